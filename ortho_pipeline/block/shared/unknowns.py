"""The unknowns of a block besides the parameters of images and the places of points."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.problem import BlockProblem, Selection
from ortho_pipeline.block.equations.solver import NEAR, Solved
from ortho_pipeline.block.heights.adjusted_dem import AdjustedDem
from ortho_pipeline.block.heights.record import HeightsRecord
from ortho_pipeline.block.heights.settling import Heights
from ortho_pipeline.block.shared.common_error import BlockCommonError
from ortho_pipeline.block.shared.priors import SharedPriors
from ortho_pipeline.errors import NotConverged
from ortho_pipeline.models.base import Array

#: Heights of a DEM are renewed so often before the search for gross errors.
_FIRST_ROUNDS = 1


@dataclass(frozen=True, eq=False)
class SharedUnknowns:
    """An error of known ground, the heights of a DEM with their errors, and parameters that images share."""

    error: BlockCommonError | None
    heights: Heights | None
    priors: SharedPriors | None

    def applied(self, problem: BlockProblem) -> BlockProblem:
        """Return the problem with the estimates of the error and of shared parameters."""
        for one in (self.error, self.priors):
            problem = problem if one is None else one.applied(problem)
        return problem

    def near(self, solved: Solved, selection: Selection) -> tuple[Solved, SharedUnknowns]:
        """Return a solution near that with heights and shared parameters, to look for gross errors from.

        Gross errors can lead shared parameters away. The search then begins with their stated values.
        """
        heights, priors = self.heights, self.priors
        if heights is not None:
            solved, heights = heights.settled(solved, selection, _FIRST_ROUNDS)
        if priors is not None:
            with contextlib.suppress(NotConverged):
                solved, priors, heights = priors.settled(solved, selection, heights, NEAR)
        return solved, replace(self, heights=heights, priors=priors)

    def settled(self, solved: Solved, selection: Selection) -> tuple[Solved, SharedUnknowns]:
        """Return the solution with all of them."""
        error, heights, priors = self.error, self.heights, self.priors
        if error is not None:
            solved, error = error.settled(solved, selection)
        if heights is not None:
            solved, heights = heights.settled(solved, selection)
        if priors is not None:
            solved, priors, heights = priors.settled(solved, selection, heights)
        return solved, SharedUnknowns(error, heights, priors)

    def adjusted_dem(self, record: HeightsRecord | None) -> AdjustedDem | None:
        """Return the errors of the DEM as orthos use it, less the mean of the record; None without heights."""
        if self.heights is None or record is None:
            return None
        return AdjustedDem.of(self.heights, self.priors, record.mean_error_m)

    def added(self, covariance: Cofactors) -> tuple[Cofactors, Array, Array]:
        """Return a covariance of the parameters with their parts, and the parts ``(N, 3, 3)`` of that of the ground.

        The first of these is of the error of known ground, the second of the others.
        """
        of_error, of_others = np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
        if self.error is not None:
            covariance = covariance.mixed(1.0, self.error.by_params, self.error.left)
            of_error = self.error.of_points
        for one in (None if self.heights is None else self.heights.common, self.priors):
            if one is not None:
                covariance = covariance.mixed(1.0, one.by_params, one.left)
                of_others = of_others + one.of_points
        return covariance, of_error, of_others
