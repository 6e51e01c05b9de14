"""The parts of the march along lines of sight, run as plain Python, against dense sampling and by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from ortho_pipeline.surface.ray_kernel import climbs
from ortho_pipeline.warp.quality import visibility_kernel as kernel
from ortho_pipeline.warp.quality.visibility_kernel import CLEAR, HIDDEN, VOID, Course, Rays, Relief

ROWS, COLUMNS = 19, 21
NAN, INF = np.nan, np.inf


@pytest.fixture(autouse=True)
def plain(interpreted):
    interpreted(kernel)


def spikes(seed: int = 1, void: bool = False) -> np.ndarray:
    random = np.random.default_rng(seed)
    heights = random.uniform(0, 3, (ROWS, COLUMNS))
    heights[tuple(random.integers(1, ROWS - 1, (2, 7)))] += 40
    if void:
        heights[4, 5] = NAN
    return heights


def excess(heights, x, y, h, across, down, bend=0.0, steps=4001) -> np.ndarray:
    """How far terrain rises above a line, by dense sampling; -inf outside and next to voids."""
    rise = np.linspace(0.0, 60.0, steps)
    u, v = x + across * rise, y + down * rise
    inside = (u >= 0) & (v >= 0) & (u <= heights.shape[1] - 1) & (v <= heights.shape[0] - 1)
    terrain = map_coordinates(heights, [v, u], order=1, mode="nearest")
    return np.where(inside & np.isfinite(terrain), terrain - (h + rise + bend * rise**2), -INF)


def steep_of(heights, low, high, void=False):
    tops = np.empty((heights.shape[0] - 1, heights.shape[1] - 1))
    squares = np.empty((-(-tops.shape[0] // 8), -(-tops.shape[1] // 8)))
    highest = kernel.find_steep(heights, void, np.asarray(low), np.asarray(high), tops, squares)
    return tops, squares, highest


# -- heights and cells -----------------------------------------------------------------------------------------------


def test_extremes_leave_voids_out():
    assert kernel.extremes(np.array([[3.0, NAN], [-2.0, 7.0]])) == (-2.0, 7.0, 1)
    assert kernel.extremes(np.array([[NAN, NAN]])) == (INF, -INF, 2)


def test_steep_cells_climb_by_more_than_the_line():
    """A line of 0.5 samples to the right per metre rises by 2 m per sample."""
    heights = np.array([[0.0, 2.0, 4.001, 0.0], [0.0, 2.0, 4.0, 0.0]])
    way = np.array([0.5, 0.0])
    assert [bool(climbs(heights, 0, i, way, way)) for i in range(3)] == [False, True, False]
    assert [bool(climbs(heights, 0, i, -way, -way)) for i in range(3)] == [False, False, True]
    assert [bool(climbs(heights, 0, i, -way, way)) for i in range(3)] == [False, True, True]
    assert [bool(climbs(heights.T, i, 0, way[::-1], way[::-1])) for i in range(3)] == [False, True, False]
    for part, steep in ((heights[:, :2], False), (heights, True), (heights[:, 1:3], True), (heights[:, :1], False)):
        assert bool(kernel.is_steep(part, way, way)) == steep
    assert kernel.is_steep(np.vstack([np.zeros((5, 2)), [[0, 3]]]), way, way)


@pytest.mark.parametrize("void", [False, True])
def test_tops_are_the_highest_corners_of_steep_cells_and_of_those_next_to_voids(void):
    heights = spikes(void=True)
    heights[0, 20] = heights[18, 0] = NAN
    low, high = np.array([-0.1, 0.1]), np.array([0.0, 0.2])
    tops, squares, highest = steep_of(heights, low, high, void)
    finite = np.isfinite(heights)
    expected = np.full(tops.shape, -INF)
    for j, i in np.ndindex(tops.shape):
        cell = heights[j : j + 2, i : i + 2]
        beside = void and not finite[max(j - 1, 0) : j + 3, max(i - 1, 0) : i + 3].all()
        if np.isfinite(cell).all() and (climbs(heights, j, i, low, high) or beside):
            expected[j, i] = cell.max()
    np.testing.assert_array_equal(tops, expected)
    assert highest == expected.max()
    blocks = [[expected[j : j + 8, i : i + 8].max() for i in (0, 8, 16)] for j in (0, 8, 16)]
    np.testing.assert_array_equal(squares, blocks)


def test_the_highest_corner_may_be_any():
    for corner in range(4):
        heights = np.zeros((2, 2))
        heights[corner // 2, corner % 2] = 9.0
        tops, _, highest = steep_of(heights, [-1.0, -1.0], [1.0, 1.0])
        assert tops[0, 0] == highest == 9.0
    assert steep_of(np.zeros((2, 2)), [-1.0, -1.0], [1.0, 1.0])[2] == -INF


def test_known_cells_are_wholly_above_or_below_the_bounds():
    heights = np.array([[1.0, 2.0, NAN, 0.0], [3.0, 1.5, 0.0, 0.0]])
    found = np.empty((1, 3), dtype=np.uint8)
    for above, below, expected in ((1.0, -9.0, CLEAR), (1.1, -9.0, VOID), (9.0, 3.0, HIDDEN), (9.0, 2.9, VOID)):
        kernel.find_known(heights, np.full((1, 3), above), np.full((1, 3), below), found)
        np.testing.assert_array_equal(found, [[expected, VOID, VOID]])


# -- bounds ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("forward", [1, -1])
@pytest.mark.parametrize("aside", [0.0, 1.0])
def test_bounds_of_one_top_by_hand(forward, aside):
    """A line is in the row of the top, d rows on, after d - 1 rows at least; its column is one of 2 pad + 1."""
    tops = np.full((12, 13), -INF)
    tops[6, 7] = 50.0
    above, below = np.empty(tops.shape), np.empty(tops.shape)
    course = Course(forward, 2.0, 3.0, aside, 0.0, 0.5, 20.0)
    kernel.find_bounds(course, np.zeros((13, 14)), tops, above, below)
    expected, pad = np.full(tops.shape, -INF), 1 + int(aside)
    for d in range(7 if forward > 0 else 6):
        middle = 7 - int(aside) * d
        expected[6 - forward * d, max(middle - pad, 0) : max(middle + pad + 1, 0)] = 50.0 - 2.0 * max(d - 1, 0)
    np.testing.assert_allclose(above, expected)


def test_neighbours_are_taken_in_each_time_directions_have_come_to_be_a_column_apart():
    tops = np.full((12, 23), -INF)
    tops[6, 11] = 50.0
    above, below = np.empty(tops.shape), np.empty(tops.shape)
    kernel.find_bounds(Course(1, 2.0, 3.0, 0.0, 0.5, 0.5, 20.0), np.zeros((13, 24)), tops, above, below)
    # Half a column per row: 1 for rounding, 1 and twice 0.5 for the spread, and one more after every second row.
    for row, pad in ((6, 3), (5, 4), (4, 4), (3, 5), (2, 5), (1, 6), (0, 6)):
        np.testing.assert_array_equal(np.flatnonzero(above[row] > -INF), np.arange(11 - pad, 12 + pad))
    kernel.find_bounds(Course(1, 2.0, 3.0, 0.0, 0.04, 0.5, 20.0), np.zeros((13, 24)), tops, above, below)
    assert [int((row > -INF).sum()) for row in above[:7]] == [5] * 7
    # A tenth per row comes to a column after ten rows from the last one.
    kernel.find_bounds(Course(1, 2.0, 3.0, 0.0, 0.1, 0.5, 20.0), np.zeros((13, 24)), tops, above, below)
    assert [int((row > -INF).sum()) for row in above[:7]] == [9, 9, 7, 7, 7, 7, 7]


def test_neighbours_are_the_next_on_both_sides():
    high, low = np.array([5.0, 1.0, 2.0, 3.0, 9.0, 0.0]), np.array([5.0, 7.0, 8.0, 6.0, 9.0, 9.0])
    kernel._take_in_neighbours(high, low, np.empty(6))
    np.testing.assert_array_equal(high, [5, 5, 3, 9, 9, 9])
    np.testing.assert_array_equal(low, [5, 5, 6, 6, 6, 9])


@pytest.mark.parametrize("forward", [1, -1])
def test_lines_meet_a_ridge_that_they_cross_below(forward):
    """A line leaves the ridge's row, d rows on, after d + 1 rows at most; a void is no ridge."""
    heights = np.zeros((13, 14))
    heights[6:8] = 50.0
    heights[6, 9] = NAN
    tops = np.where(np.arange(12)[:, None] == 6, 50.0, -INF) * np.ones((1, 13))
    above, below = np.empty(tops.shape), np.empty(tops.shape)
    kernel.find_bounds(Course(forward, 2.0, 3.0, 0.0, 0.0, 0.5, 20.0), heights, tops, above, below)
    for d in range(1, 6):
        expected = np.full(13, max(50.0 - 3.0 * (d + 1), -6.0 if d > 1 else -INF) - 0.5)
        expected[[0, 12, 7, 8, 9, 10]] = -INF
        found = below[6 - forward * d]
        np.testing.assert_allclose(found[[1, 2, 3, 4, 5, 6, 11]], expected[1])
        assert (found[[0, 12]] == -INF).all()
        assert (found[7:11] < 0).all()


