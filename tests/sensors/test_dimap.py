"""DIMAP 2: the rigorous model against the vendors' own numbers, against its conventions written down again, damaged."""

from __future__ import annotations

import json
import math
import random
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from ortho_rpc.dimap import has_dimap_pushbroom, read_dimap_pushbroom
from osgeo import gdal
from products import bundle_text, dimap_product
from scipy.spatial.transform import Rotation
from seeds import dimap_text, rpc_xml
from seeds import rpc as seed_rpc
from used import pixels, used

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.control import command
from ortho_pipeline.commands.control.points import read_control
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.survey.folder import survey
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.exchange.rpc_files import read_rpc_text, write_rpc_txt
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric
from ortho_pipeline.host import open_scene
from ortho_pipeline.models import RPC, Pushbroom
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.light import LightPath
from ortho_pipeline.options import MatchOptions, PointOptions, SurfaceOptions
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.testing import check_sensor_model

PLEIADES = "DIM_PHR1A_P_201303310839568_SEN_620285101-001.XML"
TILES = [f"IMG_PHR1A_P_201303310839568_SEN_620285101-001_R1C{k}.TIF" for k in (1, 2)]


@pytest.fixture
def pleiades(real: Path) -> Path:
    return real / "sensors" / "pleiades" / PLEIADES


@pytest.fixture
def spot(real: Path) -> Path:
    return real / "sensors" / "cosicorr3d" / "SPOT6.XML"


# -- the conventions, written down again -----------------------------------------------------------------------------


class Written:
    """Rays of a `Refined_Model` straight from its conventions; shares nothing with the engine."""

    def __init__(self, path: Path, tangent: bool = False) -> None:
        root = ElementTree.parse(path).getroot()
        model = root.find("Geometric_Data/Refined_Model")
        assert model is not None
        self.tangent = tangent
        self.start = self.seconds(model.findtext("Time/Time_Range/START"))
        stamp = model.find("Time/Time_Stamp/LINE_PERIOD")
        self.period = float(stamp.text) * (1e-6 if stamp.get("unit") == "microsecond" else 1e-3)
        points = model.findall("Ephemeris/Point_List/Point")
        self.times = np.array([self.seconds(point.findtext("TIME")) for point in points])
        self.places = np.array([[float(n) for n in point.findtext("LOCATION_XYZ").split()] for point in points])
        polynomials = model.find("Attitudes/Polynomial_Quaternions")
        if polynomials is not None:
            self.offset, self.scale = (float(polynomials.findtext(name)) for name in ("OFFSET", "SCALE"))
            self.terms = [[float(n) for n in polynomials.findtext(f"Q{k}/COEFFICIENTS").split()] for k in range(4)]
        self.listed = [
            (self.seconds(entry.findtext("TIME")), [float(entry.findtext(f"Q{k}")) for k in range(4)])
            for entry in model.findall("Attitudes/Quaternion_List/Quaternion")
        ]
        angles = next(model.iter("Polynomial_Look_Angles"), ())
        self.x, self.y = ([float(e.text) for e in angles if e.tag.startswith(name)] for name in ("XLOS", "YLOS"))

    @staticmethod
    def seconds(text: str) -> float:
        hours, minutes, seconds = text.rstrip("Z").split("T")[1].split(":")
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds)

    def ray(self, column: float, row: float) -> tuple[Array, Array]:
        """Return position and direction (ECEF) of a place of the image, (1, 1) the centre of the first pixel."""
        place, (w, x, y, z) = self.pose(row)
        psi_x, psi_y = (sum(c * (column - 1) ** k for k, c in enumerate(terms)) for terms in (self.x, self.y))
        if self.tangent:
            psi_x, psi_y = math.tan(psi_x), math.tan(psi_y)
        v, q = np.array([psi_y, -psi_x, 1.0]), np.array([x, y, z])
        turned = (w * w - q @ q) * v + 2 * (q @ v) * q + 2 * w * np.cross(q, v)
        return place, turned / np.linalg.norm(turned)

    def pose(self, row: float) -> tuple[Array, tuple[float, ...]]:
        """Return position (ECEF) and quaternion, scalar first, of a row counted from 1."""
        time = self.start + (row - 1) * self.period
        first = int(np.clip(np.searchsorted(self.times, time) - 4, 0, len(self.times) - 8))
        near = self.times[first : first + 8]
        weights = [math.prod((time - b) / (a - b) for b in near if b != a) for a in near]
        place = np.array(weights) @ self.places[first : first + 8]
        if self.listed:
            at = np.array([entry[0] for entry in self.listed])
            return place, tuple(np.interp(time, at, [entry[1][k] for entry in self.listed]) for k in range(4))
        return place, tuple(np.polyval(part[::-1], (time - self.offset) / self.scale) for part in self.terms)


