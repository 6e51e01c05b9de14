"""Moving ground: places whose displacement changes over time beyond its sigma.

What the network leaves at a place is compared with changes over time of some forms: steady, a step at one time, a
wave of one year. The majority of places is stable by definition: a place moves if it differs from the rate that most
places share. Sigmas include the errors that edges with a common date share at a place, and noisier places have larger
ones. Nothing shows whether these errors change from date to date or with the season, so the larger variance counts.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.stats import chi2

from ortho_pipeline.block.stack.components import ErrorComponents, season_correlation
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.trends import median_of
from ortho_pipeline.models.base import Array

#: Chance that a stable place is found to move, over all forms.
_CHANCE = 1e-3
#: Less than so many px over the whole time is no motion.
LEAST = 0.1
#: A place needs so many edges; steps are tried at so many times.
_FEWEST, _STEPS = 4, 10
#: Squared sigmas within which places share a rate.
_ALIKE = 9.2
#: An area of so many cells touches its neighbours (fewer can be found by chance). What is next to a cell.
AREA, NEXT = 4, np.ones((3, 3))
#: Seasons repeat if the dates span so many years.
WAVE = 1.5
#: A step has so many dates on each side. What is left is clipped at so many sigmas, so many times.
_BESIDE, _CLIP, _CLIPPED = 4, 2.5, 4


@dataclass(frozen=True, eq=False)
class Motion:
    """What moves.

    Parameters
    ----------
    moving, tested : (K,) of bool
    rate, sigma : (K, 2)
        px a year along columns and rows, relative to the stable places.
    ratio : (K,)
        The largest squared change in units of its covariance.
    form : (K,) of str
        The form with that: steady, step, or yearly.
    """

    moving: NDArray[np.bool_]
    tested: NDArray[np.bool_]
    rate: Array
    sigma: Array
    ratio: Array
    form: NDArray[np.str_]

    def touched(self, cells: Cells) -> NDArray[np.bool_]:
        """Tell which places ``(K,)`` move, or are neighbours of a moving area: their chips show a part of it."""
        columns, rows = cells.shape
        large = np.zeros(len(self.moving), dtype=bool)
        for area in self.areas(cells):
            large[area] = len(area) >= AREA
        return np.asarray(ndimage.binary_dilation(large.reshape(rows, columns), NEXT).ravel() | self.moving)

    def areas(self, cells: Cells) -> list[NDArray[np.int_]]:
        """Return connected moving cells, largest area first."""
        columns, rows = cells.shape
        numbered, count = ndimage.label(self.moving.reshape(rows, columns), structure=NEXT)
        found = [np.flatnonzero(numbered.ravel() == number + 1) for number in range(count)]
        return sorted(found, key=lambda one: (-len(one), one[0]))

    def core(self, area: NDArray[np.int_], cells: Cells) -> NDArray[np.int_]:
        """Return the cells of an area that show how it moves: those inside, or its fastest one if all are at the rim.

        Cells next to still ground move in part, because their chips show both. The fastest one shows most of the
        motion; it is fast beyond its 95 % interval, because noise makes cells fast, too.
        """
        columns, rows = cells.shape
        still = (self.tested & ~self.moving).reshape(rows, columns)
        inner = area[~ndimage.binary_dilation(still, NEXT).ravel()[area]]
        fast = np.hypot(*self.rate[area].T) - 1.96 * self.sigma[area].max(axis=1)
        return inner if len(inner) else area[[int(fast.argmax())]]

    def typical(self, area: NDArray[np.int_], cells: Cells) -> tuple[Array, float, float]:
        """Return the rate ``(2,)`` of an area, its sigma along an axis (px a year) and its ratio: medians of its core.

        Neighbours share errors, so the median is no more certain than one cell.
        """
        some = self.core(area, cells)
        ratio = float(np.median(self.ratio[some]))
        return np.median(self.rate[some], axis=0), float(np.median(self.sigma[some])), ratio


@dataclass(frozen=True, eq=False)
class Left:
    """What the network leaves of edges, with the variances of it."""

    value: Array  # (E, K, 2), 0 where nothing is
    weight: Array  # (E, K)
    own: Array  # (E, K)
    shared: Array  # (K,)
    scale: Array  # (T,)
    alike: Array  # (T, T), correlations of errors of dates that depend on the season
    first: NDArray[np.int_]
    second: NDArray[np.int_]

    @property
    def tested(self) -> NDArray[np.bool_]:
        """Which places ``(K,)`` enough edges see."""
        return np.asarray((self.weight > 0).sum(axis=0) >= _FEWEST)

    @functools.cached_property
    def noisier(self) -> Array:
        """By how much the variance of each place ``(K,)`` is larger than the one of most."""
        return _noisier(*self._placed)

    @functools.cached_property
    def _placed(self) -> tuple[Array, Array]:
        """Values ``(K, 2, E)`` and weights ``(K, E)``."""
        return _by_place(self.value), _by_place(self.weight)

    def at(self, some: NDArray[np.bool_]) -> Left:
        """Return the same of some places."""
        value, weight, own = (array[:, some] for array in (self.value, self.weight, self.own))
        return replace(self, value=value, weight=weight, own=own, shared=self.shared[some])

    def change(self, form: Array) -> tuple[Array, Array, Array]:
        """Return how much of a form ``(T,)`` each place has ``(K, 2)``, its variance ``(K,)`` and what is left."""
        apart = form[self.first] - form[self.second]
        shares, of_dates = self.shares(form)
        (value, weight), part = self._placed, _by_place(shares)
        size = np.einsum("ke,kce->kc", part, value)
        for _ in range(_CLIPPED):
            # A cloud that was matched at a few dates must not look like motion.
            rest = value - apart * size[:, :, None]
            reach = _CLIP * np.sqrt(_noisier(rest, weight)[:, None] / np.maximum(weight, 1e-12))[:, None]
            size = size + np.einsum("ke,kce->kc", part, np.clip(rest, -reach, reach))
        scaled = np.sqrt(self.scale)[:, None] * of_dates
        of_shared = np.maximum((scaled**2).sum(axis=0), (scaled * (self.alike @ scaled)).sum(axis=0))
        variance = self.shared * of_shared + (shares**2 * self.own).sum(axis=0)
        return size, variance, self.value - apart[:, None, None] * size

    def shares(self, form: Array) -> tuple[Array, Array]:
        """Return what the errors of edges ``(E, K)`` and of dates ``(T, K)`` have in how much of a form places have."""
        apart = (form[self.first] - form[self.second])[:, None]
        shares = self.weight * apart / np.maximum((self.weight * apart**2).sum(axis=0), 1e-300)
        of_dates = np.zeros((len(self.scale), shares.shape[1]))
        np.add.at(of_dates, self.first, shares)
        np.add.at(of_dates, self.second, -shares)
        return shares, of_dates


def motion_of(
    left: Left,
    years: Array,
    *,
    steady: bool = False,
) -> Motion:
    """Return which places move.

    Parameters
    ----------
    years : (T,)
        Of the dates; NaN of a date without a time, such as a reference.
    steady : bool
        Try steady motion only.
    """
    time, tested = np.where(np.isfinite(years), years, 0.0), left.tested
    span = float(np.ptp(years[np.isfinite(years)]))
    rate, variance, rest = left.change(time)
    without = replace(left, value=rest)
    noisier = without.noisier
    sigma2 = variance * noisier
    rate = rate - _majority(rate[tested], sigma2[tested]) if tested.any() else rate
    ratio = (rate**2).sum(axis=1) / np.maximum(sigma2, 1e-300)
    size, form = np.hypot(*rate.T) * span, np.full(len(ratio), "steady", dtype="<U6")
    forms = [] if steady else _forms(time, np.isfinite(years), span)
    crit = chi2.isf(_CHANCE / (1 + len(forms)), 2)
    moving = tested & (ratio > crit) & (size > LEAST)
    for name, course in forms:
        change, variance, _ = without.change(course)
        seen = tested & (variance < 1e6)
        if not seen.any():
            continue
        change = change - np.median(change[seen & ~moving] if (seen & ~moving).any() else change[seen], axis=0)
        here = (change**2).sum(axis=1) / np.maximum(variance * noisier, 1e-300)
        found = seen & (here > crit) & (np.hypot(*change.T) > LEAST)
        if name == "step" and found.any():
            found[found] = here[found] > _of_single_date(without.at(found), course, time, noisier[found])
        better = found & (~moving | (here > ratio))
        form[better] = name
        ratio = np.where(better, here, ratio)
        moving |= found
    sigma = np.sqrt(np.maximum(sigma2, 0.0))[:, None] * np.ones(2)
    return Motion(moving, tested, rate, sigma, ratio, form)


def left_of(
    edges: Edges, network: Array, components: ErrorComponents, accepted: NDArray[np.bool_], years: Array
) -> Left:
    """Return what the network leaves of accepted edges; it predicts their values by `network` ``(E, K, 2)``."""
    timed = accepted & np.isfinite(years[edges.first] - years[edges.second])
    seen = edges.measured & timed[:, None]
    value = np.where(seen[:, :, None], np.nan_to_num(edges.value) - network, 0.0)
    shared, own = components.at_place(edges)
    scale = components.scale[edges.first] + components.scale[edges.second]
    whole = scale[:, None] * shared + own
    many = np.maximum(seen.sum(axis=0), 1)
    return Left(
        value,
        np.where(seen, 1.0 / np.maximum(whole, 1e-12), 0.0),
        own,
        np.where(seen, shared, 0.0).sum(axis=0) / many,
        components.scale,
        season_correlation(years),
        edges.first,
        edges.second,
    )


def _of_single_date(left: Left, step: Array, time: Array, noisier: Array) -> Array:
    """Return the largest ratio ``(K,)`` of a change of one date alone, of the dates next to a step ``(T,)``.

    Up to half of the edges across a step are those of one of these dates. So a part of one ortho that is displaced, as
    in a mosaic, looks like a step, too.
    """
    before, after = np.unique(time[step == 0])[-_BESIDE:], np.unique(time[step > 0])[:_BESIDE]
    ratios = []
    for date in np.flatnonzero(np.isin(time, [*before, *after])):
        change, variance, _ = left.change((np.arange(len(time)) == date).astype(float))
        ratios.append((change**2).sum(axis=1) / np.maximum(variance * noisier, 1e-300))
    return np.asarray(np.max(ratios, axis=0))


def _by_place(values: Array) -> Array:
    """Return values of edges at places ``(E, K, ...)`` as ``(K, ..., E)``, next to each other in memory."""
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))


def _noisier(rest: Array, weight: Array) -> Array:
    """Return by how much the variance of each place ``(K,)`` is larger than the one of most, from ``(K, 2, E)``."""
    square, seen = rest**2 * weight[:, None], np.greater(weight, 0.0)
    middle = median_of(square.reshape(len(weight), -1), np.tile(seen, (1, 2)))
    return np.asarray(np.maximum(middle / chi2.median(1), 1.0))


def _majority(rate: Array, variance: Array) -> Array:
    """Return the rate ``(2,)`` that most places share."""
    apart = ((rate[:, None] - rate) ** 2).sum(axis=2) / np.maximum(variance, 1e-300)
    alike = apart[int((apart < _ALIKE).sum(axis=1).argmax())] < _ALIKE
    middle = np.median(rate[alike], axis=0)
    for _ in range(5):
        alike = ((rate - middle) ** 2).sum(axis=1) / np.maximum(variance, 1e-300) < _ALIKE
        if not alike.any():
            break
        weight = 1.0 / np.maximum(variance[alike], 1e-300)
        middle = np.average(rate[alike], axis=0, weights=weight)
    return np.asarray(middle)


def _forms(time: Array, known: NDArray[np.bool_], span: float) -> list[tuple[str, Array]]:
    """Return changes over time besides a steady one."""
    times = np.unique(time[known])
    if len(times) < 2 * _BESIDE:
        return []
    inside = times[_BESIDE : len(times) - _BESIDE + 1]
    chosen = inside[np.unique(np.linspace(0, len(inside) - 1, _STEPS).round().astype(int))]
    found = [("step", (time >= one).astype(float)) for one in chosen]
    if span >= WAVE:
        found += [("yearly", 0.5 * wave(2 * np.pi * time)) for wave in (np.cos, np.sin)]
    return found
