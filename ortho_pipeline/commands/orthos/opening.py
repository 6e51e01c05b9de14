"""A finished ortho as a scene: a raster on a map that no sensor recognises, whose model is the map grid."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline import host
from ortho_pipeline.errors import CrsError, InputError, completed
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.locations import located
from ortho_pipeline.files.shell import typed
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs
from ortho_pipeline.geodesy.naming import crs_definition
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import MapGrid
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.raster.valid_area import sampled_mask

#: Name of the "sensor" of a finished ortho.
ORTHO = "ortho"
#: Items of vendors' metadata that state the level of a product, and how the levels of raw scenes begin.
_LEVELS = ("productLevel", "PROCESSING_LEVEL", "Processing Level", "productType")
#: Where metadata state the time of acquisition: domain and item.
_ACQUIRED = (("IMAGERY", "ACQUISITIONDATETIME"), ("", "PRODUCT_START_TIME"), ("", "DATE_ACQUIRED"))
_RAW = ("LV1", "LV2", "SENSOR", "PRIMARY", "BASIC", "STANDARD GEOMETRICALLY", "L1A", "L1B", "1A", "1B")


def filled_of(scene: Scene, options: SceneOptions, cells: int) -> Array:
    """Return the shares ``(cells, cells)`` of pixels that have a value, in cells along rows and columns.

    They come from a sample of 8 x 8 pixels of each cell.
    """
    source, side = RasterSource(scene.path, **options.access), 8 * cells  # a band needs its dataset
    return np.asarray(sampled_mask(source.bands, side, side).reshape(cells, 8, cells, 8).mean(axis=(1, 3)))


def open_ortho(image: str | os.PathLike[str] | Scene, options: SceneOptions, *, only: bool = True) -> Scene:
    """Open a finished ortho.

    Parameters
    ----------
    only : bool
        Refuse an image that a sensor recognises. Otherwise its sensor opens it.

    Raises
    ------
    CrsError
        If the image has no CRS or no georeference.
    InputError
        If it is a raw scene, or options give another model.
    """
    if isinstance(image, Scene):
        return image
    for name in ("sensor", "rpc", "model", "crop_offset"):
        if getattr(options, name) is not None:
            raise InputError(
                Text(
                    "the model of a finished ortho is its map grid; ", Setting(f"scene.{name}"), " gives another model"
                ),
                field=f"scene.{name}",
                remedy="leave out one of the two",
            )
    plugins = host.Host.discover()
    dataset = plugins.open_image(image, **options.access)
    known = [sensor.name for sensor in plugins.sensors.values() if sensor.recognises(dataset)]
    if known and not only:
        return plugins.open_scene(image, None, dict(options.sensor_options), **options.access)
    _refuse_raw(dataset, image, known)
    size = dataset.RasterXSize, dataset.RasterYSize
    path = located(image, allow_network=options.allow_network)
    return Scene(ORTHO, path, *size, {MapGrid.kind: _grid_of(dataset, image, size)}, str(image), _facts(dataset))


def _facts(dataset: Any) -> dict[str, str]:
    """Return when an ortho was acquired, if its metadata state that."""
    items = [(dataset.GetMetadata(domain) or {}).get(name) for domain, name in _ACQUIRED]
    return next(({"acquired": text} for text in items if text), {})


def _grid_of(dataset: Any, image: str | os.PathLike[str], size: tuple[int, int]) -> MapGrid:
    """Return the model of a raster on a map.

    Raises
    ------
    CrsError
        If it is not on a map.
    """
    text, transform = dataset.GetProjection(), dataset.GetGeoTransform(can_return_null=True)
    if not text or transform is None:
        missing = "CRS" if transform is not None else "georeference"
        raise CrsError(
            f"this image has no {missing}, so it is not a finished ortho",
            file=image,
            field="image",
            remedy="rectify a raw scene first; if it is an ortho, set its place: "
            f"`gdal_edit.py -a_srs EPSG:CODE -a_ullr WEST NORTH EAST SOUTH {typed(image)}`",
        )
    with completed(image, field="image"):
        crs = horizontal(parse_crs(text))
        # Refuse a CRS of unknown datum here, with the name of the file.
        ground_transform("EPSG:4979", crs)
        return MapGrid(crs_definition(crs), tuple(transform), size)


def _refuse_raw(dataset: Any, image: str | os.PathLike[str], known: list[str]) -> None:
    """Refuse a raw scene: one with a model of its own, or whose metadata say so.

    Raises
    ------
    InputError
        With the reason.
    """
    why = ""
    if known:
        why = f"the sensor {known[0]!r} opens it as a raw scene"
    elif dataset.GetMetadata("RPC"):
        why = "it has an RPC"
    elif dataset.GetGCPCount() or dataset.GetMetadata("GEOLOCATION"):
        why = "it has ground control points or geolocation arrays instead of a map grid"
    else:
        for domain in ("", "IMD", "IMAGERY"):
            said = dataset.GetMetadata(domain) or {}
            level = next((str(said[name]) for name in _LEVELS if name in said), "")
            if level.strip('"; ').upper().startswith(_RAW):
                why = f"its metadata state the processing level {level}"
    if why:
        raise InputError(
            f"{Path(image).name} is not a finished ortho: {why}",
            file=image,
            field="image",
            remedy=f"make its ortho first: `ortho rectify {typed(image)} --dem DEM -o out`; "
            "if it is an ortho, delete the old RPC or metadata files",
        )
