r"""An error that the ground of many points of a block has in common, as matches have that of their reference.

Their known ground is off by one unknown vector in plan, :math:`c \sim N(0, I)` in units of its standard deviation. By
itself it is seen by nothing: images, ties and matches all move with it. Other control, and prior knowledge of the
parameters, tell of it. So it is one more pair of unknowns of the block, solved for with the others: with misfits
:math:`r` (over their sigmas) at a minimum, and :math:`U` what one sigma of it takes off them, a step of all other
unknowns takes :math:`H U` off and leaves :math:`V = (I - H) U`, and

.. math::
    (I + V^T V)\, dc = V^T r - c, \quad C = C_{\mathrm{rest}} + S (I + V^T V)^{-1} S^T

with :math:`S` the step of parameters and points that goes with :math:`U`. Where nothing tells of it, :math:`V = 0`, and
the whole of it stands in the covariances of parameters and ground, whatever the number of points; what is estimated of
the measurements' own sigmas does not scale it.

Source: Koch 1999, section 3.2 (elimination of unknowns) and 3.6 (mixed model); as `estimation.spatial.common_error` of
one image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.elimination import step_of
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Misfits, Selection, State
from ortho_pipeline.block.equations.solver import Solved, attempt, solve
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.estimation.observations.common_unknown import CommonGroundError
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models.base import Array, solve_2x2

#: The estimate stands when it moves by less than this (standard deviations).
_STANDS = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockCommonError(CommonGroundError):
    """What known ground has in common, and what a block tells of it.

    Parameters
    ----------
    sigmas : ndarray (N,)
        Its standard deviation at each point, m per axis; 0 for those that do not share it.
    known : ndarray (N, 3)
        Lon, lat, h of the ground as it was stated.
    by_params, by_points : ndarray (P, 2), (N, 3, 2)
        How one standard deviation of it moves parameters, and points in their east, north, up.
    seen : ndarray (M, 2, 2)
        What one standard deviation leaves of the misfits of rays (whitened), along each axis of it.
    """

    sigmas: Array
    known: Array
    by_params: Array
    by_points: Array
    seen: Array

    @classmethod
    def of(cls, problem: BlockProblem, state: State, selection: Selection) -> BlockCommonError | None:
        """Return that of the ground that a selection uses, as other ground sees it first; None without."""
        sigmas = problem.points.sigma_common
        used = selection.ground & problem.active(selection)
        shared = int((used & (sigmas > 0)).sum())
        if not shared or not problem.size:
            return None
        rays = problem.points.rays
        found = cls(
            sigma=float(sigmas.max()),
            points=shared,
            value=np.zeros(2),
            told=np.zeros((2, 2)),
            sigmas=sigmas,
            known=problem.known,
            by_params=np.zeros((problem.size, 2)),
            by_points=np.zeros((len(sigmas), 3, 2)),
            seen=np.zeros((rays, 2, 2)),
        )
        return found._seen_by(problem, state, selection) if (used & (sigmas == 0)).any() else found

    def corrected(self, known: Array) -> Array:
        """Return ground ``(N, 3)`` lon, lat, h as it lies without the estimate."""
        found = known.copy()
        moved = self.sigmas > 0
        metres = self.sigmas[moved, None] * self.value
        found[moved, :2] -= metres / metres_per_degree(np.nan_to_num(known[moved]))
        return found

    def applied(self, problem: BlockProblem) -> BlockProblem:
        """Return the problem with the known ground as it lies without the estimate."""
        return replace(problem, known=self.corrected(self.known)) if self.value.any() else problem

    def settled(self, solved: Solved, selection: Selection) -> tuple[Solved, BlockCommonError]:
        """Return the solution with it as an unknown, from one with its present value."""
        problem = solved.problem
        shared = selection.ground & problem.active(selection) & (self.sigmas > 0)

        def seen(found: BlockCommonError, solved: Solved) -> tuple[BlockCommonError, Array]:
            found, left = found._moving(solved)
            # Without anything else only rounding, and the bending of the models, would tell of it.
            if not found._is_told(solved, selection):
                return replace(found, told=np.zeros((2, 2))), np.zeros(2)
            return replace(found, told=left.T @ left), left.T @ solved.linear.misfits.vector

        def again(found: BlockCommonError, solved: Solved) -> Solved:
            return solve(found.applied(problem), solved.state, selection)

        return replace(self, points=int(shared.sum())).settled_with(solved, seen, again, _STANDS)

    def _is_told(self, solved: Solved, selection: Selection) -> bool:
        """Tell whether control without it, or knowledge of parameters, takes part."""
        others = selection.ground & solved.problem.active(selection) & (self.sigmas == 0)
        return bool(others.any() or len(solved.linear.misfits.pseudo))

    def _moving(self, solved: Solved) -> tuple[BlockCommonError, Array]:
        """Return it with what it moves, and what one sigma along each axis leaves of misfits ``(m, 2)``."""
        linear, problem = solved.linear, solved.problem
        params, places, left = [], [], []
        for misfits in self._misfits(linear):
            step = step_of(replace(linear, misfits=misfits))
            # A misfit of known ground that is taken off the ground moves all the other way.
            params.append(-step.solution.values)
            turned = problem.frame.enu_at(problem.frame.geodetic(linear.state.local))
            places.append(-(turned @ step.shift[:, :, None])[:, :, 0])
            left.append(misfits.minus(step.change).vector)
        whole = np.stack(left, axis=-1)
        seen = whole[: 2 * problem.points.rays].reshape(-1, 2, 2)
        by_params, by_points = np.stack(params, axis=-1), np.stack(places, axis=-1)
        return replace(self, by_params=by_params, by_points=by_points, seen=seen), whole

    def _misfits(self, linear: Linear) -> list[Misfits]:
        """Return what one sigma of it, east and north, takes off the misfits."""
        problem, rows = linear.problem, linear.ordering.grounded
        sigmas, found = problem.on_points(linear.state.local, rows).sigmas, []
        for axis in range(2):
            ground = np.zeros((len(problem.points), 3))
            root = np.sqrt(linear.weights.ground_weights[rows])
            ground[rows, axis] = self.sigmas[rows] / sigmas[:, axis] * root
            found.append(Misfits(np.zeros_like(linear.misfits.rays), ground, np.zeros_like(linear.misfits.pseudo)))
        return found

    def _seen_by(self, problem: BlockProblem, state: State, selection: Selection) -> BlockCommonError:
        """Return it as known ground without it sees it, ray by ray, from a block without that ground."""
        alone = replace(selection, ground=selection.ground & (self.sigmas > 0))
        try:
            solved = attempt(problem, state, alone)
        except OrthoError:
            return self
        if not solved.converged or solved.condition > CONDITION_LIMIT:
            return self
        moved, _ = self._moving(solved)
        others = selection.ground & (self.sigmas == 0) & np.isfinite(problem.known).all(axis=1)
        return self.started(moved._each(solved, others, selection.rays))

    def _each(self, solved: Solved, others: Mask, rays: Mask) -> Array:
        """Return what rays ``(M,)`` of known ground ``(N,)`` say of it by themselves ``(n, 2)``."""
        problem, points = solved.problem, solved.problem.points
        places = problem.frame.places(problem.target)
        each = [np.zeros((0, 2))]
        for image, model in enumerate(solved.state.models):
            used = np.flatnonzero(rays & (points.image == image) & others[points.point])
            rows = points.point[used]
            if not len(used) or not len(model.params):
                continue
            miss = points.measured[used] - places.project(model, rows)
            partials = model.param_partials(places.in_crs(model.crs)[rows])
            each.append(solve_2x2(partials @ self.by_params[problem.columns.of_image(image)], miss))
        return np.concatenate(each)

    # -- what it leaves ------------------------------------------------------------------------------------------------

    @property
    def of_points(self) -> Array:
        """Its part ``(N, 3, 3)`` of the covariance of the ground, m²."""
        return np.asarray(self.by_points @ self.left @ self.by_points.swapaxes(1, 2))
