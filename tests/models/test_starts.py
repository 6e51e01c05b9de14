"""Start values: normalisation and systems of classical models, and the blank camera of a resection."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from ortho_pipeline.models.families import family_of
from ortho_pipeline.models.frame.resection import _blank
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.rational_start import _normalisation, _with_heights, model_crs
from ortho_pipeline.points import Points


def points(ground: list[list[float]]) -> Points:
    return Points.of([[1.0, 2.0]] * len(ground), ground, pyproj.CRS(4326))


def test_coordinates_are_normalised_to_minus_one_and_one() -> None:
    values = np.array([[3.0, 500_000.0, 7.0], [9.0, 500_010.0, 7.0], [5.0, 500_004.0, 7.0]])
    offset, scale = _normalisation(values)
    np.testing.assert_allclose(offset, [6.0, 500_005.0, 7.0])
    np.testing.assert_allclose(scale, [3.0, 5.0, 1.0])
    # Up to rounding the same: 1e-7 of a million is noise, 1e-5 is not.
    for apart, expected in ((1e-7, 1.0), (1e-5, 5e-6)):
        scale = _normalisation(np.array([[1e6], [1e6 + apart]]))[1]
        assert scale[0] == pytest.approx(expected, rel=1e-3)


def test_a_model_of_the_plane_fills_missing_heights_with_their_mean() -> None:
    ground = np.array([[179.5, 1.0, 100.0], [-179.5, 2.0, np.nan], [-179.0, 3.0, 300.0]])
    plane = _with_heights(ground, family_of("affine2d"), True)
    np.testing.assert_allclose(plane[:, 2], [100.0, 200.0, 300.0])
    np.testing.assert_allclose(plane[:, 0], [179.5, 180.5, 181.0])
    assert np.isnan(_with_heights(ground, family_of("affine3d"), True)[1, 2])
    np.testing.assert_array_equal(_with_heights(ground, family_of("affine3d"), False)[:, 0], ground[:, 0])
    ground[:, 2] = np.nan
    np.testing.assert_array_equal(_with_heights(ground, family_of("affine2d"), True)[:, 2], 0.0)
    unknown = np.full((2, 3), np.nan)
    assert np.isnan(_with_heights(unknown, family_of("affine2d"), True)[:, 0]).all()
    near = np.array([[-80.0, 1.0, 0.0], [100.0, 2.0, 0.0]])
    np.testing.assert_array_equal(_with_heights(near, family_of("affine2d"), True)[:, 0], [-80.0, 100.0])


def test_the_zone_is_that_of_the_mean_longitude_also_across_the_antimeridian() -> None:
    assert model_crs("utm", points([[14.0, 50.0, 1.0], [16.0, 50.0, 1.0]])) == "EPSG:32633"
    assert model_crs(" UTM ", points([[179.9, -20.0, 1.0], [-179.7, -20.0, 1.0]])) == "EPSG:32701"
    assert model_crs("geographic", points([[1.0, 2.0, 3.0]])) == "EPSG:4979"
    assert model_crs("EPSG:4978", points([[1.0, 2.0, 3.0]])) == "geocentric"
    assert model_crs("epsg:2154", points([[1.0, 2.0, 3.0]])) == "EPSG:2154"


def test_a_camera_begins_above_the_middle_of_the_points() -> None:
    interior = Interior(1000, 1500, 0.120, 1e-4, 1e-4)
    east = points([[10.0, 50.0, 100.0], [12.0, 51.0, 300.0]])
    made = _blank(east, interior, None, False)
    assert made.origin == (11.0, 50.5, 200.0)
    assert made.heights == (99.0, 301.0)
    assert made.exterior.tolist() == [0.0, 0.0, 301.0, 0.0, 0.0, 0.0]
    across = _blank(points([[179.5, 50.0, 100.0], [-179.3, 51.0, 300.0]]), interior, None, True)
    assert across.origin[0] % 360 == pytest.approx(180.1)
    assert across.refraction
    on_map = _blank(east, interior, "EPSG:32633", False)
    assert on_map.origin == (0.0, 0.0, 0.0)
    assert on_map.ground_crs == "EPSG:32633"
