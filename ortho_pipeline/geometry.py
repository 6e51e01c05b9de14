"""Small geometry that several modules share."""

from __future__ import annotations

import numpy as np
import pyproj
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Semi-major axis (m) and squared eccentricity of WGS84.
SEMI_MAJOR = 6378137.0
ECCENTRICITY_SQUARED = 6.69437999014e-3


def units_per_metre(crs: pyproj.CRS, ground: Array) -> Array:
    """Return how many units of each ground coordinate one metre is, ``(N, 3)``.

    For geographic coordinates from the radii of curvature of WGS84 at the points' latitude; for projected ones from
    the unit of the axes. Heights are always metres.
    """
    scale = np.ones((len(ground), 3))
    if crs.is_geographic:
        lat = np.radians(ground[:, 1])
        w2 = 1.0 - ECCENTRICITY_SQUARED * np.sin(lat) ** 2
        prime_vertical = SEMI_MAJOR / np.sqrt(w2)
        meridian = prime_vertical * (1.0 - ECCENTRICITY_SQUARED) / w2
        scale[:, 0] = np.degrees(1.0) / (prime_vertical * np.cos(lat))
        scale[:, 1] = np.degrees(1.0) / meridian
    else:
        scale[:, :2] = 1.0 / crs.axis_info[0].unit_conversion_factor
    return scale
