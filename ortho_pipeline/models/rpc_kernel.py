"""Compiled evaluation of RPCs for many points; the NumPy form in rational.py is its tested reference.

The 20-term polynomials are evaluated in nested form, numerators and denominators of a point together. Points are taken
in blocks that stay in the first cache, each coordinate in an array of its own and always so many of them: loops without
branches over those become vector instructions, as wide as the processor has them. Products and sums are not contracted
(no FMA), so that a point's result is the same on every processor, in every place of a block and by itself.
"""

from __future__ import annotations

import numpy as np

from ortho_pipeline.files.compiled import compiled, inlined

#: Points of a block: what is kept of them fits into the first cache.
BLOCK = 256
#: Rows of the workspace of inverses: normalised column, row, height; longitude and latitude; the misfit; how it is with
#: a point; the inverse of the Jacobian. One array of known size, so that the compiler sees that no two rows overlap.
_C, _R, _H, _L, _P, _MISS, _STATE, _I00, _I01, _I10, _I11, _ROWS = range(12)
#: How it is with a point: the Jacobian serves, or has to be made anew, or nothing is to be done any more.
_OPEN, _STALE, _CLOSED = 0.0, 1.0, 2.0


@inlined
def _polynomial(a, x, y, z):
    """Value of an RPC00B polynomial with coefficients a at (L, P, H) = (x, y, z)."""
    return (
        a[0]
        + x * (a[1] + x * (a[7] + x * a[11] + y * a[14] + z * a[17]) + y * (a[4] + y * a[12] + z * a[10]))
        + y * (a[2] + y * (a[8] + y * a[15] + z * a[18]) + z * (a[6] + z * a[16]))
        + z * (a[3] + z * (a[9] + z * a[19]) + x * (a[5] + z * a[13]))
    )


@inlined
def _with_slopes(a, x, y, z):
    """Value and its derivatives by L and P."""
    by_x = (
        a[1]
        + x * (2.0 * (a[7] + y * a[14] + z * a[17]) + 3.0 * x * a[11])
        + y * (a[4] + y * a[12] + z * a[10])
        + z * (a[5] + z * a[13])
    )
    by_y = (
        a[2]
        + y * (2.0 * (a[8] + x * a[12] + z * a[18]) + 3.0 * y * a[15])
        + x * (a[4] + x * a[14] + z * a[10])
        + z * (a[6] + z * a[16])
    )
    return _polynomial(a, x, y, z), by_x, by_y


@inlined
def with_all_slopes(a, x, y, z, count, found):
    """Fill `found` ``(4, n)`` with the values of a polynomial at n points, and its derivatives by L, P and H.

    As loops over points without a branch: they take four or eight of them at a time.
    """
    value, by_x, by_y, by_z = found[0], found[1], found[2], found[3]
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9 = a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9]
    a10, a11, a12, a13, a14, a15, a16, a17, a18, a19 = (
        a[10],
        a[11],
        a[12],
        a[13],
        a[14],
        a[15],
        a[16],
        a[17],
        a[18],
        a[19],
    )
    for k in range(count):
        p, q, r = x[k], y[k], z[k]
        pp, qq, rr = p * p, q * q, r * r
        # What squares are multiplied by, and products of two different ones.
        of_pp, of_qq, of_rr = a7 + q * a14 + r * a17, a8 + p * a12 + r * a18, a9 + p * a13 + q * a16
        of_pq = a4 + r * a10
        value[k] = (
            a0 + p * (a1 + q * of_pq + r * a5) + q * (a2 + r * a6) + r * a3
            + pp * (p * a11 + of_pp) + qq * (q * a15 + of_qq) + rr * (r * a19 + of_rr)
        )  # fmt: skip
        by_x[k] = a1 + q * of_pq + r * a5 + 3.0 * pp * a11 + 2.0 * p * of_pp + qq * a12 + rr * a13
        by_y[k] = a2 + p * of_pq + r * a6 + 3.0 * qq * a15 + 2.0 * q * of_qq + pp * a14 + rr * a16
        by_z[k] = a3 + p * (a5 + q * a10) + q * a6 + 3.0 * rr * a19 + 2.0 * r * of_rr + pp * a17 + qq * a18


