"""Notices: texts with codes, a table of all codes that is complete, and nobody who recognises a sentence."""

from __future__ import annotations

import ast
import copy
import json
import math
import pickle
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ortho_pipeline import commands
from ortho_pipeline.display.notices import FROM_SENSOR, Notice
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import PointOptions, SurfaceOptions

ROOT = Path(__file__).resolve().parent.parent.parent
SOURCES = [*ROOT.glob("ortho_pipeline/**/*.py"), *ROOT.glob("plugins/**/*.py")]


# -- what a notice is ------------------------------------------------------------------------------------------------


def test_a_notice_is_its_text():
    notice = Notice("few-points", "3 points are few", count=3)
    assert notice == "3 points are few"
    assert f"{notice}" == notice[:] == "3 points are few"
    assert json.dumps([notice]) == '["3 points are few"]'
    assert (notice.code, notice.fields) == ("few-points", {"count": 3})


def test_it_survives_the_way_to_another_process():
    notice = Notice("few-points", "3 points are few", count=3)
    for again in (pickle.loads(pickle.dumps(notice)), copy.deepcopy(notice)):
        assert (str(again), again.code, again.fields) == (str(notice), notice.code, notice.fields)


def test_it_stays_as_it_is():
    notice = Notice("few-points", "3 points are few", count=3)
    with pytest.raises(AttributeError, match="cannot be changed"):
        notice.code = "other"
    with pytest.raises(TypeError):
        notice.fields["count"] = 4  # type: ignore[index]


@pytest.mark.parametrize("code", ["", "Few", "few points", "few_points", "-few", "few-", "few--points"])
def test_codes_have_one_form(code):
    with pytest.raises(ValueError, match="not a notice code"):
        Notice(code, "text")


def test_fields_are_json_values():
    fields = {"worst": np.float32(0.5), "far": math.inf, "at": np.array([1.0, np.nan]), "file": Path("a")}
    plain = {"worst": 0.5, "far": None, "at": [1.0, None], "file": "a"}
    assert Notice("few-points", "few", **fields).to_json() == {"code": "few-points", "text": "few", **plain}


def test_one_of_several_images():
    notice = Notice("no-rpc", "no RPC is written").in_image("aft")
    assert notice.to_json() == {"code": "no-rpc", "text": "image aft: no RPC is written", "image": "aft"}


def test_texts_of_sensors_get_a_code_and_their_notices_keep_theirs():
    own = Notice("tinysat-dark", "taken at night")
    scene = Scene("tinysat", "a.tif", 10, 10, {}, "a.json", warnings=("mind it", own))
    assert scene.warnings == ("mind it", "taken at night")
    assert [one.code for one in scene.notices] == [FROM_SENSOR, "tinysat-dark"]


# -- all codes -------------------------------------------------------------------------------------------------------


def calls(name: str) -> Iterator[tuple[Path, ast.Call]]:
    """Yield the calls of a function in the sources, by its name."""
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if f"{name}(" in text else ():
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == name:
                yield path, node


def listed() -> list[str]:
    page = (ROOT / "docs" / "notices.md").read_text(encoding="utf-8")
    return re.findall(r"^\| `([a-z0-9-]+)` \|", page, re.MULTILINE)


def test_the_page_lists_the_codes_that_there_are():
    given = {FROM_SENSOR}
    for path, call in calls("Notice"):
        if path.name != "notices.py":
            assert isinstance(call.args[0], ast.Constant), f"{path.name}:{call.lineno}: the code stands in the call"
            given.add(call.args[0].value)
    assert sorted(listed()) == sorted(given)


def test_codes_that_are_compared_exist():
    compared = [code for path in SOURCES for code in re.findall(r'\["code"\] == "([a-z0-9-]+)"', path.read_text())]
    assert compared
    assert set(compared) <= set(listed())


# -- in documents ----------------------------------------------------------------------------------------------------


def assert_coded(document: dict, *codes: str) -> None:
    assert [one["text"] for one in document["notices"]] == document["warnings"]
    found = [one["code"] for one in document["notices"]]
    assert set(codes) <= set(found) <= set(listed())


def test_documents_of_commands_have_codes(tiny):
    tiny.write(tiny.gcps, tiny.points(1))
    points = PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid")
    assert_coded(commands.info(tiny.image))
    found = commands.fit(tiny.image, points).to_json()
    assert_coded(found, "no-redundancy", "few-check-points", "control-covers-part")
    few = next(one for one in found["notices"] if one["code"] == "few-check-points")
    assert (few["count"], few["enough"]) == (0, 30)
    compared = commands.compare(tiny.image, points, models="rpc,rpc+shift").to_json()
    assert_coded(compared, "control-covers-part")
    for row in compared["rows"]:
        assert_coded(row)
    said = commands.check(tiny.image, points=points, surface=SurfaceOptions(height=500.0))
    assert_coded(said, "no-redundancy")
