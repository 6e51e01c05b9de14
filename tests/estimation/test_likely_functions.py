"""How likely correlation functions of errors are: by the restricted likelihood of dense covariances, written out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ortho_pipeline.estimation.spatial.displacement_field import DisplacementField, _likely
from ortho_pipeline.estimation.spatial.shared_errors import Neighbours, shared_by
from ortho_pipeline.models.base import Array

#: A root of (1 + x) exp(-x) = 1/e.
MATERN = 2.1461932206
SIDE = 0.13


def correlation(family: int, distance: Array) -> Array:
    if family == 1:
        return (1 + MATERN * distance) * np.exp(-MATERN * distance)
    return np.exp(-distance if family == 0 else -(distance**2))


def distances(place: Array) -> Array:
    return np.asarray(np.sqrt(((place[:, None] - place) ** 2).sum(axis=2)))


def restricted(covariance: Array, design: Array, value: Array) -> tuple[float, float]:
    """Return the restricted log-likelihood with the scale that fits best, and the sum of squares that is left."""
    inverse = np.linalg.inv(covariance)
    normal = design.T @ inverse @ design
    left = value - design @ np.linalg.solve(normal, design.T @ inverse @ value)
    square = float(left @ inverse @ left)
    freedom = len(value) - design.shape[1]
    logs = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(normal)[1]
    return -0.5 * float(logs + freedom * math.log(square)), square


# -- displacements -----------------------------------------------------------------------------------------------------


def drawn(count: int) -> tuple[Array, Array, Array]:
    """Return places, displacements that bend along the first axis alone, and variances of their noise."""
    random = np.random.default_rng(21)
    place = random.uniform([-0.5, -0.35], [0.5, 0.35], (count, 2))
    value = random.normal(0.0, [0.4, 0.7], (count, 2))
    value[:, 0] += 1.5 * np.sin(9.0 * place[:, 0] + 3.0 * place[:, 1])
    return place, value, random.uniform(0.5, 3.0, count)


def chip_noise(place: Array, weight: Array) -> Array:
    common = np.maximum(SIDE - np.abs(place[:, None] - place), 0.0).prod(axis=2) / SIDE**2
    found = 0.98 * common * np.sqrt(np.outer(weight, weight))
    np.fill_diagonal(found, weight)
    return np.asarray(found)


def test_functions_of_a_field_are_as_likely_as_their_restricted_likelihood() -> None:
    """A field that shows more variance than the residuals is less likely; no field is as likely as any strength."""
    place, value, weight = drawn(40)
    axes = _likely(place, value, weight, SIDE)
    noise, design = chip_noise(place, weight), np.column_stack([np.ones(40), place])
    chips = np.sqrt(distances(place) ** 2 + SIDE**2 / 3)
    for axis, one in enumerate(axes):
        assert one.freedom == 37
        whole = restricted(noise, design, value[:, axis])[1] / 37
        logs, squares = np.zeros(one.chance.shape), np.zeros(one.chance.shape)
        for (i, (family, length)), (j, ratio) in (
            (a, b) for a in enumerate(one.kernels) for b in enumerate(one.ratios.tolist())
        ):
            logs[i, j], squares[i, j] = restricted(
                noise + ratio * correlation(family, chips / length), design, value[:, axis]
            )
            logs[i, j] -= math.log(max(squares[i, j] / 37 * (1 + ratio) / whole, 1.0))
            logs[i, j] += math.log(16) if j == 0 else 0.0
        chance = np.exp(logs - logs.max())
        np.testing.assert_allclose(one.squares, squares, rtol=1e-7)
        np.testing.assert_allclose(one.chance, chance / chance.sum(), rtol=1e-6, atol=1e-12)
    # The first axis has a field, the second has none.
    assert axes[0].chance[:, 0].sum() < 0.01
    assert axes[1].chance[:, 0].sum() > 0.3


def test_ranges_are_from_that_of_neighbours_or_chips_to_the_extent_and_ratios_from_a_mean_of_noise() -> None:
    place, value, weight = drawn(40)
    nearest = float(np.median(np.sort(distances(place), axis=1)[:, 1]))
    assert nearest < SIDE
    for side, shortest in ((SIDE, SIDE), (0.0, nearest), (0.7, 0.5)):
        one, _ = _likely(place, value, weight, side)
        assert [family for family, _ in one.kernels] == [0] * 8 + [1] * 8 + [2] * 8
        np.testing.assert_allclose([length for _, length in one.kernels], np.tile(np.geomspace(shortest, 1.0, 8), 3))
        np.testing.assert_allclose(one.ratios, [0.0, *np.geomspace(1 / 40, 1e4, 16)])


def test_a_trend_has_no_slopes_by_the_criterion_of_schwarz() -> None:
    """Each axis against two slopes, with as many displacements as would determine a mean as well."""
    place, _, weight = drawn(40)
    value = np.random.default_rng(2).normal(0.0, [0.4, 0.7], (40, 2)) + place @ [[0.9, 0.2], [-0.3, 1.6]]
    axes = _likely(place, value, weight, SIDE)
    field = DisplacementField(place, value, weight, SIDE, 100.0, np.zeros(2), np.zeros(40, dtype=bool), axes)
    chips = np.sqrt(distances(place) ** 2 + SIDE**2 / 3)
    for axis, one in enumerate(axes):
        kernel, ratio = np.unravel_index(int(one.chance.argmax()), one.chance.shape)
        family, length = one.kernels[kernel]
        covariance = chip_noise(place, weight) + one.ratios[ratio] * correlation(family, chips / length)
        level = np.ones((40, 1))
        squares = [restricted(covariance, part, value[:, axis])[1] for part in (level, np.hstack([level, place]))]
        odds = np.linalg.inv(covariance).sum() * (squares[1] / squares[0]) ** (40 / 2)
        assert 0.01 < odds / (1 + odds) < 0.99
        assert field._constant(axis) == pytest.approx(odds / (1 + odds), rel=1e-7)


def test_displacements_weigh_from_a_quarter_to_sixteen() -> None:
    place, value, _ = drawn(13)
    sigma = np.array([3.0] * 7 + [0.3, 1.6, 4.5, 11.9, 12.1, 99.0])
    found = DisplacementField.of(100.0 * place + 7.0, value, sigma)
    np.testing.assert_allclose(found.weight, [1.0] * 7 + [0.25, (1.6 / 3) ** 2, 2.25, (11.9 / 3) ** 2, 16.0, 16.0])
    np.testing.assert_allclose(found.origin, 100.0 * place.mean(axis=0) + 7.0)
    assert found.scale == pytest.approx(100.0 * max(np.ptp(place[:, 0]), np.ptp(place[:, 1])))
    np.testing.assert_allclose(found.place * found.scale + found.origin, 100.0 * place + 7.0)


# -- errors of neighbours ----------------------------------------------------------------------------------------------


def matched(count: int) -> tuple[Array, Array, Array]:
    """Return image positions, whitened residuals with a bend, and a design of an affine correction."""
    random = np.random.default_rng(4)
    image = random.uniform(0, [2000.0, 1300.0], (count, 2))
    residuals = random.normal(0, [0.8, 1.1], (count, 2))
    residuals[:, 1] += 1.5 * np.sin(image[:, 0] / 400)
    residuals[:, 0] += 0.4 * np.cos(image[:, 1] / 300)
    rows = np.column_stack([np.ones(count), (image - 900.0) / 1000.0])
    design = np.zeros((count, 2, 6))
    design[:, 0, :3], design[:, 1, 3:] = rows / 0.4, rows / 0.5
    return image, residuals, design


def likely(scene: Neighbours, image: Array, variance: float) -> tuple[list[Array], Array, Array, Array]:
    """Return covariances ``(n, n)`` of the errors along both axes, and noise, shared part and range, by definition."""
    distance = distances(image)
    freedom = len(scene.means) - scene.explained.shape[1]
    ratios = np.geomspace(1 / len(image), 1e4, 20)
    covariances, noises, shares, ranges = [], np.zeros(2), np.zeros(2), np.zeros(2)
    for axis in range(2):
        logs, scales, kernels = [], [], []
        for family in range(3):
            for length in scene.ranges:
                kernel = correlation(family, distance / length)
                for ratio in ratios:
                    own = scene.means @ (np.eye(len(image)) + ratio * kernel) @ scene.means.T
                    log, square = restricted(own, scene.explained, scene.left[:, axis])
                    scale = square / (freedom - 2)
                    logs.append(log - math.log(max(scale * (1 + ratio) / variance, 1.0)))
                    scales.append(scale)
                    kernels.append((kernel, ratio, length))
        chance = np.exp(np.array(logs) - max(logs))
        chance /= chance.sum()
        each = [weight * scale for weight, scale in zip(chance, scales, strict=True)]
        own = sum(
            part * (np.eye(len(image)) + ratio * kernel) for part, (kernel, ratio, _) in zip(each, kernels, strict=True)
        )
        covariances.append(np.asarray(own))
        shared = [part * ratio for part, (_, ratio, _) in zip(each, kernels, strict=True)]
        noises[axis], shares[axis] = sum(each), sum(shared)
        mean = sum(part * math.log(length) for part, (_, _, length) in zip(shared, kernels, strict=True)) / sum(shared)
        ranges[axis] = math.exp(mean)
    return covariances, np.sqrt(noises), np.sqrt(shares), ranges


def test_errors_of_neighbours_are_the_mean_over_all_functions() -> None:
    """Of A' Sigma A without that of independent errors; Sigma has a part of each function as likely as it is."""
    image, residuals, design = matched(34)
    order = np.lexsort(image.T)
    image, residuals, design = image[order], residuals[order], design[order]
    scene = Neighbours.of(image, residuals, design)
    assert scene is not None
    # Both coordinates have the same design, which explains means over cells.
    rows, seen = scene.means @ np.column_stack([np.ones(34), image]), scene.means @ residuals
    assert len(rows) < 34
    left = seen - rows @ np.linalg.lstsq(rows, seen, rcond=None)[0]
    near = scene.means @ correlation(1, distances(image) / scene.ranges[8]) @ scene.means.T
    values, axes = np.linalg.eigh(left.T @ near @ left)
    assert values[1] > 1.5 * values[0]
    turn = axes[:, ::-1]
    np.testing.assert_allclose(np.abs(scene.left), np.abs(left @ turn), atol=1e-9)
    nearest = float(np.median(np.sort(distances(image), axis=1)[:, 1]))
    np.testing.assert_allclose(scene.ranges, np.geomspace(nearest, np.ptp(image, axis=0).max(), 16))

    variance = 1.7
    covariances, noise, shared, ranges = likely(scene, image, variance)
    along = np.einsum("ai,nik->ank", turn.T, design)
    wanted = sum(part.T @ (own - variance * np.eye(34)) @ part for part, own in zip(along, covariances, strict=True))
    excess, means = scene.middle(variance)
    np.testing.assert_allclose(excess, wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())
    for name, values in (("noise", noise), ("shared", shared), ("range_px", ranges)):
        np.testing.assert_allclose(means[name], values, rtol=1e-6)
    # Of a third of all points: thrice the errors of their own, and nine times those between them.
    alone = sum((own[0, 0] - variance) * part.T @ part for part, own in zip(along, covariances, strict=True))
    thinned, _ = replace(scene, weight=3.0).middle(variance)
    np.testing.assert_allclose(thinned, 9 * wanted - 6 * alone, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())


