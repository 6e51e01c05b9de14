"""Grids of PROJ that are not installed: their names, and how to install them."""

from __future__ import annotations

import re
import warnings
from typing import Any

from pyproj.transformer import TransformerGroup


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
