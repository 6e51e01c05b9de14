"""CSM states: there and back, and against the library's conventions, written down again."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from ortho_csm.files import csm_text, read_csm, write_csm
from ortho_maxar.isd import Isd, read_isd_pushbroom
from ortho_spot.dimap import read_spot
from osgeo import gdal
from products import isd_text, reversed_scan, spot_text
from scipy.spatial.transform import Rotation

from ortho_pipeline import commands, open_scene
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import geocentric, meet_height
from ortho_pipeline.models import FrameCamera, ImageCorrection, Pushbroom
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.light import LightPath

STATES = Path("sensors", "asp_plot", "ba_cams")


class Library:
    """What usgscsm does with a state, point by point; shares nothing with the engine."""

    def __init__(self, text: str) -> None:
        name, _, body = text.partition("\n")
        self.s = json.loads(body)
        self.frame = "FRAME" in name

    def table(self, what: str, width: int, time: float) -> Array:
        values = np.array(self.s[{3: "m_positions", 4: "m_quaternions"}[width]]).reshape(-1, width)
        at = (time - self.s[f"m_t0{what}"]) / self.s[f"m_dt{what}"]
        row = min(max(int(at), 0), len(values) - 2)
        # Towards the ends of the table the polynomial has fewer rows, in the last step two.
        half = min(4, row + 1, len(values) - 1 - row)
        first, count = row - half + 1, 2 * half
        weights = [math.prod((at - first - j) / (i - j) for j in range(count) if j != i) for i in range(count)]
        return np.array(weights) @ values[first : first + count]

    @staticmethod
    def turn(q: Array) -> Array:
        x, y, z, w = q / np.linalg.norm(q)
        return np.array([
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (w * y + x * z)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (w * x + y * z), w * w - x * x - y * y + z * z],
        ])  # fmt: skip

    def ray(self, line: float, sample: float) -> tuple[Array, Array]:
        """Return place and direction of the line through the camera."""
        s = self.s
        index = max(0, int(np.searchsorted(s["m_intTimeLines"], line, side="right")) - 1)
        time = s["m_intTimeStartTimes"][index] + s["m_intTimes"][index] * (line - s["m_intTimeLines"][index] + 0.5)
        sums, starts = s["m_detectorSampleSumming"], s["m_startingDetectorSample"]
        t2 = sample * sums + starts - s["m_detectorSampleOrigin"] - s["m_iTransS"][0]
        t1 = 0.0 * s["m_detectorLineSumming"] + s["m_startingDetectorLine"] - s["m_detectorLineOrigin"]
        t1 -= s["m_iTransL"][0]
        (m11, m12), (m21, m22) = s["m_iTransL"][1:], s["m_iTransS"][1:]
        det = m11 * m22 - m12 * m21
        x, y = (m11 * t1 - m12 * t2) / det, (-m21 * t1 + m22 * t2) / det
        square, (k0, k1, k2) = x * x + y * y, s["m_opticalDistCoeffs"]
        x, y = (part * (1 - (k0 + square * (k1 + square * k2))) for part in (x, y))
        look = np.array([-x * s["m_zDirection"], -y * s["m_zDirection"], -s["m_focalLength"]])
        return self.table("Ephem", 3, time), self.turn(self.table("Quat", 4, time)) @ look / np.linalg.norm(look)

    def pixel(self, point: Array) -> tuple[float, float]:
        """Return sample and line of a point (ECEF) in a frame."""
        s = self.s
        values = np.array(s["m_currentParameterValue"])
        p = self.turn(values[3:]).T @ (point - values[:3])
        x, y = s["m_focalLength"] * p[0] / p[2] + s["m_samplePp"], s["m_focalLength"] * p[1] / p[2] + s["m_linePp"]
        sample = s["m_iTransS"][0] + s["m_iTransS"][1] * x + s["m_iTransS"][2] * y + s["m_ccdCenter"][1]
        line = s["m_iTransL"][0] + s["m_iTransL"][1] * x + s["m_iTransL"][2] * y + s["m_ccdCenter"][0]
        return sample, line


def worldview(folder: Path, *, reverse: bool = False, **light: bool) -> Pushbroom:
    (folder / "one.XML").write_text(reversed_scan(isd_text()) if reverse else isd_text())
    model = read_isd_pushbroom(folder / "one.XML")
    return replace(model, light=LightPath(**light), heights=(0.0, 300.0))


def spot(folder: Path, **style: bool) -> Pushbroom:
    (folder / "METADATA.DIM").write_text(spot_text(**style))
    return read_spot(folder / "METADATA.DIM", heights=(0.0, 300.0)).model


def frame() -> FrameCamera:
    interior = Interior(400, 300, 0.1, 8e-6, 8.1e-6, x0=1e-5, y0=-2e-5)
    return FrameCamera.from_roll_pitch_yaw(
        interior, (33.0, 40.0, 5000.0), *np.radians([4.0, 3.0, 70.0]), heights=(0.0, 300.0)
    )


def points(model: SensorModel, size: tuple[int, int]) -> tuple[Array, Array]:
    image = np.random.default_rng(0).uniform(0.0, 1.0, (25, 2)) * size
    return image, model.image_to_ground(image, np.linspace(0.0, 300.0, 25))


@pytest.mark.parametrize("kind", ["worldview", "reverse", "spot", "spot5", "frame"])
def test_there_and_back(tmp_path: Path, kind: str) -> None:
    model = {"worldview": lambda: worldview(tmp_path), "spot": lambda: spot(tmp_path), "frame": frame,
             "spot5": lambda: spot(tmp_path, corrected=True), "reverse": lambda: worldview(tmp_path, reverse=True)
             }[kind]()  # fmt: skip
    size = (400, 300) if kind == "frame" else (60, 50)
    stated = write_csm(model, tmp_path / "one.json")
    once = read_csm(tmp_path / "one.json")
    write_csm(once, tmp_path / "two.json")
    image, ground = points(once, size)
    assert np.abs(read_csm(tmp_path / "two.json").ground_to_image(ground) - image).max() < 1e-6
    # A line of detectors that is no line of equal pixels is within what is stated; the others are exact.
    apart = np.abs(once.ground_to_image(points(model, size)[1]) - points(model, size)[0]).max()
    assert apart < (stated + 1e-6 if kind.startswith("spot") else 1e-6)
    assert stated < 0.01


@pytest.mark.parametrize("kind", ["worldview", "reverse", "light", "spot"])
def test_a_line_scanner_in_the_library(tmp_path: Path, kind: str) -> None:
    """Its rays pass the ground that the model sees, within 0.01 px; with light at the height that it is folded for."""
    if kind == "spot":
        model = spot(tmp_path)
    else:
        model = worldview(tmp_path, reverse=kind == "reverse", aberration=kind == "light", refraction=kind == "light")
    library = Library(csm_text(model)[0])
    image = np.random.default_rng(1).uniform(0.0, 1.0, (25, 2)) * model.camera.size
    ground = geocentric(model.image_to_ground(image, model.reference_height))
    for (column, row), point in zip(image, ground, strict=True):
        place, direction = library.ray(row, column)
        line = point - place
        apart = np.linalg.norm(np.cross(line, direction))
        assert apart < 0.01 * np.linalg.norm(line) / model.camera.focal_length


def test_positions_that_end_with_the_image_are_no_straight_line_there(sample: Path) -> None:
    """The library interpolates linearly in the first and last step of a table: 3 cm on the ground."""
    model = open_scene(sample / "cartosat" / "BANDF.tif").models["pushbroom"]
    library = Library(csm_text(model)[0])
    rows = np.array([10.0, 200.0, 390.0])
    ground = geocentric(model.image_to_ground(np.column_stack([np.full(3, 50.0), rows]), model.reference_height))
    for row, point in zip(rows, ground, strict=True):
        place, direction = library.ray(row, 50.0)
        assert np.linalg.norm(np.cross(point - place, direction)) < 1e-3


def test_a_state_whose_lines_were_taken_from_the_last_to_the_first(tmp_path: Path) -> None:
    """As Ames Stereo Pipeline writes it of a reverse scan: the time of a line is negative."""
    model = worldview(tmp_path)
    write_csm(model, tmp_path / "one.json")
    name, _, body = (tmp_path / "one.json").read_text().partition("\n")
    state = json.loads(body)
    rows = state["m_nLines"]
    (start,), (period,) = state["m_intTimeStartTimes"], state["m_intTimes"]
    state |= {"m_intTimeLines": [1.0, float(rows)], "m_intTimes": [-period, -period],
              "m_intTimeStartTimes": [start + (rows - 1) * period, start]}  # fmt: skip
    (tmp_path / "one.json").write_text(f"{name}\n{json.dumps(state)}")
    image, ground = points(model, model.camera.size)
    turned = np.column_stack([image[:, 0], rows - image[:, 1]])
    assert np.abs(read_csm(tmp_path / "one.json").ground_to_image(ground) - turned).max() < 1e-6


def test_a_frame_in_the_library() -> None:
    model = frame()
    library = Library(csm_text(model)[0])
    image, ground = points(model, (400, 300))
    assert np.abs([library.pixel(point) for point in geocentric(ground)] - image).max() < 1e-6


def test_a_camera_next_to_its_image_is_not_overwritten(tmp_path: Path) -> None:
    camera, image = tmp_path / "photo_csm.json", tmp_path / "photo.tif"
    write_csm(frame(), camera)
    gdal.GetDriverByName("GTiff").Create(str(image), 400, 300, 1).FlushCache()
    before = camera.read_bytes()
    with pytest.raises(InputError, match="both input and output") as caught:
        commands.export(image, tmp_path, formats=["csm"])
    assert Path(caught.value.file) == camera
    assert camera.read_bytes() == before
    assert commands.export(image, tmp_path / "out", formats=["csm"]).files["csm"].is_file()


def test_the_ground_of_an_aeroplanes_frame_lies_below_it(tmp_path: Path) -> None:
    """A state need not say how high the ground is; mountains do not reach above the camera."""
    text = csm_text(frame())[0]
    name, _, body = text.partition("\n")
    fields = {key: value for key, value in json.loads(body).items() if key not in ("m_minElevation", "m_maxElevation")}
    (tmp_path / "one.json").write_text(f"{name}\n{json.dumps(fields)}")
    model = read_csm(tmp_path / "one.json")
    assert model.reference_height < 3000.0
    assert np.isfinite(model.image_to_ground([[200.0, 150.0]], model.reference_height)).all()


def test_what_has_no_state(tmp_path: Path) -> None:
    lens = replace(frame(), interior=replace(frame().interior, k1=3.0))
    with pytest.raises(InputError, match="the error would be"):
        csm_text(lens)
    assert csm_text(lens, force=True)[1] > 0.1
    corrected = ImageCorrection.identity(frame(), "shift", (0.0, 0.0))
    with pytest.raises(InputError, match="line scanners and frames"):
        csm_text(corrected)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("m_majorAxis", 3396190.0, "not the ellipsoid of the Earth"),
        ("m_distortionType", 1, "only radial"),
        ("m_intTimes", [0.0], "not a possible line period"),
        ("m_currentParameterValue", [1.0] * 16, "corrections of the tables"),
        ("m_quaternions", [0.0] * 40, "length one"),
        ("m_positions", None, "must be a list of"),
        ("m_positions", [1e14] * 300, "where no satellite can be"),
        ("m_nLines", 0, "not an image size"),
    ],
)
def test_what_is_refused(tmp_path: Path, field: str, value: object, said: str) -> None:
    name, _, body = csm_text(worldview(tmp_path))[0].partition("\n")
    fields = {**json.loads(body), "m_opticalDistCoeffs": [0.0, 1e-12, 0.0], field: value}
    (tmp_path / "one.json").write_text(f"{name}\n{json.dumps(fields)}")
    with pytest.raises(InputError, match=said) as caught:
        read_csm(tmp_path / "one.json")
    assert caught.value.file
    assert caught.value.remedy


@pytest.mark.realdata
def test_the_state_of_a_worldview_3_and_our_model_of_its_xml(real: Path) -> None:
    """One camera, twice: the state has aberration and refraction in its angles, as each being switched on shows.

    What is left, half a row, is that both are folded in by other formulas, which the next test has.
    """
    state = read_csm(real / STATES / "1040010074793300.json")
    model = read_isd_pushbroom(Isd(real / STATES / "1040010074793300.xml"))
    image = np.stack(np.meshgrid(np.linspace(0, 42500, 7), np.linspace(0, 38116, 9)), axis=-1).reshape(-1, 2)

    def apart(**light: bool) -> tuple[Array, Array]:
        other = replace(model, light=LightPath(**light))
        moved = state.ground_to_image(other.image_to_ground(image, 7.0)) - image
        return moved.mean(axis=0), moved.std(axis=0)

    assert np.linalg.norm(apart()[0]) > 45
    assert 2.5 < np.linalg.norm(apart(aberration=True)[0]) < 3.5
    mean, spread = apart(aberration=True, refraction=True)
    assert np.linalg.norm(mean) < 0.7
    assert spread.max() < 0.05


class Maker:
    """The rays of ISD XML as the program that wrote the state makes them, written down again.

    Aberration by the velocity less the way of the ground while the light is under way, over a ball; refraction by the
    formula of Saastamoinen 1972; the attitude between rows of the table by Lagrange's polynomial, as the state's
    library has it. Shares nothing with the engine.
    """

    def __init__(self, path: Path) -> None:
        root = ElementTree.parse(path).getroot()

        def seconds(at: str) -> float:
            hours, minutes, rest = root.findtext(at).rstrip("Z").split("T")[1].split(":")
            return 3600 * int(hours) + 60 * int(minutes) + float(rest)

        def table(part: str) -> Array:
            return np.array([one.text.split() for one in root.iter(f"{part}LIST")], dtype=float)[:, 1:]

        self.step = float(root.findtext("ATT/TIMEINTERVAL"))
        self.start = seconds("IMD/IMAGE/TLCTIME") - seconds("ATT/STARTTIME")
        self.orbit, self.attitude = table("EPHEM"), table("ATT")[:, :4]
        first, last = ([float(n) for n in one.text.split()] for one in root.iter("TLCLIST"))
        self.period = (last[1] - first[1]) / (last[0] - first[0])
        array = root.find("GEO/DETECTOR_MOUNTING/BAND_P/DETECTOR_ARRAY")
        self.x, self.y, self.pitch = (float(array.findtext(f"DET{n}")) for n in ("ORIGINX", "ORIGINY", "PITCH"))
        self.distance = float(root.findtext("GEO/PRINCIPAL_DISTANCE/PD"))
        self.width = 42500

    def at(self, values: Array, times: Array, count: int) -> Array:
        """Return what a table says between its rows, by the polynomial through so many of them."""
        found = []
        for at in times / self.step:
            first = math.floor(at) - count // 2 + 1
            weights = [math.prod((at - first - j) / (i - j) for j in range(count) if j != i) for i in range(count)]
            found.append(np.array(weights) @ values[first : first + count])
        return np.array(found)

    def rays(self, image: Array, *effects: str) -> tuple[Array, Array]:
        """Return places and unit vectors to the ground of image points counted from the outer corner."""
        place, turns, velocity = self.states(image[:, 1], "interpolation" in effects)
        seen = turns.apply(self.looks(image[:, 0]))
        middle = turns.apply(self.looks(np.full(len(image), self.width / 2)))
        for name, effect in (("aberration", self.aberration), ("refraction", self.refraction)):
            if name in effects:
                # A state turns a row as a whole, by what its middle needs; a camera every detector by its own.
                turn = effect(place, velocity, middle if "row" in effects else seen)
                seen, middle = turn.apply(seen), turn.apply(middle)
        return place, seen

    def states(self, rows: Array, smooth: bool) -> tuple[Array, Rotation, Array]:
        """Return places, rotations from the camera and velocities; straight lines between quaternions if not smooth."""
        times = self.start + (rows - 0.5) * self.period
        state = self.at(self.orbit, times, 8)
        return state[:, :3], Rotation.from_quat(self.at(self.attitude, times, 8 if smooth else 2)), state[:, 3:6]

    def looks(self, columns: Array) -> Array:
        """Return unit vectors of columns in the camera."""
        ones = np.ones(len(columns))
        looks = np.stack([ones * self.x, self.y - self.pitch * (columns - 0.5), ones * self.distance], axis=1)
        return looks / np.linalg.norm(looks, axis=1)[:, None]

    @staticmethod
    def aberration(place: Array, velocity: Array, seen: Array) -> Rotation:
        ahead = -(place * seen).sum(axis=1)
        away = ahead - np.sqrt(6371000.0**2 + ahead**2 - (place**2).sum(axis=1))
        velocity = velocity - away[:, None] * np.cross([0.0, 0.0, 2 * math.pi / 86164.0905], seen)
        return Rotation.from_rotvec(np.cross(seen, -velocity) / 299792458.0)

    @staticmethod
    def refraction(place: Array, _: Array, seen: Array) -> Rotation:
        down = -place / np.linalg.norm(place, axis=1)[:, None]
        ground, high = 0.007, (np.linalg.norm(place, axis=1) - 6371000.0) / 1000
        bend = 2335 / (high - ground) * (1 - 0.02257 * ground) ** 5.256
        bend -= 0.854 ** (high - 11) * (82.2 - 521 / (high - ground))
        # By K tan(alpha) about their normal, whose length is sin(alpha).
        return Rotation.from_rotvec(np.cross(seen, down) * (1e-6 * bend / (seen * down).sum(axis=1))[:, None])


@pytest.mark.realdata
def test_the_state_of_a_worldview_3_is_explained_effect_by_effect(real: Path) -> None:
    """Aberration (48 px), refraction (2.9 px), one turn for a row (0.04 px), interpolation (0.002 px): nothing is left.

    The same 500 m higher: none of the four knows the ground, as light itself does.
    """
    state = read_csm(real / STATES / "1040010074793300.json")
    maker = Maker(real / STATES / "1040010074793300.xml")
    image = np.stack(np.meshgrid(np.linspace(0.5, 42500, 7), np.linspace(0.5, 38116, 9)), axis=-1).reshape(-1, 2)

    def apart(*effects: str, height: float = 7.0) -> tuple[float, float]:
        """Return by how many pixels the state is off on average, and how far that varies."""
        place, seen = maker.rays(image, *effects)
        moved = state.ground_to_image(meet_height(place, seen, np.full(len(image), height))) - image
        return float(np.linalg.norm(moved.mean(axis=0))), float(moved.std(axis=0).max())

    effects = ("aberration", "refraction", "row", "interpolation")
    left = [apart(*effects[:count]) for count in range(5)]
    mean, spread = zip(*left, strict=True)
    assert mean[0] == pytest.approx(51.2, abs=0.3)
    assert mean[1] == pytest.approx(2.87, abs=0.05)
    assert max(mean[2:]) < 0.005
    assert spread[2] == pytest.approx(0.043, abs=0.002)
    assert 0.001 < spread[3] < 0.004
    assert spread[4] < 0.001
    assert apart(*effects, height=507.0) == pytest.approx(left[4], abs=1e-4)


@pytest.mark.realdata
@pytest.mark.parametrize(
    "name",
    ["1040010074793300.json",
     pytest.param("1040010074793300.adjusted_state.json", marks=pytest.mark.slow),
     pytest.param("../jitter/uyuni/csm-1040010014761800.r100.adjusted_state.json", marks=pytest.mark.slow)],
    ids=["as made", "adjusted", "with solved jitter"],
)  # fmt: skip
def test_real_states_in_the_library_and_there_and_back(real: Path, tmp_path: Path, name: str) -> None:
    path = real / STATES / name
    model, library = read_csm(path), Library(path.read_text())
    image = np.random.default_rng(2).uniform(0.0, 1.0, (20, 2)) * model.camera.size
    place = model.image_to_ground(image, 100.0)
    for (column, row), point in zip(image, geocentric(place), strict=True):
        origin, direction = library.ray(row, column)
        apart = np.linalg.norm(np.cross(point - origin, direction))
        assert apart < 0.01 * np.linalg.norm(point - origin) / library.s["m_focalLength"]
    assert write_csm(model, tmp_path / "one.json") < 1e-6
    assert np.abs(read_csm(tmp_path / "one.json").ground_to_image(place) - image).max() < 1e-6
