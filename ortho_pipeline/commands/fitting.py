"""`ortho fit` and `ortho compare`: models and their control, without an ortho."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.control.points import control_of, refuse_contradictions
from ortho_pipeline.commands.placement import open_rasters
from ortho_pipeline.commands.resolved.ledger import provenance
from ortho_pipeline.commands.resolved.opening import resolve
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.commands.results import ENDINGS, CompareResult, FitResult, outputs_together, write_report
from ortho_pipeline.commands.scene_fit import (
    Adjusted,
    adjust,
    adjustable,
    heights_around,
    heights_where_wanted,
    relative_to_reference,
)
from ortho_pipeline.commands.stac.given import with_items
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.estimation.choice import comparison as comparing
from ortho_pipeline.estimation.coordinate_swaps import refuse_swapped
from ortho_pipeline.estimation.family_fit import ridge_of
from ortho_pipeline.models import families
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.report import document as report
from ortho_pipeline.runtime.process_limits import one_blas_thread


@with_items
@one_blas_thread()
def fit(
    image: str | os.PathLike[str],
    points: PointOptions,
    scene: SceneOptions = SceneOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
) -> FitResult:
    """Adjust the model of a scene to its control points and test it at its check points.

    Raises
    ------
    InputError
        If there are no points, or a file is wrong (message names file, field and remedy).
    """
    request = Request(image, scene, points, surface, match)
    _require_points(request)
    adjusted = adjust(resolved := adjustable(request))
    return FitResult(
        adjusted.scene,
        adjusted.fit,
        (*adjusted.warnings(resolved.surface), *report.datums_of(adjusted.fit, resolved.surface)),
        adjusted.removed,
        points.near,
        adjusted.matched,
    )


@with_items
@outputs_together
@one_blas_thread()
def compare(
    image: str | os.PathLike[str],
    points: PointOptions,
    *,
    models: str = "all",
    folder: str | os.PathLike[str] | None = None,
    scene: SceneOptions = SceneOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
    command: str | None = None,
) -> CompareResult:
    """Fit many models to the same points, and recommend one.

    Parameters
    ----------
    models : str
        ``all`` or names separated by commas: those of `models`, and the image's own model with its corrections
        (``rpc``, ``rpc+shift``, ``rpc+shift-drift``, ``rpc+affine``).
    folder : path, optional
        Where the report of the recommended model goes, with the comparison in it.

    Raises
    ------
    InputError
        If there are no points, a model is unknown, or a file is wrong. A model that cannot be fitted is a row.
    """
    request = Request(image, scene, points, surface, match)
    _require_points(request)
    _refuse_options_of_fit(points)
    refuse_contradictions(points, match)
    resolved = resolve(request, needs_model=False)
    opened, heights = resolved.scene, resolved.surface
    own = opened.model if opened.models else None
    names = comparing.choose_models(models, own)
    measured, matched = control_of(resolved)
    if own is not None:
        refuse_swapped(own, measured, opened.height)
    compared = _compared(resolved, heights_where_wanted(measured, heights, *names), names)
    best = compared.best
    if matched is not None:
        relative = () if best is None or best.fit is None else relative_to_reference(best.fit, match)
        compared = compared.noted([*matched.notices, *relative])
    compared = compared.replaced(image=str(opened.path), sensor=opened.sensor)
    if folder is None or best is None or best.fit is None:
        return CompareResult(opened, compared, matched)
    chosen = replace(best.fit, warnings=(*best.fit.warnings, *relative_to_reference(best.fit, match)))
    stem = Path(image).stem
    files = {name: Path(folder) / f"{stem}{ENDINGS[name]}" for name in ("residuals", "style", "report", "html")}
    inputs.check_paths(files, request)
    if best.model in {family.name for family in families()}:
        opened = replace(opened, models={best.model: chosen.model}, model_source="control points")
    adjusted = Adjusted(opened, chosen, matched=matched)
    settings = request.asked("scene", "surface", "match")
    record = provenance(request, opened, heights, resolved.ledger.hashed(), command, settings)
    document = report.build_report(
        scene=opened,
        fit=chosen,
        surface=heights,
        comparison=compared,
        near=points.near,
        provenance=record,
        warnings=adjusted.warnings(heights),
        matching=adjusted.matching,
    )
    write_report(document, chosen, files, matched, open_rasters(opened, request))
    return CompareResult(resolved.scene, compared, matched, files)


def _compared(resolved: Resolved, measured: Points, names: Sequence[str]) -> comparing.ComparisonRecord:
    scene, options = resolved.scene, resolved.request.points
    return comparing.compare(
        measured,
        names,
        own=scene.model if scene.models else None,
        priors=scene.priors,
        size=(scene.width, scene.height),
        crs=options.model_crs,
        heights=heights_around(measured, resolved.surface),
        unsuited=scene.unsuited,
        ridge=ridge_of(options.ridge),
        significance=options.significance,
    )


def _refuse_options_of_fit(points: PointOptions) -> None:
    if points.correction is not None or points.fit_model is not None:
        raise InputError(
            Text("ortho compare chooses its models with ", Setting("models")),
            remedy=Text("leave this option out; for example use ", Setting("models", "all")),
            field="points.fit_model" if points.correction is None else "points.correction",
        )
    if points.params is not None or points.prune:
        raise InputError(
            "ortho compare always fits all parameters of a model",
            field="points.params" if points.params else "points.prune",
            remedy="use `ortho fit`",
        )


def _require_points(request: Request) -> None:
    if not request.has_control:
        raise InputError(
            "no control points given",
            field="points.gcps",
            remedy=Text(
                "give a file of points with ",
                Setting("points.gcps"),
                ", or an ortho to match with ",
                Setting("match.reference"),
            ),
        )
