"""The guts of each command: paths in, paths out.

Every function here takes options, does the work and returns a result with `to_json`; printing is left to `cli`.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from ortho_pipeline import crs as crs_module
from ortho_pipeline import dem, footprint, plugins, raster, report, rpc, warp
from ortho_pipeline.crs import Vertical, parse_crs
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation import Fit
from ortho_pipeline.estimation import fit as fit_model
from ortho_pipeline.files import sha256, write_text
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.model_file import SavedModel, read_model_file, write_model_file
from ortho_pipeline.models import ImageCorrection, SensorModel
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points, assign_roles, gcps_of_dataset, read_points
from ortho_pipeline.swaps import refuse_swapped

SCHEMA_VERSION = 1
#: Side-cars that GDAL would attach to an image of this stem, whatever the image itself says.
SIDE_CARS = ("_RPC.TXT", "_rpc.txt", ".RPB", ".rpb", "_metadata.txt", ".IMD")
#: In place of a file of points: the ground control points that the image itself holds.
OWN_POINTS = "own"
FORMATS = ("rpctxt", "rpb", "vrt", "tif")


# -- results ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FitResult:
    """A scene and what was adjusted to its points."""

    scene: Scene
    fit: Fit
    warnings: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``ortho fit --json`` (docs/formats.md)."""
        document = self.fit.to_json()
        document["warnings"] = list(self.warnings)
        return {
            "schema_version": SCHEMA_VERSION,
            "sensor": self.scene.sensor,
            "model": document.pop("model"),
            "model_source": self.scene.model_source,
            **document,
        }


@dataclass(frozen=True)
class Result:
    """Files that a command wrote, what it says about them, and a summary for people."""

    files: Mapping[str, Path]
    document: Mapping[str, Any]
    summary: str

    def to_json(self) -> dict[str, Any]:
        """Return files and document as JSON values."""
        files = {name: str(path) for name, path in self.files.items()}
        return {"schema_version": SCHEMA_VERSION, "files": files, **self.document}


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
    crs = footprint.output_crs(model, *size)
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
        "gsd_m": footprint.ground_sample_distance(model, crs, *size),
        "corners_lon_lat": [[_number(value) for value in row] for row in ground[:, :2]],
        "facts": dict(scene.facts),
        "warnings": list(scene.warnings),
    }


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
    opened = open_scene(image, scene)
    heights = open_surface(surface, scene.allow_network) if _is_given(surface) else None
    adjusted = _adjust(opened, points, scene, heights)
    return FitResult(opened, adjusted, _warnings(opened, adjusted, heights))


