"""Compiled search for where rays first meet a DEM, from above; see rays.py.

A ray is a curve: the DEM coordinates (u, v) as polynomials in the normalised height, with five coefficients each.
Upwards it rises faster than the terrain, except in *steep* cells of four samples, which climb faster than the ray.
Newton's method finds a point of the ray on the terrain. It is the first one if the ray is above all steep cells on its
way up. If this is not certain, the ray is followed from above, from cell to cell. Within a cell the terrain along the
ray is a quadratic function, so the meeting point is exact, not sampled. Groups of cells below the ray are skipped:
squares of 8 x 8 cells, of 16 x 16, and so on have their highest sample.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.runtime.compiled import compiled, inlined

Array = NDArray[np.float64]

#: Cells per side of the smallest square, as a power of two.
SQUARE_BITS = 3
#: Rays of a block, and rows of their workspace: ten coefficients, normalised height, misfit, position in the cell, its
#: corners. One array of known size, so that loops become vector instructions.
BLOCK = 256
_T, _MISS, _FX, _FY, _H00, _H10, _H01, _H11, _ROWS = range(10, 19)
#: Newton steps before a ray is followed from cell to cell.
_STEPS = 8
#: Longest last Newton step (samples).
_LAST = 0.01
#: Height (m) above the highest sample at which a ray starts: more than rounding.
_MARGIN = 1e-4


class BoundedHeights(NamedTuple):
    """Heights of a DEM, and bounds on them.

    Parameters
    ----------
    heights : (rows, columns)
        From sample (left, top) on; NaN for voids.
    middle, half : float
        The normalised height is -1 at middle - half and 1 at middle + half (m).
    tops : (n,)
        The highest sample of each square of cells, edges included, -inf without samples: first those of 8 x 8 cells,
        row by row, then those of twice the side, until one square contains all.
    steep : (rows, columns)
        For squares of 8 x 8 cells, the highest corner of any steep cell that a ray upwards from there can pass.
    steepest : float
        The largest difference (m) of neighbouring samples.
    """

    heights: Any
    left: float
    top: float
    middle: float
    half: float
    tops: Any
    steep: Any
    steepest: float


def terrain_of(heights: Array, left: int, top: int, middle: float, half: float, nodes: Array) -> BoundedHeights:
    """Return heights ``(rows, columns)`` as terrain for the rays between `nodes` ``(..., n)``: see `curves_at`."""
    first = nodes[..., (1, 6)].reshape(-1, 2)
    rest = (np.abs(nodes[..., (2, 3, 4, 7, 8, 9)]).reshape(-1, 2, 3) * (2, 3, 4)).sum(axis=2)
    # Least and greatest number of samples per metre upwards. Without known nodes there are no rays.
    known = np.isfinite(first + rest).all(axis=1)
    low, high = np.zeros(2), np.zeros(2)
    if known.any():
        low, high = (first - rest)[known].min(axis=0) / half, (first + rest)[known].max(axis=0) / half
    heights = np.ascontiguousarray(heights)
    tops, steep, voids = (np.empty(tuple(((side - 2) >> SQUARE_BITS) + 1 for side in heights.shape)) for _ in range(3))
    steepest = float(find_squares(heights, low, high, tops, steep, voids))
    if voids.any():
        # For all cells next to a void: a ray may come out of it below the terrain.
        wide = np.pad(voids, 1)
        near = [wide[j : j + len(voids), i : i + voids.shape[1]] for j in range(3) for i in range(3)]
        steep = np.where(np.any(near, axis=0), tops, steep)
    if steep.max() > -np.inf:
        steep = _ahead(steep, low * 2 * half, high * 2 * half)
    levels = [tops]
    while levels[-1].size > 1:
        rows, columns = (np.arange(0, side, 2) for side in levels[-1].shape)
        levels.append(np.maximum.reduceat(np.maximum.reduceat(levels[-1], rows, axis=0), columns, axis=1))
    bounds = np.concatenate([level.ravel() for level in levels])
    return BoundedHeights(heights, float(left), float(top), float(middle), float(half), bounds, steep, steepest)


def _ahead(steep: Array, low: Array, high: Array) -> Array:
    """Return the highest of squares that rays from a square pass, which go `low` to `high` ``(2,)`` samples in all."""
    from scipy.ndimage import maximum_filter1d

    side = 1 << SQUARE_BITS
    for axis, least, most in zip((1, 0), low, high, strict=True):
        # With a sample more, and from both ends of a square.
        first, last = math.floor((min(least, 0.0) - 1) / side), math.floor((max(most, 0.0) + 1) / side) + 1
        first, last = max(first, -steep.shape[axis]), min(last, steep.shape[axis])
        size = last - first + 1
        origin = -first - size // 2
        steep = maximum_filter1d(steep, size, axis=axis, mode="constant", cval=-np.inf, origin=origin)
    return steep


def meet(curves: Array, terrain: BoundedHeights, tolerance: float) -> Array:
    """Return the normalised heights ``(n,)`` at which rays first meet the terrain; NaN where they do not.

    Parameters
    ----------
    curves : (10 or more, n)
        Coefficients of u and v.
    tolerance : float
        Greatest difference (m) of ray and terrain.
    """
    found = np.empty(curves.shape[1])
    if approach(curves, terrain, tolerance, found):
        left = np.flatnonzero(np.isnan(found))
        some = np.empty(len(left))
        follow(np.ascontiguousarray(curves[:10, left].T), terrain, tolerance, some)
        found[left] = some
    return found


@inlined
def climbs(heights, j, i, low, high):
    """Return whether a cell is steeper than a line of `low` to `high` samples per metre; never next to a void."""
    h00, h10, h01, h11 = heights[j, i], heights[j, i + 1], heights[j + 1, i], heights[j + 1, i + 1]
    across = max(low[0] * (h10 - h00), high[0] * (h10 - h00), low[0] * (h11 - h01), high[0] * (h11 - h01))
    down = max(low[1] * (h01 - h00), high[1] * (h01 - h00), low[1] * (h11 - h10), high[1] * (h11 - h10))
    return across + down > 1.0 and h00 + h10 + h01 + h11 < np.inf


@compiled
def find_squares(heights: Any, low: Any, high: Any, tops: Any, steep: Any, voids: Any) -> float:
    """Fill the highest sample of squares, that of their steep cells, and 1 where one is void; return `steepest`.

    Rays go `low` to `high` ``(2,)`` samples per metre upwards.
    """
    down, across = tops.shape
    steepest, most = 0.0, max(abs(low[0]), abs(high[0])) + max(abs(low[1]), abs(high[1]))
    for bj in range(down):
        for bi in range(across):
            row, column = bj << SQUARE_BITS, bi << SQUARE_BITS
            last_row = min(row + (1 << SQUARE_BITS), heights.shape[0] - 1)
            last = min(column + (1 << SQUARE_BITS), heights.shape[1] - 1)
            top, peak, step, void = -np.inf, -np.inf, 0.0, 0.0
            for j in range(row, last_row + 1):
                for i in range(column, last + 1):
                    h = heights[j, i]
                    top = h if h > top else top
                    void = 1.0 if np.isnan(h) else void
                    aside, below = abs(heights[j, min(i + 1, last)] - h), abs(heights[min(j + 1, last_row), i] - h)
                    step = aside if aside > step else step
                    step = below if below > step else step
            if most * step > 1.0:
                for j in range(row, last_row):
                    for i in range(column, last):
                        if climbs(heights, j, i, low, high):
                            corners = max(heights[j, i], heights[j, i + 1], heights[j + 1, i], heights[j + 1, i + 1])
                            peak = max(peak, corners)
            tops[bj, bi], steep[bj, bi], voids[bj, bi] = top, peak, void
            steepest = max(steepest, step)
    return steepest


@compiled
def curves_at(nodes: Any, places: Any, curves: Any) -> None:
    """Fill `curves` ``(n, N)`` with the coefficients at `places` ``(N, 2)`` between `nodes` ``(rows, columns, n)``.

    The first ten are of rays; NaN outside.
    """
    right, bottom = nodes.shape[1] - 1, nodes.shape[0] - 1
    for k in range(places.shape[0]):
        x, y = places[k, 0], places[k, 1]
        inside = 0.0 <= x <= right and 0.0 <= y <= bottom
        i, j = (min(int(x), right - 1), min(int(y), bottom - 1)) if inside else (0, 0)
        fx, fy = x - i if inside else np.nan, y - j
        w00, w10, w01, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
        for m in range(nodes.shape[2]):
            upper = w00 * nodes[j, i, m] + w10 * nodes[j, i + 1, m]
            curves[m, k] = upper + w01 * nodes[j + 1, i, m] + w11 * nodes[j + 1, i + 1, m]


@inlined
def _locate(work, cells, left, top, rows, columns):
    """Find the cells of the rays of a block, and the positions in them, at their heights."""
    for k in range(BLOCK):
        t = work[_T, k]
        x = work[0, k] + t * (work[1, k] + t * (work[2, k] + t * (work[3, k] + t * work[4, k]))) - left
        y = work[5, k] + t * (work[6, k] + t * (work[7, k] + t * (work[8, k] + t * work[9, k]))) - top
        inside = (x >= 0.0) & (x <= columns) & (y >= 0.0) & (y <= rows)
        x, y = x if inside else 0.0, y if inside else 0.0
        i, j = min(int(x), columns - 1), min(int(y), rows - 1)
        cells[0, k], cells[1, k] = i, j
        work[_FX, k], work[_FY, k] = x - i if inside else np.nan, y - j


@inlined
def _improve(work, middle, half, tolerance):
    """Do a Newton step for the rays of a block that are not on the terrain; return how many they were."""
    left = 0
    for k in range(BLOCK):
        t, fx, fy = work[_T, k], work[_FX, k], work[_FY, k]
        across, down = work[1, k] + work[3, k], work[6, k] + work[8, k]
        a, b = work[_H10, k] - work[_H00, k], work[_H01, k] - work[_H00, k]
        c = work[_H11, k] - work[_H01, k] - a
        miss = middle + half * t - (work[_H00, k] + a * fx + b * fy + c * fx * fy)
        step = miss / (half - (a + c * fy) * across - (b + c * fx) * down)
        far = abs(miss) > tolerance
        # The last step, from a near position, is only made if the ray stays in its cell.
        going = (work[_MISS, k] > tolerance) & (far | (abs(step) * (abs(across) + abs(down)) < _LAST))
        work[_T, k] = min(max(t - step, -1.0), 1.0) if going else t
        work[_MISS, k] = abs(miss) if work[_MISS, k] > tolerance else work[_MISS, k]
        left += 1 if far else 0
    return left


@compiled
def approach(curves: Any, terrain: BoundedHeights, tolerance: float, found: Any) -> int:
    """Fill the heights at which rays certainly first meet the terrain, NaN for the others; return how many are NaN."""
    heights, rows, columns = terrain.heights, terrain.heights.shape[0] - 1, terrain.heights.shape[1] - 1
    work, cells, others = np.zeros((_ROWS, BLOCK)), np.zeros((2, BLOCK), np.int64), 0
    for first in range(0, curves.shape[1], BLOCK):
        count = min(BLOCK, curves.shape[1] - first)
        for m in range(10):
            for k in range(count):
                work[m, k] = curves[m, first + k]
        for k in range(BLOCK):
            work[_T, k], work[_MISS, k] = 0.0, np.inf
        for _ in range(_STEPS):
            _locate(work, cells, terrain.left, terrain.top, rows, columns)
            for k in range(count):
                i, j = cells[0, k], cells[1, k]
                work[_H00, k], work[_H10, k] = heights[j, i], heights[j, i + 1]
                work[_H01, k], work[_H11, k] = heights[j + 1, i], heights[j + 1, i + 1]
            if _improve(work, terrain.middle, terrain.half, tolerance) == 0:
                break
        for k in range(count):
            peak = terrain.steep[cells[1, k] >> SQUARE_BITS, cells[0, k] >> SQUARE_BITS]
            sure = work[_MISS, k] <= tolerance and peak <= terrain.middle + terrain.half * work[_T, k]
            found[first + k] = work[_T, k] if sure else np.nan
            others += 0 if sure else 1
    return others


@inlined
def _place(curve, t, terrain):
    """Where a ray is in the window at a normalised height."""
    x = curve[0] + t * (curve[1] + t * (curve[2] + t * (curve[3] + t * curve[4])))
    y = curve[5] + t * (curve[6] + t * (curve[7] + t * (curve[8] + t * curve[9])))
    return x - terrain.left, y - terrain.top


@inlined
def _surface(heights, i, j, x, y):
    """Height of the surface through the corners of a cell, inside and outside it; NaN next to a void."""
    fx, fy = x - i, y - j
    upper = heights[j, i] + (heights[j, i + 1] - heights[j, i]) * fx
    lower = heights[j + 1, i] + (heights[j + 1, i + 1] - heights[j + 1, i]) * fx
    return upper + (lower - upper) * fy


@inlined
def _clearance(curve, terrain, i, j, t):
    """Height of a ray above the terrain, in half ranges of height; above the cell (i, j) if it is next to a void."""
    x, y = _place(curve, t, terrain)
    heights = terrain.heights
    column, row = min(max(int(x), 0), heights.shape[1] - 2), min(max(int(y), 0), heights.shape[0] - 2)
    found = _surface(heights, column, row, x, y)
    if np.isnan(found):
        found = _surface(heights, i, j, x, y)
    return terrain.middle + terrain.half * t - found


@inlined
def _narrowed(curve, terrain, i, j, high, above, low, below, t, tolerance):
    """Return the height between two at which a ray is on the terrain, by false position and bisection from a guess."""
    for turn in range(60):
        miss = _clearance(curve, terrain, i, j, t)
        if not abs(miss) > tolerance:
            break
        if miss > 0.0:
            high, above = t, miss
        else:
            low, below = t, miss
        t = 0.5 * (high + low) if turn % 3 == 2 else high - above * (low - high) / (below - above)
    return t


@inlined
def _square(tops, rows, columns, i, j, bits):
    """Highest sample of the square, with side 2^bits, that contains a cell."""
    begin = 0
    for k in range(SQUARE_BITS, bits):
        begin += (((rows - 1) >> k) + 1) * (((columns - 1) >> k) + 1)
    return tops[begin + (j >> bits) * (((columns - 1) >> bits) + 1) + (i >> bits)]


@inlined
def _coarsest(length):
    """Return the bits of the smallest squares that are at least `length` wide."""
    bits = SQUARE_BITS
    while length > 1 << bits:
        bits += 1
    return bits


@inlined
def _free(terrain, i, j, t, coarse):
    """Return the bits of the largest square around a cell that is below a ray (or zero), and how far down that is."""
    rows, columns = terrain.heights.shape[0] - 1, terrain.heights.shape[1] - 1
    bits, drop = coarse, 0.0
    while bits >= SQUARE_BITS:
        drop = t - (_square(terrain.tops, rows, columns, i, j, bits) + _MARGIN - terrain.middle) / terrain.half
        if drop > 1e-9:
            break
        bits -= 1
    return bits if bits >= SQUARE_BITS else 0, drop


@inlined
def _entry(x, y, across, down, rows, columns):
    """Return how far a ray from (x, y) goes down until it is within the samples."""
    aside = -x if across > 0.0 else x - columns
    behind = -y if down > 0.0 else y - rows
    return max(aside / abs(across), behind / abs(down), 0.0)


@inlined
def _crossed(curve, terrain, i, j, across, down, t, above, after, below, tolerance):
    """Return where a ray that crosses a cell from t to `after` first meets it; infinity if it does not.

    Its clearance is `above` where it enters the cell and `below` where it leaves.
    """
    heights, step = terrain.heights, t - after
    # The clearance between both is c + b s + a s^2, s from 0 to 1.
    twist = heights[j, i] + heights[j + 1, i + 1] - heights[j, i + 1] - heights[j + 1, i]
    a = -twist * across * down * step * step
    b = below - above - a
    if below > 0.0 and a > 0.0 and -2.0 * a < b < 0.0 and above - b * b / (4.0 * a) < 2.0 * tolerance:
        # It meets the terrain in between, or nearly.
        after = t + step * b / (2.0 * a)
        below = _clearance(curve, terrain, i, j, after)
        a, b = 0.0, below - above
    if below > 0.0:
        return np.inf
    share = 2.0 * above / (np.sqrt(max(b * b - 4.0 * a * above, 0.0)) - b)
    return _narrowed(curve, terrain, i, j, t, above, after, below, t - share * (t - after), tolerance)


@inlined
def _first_meeting(curve, terrain, tolerance):
    """Return the normalised height at which a ray first meets the terrain, from above; NaN where it does not.

    `curve` has five coefficients of each of the DEM coordinates (u, v), polynomials in the normalised height, which
    decreases from 1 to -1. A ray that leaves a void, or enters the DEM, below the terrain meets it there.
    """
    rows, columns = terrain.heights.shape[0] - 1, terrain.heights.shape[1] - 1
    # Samples per unit of normalised height downwards, along the chord, and never exactly vertical.
    across, down = -(curve[1] + curve[3]), -(curve[6] + curve[8])
    across, down = across if across != 0.0 else 1e-30, down if down != 0.0 else 1e-30
    if not abs(across) + abs(down) < 1e5:
        return np.nan
    coarse = _coarsest(min(max(abs(across), abs(down)), float(max(rows, columns))))
    t, clear = 1.0, np.nan
    x, y = _place(curve, t, terrain)
    t -= _entry(x, y, across, down, rows, columns)
    x, y = _place(curve, t, terrain)
    i, j = min(max(int(x), 0), columns - 1), min(max(int(y), 0), rows - 1)
    while t > -1.0 and 0 <= i < columns and 0 <= j < rows:
        bits, drop = _free(terrain, i, j, t, coarse)
        left, upper = (i >> bits) << bits, (j >> bits) << bits
        right, lower = min(left + (1 << bits), columns), min(upper + (1 << bits), rows)
        side, end = right if across > 0.0 else left, lower if down > 0.0 else upper
        step_x, step_y = (side - x) / across, (end - y) / down
        step = max(min(step_x, step_y, t + 1.0), 0.0)
        # The curve differs from its chord: repeat from the new position.
        x, y = _place(curve, t - step, terrain)
        step_x, step_y = step + (side - x) / across, step + (end - y) / down
        step = max(min(step_x, step_y, t + 1.0), 0.0)
        inside = bits > 0 and drop < step
        after = t - (drop if inside else step)
        below = np.nan
        if bits == 0:
            clear = _clearance(curve, terrain, i, j, t) if np.isnan(clear) else clear
            if clear <= 0.0:
                break
            below = _clearance(curve, terrain, i, j, after)
            if clear > 0.0:
                met = _crossed(curve, terrain, i, j, across, down, t, clear, after, below, tolerance)
                if met < np.inf:
                    return met
        clear = below
        t = after
        x, y = _place(curve, t, terrain)
        sideways, straight = not inside and step_x <= step_y, not inside and step_x > step_y
        i = (right if across > 0.0 else left - 1) if sideways else min(max(int(x), left), right - 1)
        j = (lower if down > 0.0 else upper - 1) if straight else min(max(int(y), upper), lower - 1)
    return np.nan


@compiled
def follow(curves: Any, terrain: BoundedHeights, tolerance: float, found: Any) -> None:
    """Fill the normalised heights ``(n,)`` at which rays ``(n, 10)`` first meet the terrain; NaN where they do not."""
    for k in range(curves.shape[0]):
        found[k] = _first_meeting(curves[k], terrain, tolerance)
