"""Matching as people use it: `ortho match`, `--reference` in the commands that adjust, and what they refuse."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from osgeo import gdal
from scenes import Case, Setting, write_raster

import ortho_pipeline as op
from ortho_pipeline.cli.program import cli

#: Small, with errors that are not noise: an affine one of the model, of the reference as a whole, and of the DEM.
SETTING = Setting(side=420, seed=5, error=9.0, margin=40.0)
FEW = ("--match-points", "120")


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return Case(SETTING, tmp_path_factory.mktemp("matched")).write()


def ortho(*words: object) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words])


def heights(case: Case) -> tuple[str, ...]:
    return ("--dem", str(case.dem_file), "--dem-vertical", "ellipsoid")


def matched(case: Case, command: str, *words: object) -> Result:
    given = (case.scene_file, "--reference", case.reference_file, "--search", 30, *heights(case), *FEW, *words)
    return ortho(command, *given)


def document(done: Result) -> dict:
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_match_writes_points_that_say_where_the_truth_is(case: Case, tmp_path: Path) -> None:
    found = document(matched(case, "match", "-o", tmp_path / "points.geojson", "--json"))["matching"]
    assert found["kept"] + sum(found["reasons"].values()) == found["tried"]
    assert np.sum(found["coverage"]["kept"]) == found["kept"] == found["control"] + found["check"]
    assert 0.1 < found["check"] / found["kept"] < 0.3
    off = -(case.misfit(case.model)[0][4])
    np.testing.assert_allclose(found["shift_px"], off, atol=0.1)
    points = op.read_points(tmp_path / "points.geojson")
    truth = case.camera.image_of(points.to_crs("EPSG:32735").ground)
    assert np.sqrt(((truth - points.image) ** 2).mean()) < 0.15
    assert (points.groups >= 0).all()
    assert np.linalg.eigvalsh(points.covariance_image).min() > 0


def test_csv_says_the_same_as_geojson(case: Case, tmp_path: Path) -> None:
    for name in ("points.geojson", "points.csv"):
        assert matched(case, "match", "-o", tmp_path / name).exit_code == 0
    one, other = (op.read_points(tmp_path / name) for name in ("points.geojson", "points.csv"))
    np.testing.assert_allclose(one.image, other.image, atol=1e-9)
    np.testing.assert_allclose(one.covariance_image, other.covariance_image, rtol=1e-9)
    assert (one.roles == other.roles).all()
    assert (one.groups == other.groups).all()


def test_rectify_with_a_reference_lies_where_the_truth_is(case: Case, tmp_path: Path) -> None:
    done = matched(case, "rectify", "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "out" / "scene_report.json").read_text())
    model = op.load_model(tmp_path / "out" / "scene_model.json")
    assert np.abs(case.misfit(model)[0]).max() < 0.15
    assert {one["role"] for one in report["provenance"]["inputs"]} >= {"image", "reference", "DEM"}
    assert report["provenance"]["options"]["match"]["search"] == 30
    assert "relative-to-reference" in {one["code"] for one in report["notices"]}


# -- refused ---------------------------------------------------------------------------------------------------------


def refused(done: Result, folder: Path) -> dict:
    assert done.exit_code == 2, done.output
    assert not list(folder.iterdir()), "nothing is written"
    error = json.loads(done.stdout)["error"]
    assert error["remedy"]
    return error


@pytest.fixture
def written(tmp_path: Path) -> Path:
    (tmp_path / "written").mkdir()
    return tmp_path / "written"


def test_a_reference_without_crs_is_refused(case: Case, tmp_path: Path, written: Path) -> None:
    bare = tmp_path / "bare.tif"
    write_raster(bare, [np.full((9, 9), 0.5)], "uint8", place=(0, 1, 0, 0, 0, -1))
    error = refused(
        ortho("match", case.scene_file, "--reference", bare, *heights(case), "-o", written / "p.csv", "--json"), written
    )
    assert (error["file"], error["field"]) == (str(bare), "--reference")


def test_the_scene_as_its_own_reference_is_refused(case: Case, tmp_path: Path, written: Path) -> None:
    view = tmp_path / "view.vrt"
    gdal.Translate(str(view), str(case.scene_file), outputSRS="EPSG:4326", outputBounds=(0, 1, 1, 0))
    words = ("--root", case.folder, *heights(case), "-o", written / "p.csv", "--json")
    error = refused(ortho("match", case.scene_file, "--reference", view, *words), written)
    assert error["field"] == "--reference"
    assert "itself" in error["message"]


def test_a_reference_elsewhere_and_a_missing_one_are_refused(case: Case, tmp_path: Path, written: Path) -> None:
    far = tmp_path / "far.tif"
    gdal.Translate(str(far), str(case.reference_file), outputBounds=(600000, 7000600, 600600, 7000000))
    for name in (far, tmp_path / "nowhere.tif", case.folder):
        words = (case.scene_file, "--reference", name, *heights(case), "-o", written / "p.csv", "--json")
        error = refused(ortho("match", *words), written)
        assert (error["file"], error["field"]) == (str(name), "--reference")


def test_a_model_that_is_off_by_more_than_the_search_is_refused(tmp_path: Path, written: Path) -> None:
    case = Case(replace(SETTING, error=40.0, margin=80.0), tmp_path / "far").write()
    words = (case.scene_file, "--reference", case.reference_file, "--search", 6, *heights(case))
    error = refused(ortho("rectify", *words, "-o", written, "--json"), written)
    assert error["field"] == "--reference"
    assert "--search" in error["remedy"]


def test_options_of_matching_without_a_reference_are_refused(case: Case, written: Path) -> None:
    words = (case.scene_file, *heights(case), "-o", written, "--json")
    for flag, value in (("--search", 5), ("--match-points", 9), ("--dem-sigma", 1), ("--gcps-as", "control")):
        assert refused(ortho("rectify", *words, flag, value), written)["field"] == flag


def test_matching_needs_heights(case: Case, written: Path) -> None:
    words = (case.scene_file, "--reference", case.reference_file, "--json")
    assert refused(ortho("match", *words, "-o", written / "p.csv"), written)["field"] == "--dem"
    assert refused(ortho("fit", *words), written)["field"] == "--dem"