def vertices(path: Path) -> Array:
    """Return lon, lat, column, row of the corners (and the centre) that the vendor gives."""
    extent = ElementTree.parse(path).getroot().find("Dataset_Content/Dataset_Extent")
    assert extent is not None
    names = ("LON", "LAT", "COL", "ROW")
    return np.array([[float(v.findtext(n)) for n in names] for v in extent if v.tag in ("Vertex", "Center")])


def passing(rays: tuple[Array, Array], lon: float, lat: float) -> tuple[float, float]:
    """Return by how much (m) a ray misses the vertical at lon, lat, and at which height it is nearest."""
    (place, direction), spot = rays, np.array([[lon, lat, 0.0]])
    up = enu_from_ecef(spot)[0, 2]
    across = np.cross(direction, up)
    across /= np.linalg.norm(across)
    solved = np.linalg.solve(np.column_stack([direction, -up, across]), geocentric(spot)[0] - place)
    return float(solved[2]), float(solved[1])


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["pleiades", "spot"])
def test_rays_are_those_of_the_conventions(name: str, request: pytest.FixtureRequest) -> None:
    path = request.getfixturevalue(name)
    model, written = read_dimap_pushbroom(path), Written(path)
    size = np.array([model.camera.width, model.camera.height])
    image = np.vstack([np.random.default_rng(0).uniform(0, 1, (200, 2)) * size, np.array([[0.5, 0.5], size - 0.5])])
    places, directions = model.rays(image)
    for k, (column, row) in enumerate(image + 0.5):
        place, direction = written.ray(column, row)
        # The times of SPOT are rounded to microseconds, 7 mm of orbit, which the smooth path does not follow; its
        # quaternions are joined by cubics here and by straight lines there.
        assert np.linalg.norm(places[k] - place) < (1e-6 if name == "pleiades" else 1e-2)
        apart = np.linalg.norm(np.cross(directions[k], direction)) * 760e3
        assert apart < (1.3e-5 if name == "pleiades" else 0.05)


@pytest.mark.realdata
def test_pleiades_passes_the_vendors_vertices_without_tangents(pleiades: Path) -> None:
    """Vertices have no heights, so a ray can only pass beside; they are the outer corners of the corner pixels."""
    model, tangents = read_dimap_pushbroom(pleiades), Written(pleiades, tangent=True)
    corners = vertices(pleiades)[:4]
    for lon, lat, column, row in corners:
        outer = np.array([column - (column == 1), row - (row == 1)])
        (place,), (direction,) = model.rays(outer[None])
        miss, height = passing((place, direction), lon, lat)
        assert abs(miss) < 1.5e-3
        assert 0 < height < 800
        assert abs(passing(tangents.ray(*(outer + 0.5)), lon, lat)[0]) > 0.2


@pytest.mark.realdata
def test_spot_meets_the_vendors_vertices_at_one_height(spot: Path) -> None:
    """They are centres of pixels at the height of the scene; a microsecond of the file's times is 7 mm of orbit."""
    model = read_dimap_pushbroom(spot)
    heights = []
    for lon, lat, column, row in vertices(spot):
        (place,), (direction,) = model.rays([[column - 0.5, row - 0.5]])
        miss, height = passing((place, direction), lon, lat)
        assert abs(miss) < 7e-3
        heights.append(height)
    assert np.ptp(heights) < 0.05


@pytest.mark.realdata
def test_a_tile_is_a_window_of_the_whole(pleiades: Path) -> None:
    whole = read_dimap_pushbroom(pleiades)
    image = np.random.default_rng(0).uniform(0, 8000, (20, 2))
    for name, left, width in ((TILES[0], 0, 32000), (TILES[1].lower(), 32000, 8000)):
        tile = read_dimap_pushbroom(pleiades, image=name)
        assert (tile.camera.width, tile.camera.height) == (width, 15872)
        for ours, theirs in zip(tile.rays(image), whole.rays(image + np.array([left, 0])), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-9)


@pytest.mark.realdata
def test_it_keeps_the_contract(pleiades: Path) -> None:
    model = read_dimap_pushbroom(pleiades, heights=(0.0, 1000.0))
    assert model.heights == (0.0, 1000.0)
    centre, half = model.domain
    check_sensor_model(model, centre + np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3)) * half)


def _image(path: Path, model: Pushbroom, apart: float = 0.0) -> Path:
    """Write an image of the model's size, its RPC a plain one that fits the model in the middle."""
    width, height = model.camera.width, model.camera.height
    middle, other, below = model.image_to_ground(
        np.array([[0, 0], [1, 0], [0, 1]]) * 100.0 + np.array([width, height]) / 2, 100.0
    )
    slopes = np.linalg.inv(np.column_stack([other - middle, below - middle])[:2] / 100.0)
    one, zero = np.eye(20)[0], np.zeros(20)
    column, row = zero.copy(), zero.copy()
    column[1:3], row[1:3] = slopes[0] * 0.1 / (width / 2), slopes[1] * 0.1 / (height / 2)
    rpc = RPC(width / 2 + apart, height / 2, middle[0], middle[1], 100.0, width / 2, height / 2, 0.1, 0.1, 500.0,
              column, one, row, one)  # fmt: skip
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), width, height, 1, options=["SPARSE_OK=TRUE"])
    dataset.SetMetadata(rpc_metadata(rpc), "RPC")
    return path


