"""Parts of single dates that are displaced from the rest of their ortho, as a wrong tile of a mosaic is.

The correction of a date does not follow such a part, and no correction of the date mends it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.stats import chi2

from ortho_pipeline.block.stack.edges import Cells
from ortho_pipeline.block.stack.moving import AREA, NEXT, Left

#: Smaller displacements of a part are not told (px): crops and shadows of one date cause them, too.
_LEAST = 0.5
#: Chance that a place of a stack without such parts is found.
_CHANCE = 1e-3
#: The median of so many edges hides one that is wrong, or whose other date has the part.
_FEWEST = 3


@dataclass(frozen=True)
class DatePart:
    """A part of a date: how many cells of those that were seen, and its displacement from the rest, px."""

    date: int
    cells: int
    of: int
    shift: tuple[float, float]


def parts_of(cells: Cells, left: Left, still: NDArray[np.bool_]) -> list[DatePart]:
    """Return the displaced parts of dates, where ground is `still` ``(K,)``."""
    found, limit = [], chi2.isf(_CHANCE / max(still.sum() * len(left.scale), 1), 2)
    for date in range(len(left.scale)):
        ends = np.flatnonzero((left.first == date) | (left.second == date))
        sign = np.where(left.first[ends] == date, 1.0, -1.0)
        seen = left.weight[ends] > 0
        count = seen.sum(axis=0)
        known = still & (count >= _FEWEST)
        if not known.any():
            continue
        value = np.where(seen[:, known, None], sign[:, None, None] * left.value[ends][:, known], np.nan)
        shift = np.zeros((len(still), 2))
        shift[known] = np.nanmedian(value, axis=0)
        # A median has pi / 2 times the variance of a mean.
        of_edges = np.pi / 2 * (left.own[ends] * seen).sum(axis=0) / np.maximum(count, 1) ** 2
        variance = (left.scale[date] * left.shared + of_edges) * left.noisier
        far = known & (np.hypot(*shift.T) > _LEAST) & ((shift**2).sum(axis=1) > limit * variance)
        area = ndimage.label(far.reshape(cells.shape[::-1]), NEXT)[0].ravel()
        part = far & (np.bincount(area)[area] >= AREA)
        if part.any():
            column, row = np.median(shift[part], axis=0).tolist()
            found.append(DatePart(date, int(part.sum()), int(known.sum()), (column, row)))
    return found
