r"""The lattice of the warp: exact model evaluations, and a bound on how far the interpolation between them is off.

Image coordinates are smooth in (x, y) and height, terrain is not. So in each block of 256 x 256 output pixels the exact
model is evaluated at lattice nodes (every 64 pixels to begin with) at a few heights that span the block's terrain; in
between they are bilinear in plan and a polynomial in height. The height itself comes from the DEM at full resolution
for every pixel. The cost of a pixel thus does not depend on the sensor model.

The error is not assumed but bounded, in every block, over the cells of its lattice that may show some of the image
(also where all check points of the block lie next to it). The bound is the sum of

- *an eighth of the largest second difference* of the nodes in either direction: the error of bilinear interpolation
  where curvature changes little from node to node. The nodes are everywhere, so no place goes unseen;
- *the largest change of second differences* from node to node. Where curvature does change, as at a knot of an attitude
  table, a single bend between two nodes moves the curve by less than that;
- *three times what neither explains* at the worst of 24 check points, in plan and height, which lie irregularly within
  the visible part and differ from block to block: the remainder in height, and what nodes at regular distances cannot
  see, such as a vibration of just their frequency. A wave stays below a third of its amplitude at one such point with
  a probability of a fifth, at all of them in one of :math:`10^{16}` blocks;
- with a block's parallax :math:`p` (pixels between its lowest and highest terrain), :math:`p\,\delta` for an error
  :math:`\delta` in DEM samples, bounded in the same way: it holds whatever cliffs the DEM has.

What is both rarer and smaller than the distance of nodes could hide from all of these, so a model with such detail says
so (`SensorModel.detail`: a pushbroom knows the knots of its attitude), and gets a node in every piece of it.

A block is refined until its bound is below half of the tolerance: by more heights, unless the first two parts alone are
too large, or by nodes closer together. Where no lattice is fine enough, and where the model ends within a block, every
pixel is projected by the exact model at its own height.

Blocks lie at fixed places of the output grid and are the unit of all decisions, so the output does not depend on tile
size, memory or number of threads.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import CoverageError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface, Window
from ortho_pipeline.surface.rays import levels, polynomials
from ortho_pipeline.warp import lattice_kernel
from ortho_pipeline.warp.tile_kernel import DemWindow, Lattice, heights_at

#: Side of a block in output pixels.
BLOCK = 256
#: (lattice spacing in output pixels, number of heights), tried one after the other; one of the same spacing only where
#: the spacing is not what lacks. Cubic terms in height are what most models lack next: four heights come first.
#: After the last one every pixel is projected, which takes as many evaluations as a spacing of 2 with these heights.
REFINEMENTS = ((64, 3), (64, 4), (32, 4), (16, 4), (16, 5), (8, 5), (8, 7), (4, 7))
#: Nodes and heights that are evaluated at once where lattices are refined, which keeps their memory small.
_TOGETHER = 1 << 15
#: Check points per block.
VERIFIED = 24
#: Least side (output pixels) of the cells into which a block is cut where memory is short.
_CELL = 32
#: What stands for the terrain of a block in which every pixel is projected: its heights are in its nodes already.
_NO_TERRAIN = DemWindow(np.zeros((2, 2)), 0, 0, False)
#: Source pixels beyond the lattice nodes of a window, for terrain that is higher or lower between the nodes.
_MARGIN = 4


@dataclass(eq=False)
class OutputBlock:
    """One block of the output: where it is, its terrain, its lattice."""

    row: int
    column: int
    spacing: int = 0
    nodes: Array | None = None
    image: Array | None = None  # source image points of the nodes at each height
    dem_nodes: Array | None = None
    middle: float = 0.0
    half: float = 1.0
    terrain: tuple[int, int, int, int] = (0, 0, 0, 0)  # DEM samples left, top, right, bottom
    reach: int = 0
    box: tuple[float, float] = (1.0, 1.0)  # source columns and rows under one output pixel
    window: tuple[int, int, int, int] | None = None  # source pixels left, top, right, bottom

    @property
    def refinement(self) -> tuple[int, int]:
        """Spacing of its nodes and number of its heights, as in `REFINEMENTS`."""
        assert self.nodes is not None
        return self.spacing, self.nodes.shape[2]

    @property
    def lattice(self) -> Lattice:
        """Its lattice as compiled code takes it."""
        assert self.nodes is not None
        assert self.dem_nodes is not None
        return Lattice(self.spacing, self.nodes, self.dem_nodes, self.middle, self.half)


class _Exact:
    """The exact geometry of an output grid: pixels and heights to source image and DEM coordinates."""

    def __init__(self, model: SensorModel, surface: Surface, grid: Grid) -> None:
        self._model, self._grid = model, grid
        self._to_model = ground_transform(grid.crs, model.crs)
        self._samples = surface.sampler(grid.crs)
        self._flat = self._ignores_height()

    def _ignores_height(self) -> bool:
        # Between projections of one datum the height takes no part, which saves transforming every level.
        grid = self._grid
        x, y = grid.xy(np.array([0.0, 0.5, 1.0]) * grid.width, np.array([0.0, 0.5, 1.0]) * grid.height)
        low, high = (self._to_model(np.stack([x, y, np.full(3, height)], axis=1)) for height in (0.0, 5000.0))
        return bool(np.array_equal(low[:, :2], high[:, :2]) and (low[:, 2] == 0).all() and (high[:, 2] == 5000).all())

    def domain(self) -> tuple[float, float, float, float]:
        """Output pixels (left, top, right, bottom) under the box in which the model is meant to be used."""
        centre, half = self._model.domain
        steps = np.linspace(-1.0, 1.0, 33)
        x, y = np.meshgrid(centre[0] + half[0] * steps, centre[1] + half[1] * steps)
        box = np.stack([x.ravel(), y.ravel(), np.full(x.size, centre[2])], axis=1)
        ground = ground_transform(self._model.crs, self._grid.crs)(box)
        ground = ground[np.isfinite(ground).all(axis=1)]
        if not len(ground):
            return -np.inf, -np.inf, np.inf, np.inf
        columns = (ground[:, 0] - self._grid.left) / self._grid.dx
        rows = (self._grid.top - ground[:, 1]) / self._grid.dy
        return float(columns.min()), float(rows.min()), float(columns.max()), float(rows.max())

    def image(self, columns: Array, rows: Array, heights: Array) -> Array:
        """Source image points ``(..., levels, 2)`` of output positions ``(...)`` at heights ``(..., levels)``."""
        x, y = self._grid.xy(columns, rows)
        levels = heights.shape[-1]
        if self._flat:
            flat = self._to_model(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
            ground = np.repeat(flat, levels, axis=0)
            ground[:, 2] = heights.ravel()
        else:
            plan = np.stack([np.repeat(x.ravel(), levels), np.repeat(y.ravel(), levels), heights.ravel()], axis=1)
            ground = self._to_model(plan)
        return self._model.ground_to_image(ground).reshape(*heights.shape, 2)

    def dem(self, columns: Array, rows: Array) -> Array:
        """DEM sample coordinates ``(..., 2)`` of output pixel positions ``(...)``."""
        x, y = self._grid.xy(columns, rows)
        samples = self._samples(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
        return samples.reshape(*np.shape(columns), 2)


@functools.cache
def _positions(spacing: int) -> tuple[Array, Array]:
    """Return offsets (columns, rows) of lattice nodes from a block's first pixel, each ``(n, n)``."""
    steps = np.arange(0, BLOCK + spacing, spacing, dtype=float)
    columns, rows = np.meshgrid(steps, steps)
    return columns, rows