def info(path: Path) -> tuple[dict, str]:
    """Return the document of `ortho info`, and its text with the warnings."""
    runner = CliRunner()
    document = runner.invoke(cli, ["info", str(path), "--json"])
    text = runner.invoke(cli, ["info", str(path)])
    assert document.exit_code == text.exit_code == 0, document.output
    return json.loads(document.stdout), text.output


@pytest.mark.realdata
def test_info_of_a_pleiades_tile_names_its_rigorous_model(pleiades: Path, tmp_path: Path) -> None:
    shutil.copy(pleiades, tmp_path)
    image = _image(tmp_path / TILES[1], read_dimap_pushbroom(pleiades, image=TILES[1]))
    document, _ = info(image)
    assert document["models"] == {"rpc": "rpc", "pushbroom": "pushbroom"}
    assert document["facts"]["rigorous_model"] == PLEIADES
    assert not document["warnings"]
    assert [path.name for path in open_scene(image).sources] == [PLEIADES]


@pytest.mark.realdata
def test_info_says_which_rigorous_model_is_not_read_and_why(real: Path, pleiades: Path, tmp_path: Path) -> None:
    neo = real / "sensors" / "asp_plot" / "pleiades" / "DIM_PNEO3_202111071029126_PAN_trimmed.XML"
    shutil.copy(neo, tmp_path)
    shutil.copy(pleiades, tmp_path)
    image = _image(tmp_path / "crop.tif", read_dimap_pushbroom(pleiades, image=TILES[1]))
    document, text = info(image)
    assert document["models"] == {"rpc": "rpc"}
    reasons = document["facts"]["rigorous_models_not_read"]
    assert set(reasons) == {neo.name, PLEIADES}
    assert "XLOS_0" in reasons[neo.name]  # this file was shortened
    assert "40000 x 15872 pixels, but this image has 8000 x 15872" in reasons[PLEIADES]
    for name in reasons:
        assert f"the rigorous model in {name} is not used: " in text
        assert any(name in warning for warning in document["warnings"])


# -- made metadata ---------------------------------------------------------------------------------------------------


@pytest.fixture(params=[False, True], ids=["polynomials", "list"])
def made(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "DIM_SIMULATED.XML"
    path.write_text(dimap_text(listed=request.param))
    return path


def test_directions_and_times_of_a_simple_flight(made: Path) -> None:
    assert has_dimap_pushbroom(made)
    model = read_dimap_pushbroom(made)
    # The first centre is exposed at noon over the equator; psi_Y looks forward.
    column = 0.5 + 0.0001 / 7e-7
    lon, lat, _ = model.image_to_ground([[column, 0.5]], 0.0)[0]
    altitude = 7.07e6 - 6378137.0
    assert lon == pytest.approx(0.0, abs=1e-9)
    assert lat == pytest.approx(np.degrees(8e-5 * altitude / 6335439.0), rel=2e-2)
    # Flying north, columns run to the left, the west; later rows lie north by what the satellite goes in the time.
    west, north = model.image_to_ground([[column + 100, 0.5], [column, 100.5]], 0.0)
    assert west[0] == pytest.approx(-np.degrees(100 * 7e-7 * altitude / 6378137.0), rel=1e-6)
    assert north[1] > lat


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("<NROWS>400", "<NROWS>400.5", "NROWS"),
        ("<NROWS>400", "<NROWS>500", "Time_Range"),
        ("<NCOLS>300</NCOLS>", "", "NCOLS"),
        ("PHR_SENSOR", "PER1_SENSOR", "METADATA_PROFILE"),
        ("<METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE>", "", "METADATA_PROFILE"),
        ("<OFFSET>43200.05", "<OFFSET>nan", "OFFSET"),
        ("<OFFSET>43200.05", "<OFFSET>1e400", "OFFSET"),
        ("<OFFSET>43200.05", "<OFFSET>-1e9", "Polynomial_Quaternions"),
        ("<SCALE>1.0", "<SCALE>0", "SCALE"),
        ("<Q0><DEGREE>1", "<Q0><DEGREE>2", "Q0"),
        ("0.70710678 1e-6", "0.8 1e-6", "Polynomial_Quaternions"),
        ("<LINE_PERIOD>", "<LINE_PERIOD unit='hour'>", "LINE_PERIOD"),
        ("<LINE_PERIOD>0.07", "<LINE_PERIOD unit='microsecond'>0.07", "Time_Range"),
        ("<LINE_PERIOD>0.07", "<LINE_PERIOD>-0.07", "LINE_PERIOD"),
        ("T12:00:00.0000000Z", "T25:00:00Z", "START"),
        ("<FIRST_COL>1<", "<FIRST_COL>5001<", "Swath_Range"),
        ("<LAST_COL>300<", "<LAST_COL>400<", "Swath_Range"),
        ("<YAW>0.0", "<YAW>0.1", "YAW"),
        ("<XLOS_0>-0.0001</XLOS_0>", "", "XLOS_0"),
        ("<XLOS_1>7e-07</XLOS_1>", "<XLOS_2>7e-07</XLOS_2>", "XLOS_1"),
        ("<XLOS_1>7e-07", "<XLOS_1>0", "across"),
        ("Refined_Model", "Other", "Refined_Model"),
        ("<Dimap_Document>", "<!DOCTYPE x [<!ENTITY a 'b'>]><Dimap_Document>", None),
    ],
)
def test_damaged_metadata(tmp_path: Path, old: str, new: str, field: str | None) -> None:
    path, text = tmp_path / "DIM_X.XML", dimap_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_dimap_pushbroom(path)
    assert caught.value.file == str(path)
    assert field is None or field in str(caught.value.field)


