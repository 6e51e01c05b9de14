"""Tiles of a warp by hand: their blocks, the windows of the source under them, and the part of a block in a tile."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.warp.lattice import OutputBlock
from ortho_pipeline.warp.lattice_engine import TileMaker, _in_order, _Tile, _tiles

#: An image of 3 bands of 300 columns and 200 rows.
IMAGE = np.random.default_rng(4).integers(0, 999, (3, 200, 300)).astype(np.uint16)


def maker(valid: np.ndarray | None = None, window_bytes: int = 0) -> Any:
    made: Any = TileMaker.__new__(TileMaker)

    def part(of: np.ndarray, left: int, top: int, width: int, height: int) -> np.ndarray:
        assert 0 <= left < left + width <= 300
        assert 0 <= top < top + height <= 200
        return of[:, top : top + height, left : left + width]

    made.source = SimpleNamespace(
        count=3,
        dtype=IMAGE.dtype,
        width=300,
        height=200,
        read=lambda *box: part(IMAGE, *box),
        read_valid=lambda left, top, pixels: (
            None if valid is None else part(valid, left, top, pixels.shape[2], pixels.shape[1])
        ),
    )
    made.surface, made.cubic_dem, made.window_bytes = None, False, window_bytes
    made.lattices = SimpleNamespace(build=lambda blocks, terrain: blocks)
    return made


def test_tiles_go_row_by_row_and_end_with_the_grid() -> None:
    grid = Grid(pyproj.CRS.from_epsg(32633), 0.0, 0.0, 1.0, 1.0, 9, 7)
    assert list(_tiles(grid, 4)) == [
        (0, 0, 4, 4), (0, 4, 4, 4), (0, 8, 4, 1), (4, 0, 3, 4), (4, 4, 3, 4), (4, 8, 3, 1),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("tile", "rows", "columns"),
    [((256, 512, 300, 257), (1, 2), (2, 3)), ((0, 0, 256, 256), (0,), (0,)), ((1024, 768, 1, 513), (4,), (3, 4, 5))],
)
def test_a_tile_has_all_blocks_that_it_meets(
    tile: tuple[int, int, int, int], rows: tuple[int, ...], columns: tuple[int, ...]
) -> None:
    _, blocks = maker().prepare(tile)
    assert [(block.row, block.column) for block in blocks] == [(row, column) for row in rows for column in columns]


def test_blocks_are_read_together_if_their_window_fits_into_the_memory() -> None:
    blocks = [OutputBlock(0, 0, window=(10, 40, 60, 70)), OutputBlock(0, 1, window=(50, 20, 95, 55))]
    # 85 columns and 50 rows of three bands of two bytes.
    assert maker(window_bytes=85 * 50 * 6)._together(blocks) == (10, 20, 95, 70)
    assert maker(window_bytes=85 * 50 * 6 - 1)._together(blocks) is None
    assert maker(window_bytes=50 * 30 * 6)._together(blocks[:1]) == (10, 40, 60, 70)


def test_a_window_has_pixels_and_which_of_them_have_only_valid_neighbours() -> None:
    plain = maker()._window(20, 30, 70, 90, 2)
    np.testing.assert_array_equal(plain.pixels, IMAGE[:, 30:90, 20:70])
    assert (plain.masked, plain.left, plain.top, plain.width, plain.height) == (False, 20, 30, 300, 200)
    valid = np.ones(IMAGE.shape, dtype=bool)
    valid[1, 50, 40] = False
    masked = maker(valid)._window(20, 30, 70, 90, 2)
    assert masked.masked
    np.testing.assert_array_equal(masked.valid, valid[:, 30:90, 20:70])
    assert masked[2].shape == (60, 50)
    assert not masked[2][18:23, 18:23].any()
    assert masked[2][10, 10]


@pytest.mark.parametrize(
    ("box", "wider"),
    [
        ((100, 80, 140, 100), (36, 16, 204, 164)),
        ((63, 65, 240, 140), (0, 1, 300, 200)),
        ((0, 0, 235, 135), (0, 0, 299, 199)),
    ],
)
def test_a_wider_window_has_64_pixels_more_on_each_side_within_the_image(
    box: tuple[int, int, int, int], wider: tuple[int, int, int, int]
) -> None:
    made = maker()
    found = made._wider(made._window(*box, 2), 2)
    _, height, width = found.pixels.shape
    assert (found.left, found.top, found.left + width, found.top + height) == wider


def test_a_part_of_a_block_is_at_its_place_in_the_tile_and_ends_with_it() -> None:
    pixels, valid = np.zeros((1, 300, 700)), np.zeros((1, 300, 700), dtype=bool)
    tile = _Tile(512, 256, pixels, valid)
    assert tile.target(OutputBlock(2, 1), (0, 256, 0, 256))[:6] == (0, 256, 0, 256, 0, 0)
    assert tile.target(OutputBlock(3, 3), (0, 256, 0, 256))[:6] == (0, 44, 0, 188, 256, 512)
    assert tile.target(OutputBlock(3, 2), (32, 64, 96, 128))[:6] == (32, 44, 96, 128, 288, 352)
    assert tile.target(OutputBlock(3, 2), (0, 256, 0, 256)).pixels is pixels


@pytest.mark.parametrize(("count", "ahead"), [(1, 0), (1, 2), (7, 0), (7, 2), (2, 5)])
def test_tiles_come_in_their_order_and_each_is_made_once(count: int, ahead: int) -> None:
    """Where tiles are prepared ahead, each is prepared once and made of what was prepared for it."""
    tiles, prepared = [(k, 0, 1, 1) for k in range(count)], []

    def prepare(tile: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
        prepared.append(tile)
        return tile

    def make(tile: Any, ready: Any = None) -> Any:
        return (tile, None if ready is None else ready.result())

    work: Any = SimpleNamespace(prepare=prepare, make=make)
    found = list(_in_order(2, work, tiles, ahead))
    assert found == [(tile, tile if ahead else None) for tile in tiles]
    assert sorted(prepared) == (tiles if ahead else [])


def test_blocks_that_are_read_together_have_the_reach_of_the_one_that_reads_farthest() -> None:
    made, asked = maker(window_bytes=10**6), []
    made._window = lambda *window: asked.append(window)
    made._warp_block = lambda block, window, dem, target: None
    blocks = [
        OutputBlock(0, 0, window=(10, 40, 60, 70), reach=2), OutputBlock(0, 1, window=(50, 20, 95, 55), reach=7),
        OutputBlock(0, 2, window=(60, 30, 90, 50), reach=4),
    ]  # fmt: skip
    made._warp(blocks, None, (0, 256, 0, 256), SimpleNamespace(target=lambda block, area: None))
    assert asked == [(10, 20, 95, 70, 7)]


@pytest.mark.parametrize(
    ("area", "count"),
    [((0, 256, 0, 256), 15), ((64, 128, 128, 192), 1), ((0, 64, 192, 256), 0), ((192, 256, 0, 64), 1)],
)
def test_cells_of_a_block_are_made_where_its_heights_are_and_the_image_is(area: Any, count: int) -> None:
    """The cell in the upper right does not see the image."""
    made, cells = maker(), []
    made.lattices.source_window = lambda block, rows, columns: (
        None if (rows.start, columns.start) == (0, 3) else (0, 0, 9, 9)
    )
    made._warp_block = lambda block, window, dem, target: cells.append(target)
    block = OutputBlock(0, 0, spacing=64)
    made._warp_cells(block, None, area, SimpleNamespace(target=lambda block, cell: cell))
    assert len(cells) == len(set(cells)) == count
    assert all(area[k] <= cell[k] < cell[k + 1] <= area[k + 1] for cell in cells for k in (0, 2))
