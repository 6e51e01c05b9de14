"""Blocks without control: how far neighbours are apart on the true terrain, by ties alone and with heights of a DEM.

python benchmarks/heights.py              seven chains of six frames at each convergence
python benchmarks/heights.py --seeds 20   more of them
python benchmarks/heights.py --bound 20   instead: errors compared with the least that any estimate can have
python benchmarks/heights.py --draws 60   instead: found errors over their sigmas, for several errors of the DEM
python benchmarks/heights.py --sizes 3    instead: 3 to 60 images of each sensor, without control and with some in one
python benchmarks/heights.py --blocks 500 instead: blocks of all kinds, pairs that are apart without a warning

The estimate never sees the truth (models, ground, errors of the DEM).
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "block"))

from chains import PIXEL, Block, Chain, apart, dem, fly, misfits, neighbours, spots_of, with_control

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.relative.joins import joins_of
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.surface.dem import DemSurface

#: Convergence (degrees) of the chains.
CONVERGENCE = (1.0, 3.0, 10.0)
#: Standard deviation (px) of the models, true and stated, where errors are compared with their sigmas.
HOLD = 5.0
CELL = 10.0
#: Sigma (px) of a pair beyond which it is warned of; 95 % of the squares of two normal numbers are less than this.
LIMIT, CHI_SQUARE = 0.5, 5.99
#: RMS (px) of the pairs of a block that are determined, and the draws that tell it.
DETERMINED, AGAIN = 0.2, 6


@dataclass(frozen=True)
class Kind:
    """Errors of a DEM as they are, and as they are stated: sigma, and options of `DemHeights`.

    A `bias` (m) is the standard deviation of one, `off` (m) a shift in a random direction. Of the share `spots` of the
    ties, heights of 0.3 m are known.
    """

    sigma: float = 2.0
    stated: dict[str, float] = field(default_factory=dict)
    flown: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=lambda: {"white": 2.0})
    bias: float = 0.0
    off: float = 0.0
    spots: float = 0.0


_KNOWN = {"bias": 0.0, "shift": 0.0}
KINDS: dict[str, Kind] = {
    "white": Kind(stated=_KNOWN),
    "white, default options": Kind(),
    # A bias as large as that of a height, and half a sample along each axis.
    "as default options assume": Kind(bias=2.0, off=CELL / math.sqrt(2.0)),
    "flat ground (0°)": Kind(stated=_KNOWN, flown={"relief": 0.0}),
    "gentle slopes (4°)": Kind(stated=_KNOWN, flown={"relief": 10.0}),
    "steep slopes (45°)": Kind(stated=_KNOWN, flown={"relief": 150.0}),
    "bias of 5 m": Kind(stated={"bias": 5.0, "shift": 0.0}, bias=5.0),
    "correlated over 200 m": Kind(3.0, {**_KNOWN, "correlation": 200.0}, errors={"correlated": 3.0, "length": 200.0}),
    "correlated over 1 km": Kind(3.0, {**_KNOWN, "correlation": 1e3}, errors={"correlated": 3.0, "length": 1e3}),
    "correlated over 10 km": Kind(3.0, {**_KNOWN, "correlation": 1e4}, errors={"correlated": 3.0, "length": 1e4}),
    "10 % of ties on trees": Kind(stated={"shift": 0.0}, flown={"trees": 0.1}),
    "10 % on trees, no bias": Kind(stated=_KNOWN, flown={"trees": 0.1}),
    "10 % of ties on roofs": Kind(stated={"shift": 0.0}, flown={"roofs": 0.1}),
    "10 % on roofs, no bias": Kind(stated=_KNOWN, flown={"roofs": 0.1}),
    "half a cell off": Kind(stated={"bias": 0.0}, off=CELL / 2.0),
    "spot heights": Kind(bias=5.0, off=CELL / math.sqrt(2.0), spots=0.02),
    "spots, correlated over 1 km": Kind(
        3.0,
        {"correlation": 1e3},
        errors={"correlated": 3.0, "length": 1e3},
        bias=5.0,
        off=CELL / math.sqrt(2.0),
        spots=0.02,
    ),
}


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=7)
    parser.add_argument("--bound", type=int, default=0, metavar="SEEDS")
    parser.add_argument("--draws", type=int, default=0)
    parser.add_argument("--sizes", type=int, default=0, metavar="SEEDS")
    parser.add_argument("--blocks", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="first seed of the draws")
    parser.add_argument("--convergence", type=float, action="append", metavar="DEG", help="may be repeated")
    parser.add_argument("--kind", action="append", choices=KINDS, help="may be repeated")
    options = parser.parse_args()
    convergence = tuple(options.convergence or CONVERGENCE)
    with tempfile.TemporaryDirectory() as folder:
        if options.draws:
            seeds = range(options.first, options.first + options.draws)
            spreads(convergence, options.kind or list(KINDS), seeds, Path(folder))
        elif options.sizes:
            sizes(convergence, options.sizes, Path(folder))
        elif options.blocks:
            silent(range(options.first, options.first + options.blocks), Path(folder))
        elif options.bound:
            bounds(convergence, options.bound, Path(folder))
        else:
            compared(convergence, options.seeds, Path(folder))


def compared(convergence: tuple[float, ...], seeds: int, folder: Path) -> None:
    """Print least and greatest distances of neighbours (px)."""
    for angle in convergence:
        distances: dict[str, list[np.ndarray]] = {}
        for seed in range(seeds):
            block = fly(Chain(convergence_deg=angle), seed)
            surface = dem(block, folder / f"{angle}-{seed}.tif", seed, white=2.0).with_sigma(2.0)
            for name, points, heights in (
                ("ties alone", block.points, None),
                ("heights of 2 m", block.points, surface),
                ("heights of 2 m without bias", block.points, DemHeights(surface, bias=0.0)),
                ("control in the first, ties", with_control(block), None),
                ("control in the first, heights", with_control(block), surface),
            ):
                distances.setdefault(name, [])
                try:
                    fit = adjust(block.start, points, heights=heights)
                except OrthoError:
                    continue
                distances[name].append(misfits(block, fit))
        for name, rows in distances.items():
            values = np.concatenate([*rows, np.zeros(0)])
            text = f"{values.min():.2f} to {values.max():.2f}, median {np.median(values):.2f}" if len(values) else "-"
            print(f"{angle:4.0f}°  {name:32s} {len(rows):3d} of {seeds} adjusted, apart {text} px", flush=True)


def sizes(convergence: tuple[float, ...], seeds: int, folder: Path) -> None:
    """Print how far neighbours are apart, and how far the last image is off with control in the first only."""
    for angle in convergence:
        for sensor in ("frame", "rpc", "pushbroom"):
            for images, strips in ((3, 1), (6, 1), (20, 1), (20, 4), (60, 1), (60, 4)):
                greatest, ends = [], []
                for seed in range(seeds):
                    flown = Chain(images, strips, angle, ties=35 * images, sensor=sensor)
                    block = fly(flown, seed)
                    path = folder / f"{seed}.tif"
                    path.unlink(missing_ok=True)
                    surface = dem(block, path, seed, white=2.0).with_sigma(2.0)
                    greatest.append(misfits(block, adjust(block.start, block.points, heights=surface)).max())
                    fit = adjust(block.start, with_control(block), heights=surface)
                    last = block.points.images[-1]
                    error = fit.models[last].params - block.truth[last].params
                    ends.append((np.hypot(*error), np.hypot(*fit.sigmas[-2:])))
                errors, sigmas = np.array(ends).T
                name = f"{angle:4.0f}°  {sensor:9s} {images:2d} images in {strips}"
                print(
                    f"{name}: neighbours up to {max(greatest):.2f} px; control in one: the last is off by up to "
                    f"{errors.max():.2f} px (sigma {sigmas.max():.2f} px, up to {(errors / sigmas).max():.1f} sigma)",
                    flush=True,
                )


def claims(fit: BlockFit) -> dict[tuple[str, str], np.ndarray]:
    """Return the claimed covariances ``(2, 2)`` of pairs in the pixels of `apart`, which are those of level ground.

    Where frames are flown low, a pixel on a hill or at the edge of a frame has 0.6 to 1.4 times that side.
    """
    return {(join.first, join.second): join.covariance * (join.pixel / PIXEL) ** 2 for join in joins_of(fit)}


# -- the least error ---------------------------------------------------------------------------------------------------


def bounds(convergence: tuple[float, ...], seeds: int, folder: Path) -> None:
    """Print errors between neighbours (px): found, claimed, and the Cramér-Rao bound.

    The bound knows the true slopes of the ground, the covariance of all errors, and that there is no bias and no shift.
    """
    for angle in convergence:
        rows = []
        for seed in range(seeds):
            block = fly(Chain(convergence_deg=angle, normal=True, errors=HOLD), seed)
            surface = dem(block, folder / f"{angle}-{seed}.tif", seed, white=2.0, cell=CELL).with_sigma(2.0)
            fit = adjust(block.start, block.points, heights=DemHeights(surface, bias=0.0, shift=0.0), hold=HOLD)
            claimed = claims(fit)
            least = least_covariance(block, surface, 3.0)
            for pair in neighbours(block):
                moves = relative_moves(block, *pair)
                variance = np.trace(moves @ least @ moves.T)
                rows.append((np.sum(apart(block, fit, *pair) ** 2), np.trace(claimed[pair]), variance))
        error, claim, bound = np.sqrt(np.mean(rows, axis=0))
        random = np.random.default_rng(0).normal(0.0, 1.0, (4_000, 35)) * bound
        print(
            f"{angle:4.0f}°  RMS between neighbours: found {error:.3f} px, claimed {claim:.3f} px, least possible "
            f"{bound:.3f} px; greatest of 35 pairs found {np.sqrt(np.max(rows, axis=0)[0]):.2f} px, by the bound "
            f"{np.median(np.abs(random).max(axis=1)):.2f} px",
            flush=True,
        )


def least_covariance(block: Block, surface: DemSurface, each: float) -> np.ndarray:
    """Return the least covariance ``(P, P)`` of the shifts of images, by samples of a DEM with errors of `each` m."""
    points, ground = block.points, block.ground
    count, size = len(ground), 2 * len(block.truth)
    normals = np.zeros((size + 3 * count, size + 3 * count))
    for image, model in enumerate(block.truth.values()):
        rays = np.flatnonzero(points.image == image)
        rows = points.point[rays]
        by_ground, by_params = model.ground_partials(ground[rows]), model.param_partials(ground[rows])
        columns = 2 * image + np.arange(2)
        for row, of_ground, of_params in zip(rows, by_ground, by_params, strict=True):
            design = np.hstack([of_params, of_ground]) / block.flown.noise
            at = np.concatenate([columns, size + 3 * row + np.arange(3)])
            normals[np.ix_(at, at)] += design.T @ design
    normals[np.arange(size), np.arange(size)] += HOLD**-2.0
    samples = surface.samples_at(ground[:, :2])
    cells, parts = np.floor(samples).astype(int), samples % 1.0
    weights: dict[tuple[int, int], np.ndarray] = {}
    for east in (0, 1):
        for south in (0, 1):
            share = np.abs(1 - east - parts[:, 0]) * np.abs(1 - south - parts[:, 1])
            for k, (u, v) in enumerate(cells + np.array([east, south])):
                weights.setdefault((u, v), np.zeros(count))[k] += share[k]
    matrix = np.array(list(weights.values()))
    step = np.eye(2)
    slopes = np.stack([(block.terrain.heights(ground[:, :2] + d) - block.terrain.heights(ground[:, :2] - d)) / 2
                       for d in step], axis=1)  # fmt: skip
    design = np.zeros((count, 3 * count))
    for axis in range(2):
        design[np.arange(count), 3 * np.arange(count) + axis] = -slopes[:, axis]
    design[np.arange(count), 3 * np.arange(count) + 2] = 1.0
    covariance = each**2 * matrix.T @ matrix + 1e-9 * np.eye(count)
    normals[size:, size:] += design.T @ np.linalg.solve(covariance, design)
    return np.linalg.inv(normals)[:size, :size]


def relative_moves(block: Block, first: str, second: str) -> np.ndarray:
    """Return how parameters move two images against each other ``(2, P)``, px."""
    columns = []
    for name, model in block.truth.items():
        for axis in np.eye(2):
            moved = {**block.truth, name: model.with_params(model.params + axis)}
            columns.append(apart(block, SimpleNamespace(models=moved), first, second))
    return np.stack(columns, axis=1)


# -- errors over their sigmas ------------------------------------------------------------------------------------------


def spreads(convergence: tuple[float, ...], kinds: list[str], seeds: range, folder: Path) -> None:
    """Print spreads of errors over their sigmas and how many intervals of 95 % contain the truth."""
    print(
        "spread of error/sigma (1 is right) and share of 95 % intervals with the truth, absolute and between\n"
        "neighbours; RMS between neighbours, px; share of heights that were left out\n"
        f"{'':34s}|        ties alone             |        with heights\n"
        f"{'':34s}| absolute    neighbours    RMS  | absolute    neighbours    RMS  left out"
    )
    for angle in convergence:
        for name in kinds:
            alone, together = Normalised(), Normalised()
            for seed in seeds:
                block, heights = drawn(KINDS[name], angle, seed, folder / "dem.tif")
                alone.add(block, adjust(block.start, block.points, hold=HOLD))
                together.add(block, adjust(block.start, block.points, heights=heights, hold=HOLD))
            print(f"{angle:4.0f}°  {name:28s}| {alone.row}  | {together.row} {together.left_out:7.3f}", flush=True)


def drawn(kind: Kind, angle: float, seed: int, path: Path) -> tuple[Block, DemHeights]:
    """Return a block and the heights that are stated of its DEM."""
    random = np.random.default_rng(777 + seed)
    flown: Any = kind.flown
    block = fly(Chain(convergence_deg=angle, normal=True, errors=HOLD, **flown), seed)
    bias, azimuth = kind.bias * random.normal(), random.uniform(0, 2 * np.pi)
    shift = kind.off * np.cos(azimuth), kind.off * np.sin(azimuth)
    path.unlink(missing_ok=True)
    errors: Any = kind.errors
    surface = dem(block, path, seed, bias=bias, shift=shift, cell=CELL, **errors).with_sigma(kind.sigma)
    spots = spots_of(block, kind.spots, 0.3, random) if kind.spots else None
    return block, DemHeights(surface, spots=spots, **kind.stated)


class Normalised:
    """Errors over their sigmas, of many blocks."""

    def __init__(self) -> None:
        self.absolute: list[np.ndarray] = []
        self.relative: list[np.ndarray] = []
        self.distances: list[np.ndarray] = []
        self.shares: list[float] = []

    def add(self, block: Block, fit: BlockFit) -> None:
        truth = np.concatenate([model.params for model in block.truth.values()])
        self.absolute.append((fit.values - truth) / fit.sigmas)
        covariances = claims(fit)
        # Ties alone may lose all ties of a pair as gross errors (one of 60 chains at 10°).
        for pair in (pair for pair in neighbours(block) if pair in covariances):
            self.relative.append(np.linalg.solve(np.linalg.cholesky(covariances[pair]), apart(block, fit, *pair)))
        self.distances.append(misfits(block, fit))
        self.shares.append(len(fit.heights.left_out) / len(block.points) if fit.heights else 0.0)

    @property
    def row(self) -> str:
        parts = [f"{np.sqrt(np.mean(np.square(some))):4.2f} {(np.abs(some) < 1.96).mean():5.3f}  "
                 for some in (self.absolute, self.relative)]  # fmt: skip
        return f"{' '.join(parts)} {np.sqrt(np.mean(np.square(self.distances))):5.3f}"

    @property
    def left_out(self) -> float:
        """Share of heights that were left out."""
        return float(np.mean(self.shares))


# -- silent cases ------------------------------------------------------------------------------------------------------


def silent(seeds: range, folder: Path) -> None:
    """Print how many pairs of drawn blocks are apart by more than 1 px, or than is claimed, without a warning."""
    counts = dict.fromkeys(("blocks", "refused", "pairs", "apart", "warned", "silent", "beyond", "close", "false"), 0)
    with_silent = set()
    for seed in seeds:
        counts["blocks"] += 1
        block, heights = any_block(seed, folder / "dem.tif")
        try:
            fit = adjust(block.start, block.points, heights=heights, hold=HOLD)
        except OrthoError as error:
            counts["refused"] += 1
            print(f"{seed}: {error}")
            continue
        covariances = claims(fit)
        pairs = [pair for pair in neighbours(block) if pair in covariances]
        weak = {(join.first, join.second): join.sigma > LIMIT for join in joins_of(fit)}
        close = determined(seed, misfits(block, fit), folder / "dem.tif", any(weak[pair] for pair in pairs))
        for pair in pairs:
            distance = apart(block, fit, *pair)
            size, square = float(np.hypot(*distance)), float(distance @ np.linalg.solve(covariances[pair], distance))
            counts["pairs"] += 1
            counts["beyond"] += square > CHI_SQUARE
            counts["apart"] += size > 1.0
            counts["warned"] += size > 1.0 and weak[pair]
            missed = size > 1.0 and not weak[pair] and square > CHI_SQUARE
            counts["silent"] += missed
            counts["close"] += close
            counts["false"] += close and weak[pair]
            if missed:
                with_silent.add(seed)
                print(f"{seed}: {pair} {size:.2f} px apart, {np.sqrt(square):.1f} sigma, {block.flown}")
        if seed % 25 == 24:
            print(counts, flush=True)
    share = counts["beyond"] / max(counts["pairs"], 1)
    print(
        f"{counts['blocks']} blocks, {counts['refused']} refused; {counts['pairs']} pairs, {100 * share:.1f} % beyond "
        f"their 95 % ellipses; {counts['apart']} more than 1 px apart, of which {counts['warned']} warned of and "
        f"{counts['silent']} neither warned of nor within their ellipses (in {len(with_silent)} blocks); "
        f"{counts['close']} in blocks with an RMS of at most {DETERMINED} px, of which {counts['false']} warned of"
    )


def determined(seed: int, distances: np.ndarray, path: Path, warned: bool) -> bool:
    """Tell whether the pairs of a block are close; where they are `warned` of, not only by chance.

    All pairs share the bias of the DEM, which may be small in one draw. So other draws of the same kind decide.
    """
    squares = [distances**2]
    if np.sqrt(np.mean(squares[0])) <= DETERMINED and warned:
        for draw in range(1, AGAIN):
            block, heights = any_block(seed, path, draw)
            squares.append(misfits(block, adjust(block.start, block.points, heights=heights, hold=HOLD)) ** 2)
    return bool(np.sqrt(np.mean(squares)) <= DETERMINED)


def any_block(seed: int, path: Path, draw: int = 0) -> tuple[Block, DemHeights | None]:
    """Return a block of 3 to 60 images in one or more strips, of any sensor, and with a DEM in seven of ten cases.

    Another `draw` has the same kind of block and of DEM, but other ground, ties and errors.
    """
    random = np.random.default_rng(50_000 + seed)
    row, strips = int(random.integers(3, 16)), int(random.integers(1, 5))
    flown = Chain(
        images=row * strips, strips=strips, convergence_deg=float(random.uniform(0.1, 25.0)),
        relief=float(random.uniform(5.0, 80.0)), ties=35 * row * strips, normal=True, errors=HOLD,
        sensor=str(random.choice(["frame", "rpc", "pushbroom"])),
    )  # fmt: skip
    of_draw = seed + 1_000_000 * draw
    block, sigma, bias = fly(flown, of_draw), float(random.uniform(1.0, 5.0)), float(random.choice([0.0, 5.0]))
    if random.random() > 0.7:
        return block, None
    path.unlink(missing_ok=True)
    found = bias * random.normal(0.0, 1.0, draw + 1)[draw]
    surface = dem(block, path, of_draw, white=sigma, bias=found, cell=CELL).with_sigma(sigma)
    return block, DemHeights(surface, bias=bias, shift=0.0)


if __name__ == "__main__":
    main()
