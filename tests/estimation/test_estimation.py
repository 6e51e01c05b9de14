"""Adjustment: truth that the estimator never sees, refits as the authority for leave-one-out, and the traps."""

from __future__ import annotations

import dataclasses
import math
import tracemalloc

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import DegeneratePoints, InputError, TooFewPoints
from ortho_pipeline.estimation.fit import Prior, fit
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.models.base import Constraints
from ortho_pipeline.points import Points

TRUTH = {
    "shift": [3.0, 0, 0, -2.0, 0, 0],
    "shift-drift": [3.0, 0, 1e-3, -2.0, 0, -2e-3],
    "affine": [3.0, 2e-3, 1e-3, -2.0, -1e-3, -2e-3],
}


@pytest.fixture(scope="module")
def rpc() -> RPC:
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[[1, 3, 7]], row[[2, 3, 8]] = (1.0, 0.05, 2e-3), (-1.0, 0.02, 1e-3)
    return RPC(500.0, 400.0, 20.0, -30.0, 500.0, 500.0, 400.0, 0.01, 0.0065, 300.0, col, one, row, one)


def make_points(rpc, kind="shift", count=12, noise=0.3, seed=0, **changes) -> Points:
    """Points whose image coordinates follow the true correction, with noise; sigma is stated as 1 px."""
    random = np.random.default_rng(seed)
    centre, half = rpc.domain
    ground = centre + 0.9 * half * random.uniform(-1, 1, (count, 3))
    true = ImageCorrection(rpc, kind, (500, 400), TRUTH[kind])
    image = true.ground_to_image(ground) + random.normal(0, 1, (count, 2)) * noise
    fields = {
        "ids": tuple(f"p{i}" for i in range(count)), "image": image, "ground": ground,
        "roles": np.full(count, "control"), "sigma_image": np.ones(count), "sigma_ground": np.zeros((count, 3)),
        "crs": pyproj.CRS.from_epsg(4326), "source": "simulated",
    }  # fmt: skip
    return Points(**{**fields, **changes})


def start(rpc, kind="shift") -> ImageCorrection:
    return ImageCorrection.identity(rpc, kind, (500, 400))


@pytest.mark.parametrize("kind", list(TRUTH))
def test_noise_free_points_give_the_truth(rpc, kind):
    found = fit(start(rpc, kind), make_points(rpc, kind, noise=0.0))
    np.testing.assert_allclose(found.model.coefficients, TRUTH[kind], atol=1e-9)
    assert np.abs(found.residuals).max() < 1e-8
    assert found.rejected == ()


@pytest.mark.parametrize(
    ("kind", "repeats"), [("affine", 100), *(pytest.param(kind, 1000, marks=pytest.mark.slow) for kind in TRUTH)]
)
def test_claimed_sigmas_are_honest(rpc, kind, repeats):
    """Over many repeats (estimate - truth) / sigma has mean 0 and spread 1.

    With r redundant observations sigma0 is estimated, so the ratio follows Student's t: spread sqrt(r / (r - 2)).
    """
    truth = np.array(TRUTH[kind])[start(rpc, kind)._free]
    ratios = []
    for seed in range(repeats):
        found = fit(start(rpc, kind), make_points(rpc, kind, count=20, seed=seed), robust=False)
        ratios.append((found.values - truth) / found.sigmas)
    redundancy = 40 - len(truth)
    spread = np.std(ratios, axis=0) / np.sqrt(redundancy / (redundancy - 2))
    # Within three standard errors.
    assert (np.abs(spread - 1) < 3 / np.sqrt(2 * repeats)).all(), spread
    assert (np.abs(np.mean(ratios, axis=0)) < 3.5 / np.sqrt(repeats)).all()


def test_sigma0_is_the_noise_and_redundancy_is_counted(rpc):
    found = fit(start(rpc, "affine"), make_points(rpc, "affine", count=400, noise=0.3))
    assert found.redundancy == 800 - 6
    # The standard error of sigma0 is sigma0 / sqrt(2 r) = 0.0075.
    assert found.sigma0 == pytest.approx(0.3, abs=0.03)


