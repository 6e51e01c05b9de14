"""STAC items: valid by the published schemas, true to the ortho, cut at the antimeridian, honest about accuracy."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pystac
import pytest
import shapely
from click.testing import CliRunner
from osgeo import gdal
from pystac.validation import JsonSchemaSTACValidator

from ortho_pipeline import commands
from ortho_pipeline.batch import runner as batch
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import OutputOptions, PointOptions, SurfaceOptions
from ortho_pipeline.raster.valid_area import to_geojson, valid_outline
from ortho_pipeline.report.stac import acquisition_time

TIME = "2005-08-03T08:12:31.25Z"
BASE = "https://stac-extensions.github.io"
SCHEMAS = Path(__file__).resolve().parent.parent / "data" / "stac"
#: The extensions as they are published, by their URIs (tests/data/stac/README.md).
EXTENSIONS = {
    f"{BASE}/{path.relative_to(SCHEMAS).as_posix()}": json.loads(path.read_text())
    for path in sorted(SCHEMAS.glob("*/*/schema.json"))
}


class Offline(JsonSchemaSTACValidator):
    """Validates with pystac's copies of the core schemas and the published ones of extensions; fetches nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.schema_cache.update(EXTENSIONS)

    def _get_schema(self, schema_uri: str) -> dict[str, Any]:
        assert schema_uri.rstrip("#") in self.schema_cache, f"{schema_uri} would be fetched"
        return super()._get_schema(schema_uri.rstrip("#"))


