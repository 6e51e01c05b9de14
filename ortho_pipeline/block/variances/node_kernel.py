"""Compiled solutions of a block's control equations at given variances; see `control_equations` for what they are."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.runtime.compiled import compiled, inlined

Array = Any


class Equations(NamedTuple):
    """What all nodes have in common: `ControlEquations` as plain arrays.

    `flat` ``(m, 3 n)`` are the rows of `k` as columns; `counts` ``(3,)`` the measurements less three for each tie
    point, the parameters that nothing told of here has a part in, and the square of the misfits of measurements.
    """

    u: Array
    k: Array
    flat: Array
    ue: Array
    d: Array
    stated: Array
    unstated: Array
    image: Array
    image_right: Array
    pseudo: Array
    pseudo_right: Array
    counts: Array


@inlined
def _points(of, node, weights, inverse, met, taken):
    """Eliminate the control points at a node; return the log determinants and the square that they leave.

    Fills `weights` ``(n, 3)``, `inverse` ``(n, 3, 3)``, `met` ``(3 n,)`` and `taken` ``(3 n, m)``.
    """
    scale, spread, square = 1.0 / node[0], 0.0, 0.0
    half, back, right = np.empty((3, 3)), np.zeros((3, 3)), np.empty(3)
    for t in range(of.u.shape[0]):
        lengths = 1.0
        for c in range(3):
            weight = of.stated[t, c]
            if of.unstated[t, c]:
                weight = 1.0 / (node[1] if c < 2 else node[2])
                lengths /= weight
            weights[t, c] = weight
            right[c] = of.ue[t, c] * scale + weight * of.d[t, c]
            square += weight * of.d[t, c] ** 2
        for c in range(3):
            for e in range(c + 1):
                value = of.u[t, c, e] * scale + (weights[t, c] if e == c else 0.0)
                for s in range(e):
                    value -= half[c, s] * half[e, s]
                half[c, e] = np.sqrt(value) if e == c else value / half[e, e]
            lengths *= half[c, c] ** 2
            back[c, c] = 1.0 / half[c, c]
        spread += np.log(lengths)
        back[1, 0] = -half[1, 0] * back[0, 0] * back[1, 1]
        back[2, 1] = -half[2, 1] * back[1, 1] * back[2, 2]
        back[2, 0] = -(half[2, 0] * back[0, 0] + half[2, 1] * back[1, 0]) * back[2, 2]
        for c in range(3):
            for e in range(3):
                value = 0.0
                for s in range(max(c, e), 3):
                    value += back[s, c] * back[s, e]
                inverse[t, c, e] = value
        for c in range(3):
            row = 3 * t + c
            x, y, z = inverse[t, c, 0], inverse[t, c, 1], inverse[t, c, 2]
            met[row] = x * right[0] + y * right[1] + z * right[2]
            square -= right[c] * met[row]
            x, y, z = x * scale, y * scale, z * scale
            for v in range(of.k.shape[2]):
                taken[row, v] = x * of.k[t, 0, v] + y * of.k[t, 1, v] + z * of.k[t, 2, v]
    return spread, square


@inlined
def _factor(normal, right):
    """Factor normal equations, U' U, in their upper triangle, and turn `right` into U'^-1 right; return log det.

    Infinite if they are not positive definite.
    """
    size, spread = normal.shape[0], 0.0
    for a in range(size):
        pivot = normal[a, a]
        if not pivot > 0.0:
            return np.inf
        spread += np.log(pivot)
        root = 1.0 / np.sqrt(pivot)
        for b in range(a, size):
            normal[a, b] *= root
        right[a] *= root
        for b in range(a + 1, size):
            along = normal[a, b]
            right[b] -= along * right[a]
            for c in range(b, size):
                normal[b, c] -= along * normal[a, c]
    return spread


@inlined
def _inverse(upper):
    """Return the inverse of an upper triangle ``(m, m)``."""
    size = upper.shape[0]
    found = np.zeros((size, size))
    for a in range(size):
        found[a, a] = 1.0 / upper[a, a]
        for b in range(a + 1, size):
            value = 0.0
            for c in range(a, b):
                value += upper[c, b] * found[a, c]
            found[a, b] = -value / upper[b, b]
    return found


@inlined
def _product(a, b, found):
    """Fill `found` with the product of two matrices."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            found[i, j] = 0.0
        for c in range(a.shape[1]):
            factor = a[i, c]
            for j in range(b.shape[1]):
                found[i, j] += factor * b[c, j]


