r"""The least-squares problem of one image: image measurements of control points, priors, and a regularisation.

With image residuals :math:`v = l - f(x)` (measured minus predicted), weights :math:`W = \Sigma^{-1}` with a 2 x 2
block for each point (`ImageErrors`: whitened by its Cholesky factor), and as further
observations each `Prior` and each of the model's own (`SensorModel.constraints`), the estimate minimises
:math:`v^T W v`. Then

- redundancy :math:`r` = observations - parameters, :math:`\sigma_0^2 = v^T W v / r`,
- covariance :math:`C = \sigma_0^2 (J^T W J)^{-1}` (a-priori :math:`\sigma_0 = 1` where :math:`r = 0`),
- leave-one-out residual of point i, without a refit: :math:`R_{ii}^{-1} v_i` with the 2 x 2 block
  :math:`R_{ii} = I - J_i (J^T W J)^{-1} J_i^T W_i` of the redundancy matrix (exact for models linear in their
  parameters). Points of one group (`Points.groups`) share errors, and are left out together: :math:`R_{ii}` is then
  that of the group.

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
from ortho_pipeline.points.image_errors import says_more

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
class ImageErrors:
    """A-priori errors of image measurements: standard deviations ``(n, 2)`` px of column and row, their correlation.

    The Cholesky factor L of a covariance is ((s0, 0), (r s1, sqrt(1 - r^2) s1)): with a correlation r of zero,
    whitening is a division by the standard deviations.
    """

    sigma: Array
    correlation: Array  # (n,)

    def __getitem__(self, rows: np.ndarray) -> ImageErrors:
        return ImageErrors(self.sigma[rows], self.correlation[rows])

    @classmethod
    def of(cls, model: SensorModel, points: Points, rows: np.ndarray) -> ImageErrors:
        """Return the errors of some points, which are in the CRS of the model, with those of their ground.

        A point whose measurement errs alike in all directions keeps independent axes: of what an error of its ground
        adds, the standard deviations count and not the correlation.
        """
        ground = points.ground[rows]
        sigma = np.broadcast_to(points.sigma_image[rows][:, None], (len(rows), 2)).astype(float)
        from_ground = np.zeros((len(rows), 2, 3))
        if (points.sigma_ground[rows] > 0).any():
            spread = points.sigma_ground[rows] * units_per_metre(points.crs, ground)
            from_ground = model.ground_partials(ground) * spread[:, None, :]
            sigma = np.sqrt(sigma**2 + (from_ground**2).sum(axis=2))
        correlation = np.zeros(len(rows))
        full = says_more(points.covariance_image[rows])
        if full.any():
            moved = from_ground[full]
            covariance = points.covariance_image[rows][full] + moved @ moved.transpose(0, 2, 1)
            sigma[full] = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
            correlation[full] = covariance[:, 0, 1] / sigma[full].prod(axis=1)
        return cls(sigma, correlation)

    @property
    def covariance(self) -> Array:
        """Covariances ``(n, 2, 2)`` px^2."""
        found = np.zeros((len(self.sigma), 2, 2))
        found[:, 0, 0], found[:, 1, 1] = (self.sigma**2).T
        found[:, 0, 1] = found[:, 1, 0] = self.correlation * self.sigma.prod(axis=1)
        return found

    def whitened(self, values: Array) -> Array:
        """Return values ``(n, 2)`` or ``(n, 2, P)`` of px as multiples of independent standard deviations."""
        flat = values.ndim == 2
        white = values / (self.sigma if flat else self.sigma[:, :, None])
        some = np.flatnonzero(self.correlation)
        if len(some):
            along = self.correlation[some] if flat else self.correlation[some][:, None]
            white[some, 1] = (white[some, 1] - along * white[some, 0]) / np.sqrt(1 - along**2)
        return white

    def restored(self, white: Array) -> Array:
        """Return whitened values ``(n, 2)`` in px."""
        values = white * self.sigma
        some = np.flatnonzero(self.correlation)
        along = self.correlation[some]
        values[some, 1] = self.sigma[some, 1] * (along * white[some, 0] + np.sqrt(1 - along**2) * white[some, 1])
        return values

    def mean_square(self, white: Array) -> Array:
        """Return the mean square distance ``(n,)`` px^2 of errors whose whitened covariance is ``(n, 2, 2)``."""
        across = self.sigma[:, 1] * np.sqrt(1 - self.correlation**2)
        along = self.sigma[:, 1] * self.correlation
        first = self.sigma[:, 0] ** 2 + along**2
        both = 2 * along * across * white[:, 0, 1]
        return np.asarray(white[:, 0, 0] * first + both + white[:, 1, 1] * across**2)


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of an adjustment; `jacobian` ``(n, 2, P)`` and `residuals` ``(n, 2)`` px are those of its control points.

    `freedom` is the number of observations minus that of (effective) parameters; `condition` is of the design without
    a regularisation. `groups` ``(n,)`` are those of `Points`.
    """

    model: SensorModel
    jacobian: Array
    residuals: Array
    errors: ImageErrors
    cofactors: Array  # (P, P)
    freedom: float
    effective: float
    sigma0: float | None
    condition: float
    groups: np.ndarray

    @property
    def redundancy(self) -> int:
        """Whole number of observations beyond the parameters."""
        return math.floor(self.freedom + 1e-6)

    def redundancy_blocks(self) -> Array:
        """Return the blocks ``(n, 2, 2)`` of the redundancy matrix of whitened observations, one of each point.

        Half of the trace of a block is the point's redundancy number.
        """
        white = self.errors.whitened(self.jacobian)
        return np.eye(2) - white @ self.cofactors @ white.transpose(0, 2, 1)

    def leave_one_out(self) -> Array:
        """Return residuals ``(n, 2)`` px that each point would have had, had it, and its group, taken no part.

        NaN is a point, or a group, that is indispensable.
        """
        left = self.leave_each_out()
        shared = [np.flatnonzero(self.groups == group) for group in np.unique(self.groups[self.groups >= 0])]
        if shared:
            left[self.groups >= 0] = self.leave_out(shared)[self.groups >= 0]
        return left

    def leave_each_out(self) -> Array:
        """Return residuals ``(n, 2)`` px that each point would have had alone without itself, whatever its group."""
        left = np.full(self.residuals.shape, np.nan)
        redundancy, white = self.redundancy_blocks(), self.errors.whitened(self.residuals)
        good = np.linalg.det(redundancy) > 1e-9
        solved = np.linalg.solve(redundancy[good], white[good][:, :, None])[:, :, 0]
        left[good] = self.errors[good].restored(solved)
        return left

    def leave_out(self, groups: list[np.ndarray]) -> Array:
        """Return residuals ``(n, 2)`` px that the points of each group would have had, had the group taken no part."""
        left = np.full(self.residuals.shape, np.nan)
        count = self.cofactors.shape[0]
        jacobian, residuals = self.errors.whitened(self.jacobian), self.errors.whitened(self.residuals)
        for group in groups:
            rows = jacobian[group].reshape(2 * len(group), count)
            matrix = np.eye(len(rows)) - rows @ self.cofactors @ rows.T
            if np.linalg.eigvalsh(matrix)[0] > 1e-9:
                solved = np.linalg.solve(matrix, residuals[group].ravel())
                left[group] = self.errors[group].restored(solved.reshape(-1, 2))
        return left


