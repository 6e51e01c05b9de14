"""Variances of seasons and drift from products of places, against the sums that define them, with few places."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.optimize import nnls

from ortho_pipeline.block.stack.common_changes import CommonChanges
from ortho_pipeline.block.stack.components import ErrorComponents
from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.moving import Left, left_of
from ortho_pipeline.block.stack.trends import Trends, design_of, trends_of

DATES, PLACES = 18, 15
RANGES, LIMITS = (0.2, 0.5, 1.25), (1e-6, 0.18, 0.3, 0.45, 0.65, 0.9, 1.2, 1.6, 3.0)
FIRST, SECOND = np.array([(i, i - k) for i in range(DATES) for k in (1, 2, 4) if k <= i]).T
#: The last date has no time.
YEARS = np.append(np.sort(np.random.default_rng(2).uniform(50.0, 52.6, DATES - 1)), np.nan)
#: Two places are not stable, one is seen by three edges alone; one edge has three places.
UNSTABLE, RARE, SHORT = (3, 9), 6, 20


def changes(left: Left, edges: Edges, trends: Trends, errors: ErrorComponents, place: np.ndarray) -> CommonChanges:
    return CommonChanges(left, edges, trends, errors, place, YEARS)


def made(noise: float) -> tuple[Left, Edges, Trends, ErrorComponents, np.ndarray]:
    """Return edges of places with waves of a year and noise, and what a network of no shifts leaves of them."""
    random = np.random.default_rng(11)
    place = random.uniform(-1, 1, (PLACES, 2))
    phase = 2 * np.pi * np.nan_to_num(YEARS, nan=50.0)
    of_dates = np.cos(phase)[:, None, None] * random.normal(0, 0.4, (PLACES, 2)) * (1.0, 0.5)
    of_dates += np.sin(2 * phase + 0.3)[:, None, None] * random.normal(0, 0.3, (PLACES, 2))
    of_dates += np.nan_to_num(YEARS, nan=50.0)[:, None, None] * random.normal(0, 0.2, (PLACES, 2))
    value = of_dates[FIRST] - of_dates[SECOND] + random.normal(0, noise, (len(FIRST), PLACES, 2))
    value[np.setdiff1d(np.arange(len(FIRST)), (4, 17, 30)), RARE] = np.nan
    value[SHORT, 3:] = np.nan
    edges = Edges(FIRST, SECOND, value, random.uniform(0.01, 0.04, value.shape[:2]), np.zeros(len(FIRST)))
    stable = ~np.isin(np.arange(PLACES), UNSTABLE)
    trends = trends_of(edges, design_of(place, 1), stable)
    errors = ErrorComponents(
        0.002 * random.uniform(0.1, 1, (2, 7)), 0.002 * random.uniform(0.1, 1, (2, 7)), random.uniform(0.5, 2, DATES),
        random.uniform(0.5, 2, len(FIRST)), np.zeros(2),
    )  # fmt: skip
    left = left_of(edges, np.zeros(value.shape), errors, np.ones(len(FIRST), dtype=bool), YEARS)
    return left, edges, trends, errors, place


def forms_of(number: int) -> list[np.ndarray]:
    """Return cosine and sine without their parts along the terms before them, of dates with a time."""
    known = np.isfinite(YEARS)
    time = YEARS[known]
    basis = np.linalg.qr(
        np.column_stack([np.ones(len(time)), time - 51, np.cos(2 * np.pi * number * (time - time.mean())),
                         np.sin(2 * np.pi * number * (time - time.mean()))])
    )  # fmt: skip
    found = []
    for column in (2, 3):
        form = np.zeros(DATES)
        form[known] = basis[0][:, column] * basis[1][column, column]
        found.append(form)
    return found


def kernels(place: np.ndarray, relative: np.ndarray) -> np.ndarray:
    far = np.linalg.norm(place[:, None] - place, axis=2)
    smooth = [np.exp(-far / one) for one in RANGES] + [np.exp(-((far / one) ** 2)) for one in RANGES]
    return np.array([np.diag(relative), *smooth])


def noise_of(left: Left, edges: Edges, errors: ErrorComponents, every: np.ndarray, form: np.ndarray) -> np.ndarray:
    """Return the covariances ``(2, K, K)`` of how much of a form places have."""
    incidence = edges.incidence(DATES).toarray()
    apart = form[FIRST] - form[SECOND]
    gain = left.weight * apart[:, None] / np.maximum((left.weight * apart[:, None] ** 2).sum(axis=0), 1e-9)
    of_dates = (incidence.T @ gain).T @ np.diag(errors.scale) @ (incidence.T @ gain)
    of_edges = gain.T @ np.diag(errors.factor) @ gain
    root = np.sqrt(left.noisier)
    assert root.max() > 1.2
    found = [
        of_dates * np.tensordot(errors.shared[axis], every, 1) + of_edges * np.tensordot(errors.own[axis], every, 1)
        for axis in (0, 1)
    ]
    return np.array(found) * np.outer(root, root)


def variance_of_mean(
    left: Left, noise: list[np.ndarray], forms: list[np.ndarray], every: np.ndarray, place: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the variances ``(2,)`` of a mean with weights that the products of places fit."""
    seen = np.flatnonzero(weight)
    weight, every = weight[seen], every[:, seen][:, :, seen]
    far = np.linalg.norm(place[seen][:, None] - place[seen], axis=2)
    classes = np.array([[sum(limit < one for limit in LIMITS) for one in row] for row in far])
    centred = np.eye(len(seen)) - np.outer(np.ones(len(seen)), weight)
    found = np.zeros(2)
    for axis in (0, 1):
        products, expected = np.zeros(len(LIMITS) + 1), np.zeros((len(LIMITS) + 1, len(every)))
        for form, noisy in zip(forms, noise, strict=True):
            known = noisy[axis][np.ix_(seen, seen)]
            size = left.change(form)[0][seen, axis]
            size = size - weight @ size
            whole = np.outer(size, size) - centred @ known @ centred.T
            counts = known.diagonal().min() / np.sqrt(np.outer(known.diagonal(), known.diagonal()))
            for which in range(len(products)):
                here = classes == which
                products[which] += (counts * whole)[here].sum()
                expected[which] += [(counts * (centred @ one @ centred.T))[here].sum() for one in every]
        found[axis] = nnls(expected, products)[0] @ [weight @ one @ weight for one in every]
    return found


