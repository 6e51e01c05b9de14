"""Voids of a raster of heights, filled by the nearest height, in an amount of memory that no window exceeds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Samples on a side that are filled at once: with their surroundings they take 100 MB at most.
_PIECE = 1024


def nearest_heights(
    read: Callable[[int, int, int, int], Array], shape: tuple[int, int], window: tuple[int, int, int, int], reach: int
) -> Array:
    """Return a window of heights with voids filled by the nearest valid sample, if one is within `reach` samples.

    Outside the raster its edge continues for `reach` samples. The result is the same if a window is cut into smaller
    ones.

    Parameters
    ----------
    read : callable (column, row, columns, rows)
        Returns heights ``(rows, columns)`` within the raster, NaN for voids.
    shape : tuple
        (rows, columns) of the raster.
    window : tuple
        First column and row, columns and rows; it may reach outside.
    """
    u0, v0, nu, nv = window
    out = np.empty((nv, nu))
    for top in range(0, nv, _PIECE):
        for left in range(0, nu, _PIECE):
            rows, columns = min(_PIECE, nv - top), min(_PIECE, nu - left)
            piece = u0 + left, v0 + top, columns, rows
            out[top : top + rows, left : left + columns] = _piece(read, shape, piece, reach)
    return out


def _piece(
    read: Callable[[int, int, int, int], Array], shape: tuple[int, int], window: tuple[int, int, int, int], reach: int
) -> Array:
    rows, columns = shape
    u0, v0, nu, nv = window
    u, v = np.clip(np.arange(u0, u0 + nu), 0, columns - 1), np.clip(np.arange(v0, v0 + nv), 0, rows - 1)
    left, top, right, bottom = int(u[0]), int(v[0]), int(u[-1]) + 1, int(v[-1]) + 1
    heights = read(left, top, right - left, bottom - top)
    if np.isnan(heights).any():
        from scipy.ndimage import distance_transform_edt

        west, north = max(0, left - reach), max(0, top - reach)
        east, south = min(columns, right + reach), min(rows, bottom + reach)
        wide = read(west, north, east - west, south - north)
        void = np.isnan(wide)
        if not void.all():
            # Without distances, which are not needed: a third of the memory.
            nearest = distance_transform_edt(void, return_distances=False, return_indices=True)
            own = (slice(top - north, bottom - north), slice(left - west, right - west))
            near_v, near_u = nearest[0][own], nearest[1][own]
            down = near_v - np.arange(own[0].start, own[0].stop)[:, None]
            across = near_u - np.arange(own[1].start, own[1].stop)
            heights = np.where(np.hypot(down, across) <= reach, wide[near_v, near_u], np.nan)
    beyond = np.hypot((np.arange(v0, v0 + nv) - v)[:, None], np.arange(u0, u0 + nu) - u)
    return np.where(beyond > reach, np.nan, heights[np.ix_(v - top, u - left)])
