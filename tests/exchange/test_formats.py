"""Formats that plugins add to `ortho export`, by the hook `ortho_formats`: listed, written, refused."""

from __future__ import annotations

import json
import math
import types
from pathlib import Path

import pytest
from click.testing import CliRunner
from ortho_csm.files import csm_text, read_csm
from osgeo import gdal
from products import tsai_text

import ortho_pipeline as op
from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError, PluginError
from ortho_pipeline.exchange.export import FORMATS
from ortho_pipeline.hookspecs import Format, hookimpl
from ortho_pipeline.host import Host

CORNERS = """
import json
from ortho_pipeline.hookspecs import Format, hookimpl

@hookimpl
def ortho_formats():
    yield Format("corners", "ground of the corners", "_corners.json", write)

def write(export, path):
    columns, rows = export.size
    image = [[0, 0], [columns, 0], [columns, rows], [0, rows]]
    ground = export.model.image_to_ground(image, export.model.reference_height)
    path.write_text(json.dumps(ground.tolist()))
    return 0.25
"""


def plugin(*offered: object, name: str = "other") -> types.ModuleType:
    module = types.ModuleType(name)
    module.ortho_formats = hookimpl(lambda: offered)  # type: ignore[attr-defined]
    return module


def offer(write=None, name: str = "mine", ending: str = "_mine.txt", title: str = "mine") -> Format:
    def written(export: object, path: Path) -> float:
        path.write_text("mine")
        return 0.0

    return Format(name, title, ending, write or written)


@pytest.fixture
def registered(monkeypatch):
    """Return a function that makes commands use the bundled plugins and these modules."""

    def register(*modules: types.ModuleType) -> None:
        host = Host(modules, installed=True)
        monkeypatch.setattr(Host, "discover", lambda: host)

    return register


def test_the_host_has_its_own_formats_and_those_of_the_bundled_plugins():
    assert list(Host.discover().formats) == [*FORMATS, "csm"]
    assert Host.discover().provenance("csm").distribution == "ortho-pipeline"


def test_an_installed_format_is_listed_and_written(install, registered, tiny, tmp_path):
    install("third-party", "third_party", CORNERS)
    registered()
    listed = CliRunner().invoke(cli, ["export", "--help"]).stdout
    assert "corners (ground of the corners)" in " ".join(listed.split())
    assert json.loads(CliRunner().invoke(cli, ["doctor", "--json"]).stdout)["formats"] == [*FORMATS, "corners", "csm"]
    arguments = ["export", str(tiny.image), "-o", str(tmp_path / "out"), "--format", "corners,rpc-txt"]
    told = CliRunner().invoke(cli, arguments).stdout
    assert "ground of the corners: at most 0.25 px off" in told
    document = json.loads(CliRunner().invoke(cli, [*arguments, "--json"]).stdout)
    assert document["corners"] == {"max_error_px": 0.25}
    written = Path(document["files"]["corners"])
    assert written == tmp_path / "out" / f"{tiny.image.stem}_corners.json"
    image = tiny.model.ground_to_image(json.loads(written.read_text()))
    assert image.round(6).tolist() == [[0, 0], [tiny.width, 0], [tiny.width, tiny.height], [0, tiny.height]]


@pytest.mark.parametrize(
    ("offered", "message"),
    [
        ([3], "yields int, not Format"),
        (None, "ortho_formats returned NoneType"),
        ([offer(name="My Format")], "'My Format' is not a valid format name"),
        ([offer(title=" ")], "the title is empty"),
        ([offer(ending="mine")], "the ending must be like '_name.json', not 'mine'"),
        ([offer(ending="_../mine")], "the ending must be like '_name.json', not '_../mine'"),
        ([Format("mine", "mine", "_mine.txt", "write")], "write must be callable"),
        ([offer(), offer()], "the format 'mine' twice"),
        ([offer(ending="_rpc.txt")], "the format 'rpc-txt' has the same ending '_rpc.txt'"),
        ([offer(), offer(name="other")], "the format 'mine' has the same ending '_mine.txt'"),
        ([offer(name="rpb")], "the format 'rpb', but this name belongs to ortho-pipeline"),
        ([offer(name="warnings")], "the format 'warnings', but this name belongs to ortho-pipeline"),
        ([offer(name="csm")], "the format 'csm', but this name belongs to ortho-pipeline"),
    ],
)
def test_formats_that_are_none_name_their_plugin(offered, message):
    module = plugin()
    module.ortho_formats = hookimpl(lambda: offered)
    with pytest.raises(PluginError, match=message) as caught:
        _ = Host([module], installed=True).formats
    assert "plugin other" in str(caught.value)


def test_two_plugins_with_one_format_are_an_error():
    with pytest.raises(PluginError, match="two plugins offer the format 'mine': one and two"):
        _ = Host([plugin(offer(), name="one"), plugin(offer(), name="two")]).formats


def test_the_help_and_the_doctor_leave_a_broken_format_out(install, caplog):
    install("third-party", "third_party", CORNERS.replace('"_corners.json"', '"_csm.json"'))
    assert list(commands.formats()) == [*FORMATS, "csm"]
    (broken,) = commands.doctor()["broken"]
    assert broken["distribution"] == "third-party"
    assert "'csm' has the same ending '_csm.json'" in broken["error"]
    assert "third-party 1.2" in caplog.text


def fails(export: object, path: Path) -> float:
    path.write_text("half")
    raise KeyError("m_nLines")


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (fails, r"format 'mine' of plugin other failed \(KeyError: 'm_nLines' at test_formats\.py:\d+\)"),
        (lambda export, path: 0.0, "format 'mine' of plugin other wrote nothing"),
        (lambda export, path: path.write_text("x") and None, "write returned None"),
        (lambda export, path: path.write_text("x") and math.nan, "write returned nan"),
        (lambda export, path: path.write_text("x") and -1, "write returned -1"),
    ],
)
def test_a_format_that_fails_leaves_nothing_behind(registered, tiny, tmp_path, write, message):
    registered(plugin(offer(write)))
    with pytest.raises(PluginError, match=message):
        commands.export(tiny.image, tmp_path / "out", formats=["rpc-txt", "mine"])
    assert not list((tmp_path / "out").glob("*"))


def test_a_format_refuses_a_model_in_its_own_words(registered, tiny, tmp_path):
    def refuses(export, path):
        raise InputError("an RPC has no focal length", field="formats", remedy="another format")

    registered(plugin(offer(refuses)))
    with pytest.raises(InputError, match="no focal length"):
        commands.export(tiny.image, tmp_path / "out", formats=["mine"])


def test_the_state_of_a_camera_is_exported_as_its_text(tmp_path):
    image = tmp_path / "one.tif"
    gdal.GetDriverByName("GTiff").Create(str(image), 60, 50)
    (tmp_path / "one.tsai").write_text(tsai_text())
    done = commands.export(image, tmp_path / "out", formats=["csm"])
    state = done.files["csm"]
    assert state.name == "one_csm.json"
    text, worst = csm_text(op.open_scene(image).model)
    assert state.read_bytes() == text.encode()
    assert done.document["csm"] == {"max_error_px": worst}
    assert f"CSM state of a line scanner or a frame: at most {worst:.2g} px off" in done.summary
    assert read_csm(state).kind == "frame"
