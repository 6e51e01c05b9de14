"""Adjust a sensor model to control points: `fit`, and its result `Fit`.

`problem` has the mathematics, `blunders` searches for gross errors, `regularisation` stabilises rational functions,
and `statistics` tests parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import InputError, ModelError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.blunders import OutlyingPoint, checks_apart, find_blunders, outlying, refuse_many
from ortho_pipeline.estimation.determinacy import (
    EXTRAPOLATION_WARNING,
    UNSTABLE,
    corner_ratio_of,
    nothing_adjusted,
    uncertain_edge,
    unstable,
)
from ortho_pipeline.estimation.observations.arguments import excluded_rows, refuse_other_model, refuse_other_points
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.estimation.problem import Problem, Solution
from ortho_pipeline.estimation.records import (
    Adjustment,
    Bias,
    GroupedStatistics,
    LeftOut,
    Parameter,
    Point,
    Rmse,
    Rmses,
    Statistics,
)
from ortho_pipeline.estimation.records import CommonError as CommonErrorRecord
from ortho_pipeline.estimation.regularisation import regularised
from ortho_pipeline.estimation.spatial.common_error import ImageCommonError
from ortho_pipeline.estimation.spatial.shared_errors import SharedErrors, shared_errors
from ortho_pipeline.estimation.statistics import correlation_of, student_of, total_correlation_of
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.runtime.process_limits import one_blas_thread

__all__ = ["Fit", "Prior", "fit"]

#: Chance that a parameter passes as significant although it is zero.
SIGNIFICANCE = 0.05


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Result of an adjustment of one image.

    Residuals are measured minus predicted: ``(N, 2)`` column and row in pixels, for points of all roles.

    - `raw_residuals`: of the model as delivered; NaN if the model comes from the points alone.
    - `loo_residuals`: leave-one-out; NaN for points that did not take part.
    - `sigma0`: of the image points; None without redundancy, or with priors and a redundancy below 4.
    - `points`: with the model's reference height where a 2D model needs no heights and the points have none.
    - `rejected`: control points that were left out as gross errors, each with the reason.
    - `outlying`: points that contradict the fit but still count.
    - `ridge`: weight of the regularisation; then the points determine only `effective_parameters`. `condition` is the
      condition number of the design without it.
    - `corner_ratio`: uncertainty at the worst corner of the scene, relative to a measured point.
    - `shared_errors`: errors that neighbouring points share, if points have groups; `covariance` includes them.
    - `common_error`: an error common to all matched points; `covariance` includes it, `residuals` are without it.
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
    warnings: tuple[Notice, ...] = ()
    condition: float = field(default=1.0)
    degrees_of_freedom: float = 0.0
    effective_parameters: float = 0.0
    ridge: float | None = None
    priors: Mapping[str, Prior] = field(default_factory=dict)
    significance: float = SIGNIFICANCE
    corner_ratio: float = 0.0
    outlying: tuple[OutlyingPoint, ...] = ()
    shared_errors: SharedErrors | None = None
    common_error: ImageCommonError | None = None

    @property
    def reservations(self) -> tuple[str, ...]:
        """Reasons not to trust the model, whatever its residuals: ``unstable``, ``uncertain at a corner``."""
        reasons = []
        if len(self.param_names) > 1 and self.condition > UNSTABLE:
            reasons.append("unstable")
        if not self.corner_ratio <= EXTRAPOLATION_WARNING:
            reasons.append("uncertain at a corner")
        return tuple(reasons)

    @property
    def effective_points(self) -> float:
        """Number of independent points that would determine a shift as well as the used ones."""
        return float(self.used.sum()) if self.shared_errors is None else self.shared_errors.effective_points

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

    @property
    def relative_covariance(self) -> Array:
        """The covariance ``(P, P)`` without the error that is common to the points."""
        return self.covariance if self.common_error is None else self.covariance - self.common_error.covariance

    @property
    def correlation(self) -> Array:
        """Correlation matrix of the parameters ``(P, P)``."""
        return correlation_of(self.covariance)

    @property
    def total_correlation(self) -> Array:
        """Multiple correlation of each parameter with all others ``(P,)``."""
        return total_correlation_of(self.covariance)

    @property
    def student(self) -> tuple[Array, Array]:
        """Student's t and two-sided p of the hypotheses that parameters are zero, each ``(P,)``.

        Without the error that is common to the points: it does not make a parameter less significant.
        """
        return student_of(
            self.values, self.relative_covariance, self.degrees_of_freedom if self.sigma0 is not None else 0.0
        )

    @property
    def not_justified(self) -> tuple[str, ...]:
        """Parameters that `prune` would remove first: removable, p above `significance`; none without redundancy."""
        chances = dict(zip(self.param_names, self.student[1], strict=True))
        removable = () if self.sigma0 is None else self.model.removable
        return tuple(name for name in removable if not chances[name] <= self.significance)

    def rmse(self, which: str) -> Rmse | None:
        """Return root mean squares in pixels; None if there is no such point.

        Parameters
        ----------
        which : {'control', 'check', 'loo', 'matched', 'agreeing'}
            Used control points, check points, or control points left out one at a time. 'matched': check points that
            are matches, if others were measured. 'agreeing': check points without outliers, which is not the accuracy.
        """
        if which not in (known := ("control", "check", "loo", "matched", "agreeing")):
            raise InputError(f"there is no RMSE of {which!r}", field="which", remedy=f"use one of {', '.join(known)}")
        if which == "loo":
            residuals = self.loo_residuals[np.isfinite(self.loo_residuals).all(axis=1)]
        elif which == "control":
            residuals = self.residuals[self.used]
        else:
            checks = self.points.check & ~self.points.tests if which == "matched" else self.points.tests
            if which == "agreeing":
                checks = checks & ~np.isin(np.array(self.points.ids), [point.id for point in self.outlying])
            residuals = self.residuals[checks]
            # A point that does not project has no residual; a warning names it.
            residuals = residuals[np.isfinite(residuals).all(axis=1)]
        return Rmse.of(residuals)

    @property
    def rmses(self) -> Rmses:
        """Root mean squares of control, check and leave-one-out; 'matched' only if there are such points."""
        both = ("matched",) if (self.points.check & ~self.points.tests).any() else ()
        return Rmses(**{which: self.rmse(which) for which in ("control", "check", "loo", *both)})

    @property
    def raw_bias(self) -> Bias | None:
        """Mean and scatter (px) of the residuals of the model as delivered, over the used points."""
        raw = self.raw_residuals[self.used]
        if not np.isfinite(raw).any():
            return None
        mean, spread = raw.mean(axis=0), raw.std(axis=0)
        return Bias(col=mean[0], row=mean[1], std_col=spread[0], std_row=spread[1], n=len(raw))

    def image_sigma(self, ground: Array) -> Array:
        """Return the standard deviation ``(N, 2)`` px of predicted image points, from the parameters alone."""
        partials = self.model.param_partials(ground)
        return np.asarray(np.sqrt(((partials @ self.covariance) * partials).sum(axis=2)))

    def _statistics(self) -> Statistics:
        """Return the tests of the parameters; values that are not finite become None."""
        t, p = self.student
        named = {"total_correlation": self.total_correlation, "t": t, "p": p}
        statistics: dict[str, Any] = {
            "correlation": json_value(self.correlation),
            **{key: dict(zip(self.param_names, json_value(values), strict=True)) for key, values in named.items()},
            "significance": self.significance,
            "not_justified": self.not_justified,
            "degrees_of_freedom": json_value(self.degrees_of_freedom),
            "effective_parameters": json_value(self.effective_parameters),
            "ridge": self.ridge,
            "condition": json_value(self.condition),
            "corner_ratio": json_value(self.corner_ratio),
        }
        if (common := self.common_error) is not None:
            statistics["common_error"] = CommonErrorRecord.of(common, common.gain)
        return (
            Statistics(**statistics)
            if self.shared_errors is None
            else GroupedStatistics(**statistics, shared_errors=self.shared_errors)
        )

    def __repr__(self) -> str:
        total = {role: rmse.total for role in ("control", "check", "loo") if (rmse := self.rmse(role))}
        text = ", ".join(f"{role} {value:.3f} px" for role, value in total.items()) or "unknown"
        return f"<fit of {self.model_name} to {counted(int(self.used.sum()), 'control point')}: RMSE {text}>"

    @property
    def record(self) -> Adjustment:
        """The fit as the record that is published (docs/engineering/formats.md)."""
        points = self.points
        names = ("image", "predicted", "residual", "loo_residual")
        pairs = (points.image, self.predicted, self.residuals, self.loo_residuals)
        rows = zip(points.ids, points.roles.tolist(), self.used.tolist(), *map(json_value, pairs), strict=True)
        return Adjustment(
            model=self.model_name,
            parameters={
                name: Parameter(value=value, sigma=json_value(sigma))
                for name, value, sigma in zip(self.param_names, self.values, self.sigmas, strict=True)
            },
            points=tuple(
                Point.model_validate({"id": name, "role": role, "used": used, **dict(zip(names, row, strict=True))})
                for name, role, used, *row in rows
            ),
            rmse=self.rmses,
            raw_bias=self.raw_bias,
            redundancy=self.redundancy,
            sigma0=self.sigma0,
            rejected=tuple(LeftOut(id=name, reason=reason) for name, reason in self.rejected),
            outlying=self.outlying,
            rmse_of_agreeing_checks=self.rmse("agreeing"),
            **to_document(self.warnings),
            statistics=self._statistics(),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``ortho fit --json`` (docs/engineering/formats.md)."""
        return self.record.given()


