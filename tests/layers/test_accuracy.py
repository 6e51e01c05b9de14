"""The layer of accuracy: its parts against errors that are drawn, its file against the parts at its pixels."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyproj
import pytest
from blocks import FLOOR, NORTH, WEST, City, Parallel, slopes_of
from osgeo import gdal
from scipy import stats

from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem
from ortho_pipeline.warp.quality import accuracy
from ortho_pipeline.warp.quality.accuracy import Budget, layer_grid, parts_at, predictive, write_accuracy
from ortho_pipeline.warp.quality.error_ellipse import circular_error
from ortho_pipeline.warp.quality.sight import Sight

UTM, UTM36 = pyproj.CRS.from_epsg(32634), pyproj.CRS.from_epsg(32636)
SIZE = (400, 300)


def corrected(model) -> ImageCorrection:
    return ImageCorrection(model, "affine", (200.0, 150.0), np.array([0.4, 1e-4, -2e-4, -0.3, 2e-4, 1e-4]))


#: Of shifts and slopes that are correlated.
COVARIANCE = (
    np.diag([0.5, 2e-3, 1e-3, 0.8, 1e-3, 2e-3]) @ (0.7 * np.eye(6) + 0.3) @ np.diag([0.5, 2e-3, 1e-3, 0.8, 1e-3, 2e-3])
)


def grid_of(tiny, side: float = 4.8) -> Grid:
    lon, lat = tiny.model.lon_off, tiny.model.lat_off
    x, y = pyproj.Transformer.from_crs(4326, UTM, always_xy=True).transform(lon, lat)
    return Grid.of_extent(UTM, (x - 1000, y - 750, x + 1000, y + 750), (side, side))


def test_the_parts_are_the_spread_of_errors_that_are_drawn(tiny):
    """An image point is met again on the ground by the true model at the true height: exact, and nothing linear."""
    model, random, count = corrected(tiny.model), np.random.default_rng(4), 20_000
    sight = Sight(model, grid_of(tiny))
    column, row, height = 130.3, 250.8, 540.0
    budget = Budget(covariance=COVARIANCE, heights=6.0, datum=2.0, reference=0.5)
    parts = parts_at(budget, sight, *(np.array([value]) for value in (column, row, height)))
    params = model.params + random.multivariate_normal(np.zeros(6), COVARIANCE, count)
    heights = height + random.normal(0, np.hypot(6.0, 2.0), count)
    x, y = sight.grid.xy(np.array([column]), np.array([row]))
    ground = sight.ground(np.full(count, column), np.full(count, row), heights)
    seen = model.model.ground_to_image(ground)
    slopes = np.einsum("nij,nj->ni", params[:, [1, 2, 4, 5]].reshape(-1, 2, 2), seen - model.origin)
    image = seen + params[:, [0, 3]] + slopes
    there = pyproj.Transformer.from_crs(4979, UTM, always_xy=True)
    met = model.image_to_ground(image, height)
    shown = np.stack(there.transform(met[:, 0], met[:, 1]), axis=1) - [x[0], y[0]] + random.normal(0, 0.5, (count, 2))
    drawn = np.cov(shown.T)
    total = parts.total[0]
    # A variance of 20,000 draws is known to 1 %.
    np.testing.assert_allclose([drawn[0, 0], drawn[1, 1]], total[:2], rtol=0.04)
    assert drawn[0, 1] == pytest.approx(total[2], abs=0.04 * np.sqrt(total[0] * total[1]))
    for name, one in zip(parts._fields, parts, strict=True):
        assert (one[0, :2].sum() > 0) == (name != "interpolation")


def test_the_file_holds_what_the_parts_say_at_its_pixels(tiny, tmp_path):
    model, grid = corrected(tiny.model), grid_of(tiny)
    dem = open_dem(tiny.dem, "ellipsoid")
    budget = Budget(covariance=COVARIANCE, heights=4.0, datum=0.5, interpolation_px=0.3)
    path = tmp_path / "accuracy.tif"
    made = write_accuracy(budget, Sight(model, grid), dem, SIZE, path, heights=(480.0, 520.0), step=2)
    dataset = gdal.Open(str(path))
    bands, small = dataset.ReadAsArray().astype(float), layer_grid(grid, 2)
    assert dataset.GetGeoTransform() == pytest.approx(small.geotransform)
    assert [dataset.GetRasterBand(k + 1).GetDescription() for k in range(4)] == ["sigma_e", "sigma_n", "rho", "ce90"]
    assert [dataset.GetRasterBand(k + 1).GetUnitType() for k in range(4)] == ["m", "m", "", "m"]
    columns, rows = (part.ravel() + 0.5 for part in np.meshgrid(np.arange(small.width), np.arange(small.height)))
    heights = dem.heights(np.stack(small.xy(columns, rows), axis=1), UTM)
    sight = Sight(model, small)
    image = sight.image(columns, rows, heights)
    inside = ((image >= 0) & (image <= SIZE)).all(axis=1)
    slopes = slopes_of(dem, sight, columns, rows)
    parts = parts_at(budget, sight, columns, rows, heights, slopes=slopes)
    wanted = parts.total
    found = bands.reshape(4, -1)
    np.testing.assert_array_equal(np.isfinite(found[3]), inside)
    assert 0.3 < inside.mean() < 0.95
    for k in range(2):
        np.testing.assert_allclose(found[k][inside], np.sqrt(wanted[inside, k]), rtol=0.005)
    np.testing.assert_allclose(found[3][inside], circular_error(wanted[inside]), rtol=0.005)
    rho = wanted[inside, 2] / np.sqrt(wanted[inside, 0] * wanted[inside, 1])
    np.testing.assert_allclose(found[2][inside], rho, atol=0.005)
    shares = np.array([one[inside, :2].sum() for one in parts])
    np.testing.assert_allclose(list(made.shares.values()), shares / shares.sum(), atol=0.005)
    assert made.quantiles[0] < made.ce90 < made.quantiles[2]
    assert np.nanmax(made.cells) <= np.nanmax(found[3])
    assert made.known == 1.0


def test_heights_of_unknown_quality_have_no_accuracy_and_void_ones_neither(tiny, tmp_path):
    """A raster of standard deviations with a void: no number stands for what nobody knows."""
    grid, path, quality = grid_of(tiny), tmp_path / "accuracy.tif", tmp_path / "hem.tif"
    dem = gdal.Open(str(tiny.dem))
    copy = gdal.GetDriverByName("GTiff").CreateCopy(str(quality), dem)
    values = np.full((dem.RasterYSize, dem.RasterXSize), 3.0, dtype=np.float32)
    values[:, :65] = 1.0
    values[60:70, 40:50] = -32767.0
    copy.GetRasterBand(1).SetNoDataValue(-32767.0)
    copy.WriteArray(values)
    copy = None
    sigma = open_dem(quality, "ellipsoid", override=True, fill="mask")
    write = {"heights": (480.0, 520.0), "step": 4}
    sight, surface = Sight(tiny.model, grid), open_dem(tiny.dem, "ellipsoid")
    made = write_accuracy(Budget(heights=sigma), sight, surface, SIZE, path, **write)
    ce90 = gdal.Open(str(path)).ReadAsArray()[3]
    one = write_accuracy(Budget(heights=1.0), sight, surface, SIZE, path, **write)
    even = gdal.Open(str(path)).ReadAsArray()[3]
    ratio = ce90 / even
    assert 0.9 < made.known < 1.0
    assert one.known == 1.0
    middle = ratio.shape[1] // 2
    np.testing.assert_allclose(ratio[:, middle + 5 :][np.isfinite(ratio[:, middle + 5 :])], 3.0, rtol=1e-3)
    np.testing.assert_allclose(np.nanmin(ratio), 1.0, rtol=1e-3)
    void = np.isnan(ce90) & np.isfinite(even)
    assert void.any()


def test_the_layer_does_not_depend_on_the_memory(tiny, tmp_path):
    from ortho_pipeline.runtime.process_limits import Resources

    sight, surface = Sight(corrected(tiny.model), grid_of(tiny)), open_dem(tiny.dem, "ellipsoid")
    found = []
    for memory in (512_000_000, 16_000):
        path = tmp_path / f"{memory}.tif"
        write_accuracy(
            Budget(covariance=COVARIANCE, heights=4.0), sight, surface, SIZE, path, heights=(480.0, 520.0), step=1,
            resources=Resources(memory),
        )  # fmt: skip
        found.append(gdal.Open(str(path)).ReadAsArray())
    np.testing.assert_array_equal(*found)


def test_what_a_vendor_states_is_a_radius_on_the_ground(tiny):
    sight = Sight(dataclasses.replace(tiny.model, err_bias=8.0, err_rand=1.0), grid_of(tiny))
    parts = parts_at(Budget(stated=3.0), sight, np.array([100.0]), np.array([90.0]), np.array([500.0]))
    np.testing.assert_allclose(parts.total, [[9.0, 9.0, 0.0]])


@pytest.mark.parametrize(("freedom", "counted"), [(1, 3), (3, 3), (4, 4), (5, 5), (40, 40), (np.inf, 1e12)])
def test_few_points_predict_with_the_variance_of_student(freedom, counted):
    covariance = np.array([[4.0, -1.0], [-1.0, 2.0]])
    np.testing.assert_allclose(predictive(covariance, freedom), covariance * stats.t.var(counted))


#: Metres of the ground per metre of the map on the central meridian of a UTM zone.
TRUE = 1 / 0.9996


def test_parallel_rays_have_the_parts_of_a_plain_formula():
    """Rays that go 0.3 m east and -0.4 m north per metre upwards, pixels of 2 m."""
    sight = Sight(Parallel(0.3, -0.4, 2.0, 256.0), City(()).grid())
    budget = Budget(heights=4.0, datum=3.0, reference=0.5, interpolation_px=0.6)
    place = [np.array([value]) for value in (200.0, 300.0, FLOOR)]
    parts = parts_at(budget, sight, *place)
    square = TRUE**2
    np.testing.assert_allclose(parts.model, [[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(parts.heights, [np.array([2.25, 4.0, -3.0]) * square], rtol=1e-4)
    np.testing.assert_allclose(parts.even, [[0.25, 0.25, 0.0]])
    # The variance of an even distribution of +-0.6 px.
    np.testing.assert_allclose(parts.interpolation, [np.array([0.48, 0.48, 0.0]) * square], rtol=1e-4, atol=1e-5)
    # Heights of a raster: those at the place count instead.
    other = parts_at(budget, sight, *place, sigma_heights=np.array([1.0]))
    np.testing.assert_allclose(other.heights, [np.array([0.9, 1.6, -1.2]) * square], rtol=1e-4)


@pytest.mark.parametrize("slope", [(0.5, 0.0), (-0.5, 0.0), (0.3, 0.6), (-0.8, 0.7), (0.9, -0.6)])
def test_on_a_slope_errors_are_those_of_rays_that_meet_it(slope, tmp_path):
    """Ground that turns away from the sensor is off by more, and ground that faces it by less."""
    model = Parallel(0.6, -0.3, 2.0, 256.0)
    corner, x = np.array([WEST - 40.5, NORTH + 40.5]), np.arange(340.0)
    rise = FLOOR + slope[0] * (x - 168.0) - slope[1] * (x[:, None] - 168.0)
    write_dem(tmp_path / "dem.tif", rise, tuple(corner), 1.0, "EPSG:32636")
    dem, sight = open_dem(tmp_path / "dem.tif", "ellipsoid"), Sight(model, City(()).grid(2.0))
    place = np.array([41.5]), np.array([77.5])
    at = np.stack(sight.grid.xy(*place), axis=1)
    height = dem.heights(at, UTM36)

    def met(image):
        """Return where a ray meets the plane of the slope, from the place, metres on the map."""
        way = np.array([model.east, model.north])
        foot = np.array([image[0] * 2.0 + WEST, NORTH - image[1] * 2.0]) - at[0]  # at the height of the floor
        up = (height[0] - FLOOR + foot @ slope) / (1.0 - way @ slope)
        return foot + way * up

    seen = sight.image(*place, height)[0]
    np.testing.assert_allclose(met(seen), 0.0, atol=1e-6)
    off = np.array([met(sight.image(*place, height + 1.0)[0]), met(seen + np.eye(2)[0]), met(seen + np.eye(2)[1])])
    slopes = slopes_of(dem, sight, *place)
    parts = parts_at(Budget(heights=1.0), sight, *place, height, slopes=slopes)
    by_map = TRUE**2 * np.array([[one[0] ** 2, one[1] ** 2, one[0] * one[1]] for one in off])
    np.testing.assert_allclose(parts.heights, by_map[:1], rtol=2e-3, atol=1e-4)
    interpolation = parts_at(Budget(interpolation_px=np.sqrt(3.0)), sight, *place, height, slopes=slopes).interpolation
    np.testing.assert_allclose(interpolation, by_map[1:].sum(axis=0)[None], rtol=2e-3, atol=1e-4)
    path = tmp_path / "accuracy.tif"
    write_accuracy(Budget(heights=1.0), sight, dem, (128, 128), path, heights=(height.min(), height.max()), step=1)
    found = gdal.Open(str(path)).ReadAsArray()[:2, 77, 41]
    np.testing.assert_allclose(found, np.sqrt(by_map[0, :2]), rtol=2e-3, atol=1e-4)


def test_the_error_of_steep_ground_has_limits():
    """A ray that grazes the ground has no infinite one, and a wall that faces the sensor has half of it."""
    sight = Sight(Parallel(0.5, 0.0, 2.0, 256.0), City(()).grid())
    place = [np.array([value]) for value in (200.0, 300.0, FLOOR)]
    level, *steep = (
        parts_at(Budget(heights=1.0), sight, *place, slopes=np.array([[slope, 0.1]])).heights[0, 0]
        for slope in (0.0, 1.6, 2.0, 30.0, -2.0, -30.0)
    )
    np.testing.assert_allclose(np.array(steep) / level, [25.0, 25.0, 25.0, 0.25, 0.25], rtol=1e-5)


def test_the_same_error_everywhere_is_that_of_the_scene(tmp_path):
    sight = Sight(Parallel(0.3, -0.4, 2.0, 256.0), City(()).grid(2.0))
    budget = Budget(heights=4.0, datum=3.0, reference=0.5, interpolation_px=0.6)
    made = write_accuracy(
        budget, sight, City(()).surface(tmp_path / "dem.tif"), (128, 128), tmp_path / "accuracy.tif",
        heights=(FLOOR, FLOOR), step=1,
    )  # fmt: skip
    east, north, cross = 2.25 + 0.25 + 0.48, 4.0 + 0.25 + 0.48, -3.0
    np.testing.assert_allclose(made.sigma, np.sqrt([east, north]), rtol=1e-3)
    wanted = {"model": 0.0, "heights": 6.25, "even": 0.5, "interpolation": 0.96}
    assert made.shares == pytest.approx({name: part / 7.71 for name, part in wanted.items()}, rel=1e-3)
    drawn = np.random.default_rng(2).multivariate_normal([0, 0], [[east, cross], [cross, north]], 400_000)
    assert made.ce90 == pytest.approx(np.quantile(np.hypot(*drawn.T), 0.9), rel=0.005)
    assert made.quantiles == pytest.approx((made.ce90,) * 3, rel=1e-3)
    np.testing.assert_allclose(made.cells, made.ce90, rtol=1e-3)
    assert made.known == 1.0


def test_quantiles_and_cells_are_those_of_the_pixels(tmp_path):
    """Standard deviations of heights rise from 5 to 15 m, rays lean east: errors lie along a line, evenly large."""
    side, count = 600.0, 700
    rise = 5 + 10 * (np.arange(count) + 0.5 - 50) / side
    write_dem(tmp_path / "sigma.tif", np.tile(rise, (count, 1)), (WEST - 50, NORTH + 50), 1.0, "EPSG:32636")
    write_dem(tmp_path / "dem.tif", np.full((count, count), FLOOR), (WEST - 50, NORTH + 50), 1.0, "EPSG:32636")
    sigma, surface = (open_dem(tmp_path / name, "ellipsoid") for name in ("sigma.tif", "dem.tif"))
    sight = Sight(Parallel(0.5, 0.0, 1.0, side), City((), side=side).grid(1.0))
    path = tmp_path / "accuracy.tif"
    made = write_accuracy(
        Budget(heights=sigma, datum=3.0), sight, surface, (600, 600), path, heights=(FLOOR, FLOOR), step=1
    )

    def wanted(share):
        return stats.norm.ppf(0.95) * 0.5 * np.hypot(5 + 10 * np.asarray(share), 3.0)

    np.testing.assert_allclose(made.quantiles, wanted((0.05, 0.5, 0.95)), rtol=5e-3)
    assert made.cells.shape == (32, 32)
    middles = (made.cell * np.arange(31) + made.cell / 2) / side
    np.testing.assert_allclose(made.cells[:, :31], np.tile(wanted(middles), (32, 1)), rtol=2e-3)
    assert made.sigma[1] == pytest.approx(0.0, abs=1e-3)


def test_what_nobody_states_is_no_error():
    sight = Sight(Parallel(0.3, -0.4, 2.0, 256.0), City(()).grid())
    parts = parts_at(Budget(heights=4.0), sight, *(np.array([value]) for value in (200.0, 300.0, FLOOR)))
    np.testing.assert_allclose(parts.total, [np.array([1.44, 2.56, -1.92]) * TRUE**2], rtol=1e-4)


@pytest.mark.parametrize(
    ("side", "origin", "slope", "spacing"),
    # In the last case a node that is one pixel off is too far off.
    [
        (640.0, 320.0, 0.002, 64),
        (640.0, 320.0, 0.01, 16),
        (640.0, 320.0, 0.15, 4),
        (64.0, 32.0, 2.0, 1),
        (100.0, 0.0, 0.03, 4),
    ],
)
def test_nodes_are_as_far_apart_as_half_a_per_cent_of_the_largest_sigma_allows(tmp_path, side, origin, slope, spacing):
    """At x px from the origin, 1 px and a slope have a variance of 1 + (slope x)^2 in either axis: lines in between."""
    x = np.linspace(0, side, 5000, endpoint=False) - origin

    def error(apart):
        nodes = np.arange(0.5 - apart, side + apart, apart) - origin
        return np.abs(np.sqrt(np.interp(x, nodes, 1 + (slope * nodes) ** 2)) - np.sqrt(1 + (slope * x) ** 2)).max()

    limit = 0.005 * np.hypot(1.0, slope * max(origin, side - origin))
    good = [apart for apart in (64, 16, 4) if error(apart) < limit]
    assert max(good, default=1) == spacing
    assert all(error(apart) > 1.5 * limit for apart in (64, 16, 4) if apart > spacing)
    model = ImageCorrection.identity(Parallel(0.0, 0.0, 1.0, side), "affine", (origin, origin))
    covariance = np.diag([1.0, slope**2, 1e-12, 1.0, 1e-12, slope**2])
    city = City((), side=side)
    layer = accuracy._Layer(
        Budget(covariance=covariance), Sight(model, city.grid(1.0)), city.surface(tmp_path / "dem.tif"),
        (int(side), int(side)), (FLOOR, FLOOR), 1 << 28,
    )  # fmt: skip
    assert layer.spacing == spacing


def test_what_a_vendor_states_counts_only_of_a_model_that_was_not_adjusted():
    assert Budget(stated=3.0, reference=4.0).even == 25.0
    assert Budget(covariance=np.eye(2), stated=3.0, reference=4.0).even == 16.0
    assert Budget(heights=5.0, datum=1.0).even == 0.0
    assert [one.knows_model for one in (Budget(), Budget(heights=5.0), Budget(stated=3.0), Budget(np.eye(2)))] == [
        False, False, True, True,
    ]  # fmt: skip
