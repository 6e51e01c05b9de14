"""The area of a stack in which displacements are compared."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from ortho_pipeline.batch.stack.dates import Dated
from ortho_pipeline.batch.stack.placing import Placed
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