@dataclass(frozen=True, eq=False)
class Problem:
    """Control points, a model with start values, and what is known beforehand."""

    model: SensorModel
    rows: np.ndarray  # indices of the control points in the table
    ground: Array
    image: Array
    errors: ImageErrors  # those of the ground included
    priors: Mapping[str, Prior]
    source: str
    groups: np.ndarray  # (n,) of points that share errors, -1 of others
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
        errors = ImageErrors.of(model, points, rows)
        ground, image, groups = points.ground[rows], points.image[rows], points.groups[rows]
        return cls(model, rows, ground, image, errors, dict(priors), points.source, groups)

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
        ground, image, errors = self.ground[keep], self.image[keep], self.errors[keep]
        count = len(self.model.params)
        self._enough(len(ground))
        model = self._adjusted(ground, image, errors) if count and not linear else self.model
        residuals = image - model.ground_to_image(ground)
        jacobian = model.param_partials(ground) if count else np.zeros((len(ground), 2, 0))
        believed, rows, true = self._pseudo(model)
        data = errors.whitened(jacobian).reshape(2 * len(ground), count)
        design = np.vstack([data, rows])
        solved = solve_linear(design, np.concatenate([errors.whitened(residuals).ravel(), believed]), refine=False)
        condition = condition_of(design[: len(design) - len(self.ridge)]) if self.ridge else solved.condition
        self._determined(solved.condition)
        if linear:
            residuals = residuals - jacobian @ solved.values
            believed = believed - rows @ solved.values
        observed = np.concatenate([errors.whitened(residuals).ravel(), believed[true]])
        effective = float(count)
        if not true.all():
            known = np.vstack([data, rows[true]])
            effective = float(np.einsum("ij,ij->", known @ solved.cofactors, known))
        freedom = len(observed) - effective
        # Fictitious observations make the count a fraction; less than a whole one tells nothing of weights.
        sigma0 = math.sqrt(float(observed @ observed) / freedom) if freedom > 1 - 1e-6 else None
        return Solution(
            model, jacobian, residuals, errors, solved.cofactors, freedom, effective, sigma0, condition,
            self.groups[keep],
        )  # fmt: skip

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

    def _adjusted(self, ground: Array, image: Array, errors: ImageErrors) -> SensorModel:
        start = self.model
        origin = start.params

        def misfit(params: Array) -> Array:
            model = start.with_params(params)
            return np.concatenate(
                [errors.whitened(image - model.ground_to_image(ground)).ravel(), self._pseudo(model)[0]]
            )

        def slopes(params: Array) -> Array:
            model = start.with_params(params)
            image_part = errors.whitened(model.param_partials(ground))
            return np.vstack([image_part.reshape(-1, len(params)), self._pseudo(model)[1]])

        # Far from singular at the start, or the iteration would only wander: say so at once.
        self._determined(condition_of(slopes(origin)))
        return start.with_params(minimise(misfit, slopes, origin, singular=CONDITION_LIMIT))
