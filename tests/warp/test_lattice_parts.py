"""Where the lattices of blocks have their nodes, check points and windows, by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyproj
import pytest

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.warp import lattice, lattice_kernel
from ortho_pipeline.warp.lattice import BLOCK, VERIFIED, Lattices, OutputBlock, TileHeights, block_cells

UTM = pyproj.CRS.from_epsg(32651)
CENTRE = (500_000.0, 1_000_000.0, 100.0)


@pytest.fixture(autouse=True)
def plain(interpreted):
    interpreted(lattice_kernel)


class Plane:
    """A camera in UTM: a pixel is a metre; the domain is 300 m wide and 200 m high."""

    crs, detail, domain = UTM, np.inf, (np.array(CENTRE), np.array([150.0, 100.0, 50.0]))

    def ground_to_image(self, ground):
        return np.stack([ground[:, 0] - 499_000, 1_001_000 - ground[:, 1]], axis=1)


def lattices(size=(400, 300), reach=2, crs=UTM, left=499_000.0, top=1_001_000.0) -> Lattices:
    grid = Grid(crs, left, top, 2.0, 1.0, 5000, 5000)
    surface = SimpleNamespace(sampler=lambda crs: lambda ground: ground[:, :2] / 10)
    return Lattices(Plane(), surface, grid, size, tolerance=0.01, reach=reach, averages=False)


@pytest.mark.parametrize("spacing", [1, 64, 256])
def test_nodes_go_from_the_first_pixel_to_that_of_the_next_block(spacing):
    columns, rows = lattice._positions(spacing)
    expected = np.arange(0, 257, spacing)
    np.testing.assert_array_equal(columns, np.tile(expected, (len(expected), 1)))
    np.testing.assert_array_equal(rows, columns.T)


def test_positions_are_those_of_the_middles_of_pixels():
    columns, rows = Lattices._offsets(
        [OutputBlock(2, 3), OutputBlock(0, 1)], np.array([0.0, 7.0]), np.array([5.0, 0.0])
    )
    np.testing.assert_array_equal(columns, [[768.5, 775.5], [256.5, 263.5]])
    np.testing.assert_array_equal(rows, [[517.5, 512.5], [5.5, 0.5]])


def test_check_points_spread_over_the_visible_part():
    area = np.array([[10.0, 60.0, 100.0, 140.0], [192.0, 256.0, 0.0, 256.0]])
    points = lattice._scatter([OutputBlock(0, 0), OutputBlock(0, 1)], area)
    assert points.shape == (2, VERIFIED, 3)
    np.testing.assert_array_equal(points[0, 0], [100 + 0.5 * 40, 10 + 0.25 * 50, -1.0])
    # The last pixel of a block is the 255th after the first.
    np.testing.assert_allclose(points[1, 0], [0.5 * 255, 192 + (0.25 + 0.5698402910) * 63, -1 + 0.3 * 2])
    for found, (top, bottom, left, right) in zip(points, np.minimum(area, 255), strict=True):
        for values, low, high in zip(found.T, (left, top, -1.0), (right, bottom, 1.0), strict=True):
            assert low <= values.min() < low + 0.2 * (high - low)
            assert high - 0.2 * (high - low) < values.max() <= high
    # The generalised golden ratio of three dimensions solves x^4 = x + 1.
    phi = 1.2207440846057596
    steps = np.remainder(np.diff((points[0] - [100, 10, -1]) / [40, 50, 2], axis=0), 1.0)
    np.testing.assert_allclose(steps, np.tile([1 / phi, 1 / phi**2, 1 / phi**3], (23, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("box", "window"),
    [
        ((10.2, 20.9, 30.1, 39.2), (4, 14, 37, 46)),
        ((3.0, 5.0, 399.0, 299.0), (0, 0, 400, 300)),
        ((-20.0, -30.0, -5.5, 9.0), (0, 0, 1, 15)),
        ((-20.0, -30.0, -6.0, 9.0), None),
        ((405.0, 9.0, 500.0, 20.0), (399, 3, 400, 26)),
        ((406.0, 9.0, 500.0, 20.0), None),
        ((9.0, -50.0, 20.0, -6.0), None),
        ((9.0, 306.0, 20.0, 400.0), None),
        ((np.inf, np.inf, -np.inf, -np.inf), None),
    ],
)
def test_windows_of_the_source_have_the_reach_and_four_pixels_around(box, window):
    assert lattices()._window_around(list(box), 2) == window


def test_blocks_over_the_domain_of_the_model():
    """It spans output columns 425 to 575 and rows 900 to 1100."""
    made = lattices()
    assert made._exact.domain() == pytest.approx((425, 900, 575, 1100))
    inside = {(row, column) for row, column in np.ndindex(6, 5) if made._in_domain(OutputBlock(row, column))}
    assert inside == {(row, column) for row in (3, 4) for column in (1, 2)}
    made._domain = (256.0, 512.0, 512.0, 768.0)
    inside = {(row, column) for row, column in np.ndindex(6, 5) if made._in_domain(OutputBlock(row, column))}
    assert inside == {(2, 1)}


def test_the_domain_is_in_pixels_of_either_side():
    """Pixels of 2 m by 4 m, the first corner 1000 m west and north of the middle: 75 x 25 pixels to either side."""
    surface = SimpleNamespace(sampler=lambda crs: lambda ground: ground[:, :2] / 10)
    exact = lattice._Exact(Plane(), surface, Grid(UTM, 499_000.0, 1_001_000.0, 2.0, 4.0, 900, 700))
    assert exact.domain() == pytest.approx((425, 225, 575, 275))
    away = Grid(pyproj.CRS.from_epsg(32651), 499_000.0, 1_001_000.0, 2.0, 4.0, 900, 700)
    nowhere = SimpleNamespace(crs=UTM, domain=(np.full(3, np.nan), np.ones(3)))
    assert lattice._Exact(nowhere, surface, away).domain() == (-np.inf, -np.inf, np.inf, np.inf)


def test_between_projections_of_one_datum_heights_take_no_part():
    assert lattices()._exact._flat
    assert not lattices(crs=pyproj.CRS.from_epsg(4978), left=-3e6, top=5e6)._exact._flat


def test_image_and_dem_points_of_positions():
    made = lattices()._exact
    columns, rows = np.array([[0.5, 3.5]]), np.array([[1.5, 2.5]])
    heights = np.array([[[5.0, 6.0, 7.0]] * 2])
    found = made.image(columns, rows, heights)
    assert found.shape == (1, 2, 3, 2)
    np.testing.assert_allclose(found[0, 0], [[1.0, 1.5]] * 3, atol=1e-6)
    np.testing.assert_allclose(found[0, 1], [[7.0, 2.5]] * 3, atol=1e-6)
    np.testing.assert_allclose(made.dem(columns, rows), [[[49900.1, 100099.85], [49900.7, 100099.75]]])


@pytest.mark.parametrize(("spacing", "side"), [(64, 64), (4, 32), (256, 256)])
def test_cells_of_a_block_cover_it_once(spacing, side):
    count = np.zeros((BLOCK, BLOCK), dtype=int)
    for (top, bottom, left, right), (rows, columns) in block_cells(spacing):
        assert (bottom - top, right - left) == (side, side)
        assert (rows.start * spacing, (rows.stop - 1) * spacing) == (top, bottom)
        assert (columns.start * spacing, (columns.stop - 1) * spacing) == (left, right)
        count[top:bottom, left:right] += 1
    assert (count == 1).all()


def test_what_an_output_pixel_covers_is_the_mean_over_the_block():
    j, i = np.mgrid[0:3.0, 0:3.0]
    block = OutputBlock(0, 0, spacing=4, dem_nodes=np.zeros((3, 3, 2)))
    block.nodes = np.stack([-8 * i + 4 * j, 2 * i - 12 * j], axis=2)[:, :, None]
    assert lattice._box(block) == (2.0 + 1.0, 0.5 + 3.0)
    block.nodes[2, 2] = np.nan
    assert lattice._box(block) == (2.0 + 1.0, 0.5 + 3.0)
    block.nodes /= 16
    assert lattice._box(block) == (1.0, 1.0)
    block.nodes = np.full((3, 3, 1, 2), np.nan)
    assert lattice._box(block) == (1.0, 1.0)


@pytest.mark.parametrize(("cubic", "half"), [(False, 3.0), (True, 3.0 + 6 * 9 / 32)])
def test_ranges_of_the_heights_of_blocks(cubic, half):
    """The first block has heights of 10 to 16 m, the second voids alone, the third none, the last a plain."""
    heights = {0: (10.0, 16.0), 20: (np.inf, -np.inf), 60: (7.0, 7.5)}
    surface = SimpleNamespace(
        window_around=lambda left, top, right, bottom: (
            None if left == 40 else (int(left), int(top), int(right), int(bottom))
        ),
        range_within=lambda left, top, width, height: heights[left],
    )
    blocks = [OutputBlock(0, column) for column in range(4)]
    uv = np.array([[[[left, 5.0], [left + 9, 8.0]]] for left in (0.0, 20.0, 40.0, 60.0)])
    assert TileHeights(surface, cubic, 100).ranges(blocks, uv) == [0, 3]
    assert (blocks[0].middle, blocks[0].half, blocks[0].terrain) == (13.0, half, (0, 5, 9, 8))
    assert (blocks[3].middle, blocks[3].half) == (7.25, 0.5)


def test_a_window_fits_if_it_takes_no_more_than_the_memory():
    heights = TileHeights(SimpleNamespace(), False, 8 * 12)
    assert heights._fits((5, 7, 9, 10))
    assert not heights._fits((5, 7, 10, 10))
