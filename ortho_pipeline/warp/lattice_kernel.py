"""Compiled bound on the error of the warp's lattices; lattice.py explains it.

Arrays: `image` ``(blocks, n + 1, n + 1, levels, 2)`` source points of the nodes at each height, `coefficients` of the
same shape their polynomials in the normalised height, `dem` ``(blocks, n + 1, n + 1, 2)`` DEM points of the nodes,
`cells` ``(blocks, n, n)`` what `visible` found.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ortho_pipeline.runtime.compiled import compiled, inlined

#: A cell counts as visible if it comes as close to the image as this (px), or as half of its own size.
_NEAR = 4.0
#: What check points find beyond the second differences is trusted to be the largest within this factor.
_TRUST = 3.0


@compiled
def extents(points: Any, boxes: Any) -> None:
    """Fill `boxes` ``(blocks, 4)``: least x and y, greatest x and y of each block's finite points ``(blocks, n, 2)``.

    The least is infinite where there are none.
    """
    for b in range(points.shape[0]):
        left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
        for k in range(points.shape[1]):
            x, y = points[b, k, 0], points[b, k, 1]
            if abs(x) < np.inf and abs(y) < np.inf:
                left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3] = left, top, right, bottom


@compiled
def height_ranges(heights: Any, left: int, top: int, windows: Any, found: Any) -> None:
    """Fill `found` ``(blocks, 2)`` with lowest and highest of the heights in `windows` ``(blocks, 4)``, voids left out.

    `heights` begin at column `left` and row `top`. The lowest is infinite where all are voids.
    """
    for b in range(windows.shape[0]):
        low, high = np.inf, -np.inf
        for j in range(windows[b, 1] - top, windows[b, 3] - top):
            for i in range(windows[b, 0] - left, windows[b, 2] - left):
                height = heights[j, i]
                if abs(height) < np.inf:
                    low, high = min(low, height), max(high, height)
        found[b, 0], found[b, 1] = low, high


@compiled
def visible(image: Any, width: float, height: float, unknown: Any, cells: Any, area: Any) -> None:
    """Mark the cells that may show some of the image, and find the rectangle of cells around them.

    `area` ``(blocks, 4)`` becomes first row, last row + 1, first column, last column + 1 of cells, zeros if there are
    none. A cell with a node that the model does not project is marked where `unknown` ``(blocks,)`` says so.
    """
    for b in range(image.shape[0]):
        count = cells.shape[1]
        first_row, last_row, first, last = count, 0, count, 0
        for j in range(count):
            for i in range(count):
                cells[b, j, i] = _may_show(image[b], j, i, width, height, unknown[b])
                if cells[b, j, i]:
                    first_row, last_row = min(first_row, j), max(last_row, j + 1)
                    first, last = min(first, i), max(last, i + 1)
        seen = last > 0
        area[b, 0], area[b, 1] = (first_row if seen else 0), last_row
        area[b, 2], area[b, 3] = (first if seen else 0), last


@inlined
def _may_show(image, j, i, width, height, unknown):
    low_col, high_col, low_row, high_row = np.inf, -np.inf, np.inf, -np.inf
    whole = True
    for level in range(image.shape[2]):
        for corner in range(4):
            point = image[j + corner // 2, i + corner % 2, level]
            whole &= abs(point[0]) < np.inf and abs(point[1]) < np.inf
            low_col, high_col = min(low_col, point[0]), max(high_col, point[0])
            low_row, high_row = min(low_row, point[1]), max(high_row, point[1])
    across, down = max(_NEAR, 0.5 * (high_col - low_col)), max(_NEAR, 0.5 * (high_row - low_row))
    near = low_col <= width + across and high_col >= -across and low_row <= height + down and high_row >= -down
    return near if whole else unknown


@compiled
def bounds(
    image: Any,
    coefficients: Any,
    dem: Any,
    cells: Any,
    spacing: int,
    points: Any,
    exact: Any,
    exact_dem: Any,
    error: Any,
    apart: Any,
    step: Any,
) -> None:
    """Fill `error` ``(blocks,)`` with a bound (source px) on the error in the visible cells of each block.

    And `apart` ``(blocks,)`` with the part of it that second differences tell, which the distance of nodes makes.

    `points` ``(blocks, p, 3)`` are offsets of columns and rows from the block's first pixel and normalised heights of
    check points, `exact` and `exact_dem` ``(blocks, p, 2)`` what the exact model and projection say there. `step`
    ``(blocks,)`` becomes the largest distance (source px) between neighbouring nodes.
    """
    nodes = image.shape[1]
    along, across = np.empty((nodes, nodes), dtype=np.bool_), np.empty((nodes, nodes), dtype=np.bool_)
    for b in range(image.shape[0]):
        error[b], apart[b], step[b] = 0.0, 0.0, 0.0
        if not _mark(cells[b], along, across):
            continue
        parallax, step[b] = _reach(image[b], cells[b])
        # As of one level: for a view of another layout, or a constant, it would be compiled apart.
        plan, shift = 0.0, _bent(dem[b].reshape(nodes, nodes, 1, 2), np.int64(0), along, across)
        for level in range(image.shape[3]):
            plan = _worse(plan, _bent(image[b], level, along, across))
        rest = 0.0
        for k in range(points.shape[1]):
            rest = _worse(
                rest,
                _unexplained(
                    coefficients[b], dem[b], cells[b], spacing, points[b, k], exact[b, k], exact_dem[b, k], parallax
                ),
            )
        apart[b] = plan + parallax * shift
        error[b] = apart[b] + _TRUST * rest
        if not error[b] < np.inf:
            error[b] = np.inf


@inlined
def _worse(first, second):
    """Return the larger; infinity where the second is not a number."""
    return max(first, second) if second <= np.inf else np.inf


@inlined
def _mark(cells, along, across):
    """Mark the nodes whose second differences count for visible cells, those of the next cell on included."""
    count, any_cell = cells.shape[0], False
    along[:], across[:] = False, False
    for j in range(count):
        for i in range(count):
            if cells[j, i]:
                any_cell = True
                for k in range(max(i - 1, 1), min(i + 2, count - 1) + 1):
                    along[j, k] = along[j + 1, k] = True
                for k in range(max(j - 1, 1), min(j + 2, count - 1) + 1):
                    across[k, i] = across[k, i + 1] = True
    return any_cell


@inlined
def _reach(image, cells):
    """Return how far the heights move a node, and how far apart nodes are, at most in visible cells (source px)."""
    count, parallax, step = cells.shape[0], 0.0, 0.0
    for j in range(count):
        for i in range(count):
            if cells[j, i]:
                for corner in range(4):
                    node, path = image[j + corner // 2, i + corner % 2], 0.0
                    for level in range(image.shape[2] - 1):
                        path += _distance(node[level + 1], node[level])
                    parallax = _worse(parallax, path)
                for level in range(image.shape[2]):
                    for side in range(2):
                        step = _worse(step, _distance(image[j + side, i + 1, level], image[j + side, i, level]))
                        step = _worse(step, _distance(image[j + 1, i + side, level], image[j, i + side, level]))
    return parallax, step


@inlined
def _distance(one, other):
    return np.sqrt((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2)


@inlined
def _bent(nodes, level, along, across):
    """Return how far bilinear interpolation between nodes ``(n, n, levels, 2)`` is off, as second differences tell.

    An eighth of the largest, which bounds it where they change little from node to node, and the largest change, which
    is more than a single bend between two nodes moves the curve. Infinite where a node is missing.
    """
    count, worst = nodes.shape[0], 0.0
    for axis in range(2):
        used, down, right = (along, 0, 1) if axis == 0 else (across, 1, 0)
        largest, change = 0.0, 0.0
        for j in range(count):
            for i in range(count):
                if not used[j, i]:
                    continue
                u, v = _second(nodes, level, j, i, down, right)
                largest = _worse(largest, u * u + v * v)
                for side in range(2):
                    y, x = (j + 1, i) if side else (j, i + 1)
                    if y < count and x < count and used[y, x]:
                        nu, nv = _second(nodes, level, y, x, down, right)
                        change = _worse(change, (nu - u) ** 2 + (nv - v) ** 2)
        worst += np.sqrt(largest) / 8.0 + np.sqrt(change)
    return worst


@inlined
def _second(nodes, level, j, i, down, right):
    before, here, after = nodes[j - down, i - right, level], nodes[j, i, level], nodes[j + down, i + right, level]
    return before[0] - 2.0 * here[0] + after[0], before[1] - 2.0 * here[1] + after[1]


@inlined
def _unexplained(coefficients, dem, cells, spacing, point, exact, exact_dem, parallax):
    """Return how far a check point is off beyond what the second differences foretell there (source px).

    Infinite where either has no projection; 0 in a cell that is not visible.
    """
    i, j = int(point[0]) // spacing, int(point[1]) // spacing
    if not cells[j, i]:
        return 0.0
    fx, fy = point[0] / spacing - i, point[1] / spacing - j
    miss, shift = 0.0, 0.0
    for axis in range(2):
        value = 0.0
        for power in range(coefficients.shape[2] - 1, -1, -1):
            value = value * point[2] + _bowed(coefficients[:, :, power, axis], j, i, fx, fy)
        miss += (exact[axis] - value) ** 2
        shift += abs(exact_dem[axis] - _bowed(dem[:, :, axis], j, i, fx, fy))
    return np.sqrt(miss) + parallax * shift


@inlined
def _bowed(nodes, j, i, fx, fy):
    """Interpolate nodes ``(n, n)`` with the bow that their second differences foretell."""
    last = nodes.shape[0] - 2
    total = 0.0
    for corner in range(4):
        y, x = j + corner // 2, i + corner % 2
        weight = (fx if corner % 2 else 1.0 - fx) * (fy if corner // 2 else 1.0 - fy)
        # A node at the block's rim has the second difference of the next one.
        xi, yi = min(max(x, 1), last), min(max(y, 1), last)
        across = nodes[y, xi - 1] - 2.0 * nodes[y, xi] + nodes[y, xi + 1]
        down = nodes[yi - 1, x] - 2.0 * nodes[yi, x] + nodes[yi + 1, x]
        total += weight * (nodes[y, x] - 0.5 * (fx * (1.0 - fx) * across + fy * (1.0 - fy) * down))
    return total
