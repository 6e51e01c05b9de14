"""A simulated flight with wrong tags: adjusted, its orthos fit, and errors are as large as their sigmas say."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.points import BlockPoints


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


@pytest.mark.parametrize("off", [0.0, 30.0])
def test_control_points_with_heights_of_another_datum_are_told(flights: Any, tmp_path: Path, off: float):
    """Over flat ground they change the focal length."""
    flight = flights.fly(flights.KINDS["exif"], 6, 2, tmp_path)
    ties, poses = flight.points, list(zip(flight.positions, flight.turns, strict=True))
    lonlat = np.array(flights.MIDDLE) + np.random.default_rng(1).uniform(-30, 30, (60, 2)) / (86_000.0, 111_000.0)
    ground = np.column_stack([lonlat, flights.height(flight.waves, *lonlat.T)])
    seen = np.array([flights.seen(flight.kind, *pose, flights.to_ecef(ground)) for pose in poses])
    visible = np.isfinite(seen).all(axis=2)
    shown = np.flatnonzero(visible.sum(axis=0) >= 3)[:5]
    image, point = np.nonzero(visible[:, shown])
    points = BlockPoints(
        ids=(*ties.ids, *(f"g{k}" for k in shown)),
        ground=np.vstack([ties.ground, ground[shown] + (0.0, 0.0, off)]),
        roles=np.append(ties.roles, ["control"] * 5),
        sigma_ground=np.vstack([ties.sigma_ground, np.full((5, 3), 0.05)]),
        crs=ties.crs.to_3d(),
        images=ties.images,
        point=np.append(ties.point, point + len(ties)),
        image=np.append(ties.image, image),
        measured=np.vstack([ties.measured, seen[image, shown[point]]]),
        sigma_image=np.append(ties.sigma_image, np.full(len(image), 0.3)),
    )
    models = {name: scene.model for name, scene in flight.scenes.items()}
    priors = {name: scene.priors for name, scene in flight.scenes.items()}
    fit = adjust(models, points, priors=priors)
    found = [str(one) for one in fit.warnings if one.code == "datum-doubtful"]
    assert len(found) == (off > 0)
    assert all("focal length" in text for text in found)


def test_angles_that_are_worse_than_stated_are_told(flights: Any, tmp_path: Path):
    """They are wrong by 3 degrees, so positions move, too."""
    kind = flights.Kind(options={"vertical": "ellipsoid", "sigmas": "3,0.1"})
    flight = flights.fly(kind, 4, 2, tmp_path)
    models = {name: scene.model for name, scene in flight.scenes.items()}
    priors = {name: scene.priors for name, scene in flight.scenes.items()}
    found = [one for one in adjust(models, flight.points, priors=priors).warnings if one.code == "poses-contradicted"]
    assert "angles" in [one.fields["what"] for one in found]
