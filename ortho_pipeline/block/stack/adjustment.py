"""The adjustment of a stack: edges in, corrections of dates out, with moving ground, wrong edges and steps found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ortho_pipeline.block.stack.common_changes import CommonChanges
from ortho_pipeline.block.stack.components import ErrorComponents, components_of
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.moving import Left, Motion, left_of, motion_of
from ortho_pipeline.block.stack.network import Closures, Network, accepted_edges, solve
from ortho_pipeline.block.stack.parts import DatePart, has_two, parts_of
from ortho_pipeline.block.stack.steps import DateStep, steps_of
from ortho_pipeline.block.stack.trends import Trends, design_of, trends_of
from ortho_pipeline.models.base import Array

#: Rounds of finding moving ground and leaving it out.
_ROUNDS = 5
#: Slopes of a date are justified at this chance (over all dates), and if they move a corner by so many px.
_CHANCE, _LEAST = 1e-3, 0.05


@dataclass(frozen=True, eq=False)
class AdjustedStack:
    """An adjusted stack; lengths in px of its grid.

    Parameters
    ----------
    network : Network
        Corrections relative to the datum. A date shows ground displaced by its correction.
    determined : (T,) of bool
        Dates that accepted edges connect with the datum.
    sloped : (T,) of bool
        Dates with an affine correction; that of all others is a shift.
    before, closures : Closures
        Of edges as they were measured, and with the last components.
    """

    cells: Cells
    edges: Edges
    network: Network
    components: ErrorComponents
    trends: Trends
    closures: Closures
    motion: Motion
    steps: tuple[DateStep, ...]
    parts: tuple[DatePart, ...]
    determined: NDArray[np.bool_]
    sloped: NDArray[np.bool_]

    @property
    def sigma(self) -> Array:
        """Standard deviations ``(T, 2)`` of the shifts at the middle; NaN of dates that are not determined."""
        variance = np.array([np.diag(one)[::3] for one in self.network.covariance]).T
        return np.where(self.determined[:, None], np.sqrt(np.maximum(variance, 0.0)), np.nan)

    def at(self, place: Array) -> tuple[Array, Array]:
        """Return corrections ``(T, n, 2)`` at places ``(n, 2)`` px, and their standard deviations."""
        terms = design_of((place - self.cells.middle) / self.cells.half, 3)
        value = np.einsum("nm,tmc->tnc", terms, self.network.value)
        blocks = self.network.covariance.reshape(2, len(value), 3, len(value), 3)
        own = np.einsum("ctmtk->tcmk", blocks)
        variance = np.einsum("nm,tcmk,nk->tnc", terms, own, terms)
        return value, np.sqrt(np.maximum(variance, 0.0))

    def sigma_between(self, one: int, other: int) -> Array:
        """Return the standard deviations ``(2,)`` of the shift of a date relative to another one."""
        i, j, covariance = 3 * one, 3 * other, self.network.covariance
        return np.sqrt(np.maximum(covariance[:, i, i] + covariance[:, j, j] - 2 * covariance[:, i, j], 0.0))


def adjust(
    cells: Cells, edges: Edges, years: Sequence[float], datum: int | None = None, *, affine: bool = True
) -> AdjustedStack:
    """Adjust a stack.

    Parameters
    ----------
    years : (T,)
        Times of the dates in order; NaN of one without a time, such as a reference.
    datum : int, optional
        The date whose correction is zero. Default: the mean of all dates.
    affine : bool
        Let dates have an affine correction where it is significant.
    """
    times, place = np.asarray(years, dtype=float), cells.place
    dates = len(times)
    one, three = design_of(place, 1), design_of(place, 3)
    none = np.zeros(dates, dtype=bool)
    stable = np.ones(len(place), dtype=bool)
    for _ in range(_ROUNDS):
        solved = _Solved.of(edges, one, place, stable, none)
        motion = motion_of(solved.left(times), times, steady=True)
        if (~motion.moving == stable).all():
            break
        stable = ~motion.moving
    sloped = _sloped(edges, three, place, stable, dates) if affine else none
    if sloped.any():
        left = solved.left(times)
        sloped &= [not (slopes and has_two(left, date, stable, three)) for date, slopes in enumerate(sloped)]
    for _ in range(_ROUNDS):
        solved = _Solved.of(edges, three if sloped.any() else one, place, stable, sloped)
        motion = motion_of(solved.left(times), times)
        if (~motion.moving == stable).all():
            break
        stable = ~motion.moving
    return _referred(cells, solved, motion, times, datum, sloped)


@dataclass(frozen=True, eq=False)
class _Solved:
    """A network, and what it was made of."""

    edges: Edges
    trends: Trends
    components: ErrorComponents
    closures: Closures
    network: Network

    @classmethod
    def of(
        cls, edges: Edges, design: Array, place: Array, stable: NDArray[np.bool_], sloped: NDArray[np.bool_]
    ) -> _Solved:
        trends = trends_of(edges, design, stable)
        components = components_of(edges, trends, place, len(sloped))
        closures, components = accepted_edges(edges, trends, components, place, len(sloped))
        network = solve(edges, trends, components, place, closures.accepted, sloped)
        return cls(edges, trends, components, closures, network)

    def linked(self, years: Array) -> NDArray[np.bool_]:
        """Return which dates with a time ``(T,)`` accepted edges compare with one without; all of them if none."""
        known, ends = np.isfinite(years), np.stack([self.edges.first, self.edges.second])
        some = self.closures.accepted & (known[ends].sum(axis=0) == 1)
        found = known & np.isin(np.arange(len(years)), ends[:, some])
        return np.asarray(found if found.any() else known)

    def left(self, years: Array) -> Left:
        """Return what the network leaves of accepted edges."""
        terms = self.trends.design.shape[1]
        apart = self.network.value[self.edges.first] - self.network.value[self.edges.second]
        predicted = self.trends.design @ apart[:, :terms]
        return left_of(self.edges, predicted, self.components, self.closures.accepted, years)


def _sloped(edges: Edges, design: Array, place: Array, stable: NDArray[np.bool_], dates: int) -> NDArray[np.bool_]:
    """Return which dates need slopes: significant against most dates, and of a size that matters."""
    solved = _Solved.of(edges, design, place, stable, np.ones(dates, dtype=bool))
    if not solved.closures.accepted.any():
        return np.zeros(dates, dtype=bool)
    slopes = solved.network.value[:, 1:]
    slopes = slopes - np.median(slopes, axis=0)
    ratio = np.zeros(dates)
    for date in range(dates):
        for axis in (0, 1):
            block = solved.network.covariance[axis, 3 * date + 1 : 3 * date + 3, 3 * date + 1 : 3 * date + 3]
            size = slopes[date, :, axis]
            ratio[date] += size @ np.linalg.solve(block + 1e-12 * np.eye(2), size)
    corner = np.hypot(*np.abs(slopes).sum(axis=1).T)
    return np.asarray((ratio > chi2.isf(_CHANCE / dates, 4)) & (corner > _LEAST))


def _referred(
    cells: Cells, solved: _Solved, motion: Motion, years: Array, datum: int | None, sloped: NDArray[np.bool_]
) -> AdjustedStack:
    """Return a stack with its datum."""
    left = solved.left(years)
    changes = CommonChanges(left, solved.edges, solved.trends, solved.components, cells.place, years)
    of_seasons = solved.components.of_seasons(solved.edges.alike[solved.trends.good])
    found = solved.network.with_seasons(of_seasons, changes.yearly_variances(), years)
    touched = motion.touched(cells)
    drift = changes.drift(touched, solved.linked(years))
    found = found.with_drift(drift.rate, drift.variance, drift.time)
    motion = replace(motion, sigma=np.hypot(motion.sigma, np.sqrt(drift.variance)))
    known = np.isfinite(years)
    part = found.part
    if datum is None:
        number = int(np.bincount(part).argmax())
        weights = (part == number) / max(int((part == number).sum()), 1)
        network = found.relative_to(weights, 3 if sloped[part == number].all() else 1)
    else:
        number = int(part[datum])
        network = found.relative_to(np.eye(len(years))[datum])
    determined = part == number
    value = np.where(determined[:, None, None], network.value, 0.0)
    network = replace(network, value=value)
    order = np.flatnonzero(determined & known)
    shifts = network.covariance[:, 3 * order][:, :, 3 * order]
    steps = tuple(replace(one, date=int(order[one.date])) for one in steps_of(value[order, 0], shifts))
    still, design = motion.tested & ~touched, design_of(cells.place, 3)
    parts = tuple(one for one in parts_of(cells, left, still, design) if determined[one.date])
    return AdjustedStack(
        cells, solved.edges, network, solved.components, solved.trends, solved.closures, motion, steps, parts,
        determined, sloped if datum is None else sloped | bool(sloped[datum]),
    )  # fmt: skip
