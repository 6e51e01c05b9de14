r"""An error common to many points in the adjustment of one image, such as the error of a reference for its matches.

The ground of such points has an unknown common offset :math:`c \sim N(0, I)`, in units of its standard deviation (true
east and north). These points alone cannot show it. Its effect in the image is taken as the part that the parameters can
absorb, :math:`A \Pi c`, where :math:`\Pi` is the least-squares fit of the parameters to a shift of one standard
deviation. So it is one more pair of unknowns. Only points without it and prior knowledge of the parameters determine
it. With whitened design :math:`A`, cofactors :math:`Q`, and :math:`U = A \Pi` for the points that share it (0 for
others),

.. math::
    S = I + U^T U - U^T A Q A^T U, \quad G = Q A^T U S^{-1}, \quad
    C = \sigma_0^2 (Q + G (S - I) G^T) + G G^T

If all points share it, :math:`S = I` and :math:`G = \Pi`: it is added in full, whatever the number of points. sigma0
measures differences between points, so it does not scale the common error.

Source: Koch 1999, section 3.2 (elimination of unknowns) and 3.6 (mixed model).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.estimation.observations.common_unknown import CommonGroundError
from ortho_pipeline.estimation.problem import Problem, Solution
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.models.base import Array, SensorModel, solve_2x2
from ortho_pipeline.points import Points

#: The iteration stops when the estimate changes by less than this (standard deviations).
_STANDS = 1e-4
#: A difference below this part of its minuend is rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageCommonError(CommonGroundError):
    """A common error of some points of an image, and the information on it from the others.

    Parameters
    ----------
    per_sigma : (P, 2)
        Change of the parameters by one standard deviation along each axis.
    gain : (P, 2)
        Error of the parameters that remains, per standard deviation.
    shares : (n,) of bool
        Points of the last solution that share the error.
    """

    per_sigma: Array
    gain: Array
    shares: np.ndarray

    @classmethod
    def of(cls, model: SensorModel, points: Points, used: np.ndarray) -> ImageCommonError | None:
        """Return the common error of the used points (mask ``(N,)``), in the CRS of the model; None without one."""
        shares = used & (points.sigma_common > 0)
        count = len(model.params)
        if not shares.any() or not count:
            return None
        problem = Problem.of(model, points, shares, {})
        per_metre = model.ground_partials(problem.ground) @ map_from_enu(parse_crs(model.crs), problem.ground)
        # If the stated ground is too far east, the point appears west of its predicted position.
        moved = -problem.errors.whitened(per_metre[:, :, :2] * problem.points.sigma_common[:, None, None])
        design = problem.errors.whitened(model.param_partials(problem.ground))
        scale = np.maximum(np.linalg.norm(design, axis=(0, 1)), 1e-300)
        scaled = np.linalg.lstsq((design / scale).reshape(-1, count), moved.reshape(-1, 2), rcond=1e-10)[0]
        per_sigma = np.asarray(scaled / scale[:, None])
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
        """Return the displacement ``(N, 2)`` px of points by the error; 0 for points that do not share it."""
        shares = points.sigma_common > 0
        offsets = np.zeros((len(points), 2))
        offsets[shares] = model.param_partials(points.ground[shares]) @ (self.per_sigma @ self.value)
        return offsets

    def seen_by(self, model: SensorModel, others: Points) -> ImageCommonError:
        """Return the error as estimated from points without it, with a model adjusted to the points with it."""
        miss = others.image - model.ground_to_image(others.ground)
        return self.started(solve_2x2(model.param_partials(others.ground) @ self.per_sigma, -miss))

    def settled(self, problem: Problem, keep: np.ndarray, solution: Solution) -> tuple[Solution, ImageCommonError]:
        """Return the solution with the error as an unknown.

        Parameters
        ----------
        problem : Problem
            With the original image measurements.
        keep : (n,) of bool
            The points that take part.
        solution : Solution
            With the present value of the error.
        """

        def again(error: ImageCommonError, _: Solution) -> Solution:
            return problem.shifted(-error.offset(problem.model, problem.points)).solve(keep)

        shared = replace(self, shares=problem.points.sigma_common[keep] > 0)
        return shared.settled_with(solution, ImageCommonError._seen, again, _STANDS)

    def _seen(self, solution: Solution) -> tuple[ImageCommonError, Array]:
        """Return the error with the information of a solution, and the slope of half the sum of squares ``(2,)``."""
        design = solution.errors.whitened(solution.jacobian)
        moved = self.moved(solution)
        cross = np.einsum("nip,nik->pk", design, moved)
        gain = solution.cofactors @ cross
        told = _difference(np.einsum("nik,nil->kl", moved, moved), cross.T @ gain)
        slope = np.einsum("nik,ni->k", moved, solution.errors.whitened(solution.residuals))
        error = replace(self, told=told)
        return replace(error, gain=gain @ error.left), slope

    def moved(self, solution: Solution) -> Array:
        """Return the displacement of the points of a solution by one sigma ``(n, 2, 2)``, whitened."""
        moved = solution.errors.whitened(solution.jacobian) @ self.per_sigma
        return np.where(self.shares[:, None, None], moved, 0.0)

    def cofactors(self, solution: Solution) -> Array:
        """Return the cofactors ``(P, P)`` of the parameters from errors that differ between points."""
        return solution.cofactors + self.gain @ self.told @ self.gain.T

    def influence(self, solution: Solution) -> Array:
        """Return the influence of each whitened observation on the parameters ``(n, 2, P)``."""
        design = solution.errors.whitened(solution.jacobian)
        return design @ solution.cofactors - self._beyond(solution) @ self.gain.T

    def beyond_parameters(self, solution: Solution) -> Array:
        """Return what the error adds to whitened observations ``(n, 2, 2)`` besides what the parameters absorb.

        The last axis has two independent parts of what is uncertain of it, one standard deviation of each.
        """
        return self._beyond(solution) @ np.linalg.cholesky(self.left)

    def _beyond(self, solution: Solution) -> Array:
        """Return what the parameters do not absorb of the displacement by one sigma ``(n, 2, 2)``, whitened."""
        design, moved = solution.errors.whitened(solution.jacobian), self.moved(solution)
        cross = np.einsum("nip,nik->pk", design, moved)
        return moved - design @ (solution.cofactors @ cross)

    @property
    def covariance(self) -> Array:
        """The part ``(P, P)`` of the covariance of the parameters that comes from the error."""
        return self.gain @ self.gain.T


def _difference(total: Array, part: Array) -> Array:
    """Return a symmetric matrix minus a part of it, without rounding errors."""
    values, vectors = np.linalg.eigh(total - (part + part.T) / 2)
    values[values < _ROUNDING * np.trace(total)] = 0.0
    return np.asarray((vectors * values) @ vectors.T)
