"""The height that undoes refraction: by integration through the air, and its derivatives by differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from ortho_pipeline.models.base import Array
from ortho_pipeline.models.light.refraction import RefractionCorrection, refraction_correction

EARTH = 6.4e6
HEIGHTS = np.array([120.0, 900.0, 2500.0])
#: Places about a point below the camera, on a round Earth and 1 to 5 km aside.
ASIDE = np.array([[900.0, -1700.0], [-2600.0, 400.0], [3100.0, 4000.0]])


def air(height: float) -> float:
    """Return the refractivity at a height."""
    return float(2.77e-4 * np.exp(-height / 9200.0))


def bend(height: float, top: float) -> float:
    return float(quad(air, height, top)[0] - air(top) * (top - height))


def flat(place: Array, centre: Array, heights: Array = HEIGHTS) -> RefractionCorrection:
    up = np.tile([0.0, 0.0, 1.0], (len(place), 1))
    return refraction_correction(heights, place, up, centre=centre, top=float(centre[2]), curvature=0.0)


def round_earth(place: Array, centre: Array, top: float) -> RefractionCorrection:
    up = place / np.linalg.norm(place, axis=1)[:, None]
    curvature = 1.0 / float(np.linalg.norm(place, axis=1).mean())
    return refraction_correction(HEIGHTS, place, up, centre=centre, top=top, curvature=curvature)


@pytest.mark.parametrize("top", [3000.0, 8000.0, 60e3])
def test_the_correction_is_the_integral_over_the_air_below_the_camera(top: float) -> None:
    place, centre = np.column_stack([ASIDE, HEIGHTS]), np.array([200.0, -300.0, top])
    line = centre - place
    cosine = line[:, 2] / np.linalg.norm(line, axis=1)
    wanted = [bend(height, top) for height in HEIGHTS] / np.maximum(cosine, 0.17) ** 2
    assert (cosine < 0.17).any() == (top == 3000.0)
    np.testing.assert_allclose(flat(place, centre).height, wanted, rtol=1e-6)


def test_derivatives_by_height_and_camera_are_differences() -> None:
    """Of a flat Earth, where the camera rises as its place does."""
    place, centre = np.column_stack([ASIDE, HEIGHTS]), np.array([200.0, -300.0, 7000.0])
    found = flat(place, centre)
    ahead, behind = (flat(place, centre, HEIGHTS + step).height for step in (0.5, -0.5))
    np.testing.assert_allclose(found.by_height, ahead - behind, rtol=1e-6)
    for axis in range(3):
        nudge = 0.5 * np.eye(3)[axis]
        slope = flat(place, centre + nudge).height - flat(place, centre - nudge).height
        np.testing.assert_allclose(found.by_centre[:, axis], slope, rtol=1e-5, atol=1e-12)
        slope = flat(place + nudge, centre).height - flat(place - nudge, centre).height
        np.testing.assert_allclose(found.by_point[:, axis], slope, rtol=1e-5, atol=1e-12)


def test_the_vertical_turns_as_a_point_moves_on_a_round_earth() -> None:
    radius = EARTH + HEIGHTS
    way = np.column_stack([ASIDE / EARTH, np.ones(3)])
    place = way / np.linalg.norm(way, axis=1)[:, None] * radius[:, None]
    centre = np.array([200.0, -300.0, EARTH + 9000.0])
    found = round_earth(place, centre, 9000.0)
    for axis in range(3):
        nudge = 2.0 * np.eye(3)[axis]
        slope = (
            round_earth(place + nudge, centre, 9000.0).height - round_earth(place - nudge, centre, 9000.0).height
        ) / 4
        np.testing.assert_allclose(found.by_point[:, axis], slope, rtol=5e-4, atol=1e-10)
