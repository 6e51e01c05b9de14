"""Speed of point operations, in points per second of CPU time on one core.

python benchmarks/points.py            two million points of the scene of benchmarks/warp.py
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from warp import Job

from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.rays import meet_surface

POINTS = 2_000_000
ROUNDS = 5


def rate(work: Callable[[], object]) -> float:
    """Return millions of points per CPU second: the best of some rounds, after one that may compile."""
    work()
    best = np.inf
    for _ in range(ROUNDS):
        begin = time.process_time()
        work()
        best = min(best, time.process_time() - begin)
    return POINTS / best / 1e6


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory(prefix="ortho_bench_") as folder:
        job = Job(Path(folder), 12000)
        job.write_dem()
        model, surface = job.model(), Surface.open(job.dem, "ellipsoid")
        random = np.random.default_rng(0)
        image = random.uniform(100, 11900, (POINTS, 2))
        heights = random.uniform(500, 900, POINTS)
        ground = model.image_to_ground(image, heights)
        closed = np.abs(model.ground_to_image(ground) - image).max()
        met = meet_surface(model, image, surface)
        miss = np.abs(met[:, 2] - surface.heights(met[:, :2], model.crs)).max()
        rows = (
            ("ground -> image", lambda: model.ground_to_image(ground), ""),
            ("image -> ground", lambda: model.image_to_ground(image, heights), f"closes to {closed:.1e} px"),
            ("image -> DEM", lambda: meet_surface(model, image, surface), f"ray and DEM within {miss:.1e} m"),
        )
        for name, work, remark in rows:
            print(f"RPC {name:16s} {rate(work):6.1f} M points / CPU s   {remark}")


if __name__ == "__main__":
    main()
