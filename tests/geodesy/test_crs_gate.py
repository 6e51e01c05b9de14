"""Which texts lead PROJ to a file outside of its folders: each form of a path, and what only looks like one."""

from __future__ import annotations

import json
from pathlib import Path

import pyproj
import pytest

from ortho_pipeline.errors import CrsError
from ortho_pipeline.geodesy.crs_gate import refuse_files


@pytest.mark.parametrize(
    "path",
    ["/a", "\\\\host\\a", "~/a", "./a", "../a", ".\\a", "..\\a", "c:/a", "C:\\a", "s3://b/a",
     "HTTPS://host/a", "a/../b", "a\\..\\b"],
)  # fmt: skip
def test_a_path_is_refused_wherever_a_value_begins(path: str) -> None:
    for text in ("{}", "  {}", "+nadgrids={}", "+nadgrids=@null,{}", "+nadgrids=@{}", "+init= {}:1", 'X["{}"]',
                 "X['{}']", "X[“{}”]", "X[{}]", "X( {})"):  # fmt: skip
        with pytest.raises(CrsError):
            refuse_files(text.format(path))


@pytest.mark.parametrize(
    "text",
    [
        # A slash or two dots within a name are no path from elsewhere; nor are a colon and a slash after a word.
        "WGS 84 / UTM zone 36N", "a/b", "a..b", "EPSG:4326", "urn:ogc:def:crs:EPSG::4326", "a.b/c.d",
        # Addresses of documents, and those that represent a code.
        'GEOGCRS["x",ID["EPSG",1,URI["https://epsg.org/1"]]]', 'X[CITATION["http://a/b"]]', "X[REMARK[“https://a/b”]]",
        'X[uri ( "https://a/b")]', '{"$schema": "https://proj.org/schemas/v0.7/projjson.schema.json"}',
        '{"remarks": "https://a/b", "citation": "https://a/c", "uri": "http://a/d"}',
        "http://www.opengis.net/def/crs/EPSG/0/4326", "https://opengis.net/def/crs/EPSG/0/4326",
    ],
)  # fmt: skip
def test_what_only_looks_like_a_path_is_taken(text: str) -> None:
    refuse_files(text)


@pytest.mark.parametrize(
    "text",
    [
        "http://www.opengis.net.evil.org/def", "https://host/http://www.opengis.net/", 'X[URI["file:///a"]]',
        'X[NAME["https://a/b"]]', 'X[URI["https://a/b"],"/etc/x"]', '{"name": "https://a/b"}',
    ],
)  # fmt: skip
def test_other_addresses_are_refused(text: str) -> None:
    with pytest.raises(CrsError):
        refuse_files(text)


def test_json_is_read_before_it_is_judged() -> None:
    for text in ('{"a": "\\u002fetc"}', '  {"a": ["b", {"c": "\\u002fetc"}]}', '{"a": "/etc", "a": "b"}'):
        with pytest.raises(CrsError):
            refuse_files(text)
    for text in ('{"a": "b"', "{" * 50_000, '{"a":' * 15_000 + "1" + "}" * 15_000):
        with pytest.raises(CrsError, match="JSON is not valid"):
            refuse_files(text)
    # An escape in a text that is no JSON is none.
    refuse_files("a\\u002fetc")
    refuse_files(json.dumps({"a": "b", "c": [1, None]}))


def test_a_text_may_have_a_hundred_thousand_characters_and_no_percent_sign() -> None:
    refuse_files("x" * 100_000)
    with pytest.raises(CrsError, match="100001"):
        refuse_files("x" * 100_001)
    for text in ("+geoidgrids=a%s.gtx", '{"a": "\\u0025n"}'):
        with pytest.raises(CrsError, match="percent"):
            refuse_files(text)


def test_a_file_of_the_working_folder_is_refused_unless_proj_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, own, users = (tmp_path / name for name in ("here", "own", "users"))
    for folder in (here, own, users):
        folder.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(pyproj.datadir, "get_data_dir", lambda: f"{tmp_path / 'none'}:{own}")
    monkeypatch.setattr(pyproj.datadir, "get_user_data_dir", lambda: str(users))
    forms = ("+geoidgrids={} +vunits=m", "+nadgrids=@null,@{} +no_defs", 'PARAMETERFILE["x","{}"]', "{}")
    names = ("mine.gtx", "linked.gtx", "my grid.gtx")
    for name in names:
        for form in forms:
            refuse_files(form.format(name))
    (here / "mine.gtx").touch()
    (here / "linked.gtx").symlink_to(tmp_path / "not there")
    (here / "my grid.gtx").touch()
    for name in names:
        for form in forms:
            # In a PROJ string a blank ends the name.
            if " " in name and form.startswith("+"):
                continue
            with pytest.raises(CrsError, match="current folder"):
                refuse_files(form.format(name))
    # A folder of that name is no grid.
    (here / "folder.gtx").mkdir()
    refuse_files("+geoidgrids=folder.gtx")
    # PROJ takes its own file first; a folder of that name is none.
    (own / "mine.gtx").touch()
    (users / "linked.gtx").touch()
    refuse_files("+geoidgrids=mine.gtx")
    refuse_files("+geoidgrids=linked.gtx")
    (own / "my grid.gtx").mkdir()
    with pytest.raises(CrsError, match="current folder"):
        refuse_files('X["my grid.gtx"]')


@pytest.mark.parametrize("name", ["a\0b", "a\udcffb"])
def test_a_text_that_can_be_no_name_of_a_file_names_none(name: str) -> None:
    refuse_files(f"+geoidgrids={name}")
