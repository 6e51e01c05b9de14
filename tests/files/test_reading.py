"""Files and JSON of strangers: how much is read, and what is none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import check_path
from ortho_pipeline.files.reading import parse_json, read_bounded, read_json, states, why_no_file


def test_one_byte_more_than_the_limit_is_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    assert [read_bounded(tmp_path / "a", limit) for limit in (6, 5, 4, 3)] == [b"12345", b"12345", b"12345", b"1234"]
    with pytest.raises(InputError):
        read_bounded(tmp_path, 6)
    with pytest.raises(InputError, match="cannot be read") as caught:
        read_bounded(tmp_path / ("x" * 300), 6)
    assert caught.value.remedy


def test_a_json_file_may_be_as_large_as_its_limit(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b"[1,  2]")
    assert read_json(tmp_path / "a.json", 7, "copy it") == [1, 2]
    with pytest.raises(InputError):
        read_json(tmp_path / "a.json", 6, "copy it")


def test_whole_numbers_have_forty_digits_at_most() -> None:
    for text in ("7" * 40, "-" + "7" * 39):
        assert parse_json(text, "a", "copy it") == int(text)
    with pytest.raises(InputError):
        parse_json("7" * 41, "a", "copy it")


@pytest.mark.parametrize("text", ["NaN", "[Infinity]", "-Infinity", "1e400", '{"a": -1e400}', "01", "[1,]"])
def test_what_is_no_json_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="not JSON"):
        parse_json(text, "a", "copy it")


def test_half_a_character_is_refused_and_a_whole_one_is_not() -> None:
    assert parse_json('"\\ud83d\\ude00"', "a", "copy it") == "\U0001f600"
    for text in ('"a\\ud83d"', '{"\\ude00": 1}'):
        with pytest.raises(InputError, match="not JSON"):
            parse_json(text, "a", "copy it")


def test_a_member_that_stands_twice_is_refused_where_it_matters() -> None:
    text = '{"a": {"b": 1, "b": 2}}'
    assert parse_json(text, "a", "copy it") == {"a": {"b": 2}}
    with pytest.raises(InputError, match="not JSON"):
        parse_json(text, "a", "copy it", unique=True)
    assert parse_json('{"a": {"a": 1}}', "a", "copy it", unique=True) == {"a": {"a": 1}}


def test_an_error_of_json_has_its_line() -> None:
    with pytest.raises(InputError) as caught:
        parse_json('{\n "a": 1,\n "b": x\n}', "a", "copy it")
    assert caught.value.field == "line 3"


def test_the_most_similar_name_is_proposed(tmp_path: Path) -> None:
    for name in ("scene_2019.tif", "dem.tif"):
        (tmp_path / name).touch()
    assert str(tmp_path / "scene_2019.tif") in check_path(tmp_path / "scene_2018.tif")
    assert "dem" not in check_path(tmp_path / "points.csv")
    assert str(tmp_path / "none") in check_path(tmp_path / "none" / "dem.tif")
    for pattern in ("*.tif", "scene_201?.tif"):
        assert "so that the shell expands it" in check_path(tmp_path / pattern)


def test_why_a_path_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "a.tif").touch()
    os.mkfifo(tmp_path / "pipe")
    for name in ("b.tif", "a.tif/b.tif", "a\0b"):
        assert why_no_file(str(tmp_path / name)) == "there is no such file"
    assert "cannot be read" in why_no_file(str(tmp_path / ("x" * 300)))
    assert why_no_file(str(tmp_path / "pipe")) == "this is a pipe or a device"


def test_a_state_has_the_size_and_no_file_has_none(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    found = states([tmp_path / "a", tmp_path / "none"])
    assert list(found) == [str(tmp_path / "a")]
    assert found[str(tmp_path / "a")][0] == 5