@pytest.mark.parametrize("forward", [1, -1])
@pytest.mark.parametrize(("aside", "spread"), [(0.0, 0.0), (0.4, 0.01), (-0.7, 0.02), (0.3, 0.25), (-1.2, 0.4)])
def test_bounds_hold_for_all_lines_of_their_cells(forward, aside, spread):
    heights = spikes(3)
    heights[9:12, 2:16] = 45.0
    least, most = 3.0, 4.0
    tops = np.full((ROWS - 1, COLUMNS - 1), -INF)
    for j, i in np.ndindex(tops.shape):
        if np.ptp(cell := heights[j : j + 2, i : i + 2]) > 2.9 or cell.min() > 40:
            tops[j, i] = cell.max()
    above, below = np.empty(tops.shape), np.empty(tops.shape)
    kernel.find_bounds(Course(forward, least, most, aside, spread, 0.0, 16.0), heights, tops, above, below)
    random = np.random.default_rng(0)
    blocked = np.where(tops > -INF, 1.0, 0.0)
    met = 0
    for j, i in np.ndindex(tops.shape):
        x, y = i + random.choice([0.001, 0.999]), j + random.choice([0.001, 0.999])
        down = forward / random.choice([least, most])
        across = (aside + random.choice([-spread, spread])) * abs(down)
        rise = np.linspace(0.0, 80.0, 1601)
        column, row = (x + across * rise).astype(int), (y + down * rise).astype(int)
        there = (x + across * rise >= 0) & (y + down * rise >= 0) & (column < COLUMNS - 1) & (row < ROWS - 1)
        steep = np.zeros(len(rise), dtype=bool)
        steep[there] = blocked[row[there], column[there]] > 0
        start = max(above[j, i], -100.0)
        assert not (tops[row[there & steep], column[there & steep]] > start + rise[there & steep] + 1e-9).any()
        if below[j, i] > 0:
            met += 1
            assert excess(heights, x, y, below[j, i], across, down).max() > 0
    assert met > 20 or abs(aside) > 1


