"""Points weighted by 2 x 2 covariances: against dense generalised least squares, refits, and simulated repeats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyproj
import pytest

from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.estimation.problem import Problem
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.points import Points

ORIGIN = (500.0, 400.0)


@pytest.fixture(scope="module")
def rpc() -> RPC:
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[[1, 3, 7]], row[[2, 3, 8]] = (1.0, 0.05, 2e-3), (-1.0, 0.02, 1e-3)
    return RPC(500.0, 400.0, 20.0, -30.0, 500.0, 500.0, 400.0, 0.01, 0.0065, 300.0, col, one, row, one)


def ellipses(random: np.random.Generator, count: int) -> np.ndarray:
    """Return covariances whose axes differ up to tenfold, in all directions."""
    angle = random.uniform(0, np.pi, count)
    axes = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], axis=-1).reshape(count, 2, 2)
    squares = np.stack([random.uniform(0.5, 2, count), random.uniform(0.05, 0.2, count)], axis=-1) ** 2
    return axes.transpose(0, 2, 1) @ (squares[:, :, None] * axes)


def measured(rpc: RPC, kind: str, count: int, seed: int, **changes: object) -> Points:
    """Return points with the errors that their covariances state, about a correction that is zero."""
    random = np.random.default_rng([seed, count])
    centre, half = rpc.domain
    ground = centre + 0.9 * half * random.uniform(-1, 1, (count, 3))
    covariance = ellipses(random, count)
    errors = (np.linalg.cholesky(covariance) @ random.normal(0, 1, (count, 2, 1)))[:, :, 0]
    points = Points(
        ids=tuple(f"p{k}" for k in range(count)), image=rpc.ground_to_image(ground) + errors, ground=ground,
        roles=np.full(count, "control"), sigma_image=np.ones(count), sigma_ground=np.zeros((count, 3)),
        crs=pyproj.CRS(4326), source="",
    )  # fmt: skip
    return replace(points.with_covariance_image(covariance), **changes)


def dense(rpc: RPC, points: Points, kind: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Return estimate, covariance and sigma0 by the normal equations with the whole weight matrix."""
    start = ImageCorrection.identity(rpc, kind, ORIGIN)
    design = start.param_partials(points.ground).reshape(2 * len(points), -1)
    observed = (points.image - rpc.ground_to_image(points.ground)).ravel()
    whole = np.zeros((2 * len(points), 2 * len(points)))
    for k, covariance in enumerate(points.covariance_image):
        whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = covariance
    weight = np.linalg.inv(whole)
    normal = design.T @ weight @ design
    estimate = np.linalg.solve(normal, design.T @ weight @ observed)
    left = observed - design @ estimate
    variance = float(left @ weight @ left) / (len(observed) - len(estimate))
    return estimate, variance * np.linalg.inv(normal), np.sqrt(variance)


@pytest.mark.parametrize("kind", ["shift", "shift-drift", "affine"])
def test_the_estimate_is_that_of_generalised_least_squares(rpc: RPC, kind: str) -> None:
    points = measured(rpc, kind, 25, 1)
    found = fit(ImageCorrection.identity(rpc, kind, ORIGIN), points, robust=False)
    estimate, covariance, sigma0 = dense(rpc, points, kind)
    sigmas = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.values / sigmas, estimate / sigmas, atol=1e-7)
    np.testing.assert_allclose(
        found.covariance / np.outer(sigmas, sigmas), covariance / np.outer(sigmas, sigmas), atol=1e-9
    )
    assert found.sigma0 == pytest.approx(sigma0, rel=1e-10)


def test_whitening_is_a_division_where_axes_are_independent_and_can_be_undone() -> None:
    random = np.random.default_rng(0)
    sigma, values = random.uniform(0.1, 2, (30, 2)), random.normal(0, 5, (30, 2))
    jacobian = random.normal(0, 1, (30, 2, 4))
    plain = ImageErrors(sigma[:, :, None] * np.eye(2))
    np.testing.assert_array_equal(plain.whitened(values), values / sigma)
    np.testing.assert_array_equal(plain.whitened(jacobian), jacobian / sigma[:, :, None])
    np.testing.assert_array_equal(plain.restored(values), values * sigma)
    correlation = random.uniform(-0.99, 0.99, 30)[:, None, None] * (1 - np.eye(2)) + np.eye(2)
    covariance = correlation * sigma[:, :, None] * sigma[:, None, :]
    factor = np.linalg.cholesky(covariance)
    errors = ImageErrors(factor)
    np.testing.assert_allclose(errors.covariance, covariance, rtol=1e-12)
    np.testing.assert_allclose(errors.sigma, sigma, rtol=1e-12)
    np.testing.assert_allclose(factor @ errors.whitened(jacobian), jacobian, atol=1e-12)
    np.testing.assert_allclose(errors.restored(errors.whitened(values)), values, atol=1e-12)
    half = random.normal(0, 1, (30, 2, 2))
    white = half @ half.transpose(0, 2, 1)
    wanted = np.trace(factor @ white @ factor.transpose(0, 2, 1), axis1=1, axis2=2)
    np.testing.assert_allclose(errors.mean_square(white), wanted, rtol=1e-12)


