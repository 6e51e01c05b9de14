"""Without control the datum of a block is the accuracy that the metadata state; what is reported absolutely has it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chains import PIXEL, Chain, dem, fly

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.start import Start
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection


def test_the_stated_accuracy_is_the_datum() -> None:
    """Of one image it is stated, of the others held within 10 px; a contradicted statement is none."""
    block = fly(Chain(images=3, errors=2.0, normal=True), 0)
    fit = adjust(block.start, block.points, accuracies={"i0": 1.8})
    assert "the metadata of 1 image state 1.8 m" in fit.gauge
    assert "sigma 2 to 10 px" in fit.gauge
    sigmas = fit.sigmas.reshape(-1, 2)
    assert sigmas[0].max() < 2.1
    assert sigmas[2].max() > 5.0
    wrong = fly(Chain(images=3, errors=30.0), 0)
    fit = adjust(wrong.start, wrong.points, accuracies=dict.fromkeys(wrong.start, 0.1))
    assert "not the accuracy of the metadata" in fit.gauge


def test_hold_and_control_come_before_the_metadata() -> None:
    block = fly(Chain(images=3), 0)
    fit = adjust(block.start, block.points, hold=4.0, accuracies={"i0": 1.8})
    assert "metadata" not in fit.gauge
    assert "sigma 4 px" in fit.gauge


def test_an_rpc_states_its_own() -> None:
    block = fly(Chain(images=2, convergence_deg=10.0), 0)
    models = {
        name: ImageCorrection.identity(
            replace(export_rpc(model.model).rpc, err_bias=3.0, err_rand=4.0), "shift", model.origin
        )
        for name, model in block.start.items()
    }
    assert "the metadata state 5 m" in adjust(models, block.points).gauge


def test_the_accuracy_of_a_start() -> None:
    block = fly(Chain(images=2), 0)
    model = block.start["i0"]
    scene = Scene("x", "x.tif", 250, 200, {"frame": model.model, "other": model.model}, "x", accuracy=7.0)
    assert Start(scene, model, "frame+shift", "x").accuracy == 7.0
    assert Start(scene, model, "other+shift", "x").accuracy is None
    assert Start(replace(scene, adjusted={}), model, "frame+shift", "x").accuracy is None


@pytest.mark.slow
def test_absolute_sigmas_by_the_stated_accuracy_are_kept(tmp_path: Path) -> None:
    """Positions over their sigmas have a spread of 1 over sixty draws, with the shift of the DEM left open."""
    normalised = []
    for seed in range(60):
        block = fly(Chain(convergence_deg=3.0, normal=True, errors=3.0), seed)
        random = np.random.default_rng(99 + seed)
        bias, shift = 3.0 * random.normal(), tuple(5.0 * random.normal(0, 1, 2))
        heights = dem(block, tmp_path / f"{seed}.tif", seed, white=1.0, bias=bias, shift=shift).with_sigma(1.0)
        fit = adjust(
            block.start,
            block.points,
            heights=DemHeights(heights, bias=3.0),
            accuracies=dict.fromkeys(block.start, 3.0 * PIXEL),
        )
        truth = np.concatenate([model.params for model in block.truth.values()])
        normalised.append((fit.values - truth) / fit.sigmas)
    assert 0.85 < float(np.sqrt(np.mean(np.square(normalised)))) < 1.15
