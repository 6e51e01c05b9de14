"""What a report says of a model that no point was measured for: delivered, or adjusted before."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ortho_pipeline as op
from ortho_pipeline import commands
from ortho_pipeline.commands import block as blocks
from ortho_pipeline.commands import results
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.exchange.model_file import read_model_file
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import FrameCamera
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.options import BlockOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.report.delivered import accuracy_before

WRONG = ("delivered", "Vendors", "5 to 25 m")


def rectify(tiny: Any, folder: Path, model: Path | None = None, **points: Any) -> results.Result:
    stated = {"crs": "EPSG:4979", "vertical": "ellipsoid"} if points else {}
    return commands.rectify(
        tiny.image, folder, scene=SceneOptions(model=model), points=PointOptions(**stated, **points),
        surface=SurfaceOptions(dem=tiny.dem, vertical="ellipsoid"), output=OutputOptions(format="GTiff"),
    )  # fmt: skip


def test_an_adjusted_model_keeps_its_accuracy(tiny, tmp_path):
    gcps = tiny.write(tmp_path / "many.csv", tiny.points(20))
    first = rectify(tiny, tmp_path / "first", gcps=gcps, check="every:2")
    earlier = first.document["report"]["headline"]
    # And so does one that went through several hands.
    second = rectify(tiny, tmp_path / "second", first.files["model"])
    third = rectify(tiny, tmp_path / "third", second.files["model"])
    for result in (second, third):
        head = result.document["report"]["headline"]
        assert head["figure"] == earlier["figure"]
        assert "10 check points" in head["what"]
        assert "10 control points" in head["what"]
        assert not [word for word in WRONG if word in result.summary + json.dumps(head)]
        assert not [word for word in WRONG[1:] if word in result.files["html"].read_text()]
    assert any("_model.json" in note for note in head["notes"])


def test_points_beside_an_adjusted_model_only_test_it(tiny, tmp_path):
    first = rectify(tiny, tmp_path / "first", gcps=tiny.gcps)
    other = tiny.write(tmp_path / "other.csv", [(f"q{row[0]}", *row[1:]) for row in tiny.points(30)])
    head = rectify(tiny, tmp_path / "second", first.files["model"], gcps=other).document["report"]["headline"]
    assert "adjusted before" in head["what"]
    assert not [word for word in WRONG if word in json.dumps(head)]


def test_a_model_of_a_block_says_so(sample, tmp_path):
    folder = sample / "cartosat"
    made = blocks.adjust(
        [folder / "BANDF.tif", folder / "BANDA.tif"], tmp_path / "adj", BlockOptions(points=folder / "points.csv")
    )
    model = next(path for path in made.files.values() if path.name == "BANDF_model.json")
    result = commands.rectify(
        folder / "BANDF.tif", tmp_path / "out", scene=SceneOptions(model=model),
        surface=SurfaceOptions(dem=folder / "dem.tif"),
    )  # fmt: skip
    head = result.document["report"]["headline"]
    truth = made.document["report"]["adjustment"]["images"]["BANDF"]["rms"]["back_projected"]["check"]
    assert head["figure"].startswith(f"{truth['total']:.2f}")
    assert f"{truth['n']} measurements of check points" in head["what"]
    assert "control points" in head["notes"][0]
    assert not [word for word in WRONG if word in result.summary]


def test_only_rpcs_come_from_vendors(tiny):
    assert "Vendors' RPCs" in accuracy_before(open_scene(tiny.image)).notes[0]
    camera = FrameCamera(Interior(6, 4, 0.01, 1e-3, 1e-3), np.array([0, 0, 500.0, 0, 0, 0]), origin=(33.0, 39.0, 0.0))
    (note,) = accuracy_before(Scene("frame", "a.tif", 6, 4, {"frame": camera}, "poses.csv")).notes
    assert note == "The model is used as it was delivered."


def test_a_model_file_of_a_delivered_model_is_no_adjustment(tiny, tmp_path):
    model = rectify(tiny, tmp_path / "out").files["model"]
    assert read_model_file(model).adjusted is None
    assert "delivered" in rectify(tiny, tmp_path / "again", model).document["report"]["headline"]["notes"][0]


@pytest.mark.parametrize(
    "adjustment",
    [
        {"gauge": "x", "parameters": {"a": 1}},
        {"gauge": "x", "sigma0": "y", "parameters": {"a": 1}, "rms": 3},
        {"points": [1], "parameters": {"a": 1}, "rmse": None},
        {"points": [{}], "parameters": {"a": 1}, "rmse": {"check": {"n": []}}},
    ],
)
def test_a_damaged_record_is_not_understood_and_no_error(tiny, tmp_path, adjustment):
    op.save_model(tiny.model, tmp_path / "m.json", adjustment=adjustment)
    scene = open_scene(tiny.image, SceneOptions(model=tmp_path / "m.json"))
    assert dict(scene.adjusted or {}) == adjustment
    head = accuracy_before(scene)
    assert head.figure == "Accuracy unknown"
    assert "adjusted before" in head.notes[0]
    assert accuracy_before(dataclasses.replace(scene, adjusted=None)).notes[0].startswith("The model is used as")
