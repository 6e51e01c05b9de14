"""What is published of the heights of a DEM, and the errors that it has in orthos, number by number."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.block.heights.adjusted_dem import AdjustedDem
from ortho_pipeline.block.heights.common_heights import CommonHeights
from ortho_pipeline.block.heights.record import HeightsRecord, record_of
from ortho_pipeline.block.heights.spots import SpotsRecord
from ortho_pipeline.report.block import height_lines

COUNT = 12


def some(*rows: int) -> np.ndarray:
    return np.isin(np.arange(COUNT), rows)


def made(*used: int) -> tuple[Any, Any]:
    """Return heights of twelve points, of which two take no part, and a solution with some of the heights."""
    random = np.random.default_rng(3)
    common = CommonHeights.of(random.normal(0, 1, (COUNT, 3)), 4.0, 4, 2)
    root = random.normal(0, 1, (3, 3))
    value, undone = np.array([0.5, -1.5, 2.0]), np.array([0.0, -1.0, 2.0])
    common = replace(common, value=value, undone=undone, told=root @ root.T)
    sigmas = np.array([1.0, 2.0, np.inf, 4.0, *np.full(8, 7.0)])
    heights = SimpleNamespace(
        of=~some(9), wrong=some(4, 10), broken=some(4, 5, 11), sigmas=sigmas, sigma=9.0, sigma_is="stated",
        common=common, spots=None, own=np.linspace(0.25, 4.0, COUNT),
        terrain=SimpleNamespace(water=some(4, 5, 6, 11), heights=np.where(some(3), np.nan, 50.0),
                                slopes=np.where(some(1)[:, None], np.nan, (0.2, -0.1))),
        source=SimpleNamespace(shift_sigma=6.0, correct_shift=False, correlation=None,
                               surface=SimpleNamespace(sample_size=30.0)),
    )  # fmt: skip
    above = np.linspace(-2.0, 3.5, COUNT)
    planes = SimpleNamespace(on=some(*used), above=lambda local: above + local[:, 2])
    ordering = SimpleNamespace(grounded=np.array([0, 1, 2, 3, 9]), numbers=np.arange(10))
    points = SimpleNamespace(ids=tuple(f"p{k}" for k in range(COUNT)))
    solved = SimpleNamespace(
        linear=SimpleNamespace(ordering=ordering), problem=SimpleNamespace(heights=planes, points=points),
        state=SimpleNamespace(local=np.full((COUNT, 3), 0.25)),
    )  # fmt: skip
    return heights, solved


def test_every_point_that_takes_part_is_counted_once_with_its_first_reason() -> None:
    """Four are used, one is wrong, one at a break, one on water, and two have no height; one takes none at all."""
    heights, solved = made(0, 1, 2, 3, 10)
    found = record_of(heights, solved)
    assert (found.used, found.left_out, found.at_breaks, found.on_water, found.without) == (4, ("p4",), 1, 1, 2)
    # One of the four has no known sigma.
    assert found.sigma_m == pytest.approx(np.sqrt((1.0 + 4.0 + 16.0) / 3))
    assert found.rms_m == pytest.approx(np.sqrt(np.mean((np.linspace(-2.0, 3.5, 12)[:4] + 0.25) ** 2)))
    assert found.mean_error_m == pytest.approx((heights.common.loads[:4] @ [0.5, -1.5, 2.0]).mean())
    assert found.shift_m == pytest.approx((-9.0, 12.0))
    left = np.linalg.inv(np.eye(3) + heights.common.told)
    assert found.shift_sigma_m == pytest.approx(6.0 * np.sqrt(np.diag(left)[1:]))
    assert (found.bias_m, found.bias_sigma_m) == pytest.approx((2.0, 4.0 * np.sqrt(left[0, 0])))


def test_without_a_height_nothing_is_said_of_residuals() -> None:
    heights, solved = made()
    found = record_of(heights, solved)
    assert (found.used, found.rms_m, found.mean_error_m) == (0, None, 0.0)
    assert found.without == 6
    # The stated sigmas of the heights that could have been used, not the 9 m that count where none is stated.
    assert found.sigma_m == pytest.approx(np.sqrt((1.0 + 4.0 + 16.0 + 7 * 49.0) / 10))
    heights.sigmas = np.full(COUNT, np.nan)
    assert record_of(heights, solved).sigma_m == 9.0


def test_a_line_says_why_most_heights_are_not_used() -> None:
    """A sigma of 1 cm over terrain of 10 m cells: the DEM is a plane nowhere."""
    found = record_of(*made())
    few = found.model_copy(update={"used": 2, "at_breaks": 3})
    assert "2 heights of the DEM, 1 left out, 3 where it differs from a plane" in height_lines(few)[0]
    assert "plane" not in height_lines(few.model_copy(update={"at_breaks": 2}))[0]


@pytest.mark.parametrize("applied", [False, True])
def test_an_adjusted_dem_errs_by_what_is_estimated_but_not_corrected(applied: bool) -> None:
    heights, _ = made(0, 1, 2, 3)
    heights.source.correct_shift = applied
    found = AdjustedDem.of(heights, None, 0.75)
    value = [0.5, -0.5, 0.0] if applied else [0.5, -1.5, 2.0]
    np.testing.assert_allclose(found.known, heights.common.loads @ value - 0.75)
    np.testing.assert_allclose(found.own, heights.sigmas * np.sqrt(heights.own))
    # Points without a height, without a known sigma, or that take none, have no errors to tell of.
    np.testing.assert_array_equal(np.isfinite(found.loads).all(axis=1), ~some(2, 3, 9))
    np.testing.assert_array_equal(found.loads[0], heights.common.loads[0])
    np.testing.assert_array_equal(found.slopes, np.where(some(1)[:, None], 0.0, (0.2, -0.1)))
    assert found.sample == 30.0


# -- notices -----------------------------------------------------------------------------------------------------------


def record(**more: Any) -> HeightsRecord:
    plain: dict[str, Any] = {
        "used": 90, "left_out": (), "at_breaks": 0, "without": 0, "sigma_m": 2.0, "sigma_is": "stated", "rms_m": 1.0,
        "mean_error_m": 0.0, "bias_m": 0.0, "bias_sigma_m": 1.0, "bias_prior_m": 2.0, "shift_m": (3.0, -4.0),
        "shift_sigma_m": (0.5, 0.25), "shift_prior_m": 5.0, "shift_chance": None, "shift_applied": False,
        "correlation_m": None,
    }  # fmt: skip
    return HeightsRecord(**{**plain, **more})


def test_what_is_said_of_heights() -> None:
    assert record(shift_chance=0.0011).notices() == []
    (shifted,) = record(shift_chance=0.0009).notices()
    assert (shifted.code, shifted.fields["east_m"], shifted.fields["north_m"]) == ("dem-shifted", 3.0, -4.0)
    assert "5.00 m (+3.0 m east, -4.0 m north, sigma 0.50 m" in str(shifted)
    (several,) = record(left_out=tuple(f"t{k}" for k in range(12))).notices()
    assert several.fields["count"] == 12
    assert several.fields["points"] == [f"t{k}" for k in range(10)]
    spots = SpotsRecord(used=3, left_out=("s1", "s2"), without=0, mean_m=0.0, rms_m=0.1)
    (left,) = record(spots=spots).notices()
    assert (left.code, left.fields["count"], left.fields["points"]) == ("spot-heights-left-out", 2, ["s1", "s2"])
    for source in ("assumed", "estimated", "enlarged", "contradicted"):
        code = "by-default" if source == "assumed" else source
        (notice,) = record(sigma_is=source).notices()
        assert notice.code == f"dem-sigma-{code}"
        assert notice.fields["dem_sigma_m"] == 2.0


DATUMS = {"sigma_m": 8.0, "bias_sigma_m": 6.0}


@pytest.mark.parametrize(
    ("more", "limit", "whose"),
    [
        # A few metres are no datum; beyond that, four sigmas of the difference are: of 10 m and 7.5 m, of 8 m and 6 m.
        ({"bias_sigma_m": 1.0}, 20.0, "block"),
        ({"bias_prior_m": 10.0, "bias_sigma_m": 7.5}, 50.0, "block"),
        (DATUMS, 40.0, "block"),
        # Spot heights that fix a bias of which nothing is known: its prior is no accuracy.
        ({**DATUMS, "bias_prior_m": 100.0, "spots": (3, 0, 0.0)}, 40.0, "spot heights"),
        ({**DATUMS, "bias_prior_m": 24.0, "bias_sigma_m": 7.0, "spots": (3, 1, 0.0)}, 100.0, "spot heights"),
        # Without any spot that agrees, the bias is that of the block.
        ({**DATUMS, "spots": (0, 2, 300.0)}, 40.0, "block"),
    ],
)
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_dem_of_another_datum_differs_by_more_than_its_accuracy(
    more: dict[str, Any], limit: float, whose: str, way: float
) -> None:
    more = dict(more)
    used, left_out, mean = more.pop("spots", (None, 0, 0.0))
    if used is not None:
        names = tuple(f"s{k}" for k in range(left_out))
        more["spots"] = SpotsRecord(used=used, left_out=names, without=0, mean_m=mean, rms_m=0.1)
    assert "heights-disagree" not in {one.code for one in record(bias_m=0.98 * way * limit, **more).notices()}
    found = {one.code: one for one in record(bias_m=1.02 * way * limit, **more).notices()}
    notice = found["heights-disagree"]
    assert f"m {'above' if way > 0 else 'below'} the {whose}, although" in str(notice)
    assert notice.fields["median_m"] == pytest.approx(-1.02 * way * limit)
    assert notice.fields["spread_m"] == more["bias_sigma_m"]
    assert ("points.spot_vertical" in str(notice)) == (whose == "spot heights")
    assert ("spot-heights-left-out" in found) == bool(used and left_out)


@pytest.mark.parametrize("mean", [46.0, -34.0])
def test_three_spot_heights_that_all_contradict_the_block_show_another_datum(mean: float) -> None:
    """The DEM is 5 m above the block and 46 m above the spot heights: these are 41 m below the block."""
    for left_out, far, codes in (
        (3, mean, ["heights-disagree"]), (2, mean, ["spot-heights-left-out"]),
        (3, mean - np.sign(mean) * 2.0, ["spot-heights-left-out"]),
    ):  # fmt: skip
        spots = SpotsRecord(used=0, left_out=tuple("abc"[:left_out]), without=0, mean_m=far, rms_m=None)
        found = record(**DATUMS, bias_m=5.0 if mean > 0 else 7.0, spots=spots).notices()
        assert [one.code for one in found] == codes
    (notice,) = record(**DATUMS, bias_m=5.0 if mean > 0 else 7.0, spots=spots.replaced(mean_m=mean)).notices()
    assert notice.fields["median_m"] == (-41.0 if mean > 0 else 41.0)
    assert f"41.0 m {'above' if mean > 0 else 'below'} the spot heights" in str(notice)