@pytest.mark.parametrize("kind", list(TRUTH))
def test_leave_one_out_is_what_refits_give(rpc, kind):
    points = make_points(rpc, kind, count=9)
    found = fit(start(rpc, kind), points, robust=False)
    for i in range(len(points)):
        without = points.select(np.arange(len(points)) != i)
        refit = fit(start(rpc, kind), without, robust=False)
        expected = points.image[i] - refit.model.ground_to_image(points.ground[i : i + 1])[0]
        np.testing.assert_allclose(found.loo_residuals[i], expected, atol=1e-8)
    assert found.rmse("loo").total > found.rmse("control").total


def test_check_points_take_no_part(rpc):
    points = make_points(rpc, count=12)
    roles = np.array(["check" if i % 3 == 0 else "control" for i in range(12)])
    spoiled = points.image + 100.0 * (roles == "check")[:, None]
    first = fit(start(rpc), points.with_roles(roles))
    second = fit(start(rpc), make_points(rpc, count=12, roles=roles, image=spoiled))
    np.testing.assert_array_equal(first.values, second.values)
    assert first.rmse("check").n == 4
    assert second.rmse("check").total > 100
    assert np.isnan(first.loo_residuals[roles == "check"]).all()


def test_order_of_points_does_not_matter(rpc):
    points = make_points(rpc, "affine")
    order = np.random.default_rng(1).permutation(len(points))
    np.testing.assert_allclose(
        fit(start(rpc, "affine"), points).values, fit(start(rpc, "affine"), points.select(order)).values, atol=1e-10
    )


def test_shifting_the_image_shifts_the_correction(rpc):
    points = make_points(rpc)
    moved = make_points(rpc, image=points.image + np.array([7.0, -5.0]))
    np.testing.assert_allclose(fit(start(rpc), moved).values - fit(start(rpc), points).values, [7.0, -5.0], atol=1e-10)


def test_weights_follow_the_stated_sigmas(rpc):
    points = make_points(rpc, noise=0.0)
    image = points.image.copy()
    image[0] += 3.0
    sigma = np.ones(12)
    sigma[0] = 10.0
    found = fit(start(rpc), make_points(rpc, noise=0.0, image=image, sigma_image=sigma), robust=False)
    # Weighted mean of eleven zeros of weight 1 and one 3 of weight 1/100.
    assert found.values[0] - 3.0 == pytest.approx(3.0 * 0.01 / 11.01, abs=1e-9)


def test_errors_of_the_ground_count_in_metres(rpc):
    """One metre is 1 / 96486 of a degree of longitude here: the sigma in pixels follows from the model's slopes."""
    sigma = np.zeros((12, 3))
    sigma[0, 0] = 50.0
    points = make_points(rpc, noise=0.0, sigma_ground=sigma)
    image = points.image.copy()
    image[0, 0] += 3.0
    found = fit(start(rpc), make_points(rpc, noise=0.0, image=image, sigma_ground=sigma), robust=False)
    px_per_metre = rpc.ground_partials(points.ground[:1])[0, 0, 0] / 96_486
    weight = 1 / (1 + (50 * px_per_metre) ** 2)
    assert found.values[0] - 3.0 == pytest.approx(3.0 * weight / (11 + weight), rel=1e-3)


def test_priors_are_observations(rpc):
    points = make_points(rpc, count=4)
    free = fit(start(rpc), points, robust=False)
    tight = fit(start(rpc), points, priors={"col_shift": Prior(0.0, 1e-6)}, robust=False)
    assert abs(tight.values[0]) < 1e-9
    assert tight.values[1] == pytest.approx(free.values[1], abs=1e-9)


@pytest.mark.parametrize("noise", [0.2, 1.0, 3.0])
def test_a_prior_keeps_its_sigma_whatever_the_points_show(rpc, noise):
    """Four points of a stated sigma of 1 are as good as their residuals say; the prior is as good as stated."""
    points = make_points(rpc, count=4, noise=noise)
    free = fit(start(rpc), points, robust=False)
    mean = free.values[0] - 0.3
    found = fit(start(rpc), points, priors={"col_shift": Prior(mean, 0.5)}, robust=False)
    weights = np.array([4 / found.sigma0**2, 0.5**-2])
    assert found.values[0] == pytest.approx(weights @ [free.values[0], mean] / weights.sum(), abs=2e-3 * 0.3)
    assert found.sigmas[0] == pytest.approx(weights.sum() ** -0.5, rel=2e-3)
    assert found.sigmas[1] == pytest.approx(found.sigma0 / 2, rel=2e-3)
    # The prior has a part of the column shift: the points have that much more redundancy.
    freedom = free.degrees_of_freedom + weights[1] / weights.sum()
    assert found.degrees_of_freedom == pytest.approx(freedom, abs=2e-3)
    squares = (found.residuals[found.used] ** 2).sum()
    assert found.sigma0 == pytest.approx(math.sqrt(squares / freedom), rel=2e-3)


