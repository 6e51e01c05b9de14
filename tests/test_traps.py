"""Traps of the field (docs/engineering/reliability.md) that no test of a module holds."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.raster.verified_writing import checked_options


@pytest.mark.parametrize("size", [(4_000_001, 1), (1, 4_000_001)])
def test_headers_of_impossible_sizes_are_refused_before_anything_is_allocated(tmp_path, size):
    path = tmp_path / "a.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *size, 1, gdal.GDT_Byte, ["SPARSE_OK=YES"])
    dataset = None
    assert dataset is None
    with pytest.raises(InputError, match="the header states"):
        open_dataset(path)


@pytest.mark.parametrize("driver", ["COG", "GTiff"])
def test_compression_is_lossless_unless_somebody_asks_for_another(driver):
    assert checked_options(driver, {}, 1).get("COMPRESS", "NONE") in ("NONE", "DEFLATE")
    assert checked_options(driver, {"COMPRESS": "JPEG"}, 1)["COMPRESS"] == "JPEG"


def test_the_rpc_of_an_image_is_used_and_not_its_control_points(tiny):
    dataset = gdal.Open(str(tiny.image), gdal.GA_Update)
    dataset.SetMetadata(rpc_metadata(tiny.model), "RPC")
    dataset.SetGCPs([gdal.GCP(10.0, 50.0, 0.0, 0.0, 0.0), gdal.GCP(11.0, 50.0, 0.0, 400.0, 0.0),
                     gdal.GCP(10.0, 51.0, 0.0, 0.0, 300.0)], "")  # fmt: skip
    dataset = None
    assert dataset is None
    found = commands.info(tiny.image)
    assert next(iter(found["models"])) == "rpc"
    lon, lat = found["corners_lon_lat"][0]
    assert abs(lon - tiny.model.lon_off) < 0.1
    assert abs(lat - tiny.model.lat_off) < 0.1


def test_every_trap_has_a_test_that_exists():
    root = Path(__file__).resolve().parent
    page = (root.parent / "docs" / "engineering" / "reliability.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| .* \| `([\w/.]+)::(\w+)` \|$", page, re.MULTILINE)
    assert [int(number) for number, _, _ in rows] == list(range(1, 46))
    for _, file, name in rows:
        assert f"def {name}(" in (root / file).read_text(encoding="utf-8"), f"{file} has no {name}"


def test_every_promise_of_security_names_tests_that_exist():
    root = Path(__file__).resolve().parent
    page = (root.parent / "SECURITY.md").read_text(encoding="utf-8")
    # Tests are named alone, after their file, or after a colon.
    names = set(re.findall(r"`(test_\w+)`", page)) | set(re.findall(r"\.py::(\w+)`", page))
    files = [root.parent / path for path in re.findall(r"`(tests/[\w/]+\.py)", page)]
    assert names
    assert not [path for path in files if not path.exists()]
    there = set(re.findall(r"^def (test_\w+)", "\n".join(path.read_text("utf-8") for path in root.rglob("*.py")), re.M))
    assert not names - there
