"""Which pixels of two orthos belong together for pan-sharpening, where their grids begin at different places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.pansharpened import CommonExtent, Pansharpened, brovey, upsampled
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.raster.source import Grid, RasterSource

UTM = pyproj.CRS("EPSG:32636")
#: Pixels whose multiples are no exact numbers.
PIXEL, RATIO, WEIGHTS = 0.3, 4, (0.4, 0.6)
CORNER = (512_000.0, 4_123_000.0)


def place(left: int, top: int, width: int, height: int, ratio: int = 1) -> Grid:
    """Return a grid that begins at panchromatic pixels from the corner, with pixels of so many of these."""
    side = PIXEL * ratio
    return Grid(UTM, CORNER[0] + PIXEL * left, CORNER[1] - PIXEL * top, side, side, width, height)


def write(path: Path, grid: Grid, pixels: np.ndarray, nodata: float | None = None) -> Path:
    kinds = {"uint16": gdal.GDT_UInt16, "uint32": gdal.GDT_UInt32, "float32": gdal.GDT_Float32}
    kind = kinds[pixels.dtype.name]
    made = gdal.GetDriverByName("GTiff").Create(str(path), grid.width, grid.height, len(pixels), kind)
    made.SetGeoTransform(grid.geotransform)
    made.SetProjection(grid.crs.to_wkt())
    made.WriteArray(pixels)
    for number in range(len(pixels) if nodata is not None else 0):
        made.GetRasterBand(number + 1).SetNoDataValue(nodata)
    return path


def opened(pan: Path, colours: Path) -> Pansharpened:
    sources = RasterSource(pan), RasterSource(colours)
    return Pansharpened(*sources, (grid_of(pan), grid_of(colours)), WEIGHTS, Profile.of(sources[1]))


@pytest.mark.parametrize(
    ("pan", "colours", "common", "whole"),
    [
        # (left, top, width, height): colours begin 30 and 22 pixels before, and reach beyond; three of them are added.
        ((0, 0, 18, 15), (-30, -22, 20, 30), (0, 0, 18, 15), (-14, -14, 44, 44)),
        # They begin within, and nothing is added where there are none.
        ((0, 0, 60, 50), (6, 9, 9, 8), (6, 9, 36, 32), (6, 9, 36, 32)),
        ((0, 0, 40, 40), (-2, 5, 20, 20), (0, 5, 40, 35), (-2, 5, 56, 48)),
        ((100, 60, 13, 10), (2, 4, 50, 50), (100, 60, 13, 10), (86, 48, 40, 36)),
    ],
)  # fmt: skip
def test_the_common_extent_is_widened_to_whole_colours_and_three_more(pan, colours, common, whole) -> None:
    found = CommonExtent.of(place(*pan), place(*colours, RATIO))
    assert found.ratio == RATIO
    for grid, (left, top, width, height) in ((found.grid, common), (found.whole, whole)):
        assert (grid.width, grid.height) == (width, height)
        assert grid.left == pytest.approx(CORNER[0] + PIXEL * left, abs=1e-6)
        assert grid.top == pytest.approx(CORNER[1] - PIXEL * top, abs=1e-6)


@pytest.mark.parametrize(("pan", "colours"), [((57, 29, 71, 83), (1, 2, 48, 47)), ((3, 6, 170, 170), (19, 27, 31, 29))])
def test_a_part_of_a_scene_has_the_pixels_of_the_scene(tmp_path: Path, pan, colours) -> None:
    """Cut at any place, for either ortho: more than three colours from a cut, GDAL's kernel has the same pixels."""
    random = np.random.default_rng(5)
    sharp = random.integers(300, 900, (1, 192, 192)).astype(np.uint16)
    wide = random.integers(300, 900, (2, 48, 48)).astype(np.uint16)
    # Whole colours are cut: the panchromatic grid begins as many pixels from theirs as the cuts say.
    first = (colours[0] // RATIO, colours[1] // RATIO)
    colours = (RATIO * first[0], RATIO * first[1], min(colours[2], 48 - first[0]), min(colours[3], 48 - first[1]))
    part = sharp[:, pan[1] : pan[1] + pan[3], pan[0] : pan[0] + pan[2]]
    some = wide[:, first[1] : first[1] + colours[3], first[0] : first[0] + colours[2]]
    whole = opened(
        write(tmp_path / "p.tif", place(0, 0, 192, 192), sharp),
        write(tmp_path / "m.tif", place(0, 0, 48, 48, RATIO), wide),
    )
    image = opened(
        write(tmp_path / "q.tif", place(pan[0], pan[1], part.shape[2], part.shape[1]), part),
        write(tmp_path / "n.tif", place(*colours, RATIO), some),
    )
    left, top = max(pan[0], colours[0]), max(pan[1], colours[1])
    grid = image.overlap.grid
    assert grid.left == pytest.approx(CORNER[0] + PIXEL * left, abs=1e-6)
    wanted = whole.read(left, top, grid.width, grid.height)[0]
    found, valid = image.read(0, 0, grid.width, grid.height)
    assert valid.all()
    assert wanted.min() > 0
    inside = (slice(None), slice(14, -14), slice(14, -14))
    np.testing.assert_array_equal(found[inside], wanted[inside])
    np.testing.assert_array_equal(image.read(20, 17, 30, 25)[0], found[:, 17:42, 20:50])


def test_a_window_is_all_valid_if_its_pixels_and_three_colours_about_it_are(tmp_path: Path) -> None:
    """Empty colours, two of them at a side, and an empty panchromatic pixel; the orthos begin at different places."""
    sharp, wide = np.full((1, 120, 130), 500, np.uint16), np.full((2, 40, 40), 400, np.uint16)
    sharp[0, 100, 90] = 1
    holes = [(14, 17), (0, 27), (33, 0)]
    for column, row in holes:
        wide[:, row, column] = 2
    pan = write(tmp_path / "p.tif", place(9, 6, 130, 120), sharp, 1)
    image = opened(pan, write(tmp_path / "m.tif", place(2, 3, 40, 40, RATIO), wide, 2))
    width, height = 7, 6
    for left, top in [*((left, top) for left in range(120) for top in (0, 63, 97)), *((60, top) for top in range(110))]:
        column, row = left + 7, top + 3  # from the first colour
        hidden = left <= 90 < left + width and top <= 100 < top + height
        for hole in holes:
            hidden |= all(
                begin // RATIO - 3 <= place < -(-(begin + size) // RATIO) + 3
                for begin, size, place in zip((column, row), (width, height), hole, strict=True)
            )
        assert image._all_valid(left, top, width, height) is not hidden


def test_pixels_without_a_value_have_that_of_the_product(tmp_path: Path) -> None:
    """In floating point, too, where GDAL marks them with a number of its own."""
    sharp, wide = np.full((1, 64, 64), 500, np.float32), np.full((2, 16, 16), 400, np.float32)
    sharp[0, 10, 20] = -1
    pan = write(tmp_path / "p.tif", place(0, 0, 64, 64), sharp, -1)
    pixels, valid = opened(pan, write(tmp_path / "m.tif", place(0, 0, 16, 16, RATIO), wide, -9)).read(0, 0, 64, 64)
    assert not valid[10, 20]
    assert valid.sum() == 64 * 64 - 1
    np.testing.assert_array_equal(pixels[:, 10, 20], [-9, -9])
    np.testing.assert_allclose(pixels[:, valid], 500.0)


def test_nan_in_one_band_is_no_value_without_nodata(tmp_path: Path) -> None:
    sharp, wide = np.full((1, 64, 64), 500, np.uint16), np.full((2, 16, 16), 400, np.float32)
    wide[1, 5:9, 6:10] = np.nan
    pan = write(tmp_path / "p.tif", place(0, 0, 64, 64), sharp)
    pixels, valid = opened(pan, write(tmp_path / "m.tif", place(0, 0, 16, 16, RATIO), wide)).read(0, 0, 64, 64)
    assert not valid[24:32, 28:36].any()
    assert valid.mean() > 0.9
    np.testing.assert_allclose(pixels[:, valid], 500.0)


@pytest.mark.parametrize(
    ("dx", "dy", "ratio"),
    # The size of a pixel times 40 columns or 50 rows, in panchromatic pixels: up to a thousandth is rounding.
    [
        (0.9e-3 / 40, 0, 4), (1.1e-3 / 40, 0, 0), (0, 0.9e-3 / 50, 4), (0, 1.1e-3 / 50, 0), (-1.1e-3 / 40, 0, 0),
        (0, 4, 0),
    ],
)  # fmt: skip
def test_grids_nest_if_their_edges_agree_at_both_ends(dx: float, dy: float, ratio: int) -> None:
    pan = Grid(UTM, 1000.0, 5000.0, 1.0, 1.0, 170, 210)
    colours = Grid(UTM, 1003.0, 4996.0, 4.0 + dx, 4.0 + dy, 40, 50)
    found = CommonExtent.of(pan, colours)
    assert found.ratio == ratio
    assert found.whole is found.grid or ratio == 4


@pytest.mark.parametrize("across", [True, False])
@pytest.mark.parametrize(
    ("off", "ratio", "first", "last"),
    [(0.9e-3, 4, 3, 163), (-0.9e-3, 4, 3, 163), (1.1e-3, 0, 4, 163), (-1.1e-3, 0, 3, 162), (0.5, 0, 4, 163)],
)
def test_only_whole_panchromatic_pixels_are_common(across: bool, off: float, ratio: int, first: int, last: int) -> None:
    """Colours begin three panchromatic pixels after the first, and a part of one."""
    pan = Grid(UTM, 1000.0, 5000.0, 1.0, 1.0, 170, 170)
    move = (off, 0.0) if across else (0.0, off)
    found = CommonExtent.of(pan, Grid(UTM, 1003.0 + move[0], 4997.0 - move[1], 4.0, 4.0, 40, 40))
    xmin, ymin, xmax, ymax = found.grid.extent
    ends = ((xmin - 1000, xmax - 1000), (5000 - ymax, 5000 - ymin))
    assert ends == (((first, last), (3, 163)) if across else ((3, 163), (first, last)))
    assert found.ratio == ratio


def test_orthos_side_by_side_have_nothing_in_common() -> None:
    pan = Grid(UTM, 1000.0, 5000.0, 1.0, 1.0, 60, 40)
    for left, top in ((60, 0), (-80, 0), (0, 40), (0, -80)):
        with pytest.raises(InputError, match="do not overlap"):
            CommonExtent.of(pan, Grid(UTM, 1000.0 + left, 5000.0 - top, 4.0, 4.0, 20, 20))
        inwards = left - np.sign(left), top - np.sign(top)
        found = CommonExtent.of(pan, Grid(UTM, 1000.0 + inwards[0], 5000.0 - inwards[1], 4.0, 4.0, 20, 20)).grid
        assert (found.width, found.height) == (1 if left else 60, 1 if top else 40)


def test_arrays_are_sharpened_by_the_weighted_sum_of_their_bands() -> None:
    """The sum is 0.25 * 100 + 0.75 * 300 = 250: a panchromatic value of 500 doubles each band."""
    pan = np.full((8, 12), 500.0, np.float32)
    pan[3, 7], pan[6, 2] = 125.0, np.nan
    colours = np.stack([np.full((2, 3), 100.0), np.full((2, 3), 300.0)]).astype(np.float32)
    found = brovey(pan, upsampled(colours, 8, 12), (0.25, 0.75))
    assert (found.shape, found.dtype) == ((2, 8, 12), np.float64)
    np.testing.assert_allclose(found, np.stack([pan / 2.5, pan / 2.5 * 3]), rtol=1e-6)


@pytest.mark.parametrize("hides", ["mask", "nodata"])
def test_dark_pixels_next_to_bright_ones_are_the_same_where_others_are_empty(tmp_path: Path, hides: str) -> None:
    """Cubic convolution undershoots below 0 there; and pixels of value 0 are valid."""
    random = np.random.default_rng(1)
    wide = random.integers(40, 300, (2, 48, 48)).astype(np.uint16)
    for left, top in random.integers(0, 40, (8, 2)):
        wide[:, top : top + 6, left : left + 6] = random.integers(1500, 4000, 2)[:, None, None]
    wide[:, 30:40, 30:40] = 0
    sharp = np.kron(wide.mean(axis=0, keepdims=True), np.ones((1, RATIO, RATIO))).astype(np.uint16)
    grids = place(0, 0, 192, 192), place(0, 0, 48, 48, RATIO)
    pan, colours = (write(tmp_path / f"{n}.tif", g, p) for n, g, p in zip("pc", grids, (sharp, wide), strict=True))
    expected, everywhere = opened(pan, colours).read(0, 0, 192, 192)
    assert everywhere.all()
    nodata = 9999 if hides == "nodata" else None
    sharp[:, :4] = 9999
    holed = write(tmp_path / "h.tif", grids[0], sharp, nodata)
    if nodata is None:
        dataset = gdal.Open(str(holed), gdal.GA_Update)
        dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
        dataset.GetRasterBand(1).GetMaskBand().WriteArray((sharp[0] != 9999).astype(np.uint8) * 255)
        dataset = None
    else:
        colours = write(tmp_path / "m.tif", grids[1], wide, nodata)
    found, valid = opened(holed, colours).read(0, 0, 192, 192)
    np.testing.assert_array_equal(valid, sharp[0] != 9999)
    assert np.abs(found.astype(int) - expected)[:, 4:].max() <= 2


@pytest.mark.parametrize("window", [(0, 0, 126, 126), (125, 0, 1, 126), (3, 5, 2, 121), (100, 100, 26, 26)])
def test_any_window_of_a_masked_ortho_has_the_pixels_of_the_whole(
    tmp_path: Path, window: tuple[int, int, int, int]
) -> None:
    """The area begins in the middle of a multispectral pixel, and windows are parts of such pixels."""
    random = np.random.default_rng(2)
    sharp, wide = (random.integers(100, 900, size).astype(np.uint16) for size in ((1, 126, 126), (2, 32, 32)))
    sharp[0, 60, 60] = 7
    pan = write(tmp_path / "p.tif", place(2, 2, 126, 126), sharp, 7)
    colours = write(tmp_path / "c.tif", place(0, 0, 32, 32, RATIO), wide, 9)
    smooth = np.floor(np.clip(upsampled(wide.astype(np.float32), 128, 128)[:, 2:, 2:], 0, None) + 0.5)
    expected = np.clip(brovey(sharp[0].astype(float), smooth, WEIGHTS), 0, 65535)
    left, top, width, height = window
    here = slice(top, top + height), slice(left, left + width)
    found, valid = opened(pan, colours).read(*window)
    np.testing.assert_array_equal(valid, sharp[0][here] != 7)
    np.testing.assert_allclose(found[:, valid], expected[:, *here][:, valid], atol=0.51, rtol=1e-5)


def test_a_plane_stays_a_plane_when_it_is_upsampled() -> None:
    """Positions are those of the middles of pixels. The middle of a hole has no value, and no number comes from it."""
    rows, columns = np.mgrid[0:10, 0:15] + 0.5
    bands = np.stack([7 * columns - 3 * rows, 50 + rows]).astype(np.float32)
    found = upsampled(bands, 40, 45)
    fine_rows, fine_columns = (np.mgrid[0:40, 0:45] + 0.5) / np.array([4.0, 3.0])[:, None, None]
    inside = (slice(None), slice(8, -8), slice(6, -6))
    expected = np.stack([7 * fine_columns - 3 * fine_rows, 50 + fine_rows])
    np.testing.assert_allclose(found[inside], expected[inside], atol=2e-4)
    bands[:, 2:8, 4:11] = np.nan
    holes = upsampled(bands, 40, 45)
    assert np.isnan(holes[:, 18:22, 20:25]).all()
    for far in (slice(0, 3), slice(42, 45)):
        np.testing.assert_allclose(holes[..., far], found[..., far], atol=2e-4)


@pytest.mark.parametrize("bits", [11, 12])
def test_pixels_of_few_bits_keep_to_them(tmp_path: Path, bits: int) -> None:
    """Another nodata value in each raster, so pixels are computed in floating point."""
    sharp, wide = np.full((1, 64, 64), 60_000, np.uint16), np.full((2, 16, 16), 2000, np.uint16)
    sharp[0, 30:], sharp[0, 0, 0] = 1200, 1
    pan = write(tmp_path / "p.tif", place(0, 0, 64, 64), sharp, 1)
    colours = tmp_path / "m.tif"
    gdal.Translate(str(colours), str(write(tmp_path / "n.tif", place(0, 0, 16, 16, RATIO), wide, 2)),
                   creationOptions=[f"NBITS={bits}"])  # fmt: skip
    pixels, valid = opened(pan, colours).read(0, 0, 64, 64)
    assert not valid[0, 0]
    assert valid.sum() == 64 * 64 - 1
    np.testing.assert_array_equal(pixels[:, 5:25], 2**bits - 1)
    np.testing.assert_array_equal(pixels[:, 35:], 1200)


def test_an_ortho_that_is_nowhere_on_the_map_of_the_other_has_nothing_in_common() -> None:
    """PROJ knows no place for it. It was an overflow."""
    pan = Grid(UTM, 1000.0, 5000.0, 1.0, 1.0, 60, 40)
    site = pyproj.CRS('LOCAL_CS["a building site",UNIT["metre",1]]')
    with pytest.raises(InputError, match="do not overlap"):
        CommonExtent.of(pan, Grid(site, 1000.0, 5000.0, 4.0, 4.0, 20, 20))


def test_a_pixel_whose_weighted_sum_is_zero_becomes_zero() -> None:
    colours = np.array([[[0.0, 3.0, 200.0]], [[0.0, -1.0, 100.0]]])
    found = brovey(np.array([[500.0, 500.0, 250.0]]), colours, (0.25, 0.75))
    np.testing.assert_allclose(found, [[[0.0, 0.0, 400.0]], [[0.0, 0.0, 200.0]]])


def test_large_numbers_keep_their_digits(tmp_path: Path) -> None:
    """Beyond 2^24, beside an empty pixel: in single precision they would be even."""
    sharp = 2**27 + np.arange(64 * 64, dtype=np.uint32).reshape(1, 64, 64)
    sharp[0, 10, 20] = 7
    wide = np.full((2, 16, 16), 3, np.uint32)
    pan = write(tmp_path / "p.tif", place(0, 0, 64, 64), sharp, 7)
    pixels, valid = opened(pan, write(tmp_path / "m.tif", place(0, 0, 16, 16, RATIO), wide, 9)).read(0, 0, 64, 64)
    assert valid.sum() == 64 * 64 - 1
    np.testing.assert_array_equal(pixels[:, valid], np.repeat(sharp[:, valid[None][0]], 2, axis=0))