def test_shortened_lists_and_bands_of_their_own_are_refused(tmp_path: Path) -> None:
    path, text = tmp_path / "DIM_X.XML", dimap_text(listed=True)
    path.write_text(re.sub(r"<Quaternion>.*?</Quaternion>", "", text))
    with pytest.raises(InputError, match="neither a polynomial nor a list"):
        read_dimap_pushbroom(path)
    early = re.findall(r"<Quaternion>.*?</Quaternion>", text)[:6]
    path.write_text(text.replace("".join(early), ""))
    with pytest.raises(InputError) as caught:
        read_dimap_pushbroom(path)
    assert caught.value.field == "attitude"
    band = re.search(r"<Band_Calibration>.*?</Band_Calibration>", text, re.DOTALL)
    assert band is not None
    path.write_text(text.replace(band[0], band[0] + band[0]))
    read_dimap_pushbroom(path)
    path.write_text(text.replace(band[0], band[0] + band[0].replace("8e-05", "9e-05")))
    with pytest.raises(InputError, match="each band has its own look angles"):
        read_dimap_pushbroom(path)


TILED = (
    '<Raster_Dimensions><NROWS>400</NROWS><NCOLS>300</NCOLS><Tile_Set><Regular_Tiling><NTILES_SIZE nrows="400"'
    ' ncols="200"/><OVERLAP_ROW>0</OVERLAP_ROW><OVERLAP_COL>0</OVERLAP_COL></Regular_Tiling></Tile_Set>'
    "</Raster_Dimensions><Data_Access><Data_Files>"
    '<Data_File tile_R="1" tile_C="1"><DATA_FILE_PATH href="a_R1C1.TIF"/></Data_File>'
    '<Data_File tile_R="1" tile_C="2"><DATA_FILE_PATH href="a_R1C2.TIF"/></Data_File></Data_Files></Data_Access>'
)
UNTILED = "<Raster_Dimensions><NROWS>400</NROWS><NCOLS>300</NCOLS></Raster_Dimensions>"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<OVERLAP_COL>0", "<OVERLAP_COL>10"),
        ('tile_C="2"', 'tile_C="9"'),
        ('tile_C="2"', 'tile_C="0"'),
        ('tile_C="2"', 'tile_C="٢"'),
        ('tile_C="2"', 'tile_C="99999999999"'),
        (' ncols="200"', ""),
    ],
)
def test_damaged_tiles(tmp_path: Path, old: str, new: str) -> None:
    path, text = tmp_path / "DIM_X.XML", dimap_text().replace(UNTILED, TILED)
    path.write_text(text)
    assert read_dimap_pushbroom(path, image="A_R1C2.tif").camera.width == 100
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_dimap_pushbroom(path, image="a_R1C2.TIF")
    assert "Tiling" in str(caught.value.field)


def test_metadata_that_name_another_image_are_not_taken(tmp_path: Path) -> None:
    """Both images of a stereo pair have the same size: the names decide."""
    path = tmp_path / "DIM_A.XML"
    path.write_text(dimap_text())
    model = read_dimap_pushbroom(path)
    image, other = _image(tmp_path / "b.tif", model), tmp_path / "a.tif"
    assert list(open_scene(image).models) == ["rpc", "pushbroom"]
    files = '<Data_Access><Data_Files><Data_File><DATA_FILE_PATH href="A.TIF"/></Data_File></Data_Files></Data_Access>'
    path.write_text(dimap_text().replace("</Raster_Data>", f"{files}</Raster_Data>"))
    _image(other, model)
    assert list(open_scene(image).models) == ["rpc"]
    assert list(open_scene(other).models) == ["rpc", "pushbroom"]


def test_metadata_in_an_archive_are_those_on_disk(tmp_path: Path) -> None:
    folder = tmp_path / "delivery"
    folder.mkdir()
    (folder / "DIM_A.XML").write_text(dimap_text())
    image = _image(folder / "a.tif", read_dimap_pushbroom(folder / "DIM_A.XML"))
    inside = f"/vsizip/{shutil.make_archive(str(tmp_path / 'order'), 'zip', folder)}"
    here, there = open_scene(image), open_scene(f"{inside}/a.tif")
    assert list(here.models) == list(there.models) == ["rpc", "pushbroom"]
    assert here.models["pushbroom"].to_dict() == there.models["pushbroom"].to_dict()
    assert list(map(str, there.sources)) == [f"{inside}/DIM_A.XML"]