def test_with_few_points_and_priors_stated_sigmas_hold(rpc):
    """Two points of three that nearly agree by chance would otherwise outweigh any prior."""
    points = make_points(rpc, "affine", count=3, noise=0.3)
    known = {name: Prior(0.0, 9.0) for name in start(rpc, "affine").param_names}
    found = fit(start(rpc, "affine"), points, priors=known, robust=False)
    assert found.sigma0 is None
    partials = found.model.param_partials(found.points.ground)
    information = np.einsum("nip,niq->pq", partials, partials) + np.eye(6) / 81
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information), rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("sigma", [0.05, 0.5, 20.0])
def test_constraints_of_a_model_are_observations(rpc, sigma):
    """A shift that was observed as well is the mean of both, by their weights, also with a soft constraint."""

    class Observed(ImageCorrection):
        def constraints(self) -> Constraints:
            fictitious = np.array([False, True])
            return Constraints((1.0, 0.0) - self.params, np.eye(2), np.array([sigma, 1e9]), fictitious)

    points = make_points(rpc, count=4, noise=0.5)
    free = fit(start(rpc), points, robust=False)
    found = fit(Observed(rpc, "shift", (500, 400), start(rpc).coefficients), points, robust=False)
    weights = np.array([4 / found.sigma0**2, sigma**-2])
    assert found.values[0] == pytest.approx(weights @ [free.values[0], 1.0] / weights.sum(), rel=2e-3)
    assert found.values[1] == pytest.approx(free.values[1], abs=1e-9)
    assert found.degrees_of_freedom == pytest.approx(free.degrees_of_freedom + weights[1] / weights.sum(), abs=2e-3)


def test_a_prior_for_nothing_is_refused(rpc):
    with pytest.raises(InputError, match="col_shfit"):
        fit(start(rpc), make_points(rpc), priors={"col_shfit": Prior(0, 1)})
    with pytest.raises(InputError):
        Prior(0.0, 0.0)


# -- gross errors ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "count"), [("shift", 5), ("shift", 12), ("shift-drift", 9), ("affine", 12)])
def test_a_gross_error_is_found_and_named(rpc, kind, count):
    points = make_points(rpc, kind, count=count, noise=0.1)
    for bad in range(count):
        image = points.image.copy()
        image[bad] += (140.0, -140.0)
        found = fit(start(rpc, kind), make_points(rpc, kind, count=count, noise=0.1, image=image))
        assert [name for name, _ in found.rejected] == [f"p{bad}"]
        # 140 px in both axes are 198 px; the noise adds less than one.
        assert 197 < float(found.rejected[0][1].removeprefix("gross error: ").split()[0]) < 199
        others = fit(start(rpc, kind), points.select(np.arange(count) != bad), robust=False)
        np.testing.assert_allclose(found.values, others.values, atol=1e-9)
        assert not found.used[bad]


def test_gross_errors_that_agree_with_each_other_are_found(rpc):
    points = make_points(rpc, count=20, noise=0.1)
    image = points.image.copy()
    image[:5] += (30.0, 10.0)
    found = fit(start(rpc), make_points(rpc, count=20, noise=0.1, image=image))
    assert [name for name, _ in found.rejected] == [f"p{i}" for i in range(5)]


def test_more_than_a_third_is_never_rejected(rpc):
    points = make_points(rpc, count=10, noise=0.1)
    image = points.image.copy()
    image[:4] += np.array([[50.0, 0], [-70, 20], [10, 90], [-30, -60]])
    with pytest.raises(DegeneratePoints, match="p0, p1, p2, p3"):
        fit(start(rpc), make_points(rpc, count=10, noise=0.1, image=image))


