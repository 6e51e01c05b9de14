"""The host: discovery, recognition, and what it refuses."""

import json
import re
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import ortho_rpc
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError, PluginError
from ortho_pipeline.exchange.rpc import rpc_metadata, write_rpc_txt
from ortho_pipeline.hookspecs import Scene, Sensor, hookimpl
from ortho_pipeline.host import Host
from ortho_pipeline.host.discovery import _discovered
from ortho_pipeline.models import KINDS, RPC, SensorModel
from ortho_pipeline.runtime.signals import Terminated

gdal.UseExceptions()

PLUGIN = """
from ortho_pipeline.hookspecs import Scene, Sensor, hookimpl

@hookimpl
def ortho_sensors():
    yield Sensor({name!r}, "a test", lambda dataset: False, lambda dataset: None)
"""


def make_rpc(**changes) -> RPC:
    linear = np.zeros((4, 20))
    linear[0, [1, 3]] = 1.0, 0.1
    linear[2, 2] = -1.0
    linear[1, 0] = linear[3, 0] = 1.0
    fields = {
        "col_off": 10.5, "row_off": 8.5, "lon_off": 24.4, "lat_off": -33.6, "h_off": 700.0, "col_scale": 10.0,
        "row_scale": 8.0, "lon_scale": 0.1, "lat_scale": 0.08, "h_scale": 500.0, "col_num": linear[0],
        "col_den": linear[1], "row_num": linear[2], "row_den": linear[3],
    }  # fmt: skip
    return RPC(**(fields | changes))


def make_image(path: Path, rpc: RPC | None = None) -> Path:
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 20, 16)
    if rpc is not None:
        dataset.SetMetadata(rpc_metadata(rpc), "RPC")
    return path


def make_sensor(name="alpha", recognises=lambda dataset: True, open_scene=None, **fields) -> Sensor:
    def opened(dataset, **options):
        size = dataset.RasterXSize, dataset.RasterYSize
        return Scene(name, dataset.GetDescription(), *size, {"rpc": make_rpc()}, "here", facts=options)

    return Sensor(name, "a test", recognises, open_scene or opened, **fields)


def make_plugin(*sensors, name="plugin", hook="ortho_sensors") -> types.ModuleType:
    module = types.ModuleType(name)

    @hookimpl
    def function():
        return sensors

    setattr(module, hook, function)
    return module


def test_discover_finds_the_bundled_plugin():
    host = Host.discover()
    assert host is Host.discover()
    assert host.sensors["rpc"].fallback
    assert host.provenance("rpc").distribution == "ortho-pipeline"


def test_installed_plugin_is_found_with_distribution_and_version(install):
    install("third-party", "third_party_plugin", PLUGIN.format(name="third"))
    host = Host(installed=True)
    assert "third" in host.sensors
    assert str(host.provenance("third")) == "third-party 1.2"
    assert host.provenance("third").module == "third_party_plugin"
    assert any(origin.distribution == "third-party" for origin in host.plugins())


@pytest.mark.parametrize("source", ["import no_such_module_here", "def broken(:", "raise KeyError('x')", "1 / 0",
                                    "import sys; sys.exit(0)"])  # fmt: skip
def test_plugin_that_fails_to_import_is_left_out_with_a_warning(install, caplog, source):
    install("third-party", "third_party_plugin", source)
    host = Host(installed=True)
    assert [broken.distribution for broken in host.broken] == ["third-party"]
    assert "third-party 1.2" in caplog.text
    assert host.broken[0].error.split(":")[0] in caplog.text
    assert "rpc" in host.sensors


def test_the_line_of_a_failing_import_is_told_for_an_entry_point_with_an_object(install, tmp_path):
    install("third-party", "third_party_plugin", "\nraise OSError('broken')\n")
    info = tmp_path / "site" / "third_party-1.2.dist-info"
    (info / "entry_points.txt").write_text("[ortho_pipeline]\nthird = third_party_plugin : plugin [more]\n")
    assert [broken.error for broken in Host(installed=True).broken] == ["OSError: broken at third_party_plugin.py:2"]


