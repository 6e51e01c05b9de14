"""Where chips are found again in larger ones, and whether that place can be believed: alike, unique, and back again."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.imaging.matching.correlation import Peaks, orientation, peaks, surfaces
from ortho_pipeline.models.base import Array

#: Side of a chip (chip px); it is even, so that a chip of any factor has its centre between the same pixels.
SIDE = 40
#: Radius (chip px) of what is rendered to measure in.
MEASURED = 4
#: Fewer matches than this cannot be judged by each other.
FEWEST = 12
#: A match that is farther from the others than so many of its sigmas contradicts them.
SIGMAS = 3.5
#: Correlation of orientations below which a match could as well be noise.
_LEAST_SCORE = 0.25
#: A second peak of more than this part of the first: the place is not unique.
_UNIQUE = 0.85
#: Forward and backward match differ by less than this (chip px).
_BACK = 0.7
#: Part of a chip that the target shows at least.
_SEEN = 0.8
#: Chips that are worked on together: as many for any number of threads, so that results do not depend on them.
_BATCH = 32

Chips = NDArray[np.float32]
_T = TypeVar("_T", bound=np.generic)


def found_again(scene: Chips, wide: Chips, radius: int) -> Peaks:
    """Find chips ``(n, s, s)`` within `radius` about the centres of larger ones ``(n, s + 4 radius, ...)``.

    These are so large that the way back can be tried from any place that is found.
    """
    return peaks(surfaces(orientation(scene), _inner(orientation(wide), radius)))


def seen(wide: Chips, radius: int) -> Array:
    """Return the part ``(n,)`` of where `found_again` looks that is valid."""
    return np.asarray(np.isfinite(_inner(wide, radius)).mean(axis=(1, 2)))


def doubts(found: Peaks, wide: Chips, around: Chips, radius: int) -> NDArray[np.str_]:
    """Return why places that were found again are not believed ``(n,)``, keys of `matcher.REASONS`; empty if they are.

    Parameters
    ----------
    wide : (n, s + 4 radius, s + 4 radius)
        What was looked in.
    around : (n, s + 2 radius, s + 2 radius)
        The scene about its chips, for the way back.
    """
    reason = np.full(len(wide), "", dtype="<U12")
    for name, passed in (
        ("backward", _way_back(found.shift, wide, around, radius) <= _BACK),
        ("ambiguous", found.inside & (found.ratio <= _UNIQUE)),
        ("weak", found.score >= _LEAST_SCORE),
        ("hidden", seen(wide, radius) >= _SEEN),
    ):
        reason[~passed] = name
    return reason


def in_batches(work: Callable[[NDArray[np.int_]], None], index: NDArray[np.int_], threads: int) -> None:
    """Do a work on numbers ``(n,)``, some at a time."""
    batches = [index[first : first + _BATCH] for first in range(0, len(index), _BATCH)]
    if threads == 1:
        for batch in batches:
            work(batch)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, batches))


def _inner(wide: NDArray[_T], radius: int) -> NDArray[_T]:
    return wide[:, radius:-radius, radius:-radius]


def _way_back(shift: Array, wide: Chips, around: Chips, radius: int) -> Array:
    """Return how far (chip px) from where it began the way back ends ``(n,)``."""
    whole = np.clip(np.round(shift), -radius, radius).astype(int)
    side = wide.shape[1] - 4 * radius
    there = np.stack([
        chip[row : row + side, column : column + side]
        for chip, (column, row) in zip(wide, 2 * radius + whole, strict=True)
    ])  # fmt: skip
    back = peaks(surfaces(orientation(there), orientation(around)))
    return np.asarray(np.hypot(*(back.shift + (shift - whole)).T))
