"""`ortho run --dry-run` and what else `ortho run` says: everything but pixels is opened, and nothing is cut off."""

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
    done = run("run", pipeline_file, "--dry-run", "--json")
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
    text = run("run", pipeline_file, "--dry-run")
    assert f"{NAMES[0]}: rpc, rpc+shift; 11 control points, 1 check point; DEM covers 100.0 %" in text.stdout
    assert "3 scenes: 1 ready, 2 with errors" in text.stdout


def test_check_of_what_is_ready_is_exit_code_0_and_its_grid_is_that_of_the_run(pipeline_file):
    words = ["run", pipeline_file, "--only", NAMES[0]]
    checked = json.loads(run(*words, "--dry-run", "--json").stdout)["scenes"][0]
    assert run(*words, "--dry-run").exit_code == 0
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


def test_a_dry_run_refuses_truncated_files(pipeline_file, tiny):
    """A TIFF whose directory comes first opens and reads well up to where it ends."""
    whole = pipeline_file.parent / f"{NAMES[0]}.tif"
    bands = gdal.Open(str(tiny.image))
    gdal.GetDriverByName("COG").CreateCopy(str(whole), bands, options=["COMPRESS=NONE", "BLOCKSIZE=128"])
    words = ["run", pipeline_file, "--only", NAMES[0], "--dry-run"]
    assert run(*words).exit_code == 0
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size * 3 // 4])
    assert gdal.Open(str(whole)).ReadAsArray(0, 0, 10, 10) is not None
    done = run(*words)
    assert done.exit_code == 1
    assert f"{NAMES[0]}.tif: the file is truncated" in done.stdout
    dem = pipeline_file.parent / "dem.tif"
    shutil.copy(tiny.image, whole)
    dem.write_bytes(dem.read_bytes()[:-200])
    assert "dem.tif" in run(*words).stdout.replace("\n", "")


def test_a_note_of_several_scenes_is_said_once(pipeline_file):
    shutil.copy(pipeline_file.parent / f"{NAMES[0]}.tif", pipeline_file.parent / "four.tif")
    pipeline_file.write_text(pipeline_file.read_text() + "  - image: four.tif\n")
    checked = json.loads(run("run", pipeline_file, "--dry-run", "--json").stdout)["scenes"]
    (note,) = set(checked[0]["warnings"]) & set(checked[3]["warnings"])
    said = run("run", pipeline_file, "--dry-run").stdout
    assert "(2 scenes)" in said
    assert said.count("Warning: ") == len({text for one in checked for text in one.get("warnings", ())})
    assert note


def test_a_run_without_a_terminal_prints_a_line_per_scene(pipeline_file):
    words = ["run", pipeline_file, "--executor", "sequential"]
    lines = run(*words).stderr.splitlines()
    assert len(lines) == 3
    assert lines[-1].startswith("100%  ")
    assert sum(": done, " in line for line in lines) == 1
    assert sum(": failed: " in line for line in lines) == 2
    quiet = run(*words, "-q")
    assert (quiet.stdout, quiet.stderr, quiet.exit_code) == ("", "", 3)


def test_a_list_is_not_cut_off(pipeline_file):
    lines = run("run", pipeline_file, "--list").stdout.splitlines()
    assert [line.split("\t")[0] for line in lines] == NAMES
    assert lines[0].endswith(f"{NAMES[0]}.tif")
