"""A simulated flight with wrong tags: adjusted, its orthos fit, and errors are as large as their sigmas say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest


@pytest.fixture(scope="module")
def flights(benchmark_module: Callable[[str], Any]) -> Any:
    return benchmark_module("flights")


@pytest.mark.parametrize("kind", [pytest.param("exif", marks=pytest.mark.slow), "datum"])
def test_a_flight_with_wrong_tags_comes_right(flights, kind):
    found = flights.trial(flights.KINDS[kind], 16, 1)
    assert found["naive"][1] > 20.0
    assert found["found"][1] < 1.0
    assert found["shift"] < 4.0
    # Sixteen photos of one block: their errors have much in common.
    spread = np.sqrt(np.mean([value**2 for values in found["spread"].values() for value in values]))
    assert 0.4 < spread < 1.8
