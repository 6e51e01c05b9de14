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

Source: Patterson and Thompson 1971 (restricted likelihood); Gelman 2006 (priors of variances); Koch 2007 (in geodesy).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ortho_pipeline.block.points import Index
from ortho_pipeline.block.solver import PERFECT_GROUND, BlockProblem, Selection, Solved
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import NotConverged, counted
from ortho_pipeline.models.base import Array

#: Errors of the ground below this part of what a point's own rays leave open change nothing that could be seen: the
#: prior is even in log sigma above it, and even in sigma below.
_UNSEEN = 0.25
#: Ground that is wrong by more than so many pixels is hardly taken as control: there the prior falls.
_WORST_PIXELS = 20.0
#: Plan and height of one survey are alike within a factor of four (two standard deviations of the log of their ratio).
_ALIKE = math.log(2.0)
#: The same for the factor of the measurements: below a tenth and above ten times what was stated the prior falls.
_IMAGE_LOW, _IMAGE_HIGH = 0.1, 10.0
#: Step of the grid in log sigma; how much less likely than the best (log) a node may be to count.
_COARSE, _COUNTS = 0.5, 12.0
#: Matrices of points by nodes that are worth while; parameters beyond which nodes are dear; nodes of one pass.
_BUDGET, _DEAR, _PASS = 40_000, 100, 256
#: With so much redundancy the measurements' factor is as good as known.
_KNOWN = 200.0
#: Below this redundancy a component is not estimated.
_LEAST = 0.5
#: No measurement is taken as better than this (px), whatever residuals say: those of simulations may be rounding alone.
_FINEST = 1e-4
#: Steps of the factor of the measurements to its best value, the ground's sigmas being given.
_ROUNDS = 4
#: Sigmas of measurements that change by less than this part are the same.
_SAME = 0.03


@dataclass(frozen=True, eq=False)
class Variances:
    """Standard deviations of the observations, as stated or found.

    Parameters
    ----------
    image : float
        Factor of the stated sigmas of measurements; 1 where it cannot be estimated.
    sigma_xy, sigma_h : float or None
        Of ground that states none, metres, in plan (each axis) and height; None where all is stated, or it cannot be
        told from errors of measurement (`separable` is then False, and `image` contains it).
    redundancy : (float, float, float)
        Parts of the redundancy of measurements, and of such ground in plan and in height.
    unstated : (int, int)
        Number of points whose ground in plan and in height states no sigma.
    freedom : float
        Degrees of freedom of what the misfits of such ground are compared with: these sigmas and those of its rays.
    nodes, chances : ndarray (b, 3), (b,)
        Squares of the three standard deviations that are possible, those of measurements over `image`, and how probable
        each is.
    """

    image: float
    sigma_xy: float | None
    sigma_h: float | None
    redundancy: tuple[float, float, float]
    unstated: tuple[int, int]
    separable: bool = True
    freedom: float = math.inf
    nodes: Array = field(default_factory=lambda: np.ones((1, 3)), repr=False)
    chances: Array = field(default_factory=lambda: np.ones(1), repr=False)

    @property
    def estimated(self) -> bool:
        """Whether a sigma of the ground was estimated."""
        return self.sigma_xy is not None or self.sigma_h is not None

    def chance_of(self, apart: Array, spread: Array, axes: tuple[int, ...]) -> float:
        """Return the chance that ground of an estimated sigma is as far as this from where the others put it.

        Parameters
        ----------
        apart : ndarray (k,)
            In metres along k of the axes east, north, up.
        spread : ndarray (k, k)
            Covariance of where the others put it.
        """
        from scipy.special import chdtrc

        own = self.nodes[:, [1, 1, 2]][:, axes]
        whole = self.nodes[:, 0, None, None] * spread + _diagonal(own)
        squares = (apart * np.linalg.solve(whole, np.broadcast_to(apart[:, None], (*own.shape, 1)))[:, :, 0]).sum(
            axis=1
        )
        return float(self.chances @ chdtrc(len(apart), squares))

    def applied(self, problem: BlockProblem) -> BlockProblem:
        """Return the problem with these standard deviations."""
        perfect = (PERFECT_GROUND, PERFECT_GROUND)
        assumed = perfect if not self.separable else (self.sigma_xy or PERFECT_GROUND, self.sigma_h or PERFECT_GROUND)
        sigma_image = problem.points.sigma_image * self.image
        return replace(problem, points=replace(problem.points, sigma_image=sigma_image), assumed=assumed)

    def notes(self) -> list[Notice]:
        """Return what people ought to know of them."""
        number = max(self.unstated)
        if not number:
            return []
        remedy = "state sigmas (sigma_xy, sigma_h, or `points.ground_sigma=XY,H`) if they are known"
        who = f"{counted(number, 'control point')} without a stated sigma"
        if not self.separable:
            text = f"{who}: their errors cannot be told from errors of measurement here, and count as such; {remedy}"
            return [Notice("unstated-sigma", text, count=number)]
        found = []
        for what, sigma, spare in zip(
            ("in plan", "in height"), (self.sigma_xy, self.sigma_h), self.redundancy[1:], strict=True
        ):
            if sigma is not None:
                weak = ", hardly determined" if spare < 2.0 else ""
                found.append(f"{sigma:.2g} m {what} (redundancy {spare:.1f}{weak})")
        text = f"{who}: estimated as {' and '.join(found)}; {remedy}"
        return [Notice("unstated-sigma", text, count=number, sigma_xy=self.sigma_xy, sigma_h=self.sigma_h)]

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        ground = {
            axis: {"sigma": sigma, "points": points, "redundancy": spare}
            for axis, sigma, points, spare in zip(
                ("xy", "h"), (self.sigma_xy, self.sigma_h), self.unstated, self.redundancy[1:], strict=True
            )
        }
        return {
            "image": {"factor": self.image, "redundancy": self.redundancy[0]},
            "unstated_ground": ground,
            "separable": self.separable,
        }


