"""Rasters are whole when they get their name: files cut off anywhere are refused, full disks are typed errors."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.raster import ortho
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.pixel_types import gdal_type
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.raster.verified_writing import (
    check_written,
    close,
    gdal_errors,
    raster_output,
    require_whole,
    written,
)

GRID = Grid(parse_crs("EPSG:32633"), 500_000.0, 4_000_000.0, 1.0, 1.0, 700, 600)
NOISE = np.random.default_rng(1).integers(0, 60_000, (1, 600, 700)).astype(np.uint16)
OPTIONS = [
    ("COG", {}),
    ("COG", {"COMPRESS": "NONE"}),
    ("GTiff", {}),
    ("GTiff", {"TILED": "NO"}),
    ("GTiff", {"TILED": "NO", "COMPRESS": "LZW", "PREDICTOR": "2"}),
    ("GTiff", {"INTERLEAVE": "BAND", "COMPRESS": "DEFLATE"}),
]


def write(path, driver, options, validity="mask"):
    count = 2 if "INTERLEAVE" in options else 1
    profile = Profile(count, np.dtype(np.uint16), validity)
    with RasterWriter(path, GRID, profile, driver=driver, creation_options=options) as writer:
        writer.write(0, 0, np.repeat(NOISE, count, axis=0), np.ones((600, 700), bool))
    return path


@pytest.mark.parametrize(("driver", "options"), OPTIONS)
def test_a_file_that_is_cut_off_anywhere_is_refused(tmp_path, driver, options):
    path = write(tmp_path / "o.tif", driver, options)
    check_written(path, path, size=(700, 600))
    whole = path.read_bytes()
    cut = tmp_path / "cut.tif"
    # In a COG, the last four bytes of a block may stand behind it once more: without them nothing is missing.
    needed = len(whole) - (5 if driver == "COG" else 1)
    for length in np.unique(np.linspace(0, needed, 60).astype(int)).tolist():
        cut.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"output is incomplete|cannot be read back"):
            check_written(cut, cut, size=(700, 600))


def test_a_block_of_zeros_is_refused(tmp_path):
    """What a disk that was full for a while leaves in the middle of a compressed file."""
    path = write(tmp_path / "o.tif", "GTiff", {"COMPRESS": "DEFLATE"})
    content = bytearray(path.read_bytes())
    dataset = gdal.Open(str(path))
    offset = int(dataset.GetRasterBand(1).GetMetadataItem("BLOCK_OFFSET_1_0", "TIFF"))
    del dataset
    content[offset : offset + 1000] = bytes(1000)
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be read back"):
        check_written(path, path)


@pytest.mark.parametrize("row", [0, 1, 2])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_damaged_block_is_refused_wherever_it_is(tmp_path, column, row):
    """Of nine blocks each is read."""
    path = write(tmp_path / "o.tif", "GTiff", {"COMPRESS": "DEFLATE", "BLOCKXSIZE": "256", "BLOCKYSIZE": "256"})
    check_written(path, path)
    dataset, content = gdal.Open(str(path)), bytearray(path.read_bytes())
    offset = int(dataset.GetRasterBand(1).GetMetadataItem(f"BLOCK_OFFSET_{column}_{row}", "TIFF"))
    del dataset
    content[offset : offset + 500] = bytes(500)
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be read back"):
        check_written(path, path)


@pytest.mark.skipif(gdal.GetDriverByName("NITF") is None, reason="this GDAL was built without NITF")
@pytest.mark.parametrize(
    ("size", "last"),
    [((129, 193), (128, 192, 1, 1)), ((150, 140), (128, 128, 22, 12)), ((127, 128), (64, 64, 63, 64))],
)
def test_of_another_format_the_last_block_alone_is_read(tmp_path, monkeypatch, size, last):
    """A NITF in blocks of 64 x 64 pixels that lacks the byte of its last pixel."""
    path, asked = tmp_path / "a.ntf", []
    memory = gdal.GetDriverByName("MEM").Create("", *size, 1)
    memory.WriteArray(np.random.default_rng(2).integers(0, 255, size[::-1]).astype(np.uint8))
    close(gdal.GetDriverByName("NITF").CreateCopy(str(path), memory, options=["BLOCKXSIZE=64", "BLOCKYSIZE=64"]))
    read = gdal.Band.ReadRaster
    monkeypatch.setattr(gdal.Band, "ReadRaster", lambda band, *window: asked.append(window) or read(band, *window))
    require_whole(path)
    assert asked == [last]
    path.write_bytes(path.read_bytes()[: -64 * 64 + (last[3] - 1) * 64 + last[2] - 1])
    with pytest.raises(InputError, match="its last pixels cannot be read"):
        require_whole(path)


LIMITED = """
import resource, signal, sys
import numpy as np
from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.source import Grid
from tests_of_writer import GRID, NOISE, OPTIONS, write
from pathlib import Path
folder = Path(sys.argv[1])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
for number, (driver, options) in enumerate(OPTIONS):
    whole = write(folder / f"whole{number}.tif", driver, options).stat().st_size
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    # The small ones end within the tags, which GDAL writes when it is told of them or when the file is closed.
    for size in [8, 111, 219, 401, 673, *(whole * step // 12 for step in range(1, 12))]:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            write(folder / "limited.tif", driver, options)
        except InputError as error:
            assert "written" in str(error) or "cannot" in str(error), error
        else:
            raise SystemExit(f"{driver} {options} limited to {size} bytes of {whole} was accepted")
        assert not [path for path in folder.iterdir() if "limited" in path.name or ".part" in path.name]
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
"""


def test_no_write_limit_leaves_a_broken_file(tmp_path):
    code = f"import importlib.util as u, sys\ns = u.spec_from_file_location('tests_of_writer', {__file__!r})\n"
    code += "m = u.module_from_spec(s); sys.modules['tests_of_writer'] = m; s.loader.exec_module(m)\n" + LIMITED
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], check=False, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    # The TIFF library in GDAL 3.13 prints lines of its own, "_tiffSeekProc: No space left on device", which GDAL's
    # handlers of errors are not told of. They are true, and stand in front of the error; a traceback would not.
    assert "Exception ignored" not in done.stderr
    assert "Traceback" not in done.stderr


def test_what_gdal_says_when_it_closes_a_file_is_not_lost(tmp_path):
    """`del dataset` would print 'Exception ignored' and go on."""
    code = """
import resource, signal, sys
import numpy as np
from osgeo import gdal
from ortho_pipeline.raster.verified_writing import close, raster_output
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
with raster_output(sys.argv[1]) as temporary:
    dataset = gdal.GetDriverByName("GTiff").Create(str(temporary), 500, 500, 1, gdal.GDT_Float64)
    dataset.GetRasterBand(1).WriteArray(np.random.rand(500, 500))
    close(dataset)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "o.tif")], check=False, capture_output=True, text=True
    )
    assert "InputError" in done.stderr
    assert "the output cannot be written" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"COMPRESS": "NOPE"}, "COMPRESS"),
        ({"TILED": "MAYBE"}, "TILED"),
        ({"BLOCKXSIZE": "wide"}, "BLOCKXSIZE"),
        ({"COMPRES": "LZW"}, "COMPRES"),
    ],
)
def test_creation_options_that_gdal_would_only_warn_of_are_refused(tmp_path, options, named):
    with pytest.raises(InputError, match=named):
        write(tmp_path / "o.tif", "GTiff", options)
    assert not list(tmp_path.iterdir())


