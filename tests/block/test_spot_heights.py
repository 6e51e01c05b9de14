"""Spot heights fix the bias of a DEM: nothing in plan, sigmas that are right, and wrong ones are left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chains import CRS, Block, Chain, apart, dem, fly, neighbours, spots_of, with_control

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.relative.joins import joins_of
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array
from ortho_pipeline.points.heights.spot_heights import SpotHeights


def errors(block: Block, found: Array) -> Array:
    """Return found minus true ground ``(N, 3)``, metres east, north, up."""
    truth = ground_transform(CRS, "EPSG:4979")(block.ground)
    frame = GroundFrame.about(truth)
    off = frame.of_geodetic(found) - frame.of_geodetic(truth)
    return np.asarray(np.einsum("nij,nj->ni", frame.enu_at(truth), off))


def test_they_fix_the_bias_of_the_dem(tmp_path: Path) -> None:
    block = fly(Chain(), 0)
    surface = dem(block, tmp_path / "dem.tif", 0, white=1.0, bias=12.0).with_sigma(1.0)
    spots = spots_of(block, 0.1, 0.3, np.random.default_rng(1), wrong=3)
    fit = adjust(block.start, block.points, heights=DemHeights(surface, spots=spots))
    assert fit.heights is not None
    assert fit.heights.bias_m == pytest.approx(12.0, abs=1.0)
    assert fit.heights.bias_sigma_m < 0.5
    assert fit.heights.spots is not None
    assert fit.heights.spots.left_out == ("s0", "s1", "s2")
    assert fit.heights.spots.used == 17
    assert any(notice.code == "spot-heights-left-out" for notice in fit.warnings)
    assert abs(float(np.nanmedian(errors(block, fit.ground)[:, 2]))) < 1.0


def test_they_tell_the_sigma_of_the_dem(tmp_path: Path) -> None:
    """Nearly parallel rays do not."""
    block = fly(Chain(convergence_deg=0.1), 3)
    surface = dem(block, tmp_path / "dem.tif", 3, white=2.0)
    spots = spots_of(block, 0.4, 0.3, np.random.default_rng(1))
    fit = adjust(block.start, block.points, heights=DemHeights(surface, spots=spots))
    assert fit.heights is not None
    assert fit.heights.sigma_is == "estimated"
    assert 1.4 < fit.heights.sigma_m < 3.0


def test_sigmas_that_are_too_small_are_enlarged_at_the_spots_too(tmp_path: Path) -> None:
    """Heights that are three times worse than stated do not fix the bias better than they can."""
    block = fly(Chain(ties=400), 0)
    surface = dem(block, tmp_path / "dem.tif", 0, white=6.0, bias=12.0)
    spots = spots_of(block, 0.05, 0.3, np.random.default_rng(1))
    stated, right = (
        adjust(block.start, block.points, heights=DemHeights(surface.with_sigma(sigma), spots=spots)).heights
        for sigma in (2.0, 6.0)
    )
    assert stated is not None
    assert right is not None
    assert stated.sigma_is == "enlarged"
    assert "dem-sigma-enlarged" in {notice.code for notice in stated.notices()}
    assert stated.bias_sigma_m == pytest.approx(right.bias_sigma_m, rel=0.35)
    assert abs(stated.bias_m - 12.0) < 4 * stated.bias_sigma_m


@pytest.mark.parametrize(
    ("sigma", "plan"),
    [(0.0, 0.0), (-1.0, 0.0), (np.nan, 0.0), (np.inf, 0.0), (0.3, -1.0), (0.3, np.nan), (0.3, np.inf)],
)
def test_sigmas_that_are_none_are_refused(sigma: float, plan: float) -> None:
    with pytest.raises(InputError, match="spot height b has the standard deviation"):
        SpotHeights(np.zeros((2, 3)), np.array([0.3, sigma]), np.array([0.0, plan]), ("a", "b"))


def test_spots_off_the_dem_are_refused(tmp_path: Path) -> None:
    block = fly(Chain(images=2, ties=40), 0)
    spots = SpotHeights(np.array([(10.0, 50.0, 100.0)]), np.array([0.3]), np.zeros(1), ("a",))
    with pytest.raises(InputError, match="no height at any spot height"):
        adjust(block.start, block.points, heights=DemHeights(dem(block, tmp_path / "dem.tif", 0), spots=spots))


@pytest.mark.parametrize(("control", "used"), [(False, 6), (True, 0)])
def test_spots_of_another_height_datum_are_named(tmp_path: Path, control: bool, used: int) -> None:
    """They move the DEM by the geoid; control points show that they are wrong, and all are left out."""
    block = fly(Chain(images=2, ties=60, convergence_deg=10.0), 0)
    spots = spots_of(block, 0.1, 0.3, np.random.default_rng(1))
    points = with_control(block) if control else block.points
    for off, codes in ((0.0, []), (30.0, ["heights-disagree"])):
        surface = dem(block, tmp_path / f"{off}.tif", 0, white=2.0).with_sigma(2.0)
        moved = replace(spots, ground=spots.ground + np.array([0.0, 0.0, off]))
        fit = adjust(block.start, points, heights=DemHeights(surface, spots=moved))
        assert fit.heights is not None
        assert fit.heights.spots is not None
        assert fit.heights.spots.used == (used if off else 6)
        (notice,) = [one for one in fit.warnings if one.code.startswith(("heights-d", "spot"))] or [None]
        assert ([] if notice is None else [notice.code]) == codes
    assert notice is not None
    assert notice.fields["median_m"] == pytest.approx(30.0, abs=3.0)
    assert "below the spot heights" in str(notice)


def test_spots_much_farther_off_than_a_datum_are_refused(tmp_path: Path) -> None:
    block = fly(Chain(images=2, ties=40), 0)
    spots = spots_of(block, 0.1, 0.3, np.random.default_rng(1))
    far = replace(spots, ground=spots.ground + np.array([0.0, 0.0, 5000.0]))
    with pytest.raises(InputError, match=r"the spot heights are \d+\.\d m above the DEM"):
        adjust(block.start, block.points, heights=DemHeights(dem(block, tmp_path / "dem.tif", 0), spots=far))


@pytest.mark.slow
@pytest.mark.parametrize("convergence_deg", [3.0, 10.0])
def test_sigmas_with_spot_heights_are_kept(tmp_path: Path, convergence_deg: float) -> None:
    """Heights of 0.3 m at 2 % of the ties; a bias of 5 m and a shift of 5 m that nobody states."""
    relative, absolute = [], []
    for seed in range(60):
        block = fly(Chain(convergence_deg=convergence_deg, normal=True, errors=5.0), seed)
        random = np.random.default_rng(777 + seed)
        bias, shift = 5.0 * random.normal(), tuple(5.0 * random.normal(0, 1, 2))
        surface = dem(block, tmp_path / f"{seed}.tif", seed, white=2.0, bias=bias, shift=shift).with_sigma(2.0)
        spots = spots_of(block, 0.02, 0.3, random)
        fit = adjust(block.start, block.points, heights=DemHeights(surface, spots=spots), hold=5.0)
        covariances = {(join.first, join.second): join.covariance for join in joins_of(fit)}
        for pair in neighbours(block):
            relative.append(np.linalg.solve(np.linalg.cholesky(covariances[pair]), apart(block, fit, *pair)))
        absolute.append(errors(block, fit.ground) / fit.ground_sigmas)
    assert 0.85 < float(np.sqrt(np.mean(np.square(relative)))) < 1.15
    for axis in range(3):
        assert 0.85 < float(np.sqrt(np.nanmean(np.square([one[:, axis] for one in absolute])))) < 1.15
