"""Variance components of a block by integrals over a fine grid, with the prior as it is documented."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from chains import ORIGIN, Chain, dense, fly, to_image, with_control
from scipy.optimize import minimize_scalar
from scipy.special import polygamma

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.problem import Pseudo
from ortho_pipeline.block.equations.solver import Solved, attempt, solve
from ortho_pipeline.block.reliability import blunders
from ortho_pipeline.block.reliability.standardised_residuals import standardise
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.block.variances.control_equations import ControlEquations
from ortho_pipeline.block.variances.grid import estimate, posterior, reweighed
from ortho_pipeline.models import ImageCorrection


def block(plan: float, height: float, control: int = 6, noise: float = 0.1) -> Solved:
    """Return the solution of a block whose ground is off by so many metres, and states the sigmas that are not 0."""
    flown = fly(Chain(images=3, convergence_deg=25.0, ties=40, errors=2.0, pairwise=False), 5)
    points = with_control(flown, "i1", control)
    random = np.random.default_rng(6)
    ground = points.ground + random.normal(0, 1, points.ground.shape) * (plan, plan, height)
    points = replace(points, ground=ground, sigma_ground=np.zeros_like(ground), sigma_image=np.full(points.rays, noise))
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, ())
    problem = problem.with_sigmas(problem.points.sigma_image, (plan, height))
    return attempt(problem, state, selection)


def integrated(solved: Solved, free: tuple[bool, bool] = (True, True)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return logs ``(b, 3)`` of sigmas, their chances, and the variances that the rays leave open, from a fine grid."""
    equations, found = ControlEquations(solved), estimate(solved)
    centre = np.log([found.image, found.sigma_xy or 1.0, found.sigma_h or 1.0])
    images = np.linspace(-0.8, 0.8, 15) + centre[0]
    axes = [np.linspace(-3.0, 2.5, 26) + centre[1 + k] if is_free else np.zeros(1) for k, is_free in enumerate(free)]
    logs = np.stack(np.meshgrid(images, *axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # Twenty pixels on the ground are too much for control; a point's own rays leave this much open.
    worst = 20.0 * equations.pixel
    rays = np.array([np.linalg.eigvalsh(np.linalg.inv(u)) for u in equations.u])
    of_rays = np.median(np.minimum(rays[:, 1:], worst**2), axis=0)
    squares = np.exp(2 * logs)
    chance = equations.likelihoods(squares)
    chance = chance - np.log1p(0.1 / np.exp(logs[:, 0])) - np.log1p(squares[:, 0] / 10.0**2)
    seen = of_rays * math.exp(2 * centre[0])
    for axis, is_free in enumerate(free):
        if is_free:
            chance -= np.log1p(seen[axis] / squares[:, 1 + axis]) + np.log1p(squares[:, 1 + axis] / worst**2)
    if all(free):
        chance -= 0.5 * ((logs[:, 1] - logs[:, 2]) / math.log(10.0)) ** 2
    chance = np.exp(chance - chance.max())
    return logs, chance / chance.sum(), of_rays


@pytest.mark.parametrize(("plan", "height"), [(0.5, 1.5), (2.0, 0.6)])
def test_sigmas_of_ground_are_means_of_their_logs(plan: float, height: float) -> None:
    solved = block(plan, height)
    found, (logs, chance, of_rays) = posterior(solved), integrated(solved)
    one = found.variances
    assert one.unstated == (6, 6)
    mean = chance @ logs
    assert np.log(one.sigma_xy) == pytest.approx(mean[1], abs=0.06)
    assert np.log(one.sigma_h) == pytest.approx(mean[2], abs=0.06)
    assert found.image_square == pytest.approx(float(chance @ np.exp(2 * logs[:, 0])), rel=0.02)
    # The redundancy is shared out among all observations.
    assert sum(one.redundancy) == pytest.approx(solved.unit_weight()[1], rel=1e-6)
    # Degrees of freedom by the spread of the logs of misfits' variances: nearly 2 / n + 2 / n^2.
    squares = np.exp(2 * logs)
    freedom = math.inf
    for axis in (1, 2):
        values = np.log(squares[:, 0] * of_rays[axis - 1] + squares[:, axis])
        spread = chance @ (values - chance @ values) ** 2
        freedom = min(freedom, (1 + math.sqrt(1 + 2 * spread)) / spread)
    assert polygamma(1, freedom / 2) == pytest.approx(2 / freedom + 2 / freedom**2, rel=0.1)
    assert one.freedom == pytest.approx(freedom, rel=0.1)
    assert one.chances.sum() == pytest.approx(1.0, abs=1e-3)
    equations, size = ControlEquations(solved), solved.problem.size
    some = np.random.default_rng(1).choice(len(logs), 1000, p=chance)
    drawn = np.mean([equations.root @ (node.cofactors + np.outer(node.z, node.z)) @ equations.root.T
                     for node in map(equations.at, squares[some])], axis=0)  # fmt: skip
    sigmas = np.sqrt(np.diag(drawn))
    np.testing.assert_allclose(np.sqrt(found.covariance.variances) / sigmas, np.ones(size), atol=0.04)


def test_measurements_that_change_by_three_per_cent_are_the_same() -> None:
    solved = block(0.5, 0.5)
    selection = solved.linear.weights
    for factor, same in ((1.029, True), (0.971, True), (1.031, False), (0.969, False)):
        again = reweighed(solved, selection, Variances(factor, None, None, (9.0, 0.0, 0.0), (0, 0)))
        assert (again is solved) is same
    of_ground = Variances(1.0, 0.4, None, (9.0, 3.0, 0.0), (6, 0))
    found = reweighed(solved, selection, of_ground)
    assert found.problem.assumed[0] == 0.4
    wanted = solve(of_ground.applied(solved.problem), solved.state, selection)
    np.testing.assert_allclose(found.state.params, wanted.state.params, atol=1e-9)


def test_sigmas_of_ground_that_are_guessed_too_large_are_scaled_together() -> None:
    """Plan and height are ten times as good as guessed: the ratio of both stays, and no point is a gross error."""
    solved = block(0.5, 1.5)
    again = solved.problem.with_sigmas(solved.problem.points.sigma_image, (5.0, 15.0))
    solved = attempt(again, solved.state, solved.linear.weights)
    problem = blunders._robust(solved, solved.linear.weights, standardise(solved), estimate(solved))[0]
    assert 0.02 < problem.assumed[0] / 5.0 < 0.5
    assert problem.assumed[1] / problem.assumed[0] == pytest.approx(3.0)


def test_ground_of_one_image_is_perfect_whatever_its_sigmas() -> None:
    """One image cannot tell an error of the ground from one of the measurement: the factor is that of plain shifts."""
    flown = fly(Chain(images=2, convergence_deg=25.0, ties=40, errors=2.0, pairwise=False), 5)
    both = with_control(flown, "i1", 8)
    rows = np.flatnonzero((both.image == 1) & (both.roles[both.point] == "control"))
    points = replace(
        both, images=("i1",), point=both.point[rows], image=np.zeros(8, dtype=int), measured=both.measured[rows],
        sigma_image=np.full(8, 0.1), sigma_ground=np.zeros_like(both.ground),
    )  # fmt: skip
    start = flown.start["i1"]
    misses = points.measured - to_image(start, points.ground[points.point])
    wanted = math.sqrt(misses.var(axis=0).sum() * 8 / 14) / 0.1
    problem, state, selection = _prepared((start,), points, {}, ())
    for sigma in (1e-5, 0.1, 0.3):
        solved = attempt(problem.with_sigmas(points.sigma_image, (sigma, sigma)), state, selection)
        found = estimate(solved)
        assert not found.separable
        assert found.redundancy == pytest.approx((solved.unit_weight()[1], 0.0, 0.0), rel=1e-6)
        assert found.image == pytest.approx(wanted, rel=1e-4)


def test_without_redundancy_measurements_are_as_good_as_stated() -> None:
    """One point of exact ground determines a shift, with the sigma of its measurement."""
    flown = fly(Chain(images=2, convergence_deg=25.0, ties=40, errors=2.0, pairwise=False), 5)
    both = with_control(flown, "i1", 1, sigma=1e-3)
    rows = np.flatnonzero((both.image == 1) & (both.roles[both.point] == "control"))
    points = replace(
        both, images=("i1",), point=both.point[rows], image=np.zeros(1, dtype=int), measured=both.measured[rows],
        sigma_image=np.full(1, 0.3),
    )  # fmt: skip
    solved = attempt(*_prepared((flown.start["i1"],), points, {}, ()))
    assert solved.unit_weight() == (None, pytest.approx(0.0, abs=1e-6))
    found = posterior(solved)
    assert found.variances.image == 1.0
    assert found.image_square == 1.0
    np.testing.assert_allclose(found.covariance.variances, 0.3**2, rtol=1e-3)


def likeliest(solved: Solved) -> float:
    """Return the factor of measurements with the greatest restricted likelihood, all equations in one dense matrix."""
    design, misfits = dense(solved.linear)
    rays = np.arange(len(design)) < 2 * len(solved.linear.ordering.rays)

    def unlikely(log: float) -> float:
        sigmas = np.where(rays, math.exp(log), 1.0)
        whitened, own = design / sigmas[:, None], misfits / sigmas
        step = np.linalg.lstsq(whitened, own, rcond=None)[0]
        _, logs = np.linalg.slogdet(whitened.T @ whitened)
        return float(np.log(sigmas).sum() + 0.5 * logs + 0.5 * ((own - whitened @ step) ** 2).sum())

    return math.exp(minimize_scalar(unlikely, bounds=(-3.0, 3.0), method="bounded", options={"xatol": 1e-6}).x)


@pytest.mark.parametrize(("stated", "off"), [(0.02, 0.3), (0.02, -1.0), (1.0, 0.3)])
def test_the_factor_of_measurements_is_the_likeliest_where_knowledge_of_parameters_contradicts_them(
    stated: float, off: float
) -> None:
    """Noise of 0.1 px; what is stated of two parameters is wrong by so many pixels of 0.2, and keeps its sigma."""
    flown = fly(Chain(images=3, convergence_deg=25.0, ties=12, errors=2.0, pairwise=False), 5)
    points = with_control(flown, "i1", 5, sigma=0.05)
    points = replace(points, sigma_image=np.full(points.rays, stated))
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, ())
    true = np.concatenate([model.params for model in flown.truth.values()])
    problem = problem.with_pseudo([Pseudo(k, float(true[k] + off), 0.2) for k in (0, 3)])
    solved = solve(problem, state, selection)
    assert estimate(solved).image == pytest.approx(likeliest(solved), rel=0.01)


@pytest.mark.parametrize("off", [-0.02, -0.1])
def test_how_far_parameters_move_with_the_sigmas_that_are_found_is_in_sigmas_they_had(off: float) -> None:
    """Two parameters: the larger of two numbers whose squares add up to that of the step over its cofactors."""
    flown = fly(Chain(images=2, convergence_deg=25.0, ties=15, errors=0.0, pairwise=False), 5)
    points = with_control(flown, "i1", 5, sigma=0.05)
    points = replace(points, sigma_image=np.full(points.rays, 0.05))
    models = ImageCorrection.identity(flown.start["i0"].model, "none", ORIGIN), flown.start["i1"]
    problem, state, selection = _prepared(models, points, {}, ())
    solved = solve(problem.with_pseudo([Pseudo(0, off, 0.02)]), state, selection)
    found = posterior(solved)
    design, misfits = dense(solved.linear)
    before = np.linalg.inv(design.T @ design)[:2, :2]
    sigmas = np.where(np.arange(len(design)) < 2 * len(solved.linear.ordering.rays), found.variances.image, 1.0)
    step = np.linalg.lstsq(design / sigmas[:, None], misfits / sigmas, rcond=None)[0][:2]
    length = math.sqrt(step @ np.linalg.solve(before, step))
    assert 0.1 < length < 1.0
    assert length / math.sqrt(2.0) <= found.moved <= 1.001 * length
