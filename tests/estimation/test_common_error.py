"""An error that many points have in common: against dense generalised least squares, and scenes drawn with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyproj
import pytest

from ortho_pipeline.commands.scene_fit import relative_to_reference
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.estimation.fit import Fit, Prior, fit
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.options import MatchOptions
from ortho_pipeline.points import Points

SIZE = 10_000.0
#: Pixels per metre that ground east and north moves in the image.
PLAN = np.array([[1.0, 0.1], [0.2, -1.0]])


@pytest.fixture(scope="module")
def rpc() -> RPC:
    """A scene of 1 m pixels, turned a little, seen at an angle."""
    ground = metres_per_degree(np.array([[20.0, -30.0, 500.0]]))[0] * 0.05
    one, col, row = np.eye(20)[0], np.zeros(20), np.zeros(20)
    # Terms 1, 2, 3 of an RPC are longitude, latitude and height, in units of half the scene.
    col[[1, 2, 3]], row[[1, 2, 3]] = (*PLAN[0] * ground / (SIZE / 2), 0.01), (*PLAN[1] * ground / (SIZE / 2), 0.02)
    half = SIZE / 2
    return RPC(half, half, 20.0, -30.0, 500.0, half, half, 0.05, 0.05, 300.0, col, one, row, one)


def scene(
    rpc: RPC, random: np.random.Generator, matched: int, surveyed: int, *, sigma: float, off: np.ndarray,
    noise: float = 0.3, stated: float = 0.3,
) -> Points:  # fmt: skip
    """Return matches whose reference lies `off` (m east and north), and surveyed points; the model is right."""
    count = matched + surveyed
    ground = np.column_stack([random.uniform(-1, 1, (count, 2)) * 0.05 + (20, -30), random.uniform(300, 700, count)])
    image = rpc.ground_to_image(ground) + random.normal(0, noise, (count, 2))
    said = ground.copy()
    said[:matched, :2] += off / metres_per_degree(ground[:matched])
    common = np.r_[np.full(matched, sigma), np.zeros(surveyed)]
    return Points(
        ids=tuple(map(str, range(count))), image=image, ground=said, roles=np.full(count, "control"),
        sigma_image=np.full(count, stated), sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS(4326), source="",
        groups=np.r_[np.arange(matched) // 4, np.full(surveyed, -1)], sigma_common=common,
    )  # fmt: skip


def adjusted(rpc: RPC, points: Points, kind: str = "shift", **options: object) -> Fit:
    return fit(ImageCorrection.identity(rpc, kind, (SIZE / 2, SIZE / 2)), points, **options)


def test_no_number_of_points_makes_it_less(rpc: RPC) -> None:
    """A reference of 2 m leaves 2 m times d(image)/d(ground) in the shift, whether 40 or 600 points were matched."""
    expected = np.hypot(*PLAN.T) * 2.0
    for count, noise in ((40, 0.3), (600, 0.3), (600, 0.02)):
        points = scene(rpc, np.random.default_rng(1), count, 0, sigma=2.0, off=np.zeros(2), noise=noise)
        found = adjusted(rpc, points)
        alone = adjusted(rpc, replace(points, sigma_common=None))
        np.testing.assert_array_equal(found.values, alone.values)
        assert found.sigma0 == alone.sigma0
        np.testing.assert_allclose(found.relative_covariance, alone.covariance, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.covariance - alone.covariance, PLAN @ PLAN.T * 4.0, rtol=0.01)
        np.testing.assert_allclose(found.sigmas, np.hypot(expected, alone.sigmas), rtol=0.01)
        # What the points say of the model, they say relative to their reference.
        np.testing.assert_allclose(found.student, alone.student, rtol=1e-6)


def test_of_common_errors_of_two_sizes_the_larger_is_published_and_the_mean_moves_a_shift(rpc: RPC) -> None:
    points = scene(rpc, np.random.default_rng(1), 40, 0, sigma=2.0, off=np.zeros(2))
    sizes = np.where(np.arange(40) < 20, 0.4, 0.8)
    found = adjusted(rpc, replace(points, sigma_common=sizes))
    assert found.common_error is not None
    assert found.to_json()["statistics"]["common_error"]["sigma_m"] == 0.8
    np.testing.assert_allclose(found.common_error.covariance, PLAN @ PLAN.T * 0.6**2, rtol=0.01)
    # Nothing takes it up in a model without parameters.
    assert adjusted(rpc, replace(points, sigma_common=sizes), "none").common_error is None


@pytest.mark.parametrize("kind", ["shift", "affine"])
@pytest.mark.parametrize("surveyed", [0, pytest.param(6, marks=pytest.mark.slow)])
def test_sigmas_cover_where_the_reference_lies_anywhere(rpc: RPC, kind: str, surveyed: int) -> None:
    """Spread of (estimate - truth) / sigma of the shifts over references drawn by their sigma.

    Sixty draws of two axes know a spread to 6.5 %; the sigmas of the matches themselves are half of what they should
    be, which sigma0 finds out, and may not scale the reference's by.
    """
    random = np.random.default_rng(7 + surveyed)
    found = []
    for _ in range(60):
        off = random.normal(0, 2.0, 2)
        points = scene(rpc, random, 40, surveyed, sigma=2.0, off=off, noise=0.3, stated=0.15)
        fitted = adjusted(rpc, points, kind, robust=False)
        shift = [fitted.param_names.index(name) for name in ("col_shift", "row_shift")]
        found.append((fitted.values / fitted.sigmas)[shift])
    assert 0.85 < np.sqrt(np.square(found).mean()) < 1.15


def dense(rpc: RPC, points: Points, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return estimate and covariance by the whole weight matrix, and sigma0 of 1."""
    start = ImageCorrection.identity(rpc, kind, (SIZE / 2, SIZE / 2))
    design = start.param_partials(points.ground).reshape(2 * len(points), -1)
    observed = (points.image - rpc.ground_to_image(points.ground)).ravel()
    moved = (PLAN[None] * points.sigma_common[:, None, None]).reshape(-1, 2)
    weight = np.linalg.inv(np.diag(np.repeat(points.sigma_image**2, 2)) + moved @ moved.T)
    covariance = np.linalg.inv(design.T @ weight @ design)
    return covariance @ design.T @ weight @ observed, covariance


