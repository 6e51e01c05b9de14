"""The parts of the warp's loop, run as plain Python on small arrays, against NumPy and SciPy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from ortho_pipeline.warp import resampling_kernel, tile_kernel
from ortho_pipeline.warp.resampling_kernel import Resampling, SourceWindow
from ortho_pipeline.warp.tile_kernel import DemWindow, Lattice, OutputWindow

#: Place of the first DEM sample.
LEFT, TOP = 5, -3
HEIGHTS = np.random.default_rng(8).normal(0, 30, (6, 7))


@pytest.fixture(autouse=True)
def plain(interpreted):
    interpreted(tile_kernel, resampling_kernel)
    with np.errstate(over="ignore"):  # unsigned places go round below zero
        yield


def keys(apart):
    """Keys' cubic kernel by its definition."""
    s = np.abs(apart)
    near, far = 1.5 * s**3 - 2.5 * s**2 + 1, -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2
    return np.where(s <= 1, near, np.where(s < 2, far, 0.0))


def height(heights, x, y, cubic):
    """Height at a place in the window: cubic where all 16 neighbours are there, bilinear elsewhere."""
    rows, columns = heights.shape
    if not (0 <= x <= columns - 1 and 0 <= y <= rows - 1):
        return np.nan
    if cubic and 1 <= x < columns - 2 and 1 <= y < rows - 2:
        return keys(y - np.arange(rows)) @ heights @ keys(x - np.arange(columns))
    return float(map_coordinates(heights, [[y], [x]], order=1)[0])


@pytest.mark.parametrize("cubic", [False, True])
def test_heights_between_samples(cubic):
    y, x = np.mgrid[0:5.01:0.25, 0:6.01:0.25]
    found = np.empty(x.shape)
    tile_kernel.heights_at(np.stack([x + LEFT, y + TOP], axis=2), DemWindow(HEIGHTS, LEFT, TOP, cubic), found)
    expected = [
        [height(HEIGHTS, *place, cubic) for place in zip(*line, strict=True)] for line in zip(x, y, strict=True)
    ]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_there_are_no_heights_outside_of_the_samples():
    for x, y in ((-1e-9, 1), (6 + 1e-9, 1), (1, -1e-9), (1, 5 + 1e-9)):
        assert np.isnan(tile_kernel.dem_height_at(HEIGHTS, x + LEFT, y + TOP, LEFT, TOP, False))


def test_a_void_counts_only_where_it_has_weight():
    for (row, column), fx, fy in itertools.product(itertools.product((2, 3), repeat=2), (0.0, 0.5), (0.0, 0.5)):
        heights = np.ones((6, 7))
        heights[row, column] = np.nan
        weight = (fx if column == 3 else 1 - fx) * (fy if row == 3 else 1 - fy)
        found = tile_kernel.dem_height_at(heights, 2 + fx + LEFT, 2 + fy + TOP, LEFT, TOP, False)
        np.testing.assert_equal(found, np.nan if weight else 1.0)


@pytest.mark.parametrize("cubic", [False, True])
def test_a_void_before_the_last_sample_has_no_weight_there(cubic):
    heights = HEIGHTS.copy()
    heights[4, 5] = np.nan
    for column, row in ((6.0, 4.0), (5.0, 5.0), (6.0, 5.0)):
        found = tile_kernel.dem_height_at(heights, column + LEFT, row + TOP, LEFT, TOP, cubic)
        assert found == heights[int(row), int(column)]
    assert np.isnan(tile_kernel.dem_height_at(heights, 5.5 + LEFT, 4 + TOP, LEFT, TOP, cubic))


@pytest.mark.parametrize("place", [(0, 0), (0, 3), (3, 0), (3, 3), (1, 3)])
def test_cubic_heights_next_to_a_void_are_bilinear(place):
    heights = HEIGHTS[:4, :4].copy()
    heights[place] = np.nan
    found = tile_kernel.dem_height_at(heights, 1.25, 1.5, 0, 0, True)
    assert found == pytest.approx(height(np.nan_to_num(heights), 1.25, 1.5, False), abs=1e-9)


# -- coordinates -----------------------------------------------------------------------------------------------------

SPACING, CELLS = 4, 2


