"""Swapped coordinates: the mistakes of point files that are not errors of measurement.

Latitude given first, row given first, rows counted upwards, heights in feet: the points then miss the model by hundreds
of pixels or fall off the Earth. Each swap is tried; one that brings the points more than twenty times closer is not a
coincidence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points

#: Residuals (px, median) above this are absurd: no vendor's model is so far off.
ABSURD = 50.0
#: A swap has to be this many times better to be named.
BETTER = 20.0
_FOOT = 0.3048

Swap = Callable[[Array, Array, float], tuple[Array, Array]]

#: What is wrong with the file, how the corrected image and ground points are made, and what to do.
SWAPS: dict[str, tuple[Swap, str]] = {
    "x and y of the ground are exchanged (latitude before longitude?)": (
        lambda image, ground, rows: (image, ground[:, [1, 0, 2]]),
        "give x (longitude, easting) before y (latitude, northing)",
    ),
    "column and row are exchanged": (
        lambda image, ground, rows: (image[:, ::-1], ground),
        "give the column before the row",
    ),
    "x and y, and column and row, are exchanged": (
        lambda image, ground, rows: (image[:, ::-1], ground[:, [1, 0, 2]]),
        "give x before y and the column before the row",
    ),
    "the sign of the rows is negative": (
        lambda image, ground, rows: (image * [1.0, -1.0], ground),
        "give rows downwards from the top of the image, as positive numbers",
    ),
    "rows are counted from the bottom of the image": (
        lambda image, ground, rows: (image * [1.0, -1.0] + [0.0, rows], ground),
        "give rows downwards from the top of the image",
    ),
    "heights are in feet": (
        lambda image, ground, rows: (image, ground * [1.0, 1.0, _FOOT]),
        "give heights in metres",
    ),
    "the sign of x is wrong (western longitudes are negative)": (
        lambda image, ground, rows: (image, ground * [-1.0, 1.0, 1.0]),
        "give longitudes positive to the east",
    ),
    "the sign of y is wrong (southern latitudes are negative)": (
        lambda image, ground, rows: (image, ground * [1.0, -1.0, 1.0]),
        "give latitudes positive to the north",
    ),
}


def refuse_swapped(model: SensorModel, points: Points, rows: int) -> None:
    """Raise an error that names the swap, if the points are absurd as they are and right with one swap.

    Parameters
    ----------
    model : SensorModel
        As delivered.
    points : Points
        Heights that are not given (NaN) are taken at the model's reference height.
    rows : int
        Height of the image in pixels.

    Raises
    ------
    InputError
        If a swap brings the points more than twenty times closer to the model, or no point projects at all.
    """
    if not len(points):
        return
    as_given = _misfit(model, points)
    if as_given <= ABSURD:
        return
    found = {}
    for what, (swap, _) in SWAPS.items():
        image, ground = swap(points.image, points.ground, float(rows))
        found[what] = _misfit(model, replace(points, image=image, ground=ground))
    best = min(found, key=lambda what: found[what])
    if found[best] * BETTER < as_given and np.isfinite(found[best]):
        now = f"{as_given:.0f} px off" if np.isfinite(as_given) else "outside of the model's domain"
        raise InputError(
            f"the points are {now} as given, and {found[best]:.1f} px with one change: {best}",
            file=points.source,
            remedy=SWAPS[best][1],
        )
    if not np.isfinite(as_given):
        raise InputError(
            "most points lie outside of the model's domain",
            file=points.source,
            field="CRS",
            remedy=Text(
                "check the coordinate system of the points (",
                Setting("points.crs"),
                ") and that they belong to this scene",
            ),
        )


def _misfit(model: SensorModel, points: Points) -> float:
    """Return the median distance (px) between measured and predicted points; inf if most do not project."""
    ground = points.ground.copy()
    ground[~np.isfinite(ground[:, 2]), 2] = model.reference_height
    try:
        moved = points.with_ground(ground).to_crs(model.crs)
    except (CrsError, InputError):
        return np.inf
    distance = np.linalg.norm(points.image - model.ground_to_image(moved.ground), axis=1)
    return float(np.median(np.where(np.isfinite(distance), distance, np.inf)))
