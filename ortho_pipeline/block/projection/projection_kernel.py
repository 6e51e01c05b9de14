"""Compiled projection of a block's rays through RPCs under affine corrections, with all partials in one pass."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.models.rpc_kernel import BLOCK, linearise_rpc, normalised
from ortho_pipeline.runtime.compiled import compiled, inlined

Array = Any


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
def _by_point(images, n, work, k, way, scale, found):
    """Fill `found` ``(2, 3)`` with the partials of the k-th ray by its point."""
    c = images.coefficients[n]
    for along in range(3):
        found[0, along], found[1, along] = 0.0, 0.0
    for axis in range(3):
        # Of the RPC by longitude, latitude or height, then of the correction, then by the frame.
        first, second = work[5 + axis, k] * scale, work[8 + axis, k] * scale
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
    work = np.empty((11, BLOCK))
    point, ground, way = places
    for n in range(begin_image, end_image):
        c, columns, offsets, scales = images.coefficients[n], images.columns[n], images.offsets[n], images.scales[n]
        middle_col, middle_row = images.origins[n, 0], images.origins[n, 1]
        table = images.polynomials[n].copy()
        for begin in range(starts[n], starts[n + 1], BLOCK):
            batch = rays[begin : min(begin + BLOCK, starts[n + 1])]
            for k in range(len(batch)):
                at = ground[point[batch[k]]]
                work[0, k], work[1, k], work[2, k] = normalised(at[0], at[1], at[2], offsets, scales)
            linearise_rpc(len(batch), offsets, scales, table, images.limits[n], work)
            for k in range(len(batch)):
                ray = batch[k]
                of, col, row = scale[ray], work[3, k] - middle_col, work[4, k] - middle_row
                image[ray, 0] = col + middle_col + (c[0] + c[1] * col + c[2] * row)
                image[ray, 1] = row + middle_row + (c[3] + c[4] * col + c[5] * row)
                _by_point(images, n, work, k, way[point[ray]], of, by_point[ray])
                # A shift moves every image point alike, but there has to be one.
                for term, value in enumerate((of + 0.0 * col, of * col, of * row)):
                    if columns[term] >= 0:
                        by_params[ray, 0, columns[term]] = value
                    if columns[3 + term] >= 0:
                        by_params[ray, 1, columns[3 + term]] = value
