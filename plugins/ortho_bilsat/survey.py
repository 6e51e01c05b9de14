"""The imaging survey: a text file of ``key = value`` lines (docs/formats/bilsat.md), read and written."""

from __future__ import annotations

import codecs
import datetime
import math
import re
from dataclasses import dataclass
from os import PathLike

from ortho_pipeline.plugin import InputError, Interior, counted, read_bounded, reads, write_text

MARK = "BILSAT-1 IMAGING SURVEY 1"
CAMERAS = ("PAN", "XS-BLUE", "XS-GREEN", "XS-RED", "XS-NIR")
MAX_BYTES = 100_000
#: How many numbers each key has; those in OPTIONAL may be missing.
NUMBERS = {
    "position_m": 3,
    "velocity_m_s": 3,
    "attitude_deg": 3,
    "focal_length_mm": 1,
    "pixel_pitch_um": 1,
    "columns": 1,
    "rows": 1,
    "position_sigma_m": 1,
    "attitude_sigma_deg": 1,
    "heights_m": 2,
}
TEXTS = ("scene", "camera", "acquired")
OPTIONAL = ("attitude_deg", "position_sigma_m", "attitude_sigma_deg", "heights_m")
HEIGHTS = (-500.0, 9000.0)


@dataclass(frozen=True)
class Survey:
    """An imaging survey; metres, radians, ECEF (WGS84).

    `attitude` is roll, pitch, yaw from the orbital frame (along, right, down) or None.
    """

    scene: str
    camera: str
    acquired: str
    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    attitude: tuple[float, float, float] | None
    interior: Interior
    position_sigma: float | None = None
    heights: tuple[float, float] = HEIGHTS
    attitude_sigma: float | None = None


@reads("write the survey as in docs/formats/bilsat.md")
def read_survey(path: str | PathLike[str]) -> Survey:
    """Read an imaging survey.

    Raises
    ------
    InputError
        Names the key (or line) that is missing, unknown, twice there, not a number or not possible.
    """
    fields = _fields(path)
    texts = {key: fields.pop(key) for key in TEXTS}
    numbers = {key: _numbers(path, key, text) for key, text in fields.items()}
    if texts["camera"] not in CAMERAS:
        raise InputError(f"unknown camera {texts['camera']!r}", file=path, field="camera", remedy=", ".join(CAMERAS))
    _check_time(path, texts["acquired"])
    _check_orbit(path, numbers["position_m"], numbers["velocity_m_s"])
    attitude, heights = numbers.get("attitude_deg"), numbers.get("heights_m", HEIGHTS)
    if not heights[0] < heights[1]:
        raise InputError("the lower height must come first", file=path, field="heights_m")
    sigmas = {key: numbers.get(key, (None,))[0] for key in ("position_sigma_m", "attitude_sigma_deg")}
    for key, sigma in sigmas.items():
        if sigma is not None and not sigma > 0:
            raise InputError("standard deviations must be positive", file=path, field=key)
    turn = sigmas["attitude_sigma_deg"]
    return Survey(
        **texts,
        position=_triple(numbers["position_m"]),
        velocity=_triple(numbers["velocity_m_s"]),
        attitude=None if attitude is None else _triple(tuple(math.radians(angle) for angle in attitude)),
        interior=_interior(path, numbers),
        position_sigma=sigmas["position_sigma_m"],
        heights=(heights[0], heights[1]),
        attitude_sigma=None if turn is None else math.radians(turn),
    )


def write_survey(survey: Survey, path: str | PathLike[str]) -> None:
    """Write an imaging survey; numbers are kept to the last bit."""
    interior = survey.interior
    values: dict[str, tuple[float, ...]] = {"position_m": survey.position, "velocity_m_s": survey.velocity}
    if survey.attitude is not None:
        values["attitude_deg"] = tuple(math.degrees(angle) for angle in survey.attitude)
    values |= {"focal_length_mm": (interior.focal_length * 1e3,), "pixel_pitch_um": (interior.pitch_x * 1e6,)}
    values |= {"columns": (interior.width,), "rows": (interior.height,), "heights_m": survey.heights}
    if survey.position_sigma is not None:
        values["position_sigma_m"] = (survey.position_sigma,)
    if survey.attitude_sigma is not None:
        values["attitude_sigma_deg"] = (math.degrees(survey.attitude_sigma),)
    lines = [MARK, *(f"{key} = {getattr(survey, key)}" for key in TEXTS)]
    lines += [f"{key} = {' '.join(map(repr, numbers))}" for key, numbers in values.items()]
    write_text(path, "\n".join([*lines, "END"]) + "\n")


