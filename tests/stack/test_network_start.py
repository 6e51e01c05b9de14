"""The network of a stack where parts, slopes and seasons matter: slopes, the part of the datum, what loops show."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from networks import Truth
from scipy.stats import chi2

from ortho_pipeline.block.stack import adjustment, network
from ortho_pipeline.block.stack.adjustment import adjust
from ortho_pipeline.block.stack.components import ErrorComponents
from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.network import Network
from ortho_pipeline.block.stack.trends import Trends


def test_errors_of_seasons_are_added_to_shifts_alone() -> None:
    """Dates half a year apart share exp(-2) of one part; a wave of half a year is the same at both."""
    root = np.random.default_rng(3).normal(size=(2, 12, 12))
    before = root @ root.transpose(0, 2, 1)
    years = np.array([15.0, 15.25, 15.5, np.nan])
    variance, yearly = np.array([0.3, 0.7]), np.array([[0.11, 0.13], [0.17, 0.19]])
    found = Network(np.ones((4, 3, 2)), before.copy(), np.zeros(4, dtype=int)).with_seasons(variance, yearly, years)
    e = np.exp(-1.0)
    season = np.array([[1, e, e**2, 0], [e, 1, e, 0], [e**2, e, 1, 0], [0, 0, 0, 1]])
    year = np.array([[1, 0, -1, 0], [0, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0, 1]])
    half = np.array([[1, -1, 1, 0], [-1, 1, -1, 0], [1, -1, 1, 0], [0, 0, 0, 1]])
    for axis in (0, 1):
        wanted = before[axis].copy()
        wanted[::3, ::3] += variance[axis] * season + yearly[0, axis] * year + yearly[1, axis] * half
        np.testing.assert_allclose(found.covariance[axis], wanted, atol=1e-12)
    np.testing.assert_array_equal(found.value, 1.0)


def random_edges(size: float) -> tuple[Edges, Trends, ErrorComponents, np.ndarray, np.ndarray]:
    """Return edges of forty dates that err by shifts of their own, of which nine are wrong by some pixels."""
    random, dates = np.random.default_rng(6), 40
    pairs = np.array([(i, i - k) for i in range(dates) for k in (1, 2, 3, 5, 9) if k <= i])
    count, places = len(pairs), 4
    shift = random.uniform(-3, 3, (dates, 2))
    value = shift[pairs[:, 0]] - shift[pairs[:, 1]] + random.normal(0, 1, (count, 2)) * (size, 2 * size)
    wrong = np.zeros(count, dtype=bool)
    wrong[random.choice(count, 9, replace=False)] = True
    value[wrong] += random.choice([-1, 1], (9, 2)) * random.uniform(25 * size, 60 * size, (9, 2))
    each = np.repeat(value[:, None], places, axis=1)
    edges = Edges(pairs[:, 0], pairs[:, 1], each, np.full((count, places), 0.01), np.full(count, 0.02))
    trends = Trends(
        np.ones((places, 1)), np.full((count, places, 1), 1 / places), value[:, None], np.zeros_like(each),
        np.ones((count, places), dtype=bool),
    )  # fmt: skip
    parts = 0.002 * np.eye(7)[[0, 0]]
    errors = ErrorComponents(parts, parts, random.uniform(0.5, 2, dates), random.uniform(0.5, 2, count), np.zeros(2))
    return edges, trends, errors, random.uniform(-1, 1, (places, 2)), wrong


@pytest.mark.parametrize("size", [0.05, 0.4])
def test_the_constant_error_of_edges_is_the_one_that_loops_confirm(size: float) -> None:
    """With it, the squares of what edges leave are as large as expected, along both axes; wrong edges have left."""
    edges, trends, errors, place, wrong = random_edges(size)
    closures, found = network.accepted_edges(edges, trends, errors, place, 40)
    np.testing.assert_array_equal(closures.accepted, ~wrong)
    np.testing.assert_allclose(found.constant, np.array([1.0, 4.0]) * size**2, rtol=0.3)
    both = [errors.covariance(axis, edges, trends, place) for axis in (0, 1)]
    again, more = network._closed(
        edges, edges.incidence(40), trends.value[:, 0], both, found.constant, closures.accepted
    )
    total = np.array([one.diagonal().mean() for one, _ in both])
    assert (np.abs(more) < 0.03 * total + 0.03 * found.constant).all()
    limit = chi2.isf(1e-4, 2)
    np.testing.assert_array_equal(again.ratio > limit, wrong)


@pytest.mark.parametrize("part", [0.97, 1.03])
@pytest.mark.parametrize("date", [0, 3])
def test_slopes_of_a_date_need_a_chance_of_one_in_a_thousand_over_all_dates(
    monkeypatch: pytest.MonkeyPatch, part: float, date: int
) -> None:
    """Two slopes along two axes have four degrees of freedom; slopes that most dates have are none of a date."""
    random = np.random.default_rng(8)
    root = random.normal(size=(2, 15, 15))
    covariance = 0.01 * (root @ root.transpose(0, 2, 1))
    size = np.array([[0.3, -0.2], [-0.1, 0.4]])
    blocks = [one[3 * date + 1 : 3 * date + 3, 3 * date + 1 : 3 * date + 3] for one in covariance]
    ratio = sum(size[:, axis] @ np.linalg.inv(blocks[axis]) @ size[:, axis] for axis in (0, 1))
    value = np.zeros((5, 3, 2))
    value[:, 0] = random.normal(0, 5, (5, 2))
    value[:, 1:] = [[0.7, -0.5], [0.2, 0.9]]
    value[date, 1:] += size * np.sqrt(part * chi2.isf(1e-3 / 5, 4) / ratio)
    assert sloped(monkeypatch, value, covariance).tolist() == [part > 1 and one == date for one in range(5)]


def sloped(monkeypatch: pytest.MonkeyPatch, value: np.ndarray, covariance: np.ndarray, accepted: int = 1) -> np.ndarray:
    network_: Any = SimpleNamespace(value=value, covariance=covariance)
    made: Any = SimpleNamespace(network=network_, closures=SimpleNamespace(accepted=np.arange(3) < accepted))
    monkeypatch.setattr(adjustment, "_Solved", SimpleNamespace(of=lambda *given: made))
    none: Any = None
    return adjustment._sloped(none, none, none, none, len(value))


def test_slopes_that_move_a_corner_by_less_than_a_twentieth_of_a_pixel_do_not_matter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A corner is moved by the sum of both slopes, along both axes; without an accepted edge nothing is known."""
    covariance = 1e-8 * np.array([np.eye(9)] * 2)
    slopes = np.array([[-0.01, 0.005], [0.02, -0.035]])
    assert np.hypot(0.01 + 0.02, 0.005 + 0.035) == pytest.approx(0.05)
    for factor in (0.97, 1.03):
        value = np.zeros((3, 3, 2))
        value[1, 1:] = factor * slopes
        assert sloped(monkeypatch, value, covariance).tolist() == [False, factor > 1, False]
    assert not sloped(monkeypatch, value, covariance, accepted=0).any()


