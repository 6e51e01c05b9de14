"""Sensor plugin for OrbView-3 Basic scenes as the USGS delivers them: image, label ``.pvl``, ``_rpc.txt``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from osgeo import gdal

from ortho_orbview3.product import Product, choose_rpc, label_of, read_product, rpc_text_of
from ortho_pipeline.plugin import (
    RPC,
    InputError,
    Notice,
    Scene,
    Sensor,
    Setting,
    Text,
    has_rpc,
    hookimpl,
    place,
    read_bounded,
    rpc_of_dataset,
)

#: Names of the USGS: 3v, year, month, day, and p for panchromatic or m for multispectral.
_NAME = re.compile(r"3v(\d{6})([pm])\d", re.IGNORECASE)
_KINDS = {"p": "panchromatic", "m": "multispectral"}
BANDS = ("blue", "green", "red", "nir")
#: Families that can be fitted to points in place of the RPC, best first.
FAMILIES = ("affine14", "affine12", "affine3d", "dlt")
UNSUITED = dict.fromkeys(
    FAMILIES[1:],
    "this scene is not projected to a plane, so affine12, affine3d and dlt leave several metres. Only affine14 comes "
    "close to the RPC",
)
#: Ground speed (m/s) below a circular orbit at 470 km, and the most panchromatic lines per second (staggered).
GROUND_SPEED, LINES_PER_SECOND = 7100.0, {"panchromatic": 5000.0, "multispectral": 1250.0}
#: Standard deviation per axis of a circular error of 90 %.
_SIGMA_OF_CE90 = 1 / math.sqrt(2 * math.log(10))
#: From here on (px) corners that do not fit the RPC are reported.
_CORNER_MISS = 1.0


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``orbview3``."""
    yield Sensor(
        "orbview3",
        "OrbView-3 Basic scenes with a label (.pvl) and _rpc.txt, panchromatic or multispectral",
        recognises,
        open_scene,
        options={
            "rpc": "which RPC to use: text (default), label, tag or an RPC file",
            "label": "the label, if it is not <image>.pvl",
        },
    )


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether there is an OrbView-3 label next to the image."""
    path = label_of(dataset.GetDescription())
    if path is None:
        return False
    try:
        text = read_bounded(path, 100_000)
    except InputError:
        return False
    # Also accept a truncated label, so that the error says so: the name of the satellite is near its end.
    return b"OV-3" in text or (b"productInfo" in text and b"numScanLines" in text) or bool(_NAME.match(path.name))


def open_scene(dataset: gdal.Dataset, *, rpc: str | None = None, label: str | None = None) -> Scene:
    """Open an OrbView-3 image with its label and its RPC."""
    name = dataset.GetDescription()
    path = place(label) if label else label_of(name)
    if path is None:
        raise InputError(
            "no label (.pvl) found next to this image",
            file=name,
            field="label",
            remedy="give it as sensor option label=FILE",
        )
    product = read_product(path)
    size = dataset.RasterXSize, dataset.RasterYSize
    if size != (product.columns, product.rows):
        raise InputError(
            f"the label is for {product.columns} x {product.rows} pixels, but the image has {size[0]} x {size[1]}",
            file=path,
            field="productInfo.pixelsPerScanLine, productInfo.numScanLines",
            remedy=Text(
                "use the whole scene with its own label, or an image that has its own RPC (",
                Setting("scene.sensor", "rpc"),
                ")",
            ),
        )
    model, source, warnings = _chosen(dataset, product, rpc)
    return Scene(
        sensor="orbview3",
        path=name,
        width=size[0],
        height=size[1],
        models={"rpc": model},
        model_source=source,
        facts=_facts(product, model, name, dataset.RasterCount),
        warnings=(*warnings, *_contradictions(product)),
        unsuited=UNSUITED,
        accuracy=None if product.circular_error is None else product.circular_error * _SIGMA_OF_CE90,
    )


def _chosen(dataset: gdal.Dataset, product: Product, choice: str | None) -> tuple[RPC, str, tuple[Notice, ...]]:
    """Return the RPC to use, its file, and warnings; a tag that contradicts the text is an error."""
    if choice == "tag":
        return *rpc_of_dataset(dataset, choice), ()
    if choice is None and has_rpc(dataset):
        rpc_of_dataset(dataset)  # raises the error
    return choose_rpc(product, rpc_text_of(dataset.GetDescription()), choice)


def _facts(product: Product, model: RPC, image: str, bands: int) -> dict[str, object]:
    named = _NAME.match(Path(image).name)
    kind = _KINDS[named[2].lower() if named else "p" if bands == 1 else "m"]
    facts: dict[str, object] = {
        "label": product.file,
        "satellite": product.satellite,
        "camera": product.sensor,
        "kind": kind,
        "pixel_spacing_m": product.pixel_spacing,
        "line_spacing_m": product.line_spacing,
        "rpc_height_range_m": list(model.height_range),
        "corners_lon_lat_height": product.corners.tolist(),
        "families": list(FAMILIES),
    }
    factor = slow_down(product.line_spacing, kind)
    if factor >= 1:
        # Below that the lines came more slowly than they can, and how fast they came is not in the label.
        facts["slow_down_factor_at_full_line_rate"] = round(factor, 3)
    if bands == len(BANDS):
        facts["bands"] = list(BANDS)
    if product.acquired is not None:
        facts["acquired"] = product.acquired.isoformat().replace("+00:00", "Z")
    if product.circular_error is not None:
        facts["circular_error_m"] = product.circular_error
    optional = {"cloud_cover_percent": product.cloud_cover, "orbit": product.orbit, "bits_per_pixel": product.bits}
    facts |= {key: value for key, value in optional.items() if value is not None}
    return facts


def slow_down(line_spacing: float, kind: str) -> float:
    """Return how much slower than the satellite the lines go over the ground, if they come as fast as they can.

    Source: Bueyueksalih et al., section 2: 7100 / 5000 = 1.42 for lines of 1 m.
    """
    return GROUND_SPEED / (LINES_PER_SECOND[kind] * line_spacing)


def _contradictions(product: Product) -> Iterator[Notice]:
    misses = product.corner_misses
    worst = float(np.abs(misses).max()) if np.isfinite(misses).all() else math.inf
    if not worst <= _CORNER_MISS:
        text = f"the label contradicts itself: its RPC projects its corners up to {worst:.3g} px off the image corners"
        yield Notice("metadata-contradict", text, difference_px=worst)
