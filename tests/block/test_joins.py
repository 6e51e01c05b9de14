"""How accurately pairs of images join: figures of a pair, and which pairs are named as weak."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ortho_pipeline.block.relative.joins import Join, weak_joins


def join(
    sigma: float, across: float, azimuth_deg: float, names: tuple[str, str] = ("a", "b"), pixel: float = 2.0
) -> Join:
    """Return a pair with a largest sigma along an azimuth, and one across."""
    angle = math.radians(azimuth_deg)
    axes = np.array([[math.sin(angle), math.cos(angle)], [math.cos(angle), -math.sin(angle)]]).T
    return Join(*names, axes @ np.diag([sigma**2, across**2]) @ axes.T, 2.0)


@pytest.mark.parametrize("azimuth_deg", [0.0, 30.0, 89.0, 120.0, 179.0])
def test_the_sigma_of_a_pair_is_the_largest_and_has_an_azimuth(azimuth_deg: float) -> None:
    made = join(0.8, 0.3, azimuth_deg)
    assert made.sigma == pytest.approx(0.8)
    assert (made.azimuth_deg - azimuth_deg + 90) % 180 == pytest.approx(90, abs=1e-6)
    figures = made.figures(0.79)
    assert figures["sigma_m"] == pytest.approx(1.6)
    assert figures["weak"]
    assert not made.figures(0.81)["weak"]


def test_rounding_makes_no_imaginary_sigma() -> None:
    assert Join("a", "b", -1e-18 * np.eye(2), 1.0).sigma == 0.0


def test_weak_pairs_are_named_from_the_worst_on() -> None:
    joins = tuple(join(0.1 * k, 0.01, 10.0 * k, (f"i{k}", f"j{k}")) for k in range(1, 9))
    assert weak_joins(joins, 0.85) == ()
    (notice,) = weak_joins(joins, 0.65)
    assert "2 pairs of images" in str(notice)
    assert str(notice).index("i8 and j8, 0.8 px (1.6 m) along azimuth 80") < str(notice).index("i7 and j7")
    assert "more" not in str(notice)
    assert notice.fields["worst"] == ["i8", "j8"]
    assert notice.fields["pairs"] == 2
    (every,) = weak_joins(joins, 0.0, dem_unused=True)
    assert "8 pairs of images" in str(every)
    named = str(every).count(" along azimuth ")
    assert f"and {8 - named} more" in str(every)
    assert every.fields["dem_unused"] is True
    (one,) = weak_joins(joins, 0.75)
    assert "1 pair of images" in str(one)
