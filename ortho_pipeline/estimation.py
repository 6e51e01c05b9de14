r"""Adjustment of a sensor model to ground control, and the statistics of the result.

With image residuals :math:`v = l - f(x)` (measured minus predicted), weights :math:`W = \Sigma^{-1}` and any `Prior` as
one more observation of its parameter, the estimate minimises :math:`v^T W v`. Then

- redundancy :math:`r` = observations - parameters, :math:`\sigma_0^2 = v^T W v / r`,
- covariance :math:`C = \sigma_0^2 (J^T W J)^{-1}` (a-priori :math:`\sigma_0 = 1` where :math:`r = 0`),
- leave-one-out residual of point i, without a refit: :math:`(I - H_{ii})^{-1} v_i` with the 2 x 2 block
  :math:`H_{ii} = J_i (J^T W J)^{-1} J_i^T W_i` of the hat matrix (exact for models linear in their parameters).

Gross errors are looked for with a start that half of the points cannot spoil (least median of squares over minimal
subsets), and decided by an F test of each suspected point against the fit of the others.

Source: Baarda 1968 (data snooping); Rousseeuw 1984 (LMedS); Cook and Weisberg 1982 (leave-one-out).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ortho_pipeline.errors import DegeneratePoints, InputError, NotConverged, TooFewPoints
from ortho_pipeline.geometry import units_per_metre
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points

#: A scaled normal matrix beyond this condition is taken as singular: the points do not determine the model.
CONDITION_LIMIT = 1e6
#: The same if some corner of the model's domain would be predicted so many times worse than a point is measured.
EXTRAPOLATION_LIMIT = 100.0
#: Chance that a good set of points loses any of its points to the search for gross errors.
BLUNDER_RISK = 0.001
#: More than this share of rejected control points is an error, not a clean-up.
REJECTED_LIMIT = 0.3
#: Residuals are never tested at a finer scale than this part of their stated sigma (noise-free simulations).
_SCALE_FLOOR = 1e-3
_SUBSETS = 500


@dataclass(frozen=True)
class Prior:
    """A parameter known beforehand: one more observation with this mean and sigma, in the parameter's unit."""

    mean: float
    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and self.sigma > 0):
            raise InputError("a prior has a finite mean and a positive sigma", field="prior")


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of an adjustment.

    Residuals are measured minus predicted, ``(N, 2)`` column and row in pixels, for all points whatever their role;
    `raw_residuals` are those of the model before the adjustment. `loo_residuals` are NaN for points that did not take
    part. `sigma0` is None without redundancy.
    """

    model: SensorModel
    model_name: str
    covariance: Array
    points: Points
    used: np.ndarray
    predicted: Array
    residuals: Array
    loo_residuals: Array
    raw_residuals: Array
    redundancy: int
    sigma0: float | None
    rejected: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    condition: float = field(default=1.0)

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of the adjusted parameters."""
        return self.model.param_names

    @property
    def values(self) -> Array:
        """Adjusted parameters ``(P,)``."""
        return self.model.params

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the parameters ``(P,)``."""
        return np.sqrt(np.diag(self.covariance))

    def rmse(self, which: str) -> dict[str, float | int] | None:
        """Return root mean squares in pixels for 'control' (used), 'check' or 'loo'; None where there is no point."""
        if which == "loo":
            residuals = self.loo_residuals[np.isfinite(self.loo_residuals).all(axis=1)]
        elif which == "control":
            residuals = self.residuals[self.used]
        else:
            residuals = self.residuals[self.points.check]
        return root_mean_square(residuals)

    @property
    def raw_bias(self) -> dict[str, float | int] | None:
        """Mean and scatter (px) of measured minus predicted of the model as delivered, over the used points."""
        raw = self.raw_residuals[self.used]
        if not len(raw):
            return None
        mean, spread = raw.mean(axis=0), raw.std(axis=0)
        return {"col": mean[0], "row": mean[1], "std_col": spread[0], "std_row": spread[1], "n": len(raw)}

    def image_sigma(self, ground: Array) -> Array:
        """Return the standard deviation ``(N, 2)`` of predicted image points that comes from the parameters."""
        partials = self.model.param_partials(ground)
        return np.sqrt(np.einsum("nip,pq,niq->ni", partials, self.covariance, partials))

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``ortho fit --json`` (docs/formats.md)."""
        points = self.points
        return {
            "model": self.model_name,
            "parameters": {
                name: {"value": float(value), "sigma": float(sigma)}
                for name, value, sigma in zip(self.param_names, self.values, self.sigmas, strict=True)
            },
            "points": [
                {
                    "id": points.ids[i],
                    "role": str(points.roles[i]),
                    "used": bool(self.used[i]),
                    "image": _numbers(points.image[i]),
                    "predicted": _numbers(self.predicted[i]),
                    "residual": _numbers(self.residuals[i]),
                    "loo_residual": _numbers(self.loo_residuals[i]),
                }
                for i in range(len(points))
            ],
            "rmse": {which: self.rmse(which) for which in ("control", "check", "loo")},
            "raw_bias": self.raw_bias,
            "redundancy": self.redundancy,
            "sigma0": self.sigma0,
            "rejected": [{"id": name, "reason": reason} for name, reason in self.rejected],
            "warnings": list(self.warnings),
        }


