"""Variables of the environment that would change what files are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.opening.environment import ignore_reading_options
from ortho_pipeline.raster.source import open_dataset


def _image(path: Path) -> Path:
    """Write an image whose places are those of pixel centres, with a mask, and a nodata value next to it."""
    gdal.SetThreadLocalConfigOption("GDAL_TIFF_INTERNAL_MASK", "NO")
    image = gdal.GetDriverByName("GTiff").Create(str(path), 8, 8, 1, options=["COMPRESS=DEFLATE"])
    image.SetMetadataItem("AREA_OR_POINT", "Point")
    image.SetGeoTransform((500.0, 20.0, 0.0, 900.0, 0.0, -20.0))
    image.WriteArray(np.arange(64, dtype=np.uint8).reshape(1, 8, 8))
    image.CreateMaskBand(gdal.GMF_PER_DATASET)
    image.GetRasterBand(1).GetMaskBand().WriteArray(np.tri(8, dtype=np.uint8) * 255)
    del image
    image = gdal.Open(str(path))
    image.GetRasterBand(1).SetNoDataValue(7)
    del image
    gdal.SetThreadLocalConfigOption("GDAL_TIFF_INTERNAL_MASK", None)
    return path


@pytest.mark.parametrize(
    "option",
    [
        "GTIFF_POINT_GEO_IGNORE=TRUE",
        "GDAL_PAM_ENABLED=NO",
        "GDAL_GEOREF_SOURCES=NONE",
        "GDAL_DISABLE_READDIR_ON_OPEN=EMPTY_DIR",
    ],
)
def test_options_that_change_what_is_read_are_ignored_with_a_warning(tmp_path, monkeypatch, caplog, option) -> None:
    """Places moved by half a pixel, and masks and nodata values were lost, without a word."""

    def read() -> tuple[object, ...]:
        image = open_dataset(path)
        band = image.GetRasterBand(1)
        return image.GetGeoTransform(), band.GetNoDataValue(), band.GetMaskBand().ReadAsArray().tolist()

    path = _image(tmp_path / "image.tif")
    expected = read()
    monkeypatch.setenv(*option.split("="))
    assert read() != expected, "this GDAL does not know the option"
    ignore_reading_options()
    assert read() == expected
    assert option in caplog.text


def test_the_defaults_of_gdal_are_no_reason_for_a_warning(monkeypatch, caplog) -> None:
    """`GDAL_PAM_ENABLED=YES`, GDAL's default, was called a change of what GDAL reads."""
    names = {"GDAL_PAM_ENABLED": "YES", "GDAL_DISABLE_READDIR_ON_OPEN": "false", "GTIFF_IGNORE_READ_ERRORS": "0"}
    for name, value in names.items():
        monkeypatch.setenv(name, value)
    ignore_reading_options()
    assert not caplog.text
    monkeypatch.setenv("GDAL_DISABLE_READDIR_ON_OPEN", "EMPTY_DIR")
    monkeypatch.setenv("GTIFF_REPORT_COMPD_CS", "YES")
    ignore_reading_options()
    assert caplog.text.count("is ignored") == 2


def test_damaged_blocks_are_errors_whatever_the_environment(tmp_path, monkeypatch) -> None:
    """GDAL returned what was in its memory."""
    path = _image(tmp_path / "image.tif")
    image = open_dataset(path)
    offset = int(image.GetRasterBand(1).GetMetadataItem("BLOCK_OFFSET_0_0", "TIFF"))
    del image
    content = bytearray(path.read_bytes())
    content[offset : offset + 8] = b"\xff" * 8
    path.write_bytes(content)
    monkeypatch.setenv("GTIFF_IGNORE_READ_ERRORS", "YES")
    ignore_reading_options()
    with pytest.raises(RuntimeError, match="IReadBlock"):
        open_dataset(path).ReadAsArray()


