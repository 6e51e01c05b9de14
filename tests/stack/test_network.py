"""The network of a stack, on edges of known truth."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from networks import Made, Truth

from ortho_pipeline.block.stack.adjustment import AdjustedStack, adjust
from ortho_pipeline.block.stack.common_changes import CommonChanges, _forms
from ortho_pipeline.block.stack.components import WAVES, ErrorComponents
from ortho_pipeline.block.stack.edges import Cells
from ortho_pipeline.block.stack.graph import pairs_of
from ortho_pipeline.block.stack.network import Network
from ortho_pipeline.block.stack.steps import steps_of


def solved(**given: Any) -> tuple[Made, AdjustedStack]:
    made = Truth(**given).made()
    return made, adjust(made.truth.cells, made.edges, made.years.tolist())


def errors(made: Made, stack: AdjustedStack) -> np.ndarray:
    return stack.network.value[:, 0] - (made.shift - made.shift.mean(axis=0))


def spread(stacks: list[tuple[Made, AdjustedStack]]) -> float:
    ratio = np.concatenate([errors(made, stack) / stack.sigma for made, stack in stacks])
    return float(np.sqrt((ratio**2).mean()))


def test_sigmas_hold_and_dates_agree():
    rough = {"length": 0.05, "of_date": 0.1, "of_edge": 0.1}
    kinds: list[dict[str, Any]] = [{}, {"sharp": True}, rough, {"sharp": True, **rough}, {"sloped": 3}]
    stacks = [solved(seed=seed, dates=16, **kind) for seed, kind in enumerate(kinds, 20)]
    assert 0.85 < spread(stacks) < 1.15
    misfit = np.concatenate(
        [np.hypot(*(e - e[:, None])[np.triu_indices(16, 1)].T) for e in (errors(*s) for s in stacks)]
    )
    assert np.median(misfit) < 0.1
    assert np.quantile(misfit, 0.95) < 0.25


@pytest.mark.parametrize("dates", [3, 4])
def test_intervals_of_few_dates_hold_though_pairs_err_by_more_than_they_state(dates):
    """Each pair errs by a shift. Pairs that agree by chance were kept, with sigmas that were 3 to 5 times too small."""
    found = []
    for seed in range(14):
        made = Truth(seed=seed, dates=dates).made()
        apart = np.random.default_rng(100 + seed).normal(0.0, 0.2, (len(made.edges), 1, 2))
        stated = np.full(len(made.edges), 0.005)
        edges = dataclasses.replace(made.edges, value=made.edges.value + apart, alike=stated)
        stack = adjust(made.truth.cells, edges, made.years.tolist())
        assert stack.determined.all()
        found.append(errors(made, stack) / stack.sigma)
    ratio = np.abs(np.concatenate(found))
    # The errors of a stack have much in common: 14 stacks of three dates are about 28 independent values.
    assert (ratio < 1.96).mean() > 0.85
    assert np.median(ratio) > 0.1


@pytest.mark.parametrize(("noise", "of_date", "of_edge"), [(0.15, 0.0, 0.0), (0.15, 0.05, 0.05), (0.05, 0.1, 0.1)])
def test_errors_of_dates_and_of_edges_are_told_apart(noise, of_date, of_edge):
    """Half of the noise belongs to dates, half to edges; the smooth errors are as large as they were made."""
    _, stack = solved(seed=3, dates=16, noise=noise, of_date=of_date, of_edge=of_edge)
    found = stack.components
    shared, own = found.shared * np.median(found.scale), found.own * np.median(found.factor)
    np.testing.assert_allclose(shared.sum(axis=1), (noise / 2) ** 2 + of_date**2, rtol=0.25)
    np.testing.assert_allclose(own.sum(axis=1), (noise / 2) ** 2 + of_edge**2, rtol=0.25)
    if not of_date:
        assert (shared[:, 0] > 0.8 * shared.sum(axis=1)).all()
        assert (own[:, 0] > 0.8 * own.sum(axis=1)).all()


def test_wrong_edges_are_rejected_and_right_ones_kept():
    made, stack = solved(seed=1, dates=20, wrong=0.1)
    assert made.wrong.sum() > 3
    np.testing.assert_array_equal(stack.closures.accepted, ~made.wrong)
    assert np.abs(errors(made, stack)).max() < 0.15


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_moving_ground_is_found_and_moves_no_date(share):
    made, stack = solved(seed=2, dates=24, interval=30.0, moving=share, wrong=0.05)
    found = stack.motion.moving
    assert (found & made.moving).sum() >= 0.9 * found.sum()
    assert (found & made.moving).sum() >= 0.9 * made.moving.sum()
    error = errors(made, stack)
    # A rate that got into the corrections would grow with time.
    drift = np.polyfit(made.years, error, 1)[0] * np.ptp(made.years)
    assert np.abs(drift).max() < 0.1
    left = stack.motion.rate[made.moving & found] - made.rate[made.moving & found]
    assert np.abs(left).max() < 0.25


def test_the_rate_of_an_area_is_that_of_the_ground_and_not_of_its_rim():
    """Places within a circle move at one rate, and the ring about them, more exactly measured, at a tenth of it."""
    made = Truth(seed=12, dates=24, interval=30.0, hidden=0.0).made()
    edges, place = made.edges, made.truth.cells.place
    reach = np.hypot(*place.T)
    share = np.where(reach < 0.45, 1.0, np.where(reach < 0.55, 0.1, 0.0))
    years = made.years[edges.first] - made.years[edges.second]
    value = edges.value + (years[:, None] * share)[:, :, None] * np.array([0.8, -0.6])
    variance = edges.variance * np.where(share == 0.1, 0.1, 1.0)
    motion = adjust(
        made.truth.cells, dataclasses.replace(edges, value=value, variance=variance), made.years.tolist()
    ).motion
    rate, sigma, _ = motion.typical(motion.areas(made.truth.cells)[0], made.truth.cells)
    np.testing.assert_allclose(rate, [0.8, -0.6], atol=4 * sigma)
    assert sigma < 0.05


def test_still_ground_is_not_moving():
    assert sum(solved(seed=seed, dates=16)[1].motion.moving.sum() for seed in (30, 31)) <= 1


def test_a_cloud_at_one_date_is_not_motion():
    """One date is displaced at one place in all of its edges; the places about it are still."""
    made = Truth(seed=30, dates=24, interval=30.0, hidden=0.0).made()
    value = made.edges.value.copy()
    for number, date in enumerate((2, 11, 21)):
        value[made.edges.first == date, 40 + 30 * number] += 1.0
        value[made.edges.second == date, 40 + 30 * number] -= 1.0
    stack = adjust(made.truth.cells, dataclasses.replace(made.edges, value=value), made.years.tolist())
    assert not stack.motion.moving[[40, 70, 100]].any()


@pytest.mark.parametrize("date", [3, 7, 12])
def test_a_part_of_one_date_that_is_displaced_is_not_motion(date):
    """Half of the edges across a step are those of one date next to it."""
    made = Truth(seed=30, dates=16, interval=30.0, hidden=0.0).made()
    part = made.truth.cells.place[:, 0] < -0.6
    away = 3.0 * part[:, None]
    value = made.edges.value + away * ((made.edges.first == date) * 1.0 - (made.edges.second == date))[:, None, None]
    stack = adjust(made.truth.cells, dataclasses.replace(made.edges, value=value), made.years.tolist())
    assert part.sum() >= 20
    assert not stack.motion.moving[part].any()


def test_only_dates_with_significant_slopes_get_them():
    made, stack = solved(seed=4, dates=16, sloped=3)
    np.testing.assert_array_equal(stack.sloped, np.abs(made.slopes).max(axis=(1, 2)) > 0)
    np.testing.assert_allclose(stack.network.value[:, 1:], made.slopes, atol=0.12)


def test_a_date_as_datum_keeps_its_place():
    made = Truth(seed=5, dates=10).made()
    stack = adjust(made.truth.cells, made.edges, made.years.tolist(), datum=3)
    np.testing.assert_allclose(stack.network.value[3], 0.0, atol=1e-12)
    np.testing.assert_allclose(stack.sigma[3], 0.0, atol=1e-9)
    np.testing.assert_allclose(stack.network.value[:, 0], made.shift - made.shift[3], atol=0.2)
    np.testing.assert_allclose(stack.sigma_between(1, 3), stack.sigma[1], rtol=1e-6)


@pytest.mark.parametrize("sloped", [False, True])
def test_dates_have_slopes_relative_to_the_datum(sloped):
    """Relative to a date with slopes all other dates have some; relative to another one, those that have some."""
    made = Truth(seed=4, dates=16, sloped=3).made()
    steep = np.abs(made.slopes).max(axis=(1, 2)) > 0
    datum = int(np.flatnonzero(steep == sloped)[1])
    stack = adjust(made.truth.cells, made.edges, made.years.tolist(), datum=datum)
    np.testing.assert_array_equal(stack.sloped, steep | sloped)
    np.testing.assert_allclose(stack.network.value[:, 1:], made.slopes - made.slopes[datum], atol=0.2)


def test_a_date_without_pairs_is_not_determined():
    made = Truth(seed=6, dates=10).made()
    kept = (made.edges.first != 7) & (made.edges.second != 7)
    stack = adjust(made.truth.cells, made.edges.select(kept), made.years.tolist())
    np.testing.assert_array_equal(stack.determined, np.arange(10) != 7)
    assert np.isnan(stack.sigma[7]).all()
    np.testing.assert_array_equal(stack.network.value[7], 0.0)


def test_the_unit_of_pixels_does_not_matter():
    made = Truth(seed=7, dates=8, moving=0.2).made()
    edges = made.edges
    scaled = dataclasses.replace(edges, value=2 * edges.value, variance=4 * edges.variance)
    cells = Cells.over(np.zeros(2), np.full(2, 2000.0))
    one, other = (
        adjust(where, which, made.years.tolist()) for where, which in ((made.truth.cells, edges), (cells, scaled))
    )
    np.testing.assert_allclose(other.network.value, 2 * one.network.value, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(other.sigma, 2 * one.sigma, rtol=1e-5)


def test_a_step_is_found_and_scatter_is_none():
    random, found, false = np.random.default_rng(0), 0, 0
    for _ in range(40):
        scatter = random.normal(0.0, 0.5, (40, 2))
        false += bool(steps_of(scatter, np.zeros((2, 40, 40))))
        scatter[20:, 0] += 2.0
        steps = steps_of(scatter, np.zeros((2, 40, 40)))
        found += len(steps) == 1 and abs(steps[0].date - 20) <= 1 and abs(steps[0].size[0] - 2.0) < 0.8
    assert found >= 38
    assert false <= 1


def test_a_date_that_is_added_makes_pairs_only_with_itself():
    days = np.sort(np.random.default_rng(0).uniform(0, 2000, 60))
    cloud = {day: 1e4 * day % 100 for day in (*days.tolist(), -5.0, 777.7, 2005.0)}

    def pairs(days):
        return pairs_of(days, clouds=[cloud[day] for day in days], suns=[20 + cloud[day] / 2 for day in days])

    before = {(days[one], days[other]) for one, other in pairs(days.tolist())}
    for new in (-5.0, 777.7, 2005.0):
        longer = np.sort([*days, new])
        after = {(longer[one], longer[other]) for one, other in pairs(longer.tolist())}
        assert all(new in pair for pair in after - before)
        assert any(new in pair for pair in after)


def test_pairs_connect_all_dates_and_seasons():
    days = np.arange(0.0, 1500.0, 16.0)
    pairs = pairs_of(days.tolist())
    assert {one for one, _ in pairs} == set(range(1, len(days)))
    apart = np.array([days[one] - days[other] for one, other in pairs])
    assert (np.abs(apart - 365.25) < 20).sum() > 50
    assert len(pairs) < 7 * len(days)


def test_clear_dates_are_preferred_and_all_stay_connected():
    days, random = np.arange(0.0, 1500.0, 16.0), np.random.default_rng(3)
    clouds = np.where(random.random(len(days)) < 0.4, 95.0, 5.0)
    clouds[0] = 95.0
    pairs = pairs_of(days, clouds=clouds)
    assert {one for one, _ in pairs} == set(range(1, len(days)))
    plain = pairs_of(days)
    partly = [np.mean([clouds[other] > 50 for _, other in some]) for some in (pairs, plain)]
    assert partly[0] < 0.1
    assert partly[1] > 0.3
    np.testing.assert_array_equal(pairs_of(days, clouds=np.full(len(days), np.nan)), plain)


@pytest.mark.parametrize(("dates", "least", "most"), [(40, 0.99, 1.05), (5, 1.1, 1.6)])
def test_many_loops_show_that_edges_are_better_than_stated(dates, least, most, monkeypatch):
    """Many closed loops show how large the error of a pair is. With few loops, the stated error counts."""
    monkeypatch.setattr(ErrorComponents, "of_seasons", lambda *_: np.zeros(2))
    none, stated = _with_stated_error(dates, 0.05)
    assert least < np.median(stated.sigma) / np.median(none.sigma) < most


def test_what_loops_do_not_show_of_the_stated_error_is_an_error_of_seasons():
    """Dates half a year apart differ by the stated error of a pair; dates of one season in two years do not."""
    none, stated = _with_stated_error(40, 0.05)
    years = Truth(seed=3, dates=40).made().years
    apart = np.abs(years[:, None] - years)
    for low, high, expected in [(0.45, 0.55, 0.05), (0.97, 1.03, 0.0)]:
        pairs = np.argwhere(np.triu((apart > low) & (apart < high)))
        more = [stated.sigma_between(i, j) ** 2 - none.sigma_between(i, j) ** 2 for i, j in pairs.tolist()]
        assert len(pairs) > 3
        # exp(-2) of it is common to opposite seasons, and 40 dates have so many loops that a tenth of it is left.
        assert np.sqrt(np.median(more)) == pytest.approx(expected, abs=0.012)


@pytest.mark.parametrize("of_season", [0.0, 0.1])
def test_sigmas_have_what_dates_of_one_season_share(of_season):
    """Fields of four seasons close all loops. What they move all places by is seen from what places have of them.

    Four seeds have 24 free means of seasons, so a spread of 1 is seen within 0.15 of it (one sigma).
    """
    seeds = range(200, 204 if of_season else 202)
    stacks = [solved(seed=seed, dates=80, interval=12.0, of_season=of_season, length=0.05) for seed in seeds]
    assert 0.8 < spread(stacks) < 1.3


def alternating(sine: float) -> np.ndarray:
    """Return two days in each of six years at which the sine of a year is as large, before and after its middle."""
    return 365.25 * (np.repeat(np.arange(6.0), 2) + np.tile([-1.0, 1.0], 6) * np.arcsin(sine) / (2 * np.pi))


@pytest.mark.parametrize(
    ("days", "forms"),
    [
        (np.arange(8) * 365.25, (0, 0)),
        (np.arange(5) * 4 * 365.25, (0, 0)),
        (np.arange(9) * 365.25 / 2, (1, 0)),
        (np.arange(13) * 365.25 / 4, (2, 1)),
        (np.arange(80) * 12.0, (2, 2)),
        # Two dates a year: the sine at both is 0.29 or 0.31, and that of half a year 0.56 or 0.59.
        (alternating(0.29), (0, 1)),
        (alternating(0.31), (1, 1)),
    ],
)
def test_waves_that_the_dates_do_not_sample_are_left_out(days, forms):
    """A wave that is the same at all dates moves all of them alike: nothing shows it, and it does not matter."""
    years = np.append(days / 365.25 + 50.5, np.nan)
    assert tuple(len(_forms(number, years)) for number in WAVES) == forms
    for form in (one for number in WAVES for one in _forms(number, years)):
        assert form[-1] == 0
        assert abs(form.sum()) < 1e-9
        assert abs(form[:-1] @ years[:-1]) < 1e-7


def test_one_date_a_year_has_the_sigmas_that_loops_show(monkeypatch):
    made = Truth(seed=5, dates=8, interval=365.25).made()
    years = 50.5 + np.arange(8.0)
    found = adjust(made.truth.cells, made.edges, years.tolist())
    monkeypatch.setattr(CommonChanges, "yearly_variances", lambda self: np.zeros((2, 2)))
    np.testing.assert_array_equal(found.sigma, adjust(made.truth.cells, made.edges, years.tolist()).sigma)


def test_a_date_without_a_time_has_a_season_of_its_own():
    network = Network(np.zeros((3, 3, 2)), np.zeros((2, 9, 9)), np.zeros(3, dtype=int))
    found = network.with_seasons(np.zeros(2), np.array([[4.0, 1.0], [0.0, 0.0]]), np.array([np.nan, 15.0, 15.5]))
    np.testing.assert_allclose(found.covariance[0][::3, ::3], [[4, 0, 0], [0, 4, -4], [0, -4, 4]], atol=1e-12)
    np.testing.assert_allclose(found.covariance[1][::3, ::3], [[1, 0, 0], [0, 1, -1], [0, -1, 1]], atol=1e-12)


def _with_stated_error(dates: int, size: float) -> tuple[AdjustedStack, AdjustedStack]:
    """Return the adjustments of edges without a stated error that all values share, and with one."""
    made = Truth(seed=3, dates=dates).made()
    stated = dataclasses.replace(made.edges, alike=np.full(len(made.edges), size))
    one, other = (adjust(made.truth.cells, edges, made.years.tolist()) for edges in (made.edges, stated))
    return one, other
