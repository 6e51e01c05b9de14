"""The bundle adjustment on the page: that of `ortho adjust` to the present points, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_measure.block.left_out import LeftOutResiduals
from ortho_measure.solution import LEAST_CHECK_POINTS, SUSPICIOUS
from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.start import Start
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.report.wording import ENOUGH_CHECK_POINTS


@dataclass(frozen=True, eq=False)
class BlockSolution:
    """An adjustment, or the reason why there is none.

    Parameters
    ----------
    models : mapping of label to SensorModel
        Adjusted models; the delivered ones without an adjustment.
    fit : BlockFit, optional
    error : str
        Why there is no adjustment, for people.
    left_out : LeftOutResiduals, optional
        Leave-one-out residuals of all measurements.
    """

    models: Mapping[str, SensorModel]
    fit: BlockFit | None = None
    error: str = ""
    left_out: LeftOutResiduals | None = None


def solve(
    starts: Mapping[str, Start],
    points: BlockPoints,
    hold: float | None,
    *,
    heights: DemHeights | None = None,
    robust: bool = True,
) -> BlockSolution:
    """Adjust images and points, like `ortho adjust`; without `robust`, gross errors stay in."""
    models = {label: start.model for label, start in starts.items()}
    if not len(points):
        return BlockSolution(models)
    without = [label for k, label in enumerate(points.images) if not (points.image == k).any()]
    if without:
        return BlockSolution(models, None, f"no points yet in {without[0]}")
    try:
        priors = {label: start.priors for label, start in starts.items()}
        stated = {label: start.accuracy for label, start in starts.items() if start.accuracy is not None}
        fit = adjust(models, points, priors=priors, robust=robust, hold=hold, heights=heights, accuracies=stated)
        left_out = LeftOutResiduals.of(fit, starts, hold)
    except OrthoError as error:
        return BlockSolution(models, None, error.message)
    except np.linalg.LinAlgError as error:
        # The journal must open again, whatever points it has.
        return BlockSolution(models, None, f"the points cannot be adjusted ({error})")
    return BlockSolution(fit.models, fit, "", left_out)


def figures(solution: BlockSolution, relative: bool) -> dict[str, Any]:
    """Return the figures of a solution for the page, as JSON values; `relative` means relative to a reference."""
    fit, without = solution.fit, solution.left_out
    if fit is None or without is None:
        return {"error": solution.error, "points": {}, "headline": _headline(solution, relative), "notices": []}
    table, sigmas = fit.points, fit.ground_sigmas
    points: dict[str, dict[str, Any]] = {
        name: {
            "residuals": {},
            "loo": {},
            "residual_m": json_position(fit.object_residuals[k]),
            "loo_m": json_value(without.ground[k]),
            "sigma_m": json_position(sigmas[k]),
            "w": json_value(without.w[k]),
            "suspicious": bool(without.chance[k] < SUSPICIOUS),
        }
        for k, name in enumerate(table.ids)
    }
    for ray, (of, image) in enumerate(zip(table.point, table.image, strict=True)):
        point, label = points[table.ids[of]], table.images[image]
        point["residuals"][label] = json_position(fit.residuals[ray])
        point["loo"][label] = json_position(without.rays[ray])
    for error in fit.rejected:
        where = f" in {error.image}" if error.image else ""
        points[error.point] |= {"suspicious": True, "reason": f"rejected{where}: {error.reason}"}
    for doubt in fit.outlying:
        text = f"its {doubt.what} differs from the block by {doubt.metres:.2f} m ({doubt.sigmas:.1f} sigmas)"
        points[doubt.point] |= {"suspicious": True, "reason": text}
    return {
        "error": "",
        "points": points,
        "headline": _headline(solution, relative),
        "sigma0": json_value(fit.sigma0),
        "redundancy": fit.redundancy,
        "gauge": fit.gauge,
        "parameters": json_value(
            {
                label: {
                    name: {"value": value, "sigma": sigma}
                    for (of, name), value, sigma in zip(fit.parameters, fit.values, fit.sigmas, strict=True)
                    if of == label
                }
                for label in table.images
            }
        ),
        "notices": [str(notice) for notice in fit.warnings],
    }


def _headline(solution: BlockSolution, relative: bool) -> dict[str, Any]:
    """Return the best available measure of accuracy and its description; never the residuals of the fit itself."""
    fit = solution.fit
    if fit is None or solution.left_out is None:
        return {"px": None, "m": None, "what": "no points yet"}
    to = ", relative to the reference" if relative else ""
    rmse = fit.object_rms()
    if rmse is None or rmse.n < LEAST_CHECK_POINTS:
        without = _left_out_in_turn(fit, solution.left_out, to, 0 if rmse is None else rmse.n)
        if rmse is None or without["m"] is not None:
            return without
    rays = [record for record in (fit.image_rms(image, "check") for image in fit.points.images) if record is not None]
    count = sum(record.n for record in rays)
    total = float(np.sqrt(sum(record.n * record.total**2 for record in rays) / count)) if count else None
    few = f". Indicative: fewer than {ENOUGH_CHECK_POINTS} check points" if rmse.n < ENOUGH_CHECK_POINTS else ""
    text = f"RMSE in plan; {rmse.h:.3f} m in height, at {counted(rmse.n, 'check point')}{to}{few}"
    document: dict[str, Any] = json_value({"px": total, "m": rmse.plan, "n": rmse.n, "what": text})
    return document


def _left_out_in_turn(fit: BlockFit, without: LeftOutResiduals, to: str, checks: int) -> dict[str, Any]:
    """Return the leave-one-out accuracy of the ground of control points that the others determine."""
    apart = without.ground[fit.used_ground]
    apart = apart[np.isfinite(apart).all(axis=1)]
    if not len(apart) or not fit.redundancy:
        return {"px": None, "m": None, "what": f"no check points; {fit.gauge}"}
    few = f"Only {counted(checks, 'check point')}" if checks else "No check points"
    east, north, up = np.sqrt((apart**2).mean(axis=0)).tolist()
    text = f"RMSE in plan; {up:.3f} m in height, at {counted(len(apart), 'control point')} (leave-one-out){to}. {few}"
    document: dict[str, Any] = json_value({"px": None, "m": math.hypot(east, north), "n": len(apart), "what": text})
    return document