@pytest.mark.parametrize(("kind", "sigma"), [("shift", 2.0), ("shift", 0.8), ("shift-drift", 2.0), ("affine", 2.0)])
def test_points_without_it_correct_it_as_generalised_least_squares_does(rpc: RPC, kind: str, sigma: float) -> None:
    off = np.array([1.25, -0.75]) * sigma
    points = scene(rpc, np.random.default_rng(3), 50, 5, sigma=sigma, off=off)
    points = replace(points, groups=None)
    found = adjusted(rpc, points, kind)
    values, covariance = dense(rpc, points, kind)
    np.testing.assert_allclose(found.values, values, atol=0.02 * np.sqrt(np.diag(covariance)).max())
    # The parts that sigma0 scales and that it does not: with sigma0 = 1 the sum is that of all.
    whole = found.relative_covariance / found.sigma0**2 + found.common_error.covariance
    size = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(whole / size / size[:, None], covariance / size / size[:, None], atol=0.02)
    said = found.to_json()["statistics"]["common_error"]
    assert said["points"] == 50
    assert said["sigma_m"] == sigma
    np.testing.assert_allclose(said["estimate_m"], off, atol=3 * max(said["estimate_sigma_m"]))
    assert max(said["estimate_sigma_m"]) < 0.3
    # The common error explains the 3 m, so the residuals are small.
    assert found.rmse("control").total < 0.6


