"""Shifts of a scene by single bands of a reference, relative to the result of matching, and whether they agree.

An edge in the infrared may be elsewhere than in the red, and the detectors of two bands may be displaced. All bands are
measured in the same chips, so errors of heights and of the model cancel in the differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.models.base import Array

#: Bands disagree if they differ by more than this many sigmas, and by more than this many px.
_SIGMAS, _APART = 3.0, 0.3


@dataclass(frozen=True)
class BandShift:
    """Shift of the scene (px, column and row) by one band alone, relative to the result, and its sigmas."""

    band: int
    shift: tuple[float, float]
    sigma: tuple[float, float]

    @classmethod
    def of(cls, band: int, moves: Array) -> BandShift:
        """Return the shift of a band from the shifts ``(n, 2)`` of single chips, some of which may be gross errors."""
        shift = np.median(moves, axis=0)
        # The sigma of a median is that of a mean times the root of pi / 2.
        sigma = 1.4826 * np.median(np.abs(moves - shift), axis=0) * np.sqrt(np.pi / 2 / len(moves))
        return cls(band, (float(shift[0]), float(shift[1])), (float(sigma[0]), float(sigma[1])))

    def contradicts(self, other: BandShift) -> bool:
        """Return whether two bands disagree."""
        apart, sigma = np.subtract(self.shift, other.shift), np.hypot(self.sigma, other.sigma)
        return bool(np.hypot(*apart) > _APART and (np.abs(apart) > _SIGMAS * sigma).any())


def disagreeing(bands: Sequence[BandShift]) -> bool:
    """Return whether any two bands disagree."""
    return any(band.contradicts(other) for band in bands for other in bands)


def agreeing(bands: Sequence[BandShift]) -> tuple[int, ...]:
    """Return the numbers of the largest set of bands that agree with one of them; if equal, with smaller sigmas."""
    sets = [[other for other in bands if not band.contradicts(other)] for band in bands]
    best = max(sets, key=lambda group: (len(group), -float(np.mean([band.sigma for band in group]))))
    return tuple(band.band for band in best)


def spread(bands: Sequence[BandShift]) -> float:
    """Return the standard deviation (px per axis) of the shifts of bands that disagree; 0 if they agree."""
    if not disagreeing(bands):
        return 0.0
    return float(np.sqrt(np.var([band.shift for band in bands], axis=0, ddof=1).mean()))
