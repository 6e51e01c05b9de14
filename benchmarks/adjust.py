"""Speed and memory of bundle adjustments, and of the pushbroom's projection.

python benchmarks/adjust.py                       blocks of 100, 200 and 400 images with 200 tie points for each of them
python benchmarks/adjust.py --images 1000         one of so many
python benchmarks/adjust.py --points 200000       a block of 100 images with so many tie points
python benchmarks/adjust.py --dem                 the same blocks with heights of a DEM, too: factor of the time
python benchmarks/adjust.py --against DIR         the same blocks by the version in DIR too, in turns
python benchmarks/adjust.py --json FILE           the numbers as JSON too

Each block is adjusted in a process of its own, so that its peak of memory is its own; CPU seconds are with the search
for gross errors, and kernels loaded by the run without that search before it. Bounds that are not kept are said: 100
images with 20,000 points within 4 s of CPU, 1,000 images with 200,000 within 120 s and 3 GB, a growth of no more than
1.2 per doubling beyond linear, a million projections per second, with heights 1.25 times the time without. `figures`
returns all of it for other programs.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

# Threads of BLAS wait for each other on matrices as small as these; to be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyproj
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.models.pushbroom.metadata import pushbroom_of_metadata
from ortho_pipeline.surface.dem import DemSurface, open_dem
from ortho_pipeline.surface.writing import write_dem

GSD, PIXELS = 2.5, 4800
#: Distance (degrees) of the middles of images; each covers 12 km, so a point is in about six of them.
STEP = 0.045
SIGMA, BLUNDERS = 0.3, 0.05
#: Seconds of CPU and bytes that blocks of so many images may take; factor of the time per doubling beyond linear.
BOUNDS, LINEAR, WITH_HEIGHTS = {100: (4.0, 2e9), 1000: (120.0, 3e9)}, 1.2, 1.25
IMAGES, TIES, CONTROL = (100, 200, 400), 200, 4
PROJECTED, PROJECTED_PER_SECOND = 1_000_000, 1e6


def sides(images: int) -> tuple[int, int]:
    """Return the rows and columns of a block that is as square as it can be."""
    rows = next(rows for rows in range(int(images**0.5), 0, -1) if images % rows == 0)
    return rows, images // rows


def models(rows: int, columns: int) -> list[RPC]:
    """Return the RPCs of a block of line scanners that look to various sides."""
    random = np.random.default_rng(1)
    found = []
    for row in range(rows):
        for column in range(columns):
            camera = LineScanner.over(
                33.0 + STEP * column * 1.25, 37.0 + STEP * row, 800.0, image_width=PIXELS, image_height=PIXELS, gsd=GSD,
                off_nadir_deg=float(random.uniform(-20, 20)), heading_deg=190.0 + float(random.uniform(-3, 3)),
                heights=(0.0, 1600.0),
            )  # fmt: skip
            found.append(export_rpc(camera).rpc)
    return found


def block(images: int, count: int) -> tuple[dict[str, ImageCorrection], BlockPoints, int]:
    """Return start models, points with noise and gross errors, and the number of the latter.

    One of four images has a control point.
    """
    random = np.random.default_rng(2)
    rows, columns = sides(images)
    rpcs = models(rows, columns)
    controls = images // CONTROL
    total = count + controls
    low = np.array([33.0, 37.0]) - 0.03
    high = np.array([33.0 + STEP * (columns - 1) * 1.25, 37.0 + STEP * (rows - 1)]) + 0.03
    ground = np.column_stack([random.uniform(low, high, (total, 2)), random.uniform(300, 1300, total)])
    ground[:, 2] = terrain(ground[:, :2])
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
    control[random.choice(np.unique(np.concatenate(point)), controls, replace=False)] = True
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


def terrain(plan: Any) -> Any:
    """Return the heights ``(...)`` of the ground at lon, lat ``(..., 2)``."""
    waves = np.array([(2.0, 1.0), (-3.0, 4.0), (9.0, 5.0), (-14.0, 17.0), (31.0, -22.0)])
    return 800.0 + 130.0 * np.sin(2 * np.pi * plan @ waves.T + np.arange(5)).sum(axis=-1)


def dem(images: int, folder: Path) -> DemSurface:
    """Return a DEM under a block with samples of one second, which err by 3 m each, and of 2 m between them."""
    rows, columns = sides(images)
    step, margin = 1.0 / 3600.0, 0.06
    size = int((STEP * 1.25 * (columns - 1) + 2 * margin) / step), int((STEP * (rows - 1) + 2 * margin) / step)
    west, north = 33.0 - margin, 37.0 + STEP * (rows - 1) + margin
    heights = np.empty(size[::-1], dtype=np.float32)
    lon, random = west + (np.arange(size[0]) + 0.5) * step, np.random.default_rng(5)
    for row in range(size[1]):
        lat = np.full_like(lon, north - (row + 0.5) * step)
        heights[row] = terrain(np.column_stack([lon, lat])) + random.normal(0, 3.0, size[0])
    write_dem(folder / "dem.tif", heights, (west, north), step, "EPSG:4326")
    return open_dem(folder / "dem.tif", "ellipsoid", override=True).with_sigma(2.0)


def _directions(random: np.random.Generator, count: int) -> Any:
    angle = random.uniform(0, 2 * np.pi, count)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def measure_block(images: int, count: int, *, heights: bool) -> dict[str, Any]:
    """Adjust a block in this process, without and with the search for gross errors; on request with heights of a DEM.

    The run without the search has the heights, too: it loads kernels, and tiles of the DEM into the system's cache.
    """
    start, points, wrong = block(images, count)
    folder = tempfile.TemporaryDirectory()
    surface = dem(images, Path(folder.name)) if heights else None
    begin, wall = time.process_time(), time.perf_counter()
    plain = adjust(start, points, robust=False, heights=surface)
    middle, half = time.process_time(), time.perf_counter()
    found = adjust(start, points, heights=surface)
    end, last = time.process_time(), time.perf_counter()
    return {
        "points": count, "rays": points.rays, "images": len(start), "parameters": len(found.parameters),
        "seconds_plain": half - wall, "seconds": last - half, "cpu_plain": middle - begin, "cpu": end - middle,
        "sigma0_plain": plain.sigma0, "sigma0": found.sigma0, "gross_errors": wrong, "rejected": len(found.rejected),
        "heights": found.heights.used if found.heights else None,
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


def run(where: Path, images: int, count: int, *, heights: bool = False) -> dict[str, Any]:
    """Measure a block by the version in a folder, in a process of its own."""
    paths = os.pathsep.join(map(str, (where, where / "plugins")))
    command = [sys.executable, __file__, "--images", str(images), "--points", str(count), "--here"]
    command += ["--dem"] if heights else []
    made = subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": paths})
    found: dict[str, Any] = json.loads(made.stdout)
    print(
        f"{found['images']:6d} {found['points']:8d} {found['rays']:8d} {found['parameters']:6d} "
        f"{found['cpu_plain']:7.1f} {found['cpu']:7.1f} {found['seconds']:7.1f} {found['bytes'] / 1e9:6.2f}  "
        f"{found['gross_errors']}, {found['rejected']}, sigma0 {found['sigma0']:.3f}"
        f"{'' if found['heights'] is None else ', heights ' + str(found['heights'])}  {where.name}",
        flush=True,
    )
    return found


def broken(rows: list[dict[str, Any]]) -> list[str]:
    """Return the bounds that blocks break."""
    found = []
    for row in rows:
        seconds, size = BOUNDS.get(row["images"], (math.inf, math.inf))
        if row["points"] == TIES * row["images"] and (row["cpu"] > seconds or row["bytes"] > size):
            found.append(f"{row['images']} images: {row['cpu']:.1f} s, {row['bytes'] / 1e9:.2f} GB")
    for one, other in itertools.pairwise(rows):
        doublings = math.log2(other["points"] / one["points"])
        growth = (other["cpu"] / one["cpu"]) / (other["points"] / one["points"])
        if doublings > 0:
            print(
                f"growth per doubling from {one['points']} to {other['points']} points: {growth ** (1 / doublings):.2f}"
            )
            if growth > LINEAR**doublings:
                found.append(f"growth to {other['points']} points")
    return found


def figures(blocks: list[tuple[int, int]], against: Path | None = None, *, heights: bool = False) -> dict[str, Any]:
    """Return the numbers of blocks of so many images and tie points, of the projection, and bounds that are not kept.

    Parameters
    ----------
    against : Path, optional
        A folder with another version, which adjusts each block first.
    heights : bool
        Adjust each block with heights of a DEM, too.
    """
    here, rows, others, on_dem = Path(__file__).resolve().parent.parent, [], [], []
    print("images   points     rays param.   plain    CPU s    wall     GB  gross errors, rejected")
    for images, count in blocks:
        if against:
            others.append(run(against.resolve(), images, count))
        rows.append(run(here, images, count))
        if heights:
            on_dem.append(run(here, images, count, heights=True))
    projection = measure_projection()
    beyond = broken(rows)
    for row, other in zip(rows, on_dem, strict=False):
        factor = other["cpu"] / row["cpu"]
        print(f"{row['images']} images: with heights {factor:.2f} times the CPU time")
        if factor > WITH_HEIGHTS:
            beyond.append(f"{row['images']} images with heights: {factor:.2f} times the CPU time")
    if projection["points_per_second"] < PROJECTED_PER_SECOND:
        beyond.append(f"pushbroom: {projection['points_per_second']:.2g} projections per second")
    return {"blocks": rows, "against": others, "heights": on_dem, "pushbroom": projection, "beyond": beyond}


def main() -> None:
    """Measure, print, and compare with the bounds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, action="append", metavar="N", help="images of a block; may be repeated")
    parser.add_argument("--points", type=int, metavar="N", help="tie points, 200 for each image if not given")
    parser.add_argument("--dem", action="store_true", help="adjust each block with heights of a DEM, too")
    parser.add_argument("--against", type=Path, metavar="DIR", help="a folder with another version")
    parser.add_argument("--json", metavar="FILE", help="write the numbers")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    sizes = given.images or (IMAGES if given.points is None else (100,))
    blocks = [(images, given.points or TIES * images) for images in sizes]
    if given.here:
        print(json.dumps(measure_block(*blocks[0], heights=given.dem)))
        return
    found = figures(blocks, given.against, heights=given.dem)
    projection = found["pushbroom"]
    print(
        f"pushbroom ground_to_image: {projection['points_per_second'] / 1e6:.2f} M points/s, closes to "
        f"{projection['closing_px']:.1e} px"
    )
    if given.json:
        with open(given.json, "w", encoding="utf-8") as file:
            json.dump(found, file, indent=1)
    for row, other in zip(found["blocks"], found["against"], strict=False):
        print(f"{row['images']} images: {row['cpu'] / other['cpu']:.3f} of the CPU time of {given.against}")
    for line in found["beyond"]:
        print(f"beyond a bound: {line}")


if __name__ == "__main__":
    main()
