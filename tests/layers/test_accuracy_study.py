"""Predicted accuracy compared with the truth of simulated scenes (benchmarks/accuracy.py in small), and real points."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from erring import Field, Truth, follow, pooled, scene_of, trial
from orthos import rectify
from osgeo import gdal

from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.host import open_scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import read_points
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem
from ortho_pipeline.warp.quality.accuracy import Budget, parts_at, predictive
from ortho_pipeline.warp.quality.sight import Sight


def test_errors_are_as_large_as_predicted():
    """Of 30 scenes with independent DEM errors a spread is known to about 10 % (docs/engineering/accuracy.md: 1000)."""
    seeds = {"ikonos": 12, "orbview3": 8, "bilsat": 8, "cartosat": 2}
    found = pooled([trial(sensor, seed) for sensor, count in seeds.items() for seed in range(count)])
    assert 0.85 <= found["east"] <= 1.15
    assert 0.85 <= found["north"] <= 1.15
    assert 0.86 <= found["within"] <= 0.94


def test_a_warped_ortho_errs_as_its_pixels_do(tmp_path):
    """The pixels of a warped ramp are the image points that they were taken from: what the study follows."""
    truth = scene_of("bilsat", 5, 16, bent=False)
    made = fit(ImageCorrection.identity(truth.rpc, "shift", (truth.size[0] / 2, truth.size[1] / 2)), truth.points)
    to_map = pyproj.Transformer.from_crs(4326, truth.zone, always_xy=True)
    random = np.random.default_rng(3)
    errors = Field.draw(random, 20.0, 4000.0)
    middle = np.array(truth.size) / 2
    corner = np.stack(to_map.transform(*truth.meet(middle[None])[:, :2].T), axis=1)[0]
    grid = Grid.of_extent(pyproj.CRS.from_epsg(truth.zone), (*(corner - 6000), *(corner + 6000)), (40.0, 40.0))
    dem = _dem(tmp_path / "dem.tif", truth, to_map, corner, errors)
    ramp = _ramp(tmp_path / "ramp.tif", truth.size)
    rectify(made.model, RasterSource(ramp), dem, grid, tmp_path / "ortho.tif", driver="GTiff")
    ortho = gdal.Open(str(tmp_path / "ortho.tif")).ReadAsArray().astype(float)
    rows, columns = random.integers(0, grid.height, 200), random.integers(0, grid.width, 200)
    image = ortho[:2, rows, columns].T
    x, y = grid.xy(columns + 0.5, rows + 0.5)
    heights = dem.heights(np.stack([x, y], axis=1), grid.crs)
    sight = Sight(made.model, grid)
    np.testing.assert_allclose(image, sight.image(columns + 0.5, rows + 0.5, heights), atol=0.02)
    shown = truth.meet(image)
    there = np.stack(to_map.transform(*shown[:, :2].T), axis=1) - np.stack([x, y], axis=1)
    # Between posts of 100 m the DEM's error is not quite the field's: that is a part of a pixel.
    followed = follow(truth, made, 20.0, errors, image)
    np.testing.assert_allclose(np.hypot(*there.T).mean(), np.hypot(*followed.errors.T).mean(), rtol=0.05)


def _dem(path, truth: Truth, to_map, corner, errors) -> Surface:
    step, count = 100.0, 180
    west, north = corner[0] - count * step / 2, corner[1] + count * step / 2
    x, y = np.meshgrid(west + step * (np.arange(count) + 0.5), north - step * (np.arange(count) + 0.5))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    heights = truth.terrain(*to_map.transform(*xy.T, direction="INVERSE")) + errors(xy)
    write_dem(path, heights.reshape(count, count), (west, north), step, f"EPSG:{truth.zone}")
    return open_dem(path, "ellipsoid")


def _ramp(path, size):
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    made = gdal.GetDriverByName("GTiff").Create(str(path), *size, 2, gdal.GDT_Float32)
    made.WriteArray(np.stack([columns, rows]).astype(np.float32))
    return path


@pytest.mark.realdata
def test_points_left_out_of_a_real_scene_are_off_by_what_the_layer_says(real):
    """QuickBird crop, 5 points: left-out residuals on the ground are the layer's errors and those of measuring."""
    folder = real / "orthority" / "rpc"
    image = next(folder.glob("*.tif"))
    scene = open_scene(image)
    points = read_points(next(folder.glob("*gcp*.geojson")))
    start = ImageCorrection.identity(scene.model, "shift", (scene.width / 2, scene.height / 2))
    made = fit(start, points)
    normalised = []
    crs = pyproj.CRS.from_epsg(32635)
    for k in range(len(made.points)):
        rest = fit(start, points.select(np.arange(len(points)) != k), robust=False)
        ground = ground_transform(made.points.crs, crs)(made.points.ground[k : k + 1])[0]
        grid = Grid(crs, ground[0] - 10.0, ground[1] + 10.0, 1.0, 1.0, 20, 20)
        sight, at = Sight(rest.model, grid), (np.array([10.0]), np.array([10.0]), ground[2:])
        covariance = predictive(rest.covariance, rest.degrees_of_freedom)
        parts = parts_at(Budget(covariance=covariance), sight, *at).total[0]
        seen = sight.seen(*at)
        per_pixel = sight.metres(*at)[0] @ seen.place_per_pixel[0]
        off = per_pixel @ (points.image[k] - seen.image[0])
        measured = per_pixel * float(np.sqrt((rest.residuals[rest.used] ** 2).mean()))
        normalised.append(off / np.sqrt(parts[:2] + np.diag(measured @ measured.T)))
    spread = np.sqrt((np.array(normalised) ** 2).mean())
    # Ten numbers, eight of them free: their spread is within this with 95 %.
    assert 0.5 <= spread <= 1.6
