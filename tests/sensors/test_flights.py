"""A simulated flight with wrong tags: adjusted, its orthos fit, and errors are as large as their sigmas say."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture(scope="module")
def flights() -> Any:
    path = Path(__file__).parents[2] / "benchmarks" / "flights.py"
    spec = importlib.util.spec_from_file_location("flights", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["flights"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("kind", ["exif", "datum"])
def test_a_flight_with_wrong_tags_comes_right(flights, kind):
    found = flights.trial(flights.KINDS[kind], 16, 1)
    assert found["naive"][1] > 20.0
    assert found["found"][1] < 1.0
    assert found["shift"] < 4.0
    # Sixteen photos of one block: their errors have much in common.
    spread = np.sqrt(np.mean([value**2 for values in found["spread"].values() for value in values]))
    assert 0.4 < spread < 1.8
