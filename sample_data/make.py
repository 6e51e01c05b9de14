"""Make the sample data: a simulated satellite scene, its RPC, a DEM, ground control, and the truth behind them.

Next to it a small BILSAT-1 frame with its imaging survey, a small IKONOS Geo delivery, a CARTOSAT-1 pair and two
OrbView-3 scenes, in folders of their own.

Run ``python sample_data/make.py [FOLDER]``; without a folder the files of this one are written again. Everything comes
from seeds, so that the pixels and numbers are the same every time.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from ortho_studies.bilsat.simulation import write_product
from ortho_studies.cartosat.simulation import write_product as write_cartosat
from ortho_studies.ikonos.simulation import write_product as write_ikonos
from ortho_studies.orbview3.simulation import write_product as write_orbview3
from ortho_studies.simulation.scanner import LineScanner, SimulatedPoints, render, simulate_points
from ortho_studies.simulation.terrain import Landscape, Terrain
from osgeo import gdal

from ortho_pipeline.exchange.rpc import write_rpc_txt
from ortho_pipeline.exchange.rpc_fit import RpcExport, fit_rpc
from ortho_pipeline.files import whole_or_nothing, write_text
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import Points, write_points
from ortho_pipeline.surface.writing import write_dem as write_dem_file

gdal.UseExceptions()

#: Middle of the scene (degrees, degrees, ellipsoidal metres); the place is made up, its geoid is not.
CENTRE = (33.35, 37.25, 850.0)
MAP_CRS = "EPSG:32636"
SIZE = 1000
GSD = 2.5
OFF_NADIR_DEG = 20.0
HEIGHTS = (650.0, 1350.0)
#: Ellipsoidal height of the lake and rise of the hills, metres.
LAKE_LEVEL = 700.0
RELIEF = 420.0
SEEDS = {"terrain": 1, "landscape": 7, "image noise": 11, "points": 5, "reference noise": 13}
#: Measured minus predicted by the delivered RPC, in the middle of the image, pixels; and its growth per row.
BIAS = {"col": 6.3, "row": -4.1, "col_per_row": 2.0e-4, "row_per_row": -1.2e-4}
SIGMA_IMAGE = 0.15
SIGMA_GROUND = 0.10
NOISE_DN = 4.0
#: The orthoimage that somebody else made: its pixel and by how far it lies off (east, north), metres; its own sun.
REFERENCE_PIXEL, REFERENCE_OFF = 5.0, (3.0, -2.0)
REFERENCE_SUN = {"sun_azimuth_deg": 158.0, "sun_elevation_deg": 38.0}
DEM_STEP = 20.0
DEM_MARGIN = 400.0
EGM96 = "EPSG:5773"
#: The BILSAT-1 frame: pixels eight times as wide as the real ones, and a coarse DEM, to keep it small.
BILSAT_SIZE, BILSAT_DEM_STEP = 256, 250.0
#: The IKONOS delivery: pixels 12.5 times as wide as the real ones, and a coarse DEM, to keep it small.
IKONOS_SIZE, IKONOS_PIXEL, IKONOS_DEM_STEP = 800, 12.5, 50.0

#: The CARTOSAT-1 pair: pixels thirty times as wide as the real ones, and a coarse DEM, to keep it small.
CARTOSAT_SIZE, CARTOSAT_DEM_STEP = 400, 120.0
#: The OrbView-3 scenes: pixels 24 times as wide as the real ones, and a coarse DEM, to keep them small.
ORBVIEW3_PIXEL, ORBVIEW3_DEM_STEP = 24, 150.0


def main(folder: Path) -> None:
    """Write all files of the sample into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    lon, lat, _ = CENTRE
    x, y = pyproj.Transformer.from_crs("EPSG:4326", MAP_CRS, always_xy=True).transform(lon, lat)
    terrain = Terrain(MAP_CRS, round(x, -2), round(y, -2), LAKE_LEVEL, RELIEF, SEEDS["terrain"])
    camera = LineScanner.over(
        *CENTRE, image_width=SIZE, image_height=SIZE, gsd=GSD, off_nadir_deg=OFF_NADIR_DEG, heights=HEIGHTS
    )
    image = render(
        camera, terrain, Landscape(terrain, GSD, seed=SEEDS["landscape"]), noise_dn=NOISE_DN, seed=SEEDS["image noise"]
    )
    write_scene(image, folder / "scene.tif")
    delivered = vendor_rpc(camera)
    write_rpc_txt(delivered.rpc, folder / "scene_RPC.TXT")
    write_dem(camera, terrain, folder / "dem.tif")
    write_reference(camera, terrain, folder / "reference.tif")
    points = simulate_points(camera, terrain, sigma_image=SIGMA_IMAGE, sigma_ground=SIGMA_GROUND, seed=SEEDS["points"])
    delivered_points = as_delivered(points.measured)
    write_points(delivered_points, folder / "gcps.geojson")
    write_points(delivered_points, folder / "gcps.csv")
    truth = truth_of(camera, terrain, delivered, points)
    write_text(folder / "truth.json", json.dumps(truth, indent=1) + "\n")
    write_product(folder / "bilsat", seed=1, size=BILSAT_SIZE, dem_step=BILSAT_DEM_STEP)
    write_ikonos(
        folder / "ikonos", seed=1, size=IKONOS_SIZE, pixel=IKONOS_PIXEL, multispectral=True, dem_step=IKONOS_DEM_STEP
    )
    write_cartosat(folder / "cartosat", seed=1, size=CARTOSAT_SIZE, dem_step=CARTOSAT_DEM_STEP)
    write_orbview3(folder / "orbview3", seed=1, pixel=ORBVIEW3_PIXEL, dem_step=ORBVIEW3_DEM_STEP)


