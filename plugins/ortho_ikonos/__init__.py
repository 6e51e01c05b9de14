"""Sensor plugin for IKONOS Geo products: ``po_<order>_<band>_<component>`` images with their metadata file.

There are two models: the vendor's RPC, if there is one, and ``geo``, the plane at Reference Height from the metadata
alone (docs/formats/ikonos.md). Bands in separate files are stacked on request. Points that were measured in another
band or component of the same acquisition also count for this image.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from osgeo import gdal

from ortho_ikonos.metadata import Component, Delivery, SourceImage, read_metadata
from ortho_ikonos.order import OrderImage, Position, bands_of, position_of, rpc_file
from ortho_pipeline.plugin import (
    RPC,
    InputError,
    MapPlane,
    Notice,
    Piece,
    Prior,
    Scene,
    Sensor,
    SensorModel,
    Setting,
    Text,
    ground_transform,
    has_rpc,
    height_range,
    hookimpl,
    open_dataset,
    place,
    priors_at,
    read_bounded,
    read_rpc,
    rpc_of_dataset,
)

OPTIONS = {
    "metadata": "the metadata file, if it is not po_<order>_metadata.txt next to the image",
    "rpc": "which RPC to use: tag, sidecar, or an RPC file",
    "geometry": "the first model: rpc (default if there is one) or geo (the plane at Reference Height)",
    "bands": "files to stack in the ortho: one (default), all separate bands, or names such as red,grn,blu",
    "heights": "lowest and highest ground for geo, ellipsoidal metres: low,high",
}
#: Products on the plane at Reference Height.
PRODUCT_LINE, LEVEL = "Geo", "Standard Geometrically Corrected"
#: Half of the height range (m) of `geo` without other information.
HALF_RANGE = 500.0
#: What the vendor states of the first years is 50 m at 90 %: 23 m for each coordinate. Direction of relief: by how much
#: it differs from the nominal one within a real scene (docs/engineering/block-adjustment.md).
SIGMAS = {"shift_x": 25.0, "shift_y": 25.0, "relief_x": 0.01, "relief_y": 0.01}
#: RPC and metadata that differ by more than this on the plane (px) belong to different images.
DISAGREEMENT = 1.0


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``ikonos``."""
    yield Sensor(
        "ikonos",
        "IKONOS Geo products (po_* with metadata.txt, with or without RPC)",
        recognises,
        open_scene,
        options=OPTIONS,
    )


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether the file is named like an image of an order, with IKONOS metadata next to it."""
    image = OrderImage.of(place(dataset.GetDescription()))
    if image is None:
        return False
    try:
        return b"IKONOS" in read_bounded(image.metadata, 100_000)
    except InputError:
        return False


def open_scene(
    dataset: gdal.Dataset,
    *,
    metadata: str | None = None,
    rpc: str | None = None,
    geometry: str | None = None,
    bands: str = "one",
    heights: str | None = None,
) -> Scene:
    """Open an image of an IKONOS order."""
    path = place(dataset.GetDescription())
    image = OrderImage.of(path)
    if image is None and (metadata is None or bands != "one"):
        raise InputError(
            "this is not the file name of an IKONOS order",
            file=path,
            field="metadata",
            remedy="name it po_<order>_<band>_<component of 7 digits>.tif, or give the sensor option metadata=FILE",
        )
    delivery = read_metadata(metadata or (image.metadata if image else ""))
    component = delivery.component(image.component if image else None)
    source = delivery.source_of(component)
    position = position_of(dataset, delivery, component)
    vendor = _rpc(dataset, rpc)
    lacking = _lacking(position, source)
    models: dict[str, SensorModel] = {} if vendor is None else {"rpc": vendor[0]}
    if not lacking:
        models["geo"] = _plane(dataset, position, source, _heights(heights, position, vendor and vendor[0]))
    first = _first(geometry, models, lacking, delivery.file, component)
    models = {first: models[first], **models}
    pieces, broken = _pieces(image, delivery, component, position, first == "rpc") if image else ((), [])
    contradiction = _disagreement(models)
    if contradiction and vendor is not None and rpc is None and geometry is None:
        raise _undecided(contradiction[0], vendor[1])
    return Scene(
        sensor="ikonos",
        path=path,
        width=dataset.RasterXSize,
        height=dataset.RasterYSize,
        models=models,
        model_source=vendor[1] if vendor and first == "rpc" else delivery.file,
        facts=_facts(image, delivery, component, source, position, models, lacking),
        warnings=(*_level_warnings(delivery), *delivery.notes, *position.warnings, *broken, *contradiction),
        priors=_priors(models),
        rasters=bands_of(image, bands) if image else (),
        pieces=pieces,
        sources=position.sources,
    )


# -- models ----------------------------------------------------------------------------------------------------------


def _rpc(dataset: gdal.Dataset, choice: str | None) -> tuple[RPC, str] | None:
    """Return the RPC and its source; GDAL does not attach a sidecar to every format."""
    if choice is not None or has_rpc(dataset):
        return rpc_of_dataset(dataset, choice)
    path = rpc_file(place(dataset.GetDescription()))
    return None if path is None else (read_rpc(path), str(path))


def _lacking(position: Position, source: SourceImage) -> list[str]:
    """Return missing keys that the plane needs."""
    wanted = {
        "Map Projection (UTM on WGS84, or of the image)": position.crs,
        "UL Map X, UL Map Y": position.corner,
        "Pixel Size X, Pixel Size Y": position.pixel,
        "Reference Height": position.reference_height,
        "Nominal Collection Azimuth": source.azimuth,
        "Nominal Collection Elevation": source.elevation,
    }
    return [key for key, value in wanted.items() if value is None]


def _plane(dataset: gdal.Dataset, position: Position, source: SourceImage, heights: tuple[float, float]) -> MapPlane:
    return MapPlane.from_view(
        position.crs,
        position.corner,
        position.pixel,
        (dataset.RasterXSize, dataset.RasterYSize),
        position.reference_height,
        math.radians(source.azimuth),
        math.radians(source.elevation),
        heights,
    )


def _heights(text: str | None, position: Position, vendor: RPC | None) -> tuple[float, float]:
    plane = position.reference_height or 0.0
    if text is not None:
        low, high = height_range(text)
    else:
        low, high = vendor.height_range if vendor else (plane - HALF_RANGE, plane + HALF_RANGE)
    return min(low, plane), max(high, plane)


def _first(
    geometry: str | None, models: dict[str, SensorModel], lacking: list[str], file: str, component: Component
) -> str:
    """Return the name of the model to start from."""
    if geometry not in (None, "rpc", "geo"):
        raise InputError(f"{geometry!r} is not a known geometry", field="geometry", remedy="rpc or geo")
    first = geometry or next(iter(models), "geo")
    if first == "rpc" and "rpc" not in models:
        raise InputError(
            "this image has no RPC",
            file=file,
            field="geometry",
            remedy=Text("give an RPC with ", Setting("scene.rpc"), ", or use geometry=geo"),
        )
    if first not in models:
        raise InputError(
            f"the plane at Reference Height needs {'; '.join(lacking)}",
            file=file,
            field=f"component {component.component}: {lacking[0]}",
            remedy=Text(
                "give the complete metadata file or an RPC (",
                Setting("scene.rpc"),
                "), or fit a model to points (",
                Setting("points.fit_model"),
                ")",
            ),
        )
    return first


def _priors(models: Mapping[str, SensorModel]) -> dict[str, Prior]:
    return priors_at(models["geo"], SIGMAS) if "geo" in models else {}


def _pieces(
    image: OrderImage, delivery: Delivery, component: Component, position: Position, with_models: bool
) -> tuple[tuple[Piece, ...], list[Notice]]:
    """Return the other files of the acquisition (same plane, maybe other pixels), and warnings."""
    pieces: list[Piece] = []
    warnings: list[Notice] = []
    others = list(image.others())
    # Only images with pixels of this size bring models: a component without one cannot be predicted.
    alike = {other.component for other in others if other.grid == image.grid} | {image.component}
    for other in others:
        known = [one for one in delivery.components if one.component == other.component]
        if len(known) != 1 or known[0].product_image != component.product_image or other.component not in alike:
            continue
        if other.component == image.component and other.grid == image.grid:
            pieces.append(Piece(other.path))
            continue
        try:
            opened = open_dataset(other.path)
            place = position.place_of(position_of(opened, delivery, known[0]))
            vendor = _rpc(opened, None) if with_models and other.grid == image.grid else None
        except InputError as error:
            text = f"points in {other.path.name} are not used: {error.message}"
            warnings.append(Notice("piece-left-out", text, file=other.path.name))
            continue
        if place is not None:
            size = opened.RasterXSize, opened.RasterYSize
            pieces.append(Piece(other.path, place[:2], size, vendor[0] if vendor else None, place[2]))
    return tuple(pieces), warnings


# -- facts and warnings ----------------------------------------------------------------------------------------------


def _level_warnings(delivery: Delivery) -> list[Notice]:
    line, level = delivery.product_line, delivery.level
    if line is None and level is None:
        text = "the metadata do not state the processing level; a Geo product is assumed"
        return [Notice("processing-level", text)]
    if (line is None or line.lower().startswith(PRODUCT_LINE.lower())) and (level or LEVEL).lower() == LEVEL.lower():
        return []
    text = (
        f"this is a product {line or 'of an unknown line'}, {level or 'level not stated'}, not {PRODUCT_LINE}, {LEVEL}:"
        " if relief is already corrected, it would be corrected twice"
    )
    return [Notice("processing-level", text, line=line, level=level)]


def _disagreement(models: dict[str, SensorModel]) -> list[Notice]:
    """Hold the RPC against the metadata on the plane, where both state the same."""
    vendor, plane = models.get("rpc"), models.get("geo")
    if vendor is None or not isinstance(plane, MapPlane):
        return []
    middle = np.array([plane.size]) / 2
    ground = ground_transform(plane.crs, vendor.crs)(plane.image_to_ground(middle, plane.plane))
    off = float(np.abs(vendor.ground_to_image(ground) - middle).max())
    if off <= DISAGREEMENT:
        return []
    apart = f"{off:.1f} px" if math.isfinite(off) else "the whole scene"
    text = f"RPC and metadata differ by {apart} at Reference Height. One of them belongs to another image"
    return [Notice("metadata-contradict", text, difference_px=off)]


def _undecided(contradiction: str, file: str) -> InputError:
    """Return the error where nothing says which of RPC and metadata is right."""
    return InputError(
        contradiction,
        file=file,
        field="rpc",
        remedy=Text(
            "choose one: the RPC with ",
            Setting("scene.rpc", "tag"),
            ", ",
            Setting("scene.rpc", "sidecar"),
            " or ",
            Setting("scene.rpc", "FILE"),
            ", or the metadata with ",
            Setting("scene.sensor_options", "geo", key="geometry"),
        ),
    )


def _facts(
    image: OrderImage | None,
    delivery: Delivery,
    component: Component,
    source: SourceImage,
    position: Position,
    models: dict[str, SensorModel],
    lacking: list[str],
) -> dict[str, object]:
    facts: dict[str, object] = {
        "satellite": source.sensor,
        "acquired": source.acquired,
        "order": delivery.order,
        "product": ", ".join(filter(None, (delivery.product_line, delivery.level))) or None,
        "band": image.band if image else None,
        "bits_per_pixel": delivery.bits,
        "component": component.component,
        "components": len(delivery.components),
        "product_image": component.product_image,
        "source_image": source.source_image,
        "azimuth_deg": source.azimuth,
        "elevation_deg": source.elevation,
        "scan_azimuth_deg": source.scan_azimuth,
        "sun_azimuth_deg": source.sun_azimuth,
        "sun_elevation_deg": source.sun_elevation,
        "cloud_cover_percent": _known(source.cloud_percent),
        "map_projection": delivery.projection or position.crs,
        "pixel_m": None if position.pixel is None else list(position.pixel),
        "reference_height_m": position.reference_height,
        "geo_model_lacks": lacking or None,
    }
    plane = models.get("geo")
    if isinstance(plane, MapPlane):
        facts["relief_px_per_100_m"] = round(100 * math.hypot(*plane.relief) / plane.pixel[0], 2)
    return {key: value for key, value in facts.items() if value is not None}


def _known(percent: float | None) -> float | None:
    # 999 is the vendor's word for a cloud cover that is not known.
    return percent if percent is not None and 0 <= percent <= 100 else None
