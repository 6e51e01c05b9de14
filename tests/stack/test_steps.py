"""Steps of dates: size, sigma and chance, by hand and against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import f

from ortho_pipeline.block.stack.steps import steps_of


def scattered(dates: int, at: int, size: tuple[float, float], scatter: float = 0.1, seed: int = 3) -> np.ndarray:
    value = np.random.default_rng(seed).normal(0.0, scatter, (dates, 2))
    value[at:] += size
    return value


def test_a_step_has_the_sigma_of_both_means_and_the_chance_of_fishers_distribution() -> None:
    value, random = scattered(24, 10, (1.0, -0.5)), np.random.default_rng(8)
    root = random.normal(0.0, 0.02, (2, 24, 24))
    covariance = root @ root.transpose(0, 2, 1)
    (step,) = steps_of(value, covariance)
    assert step.date == 10
    middle = [np.median(value[part], axis=0) for part in (slice(0, 10), slice(10, 24))]
    scatter = (1.4826 * np.median(np.abs(np.diff(value, axis=0)), axis=0)) ** 2 / 2
    means = [
        np.clip(value[part], at - 3 * np.sqrt(scatter), at + 3 * np.sqrt(scatter)).mean(axis=0)
        for part, at in zip((slice(0, 10), slice(10, 24)), middle, strict=True)
    ]
    np.testing.assert_allclose(step.size, means[1] - means[0], rtol=1e-12)
    contrast = np.repeat([-0.1, 1 / 14], [10, 14])
    variance = scatter * (1 / 10 + 1 / 14) + [contrast @ one @ contrast for one in covariance]
    np.testing.assert_allclose(step.sigma, np.sqrt(variance), rtol=1e-9)
    # A median of 23 differences is worth 37 % of a sample, along both axes.
    ratio = (np.array(step.size) ** 2 / variance).sum() / 2
    assert step.chance == pytest.approx(f.sf(ratio, 2, 2 * 0.37 * 23), rel=1e-9)


def test_two_steps_are_found_in_order_and_only_thirty_dates_beside_one_count() -> None:
    value = scattered(120, 40, (2.0, 0.0))
    value[80:] += [0.0, 3.0]
    first, second = steps_of(value, np.zeros((2, 120, 120)))
    assert (first.date, second.date) == (40, 80)
    scatter = (1.4826 * np.median(np.abs(np.diff(value, axis=0)), axis=0)) ** 2 / 2
    np.testing.assert_allclose(first.sigma, np.sqrt(scatter * (1 / 30 + 1 / 30)), rtol=1e-9)
    np.testing.assert_allclose(second.size, [0.0, 3.0], atol=0.1)


@pytest.mark.parametrize("dates", [0, 1, 2, 7])
def test_seven_dates_have_no_step(dates: int) -> None:
    assert steps_of(np.zeros((dates, 2)), np.zeros((2, dates, dates))) == []


def test_a_step_needs_a_chance_of_one_in_two_hundred_over_all_dates() -> None:
    """A known covariance makes the same displacement less certain: 0.005 / 24 is where it ends."""
    value = scattered(24, 12, (1.0, 0.0), scatter=0.05)
    for sigma in np.linspace(0.1, 1.0, 37):
        steps = steps_of(value, np.array([sigma**2 * np.eye(24)] * 2))
        scatter = (1.4826 * np.median(np.abs(np.diff(value, axis=0)), axis=0)) ** 2 / 2
        size = value[12:].mean(axis=0) - value[:12].mean(axis=0)
        chance = f.sf((size**2 / ((scatter + sigma**2) / 6)).sum() / 2, 2, 2 * 0.37 * 23)
        if not 0.7 < chance / (0.005 / 24) < 1.4:
            assert [step.date for step in steps] == [12] * bool(chance < 0.005 / 24)
