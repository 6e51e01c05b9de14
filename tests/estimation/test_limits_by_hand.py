"""Limits and small formulas of the adjustment of an image, each by a case whose answer is known."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ortho_pipeline.errors import DegeneratePoints, InputError
from ortho_pipeline.estimation.blunders import _together_apart, are_alike, contradicting, outlying, refuse_many
from ortho_pipeline.estimation.choice.compared_model import ComparedModel
from ortho_pipeline.estimation.coordinate_swaps import refuse_swapped
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.least_squares import solve_linear
from ortho_pipeline.estimation.observations.common_unknown import CommonGroundError
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.estimation.problem import Problem
from ortho_pipeline.estimation.records import CommonError
from ortho_pipeline.estimation.regularisation import regularised
from ortho_pipeline.estimation.spatial.correlation import _default_near, _edges, _function, _mean_p, _moran, analyse
from ortho_pipeline.estimation.spatial.shared_errors import _cell_means
from ortho_pipeline.models import RPC, ImageCorrection, start_model
from ortho_pipeline.points import Points


def swapped(model: RPC, apart: float, off: float) -> Points:
    """Return points whose column and row are swapped, `apart` px from right; they are `off` px off besides."""
    places = np.array([(600.0, 600.0), (1000.0, 1000.0), (1400.0, 1400.0), (700.0, 700.0), (1200.0, 1200.0)])
    true = places + np.array([-0.5, 0.5]) * apart / math.sqrt(2)
    ground = model.image_to_ground(true, 400.0)
    return Points.of(true[:, ::-1] + off / math.sqrt(2), ground, "EPSG:4979")


@pytest.mark.parametrize(
    ("apart", "off", "said"), [(49.5, 0.0, False), (50.5, 0.0, True), (80.0, 4.2, False), (80.0, 3.8, True)]
)
def test_a_swap_is_reported_beyond_fifty_pixels_and_if_it_is_twenty_times_better(
    level: RPC, apart: float, off: float, said: bool
) -> None:
    # Across the diagonal a swap moves by `apart`, and along it not at all.
    points = swapped(level, apart, off)
    miss = points.image - level.ground_to_image(points.ground)
    assert np.hypot(*miss.T) == pytest.approx(math.hypot(apart, off), abs=1e-6)
    if not said:
        refuse_swapped(level, points, 2000)
    else:
        with pytest.raises(InputError, match="column and row are swapped"):
            refuse_swapped(level, points, 2000)


def test_up_to_three_tenths_of_the_points_are_gross_errors() -> None:
    refuse_many(list("abc"), 10, "control point", "p.csv", "")
    for names, count in (("abcd", 13), ("abc", 9)):
        with pytest.raises(DegeneratePoints, match=f"^p.csv.*{len(names)} of {count} control points"):
            refuse_many(list(names), count, "control point", "p.csv", "measure again")


@pytest.mark.parametrize(
    ("misses", "alike"),
    [
        ([(4.0, 3.0), (4.0, 3.0)], True),
        # Half of the mean of 5 is a scatter of 2.5.
        ([(4.0 - 1.9, 3.0 - 1.5), (4.0 + 1.9, 3.0 + 1.5)], True),
        ([(4.0 - 2.1, 3.0 - 1.5), (4.0 + 2.1, 3.0 + 1.5)], False),
        ([(4.0, 3.0)], False),
        ([(4.0, 3.0), (-4.0, -3.0)], False),
    ],
)
def test_errors_are_alike_if_they_scatter_by_less_than_half_of_their_mean(misses: Any, alike: bool) -> None:
    assert are_alike(np.array(misses)) is alike
    assert are_alike(np.zeros((0, 2))) is False


def test_check_points_are_apart_together_if_they_are_twice_as_far_and_not_by_chance() -> None:
    # Five points have ten coordinates; twice the error is four times the square.
    assert _together_apart(np.full(5, 8.1 * 0.25), 0.25, 1000.0)
    assert not _together_apart(np.full(5, 7.9 * 0.25), 0.25, 1000.0)
    for freedom in (7.0, 1.0):
        for part, apart in ((1.01, True), (0.99, False)):
            square = part * float(stats.f.isf(0.01, 2, freedom)) * 2
            assert _together_apart(np.array([square]), 1.0, freedom) is apart
    assert not _together_apart(np.zeros(0), 1.0, 7.0)


def test_contradicting_points_are_counted_and_the_worst_named() -> None:
    assert contradicting(1, 1, ["a"]) == "1 check point contradicts the control points (a)"
    assert contradicting(4, 9, list("abcd"), "the block") == (
        "4 of 9 check points contradict the block (worst: a, b, c)"
    )
    assert contradicting(0, 3, list("abc")) == "3 check points together contradict the control points (a, b, c)"


def test_check_points_that_are_apart_are_compared_with_what_control_lets_expect(level: RPC) -> None:
    """The scatter of control is three times what is stated: a point off a mean of nine varies by 10/9 of its square."""
    random = np.random.default_rng(4)
    ground = np.column_stack([random.uniform([19.992, -30.008], [20.008, -29.992], (13, 2)), np.full(13, 400.0)])
    image = level.ground_to_image(ground) + random.normal((7.0, -4.0), 0.6, (13, 2))
    image[9:11] += 30.0, 40.0
    roles = ["control"] * 9 + ["check"] * 4
    points = Points.of(image, ground, "EPSG:4979", roles=roles, sigma_image=0.2)
    found = fit(ImageCorrection.identity(level, "shift", (1000.0, 1000.0)), points, robust=False)
    misses = (image - level.ground_to_image(ground))[9:] - (image - level.ground_to_image(ground))[:9].mean(axis=0)
    squares = (misses**2).sum(axis=1)
    scatter = (image - level.ground_to_image(ground))[:9].var(axis=0, ddof=1).sum()
    assert found.sigma0 == pytest.approx(math.sqrt(scatter / 2) / 0.2)
    assert found.sigma0 > 2.0
    (notice,) = [one for one in found.warnings if one.code == "checks-apart"]
    fields = notice.fields
    assert (fields["count"], fields["off"], sorted(fields["points"])) == (4, 2, ["10", "11"])
    assert fields["rmse"] == pytest.approx(math.sqrt(squares.mean()))
    assert fields["rest"] == pytest.approx(math.sqrt(squares[2:].mean()))
    assert fields["expected"] == pytest.approx(math.sqrt(scatter * 10 / 9))
    assert fields["alike"] is True


def test_a_common_error_is_published_in_metres() -> None:
    unknown = CommonGroundError(value=np.array([0.5, -2.0]), told=np.diag([3.0, 0.0]), sigma=4.0, points=7)
    found = CommonError.of(unknown)
    assert (found.points, found.sigma_m) == (7, 4.0)
    assert found.estimate_m == pytest.approx((2.0, -8.0))
    assert found.estimate_sigma_m == pytest.approx((2.0, 4.0))


def test_a_model_without_a_fit_has_its_reason_and_no_number() -> None:
    row = ComparedModel.of("rfm3", (78, 39, 3), "too few points")
    assert (row.model, row.parameters, row.minimum_points, row.dimensions) == ("rfm3", 78, 39, 3)
    assert row.error == "too few points"
    members = row.to_json()
    for name in ("condition", "redundancy", "sigma0", "fitted_as", "ridge", "effective_parameters"):
        assert members[name] is None
    assert set(members["rmse"].values()) == set(members["rmse_m"].values()) == {None}


@pytest.mark.parametrize("family", ["rfm2", "rfm3"])
@pytest.mark.parametrize("strength", [1.0, 0.04])
def test_the_regularisation_is_an_observation_of_zero_with_this_sigma(family: str, strength: float) -> None:
    """Of sigma / (g S sqrt(lambda)): S is half of the image, and g ten times larger with each order."""
    random = np.random.default_rng(2)
    ground = random.uniform([400e3, 5000e3, 200.0], [402e3, 5004e3, 800.0], (90, 3))
    image = np.column_stack([(ground[:, 0] - 400e3) / 2, (ground[:, 1] - 5000e3) / 2])
    points = Points.of(image, ground, "EPSG:32633", sigma_image=0.4)
    model: Any = start_model(family, points, size=(1000, 2000))
    problem = Problem.of(model, points, np.ones(90, dtype=bool), {})
    found, weight = regularised(problem, np.ones(90, dtype=bool), strength)
    assert weight == strength
    assert set(found.ridge) == set(model.penalised)
    half = (model.image_scale[0] + model.image_scale[1]) / 2
    for name, sigma in found.ridge.items():
        order = sum(int(power or 1) for power in re.findall(r"[XYZ](\d?)", name))
        grade = 10.0 ** (order - (1 if "den_" in name else 2))
        assert sigma == pytest.approx(0.4 / (grade * half * math.sqrt(strength))), name


def test_one_step_of_a_linear_model_is_its_whole_solution(level: RPC) -> None:
    """Residuals of points and of what is known before, sigma0 and redundancy: by plain least squares."""
    random = np.random.default_rng(5)
    ground = np.column_stack([random.uniform([19.992, -30.008], [20.008, -29.992], (9, 2)), np.full(9, 400.0)])
    image = level.ground_to_image(ground) + random.normal((7.0, -4.0), 0.5, (9, 2))
    points = Points.of(image, ground, "EPSG:4979", sigma_image=0.5)
    model = ImageCorrection.identity(level, "shift-drift", (1000.0, 1000.0))
    names = model.param_names
    known = {names[0]: Prior(5.0, 0.4), names[-1]: Prior(-2e-3, 1e-3)}
    problem = Problem.of(model, points, np.ones(9, dtype=bool), known)
    keep = np.arange(9) != 4
    step, whole = problem.solve(keep, linear=True), problem.solve(keep)
    rows = np.zeros((2, len(names)))
    sigma0 = 1.0
    for _ in range(40):
        # A point of a sigma of 0.5 sigma0 px, and two parameters with sigmas of their own.
        rows[0, 0], rows[1, -1] = sigma0 / 0.4, sigma0 / 1e-3
        design = np.vstack([model.param_partials(ground[keep]).reshape(16, -1) / 0.5, rows])
        observed = np.concatenate(
            [(image - level.ground_to_image(ground))[keep].ravel() / 0.5, rows @ [5.0, *[0] * (len(names) - 2), -2e-3]]
        )
        values = np.linalg.lstsq(design, observed, rcond=None)[0]
        cofactors, left = np.linalg.inv(design.T @ design), (observed - design @ values)[:16]
        freedom = 16 - np.trace(design[:16] @ cofactors @ design[:16].T)
        sigma0 = math.sqrt(left @ left / freedom)
    np.testing.assert_allclose(whole.model.params, values, rtol=1e-3)
    for found in (step, whole):
        assert found.freedom == pytest.approx(freedom, rel=1e-3)
        assert found.sigma0 == pytest.approx(sigma0, rel=1e-3)
        np.testing.assert_allclose(found.residuals.ravel(), left * 0.5, atol=1e-3)
        np.testing.assert_allclose(found.cofactors, cofactors, rtol=4e-3, atol=1e-12)
    np.testing.assert_array_equal(step.model.params, model.params)


@pytest.mark.parametrize("rows", [2, 3, 5])
def test_a_straight_line_has_the_sigmas_of_the_textbook(rows: int) -> None:
    """With one observation more than unknowns there is a sigma0, with as many there is none."""
    x = np.arange(rows, dtype=float)
    y = 3.0 + 2.0 * x + np.array([0.3, -0.5, 0.4, 0.1, -0.2])[:rows]
    found = solve_linear(np.column_stack([np.ones(rows), x]), y)
    fitted = np.polyfit(x, y, 1)[::-1]
    np.testing.assert_allclose(found.values, fitted, rtol=1e-12)
    if rows == 2:
        assert math.isnan(found.sigma0)
        return
    left = y - fitted[0] - fitted[1] * x
    assert found.sigma0 == pytest.approx(math.sqrt(left @ left / (rows - 2)))
    spread = ((x - x.mean()) ** 2).sum()
    assert found.sigmas == pytest.approx(found.sigma0 * np.sqrt([1 / rows + x.mean() ** 2 / spread, 1 / spread]))
    length = np.array([math.sqrt(rows), math.sqrt(float(x @ x))])
    assert found.condition == pytest.approx(np.linalg.cond(np.column_stack([np.ones(rows), x]) / length))


# -- errors of neighbours ----------------------------------------------------------------------------------------------


def test_a_covariance_function_that_is_there_is_found() -> None:
    """Semivariances of thirty distances with thirty pairs each; beyond three quarters of the longest none is used."""
    distance = np.repeat(np.arange(1.0, 41.0) * 100.0, 30)
    halves = 0.3**2 + 0.8**2 * (1.0 - np.exp(-distance / 700.0))
    halves[distance > 3000.0] = 50.0
    found = _function(distance, halves)
    assert found is not None
    assert (found.noise, found.systematic, found.range_m) == pytest.approx((0.3, 0.8, 700.0), rel=1e-3)
    # Two points with the same error hide it no more than others.
    halves[40] = 0.0
    same = _function(distance, halves)
    assert same is not None
    assert (same.noise, same.systematic, same.range_m) == pytest.approx((0.3, 0.8, 700.0), rel=0.1)
    # Without noise, and without a part that falls with the distance.
    pure = _function(distance, 0.8**2 * (1.0 - np.exp(-distance / 700.0)))
    assert pure is not None
    assert (pure.noise, pure.systematic, pure.range_m) == pytest.approx((0.0, 0.8, 700.0), rel=1e-3, abs=0.02)
    assert _function(distance, 1.0 - distance / 1e4) is None
    assert _function(distance[:89], halves[:89]) is None
    assert _function(distance, 0 * halves) is None


@pytest.mark.parametrize(
    ("count", "distances", "near"),
    [
        (12, np.arange(1, 100) * 10.3, 130.0),
        (3, np.arange(1, 100) * 10.3, 110.0),
        (12, np.arange(1, 100) * 0.025, 0.3),
        (12, np.arange(1, 12) * 1.0, None),
        (12, np.zeros(30), None),
    ],
)
def test_near_is_the_distance_with_as_many_pairs_as_points(
    count: int, distances: np.ndarray, near: float | None
) -> None:
    """At least ten, rounded up to two digits: 123.6 is 130, 0.3 stays."""
    assert _default_near(distances, count) == near


def test_classes_beyond_have_thirty_pairs() -> None:
    distance = np.random.default_rng(1).permutation(np.arange(1.0, 101.0))
    edges = _edges(distance, 10.0)
    assert (edges[0], edges[1], edges[-1]) == (0.0, 10.0, 100.0)
    assert len(edges) == 5
    assert np.diff(np.searchsorted(np.sort(distance), edges[1:], side="right")) == pytest.approx(30, abs=1)
    np.testing.assert_array_equal(_edges(np.arange(1.0, 40.0), 10.0), [0.0, 10.0, 39.0])
    assert len(_edges(distance, None)) == 0


def test_the_mean_is_tested_by_students_t() -> None:
    values = np.random.default_rng(1).normal(0.4, 1.0, (12, 2))
    assert _mean_p(values) == pytest.approx(stats.ttest_1samp(values, 0.0).pvalue)
    assert _mean_p(values[:8]) is not None
    assert _mean_p(values[:7]) is None
    assert _mean_p(np.zeros((12, 2))) == (1.0, 1.0)


def test_morans_index_is_by_its_definition() -> None:
    values = np.random.default_rng(1).normal(0, 1, (2, 6, 2))
    first, second = np.array([0, 1, 2, 5]), np.array([1, 0, 4, 3])
    found = _moran(values, first, second)
    for k in range(2):
        about = values[k] - values[k].mean(axis=0)
        wanted = sum(about[i] * about[j] for i, j in zip(first, second, strict=True)) / 4 / (about**2).mean(axis=0)
        np.testing.assert_allclose(found[k], wanted)


def test_moran_is_of_the_four_nearest() -> None:
    """On a line, the nearest of each point are known."""
    random = np.random.default_rng(3)
    x, values = np.cumsum(random.uniform(1.0, 2.0, 15)), random.normal(0, 1, (15, 2))
    nearest = [np.argsort(np.abs(x - x[k]))[1:5] for k in range(15)]
    about = values - values.mean(axis=0)
    about -= about.mean(axis=0)
    wanted = np.mean([about[k] * about[j] for k in range(15) for j in nearest[k]], axis=0) / (about**2).mean(axis=0)
    found = analyse(np.column_stack([x, 0 * x]), values, draws=19)
    assert found.moran == pytest.approx(tuple(wanted))


@pytest.mark.parametrize(("across", "down", "cells"), [(24, 24, 144), (36, 16, 144), (600, 1, 144), (5, 5, 25)])
def test_points_are_averaged_over_square_cells(across: int, down: int, cells: int) -> None:
    """About 144, as long as wide; noise stays as it is."""
    x, y = np.meshgrid(np.arange(across) + 0.5, np.arange(down) + 0.5)
    image = np.column_stack([x.ravel(), y.ravel()]) * 10.0 + (1000.0, -500.0)
    means = _cell_means(image[np.random.default_rng(1).permutation(len(image))])
    assert len(means) == cells
    np.testing.assert_allclose(means @ means.T, np.eye(cells), atol=1e-12)
    each = (means > 0).sum(axis=1)
    assert each.sum() == len(image)
    assert each.max() - each.min() <= 1
    np.testing.assert_allclose(means.sum(axis=1), np.sqrt(each))


def test_the_points_of_a_cell_are_neighbours() -> None:
    image = np.random.default_rng(2).uniform(0, 1000, (900, 2))
    for row in _cell_means(image):
        assert np.ptp(image[row > 0], axis=0).max() <= 1000 / 12 + 1


def test_an_error_that_control_shares_is_expected_in_check_points_without_it(level: RPC) -> None:
    """A mean of nine and a common error: 10/9 of the scatter, and the shift's common variance as it is, in px."""
    random = np.random.default_rng(4)
    ground = np.column_stack([random.uniform([19.992, -30.008], [20.008, -29.992], (12, 2)), np.full(12, 400.0)])
    image = level.ground_to_image(ground) + random.normal(0.0, 0.6, (12, 2))
    image[9] += 60.0, 80.0
    points = Points.of(image, ground, "EPSG:4979", roles=["control"] * 9 + ["check"] * 3, sigma_image=0.2)
    used = points.control
    solution = Problem.of(ImageCorrection.identity(level, "shift", (1000.0, 1000.0)), points, used, {}).solve(
        np.ones(9, dtype=bool)
    )
    common = np.array([[1.5, 0.4], [0.4, 0.7]])
    (found,) = outlying(solution, points, used, common)
    misses = image - level.ground_to_image(ground)
    scatter = misses[:9].var(axis=0, ddof=1).sum()
    assert found.id == "10"
    assert found.distance == pytest.approx(np.hypot(*(misses[9] - misses[:9].mean(axis=0))))
    assert found.expected == pytest.approx(math.sqrt(scatter * 10 / 9 + 1.5 + 0.7))
