"""The smooth field over a model: it inverts, its spline is SciPy's, and it does not fold."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.interpolate import BSpline

from ortho_pipeline.errors import InputError
from ortho_pipeline.models import ImageCorrection, MapGrid, SmoothField, model_from_dict
from ortho_pipeline.testing import check_sensor_model

SIZE = (600, 400)
GRID = MapGrid("EPSG:32636", (500_000.0, 2.0, 0.0, 4_000_000.0, 0.0, -2.0), SIZE)


def field(scale: float = 2.0) -> SmoothField:
    coefficients = np.random.default_rng(3).normal(0, scale, (7, 9, 2))
    return SmoothField(ImageCorrection.identity(GRID, "affine", (300.0, 200.0)), SIZE, coefficients)


def test_it_is_a_sensor_model():
    model = field()
    image = np.random.default_rng(1).uniform((20, 20), (580, 380), (30, 2))
    check_sensor_model(model, model.image_to_ground(image, 100.0))
    again = model_from_dict(json.loads(json.dumps(model.to_dict())))
    np.testing.assert_array_equal(again.displacement(image), model.displacement(image))


def test_what_a_match_measures_is_the_field_there():
    model = field()
    image = np.random.default_rng(2).uniform((0, 0), SIZE, (50, 2))
    ground = model.image_to_ground(image, 0.0)
    np.testing.assert_allclose(image - model.model.ground_to_image(ground), model.displacement(image), atol=1e-6)


def test_the_spline_is_that_of_scipy():
    model = field()
    along = model.coefficients[3]
    flat = SmoothField(GRID, SIZE, np.broadcast_to(along, (7, 9, 2)))
    columns = np.linspace(100, 500, 41)
    # The cubic B-spline of a knot reaches over two knots to either side.
    expected = BSpline(np.arange(-2.0, 11.0), along[:, 0], 3)(columns / flat.spacing[0])
    found = flat.displacement(np.column_stack([columns, np.full(41, 200.0)]))[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_field_that_folds_is_refused():
    with pytest.raises(InputError, match="per pixel"):
        field(60.0)


@pytest.mark.parametrize("shape", [(7, 9), (7, 9, 3), (1, 9, 2), (7, 1, 2)])
def test_coefficients_of_another_shape_are_refused(shape):
    with pytest.raises(InputError, match=r"coefficients \(rows, columns, 2\)"):
        SmoothField(GRID, SIZE, np.zeros(shape))


def test_the_field_is_its_splines_times_its_coefficients():
    model = field()
    image = np.random.default_rng(4).uniform((-40, -40), (640, 440), (60, 2))
    across, down = model.splines(0, image[:, 0]), model.splines(1, image[:, 1])
    assert (across.shape, down.shape) == ((60, 9), (60, 7))
    expected = np.einsum("nr,nc,rcd->nd", down, across, model.coefficients)
    np.testing.assert_allclose(model.displacement(image), expected, atol=1e-12)
    # A field of the same coefficients everywhere is constant: splines add up to one.
    np.testing.assert_allclose(across.sum(axis=1), 1.0)
    np.testing.assert_allclose(down.sum(axis=1), 1.0)


def test_beyond_the_rim_the_field_is_that_of_the_rim():
    model = field()
    outside = np.array([[-50.0, 100.0], [700.0, 100.0], [300.0, -9.0], [300.0, 500.0], [900.0, 900.0]])
    rim = np.clip(outside, 0.0, SIZE)
    np.testing.assert_array_equal(model.displacement(outside), model.displacement(rim))
    assert np.isnan(model.displacement([[np.nan, 3.0], [3.0, np.nan]])).all()


def test_no_change_per_pixel_is_larger_than_the_bound():
    model = field()
    random, step = np.random.default_rng(5), 1e-3
    image, angle = random.uniform((0, 0), SIZE, (3000, 2)), random.uniform(0, 2 * np.pi, 3000)
    ahead = image + step * np.column_stack([np.cos(angle), np.sin(angle)])
    change = np.hypot(*(model.displacement(ahead) - model.displacement(image)).T) / step
    assert change.max() < model.bending < 4 * change.max()
    assert model.detail == pytest.approx(400 / 6)


@pytest.mark.parametrize("size", [(0, 400), (600, 0), (600,)])
def test_an_image_without_pixels_has_no_field(size):
    with pytest.raises(InputError, match="positive size"):
        SmoothField(GRID, size, np.zeros((4, 4, 2)))
