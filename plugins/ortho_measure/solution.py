"""The solution on the page: the adjustment of `ortho fit` to the present points, and its figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.commands.scene_fit import Adjusted, adjust
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import in_metres, rmse_metres
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.options import MatchOptions
from ortho_pipeline.points import Points
from ortho_pipeline.report.wording import ENOUGH_CHECK_POINTS
from ortho_pipeline.surface.base import Surface

#: With fewer check points, the headline is the leave-one-out error of control points, if there is one.
LEAST_CHECK_POINTS = 3
#: Chance that a good point is marked as suspicious.
SUSPICIOUS = 0.001


@dataclass(frozen=True, eq=False)
class LiveAdjustment:
    """An adjustment, or the reason why there is none.

    Parameters
    ----------
    model : SensorModel
        The adjusted model; the delivered one without an adjustment.
    adjusted : Adjusted, optional
    error : str
        Why there is no adjustment, for people.
    """

    model: SensorModel
    adjusted: Adjusted | None
    error: str = ""

    @property
    def fit(self) -> Fit | None:
        """The fit; None without one."""
        return None if self.adjusted is None else self.adjusted.fit


def solve(scene: Scene, points: Points, request: Request, surface: Surface, correction: str | None) -> LiveAdjustment:
    """Adjust the model of a scene to points, like `ortho fit`."""
    if not len(points):
        return LiveAdjustment(scene.model, None)
    chosen = request.points.correction if correction is None else correction
    alone = replace(request, points=replace(request.points, correction=chosen), match=MatchOptions())
    try:
        done = adjust(Resolved(alone, scene, surface, points, None, Ledger()))
    except OrthoError as error:
        return LiveAdjustment(scene.model, None, error.message)
    except np.linalg.LinAlgError as error:
        # The journal must open again, whatever points it has.
        return LiveAdjustment(scene.model, None, f"the points cannot be adjusted ({error})")
    return LiveAdjustment(done.model, done)


def figures(solution: LiveAdjustment, surface: Surface) -> dict[str, Any]:
    """Return the figures of a solution for the page, as JSON values."""
    fit = solution.fit
    if fit is None or solution.adjusted is None:
        return {"error": solution.error, "points": {}, "headline": _headline(None), "notices": []}
    residuals_m, tests = in_metres(fit, fit.residuals), normalised_residuals(fit)
    points = {
        name: {
            "residual": json_position(fit.residuals[k]),
            "residual_m": json_position(residuals_m[k]),
            "loo": json_position(fit.loo_residuals[k]),
            "predicted": json_position(fit.predicted[k]),
            "used": bool(fit.used[k]),
            "w": json_value(tests[k]),
            "suspicious": bool(tests[k] ** 2 > -2 * math.log(SUSPICIOUS)),
        }
        for k, name in enumerate(fit.points.ids)
    }
    for name, reason in fit.rejected:
        points[name] |= {"suspicious": True, "reason": reason}
    for point in fit.outlying:
        points[point.id] |= {"suspicious": True, "reason": point.reason}
    return {
        "error": "",
        "model": fit.model_name,
        "points": points,
        "headline": _headline(fit),
        "parameters": json_value(
            {
                name: {"value": value, "sigma": sigma}
                for name, value, sigma in zip(fit.param_names, fit.values, fit.sigmas, strict=True)
            }
        ),
        "rmse": fit.rmses.given(),
        "rmse_m": rmse_metres(fit).given(),
        "sigma0": fit.sigma0,
        "redundancy": fit.redundancy,
        "notices": [str(notice) for notice in solution.adjusted.warnings(surface)],
    }


def normalised_residuals(fit: Fit) -> Array:
    """Return the test value w ``(N,)`` of each point: its distance from the fit, in its own standard deviations.

    For a control point ``w^2 = v^T C^-1 u / sigma0^2``, with its residual v, its leave-one-out residual u and the
    covariance C of its measurement: the test for an error in this point alone (Baarda), chi-squared with two degrees of
    freedom. For other points ``w^2 = v^T (sigma0^2 C + P)^-1 v``, with the covariance P of the prediction.
    """
    points = fit.points
    scale = 1.0 if fit.sigma0 is None else fit.sigma0**2
    errors = ImageErrors.of(fit.model, points).covariance * scale
    partials = fit.model.param_partials(points.ground) if len(fit.param_names) else np.zeros((len(points), 2, 0))
    predicted = partials @ fit.covariance @ partials.transpose(0, 2, 1)
    other = np.where(fit.used[:, None], fit.loo_residuals, fit.residuals)
    total = errors + np.where(fit.used[:, None, None], 0.0, predicted)
    good = np.isfinite(other).all(axis=1) & np.isfinite(fit.residuals).all(axis=1) & np.isfinite(total).all(axis=(1, 2))
    tests = np.full(len(points), np.nan)
    white = np.linalg.solve(total[good], other[good][:, :, None])[:, :, 0]
    tests[good] = np.sqrt(np.maximum((fit.residuals[good] * white).sum(axis=1), 0.0))
    if fit.sigma0 is None:
        tests[fit.used] = np.nan
    return tests


def _headline(fit: Fit | None) -> dict[str, Any]:
    """Return the best available measure of accuracy and its description; never the residuals of the fit itself."""
    if fit is None:
        return {"px": None, "m": None, "what": "no points yet"}
    relative = bool((fit.points.groups[fit.used] >= 0).any())
    to = ", relative to the reference" if relative else ""
    check, loo = fit.rmse("check"), fit.rmse("loo") if fit.redundancy else None
    checks = 0 if check is None else check.n
    which, found = ("loo", loo) if loo is not None and checks < LEAST_CHECK_POINTS else ("check", check)
    if found is None:
        return {"px": None, "m": None, "what": "no redundancy: add points to test the fit"}
    if which == "check":
        what = f"{counted(checks, 'check point')}{to}"
        few = f". Indicative: fewer than {ENOUGH_CHECK_POINTS} check points" if checks < ENOUGH_CHECK_POINTS else ""
    else:
        what = f"{counted(found.n, 'control point')} (leave-one-out){to}"
        few = ". No check points"
        if check is not None:
            few = f". Only {counted(checks, 'check point')} ({check.total:.2f} px)"
    ground = getattr(rmse_metres(fit), which)
    return {"px": found.total, "m": ground and json_value(ground.total), "n": found.n, "what": f"RMSE at {what}{few}"}
