"""The truth tells the truth: rendered marks lie where it says, both images show one ground, models err as stated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import landscape
import numpy as np
import pyproj
import pytest
from cameras import Camera
from landscape import SIZE, Land, correlation, field_of
from numpy.typing import NDArray
from osgeo import gdal
from scenes import LEVEL, MIDDLE, UTM, Case, Setting, Sky, View
from skimage.registration import phase_cross_correlation

from ortho_pipeline.exchange.rpc import rpc_of_dataset
from ortho_pipeline.surface.dem import open_dem

QUIET = View(noise=0.0)
SMALL = Setting(side=280, scene=QUIET, reference=QUIET, error=7.0, relief=5.0)


class Marked(Case):
    """A case whose ground is dark, with round bright marks at known places."""

    marks: NDArray[np.float64]

    def __init__(self, setting: Setting, folder: Path) -> None:
        super().__init__(setting, folder)
        frame = np.array(self.frame)
        image = np.random.default_rng(8).uniform(0.1, 0.9, (40, 2)) * frame
        apart = np.linalg.norm(image[:, None] - image, axis=2) + 99 * np.eye(40)
        image = image[(apart > 24).all(axis=1)]
        u, v = self.texel(self.ground_of(image)[:, :2])
        tone, size = np.zeros((SIZE, SIZE), np.float32), 3.0 * setting.gsd / self.spacing
        reach = np.arange(-int(4 * size), int(4 * size) + 1)
        for at_u, at_v in zip(u, v, strict=True):
            columns, rows = int(at_u) + reach, int(at_v) + reach
            blob = np.exp(-0.5 * ((columns + 0.5 - at_u) ** 2 + (rows[:, None] + 0.5 - at_v) ** 2) / size**2)
            tone[np.ix_(rows % SIZE, columns % SIZE)] += blob.astype(np.float32)
        ground = Land({"a": tone}, self.land.parcels, self.land.relief)
        self.__dict__.update(land=ground, marks=image)


def centroid(pixels: np.ndarray, at: np.ndarray, reach: int) -> np.ndarray:
    """Return the centre of brightness of a mark near an image point."""
    column, row = np.floor(at).astype(int)
    part = pixels[row - reach : row + reach + 1, column - reach : column + reach + 1].astype(float)
    v, u = np.mgrid[row - reach : row + reach + 1, column - reach : column + reach + 1] + 0.5
    return np.array([(part * u).sum(), (part * v).sum()]) / part.sum()


@pytest.mark.parametrize("setting", [
    SMALL, replace(SMALL, pushbroom=False, heading_deg=75.0, off_nadir_deg=-5.0), replace(SMALL, ratio=2.0),
    replace(SMALL, ratio=0.5, gsd=2.4), replace(SMALL, reference_crs="EPSG:3857"),
])  # fmt: skip
def test_marks_lie_where_the_truth_says(tmp_path, setting):
    case = Marked(setting, tmp_path)
    (pixels,) = case.rendered()
    found = np.array([centroid(pixels, mark, 10) for mark in case.marks])
    ground = case.ground_of(case.marks)
    # A mark is round on the ground; on a curved slope, seen obliquely, its image is not: its centroid is elsewhere.
    assert np.abs(found - case.marks).max() < 0.06
    assert np.sqrt(((found - case.marks) ** 2).mean()) < 0.02
    np.testing.assert_allclose(case.image_of(ground), case.marks, atol=1e-6)
    case.write_reference()
    reference = gdal.Open(str(case.reference_file))
    left, step, _, top, _, _ = reference.GetGeoTransform()
    x, y = pyproj.Transformer.from_crs(UTM, setting.reference_crs, always_xy=True).transform(*ground[:, :2].T)
    wanted = np.stack([(x - left) / step, (top - y) / step], axis=1)
    image = np.maximum(reference.ReadAsArray().astype(float) - 300, 0)
    found = np.array([centroid(image, at, int(10 / setting.ratio) + 1) for at in wanted])
    assert np.sqrt(((found - wanted) ** 2).mean()) * setting.ratio < 0.02


@pytest.mark.parametrize("pushbroom", [True, False])
def test_a_camera_is_its_own_inverse(pushbroom):
    camera = Camera((*MIDDLE, LEVEL), 0.5, 1000, 800, 600e3 if pushbroom else 2000.0, 33.0, -21.0, 8.0,
                    (2e-6, -3e-6, 1e-5), pushbroom)  # fmt: skip
    image = np.random.default_rng(1).uniform(0, 1000, (50, 2))
    height = np.random.default_rng(2).uniform(0, 900, 50)
    ground = np.column_stack([camera.ground_at(image, height), height])
    np.testing.assert_allclose(camera.image_of(ground), image, atol=1e-6)
    assert camera.ground_at([[500.0, 400.0]], [LEVEL])[0] == pytest.approx(MIDDLE, abs=1e-6)
    # One pixel to the right, and one down, are one ground sampling distance, a bit more off nadir; not mirrored.
    steps = camera.ground_at([[501.0, 400.0], [500.0, 401.0]], [LEVEL, LEVEL]) - MIDDLE
    assert np.linalg.norm(steps, axis=1) == pytest.approx([0.5, 0.5], rel=0.25)
    assert np.linalg.det(steps) < 0


@pytest.mark.parametrize("kind", ["shift", "drift", "affine", "attitude"])
def test_the_delivered_model_errs_as_stated(tmp_path, kind):
    case = Case(replace(SMALL, kind=kind, error=120.0), tmp_path)
    off, ground = case.misfit(case.model)
    shift, slopes = case.error
    if kind != "attitude":
        image = case.image_of(case.ground_of(np.array([[0.0, 0.0]]))[:, :2]) - np.array(case.frame) / 2
        np.testing.assert_allclose(off[0], shift + slopes @ image[0], atol=0.01)
    assert np.linalg.norm(off[4]) == pytest.approx(120.0, abs=0.05)
    spread = np.abs(off - off[4]).max()
    # Up to 2 px at the rim of each axis.
    assert spread < 0.02 if kind == "shift" else 0.2 < spread < 4.5
    case.write()
    delivered, _ = rpc_of_dataset(gdal.Open(str(case.scene_file)))
    np.testing.assert_allclose(delivered.ground_to_image(ground), case.model.ground_to_image(ground), atol=1e-5)


def test_the_dem_is_the_relief_with_the_errors_stated(tmp_path):
    case = Case(replace(SMALL, dem_sigma=3.0, dem_length=25.0, dem_noise=1.0), tmp_path)
    case.write_dem()
    surface = open_dem(case.dem_file, "ellipsoid")
    image = np.random.default_rng(1).uniform(0, 1, (4000, 2)) * case.frame
    ground = case.ground_of(image)
    errors = surface.heights(ground[:, :2], UTM) - ground[:, 2]
    # White errors of samples are less between them.
    assert np.hypot(3.0, 0.5) * 0.7 < errors.std() < np.hypot(3.0, 1.0) * 1.3
    exact = Case(SMALL, tmp_path)
    exact.write_dem()
    surface = open_dem(exact.dem_file, "ellipsoid")
    np.testing.assert_allclose(surface.heights(ground[:, :2], UTM), ground[:, 2], atol=1e-3)


@pytest.mark.parametrize(
    ("length", "roughness"), [(2.0, "gaussian"), (9.0, "gaussian"), (9.0, "matern"), (9.0, "exponential")]
)
def test_fields_have_the_sigma_and_the_correlation_stated(length, roughness):
    field = field_of(np.random.default_rng(4), 512, length, roughness)
    assert field.std() == pytest.approx(1.0, abs=0.1)
    for distance in (1, int(length)):
        expected = float(correlation(roughness, np.array(distance / length)))
        assert (field * np.roll(field, distance, 1)).mean() == pytest.approx(expected, abs=0.1)


def pictured(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Return the scene, and the reference brought into the scene by the truth (to the nearest pixel)."""
    scene = gdal.Open(str(case.scene_file)).ReadAsArray().astype(float)
    dataset = gdal.Open(str(case.reference_file))
    left, step, _, top, _, _ = dataset.GetGeoTransform()
    values = dataset.ReadAsArray().astype(float)
    x, y = case.mesh(np.arange(case.frame[0]) + 0.5, np.arange(case.frame[1]) + 0.5)
    column, row = ((x - left) / step).astype(int), ((top - y) / step).astype(int)
    return scene, values[row, column]


