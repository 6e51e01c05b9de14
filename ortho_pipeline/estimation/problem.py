r"""The least-squares problem of one image: image measurements of control points, priors, and a regularisation.

With image residuals :math:`v = l - f(x)` (measured minus predicted), weights :math:`W = \Sigma^{-1}`, and as further
observations each `Prior` and each of the model's own (`SensorModel.constraints`), the estimate minimises
:math:`v^T W v`. Then

- redundancy :math:`r` = observations - parameters, :math:`\sigma_0^2 = v^T W v / r`,
- covariance :math:`C = \sigma_0^2 (J^T W J)^{-1}` (a-priori :math:`\sigma_0 = 1` where :math:`r = 0`),
- leave-one-out residual of point i, without a refit: :math:`(I - H_{ii})^{-1} v_i` with the 2 x 2 block
  :math:`H_{ii} = J_i (J^T W J)^{-1} J_i^T W_i` of the hat matrix (exact for models linear in their parameters).

A regularisation adds pseudo-observations of zero, and the soft constraints of a model are as fictitious: they have no
part in :math:`v^T W v`, and the effective number of parameters, the trace of the hat matrix of the true observations,
takes the place of their number. Else constraints that are never violated would make every sigma too small.

Source: Cook and Weisberg 1982 (leave-one-out); Hansen 1998 (regularisation, effective degrees of freedom).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ortho_pipeline.errors import DegeneratePoints, InputError, TooFewPoints, counted
from ortho_pipeline.estimation.least_squares import condition_of, minimise, solve_linear
from ortho_pipeline.geodesy.ellipsoid import units_per_metre
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points

#: A scaled normal matrix beyond this condition is taken as singular: the points do not determine the model.
CONDITION_LIMIT = 1e6


@dataclass(frozen=True)
class Prior:
    """A parameter known beforehand: one more observation with this mean and sigma, in the parameter's unit."""

    mean: float
    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and self.sigma > 0):
            raise InputError(
                f"a prior has a finite mean and a positive sigma, not {self.mean} and {self.sigma}", field="prior"
            )


def priors_at(model: SensorModel, sigmas: Mapping[str, float]) -> dict[str, Prior]:
    """Return priors that hold parameters at their values in `model`, with these sigmas by name."""
    values = dict(zip(model.param_names, model.params.tolist(), strict=True))
    return {name: Prior(values[name], sigma) for name, sigma in sigmas.items()}


@dataclass(frozen=True, eq=False)
class Solution:
    """What an adjustment found; `jacobian` ``(n, 2, P)`` and `residuals` ``(n, 2)`` are those of its control points.

    `freedom` is the number of observations minus that of (effective) parameters; `condition` is of the design without
    a regularisation.
    """

    model: SensorModel
    jacobian: Array
    residuals: Array
    sigma: Array  # (n, 2) px, a priori
    cofactors: Array  # (P, P)
    freedom: float
    effective: float
    sigma0: float | None
    condition: float

    @property
    def redundancy(self) -> int:
        """Whole observations to spare."""
        return math.floor(self.freedom + 1e-6)

    def spare(self) -> Array:
        """Return the blocks ``(n, 2, 2)`` of the identity minus the hat matrix."""
        scaled = self.jacobian / self.sigma[:, :, None]
        return np.eye(2) - scaled @ self.cofactors @ scaled.transpose(0, 2, 1)

    def leave_one_out(self) -> Array:
        """Residuals ``(n, 2)`` that each point would have had, had it taken no part; NaN where it is indispensable."""
        return self.leave_out([np.array([k]) for k in range(len(self.residuals))], self.spare())

    def leave_out(self, groups: list[np.ndarray], spare: Array | None = None) -> Array:
        """Residuals ``(n, 2)`` that the points of each group would have had, had the whole group taken no part."""
        left = np.full(self.residuals.shape, np.nan)
        standardised = self.residuals / self.sigma
        if spare is not None:
            good = np.linalg.det(spare) > 1e-9
            solved = np.linalg.solve(spare[good], standardised[good][:, :, None])[:, :, 0]
            left[good] = solved * self.sigma[good]
            return left
        count = self.cofactors.shape[0]
        for group in groups:
            scaled = (self.jacobian[group] / self.sigma[group][:, :, None]).reshape(-1, count)
            matrix = np.eye(len(scaled)) - scaled @ self.cofactors @ scaled.T
            if np.linalg.eigvalsh(matrix)[0] > 1e-9:
                solved = np.linalg.solve(matrix, standardised[group].ravel())
                left[group] = solved.reshape(-1, 2) * self.sigma[group]
        return left


