"""BILSAT-1 from end to end: product, sensor options, adjusting the model itself, the RPC in GDAL, the paper."""

from __future__ import annotations

import json
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ortho_bilsat.survey import read_survey
from ortho_studies.bilsat.experiment import ROWS, reproduce
from ortho_studies.bilsat.page import page
from ortho_studies.bilsat.simulation import write_product
from ortho_studies.bilsat.truth import FOCAL_LENGTH, PITCH, SIZE
from ortho_studies.simulation.page import text
from ortho_studies.simulation.tables import is_missed
from orthos import rectify
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import bands
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.exchange.rpc import export_rpc, rpc_metadata
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.ellipsoid import geocentric
from ortho_pipeline.host import open_scene
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import read_points
from ortho_pipeline.raster.source import Grid, RasterSource, open_dataset
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem


@pytest.fixture
def product(sample):
    """The small scene of the sample data."""
    return sample / "bilsat"


def run(*arguments: object) -> str:
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def failed(*arguments: object) -> dict[str, str]:
    done = CliRunner().invoke(cli, [*(str(argument) for argument in arguments), "--json"])
    assert done.exit_code == 2, done.output
    return json.loads(done.stdout)["error"]


# -- the sample ------------------------------------------------------------------------------------------------------


def test_sample_scene_opens_and_its_truth_is_found(product):
    scene = open_scene(product / "bilsat.tif")
    assert scene.sensor == "bilsat"
    assert scene.priors["X_L"].sigma == 300.0
    assert scene.priors["omega"].sigma == pytest.approx(np.radians(0.02))
    truth = json.loads((product / "truth.json").read_text())
    image, ground = (np.array([point[key] for point in truth["points"]]) for key in ("image", "lon_lat_h"))
    # As delivered, some pixels off; adjusted, where the truth is.
    assert 0.5 < np.abs(scene.model.ground_to_image(ground) - image).max() < 8
    points = read_points(product / "gcps.csv")
    assert len(points) == 44
    result = fit(scene.model, points, priors=scene.priors)
    assert not result.rejected
    assert 0.7 < result.sigma0 < 1.3
    assert np.sqrt((result.model.ground_to_image(ground) - image) ** 2).mean() < 0.3
    miss = geocentric(result.model.perspective_centre[None])[0] - truth["position_m"]
    assert np.linalg.norm(miss) < 4 * 300


def test_sample_is_made_again_the_same(product, tmp_path):
    files = write_product(tmp_path, seed=1, size=256, dem_step=250.0)
    assert set(files) == {"image", "survey", "dem", "gcps", "truth"}
    for name in ("image", "dem"):
        made, kept = (open_dataset(folder / files[name].name).ReadAsArray() for folder in (tmp_path, product))
        np.testing.assert_array_equal(made, kept)
    assert files["gcps"].read_text() == (product / "gcps.csv").read_text()
    assert read_survey(files["survey"]).position == read_survey(product / "bilsat_survey.txt").position
    assert sum(path.stat().st_size for path in product.iterdir()) < 400_000


def test_simulate_writes_a_scene_that_rectify_takes(tmp_path):
    said = json.loads(
        run("simulate", "bilsat", "-o", tmp_path / "s", "--seed", 3, "--off-nadir", 15, "--size", 64, "--xs", "--json")
    )
    files = {name: Path(path) for name, path in said["files"].items()}
    assert {"image", "image_green", "image_blue", "image_nir"} <= set(files)
    assert all(path.exists() for path in files.values())
    made = json.loads(
        run("rectify", files["image"], "--gcps", files["gcps"], "--dem", files["dem"], "--correction", "model",
            "--check", "every:4", "-o", tmp_path / "o", "--json")
    )  # fmt: skip
    report = made["report"]
    assert report["adjustment"]["model"] == "frame+model"
    assert report["adjustment"]["rmse"]["check"]["total"] < 1.6
    assert 14 < open_scene(files["image"]).facts["off_nadir_deg"] < 16
    assert failed("simulate", "bilsat", "-o", tmp_path, "--size", 5)["field"] == "--size, --seed"


# -- options of a sensor, and adjusting the model itself -------------------------------------------------------------


