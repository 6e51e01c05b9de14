"""Equations of blocks: compiled elimination, normal equations in levels, and what is taken of their inverse.

They are compared with one dense least-squares problem of all unknowns, solved by triangulation.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pyproj
import pytest
from chains import dense
from threadpoolctl import threadpool_info, threadpool_limits

from ortho_pipeline.block import adjustment
from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.equations import elimination
from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.elimination import Elimination, step_of, weakest
from ortho_pipeline.block.equations.image_pairs import ImagePairs, Levels
from ortho_pipeline.block.equations.level_factor import LevelFactor
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Pseudo, Selection, State
from ortho_pipeline.block.equations.reduced_system import NormalSystem
from ortho_pipeline.block.equations.solver import EXACT, solve
from ortho_pipeline.block.equations.unknowns import Columns
from ortho_pipeline.block.intersection import frame_of, meet
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.reliability import blunders
from ortho_pipeline.block.variances import control_equations
from ortho_pipeline.block.variances.grid import posterior
from ortho_pipeline.estimation.observations.on_points import OnPoints
from ortho_pipeline.models import ImageCorrection, SensorModel
from ortho_pipeline.models.base import as_ground

LON, LAT, METRES = 33.0, 37.0, 111_000.0
SIZE = 2000


class Parallel(SensorModel):
    """An image with parallel rays: metres east and north of a place, plus heights times a slope, as pixels."""

    kind = "parallel"

    def __init__(self, east: float, slope: float, aslant: float) -> None:
        self.east, self.slope, self.aslant = east, slope, aslant

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        middle = LON + (self.east + SIZE / 2) / METRES
        return np.array([middle, LAT, 500.0]), np.array([0.03, 0.03, 600.0])

    def ground_to_image(self, ground: object) -> np.ndarray:
        lon, lat, h = as_ground(ground).T
        column = (lon - LON) * METRES - self.east + self.slope * h
        return np.stack([column, SIZE / 2 - (lat - LAT) * METRES + self.aslant * h], axis=1)


def strip(images: int, points: int, seed: int = 0, apart: float = 0.4) -> tuple[dict[str, SensorModel], BlockPoints]:
    """Return start models and points of a strip in which each image overlaps two on either side, `apart` of a side."""
    random = np.random.default_rng(seed)
    east = apart * SIZE * np.arange(images)
    cameras = [Parallel(e, s, a) for e, s, a in zip(east, *random.uniform(-0.7, 0.7, (2, images)), strict=True)]
    plan = random.uniform((0.0, -SIZE / 2), (east[-1] + SIZE, SIZE / 2), (points, 2)) / METRES
    ground = np.column_stack([LON + plan[:, 0], LAT + plan[:, 1], random.uniform(100, 900, points)])
    kinds = ["affine", "shift", "shift-drift", "none"]
    models, point, image, measured = {}, [], [], []
    for k, camera in enumerate(cameras):
        start = ImageCorrection.identity(camera, kinds[k % 4], (SIZE / 2, SIZE / 2))
        scale = [5.0 if name.endswith("shift") else 1e-3 for name in start.param_names]
        seen = start.with_params(random.normal(0, 1, len(scale)) * scale).ground_to_image(ground)
        inside = np.flatnonzero(((seen >= 0) & (seen <= SIZE)).all(axis=1))
        models[f"i{k}"] = start
        point.append(inside)
        image.append(np.full(len(inside), k))
        measured.append(seen[inside] + random.normal(0, 0.3, (len(inside), 2)))
    control = np.arange(points) % 8 == 0
    some = random.random((points, 3)) < 0.5
    return models, BlockPoints(
        ids=tuple(f"p{k}" for k in range(points)), ground=np.where(control[:, None], ground, np.nan),
        roles=np.where(control, "control", "tie"), sigma_ground=np.where(some, 0.5, 0.2), crs=pyproj.CRS("EPSG:4326"),
        images=tuple(models), point=np.concatenate(point), image=np.concatenate(image),
        measured=np.concatenate(measured), sigma_image=np.full(sum(map(len, point)), 0.3),
    )  # fmt: skip


@pytest.fixture(scope="module")
def linear() -> Linear:
    """Equations of a strip whose images have 6, 2, 4 and no parameters, with weights, known plan and priors."""
    models, points = strip(9, 160)
    ordered = tuple(models.values())
    known = points.ground.copy()
    known[np.flatnonzero(points.control)[::3], 2] = np.nan
    frame = frame_of(ordered, points)
    pseudo = (Pseudo(0, 1.0, 4.0), Pseudo(7, 0.5, 2.0), Pseudo(9, 0.5, 2.0, held=True))
    problem = BlockProblem(points, ordered, frame, known, pseudo)
    rays = np.ones(points.rays, dtype=bool)
    local = meet(frame, ordered, points, rays)
    rays &= np.isfinite(local).all(axis=1)[points.point]
    random = np.random.default_rng(1)
    weights = replace(
        Selection.of(rays, points.control), ray_weights=random.uniform(1e-8, 1, points.rays),
        ground_weights=random.uniform(1e-8, 1, len(points)),
    )  # fmt: skip
    return Linear.at(problem, State(ordered, local), weights)


def test_a_step_is_that_of_one_least_squares_problem_of_all_unknowns(linear: Linear) -> None:
    design, misfits = dense(linear)
    size, numbers = linear.problem.size, linear.ordering.numbers
    q, r = np.linalg.qr(design)
    inverse = np.linalg.inv(r)
    cofactors, whole = inverse @ inverse.T, inverse @ (q.T @ misfits)
    sigmas = np.sqrt(np.diag(cofactors))
    step = step_of(linear)
    found = np.concatenate([step.solution.values, step.shift[numbers].ravel()])
    np.testing.assert_allclose(found / sigmas, whole / sigmas, rtol=0, atol=1e-9)
    np.testing.assert_allclose(step.solution.cofactors.variances, sigmas[:size] ** 2, rtol=1e-9)
    own = np.arange(size, len(whole)).reshape(-1, 3)
    of_points = cofactors[own[:, :, None], own[:, None, :]]
    found = step.points.ground(step.solution.cofactors, 1.0)
    np.testing.assert_allclose(found[numbers], of_points, rtol=1e-7, atol=1e-12 * of_points.max())
    assert np.isnan(np.delete(found, numbers, axis=0)).all()
    of_rays, of_ground = step.points.hats(step.solution.cofactors)
    hat, rays = q @ q.T, linear.ordering.rays
    for rows, parts in ((0, of_rays[rays]), (2 * len(rays), of_ground[linear.ordering.grounded])):
        at = rows + np.arange(parts.shape[0] * parts.shape[1]).reshape(parts.shape[:2])
        np.testing.assert_allclose(parts, hat[at[:, :, None], at[:, None, :]], rtol=0, atol=1e-9)


def test_the_condition_is_that_of_the_design_without_the_points(linear: Linear) -> None:
    design, size = dense(linear)[0], linear.problem.size
    of_points = np.linalg.qr(design[:, size:])[0]
    left = design[:, :size] - of_points @ (of_points.T @ design[:, :size])
    scaled = left / np.linalg.norm(left, axis=0)
    assert step_of(linear).condition == pytest.approx(np.linalg.cond(scaled), rel=1e-8)
    assert abs(weakest(linear) @ np.linalg.svd(scaled)[2][-1]) == pytest.approx(1.0, rel=1e-8)


def test_damped_steps_are_those_of_a_longer_diagonal(linear: Linear) -> None:
    """Points stay free: what is damped are the parameters, relative to their equations without the points."""
    design, misfits = dense(linear)
    size = linear.problem.size
    of_points = np.linalg.qr(design[:, size:])[0]
    left = design[:, :size] - of_points @ (of_points.T @ design[:, :size])
    normal = left.T @ left
    wanted = np.linalg.solve(normal + 0.3 * np.diag(np.diag(normal)), left.T @ misfits)
    found = Elimination(linear).system().solve(0.3).values
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


def test_parts_of_the_inverse_are_those_of_the_whole(linear: Linear) -> None:
    system = Elimination(linear).system()
    found = system.solve(0.0).cofactors
    assert len(found.levels.of_level) > 2
    lengths = np.sqrt(np.abs(np.diag(np.linalg.inv(system.scaled()))))
    scale = np.sqrt(found.variances) / lengths
    whole = np.linalg.inv(system.scaled()) * np.outer(scale, scale)
    sigmas = np.sqrt(np.diag(whole))
    np.testing.assert_allclose(found.matrix / np.outer(sigmas, sigmas), whole / np.outer(sigmas, sigmas), atol=1e-9)
    columns = linear.problem.columns
    for first, second in ((4, 4), (1, 2), (2, 1), (6, 5)):
        wanted = whole[np.ix_(columns.of_image(first), columns.of_image(second))]
        part = found.between(np.array([first]), np.array([second]))[0, : wanted.shape[0], : wanted.shape[1]]
        np.testing.assert_allclose(part, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    random = np.random.default_rng(2)
    root, inner = random.normal(0, 1, (columns.size, 3)) * sigmas[:, None], np.diag([1.0, 2.0, 3.0])
    mixed = found.mixed(2.0, root, inner)
    np.testing.assert_allclose(mixed.variances, np.diag(2.0 * whole + root @ inner @ root.T), rtol=1e-8)
    np.testing.assert_allclose(mixed.matrix @ root, mixed.times(root), rtol=0, atol=1e-9 * np.abs(mixed.matrix).max())
    again = mixed.mixed(0.5, root[:, :1], np.eye(1))
    wanted = 0.5 * (2.0 * whole + root @ inner @ root.T) + root[:, :1] @ root[:, :1].T
    np.testing.assert_allclose(again.variances, np.diag(wanted), rtol=1e-8)


def test_the_condition_of_many_parameters_is_iterated_for(linear: Linear, monkeypatch: pytest.MonkeyPatch) -> None:
    system = Elimination(linear).system()
    wanted = system.solve(0.0).condition
    monkeypatch.setattr("ortho_pipeline.block.equations.level_factor._FEW", 0)
    assert system.solve(0.0).condition == pytest.approx(wanted, rel=1e-8)


def test_images_without_common_points_are_levels_of_their_own() -> None:
    """Two strips that nothing ties, and an image that nothing shows."""
    points = BlockPoints(
        ids=("a", "b", "c", "d"), ground=np.full((4, 3), np.nan), roles=np.full(4, "tie"),
        sigma_ground=np.zeros((4, 3)), crs=pyproj.CRS("EPSG:4326"), images=tuple("uvwxyz"),
        point=np.array([0, 0, 1, 1, 2, 2, 3]), image=np.array([0, 2, 2, 4, 1, 3, 1]), measured=np.zeros((7, 2)),
        sigma_image=np.ones(7),
    )  # fmt: skip
    pairs = ImagePairs.of(points)
    place = {image: k for k, level in enumerate(pairs.levels) for image in level.tolist()}
    assert sorted(place) == list(range(6))
    assert all(abs(place[a] - place[b]) <= 1 for a, b in zip(pairs.first, pairs.second, strict=True))
    levels = Levels(pairs, Columns.of([2, 1, 0, 2, 3, 1]))
    random = np.random.default_rng(3)
    blocks = random.normal(0, 0.1, (len(pairs.first), 3, 3))
    own = pairs.slot[np.arange(6), np.arange(6)]
    blocks[own] = blocks[own] + blocks[own].swapaxes(1, 2) + 2 * np.eye(3)
    factor = LevelFactor(levels, blocks)
    dense = factor.dense() * np.outer(
        factor.lengths[levels.columns.padded >= 0], factor.lengths[levels.columns.padded >= 0]
    )
    np.testing.assert_allclose(factor.solve(np.eye(9)), np.linalg.inv(dense), rtol=0, atol=1e-12)


def test_no_block_needs_the_whole_inverse(monkeypatch: pytest.MonkeyPatch) -> None:
    """From first to last, without any matrix of all parameters by all; where control tells a part of all."""
    models, points = strip(12, 320)
    points = replace(points, measured=points.measured + 30.0 * (np.arange(points.rays) % 41 == 7)[:, None])
    wanted = adjust(models, points)
    monkeypatch.setattr(control_equations, "_FAR_LESS", np.inf)
    monkeypatch.setattr(Cofactors, "matrix", property(lambda self: pytest.fail("the whole inverse was made")))
    found = adjust(models, points)
    assert wanted.rejected == found.rejected
    assert len(found.rejected) > 10
    np.testing.assert_allclose((found.values - wanted.values) / wanted.sigmas, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.sigmas, wanted.sigmas, rtol=1e-7)
    np.testing.assert_allclose(found.ground_covariance, wanted.ground_covariance, rtol=1e-5, equal_nan=True)
    assert found.sigma0 == pytest.approx(wanted.sigma0, rel=1e-8)


@pytest.mark.parametrize("stated", [True, False])
def test_what_control_tells_nothing_of_needs_no_part_in_the_grid(monkeypatch: pytest.MonkeyPatch, stated: bool) -> None:
    models, points = strip(12, 200)
    if not stated:
        points = replace(points, sigma_ground=np.zeros((len(points), 3)))
    points = points.with_roles(np.where(np.arange(len(points)) % 32 == 0, "control", "tie"))
    monkeypatch.setattr(control_equations, "_FAR_LESS", 0.0)
    wanted = adjust(models, points, robust=False)
    monkeypatch.setattr(control_equations, "_FAR_LESS", 1.0)
    found = adjust(models, points, robust=False)
    np.testing.assert_allclose(found.sigmas, wanted.sigmas, rtol=1e-8)
    np.testing.assert_allclose(found.ground_covariance, wanted.ground_covariance, rtol=1e-6, equal_nan=True)
    one, other = found.variances, wanted.variances
    assert (one.sigma_xy is None) == stated
    np.testing.assert_allclose((one.image, *one.redundancy), (other.image, *other.redundancy), rtol=1e-8)
    if not stated:
        np.testing.assert_allclose((one.sigma_xy, one.sigma_h), (other.sigma_xy, other.sigma_h), rtol=1e-8)


def test_sigmas_are_there_where_rounding_drowns_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements a hundred times as good as stated: the factor is the smallest at which the equations still hold."""
    models, points = strip(6, 120)
    points = replace(points, sigma_image=100.0 * points.sigma_image)
    exact = control_equations.ControlEquations.likelihoods

    def drowned(self: control_equations.ControlEquations, nodes: np.ndarray) -> np.ndarray:
        return np.where(nodes[:, 0] < 0.02, -np.inf, exact(self, nodes))

    free = adjust(models, points, robust=False).variances.image
    monkeypatch.setattr(control_equations.ControlEquations, "likelihoods", drowned)
    found = adjust(models, points, robust=False)
    assert free < 0.05
    assert np.sqrt(0.02) <= found.variances.image < np.sqrt(0.02) * np.exp(0.5)
    assert (found.sigmas > 0).all()


