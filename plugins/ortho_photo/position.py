"""The position of a photo: DJI's in XMP or the one in EXIF, each with its own accuracy.

A program that replaces positions often writes EXIF alone and leaves the XMP of the drone as it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ortho_photo.tags import REMEDY, Tags
from ortho_pipeline.plugin import InputError, Notice, Setting, Text

#: Standard deviation (m) in plan and height of a position without a stated accuracy: a receiver without corrections,
#: and a height that follows the air pressure from take-off.
PLAN, HEIGHT = 3.0, 10.0
#: The least standard deviation (m) of a position: RTK states that of the antenna's fix, not of the time of exposure.
LEAST = 0.02
#: Positions of two sources that are further apart (m) differ by more than rounding.
APART = 1.0
_FIXED = 50.0
_METRES_OF_DEGREE = 111_200.0
#: GDAL gives EXIF's fractions with so many digits.
_DIGITS = 6
#: Values of GPSAltitudeRef: below the reference surface, and the two of EXIF 3 that state heights from sea level.
_BELOW, _SEA_LEVEL = ("1", "3"), ("2", "3")


@dataclass(frozen=True)
class Position:
    """A position as written (degrees, m), its standard deviations in plan and height (m), and how it was found.

    `notices` has the difference between EXIF and XMP.
    """

    lon: float
    lat: float
    altitude: float
    sigmas: tuple[float, float]
    positioning: str
    notices: tuple[Notice, ...]


@dataclass(frozen=True)
class _Source:
    """What EXIF or XMP states: longitude and latitude, altitude, and their standard deviations.

    `rounded` is the standard deviation of the rounding of the position, m.
    """

    name: str
    place: tuple[float, float] | None = None
    altitude: float | None = None
    plan: float | None = None
    height: float | None = None
    positioning: str = ""
    rounded: float = 0.0


def position_of(tags: Tags, takeoff: float | None = None) -> Position:
    """Return the position: that of XMP, unless EXIF alone states an accuracy.

    With the height of the `takeoff` (m), the altitude is that above it: DJI's relative altitude, else the altitude.

    Raises
    ------
    InputError
        If position or altitude are missing or impossible.
    """
    xmp = _of_xmp(tags)
    try:
        exif = _of_exif(tags)
    except InputError:
        if xmp.place is None or xmp.altitude is None:
            raise
        exif = _Source("EXIF")  # damaged, and not needed
    sources = (exif, xmp) if exif.plan and not xmp.plan else (xmp, exif)
    placed = next((source for source in sources if source.place), None)
    if placed is None or placed.place is None:
        raise tags.error("this photo has no position", "GPSLatitude")
    lon, lat = placed.place
    if not (abs(lat) <= 90 and abs(lon) <= 360):
        raise tags.error(f"latitude {lat}, longitude {lon} is not on Earth", "GPSLatitude")
    # An accuracy in a source without a position is that of the only position.
    other = exif if placed is xmp else xmp
    plan_by = placed if placed.plan or other.place else other
    altitude, height = _altitude(tags, sources, plan_by.plan or 0.0, takeoff)
    if not -1000 < altitude < 100_000:
        raise tags.error(f"an altitude of {altitude} m is impossible", "GPSAltitude")
    return Position(
        lon,
        lat,
        altitude,
        (math.hypot(max(plan_by.plan or PLAN, LEAST), placed.rounded), max(height, LEAST)),
        plan_by.positioning if plan_by.plan else "no accuracy in the tags; assumed",
        _differing(tags, placed, xmp, exif),
    )


def _altitude(tags: Tags, sources: tuple[_Source, _Source], plan: float, takeoff: float | None) -> tuple[float, float]:
    """Return the altitude and its standard deviation; `plan` is the stated one in plan, or 0."""
    above = tags.optional("drone-dji:RelativeAltitude")
    levelled = next((source for source in sources if source.altitude is not None), None)
    stated = None if levelled is None else levelled.altitude
    if takeoff is not None and (relative := stated if above is None else above) is not None:
        return takeoff + relative, max(HEIGHT, plan)
    if levelled is None or stated is None:
        known = "" if above is None else f" but that above take-off ({above:g} m)"
        remedy = Text(
            "give the height of the take-off with ",
            Setting("scene.sensor_options", "METRES", key="takeoff"),
        )
        raise tags.error(
            f"this photo has a position, but no altitude{known}", "GPSAltitude", REMEDY if above is None else remedy
        )
    other = next(source for source in sources if source is not levelled)
    height_by = levelled if levelled.height or other.altitude is not None else other
    return stated, height_by.height or max(HEIGHT, plan)


def _of_xmp(tags: Tags) -> _Source:
    lat = tags.number("drone-dji:GpsLatitude", "drone-dji:GPSLatitude", "drone-dji:Latitude")
    # DJI wrote GpsLongtitude for years.
    names = ("GpsLongtitude", "GpsLongitude", "GPSLongtitude", "GPSLongitude", "Longitude")
    lon = tags.number(*(f"drone-dji:{name}" for name in names))
    east, north = tags.positive("drone-dji:RtkStdLon"), tags.positive("drone-dji:RtkStdLat")
    up, flag = tags.positive("drone-dji:RtkStdHgt"), tags.optional("drone-dji:RtkFlag")
    plan, height = (max(east, north), up) if east and north and up else (None, None)
    return _Source(
        "DJI's XMP",
        (lon, lat) if lat and lon else None,  # 0, 0 is written without a fix
        tags.number("drone-dji:AbsoluteAltitude"),
        plan,
        height,
        "RTK, fixed" if flag == _FIXED else "RTK, not fixed",
    )


def _of_exif(tags: Tags) -> _Source:
    """Return the position in EXIF; Pix4D's tags state its accuracy."""
    lat, lon = _degrees(tags, "GPSLatitude", "NS"), _degrees(tags, "GPSLongitude", "EW")
    altitude = tags.number("GPSAltitude")
    if altitude is not None and _reference(tags) in _BELOW:
        altitude = -altitude
    plan = tags.positive("Camera:GPSXYAccuracy", "senseFly:GPSXYAccuracy", "GPSHPositioningError")
    height = tags.positive("Camera:GPSZAccuracy", "senseFly:GPSZAccuracy") if plan else None
    place = None if lat is None or lon is None or (lat, lon) == (0.0, 0.0) else (lon, lat)
    rounded = max(_rounding(tags, "GPSLatitude"), _rounding(tags, "GPSLongitude")) * _METRES_OF_DEGREE
    return _Source("EXIF", place, altitude, plan, height, "accuracy in the tags", rounded)