def lattice(levels: int, u: tuple[float, float], v: tuple[float, float], spacing: int = SPACING) -> Lattice:
    """A lattice of two by two cells over the DEM from `u[0]`, `v[0]` in its window, `u[1]` and `v[1]` samples wide."""
    random = np.random.default_rng(levels)
    steps = np.linspace(0, 1, CELLS + 1)
    across, down = np.meshgrid(u[0] + u[1] * steps + LEFT, v[0] + v[1] * steps + TOP)
    dem = np.stack([across, down], axis=2) + random.uniform(0, 0.05, (CELLS + 1, CELLS + 1, 2))
    return Lattice(spacing, random.normal(0, 9, (CELLS + 1, CELLS + 1, levels, 2)), dem, 5.0, 40.0)


def coordinates(lattice, cubic, row, columns, heights=HEIGHTS):
    """What `block_coordinates` has to find ``(n, 2)``."""
    x, y = np.asarray(columns) / lattice.spacing, np.full(len(columns), row / lattice.spacing)
    u, v = (map_coordinates(lattice.dem[..., axis], [y, x], order=1) for axis in range(2))
    t = np.array([height(heights, *place, cubic) for place in zip(u - LEFT, v - TOP, strict=True)])
    t = (t - lattice.middle) / lattice.half
    terms = [
        [map_coordinates(lattice.image[:, :, k, axis], [y, x], order=1) * t**k for k in range(lattice.image.shape[2])]
        for axis in range(2)
    ]
    return np.sum(terms, axis=1).T


def block_coordinates(lattice, cubic, row, left, right, heights=HEIGHTS):
    columns, rows = np.full((2, right - left), 777.0)
    ticks = np.arange(right) % lattice.spacing / lattice.spacing
    dem = DemWindow(heights, LEFT, TOP, cubic)
    tile_kernel.block_coordinates(row, left, right, lattice, dem, ticks, columns, rows)
    return np.stack([columns, rows], axis=1)


@pytest.mark.parametrize("cubic", [False, True])
@pytest.mark.parametrize("levels", [1, 2, 3, 4])
@pytest.mark.parametrize(
    ("u", "v"),
    [((0.2, 5.5), (0.3, 4.4)), ((5.7, -5.5), (4.6, -4.4)), ((2.9, 0.3), (2.9, 0.2)), ((3.1, -0.3), (-0.1, 0.3))],
    ids=["fine", "backward", "coarse", "coarse and partly outside"],
)
def test_image_coordinates_are_polynomials_in_the_height(levels, u, v, cubic):
    made = lattice(levels, u, v)
    for row, (left, right) in itertools.product((0, 3, 4, 7), ((0, 8), (1, 7), (3, 4), (4, 5), (5, 8))):
        found = block_coordinates(made, cubic, row, left, right)
        np.testing.assert_allclose(found, coordinates(made, cubic, row, range(left, right)), atol=1e-9)


def test_every_pixel_may_be_a_node():
    """And nodes without weight may be unknown."""
    made = lattice(2, (0.2, 5.5), (0.3, 4.4), spacing=1)
    for row, column in itertools.product(range(CELLS), repeat=2):
        image, dem = np.full_like(made.image, np.nan), np.full_like(made.dem, np.nan)
        image[row, column], dem[row, column] = made.image[row, column], made.dem[row, column]
        found = block_coordinates(made._replace(image=image, dem=dem), False, row, column, column + 1)
        np.testing.assert_allclose(found, coordinates(made, False, row, [column]), atol=1e-9)


def test_every_second_pixel_may_be_a_node():
    made = lattice(3, (0.2, 5.5), (0.3, 4.4), spacing=2)
    for row in range(4):
        np.testing.assert_allclose(
            block_coordinates(made, False, row, 0, 4), coordinates(made, False, row, range(4)), atol=1e-9
        )


def test_rows_of_nodes_do_not_need_the_next_ones():
    made = lattice(3, (0.2, 5.5), (0.3, 4.4))
    expected = coordinates(made, False, 4, range(8))
    made.image[2], made.dem[2] = np.nan, np.nan
    np.testing.assert_allclose(block_coordinates(made, False, 4, 0, 8), expected, atol=1e-9)


