"""Places of files: paths of GDAL's file systems by their methods, kinds of addresses, what has been read."""

from __future__ import annotations

import errno
import json
import os
import tarfile
import zipfile
from pathlib import Path
from urllib.parse import quote

import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import locations, traffic
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.files.locations import Location, VsiPath, members, require_network, within


@pytest.fixture
def folder(tmp_path: Path) -> VsiPath:
    """A folder in an archive with two files and a folder of one."""
    with zipfile.ZipFile(tmp_path / "order.zip", "w") as made:
        for name, data in (("a.tif", b"12345"), ("b.txt", "Büyük\n".encode()), ("deep/c.tif", b"6")):
            made.writestr(f"order/{name}", data)
    return VsiPath(f"/vsizip/{tmp_path}/order.zip/order/")


def test_files_and_folders_are_told_apart(folder: VsiPath) -> None:
    file, none = folder / "a.tif", folder / "none.tif"
    assert [place.exists() for place in (folder, file, none)] == [True, True, False]
    assert [place.is_file() for place in (folder, file, none)] == [False, True, False]
    assert [place.is_dir() for place in (folder, file, none)] == [True, False, False]
    assert [place.size() for place in (file, none)] == [5, 0]
    assert file.stat().st_size == 5
    for asked in (none.stat, lambda: list(none.iterdir()), lambda: none.read(3)):
        with pytest.raises(FileNotFoundError):
            asked()


def test_a_folder_is_listed_and_searched(folder: VsiPath) -> None:
    assert sorted(folder.iterdir()) == [folder / "a.tif", folder / "b.txt", folder / "deep"]
    assert list(folder.glob("*.tif")) == [folder / "a.tif"]


