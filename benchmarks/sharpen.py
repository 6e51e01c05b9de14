"""Pan-sharpening of 12000 x 12000 pixels and four bands of 16 bits, compared with `gdal_pansharpen` side by side.

    python benchmarks/sharpen.py               plain, and with masks: a table
    python benchmarks/sharpen.py --side 4000 --rounds 1
    python benchmarks/sharpen.py --compress DEFLATE

Every figure is of a whole process: wall time, CPU time, peak memory. Both write tiled GeoTIFFs with two threads,
uncompressed by default: that is hardest for `ortho sharpen`, because GDAL's tool does little else. `ortho sharpen` also
computes weights, registration and quality; `gdal_pansharpen` gets the weights. The programs take turns, and only ratios
within a round count. The masked orthos have the same pixels; GDAL's tool ignores masks.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from osgeo import gdal, osr
from scipy.ndimage import gaussian_filter

gdal.UseExceptions()
RATIO, COUNT, TILE = 4, 4, 2000
TILED = ["TILED=YES", "BLOCKXSIZE=512", "BLOCKYSIZE=512", "BIGTIFF=IF_SAFER"]


def write(folder: Path, side: int, *, masked: bool) -> tuple[Path, Path]:
    """Write both orthos: a texture that repeats every `TILE` pixels, brighter from place to place."""
    random = np.random.default_rng(0)
    detail = [gaussian_filter(random.standard_normal((TILE, TILE)), sigma, mode="wrap") * sigma for sigma in (1, 3, 12)]
    bands = [600 + 300 * sum(random.uniform(0.5, 1.0) * layer for layer in detail) for _ in range(COUNT)]
    fine = np.clip(bands, 50, 2000)
    coarse = fine.reshape(COUNT, TILE // RATIO, RATIO, TILE // RATIO, RATIO).mean(axis=(2, 4))
    made = []
    for name, pixels, size in (("pan", fine.mean(axis=0)[None], 0.5), ("ms", coarse, 0.5 * RATIO)):
        width = side // (RATIO if name == "ms" else 1)
        path = folder / f"{name}{'_masked' if masked else ''}.tif"
        gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", "YES")
        raster = gdal.GetDriverByName("GTiff").Create(str(path), width, width, len(pixels), gdal.GDT_UInt16, TILED)
        raster.SetGeoTransform((500_000.0, size, 0.0, 4_000_000.0, 0.0, -size))
        place = osr.SpatialReference()
        place.ImportFromEPSG(32636)
        raster.SetProjection(place.ExportToWkt())
        if masked:
            raster.CreateMaskBand(gdal.GMF_PER_DATASET)
        step = pixels.shape[1]
        for top in range(0, width, step):
            for left in range(0, width, step):
                rows, columns = min(step, width - top), min(step, width - left)
                part = pixels[:, :rows, :columns] * (1 + 0.3 * np.sin(top / width * 5) * np.cos(left / width * 7))
                raster.WriteArray(part.astype(np.uint16), left, top)
                if masked:
                    # A diagonal rim, as of a rotated scene.
                    y, x = np.mgrid[top : top + rows, left : left + columns] / width
                    valid = (np.abs(x - 0.5) + np.abs(y - 0.5) < 0.95).astype(np.uint8) * 255
                    raster.GetRasterBand(1).GetMaskBand().WriteArray(valid, left, top)
        raster = None
        made.append(path)
    return made[0], made[1]


def measured(words: list[str]) -> tuple[float, float, float]:
    """Return wall time (s), CPU time (s) and peak memory (MB) of a command."""
    begun = time.perf_counter()
    child = os.posix_spawn(words[0], words, {**os.environ, "GDAL_CACHEMAX": "128"})
    _, status, usage = os.wait4(child, 0)
    if status:
        raise SystemExit(f"{' '.join(words)} failed")
    return time.perf_counter() - begun, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def main() -> None:
    """Compare both programs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=12_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--compress", default="NONE", help="compression of both results")
    options = parser.parse_args()
    ours, theirs = Path(sys.executable).with_name("ortho"), "from osgeo_utils.gdal_pansharpen import main; main()"
    with tempfile.TemporaryDirectory(dir=os.environ.get("BENCH_TMP")) as name:
        folder = Path(name)
        for masked in (False, True):
            # In a process of its own: a child begins with the peak memory of its parent.
            with ProcessPoolExecutor(1, get_context("spawn")) as apart:
                pan, colours = apart.submit(write, folder, options.side, masked=masked).result()
            rows = []
            for _ in range(options.rounds):
                packed = ["-co", f"COMPRESS={options.compress}", "-co", "NUM_THREADS=2"]
                creation = [*packed, *(word for option in TILED for word in ("-co", option))]
                weights = [word for _ in range(COUNT) for word in ("-w", "0.25")]
                gdals = measured(
                    [sys.executable, "-c", theirs, *weights, "-threads", "2", *creation, "-q", str(pan), str(colours),
                     str(folder / "gdal.tif")]
                )  # fmt: skip
                (folder / "gdal.tif").unlink()
                product = measured(
                    [str(ours), "sharpen", str(pan), str(colours), "-of", "GTiff", *packed, "--threads", "2", "-q",
                     "-o", str(folder / "out")]
                )  # fmt: skip
                rows.append((product, gdals))
                print(
                    f"{'masked' if masked else 'plain':<7} ortho {product[0]:6.1f} s wall {product[1]:6.1f} s CPU "
                    f"{product[2]:5.0f} MB | gdal_pansharpen {gdals[0]:6.1f} s {gdals[1]:6.1f} s {gdals[2]:5.0f} MB",
                    flush=True,
                )
            for number, what in ((0, "wall"), (1, "CPU")):
                ratio = statistics.median(product[number] / gdals[number] for product, gdals in rows)
                print(f"  {what}: {ratio:.2f} times gdal_pansharpen")


if __name__ == "__main__":
    main()
