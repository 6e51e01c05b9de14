"""Small files that unpack to much: work is limited, not only bytes on disk."""

from __future__ import annotations

import dataclasses
import re
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from osgeo import gdal, osr

from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.raster.caching.block_cache import limit_cache
from ortho_pipeline.raster.source import RasterSource, open_dataset, open_pixels

#: Beyond the default of 512 MB.
SIDE = 24_500


def bomb(path: Path, side: int = SIDE, *, dem: bool = False, model: object = None) -> Path:
    """Write a file of some bytes whose first strip unpacks to 600 MB; nobody gets as far as its pixels."""
    options = ["COMPRESS=DEFLATE", f"BLOCKYSIZE={side}", "SPARSE_OK=TRUE"]
    made = gdal.GetDriverByName("GTiff").Create(str(path), side, side + 1, 1, gdal.GDT_Byte, options)
    if model is not None:
        made.SetMetadata(rpc_metadata(model), "RPC")
    if dem:
        reference = osr.SpatialReference()
        reference.ImportFromEPSG(4326)
        made.SetSpatialRef(reference)
        made.SetGeoTransform((19.9, 0.2 / side, 0.0, -29.9, 0.0, -0.2 / side))
    made = None
    assert path.stat().st_size < 1_000_000
    return path


def peak_memory() -> int:
    """Return the largest memory (bytes) that this process had in use."""
    return 1024 * int(re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[1])


def refused(words: list[object], *named: str) -> None:
    """Run a command that has to end with exit code 2, unpacking nothing, with its message naming what is wrong."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before = peak_memory()
    done = CliRunner().invoke(cli, [str(word) for word in words])
    assert done.exit_code == 2, done.output
    # A command that has no such option names the one of the others.
    memory = "--memory MB" if words[0] == "rectify" else "`output.memory=MB`"
    for text in (*named, "block size", "600 MB", "512 MB", "TILED=YES", memory):
        assert text in done.output, done.output
    assert peak_memory() - before < 200_000_000


def test_images_and_dems_of_one_giant_strip_are_refused(tiny, tmp_path):
    half = SIDE / 2
    model = dataclasses.replace(tiny.model, col_off=half, row_off=half, col_scale=half, row_scale=half)
    image = bomb(tmp_path / "image.tif", model=model)
    dem = bomb(tmp_path / "dem.tif", dem=True)
    out = ["-o", tmp_path / "out"]
    refused(["rectify", image, "--height", "500", *out], "image.tif")
    refused(["rectify", image, "--height", "500", "--engine", "gdal", *out], "image.tif")
    refused(["rectify", tiny.image, "--dem", dem, "--dem-vertical", "ellipsoid", *out], "dem.tif")
    refused(["edge", image], "image.tif")
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())
    # Metadata cost nothing.
    assert CliRunner().invoke(cli, ["info", str(image)]).exit_code == 0
    assert open_dataset(image).RasterXSize == SIDE
    # And whoever has the memory may use it.
    assert RasterSource(image, memory=1_000_000_000).block == SIDE * SIDE


def test_the_strip_may_be_in_a_view_or_in_a_mask(tmp_path):
    bomb(tmp_path / "inner.tif")
    gdal.Translate(str(tmp_path / "a.vrt"), str(tmp_path / "inner.tif"), format="VRT")
    gdal.GetDriverByName("GTiff").Create(
        str(tmp_path / "b.tif"), SIDE, SIDE + 1, 1, gdal.GDT_Byte, ["TILED=YES", "COMPRESS=DEFLATE", "SPARSE_OK=TRUE"]
    )
    (tmp_path / "b.tif.msk").write_bytes((tmp_path / "inner.tif").read_bytes())
    for name, inner in (("a.vrt", "inner.tif"), ("b.tif", "b.tif.msk")):
        with pytest.raises(InputError, match="600 MB") as caught:
            open_pixels(tmp_path / name)
        assert caught.value.file.endswith(inner)
    # Interleaved bands are unpacked together.
    gdal.GetDriverByName("GTiff").Create(
        str(tmp_path / "c.tif"), 15_000, 15_001, 3, gdal.GDT_Byte,
        ["COMPRESS=LZW", "BLOCKYSIZE=15000", "SPARSE_OK=TRUE", "INTERLEAVE=PIXEL"],
    )  # fmt: skip
    with pytest.raises(InputError, match="675 MB"):
        open_pixels(tmp_path / "c.tif")


@pytest.mark.parametrize(("driver", "rows"), [("GTiff", 6000), ("GTiff", 5999), ("PNG", 1)])
def test_what_is_decoded_from_its_beginning_is_decoded_once(tmp_path, driver, rows):
    """Windows of it that take turns with another image's: the cache was smaller, and each one unpacked all of it.

    A strip that is the whole image is one for which GDAL claims blocks of one row.
    """
    side = 4000
    path, other = tmp_path / "strip", tmp_path / "other.tif"
    options = ["COMPRESS=DEFLATE", f"BLOCKYSIZE={rows}"] if driver == "GTiff" else []
    made = gdal.GetDriverByName("MEM").Create("", side, side, 1)
    made.GetRasterBand(1).Fill(7)
    gdal.GetDriverByName(driver).CreateCopy(str(path), made, options=options)
    Path(f"{path}.aux.xml").unlink(missing_ok=True)
    gdal.GetDriverByName("GTiff").Create(str(other), side, side, 1, gdal.GDT_Byte, ["TILED=YES", "SPARSE_OK=TRUE"])
    before = gdal.GetCacheMax()
    try:
        gdal.SetCacheMax(16_000_000)
        source, second = RasterSource(path), RasterSource(other)
        assert limit_cache(20_000_000, 2, source.block, second.block) == 1
        source.read(0, side - 10, 10, 10)
        begin = time.process_time()
        source.read(0, 0, 10, 10)
        source.read(0, side - 20, 10, 10)
        # CPU time against CPU time of the same work: GDAL counts no decodings, and has read the file by now.
        once, spent = time.process_time() - begin, 0.0
        for top in range(0, side, 500):
            for left in range(0, side, 500):
                begin = time.process_time()
                assert (source.read(left, max(0, top - 20), 10, 500) == 7).all()
                spent += time.process_time() - begin
                second.read(0, 0, side, side)
        # 36 times before.
        assert spent < 8 * once
    finally:
        gdal.SetCacheMax(before)


def test_a_megabyte_of_one_strip_is_refused(tmp_path):
    """As it was found, a thousandth of it on the disk: one strip, which GDAL gives row by row."""
    path = tmp_path / "a.tif"
    made = gdal.GetDriverByName("GTiff").Create(
        str(path), 4000, 4000, 1, gdal.GDT_Byte, ["COMPRESS=DEFLATE", "BLOCKYSIZE=4000"]
    )
    made.GetRasterBand(1).Fill(0)
    made = None
    assert path.stat().st_size < 20_000
    assert open_dataset(path).GetRasterBand(1).GetBlockSize() == [4000, 1]
    with pytest.raises(InputError, match="16 MB"):
        RasterSource(path, memory=15_000_000)
    assert RasterSource(path, memory=16_000_000).block == 16_000_000


def test_strips_as_products_have_them_keep_cache_and_threads():
    before = gdal.GetCacheMax()
    try:
        strip = 60_000 * 2 * 4 * 16
        assert limit_cache(512_000_000, 8, strip, 30_000 * 4) == 8
        # Next to the cache each thread has room for the block that it decodes.
        assert 8 * strip <= gdal.GetCacheMax() <= 128_000_000
    finally:
        gdal.SetCacheMax(before)
