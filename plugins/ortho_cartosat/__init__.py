"""Sensor plugin for CARTOSAT-1 Ortho Kit images: RPC, and a pushbroom from the metadata (cartosat.md)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from osgeo import gdal

from ortho_cartosat.layout import metadata_of, partner_of, rpc_of, view_of
from ortho_cartosat.metadata import Metadata, read_metadata
from ortho_cartosat.start import DEFAULT, SOFT, pushbroom, soft_facts, soft_sigmas
from ortho_pipeline.plugin import (
    RPC,
    InputError,
    Notice,
    Scene,
    Sensor,
    SensorModel,
    hookimpl,
    require_same_rpc,
    rpc_of_dataset,
    rpc_of_fields,
)

#: Height range (m) of the pushbroom without an RPC.
HEIGHTS = (-500.0, 9000.0)
#: RPCs of GDAL and of this plugin that differ by more than this (px) give a warning.
DISAGREEMENT = 1.0
FACTS = {
    "product_id": "ProductID",
    "satellite": "SatID",
    "camera": "Sensor",
    "date_of_pass": "DateOfPass",
}
NUMBERS = {
    "altitude_km": "SatelliteAltitude",
    "heading_deg": "SatelliteHeadingAngle",
    "along_track_deg": "ViewAngleAlongTrack",
    "across_track_deg": "ViewAngleAcrossTrack",
    "pixel_along_m": "InputResolutionAlong",
    "pixel_across_m": "InputResolutionAcross",
    "sun_azimuth_deg": "SunAzimuthAtCenter",
    "sun_elevation_deg": "SunElevationAtCenter",
}


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``cartosat``."""
    yield Sensor(
        "cartosat",
        "CARTOSAT-1 Ortho Kit: BANDA/BANDF, <name>_A/_F or PRODUCT with _MET.TXT and _RPC.TXT",
        recognises,
        open_scene,
        options={
            "rpc": "which RPC to use: tag, sidecar, or an RPC file; default: the first readable one of the delivery",
            "rpc_origin": "line and sample of the first pixel's centre in the RPC: 0 (default) or 1",
            "view": "fore or aft, if neither file name nor metadata name the view",
            **{
                option: f"soft constraint of the pushbroom: sigma of the {what}, or none; default:"
                f" {soft_facts(DEFAULT)[option]:g}"
                for option, (_, _, what) in SOFT.items()
            },
        },
    )


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether there are CARTOSAT-1 metadata next to this image."""
    path = metadata_of(dataset.GetDescription())
    try:
        return path is not None and read_metadata(path).is_cartosat1
    except InputError:
        return False


def open_scene(
    dataset: gdal.Dataset,
    *,
    rpc: str | None = None,
    rpc_origin: str = "0",
    view: str | None = None,
    sigma_plane_m: str | None = None,
    sigma_circle_rad: str | None = None,
    sigma_altitude_m: str | None = None,
    sigma_attitude_deg: str | None = None,
    sigma_rate_rad_s: str | None = None,
) -> Scene:
    """Open an image with the RPC of its delivery, and with a pushbroom to be adjusted to control points."""
    name = dataset.GetDescription()
    path = metadata_of(name)
    if path is None:
        raise InputError("there is no metadata next to this image", file=name, remedy=f"add {Path(name).stem}_MET.TXT")
    if rpc_origin not in ("0", "1") or view not in (None, "fore", "aft"):
        field, allowed = ("rpc_origin", "0 or 1") if rpc_origin not in ("0", "1") else ("view", "fore or aft")
        raise InputError(f"unknown value for {field}", field=field, remedy=f"give {allowed}")
    sigmas = soft_sigmas(
        {
            "sigma_plane_m": sigma_plane_m,
            "sigma_circle_rad": sigma_circle_rad,
            "sigma_altitude_m": sigma_altitude_m,
            "sigma_attitude_deg": sigma_attitude_deg,
            "sigma_rate_rad_s": sigma_rate_rad_s,
        }
    )
    metadata = read_metadata(path)
    size = dataset.RasterXSize, dataset.RasterYSize
    view = view or view_of(name, metadata)
    model, source, warnings = _rpc(dataset, rpc, rpc_origin)
    models: dict[str, SensorModel] = {} if model is None else {"rpc": model}
    try:
        models["pushbroom"] = pushbroom(metadata, view, size, HEIGHTS if model is None else model.height_range, sigmas)
    except InputError as error:
        if not models:
            raise
        warnings.append(Notice("no-pushbroom", f"no pushbroom model, only the RPC: {error.message}"))
    if metadata.size not in (None, size):
        text = "the metadata are for {} x {} pixels, but this image has {} x {}. Is it a crop?".format(
            *metadata.size, *size
        )
        warnings.append(Notice("maybe-a-crop", text, metadata_size=metadata.size))
    if model is None:
        text = "there is no readable RPC. The model is only a start: adjust it to at least nine control points"
        warnings.append(Notice("only-a-start", text))
    facts = _facts(name, metadata, warnings) | ({} if model is None else {"rpc_origin": int(rpc_origin)})
    facts = {"view": view} | facts if view else facts
    if "pushbroom" in models:
        facts["soft_constraints"] = soft_facts(sigmas)
    return Scene("cartosat", name, *size, models, source or str(path), facts, tuple(warnings), sources=(path,))


def _facts(name: str, metadata: Metadata, warnings: list[Notice]) -> dict[str, object]:
    """Return facts of the metadata; damaged ones give a warning, not an error."""
    partner = partner_of(name, metadata)
    facts: dict[str, object] = {"partner": None if partner is None else str(partner), "acquired": metadata.acquired}
    for fact, key in {**FACTS, **NUMBERS}.items():
        try:
            facts[fact] = metadata.number(key) if fact in NUMBERS else metadata.text(key)
        except InputError as error:
            text = f"{metadata.path.name}, {key}: {error.message}"
            warnings.append(Notice("damaged-metadata", text, file=metadata.path.name, field=key))
    return {fact: value for fact, value in facts.items() if value is not None}


def _rpc(dataset: gdal.Dataset, choice: str | None, origin: str) -> tuple[RPC | None, str | None, list[Notice]]:
    if choice is None:
        model, path, warnings = rpc_of(dataset.GetDescription())
        source = None if path is None else str(path)
    else:
        model, source = rpc_of_dataset(dataset, choice)
        warnings = []
    if model is not None and choice is None:
        require_same_rpc(dataset, [model], str(source))
        warnings += _compared_with_gdal(dataset, model, str(source))
    if model is not None and origin == "1":
        model = model._replace(col_off=model.col_off - 1.0, row_off=model.row_off - 1.0)
    return model, source, warnings


def _compared_with_gdal(dataset: gdal.Dataset, model: RPC, source: str) -> list[Notice]:
    """Return a warning if GDAL reads another RPC than this plugin."""
    try:
        other = rpc_of_fields(dataset.GetMetadata("RPC") or {})
    except (InputError, RuntimeError):
        # There is none, or the file is encrypted.
        return []
    centre = np.array([[model.lon_off, model.lat_off, model.h_off]])
    apart = float(np.abs(other.ground_to_image(centre) - model.ground_to_image(centre)).max())
    if apart <= DISAGREEMENT:
        return []
    text = f"this image uses the RPC in {Path(source).name}; GDAL reads another one, which differs by {apart:.1f} px"
    return [Notice("rpcs-differ", text, difference_px=apart)]
