"""An OrbView-3 Basic product: its translated label, and its RPC from the label and from the text file."""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from ortho_orbview3.label import LabelGroup, read_label
from ortho_pipeline.plugin import (
    RPC,
    Array,
    InputError,
    Notice,
    Setting,
    Text,
    listing,
    place,
    read_rpc,
    read_rpc_text,
    reads,
    rpc_of_fields,
)

#: Keys of the label by the names that RPC text has for them.
SCALAR_KEYS = {
    "LINE_OFF": "lineOffset",
    "SAMP_OFF": "pixelOffset",
    "LAT_OFF": "latitudeOffset",
    "LONG_OFF": "longitudeOffset",
    "HEIGHT_OFF": "heightOffset",
    "LINE_SCALE": "lineScale",
    "SAMP_SCALE": "pixelScale",
    "LAT_SCALE": "latitudeScale",
    "LONG_SCALE": "longitudeScale",
    "HEIGHT_SCALE": "heightScale",
}
COEFFICIENT_KEYS = {
    "LINE_NUM_COEFF": "lineNumeratorCoefficients",
    "LINE_DEN_COEFF": "lineDenominatorCoefficients",
    "SAMP_NUM_COEFF": "pixelNumeratorCoefficients",
    "SAMP_DEN_COEFF": "pixelDenominatorCoefficients",
}
ERROR_KEYS = {"ERR_BIAS": "errorBias", "ERR_RAND": "errorRand"}
#: Corners as the label names them, with the column and row of their pixel's centre in parts of the last one.
CORNERS = {
    "upperLeftCorner": (0, 0),
    "upperRightCorner": (1, 0),
    "lowerRightCorner": (1, 1),
    "lowerLeftCorner": (0, 1),
}
#: The vendor's word for a number that is not known.
UNKNOWN = 999.0
#: RPCs of label and text file that differ by more than the first (px) are reported, by more than the second refused.
DIFFERENT, CONTRADICTORY = 1e-3, 1.0


@dataclass(frozen=True, eq=False)
class Product:
    """The statements of a label.

    Attributes
    ----------
    columns, rows : int
    pixel_spacing, line_spacing : float
        Distance (m) of the centres of neighbouring pixels on the ground, along a line and from line to line.
    corners : (4, 3)
        Longitude, latitude (degrees), ellipsoidal height of the centres of the corner pixels, as `CORNERS` has them.
    rpc : RPC
    acquired : datetime or None
        UTC of the first line.
    circular_error : float or None
        Horizontal accuracy (m) at 90 %, without control.
    cloud_cover : float or None
        Percent.
    """

    file: str
    columns: int
    rows: int
    pixel_spacing: float
    line_spacing: float
    corners: Array
    rpc: RPC
    satellite: str
    sensor: str
    acquired: datetime.datetime | None
    circular_error: float | None
    cloud_cover: float | None
    orbit: str | None
    bits: int | None

    @property
    def corner_misses(self) -> Array:
        """How far (px) the RPC projects the corners from the centres of the corner pixels ``(4, 2)``."""
        last = np.array([self.columns - 1, self.rows - 1])
        return self.rpc.ground_to_image(self.corners) - (np.array(list(CORNERS.values())) * last + 0.5)


def label_of(image: str | PathLike[str]) -> Path | None:
    """Return the label next to an image; None without one."""
    return _beside(place(image), ".pvl")


def rpc_text_of(image: str | PathLike[str]) -> Path | None:
    """Return the RPC text next to an image; None without one."""
    return _beside(place(image), "_rpc.txt")


def _beside(image: Path, end: str) -> Path | None:
    wanted = f"{image.stem}{end}".lower()
    try:
        # A dataset in memory has no name.
        exact = image.with_name(f"{image.stem}{end}")
        if exact.is_file():
            return exact
        # Archives that went through other systems come in capitals.
        return next((image.parent / name for name in listing(image.parent).named(wanted)), None)
    except (OSError, ValueError):
        return None


@reads("copy the .pvl again from the delivery")
def read_product(path: str | PathLike[str]) -> Product:
    """Read a label.

    Raises
    ------
    InputError
        For a damaged label; the field is group and key.
    """
    label = read_label(path)
    product, image = label.group("productInfo"), label.group("inputImageInfo")
    sensor = label.group("sensorInfo")
    return Product(
        file=str(path),
        columns=product.whole("pixelsPerScanLine"),
        rows=product.whole("numScanLines"),
        pixel_spacing=_positive(product, "pixelSpacing"),
        line_spacing=_positive(product, "lineSpacing"),
        corners=_corners(product),
        rpc=_rpc(product.group("rationalFunctions")),
        satellite=sensor.text("satelliteName"),
        sensor=sensor.text("sensorName"),
        acquired=_time(image, "firstLineAcquisitionDateTime"),
        circular_error=_known(image, "circularError"),
        cloud_cover=_known(product, "productCloudCoverPercentage"),
        orbit=image.text("acquisitionOrbitNumber") if image.has("acquisitionOrbitNumber") else None,
        bits=product.whole("bitsPerPixel") if product.has("bitsPerPixel") else None,
    )


