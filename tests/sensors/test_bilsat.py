"""BILSAT-1: a simulated acquisition, the rigorous model on it, the survey file, the plugins, the four XS cameras."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import ortho_bilsat
import ortho_frame
import pytest
from ortho_bilsat.survey import Survey, read_survey, write_survey
from ortho_studies.bilsat.truth import (
    FOCAL_LENGTH,
    PITCH,
    SIZE,
    XS_CAMERAS,
    BilsatScene,
    BilsatTerrain,
    Snapshot,
    render,
)
from osgeo import gdal

from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.geodesy.ellipsoid import geocentric, geodetic
from ortho_pipeline.host import open_scene
from ortho_pipeline.imaging.band_stack import stack_bands
from ortho_pipeline.imaging.registration import TRANSFORMS, Transform, register
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.frame.resection import resect
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.testing import check_sensor

XS = Interior(SIZE, SIZE, FOCAL_LENGTH, PITCH, PITCH)


def sensor(plugin):
    return next(iter(plugin.ortho_sensors()))


def write_image(path: Path, pixels: np.ndarray) -> Path:
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), pixels.shape[1], pixels.shape[0], 1, gdal.GDT_Byte)
    dataset.WriteArray(pixels)
    dataset.FlushCache()
    return path


# -- the scene and the rigorous model --------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [0.0, 8.0, 25.0])
def test_rigorous_model_recovers_an_independent_camera(tilt):
    scene = BilsatScene.make(tilt)
    assert scene.ground[:, 2].min() > 700
    assert np.ptp(scene.ground[:, 2]) > 800
    np.testing.assert_allclose(scene.camera.project(scene.ground), scene.image, atol=1e-6)
    exact = scene.measure(0, sigma_image=0.0, sigma_ground=0.0)
    from_survey = FrameCamera.from_geocentric(XS, scene.survey(0).position, heights=(700, 1900))
    for start in (from_survey, resect(exact, XS)):
        result = fit(start, exact, robust=False)
        assert result.rmse("control").total < 1e-9
        centre = geocentric(result.model.perspective_centre[None])[0]
        assert np.linalg.norm(centre - scene.camera.position) < 1e-6
        axes = result.model.rotation @ result.model.working_frame.axes * [[1], [-1], [-1]]
        np.testing.assert_allclose(axes, scene.camera.axes, atol=1e-10)


def test_exported_rpc_is_the_frame_model():
    scene = BilsatScene.make(8.0)
    exact = scene.measure(0, sigma_image=0.0, sigma_ground=0.0)
    model = fit(resect(exact, XS, heights=(600, 2000)), exact, robust=False).model
    export = export_rpc(model)
    assert export.max_error_px < 0.005
    np.testing.assert_allclose(export.rpc.ground_to_image(scene.ground), scene.image, atol=0.005)


# -- the plugin ------------------------------------------------------------------------------------------------------


@pytest.fixture
def product(tmp_path):
    """A small scene as it would be delivered: image and survey."""
    camera = Snapshot.over_ankara(8.0, size=64)
    interior = Interior(64, 64, FOCAL_LENGTH, PITCH * 32, PITCH * 32)
    survey = Survey(
        "ANKARA", "XS-RED", "2005-08-03T08:12:31.250+00:00", tuple(camera.position.tolist()),
        tuple(camera.velocity.tolist()), (-np.radians(8.0), 0.0, 0.0), interior, 300.0, (700.0, 1900.0),
    )  # fmt: skip
    write_image(tmp_path / "ankara.tif", np.full((64, 64), 99, np.uint8))
    write_survey(survey, tmp_path / "ankara_survey.txt")
    return tmp_path, camera, survey


def test_bilsat_scene_opens_as_it_was_taken(product):
    folder, camera, survey = product
    assert read_survey(folder / "ankara_survey.txt").position == survey.position
    scene = check_sensor(sensor(ortho_bilsat), folder / "ankara.tif")
    assert scene.facts["camera"] == "XS-RED"
    assert open_scene(folder / "ankara.tif").sensor == "bilsat"
    image = np.array([[0, 0], [64, 0], [32, 32], [10, 60.0]])
    # A negative roll looks to the right, as the simulated orbit does; the survey has no other angles.
    ground = geodetic(camera.position + 700e3 * camera.rays(image))
    np.testing.assert_allclose(scene.model.ground_to_image(ground), image, atol=1e-6)


def test_a_byte_order_mark_before_the_survey_is_skipped(product):
    folder, *_ = product
    survey = folder / "ankara_survey.txt"
    survey.write_bytes(b"\xef\xbb\xbf" + survey.read_bytes())
    assert open_scene(folder / "ankara.tif").sensor == "bilsat"


def test_without_attitude_the_angles_are_zero(product):
    folder, *_ = product
    scene = sensor(ortho_bilsat).open_scene(gdal.Open(str(folder / "ankara.tif")), attitude="zero")
    assert not scene.model.exterior[[0, 1, 3, 4, 5]].any()
    assert "attitude" in scene.warnings[0]


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("BILSAT-1 IMAGING SURVEY 1", "BILSAT-2", "line 1"),
        ("END\n", "", None),
        ("END\n", "END\nmore", "line"),
        ("scene = ANKARA\n", "", "scene"),
        ("scene = ANKARA\n", "scene = A\nscene = B\n", "scene"),
        ("columns = 64", "columns = 64.5", "columns"),
        ("columns = 64", "columns = nan", "columns"),
        ("columns = 64", "columns = 1e400", "columns"),
        ("rows = 64", "speed = 64", "line"),
        ("focal_length_mm = 180.0", "focal_length_mm = -180", "focal_length_mm"),
        ("position_m = ", "position_m = 1 ", "position_m"),
        ("velocity_m_s = ", "velocity_m_s = 0 0 0 # ", "velocity_m_s"),
        ("camera = XS-RED", "camera = TIR", "camera"),
        ("2005-08-03T08:12:31.250+00:00", "yesterday", "acquired"),
        ("heights_m = 700.0 1900.0", "heights_m = 1900 700", "heights_m"),
        ("scene = ANKARA", "scene = ANKAR\u00c4", None),
    ],
)
def test_damaged_surveys_are_errors_that_name_the_field(product, old, new, field):
    path = product[0] / "ankara_survey.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as raised:
        read_survey(path)
    assert raised.value.file == str(path)
    assert field is None or field in raised.value.field


def test_generic_frame_plugin_reads_both_tables(tmp_path):
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"width": 100, "height": 80, "focal_length_mm": 50, "pixel_pitch_um": [5, 5]}))
    write_image(tmp_path / "a 1.tif", np.full((40, 50), 7, np.uint8))
    table = tmp_path / "poses.csv"
    table.write_text("filename;lon;lat;alt;roll;pitch;yaw\na 1.tif;32.8;39.9;1500;1;2;200\n")
    options = {"camera": str(camera), "vertical": "ellipsoid", "heights": "900,1100"}
    scene = check_sensor(sensor(ortho_frame), tmp_path / "a 1.tif", exterior=str(table), **options)
    # Half the pixels of the camera: a reduced copy.
    assert scene.model.interior.pitch_x == pytest.approx(1e-5)
    first = scene.model
    table.write_text("filename,x,y,z,omega,phi,kappa\na 1,480000,4420000,1500,2,1,30\n")
    second = check_sensor(
        sensor(ortho_frame), tmp_path / "a 1.tif", exterior=str(table), crs="EPSG:32636", frame="map", **options
    ).model
    assert second.crs == "EPSG:32636"
    assert first.crs == "EPSG:4979"


@pytest.mark.parametrize(
    ("camera", "table"),
    [
        ("[1", None),
        ('{"width": 100, "width": 100}', None),
        ('{"width": 100, "height": 80, "focal_length_mm": NaN, "pixel_pitch_um": [5, 5]}', None),
        ('{"width": 100, "height": 90, "focal_length_mm": 50, "pixel_pitch_um": [5, 5]}', None),
        ('{"width": 100, "height": 80, "focal_length_mm": 50, "sensor_mm": [5]}', None),
        ('{"width": 100, "height": 80, "focal_length_mm": 50, "pixel_pitch_um": [5, 5], "iso": 100}', None),
        ('{"cam": {"projection_type": "fisheye", "focal": 0.5}}', None),
        (None, ""),
        (None, "filename,x,y\n"),
        (None, "filename,x,y,z,omega,phi,kappa\nb,1,2,3,4,5,6\n"),
        (None, "filename,x,y,z,omega,phi,kappa\na,1,2,3,4,5\n"),
        (None, "filename,x,y,z,omega,phi,kappa\na,1,2,inf,4,5,6\n"),
        (None, "filename,x,y,z,omega,phi,kappa\na,1,2,3,4,5,6\na,1,2,3,4,5,6\n"),
        (None, "filename,lon,lat,alt,roll,pitch,yaw\na,32,139,3,4,5,6\n"),
    ],
)
def test_damaged_camera_files_and_tables_are_errors(tmp_path, camera, table):
    good = {"width": 100, "height": 80, "focal_length_mm": 50, "pixel_pitch_um": [5, 5]}
    (tmp_path / "camera.json").write_text(json.dumps(good) if camera is None else camera)
    (tmp_path / "poses.csv").write_text(
        "filename,x,y,z,omega,phi,kappa\na,480000,4420000,1500,0,0,0\n" if table is None else table
    )
    write_image(tmp_path / "a.tif", np.full((80, 100), 7, np.uint8))
    with pytest.raises(InputError):
        sensor(ortho_frame).open_scene(
            gdal.Open(str(tmp_path / "a.tif")), camera=str(tmp_path / "camera.json"),
            exterior=str(tmp_path / "poses.csv"), crs="EPSG:32636", vertical="ellipsoid",
        )  # fmt: skip


# -- the four cameras ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", TRANSFORMS)
def test_transformations_are_fitted_exactly(kind):
    random = np.random.default_rng(1)
    points = random.uniform(0, 2048, (30, 2))
    truth = Transform.fit("affine", points, points + 3.0)
    change = {
        "similarity": np.array([[0.01, 1.001, -0.002], [0.02, 0.002, 1.001]]),
        "affine": np.array([[0.01, 1.001, -0.002], [0.02, 0.003, 0.998]]),
        "projective": np.array([0.01, 1.001, -0.002, 0.02, 0.003, 0.998, 1e-3, -2e-3]),
        "poly2": np.array([[0.01, 1.001, -0.002, 1e-3, 0, 2e-3], [0.02, 0.003, 0.998, 0, -1e-3, 1e-3]]),
    }[kind]
    truth = Transform(kind, change, truth.centre, truth.scale)
    np.testing.assert_allclose(Transform.fit(kind, points, truth(points))(points), truth(points), atol=1e-8)
    with pytest.raises(TooFewPoints):
        Transform.fit(kind, points[:1], points[:1])


def test_four_cameras_become_one_stack(tmp_path):
    base, hills = Snapshot.over_ankara(8.0, size=512), BilsatTerrain()
    cameras = {name: base.misaligned(*angles) for name, angles in XS_CAMERAS.items()}
    paths = {
        name: write_image(tmp_path / f"{name}.tif", render(camera, hills, name, seed=k))
        for k, (name, camera) in enumerate(cameras.items())
    }
    registrations = stack_bands(paths, tmp_path / "xs.tif")
    image = np.random.default_rng(0).uniform(15, 497, (300, 2))
    for item in registrations:
        row = item.row()
        assert row["rmse"] < 0.1
        assert row["used"] >= 30
        # Against the truth: where the other camera sees the far end of the red camera's ray.
        there = cameras[item.band].project(geodetic(base.position + 700e3 * base.rays(image)))
        assert np.sqrt(((item.transform(image) - there) ** 2).mean()) < 0.03
    stack = gdal.Open(str(tmp_path / "xs.tif"))
    assert [stack.GetRasterBand(k).GetDescription() for k in (1, 2, 3, 4)] == list(XS_CAMERAS)
    np.testing.assert_array_equal(stack.GetRasterBand(1).ReadAsArray(), gdal.Open(str(paths["red"])).ReadAsArray())


def test_bands_that_have_nothing_in_common_are_refused():
    random = np.random.default_rng(0)
    with pytest.raises(TooFewPoints):
        register(list(random.normal(size=(2, 300, 300))), ["a", "b"], patch=32)
    with pytest.raises(InputError):
        register([np.zeros((4, 4)), np.zeros((4, 5))], ["a", "b"])
