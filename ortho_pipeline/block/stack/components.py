r"""Errors of the values of edges: which part belongs to a date, which to an edge, and what neighbours share.

The error of the edge from date b to date a at place k is :math:`s_a(k) - s_b(k) + u(k)`. The field :math:`s` of a date
is the same in all of its edges: noise of its pixels, shadows, bending. The field :math:`u` belongs to the edge. Each is
a sum of noise of single places and of correlations with some ranges. These are exponential and Gaussian: with one of
both alone, errors of the other form would have too long or too short a tail, and sigmas would be wrong. Their variances
follow from moments: products of residuals of places at similar distances, within edges and between edges with a common
date. What the trend takes from the residuals is part of the expected products. Variances are not negative.

The mean size of the residuals gives each date a scale of :math:`s`, and each edge one of :math:`u`.

Source: Cressie 1993, section 2.4 (moments of a variogram); Rao 1973, section 4j (MINQUE); Lawson and Hanson 1974
(non-negative least squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, sparse, spatial

from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.trends import Trends
from ortho_pipeline.models.base import Array

#: Ranges of correlations, in halves of the longer side: from one cell to errors that look like a trend. Upper limits of
#: the classes of distances.
_RANGES = 0.2, 0.5, 1.25
_TERMS = 1 + 2 * len(_RANGES)
_CLASSES = np.array([1e-6, 0.18, 0.3, 0.45, 0.65, 0.9, 1.2, 1.6, 3.0])
#: Edges and pairs of edges whose products are taken, at most.
_EDGES, _PAIRS = 120, 180
#: Limits of the scale of an edge, relative to the mean of its dates.
_SCALES = 0.25, 25.0
_ROUNDS = 30
#: Waves in a year, of errors that dates of one season share: with two, each of four seasons can differ.
WAVES = 1, 2
#: The errors of dates that are so many years apart, counted within a year, have a correlation of exp(-1).
_SEASON = 0.25


@dataclass(frozen=True, eq=False)
class ErrorComponents:
    """Variances of errors, in px².

    Parameters
    ----------
    shared, own : (2, 7)
        Of a date and of an edge, along both axes: noise of single places, and exponential and Gaussian correlations of
        three ranges.
    scale : (T,)
        Of the variances of each date.
    factor : (E,)
        Of the variances of each edge.
    constant : (2,)
        Variance of an error that all values of an edge share, in addition to the stated one; negative if loops show
        less. Residuals within edges do not show it.
    """

    shared: Array
    own: Array
    scale: Array
    factor: Array
    constant: Array

    def of_seasons(self, stated: Array) -> Array:
        """Return the variance ``(2,)`` of a date's error that closes all loops: the stated error that loops lack.

        The constant cannot take more from edges than the quietest one states. As large a part of the typical error
        belongs to dates: edges between seasons have this error, and they are noisier than edges within one season.

        Parameters
        ----------
        stated : (E,)
            Standard deviations of errors that all values of an edge share.
        """
        lacking, least = np.maximum(-self.constant, 0.0), float(stated.min(initial=np.inf))
        return np.asarray(lacking * (np.median(stated) / least) ** 2 / 2) if lacking.any() else lacking

    def at_place(self, edges: Edges) -> tuple[Array, Array]:
        """Return variances of single values ``(E, K)``, mean of both axes: in units of a date's scale, and own."""
        relative = edges.relative
        shared, own = self.shared.mean(axis=0), self.own.mean(axis=0)
        both = shared[0] * relative + shared[1:].sum(), own[0] * relative + own[1:].sum()
        rest = self.constant.mean() + edges.alike[:, None] ** 2
        return both[0], self.factor[:, None] * both[1] + rest

    def covariance(self, axis: int, edges: Edges, trends: Trends, place: Array) -> tuple[sparse.csr_matrix, Array]:
        """Return the covariance of all trends ``(E m, E m)`` along an axis, and the part of each edge ``(E, m, m)``."""
        count, _, terms = trends.weights.shape
        correlations = correlations_of(place)
        root = np.sqrt(edges.relative)
        noisy = trends.weights * root[:, :, None]
        own = self._of_edges(axis, correlations, trends.weights, noisy)
        own[:, 0, 0] += self.constant[axis] + edges.alike**2
        smooth = np.tensordot(self.shared[axis, 1:], correlations, 1)
        incidence = edges.incidence(len(self.scale)).tocsc()
        blocks = []
        for date, scale in enumerate(self.scale):
            part = slice(incidence.indptr[date], incidence.indptr[date + 1])
            rows, signs = incidence.indices[part], incidence.data[part]
            if not len(rows):
                continue
            flat = (signs[:, None, None] * trends.weights[rows]).transpose(0, 2, 1).reshape(len(rows) * terms, -1)
            noise = (signs[:, None, None] * noisy[rows]).transpose(0, 2, 1).reshape(len(rows) * terms, -1)
            block = scale * (flat @ smooth @ flat.T + self.shared[axis, 0] * noise @ noise.T)
            index = (rows[:, None] * terms + np.arange(terms)).ravel()
            blocks.append((block.ravel(), np.repeat(index, len(index)), np.tile(index, len(index))))
        index = np.arange(count * terms).reshape(count, terms)
        blocks.append((own.ravel(), np.repeat(index, terms, axis=1).ravel(), np.tile(index, (1, terms)).ravel()))
        data, rows, columns = (np.concatenate(part) for part in zip(*blocks, strict=True))
        return sparse.csr_matrix((data, (rows, columns)), shape=(count * terms, count * terms)), own

    def _of_edges(self, axis: int, correlations: Array, weights: Array, noisy: Array) -> Array:
        smooth = np.tensordot(self.own[axis, 1:], correlations, 1)
        turned = np.tensordot(weights, smooth, axes=(1, 0))  # (E, m, K)
        found = np.einsum("emk,ekn->emn", turned, weights)
        found += self.own[axis, 0] * np.einsum("ekm,ekn->emn", noisy, noisy)
        return np.asarray(self.factor[:, None, None] * found)


