"""The warp against GDAL's own warper and transformer, on ramps whose pixels are their own coordinates, and its traps.

Ramps: a Float32 source with two bands that hold column and row of their own pixel. Warped bilinearly they give, in
every output pixel, the image coordinates that the warp used, to be compared with GDAL's exact RPC transformer at
heights that scipy interpolates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import pytest
from blocks import FLOOR, WEST, Parallel
from blocks import NORTH as TOP
from orthos import rectify, rectify_gdal
from osgeo import gdal, gdal_array
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import minimum_filter

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import export_rpc, rpc_metadata
from ortho_pipeline.files import sha256
from ortho_pipeline.models import RPC, SensorModel
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.warp import lattice_engine as warp
from ortho_pipeline.warp import resampling_kernel

UTM = pyproj.CRS.from_epsg(32735)
WIDTH, HEIGHT, GSD = 700, 620, 0.5
CENTRE = (24.4, -33.65)
EAST, NORTH = pyproj.Transformer.from_crs(4326, UTM, always_xy=True).transform(*CENTRE)


def make_rpc(tilt: float = 0.36, gsd: float = GSD) -> RPC:
    """An RPC of `gsd` metres; `tilt` is the tangent of the angle off nadir (1 is 45 degrees)."""
    random = np.random.default_rng(2)
    cubic = random.normal(0, 3e-6, (4, 10))
    half = np.array([WIDTH, HEIGHT]) / 2
    parallax = tilt * 500.0 / gsd / half  # normalised, for 500 m of height
    return RPC(
        *half, *CENTRE, 700.0, *half, half[0] * gsd / 92_800, half[1] * gsd / 110_900, 500.0,
        [1e-3, 1.0, 0.03, 0.9 * parallax[0], 1e-3, 4e-4, -3e-4, -6e-4, -5e-4, 8e-5, *cubic[0]],
        [1.0, -1.7e-3, -2e-3, 3e-4, *[0.0] * 6, *cubic[1] / 10],
        [-2e-3, 0.02, -1.0, 0.4 * parallax[1], -1.5e-3, 2e-5, 3e-4, 4e-4, 3e-4, -3e-5, *cubic[2]],
        [1.0, -1.4e-3, -1.1e-3, -5e-4, *[0.0] * 6, *cubic[3] / 10],
    )  # fmt: skip


def rough(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 3, x.shape)
    return 700 + 30 * np.sin(x / 60) * np.cos(y / 45) + 8 * np.sin(x / 13 + y / 17) + noise


def cliffs(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Steps of 100 m within three samples of 10 m, in both directions."""
    return 650 + 100 * np.clip((x - EAST + 60) / 30, 0, 1) + 100 * np.clip((y - NORTH - 20) / 30, 0, 1)


@dataclass
class Scene:
    folder: Path
    model: RPC
    heights: Callable[[np.ndarray, np.ndarray], np.ndarray] = rough

    def write(self, pixels: np.ndarray, name: str = "source.tif", nodata=None, mask=None, options=()) -> Path:
        """Write pixels (bands, rows, columns) with the RPC in the tag."""
        path = self.folder / name
        bands, rows, columns = pixels.shape
        kind = gdal_array.NumericTypeCodeToGDALTypeCode(pixels.dtype.type)
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, bands, kind, list(options))
        dataset.SetMetadata(rpc_metadata(self.model), "RPC")
        for i in range(bands):
            dataset.GetRasterBand(i + 1).WriteArray(pixels[i])
            if nodata is not None:
                dataset.GetRasterBand(i + 1).SetNoDataValue(nodata)
        if mask is not None:
            gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", "YES")
            dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
            dataset.GetRasterBand(1).GetMaskBand().WriteArray(mask)
            gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", None)
        dataset = None
        return path

    def dem(self, step: float = 10.0, count: int = 80, crs: pyproj.CRS = UTM) -> Path:
        path = self.folder / "dem.tif"
        if crs.is_geographic:
            step_x, step_y, (x0, y0) = step / 92_800, step / 110_900, CENTRE
        else:
            step_x, step_y, (x0, y0) = step, step, (EAST, NORTH)
        left, top = x0 - count / 2 * step_x, y0 + count / 2 * step_y
        x, y = np.meshgrid(left + step_x * (np.arange(count) + 0.5), top - step_y * (np.arange(count) + 0.5))
        if crs.is_geographic:
            x, y = pyproj.Transformer.from_crs(crs, UTM, always_xy=True).transform(x, y)
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), count, count, 1, gdal.GDT_Float64)
        dataset.SetProjection(crs.to_wkt())
        dataset.SetGeoTransform((left, step_x, 0, top, 0, -step_y))
        dataset.WriteArray(self.heights(x, y))
        dataset = None
        return path

    def surface(self, **options) -> Surface:
        return open_dem(self.dem(**options), "ellipsoid")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path, make_rpc())


def grid_of(size: float = 380.0, step: float = GSD, crs: pyproj.CRS = UTM, shift: float = 0.0) -> Grid:
    # An origin off the lattice of anything else.
    left, top = EAST - size / 2 + 0.13 + shift, NORTH + size / 2 + 0.21
    return Grid.of_extent(crs, (left, top - size, left + size, top), (step, step))


def ramps() -> np.ndarray:
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32) + np.float32(0.5)
    return np.stack([columns, rows])


def texture(dtype=np.uint16, seed: int = 4, bands: int = 1) -> np.ndarray:
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    noise = np.random.default_rng(seed).normal(0, 10, (bands, HEIGHT, WIDTH))
    return (120 + 60 * np.sin(columns / 5) * np.cos(rows / 7) + noise).astype(dtype)


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    dataset = gdal.Open(str(path))
    pixels = dataset.ReadAsArray().reshape(dataset.RasterCount, dataset.RasterYSize, dataset.RasterXSize)
    return pixels, dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0


def exact_image(model: RPC, dem: Path, grid: Grid) -> np.ndarray:
    """Image coordinates (2, rows, columns) of all output pixels by GDAL's transformer, at heights from scipy."""
    columns, rows = np.meshgrid(np.arange(grid.width) + 0.5, np.arange(grid.height) + 0.5)
    x, y = grid.xy(columns.ravel(), rows.ravel())
    dataset = gdal.Open(str(dem))
    left, dx, _, top, _, dy = dataset.GetGeoTransform()
    heights = dataset.ReadAsArray()
    lines = top + dy * (np.arange(heights.shape[0]) + 0.5)
    samples = left + dx * (np.arange(heights.shape[1]) + 0.5)
    dem_crs = pyproj.CRS.from_wkt(dataset.GetProjection())
    u, v = pyproj.Transformer.from_crs(grid.crs, dem_crs, always_xy=True).transform(x, y)
    h = RegularGridInterpolator((lines[::-1], samples), heights[::-1])(np.stack([v, u], axis=1))
    lon, lat = pyproj.Transformer.from_crs(grid.crs, 4326, always_xy=True).transform(x, y)
    memory = gdal.GetDriverByName("MEM").Create("", WIDTH, HEIGHT)
    memory.SetMetadata(rpc_metadata(model), "RPC")
    # As rasters: half a million points as tuples of Python take forty times as long.
    found = [gdal_array.OpenArray(values.reshape(grid.height, grid.width)) for values in (lon, lat, h)]
    bands = [one.GetRasterBand(1) for one in found]
    assert gdal.Transformer(None, memory, ["DST_METHOD=RPC"]).TransformGeolocations(*bands) == 0
    return np.stack([one.ReadAsArray() for one in found[:2]])


