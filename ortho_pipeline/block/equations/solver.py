"""Minimum of a block's squared misfits: Gauss-Newton steps, damped where they do not descend, and what holds there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.elimination import Elimination, Step, step_of
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Selection, State
from ortho_pipeline.block.equations.steps import Steps
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.intersection import meet, predict
from ortho_pipeline.block.points import Index
from ortho_pipeline.errors import InputError, NotConverged
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.estimation.statistics import effective_parameters, unit_weight
from ortho_pipeline.models.base import Array

#: Length of a step at which a minimum counts as reached, over the lengths of misfits and of their sigmas: the minimum
#: itself, or near enough to tell gross errors from others by it.
EXACT, NEAR = 1e-8, 1e-4
_STEPS = 50
#: Near a minimum steps shrink to this part of the one before at least: they might creep there from far away.
_SHRUNK = 0.1
#: So many steps without a descent are rounding. It is large in points that nearly parallel rays do not determine.
_RESTS = 5
#: Part of the points that a step may lead out of the models, and still be one to believe of the others.
_FEW = 0.5


@dataclass(frozen=True, eq=False)
class Solved:
    """The observation equations at a minimum (or after one step), their points factored out, and the step there.

    `undetermined`: the points leave parameters open, whatever the condition of the step's equations is. Not
    `converged`: at the place where the iteration ended without one. `astray` ``(N,)`` are points that took no part,
    because their rays lead out of the models.
    """

    linear: Linear
    step: Step
    iterations: int = 0
    converged: bool = True
    astray: Mask | None = None
    undetermined: bool = False

    @property
    def points(self) -> Elimination:
        """The points, factored out."""
        return self.step.points

    @cached_property
    def cofactors(self) -> Cofactors:
        """Those of the parameters."""
        return self.step.solution.cofactors

    @cached_property
    def heights(self) -> tuple[Index, Array]:
        """Points ``(n,)`` with a height of a surface, and the parts of the hat matrix ``(n,)`` of these heights."""
        grounded, planes = self.linear.ordering.grounded, self.problem.heights
        if planes is None:
            return grounded[:0], np.zeros(0)
        rows = grounded[planes.on[grounded]]
        return rows, np.asarray(self.points.hats(self.cofactors)[1][rows, 2, 2])

    @property
    def condition(self) -> float:
        """Condition of the reduced system."""
        return max(self.step.condition, 1.01 * CONDITION_LIMIT) if self.undetermined else self.step.condition

    @property
    def problem(self) -> BlockProblem:
        return self.linear.problem

    @property
    def state(self) -> State:
        return self.linear.state

    def without_astray(self, selection: Selection) -> Selection:
        """Return a selection without the points that are led out of the models."""
        if self.astray is None:
            return selection
        return selection.without(self.astray, self.problem.points.point)

    def unit_weight(self) -> tuple[float | None, float]:
        """Return the standard error of unit weight (None without redundancy), and the degrees of freedom.

        What holds the datum, or is fictitious, is not an observation; nor are the parameters that it decides unknown.
        Heights of a surface have a sigma of their own, of which this says nothing: they only leave less to the others.
        """
        linear, ordering, misfits = self.linear, self.linear.ordering, self.linear.misfits
        true = linear.pseudo.true
        fictitious = [(rows, self.cofactors.of_image(image)) for image, rows in linear.pseudo_by_image(~true)]
        effective = effective_parameters(self.problem.size, fictitious)
        known = int(self.problem.on_points(self.state.local, ordering.grounded).observed.sum())
        freedom = ordering.observations + known + int(true.sum()) - (effective + 3 * ordering.points)
        square = sum(float((part**2).sum()) for part in (misfits.rays, misfits.ground))
        square += float((misfits.pseudo[true] ** 2).sum())
        rows, hats = self.heights
        square -= float((misfits.ground[rows, 2] ** 2).sum())
        freedom -= float((1.0 - hats).sum())
        # Below half an observation too many there is no redundancy.
        return unit_weight(square, freedom, 0.5), freedom

    def ground_covariance(self, covariance: Cofactors, factor: float) -> Array:
        """Return that of the points ``(N, 3, 3)``, east, north, up, NaN for those that take no part.

        Parameters
        ----------
        covariance : Cofactors
            Of the parameters.
        factor : float
            Square of the factor of the sigmas of measurements.
        """
        found = self.points.ground(covariance, factor)
        frame = self.problem.frame
        axes = frame.enu_at(frame.geodetic(self.state.local))
        return axes @ found @ axes.swapaxes(1, 2)


def solve(problem: BlockProblem, start: State, selection: Selection, tolerance: float = EXACT) -> Solved:
    """Minimise the squared misfits.

    Raises
    ------
    NotConverged
        If no minimum is found.
    """
    found = attempt(problem, start, selection, tolerance)
    if not found.converged or found.astray is not None:
        raise NotConverged("the adjustment did not converge", remedy="give more control points or a simpler model")
    return found


def solve_inside(
    problem: BlockProblem, start: State, selection: Selection, tolerance: float = EXACT
) -> tuple[Solved, Selection]:
    """Minimise the squared misfits without points whose rays lead out of the models; return what takes part, too.

    Raises
    ------
    NotConverged
        If no minimum is found.
    """
    found = attempt(problem, start, selection, tolerance)
    while found.converged and found.astray is not None:
        selection = found.without_astray(selection)
        found = attempt(problem, found.state, selection, tolerance)
    if not found.converged:
        raise NotConverged("the adjustment did not converge", remedy="give more control points or a simpler model")
    return found, selection


def attempt(problem: BlockProblem, start: State, selection: Selection, tolerance: float = EXACT) -> Solved:
    """Minimise the squared misfits of all points that have a place inside of their models; see `Solved`.

    What a step leads out of them, as with nearly parallel rays or while the images are far from right, is left out at
    once: nothing is known of it there, and it must not keep the others from where they belong. Where these have come to
    rest, each such point whose rays meet takes part again, once; so does what has no place at the start (NaN). If that
    leads more points out than before, they stay out.

    Parameters
    ----------
    tolerance : {EXACT, NEAR}

    Raises
    ------
    NotConverged
        If nothing can be computed at the start.
    """
    found = _inside(problem, start, selection, tolerance)
    gone = found.astray
    if gone is None or not found.converged or found.undetermined:
        return found
    met = _met(found, gone, selection)
    back = np.asarray(np.isfinite(met).all(axis=1))
    if not back.any():
        return found
    state = replace(found.state, local=np.where(back[:, None], met, found.state.local))
    left = gone & ~back
    again = _inside(problem, state, selection.without(left, problem.points.point), tolerance)
    outside = left if again.astray is None else left | again.astray
    if not again.converged or again.undetermined or outside.sum() > gone.sum():
        return found
    iterations = found.iterations + again.iterations
    return replace(again, iterations=iterations, astray=outside if outside.any() else None)


def _met(found: Solved, gone: Mask, selection: Selection) -> Array:
    """Return where points that were led astray are ``(N, 3)`` by the models of a solution; NaN for others and nowhere.

    Known ground is where it is known to be.
    """
    problem, models = found.problem, found.state.models
    of_ray = problem.points.point
    rays = selection.rays & problem.active(selection)[of_ray] & gone[of_ray]
    met = meet(problem.frame, models, problem.points, rays)
    known = gone & selection.ground & np.isfinite(problem.target).all(axis=1)
    met[known] = problem.target[known]
    seen = np.asarray(np.isfinite(predict(problem.frame, models, problem.points, met)).all(axis=1))
    met[of_ray[rays & ~seen]] = np.nan
    met[~gone] = np.nan
    return met


def _inside(problem: BlockProblem, start: State, selection: Selection, tolerance: float) -> Solved:
    """Return the minimum without points that have no place in their models at the start, or were led out since.

    Raises
    ------
    NotConverged
        If that is most of them at the start, or nothing can be computed there.
    """
    outside, iterations = problem.active(selection) & ~np.isfinite(start.local).all(axis=1), 0
    while True:
        linear = Linear.at(problem, start, selection.without(outside, problem.points.point))
        lost = linear.lost
        if lost.sum() > _FEW * linear.ordering.points or not (lost.any() or math.isfinite(linear.misfits.square)):
            raise NotConverged("the start values put points outside of the models", remedy="give better start values")
        if lost.any():
            outside = outside | lost
            continue
        found = _descended(linear, tolerance)
        iterations += found.iterations
        if found.astray is None:
            return replace(found, iterations=iterations, astray=outside if outside.any() else None)
        outside, start = outside | found.astray, found.state


def _descended(linear: Linear, tolerance: float) -> Solved:
    """Return the minimum by Gauss-Newton, damped where that does not descend, or where a step leads points `astray`."""
    ordering, square = linear.ordering, linear.misfits.square
    damping, steps, squares = 0.0, Steps(), list[float]()
    for iteration in range(1, _STEPS + 1):
        step = step_of(linear, damping)
        if not step.finite or (iteration == 1 and step.condition > CONDITION_LIMIT):
            # In a valley without a bottom the iteration would only wander: the caller says what is undetermined.
            return Solved(linear, step, iteration, undetermined=True)
        change, before = step.change.vector, steps.length
        promised = float(np.linalg.norm(change))
        length = math.sqrt(square) + math.sqrt(ordering.observations)
        # Close to the minimum steps are rounding: they do not get shorter any more, or do not descend.
        small = promised <= EXACT * length or (promised <= 1e-6 * length and promised > before / 4)
        small |= promised <= tolerance * length and promised <= _SHRUNK * before
        small |= promised <= 1e-4 * length and square >= min(squares[:-_RESTS], default=math.inf)
        squares.append(square)
        if small and not damping:
            return Solved(linear, step, iteration)
        whole = step.whole
        further = None if damping else steps.extrapolated(change, whole)
        ahead = _descent(linear, whole, further, square)
        if ahead is not None and ahead.astray is not None:
            return Solved(linear, step, iteration, astray=ahead.astray)
        if ahead is not None:
            if damping:
                steps = Steps()
            else:
                steps.made(change, whole, ahead.move)
            linear, square = ahead.linear, ahead.linear.misfits.square
            damping = damping / 10 if damping > 1e-6 else 0.0
            continue
        steps = Steps()
        if damping:
            step = step_of(linear)
            promised = float(np.linalg.norm(step.change.vector))
        if promised <= 1e-4 * length:
            # Rounding of the ground hides what so small a step would gain.
            return Solved(linear, step, iteration)
        damping = max(10 * damping, 1e-3)
        if damping > 1e8:
            break
    return Solved(linear, step_of(linear), iteration, converged=False)


def once(linear: Linear) -> tuple[Solved, Linear]:
    """Return one step's solution, with the misfits that it leaves to first order, and the equations after it.

    Points that it leads out of the models stay where they were.
    """
    step = step_of(linear)
    left = replace(linear, misfits=linear.misfits.minus(step.change))
    ahead = _moved(linear, step.whole)
    if ahead is not None and ahead.astray is not None:
        stay = np.where(ahead.astray[:, None], linear.state.local, ahead.linear.state.local)
        ahead = replace(ahead, linear=ahead.linear.with_points_moved(stay, ahead.astray))
    usable = ahead is not None and math.isfinite(ahead.linear.misfits.square)
    return Solved(left, step), ahead.linear if ahead is not None and usable else linear


@dataclass(frozen=True, eq=False)
class _Ahead:
    """The equations after a move, and the points ``(N,)`` that it leads out of their models, if any."""

    linear: Linear
    move: Array
    astray: Mask | None


def _descent(linear: Linear, whole: Array, further: Array | None, square: float) -> _Ahead | None:
    """Return the equations after a move that descends, further than the step, the step, or a part of it.

    Or after one that leads a few points out of the models; one that does so with most of them is too long.
    """
    moves = [] if further is None else [further]
    for move in (*moves, *(whole / 2.0**k for k in range(10))):
        ahead = _moved(linear, move)
        if ahead is None:
            continue
        if ahead.astray is not None:
            if move is not further and ahead.astray.sum() <= _FEW * linear.ordering.points:
                return ahead
        # Coordinates are rounded to a billionth of a metre: what is added to a square by that is not an ascent.
        elif ahead.linear.misfits.square <= square * (1 + 1e-8):
            return ahead
    return None


def _moved(linear: Linear, move: Array) -> _Ahead | None:
    """Return the equations after a move; None where a correction cannot be inverted."""
    problem = linear.problem
    try:
        state = linear.state.moved(move[: problem.size], move[problem.size :].reshape(-1, 3))
        made = Linear.at(problem, state, linear.weights, linear.ordering)
    except InputError:
        return None
    astray = made.lost
    return _Ahead(made, move, astray if astray.any() else None)
