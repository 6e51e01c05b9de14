"""Search for gross errors in a block: robust weights make the suspects, tests against all others decide.

Weights fall with the standardised residual (Huber, then of Geman and McClure), so that bad rays lose their pull however
many there are; what ends far off is a suspect. The block is then solved without the points of the suspects, and each of
these is asked which of its parts agree with the others: all of them, all but one ray, all but the known ground, or
none. Then all that takes part is tested once more, over and over until nothing changes.

A ray of a point with only two can err along the other ray unnoticed: that is geometry, not statistics.

Source: Baarda 1968 (data snooping); Huber 1981, Geman and McClure 1985 (weights).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Selection, State
from ortho_pipeline.block.equations.solver import NEAR, Solved, attempt, once, solve_inside
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.reliability.standardised_residuals import StandardisedResiduals, standardise
from ortho_pipeline.block.reliability.suspects import GrossError, Trusted, judge
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.block.variances.grid import estimate, reweighed
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.estimation.blunders import BLUNDER_RISK, SCALE_FLOOR, refuse_many
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.estimation.statistics import chance_of
from ortho_pipeline.models.base import Array

_ROBUST_ROUNDS, _TEST_ROUNDS = 6, 8
#: Robust weights that change less than this on average decide no more about who is a suspect.
_SETTLED = 0.02
_HUBER, _REDESCENDING, _SUSPECT = 2.0, 3.0, 4.0
#: Gross errors inflate a sigma that is estimated from few points: so little is enough to look closer.
_DOUBT = 2.0


@dataclass(frozen=True, eq=False)
class Found:
    """A selection without its gross errors, these, and the suspects that nothing could be decided about.

    `state` is near the solution of what is kept.
    """

    kept: Selection
    state: State
    rejected: tuple[GrossError, ...] = ()
    undecided: tuple[str, ...] = ()


def find_blunders(solved: Solved, selection: Selection) -> Found:
    """Look for gross errors in the selection.

    Parameters
    ----------
    solved : Solved
        The solution of everything in the selection, or near it: what is found is no more than a selection. Its
        equations are used up.

    Raises
    ------
    DegeneratePoints
        If more than 30 % of the control points, or of the others, would have to go.
    """
    problem, tests = solved.problem, standardise(solved)
    variances = estimate(solved)
    significant = _significant(solved, tests, variances)
    if not significant.any() and not _suspects(problem, tests, variances, _DOUBT).any():
        return Found(selection, solved.state)
    state = solved.state
    problem, robust, tests = _robust(solved, selection, tests, variances)
    suspects = _suspects(problem, tests, variances, _SUSPECT)
    worst = _worst(problem, tests, variances)
    trusted = _trusted(problem, (robust, state), selection, suspects)
    if trusted is None:
        # Weights of few points fall at random, and may leave too few: then only what all others contradict is doubted.
        suspects = significant
        trusted = _trusted(problem, (state,), selection, suspects)
    kept, rejected = selection, dict[int, GrossError]()
    for _ in range(_TEST_ROUNDS):
        if trusted is None:
            doubted = np.flatnonzero(suspects).tolist()
            if suspects[problem.active(selection) & selection.ground].all():
                _refuse_many(problem, selection, doubted)
            names = tuple(problem.points.ids[i] for i in doubted)
            return Found(kept, state, tuple(rejected.values()), names)
        kept, rejected = judge(trusted, selection, suspects)
        _refuse_many(problem, selection, list(rejected))
        # Only one solution of a large block is kept at a time: its equations are most of the memory.
        weighed, near, variances, trusted = trusted.solved.problem, trusted.solved.state, trusted.variances, None
        state, kept, more = _kept(weighed, near, kept, variances)
        if variances.estimated:
            # Suspects were the worst, and without them a sigma is found too small: the others return into it.
            more[list(rejected)] = True
            if not more.any():
                more, worst = worst, more
        else:
            more |= suspects
        if (more == suspects).all() or not more.any():
            break
        suspects = more
        trusted = _trusted(weighed, (near,), selection, suspects)
    return Found(kept, state, tuple(rejected[number] for number in sorted(rejected)))


def _kept(problem: BlockProblem, start: State, kept: Selection, variances: Variances) -> tuple[State, Selection, Mask]:
    """Return the solution without gross errors, what takes part in it, and the points that it contradicts."""
    solved, kept = solve_inside(problem, start, kept, NEAR)
    return solved.state, kept, _significant(solved, standardise(solved), variances)


def _trusted(problem: BlockProblem, starts: tuple[State, ...], selection: Selection, suspects: Mask) -> Trusted | None:
    """Return the solution without the suspects; None if that leaves no control to judge them by, or is undetermined.

    It is sought from the best of some starts: steps with robust weights can lead far away where few points keep theirs.
    """
    of_others = ~suspects[problem.points.point]
    others = Selection.of(selection.rays & of_others, selection.ground & ~suspects)
    if selection.ground.any() and not (problem.active(others) & others.ground).any():
        return None
    start = min(starts, key=lambda state: problem.square(state, others))
    solved = attempt(problem, start, others, NEAR)
    if solved.condition > CONDITION_LIMIT or not solved.converged:
        return None
    found = estimate(solved)
    found = replace(found, image=max(found.image, SCALE_FLOOR))
    return Trusted(reweighed(solved, solved.without_astray(others), found, NEAR), found)


def _robust(
    solved: Solved, selection: Selection, tests: StandardisedResiduals, variances: Variances
) -> tuple[BlockProblem, State, StandardisedResiduals]:
    """Return a solution that gross errors have little part in, its tests, and the problem with its own sigmas.

    Sigmas of measurements are often guessed. Were good ground judged by how much better than that the images agree with
    each other, it would look wrong.
    """
    problem, linear = solved.problem, solved.linear
    estimated = variances.of_ground(problem)
    for weigh in (_huber, _geman_mcclure):
        before = np.zeros(problem.points.rays)
        if linear.problem is not problem:
            linear = Linear.at(problem, linear.state, linear.weights)
        for _ in range(_ROBUST_ROUNDS):
            rays, ground = tests.sizes(estimated)
            weights = replace(selection, ray_weights=weigh(rays), ground_weights=weigh(ground))
            found, ahead = once(linear.reweighted(weights))
            if not np.isfinite(found.linear.misfits.rays).all():
                return problem, linear.state, tests
            tests, linear = standardise(found), ahead
            del found  # and with it the memory of its equations
            if np.abs(weights.ray_weights - before).mean() < _SETTLED:
                break
            before = weights.ray_weights
        if weigh is _huber:
            sigma_image = problem.points.sigma_image * tests.scale_of_rays()
            scale = tests.scale_of_ground(estimated) if estimated.any() else 1.0
            assumed = (problem.assumed[0] * scale, problem.assumed[1] * scale)
            problem = problem.with_sigmas(sigma_image, assumed)
    return problem, linear.state, tests


def _huber(size: Array) -> Array:
    return np.minimum(1.0, _HUBER / np.maximum(size, 1e-300))


def _geman_mcclure(size: Array) -> Array:
    return np.maximum(1.0 / (1.0 + (size / _REDESCENDING) ** 2) ** 2, 1e-8)


def _points_of(problem: BlockProblem, rays: Mask, ground: Mask) -> Mask:
    """Return the points ``(N,)`` that the rays or the ground of these masks belong to."""
    found = ground.copy()
    found[problem.points.point[rays]] = True
    return found


def _suspects(problem: BlockProblem, tests: StandardisedResiduals, variances: Variances, limit: float) -> Mask:
    """Return the points with a part that lies far off by the robust scale."""
    estimated = variances.of_ground(problem)
    rays, ground = tests.sizes(estimated)
    far = (tests.ground_rank > 0) & (ground > np.where(estimated, limit, _SUSPECT))
    return _points_of(problem, rays > _SUSPECT, far)


def _worst(problem: BlockProblem, tests: StandardisedResiduals, variances: Variances) -> Mask:
    """Return the point alone whose ground, of an estimated sigma, is farthest off; none if that is not far."""
    found = np.zeros(len(problem.points), dtype=bool)
    estimated = variances.of_ground(problem)
    sizes = np.where(estimated, tests.sizes(estimated)[1], 0.0)
    if sizes.max(initial=0.0) > _DOUBT:
        found[int(np.argmax(sizes))] = True
    return found


def _significant(solved: Solved, tests: StandardisedResiduals, variances: Variances) -> Mask:
    """Return the points with a part that the others contradict."""
    sigma0, freedom = solved.unit_weight()
    scale, freedom = max(1.0 if sigma0 is None else sigma0, SCALE_FLOOR), max(freedom, 1.0)
    count = max(int((tests.ray_rank > 0).sum() + (tests.ground_rank > 0).sum()), 1)

    def bad(squares: Array, rank: np.ndarray, freedom: Array | float) -> Mask:
        size = np.maximum(rank, 1)
        return np.asarray((rank > 0) & (chance_of(squares / scale**2, size, freedom) < BLUNDER_RISK / count))

    of_ground = np.where(variances.of_ground(solved.problem), min(variances.freedom, freedom), freedom)
    rays = bad(tests.rays, tests.ray_rank, freedom)
    return _points_of(solved.problem, rays, bad(tests.ground, tests.ground_rank, of_ground))


def _refuse_many(problem: BlockProblem, selection: Selection, rejected: list[int]) -> None:
    """Refuse to clean up where so much contradicts that which part is wrong is a guess."""
    points, active = problem.points, problem.active(selection)
    remedy = Text(
        "measure these points again, remove the wrong ones, or state sigmas as large as their errors ",
        "(sigma_image, sigma_xy, sigma_h; ",
        Setting("points.ground_sigma", "XY,H"),
        " for ground that states none)",
    )
    # Control of another datum contradicts what is known of the models.
    datum = Text("check their CRS and height datum (", Setting("points.crs"), ", ", Setting("points.vertical"), "), ")
    for what, mask, first in (
        ("control point", active & points.control, datum),
        ("tie and check point", active & ~points.control, Text()),
    ):
        refuse_many(
            [points.ids[i] for i in rejected if mask[i]], int(mask.sum()), what, points.source, Text(first, remedy)
        )
