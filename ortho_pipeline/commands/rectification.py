"""`ortho rectify` and `ortho export`: a scene, its control and a surface in; an ortho, models and a report out."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.heights.opening import require_heights
from ortho_pipeline.commands.layers import budget as layers
from ortho_pipeline.commands.layers.angles import sun_of, write_angles
from ortho_pipeline.commands.layers.filling import other_of
from ortho_pipeline.commands.placement import Placement, open_rasters, place_scene
from ortho_pipeline.commands.resolved.ledger import RASTERS, provenance, read_since
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.commands.results import (
    ENDINGS,
    OF_REPORT,
    Result,
    attempted,
    outputs,
    outputs_together,
    write_report,
)
from ortho_pipeline.commands.scene_fit import adjust, adjustable
from ortho_pipeline.commands.stac.given import with_items
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError, ReportError, completed
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.exchange import rpc
from ortho_pipeline.exchange.export import FORMATS, Export, check_formats
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.files import retire, sha256
from ortho_pipeline.files.traffic import bytes_read
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.host import Host
from ortho_pipeline.models import SensorModel
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.raster import source as raster
from ortho_pipeline.raster.caching.block_cache import cache_restored, limit_cache
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.valid_area import doubtful_alpha
from ortho_pipeline.raster.verified_writing import checked_options, require_whole
from ortho_pipeline.report import document as report
from ortho_pipeline.report.records import SceneReport
from ortho_pipeline.runtime.process_limits import Progress, Resources, one_blas_thread
from ortho_pipeline.surface import footprint

if TYPE_CHECKING:
    from ortho_pipeline.warp.job import WarpRecord
    from ortho_pipeline.warp.quality.hiding import Hiding


# -- commands --------------------------------------------------------------------------------------------------------


@with_items
@outputs_together
@one_blas_thread()
@cache_restored()
def rectify(
    image: str | os.PathLike[str] | Scene,
    folder: str | os.PathLike[str],
    *,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions | Points = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
    output: OutputOptions = OutputOptions(),
    progress: Progress | None = None,
    command: str | None = None,
    name: str | None = None,
    digest: Callable[..., str] = sha256,
    overwrite: bool = False,
) -> Result:
    """Make the orthoimage of a scene, its adjusted model in every format, and the accuracy report.

    `image` may be an open scene, and `points` a table of points in pixels of that image. All inputs are checked before
    anything is written. `name` is the id of the STAC item (default: the stem of the image); `digest` computes
    checksums of the inputs. Existing outputs are replaced, and outputs of an earlier run that this run does not make
    are deleted. `overwrite` also deletes such files without a report, and old sidecars of the ortho.

    Returns
    -------
    Result
        `files` has ortho, model, rpc and vrt (unless no RPC represents the model), residuals and style (with points
        only), report, html, and, if requested, accuracy with its style, and stac with thumbnail and overview. If the
        report failed, the others are complete, and `failure` gives the reason.

    Raises
    ------
    InputError
        If an input or an option is wrong: no heights, a DEM that does not cover the scene, a file that is both input
        and output, or an old sidecar that would attach to the ortho.

    Examples
    --------
    >>> flat, coarse = op.SurfaceOptions(height=900.0), op.OutputOptions(resolution=50.0)
    >>> done = op.rectify("sample_data/scene.tif", out, surface=flat, output=coarse)
    >>> done.files["ortho"].name
    'scene_ortho.tif'
    """
    assert isinstance(points, PointOptions), "with_items makes options of points"
    stem, before, stage = Path(image).stem, bytes_read(), progress or _unwatched
    request = Request(image, scene, points, surface, match, output)
    files = outputs(folder, stem, output)
    inputs.check_paths(files, request, overwrite)
    require_heights(surface)
    # Before the DEM is read: left alone, GDAL keeps blocks in a share of the machine's memory.
    limit_cache(output.memory, 1)
    resolved = adjustable(request)
    outcome = make_ortho(resolved, files, OrthoJob(stage, command, name or stem, digest, before))
    retire(_of_earlier_run(Path(folder), stem, files, all_of_them=overwrite))
    if isinstance(outcome, ReportError):
        return Result(files, {"report": None}, "Ortho and model are complete, but the report is missing.", outcome)
    return Result(files, {"report": outcome.to_json()}, report.summary_text(outcome))


@with_items
def check(
    image: str | os.PathLike[str],
    *,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
    output: OutputOptions = OutputOptions(),
) -> dict[str, Any]:
    """Do all that `rectify` does before the first pixel, with the same errors and warnings.

    Returns
    -------
    dict
        Sensor, model, counts of points, RMSEs in pixels, coverage by the DEM, grid and warnings, as JSON values.

    Raises
    ------
    InputError
        As `rectify`, and for a raster whose file is truncated.
    """
    require_heights(surface)
    request = Request(image, scene, points, surface, match, output)
    resolved = adjustable(request)
    _acquired(resolved.scene.facts, output)
    sun_of(resolved.scene.facts, output)
    placed = place_scene(resolved)
    other_of(placed, open_rasters(placed.scene, request))
    layers.budget_of(placed)
    checked_options(output.format, dict(output.creation_options), 1)
    for path, role in resolved.ledger.roles.items():
        if role in RASTERS:
            require_whole(path, **scene.access)
    return placed.to_json()


@with_items
@outputs_together
@one_blas_thread()
def export(
    image: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    formats: Sequence[str] = tuple(FORMATS)[:4],
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
    force: bool = False,
) -> Result:
    """Write the model of a scene, adjusted to its points if given, in formats that GDAL and every GIS read.

    Parameters
    ----------
    formats : sequence of str
        Names of formats: those of `exchange.export.FORMATS`, and formats of plugins, such as csm.
    force : bool
        Write a file even if it differs from the model by more than 0.1 px.

    Returns
    -------
    Result
        `document` states whether the RPC is exact, and the largest error of each approximation.

    Raises
    ------
    InputError
        For an unknown format, a geolocation without heights, and as `fit`.
    """
    chosen = check_formats(formats, Host.discover().formats)
    files = {file_format.name: Path(folder) / f"{Path(image).stem}{file_format.ending}" for file_format in chosen}
    request = Request(image, scene, points, surface, match)
    inputs.check_paths(files, request)
    resolved = adjustable(request)
    inputs.refuse_read(files.values(), resolved.ledger.roles)
    adjusted, heights = adjust(resolved), resolved.surface
    dataset = raster.open_dataset(image, **scene.access)
    size = adjusted.scene.width, adjusted.scene.height
    adjustment = adjusted.fit
    with completed(adjusted.scene.model_source, of="model"):
        if heights is not None:
            heights = footprint.facing(adjusted.model, heights, *size)
        job = Export(
            dataset,
            adjusted.model,
            size,
            heights,
            adjustment.points.select(adjustment.used),
            adjustment.rejected,
            force=force,
        )
        for file_format in chosen:
            job.write(file_format, files[file_format.name])
    document = {**job.document, "model": adjustment.model_name, "model_source": adjusted.scene.model_source}
    return Result(files, document, job.summary(adjustment.model_name, adjusted.scene.model_source, chosen))


# -- parts -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OrthoJob:
    """The settings of an ortho that are not in its request.

    Parameters
    ----------
    stage : callable
        Receives the stage and the progress.
    command : str, optional
        For the record.
    name : str
        Id of the STAC item.
    digest : callable
        Computes checksums of the inputs.
    before : int
        Bytes that were read over the network before the work began.
    """

    stage: Progress
    command: str | None
    name: str
    digest: Callable[..., str] = sha256
    before: int = 0


def make_ortho(resolved: Resolved, files: dict[str, Path], job: OrthoJob) -> SceneReport | ReportError:
    """Make the ortho of a scene, its report (or its error), and its models if `files` has them."""
    request, output = resolved.request, resolved.request.output
    acquired, sun = _acquired(resolved.scene.facts, output), sun_of(resolved.scene.facts, output)
    with resolved.ledger.hashed_beside(job.digest) as hashing:
        job.stage("Matching and adjusting" if request.match.reference else "Adjusting", 0.0)
        placed = place_scene(resolved)
        adjusted, opened = placed.adjusted, placed.scene
        exported, complaints = _as_rpc(placed.model)
        source = open_rasters(placed.scene, request)
        budget, notes = layers.budget_of(placed)
        path = layers.ortho_of(placed, files, other_of(placed, source))
        warped = warp_placed(placed, exported, source, path, job.stage)
        doubts = doubtful_alpha(source.dataset) if source.validity in ("alpha", "mask") else []
        job.stage("Layers and report", 0.0)
        accuracy = layers.write_layers(placed, budget, warped, files)
        angles = write_angles(placed, sun, files)
        settings = request.asked("scene", "surface", "output", "match")
        record = provenance(request, opened, placed.surface, hashing.result(), job.command, settings)
    if "model" in files:
        _write_models(placed, exported, files, {**record, "adjustment": adjusted.record()})

    def described() -> SceneReport:
        outcome = _report_of(placed, exported, warped, record | read_since(job.before), [*complaints, *notes, *doubts])
        outcome = report.with_layers(outcome, accuracy=accuracy, angles=angles)
        write_report(outcome, adjusted.fit, files, adjusted.matched, source)
        if acquired is not None:
            from ortho_pipeline.report.stac import write_item

            write_item(files["stac"], outcome, files, acquired, job.name)
        return outcome

    outcome = attempted(described, files, *OF_REPORT)
    resolved.ledger.require_unchanged()
    return outcome


def _unwatched(stage: str, share: float) -> None:
    """Ignore the progress."""


def _of_earlier_run(folder: Path, stem: str, files: Mapping[str, Path], *, all_of_them: bool) -> list[Path]:
    """Return outputs of an earlier run that this run does not write, and sidecars of its ortho.

    Without a report of that run, only `all_of_them` returns such files.
    """
    ours, before = all_of_them, folder / f"{stem}{ENDINGS['report']}"
    if not ours and before.is_file():
        with contextlib.suppress(InputError):
            ours = bool(report.read_report_json(before))
    left = [folder / f"{stem}{ending}" for ending in ENDINGS.values()] if ours else []
    return [*(path for path in left if path not in files.values()), *inputs.old_side_cars(files["ortho"])]


def _acquired(facts: Mapping[str, Any], output: OutputOptions) -> Any:
    """Return the time of acquisition for the STAC item; None without an item."""
    if output.stac:
        from ortho_pipeline.report.stac import acquisition_time

        return acquisition_time(facts, output.acquired)
    if output.acquired is not None:
        raise InputError(
            "the time of acquisition is only for a STAC item",
            field="output.acquired",
            remedy=Text("add ", Setting("output.stac"), ", or leave it out"),
        )
    return None


def no_rpc(error: InputError) -> Notice:
    """Return the notice of a model that no RPC represents."""
    return Notice("no-rpc", f"no RPC written: {error.message.replace('this RPC', 'the RPC of this model')}")


def _as_rpc(model: SensorModel) -> tuple[rpc.RpcExport | None, list[Notice]]:
    """Return the model as RPC, and notices; None if no RPC represents it."""
    try:
        exported = rpc.export_rpc(model)
    except InputError as error:
        return None, [no_rpc(error)]
    return exported, list(exported.warnings)


def warp_placed(
    placed: Placement,
    exported: rpc.RpcExport | None,
    source: raster.RasterSource,
    path: Path | Hiding,
    progress: Progress,
) -> WarpRecord:
    # The compiled kernels load slowly, so they load while checksums are computed.
    from ortho_pipeline.warp.engines import engine_of
    from ortho_pipeline.warp.job import WarpJob

    output = placed.request.output
    job = WarpJob(
        placed.model,
        source,
        placed.surface,
        placed.grid,
        output.resampling,
        output.dem_interpolation,
        output.tolerance,
        Resources(output.memory, output.threads, progress),
        output.format,
        dict(output.creation_options),
        Profile.of(source, output.dtype, output.nodata),
        exported,
    )
    return engine_of(output.engine).rectify(job, path)


def _report_of(
    placed: Placement,
    exported: rpc.RpcExport | None,
    warped: WarpRecord,
    record: Mapping[str, Any],
    notices: Sequence[Notice],
) -> SceneReport:
    """Return the report of an ortho, without its layers."""
    adjusted, request = placed.adjusted, placed.request
    return report.build_report(
        scene=placed.scene,
        fit=adjusted.fit,
        exported=exported,
        surface=placed.surface,
        coverage=placed.footprint.coverage,
        grid=placed.grid,
        warp=warped,
        near=request.points.near,
        provenance=record,
        matching=adjusted.matching,
        warnings=[
            *adjusted.warnings(placed.surface),
            *placed.footprint.notes(),
            *placed.sparse(warped.valid_pixels),
            *notices,
            *warped.notes(request.output.memory),
        ],
    )


def _write_models(
    placed: Placement, exported: rpc.RpcExport | None, files: dict[str, Path], record: Mapping[str, Any]
) -> None:
    """Write the model in every format; remove from `files` what cannot be written."""
    scene, request = placed.scene, placed.request
    size = scene.width, scene.height
    write_model_file(SavedModel(placed.model, scene.sensor, scene.model_source, size, record), files["model"])
    if exported is None:
        del files["rpc"], files["vrt"]
        return
    rpc.write_rpc_txt(exported.rpc, files["rpc"])
    rpc.write_vrt(raster.open_dataset(request.image, **request.scene.access), exported.rpc, files["vrt"])
