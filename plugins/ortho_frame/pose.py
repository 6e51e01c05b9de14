"""Exterior orientations as files state them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortho_pipeline.plugin import Array, angles_of_rotation


@dataclass(frozen=True)
class Pose:
    """One pose: position and angles (degrees) as written; `crs` and `camera` where the file names them."""

    source: str
    where: str
    geographic: bool
    position: tuple[float, float, float]
    angles: tuple[float, float, float]
    crs: str | None
    camera: str | None


@dataclass(frozen=True)
class Shot:
    """One shot of an OpenSfM reconstruction: a pose in east, north, up about `origin` (lon, lat, altitude)."""

    source: str
    where: str
    origin: tuple[float, float, float]
    rotation: tuple[float, float, float]
    translation: tuple[float, float, float]
    camera: str

    @property
    def turn(self) -> Array:
        """Rotation ``(3, 3)`` from east, north, up to OpenSfM's camera: x right, y down, z forward."""
        from scipy.spatial.transform import Rotation  # half of what all plugins together would take to load

        return np.asarray(Rotation.from_rotvec(self.rotation).as_matrix())

    @property
    def centre(self) -> Array:
        """Perspective centre ``(3,)`` in east, north, up, m."""
        return np.asarray(-self.turn.T @ self.translation)

    def exterior(self) -> Array:
        """Return the perspective centre (m) and omega, phi, kappa (rad) in east, north, up: ``(6,)``."""
        return np.array([*self.centre, *angles_of_rotation(np.diag([1.0, -1.0, -1.0]) @ self.turn)])
