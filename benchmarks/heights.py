"""Blocks without control: how far neighbours are apart on the true terrain, by ties alone and with heights of a DEM.

python benchmarks/heights.py              seven chains of six frames at each convergence
python benchmarks/heights.py --seeds 20   more of them
python benchmarks/heights.py --draws 60   instead: claimed over found errors, for several kinds of errors of the DEM

The truth (models, ground, errors of the DEM) is never seen by the estimate.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "block"))

from chains import Chain, apart, dem, fly, misfits, neighbours, with_control

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.relative.joins import joins_of
from ortho_pipeline.errors import OrthoError

#: Errors of the DEM as they are made, and as they are told: sigma, and options of `DemHeights`.
KINDS: dict[str, tuple[dict[str, Any], float, dict[str, Any]]] = {
    "white, told so": ({"white": 2.0}, 2.0, {"bias": 0.0, "shift": 0.0}),
    "white, nothing told but 2 m": ({"white": 2.0}, 2.0, {}),
    "white and a bias of 5 m": ({"white": 2.0, "bias": 5.0}, 2.0, {"bias": 5.0}),
    "alike over 200 m": ({"correlated": 3.0, "length": 200.0}, 3.0, {"bias": 0.0, "shift": 0.0, "correlation": 200.0}),
    "alike over 1 km": ({"correlated": 3.0, "length": 1e3}, 3.0, {"bias": 0.0, "shift": 0.0, "correlation": 1e3}),
    "trees on 5 % of cells": ({"white": 2.0, "trees": 0.05}, 2.0, {}),
    "half a cell off": ({"white": 2.0, "shift": (5.0, 5.0)}, 2.0, {}),
}


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=7)
    parser.add_argument("--draws", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if given.draws:
            claims(given.draws, Path(folder))
        else:
            compared(given.seeds, Path(folder))


def compared(seeds: int, folder: Path) -> None:
    """Print least and greatest distances of neighbours (px)."""
    for convergence in (1.0, 3.0, 10.0):
        found: dict[str, list[np.ndarray]] = {}
        for seed in range(seeds):
            block = fly(Chain(convergence_deg=convergence), seed)
            surface = dem(block, folder / f"{convergence}-{seed}.tif", seed, white=2.0).with_sigma(2.0)
            for name, points, heights in (
                ("ties alone", block.points, None),
                ("heights of 2 m", block.points, surface),
                ("heights of 2 m without bias", block.points, DemHeights(surface, bias=0.0)),
                ("control in the first, ties", with_control(block), None),
                ("control in the first, heights", with_control(block), surface),
            ):
                try:
                    fit = adjust(block.start, points, heights=heights)
                except OrthoError:
                    continue
                found.setdefault(name, []).append(misfits(block, fit))
            for name in ("ties alone", "heights of 2 m", "control in the first, ties"):
                found.setdefault(name, [])
        for name, all_of in found.items():
            values = np.concatenate([*all_of, np.zeros(0)])
            said = f"{values.min():.2f} to {values.max():.2f}, median {np.median(values):.2f}" if len(values) else "-"
            print(f"{convergence:4.0f}°  {name:32s} {len(all_of):3d} of {seeds} adjusted, apart {said} px", flush=True)


def claims(draws: int, folder: Path) -> None:
    """Print the spread of errors over their sigmas, of all images (absolute) and between neighbours."""
    for convergence in (3.0, 10.0):
        for name, (made, sigma, told) in KINDS.items():
            absolute, relative = [], []
            for seed in range(draws):
                block = fly(Chain(convergence_deg=convergence, normal=True, errors=5.0), seed)
                bias = made.get("bias", 0.0) * np.random.default_rng(777 + seed).normal()
                path = folder / "dem.tif"
                surface = dem(block, path, seed, **{**made, "bias": bias}).with_sigma(sigma)
                fit: BlockFit = adjust(block.start, block.points, heights=DemHeights(surface, **told), hold=5.0)
                truth = np.concatenate([model.params for model in block.truth.values()])
                absolute.append((fit.values - truth) / fit.sigmas)
                covariances = {(join.first, join.second): join.covariance for join in joins_of(fit)}
                for pair in neighbours(block):
                    relative.append(np.linalg.solve(np.linalg.cholesky(covariances[pair]), apart(block, fit, *pair)))
                path.unlink()
            spreads = [float(np.sqrt(np.mean(np.square(one)))) for one in (absolute, relative)]
            inside = float((np.abs(relative) < 1.96).mean())
            print(
                f"{convergence:4.0f}°  {name:28s} {draws} draws: spread {spreads[0]:.2f} absolute, {spreads[1]:.2f} "
                f"between neighbours ({100 * inside:.0f} % within 1.96 sigma)", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()
