"""`ortho adjust` and `ortho intersect`: images and points in, models, ground points and a report out."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ortho_pipeline.block.adjustment import adjust as adjust_block
from ortho_pipeline.block.fit import BlockFit, ObjectRms
from ortho_pipeline.block.intersection import Intersection
from ortho_pipeline.block.intersection import intersect as intersect_rays
from ortho_pipeline.block.local_frame import GEODETIC, GroundFrame
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.start import Start
from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.block_images import labels_of, refuse_copies, scenes_of, start_of, state_of_files
from ortho_pipeline.commands.block_results.ground_points import csv_of, geojson_of, ground_rows, writer_of
from ortho_pipeline.commands.block_results.models import adjusted_models, exported_models
from ortho_pipeline.commands.block_results.orthos import (
    OrthoPlan,
    mosaic_of_orthos,
    ortho_files,
    orthos_made,
    planned,
    with_mosaic,
)
from ortho_pipeline.commands.block_results.other_programs import AdjustedBlock, block_formats, files_for
from ortho_pipeline.commands.control.block_points import (
    gather,
    observed,
    read_points,
    refuse_contradictions,
    relative_to_reference,
    settled_scenes,
)
from ortho_pipeline.commands.resolved.ledger import Ledger, provenance
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.results import Result, attempted, to_store
from ortho_pipeline.commands.stac.given import with_items
from ortho_pipeline.commands.survey.folder import images_of
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.errors.texts import Text, counted
from ortho_pipeline.estimation.records import Rmse
from ortho_pipeline.exchange import rpc
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.files import together, write_json, write_text
from ortho_pipeline.models import FrameCamera, SensorModel
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import (
    BlockOptions,
    MatchOptions,
    MosaicOptions,
    OutputOptions,
    PointOptions,
    SceneOptions,
    SurfaceOptions,
)
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.report import block as block_report
from ortho_pipeline.report.block_records import BlockReport
from ortho_pipeline.report.network.cards import PICTURES, SIDE
from ortho_pipeline.report.wording import ENOUGH_CHECK_POINTS, few_check_points
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.surface.base import Surface

#: Pixels of an image of which a picture is made: without overviews nearly all of it has to be read.
_PICTURED = 400_000_000


@with_items
@to_store(folder="block")
def adjust(
    images: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    points: BlockOptions,
    scene: SceneOptions | Sequence[SceneOptions] = SceneOptions(),
    *,
    models: Sequence[str | os.PathLike[str]] = (),
    match: MatchOptions = MatchOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    orthos: OutputOptions | None = None,
    mosaic: MosaicOptions | None = None,
    export: Sequence[str] = (),
    command: str | None = None,
    progress: Progress | None = None,
) -> Result:
    """Adjust images and points together; write a model of each image, the points, adjusted RPCs and one report.

    Parameters
    ----------
    images : sequence of path
        Of one or many scenes, each opened with its own sensor; or one folder with several.
    folder : path
        Folder of all outputs. Files of images are named by the stems of the images, after folders if stems are equal.
    scene : SceneOptions or sequence of SceneOptions
        How all images are opened, or each.
    models : sequence of path
        Saved models (``*_model.json``) to start from, one for each image in their order; none: each image's own.
    match : MatchOptions
        References to take control points from, and how to match, also for ties (`points.ties`).
    surface : SurfaceOptions
        Heights, for matching, as observations of the ties, and for orthos.
    orthos : OutputOptions, optional
        Make the orthos of all images, on one grid.
    mosaic : MosaicOptions, optional
        Combine these orthos into ``mosaic.tif``.
    export : sequence of str
        Names of programs that compute heights from the block: cars, asp, s2p, and formats of plugins.

    Returns
    -------
    Result
        `files` has report, html, points, points-csv, and ``<image> model`` and ``<image> rpc`` (where an RPC stands for
        the model) of each image; with orthos also ``<image> ortho`` and so on, as those of `rectify`; with a mosaic
        those of `mosaic`; with exports the configuration of each program by its name, and ``<image> geom`` and so on.

    Raises
    ------
    InputError
        If an input or an option is wrong.
    """
    images, left_out = images_of(images, scene)
    files = _files(labels := labels_of(images), Path(folder))
    of_orthos = {} if orthos is None else ortho_files(Path(folder), labels, orthos)
    of_mosaic = mosaic_of_orthos(Path(folder), mosaic, orthos)
    scenes = scenes_of(images, scene, models)
    refuse_contradictions(points, match, surface, orthos=orthos is not None)
    programs = block_formats(export)
    written = of_orthos | of_mosaic | ({"export": files_for(programs, Path(folder), labels)} if programs else {})
    _check_paths(files, images, points, scenes, *models, match=match, surface=surface, further=written)
    begun = state_of_files(images, points, scenes, match, surface)
    scenes, placed = settled_scenes(images, labels, scenes, points, surface)
    refuse_copies(images, scenes)
    gathered = gather(images, labels, scenes, points, match, surface)
    starts = _starts(images, labels, scenes, points, gathered.table)
    fit = adjust_block(
        {label: start.model for label, start in starts.items()},
        gathered.table,
        priors={label: start.priors for label, start in starts.items()},
        hold=points.hold,
        heights=observed(points, surface, gathered.heights),
        accuracies={label: start.accuracy for label, start in starts.items() if start.accuracy is not None},
    )
    # The block has the last word on the accuracy of the DEM.
    asked = fit.heights is None and points.dem_heights == "on"
    notes = [one for one in (*placed, *gathered.notices) if asked or one.code != "dem-sigma-by-default"]
    adjusted = adjusted_models(fit, starts, gathered.heights)
    exported, complaints = exported_models(adjusted, files)
    plan = planned(starts, fit, adjusted, files, of_orthos, gathered.heights, (scenes[0], surface, orthos))
    complaints += plan.notices if isinstance(plan, OrthoPlan) else []
    record = _record(images, points, scenes, starts, command, match, surface, gathered.heights)
    report = block_report.build_report(
        fit=fit,
        starts=starts,
        exported=exported,
        provenance=record,
        warnings=[*left_out, *_warnings(fit, starts), *notes, *relative_to_reference(fit, points, match), *complaints],
        join_limit=points.join_limit,
        dem_unused=surface.dem is not None and points.dem_heights == "off",
    )
    with together(folder, "block"):
        _write(files, report, fit, starts, adjusted, exported, record)
        told = AdjustedBlock(fit, starts, adjusted, gathered.heights, scenes[0]).export(programs, Path(folder), files)
        failure = attempted(lambda: _write_report(files, report, _pictures(starts, scenes[0])), files, "report", "html")
        made, lost = orthos_made(plan, of_orthos | of_mosaic, command, progress)
        files |= {f"{label} {kind}": path for label, own in made.items() for kind, path in own.items()}
        begun.require_unchanged()
    text = Text.joined("\n", [block_report.summary_text(report), *gathered.text, *told])
    result = Result(files, {"report": report.to_json(), **gathered.document}, text, failure or lost)
    return result if mosaic is None or not made else with_mosaic(result, made, of_mosaic, mosaic)


@with_items
@to_store(output=None)
def intersect(
    images: Sequence[str | os.PathLike[str]],
    points: BlockOptions,
    scene: SceneOptions | Sequence[SceneOptions] = SceneOptions(),
    *,
    models: Sequence[str | os.PathLike[str]] = (),
    output: str | os.PathLike[str] | None = None,
) -> Result:
    """Intersect the rays of points, with the images' own models or with model files in the order of the images.

    Parameters
    ----------
    scene : SceneOptions or sequence of SceneOptions
        How all images are opened, or each.
    models : sequence of path
        Saved models (``*_model.json``), one for each image; none: each image's own.
    output : path, optional
        A ``.csv`` or ``.geojson`` file of the ground points.

    Raises
    ------
    InputError
        If the number of models differs from that of images, or another input is wrong.
    """
    labels = labels_of(images)
    writer = None if output is None else writer_of(output)
    files = {} if output is None else {"points": Path(output)}
    scenes = scenes_of(images, scene, models)
    _check_paths(files, images, points, scenes, *models)
    table, notes = read_points(images, labels, points, scenes[0].allow_network)
    if models:
        chosen = {
            label: inputs.open_scene(image, own).model for label, image, own in zip(labels, images, scenes, strict=True)
        }
    else:
        scenes, placed = settled_scenes(images, labels, scenes, points)
        notes = [*placed, *notes]
        chosen = {
            label: _own(inputs.open_scene(image, own), points.model)
            for label, image, own in zip(labels, images, scenes, strict=True)
        }
    intersection = intersect_rays(chosen, table)
    rows = ground_rows(
        table, intersection.ground, intersection.sigmas, _apart(table, intersection.ground), intersection.angles_deg
    )
    if writer is not None and output is not None:
        write_text(output, writer(rows))
    document = {
        "points": rows,
        "sigma0": intersection.sigma0,
        **to_document([*notes, *_left_open(intersection), *_contradicting(intersection)]),
        "median_residual_px": _median_residual(intersection),
    }
    return Result(files, document, _intersection_text(document))


# -- reading ---------------------------------------------------------------------------------------------------------


def _heights(table: BlockPoints) -> tuple[float, float] | None:
    known = table.ground[np.isfinite(table.ground[:, 2]), 2]
    return (float(known.min()), float(known.max())) if len(known) else None


def _starts(
    images: Sequence[str | os.PathLike[str]],
    labels: Sequence[str],
    scenes: Sequence[SceneOptions],
    points: BlockOptions,
    table: BlockPoints,
) -> dict[str, Start]:
    heights = _heights(table)
    return {
        label: start_of(image, points, own, table.in_image(label), heights)
        for label, image, own in zip(labels, images, scenes, strict=True)
    }


def _own(scene: Any, name: str | None) -> SensorModel:
    if name is not None and name not in scene.models:
        raise InputError(
            f"this image has no model {name!r}",
            file=scene.path,
            field="points.model",
            remedy=f"its models are {', '.join(scene.models)}",
        )
    model: SensorModel = scene.model if name is None else scene.models[name]
    return model


# -- paths -----------------------------------------------------------------------------------------------------------


def _files(labels: Sequence[str], folder: Path) -> dict[str, Path]:
    files = {
        "report": folder / "block_report.json",
        "html": folder / "block_report.html",
        "points": folder / "block_points.geojson",
        "points-csv": folder / "block_points.csv",
    }
    for label in labels:
        files[f"{label} model"] = folder / f"{label}_model.json"
        files[f"{label} rpc"] = folder / f"{label}_RPC.TXT"
    return files


def _check_paths(
    files: Mapping[str, Path],
    images: Sequence[str | os.PathLike[str]],
    options: BlockOptions,
    scenes: Sequence[SceneOptions],
    *more: str | os.PathLike[str],
    match: MatchOptions = MatchOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    further: Mapping[str, Mapping[str, Path]] = MappingProxyType({}),
) -> None:
    if not files:
        return
    for image, scene in zip(images, scenes, strict=True):
        for read in (options.points, options.gcps, options.spot_heights, *more):
            request = Request(image, scene, PointOptions(gcps=read), surface, match)
            for written in (files, *further.values()):
                inputs.check_paths(written, request)


def _record(
    images: Sequence[str | os.PathLike[str]],
    options: BlockOptions,
    scenes: Sequence[SceneOptions],
    starts: Mapping[str, Start],
    command: str | None,
    match: MatchOptions,
    surface: SurfaceOptions,
    heights: Surface | None,
) -> dict[str, Any]:
    """Return the record that reproduces the result."""
    ledgers = [
        Ledger.of(Request(image, scene, PointOptions(gcps=file), surface, match), start.scene, heights)
        for image, scene, start in zip(images, scenes, starts.values(), strict=True)
        for file in (options.points, options.gcps, options.spot_heights)
    ]
    first = next(iter(starts.values())).scene
    matched = options.ties is not None or bool(match.reference)
    settings = ({"match": match} if matched else {}) | ({"surface": surface} if matched or heights is not None else {})
    record = provenance(
        Request(images[0]),
        first,
        None,
        ledgers[0].joined(*ledgers[1:]).hashed(),
        command,
        {"block": options, "scene": replace(scenes[0], model=None), **settings},
    )
    return {key: record[key] for key in ("command", "inputs", "options", "software")}


# -- what came out ---------------------------------------------------------------------------------------------------


def _warnings(fit: BlockFit, starts: Mapping[str, Start]) -> list[Notice]:
    points = fit.points
    notices = [notice.in_image(label) for label, start in starts.items() for notice in start.scene.notices]
    notices += (*fit.warnings, *_adjusted_again(fit, starts))
    ties = {points.ids[k] for k in np.flatnonzero(points.tie)}
    for rejected in sorted(fit.rejected, key=lambda one: one.point in ties)[:50]:
        where = f" in {rejected.image}" if rejected.image else (" (its ground)" if rejected.what == "ground" else "")
        text = f"point {rejected.point}{where} was rejected: {rejected.reason}"
        notices.append(Notice("left-out", text, point=rejected.point, reason=rejected.reason))
    if (more := len(fit.rejected) - 50) > 0:
        text = f"{counted(more, 'more gross error')}; the report lists all"
        notices.append(Notice("more-left-out", text, count=more))
    sizes = np.array([(start.scene.width, start.scene.height) for start in starts.values()])[points.image]
    outside = ((points.measured < 0) | (points.measured > sizes)).any(axis=1)
    if outside.any():
        names = list(dict.fromkeys(points.ids[i] for i in points.point[outside][:10]))
        number = int(outside.sum())
        text = (
            f"{counted(number, 'measurement is', 'measurements are')} outside the image, but used: {', '.join(names)}"
        )
        notices.append(Notice("outside-of-image", text, count=number, points=names))
    if fit.parameters and fit.redundancy == 0:
        notices.append(Notice("no-redundancy", "no redundancy: residuals are zero by construction and prove nothing"))
    checks = max((rms.n for rms in _check_rms(fit) if rms), default=0)
    if points.control.any() and checks < ENOUGH_CHECK_POINTS:
        notices.append(few_check_points(checks))
    return list(dict.fromkeys(notices))


def _adjusted_again(fit: BlockFit, starts: Mapping[str, Start]) -> list[Notice]:
    """Return a notice of poses without an accuracy, such as those of a finished adjustment, that no control moved."""
    if fit.points.control.any():
        return []
    adjusted = {label: starts[label] for label, _ in fit.parameters}
    again = [label for label, one in adjusted.items() if isinstance(one.model, FrameCamera) and not one.priors]
    text = f"the poses of {counted(len(again), 'image')} state no accuracy. They were adjusted again"
    return [Notice("adjusted-again", text, count=len(again), images=again[:10])] if again else []


def _check_rms(fit: BlockFit) -> list[ObjectRms | Rmse | None]:
    return [fit.object_rms(), *(fit.image_rms(image, "check") for image in fit.points.images)]


def _pictures(starts: Mapping[str, Start], options: SceneOptions) -> dict[str, bytes]:
    """Return small pictures of the first images, of those that are read at once: a page can do without."""
    pictures = {}
    for label, start in list(starts.items())[:PICTURES]:
        if start.scene.width * start.scene.height > _PICTURED:
            continue
        with contextlib.suppress(OrthoError):
            pictures[label] = preview_png(start.scene.path, side=SIDE, allow_network=False, roots=options.roots)
    return pictures


def _write(
    files: Mapping[str, Path],
    report: BlockReport,
    fit: BlockFit,
    starts: Mapping[str, Start],
    models: Mapping[str, SensorModel],
    exported: Mapping[str, rpc.RpcExport],
    record: Mapping[str, Any],
) -> None:
    rows = ground_rows(fit.points, fit.ground, fit.ground_sigmas, fit.object_residuals)
    write_text(files["points"], geojson_of(rows))
    write_text(files["points-csv"], csv_of(rows))
    for label, start in starts.items():
        scene = start.scene
        adjustment = {"gauge": fit.gauge, "sigma0": fit.sigma0, **report.adjustment.images[label].to_json()}
        saved = SavedModel(
            models[label],
            scene.sensor,
            start.source,
            (scene.width, scene.height),
            {**record, "adjustment": adjustment},
        )
        write_model_file(saved, files[f"{label} model"])
        if label in exported:
            rpc.write_rpc_txt(exported[label].rpc, files[f"{label} rpc"])


def _write_report(files: Mapping[str, Path], report: BlockReport, pictures: Mapping[str, bytes]) -> None:
    write_json(files["report"], report.to_json(), ascii_only=False)
    write_text(files["html"], block_report.page(report, pictures))


# -- intersections ---------------------------------------------------------------------------------------------------


def _apart(points: BlockPoints, ground: Array) -> Array:
    """Return known minus found ground in metres east, north, up ``(N, 3)``."""
    known = points.known_in(GEODETIC)
    if not np.isfinite(known).all(axis=1).any():
        return np.full((len(points), 3), np.nan)
    frame = GroundFrame.about(known)
    return frame.apart(known, frame.of_geodetic(ground))


def _median_residual(intersection: Intersection) -> float | None:
    lengths = np.hypot(*intersection.residuals.T)
    lengths = lengths[np.isfinite(lengths)]
    return float(np.median(lengths)) if len(lengths) else None


def _left_open(intersection: Intersection) -> list[Notice]:
    open_ = ~np.isfinite(intersection.ground).all(axis=1)
    if not open_.any():
        return []
    names = np.array(intersection.points.ids)[open_][:10].tolist()
    text = (
        f"{counted(int(open_.sum()), 'point has', 'points have')} no intersection (one ray, parallel rays, or "
        f"outside the models): {', '.join(names)}"
    )
    return [Notice("no-intersection", text, count=int(open_.sum()), points=names)]


def _contradicting(intersection: Intersection) -> list[Notice]:
    notices, points = [], intersection.points
    for number in np.flatnonzero(intersection.contradicting)[:50].tolist():
        largest = float(np.hypot(*intersection.residuals[points.point == number].T).max())
        text = (
            f"the rays of point {points.ids[number]} miss each other by much more than those of the other points "
            f"(largest residual {significant(largest)} px); sigma0 is without it"
        )
        notices.append(Notice("contradicting-point", text, point=points.ids[number], role=str(points.roles[number])))
    return notices


def _intersection_text(document: Mapping[str, Any]) -> str:
    rows = document["points"]
    wide = max([5, *(len(row["id"]) for row in rows)])
    lines = [f"{'point':<{wide}} rays {'longitude':>14} {'latitude':>13} {'h':>10}   sigma E     N     h (m)"]
    for row in rows:
        if row["ground"] is None:
            lines.append(f"{row['id']:<{wide}} {row['rays']:>4} {'no intersection':>14}")
            continue
        lon, lat, h = row["ground"]
        sigma = " ".join(f"{value:5.2f}" for value in row["sigma"])
        lines.append(f"{row['id']:<{wide}} {row['rays']:>4} {lon:14.8f} {lat:13.8f} {h:10.2f}     {sigma}")
    median = document["median_residual_px"]
    sigma0 = "unknown" if document["sigma0"] is None else f"{document['sigma0']:.3g}"
    lines.append(f"Median residual {'-' if median is None else f'{median:.2f}'} px, sigma0 {sigma0}")
    return "\n".join(lines)
