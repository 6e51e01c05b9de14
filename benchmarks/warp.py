"""Orthorectification speed beside GDAL (and OTB where it is installed), in one run, alternating.

    python benchmarks/warp.py                  the 12000 x 12000 job, three rounds: a table
    python benchmarks/warp.py --dem-crs EPSG:4326    the same with a DEM in longitude and latitude
    python benchmarks/warp.py --scaling        1000² to 40000², 32 bands, Float32, JPEG 2000, one thread
    python benchmarks/warp.py --kernels        by kernel, number of bands and sensor model
    python benchmarks/warp.py --layers         what layers next to the ortho cost, as shares of the warp alone
    python benchmarks/warp.py --cog            COGs with ZSTD and overviews beside GDAL's COG driver on finished pixels
    python benchmarks/warp.py --accuracy       every output pixel of a ramp against an independent exact evaluation

Every figure is of a whole process: wall time, CPU time, peak memory. Outputs are uncompressed tiled GeoTIFFs. What
machines do at one moment differs from the next, so programs take turns and only ratios within a round count.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyproj
from osgeo import gdal, osr

from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.models import RPC, ImageCorrection, SensorModel
from ortho_pipeline.models.rpc_box import RPC_TERMS
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.warp.job import WarpJob
from ortho_pipeline.warp.lattice_engine import rectify
from ortho_pipeline.warp.quality.accuracy import Budget, write_accuracy
from ortho_pipeline.warp.quality.hiding import Hiding
from ortho_pipeline.warp.quality.sight import Sight

gdal.UseExceptions()
_T = TypeVar("_T")

LON, LAT, HEIGHT = 24.4, -33.65, 700.0
GSD = 0.5
DEM_STEP = 30.0
UTM = 32735
TILED = ("TILED=YES", "BLOCKXSIZE=512", "BLOCKYSIZE=512", "BIGTIFF=IF_SAFER")


@dataclass
class Job:
    """A scene of `side` x `side` pixels and the output grid that holds it."""

    folder: Path
    side: int
    bands: int = 1
    kind: str = "uint16"
    dem_crs: str = f"EPSG:{UTM}"

    @property
    def image(self) -> Path:
        end = "jp2" if self.kind == "jp2" else "tif"
        return self.folder / f"scene_{self.side}_{self.bands}_{self.kind}.{end}"

    @property
    def dem(self) -> Path:
        return self.folder / f"dem_{self.side}_{self.dem_crs.replace(':', '')}.tif"

    @property
    def extent(self) -> tuple[float, float, float, float]:
        x, y = pyproj.Transformer.from_crs(4326, UTM, always_xy=True).transform(LON, LAT)
        reach = round(self.side * GSD / 2 * 1.0535)
        return round(x) - reach, round(y) - reach, round(x) + reach, round(y) + reach

    @property
    def megapixels(self) -> float:
        xmin, ymin, xmax, ymax = self.extent
        return (xmax - xmin) * (ymax - ymin) / GSD**2 / 1e6

    def model(self) -> RPC:
        """An RPC with all its terms at work, some 20 degrees off nadir."""
        half, random = self.side / 2, np.random.default_rng(0)
        scale = half * 1.05
        tilt = 0.36 * 500 / GSD / scale
        cubic = random.normal(0, 2e-5, (2, 10))
        zeros = [0.0] * 16
        return RPC(
            half, half, LON, LAT, HEIGHT, scale, scale, scale * GSD / 92_800, scale * GSD / 110_900, 500.0,
            [0.002, 1.0, 0.05, 0.9 * tilt, 1e-3, 4e-4, -3e-4, -6e-4, -5e-4, 8e-6, *cubic[0]],
            [1.0, -1.4e-3, -1.1e-3, -5e-4, *zeros],
            [-0.003, 0.04, -1.0, 0.4 * tilt, -1.5e-3, 2e-5, 3e-4, 4e-4, 3e-4, -3e-6, *cubic[1]],
            [1.0, -1.7e-3, -2e-3, 3e-4, *zeros],
        )  # fmt: skip

    def make(self, *, sparse: bool = False) -> Job:
        """Write scene and DEM, unless they are there."""
        if not self.image.exists() and self.kind == "jp2":
            gdal.Translate(
                str(self.image), str(Job(self.folder, self.side, self.bands).make().image), format="JP2OpenJPEG",
                creationOptions=["QUALITY=100", "REVERSIBLE=YES", "BLOCKXSIZE=1024", "BLOCKYSIZE=1024"],
            )  # fmt: skip
        elif not self.image.exists():
            self._write_image(sparse)
        if not self.dem.exists() and self.dem_crs != f"EPSG:{UTM}":
            original = Job(self.folder, self.side).make(sparse=sparse)
            gdal.Warp(str(self.dem), str(original.dem), dstSRS=self.dem_crs, resampleAlg="bilinear", dstNodata=-9999)
        elif not self.dem.exists():
            self.write_dem()
        return self

    def _write_image(self, sparse: bool) -> None:
        kind = gdal.GDT_UInt16 if self.kind == "uint16" else gdal.GDT_Float32
        bands = 2 if self.kind == "ramp" else self.bands
        options = [*TILED, "SPARSE_OK=TRUE"] if sparse else list(TILED)
        dataset = gdal.GetDriverByName("GTiff").Create(str(self.image), self.side, self.side, bands, kind, options)
        dataset.SetMetadata(rpc_metadata(self.model()), "RPC")
        columns, random = np.arange(self.side), np.random.default_rng(1)
        for top in range(0, 0 if sparse else self.side, 512):
            rows = np.arange(top, min(top + 512, self.side))[:, None]
            if self.kind == "ramp":
                for band, ramp in enumerate((columns + 0.5 + 0 * rows, rows + 0.5 + 0 * columns)):
                    dataset.GetRasterBand(band + 1).WriteArray(ramp, 0, top)
                continue
            field = 1000 + 400 * np.sin(columns / 37) * np.cos(rows / 53) + 200 * np.sin((columns + 2 * rows) / 7)
            for band in range(bands):
                noise = random.normal(0, 20, field.shape)
                values = (field + noise).astype(np.uint16 if self.kind == "uint16" else np.float32)
                dataset.GetRasterBand(band + 1).WriteArray(values, 0, top)

    def write_dsm(self) -> Path:
        """Write a surface model of 1 m: the rough terrain, smoothed, with blocks of houses of 6 to 40 m."""
        path = self.folder / f"dsm_{self.side}.tif"
        if path.exists():
            return path
        xmin, _, xmax, ymax = self.extent
        count, margin = int(xmax - xmin) + 200, 100.0
        reference = osr.SpatialReference()
        reference.ImportFromEPSG(UTM)
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), count, count, 1, gdal.GDT_Float32, list(TILED))
        dataset.SetSpatialRef(reference)
        dataset.SetGeoTransform((xmin - margin, 1.0, 0, ymax + margin, 0, -1.0))
        houses = np.random.default_rng(3).uniform(6, 40, (count // 40 + 1, count // 40 + 1))
        x = np.arange(count)
        for top in range(0, count, 512):
            y = np.arange(top, min(top + 512, count))[:, None]
            built = (x % 40 < 24) & (y % 40 < 24)
            ground = HEIGHT + 60 * np.sin(x / 600) * np.cos(y / 800)
            dataset.WriteArray((ground + built * houses[y // 40, x // 40]).astype(np.float32), 0, top)
        return path

    def write_dem(self) -> None:
        """Write a rough DEM of ellipsoidal heights."""
        xmin, _, xmax, ymax = self.extent
        margin = 20 * DEM_STEP
        count = int((xmax - xmin + 2 * margin) / DEM_STEP)
        reference = osr.SpatialReference()
        reference.ImportFromEPSG(UTM)
        dataset = gdal.GetDriverByName("GTiff").Create(str(self.dem), count, count, 1, gdal.GDT_Float32)
        dataset.SetSpatialRef(reference)
        dataset.SetGeoTransform((xmin - margin, DEM_STEP, 0, ymax + margin, 0, -DEM_STEP))
        y, x = np.mgrid[:count, :count]
        rough = 200 * np.sin(x / 20) * np.cos(y / 27) + 60 * np.sin(x / 3.1 + y / 5)
        noise = np.random.default_rng(2).normal(0, 8, x.shape)
        dataset.WriteArray((HEIGHT + rough + noise).astype(np.float32))


@dataclass
class Run:
    """What one process took; CPU and wall in seconds, memory in MB."""

    wall: float
    cpu: float
    memory: float


def apart(work: Callable[..., _T], *given: Any, **more: Any) -> _T:
    """Return what a function returns in a process of its own: Linux counts the peak of a parent as its children's."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *given, **more).result()


