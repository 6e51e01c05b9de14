"""Covariance analysis of residuals: distances, classes and statistics by their definitions, and refusals at limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.spatial.correlation import CovarianceFunction, Covariances, analyse


def drawn(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.uniform(0, 1000, (count, 2)), random.normal(0, 1, (count, 2))


@pytest.mark.parametrize(
    ("longest", "near"), [(1234.0, 1300.0), (1200.0, 1200.0), (99.1, 100.0), (0.01234, 0.013), (5.0, 5.0)]
)
def test_the_distance_of_neighbours_is_rounded_up_to_two_digits(longest, near):
    """Five points have the ten pairs that it takes; four have six."""
    xy = np.column_stack([longest * np.array([0.0, 0.11, 0.3, 0.62, 1.0]), np.zeros(5)])
    found = analyse(xy, drawn(5)[1])
    assert (found.near_m, found.pairs_near) == (near, 10)
    assert analyse(xy[:4], drawn(4)[1]).near_m is None


def test_points_of_one_place_have_no_distance_of_neighbours():
    assert analyse(np.ones((6, 2)), drawn(6)[1]).near_m is None


def test_classes_have_all_pairs_up_to_the_farthest():
    xy, values = drawn(9)
    found = analyse(xy, values, near=150.0)
    distance = [math.dist(xy[i], xy[j]) for i in range(9) for j in range(i)]
    # Fewer than 30 pairs beyond the neighbours are one class.
    assert len(found.classes) == 2
    assert sum(one.pairs for one in found.classes) == 36
    assert found.classes[-1].to_m == pytest.approx(max(distance))
    assert found.pairs_near == sum(one <= 150.0 for one in distance)


def test_a_pair_on_an_edge_is_in_the_class_below_it():
    xy = [[0, 0], [3, 4], [0, 0], [30, 40]]
    found = analyse(xy, drawn(4)[1], classes=(0.0, 5.0, 45.0, 50.0))
    # 0 and twice 5; 45; twice 50.
    assert [one.pairs for one in found.classes] == [3, 1, 2]
    assert [one.distance_m for one in found.classes] == pytest.approx([10 / 3, 45.0, 50.0])
    # Of classes that begin above 0, the lower edge is not part.
    assert [one.pairs for one in analyse(xy, drawn(4)[1], classes=(5.0, 45.0, 50.0)).classes] == [1, 2]
    assert analyse(xy, drawn(4)[1], classes=(0.0, 0.25, 0.5)).classes[0].pairs == 1


@pytest.mark.parametrize("classes", [(-5.0, 5.0), (0.0, math.inf), (0.0, math.nan, 5.0), (5.0, 1.0)])
def test_edges_that_are_no_distances_are_refused(classes):
    with pytest.raises(InputError):
        analyse(*drawn(9), classes=classes)


@pytest.mark.parametrize("near", [-1.0, math.inf, math.nan, 0.0])
def test_a_distance_that_is_none_is_refused(near):
    with pytest.raises(InputError):
        analyse(*drawn(9), near=near)


def test_a_mean_is_tested_as_by_student():
    xy, values = drawn(11)
    values[:, 0] += 0.8
    assert analyse(xy, values).mean_p == pytest.approx(stats.ttest_1samp(values, 0.0).pvalue, rel=1e-9)
    assert analyse(xy[:7], values[:7]).mean_p is None


def test_morans_i_is_that_of_its_definition():
    """Of residuals about their mean: each with its four nearest neighbours, over the variance."""
    xy, values = drawn(15)
    about, products = values - values.mean(axis=0), np.zeros(2)
    for here in range(15):
        nearest = np.argsort(((xy - xy[here]) ** 2).sum(axis=1))[1:5]
        products += (about[here] * about[nearest]).sum(axis=0)
    found = analyse(xy, values)
    assert found.moran == pytest.approx(products / 60 / values.var(axis=0), rel=1e-9)
    assert all(1 / 1000 <= p <= 1 for p in found.p)
    # The larger value of two is as large by chance more often than either.
    assert found.p_joint >= min(found.p)


def test_the_chance_of_a_value_counts_the_draws_that_reach_it():
    """A wave along x: no draw has such neighbours, and 1 of 20 is the least chance of 19 draws."""
    xy = np.array([[x, y] for x in range(6) for y in range(6)], dtype=float)
    wave = np.column_stack([np.sin(xy[:, 0]), np.cos(xy[:, 0])])
    found = analyse(xy, wave, draws=19)
    assert found.p == pytest.approx((1 / 20, 1 / 20))
    assert found.p_joint == pytest.approx(1 / 20)
    # Residuals that alternate are as unlike as can be: all draws are more alike.
    alternating = np.repeat(np.where(xy.sum(axis=1) % 2, 1.0, -1.0)[:, None], 2, axis=1)
    assert analyse(xy, alternating, draws=19).p == pytest.approx((1.0, 1.0))


def test_points_need_all_numbers_to_count():
    xy, values = drawn(20)
    design = np.tile(np.eye(2), (20, 1, 1))
    design[3, 0, 1] = np.nan
    xy[5, 1], values[6, 0] = np.inf, np.nan
    assert analyse(xy, values, design=design).n == 17


def test_eight_points_and_eight_degrees_of_freedom_are_tested():
    for count, parameters, tested in ((8, 2, True), (7, 2, False), (8, 8, True), (8, 9, False)):
        design = np.random.default_rng(1).normal(size=(count, 2, parameters))
        assert (analyse(*drawn(count), design=design, draws=19).p_joint is not None) == tested


def test_a_function_takes_ninety_pairs():
    """Of 13 points there are 78, of 14 there are 91."""
    xy, _ = drawn(14, seed=3)
    values = np.column_stack([xy[:, 0], xy[:, 0] + xy[:, 1]]) / 300
    assert analyse(xy[:13], values[:13]).functions == (None, None)
    functions = analyse(xy, values).functions
    assert None not in functions
    assert functions[0] != functions[1]
    assert analyse(xy, values[:, ::-1]).functions == functions[::-1]


def test_a_function_keeps_a_part_of_its_covariance():
    """1/e at its range; the error between two points grows from the noise to that of both."""
    function = CovarianceFunction(noise=3.0, systematic=4.0, range_m=50.0)
    assert function.covariance([0.0, 50.0, 1e9]) == pytest.approx([16.0, 16 / math.e, 0.0])
    assert function.relative([0.0, 50.0, 1e9]) == pytest.approx([3.0, math.sqrt(25 - 16 / math.e), 5.0])


def test_check_points_are_drawn_if_they_could_be_tested():
    tested, one_class, few = (analyse(*drawn(count), classes=edges) for count, edges in (
        (20, (0.0, 300.0, 2000.0)), (20, (0.0, 2000.0)), (5, (0.0, 300.0, 2000.0))))  # fmt: skip
    assert tested.is_tested
    assert not one_class.is_tested
    assert not few.is_tested
    assert Covariances(control=tested, check=tested).drawn[0] == "check"
    assert Covariances(control=tested, check=few).drawn[0] == "control"
    assert Covariances(control=tested).drawn[0] == "control"
    assert Covariances(control=few).drawn is None
    assert Covariances().drawn is None
