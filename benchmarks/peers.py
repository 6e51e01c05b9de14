"""Other programs on the same pairs as `ortho verify`: what remains displaced, what they claim, time and memory.

    python -m venv aro && aro/bin/pip install arosics     # each peer has an environment of its own
    python benchmarks/peers.py orthos --arosics aro/bin/python --karios kar/bin/python --out peers.jsonl
    python benchmarks/peers.py orthos --read peers.jsonl

KARIOS is no package: its checkout must be importable in its environment (PYTHONPATH). It needs both images on one grid,
so it gets the reference resampled to the grid of the ortho; that time is not counted.

To add a peer of this job: a function like `arosics` in `PEERS`. To add a job (orthorectification, mosaics): a function
like `orthos` in `JOBS`; `measured` gives time and memory of any program.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from osgeo import gdal

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "tests" / "matching"), str(ROOT / "tests" / "orthos")]

from pairs import Array, Pair, drawn  # noqa: E402

gdal.UseExceptions()
#: Each prints a line of JSON after this word.
MARK = "RESULT"
#: Runs a program, and writes its memory (kB) and time of the processor (s) to a file.
LAUNCH = """
import json, resource, subprocess, sys
subprocess.call(sys.argv[2:])
used = resource.getrusage(resource.RUSAGE_CHILDREN)
json.dump([used.ru_maxrss, used.ru_utime + used.ru_stime], open(sys.argv[1], "w"))
"""
AROSICS = """
import json, sys
from arosics import COREG_LOCAL
reference, ortho, step, shift = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
# The window has to hold the shift and enough of the image besides.
side = 128 if shift < 32 else 256
made = COREG_LOCAL(reference, ortho, grid_res=step, max_shift=shift, window_size=(side, side), CPUs=1, q=True,
                   progress=False)
table = made.CoRegPoints_table
good = table[(table.ABS_SHIFT > -9999) & (table.OUTLIER == False)]
print("RESULT" + json.dumps({
    "image": good[["X_IM", "Y_IM"]].values.tolist(), "shift": good[["X_SHIFT_M", "Y_SHIFT_M"]].values.tolist()}))
"""
KARIOS = """
import json, sys
from pathlib import Path
import karios
from karios.api import KariosAPI, RuntimeConfiguration
from karios.core.configuration import ProcessingConfiguration
settings = Path(karios.__file__).parent / "configuration" / "processing_configuration.json"
made = KariosAPI(ProcessingConfiguration.from_file(settings), RuntimeConfiguration(
    Path(sys.argv[3]), False, False, False, sys.argv[4] == "far"))
# GDAL before 3.8 takes no Path.
found = made.match_images(sys.argv[2], sys.argv[1])
said = made.analyze_accuracy(found)
good = found.points[found.points.score > said.statistics.confidence]
print("RESULT" + json.dumps({
    "image": good[["x0", "y0"]].values.tolist(), "shift": good[["dx", "dy"]].values.tolist(),
    "ce90": float(said.ce90)}))
