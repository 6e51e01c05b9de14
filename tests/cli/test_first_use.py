"""What a new user meets: the steps, a folder that is looked at, the file of a run, names that were nearly right."""

from __future__ import annotations

import errno
import json
import os
import shlex
import shutil
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from osgeo import gdal

from ortho_pipeline.batch.config import read_config
from ortho_pipeline.cli.program import cli
from ortho_pipeline.cli.survey.first_use import STEPS
from ortho_pipeline.commands.survey.folder import survey
from ortho_pipeline.commands.survey.pipeline_file import text

SAMPLE = Path(__file__).resolve().parent.parent.parent / "sample_data"


@pytest.mark.parametrize("word", ["--help", "-h"])
def test_help_is_on_stdout_with_json_too(word):
    assert CliRunner().invoke(cli, ["info", "--json", word]).stdout.startswith("Usage: ")


def test_an_unknown_command_names_the_nearest():
    done = CliRunner().invoke(cli, ["rectfy", "scene.tif"])
    assert done.exit_code == 2
    assert "No such command 'rectfy'; did you mean 'rectify'?" in done.output
    assert "did you mean" not in CliRunner().invoke(cli, ["xyzzy"]).output


def run(*words: Any) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("scene.tif", "scene_RPC.TXT", "dem.tif", "gcps.csv"):
        shutil.copy(SAMPLE / name, tmp_path / name)
    (tmp_path / "notes.txt").write_text("what the vendor wrote\n")
    return tmp_path


def test_without_a_word_it_shows_the_five_things_one_does():
    done = run()
    assert done.exit_code == 0
    assert len(STEPS) == 5
    for _, line in STEPS:
        assert line in done.stdout
        for part in line.split(" && "):
            _, name, *words = shlex.split(part)
            # Every option that is shown exists.
            command = cli.get_command(click.Context(cli), name)
            assert command is not None
            with command.make_context(name, words):
                pass


def test_info_of_a_folder_lists_what_is_there_and_the_next_command(folder):
    document = json.loads(run("info", folder, "--json").stdout)
    kinds = {one["path"]: one["kind"] for one in document["files"]}
    assert kinds == {"scene.tif": "scene", "dem.tif": "dem", "gcps.csv": "points"}
    command = document["next"][-1].strip()
    assert command in run("info", folder).stdout
    # It works when it is pasted, wherever one stands.
    done = run(*shlex.split(command)[1:], "--dry-run")
    assert done.exit_code == 0, done.output
    assert "12 control points, 6 check points" in done.stdout


def test_next_commands_of_several_scenes_work_when_pasted(folder, monkeypatch):
    for name in ("scene.tif", "scene_RPC.TXT"):
        shutil.copy(folder / name, folder / f"other{name.removeprefix('scene')}")
    for place, given in ((folder.parent, folder.name), (folder, "."), (Path("/"), str(folder))):
        monkeypatch.chdir(place)
        lines = [one.strip() for one in json.loads(run("info", given, "--json").stdout)["next"]]
        init, check, _ = (shlex.split(one)[1:] for one in lines if one.startswith("ortho "))
        assert run(*init, "--overwrite").exit_code == 0
        assert run(*check, "--list").stdout.count("\tnew\t") == 2


def test_init_names_the_images_that_it_skips(folder):
    shutil.copy(SAMPLE / "scene.tif", folder / "alone.tif")
    (folder / "cut.tif").write_bytes((SAMPLE / "scene.tif").read_bytes()[:100])
    said = run("init", folder)
    assert said.exit_code == 0, said.output
    assert "1 scene, 2 images skipped:\n  alone.tif: 1000 x 1000, no model" in said.stdout
    assert "cut.tif: cannot be opened" in said.stdout


def test_what_is_missing_is_named_with_the_ways_to_get_it(folder):
    for name in ("dem.tif", "gcps.csv"):
        (folder / name).unlink()
    said = run("info", folder).stdout
    for word in ("--dem auto", "--height M", "--gcps FILE", "--reference ORTHO"):
        assert word in said
    (folder / "scene_RPC.TXT").unlink()
    assert "No image has a sensor model" in run("info", folder).stdout


def test_an_image_without_a_model_gets_one_by_the_words_that_are_printed(folder):
    (folder / "scene_RPC.TXT").unlink()
    refused = run("info", folder / "scene.tif").stderr
    assert "'ortho compare' recommends one" in refused
    assert "`points." not in refused
    words = folder / "scene.tif", "--gcps", folder / "gcps.csv"
    said = run("compare", *words, "--models", "affine2d,affine3d").stdout
    assert "  Next: use --fit-model affine3d in other commands" in said
    assert run("fit", *words, "--fit-model", "affine3d").exit_code == 0


