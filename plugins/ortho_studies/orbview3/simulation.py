"""Simulated OrbView-3 deliveries: both scenes of the paper with label and RPC text, DEM, control points, the truth."""

from __future__ import annotations

import json
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ortho_orbview3.product import COEFFICIENT_KEYS, CORNERS, ERROR_KEYS, SCALAR_KEYS
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import rpc_metadata, write_rpc_txt
from ortho_pipeline.files import write_text
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.rational import RPC
from ortho_pipeline.points import write_points
from ortho_pipeline.raster.verified_writing import raster_output, written
from ortho_pipeline.surface.writing import write_terrain
from ortho_studies.orbview3 import rendering
from ortho_studies.orbview3 import truth as simulated

GEOID = "EPSG:5773"
#: Metres of a pixel that can be asked for; the real ones are 1 m.
SMALLEST, LARGEST = 1, 40
#: Circular error (m, 90 %) in the headers of the paper's scenes.
CIRCULAR_ERROR = {"471890": 32.98, "443940": 33.00}
ACQUIRED = {"471890": "2005-06-20T08:41:12.500000Z", "443940": "2005-06-20T08:41:56.600000Z"}


def write_product(
    folder: str | PathLike[str], *, seed: int = 0, pixel: int = 8, dem_step: float = 90.0
) -> dict[str, Path]:
    """Simulate both scenes and write them as they would be delivered, with a DEM and points to adjust them to.

    Parameters
    ----------
    seed : int
        Of the attitude errors, the places and noise of the points, and the noise of the images.
    pixel : int
        Metres of a pixel at nadir; larger ones are fewer and cover the same ground. The noise of the points stays what
        it is in metres.
    dem_step : float
        Distance (m) of the posts of the DEM, whose heights are above EGM96 and without error.

    Returns
    -------
    dict of str to Path
        The files: image, label, rpc and gcps of each scene (``image_471890`` …), dem, truth.

    Raises
    ------
    InputError
        If the pixel size or the seed is not possible.
    """
    if not SMALLEST <= pixel <= LARGEST or seed < 0:
        raise InputError(
            f"pixels of {pixel} m and seed {seed} are not possible",
            field="pixel, seed",
            remedy=f"use whole metres from {SMALLEST} to {LARGEST}, and a seed of 0 or more",
        )
    out, coast = Path(folder), simulated.Coast()
    ground = simulated.places(simulated.POINTS, coast, seed)
    believed = {name: simulated.scanner(name, shrink=pixel) for name in simulated.SCENES}
    true = {name: simulated.with_attitude_error(camera, seed) for name, camera in believed.items()}
    files: dict[str, Path] = {}
    for index, (name, camera) in enumerate(believed.items()):
        stem = f"3v050620p0000{name}a520000000{index + 1:02d}00m_001{name}"
        own = {"image": ".tif", "label": ".pvl", "rpc": "_rpc.txt", "gcps": "_gcps.csv"}
        paths = {kind: out / f"{stem}{end}" for kind, end in own.items()}
        _write_image(rendering.render(true[name], coast, seed=seed + index), paths["image"])
        rpc = replace(simulated.vendor_rpc(camera), err_bias=simulated.SIGMA_BIAS, err_rand=0.5)
        write_rpc_txt(rpc, paths["rpc"])
        write_text(paths["label"], label(camera, rpc, coast, name))
        measured = simulated.measure(
            true[name], ground, seed, image_number=index, sigma_image=simulated.SIGMA_IMAGE / pixel
        ).to_crs(simulated.MAP_CRS)
        delivered = replace(measured, image=np.round(measured.image, 3), ground=np.round(measured.ground, 3))
        write_points(delivered, paths["gcps"])
        files |= {f"{kind}_{name}": path for kind, path in paths.items()}
    files |= {"dem": out / "dem.tif", "truth": out / "truth.json"}
    _write_heights(believed, coast, dem_step, files["dem"])
    write_text(files["truth"], json.dumps(_truth(true, ground, seed, pixel), indent=1) + "\n")
    return files


