"""Centres of roundabouts of known truth: discs counted by sub-pixels and blurred, with noise, occluded, and none."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ortho_pipeline.errors import InputError
from ortho_pipeline.imaging.ellipse import fit_ellipse

Array = np.ndarray
Inside = Callable[[Array, Array], Array]
CENTRE = (31.3, 32.8)


def ellipse(a: float, b: float, turn: float = 0.5, centre: tuple[float, float] = CENTRE) -> Inside:
    def inside(x: Array, y: Array) -> Array:
        u, v = turned(x - centre[0], y - centre[1], turn)
        return (u / a) ** 2 + (v / b) ** 2 < 1

    return inside


def turned(x: Array, y: Array, turn: float) -> tuple[Array, Array]:
    return x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)


def render(inside: Inside, *, over: Inside | None = None, tone: float = 450.0, parts: int = 5, size: int = 64) -> Array:
    """Return pixels that are the mean of parts² places each, after a blur of 0.6 px; `over` covers all with a tone."""
    margin = 5
    at = (np.arange((size + 2 * margin) * parts) + 0.5) / parts - margin
    x, y = np.meshgrid(at, at)
    tones = np.where(inside(x, y), 800.0, 300.0)
    if over is not None:
        tones = np.where(over(x, y), tone, tones)
    blurred = gaussian_filter(tones, 0.6 * parts)
    pixels = blurred.reshape(size + 2 * margin, parts, size + 2 * margin, parts).mean(axis=(1, 3))
    return pixels[margin:-margin, margin:-margin]


@pytest.mark.parametrize(("a", "b", "turn"), [(20.0, 16.0, 0.5), (8.0, 7.0, 1.0), (22.0, 12.0, -0.7), (6.5, 6.5, 0.0)])
@pytest.mark.parametrize("bright", [True, False])
def test_without_noise_centre_and_axes_are_right(a, b, turn, bright):
    pixels = render(ellipse(a, b, turn), parts=9)
    found = fit_ellipse(pixels if bright else 1000 - pixels, (CENTRE[0] + 0.1 * a, CENTRE[1] - 0.1 * b), 0.9 * a)
    assert np.abs(found.centre - CENTRE).max() < 0.02
    # The blur of a bent edge, 0.03 px at the smaller radii, is taken off.
    assert np.abs(np.subtract(found.axes, (a, b))).max() < 0.02
    assert found.psf_sigma == pytest.approx(0.6, abs=0.1)
    assert found.contrast == pytest.approx(500.0 if bright else -500.0, rel=0.02)
    assert found.seen == 1.0
    if a != b:
        assert found.angle_deg == pytest.approx(math.degrees(turn), abs=1.0)
    assert ellipse(a + 0.05, b + 0.05, turn)(*found.outline().T).all()
    assert not ellipse(a - 0.05, b - 0.05, turn)(*found.outline().T).any()
    json.dumps(found.to_json(), allow_nan=False)


@pytest.mark.parametrize("count", [15, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("a", "b"), [(18.0, 14.0), (8.0, 7.0)])
def test_errors_of_the_centre_are_as_large_as_their_covariance_says(a, b, count):
    pixels, random = render(ellipse(a, b), parts=9), np.random.default_rng(3)
    errors, squares = [], []
    for _ in range(count):
        start = np.add(CENTRE, random.uniform(-0.1, 0.1, 2) * b)
        found = fit_ellipse(pixels + random.normal(0, 25.0, pixels.shape), tuple(start), 0.95 * math.sqrt(a * b))
        error = found.centre - CENTRE
        errors.append(error)
        squares.append(error @ np.linalg.solve(found.covariance, error) / 2)
    # The root of the mean of `count` squares of two degrees of freedom is known to 1 / sqrt(4 count); with a variance
    # from 14 edges beyond the five parameters it is 1.08 on average.
    assert abs(math.sqrt(np.mean(squares)) - 1.04) < 0.04 + 3 / math.sqrt(4 * count)
    # No bias beyond four standard deviations of the mean.
    assert np.abs(np.mean(errors, axis=0)).max() < 4 * np.std(errors) / math.sqrt(count)


@pytest.mark.parametrize("tone", [100.0, 450.0])
def test_two_fifths_occluded_it_is_found_where_it_is(tone):
    random = np.random.default_rng(5)
    for _ in range(4):
        begin = random.uniform(0, 2 * np.pi)

        def sector(x: Array, y: Array, begin: float = begin) -> Array:
            """Cover two fifths of the circumference, with an edge of its own along a smaller circle."""
            angle = np.arctan2(y - CENTRE[1], x - CENTRE[0]) - begin
            return (angle % (2 * np.pi) < 0.8 * np.pi) & (np.hypot(x - CENTRE[0], y - CENTRE[1]) > 9)

        pixels = render(ellipse(18.0, 14.0), over=sector, tone=tone) + random.normal(0, 10.0, (64, 64))
        found = fit_ellipse(pixels, (32.3, 32.0), 15.0)
        error = found.centre - CENTRE
        assert 0.5 < found.seen < 0.7
        assert np.abs(error).max() < 0.3
        # A chance of 1e-4 for as much as this, of two degrees of freedom over two dozen.
        assert error @ np.linalg.solve(found.covariance, error) / 2 < 14


def square(half: float, turn: float) -> Inside:
    def inside(x: Array, y: Array) -> Array:
        u, v = turned(x - 32.2, y - 31.8, turn)
        return (np.abs(u) < half) & (np.abs(v) < half)

    return inside


@pytest.mark.parametrize("half", [6.0, 10.0, 18.0])
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_square_is_refused(half, turn):
    pixels = render(square(half, turn))
    for radius in (half, 1.13 * half, 1.3 * half):
        with pytest.raises(InputError, match="no ellipse"):
            fit_ellipse(pixels, (32.2, 31.8), radius)


def test_noise_a_level_and_a_straight_edge_are_refused():
    random = np.random.default_rng(0)
    nothing = [random.normal(500, 50, (64, 64)) for _ in range(6)]
    nothing += [np.full((64, 64), 7.0), render(lambda x, y: x > 40), np.full((64, 64), np.nan)]
    for pixels in nothing:
        with pytest.raises(InputError, match="no ellipse") as caught:
            fit_ellipse(pixels, (32.0, 32.0), 12.0)
        assert caught.value.field == "centre"
        assert caught.value.remedy


def test_the_radius_says_which_of_two_rings_is_meant():
    island, road = ellipse(9.0, 8.0), ellipse(20.0, 18.0)
    pixels = render(lambda x, y: road(x, y) & ~island(x, y))
    assert fit_ellipse(pixels, CENTRE, 8.5).axes == pytest.approx((9.0, 8.0), abs=0.03)
    assert fit_ellipse(pixels, CENTRE, 19.0).axes == pytest.approx((20.0, 18.0), abs=0.03)


def test_pixels_without_a_value_are_left_out():
    pixels = render(ellipse(18.0, 14.0))
    pixels[:, 44:] = np.nan
    found = fit_ellipse(pixels, CENTRE, 16.0)
    assert found.seen < 0.9
    assert np.abs(found.centre - CENTRE).max() < 0.02


@pytest.mark.parametrize(
    ("centre", "radius", "field"),
    [((-1.0, 5.0), 9.0, "centre"), ((5.0, 5.0), 2.0, "radius"), (CENTRE, 900.0, "radius")],
)
def test_what_is_not_in_the_pixels_is_refused(centre, radius, field):
    with pytest.raises(InputError) as caught:
        fit_ellipse(np.zeros((64, 64)), centre, radius)
    assert caught.value.field == field


def test_the_centre_of_an_ellipse_is_off_the_circles_image_by_what_the_docstring_says():
    # A circle of 50 m, seen from 500 km at 45 degrees with pixels of 0.3 m at the nadir.
    distance, radius, focal = 500e3, 50.0, 500e3 / 0.3
    for incidence in np.radians([10.0, 30.0, 45.0]):
        along = radius * np.array([-1.0, 1.0])
        image = focal * along * math.cos(incidence) / (distance + along * math.sin(incidence))
        predicted = focal * radius / distance * radius / distance * math.sin(incidence) * math.cos(incidence)
        assert abs(image.mean()) == pytest.approx(predicted, rel=1e-3)
        assert predicted <= focal * radius / distance * radius / (2 * distance)
        assert predicted < 0.0085
