"""GDAL's cache of blocks: how much of the memory of a job it gets."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from osgeo import gdal

from ortho_pipeline.raster.opening.drivers import require_usable_gdal

#: Bytes that GDAL's cache needs in addition to large blocks of an image.
_OTHER_BLOCKS = 64_000_000


def limit_cache(memory: int, threads: int, *blocks: int) -> int:
    """Limit GDAL's block cache to a quarter of `memory` (at least 16 MB), or to the size of the blocks of each thread.

    GDAL also needs memory for the block that each thread decodes, which counts for that quarter.

    Returns
    -------
    int
        Number of threads that this allows, at most `threads`; each decodes its own blocks (of `blocks` bytes).
    """
    held = sum(blocks)
    threads = max(1, min(threads, memory // max(held, 1)))
    gdal.SetCacheMax(max(memory // 4 - threads * held, 16_000_000))
    keep_blocks(threads * held)
    return threads


def keep_blocks(size: int) -> None:
    """Raise GDAL's block cache so that it holds blocks of `size` bytes and those of the output."""
    if size > gdal.GetCacheMax() // 2:
        gdal.SetCacheMax(max(gdal.GetCacheMax(), size + _OTHER_BLOCKS))


class _Jobs:
    """How many jobs are under way, and the size of the cache before the first of them."""

    lock, count, before = threading.Lock(), 0, 0


@contextmanager
def cache_restored() -> Iterator[None]:
    """Give the process the size of its cache back when the last job that is under way has ended."""
    require_usable_gdal()
    with _Jobs.lock:
        if not _Jobs.count:
            _Jobs.before = gdal.GetCacheMax()
        _Jobs.count += 1
    try:
        yield
    finally:
        with _Jobs.lock:
            _Jobs.count -= 1
            if not _Jobs.count:
                gdal.SetCacheMax(_Jobs.before)
