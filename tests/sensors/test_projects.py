"""Projects of OpenDroneMap and orthority: recognised next to their images, with the axes of each program."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal
from photos import photo
from scipy.spatial.transform import Rotation

from ortho_pipeline import commands
from ortho_pipeline.commands.block import adjust
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric, geodetic
from ortho_pipeline.options import BlockOptions, SceneOptions

gdal.UseExceptions()
LENS = {"projection_type": "perspective", "width": 60, "height": 40, "focal": 0.8, "k1": 0.0, "k2": 0.0}
#: Two degrees west of the central meridian of zone 36: the map is turned by 1.26 degrees.
ORIGIN = (31.0, 39.0, 900.0)
DOWN = Rotation.from_matrix([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
CENTRE = np.array([300.0, -200.0, 150.0])


def on_earth(place: np.ndarray) -> np.ndarray:
    """Return lon, lat, height of a place in east, north, up about the origin."""
    start = np.array([ORIGIN])
    return geodetic(geocentric(start) + place @ enu_from_ecef(start)[0])[0]


def in_map(place: np.ndarray) -> np.ndarray:
    return ground_transform("EPSG:4979", "EPSG:32636")([on_earth(place)])[0]


def project(folder: Path, *, offset: bool, coordinates: bool = False, gps: bool = True, lens: Any = LENS) -> Path:
    """Write a project with one photo that looks straight down, with its top along north of the axes."""
    (folder / "opensfm").mkdir()
    corner = ground_transform("EPSG:4979", "EPSG:32636")([ORIGIN])[0]
    if coordinates:
        corner = np.array([500_000.0, 4_300_000.0, ORIGIN[2]])
        (folder / "odm_georeferencing").mkdir()
        (folder / "odm_georeferencing" / "coords.txt").write_text("WGS84 UTM 36N\n500000 4300000\n1 2 3\n")
    centre = in_map(CENTRE) - corner if offset else CENTRE
    shot = {"rotation": DOWN.as_rotvec().tolist(), "translation": (-DOWN.apply(centre)).tolist(), "camera": "a"}
    if gps:
        shot["gps_position"] = (CENTRE + np.array([1.5, -1.0, 2.0])).tolist()
    names = ("longitude", "latitude", "altitude")
    part = {"cameras": {"a": lens}, "shots": {"one.tif": shot}, "reference_lla": dict(zip(names, ORIGIN, strict=True))}
    (folder / "opensfm" / "reconstruction.json").write_text(json.dumps([part]))
    (folder / "images").mkdir()
    return photo(folder / "images" / "one.tif", size=(60, 40))


def heading(scene: Any) -> float:
    """Return where the top of the image points to, degrees from true north."""
    ground = scene.model.image_to_ground([[30.0, 20.0], [30.0, 10.0]], 800.0)
    ground = ground_transform(scene.model.crs, "EPSG:4979")(ground)
    east, north = (ground[1] - ground[0])[:2] * (math.cos(math.radians(39.0)), 1.0)
    return math.degrees(math.atan2(east, north))


@pytest.mark.parametrize(
    ("made", "convergence"),
    [
        ({"offset": False}, False),
        ({"offset": True}, True),
        ({"offset": True, "coordinates": True}, True),
        ({"offset": True, "coordinates": True, "gps": False}, True),
        ({"offset": False, "gps": False}, False),
    ],
)
def test_a_photo_of_a_project_has_the_axes_of_the_project(tmp_path, made, convergence):
    scene = open_scene(project(tmp_path, **made))
    assert scene.sensor == "odm"
    centre = ground_transform(scene.model.crs, "EPSG:4979")([scene.model.perspective_centre])[0]
    wanted = on_earth(CENTRE)
    np.testing.assert_allclose(centre[:2], wanted[:2], atol=2e-8)
    # The height of a map is that above the ellipsoid, 150 m above the plane at the origin.
    assert centre[2] == pytest.approx(wanted[2], abs=0.03)
    # North of the map is 1.26 degrees west of true north here.
    turned = math.degrees(math.atan(math.tan(math.radians(31.0 - 33.0)) * math.sin(math.radians(39.0))))
    assert heading(scene) == pytest.approx(turned if convergence else 0.0, abs=0.02)
    assert [notice.code for notice in scene.notices] == ["datum-unknown"]


def test_poses_that_are_adjusted_again_are_told_once(tmp_path):
    """They may be those of a finished adjustment, as of these projects."""
    project(tmp_path, offset=False)
    file = tmp_path / "opensfm" / "reconstruction.json"
    document = json.loads(file.read_text())
    shots = document[0]["shots"]
    for number, name in enumerate(("two.tif", "three.tif"), 1):
        moved = (-DOWN.apply(CENTRE + np.array([20.0 * number, 0.0, 0.0]))).tolist()
        shots[name] = shots["one.tif"] | {"translation": moved}
        photo(tmp_path / "images" / name, size=(60, 40))
    file.write_text(json.dumps(document))
    images = [tmp_path / "images" / name for name in shots]
    options = SceneOptions(sensor_options={"vertical": "ellipsoid", "heights": "850,950"})
    models = {image: open_scene(image, options).model for image in images}
    place = models[images[1]].image_to_ground(np.random.default_rng(1).uniform((25, 5), (35, 35), (12, 2)), 900.0)
    rows = ["id,image,col,row"]
    for image, model in models.items():
        rows += [f"t{k},{image.name},{c:.3f},{r:.3f}" for k, (c, r) in enumerate(model.ground_to_image(place))]
    (tmp_path / "ties.csv").write_text("\n".join(rows))
    for correction, codes in ((None, ["adjusted-again"]), ("none", [])):
        block = BlockOptions(points=tmp_path / "ties.csv", correction=correction)
        result = adjust(images, tmp_path / f"out{correction}", block, options)
        notices = json.loads(result.files["report"].read_text())["notices"]
        assert [one["code"] for one in notices if one["code"] == "adjusted-again"] == codes


def test_the_exact_poses_of_a_project_are_preferred(tmp_path):
    image = project(tmp_path, offset=True)
    exact = tmp_path / "opensfm" / "reconstruction.topocentric.json"
    document = json.loads((tmp_path / "opensfm" / "reconstruction.json").read_text())
    document[0]["shots"]["one.tif"]["translation"] = (-DOWN.apply(CENTRE)).tolist()
    exact.write_text(json.dumps(document))
    scene = open_scene(image, SceneOptions(sensor_options={"vertical": "ellipsoid"}))
    assert scene.model.frame == "topocentric"
    np.testing.assert_allclose(scene.model.perspective_centre, on_earth(CENTRE), atol=1e-6)
    assert scene.notices == ()


@pytest.mark.parametrize("kind", ["simple_radial", "radial"])
def test_radial_cameras_are_exact(tmp_path, kind):
    lens = {"projection_type": kind, "width": 60, "height": 40, "focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01,
            "c_y": -0.02, "k1": -0.1, **({"k2": 0.05} if kind == "radial" else {})}  # fmt: skip
    scene = open_scene(project(tmp_path, offset=False, lens=lens))
    x, y = np.random.default_rng(1).uniform(-0.4, 0.4, (2, 40))
    r2 = x**2 + y**2
    radial = 1 + lens["k1"] * r2 + lens.get("k2", 0.0) * r2**2
    wanted = np.stack([30 + 60 * (0.8 * x * radial + 0.01), 20 + 60 * (0.9 * y * radial - 0.02)], axis=1)
    np.testing.assert_allclose(scene.model.interior.image_of(np.stack([x, y], axis=1)), wanted, atol=1e-9)


@pytest.mark.parametrize("kind", ["fisheye", "fisheye_opencv", "fisheye62", "fisheye624", "dual", "spherical", None])
def test_other_cameras_are_refused_by_name(tmp_path, kind):
    image = project(tmp_path, offset=False, lens={**LENS, "projection_type": kind})
    with pytest.raises(InputError, match=f"{kind!r} are not supported") as error:
        open_scene(image)
    assert "brown, perspective, simple_radial, radial" in error.value.remedy


def test_each_part_of_a_reconstruction_has_its_own_camera(tmp_path):
    image = project(tmp_path, offset=False)
    file = tmp_path / "opensfm" / "reconstruction.json"
    part = json.loads(file.read_text())[0]
    other = {**part, "cameras": {"a": {**LENS, "focal": 0.9}}, "shots": {"two.tif": part["shots"]["one.tif"]}}
    file.write_text(json.dumps([part, other]))
    two = photo(image.with_name("two.tif"), size=(60, 40))
    options = SceneOptions(sensor="frame", sensor_options={"exterior": str(file), "vertical": "ellipsoid"})
    for path, focal in ((image, 48.0), (two, 54.0)):
        assert open_scene(path).facts["focal_length_px"] == pytest.approx(focal)
        assert open_scene(path, options).facts["focal_length_px"] == pytest.approx(focal)


def test_a_photo_that_the_project_left_out_is_an_error(tmp_path):
    image = project(tmp_path, offset=False)
    other = photo(image.with_name("two.tif"), size=(60, 40))
    with pytest.raises(InputError, match=r"two.tif is not in this reconstruction"):
        open_scene(other)
    # Its tags are still there.
    assert open_scene(other, SceneOptions(sensor="photo")).sensor == "photo"


@pytest.mark.parametrize("text", ["", "WGS84 UTM 36N", "WGS84 UTM 61N\n1 2", "WGS84 UTM 36N\n1 x", "EPSG:4326\n1 2"])
def test_damaged_coordinates_are_an_error(tmp_path, text):
    image = project(tmp_path, offset=True, coordinates=True)
    (tmp_path / "odm_georeferencing" / "coords.txt").write_text(text)
    with pytest.raises(InputError, match="expected 'WGS84 UTM zone'"):
        open_scene(image)


# -- orthority -------------------------------------------------------------------------------------------------------

YAML = """
Camera A:
    type: {kind}
    im_size: [60, 40]
    focal_len: 12.0
    sensor_size: [6.0, 5.0]
    cx: 0.01
    cy: -0.02
    k1: 0.1
{more}
"""


def orthority(folder: Path, kind: str = "brown", more: str = "", text: str | None = None, **changes: Any) -> Path:
    (folder / "my_int_param.yaml").write_text(YAML.format(kind=kind, more=more) if text is None else text)
    own = {"filename": "one", "camera": "Camera A", "xyz": [400_000.0, 4_300_000.0, 2500.0], "opk": [0.0, 0.0, 0.3]}
    feature = {"type": "Feature", "properties": {**own, **changes}, "geometry": None}
    document = {"type": "FeatureCollection", "world_crs": "EPSG:32636", "features": [feature]}
    (folder / "my_ext_param.geojson").write_text(json.dumps(document))
    gdal.GetDriverByName("GTiff").Create(str(folder / "one.tif"), 60, 40, 1)
    return folder / "one.tif"


def test_orthoritys_files_are_found_and_mean_its_map(tmp_path):
    scene = open_scene(orthority(tmp_path))
    assert scene.sensor == "orthority"
    assert scene.model.frame == "map"
    np.testing.assert_allclose(scene.model.exterior, [400_000.0, 4_300_000.0, 2500.0, 0, 0, 0.3], atol=1e-9)
    # orthority: (col, row) of centres = focal_len / sensor_size * im_size * (u, v) + (im_size - 1) / 2 + longer * c.
    x, y = np.random.default_rng(1).uniform(-0.2, 0.2, (2, 40))
    radial = 1 + 0.1 * (x**2 + y**2)
    wanted = np.stack([12 / 6 * 60 * x * radial + 30 + 0.6, 12 / 5 * 40 * y * radial + 20 - 1.2], axis=1)
    np.testing.assert_allclose(scene.model.interior.image_of(np.stack([x, y], axis=1)), wanted, atol=1e-9)
    stated = open_scene(tmp_path / "one.tif", SceneOptions(sensor_options={"vertical": "egm96"}))
    assert stated.model.exterior[2] > 2520.0
    assert stated.notices == ()
    file = tmp_path / "my_ext_param.geojson"
    file.write_text(file.read_text().replace("EPSG:32636", "EPSG:32636+5773"))
    declared = open_scene(tmp_path / "one.tif")
    assert declared.model.exterior[2] == pytest.approx(stated.model.exterior[2], abs=1e-6)
    assert declared.notices == ()


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"kind": "fisheye"}, "the lens type 'fisheye' cannot be represented exactly"),
        (
            {"kind": "opencv", "more": "    k4: 0.1\n    s1: 0.2"},
            "the coefficients k4, s1 cannot be represented exactly",
        ),
        ({"text": "a: &b {type: brown, im_size: [1, 2]}\nc: *b"}, "no aliases"),
        ({"text": "a: " + "[" * 40 + "]" * 40}, "few levels"),
        ({"text": "a: [1"}, "this is not YAML"),
        ({"text": "a: !!python/object:os.system {}"}, "this is not YAML"),
        ({"text": YAML.format(kind="brown", more="").replace("12.0", "0")}, "must be positive"),
        ({"text": YAML.format(kind="brown", more="").replace("6.0", "0")}, "must be positive"),
        ({"filename": "two"}, "the image one.tif is not in this file"),
        ({"xyz": [1, 2]}, "a list of 3 numbers"),
        ({"opk": [1, 2, "x"]}, "'x' is not a number"),
    ],
)
def test_damaged_files_of_orthority_are_one_error_each(tmp_path, made, message):
    with pytest.raises(InputError, match=message) as error:
        open_scene(orthority(tmp_path, **made))
    assert error.value.file
    assert error.value.remedy


def test_a_table_without_a_header_has_the_crs_of_its_prj(tmp_path):
    image = orthority(tmp_path)
    (tmp_path / "poses.txt").write_text("two 1 2 3 4 5 6\none 400000 4300000 2500 0.5 -0.2 170\n")
    (tmp_path / "poses.prj").write_text("EPSG:32636\n")
    options = {"camera": str(tmp_path / "my_int_param.yaml"), "exterior": str(tmp_path / "poses.txt")}
    scene = open_scene(
        image, SceneOptions(sensor="frame", sensor_options={**options, "vertical": "ellipsoid", "frame": "map"})
    )
    angles = np.radians([0.5, -0.2, 170.0])
    np.testing.assert_allclose(scene.model.exterior, [400_000, 4_300_000, 2500, *angles], atol=1e-9)
    (tmp_path / "poses.txt").write_text("one 400000 4300000 2500 0.5 -0.2 398.5\n")
    with pytest.raises(InputError, match="beyond 360 degrees") as error:
        open_scene(image, SceneOptions(sensor="frame", sensor_options={**options, "vertical": "ellipsoid"}))
    assert "gon times 0.9" in str(error.value.remedy)


@pytest.mark.realdata
def test_ngi_frames_open_from_orthoritys_own_files(real):
    folder = real / "orthority"
    files = {
        "camera": str(folder / "io" / "ngi_int_param.yaml"),
        "exterior": str(folder / "io" / "ngi_ext_param.geojson"),
    }
    given = json.loads(Path(files["exterior"]).read_text())["features"]
    assert len(given) == 4
    for feature in given:
        own = feature["properties"]
        scene = open_scene(folder / "ngi" / f"{own['filename']}.tif", SceneOptions(sensor_options=files))
        np.testing.assert_allclose(scene.model.exterior, [*own["xyz"], *own["opk"]], atol=1e-9)
        assert scene.facts["focal_length_px"] == pytest.approx(120 / 92.16 * 640, abs=1e-3)
        # The same as by the table without a header, whose angles have six decimals, and its CRS.
        crs = (folder / "io" / "ngi_xyz_opk.prj").read_text().strip()
        poses = str(folder / "ngi" / "camera_pos_ori.txt")
        table = {**files, "exterior": poses, "frame": "map", "vertical": "ellipsoid", "crs": crs}
        other = open_scene(folder / "ngi" / f"{own['filename']}.tif", SceneOptions(sensor_options=table))
        np.testing.assert_allclose(other.model.exterior, scene.model.exterior, atol=2e-5)


@pytest.mark.realdata
def test_odm_photos_open_along_the_axes_of_utm(real):
    for image in sorted((real / "orthority" / "odm" / "images").glob("*.tif")):
        scene = open_scene(image, SceneOptions(sensor_options={"vertical": "ellipsoid"}))
        tags = open_scene(image, SceneOptions(sensor="photo", sensor_options={"vertical": "ellipsoid"}))
        assert (scene.sensor, scene.model.crs) == ("odm", "EPSG:32651")
        by_tags = ground_transform("EPSG:4979", "EPSG:32651")([tags.model.perspective_centre])[0]
        # RTK positions, and those that OpenDroneMap adjusted with them.
        np.testing.assert_allclose(scene.model.perspective_centre, by_tags, atol=0.06)


@pytest.mark.parametrize("folder", ["odm_orthophoto", "images"])
def test_the_orthophoto_of_a_project_is_a_finished_ortho(tmp_path, folder):
    project(tmp_path, offset=False)
    (tmp_path / folder).mkdir(exist_ok=True)
    place = tmp_path / folder / "odm_orthophoto.tif"
    ortho = gdal.GetDriverByName("GTiff").Create(str(place), 60, 40)
    ortho.SetProjection("EPSG:32636")
    ortho.SetGeoTransform((5e5, 1.0, 0.0, 43e5, 0.0, -1.0))
    ortho = None
    assert commands.info(place)["kind"] == "map image"
    assert open_scene(place, SceneOptions(ortho=True)).sensor == "ortho"
    assert commands.info(tmp_path / "images" / "one.tif")["sensor"] == "odm"
