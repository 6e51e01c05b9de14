"""An error of known ground, and parameters that images share, as further columns of one dense problem."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from chains import Block, Chain, dem, dense, fly, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.solver import Solved, attempt
from ortho_pipeline.block.heights.adjusted_dem import AdjustedDem
from ortho_pipeline.block.heights.common_heights import CommonHeights
from ortho_pipeline.block.heights.settling import Heights
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.shared.common_error import BlockCommonError
from ortho_pipeline.block.shared.priors import SharedPriors
from ortho_pipeline.block.shared.unknowns import SharedUnknowns
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree

if TYPE_CHECKING:
    from ortho_pipeline.block.heights.record import HeightsRecord


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=3, convergence_deg=10.0, ties=40, errors=1.0), 2)


def with_columns(
    solved: Solved, columns: np.ndarray, values: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return cofactors and best steps of all unknowns with further ones of variance 1 and their values, and the design.

    Values are zero if they are not given.
    """
    design, misfits = dense(solved.linear)
    count = columns.shape[1]
    known = np.zeros(count) if values is None else values
    whole = np.vstack([np.hstack([design, columns]), np.eye(count, design.shape[1] + count, design.shape[1])])
    cofactors = np.linalg.inv(whole.T @ whole)
    return cofactors, cofactors @ (whole.T @ np.concatenate([misfits, -known])), design


def test_an_error_of_known_ground_is_a_pair_of_unknowns(flown: Block) -> None:
    points = with_control(flown, "i1", count=8, sigma=0.2)
    control = np.flatnonzero(points.control)
    common = np.zeros(len(points))
    common[control[:4]] = 1.5, 1.5, 3.0, 1.5
    points = replace(points, sigma_common=common)
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, ())
    selection = replace(selection, ground_weights=np.random.default_rng(1).uniform(0.5, 1.0, len(points)))
    error = BlockCommonError.of(problem, state, selection)
    assert error is not None
    assert (error.sigma, error.points) == (3.0, 4)
    solved = attempt(problem, state, selection)
    found, left = error._moving(solved)
    assert found._is_told(solved, selection)
    linear = solved.linear
    (design, _), rays = dense(linear), 2 * len(linear.ordering.rays)
    columns = np.zeros((len(design), 2))
    for number, point in enumerate(linear.ordering.grounded.tolist()):
        sigma = 0.2 / np.sqrt(linear.weights.ground_weights[point])
        columns[rays + 3 * number : rays + 3 * number + 2] = np.eye(2) * common[point] / sigma
    cofactors, best, _ = with_columns(solved, columns)
    found = replace(found, told=left.T @ left, value=np.zeros(2))
    np.testing.assert_allclose(found.left, cofactors[-2:, -2:], rtol=1e-6, atol=1e-10)
    size, numbers = problem.size, linear.ordering.numbers
    of_params = solved.cofactors.matrix + found.by_params @ found.left @ found.by_params.T
    np.testing.assert_allclose(of_params, cofactors[:size, :size], rtol=1e-6, atol=1e-12)
    own = size + np.arange(design.shape[1] - size).reshape(-1, 3)
    enu = problem.frame.enu_at(problem.frame.geodetic(solved.state.local[numbers]))
    places = enu @ cofactors[own[:, :, None], own[:, None, :]] @ enu.swapaxes(1, 2)
    known = solved.ground_covariance(solved.cofactors, 1.0)[numbers] + found.of_points[numbers]
    np.testing.assert_allclose(known, places, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.step(left.T @ linear.misfits.vector), best[-2:], rtol=1e-5, atol=1e-9)
    # Ground without the estimate is where it truly is, metres east and north.
    moved = replace(found, value=np.array([0.5, -1.0])).corrected(problem.known)
    metres = (problem.known - moved)[control, :2] * metres_per_degree(problem.known[control])
    np.testing.assert_allclose(metres, common[control, None] * [0.5, -1.0], atol=1e-6)
    # Alone it is told by nothing; with a prior it is.
    only = replace(selection, ground=selection.ground & (common > 0))
    assert not found._is_told(attempt(problem, state, only), only)


def of_heights(solved: Solved, common: CommonHeights, rows: int) -> np.ndarray:
    """Return the columns of the errors that heights share."""
    linear, planes = solved.linear, solved.problem.heights
    assert planes is not None
    found, (points, units) = np.zeros((rows, len(common.value))), common.units(linear)
    assert planes.on[points].all()
    place = {point: k for k, point in enumerate(linear.ordering.grounded.tolist())}
    for point, unit in zip(points.tolist(), units, strict=True):
        found[2 * len(linear.ordering.rays) + 3 * place[point] + 2] = unit
    return found


