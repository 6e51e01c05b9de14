"""Search for gross errors among control points.

The search first finds points that agree with each other, robustly: for models with few parameters by least median of
squares over minimal subsets (linearised repeatedly), for models with many parameters by removing the worst point again
and again. Then every excluded point is tested against the fit of the others, and readmitted if it agrees.

Check points and used control points are also tested, but never left out; suspicious ones are reported (`outlying`).

Source: Baarda 1968 (data snooping); Rousseeuw 1984 (LMedS).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Self

import numpy as np

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import DegeneratePoints, NotConverged, TooFewPoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.problem import SCALE_FLOOR, Problem, Solution
from ortho_pipeline.estimation.regularisation import regularised
from ortho_pipeline.estimation.statistics import chance_of, left_out, rms, squared_distances
from ortho_pipeline.files.json.records import Record
from ortho_pipeline.models.base import Array
from ortho_pipeline.points import Points
from ortho_pipeline.points.control_hull import outside_of_hull

#: Chance that the search rejects any point of a good set.
BLUNDER_RISK = 0.001
#: Chance that any point of a good set is reported as outlying, for control and for check points.
OUTLYING_RISK = 0.01
#: Check points whose errors together are this many times the expected ones are reported.
_APART = 2.0
#: Among these, points with this many times the expected error count as contradicting; good points hardly reach it.
_ONE_APART = 3.0
#: If the RMSE is this many times that of the agreeing check points, it is no measure of accuracy.
FAR_ABOVE = 2.0
#: Contradicting points that a notice or an error names.
NAMED = 10
#: From this many check points on, their own scatter is the scale, if it is larger than that of the control points.
_OWN_SCATTER = 5
#: This many measured check points determine their common offset from matches.
_OWN_PLACE = 3
#: Median of a chi-squared variable of two degrees of freedom.
_MEDIAN_OF_TWO = 2 * math.log(2)
#: If a larger share of the control points is rejected, this is an error.
REJECTED_LIMIT = 0.3
#: A point with a smaller determinant of its redundancy is not tested.
_TESTABLE = 1e-6
#: Error of a point without an image (px): its square is still finite.
_FAR = 1e150
_SUBSETS = 500
#: Largest number of residuals of subsets in memory together.
_RESIDUALS_AT_ONCE = 1_000_000
#: For models with more parameters, minimal subsets nearly always contain a bad point.
_FEW_PARAMETERS = 14
_ROUNDS = 4


def find_blunders(problem: Problem, ridge: float | str | None = None) -> tuple[np.ndarray, dict[int, str]]:
    """Return the mask of points to keep ``(n,)``, and the reason for each rejected point.

    If the regularisation is to be found, it is found again without the suspected points.
    """
    count = len(problem.rows)
    keep = np.ones(count, dtype=bool)
    few = len(problem.model.params) <= _FEW_PARAMETERS and not problem.ridge
    solution = _common(problem) if few else problem.solve(keep, linear=True)
    if solution.redundancy < 2 * 2:  # one redundant point can contradict, but cannot show which point is wrong
        return keep, {}
    if few:
        keep = _median_start(problem, solution)
    else:
        keep = _snooping_start(problem, solution, linear=True)
        if ridge is not None:
            problem, _ = regularised(problem, keep, ridge)
        keep = _snooping_start(problem, problem.solve(keep), keep)
    if not keep.all():
        problem = _restarted(problem, keep)
    reasons: dict[int, str] = {}
    # Too many points are suspected first: readmit those that agree with the others, until none is left.
    while not keep.all():
        chances, sizes = _chance(problem, keep)
        agree = ~keep & (chances >= BLUNDER_RISK / count)
        if not agree.any():
            reasons = {int(i): _reason(sizes[i]) for i in np.flatnonzero(~keep)}
            break
        keep = keep | agree
    return keep, reasons


def refuse_many(names: Sequence[str], count: int, what: str, source: str, remedy: str) -> None:
    """Raise an error if too large a share of `count` contradicts the others to decide which are wrong."""
    if len(names) > REJECTED_LIMIT * count:
        some = ", ".join(names[:NAMED]) + (" ..." if len(names) > NAMED else "")
        raise DegeneratePoints(
            f"{len(names)} of {counted(count, what)} contradict the others ({some}), too many "
            "to decide which are wrong",
            file=source or None,
            remedy=remedy,
        )


def _common(problem: Problem) -> Solution:
    """Return the solution of all points, or one step towards it if gross errors prevent it."""
    everything = np.ones(len(problem.rows), dtype=bool)
    try:
        return problem.solve(everything)
    except (DegeneratePoints, NotConverged):
        return problem.solve(everything, linear=True)


def _restarted(problem: Problem, keep: np.ndarray) -> Problem:
    """Return the problem started from some points, if they determine it.

    Then gross errors no longer influence the start, nor the projection of ground errors into the image.
    """
    try:
        return problem.started(problem.solve(keep).model)
    except (DegeneratePoints, NotConverged, TooFewPoints):
        return problem


def _reason(size: float) -> str:
    if not math.isfinite(size):
        return "gross error: the fit to the other points does not project it"
    return f"gross error: {size:.1f} px from where the other points predict it"


def _median_start(problem: Problem, solution: Solution) -> np.ndarray:
    """Return a clean subset ``(n,)``; linearise again until the linear prediction of its solution holds."""
    keep = _median_subset(solution, len(problem.priors))
    for _ in range(_ROUNDS):
        try:
            fitted = problem.started(solution.model).solve(keep)
        except (DegeneratePoints, NotConverged):
            return keep
        step = fitted.model.params - solution.model.params
        linear = solution.residuals - solution.jacobian @ step
        residuals = problem.image - fitted.model.ground_to_image(problem.ground)
        with np.errstate(invalid="ignore"):
            bent = ~(np.abs(problem.errors.whitened(residuals - linear)) < 0.1).all(axis=1)
        if not bent.any() or not np.isfinite(residuals).all():
            return keep
        # The common solution was so far off that the model is not linear in between: repeat from the clean one.
        jacobian = fitted.model.param_partials(problem.ground)
        solution = Solution(
            fitted.model,
            jacobian,
            residuals,
            problem.started(fitted.model).errors,
            fitted.cofactors,
            fitted.freedom,
            fitted.effective,
            fitted.sigma0,
            fitted.condition,
            problem.points.groups,
        )
        again = _median_subset(solution, len(problem.priors))
        if (again == keep).all():
            return keep
        keep = again
    return keep


def _median_subset(solution: Solution, priors: int) -> np.ndarray:
    """Return a clean subset ``(n,)`` by least median of squares on the linearised problem."""
    jacobian, residuals = (solution.errors.whitened(values) for values in (solution.jacobian, solution.residuals))
    count, params = len(jacobian), jacobian.shape[2]
    size = max(1, math.ceil((params - priors) / 2), 0 if priors else solution.model.minimum_points)
    subsets = np.array(_minimal_subsets(count, size))
    # Linear in a step from the common solution; a minimal subset with 2 * size > params is solved by least squares.
    inverses = np.linalg.pinv(jacobian[subsets].reshape(len(subsets), 2 * size, params))
    steps = (inverses @ residuals[subsets].reshape(len(subsets), 2 * size, 1))[:, :, 0]
    half = (count + size + 1) // 2

    def squares(some: np.ndarray) -> np.ndarray:
        left = residuals[None] - (some @ jacobian.reshape(-1, params).T).reshape(len(some), count, 2)
        return (left**2).sum(axis=2)

    # All subsets together have 500 residuals per point, which is gigabytes for matched points.
    parts = np.array_split(steps, math.ceil(len(steps) * count / _RESIDUALS_AT_ONCE))
    merit = np.concatenate([np.partition(squares(part), half - 1, axis=1)[:, half - 1].copy() for part in parts])
    best = int(np.argmin(merit))
    keep = np.zeros(count, dtype=bool)
    keep[np.argsort(squares(steps[best : best + 1])[0], kind="stable")[: max(half, size + 1)]] = True
    return keep


def _minimal_subsets(count: int, size: int) -> list[list[int]]:
    if math.comb(count, size) <= _SUBSETS:
        return [list(subset) for subset in itertools.combinations(range(count), size)]
    generator = np.random.default_rng(0)  # the same points always give the same result
    return [sorted(generator.choice(count, size, replace=False).tolist()) for _ in range(_SUBSETS)]


def _snooping_start(
    problem: Problem, solution: Solution, keep: np.ndarray | None = None, *, linear: bool = False
) -> np.ndarray:
    """Return the points ``(n,)`` that remain when the worst point is removed again and again."""
    count = len(problem.rows)
    keep = np.ones(count, dtype=bool) if keep is None else keep.copy()
    # One more than the limit: then the caller raises an error.
    while (~keep).sum() <= REJECTED_LIMIT * count and keep.sum() > problem.fewest:
        tested = _against_others(solution)
        if tested is None:
            break
        # If chances underflow to zero, the ratio still shows which is worst.
        worst = int(np.argmax(tested.ratios))
        if tested.chances[worst] >= BLUNDER_RISK / count:
            break
        keep[np.flatnonzero(keep)[worst]] = False
        try:
            solution = problem.started(solution.model).solve(keep, linear=linear)
        except (DegeneratePoints, NotConverged, TooFewPoints):
            break
    return keep


class _Tested(NamedTuple):
    """Tests of points ``(n,)`` against the others: squared distance over variance, its chance, and the variance.

    The distance is 0 for a point whose position the others do not determine. `redundancy` ``(n, 2, 2)`` has the blocks
    of `Solution.redundancy_blocks`.
    """

    redundancy: Array
    ratios: Array
    chances: Array
    others: Array


def _against_others(solution: Solution) -> _Tested | None:
    """Test the residual of each point; None without enough redundancy."""
    redundancy = solution.redundancy_blocks()
    apart = left_out(redundancy, solution.errors.whitened(solution.residuals), known=0.0)
    squares, freedom = np.where(np.linalg.det(redundancy) > _TESTABLE, apart.squares, 0.0), solution.freedom - 2
    if solution.sigma0 is None or freedom < 1:
        return None
    others = np.maximum((solution.sigma0**2 * solution.freedom - squares) / freedom, SCALE_FLOOR**2)
    return _Tested(redundancy, squares / others, chance_of(squares / others, 2, freedom), others)


def _chance(problem: Problem, keep: np.ndarray) -> tuple[Array, Array]:
    """Return for each point the chance of its distance from the fit of the kept points, and that distance (px)."""
    try:
        solution = problem.solve(keep)
    except (DegeneratePoints, TooFewPoints):
        return np.ones(len(keep)), np.zeros(len(keep))
    apart = _Apart.of(solution, problem)
    scale = 1.0 if solution.sigma0 is None else max(solution.sigma0, SCALE_FLOOR)
    return chance_of(apart.squares / scale**2, 2, max(solution.freedom, 1.0)), np.hypot(*apart.miss.T)


# -- outlying points -------------------------------------------------------------------------------------------------


Role = Literal["control", "check"]


class OutlyingPoint(Record):
    """A point that contradicts the others and still counts."""

    # `distance` (px) from the position that the fit of the others predicts, `expected` root mean square of this
    # distance for good points, and `chance` that a good point has such a distance. `leverage` is the share (0 to 1) of
    # its own residual that the point removes: 0 for check points, small for control points among many.
    id: str
    role: Role
    distance: float
    expected: float
    chance: float
    leverage: float
    reason: str

    @classmethod
    def of(cls, name: str, role: Role, distance: float, expected: float, chance: float, leverage: float = 0.0) -> Self:
        """Return the point with its reason as a sentence, without the name."""
        text = (
            f"{significant(distance, 3)} px from where the other points predict it ({significant(expected)} px "
            "expected). Measure it again: "
        )
        if role == "check":
            text += "it still counts in the RMSE of the check points"
        else:
            text += f"it still takes part in the adjustment (leverage {leverage:.2f})"
        return cls(
            id=name, role=role, distance=distance, expected=expected, chance=chance, leverage=leverage, reason=text
        )


def outlying(
    solution: Solution, points: Points, used: np.ndarray, common: Array | None = None
) -> tuple[OutlyingPoint, ...]:
    """Return check points and used control points that contradict the fit; none without redundancy.

    A check point is tested with its own uncertainty and that of the model. With five or more check points, their median
    scatter is the scale if it is larger than sigma0: a model that is poor everywhere makes no point an outlier. A
    control point is tested by its leave-one-out residual, against the sigma0 of the others. In this test, an error that
    is common to the control points stays as all of them estimate it; `Fit.loo_residuals` estimate it without the point.

    `common` ``(P, P)`` is the covariance of the parameters from an error common to the control points; it also counts
    for check points without this error. If all control points were matched and this error is not stated, measured
    check points are only compared with each other, because a common offset comes from the reference.
    """
    if solution.sigma0 is None:
        return ()
    return (
        *_outlying_control(solution, points, used),
        *_outlying_checks(solution, points, used, float(solution.sigma0), common),
    )


def _outlying_control(solution: Solution, points: Points, used: np.ndarray) -> list[OutlyingPoint]:
    tested = _against_others(solution)
    rows, outliers = np.flatnonzero(used), []
    if tested is None or not (tested.chances < OUTLYING_RISK / len(rows)).any():
        return []
    redundancy, left = tested.redundancy, solution.leave_each_out()
    for i in np.flatnonzero(tested.chances < OUTLYING_RISK / len(rows)).tolist():
        spread = solution.errors[np.array([i])].mean_square(np.linalg.inv(redundancy[i : i + 1]).astype(float))
        expected = math.sqrt(float(tested.others[i] * spread[0]))
        chance, leverage = float(tested.chances[i]), float(1 - np.trace(redundancy[i]) / 2)
        name = points.ids[rows[i]]
        outliers.append(OutlyingPoint.of(name, "control", float(np.hypot(*left[i])), expected, chance, leverage))
    return outliers


@dataclass(frozen=True)
class _Apart:
    """Distances of points that did not take part in a solution: ``(n, 2)`` px, and in sigmas.

    `partials` are by the parameters, in sigmas of the points; `spread` is the expected covariance for a sigma0 of 1.
    """

    problem: Problem
    miss: Array
    partials: Array
    spread: Array

    @classmethod
    def of(cls, solution: Solution, problem: Problem) -> _Apart:
        """Return the distances of the points of a problem; infinite for those without an image."""
        miss = problem.image - solution.model.ground_to_image(problem.ground)
        miss[~np.isfinite(miss).all(axis=1)] = np.inf
        partials = np.zeros((len(miss), 2, 0))
        if len(solution.model.params):
            partials = problem.errors.whitened(solution.model.param_partials(problem.ground))
        partials[~np.isfinite(partials).all(axis=(1, 2))] = 0.0
        return cls(problem, miss, partials, np.eye(2) + partials @ solution.cofactors @ partials.transpose(0, 2, 1))

    @property
    def squares(self) -> Array:
        """Squared distances ``(n,)`` in sigmas; 2 on average if sigma0 is 1."""
        white = np.clip(self.problem.errors.whitened(np.clip(self.miss, -_FAR, _FAR)), -_FAR, _FAR)
        return squared_distances(white, self.spread)

    def expected(self, scale: float) -> Array:
        """Root mean square ``(n,)`` px of the distances of good points, if sigma0 squared is `scale`."""
        return np.sqrt(scale * self.problem.errors.mean_square(self.spread))


def _checks(solution: Solution, points: Points, used: np.ndarray, common: Array | None) -> _Apart | None:
    """Return the distances of check points that have an image."""
    seen = points.image - solution.model.ground_to_image(points.ground)
    usable = points.check & np.isfinite(seen).all(axis=1)
    if not usable.any():
        return None
    apart = _Apart.of(solution, Problem.of(solution.model, points, usable, {}))
    measured = apart.problem.points.groups < 0
    if common is None and measured.sum() >= _OWN_PLACE and (points.groups[used] >= 0).all():
        apart.miss[measured] -= np.median(apart.miss[measured], axis=0)
    return apart


def _outlying_checks(
    solution: Solution, points: Points, used: np.ndarray, sigma0: float, common: Array | None
) -> list[OutlyingPoint]:
    checks = _checks(solution, points, used, common)
    if checks is None:
        return []
    squares = checks.squares
    scale, freedom = max(sigma0, SCALE_FLOOR) ** 2, max(solution.freedom, 1.0)
    own = float(np.median(squares)) / _MEDIAN_OF_TWO
    if len(squares) >= _OWN_SCATTER and own > scale:
        # The median of n values is about as certain as the mean square of half as many.
        scale, freedom = own, float(len(squares))
    if common is not None:
        apart = checks.problem.points.sigma_common == 0
        shared = checks.partials @ common @ checks.partials.transpose(0, 2, 1) / scale
        checks = replace(checks, spread=checks.spread + np.where(apart[:, None, None], shared, 0.0))
        squares = checks.squares
    chances = chance_of(squares / scale, 2, freedom)
    expected, rows = checks.expected(scale), checks.problem.rows
    return [
        OutlyingPoint.of(
            points.ids[rows[i]], "check", float(np.hypot(*checks.miss[i])), float(expected[i]), float(chances[i])
        )
        for i in np.flatnonzero(chances < OUTLYING_RISK / len(chances)).tolist()
    ]


def checks_apart(
    solution: Solution, points: Points, used: np.ndarray, outliers: Sequence[OutlyingPoint], *, shared: bool
) -> list[Notice]:
    """Return a notice if check points contradict the control points, so that their RMSE is no measure of accuracy.

    Single `outliers` contradict if they more than double the RMSE of the others. The others contradict together, by the
    F test of their mean square against sigma0, if their errors are at least twice the expected ones: several wrong
    check points hide each other, and a model may fit its control points but not the area between them. This second test
    is not made for matches, nor if points have a common error (`shared`); other notices judge the reference.
    """
    if solution.sigma0 is None or not len(solution.model.params):
        return []
    measured = points.groups < 0
    checks = _checks(solution, points.with_roles(np.where(points.check & ~measured, "tie", points.roles)), used, None)
    if checks is None:
        return []
    scale = max(float(solution.sigma0), SCALE_FLOOR) ** 2
    ids = np.array([points.ids[i] for i in checks.problem.rows])
    off, usual = np.isin(ids, [outlier.id for outlier in outliers]), checks.expected(scale)
    apart = not shared and measured[used].all() and _together_apart(checks.squares[~off], scale, solution.freedom)
    miss = checks.problem.image - solution.model.ground_to_image(checks.problem.ground)
    sizes = np.hypot(*miss.T)
    rest = None if off.all() else rms(sizes[~off])
    if not apart and not (off.any() and rms(sizes) > FAR_ABOVE * (rms(usual) if rest is None else rest)):
        return []
    if apart:
        off |= sizes > (_ONE_APART * usual if len(ids) > 1 else 0.0)
        rest = None if off.all() or not off.any() else rms(sizes[~off])
    far = np.lexsort((-sizes, ~off))[: min(NAMED, int(off.sum()) or 3)]
    beyond = outside_of_hull(points.image[used], checks.problem.image[off])
    without = "" if rest is None else f", {significant(rest)} px without {'it' if off.sum() == 1 else 'them'}"
    cause = "Either check points are wrong, or the model is poor between the control points"
    text = (
        f"{contradicting(int(off.sum()), len(ids), ids[far].tolist())}. "
        f"RMSE {significant(rms(sizes), 3)} px{'' if len(ids) == 1 else f' of all {len(ids)}'}{without}; "
        f"{significant(rms(usual))} px expected from the control points. "
        f"{cause if apart or rest is None else 'The other check points agree with the control points'}"
    )
    return [
        Notice(
            "checks-apart",
            text,
            count=len(ids),
            off=int(off.sum()),
            rmse=rms(sizes),
            expected=rms(usual),
            points=ids[far].tolist(),
            rest=rest,
            alike=are_alike(miss[off]),
            beyond_control=int(beyond.sum()),
        )
    ]


def are_alike(misses: Array) -> bool:
    """Return whether several errors ``(n, k)`` are one shift: their scatter is less than half of their mean."""
    mean = misses.mean(axis=0) if len(misses) else np.zeros(1)
    return len(misses) > 1 and bool(rms(np.linalg.norm(misses - mean, axis=1)) < 0.5 * np.linalg.norm(mean))


def _together_apart(squares: Array, scale: float, freedom: float) -> bool:
    """Return whether check points together have larger errors than expected, from squared distances in sigmas."""
    if not len(squares):
        return False
    total, size = float(squares.sum()) / scale, 2 * len(squares)
    return total >= size * _APART**2 and bool(chance_of(total, size, max(freedom, 1.0)) <= OUTLYING_RISK)


def contradicting(
    off: int, count: int, points: Sequence[str], what: str = "the control points", role: str = "check"
) -> str:
    """Return a sentence: `off` of `count` points of a role contradict `what`, or all together; and the worst names."""
    shown = points[:3]
    named = f"({'worst: ' if (off or count) > len(shown) else ''}{', '.join(shown)})"
    if not off:
        return f"{counted(count, f'{role} point')} together contradict {what} {named}"
    of = "" if off == count else f"{off} of "
    return f"{of}{counted(count, f'{role} point')} contradict{'s' if off == 1 else ''} {what} {named}"
