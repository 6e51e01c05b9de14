"""Pixels that are read ahead are those of the file, each block once; and how much memory caches of blocks get."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.raster.caching.block_cache import cache_restored, keep_blocks, limit_cache
from ortho_pipeline.raster.caching.read_ahead import ReadAhead, _rectangles
from ortho_pipeline.raster.source import RasterSource

#: Blocks of 16 x 16 pixels; the last column has 6 pixels and the last row 4.
WIDTH, HEIGHT, BLOCK = 70, 100, 16
#: Bytes of a whole block: two bands of 2 bytes, and a byte of validity for each.
BYTES = BLOCK * BLOCK * 2 * 3


class AtOnce:
    """A pool of threads that does the work when it gets it."""

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(work(*arguments))
        return done


class Counted(RasterSource):
    """A raster that notes the windows (left, top, right, bottom) that are read."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.windows: list[tuple[int, int, int, int]] = []

    def read(self, left: int, top: int, width: int, height: int) -> Any:
        self.windows.append((left, top, left + width, top + height))
        return super().read(left, top, width, height)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("far") / "a.tif"
    options = ["TILED=YES", f"BLOCKXSIZE={BLOCK}", f"BLOCKYSIZE={BLOCK}"]
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), WIDTH, HEIGHT, 2, gdal.GDT_UInt16, options)
    values = np.random.default_rng(0).integers(1, 60_000, (2, HEIGHT, WIDTH)).astype(np.uint16)
    values[:, 30:50, 20:35] = 0
    dataset.WriteArray(values)
    for band in (1, 2):
        dataset.GetRasterBand(band).SetNoDataValue(0)
    return path


def ahead(path: Path, blocks: float) -> tuple[ReadAhead, Counted]:
    """Return a reader with memory for so many whole blocks, and the raster that it reads."""
    plain = Counted(path)
    return ReadAhead(plain, int(blocks * BYTES), AtOnce()), plain  # type: ignore[arg-type]


@pytest.mark.parametrize("blocks", [1, 3, 1000])
def test_any_window_has_the_pixels_of_the_file(path: Path, blocks: int) -> None:
    truth, (reader, plain) = RasterSource(path), ahead(path, blocks)
    random = np.random.default_rng(1)
    for number in range(80):
        left, top = random.integers(0, WIDTH), random.integers(0, HEIGHT)
        width, height = random.integers(1, WIDTH - left + 1), random.integers(1, HEIGHT - top + 1)
        window = (int(left), int(top), int(width), int(height))
        if number % 3 == 0:
            reader.expect(window[0], window[1], window[0] + window[2], window[1] + window[3])
        pixels = reader.read(*window)
        np.testing.assert_array_equal(pixels, truth.read(*window))
        found, valid = (one.read_valid(window[0], window[1], pixels) for one in (reader, truth))
        full = np.ones(pixels.shape, dtype=bool)
        np.testing.assert_array_equal(full if found is None else found, full if valid is None else valid)
    # Nothing beyond the raster is read; with much memory no pixel is read twice.
    times = np.zeros((HEIGHT, WIDTH), dtype=int)
    for first, upper, last, lower in plain.windows:
        assert 0 <= first < last <= WIDTH
        assert 0 <= upper < lower <= HEIGHT
        times[upper:lower, first:last] += 1
    assert times.max() == 1 if blocks == 1000 else times.max() > 1


def test_a_window_is_read_in_whole_blocks_and_what_is_there_is_not_read_again(path: Path) -> None:
    reader, plain = ahead(path, 1000)
    reader.read(17, 33, 10, 20)
    assert plain.windows == [(16, 32, 32, 64)]
    reader.expect(10, 40, 50, 41)
    assert sorted(plain.windows[1:]) == [(0, 32, 16, 48), (32, 32, 64, 48)]
    reader.read(10, 40, 40, 1)
    assert len(plain.windows) == 3
    reader.read(64, 96, 6, 4)
    assert plain.windows[3:] == [(64, 96, 70, 100)]