def inner(image: np.ndarray, margin: float = 3.0) -> np.ndarray:
    return (image[0] > margin) & (image[0] < WIDTH - margin) & (image[1] > margin) & (image[1] < HEIGHT - margin)


# -- geometry --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [0.36, 1.0], ids=["20 degrees", "45 degrees"])
@pytest.mark.parametrize("heights", [rough, cliffs])
@pytest.mark.parametrize("dem_crs", [UTM, pyproj.CRS.from_epsg(4326)], ids=["utm", "geographic"])
def test_every_pixel_is_within_the_tolerance(tmp_path, tilt, heights, dem_crs):
    scene = Scene(tmp_path, make_rpc(tilt), heights)
    surface, grid = scene.surface(crs=dem_crs), grid_of()
    result = rectify(
        scene.model, RasterSource(scene.write(ramps())), surface, grid, tmp_path / "ortho.tif", driver="GTiff"
    )
    found, _ = read(tmp_path / "ortho.tif")
    exact = exact_image(scene.model, tmp_path / "dem.tif", grid)
    use = inner(exact)
    assert use.sum() > 100_000
    # Float32 ramps hold 700 to 3e-5 px, which is far below the tolerance of 0.01 px.
    assert np.abs(found - exact)[:, use].max() < 0.01
    assert result.max_error_px < 0.005


@pytest.mark.parametrize("kernel", ["nearest", "bilinear", "cubic", "lanczos"])
def test_values_are_those_of_exact_gdalwarp(scene, tmp_path, kernel):
    source, surface, grid = RasterSource(scene.write(texture())), scene.surface(), grid_of()
    rectify(scene.model, source, surface, grid, tmp_path / "ours.tif", resampling=kernel, driver="GTiff")
    rectify_gdal(
        scene.model,
        export_rpc(scene.model),
        source,
        surface,
        grid,
        tmp_path / "gdal.tif",
        resampling=kernel,
        driver="GTiff",
    )
    (ours, valid), (theirs, their_valid) = read(tmp_path / "ours.tif"), read(tmp_path / "gdal.tif")
    use = inner(exact_image(scene.model, tmp_path / "dem.tif", grid), 4) & valid & their_valid
    difference = np.abs(ours.astype(int) - theirs)[0][use]
    assert use.sum() > 100_000
    # Nearest takes the neighbour where a point falls within the lattice's 0.001 px of an edge: 2 x 2 x 0.001 of them.
    assert (difference <= 1).mean() >= (0.996 if kernel == "nearest" else 0.999)
    assert (valid == their_valid).mean() > 0.9999


@pytest.mark.parametrize("nodata", [None, 0])
def test_lanczos_is_that_of_gdalwarp_at_edges_and_beside_nodata(scene, tmp_path, nodata):
    pixels = (texture() * 20).astype(np.uint16)
    if nodata is not None:
        pixels[:, np.random.default_rng(0).uniform(size=pixels.shape[1:]) < 0.02] = nodata
        pixels[:, 250:280, 300:420] = nodata
    source, surface, grid = RasterSource(scene.write(pixels, nodata=nodata)), scene.surface(), grid_of()
    rectify(scene.model, source, surface, grid, tmp_path / "ours.tif", resampling="lanczos", driver="GTiff")
    rectify_gdal(
        scene.model,
        export_rpc(scene.model),
        source,
        surface,
        grid,
        tmp_path / "gdal.tif",
        resampling="lanczos",
        driver="GTiff",
    )
    (ours, valid), (theirs, their_valid) = read(tmp_path / "ours.tif"), read(tmp_path / "gdal.tif")
    difference = np.abs(ours.astype(int) - theirs)[0][valid & their_valid]
    assert (valid == their_valid).mean() > 0.9995
    # The lattice moves points by up to 0.001 px, worth 1 DN or 2 where neighbours differ by thousands.
    assert np.quantile(difference, 0.999) <= 2
    assert (difference <= 20).mean() > 0.99999


def test_gdalwarp_on_the_command_line_agrees(scene, tmp_path):
    """As a user would: gdalwarp -rpc with the ellipsoidal DEM, exact transformer, whole-image kernel."""
    path, surface, grid = scene.write(texture()), scene.surface(), grid_of()
    rectify(scene.model, RasterSource(path), surface, grid, tmp_path / "ours.tif", resampling="cubic", driver="GTiff")
    gdal.Warp(
        str(tmp_path / "gdal.tif"), str(path), rpc=True, outputBounds=grid.extent, xRes=GSD, yRes=GSD,
        dstSRS="EPSG:32735", transformerOptions=["METHOD=RPC", f"RPC_DEM={tmp_path / 'dem.tif'}"],
        errorThreshold=0, resampleAlg="cubic",
        warpOptions=["XSCALE=1", "YSCALE=1"],
    )  # fmt: skip
    (ours, valid), (theirs, _) = read(tmp_path / "ours.tif"), read(tmp_path / "gdal.tif")
    use = inner(exact_image(scene.model, tmp_path / "dem.tif", grid)) & valid
    assert (np.abs(ours.astype(int) - theirs)[0][use] <= 1).mean() >= 0.999


@pytest.mark.parametrize("kernel", ["nearest", "bilinear", "cubic", "lanczos", "average"])
def test_one_bright_pixel_lands_on_its_ground_point(scene, tmp_path, kernel):
    pixels = np.zeros((1, HEIGHT, WIDTH), np.float32)
    pixels[0, 300, 350] = 1000.0
    surface = FlatSurface(700.0)
    ground = scene.model.image_to_ground([[350.5, 300.5]], 700.0)
    east, north = pyproj.Transformer.from_crs(4326, UTM, always_xy=True).transform(*ground[0, :2])
    fine = 0.05  # ten output pixels to one of the source show the kernel's centre
    grid = Grid.of_extent(UTM, (east - 4, north - 4, east + 4, north + 4), (fine, fine))
    rectify(
        scene.model, RasterSource(scene.write(pixels)), surface, grid, tmp_path / "o.tif", resampling=kernel,
        driver="GTiff",
    )  # fmt: skip
    spot = read(tmp_path / "o.tif")[0][0].astype(float)
    rows, columns = np.mgrid[0 : grid.height, 0 : grid.width] + 0.5
    x, y = grid.xy((spot * columns).sum() / spot.sum(), (spot * rows).sum() / spot.sum())
    assert np.hypot(x - east, y - north) < 0.05 * GSD


