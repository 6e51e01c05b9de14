"""Grids from PROJ's server, by a folder that stands for it: what is fetched whole, and what is refused."""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyproj
import pytest

from ortho_pipeline.errors import DatumError, InputError, StorageError
from ortho_pipeline.geodesy import proj_grids
from ortho_pipeline.geodesy.proj_grids import fetch_grid, fetch_missing, grids, missing_grid

SOUND = struct.pack(">4d2i", 30.0, 33.0, 1.0, 1.0, 2, 2) + struct.pack(">4f", 1.0, 2.0, 3.0, 4.0)


class Server:
    """What `Objects` does, for the files of a folder."""

    folder = Path()

    def __init__(self, address: str, *, allow_network: bool) -> None:
        assert allow_network
        assert address.startswith("https://")

    def of(self, name: str) -> str:
        return f"https://server/{name}"

    def read(self, name: str, limit: int) -> tuple[bytes, None]:
        data = (self.folder / name).read_bytes()
        assert len(data) <= limit
        return data, None

    def fetch(self, name: str, path: Path, limit: int) -> SimpleNamespace:
        shutil.copyfile(self.folder / name, path)
        assert path.stat().st_size <= limit
        return SimpleNamespace(sha256=hashlib.sha256(path.read_bytes()).hexdigest())


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the server; its neighbour is the user's own."""
    for name in ("server", "mine"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(Server, "folder", tmp_path / "server")
    monkeypatch.setattr(proj_grids, "Objects", Server)
    monkeypatch.setattr(pyproj.datadir, "get_user_data_dir", lambda create=False: str(tmp_path / "mine"))
    return tmp_path / "server"


def listed(server: Path, **digests: str) -> None:
    rows: list[dict[str, Any]] = [
        {"properties": {"name": f"{name}.gtx", "sha256sum": digests[name]}} for name in digests
    ]
    (server / "files.geojson").write_text(json.dumps({"features": rows}))


def test_a_grid_is_fetched_as_it_is_listed(server: Path) -> None:
    (server / "a.gtx").write_bytes(SOUND)
    listed(server, b="0" * 64, a=hashlib.sha256(SOUND).hexdigest())
    path = fetch_grid("a.gtx")
    assert path == server.parent / "mine" / "a.gtx"
    assert path.read_bytes() == SOUND


def test_another_content_is_refused_and_leaves_nothing(server: Path) -> None:
    (server / "a.gtx").write_bytes(SOUND)
    (server / "b.gtx").write_bytes(SOUND[:-1])
    listed(server, a=hashlib.sha256(SOUND[::-1]).hexdigest(), b=hashlib.sha256(SOUND[:-1]).hexdigest(), c="0" * 64)
    for name, said in (("a.gtx", "SHA-256"), ("b.gtx", "header"), ("c.gtx", "does not have this grid")):
        with pytest.raises(StorageError, match=said) as refused:
            fetch_grid(name)
        assert refused.value.file == f"https://server/{name}"
    with pytest.raises(InputError, match=r"no grid d\.gtx"):
        fetch_grid("d.gtx")
    assert not list((server.parent / "mine").glob("*.gtx"))


def test_a_list_that_is_missing_or_none_is_named(server: Path) -> None:
    with pytest.raises(StorageError, match="no list of grids"):
        fetch_grid("a.gtx")
    for text in ('{"features": [{}]}', '{"features": 3}', '{"features": [{"properties": {"name": "a.gtx"}}]}'):
        (server / "files.geojson").write_text(text)
        with pytest.raises(InputError, match=r"no grid a\.gtx"):
            fetch_grid("a.gtx")


def test_the_grids_of_the_common_datums(server: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """EGM96 is installed under its older name, EGM84 under its own, EGM2008 is not."""
    mine = server.parent / "mine"

    def transformer(code: str) -> SimpleNamespace:
        if code == "EPSG:3855":
            raise DatumError("the geoid grid us_nga_egm08_25.tif, which is not installed", remedy="fetch it")
        grid = {"EPSG:5773": "us_nga_egm96_15.tif", "EPSG:5798": "us_nga_egm84_30.tif"}[code]
        return SimpleNamespace(definition=f"proj=vgridshift grids={grid} multiplier=1")

    monkeypatch.setattr(proj_grids, "vertical_transformer", transformer)
    monkeypatch.setattr(proj_grids, "add_system_grids", lambda: (str(server),))
    (server / "egm96_15.gtx").touch()
    (mine / "us_nga_egm84_30.tif").touch()
    rows = {row["datum"]: (row["crs"], row["found"], row["grid"], row["path"]) for row in grids()}
    assert rows == {
        "egm96": ("EPSG:5773", True, "us_nga_egm96_15.tif", str(server / "egm96_15.gtx")),
        "egm2008": ("EPSG:3855", False, "us_nga_egm08_25.tif", None),
        "egm84": ("EPSG:5798", True, "us_nga_egm84_30.tif", str(mine / "us_nga_egm84_30.tif")),
    }
    assert (missing_grid("EPSG:3855"), missing_grid("EPSG:5773")) == ("us_nga_egm08_25.tif", None)
    fetched: list[str] = []
    monkeypatch.setattr(proj_grids, "fetch_grid", lambda name: fetched.append(name) or mine / name)
    assert fetch_missing() == [{"grid": "us_nga_egm08_25.tif", "path": str(mine / "us_nga_egm08_25.tif")}]
    assert fetched == ["us_nga_egm08_25.tif"]
