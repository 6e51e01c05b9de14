"""What is looked at in a geoid grid before PROJ opens it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import read_bounded

#: South and west end, steps in latitude and longitude, rows, columns; what follows are heights of 4 bytes each.
_GTX = struct.Struct(">4d2i")


def header_fault(path: Path) -> str | None:
    """Return what is wrong with a grid file that exists: a pipe, or a GTX header that does not fit the file.

    PROJ waits for the one, and allocates what the other asks for.
    """
    try:
        header = read_bounded(path, _GTX.size - 1) if path.exists() else b""
    except InputError as error:
        return error.message
    if not path.name.endswith("gtx") or not path.exists():
        return None
    if len(header) < _GTX.size:
        return "this is shorter than a header of GTX"
    *place, rows, columns = _GTX.unpack(header)
    if not np.isfinite(place).all() or min(place[2:]) <= 0 or min(rows, columns) <= 0:
        return "the header states no grid"
    if _GTX.size + 4 * rows * columns != path.stat().st_size:
        return f"the header states {rows} x {columns} heights, which is not the size of the file"
    return None
