"""How a map distorts the ground at a place: its scale in every direction, and the convergence of its meridians.

A metre on a map is a metre on the ground only by chance: in Web Mercator it is 0.5 m at 60° of latitude, in an
equal-area map its length depends on the direction, in degrees the axes differ, and y points to true north on few
places. Every length, slope, angle and standard deviation that is formed from map coordinates goes through here.
"""

from __future__ import annotations

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import SEMI_MAJOR, enu_from_ecef, geocentric, metres_per_degree

Array = NDArray[np.float64]

#: Distance (m, about) over which differences are taken: rounding is 1e-9 of it, curvature 1e-7.
_STEP = 1.0


def east_north_from_map(crs: pyproj.CRS, ground: Array) -> Array:
    """Return how far (m) true east and north a unit of x and of y leads at a constant height.

    On the ground, that is at the height of the place: exact for any CRS, whatever its units, axes and projection.

    Parameters
    ----------
    ground : (N, 3)
        x, y in `crs`, ellipsoidal height (m); NaN heights count as 0.

    Returns
    -------
    ndarray (N, 2, 2)
        Rows east and north, columns x and y; NaN outside of the domain of `crs`.
    """
    places = np.column_stack([ground[:, :2], np.nan_to_num(ground[:, 2])])
    geodetic_from_map = ground_transform(crs, "EPSG:4979")
    if geodetic_from_map.is_identity:
        return np.asarray(metres_per_degree(places)[:, :, None] * np.eye(2))
    step = _STEP / crs.axis_info[0].unit_conversion_factor / (SEMI_MAJOR if crs.is_geographic else 1.0)
    moved = np.concatenate([places + nudge for nudge in np.array([(0, 0, 0), (step, 0, 0), (0, step, 0)])])
    here, *there = np.split(geodetic_from_map(moved), 3)
    axes, start = enu_from_ecef(here)[:, :2], geocentric(here)
    return np.stack([np.einsum("nij,nj->ni", axes, geocentric(end) - start) for end in there], axis=2) / step


def metres_of_steps(crs: pyproj.CRS, ground: Array, steps: Array) -> Array:
    """Return how long (m, on the ground) steps along x and y ``(2,)`` of `crs` are at places ``(N, 3)``, ``(N, 2)``."""
    return np.asarray(np.linalg.norm(east_north_from_map(crs, ground) * steps, axis=1))


def map_from_enu(crs: pyproj.CRS, ground: Array) -> Array:
    """Return how x, y (units of `crs`) and height (rows) change per metre true east, north and up (columns).

    Parameters
    ----------
    ground : (N, 3)
        x, y in `crs`, ellipsoidal height (m); NaN heights count as 0.

    Returns
    -------
    ndarray (N, 3, 3)
        What multiplies derivatives by ground coordinates, so that they are by metres on the ground.
    """
    slopes = np.zeros((len(ground), 3, 3))
    slopes[:, :2, :2] = inverse_2x2(east_north_from_map(crs, ground))
    slopes[:, 2, 2] = 1.0
    return slopes


def inverse_2x2(matrices: Array) -> Array:
    """Return the inverses of matrices ``(N, 2, 2)``; not finite where there is none."""
    a, b, c, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = a * d - b * c
        # The diagonal is exact where x is east and y north.
        rows = [np.stack([1.0 / (a - b * (c / d)), -b / scale], 1), np.stack([-c / scale, 1.0 / (d - c * (b / a))], 1)]
    return np.stack(rows, axis=1)
