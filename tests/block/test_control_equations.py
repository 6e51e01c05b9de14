"""Equations of control points at any sigmas: redundancy, shifts, means over nodes, and the finest measurement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from chains import Block, Chain, dem, dense, fly, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.problem import Pseudo
from ortho_pipeline.block.equations.solver import Solved, attempt
from ortho_pipeline.block.heights.settling import Heights
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.variances import control_equations
from ortho_pipeline.block.variances.control_equations import ControlEquations, _factors, _inverted
from ortho_pipeline.block.variances.grid import estimate
from ortho_pipeline.geodesy.crs import ground_transform

#: Assumed sigmas of ground that states none, plan and height.
ASSUMED = 0.3, 0.8


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=3, convergence_deg=25.0, ties=36, errors=1.0, pairwise=False), 5)


def control(flown: Block) -> BlockPoints:
    """Return ten control points: five state a sigma, two none, two only one in plan, one only one in height."""
    points = with_control(flown, "i1", 10, sigma=0.25)
    sigmas = points.sigma_ground.copy()
    rows = np.flatnonzero(points.control)
    sigmas[rows[:2]], sigmas[rows[2:4], 2], sigmas[rows[4], :2] = 0.0, 0.0, 0.0
    sizes = np.random.default_rng(2).uniform(0.05, 0.2, points.rays)
    return replace(points, sigma_ground=sigmas, sigma_image=sizes)


def solved_with(flown: Block, points: BlockPoints, source: DemHeights | None = None) -> Solved:
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, (), source)
    problem = problem.with_pseudo([Pseudo(0, 0.7, 0.4), Pseudo(3, -0.2, 0.9)])
    problem = problem.with_sigmas(problem.points.sigma_image, ASSUMED)
    if source is not None:
        problem = Heights.under(source, problem, state.local).applied(problem)
    return attempt(problem, state, selection)


@pytest.fixture(scope="module")
def solved(flown: Block) -> Solved:
    return solved_with(flown, control(flown))


def at_node(solved: Solved, node: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows of all unknowns with variances of image, plan and height, the misfits, and the kinds of rows.

    Kinds are 0 of rays, 1 and 2 of unstated plan and height, 3 of everything else.
    """
    linear = solved.linear
    design, misfits = dense(linear)
    count, grounded = 2 * len(linear.ordering.rays), linear.ordering.grounded
    kinds = np.full(len(misfits), 3)
    kinds[:count] = 0
    unstated = np.where(solved.problem.unstated[grounded], [1, 1, 2], 3).ravel()
    kinds[count : count + len(unstated)] = unstated
    factor = np.array([node[0] ** -0.5, ASSUMED[0] / node[1] ** 0.5, ASSUMED[1] / node[2] ** 0.5, 1.0])[kinds]
    return design * factor[:, None], misfits * factor, kinds


NODES = np.array([[1.0, 0.09, 0.64], [1.9, 0.4, 0.03], [0.6, 0.02, 5.0]])


@pytest.mark.parametrize("node", NODES, ids=str)
def test_the_redundancy_of_a_kind_is_what_the_hat_matrix_leaves_of_its_observations(
    solved: Solved, node: np.ndarray
) -> None:
    equations = ControlEquations(solved)
    design, _, kinds = at_node(solved, node)
    left = 1.0 - np.einsum("ij,jk,ik->i", design, np.linalg.inv(design.T @ design), design)
    wanted = [left[kinds == kind].sum() for kind in range(3)]
    assert min(wanted) > 0.5
    np.testing.assert_allclose(equations.redundancy(equations.at(node)), wanted, rtol=1e-6)


def test_heights_of_a_dem_take_their_part_of_the_redundancy(flown: Block, tmp_path: Path) -> None:
    """At the solution itself, with a DEM under ties and under a control point without a height."""
    points = control(flown)
    ground = points.ground.copy()
    ground[np.flatnonzero(points.control)[6], 2] = np.nan
    source = DemHeights(dem(flown, tmp_path / "dem.tif", 5, white=1.0).with_sigma(0.9), bias=2.0)
    solved = solved_with(flown, replace(points, ground=ground), source)
    planes = solved.problem.heights
    assert planes is not None
    assert (planes.on & solved.problem.placed).sum() == 1
    assert planes.on.sum() > 10
    node = np.array([1.0, ASSUMED[0] ** 2, ASSUMED[1] ** 2])
    equations = ControlEquations(solved)
    design, _, kinds = at_node(solved, node)
    observed = np.abs(design).sum(axis=1) > 0
    left = 1.0 - np.einsum("ij,jk,ik->i", design, np.linalg.inv(design.T @ design), design)
    wanted = [left[(kinds == kind) & observed].sum() for kind in range(3)]
    np.testing.assert_allclose(equations.redundancy(equations.at(node)), wanted, rtol=1e-6)


def test_a_node_moves_control_points_as_the_dense_solution(solved: Solved) -> None:
    equations, linear, size = ControlEquations(solved), solved.linear, solved.problem.size
    numbers = linear.ordering.numbers.tolist()
    assert len(equations.rows) == 10
    for node in NODES[1:]:
        found = equations.at(node)
        design, misfits, _ = at_node(solved, node)
        cofactors = np.linalg.inv(design.T @ design)
        step = cofactors @ (design.T @ misfits)
        for k, point in enumerate(equations.rows.tolist()):
            own = size + 3 * numbers.index(point) + np.arange(3)
            turn = solved.problem.enu[point]
            np.testing.assert_allclose(found.shift[k], turn @ step[own], atol=1e-7 * np.abs(step).max())
            np.testing.assert_allclose(found.ground[k], turn @ cofactors[np.ix_(own, own)] @ turn.T, atol=1e-8)
        stated = solved.problem.points.sigma_ground[equations.rows]
        variances = np.where(stated > 0, np.square(stated), node[[1, 1, 2]])
        np.testing.assert_allclose(found.weights, 1 / variances, rtol=1e-9)


