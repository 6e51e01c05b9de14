"""What terrain hides: against the geometry of boxes and cliffs, against brute force, and for any tiling."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyproj
import pytest
from blocks import FLOOR, NORTH, WEST, ZONE, City, Parallel, f1, towards
from osgeo import gdal
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem
from ortho_pipeline.warp.quality import visibility
from ortho_pipeline.warp.quality.sight import Sight
from ortho_pipeline.warp.quality.visibility import Visibility
from ortho_pipeline.warp.quality.visibility_kernel import HIDDEN, VOID

#: Streets, a tower, a low house next to it, a long block, and a cliff: half of the square lies 35 m higher.
TOWN = City(((60, 40, 90, 80, 30.0), (120, 100, 128, 110, 60.0), (130, 96, 142, 112, 8.0), (30, 150, 150, 162, 18.0)))
CLIFF = City(((128, -100, 400, 400, 35.0),))


def looked(city: City, path, off_nadir: float, azimuth: float, memory: int = 2**30, step: float = 1.0) -> np.ndarray:
    east, north = towards(off_nadir, azimuth)
    grid = city.grid()
    model = Parallel(east, north, 0.5, city.side)
    view = Visibility(Sight(model, grid), city.surface(path, step), (FLOOR, FLOOR + 60), memory)
    return view.look(0, 0, grid.width, grid.height)


@pytest.mark.parametrize("city", [TOWN, CLIFF], ids=["town", "cliff"])
@pytest.mark.parametrize(("off_nadir", "azimuth"), [(0, 0), (10, 75), (25, 253), (45, 128)])
def test_what_boxes_hide_is_plain_geometry(city, off_nadir, azimuth, tmp_path):
    found = looked(city, tmp_path / "dsm.tif", off_nadir, azimuth)
    east, north = towards(off_nadir, azimuth)
    x, y = city.places(city.grid())
    wanted = city.hidden(x, y, east, north)
    assert not (found == VOID).any()
    # The walls of the DSM lean over one sample: only so near to an edge may it differ (steps of 0.25 m are tried).
    some = np.flatnonzero(((found == HIDDEN) != wanted).ravel())
    assert (city.edges(x.ravel()[some], y.ravel()[some], east, north) <= 1.25).all()
    if off_nadir == 0:
        assert not (found == HIDDEN).any()


@pytest.mark.parametrize(("off_nadir", "azimuth"), [(10, 75), (25, 253), (45, 340)])
def test_the_finer_the_samples_the_fewer_the_errors(off_nadir, azimuth, tmp_path):
    found = looked(TOWN, tmp_path / "dsm.tif", off_nadir, azimuth, step=0.25)
    wanted = TOWN.hidden(*TOWN.places(TOWN.grid()), *towards(off_nadir, azimuth))
    assert f1(found == HIDDEN, wanted) >= 0.99


def rough(path, slope: float, seed: int = 2) -> Surface:
    """Write terrain of waves whose steepest slope is a tangent."""
    x, y = np.meshgrid(np.arange(0, 700.0, 5), np.arange(0, 700.0, 5))
    random, heights = np.random.default_rng(seed), np.zeros(x.shape)
    for _ in range(24):
        length, angle, phase = random.uniform(20, 200), random.uniform(0, np.pi), random.uniform(0, 6)
        heights += length * np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / length + phase)
    steepest = max(np.abs(np.diff(heights, axis=0)).max(), np.abs(np.diff(heights, axis=1)).max()) * np.sqrt(2) / 5
    write_dem(path, FLOOR + heights * slope / steepest, (WEST - 200.37, NORTH + 200.29), 5.0, f"EPSG:{ZONE}")
    return open_dem(path, "ellipsoid")


def along(surface: Surface, x: np.ndarray, y: np.ndarray, east: float, north: float, step: float = 0.1) -> np.ndarray:
    """Return how far (m) the terrain rises at most above lines of sight, looked at every so many metres upwards."""
    base = surface.heights(np.stack([x, y], axis=1))
    rises = np.arange(step, surface.height_range[1] - base.min(), step)
    most = np.full(len(x), -np.inf)
    for rise in rises:
        there = surface.heights(np.stack([x + east * rise, y + north * rise], axis=1))
        most = np.fmax(most, there - base - rise)
    return most


@pytest.mark.parametrize(("off_nadir", "azimuth"), [(10, 75), pytest.param(45, 128, marks=pytest.mark.slow)])
def test_where_the_mask_is_not_that_of_the_boxes_their_samples_are_not_the_boxes(off_nadir, azimuth, tmp_path):
    """Of the surface between the samples it is the shadow, by a walk along each ray that differs."""
    east, north = towards(off_nadir, azimuth)
    found = looked(TOWN, tmp_path / "dsm.tif", off_nadir, azimuth) == HIDDEN
    wrong = np.argwhere(found != TOWN.hidden(*TOWN.places(TOWN.grid()), east, north))
    rows, columns = wrong[:: max(1, len(wrong) // 150)].T
    x, y = TOWN.grid().xy(columns + 0.5, rows + 0.5)
    above = along(open_dem(tmp_path / "dsm.tif", "ellipsoid"), x, y, east, north, step=0.02)
    clear = np.abs(above) > 0.03  # the walk steps over what rises by less
    assert clear.sum() > 20
    np.testing.assert_array_equal(found[rows, columns][clear], (above > 0)[clear])


@pytest.mark.parametrize("azimuth", [0, 61])
def test_rough_terrain_hides_what_a_dense_walk_finds(azimuth, tmp_path):
    surface = rough(tmp_path / "dem.tif", 5.0)
    east, north = towards(50, azimuth)
    grid = City(()).grid(1.0)
    found = Visibility(Sight(Parallel(east, north, 1.0, 256.0), grid), surface, (40.0, 160.0), 2**30).look(
        0, 0, 256, 256
    )
    rows, columns = np.random.default_rng(1).integers(0, 256, (2, 600))
    x, y = grid.xy(columns + 0.5, rows + 0.5)
    above = along(surface, x, y, east, north)
    clear = np.abs(above) > 0.05  # the walk steps over what rises by less
    assert 0.05 < (above > 0.05).mean() < 0.9
    np.testing.assert_array_equal((found[rows, columns] == HIDDEN)[clear], (above > 0)[clear])


@pytest.mark.parametrize("lower", [130.0, 400.0])
def test_terrain_below_the_ellipsoid_hides_as_terrain_above_it(lower, tmp_path):
    """Parallel rays: what hides what depends on differences of heights alone."""
    grid, path = City(()).grid(1.0), tmp_path / "dem.tif"
    sight = Sight(Parallel(*towards(50, 100), 1.0, 256.0), grid)
    rough(path, 5.0)
    above = Visibility(sight, open_dem(path, "ellipsoid"), (40.0, 160.0), 2**30).look(0, 0, 256, 256)
    dataset = gdal.Open(str(path), gdal.GA_Update)
    dataset.WriteArray(dataset.ReadAsArray() - lower)
    dataset = None
    low = Visibility(sight, open_dem(path, "ellipsoid"), (40.0 - lower, 160.0 - lower), 2**30)
    below = low.look(0, 0, 256, 256)
    assert 0.05 < (above == HIDDEN).mean() < 0.9
    # Heights are rounded to float32, so that a line that touches may not.
    assert (above != below).mean() < 1e-3


def test_nothing_is_hidden_where_no_slope_is_as_steep_as_the_rays(tmp_path):
    for off_nadir in (10, 30, 45):
        surface = rough(tmp_path / "dem.tif", 0.999 / np.tan(np.radians(off_nadir)))
        for azimuth in (0, 45, 130):
            model = Parallel(*towards(off_nadir, azimuth), 1.0, 256.0)
            view = Visibility(Sight(model, City(()).grid(1.0)), surface, (0.0, 200.0), 2**30)
            assert not view.look(0, 0, 256, 256).any()


def test_any_window_and_any_memory_give_the_same(tmp_path):
    surface = rough(tmp_path / "dem.tif", 6.0)
    grid = City((), side=512.0).grid(1.0)
    sight = Sight(Parallel(*towards(40, 100), 1.0, 512.0), grid)
    whole = Visibility(sight, surface, (40.0, 160.0), 2**30).look(0, 0, 512, 512)
    assert 0.05 < (whole == HIDDEN).mean() < 0.6
    np.testing.assert_array_equal(Visibility(sight, surface, (40.0, 160.0), 3000).look(0, 0, 512, 512), whole)
    parts = Visibility(sight, surface, (40.0, 160.0), 2**30)
    for top in (0, 256):
        for left in (0, 256):
            np.testing.assert_array_equal(parts.look(left, top, 256, 256), whole[top : top + 256, left : left + 256])


def test_a_void_is_told_and_hides_nothing(tmp_path):
    path = tmp_path / "dem.tif"
    rough(path, 5.0)
    dataset = gdal.Open(str(path), gdal.GA_Update)
    heights = dataset.ReadAsArray()
    heights[60:80, 60:80] = -32768.0
    dataset.WriteArray(heights)
    dataset = None
    surface, grid = open_dem(path, "ellipsoid", fill="mask"), City(()).grid(1.0)
    sight = Sight(Parallel(*towards(40, 100), 1.0, 256.0), grid)
    found = Visibility(sight, surface, (40.0, 160.0), 2**30).look(0, 0, 256, 256)
    columns, rows = np.meshgrid(np.arange(256) + 0.5, np.arange(256) + 0.5)
    own = surface.heights(np.stack([part.ravel() for part in grid.xy(columns, rows)], axis=1)).reshape(256, 256)
    np.testing.assert_array_equal(found == VOID, np.isnan(own))
    assert (found == HIDDEN).any()


def spikes(random: np.random.Generator) -> np.ndarray:
    heights = gaussian_filter(random.normal(0, 20, (200, 200)), 2.5)
    heights[::17, ::13] += random.uniform(3, 40, heights[::17, ::13].shape)
    return heights


def plateaus(random: np.random.Generator) -> np.ndarray:
    """Blocks wide enough that lines end inside of them, some next to a void, on a slope."""
    heights = np.kron(random.uniform(0, 60, (20, 20)), np.ones((10, 10))) + np.arange(200) / 10
    heights[60:70, 90:95] = -32768.0
    return heights


@pytest.mark.parametrize("step", [2.0, 11.0])
@pytest.mark.parametrize("terrain", [spikes, plateaus])
@pytest.mark.parametrize("azimuth", [8, 45, 99, 171, 233, 304])
def test_lines_that_end_early_miss_nothing(azimuth, terrain, step, tmp_path, monkeypatch):
    """Seen flat and in every direction, what is hidden is what it is if each line is followed to its end."""
    heights = FLOOR + terrain(np.random.default_rng(azimuth)) * step / 2
    write_dem(tmp_path / "dem.tif", heights, (WEST - 72.3, NORTH + 72.1), step, f"EPSG:{ZONE}")
    surface, grid = open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"), City(()).grid(1.0)
    sight = Sight(Parallel(*towards(62, azimuth), 1.0, 256.0), grid)
    found = Visibility(sight, surface, (60.0, 180.0), 2**30).look(0, 0, 256, 256)
    unbounded = lambda heights, tops, *_: (np.full(tops.shape, np.inf), np.full(tops.shape, -np.inf))  # noqa: E731
    monkeypatch.setattr(visibility, "_bounds", unbounded)
    np.testing.assert_array_equal(found, Visibility(sight, surface, (60.0, 180.0), 2**30).look(0, 0, 256, 256))
    assert 0.05 < (found == HIDDEN).mean() < 0.9


def followed(ends: np.ndarray, tops: np.ndarray, floors: np.ndarray, relief: float) -> tuple[np.ndarray, np.ndarray]:
    """Follow lines of the extreme directions from the corners of each cell, by steps of a tenth of a metre upwards.

    Return the lowest height of a line that meets no steep cell, and the highest that lies below some floor on its way.
    """
    rows, columns = tops.shape
    down, across = np.meshgrid(np.arange(rows) + 0.0, np.arange(columns), indexing="ij")
    free, blocked = np.full(tops.shape, -np.inf), np.full(tops.shape, np.inf)
    for k, m, x, y in np.ndindex(2, 2, 2, 2):
        met, under = np.full(tops.shape, -np.inf), np.full(tops.shape, -np.inf)
        for rise in np.arange(0, relief, 0.1):
            j = np.floor(down + np.clip(y, 1e-9, 1 - 1e-9) + ends[k, 1] * rise).astype(int)
            i = np.floor(across + np.clip(x, 1e-9, 1 - 1e-9) + ends[m, 0] * rise).astype(int)
            inside = (j >= 0) & (j < rows) & (i >= 0) & (i < columns)
            there = np.clip(j, 0, rows - 1), np.clip(i, 0, columns - 1)
            met = np.maximum(met, np.where(inside, tops[there] - rise, -np.inf))
            under = np.maximum(under, np.where(inside, floors[there] - rise, -np.inf))
        free, blocked = np.maximum(free, met), np.minimum(blocked, under)
    return free, blocked


@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize(
    ("across", "down"),
    [((0.0, 0.0), (0.9, 1.1)), ((0.4, 0.45), (0.9, 0.95)), ((-0.2, 0.2), (0.9, 1.1)), ((-1.6, -1.2), (0.8, 0.9)),
     ((1.0, 1.6), (0.9, 1.3))],
)  # fmt: skip
def test_bounds_of_lines_hold_for_every_line_from_a_cell(across, down, forward):
    """Above one bound no line meets a steep cell, below the other all run into terrain: lines are followed instead."""
    ends = np.column_stack([across, down if forward else (-down[1], -down[0])])
    heights = np.kron(np.random.default_rng(8).uniform(0, 6, (6, 3)) ** 2, np.ones((5, 14)))
    heights[13, ::9] += 12.0
    corners = heights[:-1, :-1], heights[:-1, 1:], heights[1:, :-1], heights[1:, 1:]
    floors, highest, relief = np.min(corners, axis=0), np.max(corners, axis=0), float(np.ptp(heights))
    tops = np.where(highest > floors, highest, -np.inf)
    above, below = visibility._bounds(heights, tops, highest.max(), (ends[0], ends[1]), relief, 0.0)
    free, blocked = followed(ends, tops, floors, relief)
    assert (above >= free).all()
    assert (below <= blocked + 0.1).all()
    # They are of use: no farther off than what lines from cells nearby meet.
    assert (above <= maximum_filter(free, (3, 21)) + 1.0).mean() > 0.98
    if not any(across):
        near = minimum_filter(blocked, (3, 5)) - 2 / down[0] - 0.2
        assert (below >= near)[1:-1, 2:-2].all()


@pytest.mark.slow
def test_a_ray_from_the_image_ends_where_the_pixel_is_visible(tiny, tmp_path):
    """An RPC in longitude and latitude over steep terrain: the ray of a pixel's image point is walked upwards."""
    rpc = tiny.model
    lean = dataclasses.replace(
        rpc, col_num=rpc.col_num + 0.9 * np.eye(20)[3], row_num=rpc.row_num - 0.5 * np.eye(20)[3]
    )
    utm = pyproj.CRS.from_epsg(32634)
    x, y = pyproj.Transformer.from_crs(4326, utm, always_xy=True).transform(rpc.lon_off, rpc.lat_off)
    random = np.random.default_rng(5)
    heights = 500 + 60 * gaussian_filter(random.normal(0, 6, (120, 120)), 1.5)
    write_dem(tmp_path / "dem.tif", heights, (x - 1200, y + 1200), 20.0, "EPSG:32634")
    surface, grid = open_dem(tmp_path / "dem.tif", "ellipsoid"), Grid(utm, x - 512, y + 512, 4.0, 4.0, 256, 256)
    sight = Sight(lean, grid)
    found = Visibility(sight, surface, (300.0, 700.0), 2**30).look(0, 0, 256, 256)
    rows, columns = random.integers(0, 256, (2, 200))
    xy = np.stack(grid.xy(columns + 0.5, rows + 0.5), axis=1)
    own = surface.heights(xy)
    image, above = sight.image(columns + 0.5, rows + 0.5, own), np.full(200, -np.inf)
    for rise in np.arange(0.25, surface.height_range[1] - own.min(), 0.25):
        there = lean.image_to_ground(image, own + rise)
        above = np.fmax(above, surface.heights(there, "EPSG:4979") - own - rise)
    clear = np.abs(above) > 0.25
    assert 0.1 < (above > 0.25).mean() < 0.9
    np.testing.assert_array_equal((found[rows, columns] == HIDDEN)[clear], (above > 0)[clear])
