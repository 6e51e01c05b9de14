"""The Python interface as users have it: types, objects in place of paths, points that can be gone through."""

from __future__ import annotations

import ast
import inspect
import json
import math
import re
import subprocess
import sys
import tomllib
import typing
from importlib.resources import files
from pathlib import Path

import click
import numpy as np
import pyproj
import pytest
import shapely

import ortho_pipeline as op
from ortho_pipeline import commands, plugin
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.control.command import match
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import BlockOptions, MosaicOptions
from ortho_pipeline.options.option import options_of

ROOT = Path(__file__).resolve().parent.parent

# -- types


def test_the_package_is_typed() -> None:
    assert files("ortho_pipeline").joinpath("py.typed").is_file()


@pytest.mark.parametrize("door", [op, commands, plugin], ids=lambda door: door.__name__)
def test_lazy_names_are_those_that_checkers_know(door) -> None:
    package = ast.parse(Path(door.__file__).read_text())
    (known,) = (node for node in package.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    homes = {
        alias.name: node.module.removeprefix("ortho_pipeline.")
        for node in known.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    assert homes == door._HOMES
    assert set(door.__all__) == set(homes)
    for name in door.__all__:
        assert getattr(door, name) is not None


def test_all_modules_of_public_names_are_typed_strictly() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mypy"]["overrides"]
    (strict,) = (set(one["module"]) for one in settings if one.get("disallow_untyped_defs"))
    homes = {f"ortho_pipeline.{home}" for door in (op, plugin) for home in door._HOMES.values()}
    homes |= {getattr(getattr(op, name), "__module__", "") for name in op.__all__}
    homes |= {getattr(getattr(plugin, name), "__module__", "") for name in plugin.__all__}
    homes = {name for name in homes if name.startswith("ortho_pipeline")} - {"ortho_pipeline.commands.arrays.lazy"}
    assert homes | {"ortho_pipeline", "ortho_pipeline.plugin", "ortho_pipeline.testing"} == strict


def test_what_declares_a_command_loads_no_more_than_the_hooks() -> None:
    code = (
        "import sys; from ortho_pipeline.plugin import Subcommand, hookimpl; "
        "print(*sorted(name for name in sys.modules if name.startswith(('ortho_pipeline.', 'numpy', 'osgeo'))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    light = ["hookspecs", "plugin", "runtime", "runtime.lazy_names"]
    assert done.stdout.split() == [f"ortho_pipeline.{name}" for name in light]


USER_SCRIPT = """
import ortho_pipeline as op

scene = op.open_scene("scene.tif")
points = op.read_points("gcps.geojson")
reveal_type(scene)
reveal_type(scene.model.ground_to_image([[1.0, 2.0, 3.0]]))
reveal_type(points)
reveal_type([point.id for point in points])
start = op.ImageCorrection.identity(scene.model, "shift", origin=(0.0, 0.0))
reveal_type(op.fit(start, points))
reveal_type(op.rectify(scene, "out", points=points))
reveal_type(op.compare)
reveal_type(op.__version__)
op.rectify("scene.tif", "out", pionts=points)
"""


def test_public_functions_say_what_they_return() -> None:
    returned = {
        name: str(typing.get_type_hints(getattr(op, name))["return"])
        for name in ("open_scene", "read_points", "fit", "rectify")
    }
    assert {name: text.rpartition(".")[2].strip("'>") for name, text in returned.items()} == {
        "open_scene": "Scene", "read_points": "Points", "fit": "Fit", "rectify": "Result",
    }  # fmt: skip


@pytest.mark.slow
def test_mypy_knows_what_the_public_names_are(tmp_path: Path) -> None:
    script = tmp_path / "user.py"
    script.write_text(USER_SCRIPT)
    # What was checked before is kept where mypy keeps it, so that only what has changed is checked again.
    kept = ROOT / ".mypy_cache" / "of_users"
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file=", "--ignore-missing-imports", f"--cache-dir={kept}", script],
        capture_output=True, text=True, check=False, cwd=ROOT,
    )  # fmt: skip
    revealed = re.findall(r'Revealed type is "(.*)"', done.stdout)
    assert len(revealed) == 8, done.stdout + done.stderr
    assert not [text for text in revealed if text == "Any"]
    assert revealed[0].endswith(".Scene")
    assert "ndarray" in revealed[1]
    assert revealed[2].endswith(".Points")
    assert "list[" in revealed[3]
    assert "str" in revealed[3]
    assert revealed[4].endswith(".Fit")
    assert revealed[5].endswith(".Result")
    assert revealed[6].startswith("def (")
    assert revealed[7].endswith("str")
    assert 'Unexpected keyword argument "pionts"' in done.stdout


# -- objects in place of paths


def test_rectify_takes_a_scene_and_points(tiny, tmp_path: Path) -> None:
    surface, output = op.SurfaceOptions(dem=tiny.dem, vertical="ellipsoid"), op.OutputOptions(resolution=20.0)
    options = op.PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid")
    by_path = op.rectify(tiny.image, tmp_path / "a", points=options, surface=surface, output=output)
    points = op.read_points(tiny.gcps, crs="EPSG:4979", vertical="ellipsoid")
    scene = op.open_scene(tiny.image)
    by_object = op.rectify(scene, tmp_path / "b", points=points, surface=surface, output=output)
    assert by_object.files["ortho"].read_bytes() == by_path.files["ortho"].read_bytes()
    assert sorted(by_object.files) == sorted(by_path.files)
    one, other = (result.document["report"] for result in (by_path, by_object))
    assert one["adjustment"] == other["adjustment"]
    record = json.loads(by_object.files["report"].read_text())["provenance"]
    assert record["points"]["gcps"] == str(points)
    # With options around them: half of the points only check.
    options = op.PointOptions(gcps=points, check="every:2", correction="shift")
    found = commands.fit(scene, options).fit
    assert (found.points.check.sum(), found.points.control.sum()) == (6, 6)


def test_what_objects_say_themselves_is_not_said_again(tiny) -> None:
    scene = op.open_scene(tiny.image)
    points = op.read_points(tiny.gcps, crs="EPSG:4979", vertical="ellipsoid")
    for more in ({"crs": "EPSG:4326"}, {"vertical": "egm96"}, {"pixel_origin": "center"}):
        with pytest.raises(InputError, match="already state"):
            commands.fit(scene, op.PointOptions(gcps=points, **more))
    with pytest.raises(InputError, match="already open"):
        commands.fit(scene, op.PointOptions(gcps=points), op.SceneOptions(rpc="tag"))


def test_own_points_take_the_options_of_points(tiny, tmp_path: Path) -> None:
    from osgeo import gdal

    rows = tiny.points(6)
    dataset = gdal.Open(str(tiny.image), gdal.GA_Update)
    dataset.SetGCPs([gdal.GCP(lon, lat, h, col, row) for _, col, row, lon, lat, h in rows], "")
    dataset = None
    given = op.PointOptions(gcps="own", crs="EPSG:4326", vertical="ellipsoid")
    assert len(commands.fit(tiny.image, given).fit.points) == 6
    with pytest.raises(InputError, match=r"points\.crs"):
        commands.fit(tiny.image, op.PointOptions(gcps="own"))


# -- points


def test_points_can_be_gone_through(sample: Path) -> None:
    points = op.read_points(sample / "gcps.geojson")
    found = list(points)
    assert len(found) == len(points) == 18
    for k, point in enumerate(found):
        assert point.id == points.ids[k]
        assert point.image == tuple(points.image[k])
        assert point.ground == tuple(points.ground[k])
        assert point.role == points.roles[k]
        assert point.sigma_image == points.sigma_image[k]
        assert point.sigma_ground == tuple(points.sigma_ground[k])
        assert np.array_equal(point.covariance_image, points.covariance_image[k])
        assert point.group == -1


def test_points_are_geojson(sample: Path, tmp_path: Path) -> None:
    points = op.read_points(sample / "gcps.geojson")
    utm = points.to_crs("EPSG:32636")
    document = utm.__geo_interface__
    assert document["type"] == "FeatureCollection"
    for k, feature in enumerate(document["features"]):
        shape = shapely.geometry.shape(feature["geometry"])  # longitude, latitude and height, wherever the table is
        assert [shape.x, shape.y, shape.z] == pytest.approx(points.ground[k].tolist(), abs=1e-8)
        assert feature["properties"]["id"] == points.ids[k]
    # It is what a file has, and reads back as it was.
    path = tmp_path / "again.geojson"
    path.write_text(json.dumps(document, allow_nan=False))
    again = op.read_points(path)
    np.testing.assert_allclose(again.image, points.image, atol=1e-9)
    assert again.ids == points.ids
    assert again.roles.tolist() == points.roles.tolist()
    ground = points.ground.copy()
    ground[0, 2], ground[1] = np.nan, np.nan
    one, two = points.with_ground(ground).__geo_interface__["features"][:2]
    assert len(one["geometry"]["coordinates"]) == 2
    assert two["geometry"] is None


# -- names of options


def test_the_table_of_options_is_that_of_the_command_line() -> None:
    page = (ROOT / "docs" / "api.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+\.\w+)` \| `(--[\w-]+)` \|", page, re.MULTILINE))
    command = cli.get_command(click.Context(cli), "rectify")
    groups = {"scene": "SceneOptions", "points": "PointOptions", "surface": "SurfaceOptions", "output": "OutputOptions"}
    other = {}
    for parameter in command.params:
        group, _, field = str(parameter.name).partition("_")
        if group in groups and field and isinstance(parameter, click.Option):
            flag = max((one for one in parameter.opts if one.startswith("--")), key=len)
            if flag.removeprefix("--").replace("-", "_") not in (field, field.removesuffix("s")):
                other[f"{groups[group]}.{field}"] = flag
    assert rows == other


# -- scenes that are adjusted, and what help() shows


def test_a_scene_is_fitted_as_the_command_does() -> None:
    scene, points = op.open_scene("sample_data/scene.tif"), op.read_points("sample_data/gcps.geojson")
    found = scene.fit(points, "shift")
    expected = commands.fit("sample_data/scene.tif", op.PointOptions(gcps="sample_data/gcps.geojson")).fit
    np.testing.assert_array_equal(found.values, expected.values)
    assert found.model_name == "rpc+shift"
    assert scene.fit(points, "none").param_names == ()
    with pytest.raises(InputError, match="unknown correction 'shfit'"):
        scene.fit(points, "shfit")
    with pytest.raises(InputError, match="no parameters of its own"):
        scene.fit(points, "model")


def test_a_fit_that_adjusts_nothing_says_so() -> None:
    scene, points = op.open_scene("sample_data/scene.tif"), op.read_points("sample_data/gcps.geojson")
    with pytest.raises(InputError, match="Scene is not a sensor model") as error:
        op.fit(scene, points)
    assert 'scene.fit(points, "shift")' in str(error.value)
    assert [notice.code for notice in op.fit(scene.model, points).warnings if notice.code == "nothing-adjusted"]
    assert not [notice for notice in scene.fit(points, "none").warnings if notice.code == "nothing-adjusted"]


def test_a_scene_shows_itself() -> None:
    scene = op.open_scene("sample_data/scene.tif")
    assert repr(scene) == "<scene scene.tif: 1000 x 1000, sensor rpc, models rpc>"
    html = op.html(scene)
    for text in ("scene.tif", "1000 x 1000 pixels", "scene_RPC.TXT"):
        assert text in html


@pytest.mark.parametrize("name", op.__all__)
def test_signatures_are_read_by_people(name: str) -> None:
    public = getattr(op, name)
    if name == "Surface" or (isinstance(public, type) and issubclass(public, Exception)):
        return
    signature = str(inspect.signature(public))
    for word in ("Annotated", "Option(", "typing.", "Options(sensor", "~"):
        assert word not in signature, signature
    for options in re.findall(r"(\w+Options)\(([^)]*)\)", signature):
        assert options[1] == ""


def test_options_are_shown_as_they_are_written() -> None:
    assert repr(op.SceneOptions()) == "SceneOptions()"
    assert repr(op.SceneOptions(rpc="tag", crop_offset=(1, 2))) == "SceneOptions(rpc='tag', crop_offset=(1, 2))"


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        (op.OutputOptions, "resolution", "10"),
        (op.OutputOptions, "resolution", (10.0,)),
        (op.OutputOptions, "extent", "1 2 3 4"),
        (op.OutputOptions, "bands", ["1"]),
        (op.OutputOptions, "bands", []),
        (op.OutputOptions, "memory", "1GB"),
        (op.SurfaceOptions, "dem", ["dem.tif"]),
        (op.SurfaceOptions, "override_vertical", "egm96"),
        (op.MatchOptions, "reference", "reference.tif"),
        (op.MatchOptions, "reference", (name for name in ("a.tif", "b.tif"))),
        (op.PointOptions, "gcps", ["gcps.csv"]),
        (op.SceneOptions, "sensor_options", "a=b"),
        (op.SceneOptions, "sensor_options", {1: "b"}),
        (op.OutputOptions, "creation_options", {"COMPRESS": None}),
        (op.SceneOptions, "roots", [None]),
        (op.SceneOptions, "roots", [b"folder"]),
        (op.SceneOptions, "rpc", "a\0b"),
        (op.MatchOptions, "reference", ["a.tif", math.nan]),
        (op.OutputOptions, "bands", b"\1"),
        (op.OutputOptions, "nodata", "none"),
        (op.OutputOptions, "nodata", True),
        (op.OutputOptions, "resolution", 10**400),
        (op.OutputOptions, "resolution", True),
        (op.SurfaceOptions, "fill", False),
        (op.SurfaceOptions, "height", True),
    ],
)
def test_a_value_of_a_wrong_type_is_refused_with_the_name_of_its_option(group, name, value) -> None:
    with pytest.raises(InputError, match=" is not ") as caught:
        group(**{name: value})
    assert str(caught.value.field).endswith(f".{name}")
    assert caught.value.remedy


