r"""Sensor plugin for radar images that were geocoded on a plane (GEC), not on terrain: Capella, Umbra, ICEYE, others.

Capella's GEO is projected onto a DEM: a finished ortho, which this model would displace a second time.

A radar measures range. A point above the plane is nearer to the antenna than the point of the plane below it, so it is
displaced *towards* the radar, by :math:`1 / \tan\theta` of its height at the incidence angle :math:`\theta`. A camera
on the other side at the elevation :math:`\theta` would show the same displacement; the model is `MapPlane`.

The reader of Capella's ``_extended.json`` (positions of satellite and scene centre, which give both angles) could not
be checked with a real product; a notice says so. For other products the angles are options.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.plugin import (
    InputError,
    MapPlane,
    Notice,
    Scene,
    Sensor,
    enu_from_ecef,
    geodetic,
    has_rpc,
    hookimpl,
    parse_crs,
    place,
    read_bounded,
    read_json,
    reads,
)

MAX_SIZE = 20_000_000
_REMEDY = "download the metadata again, or give incidence=DEG and azimuth=DEG"
#: Height range (m) of the model above and below the plane.
HALF_RANGE = 1000.0
#: Incidence angles of radars (degrees).
_STEEPEST, _FLATTEST = 10.0, 80.0
_PLANE = "use a product in map geometry on a plane (GEC), not SLC or GRD"
#: Capella's product that is projected onto a DEM.
_TERRAIN = "GEO"
_ON_TERRAIN = re.compile(rb'"product_type"\s*:\s*"GEO"')


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``sar``."""
    yield Sensor(
        "sar",
        "radar images geocoded on a plane (GEC): Capella with _extended.json, others with the options below",
        recognises,
        open_scene,
        options={
            "incidence": "incidence angle at the scene centre, degrees from the vertical",
            "azimuth": "direction from the scene to the radar, degrees from north, clockwise",
            "plane": "ellipsoidal height (m) of the plane; default: the scene centre's height in the metadata",
        },
    )