def test_a_rendered_ground_pattern_comes_back(tmp_path):
    """Closed loop: render a pattern of the ground through the model, orthorectify, compare with the pattern."""
    scene, level = Scene(tmp_path, make_rpc()), 700.0
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    ground = scene.model.image_to_ground(np.stack([columns.ravel(), rows.ravel()], 1), level)
    x, y = pyproj.Transformer.from_crs(4326, UTM, always_xy=True).transform(ground[:, 0], ground[:, 1])

    def pattern(x, y):
        return 1000 + 100 * np.sin((x - EAST) / 6) + 100 * np.cos((y - NORTH) / 5)

    pixels = pattern(x, y).reshape(1, HEIGHT, WIDTH).astype(np.float32)
    grid = grid_of(240.0)
    rectify(
        scene.model, RasterSource(scene.write(pixels)), FlatSurface(level), grid, tmp_path / "o.tif",
        resampling="cubic", driver="GTiff",
    )  # fmt: skip
    found, valid = read(tmp_path / "o.tif")
    out_rows, out_columns = np.mgrid[0 : grid.height, 0 : grid.width] + 0.5
    expected = pattern(*grid.xy(out_columns, out_rows))
    # A slope of 100 / 6 per metre makes 0.05 px (0.025 m) worth 0.42.
    assert np.abs(found[0] - expected)[valid].max() < 0.42
    assert valid.mean() > 0.9


# -- the lattice -----------------------------------------------------------------------------------------------------


class Bent(SensorModel):
    """A plugin's model in plain NumPy, with ripples that a coarse lattice cannot follow."""

    kind = "test_bent"

    def __init__(self, ripple: float = 0.3, length: float = 40.0) -> None:
        object.__setattr__(self, "ripple", ripple)
        object.__setattr__(self, "length", length)

    @property
    def crs(self) -> str:
        return "EPSG:32735"

    @property
    def domain(self):
        return np.array([EAST, NORTH, 700.0]), np.array([200.0, 200.0, 500.0])

    def ground_to_image(self, ground):
        x, y, h = np.asarray(ground, float).T
        col = WIDTH / 2 + (x - EAST) / GSD + self.ripple * np.sin((y - NORTH) / self.length) + 0.1 * (h - 700)
        row = HEIGHT / 2 - (y - NORTH) / GSD + self.ripple * np.cos((x - EAST) / self.length)
        return np.stack([col, row], axis=1)


def test_lattice_is_refined_until_it_holds_the_tolerance(scene, tmp_path):
    model, grid = Bent(), grid_of(200.0)
    result = rectify(
        model, RasterSource(scene.write(ramps())), FlatSurface(700.0), grid, tmp_path / "o.tif", driver="GTiff"
    )
    rows, columns = np.mgrid[0 : grid.height, 0 : grid.width] + 0.5
    x, y = grid.xy(columns.ravel(), rows.ravel())
    exact = model.ground_to_image(np.stack([x, y, np.full(x.size, 700.0)], 1)).T.reshape(2, grid.height, grid.width)
    assert np.abs(read(tmp_path / "o.tif")[0] - exact)[:, inner(exact)].max() < 0.01
    assert result.finest_spacing < 64
    assert result.refined_blocks > 0


def test_a_scene_smaller_than_a_lattice_cell_is_found(scene, tmp_path):
    """An overview of 10 m pixels in a wide grid: the scene lies between nodes that the model cannot project."""
    source, wide = RasterSource(scene.write(np.full((1, HEIGHT, WIDTH), 5, np.uint8))), 10.0
    grid = Grid.of_extent(UTM, (EAST - 3000, NORTH - 2500, EAST + 2600, NORTH + 2100), (wide, wide))
    result = rectify(scene.model, source, FlatSurface(700.0), grid, tmp_path / "o.tif", driver="GTiff")
    # 700 x 620 pixels of half a metre, to half an output pixel all around.
    expected = WIDTH * HEIGHT * GSD**2 / wide**2
    assert result.valid_pixels == pytest.approx(expected, rel=0.06)


class Shaken(Bent):
    """A model that no polynomial in height follows."""

    kind = "test_shaken"

    def ground_to_image(self, ground):
        return super().ground_to_image(ground) + 5.0 * np.sin(50.0 * np.asarray(ground, float)[:, 2:])


@pytest.mark.parametrize("memory", [512_000_000, 60_000])
def test_a_model_that_no_lattice_follows_is_projected_pixel_by_pixel(scene, tmp_path, memory):
    surface, grid = scene.surface(), grid_of(100.0)
    rows, columns = np.mgrid[0 : grid.height, 0 : grid.width] + 0.5
    x, y = grid.xy(columns.ravel(), rows.ravel())
    heights = surface.heights(np.stack([x, y], axis=1))
    exact = Shaken().ground_to_image(np.stack([x, y, heights], axis=1)).T.reshape(2, grid.height, grid.width)
    source = RasterSource(scene.write(ramps()))
    result = rectify(Shaken(), source, surface, grid, tmp_path / "o.tif", resources=Resources(memory), driver="GTiff")
    assert (result.finest_spacing, result.max_error_px) == (1, 0.0)
    # Rounding of heights (1e-13 m) and of the Float32 ramp.
    assert np.abs(read(tmp_path / "o.tif")[0] - exact)[:, inner(exact)].max() < 1e-4


@pytest.mark.parametrize("kernel", ["bilinear", "cubic"])
def test_output_is_the_same_for_any_memory_and_threads(scene, tmp_path, kernel):
    source, surface, grid = RasterSource(scene.write(texture(np.float32, bands=2))), scene.surface(), grid_of()
    outputs = []
    for k, (memory, threads) in enumerate([(512_000_000, 1), (512_000_000, 4), (400_000, 2)]):
        path = tmp_path / f"{k}.tif"
        rectify(
            scene.model,
            source,
            surface,
            grid,
            path,
            resampling=kernel,
            resources=Resources(memory, threads),
            driver="GTiff",
        )
        outputs.append(read(path))
    for pixels, valid in outputs[1:]:
        np.testing.assert_array_equal(pixels, outputs[0][0])
        np.testing.assert_array_equal(valid, outputs[0][1])


