"""What a fit states of itself: bias, root mean squares by role, sigmas in the image, tests and reservations."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.blunders import OutlyingPoint
from ortho_pipeline.estimation.family_fit import fit_own, prune, restricted, ridge_of
from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.estimation.observations.common_unknown import CommonGroundError
from ortho_pipeline.estimation.observations.on_points import OnPoints, Planes
from ortho_pipeline.exchange.rpc import read_rpc
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.points import Points, read_points

ORIGIN = (800.0, 1100.0)


def fitted(level: RPC, kind: str = "affine", seed: int = 6, slope: float = 0.0) -> Fit:
    """Return a fit of nine control and five check points; two check points are matches."""
    random = np.random.default_rng(seed)
    ground = random.uniform([19.992, -30.008, 300.0], [20.008, -29.992, 700.0], (14, 3))
    plain = level.ground_to_image(ground)
    image = plain + (3.0, -2.0) + slope * (plain - ORIGIN)[:, [1, 0]] * (1.0, 0.0) + random.normal(0, 0.5, (14, 2))
    roles = ["control"] * 9 + ["check"] * 5
    points = Points.of(image, ground, "EPSG:4979", roles=roles, sigma_image=0.5)
    points = dataclasses.replace(points, groups=np.array([-1] * 12 + [4, 5]))
    return fit(ImageCorrection.identity(level, kind, ORIGIN), points, robust=False)


def test_the_bias_of_the_delivered_model_is_the_mean_of_its_residuals_at_used_points(level: RPC) -> None:
    """With their standard deviation about it, over their number."""
    found = fitted(level)
    raw = (found.points.image - level.ground_to_image(found.points.ground))[:9]
    bias = found.raw_bias
    assert bias is not None
    assert (bias.col, bias.row) == pytest.approx(tuple(raw.mean(axis=0)))
    spread = np.sqrt(((raw - raw.mean(axis=0)) ** 2).sum(axis=0) / 9)
    assert (bias.std_col, bias.std_row, bias.n) == pytest.approx((*spread, 9))


def test_root_mean_squares_are_of_the_points_of_their_role(level: RPC) -> None:
    """If some check points were measured, matches do not count as check points."""
    found = fitted(level)
    residuals = np.random.default_rng(1).normal(size=(14, 2)) * (1.0, 3.0)
    residuals[10] = np.nan
    outlier = OutlyingPoint.of("10", "check", 9.0, 1.0, 1e-6)
    found = dataclasses.replace(found, residuals=residuals, outlying=(outlier,))
    groups = {"control": range(9), "check": (9, 11), "matched": (12, 13), "agreeing": (11,)}
    for which, rows in groups.items():
        rmse = found.rmse(which)
        assert rmse is not None
        squares = (residuals[list(rows)] ** 2).mean(axis=0)
        assert (rmse.col, rmse.row) == pytest.approx(tuple(np.sqrt(squares))), which
        assert rmse.total == pytest.approx(math.sqrt(squares.sum()))
        assert rmse.n == len(rows)
    assert found.rmses.matched == found.rmse("matched")
    loo = found.loo_residuals[:9]
    left_out = found.rmse("loo")
    assert left_out is not None
    assert (left_out.n, left_out.total) == pytest.approx((9, math.sqrt((loo**2).sum() / 9)))
    # Without measured check points, matches are the check points.
    matched = dataclasses.replace(found, points=dataclasses.replace(found.points, groups=np.arange(14)))
    assert matched.rmse("matched") is None
    check = matched.rmse("check")
    assert check is not None
    assert check.n == 4


def test_a_sigma_in_the_image_is_that_of_the_parameters_there(level: RPC) -> None:
    found = fitted(level)
    ground = level.image_to_ground([[100.0, 300.0], [1900.0, 1500.0]], 450.0)
    sigma = found.image_sigma(ground)
    for k, (column, row) in enumerate(((100.0, 300.0), (1900.0, 1500.0))):
        rows = np.array([1.0, column - 800.0, row - 1100.0])
        across, down = found.covariance[:3, :3], found.covariance[3:, 3:]
        np.testing.assert_allclose(sigma[k], [math.sqrt(rows @ across @ rows), math.sqrt(rows @ down @ rows)])


def test_a_fit_has_reservations_from_its_limits_on(level: RPC) -> None:
    found = fitted(level)

    def of(**changes: Any) -> tuple[str, ...]:
        return dataclasses.replace(found, **changes).reservations

    assert of(condition=1e4, corner_ratio=10.0) == ()
    assert of(condition=1.01e4, corner_ratio=10.01) == ("unstable", "uncertain at a corner")
    assert of(condition=1.0, corner_ratio=math.nan) == ("uncertain at a corner",)
    one = found.model.without([name for name in found.param_names if name != "col_shift"])
    assert of(model=one, condition=1e9, corner_ratio=1.0) == ()
    assert found.effective_points == 9.0


def test_a_parameter_is_justified_up_to_its_significance(level: RPC) -> None:
    found = fitted(level)
    t, p = found.student
    np.testing.assert_allclose(t, found.values / np.sqrt(np.diag(found.covariance)))
    np.testing.assert_allclose(p, 2 * stats.t.sf(np.abs(t), 18 - 6))
    k = int(np.argsort(p)[3])
    for significance, justified in ((p[k] * 1.001, True), (p[k] * 0.999, False)):
        strict = dataclasses.replace(found, significance=float(significance))
        assert (found.param_names[k] not in strict.not_justified) == justified


def test_a_shift_of_zero_beside_slopes_is_not_called_unjustified(level: RPC) -> None:
    """It is zero only because of the origin, so pruning cannot remove it."""
    places = np.random.default_rng(3).uniform([19.992, -30.008, 300.0], [20.008, -29.992, 700.0], (14, 3))
    start = ImageCorrection.identity(level, "affine", ORIGIN)
    true = start.with_params([0.0, 0.02, -0.01, 0.0, 0.01, 0.02])
    noise = np.random.default_rng(4).normal(0, 0.1, (14, 2))
    found = fit(start, Points.of(true.ground_to_image(places) + noise, places, "EPSG:4979", sigma_image=0.1))
    _, p = found.student
    assert min(p[0], p[3]) > 0.05
    assert found.not_justified == ()
    assert prune(found).removed == ()


def test_without_redundancy_no_parameter_is_called_unjustified(level: RPC) -> None:
    """Pruning refuses such a fit, because it has no sigma0."""
    found = fitted(level, "shift-drift")
    two = fit(ImageCorrection.identity(level, "shift-drift", ORIGIN), found.points.select([0, 1]), robust=False)
    assert two.sigma0 is None
    assert (two.student[1] > 0.05).any()
    assert two.not_justified == ()


# -- parameters that are removed ---------------------------------------------------------------------------------------


def test_parameters_are_removed_one_after_another_with_their_test_at_that_time(level: RPC) -> None:
    """Each is the least significant slope of plain least squares with those that are left."""
    found = fitted(level, slope=0.002)
    image = level.ground_to_image(found.points.ground)[:9]
    misses = (found.points.image[:9] - image).T
    names = {"col": ["col_shift", "col_per_col", "col_per_row"], "row": ["row_shift", "row_per_col", "row_per_row"]}
    design = dict(zip(range(3), (np.ones(9), *(image - ORIGIN).T), strict=True))
    left = {axis: [0, 1, 2] for axis in names}
    wanted = []
    while True:
        squares = 0.0
        tests: dict[tuple[str, int], float] = {}
        for axis, miss in zip(names, misses, strict=True):
            rows = np.column_stack([design[k] for k in left[axis]])
            values, (square,), *_ = np.linalg.lstsq(rows, miss, rcond=None)
            squares += square
            sizes = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))
            tests |= {(axis, k): value / size for k, value, size in zip(left[axis], values, sizes, strict=True)}
        freedom = 18 - sum(map(len, left.values()))
        scaled = {key: value / math.sqrt(squares / freedom) for key, value in tests.items()}
        chances = {key: 2 * stats.t.sf(abs(value), freedom) for key, value in scaled.items() if key[1]}
        worst = max(chances, key=chances.__getitem__, default=None)
        if worst is None or chances[worst] <= 0.05:
            break
        wanted.append((names[worst[0]][worst[1]], scaled[worst], chances[worst]))
        left[worst[0]].remove(worst[1])
    pruned = prune(found)
    assert 1 < len(wanted) < 4
    assert [part.name for part in pruned.removed] == [name for name, _, _ in wanted]
    for part, (_, t, p) in zip(pruned.removed, wanted, strict=True):
        assert (part.t, part.p) == pytest.approx((t, p), rel=1e-5)
    assert "col_per_row" in pruned.fit.param_names
    np.testing.assert_array_equal(pruned.fit.raw_residuals, found.raw_residuals)


@pytest.mark.parametrize("significance", [0.0, 1.0, -0.1, math.nan])
def test_a_significance_is_between_none_and_all(level: RPC, significance: float) -> None:
    with pytest.raises(InputError, match="between 0 and 1"):
        prune(fitted(level), significance=significance)


def test_the_only_parameter_stays(level: RPC) -> None:
    found = fitted(level, "shift")
    alone = prune(fit(found.model.without(["row_shift"]), found.points, robust=False), significance=1e-15)
    assert alone.fit.param_names == ("col_shift",)
    with pytest.raises(InputError, match="no redundancy"):
        prune(dataclasses.replace(found, sigma0=None))
    with pytest.raises(InputError, match="no parameters of its own"):
        fit_own(level, found.points)


def test_own_parameters_are_adjusted_without_gross_errors_unless_all_points_are_wanted(level: RPC) -> None:
    points = fitted(level).points
    image = points.image.copy()
    image[4] += 90.0
    points = dataclasses.replace(points, image=image)
    start = ImageCorrection.identity(level, "affine", ORIGIN)
    assert [name for name, _ in fit_own(start, points).rejected] == [points.ids[4]]
    assert fit_own(start, points, robust=False).rejected == ()


def test_some_parameters_are_adjusted_and_others_zero(level: RPC) -> None:
    model = ImageCorrection(level, "affine", ORIGIN, np.array([1.0, 2e-3, 3e-3, 4.0, 5e-3, 6e-3]))
    assert restricted(model, None) is model
    assert restricted(model, model.param_names) is model
    some = restricted(model, ("row_shift", "col_shift", "row_per_col"))
    assert some.param_names == ("col_shift", "row_shift", "row_per_col")
    assert some.coefficients.tolist() == [1.0, 0.0, 0.0, 4.0, 5e-3, 0.0]
    for wrong in ((), ("col_shift", "tilt")):
        with pytest.raises(InputError) as refused:
            restricted(model, wrong)
        assert refused.value.field == "points.params"


def test_a_regularisation_is_a_method_none_or_a_positive_weight() -> None:
    assert [ridge_of(text) for text in ("auto", "gcv", "lcurve", "none", "1e-5", "3")] == [
        "auto", "gcv", "lcurve", None, 1e-5, 3.0,
    ]  # fmt: skip
    for wrong in ("0", "-1", "best", "nan", ""):
        with pytest.raises(InputError):
            ridge_of(wrong)


# -- observations besides points ---------------------------------------------------------------------------------------


def test_positions_are_observed_along_their_axes_with_weights() -> None:
    """A known place in two directions; its misfit over the sigma counts by the root of the weight."""
    axes = np.array([[[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]])
    place = OnPoints(np.array([[0.9, -2.0, 0.0]]), axes, np.array([[0.3, 0.5, math.inf]]))
    assert place.observed.tolist() == [[True, True, False]]
    np.testing.assert_allclose(place.misfits(np.array([4.0])), [[6.0, -8.0, 0.0]])
    np.testing.assert_allclose(
        place.partials(np.array([4.0])), np.array([[[4.0, 16 / 3, 0.0], [-3.2, 2.4, 0.0], [0.0, 0.0, 0.0]]])
    )


def test_a_plane_is_above_a_point_along_its_normal() -> None:
    axes = np.array([[[1.0, 0, 0], [0, 0.8, 0.6], [0, -0.6, 0.8]], np.eye(3), np.eye(3)])
    planes = Planes(np.array([[1.0, 2.0, 3.0], [0, 0, 5.0], [0, 0, 7.0]]), axes, np.array([1.0, math.inf, 2.0]))
    assert planes.on.tolist() == [True, False, True]
    local = np.array([[4.0, 1.0, 1.0], [9.0, 9.0, 1.5], [9.0, 9.0, 9.5]])
    np.testing.assert_allclose(planes.above(local), [-0.6 * 1 + 0.8 * 2, 3.5, -2.5])
    np.testing.assert_allclose(planes.above(local, np.array([2, 0])), [-2.5, 1.0])


def test_a_common_error_starts_from_the_median_unless_it_is_four_sigmas() -> None:
    unknown = CommonGroundError(
        value=np.array([0.1, 0.2]), told=np.array([[3.0, 1.0], [1.0, 2.0]]), sigma=2.0, points=9
    )
    each = np.array([[1.0, -2.0], [3.9, -3.9], [70.0, -90.0], [np.nan, 5.0]])
    np.testing.assert_allclose(unknown.started(each).value, [3.9, -3.9])
    each[1] = 4.1, -1.0
    assert unknown.started(each) is unknown
    each[1] = 1.0, -4.1
    assert unknown.started(each) is unknown
    np.testing.assert_array_equal(unknown.started(each[3:]).value, [0.0, 0.0])
    # (I + T) step = slope - value, and (I + T) inverse is what is left of it.
    np.testing.assert_allclose(unknown.left, np.linalg.inv([[4.0, 1.0], [1.0, 3.0]]))
    step = unknown.step(np.array([0.7, -0.5]))
    np.testing.assert_allclose([[4.0, 1.0], [1.0, 3.0]] @ step, [0.6, -0.7])


@pytest.mark.parametrize("stated", [None, 0.05])
def test_few_matches_count_once_a_group_and_have_a_constant_error_in_common(level: RPC, stated: float | None) -> None:
    """Of 0.002 px along both axes, or more if it is known: parameters change as by a shift of all matches."""
    random = np.random.default_rng(17)
    ground = random.uniform([19.992, -30.008, 300.0], [20.008, -29.992, 700.0], (20, 3))
    plain = level.ground_to_image(ground)
    sigma = random.uniform(0.2, 0.9, 20)
    points = Points.of(plain + random.normal(0, 0.5, (20, 2)), ground, "EPSG:4979", sigma_image=sigma)
    alike: Any = None if stated is None else np.where(np.arange(20) < 9, stated, 1e-4)
    points = dataclasses.replace(points, groups=np.array([*(np.arange(17) // 3), -1, -1, -1]), sigma_alike=alike)
    found = fit(ImageCorrection.identity(level, "affine", ORIGIN), points, robust=False)

    rows = np.column_stack([np.ones(20), plain - ORIGIN]) / sigma[:, None]
    cofactors = np.linalg.inv(rows.T @ rows)
    squares = [np.linalg.lstsq(rows, part, rcond=None)[1][0] for part in ((points.image - plain) / sigma[:, None]).T]
    variance = sum(squares) / (40 - 6)
    # 17 matches in six groups.
    usual = variance * cofactors * 17 / 6
    shift = np.where(np.arange(20) < 17, 0.002, 0.0)
    if stated is not None:
        shift[:9] = stated
    change = np.linalg.lstsq(rows, shift / sigma, rcond=None)[0]
    whole = usual + np.outer(change, change)
    np.testing.assert_allclose(found.covariance[:3, :3], whole, rtol=1e-6)
    np.testing.assert_allclose(found.covariance[3:, 3:], whole, rtol=1e-6)
    np.testing.assert_allclose(found.covariance[:3, 3:], 0.0, atol=1e-12)
    assert found.effective_points == 3 + 6


def test_points_that_a_model_cannot_project_are_named_by_their_role(level: RPC) -> None:
    """Without a height a point has no place in the image; one that is left out by name needs no further word."""
    points = fitted(level).points

    def noted(without: list[int], **options: Any) -> dict[str, list[str]]:
        ground = points.ground.copy()
        ground[without, 2] = np.nan
        found = fit(ImageCorrection.identity(level, "shift", ORIGIN), points.with_ground(ground), **options)
        return {one.fields["role"]: one.fields["points"] for one in found.warnings if one.code == "no-projection"}

    ids = points.ids
    assert noted([]) == {}
    assert noted([2, 5]) == {"control": [ids[2], ids[5]]}
    assert noted([10]) == {"check": [ids[10]]}
    assert noted([2, 10, 11]) == {"control": [ids[2]], "check": [ids[10], ids[11]]}
    assert noted([2, 5, 10], exclude={ids[2]: "moved"}) == {"control": [ids[5]], "check": [ids[10]]}


def test_an_unknown_figure_is_refused_and_not_taken_for_that_of_the_check_points(sample) -> None:
    points = read_points(sample / "gcps.geojson")
    result = fit(ImageCorrection.identity(read_rpc(sample / "scene_RPC.TXT"), "shift", (500.0, 500.0)), points)
    assert result.rmse("check").n == 6
    for name in ("Control", "leave-one-out", None):
        with pytest.raises(InputError, match="no RMSE of"):
            result.rmse(name)


def test_a_check_point_without_an_image_position_has_no_residual(sample) -> None:
    points = read_points(sample / "gcps.geojson")
    image = points.image.copy()
    image[np.flatnonzero(points.check)[0]] = np.nan
    model = ImageCorrection.identity(read_rpc(sample / "scene_RPC.TXT"), "shift", (500.0, 500.0))
    result = fit(model, dataclasses.replace(points, image=image))
    assert result.rmse("check").n == 5
    assert not result.outlying
    np.testing.assert_allclose(result.values, fit(model, points).values)
