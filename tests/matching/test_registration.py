"""Bands moved by known parts of a pixel are registered without bias; truth as in test_subpixel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from test_subpixel import averaged, band, shifted

from ortho_pipeline.imaging.registration import register

pytestmark = pytest.mark.realdata


def found(fixed: NDArray[np.float64], moving: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the shift in the middle of a band, and the RMSE of the tie points (px)."""
    _, (registration,) = register([fixed, moving], ["fixed", "moving"], transform="similarity")
    centre = np.array([[fixed.shape[1] / 2, fixed.shape[0] / 2]])
    return (registration.transform(centre) - centre)[0], registration.row()["rmse"]


@pytest.mark.parametrize("shift", [0.25, 0.7])
@pytest.mark.parametrize(("name", "number"), [("ngi_rgb_byte_1.tif", 1), ("landsat8_byte.tif", 4)])
def test_a_shift_of_a_part_of_a_pixel_has_no_bias(real: Path, name: str, number: int, shift: float) -> None:
    fixed = band(real, name, number)
    moved, rmse = found(fixed, shifted(fixed, shift, shift))
    np.testing.assert_allclose(moved, shift, atol=0.005)
    assert rmse < 0.006


def test_aliasing_moves_nothing(real: Path) -> None:
    fine = band(real, "ngi_rgb_byte_1.tif", 1)[:-1, :-1]
    first, second = averaged(fine, 2), averaged(fine, 2, 1)
    rows, columns = second.shape
    moved, rmse = found(first[:rows, :columns], second)
    np.testing.assert_allclose(moved, -0.5, atol=0.005)
    assert rmse < 0.01
