"""Files appear whole or not at all: when a block fails, when the disk is full, when the process is killed."""

from __future__ import annotations

import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import sha256, whole_or_nothing, write_json, write_text


def test_a_file_appears_with_the_rights_of_the_user(tmp_path):
    write_text(tmp_path / "new" / "a.txt", "grüß")
    assert (tmp_path / "new" / "a.txt").read_text(encoding="utf-8") == "grüß"
    assert stat.S_IMODE((tmp_path / "new" / "a.txt").stat().st_mode) & 0o400
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.txt"]


def test_a_json_file_has_one_member_a_line_and_no_number_that_is_none(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"a": "ü", "b": [1]})
    assert path.read_text() == '{\n "a": "\\u00fc",\n "b": [\n  1\n ]\n}\n'
    write_json(path, {"a": "ü"}, ascii_only=False)
    assert path.read_text(encoding="utf-8") == '{\n "a": "ü"\n}\n'
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"a": float("nan")})
    assert path.read_text(encoding="utf-8") == '{\n "a": "ü"\n}\n'


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.tif"
    path.write_text("old")

    def fail() -> None:
        with whole_or_nothing(path) as temporary:
            temporary.write_text("half")
            Path(f"{temporary}.aux.xml").write_text("side-car")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert path.read_text() == "old"
    assert [item.name for item in tmp_path.iterdir()] == ["a.tif"]


def test_a_folder_that_is_a_file_is_said(tmp_path):
    (tmp_path / "f").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        write_text(tmp_path / "f" / "a.txt", "x")


def test_sha256(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")  # the example of FIPS 180-2
    assert sha256(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


RECTIFY = """
import resource, signal, sys
from ortho_pipeline.warp import lattice_engine as warp
from ortho_pipeline.warp.job import WarpJob
from ortho_pipeline.raster import source as raster
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.exchange.rpc import rpc_of_dataset
image, out, driver, limit = sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4])
if limit:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
model = rpc_of_dataset(raster.open_dataset(image))[0]
grid = raster.Grid.of_extent(parse_crs("EPSG:4326"), (19.99, -30.0065, 20.01, -29.9935), (2e-6, 2e-6))
print("start", flush=True)
warp.rectify(WarpJob(model, raster.RasterSource(image), FlatSurface(500.0), grid, driver=driver), out)
"""


@pytest.mark.parametrize("driver", ["GTiff", pytest.param("COG", marks=pytest.mark.slow)])
def test_a_full_disk_leaves_the_old_ortho_and_a_message(tiny, tmp_path, driver):
    """A limit on the size of files stands for the full disk: the ortho would have 130 MB."""
    out = tmp_path / "out" / "o.tif"
    out.parent.mkdir()
    out.write_text("old")
    command = [sys.executable, "-c", RECTIFY, str(tiny.image), str(out), driver, "3000000"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "disk space" in ended.stderr
    assert out.read_text() == "old"
    assert [item.name for item in out.parent.iterdir()] == ["o.tif"]


def test_a_killed_process_leaves_the_old_ortho(tiny, tmp_path):
    out = tmp_path / "out" / "o.tif"
    out.parent.mkdir()
    out.write_text("old")
    command = [sys.executable, "-c", RECTIFY, str(tiny.image), str(out), "GTiff", "0"]
    for wait in (0.0, 0.2, 0.5):
        process = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(wait)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        # Killed before the end, or come to it: never anything in between.
        assert out.read_bytes()[:4] in (b"old", b"II*\x00", b"II+\x00")
        if out.read_bytes()[:3] != b"old":
            from osgeo import gdal

            dataset = gdal.Open(str(out))  # a band does not keep its dataset alive
            assert dataset.GetRasterBand(1).Checksum() != 0
