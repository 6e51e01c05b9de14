"""Compiled elimination of the points of blocks, one after the other, and the chain rule of their rays.

Rays stand point by point: those of the t-th point are ``order[starts[t]:starts[t + 1]]``, by image. Nothing that is
made of a point is kept: factoring its few rows again takes less than reading them back.
"""

from __future__ import annotations

import numpy as np

from ortho_pipeline.files.compiled import compiled, inlined


@inlined
def _factored(rays, count, grounded, by_point, by_ground, q, r):
    """Factor the rows of a point, B = Q R, by Gram and Schmidt, each column made orthogonal twice; return their number.

    `rays` are the `count` rays, `by_ground` ``(3, 3)`` the partials of known ground, which weighs in if `grounded`.
    """
    size = 2 * count
    for a in range(count):
        for c in range(3):
            q[2 * a, c] = by_point[rays[a], 0, c]
            q[2 * a + 1, c] = by_point[rays[a], 1, c]
    if grounded:
        for row in range(3):
            for c in range(3):
                q[size + row, c] = by_ground[row, c]
        size += 3
    for c in range(3):
        for d in range(3):
            r[c, d] = 0.0
        for _ in range(2):
            for d in range(c):
                along = 0.0
                for row in range(size):
                    along += q[row, d] * q[row, c]
                for row in range(size):
                    q[row, c] -= along * q[row, d]
                r[d, c] += along
        square = 0.0
        for row in range(size):
            square += q[row, c] * q[row, c]
        r[c, c] = np.sqrt(square)
        scale = 1.0 / r[c, c] if square > 0.0 else 0.0
        for row in range(size):
            q[row, c] *= scale
    return size


@inlined
def _turned(rays, count, by_params, q, turned):
    """Fill `turned` ``(3, k p)`` with Q' A."""
    wide = by_params.shape[2]
    for a in range(count):
        for c in range(3):
            first, second = q[2 * a, c], q[2 * a + 1, c]
            for u in range(wide):
                turned[c, a * wide + u] = first * by_params[rays[a], 0, u] + second * by_params[rays[a], 1, u]


@compiled
def reduce(order, starts, numbers, grounded, image, slot, by_params, by_point, by_ground, misfits, of_ground, parts):
    """Add the normal equations of the parameters, the points eliminated, to blocks and right side.

    `numbers` ``(n,)`` are the points, `grounded` ``(n,)`` whether their known ground weighs in; `misfits` ``(M, 2)``
    are those of the rays and `of_ground` ``(N, 3)`` of the ground; `parts` are the blocks ``(S, p, p)`` of the pairs of
    images, by `slot` ``(images, images)``, and the right side ``(images, p)``.
    """
    blocks, right = parts
    wide, most = by_params.shape[2], 0
    for t in range(len(numbers)):
        most = max(most, starts[t + 1] - starts[t])
    q, r, turned, met = np.empty((2 * most + 3, 3)), np.empty((3, 3)), np.empty((3, most * wide)), np.empty(3)
    for t in range(len(numbers)):
        rays, count = order[starts[t] : starts[t + 1]], starts[t + 1] - starts[t]
        _factored(rays, count, grounded[t], by_point, by_ground[numbers[t]], q, r)
        _turned(rays, count, by_params, q, turned)
        for c in range(3):
            met[c] = 0.0
            for a in range(count):
                met[c] += q[2 * a, c] * misfits[rays[a], 0] + q[2 * a + 1, c] * misfits[rays[a], 1]
            if grounded[t]:
                for row in range(3):
                    met[c] += q[2 * count + row, c] * of_ground[numbers[t], row]
        for a in range(count):
            ray, i = rays[a], image[rays[a]]
            own = slot[i, i]
            for u in range(wide):
                first, second = by_params[ray, 0, u], by_params[ray, 1, u]
                right[i, u] += first * misfits[ray, 0] + second * misfits[ray, 1]
                for c in range(3):
                    right[i, u] -= turned[c, a * wide + u] * met[c]
                for v in range(wide):
                    blocks[own, u, v] += first * by_params[ray, 0, v] + second * by_params[ray, 1, v]
            for b in range(a, count):
                pair = slot[i, image[rays[b]]]
                for u in range(wide):
                    x, y, z = turned[0, a * wide + u], turned[1, a * wide + u], turned[2, a * wide + u]
                    for v in range(wide):
                        k = b * wide + v
                        blocks[pair, u, v] -= x * turned[0, k] + y * turned[1, k] + z * turned[2, k]


