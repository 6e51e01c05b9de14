"""CARTOSAT-1: the simulated pair is what the paper says, and shares no code with what is fitted to it."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from ortho_studies.cartosat import truth as simulated
from ortho_studies.cartosat.truth import BIASES, PLANE, Attitude, CartosatPass, StereoPair, aim
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline.geodesy.ellipsoid import geocentric

ROOT = Path(__file__).resolve().parent.parent.parent


def level(height: float):
    return lambda lon, lat: np.full(len(lon), height)


@pytest.mark.parametrize(("view", "width"), [("fore", 30.0), ("aft", 27.0)])
def test_the_cameras_see_what_the_paper_says(view, width):
    camera = aim(view)
    size = camera.size
    image = np.array([(0, 0), (size, 0), (0, size), (size, size), (size / 2, size / 2), (3000.3, 777.7)])
    ground = camera.meet(image, level(100.0))
    assert np.abs(camera.project(ground) - image).max() < 1e-6
    east, north = PLANE.metres(*ground.T[:2])
    assert np.hypot(east[1] - east[0], north[1] - north[0]) / 1e3 == pytest.approx(width, abs=0.4)
    assert np.hypot(east[2] - east[0], north[2] - north[0]) / size == pytest.approx(2.54, abs=0.02)
    np.testing.assert_allclose([east[4], north[4]], 0.0, atol=60.0)
    # The satellite is in front of the scene or behind it, by its tilt, on its orbit.
    origin, direction = camera.rays(image[4:5])
    down = -(origin * direction).sum() / np.linalg.norm(origin)
    assert np.degrees(np.arccos(down)) == pytest.approx(abs(simulated.TILTS_DEG[view]), abs=0.1)
    assert np.linalg.norm(origin) - np.linalg.norm(geocentric(ground[4:5])) == pytest.approx(618e3, abs=200)
    # It flies south, so before the passage it is further north.
    latitudes = [np.arcsin(place[0, 2] / np.linalg.norm(place)) for place in (origin, geocentric(ground[4:5]))]
    assert np.sign(latitudes[0] - latitudes[1]) == np.sign(simulated.TILTS_DEG[view])


def test_the_scanner_agrees_with_the_one_that_was_written_apart():
    other = LineScanner.over(147.4, -42.9, 200.0, image_width=2000, image_height=2000, gsd=2.5, off_nadir_deg=0.0)
    other = other.with_params((0.004, -np.radians(20.0), 0.02))
    camera = CartosatPass(
        2000, np.array(other.radial), np.array(other.along), other.radius, np.radians(20.0), 0.0, other.line_period,
        other.pixel_tan, Attitude((0.004, 0.0, 0.02)),
    )  # fmt: skip
    image = np.random.default_rng(0).uniform(0, 2000, (50, 2))
    ground = other.image_to_ground(image, 300.0)
    origin, direction = camera.rays(image)
    origin_there, direction_there = other.rays(image)
    np.testing.assert_allclose(origin, origin_there, atol=1e-6)
    np.testing.assert_allclose(direction, direction_there, atol=1e-14)
    # Its steps are those of a scene elsewhere, so they end a little later.
    assert np.abs(camera.project(ground) - image).max() < 1e-5


def test_jitter_is_in_the_image_and_not_in_what_the_vendor_believes():
    calm, swinging = (StereoPair.make(seed=2, jitter=jitter) for jitter in (0.0, 1.0))
    moved = swinging.cameras["fore"].project(calm.ground) - calm.image("fore")
    assert 0.5 < np.sqrt((moved[:, 1] ** 2).mean()) < 1.5
    # What is seen of it across the track comes from the yaw of three degrees.
    assert np.abs(moved[:, 0]).max() < 0.1 * np.abs(moved[:, 1]).max()
    for view in ("fore", "aft"):
        np.testing.assert_array_equal(swinging.rpc(view).row_num, calm.rpc(view).row_num)


def test_the_rpcs_have_the_bias_of_table_3():
    pair = StereoPair.make(seed=4)
    for view, paper in (("fore", (0.91, 33.27)), ("aft", (15.92, 26.80))):
        miss = pair.rpc(view).ground_to_image(pair.ground) - pair.image(view)
        np.testing.assert_allclose(np.sqrt((miss**2).mean(axis=0)), paper, atol=0.15)
        # "Almost constant": what varies is the slope that was asked for.
        centred = pair.image(view) - pair.image(view).mean(axis=0)
        slopes = np.linalg.lstsq(np.column_stack([np.ones(len(miss)), centred]), miss[:, 1])[0]
        assert slopes[1] == pytest.approx(BIASES[view].row_per_col, abs=2e-5)
        assert slopes[2] == pytest.approx(BIASES[view].row_per_row, abs=2e-5)


def test_points_lie_low_in_the_upper_left_quarter_of_both_images():
    pair = StereoPair.make(seed=6)
    assert len(pair.ground) == 69
    for view in ("fore", "aft"):
        image = pair.image(view)
        assert (image > 0).all()
        assert (image < 0.55 * pair.size).all()
    assert 0 < pair.ground[:, 2].min() < pair.ground[:, 2].max() < 500
    grid = np.stack(np.meshgrid(np.linspace(147.2, 147.65, 90), np.linspace(-43.1, -42.8, 90)), axis=-1).reshape(-1, 2)
    heights = pair.hills(*grid.T)
    assert heights.min() < 15
    assert 1200 < heights.max() < 1260


def test_smaller_images_cover_the_same_ground():
    small = aim("aft", size=500)
    ends = np.array([(0.0, 0.0), (1.0, 1.0)])
    near, far = (camera.meet(ends * camera.size, level(0.0)) for camera in (small, aim("aft")))
    # The projection of a reduced pixel's corner is that of the corner of the pixels it stands for.
    np.testing.assert_allclose(near[:, :2], far[:, :2], atol=2e-5)


def test_the_truth_shares_no_code_with_the_models_and_no_estimator_sees_it():
    scene = ast.parse((ROOT / "plugins/ortho_studies/cartosat/truth.py").read_text())
    used = {
        node.module: {one.name for one in node.names} for node in ast.walk(scene) if isinstance(node, ast.ImportFrom)
    }
    # The interface of what an RPC is fitted to, and the RPC that is delivered.
    assert {name: what for name, what in used.items() if name.startswith("ortho_pipeline.models")} == {
        "ortho_pipeline.models.base": {"SensorModel"}, "ortho_pipeline.models.rational": {"RPC"},
    }  # fmt: skip
    for name in ("__init__", "layout", "metadata", "start"):
        text = (ROOT / f"plugins/ortho_cartosat/{name}.py").read_text()
        assert "experiments" not in text
        assert "simulat" not in text
