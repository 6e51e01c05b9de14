"""How long many small scenes take: a plain loop, `ortho run` in one process, in two, and on two dask workers.

    python benchmarks/batch.py [--scenes 200] [--repeat 3] [--quiet SECONDS] [--json FILE]
    python benchmarks/batch.py --dask [--scenes 600] [--repeat 3] [--sample 600] [--workers 1]
                                        the CPU of dask compared with the loop over a sample of the scenes, in pairs

The scenes are windows of sample_data/scene.tif with the RPC moved along, so that each is a scene of its own. Every way
starts with an empty output folder; the time is that of the whole call, the start of the processes included. A run that
is killed half-way and started again has to end with the same bytes. With --quiet each run waits up to that long for
processors that nobody else uses; what others used meanwhile is in the JSON, as a share of the machine.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import hashlib
import json
import multiprocessing
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import yaml
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.batch import runner as batch
from ortho_pipeline.exchange.rpc import rpc_metadata, rpc_of_dataset
from ortho_pipeline.options import OutputOptions, SurfaceOptions

SAMPLE = Path(__file__).resolve().parent.parent / "sample_data"
SIDE = 400
PROCESSORS, TICKS = len(os.sched_getaffinity(0)), os.sysconf("SC_CLK_TCK")
#: Where dask's configuration for small scenes stands.
SCALE = Path(__file__).resolve().parent.parent / "docs" / "scale.md"
FILE = """
defaults:
  surface: {dem: dem.tif}
scenes:
  - images: raw/*.tif
"""


def make_scenes(folder: Path, count: int) -> None:
    """Write the scenes, the DEM and the pipeline file."""
    (folder / "raw").mkdir(parents=True)
    shutil.copy(SAMPLE / "dem.tif", folder)
    (folder / "p.yaml").write_text(FILE)
    source = gdal.Open(str(SAMPLE / "scene.tif"))
    model, _ = rpc_of_dataset(source)
    pixels, room = source.ReadAsArray(), source.RasterXSize - SIDE
    for number in range(count):
        left, top = 37 * number % room, 53 * number % room
        moved = dataclasses.replace(model, col_off=model.col_off - left, row_off=model.row_off - top)
        path = folder / "raw" / f"s{number:04}.tif"
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), SIDE, SIDE, 1, gdal.GDT_UInt16)
        dataset.SetMetadata(rpc_metadata(moved), "RPC")
        dataset.WriteArray(pixels[top : top + SIDE, left : left + SIDE])
        dataset = None


def loop(folder: Path, every: int = 1, first: int = 0) -> None:
    """Rectify all scenes, or every so many, one after the other, with nothing around it."""
    for image in sorted((folder / "raw").glob("*.tif"))[first::every]:
        commands.rectify(
            image, folder / "out" / image.stem, surface=SurfaceOptions(dem=folder / "dem.tif"), output=OutputOptions()
        )


def run(folder: Path, **options: Any) -> None:
    """Make all scenes with `batch.run`."""
    result = batch.run(folder / "p.yaml", **options)
    assert not result.failed, result.to_json()["counts"]


def timed(folder: Path, work: Callable[[Path], None]) -> dict[str, float]:
    """Return wall and CPU seconds of a call that begins with an empty output folder, and the share of others."""
    shutil.rmtree(folder / "out", ignore_errors=True)
    wall, cpu, busy = time.perf_counter(), cpu_seconds(), busy_seconds()
    work(folder)
    wall, cpu, busy = time.perf_counter() - wall, cpu_seconds() - cpu, busy_seconds() - busy
    return {"wall": wall, "cpu": cpu, "others": max(0.0, busy - cpu) / (wall * PROCESSORS)}


def timed_on_dask(folder: Path, few: Path, workers: int = 2) -> dict[str, float]:
    """Return what `timed` does on a new cluster, whose workers have made a few scenes before."""
    import dask
    from distributed import LocalCluster

    (told,) = re.findall(r"```yaml\n(distributed:.*?)```", SCALE.read_text(encoding="utf-8"), flags=re.DOTALL)
    dask.config.update(dask.config.config, yaml.safe_load(told))
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
        work = functools.partial(run, executor="dask", scheduler=cluster.scheduler_address)
        timed(few, work)
        return timed(folder, work)


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and of all below it, those that have ended included."""
    used, parents = {}, {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(path.parent.name)] = int(fields[1])
        used[int(path.parent.name)] = sum(map(int, fields[11:15]))
    mine = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in mine} - mine:
        mine |= more
    return sum(used[pid] for pid in mine) / TICKS


def busy_seconds() -> float:
    """Return the CPU seconds of the machine."""
    user, nice, system, _, _, irq, softirq, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + irq + softirq + steal) / TICKS


def wait_for_quiet(limit: float) -> None:
    """Wait until the processors have been idle for two seconds, at most `limit` seconds."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        before = busy_seconds()
        time.sleep(2)
        if busy_seconds() - before < 0.1 * 2 * PROCESSORS:
            return


def digest(folder: Path) -> str:
    """Return the checksum of all outputs of all scenes."""
    total = hashlib.sha256()
    for path in sorted((folder / "out").glob("s*/*")):
        total.update(path.name.encode() + path.read_bytes())
    return total.hexdigest()


