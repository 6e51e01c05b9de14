"""AROSICS on the same drawn pairs as `ortho verify`: what remains displaced, and the time.

    python -m venv peers && peers/bin/pip install arosics     # an environment of its own
    python benchmarks/ortho_peers.py --arosics peers/bin/python --seeds 0:20 --out peers.jsonl

Pairs whose resolutions differ by 3 times or more are left out: AROSICS resamples them to the finer grid.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "tests" / "matching"), str(ROOT / "tests" / "orthos")]

from pairs import Pair, drawn  # noqa: E402

#: Runs in the environment of AROSICS; prints tie points (metres) as JSON.
AROSICS = """
import json, sys, time
from arosics import COREG_LOCAL
reference, ortho, step, shift = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
begin = time.monotonic()
made = COREG_LOCAL(reference, ortho, grid_res=step, max_shift=shift, window_size=(128, 128), CPUs=1, q=True,
                   progress=False)
table = made.CoRegPoints_table
good = table[(table.ABS_SHIFT > -9999) & (table.OUTLIER == False)]
print("RESULT" + json.dumps({
    "image": good[["X_IM", "Y_IM"]].values.tolist(), "metres": good[["X_SHIFT_M", "Y_SHIFT_M"]].values.tolist(),
    "tried": len(table), "seconds": time.monotonic() - begin}))
"""


def arosics(python: Path, ortho: Path, reference: Path, pair: Pair) -> dict[str, Any]:
    """Return what AROSICS leaves of the displacement, in px of the coarser image."""
    coarse = max(pair.ortho.gsd, pair.reference.gsd)
    step = max(8, pair.pixels // 20)
    shift = int(1.3 * np.hypot(*pair.shift) / min(pair.ortho.gsd, pair.reference.gsd) + 10)
    words = [str(python), "-c", AROSICS, str(reference), str(ortho), str(step), str(shift)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    line = next((one for one in done.stdout.splitlines() if one.startswith("RESULT")), None)
    if line is None:
        return {"failed": (done.stderr.strip().splitlines() or ["no result"])[-1][:200]}
    found = json.loads(line.removeprefix("RESULT"))
    if len(found["image"]) < 3:
        return {"failed": f"{len(found['image'])} tie points"}
    image, metres = np.array(found["image"], dtype=float), np.array(found["metres"])
    # Its shifts correct the ortho: the opposite of the displacement.
    left = pair.displacement()(image + 0.5) + metres
    return {
        "points": len(image), "tried": found["tried"], "seconds": found["seconds"],
        "bias": float(np.hypot(*left.mean(axis=0))) / coarse,
        "median": float(np.median(np.hypot(*left.T))) / coarse,
    }  # fmt: skip


def ours(ortho: Path, reference: Path, pair: Pair) -> dict[str, Any]:
    """Return what the field of `ortho verify` leaves."""
    coarse = max(pair.ortho.gsd, pair.reference.gsd)
    search = 1.3 * float(np.hypot(*pair.shift)) + 10 * coarse
    words = [sys.executable, "-m", "ortho_pipeline", "verify", str(ortho), "--reference", str(reference)]
    begin = time.monotonic()
    done = subprocess.run(
        [*words, "--search", str(search), "--threads", "1", "--json"], capture_output=True, text=True, check=False
    )
    seconds = time.monotonic() - begin
    document = json.loads(done.stdout)
    if "error" in document:
        return {"failed": document["error"]["message"]}
    cells = np.array([one["image"] for one in document["field"]["cells"]])
    found = np.array([[one["east_m"], one["north_m"]] for one in document["field"]["cells"]])
    left = pair.on_the_ground(cells) - found
    return {
        "points": document["matches"]["kept"], "tried": document["matches"]["tried"], "seconds": seconds,
        "bias": float(np.hypot(*left.mean(axis=0))) / coarse,
        "median": float(np.median(np.hypot(*left.T))) / coarse,
    }  # fmt: skip


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arosics", type=Path, required=True, help="Python of an environment that has AROSICS")
    parser.add_argument("--seeds", default="0:10")
    parser.add_argument("--elsewhere", action="store_true", help="references of other places")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    for seed in range(*map(int, given.seeds.split(":"))):
        pair = drawn(seed, elsewhere=given.elsewhere)
        ratio = pair.ortho.gsd / pair.reference.gsd
        if not 1 / 3 < ratio < 3:
            continue
        with tempfile.TemporaryDirectory() as folder:
            ortho, reference = pair.write(Path(folder))
            row = {"seed": seed, "ratio": ratio, "clouds": pair.ortho.clouds, "season": pair.ortho.season}
            row["ours"] = ours(ortho, reference, pair)
            row["arosics"] = arosics(given.arosics, ortho, reference, pair)
        with given.out.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps(row))


if __name__ == "__main__":
    main()