@one_blas_thread()
def fit(
    model: SensorModel,
    points: Points,
    *,
    priors: Mapping[str, Prior] | None = None,
    robust: bool = True,
    name: str | None = None,
    ridge: float | str | None = None,
    exclude: Mapping[str, str] | None = None,
) -> Fit:
    """Adjust the parameters of `model` to the control points; check points do not take part.

    Parameters
    ----------
    model : SensorModel
        Start values. A model without parameters is only evaluated.
    points : Points
        In any CRS that can be transformed to that of the model.
    priors : mapping of parameter name to Prior, optional
    robust : bool
        Find gross errors and leave them out.
    ridge : float or 'gcv' or 'lcurve', optional
        Regularisation of a rational model: its weight, or the method that finds it.
    exclude : mapping of id to reason, optional
        Control points to leave out.

    Returns
    -------
    Fit
        The adjusted model with its covariance, residuals of all points, tests and warnings.

    Raises
    ------
    TooFewPoints, DegeneratePoints
        If the points do not determine the parameters, or too many contradict the others.
    InputError
        If the model projects no point.

    Examples
    --------
    >>> model, points = op.read_rpc("sample_data/scene_RPC.TXT"), op.read_points("sample_data/gcps.geojson")
    >>> op.fit(op.ImageCorrection.identity(model, "shift", (500, 500)), points).values.round(2).tolist()
    [6.31, -4.14]
    """
    refuse_other_model(model)
    refuse_other_points(points)
    points = _placed(points, model)
    raw = points.image - model.ground_to_image(points.ground)
    known_bad = excluded_rows(points, exclude or {})
    common = _common_error(model, points, raw, priors, robust=robust)
    problem, warnings = _posed(model, _without(common, model, points), raw, priors, known_bad)
    keep, rejected, problem, strength = _searched(problem, points, ridge, robust=robust)
    solution = problem.solve(keep)
    if rejected:
        # The start included gross errors, so errors of the ground were projected with a wrong model.
        solution = problem.started(solution.model).solve(keep)
    if common is not None:
        measured = replace(problem, points=points.select(problem.rows))
        solution, common = common.settled(measured, keep, solution)
    ratio = corner_ratio_of(solution, points.source, strength)
    warnings += nothing_adjusted(model, points) + uncertain_edge(ratio) + unstable(solution, strength)
    used = np.zeros(len(points), dtype=bool)
    used[problem.rows[keep]] = True
    seen = _without(common, model, points)
    outliers = outlying(solution, seen, used, None if common is None else common.covariance)
    warnings += checks_apart(solution, seen, used, outliers, shared=common is not None)
    result = _result(
        solution, seen, used, raw, {**known_bad, **rejected}, warnings, name, strength, problem.priors, common
    )
    return replace(result, points=points, corner_ratio=ratio, outlying=outliers)


