"""Surfaces: field notes 2, 8, 9, 11, 13 and 32, and rays."""

from __future__ import annotations

import copy
import dataclasses
import multiprocessing
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pyproj
import pytest
from osgeo import gdal, osr
from pyproj.database import get_units_map

from ortho_pipeline.errors import CrsError, DatumError, InputError
from ortho_pipeline.geodesy.crs import GroundTransform, Vertical
from ortho_pipeline.geodesy.datum import dem_unit
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import TILE, TileCache, open_dem
from ortho_pipeline.surface.dem_file import DemFile
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.surface.footprint import image_grid, lay
from ortho_pipeline.surface.rays import meet_surface

gdal.UseExceptions()
EGM96 = Path("/usr/share/proj/egm96_15.gtx")
EGM2008 = Path("/usr/share/proj/us_nga_egm08_25.tif")
UTM_BOX = (300000.0, 6280000.0, 100.0)


def write_dem(
    path: Path,
    heights: np.ndarray,
    crs: str | None = "EPSG:32735",
    transform: tuple[float, ...] = (UTM_BOX[0], UTM_BOX[2], 0.0, UTM_BOX[1], 0.0, -UTM_BOX[2]),
    nodata: float | None = None,
    unit: str = "",
    kind: int = gdal.GDT_Float64,
    point: bool = False,
) -> Path:
    rows, columns = heights.shape
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, 1, kind)
    if point:
        dataset.SetMetadataItem("AREA_OR_POINT", "Point")
    if crs:
        reference = osr.SpatialReference()
        reference.SetFromUserInput(crs)
        reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
        dataset.SetSpatialRef(reference)
    dataset.SetGeoTransform(transform)
    band = dataset.GetRasterBand(1)
    if nodata is not None:
        band.SetNoDataValue(nodata)
    if unit:
        band.SetUnitType(unit)
    band.WriteArray(heights)
    dataset = band = None
    return path


def hills(rows: int = 60, columns: int = 80) -> np.ndarray:
    v, u = np.mgrid[:rows, :columns]
    return 300 + 40 * np.sin(u / 5) * np.cos(v / 7) + 0.5 * u


# -- the datum


def test_a_dem_without_height_datum_is_refused(tmp_path: Path) -> None:
    path = write_dem(tmp_path / "d.tif", hills())
    with pytest.raises(DatumError) as caught:
        open_dem(path)
    text = str(caught.value)
    assert str(path) in text
    for word in ("`surface.vertical`", "ellipsoid", "egm96", "egm2008", "EPSG:n", "grid file"):
        assert word in text


@pytest.mark.skipif(not EGM96.is_file(), reason="Debian's proj-data (egm96_15.gtx) is not installed")
def test_the_undulation_is_added_once(tmp_path: Path) -> None:
    plain = write_dem(tmp_path / "plain.tif", hills())
    declared = write_dem(tmp_path / "declared.tif", hills(), "EPSG:32735+5773")
    place = GroundTransform("EPSG:4979", "EPSG:32735")([[24.85, -33.6, 0]])[:, :2]
    place = np.array([[UTM_BOX[0] + 3050.0, UTM_BOX[1] - 2050.0]])
    lon, lat, _ = GroundTransform("EPSG:32735", "EPSG:4979")([[*place[0], 0]])[0]
    undulation = Vertical.parse("egm96").undulation([lon], [lat])[0]
    base = open_dem(plain, "ellipsoid").heights(place)[0]
    assert base == pytest.approx(hills()[20, 30])
    by_option = open_dem(plain, "egm96").heights(place)[0]
    by_file = open_dem(declared).heights(place)[0]
    both = open_dem(declared, "egm96").heights(place)[0]
    by_grid = open_dem(plain, str(EGM96)).heights(place)[0]
    assert by_option == pytest.approx(base + undulation, abs=0.002)
    assert by_option == by_file == both == pytest.approx(by_grid, abs=1e-9)


def test_an_option_against_a_coded_datum_needs_an_override(tmp_path: Path) -> None:
    path = write_dem(tmp_path / "d.tif", hills(), "EPSG:32735+5773")
    with pytest.raises(DatumError, match="EGM96") as caught:
        open_dem(path, "ellipsoid")
    assert "override" in str(caught.value)
    surface = open_dem(path, "ellipsoid", override=True)
    assert surface.heights([[UTM_BOX[0] + 50, UTM_BOX[1] - 50]])[0] == pytest.approx(300.0)
    assert surface.provenance["override"] is True
    assert surface.provenance["warnings"]


