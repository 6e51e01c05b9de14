"""The collinearity equations in camera axes (x right, y up in the image, z backwards), and their derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ortho_pipeline.geodesy.ellipsoid import rotation_of_angles
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.frame.working_frame import WorkingFrame
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.light.refraction import RefractionCorrection, refraction_correction

_REFRACTION_STEPS = 12


def directions(w: Array) -> Array:
    """Return the tangents ``(N, 2)``, right and down, of vectors in camera axes ``(N, 3)``."""
    return np.stack([-w[:, 0] / w[:, 2], w[:, 1] / w[:, 2]], axis=1)


def rays(interior: Interior, image: Array) -> Array:
    """Return vectors ``(N, 3)`` in camera axes of the rays of image points ``(N, 2)``, with z = -1."""
    u, v = interior.directions_of(image).T
    return np.stack([u, -v, -np.ones_like(u)], axis=1)


def image_by_vector(interior: Interior, w: Array) -> Array:
    """Return d(image)/d(vector in camera axes) ``(N, 2, 3)`` at such vectors ``(N, 3)``."""
    by_direction = np.zeros((len(w), 2, 3))
    by_direction[:, 0, 0] = -1 / w[:, 2]
    by_direction[:, 1, 1] = 1 / w[:, 2]
    by_direction[:, 0, 2] = w[:, 0] / w[:, 2] ** 2
    by_direction[:, 1, 2] = -w[:, 1] / w[:, 2] ** 2
    return interior.partials_of_direction(directions(w)) @ by_direction


@dataclass(frozen=True, eq=False)
class Exterior:
    """The exterior orientation of a camera: ground points as vectors in camera axes, and rays back to the ground.

    Parameters
    ----------
    orientation : (6,)
        `EXTERIOR` in the working frame, metres and radians.
    frame : WorkingFrame
    refraction : bool
        Whether the standard atmosphere bends the rays.
    """

    orientation: Array
    frame: WorkingFrame
    refraction: bool

    @property
    def centre(self) -> Array:
        """The perspective centre ``(3,)`` in the working frame."""
        return self.orientation[:3]

    @cached_property
    def rotation(self) -> Array:
        """Rotation ``(3, 3)`` from the working frame to the camera, M of equation 3."""
        rotation = rotation_of_angles(*self.orientation[3:].tolist())
        rotation.setflags(write=False)
        return rotation

    def vectors(self, ground: Array) -> Array:
        """Return the vectors ``(N, 3)`` from the camera to points, in its axes; NaN if it cannot see them."""
        place = self.frame.from_ground(ground)
        line = place - self.centre
        hidden = self.frame.behind_the_earth(ground, place, line)
        if self.refraction:
            up = self.frame.verticals(ground)
            line = line + self._corrections(ground, place, up).height[:, None] * up
        w = line @ self.rotation.T
        w[~(w[:, 2] < 0) | hidden] = np.nan
        return w

    def by_ground(self, ground: Array) -> Array:
        """Return d(vectors)/d(ground) as ``(N, 3, 3)``."""
        moved = self.frame.partials(ground)
        if self.refraction:
            up = self.frame.verticals(ground)
            correction = self._corrections(ground, self.frame.from_ground(ground), up)
            rise = np.einsum("ni,nij->nj", correction.by_point, moved)
            rise[:, 2] += correction.by_height
            moved = moved + up[:, :, None] * rise[:, None, :]
        return self.rotation @ moved

    def by_orientation(self, ground: Array, w: Array) -> Array:
        """Return d(vectors)/d(orientation) as ``(N, 3, 6)`` of points with the vectors `w`."""
        moved = np.empty((len(ground), 3, 6))
        moved[:, :, :3] = -self.rotation
        if self.refraction:
            up = self.frame.verticals(ground)
            correction = self._corrections(ground, self.frame.from_ground(ground), up)
            moved[:, :, :3] += (up @ self.rotation.T)[:, :, None] * correction.by_centre[:, None]
        # The axes of omega, phi and kappa in the camera: phi turns about the second axis after kappa.
        kappa = float(self.orientation[5])
        second = np.array([math.sin(kappa), math.cos(kappa), 0.0])
        for column, axis in enumerate((self.rotation[:, 0], second, np.array([0.0, 0.0, 1.0])), start=3):
            moved[:, :, column] = np.cross(w, axis)
        return moved

    def follow(self, seen: Array, height: Array) -> Array:
        """Intersect rays in camera axes ``(N, 3)`` with ellipsoidal heights ``(N,)``; NaN where they miss."""
        way = seen @ self.rotation
        way /= np.linalg.norm(way, axis=1)[:, None]
        ground = self._meet(way, height, 0.0)
        for _ in range(_REFRACTION_STEPS if self.refraction else 0):
            before = ground
            correction = self._corrections(ground, self.frame.from_ground(ground), self.frame.verticals(ground))
            ground = self._meet(way, height, correction.height)
            if not (np.abs(ground - before)[:, :2] > 1e-15 * np.abs(ground[:, :2])).any():
                break
        hidden = ~np.isfinite(self.vectors(ground)).all(axis=1)
        ground[hidden | ~np.isfinite(height)] = np.nan
        return ground

    def steepness(self, ground: Array) -> Array:
        """Return the cosines of the zenith angles ``(N,)`` of the camera at ground points."""
        line = self.centre - self.frame.from_ground(ground)
        return np.asarray(np.abs((line * self.frame.verticals(ground)).sum(axis=1)) / np.linalg.norm(line, axis=1))

    def _meet(self, way: Array, height: Array, correction: Array | float) -> Array:
        """Return where straight lines meet heights plus a correction, as points at these heights."""
        ground = self.frame.meet(self.centre, way, height + correction)
        ground[np.isfinite(ground[:, 2]), 2] = height[np.isfinite(ground[:, 2])]
        return ground

    def _corrections(self, ground: Array, place: Array, up: Array) -> RefractionCorrection:
        top = float(self.frame.to_ground(self.centre)[2])
        return refraction_correction(
            ground[:, 2], place, up, centre=self.centre, top=top, curvature=self.frame.curvature
        )
