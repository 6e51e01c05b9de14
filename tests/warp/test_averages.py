"""Averages of an image with invalid pixels, against GDAL's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal, osr

from ortho_pipeline.cli.program import cli

SIDE, COARSER = 240, 20


def write(path: Path, pixels: np.ndarray, nodata: float | None) -> None:
    made = gdal.GetDriverByName("GTiff").Create(str(path), SIDE, SIDE, len(pixels), gdal.GDT_Float32)
    made.SetGeoTransform((500000.0, 10.0, 0.0, 4100000.0, 0.0, -10.0))
    utm = osr.SpatialReference()
    utm.ImportFromEPSG(32636)
    made.SetProjection(utm.ExportToWkt())
    for number, band in enumerate(pixels, 1):
        if nodata is not None:
            made.GetRasterBand(number).SetNoDataValue(nodata)
        made.GetRasterBand(number).WriteArray(band)
    made.FlushCache()


@pytest.mark.parametrize("nodata", [-1.0, None])
def test_an_output_pixel_is_empty_only_if_nothing_under_it_is_valid(tmp_path, nodata):
    """Almost a third of the pixels is invalid, and so is all under two output pixels; of the second band under more."""
    random = np.random.default_rng(2)
    pixels = random.uniform(50, 200, (2, SIDE, SIDE)).astype(np.float32)
    bad = random.random(pixels.shape) < 0.3
    bad[:, 40:60, 60:100] = bad[1, 100:120, 20:40] = True
    pixels[bad] = np.nan if nodata is None else nodata
    write(tmp_path / "image.tif", pixels, nodata)
    step = 10 * COARSER
    asked = ["--ortho", "--height", "0", "-tr", step, step, "-te", 500000, 4097600, 502400, 4100000, "-r", "average"]
    done = CliRunner().invoke(
        cli, ["rectify", str(tmp_path / "image.tif"), "-o", str(tmp_path / "o"), *map(str, asked)]
    )
    assert done.exit_code == 0, done.output
    ortho = gdal.Open(str(tmp_path / "o" / "image_ortho.tif")).ReadAsArray()
    empty = np.nan if nodata is None else nodata
    by_gdal = gdal.Warp(
        "", str(tmp_path / "image.tif"), format="MEM", xRes=step, yRes=step, resampleAlg="average",
        srcNodata=empty, dstNodata=empty, warpOptions=["UNIFIED_SRC_NODATA=NO"],
    ).ReadAsArray()  # fmt: skip
    known = np.ones(ortho.shape, dtype=bool)
    known[:, 2, 3:5] = known[1, 5, 1] = False
    for found in (ortho, by_gdal):
        np.testing.assert_array_equal(~np.isnan(found) if nodata is None else found != nodata, known)
    np.testing.assert_allclose(ortho[known], by_gdal[known], rtol=1e-5)
