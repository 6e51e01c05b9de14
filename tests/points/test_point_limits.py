"""Limits of point files, from both sides."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.errors import InputError
from ortho_pipeline.points import Points, read_points
from ortho_pipeline.points.link_lists import odm_crs
from ortho_pipeline.points.selection import assign_roles, select_control
from ortho_pipeline.points.shared_marks import marks_warning, one_mark
from ortho_pipeline.surface.accuracy import read_check_heights


@pytest.mark.parametrize(
    ("text", "crs"),
    [
        ("WGS84 UTM 60S", "EPSG:32760"), ("wgs 84 utm 1 n", "EPSG:32601"), ("WGS84 UTM 61N", None),
        ("WGS84 UTM 0N", None), ("WGS84", "EPSG:4326"), ("EPSG:4979", "EPSG:4979"), ("UTM 33N", None),
    ],
)  # fmt: skip
def test_names_of_systems_in_lists(text: str, crs: str | None) -> None:
    assert odm_crs(text) == crs


@pytest.mark.parametrize(("apart_mm", "same"), [(9.9, True), (10.1, False)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mark_is_one_within_a_centimetre(apart_mm: float, same: bool, axis: int) -> None:
    ground = np.array([[500_000.0, 4e6, 100.0]] * 3)
    ground[1:, axis] += apart_mm / 1000 * (1.0 if axis == 2 else 0.9996), 7.0
    points = Points.of([[1, 1], [2, 2], [3, 3]], ground, "EPSG:32636")
    assert one_mark(points) == ([("1", "2")] if same else [])
    assert bool(marks_warning(points, points.control)) is same


def test_a_check_point_that_is_a_control_point_tests_nothing() -> None:
    ground = np.array([[500_000.0, 4e6, 100.0]] * 2 + [[600_000.0, 4e6, 100.0]] * 2)
    ground[1::2, 2] += 0.005
    points = Points.of(np.eye(4, 2), ground, "EPSG:32636", roles=["control", "check", "control", "control"])
    added, tested = marks_warning(points, points.control)
    assert (added.code, added.fields["pairs"]) == ("one-mark-twice", [["3", "4"]])
    assert (tested.code, tested.fields["pairs"]) == ("one-mark-twice", [["1", "2"]])
    assert "tests nothing" in str(tested)
    assert "redundancy" in str(added)


def test_a_row_of_a_link_table_is_below_the_axis(tmp_path: Path) -> None:
    path = tmp_path / "links.txt"
    path.write_text("link table\na 5 1 24.5 -33.5\n6 -7 24.6 -33.6\n")
    found = read_points(path, crs="EPSG:4326")
    assert found.image.tolist() == [[5.0, -1.0], [6.0, 7.0]]
    assert found.ids[0] == "a"
    path.write_text("link table\n5 1.01 24.5 -33.5\n")
    with pytest.raises(InputError, match=r"line 2, from-y.*must be minus the row"):
        read_points(path, crs="EPSG:4326")


@pytest.mark.parametrize(("header", "row", "known"), [("x y h", "33.5 36.5 1042.5", True), ("x y", "33.5 36.5", False)])
def test_three_names_are_a_header_whatever_the_suffix(tmp_path: Path, header: str, row: str, known: bool) -> None:
    path = tmp_path / "heights.txt"
    path.write_text(f"{header}\n{row}\n")
    if known:
        assert read_check_heights(path, "EPSG:4326", "ellipsoid")[0].tolist() == [[33.5, 36.5, 1042.5]]
    else:
        with pytest.raises(InputError, match="unknown format"):
            read_check_heights(path, "EPSG:4326", "ellipsoid")


def features(*properties: dict[str, Any], place: Any = (24.5, -33.5, 10.0)) -> str:
    return json.dumps({
        "type": "FeatureCollection",
        "features": [
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": list(place)}, "properties": each}
            for each in properties
        ],
    })  # fmt: skip


@pytest.mark.parametrize("ji", [[1.0], [1.0, 2.0, 3.0], None, "1,2", {"a.tif": [1.0, 2.0]}])
def test_a_measurement_of_geojson_is_a_column_and_a_row(tmp_path: Path, ji: object) -> None:
    path = tmp_path / "a.geojson"
    path.write_text(features({"id": "a", "ji": ji}))
    with pytest.raises(InputError, match="'ji' = "):
        read_points(path)
    path.write_text(features({"id": "a", "ji": [1.0, 2.0]}))
    assert read_points(path).image.tolist() == [[1.5, 2.5]]
    # In a block it names its image.
    with pytest.raises(InputError, match="does not name its image"):
        read_block_points(path)
    path.write_text(features({"id": "a", "ji": [1.0, 2.0], "filename": "a.tif"}))
    assert read_block_points(path).images == ("a.tif",)


@pytest.mark.parametrize(("place", "ok"), [((24.5, -33.5), True), ((24.5,), False), ((24.5, -33.5, 1, 2), False)])
def test_coordinates_of_geojson_are_two_or_three(tmp_path: Path, place: tuple[float, ...], ok: bool) -> None:
    path = tmp_path / "a.geojson"
    path.write_text(features({"id": "a", "ji": [1.0, 2.0]}, place=place))
    if ok:
        assert math.isnan(read_points(path).ground[0, 2])
    else:
        with pytest.raises(InputError, match="coordinates are not"):
            read_points(path)


def points(count: int) -> Points:
    places = np.column_stack([np.arange(count) * 10.0, np.zeros(count)])
    ground = np.column_stack([500_000.0 + places[:, 0], np.full(count, 4e6), np.zeros(count)])
    return Points.of(places, ground, "EPSG:32636", ids=[f"p{k:02}" for k in range(count)])


@pytest.mark.parametrize(
    ("spec", "check"), [("every:1", [0, 1, 2, 3, 4]), ("every:2", [1, 3]), ("every:5", [4]), ("ids:p03,p00", [0, 3])]
)
def test_every_nth_control_point_checks(spec: str, check: list[int]) -> None:
    assert np.flatnonzero(assign_roles(points(5), spec).check).tolist() == check
    for wrong in ("every:0", "every:", "every:12345678", "ids:", "some:3"):
        with pytest.raises(InputError, match="not a selection"):
            assign_roles(points(5), wrong)


def test_selections_count_from_one_to_all() -> None:
    five = points(5)
    for spec in ("even:5", "cluster:5", "random:5"):
        assert select_control(five, spec).control.all()
    for spec in ("even:6", "cluster:6:1", "random:6"):
        with pytest.raises(InputError, match="5 control points"):
            select_control(five, spec)
    for spec in ("even:0", "even:1:1", "random:1:2:3", "even:x", "cluster:12345678901"):
        with pytest.raises(InputError, match="not a selection"):
            select_control(five, spec)
    assert np.flatnonzero(select_control(five, "cluster:2:2").control).tolist() == [3, 4]
