"""Compiled march from the ground towards the sensor, or the sun: does other terrain block the line?

A line of sight is straight: it begins on the terrain, bilinear between samples, and goes on by so many samples per
metre that it rises. Within a cell of four samples the terrain along it is a quadratic function, so that whether it
rises above the line is known, not sampled. Terrain can rise above a line only in a cell that is *steep*: where it
climbs faster than the line does. All other cells are passed unseen, and so are squares of them whose steep cells all
lie below the line. A line ends where it is above all steep cells that it could still meet: `find_bounds` takes from
square to square what blocks lines farther on, less what they rise until then.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.runtime.compiled import compiled, inlined
from ortho_pipeline.surface.ray_kernel import SQUARE_BITS, climbs

#: Classes of `look`.
CLEAR, HIDDEN, VOID = 0, 1, 2
#: Where cells are as many pixels wide as one in this, the pixels of one are filled at once.
_WIDE = 0.125
#: Terrain that rises above a line by less (m) is rounding.
_ROUNDING = 1e-5


class Rays(NamedTuple):
    """Lines of sight of a tile of the ortho, for compiled code.

    Parameters
    ----------
    samples : (rows, columns, 2)
        Sample coordinates of the terrain at nodes every `near` pixels.
    slopes : (rows, columns, levels, 2)
        Samples per metre upwards at nodes every `far` pixels, a multiple of `near`, as polynomials in the normalised
        height, which is -1 at middle - half and 1 at middle + half (m).
    bend : float
        The Earth falls away below a line by this many metres per square metre that the line rises.
    """

    samples: Any
    near: int
    slopes: Any
    far: int
    middle: float
    half: float
    bend: float


class Relief(NamedTuple):
    """Heights ``(rows, columns)`` from sample (left, top) on, and what is steep of their cells.

    Parameters
    ----------
    tops : (rows - 1, columns - 1)
        Highest corners of steep cells, -inf of others.
    squares : (rows, columns)
        The highest of the tops of each square.
    above, below : (rows - 1, columns - 1)
        Lines at the one height or above it somewhere in a cell meet no steep cell any more; lines at the other or below
        it meet one.
    known : (rows - 1, columns - 1)
        `CLEAR` or `HIDDEN` where all lines from a cell are that; `VOID` where each has to be looked along.
    highest : float
        Of all tops.
    """

    heights: Any
    left: int
    top: int
    tops: Any
    squares: Any
    above: Any
    below: Any
    known: Any
    highest: float


class Course(NamedTuple):
    """How the lines of sight of a window go: from row to row, forward (1) or backward (-1).

    Over a row they rise by `least` to `most` (m), and go `aside` columns farther, or up to `spread` more or less;
    `slack` (m) is more than what they bend upwards, and rounding. After `reach` rows they are above everything.
    """

    forward: int
    least: float
    most: float
    aside: float
    spread: float
    slack: float
    reach: float


@compiled
def extremes(heights: Any) -> tuple[float, float, int]:
    """Return the least and the greatest of heights, infinite where there are none, and how many are void."""
    least, greatest, void = np.inf, -np.inf, 0
    for j in range(heights.shape[0]):
        for i in range(heights.shape[1]):
            least, greatest = min(least, heights[j, i]), max(greatest, heights[j, i])
            void += heights[j, i] != heights[j, i]
    return least, greatest, void


@compiled
def find_steep(heights: Any, void: bool, low: Any, high: Any, tops: Any, squares: Any) -> float:
    """Find the cells ``(rows - 1, columns - 1)`` that climb faster than some line; return the highest corner of any.

    The lines go `low` to `high` ``(2,)`` samples per metre upwards. `tops` become the highest corners of the steep
    cells and -inf of others, `squares` the highest of each square; -inf is returned where there is no steep cell.
    Cells with a void corner are not steep, but those next to them are: a line may come out of a void below terrain.
    """
    squares[:] = -np.inf
    highest = -np.inf
    for j in range(tops.shape[0]):
        for i in range(tops.shape[1]):
            tops[j, i] = -np.inf
            if climbs(heights, j, i, low, high) or (void and _is_beside_void(heights, j, i)):
                top = max(heights[j, i], heights[j, i + 1], heights[j + 1, i], heights[j + 1, i + 1])
                highest, tops[j, i] = max(highest, top), top
                square = squares[j >> SQUARE_BITS]
                square[i >> SQUARE_BITS] = max(square[i >> SQUARE_BITS], top)
    return highest


@inlined
def _is_beside_void(heights, j, i):
    """Return whether a cell without a void corner has a neighbour with one."""
    void = False
    for row in range(max(j - 1, 0), min(j + 3, heights.shape[0])):
        for column in range(max(i - 1, 0), min(i + 3, heights.shape[1])):
            void |= heights[row, column] != heights[row, column]
    total = heights[j, i] + heights[j, i + 1] + heights[j + 1, i] + heights[j + 1, i + 1]
    return void and total < np.inf


@compiled
def is_steep(heights: Any, low: Any, high: Any) -> bool:
    """Return whether any cell climbs faster than some line, as `find_steep` has it."""
    found = False
    for j in range(heights.shape[0] - 1):
        for i in range(heights.shape[1] - 1):
            found |= climbs(heights, j, i, low, high)
    return found


@compiled
def find_bounds(course: Course, heights: Any, tops: Any, above: Any, below: Any) -> None:
    """Fill the heights of cells from which on lines meet no steep cell any more, and those up to which they meet one.

    What blocks lines is handed on from row to row along columns that move with the lines. A line that begins in a
    cell of such a column stays within `pad` cells of it: what a column moves in whole cells differs from what a line
    does by less than one, begin and end may be anywhere in their rows, and its direction may be another by the spread.
    Where that comes to more than a cell, the neighbours are taken in each time it has come to one.
    """
    rows, columns = tops.shape
    forward, least, most, aside, spread, slack, reach = course
    drift = spread * (reach + 2.0)
    if drift > 1.0:
        drift = 1.0 + 2.0 * spread
    else:
        spread = 0.0
    pad = int(np.ceil(1.0 + abs(aside) + drift))
    moved = int(np.ceil(abs(aside) * rows)) + 1
    size = columns + 2 * moved
    high, low, here = np.full(size, -np.inf), np.full(size, -np.inf), np.empty(size)
    floors = np.empty(columns)
    for step in range(rows):
        j = rows - 1 - step if forward > 0 else step
        # The column of this row that the first one handed on is.
        offset = int(np.floor(-aside * step)) - moved
        if step > 0 and int(spread * step) > int(spread * (step - 1)):
            _take_in_neighbours(high, low, here)
        _widest(tops[j], offset, pad, here)
        for i in range(columns):
            above[j, i] = max(here[i - offset], high[i - offset])
            below[j, i] = low[i - offset] - most - slack
        for k in range(size):
            high[k] = max(here[k], high[k] - least)
        for i in range(columns):
            h00, h10, h01, h11 = heights[j, i], heights[j, i + 1], heights[j + 1, i], heights[j + 1, i + 1]
            floors[i] = min(h00, h10, h01, h11) if h00 + h10 + h01 + h11 < np.inf else -np.inf
        _lowest(floors, offset, pad, here)
        for k in range(size):
            low[k] = max(here[k], low[k]) - most


@inlined
def _take_in_neighbours(high, low, scratch):
    last = len(high) - 1
    for k in range(last + 1):
        scratch[k] = max(high[max(k - 1, 0)], high[k], high[min(k + 1, last)])
    for k in range(last + 1):
        high[k] = scratch[k]
    for k in range(last + 1):
        scratch[k] = min(low[max(k - 1, 0)], low[k], low[min(k + 1, last)])
    for k in range(last + 1):
        low[k] = scratch[k]


@inlined
def _widest(tops, offset, pad, out):
    """Fill the highest of the tops within `pad` of each place; the first place is the column `offset`."""
    out[:] = -np.inf
    for i in range(len(tops)):
        if tops[i] > -np.inf:
            for k in range(max(i - offset - pad, 0), min(i - offset + pad + 1, len(out))):
                out[k] = max(out[k], tops[i])


@inlined
def _lowest(floors, offset, pad, out):
    """Fill the lowest of the floors within `pad` of each place, -inf where it is partly outside."""
    out[:] = -np.inf
    begin = -offset
    for i in range(pad, len(floors) - pad):
        out[begin + i] = floors[i - pad]
    for shift in range(1 - pad, pad + 1):
        for i in range(pad, len(floors) - pad):
            out[begin + i] = min(out[begin + i], floors[i + shift])


@compiled
def find_known(heights: Any, above: Any, below: Any, known: Any) -> None:
    """Fill `Relief.known`."""
    for j in range(known.shape[0]):
        for i in range(known.shape[1]):
            h00, h10, h01, h11 = heights[j, i], heights[j, i + 1], heights[j + 1, i], heights[j + 1, i + 1]
            least, most = min(h00, h10, h01, h11), max(h00, h10, h01, h11)
            found = CLEAR if least >= above[j, i] else (HIDDEN if most <= below[j, i] else VOID)
            known[j, i] = found if h00 + h10 + h01 + h11 < np.inf else VOID


@inlined
def _rises_above(heights, i, j, x, y, h, across, down, bend, start, end):
    """Return whether the terrain of a cell rises above a line between two of its heights over its beginning."""
    h00 = heights[j, i]
    a, b = heights[j, i + 1] - h00, heights[j + 1, i] - h00
    c = heights[j + 1, i + 1] - heights[j + 1, i] - a
    px, py, length = x + across * start - i, y + down * start - j, end - start
    f0 = h00 + a * px + b * py + c * px * py - (h + start + bend * start * start)
    f1 = a * across + b * down + c * (px * down + py * across) - 1.0 - 2.0 * bend * start
    f2 = c * across * down - bend
    most = max(f0, f0 + (f1 + f2 * length) * length)
    if 0.0 < f1 < -2.0 * f2 * length:
        most = max(most, f0 - f1 * f1 / (4.0 * f2))
    return most > _ROUNDING


@inlined
def _is_hidden(heights, tops, squares, above, below, x, y, h, across, down, bend):
    """Return whether terrain blocks the line from (x, y) in the window, at the height h.

    It goes `across` and `down` samples per metre upwards.
    """
    rows, columns = tops.shape
    i, j, rise = min(int(x), columns - 1), min(int(y), rows - 1), 0.0
    per_column, per_row = 1.0 / across, 1.0 / down
    hidden, going = False, True
    while going:
        bi, bj = i >> SQUARE_BITS, j >> SQUARE_BITS
        whole = squares[bj, bi] <= h + rise
        first = bi << SQUARE_BITS if whole else i
        last = (bi + 1) << SQUARE_BITS if whole else i + 1
        upper = bj << SQUARE_BITS if whole else j
        lower = (bj + 1) << SQUARE_BITS if whole else j + 1
        side = ((last if across > 0.0 else first) - x) * per_column if across != 0.0 else np.inf
        end = ((lower if down > 0.0 else upper) - y) * per_row if down != 0.0 else np.inf
        sideways = side <= end
        stop = side if sideways else end
        if not whole and tops[j, i] > h + rise:
            hidden = _rises_above(heights, i, j, x, y, h, across, down, bend, rise, stop)
        if sideways:
            i = last if across > 0.0 else first - 1
            if whole:
                j = min(max(int(y + down * stop), upper), lower - 1)
        else:
            j = lower if down > 0.0 else upper - 1
            if whole:
                i = min(max(int(x + across * stop), first), last - 1)
        rise = max(rise, stop)
        going = not hidden and 0 <= i < columns and 0 <= j < rows
        if going:
            hidden = h + rise <= below[j, i]
            going = not hidden and h + rise < above[j, i]
    return hidden


@inlined
def _height(heights, x, y):
    """Interpolate at (x, y) in the window; NaN outside, and next to a void."""
    rows, columns = heights.shape
    if not (0.0 <= x <= columns - 1 and 0.0 <= y <= rows - 1):
        return np.nan
    i, j = int(x), int(y)
    fx, fy = x - i, y - j
    upper = heights[j, i] if fx == 0.0 else heights[j, i] + (heights[j, i + 1] - heights[j, i]) * fx
    if fy == 0.0:
        return upper
    lower = heights[j + 1, i]
    if fx > 0.0:
        lower += (heights[j + 1, i + 1] - lower) * fx
    return upper + (lower - upper) * fy


@compiled
def look(rays: Rays, relief: Relief, first_row: int, first_column: int, out: Any) -> None:
    """Fill `out` ``(h, w)``, which begins with a row and a column of the tile, with `CLEAR`, `HIDDEN` or `VOID`."""
    samples, near, slopes, far, middle, half, bend = rays
    _, west, north, _, _, _, _, known, _ = relief
    height, width = out.shape
    rows, columns = known.shape
    count = slopes.shape[2]
    begin, grow = np.empty((count, 2)), np.empty((count, 2))
    for line in range(height):
        row = first_row + line
        ry, ty = row // far, (row % far) / far
        ny, fy = row // near, (row % near) / near
        column = first_column
        while column < first_column + width:
            stop = min((column // near + 1) * near, first_column + width)
            rx, nx = column // far, column // near
            for k in range(count):
                for axis in range(2):
                    start, end = slopes[ry, rx, k, axis], slopes[ry, rx + 1, k, axis]
                    start += (slopes[ry + 1, rx, k, axis] - start) * ty
                    end += (slopes[ry + 1, rx + 1, k, axis] - end) * ty
                    begin[k, axis], grow[k, axis] = start, (end - start) / far
            u0, u1 = samples[ny, nx, 0], samples[ny, nx + 1, 0]
            v0, v1 = samples[ny, nx, 1], samples[ny, nx + 1, 1]
            u0, u1 = u0 + (samples[ny + 1, nx, 0] - u0) * fy, u1 + (samples[ny + 1, nx + 1, 0] - u1) * fy
            v0, v1 = v0 + (samples[ny + 1, nx, 1] - v0) * fy, v1 + (samples[ny + 1, nx + 1, 1] - v1) * fy
            du, dv = (u1 - u0) / near, (v1 - v0) / near
            wide = max(abs(du), abs(dv)) < _WIDE
            c = column
            while c < stop:
                x, y = u0 + du * (c - nx * near) - west, v0 + dv * (c - nx * near) - north
                i, j = int(x), int(y)
                found = VOID
                if 0.0 <= x < columns and 0.0 <= y < rows:
                    found = known[j, i]
                    if wide and found != VOID:
                        end = min(c + int(_pixels_within(x, y, i, j, du, dv)), stop - 1)
                        while c < end:
                            out[line, c - first_column] = found
                            c += 1
                if found == VOID:
                    found = _looked_along(relief, begin, grow, c - rx * far, middle, half, bend, x, y)
                out[line, c - first_column] = found
                c += 1
            column = stop


@inlined
def _looked_along(relief, begin, grow, at, middle, half, bend, x, y):
    """Return the class of the place (x, y) in the window, where directions have grown over so many pixels."""
    heights, _, _, tops, squares, above, below, _, highest = relief
    h = _height(heights, x, y)
    found = CLEAR if h < np.inf else VOID
    if h < highest:
        i, j = min(int(x), tops.shape[1] - 1), min(int(y), tops.shape[0] - 1)
        if h <= below[j, i]:
            found = HIDDEN
        elif h < above[j, i]:
            t, across, down = (h - middle) / half, 0.0, 0.0
            for k in range(begin.shape[0] - 1, -1, -1):
                across = across * t + (begin[k, 0] + grow[k, 0] * at)
                down = down * t + (begin[k, 1] + grow[k, 1] * at)
            if _is_hidden(heights, tops, squares, above, below, x, y, h, across, down, bend):
                found = HIDDEN
    return found


@inlined
def _pixels_within(x, y, i, j, du, dv):
    """Return how many more pixels of a row surely are in a cell."""
    across = ((i + 1 - x) / du if du > 0.0 else (i - x) / du) if du != 0.0 else 1e6
    down = ((j + 1 - y) / dv if dv > 0.0 else (j - y) / dv) if dv != 0.0 else 1e6
    return max(min(across, down, 1e6) - 1.0, 0.0)
