"""Normal equations of a block in which only control is left point by point, solved for any sigmas of observations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.variances.components import diagonal
from ortho_pipeline.models.base import Array

#: No measurement is taken as better than this (px), whatever residuals say: those of simulations may be rounding alone.
_FINEST = 1e-4
#: Below this part of the parameters, those that control tells of are taken alone; what is told less than this part of
#: what is known counts as nothing.
_FAR_LESS, _TOLD = 0.5, 1e-13
#: Numbers of the equations of nodes that are in memory together: what a processor keeps near.
_AT_ONCE = 1 << 16


@dataclass(frozen=True, eq=False)
class Node:
    """Solution at a node, or the mean of several: parameters ``(m,)``, cofactors, shifts and covariances of control.

    `weights` ``(n, 3)`` are those of the ground, `square` that of all misfits, less what
    pseudo-observations have of it without a step; of several nodes they, the parameters
    and the shifts are those of the last.
    """

    z: Array
    cofactors: Array
    shift: Array
    ground: Array
    weights: Array
    square: float


class _Nodes(NamedTuple):
    """Solutions at b nodes: `weights` ``(b, n, 3)``, `inverse` ``(b, n, 3, 3)``, `met` and `taken` of the points.

    `lower` ``(b, m, m)`` are the factors of the normal equations of z and `half` their right sides ``(b, m)``, solved
    with these; NaN where they are not positive definite.
    """

    weights: Array
    inverse: Array
    met: Array
    taken: Array
    lower: Array
    half: Array
    square: Array
    likelihood: Array


class ControlEquations:
    """Normal equations with everything but control eliminated, in parameters z with unit cofactors.

    Per control point of n, in its local ENU frame: `u` ``(n, 3, 3)``, `k` ``(n, 3, m)``, `ue` ``(n, 3)`` are B'B, B'A,
    B'e of its rays, `d` ``(n, 3)`` its ground's misfit in metres. Parameters are `root` ``(P, m)`` z, and `rest` others
    on which neither control nor pseudo-observations have any influence.
    """

    def __init__(self, solved: Solved) -> None:
        problem, linear = solved.problem, solved.linear
        self.size = problem.size
        grounded = linear.ordering.grounded
        self.rows = grounded[problem.placed[grounded]]
        ground = problem.on_points(linear.state.local, self.rows)
        self.observed, self.d = ground.observed, ground.apart
        self.u, by_params, self.ue = self._control(linear, ground.axes)
        self.unstated = problem.unstated[self.rows]
        self.weights = ground.sigmas**-2.0
        own = self.u + diagonal(self.weights)
        self.root = _root(solved.cofactors, own, by_params, linear.pseudo_design)
        self.rest = self.size - self.root.shape[1]
        # As one product: BLAS is slow at many of three rows.
        flat = by_params.reshape(3 * len(self.rows), self.size) @ self.root
        self.k: Array = flat.reshape(len(self.rows), 3, self.rank)
        pseudo = linear.pseudo_design @ self.root
        self.pseudo, self.pseudo_right = pseudo.T @ pseudo, pseudo.T @ linear.misfits.pseudo
        inverse = np.linalg.inv(own)
        taken = inverse @ self.k
        # The normal matrix of the solution is the unit matrix, its gradient zero: what is not control is the rest.
        self.image = np.eye(self.rank) - self.pseudo + flat.T @ taken.reshape(flat.shape)
        right = (inverse @ (self.ue + self.weights * self.d)[:, :, None])[:, :, 0]
        self.image_right = flat.T @ right.ravel() - self.pseudo_right
        self.square = float((linear.misfits.rays**2).sum())
        self.points = linear.ordering.points
        # Heights of a surface under ties are not of the control, but determine a part of the unknowns.
        of_heights, hats = solved.heights
        self.observations = linear.ordering.observations + float(hats[~problem.placed[of_heights]].sum())
        pixel = np.linalg.norm(linear.by_point, axis=2)[linear.by_point.any(axis=(1, 2))]
        sigma = float(np.median(problem.points.sigma_image))
        self.finest = math.log(_FINEST / sigma)
        self.pixel = 1.0 / max(float(np.median(pixel)) * sigma, 1e-12) if len(pixel) else 1.0

    @property
    def rank(self) -> int:
        """Number m of the parameters z."""
        return self.root.shape[1]

    def _control(self, linear: Linear, axes: Array) -> tuple[Array, Array, Array]:
        """Return `u`, B'A ``(n, 3, P)`` and `ue`, along `axes` ``(n, 3, 3)`` of the points."""
        problem, ordering, points = linear.problem, linear.ordering, linear.problem.points
        place = np.full(len(points), -1)
        place[self.rows] = np.arange(len(self.rows))
        rays = ordering.rays[place[points.point[ordering.rays]] >= 0]
        of = place[points.point[rays]]
        turned = (linear.by_point[rays] @ axes[of].swapaxes(1, 2)).swapaxes(1, 2)
        u, ue = np.zeros((len(self.rows), 3, 3)), np.zeros((len(self.rows), 3))
        np.add.at(u, of, turned @ turned.swapaxes(1, 2))
        np.add.at(ue, of, (turned @ linear.misfits.rays[rays][:, :, None])[:, :, 0])
        by_params = np.zeros((len(self.rows), 3, self.size + 1))
        columns = problem.columns.padded[points.image[rays]]
        by_params[of[:, None, None], np.arange(3)[:, None], columns[:, None]] = turned @ linear.by_params[rays]
        return u, by_params[:, :, : self.size], ue

    def likelihoods(self, nodes: Array) -> Array:
        """Return the log likelihoods ``(b,)`` with variances ``(b, 3)`` of image, plan and height."""
        return np.concatenate([self._solved(part).likelihood for part in self._parts(nodes)])

    def at(self, node: Array) -> Node:
        """Return the solution with variances ``(3,)`` of image, plan and height."""
        return self._over(node[None], np.ones(1), moved=False)

    def over(self, nodes: Array, chances: Array) -> Node:
        """Return the mean over variances ``(b, 3)`` of some chances ``(b,)``; its cofactors have how solutions move."""
        return self._over(nodes, chances, moved=True)

    def _over(self, nodes: Array, chances: Array, *, moved: bool) -> Node:
        count, size, begin = len(self.rows), self.rank, 0
        cofactors, ground = np.zeros((size, size)), np.zeros((count, 3, 3))
        for part in self._parts(nodes):
            at, chance = self._solved(part), chances[begin : begin + len(part)]
            back = np.linalg.inv(at.lower).swapaxes(1, 2)
            own, z = back @ back.swapaxes(1, 2), back @ at.half[:, :, None]
            by_point, shift = at.taken.reshape(*at.inverse.shape[:3], size), (at.met - at.taken @ z)
            shift = shift.reshape(*by_point.shape[:3], 1)
            spread = (at.taken @ own).reshape(by_point.shape) @ by_point.swapaxes(2, 3)
            if moved:
                own += z @ z.swapaxes(1, 2)
                spread += shift @ shift.swapaxes(2, 3)
            cofactors += np.tensordot(chance, own, 1)
            ground += np.tensordot(chance, at.inverse + spread, 1)
            begin += len(part)
        return Node(z[-1, :, 0], cofactors, shift[-1, :, :, 0], ground, at.weights[-1], float(at.square[-1]))

    def _parts(self, nodes: Array) -> list[Array]:
        """Return nodes ``(b, 3)`` in parts whose equations are in memory together."""
        numbers = len(nodes) * (3 * len(self.rows) + self.rank) * max(self.rank, 3)
        return np.array_split(nodes, max(1, min(len(nodes), math.ceil(numbers / _AT_ONCE))))

    def _solved(self, nodes: Array) -> _Nodes:
        """Return the solutions with variances ``(b, 3)`` of measurements, and of unstated ground in plan and height."""
        count, size = len(self.rows), self.rank
        scale = 1.0 / nodes[:, 0]
        weights = np.where(self.unstated, 1.0 / nodes[:, None, [1, 1, 2]], self.weights)
        spread, own = _inverted(self.u * scale[:, None, None, None] + diagonal(weights))
        spread -= np.log(weights[:, self.unstated]).sum(axis=1)
        right = self.ue * scale[:, None, None] + weights * self.d
        met = own @ right[..., None]
        square = (weights * self.d**2 - right * met[..., 0]).sum(axis=(1, 2)) + self.square * scale
        met = met.reshape(len(nodes), 3 * count, 1)
        taken = (own @ (scale[:, None, None, None] * self.k)).reshape(len(nodes), 3 * count, size)
        flat = self.k.reshape(3 * count, size).T
        whole = np.full((len(nodes), size + 1, size + 1), np.inf)
        scale = scale[:, None, None]
        whole[:, :size, :size] = (self.image - flat @ taken) * scale + self.pseudo
        # The last row of the factor is then that of the lower triangle, solved for the right side.
        whole[:, size, :size] = ((self.image_right[:, None] - flat @ met) * scale + self.pseudo_right[:, None])[:, :, 0]
        lower = _factors(whole)
        half, lower = lower[:, size, :size], lower[:, :size, :size]
        square -= (half**2).sum(axis=1)
        free = self.observations - 3 * (self.points - count) - self.rest
        spread += free * np.log(nodes[:, 0]) + 2.0 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
        likelihood = np.where(np.isnan(spread), -np.inf, -0.5 * (spread + square))
        return _Nodes(weights, own, met, taken, lower, half, square, likelihood)

    def redundancy(self, node: Node) -> tuple[float, float, float]:
        """Return the parts of the redundancy of measurements, and of unstated ground in plan and height, at a node."""
        hat = node.weights * np.diagonal(node.ground, axis1=1, axis2=2)
        of_ground = np.where(self.unstated, 1.0 - hat, 0.0).sum(axis=0)
        of_pseudo = float((self.pseudo * node.cofactors).sum())
        image = self.observations - (self.size + 3 * self.points - float(hat.sum()) - of_pseudo)
        return image, float(of_ground[:2].sum()), float(of_ground[2])