# -- lines -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("across", [0.0, 0.31, -0.27])
@pytest.mark.parametrize("down", [0.0, 0.22, -0.35])
def test_lines_are_hidden_where_dense_sampling_finds_terrain_above_them(across, down):
    heights, bend = spikes(), 0.003
    way = np.array([across, down])
    random = np.random.default_rng(5)
    found, expected = [], []
    steep = steep_of(heights, way, way)[:2]
    everything = np.full(steep[0].shape, heights.max()), np.full(steep[0].shape, -INF)
    for _ in range(60):
        x, y = random.uniform(0, COLUMNS - 1), random.uniform(0, ROWS - 1)
        h = float(map_coordinates(heights, [[y], [x]], order=1)[0])
        over = excess(heights, x, y, h, across, down, bend)[1:].max()
        if not -1e-2 < over < 1e-2:
            expected.append(over > 0)
            found.append(
                kernel._is_hidden(heights, *steep, *everything, x, y, h, across or 1e-300, down or 1e-300, bend)
            )
    assert len(found) > 10
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("across", "down"), [(-1.0, 1e-300), (1.0, 1e-300), (1e-300, -1.0), (1e-300, 1.0)])
def test_terrain_in_the_outermost_cells_hides(across, down):
    heights = np.zeros((9, 9))
    heights[[0, -1]] = heights[:, [0, -1]] = 40.0
    way = np.array([across, down])
    steep = steep_of(heights, way, way)[:2]
    everything = np.full(steep[0].shape, heights.max()), np.full(steep[0].shape, -INF)
    # The line has risen by 4 m at the edge; from 38 m it is above all.
    for h, expected in ((1.0, True), (38.0, False)):
        assert kernel._is_hidden(heights, *steep, *everything, 4.0, 4.0, h, across, down, 0.0) == expected