def test_effective_points_determine_a_shift_as_well() -> None:
    """With points of their own: 34 that share errors, and six that do not."""
    image, residuals, design = matched(34)
    order = np.lexsort(image.T)
    image, residuals, design = image[order], residuals[order], design[order]
    shift = np.broadcast_to(np.diag([1 / 0.4, 1 / 0.5]), (40, 2, 2))
    found, excess = shared_by(image, residuals, design, np.arange(34) // 2, shift, shift[:34], 1.3)
    assert excess is not None
    assert excess.shape == (6, 6)
    scene = Neighbours.of(image, residuals, np.concatenate([design, shift[:34]], axis=2))
    assert scene is not None
    more = scene.middle(1.3)[0][-2:, -2:]
    root = np.diag([math.sqrt(40) / 0.4, math.sqrt(40) / 0.5])
    values, vectors = np.linalg.eigh(np.linalg.inv(root) @ more @ np.linalg.inv(root))
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    # Variances of a shift (px): of independent errors, and with those that are shared.
    usual = 1.3 / 40 * (0.4**2 + 0.5**2)
    together = usual + np.trace(np.linalg.inv(root) @ positive @ np.linalg.inv(root))
    assert (found.points, found.groups) == (34, 17)
    assert found.effective_points == pytest.approx(40 * usual / together, rel=1e-9)
    assert found.effective_points < 20


def test_groups_of_few_points_count_once() -> None:
    image, residuals, design = matched(29)
    shift = np.broadcast_to(np.eye(2), (36, 2, 2))
    found, excess = shared_by(image, residuals, design, np.arange(29) // 3, shift, shift[:29], 1.0)
    assert excess is None
    assert (found.points, found.groups, found.effective_points) == (29, 10, 36 - 29 + 10)
    assert (found.noise, found.shared, found.range_px) == (None, None, None)