def test_content_is_read_up_to_a_limit(folder: VsiPath, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "a.tif"
    assert [file.read(limit) for limit in (1, 5, 9)] == [b"1", b"12345", b"12345"]
    monkeypatch.setattr(locations, "MAX_READ", 5)
    assert file.read_bytes() == b"12345"
    monkeypatch.setattr(locations, "MAX_READ", 4)
    with pytest.raises(OSError, match="larger") as caught:
        file.read_bytes()
    assert caught.value.errno == errno.EFBIG


def test_content_is_open_as_bytes_or_as_text(folder: VsiPath) -> None:
    file = folder / "b.txt"
    assert file.open().read() == file.read_text() == "Büyük\n"
    assert file.open("rb").read() == "Büyük\n".encode()
    assert file.open(encoding="latin-1").read() == "BÃ¼yÃ¼k\n"


def test_paths_are_equal_and_ordered_by_their_names() -> None:
    one, other = VsiPath("/vsizip/a.zip/b"), VsiPath("/vsizip/a.zip/c/")
    assert one == VsiPath("/vsizip/a.zip/b/")
    assert one != other
    assert one != "/vsizip/a.zip/b"
    assert one < other
    assert not one < VsiPath("/vsizip/a.zip/b")
    assert sorted({other, one, VsiPath("/vsizip/a.zip/b")}) == [one, other]
    assert (other / "d.e.tif").with_suffix(".xml") == VsiPath("/vsizip/a.zip/c/d.e.xml")
    assert VsiPath("/vsicurl/https://h/a.tif?b=c.d/").name == "a.tif"


@pytest.mark.parametrize(
    ("name", "far"),
    [
        ("https://h/a.tif", True), ("S3://b/a.tif", True), ("ftp://h/a.tif", False), ("/vsicurl/https://h/a", True),
        ("/vsis3/b/a.tif", True), ("/vsizip/a.zip/b.tif", False), ("/vsizip//vsicurl/http://h/a.zip", True),
        ("/vsimem/a.tif", False), ("/data/a.tif", False), ("a.tif", False),
    ],
)  # fmt: skip
def test_places_on_other_machines_are_far(name: str, far: bool) -> None:
    assert Location(name).is_far == far


@pytest.mark.parametrize(
    ("name", "document", "asset"),
    [
        ("https://h/a.json#visual", "https://h/a.json", "visual"),
        ("s3://b/c/items/1#B04#x", "s3://b/c/items/1", "B04#x"),
        ("/vsicurl/https://h/a.json#v", "https://h/a.json", "v"), ("/data/a.JSON#v", "/data/a.JSON", "v"),
        ("/data/a#1.tif", "/data/a#1.tif", ""), ("https://h/a.json", "https://h/a.json", ""),
    ],
)  # fmt: skip
def test_the_asset_of_a_document_is_what_follows_its_number_sign(name: str, document: str, asset: str) -> None:
    assert (Location(name).document, Location(name).asset) == (document, asset)


@pytest.mark.parametrize(
    ("name", "item", "collection"),
    [
        ("https://h/v1/collections/c/items/S_1", True, False), ("https://h/v1/collections/c", False, True),
        ("https://h/v1/collections/c/", False, True), ("a.json", True, True), ("a.GeoJSON?b=c", True, True),
        ("https://h/v1/collections/c/items/", False, False), ("a.tif", False, False),
    ],
)  # fmt: skip
def test_items_and_collections_are_known_by_their_names(name: str, item: bool, collection: bool) -> None:
    assert (Location(name).is_item, Location(name).is_collection) == (item, collection)


def test_the_archive_of_a_name_is_the_file_on_disk_that_it_leads_into(tmp_path: Path) -> None:
    (tmp_path / "in.zip").mkdir()
    archive = tmp_path / "in.zip" / "scene.zip"
    archive.touch()
    assert Location(f"/vsizip/{archive}/b/c.tif").archive == archive
    assert Location(f"/vsizip/{archive}").archive == archive
    assert Location(f"/vsizip/{tmp_path}/none.zip/c.tif").archive is None
    assert Location(str(archive)).archive is None


def test_the_first_five_images_of_an_archive_are_named(tmp_path: Path) -> None:
    names = ["a.TIF", "b.txt", *(f"c/{k}.jp2" for k in range(6))]
    with zipfile.ZipFile(tmp_path / "A.ZIP", "w") as made, tarfile.open(tmp_path / "a.tar", "w") as other:
        for name in names:
            made.writestr(name, b"1")
            (tmp_path / "one").write_bytes(b"1")
            other.add(tmp_path / "one", name)
    for archive, prefix in ((tmp_path / "A.ZIP", "/vsizip/"), (tmp_path / "a.tar", "/vsitar/")):
        found = members(archive)
        assert len(found) == 5
        assert found[0] == f"{prefix}{archive}/a.TIF"
        assert all(name.startswith(f"{prefix}{archive}/c/") for name in found[1:])
    (tmp_path / "no.zip").write_bytes(b"none")
    assert members(tmp_path / "no.zip") == []


def test_a_path_is_within_one_of_the_folders_where_links_lead(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
    (tmp_path / "a" / "link").symlink_to(tmp_path / "c")
    roots = [tmp_path / "a", tmp_path / "b"]
    assert [within(tmp_path / name, roots) for name in ("a/x", "b/x", "a", "c/x", "a/link/x")] == [
        True, True, True, False, False,
    ]  # fmt: skip


@pytest.mark.parametrize("times", [0, 1, 4])
def test_credentials_are_seen_however_often_they_are_encoded(times: int) -> None:
    text = "signature="
    for _ in range(times):
        text = quote(text, safe="")
    with pytest.raises(InputError, match="credentials"):
        require_network(f"https://h/a.tif?{text}1", False)
    with pytest.raises(InputError, match="off by default"):
        require_network("https://h/a.tif?token=1", False, paged=True)
    with pytest.raises(InputError, match="credentials"):
        require_network("https://h/a.tif?token=1", False)


def test_a_closed_network_is_opened_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    for key in (*locations._CLOSED, *locations._PATIENT):
        monkeypatch.setenv(key, "")  # monkeypatch restores only what it has set or deleted
        monkeypatch.delenv(key)
    monkeypatch.setattr(locations, "_closed_with", {})
    monkeypatch.setattr(locations, "count_gdal", lambda: None)
    monkeypatch.setenv("NO_PROXY", "here")
    monkeypatch.setenv("GDAL_HTTP_RETRY_DELAY", "7")
    assert not locations.network_is_closed()
    for _ in range(2):
        locations.close_network()
    assert locations.network_is_closed()
    monkeypatch.setenv("GDAL_HTTP_PROXY", "elsewhere")
    assert not locations.network_is_closed()
    require_network("https://h/a.tif", True)
    assert os.environ["NO_PROXY"] == "here"
    assert "GDAL_HTTP_PROXY" not in os.environ
    assert (os.environ["GDAL_HTTP_MAX_RETRY"], os.environ["GDAL_HTTP_RETRY_DELAY"]) == ("5", "7")


def test_bytes_of_the_stores_client_and_of_gdal_are_added(monkeypatch: pytest.MonkeyPatch) -> None:
    document = '{"methods": {"GET": {"downloaded_bytes": 40}, "HEAD": {"count": 2}, "PUT": {"downloaded_bytes": 2}}}'
    monkeypatch.setattr(gdal, "NetworkStatsGetAsSerializedJSON", lambda: document)
    monkeypatch.setattr(traffic, "_own", [7])
    traffic.count(100)
    assert traffic.bytes_read() == 149
    monkeypatch.setattr(gdal, "NetworkStatsGetAsSerializedJSON", lambda: "")
    assert traffic.bytes_read() == 107


def test_what_gdal_read_before_it_counts_is_added_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """GDAL reads its switch again after a reset, and counts from zero."""
    read = {"downloaded_bytes": 40}
    monkeypatch.setattr(gdal, "NetworkStatsGetAsSerializedJSON", lambda: json.dumps({"methods": {"GET": read}}))
    monkeypatch.setattr(gdal, "NetworkStatsReset", lambda: read.update(downloaded_bytes=0))
    monkeypatch.setattr(traffic, "_own", [7])
    monkeypatch.setenv(traffic._COUNTING, "")  # monkeypatch restores only what it has set or deleted
    monkeypatch.delenv(traffic._COUNTING)
    traffic.count_gdal()
    assert (os.environ[traffic._COUNTING], traffic.bytes_read()) == ("YES", 47)
    read["downloaded_bytes"] = 5
    traffic.count_gdal()
    assert traffic.bytes_read() == 52


def test_a_class_in_a_document_is_text() -> None:
    assert json_value({"kind": Location, "some": frozenset({1})}) == {"kind": str(Location), "some": [1]}
