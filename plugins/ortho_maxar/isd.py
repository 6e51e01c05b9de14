r"""ISD XML of WorldView 1 to 4, GeoEye-1 and QuickBird: orbit, attitude and detectors as a line scanner; RPC; tiles.

Conventions of the vendor:

- row r, counted from 0 at the centre of the first, is exposed at TLCTIME + t, with t linear between the pairs (r, t) of
  TLCLIST: t decreases if the scan ran against the flight (SCANDIRECTION Reverse); positions and attitude have the step
  TIMEINTERVAL and begin at STARTTIME;
- positions are ECEF; the quaternion (scalar last) rotates the camera to ECEF at the moment of exposure;
- column c, counted from 0 at the first centre, looks along (DETORIGINX, DETORIGINY - c DETPITCH, PD) of the camera, in
  millimetres, z to the ground;
- velocity aberration *and* refraction are not in the angles: the vendor's RPC has both.

Checked on both parts of a WorldView-1 strip at 19 degrees off nadir, over the image and 200 m up and down, against the
vendor's RPC: the constant is (0.03, -0.13) and (0.04, -0.10) px, the standard deviation (0.04, 0.07) and (0.05, 0.02)
px. Without refraction it is 1.1 rows and changes with height by 0.05 rows, without aberration (17, 20) px.

Not supported, because no data were available to check their signs: rotated detectors, several arrays, optical
distortion, and a camera that is rotated in its platform or off its centre.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.plugin import (
    RPC,
    InputError,
    LightPath,
    LineCamera,
    Pushbroom,
    XmlFields,
    pushbroom_of_tables,
    read_rpc_text,
    reads,
    require_view,
    rotations_of_quaternions,
)

Array = NDArray[np.float64]

#: An hour of a strip has 30 MB; no strip takes an hour.
MAX_SIZE = 20_000_000
#: Height range (m) of the ground without an RPC.
HEIGHTS = (-500.0, 9000.0)
#: Rows whose times are off the mean line rate by more than this (rows) are not those of one rate.
_EVEN = 0.1
#: Camera axes (along the line, forward, to the ground) in those of the vendor.
_VENDOR_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_UNIT_LENGTH = 0.01
_LIGHT = LightPath(aberration=True, refraction=True)


@dataclass(frozen=True)
class Tile:
    """A file of a product: its first column and row, and its size."""

    name: str
    left: int
    top: int
    width: int
    height: int


class Isd:
    """The metadata of one image, or of one part of a strip.

    Raises
    ------
    InputError
        If it is no such XML; later where a field is missing or no value.
    """

    def __init__(self, path: PathLike[str]) -> None:
        self.path = path
        self.file = XmlFields(path, remedy="use the RPC", limit=MAX_SIZE)
        if not self.file.has("IMD"):
            raise self.file.error("this file is not the ISD XML of an image", "IMD", "give the XML next to the image")

    @cached_property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the image."""
        return self.file.integer("IMD/NUMCOLUMNS"), self.file.integer("IMD/NUMROWS")

    @cached_property
    def band(self) -> str:
        """What detectors took it: P, N, MS1, Multi ..."""
        return self.file.text("IMD/BANDID")[:20]

    @cached_property
    def tiles(self) -> tuple[Tile, ...]:
        """The files of the product."""
        tiles = []
        for entry in self.file.all("TIL/TILE", 10_000):
            edges = [
                self.file.number(name, entry) for name in ("ULCOLOFFSET", "ULROWOFFSET", "LRCOLOFFSET", "LRROWOFFSET")
            ]
            left, top, right, bottom = edges
            if any(edge != int(edge) or not 0 <= edge < 1e7 for edge in edges) or right < left or bottom < top:
                raise self.file.error("this is not a possible tile position", "TIL/TILE")
            name = self.file.text("FILENAME", entry).replace("\\", "/").rpartition("/")[2]
            tiles.append(Tile(name, int(left), int(top), int(right - left) + 1, int(bottom - top) + 1))
        return tuple(tiles)

    @cached_property
    def rpc(self) -> RPC | None:
        """The vendor's RPC of the whole image; None without one."""
        return read_rpc_text(self.path) if self.file.has("RPB/IMAGE/LINEOFFSET") else None

    @cached_property
    def rows(self) -> tuple[float, float]:
        """Time of the first centre (seconds of the day) and seconds per row, which are negative in a reverse scan."""
        start = self.file.time("IMD/IMAGE/TLCTIME")
        listed = self.file.all("IMD/IMAGE/TLCLISTList/TLCLIST", 10_000)
        pairs = np.array([self.file.numbers_of(entry.text or "", "TLCLIST", 2) for entry in listed]).reshape(-1, 2)
        steps, times = np.diff(pairs, axis=0).T
        if len(pairs) < 2 or not (steps > 0).all() or not ((times > 0).all() or (times < 0).all()):
            raise self.file.error(
                "TLCLIST needs at least two pairs; rows must increase, and times must all increase or all decrease",
                "TLCLISTList",
            )
        period = float((pairs[-1, 1] - pairs[0, 1]) / (pairs[-1, 0] - pairs[0, 0]))
        uneven = np.abs(pairs[:, 1] - pairs[0, 1] - (pairs[:, 0] - pairs[0, 0]) * period).max() / abs(period)
        if not (0 < abs(period) < 1 and uneven <= _EVEN):
            raise self.file.error(f"the line rate is not constant (by {uneven:.2g} rows)", "TLCLISTList")
        return start + float(pairs[0, 1] - pairs[0, 0] * period), period

    @property
    def facts(self) -> dict[str, Any]:
        """Facts for people; damaged ones are left out."""
        image = "IMD/IMAGE"
        facts: dict[str, Any] = {
            "satellite": self.file.said(f"{image}/SATID"),
            "catalogue_id": self.file.said(f"{image}/CATID"),
            "acquired": self.file.said(f"{image}/FIRSTLINETIME") or self.file.said(f"{image}/TLCTIME"),
            "band": self.file.said("IMD/BANDID"),
            "level": self.file.said("IMD/PRODUCTLEVEL"),
        }
        numbers = {
            "sun_elevation_deg": "MEANSUNEL",
            "sun_azimuth_deg": "MEANSUNAZ",
            "off_nadir_deg": "MEANOFFNADIRVIEWANGLE",
            "cloud_cover": "CLOUDCOVER",
        }
        for name, tag in numbers.items():
            try:
                facts[name] = round(self.file.number(f"{image}/{tag}"), 4)
            except InputError:
                continue
        if facts.get("cloud_cover", 0) < 0:
            del facts["cloud_cover"]  # the vendor's word for one that is not known
        return {name: value for name, value in facts.items() if value is not None}


