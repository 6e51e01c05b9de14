"""The first search where the delivered model is turned, or of another scale."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scenes import Case, Setting
from trials import run, to_refuse, tried

import ortho_pipeline as op
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.control.search import rotation_of
from ortho_pipeline.imaging.turns import orientations, renderings

#: Little relief: an affine correction of the image takes a rotation up but for the relief that it turns.
PLAIN = Setting(side=500, seed=3, error=12.0, relief=5.0)
SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"


def turned(folder: Path, angle_deg: float, **changes: object) -> Case:
    """Return a case whose delivered model has a heading that is wrong by an angle."""
    setting = replace(PLAIN, **changes)
    half = setting.side / 2
    far = 60 + 1.3 * half * min(abs(math.radians(angle_deg)), 1.0)
    return Case(replace(setting, kind="attitude", slope=math.radians(angle_deg) * half, margin=far), folder).write()


class Larger(Case):
    """The delivered model has another scale."""

    def with_error(self, ground: np.ndarray) -> np.ndarray:
        middle = np.array(self.frame) / 2
        return middle + (super().with_error(ground) - middle) * 1.035

    correction = "affine"


def test_a_heading_that_is_wrong_by_40_degrees_is_found(tmp_path: Path) -> None:
    case = turned(tmp_path, 40.0, side=360)
    refused = tried(case, search=30.0, points=60)
    assert "search_rotation" in refused.refused
    found = tried(case, search=30.0, points=60, rotation_deg=42.0)
    assert found.succeeded, found
    assert found.rms < 0.05, found
    assert found.found > 40, found


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "within"), [
    (1.0, 5.0), (3.0, 5.0), (-4.4, 5.0), (5.0, 5.0), (10.0, 180.0), (40.0, 180.0), (-70.0, 180.0), (90.0, 180.0),
    (133.0, 180.0), (180.0, 180.0),
])  # fmt: skip
def test_headings_are_found_within_what_is_searched(tmp_path: Path, angle: float, within: float) -> None:
    found = tried(turned(tmp_path, angle), search=30.0, rotation_deg=within)
    assert not found.refused, found
    # Of matches and parameters: the correction that is fitted to the matches does not turn the displacement by relief.
    # With relief 0 it is off by 1 sigma at most. It shears chips.
    assert np.abs(found.z).max() < 4, found
    assert found.rms < (0.05 if within < 10 else 0.15), found


@pytest.mark.slow
def test_a_wrong_scale_is_found(tmp_path: Path) -> None:
    found = tried(Larger(PLAIN, tmp_path).write(), search=30.0, rotation_deg=5.0)
    assert found.succeeded, found
    assert found.off < 0.3, found


@pytest.mark.slow
@pytest.mark.parametrize("what", ["place", "roofs", "chessboard", "water", "beyond"])
def test_a_wider_search_does_not_find_what_is_not_there(what: str) -> None:
    for setting, search in to_refuse(what, 4):
        (row,) = run([setting], search=search, rotation_deg=5.0)
        assert row["refused"], row


def test_rotations_are_searched_only_where_no_shift_is_found(tmp_path: Path, monkeypatch) -> None:
    case = Case(replace(PLAIN, side=360), tmp_path).write()
    monkeypatch.setattr("ortho_pipeline.imaging.matching.search.renderings", None)
    assert tried(case, search=20.0, points=60, rotation_deg=5.0).succeeded


@pytest.mark.parametrize("rotation", [2.0, 5.0, 30.0, 180.0])
def test_rotations_cover_what_is_asked_for(rotation: float) -> None:
    angles = np.array([math.degrees(math.atan2(one[1, 0], one[0, 0])) for one in renderings(rotation)])
    asked = np.linspace(-rotation, rotation, 500)
    apart = np.abs((asked[:, None] - angles + 180) % 360 - 180).min(axis=1)
    assert apart.max() <= 2.01
    assert len(angles) <= 2 * rotation / 4 + 2
    assert orientations(rotation) >= 2 * rotation / 0.3


def test_what_only_metadata_give_may_be_turned() -> None:
    frame, rpc = op.open_scene(SAMPLE / "bilsat" / "bilsat.tif"), op.open_scene(SAMPLE / "scene.tif")
    assert (rotation_of(frame, op.MatchOptions()), rotation_of(rpc, op.MatchOptions())) == (5.0, 0.0)
    assert rotation_of(rpc, op.MatchOptions(search_rotation=12.0)) == 12.0
    assert orientations(0.0) == 1


@pytest.mark.parametrize("angle", ["0", "181", "-3"])
def test_angles_that_are_none_are_refused(angle: str) -> None:
    words = ["match", "scene.tif", "--reference", "r.tif", "--dem", "d.tif", "-o", "p.csv", "--json"]
    done = CliRunner().invoke(cli, [*words, "--search-rotation", angle])
    assert (done.exit_code, json.loads(done.stdout)["error"]["field"]) == (2, "--search-rotation")