def test_creation_options_of_the_documentation_are_taken(tmp_path):
    write(tmp_path / "a.tif", "GTiff", {"compress": "zstd", "PREDICTOR": "2", "NUM_THREADS": "ALL_CPUS", "TILED": "on"})
    write(tmp_path / "b.tif", "COG", {"COMPRESS": "LERC", "OVERVIEWS": "NONE", "BLOCKSIZE": "256"})


def test_a_raster_of_a_plugin_appears_whole(tmp_path):
    with raster_output(tmp_path / "o.tif") as temporary:
        dataset = gdal.GetDriverByName("GTiff").Create(str(temporary), 20, 10, 1)
        close(dataset)
    assert [path.name for path in tmp_path.iterdir()] == ["o.tif"]


@pytest.mark.parametrize(
    ("count", "validity", "options"),
    [
        (1, "nodata", {"COMPRESS": "NONE"}), (3, "mask", {"COMPRESS": "NONE"}), (3, "mask", {"COMPRESS": "DEFLATE"}),
        (1, "nodata", {"TILED": "NO", "COMPRESS": "LZW"}), (1, "nodata", {"BLOCKXSIZE": "1024"}),
    ],
)  # fmt: skip
def test_the_order_of_blocks_does_not_depend_on_the_room_gdal_has(tmp_path, count, validity, options):
    grid = Grid(parse_crs("EPSG:32634"), 500000.0, 4300000.0, 1.0, 1.0, 1000, 900)
    noise = np.random.default_rng(0).integers(0, 999, (count, 900, 1000), dtype=np.uint16)
    if "TILED" not in options:
        options = {"TILED": "YES", "BLOCKXSIZE": "128", "BLOCKYSIZE": "128", **options}
    found, room = [], gdal.GetCacheMax()
    try:
        for megabytes in (1, 64):
            gdal.SetCacheMax(megabytes << 20)
            path = tmp_path / f"{megabytes}.tif"
            profile = Profile(count, np.dtype(np.uint16), validity, nodata=0.0 if validity == "nodata" else None)
            with RasterWriter(path, grid, profile, driver="GTiff", creation_options=options, threads=2) as writer:
                for top in range(0, 900, 512):
                    for left in range(0, 1000, 512):
                        part = noise[:, top : top + 512, left : left + 512]
                        writer.write(left, top, part, part[0] > 9)
            found.append(path.read_bytes())
    finally:
        gdal.SetCacheMax(room)
    assert found[0] == found[1]