@dataclass(frozen=True, eq=False)
class Posterior:
    """Variance components, the covariance ``(P, P)`` with their uncertainty, and that of the grounded points.

    `image_square` is the mean square of the factor of measurements; `ground` ``(n, 3, 3)`` of the points `rows`, m²
    east, north, up; `moved` is how far (sigmas) the parameters are from those of the solution.
    """

    variances: Variances
    covariance: Array
    image_square: float
    rows: Index
    ground: Array
    moved: float


def estimate(problem: BlockProblem, solved: Solved) -> Variances:
    """Return the variance components at a solution, which was found with sigmas near enough to linearise there."""
    return _Grid(_Reduced(problem, solved)).variances()


def posterior(problem: BlockProblem, solved: Solved) -> Posterior:
    """Return the variance components at a solution, and covariances with their uncertainty."""
    grid = _Grid(_Reduced(problem, solved))
    return grid.posterior(grid.variances())


def reweighed(
    problem: BlockProblem, solved: Solved, selection: Selection, variances: Variances
) -> tuple[BlockProblem, Solved]:
    """Return the problem with these standard deviations, and its solution; both as they are if nothing much changes.

    Where that does not converge, as with cameras that few points hardly determine, both stay as they are; `posterior`
    then counts how far the solution is from the best.
    """
    if not variances.estimated and abs(variances.image - 1.0) < _SAME:
        return problem, solved
    other = variances.applied(problem)
    try:
        return other, other.solve(solved.state, selection)
    except NotConverged:
        return problem, solved


