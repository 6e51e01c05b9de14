"""Sensor plugin for Maxar (Vantor): WorldView 1 to 4, GeoEye-1, QuickBird, from their ISD XML; tiles and parts too."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from osgeo import gdal

from ortho_maxar.isd import Isd, Tile, read_isd_pushbroom
from ortho_maxar.layout import colours_beside, cut, metadata_of, parts_beside, tile_of, tiles_beside
from ortho_pipeline.plugin import (
    RPC,
    InputError,
    Notice,
    Pushbroom,
    Scene,
    Sensor,
    SensorModel,
    has_rpc,
    hookimpl,
    place,
    require_same_rpc,
    rpc_of_dataset,
)

#: If rigorous model and RPC differ by more (px), warn; if by more than the second value, they are of different images.
APART, DISAGREEMENT = 5.0, 100.0


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``maxar``."""
    yield Sensor(
        "maxar",
        "WorldView 1 to 4, GeoEye-1, QuickBird with ISD XML: image, tile, part of a strip, or .TIL of all tiles",
        recognises,
        open_scene,
        options={"rpc": "which RPC to use: tag, sidecar, or an RPC file; default: that of the XML"},
    )


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether there is ISD XML next to an image."""
    return metadata_of(dataset.GetDescription()) is not None


def open_scene(dataset: gdal.Dataset, *, rpc: str | None = None) -> Scene:
    """Open an image with its RPC and with its rigorous model, and the tiles and parts that belong to it."""
    name, size = dataset.GetDescription(), (dataset.RasterXSize, dataset.RasterYSize)
    path = metadata_of(name)
    if path is None:
        raise InputError("no ISD XML found next to this image", file=name, remedy="add it from the delivery")
    isd, image = Isd(path), place(name)
    tile, warnings = tile_of(isd, image.name), []
    if tile is not None and (tile.width, tile.height) != size:
        text = f"this tile has {tile.width} x {tile.height} pixels in the XML, but {size[0]} x {size[1]} in the image"
        warnings.append(Notice("maybe-a-crop", text, metadata_size=[tile.width, tile.height]))
    elif tile is None and isd.size != size:
        text = (
            "the XML is for {} x {} pixels, but the image has {} x {}. If it is a crop, it is assumed to "
            "begin at the first corner".format(*isd.size, *size)
        )
        warnings.append(Notice("maybe-a-crop", text, metadata_size=list(isd.size)))
    model, source = _rpc(dataset, isd, rpc, tile)
    models: dict[str, SensorModel] = {} if model is None else {"rpc": model}
    facts = isd.facts
    try:
        first = (0, 0) if tile is None else (tile.left, tile.top)
        rigorous = read_isd_pushbroom(isd, size=size, first=first)
        warnings += _compared(rigorous, model)
        models["pushbroom"] = rigorous
        facts["rigorous_model"] = path.name
    except InputError as error:
        if model is None:
            raise
        text = f"the rigorous model in {path.name} is not used: {error.field or 'model'}: {error.message}"
        warnings.append(Notice("rigorous-left-out", text, file=path.name))
    parts, notices = parts_beside(isd, image, rigorous=model is None) if tile is None else ([], [])
    colours = colours_beside(isd, image, next(iter(models.values())))
    return Scene(
        "maxar",
        name,
        *size,
        models,
        source,
        facts,
        (*warnings, *notices),
        pieces=(*tiles_beside(isd, image, tile), *parts, *colours),
        sources=(path,) if source != str(path) else (),
    )


def _rpc(dataset: gdal.Dataset, isd: Isd, choice: str | None, tile: Tile | None) -> tuple[RPC | None, str]:
    """Return the RPC of an image in its own pixels, and its source."""
    if choice is not None:
        return rpc_of_dataset(dataset, choice)
    if isd.rpc is None:
        return rpc_of_dataset(dataset) if has_rpc(dataset) else (None, str(isd.path))
    of_tile = cut(isd.rpc, tile)
    require_same_rpc(dataset, (of_tile, isd.rpc), place(isd.path).name)
    return of_tile, str(isd.path)


def _compared(rigorous: Pushbroom, rpc: RPC | None) -> list[Notice]:
    """Return a warning if rigorous model and RPC of an image differ; raise an error if they differ too much."""
    if rpc is None:
        return []
    middle = np.array([rigorous.camera.size]) / 2
    seen = rpc.ground_to_image(rigorous.image_to_ground(middle, rpc.h_off))
    apart = float(np.linalg.norm(seen - middle))
    if not apart <= DISAGREEMENT:
        raise InputError(f"it is {apart:.0f} px off the RPC in the middle of the image", field="pushbroom")
    if apart <= APART:
        return []
    text = (
        f"the rigorous model and the RPC are {apart:.0f} px apart. Programs that rewrite the XML write their own RPC, "
        "without aberration. Compare both at check points"
    )
    return [Notice("rpc-and-rigorous-differ", text, difference_px=round(apart, 2))]
