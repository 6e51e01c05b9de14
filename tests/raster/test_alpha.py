"""Images with an alpha band: where it is 0 an ortho has no value, whatever bands it has."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal, osr

from ortho_pipeline.cli.program import cli
from ortho_pipeline.raster.pixel_types import valid_of
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.raster.valid_area import doubtful_alpha

SIDE = 40


def write(path: Path) -> np.ndarray:
    """Write an image of red, green, blue and alpha; return its bands."""
    pixels = np.random.default_rng(3).integers(1, 255, (4, SIDE, SIDE)).astype(np.uint8)
    pixels[3] = 255
    pixels[:, 5:15], pixels[3, 20:30] = 0, 128
    made = gdal.GetDriverByName("GTiff").Create(str(path), SIDE, SIDE, 4, options=["PHOTOMETRIC=RGB", "ALPHA=YES"])
    made.SetGeoTransform((500000.0, 10.0, 0.0, 4100000.0, 0.0, -10.0))
    utm = osr.SpatialReference()
    utm.ImportFromEPSG(32636)
    made.SetProjection(utm.ExportToWkt())
    made.WriteArray(pixels)
    return pixels


def rectified(folder: Path, *options: str) -> gdal.Dataset:
    grid = ["-tr", 10, 10, "-te", 500000, 4099600, 500400, 4100000]
    asked = [folder / "image.tif", "-o", folder / "o", "--ortho", "--height", 0, *grid, "-r", "nearest", *options]
    done = CliRunner().invoke(cli, ["rectify", *map(str, asked)])
    assert done.exit_code == 0, done.output
    return gdal.Open(str(folder / "o" / "image_ortho.tif"))


@pytest.mark.parametrize("engine", ["ortho", "gdal"])
@pytest.mark.parametrize("bands", [(3, 1), (4, 1), (2, 1, 4), (1, 4), (1, 4, 2, 3), (1, 2, 3, 4)])
def test_transparent_pixels_have_no_value_in_any_choice_of_bands(tmp_path, engine, bands):
    pixels = write(tmp_path / "image.tif")
    ortho = rectified(tmp_path, "-b", ",".join(map(str, bands)), "--engine", engine)
    valid = ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    np.testing.assert_array_equal(valid, pixels[3] > 0)
    # To GDAL alpha is the last of two or four bands.
    flags = gdal.GMF_PER_DATASET | (gdal.GMF_ALPHA if bands in ((1, 4), (1, 2, 3, 4)) else 0)
    assert ortho.GetRasterBand(1).GetMaskFlags() == flags
    chosen = pixels[np.array(bands) - 1]
    np.testing.assert_array_equal(ortho.ReadAsArray()[:, valid], chosen[:, valid])


@pytest.mark.parametrize("engine", ["ortho", "gdal"])
@pytest.mark.parametrize("bands", [(1, 2, 3, 4, 5), (1, 2, 3, 4), (2, 3, 4, 5), (4,), (5,)])
def test_alpha_counts_beside_any_number_of_bands(tmp_path, engine, bands):
    """GDAL makes a mask of alpha in rasters of two and four bands alone. It is its own, too."""
    pixels = write(tmp_path / "four.tif")
    pixels = np.insert(pixels, 3, pixels[0] + 1, axis=0)
    four = gdal.Open(str(tmp_path / "four.tif"))
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "image.tif"), SIDE, SIDE, 5)
    made.SetGeoTransform(four.GetGeoTransform())
    made.SetProjection(four.GetProjection())
    made.GetRasterBand(5).SetColorInterpretation(gdal.GCI_AlphaBand)
    made.WriteArray(pixels)
    made = None
    ortho = rectified(tmp_path, "-b", ",".join(map(str, bands)), "--engine", engine)
    valid = ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    np.testing.assert_array_equal(valid, pixels[4] > 0)
    chosen = pixels[np.array(bands) - 1]
    np.testing.assert_array_equal(np.atleast_3d(ortho.ReadAsArray().T).T[..., valid], chosen[:, valid])


@pytest.mark.parametrize("engine", ["ortho", "gdal"])
@pytest.mark.parametrize("kind", ["UInt16", "Int16", "Float32"])
def test_an_ortho_of_another_type_has_a_mask_and_keeps_the_values_of_alpha(tmp_path, engine, kind):
    pixels = write(tmp_path / "image.tif")
    ortho = rectified(tmp_path, "-ot", kind, "--engine", engine)
    valid = ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    np.testing.assert_array_equal(valid, pixels[3] > 0)
    np.testing.assert_array_equal(ortho.ReadAsArray()[:, valid], pixels[:, valid])


def test_two_files_with_an_alpha_band_each_have_a_mask(tmp_path):
    pixels = write(tmp_path / "a.tif")
    write(tmp_path / "b.tif")
    source = RasterSource(tmp_path / "a.tif", tmp_path / "b.tif")
    assert source.validity == "mask"
    valid = source.read_valid(0, 0, source.read(0, 0, SIDE, SIDE))
    np.testing.assert_array_equal(valid, np.broadcast_to(pixels[3] > 0, (8, SIDE, SIDE)))


@pytest.mark.parametrize(("alpha", "doubtful"), [("data", True), ("edge", False), ("as it is", False)])
def test_an_alpha_band_with_data_is_doubted(tmp_path, alpha, doubtful):
    """GDAL takes the fourth of four bands of bytes for alpha, such as near infrared."""
    pixels = write(tmp_path / "image.tif")
    made = gdal.Open(str(tmp_path / "image.tif"), gdal.GA_Update)
    if alpha == "data":
        made.GetRasterBand(4).WriteArray(pixels[0] // 2)
    if alpha == "edge":
        # Opaque, with a soft edge of as many levels as an image has.
        made.GetRasterBand(4).WriteArray(np.minimum(np.arange(SIDE) * 15, 255)[:, None] * np.ones((1, SIDE), np.uint8))
    del made
    rectified(tmp_path)
    report = json.loads((tmp_path / "o" / "image_report.json").read_text())
    assert ("doubtful-alpha" in [notice["code"] for notice in report["notices"]]) == doubtful
    made = gdal.Open(str(tmp_path / "image.tif"))
    assert [notice.fields for notice in doubtful_alpha(made)] == [{"band": 4}] * doubtful


def test_the_mask_of_a_band_can_be_read_when_nothing_else_holds_its_dataset(tmp_path):
    """GDAL's bands cannot be read after the object of their dataset is gone: that of `Band.GetDataset` is a new one."""
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "image.tif"), SIDE, SIDE, 5)
    made.GetRasterBand(5).SetColorInterpretation(gdal.GCI_AlphaBand)
    made.GetRasterBand(5).WriteArray(np.eye(SIDE))
    made = None
    opened = gdal.Open(str(tmp_path / "image.tif"))
    np.testing.assert_array_equal(valid_of(opened.GetRasterBand(1)), np.eye(SIDE) > 0)
    np.testing.assert_array_equal(
        valid_of(opened.GetRasterBand(2), 3, 5, 4, 6, buf_xsize=2, buf_ysize=3),
        opened.GetRasterBand(5).ReadAsArray(3, 5, 4, 6, buf_xsize=2, buf_ysize=3) > 0,
    )