def vendor_rpc(camera: LineScanner) -> RpcExport:
    """Fit an RPC to the camera as a vendor would who knows its attitude badly."""
    error = ImageCorrection(
        camera,
        "affine",
        (SIZE / 2, SIZE / 2),
        np.array([-BIAS["col"], 0.0, -BIAS["col_per_row"], -BIAS["row"], 0.0, -BIAS["row_per_row"]]),
    )
    centre, half = camera.domain
    west, south, east, north = *(centre - 1.05 * half)[:2], *(centre + 1.05 * half)[:2]
    return fit_rpc(error, (west, south, east, north), HEIGHTS)


def as_delivered(measured: Points) -> Points:
    """Return the points in map coordinates, with as many digits as a surveyor writes."""
    mapped = measured.to_crs(MAP_CRS)
    return replace(mapped, image=np.round(mapped.image, 2), ground=np.round(mapped.ground, 3))


def write_scene(image: np.ndarray, path: Path) -> None:
    """Write the image without any georeference: the RPC next to it is all there is."""
    rows, cols = image.shape
    options = ["COMPRESS=DEFLATE", "PREDICTOR=2", "ZLEVEL=9", "TILED=YES"]
    with whole_or_nothing(path) as temporary:
        dataset = gdal.GetDriverByName("GTiff").Create(str(temporary), cols, rows, 1, gdal.GDT_UInt16, options)
        dataset.GetRasterBand(1).WriteArray(image)
        dataset = None


