"""Speed and truth of matching with a reference orthoimage, over simulated scenes whose every place is known.

    python benchmarks/match.py                 time and memory: 1,000 points of a 12000² scene, by points and by size
    python benchmarks/match.py --truth         200 scenes, sigmas, accuracy, 20 refusals of each kind: half an hour
    python benchmarks/match.py --truth --count 20    a first look
    python benchmarks/match.py --json FILE     write what was found there as well

The scenes are those of tests/matching. Every time is of a process of its own, with kernels compiled; the memory is its
peak, with Python and all libraries. Exit code 1 if one of `LIMITS` is not met.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

# Threads of BLAS wait for each other on matrices as small as these; to be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "matching"))

import numpy as np
import trials
from landscape import sample
from osgeo import gdal, osr
from scenes import TYPES, UTM, Case, Setting
from scipy.ndimage import map_coordinates

from ortho_pipeline.exchange.rpc import rpc_metadata

#: What has to hold: seconds and MB of 1,000 points of a 12000² scene; growth of the time; share of scenes that succeed,
#: RMS (px) of matches, spread of (estimate - truth) / sigma.
LIMITS = {
    "seconds": 20.0, "megabytes": 700.0, "per_point": 1.3, "per_size": 1.3, "succeeded": 0.95, "rms": 0.15,
    "spread": (0.85, 1.15),
}  # fmt: skip
REFUSED = ("place", "chessboard", "water", "beyond")
SIDES, POINTS, STEP, STRIP = (3000, 6000, 12000), (250, 500, 1000, 2000), 16, 512
MATCH = """
import json, sys, time
sys.path.insert(0, {tests!r})
from pathlib import Path
from trials import matches
from ortho_pipeline.exchange.rpc import read_rpc
from ortho_pipeline.surface.dem import open_dem
folder, points = Path(sys.argv[1]), int(sys.argv[2])
found = []
for warm in (True, False):
    wall, cpu = time.perf_counter(), time.process_time()
    kept = matches(
        folder / "scene.tif", read_rpc(folder / "scene.tif"), open_dem(folder / "dem.tif", "ellipsoid"),
        [folder / "reference.tif"], search=20.0, points=100 if warm else points, threads=2,
    )
    found = [time.perf_counter() - wall, time.process_time() - cpu]
# Not ru_maxrss, which a process has from the one that started it: here from the one that made the scenes.
status = Path("/proc/self/status").read_text().split()
peak = int(status[status.index("VmHWM:") + 1]) / 1024
print(json.dumps({{"wall": found[0], "cpu": found[1], "memory": peak, "kept": len(kept)}}))
"""


class Large(Case):
    """A large scene with a reference of the same size: places are exact at each 16th pixel and linear in between."""

    def write(self) -> Case:
        """Write the files strip by strip, once."""
        if not self.dem_file.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            columns, rows = self.frame
            self._strips(self.scene_file, columns, rows, self.mesh, metadata=rpc_metadata(self.model))
            place, columns, rows = self.reference_grid()

            def of_reference(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                return np.meshgrid(place[0] + place[1] * u, place[3] + place[5] * v)

            self._strips(self.reference_file, columns, rows, of_reference, place=place)
            self.write_dem()
        return self

    def _strips(self, path: Path, columns: int, rows: int, where: Any, **about: Any) -> None:
        kind, low, gain = TYPES["uint16"]
        options = ("TILED=YES", "BLOCKXSIZE=512", "BLOCKYSIZE=512")
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, 1, kind, options)
        if "place" in about:
            dataset.SetGeoTransform(about["place"])
            crs = osr.SpatialReference()
            crs.SetFromUserInput(UTM)
            dataset.SetSpatialRef(crs)
        dataset.SetMetadata(about.get("metadata", {}), "RPC")
        coarse = np.arange(0, columns + STEP, STEP) + 0.5
        for top in range(0, rows, STRIP):
            count = min(STRIP, rows - top)
            x, y = where(coarse, top + np.arange(0, count + STEP, STEP) + 0.5)
            mesh = np.meshgrid(np.arange(count) / STEP, np.arange(columns) / STEP, indexing="ij")
            u, v = self._texel(*(map_coordinates(one, mesh, order=1) for one in (x, y)))
            tone = sample(self.land.seen("a", 0, 1.0, 0.4), u, v)
            noise = np.random.default_rng([top, columns]).normal(0, 0.01, tone.shape)
            dataset.WriteArray(np.clip(low + gain * (tone + noise), 1, 65535).astype(np.uint16), 0, top)
        dataset = None


def measured(folder: Path, side: int, points: int) -> dict[str, float]:
    """Match a large scene in a process of its own."""
    setting = Setting(side=side, fine=1.0, error=8.0, relief=5.0, margin=40.0, seed=side)
    Large(setting, folder / str(side)).write()
    code = MATCH.format(tests=sys.path[0])
    command = [sys.executable, "-c", code, str(folder / str(side)), str(points)]
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"no matches of {points} points in {side}²: see above")
    return json.loads(done.stdout)


def speed(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Measure by size and by points; return what was found, and what does not hold."""
    found: dict[str, Any] = {}
    print("scene     points   kept      wall       CPU    peak memory")
    for side, points in [*((side, 1000) for side in SIDES), *((SIDES[-1], count) for count in POINTS)]:
        if f"{side}/{points}" in found:
            continue
        run = found[f"{side}/{points}"] = measured(folder, side, points)
        print(
            f"{side:5d}²   {points:6d}  {run['kept']:5.0f}   {run['wall']:6.2f} s  {run['cpu']:6.2f} s"
            f"   {run['memory']:6.0f} MB", flush=True,
        )  # fmt: skip
    head, wrong = found[f"{SIDES[-1]}/1000"], []
    if head["wall"] > LIMITS["seconds"]:
        wrong.append(f"1,000 points take {head['wall']:.1f} s")
    if head["memory"] > LIMITS["megabytes"]:
        wrong.append(f"1,000 points take {head['memory']:.0f} MB")
    # CPU time, which other programs do not lengthen as much; a constant part only makes the ratio smaller.
    per_point = found[f"{SIDES[-1]}/{POINTS[-1]}"]["cpu"] / head["cpu"] / (POINTS[-1] / 1000)
    per_size = head["cpu"] / found[f"{SIDES[0]}/1000"]["cpu"]
    print(f"twice the points: {2 * per_point:.2f} times the time; 16 times the pixels: {per_size:.2f} times")
    if per_point > LIMITS["per_point"]:
        wrong.append(f"the time grows faster than the number of points, {per_point:.2f}")
    if per_size > LIMITS["per_size"]:
        wrong.append(f"the time depends on the size of the scene, {per_size:.2f}")
    return found, wrong


