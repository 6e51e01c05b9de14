"""The displacement field against universal kriging and generalised least squares, written out."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.errors import TooFewPoints
from ortho_pipeline.estimation.spatial.displacement_field import DisplacementField, _Axis, _between_chips, _noise

RANGE, RATIOS, SIDE, SCALE, ORIGIN = 0.3, (2.0, 0.7), 0.1, 500.0, np.array([1000.0, -300.0])
FREEDOM, SQUARES = 21, (5.25, 0.84)
random = np.random.default_rng(8)
PLACE, WEIGHT, VALUE = random.uniform(-0.5, 0.5, (24, 2)), random.uniform(0.5, 2.0, 24), random.normal(0, 1, (24, 2))
NEW = np.array([[0.1, -0.2], [0.9, 0.4], [-0.3, 0.05]])


def field() -> DisplacementField:
    """Return a field of one exponential function for each axis."""
    axes = tuple(
        _Axis(((0, RANGE),), np.array([ratio]), np.ones((1, 1)), np.array([[squares]]), FREEDOM)
        for ratio, squares in zip(RATIOS, SQUARES, strict=True)
    )
    return DisplacementField(PLACE, VALUE, WEIGHT, SIDE, SCALE, ORIGIN, np.zeros(24, dtype=bool), axes)


def exponential(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.exp(-np.sqrt(((one[:, None] - other) ** 2).sum(axis=2) + SIDE**2 / 3) / RANGE)


def noise(place: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """98 % of the noise of two chips is that of the pixels, of which they have an area in common."""
    found = np.diag(weight)
    for i in range(len(place)):
        for j in range(len(place)):
            common = np.prod(np.maximum(SIDE - np.abs(place[i] - place[j]), 0.0)) / SIDE**2
            if i != j:
                found[i, j] = 0.98 * common * np.sqrt(weight[i] * weight[j])
    return found


def kriged(axis: int, place: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance (over that of the noise) by the bordered system of universal kriging."""
    here, count = PLACE[used], int(used.sum())
    own = noise(here, WEIGHT[used]) + RATIOS[axis] * exponential(here, here)
    design, there = (np.column_stack([np.ones(len(xy)), xy]) for xy in (here, place))
    system = np.block([[own, design], [design.T, np.zeros((3, 3))]])
    right = np.vstack([RATIOS[axis] * exponential(here, place), there.T])
    weights = np.linalg.solve(system, right)
    covariance = RATIOS[axis] * exponential(place, place) - right.T @ weights
    return weights[:count].T @ VALUE[used, axis], covariance


EVERY = np.ones(24, dtype=bool)


def test_the_mean_is_that_of_universal_kriging():
    found = field().mean(NEW * SCALE + ORIGIN)
    np.testing.assert_allclose(found, np.column_stack([kriged(axis, NEW, EVERY)[0] for axis in (0, 1)]), rtol=1e-9)


def test_draws_have_the_mean_and_the_covariance_of_universal_kriging():
    found = field()
    for axis in (0, 1):
        mean, root = found._kriged(axis, (0, RANGE), RATIOS[axis], NEW, root=True)
        expected, covariance = kriged(axis, NEW, EVERY)
        np.testing.assert_allclose(mean, expected, rtol=1e-9)
        # A thousandth of the size of field and noise is added, so that the root exists where places are known.
        np.testing.assert_allclose(root @ root.T, covariance + 1e-6 * (1 + RATIOS[axis]) * np.eye(3), rtol=0, atol=1e-9)


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_displacements_that_are_all_the_same_have_a_field(shift):
    """Without noise; drawn at the places of matches, of which two are at one place."""
    place = np.vstack([PLACE, PLACE[:2]])
    found = DisplacementField.of(PLACE, np.full((24, 2), shift), side=SIDE)
    assert not found.local.any()
    np.testing.assert_allclose(found.draws(place), shift, atol=1e-6)


def test_the_trend_is_that_of_generalised_least_squares_in_the_units_of_places():
    found = field().trend()
    design = np.column_stack([np.ones(24), PLACE * SCALE])
    for axis in (0, 1):
        inverse = np.linalg.inv(noise(PLACE, WEIGHT) + RATIOS[axis] * exponential(PLACE, PLACE))
        expected = np.linalg.solve(design.T @ inverse @ design, design.T @ inverse @ VALUE[:, axis])
        np.testing.assert_allclose(found[:, axis], expected, rtol=1e-8)


def test_noise_shared_part_and_range_are_in_the_units_of_the_displacements():
    found = field()
    np.testing.assert_allclose(found.noise, [0.5, 0.2])
    np.testing.assert_allclose(found.shared, [0.5 * np.sqrt(2.0), 0.2 * np.sqrt(0.7)])
    np.testing.assert_allclose(found.range, [150.0, 150.0])


