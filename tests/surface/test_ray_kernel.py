"""First meetings of rays and a DEM against dense sampling in NumPy, in terrain that is as nasty as can be."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from ortho_pipeline.surface import ray_kernel

SIDE, LEFT, TOP = 60, 3, -2
#: Greatest difference (m) in height between a ray and the terrain.
TOLERANCE = 1e-4


def terrain(name: str) -> np.ndarray:
    """Heights of samples that are 10 m apart."""
    random = np.random.default_rng(1)
    y, x = np.mgrid[:SIDE, :SIDE]
    heights = 40 * np.sin(x / 7) * np.cos(y / 9) + random.normal(0, 2, x.shape)
    if name == "noise":
        heights = random.normal(0, 30, x.shape)
    elif name == "cliffs":
        heights = np.where((x // 9 + y // 11) % 2 == 0, 100.0, 0.0)
    elif name == "needles":
        heights = np.zeros(x.shape)
        heights[tuple(random.integers(2, SIDE - 2, (2, 60)))] = 150.0
    elif name == "plateaus":
        heights = np.round(random.normal(0, 1, (6, 6))).repeat(10, 0).repeat(10, 1) * 50
    elif name == "voids":
        heights[random.uniform(size=x.shape) < 0.01] = np.nan
        heights[20:30, 40:50] = np.nan
    return heights


def rays(half: float, count: int) -> np.ndarray:
    """Curves ``(10, n)``: straight down to 80 degrees off it, along the samples and across, straight and bent."""
    random = np.random.default_rng(2)
    curves = np.zeros((10, count))
    curves[[0, 5]] = random.uniform(0.5, SIDE - 1.5, (2, count)) + np.array([[LEFT], [TOP]])
    reach = random.choice([0.0, 0.2, 0.7, 1.7, 5.7], count) * half / 10
    azimuth = np.where(np.arange(count) % 4 == 0, np.pi / 4 * np.arange(count), random.uniform(0, 2 * np.pi, count))
    curves[[1, 6]] = reach * [np.cos(azimuth), np.sin(azimuth)]
    curves[[2, 3, 7, 8], ::3] = random.normal(0, 3e-3, (4, len(azimuth[::3])))
    return curves


def clearances(curve: np.ndarray, heights: np.ndarray, t: np.ndarray, middle: float, half: float) -> np.ndarray:
    """Height of a ray above the terrain; NaN off it and beside voids."""
    x, y = np.polyval(curve[4::-1], t) - LEFT, np.polyval(curve[9:4:-1], t) - TOP
    i, j = (np.clip(np.floor(place).astype(int), 0, SIDE - 2) for place in (x, y))
    fx, fy = x - i, y - j
    upper = heights[j, i] * (1 - fx) + heights[j, i + 1] * fx
    lower = heights[j + 1, i] * (1 - fx) + heights[j + 1, i + 1] * fx
    inside = (x >= 0) & (y >= 0) & (x <= SIDE - 1) & (y <= SIDE - 1)
    return np.where(inside, middle + half * t - (upper * (1 - fy) + lower * fy), np.nan)


@pytest.mark.parametrize("name", ["rough", "noise", "cliffs", "needles", "plateaus", "voids"])
def test_first_meetings_are_those_of_dense_sampling(name):
    """Steps of a sample, which were taken before, went past the tops of needles, and out of voids (1 ray in 25)."""
    heights = terrain(name)
    low, high = np.nanmin(heights) - 1.0, np.nanmax(heights) + 1.0
    middle, half = (low + high) / 2, (high - low) / 2
    curves = rays(half, 300)
    # The steep cells are those of a bundle of parallel rays: each ray is a bundle, and one of all hides nothing either.
    wide = ray_kernel.terrain_of(heights, LEFT, TOP, middle, half, curves.T)
    together = ray_kernel.meet(curves, wide, TOLERANCE)
    t = np.linspace(1.0, -1.0, 8001)
    met = 0
    for k, curve in enumerate(curves.T):
        alone = ray_kernel.terrain_of(heights, LEFT, TOP, middle, half, curve[None])
        (found,) = ray_kernel.meet(curve[:, None], alone, TOLERANCE)
        np.testing.assert_allclose(together[k], found, rtol=0, atol=5 * TOLERANCE)
        sampled = clearances(curve, heights, t, middle, half)
        under = np.flatnonzero(sampled <= 0.0)
        hits = len(under) and under[0] > 0 and sampled[under[0] - 1] > 0.0
        if np.isnan(found):
            # Sampling finds nothing either, or a ray that comes out of a void, or from next to the DEM, below it.
            assert not hits
            continue
        met += 1
        # On the terrain, nothing under it before, and not beyond where sampling is under it.
        assert abs(clearances(curve, heights, np.array([found]), middle, half)[0]) <= TOLERANCE
        before = sampled[t > found + 1e-12]
        assert not (before < -TOLERANCE).any()
        assert not hits or found >= t[under[0]] - 1e-12
    assert met > 200


def test_a_ray_over_a_void_and_one_that_comes_out_of_it_below_the_terrain():
    heights = np.zeros((20, 20))
    heights[:, 8:12] = np.nan
    # 45 degrees: a sample to the right per metre down, from 10 m down to -10.
    curves = np.zeros((10, 3))
    curves[1], curves[5] = -10.0, 9.5
    curves[0] = [3.0, 13.0, -1.0]  # where they meet the height zero: before the void, behind it, and before it
    curves[0, 2] = 9.5  # in it
    terrain = ray_kernel.terrain_of(heights, 0, 0, 0.0, 10.0, curves.T)
    found = ray_kernel.meet(curves, terrain, TOLERANCE)
    np.testing.assert_allclose(found, [0.0, 0.0, np.nan], atol=TOLERANCE)


def test_bounds_are_those_of_their_squares():
    """And the largest difference of neighbours, over the seams of squares too."""
    heights = terrain("voids")[:45, :37]
    node = np.zeros((1, 10))
    node[0, 1], node[0, 6] = 0.4, -0.2
    found = ray_kernel.terrain_of(heights, 0, 0, 0.0, 50.0, node)
    steepest = max(np.nanmax(np.abs(np.diff(heights, axis=axis))) for axis in (0, 1))
    assert found.steepest == steepest
    expected = []
    for bits in (3, 4, 5, 6):
        side = 1 << bits
        squares = [
            np.nanmax(heights[j : j + side + 1, i : i + side + 1])
            for j in range(0, 44, side)
            for i in range(0, 36, side)
        ]
        expected += squares
    np.testing.assert_array_equal(found.tops, expected)


@pytest.mark.parametrize("axis", [0, 1], ids=["columns", "rows"])
@pytest.mark.parametrize("way", [-1, 1])
def test_a_needle_far_ahead_of_a_ray_counts(axis, way):
    """Rays go a sample per metre upwards, through 100 m; the needle is 60 samples ahead of the last square."""
    heights = np.zeros((65, 65))
    needle, start = [36, 36], [4, 4]
    needle[1 - axis], start[1 - axis] = (4, 7) if way < 0 else (60, 0)
    heights[tuple(needle)] = 100.0
    node = np.zeros((1, 10))
    node[0, 1 + 5 * axis] = way * 50.0
    found = ray_kernel.terrain_of(heights, 0, 0, 0.0, 50.0, node)
    assert found.steep[tuple(start)] == 100.0
    # Behind a ray it does not.
    start[1 - axis] = 0 if way < 0 else 7
    needle[1 - axis] = 60 if way < 0 else 4
    heights = np.zeros((65, 65))
    heights[tuple(needle)] = 100.0
    assert ray_kernel.terrain_of(heights, 0, 0, 0.0, 50.0, node).steep[tuple(start)] == -np.inf


def test_rays_of_gentle_terrain_are_not_followed_cell_by_cell(monkeypatch):
    """Nothing in it climbs as fast as rays 20 degrees off the vertical: where they are on it, they first meet it."""
    heights = terrain("rough")
    followed = []
    monkeypatch.setattr(ray_kernel, "follow", lambda curves, *more: followed.append(len(curves)))
    curves = rays(60.0, 500)
    curves[[1, 6]] *= 0.2 * 6 / np.maximum(np.hypot(curves[1], curves[6]), 1.2)
    curves[[0, 5]] = np.random.default_rng(0).uniform(20, 30, (2, 500))
    found = ray_kernel.meet(curves, ray_kernel.terrain_of(heights, LEFT, TOP, 0.0, 60.0, curves.T), TOLERANCE)
    assert np.isfinite(found).all()
    assert not followed


# -- parts, as plain Python ------------------------------------------------------------------------------------------


def test_curves_between_nodes(interpreted):
    interpreted(ray_kernel)
    nodes = np.random.default_rng(3).normal(size=(4, 5, 11))
    y, x = (part.ravel() for part in np.mgrid[0:3.1:0.5, 0:4.1:0.5])
    found = np.empty((11, len(x)))
    ray_kernel.curves_at(nodes, np.stack([x, y], axis=1), found)
    expected = [map_coordinates(nodes[..., m], [y, x], order=1) for m in range(11)]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    outside = np.array([[-1e-9, 1], [4 + 1e-9, 1], [1, -1e-9], [1, 3 + 1e-9], [np.nan, 1], [1, np.nan]])
    found = np.zeros((11, 6))
    ray_kernel.curves_at(nodes, outside, found)
    assert np.isnan(found).all()


def test_cells_of_rays_are_where_their_polynomials_lead():
    work, cells = np.zeros((ray_kernel._ROWS, ray_kernel.BLOCK)), np.zeros((2, ray_kernel.BLOCK), int)
    work[:5, 0], work[5:10, 0], work[ray_kernel._T, 0] = [9.1, 1, 0.4, -0.3, 0.2], [3.2, -0.5, 0.3, 0.6, -0.7], 0.5
    work[0, 1:5], work[5, 1:5] = [4.0, 12.0, 3.99, 5.0], [-2.0, 4.0, 0.0, 4.01]  # first, last, and outside
    ray_kernel._locate(work, cells, 4.0, -2.0, 6, 8)
    x, y = np.polyval(work[4::-1, 0], 0.5) - 4, np.polyval(work[9:4:-1, 0], 0.5) + 2
    assert cells[:, 0].tolist() == [int(x), int(y)] == [5, 5]
    np.testing.assert_allclose(work[[ray_kernel._FX, ray_kernel._FY], 0], [x - 5, y - 5])
    assert cells[:, 1:3].tolist() == [[0, 7], [0, 5]]
    np.testing.assert_allclose(work[ray_kernel._FX, 1:5], [0, 1, np.nan, np.nan])
    np.testing.assert_allclose(work[ray_kernel._FY, 1:3], [0, 1])


def test_places_of_a_ray_and_heights_of_a_cell():
    curve = np.array([9.1, 1, 0.4, -0.3, 0.2, 3.2, -0.5, 0.3, 0.6, -0.7])
    terrain = ray_kernel.BoundedHeights(None, 4.0, -2.0, 0.0, 1.0, None, None, 0.0)
    expected = np.polyval(curve[4::-1], -0.7) - 4, np.polyval(curve[9:4:-1], -0.7) + 2
    np.testing.assert_allclose(ray_kernel._place(curve, -0.7, terrain), expected)
    heights = np.array([[0.0, 0, 0], [0, 1, 5], [0, 3, 9]])
    for x, y, height in ((1, 1, 1), (2, 1, 5), (1, 2, 3), (2, 2, 9), (1.5, 1.5, 4.5), (3, 1, 9), (1, 3, 5)):
        assert ray_kernel._surface(heights, 1, 1, x, y) == height


def test_squares_of_cells_are_numbered_row_by_row_from_the_smallest():
    rows, columns = 35, 50
    tops = np.arange(5 * 7 + 3 * 4 + 2 * 2 + 1)
    for j, i in ((0, 0), (34, 49), (8, 15), (16, 31), (33, 7)):
        assert ray_kernel._square(tops, rows, columns, i, j, 3) == j // 8 * 7 + i // 8
        assert ray_kernel._square(tops, rows, columns, i, j, 4) == 35 + j // 16 * 4 + i // 16
        assert ray_kernel._square(tops, rows, columns, i, j, 5) == 47 + j // 32 * 2 + i // 32
        assert ray_kernel._square(tops, rows, columns, i, j, 6) == 51
    assert ray_kernel._square(np.arange(24), 32, 48, 47, 31, 3) == 23
    assert [ray_kernel._coarsest(length) for length in (1, 8, 8.1, 16, 17, 64, 65)] == [3, 3, 4, 4, 5, 6, 7]


@pytest.mark.parametrize(("low", "high"), [((0.0, 0.0), (0.0, 0.0)), ((-3.0, 2.0), (10.0, 19.0)), ((-40, -9), (-7, 0))])
def test_the_highest_of_squares_that_rays_pass(low, high):
    """A square of 8 samples and one more on each side, moved by what rays go: which others does it touch?"""
    steep = np.random.default_rng(2).normal(size=(7, 9))
    found = ray_kernel._ahead(steep, np.array(low), np.array(high))
    for j, i in np.ndindex(steep.shape):
        spans = []
        for at, axis, count in ((j, 1, 7), (i, 0, 9)):
            first = 8 * at + min(low[axis], 0) - 1
            last = 8 * at + 8 + max(high[axis], 0) + 1
            spans.append([k for k in range(count) if 8 * k + 8 > first and 8 * k < last])
        least = steep[np.ix_(*spans)].max()
        wider = [
            range(max(span[0] - 1, 0), min(span[-1] + 2, count)) for span, count in zip(spans, (7, 9), strict=True)
        ]
        assert least <= found[j, i] <= steep[np.ix_(*wider)].max()


@pytest.mark.parametrize("lean", [(0.3, 0.2), (-0.3, 0.2), (-0.3, -0.2)])
def test_squares_of_few_samples(interpreted, lean):
    """Steep cells, voids and differences of samples, to the last row and column."""
    interpreted(ray_kernel)
    heights = np.random.default_rng(4).normal(0, 2, (11, 20))
    heights[10, 19], heights[5, 8], heights[3, 12] = 30.0, 40.0, np.nan
    tops, steep, voids = (np.empty((2, 3)) for _ in range(3))
    way = np.array(lean)
    steepest = ray_kernel.find_squares(heights, way - 0.01, way + 0.01, tops, steep, voids)
    differences = [np.abs(np.diff(heights, axis=axis)) for axis in (0, 1)]
    assert steepest == max(np.nanmax(part) for part in differences)
    for j, i in np.ndindex(2, 3):
        square = heights[8 * j : 8 * j + 9, 8 * i : 8 * i + 9]
        assert tops[j, i] == np.nanmax(square)
        assert voids[j, i] == np.isnan(square).any()
        peaks = [-np.inf]
        for y, x in np.ndindex(square.shape[0] - 1, square.shape[1] - 1):
            (h00, h10), (h01, h11) = cell = square[y : y + 2, x : x + 2]
            # The climb is linear along each side and in the direction: greatest at one of the ends.
            ways = [(a, b) for a in (way[0] - 0.01, way[0] + 0.01) for b in (way[1] - 0.01, way[1] + 0.01)]
            climb = max(a * u + b * v for a, b in ways for u in (h10 - h00, h11 - h01) for v in (h01 - h00, h11 - h10))
            if climb > 1:
                peaks.append(cell.max())
        assert steep[j, i] == max(peaks)
    assert np.isfinite(steep).any()


def test_a_ray_enters_at_the_nearer_sides_of_the_samples():
    """From outside at a height: how far down until both coordinates are within (0, 0) and (9, 5)."""
    assert ray_kernel._entry(-3.0, 2.0, 1.5, 0.1, 5, 9) == 2.0
    assert ray_kernel._entry(12.0, 2.0, -1.5, 0.1, 5, 9) == 2.0
    assert ray_kernel._entry(-3.0, -2.0, 1.5, 0.5, 5, 9) == 4.0
    assert ray_kernel._entry(4.0, 8.0, 1.5, -0.5, 5, 9) == 6.0
    assert ray_kernel._entry(4.0, 2.0, 1.5, -0.5, 5, 9) == 0.0