def test_an_entry_point_that_names_no_module_is_left_out_with_a_warning(install, caplog):
    install("third-party", "third-party-plugin", "")  # the name of the distribution, a likely mistake
    host = Host(installed=True)
    assert [broken.distribution for broken in host.broken] == ["third-party"]
    assert "its entry point 'third-party-plugin' does not name a module" in caplog.text
    assert "rpc" in host.sensors


def test_a_distribution_that_has_lost_its_metadata_stops_nothing(install, tmp_path):
    install("third-party", "third_party_plugin", PLUGIN.format(name="third"))
    (tmp_path / "site" / "third_party-1.2.dist-info" / "METADATA").unlink()
    assert Host(installed=True).provenance("third").distribution == "(unknown)"


def test_what_a_plugin_prints_does_not_mix_with_the_document_of_a_command(install, tmp_path: Path):
    talks = PLUGIN.format(name="talkative").replace("lambda dataset: False", "lambda dataset: print('recognising')")
    install("talkative", "talkative_plugin", f"print('imported')\n{talks}")
    _discovered.cache_clear()
    try:
        done = CliRunner().invoke(cli, ["info", str(make_image(tmp_path / "a.tif", make_rpc())), "--json"])
        wrong = CliRunner().invoke(cli, ["info", str(make_image(tmp_path / "b.tif")), "--json"])
    finally:
        _discovered.cache_clear()
    assert json.loads(done.stdout)["sensor"] == "rpc"
    assert done.stderr.startswith("imported\nrecognising\n")
    assert json.loads(wrong.stdout)["error"]["kind"] == "InputError"


def test_bundled_name_cannot_be_shadowed(install):
    install("third-party", "third_party_plugin", PLUGIN.format(name="rpc"))
    with pytest.raises(PluginError, match=r"the sensor 'rpc', but this name belongs to ortho-pipeline\n.*rename"):
        Host(installed=True)


@pytest.mark.parametrize(
    "source",
    [PLUGIN.format(name="rpc"), PLUGIN.format(name=" a "), PLUGIN.format(name="a").replace("_sensors", "_sensor")],
)
def test_the_doctor_lists_what_stops_other_commands(install, source):
    install("third-party", "third_party_plugin", source)
    with pytest.raises(PluginError):
        Host(installed=True)
    document = commands.doctor()
    (broken,) = document["broken"]
    assert (broken["plugin"], broken["distribution"], broken["version"]) == ("third_party_plugin", "third-party", "1.2")
    assert "third_party_plugin (third-party 1.2)" in broken["error"]
    assert "rpc" in document["sensors"]


def test_name_of_a_broken_bundled_plugin_stays_reserved(install):
    install("ortho-pipeline", "bundled_plugin_that_fails", "1 / 0", entry="rpc")
    install("third-party", "third_party_plugin", PLUGIN.format(name="rpc"))
    with pytest.raises(PluginError, match="belongs to ortho-pipeline"):
        Host(installed=True)


def test_two_sensors_of_one_name_are_an_error():
    with pytest.raises(PluginError, match="two plugins offer the sensor 'alpha': one and two"):
        Host([make_plugin(make_sensor(), name="one"), make_plugin(make_sensor(), name="two")])
    with pytest.raises(PluginError, match="plugin offers the sensor 'alpha' twice"):
        Host([make_plugin(make_sensor(), make_sensor())])


def test_misspelt_hook_is_an_error():
    with pytest.raises(
        PluginError, match=r"plugin plugin: .*unknown hook 'ortho_sensor'(.|\n)*did you mean ortho_sensors\?"
    ):
        Host([make_plugin(make_sensor(), hook="ortho_sensor")])


