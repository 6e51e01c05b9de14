r"""The lattice of the warp: exact model evaluations, and how far the interpolation between them is off.

Image coordinates are smooth in (x, y) and height, terrain is not. So in each block of 256 x 256 output pixels the exact
model is evaluated at lattice nodes (every 64 pixels to begin with) at a few heights that span the block's terrain; in
between they are bilinear in plan and a polynomial in height. The height itself comes from the DEM at full resolution
for every pixel. The cost of a pixel thus does not depend on the sensor model.

The error is not assumed but measured: at points spread over each block (in plan and height) the lattice is compared
with the exact model, and the block is refined until the difference is below half of the tolerance. With a block's
parallax :math:`p` (pixels between its lowest and highest terrain), an error :math:`\delta` in DEM samples moves a point
by at most :math:`p\,\delta`, whatever cliffs the DEM has; that is added.

Blocks lie at fixed places of the output grid and are the unit of all decisions, so the output does not depend on tile
size, memory or number of threads.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.crs import GroundTransform
from ortho_pipeline.dem import Surface
from ortho_pipeline.errors import InputError, ModelError
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.raster import Grid

#: Side of a block in output pixels.
BLOCK = 256
#: (lattice spacing in output pixels, number of heights), tried one after the other.
REFINEMENTS = ((64, 3), (32, 3), (16, 3), (16, 5), (8, 5), (8, 7), (4, 7), (2, 7), (1, 9))
#: Points per block at which the lattice is verified.
VERIFIED = 24
#: Source pixels beyond the lattice nodes of a window, for what lies higher or lower between the nodes.
_MARGIN = 4


@dataclass(eq=False)
class Block:
    """One block: where it is, its terrain, its lattice."""

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
    def lattice(self) -> Array:
        """Coefficients ``(ny, nx, levels, 2)`` of the image coordinates at the nodes."""
        assert self.nodes is not None
        return self.nodes

    @property
    def dem_lattice(self) -> Array:
        """DEM coordinates ``(ny, nx, 2)`` of the nodes."""
        assert self.dem_nodes is not None
        return self.dem_nodes


class _Exact:
    """The exact geometry of an output grid: pixels and heights to source image and DEM coordinates."""

    def __init__(self, model: SensorModel, surface: Surface, grid: Grid) -> None:
        self._model, self._surface, self._grid = model, surface, grid
        self._to_model = GroundTransform(grid.crs, model.crs)
        self._to_dem = None if surface.constant_height is not None else GroundTransform(grid.crs, surface.crs)
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
        ground = GroundTransform(self._model.crs, self._grid.crs)(box)
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
        if self._to_dem is None:
            return np.full((*np.shape(columns), 2), 0.5)
        x, y = self._grid.xy(columns, rows)
        plan = self._to_dem(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
        return self._surface.samples_at(plan[:, :2]).reshape(*np.shape(columns), 2)


def _positions(spacing: int) -> tuple[Array, Array]:
    """Return offsets (columns, rows) of lattice nodes from a block's first pixel, each ``(n, n)``."""
    steps = np.arange(0, BLOCK + spacing, spacing, dtype=float)
    columns, rows = np.meshgrid(steps, steps)
    return columns, rows


def _levels(count: int) -> Array:
    """Return normalised heights at which the model is evaluated: Chebyshev-Lobatto nodes of [-1, 1]."""
    return -np.cos(np.pi * np.arange(count) / (count - 1))


def _scatter(blocks: list[Block]) -> tuple[Array, Array, Array]:
    """Return `VERIFIED` points of each block ``(blocks, n)``: column and row offsets, normalised height.

    A low-discrepancy sequence (Roberts' R3), started at a place that depends on the block: spread more evenly than
    random points, other ones in each block, and the same in every run.
    """
    place = np.array([(block.row, block.column) for block in blocks], dtype=float)
    steps = np.array([0.8191725133961645, 0.6710436067037893, 0.5497004779019703])
    start = np.stack([0.5 + 0.7548776662 * place[:, 0], 0.25 + 0.5698402910 * place[:, 1], 0.3 * place.sum(axis=1)], 1)
    points = np.remainder(start[:, None, :] + np.arange(VERIFIED)[:, None] * steps, 1.0)
    return points[..., 0] * (BLOCK - 1), points[..., 1] * (BLOCK - 1), 2 * points[..., 2] - 1


