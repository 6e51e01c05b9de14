"""SPOT 1 to 5: the rigorous model against the vendor's frame corners and its conventions, written down again."""

from __future__ import annotations

import math
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
from ortho_spot import recognises
from ortho_spot.dimap import read_spot
from osgeo import gdal
from products import spot_text
from scipy.ndimage import gaussian_filter, map_coordinates
from used import pixels, used

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric, meet_height
from ortho_pipeline.host import open_scene
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.testing import check_sensor_model

SIZE = (60, 50)


class Written:
    """Rays of DIMAP 1 straight from the handbook; shares nothing with the engine."""

    def __init__(self, path: Path) -> None:
        root = ElementTree.parse(path).getroot()
        points = root.findall(".//Ephemeris/Points/Point")
        self.times = np.array([self.seconds(point.findtext("TIME")) for point in points])
        self.states = np.array(
            [[float(p.findtext(f"{part}/{k}")) for part in ("Location", "Velocity") for k in "XYZ"] for p in points]
        )
        stamp = root.find(".//Time_Stamp")
        self.period, self.line = (float(stamp.findtext(n)) for n in ("LINE_PERIOD", "SCENE_CENTER_LINE"))
        self.centre = self.seconds(stamp.findtext("SCENE_CENTER_TIME"))
        names = ("DETECTOR_ID", "PSI_X", "PSI_Y")
        self.looks = np.array([[float(e.findtext(n)) for n in names] for e in root.find(".//Look_Angles_List")])
        angles = root.findall(".//Corrected_Attitude/Angles")
        self.attitude = np.array(
            [
                [self.seconds(e.findtext("TIME")), *(float(e.findtext(n)) for n in ("YAW", "PITCH", "ROLL"))]
                for e in angles
            ]
        )

    @staticmethod
    def seconds(text: str) -> float:
        hours, minutes, seconds = text.split("T")[1].split(":")
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds)

    def ray(self, column: float, row: float) -> tuple[Array, Array]:
        """Return position and direction of a place of the image, (1, 1) the centre of the first pixel."""
        time = self.centre + (row - self.line) * self.period
        first = int(np.clip(np.searchsorted(self.times, time) - 4, 0, len(self.times) - 8))
        near = self.times[first : first + 8]
        weights = [math.prod((time - b) / (a - b) for b in near if b != a) for a in near]
        place, speed = np.split(np.array(weights) @ self.states[first : first + 8], 2)
        up = place / np.linalg.norm(place)
        right = np.cross(speed, up) / np.linalg.norm(np.cross(speed, up))
        x, y = (np.interp(column, self.looks[:, 0], self.looks[:, k]) for k in (1, 2))
        v = np.array([-math.tan(y), math.tan(x), -1.0])
        if len(self.attitude):
            yaw, pitch, roll = (np.interp(time, self.attitude[:, 0], self.attitude[:, k]) for k in (1, 2, 3))
            # The plane of each turn, in the order in which they act.
            for (a, b), angle in (((0, 1), yaw), ((0, 2), roll), ((2, 1), pitch)):
                s, c = math.sin(angle), math.cos(angle)
                v[a], v[b] = c * v[a] - s * v[b], s * v[a] + c * v[b]
        v = v[0] * right + v[1] * np.cross(up, right) + v[2] * up
        return place, v / np.linalg.norm(v)