@pytest.mark.parametrize("resolution", [(1e-10, 1.0), (1.0, 1e-10)])
def test_an_extent_too_far_from_the_origin_for_its_pixels_is_none(resolution):
    """2**52 pixels from the origin, a number does not tell one pixel from the next."""
    crs, extent = parse_crs("EPSG:32633"), (500_000.0, 4_000_000.0, 500_000.0 + 1e-6, 4_000_000.0 + 1e-6)
    with pytest.raises(InputError, match="is not an extent"):
        Grid.of_extent(crs, extent, resolution)


def test_an_extent_is_widened_to_multiples_of_the_resolution():
    """Outwards on all sides, as -tap of GDAL; one that is aligned stays."""
    crs = parse_crs("EPSG:32633")
    grid = Grid.of_extent(crs, (-7.5, 12.0, 21.0, 30.5), (2.0, 5.0), align=True)
    assert grid.extent == (-8.0, 10.0, 22.0, 35.0)
    assert (grid.width, grid.height) == (15, 5)
    assert Grid.of_extent(crs, grid.extent, (2.0, 5.0), align=True).extent == grid.extent
    with pytest.raises(InputError, match="is not a pixel size"):
        Grid.of_extent(crs, grid.extent, (2.0, 0.0))
    for side in range(4):
        turned = [value + 100.0 * (k == side) * (1 if side < 2 else -1) for k, value in enumerate(grid.extent)]
        with pytest.raises(InputError, match="is not an extent"):
            Grid.of_extent(crs, turned, (2.0, 5.0))


@pytest.mark.parametrize("driver", ["GTiff", "COG"])
def test_statistics_overviews_and_masks_go_with_the_raster_that_is_replaced(tmp_path, driver):
    """GDAL would show the picture of the old raster in the new one when it is zoomed out."""
    path, grid = tmp_path / "a.tif", Grid(parse_crs("EPSG:32636"), 5e5, 4.1e6, 10.0, 10.0, 64, 48)
    profile = Profile(1, np.dtype("u1"), "nodata", 0.0)
    for value in (200, 40):
        with RasterWriter(path, grid, profile, driver=driver) as writer:
            writer.write(0, 0, np.full((1, 48, 64), value, dtype="u1"), None)
        dataset = gdal.Open(str(path))
        # GDAL before 3.13 returns zeros if there are none.
        stored = dataset.GetRasterBand(1).GetStatistics(False, False) or [0.0, 0.0]
        assert stored[:2] in ([0.0, 0.0], [value, value])
        overview = dataset.GetRasterBand(1).GetOverview(0)
        assert overview is None or (overview.ReadAsArray() == value).all()
        assert [one.name for one in tmp_path.iterdir()] == ["a.tif"]
        dataset.GetRasterBand(1).ComputeStatistics(False)
        dataset.BuildOverviews("NEAREST", [2])
        dataset = None
        assert len([*tmp_path.iterdir()]) > 1
        (tmp_path / "a.tif.msk").write_bytes(b"")