def test_declared_options_reach_the_sensor_and_others_are_refused(product, tmp_path):
    image, survey = tmp_path / "a.tif", tmp_path / "other.txt"
    image.write_bytes((product / "bilsat.tif").read_bytes())
    survey.write_bytes((product / "bilsat_survey.txt").read_bytes())
    # Nothing next to the image: the sensor and its option say it all.
    chosen = ("--sensor", "bilsat", "--sensor-option", f"survey={survey}")
    found = json.loads(run("info", image, *chosen, "--sensor-option", "attitude=zero", "--json"))
    assert found["model_source"] == str(survey)
    assert "attitude" in found["warnings"][0]
    wrong = failed("info", image, *chosen, "--sensor-option", "colour=red")
    assert "survey, attitude" in wrong["message"]
    assert wrong["field"] == "colour"
    saved = failed("info", image, "--model", "m.json", "--sensor-option", "attitude=zero")
    assert "--sensor-option" in saved["remedy"]
    twice = failed("info", image, "--rpc", "tag", "--sensor-option", "rpc=tag")
    assert "two options" in twice["message"]
    for bad in (("attitude",), ("attitude=zero", "--sensor-option", "attitude=survey")):
        done = CliRunner().invoke(cli, ["info", str(image), "--sensor-option", *bad])
        assert done.exit_code == 2
    assert "attitude: survey (default" in run("sensors")
    # What is read is recorded, and never written over.
    result = commands.rectify(
        image, tmp_path / "o", scene=SceneOptions(sensor="bilsat", sensor_options={"survey": str(survey)}),
        surface=SurfaceOptions(dem=product / "dem.tif"), output=OutputOptions(resolution=2000.0),
    )  # fmt: skip
    provenance = result.document["report"]["provenance"]
    assert {"role": "survey", "path": str(survey)}.items() <= next(
        entry for entry in provenance["inputs"] if entry["role"] == "survey"
    ).items()


def test_the_model_itself_is_adjusted_from_the_survey_and_from_zero_angles(product):
    points = PointOptions(product / "gcps.csv", correction="model", check="every:4")
    with_survey = commands.fit(product / "bilsat.tif", points)
    assert with_survey.fit.param_names == ("X_L", "Y_L", "Z_L", "omega", "phi", "kappa")
    assert with_survey.fit.priors["Z_L"].sigma == 300.0
    from_zero = commands.fit(product / "bilsat.tif", points, SceneOptions(sensor_options={"attitude": "zero"}))
    # The same points; only the prior of the attitude is missing.
    assert set(from_zero.fit.priors) == {"X_L", "Y_L", "Z_L"}
    image = np.array([[0, 0], [256, 0], [128, 128], [256, 256.0]])
    ground = with_survey.fit.model.image_to_ground(image, 1000.0)
    assert np.abs(from_zero.fit.model.ground_to_image(ground) - image).max() < 0.5
    # Two points are enough with what the survey knows.
    few = PointOptions(product / "gcps.csv", correction="model", select="even:2")
    assert commands.fit(product / "bilsat.tif", few).fit.rmse("check").total < 2.5


def test_a_model_without_parameters_of_its_own_says_so(tiny):
    with pytest.raises(InputError, match="no parameters of its own"):
        commands.fit(tiny.image, PointOptions(tiny.gcps, crs="EPSG:4326", vertical="ellipsoid", correction="model"))


def test_frame_images_work_from_the_command_line(tmp_path, product):
    truth = FrameCamera.from_roll_pitch_yaw(
        Interior(200, 160, 0.05, 2e-5, 2e-5), (32.8, 39.9, 2500.0), 0.02, -0.03, 1.2, heights=(900.0, 1100.0)
    )
    image = tmp_path / "a.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(image), 200, 160, 1, gdal.GDT_Byte)
    dataset.GetRasterBand(1).Fill(80)
    del dataset
    (tmp_path / "camera.json").write_text(
        json.dumps({"width": 200, "height": 160, "focal_length_mm": 50, "pixel_pitch_um": [20, 20]})
    )
    angles = np.degrees([0.02, -0.03, 1.2]) + np.array([0.3, -0.2, 0.4])
    pose = ",".join(map(str, [32.8001, 39.9001, 2510.0, *angles]))
    (tmp_path / "poses.csv").write_text(f"filename,lon,lat,alt,roll,pitch,yaw\na,{pose}\n")
    random = np.random.default_rng(0)
    places = random.uniform(5, 155, (12, 2))
    ground = truth.image_to_ground(places, random.uniform(900, 1100, 12))
    rows = [
        ",".join(map(repr, [k, *a, *g])) for k, (a, g) in enumerate(zip(places.tolist(), ground.tolist(), strict=True))
    ]
    (tmp_path / "gcps.csv").write_text("#CRS: EPSG:4326\n#vertical: ellipsoid\nid,col,row,x,y,h\n" + "\n".join(rows))
    options = {
        "camera": tmp_path / "camera.json", "exterior": tmp_path / "poses.csv", "vertical": "ellipsoid",
        "heights": "900,1100", "sigmas": "20,0.5",
    }  # fmt: skip
    given = [part for key, value in options.items() for part in ("--sensor-option", f"{key}={value}")]
    assert json.loads(run("info", image, *given, "--json"))["sensor"] == "frame"
    points = ("--gcps", tmp_path / "gcps.csv", "--correction", "model")
    fitted = json.loads(run("fit", image, *given, *points, "--json"))
    assert fitted["rmse"]["control"]["total"] < 0.05
    assert set(fitted["parameters"]) == {"X_L", "Y_L", "Z_L", "omega", "phi", "kappa"}
    run("rectify", image, *given, *points, "--height", 1000, "-o", tmp_path / "o")
    compared = run("compare", image, *given, *points[:2], "--models", "frame,frame+shift,frame+model", "--json")
    names = {row["model"] for row in json.loads(compared)["rows"]}
    assert names == {"frame", "frame+shift", "frame+model"}
    for bad in ("x,y", "0,1", "1"):
        options = [part.replace("sigmas=20,0.5", f"sigmas={bad}") for part in map(str, given)]
        assert failed("info", image, *options)["field"] == "sigmas"


