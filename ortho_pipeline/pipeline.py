"""The guts of each command: paths in, paths out.

Every function here takes options, does the work and returns a result with `to_json`; printing is left to `cli`.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
import pyproj

from ortho_pipeline import comparison as comparing
from ortho_pipeline import crs as crs_module
from ortho_pipeline import dem, dem_accuracy, footprint, gcp_export, inputs, plugins, raster, report, resolution, rpc
from ortho_pipeline import stac as stac_items
from ortho_pipeline.errors import InputError, completed, counted
from ortho_pipeline.estimation import Fit
from ortho_pipeline.files import retire, sha256, staged, states, together, write_text
from ortho_pipeline.ground_error import viewing
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.inputs import has_surface, open_scene, open_surface
from ortho_pipeline.model_choice import ridge_of
from ortho_pipeline.model_file import SavedModel, write_model_file
from ortho_pipeline.models import SensorModel, families
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.raster_writer import Profile
from ortho_pipeline.results import SCHEMA_VERSION, CompareResult, FitResult, Result
from ortho_pipeline.scene_fit import Adjusted, adjust, heights_around, heights_where_wanted, on_surface, open_adjustable
from ortho_pipeline.scene_layout import lay_out, source_of
from ortho_pipeline.swaps import refuse_swapped

if TYPE_CHECKING:
    from ortho_pipeline import warp

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _outputs_together(command: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let the outputs of a command (its first parameter is a file, another one `folder`) appear together."""
    signature = inspect.signature(command)

    @functools.wraps(command)
    def wrapper(*given: _P.args, **named: _P.kwargs) -> _R:
        bound = signature.bind(*given, **named).arguments
        if bound.get("folder") is None:
            return command(*given, **named)
        with together(bound["folder"], Path(next(iter(bound.values()))).stem):
            return command(*given, **named)

    return wrapper


# -- commands --------------------------------------------------------------------------------------------------------


def sensors() -> dict[str, Any]:
    """List the installed sensors, where each comes from, and the plugins that are broken."""
    host = plugins.Host.discover()
    listed = [
        {
            "name": sensor.name,
            "description": sensor.description,
            "options": dict(sensor.options),
            "distribution": host.provenance(name).distribution,
            "version": host.provenance(name).version,
        }
        for name, sensor in host.sensors.items()
    ]
    return {"schema_version": SCHEMA_VERSION, "sensors": listed, "broken": [entry.to_json() for entry in host.broken]}


def info(image: str | os.PathLike[str], options: SceneOptions = SceneOptions()) -> dict[str, Any]:
    """Describe a scene: sensor, size, models and their source, facts, position and ground sample distance."""
    scene = open_scene(image, options)
    model = scene.model
    size = scene.width, scene.height
    with completed(scene.model_source, of="model"):
        crs = footprint.output_crs(model, *size)
        gsd = footprint.ground_sample_distance(model, crs, *size)
    corners = np.array([[0.0, 0.0], [size[0], 0.0], [size[0], size[1]], [0.0, size[1]]])
    to_geographic = crs_module.ground_transform(model.crs, "EPSG:4979")
    ground = to_geographic(model.image_to_ground(corners, model.reference_height))
    return {
        "schema_version": SCHEMA_VERSION,
        "image": str(image),
        "sensor": scene.sensor,
        "size": list(size),
        "models": {name: other.kind for name, other in scene.models.items()},
        "model_source": scene.model_source,
        "height_range": list(model.height_range),
        "reference_height": model.reference_height,
        "utm": crs_text(crs),
        "gsd_m": gsd,
        "view": viewing(model, *size)["view"],
        "corners_lon_lat": [[_number(value) for value in row] for row in ground[:, :2]],
        "facts": dict(scene.facts),
        "warnings": list(scene.warnings),
    }


def models() -> list[dict[str, Any]]:
    """List the classical model families, simple to complex, and what a scene's own model can be corrected by."""
    return [family.to_json() for family in families()]