@compiled
def shifts(order, starts, numbers, grounded, image, step, by_params, by_point, by_ground, misfits, of_ground, shift):
    """Fill `shift` ``(N, 3)`` with the steps of the points that go with a step ``(images, p)`` of the parameters."""
    wide, most = by_params.shape[2], 0
    for t in range(len(numbers)):
        most = max(most, starts[t + 1] - starts[t])
    q, r = np.empty((2 * most + 3, 3)), np.empty((3, 3))
    for t in range(len(numbers)):
        rays, count = order[starts[t] : starts[t + 1]], starts[t + 1] - starts[t]
        _factored(rays, count, grounded[t], by_point, by_ground[numbers[t]], q, r)
        x, y, z = 0.0, 0.0, 0.0
        for a in range(count):
            for side in range(2):
                left = misfits[rays[a], side]
                for u in range(wide):
                    left -= by_params[rays[a], side, u] * step[image[rays[a]], u]
                row = 2 * a + side
                x, y, z = x + q[row, 0] * left, y + q[row, 1] * left, z + q[row, 2] * left
        if grounded[t]:
            for side in range(3):
                left, row = of_ground[numbers[t], side], 2 * count + side
                x, y, z = x + q[row, 0] * left, y + q[row, 1] * left, z + q[row, 2] * left
        z = z / r[2, 2]
        y = (y - r[1, 2] * z) / r[1, 1]
        x = (x - r[0, 1] * y - r[0, 2] * z) / r[0, 0]
        shift[numbers[t], 0], shift[numbers[t], 1], shift[numbers[t], 2] = x, y, z


@inlined
def _taken(rays, count, image, slot, blocks, turned, product, inner):
    """Fill `product` ``(k p, 3)`` with C A' Q and `inner` ``(3, 3)`` with Q' A C A' Q."""
    wide = blocks.shape[1]
    for a in range(count):
        for u in range(wide):
            x, y, z = 0.0, 0.0, 0.0
            for b in range(count):
                pair = slot[image[rays[a]], image[rays[b]]]
                for v in range(wide):
                    value = blocks[pair, u, v] if a <= b else blocks[pair, v, u]
                    k = b * wide + v
                    x, y, z = x + value * turned[0, k], y + value * turned[1, k], z + value * turned[2, k]
            k = a * wide + u
            product[k, 0], product[k, 1], product[k, 2] = x, y, z
    for c in range(3):
        for d in range(3):
            inner[c, d] = 0.0
            for k in range(count * wide):
                inner[c, d] += turned[c, k] * product[k, d]


@compiled
def hats(order, starts, numbers, grounded, image, slot, blocks, by_params, by_point, by_ground, of_rays, of_ground):
    """Fill `of_rays` ``(M, 2, 2)`` and `of_ground` ``(N, 3, 3)`` with the parts of the hat matrix, C being `blocks`."""
    wide, most = by_params.shape[2], 0
    for t in range(len(numbers)):
        most = max(most, starts[t + 1] - starts[t])
    q, r, turned = np.empty((2 * most + 3, 3)), np.empty((3, 3)), np.empty((3, most * wide))
    product, core, cross, own = np.empty((most * wide, 3)), np.empty((3, 3)), np.empty((2, 3)), np.empty((2, wide))
    for t in range(len(numbers)):
        rays, count = order[starts[t] : starts[t + 1]], starts[t + 1] - starts[t]
        size = _factored(rays, count, grounded[t], by_point, by_ground[numbers[t]], q, r)
        _turned(rays, count, by_params, q, turned)
        _taken(rays, count, image, slot, blocks, turned, product, core)
        for c in range(3):
            core[c, c] += 1.0
        for a in range(count):
            ray = rays[a]
            pair = slot[image[ray], image[ray]]
            for side in range(2):
                for c in range(3):
                    cross[side, c] = 0.0
                    for u in range(wide):
                        cross[side, c] += by_params[ray, side, u] * product[a * wide + u, c]
                for v in range(wide):
                    own[side, v] = 0.0
                    for u in range(wide):
                        own[side, v] += by_params[ray, side, u] * blocks[pair, u, v]
            for i in range(2):
                for j in range(2):
                    value = 0.0
                    for v in range(wide):
                        value += own[i, v] * by_params[ray, j, v]
                    for c in range(3):
                        value -= cross[i, c] * q[2 * a + j, c] + cross[j, c] * q[2 * a + i, c]
                        for d in range(3):
                            value += q[2 * a + i, c] * core[c, d] * q[2 * a + j, d]
                    of_rays[ray, i, j] = value
        for i in range(size - 2 * count):
            for j in range(3):
                value = 0.0
                for c in range(3):
                    for d in range(3):
                        value += q[2 * count + i, c] * core[c, d] * q[2 * count + j, d]
                of_ground[numbers[t], i, j] = value


@compiled
def ground(order, starts, numbers, grounded, image, slot, blocks, factor, by_params, by_point, by_ground, found):
    """Fill `found` ``(N, 3, 3)`` with the covariances of the points, in the frame, C being `blocks`."""
    wide, most = by_params.shape[2], 0
    for t in range(len(numbers)):
        most = max(most, starts[t + 1] - starts[t])
    q, r, turned = np.empty((2 * most + 3, 3)), np.empty((3, 3)), np.empty((3, most * wide))
    product, inner, root = np.empty((most * wide, 3)), np.empty((3, 3)), np.zeros((3, 3))
    for t in range(len(numbers)):
        rays, count = order[starts[t] : starts[t + 1]], starts[t + 1] - starts[t]
        _factored(rays, count, grounded[t], by_point, by_ground[numbers[t]], q, r)
        _turned(rays, count, by_params, q, turned)
        _taken(rays, count, image, slot, blocks, turned, product, inner)
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
                found[numbers[t], i, j] = value


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
