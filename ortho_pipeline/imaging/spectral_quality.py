"""How much an image of several bands differs from the true one: ERGAS, spectral angle and the Q index.

Windows are added one after the other, so the size of the images does not matter.

Source: Wald 2002 (ERGAS); Yuhas, Goetz and Boardman 1992 (spectral angle); Wang and Bovik 2002 (Q index).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.models.base import Array

#: Side (px) of the blocks in which the Q index is computed.
_BLOCK = 32


@dataclass(frozen=True)
class SpectralQuality:
    """Differences from the true image.

    Parameters
    ----------
    ergas : float
        Relative RMSE of all bands, times 100 and the ratio of pixel sizes; 0 is best.
    sam_deg : float
        Mean angle between the spectra; 0 is best.
    q : float
        Mean Q index of bands and blocks; 1 is best.
    """

    ergas: float
    sam_deg: float
    q: float

    def to_json(self) -> dict[str, float]:
        """Return the numbers by name."""
        return {"ergas": self.ergas, "sam_deg": self.sam_deg, "q": self.q}


class QualitySums:
    """Sums over windows of an image of so many bands."""

    def __init__(self, count: int) -> None:
        self._squares, self._totals = np.zeros(count), np.zeros(count)
        self._angles, self._angled, self.pixels = 0.0, 0, 0
        self._q: list[Array] = []

    def add(self, true: NDArray[np.floating], image: NDArray[np.floating], valid: NDArray[np.bool_]) -> None:
        """Add a window: true and other values ``(bands, h, w)``, and which pixels to compare ``(h, w)``."""
        truth, other = (np.asarray(values, dtype=np.float64) for values in (true, image))
        first, second = truth[:, valid], other[:, valid]
        self._squares += ((first - second) ** 2).sum(axis=1)
        self._totals += first.sum(axis=1)
        self.pixels += first.shape[1]
        length = np.linalg.norm(first, axis=0) * np.linalg.norm(second, axis=0)
        seen = length > 0
        cosine = (first * second).sum(axis=0)[seen] / length[seen]
        self._angles += float(np.arccos(np.clip(cosine, -1.0, 1.0)).sum())
        self._angled += int(seen.sum())
        rows, columns = (side // _BLOCK * _BLOCK for side in valid.shape)
        for top in range(0, rows, _BLOCK):
            for left in range(0, columns, _BLOCK):
                block = (slice(top, top + _BLOCK), slice(left, left + _BLOCK))
                if valid[block].all():
                    self._q.append(_q_index(truth[:, *block], other[:, *block]))

    def quality(self, ratio: float) -> SpectralQuality | None:
        """Return the quality for so many panchromatic pixels along a multispectral one; None without pixels.

        Bands without light have no relative error.
        """
        light = self._totals > 0
        if not self.pixels or not self._q or not self._angled or not light.any():
            return None
        relative = self._squares[light] / self.pixels / (self._totals[light] / self.pixels) ** 2
        ergas = 100.0 / ratio * math.sqrt(float(relative.mean()))
        return SpectralQuality(ergas, math.degrees(self._angles / self._angled), float(np.mean(self._q)))


def _q_index(truth: Array, other: Array) -> Array:
    """Return the Q index of each band of a block ``(bands, h, w)``."""
    first, second = truth.reshape(len(truth), -1), other.reshape(len(other), -1)
    means, others = first.mean(axis=1), second.mean(axis=1)
    covariance = ((first - means[:, None]) * (second - others[:, None])).mean(axis=1)
    below = (first.var(axis=1) + second.var(axis=1)) * (means**2 + others**2)
    # Blocks without any content are the same.
    return np.where(below > 0, 4 * covariance * means * others / np.where(below > 0, below, 1.0), 1.0)
