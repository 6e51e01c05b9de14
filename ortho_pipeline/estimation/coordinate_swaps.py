"""Swapped coordinates: mistakes in point files that are not measurement errors.

Examples are latitude first, row first, rows counted upwards, heights in feet. Then the points are hundreds of pixels
off or not on Earth. Each swap is tried; if one reduces the error by more than a factor of twenty, it is reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points

#: Larger median residuals (px) are absurd: no vendor's model is so inaccurate.
ABSURD = 50.0
#: A swap is reported if it reduces the error by this factor.
BETTER = 20.0
_FOOT = 0.3048

Swap = Callable[[Array, Array, float], tuple[Array, Array]]

#: The mistake -> function that corrects image and ground points, and the remedy.
SWAPS: dict[str, tuple[Swap, str]] = {
    "ground x and y are swapped (latitude before longitude?)": (
        lambda image, ground, rows: (image, ground[:, [1, 0, 2]]),
        "give x (longitude, easting) before y (latitude, northing)",
    ),
    "column and row are swapped": (
        lambda image, ground, rows: (image[:, ::-1], ground),
        "give the column before the row",
    ),
    "x and y, and column and row, are swapped": (
        lambda image, ground, rows: (image[:, ::-1], ground[:, [1, 0, 2]]),
        "give x before y and the column before the row",
    ),
    "the rows are negative": (
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
    """Raise an error that names the swap, if the points are absurd as given and plausible after one swap.

    Parameters
    ----------
    model : SensorModel
        As delivered.
    points : Points
        Missing heights (NaN) are replaced by the model's reference height.
    rows : int
        Height of the image in pixels.

    Raises
    ------
    InputError
        If a swap reduces the error by more than a factor of twenty, or most points are outside the model's domain.
    """
    if not len(points):
        return
    as_given = _misfit(model, points)
    if as_given <= ABSURD:
        return
    misfits = {}
    for mistake, (swap, _) in SWAPS.items():
        image, ground = swap(points.image, points.ground, float(rows))
        misfits[mistake] = _misfit(model, replace(points, image=image, ground=ground))
    best = min(misfits, key=misfits.__getitem__)
    if misfits[best] * BETTER < as_given and np.isfinite(misfits[best]):
        now = f"{as_given:.0f} px off" if np.isfinite(as_given) else "outside the model's domain"
        raise InputError(
            f"{best}. As given, the points are {now}; with this corrected, they are {misfits[best]:.1f} px off",
            file=points.source,
            remedy=SWAPS[best][1],
        )
    if not np.isfinite(as_given):
        raise InputError(
            "most points are outside the model's domain",
            file=points.source,
            field="CRS",
            remedy=Text(
                "check the CRS of the points (",
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