@pytest.fixture(scope="module")
def two_parts() -> Any:
    """A stack of eight dates of which no edge connects the first three with the others."""
    made = Truth(seed=6, dates=8, hidden=0.0).made()
    # Loops show less than this stated error, so the rest belongs to seasons.
    edges = dataclasses.replace(made.edges, alike=np.full(len(made.edges), 0.1))
    return dataclasses.replace(made, edges=edges.select((edges.first < 3) == (edges.second < 3)))


def test_the_part_with_most_dates_is_determined(two_parts: Any) -> None:
    stack = adjust(two_parts.truth.cells, two_parts.edges, two_parts.years.tolist(), affine=False)
    np.testing.assert_array_equal(stack.determined, np.arange(8) >= 3)
    np.testing.assert_array_equal(stack.network.value[:3], 0.0)
    assert np.isnan(stack.sigma[:3]).all()
    value = stack.network.value[3:, 0]
    np.testing.assert_allclose(value.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(value, two_parts.shift[3:] - two_parts.shift[3:].mean(axis=0), atol=0.2)
    # The mean of these dates has no error.
    shifts = stack.network.covariance[:, 9::3, 9::3]
    np.testing.assert_allclose(shifts.sum(axis=(1, 2)), 0.0, atol=1e-12)


def test_the_part_of_the_datum_is_determined(two_parts: Any) -> None:
    stack = adjust(two_parts.truth.cells, two_parts.edges, two_parts.years.tolist(), datum=1, affine=False)
    np.testing.assert_array_equal(stack.determined, np.arange(8) < 3)
    np.testing.assert_array_equal(stack.network.value[3:], 0.0)
    np.testing.assert_allclose(stack.network.value[:3, 0], two_parts.shift[:3] - two_parts.shift[1], atol=0.2)
