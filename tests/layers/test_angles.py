"""Angles of view against the geometry of rays, of the sun against a rendered scene."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import orthos
import pyproj
import pytest
from blocks import FLOOR, NORTH, WEST, City, Parallel, f1, towards
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric
from ortho_pipeline.models import FrameCamera
from ortho_pipeline.models.frame.camera import MAP
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.options import OutputOptions, SurfaceOptions
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.report.document import read_report
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem
from ortho_pipeline.warp.quality.angles import Sun, write_angles, write_shadows
from ortho_pipeline.warp.quality.hiding import Hiding
from ortho_pipeline.warp.quality.sight import Sight

TOWN = City(((60, 40, 90, 80, 30.0), (120, 100, 128, 110, 60.0), (30, 150, 150, 162, 18.0), (180, 60, 220, 66, 25.0)))
SUN = Sun(142.0, 40.0)


def read(path):
    return gdal.Open(str(path)).ReadAsArray()


def test_angles_of_view_are_those_of_the_rays_in_space(tiny, tmp_path):
    """Two points of a pixel's ray, 200 m apart in height, in ECEF: their direction, in the axes of the place."""
    utm = pyproj.CRS.from_epsg(32634)
    x, y = pyproj.Transformer.from_crs(4326, utm, always_xy=True).transform(tiny.model.lon_off, tiny.model.lat_off)
    grid = Grid(utm, x - 960, y + 720, 4.8, 4.8, 400, 300)
    dem = open_dem(tiny.dem, "ellipsoid")
    write_angles(Sight(tiny.model, grid), dem, (400, 300), tmp_path / "a.tif", heights=(480.0, 520.0), step=8)
    zenith, azimuth = read(tmp_path / "a.tif")
    columns, rows = (part.ravel() for part in np.meshgrid(np.arange(20, 30) * 8 + 4.0, np.arange(10, 20) * 8 + 4.0))
    heights = dem.heights(np.stack(grid.xy(columns, rows), axis=1), utm)
    image = Sight(tiny.model, grid).image(columns, rows, heights)
    low, high = (tiny.model.image_to_ground(image, heights + rise) for rise in (-100.0, 100.0))
    ray = np.einsum("nij,nj->ni", enu_from_ecef(low), geocentric(high) - geocentric(low))
    found = (rows // 8).astype(int), (columns // 8).astype(int)
    np.testing.assert_allclose(
        zenith[found], np.degrees(np.arctan2(np.hypot(ray[:, 0], ray[:, 1]), ray[:, 2])), atol=0.05
    )
    np.testing.assert_allclose(azimuth[found], np.degrees(np.arctan2(ray[:, 0], ray[:, 1])) % 360, atol=0.3)


@pytest.mark.parametrize(("east", "north"), [(0.3, 0.0), (0.0, 0.4), (-0.2, -0.3)])
def test_the_sun_falls_on_a_slope_as_the_normal_has_it(tmp_path, east, north):
    step = np.arange(0, 400.0, 4)
    heights = FLOOR + 50 + east * step - north * step[:, None]  # rows go south
    write_dem(tmp_path / "dem.tif", heights, (WEST - 70, NORTH + 70), 4.0, "EPSG:32636")
    surface, grid = open_dem(tmp_path / "dem.tif", "ellipsoid"), City(()).grid(1.0)
    sight = Sight(Parallel(0.0, 0.0, 1.0, 256.0), grid)
    write_angles(sight, surface, (256, 256), tmp_path / "a.tif", heights=(0.0, 300.0), step=8, sun=SUN)
    zenith, _, incidence = read(tmp_path / "a.tif")[:, 10, 10]
    normal, sun = np.array([-east, -north, 1.0]), np.array([*towards(50.0, 142.0), 1.0])
    cosine = normal @ sun / np.linalg.norm(normal) / np.linalg.norm(sun)
    # The map's north is a third of a degree from the true one here.
    assert incidence == pytest.approx(np.degrees(np.arccos(cosine)), abs=0.4)
    assert zenith == pytest.approx(0.0, abs=1e-6)


def test_angles_end_where_the_image_ends(tmp_path):
    """Rays that go 0.3 m east and 0.4 m north per metre upwards; the image is smaller than the map on two sides."""
    surface, grid = City(()).surface(tmp_path / "dem.tif"), City(()).grid(1.0)
    sight, path = Sight(Parallel(0.3, 0.4, 1.0, 256.0), grid), tmp_path / "a.tif"
    made = write_angles(sight, surface, (99, 150), path, heights=(FLOOR, FLOOR), step=8)
    zenith, azimuth = read(path)
    inside = np.zeros((32, 32), dtype=bool)
    inside[:19, :12] = True  # middles at 4, 12, … 148 and 92
    np.testing.assert_array_equal(np.isfinite(zenith), inside)
    np.testing.assert_array_equal(np.isfinite(azimuth), inside)
    np.testing.assert_allclose(zenith[inside], np.degrees(np.arctan(0.5)), atol=0.01)
    np.testing.assert_allclose(azimuth[inside], np.degrees(np.arctan2(0.3, 0.4)), atol=0.01)
    assert made.view_zenith_deg == pytest.approx((np.degrees(np.arctan(0.5)),) * 2, abs=0.01)
    nothing = write_angles(sight, surface, (1, 1), path, heights=(FLOOR, FLOOR), step=8)
    assert np.isnan(nothing.view_zenith_deg).all()


def test_angles_end_where_the_image_ends_on_steep_ground(tmp_path):
    """An oblique camera 4 km above hills of 600 m: the curve of image points by height is worth several pixels."""
    interior, heights = Interior(300, 240, 0.01, 5e-6, 5e-6), (FLOOR, FLOOR + 600.0)
    exterior = [WEST, NORTH, FLOOR + 4300.0, np.radians(25.0), np.radians(-15.0), 0.0]
    model = FrameCamera.from_map(interior, "EPSG:32636", exterior, frame=MAP, heights=heights)
    x, y, _ = model.image_to_ground(np.array([[150.0, 120.0]]), FLOOR + 300.0)[0]
    v, u = np.mgrid[:121, :121]
    write_dem(
        tmp_path / "dem.tif",
        FLOOR + 300 + 300 * np.sin(u / 9) * np.cos(v / 7),
        (x - 605.0, y + 605.0),
        10.0,
        "EPSG:32636",
    )
    surface = open_dem(tmp_path / "dem.tif", "ellipsoid")
    grid = Grid(surface.grid.crs, x - 560.0, y + 560.0, 8.0, 8.0, 140, 140)
    write_angles(Sight(model, grid), surface, (300, 240), tmp_path / "a.tif", heights=heights, step=1)
    columns, rows = (part.ravel() + 0.5 for part in np.meshgrid(np.arange(140), np.arange(140)))
    places = np.stack(grid.xy(columns, rows), axis=1)
    image = model.ground_to_image(np.column_stack([places, surface.heights(places, grid.crs)]))
    within = np.minimum(image, (300.0, 240.0) - image).min(axis=1)
    shown = np.isfinite(read(tmp_path / "a.tif")[0]).ravel()
    assert 0.2 < shown.mean() < 0.8
    far = np.abs(within) > 0.2
    np.testing.assert_array_equal(shown[far], within[far] > 0)


def test_angles_are_stored_in_degrees_as_they_are(tmp_path):
    """Neither scaled nor shifted, so that any program reads the same numbers."""
    surface, sight = City(()).surface(tmp_path / "dem.tif"), Sight(Parallel(0.3, 0.4, 1.0, 256.0), City(()).grid(1.0))
    write_angles(sight, surface, (256, 256), tmp_path / "a.tif", heights=(FLOOR, FLOOR), step=8, sun=SUN)
    dataset = gdal.Open(str(tmp_path / "a.tif"))
    bands = [dataset.GetRasterBand(k + 1) for k in range(3)]
    assert [band.GetUnitType() for band in bands] == ["degree"] * 3
    assert [(band.GetScale() or 1.0, band.GetOffset() or 0.0) for band in bands] == [(1.0, 0.0)] * 3


@pytest.mark.parametrize("place", [(142.0, 0.0), (142.0, 90.5), (142.0, -3.0), (360.5, 40.0), (-360.5, 40.0)])
def test_what_is_no_place_of_the_sun_is_refused(place):
    with pytest.raises(InputError, match="not a position of the sun") as caught:
        Sun(*place)
    assert caught.value.field == "output.sun"


@pytest.mark.parametrize(("place", "way"), [((360.0, 45.0), (0.0, 1.0)), ((-360.0, 90.0), (0.0, 0.0)),
                                            ((-90.0, 45.0), (-1.0, 0.0))])  # fmt: skip
def test_the_way_to_the_sun(place, way):
    np.testing.assert_allclose(Sun(*place).way, way, atol=1e-12)


def test_ground_without_a_height_is_neither_lit_nor_in_shadow(tmp_path):
    """A tower of 20 m in the sun of 45 degrees from the south: 20 m of shadow north of it, wherever voids are."""
    tower = City(((100, 100, 120, 120, 20.0),))
    tower.surface(tmp_path / "dem.tif")
    dataset = gdal.Open(str(tmp_path / "dem.tif"), gdal.GA_Update)
    heights = dataset.ReadAsArray()
    heights[40:80, 40:140] = -32768.0
    dataset.WriteArray(heights)
    dataset = None
    surface, grid = open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"), tower.grid(1.0)
    path, sight = tmp_path / "shadow.tif", Sight(Parallel(0.0, 0.0, 1.0, 256.0), grid)
    share = write_shadows(sight, surface, Sun(180.0, 45.0), path, heights=(FLOOR, FLOOR + 20))
    found = read(path)
    x, y = tower.places(grid)
    own = surface.heights(np.stack([part.ravel() for part in (x + WEST, y + NORTH - 256.0)], axis=1)).reshape(x.shape)
    np.testing.assert_array_equal(found == 4, np.isnan(own))
    dark = (x > 101) & (x < 119) & (y > 121.5) & (y < 138.5)
    bright = (np.abs(x - 110) > 12) | (y < 99) | (y > 142)
    assert (found[dark] == 2).all()
    assert set(np.unique(found[bright])) == {1, 4}
    assert share == pytest.approx((found == 2).sum() / (found < 4).sum())
    mask = gdal.Open(str(path))
    assert [mask.GetMetadataItem(f"CLASS_{value}") for value in (1, 2, 4)] == [
        "in the sun", "in shadow", "without a height",
    ]  # fmt: skip
    assert [mask.GetMetadataItem(f"SUN_{name}") for name in ("AZIMUTH", "ELEVATION")] == ["180", "45"]


def test_the_earth_falls_away_below_a_low_sun(tmp_path):
    """A plateau of 100 m, the sun 1 degree high in the south: its shadow is 140 m shorter than on a flat Earth."""
    heights = np.full((720, 40), FLOOR)
    heights[700:] += 100.0
    write_dem(tmp_path / "dem.tif", heights, (WEST - 200, NORTH), 10.0, "EPSG:32636")
    grid = Grid(pyproj.CRS.from_epsg(32636), WEST - 100, NORTH, 10.0, 10.0, 20, 695)
    surface, sight = open_dem(tmp_path / "dem.tif", "ellipsoid"), Sight(Parallel(0.0, 0.0, 10.0, 256.0), grid)
    write_shadows(sight, surface, Sun(180.0, 1.0), tmp_path / "shadow.tif", heights=(FLOOR, FLOOR + 100))
    first = np.argmax(read(tmp_path / "shadow.tif") == 2, axis=0)
    # distance * tangent + distance^2 / 2 R = 100 m, from the first sample of the plateau.
    tangent, radius = np.tan(np.radians(1.0)), 6_371_000.0
    length = radius * (np.sqrt(tangent**2 + 2 * 100.0 / radius) - tangent)
    assert 100.0 / tangent - length > 130
    np.testing.assert_allclose(7005.0 - 10.0 * first - 5.0, length, atol=12)


def rendered(off_nadir: float, azimuth: float) -> np.ndarray:
    """Return an image of the town: each pixel's ray is walked down to the first box, roof or ground; shade is 40."""
    east, north = towards(off_nadir, azimuth)
    count = int(TOWN.side / 0.5)
    columns, rows = np.meshgrid(np.arange(count) + 0.5, np.arange(count) + 0.5)
    x, y = 0.5 * columns, TOWN.side - 0.5 * rows
    height = np.zeros(x.shape)
    for level in np.arange(60.0, 0.0, -0.25):
        inside = TOWN.heights(x + east * level, y + north * level) >= level
        height = np.where((height == 0) & inside, level, height)
    place = x + east * height, y + north * height
    # A wall is dark: what the sun does there is no matter of an ortho.
    roof = TOWN.heights(*place)
    shade = TOWN.hidden(*place, *towards(90 - SUN.elevation_deg, SUN.azimuth_deg)) | (np.abs(roof - height) > 0.3)
    return np.where(shade, 40, 200).astype(np.uint8)


def test_shadows_of_a_rendered_scene_are_where_the_mask_has_them(tmp_path):
    east, north = towards(15, 300)
    model, grid, surface = Parallel(east, north, 0.5, TOWN.side), TOWN.grid(), TOWN.surface(tmp_path / "dsm.tif", 0.25)
    image = rendered(15, 300)
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "image.tif"), *image.shape[::-1], 1, gdal.GDT_Byte)
    made.WriteArray(image)
    made = None
    heights = (FLOOR, FLOOR + 60)
    hiding = Hiding(tmp_path / "ortho.tif", heights, tmp_path / "mask.tif")
    orthos.rectify(model, RasterSource(tmp_path / "image.tif"), surface, grid, hiding, resampling="nearest")
    # The map's north, not the true one, is the renderer's.
    bearing = Sun(SUN.azimuth_deg + _convergence(grid), SUN.elevation_deg)
    share = write_shadows(Sight(model, grid), surface, bearing, tmp_path / "shadow.tif", heights=heights)
    shadow, visible = read(tmp_path / "shadow.tif"), read(tmp_path / "mask.tif") == 1
    dark = read(tmp_path / "ortho.tif") == 40
    assert f1((shadow == 2) & visible, dark & visible) >= 0.98
    assert share == pytest.approx((shadow == 2).mean())
    assert 0.02 < share < 0.3


