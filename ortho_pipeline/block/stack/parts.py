"""Parts of single dates that are displaced from the rest of their ortho, as a wrong tile of a mosaic is.

The correction of a date does not follow such a part, and no correction of the date mends it. An affine correction would
follow a part of about half the date, and then be wrong in both halves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.cluster.vq import kmeans2
from scipy.stats import chi2

from ortho_pipeline.block.stack.edges import Cells
from ortho_pipeline.block.stack.moving import AREA, NEXT, Left
from ortho_pipeline.models.base import Array

#: Smaller displacements of a part are not told (px): crops and shadows of one date cause them, too.
_LEAST = 0.5
#: Chance that a place of a stack without such parts is found.
_CHANCE = 1e-3
#: The median of so many edges hides one that is wrong, or whose other date has the part.
_FEWEST = 3
#: Two displacements leave this part of the squares that slopes leave. Of noise they leave 0.68, of a bend 0.23.
_LEVELS = 0.2
#: Slopes follow a part that is at least so much of a date. A smaller one is left out as a gross error is.
_LARGE = 0.35


@dataclass(frozen=True)
class DatePart:
    """A part of a date: how many cells of those that were seen, and its displacement from the rest, px."""

    date: int
    cells: int
    of: int
    shift: tuple[float, float]


def parts_of(cells: Cells, left: Left, still: NDArray[np.bool_], design: Array) -> list[DatePart]:
    """Return the displaced parts of dates, where ground is `still` ``(K,)``; `design` as of `has_two`."""
    found, limit = [], chi2.isf(_CHANCE / max(still.sum() * len(left.scale), 1), 2)
    for date in range(len(left.scale)):
        known, shift, of_edges = _displacement(left, date, still)
        variance = (left.scale[date] * left.shared + of_edges) * left.noisier
        far = known & (np.hypot(*shift.T) > _LEAST) & ((shift**2).sum(axis=1) > limit * variance)
        # The correction of the date is between two large parts: either may be beyond the limit, or both, or none.
        half = _smaller_part(known, shift, design)
        far = half if half.any() else far
        area = ndimage.label(far.reshape(cells.shape[::-1]), NEXT)[0].ravel()
        part = far & (np.bincount(area)[area] >= AREA)
        if part.any():
            rest = shift[known & ~far] if half.any() else np.zeros((1, 2))
            column, row = (np.median(shift[part], axis=0) - np.median(rest, axis=0)).tolist()
            found.append(DatePart(date, int(part.sum()), int(known.sum()), (column, row)))
    return found


def has_two(left: Left, date: int, still: NDArray[np.bool_], design: Array) -> bool:
    """Tell whether a date has two displacements rather than slopes.

    Parameters
    ----------
    left : Left
        What a network of shifts leaves.
    still : (K,) of bool
    design : (K, 3)
        Terms of an affine correction.
    """
    known, shift, _ = _displacement(left, date, still)
    return bool(_smaller_part(known, shift, design).any())


def _smaller_part(known: NDArray[np.bool_], shift: Array, design: Array) -> NDArray[np.bool_]:
    """Return at which places ``(K,)`` a date with two displacements has the rarer one; nowhere if that is a small part.

    Nor anywhere if slopes fit as well.
    """
    value, found = shift[known], np.zeros(len(known), dtype=bool)
    if len(value) < 2 * AREA:
        return found
    fitted = design[known] @ np.linalg.lstsq(design[known], value, rcond=None)[0]
    # The line along which values differ most divides them for a start.
    middle = value - value.mean(axis=0)
    above = middle @ np.linalg.svd(middle, full_matrices=False)[2][0] > 0
    if not 0 < above.sum() < len(above):
        return found
    start = np.array([value[~above].mean(axis=0), value[above].mean(axis=0)])
    levels, label = kmeans2(value, start, minit="matrix")
    apart = np.hypot(*(levels[1] - levels[0])) > _LEAST and _LARGE <= label.mean() <= 1 - _LARGE
    if apart and ((value - levels[label]) ** 2).sum() < _LEVELS * ((value - fitted) ** 2).sum():
        found[known] = label == (label.mean() <= 0.5)
    return found


def _displacement(left: Left, date: int, still: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return at which places ``(K,)`` a date is known, what is left of it ``(K, 2)``, and the variance by its edges."""
    ends = np.flatnonzero((left.first == date) | (left.second == date))
    sign = np.where(left.first[ends] == date, 1.0, -1.0)
    seen = left.weight[ends] > 0
    count = seen.sum(axis=0)
    known, shift = still & (count >= _FEWEST), np.zeros((len(still), 2))
    if known.any():
        value = np.where(seen[:, known, None], sign[:, None, None] * left.value[ends][:, known], np.nan)
        shift[known] = np.nanmedian(value, axis=0)
    # A median has pi / 2 times the variance of a mean.
    return known, shift, np.pi / 2 * (left.own[ends] * seen).sum(axis=0) / np.maximum(count, 1) ** 2
