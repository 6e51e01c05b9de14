"""The polynomials of RPCs with their slopes, and compiled loops over many points.

Inlined functions are plain Python when Python calls them: for few points `rational` calls them with arrays and loads no
compiler. The order of operations is the same, so results agree in every bit.

A block of points stays in the first-level cache, with an array for each coordinate: loops without branches become
vector instructions. They read copies of the coefficients, which share no memory with the output. Products and sums are
not contracted (no FMA), so the result of a point is the same on every processor and at any position of a block.

The tables of an RPC are `offsets` and `scales` of lon, lat, h, column, row; `coefficients` ``(4, 20)`` of column
numerator and denominator, row numerator and denominator, the denominators positive at the centre; and `limits` of
normalised longitude and latitude, then lowest and highest normalised height.
"""

from __future__ import annotations

import numpy as np

from ortho_pipeline.runtime.compiled import compiled, inlined

#: Points of a block; their arrays fit into the first-level cache.
BLOCK = 256


@inlined
def normalised(lon, lat, h, offsets, scales):
    """Return normalised longitude (the shorter way around the Earth), latitude and height."""
    east = lon - offsets[0]
    east = east - 360.0 * np.rint(east / 360.0)
    return east / scales[0], (lat - offsets[1]) / scales[1], (h - offsets[2]) / scales[2]


@inlined
def polynomial(a, x, y, z):
    """Return the value of a polynomial at normalised (lon, lat, h) = (x, y, z); `a` are 20 numbers or arrays."""
    return (
        a[0]
        + x * (a[1] + x * (a[7] + x * a[11] + y * a[14] + z * a[17]) + y * (a[4] + y * a[12] + z * a[10]))
        + y * (a[2] + y * (a[8] + y * a[15] + z * a[18]) + z * (a[6] + z * a[16]))
        + z * (a[3] + z * (a[9] + z * a[19]) + x * (a[5] + z * a[13]))
    )


@inlined
def slopes(a, x, y, z):
    """Return the derivatives of a polynomial by x, y and z."""
    xx, yy, zz = x * x, y * y, z * z
    # The factors of the squares.
    p, q, r = a[7] + y * a[14] + z * a[17], a[8] + x * a[12] + z * a[18], a[9] + x * a[13] + y * a[16]
    return (
        a[1] + y * (a[4] + z * a[10]) + z * a[5] + 2.0 * x * p + 3.0 * xx * a[11] + yy * a[12] + zz * a[13],
        a[2] + x * (a[4] + z * a[10]) + z * a[6] + 2.0 * y * q + 3.0 * yy * a[15] + xx * a[14] + zz * a[16],
        a[3] + x * (a[5] + y * a[10]) + y * a[6] + 2.0 * z * r + 3.0 * zz * a[19] + xx * a[17] + yy * a[18],
    )


@inlined
def is_within(x, y, z, limits):
    """Return whether a place is within the limits of an RPC."""
    return (abs(x) <= limits[0]) & (abs(y) <= limits[0]) & (limits[1] <= z) & (z <= limits[2])


@inlined
def is_point(u, v, m, q):
    """Return whether two ratios are an image point: neither denominator is at or behind its pole."""
    return (m > 0.0) & (q > 0.0) & (abs(u) < np.inf) & (abs(v) < np.inf)


@inlined
def _ratio(num, den, x, y, z):
    """Return a ratio and its denominator."""
    m = polynomial(den, x, y, z)
    return polynomial(num, x, y, z) / m, m


@inlined
def _ratio_slopes(num, den, u, m, x, y, z):
    """Return the derivatives of a ratio `u` with the denominator `m`."""
    (nx, ny, nz), (mx, my, mz), by = slopes(num, x, y, z), slopes(den, x, y, z), 1.0 / m
    return (nx - u * mx) * by, (ny - u * my) * by, (nz - u * mz) * by


@inlined
def _place(ground, first, count, offsets, scales, work):
    """Fill the first rows of `work` with normalised coordinates of some points."""
    for k in range(count):
        lon, lat, h = ground[first + k, 0], ground[first + k, 1], ground[first + k, 2]
        work[0, k], work[1, k], work[2, k] = normalised(lon, lat, h, offsets, scales)


@compiled
def project(ground, offsets, scales, coefficients, limits, image):
    """Fill `image` ``(N, 2)`` with the projections of `ground` ``(N, 3)`` (lon, lat, h)."""
    work, table = np.zeros((5, BLOCK)), coefficients.copy()
    for first in range(0, len(ground), BLOCK):
        count = min(BLOCK, len(ground) - first)
        _place(ground, first, count, offsets, scales, work)
        for k in range(count):
            x, y, z = work[0, k], work[1, k], work[2, k]
            (u, m), (v, q) = _ratio(table[0], table[1], x, y, z), _ratio(table[2], table[3], x, y, z)
            good = is_within(x, y, z, limits) & is_point(u, v, m, q)
            work[3, k], work[4, k] = u if good else np.nan, v if good else np.nan
        for k in range(count):
            image[first + k, 0] = work[3, k] * scales[3] + offsets[3]
            image[first + k, 1] = work[4, k] * scales[4] + offsets[4]


