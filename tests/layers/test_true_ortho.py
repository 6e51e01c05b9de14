"""A true ortho of a city block from two opposite views: each hides what the other sees, the mosaic has all of it."""

from __future__ import annotations

import numpy as np
import orthos
from blocks import FLOOR, City, Parallel, towards
from osgeo import gdal
from scipy.ndimage import binary_dilation

from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.warp.mosaic import Ortho, lay_out, owners_of, write_cog
from ortho_pipeline.warp.quality.hiding import Hiding

#: Houses with streets between them, some of them narrow; each roof has a brightness of its own.
BLOCK = City(tuple(
    (24 + 44 * i, 24 + 52 * j, 24 + 44 * i + 24 + 4 * (j % 2), 24 + 52 * j + 30, 8.0 + 3.0 * ((3 * i + 2 * j) % 5))
    for i in range(5) for j in range(4)
))  # fmt: skip
STREET, STEP = 20, 11


def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return what lies at places: a roof's own value, or the street."""
    out = np.full(x.shape, STREET, dtype=np.uint8)
    for number, (west, south, east, north, _) in enumerate(BLOCK.boxes, start=1):
        out[(x >= west) & (x <= east) & (y >= south) & (y <= north)] = STREET + STEP * number
    return out


def seen(off_nadir: float, azimuth: float) -> np.ndarray:
    """Return the image of a view: each pixel's ray is walked down to the first roof or street; walls are 1."""
    east, north = towards(off_nadir, azimuth)
    count = int(BLOCK.side / 0.5)
    columns, rows = np.meshgrid(np.arange(count) + 0.5, np.arange(count) + 0.5)
    x, y, height = 0.5 * columns, BLOCK.side - 0.5 * rows, np.zeros((count, count))
    for level in np.arange(22.0, 0.0, -0.25):
        inside = BLOCK.heights(x + east * level, y + north * level) >= level
        height = np.where((height == 0) & inside, level, height)
    place = x + east * height, y + north * height
    return np.where(np.abs(BLOCK.heights(*place) - height) > 0.3, 1, painted(*place)).astype(np.uint8)


def made(tmp_path, name: str, azimuth: float, surface, *, hide: bool):
    model, grid = Parallel(*towards(25, azimuth), 0.5, BLOCK.side), BLOCK.grid()
    image = seen(25, azimuth)
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / f"{name}.tif"), *image.shape[::-1], 1, gdal.GDT_Byte)
    dataset.WriteArray(image)
    dataset.GetRasterBand(1).SetNoDataValue(0)
    dataset = None
    path = tmp_path / f"{name}_ortho.tif"
    target = Hiding(path, (FLOOR, FLOOR + 25)) if hide else path
    orthos.rectify(model, RasterSource(tmp_path / f"{name}.tif"), surface, grid, target, resampling="nearest")
    return Ortho(name, path, float(np.tan(np.radians(25))))


def test_two_opposite_views_show_all_of_a_block_and_nothing_twice(tmp_path):
    surface = BLOCK.surface(tmp_path / "dsm.tif", 0.25)
    orthos = [made(tmp_path, name, azimuth, surface, hide=True) for name, azimuth in (("west", 270.0), ("east", 90.0))]
    write_cog(lay_out(orthos), tmp_path / "mosaic.tif")
    found = gdal.Open(str(tmp_path / "mosaic.tif")).ReadAsArray()
    x, y = BLOCK.places(BLOCK.grid())
    inner = (x > 12) & (x < BLOCK.side - 12)  # beyond, one of the views has no image
    truth = painted(x, y)
    edge = binary_dilation(_edges(truth), iterations=2)
    one = gdal.Open(str(orthos[0].path)).ReadAsArray()
    assert (one[inner] > 0).mean() < 0.95
    assert (found[inner] > 0).mean() >= 0.995
    # Away from edges every pixel is what the ground truth has there, so no roof is shown a second time.
    clear = inner & ~edge & (found > 0)
    assert (found[clear] == truth[clear]).mean() > 0.9999
    # Seams that move take nothing away, and show nothing twice either.
    placed = lay_out(orthos)
    write_cog(placed, tmp_path / "seams.tif", owners=owners_of(placed, None, seamlines=True))
    moved = gdal.Open(str(tmp_path / "seams.tif")).ReadAsArray()
    np.testing.assert_array_equal(moved > 0, found > 0)
    assert (moved[clear] == truth[clear]).mean() > 0.9999
    plain = made(tmp_path, "plain", 270.0, surface, hide=False)
    twice = gdal.Open(str(plain.path)).ReadAsArray()
    assert (twice[clear] != truth[clear]).mean() > 0.02


def _edges(values: np.ndarray) -> np.ndarray:
    out = np.zeros(values.shape, dtype=bool)
    out[:, 1:] |= values[:, 1:] != values[:, :-1]
    out[1:] |= values[1:] != values[:-1]
    return out
