"""Regions of an ortho that are passed over because nothing in them is steep: nothing is hidden there."""

from __future__ import annotations

import numpy as np
import pytest
from samples import CRS, Memory
from scipy.interpolate import RegularGridInterpolator

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.dem import dem_of
from ortho_pipeline.warp.quality import visibility
from ortho_pipeline.warp.quality.sight import Sight
from ortho_pipeline.warp.quality.visibility import Visibility
from ortho_pipeline.warp.quality.visibility_kernel import HIDDEN, VOID

#: Pixels of 2 m, and samples of 10 m from a place 300 m west and 200 m north of the first pixel on.
GRID = Grid(CRS, 5e5, 6.28e6, 2.0, 2.0, 700, 560)


def terrain() -> np.ndarray:
    """Return waves of 35 m and 512 m length, which no line meets, with a wall of 30 m in a trough, and a void."""
    east = 10.0 * np.arange(190) - 300
    heights = 100 + 17.5 * np.sin(2 * np.pi * east / 512) * np.ones((160, 1))
    heights[20 + 32 : 20 + 46, 30 + 89] += 30.0
    heights[20 + 5 : 20 + 8, 30 + 130 : 30 + 134] = np.nan
    return heights


def look(way: tuple[float, float], memory: int = 10**9) -> Visibility:
    surface = dem_of(Memory(terrain(), (5e5 - 300, 6.28e6 + 200)), "ellipsoid", False, "error", 10**8)
    sight = Sight.__new__(Sight)
    sight.grid = GRID
    return Visibility(
        sight, surface, (100.0, 130.0), memory, way=lambda columns, rows, heights: np.tile(way, (len(columns), 1))
    )


def looked(made: Visibility, side: int) -> np.ndarray:
    out = np.zeros((GRID.height, GRID.width), dtype=np.uint8)
    for top in range(0, GRID.height, side):
        for left in range(0, GRID.width, side):
            out[top : top + side, left : left + side] = made.look(
                left, top, min(side, GRID.width - left), min(side, GRID.height - top)
            )
    return out


def walked(way: tuple[float, float]) -> np.ndarray:
    """Return how far terrain rises above the line from every fifth pixel at most, in steps of 0.1 m upwards."""
    surface = RegularGridInterpolator((np.arange(160), np.arange(190)), terrain(), bounds_error=False)
    rows, columns = np.mgrid[0.5 : GRID.height : 5, 0.5 : GRID.width : 5]

    def heights(rise: float) -> np.ndarray:
        x, y = 2 * (columns + way[0] * rise) + 300, 2 * (rows + way[1] * rise) + 200
        return np.asarray(surface(np.stack([y, x], axis=-1) / 10))

    above, own = np.full(rows.shape, -np.inf), heights(0.0)
    for rise in np.arange(0.1, 40.0, 0.1):
        above = np.fmax(above, heights(rise) - own - rise)
    return above


@pytest.mark.parametrize("way", [(1.5, 0.2), (0.3, -1.6)])
def test_regions_without_steep_terrain_have_nothing_hidden(
    monkeypatch: pytest.MonkeyPatch, way: tuple[float, float]
) -> None:
    monkeypatch.setattr(visibility, "_REGION", 256)
    monkeypatch.setattr(visibility, "_PIXELS_PER_SAMPLE", 0.5)
    made, whole = look(way), look(way)
    found = looked(made, 256)
    monkeypatch.setattr(whole, "_is_calm", lambda column, row: False)
    np.testing.assert_array_equal(found, looked(whole, 1024))
    rows, columns = np.nonzero(found == HIDDEN)
    assert len(rows) > 200
    above, part = walked(way), (slice(None, None, 5), slice(None, None, 5))
    assert (found[part] == HIDDEN)[above > 0.01].all()
    assert not (found[part] == HIDDEN)[above < -0.5].any()
    assert set(made._calm) == {(column, row) for column in range(3) for row in range(3)}
    steep = {(int(column // 256), int(row // 256)) for row, column in zip(rows, columns, strict=True)}
    assert (found[:256, 512:] == VOID).any()
    assert not any(made._calm[place] for place in steep | {(2, 0)})
    assert made._calm[0, 2]
    assert made._calm[1, 2]


def test_samples_that_are_nearly_as_dense_as_pixels_are_not_looked_at_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visibility, "_REGION", 256)
    rays = look((1.5, 0.2))._rays(0, 512, 256, 48)
    terrain = look((1.5, 0.2))._terrain(rays.samples.reshape(-1, 2), visibility._extremes(rays.slopes), np.inf)
    assert terrain is not None
    for samples, calm in ((terrain.heights.size + 0.5, True), (terrain.heights.size - 0.5, False)):
        monkeypatch.setattr(visibility, "_PIXELS_PER_SAMPLE", 256 * 48 / samples)
        assert look((1.5, 0.2))._is_calm(0, 2) == calm


@pytest.mark.parametrize("way", [(2.0, 0.0), (-1.0, 0.0), (0.3, 2.0)])
def test_a_tower_beyond_a_flat_tile_hides_as_much_in_any_order_of_tiles(way: tuple[float, float]) -> None:
    """A tower of 80 m on flat ground: tiles from which only flat ground is near come first, last, or all at once."""
    heights = np.full((160, 190), 100.0)
    heights[20 + 50 : 20 + 60, 30 + 70 : 30 + 76] = 180.0
    surface = dem_of(Memory(heights, (5e5 - 300, 6.28e6 + 200)), "ellipsoid", False, "error", 10**8)
    sight = Sight.__new__(Sight)
    sight.grid = GRID
    shares = []
    for side, back in ((256, False), (256, True), (1024, False)):
        made = Visibility(
            sight, surface, (100.0, 180.0), 10**9, way=lambda columns, rows, heights: np.tile(way, (len(columns), 1))
        )
        out = np.zeros((GRID.height, GRID.width), dtype=np.uint8)
        places = [(left, top) for top in range(0, GRID.height, side) for left in range(0, GRID.width, side)]
        for left, top in places[:: -1 if back else 1]:
            size = min(side, GRID.width - left), min(side, GRID.height - top)
            out[top : top + side, left : left + side] = made.look(left, top, *size)
        shares.append(out)
    assert (shares[0] == HIDDEN).sum() > 3000
    np.testing.assert_array_equal(shares[0], shares[1])
    np.testing.assert_array_equal(shares[0], shares[2])
