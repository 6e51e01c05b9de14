"""Two commits side by side: what became slower, and how sure that is.

    python benchmarks/regress.py OLD NEW               all jobs, 11 pairs of runs each
    python benchmarks/regress.py OLD NEW --job warp    one of them; may be repeated

Both commits are checked out next to each other and use the packages of this environment. Runs alternate, and so does
which commit begins; a run is a whole process, and CPU seconds are compared, which other work on the machine disturbs
less than wall time. For each job the median of the ratios new to old is printed, with the interval that holds the
median of such ratios in 95 of 100 cases. The exit code is 1 if a job surely became slower by more than 3 %, or if one
of the two commits cannot do a job.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from osgeo import gdal
from warp import API, Job, machine, measure, ours, warped

HOME = Path(__file__).resolve().parents[1]
#: What is slower by more than this is a regression.
TOLERATED = 1.03
LIMIT = f"{(TOLERATED - 1) * 100:.0f} %"
NOT_SURE = f'"not sure": the job may be slower by more than {LIMIT} or not. More pairs decide it: --pairs 31.'

#: A block with four control points. With the two of a block of 10 images, one wrong ray makes half of them contradict.
BLOCK = ("--images", "16", "--points", "8000")

#: After `API` of a commit's warp.py, which knows the names of its modules: the CPU time of its warp, kernels loaded.
TIMED = """
import os, time
for name in ("warm", "counted"):
    begin = time.process_time()
    make()
    os.unlink(out)
