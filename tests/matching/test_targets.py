"""Which targets a scene is matched with."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.imaging.matching.targets import SceneView, near
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
