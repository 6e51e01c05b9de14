"""Circular errors: against drawn errors, against the closed forms of a line and of a circle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate, stats

from ortho_pipeline.warp.quality.error_ellipse import circular_error, circular_error_of_all, radii


def test_a_line_and_a_circle_are_those_of_the_normal_and_the_rayleigh_distribution():
    line, circle = circular_error(np.array([[4.0, 0.0, 0.0], [4.0, 4.0, 0.0]]))
    assert line == pytest.approx(2 * stats.norm.ppf(0.95), rel=1e-6)
    assert circle == pytest.approx(2 * math.sqrt(-2 * math.log(0.1)), rel=1e-6)
    # An axis that lies askew has the same length.
    assert circular_error(np.array([[2.0, 2.0, 2.0]]))[0] == pytest.approx(line, rel=1e-6)


@pytest.mark.parametrize("ratio", [0.003, 0.0501, 0.3, 0.77])
def test_an_ellipse_holds_nine_tenths_of_the_density_within_its_circle(ratio):
    radius = circular_error(np.array([[1.0, ratio**2, 0.0]]))[0]

    def strip(x: float) -> float:
        return stats.norm.pdf(x) * math.erf(math.sqrt(radius**2 - x**2) / ratio / math.sqrt(2))

    assert integrate.quad(strip, -radius, radius, limit=400, points=[0.0])[0] == pytest.approx(0.9, abs=2e-6)
    assert np.diff(radii()).min() > -1e-9


def test_all_places_together_are_a_mixture():
    random = np.random.default_rng(1)
    covariance = np.array([[1.0, 0.3, 0.2], [9.0, 4.0, -3.0]])
    drawn = [random.multivariate_normal([0, 0], [[xx, xy], [xy, yy]], 200_000) for xx, yy, xy in covariance]
    lengths = np.hypot(*np.concatenate(drawn).T)
    assert circular_error_of_all(covariance) == pytest.approx(np.quantile(lengths, 0.9), rel=0.01)
    assert circular_error_of_all(covariance[:1]) == pytest.approx(circular_error(covariance[:1])[0], rel=1e-6)
