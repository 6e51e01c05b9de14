"""Fields of camera files."""

from __future__ import annotations

from os import PathLike
from typing import Any

from ortho_pipeline.plugin import InputError, Interior

DISTORTION_KEYS = ("k1", "k2", "k3", "p1", "p2")


def number(path: str | PathLike[str], field: str, value: Any) -> float:
    """Return a number of a document."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
        raise InputError("is missing" if value is None else f"{value!r} is not a number", file=path, field=field)
    return float(value)


def interior_of(path: str | PathLike[str], width: float, height: float, *values: float, **others: float) -> Interior:
    """Return a camera; its errors name the file."""
    try:
        if width != int(width) or height != int(height) or not 0 < width < 1e6 or not 0 < height < 1e6:
            raise InputError("width and height must be whole numbers", field="width, height")
        return Interior(int(width), int(height), *values, **others)
    except InputError as error:
        raise InputError(error.message, file=path, field=error.field, remedy=error.remedy) from error
