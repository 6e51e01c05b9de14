"""The outline of valid pixels, of masks and of parts of the Earth that are drawn by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
import shapely
from osgeo import gdal

from ortho_pipeline.raster.valid_area import to_geojson, valid_outline

DEGREES = pyproj.CRS("EPSG:4326")


def raster(path: Path, valid: np.ndarray) -> Path:
    """Write pixels of 10 x 20 m with the first corner at 500 km, 4000 km in UTM; zero is not valid."""
    rows, columns = valid.shape
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, 1, gdal.GDT_Byte)
    dataset.SetProjection(pyproj.CRS("EPSG:32635").to_wkt())
    dataset.SetGeoTransform((500_000, 10, 0, 4_000_000, 0, -20))
    dataset.GetRasterBand(1).SetNoDataValue(0)
    dataset.WriteArray(valid.astype(np.uint8))
    return path


def test_the_outline_is_that_of_the_pixels(tmp_path: Path) -> None:
    valid = np.zeros((30, 40), dtype=bool)
    # One pixel wider than high would be simplified away: a block at the corner, and one at the other edge.
    valid[:10, :5] = valid[20:, 30:] = True
    outline = valid_outline(raster(tmp_path / "a.tif", valid))
    assert sorted(part.bounds for part in shapely.get_parts(outline)) == [
        (500_000, 3_999_800, 500_050, 4_000_000), (500_300, 3_999_400, 500_400, 3_999_600)
    ]  # fmt: skip
    assert outline.area == pytest.approx((50 + 100) * 200)
    one = valid_outline(raster(tmp_path / "b.tif", np.ones((1, 1), dtype=bool)))
    assert one.bounds == (500_000, 3_999_980, 500_010, 4_000_000)
    assert valid_outline(raster(tmp_path / "c.tif", ~np.ones((3, 4), dtype=bool))).is_empty


def test_the_outline_is_that_of_all_bands_except_alpha(tmp_path: Path) -> None:
    """Of nodata, which marks each band by itself, and of alpha, which has a value everywhere."""
    for name, kind, alpha in (("a.tif", gdal.GDT_Byte, False), ("b.tif", gdal.GDT_Float32, False), ("c.tif", 1, True)):
        made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / name), 40, 30, 2, kind, ["ALPHA=YES"] * alpha)
        made.SetProjection(pyproj.CRS("EPSG:32635").to_wkt())
        made.SetGeoTransform((500_000, 10, 0, 4_000_000, 0, -20))
        pixels = np.zeros((2, 30, 40))
        pixels[1, :, :20] = 1
        if kind == gdal.GDT_Float32:
            pixels[pixels == 0] = np.nan
        elif not alpha:
            made.GetRasterBand(1).SetNoDataValue(0)
        made.WriteArray(pixels.astype(np.float32 if kind == gdal.GDT_Float32 else np.uint8))
        del made
        assert valid_outline(tmp_path / name).bounds == (500_000, 3_999_400, 500_200, 4_000_000), name


def test_a_large_raster_is_looked_at_in_few_pixels(tmp_path: Path) -> None:
    """In 10 x 8 of them: each stands for 4 x 4 pixels."""
    valid = np.zeros((32, 40), dtype=bool)
    valid[8:24, 12:32] = True
    outline = valid_outline(raster(tmp_path / "a.tif", valid), side=10)
    assert np.abs(np.array(outline.bounds) - (500_120, 3_999_520, 500_320, 3_999_840)).max() <= 80
    whole = valid_outline(raster(tmp_path / "b.tif", np.ones((32, 40), dtype=bool)), side=10)
    assert whole.bounds == (500_000, 3_999_360, 500_400, 4_000_000)
    # Only the longer side is reduced.
    wide = np.zeros((5, 40), dtype=bool)
    wide[2:, 20:] = True
    assert valid_outline(raster(tmp_path / "c.tif", wide), side=10).bounds[1:3] == (3_999_900, 500_400)


@pytest.mark.parametrize(
    ("boxes", "expected"),
    [
        ([(10, 20, 11, 21)], (10, 20, 11, 21)),
        ([(10, 20, 11, 21), (100, -5, 101, -4)], (10, -5, 101, 21)),
        # The shorter way round the Earth holds both parts.
        ([(-170, 0, -169, 1), (170, 2, 171, 3)], (170, 0, -169, 3)),
        ([(178, 0, 179, 1), (181, 2, 182, 3)], (178, 0, -178, 3)),
        ([(-179, 0, -178, 1), (178, 0, 179, 1), (-150, 0, -149, 1)], (178, 0, -149, 1)),
        ([(-100, 0, -99, 1), (0, 0, 1, 1), (100, 0, 101, 1)], (-100, 0, 101, 1)),
        ([(-180, -90, 180, 90)], (-180, -90, 180, 90)),
        # Wide parts: the widest gap is not that between their middles.
        ([(-80, 0, 80, 1), (119, 0, 121, 1), (-131, 0, -129, 1)], (-131, 0, 121, 1)),
        ([(-60, 0, 80, 1), (100, 0, 102, 1), (-140, 0, -120, 1)], (-140, 0, 102, 1)),
    ],
)
def test_the_box_holds_all_parts(boxes: list[tuple[float, ...]], expected: tuple[float, ...]) -> None:
    geometry, box = to_geojson(shapely.union_all([shapely.box(*one) for one in boxes]), DEGREES)
    assert box == pytest.approx(expected, abs=1e-6)
    shape = shapely.geometry.shape(geometry)
    inside = [((one[0] + one[2]) / 2, (one[1] + one[3]) / 2) for one in boxes]
    assert all(shape.contains(shapely.Point((lon + 180) % 360 - 180, lat)) for lon, lat in inside)
    assert shape.area == pytest.approx(sum((one[2] - one[0]) * (one[3] - one[1]) for one in boxes), rel=1e-6)
    for part in shapely.get_parts(shape):
        assert shapely.is_ccw(part.exterior)


def test_islands_on_both_sides_of_the_antimeridian_have_a_small_box() -> None:
    """In UTM, whose zone 60 goes on to the east of 180 degrees."""
    to_map = pyproj.Transformer.from_crs(4326, 32660, always_xy=True)
    corners = [np.array(to_map.transform(lon, 10.0)) for lon in (179.5, -179.5)]
    islands = [shapely.box(*(corner - 1000), *(corner + 1000)) for corner in corners]
    geometry, (west, south, east, north) = to_geojson(shapely.MultiPolygon(islands), pyproj.CRS(32660))
    assert (west, east) == pytest.approx((179.5, -179.5), abs=0.01)
    assert (south, north) == pytest.approx((9.99, 10.01), abs=0.002)
    assert geometry["type"] == "MultiPolygon"


def test_straight_edges_of_the_map_are_bent_in_degrees() -> None:
    """The upper edge of a box of 500 km in UTM is 21 km farther north at its middle than between its corners."""
    outline = shapely.box(250_000, 6_000_000, 750_000, 6_500_000)
    geometry, _ = to_geojson(outline, pyproj.CRS("EPSG:32635"))
    shape = shapely.geometry.shape(geometry)
    edges = shapely.get_coordinates(outline.exterior)
    middles = (edges[1:] + edges[:-1]) / 2
    lon, lat = pyproj.Transformer.from_crs(32635, 4326, always_xy=True).transform(*middles.T)
    away = [shape.exterior.distance(shapely.Point(*place)) for place in zip(lon, lat, strict=True)]
    assert max(away) < 1e-6
    # A point of every 32nd part of a side, to seven decimals.
    ring = np.array(geometry["coordinates"][0])
    assert len(ring) == 4 * 32 + 1
    assert (np.round(ring, 7) == ring).all()


def test_a_hole_is_no_part_of_a_footprint() -> None:
    outline = shapely.box(0, 0, 10, 10).difference(shapely.box(4, 4, 5, 5))
    geometry, _ = to_geojson(outline, DEGREES)
    assert len(geometry["coordinates"]) == 1
    assert shapely.geometry.shape(geometry).area == pytest.approx(100.0)


@pytest.mark.parametrize(("code", "pole"), [(3413, 90.0), (3031, -90.0)])
def test_a_part_around_a_pole_reaches_it(code: int, pole: float) -> None:
    geometry, box = to_geojson(shapely.box(-2e5, -2e5, 2e5, 2e5), pyproj.CRS(code))
    shape = shapely.geometry.shape(geometry)
    assert box[::2] == [-180.0, 180.0]
    assert pole in (box[1], box[3])
    assert all(shape.contains(shapely.Point(lon, pole * 0.999)) for lon in (-179, -90, 0, 45, 179))
    assert not any(shape.contains(shapely.Point(lon, pole * 0.96)) for lon in (-179, -90, 0, 45, 179))
    assert not shape.contains(shapely.Point(0, -pole * 0.999))


def test_the_faintest_pixels_are_valid(tmp_path: Path) -> None:
    """An alpha of 1 of 255 shows the image; an alpha of 0 hides it."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 3, 2, 2, gdal.GDT_Byte, ["ALPHA=YES"])
    dataset.SetProjection(pyproj.CRS("EPSG:32635").to_wkt())
    dataset.SetGeoTransform((500_000, 10, 0, 4_000_000, 0, -20))
    dataset.WriteArray(np.array([[[9] * 3] * 2, [[1, 1, 0]] * 2], dtype=np.uint8))
    dataset = None
    assert valid_outline(tmp_path / "a.tif").bounds == (500_000, 3_999_960, 500_020, 4_000_000)


def test_a_slanted_edge_has_no_stairs(tmp_path: Path) -> None:
    valid = np.tri(60, dtype=bool)
    outline = valid_outline(raster(tmp_path / "a.tif", valid))
    assert len(shapely.get_coordinates(outline)) < 10
    assert outline.area == pytest.approx(valid.sum() * 200, rel=0.05)
