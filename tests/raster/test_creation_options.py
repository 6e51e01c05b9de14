"""Creation options of an ortho: defaults, what replaces them, and values at their limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.raster.stored_crs import stored_wkt
from ortho_pipeline.raster.verified_writing import _fits, checked_options, require_writable

TILES = {"TILED": "YES", "BLOCKXSIZE": "384", "BLOCKYSIZE": "384"}
PACKED = {"COMPRESS": "DEFLATE", "PREDICTOR": "YES", "LEVEL": "6"}


@pytest.mark.parametrize(
    ("driver", "chosen", "expected"),
    [
        ("GTiff", {}, TILES), ("GTiff", {"TILED": "no"}, {"TILED": "no"}),
        ("GTiff", {"compress": "LZW", "TILED": "YES"}, {**TILES, "COMPRESS": "LZW"}),
        ("GTiff", {"BLOCKXSIZE": "128"}, {**TILES, "BLOCKXSIZE": "128"}),
        ("COG", {}, {**PACKED, "NUM_THREADS": "3"}),
        ("COG", {"LEVEL": "9"}, {**PACKED, "NUM_THREADS": "3", "LEVEL": "9"}),
        ("COG", {"COMPRESS": "zstd"}, {**PACKED, "NUM_THREADS": "3", "COMPRESS": "zstd"}),
        ("COG", {"COMPRESS": "LZW"}, {**PACKED, "NUM_THREADS": "3", "COMPRESS": "LZW"}),
        # Others have neither a predictor nor this scale of effort.
        ("COG", {"COMPRESS": "NONE"}, {"NUM_THREADS": "3", "COMPRESS": "NONE"}),
    ],
)  # fmt: skip
def test_defaults_are_lossless_and_give_way(driver: str, chosen: dict[str, str], expected: dict[str, str]) -> None:
    assert checked_options(driver, chosen, 3, 384) == {"BIGTIFF": "IF_SAFER", **expected}


def test_there_is_always_a_thread() -> None:
    assert [checked_options("COG", {}, threads)["NUM_THREADS"] for threads in (0, 1, 2)] == ["1", "1", "2"]


@pytest.mark.parametrize(
    ("chosen", "said"),
    [
        ({"TARGET_SRS": "EPSG:3857"}, "TARGET_SRS is not allowed"), ({"COMPRESSION": "LZW"}, "no creation option"),
        ({"COMPRESS": "LZ77"}, "'LZ77' is not a value"), ({"LEVEL": "6;7"}, "'6;7' is not a value"),
    ],
)  # fmt: skip
def test_what_changes_more_than_the_layout_is_refused(chosen: dict[str, str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        checked_options("COG", chosen, 1)


@pytest.mark.parametrize(
    ("option", "allowed", "refused"),
    [
        ("PROFILE", ("GDALGeoTIFF", "gdalgeotiff"), ("GeoTIFF", "BASELINE", "baseline")),
        ("tfw", ("NO", "off"), ("YES", "true", "1")),
    ],
)
def test_metadata_stay_in_the_file(option: str, allowed: tuple[str, ...], refused: tuple[str, ...]) -> None:
    """A second file would have the temporary name of the ortho, and be lost."""
    for value in allowed:
        assert checked_options("GTiff", {option: value}, 1)[option.upper()] == value
    for value in refused:
        with pytest.raises(InputError, match=f"{option.upper()}={value} is not allowed") as caught:
            checked_options("GTiff", {option: value}, 1)
        assert caught.value.remedy == f"leave out {option.upper()}"


@pytest.mark.parametrize(
    ("option", "good", "bad"),
    [
        ('type="int" min="1" max="9"', ("1", "9", "+5"), ("0", "10", "1.5", "many")),
        ('type="int" min="1"', ("1", "99999"), ("0", "-3")), ('type="unsigned int" max="7"', ("7",), ("8", "x")),
        ('type="float" min="0" max="2.5"', ("0", "2.5", "1e-3"), ("-0.1", "2.6", "x")),
        ('type="boolean"', ("YES", "no", "True", "off", "1", "0"), ("2", "maybe")), ("", ("anything",), ()),
        ('type="string"', ("anything",), ()),
    ],
)  # fmt: skip
def test_a_value_is_of_the_type_and_within_the_limits(option: str, good: Any, bad: Any) -> None:
    element = ElementTree.fromstring(f"<Option name='X' {option}/>")
    assert [_fits(element, value) for value in (*good, *bad)] == [True] * len(good) + [False] * len(bad)


def test_a_choice_is_one_of_its_values_or_their_other_names() -> None:
    element = ElementTree.fromstring(
        "<Option name='X' type='string-select'><Value>YES</Value><Value alias='auto'>BEST</Value></Option>"
    )
    assert [_fits(element, value) for value in ("yes", "Best", "AUTO", "no")] == [True, True, True, False]
    assert _fits(ElementTree.fromstring("<Option name='X' type='string-select'/>"), "free")


@pytest.mark.parametrize(
    ("driver", "chosen", "reason"),
    [
        ("COG", {"COMPRESS": "JPEG"}, "not allowed for JPEG"),
        ("COG", {"COMPRESS": "WEBP"}, "8 bit"),
        ("COG", {"BLOCKSIZE": "500"}, "(Bad value 500|multiple of 16)"),
        ("GTiff", {"COMPRESS": "LZW", "PREDICTOR": "3"}, "PREDICTOR=3"),
        ("GTiff", {"BLOCKXSIZE": "100"}, "(Bad value 100|multiple of 16)"),
    ],
)
def test_options_that_do_not_suit_the_pixels_are_refused_at_once(
    driver: str, chosen: dict[str, str], reason: str
) -> None:
    with pytest.raises(InputError, match=f"4 bands of UInt16 .*{reason}") as refused:
        require_writable(driver, checked_options(driver, chosen, 2), 4, gdal.GDT_UInt16)
    assert "ortho_options" not in str(refused.value)


def test_an_ortho_is_refused_before_its_first_pixel(tmp_path: Path) -> None:
    grid = Grid(pyproj.CRS("EPSG:32636"), 500_000.0, 4_100_000.0, 2.0, 2.0, 8, 8)
    profile = Profile(1, np.dtype(np.uint16), "mask")
    with pytest.raises(InputError, match="1 band of UInt16"):
        RasterWriter(tmp_path / "ortho.tif", grid, profile, creation_options={"COMPRESS": "JPEG"}, threads=2)


def test_options_that_suit_the_pixels_are_accepted() -> None:
    for driver, chosen in (
        ("COG", {"COMPRESS": "JPEG"}), ("COG", {"COMPRESS": "LERC", "MAX_Z_ERROR": "0.5"}),
        ("COG", {"OVERVIEWS": "NONE"}), ("COG", {"OVERVIEW_COUNT": "2", "OVERVIEW_RESAMPLING": "NEAREST"}),
        ("GTiff", {"COMPRESS": "JPEG", "PHOTOMETRIC": "YCBCR"}), ("GTiff", {"TILED": "NO", "BLOCKYSIZE": "7"}),
        ("GTiff", {"INTERLEAVE": "BAND", "COMPRESS": "ZSTD", "PREDICTOR": "2"}),
    ):  # fmt: skip
        require_writable(driver, checked_options(driver, chosen, 2), 3, gdal.GDT_Byte)


def test_nothing_stays_in_the_memory_of_gdal(tmp_path: Path) -> None:
    """Options and the CRS are tried with files there."""
    for driver, wrong in (("GTiff", {"TILED": "YES", "BLOCKXSIZE": "100"}), ("COG", {"COMPRESS": "JPEG"})):
        require_writable(driver, checked_options(driver, {}, 1), 1, gdal.GDT_Byte)
        with pytest.raises(InputError):
            require_writable(driver, wrong, 4, gdal.GDT_UInt16)
    stored_wkt(Grid(pyproj.CRS("EPSG:32636"), 500_000.0, 4_100_000.0, 2.0, 2.0, 8, 8))
    assert [name for name in gdal.ReadDir("/vsimem/") or () if name.startswith("ortho_")] == []