# -- the RPC of a frame ----------------------------------------------------------------------------------------------


def test_gdalwarp_with_the_exported_rpc_makes_the_same_ortho(product, tmp_path):
    scene = open_scene(product / "bilsat.tif")
    interior = Interior(SIZE, SIZE, FOCAL_LENGTH, PITCH, PITCH)
    model = fit(scene.model._replace(interior=interior), _enlarged(product)).model
    exported = export_rpc(model)
    assert exported.max_error_px < 0.005
    # An image whose values are its own columns and rows: the ortho then holds where its pixels come from.
    source = tmp_path / "ramps.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(source), SIZE, SIZE, 2, gdal.GDT_Float32)
    rows, columns = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    dataset.WriteArray(np.stack([columns, rows]))
    dataset.SetMetadata(rpc_metadata(exported.rpc), "RPC")
    del dataset
    surface = open_dem(product / "dem.tif")
    # Finer than the source: where GDAL widens its kernel, that no longer keeps a ramp what it is.
    grid = Grid.of_extent(parse_crs("EPSG:32636"), (478e3, 4412e3, 492e3, 4426e3), (25.0, 25.0))
    rectify(model, RasterSource(source), surface, grid, tmp_path / "ours.tif", driver="GTiff", tolerance=0.005)
    _ellipsoidal(product / "dem.tif", surface, tmp_path / "dem.tif")
    extent = map(str, (478e3, 4412e3, 492e3, 4426e3))
    subprocess.run(
        ["gdalwarp", "-q", "-rpc", "-to", f"RPC_DEM={tmp_path / 'dem.tif'}", "-et", "0", "-r", "bilinear", "-t_srs",
         "EPSG:32636", "-te", *extent, "-tr", "25", "25", str(source), str(tmp_path / "gdal.tif")], check=True,
    )  # fmt: skip
    ours, theirs = (open_dataset(tmp_path / name).ReadAsArray() for name in ("ours.tif", "gdal.tif"))
    inside = (ours > 1).all(axis=0) & (theirs > 1).all(axis=0)
    assert inside.mean() > 0.9
    assert np.abs(ours - theirs)[:, inside].max() < 0.02


def _enlarged(product: Path):
    """Return the points of the sample as of an image of the full size."""
    points = read_points(product / "gcps.csv")
    return type(points)(**{**vars(points), "image": points.image * SIZE / 256})


def _ellipsoidal(path: Path, surface: Surface, out: Path) -> None:
    """Write the DEM with ellipsoidal heights, so that GDAL needs no geoid."""
    columns, rows = surface.shape[::-1]
    given = open_dataset(path)
    dataset = gdal.GetDriverByName("GTiff").Create(str(out), columns, rows, 1, gdal.GDT_Float64)
    dataset.SetGeoTransform(given.GetGeoTransform())
    dataset.SetProjection(parse_crs("EPSG:32636").to_wkt("WKT1_GDAL"))
    dataset.GetRasterBand(1).WriteArray(surface.window(0, 0, columns, rows))
    dataset.FlushCache()


# -- the paper -------------------------------------------------------------------------------------------------------