def measure(command: list[str], surroundings: dict[str, str] | None = None, folder: Path | None = None) -> Run:
    """Run a program in a folder; its own resource usage comes from the kernel when it ends.

    Python keeps its compiled modules, as in an installed package: a fresh checkout would compile 240 in each run.
    """
    surroundings = dict(os.environ if surroundings is None else surroundings)
    surroundings.pop("PYTHONDONTWRITEBYTECODE", None)
    begin = time.perf_counter()
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=surroundings, cwd=folder)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            log.seek(0)
            raise SystemExit(f"{' '.join(command)} failed:\n{log.read().decode(errors='replace')}")
    return Run(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def ours(job: Job, out: Path, kernel: str = "bilinear", *extra: str) -> list[str]:
    """`ortho rectify`, with everything that it writes besides the ortho."""
    shutil.rmtree(out, ignore_errors=True)
    return [
        sys.executable, "-m", "ortho_pipeline", "rectify", str(job.image), "--dem", str(job.dem),
        "--dem-vertical", "ellipsoid", "-t_srs", f"EPSG:{UTM}", "-te", *map(str, job.extent), "-tr", str(GSD),
        "-r", kernel, "--format", "GTiff", "-o", str(out), *extra,
    ]  # fmt: skip


#: The warp alone, as a program calls it: `make()`. Read by regress.py as text, from the commits that it compares.
API = """
import sys, pyproj
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.raster.source import Grid, RasterSource, open_dataset
from ortho_pipeline.exchange.rpc import rpc_of_dataset
from ortho_pipeline.warp.lattice_engine import rectify
from ortho_pipeline.warp.job import WarpJob
image, dem, out, step, *extent = sys.argv[1:]
grid = Grid.of_extent(pyproj.CRS("EPSG:32735"), [float(value) for value in extent], (float(step), float(step)))
model = rpc_of_dataset(open_dataset(image))[0]
def make():
    surface = open_dem(dem, "ellipsoid")
    rectify(WarpJob(model, RasterSource(image), surface, grid, driver="GTiff"), out)
"""


def api(job: Job, out: Path) -> list[str]:
    """A process that does no more than the other programs: open, warp, write; no checksums, models, or report."""
    return [sys.executable, "-c", f"{API}make()", *warped(job, out)]


def warped(job: Job, out: Path) -> list[str]:
    """Return the words for `API`: image, DEM, output, resolution, extent."""
    return [str(job.image), str(job.dem), str(out), str(GSD), *map(str, job.extent)]


def gdalwarp(job: Job, out: Path, kernel: str, *extra: str) -> list[str]:
    """`gdalwarp` with the same grid, two threads, and values that do not depend on its chunks."""
    out.unlink(missing_ok=True)
    create = [part for option in TILED for part in ("-co", option)]
    return [
        "gdalwarp", "-q", "-rpc", "-to", "METHOD=RPC", "-to", f"RPC_DEM={job.dem}", "-t_srs", f"EPSG:{UTM}",
        "-te", *map(str, job.extent), "-tr", str(GSD), str(GSD), "-r", kernel, "-multi", "-wo", "NUM_THREADS=2",
        "-wo", "XSCALE=1", "-wo", "YSCALE=1", *create, *extra, str(job.image), str(out),
    ]  # fmt: skip


def copy(source: Path, out: Path) -> list[str]:
    """A plain copy of as many output pixels: the practical limit."""
    out.unlink(missing_ok=True)
    create = [part for option in TILED for part in ("-co", option)]
    return ["gdal_translate", "-q", *create, str(source), str(out)]


def otb(job: Job, out: Path) -> list[str] | None:
    """OTB's OrthoRectification with its default grid, where OTB is installed.

    OTB 8 reads RPCs of the products that it knows, or a keyword list, and DEMs in longitude and latitude.
    """
    if shutil.which("otbcli_OrthoRectification") is None:
        return None
    geom, dem = job.folder / "otb.geom", job.folder / "otb_dem"
    metadata = rpc_metadata(job.model())
    lines = ["polynomial_format:  B", "sensor:  QB02", "type:  ossimQuickBirdRpcSensor"]
    for part in ("line_num", "line_den", "samp_num", "samp_den"):
        values = enumerate(metadata[f"{part.upper()}_COEFF"].split())
        lines += [f"{part}_coeff_{k:02d}:  {value}" for k, value in values]
    for part in ("line", "samp", "lat", "long", "height"):
        lines += [f"{part}_{what}:  {metadata[f'{part.upper()}_{what.upper()}']}" for what in ("off", "scale")]
    geom.write_text("\n".join(lines) + "\n")
    if not dem.exists():
        dem.mkdir()
        gdal.Warp(str(dem / "dem.tif"), str(job.dem), dstSRS="EPSG:4326", resampleAlg="bilinear")
    xmin, ymin, xmax, ymax = job.extent
    return [
        "otbcli_OrthoRectification", "-io.in", f"{job.image}?&geom={geom}",
        "-io.out", f"{out}?&gdal:co:TILED=YES", "float" if job.kind == "ramp" else "uint16",
        "-map", "epsg", "-map.epsg.code", str(UTM),
        "-elev.dem", str(dem), "-outputs.ulx", str(xmin), "-outputs.uly", str(ymax), "-outputs.spacingx", str(GSD),
        "-outputs.spacingy", str(-GSD), "-outputs.sizex", str(round((xmax - xmin) / GSD)),
        "-outputs.sizey", str(round((ymax - ymin) / GSD)), "-interpolator", "linear", "-opt.ram", "512",
    ]  # fmt: skip


def otb_works(job: Job, out: Path) -> bool:
    """Tell whether OTB is there and takes the scene."""
    command = otb(job, out)
    if command is None:
        return False
    works = subprocess.run(command, capture_output=True, check=False).returncode == 0 and out.exists()
    if not works:
        print("OTB is installed but does not take the scene: left out", file=sys.stderr)
    return works


def headline(job: Job, rounds: int, programs: list[str] | None = None) -> dict[str, list[Run]]:
    """Alternate all programs, or those named; the first call of ours, which may compile, is not counted."""
    folder, runs = job.folder, {}
    measure(ours(job, folder / "warm", "bilinear"))
    measure(ours(job, folder / "warm", "cubic"))
    reference = folder / "warm" / f"{job.image.stem}_ortho.tif"
    with_otb = not programs and otb_works(job, folder / "otb.tif")
    for number in range(rounds):
        turn = {
            "ortho rectify, bilinear": ours(job, folder / "ours", "bilinear"),
            "warp only (Python)": api(job, folder / "api.tif"),
            "gdal_translate (copy)": copy(reference, folder / "copy.tif"),
            "gdalwarp exact, bilinear": gdalwarp(job, folder / "exact.tif", "bilinear", "-et", "0"),
            "ortho rectify, cubic": ours(job, folder / "ours_cubic", "cubic"),
            "gdalwarp exact, cubic": gdalwarp(job, folder / "exact_cubic.tif", "cubic", "-et", "0"),
            "gdalwarp -et 0.125": gdalwarp(job, folder / "fast.tif", "bilinear", "-et", "0.125"),
            "OTB OrthoRectification": otb(job, folder / "otb.tif") if with_otb else None,
        }
        for name, command in turn.items():
            if command is not None and (not programs or name in programs):
                runs.setdefault(name, []).append(measure(command))
        walls = ", ".join(f"{name} {found[-1].wall:.2f} s" for name, found in runs.items())
        print(f"round {number + 1}: {walls}", file=sys.stderr)
    return runs


def cogs(job: Job, pairs: int) -> dict[str, list[Run]]:
    """Alternate `ortho rectify` to a COG with ZSTD and GDAL's COG driver, which copies finished pixels to the same."""
    folder, runs = job.folder, {}
    measure(ours(job, folder / "warm"))
    options = [word for option in ("COMPRESS=ZSTD", "PREDICTOR=YES", "BIGTIFF=IF_SAFER") for word in ("-co", option)]
    finished, copied = folder / "warm" / f"{job.image.stem}_ortho.tif", folder / "copied.tif"
    translate = ["gdal_translate", "-q", "-of", "COG", *options, "-co", "NUM_THREADS=2", str(finished), str(copied)]
    for number in range(pairs):
        rectify_it = ours(job, folder / "ours", "bilinear", *options)
        rectify_it[rectify_it.index("GTiff")] = "COG"
        turn = {"ortho rectify to a COG": rectify_it, "gdal_translate (COG of finished pixels)": translate}
        for name, command in turn.items():
            copied.unlink(missing_ok=True)
            runs.setdefault(name, []).append(measure(command))
        print(f"pair {number + 1}: {', '.join(f'{name} {found[-1]}' for name, found in runs.items())}", file=sys.stderr)
    return runs


def table(runs: dict[str, list[Run]], megapixels: float, base: str) -> str:
    """Return medians, and ratios of wall and CPU time to `base` within each round with their range."""
    lines = [
        "| program | wall s | CPU s | memory MB | Mpx/s | wall ratio | CPU ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, found in runs.items():
        median = [statistics.median(getattr(run, part) for run in found) for part in ("wall", "cpu", "memory")]
        ratios = []
        for part in ("wall", "cpu"):
            pairs = zip(found, runs[base], strict=True)
            values = sorted(getattr(one, part) / getattr(other, part) for one, other in pairs)
            ratios.append(f"{statistics.median(values):.2f} ({values[0]:.2f}-{values[-1]:.2f})")
        speed = megapixels / median[0]
        lines.append(
            f"| {name} | {median[0]:.2f} | {median[1]:.2f} | {median[2]:.0f} | {speed:.1f} | {' | '.join(ratios)} |"
        )
    return "\n".join(lines)


def alone(job: Job, model: SensorModel | None = None, kernel: str = "bilinear") -> float:
    """Return the seconds of the warp alone, in this process, with kernels loaded: no start-up, no report."""
    surface, (xmin, ymin, xmax, ymax) = open_dem(job.dem, "ellipsoid"), job.extent
    grid = Grid.of_extent(pyproj.CRS.from_epsg(UTM), (xmin, ymin, xmax, ymax), (GSD, GSD))
    out = job.folder / "alone.tif"
    source = RasterSource(job.image)
    result = rectify(WarpJob(model or job.model(), source, surface, grid, kernel, driver="GTiff"), out)
    out.unlink()
    return result.seconds


def scaling(folder: Path, rounds: int = 3) -> dict[str, dict[str, Any]]:
    """Whole processes from 1000² to 40000² source pixels, of other kinds, and with one thread; the largest are sparse.

    The fixed cost is that of the smallest scene; what a pixel costs beyond it is compared with 12000² in each round.
    """
    jobs = {f"{side}²": Job(folder, side) for side in (400, 1000, 4000, 12000, 24000, 40000)}
    jobs |= {
        "12000², one thread": jobs["12000²"], "2000², 32 bands": Job(folder, 2000, 32),
        "8000², Float32": Job(folder, 8000, kind="float32"), "4000², JPEG 2000": Job(folder, 4000, kind="jp2"),
    }  # fmt: skip
    found: dict[str, list[Run]] = {name: [] for name in jobs}
    for job in jobs.values():
        apart(job.make, sparse=job.side > 12000)
    for number in range(-1, rounds):
        for name, job in jobs.items():
            if number < 0 and job.side > 4000:
                continue  # the first round compiles
            words = ("--threads", "1") if name.endswith("one thread") else ()
            run = measure(ours(job, folder / "ours", "bilinear", *words))
            shutil.rmtree(folder / "ours")
            if number >= 0:
                found[name].append(run)
    return {name: _cost(found, jobs, name) for name in jobs}


def _cost(found: dict[str, list[Run]], jobs: dict[str, Job], name: str) -> dict[str, Any]:
    """Return what a job of `scaling` took, beyond the smallest one too, and print it."""
    values, base = jobs[name].megapixels * jobs[name].bands, jobs["12000²"].megapixels
    each = []
    for run, small, usual in zip(found[name], found["400²"], found["12000²"], strict=True):
        wall, cpu = (run.wall - small.wall) / values * 1e3, (run.cpu - small.cpu) / values * 1e3
        each.append((wall, cpu, wall / ((usual.wall - small.wall) / base * 1e3)))
    walls, cpus, shares = (statistics.median(column) for column in zip(*each, strict=True))
    memory = max(run.memory for run in found[name])
    told = {
        "megapixels": round(jobs[name].megapixels, 1), "bands": jobs[name].bands, "wall_ns": walls, "cpu_ns": cpus,
        "wall_ratio": shares, "memory": memory, "runs": [asdict(run) for run in found[name]],
    }  # fmt: skip
    wall = statistics.median(run.wall for run in found[name])
    print(
        f"{name:20s} {told['megapixels']:8.1f} Mpx {wall:8.2f} s  {walls:6.2f} ns and {cpus:6.2f} ns of CPU a value, "
        f"{shares:5.2f} of 12000²  {memory:5.0f} MB",
        flush=True,
    )
    return told


def layers(job: Job, pairs: int) -> dict[str, list[tuple[float, float]]]:
    """Return CPU seconds of the warp with a layer and without it, alternating; kernels are loaded before."""
    xmin, ymin, xmax, ymax = job.extent
    grid = Grid.of_extent(pyproj.CRS.from_epsg(UTM), (xmin, ymin, xmax, ymax), (GSD, GSD))
    model, source, out = job.model(), RasterSource(job.image), job.folder / "layers.tif"
    heights, size = (HEIGHT - 270, HEIGHT + 270), (job.side, job.side)
    budget = Budget(covariance=np.diag([0.2, 1e-5, 1e-5, 0.2, 1e-5, 1e-5]) ** 2, heights=4.0, interpolation_px=0.004)
    corrected = ImageCorrection.identity(model, "affine", (job.side / 2, job.side / 2))

    def accuracy(surface: Surface) -> None:  # after the warp, so that it is timed alone
        write_accuracy(budget, Sight(corrected, grid), surface, size, job.folder / "accuracy.tif", heights=heights)

    def plain(surface: Surface) -> None:
        rectify(WarpJob(model, source, surface, grid, driver="GTiff"), out)

    def empty(surface: Surface) -> None:
        rectify(WarpJob(model, source, surface, grid, driver="GTiff"), Hiding(out, heights))

    def mask(surface: Surface) -> None:
        hiding = Hiding(out, heights, job.folder / "mask.tif")
        rectify(WarpJob(model, source, surface, grid, driver="GTiff"), hiding)

    dem, dsm = open_dem(job.dem, "ellipsoid"), open_dem(job.write_dsm(), "ellipsoid")
    todo = {
        "accuracy, DEM of 30 m": (accuracy, dem), "hidden left empty, DEM of 30 m": (empty, dem),
        "mask of hidden, DEM of 30 m": (mask, dem), "hidden left empty, DSM of 1 m": (empty, dsm),
    }  # fmt: skip
    found: dict[str, list[tuple[float, float]]] = {}
    for name, (work, surface) in todo.items():
        found[name] = []
        for number in range(pairs + 1):
            seconds = {}
            for one in (plain, work) if number % 2 else (work, plain):
                begin = time.process_time()
                one(surface)
                seconds[one] = time.process_time() - begin
            if number:  # the first loads the kernels
                before = seconds[plain] if work is accuracy else 0.0
                found[name].append((before + seconds[work], seconds[plain]))
        more = sorted(with_it / without - 1 for with_it, without in found[name])
        base = statistics.median(without for _, without in found[name])
        print(f"{name:32s} {base:6.2f} s of CPU without; + {100 * statistics.median(more):.1f} % "
              f"({100 * more[0]:.1f} to {100 * more[-1]:.1f})", flush=True)  # fmt: skip
    return found


class PlainNumPy(SensorModel):
    """The RPC as a plugin author might write it: plain NumPy, nothing overridden."""

    kind = "benchmark_plain_numpy"

    def __init__(self, rpc: RPC) -> None:
        object.__setattr__(self, "rpc", rpc)

    @property
    def crs(self) -> str:
        return self.rpc.crs

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return self.rpc.domain

    def ground_to_image(self, ground: np.ndarray) -> np.ndarray:
        rpc = self.rpc
        lon, lat, h = ((np.asarray(ground) - rpc.domain[0]) / rpc.domain[1]).T
        terms = [lon**a * lat**b * h**c for a, b, c in RPC_TERMS]
        sums = [
            sum(value * term for value, term in zip(part, terms, strict=True))
            for part in (rpc.col_num, rpc.col_den, rpc.row_num, rpc.row_den)
        ]
        col = sums[0] / sums[1] * rpc.col_scale + rpc.col_off
        return np.stack([col, sums[2] / sums[3] * rpc.row_scale + rpc.row_off], axis=1)


def kernels(folder: Path) -> dict[str, list[Run]]:
    """By kernel, number of bands and sensor model: the warp alone."""
    job, runs = Job(folder, 8000).make(), {}
    jobs = {name: (job, None, name) for name in ("nearest", "bilinear", "cubic", "lanczos", "average")}
    jobs |= {f"{bands} bands of 4000²": (Job(folder, 4000, bands).make(), None, "bilinear") for bands in (1, 4, 8)}
    jobs |= {"plain NumPy model": (job, PlainNumPy(job.model()), "bilinear")}
    for name, (which, model, kernel) in jobs.items():
        alone(which, model, kernel)
        seconds = [(alone(which, model, kernel), alone(job)) for _ in range(5)]
        runs[name] = [Run(mine, 0.0, 0.0) for mine, _ in seconds]
        ratio = statistics.median(mine / base for mine, base in seconds)
        wall = statistics.median(mine for mine, _ in seconds)
        print(
            f"{name:20s} {wall:6.2f} s   {wall / which.megapixels * 1e3:5.1f} ns/px   {ratio:5.2f} x RPC bilinear 8000²"
        )
    return runs


def accuracy(folder: Path, side: int) -> dict[str, float]:
    """Warp a ramp; compare every output pixel with pyproj, a DEM interpolated here, and the RPC in plain NumPy."""
    job = Job(folder, side, kind="ramp").make()
    measure(ours(job, folder / "ramp"))
    found = errors(job, folder / "ramp" / f"{job.image.stem}_ortho.tif")
    result = {
        "pixels": found.size,
        "max_px": float(found.max(initial=0.0)),
        "rms_px": float(np.sqrt(np.mean(found.astype(float) ** 2))),
    }
    print(
        f"{found.size / 1e6:.1f} Mpx: at most {result['max_px']:.5f} px, "
        f"RMS {result['rms_px']:.5f} px from the exact geometry"
    )
    return result


def errors(job: Job, path: Path, *, filled: bool = False) -> np.ndarray:
    """Return how far (px, of the image) each pixel of an ortho of the ramp is from its exact place.

    `filled`: only of pixels that have a value, else of all that the image shows. Pixels within 2 px of its border do
    not count.
    """
    ortho, dem = gdal.Open(str(path)), gdal.Open(str(job.dem))
    heights, (left, step, _, top, _, down) = dem.ReadAsArray().astype(float), dem.GetGeoTransform()
    west, right, _, north, _, lower_by = ortho.GetGeoTransform()
    model, to_lonlat = job.model(), pyproj.Transformer.from_crs(UTM, 4326, always_xy=True)
    to_dem = pyproj.Transformer.from_crs(UTM, job.dem_crs, always_xy=True)
    x, margin, parts = west + (np.arange(ortho.RasterXSize) + 0.5) * right, 2.0, [np.empty(0, dtype=np.float32)]
    for row in range(ortho.RasterYSize):
        found = ortho.ReadAsArray(0, row, ortho.RasterXSize, 1)[:2, 0].astype(float)
        y = np.full(x.size, north + (row + 0.5) * lower_by)
        across, along = to_dem.transform(x, y)
        u, v = (across - left) / step - 0.5, (along - top) / down - 0.5
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        inside = (i >= 0) & (j >= 0) & (i < heights.shape[1] - 1) & (j < heights.shape[0] - 1)
        i, j = np.where(inside, i, 0), np.where(inside, j, 0)
        upper = heights[j, i] * (1 - u + i) + heights[j, i + 1] * (u - i)
        lower = heights[j + 1, i] * (1 - u + i) + heights[j + 1, i + 1] * (u - i)
        lon, lat = to_lonlat.transform(x, y)
        exact = model.ground_to_image(np.stack([lon, lat, upper * (1 - v + j) + lower * (v - j)], axis=1)).T
        use = inside & ((exact > margin) & (exact < job.side - margin)).all(axis=0)
        if filled:
            use &= (found > 0).all(axis=0) & np.isfinite(found).all(axis=0)
        parts.append(np.abs(found - exact).max(axis=0)[use].astype(np.float32))
    return np.concatenate(parts)


def machine() -> dict[str, str]:
    """Describe the machine without naming it."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")
    return {
        "cpu": f"{os.cpu_count()} x {cpu}",
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "gdal": gdal.VersionInfo("RELEASE_NAME"),
        "numpy": np.__version__,
    }


def main() -> None:
    """Parse the options and run."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--side", type=int, default=12000)
    parser.add_argument("--folder", type=Path, help="where scenes are kept between runs (default: a temporary one)")
    parser.add_argument("--json", type=Path, help="write all runs there")
    parser.add_argument("--pairs", type=int, default=5, help="of runs, with --layers and --cog")
    parser.add_argument("--dem-crs", default=f"EPSG:{UTM}", help="of the table; by default that of the ortho")
    parser.add_argument("--program", action="append", help="of the table, only this one; may be repeated")
    for option in ("scaling", "kernels", "accuracy", "layers", "cog"):
        parser.add_argument(f"--{option}", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ortho_bench_") as temporary:
        folder = (arguments.folder or Path(temporary)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        document: dict[str, object] = {"machine": machine()}
        if arguments.scaling:
            document["scaling"] = scaling(folder, arguments.rounds)
        elif arguments.kernels:
            document["kernels"] = {name: [asdict(run) for run in runs] for name, runs in kernels(folder).items()}
        elif arguments.layers:
            document["layers"] = layers(Job(folder, arguments.side).make(), arguments.pairs)
        elif arguments.accuracy:
            document["accuracy"] = accuracy(folder, arguments.side)
        else:
            job = Job(folder, arguments.side, dem_crs=arguments.dem_crs)
            apart(job.make)
            runs = cogs(job, arguments.pairs) if arguments.cog else headline(job, arguments.rounds, arguments.program)
            print(f"{job.side} x {job.side} UInt16, {job.megapixels:.0f} Mpx out; {document['machine']}\n")
            print(table(runs, job.megapixels, list(runs)[-1] if arguments.cog else "ortho rectify, bilinear"))
            document["cog" if arguments.cog else "headline"] = {
                name: [asdict(run) for run in found] for name, found in runs.items()
            }
        if arguments.json:
            arguments.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
