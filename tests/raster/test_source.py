"""What is opened as a raster, and what is refused."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.raster.source import RasterSource, open_dataset, open_pixels


def test_a_folder_without_a_product_is_no_image(tmp_path):
    with pytest.raises(InputError, match="this is a folder, not an image") as caught:
        open_dataset(tmp_path)
    assert "by name" in str(caught.value.remedy)


def raster(path, count=2, nodata=None, alpha=False, masked=False) -> str:
    """Write bands of 3 x 2 pixels, the first without a value, and a second one in the last band alone."""
    options = ["ALPHA=YES"] if alpha else []
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 3, 2, count, gdal.GDT_Byte, options)
    values = np.arange(10, 10 + 6 * count, dtype=np.uint8).reshape(count, 2, 3)
    if nodata is not None:
        values[:, 0, 0] = values[-1, 0, 1] = nodata
        for band in range(count):
            dataset.GetRasterBand(band + 1).SetNoDataValue(nodata)
    elif alpha:
        values[-1] = 255
        values[-1, 0, 0] = 0
    dataset.WriteArray(values)
    if masked:
        dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
        dataset.GetRasterBand(1).GetMaskBand().WriteArray(np.array([[255] * 3, [255, 255, 0]], dtype=np.uint8))
    return str(path)


@pytest.mark.parametrize(
    ("written", "bands", "validity", "invalid"),
    [
        ({}, None, "all", None),
        ({"nodata": 7}, None, "nodata", [(0, 0, 0), (1, 0, 0), (1, 0, 1)]),
        ({"alpha": True}, None, "alpha", [(0, 0, 0)]),
        ({"alpha": True}, [1], "mask", [(0, 0, 0)]),
        ({"alpha": True}, [2, 1], "mask", [(0, 0, 0), (1, 0, 0)]),
        ({"masked": True}, None, "mask", [(0, 1, 2), (1, 1, 2)]),
        ({"masked": True, "nodata": 7}, None, "nodata", [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 1, 2), (1, 1, 2)]),
    ],
)
def test_which_pixels_are_valid(tmp_path, written, bands, validity, invalid):
    source = RasterSource(raster(tmp_path / "a.tif", **written), bands=bands)
    assert source.validity == validity
    pixels = source.read(0, 0, 3, 2)
    valid = source.read_valid(0, 0, pixels)
    if invalid is None:
        assert valid is None
        return
    expected = np.ones(pixels.shape, dtype=bool)
    expected[tuple(np.transpose(invalid))] = False
    np.testing.assert_array_equal(np.broadcast_to(valid, pixels.shape)[:1], expected[:1])
    if validity != "alpha":
        np.testing.assert_array_equal(valid, expected)


@pytest.mark.parametrize("nodata", [None, 4])
@pytest.mark.parametrize("bands", [None, [2], [3, 1]])
def test_a_mask_of_each_band_is_that_of_its_band(tmp_path, monkeypatch, bands, nodata):
    pixels, path = np.arange(18, dtype=np.uint8).reshape(3, 2, 3), tmp_path / "a.tif"
    masks = np.random.default_rng(1).random((3, 2, 3)) > 0.4
    made = gdal.GetDriverByName("GTiff").Create(str(path), 3, 2, 3)
    made.WriteArray(pixels)
    monkeypatch.setenv("GDAL_TIFF_INTERNAL_MASK", "NO")
    for band, mask in enumerate(masks, 1):
        made.GetRasterBand(band).CreateMaskBand(0)
        made.GetRasterBand(band).GetMaskBand().WriteArray(mask.astype(np.uint8) * 255)
    if nodata is not None:
        made.GetRasterBand(1).SetNoDataValue(nodata)
    del made
    source = RasterSource(path, bands=bands)
    chosen = np.array(bands or [1, 2, 3]) - 1
    assert {band.GetMaskFlags() for band in source.bands} == {0}
    assert source.validity == ("mask" if nodata is None else "nodata")
    valid = source.read_valid(0, 0, source.read(0, 0, 3, 2))
    np.testing.assert_array_equal(valid, (masks & (pixels != nodata))[chosen])


@pytest.mark.driver("ENVI")
@pytest.mark.parametrize("dtype", [None, "Float64", "Int32"])
def test_nodata_with_more_digits_than_a_pixel_has_is_that_of_the_pixels(tmp_path, dtype):
    """A VRT and the header of an ENVI file state -9999.9, and float32 holds -9999.900390625: GDAL's mask knows."""
    made = gdal.GetDriverByName("ENVI").Create(str(tmp_path / "a.img"), 3, 2, 1, gdal.GDT_Float32)
    made.WriteArray(np.array([[1.5, -9999.9, 3.0], [4.0, 5.0, -9999.9]], dtype=np.float32))
    made.FlushCache()
    gdal.Translate(str(tmp_path / "a.vrt"), made, format="VRT", noData=-9999.9).FlushCache()
    del made
    (tmp_path / "a.img.aux.xml").unlink(missing_ok=True)
    header = tmp_path / "a.hdr"
    header.write_text(header.read_text().rstrip() + "\ndata ignore value = -9999.9\n")
    view = tmp_path / "a.vrt"
    view.write_text(view.read_text().replace("-9999.900390625", "-9999.9").replace("-9999.90039062", "-9999.9"))
    for name in ("a.img", "a.vrt"):
        source = RasterSource(tmp_path / name, dtype=dtype)
        assert source.bands[0].GetNoDataValue() == -9999.9
        pixels = source.read(0, 0, 3, 2)
        by_gdal = source.bands[0].GetMaskBand().ReadAsArray() > 0
        np.testing.assert_array_equal(source.read_valid(0, 0, pixels)[0], by_gdal)
        assert by_gdal.sum() == 4
        written = Profile.of(source, dtype="Float64").nodata
        assert written == np.float32(-9999.9).astype(float)