@pytest.mark.parametrize("kernel", ["bilinear", "cubic"])
def test_integers_of_16_bits_are_mixed_to_a_fiftieth_and_the_same_for_any_memory(scene, tmp_path, kernel):
    """Neighbours as far apart as they can be; a pixel is made in a whole row, or with care at an edge of the window."""
    pixels = np.random.default_rng(5).choice([0, 1, 32767, 65534, 65535], (1, HEIGHT, WIDTH)).astype(np.uint16)
    surface, grid, made = scene.surface(), grid_of(), []
    holed = np.full(pixels.shape[1:], 255, np.uint8)
    for row, column in np.ndindex(3, 3):
        holed[row::40, column::40] = 0
    for name, values, mask, memory in [
        ("exact", pixels.astype(np.float64), None, 512_000_000),
        ("ours", pixels, None, 512_000_000),
        ("little", pixels, None, 300_000),
        ("masked", pixels, holed, 512_000_000),
        ("little masked", pixels, holed, 300_000),
    ]:
        source, path = RasterSource(scene.write(values, f"{name}.tif", mask=mask)), tmp_path / "o.tif"
        rectify(
            scene.model, source, surface, grid, path, resampling=kernel, resources=Resources(memory), driver="GTiff"
        )
        made.append(read(path))
    (exact, valid), (ours, _), (little, _), (masked, whole), (little_masked, _) = made
    # Half a digital number of rounding, and that of Float32: 2^-24 of 65535 in each of some ten steps.
    off = np.abs(ours - np.clip(exact, 0, 65535))[:, valid]
    assert off.max() <= 0.52
    assert valid.sum() > 100_000
    np.testing.assert_array_equal(little, ours)
    np.testing.assert_array_equal(little_masked, masked)
    # Far from an invalid pixel those are the same, too.
    far = whole & (minimum_filter(whole, 15) > 0)
    assert far.sum() > 50_000
    np.testing.assert_array_equal(masked[:, far], ours[:, far])


def test_output_does_not_depend_on_the_size_of_the_tiles(scene, tmp_path, monkeypatch):
    source, surface, grid = RasterSource(scene.write(texture(np.float32))), scene.surface(), grid_of()
    pixels = []
    for blocks in (4, 1):
        monkeypatch.setattr(warp, "TILE", blocks * warp.BLOCK)
        rectify(scene.model, source, surface, grid, tmp_path / "o.tif", driver="GTiff")
        pixels.append(read(tmp_path / "o.tif")[0])
    np.testing.assert_array_equal(*pixels)


def test_the_progress_is_the_share_of_the_tiles_that_are_made(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(warp, "TILE", 256)
    told = []
    resources = Resources(threads=2, progress=lambda stage, share: told.append(share))
    source = RasterSource(scene.write(texture()))
    rectify(scene.model, source, FlatSurface(700.0), grid_of(), tmp_path / "o.tif", driver="GTiff", resources=resources)
    # 760 x 760 pixels.
    np.testing.assert_allclose(told, np.arange(1, 10) / 9)


def test_adjacent_grids_meet_without_a_seam(scene, tmp_path):
    """Two halves of a grid, cut at a block, hold the pixels of the whole."""
    source, surface, whole = RasterSource(scene.write(texture(np.float32))), scene.surface(), grid_of()
    cut = 2 * warp.BLOCK
    right = Grid(UTM, whole.left + cut * GSD, whole.top, GSD, GSD, whole.width - cut, whole.height)
    rectify(scene.model, source, surface, whole, tmp_path / "whole.tif", driver="GTiff")
    rectify(scene.model, source, surface, right, tmp_path / "right.tif", driver="GTiff")
    whole_pixels, part = read(tmp_path / "whole.tif")[0][:, :, cut:], read(tmp_path / "right.tif")[0]
    # The grids' origins round differently in the last bit, so the values do, but nothing more.
    np.testing.assert_allclose(part, whole_pixels, atol=1e-3)


# -- heights ---------------------------------------------------------------------------------------------------------


def test_voids_of_the_dem_are_holes_and_do_not_bleed(scene, tmp_path):
    dem = scene.dem()
    dataset = gdal.Open(str(dem), gdal.GA_Update)
    heights = dataset.ReadAsArray()
    heights[40, 40] = -32768.0  # not declared as nodata
    dataset.WriteArray(heights)
    left, dx, _, top, _, dy = dataset.GetGeoTransform()
    dataset = None
    grid = grid_of(200.0)
    rectify(
        scene.model, RasterSource(scene.write(texture())), open_dem(dem, "ellipsoid", fill="mask"), grid,
        tmp_path / "o.tif", driver="GTiff",
    )  # fmt: skip
    _, valid = read(tmp_path / "o.tif")
    rows, columns = np.mgrid[0 : grid.height, 0 : grid.width] + 0.5
    x, y = grid.xy(columns, rows)
    near = (np.abs((x - left) / dx - 40.5) < 1) & (np.abs((y - top) / dy - 40.5) < 1)
    np.testing.assert_array_equal(valid, ~near)


def test_cubic_dem_interpolates_its_samples(scene, tmp_path):
    """At the samples of a DEM all interpolators agree; between them cubic follows a smooth surface more closely."""
    smooth = Scene(tmp_path, make_rpc(1.0), lambda x, y: 700 + 20 * np.sin(x / 15) * np.cos(y / 15))
    surface, grid = smooth.surface(), grid_of(150.0)
    source, errors = RasterSource(smooth.write(ramps())), {}
    rows, columns = np.mgrid[0 : grid.height, 0 : grid.width] + 0.5
    x, y = grid.xy(columns.ravel(), rows.ravel())
    lon, lat = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True).transform(x, y)
    exact = smooth.model.ground_to_image(np.stack([lon, lat, smooth.heights(x, y)], 1)).T.reshape(2, *rows.shape)
    for way in ("bilinear", "cubic"):
        rectify(smooth.model, source, surface, grid, tmp_path / "o.tif", dem_interpolation=way, driver="GTiff")
        errors[way] = np.abs(read(tmp_path / "o.tif")[0] - exact)[:, inner(exact)].max()
    assert errors["cubic"] < errors["bilinear"] / 2


# -- values ----------------------------------------------------------------------------------------------------------


# Each type is compiled for, which takes most of the time.
@pytest.mark.parametrize(
    "dtype",
    [np.uint8, np.uint16, np.int16, np.int32, np.float32]
    + [pytest.param(one, marks=pytest.mark.slow) for one in (np.uint32, np.float64)],
)
@pytest.mark.parametrize("kernel", ["cubic", "lanczos"])
def test_overshoot_is_clipped_in_every_type(scene, tmp_path, dtype, kernel):
    limits = np.iinfo(dtype) if np.issubdtype(dtype, np.integer) else None
    low, high = (limits.min, limits.max) if limits else (0.0, 255.0)
    pixels = np.full((1, HEIGHT, WIDTH), low, dtype)
    pixels[:, ::8] = high  # lines one pixel wide overshoot on both sides
    pixels[:, :, ::9] = high
    path = scene.write(pixels)
    rectify(
        scene.model, RasterSource(path), FlatSurface(700.0), grid_of(100.0), tmp_path / "o.tif", resampling=kernel,
        driver="GTiff",
    )  # fmt: skip
    found, valid = read(tmp_path / "o.tif")
    assert found.dtype == dtype
    middle = (float(low) + float(high)) / 2
    if limits:
        # Wrapped values would turn the valleys beside lines into peaks.
        assert found[0][valid].min() == low
        assert (found[0][valid].astype(float) < middle).mean() > 0.5
    else:
        assert found[0][valid].min() < low


