"""A simulated IKONOS Geo delivery: images, metadata, RPC, DEM, control points, and the truth behind them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal, osr

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.exchange.rpc import write_rpc_txt
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.files import write_text
from ortho_pipeline.points import Points, write_points
from ortho_pipeline.raster.verified_writing import raster_output, written
from ortho_pipeline.surface.writing import write_terrain
from ortho_studies.ikonos import rendering
from ortho_studies.ikonos import truth as simulated
from ortho_studies.ikonos.truth import GeoScene, VendorModel

ORDER = "39001"
GEOID = "EPSG:5773"
#: Heights (m) for which a vendor's RPC is made.
HEIGHTS = (900.0, 2000.0)
#: Multispectral bands, in the order of their names' wavelengths, and how many pan pixels one of theirs is wide.
MULTISPECTRAL, RATIO = ("blu", "grn", "red", "nir"), 4
SMALLEST, LARGEST, MOST_COMPONENTS = 64, 11_000, 4
#: Least size of a pixel (m).
FINEST = 0.5
_RULE = "=" * 62


@dataclass(frozen=True)
class SimulatedComponent:
    """One image file of the order: a cut of the scene, in pan's pixels, and its name."""

    identifier: str
    scene: GeoScene


def write_product(
    folder: str | PathLike[str],
    *,
    seed: int = 0,
    off_nadir_deg: float = simulated.OFF_NADIR_DEG,
    size: int = 1000,
    pixel: float | None = None,
    rpc: bool = True,
    multispectral: bool = False,
    components: int = 1,
    dem_step: float = 30.0,
) -> dict[str, Path]:
    """Simulate an acquisition and write it as it would be delivered, with a DEM and points to adjust it to.

    Parameters
    ----------
    size, pixel : int, float
        Columns and rows of the whole, and metres of a pixel; without the latter they cover the whole city. The points
        are as good as measured in the real image, whose pixels are a metre.
    rpc : bool
        Deliver ``_rpc.txt`` with each image.
    multispectral : bool
        Four files of single bands beside pan, with pixels four times as wide.
    components : int
        Into how many files, from west to east, each image is cut.
    dem_step : float
        Distance (m) of the posts of the DEM, whose heights are above EGM96 and without error.

    Returns
    -------
    dict of str to Path
        The files: image (and image_<component>, image_<band>, … of the others), metadata, dem, gcps, truth; and rpc.

    Raises
    ------
    InputError
        If such a scene is not possible.
    """
    pixel = simulated.EXTENT / size if pixel is None and size > 0 else pixel or 0.0
    _check(size, pixel, seed, components, multispectral)
    out = Path(folder)
    scene = GeoScene.make(seed, off_nadir_deg=off_nadir_deg, pixel=pixel, columns=size, rows=size)
    cuts = _cut(scene, components)
    files: dict[str, Path] = {}
    for number, band in enumerate(("pan", *MULTISPECTRAL) if multispectral else ("pan",)):
        pixels = rendering.render(_of_band(scene, band), band, seed=seed + number)
        for cut in cuts:
            files |= _write_image(out, cut, scene, band, pixels, rpc)
    files["metadata"] = out / f"po_{ORDER}_metadata.txt"
    write_text(files["metadata"], metadata_text(scene, cuts, multispectral))
    files |= {"dem": out / "dem.tif", "gcps": out / "gcps.csv", "truth": out / "truth.json"}
    _write_heights(scene, dem_step, files["dem"])
    measured = scene.measure(seed)
    _write_points(measured, cuts, files["gcps"])
    write_text(files["truth"], json.dumps(_truth(scene, seed, off_nadir_deg), indent=1) + "\n")
    return files


def _check(size: int, pixel: float, seed: int, components: int, multispectral: bool) -> None:
    if not SMALLEST <= size <= LARGEST or seed < 0 or not 1 <= components <= MOST_COMPONENTS:
        raise InputError(
            f"size {size}, seed {seed} and {counted(components, 'component')} are not possible",
            field="size, seed, components",
            remedy=f"use a size from {SMALLEST} to {LARGEST}, a seed from 0, and 1 to {MOST_COMPONENTS} components",
        )
    if not pixel >= FINEST or size * pixel > simulated.EXTENT * (1 + 1e-9):
        raise InputError(
            f"{size} pixels of {pixel:g} m are not possible",
            field="size, pixel",
            remedy=f"use pixels of at least {FINEST} m, and a scene of at most {simulated.EXTENT:g} m",
        )
    if size % (components * (RATIO if multispectral else 1)):
        raise InputError(
            f"{size} columns cannot be cut into equal parts",
            field="size",
            remedy=f"use a multiple of {components * (RATIO if multispectral else 1)}",
        )


def _cut(scene: GeoScene, count: int) -> list[SimulatedComponent]:
    wide = scene.columns // count
    return [
        SimulatedComponent(f"{k:07d}", replace(scene, west=scene.west + k * wide * scene.pixel, columns=wide))
        for k in range(count)
    ]


