"""A DEM that is moved and raised: by metres on the ground, in metres and in degrees, and its record says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
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


@pytest.mark.parametrize(
    ("crs", "corner", "cell"), [("EPSG:32636", (700_000.0, 6_100_000.0), 10.0), ("EPSG:4326", (36.0, 55.0), 1e-4)]
)
def test_moves_add_up_along_the_ellipsoid(tmp_path: Path, crs: str, corner: tuple[float, float], cell: float) -> None:
    """Far from the central meridian, where the grid is turned by almost three degrees against north."""
    write_dem(tmp_path / "dem.tif", np.full((60, 60), 100.0), corner, cell, crs)
    surface = open_dem(tmp_path / "dem.tif", "ellipsoid", override=True)
    to_map = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
    place = np.array(to_map.transform(corner[0] + 30 * cell, corner[1] - 30 * cell, direction="INVERSE"))
    later = moved(moved(surface, (30.0, -45.0, 2.5), place), (10.0, 5.0, -4.0), place)
    azimuth, distance = 135.0, np.hypot(40.0, 40.0)
    lon, lat, _ = pyproj.Geod(ellps="WGS84").fwd(place[0], place[1], azimuth, distance)
    shift = np.subtract(to_map.transform(lon, lat), to_map.transform(*place))
    found = np.subtract(later.grid.crs_from_pixel, surface.grid.crs_from_pixel)
    metre = 1.0 if crs == "EPSG:32636" else 1e-5
    np.testing.assert_allclose(found[[0, 3]], shift, atol=2e-3 * metre)
    assert not found[[1, 2, 4, 5]].any()
    assert later.provenance["moved_m"] == [40.0, -40.0]
    assert later.provenance["raised_m"] == -1.5
    assert later.window(3, 3, 1, 1)[0, 0] == 98.5
