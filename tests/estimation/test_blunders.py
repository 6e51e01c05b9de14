"""Gross errors: what is left out, readmitted and reported, by the F distribution and fits without the point."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ortho_pipeline.errors import DegeneratePoints
from ortho_pipeline.estimation.blunders import (
    OutlyingPoint,
    _median_start,
    _median_subset,
    checks_apart,
    find_blunders,
    outlying,
    refuse_many,
)
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.problem import Problem, Solution
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points

SIGMA = 0.25
DIRECTION = np.array([0.6, -0.8])


def points_of(level: RPC, misses: np.ndarray, checks: int = 0, **more: Any) -> Points:
    """Return points whose measurements are off by `misses` px; the last ones are check points."""
    count = len(misses)
    ground = np.random.default_rng(8).uniform([19.992, -30.008, 300.0], [20.008, -29.992, 700.0], (count, 3))
    roles = ["control"] * (count - checks) + ["check"] * checks
    made = Points.of(level.ground_to_image(ground) + misses, ground, "EPSG:4979", roles=roles, sigma_image=SIGMA)
    return replace(made, **more)


def problem_of(level: RPC, points: Points, kind: str = "shift") -> Problem:
    return Problem.of(ImageCorrection.identity(level, kind, (1000.0, 1000.0)), points, points.control, {})


def solved(level: RPC, points: Points, kind: str = "shift") -> Solution:
    return problem_of(level, points, kind).solve(np.ones(int(points.control.sum()), dtype=bool))


def drawn(count: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal((7.0, -4.0), 0.6, (count, 2))


def limit(others: np.ndarray, chance: float, of: str = "left out") -> float:
    """Return the distance from the mean of other points (px) that a good point exceeds with this chance."""
    freedom = 2 * len(others) - 2
    variance = ((others - others.mean(axis=0)) ** 2).sum() / freedom
    return math.sqrt(2 * stats.f.isf(chance, 2, freedom) * variance * (1 + 1 / len(others)))


# -- points that are left out ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", [0.99, 1.01])
@pytest.mark.parametrize("ridge", [{}, {"col_shift": 1e6}])
def test_a_point_is_left_out_if_one_good_set_in_a_thousand_has_such_a_point(
    level: RPC, part: float, ridge: dict[str, float]
) -> None:
    """Both searches end with this test: that of few parameters, and that with a regularisation (here a weak one)."""
    others = drawn(11)
    distance = part * limit(others, 0.001 / 12)
    misses = np.insert(others, 5, others.mean(axis=0) + distance * DIRECTION, axis=0)
    keep, reasons = find_blunders(problem_of(level, points_of(level, misses)).with_ridge(ridge))
    assert keep.tolist() == [k != 5 or part < 1 for k in range(12)]
    wanted = {} if part < 1 else {5: f"gross error: {distance:.1f} px from where the other points predict it"}
    assert reasons == wanted


def test_a_majority_is_right_though_the_minority_agrees_better(level: RPC) -> None:
    """Six of eleven points scatter by a pixel; the first five have one wrong shift, the same to a hundredth."""
    wrong = np.array([300.0, 0.0]) + np.random.default_rng(1).normal(0, 0.01, (5, 2))
    right = np.array([(0.9, 0.2), (-0.8, 0.5), (0.1, -1.0), (0.7, 0.8), (-0.6, -0.7), (0.2, 0.4)])
    keep, reasons = find_blunders(problem_of(level, points_of(level, np.vstack([wrong, right]))))
    assert keep.tolist() == [False] * 5 + [True] * 6
    assert sorted(reasons) == [0, 1, 2, 3, 4]


def test_three_points_that_define_an_affine_correction_are_found_among_six_good_ones(level: RPC) -> None:
    """Three wrong points agree exactly with some affine correction, and each of them with many pairs of good points."""
    misses = drawn(9, seed=5) * 0.1
    misses[[0, 3, 8]] += [(40.0, 10.0), (-30.0, 25.0), (15.0, -60.0)]
    keep, reasons = find_blunders(problem_of(level, points_of(level, misses), "affine"))
    assert np.flatnonzero(~keep).tolist() == [0, 3, 8] == sorted(reasons)


def test_a_camera_that_wrong_points_bend_is_linearised_again() -> None:
    """Five of fourteen points are up to 900 px off; the camera from all of them is too far off to tell which."""
    interior = Interior(1000, 1500, 0.120, 1e-4, 1e-4)
    true = FrameCamera.from_map(
        interior, "EPSG:32636", [480e3, 4.42e6, 6000.0, 0.1, -0.2, 2.5], frame="map", heights=(700.0, 1900.0)
    )
    random = np.random.default_rng(30)
    image = random.uniform([30, 30], [970, 1470], (14, 2))
    ground = true.image_to_ground(image, random.uniform(700, 1900, 14))
    image += random.normal(0, 0.3, (14, 2))
    wrong = random.permutation(14)[:5]
    image[wrong] += random.uniform(-900, 900, (5, 2))
    points = Points.of(image, ground, "EPSG:32636", sigma_image=0.3)
    start = true.with_params(true.params + np.array([900.0, -700.0, 800.0, 0.12, 0.1, -0.2]))
    problem = Problem.of(start, points, np.ones(14, dtype=bool), {})
    common = problem.solve(np.ones(14, dtype=bool))
    assert _median_subset(common, 0)[wrong].sum() == 1
    assert not _median_start(problem, common)[wrong].any()
    keep, reasons = find_blunders(problem)
    assert set(np.flatnonzero(~keep)) == set(wrong) == set(reasons)


@pytest.mark.parametrize("seed", [8, 10, 16, 23])
def test_points_that_bend_a_camera_until_nothing_determines_it_are_found(seed: int) -> None:
    """Four of fourteen points are up to 9,000 px off: the adjustment of all has no unique solution."""
    interior = Interior(1000, 1500, 0.120, 1e-4, 1e-4)
    true = FrameCamera.from_map(
        interior, "EPSG:32636", [480e3, 4.42e6, 6000.0, 0.1, -0.2, 2.5], frame="map", heights=(700.0, 1900.0)
    )
    random = np.random.default_rng(seed)
    image = random.uniform([30, 30], [970, 1470], (14, 2))
    ground = true.image_to_ground(image, random.uniform(700, 1900, 14))
    image += random.normal(0, 0.3, (14, 2))
    wrong = random.permutation(14)[:4]
    image[wrong] += random.uniform(-9000, 9000, (4, 2))
    start = true.with_params(true.params + np.array([300.0, -200.0, 250.0, 0.04, 0.03, -0.06]))
    points = Points.of(image, ground, "EPSG:32636", sigma_image=0.3)
    problem = Problem.of(start, points, np.ones(14, dtype=bool), {})
    with pytest.raises(DegeneratePoints):
        problem.solve(np.ones(14, dtype=bool))
    keep, reasons = find_blunders(problem)
    assert set(np.flatnonzero(~keep)) == set(wrong) == set(reasons)


def test_two_points_cannot_show_which_is_wrong_and_three_can(level: RPC) -> None:
    misses = np.array([(0.3, 0.1), (900.0, 700.0), (0.1, 0.2)])
    two, three = (find_blunders(problem_of(level, points_of(level, misses[:count]))) for count in (2, 3))
    assert two[0].all()
    assert not two[1]
    assert three[0].tolist() == [True, False, True]
    assert list(three[1]) == [1]


def test_one_point_more_than_three_tenths_is_removed_one_after_another(level: RPC) -> None:
    """Then there are too many to decide which are wrong, so the fit is refused."""
    misses = drawn(10) * 0.2
    misses[[1, 4, 6, 7]] += [(1e5, 0.0), (0.0, -3e3), (80.0, 60.0), (-5.0, 5.0)]
    problem = problem_of(level, points_of(level, misses)).with_ridge({"row_shift": 1e6})
    keep, reasons = find_blunders(problem)
    assert sorted(reasons) == [1, 4, 6, 7] == np.flatnonzero(~keep).tolist()


@pytest.mark.parametrize("seed", range(3))
def test_good_points_near_the_minimum_are_not_removed_before_the_model_follows_them(seed: int) -> None:
    random = np.random.default_rng(seed)
    unit = random.uniform(-1.0, 1.0, (8, 3))
    image = 1000.0 + 1000.0 * unit[:, :2] / (1.0 + unit @ [[0.02], [-0.01], [0.04]]) + random.normal(0.0, 0.2, (8, 2))
    points = Points.of(image, unit * (1000.0, 1000.0, 300.0) + (500e3, 4e6, 500.0), crs="EPSG:32636", sigma_image=0.2)
    assert fit_family("rfm1", points).rejected == ()


def test_ten_points_are_named_and_further_ones_are_counted() -> None:
    names = [f"g{k}" for k in range(11)]
    for count, shown in ((10, "g8, g9)"), (11, "g8, g9 ...)")):
        with pytest.raises(DegeneratePoints) as refused:
            refuse_many(names[:count], 20, "match", "", "match again")
        assert shown in refused.value.message
        assert refused.value.file is None


# -- points that are reported ------------------------------------------------------------------------------------------


def test_an_outlying_control_point_is_tested_by_the_fit_of_the_others(level: RPC) -> None:
    """Of an affine correction, with covariances of column and row that differ from point to point."""
    random = np.random.default_rng(11)
    root = random.uniform(0.1, 0.5, (10, 2, 2)) * [[1.0, 0.0], [-1.0, 1.0]]
    covariance = root @ root.transpose(0, 2, 1)
    misses = 2 * np.einsum("nij,nj->ni", root, random.normal(size=(10, 2)))
    misses[4] += 9.0, 14.0
    points = points_of(level, misses).with_covariance_image(covariance)
    (found,) = outlying(solved(level, points, "affine"), points, points.control)

    image = level.ground_to_image(points.ground) - 1000.0
    design = np.zeros((10, 2, 6))
    design[:, 0, :3] = design[:, 1, 3:] = np.column_stack([np.ones(10), image])
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    rows, right = white @ design, np.einsum("nij,nj->ni", white, misses)
    others = np.arange(10) != 4
    values, square, *_ = np.linalg.lstsq(rows[others].reshape(-1, 6), right[others].ravel(), rcond=None)
    variance = square[0] / (18 - 6)
    cofactors = np.linalg.inv(rows[others].reshape(-1, 6).T @ rows[others].reshape(-1, 6))
    spread = covariance[4] + design[4] @ cofactors @ design[4].T
    miss = misses[4] - design[4] @ values
    everything = np.linalg.inv(rows.reshape(-1, 6).T @ rows.reshape(-1, 6))
    assert (found.id, found.role) == ("5", "control")
    assert found.distance == pytest.approx(np.hypot(*miss), rel=1e-6)
    assert found.expected == pytest.approx(math.sqrt(variance * np.trace(spread)), rel=1e-6)
    assert found.chance == pytest.approx(
        stats.f.sf(miss @ np.linalg.solve(spread, miss) / variance / 2, 2, 12), rel=1e-5
    )
    assert found.leverage == pytest.approx(np.trace(rows[4] @ everything @ rows[4].T) / 2, rel=1e-6)
    assert found.reason.endswith(f"takes part in the adjustment (leverage {found.leverage:.2f})")


@pytest.mark.parametrize("part", [0.99, 1.01])
@pytest.mark.parametrize("noise", [1.0, 0.0])
def test_a_control_point_is_reported_if_one_good_set_in_a_hundred_has_such_a_point(
    level: RPC, part: float, noise: float
) -> None:
    """Without any noise, a thousandth of the stated sigma is the scale."""
    others = (7.0, -4.0) + noise * (drawn(8) - (7.0, -4.0))
    distance = limit(others, 0.01 / 9)
    if not noise:
        distance = 1e-3 * SIGMA * math.sqrt(2 * stats.f.isf(0.01 / 9, 2, 14) * 9 / 8)
    last = others.mean(axis=0) + part * distance * DIRECTION
    points = points_of(level, np.vstack([others, last]))
    assert [point.id for point in outlying(solved(level, points), points, points.control)] == ["9"][: part > 1]


@pytest.mark.parametrize("part", [0.99, 1.01])
@pytest.mark.parametrize("noise", [1.0, 0.0])
def test_a_check_point_is_reported_if_one_good_set_in_a_hundred_has_such_a_point(
    level: RPC, part: float, noise: float
) -> None:
    """Without any noise, a thousandth of the stated sigma is the scale."""
    control = (7.0, -4.0) + noise * (drawn(9) - (7.0, -4.0))
    distance = part * limit(control, 0.01 / 4)
    if not noise:
        distance = part * 1e-3 * SIGMA * math.sqrt(2 * stats.f.isf(0.01 / 4, 2, 16) * 10 / 9)
    checks = control.mean(axis=0) + np.array([[1.0], [0.1], [-0.1], [0.15]]) * distance * DIRECTION
    points = points_of(level, np.vstack([control, checks]), 4)
    found = outlying(solved(level, points), points, points.control)
    assert [(point.id, point.role) for point in found] == [("10", "check")][: part > 1]
    for point in found:
        assert point.distance == pytest.approx(distance, rel=1e-4)
        assert point.leverage == 0.0
        assert point.reason.endswith("it still counts in the RMSE of the check points")


@pytest.mark.parametrize("part", [0.99, 1.01])
def test_a_check_point_is_tested_by_the_only_observation_to_spare(level: RPC, part: float) -> None:
    """One point and a shift of columns: its row, 0.4 px off, is all that is known of the noise."""
    distance = part * 0.4 * math.sqrt(2 * stats.f.isf(0.01, 2, 1))
    points = points_of(level, np.array([(7.0, 0.4), (7.0, distance)]), 1)
    model = ImageCorrection.identity(level, "shift", (1000.0, 1000.0)).without(["row_shift"])
    solution = Problem.of(model, points, points.control, {}).solve(np.ones(1, dtype=bool))
    assert [point.id for point in outlying(solution, points, points.control)] == ["2"][: part > 1]


@pytest.mark.parametrize("part", [0.99, 1.01])
def test_the_scatter_of_five_check_points_is_their_scale(level: RPC, part: float) -> None:
    """By the median of their squares, with five degrees of freedom; four are compared with the control points."""
    control = drawn(9)
    median = 12.0
    far = part * math.sqrt(2 * stats.f.isf(0.01 / 5, 2, 5) * median**2 / (2 * math.log(2)))
    sizes = np.array([9.0, median, 13.0, far, 8.0])
    points = points_of(level, np.vstack([control, control.mean(axis=0) + sizes[:, None] * DIRECTION]), 5)
    found = outlying(solved(level, points), points, points.control)
    assert [point.id for point in found] == ["13"][: part > 1]
    for point in found:
        assert point.expected == pytest.approx(median / math.sqrt(math.log(2)), rel=1e-6)
        assert point.chance == pytest.approx(stats.f.sf(far**2 / median**2 * math.log(2), 2, 5), rel=1e-6)
    four = points.select(np.arange(13))
    assert [point.id for point in outlying(solved(level, four), four, four.control)] == ["10", "11", "12", "13"]
    # A scatter below that of control is no scale: one of five is far.
    sizes = np.array([0.1, 0.2, 0.3, 6.0, 0.15])
    points = points_of(level, np.vstack([control, control.mean(axis=0) + sizes[:, None] * DIRECTION]), 5)
    (one,) = outlying(solved(level, points), points, points.control)
    assert one.expected == pytest.approx(math.sqrt(control.var(axis=0, ddof=1).sum() * 10 / 9))
    assert one.chance == pytest.approx(stats.f.sf(36.0 / control.var(axis=0, ddof=1).sum() / (10 / 9), 2, 16), rel=1e-6)


def test_three_measured_check_points_are_compared_with_each_other_if_all_control_was_matched(level: RPC) -> None:
    control = drawn(9)
    off = np.array([(50.0, -30.0), (50.2, -30.4), (62.0, -25.0), (49.7, -29.8)])
    points = points_of(level, np.vstack([control, off]), 4)
    matched = replace(points, groups=np.array([*range(9), -1, -1, -1, -1]))

    def found(some: Points) -> dict[str, float]:
        return {point.id: point.distance for point in outlying(solved(level, some), some, some.control)}

    away = off - control.mean(axis=0)
    assert found(points) == pytest.approx({str(10 + k): np.hypot(*away[k]) for k in range(4)})
    assert found(matched) == pytest.approx({"12": np.hypot(*(off[2] - np.median(off, axis=0)))})
    assert found(matched.select(np.arange(12))) == pytest.approx(
        {"12": np.hypot(*(off[2] - np.median(off[:3], axis=0)))}
    )
    assert list(found(matched.select(np.arange(11)))) == ["10", "11"]
    # One measured control point gives the offset; so do check points that were matched themselves.
    assert len(found(replace(matched, groups=np.array([-1, *range(8), -1, -1, -1, -1])))) == 4
    assert len(found(replace(matched, groups=np.array([*range(9), 20, 21, 22, -1])))) == 4
    offset = found(replace(matched, groups=np.array([*range(1, 10), 0, -1, -1, -1])))
    assert offset["10"] == pytest.approx(np.hypot(*away[0]))
    assert offset["12"] == pytest.approx(np.hypot(*(off[2] - np.median(off[1:], axis=0))))


# -- check points that are apart ---------------------------------------------------------------------------------------


def named(*ids: str) -> list[OutlyingPoint]:
    return [OutlyingPoint.of(name, "check", 9.0, 1.0, 1e-6) for name in ids]


def apart(
    level: RPC, sizes: Any, outliers: list[OutlyingPoint], *, shared: bool = False, scatter: float = 1.0, **more: Any
) -> Any:
    """Return the fields of the notice of check points so many times the expected error away; None without a notice."""
    control = scatter * drawn(9)
    usual = math.sqrt(control.var(axis=0, ddof=1).sum() * 10 / 9)
    checks = control.mean(axis=0) + np.asarray(sizes)[:, None] * usual * DIRECTION
    points = points_of(level, np.vstack([control, checks]), len(checks), **more)
    notices = checks_apart(solved(level, points), points, points.control, outliers, shared=shared)
    assert len(notices) < 2
    if not notices:
        return None
    fields = notices[0].fields
    assert fields["expected"] == pytest.approx(usual)
    assert fields["rmse"] == pytest.approx(usual * np.sqrt(np.mean(np.square(sizes))))
    return {**fields, "rest": fields["rest"] and fields["rest"] / usual, "text": str(notices[0])}


@pytest.mark.parametrize(("part", "told"), [(0.99, False), (1.01, True)])
def test_an_outlier_that_doubles_the_rmse_of_the_others_is_told(level: RPC, part: float, told: bool) -> None:
    # With three of size a, the RMSE of all is 2 a if the fourth is sqrt(13) a.
    found = apart(level, [0.8, 0.8, part * 0.8 * math.sqrt(13), 0.8], named("12"), shared=True)
    assert (found is not None) == told
    if told:
        assert (found["off"], found["count"], found["points"]) == (1, 4, ["12"])
        assert found["rest"] == pytest.approx(0.8)
    # A single one is compared with what control lets expect.
    alone = apart(level, [part * 2.0], named("10"), shared=True)
    assert (alone is not None) == told
    assert apart(level, [0.8, 0.8, 4.0, 0.8], [], shared=True) is None


def test_check_points_that_are_apart_together_count_from_three_times_the_expected_error(level: RPC) -> None:
    found = apart(level, [2.97, 3.03, 2.5, 2.2], [])
    assert (found["off"], found["points"]) == (1, ["11"])
    assert found["rest"] == pytest.approx(math.sqrt((2.97**2 + 2.5**2 + 2.2**2) / 3))
    both = apart(level, [2.7, 2.8], [])
    assert (both["off"], both["count"], both["points"], both["rest"]) == (0, 2, ["11", "10"], None)
    for scatter in (1.0, 0.1):
        single = apart(level, [2.7], [], scatter=scatter)
        assert (single["off"], single["count"], single["points"], single["rest"]) == (1, 1, ["10"], None)
    five = apart(level, [2.5, 2.9, 2.6, 2.8, 2.7], [])
    assert (five["off"], five["points"]) == (0, ["11", "13", "14"])
    assert apart(level, [2.7, 2.8], [], shared=True) is None


def test_matched_control_is_not_contradicted_by_check_points_together(level: RPC) -> None:
    """They are compared with each other only if there are three; a single matched control point is enough."""
    for first in (0, -1):
        assert apart(level, [2.7, 2.8], [], groups=np.array([first, *range(1, 9), -1, -1])) is None
    assert apart(level, [2.7, 2.8], [], groups=np.full(11, -1)) is not None
    # Check points that were matched say nothing: here the far one.
    assert apart(level, [0.5, 0.6, 80.0], [], groups=np.array([-1] * 11 + [0])) is None
    assert apart(level, [0.5, 0.6, 80.0], [], groups=np.array([-1] * 11 + [7])) is None


def test_at_most_ten_points_are_named_and_the_worst_first(level: RPC) -> None:
    sizes = [20.0, 23.0, 21.0, 31.0, 22.0, 28.0, 24.0, 26.0, 25.0, 27.0, 30.0, 29.0, 0.5]
    found = apart(level, sizes, named(*(str(10 + k) for k in range(12))))
    order = sorted(range(12), key=lambda k: -sizes[k])
    assert (found["off"], found["points"]) == (12, [str(10 + k) for k in order[:10]])
    assert found["rest"] == pytest.approx(0.5)