@dataclass(frozen=True, eq=False)
class Problem:
    """Control points, a model with start values, and what is known beforehand."""

    model: SensorModel
    rows: np.ndarray  # indices of the control points in the table
    ground: Array
    image: Array
    sigma: Array  # (n, 2) px, a priori, errors of the ground included
    priors: Mapping[str, Prior]
    source: str
    ridge: Mapping[str, float] = field(default_factory=dict)  # sigma of the pseudo-observation of zero

    @classmethod
    def of(cls, model: SensorModel, points: Points, usable: np.ndarray, priors: Mapping[str, Prior]) -> Problem:
        """Return the problem of the points in the mask `usable`, which are in the CRS of the model."""
        unknown = sorted(set(priors) - set(model.param_names))
        if unknown:
            raise InputError(
                f"a prior names parameters that the model does not have: {', '.join(unknown)}",
                field="priors",
                remedy=f"its parameters are {', '.join(model.param_names) or 'none'}",
            )
        rows = np.flatnonzero(usable)
        ground = points.ground[rows]
        sigma = np.broadcast_to(points.sigma_image[rows][:, None], (len(rows), 2)).astype(float)
        if (points.sigma_ground[rows] > 0).any():
            spread = points.sigma_ground[rows] * units_per_metre(points.crs, ground)
            sigma = np.sqrt(sigma**2 + ((model.ground_partials(ground) * spread[:, None, :]) ** 2).sum(axis=2))
        return cls(model, rows, ground, points.image[rows], sigma, dict(priors), points.source)

    def with_ridge(self, ridge: Mapping[str, float]) -> Problem:
        """Return this problem with a pseudo-observation of zero for each of these parameters."""
        return replace(self, ridge=dict(ridge))

    def started(self, model: SensorModel) -> Problem:
        """Return this problem with other start values."""
        return replace(self, model=model)

    def solve(self, keep: np.ndarray, *, linear: bool = False) -> Solution:
        """Adjust to the points in the mask `keep` ``(n,)``.

        With `linear`, one step on the linearised problem: its residuals, and the model as it was.
        """
        ground, image, sigma = self.ground[keep], self.image[keep], self.sigma[keep]
        count = len(self.model.params)
        self._enough(len(ground))
        model = self._adjusted(ground, image, sigma) if count and not linear else self.model
        residuals = image - model.ground_to_image(ground)
        jacobian = model.param_partials(ground) if count else np.zeros((len(ground), 2, 0))
        believed, rows, true = self._pseudo(model)
        data = (jacobian / sigma[:, :, None]).reshape(2 * len(ground), count)
        design = np.vstack([data, rows])
        solved = solve_linear(design, np.concatenate([(residuals / sigma).ravel(), believed]), refine=False)
        condition = condition_of(design[: len(design) - len(self.ridge)]) if self.ridge else solved.condition
        self._determined(solved.condition)
        if linear:
            residuals = residuals - jacobian @ solved.values
            believed = believed - rows @ solved.values
        observed = np.concatenate([(residuals / sigma).ravel(), believed[true]])
        effective = float(count)
        if not true.all():
            known = np.vstack([data, rows[true]])
            effective = float(np.einsum("ij,ij->", known @ solved.cofactors, known))
        freedom = len(observed) - effective
        # Fictitious observations make the count a fraction; less than a whole one to spare tells nothing of weights.
        sigma0 = math.sqrt(float(observed @ observed) / freedom) if freedom > 1 - 1e-6 else None
        return Solution(model, jacobian, residuals, sigma, solved.cofactors, freedom, effective, sigma0, condition)

    def _enough(self, points: int) -> None:
        count, known = len(self.model.params), len(self.priors)
        known += len(self.model.constraints()) if known else 0
        least = self.model.minimum_points if not known else math.ceil((count - known) / 2)
        if points < least:
            raise TooFewPoints(
                f"{counted(points, 'control point does', 'control points do')} not determine "
                f"{counted(count, 'parameter')}",
                file=self.source,
                remedy=f"give at least {counted(least, 'control point')}, or a simpler model",
            )

    def _determined(self, condition: float) -> None:
        if condition > CONDITION_LIMIT:
            raise DegeneratePoints(
                f"the control points do not determine all parameters (condition {condition:.1e})",
                file=self.source,
                remedy="spread the points over the image (and over height, for 3D models), or take a simpler model",
            )

    def _pseudo(self, model: SensorModel) -> tuple[Array, Array, np.ndarray]:
        """Return misclosures and design rows of the model's constraints, of priors, then of the regularisation.

        The mask at the end tells which of them are true observations.
        """
        wanted = [(name, prior.mean, prior.sigma) for name, prior in self.priors.items()]
        wanted += [(name, 0.0, sigma) for name, sigma in self.ridge.items()]
        own = model.constraints()
        index = {name: k for k, name in enumerate(model.param_names)}
        rows = np.zeros((len(wanted), len(index)))
        params = model.params
        believed = np.zeros(len(wanted))
        for i, (name, mean, sigma) in enumerate(wanted):
            rows[i, index[name]] = 1.0 / sigma
            believed[i] = (mean - params[index[name]]) / sigma
        scaled = own.jacobian / own.sigma[:, None]
        true = np.concatenate([~own.fictitious, np.arange(len(wanted)) < len(self.priors)])
        return np.concatenate([own.residuals / own.sigma, believed]), np.vstack([scaled, rows]), true

    def _adjusted(self, ground: Array, image: Array, sigma: Array) -> SensorModel:
        start = self.model
        origin = start.params

        def misfit(params: Array) -> Array:
            model = start.with_params(params)
            return np.concatenate([((image - model.ground_to_image(ground)) / sigma).ravel(), self._pseudo(model)[0]])

        def slopes(params: Array) -> Array:
            model = start.with_params(params)
            image_part = model.param_partials(ground) / sigma[:, :, None]
            return np.vstack([image_part.reshape(-1, len(params)), self._pseudo(model)[1]])

        # Far from singular at the start, or the iteration would only wander: say so at once.
        self._determined(condition_of(slopes(origin)))
        return start.with_params(minimise(misfit, slopes, origin, singular=CONDITION_LIMIT))