@pytest.mark.parametrize(
    ("hook", "returned", "message"),
    [
        ("ortho_sensors", make_sensor(), r"ortho_sensors returned Sensor\n.*yield the Sensor, or return \[Sensor"),
        ("ortho_sensors", None, "ortho_sensors returned NoneType"),
        ("ortho_models", [RPC], r"ortho_models returned list\n.*return \{kind: class\}"),
    ],
)
def test_hook_that_returns_something_else_is_told_what_to_return(hook, returned, message):
    module = types.ModuleType("other")
    setattr(module, hook, hookimpl(lambda: returned))
    with pytest.raises(PluginError, match=message):
        Host([module])


def test_hook_without_marker_or_with_other_arguments_is_an_error():
    module = types.ModuleType("unmarked")
    module.ortho_sensors = lambda: []
    with pytest.raises(PluginError, match="has no decorator @hookimpl"):
        Host([module])
    module = types.ModuleType("arguments")

    @hookimpl
    def ortho_sensors(dataset):
        return []

    module.ortho_sensors = ortho_sensors
    with pytest.raises(PluginError, match="dataset"):
        Host([module])


@pytest.mark.parametrize(
    ("offered", "message"),
    [
        (["alpha"], "ortho_sensors yields str, not Sensor"),
        ([make_sensor(name=" a ")], "not a valid sensor name"),
        ([make_sensor(recognises=None)], "must be callable"),
        ([make_sensor(options={"band": 3})], "options"),
    ],
)
def test_wrong_type_of_sensor_is_an_error(offered, message):
    with pytest.raises(PluginError, match=message):
        Host([make_plugin(*offered)])


def test_hook_that_raises_names_its_plugin():
    module = types.ModuleType("raising")

    @hookimpl
    def ortho_sensors():
        raise RuntimeError("no luck")

    module.ortho_sensors = ortho_sensors
    with pytest.raises(
        PluginError, match=r"raising: ortho_sensors failed \(RuntimeError: no luck at test_plugins\.py:\d+\)"
    ):
        Host([module])


def test_hooks_are_called_through_pluggy_so_that_wrappers_go_around_them():
    wrapping = types.ModuleType("wrapping")

    @hookimpl(wrapper=True)
    def ortho_sensors():
        offered = yield
        return [[replace(sensor, description="wrapped") for sensor in sensors] for sensors in offered]

    wrapping.ortho_sensors = ortho_sensors
    host = Host([make_plugin(make_sensor("alpha"), name="one"), wrapping, make_plugin(make_sensor("beta"), name="two")])
    assert {name: sensor.description for name, sensor in host.sensors.items()} == {
        "alpha": "wrapped",
        "beta": "wrapped",
    }
    assert host.provenance("beta").plugin == "two"


def test_model_families_are_collected():
    module = types.ModuleType("families")
    module.ortho_models = hookimpl(lambda: {"mine": RPC})
    assert Host([module]).models == {"mine": RPC}
    module.ortho_models = hookimpl(lambda: {"mine": int})
    with pytest.raises(PluginError, match="SensorModel"):
        Host([module])
    module.ortho_models = hookimpl(lambda: {"rpc": SensorModel})
    with pytest.raises(PluginError, match=r"'rpc', but this name belongs to ortho_pipeline.*RPC\n.*another kind"):
        Host([module])


def test_recognises_one_none_or_several(tmp_path):
    image = make_image(tmp_path / "a.tif")
    alpha, beta = make_sensor("alpha"), make_sensor("beta")
    nobody = make_sensor("nobody", recognises=lambda dataset: False)
    assert Host([make_plugin(alpha, nobody)]).open_scene(image).sensor == "alpha"
    with pytest.raises(InputError, match=r"alpha, beta(.|\n)*scene.sensor"):
        Host([make_plugin(alpha, beta)]).open_scene(image)
    with pytest.raises(InputError, match=r"no sensor recognises this image(.|\n)*scene.sensor"):
        Host([make_plugin(nobody)]).open_scene(image)
    assert Host([make_plugin(alpha, beta)]).open_scene(image, "beta").sensor == "beta"
    with pytest.raises(InputError, match=r"unknown sensor 'gamma' \(installed: alpha, beta\)"):
        Host([make_plugin(alpha, beta)]).open_scene(image, "gamma")


