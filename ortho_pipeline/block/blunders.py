"""Search for gross errors in a block: robust weights make the suspects, tests against all others decide.

Weights fall with the standardised residual (Huber, then of Geman and McClure), so that bad rays lose their pull however
many there are; what ends far off is a suspect. The block is then solved without the points of the suspects, and each of
these is asked which of its parts agree with the others: all of them, all but one ray, all but the known ground, or
none. Then all that takes part is tested once more, over and over until nothing changes.

A ray of a point with only two can err along the other ray unnoticed: that is geometry, not statistics.

Source: Baarda 1968 (data snooping); Huber 1981, Geman and McClure 1985 (weights).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.intersection import PARALLEL
from ortho_pipeline.block.points import Index
from ortho_pipeline.block.solver import BlockProblem, Eliminated, Mask, Selection, Solved
from ortho_pipeline.block.variance_components import Variances, estimate, reweighed
from ortho_pipeline.errors import DegeneratePoints, counted
from ortho_pipeline.estimation.blunders import BLUNDER_RISK, REJECTED_LIMIT
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.models.base import Array

#: Residuals are never tested at a finer scale than this part of their stated sigma (noise-free simulations).
_SCALE_FLOOR = 1e-3
#: Directions in which a part has less than this share of redundancy cannot be tested in it.
_TESTABLE = 0.01
#: The same chance for ground whose sigma is estimated: few points never reach a smaller one, and a gross error that
#: stays does more harm than a good point that goes.
_GROUND_RISK = 0.01
_ROBUST_ROUNDS, _TEST_ROUNDS = 6, 8
#: Robust weights that change less than this on average decide no more about who is a suspect.
_SETTLED = 0.02
_HUBER, _REDESCENDING, _SUSPECT = 2.0, 3.0, 4.0
#: Gross errors inflate a sigma that is estimated from few points: so little is enough to look closer.
_DOUBT = 2.0
#: Median and 95th percentile of chi squared of 1, 2 and 3 degrees of freedom.
_MEDIANS = np.array([np.nan, 0.4549, 1.3863, 2.3660])


@dataclass(frozen=True)
class Rejected:
    """What was left out of an adjustment as a gross error.

    Parameters
    ----------
    point : str
        Its id.
    what : {'ray', 'ground', 'point'}
        One measurement, the known ground of a control point, or the point as a whole.
    image : str or None
        Of a ray.
    reason : str
        For people.
    """

    point: str
    what: str
    image: str | None
    reason: str


@dataclass(frozen=True, eq=False)
class Tests:
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
    return max(math.sqrt(float(np.median(ratio))) if len(ratio) else 1.0, _SCALE_FLOOR)


def tests_of(problem: BlockProblem, solved: Solved) -> Tests:
    """Return the tests of everything that takes part, one by one."""
    points, linear = problem.points, solved.linear
    rays, ray_rank = np.zeros(points.rays), np.zeros(points.rays, dtype=np.int64)
    ground, ground_rank = np.zeros(len(points)), np.zeros(len(points), dtype=np.int64)
    for rows in solved.eliminated:
        product, inner = problem.taken(rows, solved.cofactors)
        wide = linear.by_params.shape[2]
        core = np.eye(3) + inner
        for c in range(rows.chunk.rays.shape[1]):
            used, q = rows.chunk.rays[:, c], rows.q[:, 2 * c : 2 * c + 2]
            own = linear.by_params[used]
            cross = own @ product[:, c * wide : (c + 1) * wide] @ q.swapaxes(1, 2)
            own = own @ _blocks(problem, solved.cofactors, rows.chunk.images[:, c]) @ own.swapaxes(1, 2)
            hat = q @ core @ q.swapaxes(1, 2) + own - cross - cross.swapaxes(1, 2)
            rays[used], ray_rank[used] = _test(hat, linear.ray_misfit[used])
        if rows.chunk.ground:
            used = rows.chunk.points
            ground[used], ground_rank[used] = _test_ground(rows, core)
    weights = linear.weights
    return Tests(rays / weights.ray_weights, ray_rank, ground / weights.ground_weights, ground_rank)


def tests_of_ground(problem: BlockProblem, solved: Solved) -> tuple[Array, Index]:
    """Return the squared standardised residuals ``(N,)`` of known ground alone, and their degrees of freedom."""
    ground, rank = np.zeros(len(problem.points)), np.zeros(len(problem.points), dtype=np.int64)
    for rows in solved.eliminated:
        if rows.chunk.ground:
            core = np.eye(3) + problem.taken(rows, solved.cofactors)[1]
            ground[rows.chunk.points], rank[rows.chunk.points] = _test_ground(rows, core)
    return ground, rank


def _test_ground(rows: Eliminated, core: Array) -> tuple[Array, Index]:
    q = rows.q[:, -3:]
    return _test(q @ core @ q.swapaxes(1, 2), rows.linear.ground_misfit[rows.chunk.points])


def _blocks(problem: BlockProblem, cofactors: Array, images: Index) -> Array:
    """Return the cofactors ``(n, p, p)`` of the parameters of some images."""
    columns = problem.columns
    table = cofactors[columns[:, :, None], columns[:, None, :]]
    real = columns >= 0
    blocks: Array = np.where(real[:, :, None] & real[:, None, :], table, 0.0)[images]
    return blocks


def _test(hat: Array, misfit: Array) -> tuple[Array, Index]:
    """Return squared standardised residuals ``(n,)`` of parts with a hat matrix, and their degrees of freedom."""
    spare, axes = np.linalg.eigh(np.eye(hat.shape[1]) - hat)
    turned = (axes.swapaxes(1, 2) @ misfit[:, :, None])[:, :, 0]
    testable = spare > _TESTABLE
    squares = np.where(testable, turned**2 / np.where(testable, spare, 1.0), 0.0).sum(axis=1)
    return squares, testable.sum(axis=1)


@dataclass(frozen=True, eq=False)
class Found:
    """What is kept of a selection, what is rejected, and the suspects that nothing could be decided about."""

    kept: Selection
    rejected: tuple[Rejected, ...] = ()
    undecided: tuple[str, ...] = ()


def find_blunders(problem: BlockProblem, solved: Solved, selection: Selection) -> Found:
    """Look for gross errors in the selection.

    Parameters
    ----------
    solved : Solved
        The solution of everything in the selection.

    Raises
    ------
    DegeneratePoints
        If more than 30 % of the control points, or of the others, would have to go.
    """
    tests = tests_of(problem, solved)
    variances = estimate(problem, solved)
    significant = _significant(problem, solved, tests, variances)
    if not significant.any() and not _suspects(problem, tests, variances, _DOUBT).any():
        return Found(selection)
    problem, robust = _robust(problem, solved, selection, tests, variances)
    tests = tests_of(problem, robust)
    suspects = _suspects(problem, tests, variances, _SUSPECT)
    worst = _worst(problem, tests, variances)
    trusted = _trusted(problem, (robust, solved), selection, suspects)
    if trusted is None:
        # Weights of few points fall at random, and may leave too few: then only what all others contradict is doubted.
        suspects = significant
        trusted = _trusted(problem, (solved,), selection, suspects)
    kept, rejected = selection, dict[int, Rejected]()
    for _ in range(_TEST_ROUNDS):
        if trusted is None:
            doubted = np.flatnonzero(suspects).tolist()
            if suspects[problem.active(selection) & selection.ground].all():
                _refuse_many(problem, selection, doubted)
            return Found(kept, tuple(rejected.values()), tuple(problem.points.ids[i] for i in doubted))
        kept, rejected = _judged(trusted, selection, suspects)
        _refuse_many(problem, selection, list(rejected))
        solved = trusted.problem.solve(trusted.solved.state, kept)
        tests = tests_of(trusted.problem, solved)
        more = _significant(trusted.problem, solved, tests, trusted.variances)
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
        trusted = _trusted(trusted.problem, (trusted.solved,), selection, suspects)
    return Found(kept, tuple(rejected[number] for number in sorted(rejected)))


@dataclass(frozen=True, eq=False)
class _Trusted:
    """The solution of everything but the suspects, with the sigmas that its observations have by themselves."""

    problem: BlockProblem
    solved: Solved
    variances: Variances


def _trusted(
    problem: BlockProblem, starts: tuple[Solved, ...], selection: Selection, suspects: Mask
) -> _Trusted | None:
    """Return the solution without the suspects; None if that leaves no control to judge them by, or is undetermined.

    It is sought from the best of some starts: steps with robust weights can lead far away where few points keep theirs.
    """
    of_others = ~suspects[problem.points.point]
    others = Selection.of(selection.rays & of_others, selection.ground & ~suspects)
    if selection.ground.any() and not (problem.active(others) & others.ground).any():
        return None
    start = min((one.state for one in starts), key=lambda state: problem.square(state, others))
    solved = problem.attempt(start, others)
    if solved.condition > CONDITION_LIMIT or not solved.converged:
        return None
    found = estimate(problem, solved)
    found = replace(found, image=max(found.image, _SCALE_FLOOR))
    return _Trusted(*reweighed(problem, solved, others, found), found)


def _robust(
    problem: BlockProblem, solved: Solved, selection: Selection, tests: Tests, variances: Variances
) -> tuple[BlockProblem, Solved]:
    """Return a solution that gross errors have little part in, and the problem with the sigmas that it has by itself.

    Sigmas of measurements are often guessed. Were good ground judged by how much better than that the images agree with
    each other, it would look wrong.
    """
    state = solved.state
    estimated = _estimated(problem, variances)
    for weigh in (_huber, _geman_mcclure):
        before = np.zeros(problem.points.rays)
        for _ in range(_ROBUST_ROUNDS):
            rays, ground = tests.sizes(estimated)
            weights = replace(selection, ray_weights=weigh(rays), ground_weights=weigh(ground))
            found, ahead = problem.once(state, weights)
            if not (math.isfinite(found.condition) and np.isfinite(found.linear.ray_misfit).all()):
                return problem, replace(solved, linear=replace(solved.linear, state=state))
            solved, state = found, ahead
            tests = tests_of(problem, solved)
            if np.abs(weights.ray_weights - before).mean() < _SETTLED:
                break
            before = weights.ray_weights
        if weigh is _huber:
            points = problem.points
            sigma_image = points.sigma_image * tests.scale_of_rays()
            scale = tests.scale_of_ground(estimated) if estimated.any() else 1.0
            assumed = (problem.assumed[0] * scale, problem.assumed[1] * scale)
            problem = replace(problem, points=replace(points, sigma_image=sigma_image), assumed=assumed)
    return problem, replace(solved, linear=replace(solved.linear, state=state))


def _estimated(problem: BlockProblem, variances: Variances) -> Mask:
    """Return the points ``(N,)`` whose ground has a sigma that is estimated."""
    return np.asarray(problem.unstated.any(axis=1) & variances.estimated)


def _huber(size: Array) -> Array:
    return np.minimum(1.0, _HUBER / np.maximum(size, 1e-300))


def _geman_mcclure(size: Array) -> Array:
    return np.maximum(1.0 / (1.0 + (size / _REDESCENDING) ** 2) ** 2, 1e-8)


def _points_of(problem: BlockProblem, rays: Mask, ground: Mask) -> Mask:
    """Return the points ``(N,)`` that the rays or the ground of these masks belong to."""
    found = ground.copy()
    found[problem.points.point[rays]] = True
    return found


def _suspects(problem: BlockProblem, tests: Tests, variances: Variances, limit: float) -> Mask:
    """Return the points with a part that lies far off by the robust scale."""
    rays, ground = tests.sizes(_estimated(problem, variances))
    return _points_of(problem, rays > _SUSPECT, ground > np.where(_estimated(problem, variances), limit, _SUSPECT))


def _worst(problem: BlockProblem, tests: Tests, variances: Variances) -> Mask:
    """Return the point alone whose ground, of an estimated sigma, is farthest off; none if that is not far."""
    found = np.zeros(len(problem.points), dtype=bool)
    sizes = np.where(_estimated(problem, variances), tests.sizes(_estimated(problem, variances))[1], 0.0)
    if sizes.max(initial=0.0) > _DOUBT:
        found[int(np.argmax(sizes))] = True
    return found


def _significant(problem: BlockProblem, solved: Solved, tests: Tests, variances: Variances) -> Mask:
    """Return the points with a part that the others contradict."""
    from scipy.special import fdtrc

    sigma0, freedom = problem.unit_weight(solved)
    scale, freedom = max(1.0 if sigma0 is None else sigma0, _SCALE_FLOOR), max(freedom, 1.0)
    count = max(int((tests.ray_rank > 0).sum() + (tests.ground_rank > 0).sum()), 1)

    def bad(squares: Array, rank: np.ndarray, freedom: Array | float) -> Mask:
        size = np.maximum(rank, 1)
        return np.asarray((rank > 0) & (fdtrc(size, freedom, squares / size / scale**2) < BLUNDER_RISK / count))

    of_ground = np.where(_estimated(problem, variances), min(variances.freedom, freedom), freedom)
    return _points_of(
        problem, bad(tests.rays, tests.ray_rank, freedom), bad(tests.ground, tests.ground_rank, of_ground)
    )


# -- judging suspects ------------------------------------------------------------------------------------------------


def _judged(trusted: _Trusted, selection: Selection, suspects: Mask) -> tuple[Selection, dict[int, Rejected]]:
    """Return the selection without the parts of suspects that contradict the trusted solution, and these by point."""
    problem = trusted.problem
    of_suspects = suspects[problem.points.point]
    alone = Selection.of(selection.rays & of_suspects, selection.ground & suspects)
    rays, ground = selection.rays.copy(), selection.ground.copy()
    rejected: dict[int, Rejected] = {}
    linear = problem.linearise(trusted.solved.state, problem.layout(alone), alone)
    bar = _Bar.of(trusted, selection)
    estimated = _estimated(problem, trusted.variances)
    for rows in problem.eliminate(linear):
        suspect = _Suspects(problem, rows, trusted.solved.cofactors)
        agree, agree_without = bar.verdicts(suspect, estimated[rows.chunk.points])
        for k in np.flatnonzero(~agree).tolist():
            culprits = [part for part in suspect.parts if agree_without[part][k]]
            number = int(rows.chunk.points[k])
            rejected[number] = suspect.rejected(k, culprits)
            bad = culprits if len(culprits) == 1 else list(suspect.parts)
            rays[[rows.chunk.rays[k, part] for part in bad if part != _GROUND]] = False
            ground[number] &= _GROUND not in bad
    return Selection.of(rays, ground), rejected


@dataclass(frozen=True)
class _Bar:
    """How large the square of a contradiction may be, by its degrees of freedom.

    What contradicts ground of an estimated sigma is judged with all the sigmas that are possible, and its risk is
    shared by the control points alone.
    """

    freedom: float
    risk: float
    ground_risk: float
    variances: Variances

    @classmethod
    def of(cls, trusted: _Trusted, selection: Selection) -> _Bar:
        problem = trusted.problem
        _, freedom = problem.unit_weight(trusted.solved)
        active = problem.active(selection)
        count, control = int(active.sum()), max(int((active & selection.ground).sum()), 1)
        return cls(max(freedom, 1.0), BLUNDER_RISK / count, _GROUND_RISK / control, trusted.variances)

    def verdicts(self, suspect: _Suspects, estimated: Mask) -> tuple[Mask, dict[int, Mask]]:
        """Return which points agree with the trusted, and which do without each of their parts."""
        found = {part: suspect.contradictions(part) for part in suspect.parts}
        whole, spare = suspect.contradictions(None)
        agree = self.passes(whole, spare)
        agree_without = {part: self.passes(*found[part]) for part in found}
        if _GROUND not in suspect.parts or not estimated.any():
            return agree, agree_without
        of_rays = found[_GROUND][1]
        for k in np.flatnonzero(estimated):
            placed = suspect.ground_apart(int(k)) if of_rays > 0 else None
            if placed is None:
                agree[k] = self.passes_ground(whole[k], spare)
                continue
            apart, spread, axes = placed
            likely = self.variances.chance_of(apart, spread, axes) >= self.ground_risk
            agree[k] = likely and agree_without[_GROUND][k]
        for part, (squares, freedom) in found.items():
            if part != _GROUND:
                agree_without[part] = np.where(estimated, self.passes_ground(squares, freedom), agree_without[part])
        return agree, agree_without

    def passes_ground(self, squares: Array, spare: int) -> Mask:
        return self._passes(squares, spare, min(self.freedom, self.variances.freedom), self.ground_risk)

    def passes(self, squares: Array, spare: int) -> Mask:
        return self._passes(squares, spare, self.freedom, self.risk)

    def _passes(self, squares: Array, spare: int, freedom: float, risk: float) -> Mask:
        from scipy.special import fdtri

        limit = spare * fdtri(spare, freedom, 1 - risk) if spare > 0 else -1.0
        return np.asarray(squares <= limit)


#: The part of a suspect that is its known ground; the others are its rays, counted from 0.
_GROUND = -1


class _Suspects:
    """The rows of points of a chunk; their parts are their rays, and their ground if that is known."""

    def __init__(self, problem: BlockProblem, rows: Eliminated, cofactors: Array) -> None:
        self.problem, self.rows = problem, rows
        self.design, self.misfit = rows.q @ rows.r, rows.misfit
        self.parts = {c: np.arange(2 * c, 2 * c + 2) for c in range(rows.chunk.rays.shape[1])}
        if rows.chunk.ground:
            self.parts[_GROUND] = np.arange(self.misfit.shape[1] - 3, self.misfit.shape[1])
        self.spread = np.tile(np.eye(self.misfit.shape[1]), (len(self.misfit), 1, 1))
        for group in rows.chunk.groups:
            columns, real = problem.group_columns(rows.chunk, group)
            by_params = rows.design(group)[:, :, real]
            self.spread[group] += by_params @ cofactors[columns[:, None], columns] @ by_params.swapaxes(1, 2)

    def contradictions(self, without: int | None) -> tuple[Array, int]:
        """Return the squares ``(n,)`` by which all parts but one miss each other and the block, and their freedom."""
        keep = self._all_but(without)
        spare = len(keep) - 3
        if spare < 1:
            return np.full(len(self.misfit), math.inf), 0
        half = np.linalg.cholesky(self.spread[:, keep[:, None], keep])
        q, _ = np.linalg.qr(np.linalg.solve(half, self.design[:, keep]))
        misfit = np.linalg.solve(half, self.misfit[:, keep, None])
        left = misfit - q @ (q.swapaxes(1, 2) @ misfit)
        return (left**2).sum(axis=(1, 2)), spare

    def ground_apart(self, k: int) -> tuple[Array, Array, tuple[int, ...]] | None:
        """Return how far known ground is from where its rays and the block put it: metres, covariance, known axes.

        None where parallel rays put it nowhere.
        """
        sigmas = self.problem.ground_sigmas[self.rows.chunk.points[k]]
        axes = tuple(np.flatnonzero(np.isfinite(sigmas)).tolist())
        known = self.parts[_GROUND][list(axes)]
        rays = self._all_but(_GROUND)
        weights = np.linalg.inv(self.spread[k][np.ix_(rays, rays)])
        design, sigma = self.design[k, rays], sigmas[list(axes)]
        normal = design.T @ weights @ design
        if np.linalg.cond(normal) > PARALLEL**2:
            return None
        inverse = np.linalg.inv(normal)
        place = inverse @ design.T @ weights @ self.misfit[k, rays]
        turned = self.design[k, known] * sigma[:, None]
        return sigma * self.misfit[k, known] - turned @ place, turned @ inverse @ turned.T, axes

    def _all_but(self, without: int | None) -> np.ndarray:
        return np.concatenate([part for name, part in self.parts.items() if name != without])

    def rejected(self, k: int, culprits: list[int]) -> Rejected:
        """Return what is said of a point when it is these parts, each by itself, that could be wrong."""
        points, chunk = self.problem.points, self.rows.chunk
        name = points.ids[chunk.points[k]]
        known = _GROUND in self.parts
        if len(culprits) != 1:
            who = "its ground and its measurements contradict each other" if known else "its rays miss each other"
            size = float(np.abs(self._apart(k, None)[: 2 * chunk.rays.shape[1]]).max())
            sigma = float(points.sigma_image[chunk.rays[k]].max())
            return Rejected(
                name,
                "point",
                None,
                f"gross error: {who} by {size * sigma:.1f} px, and it cannot be decided which is wrong",
            )
        culprit = culprits[0]
        apart = self._apart(k, culprit)[self.parts[culprit]]
        if culprit == _GROUND:
            sigmas = self.problem.ground_sigmas[chunk.points[k]]
            metres = float(np.linalg.norm((apart * sigmas)[np.isfinite(sigmas)]))
            return Rejected(name, "ground", None, f"gross error: {metres:.1f} m from where its rays meet")
        ray = chunk.rays[k, culprit]
        size = float(np.hypot(*apart) * points.sigma_image[ray])
        image = points.images[points.image[ray]]
        return Rejected(name, "ray", image, f"gross error: {size:.1f} px from where the other rays and points put it")

    def _apart(self, k: int, without: int | None) -> Array:
        """Return the misfits of all rows of a point at the place that all parts but one give."""
        keep = self._all_but(without)
        place = np.linalg.lstsq(self.design[k, keep], self.misfit[k, keep], rcond=None)[0]
        apart: Array = self.misfit[k] - self.design[k] @ place
        return apart


def _refuse_many(problem: BlockProblem, selection: Selection, rejected: list[int]) -> None:
    """Refuse to clean up where so much contradicts that which part is wrong is a guess."""
    active = problem.active(selection)
    control = problem.points.control
    for what, mask in (("control point", active & control), ("tie and check point", active & ~control)):
        names = [problem.points.ids[i] for i in rejected if mask[i]]
        if len(names) > REJECTED_LIMIT * int(mask.sum()):
            some = ", ".join(names[:10]) + (" ..." if len(names) > 10 else "")
            raise DegeneratePoints(
                f"{len(names)} of {counted(int(mask.sum()), what)} contradict the others ({some}): which of "
                "them are wrong "
                "cannot be decided",
                file=problem.points.source or None,
                remedy="measure these points again, remove the wrong ones, or state sigmas as large as their errors "
                "(sigma_image, sigma_xy, sigma_h; `points.ground_sigma=XY,H` for ground that states none)",
            )
