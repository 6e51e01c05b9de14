r"""The network of a stack: one correction for each date, from all edges together.

The trends of edges are :math:`y = G p + e`, where G says which dates an edge compares. Weights are the errors of each
edge alone: errors of a date are the same in all of its edges and move its correction, whatever the weights. With
:math:`p = Q y` the covariance is :math:`Q \Sigma Q^T`. The full :math:`\Sigma` includes what edges with a common date
share.

An edge is accepted if it closes the loop: if it differs from what all other edges say of its two dates by no more than
their common error explains. The first solution minimises the sum of lengths, so that wrong edges hardly move it. Then
edges leave and come back until none changes; only a loop brings one back. If an edge has loops with rejected edges
alone, nothing tells which of them is right: it is not accepted either.

Loops do not show errors that close them. If they show less than the stated error of edges, the rest belongs to dates:
the ground looks different through the year, and shadows and plants displace all matches alike. Dates of one season
share that error.

Source: Baarda 1968 (tests of single observations); Huber 1981 (robust start); Liang and Zeger 1986 (sandwich).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.sparse import csgraph
from scipy.stats import chi2, norm, t

from ortho_pipeline.block.stack.components import WAVES, ErrorComponents, season_correlation
from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.trends import Trends
from ortho_pipeline.models.base import Array

#: Chance that a right edge is rejected.
CHANCE = 1e-4
_START, _ROUNDS = 30, 12
#: Part of the errors of its dates that an edge has in its weight, so that no weight is infinite.
_LEAST = 0.1
_LIMIT = float(chi2.isf(CHANCE, 2))
#: The constant error of edges is settled if it changes by less than this part of their variance.
_SMALL = 0.03
#: The stated error of an edge counts as much as this many loops.
_STATED = 10
#: An edge with a smaller redundancy is in no loop.
_IN_LOOP = 1e-6


@dataclass(frozen=True, eq=False)
class Closures:
    """How edges close loops with all other edges.

    Parameters
    ----------
    error : (E, 2)
        What an edge measured minus what the other edges say, px; NaN where no loop tests it.
    ratio : (E,)
        Squared error in units of its covariance; NaN where no loop tests it.
    accepted : (E,) of bool
    """

    error: Array
    ratio: Array
    accepted: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Network:
    """Corrections of dates.

    Parameters
    ----------
    value : (T, 3, 2)
        Shift at the middle and slopes, px; 0 where a term is not estimated.
    covariance : (2, 3 T, 3 T)
        Along both axes.
    part : (T,) of int
        Dates with the same number are connected by accepted edges.
    """

    value: Array
    covariance: Array
    part: NDArray[np.int_]

    def relative_to(self, weights: Array, terms: int = 3) -> Network:
        """Return corrections of which the mean with weights ``(T,)``, with a sum of 1, is zero.

        Parameters
        ----------
        terms : int
            1: the mean of the shifts; 3: that of the slopes, too.
        """
        dates, value = len(self.value), self.value.copy()
        value[:, :terms] -= np.einsum("t,tmc->mc", weights, value[:, :terms])
        covariance = self.covariance.reshape(2, dates, 3, dates, 3).copy()
        covariance[:, :, :terms] -= np.einsum("t,atmun->amun", weights, covariance[:, :, :terms])[:, None]
        covariance[..., :terms] -= np.einsum("u,atmun->atmn", weights, covariance[..., :terms])[:, :, :, None]
        return replace(self, value=value, covariance=covariance.reshape(self.covariance.shape))

    def with_seasons(self, variance: Array, yearly: Array, years: Array) -> Network:
        """Return the same corrections, with errors that dates of one season share.

        A date without a time (NaN), such as a reference, shares them with no other date.

        Parameters
        ----------
        variance : (2,)
            px², of an error that falls off from season to season.
        yearly : (h, 2)
            px², of the waves `WAVES`.
        """
        covariance, apart = self.covariance.copy(), years[:, None] - years
        covariance[:, ::3, ::3] += variance[:, None, None] * season_correlation(years)
        for number, one in zip(WAVES, yearly, strict=True):
            wave = np.where(np.isfinite(apart), np.cos(2 * np.pi * number * apart), np.eye(len(years)))
            covariance[:, ::3, ::3] += one[:, None, None] * wave
        return replace(self, covariance=covariance)

    def with_drift(self, rate: Array, variance: Array, time: Array) -> Network:
        """Return corrections with a steady motion: a rate ``(2,)`` and its variance, over a time ``(T,)``."""
        value, covariance = self.value.copy(), self.covariance.copy()
        value[:, 0] += time[:, None] * rate
        covariance[:, ::3, ::3] += variance[:, None, None] * np.outer(time, time)
        return replace(self, value=value, covariance=covariance)


def accepted_edges(
    edges: Edges, trends: Trends, components: ErrorComponents, place: Array, dates: int
) -> tuple[Closures, ErrorComponents]:
    """Return which edges close loops, and components with the error that only loops show."""
    incidence = edges.incidence(dates)
    value, usable = trends.value[:, 0], trends.good
    both = [components.covariance(axis, edges, _shifts(trends), place) for axis in (0, 1)]
    left = value - incidence @ _shortest(incidence, value, usable)
    total = np.array([one.diagonal() for one, _ in both]).T
    constant, loops = np.zeros(2), _loops(incidence, usable)
    if loops:
        # As many edges as there are loops have anything left at all. More than half of these are right.
        largest = np.sort(left[usable] ** 2, axis=0)[-loops:]
        constant = largest[(loops - 1) // 2] / chi2.median(1) - np.median(total[usable], axis=0)
    least = _least(edges, loops, usable)
    constant = np.maximum(constant, least)
    accepted = usable & ((left**2 / np.maximum(total + constant, 1e-12)).sum(axis=1) < _LIMIT)
    for _ in range(_ROUNDS):
        closures, more = _closed(edges, incidence, value, both, constant, accepted)
        before, constant = constant, np.maximum(constant + more, least)
        # Edges are tested with the error that the accepted ones have themselves.
        if (np.abs(constant - before) < _SMALL * total.mean(axis=0)).all():
            again = usable & np.where(np.isfinite(closures.ratio), closures.ratio <= _LIMIT, accepted)
            if (again == accepted).all():
                break
            accepted = again
    accepted = accepted & ~_contradicted(edges, incidence, closures, accepted, usable & ~accepted)
    # What few loops show is uncertain: 1.96 sigmas hold as often as Student's intervals.
    freedom = max(_loops(incidence, accepted), 1)
    constant = np.where(constant > 0, constant * (t.isf(0.025, freedom) / norm.isf(0.025)) ** 2, constant)
    return replace(closures, accepted=accepted), replace(components, constant=constant)


def _contradicted(
    edges: Edges, incidence: sparse.csr_matrix, closures: Closures, accepted: NDArray[np.bool_],
    rejected: NDArray[np.bool_],
) -> NDArray[np.bool_]:  # fmt: skip
    """Return which accepted edges are in no loop, and connect the same parts as a rejected one."""
    found = np.zeros(len(edges), dtype=bool)
    for edge in np.flatnonzero(accepted & np.isnan(closures.ratio)):
        part = _parts(incidence, accepted & (np.arange(len(edges)) != edge))
        sides = np.sort([part[edges.first], part[edges.second]], axis=0)
        found[edge] = (rejected & (sides == sides[:, [edge]]).all(axis=0)).any()
    return found


def _loops(incidence: sparse.csr_matrix, usable: NDArray[np.bool_]) -> int:
    """Return the number of independent loops of edges."""
    part = _parts(incidence, usable)
    return int(usable.sum()) - len(part) + len(np.unique(part))


def _least(edges: Edges, loops: int, usable: NDArray[np.bool_]) -> float:
    """Return the least constant variance of edges: with many loops it may be less than stated."""
    return -loops / (loops + _STATED) * float(edges.alike[usable].min()) ** 2 if loops else 0.0


def _shifts(trends: Trends) -> Trends:
    """Return the first terms of trends alone."""
    return replace(trends, weights=np.ascontiguousarray(trends.weights[:, :, :1]), value=trends.value[:, :1])


def _shortest(incidence: sparse.csr_matrix, value: Array, usable: NDArray[np.bool_]) -> Array:
    """Return shifts of dates ``(T, 2)`` with the least sum of lengths of what is left of edges."""
    weight, found = usable.astype(float), np.zeros((incidence.shape[1], 2))
    part = _parts(incidence, usable)
    member = (part[:, None] == np.arange(part.max() + 1)).astype(float)
    for _ in range(_START):
        normal = (incidence.T @ incidence.multiply(weight[:, None])).toarray()
        level = max(float(normal.diagonal().mean()), 1.0)
        right = incidence.T @ (weight[:, None] * value)
        found = linalg.solve(normal + level * member @ member.T, right, assume_a="pos")
        length = np.hypot(*(value - incidence @ found).T)
        floor = max(float(np.median(length[usable])) * 0.1, 1e-6) if usable.any() else 1.0
        weight = usable / np.maximum(length, floor)
    return np.asarray(found)


def _parts(incidence: sparse.csr_matrix, accepted: NDArray[np.bool_]) -> NDArray[np.int_]:
    some = abs(incidence[np.flatnonzero(accepted)])
    return np.asarray(csgraph.connected_components(some.T @ some, directed=False)[1])


def _closed(
    edges: Edges,
    incidence: sparse.csr_matrix,
    value: Array,
    both: list[tuple[sparse.csr_matrix, Array]],
    constant: Array,
    accepted: NDArray[np.bool_],
) -> tuple[Closures, Array]:
    """Return the closures of edges, and by how much the constant variance ``(2,)`` of edges is to change."""
    index, every, part = np.flatnonzero(accepted), np.arange(len(value)), _parts(incidence, accepted)
    connected = part[edges.first] == part[edges.second]
    member = (part[:, None] == np.arange(part.max() + 1)).astype(float)
    error, ratio, more = np.full(value.shape, np.nan), np.zeros(len(value)), np.zeros(2)
    for axis, (sigma, own) in enumerate(both):
        total = sigma.diagonal() + constant[axis]
        weight = 1.0 / _weighed(total, own[:, 0, 0] + constant[axis])[index]
        some = incidence[index]
        scaled = some.multiply(weight[:, None]).tocsr()
        level = float(weight.mean()) if len(weight) else 1.0
        gain = (scaled @ np.linalg.inv((some.T @ scaled).toarray() + level * member @ member.T)).T  # (T, n)
        left = value[:, axis] - incidence @ (gain @ value[index, axis])
        # An edge that is not accepted shares errors of its dates with the others, too; the constant is its own.
        moved = (sigma[:, index] @ gain.T).T  # (T, E)
        moved[:, index] += constant[axis] * gain
        variance = total + _between(edges, moved[:, index] @ gain.T) - 2.0 * _across(edges, moved, every)
        leverage, squared = _across(edges, gain, index), _between(edges, gain @ gain.T)[index]
        redundancy = np.ones(len(value))
        redundancy[index] = 1.0 - leverage
        tested = connected & (redundancy > _IN_LOOP)
        error[:, axis] = np.where(tested, left / np.where(tested, redundancy, 1.0), np.nan)
        ratio += np.where(tested, left**2 / np.maximum(variance, 1e-12), np.nan)
        # Of the weighted sum of squares of what is left, E = tr(R' W R Sigma): what is more is a constant of each edge.
        excess = weight @ (left[index] ** 2 - variance[index])
        more[axis] = excess / max(float(weight @ (1.0 - 2.0 * leverage + squared)), 1e-12)
    return Closures(error, ratio, accepted), more


def _between(edges: Edges, covariance: Array) -> Array:
    """Return the variance ``(E,)`` of the difference of the dates of each edge."""
    own = covariance.diagonal()
    return np.asarray(own[edges.first] + own[edges.second] - 2.0 * covariance[edges.first, edges.second])


def _across(edges: Edges, matrix: Array, index: NDArray[np.int_]) -> Array:
    """Return, of some edges, the difference of their dates in their own columns of a matrix ``(T, n)``."""
    columns = np.arange(len(index))
    return np.asarray(matrix[edges.first[index], columns] - matrix[edges.second[index], columns])


def _weighed(total: Array, own: Array) -> Array:
    """Return the variances of which weights are the inverse."""
    return np.asarray(np.maximum(own + _LEAST * (total - own), 1e-12))


def solve(
    edges: Edges,
    trends: Trends,
    components: ErrorComponents,
    place: Array,
    accepted: NDArray[np.bool_],
    sloped: NDArray[np.bool_],
) -> Network:
    """Return the corrections of dates, with slopes of those that are `sloped` ``(T,)``; the mean shift is zero."""
    dates, terms = len(sloped), trends.design.shape[1]
    index = np.flatnonzero(accepted)
    some = edges.select(index)
    kept = replace(trends, **{name: getattr(trends, name)[index] for name in ("weights", "value", "residual", "used")})
    limited = replace(components, factor=components.factor[index])
    part = _parts(edges.incidence(dates), accepted)
    free = np.zeros((dates, 3), dtype=bool)
    free[:, 0] = True
    free[:, 1:] = sloped[:, None] & (terms == 3)
    columns = np.flatnonzero(free.ravel())
    design = sparse.kron(some.incidence(dates), np.eye(terms, 3)).tocsr()[:, columns]
    value, covariance = np.zeros((dates * 3, 2)), np.zeros((2, dates * 3, dates * 3))
    datum = _datum(part, free)[:, columns]
    # Without an accepted edge, each date is a part of its own.
    for axis in (0, 1) if len(index) else ():
        sigma, own = limited.covariance(axis, some, kept, place)
        weight = _block_weights(sigma, own)
        scaled = weight @ design
        normal = (design.T @ scaled).toarray()
        level = float(np.trace(normal)) / len(normal)
        gain = (scaled @ np.linalg.inv(normal + level * datum.T @ datum)).T
        value[columns, axis] = gain @ kept.value[:, :, axis].ravel()
        covariance[axis][np.ix_(columns, columns)] = gain @ (sigma @ gain.T)
    return Network(value.reshape(dates, 3, 2), covariance, part)


def _datum(part: NDArray[np.int_], free: NDArray[np.bool_]) -> Array:
    """Return rows ``(n, 3 T)`` of what no edge determines: the mean of terms of connected dates that are all free."""
    rows = []
    for number in range(int(part.max()) + 1):
        here = part == number
        for term in range(3):
            if free[here, term].all():
                row = np.zeros(free.shape)
                row[here, term] = 1.0 / np.sqrt(here.sum())
                rows.append(row.ravel())
    return np.array(rows)


def _block_weights(sigma: sparse.csr_matrix, own: Array) -> sparse.csr_matrix:
    count, terms = own.shape[:2]
    index = np.arange(count * terms).reshape(count, terms)
    rows, columns = np.repeat(index, terms, axis=1).ravel(), np.tile(index, (1, terms)).ravel()
    total = np.asarray(sigma[rows, columns]).reshape(count, terms, terms)
    blocks = np.linalg.inv(own + _LEAST * (total - own) + 1e-12 * np.eye(terms))
    return sparse.csr_matrix((blocks.ravel(), (rows, columns)), shape=sigma.shape)