class _Reduced:
    """The observation equations with everything but control eliminated, in parameters z with unit cofactors.

    Per control point of n, in its own horizon: `u` ``(n, 3, 3)``, `k` ``(n, 3, P)``, `ue` ``(n, 3)`` are B'B, B'A, B'e
    of its rays, `d` ``(n, 3)`` its ground's misfit in metres.
    """

    def __init__(self, problem: BlockProblem, solved: Solved) -> None:
        linear, size = solved.linear, problem.size
        self.size, self.root = size, _root(solved.cofactors)
        parts = [self._control(problem, solved, rows) for rows in solved.eliminated if rows.chunk.ground]
        shapes = ((0,), (0, 3, 3), (0, 3, size), (0, 3), (0, 3))
        joined = (
            [np.concatenate(arrays) for arrays in zip(*parts, strict=True)] if parts else [np.zeros(s) for s in shapes]
        )
        self.rows = joined[0].astype(np.int64)
        self.u: Array = joined[1]
        self.k: Array = joined[2]
        self.ue: Array = joined[3]
        self.d: Array = joined[4]
        self.observed = np.isfinite(problem.known[self.rows])
        self.unstated = self.observed & (problem.points.sigma_ground[self.rows] == 0)
        with np.errstate(divide="ignore"):
            self.weights = np.where(self.observed, problem.ground_sigmas[self.rows] ** -2.0, 0.0)
        pseudo = linear.pseudo_rows @ self.root
        self.pseudo, self.pseudo_right = pseudo.T @ pseudo, pseudo.T @ linear.pseudo_misfit
        inverse = np.linalg.inv(self.u + _diagonal(self.weights))
        taken = inverse @ self.k
        flat = self.k.reshape(3 * len(self.rows), size)
        # The normal matrix of the solution is the unit matrix, its gradient zero: what is not control is the rest.
        self.image = np.eye(size) - self.pseudo + flat.T @ taken.reshape(flat.shape)
        right = (inverse @ (self.ue + self.weights * self.d)[:, :, None])[:, :, 0]
        self.image_right = flat.T @ right.ravel() - self.pseudo_right
        self.square = float((linear.ray_misfit**2).sum())
        self.points = sum(len(chunk.points) for chunk in linear.layout.chunks)
        self.observations = linear.layout.observations
        pixel = np.linalg.norm(linear.by_point, axis=2)[linear.by_point.any(axis=(1, 2))]
        sigma = float(np.median(problem.points.sigma_image))
        self.finest = math.log(_FINEST / sigma)
        self.pixel = 1.0 / max(float(np.median(pixel)) * sigma, 1e-12) if len(pixel) else 1.0

    def _control(self, problem: BlockProblem, solved: Solved, rows: Any) -> tuple[Array, ...]:
        linear, chunk = solved.linear, rows.chunk
        n, k = chunk.rays.shape
        design = np.zeros((n, 2 * k, self.size))
        for group in chunk.groups:
            columns, real = problem.group_columns(chunk, group)
            design[group] = rows.design(group)[:, : 2 * k, real] @ self.root[columns]
        horizons = problem.horizons[chunk.points]
        by_point = linear.by_point[chunk.rays].reshape(n, 2 * k, 3) @ horizons.swapaxes(1, 2)
        turned = by_point.swapaxes(1, 2)
        misfit = linear.ray_misfit[chunk.rays].reshape(n, 2 * k, 1)
        apart = (horizons @ (problem.target[chunk.points] - solved.state.local[chunk.points])[:, :, None])[:, :, 0]
        apart = np.where(np.isfinite(problem.known[chunk.points]), apart, 0.0)
        return chunk.points, turned @ by_point, turned @ design, (turned @ misfit)[:, :, 0], apart

    def weights_at(self, nodes: Array) -> Array:
        """Return the weights ``(b, n, 3)`` of the ground with variances ``(b, 3)`` of image, plan and height."""
        own = 1.0 / nodes[:, None, [1, 1, 2]]
        return np.where(self.unstated, own, self.weights)

    def at(self, nodes: Array) -> _Node:
        """Return the solutions with variances ``(b, 3)`` of image, plan and height."""
        size, scale = self.size, nodes[:, 0]
        weights = self.weights_at(nodes)
        m = self.u / scale[:, None, None, None] + _diagonal(weights)
        inverse = np.asarray(np.linalg.inv(m), dtype=float)
        b = self.ue / scale[:, None, None] + weights * self.d
        met = (inverse @ b[..., None])[..., 0]
        taken = np.asarray(inverse @ self.k / scale[:, None, None, None], dtype=float)
        flat = self.k.reshape(3 * len(self.rows), size).T
        normal = (self.image - flat @ taken.reshape(len(nodes), 3 * len(self.rows), size)) / scale[
            :, None, None
        ] + self.pseudo
        right = (self.image_right - met.reshape(len(nodes), 3 * len(self.rows)) @ flat.T) / scale[
            :, None
        ] + self.pseudo_right
        cofactors = np.asarray(np.linalg.inv(normal) if size else normal, dtype=float)
        z = (cofactors @ right[:, :, None])[:, :, 0]
        shift = met - (taken @ z[:, None, :, None])[..., 0]
        square = self.square / scale + (weights * self.d**2).sum(axis=(1, 2))
        square -= (b * met).sum(axis=(1, 2)) + (right * z).sum(axis=1)
        ties = self.points - len(self.rows)
        spread = (self.observations - 3 * ties) * np.log(scale) + np.linalg.slogdet(m)[1].sum(axis=1)
        spread += (np.linalg.slogdet(normal)[1] if size else 0.0) - np.log(np.where(self.unstated, weights, 1.0)).sum(
            axis=(1, 2)
        )
        return _Node(-0.5 * (spread + square), z, cofactors, shift, inverse, taken, weights)

    def redundancy(self, node: _Node) -> tuple[float, float, float]:
        """Return the parts of the redundancy of measurements, and of unstated ground in plan and height, at a node."""
        spread = self.ground(node)[0]
        hat = node.weights[0] * np.diagonal(spread, axis1=1, axis2=2)
        spare = np.where(self.unstated, 1.0 - hat, 0.0).sum(axis=0)
        of_pseudo = float((self.pseudo * node.cofactors[0]).sum())
        image = self.observations - (self.size + 3 * self.points - float(hat.sum()) - of_pseudo)
        return image, float(spare[:2].sum()), float(spare[2])

    def ground(self, node: _Node) -> Array:
        """Return the covariances ``(b, n, 3, 3)`` of the control points at nodes."""
        taken = node.taken
        return np.asarray(node.inverse + taken @ node.cofactors[:, None] @ taken.swapaxes(2, 3))


