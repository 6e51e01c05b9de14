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
