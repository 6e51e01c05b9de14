"""The rigorous line scanner against vendors' metadata, location grids and RPCs; its reader against damaged files."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from measured import points_of
from ortho_rpc.dimap import has_dimap_pushbroom, read_dimap_pushbroom
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.exchange.rpc_files import read_rpc_text
from ortho_pipeline.geodesy.ellipsoid import geocentric
from ortho_pipeline.host import open_scene
from ortho_pipeline.models import RPC, Pushbroom
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.pushbroom.metadata import pushbroom_of_metadata
from ortho_pipeline.models.pushbroom.splines import SplineForm
from ortho_pipeline.testing import check_sensor_model

SCENE = "P1BP--2018122638935449CP"
#: Orbit of Pleiades, m.
ALTITUDE = 694e3


@pytest.fixture(scope="module")
def dimap(real: Path) -> Path:
    return real / "shareloc" / "rpc" / f"PHRDIMAP_{SCENE}.XML"


def grid_of(path: Path) -> tuple[Array, Array]:
    """Return the image points ``(n, 2)`` and the ground ``(heights, n, 3)`` of a location grid."""
    dataset = gdal.Open(str(path))
    x0, dx, _, y0, _, dy = dataset.GetGeoTransform()
    values = dataset.ReadAsArray()
    row, column = np.indices(values.shape[1:])
    image = np.stack([x0 + dx * column, y0 + dy * row], axis=-1).reshape(-1, 2)
    ground = []
    for band in range(0, len(values), 2):
        height = float(dataset.GetMetadataItem(f"ALTITUDE_B{band}"))
        lon, lat = values[band].ravel(), values[band + 1].ravel()
        ground.append(np.column_stack([lon, lat, np.full(len(lon), height)]))
    return image, np.array(ground)


@pytest.mark.realdata
def test_the_vendors_location_grid_to_a_millimetre(real: Path, dimap: Path) -> None:
    model = read_dimap_pushbroom(dimap)
    image, ground = grid_of(real / "shareloc" / "ellipsoide" / SCENE / f"GRID_{SCENE}.tif")
    assert ground.shape == (9, 65 * 65, 3)
    for level in ground:
        found = model.image_to_ground(image, level[:, 2])
        distance = np.linalg.norm(geocentric(found) - geocentric(level), axis=1)
        assert distance.max() < 0.5e-3
        assert np.abs(model.ground_to_image(level) - image).max() < 1e-3


@pytest.mark.realdata
def test_it_keeps_the_contract(dimap: Path) -> None:
    model = read_dimap_pushbroom(dimap)
    centre, half = model.domain
    signs = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3))
    check_sensor_model(model, centre + signs * half)
    assert model.param_names == (
        "roll_offset", "pitch_offset", "yaw_offset", "roll_drift", "pitch_drift", "yaw_drift",
    )  # fmt: skip


@pytest.mark.realdata
def test_perturbed_and_readjusted_from_nine_points(dimap: Path) -> None:
    model = read_dimap_pushbroom(dimap)
    generator = np.random.default_rng(0)
    size = np.array([model.camera.width, model.camera.height])
    at = np.stack(np.meshgrid(*[(0.1, 0.5, 0.9)] * 2), axis=-1).reshape(-1, 2) * size
    ground = model.image_to_ground(at, generator.uniform(*model.heights, 9))
    wrong = replace(
        model,
        path_line=np.array([[8.0, -5.0, 4.0], [0.0, 0.0, 0.0]]),
        attitude_line=np.array([[3e-5, -2e-5, 5e-5], [5e-6, 4e-6, -8e-6]]),
    )
    check = generator.uniform(0, 1, (300, 2)) * size
    place = model.image_to_ground(check, generator.uniform(*model.heights, 300))
    assert np.abs(wrong.ground_to_image(place) - check).max() > 20
    found = fit(wrong, points_of(at + generator.normal(0, 0.2, (9, 2)), ground, 0.2), robust=False)
    assert np.sqrt(((found.model.ground_to_image(place) - check) ** 2).mean()) < 0.4


def _look_angles(rpc: RPC, size: Array) -> tuple[float, float]:
    """Return the angles (degrees) along and across the track under which an RPC looks, from its own rays."""
    low, high = rpc.height_range
    middle = size[None] / 2
    bottom, top = (geocentric(rpc.image_to_ground(middle, height))[0] for height in (low, high))
    view = (bottom - top) / np.linalg.norm(bottom - top)
    first, last = geocentric(rpc.image_to_ground(size * [[0.5, 0.0], [0.5, 1.0]], (low + high) / 2))
    radius = np.linalg.norm(bottom) + ALTITUDE
    back = bottom @ view + np.sqrt((bottom @ view) ** 2 - bottom @ bottom + radius**2)
    up = (bottom - back * view) / radius
    left = np.cross(up, last - first)
    left /= np.linalg.norm(left)
    forward = np.cross(left, up)
    down = -view @ up
    return float(np.degrees(np.arctan2(view @ forward, down))), float(np.degrees(np.arctan2(-view @ left, down)))


@pytest.mark.realdata
@pytest.mark.parametrize(
    "name",
    [
        "RPC_P1BP--2017092838284574CP.XML",
        "RPC_P1BP--2017092838319324CP.XML",
        "phr_ventoux/RPC_PHR1B_P_201308051042194_SEN_690908101-001.XML",
    ],
)
def test_fitted_to_a_real_rpc(real: Path, name: str) -> None:
    """The RPC as observations on a grid of heights; the start is its corners, look angles and the orbit's height."""
    rpc = read_rpc_text(real / "shareloc" / "rpc" / name)
    size = np.round(2 * np.array([rpc.col_scale, rpc.row_scale])) + 1
    low, high = rpc.height_range

    def lattice(count: int, levels: int) -> tuple[Array, Array]:
        steps = np.linspace(0, 1, count)
        column, row, height = np.meshgrid(steps * size[0], steps * size[1], np.linspace(low, high, levels))
        image = np.column_stack([column.ravel(), row.ravel()])
        return image, rpc.image_to_ground(image, height.ravel())

    along, across = _look_angles(rpc, size)
    corners = rpc.image_to_ground(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size, (low + high) / 2)
    start = pushbroom_of_metadata(
        corners, int(size[0]), int(size[1]), altitude=ALTITUDE, along_deg=along, across_deg=across,
        heights=(low, high), splines=SplineForm(3), corrections=(4, 0),
    )  # fmt: skip
    image, ground = lattice(9, 5)
    assert np.abs(start.ground_to_image(ground) - image).max() < 100
    # The vendor's line is straight in angles, not in their tangents: one pixel at its ends.
    model = start.freed("path", "attitude", "focal_length", "dx_2", "dx_3")
    found = fit(model, points_of(image, ground, 1e-3), robust=False)
    check, place = lattice(14, 4)
    assert np.abs(found.model.ground_to_image(place) - check).max() < 0.01


