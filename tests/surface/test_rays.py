"""Many rays at once, by way of the lattice, against the same rays followed one by one with the exact model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.models import RPC, FrameCamera
from ortho_pipeline.models.frame.camera import MAP
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.surface import rays
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.rays import MANY, meet_surface
from ortho_pipeline.surface.writing import write_dem


@pytest.fixture(scope="module")
def model() -> RPC:
    """Three metres a pixel, 35 degrees off nadir."""
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[[1, 3, 7]], row[[2, 3, 8]] = (1.0, 0.25, 2e-4), (-1.0, 0.08, 1e-4)
    return RPC(300.0, 300.0, 20.0, -30.0, 500.0, 300.0, 300.0, 0.01, 0.0085, 300.0, col, one, row, one)


def rough(x, y):
    ridge = 150 * np.exp(-(((x - x.mean()) / 120) ** 2))
    return 450 + 40 * np.sin(x / 170) * np.cos(y / 230) + ridge + np.random.default_rng(0).normal(0, 2, x.shape)


@pytest.fixture
def surface(tmp_path: Path, model) -> Surface:
    path, step, count = tmp_path / "dem.tif", 30.0, 130
    east, north = pyproj.Transformer.from_crs(4326, 32734, always_xy=True).transform(model.lon_off, model.lat_off)
    left, top = east - count / 2 * step, north + count / 2 * step
    x, y = np.meshgrid(left + step * (np.arange(count) + 0.5), top - step * (np.arange(count) + 0.5))
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), count, count, 1, gdal.GDT_Float64)
    dataset.SetProjection(pyproj.CRS.from_epsg(32734).to_wkt())
    dataset.SetGeoTransform((left, step, 0, top, 0, -step))
    dataset.WriteArray(rough(x, y))
    dataset = None
    return open_dem(path, "ellipsoid", fill="mask")


def image_points(count: int = MANY) -> np.ndarray:
    image = np.random.default_rng(1).uniform(20, 580, (count, 2))
    image[::500] = np.nan
    image[1::500] += 5000.0  # far off the DEM
    return image


def test_many_rays_are_the_rays_one_by_one(model, surface, monkeypatch):
    # Without the points far away the lattice is dense enough for these few points.
    image = image_points()
    image[1::500] = np.nan
    used = []
    original = rays._march_many
    monkeypatch.setattr(rays, "_march_many", lambda *given: used.append(original(*given)) or used[-1])
    many = meet_surface(model, image, surface)
    assert used[0] is not None
    few = np.concatenate([meet_surface(model, part, surface) for part in np.array_split(image, 4)])
    np.testing.assert_array_equal(np.isnan(many), np.isnan(few))
    good = np.isfinite(many[:, 0])
    assert good.mean() > 0.99
    # Both stop within 1 mm of the terrain: where a ray comes down to it by so many metres per metre, that is a height
    # difference of so much more.
    lower = model.image_to_ground(image[good], many[good, 2] - 0.05)
    approach = np.abs(surface.above(lower, model.crs) - surface.above(many[good], model.crs)) / 0.05
    assert (np.abs(many - few)[good, 2] * approach).max() < 2e-3
    assert np.median(approach) > 0.5
    # The answer lies on the ray and on the terrain.
    assert np.abs(model.ground_to_image(many[good]) - image[good]).max() < 1e-6
    assert np.abs(surface.heights(many[good, :2], model.crs) - many[good, 2]).max() < 0.01


def test_points_far_apart_fall_back_to_the_exact_way(model, surface):
    image = image_points()
    ground = meet_surface(model, image, surface)
    assert np.isnan(ground[::500]).all()
    assert np.isnan(ground[1::500]).all()
    assert np.isfinite(ground[2::500]).all()


def test_the_surface_may_be_in_any_crs(tmp_path, model, surface):
    """The same terrain in geographic coordinates: a plane, which both CRSs hold exactly enough."""
    path = tmp_path / "plane.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 100, 100, 1, gdal.GDT_Float64)
    dataset.SetProjection(pyproj.CRS.from_epsg(4326).to_wkt())
    dataset.SetGeoTransform((19.98, 0.0004, 0, -29.98, 0, -0.0004))
    dataset.WriteArray(np.full((100, 100), 512.5))
    dataset = None
    image = np.random.default_rng(2).uniform(100, 500, (MANY, 2))
    ground = meet_surface(model, image, open_dem(path, "ellipsoid"))
    np.testing.assert_allclose(ground, model.image_to_ground(image, 512.5), atol=2e-8)


@pytest.mark.parametrize("fill", ["nearest", 444.0])
def test_a_fill_rule_goes_on_beyond_the_dem_for_many_points_too(model, surface, fill):
    """Half of the points look past the DEM, which covers half of the image."""
    path = str(Path(surface.provenance["path"]).with_name("half.tif"))
    gdal.Translate(path, surface.provenance["path"], srcWin=[0, 0, 65, 130])
    half = open_dem(path, "ellipsoid", fill=fill)
    image = np.random.default_rng(3).uniform(20, 580, (MANY, 2))
    ground = meet_surface(model, image, half)
    # The compiled inverse of many points and the one of few agree to rounding.
    np.testing.assert_allclose(ground[:2000], meet_surface(model, image[:2000], half), atol=1e-9)
    assert np.isfinite(ground).all()


def test_few_rays_are_parabolas_of_three_exact_positions(model, surface, monkeypatch):
    """Every step along a ray asked the model: 26 times for a scene, now three times, and once for the answer."""
    image = np.random.default_rng(4).uniform(20, 580, (1350, 2))
    asked = []
    original = RPC.image_to_ground
    monkeypatch.setattr(RPC, "image_to_ground", lambda self, at, h: asked.append(len(at)) or original(self, at, h))
    ground = meet_surface(model, image, surface)
    frames = 4 * 81  # those of the window
    assert sum(asked) <= 4 * len(image) + frames
    np.testing.assert_allclose(model.ground_to_image(ground), image, atol=1e-5)
    assert np.abs(surface.above(ground, model.crs)).max() <= 1e-3


def test_rays_that_are_no_parabolas_are_followed_by_the_exact_model(model, surface, monkeypatch):
    """A model that swings along its rays, far within the range of heights: nothing of it is in three positions."""
    original = RPC.image_to_ground

    def swinging(self, image, height):
        ground = original(self, image, height)
        ground[:, 0] += 0.001 * np.sin(np.asarray(height) / 15.0)
        return ground

    monkeypatch.setattr(RPC, "image_to_ground", swinging)
    image = np.random.default_rng(5).uniform(100, 500, (200, 2))
    ground = meet_surface(model, image, surface)
    assert np.isfinite(ground).all()
    np.testing.assert_allclose(ground, swinging(model, image, ground[:, 2]), atol=1e-9)
    assert np.abs(surface.above(ground, model.crs)).max() <= 1e-3


def test_a_ray_does_not_depend_on_those_that_come_with_it_where_the_model_does_not_reach_the_top(
    model, surface, monkeypatch
):
    """They were followed apart from the others, one step long, and a DEM that covers a scene was said not to."""
    image = np.random.default_rng(2).uniform(20, 580, (60, 2))
    expected = meet_surface(model, image, surface)
    original = RPC.image_to_ground

    def ends(self, image, height):
        ground = original(self, image, height)
        ground[(np.asarray(image)[:, 0] > 200) & (np.broadcast_to(height, len(ground)) > 590)] = np.nan
        return ground

    monkeypatch.setattr(RPC, "image_to_ground", ends)
    there = expected[:, 2] < 580
    assert there.sum() > 40
    np.testing.assert_allclose(meet_surface(model, image, surface)[there], expected[there], atol=2e-3)
    # One ray that reaches the top shows where terrain may be met.
    pairs = [meet_surface(model, np.stack([point, [30.0, 30.0]]), surface)[0] for point in image[there]]
    np.testing.assert_allclose(pairs, expected[there], atol=2e-3)


@pytest.mark.parametrize("count", [3, 5, 7])
def test_polynomials_in_height_go_through_their_values(count):
    values = np.random.default_rng(count).normal(size=(2, 3, count, 2))
    powers = np.vander(rays.levels(count), increasing=True)
    np.testing.assert_allclose(np.einsum("lk,...ka->...la", powers, rays.polynomials(values)), values, atol=1e-13)
    assert rays.levels(count)[[0, -1]].tolist() == [-1.0, 1.0]


@pytest.mark.parametrize("many", [1, MANY])
def test_terrain_above_the_heights_of_a_model_is_met_step_by_step(tmp_path: Path, many: int) -> None:
    """A model of 0 to 100 m that looks down at 45 degrees, and terraces of 50, 300 and 600 m towards the camera.

    Where its rays are 100 m high they are over the second terrace; at 300 m over the third, which they meet.
    """
    interior, x, y = Interior(1000, 1000, 0.01, 1e-6, 1e-6), 300_000.0, 2_700_000.0
    exterior = [x, y, 5000.0, np.pi / 4, 0.0, 0.0]
    model = FrameCamera.from_map(interior, "EPSG:32651", exterior, frame=MAP, heights=(0.0, 100.0))
    foot, above = model.image_to_ground([[500.0, 500.0]] * 2, [0.0, 600.0])
    towards = np.sign(above[1] - foot[1])
    assert above[1] - foot[1] == pytest.approx(600 * towards, rel=1e-3)
    rows = np.indices((300, 60))[0] * 10.0 + 5.0
    along = towards * (1500.0 - rows)
    heights = np.select([along < 80, along < 250], [50.0, 300.0], 600.0)
    write_dem(tmp_path / "dem.tif", heights, (foot[0] - 300.0, foot[1] + 1500.0), 10.0, "EPSG:32651")
    image = np.full((many, 2), 500.0) + np.linspace(-3, 3, many)[:, None] * [1.0, 0.0]
    found = meet_surface(model, image, open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"))
    np.testing.assert_allclose(found, model.image_to_ground(image, 600.0), atol=2e-3)
