r"""Elimination of a block's points: what is left determines its parameters, and these the points.

With rays :math:`l = f_i(p_i, X_j)`, all rows divided by their sigma, a step solves :math:`A\,dp + B\,dX = r`. Each
point appears in few rows, so its :math:`B_j = Q_j R_j` is small, and what is left after projecting onto the complement
of :math:`Q_j` holds the parameters alone (the Schur complement, taken orthogonally, so that nothing is squared):

.. math:: F_j = (I - Q_j Q_j^T) A_j, \qquad F\,dp = (I - Q Q^T)\, r, \qquad R_j\,dX_j = Q_j^T (r_j - A_j\,dp)

Points with equally many rays are eliminated together, as one stack of small matrices. The reduced system is solved by
orthogonal triangulation; only where it is large, by its normal equations :math:`A^T A - (Q^T A)^T (Q^T A)`. Cofactors
of a point are :math:`R_j^{-1} (I + Q_j^T A_j\, C\, A_j^T Q_j) R_j^{-T}`, and the hat matrix of its rows is
:math:`Q_j Q_j^T + F_j C F_j^T`.

Source: Brown 1976 (elimination of points); Demmel et al. 2021 (orthogonally); Grodecki and Dial 2003 (blocks of RPCs).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import Misfits
from ortho_pipeline.block.equations.reduced_system import NormalSystem, OrthogonalSystem, solve_triangular
from ortho_pipeline.block.equations.unknowns import Chunk, Mask
from ortho_pipeline.block.points import Index
from ortho_pipeline.estimation.least_squares import LinearSolution
from ortho_pipeline.models.base import Array

#: Beyond so many multiplications the reduced system is solved by its normal equations.
_ORTHOGONAL_LIMIT = 1e9


@dataclass(frozen=True, eq=False)
class Eliminated:
    """The rows of the points of a chunk, factored: B = Q R with `q` ``(n, m, 3)``, `r` ``(n, 3, 3)``.

    `turned` ``(n, 3, k p)`` and `met` ``(n, 3)`` are Q' A and Q' r: what the points take of parameters and misfits.
    """

    chunk: Chunk
    linear: Linear
    q: Array
    r: Array
    turned: Array
    met: Array
    misfit: Array

    @classmethod
    def of(cls, chunk: Chunk, linear: Linear) -> Eliminated:
        """Factor the rows of a chunk."""
        count, k = chunk.rays.shape
        points = linear.by_point[chunk.rays].reshape(count, 2 * k, 3)
        misfit = linear.misfits.rays[chunk.rays].reshape(count, 2 * k)
        if chunk.ground:
            points = np.concatenate([points, linear.ground_by_point[chunk.points]], axis=1)
            misfit = np.concatenate([misfit, linear.misfits.ground[chunk.points]], axis=1)
        q, r = np.linalg.qr(points)
        of_rays = q[:, : 2 * k].reshape(count, k, 2, 3).swapaxes(2, 3)
        turned = (of_rays @ linear.by_params[chunk.rays]).transpose(0, 2, 1, 3)
        turned = turned.reshape(count, 3, k * linear.problem.columns.widest)
        met = (q.swapaxes(1, 2) @ misfit[:, :, None])[:, :, 0]
        return cls(chunk, linear, q, r, turned, met, misfit)

    def columns(self, group: slice) -> tuple[Index, Mask]:
        """Return the parameters of the images of a group, and which of the padded columns they are."""
        padded = self.linear.problem.columns.padded[self.chunk.images[group.start]].ravel()
        return padded[padded >= 0], padded >= 0

    def design(self, rows: slice) -> Array:
        """Return the partials by the parameters of their images ``(n, m, k p)`` of some of the points."""
        rays = self.chunk.rays[rows]
        count, k = rays.shape
        by_params = self.linear.by_params[rays]
        wide = by_params.shape[3]
        design = np.zeros((count, self.q.shape[1], k * wide))
        for c in range(k):
            design[:, 2 * c : 2 * c + 2, c * wide : (c + 1) * wide] = by_params[:, c]
        return design

    def free(self, rows: slice) -> tuple[Array, Array]:
        """Return rows ``(n, m, k p)`` and misfits ``(n, m)`` of some of the points without what the points can take."""
        free = self.design(rows) - self.q[rows] @ self.turned[rows]
        left = self.misfit[rows] - (self.q[rows] @ self.met[rows][:, :, None])[:, :, 0]
        return free, left

    def taken(self, cofactors: Array) -> tuple[Array, Array]:
        """Return C A' Q ``(n, k p, 3)`` and Q' A C A' Q ``(n, 3, 3)``, C being the cofactors ``(P, P)``."""
        product = np.zeros(self.turned.swapaxes(1, 2).shape)
        for group in self.chunk.groups:
            columns, real = self.columns(group)
            part = cofactors[columns[:, None], columns] @ self.turned[group][:, :, real].swapaxes(1, 2)
            product[group.start : group.stop, real] = part
        return product, self.turned @ product

    def shift(self, padded: Array) -> Array:
        """Return the step of the points ``(n, 3)`` that goes with that of the parameters, a zero behind it."""
        columns = self.linear.problem.columns.padded[self.chunk.images]
        of_params = padded[columns].reshape(len(self.chunk.points), self.turned.shape[2], 1)
        return solve_triangular(self.r, self.met - (self.turned @ of_params)[:, :, 0])


