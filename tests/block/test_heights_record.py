"""What is published of the heights of a DEM, and the errors that it has in orthos, number by number."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.block.heights.adjusted_dem import AdjustedDem
from ortho_pipeline.block.heights.common_heights import CommonHeights
from ortho_pipeline.block.heights.record import record_of
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