def root_mean_square(residuals: Array) -> dict[str, float | int] | None:
    """Return the root mean square per axis and in total of residuals ``(N, 2)``; None for no residuals."""
    if not len(residuals):
        return None
    col, row = (residuals**2).mean(axis=0)
    return {"col": math.sqrt(col), "row": math.sqrt(row), "total": math.sqrt(col + row), "n": len(residuals)}


def fit(
    model: SensorModel,
    points: Points,
    *,
    priors: Mapping[str, Prior] | None = None,
    robust: bool = True,
    name: str | None = None,
) -> Fit:
    """Adjust the parameters of `model` to the control points; check points take no part.

    Parameters
    ----------
    model : SensorModel
        Start values; a model without parameters is only evaluated.
    points : Points
        In any CRS that can be brought to the model's.
    priors : mapping of parameter name to Prior, optional
        Soft constraints.
    robust : bool
        Look for gross errors and leave them out.

    Raises
    ------
    TooFewPoints, DegeneratePoints
        If the control points do not determine the parameters, or too many of them contradict the others.
    """
    points = points.to_crs(model.crs)
    raw = points.image - model.ground_to_image(points.ground)
    usable = points.control & np.isfinite(raw).all(axis=1)
    warnings = _unusable(points, usable)
    problem = _Problem.of(model, points, usable, dict(priors or {}))
    rejected: dict[int, str] = {}
    keep = np.ones(len(problem.rows), dtype=bool)
    if robust and len(model.params):
        keep, reasons = _find_blunders(problem)
        rejected = {int(problem.rows[i]): reason for i, reason in reasons.items()}
        _refuse_many(points, rejected, len(keep))
    solution = problem.solve(keep)
    _refuse_extrapolation(solution, points.source)
    used = np.zeros(len(points), dtype=bool)
    used[problem.rows[keep]] = True
    predicted = solution.model.ground_to_image(points.ground)
    loo = np.full((len(points), 2), np.nan)
    loo[used] = solution.leave_one_out()
    sigma0 = solution.sigma0
    return Fit(
        model=solution.model,
        model_name=name or model.kind,
        covariance=solution.cofactors * (1.0 if sigma0 is None else sigma0**2),
        points=points,
        used=used,
        predicted=predicted,
        residuals=points.image - predicted,
        loo_residuals=loo,
        raw_residuals=raw,
        redundancy=solution.redundancy,
        sigma0=sigma0,
        rejected=tuple((points.ids[i], reason) for i, reason in sorted(rejected.items())),
        warnings=tuple(warnings),
        condition=solution.condition,
    )


def _unusable(points: Points, usable: np.ndarray) -> list[str]:
    lost = [points.ids[i] for i in np.flatnonzero(points.control & ~usable)]
    if not lost:
        return []
    return [f"control points without a projection (no height, or outside the model's domain): {', '.join(lost)}"]


def _refuse_many(points: Points, rejected: dict[int, str], count: int) -> None:
    if len(rejected) > REJECTED_LIMIT * count:
        names = ", ".join(points.ids[i] for i in sorted(rejected))
        raise DegeneratePoints(
            f"{len(rejected)} of {count} control points contradict the others ({names}): "
            "which of them are wrong cannot be decided",
            file=points.source,
            remedy="measure these points again, or remove the wrong ones",
        )


def _refuse_extrapolation(solution: _Solution, source: str) -> None:
    if not len(solution.model.params) or not len(solution.sigma):
        return
    centre, half = solution.model.domain
    corners = centre + half * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    partials = solution.model.param_partials(corners)
    spread = np.sqrt(np.einsum("nip,pq,niq->ni", partials, solution.cofactors, partials))
    factor = float(np.nanmax(spread, initial=0.0) / np.median(solution.sigma))
    if factor > EXTRAPOLATION_LIMIT:
        raise DegeneratePoints(
            f"the control points do not determine the whole scene: at a corner the model is {factor:.0f} times less "
            "certain than a measured point",
            file=source,
            remedy="spread the points over the image (and over height, for 3D models), or take a simpler model",
        )


