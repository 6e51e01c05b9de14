"""The bound on the error of lattices, run as plain Python on a few nodes, against NumPy and by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.warp import lattice_kernel

NAN, INF = np.nan, np.inf


@pytest.fixture(autouse=True)
def plain(interpreted):
    interpreted(lattice_kernel)
    with np.errstate(invalid="ignore"):
        yield


# -- ranges ----------------------------------------------------------------------------------------------------------


def test_extents_of_finite_points():
    points = np.array([[[3, 4], [-1, 9], [NAN, -50], [-50, INF], [2, 1]], [[NAN, 1]] * 5], dtype=float)
    boxes = np.empty((2, 4))
    lattice_kernel.extents(points, boxes)
    np.testing.assert_array_equal(boxes, [[-1, 1, 3, 9], [INF, INF, -INF, -INF]])


def test_ranges_of_heights_in_windows():
    heights = np.random.default_rng(2).normal(size=(5, 6))
    heights[1, 2], heights[3, 4] = NAN, INF
    windows = np.array([[10, 20, 16, 25], [11, 20, 13, 23], [12, 21, 13, 22], [15, 24, 16, 25], [10, 20, 10, 25]])
    found = np.empty((5, 2))
    lattice_kernel.height_ranges(heights, 10, 20, windows, found)
    for (left, top, right, bottom), (low, high) in zip(windows, found, strict=True):
        part = heights[top - 20 : bottom - 20, left - 10 : right - 10]
        part = part[np.isfinite(part)]
        assert (low, high) == ((part.min(), part.max()) if part.size else (INF, -INF))


# -- cells -----------------------------------------------------------------------------------------------------------


def shown(left, top, right, bottom, unknown=False):
    """Whether a cell with these sides may show some of an image of 100 x 80 pixels."""
    image = np.array([[[left, top], [right, top]], [[left, bottom], [right, bottom]]], dtype=float)[None, :, :, None]
    cells, area = np.empty((1, 1, 1), dtype=bool), np.empty((1, 4))
    lattice_kernel.visible(image, 100.0, 80.0, np.array([unknown]), cells, area)
    np.testing.assert_array_equal(area[0], [0, 1, 0, 1] if cells[0, 0, 0] else [0, 0, 0, 0])
    return bool(cells[0, 0, 0])


def test_cells_are_visible_up_to_half_of_their_size_or_four_pixels_beside_the_image():
    for apart, near in ((4.0, True), (4.01, False)):
        assert shown(100 + apart, 10, 102 + apart, 12) == near
        assert shown(-2 - apart, 10, -apart, 12) == near
        assert shown(10, 80 + apart, 12, 82 + apart) == near
        assert shown(10, -2 - apart, 12, -apart) == near
    for apart, near in ((15.0, True), (15.1, False)):
        assert shown(100 + apart, 10, 130 + apart, 12) == near
        assert shown(-30 - apart, 10, -apart, 12) == near
        assert shown(10, 80 + apart, 12, 110 + apart) == near
        assert shown(10, -30 - apart, 12, -apart) == near


def test_cells_that_the_model_does_not_project_are_visible_where_that_is_unknown():
    assert shown(NAN, 10, 20, 30, unknown=True)
    assert not shown(NAN, 10, 20, 30, unknown=False)
    assert not shown(10, 10, 20, INF, unknown=False)
    assert not shown(500, 10, 520, 30, unknown=True)


def test_the_area_is_that_of_the_visible_cells():
    """Every level and every corner counts."""
    for level in range(2):
        for corner in range(4):
            image = np.full((2, 6, 6, 2, 2), 1000.0)
            image[1, 2 + corner // 2, 1 + corner % 2, level] = 50.0
            image[1, 3, 3, 1] = 50.0
            cells, area = np.empty((2, 5, 5), dtype=bool), np.empty((2, 4))
            lattice_kernel.visible(image, 100.0, 80.0, np.array([False, False]), cells, area)
            expected = np.zeros((5, 5), dtype=bool)
            for row, column in ((2 + corner // 2, 1 + corner % 2), (3, 3)):
                expected[row - 1 : row + 1, column - 1 : column + 1] = True
            np.testing.assert_array_equal(cells[1], expected)
            assert not cells[0].any()
            rows, columns = np.nonzero(expected)
            np.testing.assert_array_equal(area[0], 0)
            np.testing.assert_array_equal(area[1], [rows.min(), rows.max() + 1, columns.min(), columns.max() + 1])


# -- second differences ----------------------------------------------------------------------------------------------


def used_nodes(cells, axis):
    """Nodes ``(n, n)`` whose second difference along an axis counts, next to visible cells and of the next one on."""
    cells = cells if axis else cells.T
    nodes = np.zeros((len(cells) + 1,) * 2, dtype=bool)
    for j, i in np.argwhere(cells):
        nodes[j : j + 2, max(i - 1, 1) : min(i + 2, len(cells) - 1) + 1] = True
    return nodes if axis else nodes.T


def bend(values, cells):
    """Bound on the error of bilinear interpolation between nodes ``(n, n, 2)``, by its description."""
    worst = 0.0
    for axis in (1, 0):
        used = used_nodes(cells, axis)
        second = np.full(values.shape, NAN)
        inner = (slice(None), slice(1, -1)) if axis else (slice(1, -1), slice(None))
        second[inner] = np.diff(values, 2, axis=axis)
        second[~used] = NAN
        steps = [np.hypot(*np.moveaxis(np.diff(second, axis=way), 2, 0)) for way in (0, 1)]
        worst += np.nanmax(np.hypot(*np.moveaxis(second, 2, 0))) / 8 + max(np.nanmax(step) for step in steps)
    return worst


@pytest.mark.parametrize("places", [[(0, 0)], [(4, 4)], [(0, 4), (2, 1)], [(2, 2)], [(3, 0), (3, 4)]])
def test_second_differences_of_visible_cells_and_the_next_ones(places):
    cells = np.zeros((5, 5), dtype=bool)
    cells[tuple(np.transpose(places))] = True
    along, across = np.ones((6, 6), dtype=bool), np.ones((6, 6), dtype=bool)
    assert lattice_kernel._mark(cells, along, across)
    np.testing.assert_array_equal(along, used_nodes(cells, 1))
    np.testing.assert_array_equal(across, used_nodes(cells, 0))
    for seed in range(5):
        nodes = np.random.default_rng(seed).normal(size=(6, 6, 2, 2)) ** 3
        for level in range(2):
            found = lattice_kernel._bent(nodes, level, along, across)
            assert found == pytest.approx(bend(nodes[:, :, level], cells))


def test_no_cell_is_visible():
    along, across = np.ones((6, 6), dtype=bool), np.ones((6, 6), dtype=bool)
    assert not lattice_kernel._mark(np.zeros((5, 5), dtype=bool), along, across)
    assert not along.any()
    assert not across.any()


def test_a_missing_node_makes_the_bound_infinite():
    cells = np.zeros((5, 5), dtype=bool)
    cells[2, 2] = True
    along, across = used_nodes(cells, 1), used_nodes(cells, 0)
    for j, i in np.ndindex(6, 6):
        nodes = np.zeros((6, 6, 1, 2))
        nodes[j, i] = NAN
        needed = 2 <= j <= 3 or 2 <= i <= 3
        assert lattice_kernel._bent(nodes, 0, along, across) == (INF if needed else 0.0)


def test_the_worse_of_two():
    assert lattice_kernel._worse(1.0, 2.0) == lattice_kernel._worse(2.0, 1.0) == 2.0
    assert lattice_kernel._worse(1.0, NAN) == lattice_kernel._worse(1.0, INF) == INF


def test_paths_over_the_heights_and_steps_between_nodes_are_those_of_all_corners_of_visible_cells():
    image = np.random.default_rng(3).normal(size=(4, 4, 3, 2))
    for cell in np.ndindex(3, 3):
        cells = np.zeros((3, 3), dtype=bool)
        cells[cell] = True
        nodes = image[cell[0] : cell[0] + 2, cell[1] : cell[1] + 2]
        path = np.linalg.norm(np.diff(nodes, axis=2), axis=-1).sum(axis=-1).max()
        step = max(np.linalg.norm(np.diff(nodes, axis=axis), axis=-1).max() for axis in (0, 1))
        assert lattice_kernel._reach(image, cells) == pytest.approx((path, step))
    assert lattice_kernel._reach(image, np.zeros((3, 3), dtype=bool)) == (0.0, 0.0)


def test_a_corner_without_a_projection_has_no_bound():
    image = np.zeros((4, 4, 2, 2))
    image[2, 3, 1] = NAN
    cells = np.zeros((3, 3), dtype=bool)
    cells[1, 2] = True
    assert lattice_kernel._reach(image, cells) == (INF, INF)


def test_second_differences_foretell_parabolas_exactly():
    """At the rim too, which has the second differences of the next node."""
    j, i = np.mgrid[0:5.0, 0:5.0]

    def parabola(y, x):
        return 3 + 2 * x - y + 0.7 * x * y + 1.3 * x**2 - 0.4 * y**2

    for y, x in ((0, 0), (0, 3), (3, 0), (3, 3), (1, 2)):
        for fy, fx in ((0.0, 0.0), (0.3, 0.0), (0.0, 0.6), (0.3, 0.6), (1.0, 1.0)):
            found = lattice_kernel._bowed(parabola(j, i), y, x, fx, fy)
            assert found == pytest.approx(parabola(y + fy, x + fx))


def test_nodes_at_the_rim_have_the_bow_of_the_next_ones():
    nodes = np.random.default_rng(1).normal(size=(5, 5))
    across = np.pad(np.diff(nodes, 2, axis=1), ((0, 0), (1, 1)), mode="edge")
    down = np.pad(np.diff(nodes, 2, axis=0), ((1, 1), (0, 0)), mode="edge")
    fx, fy = 0.3, 0.6
    bowed = nodes - (fx * (1 - fx) * across + fy * (1 - fy) * down) / 2
    for j, i in np.ndindex(4, 4):
        expected = [1 - fy, fy] @ bowed[j : j + 2, i : i + 2] @ [1 - fx, fx]
        assert lattice_kernel._bowed(nodes, j, i, fx, fy) == pytest.approx(expected)


# -- the whole bound -------------------------------------------------------------------------------------------------

SPACING = 4


def scene(rows, columns, t):
    """Image and DEM coordinates of offsets in nodes and normalised heights, parabolas all."""
    column = 5 + 3 * columns + (0.2 + 0.1 * t) * columns**2 - 2 * t + 0.5 * t**2
    row = 7 - 4 * rows + 0.1 * rows**2 + 0.1 * rows * columns - t
    image = np.stack(np.broadcast_arrays(column, row), axis=-1)
    return image, np.stack([2 * columns + 0.05 * rows**2, 3 * rows + 0 * columns], axis=-1)


def bounded(points, off=0.0, off_dem=0.0, hidden=()):
    """The bound, the part of second differences, and the largest step, of a block of 4 x 4 cells that is off."""
    j, i = np.mgrid[0:5.0, 0:5.0]
    levels = np.array([-1.0, 0.0, 1.0])
    image, _ = scene(j[..., None], i[..., None], levels)
    coefficients = np.linalg.solve(np.vander(levels, increasing=True), image)
    dem = scene(j, i, 0.0)[1]
    cells = np.ones((1, 4, 4), dtype=bool)
    for cell in hidden:
        cells[(0, *cell)] = False
    points = np.array(points, dtype=float)
    exact, exact_dem = scene(points[:, 1] / SPACING, points[:, 0] / SPACING, points[:, 2])
    exact, exact_dem = exact + off, exact_dem + off_dem
    out = np.full((3, 1), 99.0)
    lattice_kernel.bounds(
        image[None], coefficients[None], dem[None], cells, SPACING, points[None], exact[None], exact_dem[None], *out
    )
    return out[:, 0]


POINTS = [(1.0, 2.0, 0.3), (13.0, 6.5, -0.8), (15.0, 15.0, 1.0)]
#: Parallax of a node over the heights, at most, in the first column: (2.5, 1) px below the middle, (1.5, 1) above it.
PARALLAX = np.hypot(1.5, 1) + np.hypot(2.5, 1)
#: An eighth of the second differences: 0.6 px along at the top, 0.2 down; 0.1 samples down in the DEM.
BENT = (0.6 + 0.2) / 8 + PARALLAX * 0.1 / 8


def test_a_parabola_is_off_by_an_eighth_of_its_second_differences():
    error, apart, step = bounded(POINTS)
    assert error == pytest.approx(BENT)
    assert apart == pytest.approx(BENT)
    # From node (4, 3) to (4, 4) at the top: 5.1 columns and 0.4 rows.
    assert step == pytest.approx(np.hypot(3 + 0.3 * 7, 0.4))


def test_what_check_points_find_counts_three_times():
    off = np.zeros((3, 2))
    off[1] = 3.0, -4.0
    off_dem = np.zeros((3, 2))
    off_dem[2] = 0.1, -0.2
    assert bounded(POINTS, off)[0] == pytest.approx(BENT + 3 * 5.0)
    assert bounded(POINTS, off)[1] == pytest.approx(BENT)
    assert bounded(POINTS, 0.0, off_dem)[0] == pytest.approx(BENT + 3 * 0.3 * PARALLAX)
    off[1] = NAN
    assert bounded(POINTS, off)[0] == INF


def test_check_points_in_cells_that_are_not_visible_do_not_count():
    off = np.zeros((3, 2))
    off[1] = 3.0, -4.0
    assert bounded(POINTS, off, hidden=[(1, 3)])[0] == pytest.approx(BENT)
    assert bounded(POINTS, off, hidden=[(3, 1)])[0] == pytest.approx(BENT + 3 * 5.0)


def test_a_node_that_the_model_does_not_project_makes_the_bound_infinite():
    image, dem = np.zeros((1, 3, 3, 2, 2)), np.zeros((1, 3, 3, 2))
    image[0, 1, 1, 1] = NAN
    points, exact = np.zeros((1, 1, 3)), np.zeros((1, 1, 2))
    out = np.zeros((3, 1))
    lattice_kernel.bounds(image, image, dem, np.ones((1, 2, 2), dtype=bool), 4, points, exact, exact, *out)
    assert out[0, 0] == INF


def test_nothing_is_visible_in_a_block():
    assert bounded(POINTS, NAN, hidden=list(np.ndindex(4, 4))).tolist() == [0.0, 0.0, 0.0]
