"""Metres and directions of a scene are of the ground, whatever CRS its model is in: against rays in space."""

from __future__ import annotations

import numpy as np
import pytest
from space import FLOOR, Satellite, axes, between, from_space, to_space

from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.ground_residuals import along_view, in_metres, viewing, with_reference_height
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.map_plane import MapPlane
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


def plane(relief: tuple[float, float]) -> MapPlane:
    """Pixels of 4 m by 3 m on the central meridian of a UTM zone, whose scale is 0.9996."""
    return MapPlane("EPSG:32633", (499_800.0, 4_640_150.0), (4.0, 3.0), (100, 100), 0.0, relief, (-50.0, 500.0))


@pytest.mark.parametrize(
    ("relief", "azimuth", "along", "across"),
    # A vertical view has no azimuth: along is north.
    [((0.0, 0.0), None, 3.0, 4.0), ((0.5, 0.0), 270.0, 4.0, 3.0), ((0.0, 0.5), 180.0, 3.0, 4.0)],
)
def test_the_view_of_a_plane_with_oblong_pixels(relief, azimuth, along, across):
    seen = viewing(plane(relief), 100, 100)
    assert seen["ground_pixel_m"] == pytest.approx([4.0 / 0.9996, 3.0 / 0.9996], rel=1e-5)
    assert seen["lean_m_per_m"] == pytest.approx(sum(relief) / 0.9996, rel=1e-5)
    assert seen["view"]["incidence_deg"] == pytest.approx(np.degrees(np.arctan(sum(relief) / 0.9996)), abs=1e-3)
    assert seen["view"]["sensor_azimuth_deg"] == (None if azimuth is None else pytest.approx(azimuth, abs=0.01))
    if azimuth is not None:
        assert seen["lean_azimuth_deg"] == pytest.approx(azimuth - 180, abs=0.01) or azimuth == 180
    assert seen["view"]["pixel_m"]["along_view"] == pytest.approx(along / 0.9996, rel=1e-5)
    assert seen["view"]["pixel_m"]["across_view"] == pytest.approx(across / 0.9996, rel=1e-5)


def test_residuals_along_and_across_the_view():
    random = np.random.default_rng(3)
    ground = np.column_stack([random.uniform(499_850, 500_150, 8), random.uniform(4_639_900, 4_640_100, 8), [50.0] * 8])
    # Higher points move to the right, upwards (rows count down), or not at all.
    for relief, column, row in (((0.5, 0.0), (1, 0), (0, 1)), ((0.0, 0.5), (0, -1), (1, 0)), ((0.0, 0.0), None, None)):
        model = plane(relief)
        image = model.ground_to_image(ground) + random.normal(0, 0.3, (8, 2))
        made = fit(ImageCorrection.identity(model, "shift", (50.0, 50.0)), Points.of(image, ground, "EPSG:32633"))
        found = along_view(made)
        if column is None:
            assert np.isnan(found).all()
        else:
            np.testing.assert_allclose(found, made.residuals @ np.array([column, row]).T, atol=1e-9)


def test_points_without_heights_are_at_the_reference_height():
    ground = np.array([[1.0, 2.0, np.nan], [3.0, 4.0, 7.0]])
    filled = with_reference_height(plane((0.5, 0.0)), ground)
    np.testing.assert_array_equal(filled, [[1.0, 2.0, 0.0], [3.0, 4.0, 7.0]])
    assert np.isnan(ground[0, 2])
