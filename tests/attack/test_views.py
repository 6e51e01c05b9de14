"""Models that a file describes and that cannot see the ground: the file is named, not the author of a plugin."""

from __future__ import annotations

import dataclasses
import json
import random
import shutil
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from ortho_pipeline.cli.program import cli
from ortho_pipeline.exchange.rpc_files import write_rpb

sys.path.insert(0, str(Path(__file__).parent))
import mutate

SAMPLES = Path(__file__).parents[2] / "sample_data"


def refusal(words: list[object]) -> dict[str, str] | None:
    """Run a command; return the document of its error, which has to be the user's, None if there is none."""
    done = CliRunner().invoke(cli, [*map(str, words), "--json"])
    if done.exit_code == 0:
        return None
    error = json.loads(done.stdout)["error"]
    assert done.exit_code == 2, error
    assert error["kind"] not in ("PluginError", "ModelError", "OrthoError")
    assert error["file"], error
    assert error["field"], error
    assert error["remedy"], error
    return error


@pytest.mark.parametrize("offset", [{"col_off": 2e5}, {"row_off": -9e4, "col_off": -9e4}])
def test_a_model_of_another_place_is_a_fault_of_its_file(tiny, offset):
    """The middle of the image is far out of the box of the RPC."""
    wrong = tiny.folder / "wrong.RPB"
    write_rpb(dataclasses.replace(tiny.model, **offset), wrong)
    out = tiny.folder / "out"
    dem = ["--dem", tiny.dem, "--dem-vertical", "ellipsoid"]
    for words in (
        ["info", tiny.image],
        ["rectify", tiny.image, "--height", "500", "-o", out],
        ["rectify", tiny.image, *dem, "-o", out],
        ["export", tiny.image, *dem, "-o", out],
    ):
        error = refusal([*words, "--rpc", wrong])
        assert error is not None
        assert "wrong.RPB" in error["file"]
        assert error["field"] == "model"
    for kind in ("gcp", "geolocation"):
        error = refusal(["export", tiny.image, "--format", kind, "-o", out, "--rpc", wrong])
        assert error is not None
    assert not out.exists() or not any(out.iterdir())


@pytest.mark.parametrize(
    ("image", "metadata"),
    [
        ("scene.tif", "scene_RPC.TXT"),
        ("cartosat/BANDA.tif", "cartosat/BANDA_MET.TXT"),
        ("bilsat/bilsat.tif", "bilsat/bilsat_survey.txt"),
    ],
)
def test_damaged_metadata_are_never_a_fault_of_a_plugin(tmp_path, image, metadata):
    """Numbers of the metadata are replaced by numbers: most are read, and then lead somewhere."""
    draw, refused = random.Random(metadata), 0
    for number in range(6):
        folder = tmp_path / str(number)
        folder.mkdir()
        shutil.copy(SAMPLES / image, folder)
        found = mutate.mutant((SAMPLES / metadata).read_bytes(), "text", draw)
        (folder / Path(metadata).name).write_bytes(found)
        done = CliRunner().invoke(cli, ["info", str(folder / Path(image).name), "--json"])
        assert done.exit_code in (0, 2), done.output
        if done.exit_code:
            error = json.loads(done.stdout)["error"]
            assert error["kind"] != "PluginError"
            assert error["file"], error
            assert error["remedy"], error
            refused += 1
    assert refused
