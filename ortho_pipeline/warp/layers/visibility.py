"""What an ortho cannot show: ground that other terrain hides from the sensor, exactly against the surface.

Such a pixel would get the image of what stands in front of it, which the ortho then shows twice. From every pixel the
line of sight is followed upwards over the surface, until it is above all of it (`visibility_kernel`). The lines are
straight, and their directions vary so smoothly that they are exact at a few nodes of a tile and heights, bilinear in
plan and quadratic in height between. Nodes lie at fixed places of the ortho, and a line does not know how much of the
surface was read, so the result does not depend on tiles, memory or threads.

With cubic interpolation of the heights of an ortho, the surface looked over is the bilinear one all the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.models.base import Array
from ortho_pipeline.surface.base import Surface, Window
from ortho_pipeline.surface.dem import DemSurface
from ortho_pipeline.surface.rays import levels, polynomials
from ortho_pipeline.warp.layers import visibility_kernel as kernel
from ortho_pipeline.warp.layers.sight import Sight

#: Pixels between nodes: of places in the DEM, and of directions.
NEAR, FAR = 128, 256
#: Heights at which a direction is exact.
_LEVELS = 3
#: Height (m) over which the direction of a line is measured in samples of the DEM.
_RISE = 100.0
_EARTH = 6_371_000.0
#: Least side of a piece of a tile whose heights are too many for the memory.
_PIECE = 64
#: So often the window of a piece grows, because higher terrain was found in it.
_WIDER = 12

Classes = NDArray[np.uint8]


class Visibility:
    """Looks from the places of an ortho along their lines of sight; safe to use from several threads.

    Parameters
    ----------
    heights : (float, float)
        Lowest and highest ground of the scene, about.
    window_bytes : int
        Of heights that may be held at once.
    way : callable, optional
        From output positions and heights to metres east and north on the map ``(n, 2)`` per metre upwards, where lines
        do not go to the sensor.
    """

    def __init__(
        self,
        sight: Sight,
        surface: Surface,
        heights: tuple[float, float],
        window_bytes: int,
        *,
        way: Callable[[Array, Array, Array], Array] | None = None,
    ) -> None:
        self._sight, self._surface, self._bytes = sight, surface, window_bytes
        self._way = way or self._to_sensor
        low, high = heights
        self._middle, self._half = (low + high) / 2, max((high - low) / 2, 1.0)
        self._sampler = surface.sampler(sight.grid.crs)

    def look(self, left: int, top: int, width: int, height: int) -> Classes:
        """Return `CLEAR`, `HIDDEN` or `VOID` (no height) of a window of the ortho ``(height, width)``.

        A window begins at a multiple of `FAR`.
        """
        out = np.zeros((height, width), dtype=np.uint8)
        if isinstance(self._surface, DemSurface):
            self._part(self._rays(left, top, width, height), 0, 0, out)
        return out

    # -- lines of sight ----------------------------------------------------------------------------------------------

    def _rays(self, left: int, top: int, width: int, height: int) -> kernel.Rays:
        near, far = self._nodes(left, top, width, height, NEAR), self._nodes(left, top, width, height, FAR)
        shape = near[0].shape
        samples = self._samples(near[0].ravel(), near[1].ravel()).reshape(*shape, 2)
        shape = far[0].shape
        columns, rows = far[0].ravel(), far[1].ravel()
        count, heights = len(rows), np.repeat(self._middle + self._half * levels(_LEVELS), len(rows))
        slopes, tangents = self._slopes(np.tile(columns, _LEVELS), np.tile(rows, _LEVELS), heights)
        # Where the model does not project there is no image either.
        directions = np.nan_to_num(polynomials(slopes.reshape(_LEVELS, count, 2).swapaxes(0, 1)))
        square = float(np.nanmax(tangents**2)) if np.isfinite(tangents).any() else 0.0
        return kernel.Rays(
            samples, NEAR, directions.reshape(*shape, _LEVELS, 2), FAR, self._middle, self._half,
            square / (2 * _EARTH),
        )  # fmt: skip

    @staticmethod
    def _nodes(left: int, top: int, width: int, height: int, spacing: int) -> tuple[Array, Array]:
        columns, rows = np.meshgrid(
            left + 0.5 + spacing * np.arange(-(-width // spacing) + 1.0),
            top + 0.5 + spacing * np.arange(-(-height // spacing) + 1.0),
        )
        return columns, rows

    def _samples(self, columns: Array, rows: Array) -> Array:
        x, y = self._sight.grid.xy(columns, rows)
        return self._sampler(np.stack([x, y, np.zeros(len(x))], axis=1))

    def _slopes(self, columns: Array, rows: Array, heights: Array) -> tuple[Array, Array]:
        """Return samples of the DEM per metre upwards ``(n, 2)``, and metres along the ground per metre upwards."""
        way = self._way(columns, rows, heights)
        step = _RISE * way * [1.0, -1.0] / self._sight.metres(columns, rows)
        there = self._samples(columns + step[:, 0], rows + step[:, 1])
        return (there - self._samples(columns, rows)) / _RISE, np.hypot(*way.T)

    def _to_sensor(self, columns: Array, rows: Array, heights: Array) -> Array:
        # A line goes against the displacement of what lies higher.
        return -self._sight.seen(columns, rows, heights).displacement

    # -- pieces ------------------------------------------------------------------------------------------------------

    def _part(self, rays: kernel.Rays, row: int, column: int, out: Classes) -> None:
        """Fill a part of a tile, which begins with a row and a column of it; in halves where memory is short."""
        height, width = out.shape
        relief = self._relief(rays, row, column, height, width, least=max(height, width) <= _PIECE)
        if relief is not None:
            if relief.highest > -np.inf or np.isnan(relief.heights).any():
                kernel.look(rays, relief, row, column, out)
            return
        half = max(_PIECE, max(height, width) // 2 // _PIECE * _PIECE)
        for j in range(0, height, half):
            for i in range(0, width, half):
                self._part(rays, row + j, column + i, out[j : j + half, i : i + half])

    def _relief(
        self, rays: kernel.Rays, row: int, column: int, height: int, width: int, *, least: bool
    ) -> kernel.Relief | None:
        """Return the terrain that lines from a part of a tile may meet; None if that is too much for the memory."""
        near, far = (
            tuple(slice(at // step, -(-(at + side) // step) + 1) for at, side in ((row, height), (column, width)))
            for step in (NEAR, FAR)
        )
        places, ends = rays.samples[near].reshape(-1, 2), _extremes(rays.slopes[far])
        rise, heights, window = 0.0, None, None
        for _ in range(_WIDER):
            swept = np.concatenate([places, *(places + rise * end for end in ends)])
            wanted = self._surface.window_under(swept)
            if wanted is None:
                return _empty()
            if wanted != window:
                window = wanted
                if not least and (window[2] - window[0]) * (window[3] - window[1]) * 8 > self._bytes:
                    return None
                heights = self._surface.window(window[0], window[1], window[2] - window[0], window[3] - window[1])
            assert heights is not None
            if np.isnan(heights).all():
                return _empty()
            range_here = float(np.nanmax(heights) - np.nanmin(heights))
            if range_here <= rise:
                break
            rise = range_here
        assert window is not None
        return _relief(np.ascontiguousarray(heights), window, ends)


def _extremes(slopes: Array) -> tuple[Array, Array]:
    """Return the least and the greatest samples per metre upwards ``(2,)`` of polynomials ``(rows, columns, n, 2)``."""
    steps = np.linspace(-1.5, 1.5, 7)[:, None] ** np.arange(slopes.shape[2])
    values = (steps @ slopes.reshape(-1, *slopes.shape[2:])).reshape(-1, 2)
    low, high = values.min(axis=0), values.max(axis=0)
    # A hair more than at the places that were looked at.
    margin = 0.01 * np.abs(values).max(axis=0)
    return low - margin, high + margin


def _relief(heights: Array, window: Window, ends: tuple[Array, Array]) -> kernel.Relief:
    steep = np.empty((heights.shape[0] - 1, heights.shape[1] - 1), dtype=np.bool_)
    squares = np.empty(tuple(-(-side // (1 << kernel.SQUARE_BITS)) for side in steep.shape))
    highest = kernel.find_steep(heights, ends[0], ends[1], steep, squares)
    return kernel.Relief(heights, window[0], window[1], steep, squares, _bounds(squares, ends), float(highest))


def _bounds(squares: Array, ends: tuple[Array, Array]) -> Array:
    """Return the heights from which on lines of sight in a square meet nothing any more.

    Lines go along the axis in which they move most; where they may go either way, only the highest of all bounds them.
    """
    low, high = ends
    least, most = (
        np.where(low * high > 0, np.minimum(np.abs(low), np.abs(high)), 0.0),
        np.maximum(np.abs(low), np.abs(high)),
    )
    axis = int(np.argmax(least))
    if least[axis] == 0.0:
        return np.full(squares.shape, squares.max())
    # Rows or columns of squares that a line may move sideways while it crosses one.
    aside = np.sort([low[1 - axis] / least[axis], high[1 - axis] / least[axis]])
    first, last = min(0, int(np.floor(aside[0]))), max(0, int(np.ceil(aside[1])))
    along = np.ascontiguousarray(squares if axis == 0 else squares.T)
    bounds = np.empty_like(along)
    forward = 1 if low[axis] > 0 else -1
    rise = (1 << kernel.SQUARE_BITS) / most[axis]
    kernel.find_bounds(along, forward, float(rise), first, last, np.empty_like(along), bounds)
    return np.ascontiguousarray(bounds if axis == 0 else bounds.T)


def _empty() -> kernel.Relief:
    """Return terrain that is void."""
    none: Any = np.zeros((1, 1), dtype=np.bool_)
    return kernel.Relief(
        np.full((2, 2), np.nan), 0, 0, none, np.full((1, 1), -np.inf), np.full((1, 1), -np.inf), -np.inf
    )
