"""Files whose place is read back with PROJ: systems that GeoTIFF keys hold, and those that they do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.errors import CrsError
from ortho_pipeline.raster import stored_crs
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.source import Grid


def grid_at(crs: str, lon: float, lat: float, size: float = 10.0) -> Grid:
    system = pyproj.CRS(crs)
    x, y = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True).transform(lon, lat)
    return Grid(system, x, y, size, size, 40, 30)


def write(path: Path, grid: Grid, driver: str) -> None:
    with RasterWriter(path, grid, Profile(1, np.dtype("u1"), "nodata", 0.0), driver=driver) as writer:
        writer.write(0, 0, np.full((1, 30, 40), 7, dtype="u1"), None)


@pytest.mark.parametrize("driver", ["GTiff", "COG"])
@pytest.mark.parametrize(
    ("crs", "lon", "lat"),
    [
        ("EPSG:32636", 33.1, 37.1), ("EPSG:4326", 33.1, 37.1), ("EPSG:3035", 10.0, 50.0),
        ("EPSG:32636+5773", 33.1, 37.1),
        ("+proj=aeqd +lat_0=37 +lon_0=33", 33.1, 37.1), ("ESRI:102429", 0.0, 50.0), ("EPSG:27704", 10.0, 50.0),
        ("EPSG:2180", 19.0, 52.0), ("EPSG:5514", 15.0, 50.0), ("EPSG:2056", 8.0, 47.0), ("EPSG:3413", -45.0, 80.0),
    ],
)  # fmt: skip
def test_a_file_has_the_place_of_its_grid(tmp_path: Path, crs: str, lon: float, lat: float, driver: str) -> None:
    """Azimuthal equidistant grids were thousands of kilometres off in the file, without a word."""
    size = 1e-4 if crs == "EPSG:4326" else 10.0
    write(tmp_path / "a.tif", grid_at(crs, lon, lat, size), driver)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]
    np.testing.assert_allclose(corner(tmp_path / "a.tif"), (lon, lat), atol=1e-6)


def corner(path: Path) -> tuple[float, float]:
    """Return longitude and latitude of the first corner of a file, by PROJ."""
    dataset = gdal.Open(str(path))
    left, _, _, top, _, _ = dataset.GetGeoTransform()
    found = pyproj.CRS.from_wkt(dataset.GetProjection())
    lon, lat, *_ = pyproj.Transformer.from_crs(found, "EPSG:4326", always_xy=True).transform(left, top)
    return lon, lat


def test_systems_are_the_same_if_their_places_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Newer codes of EPSG come back from a file as other texts."""
    grid = grid_at("EPSG:32636", 33.1, 37.1)
    stored_wkt, given_back = stored_crs.stored_wkt.__wrapped__, stored_crs._given_back
    wanted = stored_wkt(grid)
    monkeypatch.setattr(stored_crs, "same_crs", lambda one, other: False)
    assert stored_wkt(grid) == wanted
    monkeypatch.setattr(stored_crs, "_given_back", lambda text: given_back(pyproj.CRS("EPSG:32635").to_wkt()))
    with pytest.raises(CrsError, match="cannot store"):
        stored_wkt(grid)


@pytest.mark.parametrize(("crs", "lon", "lat"), [("EPSG:8857", 10.0, 50.0), ("EPSG:9311", -100.0, 40.0)])
def test_a_crs_that_no_file_gives_back_is_refused(tmp_path: Path, crs: str, lon: float, lat: float) -> None:
    """GDAL 3.6 stores none of them; later ones may."""
    refused: CrsError | None = None
    try:
        write(tmp_path / "a.tif", grid_at(crs, lon, lat), "GTiff")
    except CrsError as error:
        refused = error
    if refused is None:
        assert int(gdal.VersionInfo()) >= 3070000
        np.testing.assert_allclose(corner(tmp_path / "a.tif"), (lon, lat), atol=1e-6)
    else:
        assert crs in str(refused)
        assert refused.field == "output.crs"
        assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1)])
@pytest.mark.parametrize(("off", "stored"), [(0.08, True), (0.15, False), (1000.0, False)])
def test_places_in_a_file_are_those_of_the_grid_to_a_hundredth_of_the_shorter_side_of_a_pixel(
    monkeypatch: pytest.MonkeyPatch, way: tuple[int, int], off: float, stored: bool
) -> None:
    """The file gives back a false easting or northing that is off, to either side. Pixels are 20 x 10 m."""

    def system(east: float, north: float) -> pyproj.CRS:
        return pyproj.CRS(f"+proj=tmerc +lon_0=33 +x_0={5e5 + east:.3f} +y_0={north:.3f} +datum=WGS84 +type=crs")

    monkeypatch.setattr(stored_crs, "same_crs", lambda one, other: False)
    monkeypatch.setattr(stored_crs, "_given_back", lambda text: system(way[0] * off, way[1] * off))
    grid = Grid(system(0.0, 0.0), 520_000.0, 4_100_000.0, 20.0, 10.0, 40, 30)
    if stored:
        assert "Transverse" in stored_crs.stored_wkt.__wrapped__(grid)
    else:
        with pytest.raises(CrsError, match="cannot store"):
            stored_crs.stored_wkt.__wrapped__(grid)