@pytest.mark.parametrize("band", [1, 2])
def test_a_damaged_block_is_refused_in_any_band(tmp_path, band):
    """Of bands that are stored apart each is read."""
    path = write(tmp_path / "o.tif", "GTiff", {"INTERLEAVE": "BAND", "COMPRESS": "DEFLATE"})
    check_written(path, path)
    dataset, content = gdal.Open(str(path)), bytearray(path.read_bytes())
    offset = int(dataset.GetRasterBand(band).GetMetadataItem("BLOCK_OFFSET_1_0", "TIFF"))
    del dataset
    content[offset : offset + 500] = bytes(500)
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be read back"):
        check_written(path, path)


def test_absent_blocks_are_refused_unless_a_raster_may_lack_some(tmp_path):
    path = tmp_path / "o.tif"
    options = ["TILED=YES", "SPARSE_OK=TRUE"]
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 700, 600, 1, gdal.GDT_Byte, options)
    dataset.WriteRaster(0, 0, 256, 256, bytes([1]) * 256 * 256)
    close(dataset)
    check_written(path, path, sparse=True)
    with pytest.raises(InputError, match="incomplete"):
        check_written(path, path)


@pytest.mark.parametrize(
    ("rows", "options", "sparse"),
    [(600, {}, False), (599, {}, True), (600, {"SPARSE_OK": "true"}, True), (600, {"SPARSE_OK": "NO"}, False)],
)
def test_blocks_may_be_absent_where_a_part_was_written_or_the_user_allows_it(
    tmp_path, monkeypatch, rows, options, sparse
):
    asked = []
    monkeypatch.setattr(ortho, "check_written", lambda *_, sparse, size: asked.append((sparse, size)))
    profile = Profile(1, np.dtype(np.uint16), "nodata", 0.0)
    with RasterWriter(tmp_path / "o.tif", GRID, profile, driver="GTiff", creation_options=options) as writer:
        for left, right in ((0, 300), (300, 700)):
            writer.write(left, 0, NOISE[:, :rows, left:right], None)
    assert asked == [(sparse, (700, 600))]


@pytest.mark.parametrize("before", [None, "NO"])
def test_the_choice_of_a_program_where_masks_go_is_left_as_it_was(tmp_path, before):
    """Also after an error. While this package writes, masks go into the file itself."""
    option = "GDAL_TIFF_INTERNAL_MASK"
    gdal.SetThreadLocalConfigOption(option, before)
    try:
        write(tmp_path / "o.tif", "GTiff", {})
        assert gdal.GetThreadLocalConfigOption(option) == before
        with pytest.raises(InputError, match="YES is not the reason"), gdal_errors(tmp_path / "o.tif"):
            raise RuntimeError(f"{gdal.GetThreadLocalConfigOption(option)} is not the reason")
        assert gdal.GetThreadLocalConfigOption(option) == before
    finally:
        gdal.SetThreadLocalConfigOption(option, None)


