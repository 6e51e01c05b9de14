"""The minimum of a block: what is minimised, by hand; that it is the least; its redundancy, by a dense hat matrix."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
from chains import ORIGIN, Block, Chain, dense, fly, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.elimination import Step
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Misfits, Pseudo, Selection, State
from ortho_pipeline.block.equations.solver import EXACT, Solved, attempt, once
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.reliability.standardised_residuals import standardise, standardise_ground
from ortho_pipeline.errors import NotConverged
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.models import ImageCorrection

Prepared = tuple[BlockProblem, State, Selection]
KINDS = ("affine", "shift", "none", "shift-drift")


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=4, convergence_deg=15.0, overlap=0.7, ties=60, errors=2.0, pairwise=False), 4)


@pytest.fixture(scope="module")
def prepared(flown: Block) -> Prepared:
    """Return a block with all that is observed: other sigmas and weights of each ray, priors, and heights of a DEM."""
    points = with_control(flown, "i1", count=9, sigma=0.2)
    random = np.random.default_rng(1)
    root = random.normal(size=(points.rays, 2, 2)) + 2 * np.eye(2)
    shape = root @ root.swapaxes(1, 2)
    shape *= 2 / np.trace(shape, axis1=1, axis2=2)[:, None, None]
    points = replace(
        points, sigma_image=random.uniform(0.1, 0.4, points.rays), shape_image=shape,
        sigma_ground=random.uniform(0.1, 0.5, points.sigma_ground.shape) * points.control[:, None],
    )  # fmt: skip
    models = [ImageCorrection.identity(one.model, kind, ORIGIN) for one, kind in
              zip(flown.start.values(), KINDS, strict=True)]  # fmt: skip
    problem, state, selection = _prepared(tuple(models), points, {}, ())
    known = problem.known.copy()
    known[np.flatnonzero(points.control)[:3], 2] = np.nan
    pseudo = (Pseudo(1, 2e-3, 5e-3), Pseudo(4, 1e-3, 4e-3, held=True), Pseudo(6, 0.5, 1.5, held=True, slow=0.01),
              Pseudo(9, -0.002, 5e-3))  # fmt: skip
    problem = replace(problem, known=known, pseudo=pseudo)
    weighed = replace(
        selection, ray_weights=random.uniform(0.3, 1.0, points.rays), ground_weights=random.uniform(0.3, 1, len(points))
    )
    count, tilt = len(points), np.linalg.qr(np.eye(3) + 0.2 * random.normal(size=(3, 3)))[0]
    on = points.tie & (random.random(count) < 0.7)
    first = np.flatnonzero(points.control)[0]
    on[first] = True
    axes = np.tile(tilt, (count, 1, 1))
    # Known in plan: what is observed of its height is along its own up.
    axes[first] = problem.enu[first]
    planes = Planes(
        state.local + random.normal(0, 1, (count, 3)), axes,
        np.where(on, random.uniform(0.5, 2.0, count), np.inf),
    )  # fmt: skip
    return problem.with_heights(planes), state, weighed


def squares(problem: BlockProblem, state: State, weights: Selection) -> float:
    """Return the sum of all squares over their covariances, observation by observation."""
    points, planes, total = problem.points, problem.heights, 0.0
    assert planes is not None
    for model, rays in zip(state.models, points.rays_of_images, strict=True):
        places = problem.frame.places(state.local).in_crs(model.crs)[points.point[rays]]
        for ray, seen in zip(rays, model.ground_to_image(places), strict=True):
            off = points.measured[ray] - seen
            total += weights.ray_weights[ray] * off @ np.linalg.solve(points.covariance_image[ray], off)
    for k in range(len(points)):
        off = np.zeros(3)
        if points.control[k]:
            place = np.where(np.isfinite(problem.known[k]), problem.known[k], (0, 0, 0.0))[None]
            off = problem.frame.apart(place, state.local[k : k + 1])[0] / points.sigma_ground[k]
            off[~np.isfinite(problem.known[k])] = 0.0
        if planes.on[k]:
            off[2] = planes.axes[k, 2] @ (planes.places[k] - state.local[k]) / planes.sigmas[k]
        total += weights.ground_weights[k] * off @ off
    firm = 1 + 0.01**2 * (points.sigma_image[points.image == 1] ** -2.0).sum()
    for one in problem.pseudo:
        total += (firm if one.slow else 1.0) * ((one.mean - state.params[one.column]) / one.sigma) ** 2
    return total


def test_what_is_minimised_is_the_weighted_sum_of_all_squares(prepared: Prepared) -> None:
    problem, state, weights = prepared
    random = np.random.default_rng(5)
    scale = np.where(np.isin(np.arange(problem.size), (0, 3, 6, 7, 8, 11)), 1.0, 1e-3)
    assert problem.size == len(scale) == 12
    away = state.moved(scale * random.normal(size=12), random.normal(0, 2.0, state.local.shape))
    wanted = squares(problem, away, weights)
    assert problem.square(away, weights) == pytest.approx(wanted, rel=1e-9)
    linear = Linear.at(problem, away, weights)
    assert linear.misfits.square == pytest.approx(wanted, rel=1e-9)
    assert linear.misfits.square == pytest.approx(float(linear.misfits.vector @ linear.misfits.vector))
    # Weights that are changed later are those that are there at once.
    plain = Selection.of(weights.rays, weights.ground)
    less = replace(plain, ray_weights=0.5 * plain.ray_weights, ground_weights=0.25 * plain.ground_weights)
    again = Linear.at(problem, away, plain).reweighted(less).reweighted(weights)
    for name in ("by_params", "by_point", "ground_by_point"):
        np.testing.assert_allclose(getattr(again, name), getattr(linear, name), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(again.misfits.vector, linear.misfits.vector, rtol=1e-10, atol=1e-12)


def test_partials_are_differences_of_the_misfits(prepared: Prepared) -> None:
    problem, state, weights = prepared
    linear = Linear.at(problem, state, weights)
    random = np.random.default_rng(6)
    step = random.normal(size=problem.size) * np.where(np.isin(np.arange(12), (0, 3, 6, 7, 8, 11)), 1.0, 1e-3)
    shift = random.normal(size=state.local.shape)
    ends = [Linear.at(problem, state.moved(way * step, way * shift), weights).misfits.vector for way in (1e-3, -1e-3)]
    design, _ = dense(linear)
    numbers, rays = linear.ordering.numbers, linear.ordering.rays
    found = design @ np.concatenate([step, shift[numbers].ravel()])
    rows = np.concatenate([
        (2 * rays[:, None] + np.arange(2)).ravel(),
        2 * problem.points.rays + (3 * linear.ordering.grounded[:, None] + np.arange(3)).ravel(),
        2 * problem.points.rays + 3 * len(problem.points) + np.arange(len(problem.pseudo)),
    ])  # fmt: skip
    np.testing.assert_allclose(found, ((ends[1] - ends[0]) / 2e-3)[rows], rtol=1e-5, atol=1e-5)


def test_the_minimum_has_no_slope_in_any_direction(prepared: Prepared) -> None:
    problem, state, weights = prepared
    solved = attempt(problem, state, weights, EXACT)
    assert solved.converged
    least = problem.square(solved.state, weights)
    design, _ = dense(solved.linear)
    random = np.random.default_rng(7)
    size, numbers = problem.size, solved.linear.ordering.numbers
    for _ in range(4):
        # As far in each unknown as raises the sum by about one.
        drawn = np.asarray(random.normal(size=design.shape[1]))
        whole = drawn / np.linalg.norm(design @ drawn)
        shift = np.zeros(state.local.shape)
        shift[numbers] = whole[size:].reshape(-1, 3)
        rises = [
            problem.square(solved.state.moved(way * whole[:size], way * shift), weights) - least for way in (1, -1)
        ]
        assert rises == pytest.approx([1.0, 1.0], abs=0.01)


def test_redundancy_is_that_of_true_observations_without_heights_of_a_surface(prepared: Prepared) -> None:
    """By the diagonal of one minus the hat matrix, row by row."""
    problem, state, weights = prepared
    solved = attempt(problem, state, weights)
    linear = solved.linear
    design, misfits = dense(linear)
    shares = 1.0 - np.diag(design @ np.linalg.pinv(design))
    planes, ordering = problem.heights, linear.ordering
    assert planes is not None
    observed = np.ones((len(ordering.grounded), 3), dtype=bool)
    control = problem.points.control[ordering.grounded]
    observed[~control, :2] = False
    observed[control, 2] = np.isfinite(problem.known[ordering.grounded[control], 2])
    observed[planes.on[ordering.grounded], 2] = False
    true = np.concatenate([np.ones(2 * len(ordering.rays), dtype=bool), observed.ravel(), [True, False, False, True]])
    sigma0, freedom = solved.unit_weight()
    assert freedom == pytest.approx(shares[true].sum(), rel=1e-8)
    assert sigma0 == pytest.approx(np.sqrt((misfits[true] ** 2).sum() / shares[true].sum()), rel=1e-8)
    rows, hats = solved.heights
    assert set(rows.tolist()) == set(np.flatnonzero(planes.on).tolist())
    place = 2 * len(ordering.rays) + 3 * np.flatnonzero(planes.on[ordering.grounded]) + 2
    np.testing.assert_allclose(hats, 1.0 - shares[place], atol=1e-9)


def test_residuals_are_standardised_by_their_parts_of_the_redundancy(prepared: Prepared) -> None:
    """By the eigenvalues of the dense redundancy matrix above a hundredth; weights are those of the search."""
    problem, state, weights = prepared
    solved = attempt(problem, state, weights)
    linear, found = solved.linear, standardise(solved)
    design, misfits = dense(linear)
    redundancy = np.eye(len(design)) - design @ np.linalg.pinv(design)

    def square(rows: np.ndarray) -> tuple[float, int]:
        shares, axes = np.linalg.eigh(redundancy[np.ix_(rows, rows)])
        along, known = axes.T @ misfits[rows], shares > 0.01
        return float((along[known] ** 2 / shares[known]).sum()), int(known.sum())

    for k, ray in enumerate(linear.ordering.rays):
        wanted, rank = square(2 * k + np.arange(2))
        assert found.rays[ray] == pytest.approx(wanted / weights.ray_weights[ray], rel=1e-6, abs=1e-9)
        assert found.ray_rank[ray] == rank
    alone = standardise_ground(solved)
    for k, point in enumerate(linear.ordering.grounded):
        rows = 2 * len(linear.ordering.rays) + 3 * k + np.arange(3)
        # An unknown height is no observation, so it has no redundancy.
        wanted, rank = square(rows[design[rows].any(axis=1)])
        assert alone[0][point] == pytest.approx(wanted, rel=1e-6, abs=1e-9)
        assert found.ground[point] == pytest.approx(wanted / weights.ground_weights[point], rel=1e-6, abs=1e-9)
        if problem.points.control[point]:
            assert found.ground_rank[point] == alone[1][point] == rank
    # Heights of a surface are no part of this test.
    assert not found.ground_rank[~problem.points.control].any()


def test_covariances_of_the_ground_are_along_east_north_and_up_of_each_point() -> None:
    """Thousand kilometres from the middle of the frame, where up is another direction."""
    random = np.random.default_rng(8)
    frame = GroundFrame(np.array([12.0, 41.0, 0.0]))
    ground = np.array([[20.0, 47.0, 300.0], [3.0, 38.0, 50.0]])
    root = random.normal(size=(2, 3, 3))
    covariance = root @ root.swapaxes(1, 2)
    asked: list[Any] = []

    def of_points(*given: Any) -> np.ndarray:
        asked.append(given)
        return covariance

    made: Any = SimpleNamespace(
        points=SimpleNamespace(ground=of_points), problem=SimpleNamespace(frame=frame),
        state=SimpleNamespace(local=frame.of_geodetic(ground)),
    )  # fmt: skip
    found = Solved.ground_covariance(made, "of the parameters", 2.5)  # type: ignore[arg-type]
    assert asked == [("of the parameters", 2.5)]
    for k, (lon, lat, h) in enumerate(ground.tolist()):
        turns = []
        for at in ((12.0, 41.0, 0.0), (lon, lat, h)):
            way = pyproj.Transformer.from_pipeline(
                f"+proj=topocentric +ellps=WGS84 +lon_0={at[0]} +lat_0={at[1]} +h_0={at[2]}"
            )
            ends = np.column_stack(way.transform(*(np.array([[0, 0, 0], [1e6, 0, 0], [0, 1e6, 0], [0, 0, 1e6]]).T)))
            turns.append((ends[1:] - ends[0]).T / 1e6)
        turn = turns[1] @ turns[0].T
        np.testing.assert_allclose(found[k], turn @ covariance[k] @ turn.T, atol=1e-8)


def test_an_open_block_is_beyond_the_limit_whatever_its_equations_are() -> None:
    for condition, wanted in ((10.0, 1.01 * CONDITION_LIMIT), (1e9, 1e9)):
        step: Any = SimpleNamespace(condition=condition)
        assert Solved(None, step, undetermined=True).condition == pytest.approx(wanted)  # type: ignore[arg-type]
        assert Solved(None, step).condition == condition  # type: ignore[arg-type]


def test_one_step_leaves_what_it_does_not_take_off(prepared: Prepared) -> None:
    problem, state, weights = prepared
    linear = Linear.at(problem, state, weights)
    design, misfits = dense(linear)
    step = np.linalg.lstsq(design, misfits, rcond=None)[0]
    (solved, ahead), size = once(linear), problem.size
    found = dense(replace(linear, misfits=solved.linear.misfits))[1]
    np.testing.assert_allclose(found, misfits - design @ step, rtol=0, atol=1e-7)
    assert isinstance(solved.step, Step)
    np.testing.assert_allclose(ahead.state.params - state.params, step[:size], rtol=1e-7, atol=1e-10)
    moved = (ahead.state.local - state.local)[linear.ordering.numbers]
    np.testing.assert_allclose(moved.ravel(), step[size:], rtol=1e-6, atol=1e-8)


def test_states_and_selections_change_where_they_are_told() -> None:
    class Plain(SimpleNamespace):
        def with_params(self, params: np.ndarray) -> Plain:
            return Plain(params=params)

    models: Any = (
        Plain(params=np.array([1.0, 2.0])),
        Plain(params=np.zeros(0)),
        Plain(params=np.array([3.0, 4.0, 5.0])),
    )
    state = State(models, np.full((2, 3), 10.0))
    moved = state.moved(np.array([0.1, 0.2, 0.3, 0.4, 0.5]), np.array([[1.0, 2.0, 3.0], [-1.0, -2.0, -3.0]]))
    assert moved.params == pytest.approx([1.1, 2.2, 3.3, 4.4, 5.5])
    assert moved.models[1] is models[1]
    assert moved.local.tolist() == [[11.0, 12.0, 13.0], [9.0, 8.0, 7.0]]
    selection = Selection.of(np.array([True, True, False, True, True]), np.array([True, False, True]))
    less = selection.without(np.array([False, False, True]), np.array([0, 2, 2, 1, 2]))
    assert less.rays.tolist() == [True, False, False, True, False]
    assert less.ground.tolist() == [True, False, False]
    one, other = (Misfits(np.full((1, 2), a), np.full((1, 3), b), np.array([c])) for a, b, c in ((5, 3, 2), (1, 7, 4)))
    assert one.minus(other).vector.tolist() == [4.0, 4.0, -4.0, -4.0, -4.0, -2.0]
    assert one.square == 2 * 25 + 3 * 9 + 4


@pytest.mark.parametrize(("away", "enough"), [(0, True), (30, True), (31, False)])
def test_points_that_start_behind_the_cameras_take_part_again(prepared: Prepared, away: int, enough: bool) -> None:
    """Up to half of sixty; those that start nowhere may be any number."""
    problem, state, weights = prepared
    assert problem.active(weights).all()
    wanted, local = attempt(problem, state, weights), state.local.copy()
    order = np.argsort(np.arange(60) * 37 % 60)
    local[order[:away], 2] += 1e5
    if not enough:
        with pytest.raises(NotConverged, match="outside of the models"):
            attempt(problem, replace(state, local=local), weights)
        return
    if not away:
        # Of some only one coordinate is unknown.
        local[order[:40]], local[order[40:45], 1] = np.nan, np.nan
    found = attempt(problem, replace(state, local=local), weights)
    assert found.converged
    assert found.astray is None
    assert found.linear.ordering.points == 60
    np.testing.assert_allclose(found.state.params, wanted.state.params, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.state.local, wanted.state.local, rtol=0, atol=1e-4)
    assert found.iterations > 1


def test_a_point_that_no_model_shows_is_left_out(prepared: Prepared) -> None:
    """A tie whose rays miss each other by half an image meets nowhere near: the others are as without it."""
    problem, state, weights = prepared
    points = problem.points
    tie = int(np.flatnonzero(points.tie & (np.bincount(points.point) == 2))[0])
    mine = np.flatnonzero(points.point == tie)
    measured = points.measured.copy()
    measured[mine[0]] += (-4000.0, 10.0)
    moved = replace(problem, points=replace(points, measured=measured)).with_heights(None)
    local = state.local.copy()
    local[tie] = np.nan
    found = attempt(moved, replace(state, local=local), weights)
    others = np.arange(len(points)) != tie
    wanted = attempt(moved, state, weights.without(~others, points.point))
    assert found.converged
    assert found.astray is not None
    assert np.flatnonzero(found.astray).tolist() == [tie]
    kept = found.without_astray(weights)
    np.testing.assert_array_equal(kept.rays, weights.rays & others[points.point])
    np.testing.assert_array_equal(kept.ground, weights.ground & others)
    np.testing.assert_allclose(found.state.params, wanted.state.params, rtol=0, atol=1e-6)
