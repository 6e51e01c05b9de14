"""The rigorous model in DIMAP metadata of Pleiades: orbit, attitude and look directions instead of an RPC.

What the vendor's numbers mean (checked against the vendor's own location grid, to 0.2 mm):

- the *centre* of row 0 is exposed at START, the next ones every SENSOR_LINE_PERIOD milliseconds;
- positions (ECEF) between those of the table follow from Lagrange's polynomial through eight of them; the velocities
  are left alone, they lack the rotation of the Earth;
- the attitude is a quaternion to ECEF, scalar first, each part a polynomial in (seconds of the day - OFFSET) / SCALE,
  to be normalised;
- a column looks along (psi_Y, -psi_X, 1): both angles are polynomials in the column counted from 0 and are used as they
  are, without a tangent;
- no light time, no aberration, no refraction.
"""

from __future__ import annotations

import math
import re
from datetime import datetime
from os import PathLike
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import read_bounded
from ortho_pipeline.models.line_camera import MOST_PIXELS, LineCamera
from ortho_pipeline.models.pushbroom import Pushbroom
from ortho_pipeline.models.pushbroom_start import pushbroom_of_tables, rotations_of_quaternions

Array = NDArray[np.float64]

MAX_SIZE = 5_000_000
_MODEL = "Geometric_Data/Sensor_Model_Characteristics"
#: Heights (m) of the ground where the metadata say nothing of them.
_HEIGHTS = (-100.0, 3000.0)
#: How often the attitude polynomial is sampled, and by how many cubic polynomials it is followed: to 1e-12 rad.
_SAMPLES, _PIECES = 96, 24
_MOST_TERMS, _MOST_POINTS = 10, 100_000
# camera axes (along the line, forward, to the ground) in those of the vendor (psi_Y, -psi_X, 1)
_VENDOR_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def has_dimap_pushbroom(path: str | PathLike[str]) -> bool:
    """Tell whether a file is DIMAP metadata with a rigorous model, from its text alone."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_SIZE + 1)
    except OSError:
        return False
    return len(data) <= MAX_SIZE and b"Dimap_Document" in data[:2000] and b"<Sensor_Model_Characteristics" in data


def read_dimap_pushbroom(path: str | PathLike[str]) -> Pushbroom:
    """Read the rigorous model of a Pleiades product.

    Free are offsets and drifts of the attitude.

    Raises
    ------
    InputError
        If the file is no such metadata, or something is missing or impossible in it.
    """
    file = _File(Path(path))
    rows, columns = file.integer("Raster_Dimensions/NROWS"), file.integer("Raster_Dimensions/NCOLS")
    period = file.number(f"{_MODEL}/SENSOR_LINE_PERIOD") / 1000
    if not 0 < period < 1:
        raise InputError(f"{period} s is no time for a row", file=path, field="SENSOR_LINE_PERIOD")
    first = file.time(f"{_MODEL}/UTC_Sensor_Model_Range/START") - 0.5 * period
    _refuse_parts(file, rows * period, first)
    psi_x, psi_y = (file.polynomial(f"{_MODEL}/Sensor_Viewing_Model/Viewing_Directions/{n}_Model") for n in _PSI)
    # The vendor counts columns from 0 at the first centre.
    across, along = (Polynomial(psi)(Polynomial([-0.5, 1.0])).coef for psi in (psi_x, psi_y))
    times = np.linspace(first - 0.5 * rows * period, first + 1.5 * rows * period, _SAMPLES)
    turns = rotations_of_quaternions(_quaternions(file, times)) @ _VENDOR_FROM_CAMERA
    try:
        model = pushbroom_of_tables(
            LineCamera.of_polynomials(columns, rows, across, along),
            line_period=period,
            first_time=0.0,
            orbit=_orbit(file, first),
            attitude=(times - first, turns),
            heights=_heights(file),
            segments=(None, _PIECES),
        )
        _ = model.domain  # damaged numbers may well make a camera that looks into the sky
    except InputError as error:
        raise InputError(error.message, file=path, field=error.field, remedy=error.remedy) from error
    return model


_PSI = ("PsiX", "PsiY")


def _refuse_parts(file: _File, duration: float, first: float) -> None:
    """Refuse metadata whose times and columns are not those of the whole image: no grid tells how to count them."""
    if file.root.find(f"{_MODEL}/Sensor_Viewing_Model/Position_In_Retina") is not None:
        column = file.number(f"{_MODEL}/Sensor_Viewing_Model/Position_In_Retina/FIRST_COL")
        if column != 1:
            raise InputError(
                f"the image begins in column {column:g} of the line: from where its look angles count is not known",
                file=file.path, field="Position_In_Retina", remedy="use the RPC",
            )  # fmt: skip
    if file.root.find(f"{_MODEL}/UTC_Sensor_Model_Range/END") is not None:
        taken = file.time(f"{_MODEL}/UTC_Sensor_Model_Range/END") - first
        if abs(taken - duration) > 0.01 * duration:
            raise InputError(
                f"the rows take {duration:.6g} s, from START to END there are {taken:.6g} s", file=file.path,
                field="UTC_Sensor_Model_Range", remedy="use the RPC",
            )  # fmt: skip


def _quaternions(file: _File, seconds: Array) -> Array:
    base = f"{_MODEL}/Sensor_Attitudes"
    offset, scale = file.number(f"{base}/OFFSET"), file.number(f"{base}/SCALE")
    if scale == 0:
        raise InputError("a scale of zero", file=file.path, field="Sensor_Attitudes/SCALE")
    parts = [file.polynomial(f"{base}/Polynomial_Models/Q{k}") for k in range(4)]
    return np.stack([polyval((seconds - offset) / scale, part) for part in parts], axis=1)


def _orbit(file: _File, first: float) -> tuple[Array, Array]:
    """Return times after the first row and positions ``(N, 3)``."""
    points = file.all(f"{_MODEL}/Sensor_Ephemeris/Point_List/Point")
    if len(points) > _MOST_POINTS:
        raise InputError(f"{len(points)} positions are no orbit of one scene", file=file.path, field="Sensor_Ephemeris")
    times = np.array([file.time("UTC_TIME", point) - first for point in points])
    places = np.array([file.numbers("LOCATION_VALUES", 3, point) for point in points]).reshape(-1, 3)
    return times, places


def _heights(file: _File) -> tuple[float, float]:
    """Return the range of heights for which the RPC of the same file is meant, if it has one."""
    path = "Geoposition/Rational_Sensor_Model/Global_RFM/RFM_Validity/Alt"
    if file.root.find(path) is None:
        return _HEIGHTS
    scale, offset = file.number(f"{path}/A"), file.number(f"{path}/B")
    if not 0 < abs(scale) < 20_000 or abs(offset) > 20_000:
        return _HEIGHTS
    return offset - abs(scale), offset + abs(scale)


class _File:
    """DIMAP metadata, whose fields are asked for by their path."""

    def __init__(self, path: Path) -> None:
        from defusedxml import ElementTree
        from defusedxml.common import DefusedXmlException

        self.path = path
        self._midnight: datetime | None = None
        data = read_bounded(path, MAX_SIZE)
        if len(data) > MAX_SIZE:
            raise InputError("this file has more than 5 MB, which no metadata of a scene has", file=path)
        try:
            self.root: Element = ElementTree.fromstring(data, forbid_dtd=True)
        except (ElementTree.ParseError, DefusedXmlException, ValueError, LookupError) as error:
            raise InputError(f"this is no well-formed XML ({error})", file=path) from error
        if self.root.find(_MODEL) is None:
            raise InputError(
                "there is no rigorous model in this file", file=path, field=_MODEL, remedy="use its RPC instead"
            )

    def text(self, field: str, parent: Element | None = None) -> str:
        """Return the text of a field."""
        text = (self.root if parent is None else parent).findtext(field)
        if text is None or not text.strip():
            raise InputError("this field is missing", file=self.path, field=field)
        return text.strip()

    def all(self, field: str) -> list[Element]:
        """Return all elements of a path."""
        return self.root.findall(field)

    def numbers(self, field: str, count: int | None, parent: Element | None = None) -> list[float]:
        """Return the finite numbers of a field, `count` of them."""
        tokens = self.text(field, parent).split(maxsplit=_MOST_TERMS)
        if len(tokens) > _MOST_TERMS or (count is not None and len(tokens) != count):
            raise InputError(f"{count or 'a few'} numbers belong here", file=self.path, field=field)
        values = []
        for token in tokens:
            if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?", token[:60], re.ASCII):
                raise InputError(f"{token[:60]!r} is no number", file=self.path, field=field)
            values.append(float(token[:60]))
        if not all(map(math.isfinite, values)):
            raise InputError("a number is too large", file=self.path, field=field)
        return values

    def number(self, field: str) -> float:
        """Return the finite number of a field."""
        return self.numbers(field, 1)[0]

    def integer(self, field: str) -> int:
        """Return the number of rows or columns in a field."""
        value = self.number(field)
        if value != int(value) or not 0 < value <= MOST_PIXELS:
            raise InputError(f"{value} is no size of an image", file=self.path, field=field)
        return int(value)

    def polynomial(self, field: str) -> Array:
        """Return the coefficients, lowest power first, of a polynomial with its degree."""
        terms = self.numbers(f"{field}/COEFFICIENTS", None)
        if len(terms) != self.number(f"{field}/DEGREE") + 1:
            raise InputError("degree and coefficients do not match", file=self.path, field=field)
        return np.array(terms)

    def time(self, field: str, parent: Element | None = None) -> float:
        """Return a UTC time as seconds after midnight of the day on which the image begins.

        Counted from an epoch far away the seconds would be rounded to a millimetre of orbit.
        """
        text = self.text(field, parent)
        found = re.fullmatch(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(\.\d{1,12})?Z?", text[:60], re.ASCII)
        try:
            whole = datetime.fromisoformat(found[1]) if found else None
        except ValueError:
            whole = None
        if found is None or whole is None:
            raise InputError(f"{text[:60]!r} is no time", file=self.path, field=field)
        self._midnight = self._midnight or whole.replace(hour=0, minute=0, second=0)
        return (whole - self._midnight).total_seconds() + float(found[2] or 0.0)
