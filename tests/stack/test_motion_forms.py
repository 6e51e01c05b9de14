"""Moving ground: motion of several forms at once, noisy places, untested places and the ground that most places are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from ortho_pipeline.block.stack.components import season_correlation
from ortho_pipeline.block.stack.moving import Left, _majority, motion_of
from ortho_pipeline.models.base import Array

#: Twelve dates in three years, each compared with the three before.
YEARS = 20.0 + np.array([0.0, 0.31, 0.52, 0.8, 1.07, 1.36, 1.6, 1.91, 2.2, 2.43, 2.75, 3.0])
FIRST, SECOND = np.array([(i, i - k) for i in range(12) for k in (1, 2, 3) if k <= i]).T
PLACES = 9


def quiet(part: float = 1.0, noise: float = 0.0) -> Left:
    """Return what is left of edges: places have the same weights, and errors whose variance is a part of the usual."""
    random, count = np.random.default_rng(3), len(FIRST)
    weight = np.repeat(random.uniform(50.0, 200.0, (count, 1)), PLACES, axis=1)
    value = random.normal(0.0, 1.0, (count, PLACES, 2)) * noise
    own, shared = random.uniform(0.002, 0.01, weight.shape), random.uniform(0.001, 0.004, PLACES)
    return Left(
        value, weight, part * own, part * shared, random.uniform(0.5, 2.0, 12), season_correlation(YEARS), FIRST, SECOND
    )


def without_rate(left: Left, form: np.ndarray) -> np.ndarray:
    """Return a change over time without the part that looks like a rate."""
    apart, of_form = YEARS[FIRST] - YEARS[SECOND], form[FIRST] - form[SECOND]
    return np.asarray(form - (left.weight[:, 1] * apart) @ of_form / (left.weight[:, 1] @ apart**2) * YEARS)


def moved(left: Left, places: list[int], size: tuple[float, float], form: np.ndarray) -> Left:
    value = left.value.copy()
    value[:, places] += (form[FIRST] - form[SECOND])[:, None, None] * np.array(size)
    return dataclasses.replace(left, value=value)


STEP: Array = (np.arange(12) >= 6).astype(float)


def test_a_step_of_all_places_is_no_motion_and_one_of_few_is() -> None:
    """Five of nine places have it, but four of these move steadily: they do not say where stable ground is."""
    left = quiet(1e-5)
    form = without_rate(left, STEP)
    both = moved(left, list(range(PLACES)), (0.7, -0.4), form)
    assert not motion_of(both, YEARS).moving.any()
    some = moved(both, [1, 5, 6, 7, 8], (1.0, 0.5), form)
    for place, rate in ((5, (3.0, 0.0)), (6, (0.0, 4.0)), (7, (-5.0, 1.0)), (8, (1.0, -6.0))):
        some = moved(some, [place], rate, YEARS)
    found = motion_of(some, YEARS)
    assert np.flatnonzero(found.moving).tolist() == [1, 5, 6, 7, 8]
    assert found.form[1] == "step"
    assert found.form[5:].tolist() == ["steady"] * 4
    assert found.form[0] == "steady"


@pytest.mark.parametrize(("size", "moves"), [(0.125, False), (0.14, True)])
def test_a_step_of_less_than_a_tenth_of_a_pixel_is_no_motion(size: float, moves: bool) -> None:
    """Beside a rate, three quarters of the step are seen."""
    left = quiet(1e-6)
    found = motion_of(moved(left, [4], (0.0, -size), without_rate(left, STEP)), YEARS)
    assert found.moving.tolist() == [moves and place == 4 for place in range(PLACES)]


def test_the_ratio_is_that_of_the_form_with_the_largest() -> None:
    """A step among noise: its squared size over its variance, times by how much noisier the place is than most."""
    left = quiet(noise=0.02)
    step = moved(left, [4], (1.5, -1.0), without_rate(left, STEP))
    found = motion_of(step, YEARS)
    assert np.flatnonzero(found.moving).tolist() == [4]
    without = dataclasses.replace(step, value=step.change(YEARS)[2])
    size, variance, _ = without.change(STEP)
    size = size[4] - np.median(np.delete(size, 4, axis=0), axis=0)
    assert without.noisier[4] > 2.0
    assert found.form[4] == "step"
    assert found.ratio[4] == pytest.approx((size**2).sum() / (variance[4] * without.noisier[4]), rel=0.05)


def test_a_noisy_place_needs_more_to_move() -> None:
    """Its edges differ three times as much as most: so has its rate nine times the variance."""
    left = quiet(noise=0.1)
    value = left.value.copy()
    value[:, 4] *= 4.0
    rest = dataclasses.replace(left, value=value)
    noisier = dataclasses.replace(rest, value=rest.change(YEARS)[2]).noisier
    assert noisier[4] > 8.0
    found = motion_of(rest, YEARS, steady=True)
    variance = rest.change(YEARS)[1]
    np.testing.assert_allclose(found.sigma, np.sqrt(variance * noisier)[:, None] * [1.0, 1.0])
    np.testing.assert_allclose(found.ratio, (found.rate**2).sum(axis=1) / (variance * noisier))


@pytest.mark.parametrize(("sigmas", "alone", "among"), [(3.65, False, False), (4.1, True, False), (4.4, True, True)])
def test_with_seven_more_forms_a_rate_needs_an_eighth_of_the_chance(sigmas: float, alone: bool, among: bool) -> None:
    """Five steps and two waves: 1e-3 / 8 is a square of 4.24 sigmas along two axes, and 1e-3 one of 3.72."""
    assert chi2.sf(4.24**2, 2) == pytest.approx(1e-3 / 8, rel=0.01)
    left = quiet()
    sigma = np.sqrt(left.change(YEARS)[1][5])
    faster = moved(left, [5], (0.0, -sigmas * sigma), YEARS)
    assert bool(motion_of(faster, YEARS, steady=True).moving[5]) is alone
    assert bool(motion_of(faster, YEARS).moving[5]) is among


def test_a_place_that_few_edges_see_does_not_move_and_hides_no_rate_of_most() -> None:
    left = quiet(1e-5)
    weight = left.weight.copy()
    weight[3:, 2] = 0.0
    few = dataclasses.replace(left, weight=weight)
    few = moved(few, list(range(PLACES)), (0.05, 0.02), YEARS)
    few = moved(few, [2], (4.0, 4.0), STEP)
    found = motion_of(few, YEARS)
    assert found.tested.tolist() == [place != 2 for place in range(PLACES)]
    assert not found.moving.any()
    np.testing.assert_allclose(np.delete(found.rate, 2, axis=0), 0.0, atol=1e-6)


def test_one_edge_that_is_far_off_counts_with_two_and_a_half_sigmas() -> None:
    left = quiet()
    value = left.value.copy()
    value[7, 3] = 40.0, -40.0
    size = dataclasses.replace(left, value=value).change(YEARS)[0]
    apart = YEARS[FIRST] - YEARS[SECOND]
    share = left.weight[:, 3] * apart / (left.weight[:, 3] @ apart**2)
    # It pulls by its share of what is counted, until the others pull as much.
    wanted = share[7] * 2.5 / np.sqrt(left.weight[7, 3]) / (1.0 - share[7] * apart[7])
    np.testing.assert_allclose(size[3], [wanted, -wanted], rtol=1e-2)


def test_most_places_may_be_less_than_half_of_all() -> None:
    """Three places share a rate, and two others each another one: the median of all is none of the three."""
    rate = np.array([(2.0, 2.0)] * 3 + [(3.0, 3.0)] * 2 + [(5.0, 5.0)] * 2)
    np.testing.assert_allclose(_majority(rate, np.full(7, 1e-3)), [2.0, 2.0])
    np.testing.assert_allclose(_majority(-rate, np.full(7, 1e-3)), [-2.0, -2.0])