def test_reproduction_as_text_json_and_page(tmp_path):
    document = json.loads(run("reproduce", "bilsat", "--realisations", 2, "-o", tmp_path, "--json"))
    assert {"paper", "knobs", "tables"} <= set(document)
    assert [table["table"] for table in document["tables"]] == [3, 4, 5]
    lines = [line for table in document["tables"] for line in table["rows"]]
    assert {"label", "quantity", "paper", "median", "p5", "p95"} <= set(lines[0])
    assert len(lines) == sum(number is not None for row in ROWS for number in row.paper)
    assert document["summary"]["predicted"]["rows"] + document["summary"]["fitted"]["rows"] == len(lines)
    assert json.loads((tmp_path / "bilsat.json").read_text())["tables"] == document["tables"]
    html = (tmp_path / "bilsat.html").read_text()
    # Heads and groups of three tables, and the settings.
    assert html.count("<tr") == len(lines) + 3 + 5 + 1 + len(document["knobs"])
    assert html.count('class="control-head"') > 25
    assert "1 pixel" in html
    said = text(document)
    assert said.count("\n!") == sum(is_missed(line) for line in lines) + sum(
        one["verdict"] == "not reproduced" for one in document["statements"]
    )


def test_rows_that_cannot_be_fitted_are_said_to_be_so():
    document = reproduce(1, rows=tuple(row for row in ROWS if row.model == "rfm1"))
    for line in document["tables"][0]["rows"][:6]:
        line |= {"median": None, "p5": None, "p95": None}
    html = page(document, np.zeros((1, 2)), np.ones((1, 2)))
    assert "Fourteen unknowns from sixteen measurements" in html
    assert " - " in text(document)


# -- some cameras, one product ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cameras(tmp_path_factory) -> dict[str, Path]:
    """Return the images of three XS cameras with the survey of the red one."""
    folder = tmp_path_factory.mktemp("xs")
    return write_product(folder, size=512, cameras=("red", "blue", "nir"))


def test_registered_bands_open_as_the_scene_that_they_are(cameras, tmp_path):
    order = [cameras[name] for name in ("image_blue", "image", "image_nir")]
    result = bands.register(order, tmp_path, reference=cameras["image"])
    stack, red = open_scene(result.files["image"]), open_scene(cameras["image"])
    assert stack.sensor == "bilsat"
    assert result.files["metadata"].read_bytes() == cameras["survey"].read_bytes()
    ground = red.model.image_to_ground([[10.0, 20.0], [200.0, 100.0]], 900.0)
    np.testing.assert_array_equal(stack.model.ground_to_image(ground), red.model.ground_to_image(ground))
    dataset = gdal.Open(str(result.files["image"]))
    assert dataset.RasterCount == 3
    np.testing.assert_array_equal(
        dataset.GetRasterBand(2).ReadAsArray(), gdal.Open(str(cameras["image"])).ReadAsArray()
    )
    rows = json.loads(result.files["table"].read_text())["registrations"]
    # The simulated cameras are misaligned by several pixels; what is left is that of sub-pixel correlation.
    assert [row["band"] for row in rows] == ["bilsat_blue", "bilsat_nir"]
    assert max(row["rmse"] for row in rows) < 0.15


def test_bands_that_do_not_match_leave_nothing(cameras, tmp_path):
    noise = tmp_path / "noise.tif"
    made = gdal.GetDriverByName("GTiff").CreateCopy(str(noise), gdal.Open(str(cameras["image_blue"])))
    made.WriteArray(np.random.default_rng(0).integers(1, 255, (512, 512)).astype(np.uint8))
    made = None
    with pytest.raises(InputError):
        bands.register([cameras["image"], noise], tmp_path / "out")
    assert not list((tmp_path / "out").glob("*"))
    with pytest.raises(InputError, match="not one of the images"):
        bands.register([cameras["image"], noise], tmp_path / "out", reference=cameras["image_nir"])
    with pytest.raises(InputError, match="the same name"):
        bands.register([cameras["image"], cameras["image"]], tmp_path / "out")


def test_bands_in_an_archive_are_registered_as_those_on_disk(cameras, tmp_path):
    order = [cameras[name] for name in ("image_blue", "image")]
    with zipfile.ZipFile(tmp_path / "xs.zip", "w") as made:
        for path in cameras["image"].parent.iterdir():
            made.write(path, path.name)
    inside = [f"/vsizip/{tmp_path / 'xs.zip'}/{path.name}" for path in order]
    disk = bands.register(order, tmp_path / "disk", reference=order[1])
    zipped = bands.register(inside, tmp_path / "zipped", reference=inside[1])
    pixels = [gdal.Open(str(made.files["image"])).ReadAsArray() for made in (disk, zipped)]
    np.testing.assert_array_equal(*pixels)
    assert [disk.document[key] for key in ("sensor", "bands", "registrations")] == [
        zipped.document[key] for key in ("sensor", "bands", "registrations")
    ]
    assert open_scene(zipped.files["image"]).sensor == "bilsat"
    assert {entry["path"] for entry in zipped.document["inputs"]} == {str(tmp_path / "xs.zip")}
