"""`ortho rectify` and `ortho export`: a scene, its control and a surface in; an ortho, models and a report out."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.heights.surfaces import require_heights
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
from ortho_pipeline.exchange import rpc
from ortho_pipeline.exchange.export import FORMATS, Export, check_formats
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.files import retire, sha256
from ortho_pipeline.files.traffic import bytes_read
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.host import Host
from ortho_pipeline.models import SensorModel
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.options.texts import Setting, Text
from ortho_pipeline.points import Points
from ortho_pipeline.raster import source as raster
from ortho_pipeline.raster.caching.block_cache import cache_restored, limit_cache
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.output import checked_options, require_whole
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

    `image` may be a scene that is open, `points` a table that is read already, in pixels of that image. Nothing is
    written before all that can be checked is checked. `name` is the id of the STAC item (the
    image's stem without one), `digest` takes checksums of the inputs, which it may know. Outputs of the same name are
    replaced, with their statistics and overviews, and outputs of an earlier run that this one does not make are
    removed; with `overwrite` also where no report says that a run made them, and old models beside the ortho.

    Returns
    -------
    Result
        `files` has ortho, model, rpc, vrt (unless no RPC stands for the model), residuals and style (with points
        only), report, html, and, if asked for, accuracy with its style, and stac with thumbnail and overview. If the
        report could not be made, the others are there, and `failure` says why.

    Raises
    ------
    InputError
        For whatever the user can correct: no heights, a DEM that does not cover the scene, a path that is read and
        written, an old side-car that would attach to the ortho.
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
    made = make_ortho(resolved, files, OrthoJob(stage, command, name or stem, digest, before))
    retire(_of_earlier_run(Path(folder), stem, files, all_of_them=overwrite))
    if isinstance(made, ReportError):
        return Result(files, {"report": None}, "Ortho and model are complete; there is no report.", made)
    return Result(files, {"report": made.to_json()}, report.summary_text(made))


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
    """Do all that `rectify` does before the first pixel: what it would say then, it says now.

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
    """Write the model of a scene, adjusted if there are points, in formats that GDAL and every GIS read.

    Parameters
    ----------
    formats : sequence of str
        Names of formats: rpc-txt, rpb, vrt, tag, gcp, gcp-tag, geolocation, and those of plugins, such as csm.
    force : bool
        Accept a file that is more than 0.1 px off the model.

    Returns
    -------
    Result
        `document` says whether the RPC is exact, and the largest error of everything that is not.

    Raises
    ------
    InputError
        For an unknown format, a geolocation without heights, and as `fit`.
    """
    chosen = check_formats(formats, Host.discover().formats)
    files = {one.name: Path(folder) / f"{Path(image).stem}{one.ending}" for one in chosen}
    request = Request(image, scene, points, surface, match)
    inputs.check_paths(files, request)
    adjusted, heights = adjust(resolved := adjustable(request)), resolved.surface
    dataset = raster.open_dataset(image, **scene.access)
    size = adjusted.scene.width, adjusted.scene.height
    adjustment = adjusted.fit
    with completed(adjusted.scene.model_source, of="model"):
        if heights is not None:
            heights = footprint.facing(adjusted.model, heights, *size)
        job = Export(
            dataset, adjusted.model, size, heights, adjustment.points.select(adjustment.used), adjustment.rejected,
            force=force,
        )  # fmt: skip
        for one in chosen:
            job.write(one, files[one.name])
    document = {**job.document, "model": adjustment.model_name, "model_source": adjusted.scene.model_source}
    return Result(files, document, job.summary(adjustment.model_name, adjusted.scene.model_source, chosen))


# -- parts -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OrthoJob:
    """How an ortho is made, besides its request.

    Parameters
    ----------
    stage : callable
        Is told what is done, and how far it is.
    command : str, optional
        For the record.
    name : str
        Id of the STAC item.
    digest : callable
        Takes checksums of the inputs.
    before : int
        Bytes that were read over the network when the work began.
    """

    stage: Progress
    command: str | None
    name: str
    digest: Callable[..., str] = sha256
    before: int = 0


