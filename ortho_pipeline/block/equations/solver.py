"""Minimum of a block's squared misfits: Gauss-Newton steps, damped where they do not descend, and what holds there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.elimination import Eliminated, Step, step_of
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Selection, State
from ortho_pipeline.block.equations.steps import Steps
from ortho_pipeline.errors import InputError, NotConverged
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.models.base import Array

_STEPS = 50


@dataclass(frozen=True, eq=False)
class Solved:
    """The observation equations at a minimum (or after one step), factored, with the cofactors of the parameters.

    Not `converged`: at the place where the iteration ended without one.
    """

    linear: Linear
    eliminated: tuple[Eliminated, ...]
    cofactors: Array
    condition: float
    iterations: int = 0
    converged: bool = True

    @property
    def problem(self) -> BlockProblem:
        return self.linear.problem

    @property
    def state(self) -> State:
        return self.linear.state

    def unit_weight(self) -> tuple[float | None, float]:
        """Return the standard error of unit weight (None without redundancy), and the degrees of freedom.

        What holds the datum, or is fictitious, is not an observation; nor are the parameters that it decides unknown.
        """
        linear, ordering, misfits = self.linear, self.linear.ordering, self.linear.misfits
        true = linear.pseudo_true
        rows = linear.pseudo_rows[~true]
        effective = self.problem.size - float(((rows @ self.cofactors) * rows).sum())
        known = int(np.isfinite(self.problem.known[ordering.grounded]).sum())
        freedom = ordering.observations + known + int(true.sum()) - (effective + 3 * ordering.points)
        square = sum(float((part**2).sum()) for part in (misfits.rays, misfits.ground))
        square += float((misfits.pseudo[true] ** 2).sum())
        # The effective number of parameters is a fraction; below half an observation there is no redundancy.
        return (math.sqrt(square / freedom) if freedom > 0.5 else None), freedom

    def ground_covariance(self, covariance: Array, factor: float) -> Array:
        """Return that of the points ``(N, 3, 3)``, east, north, up, NaN for those that take no part.

        Parameters
        ----------
        covariance : ndarray (P, P)
            Of the parameters.
        factor : float
            Square of the factor of the sigmas of measurements.
        """
        found = np.full((len(self.problem.points), 3, 3), np.nan)
        for rows in self.eliminated:
            root = np.linalg.inv(rows.r)
            inner = factor * np.eye(3) + rows.taken(covariance)[1]
            found[rows.chunk.points] = root @ inner @ root.swapaxes(1, 2)
        frame = self.problem.frame
        axes = frame.enu_at(frame.geodetic(self.state.local))
        return axes @ found @ axes.swapaxes(1, 2)


def solve(problem: BlockProblem, start: State, selection: Selection) -> Solved:
    """Minimise the squared misfits.

    Raises
    ------
    NotConverged
        If no minimum is found.
    """
    found = attempt(problem, start, selection)
    if not found.converged:
        raise NotConverged("the adjustment did not converge", remedy="give more control points or a simpler model")
    return found


def attempt(problem: BlockProblem, start: State, selection: Selection) -> Solved:
    """Minimise the squared misfits by Gauss-Newton, damped where that does not descend; see `Solved.converged`.

    Raises
    ------
    NotConverged
        If nothing can be computed at the start.
    """
    ordering = problem.ordering(selection)
    state, damping, steps = start, 0.0, Steps()
    square = problem.misfits(state, ordering, selection).square
    if not math.isfinite(square):
        raise NotConverged("the start values put points outside of the models", remedy="give better start values")
    for iteration in range(1, _STEPS + 1):
        linear = Linear.at(problem, state, selection, ordering)
        step = step_of(linear, damping)
        if not step.finite or (iteration == 1 and step.condition > CONDITION_LIMIT):
            # In a valley without a bottom the iteration would only wander: the caller says what is undetermined.
            return replace(_solved(linear, step), condition=max(step.condition, CONDITION_LIMIT * 1.01))
        change, before = step.change.vector, steps.length
        promised = float(np.linalg.norm(change))
        length = math.sqrt(square) + math.sqrt(ordering.observations)
        # Close to the minimum steps are rounding: they do not get shorter any more, or do not descend.
        small = promised <= 1e-8 * length or (promised <= 1e-6 * length and promised > before / 4)
        if small and not damping:
            return _solved(linear, step, iteration)
        whole = step.whole
        further = None if damping else steps.extrapolated(change, whole)
        ahead, after, move = _descent(linear, whole, further, square)
        if ahead is not None:
            if damping:
                steps = Steps()
            else:
                steps.made(change, whole, move)
            state, square = ahead, after
            damping = damping / 10 if damping > 1e-6 else 0.0
            continue
        steps = Steps()
        if damping:
            step = step_of(linear)
            promised = float(np.linalg.norm(step.change.vector))
        if promised <= 1e-4 * length:
            # Rounding of the ground hides what so small a step would gain.
            return _solved(linear, step, iteration)
        damping = max(10 * damping, 1e-3)
        if damping > 1e8:
            break
    return replace(_solved(linear, step_of(linear), iteration), converged=False)


def once(problem: BlockProblem, state: State, selection: Selection) -> tuple[Solved, State]:
    """Return one step's solution, with the misfits that it leaves to first order, and the state after it."""
    linear = Linear.at(problem, state, selection)
    step = step_of(linear)
    left = replace(linear, misfits=linear.misfits.minus(step.change))
    return _solved(left, step), state.moved(step.solution.values, step.shift)


def _solved(linear: Linear, step: Step, iterations: int = 0) -> Solved:
    return Solved(linear, step.eliminated, step.solution.cofactors, step.condition, iterations)


def _descent(linear: Linear, whole: Array, further: Array | None, square: float) -> tuple[State | None, float, Array]:
    """Return the state after a move that descends: further than the step, the step, or a part of it."""
    problem, state = linear.problem, linear.state
    moves = [] if further is None else [further]
    for move in (*moves, *(whole / 2.0**k for k in range(10))):
        try:
            ahead = state.moved(move[: problem.size], move[problem.size :].reshape(-1, 3))
            after = problem.misfits(ahead, linear.ordering, linear.weights).square
        except InputError:  # a correction that cannot be inverted
            after = math.nan
        # Coordinates are rounded to a billionth of a metre: what is added to a square by that is not an ascent.
        if math.isfinite(after) and after <= square * (1 + 1e-8):
            return ahead, after, move
    return None, square, whole