def test_errors_of_the_ground_add_to_a_covariance_with_their_correlation(rpc: RPC) -> None:
    points = measured(rpc, "shift", 5, 3, sigma_ground=np.full((5, 3), [0.4, 0.3, 2.0]))
    start = ImageCorrection.identity(rpc, "shift", ORIGIN)
    errors = ImageErrors.of(start, points)
    metre = np.array([0.4 / 111_320 / np.cos(np.radians(points.ground[:, 1])), np.full(5, 0.3 / 110_850)]).T
    spread = np.column_stack([metre, np.full(5, 2.0)])
    moved = start.ground_partials(points.ground) * spread[:, None, :]
    added = errors.covariance - points.covariance_image
    # Degrees to metres by a sphere here: right to 0.5 %.
    np.testing.assert_allclose(added, moved @ moved.transpose(0, 2, 1), rtol=0.01, atol=1e-6)


@pytest.mark.parametrize("kind", ["affine", pytest.param("shift", marks=pytest.mark.slow)])
def test_sigmas_cover_with_strongly_anisotropic_errors(rpc: RPC, kind: str) -> None:
    """Over 1,000 repeats (estimate - truth) / sigma has spread 1 (Student's t of 50 - P degrees of freedom)."""
    start = ImageCorrection.identity(rpc, kind, ORIGIN)
    ratios, alike = [], []
    for seed in range(1000):
        points = measured(rpc, kind, 25, seed)
        problem = Problem.of(start, points, points.control, {})
        solution = problem.solve(problem.points.groups < 0, linear=True)
        step = solution.cofactors @ np.einsum(
            "nip,ni->p", problem.errors.whitened(solution.jacobian),
            problem.errors.whitened(points.image - start.ground_to_image(points.ground)),
        )  # fmt: skip
        ratios.append(step / np.sqrt(np.diag(solution.cofactors)) / solution.sigma0)
        alike.append(solution.sigma0)
    freedom = 50 - len(start.params)
    spread = np.std(ratios, axis=0) / np.sqrt(freedom / (freedom - 2))
    assert ((spread > 0.92) & (spread < 1.08)).all(), spread
    assert np.mean(np.square(alike)) == pytest.approx(1.0, abs=0.02)


def test_a_gross_error_across_the_line_of_sight_is_found_where_one_along_it_is_not(rpc: RPC) -> None:
    """Ellipses of 1 px by 0.1 px at 45 degrees: a miss of 1 px is ten sigmas across, and one along."""
    points = measured(rpc, "shift", 20, 5).with_covariance_image(np.tile([[0.505, 0.495], [0.495, 0.505]], (20, 1, 1)))
    truth = rpc.ground_to_image(points.ground)
    random = np.random.default_rng(2)
    noise = (np.linalg.cholesky(points.covariance_image[0]) @ random.normal(0, 1, (2, 20))).T
    start = ImageCorrection.identity(rpc, "shift", ORIGIN)
    for direction, rejected in (((-0.7, 0.7), ["p7"]), ((0.7, 0.7), [])):
        image = truth + noise
        image[7] = truth[7] + np.array(direction)
        found = fit(start, replace(points, image=image))
        assert [name for name, _ in found.rejected] == rejected


# -- groups ----------------------------------------------------------------------------------------------------------


def test_leave_one_out_leaves_a_whole_group_out(rpc: RPC) -> None:
    """Refits without the group are the authority; a correction is linear in its parameters."""
    groups = np.array([0, 0, 0, 4, 4, *[-1] * 10])
    points = measured(rpc, "affine", 15, 8, groups=groups)
    start = ImageCorrection.identity(rpc, "affine", ORIGIN)
    found = fit(start, points, robust=False)
    for k in range(15):
        out = (groups == groups[k]) if groups[k] >= 0 else np.arange(15) == k
        without = fit(start, points.with_roles(np.where(out, "check", "control")), robust=False)
        np.testing.assert_allclose(found.loo_residuals[k], without.residuals[k], atol=1e-6)
    alone = fit(start, replace(points, groups=None), robust=False)
    assert np.abs(alone.loo_residuals[:5] - found.loo_residuals[:5]).max() > 1e-3
    np.testing.assert_array_equal(alone.loo_residuals[5:], found.loo_residuals[5:])


def test_a_model_without_parameters_is_held_against_points_of_groups(rpc: RPC) -> None:
    points = measured(rpc, "shift", 12, 9, groups=np.repeat(np.arange(6), 2))
    found = fit(ImageCorrection.identity(rpc, "none", (0.0, 0.0)), points)
    np.testing.assert_allclose(found.loo_residuals, found.residuals)


def test_a_group_without_which_nothing_is_determined_has_no_residual(rpc: RPC) -> None:
    points = measured(rpc, "affine", 8, 10, groups=[0] * 6 + [-1] * 2)
    found = fit(ImageCorrection.identity(rpc, "affine", ORIGIN), points, robust=False)
    assert np.isnan(found.loo_residuals[:6]).all()
    assert np.isfinite(found.loo_residuals[6:]).all()
