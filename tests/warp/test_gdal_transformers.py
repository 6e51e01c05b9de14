"""What GDAL's transformers are given of a model, and how their error is measured, by hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.warp import gdal_engine
from ortho_pipeline.warp.gdal_engine import Exact, Transformer, _control, _write_arrays, _write_dem

UTM = pyproj.CRS.from_epsg(32651)
#: Map of 7 x 5 pixels of 2 x 3 m.
GRID = Grid(UTM, 500_000.0, 1_000_000.0, 2.0, 3.0, 7, 5)


@dataclass(frozen=True)
class Linear:
    """Columns and rows that are linear in the place, and not known east of a place."""

    last: float = np.inf
    crs: str = "EPSG:32651"

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([500_010.0, 999_990.0, 120.0]), np.array([8.0, 6.0, 30.0])

    def ground_to_image(self, ground: np.ndarray) -> np.ndarray:
        x, y, h = np.asarray(ground).T
        image = np.stack([400 * (x - 500_000) + h, 150 * (1_000_000 - y) - 2 * h], axis=1)
        image[x > self.last, 1] = np.nan
        return image


def exact(size: tuple[int, int] = (4000, 1500), last: float = np.inf) -> Exact:
    return Exact(Linear(last), FlatSurface(100.0), GRID, size)  # type: ignore[arg-type]


def wanted(columns: Any, rows: Any) -> np.ndarray:
    """Return the image points of positions of the map at 100 m."""
    return np.stack([800 * np.asarray(columns) + 100.0, 450 * np.asarray(rows) - 200.0], axis=-1)


def test_points_of_a_plane_are_spread_over_the_box_of_the_model() -> None:
    steps = [-1 + 0.2 * k for k in range(11)]
    found = np.array([(p.GCPX, p.GCPY, p.GCPZ, p.GCPPixel, p.GCPLine) for p in _control(Linear())])  # type: ignore[arg-type]
    places = np.array([(500_010 + 8 * x, 999_990 + 6 * y, 120.0) for y in steps for x in steps])
    np.testing.assert_allclose(found, np.column_stack([places, Linear().ground_to_image(places)]))
    # Points that are not wholly in the image are none.
    fewer = _control(Linear(500_010.1))  # type: ignore[arg-type]
    assert len(fewer) == 6 * 11
    assert max(point.GCPX for point in fewer) == pytest.approx(500_010)


@pytest.mark.parametrize("piece", [1_000_000, 14, 3])
def test_arrays_hold_the_image_point_of_the_middle_of_each_pixel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int
) -> None:
    """Points more than 1000 px outside are moved there; a pixel without an image point has none in either array."""
    monkeypatch.setattr(gdal_engine, "_PIECE", piece)
    _write_arrays(exact((2500, 300), last=500_012.0), tmp_path / "a.tif")
    dataset = gdal.Open(str(tmp_path / "a.tif"))
    found = dataset.ReadAsArray()
    columns, rows = np.meshgrid(np.arange(7) + 0.5, np.arange(5) + 0.5)
    expected = np.moveaxis(wanted(columns, rows), 2, 0)
    expected[0], expected[1] = np.clip(expected[0], -1000, 3500), np.clip(expected[1], -1000, 1300)
    expected[:, :, 6] = -1e9
    np.testing.assert_allclose(found, expected)
    assert [dataset.GetRasterBand(k).GetNoDataValue() for k in (1, 2)] == [-1e9, -1e9]
    assert (expected == 3500).any()
    assert (expected == 1300).any()


def test_points_far_above_and_left_of_the_image_are_moved_to_its_range(tmp_path: Path) -> None:
    grid = Grid(UTM, 499_990.0, 1_000_030.0, 2.0, 3.0, 2, 2)
    _write_arrays(Exact(Linear(), FlatSurface(100.0), grid, (50, 50)), tmp_path / "a.tif")  # type: ignore[arg-type]
    assert (gdal.Open(str(tmp_path / "a.tif")).ReadAsArray() == -1000).all()


def test_heights_are_written_with_their_voids(tmp_path: Path) -> None:
    ground = SimpleNamespace(
        heights=np.array([[1.25, np.nan, -7.5], [4.0, 5.0, 6.0]]), crs=UTM, geotransform=(5.0, 2.0, 0.0, 9.0, 0.0, -3.0)
    )
    path = str(tmp_path / "dem.tif")
    _write_dem(path, ground)  # type: ignore[arg-type]
    dataset = gdal.Open(path)
    np.testing.assert_array_equal(dataset.ReadAsArray(), [[1.25, -1e6, -7.5], [4.0, 5.0, 6.0]])
    assert dataset.GetRasterBand(1).GetNoDataValue() == -1e6
    assert dataset.GetGeoTransform() == (5.0, 2.0, 0.0, 9.0, 0.0, -3.0)
    assert pyproj.CRS.from_wkt(dataset.GetProjection()) == UTM


def measured(
    monkeypatch: pytest.MonkeyPatch,
    off: dict[tuple[int, int], tuple[float, float]],
    *,
    failed: tuple[tuple[int, int], ...] = (),
    method: str = "GEOLOC_ARRAY",
    size: tuple[int, int] = (6000, 2500),
    last: float = np.inf,
) -> float:
    """Return the error of a transformer that is off by so much at pixels (column, row) and fails at others."""
    asked: list[np.ndarray] = []

    def transform(inverse: int, points: list[list[float]]) -> tuple[list[Any], list[int]]:
        assert inverse == 1
        places = np.array(points)
        asked.append(places)
        image, success = wanted(places[:, 0], places[:, 1]), np.ones(len(places), dtype=int)
        for k, (column, row) in enumerate(np.floor(places[:, :2]).astype(int).tolist()):
            image[k] += off.get((column, row), (0.0, 0.0))
            success[k] = (column, row) not in failed
        return np.column_stack([image, 0 * image[:, 0]]).tolist(), success.tolist()

    monkeypatch.setattr(gdal_engine.gdal, "Transformer", lambda *_: SimpleNamespace(TransformPoints=transform))
    image = gdal.GetDriverByName("MEM").Create("", 10, 10, 1)
    error = exact(size, last).error(Transformer(method, ()), image)
    columns, rows = np.meshgrid(np.arange(7) + 0.5, np.arange(5) + 0.5)
    np.testing.assert_array_equal(asked[0], np.column_stack([columns.ravel(), rows.ravel(), np.zeros(35)]))
    return error


@pytest.mark.parametrize("method", ["GEOLOC_ARRAY", "RPC"])
def test_the_error_is_the_largest_on_either_axis_where_the_image_is_seen(
    monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    assert measured(monkeypatch, {}, method=method) == 0.0
    assert measured(monkeypatch, {(2, 3): (0.25, -0.5), (6, 4): (0.375, 0.0)}, method=method) == pytest.approx(0.5)
    # The first row is above the image by either; in the second, one of both sees the image.
    assert measured(monkeypatch, {(2, 0): (9.0, 5.0)}, method=method, size=(6000, 2500)) == pytest.approx(9.0)
    narrow = (1200, 2500)
    assert measured(monkeypatch, {(2, 2): (50.0, 0.0)}, method=method, size=narrow) == 0.0
    assert measured(monkeypatch, {(2, 2): (-950.0, 0.0)}, method=method, size=narrow) == pytest.approx(950.0)
    assert measured(monkeypatch, {(0, 2): (-600.0, 0.0)}, method=method, size=narrow) == pytest.approx(600.0)


def test_where_only_one_of_both_has_a_point_the_error_is_infinite_but_for_voids_under_an_rpc(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    off = {(1, 1): (0.125, 0.0)}
    assert measured(monkeypatch, off, failed=((3, 3),)) == np.inf
    assert measured(monkeypatch, off, failed=((3, 3),), method="RPC") == pytest.approx(0.125)
    assert measured(monkeypatch, off, last=500_009.0) == np.inf
    assert measured(monkeypatch, off, last=500_009.0, method="RPC") == pytest.approx(0.125)
    # Neither sees what is outside of the image.
    assert measured(monkeypatch, off, failed=((6, 3),), size=(5000, 2500)) == pytest.approx(0.125)


@pytest.mark.parametrize(("method", "limit"), [("GCP_POLYNOMIAL", 1e-3), ("GCP_HOMOGRAPHY", 1e-3), ("RPC", 0.1)])
def test_what_fits_points_has_to_express_the_model(method: str, limit: float) -> None:
    assert Transformer(method, ()).limit == limit