@dataclass(frozen=True, eq=False)
class _Node:
    """Solutions at nodes: log likelihood ``(b,)``, parameters, cofactors, shifts of control and what made them."""

    likelihood: Array
    z: Array
    cofactors: Array
    shift: Array
    inverse: Array
    taken: Array
    weights: Array


def _diagonal(values: Array) -> Array:
    return values[..., None] * np.eye(values.shape[-1])


def _root(cofactors: Array) -> Array:
    """Return L with L L' the cofactors ``(P, P)``."""
    if not len(cofactors):
        return np.zeros((0, 0))
    scale = np.sqrt(np.diag(cofactors))
    root: Array = np.linalg.cholesky(cofactors / np.outer(scale, scale)) * scale[:, None]
    return root


class _Grid:
    """The nodes at which the components are tried: logs of the standard deviations of image, plan and height."""

    def __init__(self, reduced: _Reduced) -> None:
        self.reduced = reduced
        self.free = [bool(reduced.unstated[:, :2].any()), bool(reduced.unstated[:, 2].any())]
        self.separable = True
        far = np.log([[1.0, 1e3 * reduced.pixel, 1e3 * reduced.pixel]])
        alone = reduced.redundancy(self._at(far))[0]
        if any(self.free) and alone < _LEAST:
            # One image, or none to spare: an error of the ground is one of the measurement.
            self.free, self.separable = [False, False], False
        self.unseen = self._unseen()
        self.centre = self._centre()

    def _at(self, logs: Array) -> _Node:
        nodes = np.exp(2.0 * logs)
        if not self.separable:
            nodes[:, 1:] = PERFECT_GROUND**2
        return self.reduced.at(nodes)

    def _unseen(self) -> float:
        """Return the sigma (m) of ground below which nothing could be seen of it, times the factor of measurements."""
        if not any(self.free):
            return 1.0
        values = np.linalg.eigvalsh(self.reduced.u)
        middle = float(np.median(values[:, 1]))
        return _UNSEEN / math.sqrt(middle) if middle > 0 else _UNSEEN * self.reduced.pixel

    def _prior(self, logs: Array) -> Array:
        sigma = np.exp(logs)
        found = -np.log1p(_IMAGE_LOW / sigma[:, 0]) - np.log1p((sigma[:, 0] / _IMAGE_HIGH) ** 2)
        for axis, free in enumerate(self.free, start=1):
            if free:
                low, high = self.unseen * sigma[:, 0], _WORST_PIXELS * self.reduced.pixel
                found = found - np.log1p(low / sigma[:, axis]) - np.log1p((sigma[:, axis] / high) ** 2)
        if all(self.free):
            found = found - 0.5 * ((logs[:, 1] - logs[:, 2]) / _ALIKE) ** 2
        return np.asarray(found)

    def passes(self, logs: Array) -> Iterator[tuple[slice, _Node]]:
        """Solve at nodes ``(b, 3)``, some at a time."""
        step = max(1, min(_PASS, int(4e6 / (max(len(self.reduced.rows), 1) * 3 * (self.reduced.size + 3)))))
        for begin in range(0, len(logs), step):
            part = slice(begin, min(begin + step, len(logs)))
            yield part, self._at(logs[part])

    def chances(self, logs: Array) -> Array:
        """Return log likelihood plus log prior ``(b,)`` at nodes ``(b, 3)``."""
        found = np.concatenate([node.likelihood for _, node in self.passes(logs)]) + self._prior(logs)
        return np.where(np.isfinite(found), found, -np.inf)

    def _centre(self) -> Array:
        """Return the logs ``(3,)`` near the best, found by turns for the ground and for the measurements."""
        reduced = self.reduced
        spare = max(reduced.redundancy(self._at(np.zeros((1, 3))))[0], 1.0)
        centre = np.array([self._log_of(reduced.square / spare), 0.0, 0.0])
        for _ in range(_ROUNDS):
            if any(self.free):
                logs = self._plane(centre[0], self._span(centre[0]))
                centre = logs[int(np.argmax(self.chances(logs)))]
            node = self._at(centre[None])
            spare = reduced.redundancy(node)[0]
            if spare < _LEAST:
                return np.array([0.0, *centre[1:]])
            # Measured minus predicted after the step; the ground's part of the square is not the measurements'.
            square = self._image_square(node, centre)
            before, centre[0] = centre[0], self._log_of(square / spare)
            if abs(centre[0] - before) < 0.01:
                break
        return centre

    def _log_of(self, square: float) -> float:
        return max(0.5 * math.log(max(square, 1e-300)), self.reduced.finest)

    def _image_square(self, node: _Node, logs: Array) -> float:
        """Return the sum of squares of the measurements' misfits (over the sigmas they have) at a node."""
        reduced, z = self.reduced, node.z[0]
        left = (reduced.d - node.shift[0]) ** 2 * node.weights[0]
        ground = float(left[reduced.observed].sum())
        scale = math.exp(2.0 * logs[0])
        # The quadratic form of everything, less the ground's and the pseudo-observations' parts.
        total = reduced.square / scale + float((node.weights[0] * reduced.d**2).sum())
        b = reduced.ue / scale + node.weights[0] * reduced.d
        met = (node.inverse[0] @ b[:, :, None])[:, :, 0]
        flat = reduced.k.reshape(met.size, reduced.size)
        right = (reduced.image_right - met.ravel() @ flat) / scale + reduced.pseudo_right
        total -= float((b * met).sum()) + float(right @ z)
        pseudo = float(z @ reduced.pseudo @ z) - 2.0 * float(z @ reduced.pseudo_right)
        return max(total - ground - pseudo, 0.0) * scale

    def _span(self, image: float) -> tuple[Array, Array]:
        low = math.log(self.unseen / 8.0) + image
        worst = max(_WORST_PIXELS * self.reduced.pixel, float(np.abs(self.reduced.d).max(initial=0.0)))
        axis = np.arange(min(low, math.log(worst) - 1.0), math.log(4.0 * worst) + _COARSE, self._step())
        return axis, axis

    def _step(self) -> float:
        return _COARSE if self.reduced.size <= _DEAR and len(self.reduced.rows) <= 100 else 2.0 * _COARSE

    def _plane(self, image: float, axes: tuple[Array, Array]) -> Array:
        grids = [axis if free else np.zeros(1) for axis, free in zip(axes, self.free, strict=True)]
        x, y = np.meshgrid(*grids, indexing="ij")
        return np.column_stack([np.full(x.size, image), x.ravel(), y.ravel()])

    def _nodes(self) -> tuple[Array, Array]:
        """Return the nodes ``(b, 3)`` that count, and their weights ``(b,)``, which sum up to one."""
        spare = self.reduced.redundancy(self._at(self.centre[None]))[0]
        known = spare > _KNOWN or spare < _LEAST
        images = np.zeros(1) if known else np.linspace(-3.5, 3.5, 7) / math.sqrt(2.0 * spare)
        if not any(self.free) and not known:
            images = np.linspace(-4.0, 6.0, 31) / math.sqrt(2.0 * spare)
        axes = self._axes(len(images))
        logs = np.concatenate([self._plane(self.centre[0] + shift, axes) for shift in images])
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
        dear = self.reduced.size > _DEAR
        side = math.sqrt(_BUDGET / images / max(len(self.reduced.rows), 20)) if all(self.free) else 31.0
        number = 7 if dear else int(np.clip(side, 7, 17))
        low, high = good.min(axis=0) - _COARSE, good.max(axis=0) + _COARSE
        return np.linspace(low[1], high[1], number), np.linspace(low[2], high[2], number)

    def variances(self) -> Variances:
        """Return the components: of the measurements the usual estimate, of the ground the means of their logs."""
        self.logs, self.chance = self._nodes()
        self.mean = np.array([self.centre[0], *(self.chance @ self.logs)[1:]])
        reduced = self.reduced
        node = self._at(self.mean[None])
        xy, h = (float(math.exp(value)) if free else None for value, free in zip(self.mean[1:], self.free, strict=True))
        unstated = int(reduced.unstated[:, :2].any(axis=1).sum()), int(reduced.unstated[:, 2].sum())
        spare = reduced.redundancy(node)
        if not self.separable:
            spare = (spare[0] + spare[1] + spare[2], 0.0, 0.0)
        likely = self.chance > 1e-8
        nodes = np.exp(2.0 * (self.logs[likely] - (self.mean[0], 0.0, 0.0)))
        return Variances(
            math.exp(self.mean[0]), xy, h, spare, unstated, self.separable, self._freedom(), nodes, self.chance[likely]
        )

    def _freedom(self) -> float:
        """Return the degrees of freedom that variances of the ground's misfits have, by the spread of their logs.

        That of a variance with n degrees of freedom is trigamma(n / 2), nearly 2 / n + 2 / n².
        """
        if not any(self.free):
            return math.inf
        values = np.linalg.eigvalsh(self.reduced.u)
        own = np.median(1.0 / np.maximum(values, 1e-6 * values[:, 2:]), axis=0)
        squares, found = np.exp(2.0 * self.logs), math.inf
        for axis, of_rays in ((1, own[1]), (2, own[0])):
            logs = np.log(squares[:, 0] * of_rays + (squares[:, axis] if self.free[axis - 1] else 0.0))
            spread = float(self.chance @ (logs - self.chance @ logs) ** 2)
            found = min(found, (1.0 + math.sqrt(1.0 + 2.0 * spread)) / spread if spread > 0 else math.inf)
        return found

    def posterior(self, variances: Variances) -> Posterior:
        """Return covariances that contain the uncertainty of the components."""
        reduced = self.reduced
        middle = self._at(self.mean[None])
        # About the solution itself, not about the mean: what is added is how far that may be from the best.
        cofactors = np.zeros((reduced.size, reduced.size))
        ground = np.zeros((len(reduced.rows), 3, 3))
        counts = self.chance > 1e-6
        logs, chance = self.logs[counts], self.chance[counts] / self.chance[counts].sum()
        for part, node in self.passes(logs):
            w = chance[part]
            apart, shift = node.z, node.shift
            cofactors += np.tensordot(w, node.cofactors, 1) + (apart * w[:, None]).T @ apart
            ground += np.tensordot(w, reduced.ground(node) + shift[..., None] * shift[..., None, :], 1)
        return Posterior(
            variances, reduced.root @ cofactors @ reduced.root.T, float(chance @ np.exp(2.0 * logs[:, 0])),
            reduced.rows, ground, float(np.abs(middle.z).max(initial=0.0)),
        )  # fmt: skip