@pytest.mark.parametrize("sets", [50, pytest.param(300, marks=pytest.mark.slow)])
def test_good_points_are_kept(rpc, sets):
    """A clean set may lose a point with a chance of 0.1 %: hardly ever among a few hundred."""
    lost = 0
    for seed in range(sets):
        kind = list(TRUTH)[seed % 3]
        lost += len(fit(start(rpc, kind), make_points(rpc, kind, count=8 + seed % 7, seed=seed)).rejected)
    assert lost <= sets // 100


# -- too little ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "count"), [("shift", 0), ("shift-drift", 1), ("affine", 2)])
def test_too_few_points(rpc, kind, count):
    with pytest.raises(TooFewPoints) as caught:
        fit(start(rpc, kind), make_points(rpc, kind, count=count))
    assert "at least" in caught.value.remedy
    # Nothing is simpler than a shift.
    assert ("a simpler correction, such as" in caught.value.remedy) == (kind != "shift")


def test_memory_of_fitting_many_points_is_bounded(rpc):
    # The residuals of all minimal subsets at once took 20 kB for each point: 5.8 GB for 300,000.
    count = 8_000
    points = make_points(rpc, count=count)
    tracemalloc.start()
    try:
        adjusted = fit(start(rpc), points)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert adjusted.values == pytest.approx([3.0, -2.0], abs=5 * 0.3 / np.sqrt(count))
    assert peak < 80e6


def test_no_redundancy_is_reported_and_has_no_sigma0(rpc):
    found = fit(start(rpc), make_points(rpc, count=1))
    assert found.redundancy == 0
    assert found.sigma0 is None
    assert found.rmse("loo") is None
    np.testing.assert_allclose(found.sigmas, [1.0, 1.0])  # the stated sigma of the point, nothing better


def test_points_on_a_line_do_not_determine_an_affine(rpc):
    points = make_points(rpc, count=8)
    along = np.linspace(-0.5, 0.5, 8)[:, None]
    centre, half = rpc.domain
    ground = centre + half * [1, 1, 0] * along
    true = ImageCorrection(rpc, "affine", (500, 400), TRUTH["affine"])
    with pytest.raises(DegeneratePoints, match="do not determine"):
        fit(start(rpc, "affine"), make_points(rpc, count=8, ground=ground, image=true.ground_to_image(ground)))
    assert fit(start(rpc), points).redundancy == 14


def test_the_same_point_many_times_does_not_determine_a_drift(rpc):
    ground = np.tile(rpc.domain[0], (6, 1))
    image = np.tile(rpc.ground_to_image(ground[:1]), (6, 1)) + np.random.default_rng(0).normal(0, 0.3, (6, 2))
    with pytest.raises(DegeneratePoints, match="condition"):
        fit(start(rpc, "shift-drift"), make_points(rpc, count=6, ground=ground, image=image))


def test_points_without_a_projection_are_left_out_and_said(rpc):
    points = make_points(rpc)
    ground = points.ground.copy()
    ground[3, 2] = np.nan
    ground[5, 0] += 90.0
    found = fit(start(rpc), make_points(rpc, ground=ground))
    assert "p3, p5" in found.warnings[0]
    assert found.used.sum() == 10


def test_check_points_without_a_projection_are_not_counted_and_said(rpc):
    points = make_points(rpc)
    ground = points.ground.copy()
    ground[3, 0] += 90.0
    roles = np.array(["check" if i < 5 else "control" for i in range(12)])
    found = fit(start(rpc), make_points(rpc, ground=ground, roles=roles))
    assert found.rmse("check").n == 4
    assert "cannot project these check points" in found.warnings[0]


def test_points_known_to_be_wrong_are_left_out_and_listed(rpc):
    points = make_points(rpc)
    found = fit(start(rpc), points, exclude={"p4": "wrong crossroads"})
    assert found.rejected == (("p4", "wrong crossroads"),)
    others = fit(start(rpc), points.select(np.arange(12) != 4))
    np.testing.assert_allclose(found.values, others.values, atol=1e-12)


