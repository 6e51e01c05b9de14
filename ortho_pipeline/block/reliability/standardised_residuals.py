"""Standardised residuals of a block: misfits over the standard deviations that they have, part by part.

Source: Baarda 1968.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.equations.elimination import Eliminated
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.points import Index
from ortho_pipeline.models.base import Array

#: Residuals are never tested at a finer scale than this part of their stated sigma (noise-free simulations).
SCALE_FLOOR = 1e-3
#: Directions in which a part has less than this share of redundancy cannot be tested in it.
_TESTABLE = 0.01
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
    points, linear = solved.problem.points, solved.linear
    rays, ray_rank = np.zeros(points.rays), np.zeros(points.rays, dtype=np.int64)
    ground, ground_rank = np.zeros(len(points)), np.zeros(len(points), dtype=np.int64)
    for rows in solved.eliminated:
        product, inner = rows.taken(solved.cofactors)
        wide = linear.by_params.shape[2]
        core = np.eye(3) + inner
        for c in range(rows.chunk.rays.shape[1]):
            used, q = rows.chunk.rays[:, c], rows.q[:, 2 * c : 2 * c + 2]
            own = linear.by_params[used]
            cross = own @ product[:, c * wide : (c + 1) * wide] @ q.swapaxes(1, 2)
            own = own @ _of_images(solved, rows.chunk.images[:, c]) @ own.swapaxes(1, 2)
            hat = q @ core @ q.swapaxes(1, 2) + own - cross - cross.swapaxes(1, 2)
            rays[used], ray_rank[used] = _standardise(hat, linear.misfits.rays[used])
        if rows.chunk.ground:
            used = rows.chunk.points
            ground[used], ground_rank[used] = _of_ground(solved, rows, core)
    weights = linear.weights
    return StandardisedResiduals(rays / weights.ray_weights, ray_rank, ground / weights.ground_weights, ground_rank)


def standardise_ground(solved: Solved) -> tuple[Array, Index]:
    """Return squared standardised residuals ``(N,)`` of known ground alone, and their degrees of freedom."""
    count = len(solved.problem.points)
    ground, rank = np.zeros(count), np.zeros(count, dtype=np.int64)
    for rows in solved.eliminated:
        if rows.chunk.ground:
            core = np.eye(3) + rows.taken(solved.cofactors)[1]
            ground[rows.chunk.points], rank[rows.chunk.points] = _of_ground(solved, rows, core)
    return ground, rank


def _of_ground(solved: Solved, rows: Eliminated, core: Array) -> tuple[Array, Index]:
    q = rows.q[:, -3:]
    # What is left after a step, as of the rays: the rows themselves have the misfits that it was taken from.
    return _standardise(q @ core @ q.swapaxes(1, 2), solved.linear.misfits.ground[rows.chunk.points])


def _of_images(solved: Solved, images: Index) -> Array:
    """Return the cofactors ``(n, p, p)`` of the parameters of some images."""
    columns = solved.problem.columns.padded
    table = solved.cofactors[columns[:, :, None], columns[:, None, :]]
    real = columns >= 0
    found: Array = np.where(real[:, :, None] & real[:, None, :], table, 0.0)[images]
    return found


def _standardise(hat: Array, misfit: Array) -> tuple[Array, Index]:
    """Return squared standardised residuals ``(n,)`` of parts with a hat matrix, and their degrees of freedom."""
    redundancy, axes = np.linalg.eigh(np.eye(hat.shape[1]) - hat)
    turned = (axes.swapaxes(1, 2) @ misfit[:, :, None])[:, :, 0]
    testable = redundancy > _TESTABLE
    squares = np.where(testable, turned**2 / np.where(testable, redundancy, 1.0), 0.0).sum(axis=1)
    return squares, testable.sum(axis=1)