def test_a_model_far_off_the_rpc_is_of_another_image(tmp_path: Path) -> None:
    path = tmp_path / "DIM_A.XML"
    path.write_text(dimap_text())
    scene = open_scene(_image(tmp_path / "a.tif", read_dimap_pushbroom(path), apart=150.0))
    assert list(scene.models) == ["rpc"]
    assert any("150 px off the RPC" in warning for warning in scene.warnings)


def mutated(text: str, generator: random.Random) -> str:
    """Return text with a few damages, of which many stay well-formed XML."""
    damaged = list(text)
    for _ in range(generator.randint(1, 4)):
        at = generator.randrange(len(damaged))
        damaged[at] = generator.choice(
            ["", "9", "-", "0", "e9", "<", "e99", "nan", "\0", "é", "1e400", damaged[at] * 3]
        )
    return "".join(damaged)


def read_mutations(path: Path, text: str, count: int) -> int:
    """Return how many of so many mutations are refused with their file; those that are read have to be finite."""
    generator, refused = random.Random(0), 0
    for _ in range(count):
        path.write_text(mutated(text, generator))
        has_dimap_pushbroom(path)
        try:
            model = read_dimap_pushbroom(path)
        except InputError as error:
            refused += error.file == str(path)
            continue
        assert np.isfinite(model.path.coefficients).all()
        assert np.isfinite(model.attitude.coefficients).all()
        assert np.isfinite(model.camera.values).all()
    return refused


def test_mutations_give_a_model_or_a_typed_error(made: Path) -> None:
    assert 0 < read_mutations(made, made.read_text(), 150) < 150


@pytest.mark.realdata
@pytest.mark.slow
def test_three_thousand_mutations_of_the_real_file(pleiades: Path, tmp_path: Path) -> None:
    """Within the geometry, which is a tenth of the file: the rest changes nothing."""
    text = pleiades.read_text()
    at = text.index("<Geometric_Data>")
    end = text.index("<Use_Area>")
    path, generator, refused = tmp_path / "DIM_X.XML", random.Random(1), 0
    for _ in range(3000):
        path.write_text(text[:at] + mutated(text[at:end], generator) + text[end:])
        try:
            model = read_dimap_pushbroom(path)
        except InputError as error:
            refused += error.file == str(path)
            continue
        assert np.isfinite(np.concatenate([model.path.coefficients, model.attitude.coefficients])).all()
    assert 300 < refused < 2900


# -- tiles, folders, Pleiades Neo ------------------------------------------------------------------------------------


@pytest.fixture
def tiled(tmp_path: Path) -> tuple[Path, Path, Pushbroom]:
    """Two tiles of a scene with its metadata and RPC, and its model."""
    folder = tmp_path / "scene"
    folder.mkdir()
    dimap_product(folder)
    model = read_dimap_pushbroom(folder / "DIM_A.XML").with_heights(190.0, 220.0)
    centre, half = model.domain
    box = (centre[0] - half[0], centre[1] - half[1], centre[0] + half[0], centre[1] + half[1])
    return *dimap_product(folder, fit_rpc(model, box, (190.0, 220.0), grid=(7, 7, 4)).rpc), model


def test_tiles_count_as_one_image(tiled: tuple[Path, Path, Pushbroom]) -> None:
    first, second, model = tiled
    scene = open_scene(second)
    assert [(Path(piece.path).name, piece.offset, piece.size) for piece in scene.pieces] == [
        (first.name, (-200, 0), (200, 400))
    ]
    image = np.array([[10.0, 20.0], [90.0, 390.0]])
    ground = model.image_to_ground(image + np.array([200.0, 0.0]), 205.0)
    for each in scene.models.values():
        assert np.abs(each.ground_to_image(ground) - image).max() < 1e-3


@pytest.mark.driver("DIMAP")
@pytest.mark.parametrize("given", ["DIM_A.XML", ""], ids=["metadata", "folder"])
def test_metadata_or_folder_in_place_of_an_image(tiled: tuple[Path, Path, Pushbroom], given: str) -> None:
    """All tiles are one image then, by GDAL's driver of DIMAP."""
    first, _, model = tiled
    scene = open_scene(first.parent / given)
    assert (scene.width, scene.height) == (300, 400)
    assert list(scene.models) == ["rpc", "pushbroom"]
    ground = model.image_to_ground([[250.0, 100.0]], 205.0)
    assert np.abs(scene.model.ground_to_image(ground) - [250.0, 100.0]).max() < 1e-3


