"""Samples of a DEM and the places between them, without a file."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyproj
import pytest
from scipy.ndimage import map_coordinates

from ortho_pipeline.errors import CrsError
from ortho_pipeline.surface import dem
from ortho_pipeline.surface.dem import TILE, DemSurface
from ortho_pipeline.surface.dem_file import SampleGrid
from ortho_pipeline.surface.dem_mosaic import _between_columns, _west

HEIGHTS = np.random.default_rng(1).normal(size=(6, 7))


class Samples:
    """A file of heights in feet, of which only what there is may be read."""

    def __init__(self, heights: np.ndarray) -> None:
        self.heights = heights

    def read(self, left: int, top: int, width: int, height: int, metres_per_unit: float) -> np.ndarray:
        assert min(left, top) >= 0
        assert left + width <= self.heights.shape[1]
        assert top + height <= self.heights.shape[0]
        return self.heights[top : top + height, left : left + width] * metres_per_unit


def surface(heights: np.ndarray, fill: str | float = "mask", first_column: int = 0, raised: float = 0.0) -> DemSurface:
    grid = SampleGrid(pyproj.CRS("EPSG:32636"), heights.shape, (0.0, 1.0, 0.0, 0.0, 0.0, -1.0), first_column)
    vertical = SimpleNamespace(is_ellipsoid=True)
    return DemSurface(Samples(heights / 0.3), grid, vertical, 0.3, fill, {}, 10**6, raised=raised)


def test_heights_between_samples():
    """The neighbours of the last sample are beyond it, and are not needed."""
    y, x = (part.ravel() for part in np.mgrid[0:5.1:0.25, 0:6.1:0.25])
    found = dem._bilinear(np.pad(HEIGHTS, (0, 1), constant_values=np.nan), x, y)
    np.testing.assert_allclose(found, map_coordinates(HEIGHTS, [y, x], order=1), atol=1e-12)


def test_positions_by_tile():
    u, v = np.array([0.0, TILE - 0.1, TILE, 3 * TILE + 5, 1.0, 9.0]), np.array([0.0, 1, TILE, 0, 2 * TILE, 7])
    found = {(row, column): these.tolist() for row, column, these in dem._by_tile(u, v, np.arange(5), 4)}
    assert found == {(0, 0): [0, 1], (1, 1): [2], (0, 3): [3], (2, 0): [4]}
    assert list(dem._by_tile(u, v, np.arange(0), 4)) == []


@pytest.mark.parametrize(
    "window",
    [
        (0, 0, 7, 6),
        (-2, -1, 4, 3),
        (5, 4, 4, 4),
        (2, 1, 3, 2),
        (-9, 0, 5, 5),
        (7, 0, 2, 2),
        (0, -9, 5, 5),
        (1, 6, 2, 2),
    ],
)
def test_windows_are_void_beyond_the_samples(window):
    u0, v0, nu, nv = window
    padded = np.pad(HEIGHTS, 20, constant_values=np.nan)
    expected = padded[v0 + 20 : v0 + 20 + nv, u0 + 20 : u0 + 20 + nu]
    np.testing.assert_allclose(surface(HEIGHTS).window(*window), expected)
    np.testing.assert_allclose(surface(HEIGHTS, 3.5).window(*window), np.where(np.isnan(expected), 3.5, expected))


@pytest.mark.parametrize("first", [0, 3, 6])
def test_the_seam_of_the_file_may_be_within_a_window(first):
    turned = np.roll(HEIGHTS, -first, axis=1) + 50.0
    for left, width in ((0, 7), (2, 3), (min(6 - first, 5), 2), (6, 1)):
        found = surface(HEIGHTS, first_column=first, raised=50.0).window(left, 1, width, 4)
        np.testing.assert_allclose(found, turned[1:5, left : left + width])


@pytest.mark.parametrize("shape", [(5, 6), (TILE + 1, TILE + 1), (TILE + 2, 2 * TILE + 3)])
def test_heights_of_positions_in_tiles(shape):
    """To the last row and column, whether or not a tile begins there."""
    heights = np.random.default_rng(2).normal(size=shape)
    rows, columns = shape
    u, v = np.array([0, 0.5, columns - 1.5, columns - 1, 3.25]), np.array([0, 0.5, 2.25, rows - 1.5, rows - 1])
    u, v = (part.ravel() for part in np.meshgrid(u, v))
    found = surface(heights)._interpolated(u, v, filled=False)
    np.testing.assert_allclose(found, map_coordinates(heights, [v, u], order=1), atol=1e-9)
    outside = np.array(
        [[-1e-9, 1], [columns - 1 + 1e-9, 1], [1, -1e-9], [1, rows - 1 + 1e-9], [np.nan, 1], [1, np.nan]]
    )
    assert np.isnan(surface(heights)._interpolated(*outside.T, filled=False)).all()


def test_the_window_around_a_box_has_room_for_cubics():
    """Two samples before, five after; at most two beyond the DEM, unless a rule fills what is beyond it."""
    wide = surface(np.zeros((90, 100)))
    assert wide.window_around(10.9, 20.1, 30.0, 40.9) == (8, 18, 35, 45)
    assert wide.window_around(-0.5, 1.5, 99.5, 88.0) == (-2, -1, 102, 92)
    assert surface(np.zeros((90, 100)), 0.0).window_around(-5.5, -3.0, 99.5, 89.0) == (-8, -5, 104, 94)
    assert wide.window_around(101.0, 5.0, 120.0, 9.0) == (99, 3, 102, 14)
    assert wide.window_around(102.0, 5.0, 120.0, 9.0) == (100, 3, 102, 14)
    assert wide.window_around(103.0, 5.0, 120.0, 9.0) is None
    assert wide.window_around(5.0, 92.0, 9.0, 95.0) == (3, 90, 14, 92)
    assert wide.window_around(5.0, 93.0, 9.0, 95.0) is None
    assert wide.window_around(-9.0, 5.0, -5.0, 9.0) == (-2, 3, 0, 14)
    assert wide.window_around(-9.0, 5.0, -6.0, 9.0) is None
    assert wide.window_around(5.0, -9.0, 9.0, -5.0) == (3, -2, 14, 0)
    assert wide.window_around(5.0, -9.0, 9.0, -6.0) is None


@pytest.mark.parametrize("window", [(0, 0, 30, 20), (7, 11, 1, 1), (9, 9, 2, 2), (-13, 4, 25, 9)])
def test_undulations_are_bilinear_between_multiples_of_the_spacing(window):
    """500 m are ten samples of 50 m."""
    left, top, width, height = window

    def undulation(lon, lat):
        return 0.01 * lon**2 + 0.02 * lat**2 + lon * lat

    grid = SimpleNamespace(sample_size=50.0, lonlat=lambda u, v: (u, v))
    found = dem._undulations(SimpleNamespace(undulation=undulation), grid, window)
    nodes = undulation(*np.meshgrid(np.arange(-20, 50, 10.0), np.arange(-20, 50, 10.0)))
    y, x = np.mgrid[top : top + height, left : left + width]
    np.testing.assert_allclose(found, map_coordinates(nodes, [(y + 20) / 10, (x + 20) / 10], order=1), atol=1e-9)


@pytest.mark.parametrize("size", [500.0, 900.0])
def test_undulations_of_wide_samples_and_at_the_rim_of_a_geoid_are_their_own(size):
    grid = SimpleNamespace(sample_size=size, lonlat=lambda u, v: (u, v))
    vertical = SimpleNamespace(undulation=lambda lon, lat: lon**2 - lat)
    y, x = np.mgrid[3:8, 2:9]
    np.testing.assert_array_equal(dem._undulations(vertical, grid, (2, 3, 7, 5)), x**2 - y)
    rim = SimpleNamespace(undulation=lambda lon, lat: np.where(lon > 8, np.nan, lon**2 - lat))
    fine = SimpleNamespace(sample_size=50.0, lonlat=lambda u, v: (u, v))
    np.testing.assert_array_equal(dem._undulations(rim, fine, (2, 3, 7, 5)), x**2 - y)


# -- columns of several spacings -------------------------------------------------------------------------------------


def members(step: float, *west: float):
    crs = pyproj.CRS.from_epsg(4326)
    return [(SimpleNamespace(path="a.tif"), SampleGrid(crs, (9, 9), (x, step, 0.0, 50.0, 0.0, -1.0))) for x in west]


@pytest.mark.parametrize(
    ("coarse", "west", "fine", "count"),
    [
        (2.0, 10.0, 1.0, 1),
        (1.5, 10.0, 1.0, 2),
        (2.0, 10.5, 1.0, 2),
        (2.0, 9.5, 1.0, 2),
        (1.5, 10.25, 1.0, 4),
        (4 / 3, 10.0, 1.0, 3),
        (13 / 12, 10.0, 1.0, 12),
        (-1.5, 10.25, -1.0, 4),
    ],
)
def test_columns_of_all_spacings_are_among_the_divided_ones(coarse, west, fine, count):
    assert _between_columns([members(coarse, west), members(fine, 10.0)]) == count


def test_the_first_column_is_that_of_the_file_farthest_west():
    assert _west(members(1.0, 3.0, 9.0)) == 3.0
    assert _west(members(-1.0, 3.0, 9.0)) == 9.0
    assert _between_columns([members(2.0, 14.5, 10.5), members(1.0, 12.0, 10.0)]) == 2
    assert _between_columns([members(2.0, 12.5), members(1.0, 13.0, 12.5)]) == 1


@pytest.mark.parametrize(("coarse", "west"), [(14 / 13, 10.0), (1.001, 10.0), (2.0, 10.04)])
def test_columns_that_do_not_match_are_refused(coarse, west):
    with pytest.raises(CrsError, match="do not match"):
        _between_columns([members(coarse, west), members(1.0, 10.0)])


def test_columns_may_be_off_by_a_hundredth_of_their_own_samples():
    assert _between_columns([members(2.0, 10.019), members(1.0, 10.0)]) == 1
    with pytest.raises(CrsError):
        _between_columns([members(2.0, 10.021), members(1.0, 10.0)])