def correlations_of(place: Array) -> Array:
    """Return the correlations ``(2 ranges, K, K)`` of places: exponential, and Gaussian."""
    distance = spatial.distance.cdist(place, place) / np.array(_RANGES)[:, None, None]
    return np.concatenate([np.exp(-distance), np.exp(-(distance**2))])


def classes_of(place: Array) -> NDArray[np.int_]:
    """Return the class ``(K, K)`` of the distance of two places."""
    return np.searchsorted(_CLASSES, spatial.distance.cdist(place, place))


def season_correlation(years: Array) -> Array:
    """Return the correlations ``(T, T)`` of errors that depend on the season.

    A date without a time (NaN), such as a reference, has one of its own.

    >>> season_correlation(np.array([0.0, 1.0, 1.5, np.nan])).round(2)
    array([[1.  , 1.  , 0.14, 0.  ],
           [1.  , 1.  , 0.14, 0.  ],
           [0.14, 0.14, 1.  , 0.  ],
           [0.  , 0.  , 0.  , 1.  ]])
    """
    apart = np.sin(np.pi * (years[:, None] - years)) ** 2 / np.sin(np.pi * _SEASON) ** 2
    return np.where(np.isfinite(apart), np.exp(-np.nan_to_num(apart)), np.eye(len(years)))


def components_of(edges: Edges, trends: Trends, place: Array, dates: int) -> ErrorComponents:
    """Return the components of the errors of edges, from the residuals of their trends."""
    good = np.flatnonzero(trends.good)
    size = np.sqrt((trends.residual**2).sum(axis=(1, 2)) / np.maximum(2 * trends.used.sum(axis=1), 1))
    typical = float(np.median(size[good])) if len(good) else 1.0
    typical = max(typical, 1e-6)
    left = trends.residual / np.maximum(size, 1e-9)[:, None, None]
    shapes = _Shapes(edges, trends, place, left)
    shared, own = np.empty((2, _TERMS)), np.empty((2, _TERMS))
    seen = np.zeros(2)
    for axis, (of_date, of_edge, parts) in enumerate(shapes.variances()):
        shared[axis], own[axis] = of_date, of_edge
        seen += parts / 2
    whole = float(seen.sum())
    if whole > 0:
        shared, own, seen = shared / whole, own / whole, seen / whole
    else:
        shared[:], own[:], seen = 0.0, np.eye(_TERMS)[0], np.array([0.0, 1.0])
    scale, factor = _scales(edges, good, (size / typical) ** 2, seen, dates)
    return ErrorComponents(shared * typical**2, own * typical**2, scale, factor, np.zeros(2))


def _scales(edges: Edges, good: NDArray[np.int_], square: Array, seen: Array, dates: int) -> tuple[Array, Array]:
    """Return scales of dates and edges, from squared sizes of residuals and the parts of dates and edges in them."""
    scale, first, second = np.ones(dates), edges.first[good], edges.second[good]
    for _ in range(_ROUNDS):
        expected = (scale[first] + scale[second]) / 2
        above, below = np.full(dates, 1e-9), np.full(dates, 1e-9)
        for end in (first, second):
            # Relative to what is expected, so that an edge of large errors does not decide for all.
            np.add.at(above, end, np.minimum(square[good] / expected, 9.0))
            np.add.at(below, end, 1.0)
        scale *= np.sqrt(above / below)
    mean = (scale[edges.first] + scale[edges.second]) / 2
    rest = (square - seen[0] * mean) / max(seen[1], 1e-9)
    factor = np.clip(rest, _SCALES[0] * mean, _SCALES[1] * mean)
    return scale, np.where(seen[1] > 0.05, factor, mean)