# -- reading ---------------------------------------------------------------------------------------------------------

DIMAP = """<?xml version="1.0" encoding="UTF-8"?>
<PHR_Dimap_Document>
  <Raster_Dimensions><NROWS>400</NROWS><NCOLS>300</NCOLS></Raster_Dimensions>
  <Geometric_Data><Sensor_Model_Characteristics>
    <UTC_Sensor_Model_Range><START>2020-12-31T23:59:59.9990000Z</START></UTC_Sensor_Model_Range>
    <Sensor_Ephemeris><Point_List>{points}</Point_List></Sensor_Ephemeris>
    <Sensor_Attitudes><Polynomial_Models>
      <Q0><DEGREE>1</DEGREE><COEFFICIENTS>0.70710678 1e-6</COEFFICIENTS></Q0>
      <Q1><DEGREE>0</DEGREE><COEFFICIENTS>0.0</COEFFICIENTS></Q1>
      <Q2><DEGREE>0</DEGREE><COEFFICIENTS>-0.70710678</COEFFICIENTS></Q2>
      <Q3><DEGREE>0</DEGREE><COEFFICIENTS>0.0</COEFFICIENTS></Q3>
    </Polynomial_Models><OFFSET>86400.0</OFFSET><SCALE>1.0</SCALE></Sensor_Attitudes>
    <SENSOR_LINE_PERIOD>0.07</SENSOR_LINE_PERIOD>
    <Sensor_Viewing_Model><Viewing_Directions>
      <PsiX_Model><DEGREE>1</DEGREE><COEFFICIENTS>-0.0001 7e-07</COEFFICIENTS></PsiX_Model>
      <PsiY_Model><DEGREE>0</DEGREE><COEFFICIENTS>8e-05</COEFFICIENTS></PsiY_Model>
    </Viewing_Directions></Sensor_Viewing_Model>
  </Sensor_Model_Characteristics></Geometric_Data>
</PHR_Dimap_Document>
"""