def test_fallback_is_asked_last(tmp_path):
    image = make_image(tmp_path / "a.tif", make_rpc())
    assert Host([ortho_rpc, make_plugin(make_sensor("special"))]).open_scene(image).sensor == "special"
    nobody = make_sensor("nobody", recognises=lambda dataset: False)
    assert Host([ortho_rpc, make_plugin(nobody)]).open_scene(image).sensor == "rpc"


def test_undeclared_option_is_refused(tmp_path):
    image = make_image(tmp_path / "a.tif")
    host = Host([make_plugin(make_sensor(options={"band": "which band"}))])
    assert host.open_scene(image, options={"band": "2"}).facts == {"band": "2"}
    with pytest.raises(InputError, match=r"no option 'bannd'; its options: band"):
        host.open_scene(image, options={"bannd": "2"})


def test_recogniser_and_opener_that_raise_name_their_plugin(tmp_path):
    def fail(dataset):
        raise ZeroDivisionError("oops")

    def bad_product(dataset):
        raise InputError("the band is missing")

    image = make_image(tmp_path / "a.tif")
    with pytest.raises(PluginError, match=r"'alpha' of plugin plugin failed to check(.|\n)*oops"):
        Host([make_plugin(make_sensor(recognises=fail))]).open_scene(image)
    with pytest.raises(PluginError, match=r"'alpha' of plugin plugin could not open.*oops at test_plugins\.py:\d+"):
        Host([make_plugin(make_sensor(open_scene=fail))]).open_scene(image)
    with pytest.raises(PluginError, match="report it to the author"):
        Host([make_plugin(make_sensor(open_scene=fail))]).open_scene(image)
    # What the user can correct is said of the file, where the plugin names none.
    with pytest.raises(InputError, match=r"a\.tif: the band is missing"):
        Host([make_plugin(make_sensor(open_scene=bad_product))]).open_scene(image)


def test_a_plugin_cannot_end_the_process_but_a_signal_can(tmp_path):
    def leave(dataset):
        sys.exit(0)

    def ended(dataset):
        raise Terminated(143)

    image = make_image(tmp_path / "a.tif")
    with pytest.raises(PluginError, match="failed to check"):
        Host([make_plugin(make_sensor(recognises=leave))]).open_scene(image)
    with pytest.raises(PluginError, match="could not open"):
        Host([make_plugin(make_sensor(open_scene=leave))]).open_scene(image)
    with pytest.raises(Terminated):
        Host([make_plugin(make_sensor(open_scene=ended))]).open_scene(image)


LATE = """
from dataclasses import dataclass
from typing import ClassVar
from ortho_pipeline.plugin import RPC, Scene, Sensor, hookimpl, rpc_of_dataset

@dataclass(frozen=True, eq=False)
class Late(RPC):
    kind: ClassVar[str] = "late"

    def image_to_ground(self, image, height):
        raise KeyError("no orbit")

@hookimpl
def ortho_models():
    return {"late": Late}

@hookimpl
def ortho_sensors():
    yield Sensor("late", "a test", lambda dataset: dataset.GetDescription().endswith("late.tif"), open_scene)

def open_scene(dataset):
    model = Late.from_dict(rpc_of_dataset(dataset)[0].to_dict())
    return Scene("late", dataset.GetDescription(), dataset.RasterXSize, dataset.RasterYSize, {"late": model}, "here")
"""