@pytest.mark.parametrize("engine", ["ortho", "gdal"])
def test_alpha_of_real_numbers_is_never_rounded(tmp_path, engine):
    pixels = write(tmp_path / "four.tif") / np.float32([1, 1, 1, 400])[:, None, None]  # alpha of 0.32 and 0.64
    four = gdal.Open(str(tmp_path / "four.tif"))
    made = gdal.Translate(str(tmp_path / "image.tif"), four, outputType=gdal.GDT_Float32)
    made.WriteArray(pixels)
    made = None
    if engine == "gdal":
        with pytest.raises(AssertionError, match="rounds an alpha band of real numbers"):
            rectified(tmp_path, "-b", "1,2,3", "--engine", engine)
    else:
        ortho = rectified(tmp_path, "-b", "1,2,3")
        np.testing.assert_array_equal(ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0, pixels[3] > 0)


@pytest.mark.parametrize(("width", "height"), [(300, 280), (20, 25)])
def test_data_in_an_alpha_band_are_found_in_a_raster_of_any_size(tmp_path, width, height):
    """Its first corner is empty, as that of an image that is turned on its map."""
    pixels = np.random.default_rng(5).integers(1, 255, (4, height, width)).astype(np.uint8)
    pixels[:, : height // 6, : width // 6] = 0
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), width, height, 4, options=["ALPHA=YES"])
    made.WriteArray(pixels)
    made.FlushCache()
    assert [notice.fields for notice in doubtful_alpha(made)] == [{"band": 4}]