@dataclass(frozen=True, eq=False)
class Step:
    """A step of the parameters with its cofactors, that of the points ``(N, 3)``, and the rows that it comes from."""

    linear: Linear
    eliminated: tuple[Eliminated, ...]
    solution: LinearSolution
    shift: Array

    @property
    def condition(self) -> float:
        """Condition of the reduced system."""
        return self.solution.condition

    @property
    def finite(self) -> bool:
        """Whether all of it could be computed."""
        return bool(np.isfinite(self.solution.values).all() and np.isfinite(self.shift).all())

    @property
    def whole(self) -> Array:
        """The steps of all unknowns, one after the other."""
        return np.concatenate([self.solution.values, self.shift.ravel()])

    @property
    def change(self) -> Misfits:
        """Misfits that it takes off, to first order."""
        return self.linear.changes(self.solution.values, self.shift)


def eliminate(linear: Linear) -> tuple[Eliminated, ...]:
    """Return the rows of all points with the points factored out."""
    return tuple(Eliminated.of(chunk, linear) for chunk in linear.ordering.chunks)


def step_of(linear: Linear, damping: float = 0.0) -> Step:
    """Return the step that minimises the squares to first order; with `damping` a shorter one."""
    eliminated = eliminate(linear)
    solution = _reduced(linear, eliminated).solve(damping)
    shift = np.zeros((len(linear.problem.points), 3))
    padded = np.append(solution.values, 0.0)
    for rows in eliminated:
        shift[rows.chunk.points] = rows.shift(padded)
    return Step(linear, eliminated, solution, shift)


def weakest(linear: Linear) -> Array:
    """Return the combination of parameters ``(P,)`` that is determined least, each in units of its own effect."""
    vectors: Array = np.linalg.eigh(_normal(linear, eliminate(linear)).scaled)[1]
    return vectors[:, 0]


def _reduced(linear: Linear, eliminated: Sequence[Eliminated]) -> OrthogonalSystem | NormalSystem:
    """Return the system of the parameters alone."""
    size = linear.problem.size
    total = linear.ordering.observations + 3 * len(linear.ordering.grounded) + len(linear.misfits.pseudo)
    if float(total) * size**2 > _ORTHOGONAL_LIMIT:
        return _normal(linear, eliminated)
    system = OrthogonalSystem(total, size)
    for rows in eliminated:
        for group in rows.chunk.groups:
            columns, real = rows.columns(group)
            free, left = rows.free(group)
            system.add(columns, free[:, :, real].reshape(left.size, len(columns)), left.ravel())
    system.add(np.arange(size), linear.pseudo_rows, linear.misfits.pseudo)
    return system


def _normal(linear: Linear, eliminated: Sequence[Eliminated]) -> NormalSystem:
    """Return the normal equations of the parameters alone."""
    normal = NormalSystem(linear.problem.size)
    for image, used in enumerate(linear.ordering.rays_of_image):
        columns = linear.problem.columns.of_image(image)
        design = linear.by_params[used][:, :, : len(columns)].reshape(2 * len(used), len(columns))
        normal.add(columns, design, linear.misfits.rays[used].ravel())
    for rows in eliminated:
        for group in rows.chunk.groups:
            columns, real = rows.columns(group)
            met = rows.met[group].ravel()
            turned = rows.turned[group][:, :, real].reshape(len(met), len(columns))
            normal.add(columns, turned, met, sign=-1.0)
    normal.add(np.arange(linear.problem.size), linear.pseudo_rows, linear.misfits.pseudo)
    return normal
