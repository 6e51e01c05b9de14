r"""Errors that change with time alike in all edges: they close all loops, so the network cannot show them.

The ground looks different through the year, and its looks displace matches alike in all years. What does not move the
mean of the places is seen: a place has a wave of one year, :math:`a \cos 2\pi t + b \sin 2\pi t`, that other places do
not have. How much these waves vary from place to place, and how far neighbours share them, gives the variance of their
mean, which displaces the dates. Errors of dates and of edges are part of the expected products.

A chip at the rim of moving ground shows a part of its motion. That part is too small to be found. Many such places
together move all dates at a steady rate. So the rate of the corrections is that of the places that are not next to
moving ground. How much the rates of these differ gives its variance in the same way.

Source: Cressie 1993, section 2.4 (moments of a variogram); Lawson and Hanson 1974 (non-negative least squares).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from ortho_pipeline.block.stack.components import WAVES, ErrorComponents, classes_of, correlations_of
from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.moving import WAVE, Left
from ortho_pipeline.block.stack.trends import FEWEST, Trends
from ortho_pipeline.models.base import Array

#: A wave is determined if so much (root mean square; 0.7 of all phases) is left of it without a constant and a rate.
_LEFT = 0.3


@dataclass(frozen=True, eq=False)
class Drift:
    """The rate of stable ground relative to the corrections.

    Parameters
    ----------
    rate : (2,)
        px a year along columns and rows.
    variance : (2,)
        Variance of the rate. It is no part of the network's covariance.
    time : (T,)
        Years from the mean of the dates that have a link with a reference, or of all; 0 of a date without a time.
    """

    rate: Array
    variance: Array
    time: Array


@dataclass(frozen=True, eq=False)
class CommonChanges:
    """What a network leaves of its edges, and the errors that it knows of.

    Parameters
    ----------
    years : (T,)
        NaN of a date without a time, such as a reference.
    """

    left: Left
    edges: Edges
    trends: Trends
    components: ErrorComponents
    place: Array
    years: Array

    def yearly_variances(self) -> Array:
        """Return the variances ``(2, 2)`` px² of the mean of all places: waves of a year and half a year, both axes.

        They are zero if the dates span less than one and a half years, because seasons do not repeat then, and if all
        dates have the same phase of a wave, because it moves all of them alike.
        """
        found, known, weight = np.zeros((len(WAVES), 2)), np.isfinite(self.years), self._weight
        if not weight.any() or not known.any() or np.ptp(self.years[known]) < WAVE:
            return found
        without = replace(self.left, value=self.left.change(np.where(known, self.years, 0.0))[2])
        for row, number in enumerate(WAVES):
            amounts = [self._amount(without, form) for form in _forms(number, self.years)]
            found[row] = self._variance_of_mean(amounts, weight)
        return found

    def drift(self, touched: NDArray[np.bool_], linked: NDArray[np.bool_]) -> Drift:
        """Return the drift without the places ``(K,)`` that motion has `touched`; if too few are left, all count.

        Dates that are `linked` ``(T,)`` with a reference keep their place relative to it, on average.
        """
        known, weight = np.isfinite(self.years), self._weight
        time = np.where(known, self.years - self.years[linked].mean(), 0.0)
        if not weight.any():
            return Drift(np.zeros(2), np.zeros(2), time)
        far = np.where(touched, 0.0, weight)
        far = far / far.sum() if (far > 0).sum() >= FEWEST else weight
        more, (rate, noise) = far - weight, self._amount(self.left, time)
        return Drift(more @ rate, noise @ more @ more + self._variance_of_mean([(rate, noise)], far), time)

    @functools.cached_property
    def _weight(self) -> Array:
        """Part of each place ``(K,)`` in the corrections of dates; its sum is 1, or 0 without an edge."""
        good = self.trends.good
        usual = self.trends.weights[good, :, 0].mean(axis=0) if good.any() else np.zeros(len(self.place))
        usual = np.where((self.left.weight > 0).any(axis=0) & (usual > 0), usual, 0.0)
        return np.asarray(usual / max(usual.sum(), 1e-300))

    @functools.cached_property
    def _correlations(self) -> Array:
        """Correlations ``(7, K, K)`` of errors of places: noise, and those of all ranges."""
        noisy = np.diag(self.edges.relative[self.trends.good].mean(axis=0))
        return np.concatenate([noisy[None], correlations_of(self.place)])

    def _amount(self, left: Left, form: Array) -> tuple[Array, Array]:
        """Return how much of a form places have ``(K, 2)``, and the covariances ``(2, K, K)`` of its known errors."""
        shares, of_dates = left.shares(form)
        dates = of_dates.T @ (self.components.scale[:, None] * of_dates)
        own = shares.T @ (self.components.factor[:, None] * shares)
        shared, single = (
            np.tensordot(of, self._correlations, 1) for of in (self.components.shared, self.components.own)
        )
        root = np.sqrt(left.noisier)
        return left.change(form)[0], (dates * shared + own * single) * np.outer(root, root)

    def _variance_of_mean(self, amounts: list[tuple[Array, Array]], weight: Array) -> Array:
        """Return the variance ``(2,)`` of the mean with weights ``(K,)`` of amounts, which places share in part.

        Products of noisy places count less.
        """
        seen = np.flatnonzero(weight)
        weight = weight[seen]
        centred, matrices = np.eye(len(seen)) - weight, self._correlations[:, seen][:, :, seen]
        classes, found = classes_of(self.place[seen]).ravel(), np.zeros(2)
        spread = [(centred @ one @ centred.T).ravel() for one in matrices]
        number, of_mean = classes.max() + 1, matrices @ weight @ weight
        for axis in (0, 1):
            products, expected = np.zeros(number), np.zeros((number, len(spread)))
            for size, noise in amounts:
                known, apart = noise[axis][seen][:, seen], centred @ size[seen, axis]
                counts = _counts(known.diagonal()).ravel()
                products += np.bincount(
                    classes, counts * (np.outer(apart, apart) - centred @ known @ centred.T).ravel()
                )
                expected += np.stack([np.bincount(classes, counts * one) for one in spread], axis=1)
            length = np.maximum(np.linalg.norm(expected, axis=0), 1e-12)
            found[axis] = of_mean @ (optimize.nnls(expected / length, products)[0] / length)
        return found


def _counts(variance: Array) -> Array:
    """Return how much the products ``(n, n)`` of places with such noise ``(n,)`` count, at most 1."""
    if not variance.any():
        return np.ones((len(variance), len(variance)))
    inverse = np.divide(1.0, np.sqrt(variance), out=np.zeros(len(variance)), where=variance > 0)
    return np.outer(inverse, inverse) / inverse.max() ** 2


def _forms(number: int, years: Array) -> list[Array]:
    """Return cosine and sine ``(T,)`` of a wave without a constant, a rate and each other, if enough is left."""
    known = np.isfinite(years)
    time = years[known] - years[known].mean()
    taken, found = [np.ones(len(time)), time], list[Array]()
    for wave in (np.cos, np.sin):
        course = wave(2 * np.pi * number * time)
        course = course - np.column_stack(taken) @ np.linalg.lstsq(np.column_stack(taken), course, rcond=None)[0]
        if np.sqrt((course**2).mean()) > _LEFT:
            taken.append(course)
            found.append(np.zeros(len(years)))
            found[-1][known] = course
    return found