def _scatter(blocks: list[OutputBlock], area: Array) -> Array:
    """Return `VERIFIED` points of each block ``(blocks, n, 3)``: column and row offsets, normalised height.

    They lie in `area` ``(blocks, 4)``, first row, last row, first column, last column (offsets in pixels). A
    low-discrepancy sequence (Roberts' R3), started at a place that depends on the block: spread more evenly than
    random points, other ones in each block, and the same in every run.
    """
    place = np.array([(block.row, block.column) for block in blocks], dtype=float)
    steps = np.array([0.8191725133961645, 0.6710436067037893, 0.5497004779019703])
    start = np.stack([0.5 + 0.7548776662 * place[:, 0], 0.25 + 0.5698402910 * place[:, 1], 0.3 * place.sum(axis=1)], 1)
    points = np.remainder(start[:, None, :] + np.arange(VERIFIED)[:, None] * steps, 1.0)
    area = np.minimum(area, BLOCK - 1.0)[:, None]
    low = np.concatenate([area[..., 2:3], area[..., 0:1], np.full((*area.shape[:2], 1), -1.0)], axis=2)
    high = np.concatenate([area[..., 3:4], area[..., 1:2], np.full((*area.shape[:2], 1), 1.0)], axis=2)
    return np.asarray(low + points * (high - low))


