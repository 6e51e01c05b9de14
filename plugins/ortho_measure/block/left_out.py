r"""Leave-one-out residuals and test values w of all measurements of a block.

They are computed by `estimation.statistics.left_out` for each ray and for the known ground of each point. If a ray
alone gives its point a distance, its error along the other ray is unknown; only the part across it is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.adjustment import pseudo_of
from ortho_pipeline.block.datum import with_datum
from ortho_pipeline.block.equations.elimination import step_of
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Selection, State
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.intersection import frame_of
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.points import Index
from ortho_pipeline.block.reliability.standardised_residuals import TESTABLE
from ortho_pipeline.block.start import Start
from ortho_pipeline.estimation.statistics import left_out, squared_distances
from ortho_pipeline.models.base import Array

#: A direction with less redundancy than this is unknown without the measurement.
_KNOWN = 1e-8
#: Least sigma (m) of ground: far below any pixel, but above rounding.
_LEAST = 1e-3


@dataclass(frozen=True, eq=False)
class LeftOutResiduals:
    """Leave-one-out residuals and tests of N points and M rays.

    Parameters
    ----------
    rays : (M, 2)
        px, measured minus predicted; NaN if unknown.
    ground : (N, 3)
        Known minus adjusted ground, m east, north, up. Residuals of check points and rejected ground need no change.
        NaN for ties, and if the others do not determine all three axes.
    w, chance : (N,)
        The largest test value among the measurements of a point, in standard deviations, and its chance for a good
        measurement. NaN without redundancy.
    """

    rays: Array
    ground: Array
    w: Array
    chance: Array

    @classmethod
    def of(cls, fit: BlockFit, starts: Mapping[str, Start], hold: float | None) -> LeftOutResiduals:
        """Return the residuals and tests of an adjustment."""
        problem, linear = _equations(fit, starts, hold)
        step = step_of(linear)
        hats = step.points.hats(step.solution.cofactors)
        misfits = linear.misfits.minus(step.change)
        points, used = fit.points, linear.ordering.rays
        rays = np.where(fit.used_rays[:, None], np.nan, fit.residuals)
        of_rays = left_out(np.eye(2) - hats[0][used], misfits.rays[used], known=_KNOWN, testable=TESTABLE)
        rays[used] = problem.points.in_pixels(of_rays.misfits, used)
        # A height of a DEM that contradicts its tie, on a roof, is none of the tie's errors.
        grounded = linear.ordering.grounded[problem.placed[linear.ordering.grounded]]
        ground = np.where(fit.used_ground[:, None], np.nan, fit.object_residuals)
        of_ground = left_out(np.eye(3) - hats[1][grounded], misfits.ground[grounded], known=_KNOWN, testable=TESTABLE)
        ground[grounded] = of_ground.whole * problem.on_points(linear.state.local, grounded).sigmas
        others = np.flatnonzero(~fit.used_ground & points.check & np.isfinite(fit.object_residuals).all(axis=1))
        tests = [
            (points.point[used], of_rays.squares, of_rays.rank),
            (grounded, of_ground.squares, of_ground.rank),
            (others, _of_checks(fit, others), np.full(len(others), 3)),
        ]
        return cls(rays, ground, *_farthest(tests, len(points), fit))


def _equations(fit: BlockFit, starts: Mapping[str, Start], hold: float | None) -> tuple[BlockProblem, Linear]:
    """Return the observation equations at the solution, with the estimated sigmas."""
    points, models = fit.points, tuple(fit.models[label] for label in fit.points.images)
    begun = tuple(fit.start[label] for label in points.images)
    priors = {label: start.priors for label, start in starts.items()}
    known = np.where(points.control[:, None], points.known_in(GEODETIC), np.nan)
    problem = BlockProblem(points, begun, frame_of(begun, points), known, pseudo_of(begun, points, priors))
    local = problem.frame.of_geodetic(fit.ground)
    selection = Selection.of(fit.used_rays, fit.used_ground)
    problem = problem.with_heights(fit.planes)
    if fit.shared_priors is not None:
        problem = fit.shared_priors.applied(problem)
    problem, _ = with_datum(problem, State(begun, local), selection, hold, fit.accuracies)
    problem = fit.variances.applied(problem)
    problem = replace(problem, assumed=(max(problem.assumed[0], _LEAST), max(problem.assumed[1], _LEAST)))
    return problem, Linear.at(problem, State(models, local), selection)


def _of_checks(fit: BlockFit, checks: Index) -> Array:
    """Return w squared of check points, including the covariance of their predicted ground."""
    plan, height = fit.variances.sigma_xy or 0.0, fit.variances.sigma_h or 0.0
    stated = fit.points.sigma_ground[checks]
    own = np.where(stated > 0, stated, (plan, plan, height))
    spread = fit.ground_covariance[checks] + own[:, :, None] ** 2 * np.eye(3)
    apart = fit.object_residuals[checks]
    return squared_distances(apart, spread)


def _farthest(tests: list[tuple[Index, Array, Index]], count: int, fit: BlockFit) -> tuple[Array, Array]:
    """Return w and chance ``(N,)`` of the least probable measurement of each point."""
    from scipy.special import chdtrc

    w, chance = np.full(count, np.nan), np.full(count, np.nan)
    if fit.sigma0 is None:
        return w, chance
    point, squares, ranks = (np.concatenate(part) for part in zip(*tests, strict=True))
    chances = chdtrc(np.maximum(ranks, 1), np.maximum(squares, 0.0))
    order = np.argsort(-chances, kind="stable")
    order = order[(ranks[order] > 0) & np.isfinite(chances[order])]
    # The last value written is the least probable one.
    w[point[order]], chance[point[order]] = np.sqrt(np.maximum(squares[order], 0.0)), chances[order]
    return w, chance
