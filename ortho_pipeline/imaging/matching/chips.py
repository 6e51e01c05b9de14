"""Chips: small windows of a scene, and what a target shows there, rendered into the geometry of the scene.

Model and surface bring the target into the pixels of the scene, so both chips differ only by a shift: no rotation, no
scale, no relief displacement. Each chip has a lattice of positions in the DEM and in the target, as polynomials in
height. Compiled code follows the ray of each pixel, so the cost does not depend on the sensor model.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import CoverageError
from ortho_pipeline.imaging.matching.kernels import chip_kernel
from ortho_pipeline.imaging.matching.targets import SceneView, Target
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.intensity import EXACT
from ortho_pipeline.surface import ray_kernel
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.rays import LEVELS, curve_nodes, levels, polynomials

Pixels = NDArray[np.float32]
#: Nodes per side of a chip's lattice, increased until its error (px of the target) is small enough.
_NODES, _EXACT = (3, 5, 9, 17), 0.002
#: Largest distance between nodes (px), and number of DEM samples per side.
_SPACING, _PLACES = 128.0, 3
#: Rays meet the surface within this height (m): a thousandth of a pixel if a metre moves a third of one.
_TOLERANCE = 0.003
#: Largest window of a target or a DEM for one chip (samples); a larger one means a wrong model.
_LARGEST = 64_000_000
#: A target that shows more than this part of a chip is enough; no other one is tried.
_NEARLY_ALL = 0.95
#: Number of chips whose lattice is compared with the model.
_PROBED = 24


def scene_chips(view: SceneView, origins: NDArray[np.int_], size: int, factor: int) -> Pixels:
    """Return intensities ``(n, size, size)`` of chips of `size` means of `factor` x `factor` pixels.

    Parameters
    ----------
    origins : (n, 2)
        Column and row of their first pixels.
    """
    read = [view.intensity.read(int(column), int(row), size, size, factor) for column, row in origins]
    return np.array(read, dtype=np.float32).reshape(len(origins), size, size)


class Renderer:
    """Renders targets at chips of a scene; for each chip the first target that shows nearly all of it.

    The lattices of all chips are made at once, because models are fastest for many points. Threads may share the
    rendering.
    """

    def __init__(
        self, view: SceneView, targets: Sequence[Target], origins: NDArray[np.int_], size: int, factor: int
    ) -> None:
        self._targets, self._size = targets, size
        self._surface = view.surface
        self._nodes = [_Nodes(view, target, np.asarray(origins, dtype=float), size * factor) for target in targets]

    def of(self, targets: Sequence[Target]) -> Renderer:
        """Return a renderer of the same chips for other bands of the same targets."""
        other = copy.copy(self)
        other._targets = targets
        return other

    def render(self, index: NDArray[np.int_]) -> Pixels:
        """Return the chips with these numbers ``(n, size, size)``; NaN where no target shows anything."""
        out = np.full((len(index), self._size, self._size), np.nan, dtype=np.float32)
        places = np.empty((self._size, self._size, 2))
        chip = np.empty((self._size, self._size), dtype=np.float32)
        for row, k in enumerate(index.tolist()):
            share = 0.0
            for target, nodes in zip(self._targets, self._nodes, strict=True):
                if share >= _NEARLY_ALL:
                    break
                if not nodes.positions(k, self._surface, places):
                    continue
                chip[:] = np.nan
                _read(target, places, chip)
                seen = float(np.isfinite(chip).mean())
                if seen > share:
                    out[row], share = chip, seen
        return out


def _read(target: Target, places: Array, out: Pixels) -> None:
    """Fill `out` with the intensities of a target at places ``(rows, columns, 2)``."""
    extent = np.empty(6)
    chip_kernel.extent(places, extent)
    if not np.isfinite(extent).all():
        return
    low, high = np.floor(extent[:2]), np.ceil(extent[2:4])
    size = target.intensity.width, target.intensity.height
    if (high < 0).any() or low[0] > size[0] or low[1] > size[1]:
        return
    # Pixels of the target in a chip pixel; several are averaged, or fine detail would become false structure.
    factor = max(1, round(math.sqrt(extent[4] * extent[5])))
    left, top = (int(value) - chip_kernel.TAPS // 2 * factor for value in low)
    columns, rows = (
        math.ceil((last - first) / factor) + chip_kernel.TAPS + 1 for first, last in zip(low, high, strict=True)
    )
    if columns * rows * min(factor, EXACT) ** 2 > _LARGEST:
        return
    pixels = target.intensity.read(left, top, columns, rows, factor)
    chip_kernel.sample(pixels, float(left), float(top), float(factor), places, out)


class _Nodes:
    """The lattices of chips: `coefficients` ``(n, m, m, 5, 4)``, the windows of the DEM, and their heights."""

    def __init__(self, view: SceneView, target: Target, origins: Array, extent: int) -> None:
        self._view, self._target, self._origins, self._extent = view, target, origins, extent
        self._sampler = view.surface.sampler(view.model.crs)
        count = len(origins)
        self.windows: list[tuple[int, int, int, int]] = [(0, 0, 0, 0)] * count
        self.middle, self.half = np.zeros(count), np.ones(count)
        self.seen = self._heights()
        self.coefficients = np.zeros((count, _NODES[0], _NODES[0], LEVELS, 4))
        for nodes in (nodes for nodes in _NODES if extent / (nodes - 1) <= _SPACING or nodes == _NODES[-1]):
            self.coefficients = self._evaluate(np.arange(count), nodes)
            if self._error(nodes) <= _EXACT:
                break
        self.shown = np.zeros(count, dtype=bool)
        # A chip outside the domain of a model has no pixels; the others are not affected.
        self.shown[self.seen] = np.isfinite(self.coefficients[self.seen]).any(axis=(1, 2, 3, 4))

    def positions(self, k: int, surface: Surface, places: Array) -> bool:
        """Fill the target coordinates of the pixels of a chip; return False if the target shows nothing."""
        left, top, right, bottom = self.windows[k]
        if not self.shown[k] or (right - left) * (bottom - top) > _LARGEST:
            return False
        heights = surface.window(left, top, right - left, bottom - top)
        nodes = curve_nodes(self.coefficients[k])
        rows, columns = places.shape[:2]
        # Pixel centres, in units of nodes.
        across, down = ((np.arange(count) + 0.5) / count * (len(nodes) - 1) for count in (columns, rows))
        pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        curves = np.empty((nodes.shape[2], len(pixels)))
        ray_kernel.curves_at(nodes, pixels, curves)
        terrain = ray_kernel.terrain_of(heights, left, top, self.middle[k], self.half[k], nodes)
        chip_kernel.positions(curves, ray_kernel.meet(curves, terrain, _TOLERANCE), places)
        return True

    def _heights(self) -> list[int]:
        """Find the heights that the rays of each chip can meet; return the chips that meet any."""
        model, surface = self._view.model, self._view.surface
        low, high = (np.full(len(self._origins), value) for value in model.height_range)
        limits = model.height_limits
        steps = np.linspace(0.0, self._extent, _PLACES)
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        corners = self._origins[:, None] + offsets
        left = np.arange(len(self._origins))
        meeting: list[int] = []
        for turn in range(4):
            samples = self._samples(corners[left], low[left], high[left])
            again = []
            for k, part in zip(left.tolist(), samples, strict=True):
                window = surface.window_under(part)
                if window is None or (window[2] - window[0]) * (window[3] - window[1]) > _LARGEST:
                    continue
                try:
                    lowest, highest = surface.range_within(
                        window[0], window[1], window[2] - window[0], window[3] - window[1]
                    )
                except CoverageError:
                    continue
                narrow = max(lowest - 1.0, limits[0]), min(highest + 1.0, limits[1])
                if not narrow[0] < narrow[1]:
                    continue
                inside = low[k] <= narrow[0] and narrow[1] <= high[k]
                self.windows[k] = window
                # Repeat between the actual heights: the window is smaller, and polynomials are better.
                low[k], high[k] = narrow if inside else (min(low[k], narrow[0]), max(high[k], narrow[1]))
                if inside and turn:
                    meeting.append(k)
                else:
                    again.append(k)
            left = np.array(again, dtype=int)
            if not len(left):
                break
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        return sorted(meeting)

    def _samples(self, corners: Array, low: Array, high: Array) -> Array:
        """Return DEM sample coordinates ``(n, 2 m, 2)`` of places ``(n, m, 2)`` at two heights."""
        image = np.concatenate([corners, corners], axis=1).reshape(-1, 2)
        count = corners.shape[1]
        heights = np.concatenate(
            [np.repeat(low[:, None], count, 1), np.repeat(high[:, None], count, 1)], axis=1
        ).ravel()
        ground = self._view.model.image_to_ground(image, heights)
        return np.asarray(self._sampler(ground)).reshape(-1, 2 * count, 2)

    def _evaluate(self, chips: NDArray[np.int_], nodes: int) -> Array:
        steps = np.linspace(0.0, self._extent, nodes)
        columns, rows = np.meshgrid(steps, steps)
        offsets = np.stack([columns, rows], axis=-1)
        image = self._origins[chips][:, None, None] + offsets
        image = np.broadcast_to(image[:, :, :, None], (*image.shape[:3], LEVELS, 2))
        heights = self.middle[chips][:, None] + self.half[chips][:, None] * levels(LEVELS)
        heights = np.broadcast_to(heights[:, None, None], image.shape[:4])
        values = self._exact(image.reshape(-1, 2), heights.ravel()).reshape(*image.shape[:4], 4)
        return np.ascontiguousarray(polynomials(values))

    def _exact(self, image: Array, heights: Array) -> Array:
        """Return positions in DEM and target ``(N, 4)`` of image points at heights."""
        ground = self._view.model.image_to_ground(image, heights)
        return np.column_stack([self._sampler(ground), self._target.project(ground, self._view.model.crs)])

    def _error(self, nodes: int) -> float:
        """Return the largest error of positions in the target (px) between the nodes of some chips."""
        if not self.seen:
            return 0.0
        chips = np.array(self.seen)[np.linspace(0, len(self.seen) - 1, min(_PROBED, len(self.seen))).astype(int)]
        cell = self._extent / (nodes - 1)
        image = self._origins[chips] + cell * 0.5
        heights = self.middle[chips] + 0.7 * self.half[chips]
        middle = self.coefficients[chips][:, :2, :2].mean(axis=(1, 2))
        powers = 0.7 ** np.arange(LEVELS)
        error = np.abs(np.einsum("k,nka->na", powers, middle) - self._exact(image, heights))[:, 2:]
        error = error[np.isfinite(error).all(axis=1)]
        return float(error.max(initial=0.0))
