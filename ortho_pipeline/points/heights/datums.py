"""Heights of points and of a DEM, compared: a difference of their datums shows here and nowhere else."""

from __future__ import annotations

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.geodesy.crs import Vertical, ground_transform

Array = NDArray[np.float64]
#: Median of control height minus DEM height from which a difference of datums is suspected, metres.
_SUSPICIOUS_HEIGHT = 5.0
#: Points nearer to the DEM than this (m) have their heights from it, so they do not test it.
FROM_DEM = 1e-6


def datums_apart(difference: Array, ground: Array, crs: pyproj.CRS, displacement: float | None = None) -> list[Notice]:
    """Return a notice if heights of points differ from those of a DEM as if their datums differed.

    Parameters
    ----------
    difference : ndarray (n,)
        Heights of points above the DEM, m. Those that come from the DEM do not count.
    ground : ndarray (N, 3)
        Points that show where that is, in `crs`.
    displacement : float, optional
        Metres in the ortho for each metre of height.
    """
    difference = difference[np.abs(difference) > FROM_DEM]
    if len(difference) < 3:
        return []
    median, spread = median_and_spread(difference)
    if abs(median) <= max(_SUSPICIOUS_HEIGHT, 3 * spread):
        return []
    by = None if displacement is None else abs(median) * displacement
    moved = "" if by is None else f"; that moves the ortho by {metres(by)}"
    side = "above" if median > 0 else "below"
    text = (
        f"the points lie {metres(abs(median))} {side} the DEM (median; spread {metres(spread)}): their heights "
        f"probably have another datum than the DEM's{_undulation_there(ground, crs)}{moved}"
    )
    return [Notice("heights-disagree", text, median_m=median, spread_m=spread, moved_m=by)]


def median_and_spread(difference: Array) -> tuple[float, float]:
    """Return the median of values and their standard deviation, which gross errors do not change."""
    median = float(np.median(difference))
    return median, float(1.4826 * np.median(np.abs(difference - median)))


def _undulation_there(ground: Array, crs: pyproj.CRS) -> str:
    try:
        there = ground_transform(crs, "EPSG:4979")(ground)
        undulation = float(np.nanmean(Vertical.parse("egm96").undulation(there[:, 0], there[:, 1])))
    except OrthoError:
        return ""
    side = "above" if undulation > 0 else "below"
    return f" (the geoid is {metres(abs(undulation))} {side} the ellipsoid there)"
