"""Working frames of the exterior orientation of a frame camera.

- **topocentric**: east, north, up in metres from an origin on or near the ground. The ground is EPSG:4979; conversion
  through ECEF in closed form makes the curvature of the Earth exact.
- **map**: map coordinates and ellipsoidal heights, as in Ok and Turker. The error grows with the square of the
  footprint (d^2 / 2R: 53 m at the edge of a scene of 52 km); the orientation absorbs a part of it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import (
    SEMI_MAJOR,
    enu_from_ecef,
    enu_from_geodetic,
    geocentric,
    geodetic,
    longitudes_near,
    meet_height,
    metres_per_degree,
)
from ortho_pipeline.models.base import Array

#: The two frames: tangential to the ellipsoid below the camera, or a map projection.
TOPOCENTRIC, MAP = "topocentric", "map"
#: The ground of a topocentric frame.
GEOGRAPHIC = "EPSG:4979"


class WorkingFrame(Protocol):
    """Cartesian coordinates (m) of a camera, and their relation to the ground ``(N, 3)``."""

    #: Curvature of the Earth in this frame (1/m): how fast the vertical turns with the position.
    curvature: float

    def from_ground(self, ground: Array) -> Array:
        """Return ground points in this frame ``(N, 3)``."""

    def to_ground(self, position: Array) -> Array:
        """Return the ground coordinates ``(3,)`` of a position ``(3,)``."""

    def partials(self, ground: Array) -> Array:
        """Return d(this frame)/d(ground) as ``(N, 3, 3)``."""

    def verticals(self, ground: Array) -> Array:
        """Return the upward directions at ground points in this frame ``(N, 3)``."""

    def behind_the_earth(self, ground: Array, place: Array, line: Array) -> np.ndarray:
        """Return which lines of sight ``(N, 3)`` pass through the Earth before they reach their points `place`."""

    def meet(self, position: Array, direction: Array, height: Array) -> Array:
        """Intersect rays ``(N, 3)`` from a position ``(3,)`` with ellipsoidal heights ``(N,)``; NaN where they miss."""

    def metres_per_unit(self, position: Array) -> Array:
        """Return the length (m) ``(2,)`` of a unit of x and of y of the ground at a position."""


class Topocentric:
    """East, north, up about an origin: lon, lat (degrees), ellipsoidal height."""

    curvature = 1.0 / SEMI_MAJOR

    def __init__(self, origin: tuple[float, float, float]) -> None:
        self.origin = np.array(origin)
        #: Rotation from ECEF, and the origin in ECEF.
        self.axes, self.zero = enu_from_ecef(self.origin[None])[0], geocentric(self.origin[None])[0]

    def from_ground(self, ground: Array) -> Array:
        """Return ground points in this frame ``(N, 3)``."""
        return np.asarray((geocentric(ground) - self.zero) @ self.axes.T)

    def to_ground(self, position: Array) -> Array:
        """Return the ground coordinates ``(3,)`` of a position ``(3,)``."""
        return np.asarray(geodetic((self.zero + position @ self.axes)[None])[0])

    def partials(self, ground: Array) -> Array:
        """Return d(this frame)/d(ground) as ``(N, 3, 3)``."""
        return enu_from_geodetic(ground, self.origin)[1]

    def verticals(self, ground: Array) -> Array:
        """Return the upward directions at ground points in this frame ``(N, 3)``."""
        return np.asarray(enu_from_ecef(ground)[:, 2] @ self.axes.T)

    def behind_the_earth(self, ground: Array, place: Array, line: Array) -> np.ndarray:
        """Return which lines of sight pass through the Earth before they reach the point."""
        radial = place + self.axes @ self.zero
        length2 = (line**2).sum(axis=1)
        # Distance from the point back along the line to where it is nearest to the Earth's centre, times its length.
        back = (radial * line).sum(axis=1)
        nearest2 = (radial**2).sum(axis=1) - back**2 / length2
        sea_level = np.linalg.norm(radial, axis=1) - ground[:, 2]
        return np.asarray((back > 0) & (back < length2) & (nearest2 < sea_level**2))

    def meet(self, position: Array, direction: Array, height: Array) -> Array:
        """Intersect rays from a position with ellipsoidal heights; NaN where they miss."""
        start = np.broadcast_to(self.zero + position @ self.axes, direction.shape)
        ground = meet_height(start, direction @ self.axes, height)
        # Near the antimeridian, stay on the side of the origin.
        ground[:, 0] = longitudes_near(ground[:, 0], self.origin[0])
        return ground

    def metres_per_unit(self, position: Array) -> Array:
        """Return the lengths ``(2,)`` of a degree of longitude and of latitude at a position."""
        return np.asarray(metres_per_degree(np.array([[*position[:2], 0.0]]))[0])


class ProjectionFrame:
    """The coordinates of a map projection, as if the Earth were flat."""

    curvature = 0.0

    def from_ground(self, ground: Array) -> Array:
        """Return ground points as they are."""
        return ground

    def to_ground(self, position: Array) -> Array:
        """Return a position as it is."""
        return position.copy()

    def partials(self, ground: Array) -> Array:
        """Return the identity for each point ``(N, 3, 3)``."""
        return np.broadcast_to(np.eye(3), (len(ground), 3, 3))

    def verticals(self, ground: Array) -> Array:
        """Return the upward directions ``(N, 3)``, which are all equal."""
        return np.broadcast_to([0.0, 0.0, 1.0], ground.shape)

    def behind_the_earth(self, ground: Array, place: Array, line: Array) -> np.ndarray:
        """Return False for each point: a flat Earth hides nothing."""
        return np.zeros(len(ground), dtype=bool)

    def meet(self, position: Array, direction: Array, height: Array) -> Array:
        """Intersect rays from a position with heights; NaN where they miss."""
        distance = (height - position[2]) / direction[:, 2]
        ground = position + distance[:, None] * direction
        ground[~(distance > 0)] = np.nan
        return np.asarray(ground)

    def metres_per_unit(self, position: Array) -> Array:
        """Return one metre for x and y."""
        return np.ones(2)


def require_frame(frame: str, ground_crs: str) -> None:
    """Raise `InputError` unless the working frame exists and suits the CRS of the ground."""
    if frame not in (TOPOCENTRIC, MAP):
        raise InputError(f"{frame!r} is not a working frame", field="frame", remedy=f"use {TOPOCENTRIC} or {MAP}")
    if (frame == TOPOCENTRIC) != (ground_crs == GEOGRAPHIC):
        raise InputError(
            f"a {frame} frame cannot be used with ground in {ground_crs}",
            field="ground_crs",
            remedy=f"use {GEOGRAPHIC} for {TOPOCENTRIC}, a projected CRS for {MAP}",
        )