def label(camera: simulated.TurningScanner, rpc: RPC, coast: simulated.Coast, name: str) -> str:
    """Return the label of a scene in the layout of the USGS, with what the vendor believes of the camera."""
    last = np.array([camera.width - 1, camera.height - 1])
    corners = camera.meet(np.array(list(CORNERS.values())) * last + 0.5, coast)
    pixel_spacing, line_spacing = _spacing(camera)
    size = [("NumberScanLines", camera.height), ("PixelsPerScanLine", camera.width)]
    spacing = [("LineSpacing", f"{line_spacing:.10e}"), ("PixelSpacing", f"{pixel_spacing:.10e}")]
    places = [
        line
        for corner, (lon, lat, height) in zip(CORNERS, corners.tolist(), strict=True)
        for line in _group(
            corner, [("latitude", f"{lat:.10f}"), ("longitude", f"{lon:.10f}"), ("height", f"{height:.7f}")]
        )
    ]
    product = [
        *_lines(
            [
                ("distributionMediaType", '"Simulated"'),
                ("productCloudCoverPercentage", 999),
                ("bytesPerPixel", 2),
                ("bitsPerPixel", 11),
                ("spacingUnits", '"meters"'),
                ("numScanLines", camera.height),
                ("pixelsPerScanLine", camera.width),
                ("lineSpacing", spacing[0][1]),
                ("pixelSpacing", spacing[1][1]),
            ]
        ),
        *_block("geodeticCorners", places),
        *_block("rationalFunctions", _rational_functions(rpc)),
    ]
    image = [
        ("firstLineAcquisitionDateTime", ACQUIRED[name]),
        ("circularError", f"{CIRCULAR_ERROR[name]:.10f}"),
        ("acquisitionOrbitNumber", "0000"),
        *((f"ids{key}", value) for key, value in [*size, *spacing]),
    ]
    lines = [
        'copyright = "simulated, under the licence of the project";',
        'companyName = "none";',
        *_block("productInfo", product),
        *_group("sensorInfo", [("satelliteName", '"OV-3"'), ("sensorName", '"PAN"')]),
        *_group("inputImageInfo", image),
        "END;",
    ]
    return "\n".join(lines) + "\n"


def _rational_functions(rpc: RPC) -> list[str]:
    fields = rpc_metadata(rpc)
    lines = _lines([(name, fields[key]) for key, name in (ERROR_KEYS | SCALAR_KEYS).items()])
    for key, name in COEFFICIENT_KEYS.items():
        lines += [f"{name} = ", "(", *(f"  {value}," for value in fields[key].split())]
        lines[-1] = lines[-1].rstrip(",")
        lines.append(");")
    return lines


def _lines(values: list[tuple[str, object]]) -> list[str]:
    return [f"{key} = {value};" for key, value in values]


def _group(name: str, values: list[tuple[str, object]]) -> list[str]:
    return _block(name, _lines(values))


def _block(name: str, lines: list[str]) -> list[str]:
    return [f"BEGIN_GROUP = {name};", *(f"  {line}" for line in lines), f"END_GROUP = {name};"]


def _spacing(camera: simulated.TurningScanner) -> tuple[float, float]:
    """Return the distance (m) of neighbouring pixel centres along and across the line, in the middle of the scene."""
    middle = np.array([camera.width / 2, camera.height / 2])
    seen = camera.meet(middle + np.array([[0, 0], [1, 0], [0, 1]]), simulated.level(simulated.LEVEL))
    xy = np.stack(simulated.to_map().transform(seen[:, 0], seen[:, 1]), axis=1)
    pixel, line = np.linalg.norm(xy[1:] - xy[0], axis=1).tolist()
    return pixel, line


def _write_image(pixels: NDArray[np.uint16], path: Path) -> None:
    rows, columns = pixels.shape
    options = ["COMPRESS=DEFLATE", "PREDICTOR=2", "ZLEVEL=9", "TILED=YES", "BIGTIFF=IF_SAFER"]
    with raster_output(path) as temporary:
        made = gdal.GetDriverByName("GTiff").Create(str(temporary), columns, rows, 1, gdal.GDT_UInt16, options)
        with written(made) as dataset:
            dataset.GetRasterBand(1).WriteArray(pixels)


def _write_heights(
    cameras: dict[str, simulated.TurningScanner], coast: simulated.Coast, step: float, path: Path
) -> None:
    seen = np.concatenate([camera.outline(h) for camera in cameras.values() for h in simulated.RPC_HEIGHTS])
    xy = np.stack(simulated.to_map().transform(seen[:, 0], seen[:, 1]), axis=1)
    margin = 500.0 + step
    box = xy.min(axis=0) - margin, xy.max(axis=0) + margin
    write_terrain(path, coast, box, step, simulated.MAP_CRS, GEOID)


def _truth(cameras: dict[str, simulated.TurningScanner], ground: Array, seed: int, pixel: int) -> dict[str, Any]:
    return {
        "about": "truth of two simulated OrbView-3 scenes",
        "seed": seed,
        "pixel_m": pixel,
        "noise": {"points_image_px": simulated.SIGMA_IMAGE / pixel, "points_ground_m": simulated.SIGMA_GROUND},
        "scenes": {
            name: {
                "seconds_from_abeam": camera.middle,
                "scan": "east" if camera.heading[0] > 0 else "west",
                "attitude_error_rad": "Legendre coefficients over the scan: along the scan, along the line, yaw",
                "attitude_error": camera.error.tolist(),
                "images": camera.project(ground).tolist(),
            }
            for name, camera in cameras.items()
        },
        "points": [{"id": f"P{k + 1:02d}", "lon_lat_h": point} for k, point in enumerate(ground.tolist())],
    }
