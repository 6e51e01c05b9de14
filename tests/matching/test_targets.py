"""Which targets a scene is matched with."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from osgeo import gdal, osr

from ortho_pipeline.imaging.matching.targets import Reference, SceneView, near
from ortho_pipeline.models import RPC

SIZE = 1000


@dataclass
class Square:
    """A target of 500 m whose first corner lies some metres east and south of that of the scene, 1 m a pixel."""

    east: float
    south: float
    intensity: Any = field(default_factory=lambda: SimpleNamespace(width=500, height=500))

    def project(self, ground: np.ndarray, crs: str) -> np.ndarray:
        return (ground[:, :2] - (20.0, 0.0)) * (111_319.5, -111_319.5) + SIZE / 2 - (self.east, self.south)


@pytest.fixture
def view() -> SceneView:
    """A scene of 1000 px of 1 m on the equator."""
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[1], row[2] = 1.0, -1.0
    scale = SIZE / 2 / 111_319.5
    half = SIZE / 2
    model = RPC(half, half, 20.0, 0.0, 500.0, half, half, scale, scale, 300.0, col, one, row, one)
    return SceneView(SimpleNamespace(width=SIZE, height=SIZE), model, None)


@pytest.mark.parametrize(
    ("place", "reach", "kept"),
    [
        ((0, 0), 0, True),
        ((250, 250), 0, True),  # within the scene, between any points that one would try
        ((-490, 990), 0, True),
        ((-2000, 0), 0, False),
        ((0, 2000), 0, False),
        ((2000, 0), 1500, True),  # where the scene may be
        ((1e6, 1e6), 1500, False),
        ((np.nan, 0), 0, True),  # nowhere: what comes of it is said later
    ],
)
def test_targets_that_a_scene_cannot_see_are_left_out(view, place, reach, kept):
    here = Square(0, 0)
    found = near(view, [here, Square(*place)], reach)
    assert len(found) == 1 + kept
    assert found[0] is here


def test_where_none_is_near_all_are_kept_to_be_refused_by_name(view):
    far = [Square(1e6, 0), Square(-1e6, 0)]
    assert near(view, far, 10) == far


@pytest.mark.parametrize(("code", "circle"), [(4326, 360.0), (4807, 400.0)])
def test_a_reference_may_be_on_either_side_of_the_antimeridian(tmp_path: Path, code: int, circle: float) -> None:
    """A model that counts on to 180.01 degrees, and a map from -180 degrees or beyond 180; also in grads from Paris."""
    system = osr.SpatialReference()
    system.ImportFromEPSG(code)
    places = []
    for turn in (-1, 0, 1):
        path = tmp_path / f"{turn}.tif"
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), 40, 30, 1)
        dataset.SetProjection(system.ExportToWkt())
        dataset.SetGeoTransform((circle / 2 - 0.02 + turn * circle, 0.001, 0.0, 10.0, 0.0, -0.001))
        dataset = None
        reference = Reference.open(path)
        lon = np.array([179.99, 180.01, -179.99, -180.01]) / 360 * circle
        ground = np.column_stack([lon, np.full(4, 9.98), np.zeros(4)])
        places.append(reference.project(ground, reference.crs))
    np.testing.assert_allclose(places, np.broadcast_to(places[1], (3, 4, 2)), atol=1e-6)
    step = 0.01 / 360 * circle / 0.001
    np.testing.assert_allclose(places[1][:, 0], 20 + step * np.array([-1, 1, 1, -1]), atol=1e-6)