@reads("copy the metadata again from the delivery, or use the RPC")
def read_isd_pushbroom(
    source: PathLike[str] | Isd, *, size: tuple[int, int] | None = None, first: tuple[int, int] = (0, 0)
) -> Pushbroom:
    """Read the rigorous model of an image, or of a tile of it.

    Parameters
    ----------
    source : path or Isd
    size, first : (int, int)
        Columns and rows of the tile, and its first column and row; default: the whole image.

    Raises
    ------
    InputError
        If something is missing or impossible, or the conventions of the camera are not known.
    """
    isd = source if isinstance(source, Isd) else Isd(source)
    file = isd.file
    columns, rows = size or isd.size
    start, period = isd.rows
    across, along = _look(file, isd.band)
    began = start + (first[1] - 0.5) * period
    heights = HEIGHTS if isd.rpc is None else isd.rpc.height_range
    # From the first pixel centre of the whole image to the outer corner of the first pixel of the tile.
    shifted = np.array([across[0] + (first[0] - 0.5) * across[1], across[1]])
    eph_times, places = _rows_of(file, "EPH", "EPHEMLIST", 12)
    att_times, quaternions = _rows_of(file, "ATT", "ATTLIST", 14)
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternions[:, :4], axis=1)
    if not (np.abs(length - 1) <= _UNIT_LENGTH).all():
        raise file.error("the quaternions of the attitude do not have length one", "ATTLISTList")
    try:
        model = pushbroom_of_tables(
            LineCamera.of_polynomials(columns, rows, shifted, along),
            line_period=period,
            first_time=0.0,
            orbit=(eph_times - began, places[:, :3]),
            attitude=(
                att_times - began,
                rotations_of_quaternions(quaternions[:, :4], scalar="last") @ _VENDOR_FROM_CAMERA,
            ),
            heights=heights,
        )
        model = replace(model, light=_LIGHT)
        require_view(model)  # damaged numbers may well make a camera that looks into the sky
    except InputError as error:
        raise InputError(error.message, file=isd.path, field=error.field, remedy=error.remedy) from error
    return model


