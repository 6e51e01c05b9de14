"""The bundle adjustment that is shown: that of `ortho adjust` to the points as they are now, and figures about it."""

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
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.options.texts import counted
from ortho_pipeline.report.block import KEPT_OUT
from ortho_pipeline.report.wording import ENOUGH_CHECK_POINTS


@dataclass(frozen=True, eq=False)
class BlockSolution:
    """An adjustment, or why there is none.

    Parameters
    ----------
    models : mapping of label to SensorModel
        Adjusted; as they were delivered where nothing was adjusted.
    fit : BlockFit, optional
    error : str
        What keeps it from being made, as people read it.
    left_out : LeftOutResiduals, optional
        What each measurement is off by had it taken no part.
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
    """Adjust images and points as `ortho adjust` does; where not `robust`, gross errors are left in."""
    models = {label: start.model for label, start in starts.items()}
    if not len(points):
        return BlockSolution(models)
    without = [label for k, label in enumerate(points.images) if not (points.image == k).any()]
    if without:
        return BlockSolution(models, None, f"no point was measured in {without[0]} yet")
    try:
        priors = {label: start.priors for label, start in starts.items()}
        stated = {label: start.accuracy for label, start in starts.items() if start.accuracy is not None}
        fit = adjust(models, points, priors=priors, robust=robust, hold=hold, heights=heights, accuracies=stated)
        left_out = LeftOutResiduals.of(fit, starts, hold)
    except OrthoError as error:
        return BlockSolution(models, None, error.message)
    except np.linalg.LinAlgError as error:
        # What is in the journal has to open again, whatever it is.
        return BlockSolution(models, None, f"the points cannot be adjusted ({error})")
    return BlockSolution(fit.models, fit, "", left_out)


def figures(solution: BlockSolution, relative: bool) -> dict[str, Any]:
    """Return what the page shows of a solution, as JSON values; `relative` is one to a reference."""
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
    for one in fit.rejected:
        where = f" in {one.image}" if one.image else ""
        points[one.point] |= {"suspicious": True, "reason": f"left out{where}: {one.reason}"}
    for doubt in fit.outlying:
        text = f"the block contradicts its {doubt.what} by {doubt.metres:.2f} m ({doubt.sigmas:.1f} sigmas)"
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
        "notices": [str(one) for one in fit.warnings],
    }


def _headline(solution: BlockSolution, relative: bool) -> dict[str, Any]:
    """Return the best evidence of accuracy that there is, and what it is: never the residuals of the fit itself."""
    fit = solution.fit
    if fit is None or solution.left_out is None:
        return {"px": None, "m": None, "what": "not tested: no points yet"}
    to = ", relative to the reference" if relative else ""
    found = fit.object_rms()
    if found is None or found.n < LEAST_CHECK_POINTS:
        without = _left_out_in_turn(fit, solution.left_out, to, 0 if found is None else found.n)
        if found is None or without["m"] is not None:
            return without
    rays = [one for one in (fit.image_rms(image, "check") for image in fit.points.images) if one is not None]
    count = sum(one.n for one in rays)
    total = float(np.sqrt(sum(one.n * one.total**2 for one in rays) / count)) if count else None
    few = f"; fewer than {ENOUGH_CHECK_POINTS} check points, no claim" if found.n < ENOUGH_CHECK_POINTS else ""
    text = f"RMSE in plan, {found.h:.3f} m in height, at {counted(found.n, 'check point')}, {KEPT_OUT}{to}{few}"
    told: dict[str, Any] = json_value({"px": total, "m": found.plan, "n": found.n, "what": text})
    return told


def _left_out_in_turn(fit: BlockFit, without: LeftOutResiduals, to: str, checks: int) -> dict[str, Any]:
    """Return the accuracy at control points whose ground was left out in turn, where others tell of all of it."""
    apart = without.ground[fit.used_ground]
    apart = apart[np.isfinite(apart).all(axis=1)]
    if not len(apart) or not fit.redundancy:
        return {"px": None, "m": None, "what": f"not tested: no check points; {fit.gauge}"}
    few = f"{counted(checks, 'check point')}: too few to judge by" if checks else "no check points were kept apart"
    east, north, up = np.sqrt((apart**2).mean(axis=0)).tolist()
    text = (
        f"RMSE in plan, {up:.3f} m in height, at {counted(len(apart), 'control point')}, the ground of each left out "
        f"in turn{to}; {few}"
    )
    told: dict[str, Any] = json_value({"px": None, "m": math.hypot(east, north), "n": len(apart), "what": text})
    return told