def test_a_reference_that_lies_elsewhere_is_moved_by_what_is_stated(tmp_path):
    setting = replace(SMALL, scene=View(noise=0.02), reference=View(noise=0.02))
    case = Case(setting, tmp_path)
    moved, reference = pictured(Case(replace(setting, offset=(5.0, -3.0)), tmp_path).write())
    shift, _, _ = phase_cross_correlation(moved, reference, upsample_factor=20)
    # The reference shows everything 5 m too far east and 3 m south.
    middle = case.ground_of([[140.0, 120.0]])[:, :2]
    wanted = (case.image_of(middle) - case.image_of(middle + np.array([5.0, -3.0])))[0]
    assert shift[::-1] == pytest.approx(wanted, abs=0.3)


def test_other_views_are_other_images_of_the_same_shapes(tmp_path):
    case = Case(SMALL, tmp_path)
    (plain,) = case.rendered()
    for changes in ({"season": 1}, {"bands": "b"}):
        (other,) = Case(replace(SMALL, scene=replace(QUIET, **changes)), tmp_path).rendered()
        assert np.abs(np.corrcoef(plain.ravel(), other.ravel())[0, 1]) < 0.9
        edges = [np.hypot(*np.gradient(image)).ravel() for image in (plain, other)]
        assert np.corrcoef(*edges)[0, 1] > 0.4