def _look(file: XmlFields, band: str) -> tuple[Array, Array]:
    """Return u and v (`LineCamera.of_polynomials`) of the column counted from 0 at the first centre."""
    if file.has("GEO/OPTICAL_DISTORTION/POLYORDER") and file.number("GEO/OPTICAL_DISTORTION/POLYORDER") >= 0:
        raise file.error("optical distortion is not supported", "OPTICAL_DISTORTION/POLYORDER")
    turned = [file.number(f"GEO/CAMERA_ATTITUDE/QCS{k}") for k in (1, 2, 3, 4)]
    if np.abs(np.subtract(turned, (0.0, 0.0, 0.0, 1.0))).max() > 1e-9:
        raise file.error("a camera that is rotated in its platform is not supported", "CAMERA_ATTITUDE")
    if any(file.number(f"GEO/PERSPECTIVE_CENTER/C{axis}") for axis in "XYZ"):
        raise file.error("a camera that is off the centre of its platform is not supported", "PERSPECTIVE_CENTER")
    mounted = file.all(f"GEO/DETECTOR_MOUNTING/BAND_{band}/DETECTOR_ARRAY", 100) if band.isalnum() else []
    if len(mounted) != 1:
        raise file.error(
            f"{len(mounted)} detector arrays for band {band!r}; exactly one is supported", "DETECTOR_MOUNTING"
        )
    x, y, angle, pitch = (
        file.number(name, mounted[0]) for name in ("DETORIGINX", "DETORIGINY", "DETROTANGLE", "DETPITCH")
    )
    distance = file.number("GEO/PRINCIPAL_DISTANCE/PD")
    if angle:
        raise file.error("rotated detectors are not supported", "DETROTANGLE")
    if not (distance > 0 and 1e-8 < pitch / distance < 1e-3):
        raise file.error(f"a detector pitch of {pitch} mm at {distance} mm is not possible", "PD, DETPITCH")
    return np.array([-y, pitch]) / distance, np.array([x]) / distance


def _rows_of(file: XmlFields, part: str, name: str, count: int) -> tuple[Array, Array]:
    """Return times (seconds of the day) and the values of a list, without their numbers."""
    step = file.number(f"{part}/TIMEINTERVAL")
    entries = file.all(f"{part}/{name}List/{name}")
    values = np.array([file.numbers_of(entry.text or "", f"{name}List", count + 1) for entry in entries])
    if len(values) < 4 or not 0 < step < 1000:
        raise file.error(f"{len(values)} rows, {step} s apart, are not a valid table", f"{name}List")
    if (np.abs(values[:, 0]) > 1e6).any():
        raise file.error("the rows are not numbered in order", f"{name}List")
    return file.time(f"{part}/STARTTIME") + step * (values[:, 0] - 1), values[:, 1:]
