"""The sensor `photo`: poses and cameras of EXIF and XMP, by directions that the test computes for itself."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from ortho_photo import DATUM_SIGMA
from osgeo import gdal
from photos import DJI, EXIF, jpeg, photo

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.commands.survey.folder import images_of
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.testing import check_sensor_model

#: Metres of a degree of longitude and of latitude at 39.5° N on WGS 84.
METRES = np.array([86_070.0, 111_025.0])
PLACE, ALTITUDE = (33.26, 39.5), 1000.5


def opened(path: Path, **options: str) -> Any:
    given = {"vertical": "ellipsoid", "calibrate": "no", **options}
    return open_scene(path, SceneOptions(sensor_options=given))


def without(tags: dict[str, str], *names: str) -> dict[str, str]:
    return {name: value for name, value in tags.items() if not any(part in name for part in names)}


def looking(scene: Any, image: Any, below: float = 100.0) -> np.ndarray:
    """Return where a pixel sees ground `below` the camera: metres east and north of the camera."""
    ground = scene.model.image_to_ground([image], ALTITUDE - below)[0]
    return (ground[:2] - PLACE) * METRES


def along(yaw: float, forward: float, right: float) -> np.ndarray:
    """Return metres east and north of what is forward and to the right of a heading."""
    s, c = math.sin(math.radians(yaw)), math.cos(math.radians(yaw))
    return np.array([forward * s + right * c, forward * c - right * s])


MIDDLE, TOP, RIGHT = (300.0, 200.0), (300.0, 0.0), (600.0, 200.0)
#: Half of the field of view as tangents: 8.8 mm before a sensor of 13.2 mm with 600 x 400 pixels.
HALF_WIDTH, HALF_HEIGHT = 6.6 / 8.8, 4.4 / 8.8


def test_a_nadir_photo_of_dji_has_its_top_forward(tmp_path):
    scene = opened(photo(tmp_path / "a.tif"))
    assert scene.sensor == "photo"
    np.testing.assert_allclose(scene.model.perspective_centre, [*PLACE, ALTITUDE], atol=1e-8)
    np.testing.assert_allclose(looking(scene, MIDDLE), 0.0, atol=0.02)
    np.testing.assert_allclose(looking(scene, TOP), along(40, 100 * HALF_HEIGHT, 0), atol=0.05)
    np.testing.assert_allclose(looking(scene, RIGHT), along(40, 0, 100 * HALF_WIDTH), atol=0.05)


def test_an_oblique_photo_of_dji_looks_forward(tmp_path):
    scene = opened(photo(tmp_path / "a.tif", xmp={**DJI, "drone-dji:GimbalPitchDegree": "-60.00"}))
    # 30 degrees off the vertical: the middle 57.7 m ahead, the top further, what is right of it to the right.
    np.testing.assert_allclose(looking(scene, MIDDLE), along(40, 100 * math.tan(math.radians(30)), 0), atol=0.05)
    tilt = math.radians(30) + math.atan(HALF_HEIGHT)
    np.testing.assert_allclose(looking(scene, TOP), along(40, 100 * math.tan(tilt), 0), atol=0.2)
    ahead, aside = 100 * math.tan(math.radians(30)), 100 / math.cos(math.radians(30)) * HALF_WIDTH
    np.testing.assert_allclose(looking(scene, RIGHT), along(40, ahead, aside), atol=0.1)


def test_djis_roll_turns_about_the_optical_axis(tmp_path):
    # A gimbal over its pole: yaw and roll of 180 degrees are the heading of 40 degrees again.
    turned = {**DJI, "drone-dji:GimbalYawDegree": "-140.00", "drone-dji:GimbalRollDegree": "180.00"}
    scene = opened(photo(tmp_path / "a.tif", xmp=turned))
    np.testing.assert_allclose(looking(scene, TOP), along(40, 100 * HALF_HEIGHT, 0), atol=0.05)
    # Seen along the axis, a positive roll lowers the right side: what is right of the middle is nearer.
    rolled = {**DJI, "drone-dji:GimbalPitchDegree": "-60.00", "drone-dji:GimbalRollDegree": "10.00"}
    scene = opened(photo(tmp_path / "b.tif", xmp=rolled))
    np.testing.assert_allclose(looking(scene, MIDDLE), along(40, 100 * math.tan(math.radians(30)), 0), atol=0.05)
    left, right = looking(scene, (100.0, 200.0)), looking(scene, (500.0, 200.0))
    assert np.linalg.norm(right) < np.linalg.norm(left)


CAMERA = {"Camera:Yaw": "40", "Camera:Pitch": "30", "Camera:Roll": "0"}


def test_pix4ds_angles_are_zero_at_nadir(tmp_path):
    exif = {**EXIF, "Make": "Parrot"}
    scene = opened(photo(tmp_path / "a.tif", exif, CAMERA))
    np.testing.assert_allclose(looking(scene, MIDDLE), along(40, 100 * math.tan(math.radians(30)), 0), atol=0.05)
    # A positive roll lowers the right wing, so the camera looks to the left.
    scene = opened(photo(tmp_path / "b.tif", exif, {**CAMERA, "Camera:Pitch": "0", "Camera:Roll": "10"}))
    aside = 100 * math.tan(math.radians(10))
    np.testing.assert_allclose(looking(scene, MIDDLE), along(40, 0, -aside), atol=0.05)
    # senseFly writes the roll with the other sign, and the angles of the DLS of MicaSense are not those of the camera.
    sensefly = {"senseFly:Yaw": "40", "senseFly:Pitch": "0", "senseFly:Roll": "10", "DLS:Yaw": "1", "DLS:Pitch": "2"}
    scene = opened(photo(tmp_path / "c.tif", {**EXIF, "Make": "senseFly"}, sensefly))
    np.testing.assert_allclose(looking(scene, MIDDLE), along(40, 0, aside), atol=0.05)


def test_a_pitch_that_is_written_against_its_definition_asks_for_the_option(tmp_path):
    # As an Autel does: Pix4D's tag with zero at the horizon.
    path = photo(tmp_path / "a.tif", {**EXIF, "Make": "Autel Robotics"}, {**CAMERA, "Camera:Pitch": "-90"})
    with pytest.raises(InputError, match="does not look at the ground") as error:
        opened(path)
    assert "pitch=horizon" in error.value.remedy
    np.testing.assert_allclose(looking(opened(path, pitch="horizon"), MIDDLE), 0.0, atol=0.02)
    with pytest.raises(InputError, match="must be horizon or nadir"):
        opened(path, pitch="sky")


@pytest.mark.parametrize(
    ("make", "angle", "refused"),
    [
        ("Autel Robotics", -60, True),
        ("Autel Robotics", -84, True),
        ("Autel Robotics", -4, False),
        ("Autel Robotics", 30, False),
        ("Parrot", -60, False),
    ],
)
def test_a_pitch_of_autel_with_two_readings_asks_for_the_option(tmp_path, make, angle, refused):
    path = photo(tmp_path / "a.tif", {**EXIF, "Make": make}, {**CAMERA, "Camera:Pitch": str(angle)})
    if refused:
        with pytest.raises(
            InputError, match=f"{-angle} degrees backwards from straight down, or {90 + angle} forwards"
        ) as error:
            opened(path)
        assert "pitch=horizon` or `scene.sensor_options.pitch=nadir" in error.value.remedy
        forward = along(40, 100 * math.tan(math.radians(90 + angle)), 0)
        np.testing.assert_allclose(looking(opened(path, pitch="horizon"), MIDDLE), forward, atol=0.05)
    scene = opened(path, pitch="nadir") if refused else opened(path)
    np.testing.assert_allclose(
        looking(scene, MIDDLE), along(40, 100 * math.tan(math.radians(angle)), 0), rtol=0.01, atol=0.05
    )


def test_a_jpeg_is_recognised_and_has_the_same_model(tmp_path):
    scene = opened(jpeg(tmp_path / "a.jpg"))
    same = opened(photo(tmp_path / "a.tif"))
    np.testing.assert_allclose(scene.model.exterior, same.model.exterior, atol=1e-9)
    assert scene.facts["acquired_local"] == "2019-04-11 11:01:21"
    assert scene.facts["camera"] == "DJI FC6310R"
    check_sensor_model(scene.model, scene.model.image_to_ground([[50.0, 60.0], [300.0, 200.0], [550.0, 390.0]], 890.0))


def test_exif_alone_gives_the_position(tmp_path):
    exif = {**EXIF, "GPSLatitudeRef": "S", "GPSLongitudeRef": "W", "GPSAltitudeRef": "0x01", "GPSAltitude": "(80)"}
    scene = opened(photo(tmp_path / "a.tif", exif, without(DJI, "Altitude")))
    np.testing.assert_allclose(scene.model.perspective_centre, [-33.26, -39.5, -80.0], atol=1e-8)


# -- heights and accuracy --------------------------------------------------------------------------------------------


def sigmas(scene: Any) -> list[float]:
    return [scene.priors[name].sigma for name in ("X_L", "Y_L", "Z_L")]


def test_the_height_datum_is_stated_or_unknown_and_never_guessed(tmp_path):
    path = photo(tmp_path / "a.tif")
    unknown = open_scene(path)
    assert [notice.code for notice in unknown.notices] == ["datum-unknown"]
    # The unknown datum, the height by air pressure, and five times a focal length within 2 % of 100 m.
    assert unknown.priors["Z_L"].sigma == pytest.approx(math.hypot(10.0, DATUM_SIGMA))
    assert unknown.model.perspective_centre[2] == pytest.approx(ALTITUDE)
    above_geoid = opened(path, vertical="egm96")
    undulation = float(Vertical.parse("egm96").undulation(np.array([33.26]), np.array([39.5]))[0])
    assert above_geoid.model.perspective_centre[2] == pytest.approx(ALTITUDE + undulation, abs=1e-6)
    assert above_geoid.notices == ()
    stated = open_scene(photo(tmp_path / "b.tif", xmp={**CAMERA, "Camera:VertCS": "ellipsoidal"}))
    assert stated.facts["altitude_datum"] == "ellipsoid"
    assert stated.notices == ()


def test_an_altitude_above_takeoff_counts_from_the_height_of_the_takeoff(tmp_path):
    lacking = photo(tmp_path / "a.tif", without(EXIF, "Altitude"), without(DJI, "Absolute"))
    with pytest.raises(InputError, match=r"no altitude but that above take-off \(100 m\)") as error:
        opened(lacking)
    assert "takeoff=METRES" in error.value.remedy
    rtk = {f"drone-dji:RtkStd{axis}": "0.02" for axis in ("Lon", "Lat", "Hgt")}
    # A position of RTK does not make a height by air pressure better.
    for path in (lacking, photo(tmp_path / "b.tif", xmp={**DJI, **rtk})):
        scene = open_scene(path, SceneOptions(sensor_options={"takeoff": "612.5", "calibrate": "no"}))
        assert scene.model.perspective_centre[2] == pytest.approx(712.5)
        assert scene.facts["altitude_datum"] == "ellipsoid"
        assert scene.priors["Z_L"].sigma == pytest.approx(10.0)
        assert scene.notices == ()
    # Without a tag of its own, the height above take-off is the altitude; the take-off has the datum of the option.
    path = photo(tmp_path / "c.tif", {**EXIF, "GPSAltitude": "(100)"}, without(DJI, "Altitude"))
    undulation = float(Vertical.parse("egm96").undulation(np.array([33.26]), np.array([39.5]))[0])
    scene = opened(path, takeoff="612.5", vertical="egm96")
    assert scene.model.perspective_centre[2] == pytest.approx(712.5 + undulation, abs=1e-6)


def test_an_unknown_altitude_that_may_be_above_takeoff_names_the_option(tmp_path):
    for altitude, named in (("1000.5", False), ("100.5", True)):
        [notice] = open_scene(photo(tmp_path / "a.tif", xmp={**DJI, "drone-dji:AbsoluteAltitude": altitude})).notices
        assert ("takeoff=METRES" in notice) is named


@pytest.mark.parametrize("text", ["orthometric", "EGM 96 Geoid", "EPSG:4326", "../a.gtx"])
def test_a_height_datum_in_other_words_is_unknown(tmp_path, text):
    path = photo(tmp_path / "a.tif", xmp={**CAMERA, "Camera:VertCS": text})
    scene = open_scene(path)
    [notice] = scene.notices
    assert notice.code == "datum-unknown"
    assert f"the tags state an unknown height datum of the camera, '{text}'." in notice
    assert scene.facts["altitude_datum"] == "unknown"
    assert scene.model.perspective_centre[2] == pytest.approx(ALTITUDE)
    assert opened(path, vertical="egm96").notices == ()


@pytest.mark.parametrize(
    ("tags", "wanted"),
    [
        ({}, [3.0, 3.0, 10.0]),
        ({"drone-dji:RtkStdLon": ".05", "drone-dji:RtkStdLat": ".04", "drone-dji:RtkStdHgt": ".1"}, [0.05, 0.05, 0.1]),
        ({"drone-dji:RtkStdLon": "0.002", "drone-dji:RtkStdLat": "0.002", "drone-dji:RtkStdHgt": "0.003"}, [0.02] * 3),
        ({"drone-dji:RtkStdLon": "0", "drone-dji:RtkStdLat": "0", "drone-dji:RtkStdHgt": "0"}, [3.0, 3.0, 10.0]),
        ({"Camera:GPSXYAccuracy": "1.5", "Camera:GPSZAccuracy": "5/2"}, [1.5, 1.5, 2.5]),
    ],
)  # fmt: skip
def test_sigmas_are_those_of_the_tags(tmp_path, tags, wanted):
    scene = opened(photo(tmp_path / "a.tif", xmp={**DJI, **tags}))
    assert sigmas(scene) == pytest.approx(wanted)
    assert scene.priors["omega"].sigma == pytest.approx(math.radians(3.0))
    given = opened(tmp_path / "a.tif", sigmas="0.5,1")
    assert sigmas(given) == pytest.approx([0.5] * 3)
    assert given.priors["kappa"].sigma == pytest.approx(math.radians(1.0))


#: A position in DJI's XMP: that of EXIF, rounded otherwise.
PLACED = {**DJI, "drone-dji:GpsLatitude": "39.50000004", "drone-dji:GpsLongtitude": "33.25999996"}
#: EXIF of a program that replaced the position in EXIF alone: 30.9 m north, 7 m higher.
REPLACED = {**EXIF, "GPSLatitude": "(39) (30) (1)", "GPSAltitude": "(1007.5)", "GPSHPositioningError": "(0.02)"}
RTK = {"drone-dji:RtkStdLon": "0.5", "drone-dji:RtkStdLat": "0.5", "drone-dji:RtkStdHgt": "0.6"}


@pytest.mark.parametrize(
    ("exif", "xmp", "north", "wanted", "used"),
    [
        (REPLACED, PLACED, 30.9, [0.02, 0.02, 10.0], "EXIF"),
        (REPLACED, {**PLACED, **RTK}, 0.0, [0.5, 0.5, 0.6], "DJI's XMP"),
        ({**REPLACED, "GPSHPositioningError": "(0)"}, PLACED, 0.0, [3.0, 3.0, 10.0], "DJI's XMP"),
        (EXIF, {**PLACED, "Camera:GPSXYAccuracy": "1.5", "Camera:GPSZAccuracy": "2"}, 0.0, [1.5, 1.5, 2.0], None),
        (
            without(EXIF, "GPS"),
            {**PLACED, "Camera:GPSXYAccuracy": "1.5", "Camera:GPSZAccuracy": "2"},
            0.0,
            [1.5, 1.5, 2.0],
            None,
        ),
        (EXIF, {**PLACED, "drone-dji:AbsoluteAltitude": "990", **RTK}, 0.0, [0.5, 0.5, 0.6], "DJI's XMP"),
        ({**EXIF, "GPSLatitude": "(x)"}, PLACED, 0.0, [3.0, 3.0, 10.0], None),
    ],
)
def test_an_accuracy_counts_for_the_position_of_its_own_source(tmp_path, exif, xmp, north, wanted, used):
    scene = opened(photo(tmp_path / "a.tif", exif, xmp))
    assert sigmas(scene) == pytest.approx(wanted)
    assert (scene.model.perspective_centre[1] - PLACE[1]) * METRES[1] == pytest.approx(north, abs=0.1)
    assert [notice.fields["used"] for notice in scene.notices] == ([used] if used else [])
    assert all(f"The position in {used} is used" in notice for notice in scene.notices)


@pytest.mark.parametrize(
    ("latitude", "sigma"),
    [
        ("(39) (30) (0.1234)", 0.02),  # 3 mm
        ("(39) (30.1235) (0)", math.hypot(0.02, 0.0001 / 60 * 111_200 / math.sqrt(12))),
        ("(39.5001) (0) (0)", math.hypot(0.02, 0.0001 * 111_200 / math.sqrt(12))),
    ],
)
def test_a_position_in_fractions_of_degrees_is_as_coarse_as_gdal_reads_it(tmp_path, latitude, sigma):
    exif = {**EXIF, "GPSLatitude": latitude, "GPSHPositioningError": "(0.02)"}
    scene = opened(photo(tmp_path / "a.tif", exif))
    assert sigmas(scene)[:2] == pytest.approx([sigma] * 2, rel=0.01)


def test_a_height_from_sea_level_in_exif_is_not_compared_with_djis(tmp_path):
    scene = opened(photo(tmp_path / "a.tif", {**EXIF, "GPSAltitude": "(1030)", "GPSAltitudeRef": "0x02"}, PLACED))
    assert scene.notices == ()
    [notice] = opened(photo(tmp_path / "b.tif", {**EXIF, "GPSAltitude": "(1030)"}, PLACED)).notices
    assert notice.code == "positions-differ"
    assert notice.fields["off_m"]["height"] == pytest.approx(29.5)


@pytest.mark.parametrize("unknown", ["nan", "+NaN", "-inf", "Infinity", "0/0"])
def test_an_optional_number_that_is_not_finite_counts_as_absent(tmp_path, unknown):
    names = ("RelativeAltitude", "RtkStdLon", "RtkStdLat", "RtkStdHgt", "RtkFlag", "CalibratedFocalLength")
    tags = {f"drone-dji:{name}": unknown for name in names} | {"Camera:GPSXYAccuracy": unknown}
    scene = opened(photo(tmp_path / "a.tif", xmp={**DJI, **tags}))
    assert sigmas(scene) == pytest.approx([3.0, 3.0, 10.0])
    assert "altitude_above_takeoff_m" not in scene.facts
    assert scene.model.heights == pytest.approx((ALTITUDE - 500, ALTITUDE - 20))
    with pytest.raises(InputError, match="is not a"):
        opened(photo(tmp_path / "b.tif", xmp={**DJI, "drone-dji:GimbalYawDegree": unknown}))


@pytest.mark.parametrize(("above", "wanted"), [("+0.10", (500, 1)), ("4", (500, 1)), ("5", (10, 1)), ("-3", (500, 20))])
def test_photos_low_above_takeoff_see_near_and_far_ground(tmp_path, above, wanted):
    scene = opened(photo(tmp_path / "a.tif", xmp={**DJI, "drone-dji:RelativeAltitude": above}))
    assert scene.model.heights == pytest.approx([ALTITUDE - below for below in wanted])
    for below in wanted:
        np.testing.assert_allclose(looking(scene, RIGHT, below), along(40, 0, below * HALF_WIDTH), atol=0.001 * below)


def test_photos_share_the_camera_with_sigmas_of_its_source(tmp_path):
    data = "2018-09-07;400,400,0,0,0,0,0,0,0"
    nominal = opened(photo(tmp_path / "a.tif"), calibrate="yes")
    calibrated = opened(photo(tmp_path / "b.tif", xmp={**DJI, "drone-dji:DewarpData": data}), calibrate="yes")
    lens = ("focal_length", "x0", "y0", "k1", "k2", "k3", "p1", "p2")
    film = opened(photo(tmp_path / "film.tif", EXIF | {"Model": "X"}), calibrate="yes")
    for scene, focal, k1 in ((nominal, 0.02, 0.03), (film, 0.03, 0.03), (calibrated, 0.005, 0.01)):
        assert scene.model.param_names[6:] == lens
        assert all(bool(scene.priors[name].shared) == (name in lens) for name in scene.model.param_names)
        assert scene.priors["focal_length"].sigma == pytest.approx(focal * scene.model.interior.focal_length)
        assert scene.priors["k1"].sigma == k1
    # Other cameras have other lenses, even where as much is known of them.
    same = opened(photo(tmp_path / "same.tif"), calibrate="yes")
    assert same.priors["k1"] == nominal.priors["k1"]
    for other in (EXIF | {"Model": "FC330"}, EXIF | {"BodySerialNumber": "2"}, EXIF | {"FocalLength": "(9.1)"}):
        k1 = opened(photo(tmp_path / "other.tif", other), calibrate="yes").priors["k1"]
        assert (k1.mean, k1.sigma) == (0.0, 0.03)
        assert k1 != nominal.priors["k1"]
    fixed = opened(tmp_path / "a.tif", calibrate="no")
    assert fixed.model.param_names == ("X_L", "Y_L", "Z_L", "omega", "phi", "kappa")


@pytest.mark.parametrize(("focal_lengths", "sigma"), [("402,400", 0.005), ("399,400", 0.0025)])
def test_a_calibration_with_pixels_that_are_not_square_is_uncertain_by_that(tmp_path, focal_lengths, sigma):
    data = f"2018-09-07;{focal_lengths},0,0,0,0,0,0,0"
    scene = opened(photo(tmp_path / "a.tif", xmp={**DJI, "drone-dji:DewarpData": data}), calibrate="yes")
    prior, interior = scene.priors["pitch_y"], scene.model.interior
    assert prior.shared
    assert prior.mean == interior.pitch_y != interior.pitch_x
    assert prior.sigma == pytest.approx(sigma * interior.pitch_x)
    assert abs(prior.mean - interior.pitch_x) == pytest.approx(prior.sigma)


# -- cameras ---------------------------------------------------------------------------------------------------------


def test_djis_calibration_is_opencvs_formula(tmp_path):
    numbers = (365.7, 365.1, -4.0, 2.3, -0.267, 0.112, 0.0009, 0.0001, -0.033)
    data = "2018-09-07;" + ",".join(map(str, numbers))
    scene = opened(photo(tmp_path / "a.tif", xmp={**DJI, "drone-dji:DewarpData": data, "drone-dji:DewarpFlag": "0"}))
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    directions = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    x, y = directions.T
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    wanted = np.stack([fx * u + cx + 300, fy * v + cy + 200], axis=1)
    np.testing.assert_allclose(scene.model.interior.image_of(directions), wanted, atol=1e-9)
    # A reduced copy of the photo: all pixels are twice as large.
    half = opened(photo(tmp_path / "b.tif", xmp={**DJI, "drone-dji:DewarpData": data}, size=(300, 200)))
    np.testing.assert_allclose(half.model.interior.image_of(directions), wanted / 2, atol=1e-9)
    # A photo that was dewarped is not distorted.
    dewarped = opened(photo(tmp_path / "c.tif", xmp={**DJI, "drone-dji:DewarpData": data, "drone-dji:DewarpFlag": "1"}))
    assert dewarped.model.interior.k1 == 0.0


PLANE = {"FocalPlaneXResolution": "(50)", "FocalPlaneResolutionUnit": "4"}


@pytest.mark.parametrize(
    ("exif", "xmp", "options", "pixels"),
    [
        ({}, {}, {}, 600 * 8.8 / 13.2),  # the table
        ({}, {}, {"sensor_width": "10"}, 600 * 0.88),
        ({"Model": "X"}, {}, {}, 600 * 24 / 36),
        ({"Model": "X", **PLANE}, {}, {}, 8.8 * 50),
        ({"Model": "X"}, {"drone-dji:CalibratedFocalLength": "366.6"}, {}, 366.6),
        ({"Model": "X", **PLANE}, {"Camera:PerspectiveFocalLength": "5.5"}, {}, 275.0),
    ],
)
def test_focal_lengths_in_the_order_of_their_worth(tmp_path, exif, xmp, options, pixels):
    scene = opened(photo(tmp_path / "a.tif", {**EXIF, **exif}, {**DJI, **xmp}), **options)
    assert scene.facts["focal_length_px"] == pytest.approx(pixels, abs=1e-3)


@pytest.mark.parametrize(
    ("model", "size", "whole"),
    [
        ("FC6310R", (4864, 3648), 5472),  # 4:3 of a sensor of 3:2
        ("FC6310R", (5472, 3078), 5472),  # 16:9
        ("FC6310R", (3648, 5472), 5472),  # stored as a portrait
        ("FC6310R", (608, 456), 684),  # a reduced copy of 4:3, whose tags state the size of the copy
        ("M3E", (5280, 3956), 5280),
    ],
)
def test_a_photo_of_another_shape_is_a_part_of_the_sensor(tmp_path, model, size, whole):
    exif = {**EXIF, "Model": model, "PixelXDimension": str(size[0]), "PixelYDimension": str(size[1])}
    width = {"FC6310R": 13.2, "M3E": 17.3}[model]
    for reduced in (1, 8):
        shown = (size[0] // reduced, size[1] // reduced)
        scene = opened(photo(tmp_path / "a.tif", exif, size=shown))
        assert scene.facts["focal_length_px"] == pytest.approx(8.8 / width * whole / reduced, abs=1e-3)


@pytest.mark.parametrize(("stated", "pixels"), [("402", 400.0), ("450", 450.0)])
def test_djis_focal_length_in_pixels_counts_where_the_known_sensor_contradicts_it(tmp_path, stated, pixels):
    # Some modes show a part of the sensor.
    scene = opened(photo(tmp_path / "a.tif", xmp={**DJI, "drone-dji:CalibratedFocalLength": stated}))
    assert scene.facts["focal_length_px"] == pytest.approx(pixels, abs=1e-3)


DEWARP = {"drone-dji:DewarpData": "2018-09-07;402,402,-1,2,0,0,0,0,0"}
CENTRE = {"drone-dji:CalibratedOpticalCenterX": "300.6", "drone-dji:CalibratedOpticalCenterY": "199.1"}


@pytest.mark.parametrize("calibration", [DEWARP, {"drone-dji:CalibratedFocalLength": "402"}])
@pytest.mark.parametrize("model", ["FC6310R", "X"])
def test_a_reduced_copy_that_states_its_own_size_is_known_by_the_optical_centre(tmp_path, calibration, model):
    exif, calibration = {**EXIF, "Model": model}, {**DJI, **calibration}
    copied = {**exif, "PixelXDimension": "75", "PixelYDimension": "50"}
    whole = opened(photo(tmp_path / "a.tif", exif, {**calibration, **CENTRE}))
    copy = opened(photo(tmp_path / "b.tif", copied, {**calibration, **CENTRE}, size=(75, 50)))
    assert copy.facts["focal_length_px"] == pytest.approx(whole.facts["focal_length_px"] / 8, rel=0.003)
    # Without the centre nothing decides whether the calibration or EXIF is right.
    path = photo(tmp_path / "c.tif", copied, calibration, size=(75, 50))
    with pytest.raises(InputError, match="states a focal length of 402 px, but EXIF one of 50 px") as error:
        opened(path)
    assert "sensor_width=MILLIMETRES" in error.value.remedy
    assert opened(path, sensor_width="13.2").facts["focal_length_px"] == pytest.approx(50, abs=1e-3)


def test_a_photo_that_a_program_turned_is_no_crop(tmp_path):
    """Its tags have the size and the angles of the camera, its pixels are turned by 90 degrees."""
    path = photo(tmp_path / "a.tif", {**EXIF, "PixelXDimension": "600", "PixelYDimension": "400"}, DJI, size=(400, 600))
    with pytest.raises(InputError, match="600 x 400 pixels by its tags, but the file 400 x 600") as error:
        opened(path)
    assert "turned this photo" in error.value.remedy


@pytest.mark.parametrize(("size", "place"), [((400, 600), "6.72,4.36"), ((600, 400), "4.36,6.72")])
def test_a_principal_point_across_shows_a_turned_photo(tmp_path, size, place):
    """A program turned the pixels and rewrote their size in EXIF; the principal point (mm) stayed."""
    pix4d = {"Camera:PerspectiveFocalLength": "8.8", "Camera:PrincipalPoint": place}
    plane = {"FocalPlaneXResolution": "45.4545", "FocalPlaneResolutionUnit": "4"}
    exif = {**EXIF, **plane, "PixelXDimension": str(size[0]), "PixelYDimension": str(size[1])}
    with pytest.raises(InputError, match=f"another shape than {size[0]} x {size[1]} pixels") as error:
        opened(photo(tmp_path / "a.tif", exif, {**DJI, **pix4d}, size=size))
    assert "turned this photo" in error.value.remedy
    assert error.value.field == "Camera:PrincipalPoint"
    exif |= {"PixelXDimension": str(size[1]), "PixelYDimension": str(size[0])}
    opened(photo(tmp_path / "b.tif", exif, {**DJI, **pix4d}, size=size[::-1]))


def test_the_optical_centre_shows_a_crop(tmp_path):
    exif = {**EXIF, "PixelXDimension": "300", "PixelYDimension": "300"}
    path = photo(tmp_path / "a.tif", exif, {**DJI, **DEWARP, **CENTRE}, size=(300, 300))
    with pytest.raises(InputError, match="of a photo of about 601 x 398 pixels, but the photo has 300 x 300"):
        opened(path)
    # Some modes show the middle of the sensor in all its rows.
    exif = {**EXIF, "PixelXDimension": "534", "PixelYDimension": "400"}
    part = opened(photo(tmp_path / "b.tif", exif, {**DJI, **DEWARP, **CENTRE}, size=(534, 400)))
    assert part.facts["focal_length_px"] == pytest.approx(402, abs=1e-3)


@pytest.mark.parametrize(
    ("size", "pixels"),
    [
        ((600, 400), 600 * 24 / 36),
        ((400, 600), 600 * 24 / 36),  # a portrait
        ((600, 450), 750 * 24 / math.hypot(36, 24)),  # 4:3, whose diagonal is 5
        ((608, 342), 608 * 24 / 36),  # 16:9 shows a part of the rows
    ],
)
def test_the_focal_length_in_35_mm_film_is_by_the_diagonal(tmp_path, size, pixels):
    exif = {**EXIF, "Model": "X", "PixelXDimension": str(size[0]), "PixelYDimension": str(size[1])}
    scene = opened(photo(tmp_path / "a.tif", exif, size=size))
    assert scene.facts["focal_length_px"] == pytest.approx(pixels, abs=1e-3)


@pytest.mark.parametrize(("model", "focal", "film"), [("FC330", 3.61, 20), ("FC220", 4.73, 26), ("FC6310", 8.8, 24)])
def test_known_sensors_agree_with_their_focal_length_in_35_mm_film(tmp_path, model, focal, film):
    size = (400, 300) if model != "FC6310" else (600, 400)
    exif = {**EXIF, "FocalLength": f"({focal})", "FocalLengthIn35mmFilm": str(film)}
    exif |= {"PixelXDimension": str(size[0]), "PixelYDimension": str(size[1])}
    pixels = [
        opened(photo(tmp_path / f"{name}.tif", {**exif, "Model": name}, size=size)).facts["focal_length_px"]
        for name in (model, "X")
    ]
    # The tag has whole millimetres.
    assert pixels[1] == pytest.approx(pixels[0], rel=0.03)


def test_a_digital_zoom_is_a_crop_unless_the_width_of_the_part_is_given(tmp_path):
    assert opened(photo(tmp_path / "a.tif", {**EXIF, "DigitalZoomRatio": "(1)"})).facts["focal_length_px"] == 400.0
    zoomed = photo(tmp_path / "b.tif", {**EXIF, "DigitalZoomRatio": "(2)"})
    with pytest.raises(InputError, match="zoomed digitally by 2") as error:
        opened(zoomed)
    assert "divided by 2" in str(error.value.remedy)
    assert opened(zoomed, sensor_width="6.6").facts["focal_length_px"] == 800.0


def test_pix4ds_camera_counts_from_the_corner(tmp_path):
    lens = {
        "Camera:PerspectiveFocalLength": "5.5",
        "Camera:PrincipalPoint": "6.1,3.9",
        "Camera:PerspectiveDistortion": "-0.1,0.02,0.003,0.0004,0.0005",
    }
    scene = opened(photo(tmp_path / "a.tif", {**EXIF, **PLANE}, {**DJI, **lens}))
    # 50 pixels per millimetre.
    np.testing.assert_allclose(scene.model.interior.image_of(np.zeros((1, 2))), [[305.0, 195.0]], atol=1e-9)
    interior = scene.model.interior
    found = (interior.k1, interior.k2, interior.k3, interior.p1, interior.p2)
    assert found == pytest.approx((-0.1, 0.02, 0.003, 0.0004, 0.0005))


@pytest.mark.parametrize(("length", "units"), [("5.5", "mm"), ("275", "pixel")])
def test_pix4ds_focal_length_has_the_unit_that_is_stated(tmp_path, length, units):
    lens = {"Camera:PerspectiveFocalLength": length, "Camera:PerspectiveFocalLengthUnits": units}
    scene = opened(photo(tmp_path / "a.tif", {**EXIF, **PLANE}, {**DJI, **lens}))
    assert scene.facts["focal_length_px"] == pytest.approx(275.0)


# -- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("exif", "xmp", "message"),
    [
        (without(EXIF, "GPS"), DJI, "no position"),
        ({**EXIF, "GPSLatitude": "(0) (0) (0)", "GPSLongitude": "(0) (0) (0)"}, DJI, "no position"),
        ({**EXIF, "GPSLatitude": "(139) (0) (0)"}, DJI, "not on Earth"),
        ({**EXIF, "GPSLatitude": "(nan) (0) (0)"}, DJI, "'nan' is not a number"),
        ({**EXIF, "GPSLatitude": "(1) (2) (3) (4)"}, DJI, "4 numbers are not an angle"),
        ({**EXIF, "GPSLongitudeRef": "Oeste"}, DJI, "must be E or W, but it is 'Oeste'"),
        (without(EXIF, "LatitudeRef"), DJI, "GPSLatitudeRef: this tag is missing"),
        (without(EXIF, "Altitude"), without(DJI, "Altitude"), "no altitude"),
        (EXIF, {**DJI, "drone-dji:AbsoluteAltitude": "1e7"}, "is impossible"),
        (EXIF, without(DJI, "Gimbal"), "no camera angles"),
        (EXIF, without(DJI, "Roll"), "one of yaw, pitch and roll is missing"),
        (EXIF, {**DJI, "drone-dji:GimbalYawDegree": "0", "drone-dji:GimbalPitchDegree": "0"}, "does not record them"),
        (EXIF, {**DJI, "drone-dji:GimbalPitchDegree": "20"}, "does not look at the ground"),
        (EXIF, {**DJI, "Camera:ModelType": "fisheye"}, "a fisheye"),
        (EXIF, {**DJI, "GPano:ProjectionType": "equirectangular"}, r"a panorama \(equirectangular\)"),
        ({**EXIF, "PixelXDimension": "1200"}, DJI, "crops are not supported|by its tags"),
        ({**without(EXIF, "35mm"), "Model": "X"}, DJI, r"sensor of this camera \(X\) is not known"),
        (EXIF, {**DJI, "drone-dji:DewarpData": "x;1,2,3"}, "3 numbers instead of 9"),
        (EXIF, {**DJI, "drone-dji:DewarpData": "x;0,1,2,3,4,5,6,7,8"}, "must be positive"),
        (EXIF, "<x:xmpmeta", "not well-formed XML"),
        (EXIF, '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "not well-formed XML"),
        (EXIF, "<a>" + "x" * 1_100_000 + "</a>", "larger than 1 MB"),
    ],
)
def test_damaged_or_missing_tags_are_one_error_each(tmp_path, exif, xmp, message):
    path = photo(tmp_path / "a.tif", exif, xmp)
    with pytest.raises(InputError, match=message) as error:
        open_scene(path, SceneOptions(sensor="photo"))
    assert str(error.value.file) == str(path)
    assert error.value.remedy


@pytest.mark.parametrize(
    ("option", "value"),
    [("sensor_width", "x"), ("sigmas", "1"), ("heights", "9,1"), ("calibrate", "x"), ("takeoff", "x")],
)
def test_wrong_options_are_errors(tmp_path, option, value):
    with pytest.raises(InputError) as error:
        opened(photo(tmp_path / "a.tif"), **{option: value})
    assert error.value.field == option


def test_a_folder_stands_for_its_photos_and_says_what_they_lack(tmp_path):
    folder = tmp_path / "my photos"
    folder.mkdir()
    one, _ = photo(folder / "a.tif"), photo(folder / "b.tif", xmp=without(DJI, "Gimbal"))
    with pytest.raises(InputError, match=r"1 scene, .*b.tif: .*no camera angles") as error:
        images_of([folder], SceneOptions())
    assert "ortho info" in error.value.remedy
    other = photo(folder / "c.tif")
    third = jpeg(folder / "e.jpeg")
    (folder / "d.jpg").write_bytes(third.read_bytes()[:100])
    found, [notice] = images_of([folder], SceneOptions())
    assert found == [one, other, third]
    assert notice.code == "images-left-out"
    assert "2 images of the folder cannot be used: b.tif: " in notice
    assert "no camera angles; d.jpg: cannot be opened" in notice
    assert notice.fields == {"count": 2, "images": ["b.tif", "d.jpg"]}
    assert images_of([one], SceneOptions()) == ([one], [])
    shown = CliRunner().invoke(cli, ["info", str(folder)]).output
    assert f"ortho adjust '{folder}' --ties auto" in shown
    assert "no camera angles" in shown


def test_photos_in_formats_that_are_not_read_are_named_unless_they_have_a_copy(tmp_path):
    for name in ("a.DNG", "b.dng", "c.HEIC", "notes.txt"):
        (tmp_path / name).write_bytes(b"II*\0")
    with pytest.raises(InputError, match=r"0 scenes.*; a.DNG: photos in this format are not read.*; b.dng: .*; c.HEIC"):
        images_of([tmp_path], SceneOptions())
    photo(tmp_path / "a.TIF")
    photo(tmp_path / "b.tif", {**EXIF, "GPSAltitude": "(1001)"})
    found, [notice] = images_of([tmp_path], SceneOptions())
    assert [Path(path).name for path in found] == ["a.TIF", "b.tif"]
    assert notice.fields["images"] == ["c.HEIC"]


def test_the_width_of_a_sensor_is_its_longer_side_also_in_portraits(tmp_path):
    size = {"PixelXDimension": "400", "PixelYDimension": "600"}
    for path in (photo(tmp_path / "a.tif"), photo(tmp_path / "b.tif", {**EXIF, **size}, size=(400, 600))):
        assert opened(path, sensor_width="13.2").facts["focal_length_px"] == pytest.approx(400, abs=1e-3)


def test_an_altitude_above_takeoff_that_is_below_the_dem_asks_for_the_takeoff(tmp_path):
    """The rays of such a camera meet nothing, so neither overlap nor place of the DEM is what is wrong."""
    low = {**DJI, "drone-dji:AbsoluteAltitude": "+100.00"}
    turned = {**low, "drone-dji:GimbalYawDegree": "+50.00"}
    files = [str(photo(tmp_path / f"{name}.tif", EXIF, xmp)) for name, xmp in (("a", low), ("b", turned))]
    dem = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "dem.tif"), 200, 200, 1, gdal.GDT_Float32)
    dem.SetGeoTransform((33.25, 1e-4, 0, 39.51, 0, -1e-4))
    dem.SetProjection("EPSG:4326")
    dem.GetRasterBand(1).Fill(900.0)
    dem = None
    words = ["--dem", str(tmp_path / "dem.tif"), "--dem-vertical", "ellipsoid", "-o", str(tmp_path / "out")]
    for command in (["rectify", files[0]], ["adjust", *files, "--ties", "auto"]):
        done = CliRunner().invoke(cli, [*command, *words])
        assert done.exit_code == 2
        assert "the camera is 800 m below the ground" in done.output
        assert "--sensor-option takeoff=METRES" in done.output
    done = CliRunner().invoke(cli, ["rectify", files[0], *words, "--sensor-option", "takeoff=900"])
    assert done.exit_code == 0, done.output


def test_photos_that_do_not_overlap_are_an_error(tmp_path):
    far = {**EXIF, "GPSLongitude": "(33) (45) (0)"}
    files = [str(photo(tmp_path / "a.tif")), str(photo(tmp_path / "b.tif", far, without(DJI, "Gps")))]
    words = ["--sensor-option", "vertical=ellipsoid", "--ties", "auto", "--height", "900", "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(cli, ["adjust", *files, *words])
    assert done.exit_code == 2
    assert "no two of these images overlap" in done.output
