"""A simulated CARTOSAT-1 stereo pair as it would be delivered, with a DEM, points, and the truth behind them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import write_rpc_txt
from ortho_pipeline.files import write_text
from ortho_pipeline.models.base import Array
from ortho_pipeline.points import Points
from ortho_pipeline.points.selection import select_control
from ortho_pipeline.raster.verified_writing import raster_output, written
from ortho_pipeline.surface.writing import write_terrain
from ortho_studies.cartosat import rendering
from ortho_studies.cartosat import truth as simulated

MAP, GEOID = simulated.MAP_CRS, "EPSG:5773"
SMALLEST, LARGEST = 64, simulated.SIZE
#: Names of the two images in a delivery.
BANDS = {"fore": "BANDF", "aft": "BANDA"}
#: How many points are control, and the a priori sigmas of the paper: px, and metres of control.
CONTROL, SIGMA_IMAGE, SIGMA_CONTROL = 9, 0.5, 0.3


def write_product(
    folder: str | PathLike[str], *, seed: int = 0, size: int = 1200, dem_step: float = 60.0, jitter: float = 0.0
) -> dict[str, Path]:
    """Simulate a stereo pair and write it as it would be delivered, with a DEM and points to adjust it to.

    Parameters
    ----------
    seed : int
        Of the places of the points and of all noise.
    size : int
        Columns and rows; 12000 is the real size, fewer pixels are larger and cover the same ground.
    dem_step : float
        Distance (m) of the posts of the DEM, whose heights are above EGM96 and without error.
    jitter : float
        Swinging of the pitch within each image, px of the full size.

    Returns
    -------
    dict of str to Path
        The files: for each of 'fore' and 'aft' image, <view>_met and <view>_rpc; dem, points, truth.

    Raises
    ------
    InputError
        If the size or the seed is not possible.
    """
    if not SMALLEST <= size <= LARGEST or seed < 0:
        raise InputError(
            f"size {size} and seed {seed} are not possible",
            field="size, seed",
            remedy=f"use a size from {SMALLEST} to {LARGEST}, and a seed of 0 or more",
        )
    out = Path(folder)
    pair = simulated.StereoPair.make(size=size, seed=seed, jitter=jitter)
    files: dict[str, Path] = {}
    for number, (view, band) in enumerate(BANDS.items()):
        files[view] = out / f"{band}.tif"
        files[f"{view}_met"], files[f"{view}_rpc"] = out / f"{band}_MET.TXT", out / f"{band}_RPC.TXT"
        _write_image(rendering.render(pair.cameras[view], pair.hills, seed=seed + number), files[view])
        write_text(files[f"{view}_met"], metadata_text(pair, view))
        write_rpc_txt(pair.rpc(view), files[f"{view}_rpc"])
    files |= {"dem": out / "dem.tif", "points": out / "points.csv", "truth": out / "truth.json"}
    _write_heights(pair, dem_step, files["dem"])
    _write_points(pair.measure(seed), files["points"])

    write_text(files["truth"], json.dumps(_truth(pair, seed, jitter), indent=1) + "\n")
    return files


def metadata_text(pair: simulated.StereoPair, view: str) -> str:
    """Return the `_MET.TXT` of an image: what the vendor believes, rounded and with irregular blanks as usual."""
    camera = pair.cameras[view]
    believed = simulated.biased(camera, simulated.BIASES[view])
    middle = believed.meet([(pair.size / 2, pair.size / 2)], lambda lon, lat: np.zeros(1))[0]
    seen = pair.corners(view)
    corners = dict(zip(("UL", "UR", "LR", "LL"), seen.tolist(), strict=True))
    box = {"UL": (0, 1), "UR": (1, 1), "LR": (1, 0), "LL": (0, 0)}
    edges = np.stack([seen.min(axis=0), seen.max(axis=0)])
    shrunk = simulated.SIZE / pair.size
    level = simulated.geocentric(np.column_stack([seen, np.zeros(4)]))
    across = math.dist(level[0], level[1]) / pair.size
    fields = {
        "ProductID": f"SIMULATED-{BANDS[view]}",
        "SatID": "CARTOSAT-1",
        "Sensor": f"PAN_{view.upper()}",
        "DateOfPass": "01-OCT-2006",
        "SceneCenterTime": "01-OCT-2006 00:13:22.512345",
        "Path": "0406",
        "Row": "0454",
        "NoScans": f"{pair.size}",
        "NoPixels": f"{pair.size}",
        "BitsPerPixel": "10",
        "MapProjection": "-NA-",
    }
    for name, (lon, lat) in corners.items():
        fields |= {f"Image{name}Lat": f"{lat:.6f}", f"Image{name}Lon": f"{lon:.6f}"}
    for name, (x, y) in box.items():
        fields |= {f"Prod{name}Lat": f"{edges[y, 1]:.6f}", f"Prod{name}Lon": f"{edges[x, 0]:.6f}"}
    fields |= {
        "SceneCenterLat": f"{middle[1]:.6f}",
        "SceneCenterLon": f"{middle[0]:.6f}",
        "SceneCenterRoll": "-NA-",
        "SceneCenterPitch": "-NA-",
        "SceneCenterYaw": "-NA-",
        "SatelliteAltitude": f"{simulated.SAID_ALTITUDE / 1e3:.3f}",
        "SatelliteHeadingAngle": "-NA-",
        "ViewAngleAlongTrack": f"{simulated.TILTS_DEG[view]:.6f}",
        "ViewAngleAcrossTrack": "-NA-",
        "InputResolutionAlong": f"{simulated.GSD_ALONG * shrunk:.4f}",
        "InputResolutionAcross": f"{across:.4f}",
        "SunAzimuthAtCenter": "48.213000",
        "SunElevationAtCenter": "41.650000",
    }
    return "".join(f"{key}{' ' * (k % 3)}={' ' * (k % 2)}{value}\n" for k, (key, value) in enumerate(fields.items()))


def _write_image(pixels: np.ndarray[Any, Any], path: Path) -> None:
    rows, columns = pixels.shape
    options = ["COMPRESS=DEFLATE", "PREDICTOR=2", "ZLEVEL=9", "TILED=YES"]
    with raster_output(path) as temporary:
        made = gdal.GetDriverByName("GTiff").Create(str(temporary), columns, rows, 1, gdal.GDT_UInt16, options)
        with written(made) as dataset:
            dataset.GetRasterBand(1).WriteArray(pixels)


def _write_points(tables: Mapping[str, Points], path: Path) -> None:
    """Write one line per point and image, nine of the points as control, with the sigmas that the paper takes."""
    roles = select_control(tables["fore"], f"even:{CONTROL}").roles
    lines = [f"#CRS: {MAP}", "#vertical: ellipsoid", "id,image,col,row,x,y,h,role,sigma_image,sigma_xy,sigma_h"]
    for view, table in tables.items():
        mapped = table.to_crs(MAP)
        for k, name in enumerate(mapped.ids):
            col, row = np.round(mapped.image[k], 2).tolist()
            x, y, h = np.round(mapped.ground[k], 3).tolist()
            sigmas = f"{SIGMA_IMAGE},{SIGMA_CONTROL},{SIGMA_CONTROL}"
            lines.append(f"{name},{BANDS[view]}.tif,{col},{row},{x},{y},{h},{roles[k]},{sigmas}")
    write_text(path, "\n".join(lines) + "\n")


def _write_heights(pair: simulated.StereoPair, step: float, path: Path) -> None:
    ring = np.array([(u, v) for u in (0.0, 0.5, 1.0) for v in (0.0, 0.5, 1.0)]) * pair.size
    seen = np.concatenate([camera.meet(ring, pair.hills) for camera in pair.cameras.values()])
    to_map = pyproj.Transformer.from_crs("EPSG:4326", MAP, always_xy=True)
    xy = np.stack(to_map.transform(seen[:, 0], seen[:, 1]), axis=1)
    # What the vendor's models see at the heights of the RPC lies beyond what the cameras see on the hills.
    margin = 1200.0 + step
    write_terrain(path, pair.hills, (xy.min(axis=0) - margin, xy.max(axis=0) + margin), step, MAP, GEOID)


def _truth(pair: simulated.StereoPair, seed: int, jitter: float) -> dict[str, Any]:
    images: dict[str, Array] = {view: pair.image(view) for view in pair.cameras}
    return {
        "about": "truth of a simulated CARTOSAT-1 stereo pair",
        "seed": seed,
        "jitter_px": jitter,
        "rpc_bias_px": {view: vars(bias) for view, bias in simulated.BIASES.items()},
        "noise": {
            "columns_px": simulated.SIGMA_COLUMN,
            "rows_px": simulated.SIGMA_ROW,
            "ground_m_east_north_up": list(simulated.SIGMA_GROUND),
        },
        "points": [
            {"id": f"P{k + 1:02d}", "lon_lat_h": ground.tolist()}
            | {view: image[k].tolist() for view, image in images.items()}
            for k, ground in enumerate(pair.ground)
        ],
    }
