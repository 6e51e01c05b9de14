"""The displacement field of matches: what it states of its mean contains the truth, also where chips share noise."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.estimation.spatial.displacement_field import DisplacementField
from ortho_pipeline.runtime.process_limits import one_blas_thread

CHIP, SIZE = 10, 60


@one_blas_thread()
def test_chips_that_overlap_do_not_count_as_independent():
    """Errors are means of white noise over chips, as those of least-squares matching are."""
    spread = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        sums = np.zeros((SIZE + 1, SIZE + 1, 2))
        sums[1:, 1:] = random.normal(0, 1, (SIZE, SIZE, 2)).cumsum(axis=0).cumsum(axis=1)
        left, top = random.integers(0, SIZE - CHIP + 1, (2, 80))
        right, bottom = left + CHIP, top + CHIP
        value = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        place = np.column_stack([left, top]) + CHIP / 2
        cells = np.stack(np.meshgrid(np.arange(5, 60, 10.0), np.arange(5, 60, 10.0)), axis=-1).reshape(-1, 2)
        means = DisplacementField.of(place, value / CHIP, side=float(CHIP)).draws(cells, seed).mean(axis=1)
        spread.append(means.mean(axis=0) / means.std(axis=0))
    assert 0.75 < np.sqrt(np.mean(np.square(spread))) < 1.25


def test_a_field_does_not_depend_on_where_coordinates_begin():
    """Places in a projected CRS are millions; their differences are what counts."""
    random = np.random.default_rng(2)
    place = random.uniform(0, 4000, (60, 2))
    value = np.column_stack([np.sin(place[:, 0] / 900), np.cos(place[:, 1] / 700)]) + random.normal(0, 0.1, (60, 2))
    sigma, cells = random.uniform(0.5, 2.0, 60), random.uniform(0, 4000, (20, 2))
    here, there = (
        DisplacementField.of(place + begin, value, sigma, 50.0).draws(cells + begin, 1)
        for begin in (np.zeros(2), np.array([500_000.0, 4_000_000.0]))
    )
    np.testing.assert_allclose(there.mean(axis=0), here.mean(axis=0), atol=1e-3)
    np.testing.assert_allclose(there.std(axis=0), here.std(axis=0), rtol=1e-2)


def smooth(place: np.ndarray) -> np.ndarray:
    """Return a displacement that bends: what no affine trend follows."""
    x, y = place.T / 1000
    return np.column_stack([2 + np.sin(2 * x) + 0.3 * y, -1 + np.cos(1.5 * y)])


def test_displacements_that_contradict_their_neighbours_are_local():
    random = np.random.default_rng(7)
    place = random.uniform(0, 4000, (150, 2))
    value, wrong = smooth(place) + random.normal(0, 0.05, (150, 2)), np.isin(np.arange(150), [3, 50, 51, 120])
    value[wrong] += random.choice([-1, 1], (4, 2)) * (1.5, 2.5)
    found = DisplacementField.of(place, value)
    np.testing.assert_array_equal(found.local, wrong)
    assert len(found.place) == 146
    inner = random.uniform(500, 3500, (40, 2))
    assert np.abs(found.mean(inner) - smooth(inner)).max() < 0.2
    np.testing.assert_allclose(found.noise, 0.05, rtol=0.3)
    assert DisplacementField.of(place[~wrong], value[~wrong]).local.sum() == 0


def test_a_displacement_contradicts_its_neighbours_from_four_and_a_half_sigmas_on():
    """Of 60 displacements of 0.1 to any side, one is 0.4 to the right, 3.6 of its sigmas, and one 2 downwards."""
    random = np.random.default_rng(7)
    place, value = random.uniform(0, 1000, (60, 2)), random.choice([-0.1, 0.1], (60, 2))
    value[5, 0], value[9, 1] = 0.4, 2.0
    others = np.arange(60) != 9
    np.testing.assert_allclose(value[others].std(axis=0), (0.11, 0.1), rtol=0.03)
    assert np.flatnonzero(DisplacementField.of(place, value).local).tolist() == [9]


def test_the_trend_of_a_plane_is_its_coefficients():
    """At the middle of the places, and per unit of x and y, whatever the unit is."""
    random = np.random.default_rng(3)
    for unit in (1.0, 1e-3, 500.0):
        place = random.uniform(0, [3 * unit, unit], (40, 2)) + 100 * unit
        slopes = np.array([[0.3, -0.2], [0.1, 0.4]]) / unit
        found = DisplacementField.of(place, place @ slopes + (5.0, -7.0) + random.normal(0, 1e-4, (40, 2)))
        trend = found.trend()
        np.testing.assert_allclose(trend[1:], slopes, rtol=2e-3)
        np.testing.assert_allclose(trend[0], found.origin @ slopes + (5.0, -7.0), atol=1e-3)


def test_displacements_weigh_by_their_sigmas():
    """Of errors that are independent, the best plane is that of weighted least squares."""
    random = np.random.default_rng(4)
    place, sigma = random.uniform(0, 1000, (200, 2)), np.repeat([0.1, 0.2, 0.4], [60, 80, 60])
    value = random.normal(0, 1, (200, 2)) * sigma[:, None]
    found = DisplacementField.of(place, value, sigma)
    np.testing.assert_allclose(found.noise, 0.2, rtol=0.2)
    design = np.column_stack([np.ones(200), place - place.mean(axis=0)]) / sigma[:, None]
    expected = np.linalg.lstsq(design, value / sigma[:, None], rcond=None)[0]
    np.testing.assert_allclose(found.trend()[0], expected[0], atol=0.01)
    assert (found.shared < 0.1).all()


def test_what_is_held_out_is_predicted_from_the_rest():
    random = np.random.default_rng(5)
    place = random.uniform(0, 4000, (120, 2))
    value, groups = smooth(place) + random.normal(0, 0.05, (120, 2)), random.integers(0, 6, 120)
    found = DisplacementField.of(place, value)
    assert not found.local.any()
    field, trend = found.held_out(groups)
    for group in range(6):
        out = groups == group
        design = np.column_stack([np.ones(120), place])
        plane = np.linalg.lstsq(design[~out], value[~out], rcond=None)[0]
        square = ((value[out] - design[out] @ plane) ** 2).sum(axis=1)
        assert trend[group] == pytest.approx(square.mean(), rel=1e-6)
    # The field follows what the plane does not, up to the noise.
    assert 0.05**2 < field.mean() < 0.05 * trend.mean()


def test_a_rate_is_found_beside_a_trend_with_its_sigma():
    """Displacements that grow with height, on a plane: rates, their sigmas and the level at height zero."""
    ratios = []
    for seed in range(12):
        random = np.random.default_rng(seed)
        place, height = random.uniform(0, 2000, (60, 2)), random.uniform(0, 300, 60)
        plane = (place - place.mean(axis=0)) @ [[1e-3, 0.0], [-2e-3, 1e-3]] + (4.0, 1.0)
        value = plane + height[:, None] * (0.01, -0.02) + random.normal(0, 0.2, (60, 2))
        rates, sigmas, level = DisplacementField.of(place, plane + random.normal(0, 0.2, (60, 2))).regressed(
            place, value, height
        )
        ratios.append((rates - (0.01, -0.02)) / sigmas)
        np.testing.assert_allclose(level, (4.0, 1.0), atol=0.4)
        np.testing.assert_allclose(sigmas, 0.2 / np.sqrt(60) / (300 / np.sqrt(12)), rtol=0.5)
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_fields_have_slopes_where_displacements_show_them():
    """Beyond the last match a plane goes on as a plane, and a constant is as certain as a constant."""
    random = np.random.default_rng(6)
    place, noise = random.uniform(0, 1000, (60, 2)), random.normal(0, 0.1, (60, 2))
    corners = np.array([[-600.0, -600.0], [1600.0, 1600.0]])
    plane = np.array([[0.004, -0.003], [0.002, 0.005]])
    draws = DisplacementField.of(place, place @ plane + noise).draws(corners)
    np.testing.assert_allclose(draws.mean(axis=0), corners @ plane, atol=0.3)
    constant = DisplacementField.of(place, noise).draws(corners)
    assert np.abs(np.median(constant, axis=0)).max() < 0.05
    assert (np.median(np.abs(constant), axis=0) < 0.05).all()
    finer = DisplacementField.of(place, 1000 * noise).draws(corners)
    np.testing.assert_allclose(finer, 1000 * constant, rtol=1e-6)


def test_size_and_range_of_a_field_are_those_that_it_was_drawn_with():
    """Means of fields with a standard deviation of 0.5 and an exponential correlation of 400 m; noise of 0.1."""
    found = []
    for seed in range(6):
        random = np.random.default_rng(seed)
        place = random.uniform(0, 5000, (150, 2))
        distance = np.hypot(*(place[:, None] - place).T)
        root = np.linalg.cholesky(0.25 * np.exp(-distance / 400.0) + 1e-9 * np.eye(150))
        value = root @ random.normal(0, 1, (150, 2)) + random.normal(0, 0.1, (150, 2))
        field = DisplacementField.of(place, value)
        found.append([field.shared.mean(), field.range.mean(), np.sqrt((field.noise**2 + field.shared**2).mean())])
    shared, reach, total = np.median(found, axis=0)
    assert shared == pytest.approx(0.5, abs=0.1)
    assert 250 < reach < 650
    assert total == pytest.approx(np.hypot(0.5, 0.1), rel=0.2)
