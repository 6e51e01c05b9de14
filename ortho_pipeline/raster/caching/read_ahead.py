"""Pixels of remote rasters, read before they are needed: several windows at a time, and each block once.

A request to a store takes a full round trip, even for few bytes. A caller that states the next windows
(`ReadAhead.expect`) does not wait for each of them.
"""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.files.locations import Location
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.runtime.process_limits import thread_pool

#: Windows that are read at a time; GDAL asks for the parts of each at once.
_AT_ONCE = 6
#: Pieces of work that are prepared before their turn.
AHEAD = 6


@contextlib.contextmanager
def read_ahead(source: RasterSource, memory: int) -> Iterator[RasterSource]:
    """Yield a reader that reads windows of a remote source ahead; for a local source, the source itself.

    Parameters
    ----------
    memory : int
        Bytes of cached pixels.
    """
    if not any(Location(path).is_far for path in source.paths):
        yield source
        return
    pool = thread_pool(_AT_ONCE, "ahead")
    try:
        yield ReadAhead(source, memory, pool)
    finally:
        # The interpreter cannot end while a thread is inside of GDAL.
        pool.shutdown(wait=True, cancel_futures=True)


@dataclass(eq=False)
class _Part:
    """Pixels of a rectangle of blocks, and which are valid; `used` if they were read from here."""

    left: int
    top: int
    right: int
    bottom: int
    content: Future[tuple[NDArray[Any], NDArray[np.bool_] | None]]
    size: int
    used: bool = False


class ReadAhead(RasterSource):
    """The rasters of a source; each block is read once for all its windows, and ahead if it is expected.

    Parameters
    ----------
    source : RasterSource
    memory : int
        Bytes of cached pixels.
    pool : ThreadPoolExecutor
        Threads that read, each with its own handles.
    """

    def __init__(self, source: RasterSource, memory: int, pool: ThreadPoolExecutor) -> None:
        vars(self).update(vars(source))
        self._plain, self._memory, self._pool = source, memory, pool
        columns, rows = source.bands[0].GetBlockSize()
        self._unit = min(columns, self.width), min(rows, self.height)
        self._lock = threading.Lock()
        self._of_block: dict[tuple[int, int], _Part] = {}
        self._parts: OrderedDict[_Part, None] = OrderedDict()
        self._bytes = 0

    def expect(self, left: int, top: int, right: int, bottom: int) -> None:
        """Begin to read a window, unless so much is waiting that it would have to be read again."""
        with self._lock:
            if sum(part.size for part in self._parts if not part.used) < self._memory // 2:
                self._asked(left, top, right, bottom)

    def read(self, left: int, top: int, width: int, height: int) -> NDArray[Any]:
        """Return the pixels ``(count, height, width)`` of a window inside the raster."""
        out = np.empty((self.count, height, width), self.dtype)
        for part in self._taken(left, top, width, height):
            to, of = _shared(part, left, top, width, height)
            out[to] = part.content.result()[0][of]
        return out

    def read_valid(self, left: int, top: int, pixels: NDArray[Any]) -> NDArray[np.bool_] | None:
        """Return which of the `pixels` of a window ``(count, h, w)`` are valid; None where all are."""
        _, height, width = pixels.shape
        out = None
        for part in self._taken(left, top, width, height):
            valid = part.content.result()[1]
            if valid is not None:
                out = np.ones(pixels.shape, dtype=bool) if out is None else out
                to, of = _shared(part, left, top, width, height)
                out[to] = valid[of]
        return None if out is None or out.all() else out

    def _taken(self, left: int, top: int, width: int, height: int) -> list[_Part]:
        with self._lock:
            parts = self._asked(left, top, left + width, top + height)
            for part in parts:
                part.used = True
                self._parts.move_to_end(part)
            self._forget(parts)
        return parts

    def _asked(self, left: int, top: int, right: int, bottom: int) -> list[_Part]:
        """Return the parts that hold a window, those that are not there yet in the reading."""
        columns, rows = self._unit
        needed = list(_places(range(top // rows, -(-bottom // rows)), range(left // columns, -(-right // columns))))
        missing = {place for place in needed if place not in self._of_block}
        for first_row, last_row, first, last in _rectangles(missing):
            box = first * columns, first_row * rows, min(last * columns, self.width), min(last_row * rows, self.height)
            size = (box[2] - box[0]) * (box[3] - box[1]) * self.count * (self.dtype.itemsize + 1)
            part = _Part(*box, self._pool.submit(self._read, *box), size)
            self._parts[part] = None
            self._bytes += size
            for place in _places(range(first_row, last_row), range(first, last)):
                self._of_block[place] = part
        return list(dict.fromkeys(self._of_block[place] for place in needed))

    def _read(self, left: int, top: int, right: int, bottom: int) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        pixels = self._plain.read(left, top, right - left, bottom - top)
        return pixels, self._plain.read_valid(left, top, pixels)

    def _forget(self, needed: list[_Part]) -> None:
        """Let go of what was used longest ago."""
        columns, rows = self._unit
        for part in [part for part in self._parts if part.used and part not in needed]:
            if self._bytes <= self._memory:
                return
            del self._parts[part]
            self._bytes -= part.size
            over = range(part.left // columns, -(-part.right // columns))
            for place in _places(range(part.top // rows, -(-part.bottom // rows)), over):
                del self._of_block[place]


def _places(rows: range, columns: range) -> Iterator[tuple[int, int]]:
    return ((row, column) for row in rows for column in columns)


def _shared(part: _Part, left: int, top: int, width: int, height: int) -> tuple[Any, Any]:
    """Return the pixels that a part has of a window: their places in the window, and in the part."""
    first, last = max(left, part.left), min(left + width, part.right)
    above, below = max(top, part.top), min(top + height, part.bottom)
    to = np.s_[:, above - top : below - top, first - left : last - left]
    return to, np.s_[:, above - part.top : below - part.top, first - part.left : last - part.left]


def _rectangles(places: set[tuple[int, int]]) -> list[tuple[int, int, int, int]]:
    """Return rectangles (first row, last row + 1, first column, last column + 1) that are these places together."""
    open_runs: dict[tuple[int, int], int] = {}
    rectangles = []
    below = 0  # the row after the one before, where its runs end
    for row in sorted({row for row, _ in places}):
        columns = sorted(column for one, column in places if one == row)
        ends = [k for k in range(len(columns)) if k + 1 == len(columns) or columns[k + 1] != columns[k] + 1]
        starts = [0, *(k + 1 for k in ends[:-1])]
        runs = {(columns[a], columns[b] + 1) for a, b in zip(starts, ends, strict=True)}
        for run in [run for run in open_runs if run not in runs or row != below]:
            rectangles.append((open_runs.pop(run), below, *run))
        for run in runs:
            open_runs.setdefault(run, row)
        below = row + 1
    rectangles += [(first, below, *run) for run, first in open_runs.items()]
    return rectangles