@pytest.mark.parametrize("du", [0.11, -0.11])
def test_a_run_between_the_same_samples_next_to_voids_and_the_edge(du):
    heights = HEIGHTS.copy()
    heights[2, 3] = np.nan
    u0 = LEFT - 0.3 if du > 0 else LEFT + 6.3
    ticks = np.arange(64.0)
    for v0 in (TOP - 0.5, TOP, TOP + 1.0, TOP + 1.5, TOP + 2.0, TOP + 4.5, TOP + 5.0, TOP + 5.5):
        found = np.empty(64)
        tile_kernel._row_heights(DemWindow(heights, LEFT, TOP, False), u0, du, v0, 0.0, 1.0, ticks, found)
        expected = [tile_kernel.dem_height_at(heights, u0 + du * t, v0, LEFT, TOP, False) for t in ticks]
        np.testing.assert_allclose(found, expected, atol=1e-9)
        assert np.isfinite(found).any() == (TOP <= v0 <= TOP + 5)


def test_a_run_in_a_window_that_begins_west_of_the_dem():
    """Windows may begin at negative columns and rows, as those of DEMs with heights beyond their edge do."""
    ticks, found = np.arange(64.0), np.empty(64)
    for left, top in ((-5, -3), (-2, 4), (3, -4)):
        window = DemWindow(HEIGHTS, left, top, False)
        tile_kernel._row_heights(window, left + 0.2, 0.09, top + 1.3, 0.05, 1.0, ticks, found)
        expected = [height(HEIGHTS, 0.2 + 0.09 * t, 1.3 + 0.05 * t, False) for t in ticks]
        np.testing.assert_allclose(found, expected, atol=1e-9)


# -- parts of rows ---------------------------------------------------------------------------------------------------

#: Bounds of columns and rows within which no neighbour is missing.
BOUNDS = 2, 60, 3, 9


def parts(find, count):
    """All parts of a row, one after the other."""
    done = 0
    while done < count:
        begin, end = find(done)
        if begin < end:
            yield begin, end
        assert end > done
        done = end


def test_parts_with_all_neighbours_are_at_least_eight_pixels_long():
    good = np.array([0] * 2 + [1] * 7 + [0] + [1] * 8 + [0] * 3 + [1] * 9 + [0] * 2 + [1] * 5, dtype=bool)
    whole = np.zeros((9, 60), dtype=bool)
    whole[4, 5 : 5 + len(good)] = good
    columns, rows = np.arange(len(good)) + 6.5, np.full(len(good), 5.5)
    source = SourceWindow(None, None, whole, True, 1, 1, 90, 90)
    found = list(parts(lambda done: tile_kernel._next_whole(source, columns, rows, *BOUNDS, done), len(good)))
    assert found == [(10, 18), (21, 30)]


@pytest.mark.parametrize("along", [0, 1], ids=["columns", "rows"])
def test_bounds_belong_to_a_part_but_for_the_last(along):
    low, high = BOUNDS[2 * along : 2 * along + 2]
    moving = np.concatenate([[low - 1e-9], np.linspace(low, high - 1e-9, 10), [high, high + 1]])
    places = [np.full(13, 5.0), np.full(13, 5.0)]
    places[along] = moving
    assert tile_kernel._span(*places, *BOUNDS, 0) == (1, 11)
    assert tile_kernel._span(*places, *BOUNDS, 5) == (13, 13)
    source = SourceWindow(None, None, np.ones((9, 60), dtype=bool), True, 1, 1, 90, 90)
    assert tile_kernel._next_whole(source, *places, *BOUNDS, 0) == (1, 11)


@pytest.mark.parametrize("along", [0, 1], ids=["columns", "rows"])
@pytest.mark.parametrize("value", [1.9, 60.0, np.nan])
def test_a_row_that_leaves_the_bounds_between_has_no_part(along, value):
    places = [np.full(9, 5.0), np.full(9, 5.0)]
    assert tile_kernel._span(*places, *BOUNDS, 0) == (0, 9)
    places[along][4] = value
    assert tile_kernel._span(*places, *BOUNDS, 0) == (9, 9)


# -- blocks ----------------------------------------------------------------------------------------------------------

#: Kernels and how many pixels around a point they read.
KERNELS = {"bilinear": (None, 1), "nearest": (0, 0), "cubic": (1, 2), "lanczos": (2, 3), "average": (3, 2)}
WIDTH, HEIGHT = 16, 12


def plan(row, column):
    """Image columns and rows of output pixels."""
    return 0.813 + 1.0537 * column + 0.0211 * row, 0.719 + 0.0303 * column + 0.9517 * row