def corners(path: Path) -> Array:
    """Return lon, lat, column, row of the frame's corners and its centre."""
    root = ElementTree.parse(path).getroot()
    entries = [*root.findall("Dataset_Frame/Vertex"), root.find("Dataset_Frame/Scene_Center")]
    return np.array([[float(e.findtext(f"FRAME_{n}")) for n in ("LON", "LAT", "COL", "ROW")] for e in entries])


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("number", "constant", "spread", "centre"),
    [(1, 0.5, 0.01, 3.0), (2, 0.5, 0.01, 0.1), (3, 1.3, 0.01, 0.6), (5, 0.1, 0.1, 0.1)],
)
def test_the_vendors_frame_corners(real: Path, number: int, constant: float, spread: float, centre: float) -> None:
    """At height 0. The constant is along the track: SCENE_CENTER_TIME has milliseconds, half of one is 3.3 m.

    SPOT 5 prints corners to a millionth of a degree, 0.1 m. The centre's row is a whole one (half of one: 5 m).
    """
    path = real / "sensors" / "cosicorr3d" / f"SPOT{number}.DIM"
    model, given = read_spot(path).model, corners(path)
    found = model.image_to_ground(given[:, 2:] - 0.5, 0.0)
    place = geocentric(np.column_stack([given[:, :2], np.zeros(5)]))
    axes = enu_from_ecef(found)
    miss = np.einsum("nij,nj->ni", axes, geocentric(found) - place)[:, :2]
    mean = miss[:4].mean(axis=0)
    assert np.linalg.norm(mean) < constant
    assert np.linalg.norm(miss[:4] - mean, axis=1).max() < spread
    assert np.linalg.norm(miss[4] - mean) < centre


@pytest.mark.realdata
@pytest.mark.parametrize("number", [1, 5])
def test_it_keeps_the_contract(real: Path, number: int) -> None:
    model = read_spot(real / "sensors" / "cosicorr3d" / f"SPOT{number}.DIM", heights=(0.0, 1000.0)).model
    centre, half = model.domain
    check_sensor_model(model, centre + np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3)) * half)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "scene"
    folder.mkdir()
    pixels(folder / "IMAGERY.TIF", SIZE)
    (folder / "METADATA.DIM").write_text(spot_text(size=SIZE))
    return folder


@pytest.mark.parametrize(
    "style", [{}, {"every": True, "corrected": True}, {"corrected": True}], ids=["1-4", "5", "few"]
)
def test_rays_are_those_of_the_handbook(tmp_path: Path, style: dict[str, bool]) -> None:
    path = tmp_path / "METADATA.DIM"
    path.write_text(spot_text(size=SIZE, **style))
    model, written = read_spot(path).model, Written(path)
    image = np.random.default_rng(0).uniform(0.5, 49.5, (40, 2))
    ground = model.image_to_ground(image, 200.0)
    rays = [written.ray(column + 0.5, row + 0.5) for column, row in image]
    place, direction = (np.array(part) for part in zip(*rays, strict=True))
    apart = np.linalg.norm(geocentric(ground) - geocentric(meet_height(place, direction, np.full(40, 200.0))), axis=1)
    # Look angles between detectors, and angles between rows of the attitude, are linear there and smooth here.
    assert apart.max() < 0.02
    assert np.abs(model.ground_to_image(ground) - image).max() < 1e-5


def test_angular_speeds_move_the_scene_about_its_middle(scene: Path) -> None:
    image = np.array([[30.0, row] for row in np.linspace(0.0, 50.0, 51)])
    still, turning = (
        geocentric(read_spot(scene / "METADATA.DIM", attitude=kind).model.image_to_ground(image, 0.0))
        for kind in ("vendor", "speeds")
    )
    moved = np.linalg.norm(turning - still, axis=1)
    # A pitch of 1e-5 rad/s over half of 75 ms, seen from 920 km; the middle stays.
    assert moved[0] == pytest.approx(1e-5 * 0.0376 * 920e3, rel=0.35)
    assert moved[25] < 0.1 * moved[0]


@pytest.mark.parametrize(
    "given",
    [
        pytest.param("IMAGERY.TIF", id="image"),
        pytest.param("METADATA.DIM", id="metadata", marks=pytest.mark.driver("DIMAP")),
        pytest.param("", id="folder", marks=pytest.mark.driver("DIMAP")),
    ],
)
def test_image_metadata_or_folder(scene: Path, given: str) -> None:
    found = open_scene(scene / given)
    assert (found.sensor, Path(found.model_source).name) == ("spot", "METADATA.DIM")
    assert found.facts["satellite"] == "SPOT1"
    assert set(found.priors) == set(found.model.param_names)


