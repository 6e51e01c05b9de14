"""Facts about a scene, an image, a DEM, a sensor and this machine: `ortho info`, `edge`, `sensors`, `doctor`, ..."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
import traceback
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline import errors, host
from ortho_pipeline.commands.heights.opening import dem_as_stated
from ortho_pipeline.commands.inputs import open_image, open_scene
from ortho_pipeline.commands.results import ENDINGS, SCHEMA_VERSION, Result, outputs_together
from ortho_pipeline.commands.stac.given import heights_given, with_items
from ortho_pipeline.commands.survey.map_raster import described, is_upright, kind_of
from ortho_pipeline.display.notices import to_document
from ortho_pipeline.errors import InputError, OrthoError, PluginError, completed
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.ground_residuals import viewing
from ortho_pipeline.files import write_json, write_text
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.files.locations import located
from ortho_pipeline.files.shell import typed
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.naming import crs_text
from ortho_pipeline.geodesy.proj_grids import fetch_missing, grids, proj_info
from ortho_pipeline.hookspecs import Scene, Sensor
from ortho_pipeline.host.discovery import require_declared
from ortho_pipeline.host.unread import unread
from ortho_pipeline.imaging import resolution
from ortho_pipeline.models import families
from ortho_pipeline.options import SceneOptions, SurfaceOptions
from ortho_pipeline.raster import source as raster
from ortho_pipeline.report import document as report
from ortho_pipeline.runtime.compiled import COMPILER
from ortho_pipeline.stores import local_cache
from ortho_pipeline.surface import accuracy as dem_accuracy
from ortho_pipeline.surface import footprint
from ortho_pipeline.surface.cells.copernicus import extent_of
from ortho_pipeline.testing import check_sensor


def sensors() -> dict[str, Any]:
    """List the installed sensors, where each comes from, and the plugins that are broken."""
    plugins = host.Host.discover()
    listed = [
        {
            "name": sensor.name,
            "description": sensor.description,
            "options": dict(sensor.options),
            "distribution": plugins.provenance(name).distribution,
            "version": plugins.provenance(name).version,
        }
        for name, sensor in plugins.sensors.items()
    ]
    return {
        "schema_version": SCHEMA_VERSION,
        "sensors": listed,
        "broken": json_value(plugins.broken),
    }


def sensor_test(
    name: str, image: str | os.PathLike[str] | None, options: SceneOptions = SceneOptions()
) -> dict[str, Any]:
    """Check the contract of plugins (`testing.check_sensor`) for an installed sensor and an image of it.

    Parameters
    ----------
    name : str
        Name of the sensor, or of its plugin, module or distribution if that has one sensor.
    image : path or None
        None is an error with the command to type, after the name was checked.
    options : SceneOptions
        Only `sensor_options` are used.

    Raises
    ------
    InputError
        If no or several sensors have this name, the image cannot be opened, or the sensor says that it is damaged.
    PluginError
        With the requirement of the contract that fails, or with the exception of the plugin and its line.
    """
    plugins = host.Host.discover()
    sensor = _sensor_named(name, plugins)
    if image is None:
        raise InputError(
            f"an image of the sensor {sensor.name!r} is missing",
            field="test",
            remedy=f"name it: `ortho sensors --test {sensor.name} IMAGE`",
        )
    origin = plugins.provenance(sensor.name)
    require_declared(sensor, options.sensor_options, image)
    again = f"ortho sensors --test {sensor.name} {typed(image)}"
    remedy = f"correct the plugin, or give an image of its sensor; then test again: `{again}`"
    with _contract_of(sensor, remedy):
        scene = check_sensor(sensor, image, **options.sensor_options)
        recognised = sensor.recognises(raster.open_dataset(image))
    return {
        "schema_version": SCHEMA_VERSION,
        "sensor": sensor.name,
        "plugin": origin.plugin,
        "distribution": origin.distribution,
        "version": origin.version,
        "image": str(image),
        "sensor_options": dict(options.sensor_options),
        "recognised": recognised,
        "size": [scene.width, scene.height],
        "models": {key: model.kind for key, model in scene.models.items()},
        "model_source": str(scene.model_source),
        "facts": json_value(scene.facts),
    }


def _sensor_named(name: str, plugins: host.Host) -> Sensor:
    """Return the sensor of this name, or the only one of the plugin, module or distribution of this name."""
    if name in plugins.sensors:
        return plugins.sensors[name]
    wanted = _comparable(name)
    for broken in plugins.broken:
        if wanted in {_comparable(broken.plugin), _comparable(broken.distribution)}:
            raise PluginError(
                f"the plugin cannot be imported ({broken.error})",
                field=broken.plugin,
                remedy="correct its module, then test it again",
            )
    named = []
    for sensor in plugins.sensors.values():
        origin = plugins.provenance(sensor.name)
        if wanted in {_comparable(text) for text in (origin.plugin, origin.module, origin.distribution)}:
            named.append(sensor)
    if len(named) == 1:
        return named[0]
    if named:
        names = ", ".join(sensor.name for sensor in named)
        raise InputError(
            f"{name!r} has several sensors: {names}",
            field="test",
            remedy=f"name one of them: `ortho sensors --test {named[0].name} IMAGE`",
        )
    raise InputError(
        f"no installed sensor or plugin has the name {name!r}",
        field="test",
        remedy="list the names with `ortho sensors`; a plugin is listed when its package is installed",
    )


def _comparable(name: str) -> str:
    """Return the name of a distribution as indexes compare it."""
    return name.lower().replace("_", "-").replace(".", "-")


@contextlib.contextmanager
def _contract_of(sensor: Sensor, remedy: str) -> Iterator[None]:
    """Turn a failed requirement, and any exception of the plugin, into a `PluginError` of the plugin's file."""
    if not __debug__:
        raise InputError("Python ignores assertions, so it cannot check the contract", remedy="unset PYTHONOPTIMIZE")
    try:
        yield
    except OrthoError:
        raise
    except (Exception, SystemExit) as error:
        *_, (frame, _line) = traceback.walk_tb(error.__traceback__)
        of_contract = isinstance(error, AssertionError) and frame.f_globals["__name__"] == check_sensor.__module__
        text = str(error) if of_contract else f"the plugin failed ({errors.described(error, sensor.open_scene)})"
        file = getattr(sys.modules.get(getattr(sensor.open_scene, "__module__", "")), "__file__", None)
        raise PluginError(text, file=file, field=sensor.name, remedy=remedy) from error


