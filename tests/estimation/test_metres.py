"""Metres and directions of a scene are of the ground, whatever CRS its model is in: against rays in space."""

from __future__ import annotations

import numpy as np
import pytest
from space import FLOOR, Satellite, axes, between, from_space, to_space

from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.ground_residuals import in_metres, viewing
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.points import Points

PLACE = (17.9, 60.0)
SYSTEMS = (
    "EPSG:4979",
    "EPSG:3857",
    "EPSG:3035",
    "EPSG:3413",
    "+proj=tmerc +lat_0=50 +lon_0=14 +units=us-ft +datum=WGS84",
)


def points_of(crs: str, **more) -> tuple[Satellite, Points, np.ndarray]:
    """Return the satellite in a CRS, points whose image is off by 2 and -1 px, and where they are in space."""
    model, random = Satellite(PLACE, ground_crs=crs), np.random.default_rng(1)
    image, heights = random.uniform(50, 550, (12, 2)), FLOOR + random.uniform(-100, 100, 12)
    lonlat = from_space(model.seen_at(image, heights))
    ground = np.column_stack(between("EPSG:4979", crs).transform(*lonlat.T))
    return model, Points.of(image + np.array([2.0, -1.0]), ground, crs, **more), lonlat


@pytest.mark.parametrize("crs", SYSTEMS)
def test_the_view_is_that_of_the_ray(crs):
    seen = viewing(Satellite(PLACE, ground_crs=crs), 600, 600)
    assert seen["view"]["incidence_deg"] == pytest.approx(26.0, abs=0.005)
    assert seen["view"]["sensor_azimuth_deg"] == pytest.approx(98.0, abs=0.005)
    assert seen["lean_azimuth_deg"] == pytest.approx(278.0, abs=0.005)
    assert seen["lean_m_per_m"] == pytest.approx(np.tan(np.radians(26.0)), rel=1e-4)
    # A pixel is 5 m across the line of sight.
    assert seen["view"]["pixel_m"]["across_view"] == pytest.approx(5.0, rel=2e-3)
    assert seen["view"]["pixel_m"]["along_view"] == pytest.approx(5.0 / np.cos(np.radians(26.0)), rel=2e-3)


@pytest.mark.parametrize("crs", SYSTEMS)
def test_residuals_are_metres_east_and_north(crs):
    model, points, lonlat = points_of(crs)
    made = fit(model, points)
    off = model.seen_at(points.image, lonlat[:, 2]) - to_space(lonlat)
    true = np.einsum("nij,nj->ni", axes(lonlat), off)[:, :2]
    assert np.hypot(*true.T).min() > 8
    np.testing.assert_allclose(in_metres(made, made.raw_residuals), true, atol=2e-3)


@pytest.mark.parametrize("crs", SYSTEMS)
def test_errors_of_the_ground_are_metres_east_north_and_up(crs):
    sigma = np.array([3.0, 0.5, 1.0])
    model, points, lonlat = points_of(crs, sigma_ground=sigma, sigma_image=1e-6)
    there, place = model.ground_to_image, between("EPSG:4978", crs)

    def seen(way: np.ndarray) -> np.ndarray:
        moved = to_space(lonlat) + np.einsum("j,njk->nk", way, axes(lonlat))
        return there(np.column_stack(place.transform(*moved.T)))

    moved = np.stack([seen(step) - seen(-step) for step in np.diag(sigma) / 2], axis=2)
    np.testing.assert_allclose(
        ImageErrors.of(model, points).covariance, moved @ moved.transpose(0, 2, 1), rtol=1e-3, atol=1e-6
    )
