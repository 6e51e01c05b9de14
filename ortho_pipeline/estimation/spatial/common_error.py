r"""An error that many points have in common, as matches have that of their reference, in an adjustment.

The ground of such points is off by one unknown vector, in units of its standard deviation :math:`c \sim N(0, I)`
(true east and north). Nothing within these points shows it: what it moves them by in the image is taken to be what the
parameters can follow, :math:`A \Pi c`, with :math:`\Pi` the least-squares fit of the parameters to a shift of one
standard deviation. So it is one more pair of unknowns, which only points without it, and prior knowledge of the
parameters, tell anything of. With whitened design :math:`A`, cofactors :math:`Q`, and :math:`U = A \Pi` for the
points that share it and 0 for others,

.. math::
    S = I + U^T U - U^T A Q A^T U, \quad G = Q A^T U S^{-1}, \quad
    C = \sigma_0^2 (Q + G (S - I) G^T) + G G^T

Points that all share it leave :math:`S = I`, :math:`G = \Pi`: it is added in full, whatever their number, and sigma0,
which is of what differs from point to point, does not scale it.

Source: Koch 1999, section 3.2 (elimination of unknowns) and 3.6 (mixed model).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.estimation.observations.common_unknown import CommonUnknown
from ortho_pipeline.estimation.problem import Problem, Solution
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.models.base import Array, SensorModel, solve_2x2
from ortho_pipeline.points import Points

#: The estimate stands when it moves by less than this (standard deviations).
_STANDS = 1e-4
#: Information that is less than this part of what it is the rest of.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageCommonError(CommonUnknown):
    """What some points of an image have in common, and what the others tell of it.

    Parameters
    ----------
    per_sigma : (P, 2)
        What the parameters follow it by, per standard deviation along each axis.
    gain : (P, 2)
        What it leaves in the parameters.
    shares : (n,) of bool
        Which points of the last solution share it.
    """

    per_sigma: Array
    gain: Array
    shares: np.ndarray

    @classmethod
    def of(cls, model: SensorModel, points: Points, used: np.ndarray) -> ImageCommonError | None:
        """Return that of points, in the CRS of the model, of which those in a mask ``(N,)`` control; None without."""
        shares = used & (points.sigma_common > 0)
        count = len(model.params)
        if not shares.any() or not count:
            return None
        problem = Problem.of(model, points, shares, {})
        per_metre = model.ground_partials(problem.ground) @ map_from_enu(parse_crs(model.crs), problem.ground)
        # Where ground is said to lie farther east than it does, it is seen farther west of where the model puts it.
        moved = -problem.errors.whitened(per_metre[:, :, :2] * problem.points.sigma_common[:, None, None])
        design = problem.errors.whitened(model.param_partials(problem.ground))
        scale = np.maximum(np.linalg.norm(design, axis=(0, 1)), 1e-300)
        found = np.linalg.lstsq((design / scale).reshape(-1, count), moved.reshape(-1, 2), rcond=1e-10)[0]
        per_sigma = np.asarray(found / scale[:, None])
        largest = float(problem.points.sigma_common.max())
        everyone = np.ones(len(problem.rows), dtype=bool)
        return cls(
            sigma=largest,
            points=len(everyone),
            value=np.zeros(2),
            told=np.zeros((2, 2)),
            per_sigma=per_sigma,
            gain=per_sigma,
            shares=everyone,
        )

    def offset(self, model: SensorModel, points: Points) -> Array:
        """Return how far (px) it moves each of points ``(N, 2)``; 0 for those that do not share it."""
        shares = points.sigma_common > 0
        found = np.zeros((len(points), 2))
        found[shares] = model.param_partials(points.ground[shares]) @ (self.per_sigma @ self.value)
        return found

    def seen_by(self, model: SensorModel, others: Points) -> ImageCommonError:
        """Return it as points without it see it, from a model that was adjusted to those with it."""
        miss = others.image - model.ground_to_image(others.ground)
        return self.started(solve_2x2(model.param_partials(others.ground) @ self.per_sigma, -miss))

    def settled(self, problem: Problem, keep: np.ndarray, solution: Solution) -> tuple[Solution, ImageCommonError]:
        """Return the solution with it as an unknown.

        Parameters
        ----------
        problem : Problem
            With the images as they were measured.
        keep : (n,) of bool
            The points that take part.
        solution : Solution
            With its present value.
        """

        def again(found: ImageCommonError, _: Solution) -> Solution:
            return problem.shifted(-found.offset(problem.model, problem.points)).solve(keep)

        shared = replace(self, shares=problem.points.sigma_common[keep] > 0)
        return shared.settled_with(solution, ImageCommonError._seen, again, _STANDS)

    def _seen(self, solution: Solution) -> tuple[ImageCommonError, Array]:
        """Return it with what a solution tells of it, and the slope of half the sum of squares ``(2,)``."""
        design = solution.errors.whitened(solution.jacobian)
        moved = self.moved(solution)
        cross = np.einsum("nip,nik->pk", design, moved)
        gain = solution.cofactors @ cross
        told = _difference(np.einsum("nik,nil->kl", moved, moved), cross.T @ gain)
        slope = np.einsum("nik,ni->k", moved, solution.errors.whitened(solution.residuals))
        found = replace(self, told=told)
        return replace(found, gain=gain @ found.left), slope

    def moved(self, solution: Solution) -> Array:
        """Return by how much one sigma of it moves the points of a solution ``(n, 2, 2)``, whitened."""
        moved = solution.errors.whitened(solution.jacobian) @ self.per_sigma
        return np.where(self.shares[:, None, None], moved, 0.0)

    def cofactors(self, solution: Solution) -> Array:
        """Return the cofactors ``(P, P)`` of the parameters, of what differs from point to point."""
        return solution.cofactors + self.gain @ self.told @ self.gain.T

    def influence(self, solution: Solution) -> Array:
        """Return what each whitened observation does to the parameters ``(n, 2, P)``."""
        design, moved = solution.errors.whitened(solution.jacobian), self.moved(solution)
        cross = np.einsum("nip,nik->pk", design, moved)
        left = moved - design @ (solution.cofactors @ cross)
        return design @ solution.cofactors - left @ self.gain.T

    @property
    def covariance(self) -> Array:
        """Its part ``(P, P)`` of the covariance of the parameters."""
        return self.gain @ self.gain.T


def _difference(whole: Array, part: Array) -> Array:
    """Return a symmetric matrix less a part of it, without what rounding made of it."""
    values, vectors = np.linalg.eigh(whole - (part + part.T) / 2)
    values[values < _ROUNDING * np.trace(whole)] = 0.0
    return np.asarray((vectors * values) @ vectors.T)