def warped(name: str, masked: bool, window: tuple[int, int, int, int]):
    """Warp 14 x 11 pixels out of a window of a source of two bands, a plane each, by a lattice that is a plane too."""
    kernel, reach = KERNELS[name]
    left, top, right, bottom = window
    j, i = np.mgrid[top:bottom, left:right] + 0.5
    pixels = np.stack([3 * i + 7 * j, 500 - i + j])
    valid = np.ones(pixels.shape, dtype=bool)
    valid[1, 6 - top : 7 - top, 7 - left : 8 - left] = False
    whole = np.ones(pixels.shape[1:], dtype=np.uint8)
    resampling_kernel.find_whole(valid, reach, whole)
    source = SourceWindow(pixels, valid, whole, masked, left, top, WIDTH, HEIGHT)
    resampling = Resampling(kernel, reach, (2.0, 2.0), -np.inf, np.inf, False, -1.0, np.empty(0))
    row, column = np.meshgrid(SPACING * np.arange(5), SPACING * np.arange(5), indexing="ij")
    image = np.stack([0.813 + 1.0537 * column + 0.0211 * row, 0.719 + 0.0303 * column + 0.9517 * row], axis=2)[
        :, :, None
    ]
    flat = Lattice(SPACING, image, np.full((5, 5, 2), 0.5), 0.0, 1.0)
    out, good = np.full((2, 20, 20), 99.0), np.zeros((2, 20, 20), dtype=bool)
    target = OutputWindow(2, 13, 1, 15, 4, 3, out, good)
    short = tile_kernel.warp_block(source, flat, DemWindow(np.zeros((2, 2)), 0, 0, False), resampling, target)
    row, column = np.meshgrid(np.arange(2, 13), np.arange(1, 15), indexing="ij")
    here = (slice(None), slice(4, 15), slice(3, 17))
    outside = np.ones(out.shape, dtype=bool)
    outside[here] = False
    assert (out[outside] == 99.0).all()
    assert not good[outside].any()
    return short, out[here], good[here], plan(row, column)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", KERNELS)
def test_a_block_of_a_plane(name, masked):
    short, out, good, (x, y) = warped(name, masked, (0, 0, WIDTH, HEIGHT))
    assert short == 0
    inside = (x <= WIDTH) & (y <= HEIGHT)
    hole = (np.floor(x) == 7) & (np.floor(y) == 6) & masked
    assert hole.any() == masked
    hole &= name != "average"  # its box is larger than the hole
    np.testing.assert_array_equal(good[0], inside)
    np.testing.assert_array_equal(good[1], inside & ~hole)
    assert (out[~good] == -1.0).all()
    reach = KERNELS[name][1]
    sure = (x > reach) & (y > reach) & (x < WIDTH - reach) & (y < HEIGHT - reach)
    sure &= (not masked) | (np.abs(x - 7.5) > reach + 0.5) | (np.abs(y - 6.5) > reach + 0.5)
    assert sure.sum() > 10
    if name == "nearest":
        x, y = np.floor(x) + 0.5, np.floor(y) + 0.5
    # Lanczos does not keep planes.
    off = 0.2 if name == "lanczos" else 1e-9
    for band, plane in enumerate((3 * x + 7 * y, 500 - x + y)):
        np.testing.assert_allclose(out[band][sure], plane[sure], rtol=0, atol=off)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", KERNELS)
def test_a_window_gives_what_the_source_does_and_counts_what_it_lacks(name, masked):
    _, expected, expected_good, (x, y) = warped(name, masked, (0, 0, WIDTH, HEIGHT))
    reach = KERNELS[name][1]
    for left, top, right, bottom in ((1, 0, 16, 12), (0, 2, 15, 12), (3, 3, 14, 11), (4, 0, 16, 10)):
        short, out, good, _ = warped(name, masked, (left, top, right, bottom))
        columns, rows = np.minimum(np.floor(x), WIDTH - 1), np.minimum(np.floor(y), HEIGHT - 1)
        lacks = (np.maximum(columns - reach, 0) < left) | (np.maximum(rows - reach, 0) < top)
        lacks |= (np.minimum(columns + reach, WIDTH - 1) >= right) | (np.minimum(rows + reach, HEIGHT - 1) >= bottom)
        lacks &= (x <= WIDTH) & (y <= HEIGHT)
        assert short == lacks.sum()
        np.testing.assert_array_equal(good[:, ~lacks], expected_good[:, ~lacks])
        np.testing.assert_allclose(out[:, ~lacks], expected[:, ~lacks], atol=1e-9)
