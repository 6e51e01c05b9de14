"""Variances of seasons from products of places, against the sums that define them, with few places and dates."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import nnls

from ortho_pipeline.block.stack.components import ErrorComponents
from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.moving import Left, left_of
from ortho_pipeline.block.stack.seasons import yearly_variances
from ortho_pipeline.block.stack.trends import Trends, design_of, trends_of

DATES, PLACES = 18, 15
RANGES, LIMITS = (0.2, 0.5, 1.25), (1e-6, 0.18, 0.3, 0.45, 0.65, 0.9, 1.2, 1.6, 3.0)
FIRST, SECOND = np.array([(i, i - k) for i in range(DATES) for k in (1, 2, 4) if k <= i]).T
#: The last date has no time.
YEARS = np.append(np.sort(np.random.default_rng(2).uniform(50.0, 52.6, DATES - 1)), np.nan)
#: Two places are not stable, one is seen by three edges alone; one edge has three places.
UNSTABLE, RARE, SHORT = (3, 9), 6, 20


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


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_variances_are_those_whose_products_the_waves_of_places_have(noise: float) -> None:
    left, edges, trends, errors, place = made(noise)
    usual = trends.weights[trends.good][:, :, 0].mean(axis=0)
    seen = np.setdiff1d(np.arange(PLACES), (*UNSTABLE, RARE))
    assert not trends.good[SHORT]
    assert trends.good.sum() == len(FIRST) - 1
    assert (usual[list(UNSTABLE)] == 0).all()
    assert usual[RARE] > 0
    weight = usual[seen] / usual[seen].sum()
    centred = np.eye(len(seen)) - np.outer(np.ones(len(seen)), weight)
    every = kernels(place[seen], edges.relative[trends.good][:, seen].mean(axis=0))
    far = np.linalg.norm(place[seen][:, None] - place[seen], axis=2)
    classes = np.array([[sum(limit < one for limit in LIMITS) for one in row] for row in far])
    rate = left.change(np.nan_to_num(YEARS))[2]
    without = dataclasses.replace(left, value=rate)
    root = np.sqrt(without.noisier[seen])
    assert root.max() > 1.2
    incidence = edges.incidence(DATES).toarray()
    wanted = np.zeros((2, 2))
    for row, number in enumerate((1, 2)):
        forms = forms_of(number)
        for axis in (0, 1):
            products = np.zeros(len(LIMITS) + 1)
            for form in forms:
                apart = form[FIRST] - form[SECOND]
                gain = left.weight[:, seen] * apart[:, None]
                gain /= (left.weight[:, seen] * apart[:, None] ** 2).sum(axis=0)
                size = without.change(form)[0][seen, axis]
                size = size - weight @ size
                of_dates = (incidence.T @ gain).T @ np.diag(errors.scale) @ (incidence.T @ gain)
                of_edges = gain.T @ np.diag(errors.factor) @ gain
                noisy = of_dates * np.tensordot(errors.shared[axis], every, 1)
                noisy = (noisy + of_edges * np.tensordot(errors.own[axis], every, 1)) * np.outer(root, root)
                whole = np.outer(size, size) - centred @ noisy @ centred.T
                for which in range(len(products)):
                    products[which] += whole[classes == which].sum() / 2
            expected = np.array(
                [
                    [(centred @ one @ centred.T)[classes == which].sum() for one in every]
                    for which in range(len(products))
                ]
            )
            variances = nnls(expected, products)[0]
            wanted[row, axis] = variances @ [weight @ one @ weight for one in every]
    assert (wanted > 0).all()
    np.testing.assert_allclose(yearly_variances(left, edges, trends, errors, place, YEARS), wanted, rtol=1e-6)


def test_dates_of_one_year_and_a_half_see_seasons_and_fewer_do_not() -> None:
    left, edges, trends, errors, place = made(0.0)
    known = YEARS[:-1]
    for span, sees in ((1.49, False), (1.51, True)):
        years = np.append(50.0 + (known - known.min()) / np.ptp(known) * span, np.nan)
        assert (yearly_variances(left, edges, trends, errors, place, years) > 0).any() == sees


def test_without_an_edge_that_has_a_trend_nothing_is_seen() -> None:
    left, edges, trends, errors, place = made(0.0)
    nothing = dataclasses.replace(trends, used=np.zeros_like(trends.used))
    np.testing.assert_array_equal(yearly_variances(left, edges, nothing, errors, place, YEARS), 0.0)
