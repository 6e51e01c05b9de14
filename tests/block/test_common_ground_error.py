"""An error that known ground shares: its start by other ground, what it leaves of misfits, and what tells of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chains import ORIGIN, Block, Chain, dense, fly, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.problem import Pseudo, Selection
from ortho_pipeline.block.equations.solver import attempt
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.shared import common_error
from ortho_pipeline.block.shared.common_error import BlockCommonError
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import SensorModel

#: Standard deviations (m) of what known ground shares, of the first twelve control points; the others are surveyed.
SIGMAS = np.array([2.0, 4.0, 1.0] * 4)


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=3, convergence_deg=20.0, ties=50, errors=1.0, noise=1e-3, pairwise=False), 3)


def off_by(flown: Block, error: tuple[float, float], surveyed: int = 5) -> tuple[BlockPoints, np.ndarray]:
    """Return control of which twelve points are off by so many of their sigmas, and which these are."""
    points = with_control(flown, "i1", 12 + surveyed, sigma=1e-3)
    rows = np.flatnonzero(points.control)
    ground, shared = points.ground.copy(), np.zeros(len(points))
    shared[rows[:12]] = SIGMAS
    # On the central meridian a metre of the map is 1 / 0.9996 m on the ground.
    ground[:, :2] += 0.9996 * shared[:, None] * error
    sigmas = np.where(points.sigma_ground > 0, 0.02, 0.0)
    return replace(points, ground=ground, sigma_common=shared, sigma_ground=sigmas), rows[:12]


def prepared(models: Mapping[str, SensorModel], points: BlockPoints) -> tuple[Any, Any, Selection]:
    return _prepared(tuple(models.values()), points, {}, ())


@pytest.mark.parametrize("error", [(1.5, -0.7), (-3.9, 0.4)])
def test_it_starts_where_the_median_of_other_ground_sees_it(flown: Block, error: tuple[float, float]) -> None:
    """One surveyed point is wrong by 30 m, and one has no height: neither is the median."""
    points, rows = off_by(flown, error)
    others = np.flatnonzero(points.control & (points.sigma_common == 0))
    ground = points.ground.copy()
    ground[others[1], 0] += 30.0
    ground[others[2]] += (500.0, 500.0, np.nan)
    found = BlockCommonError.of(*prepared(flown.start, replace(points, ground=ground)))
    assert found is not None
    assert (found.sigma, found.points) == (4.0, len(rows))
    np.testing.assert_allclose(found.value, error, atol=0.05)
    np.testing.assert_array_equal(found.sigmas[rows], SIGMAS)


def test_an_error_of_more_than_four_sigmas_is_not_believed(flown: Block) -> None:
    for error, believed in (((3.9, -3.9), True), ((4.1, 0.5), False), ((0.5, -4.1), False)):
        found = BlockCommonError.of(*prepared(flown.start, off_by(flown, error)[0]))
        assert found is not None
        np.testing.assert_allclose(found.value, error if believed else (0.0, 0.0), atol=0.05)


def test_it_starts_at_zero_if_nothing_else_sees_it(flown: Block) -> None:
    points, _ = off_by(flown, (1.5, -0.7), surveyed=0)
    found = BlockCommonError.of(*prepared(flown.start, points))
    assert found is not None
    np.testing.assert_array_equal(found.value, 0.0)
    # Nor if the ground that shares it does not determine the images.
    points, rows = off_by(flown, (1.5, -0.7))
    problem, state, selection = prepared(flown.start, points)
    few = replace(selection, ground=selection.ground & ~np.isin(np.arange(len(points)), rows[:12]))
    assert BlockCommonError.of(problem, state, few) is None
    nowhere = replace(state, local=np.full_like(state.local, np.nan))
    found = BlockCommonError.of(problem, nowhere, selection)
    assert found is not None
    np.testing.assert_array_equal(found.value, 0.0)


@pytest.mark.parametrize("how", [{"converged": False}, {"condition": 2e16}, {}])
def test_it_starts_at_zero_if_its_own_ground_does_not_determine_the_images(
    flown: Block, monkeypatch: pytest.MonkeyPatch, how: dict[str, Any]
) -> None:
    class Made:
        def __init__(self, solved: Any) -> None:
            self.solved = solved

        def __getattr__(self, name: str) -> Any:
            return how.get(name, getattr(self.solved, name))

    monkeypatch.setattr(common_error, "attempt", lambda *given: Made(attempt(*given)))
    found = BlockCommonError.of(*prepared(flown.start, off_by(flown, (1.5, -0.7))[0]))
    assert found is not None
    np.testing.assert_allclose(found.value, (0.0, 0.0) if how else (1.5, -0.7), atol=0.05)


def test_only_ground_that_takes_part_shares_it(flown: Block) -> None:
    points, rows = off_by(flown, (1.5, -0.7))
    problem, state, selection = prepared(flown.start, points)
    # Two points are left out, and one has no ray.
    ground, rays = selection.ground.copy(), selection.rays.copy()
    ground[rows[:2]] = False
    rays[points.point == rows[5]] = False
    some = replace(selection, ground=ground, rays=rays)
    found = BlockCommonError.of(problem, state, some)
    assert found is not None
    assert found.points == 9
    solved = attempt(problem, state, some)
    _, settled = found.settled(solved, some)
    assert settled.points == 9
    # Without parameters there is nothing that could be off.
    fixed = {name: ImageCorrection.identity(one.model, "none", ORIGIN) for name, one in flown.start.items()}
    assert BlockCommonError.of(*prepared(fixed, points)) is None


def test_what_it_leaves_of_misfits_is_that_of_the_dense_problem(flown: Block) -> None:
    points, _ = off_by(flown, (1.5, -0.7))
    problem, state, selection = prepared(flown.start, points)
    problem = problem.with_pseudo([Pseudo(1, 0.4, 0.5)])
    selection = replace(selection, ground_weights=np.random.default_rng(1).uniform(0.2, 1.0, len(points)))
    error = BlockCommonError.of(problem, state, selection)
    assert error is not None
    solved = attempt(problem, state, selection)
    found, left = error._moving(solved)
    linear = solved.linear
    design, _ = dense(linear)
    rays, count = linear.ordering.rays, 2 * len(linear.ordering.rays)
    columns = np.zeros((len(design), 2))
    for number, point in enumerate(linear.ordering.grounded.tolist()):
        sigma = 0.02 / np.sqrt(selection.ground_weights[point])
        columns[count + 3 * number : count + 3 * number + 2] = np.eye(2) * points.sigma_common[point] / sigma
    step = np.linalg.solve(design.T @ design, design.T @ columns)
    wanted = columns - design @ step
    np.testing.assert_allclose(found.seen[rays], wanted[:count].reshape(-1, 2, 2), atol=1e-6 * np.abs(columns).max())
    np.testing.assert_allclose(left.T @ left, wanted.T @ wanted, rtol=1e-6)
    np.testing.assert_allclose(found.by_params, -step[: problem.size], rtol=1e-5, atol=1e-9)


def test_it_is_estimated_as_one_more_pair_of_unknowns(flown: Block) -> None:
    """The known ground without the estimate is where it truly is; what the points say of it is its sigma."""
    error = (1.5, -0.7)
    points, rows = off_by(flown, error)
    problem, state, selection = prepared(flown.start, points)
    start = BlockCommonError.of(problem, state, selection)
    assert start is not None
    solved, found = start.settled(attempt(start.applied(problem), state, selection), selection)
    # Five surveyed points of 0.02 m leave of it some thousandths of its sigmas.
    np.testing.assert_allclose(found.value, error, atol=0.02)
    assert (np.sqrt(np.diag(found.left)) < 0.02).all()
    truth = replace(points, ground=np.where(points.control[:, None], flown.ground, np.nan))
    known = prepared(flown.start, truth)[0].known
    off = (solved.problem.known - known)[rows, :2] * metres_per_degree(known[rows])
    np.testing.assert_allclose(off, 0.0, atol=0.08)
    assert found._is_told(solved, selection)


def test_it_is_told_by_one_surveyed_point_or_by_a_prior(flown: Block) -> None:
    points, rows = off_by(flown, (1.5, -0.7))
    problem, state, selection = prepared(flown.start, points)
    found = BlockCommonError.of(problem, state, selection)
    assert found is not None
    others = np.setdiff1d(np.flatnonzero(points.control), rows)
    alone = replace(selection, ground=selection.ground & (points.sigma_common > 0))
    with_one = replace(alone, ground=alone.ground | (np.arange(len(points)) == others[0]))
    held = problem.with_pseudo([Pseudo(1, 0.0, 0.5)])
    for known, some, told in ((problem, alone, False), (problem, with_one, True), (held, alone, True)):
        started = replace(found, value=np.zeros(2))
        solved = attempt(known, state, some)
        assert started._is_told(solved, some) is told
        after = started.settled(solved, some)[1]
        assert bool(after.told.any()) is told
        assert bool(after.value.any()) is told
        if not told:
            np.testing.assert_array_equal(after.left, np.eye(2))
    # A surveyed point without a ray tells nothing.
    unseen = replace(with_one, rays=with_one.rays & (points.point != others[0]))
    assert not found._is_told(attempt(problem, state, unseen), unseen)


def test_ground_is_corrected_along_both_axes_even_if_one_part_is_zero(flown: Block) -> None:
    points, rows = off_by(flown, (0.0, 0.0))
    problem, state, selection = prepared(flown.start, points)
    found = BlockCommonError.of(problem, state, selection)
    assert found is not None
    for value in ((0.0, 1.2), (-0.8, 0.0)):
        moved = replace(found, value=np.array(value)).applied(problem)
        off = (problem.known - moved.known)[:, :2] * metres_per_degree(np.nan_to_num(problem.known))
        np.testing.assert_allclose(off[rows], SIGMAS[:, None] * value, atol=1e-6)
        surveyed = points.control & (points.sigma_common == 0)
        np.testing.assert_array_equal(moved.known[surveyed], problem.known[surveyed])
    assert replace(found, value=np.zeros(2)).applied(problem) is problem
