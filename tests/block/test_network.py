"""The network of a block: against the places of cameras that are known, and the page that shows it."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.intersection import intersect
from ortho_pipeline.block.network import network_of
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.geodesy.ellipsoid import geocentric
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points

PLACES = {
    "a": (12.49, 41.9, 3000.0),
    "b": (12.50, 41.9, 3000.0),
    "c": (12.51, 41.905, 2600.0),
    "d": (12.60, 41.9, 3000.0),
}


@pytest.fixture(scope="module")
def block():
    """Three cameras over one place, and one that sees other ground; all ground is known."""
    interior = Interior(width=4000, height=3000, focal_length=0.03, pitch_x=5e-6, pitch_y=5e-6)
    cameras = {
        name: FrameCamera.from_roll_pitch_yaw(interior, place, 0.0, 0.0, 0.3, heights=(0.0, 300.0))
        for name, place in PLACES.items()
    }
    random = np.random.default_rng(2)
    ground = np.column_stack(
        [random.uniform(12.495, 12.505, 20), random.uniform(41.896, 41.904, 20), random.uniform(0, 300, 20)]
    )
    ground[15:, 0] += 0.1
    tables = {}
    for name, camera in cameras.items():
        here = np.arange(15, 20) if name == "d" else np.arange(15 if name != "c" else 6)
        tables[name] = Points.of(
            camera.ground_to_image(ground[here]),
            ground[here],
            "EPSG:4979",
            ids=[f"p{k}" for k in here],
            sigma_ground=0.1,
        )
    return cameras, adjust(cameras, BlockPoints.of(tables)), ground


def test_angles_are_those_between_the_places_of_the_cameras(block):
    _, fit, ground = block
    network = network_of(fit)
    stations = {name: geocentric(np.array([place]))[0] for name, place in PLACES.items()}
    expected, seen = {}, np.full(20, np.nan)
    for (one, other), count in zip(itertools.combinations("abc", 2), (15, 6, 6), strict=True):
        rays = [geocentric(ground[:count]) - stations[name] for name in (one, other)]
        rays = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
        angles = np.degrees(np.arccos((rays[0] * rays[1]).sum(axis=1)))
        expected[one, other] = (count, np.median(angles))
        seen[:count] = np.fmax(seen[:count], angles)
    found = {(pair.first, pair.second): (pair.points, pair.angle_deg) for pair in network.pairs}
    assert found.keys() == expected.keys()
    for pair, (count, angle) in expected.items():
        assert found[pair][0] == count
        assert found[pair][1] == pytest.approx(angle, abs=1e-3)
    np.testing.assert_allclose(np.array(network.largest_deg, dtype=float), seen, atol=1e-3)
    # The same by the rays as they were measured.
    np.testing.assert_allclose(intersect(fit.models, fit.points).angles_deg[:15], seen[:15], atol=1e-3)


def test_images_without_points_in_common_are_parts_of_their_own(block):
    assert network_of(block[1]).parts == (("a", "b", "c"), ("d",))


def test_points_without_a_place_leave_the_others_their_angles(block):
    _, fit, _ = block
    ground = fit.ground.copy()
    ground[3] = np.nan
    before, found = network_of(fit), network_of(dataclasses.replace(fit, ground=ground))
    assert found.largest_deg[3] is None
    np.testing.assert_allclose(np.delete(np.array(found.largest_deg, dtype=float), 3),
                               np.delete(np.array(before.largest_deg, dtype=float), 3), atol=1e-6)  # fmt: skip
    assert [pair.points for pair in found.pairs] == [pair.points - 1 for pair in before.pairs]
    assert found.angles is not None
    assert found.angles.points == 14
    assert network_of(dataclasses.replace(fit, ground=np.full_like(ground, np.nan))).angles is None
