r"""DIMAP 1 metadata of SPOT 1 to 5, level 1A: ephemeris, attitude and look angles of the detectors as a line scanner.

Conventions of the vendor:

- the *centre* of row l, counted from 1, is exposed at SCENE_CENTER_TIME + (l - SCENE_CENTER_LINE) LINE_PERIOD;
- positions and velocities (ECEF, relative to the rotating Earth) are interpolated by Lagrange's polynomial through
  eight rows of the table;
- the orbital frame has Z along the position, X along velocity x Z (to the right of the flight), Y = Z x X;
- detector p looks along :math:`(-\tan\psi_Y, \tan\psi_X, -1)` on board; SPOT 1 to 4 give the angles of the first and
  the last detector, between which they are linear, SPOT 5 those of every detector; detector 1 is column 1;
- on board is turned into the orbital frame by :math:`M_p M_r M_y` with

  .. math:: M_p = \begin{pmatrix}1&0&0\\0&c_p&s_p\\0&-s_p&c_p\end{pmatrix},\
      M_r = \begin{pmatrix}c_r&0&-s_r\\0&1&0\\s_r&0&c_r\end{pmatrix},\
      M_y = \begin{pmatrix}c_y&-s_y&0\\s_y&c_y&0\\0&0&1\end{pmatrix},

  of the corrected attitude of SPOT 5. SPOT 1 to 4 have none: their angles are zero in the vendor's own location;
- no light time, no aberration, no refraction.

Source: SPOT Satellite Geometry Handbook, S-NT-73-12-SI, chapter 4. Checked against the vendor's frame corners at height
0: their differences agree within 0.01 m for SPOT 1, 2 and 3 and 0.06 m for SPOT 5 (whose corners are printed to 0.1 m);
together they are 0.4, 0.4, 1.2 and 0.02 m along the track, as much as the milliseconds of SCENE_CENTER_TIME leave open
for SPOT 1 to 3 (3.3 m). The centre of SPOT 1 is 3 m off them, a third of a row, for its row is printed as a whole one.
Angular speeds have the signs of the angles: on SPOT 5, integrated and without their parabola, they correlate with those
of the star tracker by 0.996 (pitch), 0.84 (roll) and 0.71 (yaw).
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.plugin import (
    InputError,
    LineCamera,
    Pushbroom,
    XmlFields,
    lagrange,
    pushbroom_of_tables,
    reads,
    require_view,
)

Array = NDArray[np.float64]

#: A file of 24,000 detectors with their calibration has 10 MB.
MAX_SIZE = 20_000_000
#: Height range (m) of the camera, because none is stated.
HEIGHTS = (-500.0, 9000.0)
_STRIP, _CONFIGURATION = "Data_Strip", "Data_Strip/Sensor_Configuration"
_ATTITUDES = f"{_STRIP}/Satellite_Attitudes"
_SOURCE = "Dataset_Sources/Source_Information/Scene_Source"
_SAID = (
    "MISSION",
    "MISSION_INDEX",
    "INSTRUMENT",
    "INSTRUMENT_INDEX",
    "SENSOR_CODE",
    "IMAGING_DATE",
    "IMAGING_TIME",
    "SUN_AZIMUTH",
    "SUN_ELEVATION",
    "INCIDENCE_ANGLE",
)
#: Camera axes (along the line, forward, to the ground) in those of the vendor on board.
_VENDOR_FROM_CAMERA = np.diag([-1.0, 1.0, -1.0])
#: Time step (s) of tables of frame and attitude, unless the vendor's rows are used.
_EVERY, _SPEEDS_EVERY = 0.25, 0.125
#: Angles are used this much (s) beyond both ends, because a cubic needs four rows.
_BEYOND = 1.0
#: Columns that represent the tangent of angles that are linear along a line.
_COLUMNS = 33
#: Bands whose look angles differ by more than this (px) from those of the first give a warning.
_SAME = 0.5


@dataclass(frozen=True)
class SpotScene:
    """A scene as its metadata describe it.

    Parameters
    ----------
    model : Pushbroom
        Free are offset and drift of the attitude.
    facts : dict
    bands_differ : float
        By how many pixels the look angles of its bands differ.
    """

    model: Pushbroom
    facts: dict[str, Any]
    bands_differ: float


@reads("copy the metadata again from the delivery")
def read_spot(path: PathLike[str], *, attitude: str = "vendor", heights: tuple[float, float] = HEIGHTS) -> SpotScene:
    """Read a scene of level 1A.

    Parameters
    ----------
    attitude : {'vendor', 'speeds'}
        The angles with which the vendor locates, or those of integrated angular speeds about zero (SPOT 1 to 4).

    Raises
    ------
    InputError
        If the file is not DIMAP 1, not of level 1A, or something is missing or impossible in it.
    """
    file = XmlFields(path, limit=MAX_SIZE)
    level = file.text("Data_Processing/PROCESSING_LEVEL")
    if level != "1A":
        raise file.error(
            f"this product of level {level[:10]} is resampled, so its metadata do not describe its pixels",
            "Data_Processing/PROCESSING_LEVEL",
            "use the scene at level 1A",
        )
    columns, rows = (file.integer(f"Raster_Dimensions/{name}") for name in ("NCOLS", "NROWS"))
    lines = file.all(f"{_CONFIGURATION}/Instrument_Look_Angles_List/Instrument_Look_Angles", 20)
    if not lines:
        raise file.error("the metadata have no look angles", "Instrument_Look_Angles_List")
    psi_x, psi_y = _look_angles(file, lines[0], columns)
    period = file.number(f"{_CONFIGURATION}/Time_Stamp/LINE_PERIOD")
    if not 0 < period < 1:
        raise file.error(f"{period} s is not a possible line period", "LINE_PERIOD")
    centre = file.number(f"{_CONFIGURATION}/Time_Stamp/SCENE_CENTER_LINE")
    first = file.time(f"{_CONFIGURATION}/Time_Stamp/SCENE_CENTER_TIME") + (0.5 - centre) * period
    orbit = _orbit(file)
    at = np.linspace(0.5, columns - 0.5, len(psi_x))
    try:
        model = pushbroom_of_tables(
            LineCamera.of_table(columns, rows, at, np.tan(psi_y), np.tan(psi_x)),
            line_period=period,
            first_time=first,
            orbit=orbit[:2],
            attitude=_attitude(file, orbit, (first, rows * period), attitude),
            heights=heights,
        )
        require_view(model)  # damaged numbers may well make a camera that looks into the sky
    except InputError as error:
        raise InputError(error.message, file=path, field=error.field, remedy=error.remedy) from error
    pixel = np.ptp(psi_y) / (len(psi_y) - 1) * (len(psi_y) - 1) / columns
    others = [_look_angles(file, line, columns) for line in lines[1:]]
    differ = max(
        (
            np.abs(theirs - ours).max() / pixel
            for other in others
            for theirs, ours in zip(other, (psi_x, psi_y), strict=True)
            if len(theirs) == len(ours)
        ),
        default=0.0,
    )
    return SpotScene(model, _facts(file), float(differ))


def _facts(file: XmlFields) -> dict[str, Any]:
    """Return facts of the metadata; missing ones are left out."""
    said = {name: file.said(f"{_SOURCE}/{name}") for name in _SAID}

    def joined(first: str, second: str, sign: str = "") -> str | None:
        return sign.join(filter(None, (said[first], said[second]))) if said[first] and said[second] else None

    facts = {
        "satellite": joined("MISSION", "MISSION_INDEX"),
        "instrument": joined("INSTRUMENT", "INSTRUMENT_INDEX"),
        "mode": said["SENSOR_CODE"],
        "acquired": joined("IMAGING_DATE", "IMAGING_TIME", "T"),
        "sun_azimuth_deg": said["SUN_AZIMUTH"],
        "sun_elevation_deg": said["SUN_ELEVATION"],
        "incidence_deg": said["INCIDENCE_ANGLE"],
    }
    for name in [name for name in facts if name.endswith("_deg") and facts[name]]:
        try:
            facts[name] = round(file.numbers_of(str(facts[name]), name, 1)[0], 4)  # type: ignore[assignment]
        except InputError:
            facts[name] = None
    return {name: value for name, value in facts.items() if value is not None}


def _look_angles(file: XmlFields, line: Element, columns: int) -> tuple[Array, Array]:
    """Return psi_X and psi_Y (rad) at evenly spaced columns, including the centres of the first and the last."""
    entries = line.findall("Look_Angles_List/Look_Angles")
    field = "Look_Angles_List/Look_Angles"
    detectors = np.array([file.number("DETECTOR_ID", entry) for entry in entries])
    angles = np.array([[file.number(name, entry) for name in ("PSI_X", "PSI_Y")] for entry in entries]).reshape(-1, 2)
    if not (np.abs(angles) < 1.2).all():
        raise file.error("a look angle is out of range", field)
    complete = len(detectors) >= 2 and detectors[0] == 1 and detectors[-1] == columns
    if not complete or len(detectors) not in (2, columns) or not (np.diff(detectors) > 0).all():
        raise file.error(
            f"{len(detectors)} detectors do not match the {columns} columns of this image; the first must be "
            f"detector 1",
            field,
        )
    if len(detectors) == 2:
        share = np.linspace(0.0, 1.0, min(_COLUMNS, columns))[:, None]
        angles = angles[0] + share * (angles[1] - angles[0])
    return angles[:, 0], angles[:, 1]


def _orbit(file: XmlFields) -> tuple[Array, Array, Array]:
    """Return times, positions and velocities ``(N, 3)``."""
    points = file.all(f"{_STRIP}/Ephemeris/Points/Point", 10_000)
    times = np.array([file.time("TIME", point) for point in points])
    places, rates = (
        np.array([[file.number(f"{part}/{axis}", point) for axis in "XYZ"] for point in points]).reshape(-1, 3)
        for part in ("Location", "Velocity")
    )
    if len(times) < 4 or not (np.diff(times) > 0).all():
        raise file.error(
            f"{len(times)} positions do not give an orbit (at least 4, at increasing times)", "Ephemeris/Points"
        )
    return times, places, rates


def _attitude(
    file: XmlFields, orbit: tuple[Array, Array, Array], span: tuple[float, float], kind: str
) -> tuple[Array, Array]:
    """Return times and rotations from camera to ECEF, to half an image beyond both ends if the tables cover it."""
    first, duration = span
    low, high = max(first - duration / 2, orbit[0][0]), min(first + 1.5 * duration, orbit[0][-1])
    if not high > low:
        raise file.error("the positions do not cover the image", "Ephemeris/Points")
    corrected = file.has(f"{_ATTITUDES}/Corrected_Attitudes")
    if corrected and kind == "speeds":
        raise file.error(
            "this scene has a corrected attitude, which is more accurate than angular speeds",
            "Corrected_Attitudes",
            "use attitude=vendor",
        )
    if corrected:
        times, angles = _rows(file, f"{_ATTITUDES}/Corrected_Attitudes/Corrected_Attitude//Angles")
    elif kind == "vendor":
        times = np.linspace(low, high, max(8, min(2000, int((high - low) / _EVERY))))
        angles = np.zeros((len(times), 3))
    else:
        its, turned = _integrated(file, span)
        # They end with the image, which may extend slightly beyond: there the angles stay constant.
        times = np.linspace(low, high, max(8, min(2000, int((high - low) / _SPEEDS_EVERY))))
        angles = np.column_stack([np.interp(times, its, part) for part in turned.T])
    near = (times >= max(low - _BEYOND, orbit[0][0])) & (times <= min(high + _BEYOND, orbit[0][-1]))
    times, angles = times[near], angles[near]
    with np.errstate(all="ignore"):
        places, rates = (lagrange(orbit[0], table, times)[0] for table in orbit[1:])
        z = places / np.linalg.norm(places, axis=1)[:, None]
        x = np.cross(rates, z)
        x /= np.linalg.norm(x, axis=1)[:, None]
    if not np.isfinite(x).all():
        raise file.error("positions and velocities do not match a satellite orbit", "Ephemeris/Points")
    orbital = np.stack([x, np.cross(z, x), z], axis=2)
    return times, orbital @ _on_board(*angles.T) @ _VENDOR_FROM_CAMERA


def _on_board(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Return M_p M_r M_y ``(N, 3, 3)``."""
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])

    def matrix(*parts: Array) -> Array:
        return np.stack(parts, axis=1).reshape(-1, 3, 3)

    by_pitch = matrix(one, zero, zero, zero, cp, sp, zero, -sp, cp)
    by_roll = matrix(cr, zero, -sr, zero, one, zero, sr, zero, cr)
    return by_pitch @ by_roll @ matrix(cy, -sy, zero, sy, cy, zero, zero, zero, one)