def test_values_of_numpy_and_pyproj_are_options() -> None:
    output = op.OutputOptions(resolution=np.float32(20), crs=pyproj.CRS(32636), bands=np.array([1]), nodata=np.uint8(0))
    assert output == op.OutputOptions(resolution=20.0, crs="EPSG:32636", bands=[1], nodata=0)
    assert op.OutputOptions(creation_options={"BLOCKSIZE": np.int64(256)}).creation_options == {"BLOCKSIZE": "256"}
    assert op.OutputOptions(bands=[np.int64(1)], extent=tuple(np.arange(4, dtype=np.float32))).bands == [1]
    assert op.OutputOptions(nodata="-1.7976931348623157e308").nodata
    assert op.OutputOptions(nodata="NaN").nodata
    surface = op.SurfaceOptions(height=np.float32(800))
    json.dumps([output.resolution, output.crs, output.bands, output.nodata, surface.height])


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("points", "gcps.csv", "op.PointOptions(gcps='gcps.csv')"),
        ("surface", Path("dem.tif"), "op.SurfaceOptions(dem='dem.tif')"),
        ("match", "reference.tif", "op.MatchOptions(reference=['reference.tif'])"),
        ("output", {"resolution": 10.0}, "op.OutputOptions(**{'resolution': 10.0})"),
    ],
)
def test_a_path_in_place_of_options_is_refused_with_the_options(name, value, remedy, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        op.rectify("scene.tif", tmp_path, **{name: value})
    assert (caught.value.field, caught.value.remedy) == (name, f"give {remedy}")
    assert isinstance(eval(remedy), getattr(op, remedy[3:].partition("(")[0]))


@pytest.mark.parametrize("group", ["scene", "points", "surface", "match", "output"])
@pytest.mark.parametrize("value", [None, 5, op.StackOptions()])
def test_anything_else_in_place_of_options_is_refused_by_name(group, value, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is not .*Options") as caught:
        op.rectify("scene.tif", tmp_path, **{group: value})
    assert caught.value.field == group
    assert eval(str(caught.value.remedy).removeprefix("give ")) is not None


def test_an_error_names_the_file_of_any_kind_of_path(tmp_path: Path) -> None:
    class Named:
        def __fspath__(self) -> str:
            return "nowhere.csv"

    with pytest.raises(InputError) as caught:
        op.read_points(Named())
    assert caught.value.file == "nowhere.csv"


def test_gdal_exceptions_that_the_caller_turned_off_change_no_error(sample: Path) -> None:
    from osgeo import gdal

    op.open_scene(sample / "scene.tif")
    gdal.DontUseExceptions()
    try:
        with pytest.raises(InputError, match="cannot open this as a raster"):
            op.open_scene(sample / "gcps.csv")
    finally:
        gdal.UseExceptions()


def test_a_correction_needs_a_value_for_each_parameter(sample: Path) -> None:
    start = op.ImageCorrection.identity(op.open_scene(sample / "scene.tif").model, "shift", (500.0, 500.0))
    assert start.with_params([1.0, 2.0]).params.tolist() == [1.0, 2.0]
    for wrong in ([1.0], 1.0, [1.0, 2.0, 3.0]):
        with pytest.raises(InputError, match="col_shift, row_shift"):
            start.with_params(wrong)


def test_the_output_of_some_commands_is_a_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no heights given"):
        match(tmp_path / "scene.tif", tmp_path / "m.geojson", op.MatchOptions(reference=("reference.tif",)))


def test_what_a_masked_array_hides_is_nan(sample: Path) -> None:
    model = op.open_scene(sample / "scene.tif").model
    ground = np.ma.masked_array([[33.35, 37.25, 900.0], [33.35, 37.25, 900.0]], mask=[[0, 0, 1], [0, 0, 0]])
    image = model.ground_to_image(ground)
    assert np.isnan(image[0]).all()
    np.testing.assert_array_equal(image[1:], model.ground_to_image([[33.35, 37.25, 900.0]]))
    heights = np.ma.masked_array([900, 900], mask=[True, False], dtype=np.int16)
    np.testing.assert_array_equal(
        np.isnan(model.image_to_ground([[500, 500], [500, 500]], heights)[:, 2]), [True, False]
    )
    dem = op.open_dem(sample / "dem.tif")
    place = np.ma.masked_array(ground.data[:, :2], mask=[[1, 0], [0, 0]])
    assert np.isnan(dem.heights(place, "EPSG:4326")).tolist() == [True, False]
    seen = np.ma.masked_array([[500.0, 500.0], [500.0, 500.0]], mask=[[0, 1], [0, 0]])
    assert np.isnan(op.meet_surface(model, seen, dem)[:, 2]).tolist() == [True, False]
    points = op.Points.of(np.ma.masked_less([[500, 500], [-9, -9]], 0), ground, "EPSG:4979")
    assert np.isnan(points.with_ground(ground).ground[0, 2])
    assert np.isnan(points.image[1]).all()
    assert np.isnan(points.ground[0, 2])


@pytest.mark.parametrize("height", [[1.0, 2.0, 3.0], [[1.0], [2.0]], ["high", "low"]])
def test_heights_of_another_number_are_refused_by_name(height, sample: Path) -> None:
    model = op.open_scene(sample / "scene.tif").model
    with pytest.raises(InputError, match="height"):
        model.image_to_ground([[500.0, 500.0], [501.0, 500.0]], height)
    with pytest.raises(InputError, match="ground is no array of numbers"):
        model.ground_to_image([[33.0, 37.0, 800.0], [33.0, 37.0]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": "gcps.csv"}, r"a str is not a Points(.|\n)*op\.read_points"),
        ({"exclude": {"G99": "wrong"}}, "cannot exclude 'G99': no control point has this id"),
        ({"exclude": {"C01": "a check point"}}, "cannot exclude 'C01'"),
        ({"exclude": ["G01"]}, "exclude must map ids to reasons"),
        ({"priors": {"col_shift": (0.0, 1.0)}}, r"the prior of 'col_shift' is a tuple(.|\n)*op\.Prior"),
    ],
)
def test_a_fit_refuses_what_it_would_ignore_or_cannot_use(arguments, message, sample: Path) -> None:
    start = op.ImageCorrection.identity(op.open_scene(sample / "scene.tif").model, "shift", (500.0, 500.0))
    points = op.read_points(sample / "gcps.geojson")
    with pytest.raises(InputError, match=message):
        op.fit(start, **{"points": points, **arguments})


def test_points_are_no_path_of_a_file(sample: Path) -> None:
    scene, path = op.open_scene(sample / "scene.tif"), str(sample / "gcps.geojson")
    for takes_points in (scene.fit, lambda points: op.compare(points, ["dlt"]), lambda points: op.adjust({}, points)):
        with pytest.raises(InputError, match="a str is not a"):
            takes_points(path)


def test_a_block_refuses_names_that_it_has_not(sample: Path) -> None:
    points = op.read_block_points(sample / "cartosat" / "points.csv")
    scenes = {name: op.open_scene(sample / "cartosat" / name) for name in points.images}
    shifts = {name: op.ImageCorrection.identity(scene.model, "shift", (0, 0)) for name, scene in scenes.items()}
    first = points.images[0]
    for accuracies, message in (({"other": 3.0}, "no points of the image 'other'"), ({first: math.nan}, "is nan, not")):
        with pytest.raises(InputError, match=message):
            op.adjust(shifts, points, accuracies=accuracies)
    with pytest.raises(InputError, match="a Scene is not a sensor model"):
        op.adjust(scenes, points)
    block = op.adjust(shifts, points, robust=False)
    with pytest.raises(InputError, match="no role 'Check'"):
        block.object_rms("Check")
    with pytest.raises(InputError, match="no role 'Check'"):
        block.image_rms(first, "Check")
    with pytest.raises(InputError, match="no image 'other'"):
        block.image_rms("other", "check")


@pytest.mark.parametrize(
    ("group", "values"),
    [
        (op.OutputOptions, {"memory": 512}),
        (op.OutputOptions, {"memory": -1}),
        (op.OutputOptions, {"threads": 0}),
        (op.OutputOptions, {"threads": np.int64(-1)}),
        (op.OutputOptions, {"tolerance": 0.0}),
        (op.OutputOptions, {"tolerance": math.nan}),
    ],
)
def test_a_number_beyond_the_bounds_of_its_option_is_refused(group, values) -> None:
    (name,) = values
    with pytest.raises(InputError, match=r"is not a .*number.* above ") as caught:
        group(**values)
    assert caught.value.field == f"output.{name}"
    assert "MB" not in str(caught.value)


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        (op.OutputOptions, "visibility", "nodta"),
        (op.OutputOptions, "dtype", "uint12"),
        (op.MatchOptions, "gcps_as", "controls"),
        (op.PointOptions, "correction", "shfit"),
        (MosaicOptions, "order", "first"),
        (MosaicOptions, "format", "TIF"),
        (BlockOptions, "dem_heights", "no"),
    ],
)
def test_a_value_that_is_no_choice_of_its_option_is_refused_with_the_choices(group, name, value) -> None:
    with pytest.raises(InputError, match=f"'{value}' is not ") as caught:
        group(**{name: value})
    assert str(caught.value.field).endswith(f".{name}")
    for choice in options_of(group)[name].choices:
        assert choice in str(caught.value.remedy)
        assert getattr(group(**{name: choice}), name) == choice