def _of_band(scene: GeoScene, band: str) -> GeoScene:
    """Return the scene on the grid of a band."""
    if band == "pan":
        return scene
    return replace(scene, pixel=scene.pixel * RATIO, columns=scene.columns // RATIO, rows=scene.rows // RATIO)


# -- files -----------------------------------------------------------------------------------------------------------


def _write_points(measured: Points, cuts: list[SimulatedComponent], path: Path) -> None:
    """Write the points in the panchromatic component that each of them lies in, named where there are several."""
    wide = cuts[0].scene.columns
    of = np.clip(measured.image[:, 0] // wide, 0, len(cuts) - 1).astype(int)
    image = np.round(measured.image - np.stack([of * wide, np.zeros(len(of))], axis=1), 4)
    names = [f"po_{ORDER}_pan_{cuts[k].identifier}.tif" for k in of]
    written = replace(measured, image=image, ground=np.round(measured.ground, 3))
    write_points(written, path, images=names if len(cuts) > 1 else None)


def _write_image(
    out: Path, cut: SimulatedComponent, scene: GeoScene, band: str, pixels: NDArray[np.uint16], rpc: bool
) -> Iterator[tuple[str, Path]]:
    grid = _of_band(cut.scene, band)
    name = "_".join(
        ["", *([] if cut.identifier == "0000000" else [cut.identifier]), *([] if band == "pan" else [band])]
    )
    first = round((grid.west - scene.west) / grid.pixel)
    path = out / f"po_{ORDER}_{band}_{cut.identifier}.tif"
    _write_tiff(path, pixels[:, first : first + grid.columns], grid)
    yield f"image{name}".rstrip("_"), path
    if rpc:
        vendor = VendorModel.of(grid, HEIGHTS)
        (west, south, _), (east, north, _) = vendor.box.tolist()
        path = path.with_name(f"{path.stem}_rpc.txt")
        write_rpc_txt(fit_rpc(vendor, (west, south, east, north), HEIGHTS).rpc, path)
        yield f"rpc{name}".rstrip("_"), path


def _write_tiff(path: Path, pixels: NDArray[np.uint16], grid: GeoScene) -> None:
    system = osr.SpatialReference()
    system.SetFromUserInput(simulated.MAP_CRS)
    options = ["COMPRESS=DEFLATE", "PREDICTOR=2", "ZLEVEL=9"]
    with raster_output(path) as temporary:
        made = gdal.GetDriverByName("GTiff").Create(
            str(temporary), grid.columns, grid.rows, 1, gdal.GDT_UInt16, options
        )
        with written(made) as dataset:
            dataset.SetGeoTransform((grid.west, grid.pixel, 0.0, grid.north, 0.0, -grid.pixel))
            dataset.SetProjection(system.ExportToWkt())
            dataset.GetRasterBand(1).WriteArray(pixels)


def _write_heights(scene: GeoScene, step: float, path: Path) -> None:
    # What is seen at the lowest and the highest ground lies some hundred metres beyond the image.
    margin = 600.0 + step
    low = np.array([scene.west, scene.north - scene.rows * scene.pixel]) - margin
    high = np.array([scene.west + scene.columns * scene.pixel, scene.north]) + margin
    write_terrain(path, scene.terrain, (low, high), step, simulated.MAP_CRS, GEOID)


# -- metadata --------------------------------------------------------------------------------------------------------


def metadata_text(scene: GeoScene, cuts: list[SimulatedComponent], multispectral: bool) -> str:
    """Return the text of ``po_<order>_metadata.txt``: sections between rules, nesting by three blanks."""
    sections = [
        ["Version Number: 2.2"],
        ["", "Product Order Metadata", "", *_order(scene, multispectral)],
        ["", "Source Image Metadata", "", *_source(scene)],
        ["", "Product Space Metadata", "", *_space(scene, len(cuts))],
        ["", "Product Component Metadata", "", f"Number of Components: {len(cuts)}"],
    ]
    for number, cut in enumerate(cuts):
        sections[-1] += [*(["", "-" * 62] if number else [""]), *_component(cut, multispectral)]
    return "".join(_RULE + "\n" + "".join(line + "\n" for line in (*lines, "")) for lines in sections) + _RULE + "\n"


def _order(scene: GeoScene, multispectral: bool) -> list[str]:
    return [
        "Creation Date: 05/26/01",
        f"Product Work Order Number: {ORDER}",
        f"Product Order Number: {ORDER}",
        "Customer Project Name: SIMULATED",
        "Sensor Type: Satellite",
        "Sensor Name: IKONOS-2",
        "Product Line: Geo",
        "Processing Level: Standard Geometrically Corrected",
        f"Image Type: {'PAN/MSI' if multispectral else 'PAN'}",
        "Interpolation Method: Cubic Convolution",
        "Multispectral Algorithm: None",
        "Stereo: Mono",
        "Mosaic: No",
        "Map Projection: Universal Transverse Mercator",
        "   UTM Specific Parameters",
        "      Hemisphere: N",
        f"      Zone Number: {simulated.MAP_CRS[-2:]}",
        "Datum: WGS84",
        f"Product Order Pixel Size: {scene.pixel:.10f} meters",
        "Product Order Map Units: meters",
        "MTFC Applied: No",
        "DRA Applied: No",
        "File Format: GeoTIFF",
        "   TIFF Tiled: No",
        "   Bits per Pixel per Band: 11 bits per pixel",
        "Multispectral Files: Separate Files",
    ]


def _source(scene: GeoScene) -> list[str]:
    azimuth, elevation = scene.view
    across, along = scene.sampling
    return [
        "Number of Source Images: 1",
        "",
        "Source Image ID: 2001052507012340000011600000",
        "Product Image ID: 000",
        "Sensor: IKONOS-2",
        "Acquired Nominal GSD",
        *(
            f"   {kind} {way} Scan: {factor * value:.2f} meters"
            for kind, factor in (("Pan", 1), ("MS", RATIO))
            for way, value in (("Cross", across), ("Along", along))
        ),
        f"Scan Azimuth: {scene.scan_azimuth_deg:.2f} degrees",
        f"Scan Direction: {'Reverse' if scene.scan.is_reverse else 'Forward'}",
        f"Nominal Collection Azimuth: {azimuth:.4f} degrees",
        f"Nominal Collection Elevation: {elevation:.5f} degrees",
        "Sun Angle Azimuth: 120.1234 degrees",
        "Sun Angle Elevation: 65.12345 degrees",
        "Acquisition Date/Time: 2001-05-25 07:01 GMT",
        "Percent Cloud Cover: 0",
    ]


def _space(scene: GeoScene, components: int) -> list[str]:
    return [
        f"Number of Image Components: {components}",
        f"   X Components: {components}",
        "   Y Components: 1",
        *_corners("Product", scene),
        *_grid(scene),
    ]


def _component(cut: SimulatedComponent, multispectral: bool) -> list[str]:
    bands = ("pan", *MULTISPECTRAL) if multispectral else ("pan",)
    names = " ".join(f"po_{ORDER}_{band}_{cut.identifier}.tif" for band in bands)
    grid = cut.scene
    # The vendor counts from the centre of the first pixel.
    x, y = grid.west + grid.pixel / 2, grid.north - grid.pixel / 2
    return [
        f"Component ID: {cut.identifier}",
        "Product Image ID: 000",
        f"Component File Name: {names}",
        "Country Code: IR",
        *_corners("Component", grid),
        "Component Map Coordinates (in Map Units)",
        f"   UL Map X (Easting): {x:.4f} meters",
        f"   UL Map Y (Northing): {y:.4f} meters",
        *_grid(grid),
        "Percent Component Cloud Cover: 0",
    ]


def _grid(grid: GeoScene) -> list[str]:
    return [
        f"Pixel Size X: {grid.pixel:.10f} meters",
        f"Pixel Size Y: {grid.pixel:.10f} meters",
        "Product Order Map Units: meters",
        f"Columns: {grid.columns} pixels",
        f"Rows: {grid.rows} pixels",
        f"Reference Height: {simulated.REFERENCE_HEIGHT:.10f} meters",
    ]


def _corners(of: str, grid: GeoScene) -> list[str]:
    corners = grid.on_map([[0, 0], [grid.columns, 0], [grid.columns, grid.rows], [0, grid.rows]])
    lines = [f"{of} Geographic Corner Coordinates", "   Number of Coordinates: 4"]
    for number, (lon, lat, _) in enumerate(corners.tolist(), 1):
        lines += [
            f"   Coordinate: {number}",
            f"      Latitude: {lat:.8f} degrees",
            f"      Longitude: {lon:.8f} degrees",
        ]
    return lines


def _truth(scene: GeoScene, seed: int, off_nadir_deg: float) -> dict[str, Any]:
    azimuth, elevation = scene.view
    bias = (scene.image - scene.predict(scene.ground)).mean(axis=0)
    return {
        "about": "truth of a simulated IKONOS Geo scene",
        "seed": seed,
        "off_nadir_deg": off_nadir_deg,
        "azimuth_deg": azimuth,
        "elevation_deg": elevation,
        "satellite_m": scene.scan.satellite(np.zeros(1))[0].tolist(),
        "attitude_error_rad": scene.attitude_error.tolist(),
        "bias_px": bias.tolist(),
        "bias_is": "true minus what the vendor predicts, mean over the points",
        "terrain": {"bend": scene.terrain.bend, "roughness": scene.terrain.roughness, "seed": scene.terrain.seed},
        "noise": {"points_image_m": simulated.POINTING, "points_ground_m": simulated.SIGMA_GROUND},
        "points": [
            {"id": name, "image": image.tolist(), "lon_lat_h": ground.tolist()}
            for name, image, ground in zip(scene.point_ids, scene.image, scene.ground, strict=True)
        ],
    }