def dimap_text() -> str:
    """Return metadata of a flight northwards along the Greenwich meridian, over the equator at New Year."""
    points = ""
    for seconds in range(-120, 121, 30):
        angle = 1.06e-3 * seconds
        moment = datetime(2021, 1, 1) + timedelta(seconds=seconds)
        place = f"{7.07e6 * math.cos(angle)!r} 0.0 {7.07e6 * math.sin(angle)!r}"
        points += f"<Point><LOCATION_VALUES>{place}</LOCATION_VALUES>"
        points += f"<UTC_TIME>{moment.isoformat()}.000000Z</UTC_TIME></Point>"
    return DIMAP.format(points=points)


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """Write the metadata of a flight that everybody can follow in their head."""
    path = tmp_path / "DIM_SIMULATED.XML"
    path.write_text(dimap_text())
    return path


def test_directions_and_times_of_a_simple_flight(made: Path) -> None:
    model = read_dimap_pushbroom(made)
    # The centre of row 14.29 is exposed at midnight, 14.29 periods after START, over the equator; psi_Y looks forward.
    row = 0.5 + 1e-3 / 7e-5
    column = 0.5 + 0.0001 / 7e-7
    lon, lat, _ = model.image_to_ground([[column, row]], 0.0)[0]
    altitude = 7.07e6 - 6378137.0
    assert lon == pytest.approx(0.0, abs=1e-9)
    assert lat == pytest.approx(np.degrees(8e-5 * altitude / 6335439.0), rel=1e-3)
    # Flying north, columns run to the left, the west; later rows lie north.
    west, north = model.image_to_ground([[column + 100, row], [column, row + 100]], 0.0)
    assert west[0] == pytest.approx(-np.degrees(100 * 7e-7 * altitude / 6378137.0), rel=1e-6)
    assert north[1] > lat
    check_sensor_model(model, model.domain[0] + np.random.default_rng(0).uniform(-0.5, 0.5, (9, 3)) * model.domain[1])


def _image(folder: Path, width: int, height: int) -> Path:
    path = folder / "image.tif"
    one, zero = np.eye(20)[0], np.zeros(20)
    column, row = zero.copy(), zero.copy()
    column[1], row[2] = 1.0, -1.0
    # The middle of the made flight: 0.001 degrees north of where it begins.
    rpc = RPC(150.0, 200.0, 0.0, 0.0012, 500.0, 150.0, 200.0, 0.001, 0.001, 500.0, column, one, row, one)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), width, height, 1)
    dataset.SetMetadata(rpc_metadata(rpc), "RPC")
    dataset = None
    return path


def test_the_scene_has_it_as_its_second_model(made: Path) -> None:
    scene = open_scene(_image(made.parent, 300, 400))
    assert list(scene.models) == ["rpc", "pushbroom"]
    assert isinstance(scene.models["pushbroom"], Pushbroom)


def test_metadata_of_another_image_are_left_alone(made: Path) -> None:
    assert list(open_scene(_image(made.parent, 200, 400)).models) == ["rpc"]


