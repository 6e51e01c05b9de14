"""A camera with a known pose and points whose stated accuracy is wrong: simulated, with true sigmas of the pose."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.estimation.fit import Prior, fit
from ortho_pipeline.models import FrameCamera
from ortho_pipeline.models.frame.camera import EXTERIOR
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points

INTERIOR = Interior(6000, 4000, focal_length=0.05, pitch_x=6e-6, pitch_y=6e-6)
SIGMAS = np.array([0.05, 0.05, 0.1, 5e-5, 5e-5, 5e-5])
#: Points are in a corner of the image: elsewhere the pose decides.
FAR = np.array([[5900.0, 3900.0], [5900.0, 100.0]])


def ratios(real: float, count: int, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    """Return errors over sigmas far from the points ``(R, 2, 2)``, and of the pose ``(R, 6)``; 0.5 px is stated."""
    random = np.random.default_rng(1)
    far, pose = [], []
    for _ in range(repeats):
        roll, pitch = 0.01 * random.normal(size=2)
        true = FrameCamera.from_roll_pitch_yaw(
            INTERIOR, [33.0, 37.0, 1000.0], roll, pitch, random.uniform(0, 6), heights=(0.0, 100.0)
        )
        told = true._replace(exterior=true.exterior + random.normal(size=6) * SIGMAS)
        image = random.uniform(100, 1500, (count, 2))
        ground = true.image_to_ground(image, random.uniform(40, 60, count))
        points = Points.of(image + random.normal(0, real, (count, 2)), ground, "EPSG:4979", sigma_image=0.5)
        priors = {
            name: Prior(*one) for name, one in zip(EXTERIOR, zip(told.exterior, SIGMAS, strict=True), strict=True)
        }
        found = fit(told, points, priors=priors)
        place = true.image_to_ground(FAR, 50.0)
        error = found.model.ground_to_image(place) - true.ground_to_image(place)
        far.append(error / found.image_sigma(place))
        pose.append((found.values - true.exterior) / found.sigmas)
    return np.array(far), np.array(pose)


@pytest.mark.parametrize("real", [0.1, 0.5, 1.5])
def test_sigmas_hold_if_points_are_better_or_worse_than_stated(real: float) -> None:
    """Before, points five times better than stated made the sigmas of the pose three times too small."""
    for one in ratios(real, 10, 25):
        # Values of one image share errors: about a quarter of them is independent.
        assert 0.75 < np.sqrt((one**2).mean()) < 1.3


@pytest.mark.parametrize("count", [1, 2])
def test_a_few_points_do_not_outweigh_the_pose(count: int) -> None:
    for one in ratios(0.5, count, 25):
        assert 0.75 < np.sqrt((one**2).mean()) < 1.3


def test_a_gross_error_is_found_among_fewer_points_than_parameters() -> None:
    """With priors for all six parameters, a single point determines the camera, and the others test it."""
    random = np.random.default_rng(2)
    true = FrameCamera.from_roll_pitch_yaw(INTERIOR, [33.0, 37.0, 1000.0], 0.01, -0.02, 2.0, heights=(0.0, 100.0))
    image = np.array([[700.0, 500.0], [5200.0, 900.0], [4800.0, 3500.0], [900.0, 3100.0], [2900.0, 2100.0]])
    ground = true.image_to_ground(image, random.uniform(40, 60, 5))
    image += random.normal(0, 0.5, (5, 2))
    image[3] += 400.0, -300.0
    priors = {name: Prior(*one) for name, one in zip(EXTERIOR, zip(true.exterior, SIGMAS, strict=True), strict=True)}
    found = fit(true, Points.of(image, ground, "EPSG:4979", sigma_image=0.5), priors=priors)
    assert [name for name, _ in found.rejected] == ["4"]
