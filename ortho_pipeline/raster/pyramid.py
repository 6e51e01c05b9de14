"""A raster for display: intensities at any reduction, with a coarse copy in memory.

Up to `intensity.EXACT` a window is read and averaged. For larger reductions there is one coarse copy of the raster in
memory, from its overviews, or without overviews from single pixels of every few rows. It is for display, never for
measurement.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.raster.intensity import EXACT, Intensity
from ortho_pipeline.raster.source import RasterSource

#: Least reduction of the coarse copy, and its largest number of pixels.
_COARSE, _MOST_PIXELS = 2 * EXACT, 16_000_000


def stretch(values: NDArray[np.float32]) -> tuple[float, float] | None:
    """Return the intensities to show as black and as white: percentiles 1 and 99; None if none is valid."""
    seen = values[np.isfinite(values)]
    if not len(seen):
        return None
    low, high = (float(value) for value in np.percentile(seen, (1.0, 99.0)))
    return low, max(high, low + 1e-6 * max(abs(low), 1.0))


class Pyramid(Intensity):
    """Intensities of a raster for a viewer: as `Intensity`, with a coarse copy in memory for large reductions."""

    def __init__(self, source: RasterSource, bands: Sequence[int] = ()) -> None:
        super().__init__(source, bands)
        self._lock = threading.Lock()
        self._copy: NDArray[np.float32] | None = None
        self._step = _COARSE
        while (self.width / self._step) * (self.height / self._step) > _MOST_PIXELS:
            self._step *= 2

    @property
    def coarse(self) -> NDArray[np.float32]:
        """The coarse copy ``(rows, columns)``, made when it is first needed; NaN where not valid."""
        with self._lock:
            if self._copy is None:
                self._copy = self._decimated()
            return self._copy

    def stretch(self) -> tuple[float, float]:
        """Return the intensities that are shown as black and as white: percentiles of all valid pixels."""
        return stretch(self.coarse) or (0.0, 1.0)

    def _reduced(self, left: int, top: int, rows: int, columns: int, factor: int) -> NDArray[np.float32]:
        copy = self.coarse
        row = ((top + (np.arange(rows) + 0.5) * factor) / self._step).astype(int)
        column = ((left + (np.arange(columns) + 0.5) * factor) / self._step).astype(int)
        if factor <= self._step:
            return copy[np.minimum(row, copy.shape[0] - 1)][:, np.minimum(column, copy.shape[1] - 1)]
        many = factor // self._step
        first = np.minimum(top // self._step + np.arange(rows * many), copy.shape[0] - 1)
        second = np.minimum(left // self._step + np.arange(columns * many), copy.shape[1] - 1)
        part = copy[first][:, second].reshape(rows, many, columns, many)
        valid = np.isfinite(part)
        count = valid.sum(axis=(1, 3))
        total = np.where(valid, part, 0.0).sum(axis=(1, 3))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)

    def _decimated(self) -> NDArray[np.float32]:
        rows, columns = max(1, self.height // self._step), max(1, self.width // self._step)
        window = 0, 0, columns * self._step, rows * self._step
        if columns * self._step > self.width or rows * self._step > self.height:
            window = 0, 0, self.width, self.height
        return self._resampled(window, rows, columns, single=True)
