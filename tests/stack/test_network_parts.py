"""The parts of a stack's network, against dense matrices: the solution, closures, and the adjusted stack."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from networks import Truth

from ortho_pipeline.block.stack import adjustment, network
from ortho_pipeline.block.stack.adjustment import adjust
from ortho_pipeline.block.stack.components import ErrorComponents
from ortho_pipeline.block.stack.edges import Edges
from ortho_pipeline.block.stack.network import Network
from ortho_pipeline.block.stack.trends import Trends, design_of, trends_of


def loops() -> tuple[Edges, Trends, ErrorComponents, np.ndarray]:
    """Return eleven edges of six dates with three terms, their trends and components, and the places."""
    random = np.random.default_rng(17)
    pairs = np.array([(1, 0), (2, 0), (2, 1), (3, 1), (3, 2), (4, 2), (4, 3), (5, 3), (5, 4), (5, 0), (4, 1)])
    place = random.uniform(-1, 1, (14, 2))
    truth = random.uniform(-3, 3, (6, 2))
    value = (truth[pairs[:, 0]] - truth[pairs[:, 1]])[:, None] + random.normal(0.0, 0.1, (11, 14, 2))
    variance = random.uniform(0.01, 0.04, (11, 14))
    edges = Edges(pairs[:, 0], pairs[:, 1], value, variance, random.uniform(0.05, 0.1, 11))
    trends = trends_of(edges, design_of(place, 3), np.ones(14, dtype=bool))
    errors = ErrorComponents(
        random.uniform(0.001, 0.01, (2, 7)), random.uniform(0.001, 0.01, (2, 7)), random.uniform(0.5, 2, 6),
        random.uniform(0.5, 2, 11), np.array([0.004, -0.002]),
    )  # fmt: skip
    return edges, trends, errors, place


def block_weights(sigma: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return the weights of edges: of their own errors and a tenth of what dates share, without pairs of edges."""
    terms = own.shape[1]
    weight = np.zeros_like(sigma)
    for edge in range(len(own)):
        part = slice(edge * terms, (edge + 1) * terms)
        weight[part, part] = np.linalg.inv(0.9 * own[edge] + 0.1 * sigma[part, part])
    return weight


@pytest.mark.parametrize("sloped", [(False,) * 6, (True,) * 6, (False, True, False, False, True, False)])
def test_corrections_are_weighted_least_squares_of_all_edges(sloped):
    edges, trends, errors, place = loops()
    free = np.column_stack([np.ones(6, dtype=bool), sloped, sloped])
    accepted = np.arange(11) != 8
    found = network.solve(edges, trends, errors, place, accepted, np.array(sloped))
    kept = np.flatnonzero(accepted)
    incidence = edges.incidence(6).toarray()[kept]
    columns = np.flatnonzero(free.ravel())
    design = np.kron(incidence, np.eye(3))[:, columns]
    rows = (3 * kept[:, None] + np.arange(3)).ravel()
    for axis in (0, 1):
        sigma, own = errors.covariance(axis, edges, trends, place)
        sigma = sigma.toarray()[np.ix_(rows, rows)]
        weight = block_weights(sigma, own[kept])
        # Terms that all dates have are determined but for their mean, which is zero.
        gain = np.linalg.pinv(design.T @ weight @ design) @ design.T @ weight
        dense = np.zeros(18)
        dense[columns] = gain @ trends.value[kept, :, axis].ravel()
        np.testing.assert_allclose(found.value[:, :, axis].ravel(), dense, atol=1e-8)
        covariance = np.zeros((18, 18))
        covariance[np.ix_(columns, columns)] = gain @ sigma @ gain.T
        np.testing.assert_allclose(found.covariance[axis], covariance, atol=1e-9)
    assert found.part.tolist() == [0] * 6


