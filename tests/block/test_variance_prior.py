"""The prior of variance components, what rays leave open, degrees of freedom, and the grid's mean, by definition."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from chains import Chain, fly, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.problem import PERFECT_GROUND
from ortho_pipeline.block.equations.solver import Solved, attempt
from ortho_pipeline.block.variances.control_equations import ControlEquations
from ortho_pipeline.block.variances.grid import _Grid


def solved_with(unstated: tuple[bool, bool], single: bool = False) -> Solved:
    """Return a block with nine control points, of which five state no sigma in plan, in height, or in both.

    Three of them are in one image alone if `single`.
    """
    flown = fly(Chain(images=3, convergence_deg=25.0, ties=40, errors=1.0, pairwise=False), 5)
    points = with_control(flown, "i1", 9, sigma=0.4)
    sigmas, rows = points.sigma_ground.copy(), np.flatnonzero(points.control)
    for axes, free in ((slice(0, 2), unstated[0]), (slice(2, 3), unstated[1])):
        sigmas[rows[:5], axes] = 0.0 if free else 0.4
    points = replace(points, sigma_ground=sigmas)
    if single:
        keep = ~np.isin(points.point, rows[:7]) | (points.image == 1)
        points = points.of_rays(np.flatnonzero(keep))
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, ())
    return attempt(problem.with_sigmas(problem.points.sigma_image, (0.4, 0.4)), state, selection)


@pytest.mark.parametrize("single", [False, True])
def test_what_rays_leave_open_is_the_median_of_the_control_points(single: bool) -> None:
    """The two smallest variances of three along the axes of each; what no ray tells of is as the worst ground."""
    solved = solved_with((True, True), single)
    grid, equations = _Grid(solved), ControlEquations(solved)
    assert grid.worst == pytest.approx(20.0 * equations.pixel)
    values = np.linalg.eigvalsh(equations.u)
    with np.errstate(divide="ignore"):
        open_ = np.sort(np.minimum(1.0 / np.maximum(values, 0.0), grid.worst**2), axis=1)
    np.testing.assert_allclose(grid.of_rays, np.median(open_[:, 1:], axis=0), rtol=1e-6)
    assert (grid.of_rays[1] > 0.9 * grid.worst**2) == single


@pytest.mark.parametrize("unstated", [(True, True), (True, False), (False, True), (False, False)])
def test_the_prior_is_the_one_that_is_documented(unstated: tuple[bool, bool]) -> None:
    grid = _Grid(solved_with(unstated))
    assert tuple(grid.free) == unstated
    assert grid.separable
    logs = np.random.default_rng(3).normal(0.0, 2.0, (30, 3))
    wanted = []
    for image, *ground in np.exp(logs):
        # Below a tenth and above ten times what was stated it falls, by the sigma and by its square.
        chance = 1.0 / (1.0 + 0.1 / image) / (1.0 + image**2 / 100.0)
        for sigma, rays, free in zip(ground, grid.of_rays * math.exp(2 * grid.centre[0]), unstated, strict=True):
            if free:
                chance /= (1.0 + rays / sigma**2) * (1.0 + sigma**2 / grid.worst**2)
        if all(unstated):
            chance *= math.exp(-0.5 * (math.log(ground[0] / ground[1]) / math.log(10.0)) ** 2)
        wanted.append(math.log(chance))
    np.testing.assert_allclose(grid._prior(logs), wanted, rtol=1e-9)
    chances = grid.equations.likelihoods(np.exp(2 * logs)) + wanted
    np.testing.assert_allclose(grid.chances(logs), chances, rtol=1e-9)


@pytest.mark.parametrize("unstated", [(True, True), (True, False), (False, True), (False, False)])
def test_components_are_means_over_the_nodes(unstated: tuple[bool, bool]) -> None:
    """Of the ground the means of the logs, with the degrees of freedom that the spread of the misfits' logs has."""
    solved = solved_with(unstated)
    grid = _Grid(solved)
    found = grid.variances()
    logs, chance = grid.logs, grid.chance
    assert chance.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(chance / chance.max(), np.exp(grid.chances(logs) - grid.chances(logs).max()), rtol=1e-9)
    means = np.exp(chance @ logs)
    for sigma, mean, free in zip((found.sigma_xy, found.sigma_h), means[1:], unstated, strict=True):
        assert (sigma is not None) == free
        assert sigma is None or sigma == pytest.approx(mean)
    assert found.unstated == (5 * unstated[0], 5 * unstated[1])
    freedom = math.inf
    for axis in (1, 2):
        if any(unstated):
            own = np.exp(2 * logs[:, axis]) * unstated[axis - 1]
            values = np.log(np.exp(2 * logs[:, 0]) * grid.of_rays[axis - 1] + own)
            spread = np.average((values - np.average(values, weights=chance)) ** 2, weights=chance)
            # 2 / n + 2 / n² is the spread.
            freedom = min(freedom, float(np.roots([spread, -2.0, -2.0]).max()))
    assert found.freedom == pytest.approx(freedom)
    assert found.chances.sum() == pytest.approx(1.0, abs=1e-5)
    likely = chance > 1e-8
    squares = np.exp(2 * logs[likely])
    squares[:, 0] /= found.image**2
    np.testing.assert_allclose(found.nodes, squares, rtol=1e-9)


def test_the_factor_of_measurements_is_that_of_their_redundancy() -> None:
    """At its best value, the sum of the squared misfits of rays over their redundancy is one."""
    solved = solved_with((False, False))
    found = _Grid(solved).variances()
    equations = ControlEquations(solved)
    node = equations.at(np.array([found.image**2, PERFECT_GROUND**2, PERFECT_GROUND**2]))
    apart = (equations.d - node.shift) / 0.4
    rays = (node.square - (apart**2).sum()) * found.image**2
    assert found.image == pytest.approx(math.sqrt(rays / equations.redundancy(node)[0]), rel=0.01)
    assert found.redundancy[1:] == (0.0, 0.0)
