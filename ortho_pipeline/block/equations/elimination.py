r"""Elimination of a block's points: what is left determines its parameters, and these the points.

With rays :math:`l = f_i(p_i, X_j)`, all rows divided by their sigma, a step solves :math:`A\,dp + B\,dX = r`. Each
point appears in few rows, so its :math:`B_j = Q_j R_j` is small, and what is left after projecting onto the complement
of :math:`Q_j` holds the parameters alone (the Schur complement, taken orthogonally, so that nothing is squared):

.. math:: F_j = (I - Q_j Q_j^T) A_j, \qquad F\,dp = (I - Q Q^T)\, r, \qquad R_j\,dX_j = Q_j^T (r_j - A_j\,dp)

Points with equally many rays are eliminated together, as one stack of small matrices. The reduced system is solved by
orthogonal triangulation; only where it is large, by its normal equations :math:`A^T A - (Q^T A)^T (Q^T A)`, the points
eliminated one after the other by compiled code. Cofactors
of a point are :math:`R_j^{-1} (I + Q_j^T A_j\, C\, A_j^T Q_j) R_j^{-T}`, and the hat matrix of its rows is
:math:`Q_j Q_j^T + F_j C F_j^T`.

Source: Brown 1976 (elimination of points); Demmel et al. 2021 (orthogonally); Grodecki and Dial 2003 (blocks of RPCs).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import Misfits
from ortho_pipeline.block.equations.reduced_system import (
    DenseSolution,
    LevelSolution,
    NormalSystem,
    OrthogonalSystem,
    solve_triangular,
)
from ortho_pipeline.block.equations.unknowns import Chunk, Mask
from ortho_pipeline.block.points import Index
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

    def taken(self, cofactors: Cofactors) -> tuple[Array, Array]:
        """Return C A' Q ``(n, k p, 3)`` and Q' A C A' Q ``(n, 3, 3)``, C being the cofactors ``(P, P)``."""
        product = np.zeros(self.turned.swapaxes(1, 2).shape)
        for group in self.chunk.groups:
            _, real = self.columns(group)
            part = cofactors.of_images(self.chunk.images[group.start]) @ self.turned[group][:, :, real].swapaxes(1, 2)
            product[group.start : group.stop, real] = part
        return product, self.turned @ product

    def shift(self, padded: Array) -> Array:
        """Return the step of the points ``(n, 3)`` that goes with that of the parameters, a zero behind it."""
        columns = self.linear.problem.columns.padded[self.chunk.images]
        of_params = padded[columns].reshape(len(self.chunk.points), self.turned.shape[2], 1)
        return solve_triangular(self.r, self.met - (self.turned @ of_params)[:, :, 0])


class Elimination(Protocol):
    """The points of a block, factored out of its equations."""

    @property
    def linear(self) -> Linear:
        """The equations."""

    def system(self) -> OrthogonalSystem | NormalSystem:
        """Return the system of the parameters alone."""

    def shifts(self, values: Array) -> Array:
        """Return the step of the points ``(N, 3)`` that goes with that of the parameters ``(P,)``."""

    def hats(self, cofactors: Cofactors) -> tuple[Array, Array]:
        """Return the parts of the hat matrix of rays ``(M, 2, 2)`` and of known ground ``(N, 3, 3)``."""

    def ground(self, covariance: Cofactors, factor: float) -> Array:
        """Return the covariances ``(N, 3, 3)`` of the points in the frame; NaN for those that take no part."""


@dataclass(frozen=True, eq=False)
class StackedElimination:
    """Points that are eliminated in stacks of equally many rays, and kept so."""

    linear: Linear

    @cached_property
    def stacks(self) -> tuple[Eliminated, ...]:
        """The rows of all points with the points factored out."""
        return eliminate(self.linear)

    def system(self) -> OrthogonalSystem:
        """Return the system of the parameters alone, to be triangulated."""
        linear = self.linear
        system = OrthogonalSystem(_rows_of(linear), linear.problem.columns)
        for rows in self.stacks:
            for group in rows.chunk.groups:
                columns, real = rows.columns(group)
                free, left = rows.free(group)
                system.add(columns, free[:, :, real].reshape(left.size, len(columns)), left.ravel())
        system.add(np.arange(linear.problem.size), linear.pseudo_design, linear.misfits.pseudo)
        return system

    def shifts(self, values: Array) -> Array:
        """Return the step of the points ``(N, 3)`` that goes with that of the parameters ``(P,)``."""
        found = np.zeros((len(self.linear.problem.points), 3))
        padded = np.append(values, 0.0)
        for rows in self.stacks:
            found[rows.chunk.points] = rows.shift(padded)
        return found

    def hats(self, cofactors: Cofactors) -> tuple[Array, Array]:
        """Return the parts of the hat matrix of rays ``(M, 2, 2)`` and of known ground ``(N, 3, 3)``."""
        linear = self.linear
        of_rays, of_ground = _no_hats(linear)
        wide = linear.by_params.shape[2]
        padded = linear.problem.columns.padded
        real = padded >= 0
        table = np.where(real[:, :, None] & real[:, None], cofactors.matrix[padded[:, :, None], padded[:, None]], 0.0)
        for rows in self.stacks:
            product, inner = rows.taken(cofactors)
            core = np.eye(3) + inner
            for c in range(rows.chunk.rays.shape[1]):
                used, q = rows.chunk.rays[:, c], rows.q[:, 2 * c : 2 * c + 2]
                own = linear.by_params[used]
                cross = own @ product[:, c * wide : (c + 1) * wide] @ q.swapaxes(1, 2)
                own = own @ table[rows.chunk.images[:, c]] @ own.swapaxes(1, 2)
                of_rays[used] = q @ core @ q.swapaxes(1, 2) + own - cross - cross.swapaxes(1, 2)
            if rows.chunk.ground:
                q = rows.q[:, -3:]
                of_ground[rows.chunk.points] = q @ core @ q.swapaxes(1, 2)
        return of_rays, of_ground

    def ground(self, covariance: Cofactors, factor: float) -> Array:
        """Return the covariances ``(N, 3, 3)`` of the points in the frame; NaN for those that take no part."""
        found = np.full((len(self.linear.problem.points), 3, 3), np.nan)
        for rows in self.stacks:
            root = np.linalg.inv(rows.r)
            inner = factor * np.eye(3) + rows.taken(covariance)[1]
            found[rows.chunk.points] = root @ inner @ root.swapaxes(1, 2)
        return found