print(time.process_time() - begin)
"""


@dataclass(frozen=True)
class Checkout:
    """A commit in a folder of its own, and how its code is run."""

    name: str
    home: Path

    @property
    def surroundings(self) -> dict[str, str]:
        """The environment of its processes."""
        return {**os.environ, "PYTHONPATH": os.pathsep.join((str(self.home), str(self.home / "plugins")))}

    def cpu(self, command: list[str], folder: Path) -> float:
        """Return the CPU seconds of a process; not in the folder of a checkout, which goes before PYTHONPATH."""
        return measure(command, self.surroundings, folder).cpu

    def output(self, command: list[str], folder: Path) -> str:
        """Return what a process prints."""
        done = subprocess.run(command, env=self.surroundings, cwd=folder, check=True, capture_output=True, text=True)
        return done.stdout

    @property
    def warp_code(self) -> str:
        """A program that prints the CPU time of its warp; commits before this one had it whole, as `WARP_CPU`."""
        texts = {}
        for name in ("warp.py", "regress.py"):
            path = self.home / "benchmarks" / name
            tree = ast.parse(path.read_text(encoding="utf-8")) if path.exists() else ast.Module([], [])
            for node in tree.body:
                if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
                    texts[ast.unparse(node.targets[0])] = str(node.value.value)
        return texts.get("WARP_CPU", texts.get("API", API) + TIMED)


@contextlib.contextmanager
def checked_out(name: str, commit: str, folder: Path) -> Iterator[Checkout]:
    """Yield a commit of this repository in a folder that is removed."""
    git = ["git", "-C", str(HOME)]
    subprocess.run([*git, "worktree", "add", "--quiet", "--detach", str(folder), commit], check=True)
    try:
        yield Checkout(name, folder)
    finally:
        subprocess.run([*git, "worktree", "remove", "--force", str(folder)], check=True)


def with_invalid_pixels(job: Job) -> Path:
    """Write the image of a job with edges and specks that have no value."""
    path = job.folder / f"invalid_{job.side}.tif"
    if not path.exists():
        gdal.Translate(str(path), str(job.image), noData=0, creationOptions=["TILED=YES"])
        dataset = gdal.Open(str(path), gdal.GA_Update)
        pixels = np.maximum(dataset.ReadAsArray(), 1)
        rows, columns = np.ogrid[: job.side, : job.side]
        pixels[(columns + rows * 0.3 < 0.25 * job.side) | (job.side - columns + rows * 0.2 < 0.15 * job.side)] = 0
        for row, column in np.random.default_rng(1).integers(0, job.side - 3, (job.side**2 // 18_000, 2)):
            pixels[row : row + 3, column : column + 3] = 0
        dataset.WriteArray(pixels)
        dataset.Close() if hasattr(dataset, "Close") else dataset.FlushCache()
    return path


def jobs(job: Job) -> dict[str, Callable[[Checkout], float]]:
    """Return what is timed, by name: the CPU seconds of a commit."""
    sample, folder = HOME / "sample_data", job.folder
    scene = [str(sample / "scene.tif"), "--dem", str(sample / "dem.tif")]
    points = ["--gcps", str(sample / "gcps.geojson")]

    def ortho(*arguments: str) -> Callable[[Checkout], float]:
        def run(one: Checkout) -> float:
            shutil.rmtree(folder / "out", ignore_errors=True)
            return one.cpu([sys.executable, "-m", "ortho_pipeline", *arguments], folder)

        return run

    def whole(*more: str, kernel: str = "bilinear") -> Callable[[Checkout], float]:
        return lambda one: one.cpu([*ours(job, folder / "out", kernel), *more], folder)

    def invalid(one: Checkout) -> float:
        command = ours(job, folder / "out")
        return one.cpu([str(with_invalid_pixels(job)) if part == str(job.image) else part for part in command], folder)

    def warp(one: Checkout) -> float:
        return float(one.output([sys.executable, "-c", one.warp_code, *warped(job, folder / "warp.tif")], folder))

    def block(one: Checkout) -> float:
        # adjust.py of this checkout measures the code of the other.
        command = [sys.executable, str(HOME / "benchmarks/adjust.py"), *BLOCK, "--here"]
        return float(json.loads(one.output(command, folder))["cpu"])

    def first(one: Checkout) -> float:
        # What other jobs compiled is taken where the cache has nothing.
        for kept in (*one.home.rglob("*.nbi"), *one.home.rglob("*.kernel")):
            kept.unlink()
        with tempfile.TemporaryDirectory() as cache:
            empty = {**one.surroundings, "NUMBA_CACHE_DIR": cache, "XDG_CACHE_HOME": cache}
            return measure(ours(job, folder / "out"), empty, folder).cpu

    return {
        "help": ortho("--help"),
        "fit": ortho("fit", *scene, *points),
        "compare": ortho("compare", *scene, *points),
        "match": ortho("match", *scene, "--reference", str(sample / "reference.tif"), "-o", "out/points.geojson"),
        "small scene": ortho("rectify", *scene, *points, "-o", "out"),
        "block": block,
        "warp": warp,
        "whole job": whole(),
        "cubic": whole(kernel="cubic"),
        "cog": whole("--format", "COG", "-co", "COMPRESS=ZSTD"),
        "invalid pixels": invalid,
        "accuracy raster": whole("--accuracy-raster", "--dem-sigma", "3"),
        "first run": first,
    }


class CannotRun(Exception):
    """A commit cannot do a job."""


def seconds(run: Callable[[Checkout], float], one: Checkout) -> float:
    """Return the CPU seconds of a run, or raise `CannotRun` with the commit and what the program printed."""
    try:
        return run(one)
    except subprocess.CalledProcessError as error:
        raise CannotRun(f"{one.name} cannot do it:\n{error.stderr}") from error
    except SystemExit as error:
        raise CannotRun(f"{one.name} cannot do it:\n{error}") from error


def compare(run: Callable[[Checkout], float], old: Checkout, new: Checkout, pairs: int) -> dict[str, object]:
    """Alternate two commits; return CPU seconds, ratios new to old and what holds their median."""
    seconds(run, old), seconds(run, new)  # kernels and templates are compiled
    found = []
    for number in range(pairs):
        order = (old, new) if number % 2 else (new, old)
        taken = {one: seconds(run, one) for one in order}
        found.append((taken[old], taken[new]))
    ratios = sorted(after / before for before, after in found)
    # Order statistics: this interval holds the median of such ratios in 95 of 100 cases.
    rank = max(0, int((pairs - 1.96 * pairs**0.5) / 2))
    before, after = (statistics.median(values) for values in zip(*found, strict=True))
    return {
        "old": before, "new": after, "ratio": statistics.median(ratios), "low": ratios[rank],
        "high": ratios[-1 - rank], "pairs": found,
    }  # fmt: skip


def verdict(result: dict[str, object]) -> str:
    """Say what an interval tells."""
    low, high = float(str(result["low"])), float(str(result["high"]))
    if low > TOLERATED:
        return "SLOWER"
    if high <= TOLERATED:
        return "faster" if high < 1.0 else f"not slower by more than {LIMIT}"
    return "not sure"


def main() -> None:
    """Parse the options and run."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0], epilog=NOT_SURE)
    parser.add_argument("old", metavar="OLD", help="a commit")
    parser.add_argument("new", metavar="NEW", help="a commit; HEAD for what is committed")
    parser.add_argument("--pairs", type=int, default=11)
    parser.add_argument("--side", type=int, default=4000, help="of the large scene (px)")
    parser.add_argument("--job", action="append", help="may be repeated; all without")
    parser.add_argument("--folder", type=Path, help="where scenes are kept between runs (default: a temporary one)")
    parser.add_argument("--json", type=Path, help="write all runs there")
    arguments = parser.parse_args()
    if arguments.pairs < 6:
        parser.error("fewer than 6 pairs do not hold a median in 95 of 100 cases")
    with contextlib.ExitStack() as stack:
        temporary = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ortho_regress_")))
        folder = (arguments.folder or temporary / "scenes").resolve()
        folder.mkdir(parents=True, exist_ok=True)
        old = stack.enter_context(checked_out("OLD", arguments.old, temporary / "old"))
        new = stack.enter_context(checked_out("NEW", arguments.new, temporary / "new"))
        todo = jobs(Job(folder, arguments.side).make())
        if unknown := set(arguments.job or ()) - set(todo):
            parser.error(f"no job is called {', '.join(sorted(unknown))}; there are {', '.join(todo)}")
        results, failed = {}, []
        print(f"{'':17s}{'old':>8s}{'new':>8s} s of CPU, {arguments.pairs} pairs; ratio (95 %)")
        for name in arguments.job or todo:
            try:
                result = results[name] = compare(todo[name], old, new, arguments.pairs)
            except CannotRun as error:
                print(f"{name:17s}FAILED: {error}", flush=True)
                failed.append(name)
                continue
            print(
                f"{name:17s}{result['old']:8.2f}{result['new']:8.2f}   {result['ratio']:.3f} "
                f"({result['low']:.3f}-{result['high']:.3f})  {verdict(result)}",
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": machine(), "jobs": results}, indent=1) + "\n")
    verdicts = [verdict(result) for result in results.values()]
    if "not sure" in verdicts:
        print(NOT_SURE)
    if failed:
        print(f"These jobs failed: {', '.join(failed)}")
    if failed or "SLOWER" in verdicts:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
