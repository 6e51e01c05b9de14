"""Compiled march from the ground towards the sensor, or the sun: does other terrain stand in the way?

A line of sight is straight: it begins on the terrain, bilinear between samples, and goes on by so many samples per
metre that it rises. Within a cell of four samples the terrain along it is a quadratic function, so that whether it
rises above the line is known, not sampled. Terrain can rise above a line only in a cell that is *steep*: where it
climbs faster than the line does. All other cells are passed unseen, and so are squares of them whose steep cells all
lie below the line. A line ends where it is above all steep cells that it could still meet: `find_bounds` takes from
square to square what stands in the way of lines farther on, less what they rise until then.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.files.compiled import compiled, inlined

#: Classes of `look`.
CLEAR, HIDDEN, VOID = 0, 1, 2
#: Cells per side of a square that is passed at once, as a power of two.
SQUARE_BITS = 3
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
    """Heights ``(rows, columns)`` from sample (left, top) on; which cells are steep, and the highest of each square.

    A line that is at `bounds` or above somewhere in a square meets no steep cell any more; nor does one at `highest`.
    """

    heights: Any
    left: int
    top: int
    steep: Any
    squares: Any
    bounds: Any
    highest: float


@compiled
def find_steep(heights: Any, low: Any, high: Any, steep: Any, squares: Any) -> float:
    """Mark the cells ``(rows - 1, columns - 1)`` that climb faster than some line; return the highest corner of any.

    The lines go `low` to `high` ``(2,)`` samples per metre upwards. `squares` become the highest corner of the steep
    cells in each square, -inf where there are none, which is returned too where there is no steep cell. A cell beside
    a void is not steep.
    """
    squares[:] = -np.inf
    highest = -np.inf
    for j in range(steep.shape[0]):
        for i in range(steep.shape[1]):
            h00, h10, h01, h11 = heights[j, i], heights[j, i + 1], heights[j + 1, i], heights[j + 1, i + 1]
            across = max(low[0] * (h10 - h00), high[0] * (h10 - h00), low[0] * (h11 - h01), high[0] * (h11 - h01))
            down = max(low[1] * (h01 - h00), high[1] * (h01 - h00), low[1] * (h11 - h10), high[1] * (h11 - h10))
            # False beside a void, whichever corner it is.
            climbs = across + down > 1.0 and h00 + h10 + h01 + h11 < np.inf
            steep[j, i] = climbs
            if climbs:
                top = max(h00, h10, h01, h11)
                highest = max(highest, top)
                square = squares[j >> SQUARE_BITS]
                square[i >> SQUARE_BITS] = max(square[i >> SQUARE_BITS], top)
    return highest


@compiled
def find_bounds(squares: Any, forward: int, rise: float, first: int, last: int, entered: Any, bounds: Any) -> None:
    """Fill heights from which on a line in a square ``(rows, columns)`` meets no steep cell any more.

    Lines go from column to column, `forward` (1 or -1), rise at least `rise` (m) over each, and by then are between
    `first` and `last` rows farther. `entered` becomes the same for lines that enter the square from the column before.
    """
    rows, columns = squares.shape
    for step in range(columns):
        i = columns - 1 - step if forward > 0 else step
        for j in range(rows):
            here, farther = -np.inf, -np.inf
            for row in range(max(j + first, 0), min(j + last, rows - 1) + 1):
                here = max(here, squares[row, i])
                if step > 0:
                    farther = max(farther, entered[row, i + forward])
            bounds[j, i] = max(here, farther)
            entered[j, i] = max(here, farther - rise)


@inlined
def _rises_above(heights, i, j, x, y, h, across, down, bend, start, end):
    """Tell whether the terrain of a cell rises above a line between two of its heights over its beginning."""
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
def _is_hidden(heights, steep, squares, bounds, x, y, h, across, down, bend):
    """Tell whether terrain stands in the way of the line from (x, y) in the window, at the height h.

    It goes `across` and `down` samples per metre upwards.
    """
    rows, columns = steep.shape
    i, j, rise = min(int(x), columns - 1), min(int(y), rows - 1), 0.0
    per_column, per_row = 1.0 / across, 1.0 / down
    hidden, going = False, True
    while going:
        bi, bj = i >> SQUARE_BITS, j >> SQUARE_BITS
        whole = squares[bj, bi] <= h + rise
        first = bi << SQUARE_BITS if whole else i
        last = (bi + 1) << SQUARE_BITS if whole else i + 1
        above = bj << SQUARE_BITS if whole else j
        below = (bj + 1) << SQUARE_BITS if whole else j + 1
        side = ((last if across > 0.0 else first) - x) * per_column if across != 0.0 else np.inf
        end = ((below if down > 0.0 else above) - y) * per_row if down != 0.0 else np.inf
        sideways = side <= end
        stop = side if sideways else end
        if not whole and steep[j, i]:
            hidden = _rises_above(heights, i, j, x, y, h, across, down, bend, rise, stop)
        if sideways:
            i = last if across > 0.0 else first - 1
            if whole:
                j = min(max(int(y + down * stop), above), below - 1)
        else:
            j = below if down > 0.0 else above - 1
            if whole:
                i = min(max(int(x + across * stop), first), last - 1)
        rise = max(rise, stop)
        going = not hidden and 0 <= i < columns and 0 <= j < rows
        going = going and h + rise < bounds[j >> SQUARE_BITS, i >> SQUARE_BITS]
    return hidden


@inlined
def _height(heights, x, y):
    """Interpolate at (x, y) in the window; NaN outside, and beside a void."""
    rows, columns = heights.shape
    if not (0.0 <= x <= columns - 1 and 0.0 <= y <= rows - 1):
        return np.nan
    i, j = min(int(x), columns - 2), min(int(y), rows - 2)
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
    heights, west, north, steep, squares, bounds, highest = relief
    height, width = out.shape
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
            for c in range(column, stop):
                x, y = u0 + du * (c - nx * near) - west, v0 + dv * (c - nx * near) - north
                h = _height(heights, x, y)
                found = VOID
                if h < highest:
                    found = CLEAR
                    i, j = min(int(x), steep.shape[1] - 1), min(int(y), steep.shape[0] - 1)
                    if not h < bounds[j >> SQUARE_BITS, i >> SQUARE_BITS]:
                        out[line, c - first_column] = found
                        continue
                    t, at, across, down = (h - middle) / half, c - rx * far, 0.0, 0.0
                    for k in range(count - 1, -1, -1):
                        across = across * t + (begin[k, 0] + grow[k, 0] * at)
                        down = down * t + (begin[k, 1] + grow[k, 1] * at)
                    hidden = _is_hidden(heights, steep, squares, bounds, x, y, h, across, down, bend)
                    found = HIDDEN if hidden else CLEAR
                elif h < np.inf:
                    found = CLEAR
                out[line, c - first_column] = found
            column = stop
