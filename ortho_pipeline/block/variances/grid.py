r"""Variance components of a block: how good the measurements are, and how good the ground that states no sigma.

Sigmas of measurements are often guessed, those of control points often missing; an error of a control point is one
error on the ground, the same in all images, which no residual of an image can stand for. So three standard deviations
are estimated apart from the observations themselves: a factor of the sigmas of the measurements, and the unstated
sigmas of the ground in plan and in height. What is stated of the ground, or of parameters, is taken as it is stated.

With few points the components are uncertain, and plugging in one value of them would claim too much. They are
integrated out instead: restricted likelihood times a weak prior, on a grid. The covariance is the mean over that grid,
with the spread of the estimates; for a single component of :math:`\nu` degrees of freedom it is
:math:`\nu / (\nu - 2)` times that of the plain estimate, and 1.96 sigmas hold as often as Student's intervals.

Only control enters point by point: with parameters :math:`z` in which the cofactors of a solution are the unit matrix,
the normal equations of everything else are the rest of the unit matrix, so a node of the grid costs next to nothing.

Source: Patterson and Thompson 1971 (restricted likelihood); Tiao and Tan 1965 (a prior that is even in the log of the
sum of two variances); Gelman 2006 (priors of variances); Koch 2007 (in geodesy).
"""

from __future__ import annotations

import math

import numpy as np

from ortho_pipeline.block.equations.problem import PERFECT_GROUND, Selection
from ortho_pipeline.block.equations.solver import EXACT, Solved, solve
from ortho_pipeline.block.variances.components import Posterior, Variances
from ortho_pipeline.block.variances.control_equations import ControlEquations, Node
from ortho_pipeline.errors import NotConverged
from ortho_pipeline.models.base import Array

#: Ground that is wrong by more than so many pixels is hardly taken as control: there the prior falls.
_WORST_PIXELS = 20.0
#: Heights of a survey that are ten times worse than plan, or better, are one standard deviation of the prior.
_RATIO = 10.0
#: The same for the factor of the measurements: below a tenth and above ten times what was stated the prior falls.
_IMAGE_LOW, _IMAGE_HIGH = 0.1, 10.0
#: The grid begins so far (log) below what a point's own rays leave open: less of its ground cannot be seen.
_UNSEEN = 3.0
#: Step of the grid in log sigma; how much less likely than the best (log) a node may be to count.
_COARSE, _COUNTS = 0.5, 12.0
#: Matrices of points by nodes that are worth while; parameters beyond which nodes are dear.
_BUDGET, _DEAR = 40_000, 100
#: With so much redundancy the measurements' factor is as good as known.
_KNOWN = 200.0
#: How far (log) the ground's best sigmas may move when the measurements' factor does.
_NEAR = 2.1
#: Below this redundancy a component is not estimated.
_LEAST = 0.5
#: Steps of the factor of the measurements to its best value, the ground's sigmas being given.
_ROUNDS = 4
#: Sigmas of measurements that change by less than this part are the same.
_SAME = 0.03


def estimate(solved: Solved) -> Variances:
    """Return the variance components at a solution, which was found with sigmas near enough to linearise there."""
    return _Grid(solved).variances()


def posterior(solved: Solved) -> Posterior:
    """Return the variance components at a solution, and covariances with their uncertainty."""
    grid = _Grid(solved)
    return grid.posterior(grid.variances())


def reweighed(solved: Solved, selection: Selection, variances: Variances, tolerance: float = EXACT) -> Solved:
    """Return the solution with these standard deviations; as it is if nothing much changes.

    Where that does not converge or leaves parameters open, as with cameras that few points hardly determine, it stays
    as it is, too; `posterior` then counts how far the solution is from the best.
    """
    if not variances.estimated and abs(variances.image - 1.0) < _SAME:
        return solved
    try:
        found = solve(variances.applied(solved.problem), solved.state, selection, tolerance)
    except NotConverged:
        return solved
    # Next to nearly exact measurements, what holds the rest is lost in rounding.
    return solved if found.undetermined else found