def check_dem(found: AdjustedDem | None, common: CommonHeights, mixed: np.ndarray, own: np.ndarray) -> None:
    """Compare the errors of a DEM and of parameters with a dense solution's covariances of both ``(P, k), (k, k)``."""
    assert found is not None
    rows = np.isfinite(found.loads).all(axis=1)
    # In columns of the dense problem, an unknown is what heights have too much; the DEM without it errs by less.
    heights = found.loads[rows] @ found.covariance
    loads = common.loads[rows]
    np.testing.assert_allclose(heights @ found.loads[rows].T, loads @ own @ loads.T, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(heights @ found.by_params.T, loads @ mixed.T, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.known, common.loads @ common.value - 2.0, atol=1e-12)


@pytest.mark.parametrize(("with_dem", "bias"), [(False, 0.0), (True, 0.0), (True, 0.8)])
def test_a_shared_parameter_is_one_unknown(flown: Block, tmp_path: Path, with_dem: bool, bias: float) -> None:
    """Two images share the column of a shift, the third has its own; heights of a DEM err together, too.

    The heights' errors are not settled: their estimates are zero, or a bias of some standard deviations.
    """
    shared, apart = Prior(1.0, 3.0, shared="one camera"), Prior(0.5, 2.0, shared="another")
    name, other = flown.start["i0"].param_names
    priors: dict[str, dict[str, Prior]] = {
        "i0": {name: shared}, "i1": {name: shared, other: Prior(0.0, 4.0)}, "i2": {name: apart},
    }  # fmt: skip
    source = None
    if with_dem:
        source = DemHeights(dem(flown, tmp_path / "dem.tif", 2, white=1.0).with_sigma(1.5), bias=4.0, shift=6.0)
    points = with_control(flown, "i1", count=6, sigma=0.5)
    problem, state, selection = _prepared(tuple(flown.start.values()), points, priors, (), source)
    made = SharedPriors.of(problem, priors)
    assert made is not None
    assert [(one.name, one.images, one.columns) for one in made.parameters] == [
        (name, ("i0", "i1"), (0, 2)), (name, ("i2",), (4,))
    ]  # fmt: skip
    heights = None if source is None else Heights.under(source, problem, state.local)
    if heights is not None:
        heights = replace(heights, common=replace(heights.common, value=np.array([bias, 0.0, 0.0])))
    problem = problem if heights is None else heights.applied(problem)
    solved = attempt(problem, state, selection)
    common = None if heights is None else heights.seen(solved)[0]
    found, slope = made._seen(solved, heights)
    (design, _), linear = dense(solved.linear), solved.linear
    # The mean of a prior is 3 or 2 sigmas of its own times the unknown; its own sigma is what the images have apart.
    rows = len(design) - len(problem.pseudo)
    columns = np.zeros((len(design), 2))
    for number, pseudo in enumerate(problem.pseudo):
        for k, one in enumerate(made.parameters):
            if pseudo.column in one.columns:
                columns[rows + number, k] = -one.prior.sigma / pseudo.sigma
    extra = np.zeros((len(design), 0)) if common is None else of_heights(solved, common, len(design))
    values = np.zeros(extra.shape[1] + 2)
    values[: min(extra.shape[1], 1)] = bias
    cofactors, best, _ = with_columns(solved, np.hstack([extra, columns]), values)
    np.testing.assert_allclose(found.left, cofactors[-2:, -2:], rtol=1e-6, atol=1e-10)
    size, numbers = problem.size, linear.ordering.numbers
    of_params = solved.cofactors.matrix + found.by_params @ found.left @ found.by_params.T
    of_points = solved.ground_covariance(solved.cofactors, 1.0) + found.of_points
    if common is not None and heights is not None:
        of_params = of_params + common.by_params @ common.left @ common.by_params.T
        of_points = of_points + common.of_points
        made_of = SharedUnknowns(None, replace(heights, common=common), found).adjusted_dem(
            cast("HeightsRecord", SimpleNamespace(mean_error_m=2.0))
        )
        together = slice(len(cofactors) - 2 - len(common.value), len(cofactors) - 2)
        check_dem(made_of, common, cofactors[:size, together], cofactors[together, together])
    np.testing.assert_allclose(of_params, cofactors[:size, :size], rtol=1e-6, atol=1e-12)
    own = size + np.arange(design.shape[1] - size).reshape(-1, 3)
    enu = problem.frame.enu_at(problem.frame.geodetic(solved.state.local[numbers]))
    places = enu @ cofactors[own[:, :, None], own[:, None, :]] @ enu.swapaxes(1, 2)
    np.testing.assert_allclose(of_points[numbers], places, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.step(slope), best[-2:], rtol=1e-5, atol=1e-9)
    applied = replace(found, value=np.array([0.5, -1.0])).applied(problem)
    means = {one.column: one.mean for one in applied.pseudo}
    assert {column: means[column] for column in (0, 2, 3, 4)} == {0: 2.5, 2: 2.5, 3: 0.0, 4: -1.5}
