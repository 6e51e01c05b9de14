"""Errors that heights of a DEM share, as further columns of one dense least-squares problem."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chains import Chain, dem, dense, fly, with_control

from ortho_pipeline.block.adjustment import _prepared, adjust
from ortho_pipeline.block.equations.problem import Selection
from ortho_pipeline.block.equations.solver import Solved, attempt
from ortho_pipeline.block.heights.record import record_of
from ortho_pipeline.block.heights.settling import Heights
from ortho_pipeline.block.heights.source import DemHeights


@pytest.fixture(scope="module")
def settled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Solved, Selection, Heights]:
    """Control in one of three images, and ties with heights of different weights; some heights are left out."""
    block = fly(Chain(images=3, convergence_deg=10.0, ties=50, errors=1.0), 2)
    surface = dem(block, Path(tmp_path_factory.mktemp("dem")) / "dem.tif", 2, white=1.0, bias=3.0).with_sigma(1.5)
    source = DemHeights(surface, bias=4.0, shift=6.0, correlation=150.0)
    problem, state, selection = _prepared(tuple(block.start.values()), with_control(block, count=5), {}, (), source)
    heights = Heights.under(source, problem, state.local)
    wrong = np.arange(len(state.local)) % 11 == 3
    heights = replace(heights, wrong=wrong & heights.of)
    weights = np.random.default_rng(3).uniform(0.3, 1.0, len(wrong))
    selection = replace(selection, ground_weights=weights)
    return attempt(heights.applied(problem), state, selection), selection, heights


def test_a_filled_height_is_no_observation(tmp_path: Path) -> None:
    surface = dem(fly(Chain(images=3, convergence_deg=10.0, ties=50, errors=1.0), 2), tmp_path / "dem.tif", 2)
    for fill in ("mask", "nearest", 12.0):
        assert np.isnan(DemHeights(surface.with_fill(fill)).surface.heights([[0.0, 0.0]])).all()


def test_they_are_unknowns_of_the_block(settled: tuple[Solved, Selection, Heights]) -> None:
    solved, _, heights = settled
    linear, planes = solved.linear, solved.problem.heights
    assert planes is not None
    common, slope = heights.common.with_slopes(heights.terrain.slopes, heights.source.shift_sigma).moved_by(solved)
    np.testing.assert_array_equal(heights.common.loads[:, 0], 4.0)
    design, misfits = dense(linear)
    grounded, rays = linear.ordering.grounded, linear.ordering.rays
    columns = np.zeros((len(design), len(common.value)))
    used = grounded[planes.on[grounded]]
    for number, point in enumerate(grounded.tolist()):
        if planes.on[point]:
            # What one standard deviation takes off a height, along the normal of its plane.
            up = solved.problem.frame.enu_at(solved.problem.frame.geodetic(linear.state.local[[point]]))[0, 2]
            along = planes.axes[point, 2] @ up
            sigma = planes.sigmas[point] / np.sqrt(linear.weights.ground_weights[point])
            columns[2 * len(rays) + 3 * number + 2] = common.loads[point] * along / sigma
    assert common.points == len(used) > 25
    prior = np.hstack([np.zeros((columns.shape[1], design.shape[1])), np.eye(columns.shape[1])])
    whole = np.vstack([np.hstack([design, columns]), prior])
    cofactors = np.linalg.inv(whole.T @ whole)
    size, count = solved.problem.size, len(common.value)
    np.testing.assert_allclose(common.left, cofactors[-count:, -count:], atol=1e-8)
    of_params = solved.cofactors.matrix + common.by_params @ common.left @ common.by_params.T
    np.testing.assert_allclose(of_params, cofactors[:size, :size], rtol=1e-6, atol=1e-10)
    own = size + np.arange(design.shape[1] - size).reshape(-1, 3)
    places = cofactors[own[:, :, None], own[:, None, :]]
    numbers = linear.ordering.numbers
    enu = solved.problem.frame.enu_at(solved.problem.frame.geodetic(linear.state.local[numbers]))
    known = solved.ground_covariance(solved.cofactors, 1.0)[numbers] + common.of_points[numbers]
    np.testing.assert_allclose(known, enu @ places @ enu.swapaxes(1, 2), rtol=1e-5, atol=1e-6)
    # The best estimate, and how parameters and points follow it.
    best = cofactors @ (whole.T @ np.concatenate([misfits, np.zeros(count)]))
    step = common.step(slope)
    np.testing.assert_allclose(step, best[-count:], atol=1e-6)
    np.testing.assert_allclose(common.by_params @ step, best[:size], atol=1e-6)
    moved = replace(common, value=step).followed(common, solved)
    np.testing.assert_allclose((moved.local - solved.state.local)[numbers].ravel(), best[size:-count], atol=1e-5)
    np.testing.assert_allclose(moved.params - solved.state.params, best[:size], atol=1e-6)


def test_the_record_counts_every_tie_once(settled: tuple[Solved, Selection, Heights]) -> None:
    solved, _, heights = settled
    broken = np.arange(len(heights.of)) % 11 == 4
    heights = replace(heights, broken=broken)
    solved = attempt(heights.applied(solved.problem), solved.state, settled[1])
    planes, points = solved.problem.heights, solved.problem.points
    assert planes is not None
    found = record_of(heights, solved)
    on = np.flatnonzero(planes.on)
    assert found.used == len(on)
    assert found.left_out == tuple(points.ids[k] for k in np.flatnonzero(heights.of & heights.wrong))
    assert found.at_breaks == int((heights.of & broken).sum())
    assert found.used + len(found.left_out) + found.at_breaks + found.on_water + found.without == heights.of.sum()
    apart = planes.above(solved.state.local)[on]
    assert found.rms_m == pytest.approx(np.sqrt(np.mean(apart**2)))
    assert (found.sigma_m, found.sigma_is) == (pytest.approx(1.5), "stated")
    assert (found.bias_prior_m, found.shift_prior_m, found.correlation_m) == (4.0, 6.0, 150.0)
    assert found.bias_sigma_m == pytest.approx(4.0)
    assert found.shift_sigma_m == pytest.approx((6.0, 6.0))
    larger = record_of(replace(heights, scale=2.0), solved)
    assert (larger.sigma_m, larger.sigma_is) == (pytest.approx(3.0), "enlarged")


@pytest.mark.parametrize(("stated", "says"), [(3.0, "contradicted"), (8.0, "stated")])
def test_a_sigma_of_correlated_errors_that_ties_contradict_is_named(stated: float, says: str, tmp_path: Path) -> None:
    """It is not enlarged, so the figures of the report are too small."""
    block = fly(Chain(images=3, ties=90, errors=5.0, normal=True), 1)
    surface = dem(block, tmp_path / "dem.tif", 1, correlated=9.0, length=100.0).with_sigma(stated)
    heights = DemHeights(surface, bias=0.0, shift=0.0, correlation=100.0)
    found = adjust(block.start, block.points, heights=heights, hold=5.0).heights
    assert found is not None
    assert (found.sigma_is, found.sigma_m) == (says, stated)
    assert [one.code for one in found.notices()] == ["dem-sigma-contradicted"] * (says == "contradicted")


def test_residuals_of_heights_vary_as_in_a_dense_problem(settled: tuple[Solved, Selection, Heights]) -> None:
    """Of a height that takes part, less than it does; of one that was left out, more."""
    solved, selection, heights = settled
    equal = Selection.of(selection.rays, selection.ground)
    heights = replace(heights, own=np.ones(len(heights.of)))
    problem = heights.applied(solved.problem)
    solved = attempt(problem, solved.state, equal)
    planes = solved.problem.heights
    assert planes is not None
    residuals, variances, taking = heights._residuals(solved, solved.state.local)
    design, misfits = dense(solved.linear)
    cofactors = np.linalg.inv(design.T @ design)
    rays, grounded = 2 * len(solved.linear.ordering.rays), solved.linear.ordering.grounded
    every = heights._planes(solved.problem, heights.of)
    frame, numbers = solved.problem.frame, solved.linear.ordering.numbers
    for point in range(len(heights.of)):
        if not heights.of[point]:
            assert (residuals[point], variances[point]) == (0.0, np.inf)
            continue
        up = frame.enu_at(frame.geodetic(solved.state.local[[point]]))[0, 2]
        upright = every.axes[point, 2] @ up
        if planes.on[point]:
            row = rays + 3 * int(np.flatnonzero(grounded == point)[0]) + 2
            assert residuals[point] == pytest.approx(misfits[row] * 1.5, rel=1e-3, abs=1e-6)
            assert variances[point] == pytest.approx(1.5**2 * (1 - design[row] @ cofactors @ design[row]), rel=1e-3)
        else:
            assert not taking[point]
            begin = solved.problem.size + 3 * int(np.flatnonzero(numbers == point)[0])
            own = cofactors[begin : begin + 3, begin : begin + 3]
            normal = every.axes[point, 2]
            assert variances[point] == pytest.approx(1.5**2 + normal @ own @ normal / upright**2, rel=1e-3)
    assert taking.sum() == planes.on.sum()