class Lattices:
    """Makes and verifies the lattices of one output raster; shared by the threads that warp it.

    Attributes
    ----------
    worst : float
        Largest error (source px) at a verified point so far.
    finest : int
        Smallest spacing so far.
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
        self._size = np.array(size)
        self._domain = self._exact.domain()
        self._tolerance, self._reach, self._averages = tolerance, reach, averages
        self._lock = threading.Lock()
        self.worst, self.finest, self.refined = 0.0, REFINEMENTS[0][0], 0

    def build(self, blocks: list[Block], terrain: Terrain) -> list[Block]:
        """Give each block that has terrain its lattice; return those that see the source.

        Raises
        ------
        ModelError
            If no lattice holds the tolerance.
        """
        uv = self._nodes_dem(blocks, REFINEMENTS[0][0])
        return self._lattices(blocks, uv, terrain.ranges(blocks, uv))

    def _nodes_dem(self, blocks: list[Block], spacing: int) -> Array:
        columns, rows = self._offsets(blocks, *_positions(spacing))
        return self._exact.dem(columns, rows)

    @staticmethod
    def _offsets(blocks: list[Block], columns: Array, rows: Array) -> tuple[Array, Array]:
        """Return output positions of pixel centres, ``(blocks, ...)``, at offsets from each block's first pixel."""
        shape = (-1,) + (1,) * columns.ndim
        corner_columns = np.array([block.column for block in blocks], dtype=float).reshape(shape) * BLOCK
        corner_rows = np.array([block.row for block in blocks], dtype=float).reshape(shape) * BLOCK
        return corner_columns + columns + 0.5, corner_rows + rows + 0.5

    # -- lattices ----------------------------------------------------------------------------------------------------

    def _lattices(self, blocks: list[Block], uv: Array, with_terrain: list[int]) -> list[Block]:
        """Give each block that has terrain its lattice; return those that see the source."""
        blocks, uv = [blocks[k] for k in with_terrain], uv[with_terrain]
        if not blocks:
            return []
        # One call for all blocks of a tile, whatever the memory: the last bits of a result may depend on a call's size.
        self._evaluate(blocks, *REFINEMENTS[0], uv)
        for block, error in zip(blocks, self._verify(blocks), strict=True):
            final, steps = float(error), iter(REFINEMENTS[1:])
            while final > self._tolerance / 2:
                try:
                    spacing, levels = next(steps)
                except StopIteration:
                    raise ModelError(
                        f"the warp cannot hold {self._tolerance} px (the error is {final:.3g} px)",
                        remedy="allow more with --tolerance, or check the model near this part of the scene",
                    ) from None
                self._evaluate([block], spacing, levels, self._nodes_dem([block], spacing))
                final = float(self._verify([block])[0])
            with self._lock:
                self.worst, self.finest = max(self.worst, final), min(self.finest, block.spacing)
                self.refined += block.spacing != REFINEMENTS[0][0]
        return [block for block in blocks if block.window is not None]

    def _evaluate(self, blocks: list[Block], spacing: int, levels: int, uv: Array) -> None:
        """Set the lattices of `blocks` from exact model evaluations."""
        columns, rows = self._offsets(blocks, *_positions(spacing))
        steps = _levels(levels)
        middle = np.array([block.middle for block in blocks])[:, None, None, None]
        half = np.array([block.half for block in blocks])[:, None, None, None]
        heights = np.broadcast_to(middle + half * steps, (*columns.shape, levels))
        image = self._exact.image(columns, rows, heights)
        polynomial = np.linalg.inv(np.vander(steps, increasing=True))
        coefficients = np.einsum("kl,...la->...ka", polynomial, image)
        for k, block in enumerate(blocks):
            block.spacing, block.nodes, block.dem_nodes = spacing, coefficients[k], uv[k]
            if self._averages:
                block.box = _box(block)
                block.reach = self._reach + math.ceil(max(block.box) / 2)
            else:
                block.reach = self._reach
            block.image = image[k]
            block.window = self.source_window(block)

    def source_window(
        self, block: Block, rows: slice = slice(None), columns: slice = slice(None)
    ) -> tuple[int, int, int, int] | None:
        """Return the window of the source (left, top, right, bottom) under some nodes of a block; None if empty."""
        assert block.image is not None
        points, pad = block.image[rows, columns].reshape(-1, 2), block.reach + _MARGIN
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return None
        size = self._size
        low = np.clip(np.floor(points.min(axis=0)) - pad, 0, size).astype(int)
        high = np.clip(np.ceil(points.max(axis=0)) + pad, 0, size).astype(int)
        return None if (high <= low).any() else (int(low[0]), int(low[1]), int(high[0]), int(high[1]))

    def _verify(self, blocks: list[Block]) -> Array:
        """Return the worst error (source px) of each block's lattice at its verification points ``(blocks,)``."""
        columns, rows, t = _scatter(blocks)
        if blocks[0].spacing == 1:
            columns, rows = np.floor(columns), np.floor(rows)  # nothing between the nodes is ever used
        corner_columns = np.array([block.column for block in blocks])[:, None] * BLOCK + 0.5
        corner_rows = np.array([block.row for block in blocks])[:, None] * BLOCK + 0.5
        middle = np.array([block.middle for block in blocks])[:, None]
        half = np.array([block.half for block in blocks])[:, None]
        output = columns + corner_columns, rows + corner_rows
        exact = self._exact.image(*output, (middle + half * t)[:, :, None])[:, :, 0]
        exact_uv = self._exact.dem(*output)
        image, uv, parallax = _interpolate(blocks, columns, rows, t)
        with np.errstate(invalid="ignore"):
            inside = [((points >= -2) & (points <= self._size + 2)).all(axis=2) for points in (image, exact)]
            errors = np.hypot(*np.moveaxis(image - exact, 2, 0)) + parallax * np.abs(uv - exact_uv).sum(axis=2)
        # A point that one of them puts into the image and the other nowhere is infinitely wrong.
        errors[np.isnan(errors)] = np.inf
        worst = np.where(inside[0] | inside[1], errors, 0.0).max(axis=1)
        for k, block in enumerate(blocks):
            beside = block.window is not None or self._in_domain(block)
            if block.spacing > 1 and beside and np.isnan(block.lattice).any():
                worst[k] = np.inf  # the scene may hide between nodes that lie outside of the model's domain
        return worst

    def _in_domain(self, block: Block) -> bool:
        left, top, right, bottom = self._domain
        column, row = block.column * BLOCK, block.row * BLOCK
        return left < column + BLOCK and right > column and top < row + BLOCK and bottom > row


