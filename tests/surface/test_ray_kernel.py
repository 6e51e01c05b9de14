"""First meetings of rays and a DEM against dense sampling in NumPy, in terrain that is as nasty as can be."""

from __future__ import annotations

import numpy as np
import pytest

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