@pytest.mark.skipif(EGM2008.is_file(), reason="the EGM2008 grid is installed here")
def test_a_declared_datum_whose_grid_is_missing(tmp_path: Path) -> None:
    path = write_dem(tmp_path / "d.tif", hills(), "EPSG:32735+3855")
    with pytest.raises(DatumError, match=r"us_nga_egm08_25\.tif") as caught:
        open_dem(path)
    assert "surface.vertical" in str(caught.value)
    assert "EGM2008" in str(caught.value)
    with pytest.raises(DatumError, match="override"):
        open_dem(path, "egm96")
    # A grid file is how the declared geoid is brought along.
    assert open_dem(path, str(EGM96)).provenance["warnings"]


def test_the_grid_has_to_reach_the_dem(tmp_path: Path) -> None:
    geoid = write_dem(
        tmp_path / "geoid.tif", np.full((20, 20), 30.0), "EPSG:4326", (0, 0.1, 0, 10, 0, -0.1), kind=gdal.GDT_Float32
    )
    with pytest.raises(DatumError, match="does not cover"):
        open_dem(write_dem(tmp_path / "d.tif", hills()), str(geoid))


@pytest.mark.parametrize(
    ("unit", "factor"), [("ft", 0.3048), ("US survey foot", 1200 / 3937), ("metre", 1.0), ("", 1.0)]
)
def test_units_end_at_the_border(tmp_path: Path, unit: str, factor: float) -> None:
    surface = open_dem(write_dem(tmp_path / "d.tif", hills(), unit=unit), "ellipsoid")
    assert surface.window(3, 4, 1, 1)[0, 0] == pytest.approx(hills()[4, 3] * factor)


def test_feet_of_the_crs_and_units_that_contradict(tmp_path: Path) -> None:
    crs = "EPSG:32735+8228"
    feet = write_dem(tmp_path / "d.tif", hills(), crs)
    surface = open_dem(feet, "ellipsoid", override=True)
    assert surface.window(3, 4, 1, 1)[0, 0] == pytest.approx(hills()[4, 3] * 0.3048)
    with pytest.raises(DatumError, match="unit"):
        dem_unit("furlong", None)


def test_feet_of_the_datum_that_the_user_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Vertical, "undulation", lambda self, lon, lat: np.full(np.shape(lon), 30.0))
    surface = open_dem(write_dem(tmp_path / "d.tif", hills()), "EPSG:8228")
    assert surface.window(3, 4, 1, 1)[0, 0] == pytest.approx(hills()[4, 3] * 0.3048 + 30.0)


@pytest.mark.parametrize(
    ("text", "name"),
    [("m", "metre"), ("Meters", "metre"), ("cm", "centimetre"), ("centimeter", "centimetre"), ("feet", "foot"),
     ("foot", "foot"), ("International foot", "foot"), ("US survey feet", "US survey foot"),
     ("us-ft", "US survey foot"), ("ft_us", "US survey foot"), ("ftUS", "US survey foot")],
)  # fmt: skip
def test_units_by_name_are_those_of_proj(text: str, name: str) -> None:
    assert dem_unit(text, None) == pytest.approx(get_units_map()[name].conv_factor, rel=1e-12)


@pytest.mark.parametrize("fill", ["bad", "nan", float("inf")])
def test_fill_rules_are_checked(tmp_path: Path, fill: str | float) -> None:
    with pytest.raises(InputError, match=r"surface\.fill"):
        open_dem(write_dem(tmp_path / "d.tif", hills()), "ellipsoid", fill=fill)


# -- encodings

ALONG = (24.80, -33.62)


def plane(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    return 500.0 + 3000.0 * (lon - ALONG[0]) - 2000.0 * (lat - ALONG[1])


def fill_plane(crs: str, transform: tuple[float, ...], rows: int, columns: int) -> np.ndarray:
    v, u = np.mgrid[:rows, :columns] + 0.5
    x = transform[0] + transform[1] * u + transform[2] * v
    y = transform[3] + transform[4] * u + transform[5] * v
    ground = GroundTransform(crs, "EPSG:4979")(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))
    lon = (ground[:, 0] + 180) % 360 - 180
    return plane(lon, ground[:, 1]).reshape(rows, columns)


def encodings() -> dict[str, tuple[str, tuple[float, ...], bool]]:
    x, y, _ = GroundTransform("EPSG:4979", "EPSG:32735")([[*ALONG, 0]])[0]
    lon, lat = ALONG
    turn = np.radians(30)
    c, s = 30 * np.cos(turn), 30 * np.sin(turn)
    middle = (x - 100 * c - 100 * s, c, s, y - 100 * s + 100 * c, s, -c)
    return {
        "utm": ("EPSG:32735", (x - 3000, 30, 0, y + 3000, 0, -30), False),
        "geographic": ("EPSG:4326", (lon - 0.03, 0.0003, 0, lat + 0.03, 0, -0.0003), False),
        "point": ("EPSG:32735", (x - 3000, 30, 0, y + 3000, 0, -30), True),
        "rotated": ("EPSG:32735", middle, False),
        "south-up": ("EPSG:32735", (x - 3000, 30, 0, y - 3000, 0, 30), False),
        "360": ("EPSG:4326", (lon + 360 - 0.03, 0.0003, 0, lat + 0.03, 0, -0.0003), False),
    }