class _Grid:
    """The nodes at which the components are tried: logs of the standard deviations of image, plan and height."""

    def __init__(self, solved: Solved) -> None:
        self.cofactors = solved.cofactors
        self.equations = equations = ControlEquations(solved)
        self.free = [bool(equations.unstated[:, :2].any()), bool(equations.unstated[:, 2].any())]
        self.separable = True
        self._last: tuple[Array, Node] | None = None
        far = np.log([1.0, 1e3 * equations.pixel, 1e3 * equations.pixel])
        if any(self.free) and equations.redundancy(self._at(far))[0] < _LEAST:
            # One image, or no redundancy: an error of the ground is one of the measurement.
            self.free, self.separable = [False, False], False
        self.worst = _WORST_PIXELS * equations.pixel
        self.of_rays = self._of_rays()
        self.centre = np.zeros(3)
        self._find_centre()
        # No better than the equations can tell, of the ground as well.
        while not np.isfinite(self.chances(self.centre[None])[0]) and self.centre[0] < 0.0:
            self.centre[0] = min(self.centre[0] + _COARSE, 0.0)

    def _variances(self, logs: Array) -> Array:
        """Return the variances ``(..., 3)`` at nodes."""
        nodes = np.exp(2.0 * logs)
        if not self.separable:
            nodes[..., 1:] = PERFECT_GROUND**2
        return np.asarray(nodes)

    def _at(self, logs: Array) -> Node:
        """Return the solution at a node ``(3,)``; the last one is asked for again and again."""
        if self._last is None or not np.array_equal(self._last[0], logs):
            self._last = logs.copy(), self.equations.at(self._variances(logs))
        return self._last[1]

    def _of_rays(self) -> Array:
        """Return the variances ``(2,)``, m² in plan and height, that a control point's rays leave open.

        They are over the square of the factor of measurements. One ray leaves the height open: there it is the worst.
        """
        if not any(self.free):
            return np.ones(2)
        values = np.linalg.eigvalsh(self.equations.u)
        return np.asarray(np.median(1.0 / np.maximum(values[:, 1::-1], self.worst**-2), axis=0))

    def _prior(self, logs: Array) -> Array:
        """Return the log prior ``(b,)`` at nodes.

        A misfit of the ground has the variance of the ground plus that of its rays. In plan and in height, the prior
        is even in the log of this sum, which is all that misfits show. The variance of rays is that at the centre: if
        it were each node's own, good control would make measurements seem better than they are. The last line says
        how plan and height are related: four points outweigh it; with fewer it keeps heights from being anything.
        """
        squares = np.exp(2.0 * logs)
        of_rays = self.of_rays * math.exp(2.0 * self.centre[0])
        found = -np.log1p(_IMAGE_LOW / np.exp(logs[:, 0])) - np.log1p(squares[:, 0] / _IMAGE_HIGH**2)
        for axis, free in enumerate(self.free, start=1):
            if free:
                found = found - np.log1p(of_rays[axis - 1] / squares[:, axis])
                found = found - np.log1p(squares[:, axis] / self.worst**2)
        if all(self.free):
            found = found - 0.5 * ((logs[:, 1] - logs[:, 2]) / math.log(_RATIO)) ** 2
        return np.asarray(found)

    def chances(self, logs: Array) -> Array:
        """Return log likelihood plus log prior ``(b,)`` at nodes ``(b, 3)``."""
        found = self.equations.likelihoods(self._variances(logs)) + self._prior(logs)
        return np.where(np.isfinite(found), found, -np.inf)

    def _find_centre(self) -> None:
        """Find the logs ``(3,)`` near the best, by turns for the ground and for the measurements."""
        equations, centre = self.equations, self.centre
        redundancy = max(equations.redundancy(self._at(np.zeros(3)))[0], 1.0)
        centre[0] = self._log_of(equations.square / redundancy)
        for number in range(_ROUNDS):
            if any(self.free):
                logs = self._plane(centre[0], self._span(centre[0]))
                if number:
                    # Another factor of the measurements moves the best ones a little.
                    logs = logs[(np.abs(logs[:, 1:] - centre[1:]) < _NEAR).all(axis=1)]
                centre[:] = logs[int(np.argmax(self.chances(logs)))]
            node = self._at(centre)
            redundancy = equations.redundancy(node)[0]
            if not math.isfinite(redundancy):
                # So much better than stated that rounding of the equations drowns them.
                return
            if redundancy < _LEAST:
                centre[0] = 0.0
                return
            # Measured minus predicted after the step; the ground's part of the square is not the measurements'.
            square = self._image_square(node, centre)
            before, centre[0] = centre[0], self._log_of(square / redundancy)
            if abs(centre[0] - before) < 0.01:
                return

    def _log_of(self, square: float) -> float:
        return max(0.5 * math.log(max(square, 1e-300)), self.equations.finest)

    def _image_square(self, node: Node, logs: Array) -> float:
        """Return the sum of squares of the measurements' misfits (over the sigmas they have) at a node."""
        equations, z = self.equations, node.z
        left = (equations.d - node.shift) ** 2 * node.weights
        ground = float(left[equations.observed].sum())
        pseudo = float(z @ equations.pseudo @ z) - 2.0 * float(z @ equations.pseudo_right)
        return max(node.square - ground - pseudo, 0.0) * math.exp(2.0 * logs[0])

    def _span(self, image: float) -> tuple[Array, Array]:
        worst = max(self.worst, float(np.abs(self.equations.d).max(initial=0.0)))
        lows = np.minimum(0.5 * np.log(self.of_rays) - _UNSEEN + image, math.log(worst) - 1.0)
        plan, height = (np.arange(low, math.log(4.0 * worst) + _COARSE, self._step()) for low in lows)
        return plan, height

    def _step(self) -> float:
        return _COARSE if self.equations.size <= _DEAR and len(self.equations.rows) <= 100 else 2.0 * _COARSE

    def _plane(self, image: float, axes: tuple[Array, Array]) -> Array:
        grids = [axis if free else np.zeros(1) for axis, free in zip(axes, self.free, strict=True)]
        x, y = np.meshgrid(*grids, indexing="ij")
        return np.column_stack([np.full(x.size, image), x.ravel(), y.ravel()])

    def _nodes(self) -> tuple[Array, Array]:
        """Return the nodes ``(b, 3)`` that count, and their weights ``(b,)``, which sum up to one."""
        redundancy = self.equations.redundancy(self._at(self.centre))[0]
        known = redundancy > _KNOWN or redundancy < _LEAST
        images = np.zeros(1) if known else np.linspace(-3.5, 3.5, 7) / math.sqrt(2.0 * redundancy)
        if not any(self.free) and not known:
            images = np.linspace(-4.0, 6.0, 31) / math.sqrt(2.0 * redundancy)
        axes = self._axes(len(images))
        logs = np.concatenate([self._plane(self.centre[0] + shift, axes) for shift in images])
        if len(logs) == 1:
            return logs, np.ones(1)
        chances = self.chances(logs)
        weights = np.exp(chances - chances.max())
        return logs, weights / weights.sum()

    def _axes(self, images: int) -> tuple[Array, Array]:
        """Return finer axes over what counts of the coarse ones."""
        if not any(self.free):
            return np.zeros(1), np.zeros(1)
        coarse = self._plane(self.centre[0], self._span(self.centre[0]))
        chances = self.chances(coarse)
        good = coarse[chances > chances.max() - _COUNTS]
        dear = self.equations.size > _DEAR
        side = math.sqrt(_BUDGET / images / max(len(self.equations.rows), 20)) if all(self.free) else 31.0
        number = 7 if dear else int(np.clip(side, 7, 17))
        low, high = good.min(axis=0) - _COARSE, good.max(axis=0) + _COARSE
        return np.linspace(low[1], high[1], number), np.linspace(low[2], high[2], number)

    def variances(self) -> Variances:
        """Return the components: of the measurements the usual estimate, of the ground the means of their logs."""
        self.logs, self.chance = self._nodes()
        self.mean = np.array([self.centre[0], *(self.chance @ self.logs)[1:]])
        equations = self.equations
        node = self._at(self.mean)
        xy, h = (float(math.exp(value)) if free else None for value, free in zip(self.mean[1:], self.free, strict=True))
        unstated = int(equations.unstated[:, :2].any(axis=1).sum()), int(equations.unstated[:, 2].sum())
        parts = equations.redundancy(node)
        if not self.separable:
            parts = (parts[0] + parts[1] + parts[2], 0.0, 0.0)
        likely = self.chance > 1e-8
        nodes = np.exp(2.0 * (self.logs[likely] - (self.mean[0], 0.0, 0.0)))
        return Variances(
            math.exp(self.mean[0]), xy, h, parts, unstated, self.separable, self._freedom(), nodes, self.chance[likely]
        )

    def _freedom(self) -> float:
        """Return the degrees of freedom that variances of the ground's misfits have, by the spread of their logs.

        That of a variance with n degrees of freedom is trigamma(n / 2), nearly 2 / n + 2 / n².
        """
        if not any(self.free):
            return math.inf
        squares, found = np.exp(2.0 * self.logs), math.inf
        for axis, of_rays in enumerate(self.of_rays, start=1):
            logs = np.log(squares[:, 0] * of_rays + (squares[:, axis] if self.free[axis - 1] else 0.0))
            spread = float(self.chance @ (logs - self.chance @ logs) ** 2)
            found = min(found, (1.0 + math.sqrt(1.0 + 2.0 * spread)) / spread if spread > 0 else math.inf)
        return found

    def posterior(self, variances: Variances) -> Posterior:
        """Return covariances that contain the uncertainty of the components."""
        equations = self.equations
        middle = self._at(self.mean)
        counts = self.chance > 1e-6
        logs, chance = self.logs[counts], self.chance[counts] / self.chance[counts].sum()
        # About the solution itself, not about the mean: what is added is how far that may be from the best.
        mean = equations.over(self._variances(logs), chance)
        image_square = float(chance @ np.exp(2.0 * logs[:, 0]))
        # Of what control tells nothing, the measurements tell all.
        others = image_square if equations.rest else 0.0
        covariance = self.cofactors.mixed(others, equations.root, mean.cofactors - others * np.eye(equations.rank))
        return Posterior(
            variances, covariance, image_square, equations.rows, mean.ground, float(np.abs(middle.z).max(initial=0.0))
        )