@pytest.mark.driver("DIMAP")
def test_metadata_of_the_images_own_name_come_first(scene: Path) -> None:
    own = scene / "SCENE.DIM"
    own.write_text((scene / "METADATA.DIM").read_text())
    assert open_scene(next(scene.glob("*.TIF")).rename(scene / "SCENE.TIF")).model_source == str(own)


@pytest.mark.driver("DIMAP")
def test_every_command_takes_the_folder(scene: Path) -> None:
    info = used(scene, read_spot(scene / "METADATA.DIM").model, SIZE, sensor="spot", height=300.0,
                correction="model")  # fmt: skip
    assert info["facts"]["acquired"] == "1998-07-12T12:00:00"


def test_a_crop_has_its_place(scene: Path) -> None:
    whole = open_scene(scene / "IMAGERY.TIF").model
    image = pixels(scene / "IMAGERY.TIF", (30, 20))
    # GDAL deletes the metadata of an image that it writes anew.
    (scene / "METADATA.DIM").write_text(spot_text(size=SIZE))
    assert [notice.code for notice in open_scene(image).notices] == ["maybe-a-crop"]
    crop = open_scene(image, crop_offset=(20, 10)).model
    ground = whole.image_to_ground([[33.0, 15.0]], 200.0)
    assert np.abs(crop.ground_to_image(ground) - (13.0, 5.0)).max() < 1e-6


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<PROCESSING_LEVEL>1A", "<PROCESSING_LEVEL>1B", "level 1A"),
        ("<DETECTOR_ID>1<", "<DETECTOR_ID>2<", "detector 1"),
        ("<NCOLS>60", "<NCOLS>61", "61 columns"),
        ("+1.5040000000e-03", "0", "not a possible line period"),
        ("Location", "Elsewhere", "missing"),
    ],
)
def test_what_is_refused(scene: Path, old: str, new: str, said: str) -> None:
    path = scene / "METADATA.DIM"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=said) as caught:
        open_scene(scene / "IMAGERY.TIF")
    assert caught.value.file
    assert caught.value.remedy


def test_strangers_are_left_alone(tmp_path: Path) -> None:
    image = pixels(tmp_path / "IMAGERY.TIF", (5, 5))
    (tmp_path / "METADATA.DIM").write_text(
        "<Dimap_Document><METADATA_PROFILE>OTHER</METADATA_PROFILE></Dimap_Document>"
    )
    assert not recognises(gdal.Open(str(image)))


def window(text: str, left: int, top: int, side: int) -> str:
    """Return the metadata of a window of a scene with two look angles: its detectors, its rows, its size."""
    found = re.findall(r"<PSI_([XY])>(.*?)</PSI_", text)
    ends = np.array([[float(value) for axis, value in found if axis == name] for name in "XY"])
    whole = int(re.search(r"<NCOLS>(\d+)", text)[1])
    inner = ends[:, :1] + np.diff(ends) * (left + np.array([0, side - 1])) / (whole - 1)
    looks = "".join(
        f"<Look_Angles><DETECTOR_ID>{d}</DETECTOR_ID><PSI_X>{x!r}</PSI_X><PSI_Y>{y!r}</PSI_Y></Look_Angles>"
        for d, (x, y) in zip((1, side), inner.T.tolist(), strict=True)
    )
    text = re.sub(r"(?s)(<Look_Angles_List>).*?(</Look_Angles_List>)", rf"\g<1>{looks}\g<2>", text)
    text = re.sub(r"(<N(?:COLS|ROWS)>)\d+", rf"\g<1>{side}", text)
    centre = int(re.search(r"<SCENE_CENTER_LINE>(\d+)", text)[1])
    return re.sub(r"(<SCENE_CENTER_LINE>)\d+", rf"\g<1>{centre - top}", text)


