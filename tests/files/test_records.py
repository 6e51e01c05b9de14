"""What becomes of values in JSON documents, and records made of documents."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pyproj
import pytest

from ortho_pipeline.files.json.records import DocumentError, Record
from ortho_pipeline.files.json.values import json_position, json_value


@dataclasses.dataclass
class Shift:
    column: float
    at: tuple[int, int]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, None), (True, True), (np.True_, True), (3, 3), (np.int64(3), 3), (1.5, 1.5), (np.float32(1.5), 1.5),
        (math.nan, None), (-math.inf, None), (np.float64("nan"), None), ("a", "a"), (np.str_("a"), "a"),
        (np.array([[1.0, np.nan], [np.inf, 2.0]]), [[1.0, None], [None, 2.0]]), ((1, {"a": {2}}), [1, {"a": [2]}]),
        ({1: Path("a/b")}, {"1": "a/b"}), (Shift(math.nan, (1, 2)), {"column": None, "at": [1, 2]}),
        (pyproj.CRS("EPSG:4326"), "EPSG:4326"),
    ],
)  # fmt: skip
def test_values_are_what_json_holds(value, expected):
    found = json_value(value)
    assert json.loads(json.dumps(found, allow_nan=False)) == expected
    assert type(found) is type(expected)


def test_half_a_place_is_none():
    assert json_position(np.array([1.0, 2.0])) == [1.0, 2.0]
    assert json_position(np.array([1.0, np.nan])) is None


class One(Record):
    """A record."""

    number: int


def test_a_record_within_other_values_is_an_object() -> None:
    assert json_value({"records": (One(number=1),)}) == {"records": [{"number": 1}]}


def test_a_member_without_a_name_is_named() -> None:
    with pytest.raises(DocumentError) as caught:
        One.read({"number": 1, "": 2})
    assert caught.value.place == "''"