def test_a_model_without_parameters_is_evaluated(rpc):
    points = make_points(rpc, noise=0.0)
    found = fit(start(rpc, "none"), points)
    np.testing.assert_allclose(found.residuals, np.tile([3.0, -2.0], (12, 1)), atol=1e-9)
    assert found.redundancy == 24
    assert found.raw_bias.col == pytest.approx(3.0)


def test_document(rpc):
    found = fit(start(rpc), make_points(rpc, count=5), name="rpc+shift").to_json()
    assert found["model"] == "rpc+shift"
    assert set(found["parameters"]) == {"col_shift", "row_shift"}
    assert set(found["points"][0]) == {"id", "role", "used", "image", "predicted", "residual", "loo_residual"}
    assert set(found["rmse"]["loo"]) == {"col", "row", "total", "n"}
    assert found["rmse"]["check"] is None


def test_points_none_of_which_has_an_image_are_an_error(rpc):
    """Two warnings and nothing else looked like a fit."""
    points = make_points(rpc)
    away = points.with_ground(points.ground + np.array([40.0, 0.0, 0.0]))
    for kind in ("none", "shift"):
        with pytest.raises(
            InputError, match=r"simulated: the model .* projects none of the points \(12\)(.|\n)*check CRS"
        ):
            fit(start(rpc, kind), away)


# -- points that are tested and stay ---------------------------------------------------------------------------------


def with_roles(points: Points, checks: int) -> Points:
    roles = points.roles.copy()
    roles[-checks:] = "check"
    return points.with_roles(roles)


def moved(points: Points, name: str, by: tuple[float, float]) -> Points:
    image = points.image.copy()
    image[points.ids.index(name)] += by
    return dataclasses.replace(points, image=image)


@pytest.mark.parametrize("checks", [1, 6, 20])
def test_a_wrong_check_point_is_named_and_counts(rpc, checks):
    good = with_roles(make_points(rpc, count=12 + checks), checks)
    found = fit(start(rpc), moved(good, "p12", (7.0, 0.0)))
    assert [(one.id, one.role) for one in found.outlying] == [("p12", "check")]
    assert found.outlying[0].distance == pytest.approx(7.0, abs=1.5)
    # As accurate as a point and the mean of twelve: 0.3 px in both axes.
    assert found.outlying[0].expected == pytest.approx(0.3 * np.sqrt(2) * np.sqrt(13 / 12), rel=0.5)
    assert found.rmse("check").n == checks
    assert found.rmse("check").total >= 6 / np.sqrt(checks)
    rest = found.rmse("agreeing")
    assert rest is None if checks == 1 else (rest.n == checks - 1 and rest.total < 0.7)
    assert found.to_json()["outlying"][0]["id"] == "p12"
    # Alone it decides what the RMSE is: no accuracy is to be told by it. One of twelve that is off by little is not so.
    (notice,) = [one for one in found.warnings if one.code == "checks-apart"]
    assert (notice.fields["off"], notice.fields["count"], notice.fields["points"]) == (1, checks, ["p12"])
    assert notice.fields["rmse"] == pytest.approx(found.rmse("check").total)
    if rest is not None:
        assert f"{rest.total:.2g} px without it" in notice
        assert notice.endswith("expected from the control points. The other check points agree with the control points")
        near = fit(start(rpc), moved(good, "p12", (2.2, 0.0)))
        assert near.rmse("check").total < 2 * (near.rmse("agreeing") or near.rmse("check")).total or checks < 12
        assert checks < 12 or not [one for one in near.warnings if one.code == "checks-apart"]


def test_a_model_that_is_poor_everywhere_makes_no_check_point_wrong(rpc):
    # Control in one corner under a drift that the shift does not follow: check points are far off together.
    points = make_points(rpc, "affine", count=40, noise=0.1)
    near = np.argsort(np.hypot(*points.image.T))
    roles = np.full(40, "check", dtype="<U7")
    roles[near[:8]] = "control"
    found = fit(start(rpc), points.with_roles(roles))
    assert found.rmse("check").total > 3 * found.rmse("control").total
    assert not [one for one in found.outlying if one.role == "check"]
    (notice,) = [one for one in found.warnings if one.code == "checks-apart"]
    assert notice.fields["rmse"] == pytest.approx(found.rmse("check").total)
    assert "(worst: " in notice


