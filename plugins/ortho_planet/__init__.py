"""Sensor plugin for Planet's basic products: PlanetScope level 1B and SkySat level 1A/1B, by their RPC.

The metadata of an item (``<id>_metadata.json``) are next to its assets, whose names begin with that of the item. Frames
of a strip are separate images; `ortho adjust` adjusts them together.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from osgeo import gdal

from ortho_pipeline.plugin import (
    InputError,
    Notice,
    Scene,
    Sensor,
    has_rpc,
    hookimpl,
    listing,
    place,
    read_bounded,
    read_json,
    reads,
    rpc_of_dataset,
)

MAX_SIZE = 5_000_000
_METADATA = re.compile(r".*_metadata\.json$", re.IGNORECASE | re.DOTALL)
_REMEDY = "download the metadata of this item again"
#: Facts of an item, with their names here.
_TEXTS = {
    "acquired": "acquired",
    "satellite_id": "satellite",
    "instrument": "instrument",
    "item_type": "item_type",
    "strip_id": "strip",
}
_NUMBERS = {
    "sun_azimuth": "sun_azimuth_deg",
    "sun_elevation": "sun_elevation_deg",
    "view_angle": "view_angle_deg",
    "cloud_cover": "cloud_cover",
    "gsd": "stated_gsd_m",
}


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``planet``."""
    yield Sensor(
        "planet",
        "PlanetScope level 1B and SkySat level 1A/1B with <id>_metadata.json and an RPC",
        recognises,
        open_scene,
        options={"rpc": "which RPC to use: tag, sidecar, or an RPC file"},
    )


def metadata_of(name: str) -> Path | None:
    """Return the metadata of the item that an image is an asset of; None without."""
    if not name:
        return None
    try:
        image = place(name)
        files = [image.parent / one for one in listing(image.parent).matching(_METADATA)]
    except (OSError, ValueError, InputError):
        return None
    asset = f"{image.stem}_".lower()
    its = [one for one in files if asset.startswith(one.name.lower().removesuffix("metadata.json"))]
    # The longest name is of the item itself, where one item's name begins with another's.
    return max(its, key=lambda one: len(one.name), default=None)


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether there are metadata of a Planet item next to an image."""
    path = metadata_of(dataset.GetDescription())
    try:
        return path is not None and b'"item_type"' in read_bounded(path, MAX_SIZE)
    except InputError:
        return False


def open_scene(dataset: gdal.Dataset, *, rpc: str | None = None) -> Scene:
    """Open an asset with its RPC."""
    name = dataset.GetDescription()
    path = metadata_of(name)
    if path is None:
        raise InputError("no <id>_metadata.json found next to this image", file=name, remedy="download it")
    facts = read_item(path)
    if rpc is None and not has_rpc(dataset):
        raise InputError(
            "there is no RPC. Orthorectified assets have none, because they are already orthoimages",
            file=name,
            remedy="use the basic product (level 1B, or SkySat level 1A) with its RPC",
        )
    model, source = rpc_of_dataset(dataset, rpc)
    warnings = []
    if not str(facts.get("item_type", "PS")).startswith(("PS", "SkySat")):
        text = (
            f"this reader was never tested with an item of the type {facts['item_type']}. Compare with control points"
        )
        warnings.append(Notice("unchecked-product", text))
    return Scene(
        "planet",
        name,
        dataset.RasterXSize,
        dataset.RasterYSize,
        {"rpc": model},
        source,
        facts,
        tuple(warnings),
        sources=(path,),
    )


@reads(_REMEDY)
def read_item(path: Path) -> dict[str, Any]:
    """Read the facts of an item's metadata.

    Raises
    ------
    InputError
        If the file is not the JSON of an item.
    """
    document = read_json(path, MAX_SIZE, _REMEDY)
    properties = document.get("properties") if isinstance(document, dict) else None
    if not isinstance(properties, dict):
        raise InputError("this file is not the metadata of an item", file=path, field="properties", remedy=_REMEDY)
    texts = {ours: properties.get(theirs) for theirs, ours in _TEXTS.items()}
    facts: dict[str, Any] = {name: text[:200] for name, text in texts.items() if isinstance(text, str)}
    for theirs, ours in _NUMBERS.items():
        value = properties.get(theirs)
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9:
            facts[ours] = value
    return facts
