"""Orthos without a pixel, heights that are no terrain and DEMs that cannot be: errors before anything is left."""

import os

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.errors import CoverageError, CrsError, InputError
from ortho_pipeline.options import OutputOptions, SurfaceOptions
from ortho_pipeline.surface.dem import NEAREST_METRES, open_dem
from ortho_pipeline.surface.dem_file import DemFile


def dem_of(tiny, **options):
    return SurfaceOptions(**{"dem": tiny.dem, "vertical": "ellipsoid", **options})


def moved(tiny, path, east=0.0, up=0.0, pitch=None):
    """Write the DEM of the scene again, at another place or height, or with samples of another size."""
    source = gdal.Open(str(tiny.dem))
    copy = gdal.GetDriverByName("GTiff").CreateCopy(str(path), source)
    x, dx, _, y, _, dy = source.GetGeoTransform()
    copy.SetGeoTransform((x + east, pitch or dx, 0, y, 0, -(pitch or -dy)))
    copy.GetRasterBand(1).WriteArray(source.ReadAsArray() + np.float32(up))
    copy = None
    return path


def refused(tiny, folder, match, kind=InputError, **options):
    given = {"surface": dem_of(tiny), **options}
    with pytest.raises(kind, match=match) as caught:
        commands.rectify(tiny.image, folder, **given)
    assert not folder.exists() or not list(folder.iterdir())
    assert caught.value.remedy
    return caught.value


def test_an_extent_beside_the_scene_is_refused(tiny, tmp_path):
    output = OutputOptions(extent=(0.0, 0.0, 1000.0, 1000.0), resolution=10.0)
    error = refused(tiny, tmp_path / "out", "does not overlap the scene", output=output)
    assert error.field == "output.extent"


def test_an_extent_at_the_other_turn_of_longitude_is_the_same_extent(tiny, tmp_path):
    lon, lat = tiny.model.lon_off, tiny.model.lat_off
    for turn in (0.0, 360.0):
        extent = (lon - 0.002 + turn, lat - 0.002, lon + 0.002 + turn, lat + 0.002)
        output = OutputOptions(crs="EPSG:4326", extent=extent, resolution=1e-4)
        assert commands.check(tiny.image, surface=dem_of(tiny), output=output)["grid"]["size"] == [40, 40]


@pytest.mark.parametrize(
    "crs", ["EPSG:4978", "EPSG:5773", "+proj=ob_tran +o_proj=longlat +o_lon_p=0 +o_lat_p=39 +lon_0=18 +type=crs",
            "+proj=ob_tran +o_proj=moll +o_lon_p=0 +o_lat_p=39 +lon_0=18"]
)  # fmt: skip
def test_a_crs_that_no_map_can_have_is_refused(tiny, tmp_path, crs):
    error = refused(tiny, tmp_path / "out", "GeoTIFF|horizontal", CrsError, output=OutputOptions(crs=crs))
    assert error.field == "output.crs"


@pytest.mark.parametrize("height", [9000.0, -20000.0, -430.0])
def test_a_height_that_the_model_is_not_good_for_is_refused(tiny, tmp_path, height):
    error = refused(tiny, tmp_path / "out", f"height of {height:g} m", surface=SurfaceOptions(height=height))
    assert error.field == "surface.height"
    assert "0 to 1000 m" in error.remedy


@pytest.mark.parametrize("fill", ["error", "mask"])
def test_a_dem_elsewhere_is_refused(tiny, tmp_path, fill):
    dem = moved(tiny, tmp_path / "far.tif", east=100_000.0)
    error = refused(
        tiny,
        tmp_path / "out",
        "(not cover the scene|covers 0)",
        CoverageError,
        surface=dem_of(tiny, dem=dem, fill=fill),
    )
    assert error.file == str(dem)


@pytest.mark.parametrize("fill", ["error", "mask"])
def test_heights_beyond_those_of_the_model_are_named(tiny, tmp_path, fill):
    dem = moved(tiny, tmp_path / "high.tif", up=2000.0)
    refused(tiny, tmp_path / "out", "are 24.. to 25.. m", CoverageError, surface=dem_of(tiny, dem=dem, fill=fill))