def test_two_of_them_and_damaged_ones_are_said(made: Path) -> None:
    image = _image(made.parent, 300, 400)
    (made.parent / "DIM_COPY.XML").write_text(dimap_text())
    scene = open_scene(image)
    assert list(scene.models) == ["rpc"]
    assert any("several rigorous models" in text for text in scene.warnings)
    (made.parent / "DIM_COPY.XML").write_text(dimap_text().replace("<SCALE>1.0", "<SCALE>0"))
    scene = open_scene(image)
    assert list(scene.models) == ["rpc", "pushbroom"]
    assert any("is not used" in text for text in scene.warnings)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("<NROWS>400", "<NROWS>400.5", "NROWS"),
        ("<NROWS>400", "<NROWS>2000000000", "NROWS"),
        ("<NCOLS>300</NCOLS>", "", "NCOLS"),
        ("<OFFSET>86400.0", "<OFFSET>nan", "OFFSET"),
        ("<OFFSET>86400.0", "<OFFSET>1e400", "OFFSET"),
        ("<SCALE>1.0", "<SCALE>0", "SCALE"),
        ("<Q0><DEGREE>1", "<Q0><DEGREE>2", "Q0"),
        ("0.07</SENSOR", "-0.07</SENSOR", "SENSOR_LINE_PERIOD"),
        ("23:59:59.9990000Z", "25:59:59Z", "START"),
        ("2020-12-31T23:59:59", "1020-12-31T23:59:59", "orbit"),
        ("<COEFFICIENTS>-0.0001 7e-07", "<COEFFICIENTS>-0.0001 0", "across"),
        ("-0.70710678", "0.0", "Sensor_Attitudes"),
        ("Sensor_Model_Characteristics", "Other", "Geometric_Data"),
        # A part of the line, or of the pass: how columns and rows then count is not documented.
        (
            "<Sensor_Viewing_Model>",
            "<Sensor_Viewing_Model><Position_In_Retina><FIRST_COL>5001</FIRST_COL></Position_In_Retina>",
            "Position_In_Retina",
        ),
        ("</START>", "</START><END>2021-01-01T00:00:00.1</END>", "UTC_Sensor_Model_Range"),
        ("<PHR_Dimap_Document>", "<!DOCTYPE x [<!ENTITY a 'b'>]><PHR_Dimap_Document>", None),
    ],
)
def test_damaged_metadata(made: Path, old: str, new: str, field: str | None) -> None:
    text = dimap_text()
    assert old in text
    made.write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_dimap_pushbroom(made)
    assert caught.value.file is not None
    assert field is None or field in str(caught.value.field)


def test_too_large_missing_or_no_xml(made: Path) -> None:
    made.write_bytes(dimap_text().encode() + b" " * 5_000_000)
    with pytest.raises(InputError, match="5 MB"):
        read_dimap_pushbroom(made)
    assert not has_dimap_pushbroom(made)
    made.write_bytes(b"\0\xff")
    with pytest.raises(InputError):
        read_dimap_pushbroom(made)
    with pytest.raises(InputError):
        read_dimap_pushbroom(made.parent / "missing.XML")
    assert not has_dimap_pushbroom(made.parent)


def test_mutations_give_a_model_or_a_typed_error(made: Path) -> None:
    generator = random.Random(0)
    text = dimap_text()
    refused = 0
    for _ in range(300):
        damaged = list(text)
        for _ in range(generator.randint(1, 4)):
            at = generator.randrange(len(damaged))
            damaged[at] = generator.choice(["", "9", "-", "<", "e99", "nan", "\0", "é", damaged[at] * 3])
        made.write_text("".join(damaged))
        try:
            model = read_dimap_pushbroom(made)
        except InputError:
            refused += 1
            continue
        assert np.isfinite(model.path.coefficients).all()
        assert np.isfinite(model.attitude.coefficients).all()
    assert 0 < refused < 300