def test_bands_are_warped_alike(scene, tmp_path):
    pixels = texture(bands=8)
    for options in ([], ["INTERLEAVE=BAND"]):
        path = scene.write(pixels, "many.tif", options=options)
        rectify(scene.model, RasterSource(path), scene.surface(), grid_of(), tmp_path / "many_o.tif", driver="GTiff")
        single = scene.write(pixels[5:6], "single.tif")
        rectify(scene.model, RasterSource(single), scene.surface(), grid_of(), tmp_path / "one_o.tif", driver="GTiff")
        np.testing.assert_array_equal(read(tmp_path / "many_o.tif")[0][5], read(tmp_path / "one_o.tif")[0][0])


def test_values_of_nearest_are_values_of_the_source(scene, tmp_path):
    pixels = (np.random.default_rng(0).integers(0, 2, (1, HEIGHT, WIDTH)) * 7).astype(np.uint8)
    path = scene.write(pixels)
    rectify(
        scene.model, RasterSource(path), scene.surface(), grid_of(200.0), tmp_path / "o.tif", resampling="nearest",
        creation_options={"blocksize": "128", "OVERVIEW_COUNT": "1"},
    )  # fmt: skip
    found, valid = read(tmp_path / "o.tif")
    assert set(np.unique(found[0][valid])) == {0, 7}
    assert valid.all()  # a valid 0 stays valid
    # Values of classes do not mix in overviews either, as they would by default.
    ortho = gdal.Open(str(tmp_path / "o.tif"))
    assert set(np.unique(ortho.GetRasterBand(1).GetOverview(0).ReadAsArray())) == {0, 7}


@pytest.mark.parametrize("kernel", ["bilinear", "cubic", "lanczos", "average"])
def test_nodata_does_not_bleed(scene, tmp_path, kernel):
    pixels = np.full((1, HEIGHT, WIDTH), 1000, np.uint16)
    pixels[:, 200:400, 300:420] = 0
    path = scene.write(pixels, nodata=0)
    rectify(scene.model, RasterSource(path), scene.surface(), grid_of(), tmp_path / "o.tif", resampling=kernel)
    found, _ = read(tmp_path / "o.tif")
    assert set(np.unique(found)) == {0, 1000}
    dataset = gdal.Open(str(tmp_path / "o.tif"))  # a band does not keep its dataset alive
    assert dataset.GetRasterBand(1).GetNoDataValue() == 0


def test_mask_and_nan_are_not_valid(scene, tmp_path):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[200:400, 300:420] = 0
    values = np.full((1, HEIGHT, WIDTH), 5.0, np.float32)
    poisoned = values.copy()
    poisoned[0][mask == 0] = 1e30
    holes = values.copy()
    holes[0][mask == 0] = np.nan
    outputs = []
    for name, pixels, kind in (("mask.tif", poisoned, mask), ("nan.tif", holes, None)):
        path = scene.write(pixels, name, mask=kind)
        rectify(scene.model, RasterSource(path), scene.surface(), grid_of(), tmp_path / f"o_{name}", driver="GTiff")
        outputs.append(read(tmp_path / f"o_{name}"))
    for pixels, valid in outputs:
        np.testing.assert_allclose(pixels[0][valid], 5.0, rtol=1e-6)
        assert 0.05 < 1 - valid.mean() < 0.6
    np.testing.assert_array_equal(outputs[0][1], outputs[1][1])


def test_a_valid_pixel_never_becomes_nodata(scene, tmp_path):
    """Between 4 and 6 lies 5, which is nodata: such a pixel moves to the value next to it."""
    pixels = np.full((1, HEIGHT, WIDTH), 4, np.uint8)
    pixels[:, :, ::2] = 6
    path = scene.write(pixels, nodata=5)
    rectify(scene.model, RasterSource(path), FlatSurface(700.0), grid_of(150.0), tmp_path / "o.tif")
    assert set(np.unique(read(tmp_path / "o.tif")[0])) == {4, 6}


@pytest.mark.parametrize(("nodata", "moved"), [(7, 6), (0, 1), (255, 254)])
def test_it_moves_to_the_value_that_gdal_takes(scene, tmp_path, nodata, moved):
    """With nearest, and with the other kernels, of which every GDAL knows it."""
    path = scene.write(np.full((1, HEIGHT, WIDTH), nodata, np.uint8))
    source = RasterSource(path)
    for kernel in ("nearest", "bilinear"):
        rectify(
            scene.model, source, FlatSurface(700.0), grid_of(150.0), tmp_path / "o.tif", resampling=kernel,
            profile=Profile.of(source, nodata=nodata),
        )  # fmt: skip
        assert set(np.unique(read(tmp_path / "o.tif")[0])) == {moved}
    flat = gdal.GetDriverByName("MEM").Create("", 4, 4, 1)
    flat.SetGeoTransform((0, 1, 0, 4, 0, -1))
    flat.GetRasterBand(1).Fill(nodata)
    warped = gdal.Warp(
        "", flat, format="MEM", dstNodata=nodata, resampleAlg="bilinear", outputBounds=(0.5, 1, 3.5, 3)
    ).ReadAsArray()
    assert set(np.unique(warped)) == {moved}


def test_palette_is_kept_by_nearest_and_refused_by_others(scene, tmp_path):
    path = scene.write(texture(np.uint8))
    dataset = gdal.Open(str(path), gdal.GA_Update)
    table = gdal.ColorTable()
    for i in range(256):
        table.SetColorEntry(i, (i, 255 - i, 7, 255))
    dataset.GetRasterBand(1).SetColorTable(table)
    dataset = None
    source = RasterSource(path)
    with pytest.raises(InputError, match="palette"):
        rectify(scene.model, source, FlatSurface(700.0), grid_of(50.0), tmp_path / "o.tif")
    rectify(
        scene.model, source, FlatSurface(700.0), grid_of(50.0), tmp_path / "o.tif", resampling="nearest",
        driver="GTiff",
    )  # fmt: skip
    dataset = gdal.Open(str(tmp_path / "o.tif"))  # a band does not keep its dataset alive
    assert dataset.GetRasterBand(1).GetColorTable().GetColorEntry(9) == (9, 246, 7, 255)


def test_alpha_stays_alpha(scene, tmp_path):
    pixels = texture(np.uint8, bands=4)
    pixels[3] = 255
    pixels[3, :, :350] = 0
    path = scene.write(pixels, options=["PHOTOMETRIC=RGB", "ALPHA=YES"])
    rectify(scene.model, RasterSource(path), scene.surface(), grid_of(), tmp_path / "o.tif", driver="GTiff")
    dataset = gdal.Open(str(tmp_path / "o.tif"))
    assert dataset.RasterCount == 4
    assert dataset.GetRasterBand(4).GetColorInterpretation() == gdal.GCI_AlphaBand
    assert set(np.unique(dataset.GetRasterBand(4).ReadAsArray())) == {0, 255}


def test_complex_pixels_are_refused(scene):
    with pytest.raises(InputError, match="complex"):
        RasterSource(scene.write(np.zeros((1, HEIGHT, WIDTH), np.complex64)))


