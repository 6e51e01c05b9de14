"""The ellipsoid, its local axes, and rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Semi-major axis of WGS84 (m).
SEMI_MAJOR = 6378137.0
#: Squared eccentricity of WGS84.
ECCENTRICITY_SQUARED = 6.69437999014e-3
#: Rotation of the Earth, radians per second.
EARTH_RATE = 7.292115e-5


# -- the ellipsoid ---------------------------------------------------------------------------------------------------


def geocentric(ground: Array) -> Array:
    """Convert lon, lat (degrees), ellipsoidal height ``(N, 3)`` on WGS84 to ECEF metres ``(N, 3)``.

    Examples
    --------
    >>> geocentric(np.array([[0.0, 0.0, 0.0]])).tolist()
    [[6378137.0, 0.0, 0.0]]
    """
    lon, lat = np.radians(ground[:, 0]), np.radians(ground[:, 1])
    prime_vertical = SEMI_MAJOR / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(lat) ** 2)
    level = (prime_vertical + ground[:, 2]) * np.cos(lat)
    polar = (prime_vertical * (1.0 - ECCENTRICITY_SQUARED) + ground[:, 2]) * np.sin(lat)
    return np.stack([level * np.cos(lon), level * np.sin(lon), polar], axis=1)


def geodetic(ecef: Array) -> Array:
    """Convert ECEF metres ``(N, 3)`` to lon, lat (degrees), ellipsoidal height ``(N, 3)``, to 1e-9 m.

    Three iterations of Bowring's formula: accurate from the sea floor to beyond satellites, also at the poles.

    Examples
    --------
    >>> geodetic(np.array([[6378237.0, 0.0, 0.0]])).tolist()
    [[0.0, 0.0, 100.0]]
    """
    x, y, z = ecef.T
    level = np.hypot(x, y)
    flat = np.sqrt(1.0 - ECCENTRICITY_SQUARED)
    second = SEMI_MAJOR * ECCENTRICITY_SQUARED / flat
    reduced = np.arctan2(z, level * flat)
    for _ in range(3):
        sin, cos = z + second * np.sin(reduced) ** 3, level - SEMI_MAJOR * ECCENTRICITY_SQUARED * np.cos(reduced) ** 3
        reduced = np.arctan2(flat * sin, cos)
    length = np.hypot(sin, cos)
    sin, cos = sin / length, cos / length
    height = level * cos + z * sin - SEMI_MAJOR * np.sqrt(1.0 - ECCENTRICITY_SQUARED * sin**2)
    return np.stack([np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(sin, cos)), height], axis=1)


def enu_from_ecef(ground: Array) -> Array:
    """Return the east, north and up axes at lon, lat (degrees) in ECEF, as rows of rotations ``(N, 3, 3)``.

    Examples
    --------
    >>> enu_from_ecef(np.array([[0.0, 0.0]]))[0, 2].tolist()  # up
    [1.0, 0.0, 0.0]
    """
    lon, lat = np.radians(ground[:, 0]), np.radians(ground[:, 1])
    sin_lon, cos_lon, sin_lat, cos_lat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lon)], axis=1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=1)
    return np.stack([east, north, up], axis=1)


def longitudes_near(lon: Array, about: float) -> Array:
    """Return longitudes (degrees) within half a turn of `about`, so that they do not jump at the antimeridian.

    Examples
    --------
    >>> longitudes_near(np.array([179.0, -179.0]), 180.0).tolist()
    [179.0, 181.0]
    """
    return np.asarray(about + np.remainder(lon - about + 180.0, 360.0) - 180.0)


def metres_per_degree(ground: Array) -> Array:
    """Return the lengths ``(N, 2)`` of a degree of longitude and of latitude at lon, lat (degrees), height."""
    lat = np.radians(ground[:, 1])
    w2 = 1.0 - ECCENTRICITY_SQUARED * np.sin(lat) ** 2
    prime_vertical = SEMI_MAJOR / np.sqrt(w2)
    meridian = prime_vertical * (1.0 - ECCENTRICITY_SQUARED) / w2
    return np.radians(np.stack([(prime_vertical + ground[:, 2]) * np.cos(lat), meridian + ground[:, 2]], axis=1))


def enu_from_geodetic(ground: Array, origin: Array) -> tuple[Array, Array]:
    """Return east, north, up (m) of points ``(N, 3)`` lon, lat (deg), h about an origin, and derivatives ``(N, 3, 3)``.

    A local ENU frame: the geocentric system, turned to the axes at `origin` ``(3,)`` and moved there.
    """
    turn = enu_from_ecef(origin[None])[0]
    # Columns: how a point moves with longitude, latitude and height.
    slopes = turn @ np.swapaxes(enu_from_ecef(ground), 1, 2)
    slopes[:, :, :2] *= metres_per_degree(ground)[:, None, :]
    return (geocentric(ground) - geocentric(origin[None])) @ turn.T, slopes


def meet_height(origin: Array, direction: Array, height: Array) -> Array:
    """Return the first point of rays in ECEF at an ellipsoidal height.

    Starts in closed form from the ellipsoid with axes longer by the height. Newton's method along the ray follows,
    because the surface of equal height is not exactly an ellipsoid.

    Parameters
    ----------
    origin, direction : (N, 3)
        Start (m) and unit vectors.
    height : (N,)

    Returns
    -------
    ndarray (N, 3)
        Lon, lat (degrees), height; NaN where the ray passes above that height or starts beyond it.
    """
    axes = np.array([SEMI_MAJOR, SEMI_MAJOR, SEMI_MAJOR * np.sqrt(1.0 - ECCENTRICITY_SQUARED)]) + height[:, None]
    start, way = origin / axes, direction / axes
    square, half, rest = (way**2).sum(axis=1), (start * way).sum(axis=1), (start**2).sum(axis=1) - 1.0
    with np.errstate(invalid="ignore"):
        root = np.sqrt(half**2 - square * rest)
        distance = np.where(rest > 0, -half - root, -half + root) / square
        ground = geodetic(origin + distance[:, None] * direction)
        for _ in range(5):
            miss = height - ground[:, 2]
            if not (np.abs(miss) > 1e-9).any():
                break
            distance = distance + miss / (enu_from_ecef(ground)[:, 2] * direction).sum(axis=1)
            ground = geodetic(origin + distance[:, None] * direction)
        ground[~((distance > 0) & (np.abs(ground[:, 2] - height) < 1e-6))] = np.nan
    return ground


# -- rotations -------------------------------------------------------------------------------------------------------
#
# An adjustment turns angles into matrices in every step, and a resection vectors onto others for every triple of
# points: scipy's Rotation, whose signs and sequences these have (tests/geodesy/test_rotations.py), takes 5 to 20 times
# as long.


def rotation_of_angles(omega: float, phi: float, kappa: float) -> Array:
    """Return the rotation ``(3, 3)`` from ground to camera axes of the angles omega, phi, kappa.

    Source: Ok and Turker, equation 3. In print cos phi sin kappa lacks its minus sign, and sin phi is printed as sin
    omega; these are the usual elements, M = R3(kappa) R2(phi) R1(omega).
    """
    so, co, sp, cp, sk, ck = *_sin_cos(omega), *_sin_cos(phi), *_sin_cos(kappa)
    return np.array(
        [
            [cp * ck, so * sp * ck + co * sk, -co * sp * ck + so * sk],
            [-cp * sk, -so * sp * sk + co * ck, co * sp * sk + so * ck],
            [sp, -so * cp, co * cp],
        ]
    )


def angles_of_rotation(matrix: Array) -> tuple[float, float, float]:
    """Return omega, phi, kappa (rad) of a rotation ``(3, 3)`` from ground to camera axes; phi within 90 degrees.

    Examples
    --------
    >>> [round(angle, 3) for angle in angles_of_rotation(rotation_of_angles(0.1, 0.2, 0.3))]
    [0.1, 0.2, 0.3]
    """
    omega = np.arctan2(-matrix[2, 1], matrix[2, 2])
    phi = np.arctan2(matrix[2, 0], np.hypot(matrix[2, 1], matrix[2, 2]))
    kappa = np.arctan2(-matrix[1, 0], matrix[0, 0])
    return float(omega), float(phi), float(kappa)


def orbital_from_ecef(position: Array, velocity: Array) -> Array:
    """Return the axes along, right, down of an orbit, as rows of a rotation ``(3, 3)`` from ECEF.

    Down is towards the centre of the Earth. Along is the direction at a right angle to it that is nearest to the
    inertial velocity.

    Parameters
    ----------
    position, velocity : (3,)
        In ECEF (m, m/s); the velocity is relative to the rotating Earth.

    Examples
    --------
    >>> orbital_from_ecef(np.array([7e6, 0.0, 0.0]), np.array([0.0, 7500.0, 0.0]))[0].tolist()  # along
    [-0.0, 1.0, 0.0]
    """
    down = -position / np.linalg.norm(position)
    inertial = velocity + EARTH_RATE * np.array([-position[1], position[0], 0.0])
    right = np.cross(down, inertial)
    right /= np.linalg.norm(right)
    return np.stack([np.cross(right, down), right, down])


def rotation_between(from_vectors: Array, to_vectors: Array) -> Array:
    """Return the rotation ``(3, 3)`` that best maps vectors ``(N, 3)`` to others, by least squares (Kabsch)."""
    u, _, vt = np.linalg.svd(to_vectors.T @ from_vectors)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _sin_cos(angle: float) -> tuple[float, float]:
    return float(np.sin(angle)), float(np.cos(angle))