def seen_by(left: Left, edges: Edges, trends: Trends, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of places in the mean, and their correlations."""
    usual = trends.weights[trends.good][:, :, 0].mean(axis=0)
    assert not trends.good[SHORT]
    assert trends.good.sum() == len(FIRST) - 1
    assert (usual[list(UNSTABLE)] == 0).all()
    assert usual[RARE] > 0
    return usual / usual.sum(), kernels(place, edges.relative[trends.good].mean(axis=0))


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_variances_are_those_whose_products_the_waves_of_places_have(noise: float) -> None:
    left, edges, trends, errors, place = made(noise)
    weight, every = seen_by(left, edges, trends, place)
    without = dataclasses.replace(left, value=left.change(np.nan_to_num(YEARS))[2])
    wanted = []
    for number in (1, 2):
        forms = forms_of(number)
        noisy = [noise_of(without, edges, errors, every, form) for form in forms]
        wanted.append(variance_of_mean(without, noisy, forms, every, place, weight))
    assert (np.array(wanted) > 0).all()
    found = changes(left, edges, trends, errors, place).yearly_variances()
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


@pytest.mark.parametrize("touched", [(), (0, 5, 7), range(1, PLACES)])
def test_the_drift_is_that_of_places_that_no_motion_touches(touched: Sequence[int]) -> None:
    """With too few such places all count, and there is no drift."""
    left, edges, trends, errors, place = made(0.3)
    weight, every = seen_by(left, edges, trends, place)
    linked = np.isin(np.arange(DATES), (13, 15, 16))
    time = np.nan_to_num(YEARS - YEARS[linked].mean())
    away = np.isin(np.arange(PLACES), list(touched), invert=True)
    far = weight * away / (weight * away).sum() if len(touched) < 6 else weight
    noisy = noise_of(left, edges, errors, every, time)
    wanted = variance_of_mean(left, [noisy], [time], every, place, far)
    wanted = wanted + [(far - weight) @ one @ (far - weight) for one in noisy]
    found = changes(left, edges, trends, errors, place).drift(~away, linked)
    assert (found.variance > 0).all()
    np.testing.assert_allclose(found.variance, wanted, rtol=1e-6)
    np.testing.assert_allclose(found.rate, (far - weight) @ left.change(time)[0], atol=1e-12)
    np.testing.assert_allclose(found.time, time, atol=1e-12)
    assert found.rate.any() == (len(touched) == 3)


def test_dates_of_one_year_and_a_half_see_seasons_and_fewer_do_not() -> None:
    left, edges, trends, errors, place = made(0.0)
    known = YEARS[:-1]
    for span, sees in ((1.49, False), (1.51, True)):
        years = np.append(50.0 + (known - known.min()) / np.ptp(known) * span, np.nan)
        found = dataclasses.replace(changes(left, edges, trends, errors, place), years=years)
        assert (found.yearly_variances() > 0).any() == sees


def test_without_an_edge_that_has_a_trend_nothing_is_seen() -> None:
    left, edges, trends, errors, place = made(0.0)
    nothing = dataclasses.replace(trends, used=np.zeros_like(trends.used))
    found = changes(left, edges, nothing, errors, place)
    np.testing.assert_array_equal(found.yearly_variances(), 0.0)
    drift = found.drift(np.zeros(PLACES, dtype=bool), np.isfinite(YEARS))
    np.testing.assert_array_equal([drift.rate, drift.variance], 0.0)
