"""The same orthorectification by several programs: time, memory, error, and what they do with ten faults.

    python benchmarks/peers_warp.py --out peers.json                    GDAL, and OTB where it is installed
    python benchmarks/peers_warp.py --rasterio P --orthority P          and Python of environments with these
    python benchmarks/peers_warp.py --read peers.json                   the table of faults into docs/comparison.md

`make peers` makes the environments. Each pixel of the image holds its own position, so every pixel of every ortho is
compared with an exact calculation. The DEM is once in EPSG:4326, as most are, and once in the CRS of the ortho.

A fault is *refused* (the program fails, and leaves no ortho), *said* (the ortho is wrong, and the program wrote a
warning), *silent* (wrong without a word), or *right*: fewer than one filled pixel in a thousand is off by more than
1 px.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from osgeo import gdal, osr
from warp import GSD, LAT, LON, UTM, Job, Run, apart, errors, gdalwarp, machine, measure, otb, otb_works, ours

from ortho_pipeline.exchange.rpc import rpc_metadata

gdal.UseExceptions()
ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "comparison.md"
DEMS = ("EPSG:4326", f"EPSG:{UTM}")
RASTERIO = """
import sys, rasterio
from rasterio.transform import from_origin
from rasterio.warp import Resampling, reproject
image, dem, out, step, *extent = sys.argv[1:]
step, (left, bottom, right, top) = float(step), [float(value) for value in extent]
with rasterio.open(image) as source:
    shape = {"width": round((right - left) / step), "height": round((top - bottom) / step), "count": source.count}
    with rasterio.open(out, "w", driver="GTiff", dtype=source.dtypes[0], crs="EPSG:32735", nodata=0, tiled=True,
                       blockxsize=512, blockysize=512, transform=from_origin(left, top, step, step), **shape) as made:
        bands = list(range(1, source.count + 1))
        reproject(rasterio.band(source, bands), rasterio.band(made, bands), rpcs=source.rpcs, src_crs="EPSG:4326",
                  dst_crs="EPSG:32735", resampling=Resampling.bilinear, num_threads=2, RPC_DEM=dem)
