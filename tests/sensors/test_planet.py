"""Planet's basic products by their RPC, with the metadata of their item."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from ortho_planet import metadata_of
from products import PLANET
from seeds import SIZE, rpc
from used import pixels, used

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc_files import write_rpc_txt
from ortho_pipeline.plugins import open_scene

ITEM = "20200101_081500_12_2401"


@pytest.fixture
def image(tmp_path: Path) -> Path:
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / f"{ITEM}_metadata.json").write_text(PLANET)
    path = pixels(folder / f"{ITEM}_1B_AnalyticMS.tif", SIZE)
    write_rpc_txt(rpc(), folder / f"{ITEM}_1B_AnalyticMS_RPC.TXT")
    return path


def test_every_command(image: Path) -> None:
    info = used(image, rpc(), SIZE, sensor="planet", height=rpc().h_off, correction="shift")
    assert info["facts"]["satellite"] == "2401"
    assert info["facts"]["cloud_cover"] == 0.01


def test_an_orthorectified_asset_is_refused(image: Path) -> None:
    (image.parent / f"{image.stem}_RPC.TXT").unlink()
    with pytest.raises(InputError, match="orthorectified assets have none"):
        open_scene(image)


def test_the_metadata_are_those_of_the_item(image: Path) -> None:
    shutil.copy(image.parent / f"{ITEM}_metadata.json", image.parent / "20200101_081500_12_metadata.json")
    assert metadata_of(str(image)) == image.parent / f"{ITEM}_metadata.json"
    (image.parent / f"{ITEM}_metadata.json").write_text('{"item_type": 1}')
    with pytest.raises(InputError, match="not the metadata of an item"):
        open_scene(image)