def test_the_command_line_ignores_them() -> None:
    script = (
        "import os; from ortho_pipeline.cli.program import _begin; _begin(); print('GDAL_PAM_ENABLED' in os.environ)"
    )
    surroundings = {**os.environ, "GDAL_PAM_ENABLED": "NO"}
    done = subprocess.run([sys.executable, "-c", script], env=surroundings, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


_AS_COMMAND_LINE = "from ortho_pipeline.cli.program import _begin; _begin()\n"
_OPEN = "import sys; from ortho_pipeline.raster.source import open_dataset; image = open_dataset(sys.argv[1])\n"
_REFUSED = (
    "import sys; from ortho_pipeline.errors import InputError\n"
    "from ortho_pipeline.raster.source import open_dataset\n"
    "try: open_dataset(sys.argv[1])\n"
    "except InputError as error: print(error)\n"
)


def test_options_of_a_gdalrc_do_not_reach_the_command_line(tmp_path: Path) -> None:
    """Places moved by half a pixel without a word."""
    path = _image(tmp_path / "image.tif")
    expected = open_dataset(path).GetGeoTransform()
    settings = tmp_path / "gdalrc"
    settings.write_text("[configoptions]\nGTIFF_POINT_GEO_IGNORE=TRUE\n")
    script = _AS_COMMAND_LINE + _OPEN + "print(image.GetGeoTransform())"
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)],
        env={**os.environ, "GDAL_CONFIG_FILE": str(settings)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == f"{expected}\n"
    assert "GTIFF_POINT_GEO_IGNORE=TRUE is ignored" in done.stderr


def test_options_that_a_program_sets_are_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """They are those of the program, which a library leaves alone."""
    path = _image(tmp_path / "image.tif")
    gdal.SetConfigOption("GDAL_JPEG_TO_RGB", "NO")
    try:
        open_dataset(path)
        open_dataset(path)
        assert gdal.GetConfigOption("GDAL_JPEG_TO_RGB") == "NO"
    finally:
        gdal.SetConfigOption("GDAL_JPEG_TO_RGB", None)
    assert caplog.text.count("GDAL_JPEG_TO_RGB=NO is set in this process") == 1


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("GDAL_SKIP", "COG", "GDAL_SKIP: GDAL has no driver COG"),
        ("GDAL_SKIP", "MEM,DTED", "GDAL_SKIP: GDAL has no driver MEM"),
        ("GDAL_CACHEMAX", "-5", "GDAL_CACHEMAX: GDAL cannot use this size of its cache: -5"),
        ("GDAL_CACHEMAX", "foo", "GDAL_CACHEMAX: GDAL cannot use this size of its cache: foo"),
    ],
)
def test_options_with_which_gdal_cannot_work_are_named(tmp_path: Path, name: str, value: str, message: str) -> None:
    """They were called bugs of this package, some after the ortho had been made."""
    words = [sys.executable, "-c", _REFUSED, str(_image(tmp_path / "image.tif"))]
    done = subprocess.run(words, env={**os.environ, name: value}, capture_output=True, text=True, check=True)
    assert message in done.stdout


def test_a_folder_without_the_database_of_proj_is_named(tmp_path: Path) -> None:
    """A DEM with a height datum was refused because it had none, and then the error was called a bug."""
    words = [sys.executable, "-c", _REFUSED, str(_image(tmp_path / "image.tif"))]
    surroundings = {**os.environ, "PROJ_LIB": str(tmp_path)}
    surroundings.pop("PROJ_DATA", None)
    done = subprocess.run(words, env=surroundings, capture_output=True, text=True, check=True)
    assert f"{tmp_path}: PROJ_LIB: GDAL cannot use the database of PROJ" in done.stdout
    assert "Remedy: remove the environment variable PROJ_LIB" in done.stdout


def test_a_name_that_is_not_utf_8_is_the_reason(tmp_path: Path) -> None:
    """The remedy was another format."""
    path = _image(tmp_path / "image.tif").rename(tmp_path / os.fsdecode(b"image\xff.tif"))
    with pytest.raises(InputError, match="rename the file or its folder"):
        open_dataset(path)
