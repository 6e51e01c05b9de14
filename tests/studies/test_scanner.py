"""Simulated scenes: the camera inverts itself, the image shows the landscape, the points have the noise they claim."""

from __future__ import annotations

import json

import numpy as np
import pyproj
import pytest
from ortho_studies.simulation.earth import geocentric, geodetic
from ortho_studies.simulation.scanner import LineScanner, meet_terrain, render, simulate_points
from ortho_studies.simulation.terrain import Landscape, Terrain

from ortho_pipeline.errors import InputError
from ortho_pipeline.models import KINDS
from ortho_pipeline.testing import check_sensor_model

CENTRE = (33.35, 37.25, 850.0)
HEIGHTS = (650.0, 1350.0)


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return Terrain("EPSG:32636", 531100.0, 4122700.0)


@pytest.fixture(scope="module")
def camera() -> LineScanner:
    return LineScanner.over(*CENTRE, off_nadir_deg=20.0, heights=HEIGHTS)


def somewhere(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1000, (count, 2))


# -- camera ----------------------------------------------------------------------------------------------------------


def test_camera_keeps_the_contract(camera, monkeypatch):
    # Registered as a plugin's hook would do it: files of real scenes have no business with it.
    monkeypatch.setitem(KINDS, LineScanner.kind, LineScanner)
    centre, half = camera.domain
    ground = centre + half * np.random.default_rng(1).uniform(-0.8, 0.8, (40, 3))
    check_sensor_model(camera, ground)


@pytest.mark.parametrize("height", [-100.0, 850.0, 4000.0])
def test_inverse_closes(camera, height):
    image = somewhere(2000)
    ground = camera.image_to_ground(image, height)
    assert np.abs(camera.ground_to_image(ground) - image).max() < 1e-6
    assert (ground[:, 2] == height).all()


@pytest.mark.parametrize(
    ("lon", "lat", "heading", "off_nadir"),
    [(179.9999, 10.0, 190.0, 25.0), (-60.0, -72.0, 350.0, -15.0), (10, 0, 98, 0)],
)
def test_camera_anywhere_on_earth(lon, lat, heading, off_nadir):
    camera = LineScanner.over(lon, lat, 30.0, heading_deg=heading, off_nadir_deg=off_nadir, gsd=1.0)
    image = somewhere(50)
    assert np.abs(camera.ground_to_image(camera.image_to_ground(image, 100.0)) - image).max() < 1e-6


def test_middle_of_the_image_is_where_it_was_aimed(camera):
    assert camera.ground_to_image([CENTRE])[0] == pytest.approx((500.0, 500.0), abs=1e-6)


def test_pixel_has_the_size_asked_for(camera):
    ground = camera.image_to_ground([[500, 500], [501, 500], [500, 501]], CENTRE[2])
    geod = pyproj.Geod(ellps="WGS84")
    for other in (1, 2):
        _, _, metres = geod.inv(*ground[0, :2], *ground[other, :2])
        assert metres == pytest.approx(2.5, rel=5e-3)


def test_southward_pass_gives_a_north_up_image(camera):
    top, bottom, left, right = camera.image_to_ground([[500, 0], [500, 1000], [0, 500], [1000, 500]], 850.0)
    assert top[1] > bottom[1]
    assert left[0] < right[0]


def test_relief_leans_by_the_incidence_angle(camera):
    low, high = (camera.image_to_ground([[500.0, 500.0]], h)[0] for h in (800.0, 900.0))
    _, _, metres = pyproj.Geod(ellps="WGS84").inv(*low[:2], *high[:2])
    # Sine rule in the triangle Earth centre, satellite, ground.
    incidence = np.arcsin(camera.radius * np.sin(camera.roll) / np.linalg.norm(geocentric(np.array([CENTRE]))))
    assert metres / 100 == pytest.approx(np.tan(incidence), rel=5e-3)


def test_point_behind_the_earth_is_nan(camera):
    lon, lat, _ = CENTRE
    assert np.isnan(camera.ground_to_image([[lon - 180.0, -lat, 0.0], [np.nan, lat, 0.0]])).all()


