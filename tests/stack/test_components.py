"""Error components of edges: expected products, covariances and scales, against dense matrices."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ortho_pipeline.block.stack.components import (
    ErrorComponents,
    _scales,
    _Shapes,
    _spread,
    _with_common_date,
    classes_of,
    components_of,
    correlations_of,
    season_correlation,
)
from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.trends import Trends, design_of, trends_of

RANDOM = np.random.default_rng(4)
#: Dates of four edges; the places of a small stack.
FIRST, SECOND = np.array([1, 2, 2, 3]), np.array([0, 0, 1, 1])
PLACE = RANDOM.uniform(-1, 1, (14, 2))
VARIANCE = RANDOM.uniform(0.01, 0.04, (4, 14))


def made(terms: int = 1, noise: float = 0.1) -> tuple[Edges, Trends]:
    """Return four edges with white noise, one of them without a place, and their trends."""
    value = np.random.default_rng(6).normal(0.0, noise, (4, 14, 2))
    value[1, 3] = np.nan
    edges = Edges(FIRST, SECOND, value, VARIANCE, np.array([0.0, 0.1, 0.2, 0.3]))
    return edges, trends_of(edges, design_of(PLACE, terms), np.ones(14, dtype=bool))


def components() -> ErrorComponents:
    random = np.random.default_rng(8)
    return ErrorComponents(
        random.uniform(0.1, 1.0, (2, 7)), random.uniform(0.1, 1.0, (2, 7)), np.array([0.5, 1.0, 2.0, 3.0]),
        np.array([0.3, 0.7, 1.1, 1.9]), np.array([0.05, -0.02]),
    )  # fmt: skip


def kernels(edges: Edges, one: int, other: int) -> list[np.ndarray]:
    """Return the seven correlations of the places of two edges: noise, exponentials, Gaussians."""
    distance = np.linalg.norm(PLACE[:, None] - PLACE, axis=2)
    noise = np.diag(np.sqrt(edges.relative[one] * edges.relative[other]))
    ranges = (0.2, 0.5, 1.25)
    return [noise, *(np.exp(-distance / far) for far in ranges), *(np.exp(-((distance / far) ** 2)) for far in ranges)]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("terms", [1, 3])
def test_the_covariance_of_trends_is_that_of_all_values_through_their_weights(axis: int, terms: int) -> None:
    edges, trends = made(terms)
    errors = components()
    found, own = errors.covariance(axis, edges, trends, PLACE)
    expected = np.zeros((4, terms, 4, terms))
    for one in range(4):
        for other in range(4):
            both = kernels(edges, one, other)
            of_dates = np.tensordot(errors.shared[axis], both, 1)
            signs = [
                sign * back * errors.scale[date]
                for date, sign in ((FIRST[one], 1), (SECOND[one], -1))
                for same, back in ((FIRST[other], 1), (SECOND[other], -1))
                if date == same
            ]
            block = sum(signs) * trends.weights[one].T @ of_dates @ trends.weights[other]
            if one == other:
                of_edge = errors.factor[one] * np.tensordot(errors.own[axis], both, 1)
                alone = trends.weights[one].T @ of_edge @ trends.weights[one]
                alone[0, 0] += errors.constant[axis] + edges.alike[one] ** 2
                np.testing.assert_allclose(own[one], alone, rtol=1e-9)
                block = block + alone
            expected[one, :, other] = block
    np.testing.assert_allclose(found.toarray(), expected.reshape(4 * terms, -1), rtol=1e-9, atol=1e-12)


def test_the_variance_of_a_single_value_is_the_mean_of_both_axes() -> None:
    edges, _ = made()
    errors = components()
    shared, own = errors.at_place(edges)
    of_date = [(errors.shared[axis, 0] * edges.relative + errors.shared[axis, 1:].sum()) for axis in (0, 1)]
    of_edge = [(errors.own[axis, 0] * edges.relative + errors.own[axis, 1:].sum()) for axis in (0, 1)]
    np.testing.assert_allclose(shared, (of_date[0] + of_date[1]) / 2)
    rest = (0.05 - 0.02) / 2 + np.array([0.0, 0.01, 0.04, 0.09])
    np.testing.assert_allclose(own, errors.factor[:, None] * (of_edge[0] + of_edge[1]) / 2 + rest[:, None])


def test_what_loops_lack_is_shared_by_two_dates() -> None:
    errors = dataclasses.replace(components(), constant=np.array([-0.08, 0.03]))
    np.testing.assert_allclose(errors.of_seasons(np.full(5, 0.3)), [0.04, 0.0])
    # Of most edges three times as much is stated as of the quietest one.
    np.testing.assert_allclose(errors.of_seasons(np.array([0.3, 0.9, 0.9])), [0.36, 0.0])
    none = dataclasses.replace(components(), constant=np.zeros(2))
    np.testing.assert_array_equal(none.of_seasons(np.zeros(5)), [0.0, 0.0])


def test_correlations_and_classes_of_places_by_hand() -> None:
    place = np.array([[0.0, 0.0], [0.3, 0.4], [0.0, -0.1]])
    found = correlations_of(place)
    assert found.shape == (6, 3, 3)
    np.testing.assert_allclose(found[:, 0, 1], np.exp([-2.5, -1.0, -0.4, -6.25, -1.0, -0.16]))
    np.testing.assert_allclose(found[:, 0, 0], 1.0)
    # Limits: 1e-6, 0.18, 0.3, 0.45, 0.65, 0.9, 1.2, 1.6, 3.0; distances 0, 0.5, 0.1 and 0.58.
    assert classes_of(place).tolist() == [[0, 4, 1], [4, 0, 4], [1, 4, 0]]
    far = np.array([[0.0, 0.0], [0.17, 0], [0.31, 0], [0.46, 0], [0.89, 0], [0.91, 0], [1.3, 0], [2.9, 0], [3.1, 0]])
    assert classes_of(far)[0].tolist() == [0, 1, 3, 4, 5, 6, 7, 8, 9]


def test_a_quarter_of_a_year_is_the_length_of_a_season() -> None:
    found = season_correlation(np.array([10.0, 10.25, 10.5, 13.0, np.nan]))
    np.testing.assert_allclose(found[0], [1.0, np.exp(-1), np.exp(-2), 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(found[4], [0, 0, 0, 0, 1])


@pytest.mark.parametrize("terms", [1, 3])
def test_expected_products_are_those_of_residuals_of_the_trends(terms: int) -> None:
    """Residuals are (I - D W') e, so products are of the matrix (I - D W') C (I - D W')'."""
    edges, trends = made(terms)
    left = trends.residual
    shapes = _Shapes(edges, trends, PLACE, left)
    pairs = [(0, 0, 1.0), (0, 1, -1.0), (1, 2, 1.0)]
    expected, seen, number = shapes._sums(pairs)
    classes = classes_of(PLACE)
    wanted, products, count = np.zeros((10, 7)), np.zeros((10, 2)), np.zeros(10)
    for one, other, sign in pairs:
        first, second = (np.flatnonzero(trends.used[edge]) for edge in (one, other))
        # Places that take no part have no weight, so the trend at the others is that of all.
        before = np.eye(14) - trends.design @ trends.weights[one].T
        behind = np.eye(14) - trends.design @ trends.weights[other].T
        for term, kernel in enumerate(kernels(edges, one, other)):
            whole = before[np.ix_(first, first)] @ kernel[np.ix_(first, second)] @ behind[np.ix_(second, second)].T
            for i, row in enumerate(first):
                for j, column in enumerate(second):
                    wanted[classes[row, column], term] += whole[i, j]
        for row in first:
            for column in second:
                count[classes[row, column]] += 1
                products[classes[row, column]] += sign * left[one, row] * left[other, column]
    np.testing.assert_allclose(number, count)
    np.testing.assert_allclose(seen, products, atol=1e-12)
    np.testing.assert_allclose(expected, wanted, rtol=1e-9, atol=1e-12)


def test_variances_are_those_whose_expected_products_were_seen() -> None:
    """If the products are exactly what some components make, these components are found, and their parts."""
    edges, trends = made()
    shapes = _Shapes(edges, trends, PLACE, trends.residual)
    of_date, of_edge = np.array([0.5, 0.0, 0.2, 0, 0, 0, 0]), np.array([0.3, 0.4, 0.0, 0, 0, 0, 0])
    sums = shapes._sums

    def exact(pairs: list[tuple[int, int, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        expected, _, number = sums(pairs)
        value = expected @ (2 * of_date + of_edge) if pairs is shapes.single else expected @ of_date
        return expected, np.column_stack([value, 4 * value]), number

    shapes._sums = exact  # type: ignore[method-assign]
    (shared, own, parts), (other, rest, more) = shapes.variances()
    expected, _, number = sums(shapes.single)
    np.testing.assert_allclose([shared, own], [of_date, of_edge], atol=1e-6)
    np.testing.assert_allclose([other, rest], [4 * of_date, 4 * of_edge], atol=1e-5)
    of_one = expected[0] / number[0]
    np.testing.assert_allclose(parts, [2 * of_one @ of_date, of_one @ of_edge], rtol=1e-5)
    np.testing.assert_allclose(more, 4 * parts, rtol=1e-5)


def test_components_grow_with_the_square_of_the_errors() -> None:
    edges, trends = made()
    one = components_of(edges, trends, PLACE, 4)
    three = components_of(edges, dataclasses.replace(trends, residual=3 * trends.residual), PLACE, 4)
    np.testing.assert_allclose(three.shared, 9 * one.shared, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(three.own, 9 * one.own, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(three.scale, one.scale)
    np.testing.assert_allclose(three.factor, one.factor)
    np.testing.assert_array_equal(one.constant, 0.0)


def test_the_size_of_an_edge_does_not_change_what_parts_its_errors_have() -> None:
    """An edge of large errors, as under a cloud, has a large factor. It does not decide what neighbours share."""
    edges, trends = made()
    before = components_of(edges, trends, PLACE, 4)
    found = components_of(
        edges, dataclasses.replace(trends, residual=trends.residual * np.array([1, 30, 1, 1])[:, None, None]), PLACE, 4
    )
    parts = [np.hstack([one.shared, one.own]) for one in (before, found)]
    assert (parts[0] > 0).sum() > 2
    np.testing.assert_allclose(parts[1] / parts[1].sum(), parts[0] / parts[0].sum(), rtol=1e-6, atol=1e-12)


def test_components_explain_the_typical_residual() -> None:
    """What they make of a residual, both dates and the edge, is its mean square of the median edge."""
    edges, trends = made()
    found = components_of(edges, trends, PLACE, 4)
    size = [(trends.residual[edge] ** 2).sum() / (2 * trends.used[edge].sum()) for edge in range(4)]
    shapes = _Shapes(edges, trends, PLACE, trends.residual)
    expected, _, number = shapes._sums(shapes.single)
    of_one = expected[0] / number[0]
    typical = np.mean([of_one @ (2 * found.shared[axis] + found.own[axis]) for axis in (0, 1)])
    assert typical == pytest.approx(np.median(np.sqrt(size)) ** 2, rel=1e-6)


def test_a_date_with_twice_the_errors_has_four_times_the_scale() -> None:
    value = np.random.default_rng(1).normal(0.0, 0.1, (120, 60, 2))
    edges = dataclasses.replace(ring(16), value=value, variance=np.full((120, 60), 0.01))
    place = np.random.default_rng(2).uniform(-1, 1, (60, 2))
    large = (edges.first == 5) | (edges.second == 5)
    value[large] *= np.sqrt(2.5)  # (4 + 1) / 2 of the variance of the others
    trends = trends_of(edges, design_of(place, 1), np.ones(60, dtype=bool))
    found = components_of(edges, trends, place, 16)
    assert found.scale[5] / np.median(found.scale) == pytest.approx(4.0, rel=0.1)
    residual = np.median(np.sqrt((trends.residual**2).sum(axis=(1, 2)) / (2 * trends.used.sum(axis=1))))
    np.testing.assert_allclose((2 * found.shared + found.own).sum(axis=1), residual**2, rtol=0.1)


def test_edges_without_errors_have_white_ones_of_almost_nothing() -> None:
    edges, trends = made(noise=0.0)
    found = components_of(edges, trends, PLACE, 4)
    np.testing.assert_array_equal(found.shared, 0.0)
    np.testing.assert_allclose(found.own, 1e-12 * np.eye(7)[[0, 0]])


def ring(dates: int) -> Edges:
    """Return edges between all dates."""
    first, second = np.triu_indices(dates, 1)[::-1]
    count = len(first)
    return Edges(first, second, np.zeros((count, 1, 2)), np.ones((count, 1)), np.zeros(count))


def test_the_scales_of_dates_explain_the_sizes_of_edges() -> None:
    edges, truth = ring(6), np.array([0.5, 0.7, 1.0, 1.2, 1.5, 2.5])
    square = (truth[edges.first] + truth[edges.second]) / 2
    scale, factor = _scales(edges, np.arange(len(edges)), square, np.array([0.6, 0.4]), 6)
    np.testing.assert_allclose(scale, truth, rtol=0.015)
    # What dates do not explain, 0.4 of each, belongs to the edge: the same factor.
    mean = (scale[edges.first] + scale[edges.second]) / 2
    np.testing.assert_allclose(factor, (square - 0.6 * mean) / 0.4)


def test_the_factor_of_an_edge_has_limits_and_needs_a_part() -> None:
    edges = ring(16)
    square = np.ones(120)
    square[3], square[70] = 0.05, 900.0
    parts = np.array([0.5, 0.5])
    scale, factor = _scales(edges, np.arange(120), square, parts, 16)
    mean = (scale[edges.first] + scale[edges.second]) / 2
    assert factor[3] == pytest.approx(0.25 * mean[3])
    assert factor[70] == pytest.approx(25.0 * mean[70])
    usual = (1.0 - 0.5 * mean) / 0.5
    inside = np.setdiff1d(np.flatnonzero((usual > 0.26 * mean) & (usual < 24 * mean)), [3, 70])
    assert len(inside) > 80
    np.testing.assert_allclose(factor[inside], usual[inside])
    _, without = _scales(edges, np.arange(120), square, np.array([0.96, 0.04]), 16)
    np.testing.assert_allclose(without, mean)
    _, just = _scales(edges, np.arange(120), np.ones(120), np.array([0.94, 0.06]), 16)
    np.testing.assert_allclose(just, 1.0, rtol=1e-6)
    np.testing.assert_allclose(_scales(edges, np.arange(120), 2 * np.ones(120), parts, 16)[0], 2.0, rtol=1e-6)
    # One edge counts at most nine times what is expected, however large it is.
    more, _ = _scales(edges, np.arange(120), np.where(square > 100, 1e6, square), parts, 16)
    np.testing.assert_allclose(more, scale)


def test_pairs_of_edges_have_a_common_date_and_its_sign() -> None:
    edges, _ = made()
    found = _with_common_date(edges, np.arange(4))
    assert found == [(0, 1, 1.0), (0, 2, -1.0), (0, 3, -1.0), (2, 3, 1.0), (1, 2, 1.0)]
    assert _with_common_date(edges, np.array([0, 3])) == [(0, 3, -1.0)]


def test_pairs_are_taken_evenly_from_all() -> None:
    items = [(number, number, 1.0) for number in range(9)]
    assert _spread(items, 9) == items
    assert [one for one, _, _ in _spread(items, 5)] == [0, 2, 4, 6, 8]
    assert [one for one, _, _ in _spread(items, 4)] == [0, 3, 5, 8]