@pytest.mark.parametrize("name", list(encodings()))
def test_one_plane_in_six_encodings(tmp_path: Path, name: str) -> None:
    crs, transform, point = encodings()[name]
    path = write_dem(tmp_path / "d.tif", fill_plane(crs, transform, 200, 200), crs, transform, point=point)
    surface = open_dem(path, "ellipsoid")
    rng = np.random.default_rng(0)
    where = ALONG + rng.uniform(-0.015, 0.015, (500, 2))
    assert surface.heights(where, "EPSG:4326") == pytest.approx(plane(*where.T), abs=0.002)
    assert surface.heights(where + np.array([360, 0]), "EPSG:4326") == pytest.approx(plane(*where.T), abs=0.002)
    assert surface.coverage(where, "EPSG:4326") == 1.0
    # Sample coordinates and windows say the same as `heights`.
    xy = GroundTransform("EPSG:4326", surface.crs)(np.column_stack([where, np.zeros(500)]))[:, :2]
    u, v = np.rint(surface.samples_at(xy)).astype(int).T
    window = surface.window(0, 0, 200, 200)
    a, b, c, d, e, f = surface.pixel_from_crs
    centre = np.linalg.solve([[b, c], [e, f]], np.array([u - a, v - d])).T
    assert window[v, u] == pytest.approx(surface.heights(centre), abs=1e-6)


def test_a_dem_across_the_antimeridian(tmp_path: Path) -> None:
    transform = (179.0, 0.01, 0, -16.0, 0, -0.01)
    v, u = np.mgrid[:100, :200]
    surface = open_dem(write_dem(tmp_path / "d.tif", u + 0.5 * v, "EPSG:4326", transform), "ellipsoid")
    both = surface.heights([[179.505, -16.505], [-179.495, -16.505], [180.505, -16.505]], "EPSG:4326")
    assert both == pytest.approx([75, 175, 175])


def test_the_seam_of_a_global_dem(tmp_path: Path) -> None:
    # Heights that go round the world with the longitude.
    lon = np.arange(-180, 180) + 0.5
    heights = np.tile(1000 + 500 * np.cos(np.radians(lon)), (180, 1))
    surface = open_dem(write_dem(tmp_path / "d.tif", heights, "EPSG:4326", (-180, 1, 0, 90, 0, -1)), "ellipsoid")
    where = np.array([[179.9, 5.0], [-179.9, 5.0], [180.0, 5.0], [175.0, 5.0]])
    here = surface.around(179.0)
    assert here.shape == surface.shape
    assert np.isfinite(here.heights(where)).all()
    assert here.heights(where) == pytest.approx(1000 + 500 * np.cos(np.radians(where[:, 0])), abs=0.1)
    assert np.ptp(here.samples_at(where)[:, 0]) < 6
    assert here.heights([[10.5, 5.0]]) == pytest.approx(surface.heights([[10.5, 5.0]]))
    # Single positions need no turned grid.
    assert surface.heights(where) == pytest.approx(here.heights(where))
    assert surface.coverage(where) == 1.0
    corner = here.samples_at(np.array([[179.5, 0.5]]))[0].astype(int)
    assert here.window(*corner, 2, 1)[0] == pytest.approx(heights[0, [-1, 0]])
    # A DEM of a region has no height outside, even if its accuracy is a raster of the world.
    region = open_dem(write_dem(tmp_path / "r.tif", heights[:10, :10], "EPSG:4326", (10, 1, 0, 10, 0, -1)), "ellipsoid")
    assert np.isnan(replace(region, sigma=surface).heights([[9.9, 5.0], [25.0, 5.0]])).all()


# -- voids


@pytest.mark.parametrize("void", [-32768.0, 9999.0, np.nan, -9999.0, 1e30, 0.0])
def test_voids_are_not_heights_and_do_not_mix(tmp_path: Path, void: float) -> None:
    heights = hills()
    heights[20, 30] = void
    nodata = 0.0 if void == 0.0 else None
    surface = open_dem(write_dem(tmp_path / "d.tif", heights, nodata=nodata), "ellipsoid")
    x, y, step = UTM_BOX
    around = np.array(
        [
            [x + (30.5 + du) * step, y - (20.5 + dv) * step]
            for du in (-1, -0.5, 0, 0.5, 1)
            for dv in (-1, -0.5, 0, 0.5, 1)
        ]
    )
    found = surface.heights(around).reshape(5, 5)
    assert np.isnan(found[1:4, 1:4]).all()
    edge = np.ones((5, 5), dtype=bool)
    edge[1:4, 1:4] = False
    # Exactly on the neighbouring samples the void has no weight.
    assert np.isfinite(found[edge]).all()
    assert np.isnan(surface.window(30, 20, 1, 1)).all()
    assert surface.coverage(around) == pytest.approx(16 / 25)
    assert surface.height_range[1] < 400


