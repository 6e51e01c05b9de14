"""Compiled march along the rays of image points down to a DEM; see rays.py."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.files.compiled import compiled, inlined


@inlined
def clearance(u, v, t, heights, left, top, middle, half):
    """Height of the ray above the terrain at the normalised height t; NaN off the DEM and beside a void.

    `u` and `v` are polynomials of five coefficients in t.
    """
    x = u[0] + t * (u[1] + t * (u[2] + t * (u[3] + t * u[4]))) - left
    y = v[0] + t * (v[1] + t * (v[2] + t * (v[3] + t * v[4]))) - top
    rows, columns = heights.shape
    if not (0.0 <= x <= columns - 1 and 0.0 <= y <= rows - 1):
        return np.nan
    i, j = min(int(x), columns - 2), min(int(y), rows - 2)
    fx, fy = x - i, y - j
    upper = heights[j, i] + (heights[j, i + 1] - heights[j, i]) * fx
    lower = heights[j + 1, i] + (heights[j + 1, i + 1] - heights[j + 1, i]) * fx
    return middle + half * t - (upper + (lower - upper) * fy)


@compiled
def first_meeting(u, v, heights, left, top, middle, half, tolerance):
    """Return the normalised height at which a ray first meets the terrain, from above; NaN where it does not.

    Steps are at most one DEM sample long in plan, so that no ridge is stepped over; the bracket is then narrowed by
    false position, with a bisection every third time, until ray and terrain differ by less than `tolerance` (m).
    """
    length = 2.0 * np.hypot(u[1] + u[3], v[1] + v[3])
    if not length < 1e5:
        return np.nan
    steps = int(length) + 1
    high, above = 1.0, clearance(u, v, 1.0, heights, left, top, middle, half)
    low, below = high, above
    for step in range(1, steps + 1):
        low = 1.0 - 2.0 * step / steps
        below = clearance(u, v, low, heights, left, top, middle, half)
        if below <= 0.0:
            break
        high, above = low, below
    if not (below <= 0.0 and above > 0.0):
        return np.nan
    for turn in range(60):
        t = 0.5 * (high + low) if turn % 3 == 2 else high - above * (low - high) / (below - above)
        miss = clearance(u, v, t, heights, left, top, middle, half)
        if abs(miss) <= tolerance:
            return t
        if miss > 0.0:
            high, above = t, miss
        elif miss <= 0.0:
            low, below = t, miss
        else:
            break
    return np.nan


@compiled
def march(image, nodes, origin, spacing, heights, left, top, middle, half, tolerance, found):
    """Fill `found` ``(N,)`` with the heights at which rays first meet the terrain; NaN where they do not."""
    u, v = np.empty(nodes.shape[2]), np.empty(nodes.shape[2])
    for k in range(image.shape[0]):
        found[k] = np.nan
        px, py = (image[k, 0] - origin[0]) / spacing, (image[k, 1] - origin[1]) / spacing
        if not (0.0 <= px <= nodes.shape[1] - 1 and 0.0 <= py <= nodes.shape[0] - 1):
            continue
        i, j = min(int(px), nodes.shape[1] - 2), min(int(py), nodes.shape[0] - 2)
        fx, fy = px - i, py - j
        w00, w10, w01, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
        for m in range(nodes.shape[2]):
            u[m] = (
                w00 * nodes[j, i, m, 0] + w10 * nodes[j, i + 1, m, 0]
                + w01 * nodes[j + 1, i, m, 0] + w11 * nodes[j + 1, i + 1, m, 0]
            )  # fmt: skip
            v[m] = (
                w00 * nodes[j, i, m, 1] + w10 * nodes[j, i + 1, m, 1]
                + w01 * nodes[j + 1, i, m, 1] + w11 * nodes[j + 1, i + 1, m, 1]
            )  # fmt: skip
        found[k] = middle + half * first_meeting(u, v, heights, left, top, middle, half, tolerance)