def test_what_was_used_longest_ago_is_forgotten_first(path: Path) -> None:
    """Memory for two blocks; what is waiting is kept."""
    reader, plain = ahead(path, 2)
    for left in (0, 16, 0, 32):
        reader.read(left, 0, 1, 1)
    assert len(plain.windows) == 3
    reader.read(0, 0, 1, 1)
    reader.read(32, 0, 1, 1)
    assert len(plain.windows) == 3
    reader.read(16, 0, 1, 1)
    assert plain.windows[3:] == [(16, 0, 32, 16)]
    # A block that is expected stays until it is used.
    waiting, plain = ahead(path, 2)
    waiting.expect(0, 0, 1, 1)
    for left in (16, 32, 48):
        waiting.read(left, 0, 1, 1)
    waiting.read(0, 0, 1, 1)
    assert len(plain.windows) == 4


def test_no_more_is_read_ahead_than_half_of_the_memory(path: Path) -> None:
    reader, plain = ahead(path, 4)
    for top in (0, 16, 32, 48):
        reader.expect(0, top, 16, top + 16)
    assert len(plain.windows) == 2
    # What was used does not wait any more.
    reader.read(0, 0, 1, 1)
    reader.expect(0, 32, 16, 48)
    assert len(plain.windows) == 3


def test_rectangles_are_the_places_together() -> None:
    random = np.random.default_rng(2)
    for share in (0.1, 0.5, 0.8, 1.0):
        grid = random.random((9, 12)) < share
        places = {(int(row) + 3, int(column) + 5) for row, column in np.argwhere(grid)}
        covered = [
            (row, column)
            for first_row, last_row, first, last in _rectangles(places)
            for row in range(first_row, last_row)
            for column in range(first, last)
        ]
        assert sorted(covered) == sorted(places)
    assert _rectangles(set()) == []
    # Runs of the same columns in rows one below the other are one; a row between them divides them.
    assert _rectangles({(0, 0), (0, 1), (1, 0), (1, 1)}) == [(0, 2, 0, 2)]
    assert sorted(_rectangles({(0, 0), (2, 0)})) == [(0, 1, 0, 1), (2, 3, 0, 1)]


# -- GDAL's cache ----------------------------------------------------------------------------------------------------

MB = 1_000_000


@pytest.fixture
def cache() -> Iterator[None]:
    before = gdal.GetCacheMax()
    yield
    gdal.SetCacheMax(before)


@pytest.mark.parametrize(
    ("memory", "threads", "blocks", "allowed", "size"),
    [
        (400, 4, (), 4, 100),
        (40, 4, (), 4, 16),
        # The blocks of the threads count: 100 - 4 x 10 MB, of which they fill no more than half.
        (400, 2, (5, 5), 2, 80),
        # More than half of the cache: room for them and 64 MB.
        (400, 4, (10,), 4, 104),
        (100, 8, (30,), 3, 154),
        (10, 8, (30,), 1, 94),
    ],
)  # fmt: skip
def test_the_cache_is_a_quarter_of_the_memory_or_the_blocks_of_the_threads(
    cache: None, memory: int, threads: int, blocks: tuple[int, ...], allowed: int, size: int
) -> None:
    assert limit_cache(memory * MB, threads, *(block * MB for block in blocks)) == allowed
    assert gdal.GetCacheMax() == size * MB


def test_a_cache_that_holds_the_blocks_stays(cache: None) -> None:
    gdal.SetCacheMax(100 * MB)
    keep_blocks(50 * MB)
    assert gdal.GetCacheMax() == 100 * MB
    keep_blocks(51 * MB)
    assert gdal.GetCacheMax() == 115 * MB


def test_the_size_of_the_cache_comes_back_with_the_end_of_the_last_job(cache: None) -> None:
    gdal.SetCacheMax(77 * MB)
    with cache_restored():
        gdal.SetCacheMax(20 * MB)
        with cache_restored():
            gdal.SetCacheMax(30 * MB)
        assert gdal.GetCacheMax() == 30 * MB
    assert gdal.GetCacheMax() == 77 * MB
    with contextlib.suppress(ValueError), cache_restored():
        gdal.SetCacheMax(30 * MB)
        raise ValueError("a job fails")
    assert gdal.GetCacheMax() == 77 * MB
