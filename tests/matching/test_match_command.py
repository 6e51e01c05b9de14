"""Matching as people use it: `ortho match`, `--reference` in the commands that adjust, and what they refuse."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from click.testing import CliRunner, Result
from osgeo import gdal
from scenes import UTM, Case, Setting, View, write_raster

import ortho_pipeline as op
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.control.search import search_of
from ortho_pipeline.display.numbers import metres, px
from ortho_pipeline.errors import InputError

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"

#: Small, with errors that are not noise: an affine one of the model, of the reference as a whole, and of the DEM.
SETTING = Setting(
    side=360, seed=5, error=9.0, margin=40.0, fine=1.0, scene=View(noise=0.03), reference=View(noise=0.03)
)
FEW = ("--match-points", "80")


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


@pytest.fixture(scope="module")
def written_points(case: Case, tmp_path_factory) -> tuple[Path, dict]:
    """Return a file of matches, and what `ortho match` said."""
    path = tmp_path_factory.mktemp("points") / "points.geojson"
    return path, document(matched(case, "match", "-o", path, "--json"))


@pytest.fixture(scope="module")
def rectified(case: Case, tmp_path_factory) -> Path:
    """Return the folder of an ortho that was made with a reference, in one command."""
    folder = tmp_path_factory.mktemp("rectified")
    done = matched(case, "rectify", "-o", folder, "--stac", "--acquired", "2020-01-01T00:00:00Z", "-of", "GTiff")
    assert done.exit_code == 0, done.output
    return folder


def test_match_writes_points_that_say_where_the_truth_is(case: Case, written_points: tuple[Path, dict]) -> None:
    path, said = written_points
    found = said["matching"]
    assert found["kept"] + sum(found["reasons"].values()) == found["tried"]
    assert np.sum(found["coverage"]["kept"]) == found["kept"] == found["control"] + found["check"]
    assert 0.1 < found["check"] / found["kept"] < 0.3
    off = -(case.misfit(case.model)[0][4])
    np.testing.assert_allclose(found["shift_px"], off, atol=0.1)
    points = op.read_points(path)
    truth = case.camera.image_of(points.to_crs("EPSG:32735").ground)
    assert np.sqrt(((truth - points.image) ** 2).mean()) < 0.15
    assert (points.groups >= 0).all()
    assert np.linalg.eigvalsh(points.covariance_image).min() > 0


def test_match_shows_what_it_found(case: Case, written_points: tuple[Path, dict], tmp_path: Path) -> None:
    words = ("-o", tmp_path / "points.geojson", "--report", tmp_path / "matches.html", "--json")
    found = document(matched(case, "match", *words))
    assert set(found["files"]) == {"points", "html", "report"}
    # The same as without a page.
    path, plain = written_points
    assert found["matching"] == plain["matching"]
    assert (tmp_path / "points.geojson").read_bytes() == path.read_bytes()
    numbers = json.loads((tmp_path / "matches.json").read_text())
    assert numbers["matching"]["candidates"] == plain["matching"]["candidates"]
    page = (tmp_path / "matches.html").read_text()
    assert 'data-plot="matches"' in page
    assert page.count('aria-label="Scene at m') == page.count('aria-label="Reference at m') >= 24
    worst = max(math.hypot(*one["residual"]) for one in numbers["adjustment"]["points"])
    assert f"<b>{px(worst)}</b>" in page


def test_points_and_their_page_appear_together(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that ended between the two left new points next to the page of old ones."""
    there = []

    def interrupted(*_: object, **__: object) -> None:
        there.extend(path for path in tmp_path.iterdir() if not path.name.startswith("."))
        raise KeyboardInterrupt

    monkeypatch.setattr("ortho_pipeline.report.document.write_report_html", interrupted)
    words = ("-o", tmp_path / "points.geojson", "--report", tmp_path / "points.html", "--match-points", "30")
    assert matched(case, "match", *words).exit_code != 0
    assert there == list(tmp_path.iterdir()) == []


def test_the_page_of_matches_is_a_page(case: Case, tmp_path: Path) -> None:
    refused = matched(case, "match", "-o", tmp_path / "points.csv", "--report", tmp_path / "matches.pdf")
    assert refused.exit_code == 2
    assert ".html" in refused.output
    assert not list(tmp_path.iterdir())