def test_nodes_are_the_least_squares_problems_with_their_variances() -> None:
    """Cofactors, solution and restricted likelihood of a node, by one dense problem of all unknowns."""
    models, points = strip(6, 120)
    points = replace(points, sigma_ground=np.where(np.arange(len(points))[:, None] % 16 == 0, 0.0, points.sigma_ground))
    ordered, frame = tuple(models.values()), frame_of(tuple(models.values()), points)
    known = np.where(points.control[:, None], points.ground, np.nan)
    problem = BlockProblem(points, ordered, frame, known, (Pseudo(0, 1.0, 4.0),), assumed=(0.4, 0.7))
    rays = np.ones(points.rays, dtype=bool)
    local = meet(frame, ordered, points, rays)
    rays &= np.isfinite(local).all(axis=1)[points.point]
    solved = solve(problem, State(ordered, local), Selection.of(rays, points.control))
    linear, equations = solved.linear, control_equations.ControlEquations(solved)
    design, misfits = dense(linear)
    count, grounded = linear.ordering.observations, linear.ordering.grounded
    found, wanted = [], []
    for image, plan, height in ((1.0, 0.16, 0.49), (1.7, 0.01, 4.0)):
        # The ground was weighted by 0.4 and 0.7 m where it states no sigma; its misfits follow the node's.
        factor = np.ones(len(misfits))
        factor[:count] = image**-0.5
        own = np.where(equations.unstated, np.sqrt([0.16 / plan, 0.16 / plan, 0.49 / height]), 1.0)
        factor[count : count + 3 * len(grounded)] = own.ravel()
        a, r = design * factor[:, None], misfits * factor
        cofactors = np.linalg.inv(a.T @ a)
        whole = cofactors @ (a.T @ r)
        left = r - a @ whole
        wanted.append(np.log(factor).sum() + 0.5 * np.linalg.slogdet(cofactors)[1] - 0.5 * left @ left)
        node = np.array([image, plan, height])
        solution = equations.at(node)
        found.append(equations.likelihoods(node[None])[0])
        size = problem.size
        sigmas = np.sqrt(np.diag(cofactors))[:size]
        np.testing.assert_allclose(equations.root @ solution.z / sigmas, whole[:size] / sigmas, rtol=0, atol=1e-7)
        parts = equations.root @ solution.cofactors @ equations.root.T / np.outer(sigmas, sigmas)
        np.testing.assert_allclose(parts, cofactors[:size, :size] / np.outer(sigmas, sigmas), rtol=0, atol=1e-8)
        assert solution.square == pytest.approx(left @ left - linear.misfits.pseudo @ linear.misfits.pseudo, rel=1e-9)
        first = size + 3 * int(np.flatnonzero(linear.ordering.numbers == grounded[0])[0])
        turn = problem.enu[grounded[0]]
        of_point = turn @ cofactors[first : first + 3, first : first + 3] @ turn.T
        np.testing.assert_allclose(solution.ground[0], of_point, rtol=0, atol=1e-8 * of_point.max())
    assert found[1] - found[0] == pytest.approx(wanted[1] - wanted[0], abs=1e-6)
    # Nodes are solved many at once, and each is the same by itself.
    nodes = np.exp(np.random.default_rng(0).normal(size=(200, 3)))
    alone = [equations.likelihoods(node[None])[0] for node in nodes]
    np.testing.assert_allclose(equations.likelihoods(nodes), alone, rtol=1e-13)


