"""Whole orthos at the edges of the Earth: each pixel is where the exact model has it, or there is an error that helps.

The bands of an image are its own columns and rows. Bilinear resampling gives these back exactly, so that a pixel of the
ortho says where in the image it was taken from, and the camera says where it had to be.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pyproj
import pytest
from ortho_studies.simulation.scanner import LineScanner
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.exchange.model_file import save_model
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.geodesy.crs import utm_crs
from ortho_pipeline.models import FrameCamera, SensorModel
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.options import OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.surface.writing import write_dem

SIZE, GSD, TOLERANCE = 200, 5.0, 0.01
#: Single precision of a column, and of the DEM's heights at 60 degrees off nadir.
ROUNDING = 1e-3


def write_image(path: Path, rpc: dict[str, str] | None = None) -> Path:
    """Write an image whose bands are the columns and the rows of its pixels' centres."""
    made = gdal.GetDriverByName("GTiff").Create(str(path), SIZE, SIZE, 2, gdal.GDT_Float32)
    if rpc is not None:
        made.SetMetadata(rpc, "RPC")
    made.WriteArray(np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)).astype(np.float32))
    made = None
    return path


class Plane:
    """A plane that leans 0.03 to the east and 0.01 to the north about a place in a map, and the DEM of it."""

    def __init__(self, crs: pyproj.CRS, x: float, y: float, height: float) -> None:
        self.crs, self.x, self.y, self.height = crs, x, y, height

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return self.height + 0.03 * (x - self.x) + 0.01 * (y - self.y)

    def write(self, path: Path, half: float) -> Path:
        step, count = 30.0, 2 * int(half / 30.0)
        left, top = self.x - half, self.y + half
        x, y = np.meshgrid(left + step * (np.arange(count) + 0.5), top - step * (np.arange(count) + 0.5))
        write_dem(path, self(x, y), (left, top), step, self.crs.to_string())
        return path


def misses(ortho: Path, plane: Plane, model: SensorModel) -> np.ndarray:
    """Return by how much the pixels of an ortho ``(N, 2)`` come from elsewhere in the image than the model has."""
    dataset = gdal.Open(str(ortho))
    left, dx, _, top, _, dy = dataset.GetGeoTransform()
    found = dataset.ReadAsArray()
    valid = dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    row, column = np.nonzero(valid)
    x, y = left + dx * (column + 0.5), top + dy * (row + 0.5)
    to_earth = pyproj.Transformer.from_crs(pyproj.CRS.from_wkt(dataset.GetProjection()), 4979, always_xy=True)
    lon, lat, height = to_earth.transform(x, y, plane(x, y))
    image = found[:, row, column].T
    # Within half a pixel of the edge of an image there is nothing to interpolate between.
    inner = ((image > 0.6) & (image < SIZE - 0.6)).all(axis=1)
    assert inner.sum() > 5000
    return (image - model.ground_to_image(np.column_stack([lon, lat, height])))[inner]


#: Longitude, latitude, degrees off nadir, height of the plane: each at an edge of what there is.
EDGES = {
    "north": (40.0, 89.7, 10.0, 250.0),
    "south": (-120.0, -89.7, 10.0, 2900.0),
    "antimeridian": (179.999, 10.0, 20.0, 250.0),
    "antimeridian in the north": (-179.9995, 83.0, 20.0, 50.0),
    "60 degrees off nadir": (33.35, 37.25, 60.0, 1000.0),
    "below the sea": (35.5, 31.5, 20.0, -380.0),
}


@pytest.mark.parametrize("place", EDGES)
def test_an_ortho_at_an_edge_is_where_the_camera_has_it(tmp_path: Path, place: str) -> None:
    lon, lat, angle, height = EDGES[place]
    heights = (height - 250.0, height + 250.0)
    camera = LineScanner.over(
        lon, lat, height, image_width=SIZE, image_height=SIZE, gsd=GSD, off_nadir_deg=angle, heights=heights
    )
    crs = utm_crs(lon, lat)
    x, y = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(lon, lat)
    plane = Plane(crs, x, y, height)
    corners = np.array([(column, row) for column in (0, SIZE) for row in (0, SIZE)] * 2, dtype=float)
    ground = camera.image_to_ground(corners, np.repeat(heights, 4))
    # Beyond 180 degrees, where the scene goes on.
    around = lon + (ground[:, 0] - lon + 180) % 360 - 180
    found = fit_rpc(camera, (around.min(), ground[:, 1].min(), around.max(), ground[:, 1].max()), heights)
    image = write_image(tmp_path / "one.tif", rpc_metadata(found.rpc))
    dem = plane.write(tmp_path / "dem.tif", 2000.0)
    commands.rectify(
        image, tmp_path / "out", surface=SurfaceOptions(dem=dem, vertical="ellipsoid"),
        output=OutputOptions(crs=crs.to_string(), resolution=2 * GSD, tolerance=TOLERANCE),
    )  # fmt: skip
    ortho = tmp_path / "out" / "one_ortho.tif"
    assert np.abs(misses(ortho, plane, found.rpc)).max() <= TOLERANCE + ROUNDING
    assert np.abs(misses(ortho, plane, camera)).max() <= TOLERANCE + ROUNDING + found.max_error_px
    assert found.max_error_px < 0.05


@pytest.mark.parametrize(("lat", "code"), [(90.0, 5041), (-90.0, 5042)])
def test_an_ortho_with_the_pole_in_it(tmp_path: Path, lat: float, code: int) -> None:
    """No RPC describes it, since longitudes there are all of them; a camera does."""
    crs = pyproj.CRS.from_epsg(code)
    interior = Interior(SIZE, SIZE, 0.1, 1e-4, 1e-4)
    exterior = (2_000_100.0, 1_999_950.0, 2000.0 + 0.1 / 1e-4 * GSD, math.radians(4.0), math.radians(-3.0), 0.3)
    camera = FrameCamera.from_map(interior, crs, exterior, heights=(1500.0, 2500.0))
    plane = Plane(crs, 2e6, 2e6, 2000.0)
    save_model(camera, tmp_path / "one_model.json")
    image, dem = write_image(tmp_path / "one.tif"), plane.write(tmp_path / "dem.tif", 2000.0)
    commands.rectify(
        image, tmp_path / "out", scene=SceneOptions(model=tmp_path / "one_model.json"),
        surface=SurfaceOptions(dem=dem, vertical="ellipsoid"),
        output=OutputOptions(crs=f"EPSG:{code}", resolution=2 * GSD, tolerance=TOLERANCE),
    )  # fmt: skip
    ortho = tmp_path / "out" / "one_ortho.tif"
    assert np.abs(misses(ortho, plane, camera)).max() <= TOLERANCE + ROUNDING
    # The pole itself is a pixel of it.
    dataset = gdal.Open(str(ortho))
    left, dx, _, top, _, dy = dataset.GetGeoTransform()
    column, row = int((2e6 - left) / dx), int((2e6 - top) / dy)
    assert dataset.GetRasterBand(1).GetMaskBand().ReadAsArray(column, row, 1, 1)[0, 0] > 0