def rectify(
    image: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    output: OutputOptions = OutputOptions(),
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Make the orthoimage of a scene, its adjusted model in every format, and the accuracy report.

    Nothing is written before all that can be checked is checked.

    Returns
    -------
    Result
        `files` has ortho, model, rpc, vrt, residuals (with points only), report and html.

    Raises
    ------
    InputError
        For whatever the user can correct: no heights, a DEM that does not cover the scene, a path that is read and
        written, an old side-car that would attach to the ortho.
    """
    stem = Path(image).stem
    files = {name: Path(folder) / f"{stem}{ending}" for name, ending in _RECTIFIED.items()}
    _check_paths(files, image, scene, points, surface)
    if not _is_given(surface):
        raise InputError(
            "an orthoimage needs heights",
            field="--dem",
            remedy="give --dem FILE, or --height METRES above the ellipsoid for flat ground",
        )
    opened = open_scene(image, scene)
    heights = open_surface(surface, scene.allow_network)
    adjusted = _adjust(opened, points, scene, heights)
    model = _result_of(adjusted)
    share = footprint.coverage(model, heights, opened.width, opened.height)
    footprint.require_coverage(share, heights)
    crs = parse_crs(output.crs) if output.crs else None
    size = opened.width, opened.height
    grid = footprint.choose_grid(model, heights, size, crs=crs, resolution=output.resolution, extent=output.extent)
    exported = rpc.export_rpc(model)
    source = raster.RasterSource(image, allow_network=scene.allow_network)
    warped = _warp(model, exported, source, heights, grid, files["ortho"], output, progress)
    provenance = _provenance(image, opened, points, heights)
    _write_models(model, exported, opened, source, files, {**provenance, "adjustment": adjusted.to_json()})
    document = report.build_report(
        scene=opened, fit=adjusted, exported=exported, surface=heights, coverage=share, grid=grid, warp=warped,
        provenance=provenance, warnings=[*_warnings(opened, adjusted, heights), *exported.warnings],
    )  # fmt: skip
    if len(adjusted.points):
        write_text(files["residuals"], json.dumps(report.residuals_geojson(adjusted), allow_nan=False))
    else:
        del files["residuals"]
    report.write_report_json(document, files["report"])
    report.write_report_html(document, files["html"], ortho=files["ortho"])
    return Result(files, {"report": document}, report.summary_text(document))


def export(
    image: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    formats: Sequence[str] = FORMATS,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
) -> Result:
    """Write the model of a scene, adjusted if there are points, as RPC text, RPB, VRT and tagged GeoTIFF.

    Returns
    -------
    Result
        `document` says whether the RPC is exact, and its largest error in pixels if it is not.
    """
    unknown = sorted(set(formats) - set(FORMATS))
    if unknown:
        raise InputError(
            f"no format is called {', '.join(unknown)}", field="--as", remedy=f"one of {', '.join(FORMATS)}"
        )
    stem = Path(image).stem
    endings = {"rpctxt": "_RPC.TXT", "rpb": ".RPB", "vrt": ".vrt", "tif": "_rpc.tif"}
    files = {name: Path(folder) / f"{stem}{endings[name]}" for name in formats}
    _check_paths(files, image, scene, points, surface)
    opened = open_scene(image, scene)
    heights = open_surface(surface, scene.allow_network) if _is_given(surface) else None
    model = _result_of(_adjust(opened, points, scene, heights))
    exported = rpc.export_rpc(model)
    dataset = raster.open_dataset(image, allow_network=scene.allow_network)
    writers: dict[str, Callable[[Path], object]] = {
        "rpctxt": lambda path: rpc.write_rpc_txt(exported.rpc, path),
        "rpb": lambda path: rpc.write_rpb(exported.rpc, path),
        "vrt": lambda path: rpc.write_vrt(dataset, exported.rpc, path),
        "tif": lambda path: rpc.write_tagged_copy(dataset, exported.rpc, path),
    }
    for name, path in files.items():
        writers[name](path)
    document = {"exact": exported.exact, "max_error_px": exported.max_error_px, "model_source": opened.model_source}
    how = "exact" if exported.exact else f"refitted, at most {exported.max_error_px:.2g} px off"
    return Result(files, document, f"RPC of {opened.model_source}: {how}")


def doctor() -> dict[str, Any]:
    """Return versions of GDAL, PROJ and the compiled parts, geoid grids, and plugins with their distributions."""
    host = plugins.Host.discover()
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

_RECTIFIED = {
    "ortho": "_ortho.tif",
    "model": "_model.json",
    "rpc": "_RPC.TXT",
    "vrt": ".vrt",
    "residuals": "_residuals.geojson",
    "report": "_report.json",
    "html": "_report.html",
}


def open_scene(image: str | os.PathLike[str], options: SceneOptions = SceneOptions()) -> Scene:
    """Open an image with its sensor, or with the model of a model file.

    Raises
    ------
    InputError
        If no sensor recognises the image, or the model file belongs to an image of another size.
    """
    if options.model is None:
        given = {} if options.rpc is None else {"rpc": options.rpc}
        return plugins.open_scene(image, options.sensor, given, allow_network=options.allow_network)
    if options.rpc is not None or options.sensor is not None:
        raise InputError(
            "a model file takes the place of the image's model", field="--model", remedy="leave out --rpc and --sensor"
        )
    dataset = raster.open_dataset(image, allow_network=options.allow_network)
    saved = read_model_file(options.model)
    size = dataset.RasterXSize, dataset.RasterYSize
    if saved.size is not None and saved.size != size:
        raise InputError(
            f"this model is of an image of {saved.size[0]} x {saved.size[1]} pixels, {Path(image).name} has "
            f"{size[0]} x {size[1]}",
            file=options.model,
            field="size",
            remedy="give the model file of this image",
        )
    return Scene(
        sensor=saved.sensor or "model file", path=image, width=size[0], height=size[1],
        models={saved.model.kind: saved.model}, model_source=str(options.model),
        facts={"delivered_model_source": saved.model_source} if saved.model_source else {},
    )  # fmt: skip


def open_surface(options: SurfaceOptions, allow_network: bool = False) -> dem.Surface:
    """Open the DEM, or make a surface of one height.

    Raises
    ------
    InputError
        If both or neither are given, or a rule is unknown.
    """
    if options.dem is not None and options.height is not None:
        raise InputError("--dem and --height exclude each other", field="--height", remedy="give one of them")
    if options.height is not None:
        return dem.Surface.constant(options.height)
    if options.dem is None:
        raise InputError("there are no heights", field="--dem", remedy="give --dem FILE or --height METRES")
    vertical = None if options.vertical is None else Vertical.parse(options.vertical)
    return dem.Surface.open(
        options.dem, vertical, override=options.override_vertical, fill=options.fill,
        allow_network=allow_network,
    )  # fmt: skip


def _is_given(options: SurfaceOptions) -> bool:
    return options.dem is not None or options.height is not None


def _adjust(scene: Scene, options: PointOptions, opened: SceneOptions, surface: dem.Surface | None) -> Fit:
    """Return the adjustment; without points one in which nothing was adjusted."""
    points = _read(scene, options, opened.allow_network)
    refuse_swapped(scene.model, points, scene.height)
    points = _with_heights(points, surface)
    correction = options.correction
    if correction is None:
        correction = "shift" if points.control.any() and opened.model is None else "none"
    elif correction != "none" and opened.model is not None:
        raise InputError(
            "a model file is an adjusted model: adjusting it again would count points twice",
            field="--correction",
            remedy="adjust the scene's own model with all points (leave out --model)",
        )
    start = ImageCorrection.identity(scene.model, correction, (scene.width / 2, scene.height / 2))
    name = scene.model.kind if correction == "none" else f"{scene.model.kind}+{correction}"
    return fit_model(start, points, robust=correction != "none", name=name)


def _result_of(adjusted: Fit) -> SensorModel:
    """Return the adjusted model without a correction that corrects nothing."""
    model = adjusted.model
    return model.model if isinstance(model, ImageCorrection) and model.correction == "none" else model


def _read(scene: Scene, options: PointOptions, allow_network: bool) -> Points:
    if options.gcps is None:
        if options.correction not in (None, "none"):
            raise InputError(
                f"a {options.correction} needs control points", field="--gcps", remedy="give a file of points"
            )
        return _no_points()
    if os.fspath(options.gcps) == OWN_POINTS:
        points = gcps_of_dataset(raster.open_dataset(scene.path, allow_network=allow_network))
    else:
        points = read_points(
            options.gcps,
            crs=None if options.crs is None else parse_crs(options.crs),
            vertical=None if options.vertical is None else Vertical.parse(options.vertical),
            pixel_origin=options.pixel_origin,
            image_name=Path(scene.path).name,
        )
    return points if options.check is None else assign_roles(points, options.check)


def _no_points() -> Points:
    none = np.zeros(0)
    return Points(
        ids=(), image=np.zeros((0, 2)), ground=np.zeros((0, 3)), roles=np.zeros(0, dtype="<U7"), sigma_image=none,
        sigma_ground=np.zeros((0, 3)), crs=pyproj.CRS.from_epsg(4326), source="",
    )  # fmt: skip


def _with_heights(points: Points, surface: dem.Surface | None) -> Points:
    """Fill heights that a file does not give from the surface."""
    missing = ~np.isfinite(points.ground[:, 2])
    if not missing.any():
        return points
    if surface is None:
        names = ", ".join(np.array(points.ids)[missing][:5])
        raise InputError(
            f"{int(missing.sum())} points have no height ({names})", file=points.source, field="h",
            remedy="give heights in the file, or a DEM with --dem to take them from",
        )  # fmt: skip
    ground = points.ground.copy()
    ground[missing, 2] = surface.heights(ground[missing, :2], points.crs)
    return points.with_ground(ground)


def _warnings(scene: Scene, adjusted: Fit, surface: dem.Surface | None) -> tuple[str, ...]:
    """Return what people ought to know before they trust the numbers."""
    found = [*scene.warnings, *adjusted.warnings]
    if surface is not None:
        found += surface.provenance.get("warnings", [])
    points = adjusted.points
    found += [f"point {name} was left out: {reason}" for name, reason in adjusted.rejected]
    inside = ((points.image >= 0) & (points.image <= (scene.width, scene.height))).all(axis=1)
    if not inside.all():
        outside = ", ".join(np.array(points.ids)[~inside])
        found.append(f"points outside of the image (used all the same): {outside}")
    if adjusted.used.any() and len(adjusted.param_names) and adjusted.redundancy == 0:
        found.append("no redundancy: the RMSE of the control points is zero by construction and says nothing")
    checks = int(points.check.sum())
    if len(points) and checks < 30:
        found.append(f"{checks} check points: fewer than the 30 that ASPRS 2023 asks for before accuracy is claimed")
    return tuple(dict.fromkeys(found))


def _check_paths(
    files: Mapping[str, Path],
    image: str | os.PathLike[str],
    scene: SceneOptions,
    points: PointOptions,
    surface: SurfaceOptions,
) -> None:
    """Refuse to write what is read, and outputs that change the model of the source or of the ortho."""
    given = (image, scene.model, scene.rpc, points.gcps, surface.dem)
    inputs = {Path(path).resolve() for path in given if path is not None}
    for path in files.values():
        if path.resolve() in inputs:
            raise InputError(
                "this path would be read and written", file=path, field="-o", remedy="choose another output folder"
            )
    folder = next(iter(files.values())).parent
    if folder.resolve() == Path(image).resolve().parent:
        raise InputError(
            "the RPC files written here would attach to the source image and change its model", file=folder,
            field="-o", remedy="choose an output folder of its own",
        )  # fmt: skip
    if "ortho" in files:
        for ending in SIDE_CARS:
            stale = files["ortho"].with_name(files["ortho"].stem + ending)
            if stale.exists():
                raise InputError(
                    "an old side-car lies here that GDAL would attach to the ortho", file=stale,
                    remedy="remove it, or choose another output folder",
                )  # fmt: skip


def _warp(
    model: SensorModel,
    exported: rpc.RpcExport,
    source: raster.RasterSource,
    surface: dem.Surface,
    grid: raster.Grid,
    path: Path,
    output: OutputOptions,
    progress: Callable[[float], None] | None,
) -> warp.WarpResult:
    common: dict[str, Any] = {
        "resampling": output.resampling,
        "memory": output.memory,
        "threads": output.threads,
        "driver": output.format,
        "creation_options": dict(output.creation_options),
        "progress": progress,
    }
    if output.engine == "ortho":
        return warp.rectify(model, source, surface, grid, path, tolerance=output.tolerance, **common)
    if output.engine != "gdal":
        raise InputError(f"no engine is called {output.engine!r}", field="--engine", remedy="ortho or gdal")
    return warp.rectify_gdal(rpc.rpc_metadata(exported.rpc), source, surface, grid, path, **common)


def _provenance(
    image: str | os.PathLike[str], scene: Scene, points: PointOptions, surface: dem.Surface
) -> dict[str, Any]:
    control = None
    if points.gcps is not None and os.fspath(points.gcps) != OWN_POINTS:
        control = {**dataclasses.asdict(points), "gcps": str(points.gcps), "sha256": sha256(points.gcps)}
    elif points.gcps is not None:
        control = {**dataclasses.asdict(points), "gcps": OWN_POINTS}
    return {
        "image": {"path": str(image), "size": [scene.width, scene.height]},
        "sensor": scene.sensor,
        "model_source": scene.model_source,
        "points": control,
        "surface": dict(surface.provenance),
        "software": {
            "ortho-pipeline": metadata.version("ortho-pipeline"),
            "gdal": raster.gdal.VersionInfo("RELEASE_NAME"),
            "proj": pyproj.proj_version_str,
        },
    }


def _write_models(
    model: SensorModel,
    exported: rpc.RpcExport,
    scene: Scene,
    source: raster.RasterSource,
    files: Mapping[str, Path],
    provenance: Mapping[str, Any],
) -> None:
    size = scene.width, scene.height
    write_model_file(SavedModel(model, scene.sensor, scene.model_source, size, provenance), files["model"])
    rpc.write_rpc_txt(exported.rpc, files["rpc"])
    rpc.write_vrt(source.dataset, exported.rpc, files["vrt"])


def crs_text(crs: pyproj.CRS) -> str:
    """Return ``EPSG:n`` where there is such a code, the name otherwise."""
    authority = crs.to_authority()
    return ":".join(authority) if authority else crs.name


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
