"""A DEM that is moved and raised: by metres on the ground, in metres and in degrees, and its record says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.surface.dem import moved, open_dem
from ortho_pipeline.surface.writing import write_dem


@pytest.mark.parametrize(
    ("crs", "corner", "cell"), [("EPSG:32636", (500_000.0, 4_100_000.0), 10.0), ("EPSG:4326", (33.0, 37.0), 1e-4)]
)
def test_a_dem_is_moved_by_metres(tmp_path: Path, crs: str, corner: tuple[float, float], cell: float) -> None:
    random = np.random.default_rng(0)
    write_dem(tmp_path / "dem.tif", random.normal(100.0, 10.0, (80, 80)), corner, cell, crs)
    surface = open_dem(tmp_path / "dem.tif", "ellipsoid", override=True)
    places = np.array(corner) + cell * np.array([(30.2, -40.7), (40.0, -40.0), (50.5, -30.1)])
    ground = ground_transform(crs, "EPSG:4979")(np.column_stack([places, np.zeros(3)]))
    later = moved(surface, (7.0, -4.0, 2.5), ground[1, :2])
    # East and north of a metre on the ground at the place in the middle.
    from ortho_pipeline.geodesy.ellipsoid import metres_per_degree

    there = ground[:, :2] + np.array([7.0, -4.0]) / metres_per_degree(ground)
    # The grid of a map is turned against north by a little, and scaled.
    np.testing.assert_allclose(
        later.heights(there, "EPSG:4979"), surface.heights(ground[:, :2], "EPSG:4979") + 2.5, atol=0.05
    )
    again = moved(later, (-7.0, 4.0, 0.0), ground[1, :2])
    assert again.provenance["moved_m"] == [0.0, 0.0]
    assert again.provenance["raised_m"] == 2.5
