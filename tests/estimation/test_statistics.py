"""Statistics of parameters and selection of points, against closed forms and regressions of one on the others."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyproj
import pytest
from scipy.stats import f, ttest_1samp

from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.estimation.choice.expected_error import expectation
from ortho_pipeline.estimation.determinacy import uncertain_edge, unstable
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.observations.common_unknown import CommonGroundError
from ortho_pipeline.estimation.statistics import (
    basis_of,
    chance_of,
    chance_of_mean,
    correlation_of,
    effective_parameters,
    left_out,
    rms,
    squared_distances,
    student_of,
    total_correlation_of,
    unit_weight,
)
from ortho_pipeline.points import Points
from ortho_pipeline.points.selection import select_control

SIZE = (10_000, 10_000)


def perspective(ground: np.ndarray) -> np.ndarray:
    x, y, z = ((ground - [415e3, 5015e3, 850.0]) / [15e3, 15e3, 650.0]).T
    return 5000 + 4500 * np.stack([x + 0.02 * z, -y + 0.01 * z], axis=1) / (1 + 0.02 * x - 0.01 * y + 1e-3 * z)[:, None]


def make_points(count, noise=0.5, seed=0, camera=perspective) -> Points:
    random = np.random.default_rng(seed)
    ground = random.uniform([400e3, 5000e3, 200.0], [430e3, 5030e3, 1500.0], (count, 3))
    return Points(
        ids=tuple(f"p{i}" for i in range(count)), image=camera(ground) + noise * random.normal(0, 1, (count, 2)),
        ground=ground, roles=np.full(count, "control"), sigma_image=np.full(count, 0.5),
        sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS.from_epsg(32633), source="simulated",
    )  # fmt: skip


@pytest.fixture(scope="module")
def covariance() -> np.ndarray:
    root = np.random.default_rng(0).normal(0, 1, (6, 6))
    return root @ root.T * np.outer(10.0 ** np.arange(-3, 3), 10.0 ** np.arange(-3, 3))


def test_correlation(covariance):
    sample = np.random.default_rng(1).multivariate_normal(np.zeros(6), covariance, 100_000)
    np.testing.assert_allclose(correlation_of(covariance), np.corrcoef(sample.T), atol=0.02)


def test_total_correlation_is_that_with_the_best_prediction_by_the_others(covariance):
    found = total_correlation_of(covariance)
    for k in range(6):
        others = np.delete(np.arange(6), k)
        weights = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, k])
        explained = weights @ covariance[others, k] / covariance[k, k]
        assert found[k] == pytest.approx(np.sqrt(explained), abs=1e-9)
    np.testing.assert_array_equal(total_correlation_of(np.diag([4.0, 1.0])), [0.0, 0.0])
    assert total_correlation_of(np.zeros((0, 0))).shape == (0,)
    assert total_correlation_of(np.array([[1.0, 1.0], [1.0, 1.0]])) == pytest.approx([1.0, 1.0])


def test_student():
    t, p = student_of(np.array([2.228, 0.0]), np.eye(2), 10)
    # The table of every textbook: 2.228 for 10 degrees of freedom and 5 %.
    np.testing.assert_allclose(t, [2.228, 0.0])
    np.testing.assert_allclose(p, [0.05, 1.0], atol=1e-4)
    assert student_of(np.array([12.706]), np.eye(1), 1)[1] == pytest.approx(0.05, abs=1e-4)
    assert student_of(np.array([1.96]), np.eye(1), 0)[1] == pytest.approx(0.05, abs=1e-4)


@pytest.mark.parametrize("repeats", [150, pytest.param(300, marks=pytest.mark.slow)])
def test_a_parameter_that_is_zero_is_called_significant_as_often_as_stated(repeats):
    """A 3D affine camera has no XZ: p is uniform over repeats."""
    truth = fit_family("affine3d", make_points(40, noise=0.0)).model
    chances = []
    for seed in range(repeats):
        found = fit_family("affine12", make_points(20, seed=seed, camera=truth.ground_to_image), robust=False)
        chances.append(found.student[1][found.param_names.index("col_XZ")])
    assert 0.02 < np.mean(np.array(chances) < 0.05) < 0.09
    assert abs(np.mean(chances) - 0.5) < 0.06


def test_document_has_the_statistics():
    found = fit_family("rfm2", make_points(60), size=SIZE)
    document = json.loads(json.dumps(found.to_json(), allow_nan=False))["statistics"]
    names = list(found.param_names)
    assert np.shape(document["correlation"]) == (38, 38)
    assert all(list(document[key]) == names for key in ("total_correlation", "t", "p"))
    assert document["ridge"] == found.ridge > 0
    assert document["effective_parameters"] < 38
    assert document["degrees_of_freedom"] == pytest.approx(120 - document["effective_parameters"])
    assert document["condition"] > 1e4


def test_predicted_sigma_grows_away_from_the_points():
    found = fit_family("affine3d", make_points(20), size=SIZE)
    centre, half = found.model.domain
    near, corner = found.image_sigma(np.stack([centre, centre + half]))
    assert (corner > 1.5 * near).all()


# -- selection -------------------------------------------------------------------------------------------------------


def test_even_points_are_well_spread_whatever_their_order():
    points = make_points(100)
    chosen = select_control(points, "even:9")
    assert chosen.control.sum() == 9
    assert chosen.check.sum() == 91
    places = points.image[chosen.control]
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)[~np.eye(9, dtype=bool)]
    # Nine points of a 3 x 3 grid are half the extent apart.
    assert distances.min() > 0.25 * np.ptp(points.image, axis=0).min()
    shuffled = points.select(np.random.default_rng(0).permutation(100))
    again = select_control(shuffled, "even:9")
    assert set(np.array(again.ids)[again.control]) == set(np.array(chosen.ids)[chosen.control])


def test_clusters_are_regions():
    points = make_points(100)
    middle = points.image.mean(axis=0)
    signs = {1: (-1, -1), 2: (1, -1), 3: (1, 1), 4: (-1, 1)}
    for group, sign in signs.items():
        places = points.image[select_control(points, f"cluster:6:{group}").control]
        assert len(places) == 6
        assert ((places.mean(axis=0) - middle) * sign > 0).all()
    centre = points.image[select_control(points, "cluster:6:5").control]
    assert np.abs(centre.mean(axis=0) - middle).max() < 0.15 * np.ptp(points.image, axis=0).max()
    first, same = select_control(points, "cluster:6"), select_control(points, "cluster:6:1")
    np.testing.assert_array_equal(first.roles, same.roles)


def test_ids_and_random_points():
    points = make_points(30)
    named = select_control(points, "ids:p3, p7")
    assert np.flatnonzero(named.control).tolist() == [3, 7]
    one, two = select_control(points, "random:10:1"), select_control(points, "random:10:2")
    assert one.control.sum() == two.control.sum() == 10
    assert (one.roles != two.roles).any()
    np.testing.assert_array_equal(one.roles, select_control(points, "random:10:1").roles)


def test_check_points_stay_check_points():
    points = make_points(30)
    points = points.with_roles(np.where(np.arange(30) < 10, "check", "control"))
    assert not select_control(points, "even:20").check[10:].any()
    with pytest.raises(TooFewPoints):
        select_control(points, "even:21")
    with pytest.raises(InputError, match="not a control point"):
        select_control(points, "ids:p0")


@pytest.mark.parametrize(
    "spec", ["", "even", "even:0", "even:x", "even:3:1", "cluster:3:6", "ids:", "ids:nobody", "random:3:x", "each:3"]
)
def test_other_texts_are_refused(spec):
    with pytest.raises(InputError):
        select_control(make_points(10), spec)


def test_squared_distances_are_those_in_whitened_coordinates():
    random = np.random.default_rng(5)
    root = np.tril(random.normal(size=(20, 2, 2))) + 2 * np.eye(2)
    standard = random.normal(size=(20, 2))
    residuals = np.einsum("nij,nj->ni", root, standard)
    found = squared_distances(residuals, root @ root.transpose(0, 2, 1))
    np.testing.assert_allclose(found, (standard**2).sum(axis=1), rtol=1e-10)


def test_parts_left_out_are_as_far_as_refits_without_them_predict():
    """Pairs of a linear fit: the misfit of a pair is its distance from the fit to all others."""
    random = np.random.default_rng(2)
    design, value = random.normal(0, 1, (16, 5)), random.normal(0, 1, 16)
    hat = design @ np.linalg.pinv(design)
    residual = value - hat @ value
    pairs = np.arange(16).reshape(8, 2)
    redundancy = np.array([(np.eye(16) - hat)[np.ix_(pair, pair)] for pair in pairs])
    found = left_out(redundancy, residual[pairs], known=1e-9)
    for k, pair in enumerate(pairs):
        rest = np.setdiff1d(np.arange(16), pair)
        refit = np.linalg.lstsq(design[rest], value[rest], rcond=None)[0]
        np.testing.assert_allclose(found.misfits[k], value[pair] - design[pair] @ refit, atol=1e-9)
        # What the sum of squares loses without the pair.
        lost = residual @ residual - ((value[rest] - design[rest] @ refit) ** 2).sum()
        assert found.squares[k] == pytest.approx(lost)
    assert found.known.all()
    np.testing.assert_array_equal(found.rank, 2)
    np.testing.assert_array_equal(found.whole, found.misfits)


def test_directions_that_only_a_part_itself_determines_are_unknown():
    redundancy = np.array([np.diag([0.5, 0.0]), np.zeros((2, 2)), np.diag([0.5, 0.05])])
    found = left_out(redundancy, np.array([[1.0, 0.0], [0.0, 0.0], [1.0, 0.1]]), known=1e-6, testable=0.1)
    np.testing.assert_allclose(found.misfits, [[2.0, 0.0], [np.nan, np.nan], [2.0, 2.0]])
    np.testing.assert_array_equal(np.isnan(found.whole).all(axis=1), [True, True, False])
    np.testing.assert_array_equal(found.rank, [1, 0, 1])
    np.testing.assert_allclose(found.squares, [2.0, 0.0, 2.0])


def test_small_figures_are_by_their_definitions():
    assert rms(np.array([3.0, -4.0, np.nan])) == pytest.approx(np.sqrt(12.5))
    assert rms(np.array([np.nan])) == 0.0
    assert unit_weight(8.0, 2.0, 0.5) == 2.0
    assert unit_weight(8.0, 0.5, 0.5) is None
    np.testing.assert_allclose(chance_of([3.0, 8.0], [2, 3], [10, 4.5]), f.sf([1.5, 8 / 3], [2, 3], [10, 4.5]))
    random = np.random.default_rng(1)
    columns = random.normal(0, 1, (9, 3)) @ random.normal(0, 1, (3, 5))
    basis = basis_of(columns)
    assert basis.shape == basis_of(1e6 * columns).shape == basis_of(1e-6 * columns).shape == (9, 3)
    assert basis_of(np.outer(columns[:, 0], (1.0, 2.0, -3.0))).shape == (9, 1)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(basis @ (basis.T @ columns), columns, atol=1e-12)
    # A ridge that is as heavy as the observations halves what these determine.
    design = np.linalg.qr(random.normal(0, 1, (9, 4)))[0]
    rows = np.eye(4)
    cofactors = np.linalg.inv(design.T @ design + rows.T @ rows)
    assert effective_parameters(4, [(rows[:1], cofactors), (rows[1:], cofactors)]) == pytest.approx(2.0)


def test_even_points_of_a_line_halve_it():
    points = make_points(11)
    ids = tuple(f"{k:02}" for k in range(11))
    line = replace(points, ids=ids, image=np.column_stack([np.arange(11.0), np.zeros(11)]))
    assert np.flatnonzero(select_control(line, "even:2").control).tolist() == [0, 10]
    assert np.flatnonzero(select_control(line, "even:3").control).tolist() == [0, 5, 10]
    assert np.flatnonzero(select_control(line, "cluster:2:5").control).tolist() in ([4, 5], [5, 6])
    assert (select_control(line, "random:4").roles == select_control(line, "random:4:0").roles).all()
    assert len(select_control(line, "even:11").control.nonzero()[0]) == 11
    for wrong in ("cluster:2:0", "cluster:2:6"):
        with pytest.raises(InputError, match="not a selection"):
            select_control(line, wrong)


def test_a_common_error_moves_as_far_as_its_information_says():
    # Information 3 on an error whose own is 1: variance 1 / 4, a step of (slope - value) / 4.
    error = CommonGroundError(value=np.array([0.4, 0.0]), told=np.diag([3.0, 0.0]), sigma=2.0, points=5)
    np.testing.assert_allclose(error.left, np.diag([0.25, 1.0]))
    np.testing.assert_allclose(error.step(np.array([2.4, 1.0])), [0.5, 1.0])
    # The median of the estimates is believed up to four of its standard deviations.
    for each, value in ((3.9, [3.9, 1.0]), (4.1, [0.4, 0.0]), (-4.1, [0.4, 0.0])):
        estimates = np.array([[each, 1.0], [np.nan, 9.0], [each, 1.0], [99.0, 1.0]])
        np.testing.assert_allclose(error.started(estimates).value, value)
    np.testing.assert_allclose(error.started(np.zeros((0, 2))).value, [0.0, 0.0])


def test_the_expected_error_of_a_linear_model_is_that_of_the_textbooks():
    points = make_points(20)
    found = fit_family("affine3d", points, robust=False)
    statistics = expectation(found, found.used, SIZE)
    # 40 observations, 8 that stand for the stated noise, 8 parameters and the noise: Akaike's criterion, corrected.
    n, k, squares = 48, 9, (found.residuals / 0.5).ravel() @ (found.residuals / 0.5).ravel() + 8
    assert statistics.criterion == pytest.approx(n * np.log(squares / n) + 2 * k + 2 * k * (k + 1) / (n - k - 1))
    assert statistics.noise == pytest.approx((squares - 8) / 32)
    assert statistics.stated == pytest.approx(2 * 0.5**2)
    # The trace of the hat matrix is the number of parameters.
    assert statistics.tested == pytest.approx(0.5**2 * 8 / 20)
    assert statistics.scene > statistics.tested
    assert statistics.unseen == 0.0


@pytest.mark.parametrize(
    "places", [[(0, 0), (10, 5), (5, 10), (6, 6)], [(10, 10), (0, 5), (5, 0), (4, 4)], [(1, 9), (9, 8), (0, 0), (5, 5)]]
)
def test_the_first_of_even_points_is_the_farthest_from_the_middle(places):
    image = np.array(places, dtype=float)
    chosen = select_control(replace(make_points(4), image=image), "even:1").control
    middle = (image.max(axis=0) + image.min(axis=0)) / 2
    assert np.flatnonzero(chosen).tolist() == [int(np.argmax(np.hypot(*(image - middle).T)))]


@pytest.mark.parametrize("noise", [0.1, 2.0])
def test_the_uncertainty_of_a_corner_is_that_of_a_regression(noise):
    """Nine points of a regular grid, -1 to 1: a regression has 1/9 + x^2/6 + y^2/6 of their variance at (x, y)."""
    places = np.stack(np.meshgrid([1000.0, 5000.0, 9000.0], [1000.0, 5000.0, 9000.0]), axis=-1).reshape(-1, 2)
    points = make_points(9)
    ground = np.column_stack([400e3 + places[:, 0], 5030e3 - places[:, 1], np.full(9, 300.0)])
    image = places + noise * np.random.default_rng(1).normal(size=(9, 2))
    found = fit_family("affine2d", replace(points, ground=ground, image=image), size=SIZE, robust=False)
    # The corners of the domain are 2 % beyond those of the image, at 1.25; noise moves them a little.
    assert found.corner_ratio == pytest.approx(np.sqrt(1 / 9 + 2 * (1.02 * 1.25) ** 2 / 6), rel=2e-3)
    assert [uncertain_edge(factor) != [] for factor in (9.9, 10.1)] == [False, True]


def test_parameters_that_cannot_be_separated_are_named():
    def said(correlation: float, condition: float = 100.0) -> list[str]:
        cofactors = np.diag([4.0, 1.0, 9.0])
        cofactors[0, 2] = cofactors[2, 0] = -6.0 * correlation
        model = SimpleNamespace(param_names=("a", "b", "c"))
        solution = SimpleNamespace(model=model, cofactors=cofactors, condition=condition, effective=3.0)
        return [str(notice) for notice in unstable(solution, None)]

    assert said(0.9994) == []
    (text,) = said(0.9996)
    assert "1 pair of parameters" in text
    assert "a and c" in text
    assert said(0.5, condition=9.9e3) == []
    assert said(0.5, condition=1.1e4)[0].startswith("unstable")


def test_the_chance_of_a_mean_is_that_of_a_one_sided_t_test():
    for mean in (-0.5, 0.0, 0.4, 3.0):
        values = np.random.default_rng(7).normal(mean, 1.0, 9)
        assert chance_of_mean(values) == pytest.approx(ttest_1samp(values, 0.0, alternative="greater").pvalue, rel=1e-9)
    assert (chance_of_mean(np.ones(5)), chance_of_mean(-np.ones(5))) == (0.0, 1.0)
    assert np.isnan(chance_of_mean(np.zeros(5)))
