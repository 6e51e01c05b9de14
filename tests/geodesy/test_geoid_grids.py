"""Headers of geoid grids, written by hand: which are sound, and which PROJ must not open."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from pyproj.exceptions import ProjError

from ortho_pipeline.errors import DatumError
from ortho_pipeline.geodesy.geoid_grid import header_fault, refuse_unread

SHORT, LONG, BYTE = 3, 4, 1
STRIPS, TILES = [(278, SHORT, 1, 8)], [(322, SHORT, 1, 16), (323, LONG, 1, 16)]
Entry = tuple[int, int, int, int]


def tiff(*directories: Iterable[Entry], order: str = "<", big: bool = False, last: int = 0) -> bytes:
    """Return the header and directories of a TIFF.

    An entry is tag, kind, count and value. `last` is the offset of what follows the last directory; 0 ends the list.
    """
    wide = "Q" if big else "I"
    mark, version = b"II" if order == "<" else b"MM", struct.pack(order + "H", 43 if big else 42)
    more = struct.pack(order + "HH", 8, 0) if big else b""
    at = 16 if big else 8
    data = mark + version + more + struct.pack(order + wide, at)
    for k, entries in enumerate(directories):
        body = struct.pack(order + ("Q" if big else "H"), len(list(entries)))
        for tag, kind, count, value in entries:
            small = struct.pack(order + {SHORT: "H", LONG: "I", BYTE: "B"}[kind], value)
            body += struct.pack(order + "HH" + wide, tag, kind, count) + small.ljust(
                struct.calcsize(order + wide), b"\0"
            )
        at += len(body) + struct.calcsize(order + wide)
        data += body + struct.pack(order + wide, at if k < len(directories) - 1 else last)
    return data


def fault(folder: Path, data: bytes, name: str = "geoid.tif") -> str | None:
    (folder / name).write_bytes(data)
    return header_fault(folder / name)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_a_directory_states_its_strips_or_both_sides_of_its_tiles(order: str, big: bool, tmp_path: Path) -> None:
    def of(*directories: list[Entry]) -> str | None:
        return fault(tmp_path, tiff(*directories, order=order, big=big))

    width = (256, SHORT, 1, 8)
    assert of([width, *STRIPS]) is None
    assert of([width, *TILES]) is None
    assert of([width, (278, LONG, 1, 8)]) is None
    assert of(STRIPS, TILES, STRIPS) is None
    for wrong in (
        [width],
        [(278, SHORT, 1, 0)],
        # Two values, or bytes, are not the number that PROJ reads.
        [(278, SHORT, 2, 8)],
        [(278, BYTE, 1, 8)],
        TILES[:1],
        TILES[1:],
        [TILES[0], (323, LONG, 1, 0)],
        # Tiles without their height: rows of a strip do not help.
        [*STRIPS, TILES[0]],
    ):
        assert "does not state the size of its blocks" in (of(wrong) or "")
        assert "does not state the size of its blocks" in (of(STRIPS, wrong) or "")


@pytest.mark.parametrize("big", [False, True])
def test_a_tiff_that_ends_early_or_never(big: bool, tmp_path: Path) -> None:
    sound = tiff(STRIPS, TILES, big=big)
    for length in range(8, len(sound)):
        assert "beyond the end" in (fault(tmp_path, sound[:length]) or "")
    first = 16 if big else 8
    for again in (first, first + struct.calcsize("<QHHQQQ" if big else "<HHHIII")):
        assert "form a loop" in (fault(tmp_path, tiff(STRIPS, TILES, big=big, last=again)) or "")
    assert "beyond the end" in (fault(tmp_path, tiff(STRIPS, big=big, last=10**6)) or "")


def test_a_tiff_is_known_by_its_first_bytes_and_a_gtx_by_its_name(tmp_path: Path) -> None:
    wrong = tiff([(278, SHORT, 1, 0)])
    for name in ("geoid.tif", "geoid.gtx", "geoid"):
        assert "blocks" in (fault(tmp_path, wrong, name) or "")
    assert fault(tmp_path, b"no grid", "geoid.tif") is None
    assert fault(tmp_path, b"no grid", "geoid.gtx") is not None
    # PROJ says that a file is missing.
    assert header_fault(tmp_path / "none.gtx") is None


def test_a_gtx_is_exactly_as_long_as_its_header_says(tmp_path: Path) -> None:
    def of(place: tuple[float, ...], rows: int, columns: int, values: int) -> str | None:
        return fault(tmp_path, struct.pack(">4d2i", *place, rows, columns) + bytes(4 * values), "geoid.gtx")

    place = (30.0, 33.0, 1.0, 0.5)
    assert of(place, 2, 3, 6) is None
    assert of(place, 1, 1, 1) is None
    assert of((-30.0, -33.0, 1e-3, 1e-3), 2, 3, 6) is None
    for rows, columns, values in ((2, 3, 5), (2, 3, 7), (3, 2, 5), (2, 0, 0), (0, 2, 0), (-2, -3, 6)):
        assert of(place, rows, columns, values) is not None
    for bad in (0.0, -1.0, np.nan, np.inf):
        assert of((30.0, 33.0, bad, 0.5), 2, 3, 6) is not None
        assert of((30.0, 33.0, 1.0, bad), 2, 3, 6) is not None
    for bad in (np.nan, np.inf):
        assert of((bad, 33.0, 1.0, 0.5), 2, 3, 6) is not None
        assert of((30.0, bad, 1.0, 0.5), 2, 3, 6) is not None
    assert fault(tmp_path, struct.pack(">4d2i", *place, 2, 3)[:-1], "geoid.gtx") is not None


class Reading:
    """A transformation that reports positions west of zero as outside, as PROJ with its error checks does."""

    def __init__(self) -> None:
        self.tried: list[tuple[float, float]] = []

    def transform(self, lon: float, lat: float, height: float, *, errcheck: bool = False) -> None:
        self.tried.append((lon, lat))
        if errcheck and lon < 0:
            raise ProjError("outside of the grid")


def test_positions_inside_of_a_grid_that_have_no_height_are_refused() -> None:
    def tried(lon: list[float], lat: list[float], shift: list[float]) -> list[tuple[float, float]]:
        reading = Reading()
        refuse_unread(reading, np.array(lon), np.array(lat), np.array(shift), "geoid.gtx")  # type: ignore[arg-type]
        return reading.tried

    # Positions with a height, and positions that are none, are not looked at.
    assert tried([5.0, np.nan, 5.0], [1.0, 1.0, np.nan], [20.0, np.nan, np.nan]) == []
    assert tried([-5.0, -6.0], [1.0, 2.0], [np.nan, np.nan]) == [(-5.0, 1.0), (-6.0, 2.0)]
    with pytest.raises(DatumError) as refused:
        tried([5.0, -5.0, 7.0], [1.0, 2.0, 3.0], [20.0, np.nan, np.nan])
    assert refused.value.file == "geoid.gtx"
    assert "7 3" in refused.value.message
    # Of many, some sixteen are looked at, all over the list.
    many = tried([-1.0 - k for k in range(3200)], [0.0] * 3200, [np.nan] * 3200)
    assert [lon for lon, _ in many] == [-1.0 - 200 * k for k in range(16)]
    with pytest.raises(DatumError):
        tried([-1.0] * 3000 + [1.0] * 200, [0.0] * 3200, [np.nan] * 3200)