def make_ortho(resolved: Resolved, files: dict[str, Path], job: OrthoJob) -> SceneReport | ReportError:
    """Make the ortho of a scene, its models unless `files` has none, and its report, or say why there is none."""
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
        warped = _warp(placed, exported, source, path, job.stage)
        job.stage("Layers and report", 0.0)
        accuracy = layers.write_layers(placed, budget, warped, files)
        angles = write_angles(placed, sun, files)
        asked = request.asked("scene", "surface", "output", "match")
        record = provenance(request, opened, placed.surface, hashing.result(), job.command, asked)
    if "model" in files:
        _write_models(placed, exported, files, {**record, "adjustment": adjusted.record()})

    def described() -> SceneReport:
        made = report.build_report(
            scene=opened, fit=adjusted.fit, exported=exported, surface=placed.surface,
            coverage=placed.footprint.coverage, grid=placed.grid, warp=warped, near=request.points.near,
            provenance=record | read_since(job.before), matching=adjusted.matching,
            warnings=[*adjusted.warnings(placed.surface), *placed.footprint.notes(),
                      *placed.sparse(warped.valid_pixels), *complaints, *notes, *warped.notes(output.memory)],
        )  # fmt: skip
        made = report.with_layers(made, accuracy=accuracy, angles=angles)
        write_report(made, adjusted.fit, files, adjusted.matched, source)
        if acquired is not None:
            from ortho_pipeline.report.stac import write_item

            write_item(files["stac"], made, files, acquired, job.name)
        return made

    made = attempted(described, files, *OF_REPORT)
    resolved.ledger.require_unchanged()
    return made


def _unwatched(stage: str, share: float) -> None:
    """Tell nobody how far the work is."""


def _of_earlier_run(folder: Path, stem: str, files: Mapping[str, Path], *, all_of_them: bool) -> list[Path]:
    """Return what an earlier run wrote for this scene and this one does not, and side-cars of the ortho it wrote.

    Without its report, only `all_of_them` takes files of such names for its own.
    """
    ours, before = all_of_them, folder / f"{stem}{ENDINGS['report']}"
    if not ours and before.is_file():
        with contextlib.suppress(InputError):
            ours = bool(report.read_report_json(before))
    left = [folder / f"{stem}{ending}" for ending in ENDINGS.values()] if ours else []
    return [*(path for path in left if path not in files.values()), *inputs.old_side_cars(files["ortho"])]


def _acquired(facts: Mapping[str, Any], output: OutputOptions) -> Any:
    """Return the time of acquisition for the STAC item, None where none is asked for."""
    if output.stac:
        from ortho_pipeline.report.stac import acquisition_time

        return acquisition_time(facts, output.acquired)
    if output.acquired is not None:
        raise InputError("only a STAC item says when", field="output.acquired",
                         remedy=Text("give ", Setting("output.stac"), " too, or leave it out"))  # fmt: skip
    return None


def _as_rpc(model: SensorModel) -> tuple[rpc.RpcExport | None, list[Notice]]:
    """Return the model as RPC and what there is to say about it; None where no RPC stands for it."""
    try:
        exported = rpc.export_rpc(model)
    except InputError as error:
        return None, [Notice("no-rpc", Text("no RPC files were written: ", error.message))]
    return exported, list(exported.warnings)


def _warp(
    placed: Placement,
    exported: rpc.RpcExport | None,
    source: raster.RasterSource,
    path: Path | Hiding,
    progress: Progress,
) -> WarpRecord:
    # The compiled kernels take a while to load: beside the checksums.
    from ortho_pipeline.warp.engines import engine_of
    from ortho_pipeline.warp.job import WarpJob

    output = placed.request.output
    job = WarpJob(
        placed.model, source, placed.surface, placed.grid, output.resampling, output.dem_interpolation,
        output.tolerance, Resources(output.memory, output.threads, progress), output.format,
        dict(output.creation_options), Profile.of(source, output.dtype, output.nodata), exported,
    )  # fmt: skip
    return engine_of(output.engine).rectify(job, path)


def _write_models(
    placed: Placement, exported: rpc.RpcExport | None, files: dict[str, Path], record: Mapping[str, Any]
) -> None:
    """Write the model in every format; what cannot be written is taken out of `files`."""
    scene, request = placed.scene, placed.request
    size = scene.width, scene.height
    write_model_file(SavedModel(placed.model, scene.sensor, scene.model_source, size, record), files["model"])
    if exported is None:
        del files["rpc"], files["vrt"]
        return
    rpc.write_rpc_txt(exported.rpc, files["rpc"])
    rpc.write_vrt(raster.open_dataset(request.image, **request.scene.access), exported.rpc, files["vrt"])
