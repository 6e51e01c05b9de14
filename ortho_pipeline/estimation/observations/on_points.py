"""Direct observations of the positions of points, in addition to their rays, such as known ground.

All types have the same form for the solver, the sigmas and the search for gross errors: observed minus present position
along three axes of each point, and its sigma.

- Known ground has the axes east, north and up. Without a known height, nothing is observed along the third axis.
- The height of a surface would be observed along the normal of its tangent plane at the present position.

A further type gives apart, axes and sigmas of its points in `block.equations.problem.BlockProblem.on_points`. The
sigmas of a block (`block.variances`) give covariances of these points along the axes.
"""

from __future__ import annotations

from dataclasses import dataclass

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
