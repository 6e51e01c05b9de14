r"""The least-squares problem of one image: image measurements of control points, priors, and a regularisation.

Image residuals are :math:`v = l - f(x)` (measured minus predicted). Weights are :math:`W = \Sigma^{-1}`, with a 2 x 2
block :math:`\Sigma = C + G S G^T` for each point (`ImageErrors`): C of the measurement, and S of the ground, projected
by the partials G of the start. Each `Prior`, and each constraint of the model (`SensorModel.constraints`), is a further
observation. The estimate minimises :math:`v^T W v`. Then

- redundancy :math:`r` = image observations - parameters, :math:`\sigma_0^2 = v^T W v / r` of the image observations,
- covariance :math:`C = \sigma_0^2 (J^T W J)^{-1}` (a-priori :math:`\sigma_0 = 1` where :math:`r = 0`),
- leave-one-out residual of point i, without a refit: :math:`R_{ii}^{-1} v_i` with the 2 x 2 block
  :math:`R_{ii} = I - J_i (J^T W J)^{-1} J_i^T W_i` of the redundancy matrix (exact for models linear in their
  parameters). Points of one group (`Points.groups`) share errors and are left out together; then :math:`R_{ii}` is that
  of the group.

Pseudo-observations do not count in :math:`\sigma_0`. The effective number of parameters, the trace of the hat matrix of
the image observations, replaces the number of parameters. Otherwise constraints that are never violated would make
every sigma too small.

:math:`\sigma_0` is the factor by which stated image errors are wrong. Priors and measured constraints of a model have
other sources, so their sigmas stay as stated: their weights are multiplied by :math:`\sigma_0^2`, and the problem is
solved again until it settles. Weights of fictitious pseudo-observations (regularisation, soft constraints) are relative
to those of the points.

Source: Cook and Weisberg 1982 (leave-one-out); Hansen 1998 (regularisation, effective degrees of freedom); Rao 1973,
section 4j (a variance from the residuals of one group of observations).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ortho_pipeline.errors import DegeneratePoints, InputError, TooFewPoints
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.least_squares import condition_of, minimise, solve_linear
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.estimation.statistics import effective_parameters, left_out, unit_weight
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.models.correction import ImageCorrection
from ortho_pipeline.points import Points

#: Above this condition number the points do not determine the model.
CONDITION_LIMIT = 1e6
#: A point with less redundancy than this in some direction is indispensable.
INDISPENSABLE = 1e-9
#: Lower limit of sigma0 in tests and in weights (for noise-free simulations).
SCALE_FLOOR = 1e-3
#: sigma0 is settled if it changes by less than this part.
_SETTLED, _ROUNDS = 1e-3, 30
#: With a smaller redundancy, observations can fit by chance: stated sigmas hold, or priors would no longer count.
LEAST_REDUNDANCY = 4.0


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of the problem; `jacobian` ``(n, 2, P)`` and `residuals` ``(n, 2)`` px belong to the control points.

    `freedom` is the number of image observations minus that of (effective) parameters; `condition` is the condition
    number of the design without regularisation; `groups` ``(n,)`` are those of `Points`.
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
        """Number of image observations minus effective parameters, rounded down."""
        return math.floor(self.freedom + 1e-6)

    def redundancy_blocks(self) -> Array:
        """Return the blocks ``(n, 2, 2)`` of the redundancy matrix of whitened observations, one for each point.

        Half of the trace of a block is the point's redundancy number.
        """
        white = self.errors.whitened(self.jacobian)
        return np.eye(2) - white @ self.cofactors @ white.transpose(0, 2, 1)

    def leave_one_out(self, further: Array | None) -> Array:
        """Return leave-one-out residuals ``(n, 2)`` px; points of a group are left out together.

        NaN if the point or group is indispensable. `further` ``(n, 2, k)`` are what independent unknowns besides the
        parameters add to whitened observations, in their standard deviations.
        """
        white = self.errors.whitened(self.residuals)
        design = self.errors.whitened(self.jacobian)
        further = design[:, :, :0] if further is None else further
        redundancy = self.redundancy_blocks() - further @ further.transpose(0, 2, 1)
        left = self.errors.restored(left_out(redundancy, white, known=INDISPENSABLE).whole)
        for group in sorted({*self.groups.tolist()} - {-1}):
            of = self.groups == group
            rows, more = (part[of].reshape(2 * int(of.sum()), part.shape[2]) for part in (design, further))
            redundancy = np.eye(len(rows)) - rows @ self.cofactors @ rows.T - more @ more.T
            together = left_out(redundancy[None], white[of].reshape(1, -1), known=INDISPENSABLE).whole
            left[of] = self.errors[of].restored(together.reshape(-1, 2))
        return left

    def leave_each_out(self) -> Array:
        """Return leave-one-out residuals ``(n, 2)`` px with each point left out alone, whatever its group."""
        white = self.errors.whitened(self.residuals)
        return self.errors.restored(left_out(self.redundancy_blocks(), white, known=INDISPENSABLE).whole)


@dataclass(frozen=True, eq=False)
class Problem:
    """Control points, a model with start values, and prior knowledge."""

    model: SensorModel
    rows: np.ndarray  # indices of the control points in the table
    points: Points  # those rows of it
    errors: ImageErrors  # with errors of the ground, projected by `model`
    priors: Mapping[str, Prior]
    ridge: Mapping[str, float] = field(default_factory=dict)  # sigma of the pseudo-observation of zero

    @classmethod
    def of(cls, model: SensorModel, points: Points, usable: np.ndarray, priors: Mapping[str, Prior]) -> Problem:
        """Return the problem of the points in the mask `usable`; they must be in the CRS of the model."""
        unknown = sorted(set(priors) - set(model.param_names))
        if unknown:
            raise InputError(
                f"priors for parameters that the model does not have: {', '.join(unknown)}",
                field="priors",
                remedy=f"the model has these parameters: {', '.join(model.param_names) or 'none'}",
            )
        other = [name for name, prior in priors.items() if not isinstance(prior, Prior)]
        if other:
            raise InputError(
                f"the prior of {other[0]!r} is a {type(priors[other[0]]).__name__}",
                field="priors",
                remedy="give op.Prior(mean, sigma)",
            )
        rows = np.flatnonzero(usable)
        chosen = points.select(rows)
        return cls(model, rows, chosen, ImageErrors.of(model, chosen), dict(priors))

    @property
    def ground(self) -> Array:
        """Ground of the points ``(n, 3)`` in the CRS of the model."""
        return self.points.ground

    @property
    def image(self) -> Array:
        """Their measurements ``(n, 2)`` px."""
        return self.points.image

    @property
    def fewest(self) -> int:
        """Least number of points that it needs."""
        known = len(self.priors) + (len(self.model.constraints()) if self.priors else 0)
        return math.ceil((len(self.model.params) - known) / 2) if known else self.model.minimum_points

    def shifted(self, offset: Array) -> Problem:
        """Return this problem with images moved by ``(n, 2)`` px."""
        return replace(self, points=replace(self.points, image=self.points.image + offset))

    def with_ridge(self, ridge: Mapping[str, float]) -> Problem:
        """Return this problem with a pseudo-observation of zero for each of these parameters."""
        return replace(self, ridge=dict(ridge))

    def started(self, model: SensorModel) -> Problem:
        """Return this problem with other start values, which also project the errors of the ground."""
        return replace(self, model=model, errors=ImageErrors.of(model, self.points))

    def solve(self, keep: np.ndarray, *, linear: bool = False) -> Solution:
        """Adjust to the points in the mask `keep` ``(n,)``.

        With `linear`, only one step of the linearised problem; the model stays unchanged.
        """
        solution = stated = self._solved(keep, 1.0, linear=linear)
        if not self.priors and self.model.constraints().fictitious.all():
            return solution
        scale = 1.0
        for _ in range(_ROUNDS):
            if solution.sigma0 is None or solution.freedom < LEAST_REDUNDANCY:
                return replace(stated, sigma0=None)
            last, scale = scale, max(solution.sigma0, SCALE_FLOOR)
            if abs(scale - last) <= _SETTLED * last:
                break
            solution = replace(self, model=solution.model)._solved(keep, scale, linear=linear)
        return replace(solution, sigma0=scale)

    def _solved(self, keep: np.ndarray, scale: float, *, linear: bool) -> Solution:
        """Adjust with priors whose sigmas are those of points of a sigma0 of `scale`."""
        ground, image, errors = self.ground[keep], self.image[keep], self.errors[keep]
        count = len(self.model.params)
        self._enough(len(ground))
        model = self._adjusted(ground, image, errors, scale) if count and not linear else self.model
        residuals = image - model.ground_to_image(ground)
        jacobian = model.param_partials(ground) if count else np.zeros((len(ground), 2, 0))
        believed, rows = self._pseudo(model, scale)
        data = errors.whitened(jacobian).reshape(2 * len(ground), count)
        design = np.vstack([data, rows])
        solved = solve_linear(design, np.concatenate([errors.whitened(residuals).ravel(), believed]), refine=False)
        condition = condition_of(design[: len(design) - len(self.ridge)]) if self.ridge else solved.condition
        self._determined(solved.condition)
        if linear:
            residuals = residuals - jacobian @ solved.values
        observed = errors.whitened(residuals).ravel()
        effective = effective_parameters(count, [(rows, solved.cofactors)])
        freedom = len(observed) - effective
        # A redundancy below one observation gives no sigma0.
        sigma0 = unit_weight(float(observed @ observed), freedom, 1 - 1e-6)
        return Solution(
            model,
            jacobian,
            residuals,
            errors,
            solved.cofactors,
            freedom,
            effective,
            sigma0,
            condition,
            self.points.groups[keep],
        )

    def _enough(self, points: int) -> None:
        count, least = len(self.model.params), self.fewest
        if points < least:
            simpler: str = "a simpler model"
            if isinstance(self.model, ImageCorrection) and count > 2:
                simpler = Text("a simpler correction, such as ", Setting("points.correction", "shift"))
            raise TooFewPoints(
                f"{counted(points, 'control point is', 'control points are')} not enough for "
                f"{counted(count, 'parameter')}",
                file=self.points.source,
                remedy=Text(f"give at least {counted(least, 'control point')}, or use ", simpler),
            )

    def _determined(self, condition: float) -> None:
        if condition > CONDITION_LIMIT:
            raise DegeneratePoints(
                f"the control points do not determine all parameters (condition number {condition:.1e})",
                file=self.points.source,
                remedy="spread the points over the image (for 3D models also over height), or use a simpler model",
            )

    def _pseudo(self, model: SensorModel, scale: float) -> tuple[Array, Array]:
        """Return misclosures and design rows of the model's constraints, the priors and the regularisation."""
        wanted = [(name, prior.mean, prior.sigma / scale) for name, prior in self.priors.items()]
        wanted += [(name, 0.0, sigma) for name, sigma in self.ridge.items()]
        own = model.constraints()
        index = {name: k for k, name in enumerate(model.param_names)}
        rows = np.zeros((len(wanted), len(index)))
        params = model.params
        believed = np.zeros(len(wanted))
        for i, (name, mean, sigma) in enumerate(wanted):
            rows[i, index[name]] = 1.0 / sigma
            believed[i] = (mean - params[index[name]]) / sigma
        sigmas = np.where(own.fictitious, own.sigma, own.sigma / scale)
        return np.concatenate([own.residuals / sigmas, believed]), np.vstack([own.jacobian / sigmas[:, None], rows])

    def _adjusted(self, ground: Array, image: Array, errors: ImageErrors, scale: float) -> SensorModel:
        start = self.model
        origin = start.params
        missed = np.full(2 * len(ground) + len(self._pseudo(start, scale)[0]), np.nan)

        def misfit(params: Array) -> Array:
            try:
                model = start.with_params(params)
            except InputError:
                # No such model exists, such as a camera with a negative focal length: the step is too long.
                return missed
            return np.concatenate(
                [errors.whitened(image - model.ground_to_image(ground)).ravel(), self._pseudo(model, scale)[0]]
            )

        def slopes(params: Array) -> Array:
            model = start.with_params(params)
            image_part = errors.whitened(model.param_partials(ground))
            return np.vstack([image_part.reshape(-1, len(params)), self._pseudo(model, scale)[1]])

        # If the start is nearly singular, the iteration would only wander: raise the error at once.
        self._determined(condition_of(slopes(origin)))
        return start.with_params(minimise(misfit, slopes, origin, singular=CONDITION_LIMIT))