"""


class PeerFailed(Exception):
    """A peer gives no result, and why."""


@dataclass(frozen=True)
class Run:
    """A program that ran: its output, seconds by the clock and of the processor, and megabytes (largest resident)."""

    output: str
    error: str
    seconds: float
    processor: float
    megabytes: float


@dataclass(frozen=True)
class Answer:
    """What a program says of an ortho.

    Parameters
    ----------
    places, displacement : (n, 2)
        Places in the ortho (px), and what it says is displaced there (m to the east and north).
    claims : dict of str to (float, float, float)
        RMSE and CE90 (m) that it states, with the limits of its 95 % interval (NaN without one).
    """

    places: Array
    displacement: Array
    claims: dict[str, tuple[float, float, float]]
    run: Run


@dataclass(frozen=True)
class Case:
    """A pair in files."""

    pair: Pair
    ortho: Path
    reference: Path
    folder: Path

    @property
    def search(self) -> float:
        """Metres within which the displacement is."""
        return 1.3 * float(np.hypot(*self.pair.shift)) + 10 * self.coarse

    @property
    def coarse(self) -> float:
        """Metres of a pixel of the coarser image."""
        return max(self.pair.ortho.gsd, self.pair.reference.gsd)


def measured(words: Sequence[str | Path], folder: Path) -> Run:
    """Run a program and return what it says and needs.

    A child of this process would count the memory of this process, too, so a small one starts the program.
    """
    out, err, used = folder / "out.txt", folder / "err.txt", folder / "used.json"
    begin = time.monotonic()
    with out.open("w") as output, err.open("w") as errors:
        launch = [sys.executable, "-c", LAUNCH, used, *words]
        subprocess.run([str(word) for word in launch], check=False, stdout=output, stderr=errors)
    seconds = time.monotonic() - begin
    kilobytes, processor = json.loads(used.read_text())
    return Run(out.read_text(), err.read_text(), seconds, processor, kilobytes / 1024)


def result_of(run: Run) -> dict[str, Any]:
    """Return the document that a program printed."""
    line = next((one for one in run.output.splitlines() if one.startswith(MARK)), None)
    if line is None:
        raise PeerFailed((run.error.strip().splitlines() or ["no result"])[-1][:200])
    return dict(json.loads(line.removeprefix(MARK)))


def at_points(places: Array, displacement: Array, run: Run, ce90: float | None = None) -> Answer:
    """Return the answer of a program that states displacements at points alone: its statistics are those of them."""
    if len(places) < 3:
        raise PeerFailed(f"{len(places)} tie points")
    length = np.hypot(*displacement.T)
    values = {"rmse": np.sqrt((length**2).mean()), "ce90": np.quantile(length, 0.9) if ce90 is None else ce90}
    return Answer(places, displacement, {name: (float(value), np.nan, np.nan) for name, value in values.items()}, run)


def arosics(python: Path, case: Case) -> Answer:
    """Run AROSICS."""
    pair = case.pair
    step = max(8, pair.pixels // 20)
    shift = int(1.3 * np.hypot(*pair.shift) / min(pair.ortho.gsd, pair.reference.gsd) + 10)
    run = measured([python, "-c", AROSICS, case.reference, case.ortho, str(step), str(shift)], case.folder)
    found = result_of(run)
    # Its shifts correct the ortho: the opposite of the displacement. Its places are centres of pixels.
    return at_points(
        np.array(found["image"], dtype=float).reshape(-1, 2) + 0.5, -np.array(found["shift"]).reshape(-1, 2), run
    )


def karios(python: Path, case: Case) -> Answer:
    """Run KARIOS, on the grid of the ortho."""
    ortho = gdal.Open(str(case.ortho))
    left, dx, _, top, _, dy = ortho.GetGeoTransform()
    bounds = left, top + dy * ortho.RasterYSize, left + dx * ortho.RasterXSize, top
    way = "average" if case.pair.reference.gsd < case.pair.ortho.gsd else "cubic"
    same = case.folder / "same_grid.tif"
    gdal.Warp(str(same), str(case.reference), outputBounds=bounds, xRes=dx, yRes=-dy, resampleAlg=way)
    # It finds shifts of some pixels; its search for larger ones takes others for them where there are none.
    far = np.hypot(*case.pair.shift) > 10 * case.pair.ortho.gsd
    words = [python, "-c", KARIOS, same, case.ortho, case.folder / "karios", "far" if far else "near"]
    run = measured(words, case.folder)
    found = result_of(run)
    places, shift = (np.array(found[name], dtype=float).reshape(-1, 2) for name in ("image", "shift"))
    return at_points(places + shift + 0.5, shift * (dx, dy), run, found["ce90"])


def ours(python: Path, case: Case) -> Answer:
    """Run `ortho verify`."""
    words = [python, "-m", "ortho_pipeline", "verify", case.ortho, "--reference", case.reference]
    run = measured([*words, "--search", str(case.search), "--threads", "1", "--json"], case.folder)
    document = json.loads(run.output)
    if "error" in document:
        raise PeerFailed(document["error"]["message"])
    cells = np.array([one["image"] for one in document["field"]["cells"]])
    field = np.array([[one["east_m"], one["north_m"]] for one in document["field"]["cells"]])
    numbers = {name: document["relative"][f"{name}_m"] for name in ("rmse", "ce90")}
    claims = {name: (one["value"], one["low"], one["high"]) for name, one in numbers.items()}
    return Answer(cells, field, claims, run)


#: The programs of the job `orthos`.
PEERS: dict[str, Callable[[Path, Case], Answer]] = {"ours": ours, "arosics": arosics, "karios": karios}


def compared(peer: str, python: Path, case: Case) -> dict[str, Any]:
    """Return what a program leaves of the displacement, and its claims less the truth; in px of the coarser image."""
    try:
        answer = PEERS[peer](python, case)
    except PeerFailed as failure:
        return {"failed": str(failure)}
    # Ours measures on the ellipsoid, the others on the map.
    truth_at = case.pair.on_the_ground if peer == "ours" else case.pair.displacement()
    true = truth_at(answer.places)
    left, length = true - answer.displacement, np.hypot(*true.T)
    truth = {"rmse": float(np.sqrt((length**2).mean())), "ce90": float(np.quantile(length, 0.9))}
    row: dict[str, Any] = {
        "points": len(answer.places), "seconds": answer.run.seconds, "processor": answer.run.processor,
        "megabytes": answer.run.megabytes,
        "bias": float(np.hypot(*left.mean(axis=0))) / case.coarse,
        "median": float(np.median(np.hypot(*left.T))) / case.coarse,
    }  # fmt: skip
    for name, (value, low, high) in answer.claims.items():
        row[f"{name}_claim"] = (value - truth[name]) / case.coarse
        if np.isfinite([low, high]).all():
            row[f"{name}_covered"] = bool(low <= truth[name] <= high)
    return row


def orthos(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Verify drawn pairs by each program that has an environment. Resolutions differ by less than 3 times."""
    pythons = {"ours": Path(sys.executable), "arosics": given.arosics, "karios": given.karios}
    rows = []
    for seed in range(*map(int, given.seeds.split(":"))):
        pair = drawn(seed, elsewhere=given.elsewhere)
        ratio = pair.ortho.gsd / pair.reference.gsd
        if not 1 / 3 < ratio < 3:
            continue
        with tempfile.TemporaryDirectory() as folder:
            case = Case(pair, *pair.write(Path(folder)), Path(folder))
            row = {"seed": seed, "ratio": ratio, "clouds": pair.ortho.clouds, "season": pair.ortho.season}
            row["shift"], row["bend"] = float(np.hypot(*pair.shift)) / case.coarse, pair.bend / case.coarse
            row |= {name: compared(name, python, case) for name, python in pythons.items() if python is not None}
        rows.append(row)
        if given.out:
            with given.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    return rows