def test_bands_of_several_files_are_valid_each_as_in_its_own(tmp_path):
    plain, holes = raster(tmp_path / "a.tif"), raster(tmp_path / "b.tif", nodata=7)
    source = RasterSource(plain, holes, bands=[1, 2, 4, 3])
    pixels = source.read(1, 0, 2, 2)
    own = [[[11, 12], [14, 15]], [[17, 18], [20, 21]]]
    np.testing.assert_array_equal(pixels, [*own, [[7, 18], [20, 21]], own[0]])
    expected = np.ones((4, 2, 2), dtype=bool)
    expected[2, 0, 0] = False
    np.testing.assert_array_equal(source.read_valid(1, 0, pixels), expected)
    for band in (0, 5):
        with pytest.raises(InputError, match=f"no band {band}: the image has 4"):
            RasterSource(plain, holes, bands=[band])


def one_block(path, kind) -> str:
    """Write the header of a raster whose only block has 32,768 x 32,768 pixels."""
    options = ["BLOCKYSIZE=32768", "SPARSE_OK=TRUE", "COMPRESS=DEFLATE"]
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 32768, 32768, 1, kind, options)
    del dataset
    return str(path)


def test_a_block_of_a_gigabyte_is_opened(tmp_path):
    assert RasterSource(one_block(tmp_path / "a.tif", gdal.GDT_Byte)).width == 32768


def test_a_larger_block_is_refused_with_its_size(tmp_path):
    with pytest.raises(InputError, match=f"32768 x 32768 pixels in blocks of {1 << 31} bytes"):
        RasterSource(one_block(tmp_path / "a.tif", gdal.GDT_UInt16))


def test_a_name_that_is_too_long_for_the_system_is_named_as_the_cause() -> None:
    with pytest.raises(InputError, match=r"cannot be read \(File name too long\)"):
        RasterSource("x" * 300)


@pytest.mark.parametrize("opened", [open_dataset, open_pixels, RasterSource, preview_png, grid_of])
def test_rasters_of_other_machines_are_not_opened_unless_that_is_allowed(opened):
    with pytest.raises(InputError, match="network access is off by default"):
        opened("https://example.invalid/a.tif")


def test_a_palette_of_any_band_or_file_counts(tmp_path):
    """Its indices must not be mixed, whatever is next to them."""
    plain = raster(tmp_path / "a.tif", count=1)
    dataset = gdal.Open(raster(tmp_path / "b.tif", count=1), gdal.GA_Update)
    colours = gdal.ColorTable()
    colours.SetColorEntry(11, (200, 100, 50))
    dataset.GetRasterBand(1).SetColorTable(colours)
    dataset = None
    assert not RasterSource(plain).palette
    for names in ((plain, tmp_path / "b.tif"), (tmp_path / "b.tif", plain)):
        assert RasterSource(*names).palette
        assert not RasterSource(*names, bands=[1 + (names[0] != plain)]).palette
    gdal.BuildVRT(str(tmp_path / "c.vrt"), [plain, str(tmp_path / "b.tif")], separate=True)
    both = gdal.Open(str(tmp_path / "c.vrt"), gdal.GA_Update)
    both.GetRasterBand(2).SetColorTable(colours)
    both = None
    assert RasterSource(tmp_path / "c.vrt").palette


def test_a_vrt_in_an_archive_is_not_opened(tmp_path):
    """What it refers to cannot be seen to there; an image in the same archive is read."""
    raster(tmp_path / "a.tif")
    gdal.Translate(str(tmp_path / "a.vrt"), str(tmp_path / "a.tif"), format="VRT").FlushCache()
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in ("a.tif", "a.vrt"):
            archive.write(tmp_path / name, name)
    assert RasterSource(f"/vsizip/{tmp_path}/a.zip/a.tif").width == 3
    with pytest.raises(InputError, match="GDAL cannot open this"):
        RasterSource(f"/vsizip/{tmp_path}/a.zip/a.vrt")