def gross_errors(
    model: SensorModel,
    points: Points,
    *,
    priors: Mapping[str, Prior] | None,
    ridge: float | str | None,
) -> dict[str, str]:
    """Return the control points that `fit` would leave out, with the reason of each.

    Raises
    ------
    TooFewPoints, DegeneratePoints, InputError
        As `fit`, except for points that are too few after the search.
    """
    points = _placed(points, model)
    problem, _ = _posed(model, points, points.image - model.ground_to_image(points.ground), priors, {})
    _, rejected, _, _ = _searched(problem, points, ridge, robust=True)
    return {points.ids[i]: reason for i, reason in sorted(rejected.items())}


def _common_error(
    model: SensorModel, points: Points, raw: Array, priors: Mapping[str, Prior] | None, *, robust: bool
) -> ImageCommonError | None:
    """Return the common error of control points, started from points without it; None if they have none."""
    usable = points.control & np.isfinite(raw).all(axis=1)
    common = ImageCommonError.of(model, points, usable)
    others = usable & (points.sigma_common == 0)
    if common is None or not others.any():
        return common
    # Otherwise the few points without it would look like gross errors among the many points with it.
    try:
        first = fit(model, points.select(usable & ~others), priors=priors, robust=robust)
    except (InputError, ModelError):
        return common
    return common.seen_by(first.model, points.select(others))