@pytest.mark.parametrize("size", [(2500, 3), (3, 2500)])
@pytest.mark.parametrize(("kind", "nodata"), [("u2", 7.0), ("f4", np.nan), ("u1", None)])
def test_a_copy_of_a_raster_is_whole_and_its_valid_pixels_are_counted(tmp_path, size, kind, nodata):
    """Longer than the windows of 2048 px. Without nodata the last band is the mask, of which 1 is enough."""
    random, (width, height) = np.random.default_rng(3), size
    pixels = random.integers(10, 99, (2, height, width)).astype(kind)
    missing = random.random(pixels.shape) < 0.4
    valid = ~missing.all(axis=0)
    pixels[missing] = 0 if nodata is None else nodata
    bands = pixels if nodata is not None else np.concatenate([pixels, valid[None].astype(kind)])
    made = gdal.GetDriverByName("GTiff").Create(
        str(tmp_path / "a.tif"), width, height, len(bands), gdal_type(pixels.dtype)
    )
    made.WriteArray(bands)
    del made
    grid = Grid(GRID.crs, GRID.left, GRID.top, 1.0, 1.0, width, height)
    profile = Profile(2, pixels.dtype, "mask" if nodata is None else "nodata", nodata)
    with RasterWriter(tmp_path / "o.tif", grid, profile, driver="GTiff") as writer:
        assert writer.copy(tmp_path / "a.tif") == valid.sum()
    found = gdal.Open(str(tmp_path / "o.tif"))
    np.testing.assert_array_equal(found.ReadAsArray(), pixels)
    if nodata is None:
        np.testing.assert_array_equal(found.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0, valid)


@pytest.mark.parametrize("driver", ["GTiff", "COG"])
def test_each_band_has_its_name_scale_offset_and_unit_in_the_file(tmp_path, driver):
    scales = ((0.01, -3.0, "m"), (1.0, 0.0, ""), (1.0, 0.5, "dB"), (4.0, 0.0, ""))
    profile = Profile(4, np.dtype(np.uint16), "mask", descriptions=("a", "", "c", "d"), scales=scales)
    grid = Grid(GRID.crs, GRID.left, GRID.top, 1.0, 1.0, 9, 8)
    with RasterWriter(tmp_path / "o.tif", grid, profile, driver=driver) as writer:
        writer.write(0, 0, np.ones((4, 8, 9), np.uint16), np.ones((8, 9), bool))
    dataset = gdal.Open(str(tmp_path / "o.tif"))
    bands = [dataset.GetRasterBand(number) for number in (1, 2, 3, 4)]
    assert [band.GetDescription() for band in bands] == ["a", "", "c", "d"]
    found = [(band.GetScale() or 1.0, band.GetOffset() or 0.0, band.GetUnitType()) for band in bands]
    assert found == list(scales)


def test_of_many_blocks_the_last_in_the_file_is_read(tmp_path):
    """What a disk that was full at the end leaves. Of 110 blocks, one in nine is read besides."""
    path = write(tmp_path / "o.tif", "GTiff", {"COMPRESS": "DEFLATE", "BLOCKXSIZE": "64", "BLOCKYSIZE": "64"}, "nodata")
    check_written(path, path)
    dataset, content = gdal.Open(str(path)), bytearray(path.read_bytes())
    band = dataset.GetRasterBand(1)
    offsets = [int(band.GetMetadataItem(f"BLOCK_OFFSET_{k % 11}_{k // 11}", "TIFF")) for k in range(110)]
    del band, dataset
    assert offsets.index(max(offsets)) % 9
    content[max(offsets) : max(offsets) + 500] = bytes(500)
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be read back"):
        check_written(path, path)


def test_a_raster_of_a_plugin_is_checked_and_takes_old_files_along(tmp_path):
    """Statistics, overviews and masks of the raster that was there before. One that lacks blocks does not appear."""
    path = tmp_path / "o.tif"
    for ending in ("", ".aux.xml", ".ovr", ".msk"):
        (tmp_path / f"o.tif{ending}").write_bytes(b"old")
    options = ["TILED=YES", "SPARSE_OK=TRUE"]
    with pytest.raises(InputError, match="incomplete"), raster_output(path) as temporary:
        close(gdal.GetDriverByName("GTiff").Create(str(temporary), 300, 300, 1, gdal.GDT_Byte, options))
    assert {one.read_bytes() for one in tmp_path.iterdir()} == {b"old"}
    assert len([*tmp_path.iterdir()]) == 4
    with raster_output(path) as temporary:
        close(gdal.GetDriverByName("GTiff").Create(str(temporary), 20, 10, 1))
    assert [one.name for one in tmp_path.iterdir()] == ["o.tif"]


def test_a_dataset_that_gdal_did_not_make_is_an_error_before_it_is_used():
    with pytest.raises(RuntimeError), written(None):
        pytest.fail("there is nothing to write into")