@pytest.mark.parametrize("flags", [0, gdal.GMF_PER_DATASET])
def test_masked_samples_are_voids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: int) -> None:
    """Flags 0 are a mask of one band, which GDAL keeps in a sidecar."""
    path = write_dem(tmp_path / "d.tif", np.full((3, 3), 100.0))
    dataset = gdal.Open(str(path), gdal.GA_Update)
    monkeypatch.setenv("GDAL_TIFF_INTERNAL_MASK", "NO")
    dataset.GetRasterBand(1).CreateMaskBand(flags)
    mask = np.full((3, 3), 255, dtype=np.uint8)
    mask[1, 1] = 0
    dataset.GetRasterBand(1).GetMaskBand().WriteArray(mask)
    dataset = None
    assert (np.isnan(open_dem(path, "ellipsoid").window(0, 0, 3, 3)) == (mask == 0)).all()


@pytest.mark.parametrize(("unit", "metres"), [("", 1.0), ("ft", 0.3048)])
def test_scale_offset_and_integers(tmp_path: Path, unit: str, metres: float) -> None:
    """GDAL: what scale and offset make of a number is in the unit of the band."""
    raw = np.array([[1000, 2000], [-32768, 3000]], dtype=np.int16)
    path = write_dem(tmp_path / "d.tif", raw, nodata=-32768, kind=gdal.GDT_Int16, unit=unit)
    dataset = gdal.Open(str(path), gdal.GA_Update)
    dataset.GetRasterBand(1).SetScale(0.1)
    dataset.GetRasterBand(1).SetOffset(50.0)
    dataset = None
    window = open_dem(path, "ellipsoid").window(0, 0, 2, 2)
    assert window == pytest.approx(metres * np.array([[150.0, 250.0], [np.nan, 350.0]]), nan_ok=True)


@pytest.mark.parametrize("nodata", [None, -9999])
def test_the_lowest_integer_of_16_bits_is_a_void_with_any_scale(tmp_path: Path, nodata: float | None) -> None:
    raw = np.array([[10_000, -32768], [-32767, 20_000]], dtype=np.int16)
    path = write_dem(tmp_path / "d.tif", raw, kind=gdal.GDT_Int16, nodata=nodata)
    dataset = gdal.Open(str(path), gdal.GA_Update)
    dataset.GetRasterBand(1).SetScale(0.01)
    dataset = None
    window = open_dem(path, "ellipsoid").window(0, 0, 2, 2)
    assert window == pytest.approx(np.array([[100.0, np.nan], [-327.67, 200.0]]), nan_ok=True)


def test_outside_is_nan_and_fill_rules_say_otherwise(tmp_path: Path) -> None:
    heights = hills()
    heights[10:14, 10:14] = np.nan
    path = write_dem(tmp_path / "d.tif", heights)
    x, y, step = UTM_BOX
    void, far = [x + 11.5 * step, y - 11.5 * step], [x - 5000, y + 5000]
    for rule in ("error", "mask"):
        surface = open_dem(path, "ellipsoid", fill=rule)
        assert np.isnan(surface.heights([void, far])).all()
        window = surface.window(-3, -2, 8, 6)
        assert np.isnan(window[:2]).all()
        assert np.isnan(window[:, :3]).all()
        assert (window[2:, 3:] == heights[:4, :5]).all()
    constant = open_dem(path, "ellipsoid", fill=123.0)
    assert (constant.heights([void, far]) == 123.0).all()
    assert np.isfinite(constant.window(-3, -2, 20, 20)).all()
    assert constant.height_range[0] == 123.0
    assert constant.coverage([void, far]) == 0.0
    nearest = open_dem(path, "ellipsoid", fill="nearest")
    assert nearest.heights([far])[0] == heights[0, 0]
    assert nearest.window(9, 10, 2, 1)[0] == pytest.approx([heights[10, 9], heights[10, 9]])
    assert nearest.coverage([void, far]) == 0.0
    assert nearest.window(120, 120, 2, 2) == pytest.approx(np.full((2, 2), heights[-1, -1]))
    assert np.isnan(nearest.window(600, 600, 2, 2)).all()


