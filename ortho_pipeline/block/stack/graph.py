"""Which pairs of dates are matched: neighbours in time, the same season of other years, and long links.

Each rule chooses for a date the nearest dates to a time; dates with clouds or other shadows count as farther. So a date
that is added makes new pairs only with itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Neighbours of a date among the earlier dates.
NEIGHBOURS = 3
#: Days from a date to its partners, and how far from that a partner may be. In whole years the season is the same.
_LAGS = ((365.25, 40.0), (1826.25, 40.0))

#: A date counts as under clouds to this part at most, and the sun as no lower (degrees).
_CLOUDED, _LOW = 0.99, 5.0


def pairs_of(
    days: Sequence[float],
    neighbours: int = NEIGHBOURS,
    clouds: Sequence[float] | None = None,
    suns: Sequence[float] | None = None,
) -> list[tuple[int, int]]:
    """Return pairs (later, earlier) of dates ``(T,)``, which are in order of time.

    A date of which half is under clouds counts as twice as far in time, because half of its matches are lost. One whose
    shadows are longer or shorter by the height of an object counts as twice as far, too.

    Parameters
    ----------
    clouds : (T,), optional
        Cloud cover in percent; NaN if unknown, which counts as clear.
    suns : (T,), optional
        Elevations of the sun (degrees); NaN if unknown, which counts as equal.

    Examples
    --------
    >>> pairs_of([0, 10, 20, 30, 365], 2)
    [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2), (4, 0), (4, 2), (4, 3)]
    >>> pairs_of([0, 10, 20, 30, 365], 2, clouds=[0, 0, 90, 0, 0])
    [(1, 0), (2, 0), (2, 1), (3, 0), (3, 1), (4, 0), (4, 1), (4, 3)]
    """
    time = np.asarray(days, dtype=float)
    covered = np.zeros(len(time)) if clouds is None else np.nan_to_num(np.asarray(clouds, dtype=float))
    elevation = np.full(len(time), np.nan) if suns is None else np.asarray(suns, dtype=float)
    clear = 1.0 - np.clip(covered / 100.0, 0.0, _CLOUDED)
    shadow = 1.0 / np.tan(np.radians(np.clip(elevation, _LOW, 90.0)))
    found: set[tuple[int, int]] = set()
    for date in range(1, len(time)):
        farther = (1.0 + np.nan_to_num(np.abs(shadow[date] - shadow[:date]))) / clear[:date]
        cost = (time[date] - time[:date] + 1.0) * farther
        nearest = np.lexsort((-np.arange(date), cost))
        found |= {(date, int(other)) for other in nearest[:neighbours]}
        for lag, tolerance in _LAGS:
            apart = np.abs(time[date] - lag - time[:date])
            if apart.min() <= tolerance:
                # Within the tolerance, the season counts no more than twice.
                found.add((date, int(np.where(apart <= tolerance, (tolerance + apart) * farther, np.inf).argmin())))
    return sorted(found)
