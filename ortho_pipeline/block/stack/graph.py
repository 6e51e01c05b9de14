"""Which pairs of dates are matched: neighbours in time, the same season of other years, and long links.

Each rule chooses for a date the nearest dates to a time. So a date that is added makes new pairs only with itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Neighbours of a date among the earlier dates.
NEIGHBOURS = 3
#: Days from a date to its partners, and how far from that a partner may be. In whole years the season is the same.
_LAGS = ((91.0, 25.0), (365.25, 40.0), (730.5, 40.0), (1826.25, 40.0))


def pairs_of(days: Sequence[float], neighbours: int = NEIGHBOURS) -> list[tuple[int, int]]:
    """Return pairs (later, earlier) of dates ``(T,)``, which are in order of time.

    >>> pairs_of([0, 10, 20, 30, 365], 2)
    [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2), (4, 0), (4, 2), (4, 3)]
    """
    time = np.asarray(days, dtype=float)
    found: set[tuple[int, int]] = set()
    for date in range(len(time)):
        found |= {(date, other) for other in range(max(0, date - neighbours), date)}
        for lag, tolerance in _LAGS:
            apart = np.abs(time[date] - lag - time[:date])
            if date and apart.min() <= tolerance:
                found.add((date, int(apart.argmin())))
    return sorted(found)
