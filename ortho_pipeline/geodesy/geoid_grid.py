"""Check a geoid grid before PROJ opens it, and the undulations that it gives."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ortho_pipeline.errors import DatumError, InputError
from ortho_pipeline.files import read_bounded

#: South and west end, steps in latitude and longitude, rows, columns; what follows are heights of 4 bytes each.
_GTX = struct.Struct(">4d2i")
#: Metres; the geoid of the Earth is between 107 m below the ellipsoid and 86 m above it.
_LARGEST_UNDULATION = 200.0


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


def refuse_absurd(undulation: np.ndarray, name: str) -> None:
    """Refuse undulations (m, NaN where there is none) that no height datum of the Earth has.

    Raises
    ------
    DatumError
        If one is beyond 200 m: a grid that is damaged, holds other values, or is not in metres.
    """
    absurd = undulation[np.abs(undulation) > _LARGEST_UNDULATION]
    if absurd.size:
        raise DatumError(
            f"this height datum lies {absurd[0]:.4g} m above the ellipsoid, and the Earth's geoid within 110 m of it",
            file=None if name.startswith("EPSG:") else name, field="vertical",
            remedy="give a geoid grid in metres, and check that the file is not damaged",
        )  # fmt: skip
