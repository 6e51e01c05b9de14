"""The bound on the warp's error is a bound: every output pixel compared with the exact model, for nasty models.

The source is a ramp whose pixels are their own coordinates, computed as it is read, so that images may be as large as
real ones. Warped bilinearly it gives the image coordinates that the warp used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
from ortho_studies.simulation.scanner import LineScanner
from orthos import rectify
from osgeo import gdal

from ortho_pipeline.geodesy.crs import GroundTransform
from ortho_pipeline.models import Pushbroom, SensorModel
from ortho_pipeline.models.correction import ImageCorrection
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.tables import pushbroom_of_tables
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.surface.writing import write_dem
from ortho_pipeline.warp.job import WarpRecord
from ortho_pipeline.warp.lattice import BLOCK, Lattices, OutputBlock, TileHeights

UTM = pyproj.CRS.from_epsg(32651)
EAST, NORTH = 500_000.0, 1_000_000.0
TOLERANCE = 0.01
#: Of coordinates of some thousand pixels, in the two orders of computation (px).
ROUNDING = 1e-9


class Ramp(RasterSource):
    """A source of two bands, column and row of their own pixels, of any size."""

    def __init__(self, folder: Path, width: int, height: int) -> None:
        path = folder / f"ramp_{width}_{height}.tif"
        if not path.exists():
            gdal.GetDriverByName("GTiff").Create(
                str(path), width, height, 2, gdal.GDT_Float64, ["SPARSE_OK=TRUE", "TILED=YES"]
            )
        super().__init__(path)

    def read(self, left, top, width, height):
        rows, columns = np.mgrid[top : top + height, left : left + width] + 0.5
        return np.stack([columns, rows], out=np.empty((2, height, width)))


def compare(
    model: SensorModel,
    size: tuple[int, int],
    grid: Grid,
    folder: Path,
    *,
    height: float = np.nan,
    surface: Surface | None = None,
) -> tuple[float, int, WarpRecord]:
    """Return the worst error (px) of all output pixels that show the image, their number, and what the warp says."""
    columns, rows = np.meshgrid(np.arange(grid.width) + 0.5, np.arange(grid.height) + 0.5)
    x, y = grid.xy(columns.ravel(), rows.ravel())
    ground = np.stack([x, y, np.full(x.size, height)], axis=1)
    if surface is None:
        surface = FlatSurface(height)
    else:
        ground[:, 2] = surface.heights(ground[:, :2])
    path = folder / "o.tif"
    result = rectify(model, Ramp(folder, *size), surface, grid, path, driver="GTiff", tolerance=TOLERANCE)
    dataset = gdal.Open(str(path))
    found, valid = dataset.ReadAsArray().reshape(2, -1).T, dataset.GetRasterBand(1).GetMaskBand().ReadAsArray().ravel()
    exact = model.ground_to_image(GroundTransform(grid.crs, model.crs)(ground))
    with np.errstate(invalid="ignore"):
        # Values end half a pixel from the edge, where the ramp does; which pixels are valid counts up to the edge.
        whole = ((exact > TOLERANCE) & (exact < np.array(size) - TOLERANCE)).all(axis=1)
        near = ((exact > -TOLERANCE) & (exact < np.array(size) + TOLERANCE)).all(axis=1)
        inside = ((exact > 0.5) & (exact < np.array(size) - 0.5)).all(axis=1)
    assert valid[whole].all(), "a pixel of the image is missing"
    assert not valid[~near].any(), "a pixel shows what lies outside of the image"
    error = np.hypot(*(found - exact)[inside].T)
    return float(error.max(initial=0.0)), int(inside.sum()), result


# -- frames ----------------------------------------------------------------------------------------------------------


def drone(focal: float, omega: float = 0.0, **distortion: float) -> FrameCamera:
    interior = Interior(5472, 3648, focal * 1e-6, 1e-6, 1e-6, **distortion)
    exterior = np.array([EAST, NORTH, 180.0, omega, 0.02, 0.3])
    return FrameCamera(interior, exterior, frame="map", ground_crs="EPSG:32651", heights=(55.0, 115.0))


@pytest.mark.parametrize("corner", range(4))
def test_slivers_at_the_corners_of_a_drone_image(tmp_path, corner):
    """Eight extents about each corner, some of which show but a few pixels: the camera of the `odm` scene."""
    lens = {"k1": -0.26406, "k2": 0.10189, "k3": -0.02582, "p1": 7.3459e-4, "p2": 2.5952e-4}
    model, step, side = drone(0.66646 * 5472, **lens), 0.03, 300
    place = model.image_to_ground(np.array([[0, 0], [5472, 0], [5472, 3648], [0, 3648.0]]), 80.0)[corner]
    random, shown = np.random.default_rng(corner), []
    for shift in random.uniform(-0.9, 0.9, (8, 2)) * side * step / 2:
        x, y = place[:2] + shift
        grid = Grid(UTM, x - side * step / 2, y + side * step / 2, step, step, side, side)
        worst, count, result = compare(model, (5472, 3648), grid, tmp_path, height=80.0)
        assert worst - ROUNDING <= result.max_error_px <= TOLERANCE / 2
        shown.append(count)
    assert sum(count > 1000 for count in shown) >= 4


@pytest.mark.parametrize(
    "camera",
    [
        {"focal": 1500.0, "k1": -0.264, "k2": 0.1},
        {"focal": 1800.0, "k1": -0.3, "k2": 0.05, "omega": 0.6},
        {"focal": 3000.0, "k1": 0.5, "k2": 0.3},
        {"focal": 900.0, "k1": -0.1, "omega": 1.0},
    ],
    ids=["barrel", "barrel, oblique", "pincushion", "folds over"],
)
@pytest.mark.parametrize("step", [0.1, 0.6])
def test_distortion_of_a_fisheye(tmp_path, camera, step):
    model = drone(**camera)
    x, y = model.image_to_ground(np.array([[2736.0, 1824.0]]), 80.0)[0, :2] + (25.0, -40.0)
    grid = Grid(UTM, x - 200 * step, y + 170 * step, step, step, 400, 340)
    worst, count, result = compare(model, (5472, 3648), grid, tmp_path, height=80.0)
    assert count > 5000
    assert worst - ROUNDING <= result.max_error_px <= TOLERANCE / 2


# -- vibrations ------------------------------------------------------------------------------------------------------


class Trembling(SensorModel):
    """A line scanner whose columns swing with its rows; nothing tells the warp how fast."""

    kind = "test_trembling"

    def __init__(self, length: float, amplitude: float) -> None:
        object.__setattr__(self, "length", length)
        object.__setattr__(self, "amplitude", amplitude)

    @property
    def crs(self) -> str:
        return "EPSG:32651"

    @property
    def domain(self):
        return np.array([EAST, NORTH, 300.0]), np.array([5000.0, 5000.0, 400.0])

    def ground_to_image(self, ground):
        x, y, h = np.asarray(ground, float).T
        row = 3000 - (y - NORTH + 0.4 * (h - 300)) / 0.5
        swing = self.amplitude * np.sin(2 * np.pi * row / self.length + 0.3)
        return np.stack([3000 + (x - EAST + 0.3 * (h - 300)) / 0.5 + swing, row], axis=1)


#: Rows of a wave at 0.3 ms a row: 0.1 Hz to 50 Hz, those that lattices of 64, 32, 16 and 8 pixels cannot see, others.
WAVES = (33_000.0, 3300.0, 1000.0, 330.0, 128.0, 66.0, 64.0, 64 / 3, 16.0)


@pytest.mark.parametrize("length", WAVES)
def test_a_vibration_of_any_frequency(tmp_path, length):
    grid = Grid(UTM, EAST - 60.3, NORTH + 130.2, 0.5, 0.5, 240, 500)
    for amplitude in (0.003, 1.0, 300.0):
        model = Trembling(length, amplitude)
        worst, count, result = compare(model, (6000, 6000), grid, tmp_path, height=310.0)
        assert count == grid.width * grid.height
        assert worst - ROUNDING <= result.max_error_px <= TOLERANCE / 2


def mountains(folder: Path) -> Surface:
    """Heights of 150 to 450 m and noise, every 10 m about the middle."""
    path = folder / "dem.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 80, 80, 1, gdal.GDT_Float64)
    dataset.SetProjection(UTM.to_wkt())
    dataset.SetGeoTransform((EAST - 400, 10.0, 0, NORTH + 400, 0, -10.0))
    rows, columns = np.mgrid[:80, :80]
    noise = np.random.default_rng(0).normal(0, 5, (80, 80))
    dataset.WriteArray(300 + 150 * np.sin(columns / 5) * np.cos(rows / 7) + noise)
    dataset = None
    return open_dem(path, "ellipsoid")


@pytest.mark.parametrize(("length", "amplitude"), [(33_000.0, 300.0), (1000.0, 1.0), (128.0, 0.02), (66.0, 300.0)])
def test_a_vibration_over_mountains(tmp_path, length, amplitude):
    """The heights of a block shift the rows over several waves, which no polynomial of the height follows."""
    grid = Grid(UTM, EAST - 60.3, NORTH + 130.2, 0.5, 0.5, 240, 500)
    surface = mountains(tmp_path)
    worst, count, result = compare(Trembling(length, amplitude), (6000, 6000), grid, tmp_path, surface=surface)
    assert count == grid.width * grid.height
    assert worst - ROUNDING <= result.max_error_px <= TOLERANCE / 2


class Rising(Trembling):
    """Columns that bend with the height: a power of it, or waves of some length (m) where `power` is 0."""

    kind = "test_rising"

    def __init__(self, amplitude: float, power: int, length: float = 150.0) -> None:
        super().__init__(length, amplitude)
        object.__setattr__(self, "power", power)
        object.__setattr__(self, "calls", [])

    def ground_to_image(self, ground):
        ground = np.asarray(ground, float)
        self.calls.append(len(ground))
        x, y, h = ground.T
        up = (h - 300) / self.length
        bend = up**self.power if self.power else np.sin(2 * np.pi * up)
        column = 3000 + (x - EAST + 0.3 * (h - 300)) / 0.5 + self.amplitude * bend
        return np.stack([column, 3000 - (y - NORTH + 0.4 * (h - 300)) / 0.5], axis=1)


@pytest.mark.parametrize("amplitude", [0.01, 1.0, 100.0])
@pytest.mark.parametrize(
    ("power", "length"),
    [(3, 150.0), (4, 150.0), (5, 150.0), (8, 150.0), (0, 3000.0), (0, 300.0), (0, 75.0), (0, 20.0), (0, 1.0)],
)
def test_a_model_that_bends_with_the_height(tmp_path, power, length, amplitude):
    grid = Grid(UTM, EAST - 60.3, NORTH + 130.2, 0.5, 0.5, 240, 500)
    model = Rising(amplitude, power, length)
    worst, count, result = compare(model, (6000, 6000), grid, tmp_path, surface=mountains(tmp_path))
    assert count == grid.width * grid.height
    assert worst - ROUNDING <= result.max_error_px <= TOLERANCE / 2


def test_a_cubic_in_height_takes_a_height_more_and_all_blocks_of_a_tile_at_once(tmp_path):
    """Nodes closer together would not help, and a call of the model for each block takes longer than it computes."""
    model, surface = Rising(1.0, 3), mountains(tmp_path)
    grid = Grid(UTM, EAST - 120.3, NORTH + 130.2, 0.5, 0.5, 512, 512)
    result = rectify(model, Ramp(tmp_path, 6000, 6000), surface, grid, tmp_path / "o.tif", driver="GTiff")
    assert (result.refined_blocks, result.blocks, result.finest_spacing) == (4, 4, 64)
    # Nodes and check points, at three heights and at four.
    assert model.calls == [4 * 25 * 3, 4 * 24, 4 * 25 * 4, 4 * 24]


@pytest.mark.parametrize(
    ("amplitude", "power"),
    [(1.0, 3), pytest.param(100.0, 8, marks=pytest.mark.slow)],
    ids=["a height more", "closer nodes"],
)
def test_refined_blocks_are_the_same_for_any_memory_and_threads(tmp_path, amplitude, power):
    """They are evaluated together, with whatever other blocks of their tile lack."""
    surface, found = mountains(tmp_path), []
    grid = Grid(UTM, EAST - 300.3, NORTH + 300.2, 0.5, 0.5, 1200, 1100)
    for memory, threads in ((512_000_000, 1), (512_000_000, 4), (3_000_000, 2)):
        result = rectify(
            Rising(amplitude, power), Ramp(tmp_path, 6000, 6000), surface, grid, tmp_path / "o.tif", driver="GTiff",
            resources=Resources(memory, threads),
        )  # fmt: skip
        assert result.refined_blocks > 4
        found.append((gdal.Open(str(tmp_path / "o.tif")).ReadAsArray(), result.max_error_px, result.finest_spacing))
    for pixels, *other in found[1:]:
        np.testing.assert_array_equal(pixels, found[0][0])
        assert other == list(found[0][1:])


def test_the_heights_of_a_block_hold_what_a_cubic_dem_makes_between_its_samples(tmp_path):
    """The worst of Keys' kernel: in the middle of four samples, of which each has the least weight that it can."""
    signs = np.sign(np.outer([-1, 1, 1, -1], [-1, 1, 1, -1]))
    heights = np.where(np.tile(signs, (16, 16)) > 0, 500.0, 100.0)
    write_dem(tmp_path / "d.tif", heights, (EAST - 320, NORTH + 320), 10.0, UTM.to_string())
    surface = open_dem(tmp_path / "d.tif", "ellipsoid")
    grid = Grid(UTM, EAST - 200, NORTH + 200, 0.5, 0.5, 512, 512)
    heights = TileHeights(surface, True, 64_000_000)
    lattices = Lattices(Rising(0.0, 1), surface, grid, (6000, 6000), tolerance=TOLERANCE, reach=1, averages=False)
    block = OutputBlock(0, 0)
    assert lattices.build([block], heights)
    x, y = np.meshgrid(EAST - 200 + 0.5 * np.arange(BLOCK + 1), NORTH + 200 - 0.5 * np.arange(BLOCK + 1))
    uv = surface.samples_at(np.column_stack([x.ravel(), y.ravel()])).reshape(BLOCK + 1, BLOCK + 1, 2)
    found = heights.heights(block, uv)
    assert np.nanmax(found) > 600
    assert np.nanmax(np.abs(found - block.middle)) <= block.half