def killed_and_resumed(folder: Path, scenes: int) -> dict[str, Any]:
    """Kill a run of two processes when half is done, start it again, and compare the bytes with one that was not."""
    run(folder, executor="processes", workers=2)
    whole = digest(folder)
    shutil.rmtree(folder / "out")
    command = [sys.executable, "-m", "ortho_pipeline", "run", str(folder / "p.yaml"), "--workers", "2"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while len(list((folder / "out").glob(".run/s*.json"))) < scenes // 2:
        time.sleep(0.01)
    process.kill()
    process.wait()
    result = batch.run(folder / "p.yaml", executor="processes", workers=2)
    return {"kept": result.count("unchanged"), "made": result.count("done"), "same_bytes": digest(folder) == whole}


def measure(folder: Path, few: Path, scenes: int, repeat: int, quiet: float) -> dict[str, Any]:
    """Measure all ways in turn, `repeat` times, after one with `few` scenes each."""
    ways: dict[str, Callable[[Path], None]] = {
        "loop": loop,
        "sequential": lambda where: run(where, executor="sequential"),
        "processes": lambda where: run(where, executor="processes", workers=2),
    }
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in (*ways, "dask")}
    for warm in ways.values():
        timed(few, warm)
    for _ in range(repeat):
        for name, each in runs.items():
            wait_for_quiet(quiet)
            each.append(timed_on_dask(folder, few) if name == "dask" else timed(folder, ways[name]))
            print(name, {key: round(value, 2) for key, value in each[-1].items()}, flush=True)
    begin = time.perf_counter()
    run(folder, executor="sequential")
    again = time.perf_counter() - begin
    wall = {name: statistics.median(one["wall"] for one in each) for name, each in runs.items()}
    pairs = list(zip(runs["sequential"], runs["processes"], runs["dask"], runs["loop"], strict=True))
    return {
        "scenes": scenes,
        "side": SIDE,
        "processors": PROCESSORS,
        "seconds": wall,
        "runs": runs,
        "processes_speedup": statistics.median(s["wall"] / p["wall"] for s, p, _, _ in pairs),
        "dask_beside_processes": statistics.median(d["wall"] / p["wall"] for _, p, d, _ in pairs),
        "overhead_ms_per_scene": 1000 * statistics.median(s["cpu"] - b["cpu"] for s, _, _, b in pairs) / scenes,
        "overhead_wall_ms_per_scene": 1000 * statistics.median(s["wall"] - b["wall"] for s, _, _, b in pairs) / scenes,
        "unchanged_ms_per_scene": 1000 * again / scenes,
    }


def loops(folder: Path, crew: Sequence[Executor], sample: int) -> None:
    """Rectify a sample of the scenes by plain loops at once."""
    every = len(list((folder / "raw").glob("*.tif"))) // sample
    ends = [one.submit(loop, folder, every * len(crew), every * number) for number, one in enumerate(crew)]
    for end in ends:
        end.result()


def dask_overhead(folder: Path, few: Path, repeat: int, workers: int, sample: int, scenes: int) -> None:
    """Print how much CPU a dask cluster takes beside plain loops in as many processes, in pairs.

    The loops, before and after the cluster, are in processes that have made a few scenes, as dask's are.
    """
    ratios, spread = list[float](), 0.0
    with ExitStack() as stack:
        spawn = multiprocessing.get_context("spawn")
        crew = [stack.enter_context(ProcessPoolExecutor(1, spawn)) for _ in range(workers)]
        for one in crew:
            loops(few, [one], 4)
        for _ in range(repeat):
            plain = []
            for way in ("loop", "dask", "loop"):
                if way == "dask":
                    took = timed_on_dask(folder, few, workers)
                else:
                    took = timed(folder, lambda where: loops(where, crew, sample))
                each = 1000 * took["cpu"] / (scenes if way == "dask" else sample)
                print(f"{way}: {each:.1f} ms of CPU a scene, {took['wall']:.0f} s, "
                      f"others {took['others']:.0%} of the machine", flush=True)  # fmt: skip
                spread, plain = (each, plain) if way == "dask" else (spread, [*plain, each])
            ratios.append(spread / statistics.mean(plain))
            print(f"ratio {ratios[-1]:.3f}", flush=True)
    print(f"median {statistics.median(ratios):.3f}")


def main() -> None:
    """Measure, print, and write the numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--quiet", type=float, default=0.0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--dask", action="store_true")
    parser.add_argument("--sample", type=int, default=600)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder, few = Path(name) / "all", Path(name) / "few"
        make_scenes(folder, given.scenes)
        make_scenes(few, 4)
        if given.dask:
            sample = min(given.sample, given.scenes)
            return dask_overhead(folder, few, given.repeat, given.workers, sample, given.scenes)
        found = measure(folder, few, given.scenes, given.repeat, given.quiet)
        found["killed_and_resumed"] = killed_and_resumed(folder, given.scenes)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    print(f"{given.scenes} scenes of {SIDE} x {SIDE} px, {found['processors']} processors, median of {given.repeat}")
    for way, seconds in found["seconds"].items():
        print(f"  {way:<11} {seconds:7.2f} s   {1000 * seconds / given.scenes:6.1f} ms a scene")
    print(f"processes beside sequential: {found['processes_speedup']:.2f} times as fast")
    print(f"dask beside processes:       {found['dask_beside_processes']:.2f} of the time")
    print(f"overhead beyond the loop:     {found['overhead_ms_per_scene']:.1f} ms CPU a scene, "
          f"{found['overhead_wall_ms_per_scene']:.1f} ms wall")  # fmt: skip
    print(f"a scene that is there:       {found['unchanged_ms_per_scene']:.2f} ms")
    print(f"killed and resumed:          {found['killed_and_resumed']}")
    return None


if __name__ == "__main__":
    main()