@pytest.mark.parametrize("kind", [str, Path])
@pytest.mark.parametrize("opened", [op.open_dem, op.open_scene, op.RasterSource], ids=lambda opened: opened.__name__)
def test_one_folder_in_place_of_a_list_of_roots_allows_no_others(opened, kind, sample: Path, tmp_path: Path) -> None:
    from osgeo import gdal

    gdal.UseExceptions()
    image = tmp_path / "inner" / "image.vrt"
    image.parent.mkdir()
    gdal.BuildVRT(str(image), [str(sample / "dem.tif")]).FlushCache()
    with pytest.raises(InputError, match="one path in place of a list") as caught:
        opened(image, roots=kind(tmp_path / "other"))
    assert (caught.value.field, caught.value.remedy) == ("roots", f"give ['{tmp_path / 'other'}']")


def test_ground_of_points_is_not_the_array_of_the_caller(sample: Path) -> None:
    points = op.read_points(sample / "gcps.geojson")
    ground = points.ground.copy()
    changed = points.with_ground(ground)
    ground[:] = 0.0
    np.testing.assert_array_equal(changed.ground, points.ground)


@pytest.mark.parametrize("kind", [str, Path])
def test_one_path_in_place_of_a_list_of_files_is_refused_with_the_list(kind, tmp_path: Path) -> None:
    reference = op.MatchOptions(reference=["reference.tif"])
    calls = {
        "orthos": (lambda path: op.mosaic(path, tmp_path / "m.tif"), lambda path: op.stack(path, tmp_path / "s")),
        "masks": (
            lambda path: op.verify("ortho.tif", match=reference, masks=path),
            lambda path: op.align("ortho.tif", tmp_path / "a", match=reference, masks=path),
        ),
    }
    for field, functions in calls.items():
        for function in functions:
            with pytest.raises(InputError, match="one path in place of a list") as caught:
                function(kind("a.tif"))
            assert (caught.value.field, caught.value.remedy) == (field, "give ['a.tif']")