def _fields(path: str | PathLike[str]) -> dict[str, str]:
    lines = _text(path).splitlines()
    if not lines or lines[0].strip() != MARK:
        raise InputError(
            "this file is not an imaging survey", file=path, field="line 1", remedy=f"the first line must be {MARK!r}"
        )
    fields: dict[str, str] = {}
    ended = False
    for number, line in enumerate(lines[1:], start=2):
        plain = line.split("#", 1)[0].strip()
        if not plain:
            continue
        if ended:
            raise InputError("there is text after END", file=path, field=f"line {number}")
        if plain == "END":
            ended = True
            continue
        key, sign, value = (part.strip() for part in plain.partition("="))
        if not sign or (key not in NUMBERS and key not in TEXTS):
            raise InputError(f"{key[:60]!r} is not a known key", file=path, field=f"line {number}")
        if key in fields:
            raise InputError("this key appears twice", file=path, field=key)
        fields[key] = value
    if not ended:
        raise InputError("the file is cut off: END is missing", file=path)
    missing = [key for key in (*TEXTS, *NUMBERS) if key not in fields and key not in OPTIONAL]
    if missing:
        raise InputError("this key is missing", file=path, field=missing[0], remedy="see docs/formats/bilsat.md")
    return fields


def _text(path: str | PathLike[str]) -> str:
    data = read_bounded(path, MAX_BYTES, field="survey", remedy="give the option survey")
    if len(data) > MAX_BYTES:
        raise InputError(f"this survey is larger than the limit of {MAX_BYTES} bytes", file=path)
    try:
        return data.removeprefix(codecs.BOM_UTF8).decode("ascii")
    except ValueError as error:
        raise InputError("a survey must be plain ASCII text", file=path) from error


def _numbers(path: str | PathLike[str], key: str, text: str) -> tuple[float, ...]:
    # float() also reads inf, nan, 1_000 and digits of other scripts.
    parts = text.split()
    if not all(re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", part) for part in parts):
        raise InputError(f"{text[:60]!r} is not a list of numbers", file=path, field=key)
    values = tuple(float(part) for part in parts)
    if len(values) != NUMBERS[key] or not all(abs(value) < 1e12 for value in values):
        raise InputError(f"{text[:60]!r}: not {counted(NUMBERS[key], 'number')} in range", file=path, field=key)
    return values


def _check_time(path: str | PathLike[str], text: str) -> None:
    try:
        time = datetime.datetime.fromisoformat(text)
    except ValueError:
        time = None
    if time is None or time.utcoffset() != datetime.timedelta(0):
        raise InputError(
            f"{text[:60]!r} is not a time in UTC", file=path, field="acquired", remedy="2005-08-03T08:12:31.25Z"
        )


def _check_orbit(path: str | PathLike[str], position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
    if not 6.5e6 < math.hypot(*position) < 5e7:
        raise InputError(
            "this is not a possible satellite position", file=path, field="position_m", remedy="ECEF in metres"
        )
    if not 1e3 < math.hypot(*velocity) < 1.2e4:
        raise InputError(
            "this is not a possible satellite speed", file=path, field="velocity_m_s", remedy="ECEF in m/s"
        )
    cosine = sum(p * v for p, v in zip(position, velocity, strict=True)) / math.hypot(*position) / math.hypot(*velocity)
    if abs(cosine) > 0.5:
        raise InputError("this velocity is not horizontal", file=path, field="velocity_m_s")


def _interior(path: str | PathLike[str], numbers: dict[str, tuple[float, ...]]) -> Interior:
    (focal,), (pitch,) = numbers["focal_length_mm"], numbers["pixel_pitch_um"]
    (columns,), (rows,) = numbers["columns"], numbers["rows"]
    for key, value in (("columns", columns), ("rows", rows)):
        if value != int(value) or not 0 < value < 1e6:
            raise InputError(f"{value} is not a number of pixels", file=path, field=key)
    for key, value in (("focal_length_mm", focal), ("pixel_pitch_um", pitch)):
        if not 1e-6 < value < 1e6:
            raise InputError(f"{value} is out of range", file=path, field=key)
    return Interior(int(columns), int(rows), focal * 1e-3, pitch * 1e-6, pitch * 1e-6)


def _triple(values: tuple[float, ...]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]