def test_outputs_are_no_inputs(folder):
    shutil.copy(SAMPLE / "dem.tif", folder / "scene_ortho.tif")
    assert "scene_ortho.tif" in survey(folder).of("dem")
    (folder / "scene_report.json").write_text("{}")
    assert "scene_ortho.tif" not in survey(folder).of("dem")


def test_a_folder_without_raw_images_is_not_asked_for_metadata(tmp_path):
    (tmp_path / "scene_report.json").write_text("{}")
    shutil.copy(SAMPLE / "reference.tif", tmp_path / "scene_ortho.tif")
    assert "No scenes found. Outputs of ortho are not listed" in run("info", tmp_path).stdout
    shutil.copy(SAMPLE / "reference.tif", tmp_path / "one.tif")
    assert f"ortho verify {tmp_path / 'one.tif'} --reference ORTHO" in run("info", tmp_path).stdout
    shutil.copy(SAMPLE / "reference.tif", tmp_path / "two.tif")
    said = run("info", tmp_path).stdout
    assert f"ortho verify {tmp_path / 'one.tif'} --reference {tmp_path / 'two.tif'}" in said
    assert "No image has a sensor model" not in said


def test_init_writes_a_file_that_a_run_takes(folder):
    done = run("init", folder)
    assert done.exit_code == 0, done.output
    checked = json.loads(run("run", folder / "pipeline.yaml", "--dry-run", "--json").stdout)
    (scene,) = checked["scenes"]
    assert (scene["points"]["control"], scene["points"]["check"], scene["coverage"]) == (12, 6, 1.0)
    again = run("init", folder)
    assert (again.exit_code, "already exists" in again.stderr) == (2, True)
    assert run("init", folder, "--overwrite").exit_code == 0
    elsewhere = run("init", folder, "-o", folder / "deeper" / "p.yaml")
    assert elsewhere.exit_code == 2


def test_points_of_which_most_are_outside_of_an_image_are_of_another_one(folder):
    gdal.Translate(str(folder / "bundle_ms.tif"), str(folder / "scene.tif"), srcWin=[0, 0, 250, 250])
    shutil.copy(folder / "scene_RPC.TXT", folder / "bundle_ms_RPC.TXT")
    seen = survey(folder)
    assert seen.beside("scene.tif", "points") == ["gcps.csv"]
    assert seen.beside("bundle_ms.tif", "points") == []


def test_init_names_scenes_of_the_same_stem_by_their_folders(folder):
    for place in ("a", "b/c"):
        (folder / place).mkdir(parents=True)
        for name in ("scene.tif", "scene_RPC.TXT"):
            shutil.copy(folder / name, folder / place / name)
    assert run("init", folder).exit_code == 0
    listed = run("run", folder / "pipeline.yaml", "--list")
    assert [line.split("\t")[0] for line in listed.stdout.splitlines() if line] == ["a_scene", "b_c_scene", "scene"]


def test_files_belong_to_the_scene_that_they_are_named_after_or_lie_beside(folder):
    deeper = folder / "two: [*]"
    deeper.mkdir()
    for name in ("left", "right"):
        shutil.copy(folder / "scene.tif", deeper / f"{name}.tif")
        shutil.copy(folder / "scene_RPC.TXT", deeper / f"{name}_RPC.TXT")
    shutil.copy(folder / "gcps.csv", deeper / "right_gcps.csv")
    shutil.copy(folder / "dem.tif", deeper / "dem.tif")
    seen = survey(folder)
    assert seen.beside("scene.tif", "points") == ["gcps.csv"]
    assert seen.beside("two: [*]/right.tif", "points") == ["two: [*]/right_gcps.csv"]
    # The one above is of the scene there.
    assert seen.beside("two: [*]/left.tif", "points") == []
    (folder / "p.yaml").write_text(text(seen), encoding="utf-8")
    left = read_config(folder / "p.yaml").scenes[1]
    assert (left.image, left.surface.dem) == ("two: [*]/left.tif", "two: [*]/dem.tif")


def test_the_only_dem_belongs_to_all_scenes_wherever_it_lies(folder):
    (folder / "heights").mkdir()
    shutil.move(folder / "dem.tif", folder / "heights" / "dem.tif")
    assert survey(folder).beside("scene.tif", "dem") == ["heights/dem.tif"]
    shutil.copy(folder / "heights" / "dem.tif", folder / "heights" / "other.tif")
    assert survey(folder).beside("scene.tif", "dem") == []