class _Shapes:
    """Products of residuals, and what they are expected to be."""

    def __init__(self, edges: Edges, trends: Trends, place: Array, left: Array) -> None:
        self.edges, self.trends, self.left = edges, trends, left
        self.correlations = correlations_of(place)
        self.classes = classes_of(place)
        good = np.flatnonzero(trends.good)
        self.single = _spread([(edge, edge, 1.0) for edge in good.tolist()], _EDGES)
        self.pairs = _spread(_with_common_date(edges, good), _PAIRS)

    def variances(self) -> list[tuple[Array, Array, Array]]:
        """Return variances of a date and of an edge ``(7,)``, and their parts ``(2,)`` of a residual, of both axes."""
        same, seen, number = self._sums(self.single)
        between, cross, many = self._sums(self.pairs)
        design = np.vstack([np.hstack([2 * same, same]), np.hstack([between, np.zeros_like(between)])])
        weight = 1.0 / np.sqrt(np.maximum(np.concatenate([number, many]), 1.0))
        columns = design * weight[:, None]
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
        here = same[0] / max(float(number[0]), 1.0)
        result = []
        for axis in (0, 1):
            products = np.concatenate([seen[:, axis], cross[:, axis]]) * weight
            shared, own = np.split(optimize.nnls(columns / size, products)[0] / size, 2)
            result.append((shared, own, np.array([2 * here @ shared, here @ own])))
        return result

    def _sums(self, pairs: list[tuple[int, int, float]]) -> tuple[Array, Array, Array]:
        """Return expected sums ``(classes, 7)`` per unit of variance, those seen ``(classes, 2)``, and numbers."""
        count = len(_CLASSES) + 1
        expected, seen = np.zeros((count, _TERMS)), np.zeros((count, 2))
        one, other = np.array([pair[:2] for pair in pairs], dtype=int).reshape(-1, 2).T
        sign, trends, root = np.array([pair[2] for pair in pairs]), self.trends, np.sqrt(self.edges.relative)
        used, there = trends.used[one].astype(float), trends.used[other].astype(float)  # (P, K)
        many = used.T @ there
        number = np.asarray(np.bincount(self.classes.ravel(), many.ravel(), count), dtype=float)
        for axis in (0, 1):
            product = (sign[:, None] * self.left[one, :, axis]).T @ self.left[other, :, axis]
            seen[:, axis] = np.bincount(self.classes.ravel(), product.ravel(), count)
        before, behind = (trends.weights[end].transpose(0, 2, 1) for end in (one, other))  # (P, m, K)
        rows, columns = (which[:, None, :] * trends.design.T for which in (used, there))
        for kind in range(count):
            # The trends of both edges take a part of the products of a class. It is the same for all kernels.
            here = (self.classes == kind).astype(float)
            left, right = rows @ here * there[:, None, :], columns @ here * used[:, None, :]
            left = left - (left @ columns.transpose(0, 2, 1)) @ behind
            parts = (
                here * many
                - np.tensordot(before, left, ((0, 1), (0, 1)))
                - np.tensordot(right, behind, ((0, 1), (0, 1)))
            )
            expected[kind, 1:] = (self.correlations * parts).sum(axis=(1, 2))
            single = here.diagonal() * used * there - (before * left).sum(axis=1) - (right * behind).sum(axis=1)
            expected[kind, 0] = (root[one] * root[other] * single).sum()
        return expected, seen, number


def _with_common_date(edges: Edges, good: NDArray[np.int_]) -> list[tuple[int, int, float]]:
    """Return pairs of edges with a common date, and the sign of its part in their product."""
    ends: dict[int, list[tuple[int, float]]] = {}
    for edge in good.tolist():
        ends.setdefault(int(edges.first[edge]), []).append((edge, 1.0))
        ends.setdefault(int(edges.second[edge]), []).append((edge, -1.0))
    return [
        (one, other, sign * back)
        for date in sorted(ends)
        for place, (one, sign) in enumerate(ends[date])
        for other, back in ends[date][place + 1 :]
    ]


def _spread(items: list[tuple[int, int, float]], most: int) -> list[tuple[int, int, float]]:
    """Return at most so many items, spread evenly."""
    if len(items) <= most:
        return items
    return [items[place] for place in np.linspace(0, len(items) - 1, most).round().astype(int)]
