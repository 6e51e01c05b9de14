"""Normal equations of a block in which only control is left point by point, solved for any sigmas of observations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.variances import dense_nodes
from ortho_pipeline.block.variances.components import diagonal
from ortho_pipeline.models.base import Array
from ortho_pipeline.runtime.process_limits import parts_of, side_by_side

if TYPE_CHECKING:
    from ortho_pipeline.block.variances import node_kernel

#: No measurement is taken as better than this (px), whatever residuals say: those of simulations may be rounding alone.
_FINEST = 1e-4
#: Below this part of the parameters, those that control tells of are taken alone; what is told less than this part of
#: what is known counts as nothing.
_FAR_LESS, _TOLD = 0.5, 1e-13
#: Beyond so many parameters z nodes are solved by LAPACK: compiled loops take ten times as long then, and less below.
_MANY = 100
#: Nodes that are worth a thread.
_SHARE = 50


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


class ControlEquations:
    """Normal equations with everything but control eliminated, in parameters z with unit cofactors.

    Per control point of n, in its local ENU frame: `u` ``(n, 3, 3)``, `k` ``(n, 3, m)``, `ue` ``(n, 3)`` are B'B, B'A,
    B'e of its rays, `d` ``(n, 3)`` its ground's misfit in metres. Parameters are `root` ``(P, m)`` z, and `rest` others
    on which neither control nor pseudo-observations have any influence.
    """

    def __init__(self, solved: Solved) -> None:
        problem, linear = solved.problem, solved.linear
        self.size = problem.size
        self.rows = linear.ordering.grounded
        self.u, by_params, self.ue, self.d = self._control(linear)
        self.observed = np.isfinite(problem.known[self.rows])
        self.unstated = self.observed & (problem.points.sigma_ground[self.rows] == 0)
        with np.errstate(divide="ignore"):
            self.weights = np.where(self.observed, problem.ground_sigmas[self.rows] ** -2.0, 0.0)
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
        self.observations = linear.ordering.observations
        pixel = np.linalg.norm(linear.by_point, axis=2)[linear.by_point.any(axis=(1, 2))]
        sigma = float(np.median(problem.points.sigma_image))
        self.finest = math.log(_FINEST / sigma)
        self.pixel = 1.0 / max(float(np.median(pixel)) * sigma, 1e-12) if len(pixel) else 1.0

    @property
    def rank(self) -> int:
        """Number m of the parameters z."""
        return self.root.shape[1]

    def _control(self, linear: Linear) -> tuple[Array, Array, Array, Array]:
        """Return `u`, B'A ``(n, 3, P)``, `ue` and `d`."""
        problem, ordering, points = linear.problem, linear.ordering, linear.problem.points
        place = np.full(len(points), -1)
        place[self.rows] = np.arange(len(self.rows))
        rays = ordering.rays[place[points.point[ordering.rays]] >= 0]
        of = place[points.point[rays]]
        enu = problem.enu[self.rows]
        turned = (linear.by_point[rays] @ enu[of].swapaxes(1, 2)).swapaxes(1, 2)
        u, ue = np.zeros((len(self.rows), 3, 3)), np.zeros((len(self.rows), 3))
        np.add.at(u, of, turned @ turned.swapaxes(1, 2))
        np.add.at(ue, of, (turned @ linear.misfits.rays[rays][:, :, None])[:, :, 0])
        by_params = np.zeros((len(self.rows), 3, self.size + 1))
        columns = problem.columns.padded[points.image[rays]]
        by_params[of[:, None, None], np.arange(3)[:, None], columns[:, None]] = turned @ linear.by_params[rays]
        apart = (enu @ (problem.target[self.rows] - linear.state.local[self.rows])[:, :, None])[:, :, 0]
        apart = np.where(np.isfinite(problem.known[self.rows]), apart, 0.0)
        return u, by_params[:, :, : self.size], ue, apart

    @cached_property
    def _compiled(self) -> node_kernel.Equations:
        """These equations for compiled code."""
        from ortho_pipeline.block.variances import node_kernel

        flat = self.k.reshape(3 * len(self.rows), self.rank).T
        ties = self.points - len(self.rows)
        counts = np.array([self.observations - 3 * ties, self.rest, self.square], dtype=float)
        parts = (
            self.u, self.k, flat, self.ue, self.d, self.weights, self.unstated, self.image, self.image_right,
            self.pseudo, self.pseudo_right, counts,
        )  # fmt: skip
        return node_kernel.Equations(*(np.ascontiguousarray(part) for part in parts))

    def likelihoods(self, nodes: Array) -> Array:
        """Return the log likelihoods ``(b,)`` with variances ``(b, 3)`` of image, plan and height."""
        from ortho_pipeline.block.variances import node_kernel

        if self.rank > _MANY:
            return np.array([dense_nodes.solved(self._compiled, node).likelihood for node in nodes])
        found, equations = np.empty(len(nodes)), self._compiled

        def part(_: int, begin: int, end: int) -> None:
            node_kernel.likelihoods(equations, nodes[begin:end], found[begin:end])

        side_by_side(part, parts_of(len(nodes), _SHARE))
        return found

    def at(self, node: Array) -> Node:
        """Return the solution with variances ``(3,)`` of image, plan and height."""
        return self._over(node[None], np.ones(1), moved=False)

    def over(self, nodes: Array, chances: Array) -> Node:
        """Return the mean over variances ``(b, 3)`` of some chances ``(b,)``; its cofactors have how solutions move."""
        return self._over(nodes, chances, moved=True)

    def _over(self, nodes: Array, chances: Array, *, moved: bool) -> Node:
        from ortho_pipeline.block.variances import node_kernel

        if self.rank > _MANY:
            return Node(*dense_nodes.means(self._compiled, nodes, chances, moved=moved))
        count, size = len(self.rows), self.rank
        weights, z, shift = np.empty((count, 3)), np.empty(size), np.empty((count, 3))
        cofactors, ground = np.zeros((size, size)), np.zeros((count, 3, 3))
        square = node_kernel.means(
            self._compiled, nodes, chances, moved, weights, z, cofactors, shift, ground
        )  # fmt: skip
        return Node(z, cofactors, shift, ground, weights, square)

    def redundancy(self, node: Node) -> tuple[float, float, float]:
        """Return the parts of the redundancy of measurements, and of unstated ground in plan and height, at a node."""
        hat = node.weights * np.diagonal(node.ground, axis1=1, axis2=2)
        of_ground = np.where(self.unstated, 1.0 - hat, 0.0).sum(axis=0)
        of_pseudo = float((self.pseudo * node.cofactors).sum())
        image = self.observations - (self.size + 3 * self.points - float(hat.sum()) - of_pseudo)
        return image, float(of_ground[:2].sum()), float(of_ground[2])


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