def test_average_is_the_mean_under_the_output_pixel(scene, tmp_path):
    pixels = texture(np.float32)
    path, step = scene.write(pixels), 4.0  # eight source pixels a side
    rectify(
        scene.model, RasterSource(path), FlatSurface(700.0), grid_of(160.0, step), tmp_path / "a.tif",
        resampling="average", driver="GTiff",
    )  # fmt: skip
    rectify(
        scene.model, RasterSource(path), FlatSurface(700.0), grid_of(160.0, step / 64), tmp_path / "f.tif",
        resampling="nearest", driver="GTiff",
    )  # fmt: skip
    coarse, fine = read(tmp_path / "a.tif")[0][0], read(tmp_path / "f.tif")[0][0]
    mean = fine.reshape(40, 64, 40, 64).mean(axis=(1, 3))
    # The box follows the image's axes, a rotated pixel does not: agree within a tenth of the pattern's spread.
    assert np.sqrt(np.mean((coarse - mean) ** 2)) < 0.1 * pixels.std()


@pytest.mark.parametrize("masked", [False, True])
def test_average_weighs_pixels_by_their_area_in_the_box(scene, tmp_path, masked):
    """Exactly: the integral of the source over the box, which the edge of the source may cut."""
    random = np.random.default_rng(4)
    pixels = random.uniform(0, 1000, (1, 64, 64)).astype(np.float32)
    if masked:
        pixels[0, 20:26, 30:36] = -1.0
    path = scene.write(pixels, nodata=-1.0 if masked else None)
    model, step = Parallel(0.0, 0.0, 1.0, 64.0), 2.7  # pixels of a source of 1 m, from its corner
    grid = Grid(pyproj.CRS(model.crs), WEST - 0.8, TOP + 0.7, step, step, 24, 24)
    rectify(
        model, RasterSource(path), FlatSurface(FLOOR), grid, tmp_path / "a.tif", resampling="average", driver="GTiff"
    )
    found, valid = read(tmp_path / "a.tif")

    def integral(values: np.ndarray) -> np.ndarray:
        """Return the integral of a picture over each box, from sums that are linear between the pixels' edges."""
        for axis, first in ((0, -0.7), (1, -0.8)):
            sums = np.concatenate([np.zeros_like(values.take([0], axis)), np.cumsum(values, axis)], axis)
            edges = first + step * np.arange(25)
            at = np.apply_along_axis(lambda line, x=edges: np.interp(x, np.arange(65), line), axis, sums)
            values = np.diff(at, axis=axis)
        return values

    whole = (pixels[0] >= 0).astype(float)
    with np.errstate(invalid="ignore"):
        expected = integral(np.where(whole > 0, pixels[0], 0).astype(float)) / integral(whole)
    np.testing.assert_array_equal(valid, ~np.isnan(expected))
    np.testing.assert_allclose(found[0][valid], expected[valid], rtol=1e-5)
    assert valid.all() != masked


# -- files -----------------------------------------------------------------------------------------------------------


def test_cog_has_overviews_and_no_rpc(scene, tmp_path):
    rectify(scene.model, RasterSource(scene.write(texture())), scene.surface(), grid_of(), tmp_path / "o.tif")
    dataset = gdal.Open(str(tmp_path / "o.tif"))
    assert dataset.GetMetadataItem("LAYOUT", "IMAGE_STRUCTURE") == "COG"
    assert dataset.GetMetadataItem("COMPRESSION", "IMAGE_STRUCTURE") == "DEFLATE"
    assert dataset.GetMetadata("RPC") == {}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dem.tif", "o.tif", "source.tif"]


def test_nothing_is_left_when_the_source_is_cut_off(scene, tmp_path):
    path = scene.write(texture())
    path.write_bytes(path.read_bytes()[:200_000])
    (tmp_path / "o.tif").write_bytes(b"the old one")
    with pytest.raises(InputError) as caught:
        rectify(scene.model, RasterSource(path), FlatSurface(700.0), grid_of(), tmp_path / "o.tif")
    assert str(path) in str(caught.value)
    assert (tmp_path / "o.tif").read_bytes() == b"the old one"
    assert sorted(item.name for item in tmp_path.iterdir()) == ["o.tif", "source.tif"]


@pytest.mark.parametrize("options", [{"COMPRES": "LZW"}, {"TILES": "YES"}])
def test_unknown_creation_options_are_refused(scene, tmp_path, options):
    with pytest.raises(InputError, match="creation option"):
        rectify(
            scene.model, RasterSource(scene.write(texture())), FlatSurface(700.0), grid_of(50.0),
            tmp_path / "o.tif", creation_options=options,
        )  # fmt: skip


def test_non_square_pixels(scene, tmp_path):
    left, top = EAST - 80, NORTH + 80
    grid = Grid.of_extent(UTM, (left, top - 160, left + 160, top), (0.4, 1.6))
    assert (grid.width, grid.height) == (400, 100)
    rectify(scene.model, RasterSource(scene.write(ramps())), scene.surface(), grid, tmp_path / "o.tif", driver="GTiff")
    exact = exact_image(scene.model, tmp_path / "dem.tif", grid)
    assert np.abs(read(tmp_path / "o.tif")[0] - exact)[:, inner(exact)].max() < 0.01


# -- several files, large files --------------------------------------------------------------------------------------


def test_a_file_for_each_band_is_one_source(scene, tmp_path):
    pixels = texture(bands=3)
    together = scene.write(pixels, "all.tif")
    apart = [scene.write(pixels[k : k + 1], f"band{k}.tif") for k in range(3)]
    for name, source in (("all", RasterSource(together)), ("apart", RasterSource(*apart))):
        rectify(scene.model, source, scene.surface(), grid_of(), tmp_path / f"o_{name}.tif", driver="GTiff")
    np.testing.assert_array_equal(read(tmp_path / "o_all.tif")[0], read(tmp_path / "o_apart.tif")[0])


def patch(value, dtype, hole) -> np.ndarray:
    pixels = np.full((1, HEIGHT, WIDTH), value, dtype)
    pixels[:, 250:350, 300:400] = hole
    return pixels


def test_a_pixel_of_integers_needs_all_of_its_bands(scene, tmp_path):
    """One file has a nodata value, the other has none: a mask, and no band gets a 0 that means nothing."""
    full = scene.write(np.full((1, HEIGHT, WIDTH), 9, np.uint8), "full.tif")
    source = RasterSource(full, scene.write(patch(9, np.uint8, 0), "holes.tif", nodata=0))
    rectify(scene.model, source, scene.surface(), grid_of(200.0), tmp_path / "o.tif", driver="GTiff")
    pixels, valid = read(tmp_path / "o.tif")
    assert 0 < (~valid).mean() < 0.2
    assert set(np.unique(pixels[:, valid])) == {9}


def test_bands_of_numbers_are_nan_where_they_alone_have_no_value(scene, tmp_path):
    source = np.concatenate([patch(5, np.float32, np.nan), np.full((1, HEIGHT, WIDTH), 7, np.float32)])
    for nodata in (None, np.nan):
        path = scene.write(source, "n.tif", nodata=nodata)
        rectify(scene.model, RasterSource(path), scene.surface(), grid_of(200.0), tmp_path / "o.tif", driver="GTiff")
        (first, second), _ = read(tmp_path / "o.tif")
        assert 0 < np.isnan(first).mean() < 0.2
        np.testing.assert_allclose(first[~np.isnan(first)], 5)
        np.testing.assert_allclose(second, 7)
        dataset = gdal.Open(str(tmp_path / "o.tif"))  # a band does not keep its dataset alive
        declared = dataset.GetRasterBand(1).GetNoDataValue()
        assert declared is None if nodata is None else np.isnan(declared)