def _differing(tags: Tags, used: _Source, xmp: _Source, exif: _Source) -> tuple[Notice, ...]:
    """Return a notice if both sources state a position, and these differ by more than `APART`."""
    if xmp.place is None or exif.place is None:
        return ()
    (east, north), (lon, lat) = xmp.place, exif.place
    turn = math.remainder(lon - east, 360.0) * math.cos(math.radians(lat))
    metres = {"plan": math.hypot(turn, lat - north) * _METRES_OF_DEGREE}
    # A height from sea level in EXIF and DJI's height may have different datums.
    if xmp.altitude is not None and exif.altitude is not None and _reference(tags) not in _SEA_LEVEL:
        metres["height"] = abs(exif.altitude - xmp.altitude)
    if max(metres.values()) <= APART:
        return ()
    by = " and ".join(f"{size:.1f} m in {what}" for what, size in metres.items())
    text = f"the positions in EXIF and in DJI's XMP differ by {by}. The position in {used.name} is used"
    return (Notice("positions-differ", text, off_m=metres, used=used.name),)


def _reference(tags: Tags) -> str:
    return tags.text("GPSAltitudeRef").lower().removeprefix("0x").lstrip("0")


def _degrees(tags: Tags, name: str, directions: str) -> float | None:
    """Return an angle; `directions` are the initials of the positive and of the negative one."""
    parts = tags.numbers(name)
    if parts is None:
        return None
    if not 1 <= len(parts) <= 3:
        raise tags.error(f"{len(parts)} numbers are not an angle", name)
    value = sum(part / 60**power for power, part in enumerate(parts))
    stated, wanted = tags.text(f"{name}Ref"), " or ".join(directions)
    if not stated or stated[0].upper() not in directions:
        # O is east in German, west in Spanish.
        text = f"this tag must be {wanted}, but it is {stated[:20]!r}" if stated else "this tag is missing"
        raise tags.error(text, f"{name}Ref", f"write {wanted} into this tag")
    return -value if stated[0].upper() == directions[1] else value


def _rounding(tags: Tags, name: str) -> float:
    """Return the standard deviation (degrees) of an angle's rounding: fractions of degrees or minutes are coarse."""
    digits = (
        10.0 ** (math.floor(math.log10(part)) + 1 - _DIGITS) / 60**power
        for power, part in enumerate(tags.numbers(name) or [])
        if part > 0 and not part.is_integer()
    )
    return max(digits, default=0.0) / math.sqrt(12)
