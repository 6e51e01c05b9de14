"""Sensor plugin for EnMAP level 1B: the spectral image of a detector with the RPCs of its bands from METADATA.XML.

Every band has its own RPC, because the detectors see a place one after the other. The short-wave infrared is about 20
rows from the visible, depending on height. The scene uses the RPC of one band.

Rows and columns of these RPCs count from 0 at the first pixel centre: at the corners of the file (without stated
heights), the rows of the first and last line are 0.0 and 1023.0 of 1024.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from osgeo import gdal

from ortho_pipeline.plugin import (
    RPC,
    InputError,
    Notice,
    Scene,
    Sensor,
    XmlFields,
    hookimpl,
    listing,
    place,
    read_bounded,
    reads,
    require_same_rpc,
    rpc_of_dataset,
    rpc_of_fields,
)

MAX_SIZE = 20_000_000
MOST_BANDS = 300
_DETECTORS = ("VNIR", "SWIR")
_SCALARS = {
    "ROW_OFF": "LINE_OFF",
    "COL_OFF": "SAMP_OFF",
    "LAT_OFF": "LAT_OFF",
    "LONG_OFF": "LONG_OFF",
    "HEIGHT_OFF": "HEIGHT_OFF",
    "ROW_SCALE": "LINE_SCALE",
    "COL_SCALE": "SAMP_SCALE",
    "LAT_SCALE": "LAT_SCALE",
    "LONG_SCALE": "LONG_SCALE",
    "HEIGHT_SCALE": "HEIGHT_SCALE",
}
_TERMS = {
    "ROW_NUM": "LINE_NUM_COEFF",
    "ROW_DEN": "LINE_DEN_COEFF",
    "COL_NUM": "SAMP_NUM_COEFF",
    "COL_DEN": "SAMP_DEN_COEFF",
}
#: Bands that are further (px) from the chosen band give a warning.
_SAME = 0.1
_REMEDY = "copy the metadata again from the delivery"


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``enmap``."""
    yield Sensor(
        "enmap",
        "EnMAP level 1B: ...SPECTRAL_IMAGE_VNIR.TIF or _SWIR.TIF with ...METADATA.XML",
        recognises,
        open_scene,
        options={
            "band": "number of the band whose RPC is used, from 1; default: the middle band",
            "rpc": "which RPC to use: tag, sidecar, or an RPC file; default: that of the band",
        },
    )