class Lattices:
    """Makes and verifies the lattices of one output raster; shared by the threads that warp it.

    Attributes
    ----------
    worst : float
        Largest bound (source px) on the error of a block so far; 0 for blocks in which every pixel is projected.
    finest : int
        Smallest spacing so far; 1 where every pixel is projected.
    refined : int
        Number of blocks that needed more than the first lattice.
    """

    def __init__(
        self,
        model: SensorModel,
        surface: Surface,
        grid: Grid,
        size: tuple[int, int],
        *,
        tolerance: float,
        reach: int,
        averages: bool,
    ) -> None:
        self._exact = _Exact(model, surface, grid)
        self._size = size
        self._domain, self._detail = self._exact.domain(), model.detail
        self._tolerance, self._reach, self._averages = tolerance, reach, averages
        self._lock = threading.Lock()
        self.worst, self.finest, self.refined = 0.0, REFINEMENTS[0][0], 0

    def build(self, blocks: list[OutputBlock], terrain: TileHeights) -> list[OutputBlock]:
        """Give each block that has terrain its lattice; return those that see the source."""
        uv = self._nodes_dem(blocks, REFINEMENTS[0][0])
        with_terrain = terrain.ranges(blocks, uv)
        return self._lattices([blocks[k] for k in with_terrain], uv[with_terrain], terrain)

    def _nodes_dem(self, blocks: list[OutputBlock], spacing: int) -> Array:
        columns, rows = self._offsets(blocks, *_positions(spacing))
        return self._exact.dem(columns, rows)

    @staticmethod
    def _offsets(blocks: list[OutputBlock], columns: Array, rows: Array) -> tuple[Array, Array]:
        """Return output positions of pixel centres, ``(blocks, ...)``, at offsets from each block's first pixel."""
        shape = (-1,) + (1,) * columns.ndim
        corner_columns = np.array([block.column for block in blocks], dtype=float).reshape(shape) * BLOCK
        corner_rows = np.array([block.row for block in blocks], dtype=float).reshape(shape) * BLOCK
        return corner_columns + columns + 0.5, corner_rows + rows + 0.5

    # -- lattices ----------------------------------------------------------------------------------------------------

    def _lattices(self, blocks: list[OutputBlock], uv: Array, terrain: TileHeights) -> list[OutputBlock]:
        """Give each block its lattice; return those that see the source."""
        if not blocks:
            return []
        # One call for all blocks of a tile, whatever the memory: the last bits of a result may depend on a call's size.
        error, plan = self._evaluate(blocks, *REFINEMENTS[0], uv)
        limit = self._tolerance / 2
        for spacing, count in REFINEMENTS[1:]:
            failing = np.flatnonzero(error > limit)
            if not len(failing):
                break
            lacking = [k for k in failing if spacing < blocks[k].spacing or plan[k] <= limit]
            step = max(1, _TOGETHER // ((BLOCK // spacing + 1) ** 2 * count))
            for part in (lacking[first : first + step] for first in range(0, len(lacking), step)):
                some = [blocks[k] for k in part]
                error[part], plan[part] = self._evaluate(some, spacing, count, self._nodes_dem(some, spacing))
        for k in np.flatnonzero(error > limit):
            self._project(blocks[k], terrain)
            error[k] = 0.0
        with self._lock:
            self.worst = max(self.worst, float(error.max()))
            self.finest = min(self.finest, *(block.spacing for block in blocks))
            self.refined += sum(block.refinement != REFINEMENTS[0] for block in blocks)
        return [block for block in blocks if block.window is not None]

    def _evaluate(self, blocks: list[OutputBlock], spacing: int, count: int, uv: Array) -> tuple[Array, Array]:
        """Set the lattices of `blocks` from exact model evaluations; return a bound on the error of each ``(blocks,)``.

        Infinite for a block into which the scene may come between nodes that the model does not project. Then the part
        of it that only nodes closer together make smaller.
        """
        columns, rows = self._offsets(blocks, *_positions(spacing))
        middle = np.array([block.middle for block in blocks])[:, None, None, None]
        half = np.array([block.half for block in blocks])[:, None, None, None]
        heights = np.broadcast_to(middle + half * levels(count), (*columns.shape, count))
        image = self._exact.image(columns, rows, heights)
        coefficients = polynomials(image)
        self._set(blocks, spacing, coefficients, image, uv)
        return self._bounds(blocks, image, coefficients, uv)

    def _project(self, block: OutputBlock, terrain: TileHeights) -> None:
        """Give a block the exact image points of all its pixels, each at its own height."""
        columns, rows = self._offsets([block], *_positions(1))
        heights = terrain.heights(block, self._exact.dem(columns, rows)[0])
        image = self._exact.image(columns, rows, heights[None, :, :, None])
        self._set([block], 1, image, image, np.full((1, *heights.shape, 2), 0.5))

    def _set(self, blocks: list[OutputBlock], spacing: int, coefficients: Array, image: Array, uv: Array) -> None:
        for k, (block, box) in enumerate(zip(blocks, _extents(image.reshape(len(blocks), -1, 2)), strict=True)):
            block.spacing, block.nodes, block.dem_nodes, block.image = spacing, coefficients[k], uv[k], image[k]
            block.reach = self._reach
            if self._averages:
                block.box = _box(block)
                block.reach += math.ceil(max(block.box) / 2)
            block.window = self._window_around(box, block.reach)

    def _bounds(self, blocks: list[OutputBlock], image: Array, coefficients: Array, uv: Array) -> tuple[Array, Array]:
        """Return a bound on the error (source px) of each block's lattice where it may show some of the image.

        And the part of it that comes of the distance of the nodes, as far as second differences tell.
        """
        count, spacing = image.shape[1] - 1, blocks[0].spacing
        unknown = np.array([block.window is not None or self._in_domain(block) for block in blocks])
        cells, area = np.empty((len(blocks), count, count), dtype=bool), np.empty((len(blocks), 4))
        lattice_kernel.visible(image, float(self._size[0]), float(self._size[1]), unknown, cells, area)
        points = _scatter(blocks, area * spacing)
        columns, rows = (np.array([getattr(block, name) for block in blocks])[:, None] for name in ("column", "row"))
        output = columns * BLOCK + 0.5 + points[..., 0], rows * BLOCK + 0.5 + points[..., 1]
        middle, half = (np.array([getattr(block, name) for block in blocks])[:, None] for name in ("middle", "half"))
        exact = self._exact.image(*output, (middle + half * points[..., 2])[:, :, None])[:, :, 0]
        error, plan, step = np.empty((3, len(blocks)))
        lattice_kernel.bounds(
            image, coefficients, uv, cells, spacing, points, exact, self._exact.dem(*output), error, plan, step
        )
        # Between nodes farther apart than the model's detail anything may hide.
        error[step > self._detail] = plan[step > self._detail] = np.inf
        return error, plan

    def source_window(
        self, block: OutputBlock, rows: slice = slice(None), columns: slice = slice(None)
    ) -> tuple[int, int, int, int] | None:
        """Return the window of the source (left, top, right, bottom) under some nodes of a block; None if empty."""
        assert block.image is not None
        return self._window_around(_extents(block.image[rows, columns].reshape(1, -1, 2))[0], block.reach)

    def _window_around(self, box: list[float], reach: int) -> tuple[int, int, int, int] | None:
        left, top, right, bottom = box
        if not left < math.inf:
            return None
        pad, (width, height) = reach + _MARGIN, self._size
        left, right = (min(max(side, 0), width) for side in (math.floor(left) - pad, math.ceil(right) + pad))
        top, bottom = (min(max(side, 0), height) for side in (math.floor(top) - pad, math.ceil(bottom) + pad))
        return None if right <= left or bottom <= top else (left, top, right, bottom)

    def _in_domain(self, block: OutputBlock) -> bool:
        left, top, right, bottom = self._domain
        column, row = block.column * BLOCK, block.row * BLOCK
        return left < column + BLOCK and right > column and top < row + BLOCK and bottom > row


class TileHeights:
    """The heights under one tile, read at once or, where memory is short, block by block."""

    def __init__(self, surface: Surface, cubic: bool, window_bytes: int) -> None:
        self._surface, self._cubic, self._window_bytes = surface, cubic, window_bytes
        self._whole: DemWindow | None = None

    def ranges(self, blocks: list[OutputBlock], uv: Array) -> list[int]:
        """Set the height range of each block from its lattice in the DEM; return the indices of those with heights."""
        windows = self._windows(uv.reshape(len(uv), -1, 2))
        present = [k for k, window in enumerate(windows) if window is not None]
        if not present:
            return []
        together = np.array([windows[k] for k in present])
        tile = (*together[:, :2].min(axis=0), *together[:, 2:].max(axis=0))
        if self._fits(tile):
            self._whole = self._read(tile)
        bounds = self._height_ranges(together)
        for k, window, (lowest, highest) in zip(present, together.tolist(), bounds, strict=True):
            # A cubic DEM overshoots by 9/32 of its samples' range at most: what their negative weights sum to.
            extra = 9 / 32 * (highest - lowest) if self._cubic else 0.0
            blocks[k].terrain, blocks[k].middle = tuple(window), (lowest + highest) / 2
            blocks[k].half = max((highest - lowest) / 2 + extra, 0.5)
        return [k for k, (lowest, highest) in zip(present, bounds, strict=True) if lowest <= highest]

    def groups(
        self, blocks: list[OutputBlock]
    ) -> Iterator[tuple[list[OutputBlock], DemWindow, tuple[int, int, int, int]]]:
        """Yield blocks with the heights that they share and the part of the block.

        The part (first row, last row + 1, first column, last column + 1) is the whole block, or a cell of its lattice
        where the DEM is so much finer than the output that even a block's heights do not fit into the memory.
        """
        tile = (0, BLOCK, 0, BLOCK)
        yield from (([block], _NO_TERRAIN, tile) for block in blocks if block.spacing == 1)
        blocks = [block for block in blocks if block.spacing > 1]
        if self._whole is not None:
            if blocks:
                yield blocks, self._whole, tile
            return
        for block in blocks:
            if self._fits(block.terrain):
                yield [block], self._read(block.terrain), tile
                continue
            for cell, nodes in block_cells(block.spacing):
                window = self._window(block.lattice.dem[nodes])
                if window is not None:
                    yield [block], self._read(window), cell

    def heights(self, block: OutputBlock, uv: Array) -> Array:
        """Return the heights ``(BLOCK + 1, BLOCK + 1)`` at DEM points of all pixels of a block; NaN in voids."""
        heights = np.full(uv.shape[:2], np.nan)
        parts: Any = [((), slice(None))] if self._whole is not None or self._fits(block.terrain) else block_cells(1)
        for _, nodes in parts:
            window = self._window(uv[nodes])
            if window is not None:
                heights_at(uv[nodes], self._whole or self._read(window), heights[nodes])
        return heights

    def _fits(self, window: Any) -> bool:
        return (window[2] - window[0]) * (window[3] - window[1]) * 8 <= self._window_bytes

    def _window(self, nodes: Array) -> Window | None:
        """Return the samples (left, top, right, bottom) under lattice nodes, with those that interpolation needs."""
        return self._windows(nodes.reshape(1, -1, 2))[0]

    def _windows(self, nodes: Array) -> list[Window | None]:
        boxes = _extents(nodes)
        return [self._surface.window_around(*box) if box[0] < math.inf else None for box in boxes]

    def _read(self, window: Any) -> DemWindow:
        left, top, right, bottom = (int(value) for value in window)
        heights = self._surface.window(left, top, right - left, bottom - top)
        return DemWindow(heights, left, top, self._cubic)

    def _height_ranges(self, windows: NDArray[np.int64]) -> list[list[float]]:
        """Return lowest and highest height in windows ``(n, 4)``; infinity and minus infinity where all are voids."""
        ranges = np.empty((len(windows), 2))
        if self._whole is not None:
            lattice_kernel.height_ranges(self._whole.heights, self._whole.left, self._whole.top, windows, ranges)
            return ranges.tolist()
        for k, (left, top, right, bottom) in enumerate(windows.tolist()):
            try:
                ranges[k] = self._surface.range_within(left, top, right - left, bottom - top)
            except CoverageError:
                ranges[k] = math.inf, -math.inf
        return ranges.tolist()


def _extents(points: Array) -> list[list[float]]:
    """Return left, top, right, bottom of the finite points ``(blocks, n, 2)`` of each block; infinite without any."""
    boxes = np.empty((len(points), 4))
    lattice_kernel.extents(np.ascontiguousarray(points), boxes)
    return boxes.tolist()


def block_cells(spacing: int) -> Iterator[tuple[tuple[int, int, int, int], tuple[slice, slice]]]:
    """Cut a block into cells for want of memory; yield the pixels of each (see `TileHeights.groups`) and its nodes."""
    step = max(spacing, _CELL)
    for row in range(0, BLOCK, step):
        for column in range(0, BLOCK, step):
            rows, columns = (slice(first // spacing, (first + step) // spacing + 1) for first in (row, column))
            yield (row, row + step, column, column + step), (rows, columns)


def _box(block: OutputBlock) -> tuple[float, float]:
    """Return how many columns and rows of the source one output pixel covers in the mean over a block, at least 1."""
    level = block.lattice.image[:, :, 0]
    across = np.abs(np.diff(level, axis=1)) / block.spacing
    down = np.abs(np.diff(level, axis=0)) / block.spacing
    finite = [part[np.isfinite(part).all(axis=2)] for part in (across, down)]
    if not all(len(part) for part in finite):
        return 1.0, 1.0
    size = np.maximum(finite[0].mean(axis=0) + finite[1].mean(axis=0), 1.0)
    return float(size[0]), float(size[1])
