"""A finished ortho is a scene: its model is the map grid, only where that is asked for, and never of a raw scene."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from click.testing import CliRunner
from osgeo import gdal, osr

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.commands.orthos.opening import filled_of, open_ortho
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.models import MapGrid, model_from_dict
from ortho_pipeline.options import MatchOptions, SceneOptions
from ortho_pipeline.testing import check_sensor_model
from tests.conftest import SAMPLE

gdal.UseExceptions()
GRIDS = {
    "metres": ("EPSG:32636", (529_305.0, 5.0, 0.0, 4_124_260.0, 0.0, -5.0)),
    "feet": ("EPSG:8035", (1_640_000.0, 2.0, 0.0, 14_780_000.0, 0.0, -2.0)),
    "degrees": ("EPSG:4326", (33.3, 5e-5, 0.0, 37.2, 0.0, -4e-5)),
    "rotated": ("EPSG:32636", (529_305.0, 3.0, 4.0, 4_124_260.0, 4.0, -3.0)),
    "south up": ("EPSG:3857", (3_700_000.0, 10.0, 0.0, 4_400_000.0, 0.0, 10.0)),
}


def raster(path: Path, crs: str | None, transform: tuple[float, ...] | None, **domains: dict[str, str]) -> Path:
    made = gdal.GetDriverByName("GTiff").Create(str(path), 60, 40, 1)
    if crs:
        reference = osr.SpatialReference()
        reference.SetFromUserInput(crs)
        made.SetProjection(reference.ExportToWkt())
    if transform:
        made.SetGeoTransform(transform)
    made.GetRasterBand(1).WriteArray(np.arange(2400, dtype=np.uint8).reshape(40, 60))
    for domain, items in domains.items():
        made.SetMetadata(items, domain)
    return path


@pytest.mark.parametrize("name", GRIDS)
def test_the_map_grid_is_a_sensor_model(name):
    crs, transform = GRIDS[name]
    model = MapGrid(crs, transform, (60, 40))
    centre, half = model.domain
    check_sensor_model(model, centre + half * np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3)))
    assert not model.uses_height
    # Of all ground, from the Dead Sea to the summit of Everest.
    assert model.height_range[0] < -430
    assert model.height_range[1] > 8849
    # GDAL's own geotransform is the authority.
    x, y = gdal.ApplyGeoTransform(transform, 12.5, 7.25)
    np.testing.assert_allclose(model.ground_to_image([[x, y, 123.0]]), [[12.5, 7.25]], atol=1e-7)
    again = model_from_dict(json.loads(json.dumps(model.to_dict())))
    np.testing.assert_array_equal(again.ground_to_image([[x, y, 0.0]]), model.ground_to_image([[x, y, 0.0]]))


def test_longitudes_are_counted_as_the_map_counts_them():
    model = MapGrid("EPSG:4326", (199.0, 0.1, 0.0, 10.0, 0.0, -0.1), (20, 20))
    np.testing.assert_allclose(model.ground_to_image([[-160.0, 9.0, 0.0]]), [[10.0, 10.0]], atol=1e-9)


@pytest.mark.parametrize("west", [-180.0, 0.0])
def test_a_map_of_the_whole_earth_has_each_longitude_within(west):
    model = MapGrid("EPSG:4326", (west, 0.1, 0.0, 90.0, 0.0, -0.1), (3600, 1800))
    for longitude in (-170.0, -10.0, 10.0, 170.0, 190.0):
        column = (longitude - west) % 360 * 10
        np.testing.assert_allclose(model.ground_to_image([[longitude, 9.0, 0.0]]), [[column, 810.0]], atol=1e-6)


@pytest.mark.parametrize(
    "transform",
    [
        (0.0, 1.0, 2.0, 0.0, 2.0, 4.0), (1e300, 1e-9, 0.0, 0.0, 0.0, -1e-9), (-1e300, 1e-9, 0.0, 0.0, 0.0, -1e-9),
        (0.0, 1.0, 0.0, 4e6, 0.0, -1e-10), (5e5, 1e-10, 0.0, 4e6, 0.0, -1.0),
    ],
)  # fmt: skip
def test_a_geotransform_that_cannot_be_inverted_is_refused(transform):
    with pytest.raises(InputError, match="cannot be inverted"):
        MapGrid("EPSG:32636", transform, (60, 40))


@pytest.mark.parametrize("crs", ["EPSG:4978", "EPSG:5773"])
def test_a_map_has_a_horizontal_crs(crs):
    with pytest.raises(CrsError, match="no horizontal coordinates"):
        MapGrid(crs, GRIDS["metres"][1], (60, 40))


@pytest.mark.parametrize(
    "transform", [(5e5, 1.0, 0.0, 4e6, 0.0), (5e5, 1.0, 0.0, 4e6, 0.0, -1.0, 0.0), (5e5, 1.0, 0.0, np.nan, 0.0, -1.0)]
)
def test_a_geotransform_has_six_finite_numbers(transform):
    with pytest.raises(InputError, match="six finite numbers"):
        MapGrid("EPSG:32636", transform, (60, 40))


@pytest.mark.parametrize("name", GRIDS)
def test_an_ortho_of_any_grid_opens(tmp_path, name):
    path = raster(tmp_path / "a.tif", *GRIDS[name])
    scene = open_ortho(path, SceneOptions())
    assert scene.sensor == "ortho"
    assert (scene.width, scene.height) == (60, 40)
    x, y = gdal.ApplyGeoTransform(GRIDS[name][1], 5.0, 6.0)
    np.testing.assert_allclose(scene.model.ground_to_image([[x, y, 0.0]]), [[5.0, 6.0]], atol=1e-6)
    assert pyproj.CRS(scene.model.crs).is_geographic == (name == "degrees")


def test_without_the_option_an_ortho_is_no_scene_and_the_error_names_it(tmp_path):
    path = raster(tmp_path / "a.tif", *GRIDS["metres"])
    with pytest.raises(InputError, match=r"no sensor recognises this image(.|\n)*scene.ortho"):
        open_scene(path)
    assert open_scene(path, SceneOptions(ortho=True)).sensor == "ortho"
    failed = CliRunner().invoke(cli, ["fit", str(path), "--gcps", str(SAMPLE / "gcps.geojson")])
    assert failed.exit_code == 2
    assert "--ortho" in failed.output


def test_with_the_option_a_raw_scene_stays_one():
    assert open_scene(SAMPLE / "scene.tif", SceneOptions(ortho=True)).sensor == open_scene(SAMPLE / "scene.tif").sensor
    with pytest.raises(InputError, match="not a finished ortho: the sensor"):
        open_ortho(SAMPLE / "scene.tif", SceneOptions())


def test_an_rpc_beside_it_rules_an_ortho_out(tmp_path):
    path = raster(tmp_path / "a.tif", *GRIDS["metres"])
    shutil.copy(SAMPLE / "scene_RPC.TXT", tmp_path / "a_RPC.TXT")
    with pytest.raises(InputError, match="not a finished ortho"):
        open_ortho(path, SceneOptions())


def test_a_level_1_product_is_no_ortho(tmp_path):
    path = raster(tmp_path / "a.tif", *GRIDS["metres"], IMD={"productLevel": '"LV1B"'})
    with pytest.raises(InputError, match="processing level"):
        open_ortho(path, SceneOptions())


@pytest.mark.parametrize(("crs", "transform"), [(None, GRIDS["metres"][1]), ("EPSG:32636", None)])
def test_a_raster_without_a_place_is_no_ortho(tmp_path, crs, transform):
    with pytest.raises(CrsError, match=r"no (CRS|georeference)"):
        open_ortho(raster(tmp_path / "a.tif", crs, transform), SceneOptions())


@pytest.mark.parametrize("given", [{"rpc": "tag"}, {"sensor": "rpc"}, {"model": "a_model.json"}])
def test_another_model_contradicts_the_option(tmp_path, given: dict[str, Any]):
    path = raster(tmp_path / "a.tif", *GRIDS["metres"])
    with pytest.raises(InputError, match="its map grid"):
        open_scene(path, SceneOptions(ortho=True, **given))


def test_other_commands_take_an_ortho_as_a_scene(tmp_path):
    ortho = tmp_path / "displaced.tif"
    left, dx, _, top, _, dy = gdal.Open(str(SAMPLE / "reference.tif")).GetGeoTransform()
    bounds = [left + 15.0, top - 10.0, left + 15.0 + 717 * dx, top - 10.0 + 643 * dy]
    gdal.Translate(str(ortho), str(SAMPLE / "reference.tif"), outputBounds=bounds)
    points = tmp_path / "points.csv"
    # Measured 15 m too far east and 10 m too far south.
    rows = [(100, 100), (600, 120), (120, 560), (580, 600), (350, 300)]
    lines = [f"p{k},{c},{r},{left + dx * c},{top + dy * r},0" for k, (c, r) in enumerate(rows)]
    points.write_text("id,col,row,x,y,h\n" + "\n".join(lines))
    words = ["fit", ortho, "--ortho", "--gcps", points, "--points-crs", "EPSG:32636"]
    words += ["--points-vertical", "ellipsoid", "--json"]
    done = CliRunner().invoke(cli, list(map(str, words)))
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["parameters"]
    np.testing.assert_allclose([found[name]["value"] for name in ("col_shift", "row_shift")], [3.0, 2.0], atol=1e-6)
    words = ["rectify", ortho, "--ortho", "--gcps", points, "--points-crs", "EPSG:32636", "--points-vertical"]
    words += ["ellipsoid", "--height", "0", "--like", SAMPLE / "reference.tif", "-r", "nearest", "-o", tmp_path / "out"]
    done = CliRunner().invoke(cli, list(map(str, words)))
    assert done.exit_code == 0, done.output
    made = gdal.Open(str(tmp_path / "out" / "displaced_ortho.tif")).ReadAsArray()
    expected = gdal.Open(str(SAMPLE / "reference.tif")).ReadAsArray()
    assert (made[..., 5:-5, 5:-5] == expected[..., 5:-5, 5:-5]).mean() > 0.99


def test_info_shows_an_ortho_as_a_scene_where_that_is_asked_for():
    document = json.loads(CliRunner().invoke(cli, ["info", str(SAMPLE / "reference.tif"), "--ortho", "--json"]).stdout)
    assert document["sensor"] == "ortho"
    assert document["models"] == {"map_grid": "map_grid"}
    np.testing.assert_allclose(document["gsd_m"], 5.0, rtol=1e-3)
    assert "ortho verify" in CliRunner().invoke(cli, ["info", str(SAMPLE / "reference.tif")]).output


def test_cells_without_values_are_known(tmp_path):
    """Of an ortho whose eastern half has no values, and of one without nodata."""
    path = raster(tmp_path / "half.tif", *GRIDS["metres"])
    assert (filled_of(open_ortho(path, SceneOptions()), SceneOptions(), 4) == 1).all()
    written = gdal.Open(str(path), gdal.GA_Update)
    written.GetRasterBand(1).SetNoDataValue(0)
    written.WriteArray(np.repeat(np.arange(60) < 30, 40).reshape(60, 40).T.astype(np.uint8))
    written.FlushCache()
    shares = filled_of(open_ortho(path, SceneOptions()), SceneOptions(), 4)
    np.testing.assert_allclose(shares, np.repeat([[1.0, 1.0, 0.0, 0.0]], 4, axis=0))


def test_cells_of_nan_have_no_value_without_nodata(tmp_path):
    """Of floating point; nor does an empty first band hide the values of the others."""
    pixels = np.full((2, 64, 64), np.nan, dtype=np.float32)
    pixels[1, :, :32] = 7
    written = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "nan.tif"), 64, 64, 2, gdal.GDT_Float32)
    written.SetProjection(pyproj.CRS("EPSG:32636").to_wkt())
    written.SetGeoTransform((5e5, 1.0, 0.0, 4e6, 0.0, -1.0))
    written.WriteArray(pixels)
    del written
    shares = filled_of(open_ortho(tmp_path / "nan.tif", SceneOptions()), SceneOptions(), 4)
    np.testing.assert_allclose(shares, np.repeat([[1.0, 1.0, 0.0, 0.0]], 4, axis=0))


def test_a_band_that_the_ortho_has_not_is_refused(tmp_path: Path) -> None:
    path = raster(tmp_path / "o.tif", *GRIDS["metres"])
    done = CliRunner().invoke(cli, ["verify", str(path), "--reference", str(path), "--compare-band", "2"])
    assert done.exit_code == 2
    assert "there is no band 2: the ortho has 1 band" in done.stderr


@pytest.mark.parametrize("band", [0, -1])
def test_a_band_below_1_is_refused(band: int, tmp_path: Path) -> None:
    path = raster(tmp_path / "o.tif", *GRIDS["metres"])
    with pytest.raises(InputError, match=f"there is no band {band}: the ortho has 1 band"):
        verify(path, match=MatchOptions(reference=[str(path)]), band=band)