@pytest.mark.driver("DIMAP")
@pytest.mark.parametrize("given", ["DIM_A.XML", ""], ids=["metadata", "folder"])
def test_points_of_the_tiles_count_for_all_tiles_together(tiled: tuple[Path, Path, Pushbroom], given: str) -> None:
    first, second, _ = tiled
    assert [(Path(piece.path), piece.offset, piece.size) for piece in open_scene(first.parent / given).pieces] == [
        (first, (0, 0), (200, 400)),
        (second, (200, 0), (100, 400)),
    ]


@pytest.mark.driver("DIMAP")
@pytest.mark.parametrize("given", ["DIM_A.XML", ""], ids=["metadata", "folder"])
def test_metadata_or_folder_in_an_archive(tiled: tuple[Path, Path, Pushbroom], tmp_path: Path, given: str) -> None:
    folder = tiled[0].parent
    inside = f"/vsizip/{shutil.make_archive(str(tmp_path / 'order'), 'zip', folder.parent, folder.name)}/{folder.name}"
    scene = open_scene(f"{inside}/{given}".rstrip("/"))
    assert ((scene.width, scene.height), list(scene.models)) == ((300, 400), ["rpc", "pushbroom"])
    assert scene.model.to_dict() == open_scene(folder).model.to_dict()


@pytest.mark.driver("JP2OpenJPEG")
@pytest.mark.driver("DIMAP")
def test_tiles_in_jpeg_2000(tiled: tuple[Path, Path, Pushbroom], tmp_path: Path) -> None:
    """As Pleiades Neo is delivered: the folder is one image, of which the tiles are pieces."""
    (tmp_path / "jp2").mkdir()
    first, second = dimap_product(tmp_path / "jp2", read_rpc_text(tiled[0].parent / "RPC_A.XML"), "JP2")
    scene = open_scene(first.parent)
    assert ((scene.width, scene.height), list(scene.models)) == ((300, 400), ["rpc", "pushbroom"])
    values = RasterSource(scene.path).read(195, 10, 10, 1)[0, 0]
    assert values.tolist() == [100] * 5 + [50] * 5
    (piece,) = open_scene(second).pieces
    assert (Path(piece.path), piece.offset) == (first, (-200, 0))


@pytest.mark.driver("DIMAP")
def test_every_command_takes_the_folder(tiled: tuple[Path, Path, Pushbroom]) -> None:
    first, _, model = tiled
    info = used(first.parent, model, (300, 400), sensor="rpc", height=200.0, correction="model")
    assert info["models"] == {"rpc": "rpc", "pushbroom": "pushbroom"}


def test_a_folder_of_two_products_names_them(tiled: tuple[Path, Path, Pushbroom]) -> None:
    folder = tiled[0].parent
    shutil.copy(folder / "DIM_A.XML", folder / "DIM_B.XML")
    with pytest.raises(InputError, match=r"several products: DIM_A.XML, DIM_B.XML"):
        open_scene(folder)


def volume(path: Path, *products: str) -> Path:
    """Write what Airbus deliveries have at their top: a list of products, and of pictures of them."""
    component = "<Component><COMPONENT_TYPE>{}</COMPONENT_TYPE><COMPONENT_PATH href='{}'/></Component>"
    listed = [("DIMAP", one) for one in products] + [("DOCUMENT", "INDEX.HTM")]
    path.write_text(
        "<Dimap_Document><Metadata_Identification><METADATA_FORMAT version='2.15'>DIMAP</METADATA_FORMAT>"
        "</Metadata_Identification><Dataset_Content><Dataset_Components>"
        + "".join(component.format(*one) for one in listed)
        + "</Dataset_Components></Dataset_Content></Dimap_Document>"
    )
    return path


@pytest.mark.driver("DIMAP")
@pytest.mark.parametrize("given", ["VOL_PHR.XML", ""], ids=["volume", "folder"])
def test_a_volume_is_its_one_product(tiled: tuple[Path, Path, Pushbroom], given: str) -> None:
    folder = tiled[0].parent
    top = volume(folder.parent / "VOL_PHR.XML", f"{folder.name}/DIM_A.XML").parent
    scene = open_scene(top / given)
    assert ((scene.width, scene.height), list(scene.models)) == ((300, 400), ["rpc", "pushbroom"])
    assert Path(scene.path) == folder / "DIM_A.XML"
    # A survey lists neither the tiles nor the volume again.
    assert survey(top).of("scene") == [f"{folder.name}/DIM_A.XML"]


@pytest.mark.driver("DIMAP")
def test_a_volume_of_several_products_names_them_and_one_whose_product_is_missing_it(
    tiled: tuple[Path, Path, Pushbroom],
) -> None:
    folder = tiled[0].parent
    shutil.copy(folder / "DIM_A.XML", folder / "DIM_B.XML")
    given = volume(folder.parent / "VOL_PHR.XML", *(f"{folder.name}/DIM_{one}.XML" for one in "AB"))
    for one in (given, given.parent):
        with pytest.raises(InputError, match=r"several products: .*DIM_A.XML, .*DIM_B.XML") as caught:
            open_scene(one)
        assert caught.value.remedy == "give one of them"
    volume(given, "IMG_01/DIM_C.XML")
    with pytest.raises(InputError, match=r"its product 'IMG_01/DIM_C.XML' is missing"):
        open_scene(given)


