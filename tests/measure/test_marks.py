"""Marks: actions, undoing, and the points that they become."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ortho_measure.marks import History, Mark, mark_of, marks_of

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import write_json
from ortho_pipeline.points import read_points

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"


def whole(name: str, **more: object) -> dict:
    return {"id": name, "image": [10.5, 20.25], "ground": [33.25, 37.125, 900.0625], **more}


def history(*actions: dict) -> History:
    found = History()
    for action in ({"do": "begin", "marks": []}, *actions):
        found.take(found.after(action))
    return found


def test_undo_and_redo_lead_through_all_states() -> None:
    found = history({"do": "put", "mark": whole("A")}, {"do": "put", "mark": whole("B", image=[1, 2]), "was": "A"})
    assert list(found.marks.by_id) == ["B"]
    found.take(found.after({"do": "undo"}))
    assert found.marks.by_id["A"].image == (10.5, 20.25)
    found.take(found.after({"do": "undo"}))
    assert not found.marks.by_id
    with pytest.raises(InputError, match="nothing to undo"):
        found.after({"do": "undo"})
    found.take(found.after({"do": "redo"}))
    found.take(found.after({"do": "remove", "id": "A"}))
    assert not found.can_redo
    assert not found.marks.by_id


@pytest.mark.parametrize(
    ("mark", "field"),
    [
        (whole("A", image=[float("nan"), 1]), "image"), (whole("A", ground=[33, 137, 0]), "ground"),
        (whole(" A"), "id"), (whole("A\nB"), "id"), (whole("A", role="king"), "role"),
        (whole("A", owner="me"), "owner"),
        (whole("A", sigma_image=0.0), "sigma_image"), (whole("A", covariance=[1, 1, 1]), "covariance"),
        (whole("A", sigma_xy=-1), "sigma_xy"), (whole("A", note="x" * 501), "note"), (["A"], ""),
    ],
)  # fmt: skip
def test_impossible_marks_are_refused_with_their_field(mark: object, field: str) -> None:
    with pytest.raises(InputError) as refused:
        history({"do": "put", "mark": mark})
    assert field in str(refused.value.field)


def test_the_file_is_read_as_the_points_that_are_shown(tmp_path: Path) -> None:
    """What is fitted live and what `ortho fit` reads agree to the last bit but for the half pixel of ``ji``."""
    found = history(
        {"do": "put", "mark": whole("A", image=[1 / 3, 100 / 7], sigma_image=0.3)},
        {
            "do": "put",
            "mark": whole(
                "B", image=[50, 60], covariance=[0.01, 0.02, 0.005], ground=[33, 37, 4], ground_from="reference"
            ),
        },
        {"do": "put", "mark": whole("C", image=[70, 60], role="check", ground=[33, 37, 5], ground_from="reference")},
        {"do": "put", "mark": whole("off", image=[1, 1], off=True)},
        {"do": "put", "mark": {"id": "half", "image": [4, 5]}},
    ).marks
    path = tmp_path / "p.geojson"
    write_json(path, found.document("p"))
    read, shown = read_points(path), found.points("p")
    assert read.ids == shown.ids == ("A", "B", "C")
    np.testing.assert_allclose(read.image, shown.image, rtol=0, atol=1e-13)
    for name in ("ground", "roles", "sigma_image", "sigma_ground", "covariance_image", "groups"):
        np.testing.assert_array_equal(getattr(read, name), getattr(shown, name))
    assert read.crs == shown.crs
    # What the reference says is relative to it, and the file says so.
    assert shown.groups.tolist() == [-1, 0, 1]
    assert [one["id"] for one in json.loads(path.read_text())["left_out"]] == ["off", "half"]


def test_two_points_of_one_place_are_refused_as_the_file_would_be() -> None:
    for twin in (whole("B", image=[11, 12]), whole("B", ground=[33.5, 37, 1])):
        with pytest.raises(InputError, match="A already has the same"):
            history({"do": "put", "mark": whole("A")}, {"do": "put", "mark": twin})
    # What is off is not in the file.
    history({"do": "put", "mark": whole("A", off=True)}, {"do": "put", "mark": whole("B")})


def test_points_of_a_file_stay_what_they_are() -> None:
    points = read_points(SAMPLE / "gcps.geojson")
    marks = marks_of(points, "now")
    again = History()
    again.take(again.after({"do": "begin", "marks": [vars(mark) for mark in marks]}))
    found = again.marks.points("p")
    assert found.ids == points.ids
    np.testing.assert_array_equal(found.image, points.image)
    np.testing.assert_array_equal(found.sigma_image, points.sigma_image)
    np.testing.assert_allclose(found.ground, points.ground, rtol=0, atol=1e-9)
    assert isinstance(marks[0], Mark)
    assert marks[0].ground_from == "file"


@pytest.mark.parametrize("document", [[], "P1", None, 7])
def test_what_is_no_object_is_refused_by_name(document):
    with pytest.raises(InputError, match="not a point") as caught:
        mark_of(document)
    assert caught.value.field == "mark"
