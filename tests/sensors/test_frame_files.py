"""The sensor `frame`: what it asks for, and OpenSfM's reconstruction as source of poses and cameras."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal
from scipy.spatial.transform import Rotation

from ortho_pipeline import commands
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.options import SceneOptions

LENS = {"projection_type": "perspective", "width": 60, "height": 40, "focal": 0.8, "k1": 0.0, "k2": 0.0}
PLACE = {"longitude": 33.0, "latitude": 39.0, "altitude": 900.0}


def image(folder: Path, name: str = "one.tif") -> Path:
    gdal.GetDriverByName("GTiff").Create(str(folder / name), 60, 40, 1)
    return folder / name


def shot(centre: Any, turn: Rotation, camera: str = "a") -> dict[str, Any]:
    """Return a shot of a camera at a place in east, north, up; `turn` takes these to x right, y down, z forward."""
    return {
        "rotation": turn.as_rotvec().tolist(),
        "translation": (-turn.apply(centre)).tolist(),
        "camera": camera,
    }


def write(folder: Path, **changes: Any) -> Path:
    down = Rotation.from_matrix([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    part = {"cameras": {"a": LENS, "b": {**LENS, "focal": 1.6}}, "reference_lla": PLACE}
    part["shots"] = {"one.tif": shot([30.0, -20.0, 150.0], down), "two": shot([0, 0, 150.0], down, "b")}
    path = folder / "reconstruction.json"
    path.write_text(json.dumps([{"cameras": {}, "shots": {}}, {**part, **changes}]))
    return path


def scene(folder: Path, name: str = "one.tif", **options: str) -> Any:
    given = {"exterior": str(folder / "reconstruction.json"), "vertical": "ellipsoid", **options}
    return open_scene(image(folder, name), SceneOptions(sensor_options=given))


def test_a_shot_looks_where_opensfm_says(tmp_path):
    write(tmp_path)
    opened = scene(tmp_path, heights="800,1000")
    # Straight down: the middle of the image is below the camera, 30 m east and 20 m south of the origin.
    lon, lat, _ = opened.model.image_to_ground([[30.0, 20.0]], 900.0)[0]
    metre = 1 / 111_412.0  # of longitude at the equator, within 0.1 %
    assert (lon - 33.0, lat - 39.0) == pytest.approx((30 * metre / np.cos(np.radians(39)), -20 / 111_017.0), rel=3e-3)
    # One pixel is 150 m / (0.8 x 60 px); columns run to the east, rows to the south.
    ground = opened.model.image_to_ground([[30.0, 20.0], [31.0, 20.0], [30.0, 21.0]], 900.0)
    assert ground[1, 0] - lon == pytest.approx(150 / 48 * metre / np.cos(np.radians(39)), rel=3e-3)
    assert ground[2, 1] - lat == pytest.approx(-150 / 48 / 111_017.0, rel=3e-3)
    assert opened.facts["exterior_orientation"] == "shots.one.tif"


def test_a_camera_that_looks_into_the_sky_says_so(tmp_path):
    write(tmp_path)
    opened = scene(tmp_path, heights="800,1000")
    assert opened.model.sees_ground
    assert (opened.facts["tilt_deg"], opened.warnings) == (pytest.approx(0.0, abs=1e-3), ())
    write(tmp_path, shots={"one.tif": shot([30.0, -20.0, 150.0], Rotation.identity())})
    opened = scene(tmp_path, heights="800,1000")
    assert not opened.model.sees_ground
    assert opened.facts["tilt_deg"] == pytest.approx(180.0, abs=1e-3)
    assert "looks past the ground" in opened.warnings[0]


def test_a_shot_has_its_own_camera_and_its_name_may_lack_a_suffix(tmp_path):
    write(tmp_path)
    assert scene(tmp_path, "two.tif").facts["focal_length_px"] == pytest.approx(96.0)
    assert scene(tmp_path).facts["focal_length_px"] == pytest.approx(48.0)


def test_heights_of_the_reconstruction_are_above_what_is_said(tmp_path):
    write(tmp_path)
    ellipsoid = scene(tmp_path).facts["perspective_centre"][2]
    # EGM96 is 36 m above the ellipsoid at Ankara's latitude and longitude (published grids: 35 to 37 m).
    assert scene(tmp_path, vertical="egm96").facts["perspective_centre"][2] - ellipsoid == pytest.approx(36.0, abs=2.0)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"shots": {}}, "shots"),
        ({"reference_lla": None}, "reference_lla"),
        ({"reference_lla": {**PLACE, "latitude": 91}}, "reference_lla"),
        ({"reference_lla": {"longitude": 1, "latitude": 2}}, "reference_lla.altitude"),
        ({"shots": {"one": {"rotation": [0, 0], "translation": [0, 0, 1]}}}, "shots.one.rotation"),
        ({"shots": {"one": {"rotation": [0, 0, 0], "translation": [0, "x", 1]}}}, "shots.one.translation"),
        ({"shots": {"one": [], "one.tif": []}}, "shots"),
        ({"shots": []}, "shots"),
    ],
)
def test_a_damaged_reconstruction_is_named(tmp_path, changes, field):
    write(tmp_path, **changes)
    with pytest.raises(InputError) as error:
        scene(tmp_path)
    assert (error.value.field, Path(str(error.value.file)).name) == (field, "reconstruction.json")


def test_info_says_what_is_missing(tmp_path):
    path = image(tmp_path)
    with pytest.raises(InputError) as error:
        commands.info(path)
    assert "`scene.sensor=NAME` (general ones: frame" in str(error.value)
    with pytest.raises(InputError) as error:
        commands.info(path, SceneOptions(sensor="frame"))
    for option in ("camera", "exterior", "vertical"):
        assert f"`scene.sensor_options.{option}=" in str(error.value.remedy)
    with pytest.raises(InputError) as error:
        commands.info(path, SceneOptions(sensor_options={"exterior": "reconstruction.json"}))
    assert error.value.field == "vertical"
    write(tmp_path)
    exterior = str(tmp_path / "reconstruction.json")
    options = SceneOptions(sensor_options={"exterior": exterior, "vertical": "ellipsoid"})
    assert "not stated" in commands.info(path, options)["facts"]["ground_heights"]
    stated = SceneOptions(sensor_options={**options.sensor_options, "heights": "850,950"})
    assert "ground_heights" not in commands.info(path, stated)["facts"]


CAMERA = {"width": 60, "height": 40, "focal_length_mm": 48.0, "sensor_mm": [60.0, 40.0]}
ROW = "500100.0,6270000.0,2500.0"


def framed(folder: Path, table: str, vertical: str = "ellipsoid") -> np.ndarray:
    """Return the parameters of an image that a table orients: place, omega, phi and kappa."""
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    (folder / "poses.csv").write_text(table)
    given = {"camera": str(folder / "camera.json"), "exterior": str(folder / "poses.csv"), "crs": "EPSG:32735"}
    options = {**given, "vertical": vertical, "frame": "map"}
    return np.asarray(open_scene(image(folder), SceneOptions(sensor_options=options)).model.params)


def test_a_header_may_be_a_comment(tmp_path):
    plain = framed(tmp_path, f"filename,x,y,z,kappa,phi,omega\none.tif,{ROW},30,2,1\n")
    np.testing.assert_allclose(np.degrees(plain[3:]), [1, 2, 30], atol=1e-9)
    for header in ("#filename,x,y,z,kappa,phi,omega\n", "# Cameras (1)\n# Filename, X, Y, Z, Kappa, Phi, Omega\n"):
        np.testing.assert_array_equal(framed(tmp_path, f"{header}one.tif,{ROW},30,2,1\n"), plain)
    # Without one, angles are omega, phi and kappa; a comment in words is no header.
    for first in ("", "# made by hand, with care, on a Monday, and checked\n", "#one,1,2,3,4,5,6\n"):
        bare = framed(tmp_path, f"{first}one.tif,{ROW},1,2,30\n")
        np.testing.assert_array_equal(bare, plain)


def test_a_header_of_other_angles_is_refused_in_a_comment_too(tmp_path):
    with pytest.raises(InputError, match="unexpected columns"):
        framed(tmp_path, f"#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll\none.tif,{ROW},30,2,1\n")


def test_heights_of_a_table_have_the_unit_of_their_datum(tmp_path, monkeypatch):
    monkeypatch.setattr(Vertical, "undulation", lambda self, lon, lat: np.full(np.shape(lon), 30.0))
    table = f"one.tif,{ROW},1,2,30\n"
    for code, metres in (("EPSG:8228", 0.3048), ("EPSG:5703", 1.0)):
        assert framed(tmp_path, table, code)[2] == pytest.approx(2500 * metres + 30.0)