@pytest.mark.parametrize(("kind", "surveyed"), [("shift", 4), ("shift", 1), ("affine", 4)])
def test_leaving_out_a_point_is_a_fit_without_it(rpc: RPC, kind: str, surveyed: int) -> None:
    """A surveyed point corrects the reference: without it the others predict it with an error that is less corrected.

    Matches of a group are left out together.
    """
    points = scene(rpc, np.random.default_rng(3), 16, surveyed, sigma=2.0, off=np.array([2.5, -1.5]))
    found = adjusted(rpc, points, kind, robust=False)
    for k in (0, 7, 16, 15 + surveyed):
        left = points.groups == points.groups[k] if points.groups[k] >= 0 else np.arange(len(points)) == k
        others = adjusted(rpc, points.select(~left), kind, robust=False)
        alone = points.select([k])
        predicted = others.model.ground_to_image(alone.ground) + others.common_error.offset(others.model, alone)
        np.testing.assert_allclose(found.loo_residuals[k], (alone.image - predicted)[0], atol=2e-3)


def test_few_surveyed_points_are_no_gross_errors_beside_many_matches(rpc: RPC) -> None:
    """Of 300 matches whose reference is off by 1.5 sigmas, four surveyed points, and one that is really wrong."""
    points = scene(rpc, np.random.default_rng(5), 300, 5, sigma=4.0, off=np.array([5.0, 3.0]))
    image = points.image.copy()
    image[-1] += (9.0, 0.0)
    found = adjusted(rpc, replace(points, image=image))
    assert [name for name, _ in found.rejected] == ["304"]
    assert np.abs(found.values).max() < 0.6
    without = adjusted(rpc, replace(points, image=image, sigma_common=None))
    assert len(without.rejected) == 5


def test_what_is_known_of_the_model_tells_of_it(rpc: RPC) -> None:
    """A model that is known to 0.1 px beforehand is not moved by a reference of 5 m, and says where that lies."""
    points = scene(rpc, np.random.default_rng(9), 80, 0, sigma=5.0, off=np.array([4.0, -6.0]))
    names = ("col_shift", "row_shift")
    found = adjusted(rpc, points, priors={name: Prior(0.0, 0.1) for name in names})
    assert np.abs(found.values).max() < 0.15
    np.testing.assert_allclose(found.common_error.value * 5.0, (4.0, -6.0), atol=0.4)
    assert (found.sigmas < 0.11).all()


def test_surveyed_check_points_may_lie_off_by_it(rpc: RPC) -> None:
    """An error that was stated is no contradiction, and one that all of them show is the reference's.

    Two cannot tell which of them, or the reference, is wrong; of four the one that contradicts the others is named.
    """
    points = scene(rpc, np.random.default_rng(6), 80, 4, sigma=4.0, off=np.array([4.0, -2.0]))
    points = points.with_roles(np.where(points.groups < 0, "check", "control"))
    assert not adjusted(rpc, points).outlying
    unstated = replace(points, sigma_common=None)
    assert not adjusted(rpc, unstated).outlying
    assert len(adjusted(rpc, unstated.select(np.arange(82))).outlying) == 2
    image = unstated.image.copy()
    image[81] += (5.0, 0.0)
    assert [one.id for one in adjusted(rpc, replace(unstated, image=image)).outlying] == ["81"]


def test_check_points_tell_a_displaced_reference_by_the_accuracy_of_their_mean(rpc: RPC) -> None:
    """36 points of 0.3 m place it to 0.05 m: 0.35 m is told, though less than one of them may err; nothing is not."""

    def noted(off: float, seed: int) -> list[Notice]:
        points = scene(rpc, np.random.default_rng(seed), 200, 36, sigma=0.0, off=np.array([off, 0.0]))
        roles = np.where(np.arange(236) < 200, "control", "check")
        notices = relative_to_reference(adjusted(rpc, replace(points, roles=roles)), MatchOptions())
        return [one for one in notices if one.code == "reference-displaced"]

    for seed in range(10):
        (notice,) = noted(0.35, seed)
        np.testing.assert_allclose(notice.fields["reference_off_m"], (0.35, 0.0), atol=4 * 0.06)
        assert noted(0.0, seed) == []
