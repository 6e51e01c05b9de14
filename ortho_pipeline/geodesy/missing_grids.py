"""Grids of PROJ that are not installed: their names, and how to install them."""

from __future__ import annotations

import logging
import re
import warnings
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj.transformer import AreaOfInterest, Transformer, TransformerGroup

log = logging.getLogger(__name__)


def grid_of_message(message: str) -> str | None:
    """Return the grid that an error of PROJ names as missing; None if it names none."""
    match = re.search(r"Grid (\S+) is not available", message)
    return match.group(1) if match else None


def grid_remedy(grid: str, otherwise: str) -> str:
    """Return how to install a grid, or what to do `otherwise`."""
    sync = f"`pyproj sync --file {grid}` (or `projsync --file {grid}`, both from PROJ's network)"
    # Of the worldwide geoids Debian's package has this one alone.
    debian = " or install Debian's proj-data," if "egm96" in grid else ""
    return f"run {sync},{debian} {otherwise}"


def unavailable_grids(source: Any, target: Any) -> list[str]:
    """Return the grids that transformations between two systems need and that are not installed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
    return [
        grid.short_name for operation in group.unavailable_operations for grid in operation.grids if not grid.available
    ]


def warn_of_better(used: Transformer, source: pyproj.CRS, target: pyproj.CRS, sample: NDArray[np.float64]) -> None:
    """Log that a more exact transformation exists whose grid is not installed (``only_best`` lets some of them pass).

    A negative accuracy of `used` means that PROJ chooses among several operations by position.
    """
    lon, lat = Transformer.from_crs(target.to_2d(), 4326, always_xy=True).transform(*sample[:2])
    if not (abs(lon) <= 180 and abs(lat) <= 90):
        return
    area = AreaOfInterest(lon, lat, lon, lat)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(source, target, always_xy=True, area_of_interest=area, allow_ballpark=False)
    if not group.best_available and group.unavailable_operations:
        better = group.unavailable_operations[0]
        grid = ", ".join(grid.short_name for grid in better.grids if not grid.available)
        log.warning(
            "%s -> %s: using a transformation accurate to %.1f m. A better one (%.1f m) needs the grid %s, "
            "which is not installed",
            source.name,
            target.name,
            used.get_last_used_operation().accuracy,
            better.accuracy,
            grid,
        )