def _inverted(matrices: Array) -> tuple[Array, Array]:
    """Return the sums ``(b,)`` of the log determinants of matrices ``(b, n, 3, 3)``, and their inverses.

    By Cholesky's factors, entry by entry for all of them: LAPACK takes twenty times as long for so small ones.
    """
    half, back, inverted = (np.zeros((3, 3, *matrices.shape[:2])) for _ in range(3))
    for c in range(3):
        for e in range(c + 1):
            left = matrices[..., c, e] - (half[c, :e] * half[e, :e]).sum(axis=0)
            half[c, e] = np.sqrt(left) if e == c else left / half[e, e]
        back[c, c] = 1.0 / half[c, c]
        for e in range(c):
            back[c, e] = -(half[c, e:c] * back[e:c, e]).sum(axis=0) * back[c, c]
    for c in range(3):
        for e in range(c + 1):
            inverted[c, e] = inverted[e, c] = (back[c:, c] * back[c:, e]).sum(axis=0)
    logs = 2.0 * np.log(half[range(3), range(3)]).sum(axis=(0, 2))
    return logs, np.moveaxis(inverted, (0, 1), (2, 3))


def _factors(matrices: Array) -> Array:
    """Return the lower Cholesky factors of matrices ``(b, k, k)``; NaN where they are not positive definite."""
    try:
        return np.asarray(np.linalg.cholesky(matrices))
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.full_like(matrices, np.nan)
    return np.concatenate([_factors(one[None]) for one in matrices])