def test_nearest_takes_no_height_from_far_away(tiny, tmp_path):
    far, near = (moved(tiny, tmp_path / f"{east}.tif", east=east) for east in (NEAREST_METRES + 10_000.0, 1500.0))
    refused(tiny, tmp_path / "out", "15.4 km", CoverageError, surface=dem_of(tiny, dem=far, fill="nearest"))
    done = commands.check(tiny.image, surface=dem_of(tiny, dem=near, fill="nearest"))
    assert 0 < done["coverage"] < 1
    surface = open_dem(far, "ellipsoid", fill="nearest")
    reach = surface.nearest_reach
    window = surface.window(-reach - 5, 10, reach + 5, 1)[0]
    assert np.isnan(window[:5]).all()
    assert (window[5:] == surface.window(0, 10, 1, 1)).all()
    x, _, _, y, _, _ = gdal.Open(str(far)).GetGeoTransform()
    heights = surface.heights([[x - 30.0 * (reach - 2), y - 315.0], [x - 30.0 * (reach + 2), y - 315.0]])
    np.testing.assert_array_equal(np.isfinite(heights), [True, False])


def test_no_valid_pixel_is_an_error_and_leaves_nothing(tiny, tmp_path):
    dataset = gdal.Open(str(tiny.image), gdal.GA_Update)
    dataset.GetRasterBand(1).SetNoDataValue(7)
    dataset.GetRasterBand(1).WriteArray(np.full((300, 400), 7, np.uint16))
    dataset = None
    for engine in ("ortho", "gdal"):
        refused(tiny, tmp_path / engine, "no pixel of this ortho has a value", output=OutputOptions(engine=engine))


def test_hardly_any_valid_pixel_is_said(tiny, tmp_path):
    dataset = gdal.Open(str(tiny.image), gdal.GA_Update)
    pixels = np.full((300, 400), 7, np.uint16)
    pixels[100:120, 100:120] = 1000
    dataset.GetRasterBand(1).SetNoDataValue(7)
    dataset.GetRasterBand(1).WriteArray(pixels)
    dataset = None
    done = commands.rectify(tiny.image, tmp_path / "out", surface=dem_of(tiny))
    assert any(
        "of the pixels inside the footprint have a value" in text for text in done.document["report"]["warnings"]
    )


def test_a_tolerance_without_end_is_refused():
    with pytest.raises(InputError, match="tolerance: inf is not a number above 0"):
        OutputOptions(tolerance=float("inf"))


def test_samples_that_are_too_close_to_be_a_dem_are_refused(tiny, tmp_path):
    dem = moved(tiny, tmp_path / "fine.tif", pitch=1e-6)
    refused(tiny, tmp_path / "out", "1e-06 m apart", CrsError, surface=dem_of(tiny, dem=dem, fill="mask"))


def test_a_dem_that_is_cut_off_is_called_damaged(tiny, tmp_path):
    dem = tmp_path / "cut.tif"
    gdal.GetDriverByName("GTiff").CreateCopy(str(dem), gdal.Open(str(tiny.dem)), options=["COMPRESS=DEFLATE"])
    os.truncate(dem, dem.stat().st_size // 2)
    for fill in ("error", "mask", "nearest", "500"):
        error = refused(tiny, tmp_path / "out", "cannot be read", surface=dem_of(tiny, dem=dem, fill=fill))
        assert error.file == str(dem)
        # What GDAL says is a part of the sentence: without the file, which stands before it, and without its full stop.
        assert str(error).count(str(dem)) == 1
        assert ".)" not in error.message


@pytest.mark.parametrize("fill", ["nearest", "500"])
def test_a_fill_rule_does_not_read_the_whole_dem(tiny, tmp_path, monkeypatch, fill):
    # 12,000 x 12,000 samples would be 1.2 GB as heights; the scene lies on 80 x 80 of them.
    dem, side = tmp_path / "large.tif", 12_000
    source = gdal.Open(str(tiny.dem))
    x, dx, _, y, _, dy = source.GetGeoTransform()
    options = ["TILED=YES", "SPARSE_OK=YES", "COMPRESS=DEFLATE"]
    large = gdal.GetDriverByName("GTiff").Create(str(dem), side, side, 1, gdal.GDT_Float32, options)
    large.SetGeoTransform((x, dx, 0, y, 0, dy))
    large.SetProjection(source.GetProjection())
    large.WriteArray(source.ReadAsArray())
    large = None
    read, inside = [], DemFile.read
    monkeypatch.setattr(DemFile, "read", lambda self, *window: read.append(window) or inside(self, *window))
    commands.check(tiny.image, surface=dem_of(tiny, dem=dem, fill=fill))
    assert max(left + width for left, _, width, *_ in read) < 3000