def formats() -> dict[str, str]:
    """Return the formats that models are written in, by name, each with its title; broken plugins are left out."""
    return {name: file_format.title for name, file_format in host.Host(installed=True, lenient=True).formats.items()}


def block_formats() -> dict[str, str]:
    """Return the programs that take all images of a block, by name, each with its title; as `formats`."""
    offers = host.Host(installed=True, lenient=True).block_formats
    return {name: offer.title for name, offer in offers.items()}


@with_items
def info(image: str | os.PathLike[str], options: SceneOptions = SceneOptions()) -> dict[str, Any]:
    """Describe a scene: sensor, size, models and their source, facts, position and ground sample distance.

    Of a DEM or an ortho, which no sensor opens: what it seems to be, its place on the map, and which option takes it.
    """
    if (seen := _on_a_map(image, options)) is not None:
        return seen
    scene = open_scene(image, options)
    model = scene.model
    size = scene.width, scene.height
    with completed(scene.model_source, of="model"):
        crs = footprint.output_crs(model, *size)
        gsd = footprint.ground_sample_distance(model, crs, *size)
    corners = np.array([[0.0, 0.0], [size[0], 0.0], [size[0], size[1]], [0.0, size[1]]])
    to_geographic = ground_transform(model.crs, "EPSG:4979")
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
        "corners_lon_lat": json_value(ground[:, :2]),
        "facts": json_value(scene.facts),
        "same_acquisition": [Path(piece.path).name for piece in scene.pieces],
        **to_document(scene.notices),
    }


def _on_a_map(image: str | os.PathLike[str], options: SceneOptions) -> dict[str, Any] | None:
    """Return the document of a DEM or an ortho; None for a possible scene."""
    if isinstance(image, Scene) or dataclasses.replace(options, allow_network=False, roots=()) != SceneOptions():
        return None
    if os.path.isdir(image):
        return None
    dataset = raster.open_dataset(image, **options.access)
    if kind_of(dataset) is None or open_image(image, options, needs_model=False).models:
        return None
    # What stands askew on a map may be a frame that was laid there roughly.
    return described(image, dataset) if is_upright(dataset) or unread(dataset) is None else None


def models() -> list[dict[str, Any]]:
    """List the classical model families, simple to complex, and what a scene's own model can be corrected by."""
    return [family.to_json() for family in families()]