def _without(common: ImageCommonError | None, model: SensorModel, points: Points) -> Points:
    """Return points with their common error removed."""
    if common is None or not common.value.any():
        return points
    return replace(points, image=points.image - common.offset(model, points))


def _posed(
    model: SensorModel,
    points: Points,
    raw: Array,
    priors: Mapping[str, Prior] | None,
    without: Mapping[int, str],
) -> tuple[Problem, list[Notice]]:
    """Return the problem of the usable control points, and warnings about the others."""
    projected = np.asarray(np.isfinite(raw).all(axis=1))
    if len(points) and not projected.any():
        raise InputError(
            f"the model {model.kind!r} projects none of the points ({len(points)}): they have no height, or are "
            "outside its domain",
            file=points.source or None,
            remedy="check CRS and heights of the points, and that points and model belong to this scene",
        )
    usable = points.control & projected
    wrong = np.zeros(len(points), dtype=bool)
    wrong[list(without)] = True
    warnings = _unusable(points, usable | wrong, projected)
    usable &= ~wrong
    return Problem.of(model, points, usable, dict(priors or {})), warnings


def _searched(
    problem: Problem, points: Points, ridge: float | str | None, *, robust: bool
) -> tuple[np.ndarray, dict[int, str], Problem, float | None]:
    """Return the points to keep ``(n,)``, the rejected rows with reasons, the regularised problem and its weight."""
    keep = np.ones(len(problem.rows), dtype=bool)
    strength = None
    if ridge is not None:
        problem, strength = regularised(problem, keep, ridge, linear=robust)
    rejected: dict[int, str] = {}
    if robust and len(problem.model.params):
        keep, reasons = find_blunders(problem, ridge)
        rejected = {int(problem.rows[i]): reason for i, reason in reasons.items()}
        names = [points.ids[i] for i in sorted(rejected)]
        refuse_many(
            names, len(keep), "control point", points.source, "measure these points again, or remove the wrong ones"
        )
        if ridge is not None:
            problem, strength = regularised(problem, keep, ridge)
    return keep, rejected, problem, strength


def _placed(points: Points, model: SensorModel) -> Points:
    """Return the points in the CRS of the model, at its reference height if it ignores heights and they have none."""
    points = points.to_crs(model.crs)
    missing = ~np.isfinite(points.ground[:, 2])
    if model.uses_height or not missing.any():
        return points
    ground = points.ground.copy()
    ground[missing, 2] = model.reference_height
    return points.with_ground(ground)


def _result(
    solution: Solution,
    points: Points,
    used: np.ndarray,
    raw: Array,
    rejected: Mapping[int, str],
    warnings: list[Notice],
    name: str | None,
    strength: float | None,
    priors: Mapping[str, Prior],
    common: ImageCommonError | None,
) -> Fit:
    predicted = solution.model.ground_to_image(points.ground)
    loo = np.full((len(points), 2), np.nan)
    loo[used] = solution.leave_one_out(None if common is None else common.beyond_parameters(solution))
    sigma0 = solution.sigma0
    shared = shared_errors(solution, points.image[used], common, points.sigma_alike[used])
    usual = common.cofactors(solution) if common is not None else solution.cofactors
    covariance = usual * (1.0 if sigma0 is None else sigma0**2) if shared is None else shared[1]
    return Fit(
        model=solution.model,
        model_name=str(name or getattr(solution.model, "family", solution.model.kind)),
        covariance=covariance if common is None else covariance + common.covariance,
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
        degrees_of_freedom=solution.freedom,
        effective_parameters=solution.effective,
        ridge=strength,
        priors=priors,
        shared_errors=None if shared is None else shared[0],
        common_error=common,
    )


def _unusable(points: Points, usable: np.ndarray, projected: np.ndarray) -> list[Notice]:
    notices = []
    for role, mask in (("control", points.control & ~usable), ("check", points.check & ~projected)):
        if mask.any():
            names = [points.ids[i] for i in np.flatnonzero(mask)]
            notices.append(
                Notice(
                    "no-projection",
                    f"the model cannot project these {role} points (no height, or outside its domain): "
                    f"{', '.join(names)}",
                    role=role,
                    points=names,
                )
            )
    return notices