def test_a_block_more_takes_few_calls(tmp_path, calls):
    """What a tile takes in addition to its pixels is mostly the interpreter's work."""
    model, surface = Rising(0.0, 1), mountains(tmp_path)
    grid = Grid(UTM, EAST - 250.3, NORTH + 250.2, 0.5, 0.5, 1024, 1024)
    lattices = Lattices(model, surface, grid, (6000, 6000), tolerance=TOLERANCE, reach=1, averages=False)
    taken = []
    for count in (1, 1, 16):
        blocks = [OutputBlock(number // 4, number % 4) for number in range(count)]
        with calls:
            assert len(lattices.build(blocks, TileHeights(surface, False, 64_000_000))) == count
        taken.append(calls.count)
        calls.count = 0
    assert taken[2] - taken[1] < 15 * 60


def shaken(rate: float, roll_px: float, glitch: bool = False) -> Pushbroom:
    """A pushbroom of 2.5 m with a table of its attitude twelve times per wave: a roll of `rate` Hz, or one jerk."""
    camera = LineScanner.over(
        121.0, 24.0, 300.0, image_width=6000, image_height=6000, gsd=2.5, heading_deg=192.0, altitude=618e3,
        heights=(0.0, 1260.0),
    )  # fmt: skip
    period = camera.line_period
    times = np.arange(-0.6 * 6000 * period, 1.6 * 6000 * period, min(1 / rate / 12, 0.05))
    rows = times / period
    positions, z = camera.rays(np.column_stack([np.full(len(rows), 3000.0), rows]))
    across = camera.rays(np.column_stack([np.zeros(len(rows)), rows]))[1]
    across = across / (across * z).sum(axis=1)[:, None] - z
    x = -across / np.linalg.norm(across, axis=1)[:, None]
    turns = np.stack([x, np.cross(z, x), z], axis=2)
    angle = roll_px * camera.pixel_tan * np.sin(2 * np.pi * rate * times)
    if glitch:
        angle = np.where(np.abs(rows - 3000.0) <= rate, roll_px * camera.pixel_tan, 0.0)
    roll = np.zeros((len(rows), 3, 3))
    roll[:, 0, 0], roll[:, 0, 2], roll[:, 1, 1] = np.cos(angle), np.sin(angle), 1.0
    roll[:, 2, 0], roll[:, 2, 2] = -np.sin(angle), np.cos(angle)
    return pushbroom_of_tables(
        LineCamera(6000, 6000, 3000.0, 0.0, 1 / camera.pixel_tan), line_period=period, first_time=0.0,
        orbit=(times, positions), attitude=(times, turns @ roll), heights=camera.heights,
    )  # fmt: skip


@pytest.mark.parametrize(("rate", "roll_px"), [(0.5, 3.0), (2.0, 30.0), (10.0, 1.0), (50.0, 100.0)])
def test_roll_of_a_pushbroom_in_degrees(tmp_path, rate, roll_px):
    model = shaken(rate, roll_px)
    lon, lat = model.image_to_ground(np.array([[3000.0, 3000.0]]), 400.0)[0, :2]
    step = 2.5 / 111e3
    grid = Grid(pyproj.CRS(4326), lon - 120 * step, lat + 250 * step, step, step, 240, 500)
    worst, count, result = compare(model, (6000, 6000), grid, tmp_path, height=400.0)
    assert count == grid.width * grid.height
    assert worst - ROUNDING <= result.max_error_px <= TOLERANCE / 2
    assert result.max_error_px > 0 or result.finest_spacing == 1


class Jerk(Trembling):
    """A single jerk of half a wave, which lies between the nodes and, in a coarse output, between check points."""

    kind = "test_jerk"

    @property
    def detail(self) -> float:
        return self.length / 2

    def ground_to_image(self, ground):
        image = super().ground_to_image(ground)
        steady = (image[:, 1] < 3100) | (image[:, 1] > 3100 + self.length / 2)
        image[:, 0] -= np.where(steady, self.amplitude * np.sin(2 * np.pi * image[:, 1] / self.length + 0.3), 0.0)
        return image


def test_a_model_that_names_its_detail_hides_none(tmp_path):
    model, step = Jerk(24.0, 0.5), 4.0
    for shift in (0.0, 9.0, 37.0):
        grid = Grid(UTM, EAST - 400.0, NORTH + 600.0 + shift, step, step, 200, 300)
        worst, _, result = compare(model, (6000, 6000), grid, tmp_path, height=300.0)
        assert worst - ROUNDING <= result.max_error_px <= TOLERANCE / 2


def test_detail_of_models():
    model = shaken(50.0, 1.0)
    assert model.detail == pytest.approx(1 / 50 / 12 / model.line_period, rel=0.01)
    assert ImageCorrection.identity(model, "shift", (0.0, 0.0)).detail == model.detail
    assert drone(3000.0).detail == np.inf
