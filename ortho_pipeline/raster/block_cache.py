"""GDAL's cache of blocks: how much of the memory of a job it gets."""

from __future__ import annotations

from osgeo import gdal

#: What GDAL's cache has to hold beside large blocks of an image (bytes).
_OTHER_BLOCKS = 64_000_000


def limit_cache(memory: int, threads: int, *blocks: int) -> int:
    """Limit GDAL's block cache to a quarter of `memory` (at least 16 MB), or to what holds the blocks of each thread.

    Beside its cache GDAL has room for the block that each thread decodes, which counts for that quarter.

    Returns
    -------
    int
        How many threads that allows, at most `threads`: each decodes blocks (of `blocks` bytes) of its own.
    """
    held = sum(blocks)
    threads = max(1, min(threads, memory // max(held, 1)))
    gdal.SetCacheMax(max(memory // 4 - threads * held, 16_000_000))
    keep_blocks(threads * held)
    return threads


def keep_blocks(size: int) -> None:
    """Raise GDAL's block cache to what holds blocks of `size` bytes beside those of the output."""
    if size > gdal.GetCacheMax() // 2:
        gdal.SetCacheMax(max(gdal.GetCacheMax(), size + _OTHER_BLOCKS))