def told(rows: list[dict[str, Any]]) -> str:
    """Return what rows say together: medians over the pairs that a program could measure."""
    lines = [f"{len(rows)} pairs; px of the coarser image, medians"]
    for name in PEERS:
        here = [row[name] for row in rows if name in row]
        done = [row for row in here if "failed" not in row]
        if not done:
            lines.append(f"{name}: {len(here)} pairs, none measured")
            continue
        parts = [f"{name}: {len(done)} of {len(here)} measured"]
        for key, text in (("median", "left"), ("bias", "bias left"), ("rmse_claim", "RMSE stated off by"),
                          ("ce90_claim", "CE90 stated off by"), ("seconds", "s"), ("processor", "s of the processor"),
                          ("megabytes", "MB")):  # fmt: skip
            parts.append(f"{text} {np.median([abs(row[key]) for row in done]):.3g}")
        covered = [row[key] for row in done for key in ("rmse_covered", "ce90_covered") if key in row]
        parts.append(f"{sum(covered)} of {len(covered)} intervals cover" if covered else "no intervals")
        lines.append(", ".join(parts))
    return "\n".join(lines)


JOBS: dict[str, Callable[[argparse.Namespace], list[dict[str, Any]]]] = {"orthos": orthos}


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", choices=JOBS)
    parser.add_argument("--arosics", type=Path, help="Python of an environment that has AROSICS")
    parser.add_argument("--karios", type=Path, help="Python of an environment that has KARIOS")
    parser.add_argument("--seeds", default="6000:6020")
    parser.add_argument("--elsewhere", action="store_true", help="references of other places: none should be measured")
    parser.add_argument("--out", type=Path, help="a line of JSON for each pair")
    parser.add_argument("--read", type=Path, nargs="*", help="only count what such files say")
    given = parser.parse_args()
    if given.read:
        rows = [json.loads(line) for path in given.read for line in path.read_text().splitlines()]
    else:
        rows = JOBS[given.job](given)
    print(told(rows))


if __name__ == "__main__":
    main()