def test_covariances_are_means_over_the_factors_that_are_possible() -> None:
    """Of stated ground and few measurements: by the restricted likelihood of dense problems, and the prior."""
    models, points = strip(4, 24, seed=4)
    ordered, frame = tuple(models.values()), frame_of(tuple(models.values()), points)
    problem = BlockProblem(points, ordered, frame, np.where(points.control[:, None], points.ground, np.nan))
    rays = np.ones(points.rays, dtype=bool)
    local = meet(frame, ordered, points, rays)
    rays &= np.isfinite(local).all(axis=1)[points.point]
    solved = solve(problem, State(ordered, local), Selection.of(rays, points.control))
    (design, misfits), count, size = dense(solved.linear), solved.linear.ordering.observations, problem.size
    freedom = len(misfits) - design.shape[1]
    assert freedom < 30
    logs = np.linspace(-1.5, 2.5, 400)
    chances, squares = np.zeros(400), np.zeros((400, size, size))
    for k, log in enumerate(logs):
        factor = np.where(np.arange(len(misfits)) < count, np.exp(-log), 1.0)
        a, r = design * factor[:, None], misfits * factor
        cofactors = np.linalg.inv(a.T @ a)
        step = cofactors @ (a.T @ r)
        left = r - a @ step
        squares[k] = (cofactors + np.outer(step, step))[:size, :size]
        chances[k] = np.log(factor).sum() + 0.5 * np.linalg.slogdet(cofactors)[1] - 0.5 * left @ left
        chances[k] -= np.log1p(0.1 / np.exp(log)) + np.log1p(np.exp(2 * log) / 10.0**2)
    chances = np.exp(chances - chances.max())
    chances /= chances.sum()
    found = posterior(solved)
    assert found.image_square == pytest.approx(chances @ np.exp(2 * logs), rel=2e-3)
    wanted = np.tensordot(chances, squares, 1)
    sigmas = np.sqrt(np.diag(wanted))
    apart = (found.covariance.matrix - wanted) / np.outer(sigmas, sigmas)
    np.testing.assert_allclose(apart, 0.0, atol=3e-3)


