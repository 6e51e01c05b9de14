"""Speed and memory of bundle adjustments, and of the pushbroom's projection, on one core.

python benchmarks/adjust.py                       a block of 100 images with 20,000, 60,000 and 200,000 tie points
python benchmarks/adjust.py --points 20000        one of them
python benchmarks/adjust.py --json FILE           the numbers as JSON too

Each block is adjusted in a process of its own, so that its peak of memory is its own. Exit code 1 if a bound is broken:
20,000 points within 60 s and 2 GB, time growing no faster than 1.3 times the number of points, a million projections
per second.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from typing import Any

# Threads of BLAS wait for each other on matrices as small as these; to be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyproj

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.models.pushbroom.metadata import pushbroom_of_metadata
from ortho_pipeline.simulation.scanner import LineScanner

SIDE, GSD, PIXELS = 10, 2.5, 4800
#: Distance (degrees) of the middles of images; each covers 12 km, so a point is in about six of them.
STEP = 0.045
SIGMA, BLUNDERS = 0.3, 0.05
SECONDS, BYTES, LINEAR = 60.0, 2e9, 1.3
POINTS = (20_000, 60_000, 200_000)
PROJECTED, PROJECTED_PER_SECOND = 1_000_000, 1e6


def models() -> list[RPC]:
    """Return the RPCs of a square block of line scanners that look to various sides."""
    random = np.random.default_rng(1)
    found = []
    for row in range(SIDE):
        for column in range(SIDE):
            camera = LineScanner.over(
                33.0 + STEP * column * 1.25, 37.0 + STEP * row, 800.0, image_width=PIXELS, image_height=PIXELS, gsd=GSD,
                off_nadir_deg=float(random.uniform(-20, 20)), heading_deg=190.0 + float(random.uniform(-3, 3)),
                heights=(0.0, 1600.0),
            )  # fmt: skip
            found.append(export_rpc(camera).rpc)
    return found


def block(count: int) -> tuple[dict[str, ImageCorrection], BlockPoints, int]:
    """Return start models, points (25 of them control) with noise and gross errors, and the number of the latter."""
    random = np.random.default_rng(2)
    rpcs = models()
    total = count + 25
    low, high = np.array([33.0, 37.0]) - 0.03, np.array([33.0 + STEP * 9 * 1.25, 37.0 + STEP * 9]) + 0.03
    ground = np.column_stack([random.uniform(low, high, (total, 2)), random.uniform(300, 1300, total)])
    point, image, measured = [], [], []
    for k, rpc in enumerate(rpcs):
        truth = ImageCorrection(rpc, "affine", (PIXELS / 2, PIXELS / 2), random.normal(0, (8, 3e-4, 3e-4) * 2))
        seen = truth.ground_to_image(ground)
        inside = np.flatnonzero(((seen >= 0) & (seen <= PIXELS)).all(axis=1))
        point.append(inside)
        image.append(np.full(len(inside), k))
        measured.append(seen[inside] + random.normal(0, SIGMA, (len(inside), 2)))
    rays = np.concatenate(measured)
    wrong = random.random(len(rays)) < BLUNDERS
    rays[wrong] += random.uniform(8, 60, (int(wrong.sum()), 1)) * _directions(random, int(wrong.sum()))
    control = np.zeros(total, dtype=bool)
    control[random.choice(np.unique(np.concatenate(point)), 25, replace=False)] = True
    points = BlockPoints(
        ids=tuple(f"p{k}" for k in range(total)), ground=np.where(control[:, None], ground, np.nan),
        roles=np.where(control, "control", "tie"), sigma_ground=np.full((total, 3), 0.3), crs=pyproj.CRS("EPSG:4326"),
        images=tuple(f"i{k}" for k in range(len(rpcs))), point=np.concatenate(point), image=np.concatenate(image),
        measured=rays, sigma_image=np.full(len(rays), SIGMA),
    )  # fmt: skip
    start = {
        f"i{k}": ImageCorrection.identity(rpc, "affine", (PIXELS / 2, PIXELS / 2)) for k, rpc in enumerate(rpcs)
    }  # fmt: skip
    return start, points, int(wrong.sum())


def _directions(random: np.random.Generator, count: int) -> Any:
    angle = random.uniform(0, 2 * np.pi, count)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def measure_block(count: int) -> dict[str, Any]:
    """Adjust a block in this process, without and with the search for gross errors."""
    start, points, wrong = block(count)
    begin = time.perf_counter()
    plain = adjust(start, points, robust=False)
    middle = time.perf_counter()
    found = adjust(start, points)
    end = time.perf_counter()
    return {
        "points": count, "rays": points.rays, "images": len(start), "parameters": len(found.parameters),
        "seconds_plain": middle - begin, "seconds": end - middle, "sigma0_plain": plain.sigma0, "sigma0": found.sigma0,
        "gross_errors": wrong, "rejected": len(found.rejected),
        "bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }  # fmt: skip


def measure_projection() -> dict[str, Any]:
    """Return ground points per second that the pushbroom projects, after a first round that may compile."""
    size = 12_000
    camera = LineScanner.over(
        33.35,
        37.25,
        850.0,
        image_width=size,
        image_height=size,
        off_nadir_deg=0.0,
        altitude=618e3,
        heights=(0.0, 1700.0),
    )
    corners = camera.image_to_ground([(0, 0), (size, 0), (size, size), (0, size)], 850.0)
    model = pushbroom_of_metadata(corners, size, size, altitude=618e3, along_deg=0.0, heights=(0.0, 1700.0))
    random = np.random.default_rng(3)
    image = random.uniform(0, size, (PROJECTED, 2))
    ground = model.image_to_ground(image, random.uniform(400, 1300, PROJECTED))
    closing = float(np.nanmax(np.abs(model.ground_to_image(ground) - image)))
    taken = []
    for _ in range(3):
        begin = time.perf_counter()
        model.ground_to_image(ground)
        taken.append(time.perf_counter() - begin)
    return {"points_per_second": PROJECTED / min(taken), "closing_px": closing}


def main() -> int:
    """Measure, print, and compare with the bounds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, action="append", metavar="N", help="tie points; may be repeated")
    parser.add_argument("--json", metavar="FILE", help="write the numbers")
    parser.add_argument("--one", type=int, metavar="N", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(measure_block(given.one)))
        return 0
    rows = []
    print(f"{'points':>8} {'rays':>8} {'param.':>6} {'plain':>8} {'robust':>8} {'memory':>8}  gross errors, rejected")
    for count in given.points or POINTS:
        run = subprocess.run(
            [sys.executable, __file__, "--one", str(count)], capture_output=True, text=True, check=True
        )
        row = json.loads(run.stdout)
        rows.append(row)
        print(
            f"{row['points']:8d} {row['rays']:8d} {row['parameters']:6d} {row['seconds_plain']:6.1f} s "
            f"{row['seconds']:6.1f} s {row['bytes'] / 1e9:5.2f} GB  {row['gross_errors']}, {row['rejected']}, "
            f"sigma0 {row['sigma0']:.3f}"
        )
    projection = measure_projection()
    print(
        f"pushbroom ground_to_image: {projection['points_per_second'] / 1e6:.2f} M points/s, closes to "
        f"{projection['closing_px']:.1e} px"
    )
    if given.json:
        with open(given.json, "w", encoding="utf-8") as file:
            json.dump({"blocks": rows, "pushbroom": projection}, file, indent=1)
    slow = [row for row in rows if row["points"] <= 20_000 and (row["seconds"] > SECONDS or row["bytes"] > BYTES)]
    first = rows[0]
    bent = [row for row in rows if row["seconds"] / first["seconds"] > LINEAR * row["points"] / first["points"]]
    for row in slow + bent:
        print(f"beyond a bound: {row['points']} points")
    few = projection["points_per_second"] < PROJECTED_PER_SECOND
    return 1 if slow or bent or few else 0


if __name__ == "__main__":
    sys.exit(main())
