"""Search for gross errors among control points.

Points that agree with each other are looked for first, in a way that bad ones cannot spoil: by least median of squares
over minimal subsets for models with few parameters (linearised, and linearised again where that led), by taking out the
worst point over and over for models with many. Every excluded point is then tested against the fit of the others and
comes back if it agrees with them.

What is never left out is tested too, and named: check points, and control points that stay in the fit (`outlying`).

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
from ortho_pipeline.errors import DegeneratePoints, NotConverged, TooFewPoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.problem import Problem, Solution
from ortho_pipeline.estimation.regularisation import regularised
from ortho_pipeline.estimation.statistics import chance_of, left_out, rms, squared_distances
from ortho_pipeline.files.json.records import Record
from ortho_pipeline.models.base import Array
from ortho_pipeline.points import Points
from ortho_pipeline.points.control_hull import outside_of_hull

#: Chance that a good set of points loses any of its points to the search for gross errors.
BLUNDER_RISK = 0.001
#: Chance that a set of good points has any that is named as outlying, for control and for check points.
OUTLYING_RISK = 0.01
#: Check points that are together so many times farther off than expected are told.
_APART = 2.0
#: Of these the ones are counted that are so many times as far off as expected, which hardly a good one is.
_ONE_APART = 3.0
#: An RMSE so many times that of the check points which agree is no figure to judge accuracy by.
FAR_ABOVE = 2.0
#: Contradicting points that a notice or an error names.
NAMED = 10
#: From so many check points on their own scatter counts, where it is larger than that of the control points.
_OWN_SCATTER = 5
#: Measured check points that show where they lie together beside matches.
_OWN_PLACE = 3
#: Median of a chi-squared variable of two degrees of freedom.
_MEDIAN_OF_TWO = 2 * math.log(2)
#: More than this share of rejected control points is an error, not a clean-up.
REJECTED_LIMIT = 0.3
#: Residuals are never tested at a finer scale than this part of their stated sigma (noise-free simulations).
SCALE_FLOOR = 1e-3
#: A point with a smaller determinant of its redundancy is not tested.
_TESTABLE = 1e-6
#: A point without an image is so far off (px): its square is still a number.
_FAR = 1e150
_SUBSETS = 500
#: Bound on the residuals of all subsets that are in memory together.
_RESIDUALS_AT_ONCE = 1_000_000
#: Minimal subsets of models with more parameters hardly ever are without a bad point.
_FEW_PARAMETERS = 14
_ROUNDS = 4


def find_blunders(problem: Problem, ridge: float | str | None = None) -> tuple[np.ndarray, dict[int, str]]:
    """Return the mask of points to keep ``(n,)`` and the reason for each that is not.

    A regularisation that is to be found is found once more when suspected points are out.
    """
    count = len(problem.rows)
    keep = np.ones(count, dtype=bool)
    few = len(problem.model.params) <= _FEW_PARAMETERS and not problem.ridge
    solution = _common(problem) if few else problem.solve(keep, linear=True)
    if solution.redundancy < 2 * 2:  # a single point too many can contradict, but not say who is wrong
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
    # Suspicion first falls on too many: re-admit the excluded that agree with the others, until none is left that does.
    while not keep.all():
        chances, sizes = _chance(problem, keep)
        agree = ~keep & (chances >= BLUNDER_RISK / count)
        if not agree.any():
            reasons = {int(i): _reason(sizes[i]) for i in np.flatnonzero(~keep)}
            break
        keep = keep | agree
    return keep, reasons


def refuse_many(names: Sequence[str], count: int, what: str, source: str, remedy: str) -> None:
    """Refuse to clean up where so many of `count` contradict that which of them are wrong is a guess."""
    if len(names) > REJECTED_LIMIT * count:
        some = ", ".join(names[:NAMED]) + (" ..." if len(names) > NAMED else "")
        raise DegeneratePoints(
            f"{len(names)} of {counted(count, what)} contradict the others ({some}): which of them are wrong cannot be "
            "decided",
            file=source or None,
            remedy=remedy,
        )


def _common(problem: Problem) -> Solution:
    """Return the solution of all points, or one step towards it where gross errors keep it from converging."""
    everything = np.ones(len(problem.rows), dtype=bool)
    try:
        return problem.solve(everything)
    except NotConverged:
        return problem.solve(everything, linear=True)


def _restarted(problem: Problem, keep: np.ndarray) -> Problem:
    """Return the problem started from some points, if they determine it.

    Gross errors in the start are then gone, also from the direction in which it takes errors of the ground to move.
    """
    try:
        return problem.started(problem.solve(keep).model)
    except (DegeneratePoints, NotConverged, TooFewPoints):
        return problem


def _reason(size: float) -> str:
    if not math.isfinite(size):
        return "gross error, for the other points put it outside of the model"
    return f"gross error, {size:.1f} px from where the other points put it"


def _median_start(problem: Problem, solution: Solution) -> np.ndarray:
    """Return a clean subset ``(n,)``, linearised anew until the linear prediction of its solution holds."""
    keep = _median_subset(solution, len(problem.priors))
    for _ in range(_ROUNDS):
        try:
            found = problem.started(solution.model).solve(keep)
        except (DegeneratePoints, NotConverged):
            return keep
        step = found.model.params - solution.model.params
        linear = solution.residuals - solution.jacobian @ step
        residuals = problem.image - found.model.ground_to_image(problem.ground)
        with np.errstate(invalid="ignore"):
            bent = ~(np.abs(problem.errors.whitened(residuals - linear)) < 0.1).all(axis=1)
        if not bent.any() or not np.isfinite(residuals).all():
            return keep
        # The common solution was so far off that the model is not linear on the way: look again from the clean one.
        jacobian = found.model.param_partials(problem.ground)
        solution = Solution(
            found.model,
            jacobian,
            residuals,
            problem.started(found.model).errors,
            found.cofactors,
            found.freedom,
            found.effective,
            found.sigma0,
            found.condition,
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
    size = max(1, solution.model.minimum_points, math.ceil((params - priors) / 2))
    if priors:
        size = max(1, math.ceil((params - priors) / 2))
    subsets = np.array(_minimal_subsets(count, size))
    # Linear in a step from the common solution; a minimal subset with 2 * size > params is solved by least squares.
    inverses = np.linalg.pinv(jacobian[subsets].reshape(len(subsets), 2 * size, params))
    steps = (inverses @ residuals[subsets].reshape(len(subsets), 2 * size, 1))[:, :, 0]
    half = (count + size + 1) // 2

    def squares(some: np.ndarray) -> np.ndarray:
        left = residuals[None] - (some @ jacobian.reshape(-1, params).T).reshape(len(some), count, 2)
        return (left**2).sum(axis=2)

    # All subsets at once are 500 residuals of every point: gigabytes where points are matched, not measured.
    parts = np.array_split(steps, math.ceil(len(steps) * count / _RESIDUALS_AT_ONCE))
    merit = np.concatenate([np.partition(squares(part), half - 1, axis=1)[:, half - 1].copy() for part in parts])
    best = int(np.argmin(merit))
    keep = np.zeros(count, dtype=bool)
    keep[np.argsort(squares(steps[best : best + 1])[0], kind="stable")[: max(half, size + 1)]] = True
    return keep


def _minimal_subsets(count: int, size: int) -> list[list[int]]:
    if math.comb(count, size) <= _SUBSETS:
        return [list(subset) for subset in itertools.combinations(range(count), size)]
    generator = np.random.default_rng(0)  # the same points give the same answer every time
    return [sorted(generator.choice(count, size, replace=False).tolist()) for _ in range(_SUBSETS)]


def _snooping_start(
    problem: Problem, solution: Solution, keep: np.ndarray | None = None, *, linear: bool = False
) -> np.ndarray:
    """Return the points ``(n,)`` that are left when the one that fits the others worst is taken out, over and over."""
    count = len(problem.rows)
    keep = np.ones(count, dtype=bool) if keep is None else keep.copy()
    # One more than may be rejected: the caller then says that there are too many.
    while (~keep).sum() <= REJECTED_LIMIT * count:
        tested = _against_others(solution)
        if tested is None:
            break
        # Where chances underflow to zero, the ratio still tells which is worst.
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
    """Points ``(n,)`` against the variance of the others: squared distances over it, their chances, and that variance.

    A point that the others do not determine the place of is at the distance 0. `redundancy` ``(n, 2, 2)`` are the
    blocks of `Solution.redundancy_blocks`.
    """

    redundancy: Array
    ratios: Array
    chances: Array
    others: Array


def _against_others(solution: Solution) -> _Tested | None:
    """Test the residual of each point; None where there is too little redundancy."""
    redundancy = solution.redundancy_blocks()
    apart = left_out(redundancy, solution.errors.whitened(solution.residuals), known=0.0)
    squares, freedom = np.where(np.linalg.det(redundancy) > _TESTABLE, apart.squares, 0.0), solution.freedom - 2
    if solution.sigma0 is None or freedom < 1:
        return None
    others = np.maximum((solution.sigma0**2 * solution.freedom - squares) / freedom, SCALE_FLOOR**2)
    return _Tested(redundancy, squares / others, chance_of(squares / others, 2, freedom), others)


def _chance(problem: Problem, keep: np.ndarray) -> tuple[Array, Array]:
    """Return for each point the chance of lying so far from the fit of the kept ones, and that distance in pixels."""
    try:
        solution = problem.solve(keep)
    except (DegeneratePoints, TooFewPoints):
        return np.ones(len(keep)), np.zeros(len(keep))
    apart = _Apart.of(solution, problem)
    scale = max(solution.sigma0 or 0.0, SCALE_FLOOR)
    return chance_of(apart.squares / scale**2, 2, max(solution.freedom, 1.0)), np.hypot(*apart.miss.T)


# -- what is not left out --------------------------------------------------------------------------------------------


Role = Literal["control", "check"]


class OutlyingPoint(Record):
    """A point that contradicts the others and still counts."""

    # Its distance (px) from where the fit of the others puts it, the root mean square of such distances for good
    # points, and the chance of so large a one for a good point. Leverage is the share (0 to 1) of its own residual that
    # it takes away: 0 for check points, and little for control points among many.
    id: str
    role: Role
    distance: float
    expected: float
    chance: float
    leverage: float
    reason: str

    @classmethod
    def of(cls, name: str, role: Role, distance: float, expected: float, chance: float, leverage: float = 0.0) -> Self:
        """Return it with the sentence about it, without its name."""
        said = f"{distance:.3g} px from where the others put it, {expected:.2g} px expected: measure it again, for it "
        if role == "check":
            said += "counts in the RMSE of the check points all the same"
        else:
            said += f"stays in the adjustment (leverage {leverage:.2f})"
        return cls(
            id=name, role=role, distance=distance, expected=expected, chance=chance, leverage=leverage, reason=said
        )


def outlying(
    solution: Solution, points: Points, used: np.ndarray, common: Array | None = None
) -> tuple[OutlyingPoint, ...]:
    """Return check points, and used control points, that contradict the fit; none without redundancy.

    A check point is tested with its own uncertainty and that of the model there; from five check points on their own
    (median) scatter is the scale where it is larger than sigma0, so that a model that is poor everywhere makes none of
    them an outlier. A control point is tested by its residual had it taken no part, against the sigma0 of the others.
    `common` ``(P, P)`` is what the error that control points have in common leaves in the parameters: check points that
    do not share it may lie off by it. Where all control was matched and nobody states that error, measured check points
    are held against each other: all of them being off alike is the reference's fault.
    """
    if solution.sigma0 is None:
        return ()
    return (
        *_outlying_control(solution, points, used),
        *_outlying_checks(solution, points, used, float(solution.sigma0), common),
    )


def _outlying_control(solution: Solution, points: Points, used: np.ndarray) -> list[OutlyingPoint]:
    tested = _against_others(solution)
    rows, found = np.flatnonzero(used), []
    if tested is None or not (tested.chances < OUTLYING_RISK / len(rows)).any():
        return []
    redundancy, left = tested.redundancy, solution.leave_each_out()
    for i in np.flatnonzero(tested.chances < OUTLYING_RISK / len(rows)).tolist():
        spread = solution.errors[np.array([i])].mean_square(np.linalg.inv(redundancy[i : i + 1]).astype(float))
        expected = math.sqrt(float(tested.others[i] * spread[0]))
        chance, leverage = float(tested.chances[i]), float(1 - np.trace(redundancy[i]) / 2)
        name = points.ids[rows[i]]
        found.append(OutlyingPoint.of(name, "control", float(np.hypot(*left[i])), expected, chance, leverage))
    return found


@dataclass(frozen=True)
class _Apart:
    """How far points that took no part in a solution are from it: ``(n, 2)`` px, and in sigmas.

    `partials` are those by the parameters in sigmas of the points, `spread` what is expected with a sigma0 of 1.
    """

    problem: Problem
    miss: Array
    partials: Array
    spread: Array

    @classmethod
    def of(cls, solution: Solution, problem: Problem) -> _Apart:
        """Return it of the points of a problem; those without an image are infinitely far off."""
        miss = problem.image - solution.model.ground_to_image(problem.ground)
        miss[~np.isfinite(miss).all(axis=1)] = np.inf
        partials = np.zeros((len(miss), 2, 0))
        if len(solution.model.params):
            partials = problem.errors.whitened(solution.model.param_partials(problem.ground))
        partials[~np.isfinite(partials).all(axis=(1, 2))] = 0.0
        return cls(problem, miss, partials, np.eye(2) + partials @ solution.cofactors @ partials.transpose(0, 2, 1))

    @property
    def squares(self) -> Array:
        """Squared distances ``(n,)`` in sigmas; 2 in the mean where sigma0 is 1."""
        white = np.clip(self.problem.errors.whitened(np.clip(self.miss, -_FAR, _FAR)), -_FAR, _FAR)
        return squared_distances(white, self.spread)

    def expected(self, scale: float) -> Array:
        """Root mean square ``(n,)`` px of the distances of good points, where sigma0 squared is `scale`."""
        return np.sqrt(scale * self.problem.errors.mean_square(self.spread))


def _checks(solution: Solution, points: Points, used: np.ndarray, common: Array | None) -> _Apart | None:
    """Return how far check points that have an image are off."""
    usable = points.check & np.isfinite(solution.model.ground_to_image(points.ground)).all(axis=1)
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
        # The median of n is about as certain as a mean square of half as many.
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
    solution: Solution, points: Points, used: np.ndarray, said: Sequence[OutlyingPoint], *, shared: bool = False
) -> list[Notice]:
    """Return a notice where check points contradict the control points, so that their RMSE tells no accuracy.

    Those that contradict by themselves (`said`) do it where they more than double the RMSE of the others. The others
    do it together, by the F test of their mean square against sigma0, where they are at least twice as far off as
    expected: several wrong check points hide each other, and a model may follow its control points and nothing between
    them. Of matches, and where points have an error in common (`shared`), that is left to what is said of their
    reference.
    """
    if solution.sigma0 is None or not len(solution.model.params):
        return []
    measured = points.groups < 0
    checks = _checks(solution, points.with_roles(np.where(points.check & ~measured, "tie", points.roles)), used, None)
    if checks is None:
        return []
    scale = max(float(solution.sigma0), SCALE_FLOOR) ** 2
    ids = np.array([points.ids[i] for i in checks.problem.rows])
    off, usual = np.isin(ids, [one.id for one in said]), checks.expected(scale)
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
    without = "" if rest is None else f", {rest:.2g} px without {'it' if off.sum() == 1 else 'them'}"
    agree = "check points are wrong, or the model is poor between the control points"
    text = (
        f"{contradicting(int(off.sum()), len(ids), ids[far].tolist())}: RMSE {rms(sizes):.3g} px"
        f"{'' if len(ids) == 1 else f' over all {len(ids)}'}{without}, where {rms(usual):.2g} px was to be expected "
        f"from the control points; {agree if apart or rest is None else 'the others agree with them'}"
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
    """Tell whether several misses ``(n, k)`` are one shift: their scatter about their mean is below half of it."""
    mean = misses.mean(axis=0) if len(misses) else np.zeros(1)
    return len(misses) > 1 and bool(rms(np.linalg.norm(misses - mean, axis=1)) < 0.5 * np.linalg.norm(mean))


def _together_apart(squares: Array, scale: float, freedom: float) -> bool:
    """Tell whether check points are farther off together than expected, by their squared distances in sigmas."""
    if not len(squares):
        return False
    total, size = float(squares.sum()) / scale, 2 * len(squares)
    return total >= size * _APART**2 and bool(chance_of(total, size, max(freedom, 1.0)) <= OUTLYING_RISK)


def contradicting(
    off: int, count: int, points: Sequence[str], what: str = "the control points", role: str = "check"
) -> str:
    """Say how many points of a role contradict `what`: `off` of `count`, or all together; and the farthest by name."""
    shown = points[:3]
    named = f"({'farthest ' if (off or count) > len(shown) else ''}{', '.join(shown)})"
    if not off:
        return f"{counted(count, f'{role} point')} together contradict {what} {named}"
    of = "" if off == count else f"{off} of "
    return f"{of}{counted(count, f'{role} point')} contradict{'s' if off == 1 else ''} {what} {named}"