def test_the_sky_covers_what_it_is_said_to():
    tone = np.full((300, 400), 0.4, np.float32)

    def over(**changes: float) -> np.ndarray:
        return Sky(tone.shape, np.random.default_rng(3)).over(tone, replace(QUIET, **changes))

    assert (over(clouds=0.4) > 0.55).mean() == pytest.approx(0.4, abs=0.06)
    assert (over(shadows=0.3) < 0.3).mean() == pytest.approx(0.3, abs=0.06)
    assert np.isnan(over(holes=0.1)).mean() == pytest.approx(0.1, abs=0.01)
    assert over(noise=0.05).std() == pytest.approx(0.05, rel=0.03)
    assert over(stripes=0.05).mean(axis=0).std() == pytest.approx(0.05, rel=0.2)
    assert 0.4 <= over(haze=0.5).min() < over(haze=0.5).max() < 0.66


def test_another_place_has_nothing_in_common(tmp_path):
    scene, reference = pictured(Case(replace(SMALL, elsewhere=True), tmp_path).write())
    window = np.outer(np.hanning(scene.shape[0]), np.hanning(scene.shape[1]))
    one, other = ((image - image.mean()) / image.std() * window for image in (scene, reference))
    peak = np.fft.irfft2(np.fft.rfft2(one) * np.conj(np.fft.rfft2(other))).max() / (window**2).sum()
    assert peak < 0.5


@pytest.mark.slow
def test_grounds_repeat_only_at_their_rims():
    tone = landscape.land("country").tones["a"]
    assert tone.shape == (SIZE, SIZE)
    # No seam where it repeats.
    steps = np.abs(np.diff(tone, axis=0, prepend=tone[-1:])).mean(axis=1)
    assert steps[0] < 2 * np.median(steps)
    for shift in (64, 300, 1000):
        assert abs(np.corrcoef(tone.ravel(), np.roll(tone, shift, 1).ravel())[0, 1]) < 0.6


@pytest.mark.parametrize(
    "ground",
    ["country", *(pytest.param(one, marks=pytest.mark.slow) for one in ("woods", "town")),
     pytest.param("real", marks=[pytest.mark.slow, pytest.mark.realdata])],
)  # fmt: skip
def test_scene_and_reference_show_the_same_ground(tmp_path, ground):
    setting = replace(SMALL, ground=ground, scene=View(noise=0.02), reference=View(noise=0.02))
    case = Case(setting, tmp_path).write()
    scene, reference = pictured(case)
    shift, _, _ = phase_cross_correlation(scene, reference, upsample_factor=20)
    assert np.abs(shift).max() <= 0.1
    assert np.corrcoef(scene.ravel(), reference.ravel())[0, 1] > 0.8