def metadata_of(name: str) -> tuple[Path, str] | None:
    """Return the metadata of an image and its detector, by their names; None for others."""
    if not name:
        return None
    image = place(name)
    start, sign, end = image.stem.upper().partition("-SPECTRAL_IMAGE")
    detector = next((one for one in _DETECTORS if end.strip("_") in (one, f"{one}_COG")), None)
    if not sign or detector is None or not start.startswith("ENMAP"):
        return None
    try:
        wanted = f"{start}-METADATA.XML"
        path = next((image.parent / one for one in listing(image.parent).named(wanted)), None)
    except (OSError, ValueError, InputError):
        return None
    return None if path is None else (path, detector)


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether this is the image of an EnMAP detector with its metadata next to it."""
    metadata = metadata_of(dataset.GetDescription())
    try:
        return metadata is not None and b"level_X" in read_bounded(metadata[0], 1000)
    except InputError:
        return False


def open_scene(dataset: gdal.Dataset, *, band: str | None = None, rpc: str | None = None) -> Scene:
    """Open the image of a detector with the RPC of one of its bands, or with another that is chosen."""
    name, size = dataset.GetDescription(), (dataset.RasterXSize, dataset.RasterYSize)
    metadata = metadata_of(name)
    if metadata is None:
        raise InputError("there is no METADATA.XML next to this image", file=name, remedy="add it from the delivery")
    path, detector = metadata
    rpcs, facts = read_enmap(path)
    its = _of_detector(rpcs, facts, detector, dataset.RasterCount, path)
    number = _chosen(band, len(its))
    model = its[number - 1]
    warnings = []
    if facts["size"] != list(size):
        text = "the metadata are for {} x {} pixels, but this image has {} x {}. Is it a crop?".format(
            *facts["size"], *size
        )
        warnings.append(Notice("maybe-a-crop", text, metadata_size=facts["size"]))
    apart = max(apart_of(one, model) for one in its)
    if apart > _SAME:
        text = f"the RPC of band {number} is used for all bands; other bands are up to {apart:.2f} px away from it"
        warnings.append(Notice("bands-differ", text, difference_px=round(apart, 3)))
    other = rpcs[facts["bands_vnir"] + facts["bands_swir"] // 2 if detector == "VNIR" else facts["bands_vnir"] // 2]
    facts |= {"detector": detector, "band": number, "parallax_to_other_detector_px_per_km": parallax(model, other)}
    if rpc is None:
        require_same_rpc(dataset, its, path.name)
        used, source = model, str(path)
    else:
        used, source = rpc_of_dataset(dataset, rpc)
    sources = () if rpc is None else (path,)
    return Scene("enmap", name, *size, {"rpc": used}, source, facts, tuple(warnings), sources=sources)


@reads(_REMEDY)
def read_enmap(path: Path) -> tuple[tuple[RPC, ...], dict[str, Any]]:
    """Read the RPCs of all bands, visible ones first, and facts.

    Raises
    ------
    InputError
        If the file is not metadata of level 1B, or an RPC is damaged.
    """
    file = XmlFields(path, remedy=_REMEDY, limit=MAX_SIZE)
    level = file.said("base/level") or "none"
    if level != "L1B":
        raise file.error(f"a product of level {level[:10]} has no RPCs", "base/level", "use level 1B")
    entries = file.all("product/navigation/RPC/bandID", MOST_BANDS) or file.all(".//RPC/bandID", MOST_BANDS)
    if not entries:
        raise file.error("the metadata have no RPCs", "RPC")
    rpcs = []
    for entry in entries:
        fields = {gdals: file.text(name, entry) for name, gdals in _SCALARS.items()}
        for name, gdals in _TERMS.items():
            fields |= {f"{gdals}_{k}": file.text(f"{name}_{k:02d}", entry) for k in range(1, 21)}
        rpcs.append(rpc_of_fields(fields, path))
    columns, rows = (file.integer(f"product/image/vnir/dimension/{name}") for name in ("columns", "rows"))
    facts: dict[str, Any] = {"size": [columns, rows], "acquired": file.said("specific/datatakeStart")}
    for detector in _DETECTORS:
        facts[f"bands_{detector.lower()}"] = file.integer(f"product/image/{detector.lower()}/channels")
    return tuple(rpcs), facts


def apart_of(one: RPC, other: RPC) -> float:
    """Return the distance (px) of two bands at the middle of the other, at its own height."""
    middle = np.array([[other.lon_off, other.lat_off, other.h_off]])
    return float(np.linalg.norm(one.ground_to_image(middle) - other.ground_to_image(middle)))


def parallax(one: RPC, other: RPC) -> list[float]:
    """Return the change of the offset between two bands (column, row; px) per kilometre of height."""
    ground = one.lon_off, one.lat_off
    low, high = (np.array([[*ground, one.h_off + h]]) for h in (-500.0, 500.0))
    apart = [other.ground_to_image(at) - one.ground_to_image(at) for at in (low, high)]
    return [round(float(value), 5) for value in (apart[1] - apart[0])[0]]


def _of_detector(
    rpcs: tuple[RPC, ...], facts: dict[str, Any], detector: str, bands: int, path: Path
) -> tuple[RPC, ...]:
    """Return the RPCs of the bands of a detector; the image must have all of them."""
    visible, infrared = facts["bands_vnir"], facts["bands_swir"]
    if visible + infrared != len(rpcs):
        raise InputError(f"{len(rpcs)} RPCs for {visible} + {infrared} bands", file=path, field="RPC", remedy=_REMEDY)
    its = rpcs[:visible] if detector == "VNIR" else rpcs[visible:]
    if bands != len(its):
        raise InputError(
            f"the image has {bands} bands, but the metadata describe {len(its)} {detector} bands",
            file=path,
            field="channels",
            remedy="give the image with all its bands",
        )
    return its


def _chosen(band: str | None, count: int) -> int:
    if band is None:
        return (count + 1) // 2
    if not band.isascii() or not band.isdigit() or not 1 <= int(band[:9]) <= count:
        raise InputError(f"unknown band {band[:20]!r}", field="band", remedy=f"give a number from 1 to {count}")
    return int(band)