def choose_rpc(product: Product, text: Path | None, choice: str | None) -> tuple[RPC, str, tuple[Notice, ...]]:
    """Return the RPC to use, its file, and warnings.

    Parameters
    ----------
    choice : {None, 'label', 'text', 'sidecar'} or path
        Which RPC to use if they differ; the text is the sidecar that GDAL reads.

    Raises
    ------
    InputError
        If the text is damaged or missing, or if both differ by more than a pixel and none is chosen.
    """
    if choice == "label":
        return product.rpc, product.file, ()
    if choice not in (None, "text", "sidecar"):
        return read_rpc(choice), str(choice), ()
    if text is None:
        if choice is not None:
            raise InputError(
                "no RPC text file found next to the image",
                field="rpc",
                remedy=Text("take ", Setting("scene.rpc", "label")),
            )
        text_missing = "no RPC text file found next to the label, so the RPC of the label is used"
        return product.rpc, product.file, (Notice("no-rpc-text", text_missing),)
    rpc = read_rpc_text(text)
    difference = _difference(product.rpc, rpc)
    if choice is not None or difference <= DIFFERENT:
        return rpc, str(text), ()
    if not difference <= CONTRADICTORY:
        raise InputError(
            f"the RPCs in this file and in {Path(product.file).name} differ by {difference:.3g} px",
            file=text,
            field="rpc",
            remedy=Text(
                "choose one with ",
                Setting("scene.rpc", "label"),
                ", ",
                Setting("scene.rpc", "text"),
                ", or ",
                Setting("scene.rpc", "FILE"),
            ),
        )
    differ = f"the RPCs of label and text file differ by {difference:.2g} px; the text file is used"
    return rpc, str(text), (Notice("rpcs-differ", differ, difference_px=difference),)


def _difference(first: RPC, second: RPC) -> float:
    """Return by how much two RPCs differ over the box of the first (px); infinite where one has no value."""
    apart = np.abs(second.ground_to_image(_box(first)) - first.ground_to_image(_box(first)))
    return float(apart.max()) if np.isfinite(apart).all() else np.inf


def _box(rpc: RPC) -> Array:
    centre, half = rpc.domain
    signs = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 3), axis=-1).reshape(-1, 3)
    return centre + signs * half


def _positive(group: LabelGroup, key: str) -> float:
    value = group.number(key)
    if not value > 0:
        raise InputError(f"{value:g} is not a possible spacing", file=group.file, field=group.place(key))
    return value


def _known(group: LabelGroup, key: str) -> float | None:
    if not group.has(key):
        return None
    value = group.number(key)
    return None if value < 0 or value == UNKNOWN else value


def _time(group: LabelGroup, key: str) -> datetime.datetime | None:
    if not group.has(key):
        return None
    text = group.text(key)
    try:
        time = datetime.datetime.fromisoformat(re.sub(r"(\.\d{6})\d+", r"\1", text))
    except ValueError as error:
        raise InputError(f"{text[:40]!r} is not a time", file=group.file, field=group.place(key)) from error
    return time if time.tzinfo is not None else time.replace(tzinfo=datetime.UTC)


def _corners(product: LabelGroup) -> Array:
    group = product.group("geodeticCorners")
    corners = np.array(
        [[group.group(name).number(key) for key in ("longitude", "latitude", "height")] for name in CORNERS]
    )
    for name, (lon, lat, height) in zip(CORNERS, corners.tolist(), strict=True):
        if abs(lat) > 90 or abs(lon) > 360 or not -1000 < height < 10_000:
            raise InputError(
                f"{lon:g}, {lat:g}, {height:g} m is not on Earth", file=group.file, field=group.place(name)
            )
    return corners


def _rpc(group: LabelGroup) -> RPC:
    fields = {key: repr(group.number(name)) for key, name in SCALAR_KEYS.items()}
    for key, name in COEFFICIENT_KEYS.items():
        fields[key] = " ".join(map(repr, group.numbers(name, 20)))
    fields |= {key: repr(group.number(name)) for key, name in ERROR_KEYS.items() if group.has(name)}
    try:
        return rpc_of_fields(fields, group.file)
    except InputError as error:
        names = SCALAR_KEYS | COEFFICIENT_KEYS | ERROR_KEYS
        keys = [names.get(key, key) for key in (error.field or "").split(", ")]
        raise InputError(
            error.message, file=group.file, field=", ".join(map(group.place, keys)), remedy=error.remedy
        ) from error
