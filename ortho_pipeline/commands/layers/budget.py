"""The error budget of an ortho, from scene, points, surface and options, and its accuracy layer."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ortho_pipeline.commands.placement import Placement
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.estimation.ground_residuals import metre_partials
from ortho_pipeline.files import write_text
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.models.base import Array
from ortho_pipeline.report.document import accuracy_style
from ortho_pipeline.report.layers.accuracy import AccuracyLayer
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface

if TYPE_CHECKING:
    from ortho_pipeline.raster.regridded import Regridded
    from ortho_pipeline.warp.job import WarpRecord
    from ortho_pipeline.warp.quality.accuracy import AccuracyResult, Budget
    from ortho_pipeline.warp.quality.hiding import Hiding

#: Standard deviation (m) of geoids by the name of the height datum: commission errors over land; of any other, national
#: ones and grids of one's own. Source: Lemoine et al. 1998 (EGM96), Pavlis et al. 2012 (EGM2008).
_GEOIDS = {"EPSG:5773": 0.5, "EPSG:3855": 0.2}
_OTHER_GEOID = 0.1


@dataclasses.dataclass(frozen=True)
class Known:
    """The error budget, with its unknown parts and its assumptions in words.

    `common` is the variance on the ground (m², both axes) that the covariance of the parameters has of the reference.
    """

    budget: Budget
    unknown: tuple[str, ...]
    assumptions: tuple[str, ...]
    adjusted: bool
    common: float


def budget_of(placed: Placement) -> tuple[Known | None, list[Notice]]:
    """Return the error budget of an ortho (None if not requested) and notices.

    Raises
    ------
    InputError
        If nothing is known of them.
    """
    output = placed.request.output
    if not output.accuracy_raster:
        return None, []
    from ortho_pipeline.warp.quality.accuracy import Budget

    surface, fit = placed.surface, placed.adjusted.fit
    covariance = _covariance(placed)
    stated = None if covariance is not None else placed.model.stated_accuracy or placed.scene.accuracy
    datum = 0.0 if surface.sigma is None else _datum(surface)
    apart, unstated = _reference(fit.warnings, placed.scene.adjusted)
    budget = Budget(covariance=covariance, stated=stated, heights=surface.sigma, datum=datum, reference=apart)
    unknown = [
        name
        for name, missing in (
            ("model", not budget.knows_model),
            ("heights", surface.sigma is None),
            ("reference", unstated),
        )
        if missing
    ]
    if not budget.knows_model and surface.sigma is None:
        raise InputError(
            "no accuracy raster possible: neither the model nor the heights have a stated accuracy",
            field="output.accuracy_raster",
            remedy=Text(
                "give ",
                Setting("surface.sigma"),
                ", or control points with ",
                Setting("points.gcps"),
                ", or leave it out",
            ),
        )
    assumed = _assumptions(budget, surface)
    if output.fill_from is not None:
        assumed.append(f"the layer does not describe pixels from {Path(output.fill_from).name}")
    known = Known(budget, tuple(unknown), tuple(assumed), covariance is not None, _common(placed))
    if not unknown:
        return known, []
    names = {
        "model": "the model",
        "heights": Text("the heights (", Setting("surface.sigma"), ")"),
        "reference": Text("the reference (", Setting("match.reference_sigma"), ")"),
    }
    sources = Text.joined(" and of ", (names[name] for name in unknown))
    text = Text(
        "the accuracy raster does not include the errors of ", sources, ", which are unknown; real errors are larger"
    )
    return known, [Notice("accuracy-in-part", text, unknown=unknown)]


def _covariance(placed: Placement) -> Array | None:
    """Return the covariance of the model's parameters, now or before; None where nothing was adjusted.

    Residuals do not estimate the common error of points, so few of them do not enlarge it.
    """
    from ortho_pipeline.warp.quality.accuracy import predictive

    fit, before = placed.adjusted.fit, placed.scene.adjusted
    if len(fit.param_names) and fit.used.any():
        freedom, common = fit.degrees_of_freedom, fit.covariance - fit.relative_covariance
        return predictive(fit.relative_covariance, math.inf if fit.sigma0 is None else freedom) + common
    if before is None or not placed.model.param_names:
        return None
    found = _of_record(before, placed.model.param_names)
    if found is None:
        return None
    covariance, common = found
    freedom = math.inf if before.get("sigma0") is None else _number(before["statistics"], "degrees_of_freedom")
    return predictive(covariance - common, freedom) + common


def _of_record(adjusted: Mapping[str, Any], names: tuple[str, ...]) -> tuple[Array, Array] | None:
    """Return the covariance of parameters in a model file, and its part from a common error; None if incomplete."""
    try:
        parameters = adjusted["parameters"]
        sigmas = np.array([float(parameters[name]["sigma"]) for name in names])
        correlation = np.array(adjusted["statistics"]["correlation"], dtype=float)
        per_sigma = (adjusted["statistics"].get("common_error") or {}).get("per_sigma")
        gain = np.array(per_sigma or np.zeros((len(names), 2)), dtype=float)
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
    if list(parameters) != list(names) or correlation.shape != (len(names),) * 2 or gain.shape != (len(names), 2):
        return None
    # A parameter that a prior holds has no correlation to speak of.
    correlation = np.where(np.isfinite(correlation), correlation, np.eye(len(names)))
    covariance = np.asarray(sigmas[:, None] * correlation * sigmas)
    return (covariance, gain @ gain.T) if np.isfinite(sigmas).all() and np.isfinite(gain).all() else None


def _number(statistics: Any, name: str) -> float:
    value = statistics.get(name) if isinstance(statistics, Mapping) else None
    return float(value) if isinstance(value, int | float) and value > 0 else math.inf


def _datum(surface: Surface) -> float:
    """Return the standard deviation (m) of the height datum of a surface."""
    if not isinstance(surface, DemSurface) or surface.vertical.is_ellipsoid:
        return 0.0
    return _GEOIDS.get(surface.vertical.name, _OTHER_GEOID)


def _reference(warnings: tuple[Notice, ...], before: Mapping[str, Any] | None) -> tuple[float, bool]:
    """Return the error of the reference of matched points that the parameters do not include.

    Its standard deviation (m), and whether it is unknown.
    """
    notices = [notice.fields for notice in warnings if notice.code == "relative-to-reference"]
    notices += [notice for notice in (before or {}).get("notices", ()) if notice.get("code") == "relative-to-reference"]
    if not notices:
        return 0.0, False
    sigma = notices[0].get("reference_sigma_m")
    return 0.0 if notices[0].get("in_sigmas") else float(sigma or 0.0), not sigma


def _common(placed: Placement) -> float:
    """Return the variance (m², both axes) at the scene centre of errors common to all control points."""
    fit, scene = placed.adjusted.fit, placed.scene
    if fit.common_error is None:
        return 0.0
    middle = fit.model.image_to_ground(np.array([[scene.width / 2, scene.height / 2]]), fit.model.reference_height)
    there = np.linalg.pinv(metre_partials(fit.model, middle)[0][0])
    spread = there @ fit.model.param_partials(middle)[0] @ fit.common_error.gain
    return float((spread**2).sum()) if np.isfinite(spread).all() else 0.0


def _assumptions(budget: Budget, surface: Surface) -> list[str]:
    assumptions = [
        "errors of model, heights and reference are independent",
        "the model is right apart from its parameters",
        "an error is the position of a point in the ortho, at its height, minus its true position",
    ]
    if budget.datum:
        assumptions.insert(1, f"the height datum is accurate to {metres(budget.datum)}")
    if budget.stated is not None:
        assumptions.append(f"the model is accurate to {metres(budget.stated)} per axis, as its vendor states")
    if isinstance(surface.sigma, float | int):
        assumptions.append(f"the heights are accurate to {metres(surface.sigma)} everywhere")
    return assumptions


def ortho_of(placed: Placement, files: Mapping[str, Path], other: Regridded | None) -> Path | Hiding:
    """Return the path of the ortho; if requested, with the treatment of pixels that terrain hides."""
    if placed.request.output.visibility is None:
        return files["ortho"]
    from ortho_pipeline.warp.quality.hiding import Hiding

    return Hiding(files["ortho"], placed.footprint.heights, files.get("visibility"), other)


def write_layers(
    placed: Placement, known: Known | None, warped: WarpRecord, files: Mapping[str, Path]
) -> AccuracyLayer | None:
    """Write the accuracy raster and its style, if requested, and return its record for the report."""
    if known is None:
        return None
    from ortho_pipeline.warp.quality.accuracy import write_accuracy
    from ortho_pipeline.warp.quality.sight import Sight

    budget = dataclasses.replace(known.budget, interpolation_px=warped.max_error_px)
    scene, output = placed.scene, placed.request.output
    result = write_accuracy(
        budget,
        Sight(placed.model, placed.grid),
        placed.surface,
        (scene.width, scene.height),
        files["accuracy"],
        heights=placed.footprint.heights,
        step=output.layer_step,
        resources=Resources(output.memory, output.threads),
        metadata={"ASSUMPTIONS": "; ".join(known.assumptions), "UNKNOWN": ", ".join(known.unknown) or "nothing"},
    )
    if not result.known:
        raise InputError(
            "the raster of height accuracy has no value within the ortho",
            field="surface.sigma",
            remedy="give a raster of this area whose values are not negative, or a number",
        )
    layer = _record(result, known, output.layer_step)
    write_text(files["accuracy_style"], accuracy_style(layer))
    return layer


def _record(result: AccuracyResult, known: Known, step: int) -> AccuracyLayer:
    shares, budget = dict(result.shares), known.budget
    even = shares.pop("even")
    stated = 0.0 if known.adjusted or not budget.stated else budget.stated**2
    part = stated / (stated + budget.reference**2) if even else 0.0
    by = "points" if known.adjusted else "model"
    common = min(known.common / max(sum(sigma**2 for sigma in result.sigma), 1e-300), shares["model"])
    return AccuracyLayer(
        ce90_m=result.ce90,
        range_m=result.quantiles,
        sigma_m=result.sigma,
        shares={
            by: shares["model"] - common + even * part,
            "heights": shares["heights"],
            "reference": even * (1.0 - part) + common,
            "interpolation": shares["interpolation"],
        },
        unknown=known.unknown,
        known=result.known,
        assumptions=known.assumptions,
        cell=result.cell * step,
        cells=tuple(tuple(row) for row in json_value(_rounded(result.cells))),
    )


def _rounded(values: Array) -> list[list[float]]:
    """Return values with three digits: those of a map."""
    return [[float(f"{value:.3g}") for value in row] for row in values.tolist()]
