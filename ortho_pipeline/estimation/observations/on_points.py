"""Direct observations of the positions of points, in addition to their rays, such as known ground.

All types have the same form for the solver, the sigmas and the search for gross errors: observed minus present position
along three axes of each point, and its sigma.

- Known ground has the axes east, north and up. Without a known height, nothing is observed along the third axis.
- A height of a surface is observed along the normal of its plane at the point (`Planes`).

A further type gives apart, axes and sigmas of its points in `block.equations.problem.BlockProblem.on_points`. The
sigmas of a block (`block.variances`) give covariances of these points along the axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.models.base import Array


@dataclass(frozen=True, eq=False)
class OnPoints:
    """Observations of the positions of n points.

    Parameters
    ----------
    apart : ndarray (n, 3)
        Observed minus present position, metres along the axes; 0 if nothing is observed.
    axes : ndarray (n, 3, 3)
        Rotations from the frame to the axes.
    sigmas : ndarray (n, 3)
        Standard deviations in metres; infinite along axes without an observation.
    """

    apart: Array
    axes: Array
    sigmas: Array

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Mask ``(n, 3)`` of the axes with an observation; each is one equation."""
        return np.isfinite(self.sigmas)

    def misfits(self, weights: Array) -> Array:
        """Return the misfits ``(n, 3)`` over their sigmas, with weights ``(n,)``."""
        return self.apart / self.sigmas * np.sqrt(weights)[:, None]

    def partials(self, weights: Array) -> Array:
        """Return the derivatives ``(n, 3, 3)`` of the prediction by the position in the frame, over the sigmas."""
        return self.axes * (np.sqrt(weights)[:, None] / self.sigmas)[:, :, None]


@dataclass(frozen=True, eq=False)
class Planes:
    """Heights of a surface under N points, each as a plane near its point: one observation along its normal.

    Parameters
    ----------
    places : ndarray (N, 3)
        A place on each plane, in the frame.
    axes : ndarray (N, 3, 3)
        Rotations from the frame to axes of which the third is the normal.
    sigmas : ndarray (N,)
        Standard deviations in metres along the normal; infinite where nothing is observed.
    """

    places: Array
    axes: Array
    sigmas: Array

    @property
    def on(self) -> NDArray[np.bool_]:
        """Of which points ``(N,)`` a height is observed."""
        return np.isfinite(self.sigmas)

    def above(self, local: Array, rows: NDArray[np.int64] | slice = slice(None)) -> Array:
        """Return how far the planes are above points of `rows` ``(n,)``, along their normals; `local` is ``(N, 3)``."""
        return np.asarray(np.einsum("nc,nc->n", self._normals[rows], self.places[rows] - local[rows]))

    @cached_property
    def _normals(self) -> Array:
        """Normals ``(N, 3)``, next to each other in memory."""
        return np.ascontiguousarray(self.axes[:, 2])
