"""The trend of each edge: a shift, or a shift and slopes, of the places that agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.models.base import Array

#: Least number of places of an edge, and per term of a trend.
FEWEST, _PER_TERM = 6, 4
#: A place is apart if it is so many sigmas from the trend.
_SIGMAS = 3.5
_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class Trends:
    """Linear functions of the values of each edge.

    Parameters
    ----------
    design : (K, m)
        Terms at the places: 1, x, y.
    weights : (E, K, m)
        A term of the trend is the sum of values times weights.
    value : (E, m, 2)
    residual : (E, K, 2)
        0 where a value takes no part.
    used : (E, K) of bool
    """

    design: Array
    weights: Array
    value: Array
    residual: Array
    used: NDArray[np.bool_]

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which edges have a trend."""
        return np.asarray(self.used.any(axis=1), dtype=np.bool_)


def design_of(place: Array, terms: int) -> Array:
    """Return the terms of a trend ``(K, terms)``, 1 or 3, at places."""
    return np.column_stack([np.ones(len(place)), place])[:, :terms]


def trends_of(edges: Edges, design: Array, stable: NDArray[np.bool_]) -> Trends:
    """Return the trend of each edge at stable places ``(K,)``; places that contradict the majority take no part."""
    allowed: NDArray[np.bool_] = np.logical_and(edges.measured, stable)
    value = np.where(allowed[:, :, None], np.nan_to_num(edges.value), 0.0)
    base = 1.0 / (1.0 + edges.relative)
    middle = np.stack([median_of(value[..., axis], allowed) for axis in (0, 1)], axis=1)
    left = np.where(allowed[:, :, None], value - middle[:, None], 0.0)
    used = _near(left, allowed)
    for _ in range(_ROUNDS):
        weights = _functionals(design, base * used)
        trend = weights.transpose(0, 2, 1) @ value
        left = value - design @ trend
        again = _near(left, allowed)
        if (again == used).all():
            break
        used = again
    used &= (used.sum(axis=1) >= max(FEWEST, _PER_TERM * design.shape[1]))[:, None]
    weights = _functionals(design, base * used)
    used &= np.asarray(weights.any(axis=(1, 2)))[:, None]
    weights = np.where(used[:, :, None], weights, 0.0)
    trend = weights.transpose(0, 2, 1) @ value
    left = np.where(used[:, :, None], value - design @ trend, 0.0)
    return Trends(design, weights, trend, left, used)


def median_of(value: Array, some: NDArray[np.bool_]) -> Array:
    """Return the median ``(n,)`` of some values of each row ``(n, m)``; 0 without any."""
    ordered, count = np.sort(np.where(some, value, np.inf), axis=1), some.sum(axis=1)
    rows = np.arange(len(value))
    ends = [ordered[rows, np.maximum(place, 0)] for place in ((count - 1) // 2, count // 2)]
    return np.where(count > 0, (ends[0] + np.where(count > 0, ends[1], ends[0])) / 2, 0.0)


def _near(left: Array, allowed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which values ``(E, K)`` are near the trend, for noise of the size that the median shows."""
    length = np.hypot(left[..., 0], left[..., 1])
    scale = median_of(length, allowed) / np.sqrt(2.0 * np.log(2.0))
    near: NDArray[np.bool_] = allowed & np.less_equal(length, _SIGMAS * np.maximum(scale, 1e-6)[:, None])
    return near


def _functionals(design: Array, weight: Array) -> Array:
    """Return the weights ``(E, K, m)`` that make the terms of a trend of values; 0 where they are not determined."""
    normal = np.einsum("ek,km,kn->emn", weight, design, design)
    values, vectors = np.linalg.eigh(normal)
    sound = values[:, 0] > 1e-3 * values[:, -1]
    inverse = np.einsum("eij,ej,ekj->eik", vectors, 1.0 / np.where(sound[:, None], values, np.inf), vectors)
    return np.asarray(weight[:, :, None] * (design @ inverse))
