"""Speed of adjustments, warm, on one core: what fitting costs beside warping.

python benchmarks/fit.py            prints a line per job; exit code 1 if one is slower than its bound
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

# Threads of BLAS wait for each other on matrices as small as these; to be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pyproj
from ortho_studies.bilsat.truth import FOCAL_LENGTH, MAP_CRS, PITCH, SIZE, BilsatScene
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline.estimation.choice.comparison import compare
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.frame.resection import resect
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points

SIMPLE = ("poly1", "poly2", "poly3", "rfm1", "rfm2", "rfm3", "projective", "dlt")
FOURTEEN = (
    "affine2d", "poly1", "poly2", "poly3", "projective", "affine3d", "affine12", "affine14", "poly3d2", "poly3d3",
    "dlt", "rfm1", "rfm2", "rfm3",
)  # fmt: skip
ROUNDS = 5


def seconds(job: Callable[[], object]) -> float:
    """Return the best of some rounds, after one that may compile: other processes only ever add to it."""
    job()
    taken = []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        job()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def scanned(count: int) -> Points:
    """Return points of a simulated line scanner, 20 degrees off nadir, with noise of half a pixel."""
    random = np.random.default_rng(1)
    camera = scanner()
    image = random.uniform(0, 1, (count, 2)) * (camera.width, camera.height)
    ground = camera.image_to_ground(image, random.uniform(100.0, 1400.0, count))
    return Points(
        ids=tuple(f"p{k}" for k in range(count)), image=image + random.normal(0, 0.5, image.shape), ground=ground,
        roles=np.full(count, "control", dtype="<U7"), sigma_image=np.full(count, 0.5),
        sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS("EPSG:4326"), source="benchmark",
    )  # fmt: skip


def scanner() -> LineScanner:
    """Return the line scanner of the benchmark."""
    return LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(0.0, 1500.0))


def main() -> int:
    """Measure and print."""
    scene = BilsatScene.make()
    points = scene.measure(0)
    in_map = points.to_crs(MAP_CRS)
    interior = Interior(SIZE, SIZE, FOCAL_LENGTH, PITCH, PITCH)
    survey = FrameCamera.from_geocentric(interior, scene.survey(0).position, heights=(600.0, 2000.0))
    sixty, many, camera = scanned(60), scanned(1000), scanner()
    size = (camera.width, camera.height)

    def all_nine() -> None:
        fit(survey, points)
        for name in SIMPLE:
            fit_family(name, in_map, size=(SIZE, SIZE))

    jobs: tuple[tuple[str, Callable[[], object], float], ...] = (
        ("frame from zero angles, 44 points", lambda: fit(survey, points), 1.0),
        ("frame from nothing (P3P), 44 points", lambda: fit(resect(points, interior), points), 1.0),
        ("frame and eight simple models, 44 points", all_nine, 1.0),
        ("14 models on 60 points", lambda: [fit_family(name, sixty) for name in FOURTEEN], 3.0),
        ("compare 14 models on 60 points", lambda: compare(sixty, FOURTEEN, size=size), 3.0),
        ("rfm3 with leave-one-out, 1,000 points", lambda: fit_family("rfm3", many), 5.0),
        ("RPC of a line scanner", lambda: export_rpc(camera), 0.1),
    )
    slow = 0
    for name, job, bound in jobs:
        taken = seconds(job)
        slow += taken > bound
        print(f"{name:42s} {1e3 * taken:8.1f} ms   {'SLOWER than' if taken > bound else 'bound'} {1e3 * bound:.0f} ms")
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
