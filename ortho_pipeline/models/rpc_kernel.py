"""Compiled evaluation of RPCs for many points; the NumPy form in rational.py is its tested reference.

The 20-term polynomials are evaluated in nested form, numerators and denominators of a point together, so that one pass
over the points does it all without temporary arrays.
"""

from __future__ import annotations

import numpy as np

from ortho_pipeline.files.compiled import compiled, inlined


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
    for k in range(ground.shape[0]):
        lon = ground[k, 0] - offsets[0]
        if lon > 180.0 or lon < -180.0:
            lon -= 360.0 * np.floor((lon + 180.0) / 360.0)
        x = lon * inverse[0]
        y = (ground[k, 1] - offsets[1]) * inverse[1]
        z = (ground[k, 2] - offsets[2]) * inverse[2]
        m, q = _polynomial(b, x, y, z), _polynomial(d, x, y, z)
        col = _polynomial(a, x, y, z) / m * scales[3] + offsets[3]
        row = _polynomial(c, x, y, z) / q * scales[4] + offsets[4]
        good = abs(x) <= limit and abs(y) <= limit and lowest <= z <= highest and m > 0.0 and q > 0.0
        good = good and abs(col) < np.inf and abs(row) < np.inf
        image[k, 0] = col if good else np.nan
        image[k, 1] = row if good else np.nan


@compiled
def image_to_ground(image, heights, offsets, scales, coefficients, start, limits, tolerance, verified, steps, ground):
    """Fill `ground` ``(N, 3)`` with the points at ellipsoidal `heights` ``(N,)`` whose projections are `image`.

    `start` ``(2, 6)`` gives first longitudes and latitudes (normalised) as polynomials 1, c, r, z, cz, rz of normalised
    column, row and height. Then Newton's method with the Jacobian of the first step, renewed when a step does not
    shrink the misfit to a hundredth.
    """
    a, b, c, d = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    limit, lowest, highest = limits[0], limits[1], limits[2]
    for k in range(image.shape[0]):
        col = (image[k, 0] - offsets[3]) / scales[3]
        row = (image[k, 1] - offsets[4]) / scales[4]
        z = (heights[k] - offsets[2]) / scales[2]
        x = (
            start[0, 0]
            + start[0, 1] * col
            + start[0, 2] * row
            + z * (start[0, 3] + start[0, 4] * col + start[0, 5] * row)
        )
        y = (
            start[1, 0]
            + start[1, 1] * col
            + start[1, 2] * row
            + z * (start[1, 3] + start[1, 4] * col + start[1, 5] * row)
        )
        stale, before, miss = True, np.inf, np.inf
        i00, i01, i10, i11 = 0.0, 0.0, 0.0, 0.0
        for _ in range(steps):
            if stale:
                n, nx, ny = _with_slopes(a, x, y, z)
                m, mx, my = _with_slopes(b, x, y, z)
                p, px, py = _with_slopes(c, x, y, z)
                q, qx, qy = _with_slopes(d, x, y, z)
                u, v = n / m, p / q
                j00, j01 = (nx - u * mx) / m, (ny - u * my) / m
                j10, j11 = (px - v * qx) / q, (py - v * qy) / q
                scale = 1.0 / (j00 * j11 - j01 * j10)
                i00, i01, i10, i11 = j11 * scale, -j01 * scale, -j10 * scale, j00 * scale
            else:
                u = _polynomial(a, x, y, z) / _polynomial(b, x, y, z)
                v = _polynomial(c, x, y, z) / _polynomial(d, x, y, z)
            du, dv = col - u, row - v
            miss = max(abs(du * scales[3]), abs(dv * scales[4]))
            stale = miss > 0.01 * before
            before = miss
            dx, dy = i00 * du + i01 * dv, i10 * du + i11 * dv
            # A step beyond the domain comes from a bad linearisation far from the solution: go a shorter way.
            longest = max(abs(dx), abs(dy), 1.0)
            x, y = x + dx / longest, y + dy / longest
            # The step that was just made takes what is left to a hundredth, down to the rounding of degrees.
            if not miss > tolerance:
                break
        good = miss <= verified and abs(x) <= limit and abs(y) <= limit and lowest <= z <= highest
        good = good and _polynomial(b, x, y, z) > 0.0 and _polynomial(d, x, y, z) > 0.0
        ground[k, 0] = x * scales[0] + offsets[0] if good else np.nan
        ground[k, 1] = y * scales[1] + offsets[1] if good else np.nan
        ground[k, 2] = heights[k] if good else np.nan