def test_what_is_apart_is_measured_in_the_sigma_of_its_prediction_without_it():
    """A displacement against what all others say of it: signal, and its own noise that nobody shares."""
    expected = np.zeros(24)
    for axis in (0, 1):
        whole = noise(PLACE, WEIGHT) + RATIOS[axis] * exponential(PLACE, PLACE)
        design = np.column_stack([np.ones(24), PLACE])
        for out in range(24):
            rest = np.arange(24) != out
            system = np.block([[whole[rest][:, rest], design[rest]], [design[rest].T, np.zeros((3, 3))]])
            right = np.concatenate([whole[rest, out], design[out]])
            weights = np.linalg.solve(system, right)
            error = VALUE[out, axis] - weights[:23] @ VALUE[rest, axis]
            expected[out] += error**2 / (whole[out, out] - right @ weights) / (SQUARES[axis] / FREEDOM)
    np.testing.assert_allclose(field()._apart(), expected, rtol=1e-7)


def test_groups_are_predicted_from_all_others():
    groups = np.arange(24) % 3
    squares, _ = field().held_out(groups)
    for group in range(3):
        out = groups == group
        errors = [VALUE[out, axis] - kriged(axis, PLACE[out], ~out)[0] for axis in (0, 1)]
        assert squares[group] == pytest.approx(np.square(errors).sum(axis=0).mean(), rel=1e-9)


def test_a_rate_is_that_of_generalised_least_squares_with_its_sigma():
    along = np.random.default_rng(1).uniform(0, 100, 24)
    rates, sigmas, level = field().regressed(PLACE * SCALE + ORIGIN, VALUE, along)
    design = np.column_stack([np.ones(24), PLACE, along])
    for axis in (0, 1):
        inverse = np.linalg.inv(noise(PLACE, np.ones(24)) + RATIOS[axis] * exponential(PLACE, PLACE))
        cofactors = np.linalg.inv(design.T @ inverse @ design)
        expected = cofactors @ design.T @ inverse @ VALUE[:, axis]
        left = VALUE[:, axis] - design @ expected
        assert (level[axis], rates[axis]) == pytest.approx((expected[0], expected[3]), rel=1e-8)
        assert sigmas[axis] == pytest.approx(np.sqrt(left @ inverse @ left / 20 * cofactors[3, 3]), rel=1e-8)


def test_chips_share_the_noise_of_their_common_pixels():
    place, weight = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.5], [2.0, 0.0]]), np.array([1.0, 4.0, 9.0, 1.0])
    # Of chips with sides of 2, neighbours have 1/2, 1/4 and 1/8 of their pixels in common, the first and last none.
    half, quarter, eighth = 0.98 / 2, 0.98 / 4, 0.98 / 8
    np.testing.assert_allclose(
        _noise(place, weight, 2.0),
        [[1, 2 * half, 3 * eighth, 0], [2 * half, 4, 6 * quarter, 2 * half],
         [3 * eighth, 6 * quarter, 9, 3 * eighth], [0, 2 * half, 3 * eighth, 1]],
        atol=1e-12,
    )  # fmt: skip
    np.testing.assert_array_equal(_noise(place, weight, 0.0), np.diag(weight))


def test_the_distance_of_chips_is_the_root_mean_square_of_that_of_their_points():
    side, centres = 2.0, np.array([0.0, 3.0])
    inside = (np.arange(200) + 0.5) / 200 * side - side / 2
    across = ((inside[:, None] + centres[1] - inside) ** 2).mean() + ((inside[:, None] - inside) ** 2).mean()
    assert _between_chips(np.array([3.0]), side)[0] == pytest.approx(np.sqrt(across), rel=1e-4)


@pytest.mark.parametrize("turn", [0.0, 30.0, 45.0, 90.0])
def test_places_on_a_line_determine_no_field(turn):
    drawn = np.random.default_rng(2)
    along = drawn.uniform(0, 1000, 30)[:, None] * [np.cos(np.radians(turn)), np.sin(np.radians(turn))] + 4e6
    with pytest.raises(TooFewPoints):
        DisplacementField.of(along, drawn.normal(0, 1, (30, 2)))
    # A strip is enough.
    DisplacementField.of(along + drawn.normal(0, 2, (30, 2)), drawn.normal(0, 1, (30, 2)))


def test_twelve_displacements_are_enough():
    drawn = np.random.default_rng(3)
    place, value = drawn.uniform(0, 1, (12, 2)), drawn.normal(0, 1, (12, 2))
    assert DisplacementField.of(place, value).draws(place[:2]).shape[1:] == (2, 2)
    for some in (place[:11], np.ones((12, 2)), place[:0]):
        with pytest.raises(TooFewPoints):
            DisplacementField.of(some, value[: len(some)])
