"""Steps: times from which all dates are displaced relative to the dates before, such as by another processing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher

from ortho_pipeline.models.base import Array

#: Chance of a false alarm in a stack without steps.
_CHANCE = 0.005
#: Dates on each side, at least and at most.
_FEWEST, _MOST = 4, 30
#: The part of a sample that a median of deviations is worth, and the sigmas at which single dates are clipped.
_WORTH, _CLIP = 0.37, 3.0


@dataclass(frozen=True)
class DateStep:
    """A step: the first date after it, its size (px) along both axes with sigmas, and its chance by accident."""

    date: int
    size: tuple[float, float]
    sigma: tuple[float, float]
    chance: float


def steps_of(value: Array, covariance: Array) -> list[DateStep]:
    """Return the steps of shifts ``(T, 2)`` in order of time, with covariances ``(2, T, T)``.

    Shifts scatter from date to date. Their scatter is estimated from differences of neighbours, most of which no step
    has.
    """
    if len(value) < 2 * _FEWEST:
        return []
    scatter = (1.4826 * np.median(np.abs(np.diff(value, axis=0)), axis=0)) ** 2 / 2
    freedom = 2 * _WORTH * (len(value) - 1)
    found: list[DateStep] = []
    segments = [(0, len(value))]
    while segments:
        low, high = segments.pop()
        tries = [
            _at(value, covariance, scatter, low, at, high, freedom) for at in range(low + _FEWEST, high - _FEWEST + 1)
        ]
        best = min(tries, key=lambda one: one.chance, default=None)
        if best is not None and best.chance < _CHANCE / len(value):
            found.append(best)
            segments += [(low, best.date), (best.date, high)]
    return sorted(found, key=lambda one: one.date)


def _at(value: Array, covariance: Array, scatter: Array, low: int, at: int, high: int, freedom: float) -> DateStep:
    """Return the step between the dates before and after a time."""
    before, after = np.arange(max(low, at - _MOST), at), np.arange(at, min(high, at + _MOST))
    contrast = np.zeros(len(value))
    contrast[before], contrast[after] = -1.0 / len(before), 1.0 / len(after)
    size = _level(value[after], scatter) - _level(value[before], scatter)
    known = (contrast @ covariance * contrast).sum(axis=1)
    variance = scatter * (1.0 / len(before) + 1.0 / len(after)) + known
    ratio = float((size**2 / np.maximum(variance, 1e-12)).sum()) / 2
    sigma = np.sqrt(variance)
    return DateStep(
        at, (float(size[0]), float(size[1])), (float(sigma[0]), float(sigma[1])), float(fisher.sf(ratio, 2, freedom))
    )


def _level(value: Array, scatter: Array) -> Array:
    """Return the mean of shifts ``(n, 2)``, of which single ones far from the median count little."""
    middle, reach = np.median(value, axis=0), _CLIP * np.sqrt(scatter)
    return np.asarray(np.clip(value, middle - reach, middle + reach).mean(axis=0))
