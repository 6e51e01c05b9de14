"""Control points for GDAL, and the boxes over which an RPC is fitted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError, ModelError
from ortho_pipeline.exchange.gcp import gcps_of_model, gcps_of_points, write_gcps, write_geolocation
from ortho_pipeline.exchange.moved_grid import write_moved
from ortho_pipeline.exchange.rpc import write_bare_vrt
from ortho_pipeline.exchange.rpc_fit import box_grid, domain_box
from ortho_pipeline.points import Points


def test_measured_points_are_longitude_latitude_and_height() -> None:
    ground = np.array([[500_000.0, 4e6, 120.0], [510_000.0, 4.01e6, math.nan]])
    found = gcps_of_points(Points.of([[1.5, 2.5], [3, 4]], ground, "EPSG:32633"))
    lon, lat = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(*ground[:, :2].T)
    np.testing.assert_allclose(found, np.column_stack([[1.5, 3], [2.5, 4], lon, lat, [120, 0]]), rtol=1e-12)


def test_longitudes_do_not_jump_at_the_antimeridian() -> None:
    """A polynomial through 179.99 and -179.99 degrees would go around the Earth."""
    image = np.random.default_rng(3).uniform(0, 400, (20, 2))
    # Metres in UTM zone 60, on both sides of its border at 180 degrees.
    ground = np.column_stack([image * (10.0, -10.0) + (817_500.0, 8_120_000.0), np.full(20, 50.0)])
    gcps = gcps_of_points(Points.of(image, ground, "EPSG:32760"))
    assert 179.9 < gcps[:, 2].min() < 180.0 < gcps[:, 2].max() < 180.1


@pytest.mark.parametrize("side", [2, 11])
def test_a_grid_of_points_has_the_corners_of_the_image(tiny: Any, side: int) -> None:
    found = gcps_of_model(tiny.model, (tiny.width, tiny.height), side=side)
    assert len(found) == side**2
    assert found[:, :2].min(axis=0).tolist() == [0, 0]
    assert found[:, :2].max(axis=0).tolist() == [tiny.width, tiny.height]
    np.testing.assert_allclose(found[:, 4], tiny.model.reference_height, atol=1e-6)
    np.testing.assert_allclose(tiny.model.ground_to_image(found[:, 2:]), found[:, :2], atol=1e-3)


def test_four_points_are_the_least(tiny: Any) -> None:
    """Only the corners of one side of the image, and then one side more, are on the ground."""

    class Partly(type(tiny.model)):  # type: ignore[misc]
        def image_to_ground(self, image: np.ndarray, height: Any) -> np.ndarray:
            ground = super().image_to_ground(image, height)
            ground[np.arange(len(ground)) >= kept] = np.nan
            return ground

    model = object.__new__(Partly)
    model.__dict__.update(vars(tiny.model))
    kept = 4
    assert len(gcps_of_model(model, (tiny.width, tiny.height), side=3)) == 4
    kept = 3
    with pytest.raises(InputError, match="do not meet the ground"):
        gcps_of_model(model, (tiny.width, tiny.height), side=3)


@pytest.mark.parametrize("name", ["a.vrt", "a.tif"])
def test_gdal_reads_the_points_and_nothing_that_it_would_prefer(tiny: Any, tmp_path: Path, name: str) -> None:
    gcps = gcps_of_model(tiny.model, (tiny.width, tiny.height), side=3)
    source = gdal.GetDriverByName("GTiff").CreateCopy(str(tmp_path / "source.tif"), gdal.Open(str(tiny.image)))
    source.SetGeoTransform((5.0, 2.0, 0.0, 7.0, 0.0, -2.0))
    source.FlushCache()
    write_gcps(source, gcps, tmp_path / name)
    made = gdal.Open(str(tmp_path / name))
    found = [[p.GCPPixel, p.GCPLine, p.GCPX, p.GCPY, p.GCPZ] for p in made.GetGCPs()]
    np.testing.assert_allclose(found, gcps, rtol=0, atol=1e-4)
    assert pyproj.CRS(made.GetGCPProjection()).to_epsg() == 4326
    assert made.GetGeoTransform(can_return_null=True) is None
    assert not made.GetMetadata("RPC")
    np.testing.assert_array_equal(made.ReadAsArray(), gdal.Open(str(tiny.image)).ReadAsArray())


def test_a_vrt_finds_its_image_when_the_folder_of_both_moves(tiny: Any, tmp_path: Path) -> None:
    (tmp_path / "one" / "out").mkdir(parents=True)
    path, size = tmp_path / "one" / "source.tif", (tiny.width, tiny.height)
    gdal.GetDriverByName("GTiff").CreateCopy(str(path), gdal.Open(str(tiny.image)))
    source = gdal.Open(str(path))
    write_gcps(source, gcps_of_model(tiny.model, size, side=3), tmp_path / "one" / "out" / "gcps.vrt")
    write_geolocation(source, tiny.model, size, None, tmp_path / "one" / "out" / "arrays.vrt")
    write_bare_vrt(source, tmp_path / "one" / "out" / "bare.vrt")
    write_moved(source, (5e5, 2.0, 0.0, 4e6, 0.0, -2.0), tmp_path / "one" / "out" / "moved.vrt")
    (tmp_path / "one").rename(tmp_path / "two")
    for name in ("gcps", "arrays", "bare", "moved"):
        found = gdal.Open(str(tmp_path / "two" / "out" / f"{name}.vrt")).ReadAsArray()
        np.testing.assert_array_equal(found, gdal.Open(str(tiny.image)).ReadAsArray())


@pytest.mark.parametrize(
    ("name", "off", "same"),
    [
        ("GCPPixel", 5e-5, True), ("GCPLine", -5e-5, True), ("GCPPixel", 1.5e-4, False), ("GCPLine", -1.5e-4, False),
        ("GCPX", -1.5e-4, False), ("GCPZ", 1.5e-4, False),
    ],
)  # fmt: skip
def test_points_that_are_stored_elsewhere_are_not_left(
    tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, off: float, same: bool
) -> None:
    """One of nine, by more than a ten-thousandth of its unit: as if GDAL stored another number."""
    gcps, original = gcps_of_model(tiny.model, (tiny.width, tiny.height), side=3), gdal.GCP

    def changed(*numbers: Any) -> gdal.GCP:
        made = original(*numbers)
        if numbers and numbers[-1] == "4":
            setattr(made, name, getattr(made, name) + off)
        return made

    monkeypatch.setattr(gdal, "GCP", changed)
    if same:
        write_gcps(gdal.Open(str(tiny.image)), gcps, tmp_path / "a.tif")
    else:
        with pytest.raises(ModelError, match="control points differ"):
            write_gcps(gdal.Open(str(tiny.image)), gcps, tmp_path / "a.tif")
    assert (tmp_path / "a.tif").exists() is same


def test_the_grid_of_a_box_has_its_corners_and_steps() -> None:
    grid = box_grid((10.0, 40.0, 12.0, 44.0), (100.0, 700.0), (3, 5, 2))
    wanted = [[x, y, h] for x in (10, 11, 12) for y in (40, 41, 42, 43, 44) for h in (100, 700)]
    np.testing.assert_allclose(grid, wanted)
    # One height gets a metre to either side.
    assert sorted({*box_grid((10.0, 40.0, 12.0, 44.0), (100.0, 100.0), (2, 2, 2))[:, 2]}) == [99.0, 101.0]
    for box, heights in (
        ((10, 40, 10, 44), (0, 1)), ((10, 40, 12, 40), (0, 1)), ((10, 40, 12, 44), (1, 0)),
        ((10, 40, math.nan, 44), (0, 1)), ((10, 40, 12, 44), (0, math.inf)),
    ):  # fmt: skip
        with pytest.raises(InputError, match="is empty"):
            box_grid(box, heights, (2, 2, 2))


def test_the_box_of_an_rpc_is_its_range_on_either_side_of_the_antimeridian(tiny: Any) -> None:
    for lon in (20.0, 179.999, -179.999):
        rpc = tiny.model._replace(lon_off=lon)
        box, heights = domain_box(rpc)
        centre, half = rpc.domain
        np.testing.assert_allclose(box, [*(centre - half)[:2], *(centre + half)[:2]], atol=1e-9)
        assert heights == rpc.height_range