def fit(
    image: str | os.PathLike[str],
    points: PointOptions,
    scene: SceneOptions = SceneOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
) -> FitResult:
    """Adjust the model of a scene to its control points and hold it against its check points.

    Raises
    ------
    InputError
        If there are no points, or a file is wrong (message names file, field and remedy).
    """
    if points.gcps is None:
        raise InputError("there are no points to fit to", field="--gcps", remedy="give a file of points with --gcps")
    opened = open_adjustable(image, scene, points)
    heights = open_surface(surface, scene) if has_surface(surface) else None
    adjusted = adjust(opened, points, scene, heights)
    return FitResult(
        adjusted.scene, adjusted.fit, adjusted.warnings(heights), tuple(adjusted.removed_json()), points.near
    )  # fmt: skip


@_outputs_together
def compare(
    image: str | os.PathLike[str],
    points: PointOptions,
    *,
    models: str = "all",
    folder: str | os.PathLike[str] | None = None,
    scene: SceneOptions = SceneOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
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
    if points.gcps is None:
        raise InputError("there are no points to fit to", field="--gcps", remedy="give a file of points with --gcps")
    if points.correction is not None or points.fit_model is not None:
        raise InputError("compare takes its models from --models", field="--models", remedy="for example all")
    if points.params is not None or points.prune:
        raise InputError(
            "compare fits whole models", field="--params" if points.params else "--prune", remedy="take ortho fit"
        )
    opened = inputs.open_image(image, scene, needs_model=False)
    names = comparing.choose_models(models, opened.model if opened.models else None)
    heights = open_surface(surface, scene) if has_surface(surface) else None
    opened = on_surface(opened, heights)
    own = opened.model if opened.models else None
    given = inputs.read_control(opened, points, scene)
    if own is not None:
        refuse_swapped(own, given, opened.height)
    given = heights_where_wanted(given, heights, *names)
    compared = comparing.compare(
        given, names, own=own, priors=opened.priors, size=(opened.width, opened.height), crs=points.model_crs,
        heights=heights_around(given, heights), unsuited=opened.unsuited, ridge=ridge_of(points.ridge),
        significance=points.significance,
    )  # fmt: skip
    result = CompareResult(opened, compared)
    best = compared.best
    if folder is None or best is None or best.fit is None:
        return result
    stem = Path(image).stem
    files = {name: Path(folder) / f"{stem}{_ENDINGS[name]}" for name in ("residuals", "style", "report", "html")}
    inputs.check_paths(files, image, scene, points, surface)
    if best.model in {family.name for family in families()}:
        opened = replace(opened, models={best.model: best.fit.model}, model_source="control points")
    adjusted = Adjusted(opened, best.fit)
    hashed = inputs.hashed(inputs.files_read(image, scene, points, surface, opened))
    record = inputs.provenance(opened, points, heights, hashed, command, {"scene": scene, "surface": surface})
    document = report.build_report(
        scene=opened, fit=best.fit, surface=heights, comparison=result.to_json(), near=points.near,
        provenance=record, warnings=adjusted.warnings(heights),
    )  # fmt: skip
    _write_report(document, best.fit, files)
    return replace(result, files=files)


@_outputs_together
def rectify(
    image: str | os.PathLike[str] | Scene,
    folder: str | os.PathLike[str],
    *,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions | Points = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    output: OutputOptions = OutputOptions(),
    progress: Callable[[float], None] | None = None,
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
        only), report, html, and stac with thumbnail and overview (if asked for).

    Raises
    ------
    InputError
        For whatever the user can correct: no heights, a DEM that does not cover the scene, a path that is read and
        written, an old side-car that would attach to the ortho.
    """
    stem = Path(image).stem
    files = {
        kind: Path(folder) / f"{stem}{ending}" for kind, ending in _ENDINGS.items() if kind not in _STAC or output.stac
    }
    points = inputs.point_options(points)
    inputs.check_paths(files, image, scene, points, surface, overwrite)
    inputs.require_heights(surface)
    begun = states(inputs.given_files(image, scene, points, surface))
    # Before the DEM is read: left alone, GDAL keeps blocks in a share of the machine's memory.
    raster.limit_cache(output.memory, 1)
    opened = open_adjustable(image, scene, points)
    heights = open_surface(surface, scene)
    acquired = stac_items.acquisition_time(opened.facts, output.acquired) if output.stac else None
    read = inputs.files_read(image, scene, points, surface, opened)
    begun = states(read) | begun
    with inputs.hashed_beside(read, digest) as hashing:
        laid = lay_out(opened, points, scene, heights, output)
        adjusted, model, heights, found, grid = laid
        opened = adjusted.scene
        exported, complaints = _as_rpc(model)
        source = source_of(opened, image, scene, output)
        warped = _warp(model, exported, source, heights, grid, files["ortho"], output, progress)
        asked = {"scene": scene, "surface": surface, "output": output}
        record = inputs.provenance(opened, points, heights, hashing.result(), command, asked)
    whole = raster.open_dataset(image, **scene.access)
    _write_models(model, exported, opened, whole, files, {**record, "adjustment": adjusted.record()})
    document = report.build_report(
        scene=opened, fit=adjusted.fit, exported=exported, surface=heights, coverage=found.coverage, grid=grid,
        warp=warped, near=points.near, provenance=record,
        warnings=[*adjusted.warnings(heights), *found.notes(heights), *laid.sparse(warped.valid_pixels), *complaints,
                  *warped.notes(output.memory)],
    )  # fmt: skip
    _write_report(document, adjusted.fit, files)
    if acquired is not None:
        stac_items.write_item(files["stac"], document, files, acquired, name or stem)
    inputs.refuse_changed(begun)
    retire(_of_earlier_run(Path(folder), stem, files, all_of_them=overwrite))
    return Result(files, {"report": document}, report.summary_text(document))


def check(
    image: str | os.PathLike[str],
    *,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
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
        As `rectify`.
    """
    inputs.require_heights(surface)
    opened = open_adjustable(image, scene, points)
    if output.stac:
        stac_items.acquisition_time(opened.facts, output.acquired)
    laid = lay_out(opened, points, scene, open_surface(surface, scene), output)
    Profile.of(source_of(laid.scene, image, scene, output), output.dtype, output.nodata)
    return laid.to_json()


@_outputs_together
def export(
    image: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    formats: Sequence[str] = gcp_export.FORMATS[:4],
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    force: bool = False,
) -> Result:
    """Write the model of a scene, adjusted if there are points, in formats that GDAL and every GIS read.

    Parameters
    ----------
    formats : sequence of str
        Some of `gcp_export.FORMATS`: rpc-txt, rpb, vrt, tag, gcp, gcp-tag, geolocation.
    force : bool
        Accept an RPC that stands for the model only to more than 0.1 px.

    Returns
    -------
    Result
        `document` says whether the RPC is exact, and the largest error of everything that is not.

    Raises
    ------
    InputError
        For an unknown format, a geolocation without heights, and as `fit`.
    """
    formats = gcp_export.check_formats(formats)
    stem = Path(image).stem
    files = {name: Path(folder) / f"{stem}{gcp_export.ENDINGS[name]}" for name in formats}
    inputs.check_paths(files, image, scene, points, surface)
    opened = open_adjustable(image, scene, points)
    heights = open_surface(surface, scene) if has_surface(surface) else None
    adjusted = adjust(opened, points, scene, heights)
    dataset = raster.open_dataset(image, **scene.access)
    size = opened.width, opened.height
    adjustment = adjusted.fit
    with completed(adjusted.scene.model_source, of="model"):
        if heights is not None:
            heights = footprint.facing(adjusted.model, heights, *size)
        job = gcp_export.Export(
            dataset, adjusted.model, size, heights, adjustment.points.select(adjustment.used), adjustment.rejected,
            force=force,
        )  # fmt: skip
        for name, path in files.items():
            job.write(name, path)
    document = {**job.document, "model": adjustment.model_name, "model_source": adjusted.scene.model_source}
    return Result(files, document, job.summary(adjustment.model_name, adjusted.scene.model_source))


@_outputs_together
def write_plots(report_file: str | os.PathLike[str], folder: str | os.PathLike[str], kind: str = "svg") -> Result:
    """Write the plots of a report again, each as a picture of its own.

    Parameters
    ----------
    report_file : path
        A ``<stem>_report.json``.
    kind : {'svg', 'png'}

    Raises
    ------
    InputError
        If it is no report, or PNG is asked for and matplotlib is not installed.
    """
    with completed(report_file, remedy="give a <stem>_report.json as it was written, or make it again"):
        document = report.read_report_json(report_file)
        stem = Path(report_file).stem
        files = report.write_plots(document, Path(folder), stem, kind)
    return Result(
        files, {}, f"{counted(len(files), 'plot')} of {Path(report_file).name.removesuffix(_ENDINGS['report'])}"
    )


@_outputs_together
def edge(
    image: str | os.PathLike[str],
    folder: str | os.PathLike[str] | None = None,
    *,
    edge: str | None = None,
    band: int = 1,
    allow_network: bool = False,
) -> Result:
    """Measure the effective resolution of an image from one edge, or from those that are found.

    Parameters
    ----------
    folder : path, optional
        Where the document and a plot of the typical edge go.
    edge : str, optional
        ``x1,y1,x2,y2``, columns and rows of its ends.

    Raises
    ------
    InputError
        If there is no such edge, or none is found.
    """
    given = None if edge is None else resolution.parse_edge(edge)
    found = resolution.measure(image, edge=given, band=band, allow_network=allow_network)
    document, stem = resolution.document(found, image, band), Path(image).stem
    files = (
        {}
        if folder is None
        else {"json": Path(folder) / f"{stem}_edges.json", "svg": Path(folder) / f"{stem}_edge.svg"}
    )
    if files:
        write_text(files["json"], json.dumps(document, indent=1, allow_nan=False) + "\n")
        write_text(files["svg"], resolution.plot(resolution.typical(found)).svg(alone=True) + "\n")
    return Result(files, document, resolution.text(document))


def dem_check(
    dem_file: str | os.PathLike[str],
    points: str | os.PathLike[str],
    *,
    crs: str | None = None,
    vertical: str | None = None,
    surface: SurfaceOptions = SurfaceOptions(),
    scene: SceneOptions = SceneOptions(),
) -> Result:
    """Compare a DEM with check heights, by the slope of the terrain.

    Parameters
    ----------
    points : path
        CSV or GeoJSON with x, y and h.
    crs, vertical : str, optional
        What they are in, where the file does not say it.
    surface : SurfaceOptions
        How the heights of the DEM are to be understood.

    Raises
    ------
    InputError
        If a file cannot be used, or no check point lies on the DEM.
    """
    heights = open_surface(replace(surface, dem=dem_file), scene)
    ground, plane, ids = dem_accuracy.read_check_heights(points, crs, vertical)
    found = dem_accuracy.check_dem(heights, ground, plane, ids)
    if not found.overall.count:
        raise InputError(
            f"none of the {counted(len(ids), 'check point')} has a height in this DEM", file=dem_file, field="--points",
            remedy="check the CRS of the points, and whether they lie on the DEM",
        )  # fmt: skip
    document = {
        "dem": str(dem_file), "check_points": str(points), "surface": dict(heights.provenance), **found.to_json()
    }  # fmt: skip
    return Result({}, document, dem_accuracy.summary(document))


def doctor() -> dict[str, Any]:
    """Return versions of GDAL, PROJ and the compiled parts, geoid grids, and plugins with their distributions.

    A plugin that breaks the contract, at which other commands stop, is among the broken ones here.
    """
    host = plugins.Host(installed=True, lenient=True)
    packages = ("ortho-pipeline", "numpy", "scipy", "numba", "pyproj", "click", "pluggy")
    allowed = [name for name in raster.DRIVERS if raster.gdal.GetDriverByName(name) is not None]
    return {
        "schema_version": SCHEMA_VERSION,
        "packages": {name: metadata.version(name) for name in packages},
        "gdal": {
            "version": raster.gdal.VersionInfo("RELEASE_NAME"),
            "bindings": raster.gdal.__version__,
            "drivers": allowed,
        },
        "proj": crs_module.proj_info(),
        "grids": crs_module.grids(),
        "plugins": [entry.to_json() for entry in host.plugins()],
        "sensors": list(host.sensors),
        "broken": [entry.to_json() for entry in host.broken],
        "cpus": os.cpu_count(),
    }


# -- parts -----------------------------------------------------------------------------------------------------------

_ENDINGS = {
    "ortho": "_ortho.tif",
    "model": "_model.json",
    "rpc": "_RPC.TXT",
    "vrt": ".vrt",
    "residuals": "_residuals.geojson",
    "style": "_residuals.qml",
    "report": "_report.json",
    "html": "_report.html",
    "stac": "_stac.json",
    "thumbnail": "_thumbnail.png",
    "overview": "_overview.png",
}
#: Outputs that are only made with a STAC item.
_STAC = ("stac", "thumbnail", "overview")


def _of_earlier_run(folder: Path, stem: str, files: Mapping[str, Path], *, all_of_them: bool) -> list[Path]:
    """Return what an earlier run wrote for this scene and this one does not, and side-cars of the ortho it wrote.

    Without its report, only `all_of_them` takes files of such names for its own.
    """
    ours = all_of_them
    if not ours:
        with contextlib.suppress(InputError):
            ours = bool(report.read_report_json(folder / f"{stem}{_ENDINGS['report']}"))
    left = [folder / f"{stem}{ending}" for ending in _ENDINGS.values()] if ours else []
    return [*(path for path in left if path not in files.values()), *inputs.old_side_cars(files["ortho"])]


def _as_rpc(model: SensorModel) -> tuple[rpc.RpcExport | None, list[str]]:
    """Return the model as RPC and what there is to say about it; None where no RPC stands for it."""
    try:
        exported = rpc.export_rpc(model)
    except InputError as error:
        return None, [f"no RPC files were written: {error.message}"]
    return exported, list(exported.warnings)


def _warp(
    model: SensorModel,
    exported: rpc.RpcExport | None,
    source: raster.RasterSource,
    surface: dem.Surface,
    grid: raster.Grid,
    path: Path,
    output: OutputOptions,
    progress: Callable[[float], None] | None,
) -> warp.WarpResult:
    from ortho_pipeline import warp  # the compiled kernels take a while to load: beside the checksums

    common: dict[str, Any] = {
        "resampling": output.resampling,
        "dem_interpolation": output.dem_interpolation,
        "memory": output.memory,
        "threads": output.threads,
        "driver": output.format,
        "creation_options": dict(output.creation_options),
        "profile": Profile.of(source, output.dtype, output.nodata),
        "progress": progress,
    }
    if output.engine == "ortho":
        return warp.rectify(model, source, surface, grid, path, tolerance=output.tolerance, **common)
    if output.engine != "gdal":
        raise InputError(f"no engine is called {output.engine!r}", field="--engine", remedy="ortho or gdal")
    return warp.rectify_gdal(model, exported, source, surface, grid, path, **common)


def _write_models(
    model: SensorModel,
    exported: rpc.RpcExport | None,
    scene: Scene,
    dataset: raster.gdal.Dataset,
    files: dict[str, Path],
    provenance: Mapping[str, Any],
) -> None:
    """Write the model in every format; what cannot be written is taken out of `files`."""
    size = scene.width, scene.height
    write_model_file(SavedModel(model, scene.sensor, scene.model_source, size, provenance), files["model"])
    if exported is None:
        del files["rpc"], files["vrt"]
        return
    rpc.write_rpc_txt(exported.rpc, files["rpc"])
    rpc.write_vrt(dataset, exported.rpc, files["vrt"])


def _write_report(document: Mapping[str, Any], fit: Fit, files: dict[str, Path]) -> None:
    """Write report and residuals; without points there are no residuals, and they are taken out of `files`."""
    if len(fit.points):
        write_text(files["residuals"], json.dumps(report.residuals_geojson(fit), allow_nan=False))
        write_text(files["style"], report.residuals_style(document))
    else:
        del files["residuals"], files["style"]
    report.write_report_json(document, files["report"])
    report.write_report_html(document, files["html"], ortho=staged(files["ortho"]) if "ortho" in files else None)


def crs_text(crs: pyproj.CRS) -> str:
    """Return ``EPSG:n`` where there is such a code, the name otherwise."""
    authority = crs.to_authority()
    return ":".join(authority) if authority else crs.name


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