@outputs_together
def write_plots(
    report_file: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    kind: str = "svg",
    *,
    allow_network: bool = False,
) -> Result:
    """Write the plots of a report again, each as a picture of its own.

    Parameters
    ----------
    report_file : path
        A ``<stem>_report.json``.
    kind : {'svg', 'png'}

    Raises
    ------
    InputError
        If it is not a report, or PNG is requested without matplotlib.
    """
    with completed(report_file, remedy="give an unmodified <stem>_report.json, or make the report again"):
        document = report.read_report(located(report_file, allow_network=allow_network))
        stem = Path(report_file).stem
        files = report.write_plots(document, Path(folder), stem, kind)
    return Result(
        files, {}, f"{counted(len(files), 'plot')} of {Path(report_file).name.removesuffix(ENDINGS['report'])}"
    )


@outputs_together
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
    ends = None if edge is None else resolution.parse_edge(edge)
    result = resolution.measure(image, edge=ends, band=band, allow_network=allow_network)
    document, stem = resolution.document(result, image, band), Path(image).stem
    files = (
        {}
        if folder is None
        else {"json": Path(folder) / f"{stem}_edges.json", "svg": Path(folder) / f"{stem}_edge.svg"}
    )
    if files:
        write_json(files["json"], document)
        write_text(files["svg"], resolution.plot(resolution.typical(result)).svg(alone=True) + "\n")
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
        CRS and datum of the points, if the file does not state them.
    surface : SurfaceOptions
        Height datum of the DEM.

    Raises
    ------
    InputError
        If a file cannot be used, or no check point lies on the DEM.
    """
    ground, plane, ids = dem_accuracy.read_check_heights(points, crs, vertical)
    extent = extent_of(ground_transform(plane, "EPSG:4979")(ground)[:, :2])
    heights = dem_as_stated(heights_given(dem_file, scene), surface, scene, extents=[] if extent is None else [extent])
    result = dem_accuracy.check_dem(heights, ground, plane, ids)
    if not result.overall.count:
        raise InputError(
            f"none of the {counted(len(ids), 'check point')} has a height in this DEM",
            file=dem_file,
            field="points",
            remedy="check the CRS of the points and the extent of the DEM",
        )
    document = {
        "dem": str(dem_file),
        "check_points": str(points),
        "surface": dict(heights.provenance),
        **result.to_json(),
    }
    return Result({}, document, dem_accuracy.summary(document))


def doctor(*, fetch_grids: bool = False) -> dict[str, Any]:
    """Return versions of GDAL, PROJ and the compiled parts, geoid grids, and plugins with their distributions.

    A plugin that breaks the contract, at which other commands stop, is among the broken ones here. With `fetch_grids`
    those that are missing are fetched from PROJ's store before.
    """
    fetched = fetch_missing() if fetch_grids else []
    plugins = host.Host(installed=True, lenient=True)
    packages = ("ortho-pipeline", "numpy", "scipy", COMPILER, "pyproj", "click", "pluggy")
    allowed = [name for name in raster.DRIVERS if raster.gdal.GetDriverByName(name) is not None]
    return {
        "schema_version": SCHEMA_VERSION,
        "packages": {name: metadata.version(name) for name in packages},
        "gdal": {
            "version": raster.gdal.VersionInfo("RELEASE_NAME"),
            "bindings": raster.gdal.__version__,
            "drivers": allowed,
            "missing_drivers": [name for name in raster.DRIVERS if name not in allowed],
        },
        "proj": proj_info(),
        "grids": grids(),
        "fetched": fetched,
        "plugins": json_value(plugins.plugins()),
        "sensors": list(plugins.sensors),
        "formats": list(plugins.formats),
        "broken": json_value(plugins.broken),
        "cpus": os.cpu_count(),
    }


def kept_files(*, verify: bool = False) -> dict[str, Any]:
    """Return the cached downloads: folder, and address, path, bytes and SHA-256 of each.

    With `verify` also their state: sound, damaged, of another size, missing.
    """
    files = [
        {"address": record.address, "path": str(record.path), "bytes": record.bytes, "sha256": record.sha256}
        | ({"state": record.state()} if verify else {})
        for record in local_cache.records()
    ]
    return {"schema_version": SCHEMA_VERSION, "folder": str(local_cache.folder()), "files": files}


def forget_kept_files() -> dict[str, Any]:
    """Delete the cached downloads; return their number and bytes."""
    count, size = local_cache.clear()
    return {"schema_version": SCHEMA_VERSION, "folder": str(local_cache.folder()), "files": count, "bytes": size}
