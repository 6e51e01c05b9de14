"""Stacks of known truth: what `ortho stack` finds, compared with aligning each date with one master.

    python benchmarks/stack.py network --seeds 0:20 --dates 40
    python benchmarks/stack.py network --seeds 0:1 --dates 300
    python benchmarks/stack.py images --dates 20 --side 500 --out images.jsonl
    python benchmarks/stack.py images --dates 20 --side 500 --arosics aro/bin/python

`network` draws edges (tests/stack/networks.py) and runs the network alone. `images` draws rasters
(tests/stack/rasters.py), matches them and measures misfit, moving ground and time. Misfit is the length of the error
between any two dates, in px. The usual way matches each date with the middle one alone: with our matcher, and with
AROSICS (the median of its tie points). `--wrong-edges` displaces all matches of some pairs by 2 to 15 px on both axes.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from osgeo import gdal

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "tests" / "matching"), str(ROOT / "tests" / "orthos"), str(ROOT / "tests" / "stack")]

from networks import Truth  # noqa: E402
from peers import AROSICS, PeerFailed, measured, result_of  # noqa: E402
from rasters import Rasters  # noqa: E402

from ortho_pipeline.batch.stack.command import stack  # noqa: E402
from ortho_pipeline.batch.stack.matching import EdgeMatches, read_matches  # noqa: E402
from ortho_pipeline.block.stack.adjustment import adjust  # noqa: E402
from ortho_pipeline.commands.orthos.aligning import align  # noqa: E402
from ortho_pipeline.errors import OrthoError  # noqa: E402
from ortho_pipeline.imaging.matching.chip_search import SIDE  # noqa: E402
from ortho_pipeline.options import MatchOptions, OutputOptions  # noqa: E402

#: What `network` draws besides errors of up to 20 px.
KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "moving": {"moving": 0.1},
    "hard": {"moving": 0.4, "wrong": 0.05, "hidden": 0.3},
    "rough": {"length": 0.05, "of_date": 0.1, "of_edge": 0.1},
    "long": {"length": 0.3, "of_date": 0.1, "of_edge": 0.1},
    "sharp": {"sharp": True},
    "sharp and rough": {"sharp": True, "length": 0.05, "of_date": 0.1, "of_edge": 0.1},
    "sloped": {"sloped": 5},
    "step": {"scatter": 0.5, "step": 2.0},
}


def misfit(errors: np.ndarray) -> np.ndarray:
    """Return the lengths of the errors between any two dates; errors ``(T, 2)``."""
    one, other = np.triu_indices(len(errors), 1)
    return np.asarray(np.hypot(*(errors[one] - errors[other]).T))


def network(seed: int, dates: int, kind: str) -> dict[str, Any]:
    """Return what the network finds of one draw."""
    made = Truth(seed=seed, dates=dates, **KINDS[kind]).made()
    begin = time.process_time()
    found = adjust(made.truth.cells, made.edges, made.years.tolist())
    seconds = time.process_time() - begin
    errors = found.network.value[:, 0] - (made.shift - made.shift.mean(axis=0))
    apart, moving = misfit(errors), found.motion.moving
    drift = np.polyfit(made.years, errors, 1)[0] * np.ptp(made.years) if dates > 2 else np.zeros(2)
    return {
        "seed": seed, "kind": kind, "edges": len(made.edges), "seconds": seconds,
        "squares": float(((errors / found.sigma) ** 2).mean()),
        "median": float(np.median(apart)), "p95": float(np.quantile(apart, 0.95)),
        "drift": float(np.abs(drift).max()),
        "wrong": int(made.wrong.sum()), "wrong_found": int((made.wrong & ~found.closures.accepted).sum()),
        "right_lost": int((~made.wrong & ~found.closures.accepted).sum()),
        "moving": int(made.moving.sum()), "moving_found": int((made.moving & moving).sum()),
        "still_moving": int((~made.moving & moving).sum()),
        "steps": len(found.steps), "step_found": any(abs(one.date - dates // 2) <= 1 for one in found.steps),
    }  # fmt: skip


def told(rows: list[dict[str, Any]]) -> str:
    """Return what rows of one kind say together."""

    def sums(name: str) -> int:
        return sum(row[name] for row in rows)

    def mean(name: str) -> float:
        return float(np.mean([row[name] for row in rows]))

    return (
        f"{rows[0]['kind']}: {len(rows)} stacks of {rows[0]['edges']} edges; spread {np.sqrt(mean('squares')):.2f}; "
        f"misfit median {mean('median'):.3f}, 95 % {mean('p95'):.3f} px; drift {mean('drift'):.3f} px; "
        f"wrong edges {sums('wrong_found')} of {sums('wrong')} found, {sums('right_lost')} right ones lost; "
        f"moving cells {sums('moving_found')} of {sums('moving')} found, {sums('still_moving')} false; "
        f"stacks with steps {sum(row['steps'] > 0 for row in rows)}, right ones {sums('step_found')}; "
        f"CPU {np.median([row['seconds'] for row in rows]):.1f} s"
    )


@dataclass
class Spoiled:
    """Reads the matches of pairs, and displaces all matches of a share of them."""

    seed: int
    share: float
    pairs: set[tuple[str, str]] = field(default_factory=set)

    def __call__(self, path: Path) -> EdgeMatches:
        """Return the matches in a file; pixels have one metre."""
        found = read_matches(path)
        random = np.random.default_rng([self.seed, zlib.crc32(path.name.encode())])
        if random.random() >= self.share:
            return found
        self.pairs.add((found.first, found.second))
        shift = random.uniform(2, 15, 2) * random.choice([-1, 1], 2)
        return found.model_copy(update={"shown": tuple(map(tuple, (np.array(found.shown) + shift).tolist()))})


def images(given: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Return what `ortho stack` finds of one drawn stack, and what the usual way finds."""
    rasters = Rasters(
        seed=seed, side=given.side, dates=given.dates, interval=given.interval, error=20.0, seasons=4, sun=given.sun,
        clouds=0.3, noise=0.02, moving=given.moving, rate=1.0, ground=("country", "woods", "town")[seed % 3],
        wrong=(given.dates // 3,) if given.wrong else (),
    )  # fmt: skip
    true = rasters.shifts()
    kept = np.array([number not in rasters.wrong for number in range(given.dates)])
    output = OutputOptions(resampling="cubic", threads=1, format="GTiff")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = rasters.write(folder / "in", given.workers)
        begin, wall = _cpu(), time.monotonic()
        with_workers: Any = {"executor": "processes", "workers": given.workers} if given.workers > 1 else {}
        match, spoiled = MatchOptions(search=60.0), Spoiled(seed, given.wrong_edges)
        with mock.patch("ortho_pipeline.batch.stack.matching.read_matches", spoiled):
            document = stack([folder / "in"], folder / "out", match=match, output=output, **with_workers).document
        seconds, wall = _cpu() - begin, time.monotonic() - wall
        found = np.array([one["shift_px"] or (np.nan, np.nan) for one in document["dates"]])
        sigma = np.array([one["sigma_px"] or (np.nan, np.nan) for one in document["dates"]])
        master = given.dates // 2
        usual = {}
        if not given.alone:
            usual["usual"] = _each(paths, master, lambda path: _ours(path, paths[master], folder, output))
        if given.arosics:
            usual["arosics"] = _each(paths, master, lambda path: _arosics(given.arosics, path, paths[master], folder))
    known = kept & np.isfinite(found).all(axis=1)
    errors = (found - true)[known]
    errors = errors - errors.mean(axis=0)
    cells = np.array([one["place"] for one in document["cells"]])
    moving, tested = (np.array([one[name] for one in document["cells"]]) for name in ("moving", "tested"))
    steady = np.array([one["form"] == "steady" for one in document["cells"]])
    truth = rasters.moves(cells) & tested
    still = _still(rasters, cells) & tested
    status = [one["status"] for one in document["pairs"]]
    wrong = [(one["first"], one["second"]) in spoiled.pairs for one in document["pairs"]]
    return {
        "seed": seed, "dates": given.dates, "side": given.side, "pairs": len(status),
        **{one.replace(" ", "_"): status.count(one) for one in ("accepted", "rejected", "not matched", "untested")},
        "wrong": sum(wrong),
        "wrong_found": sum(one == "rejected" and bad for one, bad in zip(status, wrong, strict=True)),
        **_of(found - true, kept), "of": int(kept.sum()),
        "spread": float(np.sqrt(((errors / sigma[known]) ** 2).mean())),
        **{f"{name}_{key}": value for name, each in usual.items() for key, value in _of(each - true, kept).items()},
        "moving": int(truth.sum()), "moving_found": int((truth & moving).sum()),
        "still": int(still.sum()), "still_moving": int((still & moving).sum()),
        "still_steady": int((still & moving & steady).sum()),
        "partly_moving": int((~truth & ~still & moving).sum()), "steps": len(document["steps"]), "seconds": seconds,
        "wall": wall, "mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }  # fmt: skip


def _still(rasters: Rasters, cells: np.ndarray) -> np.ndarray:
    """Tell in which cells ``(n, 2)`` nothing moves, nor within half a chip of them."""
    reach = np.diff(np.unique(cells[:, 0]))[0] / 2 + SIDE / 2
    steps = np.stack(np.meshgrid(*2 * [np.linspace(-reach, reach, 21)]), axis=-1).reshape(-1, 2)
    return np.array([not rasters.moves(cell + steps).any() for cell in cells])


def _cpu() -> float:
    """Return the seconds of processors that this process and its ended children took."""
    both = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return sum(one.ru_utime + one.ru_stime for one in both)


def _of(errors: np.ndarray, kept: np.ndarray) -> dict[str, float]:
    """Return how many dates have an error ``(T, 2)``, and the misfit between these."""
    known = errors[kept & np.isfinite(errors).all(axis=1)]
    apart = misfit(known)
    return {"known": len(known), "median": float(np.median(apart)), "p95": float(np.quantile(apart, 0.95))}


def _each(paths: list[Path], master: int, shift: Callable[[Path], np.ndarray]) -> np.ndarray:
    """Return shifts of all dates relative to one, each matched with it alone; NaN where that fails."""
    found = np.full((len(paths), 2), np.nan)
    found[master] = 0.0
    for number, path in enumerate(paths):
        if number != master:
            with suppress(OrthoError, PeerFailed):
                found[number] = shift(path)
    return found


def _ours(path: Path, master: Path, folder: Path, output: OutputOptions) -> np.ndarray:
    match = MatchOptions(reference=(str(master),), search=60.0)
    done = align(path, folder / "usual", match=match, output=output, resample=False)
    return np.array(done.document["correction"]["shift_px"])


def _arosics(python: Path, path: Path, master: Path, folder: Path) -> np.ndarray:
    """Return the median shift by AROSICS; pixels have one metre."""
    step = max(8, gdal.Open(str(path)).RasterXSize // 20)
    found = result_of(measured([python, "-c", AROSICS, master, path, str(step), "60"], folder))
    if not found["shift"]:
        raise PeerFailed("no tie points")
    # Its shifts correct the ortho: the opposite of the displacement. Rows count to the south.
    return np.array(np.median(found["shift"], axis=0) * (-1.0, 1.0))


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["network", "images"])
    parser.add_argument("--seeds", default="0:1", help="first:last, the last not included")
    parser.add_argument("--dates", type=int, default=20)
    parser.add_argument("--kinds", default=",".join(KINDS), help="of network, with commas")
    parser.add_argument("--side", type=int, default=500, help="columns and rows of images")
    parser.add_argument("--interval", type=float, default=50.0, help="mean days between images")
    parser.add_argument("--moving", type=float, default=0.2, help="share of the images that moves")
    parser.add_argument("--sun", type=float, default=1.5, help="how much slopes change with the sun")
    parser.add_argument("--wrong", action="store_true", help="one date shows another place")
    parser.add_argument("--wrong-edges", type=float, default=0.0, help="share of the pairs with displaced matches")
    parser.add_argument("--alone", action="store_true", help="without the usual way")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--arosics", type=Path, help="Python of an environment that has AROSICS")
    parser.add_argument("--out", type=Path, help="a line of JSON for each stack")
    given = parser.parse_args()
    seeds = range(*map(int, given.seeds.split(":")))
    for kind in given.kinds.split(",") if given.what == "network" else [""]:
        rows = []
        for seed in seeds:
            rows.append(network(seed, given.dates, kind) if kind else images(given, seed))
            if given.out:
                with given.out.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
            if not kind:
                print(json.dumps(rows[-1], indent=1), flush=True)
        if kind:
            print(told(rows), flush=True)


if __name__ == "__main__":
    main()
