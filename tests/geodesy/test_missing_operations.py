"""Points that no operation of PROJ reaches: a grid is missing, or they are out of range."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj.exceptions import ProjError

from ortho_pipeline.errors import CrsError
from ortho_pipeline.geodesy import crs as module
from ortho_pipeline.geodesy.crs import GroundTransform

BEFORE = np.array([[np.nan, 1.0, 2.0], [39.0, 1.0, 50.0], [40.0, 2.0, 60.0]])


def checked(monkeypatch, message: str, grids: list[str], after: np.ndarray | None = None):
    """Check points of which none arrives, where PROJ says `message`; return those that were tried again."""
    way, tried = GroundTransform("EPSG:4979", "EPSG:32637"), []

    def leg(transformer, spatial, ground, errcheck=False):
        assert errcheck
        tried.append(ground)
        raise ProjError(message)

    monkeypatch.setattr(way, "_leg", leg)
    monkeypatch.setattr(module, "unavailable_grids", lambda source, target: grids)
    way._checked = False
    way._check(None, True, BEFORE, np.full((3, 3), np.nan) if after is None else after)
    return tried


def test_without_an_operation_the_grid_that_is_not_there_is_named(monkeypatch):
    with pytest.raises(CrsError, match=r"needs the grid us_a\.tif"):
        checked(monkeypatch, "No operation found matching criteria", ["us_a.tif", "us_b.tif"])


@pytest.mark.parametrize(
    ("message", "grids"),
    [("No operation found matching criteria", []), ("Point outside of projection domain", ["us_a.tif"])],
)
def test_points_out_of_range_are_no_missing_grid(monkeypatch, message, grids):
    (tried,) = checked(monkeypatch, message, grids)
    np.testing.assert_array_equal(tried, BEFORE[1:2])