def truth(count: int) -> tuple[dict[str, Any], list[str]]:
    """Run the experiments; return all rows, and what does not hold."""

    def told(text: str) -> None:
        print(text, flush=True)

    found: dict[str, Any] = {"good texture": trials.run(trials.good_texture(max(4, count // 10)), told)}
    wrong = []
    rms = math.sqrt(float(np.mean([row["rms"] ** 2 for row in found["good texture"]])))
    print(f"-- good texture: matches within {rms:.3f} px (RMS) of the truth\n")
    if not rms <= LIMITS["rms"]:
        wrong.append(f"matches over good texture are off by {rms:.3f} px")
    rows = found["scenes"] = trials.run(trials.scenes(count), told)
    share = sum(row["succeeded"] for row in rows) / len(rows)
    off = [row for row in rows if row["wrong"]]
    print(f"-- scenes: {share:.1%} of {len(rows)} succeed, {len(off)} are wrong without an error\n")
    if share < LIMITS["succeeded"] or off:
        wrong.append(f"{share:.1%} of the scenes succeed, {len(off)} are wrong")
    rows = found["sigmas"] = trials.run(trials.coverage(count), told)
    spread = trials.spread(rows)
    print(f"-- sigmas: (estimate - truth) / sigma has a spread of {spread:.3f}\n")
    low, high = LIMITS["spread"]
    if not low <= spread <= high:
        wrong.append(f"the spread of (estimate - truth) / sigma is {spread:.3f}")
    rows = found["rough"] = trials.run(trials.rough(max(3, 3 * count // 10)), told)
    for kind in ("gaussian", "matern", "exponential"):
        spread = trials.spread([row for row in rows if row["setting"]["roughness"] == kind])
        print(f"-- sigmas where errors are {kind}: a spread of {spread:.3f}\n")
    for what in REFUSED:
        rows = found[what] = trials.refusals(what, max(2, count // 10), told)
        refused = sum(bool(row["refused"]) for row in rows)
        print(f"-- {what}: {refused} of {len(rows)} refused\n")
        if refused < len(rows):
            wrong.append(f"{what}: {refused} of {len(rows)} refused")
    return found, wrong


def main() -> None:
    """Parse the options and run."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--truth", action="store_true", help="the experiments instead of the speed")
    parser.add_argument("--count", type=int, default=200, help="of scenes")
    parser.add_argument(
        "--folder", type=Path, help="where large scenes are kept between runs (default: a temporary one)"
    )
    parser.add_argument("--json", type=Path, help="write all that was found there")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ortho_bench_") as temporary:
        folder = (arguments.folder or Path(temporary)).resolve()
        found, wrong = truth(arguments.count) if arguments.truth else speed(folder)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")
    for text in wrong:
        print(f"does not hold: {text}")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
