"""A geoid grid that reaches a part of a DEM alone: there the DEM has heights."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from ortho_pipeline.errors import DatumError
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem


def geoid_around(path: Path, lon: float, lat: float) -> str:
    """Write undulations of 30 m, from 0.04 degrees west and south of a place to 0.04 degrees east and north of it."""
    path.write_bytes(struct.pack(">4d2i4f", lat - 0.04, lon - 0.04, 0.08, 0.08, 2, 2, *[30.0] * 4))
    return str(path)


@pytest.mark.parametrize(
    ("lon", "lat"),
    [(10.0, 50.0), (18.0, 50.0), (10.0, 44.0), (18.0, 44.0), (14.0, 47.0), (14.0, 50.0), (10.0, 47.0), (13.4, 46.3)],
)
def test_a_geoid_that_reaches_a_small_part_of_a_dem_gives_heights_there(tmp_path: Path, lon: float, lat: float) -> None:
    """Samples every 0.1 degrees, from 10 to 18 degrees east and from 50 to 44 degrees north."""
    write_dem(tmp_path / "dem.tif", np.full((61, 81), 500.0), (9.95, 50.05), 0.1, "EPSG:4326")
    dem = open_dem(tmp_path / "dem.tif", geoid_around(tmp_path / f"geoid_{lon:g}_{lat:g}.gtx", lon, lat))
    assert dem.heights([[lon, lat]])[0] == pytest.approx(530.0, abs=1e-3)


@pytest.mark.parametrize(("lon", "lat"), [(9.9, 50.0), (18.1, 50.0), (10.0, 43.9), (10.0, 50.1)])
def test_a_geoid_that_ends_before_the_first_or_the_last_sample_is_refused(
    tmp_path: Path, lon: float, lat: float
) -> None:
    write_dem(tmp_path / "dem.tif", np.full((61, 81), 500.0), (9.95, 50.05), 0.1, "EPSG:4326")
    with pytest.raises(DatumError, match="does not cover this DEM"):
        open_dem(tmp_path / "dem.tif", geoid_around(tmp_path / f"beside_{lon:g}_{lat:g}.gtx", lon, lat))