def test_a_line_ends_where_the_bounds_tell_what_it_meets():
    heights = np.zeros((4, 12))
    tops, squares = np.full((3, 11), 9.0), np.full((1, 2), 9.0)
    for h, expected in ((0.0, True), (3.9, True), (4.1, False)):
        above, below = np.full((3, 11), INF), np.full((3, 11), -INF)
        above[:, 6], below[:, 6] = h + 5.4, 9.4  # the line has risen by 5.5 m there
        found = kernel._is_hidden(heights, tops, squares, above, below, 0.5, 1.5, h, 1.0, 1e-12, 0.0)
        assert found == expected


def test_terrain_between_the_ends_of_a_cell_may_rise_above_a_line():
    """Along the diagonal of this cell terrain is 40 s (1 - s), 10 m in the middle, the line at h + 2 s."""
    heights = np.array([[0.0, 20.0], [20.0, 0.0]])
    for h, expected in ((9.02, True), (9.04, False)):  # it is above up to 38^2 / 160 = 9.025
        assert kernel._rises_above(heights, 0, 0, 0.0, 0.0, h, 0.5, 0.5, 0.0, 0.0, 2.0) == expected
    # From the middle on it falls; what counts is where the part begins.
    assert kernel._rises_above(heights, 0, 0, 0.0, 0.0, 8.99, 0.5, 0.5, 0.0, 1.0, 2.0)
    assert not kernel._rises_above(heights, 0, 0, 0.0, 0.0, 9.01, 0.5, 0.5, 0.0, 1.0, 2.0)
    # 6 m per sample against a line that bends upwards: 2 s - s^2 is at most 1 m.
    ramp = np.array([[0.0, 6.0], [0.0, 6.0]])
    assert kernel._rises_above(ramp, 0, 0, 0.0, 0.0, 0.99, 0.5, 0.0, 1.0, 0.0, 2.0)
    assert not kernel._rises_above(ramp, 0, 0, 0.0, 0.0, 1.01, 0.5, 0.0, 1.0, 0.0, 2.0)
    # The Earth falls away below: by 0.1 s^2 metres.
    assert not kernel._rises_above(heights, 0, 0, 0.0, 0.0, 8.91, 0.5, 0.5, 0.1, 1.0, 2.0)
    assert kernel._rises_above(heights, 0, 0, 0.0, 0.0, 8.89, 0.5, 0.5, 0.1, 1.0, 2.0)


def test_heights_in_the_window():
    heights = spikes()[:5, :6]
    for y, x in np.ndindex(9, 11):
        expected = map_coordinates(heights, [[y / 2], [x / 2]], order=1)[0]
        assert kernel._height(heights, x / 2, y / 2) == pytest.approx(expected, abs=1e-9)
    for x, y in ((-1e-9, 1), (1, -1e-9), (5 + 1e-9, 1), (1, 4 + 1e-9)):
        assert np.isnan(kernel._height(heights, x, y))
    heights[2, 3] = NAN
    for x, y, void in (
        (2.0, 2.5, False),
        (2.0, 1.5, False),
        (2.5, 1.0, False),
        (2.5, 2.0, True),
        (3.0, 1.5, True),
        (2.5, 1.5, True),
    ):
        assert np.isnan(kernel._height(heights, x, y)) == void
    heights[3, 4] = NAN  # before the last sample of its row and of its column
    assert np.isnan(kernel._height(heights, 4.5, 3.0))
    assert np.isnan(kernel._height(heights, 4.0, 3.5))
    assert kernel._height(heights, 5.0, 3.0) == heights[3, 5]
    assert kernel._height(heights, 4.0, 4.0) == heights[4, 4]


