"""Interior orientation of a frame: pixels by the formula written out, its partials, and where a lens is unique."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.lens import INTERIOR, Interior

LENS = Interior(2048, 1536, 0.18, 7.3e-6, 6.9e-6, 3e-4, -2e-4, -0.31, 0.17, -0.05, 1.3e-2, -0.7e-2)
DIRECTIONS = np.array([[0.0, 0.0], [0.31, -0.22], [-0.4, 0.13], [0.05, 0.47], [-0.21, -0.33]])


def pixel(lens: Interior, u: float, v: float) -> tuple[float, float]:
    """Return column and row by the formula of the docstring."""
    r2 = u * u + v * v
    radial = 1 + lens.k1 * r2 + lens.k2 * r2**2 + lens.k3 * r2**3
    across = u * radial + 2 * lens.p1 * u * v + lens.p2 * (r2 + 2 * u * u)
    down = v * radial + lens.p1 * (r2 + 2 * v * v) + 2 * lens.p2 * u * v
    x, y = lens.x0 + lens.focal_length * across, lens.y0 - lens.focal_length * down
    return lens.width / 2 + x / lens.pitch_x, lens.height / 2 - y / lens.pitch_y


@pytest.mark.parametrize(
    "changes",
    [{}, {"k1": 0.0, "k2": 0.0, "k3": 0.0}, {"p1": 0.0, "p2": 0.0}, {"k2": 0.0, "k3": 0.0, "p1": 0.0}]
    + [{name: 0.0 for name in ("k1", "k2", "k3", "p1", "p2") if name != only} for only in ("k2", "k3", "p1", "p2", "")],
)
def test_pixels_are_those_of_the_formula_and_lead_back(changes: Any) -> None:
    lens = replace(LENS, **changes)
    image = lens.image_of(DIRECTIONS)
    np.testing.assert_allclose(image, [pixel(lens, u, v) for u, v in DIRECTIONS], atol=1e-8)
    np.testing.assert_allclose(lens.directions_of(image), DIRECTIONS, atol=1e-12)


def test_the_principal_point_is_right_and_up_of_the_middle() -> None:
    plain = Interior(2048, 1536, 0.18, 7.3e-6, 6.9e-6, 3e-4, 2e-4)
    np.testing.assert_allclose(plain.image_of(np.zeros((1, 2))), [[1024 + 3e-4 / 7.3e-6, 768 - 2e-4 / 6.9e-6]])


def test_partials_are_those_of_differences() -> None:
    """By central differences of the formula, in directions and in each parameter."""
    found = LENS.partials_of_direction(DIRECTIONS)
    for k, (u, v) in enumerate(DIRECTIONS.tolist()):
        for axis, (du, dv) in enumerate(((1e-5, 0.0), (0.0, 1e-5))):
            there, back = np.array(pixel(LENS, u + du, v + dv)), np.array(pixel(LENS, u - du, v - dv))
            np.testing.assert_allclose(found[k, :, axis], (there - back) / 2e-5, rtol=1e-6, atol=1e-3)
    partials = LENS.partials(DIRECTIONS)
    assert partials.shape == (5, 2, len(INTERIOR))
    for k, name in enumerate(INTERIOR):
        value = getattr(LENS, name)
        step = 1e-5 * abs(value)
        ends = [replace(LENS, **{name: value + sign * step}) for sign in (1, -1)]
        there, back = (np.array([pixel(lens, u, v) for u, v in DIRECTIONS]) for lens in ends)
        slope = (there - back) / (2 * step)
        np.testing.assert_allclose(partials[:, :, k], slope, rtol=1e-6, atol=1e-5 * np.abs(slope).max(), err_msg=name)


def test_the_field_of_view_is_the_angle_to_the_corner() -> None:
    corner = math.hypot(1024 * 7.3e-6, 768 * 6.9e-6)
    assert LENS.field_of_view == pytest.approx(math.atan(corner / 0.18), rel=1e-12)


@pytest.mark.parametrize(
    ("k", "limit"),
    [
        # r (1 + k1 r^2 + ...) turns where 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 is zero.
        ((-0.4, 0.0, 0.0), math.sqrt(1 / 1.2)),
        ((0.0, -0.3, 0.0), (1 / 1.5) ** 0.25),
        ((0.0, 0.0, -0.2), (1 / 1.4) ** (1 / 6)),
        # 3 k1 = -5, 5 k2 = 4: zero at r^2 = (5 - 3) / 8, the smaller of two.
        ((-5 / 3, 0.8, 0.0), 0.5),
        ((0.4, 0.0, 0.0), math.inf),
        ((0.4, 0.1, 0.3), math.inf),
        ((-1e-40, 0.0, 0.0), math.inf),
    ],
)
def test_a_lens_is_unique_up_to_where_the_distortion_turns(k: tuple[float, float, float], limit: float) -> None:
    lens = Interior(1000, 800, 0.05, 5e-6, 5e-6, k1=k[0], k2=k[1], k3=k[2])
    angle = 0.7
    way = np.array([[math.cos(angle), math.sin(angle)]])
    if limit == math.inf:
        assert np.isfinite(lens.image_of(50.0 * way)).all()
        return
    assert np.isfinite(lens.image_of(0.9999 * limit * way)).all()
    assert np.isnan(lens.image_of(1.0001 * limit * way)).all()
    inner = lens.image_of(np.concatenate([0.5 * limit * way, 0.97 * limit * way]))
    found = lens.directions_of(inner)
    np.testing.assert_allclose(np.hypot(*found.T), [0.5 * limit, 0.97 * limit], atol=1e-9)
    # Farther out than the turn of the distortion, no direction has this pixel.
    turn = np.array([pixel(lens, *(limit * way[0]))])
    middle = np.array([[500.0, 400.0]])
    assert np.isnan(lens.directions_of(middle + 1.01 * (turn - middle))).all()
    assert np.isfinite(lens.directions_of(middle + 0.99 * (turn - middle))).all()


def test_a_lens_that_is_unique_nowhere_projects_nothing_else_than_its_axis() -> None:
    lens = Interior(1000, 800, 0.05, 5e-6, 5e-6, k1=-1e120)
    assert np.isnan(lens.image_of(np.array([[1e-3, 0.0]]))).all()


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"width": 0}, "width"),
        ({"height": -1}, "height"),
        ({"focal_length": 0.0}, "focal_length"),
        ({"pitch_x": 0.0}, "pitch_x"),
        ({"pitch_y": -1e-6}, "pitch_y"),
        ({"width": 10.5}, "width, height"),
        ({"height": 10.5}, "width, height"),
        ({"p2": math.nan}, "p2"),
        ({"x0": math.inf}, "x0"),
    ],
)
def test_numbers_of_no_camera_are_refused(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as refused:
        replace(LENS, **changes)
    assert refused.value.field == field
    smallest: Array = Interior(1, 1, 1e-9, 1e-12, 1e-12).image_of(np.zeros((1, 2)))
    np.testing.assert_allclose(smallest, [[0.5, 0.5]])