def test_the_page_of_an_ortho_shows_its_matches(rectified: Path) -> None:
    assert "those with the largest residuals" in (rectified / "scene_report.html").read_text()


def test_csv_says_the_same_as_geojson(case: Case, written_points: tuple[Path, dict], tmp_path: Path) -> None:
    done = matched(case, "match", "-o", tmp_path / "points.csv")
    assert done.exit_code == 0
    assert f"{written_points[1]['matching']['kept']} of " in done.output
    one, other = (op.read_points(path) for path in (written_points[0], tmp_path / "points.csv"))
    np.testing.assert_allclose(one.image, other.image, atol=1e-9)
    np.testing.assert_allclose(one.covariance_image, other.covariance_image, rtol=1e-9)
    assert (one.roles == other.roles).all()
    assert (one.groups == other.groups).all()


def test_rectify_with_a_reference_lies_where_the_truth_is(case: Case, rectified: Path) -> None:
    report = json.loads((rectified / "scene_report.json").read_text())
    model = op.load_model(rectified / "scene_model.json")
    assert np.abs(case.misfit(model)[0]).max() < 0.15
    assert {one["role"] for one in report["provenance"]["inputs"]} >= {"image", "reference", "DEM"}
    assert report["provenance"]["options"]["match"]["search"] == 30
    assert "relative-to-reference" in {one["code"] for one in report["notices"]}


# -- honest ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def moved(tmp_path_factory) -> Case:
    """A case whose reference lies 5 m east and 3 m south of the truth."""
    return Case(replace(SETTING, offset=(5.0, -3.0)), tmp_path_factory.mktemp("moved")).write()


def surveyed(case: Case, count: int = 6) -> op.Points:
    """Return points that somebody measured without error."""
    image = np.random.default_rng(2).uniform(0.1, 0.9, (count, 2)) * case.frame
    return op.Points(
        ids=tuple(f"m{k}" for k in range(count)), image=image, ground=case.ground_of(image),
        roles=np.full(count, "control"), sigma_image=np.full(count, 0.1), sigma_ground=np.zeros((count, 3)),
        crs=pyproj.CRS(UTM), source="survey",
    )  # fmt: skip


def test_measured_points_see_what_matches_cannot(moved: Case, tmp_path: Path) -> None:
    op.write_points(surveyed(moved), tmp_path / "survey.csv")
    words = ("--gcps", tmp_path / "survey.csv", "--reference-sigma", 2, "--accuracy-raster")
    done = matched(moved, "rectify", "-o", tmp_path / "out", "-of", "GTiff", *words)
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "out" / "scene_report.json").read_text())
    matching, control = report["matching"], [one for one in report["adjustment"]["points"] if one["role"] == "control"]
    assert len(control) == matching["control"]
    # The reference is off by hypot(5, 3) m: the points that were matched do not know, those measured do.
    assert matching["absolute"]["n"] == 6
    assert matching["absolute"]["m"] == pytest.approx(math.hypot(5, 3), abs=0.2)
    assert matching["relative"]["n"] == matching["check"]
    # Never in one figure.
    for rmse in (report["adjustment"]["rmse"], report["rmse_m"]):
        assert (rmse["check"]["n"], rmse["matched"]["n"]) == (6, matching["check"])
        assert rmse["check"]["total"] > 10 * rmse["matched"]["total"]
    assert report["view_rmse"]["check"]["n"] == report["covariance"]["check"]["n"] == 6
    assert matching["relative"]["m"] < 0.3
    # The 2 m are in the sigmas of the shift, once, and in the raster of accuracy, once.
    shifts = [report["adjustment"]["parameters"][name]["sigma"] for name in ("col_shift", "row_shift")]
    assert np.hypot(*shifts) == pytest.approx(2 * np.sqrt(2), rel=0.05)
    assert np.hypot(*report["accuracy"]["sigma_m"]) == pytest.approx(2 * np.sqrt(2), rel=0.05)
    assert report["accuracy"]["shares"]["reference"] > 0.9
    head = report["headline"]
    # What is read first is what the measured points say.
    assert head["metres"] == metres(matching["absolute"]["m"])
    assert "6 measured check points" in head["what"]
    assert any(note.startswith("Relative: ") and "relative to the reference" in note for note in head["notes"])
    assert any("2.00 m per axis" in note for note in head["notes"])
    # Six measured points test the scale of a map; matches do not.
    assert (report["map_scale"]["evidence"], report["map_scale"]["n"]) == ("check", 6)
    page = (tmp_path / "out" / "scene_report.html").read_text()
    assert "relative to the reference" in page
    assert "check points: measured, absolute" in page
    assert "0 times" not in page
    # The map of matches has the residuals of matches, the plot those of the others.
    assert "Residual vectors of 6 points" in page