@dataclass(frozen=True, eq=False)
class StreamedElimination:
    """Points of a large block, eliminated one after the other by compiled code; nothing of them is kept."""

    linear: Linear

    @cached_property
    def _points(self) -> tuple[Index, Index, Index, Mask, Index]:
        ordering = self.linear.ordering
        return ordering.rays, ordering.starts, ordering.numbers, ordering.known, ordering.image

    @property
    def _partials(self) -> tuple[Array, Array, Array]:
        return self.linear.by_params, self.linear.by_point, self.linear.ground_by_point

    def system(self) -> NormalSystem:
        """Return the normal equations of the parameters alone."""
        from ortho_pipeline.block.equations import point_kernel

        linear, misfits = self.linear, self.linear.misfits
        levels = linear.problem.levels
        system = NormalSystem(levels)
        parts = system.blocks, system.right
        point_kernel.reduce(*self._points, levels.pairs.slot, *self._partials, misfits.rays, misfits.ground, parts)
        system.add(linear.pseudo.image, linear.pseudo.rows, misfits.pseudo)
        return system

    def shifts(self, values: Array) -> Array:
        """Return the step of the points ``(N, 3)`` that goes with that of the parameters ``(P,)``."""
        from ortho_pipeline.block.equations import point_kernel

        found = np.zeros((len(self.linear.problem.points), 3))
        step, misfits = np.append(values, 0.0)[self.linear.problem.columns.padded], self.linear.misfits
        point_kernel.shifts(*self._points, step, *self._partials, misfits.rays, misfits.ground, found)
        return found

    def hats(self, cofactors: Cofactors) -> tuple[Array, Array]:
        """Return the parts of the hat matrix of rays ``(M, 2, 2)`` and of known ground ``(N, 3, 3)``."""
        from ortho_pipeline.block.equations import point_kernel

        levels, found = self.linear.problem.levels, _no_hats(self.linear)
        blocks = cofactors.blocks_of(levels)
        point_kernel.hats(*self._points, levels.pairs.slot, blocks, *self._partials, *found)
        return found

    def ground(self, covariance: Cofactors, factor: float) -> Array:
        """Return the covariances ``(N, 3, 3)`` of the points in the frame; NaN for those that take no part."""
        from ortho_pipeline.block.equations import point_kernel

        levels, blocks = self.linear.problem.levels, covariance.blocks_of(self.linear.problem.levels)
        found = np.full((len(self.linear.problem.points), 3, 3), np.nan)
        point_kernel.ground(*self._points, levels.pairs.slot, blocks, factor, *self._partials, found)
        return found


def _no_hats(linear: Linear) -> tuple[Array, Array]:
    return np.zeros((linear.problem.points.rays, 2, 2)), np.zeros((len(linear.problem.points), 3, 3))


@dataclass(frozen=True, eq=False)
class Step:
    """A step of the parameters with its cofactors, and that of the points ``(N, 3)``."""

    points: Elimination
    solution: DenseSolution | LevelSolution
    shift: Array

    @property
    def linear(self) -> Linear:
        """The equations that it comes from."""
        return self.points.linear

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
    """Return the rows of all points, in stacks, with the points factored out."""
    return tuple(Eliminated.of(chunk, linear) for chunk in linear.ordering.chunks)


def eliminated(linear: Linear) -> Elimination:
    """Return the equations with their points factored out, in the way that suits their size."""
    large = float(_rows_of(linear)) * linear.problem.size**2 > _ORTHOGONAL_LIMIT
    return StreamedElimination(linear) if large else StackedElimination(linear)


def step_of(linear: Linear, damping: float = 0.0) -> Step:
    """Return the step that minimises the squares to first order; with `damping` a shorter one."""
    points = eliminated(linear)
    solution = points.system().solve(damping)
    return Step(points, solution, points.shifts(solution.values))


def weakest(linear: Linear) -> Array:
    """Return the combination of parameters ``(P,)`` that is determined least, each in units of its own effect."""
    vectors: Array = np.linalg.eigh(eliminated(linear).system().scaled())[1]
    return vectors[:, 0]


def _rows_of(linear: Linear) -> int:
    """Return the number of all equations."""
    return linear.ordering.observations + 3 * len(linear.ordering.grounded) + len(linear.misfits.pseudo)