@pytest.mark.slow
@pytest.mark.realdata
def test_automatic_control_of_a_real_scenes_geometry(real: Path, tmp_path: Path) -> None:
    """SPOT 1's geometry, 300 m off, over hills: 40 matches with an orthoimage leave half a pixel or less."""
    folder = tmp_path / "scene"
    folder.mkdir()
    side = 700
    text = window((real / "sensors" / "cosicorr3d" / "SPOT1.DIM").read_text(), 2600, 2600, side)
    (folder / "METADATA.DIM").write_text(text)
    model = read_spot(folder / "METADATA.DIM").model
    names = ("roll_offset", "pitch_offset", "yaw_offset")
    # 300 m from 960 km, and an angle that nobody measured about the vertical.
    values = dict(zip(names, (2.7e-4, -2e-4, 1e-4), strict=True))
    truth = model.with_params([values.get(name, 0.0) for name in model.param_names])
    utm, random = "EPSG:32636", np.random.default_rng(3)
    onto = ground_transform("EPSG:4979", utm)
    middle = onto(model.image_to_ground([[side / 2, side / 2]], 0.0))[0, :2].round(-1)
    cells, step = 2048, 10.0
    tone = sum(gaussian_filter(random.normal(0, 1, (cells, cells)), s, mode="wrap") * s for s in (1.5, 4.0, 12.0))
    corner = middle + np.array([-1, 1]) * cells * step / 2

    def height(x: Array, y: Array) -> Array:
        return 300.0 + 120.0 * np.sin((x - middle[0]) / 1500.0) * np.cos((y - middle[1]) / 1900.0)

    def shade(x: Array, y: Array) -> Array:
        return map_coordinates(tone, [(corner[1] - y) / step - 0.5, (x - corner[0]) / step - 0.5], order=1, mode="wrap")

    def written(path: Path, values: Array, place: tuple[float, ...] | None) -> Path:
        kind = gdal.GDT_Float32 if place and path.name == "dem.tif" else gdal.GDT_Byte
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), values.shape[1], values.shape[0], 1, kind)
        if place:
            dataset.SetGeoTransform(place)
            dataset.SetProjection(pyproj.CRS(utm).to_wkt())
        dataset.WriteArray(values)
        dataset = None
        return path

    def grey(x: Array, y: Array) -> Array:
        noise = random.normal(0, 5, np.shape(x))
        return np.clip(120 + 45 * shade(x, y) / tone.std() + noise, 1, 255).astype(np.uint8)

    columns, rows = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    image = np.column_stack([columns.ravel(), rows.ravel()])
    level = np.full(len(image), 300.0)
    for _ in range(12):
        place = onto(truth.image_to_ground(image, level))
        level = height(place[:, 0], place[:, 1])
    scene = written(folder / "IMAGERY.TIF", grey(place[:, 0], place[:, 1]).reshape(side, side), None)
    (folder / "METADATA.DIM").write_text(text)  # GDAL deletes the metadata of an image that it writes anew
    x, y = np.meshgrid(corner[0] + step * (np.arange(cells) + 0.5), corner[1] - step * (np.arange(cells) + 0.5))
    grid = (corner[0], step, 0.0, corner[1], 0.0, -step)
    written(tmp_path / "dem.tif", height(x, y).astype(np.float32), grid)
    written(tmp_path / "reference.tif", grey(x, y), grid)
    fitted = commands.fit(
        scene, PointOptions(correction="model"), SceneOptions(),
        SurfaceOptions(dem=tmp_path / "dem.tif", vertical="ellipsoid"),
        MatchOptions(reference=(tmp_path / "reference.tif",), points=40, search=1000.0),
    )  # fmt: skip
    check = random.uniform(50, side - 50, (200, 2))
    ground = truth.image_to_ground(check, 350.0)
    before = np.linalg.norm(onto(model.image_to_ground(check, 350.0)) - onto(ground), axis=1)
    assert before.min() > 300
    left = np.linalg.norm(fitted.fit.model.ground_to_image(ground) - check, axis=1)
    assert np.sqrt((left**2).mean()) < 0.5