"""
#: Words in the output of a program that warn.
_WARNS = re.compile(r"\bwarning|\berror", re.IGNORECASE)
_WRONG = 1e-3


@dataclass(frozen=True)
class Program:
    """A program: `words` for a job and an empty folder for its output, and where its ortho then is."""

    words: Callable[[Job, Path], list[str] | None]
    ortho: Callable[[Job, Path], Path] = lambda _, out: out / "ortho.tif"


def _rasterio(python: Path) -> Program:
    def words(job: Job, out: Path) -> list[str]:
        files = (job.image, job.dem, out / "ortho.tif")
        return [str(python), "-c", RASTERIO, *map(str, files), str(GSD), *map(str, job.extent)]

    return Program(words)


def _orthority(python: Path) -> Program:
    def words(job: Job, out: Path) -> list[str]:
        return [
            str(python.parent / "oty"), "rpc", "--dem", str(job.dem), "--crs", f"EPSG:{UTM}", "--res", str(GSD),
            "--interp", "bilinear", "--dem-interp", "bilinear", "--no-build-ovw", "-co", "TILED=YES",
            "--out-dir", str(out), "--overwrite", str(job.image),
        ]  # fmt: skip

    return Program(words, lambda job, out: out / f"{job.image.stem}_ORTHO.tif")


def programs(given: argparse.Namespace, job: Job) -> dict[str, Program]:
    """Return the programs that are here. GDAL is there twice: as it comes, and with threads, memory and cache."""
    tuned = ("-wm", "1024", "--config", "GDAL_CACHEMAX", "1024")
    found = {
        "ortho rectify": Program(ours, lambda job, out: out / f"{job.image.stem}_ortho.tif"),
        "gdalwarp": Program(lambda job, out: _plain(gdalwarp(job, out / "ortho.tif", "bilinear"))),
        "gdalwarp, tuned": Program(lambda job, out: gdalwarp(job, out / "ortho.tif", "bilinear", *tuned)),
    }
    if given.rasterio:
        found["rasterio"] = _rasterio(given.rasterio)
    if given.orthority:
        found["orthority"] = _orthority(given.orthority)
    if otb_works(job, job.folder / "otb.tif"):
        found["OTB"] = Program(lambda job, out: otb(job, out / "ortho.tif"))
    else:
        print("Skipped: OTB is not installed (apt-get install otb-bin), or does not take the scene", file=sys.stderr)
    return found


def _plain(words: list[str]) -> list[str]:
    """Return `gdalwarp` without what tunes it: threads, and scales that do not depend on its chunks."""
    kept, skip = [], False
    for number, word in enumerate(words):
        if skip:
            skip = False
        elif word == "-wo":
            skip = True
        elif word != "-multi" or number == 0:
            kept.append(word)
    return kept


def timed(found: dict[str, Program], jobs: dict[str, Job], rounds: int) -> dict[str, dict[str, Any]]:
    """Alternate all programs with both DEMs; return runs, and errors of the last orthos in px."""
    runs: dict[str, dict[str, list[Run]]] = {dem: {} for dem in jobs}
    told: dict[str, dict[str, Any]] = {dem: {} for dem in jobs}
    first = next(iter(jobs.values()))
    measure(ours(first, first.folder / "warm"))
    for number in range(rounds):
        for dem, job in jobs.items():
            for name, program in found.items():
                out = job.folder / "out"
                shutil.rmtree(out, ignore_errors=True)
                out.mkdir()
                words = program.words(job, out)
                assert words is not None
                runs[dem].setdefault(name, []).append(measure(words))
                if number == rounds - 1:
                    # In a process of its own: the peak memory of a program begins with that of its parent.
                    told[dem][name] = apart(_size_of_errors, job, program.ortho(job, out))
        print(f"round {number + 1}: {runs}", file=sys.stderr)
    for dem, here in runs.items():
        for name, taken in here.items():
            base = here["ortho rectify"]
            ratios = [one.wall / other.wall for one, other in zip(taken, base, strict=True)]
            told[dem][name] |= {
                "runs": [asdict(run) for run in taken], "ratio": statistics.median(ratios),
                "cpu_ratio": statistics.median(a.cpu / b.cpu for a, b in zip(taken, base, strict=True)),
            }  # fmt: skip
    return told


def _size_of_errors(job: Job, ortho: Path) -> dict[str, float]:
    off = errors(job, ortho, filled=True)
    return {"max_px": float(off.max()), "rms_px": float(np.sqrt(np.mean(off**2.0)))}


#: What is wrong with a folder that holds the scene and its DEM.
Fault = Callable[[Job], None]


def _dem(job: Job, change: Callable[[gdal.Dataset, np.ndarray], np.ndarray]) -> None:
    dataset = gdal.Open(str(job.dem), gdal.GA_Update)
    heights = change(dataset, dataset.ReadAsArray())
    dataset.WriteArray(heights)
    dataset.FlushCache()


def half_a_dem(job: Job) -> None:
    """Cut the DEM to its western half."""
    whole = gdal.Open(str(job.dem))
    cut = job.folder / "cut.tif"
    gdal.Translate(str(cut), whole, srcWin=[0, 0, whole.RasterXSize // 2, whole.RasterYSize])
    cut.replace(job.dem)


def hole(job: Job) -> None:
    """Put nodata into the middle of the DEM."""

    def change(dataset: gdal.Dataset, heights: np.ndarray) -> np.ndarray:
        dataset.GetRasterBand(1).SetNoDataValue(-32768)
        rows, columns = heights.shape
        heights[rows // 2 - 4 : rows // 2 + 4, columns // 2 - 4 : columns // 2 + 4] = -32768
        return heights

    _dem(job, change)


def elsewhere(job: Job) -> None:
    """Move the DEM by 100 km."""

    def change(dataset: gdal.Dataset, heights: np.ndarray) -> np.ndarray:
        left, *rest = dataset.GetGeoTransform()
        dataset.SetGeoTransform((left + 1e5, *rest))
        return heights

    _dem(job, change)


def feet(job: Job) -> None:
    """State heights in feet, as the unit of the band says."""

    def change(dataset: gdal.Dataset, heights: np.ndarray) -> np.ndarray:
        dataset.GetRasterBand(1).SetUnitType("ft")
        return heights / 0.3048

    _dem(job, change)


def no_crs(job: Job) -> None:
    """Remove the CRS of the DEM."""
    _dem(job, lambda dataset, heights: (dataset.SetProjection(""), heights)[1])


def _above_geoid(job: Job, *, said: bool) -> None:
    """Give heights above EGM96, by GDAL's own transformation."""
    two, three = osr.SpatialReference(), osr.SpatialReference()
    two.SetFromUserInput("EPSG:4979")
    three.SetFromUserInput("EPSG:4326+5773")
    for reference in (two, three):
        reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    lowered = osr.CoordinateTransformation(two, three).TransformPoint(LON, LAT, 0.0)[2]
    assert abs(lowered) > 10, "PROJ does not find the grid of EGM96"

    def change(dataset: gdal.Dataset, heights: np.ndarray) -> np.ndarray:
        if said:
            compound = osr.SpatialReference()
            compound.SetFromUserInput(f"EPSG:{UTM}+5773")
            dataset.SetSpatialRef(compound)
        return heights + lowered

    _dem(job, change)