@dataclass(frozen=True, eq=False)
class _Solution:
    model: SensorModel
    jacobian: Array  # (n, 2, P), of the control points
    residuals: Array  # (n, 2) px
    sigma: Array  # (n, 2) px, a priori
    cofactors: Array  # (P, P)
    redundancy: int
    sigma0: float | None
    condition: float

    def leave_one_out(self) -> Array:
        """Residuals ``(n, 2)`` that each point would have had, had it taken no part; NaN where it is indispensable."""
        scaled = self.jacobian / self.sigma[:, :, None]
        spare = np.eye(2) - np.einsum("nip,pq,njq->nij", scaled, self.cofactors, scaled)
        left = np.linalg.det(spare) > 1e-9
        loo = np.full(self.residuals.shape, np.nan)
        standardised = self.residuals / self.sigma
        loo[left] = np.linalg.solve(spare[left], standardised[left][:, :, None])[:, :, 0] * self.sigma[left]
        return loo


@dataclass(frozen=True, eq=False)
class _Problem:
    model: SensorModel
    rows: np.ndarray  # indices of the control points in the table
    ground: Array
    image: Array
    sigma: Array  # (n, 2) px, a priori, errors of the ground included
    priors: Mapping[str, Prior]
    source: str

    @classmethod
    def of(cls, model: SensorModel, points: Points, usable: np.ndarray, priors: dict[str, Prior]) -> _Problem:
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
        return cls(model, rows, ground, points.image[rows], sigma, priors, points.source)

    def solve(self, keep: np.ndarray) -> _Solution:
        """Adjust to the points in the mask `keep` ``(n,)``."""
        ground, image, sigma = self.ground[keep], self.image[keep], self.sigma[keep]
        count = len(self.model.params)
        self._enough(len(ground))
        model = _minimise(self.model, ground, image, sigma, self.priors) if count else self.model
        residuals = image - model.ground_to_image(ground)
        jacobian = model.param_partials(ground) if count else np.zeros((len(ground), 2, 0))
        design = np.vstack([(jacobian / sigma[:, :, None]).reshape(2 * len(ground), count), self._prior_rows()])
        cofactors, condition = _cofactors(design, self.source)
        observed = (residuals / sigma).ravel()
        believed = np.array([(p.mean - model.params[self._index(k)]) / p.sigma for k, p in self.priors.items()])
        redundancy = design.shape[0] - count
        sum_of_squares = float(observed @ observed + believed @ believed)
        sigma0 = math.sqrt(sum_of_squares / redundancy) if redundancy > 0 else None
        return _Solution(model, jacobian, residuals, sigma, cofactors, redundancy, sigma0, condition)

    def _enough(self, points: int) -> None:
        count = len(self.model.params)
        if 2 * points + len(self.priors) < count:
            raise TooFewPoints(
                f"{points} control points do not determine {count} parameters",
                file=self.source,
                remedy=f"give at least {math.ceil((count - len(self.priors)) / 2)} control points, or a simpler model",
            )

    def _index(self, name: str) -> int:
        return self.model.param_names.index(name)

    def _prior_rows(self) -> Array:
        rows = np.zeros((len(self.priors), len(self.model.params)))
        for i, (name, prior) in enumerate(self.priors.items()):
            rows[i, self._index(name)] = 1.0 / prior.sigma
        return rows


def _minimise(
    model: SensorModel, ground: Array, image: Array, sigma: Array, priors: Mapping[str, Prior]
) -> SensorModel:
    from scipy.optimize import least_squares

    index = [model.param_names.index(name) for name in priors]
    mean = np.array([prior.mean for prior in priors.values()])
    spread = np.array([prior.sigma for prior in priors.values()])
    rows = np.zeros((len(priors), len(model.params)))
    rows[np.arange(len(priors)), index] = 1.0

    def misfit(params: Array) -> Array:
        image_part = ((model.with_params(params).ground_to_image(ground) - image) / sigma).ravel()
        return np.concatenate([image_part, (params[index] - mean) / spread])

    def slope(params: Array) -> Array:
        image_part = model.with_params(params).param_partials(ground) / sigma[:, :, None]
        return np.vstack([image_part.reshape(-1, len(params)), rows / spread[:, None]])

    try:
        result = least_squares(misfit, model.params, slope, method="lm", x_scale="jac", ftol=1e-15, xtol=1e-15)
    except ValueError as error:
        raise NotConverged(f"the adjustment left the domain of the model ({error})") from error
    if not np.isfinite(result.x).all() or result.status == 0:
        raise NotConverged("the adjustment did not converge", remedy="give better start values or fewer parameters")
    return model.with_params(result.x)