@pytest.mark.realdata
def test_rpc_of_pleiades_neo_and_its_vertices(real: Path) -> None:
    """Version 3 of the file; it counts from 0 where the vertices, with heights, count centres from 1.

    Below, their corners are 0.15 px apart: as far as one of the vendor's models follows the other.
    """
    folder = real / "sensors" / "asp_plot" / "pleiades"
    rpc = read_rpc_text(folder / "RPC_PNEO3_202111071029126_PAN_trimmed.XML")
    root = ElementTree.parse(folder / "DIM_PNEO3_202111071029126_PAN_trimmed.XML").getroot()
    names = ("LON", "LAT", "H", "COL", "ROW")
    corners = np.array([[float(v.findtext(n)) for n in names] for v in root.iter("Vertex")])
    apart = rpc.ground_to_image(corners[:, :3]) - (corners[:, 3:] - 0.5)
    assert np.abs(apart[:2]).max() < 0.002
    assert np.abs(apart[2:]).max() < 0.16


NEO_ROWS = (66, 665)
"""The rows of the shortened file for which there are both positions and quaternions, counted from 0."""


def look_angles(written: Written, rpc: RPC, row: int, light: LightPath) -> tuple[Array, Array]:
    """Return columns counted from 0 and the angles (psi_X, psi_Y) under which a row sees what its RPC says."""
    columns = np.linspace(0.0, 29392.0, 15)
    ground = rpc.image_to_ground(np.column_stack([columns + 0.5, np.full(15, row + 0.5)]), rpc.h_off)
    place, (w, x, y, z) = written.pose(row + 1)
    velocity = (written.pose(row + 2)[0] - place) / written.period
    line = light.apparent(
        geocentric(ground) - place, np.tile(velocity, (15, 1)), enu_from_ecef(ground)[:, 2], ground[:, 2]
    )
    forward, right, down = Rotation.from_quat([x, y, z, w]).inv().apply(line).T
    return columns, np.stack([-right / down, forward / down], axis=1)


@pytest.mark.realdata
@pytest.mark.parametrize(("light", "most"), [({"refraction": True}, 0.01), ({}, 0.05)], ids=["refraction", "none"])
def test_pleiades_neo_and_its_rpc(real: Path, tmp_path: Path, light: dict[str, bool], most: float) -> None:
    """Orbit, attitude and times of the shortened file, with the four look angles that its RPC has in one row.

    They are straight lines, as the format has them, to 0.002 px, and would not be with a tangent; with them the model
    agrees with the RPC over all rows that have an attitude. Its change with height is that of refraction.
    """
    folder = real / "sensors" / "asp_plot" / "pleiades"
    path, light_path = folder / "DIM_PNEO3_202111071029126_PAN_trimmed.XML", LightPath(**light)
    rpc, written = read_rpc_text(folder / "RPC_PNEO3_202111071029126_PAN_trimmed.XML"), Written(path)
    columns, angles = look_angles(written, rpc, 360, light_path)
    lines = [np.polynomial.Polynomial.fit(columns, part, 1).convert() for part in angles.T]
    pixel = abs(lines[0].coef[1])
    assert max(np.abs(one(columns) - part).max() for one, part in zip(lines, angles.T, strict=True)) < 0.002 * pixel
    bent = np.arctan(angles[:, 0])
    assert np.abs(np.polynomial.Polynomial.fit(columns, bent, 1)(columns) - bent).max() > 0.1 * pixel
    first, last = NEO_ROWS
    start = written.start + first * written.period

    def moment(seconds: float) -> str:
        return f"2021-11-07T{int(seconds // 3600):02d}:{int(seconds // 60 % 60):02d}:{seconds % 60:013.10f}Z"

    look = "".join(f"<{n}_{k}>{c!r}</{n}_{k}>" for n, one in zip(("XLOS", "YLOS"), lines, strict=True)
                   for k, c in enumerate(one.coef.tolist()))  # fmt: skip
    band = f"<Band_Calibration><Polynomial_Look_Angles>{look}</Polynomial_Look_Angles></Band_Calibration>"
    text, rows = path.read_text(), last - first
    for pattern, new in (
        (r"<START>.*?</START>", f"<START>{moment(start)}</START>"),
        (r"<END>.*?</END>", f"<END>{moment(start + rows * written.period)}</END>"),
        (r"<NROWS>\d+", f"<NROWS>{rows}"),
        (r"(?s)(<Geometric_Calibration>).*?(?=</Geometric_Calibration>)",
         rf"\1<Instrument_Calibration><Band_Calibration_List>{band}</Band_Calibration_List></Instrument_Calibration>"),
    ):  # fmt: skip
        text = re.sub(pattern, new, text, count=1)
    (tmp_path / path.name).write_text(text)
    model = replace(read_dimap_pushbroom(tmp_path / path.name), light=light_path)
    share = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), axis=-1).reshape(-1, 2)
    image = 0.5 + share * (np.array(model.camera.size) - 1)
    apart = np.array([rpc.ground_to_image(model.image_to_ground(image, rpc.h_off + h)) - image - (0, first)
                      for h in (-200.0, 0.0, 200.0)])  # fmt: skip
    assert apart.std(axis=(0, 1)).max() < most
    assert np.abs(apart.mean(axis=(0, 1))).max() < 0.01
    by_height = np.ptp(apart.mean(axis=1), axis=0).max()
    assert by_height < 0.01 if light else 0.05 < by_height < 0.15


