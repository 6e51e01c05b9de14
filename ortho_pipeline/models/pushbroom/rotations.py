"""Rotations of the platform: roll, pitch and yaw as matrices, and back."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array


def are_rotations(turns: Array) -> bool:
    """Return whether all matrices ``(N, 3, 3)`` are rotations, to six digits.

    Examples
    --------
    >>> are_rotations(np.eye(3)[None])
    True
    """
    miss = np.swapaxes(turns, 1, 2) @ turns - np.eye(3)
    return bool(np.abs(miss).max(initial=0.0) <= 3e-6 and (np.linalg.det(turns) > 0).all())


def exact_rotation(matrix: Array, field: str) -> Array:
    """Return the exact rotation ``(3, 3)``, read-only, of a matrix that may be rounded.

    Raises
    ------
    InputError
        If it is not a rotation; the error names the field.
    """
    if not are_rotations(matrix[None]):
        raise InputError("this matrix is not a rotation", field=field)
    # Rounding makes the inverse differ from the transpose.
    if np.abs(matrix.T @ matrix - np.eye(3)).max() > 1e-12:
        left, _, right = np.linalg.svd(matrix)
        matrix = left @ right
        matrix.setflags(write=False)
    return matrix


def rotations(angles: Array) -> Array:
    """Return the rotations R_P ``(N, 3, 3)`` of roll, pitch, yaw ``(N, 3)`` (rad).

    Examples
    --------
    >>> rotations(np.zeros((1, 3)))[0].tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.0, 0.0, 1.0]]
    """
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
    """Return the axes of roll, pitch and yaw, in platform axes, as columns ``(N, 3, 3)``."""
    (sr, sp, _), (cr, cp, _) = np.sin(angles).T, np.cos(angles).T
    zero, one = np.zeros_like(sr), np.ones_like(sr)
    return np.moveaxis(np.array([[one, zero, -sp], [zero, cr, cp * sr], [zero, -sr, cp * cr]]), -1, 0)


def orbital_axes(position: Array, velocity: Array) -> Array:
    """Return R_O ``(3, 3)``: the axes forward, left, up in ECEF as columns."""
    up = position / np.linalg.norm(position)
    left = np.cross(up, velocity)
    left /= np.linalg.norm(left)
    return np.column_stack([np.cross(left, up), left, up])
