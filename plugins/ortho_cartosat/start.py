"""The line scanner that the metadata of a CARTOSAT-1 image determine: the start of an adjustment to control points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from ortho_cartosat.metadata import TILTS_DEG, Metadata
from ortho_pipeline.plugin import InputError, Pushbroom, SoftSigmas, is_usable, number_of, pushbroom_of_metadata

#: Focal length and pixel size of both cameras in metres: Willneff et al., table 1; and columns of a whole image.
FOCAL_LENGTH, PIXEL_SIZE, COLUMNS = 1.945, 7e-6, 12000
#: Sigma (m) of the flying height: section 2.1 tells of metadata with 638 km for a satellite at 618 km.
SIGMA_RADIUS = 20e3
DEFAULT = SoftSigmas(radius=SIGMA_RADIUS)
#: Options of the sensor: the sigma of a soft constraint each, its unit in those of `SoftSigmas`, and what it is of.
SOFT: dict[str, tuple[str, float, str]] = {
    "sigma_plane_m": ("plane", 1.0, "distance (m) of the path from a plane through the Earth's centre"),
    "sigma_circle_rad": ("circular", 1.0, "angle (rad) between position and velocity beyond a right one"),
    "sigma_altitude_m": ("radius", 1.0, "flying height (m)"),
    "sigma_attitude_deg": ("attitude", math.radians(1.0), "roll, pitch and yaw (degrees) in the middle of the scene"),
    "sigma_rate_rad_s": ("rate", 1.0, "their rates (rad/s) at first and last row"),
}
#: Where a constraint is left out.
NONE = "none"


def soft_sigmas(options: Mapping[str, str | None]) -> SoftSigmas:
    """Return the sigmas of the sensor options, each a positive number or ``none``.

    Raises
    ------
    InputError
        If a value is neither.
    """
    sigmas = asdict(DEFAULT)
    for option, text in options.items():
        name, unit, _ = SOFT[option]
        if text is None:
            continue
        value = None if text.strip().lower() == NONE else number_of(text) * unit
        if value is not None and not (is_usable(value) and value > 0):
            raise InputError(
                f"{text[:40]!r} is not a sigma",
                field=option,
                remedy=f"give a positive number, or {NONE} for no constraint",
            )
        sigmas[name] = value
    return SoftSigmas(**sigmas)


def soft_facts(sigmas: SoftSigmas) -> dict[str, float | None]:
    """Return the sigmas by name and in the units of the options; None without a constraint."""
    values = asdict(sigmas)
    return {
        option: None if values[name] is None else float(f"{values[name] / unit:.12g}")
        for option, (name, unit, _) in SOFT.items()
    }


def pushbroom(
    metadata: Metadata,
    view: str | None,
    size: tuple[int, int],
    heights: tuple[float, float],
    sigmas: SoftSigmas = DEFAULT,
) -> Pushbroom:
    """Return the line scanner that starts an adjustment, from corners, flying height and nominal camera.

    Raises
    ------
    InputError
        If the metadata lack one of these.

    Source: Willneff et al., section 3.3.1.
    """
    corners, altitude = metadata.corners, metadata.altitude
    if corners is None or altitude is None or view is None:
        field = "ImageULLat" if corners is None else "SatelliteAltitude" if altitude is None else "Sensor"
        raise InputError("the metadata do not state this", file=metadata.path, field=field)
    # Images have 12000 columns. If not, the image was reduced or cut, and its swath gives the scale.
    nominal = size[0] == COLUMNS
    middle = np.full((4, 1), min(max(0.0, heights[0]), heights[1]))
    return pushbroom_of_metadata(
        np.hstack([corners, middle]),
        *size,
        altitude=altitude,
        along_deg=_tilt(metadata, view),
        across_deg=metadata.number("ViewAngleAcrossTrack", low=-60, high=60) or 0.0,
        focal_length=FOCAL_LENGTH if nominal else None,
        pixel_size=PIXEL_SIZE if nominal else None,
        heights=heights,
        sigmas=sigmas,
    )


def _tilt(metadata: Metadata, view: str) -> float:
    """Return the tilt along the track in degrees, forward positive: as the file gives it, or the nominal one."""
    angle = metadata.number("ViewAngleAlongTrack", low=-60, high=60)
    # Signs differ between processors; which way a camera looks is known.
    return TILTS_DEG[view] if not angle else float(np.copysign(angle, TILTS_DEG[view]))
