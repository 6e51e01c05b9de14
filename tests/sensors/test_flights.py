"""A simulated flight with wrong tags: adjusted, its orthos fit, and errors are as large as their sigmas say."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest


@pytest.fixture(scope="module")
def flights(benchmark_module: Callable[[str], Any]) -> Any:
    return benchmark_module("flights")


@pytest.mark.parametrize("kind", [pytest.param("exif", marks=pytest.mark.slow), "datum"])
def test_a_flight_with_wrong_tags_comes_right(flights, kind):
    found = flights.trial(flights.KINDS[kind], 12, 1)
    assert found["naive"][1] > 20.0
    assert found["found"][1] < 1.0
    assert found["shift"] < 4.0
    # Twelve photos of one block: their errors have much in common.
    spread = np.sqrt(np.mean([value**2 for values in found["spread"].values() for value in values]))
    assert 0.4 < spread < 1.8


def test_an_error_of_any_cell_moves_the_mean_of_a_pair_by_its_share_of_the_overlap(flights: Any, tmp_path: Path):
    flight = flights.fly(flights.KINDS["exif"], 2, 1, tmp_path)
    poses = list(zip(flight.positions, flight.turns, strict=True))
    true = {
        name: SimpleNamespace(
            ground_to_image=lambda at, pose=pose: flights.seen(flight.kind, *pose, flights.to_ecef(at))
        )
        for name, pose in zip(flight.scenes, poses, strict=True)
    }
    photos = np.column_stack(flights.TO_ECEF.transform(*flight.positions.T, direction="INVERSE"))[:, :2]
    metres, base = np.array([86_000.0, 111_000.0]), np.linalg.norm(np.diff(flight.positions, axis=0))
    for off in np.random.default_rng(0).uniform(-20, 20, (6, 2)):
        cell = photos.mean(axis=0) + off / metres

        def heights(lonlat, crs, cell=cell):
            weights = np.maximum(1.0 - np.abs((lonlat - cell) * metres) / flights.CELL, 0.0).prod(axis=1)
            return flights.height(flight.waves, *lonlat.T) + weights

        one, other = flights.off_by(flight, true, SimpleNamespace(heights=heights))
        between = np.nansum(one - other, axis=0)
        by_metre = base / (flights.GROUND_HEIGHT + flights.ABOVE - flights.height(flight.waves, *cell))
        assert np.linalg.norm(between) == pytest.approx(by_metre, rel=0.15)
