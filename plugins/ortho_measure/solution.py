"""The solution that is shown: the adjustment of `ortho fit` to the points as they are now, and figures about it."""

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

#: With fewer check points the headline is the error of control points that are left out in turn, where there is one.
LEAST_CHECK_POINTS = 3
#: Chance that a good point is shown as suspicious.
SUSPICIOUS = 0.001


@dataclass(frozen=True, eq=False)
class LiveAdjustment:
    """An adjustment, or why there is none.

    Parameters
    ----------
    model : SensorModel
        The adjusted model; as it was delivered where nothing was adjusted.
    adjusted : Adjusted, optional
    error : str
        What keeps it from being made, as people read it.
    """

    model: SensorModel
    adjusted: Adjusted | None
    error: str = ""

    @property
    def fit(self) -> Fit | None:
        """The fit, None where there is none."""
        return None if self.adjusted is None else self.adjusted.fit


def solve(scene: Scene, points: Points, request: Request, surface: Surface, correction: str | None) -> LiveAdjustment:
    """Adjust the model of a scene to points as `ortho fit` does."""
    if not len(points):
        return LiveAdjustment(scene.model, None)
    chosen = request.points.correction if correction is None else correction
    alone = replace(request, points=replace(request.points, correction=chosen), match=MatchOptions())
    try:
        done = adjust(Resolved(alone, scene, surface, points, None, Ledger()))
    except OrthoError as error:
        return LiveAdjustment(scene.model, None, error.message)
    except np.linalg.LinAlgError as error:
        # What is in the journal has to open again, whatever it is.
        return LiveAdjustment(scene.model, None, f"the points cannot be adjusted ({error})")
    return LiveAdjustment(done.model, done)


def figures(solution: LiveAdjustment, surface: Surface) -> dict[str, Any]:
    """Return what the page shows of a solution, as JSON values."""
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
    for one in fit.outlying:
        points[one.id] |= {"suspicious": True, "reason": one.reason}
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
        "notices": [str(one) for one in solution.adjusted.warnings(surface)],
    }


def normalised_residuals(fit: Fit) -> Array:
    """Return the test value w ``(N,)`` of each point: how far it is from the fit, in its own standard deviations.

    Of a control point ``w^2 = v^T C^-1 u / sigma0^2`` with its residual v, its leave-one-out residual u and the
    covariance C of its measurement: the test for an error in this point alone (Baarda), chi-squared with two degrees of
    freedom. Of any other point ``w^2 = v^T (sigma0^2 C + P)^-1 v`` with the covariance P of the prediction.
    """
    points = fit.points
    scale = 1.0 if fit.sigma0 is None else fit.sigma0**2
    errors = ImageErrors.of(fit.model, points).covariance * scale
    partials = fit.model.param_partials(points.ground) if len(fit.param_names) else np.zeros((len(points), 2, 0))
    predicted = partials @ fit.covariance @ partials.transpose(0, 2, 1)
    other = np.where(fit.used[:, None], fit.loo_residuals, fit.residuals)
    total = errors + np.where(fit.used[:, None, None], 0.0, predicted)
    good = np.isfinite(other).all(axis=1) & np.isfinite(fit.residuals).all(axis=1) & np.isfinite(total).all(axis=(1, 2))
    found = np.full(len(points), np.nan)
    white = np.linalg.solve(total[good], other[good][:, :, None])[:, :, 0]
    found[good] = np.sqrt(np.maximum((fit.residuals[good] * white).sum(axis=1), 0.0))
    if fit.sigma0 is None:
        found[fit.used] = np.nan
    return found


def _headline(fit: Fit | None) -> dict[str, Any]:
    """Return the best evidence of accuracy that there is, and what it is: never the residuals of the fit itself."""
    if fit is None:
        return {"px": None, "m": None, "what": "not tested: no points yet"}
    relative = bool((fit.points.groups[fit.used] >= 0).any())
    to = ", relative to the reference" if relative else ""
    check, loo = fit.rmse("check"), fit.rmse("loo") if fit.redundancy else None
    checks = 0 if check is None else check.n
    which, found = ("loo", loo) if loo is not None and checks < LEAST_CHECK_POINTS else ("check", check)
    if found is None:
        return {"px": None, "m": None, "what": "not tested: nothing is left over to test the fit with"}
    if which == "check":
        what = f"{counted(checks, 'check point')} that took no part{to}"
        few = f"; fewer than {ENOUGH_CHECK_POINTS} check points, no claim" if checks < ENOUGH_CHECK_POINTS else ""
    else:
        what = f"{counted(found.n, 'control point')}, each left out in turn{to}"
        few = "; no check points were kept apart"
        if check is not None:
            few = f"; {counted(checks, 'check point')} ({check.total:.2f} px): too few to judge by"
    ground = getattr(rmse_metres(fit), which)
    return {"px": found.total, "m": ground and json_value(ground.total), "n": found.n, "what": f"RMSE at {what}{few}"}
