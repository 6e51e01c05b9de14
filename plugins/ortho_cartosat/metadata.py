"""The `_MET.TXT` of a CARTOSAT-1 product: ``key = value`` lines (docs/formats/cartosat.md), read with tolerance.

Blanks are irregular, cases vary, ``-NA-`` means unknown, and lines without an assignment are titles. A key is only
checked when it is read; an invalid value is an error that names file and key.
"""

from __future__ import annotations

import datetime
import math
import re
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np

from ortho_pipeline.plugin import Array, InputError, decoded, place, read_bounded, reads

MAX_BYTES = 1_000_000
_REMEDY = "copy the _MET.TXT again from the delivery"
MISSING = frozenset({"", "-NA-", "NA", "N/A", "-", "NULL"})
#: Along-track tilts of the two cameras, degrees: Willneff et al., table 1.
TILTS_DEG = {"fore": 26.0, "aft": -5.0}
CORNERS = ("UL", "UR", "LR", "LL")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_SATELLITE = re.compile(r"(IRS)?(P5|C(ARTO)?(SAT)?0?1[AB]?)")
_TIMES = ("%d-%b-%Y %H:%M:%S.%f", "%d-%b-%Y %H:%M:%S", "%d-%b-%Y:%H:%M:%S.%f", "%Y-%m-%d %H:%M:%S.%f", "%d-%b-%Y")


@dataclass(frozen=True)
class Metadata:
    """The statements of a `_MET.TXT`.

    Attributes
    ----------
    path : Path
    fields : dict of str to tuple of str
        Values by key in lower case, all that the file gives for it.
    """

    path: Path
    fields: dict[str, tuple[str, ...]]

    def text(self, *keys: str) -> str | None:
        """Return the value of the first of these keys that the file has one for.

        Raises
        ------
        InputError
            If the file gives two different ones.
        """
        for key in keys:
            values = {value for value in self.fields.get(key.lower(), ()) if value.upper() not in MISSING}
            if len(values) > 1:
                raise InputError(
                    "this key appears twice, with different values", file=self.path, field=key, remedy=_REMEDY
                )
            if values:
                return values.pop()
        return None

    def number(self, *keys: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        """Return the first of these keys that has a value as a number; a unit after it is ignored.

        Raises
        ------
        InputError
            If the value is not a number, or not within `low` and `high`.
        """
        key = next((key for key in keys if self.text(key) is not None), None)
        if key is None:
            return None
        token, *rest = str(self.text(key)).split()
        if not _NUMBER.fullmatch(token):
            raise InputError(f"{token[:60]!r} is not a number", file=self.path, field=key, remedy=_REMEDY)
        # Degrees, minutes and seconds would otherwise be read as whole degrees.
        if any(map(_NUMBER.fullmatch, rest)):
            text = str(self.text(key))[:60]
            raise InputError(f"{text!r} is not one number", file=self.path, field=key, remedy="write it as one number")
        value = float(token)
        if not low <= value <= high or not math.isfinite(value):
            raise InputError(f"{token[:60]} is out of range", file=self.path, field=key, remedy=f"{low:g} to {high:g}")
        return value

    @property
    def is_cartosat1(self) -> bool:
        """Whether the satellite is CARTOSAT-1 (IRS-P5)."""
        name = self.text("SatID", "Satellite", "SatelliteID") or ""
        return _SATELLITE.fullmatch(re.sub(r"[\W_]", "", name.upper())) is not None

    @property
    def view(self) -> str | None:
        """'fore' or 'aft', from the sensor's name or its angle along the track; None if neither states it."""
        sensor = re.sub(r"[\W_]", "", (self.text("Sensor", "BandNumbers") or "").upper())
        for name, view in (("FORE", "fore"), ("AFT", "aft"), ("PANF", "fore"), ("PANA", "aft")):
            if name in sensor:
                return view
        angle = self.number("ViewAngleAlongTrack", "ViewAngle", low=-60, high=60)
        if angle is None:
            return None
        # Whatever its sign: one camera looks steeply, the other hardly.
        return "fore" if abs(angle) > 15 else "aft"

    @property
    def size(self) -> tuple[int, int] | None:
        """Columns and rows of the product."""
        columns, rows = (self.number(key, low=1, high=1e6) for key in ("NoPixels", "NoScans"))
        return None if columns is None or rows is None else (int(columns), int(rows))

    @property
    def altitude(self) -> float | None:
        """Flying height above the ground in metres; the file has kilometres."""
        kilometres = self.number("SatelliteAltitude", low=100, high=2000)
        return None if kilometres is None else kilometres * 1e3

    @cached_property
    def corners(self) -> Array | None:
        """Longitudes and latitudes (degrees) of upper left, upper right, lower right, lower left: ``(4, 2)``.

        Those of the image go before those of the product, which may be the box around it.
        """
        for prefix in ("Image", "Prod"):
            corners = [
                (
                    self.number(f"{prefix}{corner}Lon", low=-180, high=360),
                    self.number(f"{prefix}{corner}Lat", low=-90, high=90),
                )
                for corner in CORNERS
            ]
            values = [number for corner in corners for number in corner if number is not None]
            if len(values) == 8:
                return np.array(values).reshape(4, 2)
            if values:
                missing = next(
                    f"{prefix}{name}" for name, corner in zip(CORNERS, corners, strict=True) if None in corner
                )
                raise InputError("this corner is incomplete", file=self.path, field=missing, remedy=_REMEDY)
        return None

    @property
    def acquired(self) -> str | None:
        """Time of the middle of the scene, as ISO 8601 in UTC if it can be parsed, otherwise unchanged."""
        text = self.text("SceneCenterTime", "SceneCentreTime", "DateOfPass")
        if text is None:
            return None
        # Nanoseconds are more than Python reads.
        plain = re.sub(r"(\.\d{6})\d+", r"\1", " ".join(text.split()))
        for form in _TIMES:
            try:
                time = datetime.datetime.strptime(plain, form)
            except ValueError:
                continue
            return time.date().isoformat() if form == "%d-%b-%Y" else f"{time.isoformat()}Z"
        return text[:60]


@reads(_REMEDY)
def read_metadata(path: str | PathLike[str]) -> Metadata:
    """Read a `_MET.TXT`.

    Raises
    ------
    InputError
        If the file cannot be read, is not text, or holds no assignment.
    """
    path = place(path)
    data = read_bounded(path, MAX_BYTES)
    if len(data) > MAX_BYTES or b"\0" in data:
        raise InputError("this is not a metadata file: it is too large, or not text", file=path)
    fields: dict[str, tuple[str, ...]] = {}
    for line in decoded(data).splitlines():
        key, sign, value = (part.strip() for part in line[:2000].partition("="))
        if sign and key:
            fields[key.lower()] = (*fields.get(key.lower(), ()), value.strip("\"'").strip())
    if not fields:
        raise InputError("this file has no line 'key = value'", file=path)
    return Metadata(path, fields)
