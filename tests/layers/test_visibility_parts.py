"""The parts of the look along lines of sight, by hand: directions, their extremes, terrain that counts, bounds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from samples import CRS, Memory

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.dem import dem_of
from ortho_pipeline.warp.quality import visibility
from ortho_pipeline.warp.quality.sight import Sight
from ortho_pipeline.warp.quality.visibility import FAR, NEAR, Visibility, _across, _bounds, _extremes

HEIGHTS = np.random.default_rng(3).uniform(100.0, 140.0, (200, 220))


def look(heights: np.ndarray = HEIGHTS, way: tuple[float, float] = (2.0, -3.0)) -> Visibility:
    """Return the look from pixels of 5 m along lines that go so many pixels per metre upwards."""
    surface = dem_of(Memory(heights, (5e5, 6.28e6)), "ellipsoid", False, "error", 10**8)  # type: ignore[arg-type]
    sight = Sight.__new__(Sight)
    sight.grid = Grid(CRS, 5e5, 6.28e6, 5.0, 5.0, 300, 260)
    return Visibility(
        sight, surface, (100.0, 140.0), 10**9, way=lambda columns, rows, heights: np.tile(way, (len(columns), 1))
    )


def test_directions_are_in_samples_and_lengths_in_metres() -> None:
    """Two pixels of 5 m are one sample of 10 m to the right, three are one and a half upwards."""
    slopes, tangents = look()._slopes(np.array([100.0, 120.0]), np.array([100.0, 90.0]), np.array([100.0, 120.0]))
    np.testing.assert_allclose(slopes, [[1.0, -1.5]] * 2, rtol=1e-6)
    np.testing.assert_allclose(tangents, np.hypot(10.0, 15.0), rtol=1e-3)


def test_nodes_begin_in_the_middle_of_the_first_pixel_and_reach_beyond_the_last() -> None:
    columns, rows = Visibility._nodes(256, 512, 300, 129, 128)
    assert columns[0].tolist() == [256.5, 384.5, 512.5, 640.5]
    assert rows[:, 0].tolist() == [512.5, 640.5, 768.5]
    assert Visibility._nodes(0, 0, 256, 128, 128)[0].shape == (2, 3)


def test_rays_of_a_window_have_places_directions_and_the_bend_of_the_earth() -> None:
    rays = look()._rays(0, 0, 200, 150)
    assert rays.samples.shape == (-(-150 // NEAR) + 1, -(-200 // NEAR) + 1, 2)
    # The middle of the first pixel is 2.5 m from the corner, which is the first sample.
    np.testing.assert_allclose(rays.samples[0, 0], [0.25, 0.25], atol=1e-6)
    np.testing.assert_allclose(rays.samples[1, 1], [0.25 + NEAR / 2] * 2, atol=1e-6)
    assert rays.slopes.shape == (-(-150 // FAR) + 1, -(-200 // FAR) + 1, 3, 2)
    known = rays.slopes[0, 0]
    np.testing.assert_allclose(known[0], [1.0, -1.5], rtol=1e-6)
    np.testing.assert_allclose(known[1:], 0.0, atol=1e-8)
    assert rays[-3:-1] == (120.0, 20.0)
    assert rays.bend == pytest.approx((10.0**2 + 15.0**2) / (2 * 6_371_000.0), rel=1e-2)


def test_extremes_are_those_of_the_polynomials_and_a_hundredth_more() -> None:
    slopes = np.random.default_rng(8).normal(size=(3, 4, 3, 2))
    t = np.linspace(-1.5, 1.5, 7)
    values = np.stack([slopes[:, :, 0] + slopes[:, :, 1] * s + slopes[:, :, 2] * s**2 for s in t])
    low, high = _extremes(slopes)
    margin = 0.01 * np.abs(values).max(axis=(0, 1, 2))
    np.testing.assert_allclose(low, values.min(axis=(0, 1, 2)) - margin)
    np.testing.assert_allclose(high, values.max(axis=(0, 1, 2)) + margin)


@pytest.mark.parametrize(
    ("low", "high", "across"),
    [
        ((2.0, 1.0), (3.0, 1.9), True), ((1.0, 2.0), (1.9, 3.0), False), ((-3.0, 1.0), (-2.0, 1.5), True),
        ((-1.0, 0.1), (3.0, 0.2), False), ((2.0, -1.0), (3.0, 1.0), True), ((1.0, 1.5), (5.0, 2.0), False),
        ((1.0, 0.9), (1.0, 5.0), True), ((-1.0, -1.0), (1.0, 1.0), False), ((-2.0, -3.0), (-1.0, -0.5), True),
    ],
)  # fmt: skip
def test_lines_go_across_if_their_least_is_more_than_that_down(low, high, across: bool) -> None:
    """A direction that may be either way has a least of zero."""
    assert _across((np.array(low), np.array(high))) == across


def captured(monkeypatch: pytest.MonkeyPatch, ends: Any, relief: float = 40.0, bend: float = 1e-4) -> Any:
    seen: list[Any] = []
    monkeypatch.setattr(visibility.kernel, "find_bounds", lambda course, *more: seen.append(course))
    heights, tops = HEIGHTS[:5, :6], np.zeros((4, 5))
    above, below = _bounds(heights, tops, 99.0, tuple(map(np.array, ends)), relief, bend)
    assert above.shape == below.shape == (4, 5)
    if not seen:
        assert (above == 99.0).all()
        assert (below == -np.inf).all()
    return seen[0] if seen else None


@pytest.mark.parametrize("down", [1.0, -1.0])
def test_bounds_are_those_of_lines_that_go_one_way_down_the_rows(monkeypatch, down: float) -> None:
    """Across -0.2 to 0.3 samples and down 2 to 4 samples per metre: -0.1 to 0.15 samples aside per row."""
    ends = ((-0.2, 2.0), (0.3, 4.0)) if down > 0 else ((-0.2, -4.0), (0.3, -2.0))
    course = captured(monkeypatch, ends)
    assert course[0] == down
    np.testing.assert_allclose(course[1:5], [0.25, 0.5, 0.025, 0.125])
    assert course[5] == pytest.approx(1e-4 * 1600 + 1e-3)
    assert course[6] == 160


@pytest.mark.parametrize("ends", [((0.0, -1.0), (0.1, 1.0)), ((0.0, 0.0), (0.1, 1.0)), ((-2.0, 1.0), (2.0, 3.0))])
def test_only_the_highest_terrain_bounds_lines_that_go_many_ways(monkeypatch, ends) -> None:
    assert captured(monkeypatch, ends) is None


def test_the_terrain_has_all_that_a_line_can_meet_until_it_is_above_all() -> None:
    made, ends = look(), (np.array([0.5, -0.25]), np.array([1.0, -0.5]))
    assert made._highest == HEIGHTS.max()
    places = np.array([[60.0, 100.0], [70.0, 110.0]])
    rise = HEIGHTS.max() - HEIGHTS[100:111, 60:71].min()
    terrain = made._terrain(places, ends, math.inf)
    assert terrain is not None
    left, top, right, bottom = terrain.window
    assert terrain.heights.shape == (bottom - top, right - left)
    np.testing.assert_array_equal(terrain.heights, HEIGHTS[top:bottom, left:right])
    assert (terrain.low, terrain.high) == (terrain.heights.min(), terrain.heights.max())
    assert left <= 60
    assert bottom - 1 >= 110
    assert right - 1 >= 70 + rise * 1.0
    assert top <= 100 - rise * 0.5
    assert right <= 70 + 41 * 1.0 + 8, "and hardly more"
    assert not terrain.void
    size = (right - left) * (bottom - top)
    assert made._terrain(places, ends, size) is not None
    assert made._terrain(places, ends, size - 1) is None
    assert made._terrain(places, (np.zeros(2), np.zeros(2)), size - 1) is not None


def test_higher_terrain_beyond_the_ortho_counts_as_far_as_lines_below_it_go(monkeypatch) -> None:
    """Nodes end at sample 192, and lines go a sample in 4 m: 40 m, the range that is stated, lead to sample 202."""
    heights = np.full((200, 220), 100.0)
    heights[40:60, 214] = 290.0
    assert look(heights, (0.5, 0.0))._highest == 290.0, "a small DEM is looked at as a whole"
    monkeypatch.setattr(visibility, "_SMALL", 40_000)
    assert look(heights, (0.5, 0.0))._highest == 100.0
    # A wall of 90 m leads to sample 214.
    heights[40:60, 199] = 190.0
    assert look(heights, (0.5, 0.0))._highest == 290.0
    assert look(np.full_like(heights, np.nan), (2.0, 0.0))._highest == -np.inf


def test_a_pit_and_a_height_for_voids_do_not_make_other_parts_look_farther() -> None:
    """What lines can meet begins at the lowest ground of their own places."""
    heights = HEIGHTS.copy()
    heights[5, 5] = -2000.0
    flat, places = (np.array([0.5, -0.25]), np.array([1.0, -0.5])), np.array([[60.0, 100.0], [70.0, 110.0]])
    one, other = (look(each)._terrain(places, flat, math.inf) for each in (HEIGHTS, heights))
    assert one is not None
    assert other is not None
    assert one.window == other.window


def test_a_dem_that_cannot_be_read_is_no_flat_ground(monkeypatch) -> None:
    def damaged(*where: int) -> None:
        raise InputError("the heights cannot be read")

    monkeypatch.setattr("ortho_pipeline.surface.dem.DemSurface.range_within", damaged)
    with pytest.raises(InputError, match="cannot be read"):
        look()


def test_terrain_with_a_void_or_places_beyond_it_is_told() -> None:
    flat = (np.zeros(2), np.zeros(2))
    heights = HEIGHTS.copy()
    heights[104, 64] = np.nan
    places = np.array([[60.0, 100.0], [70.0, 110.0]])
    for made, void in ((look(heights), True), (look(), False)):
        terrain = made._terrain(places, flat, math.inf)
        assert terrain is not None
        assert terrain.void == void
    edge = look()._terrain(np.array([[0.0, 0.0], [219.0, 199.0]]), flat, math.inf)
    assert edge is not None
    outside = look()._terrain(np.array([[-5.0, 3.0], [10.0, 10.0]]), flat, math.inf)
    assert outside is not None
    assert outside.void
    nowhere = look()._terrain(np.array([[-500.0, 3.0], [-490.0, 10.0]]), flat, math.inf)
    assert nowhere is not None
    assert nowhere.high < nowhere.low
    assert nowhere.void


def test_a_part_without_any_height_is_void() -> None:
    made = look(np.full_like(HEIGHTS, np.nan))
    assert (made.look(0, 0, 60, 50) == visibility.kernel.VOID).all()
    steep = look(np.where(np.arange(220) == 60, 140.0, 100.0) * np.ones((200, 1)), way=(2.0, 0.0))
    seen = steep.look(0, 0, 200, 100)
    # A wall of 40 m at sample 60 (pixel 120) hides what is less than 40 samples (80 pixels) to the west of it.
    assert (seen[:, 45:115] == visibility.kernel.HIDDEN).all()
    assert (seen[:, :38] == visibility.kernel.CLEAR).all()
    assert (seen[:, 125:] == visibility.kernel.CLEAR).all()
