"""Points along an outline, and longitudes where it is cut."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
import shapely

from ortho_pipeline.raster.valid_area import to_geojson

DEGREES = pyproj.CRS("EPSG:4326")


@pytest.mark.parametrize(("width", "height", "points"), [(16.0, 4.0, 80), (4.0, 16.0, 80), (3.0, 3.0, 128)])
def test_sides_have_points_at_every_thirty_second_part_of_the_longer_one(
    width: float, height: float, points: int
) -> None:
    outline = shapely.box(100.0, 20.0, 100.0 + width, 20.0 + height)
    geometry, box = to_geojson(outline, DEGREES)
    ring = np.array(geometry["coordinates"][0])
    assert len(ring) == points + 1
    np.testing.assert_allclose(np.hypot(*np.diff(ring, axis=0).T), max(width, height) / 32, atol=2e-7)
    assert box == [100.0, 20.0, 100.0 + width, 20.0 + height]


@pytest.mark.parametrize("west", [-180.0, 170.0, 172.5, 180.0, 530.0, -190.0])
def test_parts_are_cut_at_the_antimeridian(west: float) -> None:
    """Ten degrees wide: each part has longitudes from -180 to 180 degrees, and both have all of the area."""
    geometry, box = to_geojson(shapely.box(west, 1.0, west + 10.0, 3.0), DEGREES)
    shape = shapely.geometry.shape(geometry)
    assert shape.area == pytest.approx(20.0)
    assert shape.bounds[0] >= -180
    assert shape.bounds[2] <= 180
    first = (west + 180) % 360 - 180
    assert (box[0], box[1], box[3]) == (first, 1.0, 3.0)
    assert (box[2] - (first + 10)) % 360 == 0
    ends = sorted(part.bounds[::2] for part in shapely.get_parts(shape))
    within = 180 - first
    assert ends == ([(first, first + 10)] if within >= 10 else [(-180.0, first + 10 - 360), (first, 180.0)])


def test_coordinates_have_seven_decimals() -> None:
    geometry, box = to_geojson(shapely.box(1.23456789, 2.0, 3.98765432, 4.0), DEGREES)
    assert (box[0], box[2]) == (1.2345679, 3.9876543)
    ring = np.array(geometry["coordinates"][0])
    assert ring[:, 0].min() == 1.2345679
