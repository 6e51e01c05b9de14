"""Names in folders: known once, and never longer than they are true."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import folders
from ortho_pipeline.files.folders import listing
from ortho_pipeline.host.discovery import Host


@pytest.fixture
def scans(monkeypatch) -> list[str]:
    """The folders that are read, each time that one is."""
    seen: list[str] = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: seen.append(os.fspath(path)) or scandir(path))
    return seen


@pytest.fixture
def settled(monkeypatch) -> None:
    """No folder is too young for its list to be kept."""
    monkeypatch.setattr(folders, "_SETTLED", -1.0)
    monkeypatch.setattr(folders, "_kept", {})


def test_names_are_found_by_their_beginning_and_whatever_their_case(tmp_path: Path) -> None:
    for name in ("b_RPC.TXT", "B.tif", "ab.tif", "b.TIF.ovr", "c", "bé.xml"):
        (tmp_path / name).touch()
    found = listing(tmp_path)
    assert list(found.names) == sorted(os.listdir(tmp_path))
    assert sorted(found.beginning("b")) == ["B.tif", "b.TIF.ovr", "b_RPC.TXT", "bé.xml"]
    assert found.named("b_rpc.txt") == ["b_RPC.TXT"]
    assert found.named("b") == []
    assert found.beginning("d") == []
    assert found.matching(re.compile(r".*\.tif$", re.IGNORECASE)) == ["B.tif", "ab.tif"]


def test_what_is_no_plain_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("file")
    os.mkfifo(tmp_path / "pipe")
    assert sorted(listing(tmp_path).special) == ["link", "pipe"]


@pytest.mark.usefixtures("settled")
def test_a_folder_is_read_again_when_a_name_comes_goes_or_changes(tmp_path: Path, scans) -> None:
    (tmp_path / "a").touch()
    first = listing(tmp_path)
    assert listing(tmp_path) is first
    assert len(scans) == 1
    for change in ("touch b", "mv b c", "rm a"):
        subprocess.run(change.split(), cwd=tmp_path, check=True)
        assert list(listing(tmp_path).names) == sorted(os.listdir(tmp_path))
    assert len(scans) == 4


def test_a_list_that_may_be_young_is_not_kept(tmp_path: Path, scans) -> None:
    """The clock of a file system ticks every few milliseconds: a second change within a tick has the same time."""
    listing(tmp_path)
    listing(tmp_path)
    assert len(scans) == 2


@pytest.mark.usefixtures("settled")
def test_a_scene_among_thousands_is_opened_with_one_look_at_their_folder(tiny, scans) -> None:
    """Each of a dozen sensors, and GDAL's gate at each opening, looked through all names: seconds a scene."""
    for number in range(300):
        (tiny.folder / f"other{number}.tif").touch()
    host = Host.discover()
    scene = host.open_scene(tiny.image)
    assert scene.sensor == "rpc"
    assert scans.count(str(tiny.folder)) <= 1
    os.mkfifo(tiny.folder / "tiny.aux.xml")
    with pytest.raises(InputError, match="pipe"):
        host.open_scene(tiny.image)