def test_equations_with_a_few_points_elsewhere_are_those_of_the_state(linear: Linear) -> None:
    moved = np.arange(len(linear.problem.points)) % 7 == 0
    local = linear.state.local + 5.0 * moved[:, None]
    wanted = Linear.at(linear.problem, State(linear.state.models, local), linear.weights)
    own = Linear.at(linear.problem, linear.state, linear.weights)
    found = own.with_points_moved(local, moved)
    assert not hasattr(own, "by_params"), "partials, most of the memory of a block, are kept twice"
    np.testing.assert_allclose(found.misfits.vector, wanted.misfits.vector, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.by_point, wanted.by_point, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.by_params, wanted.by_params, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(found.state.local, local)


def test_a_search_near_the_minimum_finds_the_same_in_fewer_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    models, points = strip(10, 400)
    random = np.random.default_rng(2)
    measured = points.measured.copy()
    wrong = random.choice(points.rays, 30, replace=False)
    measured[wrong] += random.uniform(10, 60, (30, 2)) * random.choice([-1.0, 1.0], (30, 2))
    points, steps, system = replace(points, measured=measured), [0, 0], Elimination.system

    def counted(self: Elimination) -> NormalSystem:
        steps[0] += 1
        return system(self)

    monkeypatch.setattr(Elimination, "system", counted)
    near = adjust(models, points)
    steps.reverse()
    for module in (adjustment, blunders):
        monkeypatch.setattr(module, "NEAR", EXACT)
    exact = adjust(models, points)
    assert steps[1] < 0.85 * steps[0]
    assert len(near.rejected) > 20
    assert near.rejected == exact.rejected
    # Both end where a step is below 1e-8 of all misfits, which is up to 1e-5 sigmas of one parameter.
    np.testing.assert_allclose(near.values / exact.sigmas, exact.values / exact.sigmas, rtol=0, atol=1e-5)
    np.testing.assert_allclose(near.sigmas, exact.sigmas, rtol=1e-9)


def test_blocks_are_the_same_on_any_number_of_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    # All of the images share points: their equations are one matrix, large enough for BLAS to share it out.
    models, points = strip(40, 90, apart=0.01)
    models = {name: ImageCorrection.identity(one.model, "affine", one.origin) for name, one in models.items()}
    monkeypatch.setattr(elimination, "_SHARE", 10)
    found = []
    for threads in (1, 2, 4):
        monkeypatch.setattr(os, "cpu_count", lambda: threads)  # noqa: B023  (used within the round)
        with threadpool_limits(threads, user_api="blas"):
            fit = adjust(models, points, robust=False)
            found.append(b"".join(np.asarray(part).tobytes() for part in (
                fit.values, fit.covariance, fit.ground, fit.ground_covariance, fit.residuals, fit.sigma0,
            )))  # fmt: skip
            assert {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"} == {threads}
    assert found[1:] == found[:-1]


def test_equations_in_parts_are_those_of_the_whole(linear: Linear, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = step_of(linear)
    hats, spread = whole.points.hats(whole.solution.cofactors), whole.points.ground(whole.solution.cofactors, 1.0)
    monkeypatch.setattr(elimination, "_SHARE", 10)
    parts = step_of(linear)
    assert len(parts.points._parts) == 8
    np.testing.assert_allclose(parts.whole, whole.whole, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(parts.change.vector, whole.change.vector, rtol=0, atol=1e-9)
    # What is not summed over points is the same to the last bit.
    again = Elimination(linear)
    np.testing.assert_array_equal(again.ground(whole.solution.cofactors, 1.0), spread)
    for one, other in zip(again.hats(whole.solution.cofactors), hats, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_order_in_which_rays_are_stated_changes_no_bit() -> None:
    models, points = strip(8, 200)
    measured = points.measured.copy()
    measured[::40] += 30.0
    points = replace(points, measured=measured, sigma_image=np.linspace(0.2, 0.4, points.rays))
    shuffled = np.random.default_rng(3).permutation(points.rays)
    straight, other = adjust(models, points), adjust(models, points.of_rays(shuffled))
    assert straight.rejected == other.rejected != ()
    for name in ("values", "covariance", "ground", "ground_covariance"):
        np.testing.assert_array_equal(getattr(straight, name), getattr(other, name))
    for name in ("residuals", "back_projected", "raw_residuals", "used_rays"):
        np.testing.assert_array_equal(getattr(straight, name)[shuffled], getattr(other, name))


class OnASlope(BlockProblem):
    """A block whose ties have an observed height: they lie on a surface with a slope, 5 cm along its normal."""

    normal = np.array([0.3, -0.2, 1.0]) / np.sqrt(1.13)
    distances: np.ndarray

    def _grounded(self, selection: Selection) -> np.ndarray:
        return np.asarray(super()._grounded(selection) | self.points.tie)

    def on_points(self, local: np.ndarray, rows: np.ndarray) -> OnPoints:
        found, tie = super().on_points(local, rows), self.points.tie[rows]
        turn = np.linalg.qr(np.column_stack([self.normal, np.eye(3)[:, :2]]))[0].T[[1, 2, 0]]
        turn[2] = self.normal
        along = np.where(tie, self.distances[rows] - local[rows] @ self.normal, found.apart[:, 2])
        sigmas = np.where(tie[:, None], (np.inf, np.inf, 0.05), found.sigmas)
        axes = np.where(tie[:, None, None], turn, found.axes)
        return OnPoints(np.column_stack([found.apart[:, :2], along]), axes, sigmas)


def test_a_further_type_of_observation_of_points_needs_no_change_of_the_solver() -> None:
    models, points = strip(6, 120)
    ordered = tuple(models.values())
    frame = frame_of(ordered, points)
    known = np.where(points.control[:, None], points.ground, np.nan)
    problem, everything = OnASlope(points, ordered, frame, known), np.ones(points.rays, dtype=bool)
    local = meet(frame, ordered, points, everything)
    object.__setattr__(problem, "distances", local @ problem.normal)
    rays = np.isfinite(local).all(axis=1)[points.point]
    solved = solve(problem, State(ordered, local), Selection.of(rays, points.control))
    design, misfits = dense(solved.linear)
    assert np.abs(design.T @ misfits).max() < 1e-6 * np.abs(design.T).dot(np.abs(misfits)).max()
    whole = np.linalg.inv(design.T @ design)
    numbers, found = solved.linear.ordering.numbers, solved.points.ground(solved.cofactors, 1.0)
    own = np.arange(problem.size, len(whole)).reshape(-1, 3)
    of_points = whole[own[:, :, None], own[:, None, :]]
    np.testing.assert_allclose(found[numbers], of_points, rtol=1e-6, atol=1e-9 * of_points.max())
    ties = points.tie & np.isfinite(found).all(axis=(1, 2))
    assert (np.sqrt(problem.normal @ found[ties] @ problem.normal) < 0.05).all()
    assert solved.unit_weight()[1] == pytest.approx(np.abs(design).any(axis=1).sum() - design.shape[1])
