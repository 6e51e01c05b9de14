"""Flat ground: one height at every finite position of the world."""

from __future__ import annotations

import json

import numpy as np

from ortho_pipeline.surface.flat import FlatSurface


def test_a_whole_number_is_the_same_ground_as_a_real_one() -> None:
    """Integers are another type of samples for the compiled warp, and another number in a record."""
    whole, real = FlatSurface(85), FlatSurface(85.0)
    assert json.dumps(whole.provenance) == json.dumps(real.provenance)
    for flat in (whole, real):
        for heights in (flat.window(0, 0, 3, 2), flat.excerpt(np.zeros((1, 3)), "EPSG:4326").heights):
            assert heights.dtype == np.float64
            assert (heights == 85.0).all()


def test_ground_is_flat_at_every_finite_position() -> None:
    """A third column, such as the heights of points, does not count."""
    flat = FlatSurface(85.5)
    places = np.array([[24.0, -33.0, np.nan], [np.nan, -33.0, 1.0], [24.0, np.nan, 1.0], [-180.0, 90.0, 7.0]])
    np.testing.assert_array_equal(flat.heights(places, "EPSG:4326"), [85.5, np.nan, np.nan, 85.5])
    assert flat.coverage(places, "EPSG:4326") == 0.5
    assert flat.coverage(places[:0], "EPSG:4326") == 1.0


def test_the_excerpt_of_flat_ground_is_one_sample_of_the_world() -> None:
    made = FlatSurface(85.5).excerpt(np.array([[3e5, 6.2e6, 0.0]]), "EPSG:32735")
    west, across, turn, north, lean, down = made.geotransform
    assert (west, west + across, north + down, north) == (-180.0, 180.0, -90.0, 90.0)
    assert (turn, lean) == (0.0, 0.0)
    assert made.heights.tolist() == [[85.5]]
    assert made.crs.to_epsg() == 4326
