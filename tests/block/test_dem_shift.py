"""A DEM that is half a sample off its place: found with its significance, corrected on request, and no false alarms."""

from __future__ import annotations

from pathlib import Path

import chains
import numpy as np
import pytest
from chains import Chain, dem, fly, with_control

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.source import DemHeights

CELL = 30.0


@pytest.fixture(autouse=True)
def pixels_of_four_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of a kilometre: a DEM of 30 m has hundreds of samples under them."""
    monkeypatch.setattr(chains, "PIXEL", 4.0)


def adjusted(seed: int, part: float, path: Path, *, move: bool = False) -> tuple[BlockFit, np.ndarray]:
    """Return a block with control in its first image, and by how much (m) its DEM is off: a part of half a sample."""
    block = fly(Chain(images=4, convergence_deg=10.0, normal=True, errors=5.0, ties=600), seed)
    random = np.random.default_rng(5 + seed)
    azimuth, bias = random.uniform(0, 2 * np.pi), 2.0 * random.normal()
    shift = 0.5 * CELL * part * np.array([np.sin(azimuth), np.cos(azimuth)])
    surface = dem(block, path, seed, white=2.0, cell=CELL, bias=bias, shift=(float(shift[0]), float(shift[1])))
    heights = DemHeights(surface.with_sigma(2.0), correct_shift=move)
    return adjust(block.start, with_control(block, sigma=0.5, seed=seed), heights=heights), shift


@pytest.mark.parametrize("move", [False, True])
def test_half_a_sample_is_found(tmp_path: Path, move: bool) -> None:
    fit, shift = adjusted(1, 1.0, tmp_path / "dem.tif", move=move)
    assert fit.heights is not None
    assert fit.heights.shift_significant
    assert fit.heights.shift_applied == move
    off = np.array(fit.heights.shift_m) - shift
    assert (np.abs(off) < 4 * np.array(fit.heights.shift_sigma_m)).all()
    notice = next(one for one in fit.warnings if one.code == "dem-shifted")
    assert ("points.dem_shift" in str(notice)) != move
    size = float(np.hypot(*fit.heights.shift_m))
    assert f"Estimated shift of the DEM: {size:.1f} m (" in str(notice)


def test_a_dem_in_its_place_is_not_shifted(tmp_path: Path) -> None:
    fit, _ = adjusted(1, 0.0, tmp_path / "dem.tif")
    assert fit.heights is not None
    assert not fit.heights.shift_significant
    assert not any(one.code == "dem-shifted" for one in fit.warnings)


@pytest.mark.slow
def test_shifts_are_found_and_false_alarms_are_rare(tmp_path: Path) -> None:
    """Of 200 scenes each: at least 95 % of the half samples, at most 1 % false alarms, and sigmas that are right."""
    found, alarms, normalised = 0, 0, []
    for seed in range(200):
        for part in (1.0, 0.0):
            fit, shift = adjusted(seed, part, tmp_path / "dem.tif")
            heights = fit.heights
            assert heights is not None
            normalised.append((np.array(heights.shift_m) - shift) / heights.shift_sigma_m)
            if part:
                found += heights.shift_significant
            else:
                alarms += heights.shift_significant
    assert found >= 190
    assert alarms <= 2
    assert 0.85 < float(np.sqrt(np.mean(np.square(normalised)))) < 1.15
