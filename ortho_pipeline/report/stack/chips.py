"""Chips of the page of a stack: one place in some dates, over another date, before and after their correction."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.regridded import Regridded
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.raster.verified_writing import png_bytes
from ortho_pipeline.report.gallery.chips import stretched

#: So many dates are shown. A chip has values in such a share of its pixels.
_DATES, _LEAST = 6, 0.5


@dataclass(frozen=True)
class DateFiles:
    """A date that chips may show.

    Parameters
    ----------
    shift_px : (float, float)
        Its correction at the place, columns and rows.
    before, after : path
        Its ortho as delivered, and as aligned.
    """

    name: str
    time: str
    shift_px: tuple[float, float]
    before: str | os.PathLike[str]
    after: str | os.PathLike[str]


@dataclass(frozen=True)
class DateChips:
    """A date with its pictures (PNG in base64) before and after its correction."""

    date: DateFiles
    before: str
    after: str


@dataclass(frozen=True)
class ChipSheet:
    """Chips of dates at one place, largest correction first.

    Parameters
    ----------
    lower : str
        The date under all others, as aligned.
    middle, size : (float, float), (int, int)
        Of the place, and columns and rows of a chip, in px of the stack's grid.
    """

    lower: str
    middle: tuple[float, float]
    size: tuple[int, int]
    chips: tuple[DateChips, ...]


def sheet_of(
    dates: Sequence[DateFiles], window: Grid, middle: tuple[float, float], access: Mapping[str, Any]
) -> ChipSheet | None:
    """Return chips of the dates with the largest corrections over the one with the smallest; None if there are none.

    A date that cannot be read on this grid is left out: the page has all else without it. That is also so for
    corrections without pixels whose map grid is not north up.

    Parameters
    ----------
    window : Grid
        Of a chip.
    access : mapping
        Permissions to open the orthos.
    """
    order = sorted(dates, key=lambda one: (-float(np.hypot(*one.shift_px)), one.time, one.name))
    lower, below = None, ""
    while order and lower is None:
        # A datum is the last.
        one = order.pop()
        lower, below = _read(one.after, window, access), one.name
    if lower is None:
        return None
    found = []
    for one in order[:_DATES]:
        before, after = (_read(path, window, access) for path in (one.before, one.after))
        if before is not None and after is not None:
            found.append(DateChips(one, _overlay(lower, before), _overlay(lower, after)))
    return ChipSheet(below, middle, (window.width, window.height), tuple(found)) if found else None


def _read(path: str | os.PathLike[str], window: Grid, access: Mapping[str, Any]) -> Array | None:
    """Return the mean of the bands ``(rows, columns)``, NaN without values; None if it cannot be read, or is empty."""
    try:
        image = Regridded(path, window, resampling="cubic", **access)
        pixels, valid = image.read(0, 0, window.width, window.height)
    except OrthoError:
        return None
    values = np.abs(pixels) if np.iscomplexobj(pixels) else pixels
    shown = np.where(valid.all(axis=0), values.mean(axis=0, dtype=float), np.nan)
    return shown if np.isfinite(shown).mean() >= _LEAST else None


def _overlay(lower: Array, upper: Array) -> str:
    """Return the picture (PNG in base64) of two chips ``(rows, columns)``: the lower one red, the upper one cyan.

    Each has its own contrast, so that it is grey where they fit. It is transparent where either is NaN.
    """
    (red, under), (cyan, over) = stretched(lower), stretched(upper)
    return base64.b64encode(png_bytes(np.stack([red, cyan, cyan, np.minimum(under, over)]))).decode()
