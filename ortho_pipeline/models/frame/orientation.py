"""Exterior orientations: their parameters, and conversions between the ways to state them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.geodesy.ellipsoid import (
    angles_of_rotation,
    enu_from_ecef,
    geocentric,
    geodetic,
    rotation_of_angles,
)
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.frame.working_frame import GEOGRAPHIC

#: Parameters of the exterior orientation: metres and radians in the working frame.
EXTERIOR = ("X_L", "Y_L", "Z_L", "omega", "phi", "kappa")

#: Highest ground below a camera, as part of its altitude, if nothing is known of the terrain.
_BELOW = 0.9


def exterior_of_geocentric(
    position: ArrayLike, camera_from_ecef: Array | None
) -> tuple[Array, tuple[float, float, float]]:
    """Return the topocentric exterior ``(6,)`` of a position in ECEF, and its origin on the ellipsoid below.

    `camera_from_ecef` is the rotation ``(3, 3)`` to camera axes. Without it the camera looks straight down, and the top
    of the image is north.
    """
    lon, lat, height = geodetic(np.asarray(position, dtype=np.float64)[None])[0].tolist()
    axes = enu_from_ecef(np.array([[lon, lat]]))[0]
    angles = (0.0, 0.0, 0.0) if camera_from_ecef is None else angles_of_rotation(camera_from_ecef @ axes.T)
    return np.array([0.0, 0.0, height, *angles]), (lon, lat, 0.0)


def heights_below(position: ArrayLike, heights: tuple[float, float]) -> tuple[float, float]:
    """Return a range of ground heights (m) whose upper end is clearly below a camera at a position in ECEF (m).

    Raises
    ------
    InputError
        If the camera is below all of it.

    Examples
    --------
    >>> heights_below(geocentric(np.array([[12.5, 41.9, 2500.0]]))[0], (0.0, 3000.0))
    (0.0, 2250.0)
    """
    low, high = heights
    altitude = float(geodetic(np.asarray(position, dtype=np.float64)[None])[0, 2])
    if not altitude > low:
        raise InputError(f"a camera at a height of {altitude:.0f} m sees no ground", field="position")
    return low, min(high, low + _BELOW * (altitude - low))


def geocentric_of_map(crs: str, exterior: Array) -> tuple[Array, Array]:
    """Return position in ECEF ``(3,)`` and rotation to the camera ``(3, 3)`` of an exterior orientation in a map.

    The angles are rotated by the meridian convergence at the perspective centre.

    Examples
    --------
    >>> position, rotation = geocentric_of_map("EPSG:32631", np.array([500_000.0, 0.0, 2500.0, 0.0, 0.0, 0.0]))
    >>> geodetic(position[None]).round(3).tolist()
    [[3.0, 0.0, 2500.0]]
    """
    to_geographic = ground_transform(crs, GEOGRAPHIC)
    steps = np.array([[0, 0], [100.0, 0], [-100.0, 0], [0, 100.0], [0, -100.0]])
    around = to_geographic(np.column_stack([exterior[:2] + steps, np.full(5, exterior[2])]))
    axes = enu_from_ecef(around[:1])[0]
    ecef = geocentric(around)
    east, north = axes @ (ecef[1] - ecef[2]), axes @ (ecef[3] - ecef[4])
    turn = math.atan2(east[1] - north[0], east[0] + north[1])
    grid_from_enu = np.array([[math.cos(turn), math.sin(turn), 0], [-math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    return ecef[0], rotation_of_angles(*exterior[3:].tolist()) @ grid_from_enu @ axes


def geocentric_of_platform(position: ArrayLike, roll: float, pitch: float, yaw: float) -> tuple[Array, Array]:
    """Return position in ECEF ``(3,)`` and rotation to the camera ``(3, 3)`` of a platform.

    See `FrameCamera.from_roll_pitch_yaw`.
    """
    place = np.asarray(position, dtype=np.float64)[None]
    axes = enu_from_ecef(place)[0]
    ned_from_ecef = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]) @ axes
    return geocentric(place)[0], camera_from_platform(roll, pitch, yaw) @ ned_from_ecef


def camera_from_platform(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation ``(3, 3)`` from north, east, down to camera axes, for a camera that looks down.

    Angles (rad) are those of `FrameCamera.from_roll_pitch_yaw`. For a satellite it is the rotation from the orbital
    axes along, right, down.

    Examples
    --------
    >>> camera_from_platform(0.0, 0.0, 0.0)
    array([[ 0.,  1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0., -1.]])
    """
    sr, cr, sp, cp, sy, cy = (f(a) for a in (roll, pitch, yaw) for f in (math.sin, math.cos))
    platform_from_level = np.array(
        [
            [cp * cy, cp * sy, -sp],
            [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp],
            [cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp],
        ]
    )
    camera_from_axes = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return np.asarray(camera_from_axes @ platform_from_level)


def exterior_sigmas(position: float | None, angle: float | None) -> dict[str, float]:
    """Return standard deviations of the exterior orientation by parameter, from those of position (m) and angles (rad).

    Examples
    --------
    >>> exterior_sigmas(5.0, None)
    {'X_L': 5.0, 'Y_L': 5.0, 'Z_L': 5.0}
    """
    known = {EXTERIOR[:3]: position, EXTERIOR[3:]: angle}
    return {name: sigma for names, sigma in known.items() if sigma is not None for name in names}


def require_metres(crs: str) -> None:
    """Raise `InputError` for a CRS that is not a map projection in metres."""
    parsed = parse_crs(crs)
    if not parsed.is_projected or abs(parsed.axis_info[0].unit_conversion_factor - 1.0) > 1e-12:
        raise InputError(
            f"{parsed.name!r} is not a map projection in metres", field="CRS", remedy="give a projected CRS such as UTM"
        )