def test_measured_points_control_if_the_user_says_so(moved: Case, tmp_path: Path) -> None:
    op.write_points(surveyed(moved), tmp_path / "survey.csv")
    words = ("--gcps", tmp_path / "survey.csv", "--gcps-as", "control", "--select", "even:4", "--json")
    found = document(matched(moved, "fit", *words))
    roles = Counter(one["role"] for one in found["points"])
    assert roles["control"] == found["matching"]["control"] + 4
    assert found["matching"]["absolute"]["n"] == 2
    notice = next(one for one in found["notices"] if one["code"] == "relative-to-reference")
    assert notice["control"] - notice["matched"] == sum(
        one["used"] for one in found["points"][:6]
    )  # those that contradict the many are left out, and named


def test_measured_points_that_only_check_say_where_the_reference_lies(moved: Case, tmp_path: Path) -> None:
    """They agree with each other: the reference is off, and none of them is to be measured again; a bad one is."""
    points = surveyed(moved)
    image = points.image.copy()
    image[2] += (6.0, 0.0)
    op.write_points(replace(points, image=image), tmp_path / "survey.csv")
    found = document(matched(moved, "fit", "--gcps", tmp_path / "survey.csv", "--json"))
    notice = next(one for one in found["notices"] if one["code"] == "reference-displaced")
    np.testing.assert_allclose(notice["reference_off_m"], (5.0, -3.0), atol=0.2)
    assert (notice["points"], "reference, and so the ortho, is displaced by +" in notice["text"]) == (5, True)
    suspects = {one["id"] for one in found["outlying"]}
    assert suspects & set(points.ids) == {points.ids[2]}


def test_measured_points_say_where_a_reference_lies_whose_sigma_is_stated(moved: Case, tmp_path: Path) -> None:
    op.write_points(surveyed(moved), tmp_path / "survey.csv")
    words = ("--gcps", tmp_path / "survey.csv", "--gcps-as", "control", "--select", "even:4", "--json")
    found = document(matched(moved, "fit", *words, "--reference-sigma", 4))
    said = found["statistics"]["common_error"]
    np.testing.assert_allclose(said["estimate_m"], (5.0, -3.0), atol=0.2)
    assert max(said["estimate_sigma_m"]) < 0.2
    assert not {"m0", "m1", "m2", "m3", "m4", "m5"} & {one["id"] for one in found["rejected"]}
    assert found["rmse"]["check"]["n"] == 2
    assert found["rmse"]["check"]["total"] < 0.3
    notice = next(one for one in found["notices"] if one["code"] == "relative-to-reference")
    assert notice["in_sigmas"]
    assert "along x" in notice["text"]


def test_of_many_points_the_worst_are_printed(case: Case, written_points: tuple[Path, dict]) -> None:
    words = ("fit", case.scene_file, "--gcps", written_points[0], *heights(case))
    points = document(ortho(*words, "--json"))["points"]
    assert len(points) > 60
    done = ortho(*words)
    lines = [line for line in done.stdout.splitlines() if line.startswith("m") and len(line.split()) == 7]
    worst = sorted(points, key=lambda one: -math.hypot(*one["residual"]))[:20]
    assert [line.split()[0] for line in lines] == [one["id"] for one in worst]
    assert f"and {len(points) - 20} points with smaller residuals" in done.stdout