def test_several_wrong_check_points_that_hide_each_other_are_told(rpc):
    # Three of six: their median is no scale to find any of them by.
    points = with_roles(make_points(rpc, count=18), 6)
    wrong = points
    for name, by in (("p12", (14.0, 0.0)), ("p13", (0.0, -9.0)), ("p14", (0.0, 6.0))):
        wrong = moved(wrong, name, by)
    found = fit(start(rpc), wrong)
    (notice,) = [one for one in found.warnings if one.code == "checks-apart"]
    assert notice.fields["count"] == 6 - len(found.outlying)
    # As accurate as a point and the mean of twelve: 0.3 px in both axes.
    assert notice.fields["expected"] == pytest.approx(0.3 * np.sqrt(2) * np.sqrt(13 / 12), rel=0.5)
    assert notice.fields["rmse"] > 5
    assert (notice.fields["off"], notice.fields["points"]) == (3, ["p12", "p13", "p14"])
    # Three are far off, and not all six; of how many it is told by numbers.
    assert notice.startswith(
        f"3 of {notice.fields['count']} check points contradict the control points (p12, p13, p14)"
    )
    assert "expected from the control points" in notice
    # They are off to different sides, and not beyond control; all by the same, and far outside, is told as such.
    assert (notice.fields["alike"], notice.fields["beyond_control"]) == (False, 0)
    alike = points
    for name in ("p12", "p13", "p14"):
        alike = moved(alike, name, (9.0, -5.0))
    (notice,) = [one for one in fit(start(rpc), alike).warnings if one.code == "checks-apart"]
    assert notice.fields["alike"]
    # Three check points a long way outside of control that lies in one corner.
    near = np.argsort(np.hypot(*points.image.T))
    roles = np.full(18, "check", dtype="<U7")
    roles[near[:12]] = "control"
    far = wrong = points.with_roles(roles)
    for index in near[-3:]:
        wrong = moved(wrong, far.ids[index], (9.0, -5.0))
    (notice,) = [one for one in fit(start(rpc), wrong).warnings if one.code == "checks-apart"]
    assert notice.fields["beyond_control"] > 0


@pytest.mark.parametrize("checks", [1, 3, 12])
def test_good_check_points_are_not_told_to_be_apart(rpc, checks):
    for seed in range(20):
        found = fit(start(rpc), with_roles(make_points(rpc, count=12 + checks, seed=seed), checks))
        assert not [one for one in found.warnings if one.code == "checks-apart"]


def test_an_outlying_control_point_that_stays_is_named_with_its_leverage(rpc):
    # A chance of 1 in 10,000 for one of forty: below 1 % of all sets, above the 0.1 % at which points are left out.
    points = make_points(rpc, count=40, noise=0.3, seed=1)
    rest = fit(start(rpc), points.select(np.arange(40) != 7))
    image = points.image.copy()
    image[7] = rest.model.ground_to_image(points.ground[7:8])[0] + (rest.sigma0 * np.sqrt(2 * np.log(1e4)) * 1.05, 0.0)
    found = fit(start(rpc), dataclasses.replace(points, image=image))
    assert found.used.all()
    (one,) = found.outlying
    assert (one.id, one.role) == ("p7", "control")
    assert one.leverage == pytest.approx(1 / 40)
    assert one.distance == pytest.approx(np.hypot(*found.loo_residuals[7]))


# One in a hundred sets, for control and for check points. More than so many have a chance of 0.0005.
@pytest.mark.parametrize(("sets", "most"), [(60, 4), pytest.param(600, 16, marks=pytest.mark.slow)])
def test_good_sets_rarely_have_an_outlying_point(rpc, sets, most):
    named = {"control": 0, "check": 0}
    for seed in range(sets):
        points = with_roles(make_points(rpc, count=8 + seed % 20, seed=seed), 3 + seed % 4)
        roles = {one.role for one in fit(start(rpc), points).outlying}
        for role in roles:
            named[role] += 1
    assert max(named.values()) <= most, named


def test_without_redundancy_no_point_is_called_wrong(rpc):
    points = with_roles(make_points(rpc, count=3), 2)
    assert fit(start(rpc), moved(points, "p1", (50.0, 0.0))).outlying == ()