def test_ray_into_space_is_nan(camera):
    assert np.isnan(camera.with_params([1.5, 0, 0]).image_to_ground([[500.0, 500.0]], 0.0)).all()


def test_camera_survives_json(camera):
    again = LineScanner.from_dict(json.loads(json.dumps(camera.to_dict())))
    ground = camera.image_to_ground(somewhere(20), 900.0)
    assert (again.ground_to_image(ground) == camera.ground_to_image(ground)).all()


def test_camera_without_pixels_is_refused():
    with pytest.raises(InputError):
        LineScanner.over(*CENTRE, image_width=0)


def test_geocentric_agrees_with_proj():
    rng = np.random.default_rng(3)
    ground = np.stack(
        [rng.uniform(-180, 180, 500), rng.uniform(-89.9, 89.9, 500), rng.uniform(-500, 9000, 500)], axis=1
    )
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    assert np.abs(geocentric(ground) - np.stack(to_ecef.transform(*ground.T), axis=1)).max() < 1e-6
    back = geodetic(geocentric(ground))
    assert np.abs(back - ground)[:, :2].max() < 1e-12 * 360
    assert np.abs(back - ground)[:, 2].max() < 1e-7


# -- terrain, landscape, image ---------------------------------------------------------------------------------------


def test_rays_end_on_the_terrain(camera, terrain):
    image = somewhere(3000)
    ground = meet_terrain(camera, terrain, image)
    assert np.abs(terrain(ground[:, 0], ground[:, 1]) - ground[:, 2]).max() < 1e-6
    assert np.abs(camera.ground_to_image(ground) - image).max() < 1e-6
    assert np.ptp(ground[:, 2]) > 300


def test_terrain_is_smooth_and_ends_at_the_lake(terrain):
    xy = np.random.default_rng(2).uniform(-1500, 1500, (2000, 2)) + np.array([terrain.x0, terrain.y0])
    heights = terrain.heights(xy)
    assert heights.min() >= terrain.lake_level
    # A post spacing of 20 m with linear interpolation loses only centimetres to decimetres.
    middle = sum(terrain.heights(xy + np.array([side, 0.0])) for side in (-10, 10)) / 2
    assert np.sqrt(((middle - heights) ** 2).mean()) < 0.1


def test_image_shows_the_landscape_where_the_camera_looks(camera, terrain):
    landscape = Landscape(terrain)
    window = (400, 300, 60, 40)
    image = render(camera, terrain, landscape, window=window, noise_dn=0.0)
    assert image.shape == (40, 60)
    assert image.dtype == np.uint16
    ground = meet_terrain(camera, terrain, [[417.5, 323.5]])
    brightness = landscape(terrain.xy(ground[:, 0], ground[:, 1]))[0]
    assert image[23, 17] == round(60 + 1900 * brightness)


def test_flat_pattern_leaves_the_noise(camera, terrain):
    image = render(camera, terrain, lambda xy: np.full(len(xy), 0.5), window=(0, 0, 200, 50), noise_dn=4.0)
    assert image.mean() == pytest.approx(1010, abs=0.3)
    assert image.std() == pytest.approx(4.0, rel=0.05)


def test_same_seed_same_image_other_seed_other_noise(camera, terrain):
    images = [render(camera, terrain, Landscape(terrain), window=(0, 0, 20, 20), seed=seed) for seed in (4, 4, 5)]
    assert (images[0] == images[1]).all()
    assert (images[0] != images[2]).any()


def test_window_is_part_of_the_whole(camera, terrain):
    landscape = Landscape(terrain)
    large = render(camera, terrain, landscape, window=(100, 200, 40, 30), noise_dn=0)
    small = render(camera, terrain, landscape, window=(110, 205, 10, 10), noise_dn=0)
    assert (large[5:15, 10:20] == small).all()


