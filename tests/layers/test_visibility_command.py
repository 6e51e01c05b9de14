"""What terrain hides, as `rectify` treats it: a mask next to the ortho, or a true ortho."""

from __future__ import annotations

import dataclasses

import numpy as np
import orthos
import pytest
from blocks import FLOOR, NORTH, WEST, City, Parallel, f1, towards
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import OutputOptions, SurfaceOptions
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.report.document import read_report
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.warp import lattice_engine as engine
from ortho_pipeline.warp.quality.hiding import Hiding

TOWN = City(((60, 40, 90, 80, 30.0), (120, 100, 128, 110, 60.0), (30, 150, 150, 162, 18.0)))


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Return model, source and surface of a town seen from the west; what is on a roof is 200, on the ground 50."""
    folder = tmp_path_factory.mktemp("town")
    model = Parallel(*towards(30, 270), 0.5, TOWN.side)
    surface = TOWN.surface(folder / "dsm.tif")
    image = np.full((1, 700, 700), 50, dtype=np.uint8)
    made = gdal.GetDriverByName("GTiff").Create(str(folder / "image.tif"), 700, 700, 1, gdal.GDT_Byte)
    made.WriteArray(image[0])
    made = None
    return model, RasterSource(folder / "image.tif"), surface


def warped(town, hiding, **more):
    model, source, surface = town
    return orthos.rectify(model, source, surface, TOWN.grid(), hiding, driver="GTiff", **more)


def test_a_mask_has_the_classes_and_nodata_leaves_them_empty(town, tmp_path):
    heights = (FLOOR, FLOOR + 60)
    result = warped(town, Hiding(tmp_path / "all.tif", heights, tmp_path / "mask.tif"))
    classes = gdal.Open(str(tmp_path / "mask.tif")).ReadAsArray()
    x, y = TOWN.places(TOWN.grid())
    wanted = TOWN.hidden(x, y, *towards(30, 270))
    assert f1(classes == 2, wanted) > 0.95
    assert set(np.unique(classes)) == {1, 2}
    # A GIS that opens it shows classes in their colours.
    mask = gdal.Open(str(tmp_path / "mask.tif"))
    colours = mask.GetRasterBand(1).GetColorTable()
    assert len({colours.GetColorEntry(value) for value in (1, 2, 3, 4)}) == 4
    assert result.hidden_share == pytest.approx((classes == 2).mean())
    empty = warped(town, Hiding(tmp_path / "true.tif", heights))
    assert empty.hidden_share == result.hidden_share
    assert empty.valid_pixels == result.valid_pixels - (classes == 2).sum()
    true = gdal.Open(str(tmp_path / "true.tif"))
    band = true.GetRasterBand(1)
    np.testing.assert_array_equal(band.GetMaskBand().ReadAsArray() == 0, classes == 2)
    assert (band.ReadAsArray()[classes == 2] == 0).all()


@pytest.mark.parametrize("void", [False, True])
def test_what_the_image_or_the_dem_does_not_reach_has_classes_of_its_own(tmp_path, void):
    """Seen straight down by an image of 150 x 200 m; a void of the DEM is partly in it."""
    City(()).surface(tmp_path / "dem.tif")
    dataset = gdal.Open(str(tmp_path / "dem.tif"), gdal.GA_Update)
    heights = dataset.ReadAsArray()
    if void:
        heights[100:180, 150:250] = -32768.0
    dataset.WriteArray(heights)
    dataset = None
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "image.tif"), 300, 400, 1, gdal.GDT_Byte)
    made.WriteArray(np.full((400, 300), 90, dtype=np.uint8))
    made = None
    surface, grid = open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"), City(()).grid(1.0)
    job = Parallel(0.0, 0.0, 0.5, 256.0), RasterSource(tmp_path / "image.tif"), surface, grid
    hiding = Hiding(tmp_path / "ortho.tif", (FLOOR, FLOOR), tmp_path / "mask.tif")
    result = orthos.rectify(*job, hiding, driver="GTiff", resampling="nearest")
    x, y = City(()).places(grid)
    own = surface.heights(np.stack([part.ravel() for part in (x + WEST, y + NORTH - 256.0)], axis=1)).reshape(x.shape)
    wanted = np.where(np.isnan(own), 4, np.where((x < 150) & (y > 56), 1, 3))
    mask = gdal.Open(str(tmp_path / "mask.tif"))
    np.testing.assert_array_equal(mask.ReadAsArray(), wanted)
    assert np.isnan(own).any() == void
    assert result.hidden_share == 0.0
    names = ["visible", "hidden", "outside of the image", "without a height"]
    assert [mask.GetMetadataItem(f"CLASS_{value}") for value in (1, 2, 3, 4)] == names


def test_tiles_threads_and_memory_change_nothing(town, tmp_path, monkeypatch):
    found = []
    for tile, resources in ((1024, Resources(2**29, 1)), (256, Resources(2**29, 3)), (512, Resources(24_000_000, 2))):
        monkeypatch.setattr(engine, "TILE", tile)
        hiding = Hiding(tmp_path / "ortho.tif", (FLOOR, FLOOR + 60), tmp_path / f"{tile}.tif")
        warped(town, hiding, resources=resources)
        found.append(gdal.Open(str(hiding.mask)).ReadAsArray())
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_rectify_writes_the_mask_with_the_ortho_and_reports_what_is_visible(tiny, tmp_path):
    output = OutputOptions(resolution=10.0, crs="EPSG:32634", visibility="mask")
    surface = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    result = commands.rectify(tiny.image, tmp_path / "out", surface=surface, output=output)
    classes = gdal.Open(str(result.files["visibility"]))
    ortho = gdal.Open(str(result.files["ortho"]))
    assert classes.GetGeoTransform() == ortho.GetGeoTransform()
    assert classes.GetMetadataItem("CLASS_2") == "hidden"
    np.testing.assert_array_equal(
        np.isin(classes.ReadAsArray(), (1, 2)), ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    )
    # The gentle waves of this DEM hide nothing from a camera that looks down.
    assert read_report(result.files["report"]).warp.hidden_share == 0.0
    assert "100 % of the area of the image" in result.files["html"].read_text()
    again = dataclasses.replace(output, visibility="nodata")
    true = commands.rectify(tiny.image, tmp_path / "out", surface=surface, output=again)
    assert "visibility" not in true.files
    assert not result.files["visibility"].exists()
    with pytest.raises(InputError, match="GDAL's warper"):
        commands.rectify(
            tiny.image, tmp_path / "gdal", surface=surface, output=dataclasses.replace(output, engine="gdal")
        )
