"""Real orthos: two aerial orthos and Landsat of one place see the same displacement of each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.options import MatchOptions

pytestmark = pytest.mark.realdata
AERIAL = ("ngi_rgb_byte_1.tif", "ngi_rgb_byte_2.tif")


def bias_of(document: dict[str, Any]) -> np.ndarray:
    return np.array([document["relative"][f"bias_{axis}_m"]["value"] for axis in ("east", "north")])


def half_of(document: dict[str, Any]) -> np.ndarray:
    found = [document["relative"][f"bias_{axis}_m"] for axis in ("east", "north")]
    return np.array([(one["high"] - one["low"]) / 2 for one in found])


@pytest.fixture(scope="module")
def homonim(real: Path) -> Path:
    return real / "homonim"


@pytest.mark.slow
def test_aerial_orthos_see_the_same_displacement_of_each_other(homonim):
    first, second = (homonim / name for name in AERIAL)
    there = verify(first, match=MatchOptions(reference=[str(second)])).document
    back = verify(second, match=MatchOptions(reference=[str(first)])).document
    # They overlap in a part of each. Both are measured there.
    limit = 3.0 * np.hypot(half_of(there), half_of(back)) / 1.96 + 0.25
    assert (np.abs(bias_of(there) + bias_of(back)) < limit).all()


@pytest.mark.slow
def test_landsat_and_an_aerial_ortho_see_the_same_displacement_of_each_other(homonim):
    landsat, aerial = homonim / "landsat8_byte.tif", homonim / AERIAL[1]
    there = verify(aerial, match=MatchOptions(reference=[str(landsat)])).document
    back = verify(landsat, match=MatchOptions(reference=[str(aerial)])).document
    # Both are measured where they overlap, in pixels of 5 m and of 30 m.
    limit = 3.0 * np.hypot(half_of(there), half_of(back)) / 1.96 + 1.5
    assert (np.abs(bias_of(there) + bias_of(back)) < limit).all()
