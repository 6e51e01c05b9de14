"""Compiled elimination of the points of blocks, one after the other, and the chain rule of their rays.

Rays stand point by point: those of the t-th point are ``order[starts[t]:starts[t + 1]]``, by image. Nothing that is
made of a point is kept: factoring its few rows again takes less than reading them back. Points that the same images
show follow each other, so that what is added up by pairs of images is so in a small matrix of these images first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.runtime.compiled import compiled, inlined

Array = Any


class Rows(NamedTuple):
    """Equations of a block, and the order in which its n points are eliminated.

    `image` ``(M,)`` are the images of the rays, `slot` ``(images, images)`` numbers of their pairs, `numbers` ``(n,)``
    the points, `grounded` ``(n,)`` whether their known ground weighs in. Misfits are those of the rays ``(M, 2)`` and
    of the ground ``(N, 3)``, partials `by_params` ``(M, 2, p)``, `by_point` ``(M, 2, 3)``, `by_ground` ``(N, 3, 3)``.
    """

    order: Array
    starts: Array
    numbers: Array
    grounded: Array
    image: Array
    slot: Array
    by_params: Array
    by_point: Array
    by_ground: Array
    misfits: Array
    of_ground: Array


class FactoredPoint(NamedTuple):
    """The rows of one point, factored: B = Q R, with `q` ``(3, rows)``, and `turned` ``(3, k p)``, which is Q' A.

    What has a column for each parameter of the images of a point has some more, which are zero, so that loops over them
    take whole registers. They begin at the first column for the same reason: others are not unrolled.
    """

    q: Array
    r: Array
    turned: Array


@inlined
def _padded(columns):
    """Return the next multiple of eight."""
    return (columns + 7) // 8 * 8


@inlined
def _room(rows, begin, end):
    """Return room for any point between two, the most rays that one has, and the most columns."""
    most = 0
    for t in range(begin, end):
        most = max(most, rows.starts[t + 1] - rows.starts[t])
    wide = _padded(most * rows.by_params.shape[2])
    return FactoredPoint(np.empty((3, 2 * most + 3)), np.empty((3, 3)), np.empty((3, wide))), most, wide


@inlined
def _factored(rows, t, point):
    """Factor the rows of the t-th point by Gram and Schmidt, each column made orthogonal twice; return their number."""
    q, r = point.q, point.r
    size = 0
    for a in range(rows.starts[t], rows.starts[t + 1]):
        ray = rows.order[a]
        for c in range(3):
            q[c, size] = rows.by_point[ray, 0, c]
            q[c, size + 1] = rows.by_point[ray, 1, c]
        size += 2
    if rows.grounded[t]:
        for row in range(3):
            for c in range(3):
                q[c, size + row] = rows.by_ground[rows.numbers[t], row, c]
        size += 3
    for c in range(3):
        for d in range(3):
            r[c, d] = 0.0
        for _ in range(2):
            for d in range(c):
                along = 0.0
                for row in range(size):
                    along += q[d, row] * q[c, row]
                for row in range(size):
                    q[c, row] -= along * q[d, row]
                r[d, c] += along
        square = 0.0
        for row in range(size):
            square += q[c, row] * q[c, row]
        r[c, c] = np.sqrt(square)
        scale = 1.0 / r[c, c] if square > 0.0 else 0.0
        for row in range(size):
            q[c, row] *= scale
    return size


@inlined
def _turned(rows, t, point):
    """Fill Q' A of the t-th point; return its number of columns, padded."""
    wide, begin = rows.by_params.shape[2], rows.starts[t]
    k = 0
    for a in range(rows.starts[t + 1] - begin):
        of_col, of_row = rows.by_params[rows.order[begin + a], 0], rows.by_params[rows.order[begin + a], 1]
        q, row = point.q, 2 * a
        for u in range(wide):
            first, second = of_col[u], of_row[u]
            point.turned[0, k] = q[0, row] * first + q[0, row + 1] * second
            point.turned[1, k] = q[1, row] * first + q[1, row + 1] * second
            point.turned[2, k] = q[2, row] * first + q[2, row + 1] * second
            k += 1
    for more in range(k, _padded(k)):
        point.turned[0, more], point.turned[1, more], point.turned[2, more] = 0.0, 0.0, 0.0
    return _padded(k)


@inlined
def _as_before(rows, t):
    """Return whether the t-th point is shown by the same images as the one before it."""
    here, count = rows.starts[t], rows.starts[t + 1] - rows.starts[t]
    before = here - count
    if before != rows.starts[t - 1]:
        return False
    same = True
    for a in range(count):
        same = same and rows.image[rows.order[here + a]] == rows.image[rows.order[before + a]]
    return same


