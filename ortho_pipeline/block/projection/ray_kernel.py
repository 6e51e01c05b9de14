"""Compiled projection of a block's rays through RPCs under affine corrections, with all partials in one pass."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.files.compiled import compiled, inlined
from ortho_pipeline.models.rpc_kernel import with_all_slopes

Array = Any
#: Rays that are looked at side by side.
_BATCH = 128


class Images(NamedTuple):
    """RPCs of n images as `rpc_kernel` takes them, with what moves their image points.

    `origins` ``(n, 2)`` and `coefficients` ``(n, 6)`` are those of an `ImageCorrection`, `columns` ``(n, 6)`` the
    places of the latter among the parameters of their image, -1 for those that are none.
    """

    offsets: Array
    scales: Array
    polynomials: Array
    limits: Array
    origins: Array
    coefficients: Array
    columns: Array


@inlined
def _normalised(images, n, rays, point, ground, place):
    """Fill `place` ``(3, k)`` with the normalised coordinates of the points of k rays of the n-th image."""
    offsets, scales = images.offsets[n], images.scales[n]
    for k in range(len(rays)):
        at = ground[point[rays[k]]]
        lon = at[0] - offsets[0]
        if lon > 180.0 or lon < -180.0:
            lon -= 360.0 * np.floor((lon + 180.0) / 360.0)
        place[0, k], place[1, k] = lon / scales[0], (at[1] - offsets[1]) / scales[1]
        place[2, k] = (at[2] - offsets[2]) / scales[2]


@inlined
def _ratios(images, n, place, sums, k):
    """Return the image point of the k-th ray of a batch by the RPC, not yet in pixels; NaN where it leads out of it."""
    x, y, z = place[0, k], place[1, k], place[2, k]
    m, q, limits = sums[1, 0, k], sums[3, 0, k], images.limits[n]
    u, v = sums[0, 0, k] / m, sums[2, 0, k] / q
    good = abs(x) <= limits[0] and abs(y) <= limits[0] and limits[1] <= z <= limits[2] and m > 0.0 and q > 0.0
    good = good and abs(u) < np.inf and abs(v) < np.inf
    return u if good else np.nan, v if good else np.nan


@inlined
def _by_point(images, n, u, v, sums, k, way, scale, found):
    """Fill `found` ``(2, 3)`` with the partials of the k-th ray by its point."""
    scales, c = images.scales[n], images.coefficients[n]
    by_col, by_row = scale * scales[3] / sums[1, 0, k], scale * scales[4] / sums[3, 0, k]
    for along in range(3):
        found[0, along], found[1, along] = 0.0, 0.0
    for axis in range(3):
        # Of the RPC by longitude, latitude or height, then of the correction, then by the frame.
        first = (sums[0, 1 + axis, k] - u * sums[1, 1 + axis, k]) * by_col / scales[axis]
        second = (sums[2, 1 + axis, k] - v * sums[3, 1 + axis, k]) * by_row / scales[axis]
        col = first + (c[1] * first + c[2] * second)
        row = second + (c[4] * first + c[5] * second)
        for along in range(3):
            found[0, along] += col * way[axis, along]
            found[1, along] += row * way[axis, along]


@compiled
def linearise(images, begin_image, end_image, starts, rays, places, scale, image, by_point, by_params):
    """Fill image points ``(M, 2)``, their partials by points ``(M, 2, 3)`` and by parameters ``(M, 2, p)``.

    Of images `begin_image` to `end_image` alone; the n-th has the `rays` between ``starts[n]`` and ``starts[n + 1]``.
    `places` are the points of the rays ``(M,)`` among N, their lon, lat, h ``(N, 3)``, and d(lon, lat, h)/d(frame)
    ``(N, 3, 3)``. Partials are multiplied with `scale`
    ``(M,)``, those by parameters set only where there are any. A ray is NaN where it leads out of its RPC.
    """
    place, sums = np.empty((3, _BATCH)), np.empty((4, 4, _BATCH))
    point, ground, way = places
    for n in range(begin_image, end_image):
        c, columns = images.coefficients[n], images.columns[n]
        middle_col, middle_row = images.origins[n, 0], images.origins[n, 1]
        for begin in range(starts[n], starts[n + 1], _BATCH):
            batch = rays[begin : min(begin + _BATCH, starts[n + 1])]
            _normalised(images, n, batch, point, ground, place)
            for part in range(4):
                with_all_slopes(images.polynomials[n, part], place[0], place[1], place[2], len(batch), sums[part])
            for k in range(len(batch)):
                ray = batch[k]
                of, (u, v) = scale[ray], _ratios(images, n, place, sums, k)
                col = u * images.scales[n, 3] + images.offsets[n, 3] - middle_col
                row = v * images.scales[n, 4] + images.offsets[n, 4] - middle_row
                image[ray, 0] = col + middle_col + (c[0] + c[1] * col + c[2] * row)
                image[ray, 1] = row + middle_row + (c[3] + c[4] * col + c[5] * row)
                _by_point(images, n, u, v, sums, k, way[point[ray]], of, by_point[ray])
                # A shift moves every image point alike, but there has to be one.
                for term, value in enumerate((of + 0.0 * col, of * col, of * row)):
                    if columns[term] >= 0:
                        by_params[ray, 0, columns[term]] = value
                    if columns[3 + term] >= 0:
                        by_params[ray, 1, columns[3 + term]] = value
