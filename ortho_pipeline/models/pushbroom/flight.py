"""The flight of a line scanner: path and attitude at any time, with their offsets and drifts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ortho_pipeline.models.base import Array
from ortho_pipeline.models.pushbroom.kernel import Trajectory
from ortho_pipeline.models.pushbroom.rotations import rotations
from ortho_pipeline.models.pushbroom.splines import Spline


@dataclass(frozen=True, eq=False)
class Flight:
    """Position and attitude of the platform.

    Parameters
    ----------
    origin, orbital : (3,), (3, 3)
        S_O and R_O.
    path, attitude : Spline
        s (m) and roll, pitch, yaw (rad), with offset and drift.
    duration : float
        Seconds from the upper edge of the image to the lower one; negative if the lower one was exposed first.
    """

    origin: Array
    orbital: Array
    path: Spline
    attitude: Spline
    duration: float

    @property
    def middle(self) -> float:
        """Time in the middle of the image, where drifts are zero."""
        return self.duration / 2

    @cached_property
    def trajectory(self) -> Trajectory:
        """Path and attitude for the compiled projection: polynomials between all knots of both."""
        splines = (self.path, self.attitude)
        ends = np.unique(np.concatenate([spline.breaks for spline in splines]))
        # The first piece holds before the first knot.
        origins = np.concatenate([[ends[0] - 1.0], ends])
        degree = max(spline.degree for spline in splines)
        pieces = np.zeros((len(origins), degree + 1, 6))
        for k, spline in enumerate(splines):
            pieces[:, : spline.degree + 1, 3 * k : 3 * k + 3] = spline.pieces(origins)
        return Trajectory(self.orbital, self.origin, ends, origins, pieces)

    def basis(self, spline: Spline, times: Array, derivative: int = 0) -> Array:
        """Return the weights ``(N, size + 2)`` of the coefficients of a spline, its offset and its drift."""
        line = [np.ones_like(times), times - self.middle] if not derivative else [0 * times, np.ones_like(times)]
        return np.column_stack([spline.basis(times, derivative), *line])

    def positions(self, times: Array, derivative: int) -> Array:
        """Return S or dS/dt in ECEF ``(N, 3)``."""
        return self.path(times, derivative) @ self.orbital.T + (0.0 if derivative else self.origin)

    def lines(self, times: Array, look: Array, lever: Array) -> tuple[Array, Array]:
        """Return origins and directions ``(N, 3)`` in ECEF of rays along `look` ``(N, 3)`` from `lever` ``(3,)``.

        `look` and `lever` are in platform axes.
        """
        turn = rotations(self.attitude(times))
        direction = np.einsum("nij,nj->ni", turn, look) @ self.orbital.T
        local = self.path(times) + turn @ lever
        return self.origin + local @ self.orbital.T, direction