def other_rpc(job: Job) -> None:
    """Put the RPC of another image, 50 px away, next to the image, whose tag has the right one."""
    fields = rpc_metadata(job.model())
    fields["SAMP_OFF"] = str(float(fields["SAMP_OFF"]) + 50)
    names = [name for name in fields if not name.endswith("_COEFF")]
    lines = [f"{name}: {fields[name]}" for name in names]
    for name in ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF"):
        lines += [f"{name}_{k + 1}: {value}" for k, value in enumerate(fields[name].split())]
    job.image.with_name(f"{job.image.stem}_RPC.TXT").write_text("\n".join(lines) + "\n")


def no_number(job: Job) -> None:
    """Make a coefficient of the RPC no number."""
    fields = rpc_metadata(job.model())
    fields["LINE_NUM_COEFF"] = " ".join(["nan", *fields["LINE_NUM_COEFF"].split()[1:]])
    gdal.Open(str(job.image), gdal.GA_Update).SetMetadata(fields, "RPC")


def cut_off(job: Job) -> None:
    """Keep the first 60 % of the bytes of the image."""
    data = job.image.read_bytes()
    job.image.write_bytes(data[: len(data) * 6 // 10])


def full_disk(job: Job) -> None:
    """Leave the files as they are: no file may be larger than 2 MB (`prlimit`)."""


FAULTS: dict[str, Fault] = {
    "half a DEM": half_a_dem,
    "DEM with a hole": hole,
    "DEM of another place": elsewhere,
    "DEM without CRS": no_crs,
    "DEM in feet": feet,
    "geoid heights, stated": lambda job: _above_geoid(job, said=True),
    "geoid heights, not stated": lambda job: _above_geoid(job, said=False),
    "two different RPCs": other_rpc,
    "NaN in the RPC": no_number,
    "truncated image": cut_off,
    "full disk": full_disk,
}


def behaviour(found: dict[str, Program], job: Job) -> dict[str, dict[str, str]]:
    """Return what each program does with each fault of a small scene."""
    told: dict[str, dict[str, str]] = {}
    for fault, spoil in FAULTS.items():
        for name, program in found.items():
            if name in ("gdalwarp, tuned", "OTB"):  # as gdalwarp; another file than the others has the RPC of OTB
                continue
            with tempfile.TemporaryDirectory(dir=job.folder) as folder:
                here = Job(Path(folder), job.side, kind=job.kind, dem_crs=job.dem_crs)
                shutil.copy(job.image, here.image)
                shutil.copy(job.dem, here.dem)
                spoil(here)
                out = Path(folder) / "out"
                out.mkdir()
                words = program.words(here, out)
                assert words is not None
                if "geoid" in fault:
                    words = [word for word in words if word not in ("--dem-vertical", "ellipsoid")]
                if fault == "full disk":
                    words = ["prlimit", "--fsize=2000000", *words]
                done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=600)
                told.setdefault(fault, {})[name] = _verdict(job, program.ortho(here, out), done)
                print(f"{fault}: {name}: {told[fault][name]}: {done.stderr.strip()[:200]!r}", file=sys.stderr)
    return told


def _verdict(job: Job, ortho: Path, done: subprocess.CompletedProcess[str]) -> str:
    if done.returncode:
        return "leaves a file" if ortho.exists() else "refused"
    try:
        off = errors(job, ortho, filled=True)
    except RuntimeError:
        return "unreadable ortho"
    wrong = float(np.mean(off > 1.0)) if off.size else 0.0
    if not off.size:
        return "empty, said" if _WARNS.search(done.stdout + done.stderr) else "empty, silent"
    if wrong < _WRONG:
        return "right"
    said = "said" if _WARNS.search(done.stdout + done.stderr) else "silent"
    return f"{said}: {np.median(off[off > 1.0]):.0f} px"


def times(document: dict[str, Any]) -> str:
    """Return the table of time, memory and error as Markdown."""
    names = list(document["times"][DEMS[0]])
    lines = ["| | DEM in EPSG:4326 | DEM in the CRS of the ortho | memory | largest error |", "|---|---|---|---|---|"]
    for name in names:
        first, second = (document["times"][dem][name] for dem in DEMS)
        memory = statistics.median(run["memory"] for run in first["runs"] + second["runs"])
        worst = max(first["max_px"], second["max_px"])
        cells = [f"{statistics.median(run['wall'] for run in one['runs']):.1f} s, {one['ratio']:.1f}" for one in
                 (first, second)]  # fmt: skip
        lines.append(f"| {name} | {cells[0]} | {cells[1]} | {memory:.0f} MB | {worst:.3f} px |")
    return "\n".join(lines)


def faults(document: dict[str, Any]) -> str:
    """Return the table of faults as Markdown."""
    names = list(next(iter(document["faults"].values())))
    lines = ["| fault | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    lines += [f"| {fault} | {' | '.join(row[name] for name in names)} |" for fault, row in document["faults"].items()]
    return "\n".join(lines)


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rasterio", type=Path, help="Python of an environment that has rasterio")
    parser.add_argument("--orthority", type=Path, help="Python of an environment that has orthority")
    parser.add_argument("--arosics", type=Path, help="not used here: `peers.py orthos`")
    parser.add_argument("--side", type=int, default=4000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, help="all numbers as JSON")
    parser.add_argument("--read", type=Path, help="measure nothing; write the faults of this file")
    given = parser.parse_args()
    if given.read:
        document = json.loads(given.read.read_text())
        begin, _, rest = PAGE.read_text(encoding="utf-8").partition("<!-- peers -->\n")
        end = rest.partition("<!-- end of peers -->")[2]
        PAGE.write_text(f"{begin}<!-- peers -->\n{faults(document)}\n<!-- end of peers -->{end}", encoding="utf-8")
        return
    with tempfile.TemporaryDirectory() as folder:
        jobs = {dem: Job(Path(folder), given.side, kind="ramp", dem_crs=dem).make() for dem in DEMS}
        small = Job(Path(folder), 1000, kind="ramp").make()
        found = programs(given, small)
        document = {
            "machine": machine(), "side": given.side, "times": timed(found, jobs, given.rounds),
            "faults": behaviour(found, small),
        }  # fmt: skip
    print(times(document), faults(document), sep="\n\n")
    if given.out:
        given.out.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
