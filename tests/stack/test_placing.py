"""The area of a stack in which displacements are compared."""

from __future__ import annotations

from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ortho_pipeline.batch.stack.dates import Dated
from ortho_pipeline.batch.stack.placing import Placed
from ortho_pipeline.block.stack.adjustment import AdjustedStack
from ortho_pipeline.block.stack.edges import Cells
from ortho_pipeline.commands.orthos.opening import ORTHO
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import MapGrid


def date(west: float, side: int) -> Dated:
    """Return an ortho with pixels of one metre."""
    grid = MapGrid("EPSG:32735", (500_000.0 + west, 1.0, 0.0, 7_000_000.0, 0.0, -1.0), (side, side))
    scene = Scene(ORTHO, Path("a.tif"), side, side, {MapGrid.kind: grid}, "a.tif")
    return Dated("a", Path("a.tif"), datetime(2020, 1, 1, tzinfo=UTC), "list", scene)


def test_the_area_of_a_stack_is_what_matched_dates_share() -> None:
    """Cells over a large or misplaced ortho would be too large for the ground that the others show."""
    dates = [date(0, 240), date(10, 240), date(-1000, 4000), date(50_000, 240)]
    low, high = Placed.of(dates).shared(dates, [(1, 0), (2, 0), (2, 1)])
    west, north = 1000.0, 0.0
    assert low.tolist() == [west, north]
    assert high.tolist() == [west + 250.0, north + 240.0]
    # A reference may show all of a date.
    assert Placed.of(dates[:1]).shared(dates[:1], [(0, 1)])[1].tolist() == [240.0, 240.0]


def of_corrections(dates: list[Dated], corrections: Any, determined: Any) -> tuple[Placed, Any, Placed, Any]:
    """Return the grid of dates and the stack with corrections ``(T, 2)`` px on it, and both for corrected dates."""
    placed, parts = Placed.of(dates), {one.name: None for one in fields(AdjustedStack)}
    value = np.zeros((len(dates), 3, 2))
    value[:, 0] = corrections
    network = SimpleNamespace(value=value, covariance=np.zeros((2, 3 * len(dates), 3 * len(dates))))
    made: dict[str, Any] = {
        "network": network, "determined": np.array(determined), "sloped": np.zeros(len(dates), dtype=bool),
        "cells": Cells.over(*placed.shared(dates, [(2, 1)])),
    }  # fmt: skip
    stack = AdjustedStack(**parts | made)
    return placed, stack, *placed.of_corrected(dates, stack)


def test_dates_that_are_not_corrected_do_not_extend_the_grid() -> None:
    """An ortho of another place, 300 km away, would make all orthos 300 km large."""
    dates = [date(300_000, 240), date(0, 240), date(10, 240)]
    placed, stack, found, same = of_corrections(dates, np.zeros((3, 2)), [False, True, True])
    assert (found.grid.left, found.grid.width, found.grid.height) == (500_000.0, 250, 240)
    before, after = (one.model.image_to_ground(of.cells.middles, 0.0) for one, of in ((placed, stack), (found, same)))
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_the_grid_has_the_corrected_area_of_all_dates_and_all_of_the_first() -> None:
    """A date that shows the ground 30 px too far west is moved east, and its eastern edge must not be lost."""
    dates = [date(0, 240), date(0, 240), date(0, 240)]
    placed, _, found, same = of_corrections(dates, [[0.3, -0.4], [-30.2, 0.0], [4.0, 7.6]], [True] * 3)
    grid, old = found.grid, placed.grid
    # The second date reaches 30.2 px farther east, the third one 4 px farther west and 7.6 px farther north.
    assert (grid.left, grid.top, grid.width, grid.height) == (old.left - 4.0, old.top + 8.0, 274, 248)
    np.testing.assert_allclose(same.cells.low, np.array([4.0, 8.0]))


def test_longitudes_on_both_sides_of_the_antimeridian_are_one_area() -> None:
    """The second date has longitudes from -180.0005, which is 179.9995."""

    def of_west(west: float) -> Dated:
        grid = MapGrid("EPSG:4326", (west, 1e-5, 0.0, 10.0, 0.0, -1e-5), (240, 240))
        scene = Scene(ORTHO, Path("a.tif"), 240, 240, {MapGrid.kind: grid}, "a.tif")
        return Dated("a", Path("a.tif"), datetime(2020, 1, 1, tzinfo=UTC), "list", scene)

    dates = [of_west(179.999), of_west(-180.0005), of_west(179.9992)]
    _, _, found, _ = of_corrections(dates, np.zeros((3, 2)), [True] * 3)
    for grid in (Placed.of(dates).grid, found.grid):
        assert (grid.width, grid.height) == (290, 240)
        np.testing.assert_allclose(grid.left, 179.999, atol=1e-9)
    np.testing.assert_allclose(found.shared(dates, [(1, 0)]), [[50, 0], [240, 240]], atol=1e-4)