def test_a_model_that_fails_after_its_scene_is_open_names_its_plugin(install, tmp_path):
    install("third-party", "third_party_plugin", LATE)
    _discovered.cache_clear()
    try:
        done = CliRunner().invoke(cli, ["info", str(make_image(tmp_path / "late.tif", make_rpc())), "--json"])
        (tmp_path / "run.yaml").write_text("scenes:\n- image: late.tif\n  surface: {height: 700}\n")
        CliRunner().invoke(cli, ["run", str(tmp_path / "run.yaml"), "--executor", "sequential"])
    finally:
        _discovered.cache_clear()
        KINDS.pop("late", None)
    error = json.loads(done.stdout)["error"]
    scene = json.loads((tmp_path / "out" / "run.json").read_text())["scenes"][0]["error"]
    assert (done.exit_code, error["kind"]) == (1, "PluginError")
    told = (
        r"plugin third_party_plugin \(third-party 1\.2\) failed \(KeyError: 'no orbit' at third_party_plugin\.py:11\)"
    )
    assert re.fullmatch(told, error["message"])
    assert "author of the plugin" in error["remedy"]
    assert (scene["kind"], scene["remedy"]) == ("PluginError", error["remedy"])
    assert re.fullmatch(told, scene["message"])


def test_a_damaged_rpc_is_blamed_on_its_file_and_not_on_the_author_of_the_plugin(tmp_path):
    image = make_image(tmp_path / "a.tif")
    side_car = tmp_path / "a_RPC.TXT"
    write_rpc_txt(make_rpc(), side_car)
    side_car.write_text(re.sub(r"LAT_SCALE: *\S+", "LAT_SCALE: +100000.0", side_car.read_text()))
    with pytest.raises(InputError, match="too large for a scene on Earth") as caught:
        Host.discover().open_scene(image)
    assert caught.value.file == str(side_car)
    assert caught.value.field
    assert "author" not in (caught.value.remedy or "author")


@pytest.mark.parametrize(
    "scene",
    [
        None,
        Scene("beta", "a.tif", 20, 16, {"rpc": make_rpc()}, "x"),
        Scene("alpha", "a.tif", 20, 16, {}, "x"),
        Scene("alpha", "a.tif", 20, 16, {"rpc": 3}, "x"),
        Scene("alpha", "a.tif", 0, 16, {"rpc": make_rpc()}, "x"),
    ],
)
def test_wrong_scene_is_an_error(tmp_path, scene):
    host = Host([make_plugin(make_sensor(open_scene=lambda dataset: scene))])
    with pytest.raises(PluginError, match="alpha"):
        host.open_scene(make_image(tmp_path / "a.tif"))


def test_rpc_sensor_opens_a_tagged_file(tmp_path):
    image = make_image(tmp_path / "a.tif", make_rpc(err_bias=3.0))
    scene = Host([ortho_rpc]).open_scene(image)
    assert (scene.width, scene.height, scene.path) == (20, 16, image)
    assert scene.model_source == f"{image} (TIFF tag)"
    assert scene.facts["rpc_err_bias_m"] == 3.0
    assert scene.model.col_off == 10.5
    assert scene.warnings == ()


def test_rpc_option_is_enough_for_a_file_without_rpc(tmp_path):
    image = make_image(tmp_path / "a.tif")
    write_rpc_txt(make_rpc(), tmp_path / "elsewhere.txt")
    host = Host([ortho_rpc, make_plugin(make_sensor("nobody", recognises=lambda dataset: False))])
    scene = host.open_scene(image, options={"rpc": str(tmp_path / "elsewhere.txt")})
    assert (scene.sensor, scene.model_source) == ("rpc", str(tmp_path / "elsewhere.txt"))
    with pytest.raises(InputError, match="no sensor recognises this image"):
        host.open_scene(image)
    with pytest.raises(InputError, match="no sensor recognises this image"):
        host.open_scene(image, options={"rpcc": "x"})


def test_rpc_sensor_warns_of_a_crop_with_the_rpc_of_the_whole(tmp_path):
    scene = Host([ortho_rpc]).open_scene(make_image(tmp_path / "a.tif", make_rpc(col_off=5000.0)))
    assert "crop" in scene.warnings[0]
