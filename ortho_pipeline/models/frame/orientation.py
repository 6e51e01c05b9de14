"""Cameras on a platform that states roll, pitch and yaw."""

from __future__ import annotations

import math

import numpy as np

from ortho_pipeline.models.base import Array


def camera_from_platform(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation ``(3, 3)`` from north, east, down to camera axes, for a camera that looks down.

    See `FrameCamera.from_roll_pitch_yaw`; for a satellite the same holds from the orbital frame along, right, down.
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
    return camera_from_axes @ platform_from_level
