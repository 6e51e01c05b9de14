r"""Elimination of a block's points: what is left determines its parameters, and these the points.

With rays :math:`l = f_i(p_i, X_j)`, all rows divided by their sigma, a step solves :math:`A\,dp + B\,dX = r`. Each
point appears in few rows, so its :math:`B_j = Q_j R_j` is small, and what is left after projecting onto the complement
of :math:`Q_j` holds the parameters alone (the Schur complement, taken orthogonally):

.. math:: F_j = (I - Q_j Q_j^T) A_j, \qquad F\,dp = (I - Q Q^T)\, r, \qquad R_j\,dX_j = Q_j^T (r_j - A_j\,dp)

The reduced system is solved by its normal equations :math:`A^T A - (Q^T A)^T (Q^T A)`, with a diagonal of ones; blocks
are refused at a condition at which these still have some digits. Cofactors of a point are
:math:`R_j^{-1} (I + Q_j^T A_j\, C\, A_j^T Q_j) R_j^{-T}`, and the hat matrix of its rows is
:math:`Q_j Q_j^T + F_j C F_j^T`. Compiled code takes the points one after the other, parts of them side by side: as many
parts on any machine, whose sums are added in their order, so that results do not depend on the number of threads.

Source: Brown 1976 (elimination of points); Demmel et al. 2021 (orthogonally); Grodecki and Dial 2003 (blocks of RPCs).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import Misfits
from ortho_pipeline.block.equations.reduced_system import NormalSolution, NormalSystem
from ortho_pipeline.models.base import Array
from ortho_pipeline.runtime.process_limits import parts_of, side_by_side

if TYPE_CHECKING:
    from ortho_pipeline.block.equations import point_kernel

#: Points that are worth a thread.
_SHARE = 2_000


@dataclass(frozen=True, eq=False)
class Elimination:
    """The points of a block, factored out of its equations one after the other; nothing of them is kept."""

    linear: Linear

    @property
    def _rows(self) -> point_kernel.Rows:
        """These equations for compiled code."""
        from ortho_pipeline.block.equations import point_kernel

        linear, ordering = self.linear, self.linear.ordering
        return point_kernel.Rows(
            ordering.rays,
            ordering.starts,
            ordering.numbers,
            ordering.known,
            ordering.image,
            linear.problem.levels.pairs.slot,
            linear.by_params,
            linear.by_point,
            linear.ground_by_point,
            linear.misfits.rays,
            linear.misfits.ground,
        )

    @property
    def _parts(self) -> list[tuple[int, int]]:
        return parts_of(self.linear.ordering.points, _SHARE)

    def system(self) -> NormalSystem:
        """Return the normal equations of the parameters alone."""
        from ortho_pipeline.block.equations import point_kernel

        linear, rows, parts = self.linear, self._rows, self._parts
        systems = [NormalSystem(linear.problem.levels) for _ in parts]
        side_by_side(
            lambda k, begin, end: point_kernel.reduce(rows, begin, end, systems[k].blocks, systems[k].right), parts
        )
        system = systems[0]
        for other in systems[1:]:
            system.blocks += other.blocks
            system.right += other.right
        system.add(linear.pseudo.image, linear.pseudo.rows, linear.misfits.pseudo)
        return system

    def shifts(self, values: Array) -> tuple[Array, Misfits]:
        """Return the step of the points ``(N, 3)`` that goes with that of the parameters ``(P,)``.

        And what both take off the misfits, to first order.
        """
        from ortho_pipeline.block.equations import point_kernel

        linear, points, rows = self.linear, self.linear.problem.points, self._rows
        step = np.append(values, 0.0)[linear.problem.columns.padded]
        of_rays = linear.problem.buffers.zeros((points.rays, 2))
        found, of_ground = np.zeros((len(points), 3)), np.zeros((len(points), 3))
        made = found, of_rays, of_ground
        side_by_side(lambda _, begin, end: point_kernel.shifts(rows, begin, end, step, *made), self._parts)
        pseudo = (linear.pseudo.rows * step[linear.pseudo.image]).sum(axis=1)
        return found, Misfits(of_rays, of_ground, pseudo)

    def hats(self, cofactors: Cofactors) -> tuple[Array, Array]:
        """Return the parts of the hat matrix of rays ``(M, 2, 2)`` and of known ground ``(N, 3, 3)``."""
        from ortho_pipeline.block.equations import point_kernel

        points, rows, blocks = self.linear.problem.points, self._rows, cofactors.blocks
        found = self.linear.problem.buffers.zeros((points.rays, 2, 2)), np.zeros((len(points), 3, 3))
        side_by_side(lambda _, begin, end: point_kernel.hats(rows, begin, end, blocks, *found), self._parts)
        return found

    def ground(self, covariance: Cofactors, factor: float) -> Array:
        """Return the covariances ``(N, 3, 3)`` of the points in the frame; NaN for those that take no part."""
        from ortho_pipeline.block.equations import point_kernel

        rows, blocks, found = self._rows, covariance.blocks, np.full((len(self.linear.problem.points), 3, 3), np.nan)
        side_by_side(lambda _, begin, end: point_kernel.ground(rows, begin, end, blocks, factor, found), self._parts)
        return found


@dataclass(frozen=True, eq=False)
class Step:
    """A step of the parameters with its cofactors, and that of the points ``(N, 3)``.

    `change` are the misfits that it takes off, to first order.
    """

    points: Elimination
    solution: NormalSolution
    shift: Array
    change: Misfits

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


def step_of(linear: Linear, damping: float = 0.0) -> Step:
    """Return the step that minimises the squares to first order; with `damping` a shorter one."""
    points = Elimination(linear)
    solution = points.system().solve(damping)
    return Step(points, solution, *points.shifts(solution.values))


def weakest(linear: Linear) -> Array:
    """Return the combination of parameters ``(P,)`` that is determined least, each in units of its own effect."""
    vectors: Array = np.linalg.eigh(Elimination(linear).system().scaled())[1]
    return vectors[:, 0]
