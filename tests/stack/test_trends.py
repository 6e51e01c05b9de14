"""Trends of edges and the cells and pairs of dates before them, where variances, places and dates differ."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.graph import pairs_of
from ortho_pipeline.block.stack.steps import steps_of
from ortho_pipeline.block.stack.trends import design_of, trends_of

PLACE = np.random.default_rng(1).uniform(-1, 1, (60, 2))


def edge(value: np.ndarray, variance: np.ndarray) -> Edges:
    return Edges(np.array([1]), np.array([0]), value[None], variance[None], np.zeros(1))


@pytest.mark.parametrize("terms", [1, 3])
def test_a_value_of_the_usual_noise_has_half_the_weight_of_one_without(terms: int) -> None:
    """Weights are those of the noise of a value and of as large an error that it shares."""
    random = np.random.default_rng(2)
    variance = random.uniform(0.005, 0.08, 60)
    value = random.normal(0.0, 0.1, (60, 2)) + (3.0, -2.0) + PLACE @ [[0.5, 0.2], [-0.3, 0.4]] * (terms == 3)
    found = trends_of(edge(value, variance), design_of(PLACE, terms), np.ones(60, dtype=bool))
    used = found.used[0]
    assert used.sum() > 50
    relative = np.clip(variance / np.median(variance), 0.1, 10.0)
    root = np.sqrt(1.0 / (1.0 + relative[used]))[:, None]
    design = design_of(PLACE, terms)[used]
    wanted = np.linalg.lstsq(root * design, root * value[used], rcond=None)[0]
    np.testing.assert_allclose(found.value[0], wanted, rtol=1e-9)
    np.testing.assert_allclose(found.weights[0, used].T @ value[used], wanted, rtol=1e-9)
    assert not found.weights[0, ~used].any()


def test_two_fifths_of_the_places_do_not_move_the_trend_of_the_others() -> None:
    value = np.where(np.arange(60)[:, None] < 36, (10.0, -5.0), (0.0, 0.0))
    value = value + np.random.default_rng(3).normal(0, 0.01, (60, 2))
    found = trends_of(edge(value, np.full(60, 0.01)), design_of(PLACE, 1), np.ones(60, dtype=bool))
    assert not found.used[0, 36:].any()
    np.testing.assert_allclose(found.value[0, 0], (10.0, -5.0), atol=0.01)


@pytest.mark.parametrize(("ratio", "good"), [(7e-4, False), (1.4e-3, True)])
def test_slopes_need_places_beside_a_line(ratio: float, good: bool) -> None:
    """The spread across the line, squared, is at least a thousandth of the number of places."""
    x = np.tile(np.linspace(-1.0, 1.0, 30), 2)
    place = np.column_stack([x, np.repeat([1.0, -1.0], 30) * np.sqrt(ratio)])
    found = trends_of(edge(np.zeros((60, 2)), np.full(60, 0.01)), design_of(place, 3), np.ones(60, dtype=bool))
    assert found.good.tolist() == [good]


def test_cells_begin_where_the_area_does() -> None:
    """300 by 125 px from (1000, 500): twelve columns of 25 px, and five rows."""
    cells = Cells.over(np.array([1000.0, 500.0]), np.array([1300.0, 625.0]))
    assert (cells.side, cells.shape) == (25.0, (12, 5))
    place = np.array([[1030.0, 510.0], [1299.0, 624.0], [1010.0, 626.0], [999.0, 510.0], [1301.0, 510.0]])
    value = np.array([[1.0, 2.0], [3.0, 4.0], [50.0, 50.0], [60.0, 60.0], [70.0, 70.0]])
    found, variance = cells.sampled(place, value, np.array([0.1, 0.2, 0.3, 0.4, 0.5]))
    assert np.flatnonzero(np.isfinite(variance)).tolist() == [1, 59]
    np.testing.assert_allclose(found[[1, 59]], value[:2])
    np.testing.assert_allclose(variance[[1, 59]], [0.01, 0.04])
    assert np.isnan(found[0]).all()


def test_a_match_within_three_sigmas_stays_and_one_beyond_leaves() -> None:
    ring = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] * 2
    value = np.array([*ring, (4.1, 0.0), (-4.1, 0.0)])
    cells = Cells.over(np.zeros(2), np.array([1200.0, 1200.0]))
    for sigma, count in ((1.33, 8), (1.40, 10)):
        _, variance = cells.sampled(np.full((10, 2), 5.0), value, np.full(10, sigma))
        assert variance[0] == pytest.approx(sigma**2 / count)


# -- pairs -------------------------------------------------------------------------------------------------------------


def test_pairs_do_not_depend_on_when_time_begins() -> None:
    days = np.sort(np.random.default_rng(5).uniform(0.0, 2500.0, 50))
    pairs = pairs_of(days.tolist())
    lags = np.array([days[one] - days[other] for one, other in pairs])
    assert (np.abs(lags - 365.25) < 40).sum() > 20
    assert (np.abs(lags - 1826.25) < 40).sum() > 5
    assert pairs_of((days + 18_000.0).tolist()) == pairs
    assert pairs_of((days - 18_000.0).tolist()) == pairs


def test_within_a_season_a_clear_date_is_preferred() -> None:
    """10 days off and half covered costs (40 + 10) * 2, 20 days off and clear 40 + 20; 45 days off is too far."""
    days = [0.0, 20.0, 30.0, 40.0, 395.25]
    # The partner is sought at day 30; day 20 is 10 off, day 40 too, day 0 is 30 off.
    assert (4, 2) in pairs_of(days, 1)
    assert (4, 1) in pairs_of(days, 1, clouds=[0, 20, 90, 90, 0])
    assert (4, 0) in pairs_of(days, 1, clouds=[0, 60, 90, 90, 0])
    assert (4, 2) in pairs_of(days, 1, clouds=[90, 90, 20, 90, 0])


def test_of_two_dates_of_one_day_the_later_one_is_the_neighbour() -> None:
    assert pairs_of([0.0, 0.0, 10.0], 1) == [(1, 0), (2, 1)]


def test_dates_under_clouds_alone_and_with_the_sun_at_the_horizon_are_still_ordered() -> None:
    """More than 99 % of clouds count as 99 %, and a sun lower than 5 degrees as one of 5 degrees."""
    days = [0.0, 5.0, 9.0, 12.0]
    for covered in (99.0, 99.9, 100.0):
        assert pairs_of(days, 1, clouds=[covered] * 3 + [0.0]) == pairs_of(days, 1)
    low = pairs_of(days, 1, suns=[5.0, 5.0, 3.0, 5.0])
    assert low == pairs_of(days, 1)
    assert (3, 1) in pairs_of(days, 1, suns=[7.0, 7.0, 5.0, 7.0])


# -- steps -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [3, 9])
def test_three_dates_beside_a_change_are_too_few_for_a_step_there(at: int) -> None:
    value = np.random.default_rng(1).normal(0, 0.01, (12, 2))
    value[at:] += 5.0
    assert at not in [step.date for step in steps_of(value, np.zeros((2, 12, 12)))]