def test_the_restricted_likelihood_is_that_of_the_dense_problem(solved: Solved) -> None:
    """But for a constant, which no comparison of nodes sees."""
    found, wanted = ControlEquations(solved).likelihoods(NODES), []
    for node in NODES:
        design, misfits, kinds = at_node(solved, node)
        normal = design.T @ design
        left = misfits - design @ np.linalg.solve(normal, design.T @ misfits)
        counts = np.bincount(kinds, minlength=4)[:3]
        wanted.append(-0.5 * (counts @ np.log(node) + np.linalg.slogdet(normal)[1] + left @ left))
    assert np.ptp(wanted) > 1.0
    np.testing.assert_allclose(found - found[0], np.array(wanted) - wanted[0], rtol=1e-7)


def test_a_node_whose_equations_have_no_solution_has_no_chance(solved: Solved) -> None:
    """Where rounding leaves matrices that are not positive definite, the node must not be the best."""
    equations = ControlEquations(solved)
    equations.image = -equations.image
    np.testing.assert_array_equal(equations.likelihoods(NODES), -np.inf)


@pytest.mark.parametrize("at_once", [1 << 16, 1])
def test_the_mean_over_nodes_has_how_far_their_solutions_are_apart(
    solved: Solved, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    """Whatever number of nodes is in memory together."""
    monkeypatch.setattr(control_equations, "_AT_ONCE", at_once)
    equations, chances = ControlEquations(solved), np.array([0.2, 0.5, 0.3])
    alone = [equations.at(node) for node in NODES]
    found = equations.over(NODES, chances)
    wanted = [one.cofactors + np.outer(one.z, one.z) for one in alone]
    np.testing.assert_allclose(found.cofactors, np.tensordot(chances, wanted, 1), rtol=1e-10, atol=1e-13)
    ground = [one.ground + one.shift[:, :, None] * one.shift[:, None, :] for one in alone]
    np.testing.assert_allclose(found.ground, np.tensordot(chances, ground, 1), rtol=1e-10, atol=1e-13)
    assert max(np.abs(one.z).max() for one in alone[1:]) > 0.1
    np.testing.assert_allclose(equations.likelihoods(NODES), [equations.likelihoods(one[None])[0] for one in NODES])


def test_a_pixel_is_as_long_as_the_models_say(flown: Block, solved: Solved) -> None:
    """The median over image axes, of the length on the ground that moves an image point by one pixel."""
    state, points = solved.state, solved.problem.points
    moves = []
    for image, model in enumerate(state.models):
        rows = points.point[points.image == image]
        local = state.local[rows]
        for step in 0.5 * np.eye(3):
            ahead, behind = (model.ground_to_image(_in_crs(solved, local + way * step, model.crs)) for way in (1, -1))
            moves.append(ahead - behind)
    count = len(moves) // 3
    lengths = [np.linalg.norm(moves[3 * k : 3 * k + 3], axis=0) for k in range(count)]
    weighed = np.concatenate(lengths) / _sigmas(points)[:, None]
    wanted = 1.0 / (np.median(weighed) * np.median(points.sigma_image))
    assert ControlEquations(solved).pixel == pytest.approx(wanted, rel=1e-5)


def _sigmas(points: BlockPoints) -> np.ndarray:
    return np.concatenate([points.sigma_image[points.image == image] for image in range(len(points.images))])


def _in_crs(solved: Solved, local: np.ndarray, crs: pyproj.CRS | str) -> np.ndarray:
    return ground_transform("EPSG:4979", crs)(solved.problem.frame.geodetic(local))


def test_no_measurement_counts_as_better_than_a_ten_thousandth_of_a_pixel() -> None:
    """Simulated image points without errors: their factor is 1e-4 px over the stated 0.2 px."""
    flown = fly(Chain(images=3, convergence_deg=25.0, ties=30, errors=1.0, noise=1e-9, pairwise=False), 5)
    points = replace(with_control(flown, "i1", 8, sigma=1e-9), sigma_image=np.full(flown.points.rays, 0.2))
    points = replace(points, sigma_ground=np.where(points.sigma_ground > 0, 0.1, 0.0))
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, ())
    assert estimate(attempt(problem, state, selection)).image == pytest.approx(1e-4 / 0.2, rel=1e-9)


def test_small_matrices_are_inverted_with_their_determinants() -> None:
    root = np.random.default_rng(4).normal(size=(5, 4, 3, 3))
    matrices = root @ root.swapaxes(2, 3) + 0.3 * np.eye(3)
    logs, inverse = _inverted(matrices)
    np.testing.assert_allclose(logs, np.linalg.slogdet(matrices)[1].sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrices), rtol=1e-9, atol=1e-9)


def test_a_matrix_that_has_no_root_does_not_spoil_the_others() -> None:
    matrices = np.array([[[4.0, 2.0], [2.0, 5.0]], [[1.0, 3.0], [3.0, 1.0]], [[9.0, 3.0], [3.0, 2.0]]])
    found = _factors(matrices)
    np.testing.assert_allclose(found[[0, 2]], [[[2, 0], [1, 2]], [[3, 0], [1, 1]]])
    assert np.isnan(found[1]).all()
