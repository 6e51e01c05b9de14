"""CARTOSAT-1: the metadata, the layouts of a delivery, the plugin, and the start of a pushbroom."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import ortho_cartosat
import pytest
from ortho_cartosat.layout import partner_of, rpc_of
from ortho_cartosat.metadata import read_metadata
from ortho_studies.cartosat import truth as simulated
from ortho_studies.cartosat.truth import StereoPair, aim
from ortho_studies.simulation.earth import EARTH_A
from osgeo import gdal

from ortho_pipeline.errors import DegeneratePoints, InputError
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.exchange.rpc_files import read_rpc_text, rpc_metadata
from ortho_pipeline.host import open_scene
from ortho_pipeline.models.pushbroom.metadata import SoftSigmas
from ortho_pipeline.points import read_points
from ortho_pipeline.points.selection import select_control
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.testing import check_sensor

SENSOR = next(iter(ortho_cartosat.ortho_sensors()))


@pytest.fixture
def pair_folder(sample):
    """The small pair of the sample data."""
    return sample / "cartosat"


def deliver(source: Path, folder: Path, names: dict[str, str]) -> Path:
    """Copy files of the sample under other names."""
    folder.mkdir(parents=True, exist_ok=True)
    for old, new in names.items():
        shutil.copy(source / old, folder / new)
    return folder


def named(stem: str, side: str = "A", met: str = "_MET.TXT", rpc: str = "_RPC.TXT") -> dict[str, str]:
    band = f"BAND{side}"
    return {f"{band}.tif": f"{stem}.tif", f"{band}_MET.TXT": f"{stem}{met}", f"{band}_RPC.TXT": f"{stem}{rpc}"}


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


# -- metadata --------------------------------------------------------------------------------------------------------


def metadata(tmp_path: Path, text: str):
    path = tmp_path / "X_MET.TXT"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_metadata(path)


def test_metadata_are_read_with_tolerance(tmp_path):
    read = metadata(
        tmp_path,
        "\ufeffCARTOSAT-1 PRODUCT METADATA\r\n=====\r\nSatID=  IRS-P5 \r\n  sensor\t= PAN_F\r\nNoPixels   =12000 px\r\n"
        'NoScans =12000\r\nSatelliteAltitude= +638.5E0 km\r\nSceneCenterRoll = -NA-\r\nProductID = "A = B"\r\n'
        "SceneCenterTime = 01-OCT-2006  00:13:22.512345678\r\nDateOfPass=01-OCT-2006\r\nDateOfPass = 01-OCT-2006\r\n",
    )
    assert read.is_cartosat1
    assert read.view == "fore"
    assert read.size == (12000, 12000)
    assert read.altitude == 638500.0
    assert read.number("SceneCenterRoll") is None
    assert read.text("PRODUCTID") == "A = B"
    assert read.text("DateOfPass") == "01-OCT-2006"
    assert read.acquired == "2006-10-01T00:13:22.512345Z"
    assert read.corners is None


@pytest.mark.parametrize(
    ("name", "ours"),
    [("CARTOSAT-1", True), ("Cartosat1A", True), ("IRS-P5", True), ("C1", True), ("CARTOSAT-2", False), ("P6", False),
     ("CARTOSAT-12", False), ("-NA-", False)],
)  # fmt: skip
def test_the_satellite_decides(tmp_path, name, ours):
    assert metadata(tmp_path, f"SatID = {name}\n").is_cartosat1 is ours


@pytest.mark.parametrize(
    ("text", "ask", "field"),
    [
        ("NoPixels = many\nNoScans = 1\n", lambda read: read.size, "NoPixels"),
        ("NoPixels = 1e400\nNoScans = 1\n", lambda read: read.size, "NoPixels"),
        ("NoPixels = nan\nNoScans = 1\n", lambda read: read.size, "NoPixels"),
        ("SatelliteAltitude = 638,5\n", lambda read: read.altitude, "SatelliteAltitude"),
        ("SatelliteAltitude = 638000\n", lambda read: read.altitude, "SatelliteAltitude"),
        ("SatID = A\nSatID = B\n", lambda read: read.is_cartosat1, "SatID"),
        ("ImageULLat = 1\nImageULLon = 2\nImageURLat = 1\n", lambda read: read.corners, "ImageUR"),
        ("ImageULLon = 147 18 33.2\n", lambda read: read.corners, "ImageULLon"),
        ("ImageULLat = 91\n", lambda read: read.corners, "ImageULLat"),
        ("ViewAngleAlongTrack = 1_0\n", lambda read: read.view, "ViewAngleAlongTrack"),
    ],
)
def test_errors_name_file_and_key(tmp_path, text, ask, field):
    with pytest.raises(InputError) as caught:
        ask(metadata(tmp_path, text))
    assert caught.value.field == field
    assert str(caught.value.file).endswith("X_MET.TXT")


@pytest.mark.parametrize("data", [b"", b"no assignment\n", b"SatID = A\0", b"=\n", b"SatID = A\n" * 200_000])
def test_what_is_no_metadata_is_a_typed_error(tmp_path, data):
    with pytest.raises(InputError, match="X_MET"):
        metadata(tmp_path, data)
    with pytest.raises(InputError):
        read_metadata(tmp_path / "absent_MET.TXT")


def test_mutated_metadata_give_typed_errors_or_scenes(pair_folder, tmp_path):
    folder = deliver(pair_folder, tmp_path / "own", named("BANDA"))
    text = (folder / "BANDA_MET.TXT").read_bytes()
    dataset = open_dataset(folder / "BANDA.tif")
    random = np.random.default_rng(0)
    opened = 0
    for _ in range(80):
        mutated = bytearray(text)
        for place in random.integers(0, len(text), random.integers(1, 12)):
            mutated[place] = random.choice(np.frombuffer(b"0123456789.-+eE=\n\t\0 \xffnaifLU", dtype=np.uint8))
        (folder / "BANDA_MET.TXT").write_bytes(bytes(mutated))
        SENSOR.recognises(dataset)
        try:
            scene = SENSOR.open_scene(dataset)
        except InputError:
            continue
        opened += 1
        for model in scene.models.values():
            assert np.isfinite(model.params).all()
    assert opened > 50


def test_corners_of_the_product_stand_in_for_those_of_the_image(pair_folder, tmp_path):
    read = read_metadata(pair_folder / "BANDA_MET.TXT")
    assert read.corners.shape == (4, 2)
    path = tmp_path / "B_MET.TXT"
    path.write_text((pair_folder / "BANDA_MET.TXT").read_text().replace("Image", "Else"))
    box = read_metadata(path).corners
    np.testing.assert_array_equal(box.min(axis=0), read.corners.min(axis=0))
    np.testing.assert_array_equal(box[0], [read.corners[:, 0].min(), read.corners[:, 1].max()])


# -- the plugin ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", ["fore", "aft"])
def test_the_sample_keeps_the_contract(pair_folder, view):
    band, other = ("BANDF", "BANDA") if view == "fore" else ("BANDA", "BANDF")
    scene = check_sensor(SENSOR, pair_folder / f"{band}.tif")
    assert list(scene.models) == ["rpc", "pushbroom"]
    assert scene.model_source == str(pair_folder / f"{band}_RPC.TXT")
    assert scene.facts["view"] == view
    assert scene.facts["partner"] == str(pair_folder / f"{other}.tif")
    assert scene.facts["acquired"] == "2006-10-01T00:13:22.512345Z"
    assert "heading_deg" not in scene.facts
    assert scene.warnings == ()
    assert open_scene(pair_folder / f"{band}.tif").sensor == "cartosat"


@pytest.mark.parametrize("layout", ["names", "lower case", "folders", "products"])
def test_every_layout_is_recognised_and_its_pair_found(pair_folder, tmp_path, layout):
    if layout == "names":
        folder = deliver(pair_folder, tmp_path, named("hobart_A") | named("hobart_F", "F"))
        images = folder / "hobart_A.tif", folder / "hobart_F.tif"
    elif layout == "lower case":
        small = {"met": "_met.txt", "rpc": "_rpc.txt"}
        folder = deliver(pair_folder, tmp_path, named("banda", **small) | named("bandf", "F", **small))
        images = folder / "banda.tif", folder / "bandf.tif"
    elif layout == "folders":
        deliver(pair_folder, tmp_path / "one", named("BANDA"))
        deliver(pair_folder, tmp_path / "two", named("BANDF", "F"))
        images = tmp_path / "one" / "BANDA.tif", tmp_path / "two" / "BANDF.tif"
    else:
        for folder, side in (("aft", "A"), ("fore", "F")):
            names = named("PRODUCT", side) | {f"BAND{side}_MET.TXT": "product_met.txt"}
            deliver(pair_folder, tmp_path / folder, names)
        images = tmp_path / "aft" / "PRODUCT.tif", tmp_path / "fore" / "PRODUCT.tif"
    for image, other, view in ((*images, "aft"), (*images[::-1], "fore")):
        scene = open_scene(image)
        assert scene.sensor == "cartosat"
        assert (scene.facts["view"], scene.facts["partner"]) == (view, str(other))
        assert "rpc" in scene.models


def test_another_pass_is_no_partner(pair_folder, tmp_path):
    folder = deliver(pair_folder, tmp_path / "own", named("BANDA") | named("BANDF", "F"))
    edit(folder / "BANDF_MET.TXT", "01-OCT-2006", "02-OCT-2006")
    assert partner_of(folder / "BANDA.tif", read_metadata(folder / "BANDA_MET.TXT")) is None
    assert "partner" not in open_scene(folder / "BANDA.tif").facts
    # One in a folder beside is, of two copies nobody knows which.
    copy = deliver(pair_folder, tmp_path / "copy", named("BANDF", "F"))
    assert open_scene(folder / "BANDA.tif").facts["partner"] == str(copy / "BANDF.tif")
    deliver(pair_folder, tmp_path / "second copy", named("BANDF", "F"))
    assert "partner" not in open_scene(folder / "BANDA.tif").facts


def test_the_first_rpc_that_can_be_read_is_taken(pair_folder, tmp_path):
    folder = deliver(pair_folder, tmp_path, named("BANDA"))
    image, plain = folder / "BANDA.tif", folder / "BANDA_RPC.TXT"
    decrypted = folder / "DECRYPTED_BANDA_RPC.TXT"
    plain.rename(decrypted)
    plain.write_bytes(bytes(range(256)) * 20)
    scene = check_sensor(SENSOR, image)
    assert scene.model_source == str(decrypted)
    original = folder / "BANDA_RPC_ORG.TXT"
    original.write_text(decrypted.read_text().replace("LINE_OFF: 1", "LINE_OFF: 2"))
    scene = open_scene(image)
    assert scene.model_source == str(original)
    assert scene.models["rpc"].row_off == read_rpc_text(decrypted).row_off + 100
    original.write_text("LINE_OFF: nothing\n")
    scene = open_scene(image)
    assert scene.model_source == str(decrypted)
    assert "BANDA_RPC_ORG.TXT" in scene.warnings[0]
    assert "LINE_OFF" in scene.warnings[0]
    # Whatever else lies there can be chosen.
    assert open_scene(image, options={"rpc": str(decrypted)}).model_source == str(decrypted)


def test_a_tag_that_contradicts_the_file_is_an_error(pair_folder, tmp_path):
    folder = deliver(pair_folder, tmp_path, named("BANDA"))
    image, text = folder / "BANDA.tif", folder / "BANDA_RPC.TXT"
    rpc = read_rpc_text(text)
    dataset = gdal.OpenEx(str(image), gdal.OF_UPDATE, sibling_files=[image.name])
    dataset.SetMetadata(rpc_metadata(rpc.shifted(0.0, 9.0)), "RPC")
    dataset = None
    with pytest.raises(InputError, match=r"differ by 9\.0 px"):
        open_scene(image)
    lines = [open_scene(image, options={"rpc": choice}).model.row_off for choice in ("tag", str(text))]
    assert lines == pytest.approx([rpc.row_off - 9.0, rpc.row_off])


def test_gdal_finds_another_rpc_than_the_plugin_and_that_is_said(pair_folder, tmp_path):
    folder = deliver(pair_folder, tmp_path, named("BANDA"))
    text = (folder / "BANDA_RPC.TXT").read_text()
    # Without "pixels" and the like, as vendors write it as well, and moved by 7 lines.
    offset = read_rpc_text(folder / "BANDA_RPC.TXT").row_off - 0.5
    (folder / "BANDA_RPC_ORG.TXT").write_text(text.replace(f"LINE_OFF: {offset!r} pixels", f"LINE_OFF: {offset + 7!r}"))
    # GDAL looks for <name>_RPC.TXT only beside products that it knows, or in the PAM file.
    dataset = open_dataset(folder / "BANDA.tif")
    if not dataset.GetMetadata("RPC"):
        pytest.skip("this GDAL does not read _RPC.TXT next to a TIFF")
    assert float(dataset.GetMetadataItem("LINE_OFF", "RPC").split()[0]) == pytest.approx(offset)
    scene = open_scene(folder / "BANDA.tif")
    assert any("GDAL reads another one" in warning and "7.0 px" in warning for warning in scene.warnings)


def test_an_image_without_a_readable_rpc_opens_with_the_pushbroom(pair_folder, tmp_path):
    folder = deliver(pair_folder, tmp_path, named("BANDF", "F"))
    (folder / "BANDF_RPC.TXT").write_bytes(b"\x93\x11\x00encrypted" * 300)
    scene = check_sensor(SENSOR, folder / "BANDF.tif")
    assert list(scene.models) == ["pushbroom"]
    assert scene.model_source == str(folder / "BANDF_MET.TXT")
    assert any("BANDF_RPC.TXT" in warning for warning in scene.warnings)
    assert any("nine control points" in warning for warning in scene.warnings)
    edit(folder / "BANDF_MET.TXT", "SatelliteAltitude", "SatelliteAttitude")
    with pytest.raises(InputError) as caught:
        open_scene(folder / "BANDF.tif")
    assert caught.value.field == "SatelliteAltitude"
    # With an RPC that is only a warning.
    shutil.copy(pair_folder / "BANDF_RPC.TXT", folder)
    assert any("no pushbroom" in warning for warning in open_scene(folder / "BANDF.tif").warnings)


def test_the_origin_of_the_rpc_is_a_choice(pair_folder):
    image = pair_folder / "BANDA.tif"
    zero, one = (open_scene(image, options={"rpc_origin": origin}).models["rpc"] for origin in ("0", "1"))
    ground = np.array([[zero.lon_off, zero.lat_off, zero.h_off]])
    np.testing.assert_allclose(zero.ground_to_image(ground) - one.ground_to_image(ground), 1.0, atol=1e-12)
    for options, field in (({"rpc_origin": "2"}, "rpc_origin"), ({"view": "nadir"}, "view")):
        with pytest.raises(InputError) as caught:
            open_scene(image, options=options)
        assert caught.value.field == field


def test_name_and_metadata_may_not_contradict_each_other(pair_folder, tmp_path):
    folder = deliver(pair_folder, tmp_path, named("BANDF", "A"))
    with pytest.raises(InputError, match="the fore image by its file name, but the aft image by its metadata"):
        open_scene(folder / "BANDF.tif")
    assert open_scene(folder / "BANDF.tif", options={"view": "aft"}).facts["view"] == "aft"
    # A name that says nothing leaves it to the sensor, that to the angle, and then there is no pushbroom.
    folder = deliver(pair_folder, tmp_path / "b", named("hobart"))
    assert open_scene(folder / "hobart.tif").facts["view"] == "aft"
    edit(folder / "hobart_MET.TXT", "PAN_AFT", "PAN")
    assert open_scene(folder / "hobart.tif").facts["view"] == "aft"
    edit(folder / "hobart_MET.TXT", "ViewAngleAlongTrack", "Else")
    scene = open_scene(folder / "hobart.tif")
    assert "view" not in scene.facts
    assert list(scene.models) == ["rpc"]


def test_what_is_not_ours_is_not_recognised(pair_folder, tmp_path, sample):
    assert not SENSOR.recognises(open_dataset(sample / "scene.tif"))
    folder = deliver(pair_folder, tmp_path, named("BANDA"))
    dataset = open_dataset(folder / "BANDA.tif")
    edit(folder / "BANDA_MET.TXT", "CARTOSAT-1", "CARTOSAT-2")
    assert not SENSOR.recognises(dataset)
    (folder / "BANDA_MET.TXT").write_bytes(b"\0")
    assert not SENSOR.recognises(dataset)
    # Taken by name, it says what is missing.
    (folder / "BANDA_MET.TXT").unlink()
    with pytest.raises(InputError, match="no metadata"):
        open_scene(folder / "BANDA.tif", "cartosat")
    assert not SENSOR.recognises(gdal.GetDriverByName("MEM").Create("", 3, 3))
    assert rpc_of("x" * 300 + ".tif") == (None, None, [])


def test_crops_and_damaged_facts_are_warnings(pair_folder, tmp_path):
    folder = deliver(pair_folder, tmp_path, named("BANDA"))
    edit(folder / "BANDA_MET.TXT", "NoScans = 400", "NoScans = 12000")
    edit(folder / "BANDA_MET.TXT", "41.650000", "high")
    warnings = " ".join(open_scene(folder / "BANDA.tif").warnings)
    assert "Is it a crop" in warnings
    assert "SunElevationAtCenter" in warnings


# -- the start of a pushbroom ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", ["fore", "aft"])
def test_metadata_place_an_image_within_500_pixels(view, tmp_path):
    from ortho_cartosat.start import pushbroom
    from ortho_studies.cartosat.simulation import metadata_text

    pair = StereoPair.make(seed=1)
    path = tmp_path / "BAND_MET.TXT"
    path.write_text(metadata_text(pair, view))
    model = pushbroom(read_metadata(path), view, (pair.size, pair.size), (-50.0, 1400.0))
    miss = model.ground_to_image(pair.ground) - pair.image(view)
    assert 5 < np.abs(miss).max() < 500
    # The sign of the angle differs between processors; the camera does not.
    edit(path, f"{simulated.TILTS_DEG[view]:.6f}", f"{-simulated.TILTS_DEG[view]:.6f}")
    other = pushbroom(read_metadata(path), view, (pair.size, pair.size), (-50.0, 1400.0))
    np.testing.assert_array_equal(other.params, model.params)


def test_heights_of_the_satellite_are_as_the_scene_has_them():
    # What the experiments call 618 km is above the ground of the scene, not above the equator.
    camera = aim("aft")
    assert camera.radius < EARTH_A + 618e3


# -- soft constraints ------------------------------------------------------------------------------------------------


def fitted(folder, view: str, count: int, **options: str):
    """Fit the pushbroom of the pair in a folder to so many of all its 69 points, evenly chosen."""
    image = folder / {"fore": "BANDF.tif", "aft": "BANDA.tif"}[view]
    points = read_points(folder / "points.csv", image_name=image.name)
    points = points.with_roles(np.full(len(points), "control"))
    scene = open_scene(image, "cartosat", options)
    return fit(scene.models["pushbroom"], select_control(points, f"even:{count}"))


NO_ATTITUDE = {"sigma_attitude_deg": "none", "sigma_rate_rad_s": "none"}


@pytest.mark.slow
@pytest.mark.parametrize("view", ["fore", "aft"])
def test_without_the_constraints_of_attitude_nine_points_determine_nothing(pair_folder, view):
    assert fitted(pair_folder, view, 9).rmse("check").total < 1.0
    with pytest.raises(DegeneratePoints):
        fitted(pair_folder, view, 9, **NO_ATTITUDE)


def test_soft_constraints_are_set_left_out_and_told(pair_folder):
    image = pair_folder / "BANDF.tif"
    plain = open_scene(image)
    assert plain.facts["soft_constraints"] == {
        "sigma_plane_m": 10.0, "sigma_circle_rad": 0.001, "sigma_altitude_m": 20000.0, "sigma_attitude_deg": 0.5,
        "sigma_rate_rad_s": 1e-4,
    }  # fmt: skip
    assert len(plain.models["pushbroom"].constraints()) == 2 + 2 + 1 + 3 + 6
    options = {**NO_ATTITUDE, "sigma_altitude_m": "None", "sigma_plane_m": "2.5"}
    scene = open_scene(image, "cartosat", options)
    model = scene.models["pushbroom"]
    assert scene.facts["soft_constraints"] == {
        "sigma_plane_m": 2.5, "sigma_circle_rad": 0.001, "sigma_altitude_m": None, "sigma_attitude_deg": None,
        "sigma_rate_rad_s": None,
    }  # fmt: skip
    assert len(model.constraints()) == 2 + 2
    np.testing.assert_allclose(model.constraints().sigma[:2], 2.5)


@pytest.mark.parametrize("option", ["sigma_plane_m", "sigma_rate_rad_s"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "1e400", "much", ""])
def test_a_sigma_is_a_positive_number_or_none(pair_folder, option, value):
    with pytest.raises(InputError) as caught:
        open_scene(pair_folder / "BANDF.tif", "cartosat", {option: value})
    assert caught.value.field == option
    assert "none" in caught.value.remedy
    with pytest.raises(InputError, match="is not a sigma"):
        SoftSigmas(rate=-1.0)
