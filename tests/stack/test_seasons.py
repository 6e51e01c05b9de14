"""Errors of seasons that all places share in part: their variance from what places have of a wave."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ortho_pipeline.block.stack.common_changes import CommonChanges
from ortho_pipeline.block.stack.components import ErrorComponents
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.moving import left_of
from ortho_pipeline.block.stack.trends import design_of, trends_of

CELLS = Cells.over(np.zeros(2), np.full(2, 1000.0))
PLACE = CELLS.place
#: Two dates a month for three years; each is compared with the two before it.
YEARS = 20.0 + np.arange(72) / 24.0
FIRST, SECOND = np.array([(i, i - k) for i in range(72) for k in (1, 2) if k <= i]).T
#: A field has a correlation of exp(-1) at half of the longer half-side.
CORRELATION = np.exp(-np.linalg.norm(PLACE[:, None] - PLACE, axis=2) / 0.5)
ROOT = np.linalg.cholesky(CORRELATION + 1e-9 * np.eye(len(PLACE)))


def found(of_dates: np.ndarray, noise: float = 0.0, years: np.ndarray = YEARS) -> np.ndarray:
    """Return the variances of edges whose dates are displaced by so much ``(T, K, 2)``."""
    value = of_dates[FIRST] - of_dates[SECOND]
    edges = Edges(FIRST, SECOND, value, np.full(value.shape[:2], 0.01), np.zeros(len(FIRST)))
    trends = trends_of(edges, design_of(PLACE, 1), np.ones(len(PLACE), dtype=bool))
    none = np.zeros((2, 7))
    own = none.copy()
    own[:, 0] = noise**2
    errors = ErrorComponents(own, none, np.ones(72), np.ones(len(FIRST)), np.zeros(2))
    network = np.repeat(trends.value, len(PLACE), axis=1)
    known = dataclasses.replace(errors, own=np.full((2, 7), 1e-6))
    left = left_of(edges, network, known, np.ones(len(FIRST), dtype=bool), years)
    return CommonChanges(left, edges, trends, errors, PLACE, years).yearly_variances()


def waves(number: int, seed: int, sizes: tuple[float, float]) -> np.ndarray:
    """Return what a wave of a smooth field displaces ``(T, K, 2)`` px, along columns and rows."""
    random = np.random.default_rng(seed)
    phase = 2 * np.pi * number * YEARS[:, None, None]
    cosine, sine = (np.asarray(ROOT @ random.normal(size=(len(PLACE), 2))) * sizes for _ in range(2))
    return np.cos(phase) * cosine + np.sin(phase) * sine


@pytest.mark.parametrize("number", [1, 2])
def test_the_variance_of_the_mean_is_that_of_the_field(number: int) -> None:
    sizes = (0.3, 0.15)
    # Of 100 fields the mean is 1.25 of it, because no part is negative; a single one has a sigma of its own size.
    seen = np.mean([found(waves(number, seed, sizes)) for seed in range(12)], axis=0)
    expected = CORRELATION.mean() * np.array(sizes) ** 2
    assert (np.abs(np.log(seen[number - 1] / expected)) < np.log(1.7)).all()
    np.testing.assert_allclose(seen[2 - number], 0.0, atol=0.02 * expected.max())


def test_what_moves_all_places_alike_is_not_seen_and_twice_the_wave_has_four_times_the_variance() -> None:
    one = waves(1, 3, (0.3, 0.15))
    alike = one + 5.0 * np.sin(2 * np.pi * YEARS)[:, None, None] + 0.3 * YEARS[:, None, None]
    np.testing.assert_allclose(found(alike), found(one), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(found(2 * one), 4 * found(one), rtol=1e-4, atol=1e-7)


def test_noise_of_dates_that_is_known_is_no_wave() -> None:
    """White noise of 0.3 px per date and place: unless it is expected, it counts as a wave."""
    noise = np.random.default_rng(5).normal(0.0, 0.3, (72, len(PLACE), 2))
    assert found(noise, noise=0.3).sum() < 0.5 * found(noise).sum()


def test_seasons_are_seen_from_a_year_and_a_half_on() -> None:
    one = waves(1, 4, (0.3, 0.3))
    short = 20.0 + (YEARS - 20.0) / np.ptp(YEARS)
    assert (found(one, years=1.49 * short - 9.8) == 0.0).all()
    assert (found(waves(1, 4, (0.3, 0.3)), years=np.full(72, np.nan)) == 0.0).all()