def test_brightness_is_continuous(terrain):
    """Edges are as wide as the softness: a jump would alias, and no ortho could be compared with it."""
    start = np.array([terrain.x0 - 1200.0, terrain.y0 + 150.0])
    xy = start + np.arange(48000)[:, None] * (0.05, 0.0)
    values = Landscape(terrain)(xy)
    assert ((values >= 0) & (values <= 1)).all()
    assert np.quantile(np.abs(np.diff(values)), 0.9995) < 0.05


# -- points ----------------------------------------------------------------------------------------------------------


def test_points_have_the_noise_they_claim(camera, terrain):
    made = simulate_points(camera, terrain, control=600, check=200, sigma_image=0.2, sigma_ground=0.0, seed=3)
    residuals = made.measured.image - camera.ground_to_image(made.measured.ground)
    assert residuals.std(axis=0) == pytest.approx((0.2, 0.2), rel=0.1)
    assert np.abs(residuals.mean(axis=0)).max() < 0.03
    made = simulate_points(camera, terrain, control=600, check=200, sigma_image=0.0, sigma_ground=0.3, seed=3)
    moved = geocentric(made.measured.ground) - geocentric(made.true_ground)
    assert moved.std(axis=0) == pytest.approx((0.3, 0.3, 0.3), rel=0.1)
    assert (made.measured.image == made.true_image).all()


def test_points_are_spread_and_have_roles(camera, terrain):
    made = simulate_points(camera, terrain)
    assert (made.measured.control.sum(), made.measured.check.sum()) == (12, 6)
    assert len(set(made.measured.ids)) == 18
    assert (np.ptp(made.true_image, axis=0) > 600).all()
    assert np.abs(camera.ground_to_image(made.true_ground) - made.true_image).max() < 1e-6


def test_points_come_from_their_seed(camera, terrain):
    first, again, other = (simulate_points(camera, terrain, seed=seed).measured for seed in (1, 1, 2))
    assert (first.image == again.image).all()
    assert (first.ground == again.ground).all()
    assert (first.image != other.image).any()


@pytest.mark.parametrize("counts", [{"control": 0, "check": 0}, {"control": -1, "check": 5}])
def test_no_points_is_an_error(camera, terrain, counts):
    with pytest.raises(InputError):
        simulate_points(camera, terrain, **counts)


# -- the sample ------------------------------------------------------------------------------------------------------


def test_sample_is_what_its_truth_says(sample):
    from ortho_pipeline.exchange.rpc import read_rpc
    from ortho_pipeline.points import read_points

    truth = json.loads((sample / "truth.json").read_text(encoding="utf-8"))
    camera = LineScanner.from_dict(truth["camera"])
    measured = read_points(sample / "gcps.geojson").to_crs("EPSG:4979")
    same = read_points(sample / "gcps.csv").to_crs("EPSG:4979")
    assert same.ids == measured.ids
    assert np.abs(same.image - measured.image).max() < 1e-9
    assert np.abs(same.ground - measured.ground).max() < 1e-6
    true_ground = np.array([point["lon_lat_h"] for point in truth["points"]])
    true_image = np.array([point["image"] for point in truth["points"]])
    assert np.abs(camera.ground_to_image(true_ground) - true_image).max() < 1e-6
    assert np.abs(measured.image - true_image).max() < 4 * 0.15
    bias, delivered = truth["rpc"]["bias_px"], read_rpc(sample / "scene_RPC.TXT")
    away = (true_image - delivered.ground_to_image(true_ground)) - (bias["col"], bias["row"])
    drift = (true_image[:, 1:] - 500) * (bias["col_per_row"], bias["row_per_row"])
    assert np.abs(away - drift).max() < 0.002


def test_sample_dem_is_the_terrain(sample):
    from ortho_pipeline.surface.dem import open_dem

    truth = json.loads((sample / "truth.json").read_text(encoding="utf-8"))
    terrain = Terrain(**truth["terrain"])
    ground = np.array([point["lon_lat_h"] for point in truth["points"]])
    heights = open_dem(sample / "dem.tif").heights(ground[:, :2], "EPSG:4979")
    assert np.abs(heights - ground[:, 2]).max() < 0.5
    assert np.abs(terrain(ground[:, 0], ground[:, 1]) - ground[:, 2]).max() < 1e-6
