"""Grids of output rasters: sizes, limits and corners."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.raster.ortho import Profile, square_side
from ortho_pipeline.raster.source import MAX_SIDE, Grid

CRS = parse_crs("EPSG:32633")


def test_positions_count_from_the_upper_left_corner() -> None:
    grid = Grid(CRS, 1000.0, 5000.0, 2.0, 3.0, 7, 4)
    x, y = grid.xy(np.array([0.5, 7.0, -2.0]), np.array([0.5, 4.0, 1.5]))
    assert (x.tolist(), y.tolist()) == ([1001.0, 1014.0, 996.0], [4998.5, 4988.0, 4995.5])
    assert grid.extent == (1000.0, 4988.0, 1014.0, 5000.0)
    assert grid.geotransform == (1000.0, 2.0, 0.0, 5000.0, 0.0, -3.0)


@pytest.mark.parametrize(
    ("size", "width"), [(0.3, 1), (1.4, 1), (2.4, 2), (2.5, 3), (3.49, 3), (3.5, 4), (1234.5, 1235)]
)
def test_an_extent_has_the_nearest_number_of_pixels_and_at_least_one(size: float, width: int) -> None:
    """Halves count as one more; its first corner stays in any case."""
    grid = Grid.of_extent(CRS, (100.0, 40.0, 100.0 + size * 2.0, 40.0 + 9 * 4.0), (2.0, 4.0))
    assert (grid.left, grid.top, grid.dx, grid.dy, grid.width, grid.height) == (100.0, 76.0, 2.0, 4.0, width, 9)
    grid = Grid.of_extent(CRS, (100.0, 40.0, 100.0 + 9 * 2.0, 40.0 + size * 4.0), (2.0, 4.0))
    assert (grid.left, grid.top, grid.width, grid.height) == (100.0, 40.0 + size * 4.0, 9, width)


@pytest.mark.parametrize("side", range(4))
@pytest.mark.parametrize(("off", "more"), [(0.5e-6, 0), (2e-6, 1)])
def test_an_aligned_extent_grows_for_more_than_a_millionth_of_a_pixel(side: int, off: float, more: int) -> None:
    box = [10.0, 35.0, 30.0, 60.0]
    box[side] += off * (2.0 if side % 2 == 0 else 5.0) * (-1 if side < 2 else 1)
    grid = Grid.of_extent(CRS, box, (2.0, 5.0), align=True)
    assert (grid.width, grid.height) == (10 + more * (side % 2 == 0), 5 + more * (side % 2 == 1))
    expected = [10.0, 35.0, 30.0, 60.0]
    expected[side] += more * (2.0 if side % 2 == 0 else 5.0) * (-1 if side < 2 else 1)
    assert grid.extent == pytest.approx(expected)


@pytest.mark.parametrize(
    ("dx", "dy", "left", "top"),
    [(0, 1, 0.0, 0.0), (1, 0, 0.0, 0.0), (1, -1, 0.0, 0.0), (-1, 1, 0, 0), (1, 1, math.nan, 0), (1, 1, 0, math.inf)],
)  # fmt: skip
def test_pixels_have_a_size_and_a_place(dx: float, dy: float, left: float, top: float) -> None:
    with pytest.raises(InputError, match="must be positive"):
        Grid(CRS, left, top, dx, dy, 3, 3)


@pytest.mark.parametrize(
    ("width", "height", "possible"),
    [
        (1, MAX_SIDE, True), (MAX_SIDE, 1, True), (MAX_SIDE + 1, 1, False), (1, MAX_SIDE + 1, False), (0, 1, False),
        (1, 0, False),
    ],
)  # fmt: skip
def test_a_side_has_one_to_four_million_pixels(width: int, height: int, possible: bool) -> None:
    if possible:
        assert Grid(CRS, 0.0, 0.0, 1.0, 1.0, width, height).width == width
    else:
        with pytest.raises(InputError, match=f"would have {width} x {height} pixels"):
            Grid(CRS, 0.0, 0.0, 1.0, 1.0, width, height)


@pytest.mark.parametrize(
    ("count", "dtype", "side", "expected"),
    [
        (32, "u1", 512, 512), (33, "u1", 512, 256), (16, "u2", 512, 512), (17, "u2", 512, 256), (5, "f8", 512, 256),
        (4, "f8", 512, 512), (900, "f8", 512, 256), (8, "u1", 1024, 1024), (9, "u1", 1024, 512), (900, "f8", 128, 128),
    ],
)  # fmt: skip
def test_a_tile_has_at_most_8_mb_or_256_pixels_a_side(count: int, dtype: str, side: int, expected: int) -> None:
    """512 x 512 pixels of 32 bytes are 8 MB."""
    assert square_side(Profile(count, np.dtype(dtype), "mask"), side) == expected
