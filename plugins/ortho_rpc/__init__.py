"""Sensor plugin for every product that comes with an RPC: TIFF tag, side-car, DIMAP, NITF, VRT, or a file given.

It is a fallback: plugins that know the product have priority. If there are DIMAP metadata with the rigorous model of
the same image next to it, the scene also has the model ``pushbroom``.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from osgeo import gdal

from ortho_pipeline.plugin import RPC, Notice, Scene, Sensor, SensorModel, has_rpc, hookimpl, place, rpc_of_dataset
from ortho_rpc import geolocation
from ortho_rpc.bundle import pieces_beside, rpc_of_dimap
from ortho_rpc.rigorous import Rigorous, rigorous_beside

# What GDAL's readers of vendor metadata agree on, and what it is called here.
IMAGERY = {"SATELLITEID": "satellite", "ACQUISITIONDATETIME": "acquired", "CLOUDCOVER": "cloud_cover_percent"}


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensors ``rpc`` and ``geolocation``, for metadata that GDAL reads."""
    yield Sensor(
        "rpc",
        "any image with an RPC (tag, .RPB, _RPC.TXT, DIMAP, NITF, VRT)",
        recognises,
        open_scene,
        options={"rpc": "which RPC to use: tag, sidecar, or an RPC file"},
        fallback=True,
    )
    yield Sensor(
        "geolocation",
        "images with geolocation arrays (GDAL's domain, or files of longitudes and latitudes), to start matching",
        lambda dataset: geolocation.has_arrays(dataset) and not has_rpc(dataset),
        geolocation.open_scene,
        options=geolocation.OPTIONS,
        fallback=True,
    )


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether an image has an RPC, or is a DIMAP metadata file with one next to it."""
    return has_rpc(dataset) or _of_dimap(dataset) is not None


def _of_dimap(dataset: gdal.Dataset) -> Path | None:
    name = dataset.GetDescription()
    return rpc_of_dimap(place(name)) if name.upper().endswith(".XML") else None


def open_scene(dataset: gdal.Dataset, *, rpc: str | None = None) -> Scene:
    """Open an image with its RPC, or with a given one."""
    if rpc is None and not has_rpc(dataset) and (beside := _of_dimap(dataset)) is not None:
        rpc = str(beside)
    model, source = rpc_of_dataset(dataset, rpc)
    width, height = dataset.RasterXSize, dataset.RasterYSize
    rigorous = rigorous_beside(place(dataset.GetDescription()), (width, height), model)
    models: dict[str, SensorModel] = {"rpc": model}
    if rigorous.model is not None:
        models["pushbroom"] = rigorous.model
    return Scene(
        sensor="rpc",
        path=dataset.GetDescription(),
        width=width,
        height=height,
        models=models,
        model_source=source,
        facts=_facts(dataset, model) | _facts_of(rigorous),
        warnings=(*_warnings(dataset, model), *rigorous.warnings),
        sources=() if rigorous.path is None else (rigorous.path,),
        pieces=pieces_beside(place(dataset.GetDescription()), model),
    )


def _facts(dataset: gdal.Dataset, model: RPC) -> dict[str, Any]:
    imagery = dataset.GetMetadata("IMAGERY") or {}
    facts: dict[str, Any] = {name: imagery[key] for key, name in IMAGERY.items() if imagery.get(key)}
    # GDAL hands on 999, the vendors' word for a cloud cover that is not known.
    if facts.get("cloud_cover_percent", "").strip() in ("999", "99.9"):
        del facts["cloud_cover_percent"]
    for name in ("err_bias", "err_rand"):
        value = getattr(model, name)
        if value is not None:
            facts[f"rpc_{name}_m"] = value
    facts["rpc_height_range_m"] = list(model.height_range)
    return facts


def _facts_of(rigorous: Rigorous) -> dict[str, Any]:
    facts: dict[str, Any] = {} if rigorous.path is None else {"rigorous_model": rigorous.path.name}
    return facts | ({"rigorous_models_not_read": dict(rigorous.left)} if rigorous.left else {})


def _warnings(dataset: gdal.Dataset, model: RPC) -> tuple[Notice, ...]:
    warnings = []
    if dataset.GetGCPCount():
        text = f"the file also has {dataset.GetGCPCount()} GCPs; GDAL programs use these instead of the RPC"
        warnings.append(Notice("gcps-beside-rpc", text, count=dataset.GetGCPCount()))
    return tuple(warnings)