def metadata_of(name: str) -> Path | None:
    """Return the extended metadata of a Capella image; None without them."""
    if not name:
        return None
    try:
        image = place(name)
        path = image.with_name(f"{image.stem}_extended.json")
        return path if path.is_file() else None
    except (OSError, ValueError, InputError):
        return None


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether an image has extended Capella metadata next to it, or complex values without a position."""
    path = metadata_of(dataset.GetDescription())
    if path is None and _is_slant(dataset) and not has_rpc(dataset):
        return True
    try:
        text = b"" if path is None else read_bounded(path, MAX_SIZE)
    except InputError:
        return False
    return b'"center_pixel"' in text and _ON_TERRAIN.search(text) is None


def open_scene(
    dataset: gdal.Dataset, *, incidence: str | None = None, azimuth: str | None = None, plane: str | None = None
) -> Scene:
    """Open an image on a plane; raise an error for slant range."""
    name, size = dataset.GetDescription(), (dataset.RasterXSize, dataset.RasterYSize)
    if _is_slant(dataset):
        raise InputError(
            "this image is in slant range (SLC, SICD): it has complex values and no map geometry",
            file=name,
            remedy=_PLANE,
        )
    path = metadata_of(name)
    facts = {} if path is None else read_extended(path)
    product = facts.get("product", "GEC")
    if product == _TERRAIN:
        raise InputError(
            "a GEO product is a finished ortho: its maker projected it onto a DEM",
            file=name,
            remedy="use it as it is, or order the product GEC",
        )
    if product != "GEC":
        raise InputError(f"a {product} product is in slant or ground range", file=name, remedy=_PLANE)
    crs, corner, pixel = _map_of(dataset)
    stated = {"incidence_deg": incidence, "azimuth_deg": azimuth, "plane_m": plane}
    facts |= {fact: _number(text, fact) for fact, text in stated.items() if text is not None}
    missing = [fact for fact in stated if not isinstance(facts.get(fact), float)]
    if missing:
        options = ", ".join(fact.rpartition("_")[0] for fact in missing)
        raise InputError(
            f"unknown for this image: {options}", file=name, field=options, remedy=f"give {options} as sensor options"
        )
    if not _STEEPEST <= facts["incidence_deg"] <= _FLATTEST:
        raise InputError(
            f"{facts['incidence_deg']:g} degrees is not a possible incidence angle of a radar",
            field="incidence",
            remedy=f"give {_STEEPEST:g} to {_FLATTEST:g} degrees from the vertical",
        )
    height = facts["plane_m"]
    model = MapPlane.from_view(
        crs,
        corner,
        pixel,
        size,
        height,
        math.radians(facts["azimuth_deg"]) + math.pi,
        math.radians(facts["incidence_deg"]),
        (height - HALF_RANGE, height + HALF_RANGE),
    )
    facts["relief_px_per_100_m"] = round(100 * math.hypot(*model.relief) / pixel[0], 2)
    return Scene("sar", name, *size, {"geo": model}, str(path or name), facts, _warnings(path is not None))


def _is_slant(dataset: gdal.Dataset) -> bool:
    """Return whether an image has complex values (a radar image in its own geometry) and no map geometry."""
    band = dataset.GetRasterBand(1) if dataset.RasterCount else None
    complex_ = band is not None and bool(gdal.DataTypeIsComplex(band.DataType))
    return complex_ and dataset.GetGeoTransform(can_return_null=True) is None


@reads(_REMEDY)
def read_extended(path: Path) -> dict[str, Any]:
    """Read angles and plane from Capella's extended metadata.

    Raises
    ------
    InputError
        If it is not such JSON, or its positions are not those of a satellite and a scene.
    """
    document = read_json(path, MAX_SIZE, _REMEDY)

    def at(*names: str) -> Any:
        value = document
        for name in names:
            value = value.get(name) if isinstance(value, dict) else None
        return value

    product = at("product_type")
    facts: dict[str, Any] = {"product": product[:10] if isinstance(product, str) else "unknown"}
    for fact, text in (("satellite", at("collect", "platform")), ("acquired", at("collect", "start_timestamp"))):
        if isinstance(text, str):
            facts[fact] = text[:60]
    vectors = at("collect", "state", "state_vectors")
    if not isinstance(vectors, list) or not vectors:
        raise InputError("the metadata have no satellite positions", file=path, field="collect.state.state_vectors")
    target = _place(at("collect", "image", "center_pixel", "target_position"), path, "center_pixel.target_position")
    places = np.array(
        [
            _place(vector.get("position") if isinstance(vector, dict) else None, path, "state_vectors.position")
            for vector in vectors
        ]
    )
    # The radar is nearest at the middle of the aperture, within the time step of the vectors.
    line = places[int(np.argmin(np.linalg.norm(places - target, axis=1)))] - target
    ground = geodetic(target[None])
    east, north, up = enu_from_ecef(ground)[0] @ (line / np.linalg.norm(line))
    if not (up > 0.1 and abs(ground[0, 2]) < 10_000):
        raise InputError(
            "these positions are not those of a satellite and a scene below it",
            file=path,
            field="state_vectors, target",
        )
    facts["incidence_deg"] = round(math.degrees(math.acos(min(1.0, up))), 4)
    facts["azimuth_deg"] = round(math.degrees(math.atan2(east, north)) % 360.0, 4)
    return facts | {"plane_m": round(float(ground[0, 2]), 3)}


def _place(value: Any, path: Path, field: str) -> NDArray[np.float64]:
    good = isinstance(value, list) and len(value) == 3
    if not good or not all(isinstance(number, int | float) and not isinstance(number, bool) for number in value):
        raise InputError("this must be a list of three numbers", file=path, field=field, remedy=_REMEDY)
    position = np.array(value, dtype=np.float64)
    if not 6.2e6 < np.linalg.norm(position) < 5e7:
        raise InputError("this position is not near the Earth", file=path, field=field, remedy=_REMEDY)
    return position


def _map_of(dataset: gdal.Dataset) -> tuple[str, tuple[float, float], tuple[float, float]]:
    """Return CRS, corner and pixel of an image in map geometry."""
    name, steps = dataset.GetDescription(), dataset.GetGeoTransform(can_return_null=True)
    text = dataset.GetProjection()
    if steps is None or not text:
        raise InputError("this image is in slant or ground range: it has no map geometry", file=name, remedy=_PLANE)
    crs = parse_crs(text)
    if not crs.is_projected or steps[2] or steps[4] or not (steps[1] > 0 > steps[5]):
        raise InputError(
            f"this image must be in a map projection with north up, not in {crs.name}",
            file=name,
            remedy="project it to its UTM zone, which keeps the plane: `gdalwarp -t_srs EPSG:CODE IN OUT`",
        )
    return crs.to_string(), (steps[0], steps[3]), (steps[1], -steps[5])


def _number(text: str, fact: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) < 1e5:
        raise InputError(f"{text[:20]!r} is not a number", field=fact.rpartition("_")[0], remedy="give a number")
    return value


def _warnings(from_file: bool) -> tuple[Notice, ...]:
    text = (
        "this is a radar image: high objects lean towards the radar. Steep slopes are in layover or in shadow, where "
        "the ground is not visible"
    )
    notices = [Notice("radar-on-a-plane", text)]
    if from_file:
        text = "this metadata reader was never tested with a real product of this kind. Compare with control points"
        notices.append(Notice("unchecked-product", text))
    return tuple(notices)