def test_nothing_absolute_is_said_of_matches_alone(
    case: Case, rectified: Path, written_points: tuple[Path, dict], tmp_path: Path
) -> None:
    # In one command, from a file of matches, of a STAC item, and of the model file that came of it.
    own = json.loads((rectified / "scene_report.json").read_text())
    filed = ortho("fit", case.scene_file, "--gcps", written_points[0], *heights(case), "--json")
    for found in (own, document(filed)):
        assert found["map_scale"] is None
        assert "relative-to-reference" in {one["code"] for one in found["notices"]}
    assert own["matching"]["absolute"] is None
    assert "matched" not in own["adjustment"]["rmse"] or own["adjustment"]["rmse"]["matched"] is None
    page = (rectified / "scene_report.html").read_text()
    assert 'data-plot="matches"' in page
    assert 'data-plot="residuals"' not in page
    item = json.loads((rectified / "scene_stac.json").read_text())["properties"]
    assert not [name for name in item if name.startswith("accuracy:geometric")]
    words = ("--model", rectified / "scene_model.json", *heights(case), "-o", tmp_path / "again", "-of", "GTiff")
    again = ortho("rectify", case.scene_file, *words)
    assert again.exit_code == 0, again.output
    assert "relative to the reference" in again.output


def test_a_reference_made_of_the_scene_is_a_notice(case: Case, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert ortho("rectify", case.scene_file, *heights(case), "-o", out, "-r", "cubic", "-of", "GTiff").exit_code == 0
    words = (case.scene_file, "--reference", out / "scene_ortho.tif", *heights(case), *FEW, "--search", 20, "--json")

    def notices() -> set[str]:
        found = document(ortho("match", *words, "-o", tmp_path / "points.csv"))
        return {one["code"] for one in found["notices"]}

    # Its report names the scene; without it, no two images are that much alike.
    assert "reference-made-of-scene" in notices()
    (out / "scene_report.json").unlink()
    assert "reference-made-of-scene" in notices()


def test_the_matches_choose_the_correction(tmp_path: Path) -> None:
    # Slopes of up to 2 px at the rim; a shift would leave them.
    case = Case(replace(SETTING, kind="affine", slope=2.0), tmp_path / "affine").write()
    found = document(matched(case, "fit", "--json"))
    assert found["model"] == "rpc+affine"
    assert {one["code"]: one for one in found["notices"]}["correction-by-matches"]["correction"] == "affine"
    assert document(matched(case, "fit", "--correction", "shift", "--json"))["model"] == "rpc+shift"


# -- how far to search -----------------------------------------------------------------------------------------------


def test_the_search_is_what_the_scene_says_of_itself() -> None:
    rpc = op.open_scene(SAMPLE / "scene.tif")
    options = op.MatchOptions(reference=("ortho.tif",))
    model = replace(rpc.model, err_bias=3.0, err_rand=4.0)
    stated = replace(rpc, models={"rpc": model}, facts={})
    assert search_of(stated, options, 0.5).distance == pytest.approx(15.0)
    assert search_of(stated, replace(options, search=7.0), 0.5).distance == 7.0
    # Never less than a few pixels: ERR_BIAS of a centimetre is a vendor's way to say nothing.
    assert (
        search_of(replace(stated, models={"rpc": replace(model, err_bias=0.01, err_rand=0.0)}), options, 0.5).distance
        == 4.0
    )
    unknown = replace(stated, models={"rpc": replace(model, err_bias=None, err_rand=None)})
    assert search_of(replace(unknown, accuracy=5.0), options, 0.5).distance == pytest.approx(15 * math.sqrt(2))
    found = search_of(unknown, options, 1.0)
    assert (found.distance, found.known) == (100.0, False)
    assert search_of(unknown, options, 0.01).distance == pytest.approx(0.25 * 0.01 * min(unknown.width, unknown.height))


def test_the_search_of_a_frame_is_what_its_orientation_is_known_to() -> None:
    bilsat = op.open_scene(SAMPLE / "bilsat" / "bilsat.tif")
    doubled = {name: op.Prior(prior.mean, 2 * prior.sigma) for name, prior in bilsat.priors.items()}
    found = search_of(replace(bilsat, priors=doubled), op.MatchOptions(), 226.0)
    # 300 m of position and 0.02 degrees of attitude from 694 km, doubled: 600 m and 484 m on the ground per axis.
    assert "parameters" in found.source
    assert found.distance == pytest.approx(3 * math.sqrt(2) * math.hypot(600.0, 484.0), rel=0.1)


# -- many scenes -----------------------------------------------------------------------------------------------------


def test_a_run_matches_each_scene(case: Case, tmp_path: Path) -> None:
    pipeline = tmp_path / "p.yaml"
    for name in ("scene.tif", "reference.tif", "dem.tif"):
        (tmp_path / name).symlink_to(case.folder / name)
    pipeline.write_text(
        "defaults:\n  surface: {dem: dem.tif, vertical: ellipsoid}\n"
        "  match: {reference: reference.tif, search: 30, points: 60}\nscenes:\n  - image: scene.tif\n"
    )
    root = ("--root", Path("/"))
    done = ortho("run", pipeline, *root, "--executor", "sequential")
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "out" / "scene" / "scene_report.json").read_text())
    assert report["matching"]["search_m"] == 30
    assert json.loads(ortho("run", pipeline, *root, "--list", "--json").stdout)["scenes"][0]["state"] == "done"


