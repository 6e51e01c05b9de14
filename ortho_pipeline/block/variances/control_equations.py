"""Normal equations of a block in which only control is left point by point, solved for any sigmas of observations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.block.equations.elimination import Eliminated
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.variances.components import diagonal
from ortho_pipeline.models.base import Array

#: No measurement is taken as better than this (px), whatever residuals say: those of simulations may be rounding alone.
_FINEST = 1e-4


@dataclass(frozen=True, eq=False)
class Node:
    """Solutions at nodes: log likelihood ``(b,)``, parameters, cofactors, shifts of control and what made them."""

    likelihood: Array
    z: Array
    cofactors: Array
    shift: Array
    inverse: Array
    taken: Array
    weights: Array


class ControlEquations:
    """Normal equations with everything but control eliminated, in parameters z with unit cofactors.

    Per control point of n, in its local ENU frame: `u` ``(n, 3, 3)``, `k` ``(n, 3, P)``, `ue` ``(n, 3)`` are B'B, B'A,
    B'e of its rays, `d` ``(n, 3)`` its ground's misfit in metres.
    """

    def __init__(self, solved: Solved) -> None:
        problem, linear, size = solved.problem, solved.linear, solved.problem.size
        self.size, self.root = size, _root(solved.cofactors)
        parts = [self._control(rows) for rows in solved.eliminated if rows.chunk.ground]
        if parts:
            joined = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
        else:
            joined = [np.zeros(shape) for shape in ((0,), (0, 3, 3), (0, 3, size), (0, 3), (0, 3))]
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
        self.pseudo, self.pseudo_right = pseudo.T @ pseudo, pseudo.T @ linear.misfits.pseudo
        inverse = np.linalg.inv(self.u + diagonal(self.weights))
        taken = inverse @ self.k
        flat = self.k.reshape(3 * len(self.rows), size)
        # The normal matrix of the solution is the unit matrix, its gradient zero: what is not control is the rest.
        self.image = np.eye(size) - self.pseudo + flat.T @ taken.reshape(flat.shape)
        right = (inverse @ (self.ue + self.weights * self.d)[:, :, None])[:, :, 0]
        self.image_right = flat.T @ right.ravel() - self.pseudo_right
        self.square = float((linear.misfits.rays**2).sum())
        self.points = linear.ordering.points
        self.observations = linear.ordering.observations
        pixel = np.linalg.norm(linear.by_point, axis=2)[linear.by_point.any(axis=(1, 2))]
        sigma = float(np.median(problem.points.sigma_image))
        self.finest = math.log(_FINEST / sigma)
        self.pixel = 1.0 / max(float(np.median(pixel)) * sigma, 1e-12) if len(pixel) else 1.0

    def _control(self, rows: Eliminated) -> tuple[Any, ...]:
        """Return the points of a chunk, and their parts of `u`, `k`, `ue` and `d`."""
        linear, chunk, problem = rows.linear, rows.chunk, rows.linear.problem
        n, k = chunk.rays.shape
        design = np.zeros((n, 2 * k, self.size))
        for group in chunk.groups:
            columns, real = rows.columns(group)
            design[group] = rows.design(group)[:, : 2 * k, real] @ self.root[columns]
        enu = problem.enu[chunk.points]
        by_point = linear.by_point[chunk.rays].reshape(n, 2 * k, 3) @ enu.swapaxes(1, 2)
        turned = by_point.swapaxes(1, 2)
        misfit = linear.misfits.rays[chunk.rays].reshape(n, 2 * k, 1)
        apart = (enu @ (problem.target[chunk.points] - linear.state.local[chunk.points])[:, :, None])[:, :, 0]
        apart = np.where(np.isfinite(problem.known[chunk.points]), apart, 0.0)
        return chunk.points, turned @ by_point, turned @ design, (turned @ misfit)[:, :, 0], apart

    def weights_at(self, nodes: Array) -> Array:
        """Return the weights ``(b, n, 3)`` of the ground with variances ``(b, 3)`` of image, plan and height."""
        own = 1.0 / nodes[:, None, [1, 1, 2]]
        return np.where(self.unstated, own, self.weights)

    def at(self, nodes: Array) -> Node:
        """Return the solutions with variances ``(b, 3)`` of image, plan and height."""
        size, scale = self.size, nodes[:, 0]
        weights = self.weights_at(nodes)
        m = self.u / scale[:, None, None, None] + diagonal(weights)
        inverse = np.asarray(np.linalg.inv(m), dtype=float)
        b = self.ue / scale[:, None, None] + weights * self.d
        met = (inverse @ b[..., None])[..., 0]
        taken = np.asarray(inverse @ self.k / scale[:, None, None, None], dtype=float)
        flat = self.k.reshape(3 * len(self.rows), size).T
        normal = self.image - flat @ taken.reshape(len(nodes), 3 * len(self.rows), size)
        normal = normal / scale[:, None, None] + self.pseudo
        right = self.image_right - met.reshape(len(nodes), 3 * len(self.rows)) @ flat.T
        right = right / scale[:, None] + self.pseudo_right
        cofactors = np.asarray(np.linalg.inv(normal) if size else normal, dtype=float)
        z = (cofactors @ right[:, :, None])[:, :, 0]
        shift = met - (taken @ z[:, None, :, None])[..., 0]
        square = self.square / scale + (weights * self.d**2).sum(axis=(1, 2))
        square -= (b * met).sum(axis=(1, 2)) + (right * z).sum(axis=1)
        ties = self.points - len(self.rows)
        spread = (self.observations - 3 * ties) * np.log(scale) + np.linalg.slogdet(m)[1].sum(axis=1)
        of_ground = np.log(np.where(self.unstated, weights, 1.0)).sum(axis=(1, 2))
        spread += (np.linalg.slogdet(normal)[1] if size else 0.0) - of_ground
        return Node(-0.5 * (spread + square), z, cofactors, shift, inverse, taken, weights)

    def redundancy(self, node: Node) -> tuple[float, float, float]:
        """Return the parts of the redundancy of measurements, and of unstated ground in plan and height, at a node."""
        spread = self.ground(node)[0]
        hat = node.weights[0] * np.diagonal(spread, axis1=1, axis2=2)
        of_ground = np.where(self.unstated, 1.0 - hat, 0.0).sum(axis=0)
        of_pseudo = float((self.pseudo * node.cofactors[0]).sum())
        image = self.observations - (self.size + 3 * self.points - float(hat.sum()) - of_pseudo)
        return image, float(of_ground[:2].sum()), float(of_ground[2])

    def ground(self, node: Node) -> Array:
        """Return the covariances ``(b, n, 3, 3)`` of the control points at nodes."""
        taken = node.taken
        return np.asarray(node.inverse + taken @ node.cofactors[:, None] @ taken.swapaxes(2, 3))


def _root(cofactors: Array) -> Array:
    """Return L with L L' the cofactors ``(P, P)``."""
    if not len(cofactors):
        return np.zeros((0, 0))
    scale = np.sqrt(np.diag(cofactors))
    root: Array = np.linalg.cholesky(cofactors / np.outer(scale, scale)) * scale[:, None]
    return root