@compiled
def project(ground, offsets, scales, coefficients, limits, image):
    """Fill `image` ``(N, 2)`` with the projections of `ground` ``(N, 3)`` (lon, lat, h).

    `offsets` and `scales` are of lon, lat, h, column, row; `coefficients` ``(4, 20)`` column numerator and denominator,
    row numerator and denominator, the denominators positive at the centre. The projection is NaN beyond `limits` (of
    normalised longitude and latitude, lowest and highest normalised height), and beyond a pole.
    """
    a, b, c, d = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    limit, lowest, highest = limits[0], limits[1], limits[2]
    inverse = 1.0 / scales
    xs, ys, zs = np.zeros(BLOCK), np.zeros(BLOCK), np.zeros(BLOCK)
    cols, rows = np.empty(BLOCK), np.empty(BLOCK)
    for first in range(0, ground.shape[0], BLOCK):
        count = min(BLOCK, ground.shape[0] - first)
        for k in range(count):
            lon = ground[first + k, 0] - offsets[0]
            turned = lon - 360.0 * np.floor((lon + 180.0) / 360.0)
            xs[k] = (turned if abs(lon) > 180.0 else lon) * inverse[0]
            ys[k] = (ground[first + k, 1] - offsets[1]) * inverse[1]
            zs[k] = (ground[first + k, 2] - offsets[2]) * inverse[2]
        for k in range(BLOCK):
            x, y, z = xs[k], ys[k], zs[k]
            m, q = _polynomial(b, x, y, z), _polynomial(d, x, y, z)
            col = _polynomial(a, x, y, z) / m * scales[3] + offsets[3]
            row = _polynomial(c, x, y, z) / q * scales[4] + offsets[4]
            good = (abs(x) <= limit) & (abs(y) <= limit) & (lowest <= z) & (z <= highest) & (m > 0.0) & (q > 0.0)
            good &= (abs(col) < np.inf) & (abs(row) < np.inf)
            cols[k] = col if good else np.nan
            rows[k] = row if good else np.nan
        for k in range(count):
            image[first + k, 0], image[first + k, 1] = cols[k], rows[k]


@inlined
def _moved(work, k, x, y, du, dv, col_scale, row_scale, tolerance, due):
    """Take a point a step further by the inverse of its Jacobian, if it is due."""
    miss = max(abs(du * col_scale), abs(dv * row_scale))
    dx, dy = work[_I00, k] * du + work[_I01, k] * dv, work[_I10, k] * du + work[_I11, k] * dv
    # A step beyond the domain comes from a bad linearisation far from the solution: go a shorter way.
    longest = max(abs(dx), abs(dy), 1.0)
    # The step that is made takes what is left to a hundredth, down to the rounding of degrees.
    before, state = work[_MISS, k], work[_STATE, k]
    after = (_STALE if miss > 0.01 * before else _OPEN) if miss > tolerance else _CLOSED
    work[_L, k], work[_P, k] = x + dx / longest if due else x, y + dy / longest if due else y
    work[_MISS, k] = miss if due else before
    work[_STATE, k] = after if due else state
    return after if due else state


@inlined
def _newton(work, coefficients, col_scale, row_scale, tolerance):
    """Take the stale points a step further with a new Jacobian; return how many are open, and stale, after it."""
    left, again = 0, 0
    for k in range(BLOCK):
        x, y, z = work[_L, k], work[_P, k], work[_H, k]
        n, nx, ny = _with_slopes(coefficients[0], x, y, z)
        m, mx, my = _with_slopes(coefficients[1], x, y, z)
        p, px, py = _with_slopes(coefficients[2], x, y, z)
        q, qx, qy = _with_slopes(coefficients[3], x, y, z)
        u, v = n / m, p / q
        j00, j01 = (nx - u * mx) / m, (ny - u * my) / m
        j10, j11 = (px - v * qx) / q, (py - v * qy) / q
        scale = 1.0 / (j00 * j11 - j01 * j10)
        stale = work[_STATE, k] == _STALE
        work[_I00, k] = j11 * scale if stale else work[_I00, k]
        work[_I01, k] = -j01 * scale if stale else work[_I01, k]
        work[_I10, k] = -j10 * scale if stale else work[_I10, k]
        work[_I11, k] = j00 * scale if stale else work[_I11, k]
        state = _moved(work, k, x, y, work[_C, k] - u, work[_R, k] - v, col_scale, row_scale, tolerance, stale)
        left += 1 if state == _OPEN else 0
        again += 1 if state == _STALE else 0
    return left, again