@pytest.mark.parametrize("apart", [0.0, 5.0])
def test_pleiades_neo_is_held_against_the_rpc_of_each_scene(tmp_path: Path, apart: float) -> None:
    path = tmp_path / "DIM_A.XML"
    path.write_text(dimap_text(listed=True).replace("S6_SENSOR", "PNEO_SENSOR"))
    model = read_dimap_pushbroom(path).with_heights(190.0, 220.0)
    assert model.light == LightPath(refraction=True)
    centre, half = model.domain
    box = (centre[0] - half[0], centre[1] - half[1], centre[0] + half[0], centre[1] + half[1])
    rpc = fit_rpc(model, box, (190.0, 220.0), grid=(7, 7, 4)).rpc
    image = _image(tmp_path / "a.tif", model)
    write_rpc_txt(replace(rpc, col_off=rpc.col_off + apart), tmp_path / "a_RPC.TXT")
    scene = open_scene(image, None, {"rpc": "sidecar"})
    assert list(scene.models) == (["rpc"] if apart else ["rpc", "pushbroom"])
    assert [notice.code for notice in scene.notices] == ["rigorous-left-out"] * bool(apart)
    assert not apart or "it is 5 px off the RPC within the image" in scene.notices[0]


def test_a_bundle_of_panchromatic_and_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders as they are delivered; a point that was measured in one image counts in the other, by both RPCs."""
    images = []
    for number, (band, scale) in enumerate((("P", 1), ("MS", 4)), 1):
        folder = tmp_path / f"IMG_0{number}_PHR1A_{band}"
        folder.mkdir()
        (folder / f"DIM_PHR1A_{band}_1.XML").write_text(bundle_text(band, (160 // scale, 120 // scale)))
        one = seed_rpc().scaled(scale)
        (folder / f"RPC_PHR1A_{band}_1.XML").write_text(rpc_xml(one))
        images.append(pixels(folder / f"IMG_PHR1A_{band}_1_R1C1.TIF", (160 // scale, 120 // scale)))
        write_rpc_txt(one, images[-1].with_name(f"{images[-1].stem}_RPC.TXT"))
    pan, colours = images
    (here,), (there,) = open_scene(pan).pieces, open_scene(colours).pieces
    assert (here.path, there.path) == (colours, pan)
    assert (here.scale, there.scale) == pytest.approx((4.0, 0.25))
    lon, lat, h = seed_rpc().image_to_ground([[100.0, 60.0]], 900.0)[0].tolist()
    (tmp_path / "p.csv").write_text(f"id,image,col,row,x,y,h\n1,{pan.name},104,58,{lon},{lat},{h}\n")
    options = PointOptions(gcps=tmp_path / "p.csv", crs="EPSG:4326", vertical="ellipsoid")
    points = read_control(open_scene(colours), Request(colours, points=options))
    np.testing.assert_allclose(points.image, [[104 / 4, 58 / 4]], atol=1e-6)
    # Matches say in which image they were measured, and so serve the other one as well.
    found = SimpleNamespace(matches=SimpleNamespace(points=points), to_json=dict, notices=(), summary=list)
    monkeypatch.setattr(command, "match_scene", lambda *_: found)
    (tmp_path / "matches").mkdir()
    command.match(
        colours, tmp_path / "matches" / "m.csv", MatchOptions(reference=(pan,)), surface=SurfaceOptions(height=900.0)
    )
    matched = replace(options, gcps=tmp_path / "matches" / "m.csv", crs=None, vertical=None)
    again = read_control(open_scene(pan), Request(pan, points=matched))
    np.testing.assert_allclose(again.image, [[104.0, 58.0]], atol=1e-4)
    survey = json.loads(CliRunner().invoke(cli, ["info", str(tmp_path), "--json"]).stdout)
    assert [one["path"] for one in survey["files"] if one["kind"] == "scene"] == [
        str(one.relative_to(tmp_path)) for one in images
    ]
    # Another strip, or the same bands, are images of their own.
    path = colours.with_name("DIM_PHR1A_MS_1.XML")
    for old, new in (("DS_PHR1A_1", "DS_PHR1A_2"), (">MS<", ">P<")):
        text = path.read_text()
        path.write_text(text.replace(old, new))
        assert open_scene(pan).pieces == ()
        path.write_text(text)
