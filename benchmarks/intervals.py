"""How honest bundle adjustments are: 95 % intervals, refusals and gross errors of simulated blocks.

python benchmarks/intervals.py                     60 blocks of each kind; about an hour on two cores
python benchmarks/intervals.py --blocks 12         a first look
python benchmarks/intervals.py --control 4 --error 0.5   one kind
python benchmarks/intervals.py --ratio 4           heights of the control are four times worse than plan
python benchmarks/intervals.py --json FILE         what was found in each block, one line each

Three line scanners over one place with RPCs and shifts; control (4, 6, 9 or 20 points) whose ground is wrong by 0, 0.2,
0.5 or 1 m on each axis (heights by `--ratio` times as much) and states no sigma; 10 check and 20 tie points;
measurements good to 0.3 px that state the default of 0.5. Each block is adjusted as it is, and once more with the first
control point moved by ten true sigmas in any direction.

The intervals of one block share the errors of its control, so what is behind ± is the standard error over blocks. Exit
code 1 if a share is outside of 0.92 to 0.97 by more than two of these, or more than 2 % of a kind are refused.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from typing import Any

# Threads of BLAS wait for each other on matrices as small as these; to be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyproj
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import DegeneratePoints
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.models import RPC, ImageCorrection

LON, LAT, PIXELS = 33.35, 37.25, 4000
ERRORS, CONTROL = (0.0, 0.2, 0.5, 1.0), (4, 6, 9, 20)
NOISE, STATED, CHECK, TIES, TIMES = 0.3, 0.5, 10, 20, 10.0
LOW, HIGH, REFUSED = 0.92, 0.97, 0.02
SHARES = ("parameters", "plan", "height", "control")


@cache
def cameras(gsd: float) -> dict[str, RPC]:
    """Return the RPCs of three line scanners with pixels of so many metres."""
    return {
        name: export_rpc(
            LineScanner.over(
                LON, LAT, 850.0, off_nadir_deg=angle, heading_deg=heading, image_width=PIXELS, image_height=PIXELS,
                gsd=gsd, heights=(0.0, 1700.0),
            )
        ).rpc
        for name, angle, heading in (("left", 18.0, 192.0), ("right", -14.0, 191.0), ("down", 2.0, 200.0))
    }  # fmt: skip


def block(
    gsd: float, control: int, error: float, ratio: float, seed: int
) -> tuple[dict[str, ImageCorrection], BlockPoints, np.ndarray]:
    """Return true models, points whose control is wrong by `error` m, in height times `ratio`, and the true ground."""
    random = np.random.default_rng([seed, control, round(1000 * error)])
    middle = (PIXELS / 2, PIXELS / 2)
    truth = {
        name: ImageCorrection.identity(rpc, "shift", middle).with_params(random.normal(0, 10.0, 2))
        for name, rpc in cameras(gsd).items()
    }
    count = control + CHECK + TIES
    reach = 0.018 * gsd
    ground = np.column_stack([
        LON + reach * random.uniform(-1, 1, count), LAT + 0.8 * reach * random.uniform(-1, 1, count),
        random.uniform(850 - 260 * gsd, 850 + 260 * gsd, count),
    ])  # fmt: skip
    seen = np.concatenate([model.ground_to_image(ground) for model in truth.values()])
    known = ground.copy()
    known[:control] = moved(ground[:control], random.normal(0, 1, (control, 3)) * error * (1.0, 1.0, ratio))
    points = BlockPoints(
        ids=tuple(f"p{k}" for k in range(count)), ground=known,
        roles=np.array(["control"] * control + ["check"] * CHECK + ["tie"] * TIES), sigma_ground=np.zeros((count, 3)),
        crs=pyproj.CRS("EPSG:4326"), images=tuple(truth), point=np.tile(np.arange(count), len(truth)),
        image=np.repeat(np.arange(len(truth)), count), measured=seen + random.normal(0, NOISE, seen.shape),
        sigma_image=np.full(len(seen), STATED),
    )  # fmt: skip
    return truth, points, ground


def moved(ground: np.ndarray, metres: np.ndarray) -> np.ndarray:
    """Return ground ``(n, 3)`` lon, lat, h moved by metres ``(n, 3)`` east, north, up."""
    frame = GroundFrame.about(ground)
    turned = frame.enu_at(ground).swapaxes(1, 2) @ metres[:, :, None]
    return frame.geodetic(frame.of_geodetic(ground) + turned[:, :, 0])


def covered(found: BlockFit, truth: dict[str, ImageCorrection], ground: np.ndarray) -> dict[str, float]:
    """Return the shares of 95 % intervals that contain the truth."""
    wanted = np.concatenate([model.params for model in truth.values()])
    frame = GroundFrame.about(ground)
    apart = frame.enu_at(ground) @ (frame.of_geodetic(found.ground) - frame.of_geodetic(ground))[:, :, None]
    inside = np.abs(apart[:, :, 0] / found.ground_sigmas) < 1.96
    control = found.points.control
    return {
        "parameters": float((np.abs((found.values - wanted) / found.sigmas) < 1.96).mean()),
        "plan": float(inside[~control, :2].mean()),
        "height": float(inside[~control, 2].mean()),
        "control": float(inside[control].mean()),
    }


def measure(case: tuple[float, int, float, float, int]) -> dict[str, Any]:
    """Adjust one block, without and with a gross error."""
    gsd, control, error, ratio, seed = case
    truth, points, ground = block(gsd, control, error, ratio, seed)
    start = {name: model.with_params(np.zeros(2)) for name, model in truth.items()}
    row: dict[str, Any] = {"gsd": gsd, "points": control, "error": error, "ratio": ratio, "seed": seed}
    try:
        found = adjust(start, points)
        row |= covered(found, truth, ground) | {
            "dropped": [one.point for one in found.rejected], "sigma_xy": found.variances.sigma_xy,
            "sigma_h": found.variances.sigma_h, "sigma0": found.sigma0, "warned": len(found.outlying),
        }  # fmt: skip
    except DegeneratePoints as problem:
        row["refused"] = str(problem)
    direction = np.random.default_rng([seed, 1]).normal(0, 1, 3)
    sigmas = max(error, NOISE * gsd) * np.array([1.0, 1.0, ratio])
    known = points.ground.copy()
    known[:1] = moved(ground[:1], TIMES * sigmas * (direction / np.linalg.norm(direction))[None])
    try:
        spoiled = adjust(start, replace(points, ground=known))
        names = {one.point for one in spoiled.rejected}
        row |= {
            "blunder": "p0" in names, "others": sorted(names - {"p0"}),
            "said": "p0" in names | {one.point for one in spoiled.outlying},
        } | {f"{key} with blunder": share for key, share in covered(spoiled, truth, ground).items()}  # fmt: skip
    except DegeneratePoints as problem:
        row["blunder refused"] = str(problem)
    return row


def mean(values: Iterable[float]) -> tuple[float, float]:
    """Return the mean share of blocks and its standard error; where all hold, that of the rule of three."""
    array = np.array(list(values), dtype=float)
    if not len(array):
        return math.nan, math.nan
    spread = array.std(ddof=1) / math.sqrt(len(array)) if len(array) > 1 else math.inf
    return float(array.mean()), float(max(spread, 1.5 / len(array)) if (array == 1).all() else spread)


def report(rows: list[dict[str, Any]]) -> int:
    """Print a line for each kind of block; return how many are beyond a bound."""
    bad = 0
    print(
        f"{'error':>5} {'n':>3} {'blocks':>6} {'refused':>7} {'dropped':>7}  "
        + "  ".join(f"{name:<13}" for name in SHARES)
        + "  blunder found, named; good points with it"
    )
    kinds = sorted({(row["error"], row["points"]) for row in rows})
    for error, control in kinds:
        mine = [row for row in rows if (row["error"], row["points"]) == (error, control)]
        good = [row for row in mine if "refused" not in row]
        refused = len(mine) - len(good)
        cells = []
        for name in SHARES:
            share, spread = mean(row[name] for row in good)
            within = LOW - 2 * spread <= share <= HIGH + 2 * spread
            beyond = name != "control" and not within
            bad += int(beyond)
            cells.append(f"{share:.3f} ± {spread:.3f}{'*' if beyond else ' '}")
        bad += int(refused > REFUSED * len(mine))
        dropped = sum(len(row["dropped"]) for row in good)
        caught = [row for row in mine if "blunder refused" not in row]
        print(
            f"{error:5.1f} {control:3d} {len(mine):6d} {refused:7d} {dropped:7d}  {'  '.join(cells)}  "
            f"{sum(row['blunder'] for row in caught)}, {sum(row['said'] for row in caught)} of {len(caught)}; "
            f"{sum(len(row['others']) for row in caught)} of {(control - 1) * len(caught)}, "
            f"{len(mine) - len(caught)} refused",
            flush=True,
        )
    return bad


def main() -> int:
    """Measure, print, and compare with the bounds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blocks", type=int, default=60, metavar="N", help="blocks of each kind (60)")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first (0)")
    parser.add_argument("--control", type=int, action="append", metavar="N", help="control points; may be repeated")
    parser.add_argument("--error", type=float, action="append", metavar="M", help="error in metres; may be repeated")
    parser.add_argument("--ratio", type=float, default=1.0, metavar="R", help="error in height over that in plan (1)")
    parser.add_argument("--gsd", type=float, default=0.5, metavar="M", help="size of a pixel in metres (0.5)")
    parser.add_argument("--processes", type=int, default=2, metavar="N", help="processes at a time (2)")
    parser.add_argument("--json", metavar="FILE", help="write a line for each block")
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.blocks)
    cases = [
        (given.gsd, control, error, given.ratio, seed)
        for seed, error, control in itertools.product(seeds, given.error or ERRORS, given.control or CONTROL)
    ]
    rows = []
    with ProcessPoolExecutor(given.processes) as pool, open(given.json or os.devnull, "w", encoding="utf-8") as file:
        for row in pool.map(measure, cases):
            rows.append(row)
            print(json.dumps(row), file=file, flush=True)
    bad = report(rows)
    print(f"{bad} beyond a bound")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
