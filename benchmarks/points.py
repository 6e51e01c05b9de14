"""Speed of point operations, in points per second of CPU time on one core, beside rpcfast and orthority.

    python benchmarks/points.py            two million points of the scene of benchmarks/warp.py
    python benchmarks/points.py --json FILE

Programs take turns, and ratios are of runs within a round. rpcfast (https://pypi.org/project/rpcfast) and orthority
(https://pypi.org/project/orthority) take part where the interpreter that runs this can import them. Threads are not
used: what can be computed in several has one.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

os.environ["NUMBA_NUM_THREADS"] = "1"

import numpy as np
from warp import Job

from ortho_pipeline.models import RPC
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.rays import meet_surface

POINTS = 2_000_000
#: Points for programs that take microseconds each.
FEWER = 100_000
ROUNDS = 5
OURS = "ortho-pipeline"
#: What was asked for (million points per CPU second).
ASKED = {"ground -> image": 60.0, "image -> ground": 15.0, "image -> DEM": 5.0}
#: Work, and the number of its points.
Work = tuple[Callable[[], Any], int]


def rpcfast_work(model: RPC, ground: np.ndarray, image: np.ndarray, heights: np.ndarray) -> dict[str, Work]:
    """Return the work of rpcfast, of arrays of single coordinates as it takes them."""
    import rpcfast

    same = rpcfast.RPCModel(
        model.row_off - 0.5, model.col_off - 0.5, model.lat_off, model.lon_off, model.h_off,
        model.row_scale, model.col_scale, model.lat_scale, model.lon_scale, model.h_scale,
        model.row_num, model.row_den, model.col_num, model.col_den,
    )  # fmt: skip
    lon, lat, h = (part.copy() for part in ground.T)
    col, row = (part - 0.5 for part in image.T)
    found = np.column_stack(rpcfast.project(same, lon, lat, h)) + 0.5
    assert np.abs(found - image).max() < 1e-6, "rpcfast projects to other places"
    return {
        "ground -> image": (lambda: rpcfast.project(same, lon, lat, h), len(lon)),
        "image -> ground": (lambda: rpcfast.localize(same, col, row, heights), len(lon)),
    }


def orthority_work(model: RPC, ground: np.ndarray, image: np.ndarray, heights: np.ndarray) -> dict[str, Work]:
    """Return the work of orthority, whose inverse is GDAL's, as exact as that is by default: a tenth of a pixel."""
    from orthority.camera import RpcCamera

    names = {"line": "row", "samp": "col", "lat": "lat", "long": "lon", "height": "h"}
    fields: dict[str, Any] = {"err_bias": None, "err_rand": None}
    for theirs, own in names.items():
        centre = 0.5 if own in ("row", "col") else 0.0
        fields |= {
            f"{theirs}_off": getattr(model, f"{own}_off") - centre,
            f"{theirs}_scale": getattr(model, f"{own}_scale"),
        }
    for theirs, own in (("line", "row"), ("samp", "col")):
        for part in ("num", "den"):
            fields[f"{theirs}_{part}_coeff"] = getattr(model, f"{own}_{part}").tolist()
    camera = RpcCamera((12000, 12000), fields)
    xyz, ji = np.ascontiguousarray(ground.T), np.ascontiguousarray(image.T) - 0.5
    assert np.abs(camera.world_to_pixel(xyz[:, :FEWER]) - ji[:, :FEWER]).max() < 1e-6, "orthority projects elsewhere"
    few, some = np.ascontiguousarray(ji[:, :FEWER]), heights[:FEWER].copy()
    return {
        "ground -> image": (lambda: camera.world_to_pixel(xyz), xyz.shape[1]),
        "image -> ground": (lambda: camera.pixel_to_world_z(few, some), FEWER),
    }


def measured(programs: Mapping[str, Work]) -> dict[str, dict[str, Any]]:
    """Return, of programs that take turns, million points per CPU second and the ratio of ours to them."""
    for work, _ in programs.values():
        work()  # which may compile
    rates: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(ROUNDS):
        for name, (work, count) in programs.items():
            begin = time.process_time()
            work()
            rates[name].append(count / (time.process_time() - begin) / 1e6)
    told = {}
    for name, found in rates.items():
        ratios = sorted(own / other for own, other in zip(rates[OURS], found, strict=True))
        told[name] = {
            "rate": statistics.median(found), "best": max(found),
            "ratio": [statistics.median(ratios), ratios[0], ratios[-1]],
        }  # fmt: skip
    return told


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", type=Path, help="write what is found there")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ortho_bench_") as folder:
        job = Job(Path(folder), 12000)
        job.write_dem()
        model, surface = job.model(), open_dem(job.dem, "ellipsoid")
        random = np.random.default_rng(0)
        image = random.uniform(100, 11900, (POINTS, 2))
        heights = random.uniform(500, 900, POINTS)
        ground = model.image_to_ground(image, heights)
        met = meet_surface(model, image, surface)
        works: dict[str, dict[str, Work]] = {
            "ground -> image": {OURS: (lambda: model.ground_to_image(ground), POINTS)},
            "image -> ground": {OURS: (lambda: model.image_to_ground(image, heights), POINTS)},
            "image -> DEM": {OURS: (lambda: meet_surface(model, image, surface), POINTS)},
        }
        for name, make in (("rpcfast", rpcfast_work), ("orthority", orthority_work)):
            if importlib.util.find_spec(name) is not None:
                for operation, work in make(model, ground, image, heights).items():
                    works[operation][name] = work
        told: dict[str, Any] = {operation: measured(programs) for operation, programs in works.items()}
        told["closes_px"] = float(np.abs(model.ground_to_image(ground) - image).max())
        told["ray_and_dem_m"] = float(np.abs(met[:, 2] - surface.heights(met[:, :2], model.crs)).max())
    for operation, asked in ASKED.items():
        for name, one in told[operation].items():
            middle, low, high = one["ratio"]
            rest = (
                f"asked {asked:.0f}" if name == OURS else f"ours {middle:.3g} ({low:.3g} to {high:.3g}) times as fast"
            )
            print(f"RPC {operation:16s} {name:15s} {one['rate']:7.2f} M points / CPU s   {rest}")
    print(f"image -> ground closes to {told['closes_px']:.1e} px; ray and DEM within {told['ray_and_dem_m']:.1e} m")
    if arguments.json:
        arguments.json.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
