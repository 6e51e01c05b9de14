"""Check a geoid grid before PROJ opens it, and the undulations that it gives."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

import numpy as np
from pyproj.exceptions import ProjError
from pyproj.transformer import Transformer

from ortho_pipeline.errors import DatumError, InputError
from ortho_pipeline.files import read_bounded

#: South and west end, steps in latitude and longitude, rows, columns; what follows are heights of 4 bytes each.
_GTX = struct.Struct(">4d2i")
#: Tags of a TIFF: width and height of a tile, rows of a strip.
_TILES, _STRIPS = (322, 323), (278,)
_BLOCK_SIZES = (*_TILES, *_STRIPS)
#: Grids of a whole continent have some hundreds of directories.
_MOST_DIRECTORIES, _MOST_ENTRIES = 10_000, 200
#: Metres; the geoid of the Earth is between 107 m below the ellipsoid and 86 m above it.
_LARGEST_UNDULATION = 200.0
#: Positions without a height that are looked at.
_TRIED = 16


def header_fault(path: Path) -> str | None:
    """Return what is wrong with a grid file that exists: a pipe, or a GTX or TIFF header that does not fit the file.

    PROJ would wait for a pipe, allocate any size that a GTX states, and divide by a missing number of a TIFF.
    """
    try:
        header = read_bounded(path, _GTX.size - 1) if path.exists() else b""
    except InputError as error:
        return error.message
    if header[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _fault_of_tiff(data)
    return _fault_of_gtx(header, path) if path.name.endswith("gtx") and path.exists() else None


def _fault_of_gtx(header: bytes, path: Path) -> str | None:
    if len(header) < _GTX.size:
        return "the file is shorter than a GTX header"
    *place, rows, columns = _GTX.unpack(header)
    if not np.isfinite(place).all() or min(place[2:]) <= 0 or min(rows, columns) <= 0:
        return "the header describes no grid"
    if _GTX.size + 4 * rows * columns != path.stat().st_size:
        return f"the header states {rows} x {columns} heights, which does not match the size of the file"
    return None


def _fault_of_tiff(data: mmap.mmap) -> str | None:
    """Return what is wrong with the directories of a TIFF: each must state the size of its blocks."""
    order = "<" if data[:2] == b"II" else ">"
    big = data[2:4] in (b"+\0", b"\0+")
    count, entry, offset = (struct.Struct(order + form) for form in (("Q", "HHQQ", "Q") if big else ("H", "HHII", "I")))
    seen: set[int] = set()
    try:
        (at,) = offset.unpack_from(data, 8 if big else 4)
        while at:
            if at in seen or len(seen) >= _MOST_DIRECTORIES:
                return "its TIFF directories form a loop"
            seen.add(at)
            (entries,) = count.unpack_from(data, at)
            begin, stated = at + count.size, {}
            for k in range(min(entries, _MOST_ENTRIES)):
                place = begin + k * entry.size
                tag, kind, values, _ = entry.unpack_from(data, place)
                if tag in _BLOCK_SIZES and values == 1 and kind in (3, 4):
                    form = order + ("H" if kind == 3 else "I")
                    (stated[tag],) = struct.unpack_from(form, data, place + entry.size - offset.size)
            needed = _TILES if _TILES[0] in stated else _STRIPS
            if not all(stated.get(tag) for tag in needed):
                return "a TIFF directory does not state the size of its blocks"
            (at,) = offset.unpack_from(data, begin + entries * entry.size)
    except struct.error:
        return "a TIFF directory is beyond the end of the file"
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
            f"this height datum is {absurd[0]:.4g} m above the ellipsoid; the geoid is within 110 m of it",
            file=None if name.startswith("EPSG:") else name,
            field="vertical",
            remedy="give a geoid grid in metres, and check that the file is not damaged",
        )


def refuse_unread(transformer: Transformer, lon: np.ndarray, lat: np.ndarray, shift: np.ndarray, file: str) -> None:
    """Refuse a grid file that PROJ cannot read at positions ``(N,)`` inside the grid.

    PROJ silently gives no height there, as for positions outside. With error checks it reports positions outside and
    without a value, but not positions that it could not read.

    Raises
    ------
    DatumError
        If one of a few tried positions cannot be read.
    """
    lost = np.flatnonzero(np.isnan(shift) & np.isfinite(lon) & np.isfinite(lat))
    for k in lost[:: max(1, len(lost) // _TRIED)]:
        try:
            transformer.transform(lon.flat[k], lat.flat[k], 0.0, errcheck=True)
        except ProjError:
            continue
        raise DatumError(
            f"the geoid grid cannot be read at {lon.flat[k]:.6g} {lat.flat[k]:.6g}, although the grid covers it",
            file=file,
            field="vertical",
            remedy="the file is cut off or damaged: copy it again",
        )