def _convergence(grid: Grid) -> float:
    x, y = grid.xy(np.array([grid.width / 2]), np.array([grid.height / 2]))
    place = pyproj.Transformer.from_crs(grid.crs, 4326, always_xy=True).transform(x[0], y[0])
    return float(pyproj.Proj(grid.crs).get_factors(*place).meridian_convergence)


def test_rectify_writes_angles_and_shadows_with_the_ortho(tiny, tmp_path):
    output = OutputOptions(resolution=10.0, crs="EPSG:32634", angles=True, sun=(60.0, 3.0), layer_step=4)
    surface = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    result = commands.rectify(tiny.image, tmp_path / "out", surface=surface, output=output)
    bands = gdal.Open(str(result.files["angles"]))
    names = [bands.GetRasterBand(k + 1).GetDescription() for k in range(bands.RasterCount)]
    assert names == ["view_zenith", "view_azimuth", "sun_incidence"]
    style = ElementTree.parse(result.files["angles_style"]).getroot()
    low, high = (float(style.find(".//rasterrenderer").get(f"classification{end}")) for end in ("Min", "Max"))
    zenith = bands.GetRasterBand(1).ReadAsArray()
    assert low == pytest.approx(np.nanmin(zenith), rel=1e-4)
    assert high >= np.nanmax(zenith) * (1 - 1e-4)
    report = read_report(result.files["report"])
    assert report.angles.sun_deg == (60.0, 3.0)
    # Waves of 20 m over 300 m throw shadows where the sun is so low.
    assert 0.05 < report.angles.shadow_share < 0.9
    assert "in shadow" in report.angles.statement
    night = OutputOptions(resolution=10.0, crs="EPSG:32634", angles=True)
    without = commands.rectify(tiny.image, tmp_path / "out", surface=surface, output=night)
    assert "shadow" not in without.files
    assert not result.files["shadow"].exists()
    for wrong in (OutputOptions(sun=(60.0, 3.0)), OutputOptions(angles=True, sun=(60.0, -3.0))):
        with pytest.raises(InputError):
            commands.check(tiny.image, surface=surface, output=wrong)
