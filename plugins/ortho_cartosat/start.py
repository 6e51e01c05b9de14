"""The line scanner that the metadata of a CARTOSAT-1 image determine: the start of an adjustment to control points."""

from __future__ import annotations

import numpy as np

from ortho_cartosat.metadata import TILTS_DEG, Metadata
from ortho_pipeline.errors import InputError
from ortho_pipeline.models.pushbroom import Pushbroom
from ortho_pipeline.models.pushbroom_start import SoftSigmas, pushbroom_of_metadata

#: Focal length and pixel size of both cameras in metres: Willneff et al., table 1; and columns of a whole image.
FOCAL_LENGTH, PIXEL_SIZE, COLUMNS = 1.945, 7e-6, 12000
#: Sigma (m) of the flying height: section 2.1 tells of metadata with 638 km for a satellite at 618 km.
SIGMA_RADIUS = 20e3


def pushbroom(metadata: Metadata, view: str | None, size: tuple[int, int], heights: tuple[float, float]) -> Pushbroom:
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
        raise InputError("the metadata do not tell this", file=metadata.path, field=field)
    # The images are 12000 columns; one that is not was reduced (or cut), and then its own swath tells the scale.
    nominal = size[0] == COLUMNS
    middle = np.full((4, 1), min(max(0.0, heights[0]), heights[1]))
    return pushbroom_of_metadata(
        np.hstack([corners, middle]), *size, altitude=altitude, along_deg=_tilt(metadata, view),
        across_deg=metadata.number("ViewAngleAcrossTrack", low=-60, high=60) or 0.0,
        focal_length=FOCAL_LENGTH if nominal else None, pixel_size=PIXEL_SIZE if nominal else None, heights=heights,
        sigmas=SoftSigmas(radius=SIGMA_RADIUS),
    )  # fmt: skip


def _tilt(metadata: Metadata, view: str) -> float:
    """Return the tilt along the track in degrees, forward positive: as the file gives it, or the nominal one."""
    given = metadata.number("ViewAngleAlongTrack", low=-60, high=60)
    # Signs differ between processors; which way a camera looks is known.
    return TILTS_DEG[view] if not given else float(np.copysign(given, TILTS_DEG[view]))
