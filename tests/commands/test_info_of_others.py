"""`ortho info` of what is no scene: DEMs and orthos say what they are, projects and photos what was recognised."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from osgeo import gdal

from ortho_pipeline.cli.program import cli
from tests.conftest import SAMPLE

gdal.UseExceptions()


def info(*words: Any) -> Result:
    return CliRunner().invoke(cli, ["info", *map(str, words)])


def picture(path: Path, tags: dict[str, str] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    made = gdal.GetDriverByName("GTiff").Create(str(path), 30, 20, 3)
    made.SetMetadata(tags or {})
    return path


def test_a_dem_says_what_it_is():
    done = info(SAMPLE / "dem.tif")
    assert done.exit_code == 0, done.output
    for text in ("a DEM", "EPSG:32636", "20 x 20 metre", "EGM96 height", f"--dem {SAMPLE / 'dem.tif'}"):
        assert text in done.output
    document = json.loads(info(SAMPLE / "dem.tif", "--json").stdout)
    heights = gdal.Open(str(SAMPLE / "dem.tif")).ReadAsArray()
    heights = heights[heights != -32768]
    assert document["kind"] == "dem"
    assert document["option"] == "surface.dem"
    np.testing.assert_allclose(document["heights"], [heights.min(), heights.max()], atol=1.0)
    # Longitude comes first.
    assert 33.3 < document["corners_lon_lat"][0][0] < 33.4
    assert 37.2 < document["corners_lon_lat"][0][1] < 37.3


def test_a_raster_in_a_local_system_is_named(tmp_path):
    path = picture(tmp_path / "site.tif")
    made = gdal.Open(str(path), gdal.GA_Update)
    made.SetProjection('LOCAL_CS["site",UNIT["metre",1]]')
    made.SetGeoTransform((0, 1, 0, 0, 0, -1))
    made = None
    done = info(path)
    assert done.exit_code == 2
    assert done.output.startswith(f"Error: {path}: CRS: there is no transformation from 'site'")


def test_an_ortho_says_what_it_is():
    done = info(SAMPLE / "reference.tif")
    assert done.exit_code == 0, done.output
    reference = f"--reference {SAMPLE}"
    for text in ("an ortho or another map raster", "no sensor model", "EPSG:32636", "5 x 5 metre", reference):
        assert text in done.output
    document = json.loads(info(SAMPLE / "reference.tif", "--json").stdout)
    assert document["kind"] == "map image"
    assert document["extent"] == [529305.0, 4121045.0, 532890.0, 4124260.0]
    # A scene on a map stays a scene, and an option that opens one is not passed over.
    assert json.loads(info(SAMPLE / "ikonos" / "po_39001_pan_0000000.tif", "--json").stdout)["sensor"] == "ikonos"
    assert info(SAMPLE / "reference.tif", "--rpc", SAMPLE / "scene_RPC.TXT", "--json").exit_code == 0


@pytest.mark.parametrize(("scale", "heights"), [(0.1, [51.0, 53.0]), (-0.1, [47.0, 49.0])])
def test_the_heights_of_a_dem_have_its_scale(tmp_path: Path, scale: float, heights: list[float]):
    path = str(tmp_path / "dem.tif")
    made = gdal.GetDriverByName("GTiff").Create(path, 2, 1, 1, gdal.GDT_Int16)
    made.SetProjection(gdal.Open(str(SAMPLE / "dem.tif")).GetProjection())
    made.SetGeoTransform((530_000, 20, 0, 4_124_000, 0, -20))
    # GDAL 3.13 loses them after the pixels, if the CRS has heights.
    made.GetRasterBand(1).SetScale(scale)
    made.GetRasterBand(1).SetOffset(50.0)
    made.GetRasterBand(1).WriteArray(np.array([[10, 30]]))
    made = None
    assert json.loads(info(path, "--json").stdout)["heights"] == pytest.approx(heights)


def test_a_dem_of_voids_is_described(tmp_path: Path):
    made = gdal.Translate(str(tmp_path / "dem.tif"), str(SAMPLE / "dem.tif"), width=2, height=1)
    made.GetRasterBand(1).WriteArray(np.full((1, 2), made.GetRasterBand(1).GetNoDataValue()))
    made = None
    done = info(tmp_path / "dem.tif")
    assert "no valid sample found, EGM96 height" in done.output
    assert done.exit_code == 0


def test_a_damaged_dem_is_not_one_of_voids(tmp_path: Path):
    path = tmp_path / "dem.tif"
    made = gdal.Translate(str(path), str(SAMPLE / "dem.tif"), creationOptions=["COMPRESS=DEFLATE"])
    begins = int(made.GetRasterBand(1).GetMetadataItem("BLOCK_OFFSET_0_0", "TIFF"))
    made = None
    content = bytearray(path.read_bytes())
    content[begins : begins + 8] = b"\xff" * 8
    path.write_bytes(content)
    done = info(path)
    assert "the heights cannot be read" in done.output
    assert done.exit_code == 2


def test_a_dem_without_a_datum_asks_for_it(tmp_path):
    dem = str(tmp_path / "dem.tif")
    gdal.Translate(dem, str(SAMPLE / "dem.tif"), outputSRS="EPSG:32636")
    assert "--dem-vertical DATUM" in info(dem).output


def test_a_table_that_names_the_image_is_named(tmp_path):
    image = picture(tmp_path / "a_b.tif")
    (tmp_path / "positions.txt").write_text("x 1 2 3 4 5 6\na_b -5.5 -3.7e6 5258.3 -0.3 0.29 -179.0\n")
    done = info(image)
    assert "positions.txt seems to have an exterior orientation for this image" in done.output
    assert f"--sensor-option exterior={tmp_path / 'positions.txt'}" in done.output
    other = picture(tmp_path / "c.tif")
    assert "no sensor recognises this image" in info(other).output


def test_a_photo_with_a_position_says_what_is_missing(tmp_path):
    tags = {
        "EXIF_GPSLatitude": "(24) (41) (5.7)",
        "EXIF_GPSLatitudeRef": "N",
        "EXIF_Make": "DJI",
        "EXIF_Model": "FC6310R",
    }
    done = info(picture(tmp_path / "a.tif", tags), "--json")
    assert done.exit_code == 2
    assert "this photo has no position" in json.loads(done.stdout)["error"]["message"]
    assert "no model: this photo has no position" in info(tmp_path).output


@pytest.mark.realdata
def test_a_real_project_opens_and_a_table_next_to_frames_is_named(real):
    image = real / "orthority" / "odm" / "images" / "100_0005_0018.tif"
    assert json.loads(info(image, "--json").stdout)["sensor"] == "odm"
    # A frame that was laid on the map roughly is no ortho, and the DEM next to it is a DEM.
    ngi = real / "orthority" / "ngi"
    assert "camera_pos_ori.txt" in info(ngi / "3324c_2015_1004_05_0182_RGB.tif").output
    assert json.loads(info(ngi / "dem.tif", "--json").stdout)["vertical"] == "EGM2008 height"