@pytest.mark.parametrize(
    ("du", "dv", "pixels"),
    [(0.1, 0.0, 6), (-0.1, 0.0, 2), (0.0, 0.1, 3), (0.0, -0.1, 5), (0.1, 0.05, 6), (0.9, 0.0, 0), (0.0, 0.0, 999_999)],
)
def test_pixels_of_a_row_within_a_cell(du, dv, pixels):
    """At 0.3 across the cell and 0.6 down, less one for rounding."""
    assert kernel._pixels_within(4.3, 7.6, 4, 7, du, dv) == pytest.approx(pixels, abs=1e-6)


# -- tiles -----------------------------------------------------------------------------------------------------------


def between(nodes, row, column, spacing):
    at = [[row / spacing], [column / spacing]]
    return [map_coordinates(nodes[..., axis], at, order=1)[0] for axis in range(2)]


@pytest.mark.parametrize("scale", [0.6, 0.09], ids=["narrow", "wide"])
def test_classes_of_a_tile(scale):
    """Nodes every 4 and 8 pixels, a window that begins between them, and directions that change with the height."""
    heights = spikes(2, void=True)
    west, north, near, far, middle, half, bend = 7, -2, 4, 8, 20.0, 25.0, 0.001
    random = np.random.default_rng(3)
    j, i = np.mgrid[0:25:near, 0:33:near]
    origin = (-0.83, 2.13) if scale > 0.5 else (3.1, 3.4)
    places = np.stack([origin[0] + scale * i + 0.05 * j, origin[1] + scale * j + 0.02 * i], axis=2)
    places += random.uniform(0, 0.1, places.shape)
    j, i = np.mgrid[0:25:far, 0:33:far]
    first = np.stack([0.2 + 0.002 * i + 0.001 * j, 0.15 - 0.001 * i + 0.003 * j], axis=2)
    slopes = np.stack([first + random.uniform(-0.03, 0.03, first.shape), np.full_like(first, 0.02)], axis=2)
    ends = np.array([0.1, 0.05]), np.array([0.4, 0.35])
    tops, squares, highest = steep_of(heights, *ends, True)
    above, below = np.full(tops.shape, highest), np.full(tops.shape, -INF)
    known = np.empty(tops.shape, dtype=np.uint8)
    kernel.find_known(heights, above, below, known)
    relief = Relief(heights, west, north, tops, squares, above, below, known, highest)
    found = np.full((15, 21), 9, dtype=np.uint8)
    kernel.look(Rays(np.add(places, (west, north)), near, slopes, far, middle, half, bend), relief, 3, 5, found)
    counts = np.zeros(3, dtype=int)
    for line, column in np.ndindex(found.shape):
        x, y = between(places, line + 3, column + 5, near)
        h = kernel._height(heights, x, y)
        expected = VOID
        if np.isfinite(h):
            across, down = between(slopes[:, :, 0] + 0.02 * (h - middle) / half, line + 3, column + 5, far)
            over = excess(heights, x, y, h, across, down, bend, 1201)[1:].max()
            if -1e-2 < over < 1e-2:
                continue
            expected = HIDDEN if over > 0 else CLEAR
        counts[expected] += 1
        assert found[line, column] == expected, (line, column)
    assert (counts > 2).all()


def test_classes_that_the_bounds_tell_at_once():
    heights = np.full((4, 4), 5.0)
    flat = np.full((3, 3), 99.0)
    places = np.stack(np.meshgrid([0.0, 0.4], [1.5, 1.9]), axis=2)
    rays = Rays(places, 8, np.full((2, 2, 1, 2), 0.1), 8, 0.0, 10.0, 0.0)
    for above, below, expected in ((INF, 5.0, HIDDEN), (5.0, -INF, CLEAR)):
        bounds = np.full((3, 3), above), np.full((3, 3), below)
        for before in (VOID, expected):
            known, found = np.full((3, 3), before, dtype=np.uint8), np.full((2, 8), 9, dtype=np.uint8)
            kernel.look(rays, Relief(heights, 0, 0, flat, np.full((1, 1), 99.0), *bounds, known, 99.0), 0, 0, found)
            assert (found == expected).all()