def _cofactors(design: Array, source: str) -> tuple[Array, float]:
    """Return the inverse normal matrix and the condition of the column-scaled design matrix."""
    if not design.shape[1]:
        return np.zeros((0, 0)), 1.0
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1.0
    _, singular, vt = np.linalg.svd(design / scale, full_matrices=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else math.inf
    if condition > CONDITION_LIMIT or len(singular) < design.shape[1]:
        raise DegeneratePoints(
            f"the control points do not determine all parameters (condition {condition:.1e})",
            file=source,
            remedy="spread the points over the image (and over height, for 3D models), or take a simpler model",
        )
    root = (vt.T / singular) / scale[:, None]
    return root @ root.T, condition


def _find_blunders(problem: _Problem) -> tuple[np.ndarray, dict[int, str]]:
    """Return the mask of points to keep ``(n,)`` and the reason for each that is not."""
    count = len(problem.rows)
    keep = np.ones(count, dtype=bool)
    solution = problem.solve(keep)
    if solution.redundancy < 2 * 2:  # a single spare point can contradict, but not say who is wrong
        return keep, {}
    keep = _robust_start(solution, len(problem.priors))
    reasons: dict[int, str] = {}
    # Suspicion first falls on too many: re-admit the excluded that agree with the others, until none is left that does.
    while not keep.all():
        chances, sizes = _chance(problem, keep)
        agree = ~keep & (chances >= BLUNDER_RISK / count)
        if not agree.any():
            reasons = {int(i): _reason(sizes[i]) for i in np.flatnonzero(~keep)}
            break
        keep = keep | agree
    return keep, reasons


def _reason(size: float) -> str:
    return f"gross error: {size:.1f} px from where the other points put it"


def _robust_start(solution: _Solution, priors: int) -> np.ndarray:
    """Return a clean subset ``(n,)`` by least median of squares on the linearised problem."""
    jacobian, residuals = solution.jacobian / solution.sigma[:, :, None], solution.residuals / solution.sigma
    count, params = len(jacobian), jacobian.shape[2]
    size = max(1, math.ceil((params - priors) / 2))
    subsets = _minimal_subsets(count, size)
    # Linear in a step from the common solution; a minimal subset with 2 * size > params is solved by least squares.
    steps = np.stack([np.linalg.lstsq(jacobian[s].reshape(-1, params), residuals[s].ravel())[0] for s in subsets])
    left = residuals[None] - np.einsum("nip,sp->sni", jacobian, steps)
    squares = (left**2).sum(axis=2)
    half = (count + size + 1) // 2
    merit = np.sort(squares, axis=1)[:, half - 1]
    best = int(np.argmin(merit))
    keep = np.zeros(count, dtype=bool)
    keep[np.argsort(squares[best], kind="stable")[: max(half, size + 1)]] = True
    return keep


def _minimal_subsets(count: int, size: int) -> list[list[int]]:
    if math.comb(count, size) <= _SUBSETS:
        return [list(subset) for subset in itertools.combinations(range(count), size)]
    generator = np.random.default_rng(0)  # the same points give the same answer every time
    return [sorted(generator.choice(count, size, replace=False).tolist()) for _ in range(_SUBSETS)]


def _chance(problem: _Problem, keep: np.ndarray) -> tuple[Array, Array]:
    """Return for each point the chance of lying so far from the fit of the kept ones, and that distance in pixels."""
    from scipy.stats import f as fisher

    try:
        solution = problem.solve(keep)
    except DegeneratePoints:
        return np.ones(len(keep)), np.zeros(len(keep))
    miss = problem.image - solution.model.ground_to_image(problem.ground)
    jacobian = solution.model.param_partials(problem.ground) / problem.sigma[:, :, None]
    spread = np.eye(2) + np.einsum("nip,pq,njq->nij", jacobian, solution.cofactors, jacobian)
    standardised = miss / problem.sigma
    distance = np.einsum("ni,ni->n", standardised, np.linalg.solve(spread, standardised[:, :, None])[:, :, 0])
    freedom = max(solution.redundancy, 1)
    scale = max(solution.sigma0 or 0.0, _SCALE_FLOOR)
    return fisher.sf(distance / 2 / scale**2, 2, freedom), np.hypot(miss[:, 0], miss[:, 1])


def _numbers(values: Array) -> list[float | None]:
    return [float(value) if math.isfinite(value) else None for value in values]