def write_reference(camera: LineScanner, terrain: Terrain, path: Path) -> None:
    """Write an orthoimage of the place with another sun, contrast and pixel, that lies off by `REFERENCE_OFF`."""
    west, north, cols, rows = grid_over(camera, terrain, 100.0, REFERENCE_PIXEL)
    landscape = Landscape(terrain, REFERENCE_PIXEL, seed=SEEDS["landscape"], **REFERENCE_SUN)
    x, y = centres(west, north, cols, rows, REFERENCE_PIXEL)
    # What it shows at a place lies elsewhere in truth.
    brightness = landscape(np.stack([x.ravel() - REFERENCE_OFF[0], y.ravel() - REFERENCE_OFF[1]], axis=1))
    noise = np.random.default_rng(SEEDS["reference noise"]).normal(0.0, 3.0, x.shape)
    values = np.clip(np.round(255 * np.sqrt(brightness.reshape(x.shape)) + noise), 1, 255).astype(np.uint8)
    with whole_or_nothing(path) as temporary:
        options = ["COMPRESS=DEFLATE", "ZLEVEL=9", "TILED=YES"]
        dataset = gdal.GetDriverByName("GTiff").Create(str(temporary), cols, rows, 1, gdal.GDT_Byte, options)
        dataset.SetGeoTransform((west, REFERENCE_PIXEL, 0.0, north, 0.0, -REFERENCE_PIXEL))
        dataset.SetProjection(pyproj.CRS(MAP_CRS).to_wkt())
        dataset.GetRasterBand(1).WriteArray(values)
        dataset = None


def grid_over(camera: LineScanner, terrain: Terrain, margin: float, step: float) -> tuple[float, float, int, int]:
    """Return west, north, columns and rows of a grid over what the camera is meant for, and a margin in metres."""
    centre, half = camera.domain
    corners = [centre[:2] + half[:2] * (sx, sy) for sx in (-1, 1) for sy in (-1, 1)]
    xy = terrain.xy(*np.array(corners).T)
    west, south = (np.floor((xy.min(axis=0) - margin) / step) * step).tolist()
    cols, rows = np.ceil((xy.max(axis=0) + margin - (west, south)) / step).astype(int).tolist()
    return west, south + rows * step, cols, rows


def centres(west: float, north: float, cols: int, rows: int, step: float) -> list[np.ndarray]:
    """Return map coordinates of the centres of a grid's pixels."""
    return np.meshgrid(west + step * (np.arange(cols) + 0.5), north - step * (np.arange(rows) + 0.5))


def write_dem(camera: LineScanner, terrain: Terrain, path: Path) -> None:
    """Write the terrain as a DEM of heights above the EGM96 geoid, which its compound CRS declares."""
    west, north, cols, rows = grid_over(camera, terrain, DEM_MARGIN, DEM_STEP)
    x, y = centres(west, north, cols, rows, DEM_STEP)
    posts = np.stack([x.ravel(), y.ravel()], axis=1)
    lon, lat = pyproj.Transformer.from_crs(MAP_CRS, "EPSG:4326", always_xy=True).transform(*posts.T)
    heights = terrain.heights(posts) - Vertical.parse("egm96").undulation(lon, lat)
    # A centimetre is finer than any DEM, and packs four times better than full Float32 noise.
    crs = f"{MAP_CRS}+{EGM96.split(':')[1]}"
    write_dem_file(path, np.round(heights, 2).reshape(rows, cols), (west, north), DEM_STEP, crs)


def truth_of(camera: LineScanner, terrain: Terrain, delivered: RpcExport, points: SimulatedPoints) -> dict[str, Any]:
    """Collect all that an estimate from the sample can be compared with."""
    return {
        "about": "truth of the simulated sample; see README.md",
        "camera": camera.to_dict(),
        "terrain": {
            "crs": terrain.crs,
            "x0": terrain.x0,
            "y0": terrain.y0,
            "lake_level": terrain.lake_level,
            "relief": terrain.relief,
            "seed": terrain.seed,
        },
        "rpc": {
            "bias_px": BIAS,
            "bias_is": "true minus predicted by scene_RPC.TXT, in the middle of the image and its growth per row",
            "fit_error_px": delivered.max_error_px,
        },
        "noise": {"image_dn": NOISE_DN, "points_image_px": SIGMA_IMAGE, "points_ground_m": SIGMA_GROUND},
        "seeds": SEEDS,
        "points": [
            {"id": name, "image": image.tolist(), "lon_lat_h": ground.tolist()}
            for name, image, ground in zip(points.measured.ids, points.true_image, points.true_ground, strict=True)
        ],
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