@inlined
def _upper_product(a, b, found):
    """Fill the upper triangle of `found` with a product that is symmetric."""
    size = a.shape[0]
    for i in range(size):
        for j in range(i, size):
            found[i, j] = 0.0
        for c in range(a.shape[1]):
            factor = a[i, c]
            for j in range(i, size):
                found[i, j] += factor * b[c, j]


@inlined
def _times(a, x, found):
    """Fill `found` with the product of a matrix and a vector."""
    for i in range(a.shape[0]):
        found[i] = 0.0
        for c in range(a.shape[1]):
            found[i] += a[i, c] * x[c]


@inlined
def _solve(of, node, weights, inverse, met, taken, normal, right):
    """Solve at a node; return its log likelihood and the square of all misfits.

    `normal` is its factor then, and `right` U'^-1 times the right side;
    `node` ``(3,)`` are the variances of measurements, and of unstated ground in plan and height.
    """
    spread, square = _points(of, node, weights, inverse, met, taken)
    scale, size = 1.0 / node[0], normal.shape[0]
    _upper_product(of.flat, taken, normal)
    _times(of.flat, met, right)
    for a in range(size):
        right[a] = (of.image_right[a] - right[a]) * scale + of.pseudo_right[a]
        for b in range(a, size):
            normal[a, b] = (of.image[a, b] - normal[a, b]) * scale + of.pseudo[a, b]
    spread += (of.counts[0] - of.counts[1]) * np.log(node[0]) + _factor(normal, right)
    square += of.counts[2] * scale
    for a in range(size):
        square -= right[a] * right[a]
    return -0.5 * (spread + square), square


@compiled
def likelihoods(of, nodes, found):
    """Fill `found` ``(b,)`` with the log likelihoods at nodes ``(b, 3)``."""
    count, size = of.u.shape[0], of.k.shape[2]
    weights, inverse, met = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty(3 * count)
    taken, normal, right = np.empty((3 * count, size)), np.empty((size, size)), np.empty(size)
    for t in range(nodes.shape[0]):
        found[t], _ = _solve(of, nodes[t], weights, inverse, met, taken, normal, right)


@compiled
def means(of, nodes, chances, moved, weights, z, cofactors, shift, ground):
    """Add up what holds at nodes ``(b, 3)`` times their chances ``(b,)``; return the square of the last node's misfits.

    `z` ``(m,)``, `shift` ``(n, 3)`` and `weights` ``(n, 3)`` are those of the last node; `cofactors` ``(m, m)`` and
    `ground` ``(n, 3, 3)`` get the cofactors of parameters and points, with z z' and the squares of the shifts if
    `moved`.
    """
    count, size, square = of.u.shape[0], of.k.shape[2], 0.0
    inverse, met, taken = np.empty((count, 3, 3)), np.empty(3 * count), np.empty((3 * count, size))
    normal, right = np.empty((size, size)), np.empty(size)
    own, spread = np.empty((size, size)), np.empty((3 * count, size))
    for t in range(nodes.shape[0]):
        _, square = _solve(of, nodes[t], weights, inverse, met, taken, normal, right)
        back = _inverse(normal)
        _product(back, back.T, own)
        _times(back, right, z)
        _product(taken, own, spread)
        for a in range(size):
            for b in range(size):
                cofactors[a, b] += chances[t] * (own[a, b] + (z[a] * z[b] if moved else 0.0))
        for point in range(count):
            for c in range(3):
                row = 3 * point + c
                value = met[row]
                for a in range(size):
                    value -= taken[row, a] * z[a]
                shift[point, c] = value
            for c in range(3):
                for e in range(3):
                    value = inverse[point, c, e]
                    for a in range(size):
                        value += spread[3 * point + c, a] * taken[3 * point + e, a]
                    if moved:
                        value += shift[point, c] * shift[point, e]
                    ground[point, c, e] += chances[t] * value
    return square
