"""Standardised residuals of a block: misfits over the standard deviations that they have, part by part.

Source: Baarda 1968.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.points import Index
from ortho_pipeline.estimation.blunders import SCALE_FLOOR
from ortho_pipeline.estimation.statistics import left_out
from ortho_pipeline.models.base import Array

#: Directions in which a part has less than this share of redundancy cannot be tested in it.
TESTABLE = 0.01
#: Median of chi squared of 1, 2 and 3 degrees of freedom.
_MEDIANS = np.array([np.nan, 0.4549, 1.3863, 2.3660])


@dataclass(frozen=True, eq=False)
class StandardisedResiduals:
    """Squared standardised residuals of rays ``(M,)`` and ground ``(N,)``, and their degrees of freedom."""

    rays: Array
    ray_rank: Index
    ground: Array
    ground_rank: Index

    def scale_of_rays(self) -> float:
        """Return the robust standard error of unit weight of the rays."""
        return _root_median((self.rays / _MEDIANS[self.ray_rank])[self.ray_rank > 0])

    def scale_of_ground(self, estimated: Mask) -> float:
        """Return that of ground whose sigma is estimated; what is stated is taken as it is stated."""
        of = estimated & (self.ground_rank > 0)
        return _root_median((self.ground / _MEDIANS[self.ground_rank])[of])

    def sizes(self, estimated: Mask) -> tuple[Array, Array]:
        """Return standardised residuals of rays ``(M,)`` and ground ``(N,)``, over these scales."""
        scale = np.where(estimated, self.scale_of_ground(estimated), 1.0)
        return np.sqrt(self.rays) / self.scale_of_rays(), np.sqrt(self.ground) / scale


def _root_median(ratio: Array) -> float:
    return max(math.sqrt(float(np.median(ratio))) if len(ratio) else 1.0, SCALE_FLOOR)


def standardise(solved: Solved) -> StandardisedResiduals:
    """Standardise the residuals of everything that takes part, one by one."""
    from ortho_pipeline.block.equations import point_kernel

    linear, weights = solved.linear, solved.linear.weights
    of_rays, of_ground = solved.points.hats(solved.cofactors)
    rays, ray_rank = np.zeros(len(of_rays)), np.zeros(len(of_rays), dtype=np.int64)
    point_kernel.squares(linear.ordering.rays, of_rays, linear.misfits.rays, TESTABLE, rays, ray_rank)
    ground, ground_rank = _of_ground(solved, of_ground)
    return StandardisedResiduals(rays / weights.ray_weights, ray_rank, ground / weights.ground_weights, ground_rank)


def standardise_ground(solved: Solved) -> tuple[Array, Index]:
    """Return squared standardised residuals ``(N,)`` of known ground alone, and their degrees of freedom."""
    return _of_ground(solved, solved.points.hats(solved.cofactors)[1])


def _of_ground(solved: Solved, hats: Array) -> tuple[Array, Index]:
    """Return those of ground with a hat matrix; zero where none takes part.

    Misfits are those that are left after a step; the rows themselves have those that it was taken from.
    """
    used = solved.linear.ordering.grounded
    squares, rank = np.zeros(len(hats)), np.zeros(len(hats), dtype=np.int64)
    # A row of an unknown coordinate is empty, and has no redundancy.
    observed = (solved.linear.ground_by_point[used] != 0.0).any(axis=2)
    redundancy = observed[:, :, None] * np.eye(3) - hats[used]
    found = left_out(redundancy, solved.linear.misfits.ground[used], known=TESTABLE)
    squares[used] = found.squares
    # Heights of a surface are weighed by their squares too, but tested in `block.heights`.
    control = solved.problem.placed[used]
    rank[used[control]] = found.rank[control]
    return squares, rank
