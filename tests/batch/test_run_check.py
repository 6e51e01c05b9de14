"""`ortho run --check` and what else `ortho run` says: everything but pixels is opened, and nothing is cut off."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from osgeo import gdal

from ortho_pipeline.cli.program import cli
from ortho_pipeline.raster import source as raster

NAMES = ["one_with_a_name_that_is_far_longer_than_a_line_of_a_terminal_would_ever_be_and_then_some", "two", "three"]
POINTS = "{gcps: gcps.csv, crs: 'EPSG:4979', vertical: ellipsoid, check: 'ids:p1'}"


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture
def pipeline_file(tiny) -> Path:
    """Write a file of three scenes: a good one, one whose DEM ends within it, one without its points."""
    for name in NAMES:
        shutil.copy(tiny.image, tiny.folder / f"{name}.tif")
    tiny.write_dem(tiny.folder / "half.tif", share=0.5)
    file = tiny.folder / "run.yaml"
    file.write_text(
        f"defaults:\n  surface: {{dem: dem.tif, vertical: ellipsoid}}\n  points: {POINTS}\nscenes:\n"
        f"  - image: {NAMES[0]}.tif\n"
        f"  - {{image: two.tif, surface: {{dem: half.tif}}}}\n"
        f"  - {{image: three.tif, points: {{gcps: none.csv}}}}\n"
    )
    return file


def test_check_finds_what_a_run_would_and_reads_no_pixel(pipeline_file, monkeypatch):
    def read(*_: Any) -> None:
        raise AssertionError("a pixel of an image was read")

    monkeypatch.setattr(raster.RasterSource, "read", read)
    done = run("run", pipeline_file, "--check", "--json")
    assert done.exit_code == 3, done.stderr
    good, half, missing = json.loads(done.stdout)["scenes"]
    assert good["points"] == {"control": 11, "check": 1}
    assert good["coverage"] == 1.0
    assert good["grid"]["crs"] == "EPSG:32734"
    # Points carry 0.1 px of noise in each of two directions.
    assert good["rmse_px"]["control"] < 0.3
    assert half["error"]["kind"] == "CoverageError"
    assert "none.csv" in missing["error"]["file"]
    assert not (pipeline_file.parent / "out").exists()
    text = run("run", pipeline_file, "--check")
    assert f"{NAMES[0]}: rpc, rpc+shift; 11 control points, 1 check point; DEM covers 100.0 %" in text.stdout
    assert "3 scenes: 1 ready, 2 not" in text.stdout


def test_check_of_what_is_ready_is_exit_code_0_and_its_grid_is_that_of_the_run(pipeline_file):
    words = ["run", pipeline_file, "--only", NAMES[0]]
    checked = json.loads(run(*words, "--check", "--json").stdout)["scenes"][0]
    assert run(*words, "--check").exit_code == 0
    made = run(*words, "--executor", "sequential", "--json")
    assert made.exit_code == 0, made.stderr
    ortho = gdal.Open(json.loads(made.stdout)["scenes"][0]["files"]["ortho"])
    assert [ortho.RasterXSize, ortho.RasterYSize] == checked["grid"]["size"]
    facts = json.loads(made.stdout)["scenes"][0]["facts"]
    assert facts["rmse_px"]["control"] == pytest.approx(checked["rmse_px"]["control"])
    again = run(*words, "--executor", "sequential")
    assert NAMES[0] in again.stdout
    assert "unchanged" in again.stdout
    assert "1 scene: " in again.stdout


def test_a_list_is_not_cut_off(pipeline_file):
    lines = run("run", pipeline_file, "--list").stdout.splitlines()
    assert [line.split("\t")[0] for line in lines] == NAMES
    assert lines[0].endswith(f"{NAMES[0]}.tif")
