"""How fluid `ortho measure` is: tiles of a large scene, the rendered reference, live solutions, the first answer.

python benchmarks/measure.py [SIDE]     a scene of 12000 pixels a side unless another is given, 40000 too; milliseconds

Each figure is the 95th percentile of what a person waits for, beside what issue 18 asks for. Tiles are asked for once
before ("warm": files and kernels), and then at places that were not asked for.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyproj
from ortho_measure.block.session import open_block_session
from ortho_measure.serving.tiles import TileServer
from ortho_measure.session import open_session
from ortho_studies.simulation.scanner import LineScanner
from osgeo import gdal, gdal_array, osr

from ortho_pipeline.exchange.rpc import rpc_metadata, write_rpc_txt
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.models.rational import RPC
from ortho_pipeline.options import MatchOptions, SurfaceOptions
from ortho_pipeline.surface.writing import write_dem

gdal.UseExceptions()
#: Rasters with more pixels a side are mosaics: their bytes come from memory, not from a disk.
LARGE = 20_000
LON, LAT, CRS, GSD = 33.35, 37.25, "EPSG:32636", 1.0


def write_model(path: Path, side: int, off_nadir_deg: float) -> RPC:
    """Write the RPC of a scene next to it, and return it."""
    camera = LineScanner.over(
        LON, LAT, 850.0, image_width=side, image_height=side, gsd=GSD, off_nadir_deg=off_nadir_deg,
        heights=(600.0, 1400.0),
    )  # fmt: skip
    centre, half = camera.domain
    west, south, east, north = *(centre - 1.05 * half)[:2], *(centre + 1.05 * half)[:2]
    rpc = fit_rpc(camera, (west, south, east, north), (600.0, 1400.0)).rpc
    write_rpc_txt(rpc, path.with_name(f"{path.stem}_RPC.TXT"))
    return rpc


def write_noise(
    folder: Path, name: str, pixels: int, noise: np.ndarray, origin: tuple[float, ...] | None = None
) -> None:  # fmt: skip
    """Write a raster of noise without overviews: a TIFF, or a mosaic of one file if it is large."""
    side = len(noise)
    starts = [(left, top) for top in range(0, pixels, side) for left in range(0, pixels, side)]
    mosaic = pixels > LARGE
    made = gdal.GetDriverByName("VRT" if mosaic else "GTiff").Create(
        str(folder / f"{name}.{'vrt' if mosaic else 'tif'}"),
        pixels,
        pixels,
        1,
        gdal.GDT_UInt16,
        [] if mosaic else ["TILED=YES", "BIGTIFF=IF_SAFER"],
    )
    if origin is not None:
        system = osr.SpatialReference()
        system.ImportFromEPSG(32636)
        made.SetProjection(system.ExportToWkt())
        made.SetGeoTransform(origin)
    if mosaic and not (folder / "noise.tif").exists():
        gdal.GetDriverByName("GTiff").CreateCopy(
            str(folder / "noise.tif"), gdal_array.OpenArray(noise), 0, ["TILED=YES"]
        )
    for left, top in starts:
        width, height = min(side, pixels - left), min(side, pixels - top)
        if mosaic:
            source = (
                f"<SimpleSource><SourceFilename relativeToVRT='1'>noise.tif</SourceFilename><SourceBand>1</SourceBand>"
                f"<SrcRect xOff='0' yOff='0' xSize='{width}' ySize='{height}'/>"
                f"<DstRect xOff='{left}' yOff='{top}' xSize='{width}' ySize='{height}'/></SimpleSource>"
            )
            made.GetRasterBand(1).SetMetadataItem(f"source_{len(starts)}", source, "new_vrt_sources")
        else:
            made.GetRasterBand(1).WriteArray(noise[:height, :width], left, top)
    made.FlushCache()


def raster(folder: Path, name: str) -> Path:
    """Return the path of a raster that was written."""
    return next(path for ending in ("vrt", "tif") if (path := folder / f"{name}.{ending}").exists())


def write(folder: Path, side: int) -> None:
    """Write a scene of noise with its RPC, a rough DEM of 30 m, a reference of noise, and a second scene, empty."""
    rpc = write_model(folder / "scene.tif", side, 15.0)
    write_model(folder / "second.tif", side, -15.0)
    gdal.GetDriverByName("GTiff").Create(str(folder / "second.tif"), side, side, 1, gdal.GDT_Byte, ["SPARSE_OK=YES"])
    random = np.random.default_rng(1)
    noise = random.integers(100, 2000, (1024, 1024), dtype=np.uint16)
    x, y = pyproj.Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(LON, LAT)
    reach = 0.62 * side * GSD + 2000
    origin = (x - reach, GSD, 0, y + reach, 0, -GSD)
    write_noise(folder, "scene", side, noise)
    if (mosaic := folder / "scene.vrt").exists():
        # GDAL reads no text next to a mosaic.
        made = gdal.Open(str(mosaic), gdal.GA_Update)
        made.SetMetadata(rpc_metadata(rpc), "RPC")
        made.FlushCache()
    write_noise(folder, "reference", int(2 * reach / GSD), noise, origin)
    side_of_dem = int(2 * (reach + 1000) / 30)
    heights = 900 + np.cumsum(random.normal(0, 1, (side_of_dem, side_of_dem)), axis=1)
    write_dem(
        folder / "dem.tif", np.clip(heights, 650, 1350), (x - reach - 1000, y + reach + 1000), 30.0, f"{CRS}+5773"
    )


def worked(job: Callable[[], object], count: int) -> float:
    """Return the median CPU time (ms) of a job: other processes add to the wall clock."""
    taken = []
    for _ in range(count):
        begin = time.process_time()
        job()
        taken.append(time.process_time() - begin)
    return float(np.median(taken)) * 1e3


def waited(job: Callable[[int], object], count: int) -> float:
    """Return the 95th percentile (ms) of waiting for a job."""
    taken = []
    for number in range(count):
        begin = time.perf_counter()
        job(number)
        taken.append(time.perf_counter() - begin)
    return float(np.percentile(taken, 95)) * 1e3


def main(side: int) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write(folder, side)
        begin = time.perf_counter()
        session = open_session(
            raster(folder, "scene"), folder / "p.geojson", surface=SurfaceOptions(dem=folder / "dem.tif"),
            match=MatchOptions(reference=(str(raster(folder, "reference")),)),
        )  # fmt: skip
        tiles = TileServer(session)
        limits = [tiles.limits("scene-0", 0, None, 0)]
        print(f"open, with the contrast of the scene         {time.perf_counter() - begin:8.2f} s")
        random = np.random.default_rng(2)
        for pane, bound in (("scene-0", 100), ("reference-0", 150), ("map-0", 100)):
            for factor in (1, 4, 16):
                most = max(1, side // (256 * factor))
                places = random.integers(0, most, (60, 2)).tolist()

                def show(number: int, pane: str = pane, factor: int = factor, places: list = places) -> object:
                    column, row = places[number]
                    return tiles.png(pane, 0, factor, column, row, [0], limits)

                show(0)
                print(
                    f"tile of the {pane:<11} 1 : {factor:<2} ({side}^2)    {waited(show, 60):8.0f} ms (asked: {bound})"
                )
        image = random.uniform(0, side, (100, 2))
        ground = session.places.ground_of(image)
        for number, (at, on_ground) in enumerate(zip(image.tolist(), ground.tolist(), strict=True)):
            noisy = [at[0] + random.normal(0, 0.3), at[1] + random.normal(0, 0.3)]
            mark = {"id": f"P{number}", "image": noisy, "ground": on_ground, "ground_from": "typed"}
            session.act({"do": "put", "mark": mark})
        jobs = ("solution of 100 points", session._solve, 50), ("all that is shown of them", session.state, 0)
        for what, job, asked in jobs:
            wall = waited(lambda _, job=job: job(), 20)
            print(f"{what:<44} {wall:8.0f} ms, CPU {worked(job, 20):.0f} ms{f' (asked: {asked})' if asked else ''}")
        session.close()
        for stated in (True, False):
            pair(folder, stated)
        painted(folder)


def pair(folder: Path, stated: bool) -> None:
    """Measure the bundle adjustment of a pair after each action: half of 100 points ties, the others known."""
    session = open_block_session(
        [raster(folder, "scene"), folder / "second.tif"], folder / f"pair-{stated}.geojson",
        surface=SurfaceOptions(dem=folder / "dem.tif"),
    )  # fmt: skip
    random = np.random.default_rng(3)
    first, second = session.images.places
    image = random.uniform(0.1, 0.9, (100, 2)) * first.view.size
    ground = first.ground_of(image)
    rays = {"scene": image, "second": second.image_of(ground)}
    sigmas = {"sigma_xy": 0.3, "sigma_h": 0.5} if stated else {}
    known = ground + random.normal(0, 1, ground.shape) * (0.3 / 88_000, 0.3 / 111_000, 0.5)
    for number in range(100):
        placed = {
            name: {"image": (places[number] + random.normal(0, 0.2, 2)).tolist()} for name, places in rays.items()
        }
        role = ("control", "tie", "check", "tie")[number % 4]
        of = {} if role == "tie" else {"ground": known[number].tolist(), "ground_from": "typed", **sigmas}
        session.act({"do": "put", "mark": {"id": f"P{number}", "role": role, "rays": placed, **of}})
    what = "ground with sigmas" if stated else "ground without sigmas"
    for name, job in ((f"pair of 100 points, {what}", session._solve), ("all that is shown of them", session.state)):
        print(f"{name:<44} {waited(lambda _, job=job: job(), 20):8.0f} ms, CPU {worked(job, 20):.0f} ms")
    session.close()


def painted(folder: Path) -> None:
    """Measure in Chromium, if it is there, when the page and its first tile are seen after the address is opened."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None or importlib.util.find_spec("playwright") is None:
        print("the page itself: no Chromium here")
        return
    from playwright.sync_api import sync_playwright

    server = subprocess.Popen(
        [sys.executable, "-m", "ortho_pipeline", "measure", str(raster(folder, "scene")), "--reference",
         str(raster(folder, "reference")), "--dem", str(folder / "dem.tif"), "-o", str(folder / "page.geojson"),
         "--no-browser"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert server.stdout is not None
    address = server.stdout.readline().split()[-1]
    seen, tiles = [], []
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        # An address works once; then a cookie of the context opens the page.
        context = browser.new_context(viewport={"width": 1400, "height": 860})
        for _ in range(5):
            page = context.new_page()
            page.goto(address)
            address = page.url
            loaded = "performance.getEntriesByType('resource')"
            tile = f"{loaded}.find((one) => one.name.includes('/tiles/') && one.responseEnd)"
            page.wait_for_function(f"() => performance.getEntriesByType('paint').length > 1 && {tile}")
            seen.append(page.evaluate("() => performance.getEntriesByName('first-contentful-paint')[0].startTime"))
            tiles.append(page.evaluate(f"() => {tile}.responseEnd"))
            page.close()
        browser.close()
    server.terminate()
    server.wait(30)
    print(f"{'first paint of the page':<44} {max(seen):8.0f} ms (asked: 2000)")
    print(f"{'its first tile':<44} {max(tiles):8.0f} ms")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 12000)