@pytest.mark.parametrize(("step", "reach"), [(1000.0, 20), (100.0, 200), (10.0, 512), (30_000.0, 1)])
def test_the_nearest_height_is_at_most_20_km_and_512_samples_away(tmp_path: Path, step: float, reach: int) -> None:
    """As docs/faq.md promises, beyond the DEM and in a void, for single places and for windows."""
    heights = np.full((3, reach + 12), np.nan)
    heights[:, :4] = 7.0
    grid = UTM_BOX[0], step, 0.0, UTM_BOX[1], 0.0, -step
    dem = open_dem(write_dem(tmp_path / "d.tif", heights, transform=grid), "ellipsoid", fill="nearest")
    first = 3 + reach
    found = np.stack(
        [dem.heights_at(np.array([first - 1.0, first + 2.0]), np.ones(2)), dem.window(first - 1, 1, 4, 1)[0, ::3]]
    )
    assert np.array_equal(found, [[7.0, np.nan]] * 2, equal_nan=True)
    outside = np.array([1.0 - reach, -2.0 - reach])
    found = np.stack([dem.heights_at(outside, np.ones(2)), dem.window(-2 - reach, 1, 4, 1)[0, ::-3]])
    assert np.array_equal(found, [[7.0, np.nan]] * 2, equal_nan=True)


@pytest.mark.parametrize("fill", ["nearest", "-3.5", "mask"])
def test_a_look_with_another_rule_leaves_a_surface_as_it_was(tmp_path: Path, fill: str) -> None:
    heights = hills()
    heights[20:24, 30:36] = -9999.0
    path = write_dem(tmp_path / "dem.tif", heights, nodata=-9999.0)
    image = np.array([[3000.0, 2000.0], [3250.0, 2150.0], [7000.0, 5000.0]])
    ground = image * [1.0, -1.0] + UTM_BOX[:2]
    untouched = open_dem(path, "ellipsoid", fill=fill).heights(ground)
    surface = open_dem(path, "ellipsoid", fill=fill)
    # Its border must lie on the DEM: only then are tiles read.
    assert lay(Oblique(0.0), surface, 6000, 5000).voids == 24
    np.testing.assert_array_equal(surface.heights(ground), untouched)
    other = surface.with_fill("12.0")
    np.testing.assert_array_equal(other.heights(ground[1:2]), [12.0])
    np.testing.assert_array_equal(surface.heights(ground), untouched)
    assert (surface.fill, surface.provenance["fill"]) == (open_dem(path, "ellipsoid", fill=fill).fill,) * 2
    assert other.provenance["fill"] == 12.0
    assert other.height_range[0] == 12.0
    assert surface.height_range == open_dem(path, "ellipsoid", fill=fill).height_range
    with pytest.raises(AttributeError):
        surface.fill = "mask"  # type: ignore[misc]


def copies(surface: Surface) -> dict[str, Surface]:
    return {
        "copy": copy.copy(surface), "deep copy": copy.deepcopy(surface), "pickle": pickle.loads(pickle.dumps(surface)),
        "other fill": surface.with_fill("mask"), "other seam": surface.around(179.0),
    }  # fmt: skip


def global_dem(folder: Path, **options: str) -> Surface:
    heights = np.arange(20.0 * 36).reshape(20, 36)
    heights[5, 17:19] = -9999.0
    path = write_dem(folder / "world.tif", heights, "EPSG:4326", (-180, 10, 0, 90, 0, -9), nodata=-9999.0)
    return open_dem(path, "ellipsoid", **options)


def test_a_turned_global_dem_has_the_same_heights_at_its_new_seam(tmp_path: Path) -> None:
    surface = global_dem(tmp_path)
    # Turned around 63 degrees east, the seam is at 117 degrees west, between two samples.
    where = np.array([[-117.0, 10.0], [-113.0, -33.3], [-121.0, 40.0]])
    np.testing.assert_allclose(surface.around(63.0).heights(where), surface.heights(where), rtol=1e-12)


def test_no_two_surfaces_share_what_they_keep(tmp_path: Path) -> None:
    surface = global_dem(tmp_path, fill="nearest")
    where = np.array([[-0.5, 42.0], [33.0, 10.0], [-91.0, -33.3]])  # the first next to a void
    expected, lowest = surface.heights(where), surface.height_range
    assert np.isfinite(expected).all()
    for name, other in copies(surface).items():
        assert "height_range" not in vars(other), name
        found = other.heights(where)
        assert np.isnan(found[0]) == (name == "other fill"), name
        np.testing.assert_allclose(found[1:], expected[1:], rtol=1e-14)
        with pytest.raises(dataclasses.FrozenInstanceError):
            other.fill = 5.0
    np.testing.assert_array_equal(surface.heights(where), expected)
    assert surface.height_range == lowest


