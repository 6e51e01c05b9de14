r"""Errors that the dates of one season share: they close all loops, so the network cannot show them.

The ground looks different through the year, and its looks displace matches alike in all years. What does not move the
mean of the places is seen: a place has a wave of one year, :math:`a \cos 2\pi t + b \sin 2\pi t`, that other places do
not have. How much these waves vary from place to place, and how far neighbours share them, gives the variance of their
mean, which displaces the dates. Errors of dates and of edges are part of the expected products.

Source: Cressie 1993, section 2.4 (moments of a variogram); Lawson and Hanson 1974 (non-negative least squares).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import optimize

from ortho_pipeline.block.stack.components import WAVES, ErrorComponents, classes_of, correlations_of
from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.moving import WAVE, Left
from ortho_pipeline.block.stack.trends import Trends
from ortho_pipeline.models.base import Array

#: A wave is determined if so much (root mean square; 0.7 of all phases) is left of it without a constant and a rate.
_LEFT = 0.3


def yearly_variances(
    left: Left, edges: Edges, trends: Trends, components: ErrorComponents, place: Array, years: Array
) -> Array:
    """Return the variances ``(2, 2)`` px² of the mean of all places: waves of a year and of half a year, both axes.

    They are zero if the dates span less than one and a half years, because seasons do not repeat then, and if all dates
    have the same phase of a wave, because it moves all of them alike.
    """
    found, known = np.zeros((len(WAVES), 2)), np.isfinite(years)
    usual = trends.weights[trends.good, :, 0].mean(axis=0) if trends.good.any() else np.zeros(len(place))
    seen = np.flatnonzero((usual > 0) & left.tested)
    if not len(seen) or not known.any() or np.ptp(years[known]) < WAVE:
        return found
    weight = usual[seen] / usual[seen].sum()
    centred = np.eye(len(seen)) - weight
    classes = classes_of(place[seen]).ravel()
    relative = np.diag(edges.relative[trends.good][:, seen].mean(axis=0))
    matrices = np.concatenate([relative[None], correlations_of(place[seen])])
    expected = np.stack([np.bincount(classes, (centred @ one @ centred.T).ravel()) for one in matrices], axis=1)
    size, of_mean = np.maximum(np.linalg.norm(expected, axis=0), 1e-12), matrices @ weight @ weight
    without = replace(left, value=left.change(np.where(known, years, 0.0))[2])
    root = np.sqrt(without.noisier[seen])
    shared, single = (np.tensordot(of, matrices, 1) for of in (components.shared, components.own))
    for row, number in enumerate(WAVES):
        forms, products = _forms(number, years), np.zeros((2, len(expected)))
        for form in forms:
            apart = centred @ without.change(form)[0][seen]
            shares, of_dates = (one[:, seen] for one in left.shares(form))
            dates = of_dates.T @ (components.scale[:, None] * of_dates)
            own = shares.T @ (components.factor[:, None] * shares)
            for axis in (0, 1):
                noise = dates * shared[axis] + own * single[axis]
                rest = np.outer(apart[:, axis], apart[:, axis]) - centred @ (noise * np.outer(root, root)) @ centred.T
                products[axis] += np.bincount(classes, rest.ravel()) / len(forms)
        for axis in (0, 1):
            found[row, axis] = of_mean @ (optimize.nnls(expected / size, products[axis])[0] / size)
    return found


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