@inlined
def _chord(work, coefficients, col_scale, row_scale, tolerance):
    """Take the open points a step further with the Jacobian that they have; return the same."""
    left, again = 0, 0
    for k in range(BLOCK):
        x, y, z = work[_L, k], work[_P, k], work[_H, k]
        u = _polynomial(coefficients[0], x, y, z) / _polynomial(coefficients[1], x, y, z)
        v = _polynomial(coefficients[2], x, y, z) / _polynomial(coefficients[3], x, y, z)
        due = work[_STATE, k] == _OPEN
        state = _moved(work, k, x, y, work[_C, k] - u, work[_R, k] - v, col_scale, row_scale, tolerance, due)
        left += 1 if state == _OPEN else 0
        again += 1 if state == _STALE else 0
    return left, again


@inlined
def _judge(work, coefficients, limits, verified):
    """Open again the points that have not closed within the domain, before a pole."""
    limit, lowest, highest = limits[0], limits[1], limits[2]
    for k in range(BLOCK):
        x, y, z = work[_L, k], work[_P, k], work[_H, k]
        good = (work[_MISS, k] <= verified) & (abs(x) <= limit) & (abs(y) <= limit) & (lowest <= z) & (z <= highest)
        m, q = _polynomial(coefficients[1], x, y, z), _polynomial(coefficients[3], x, y, z)
        work[_STATE, k] = _CLOSED if good & (m > 0.0) & (q > 0.0) else _OPEN


@compiled
def image_to_ground(image, heights, offsets, scales, coefficients, start, limits, tolerance, verified, steps, ground):
    """Fill `ground` ``(N, 3)`` with the points at ellipsoidal `heights` ``(N,)`` whose projections are `image`.

    `start` ``(2, 6)`` gives first longitudes and latitudes (normalised) as polynomials 1, c, r, z, cz, rz of normalised
    column, row and height. Then Newton's method with the Jacobian of the first step, renewed when a step does not
    shrink the misfit to a hundredth.
    """
    work, table = np.zeros((_ROWS, BLOCK)), np.empty((4, 20))
    for k in range(4):
        for n in range(20):
            table[k, n] = coefficients[k, n]
    for first in range(0, image.shape[0], BLOCK):
        count = min(BLOCK, image.shape[0] - first)
        for k in range(count):
            col = (image[first + k, 0] - offsets[3]) / scales[3]
            row = (image[first + k, 1] - offsets[4]) / scales[4]
            z = (heights[first + k] - offsets[2]) / scales[2]
            work[_C, k], work[_R, k], work[_H, k] = col, row, z
            work[_L, k] = (
                start[0, 0]
                + start[0, 1] * col
                + start[0, 2] * row
                + z * (start[0, 3] + start[0, 4] * col + start[0, 5] * row)
            )
            work[_P, k] = (
                start[1, 0]
                + start[1, 1] * col
                + start[1, 2] * row
                + z * (start[1, 3] + start[1, 4] * col + start[1, 5] * row)
            )
            work[_MISS, k], work[_STATE, k] = np.inf, _STALE
        for k in range(count, BLOCK):
            work[_STATE, k] = _CLOSED
        left, stale = 0, 1
        for _ in range(steps):
            if stale:
                left, stale = _newton(work, table, scales[3], scales[4], tolerance)
            if left:
                left, stale = _chord(work, table, scales[3], scales[4], tolerance)
            if left + stale == 0:
                break
        _judge(work, table, limits, verified)
        for k in range(count):
            good = work[_STATE, k] == _CLOSED
            ground[first + k, 0] = work[_L, k] * scales[0] + offsets[0] if good else np.nan
            ground[first + k, 1] = work[_P, k] * scales[1] + offsets[1] if good else np.nan
            ground[first + k, 2] = heights[first + k] if good else np.nan