@pytest.mark.parametrize(("dtype", "nodata"), [(np.uint16, 0), (np.float32, -9999.0)])
@pytest.mark.parametrize("kernel", ["nearest", "bilinear"])
def test_nodata_of_one_band_stays_nodata(scene, tmp_path, dtype, nodata, kernel):
    pixels = np.concatenate([patch(5, dtype, nodata), np.full((1, HEIGHT, WIDTH), 7, dtype)])
    path = scene.write(pixels, "n.tif", nodata=nodata)
    rectify(scene.model, RasterSource(path), scene.surface(), grid_of(200.0), tmp_path / "o.tif", resampling=kernel)
    first, second = read(tmp_path / "o.tif")[0]
    assert set(np.unique(first)) == {nodata, 5}
    assert set(np.unique(second)) == {7}


def test_a_mask_beside_nodata_counts(scene, tmp_path):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[250:350, 300:400] = 0
    path = scene.write(np.full((1, HEIGHT, WIDTH), 100, np.uint16), nodata=0, mask=mask)
    rectify(scene.model, RasterSource(path), scene.surface(), grid_of(200.0), tmp_path / "o.tif")
    assert set(np.unique(read(tmp_path / "o.tif")[0])) == {0, 100}


def test_integers_of_64_bits_are_only_copied(scene, tmp_path):
    source = RasterSource(scene.write(np.full((1, HEIGHT, WIDTH), 2**62 + 1, np.int64)))
    with pytest.raises(InputError, match="64-bit integers"):
        rectify(scene.model, source, FlatSurface(700.0), grid_of(50.0), tmp_path / "o.tif")
    rectify(
        scene.model, source, FlatSurface(700.0), grid_of(50.0), tmp_path / "o.tif", resampling="nearest",
        driver="GTiff",
    )  # fmt: skip
    assert set(np.unique(read(tmp_path / "o.tif")[0])) == {2**62 + 1}


def test_the_end_of_the_model_may_cross_the_image(tmp_path):
    """A model whose domain is smaller than the image: what it cannot project is a hole, not an error."""
    for half in np.linspace(0.2, 0.4, 6):
        fields = {"lon_scale": half * 0.0037, "lat_scale": half * 0.0028}
        one, zero = np.eye(20)[0], np.zeros(20)
        col, row = zero.copy(), zero.copy()
        col[1], row[2] = 1.0, -1.0
        model = RPC(
            350.0, 310.0, *CENTRE, 700.0, fields["lon_scale"] * 92_800 / GSD, fields["lat_scale"] * 110_900 / GSD,
            *fields.values(), 500.0, col, one, row, one,
        )  # fmt: skip
        scene = Scene(tmp_path, model)
        result = rectify(
            model, RasterSource(scene.write(texture())), FlatSurface(700.0), grid_of(), tmp_path / "o.tif",
            driver="GTiff",
        )  # fmt: skip
        box = 3 * fields["lon_scale"] * 92_800 / GSD * 3 * fields["lat_scale"] * 110_900 / GSD
        assert result.valid_pixels == pytest.approx(min(box, WIDTH * HEIGHT), rel=0.05)


def test_a_fine_dem_under_a_coarse_output_stays_within_the_memory(scene, tmp_path):
    """A block would look at 2,600² heights: with little memory it is made cell by cell, with the same pixels."""
    surface = open_dem(scene.dem(step=0.5, count=1000), "ellipsoid")
    outputs = []
    for memory in (512_000_000, 400_000):
        rectify(
            scene.model, RasterSource(scene.write(texture(np.float32))), surface, grid_of(300.0, 5.0),
            tmp_path / "o.tif", resources=Resources(memory, 1), driver="GTiff",
        )  # fmt: skip
        outputs.append(read(tmp_path / "o.tif")[0])
    assert np.isfinite(outputs[0]).mean() > 0.9
    np.testing.assert_array_equal(outputs[0], outputs[1])


@pytest.mark.parametrize("reach", [1, 2, 5])
def test_pixels_whose_neighbours_are_all_valid_are_known(reach):
    valid = np.random.default_rng(reach).random((2, 60, 80)) > 0.004
    valid[:, 3, 70:] = False
    whole = np.empty(valid.shape[1:], dtype=bool)
    resampling_kernel.find_whole(valid, reach, whole)
    np.testing.assert_array_equal(whole, minimum_filter(valid.all(axis=0), 2 * reach + 1, mode="constant", cval=True))
    assert 0.1 < whole.mean() < 0.99


def test_masked_pixels_are_the_same_for_any_memory(scene, tmp_path):
    pixels = texture(np.float32)
    pixels[:, 100:130, 200:260] = -1.0
    source, outputs = RasterSource(scene.write(pixels, nodata=-1.0)), []
    for memory in (512_000_000, 300_000):
        rectify(
            scene.model,
            source,
            scene.surface(),
            grid_of(),
            tmp_path / "o.tif",
            resources=Resources(memory),
            driver="GTiff",
        )
        outputs.append(read(tmp_path / "o.tif")[0])
    np.testing.assert_array_equal(*outputs)


def test_names_with_brackets_leave_nothing_behind(scene, tmp_path):
    out = tmp_path / "out"
    rectify(scene.model, RasterSource(scene.write(texture())), FlatSurface(700.0), grid_of(50.0), out / "o[1]*.tif")
    assert [path.name for path in out.iterdir()] == ["o[1]*.tif"]


def test_gdals_warper_refuses_several_files(scene, tmp_path):
    source = RasterSource(scene.write(texture(), "a.tif"), scene.write(texture(), "b.tif"))
    with pytest.raises(InputError, match="one file"):
        rectify_gdal(scene.model, None, source, FlatSurface(700.0), grid_of(50.0), tmp_path / "o.tif")


def vrt(path: Path, source: str) -> Path:
    path.write_text(
        f'<VRTDataset rasterXSize="10" rasterYSize="10"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="1">{source}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>'
        f"</VRTRasterBand></VRTDataset>"
    )
    return path


def test_a_vrt_reads_only_its_own_folder(tmp_path):
    folder = tmp_path / "v"
    folder.mkdir()
    secret = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "secret.tif"), 10, 10)
    secret.GetRasterBand(1).Fill(42)
    secret = None
    evil = vrt(folder / "evil.tif", "../secret.tif")
    for path in (vrt(folder / "a.vrt", "../secret.tif"), vrt(folder / "b.vrt", "evil.tif"), evil):
        with pytest.raises(InputError):
            RasterSource(path)
    vrt(folder / "c.vrt", "d.vrt")
    with pytest.raises(InputError, match="refers to itself"):
        RasterSource(vrt(folder / "d.vrt", "c.vrt"))