def validate(path: Path) -> dict[str, Any]:
    """Return a STAC document, validated against every schema that it declares."""
    document = json.loads(path.read_text())
    pystac.validation.validate_dict(document, validator=Offline())
    return document


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Rectify the sample scene with a STAC item."""
    sample = Path(__file__).resolve().parent.parent.parent / "sample_data"
    folder = tmp_path_factory.mktemp("stac")
    result = commands.rectify(
        sample / "scene.tif", folder, points=PointOptions(gcps=sample / "gcps.geojson"),
        surface=SurfaceOptions(dem=sample / "dem.tif"), output=OutputOptions(stac=True, acquired=TIME, resolution=5),
    )  # fmt: skip
    return folder, result.document["report"]


def test_item_is_valid_and_true_to_the_ortho(made):
    folder, _ = made
    item = validate(folder / "scene_stac.json")
    properties = item["properties"]
    assert (item["id"], properties["datetime"]) == ("scene", "2005-08-03T08:12:31.250000Z")
    ortho = gdal.Open(str(folder / "scene_ortho.tif"))
    left, dx, _, top, _, dy = ortho.GetGeoTransform()
    assert properties["proj:transform"] == [dx, 0.0, left, 0.0, dy, top]
    assert properties["proj:shape"] == [ortho.RasterYSize, ortho.RasterXSize]
    assert properties["proj:code"] == "EPSG:32636"
    asset = item["assets"]["ortho"]
    assert asset["href"] == "./scene_ortho.tif"
    assert asset["type"] == pystac.MediaType.COG
    content = (folder / "scene_ortho.tif").read_bytes()
    assert asset["file:size"] == len(content)
    # A multihash: 0x12 is SHA-256, 0x20 its 32 bytes.
    assert asset["file:checksum"] == "1220" + hashlib.sha256(content).hexdigest()
    assert asset["raster:bands"] == [{"data_type": "uint16", "sampling": "area", "spatial_resolution": 5.0}]
    assert {"report", "html", "model", "thumbnail", "overview"} < set(item["assets"])
    for one in item["assets"].values():
        assert (folder / one["href"]).is_file()
    assert properties["gsd"] == pytest.approx(2.6, abs=0.2)
    again = pystac.Item.from_file(folder / "scene_stac.json")
    assert shapely.geometry.shape(again.geometry).is_valid


def test_outline_holds_the_valid_pixels(made):
    folder, _ = made
    item = json.loads((folder / "scene_stac.json").read_text())
    ortho = gdal.Open(str(folder / "scene_ortho.tif"))
    mask = ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    transform = ortho.GetGeoTransform()
    rows, columns = np.mgrid[0 : mask.shape[0] : 4, 0 : mask.shape[1] : 4]
    x, y = transform[0] + (columns + 0.5) * transform[1], transform[3] + (rows + 0.5) * transform[5]
    outline = shapely.geometry.shape(item["properties"]["proj:geometry"])
    # The outline is true to a pixel or two, so only these may differ.
    inner, outer = outline.buffer(-15), outline.buffer(15)
    assert shapely.contains_xy(outer, x, y)[mask[::4, ::4]].all()
    assert mask[::4, ::4][shapely.contains_xy(inner, x, y)].all()
    to_degrees = pyproj.Transformer.from_crs("EPSG:32636", "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(x, y)
    degrees = shapely.geometry.shape(item["geometry"])
    assert shapely.contains_xy(degrees.buffer(1.5e-4), lon, lat)[mask[::4, ::4]].all()
    west, south, east, north = item["bbox"]
    assert degrees.bounds == pytest.approx((west, south, east, north), abs=1e-6)
    assert degrees.exterior.is_ccw


def test_view_is_that_of_the_camera(made):
    folder, _ = made
    properties = json.loads((folder / "scene_stac.json").read_text())["properties"]
    truth = json.loads((Path(__file__).resolve().parent.parent.parent / "sample_data" / "truth.json").read_text())
    camera = truth["camera"]
    position = np.array(camera["radial"]) * camera["radius"]
    west, south, east, north = json.loads((folder / "scene_stac.json").read_text())["bbox"]
    lon, lat = (west + east) / 2, (south + north) / 2
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    ground = np.array(to_ecef.transform(lon, lat, 850.0))
    angles = np.radians([lon, lat])
    up = np.array([np.cos(angles[1]) * np.cos(angles[0]), np.cos(angles[1]) * np.sin(angles[0]), np.sin(angles[1])])
    ray = (position - ground) / np.linalg.norm(position - ground)
    assert properties["view:incidence_angle"] == pytest.approx(np.degrees(np.arccos(ray @ up)), abs=0.1)
    below = to_ecef.transform(*position, direction="INVERSE")
    _, back, _ = pyproj.Geod(ellps="WGS84").inv(below[0], below[1], lon, lat)
    assert properties["view:azimuth"] == pytest.approx((back + 180) % 360, abs=0.3)  # as seen from the scene


def test_accuracy_is_that_of_check_points_only(made, tiny, tmp_path):
    folder, report = made
    properties = json.loads((folder / "scene_stac.json").read_text())["properties"]
    assert properties["accuracy:geometric_rmse"] == pytest.approx(report["rmse_m"]["check"]["total"], abs=1e-4)
    assert (properties["ortho:accuracy_from"], properties["ortho:accuracy_points"]) == ("check points", 6)
    shifts = np.array([p["residual_m"] for p in report["adjustment"]["points"] if p["role"] == "check"])
    assert properties["accuracy:geometric_x_bias"] == pytest.approx(shifts[:, 0].mean(), abs=1e-4)
    assert properties["accuracy:geometric_y_stddev"] == pytest.approx(shifts[:, 1].std(ddof=1), abs=1e-4)
    surface, output = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid"), OutputOptions(stac=True, acquired=TIME)
    given = PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid")
    commands.rectify(tiny.image, tmp_path / "a", points=given, surface=surface, output=output)
    with_control = json.loads((tmp_path / "a" / "tiny_stac.json").read_text())["properties"]
    assert with_control["ortho:accuracy_from"] == "leave-one-out residuals"
    commands.rectify(tiny.image, tmp_path / "b", surface=surface, output=output)
    without = json.loads((tmp_path / "b" / "tiny_stac.json").read_text())
    assert not [name for name in without["properties"] if name.startswith("accuracy")]
    assert not [uri for uri in without["stac_extensions"] if "accuracy" in uri]


@pytest.mark.parametrize(("crs", "step"), [("EPSG:3857", 10.0), ("EPSG:4326", 1e-4)])
def test_the_resolution_is_metres_on_the_ground(tiny, tmp_path, crs, step):
    output = OutputOptions(stac=True, acquired=TIME, crs=crs, resolution=step)
    commands.rectify(tiny.image, tmp_path, surface=SurfaceOptions(dem=tiny.dem, vertical="ellipsoid"), output=output)
    band = json.loads((tmp_path / "tiny_stac.json").read_text())["assets"]["ortho"]["raster:bands"][0]
    left, dx, _, top, _, dy = (ortho := gdal.Open(str(tmp_path / "tiny_ortho.tif"))).GetGeoTransform()
    x, y = left + ortho.RasterXSize / 2 * dx, top + ortho.RasterYSize / 2 * dy
    lon, lat = pyproj.Transformer.from_crs(crs, 4326, always_xy=True).transform([x, x + dx, x], [y, y, y + dy])
    sides = pyproj.Geod(ellps="WGS84").inv([lon[0]] * 2, [lat[0]] * 2, lon[1:], lat[1:])[2]
    assert band["spatial_resolution"] == pytest.approx(np.mean(sides), rel=5e-3)


def test_time_of_acquisition(tiny, tmp_path):
    assert acquisition_time({"acquired": "2010-01-02 03:04:05"}) == datetime(2010, 1, 2, 3, 4, 5, tzinfo=UTC)
    assert acquisition_time({"acquired": "x"}, "2010-01-02T03:04:05+02:00").hour == 1
    for facts, given in (({}, None), ({"acquired": "soon"}, None), ({}, "31.12.2005")):
        with pytest.raises(InputError) as caught:
            acquisition_time(facts, given)
        assert caught.value.remedy
        assert caught.value.field == "output.acquired"
    arguments = [
        "rectify",
        tiny.image,
        "--dem",
        tiny.dem,
        "--dem-vertical",
        "ellipsoid",
        "-o",
        tmp_path / "o",
        "--stac",
    ]
    done = CliRunner().invoke(cli, [str(word) for word in arguments])
    assert done.exit_code == 2
    assert not (tmp_path / "o").exists()  # said before the work, not after
    done = CliRunner().invoke(cli, [str(word) for word in (*arguments, "--acquired", TIME, "--json")])
    assert done.exit_code == 0
    assert json.loads(done.stdout)["files"]["stac"] == str(tmp_path / "o" / "tiny_stac.json")


@pytest.mark.parametrize(
    ("crs", "box", "parts", "expected"),
    [
        ("EPSG:32635", (500000, 4000000, 510000, 4010000), 1, (27.0, 36.14, 27.11, 36.24)),
        ("EPSG:4326", (179.5, -17, 180.5, -16), 2, (179.5, -17, -179.5, -16)),
        ("EPSG:4326", (-180.25, 10, -179.75, 11), 2, (179.75, 10, -179.75, 11)),
        ("EPSG:32701", (150000, 8000000, 250000, 8100000), 2, None),
        ("EPSG:3832", (2990000, 0, 3450000, 100000), 2, None),
    ],
)
def test_antimeridian(crs, box, parts, expected):
    outline = shapely.box(*box)
    geometry, bounds = to_geojson(outline, pyproj.CRS(crs))
    shape = shapely.geometry.shape(geometry)
    assert shape.is_valid
    assert len(shapely.get_parts(shape)) == parts
    coordinates = shapely.get_coordinates(shape)
    assert (np.abs(coordinates[:, 0]) <= 180).all()
    assert (bounds[0] > bounds[2]) == (parts == 2)
    if expected:
        assert bounds == pytest.approx(expected, abs=0.02)
    # The same places are inside, whatever the longitude is written as.
    inverse = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    random = np.random.default_rng(0)
    x, y = random.uniform(box[0], box[2], 300), random.uniform(box[1], box[3], 300)
    lon, lat = inverse.transform(x, y)
    lon = (np.asarray(lon) + 180) % 360 - 180
    near = shape.buffer(1e-6)
    assert shapely.contains_xy(near, lon, lat).all()
    outside_x = np.array([box[0] - 0.1 * (box[2] - box[0]), box[2] + 0.1 * (box[2] - box[0])])
    lon, lat = inverse.transform(outside_x, np.full(2, (box[1] + box[3]) / 2))
    assert not shapely.contains_xy(near, (np.asarray(lon) + 180) % 360 - 180, lat).any()


def test_a_pole():
    geometry, bounds = to_geojson(
        shapely.box(-200000, -200000, 200000, 200000), pyproj.CRS("EPSG:32661").from_epsg(3413)
    )
    shape = shapely.geometry.shape(geometry)
    assert shape.is_valid
    assert bounds[0::2] == [-180.0, 180.0]
    assert bounds[3] == 90.0
    for lon in (-179.9, -90.0, 0.0, 10.0, 179.9):
        assert shapely.contains_xy(shape, lon, 89.0)
        assert not shapely.contains_xy(shape, lon, 86.0)


def test_several_parts_and_no_valid_pixel(tmp_path):
    values = np.zeros((40, 60), dtype=np.uint8)
    values[5:20, 5:20] = values[25:35, 30:55] = 9
    for name, pixels in (("two", values), ("none", values * 0)):
        dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / f"{name}.tif"), 60, 40, 1, gdal.GDT_Byte)
        dataset.SetProjection(pyproj.CRS("EPSG:32635").to_wkt())
        dataset.SetGeoTransform((500000, 10, 0, 4000000, 0, -10))
        dataset.GetRasterBand(1).SetNoDataValue(0)
        dataset.WriteArray(pixels)
        dataset = None
    outline = valid_outline(tmp_path / "two.tif")
    assert sorted(part.bounds for part in shapely.get_parts(outline)) == [
        (500050, 3999800, 500200, 3999950), (500300, 3999650, 500550, 3999750)
    ]  # fmt: skip
    assert valid_outline(tmp_path / "none.tif").is_empty
    geometry, _ = to_geojson(outline, pyproj.CRS("EPSG:32635"))
    assert geometry["type"] == "MultiPolygon"


def test_a_run_ends_in_a_catalog(tiny, tmp_path):
    folder = tmp_path / "block"
    for name in ("a", "b"):
        (folder / name).mkdir(parents=True)
        (folder / name / "scene.tif").write_bytes(tiny.image.read_bytes())
    (folder / "dem.tif").write_bytes(tiny.dem.read_bytes())
    (folder / "p.yaml").write_text(
        "defaults:\n  surface: {dem: dem.tif, vertical: ellipsoid}\n"
        f"  output: {{resolution: 20, stac: true, acquired: '{TIME}'}}\n"
        "scenes:\n  - images: '*/scene.tif'\n    name: 'block {folder}'\n"
    )
    result = batch.run(folder / "p.yaml", executor="sequential")
    assert [scene.status for scene in result.scenes] == ["done", "done"]
    catalog = validate(folder / "out" / "catalog.json")
    assert [link["href"] for link in catalog["links"] if link["rel"] == "item"] == [
        "./block a/scene_stac.json", "./block b/scene_stac.json"
    ]  # fmt: skip
    opened = pystac.Catalog.from_file(folder / "out" / "catalog.json")
    assert [item.id for item in opened.get_items()] == ["block a", "block b"]
    validate(folder / "out" / "block a" / "scene_stac.json")
    assert dataclasses.asdict(result.scenes[0])["files"]["stac"].endswith("scene_stac.json")


@pytest.mark.parametrize(
    "spoil",
    [
        lambda item: item["properties"].update({"view:azimuth": 400}),
        lambda item: item["properties"].update({"accuracy:geometric_rmse": -1}),
        lambda item: item["properties"].update({"proj:shape": [1.5, 2]}),
        lambda item: item["assets"]["ortho"].update({"file:checksum": "SHA"}),
        lambda item: item["assets"]["ortho"]["raster:bands"][0].update({"sampling": "both"}),
    ],
)
def test_the_published_schemas_are_what_is_asked(made, spoil):
    item = validate(made[0] / "scene_stac.json")
    # What is declared is all that is used, and the other way round.
    used = {name.partition(":")[0] for part in (item["properties"], *item["assets"].values()) for name in part}
    names = {"proj": "projection"}
    declared = {uri.removeprefix(f"{BASE}/").partition("/")[0] for uri in item["stac_extensions"]}
    assert {names.get(name, name) for name in used} & {uri.split("/")[3] for uri in EXTENSIONS} == declared
    spoil(item)
    with pytest.raises(pystac.STACValidationError):
        pystac.validation.validate_dict(item, validator=Offline())


def test_pictures_of_the_item(made):
    folder, _ = made
    item = validate(folder / "scene_stac.json")
    ortho = gdal.Open(str(folder / "scene_ortho.tif"))
    size = np.array([ortho.RasterXSize, ortho.RasterYSize])
    mask = ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    for role, side in (("thumbnail", 256), ("overview", 1024)):
        asset = item["assets"][role]
        assert asset["type"] == "image/png"
        assert role in asset["roles"]
        picture = gdal.Open(str(folder / asset["href"]))
        assert picture.GetDriver().ShortName == "PNG"
        found = np.array([picture.RasterXSize, picture.RasterYSize])
        assert found.max() == min(side, size.max())
        assert found / found.max() == pytest.approx(size / size.max(), abs=1 / found.max())
        alpha = picture.GetRasterBand(picture.RasterCount).ReadAsArray() > 0
        assert alpha.mean() == pytest.approx(mask.mean(), abs=0.02)
        values = picture.GetRasterBand(1).ReadAsArray()[alpha]
        assert np.ptp(values) == 255  # stretched for the eye