def test_parts_that_no_edge_connects_have_means_of_their_own():
    edges, trends, errors, place = loops()
    accepted = np.isin(edges.first * 10 + edges.second, [10, 20, 21, 43, 53, 54])
    found = network.solve(edges, trends, errors, place, accepted, np.zeros(6, dtype=bool))
    assert found.part.tolist() == [0, 0, 0, 1, 1, 1]
    np.testing.assert_allclose(found.value[:3, 0].sum(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(found.value[3:, 0].sum(axis=0), 0.0, atol=1e-9)


def test_the_error_of_an_edge_is_what_all_others_say():
    """An edge is left out, and the others are solved without it; the covariance is that of all errors."""
    edges, trends, errors, place = loops()
    shifts = network._shifts(trends)
    both = [errors.covariance(axis, edges, shifts, place) for axis in (0, 1)]
    constant = np.array([0.003, 0.001])
    accepted = np.arange(11) != 6
    incidence, value = edges.incidence(6), shifts.value[:, 0]
    found, more = network._closed(edges, incidence, value, both, constant, accepted)
    dense, ratio = incidence.toarray(), np.zeros(11)
    for axis, (sigma, own) in enumerate(both):
        full = sigma.toarray() + constant[axis] * np.eye(11)
        alone = own[:, 0, 0] + constant[axis]
        weight = 1.0 / (alone + 0.1 * (np.diag(full) - alone))
        for edge in range(11):
            others = np.flatnonzero(accepted & (np.arange(11) != edge))
            some = dense[others]
            gain = np.zeros((6, 11))
            gain[:, others] = np.linalg.pinv(some.T @ (weight[others, None] * some)) @ some.T * weight[others]
            row = np.eye(11)[edge] - dense[edge] @ gain
            assert found.error[edge, axis] == pytest.approx(row @ value[:, axis], abs=1e-9)
            ratio[edge] += (row @ value[:, axis]) ** 2 / (row @ full @ row)
        used = np.flatnonzero(accepted)
        some = dense[used]
        left = np.eye(10) - some @ np.linalg.pinv(some.T @ (weight[used, None] * some)) @ some.T * weight[used]
        squares = weight[used] @ (left @ value[used, axis]) ** 2
        expected = np.trace(left.T @ np.diag(weight[used]) @ left @ full[np.ix_(used, used)])
        of_constant = np.trace(left.T @ np.diag(weight[used]) @ left)
        assert more[axis] == pytest.approx((squares - expected) / of_constant, rel=1e-6)
    np.testing.assert_allclose(found.ratio, ratio, rtol=1e-6)


def test_an_edge_in_no_loop_is_not_tested():
    edges, trends, errors, place = loops()
    accepted = np.isin(edges.first * 10 + edges.second, [10, 20, 21, 31])
    both = [errors.covariance(axis, edges, network._shifts(trends), place) for axis in (0, 1)]
    found, _ = network._closed(edges, edges.incidence(6), trends.value[:, 0], both, np.zeros(2), accepted)
    # 3-1 is the only one of its date; 3-2 would close a loop; dates 4 and 5 are not connected.
    tested = np.isin(edges.first * 10 + edges.second, [10, 20, 21, 32])
    np.testing.assert_array_equal(np.isfinite(found.error), np.column_stack([tested] * 2))
    np.testing.assert_array_equal(np.isfinite(found.ratio), tested)


def test_two_wrong_edges_of_eleven_do_not_move_the_first_solution():
    edges = loops()[0]
    incidence, truth = edges.incidence(6), np.random.default_rng(2).uniform(-4, 4, (6, 2))
    truth -= truth.mean(axis=0)
    value = incidence @ truth
    value[[2, 7]] += [[9.0, -4.0], [3.0, 30.0]]
    found = network._shortest(incidence, value, np.ones(11, dtype=bool))
    np.testing.assert_allclose(found, truth, atol=1e-3)
    # An edge that is not usable has no part, however many of them there are.
    value[4] += 7.0
    np.testing.assert_allclose(network._shortest(incidence, value, np.arange(11) != 4), truth, atol=1e-3)


@pytest.mark.parametrize(("usable", "loops_"), [(11, 6), (7, 3), (4, 1), (3, 1)])
def test_many_loops_let_the_stated_error_shrink(usable, loops_):
    """Edges less dates plus parts are the loops; ten of them count as much as what is stated."""
    edges, *_ = loops()
    some = np.arange(11) < usable
    expected = -loops_ / (loops_ + 10) * edges.alike[:usable].min() ** 2
    assert network._loops(edges.incidence(6), some) == loops_
    assert network._least(edges, loops_, some) == pytest.approx(expected)
    assert network._loops(edges.incidence(6), np.zeros(11, dtype=bool)) == 0
    assert network._least(edges, 0, np.zeros(11, dtype=bool)) == 0.0


def test_a_wrong_edge_leaves_and_what_loops_show_is_added():
    edges, trends, errors, place = loops()
    value = trends.value.copy()
    value[3, 0] += 4.0
    wrong = dataclasses.replace(trends, value=value)
    closures, found = network.accepted_edges(edges, wrong, errors, place, 6)
    np.testing.assert_array_equal(closures.accepted, np.arange(11) != 3)
    np.testing.assert_allclose(closures.error[3], 4.0, atol=0.5)
    assert closures.ratio[3] > 20
    # 11 edges less 6 dates plus one part are six loops. What loops show is no less than this.
    assert (found.constant >= -6 / 16 * edges.alike.min() ** 2 - 1e-15).all()
    np.testing.assert_array_equal(found.shared, errors.shared)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    ("left_out", "wrong", "known"),
    [((), (7,), True), ((), (7, 9), False), ((8,), (7,), False), ((8, 9), (), True), ((7, 8, 9), (), True)],
)
def test_edges_of_a_date_that_contradict_each_other_are_not_accepted(seed, left_out, wrong, known):
    """The last date has edges 7, 8 and 9. Two that agree are right; if none agree, nothing tells which is right.

    A single edge contradicts none.
    """
    edges, trends, errors, place = loops()
    value, random = trends.value.copy(), np.random.default_rng(seed)
    value[list(wrong), 0] += random.choice([-1, 1], (len(wrong), 2)) * random.uniform(4, 15, (len(wrong), 2))
    used = trends.used & ~np.isin(np.arange(11), left_out)[:, None]
    closures, _ = network.accepted_edges(edges, dataclasses.replace(trends, value=value, used=used), errors, place, 6)
    accepted = np.ones(11, dtype=bool)
    accepted[[*left_out, *wrong] if known else [7, 8, 9]] = False
    np.testing.assert_array_equal(closures.accepted, accepted)


@pytest.mark.parametrize("size", [0.5, 1.0])
def test_an_error_of_edges_that_their_places_do_not_show_is_found_from_loops(size):
    """Each of 400 edges errs by a shift of its own: the constant variance is its square."""
    made = Truth(seed=3, dates=110, hidden=0.0, noise=0.05, of_date=0.0, of_edge=0.0).made()
    random = np.random.default_rng(9)
    apart = random.normal(0.0, size, (len(made.edges), 1, 2))
    edges = dataclasses.replace(made.edges, value=made.edges.value + apart)
    place = made.truth.cells.place
    trends = trends_of(edges, design_of(place, 1), np.ones(len(place), dtype=bool))
    white = np.zeros((2, 7))
    white[:, 0] = 0.05**2 / 4
    errors = ErrorComponents(white, white, np.ones(110), np.ones(len(edges)), np.zeros(2))
    closures, found = network.accepted_edges(edges, trends, errors, place, 110)
    assert closures.accepted.mean() > 0.99
    np.testing.assert_allclose(found.constant, size**2, rtol=0.2)


@pytest.mark.parametrize("errors", [[(0.6, -0.3)], [(0.6, -0.3), (0.4, 0.9)], [(0.5, 0.7), (0.6, -0.3), (0.4, 0.9)]])
def test_what_few_loops_show_is_as_uncertain_as_students_distribution(errors):
    """Triangles of dates that have one date in common, with the error of each loop.

    Each of three edges errs by a third of it, so a constant variance is a third of the mean square. Spreads that n
    loops show count as larger, by the quantile of Student's distribution over that of the normal distribution.
    """
    count = len(errors)
    pairs = np.array([(2 * k + i, j) for k in range(count) for i, j in ((1, 0), (2, 2 * k + 1), (2, 0))])
    value = np.zeros((3 * count, 4, 2))
    value[::3] = np.array(errors)[:, None]
    edges = Edges(pairs[:, 0], pairs[:, 1], value, np.full((3 * count, 4), 0.01), np.full(3 * count, 0.02))
    place = np.random.default_rng(1).uniform(-1, 1, (4, 2))
    trends = Trends(
        np.ones((4, 1)), np.full((3 * count, 4, 1), 0.25), value[:, :1], np.zeros_like(value),
        np.ones((3 * count, 4), dtype=bool),
    )  # fmt: skip
    white = 1e-6 * np.eye(7)[[0, 0]]
    known = ErrorComponents(0.0 * white, white, np.ones(2 * count + 1), np.ones(3 * count), np.zeros(2))
    closures, found = network.accepted_edges(edges, trends, known, place, 2 * count + 1)
    assert closures.accepted.all()
    stated = 0.02**2 + 1e-6 / 4
    quantile = {1: 12.706, 2: 4.303, 3: 3.182}[count] / 1.960
    wanted = (np.square(errors).mean(axis=0) / 3 - stated) * quantile**2
    np.testing.assert_allclose(found.constant, wanted, rtol=2e-3)
    # Without an error of loops, the constant takes from what is stated, and has no interval.
    _, exact = network.accepted_edges(
        edges, dataclasses.replace(trends, value=0.0 * trends.value), known, place, 2 * count + 1
    )
    np.testing.assert_allclose(exact.constant, -count / (count + 10) * 0.02**2)


def test_corrections_relative_to_one_date_and_to_a_mean():
    random = np.random.default_rng(5)
    root = random.normal(size=(2, 9, 9))
    one = Network(random.normal(size=(3, 3, 2)), root @ root.transpose(0, 2, 1), np.zeros(3, dtype=int))
    weights = np.array([0.5, 0.5, 0.0])
    found = one.relative_to(weights)
    np.testing.assert_allclose(found.value, one.value - (one.value[0] + one.value[1]) / 2)
    for axis in (0, 1):
        for date in range(3):
            for term in range(3):
                row = np.eye(9)[3 * date + term] - (np.eye(9)[term] + np.eye(9)[3 + term]) / 2
                variance = found.covariance[axis, 3 * date + term, 3 * date + term]
                assert variance == pytest.approx(row @ one.covariance[axis] @ row)


# The adjusted stack.


def test_the_correction_at_a_place_has_its_slopes_and_their_variances():
    made = Truth(seed=4, dates=16, sloped=3).made()
    stack = adjust(made.truth.cells, made.edges, made.years.tolist())
    cells, place = made.truth.cells, np.array([[100.0, 900.0], [500.0, 500.0]])
    value, sigma = stack.at(place)
    np.testing.assert_allclose(value[:, 1], stack.network.value[:, 0])
    np.testing.assert_allclose(sigma[:, 1], stack.sigma)
    x, y = (100 - 500) / cells.half, (900 - 500) / cells.half
    terms = np.array([1.0, x, y])
    for date in range(16):
        np.testing.assert_allclose(value[date, 0], terms @ stack.network.value[date])
        for axis in (0, 1):
            block = stack.network.covariance[axis, 3 * date : 3 * date + 3, 3 * date : 3 * date + 3]
            assert sigma[date, 0, axis] == pytest.approx(np.sqrt(terms @ block @ terms))
    covariance = stack.network.covariance[1]
    row = np.eye(48)[3 * 2] - np.eye(48)[3 * 9]
    assert stack.sigma_between(2, 9)[1] == pytest.approx(np.sqrt(row @ covariance @ row))


def test_the_mean_shift_of_the_stack_is_zero():
    for sloped in (0, 3):
        made = Truth(seed=4, dates=16, sloped=sloped).made()
        stack = adjust(made.truth.cells, made.edges, made.years.tolist())
        np.testing.assert_allclose(stack.network.value[:, 0].mean(axis=0), 0.0, atol=1e-9)
        shifts = stack.network.covariance[:, ::3, ::3]
        np.testing.assert_allclose(shifts.sum(axis=1), 0.0, atol=1e-9)
        steep = np.abs(made.slopes).max(axis=(1, 2)) > 0
        assert (np.abs(stack.network.value[~steep, 1:]) == 0).all()


def test_a_step_is_reported_by_the_number_of_its_date_among_all():
    """Dates without pairs come before the step; it keeps its number, and its size."""
    made = Truth(seed=11, dates=30, error=0.0, scatter=0.3, step=3.0, hidden=0.0).made()
    alone = [2, 5, 8, 11]
    kept = ~np.isin(made.edges.first, alone) & ~np.isin(made.edges.second, alone)
    stack = adjust(made.truth.cells, made.edges.select(kept), made.years.tolist())
    assert [one.date for one in stack.steps] == [15]
    before, after = np.setdiff1d(np.arange(15), alone), np.arange(15, 30)
    expected = made.shift[after].mean(axis=0) - made.shift[before].mean(axis=0)
    np.testing.assert_allclose(stack.steps[0].size, expected, atol=0.15)


def test_ground_that_does_not_move_needs_one_solution_for_each_question(monkeypatch):
    """One for steady motion, one for any motion: the second solution of a question would repeat the first."""
    made = Truth(seed=4, dates=8).made()
    asked, motion_of = [], adjustment.motion_of
    monkeypatch.setattr(
        adjustment, "motion_of", lambda left, times, **how: (asked.append(how), motion_of(left, times, **how))[1]
    )
    stack = adjust(made.truth.cells, made.edges, made.years.tolist(), affine=False)
    assert not stack.motion.moving.any()
    assert asked == [{"steady": True}, {}]


@pytest.mark.parametrize(("cells", "known"), [(8, 6), (5, 1)])
def test_edges_in_few_cells_give_shifts_or_nothing(cells: int, known: int) -> None:
    """Slopes need twelve cells, such as all of a narrow strip, and a shift needs six."""
    made = Truth(dates=6, hidden=0.0).made()
    value = made.edges.value.copy()
    value[:, cells:] = np.nan
    found = adjust(made.truth.cells, dataclasses.replace(made.edges, value=value), made.years)
    assert found.determined.sum() == known
    assert not found.sloped.any()
    if known > 1:
        np.testing.assert_allclose(found.network.value[:, 0], made.shift - made.shift.mean(axis=0), atol=0.2)
