"""What an ortho cannot show: ground that other terrain hides from the sensor, exactly against the surface.

Such a pixel would get the image of the terrain that hides it, which the ortho then shows twice. From every pixel the
line of sight is followed upwards over the surface, until it is above all of it (`visibility_kernel`). The lines are
straight, and their directions vary so smoothly that they are exact at a few nodes of a tile and heights, bilinear in
plan and quadratic in height between. Nodes lie at fixed places of the ortho, and a line does not know how much of the
surface was read, so the result does not depend on tiles, memory or threads.

With cubic interpolation of the heights of an ortho, the surface looked over is the bilinear one all the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import CoverageError
from ortho_pipeline.models.base import Array
from ortho_pipeline.surface.base import Surface, Window
from ortho_pipeline.surface.dem import DemSurface
from ortho_pipeline.surface.rays import levels, polynomials
from ortho_pipeline.warp.quality import visibility_kernel as kernel
from ortho_pipeline.warp.quality.sight import Sight

#: Pixels between nodes: of places in the DEM, and of directions.
NEAR, FAR = 128, 256
#: Heights at which a direction is exact.
_LEVELS = 3
#: Height (m) over which the direction of a line is measured in samples of the DEM.
_RISE = 100.0
_EARTH = 6_371_000.0
#: Least side of a piece of a tile whose heights are too many for the memory.
_PIECE = 64
#: Samples of a DEM that is looked at as a whole. Larger ones are looked at around the ortho: that area grows so often,
#: because higher terrain was found in it, and has a node of every `NEAR` pixels for so many pixels of its longer side.
_SMALL, _WIDER, _FEWER = 16_000_000, 12, 16_384
#: Memory (B) per sample of the terrain that is looked over.
_CELL_BYTES = 48
#: Side (px) of the regions of an ortho that are first asked whether anything in them is steep, if so many pixels or
#: more come to a sample.
_REGION, _PIXELS_PER_SAMPLE = 4096, 16
#: Lines count as below terrain only where they are by more than rounding (m).
_SLACK = 1e-3

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
        From output positions and heights to output pixels ``(n, 2)`` per metre upwards, where lines do not go to the
        sensor.
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
        self._highest = self._highest_ground(surface) if isinstance(surface, DemSurface) else -math.inf
        self._calm: dict[tuple[int, int], bool] = {}

    def look(self, left: int, top: int, width: int, height: int) -> Classes:
        """Return `CLEAR`, `HIDDEN` or `VOID` (no height) of a window of the ortho ``(height, width)``.

        A window begins at a multiple of `FAR`.
        """
        out = np.zeros((height, width), dtype=np.uint8)
        if isinstance(self._surface, DemSurface) and not self._is_calm(left // _REGION, top // _REGION):
            self._part(self._rays(left, top, width, height), 0, 0, out)
        return out

    def _is_calm(self, column: int, row: int) -> bool:
        """Return whether a region of the ortho has no void and no terrain as steep as a line of sight.

        It is the cheapest look at the tiles of most terrain. Samples that are nearly as dense as pixels are not looked
        at twice.
        """
        known = self._calm.get((column, row))
        if known is None:
            grid, left, top = self._sight.grid, column * _REGION, row * _REGION
            width, height = min(_REGION, grid.width - left), min(_REGION, grid.height - top)
            rays = self._rays(left, top, width, height)
            ends = _extremes(rays.slopes)
            most = min(self._bytes / _CELL_BYTES, width * height / _PIXELS_PER_SAMPLE)
            terrain = self._terrain(rays.samples.reshape(-1, 2), ends, most)
            known = terrain is not None and not terrain.void and not kernel.is_steep(terrain.heights, *ends)
            # Two threads that ask at once both find out.
            self._calm[column, row] = known
        return known

    # -- lines of sight ----------------------------------------------------------------------------------------------

    def _rays(self, left: int, top: int, width: int, height: int, sparse: int = 1) -> kernel.Rays:
        near, far = (self._nodes(left, top, width, height, sparse * spacing) for spacing in (NEAR, FAR))
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
            samples,
            NEAR,
            directions.reshape(*shape, _LEVELS, 2),
            FAR,
            self._middle,
            self._half,
            square / (2 * _EARTH),
        )

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
        there = self._samples(columns + _RISE * way[:, 0], rows + _RISE * way[:, 1])
        metres = np.einsum("nij,nj->ni", self._sight.metres(columns, rows, heights), way)
        return (there - self._samples(columns, rows)) / _RISE, np.hypot(*metres.T)

    def _to_sensor(self, columns: Array, rows: Array, heights: Array) -> Array:
        # A line goes against the displacement of what lies higher.
        return -self._sight.seen(columns, rows, heights).displacement

    # -- pieces ------------------------------------------------------------------------------------------------------

    def _part(self, rays: kernel.Rays, row: int, column: int, out: Classes) -> None:
        """Fill a part of a tile, which begins with a row and a column of it; in halves where memory is short."""
        height, width = out.shape
        near, far = (
            tuple(slice(at // step, -(-(at + side) // step) + 1) for at, side in ((row, height), (column, width)))
            for step in (NEAR, FAR)
        )
        slopes = rays.slopes[far]
        ends = _extremes(slopes)
        most = math.inf if max(height, width) <= _PIECE else self._bytes / _CELL_BYTES
        terrain = self._terrain(rays.samples[near].reshape(-1, 2), ends, most)
        if terrain is None:
            half = max(_PIECE, max(height, width) // 2 // _PIECE * _PIECE)
            for j in range(0, height, half):
                for i in range(0, width, half):
                    self._part(rays, row + j, column + i, out[j : j + half, i : i + half])
        elif terrain.high < terrain.low:
            out[:] = kernel.VOID
        else:
            _look(rays, terrain, ends, row, column, out)

    def _terrain(self, places: Array, ends: tuple[Array, Array], most: float) -> _Terrain | None:
        """Return the terrain that lines from samples ``(n, 2)`` may meet; None if that is more samples than `most`.

        Lines begin no lower than the lowest ground under the places, and end above the highest ground of all.
        """
        low, high, rise = math.inf, -math.inf, 0.0
        window, heights, void = None, np.empty((0, 0)), 0
        for _ in range(2):
            wanted = self._window_of(places, ends, rise)
            if wanted is None:
                return _Terrain(heights, (0, 0, 0, 0), math.inf, -math.inf, True)
            if wanted != window:
                left, top, right, bottom = window = wanted
                if (right - left) * (bottom - top) > most:
                    return None
                heights = self._surface.window(left, top, right - left, bottom - top)
                low, high, void = kernel.extremes(heights)
            rise = max(self._highest - low, 0.0) if low <= high else 0.0
        assert window is not None
        inside = (places >= window[:2]).all() and (places <= np.subtract(window[2:], 1)).all()
        return _Terrain(heights, window, low, high, void > 0 or not inside)

    def _window_of(self, places: Array, ends: tuple[Array, Array], rise: float) -> Window | None:
        """Return the samples under lines from places until they have risen so far (m)."""
        return self._surface.window_under(np.concatenate([places, *(places + rise * end for end in ends)]))

    def _highest_ground(self, surface: DemSurface) -> float:
        """Return the height (m) of the highest terrain that lines from the ortho may meet, the same for all tiles.

        Of a DEM that is not large that is its highest sample. Of others the area is looked at that lines cross while
        they rise by its range of heights: a summit beyond flat ground may be missed.
        """
        (rows, columns), grid, highest = surface.shape, self._sight.grid, -math.inf
        try:
            if rows * columns <= _SMALL:
                return surface.height_range[1]
            rays = self._rays(0, 0, grid.width, grid.height, max(1, max(grid.width, grid.height) // _FEWER))
            places, ends, rise = rays.samples.reshape(-1, 2), _extremes(rays.slopes), 2 * self._half
            for _ in range(_WIDER):
                window = self._window_of(places, ends, rise)
                if window is None:
                    break
                left, top, right, bottom = window
                low, highest = surface.range_within(left, top, right - left, bottom - top)
                if highest - low <= rise:
                    break
                rise = highest - low
        except CoverageError:
            pass  # no height at all
        return highest


class _Terrain(NamedTuple):
    """Heights of a window, the least and the greatest, and whether places are without."""

    heights: Array
    window: Window
    low: float
    high: float
    void: bool


def _look(rays: kernel.Rays, terrain: _Terrain, ends: tuple[Array, Array], row: int, column: int, out: Classes) -> None:
    """Fill a part of a tile, which begins with a row and a column of it, in a terrain that has heights."""
    heights, (left, top, _, _), low, high, void = terrain
    if _across(ends):
        # Compiled code follows lines from row to row.
        heights, left, top = heights.T, top, left
        ends = ends[0][::-1], ends[1][::-1]
        rays = rays._replace(
            samples=np.ascontiguousarray(rays.samples[..., ::-1]), slopes=np.ascontiguousarray(rays.slopes[..., ::-1])
        )
    heights = np.ascontiguousarray(heights)
    tops = np.empty((heights.shape[0] - 1, heights.shape[1] - 1))
    squares = np.empty(tuple(-(-side // (1 << kernel.SQUARE_BITS)) for side in tops.shape))
    highest = float(kernel.find_steep(heights, void, *ends, tops, squares))
    if highest > -np.inf:
        above, below = _bounds(heights, tops, highest, ends, high - low, rays.bend)
    elif void:
        above, below = np.full(tops.shape, -np.inf), np.full(tops.shape, -np.inf)
    else:
        return
    known = np.empty(tops.shape, dtype=np.uint8)
    kernel.find_known(heights, above, below, known)
    relief = kernel.Relief(heights, left, top, tops, squares, above, below, known, highest)
    kernel.look(rays, relief, row, column, out)


def _extremes(slopes: Array) -> tuple[Array, Array]:
    """Return the least and the greatest samples per metre upwards ``(2,)`` of polynomials ``(rows, columns, n, 2)``."""
    steps = np.linspace(-1.5, 1.5, 7)[:, None] ** np.arange(slopes.shape[2])
    values = (steps @ slopes.reshape(-1, *slopes.shape[2:])).reshape(-1, 2)
    low, high = values.min(axis=0), values.max(axis=0)
    # A hair more than at the places that were looked at.
    margin = 0.01 * np.abs(values).max(axis=0)
    return low - margin, high + margin


def _across(ends: tuple[Array, Array]) -> bool:
    """Return whether lines surely move more across the samples than down."""
    least = np.where(ends[0] * ends[1] > 0, np.minimum(*np.abs(ends)), 0.0)
    return bool(least[0] > least[1])


def _bounds(
    heights: Array, tops: Array, highest: float, ends: tuple[Array, Array], relief: float, bend: float
) -> tuple[Array, Array]:
    """Return heights from which on lines of sight in a cell meet nothing any more, and up to which they meet something.

    Where lines may go down the rows or up, only the highest of all bounds them.
    """
    (across, down), (across_end, down_end) = ends
    if down * down_end > 0:
        slow, fast = sorted((abs(down), abs(down_end)))
        aside = np.outer([across, across_end], [1 / slow, 1 / fast])
        middle, spread = (aside.max() + aside.min()) / 2, (aside.max() - aside.min()) / 2
        if spread < 1.0:
            forward = 1 if down > 0 else -1
            slack = bend * relief**2 + _SLACK
            course = kernel.Course(
                forward, 1 / fast, 1 / slow, float(middle), float(spread), slack, math.ceil(relief * fast)
            )
            above, below = np.empty(tops.shape), np.empty(tops.shape)
            kernel.find_bounds(course, heights, tops, above, below)
            return above, below
    return np.full(tops.shape, highest), np.full(tops.shape, -np.inf)
