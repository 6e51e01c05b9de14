"""The Earth of simulated scenes: size, rotation, geocentric coordinates; it shares no code with the models."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
EARTH_A = 6378137.0
EARTH_F = 1 / 298.257223563
EARTH_GM = 3.986004418e14
EARTH_RATE = 7.292115e-5
_E2 = EARTH_F * (2 - EARTH_F)


def geocentric(ground: Array) -> Array:
    """Convert lon, lat (degrees), ellipsoidal height ``(N, 3)`` on WGS 84 to ECEF metres."""
    lon, lat = np.radians(ground[:, 0]), np.radians(ground[:, 1])
    normal = EARTH_A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    level = (normal + ground[:, 2]) * np.cos(lat)
    return np.stack(
        [level * np.cos(lon), level * np.sin(lon), (normal * (1 - _E2) + ground[:, 2]) * np.sin(lat)], axis=1
    )


def geodetic(ecef: Array) -> Array:
    """Convert ECEF metres ``(N, 3)`` to lon, lat (degrees), ellipsoidal height; Bowring's iteration, to 1e-9 m."""
    x, y, z = ecef.T
    level = np.hypot(x, y)
    flat = 1 - EARTH_F
    with np.errstate(divide="ignore", invalid="ignore"):
        tan_reduced = z / (level * flat)
        for _ in range(3):
            cos = 1 / np.sqrt(1 + tan_reduced**2)
            sin = tan_reduced * cos
            tan_lat = (z + _E2 / flat * EARTH_A * sin**3) / (level - _E2 * EARTH_A * cos**3)
            tan_reduced = flat * tan_lat
    lat = np.arctan(tan_lat)
    normal = EARTH_A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    height = level * np.cos(lat) + z * np.sin(lat) - EARTH_A**2 / normal
    return np.stack([np.degrees(np.arctan2(y, x)), np.degrees(lat), height], axis=1)


def spin(vectors: Array, angle: Array) -> Array:
    """Rotate ``(N, 3)`` vectors about the Earth's axis by ``(N,)`` radians."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)
