"""Heights of a DEM as observations: neighbours meet, common errors are in the sigmas, roofs cost no tie."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chains import (
    CRS,
    Block,
    Chain,
    apart,
    apart_over,
    dem,
    fly,
    misfits,
    neighbours,
    to_ground,
    to_image,
    with_control,
)

from ortho_pipeline.block.adjustment import _prepared, adjust
from ortho_pipeline.block.datum import with_datum
from ortho_pipeline.block.equations.solver import attempt
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights import settling
from ortho_pipeline.block.heights.settling import Heights
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.heights.terrain import expected_slopes
from ortho_pipeline.block.relative.joins import _Moves, joins_of, weak_joins
from ortho_pipeline.commands.block_results.orthos import corrected
from ortho_pipeline.errors import DegeneratePoints, InputError, NotConverged
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.surface.flat import FlatSurface


@pytest.mark.parametrize("convergence_deg", [1.0, 3.0])
def test_neighbours_meet_by_the_heights_of_a_dem(tmp_path: Path, convergence_deg: float) -> None:
    """Ties alone leave them pixels apart; DEM heights of 2 m bring them together."""
    alone, together = [], []
    for seed in range(3):
        block = fly(Chain(convergence_deg=convergence_deg), seed)
        heights = dem(block, tmp_path / f"{seed}.tif", seed, white=2.0).with_sigma(2.0)
        alone.append(misfits(block, adjust(block.start, block.points)).max())
        fit = adjust(block.start, block.points, heights=heights)
        together.append(misfits(block, fit).max())
        assert fit.heights is not None
        assert fit.heights.used > 190
        assert 0.8 < float(fit.sigma0 or 0) < 1.2
    assert min(alone) > 2.0
    assert max(together) < 0.15


def test_control_in_one_image_reaches_the_others(tmp_path: Path) -> None:
    block = fly(Chain(), 1)
    points = with_control(block)
    with pytest.raises(DegeneratePoints, match="do not determine"):
        adjust(block.start, points)
    fit = adjust(block.start, points, heights=dem(block, tmp_path / "dem.tif", 1, white=2.0).with_sigma(2.0))
    assert misfits(block, fit).max() < 0.5
    off = fit.values - np.concatenate([model.params for model in block.truth.values()])
    assert (np.abs(off) < 4 * fit.sigmas).all()


def test_a_bias_of_the_dem_does_not_average_out(tmp_path: Path) -> None:
    """Two hundred heights say of a common error of 5 m no more than one."""
    block = fly(Chain(normal=True, errors=5.0), 2)
    heights = dem(block, tmp_path / "dem.tif", 2, white=2.0, bias=5.0).with_sigma(2.0)
    fit = adjust(block.start, block.points, heights=DemHeights(heights, bias=5.0), hold=5.0)
    assert fit.heights is not None
    assert fit.heights.bias_sigma_m > 3.0
    assert np.nanmedian(fit.ground_sigmas[:, 2]) > 3.0
    claimed = [np.hypot(*fit_sigma) for fit_sigma in _claims(block, fit)]
    assert (misfits(block, fit) < 3.5 * np.array(claimed)).all()


def _claims(block: Block, fit: BlockFit) -> list[tuple[float, float]]:
    found = {(join.first, join.second): join.covariance for join in joins_of(fit)}
    return [tuple(np.sqrt(np.linalg.eigvalsh(found[pair]))) for pair in neighbours(block)]


def test_trees_cost_their_heights_and_no_tie(tmp_path: Path) -> None:
    block = fly(Chain(convergence_deg=10.0), 0)
    heights = dem(block, tmp_path / "dem.tif", 0, white=1.0, trees=0.05).with_sigma(1.0)
    fit = adjust(block.start, block.points, heights=heights)
    assert fit.heights is not None
    assert len(fit.heights.left_out) >= 5
    assert fit.used_rays.all()
    assert not fit.rejected
    assert any(notice.code == "heights-left-out" for notice in fit.warnings)


def test_the_sigma_is_found_where_nobody_states_it(tmp_path: Path) -> None:
    block = fly(Chain(convergence_deg=10.0), 3)
    fit = adjust(block.start, block.points, heights=dem(block, tmp_path / "dem.tif", 3, white=2.0))
    assert fit.heights is not None
    assert fit.heights.sigma_is == "estimated"
    assert 1.4 < fit.heights.sigma_m < 2.8
    # Nearly parallel rays do not tell it: then it is taken to be 10 m, and that is said.
    parallel = fly(Chain(convergence_deg=0.1), 3)
    fit = adjust(parallel.start, parallel.points, heights=dem(parallel, tmp_path / "other.tif", 3, white=2.0))
    assert fit.heights is not None
    assert fit.heights.sigma_is == "assumed"
    assert any(notice.code == "dem-sigma-by-default" for notice in fit.warnings)


def test_the_sigma_that_is_found_does_not_depend_on_how_many_ties_there_are(tmp_path: Path) -> None:
    """The ties are five times better than stated, and the DEM as good: their sigma is all that heights can be told by.

    With a limit of so many ties only, more of them made the sigma of the same DEM smaller.
    """
    found = []
    for ties in (200, 800):
        block = fly(Chain(convergence_deg=20.0, noise=0.02, ties=ties), 1)
        points = replace(block.points, sigma_image=np.full(len(block.points.point), 0.1))
        surface = dem(block, tmp_path / f"{ties}.tif", 1, white=0.02)
        fit = adjust(block.start, points, heights=DemHeights(surface, bias=0.0, shift=0.0))
        assert fit.heights is not None
        assert fit.heights.sigma_is == "estimated"
        found.append(fit.heights.sigma_m)
    assert found[1] == pytest.approx(found[0], rel=0.25)


def test_residuals_do_not_tell_the_sigma_of_correlated_errors(tmp_path: Path) -> None:
    """The shared errors contain them: what is left, 0.01 m, is no accuracy of the DEM."""
    block = fly(Chain(images=3, convergence_deg=10.0, ties=90), 3)
    surface = dem(block, tmp_path / "dem.tif", 3, correlated=5.0, length=300.0)
    fit = adjust(block.start, block.points, heights=DemHeights(surface, correlation=300.0))
    assert fit.heights is not None
    assert (fit.heights.sigma_is, fit.heights.sigma_m) == ("assumed", 10.0)
    assert any(notice.code == "dem-sigma-by-default" for notice in fit.warnings)


def test_no_heights_in_voids(tmp_path: Path) -> None:
    block = fly(Chain(images=4), 0)
    heights = dem(block, tmp_path / "dem.tif", 0, white=2.0, void=100.0).with_sigma(2.0)
    fit = adjust(block.start, block.points, heights=heights)
    assert fit.heights is not None
    assert fit.heights.without > 20
    taken = fit.heights.used + len(fit.heights.left_out) + fit.heights.at_breaks + fit.heights.on_water
    assert taken + fit.heights.without == len(block.points)
    assert fit.used_rays.all()


@pytest.mark.parametrize("seed", [0, 1])
def test_no_heights_on_water(tmp_path: Path, seed: int) -> None:
    """Half of an overlap is a lake that was 5 m lower in the DEM: its heights shift images by 0.4 to 1.2 px."""
    block = fly(Chain(convergence_deg=10.0, relief=2.0), seed)
    heights = dem(block, tmp_path / "dem.tif", seed, white=2.0, lake=70.0).with_sigma(2.0)
    fit = adjust(block.start, block.points, heights=heights)
    assert fit.heights is not None
    # On the lake, or as near to it as the heights for a slope are to each other.
    offshore = block.ground[:, 0] - block.ground[:, 0].min() - 70.0
    assert (offshore < -5.0).sum() <= fit.heights.on_water <= (offshore < 30.0).sum()
    assert fit.used_rays.all()
    assert misfits(block, fit)[0] < 0.2


def test_level_ground_is_no_water(tmp_path: Path) -> None:
    block = fly(Chain(relief=0.0), 0)
    fit = adjust(block.start, block.points, heights=dem(block, tmp_path / "dem.tif", 0).with_sigma(2.0))
    assert fit.heights is not None
    assert fit.heights.on_water == 0
    assert fit.heights.used > 190


def test_flat_ground_is_no_observation() -> None:
    block = fly(Chain(images=2, ties=20), 0)
    with pytest.raises(InputError, match="flat ground"):
        adjust(block.start, block.points, heights=FlatSurface(200.0))


def test_a_join_says_how_far_neighbours_may_be_apart(tmp_path: Path) -> None:
    """By ties alone the sigma covers the misfit, and it is warned of; with heights neither is there."""
    block = fly(Chain(), 4)
    alone = adjust(block.start, block.points)
    weak = weak_joins(joins_of(alone), 0.5)
    assert len(weak) == 1
    assert weak[0].fields["pairs"] == 5
    claims = np.array([one[1] for one in _claims(block, alone)])
    assert (claims > 0.5).all()
    assert (misfits(block, alone) < 3 * claims).all()
    heights = dem(block, tmp_path / "dem.tif", 4, white=2.0).with_sigma(2.0)
    fit = adjust(block.start, block.points, heights=heights)
    assert not weak_joins(joins_of(fit), 0.5)
    assert max(one[1] for one in _claims(block, fit)) < 0.2


def test_slopes_count_as_much_as_their_errors_allow() -> None:
    """An estimate with expected slopes has the accuracy that it claims; with slopes as measured it claims too much."""
    random, count = np.random.default_rng(4), 10_000
    images = np.arange(count) % 20
    rough = np.column_stack([random.normal(0, 0.05, count), np.zeros(count)])
    true = rough + random.normal(0, 0.5, (20, 2))[images]
    measured = true + 0.05 * random.normal(0, 1, (count, 2))
    expected = expected_slopes(measured, np.full(count, 2.0), (0.05 / 2.0) ** 2, images)

    def apart(slopes: np.ndarray) -> np.ndarray:
        means = np.stack([np.bincount(images, one) for one in slopes.T], axis=1) / np.bincount(images)[:, None]
        return slopes - means[images]

    # Information that is claimed, and that is there: the regression of true slopes on expected ones is 1.
    claimed, there = np.sum(apart(expected) ** 2), np.sum(apart(expected) * apart(true))
    assert there == pytest.approx(claimed, rel=0.05)
    assert np.sum(apart(measured) ** 2) > 3 * np.sum(apart(measured) * apart(true)) / 2
    assert np.ptp(apart(expected)[:, 1]) < 0.25 * np.ptp(apart(measured)[:, 1])


def test_slopes_of_interpolated_heights_err_as_predicted(tmp_path: Path) -> None:
    block = fly(Chain(relief=0.0), 0)
    source = DemHeights(dem(block, tmp_path / "dem.tif", 0, white=2.0))
    inside = np.random.default_rng(1).uniform([500_000.0, 4_100_000.0], [500_400.0, 4_100_050.0], (20_000, 2))
    ground = ground_transform("EPSG:32636", "EPSG:4979")(np.column_stack([inside, np.zeros(20_000)]))
    for spacing in (10.0, 16.0, 30.0):
        slopes, _ = source.slopes(ground, spacing)
        assert np.var(slopes) == pytest.approx(4.0 * source.slope_variance(spacing), rel=0.25)


@pytest.mark.parametrize("ties", [150, 400, 1000])
def test_heights_between_the_same_samples_share_information(tmp_path: Path, ties: int) -> None:
    """The variance of a weighted mean is what its weights claim, for the correlation of interpolated errors."""
    block = fly(Chain(images=4, ties=ties), 0)
    surface = dem(block, tmp_path / "dem.tif", 0, white=1.0)
    weights = 1.0 / DemHeights(surface).sharing(ground_transform("EPSG:32636", "EPSG:4979")(block.ground))
    samples = surface.samples_at(block.ground[:, :2])
    # Errors of samples by their weights in the heights.
    shares = np.zeros((ties, *surface.shape))
    cells, parts = np.floor(samples).astype(int), samples % 1.0
    for east in (0, 1):
        for south in (0, 1):
            share = np.abs(1 - east - parts[:, 0]) * np.abs(1 - south - parts[:, 1])
            shares[np.arange(ties), cells[:, 1] + south, cells[:, 0] + east] = share
    shares = shares.reshape(ties, -1)
    alike = shares @ shares.T / np.mean(np.sum(shares**2, axis=1))
    assert weights @ alike @ weights / weights.sum() == pytest.approx(1.0, abs=0.12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "sigma", "told"),
    [
        ({"white": 2.0}, 2.0, {"bias": 0.0, "shift": 0.0}),
        ({"white": 2.0, "bias": 5.0}, 2.0, {"bias": 5.0, "shift": 0.0}),
        ({"correlated": 3.0, "length": 1000.0}, 3.0, {"bias": 0.0, "shift": 0.0, "correlation": 1000.0}),
        ({"correlated": 3.0, "length": 200.0}, 3.0, {"bias": 0.0, "shift": 0.0, "correlation": 200.0}),
    ],
)
def test_claims_are_kept(tmp_path: Path, made: dict[str, float], sigma: float, told: dict[str, float]) -> None:
    """Errors over their sigmas have a spread of 1 over sixty draws: absolute, and between neighbours."""
    normalised, absolute = [], []
    for seed in range(60):
        block = fly(Chain(convergence_deg=3.0, normal=True, errors=5.0), seed)
        bias = made.get("bias", 0.0) * np.random.default_rng(777 + seed).normal()
        heights = dem(block, tmp_path / f"{seed}.tif", seed, **{**made, "bias": bias}).with_sigma(sigma)
        fit = adjust(block.start, block.points, heights=DemHeights(heights, **told), hold=5.0)
        truth = np.concatenate([model.params for model in block.truth.values()])
        absolute.append((fit.values - truth) / fit.sigmas)
        covariances = {(join.first, join.second): join.covariance for join in joins_of(fit)}
        for pair in neighbours(block):
            root = np.linalg.cholesky(covariances[pair])
            normalised.append(np.linalg.solve(root, apart_of(block, fit, pair)))
    for errors in (normalised, absolute):
        assert 0.85 < float(np.sqrt(np.mean(np.square(errors)))) < 1.15


def test_orthos_move_along_the_slopes_of_the_dem(tmp_path: Path) -> None:
    """What parameters and heights move, by rays of changed models that meet a changed DEM."""
    block = fly(Chain(images=2, convergence_deg=20.0, ties=60, relief=80.0), 3)
    surface = dem(block, tmp_path / "dem.tif", 3, cell=5.0)
    fit = adjust(block.start, block.points, heights=surface.with_sigma(0.1), hold=5.0)
    assert fit.adjusted_dem is not None
    assert np.abs(fit.adjusted_dem.slopes).max() > 0.2
    points = np.flatnonzero(np.isfinite(fit.adjusted_dem.loads).all(axis=1))
    ground, model = ground_transform("EPSG:4979", CRS)(fit.ground[points]), fit.models["i0"]
    seen = to_image(model, ground)

    def places(params: np.ndarray, above: float) -> np.ndarray:
        height = ground[:, 2]
        for _ in range(12):
            place = to_ground(model.with_params(params), seen, height)
            height = surface.heights(place[:, :2], CRS) + above
        return np.asarray(place[:, :2])

    moves = _Moves.of(fit, 0, points, fit.adjusted_dem)
    for k, step in enumerate(np.diag(np.full(len(model.params), 0.5))):
        wanted = (places(model.params + step, 0.0) - places(model.params - step, 0.0)).mean(axis=0)
        np.testing.assert_allclose(moves.by_params[:, k], wanted, rtol=0.01, atol=0.01 * np.abs(wanted).max())
    wanted = (places(model.params, 1.0) - places(model.params, -1.0)).mean(axis=0) / 2
    np.testing.assert_allclose(moves.by_height.mean(axis=0), wanted, rtol=0.01, atol=0.01 * np.abs(wanted).max())
    level = _Moves.of(fit, 0, points, None).by_height.mean(axis=0)
    assert np.abs(level - wanted).max() > 0.02 * np.abs(wanted).max(), "slopes would not matter here"


@pytest.mark.slow
@pytest.mark.parametrize("applied", [False, True])
@pytest.mark.parametrize(
    ("made", "sigma", "told", "scatter"),
    [
        ({"white": 2.0, "bias": 5.0}, 2.0, {"bias": 5.0, "shift": 0.0}, 0.0),
        ({"white": 2.0}, 2.0, {"bias": 0.0, "shift": 8.0}, 8.0),
        ({"correlated": 3.0, "length": 1000.0}, 3.0, {"bias": 0.0, "shift": 0.0, "correlation": 1000.0}, 0.0),
        ({"correlated": 3.0, "length": 200.0}, 3.0, {"bias": 0.0, "shift": 0.0, "correlation": 200.0}, 0.0),
    ],
    ids=["bias", "shift", "correlated", "less correlated"],
)
def test_claims_of_orthos_over_the_adjusted_dem_are_kept(
    tmp_path: Path, made: dict[str, float], sigma: float, told: dict[str, float], scatter: float, applied: bool
) -> None:
    """Orthos of neighbours over the DEM that the adjustment corrected, of which they share the errors."""
    over, true = [], []
    for seed in range(40):
        block, random = (
            fly(Chain(convergence_deg=3.0, normal=True, errors=5.0), seed),
            np.random.default_rng(777 + seed),
        )
        bias, shift = made.get("bias", 0.0) * random.normal(), tuple((scatter * random.normal(0, 1, 2)).tolist())
        heights = dem(block, tmp_path / f"{seed}.tif", seed, **{**made, "bias": bias}, shift=shift).with_sigma(sigma)
        source = DemHeights(heights, **told, correct_shift=applied)
        fit = adjust(block.start, block.points, heights=source, hold=5.0)
        surface = corrected(heights, fit)
        covariances = {(join.first, join.second): join.covariance for join in joins_of(fit, fit.adjusted_dem)}
        at_truth = {(join.first, join.second): join.covariance for join in joins_of(fit)}
        for pair in neighbours(block):
            off = apart_over(block, fit, surface, *pair)
            over.append(np.linalg.solve(np.linalg.cholesky(covariances[pair]), off))
            true.append(np.linalg.solve(np.linalg.cholesky(at_truth[pair]), off))
    spread, naive = (float(np.sqrt(np.mean(np.square(errors)))) for errors in (over, true))
    print(f"orthos: error over sigma {spread:.2f}; with the sigma at true heights {naive:.2f}")
    assert 0.85 < spread < 1.15


def apart_of(block: Block, fit: BlockFit, pair: tuple[str, str]) -> np.ndarray:
    return apart(block, fit, *pair)


def test_a_bias_makes_no_height_wrong(tmp_path: Path) -> None:
    """Points and images follow the bias that a solution finds before heights are compared with them."""
    block = fly(Chain(convergence_deg=20.0, ties=80), 2)
    source = DemHeights(dem(block, tmp_path / "dem.tif", 2, white=1.0, bias=15.0).with_sigma(1.0), bias=5.0)
    problem, state, selection = _prepared(tuple(block.start.values()), block.points, {}, (), source)
    heights = Heights.under(source, problem, state.local)
    problem, _ = with_datum(heights.applied(problem), state, selection, 5.0)
    _, found = heights.settled(attempt(problem, state, selection), selection, rounds=1)
    assert found.common.bias[0] == pytest.approx(15.0, abs=4.0)
    assert found.wrong.sum() <= 2


def test_a_point_outside_of_its_models_at_the_start_takes_part_later(tmp_path: Path) -> None:
    block = fly(Chain(images=3, convergence_deg=20.0, ties=40), 2)
    problem, state, selection = _prepared(tuple(block.start.values()), block.points, {}, ())
    problem, _ = with_datum(problem, state, selection, 5.0)
    right = attempt(problem, state, selection)
    state.local[3, 2] += 1e6
    found = attempt(problem, state, selection)
    assert found.converged
    assert found.astray is None
    np.testing.assert_allclose(found.state.params, right.state.params, atol=1e-6)


def test_heights_without_a_solution_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The solution before would have sigmas without the errors that the heights share."""
    block = fly(Chain(images=3), 1)
    heights = dem(block, tmp_path / "dem.tif", 1, white=2.0).with_sigma(2.0)
    monkeypatch.setattr(settling, "attempt", lambda *given: replace(attempt(*given), converged=False))
    with pytest.raises(NotConverged, match="with the heights of the DEM"):
        adjust(block.start, block.points, heights=heights)


#: Heights that were renewed once had no minimum in reach; points of nearly parallel rays moved by rounding without end.
DIFFICULT = {22025: "renewed", 22159: "rounding", 22205: "rounding, silent"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", DIFFICULT)
def test_blocks_that_were_difficult_to_solve(benchmark_module: Callable[[str], Any], tmp_path: Path, seed: int) -> None:
    heights = benchmark_module("heights")
    block, source = heights.any_block(seed, tmp_path / "dem.tif")
    fit = adjust(block.start, block.points, heights=source, hold=heights.HOLD)
    np.testing.assert_allclose(fit.sigma0, 1.0, atol=0.2)
    # The bias moves neighbours by as much as its sigma allows, and their relative sigmas contain it.
    claimed = heights.claims(fit)
    for pair in neighbours(block):
        distance = apart(block, fit, *pair)
        assert distance @ np.linalg.solve(claimed[pair], distance) < 25.0