def _root(cofactors: Cofactors, own: Array, by_params: Array, pseudo: Array) -> Array:
    """Return a root R ``(P, m)`` of the cofactors C: R R' is C, or if that is far less, its part that control tells of.

    Control points with normal matrices `own` ``(n, 3, 3)`` and B'A `by_params` ``(n, 3, P)``, and rows of
    pseudo-observations ``(k, P)``, tell nothing of parameters without a part in the span of C times these.
    """
    size = pseudo.shape[1]
    if not size:
        return np.zeros((0, 0))
    if 3 * len(own) + len(pseudo) > _FAR_LESS * size:
        matrix = cofactors.matrix
        scale = np.sqrt(np.diag(matrix))
        root: Array = np.linalg.cholesky(matrix / np.outer(scale, scale)) * scale[:, None]
        return root
    # Over the root of their own normal matrices, no control point tells more than the unit matrix.
    values, vectors = np.linalg.eigh(own)
    whitened = vectors.swapaxes(1, 2) @ by_params / np.sqrt(np.maximum(values, 1e-300))[:, :, None]
    rows = np.vstack([whitened.reshape(-1, size), pseudo])
    product = cofactors.times(rows.T)
    told, axes = np.linalg.eigh(rows @ product)
    return np.asarray(product @ axes[:, told > _TOLD] / np.sqrt(told[told > _TOLD]))
