"""The parts of a stack's network: cells, edges, trends and pairs, by numbers on paper."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.batch.stack.document import closures
from ortho_pipeline.block.stack.components import ErrorComponents
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.graph import pairs_of
from ortho_pipeline.block.stack.steps import steps_of
from ortho_pipeline.block.stack.trends import design_of, median_of, trends_of


def test_cells_are_squares_that_cover_the_area() -> None:
    cells = Cells.over(np.array([100.0, 40.0]), np.array([1300.0, 690.0]))
    assert (cells.side, cells.shape) == (100.0, (12, 7))
    assert cells.middles[[0, 1, 12, -1]].tolist() == [[150, 90], [250, 90], [150, 190], [1250, 690]]
    assert cells.middle.tolist() == [700.0, 390.0]
    assert cells.half == 600.0
    np.testing.assert_allclose(cells.place[[0, -1]], [[-11 / 12, -0.5], [11 / 12, 0.5]])
    assert Cells.over(np.zeros(2), np.array([1200.0, 600.0])).shape == (12, 6), "an exact multiple has no row more"
    assert Cells.over(np.zeros(2), np.array([600.0, 1200.0])).shape == (6, 12)


def test_a_cell_has_the_mean_of_its_matches_without_those_far_from_the_median() -> None:
    cells = Cells.over(np.zeros(2), np.array([1200.0, 1200.0]))
    place = np.array([[10, 10], [20, 30], [50, 60], [70, 80], [90, 99], [110, 10], [-1, 10], [10, -1], [1200, 10.0]])
    value = np.array([[1.0, 2], [1.2, 2], [0.8, 2], [1, 2.2], [9, 9], [5, 6], [77, 77], [77, 77], [77, 77]])
    sigma = np.array([0.1, 0.1, 0.2, 0.2, 0.1, 0.3, 0.1, 0.1, 0.1])
    found, variance = cells.sampled(place, value, sigma)
    np.testing.assert_allclose(found[:2], [[1.0, 2.05], [5.0, 6.0]])
    np.testing.assert_allclose(variance[:2], [(2 * 0.01 + 2 * 0.04) / 4 / 4, 0.09])
    assert np.isnan(found[2:]).all()
    assert np.isnan(variance[2:]).all()


@pytest.mark.parametrize(("far", "sigma", "kept"), [(3.9, 0.1, True), (4.1, 0.1, False), (4.1, 1.4, True)])
def test_a_match_is_far_at_four_medians_or_three_sigmas(far: float, sigma: float, kept: bool) -> None:
    ring = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]
    value = np.array([*ring, *ring, (far, 0.0), (-far, 0.0)])
    cells = Cells.over(np.zeros(2), np.array([1200.0, 1200.0]))
    _, variance = cells.sampled(np.full((10, 2), 5.0), value, np.full(10, sigma))
    assert variance[0] == pytest.approx(sigma**2 / (10 if kept else 8))


def edges_of(value: np.ndarray, variance: float | np.ndarray = 0.01) -> Edges:
    count = len(value)
    spread = np.broadcast_to(variance, value.shape[:2]).copy()
    return Edges(np.arange(1, count + 1), np.zeros(count, dtype=int), value, spread, np.zeros(count))


def test_an_edge_is_its_first_date_minus_its_second() -> None:
    value = np.zeros((2, 4, 2))
    value[1, 3, 0] = np.nan
    edges = edges_of(value, np.array([[1.0, 2.0, 4.0, 200.0], [0.01, 2.0, 2.0, 9.0]]))
    assert edges.incidence(3).toarray().tolist() == [[-1, 1, 0], [-1, 0, 1]]
    assert edges.measured.tolist() == [[True] * 4, [True, True, True, False]]
    # The median of the measured variances is 2; a place counts at least a tenth of it, at most ten times.
    assert edges.relative.tolist() == [[0.5, 1.0, 2.0, 10.0], [0.1, 1.0, 1.0, 1.0]]
    part = edges.select(np.array([1]))
    assert (len(part), part.first.tolist(), part.value.shape) == (1, [2], (1, 4, 2))


def test_the_median_of_some_values() -> None:
    random = np.random.default_rng(3)
    value, some = random.normal(size=(6, 9)), random.random((6, 9)) < 0.6
    some[0], some[1] = False, True
    wanted = [np.median(row[which]) if which.any() else 0.0 for row, which in zip(value, some, strict=True)]
    assert {int(which.sum()) % 2 for which in some} == {0, 1}
    np.testing.assert_allclose(median_of(value, some), wanted)


def test_a_trend_is_that_of_the_places_that_agree() -> None:
    cells = Cells.over(np.zeros(2), np.array([1200.0, 1200.0]))
    design = design_of(cells.place, 3)
    assert design_of(cells.place, 1).shape == (144, 1)
    coefficients = np.array([[[1.0, -2.0], [0.5, 0.3], [-0.2, 0.1]]])
    noise = np.random.default_rng(0).normal(0, 0.01, (1, 144, 2))
    value = np.einsum("km,emc->ekc", design, coefficients) + noise
    wrong = np.arange(0, 144, 12)
    value[0, wrong] += 0.5
    still = np.arange(144) != 77
    value[0, ~still] += 3.0
    trends = trends_of(edges_of(value), design, still)
    assert trends.good.all()
    assert not trends.used[0, [*wrong, 77]].any()
    assert trends.used.sum() >= 144 - 13 - 4
    kept = trends.used[0]
    wanted = np.linalg.lstsq(design[kept], value[0, kept], rcond=None)[0]
    np.testing.assert_allclose(trends.value[0], wanted, atol=1e-9)
    np.testing.assert_allclose(trends.residual[0, kept], value[0, kept] - design[kept] @ wanted, atol=1e-9)
    assert not trends.residual[0, ~kept].any()


def test_a_place_is_apart_at_three_and_a_half_sigmas() -> None:
    """If half of the residuals are shorter than 1, sigma is 1 / sqrt(2 ln 2) per axis: 3.5 sigmas are 2.97."""
    angle = np.linspace(0, 2 * np.pi, 144, endpoint=False)
    value = np.column_stack([np.cos(angle), np.sin(angle)])[None] * 1.0
    value[0, [0, 72]] *= 2.85
    value[0, [36, 108]] *= 3.1
    cells = Cells.over(np.zeros(2), np.array([1200.0, 1200.0]))
    used = trends_of(edges_of(value), design_of(cells.place, 1), np.ones(144, bool)).used[0]
    assert np.flatnonzero(~used).tolist() == [36, 108]


@pytest.mark.parametrize(("terms", "count", "good"), [(1, 5, False), (1, 6, True), (3, 11, False), (3, 12, True)])
def test_a_trend_needs_six_places_and_four_a_term(terms: int, count: int, good: bool) -> None:
    cells = Cells.over(np.zeros(2), np.array([1200.0, 1200.0]))
    value = np.full((1, 144, 2), np.nan)
    # All matches agree to the last digit, spread over the area.
    value[0, np.random.default_rng(0).permutation(144)[:count]] = 0.25
    trends = trends_of(edges_of(value), design_of(cells.place, terms), np.ones(144, bool))
    assert trends.good.tolist() == [good]


def test_a_date_with_other_shadows_counts_as_farther() -> None:
    """The cotangents of 45 and 26.6 degrees differ by one, so that the date counts as twice as far."""
    days = [0.0, 4.0, 7.0, 10.0]
    assert pairs_of(days, 1) == [(1, 0), (2, 1), (3, 2)]
    suns = [45.0, 45.0, float(np.degrees(np.arctan(0.5))), 45.0]
    # From day 10: day 7 costs (3 + 1) * 2, day 4 costs 6 + 1.
    assert (3, 1) in pairs_of(days, 1, suns=suns)
    assert (3, 2) in pairs_of([0.0, 3.0, 7.0, 10.0], 1, suns=[*suns[:2], float(np.degrees(np.arctan(0.55))), 45.0])
    assert pairs_of(days, 1, suns=[45.0, 45.0, float("nan"), 45.0]) == pairs_of(days, 1)


def test_clouds_count_by_what_is_left() -> None:
    """Half of a date under clouds makes it twice as far: 2 * (3 + 1) against 6 + 1, and against 7 + 1 days and more."""
    days = [0.0, 4.0, 7.0, 10.0]
    assert (3, 1) in pairs_of(days, 1, clouds=[0, 0, 50, 0])
    assert (3, 2) in pairs_of(days, 1, clouds=[0, 0, 40, 0])
    assert (3, 2) in pairs_of(days, 1, clouds=[0, 0, float("nan"), 0])


def test_the_same_season_of_other_years_is_within_forty_days() -> None:
    for gap, season in (
        (365.25 + 39, True),
        (365.25 + 41, False),
        (365.25 - 39, True),
        (1826.25 + 39, True),
        (1826.25 + 41, False),
    ):
        days = [0.0, *(gap - 60 + 10 * k for k in range(4)), gap]
        assert ((5, 0) in pairs_of(days, 3)) == season, gap


def test_a_step_has_its_date_and_its_size() -> None:
    random = np.random.default_rng(1)
    value = random.normal(0, 0.05, (40, 2))
    value[23:] += (0.6, -0.4)
    (step,) = steps_of(value, np.zeros((2, 40, 40)))
    assert step.date == 23
    np.testing.assert_allclose(step.size, (0.6, -0.4), atol=0.06)
    # Of means of 23 and 17 dates, to the third that a median of 39 differences leaves open.
    np.testing.assert_allclose(step.sigma, 0.05 * np.sqrt(1 / 23 + 1 / 17), rtol=0.35)
    # A covariance that all dates share adds nothing to a difference, and one of each date adds its mean.
    (same,) = steps_of(value, np.ones((2, 40, 40)))
    np.testing.assert_allclose(same.sigma, step.sigma, rtol=1e-6)
    (more,) = steps_of(value, np.full((2, 1, 1), 0.01) * np.eye(40))
    np.testing.assert_allclose(np.square(more.sigma) - np.square(step.sigma), 0.01 * (1 / 23 + 1 / 17), rtol=1e-6)
    assert steps_of(value[20:27], np.zeros((2, 7, 7))) == []


def test_a_step_needs_four_dates_on_each_side() -> None:
    value = np.random.default_rng(1).normal(0, 0.01, (8, 2))
    value[4:] += 5.0
    assert [step.date for step in steps_of(value, np.zeros((2, 8, 8)))] == [4]


def test_a_single_date_changes_a_step_by_three_sigmas_at_most() -> None:
    value = np.random.default_rng(1).normal(0, 0.05, (40, 2))
    value[23:] += (0.6, -0.4)
    value[30] = np.median(value[23:], axis=0)
    (step,) = steps_of(value, np.zeros((2, 40, 40)))
    value[30] += 8.0
    (other,) = steps_of(value, np.zeros((2, 40, 40)))
    scatter = np.array(other.sigma) / np.sqrt(1 / 23 + 1 / 17)
    change = (np.array(other.size) - step.size) * 17 / scatter
    assert (np.abs(change - 3) < 1).all()


def test_the_variance_of_a_value_is_the_sum_of_all_that_errs() -> None:
    """Noise by the variance of each value, correlations alike, an edge's part by its factor, and what is alike."""
    relative = np.array([[1.0, 2.0], [0.5, 4.0]])
    edges = Edges(np.array([0, 1]), np.array([1, 2]), np.zeros((2, 2, 2)), relative, np.array([0.3, 0.0]))
    np.testing.assert_allclose(edges.relative, relative / 1.5)
    shared, own = np.arange(14.0).reshape(2, 7), np.arange(14.0).reshape(2, 7)[::-1] ** 2
    made = ErrorComponents(shared, own, np.ones(3), np.array([2.0, 5.0]), np.array([0.1, 0.3]))
    of_date, of_edge = made.at_place(edges)
    for edge in range(2):
        for place in range(2):
            noise, rest = (shared[0] + shared[1]) / 2, (own[0] + own[1]) / 2
            value = relative[edge, place] / 1.5
            assert of_date[edge, place] == pytest.approx(noise[0] * value + noise[1:].sum())
            wanted = (2.0, 5.0)[edge] * (rest[0] * value + rest[1:].sum()) + 0.2 + (0.09, 0.0)[edge]
            assert of_edge[edge, place] == pytest.approx(wanted)
    np.testing.assert_allclose(made.of_seasons(np.array([0.7, 0.8])), [0.0, 0.0])
    less = ErrorComponents(shared, own, np.ones(3), np.ones(2), np.array([-0.4, 0.3]))
    np.testing.assert_allclose(less.of_seasons(np.array([0.8, 0.8])), [0.2, 0.0])


@pytest.mark.parametrize(
    ("pairs", "loops"),
    [
        ([(1, 0), (2, 0), (2, 1)], 1),
        ([(1, 0), (0, 2), (1, 2)], 1),  # 2 is a reference
        ([(1, 0), (2, 0), (2, 1), (0, 3), (1, 3), (2, 3)], 4),
        ([(1, 0), (2, 1), (3, 2), (3, 0)], 0),
    ],
)
def test_loops_of_three_include_those_with_a_reference(pairs: list[tuple[int, int]], loops: int) -> None:
    position = np.array([[0.0, 0.0], [1.0, 2.0], [-3.0, 1.0], [2.0, 2.0]])
    first, second = np.array(pairs).T
    shifts = position[first] - position[second]
    shifts[0] += 0.3, 0.4
    stack: Any = SimpleNamespace(edges=SimpleNamespace(first=first, second=second), determined=np.ones(4, dtype=bool))
    found = closures(stack, shifts, np.ones(len(pairs), dtype=bool))
    assert found.loops == loops
    assert found.largest_px == (pytest.approx(0.5) if loops else None)