def _rows(file: XmlFields, field: str) -> tuple[Array, Array]:
    """Return times and yaw, pitch, roll ``(N, 3)`` of a list, without rows that are marked out of range."""
    entries = [one for one in file.all(field) if (one.findtext("OUT_OF_RANGE") or "N").strip() != "Y"]
    if len(entries) < 4:
        raise file.error(f"{len(entries)} of these do not give an attitude", field)
    times = np.array([file.time("TIME", entry) for entry in entries])
    angles = np.array([[file.number(name, entry) for name in ("YAW", "PITCH", "ROLL")] for entry in entries])
    if not (np.abs(angles) < 0.1).all():
        raise file.error("an attitude angle is larger than 0.1 rad", field)
    return times, angles


def _integrated(file: XmlFields, span: tuple[float, float]) -> tuple[Array, Array]:
    """Return angles whose rates are the angular speeds, without their mean over the image."""
    field = f"{_ATTITUDES}/Raw_Attitudes/Aocs_Attitude/Angular_Speeds_List/Angular_Speeds"
    times, speeds = _rows(file, field)
    steps = np.diff(times)[:, None] * (speeds[1:] + speeds[:-1]) / 2
    angles = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    within = (times >= span[0]) & (times <= span[0] + span[1])
    return times, angles - (angles[within].mean(axis=0) if within.any() else 0.0)