class Terrain:
    """The heights under one tile, read at once or, where memory is short, block by block."""

    def __init__(self, surface: Surface, cubic: bool, window_bytes: int) -> None:
        self._surface, self._cubic, self._window_bytes = surface, cubic, window_bytes
        self._whole: tuple[Array, tuple[int, int]] | None = None

    def ranges(self, blocks: list[Block], uv: Array) -> list[int]:
        """Set the height range of each block from its lattice in the DEM; return the indices of those with heights."""
        windows = [self._window(nodes) for nodes in uv]
        present = [k for k, window in enumerate(windows) if window is not None]
        if not present:
            return []
        together = np.array([windows[k] for k in present])
        whole = (*together[:, :2].min(axis=0), *together[:, 2:].max(axis=0))
        if self._fits(whole):
            self._whole = self._read(whole), (int(whole[0]), int(whole[1]))
        return [k for k in present if self._range(blocks[k], windows[k])]

    def groups(
        self, blocks: list[Block]
    ) -> Iterator[tuple[list[Block], Array, tuple[int, int], tuple[int, int, int, int]]]:
        """Yield blocks with the heights that they share, the place of the first sample, and the part of the block.

        The part (first row, last row + 1, first column, last column + 1) is the whole block, or a cell of its lattice
        where the DEM is so much finer than the output that even a block's heights do not fit into the memory.
        """
        whole = (0, BLOCK, 0, BLOCK)
        if self._whole is not None:
            if blocks:
                yield blocks, *self._whole, whole
            return
        for block in blocks:
            if self._fits(block.terrain):
                yield [block], self._read(block.terrain), block.terrain[:2], whole
                continue
            step = block.spacing
            for j in range(BLOCK // step):
                for i in range(BLOCK // step):
                    window = self._window(block.dem_lattice[j : j + 2, i : i + 2])
                    if window is not None:
                        cell = (j * step, (j + 1) * step, i * step, (i + 1) * step)
                        yield [block], self._read(window), window[:2], cell

    def _fits(self, window: Any) -> bool:
        return (window[2] - window[0]) * (window[3] - window[1]) * 8 <= self._window_bytes

    def _window(self, nodes: Array) -> tuple[int, int, int, int] | None:
        """Return the samples (left, top, right, bottom) under lattice nodes, with those that interpolation needs."""
        if self._surface.constant_height is not None:
            return 0, 0, 2, 2
        points = nodes.reshape(-1, 2)
        points = points[np.isfinite(points).all(axis=1)]
        rows, columns = self._surface.shape
        if not len(points):
            return None
        low, high = np.floor(points.min(axis=0)).astype(int) - 2, np.floor(points.max(axis=0)).astype(int) + 5
        if self._surface.fill in ("error", "mask"):  # with any other rule there are heights beyond the DEM
            low, high = np.maximum(low, -2), np.minimum(high, (columns + 2, rows + 2))
        return None if (high - low < 2).any() else (int(low[0]), int(low[1]), int(high[0]), int(high[1]))

    def _read(self, window: Any) -> Array:
        left, top, right, bottom = (int(value) for value in window)
        if self._surface.constant_height is not None:
            return np.full((2, 2), float(self._surface.constant_height))
        return self._surface.window(left, top, right - left, bottom - top)

    def _range(self, block: Block, window: Any) -> bool:
        left, top, right, bottom = block.terrain = window
        if self._whole is None:
            try:
                lowest, highest = self._surface.range_within(left, top, right - left, bottom - top)
            except InputError:
                return False
        else:
            heights, (first, above) = self._whole
            under = heights[top - above : bottom - above, left - first : right - first]
            if not np.isfinite(under).any():
                return False
            lowest, highest = float(np.nanmin(under)), float(np.nanmax(under))
        # A cubic DEM overshoots between its samples by up to a quarter of their range.
        extra = 0.25 * (highest - lowest) if self._cubic else 0.0
        block.middle = (lowest + highest) / 2
        block.half = max((highest - lowest) / 2 + extra, 0.5)
        return True


def _interpolate(blocks: list[Block], columns: Array, rows: Array, t: Array) -> tuple[Array, Array, Array]:
    """Return what the kernel gets from lattices of one spacing at points ``(blocks, n)`` of each.

    Image points ``(blocks, n, 2)``, DEM points ``(blocks, n, 2)``, parallax ``(blocks, n)`` over a block's heights.
    """
    spacing, which = blocks[0].spacing, np.arange(len(blocks))[:, None]
    i, j = (columns // spacing).astype(int), (rows // spacing).astype(int)
    fx, fy = columns / spacing - i, rows / spacing - j

    def plan(nodes: Array) -> Array:
        shape = (*fx.shape, *[1] * (nodes.ndim - 3))
        across, down = fx.reshape(shape), fy.reshape(shape)
        # A node without weight may be NaN (outside of the model) and must not count.
        upper = np.where(across == 0, nodes[which, j, i], _mean(nodes[which, j, i], nodes[which, j, i + 1], across))
        below = nodes[which, j + 1, i]
        lower = np.where(across == 0, below, _mean(below, nodes[which, j + 1, i + 1], across))
        return np.where(down == 0, upper, _mean(upper, lower, down))

    coefficients = plan(np.stack([block.lattice for block in blocks]))
    powers = t[:, :, None] ** np.arange(coefficients.shape[2])
    image = np.einsum("bnk,bnka->bna", powers, coefficients)
    parallax = 2 * np.hypot(coefficients[:, :, 1, 0], coefficients[:, :, 1, 1])
    return image, plan(np.stack([block.dem_lattice for block in blocks])), parallax


def _mean(first: Array, second: Array, share: Array) -> Array:
    return first + (second - first) * share


def _box(block: Block) -> tuple[float, float]:
    """Return how many columns and rows of the source one output pixel covers in the mean over a block, at least 1."""
    level = block.lattice[:, :, 0]
    across = np.abs(np.diff(level, axis=1)) / block.spacing
    down = np.abs(np.diff(level, axis=0)) / block.spacing
    finite = [part[np.isfinite(part).all(axis=2)] for part in (across, down)]
    if not all(len(part) for part in finite):
        return 1.0, 1.0
    size = np.maximum(finite[0].mean(axis=0) + finite[1].mean(axis=0), 1.0)
    return float(size[0]), float(size[1])