def test_a_worker_process_gets_a_surface(tmp_path: Path) -> None:
    surface = global_dem(tmp_path, fill="nearest").around(179.0)
    where = np.array([[-0.5, 42.0], [179.9, 10.0], [-179.9, 10.0]])
    flat = FlatSurface(7.5)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        np.testing.assert_array_equal(pool.submit(surface.heights, where).result(), surface.heights(where))
        np.testing.assert_array_equal(pool.submit(flat.heights, where).result(), [7.5, 7.5, 7.5])
    assert pickle.loads(pickle.dumps(surface)).provenance == surface.provenance


@pytest.mark.parametrize(
    ("code", "x", "y"),
    [
        (3857, 1.0e6, 8.4e6),
        (32633, 500_000.0, 6.65e6),
        (3413, 1.0e6, -1.0e6),
        (4326, 9.0, 60.0),
        (8035, 1.64e6, 1.478e7),
    ],
)
def test_the_size_of_samples_is_that_on_the_ground(tmp_path: Path, code: int, x: float, y: float) -> None:
    """`nearest` looks for heights within metres of the ground: in EPSG:3857 at 60° N the map has twice as many."""
    side = 3e-4 if code == 4326 else 30.0
    path = write_dem(tmp_path / "d.tif", hills(40, 40), f"EPSG:{code}", (x, side, 0.0, y, 0.0, -side))
    to_lonlat = pyproj.Transformer.from_crs(code, 4326, always_xy=True)
    u, v = np.array([20.0, 21.0, 20.0]), np.array([20.0, 20.0, 21.0])
    lon, lat = to_lonlat.transform(x + side * (u + 0.5), y - side * (v + 0.5))
    _, _, metres = pyproj.Geod(ellps="GRS80").inv(lon[[0, 0]], lat[[0, 0]], lon[1:], lat[1:])
    assert open_dem(path, "ellipsoid").sample_size == pytest.approx(max(metres), rel=1e-3)


