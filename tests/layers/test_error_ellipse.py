"""Circular errors: against drawn errors, against the closed forms of a line and of a circle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate, stats

from ortho_pipeline.warp.quality.error_ellipse import (
    circular_error,
    circular_error_of_all,
    principal,
    radii,
    share_beyond,
)


def test_a_line_and_a_circle_are_those_of_the_normal_and_the_rayleigh_distribution():
    line, circle = circular_error(np.array([[4.0, 0.0, 0.0], [4.0, 4.0, 0.0]]))
    assert line == pytest.approx(2 * stats.norm.ppf(0.95), rel=1e-6)
    assert circle == pytest.approx(2 * math.sqrt(-2 * math.log(0.1)), rel=1e-6)
    # An axis that lies askew has the same length.
    assert circular_error(np.array([[2.0, 2.0, 2.0]]))[0] == pytest.approx(line, rel=1e-6)


@pytest.mark.parametrize("ratio", [0.003, 0.0501, 0.3, 0.77])
def test_an_ellipse_holds_nine_tenths_of_the_density_within_its_circle(ratio):
    radius = circular_error(np.array([[1.0, ratio**2, 0.0]]))[0]

    def strip(x: float) -> float:
        return stats.norm.pdf(x) * math.erf(math.sqrt(radius**2 - x**2) / ratio / math.sqrt(2))

    assert integrate.quad(strip, -radius, radius, limit=400, points=[0.0])[0] == pytest.approx(0.9, abs=2e-6)
    assert np.diff(radii()).min() > -1e-9


def test_all_places_together_are_a_mixture():
    random = np.random.default_rng(1)
    covariance = np.array([[1.0, 0.3, 0.2], [9.0, 4.0, -3.0]])
    drawn = [random.multivariate_normal([0, 0], [[xx, xy], [xy, yy]], 200_000) for xx, yy, xy in covariance]
    lengths = np.hypot(*np.concatenate(drawn).T)
    assert circular_error_of_all(covariance) == pytest.approx(np.quantile(lengths, 0.9), rel=0.01)
    assert circular_error_of_all(covariance[:1]) == pytest.approx(circular_error(covariance[:1])[0], rel=1e-6)


def inside(radius: float, larger: float, smaller: float) -> float:
    """Return the share of the errors in a circle: the density along strips."""

    def strip(x: float) -> float:
        return float(stats.norm.pdf(x, scale=larger) * math.erf(math.sqrt(radius**2 - x**2) / smaller / math.sqrt(2)))

    return float(integrate.quad(strip, -radius, radius, limit=400, points=[0.0])[0])


@pytest.mark.parametrize(("radius", "larger", "smaller"), [(3.7, 2.5, 0.8), (0.6, 1.7, 1.1), (9.0, 4.0, 3.9)])
def test_the_share_beyond_a_radius_is_that_of_the_density_outside(radius: float, larger: float, smaller: float) -> None:
    found = share_beyond(np.array(radius), np.array([larger]), np.array([smaller]))
    assert found[0] == pytest.approx(1 - inside(radius, larger, smaller), abs=1e-9)


@pytest.mark.parametrize("share", [0.5, 0.95])
def test_a_circle_holds_the_share_that_is_asked_for(share: float) -> None:
    line, circle, ellipse = circular_error(np.array([[9.0, 0.0, 0.0], [9.0, 9.0, 0.0], [9.0, 4.0, 0.0]]), share)
    assert line == pytest.approx(3 * stats.norm.ppf((1 + share) / 2), rel=2e-6)
    assert circle == pytest.approx(3 * math.sqrt(-2 * math.log(1 - share)), rel=1e-6)
    assert inside(ellipse, 3.0, 2.0) == pytest.approx(share, abs=2e-6)


def test_the_radius_of_all_places_is_exact_for_different_ellipses() -> None:
    covariance = np.array([[1.0, 0.3, 0.2], [9.0, 4.0, -3.0], [2.0, 6.0, 1.0]])
    axes = [np.sqrt(np.linalg.eigvalsh([[xx, xy], [xy, yy]])) for xx, yy, xy in covariance]
    np.testing.assert_allclose(np.stack(principal(covariance), axis=1), [axis[::-1] for axis in axes])
    for share in (0.5, 0.9):
        radius = circular_error_of_all(covariance, share)
        assert np.mean([inside(radius, axis[1], axis[0]) for axis in axes]) == pytest.approx(share, abs=1e-6)


def test_no_error_has_a_circle_of_no_radius() -> None:
    np.testing.assert_array_equal(circular_error(np.zeros((2, 3))), 0.0)
    assert circular_error_of_all(np.zeros((2, 3))) == 0.0
