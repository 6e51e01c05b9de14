"""Orthorectification: every output pixel through the lattice into the source, by compiled kernels, tile by tile.

A tile reads only its windows of DEM and source, so memory is bounded whatever the size of the image. Tiles are made by
several threads, each with GDAL handles of its own.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.caching.block_cache import limit_cache
from ortho_pipeline.raster.caching.read_ahead import AHEAD, ReadAhead, read_ahead
from ortho_pipeline.raster.ortho import (
    Profile,
    RasterWriter,
    as_written,
    keep_off_nodata,
    refuse_empty,
    square_side,
    value_range,
)
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.runtime.process_limits import thread_pool
from ortho_pipeline.warp import resampling_kernel
from ortho_pipeline.warp.job import KERNELS, WARPING, WarpJob, WarpRecord
from ortho_pipeline.warp.lattice import BLOCK, Lattices, OutputBlock, TileHeights, block_cells
from ortho_pipeline.warp.quality.hiding import Hiding, Looked
from ortho_pipeline.warp.tile_kernel import DemWindow, OutputWindow, warp_block

#: Side of a tile, the piece of work of a thread, of few bands (`square_side`). What a tile is may not depend on memory
#: or threads, which the order of blocks in a file would tell.
TILE = 4 * BLOCK


def rectify(job: WarpJob, path: str | os.PathLike[str] | Hiding) -> WarpRecord:
    """Write the orthoimage of a source on a grid.

    Parameters
    ----------
    path : path or Hiding
        Path of the ortho, or the path with the treatment of pixels that terrain hides.

    Raises
    ------
    InputError
        For an unknown kernel, a palette with anything but nearest, or files that cannot be read or written.
    ModelError
        If the tolerance cannot be held.
    """
    begin = time.monotonic()
    _check(job)
    memory, progress, grid, profile = job.resources.memory, job.resources.progress, job.grid, job.look()
    other = path.other.block if isinstance(path, Hiding) and path.other is not None else 0
    threads = limit_cache(memory, job.threads(), job.source.block, job.surface.block, other)
    with contextlib.ExitStack() as stack:
        source = stack.enter_context(read_ahead(job.source, memory // 4))
        ahead = AHEAD if isinstance(source, ReadAhead) else 0
        window = memory // (4 * (threads + ahead))
        work = TileMaker(replace(job, source=source), profile, window)
        if isinstance(path, Hiding):
            work.looked, path = path.begun(job.model, job.surface, grid, window), path.ortho
        writer = stack.enter_context(
            RasterWriter(
                path,
                grid,
                profile,
                driver=job.driver,
                creation_options=job.layout(),
                threads=threads,
                progress=progress,
            )
        )
        mask = None if work.looked is None else stack.enter_context(work.looked.writer(job.driver, threads))
        tiles = list(_tiles(grid, square_side(profile, TILE)))
        for done, tile in enumerate(_in_order(threads, work, tiles, ahead), start=1):
            writer.write(tile.left, tile.top, tile.pixels, tile.valid)
            if mask is not None:
                mask.write(tile.left, tile.top, tile.classes[None], None)
            if progress:
                progress(WARPING, done / len(tiles))
        refuse_empty(work.valid_pixels, path)
    return WarpRecord(
        max_error_px=work.lattices.worst,
        tolerance_px=job.tolerance,
        finest_spacing=work.lattices.finest,
        refined_blocks=work.lattices.refined,
        blocks=math.ceil(grid.width / BLOCK) * math.ceil(grid.height / BLOCK),
        pixels=grid.width * grid.height,
        valid_pixels=work.valid_pixels,
        seconds=time.monotonic() - begin,
        hidden_share=None if work.looked is None else work.looked.hidden_share,
        filled_share=None if work.looked is None else work.looked.filled_share,
    )


def tile_maker(job: WarpJob) -> TileMaker:
    """Return what makes the tiles of an ortho one by one, those that `rectify` writes; its threads share the memory.

    Raises
    ------
    InputError
        As `rectify`.
    """
    _check(job)
    return TileMaker(job, job.look(), job.resources.memory // (4 * (os.cpu_count() or 1)))


def _check(job: WarpJob) -> None:
    job.check()
    if not 0 < job.tolerance < math.inf:
        raise InputError(
            "the tolerance must be positive and finite", field="tolerance", remedy="use the default, 0.01 px"
        )


def _tiles(grid: Grid, side: int) -> Iterator[tuple[int, int, int, int]]:
    for top in range(0, grid.height, side):
        for left in range(0, grid.width, side):
            yield top, left, min(side, grid.height - top), min(side, grid.width - left)


def _in_order(threads: int, work: TileMaker, tiles: list[tuple[int, int, int, int]], ahead: int) -> Iterator[Made]:
    """Yield tiles in their order, so that equal orthos are equal files; few are made, and `ahead` prepared, before.

    Threads begin work in the order in which it is handed to them: what a tile waits for has begun.
    """
    if len(tiles) == 1 and not ahead:
        # A thread of its own would open the files again, and ask PROJ for its transformations anew.
        yield work.make(tiles[0])
        return
    with thread_pool(threads, "warp") as pool:
        prepared = deque(pool.submit(work.prepare, tile) for tile in tiles[:ahead])
        pending: deque[Future[Any]] = deque()
        try:
            for number, tile in enumerate(tiles):
                if ahead and number + ahead < len(tiles):
                    prepared.append(pool.submit(work.prepare, tiles[number + ahead]))
                pending.append(pool.submit(work.make, tile, prepared.popleft() if ahead else None))
                if len(pending) > threads + 1:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in (*prepared, *pending):
                future.cancel()


class Made(NamedTuple):
    """A tile: its place in the ortho, pixels ``(bands, h, w)``, which of them are valid ``(h, w)``, classes."""

    left: int
    top: int
    pixels: NDArray[Any]
    valid: NDArray[np.bool_]
    classes: Any


class TileMaker:
    """The work on one output raster, shared by its threads: see `tile_maker`."""

    def __init__(self, job: WarpJob, profile: Profile, window_bytes: int) -> None:
        source = job.source
        kernel, reach = KERNELS[job.resampling]
        self.source, self.surface, self.profile, self.window_bytes = source, job.surface, profile, window_bytes
        self.lattices = Lattices(
            job.model,
            job.surface,
            job.grid,
            (source.width, source.height),
            tolerance=job.tolerance,
            reach=reach,
            averages=job.resampling == "average",
        )
        self.cubic_dem = job.dem_interpolation == "cubic"
        self.resampling = resampling_kernel.Resampling(
            kernel, 0, (1.0, 1.0), *value_range(source.dtype, profile), real=None
        )
        self._lock = threading.Lock()
        self.valid_pixels = 0
        self.looked: Looked | None = None

    # -- a tile ------------------------------------------------------------------------------------------------------

    def prepare(self, part: tuple[int, int, int, int]) -> tuple[TileHeights, list[OutputBlock]]:
        """Find where the pixels of a tile (top, left, height, width) come from, and begin to read them if far away."""
        top, left, height, width = part
        blocks = [
            OutputBlock(row, column)
            for row in range(top // BLOCK, -(-(top + height) // BLOCK))
            for column in range(left // BLOCK, -(-(left + width) // BLOCK))
        ]
        terrain = TileHeights(self.surface, self.cubic_dem, self.window_bytes)
        seen = self.lattices.build(blocks, terrain)
        if isinstance(self.source, ReadAhead) and seen:
            together = self._together(seen)
            for window in [block.window for block in seen] if together is None else [together]:
                assert window is not None
                self.source.expect(*(int(side) for side in window))
        return terrain, seen

    def make(
        self, part: tuple[int, int, int, int], prepared: Future[tuple[TileHeights, list[OutputBlock]]] | None = None
    ) -> Made:
        """Compute one tile (top, left, height, width)."""
        top, left, height, width = part
        shape, dtype = (self.source.count, height, width), self.source.dtype
        tile = _Tile(top, left, np.full(shape, self.resampling.fill, dtype), np.zeros(shape, dtype=bool))
        terrain, seen = self.prepare(part) if prepared is None else prepared.result()
        for group, dem, area in terrain.groups(seen):
            self._warp(group, dem, area, tile)
        classes, hidden = None, None
        if self.looked is not None:
            classes, hidden = self.looked.look(left, top, tile.pixels, tile.valid, self.resampling.fill)
        low, _, _, fill = value_range(self.profile.dtype, self.profile)
        out = as_written(tile.pixels, tile.valid, self.profile.dtype, fill)
        if self.looked is not None:
            self.looked.fill(left, top, hidden, out, tile.valid)
        if self.profile.validity == "nodata":
            keep_off_nodata(out, tile.valid, fill, low)
        mask = self.profile.mask_of(tile.valid)
        with self._lock:
            self.valid_pixels += int(np.count_nonzero(mask))
        return Made(left, top, out, mask, classes)

    # -- pixels ------------------------------------------------------------------------------------------------------

    def _warp(self, blocks: list[OutputBlock], dem: DemWindow, area: tuple[int, int, int, int], tile: _Tile) -> None:
        together = self._together(blocks)
        if together is None:
            for block in blocks:
                if len(blocks) > 1:
                    self._warp([block], dem, area, tile)
                else:
                    self._warp_cells(block, dem, area, tile)
            return
        window = self._window(*together, max(block.reach for block in blocks))
        for block in blocks:
            self._warp_block(block, window, dem, tile.target(block, area))

    def _together(self, blocks: list[OutputBlock]) -> tuple[int, int, int, int] | None:
        """Return the window of the source under some blocks; None where it is too large for the memory."""
        windows = np.array([block.window for block in blocks])
        left, top = (int(side) for side in windows[:, :2].min(axis=0))
        right, bottom = (int(side) for side in windows[:, 2:].max(axis=0))
        size = (right - left) * (bottom - top) * self.source.count * self.source.dtype.itemsize
        return (left, top, right, bottom) if size <= self.window_bytes else None

    def _warp_cells(self, block: OutputBlock, dem: DemWindow, area: tuple[int, int, int, int], tile: _Tile) -> None:
        """Make a block whose window of the source is too large for the memory, one cell of its lattice at a time."""
        for cell, nodes in block_cells(block.spacing):
            window = self.lattices.source_window(block, *nodes)
            within = all(area[k] <= cell[k] and cell[k + 1] <= area[k + 1] for k in (0, 2))
            if window is not None and within:
                self._warp_block(block, self._window(*window, block.reach), dem, tile.target(block, cell))

    def _warp_block(
        self, block: OutputBlock, window: resampling_kernel.SourceWindow, dem: DemWindow, target: OutputWindow
    ) -> None:
        # An array that threads shared would have them wait for each other's counts of its references.
        real = resampling_kernel.mixing(self.source.dtype)
        resampling = self.resampling._replace(reach=block.reach, box=block.box, real=real)
        empty = target.first_row >= target.last_row or target.first_column >= target.last_column
        while not empty and warp_block(window, block.lattice, dem, resampling, target):
            window = self._wider(window, block.reach)

    def _window(self, left: int, top: int, right: int, bottom: int, reach: int) -> resampling_kernel.SourceWindow:
        source = self.source
        pixels = source.read(left, top, right - left, bottom - top)
        valid = source.read_valid(left, top, pixels)
        masked = valid is not None
        fully_valid = np.ones(pixels.shape[1:] if masked else (1, 1), dtype=bool)
        if valid is not None:
            resampling_kernel.find_whole(valid, reach, fully_valid)
        return resampling_kernel.SourceWindow(
            pixels,
            np.ones((1, 1, 1), dtype=bool) if valid is None else valid,
            fully_valid,
            masked,
            left,
            top,
            source.width,
            source.height,
        )

    def _wider(self, window: resampling_kernel.SourceWindow, reach: int) -> resampling_kernel.SourceWindow:
        """Return a window larger by 64 pixels all around (terrain between the nodes reached beyond this one)."""
        _, height, width = window.pixels.shape
        left, top = max(0, window.left - 64), max(0, window.top - 64)
        right, bottom = window.left + width + 64, window.top + height + 64
        return self._window(left, top, min(self.source.width, right), min(self.source.height, bottom), reach)


@dataclass(frozen=True, eq=False)
class _Tile:
    """A tile in the making: its first row and column in the ortho, its pixels ``(bands, h, w)``, which are valid."""

    top: int
    left: int
    pixels: NDArray[Any]
    valid: NDArray[np.bool_]

    def target(self, block: OutputBlock, area: tuple[int, int, int, int]) -> OutputWindow:
        """Return the window of a part of a block (see `TileHeights.groups`). The last blocks reach beyond the grid."""
        top, left = block.row * BLOCK - self.top, block.column * BLOCK - self.left
        _, height, width = self.pixels.shape
        first_row, last_row, first, last = area[0], min(area[1], height - top), area[2], min(area[3], width - left)
        place = top + first_row, left + first
        return OutputWindow(first_row, last_row, first, last, *place, self.pixels, self.valid)