def test_rays_that_stand_far_apart_read_every_tile_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On every step over a thousand rays each need another tile, which the next step needs again."""
    side, transform = 2600, (UTM_BOX[0], 2.0, 0.0, UTM_BOX[1], 0.0, -2.0)
    heights = hills(side, side).astype(np.float32)
    heights[700:760, 900:980] = -9999.0
    path = write_dem(tmp_path / "d.tif", heights, transform=transform, nodata=-9999.0, kind=gdal.GDT_Float32)
    surface = open_dem(path, "ellipsoid", fill="nearest")
    model = Oblique(lean=0.02)
    reads: list[int] = []
    inside = DemFile.read

    def read(self: DemFile, left: int, top: int, width: int, height: int, unit: float) -> np.ndarray:
        reads.append(width * height)
        return inside(self, left, top, width, height, unit)

    monkeypatch.setattr(DemFile, "read", read)
    ground = meet_surface(model, image_grid(5000, 5000, 33) + 50.0, surface)
    assert np.isfinite(ground).all()
    # The whole DEM for the range of heights, the tiles, and the wide surroundings of a few that lie on the void.
    assert sum(reads) < 3 * side**2 + 30 * (2 * surface.nearest_reach + TILE) ** 2


def test_heights_that_are_kept_take_no_more_memory_than_they_may(tmp_path: Path) -> None:
    kept, made = TileCache(3 * 80), []

    def make(key: int) -> np.ndarray:
        return kept.get(key, lambda: made.append(key) or np.full(10, float(key)))

    for key in (1, 2, 3, 1, 4, 1, 2):  # 4 drives out 2, which was used longest ago
        assert (make(key) == key).all()
    assert made == [1, 2, 3, 4, 2]
    large = TileCache(8)
    assert large.get("a", lambda: np.zeros(10)) is large.get("a", lambda: np.ones(10)), "the last one stays"
    path = write_dem(tmp_path / "d.tif", hills())
    assert open_dem(path, "ellipsoid", memory=80_000_000).cache_bytes == 10_000_000


def test_windows_do_not_depend_on_how_they_are_cut(tmp_path: Path) -> None:
    heights = hills(300, 320)
    rng = np.random.default_rng(3)
    heights[rng.random(heights.shape) < 0.3] = np.nan
    heights[100:180, 50:200] = np.nan
    surface = open_dem(write_dem(tmp_path / "d.tif", heights), "egm96", fill="nearest")
    whole = surface.window(-10, -10, 340, 320)
    assert np.isfinite(whole).all()
    for u0, v0, nu, nv in ((40, 90, 70, 64), (-5, 100, 33, 21), (110, 120, 1, 1), (250, 250, 80, 60)):
        assert (surface.window(u0, v0, nu, nv) == whole[v0 + 10 : v0 + 10 + nv, u0 + 10 : u0 + 10 + nu]).all()


@pytest.mark.skipif(not EGM96.is_file(), reason="Debian's proj-data (egm96_15.gtx) is not installed")
def test_the_undulation_between_its_lattice_is_exact_to_millimetres(tmp_path: Path) -> None:
    transform = (UTM_BOX[0], 7.0, 0, UTM_BOX[1], 0, -7.0)
    surface = open_dem(write_dem(tmp_path / "d.tif", np.zeros((700, 900)), transform=transform), "egm96")
    v, u = np.mgrid[:700:13, :900:11]
    ground = np.column_stack([UTM_BOX[0] + 7 * (u.ravel() + 0.5), UTM_BOX[1] - 7 * (v.ravel() + 0.5), np.zeros(u.size)])
    lonlat = GroundTransform("EPSG:32735", "EPSG:4979")(ground)
    exact = Vertical.parse("egm96").undulation(lonlat[:, 0], lonlat[:, 1]).reshape(u.shape)
    assert np.abs(surface.window(0, 0, 900, 700)[v, u] - exact).max() < 0.002


def test_threads_share_a_surface(tmp_path: Path) -> None:
    surface = open_dem(write_dem(tmp_path / "d.tif", hills(600, 700), kind=gdal.GDT_Float32), "egm96")
    expected = surface.window(0, 0, 700, 600)
    wrong: list[int] = []

    def work(seed: int) -> None:
        rng = np.random.default_rng(seed)
        for _ in range(30):
            u, v = rng.integers(0, 500, 2)
            if not np.array_equal(surface.window(u, v, 100, 90), expected[v : v + 90, u : u + 100]):
                wrong.append(seed)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


# -- what cannot be a DEM


def test_no_georeference(tmp_path: Path) -> None:
    with pytest.raises(CrsError, match="no CRS"):
        open_dem(write_dem(tmp_path / "d.tif", hills(), crs=None), "ellipsoid")
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "e.tif"), 5, 5, 1, gdal.GDT_Float32)
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(32735)
    dataset.SetSpatialRef(reference)
    dataset = None
    with pytest.raises(CrsError, match="no geotransform"):
        open_dem(tmp_path / "e.tif", "ellipsoid")


@pytest.mark.parametrize(("count", "kind", "heights"), [
    (3, gdal.GDT_Byte, False), (4, gdal.GDT_Byte, False), (1, gdal.GDT_Byte, True), (3, gdal.GDT_Float32, True),
])  # fmt: skip
def test_a_picture_in_colours_is_no_dem(tmp_path: Path, count: int, kind: int, heights: bool) -> None:
    """As shaded relief, and heights in red, green and blue."""
    path = tmp_path / "d.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 3, 3, count, kind)
    dataset.SetGeoTransform((300000, 10, 0, 6280000, 0, -10))
    dataset.SetSpatialRef(osr.SpatialReference(pyproj.CRS("EPSG:32735").to_wkt()))
    dataset = None
    if heights:
        assert open_dem(path, "ellipsoid").height_range == (0.0, 0.0)
    else:
        with pytest.raises(InputError, match="colours, not heights"):
            open_dem(path, "ellipsoid")


def test_nothing_but_voids(tmp_path: Path) -> None:
    surface = open_dem(write_dem(tmp_path / "d.tif", np.full((5, 5), np.nan)), "ellipsoid")
    with pytest.raises(InputError, match="no valid height"):
        _ = surface.height_range


def test_a_plane() -> None:
    surface = FlatSurface(85.5)
    assert surface.height == 85.5
    assert surface.heights([[24.0, -33.0], [np.nan, 0]], "EPSG:4326") == pytest.approx([85.5, np.nan], nan_ok=True)
    assert surface.height_range == (85.5, 85.5)
    assert surface.coverage([[0, 0]]) == 1.0
    with pytest.raises(InputError):
        FlatSurface(float("nan"))


# -- rays


@dataclass(frozen=True, eq=False)
class Oblique(SensorModel):
    """Parallel rays that lean by `lean` metres of x per metre of height, one pixel a metre."""

    kind: ClassVar[str] = "oblique"
    lean: float = 0.0

    @property
    def crs(self) -> str:
        return "EPSG:32735"

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([UTM_BOX[0] + 4000, UTM_BOX[1] - 3000, 500.0]), np.array([6000.0, 6000.0, 2000.0])

    def ground_to_image(self, ground) -> np.ndarray:
        ground = np.asarray(ground, dtype=float)
        return np.stack([ground[:, 0] - UTM_BOX[0] - self.lean * ground[:, 2], UTM_BOX[1] - ground[:, 1]], axis=1)

    def image_to_ground(self, image, height) -> np.ndarray:
        image = np.asarray(image, dtype=float)
        height = np.broadcast_to(np.asarray(height, dtype=float), (len(image),))
        return np.stack([UTM_BOX[0] + image[:, 0] + self.lean * height, UTM_BOX[1] - image[:, 1], height], axis=1)


@pytest.mark.parametrize("lean", [0.0, 0.3, -0.7, 1.7])
def test_rays_meet_the_terrain(tmp_path: Path, lean: float) -> None:
    surface = open_dem(write_dem(tmp_path / "d.tif", hills()), "ellipsoid")
    model = Oblique(lean=lean)
    rng = np.random.default_rng(2)
    image = rng.uniform([1500, 500], [6000, 5500], (300, 2)) - [lean * 300, 0]
    ground = meet_surface(model, image, surface)
    assert np.isfinite(ground).all()
    assert model.ground_to_image(ground) == pytest.approx(image, abs=1e-6)
    assert surface.heights(ground[:, :2]) == pytest.approx(ground[:, 2], abs=1e-3)


def wall() -> np.ndarray:
    heights = np.full((60, 80), 100.0)
    heights[:, 40:43] = 600.0
    return heights


def test_the_visible_side_of_a_ridge_is_found(tmp_path: Path) -> None:
    surface = open_dem(write_dem(tmp_path / "d.tif", wall()), "ellipsoid")
    # The sensor is in the east: coming down, a ray goes west and meets the top or the eastern face of the wall first.
    model = Oblique(lean=1.0)
    west = np.array([[4050.0 + k - 500.0, 3000.0] for k in (0.0, 60.0, 150.0, 300.0)])
    ground = meet_surface(model, west, surface)
    assert np.isfinite(ground).all()
    heights = np.linspace(700, 0, 20001)
    for k in range(len(west)):
        ray = model.image_to_ground(np.repeat(west[k : k + 1], len(heights), axis=0), heights)
        first = int(np.argmax(surface.heights(ray[:, :2]) >= heights))
        assert ground[k, 2] == pytest.approx(heights[first], abs=0.1)


def test_rays_that_leave_the_dem_are_nan(tmp_path: Path) -> None:
    surface = open_dem(write_dem(tmp_path / "d.tif", hills()), "ellipsoid")
    ground = meet_surface(Oblique(), np.array([[-500.0, 100.0], [4000.0, 3000.0], [np.nan, 1.0]]), surface)
    assert np.isnan(ground[[0, 2]]).all()
    assert np.isfinite(ground[1]).all()
    assert meet_surface(Oblique(), np.zeros((0, 2)), surface).shape == (0, 3)
    assert np.isnan(meet_surface(Oblique(), np.array([[-50000.0, 100.0]]), surface)).all()


def test_rays_meet_a_plane() -> None:
    ground = meet_surface(Oblique(lean=0.5), np.array([[100.0, 50.0]]), FlatSurface(200.0))
    assert ground.tolist() == [[UTM_BOX[0] + 200, UTM_BOX[1] - 50, 200.0]]


# -- real data


@pytest.mark.realdata
def test_the_real_dem_refuses_without_option_and_takes_egm96(real: Path) -> None:
    path = real / "orthority/ngi/dem.tif"
    if not EGM2008.is_file():
        with pytest.raises(DatumError) as caught:
            open_dem(path)
        text = str(caught.value)
        for word in ("EGM2008", "us_nga_egm08_25.tif", "`surface.vertical`"):
            assert word in text
    surface = open_dem(path, "egm96")
    assert any("EGM2008" in warning for warning in surface.provenance["warnings"])
    where = np.array([[24.4, -33.65]])
    raw = open_dem(path, "ellipsoid").heights(where, "EPSG:4326")
    assert surface.heights(where, "EPSG:4326") - raw == pytest.approx(28.208, abs=0.01)


@pytest.mark.realdata
@pytest.mark.parametrize("opener", [lambda p: p / "N44E005.hgt"])
@pytest.mark.driver("SRTMHGT")
def test_a_real_srtm_tile(real: Path, opener: Callable[[Path], Path]) -> None:
    surface = open_dem(opener(real / "shareloc/dtm/srtm_ventoux/srtm90_non_void_filled"), "egm96")
    # Mont Ventoux: 1909 m above the sea.
    lon, lat = np.meshgrid(np.linspace(5.25, 5.31, 60), np.linspace(44.15, 44.2, 60))
    peak = np.nanmax(surface.heights(np.column_stack([lon.ravel(), lat.ravel()]), "EPSG:4326"))
    assert 1880 < peak - Vertical.parse("egm96").undulation([5.28], [44.17])[0] < 1915


def test_a_worker_with_another_working_folder_gets_the_same_dem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    global_dem(tmp_path)
    monkeypatch.chdir(tmp_path)
    sent = pickle.dumps(open_dem("world.tif", "ellipsoid"))
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    assert np.isfinite(pickle.loads(sent).heights(np.array([[33.0, 10.0]]))).all()