@inlined
def linearise_rpc(count, offsets, scales, table, limits, work):
    """Fill rows 3 to 10 of `work` ``(11, n)`` with columns, rows, and their partials by lon, lat, h.

    Rows 0 to 2 have `count` normalised places.
    """
    for k in range(count):
        x, y, z = work[0, k], work[1, k], work[2, k]
        (u, m), (v, q) = _ratio(table[0], table[1], x, y, z), _ratio(table[2], table[3], x, y, z)
        good = is_within(x, y, z, limits) & is_point(u, v, m, q)
        u, v = u if good else np.nan, v if good else np.nan
        work[3, k], work[4, k] = u * scales[3] + offsets[3], v * scales[4] + offsets[4]
        x_col, y_col, z_col = _ratio_slopes(table[0], table[1], u, m, x, y, z)
        x_row, y_row, z_row = _ratio_slopes(table[2], table[3], v, q, x, y, z)
        work[5, k], work[8, k] = x_col * scales[3] / scales[0], x_row * scales[4] / scales[0]
        work[6, k], work[9, k] = y_col * scales[3] / scales[1], y_row * scales[4] / scales[1]
        work[7, k], work[10, k] = z_col * scales[3] / scales[2], z_row * scales[4] / scales[2]


@compiled
def projected(ground, offsets, scales, coefficients, limits, image, partials):
    """Fill `image` as `project` does, and `partials` ``(N, 2, 3)`` with its derivatives by the ground."""
    work, table = np.zeros((11, BLOCK)), coefficients.copy()
    for first in range(0, len(ground), BLOCK):
        count = min(BLOCK, len(ground) - first)
        _place(ground, first, count, offsets, scales, work)
        linearise_rpc(count, offsets, scales, table, limits, work)
        for k in range(count):
            for n in range(2):
                image[first + k, n] = work[3 + n, k]
                for axis in range(3):
                    partials[first + k, n, axis] = work[5 + 3 * n + axis, k]


@inlined
def _newton(work, table, col_scale, row_scale, tolerance):
    """Do a Newton step for the points of a block that have not converged; return how many are left."""
    left = 0
    for k in range(BLOCK):
        x, y, z, missed = work[0, k], work[1, k], work[2, k], work[3, k]
        (u, m), (v, q) = _ratio(table[0], table[1], x, y, z), _ratio(table[2], table[3], x, y, z)
        ux, uy, _ = _ratio_slopes(table[0], table[1], u, m, x, y, z)
        vx, vy, _ = _ratio_slopes(table[2], table[3], v, q, x, y, z)
        du, dv, scale = work[4, k] - u, work[5, k] - v, 1.0 / (ux * vy - uy * vx)
        dx, dy = (vy * du - uy * dv) * scale, (ux * dv - vx * du) * scale
        # A step beyond the domain comes from a bad linearisation far from the solution: shorten it.
        longest = max(abs(dx), abs(dy), 1.0)
        due = missed > tolerance
        work[0, k], work[1, k] = x + dx / longest if due else x, y + dy / longest if due else y
        found = np.inf if (m <= 0.0) | (q <= 0.0) else max(abs(du * col_scale), abs(dv * row_scale))
        missed = found if due else missed
        work[3, k] = missed
        left += 1 if missed > tolerance else 0
    return left


@compiled
def image_to_ground(image, heights, offsets, scales, coefficients, limits, tolerance, verified, steps, ground):
    """Fill `ground` ``(N, 3)`` with the points at ellipsoidal `heights` ``(N,)`` whose projections are `image`.

    Newton's method from the middle of the domain, as for any model, with the whole block in each step.
    """
    # Normalised place, its error (px) before the last step, and its target ratios.
    work, table = np.zeros((6, BLOCK)), coefficients.copy()
    for first in range(0, len(image), BLOCK):
        count = min(BLOCK, len(image) - first)
        for k in range(BLOCK):
            # The last block is filled up with converged points.
            work[0, k], work[1, k], work[3, k] = 0.0, 0.0, np.inf if k < count else 0.0
        for k in range(count):
            work[2, k] = (heights[first + k] - offsets[2]) / scales[2]
            work[4, k], work[5, k] = (
                (image[first + k, 0] - offsets[3]) / scales[3],
                (image[first + k, 1] - offsets[4]) / scales[4],
            )
        for _ in range(steps):
            if _newton(work, table, scales[3], scales[4], tolerance) == 0:
                break
        for k in range(count):
            good = (work[3, k] <= verified) & is_within(work[0, k], work[1, k], work[2, k], limits)
            ground[first + k, 0] = work[0, k] * scales[0] + offsets[0] if good else np.nan
            ground[first + k, 1] = work[1, k] * scales[1] + offsets[1] if good else np.nan
            ground[first + k, 2] = heights[first + k] if good else np.nan