@inlined
def _add_point(rows, t, size, point, sums, squares, right):
    """Add the equations of the parameters that the t-th point leaves to those of its k images.

    These are `squares` ``(k, p, p)``, A' A of each image, `sums` ``(k p, k p)``, which is to be taken off, and `right`
    ``(k p,)``.
    """
    wide, begin = rows.by_params.shape[2], rows.starts[t]
    count = rows.starts[t + 1] - begin
    q, east, north, up = point.q, point.turned[0], point.turned[1], point.turned[2]
    x, y, z = 0.0, 0.0, 0.0
    for row in range(size):
        if row < 2 * count:
            misfit = rows.misfits[rows.order[begin + row // 2], row % 2]
        else:
            misfit = rows.of_ground[rows.numbers[t], row - 2 * count]
        x, y, z = x + q[0, row] * misfit, y + q[1, row] * misfit, z + q[2, row] * misfit
    for a in range(count):
        ray = rows.order[begin + a]
        by_col, by_row = rows.by_params[ray, 0], rows.by_params[ray, 1]
        for u in range(wide):
            own, first, second, i = squares[a, u], by_col[u], by_row[u], a * wide + u
            right[i] += first * rows.misfits[ray, 0] + second * rows.misfits[ray, 1]
            right[i] -= east[i] * x + north[i] * y + up[i] * z
            for v in range(wide):
                own[v] += first * by_col[v] + second * by_row[v]
    columns = _padded(count * wide)
    for i in range(count * wide):
        row, first, second, third = sums[i], east[i], north[i], up[i]
        for k in range(columns):
            row[k] += first * east[k] + second * north[k] + third * up[k]


@compiled
def reduce(rows, begin, end, blocks, right):
    """Add the normal equations of the parameters, points `begin` to `end` eliminated.

    They go to blocks ``(S, p, p)`` of pairs of images, and to the right side ``(images, p)``.
    """
    wide = rows.by_params.shape[2]
    point, most, columns = _room(rows, begin, end)
    sums, squares, side = np.empty((columns, columns)), np.empty((most, wide, wide)), np.empty(columns)
    for t in range(begin, end):
        first = rows.starts[t]
        count = rows.starts[t + 1] - first
        if t == begin or not _as_before(rows, t):
            sums[: count * wide, : _padded(count * wide)] = 0.0
            squares[:count], side[: count * wide] = 0.0, 0.0
        size = _factored(rows, t, point)
        _turned(rows, t, point)
        _add_point(rows, t, size, point, sums, squares, side)
        if t + 1 < end and _as_before(rows, t + 1):
            continue
        for a in range(count):
            i = rows.image[rows.order[first + a]]
            for u in range(wide):
                right[i, u] += side[a * wide + u]
                for v in range(wide):
                    blocks[rows.slot[i, i], u, v] += squares[a, u, v]
            for b in range(a, count):
                pair = rows.slot[i, rows.image[rows.order[first + b]]]
                for u in range(wide):
                    for v in range(wide):
                        blocks[pair, u, v] -= sums[a * wide + u, b * wide + v]


@compiled
def shifts(rows, begin, end, step, shift, of_rays, of_ground):
    """Fill what goes with a step ``(images, p)`` of the parameters, of points `begin` to `end`.

    Those are `shift` ``(N, 3)``, the steps of the points, and what both take off the misfits of rays ``(M, 2)`` and
    ground ``(N, 3)``, to first order.
    """
    wide = rows.by_params.shape[2]
    point, _, _ = _room(rows, begin, end)
    for t in range(begin, end):
        size, number = _factored(rows, t, point), rows.numbers[t]
        x, y, z = 0.0, 0.0, 0.0
        place = 0
        for a in range(rows.starts[t], rows.starts[t + 1]):
            ray = rows.order[a]
            own = step[rows.image[ray]]
            for side in range(2):
                taken = 0.0
                for u in range(wide):
                    taken += rows.by_params[ray, side, u] * own[u]
                of_rays[ray, side] = taken
                left = rows.misfits[ray, side] - taken
                x, y, z = x + point.q[0, place] * left, y + point.q[1, place] * left, z + point.q[2, place] * left
                place += 1
        for row in range(place, size):
            left = rows.of_ground[number, row - place]
            x, y, z = x + point.q[0, row] * left, y + point.q[1, row] * left, z + point.q[2, row] * left
        z = z / point.r[2, 2]
        y = (y - point.r[1, 2] * z) / point.r[1, 1]
        x = (x - point.r[0, 1] * y - point.r[0, 2] * z) / point.r[0, 0]
        shift[number, 0], shift[number, 1], shift[number, 2] = x, y, z
        for a in range(rows.starts[t], rows.starts[t + 1]):
            for side in range(2):
                by = rows.by_point[rows.order[a], side]
                of_rays[rows.order[a], side] += by[0] * x + by[1] * y + by[2] * z
        for row in range(size - place):
            by = rows.by_ground[number, row]
            of_ground[number, row] = by[0] * x + by[1] * y + by[2] * z


@inlined
def _gathered(rows, t, blocks, whole):
    """Fill `whole` ``(k p, k p)`` with those of `blocks` ``(S, p, p)`` that the images of the t-th point have."""
    wide, begin = rows.by_params.shape[2], rows.starts[t]
    count = rows.starts[t + 1] - begin
    for a in range(count):
        for b in range(a, count):
            pair = rows.slot[rows.image[rows.order[begin + a]], rows.image[rows.order[begin + b]]]
            for u in range(wide):
                for v in range(wide):
                    whole[a * wide + u, b * wide + v] = blocks[pair, u, v]
                    whole[b * wide + v, a * wide + u] = blocks[pair, u, v]
    for i in range(count * wide):
        for k in range(count * wide, _padded(count * wide)):
            whole[i, k] = 0.0


@inlined
def _spread(rows, t, fresh, blocks, point, whole, product, inner):
    """Factor the t-th point; fill `product` ``(3, k p)`` with Q' A C and `inner` ``(3, 3)`` with Q' A C A' Q.

    C are `blocks` ``(S, p, p)``, whose part for the images of the point is made anew in `whole` if they are `fresh`.
    Returns the number of rows.
    """
    if fresh:
        _gathered(rows, t, blocks, whole)
    size = _factored(rows, t, point)
    columns, turned = _turned(rows, t, point), point.turned
    east, north, up = product[0], product[1], product[2]
    for k in range(columns):
        east[k], north[k], up[k] = 0.0, 0.0, 0.0
    for i in range((rows.starts[t + 1] - rows.starts[t]) * rows.by_params.shape[2]):
        first, second, third, row = turned[0, i], turned[1, i], turned[2, i], whole[i]
        for k in range(columns):
            east[k] += first * row[k]
            north[k] += second * row[k]
            up[k] += third * row[k]
    for c in range(3):
        for d in range(3):
            inner[c, d] = 0.0
        for k in range(columns):
            value = turned[c, k]
            inner[c, 0], inner[c, 1], inner[c, 2] = (
                inner[c, 0] + value * east[k],
                inner[c, 1] + value * north[k],
                inner[c, 2] + value * up[k],
            )
    return size


@inlined
def _hat(rows, ray, place, point, whole, product, core, own, found):
    """Fill the hat matrix ``(2, 2)`` of a ray, the `place`-th of its point; `core` is Q' A C A' Q plus the unit matrix.

    With P = Q' A C it is Q Q' + F C F' = A C A' - A P' Q' - Q P A' + Q core Q', of the rows of the ray.
    """
    by, wide = rows.by_params[ray], rows.by_params.shape[2]
    begin = place * wide
    for i in range(2):
        row = 2 * place + i
        x, y, z = point.q[0, row], point.q[1, row], point.q[2, row]
        # Of Q core - A P', which the columns Q' of the other row take.
        along = x * core[0, 0] + y * core[1, 0] + z * core[2, 0]
        across = x * core[0, 1] + y * core[1, 1] + z * core[2, 1]
        up = x * core[0, 2] + y * core[1, 2] + z * core[2, 2]
        for u in range(wide):
            along -= by[i, u] * product[0, begin + u]
            across -= by[i, u] * product[1, begin + u]
            up -= by[i, u] * product[2, begin + u]
        # Of A C - Q P, which A' of the other row takes.
        for v in range(wide):
            own[v] = -(x * product[0, begin + v] + y * product[1, begin + v] + z * product[2, begin + v])
        for u in range(wide):
            value, row = by[i, u], whole[begin + u, begin : begin + wide]
            for v in range(wide):
                own[v] += value * row[v]
        for j in range(2):
            other = 2 * place + j
            value = along * point.q[0, other] + across * point.q[1, other] + up * point.q[2, other]
            for v in range(wide):
                value += own[v] * by[j, v]
            found[ray, i, j] = value


@compiled
def hats(rows, begin, end, blocks, of_rays, of_ground):
    """Fill the parts of the hat matrix of rays ``(M, 2, 2)`` and known ground ``(N, 3, 3)``, C being `blocks`."""
    point, _, columns = _room(rows, begin, end)
    whole, product, core = np.empty((columns, columns)), np.empty((3, columns)), np.empty((3, 3))
    own = np.empty(rows.by_params.shape[2])
    for t in range(begin, end):
        size = _spread(rows, t, t == begin or not _as_before(rows, t), blocks, point, whole, product, core)
        for c in range(3):
            core[c, c] += 1.0
        place = 0
        for a in range(rows.starts[t], rows.starts[t + 1]):
            _hat(rows, rows.order[a], place, point, whole, product, core, own, of_rays)
            place += 1
        for i in range(size - 2 * place):
            for j in range(3):
                value = 0.0
                for c in range(3):
                    for d in range(3):
                        value += point.q[c, 2 * place + i] * core[c, d] * point.q[d, 2 * place + j]
                of_ground[rows.numbers[t], i, j] = value


@compiled
def ground(rows, begin, end, blocks, factor, found):
    """Fill `found` ``(N, 3, 3)`` with the covariances of the points, in the frame, C being `blocks`."""
    point, _, columns = _room(rows, begin, end)
    whole, product, inner = np.empty((columns, columns)), np.empty((3, columns)), np.empty((3, 3))
    root, r = np.zeros((3, 3)), point.r
    for t in range(begin, end):
        _spread(rows, t, t == begin or not _as_before(rows, t), blocks, point, whole, product, inner)
        for c in range(3):
            inner[c, c] += factor
            root[c, c] = 1.0 / r[c, c]
        root[0, 1] = -r[0, 1] * root[0, 0] * root[1, 1]
        root[1, 2] = -r[1, 2] * root[1, 1] * root[2, 2]
        root[0, 2] = -(r[0, 1] * root[1, 2] + r[0, 2] * root[2, 2]) * root[0, 0]
        for i in range(3):
            for j in range(3):
                value = 0.0
                for c in range(i, 3):
                    for d in range(j, 3):
                        value += root[i, c] * inner[c, d] * root[j, d]
                found[rows.numbers[t], i, j] = value


@compiled
def slopes(ground, lengths, turn, found):
    """Fill `found` ``(N, 3, 3)`` with d(lon, lat, h)/d(frame) of points lon, lat (degrees), h.

    `lengths` ``(N, 2)`` are those of a degree, `turn` ``(3, 3)`` leads from ECEF to the frame.
    """
    axes = np.empty((3, 3))
    for k in range(ground.shape[0]):
        lon, lat = np.radians(ground[k, 0]), np.radians(ground[k, 1])
        sin_lon, cos_lon, sin_lat, cos_lat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
        axes[0, 0], axes[0, 1], axes[0, 2] = -sin_lon, cos_lon, 0.0
        axes[1, 0], axes[1, 1], axes[1, 2] = -sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat
        axes[2, 0], axes[2, 1], axes[2, 2] = cos_lat * cos_lon, cos_lat * sin_lon, sin_lat
        for row in range(3):
            scale = 1.0 / lengths[k, row] if row < 2 else 1.0
            for along in range(3):
                value = axes[row, 0] * turn[along, 0] + axes[row, 1] * turn[along, 1] + axes[row, 2] * turn[along, 2]
                found[k, row, along] = value * scale


@compiled
def squares(used, hats, misfits, testable, found, rank):
    """Fill squared standardised residuals `found` ``(M,)`` of rays, and their degrees of freedom `rank` ``(M,)``.

    Of those `used`, with hat matrices ``(M, 2, 2)`` and misfits ``(M, 2)``, along the axes of their redundancy, where
    this is more than `testable`. Others stay as they are.
    """
    for k in range(len(used)):
        ray = used[k]
        a, b, c = 1.0 - hats[ray, 0, 0], -hats[ray, 1, 0], 1.0 - hats[ray, 1, 1]
        half, spread = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
        # Twice the angle of the first axis, by the sum or the difference that loses no digits.
        along = 0.5 * (a - c)
        x, y = (along + spread, b) if along >= 0.0 else (b, spread - along)
        length = np.hypot(x, y)
        cos, sin = (x / length, y / length) if length > 0.0 else (1.0, 0.0)
        first = cos * misfits[ray, 0] + sin * misfits[ray, 1]
        second = cos * misfits[ray, 1] - sin * misfits[ray, 0]
        square, free = 0.0, 0
        if half + spread > testable:
            square, free = square + first * first / (half + spread), free + 1
        if half - spread > testable:
            square, free = square + second * second / (half - spread), free + 1
        found[ray], rank[ray] = square, free


@compiled
def chained(by_ground, way, rows):
    """Return d(image)/d(frame) ``(n, 2, 3)`` of d(image)/d(ground) ``(n, 2, 3)`` and `way` ``(N, 3, 3)`` of `rows`."""
    found = np.empty(by_ground.shape)
    for k in range(by_ground.shape[0]):
        at = way[rows[k]]
        for side in range(2):
            x, y, h = by_ground[k, side, 0], by_ground[k, side, 1], by_ground[k, side, 2]
            for axis in range(3):
                found[k, side, axis] = x * at[0, axis] + y * at[1, axis] + h * at[2, axis]
    return found