def test_files_of_different_sizes_are_no_source(scene):
    with pytest.raises(InputError, match="one by one"):
        RasterSource(scene.write(texture(), "a.tif"), scene.write(texture()[:, :-1], "b.tif"))


def test_a_sparse_source_of_70000_pixels_a_side_in_little_memory(tmp_path):
    """A header of 9.8 GB of pixels: only the windows are read, and of the output only what the grid asks for."""
    side = 70_000
    path = tmp_path / "huge.tif"
    options = ["SPARSE_OK=TRUE", "TILED=YES", "BIGTIFF=YES"]
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), side, side, 1, gdal.GDT_UInt16, options)
    dataset.GetRasterBand(1).WriteArray(np.full((512, 512), 77, np.uint16), side // 2 - 256, side // 2 - 256)
    dataset = None
    half = side / 2
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[1], row[2] = 1.0, -1.0
    scales = half, half, half * GSD / 92_800, half * GSD / 110_900, 500.0
    model = RPC(half, half, *CENTRE, 700.0, *scales, col, one, row, one)
    grid = Grid.of_extent(UTM, (EAST - 400, NORTH - 400, EAST + 400, NORTH + 400), (GSD, GSD))
    result = rectify(model, RasterSource(path), FlatSurface(700.0), grid, tmp_path / "o.tif", driver="GTiff")
    pixels, _ = read(tmp_path / "o.tif")
    assert result.valid_pixels == grid.width * grid.height
    # 512 x 512 source pixels of 77, seen through a slightly rotated grid of the same resolution.
    assert (pixels == 77).sum() == pytest.approx(512**2, rel=0.01)


def test_many_bands_take_no_more_memory_than_tiles_of_8_mb(scene, tmp_path):
    """32 bands of a tile of 1024² are 67 MB, of which there used to be four at a time, and windows of the same size."""
    import tracemalloc

    path, options = tmp_path / "many.tif", ["SPARSE_OK=TRUE", "TILED=YES"]
    gdal.GetDriverByName("GTiff").Create(str(path), 600, 600, 32, gdal.GDT_UInt16, options).FlushCache()
    source, surface = RasterSource(path), FlatSurface(700.0)
    rectify(scene.model, source, surface, grid_of(size=50.0), tmp_path / "loads.tif", driver="GTiff")
    tracemalloc.start()
    try:
        rectify(scene.model, source, surface, grid_of(size=600 * GSD), tmp_path / "1.tif", driver="GTiff",
                resources=Resources(threads=1))  # fmt: skip
        # Three tiles of 256², what is valid in them, a window: 27 MB.
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()
    rectify(scene.model, source, surface, grid_of(size=600 * GSD), tmp_path / "2.tif", driver="GTiff")
    assert gdal.Open(str(tmp_path / "1.tif")).GetRasterBand(1).GetBlockSize() == [256, 256]
    assert sha256(tmp_path / "1.tif") == sha256(tmp_path / "2.tif")


def test_an_output_that_may_exceed_4_gb_is_a_bigtiff(scene, tmp_path):
    """BIGTIFF=IF_SAFER by default: GDAL decides by the size of the raster, without compression known."""
    import struct

    def version(path: Path) -> int:
        return struct.unpack("<H", path.read_bytes()[2:4])[0]

    source = RasterSource(scene.write(texture()))
    small = grid_of(20.0)
    large = Grid(UTM, EAST, NORTH, GSD, GSD, 60_000, 40_000)  # 4.8 GB, none of it over the scene
    from ortho_pipeline.raster.ortho import Profile, RasterWriter

    for grid, expected in ((small, 42), (large, 43)):
        sparse = {"SPARSE_OK": "TRUE"}  # or 4.8 GB of zeros would be compressed here
        with RasterWriter(
            tmp_path / "o.tif", grid, Profile.of(source), driver="GTiff", creation_options=sparse
        ) as writer:
            writer.write(0, 0, np.zeros((1, 40, 40), np.uint16), np.ones((40, 40), bool))
        assert version(tmp_path / "o.tif") == expected


def test_strong_downsampling_stays_within_the_memory(scene, tmp_path):
    """An output pixel of 60 source pixels: a block would see 15,000² of them; it is made cell by cell."""
    path, step = scene.write(texture(np.float32)), 30.0
    outputs = []
    for memory in (512_000_000, 200_000):
        rectify(
            scene.model, RasterSource(path), FlatSurface(700.0), grid_of(300.0, step), tmp_path / "o.tif",
            resampling="average", resources=Resources(memory), driver="GTiff",
        )  # fmt: skip
        outputs.append(read(tmp_path / "o.tif"))
    np.testing.assert_array_equal(outputs[0][0], outputs[1][0])
    assert outputs[0][1].all()


def test_a_crop_of_the_image_gives_a_crop_of_the_ortho(scene, tmp_path):
    """Field practice: the model of the whole image, shifted, for a tile of it."""
    pixels = texture(np.float32)
    crop = pixels[:, 100:500, 150:600]
    surface, grid = scene.surface(), grid_of(160.0)
    rectify(scene.model, RasterSource(scene.write(pixels)), surface, grid, tmp_path / "whole.tif", driver="GTiff")
    rectify(
        scene.model.shifted(150, 100), RasterSource(scene.write(crop, "crop.tif")), surface, grid,
        tmp_path / "crop_o.tif", driver="GTiff",
    )  # fmt: skip
    (whole, valid), (part, part_valid) = read(tmp_path / "whole.tif"), read(tmp_path / "crop_o.tif")
    use = valid & part_valid
    assert use.mean() > 0.9
    # Values are the same but where the crop ends; positions differ in the last bit.
    assert np.quantile(np.abs(whole - part)[0][use], 0.99) < 1e-3


@pytest.mark.parametrize("options", [{}, pytest.param({"COMPRESS": "DEFLATE", "TILED": "NO"}, marks=pytest.mark.slow)])
def test_equal_orthos_are_equal_files_whatever_the_number_of_threads(scene, tmp_path, options):
    """Blocks used to be written in the order in which the threads came to an end."""
    source, found = RasterSource(scene.write(texture())), set()
    for threads in (1, 4, 4, 7):
        out = tmp_path / "o.tif"
        rectify(scene.model, source, FlatSurface(700.0), grid_of(step=0.1), out, driver="GTiff",
                resources=Resources(threads=threads), creation_options=options)  # fmt: skip
        found.add(sha256(out))
    assert len(found) == 1


@pytest.mark.skipif(hasattr(gdal, "GDT_Int8"), reason="this GDAL has a type for bytes with a sign")
def test_bytes_with_a_sign_are_not_taken_for_others(tmp_path):
    path = tmp_path / "signed.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 4, 4, 1, gdal.GDT_Byte, ["PIXELTYPE=SIGNEDBYTE"])
    dataset = None
    assert dataset is None
    with pytest.raises(InputError, match="signed bytes"):
        RasterSource(path)
