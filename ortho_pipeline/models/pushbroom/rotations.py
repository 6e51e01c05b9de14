"""Rotations of the platform: roll, pitch and yaw as matrices, and back."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.models.base import Array


def are_rotations(turns: Array) -> bool:
    """Tell whether all matrices ``(N, 3, 3)`` are rotations, rounded to six digits or better."""
    miss = np.swapaxes(turns, 1, 2) @ turns - np.eye(3)
    return bool(np.abs(miss).max(initial=0.0) <= 3e-6 and (np.linalg.det(turns) > 0).all())


def rotations(angles: Array) -> Array:
    """Return R_P ``(N, 3, 3)`` of roll, pitch, yaw ``(N, 3)``."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles).T, np.cos(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def angles_of(turns: Array) -> Array:
    """Return roll, pitch, yaw ``(N, 3)`` of rotations R_P ``(N, 3, 3)``; pitch within 90 degrees."""
    roll = np.arctan2(turns[:, 2, 1], turns[:, 2, 2])
    pitch = np.arctan2(-turns[:, 2, 0], np.hypot(turns[:, 2, 1], turns[:, 2, 2]))
    yaw = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    return np.stack([roll, pitch, yaw], axis=1)


def turning_axes(angles: Array) -> Array:
    """Return what roll, pitch and yaw turn about, in platform axes, as columns ``(N, 3, 3)``."""
    (sr, sp, _), (cr, cp, _) = np.sin(angles).T, np.cos(angles).T
    zero, one = np.zeros_like(sr), np.ones_like(sr)
    return np.moveaxis(np.array([[one, zero, -sp], [zero, cr, cp * sr], [zero, -sr, cp * cr]]), -1, 0)