def test_the_only_points_belong_to_the_only_scene_wherever_they_lie(folder):
    for name, place in {"scene.tif": "raw", "scene_RPC.TXT": "raw", "gcps.csv": "points"}.items():
        (folder / place).mkdir(exist_ok=True)
        shutil.move(folder / name, folder / place / name)
    assert f"--gcps {folder / 'points' / 'gcps.csv'}" in run("info", folder).stdout
    assert 'points: {gcps: "points/gcps.csv"}' in text(survey(folder))
    shutil.copytree(folder / "raw", folder / "later")
    assert survey(folder).beside("raw/scene.tif", "points") == []
    assert "No control points found for later/scene.tif." in run("info", folder).stdout


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("info", "{}/sceen.tif"), "scene.tif"),
        (("fit", "{}/scene.tif", "--gcps", "{}/gcp.csv"), "gcps.csv"),
        (("rectify", "{}/scene.tif", "--dem", "{}/dem.tiff", "-o", "{}/out"), "dem.tif"),
        (("run", "{}/pipelin.yaml"), "pipeline.yaml"),
    ],
)
def test_a_file_that_is_not_there_suggests_the_one_most_like_it(folder, words, meant):
    (folder / "pipeline.yaml").write_text("scenes: []\n")
    done = run(*(word.format(folder) for word in words))
    assert done.exit_code == 2
    assert f"did you mean '{folder / meant}'?" in done.stderr


def test_a_pattern_in_quotes_is_called_one(tmp_path):
    """There was "no folder 'west*'"."""
    done = run("mosaic", tmp_path / "west*" / "*.tif", "-o", tmp_path / "mosaic.tif")
    assert done.exit_code == 2
    assert "write the pattern without quotes" in done.stderr


def test_brackets_in_the_name_of_a_folder_make_no_pattern(tmp_path):
    (tmp_path / "area [2]").mkdir()
    (tmp_path / "area [2]" / "scene.tif").touch()
    assert (
        f"did you mean '{tmp_path / 'area [2]' / 'scene.tif'}'?" in run("info", tmp_path / "area [2]/scen.tif").stderr
    )


def test_a_folder_that_is_not_there_is_named(tmp_path):
    assert "there is no folder" in run("info", tmp_path / "none" / "scene.tif").stderr


def test_a_closed_folder_and_a_link_in_a_circle_do_not_hide_the_rest(tmp_path, monkeypatch, caplog):
    """Such as the folder ``lost+found`` at the root of a disk."""
    (tmp_path / "lost+found").mkdir()
    (tmp_path / "circle.tif").symlink_to("circle.tif")
    (tmp_path / "points.csv").write_text((SAMPLE / "gcps.csv").read_text())
    scandir = os.scandir

    def closed(folder: Any) -> Any:
        if Path(folder).name == "lost+found":
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", closed)
    assert [file.path for file in survey(tmp_path).found] == ["points.csv"]
    assert "lost+found: cannot read this folder (Permission denied); it is left out" in caplog.text


def test_points_without_crs_or_datum_are_listed_and_used_in_the_next_command(folder):
    text = (folder / "gcps.csv").read_text()
    (folder / "gcps.csv").write_text("\n".join(line for line in text.splitlines() if not line.startswith("#")))
    said = run("info", folder).stdout
    assert "incomplete: the CRS of these points is unknown" in said
    assert "No control points found" not in said
    assert f"--gcps {folder / 'gcps.csv'}" in said
    assert "--points-vertical egm96" in said


def test_points_of_several_images_are_listed_and_go_to_the_adjustment(tmp_path):
    shutil.copytree(SAMPLE / "photos", tmp_path / "photos")
    shutil.copy(SAMPLE / "dem.tif", tmp_path)
    lines = [f"530000 4120000 800 100 200 photo{number}.jpg g1" for number in (1, 2)]
    gcps = tmp_path / "photos/gcp_list.txt"
    gcps.write_text("\n".join(["EPSG:32636", *lines]))
    said = run("info", tmp_path).stdout
    assert "incomplete: the height datum of these points is unknown" in said
    assert f"ortho adjust {tmp_path} --ties auto --dem {tmp_path / 'dem.tif'} --points {gcps} --dem-fill mask" in said
    for number in (2, 3):
        (tmp_path / f"photos/photo{number}.jpg").unlink()
    said = run("info", tmp_path).stdout
    assert "No control points found" not in said
    assert f"ortho rectify {tmp_path / 'photos/photo1.jpg'} --dem {tmp_path / 'dem.tif'} --gcps {gcps} -o out" in said
    gcps.write_text("\n".join(["id,image,col,row", *(f"t1,photo{number}.jpg,100,200" for number in (1, 2))]))
    said = run("info", tmp_path).stdout
    assert "0 control points, 0 check points, 1 tie point in 2 images" in said
