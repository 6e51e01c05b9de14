"""DEMs that are written: each sample has the height of its own middle, by GDAL and PROJ."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.errors import CoverageError
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.surface.writing import write_dem, write_ellipsoidal, write_terrain


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, gdal.Dataset]:
    """Return heights, and x and y of the middles of their samples, as GDAL has them."""
    dataset = gdal.Open(str(path))
    heights = dataset.ReadAsArray().astype(float)
    rows, columns = np.indices(heights.shape) + 0.5
    left, dx, _, top, _, dy = dataset.GetGeoTransform()
    return heights, left + columns * dx, top + rows * dy, dataset


def test_a_dem_has_its_heights_from_the_northwest(tmp_path: Path) -> None:
    heights = np.arange(12.0).reshape(3, 4)
    heights[1, 2] = -32768.0
    write_dem(tmp_path / "dem.tif", heights, (300_000.0, 2_700_000.0), 5.0, "EPSG:32636+5773")
    found, x, y, dataset = read(tmp_path / "dem.tif")
    np.testing.assert_array_equal(found, heights)
    assert (x[0, 0], y[0, 0], x[-1, -1], y[-1, -1]) == (300_002.5, 2_699_997.5, 300_017.5, 2_699_987.5)
    assert dataset.GetRasterBand(1).GetMaskBand().ReadAsArray()[1].tolist() == [255, 255, 0, 255]
    crs = pyproj.CRS(dataset.GetProjection())
    assert [part.to_epsg() for part in crs.sub_crs_list] == [32636, 5773]


def test_a_terrain_is_exact_at_its_posts(tmp_path: Path) -> None:
    """Heights of a plane in degrees over the ellipsoid, less the geoid, to a decimetre."""
    box = [[500_013.0, 4_099_971.0], [500_251.0, 4_100_160.0]]
    grid = Vertical("EPSG:5773")
    write_terrain(tmp_path / "dem.tif", lambda lon, lat: 1e4 * (lon - 33) + 2e4 * (lat - 37), box, 30.0, "EPSG:32636",
                  grid.name)  # fmt: skip
    found, x, y, _ = read(tmp_path / "dem.tif")
    # The samples lie between multiples of 30 m, and cover the box.
    assert (x[0, 0] - 15, y[-1, 0] - 15) == (500_010, 4_099_950)
    assert (x[0, -1] + 15, y[0, 0] + 15) == (500_280, 4_100_160)
    lon, lat = pyproj.Transformer.from_crs(32636, 4326, always_xy=True).transform(x, y)
    wanted = 1e4 * (lon - 33) + 2e4 * (lat - 37) - grid.undulation(lon.ravel(), lat.ravel()).reshape(lon.shape)
    assert np.abs(found - wanted).max() < 0.051
    np.testing.assert_allclose(found, np.round(found, 1), atol=1e-4)


def plane(hole: float = 2.0) -> SimpleNamespace:
    """Return a surface of 100 m per degree to the east and 1000 to the north, without heights east of `hole`."""

    def heights(places: np.ndarray, crs: str) -> np.ndarray:
        assert crs == "EPSG:4326"
        return np.where(places[:, 0] > hole, np.nan, 100 * places[:, 0] + 1000 * places[:, 1])

    return SimpleNamespace(heights=heights)


@pytest.mark.parametrize(("size", "step"), [(0.01, 1 / 3600), (20.0, 20 / 4000)])
def test_ellipsoidal_heights_are_those_of_the_surface(size: float, step: float, tmp_path: Path) -> None:
    """Samples of an arc second, or of the 4000th part of the longer side."""
    box = [[1.0, 45.0], [1.0 + size / 20, 45.0 + size]]
    write_ellipsoidal(tmp_path / "dem.tif", plane(), box)  # type: ignore[arg-type]
    found, x, y, dataset = read(tmp_path / "dem.tif")
    assert dataset.GetGeoTransform() == pytest.approx((1.0, step, 0.0, 45.0 + size, 0.0, -step))
    assert found.shape == (np.ceil(size / step - 1e-9), np.ceil(size / 20 / step - 1e-9))
    # Float32 has seven digits.
    np.testing.assert_allclose(found, 100 * x + 1000 * y, rtol=1e-7)
    assert pyproj.CRS(dataset.GetProjection()).to_epsg() == 4326


def test_a_void_gets_the_median_of_the_heights(tmp_path: Path) -> None:
    box = [[1.0, 45.0], [1.004, 45.002]]
    write_ellipsoidal(tmp_path / "dem.tif", plane(hole=1.002), box)  # type: ignore[arg-type]
    found, x, y, _ = read(tmp_path / "dem.tif")
    known = x <= 1.002
    heights = 100 * x + 1000 * y
    np.testing.assert_allclose(found[known], heights[known], rtol=1e-7)
    np.testing.assert_allclose(found[~known], np.median(heights[known]), rtol=1e-7)
    with pytest.raises(CoverageError):
        write_ellipsoidal(tmp_path / "no.tif", plane(hole=0.0), box)  # type: ignore[arg-type]
    assert not (tmp_path / "no.tif").exists()
