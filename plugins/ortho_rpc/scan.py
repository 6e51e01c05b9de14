"""A scene as either version of DIMAP metadata describes it: times, orbit, attitude, look angles (`ortho_rpc.dimap`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from ortho_pipeline.plugin import LightPath, rotations_of_quaternions
from ortho_rpc.dimap_file import MOST_TERMS, DimapFile

Array = NDArray[np.float64]

FIRST, SECOND = "Geometric_Data/Sensor_Model_Characteristics", "Geometric_Data/Refined_Model"
_NO_LIGHT = LightPath()
#: Products of version 2 whose conventions were checked against numbers of the vendor, and what light does on its way to
#: the camera that their angles leave out: the RPC of Pleiades Neo bends with height as refraction does.
PROFILES = {
    "PHR_SENSOR": _NO_LIGHT,
    "S6_SENSOR": _NO_LIGHT,
    "S7_SENSOR": _NO_LIGHT,
    "PNEO_SENSOR": LightPath(refraction=True),
}
#: Units of line periods in seconds; Pleiades states none.
_UNITS = {None: 1e-3, "ms": 1e-3, "millisecond": 1e-3, "microsecond": 1e-6, "us": 1e-6}
#: How often an attitude polynomial is sampled, and by how many cubic polynomials it is followed: to 1e-12 rad.
_SAMPLES, _PIECES = 96, 24
#: Quaternions are normalised, but those of a vendor are nearly so: others are damaged.
_UNIT_LENGTH = 0.01
# camera axes (along the line, forward, to the ground) in those of the vendor (psi_Y, -psi_X, 1)
_VENDOR_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Scan:
    """A scene as described by either version; times are seconds of the day.

    Parameters
    ----------
    start : float
        Exposure time of the centre of the first row.
    psi_x, psi_y : (k,)
        Polynomials, lowest power first, of the column counted from 0 at the first centre.
    orbit : (N,), (N, 3)
    attitude : callable(first, duration) -> (N,), (N, 3, 3)
        Times and rotations for a duration in seconds, from `first` on.
    pieces : int, optional
        Number of polynomials for the attitude; default: through all its rows.
    light : LightPath
        Effects that the angles do not include.
    """

    columns: int
    rows: int
    period: float
    start: float
    psi_x: Array
    psi_y: Array
    orbit: tuple[Array, Array]
    attitude: Callable[[float, float], tuple[Array, Array]]
    pieces: int | None
    light: LightPath = _NO_LIGHT


def first_version(file: DimapFile) -> Scan:
    rows, columns = file.integer("Raster_Dimensions/NROWS"), file.integer("Raster_Dimensions/NCOLS")
    period = _possible_period(file, file.number(f"{FIRST}/SENSOR_LINE_PERIOD") / 1000, "SENSOR_LINE_PERIOD")
    start = file.time(f"{FIRST}/UTC_Sensor_Model_Range/START")
    _refuse_part_of_a_line(file, f"{FIRST}/Sensor_Viewing_Model/Position_In_Retina", columns)
    _refuse_other_duration(file, f"{FIRST}/UTC_Sensor_Model_Range", start, rows * period)
    psi_x, psi_y = (
        file.polynomial(f"{FIRST}/Sensor_Viewing_Model/Viewing_Directions/{name}_Model") for name in ("PsiX", "PsiY")
    )
    base = f"{FIRST}/Sensor_Attitudes"
    attitude = _polynomial_attitude(file, base, f"{base}/Polynomial_Models")
    orbit = _orbit(file, f"{FIRST}/Sensor_Ephemeris", "UTC_TIME", "LOCATION_VALUES")
    return Scan(columns, rows, period, start, psi_x, psi_y, orbit, attitude, _PIECES)


def second_version(file: DimapFile) -> Scan:
    profile = file.text("Metadata_Identification/METADATA_PROFILE")
    if profile not in PROFILES:
        raise file.error(
            f"products of {profile[:40]} are not supported, because they could not be tested. Supported are"
            f" {', '.join(PROFILES)}",
            "METADATA_PROFILE",
        )
    size = "Raster_Data/Raster_Dimensions"
    rows, columns = file.integer(f"{size}/NROWS"), file.integer(f"{size}/NCOLS")
    stamp = f"{SECOND}/Time/Time_Stamp/LINE_PERIOD"
    value, element = file.number(stamp), file.root.find(stamp)
    unit = None if element is None else element.get("unit")
    if unit not in _UNITS:
        raise file.error(f"{unit[:20]!r} is not a known unit", "LINE_PERIOD")
    period = _possible_period(file, value * _UNITS[unit], "LINE_PERIOD")
    start = file.time(f"{SECOND}/Time/Time_Range/START")
    _refuse_other_duration(file, f"{SECOND}/Time/Time_Range", start, rows * period)
    psi_x, psi_y = _look_angles(file, columns)
    base = f"{SECOND}/Attitudes"
    if file.has(f"{base}/Polynomial_Quaternions"):
        name, pieces = f"{base}/Polynomial_Quaternions", _PIECES
        attitude = _polynomial_attitude(file, name, name)
    else:
        attitude, pieces = _listed_attitude(file, f"{base}/Quaternion_List"), None
    orbit = _orbit(file, f"{SECOND}/Ephemeris", "TIME", "LOCATION_XYZ")
    return Scan(columns, rows, period, start, psi_x, psi_y, orbit, attitude, pieces, PROFILES[profile])


def _look_angles(file: DimapFile, columns: int) -> tuple[Array, Array]:
    """Return the polynomials of both angles; all bands of the image must share them."""
    base = f"{SECOND}/Geometric_Calibration/Instrument_Calibration"
    for name in ("YAW", "PITCH", "ROLL"):
        field = f"{base}/Instrument_Biases/{name}"
        if file.has(field) and file.number(field) != 0:
            raise file.error("an instrument bias with an unknown direction of rotation is not supported", field)
    bands = file.all(f"{base}/Band_Calibration_List/Band_Calibration", 100)
    places = [f"{base}/Band_Calibration_List/Band_Calibration[{k + 1}]" for k in range(len(bands))] or [base]
    polynomials = []
    for place in places:
        _refuse_part_of_a_line(file, f"{place}/Swath_Range", columns)
        polynomials.append([_angle(file, f"{place}/Polynomial_Look_Angles", name) for name in ("XLOS", "YLOS")])
    if any(not np.array_equal(*pair) for other in polynomials for pair in zip(other, polynomials[0], strict=True)):
        raise file.error("each band has its own look angles; this is not supported", "Band_Calibration_List")
    return polynomials[0][0], polynomials[0][1]


def _angle(file: DimapFile, base: str, name: str) -> Array:
    """Return the coefficients ``name_0``, ``name_1`` ...; the first one is required."""
    terms = [file.number(f"{base}/{name}_0")]
    while file.has(f"{base}/{name}_{len(terms)}") and len(terms) <= MOST_TERMS:
        terms.append(file.number(f"{base}/{name}_{len(terms)}"))
    listed = sum(element.tag.startswith(f"{name}_") for element in file.all(f"{base}/*"))
    if listed != len(terms):
        raise file.error("the coefficients do not form one polynomial", f"{base}/{name}_{len(terms)}")
    return np.array(terms)


def _possible_period(file: DimapFile, period: float, field: str) -> float:
    if not 0 < period < 1:
        raise file.error(f"{period} s is not a possible line period", field)
    return period


def _refuse_part_of_a_line(file: DimapFile, field: str, columns: int) -> None:
    """Raise an error unless the columns are those of the whole image; the convention for others is unknown."""
    if not file.has(field):
        return
    first = file.number(f"{field}/FIRST_COL")
    last = file.number(f"{field}/LAST_COL") if file.has(f"{field}/LAST_COL") else columns
    if first != 1:
        raise file.error(f"the image begins at column {first:g} of the line; such images are not supported", field)
    if field.endswith("Swath_Range") and last != columns:
        raise file.error(f"there are look angles for {last:g} columns, but the image has {columns}", field)


def _refuse_other_duration(file: DimapFile, field: str, start: float, duration: float) -> None:
    """Raise an error for a part of a pass, because it is not stated which rows the image has."""
    if not file.has(f"{field}/END"):
        return
    taken = file.time(f"{field}/END") - start
    if abs(taken - duration) > 0.01 * duration:
        raise file.error(f"the rows take {duration:.6g} s, but START and END are {taken:.6g} s apart", field)


def _polynomial_attitude(file: DimapFile, scaled: str, parts: str) -> Callable[[float, float], tuple[Array, Array]]:
    """Return the attitude polynomials, sampled to half an image beyond both ends."""
    offset, scale = file.number(f"{scaled}/OFFSET"), file.number(f"{scaled}/SCALE")
    if scale == 0:
        raise file.error("a scale is zero", f"{scaled}/SCALE")
    terms = [file.polynomial(f"{parts}/Q{k}") for k in range(4)]

    def sampled(first: float, duration: float) -> tuple[Array, Array]:
        times = np.linspace(first - 0.5 * duration, first + 1.5 * duration, _SAMPLES)
        with np.errstate(over="ignore", invalid="ignore"):
            quaternions = np.stack([polyval((times - offset) / scale, part) for part in terms], axis=1)
        return times, _turns(file, quaternions, parts)

    return sampled


def _listed_attitude(file: DimapFile, field: str) -> Callable[[float, float], tuple[Array, Array]]:
    rows = file.all(f"{field}/Quaternion")
    if not rows:
        raise file.error("the attitude has neither a polynomial nor a list of quaternions", field)
    times = np.array([file.time("TIME", row) for row in rows])
    quaternions = np.array([[file.number(f"Q{k}", row) for k in range(4)] for row in rows])
    turns = _turns(file, quaternions, field)
    return lambda first, duration: (times, turns)


def _turns(file: DimapFile, quaternions: Array, field: str) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternions, axis=1)
    if not (np.abs(length - 1) <= _UNIT_LENGTH).all():
        raise file.error("the quaternions of the attitude do not have length one", field)
    return np.asarray(rotations_of_quaternions(quaternions) @ _VENDOR_FROM_CAMERA)


def _orbit(file: DimapFile, field: str, time: str, place: str) -> tuple[Array, Array]:
    """Return times and positions ``(N, 3)``."""
    points = file.all(f"{field}/Point_List/Point")
    times = np.array([file.time(time, point) for point in points])
    return times, np.array([file.numbers(place, 3, point) for point in points]).reshape(-1, 3)