@pytest.mark.parametrize("command", ["rectify", "match"])
def test_the_memory_of_a_job_is_that_of_its_matching(case: Case, tmp_path: Path, monkeypatch, command: str) -> None:
    asked = []

    def match(view, targets, settings):
        asked.append(settings.memory)
        raise InputError("enough is seen")

    monkeypatch.setattr("ortho_pipeline.imaging.matching.match", match)
    memory = ("--memory", 300) if command == "rectify" else ()
    assert matched(case, command, "-o", tmp_path / "out.csv", *memory).exit_code == 2
    assert asked == [300_000_000 if memory else 512_000_000]


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


def test_references_of_nothing_and_none_are_refused(case: Case, tmp_path: Path, written: Path) -> None:
    far = tmp_path / "far.tif"
    gdal.Translate(str(far), str(case.reference_file), outputBounds=(600000, 7000600, 600600, 7000000))
    coarse, text = tmp_path / "coarse.tif", tmp_path / "text.tif"
    gdal.Translate(str(coarse), str(case.reference_file), xRes=12, yRes=12, resampleAlg="average")
    text.write_text("no raster")
    for name in (far, tmp_path / "nowhere.tif", case.folder, coarse, text):
        words = (case.scene_file, "--reference", name, *heights(case), "-o", written / "p.csv", "--json")
        error = refused(ortho("match", *words), written)
        assert (error["file"], error["field"]) == (str(name), "--reference")


def test_what_is_endless_is_refused(case: Case, tmp_path: Path, written: Path) -> None:
    pipe = tmp_path / "pipe.tif"
    os.mkfifo(pipe)
    words = (case.scene_file, *heights(case), "-o", written / "p.csv", "--json")
    for name in (pipe, "/dev/zero"):
        error = refused(ortho("match", *words, "--reference", name), written)
        assert (error["file"], error["field"]) == (str(name), "--reference")
        assert "a pipe or a device" in error["message"]
    many = ortho("match", *words, "--reference", case.reference_file, "--match-points", 10**9)
    assert refused(many, written)["field"] == "--match-points"


def test_a_model_that_is_off_by_more_than_the_search_is_refused(tmp_path: Path, written: Path) -> None:
    case = Case(replace(SETTING, error=40.0, margin=80.0), tmp_path / "far").write()
    words = (case.scene_file, "--reference", case.reference_file, "--search", 6, *heights(case))
    error = refused(ortho("rectify", *words, "-o", written, "--json"), written)
    assert error["field"] == "--reference"
    assert "--search" in error["remedy"]


def test_options_of_matching_without_a_reference_are_refused(case: Case, written: Path) -> None:
    words = (case.scene_file, *heights(case), "-o", written, "--json")
    for flag, value in (("--search", 5), ("--match-points", 9), ("--reference-sigma", 1), ("--gcps-as", "control")):
        assert refused(ortho("rectify", *words, flag, value), written)["field"] == flag


def test_matching_needs_heights(case: Case, written: Path) -> None:
    words = (case.scene_file, "--reference", case.reference_file, "--json")
    assert refused(ortho("match", *words, "-o", written / "p.csv"), written)["field"] == "--dem"
    assert refused(ortho("fit", *words), written)["field"] == "--dem"
