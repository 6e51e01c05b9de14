"""The command line: names, exit codes, JSON, and a start that does not wait for heavy libraries."""

from __future__ import annotations

import errno
import importlib
import json
import pkgutil
import subprocess
import sys
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result

from ortho_pipeline import cli as rooms
from ortho_pipeline import commands
from ortho_pipeline.cli.program import COMMANDS as KNOWN
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import ModelError

HEAVY = ("numba", "matplotlib", "scipy", "pyproj", "osgeo", "numpy")


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def fit_arguments(tiny: Any) -> list[Any]:
    return [tiny.image, "--gcps", tiny.gcps, "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]


def test_help_does_not_load_heavy_libraries():
    code = (
        "import sys; from click.testing import CliRunner; from ortho_pipeline.cli.program import cli; "
        "r = CliRunner().invoke(cli, ['rectify', '--help']); assert r.exit_code == 0, r.output; "
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_help_of_all_commands_loads_none_of_them():
    code = (
        "import sys; from click.testing import CliRunner; from ortho_pipeline.cli.program import cli; "
        "r = CliRunner().invoke(cli, ['--help']); assert 'rectify' in r.output, r.output; "
        "print(*sorted(name for name in sys.modules if name.startswith('ortho_')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert [name.removeprefix("ortho_pipeline.") for name in done.stdout.split()] == [
        "ortho_measure", "ortho_pipeline", "cli", "cli.machine", "cli.machine.added", "cli.machine.terminal",
        "cli.program", "errors", "hookspecs", "host", "host.registry", "plugin",
        "runtime", "runtime.lazy_names", "ortho_studies",
    ]  # fmt: skip


def test_what_is_said_of_commands_before_they_are_loaded_is_what_they_say():
    ctx = click.Context(cli)
    told = KNOWN | {name: (offer.target, offer.summary) for name, offer in cli.added.offers.items()}
    assert {"measure", "reproduce", "simulate"} <= set(told)
    for name, (module, said) in told.items():
        command = cli.get_command(ctx, name)
        assert command is not None
        assert (command.name, command.get_short_help_str(1000)) == (name, said), f"correct what is said of {module}"
    # No command is missing there: each that stands in a module of the room is known, or of a group.
    found = {
        one
        for module in pkgutil.walk_packages(rooms.__path__, f"{rooms.__name__}.")
        for one in vars(importlib.import_module(module.name)).values()
        if isinstance(one, click.Command)
    }
    # Subcommands of cache are of their own: one has the name of a command.
    found -= {*cli.get_command(ctx, "cache").commands.values()}
    assert {command.name for command in found} == {*KNOWN, "cli"}


def test_python_m_is_the_same_command():
    done = subprocess.run(
        [sys.executable, "-m", "ortho_pipeline", "--help"], capture_output=True, text=True, check=True
    )
    for command in ("sensors", "models", "info", "fit", "compare", "rectify", "export", "report", "doctor"):
        assert f"\n  {command} " in done.stdout


@pytest.mark.parametrize(("words", "code"), [(["--version"], 0), (["rectify", "--nonsense"], 2)])
def test_the_process_ends_with_its_code_and_what_was_asked_for_at_the_end(words, code):
    program = (
        "import atexit, sys; atexit.register(print, 'at the end'); from ortho_pipeline.cli.program import main; "
        f"sys.argv = ['ortho', *{words!r}]; main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (code, "at the end")
    assert "Traceback" not in done.stderr


def test_an_ortho_without_points_loads_nothing_that_few_need(tiny, tmp_path):
    """numba loads scipy.linalg with compiled kernels; the others take a tenth of a second each."""
    words = ["rectify", str(tiny.image), "--height", "700", "-o", str(tmp_path / "out"), "-tr", "20"]
    code = (
        f"import sys; from ortho_pipeline.cli.program import main; sys.argv = ['ortho', *{words!r}]\n"
        "try: main()\nfinally: print([name for name in ('scipy.special', 'scipy.stats', "
        "'scipy.ndimage', 'matplotlib', 'pystac', "
        "'ortho_pipeline.report.stac') if name in sys.modules])"
    )
    # Kernels are compiled in the first run, which loads more.
    run(*words)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_importing_the_package_is_light():
    code = f"import sys, ortho_pipeline; print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there():
    import ortho_pipeline

    for name in dir(ortho_pipeline):
        assert getattr(ortho_pipeline, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = ortho_pipeline.nonsense


@pytest.mark.parametrize("command", ["sensors", "doctor"])
def test_lists_print_text_and_json(command):
    assert "rpc" in run(command).output
    document = json.loads(run(command, "--json").stdout)
    assert document["schema_version"] == 1


def test_doctor_names_versions_grids_and_plugins():
    document = json.loads(run("doctor", "--json").stdout)
    assert document["gdal"]["version"] == document["gdal"]["bindings"].split("-")[0]
    assert {grid["datum"] for grid in document["grids"]} >= {"egm96", "egm2008"}
    assert document["plugins"][0]["distribution"] == "ortho-pipeline"
    assert document["plugins"][0]["version"]


def test_info_says_where_the_model_was_read(tiny):
    document = json.loads(run("info", tiny.image, "--json").stdout)
    assert document["sensor"] == "rpc"
    assert "tiny.tif" in document["model_source"]
    assert document["gsd_m"] == pytest.approx(4.8, abs=0.05)
    assert document["utm"] == "EPSG:32734"
    assert document["model_source"] in run("info", tiny.image).output
    lon, lat = document["corners_lon_lat"][0]
    assert f"Corners    lon,lat {lon:.5f},{lat:.5f}" in run("info", tiny.image).output


def test_fit_prints_the_documented_json(tiny):
    done = run("fit", *fit_arguments(tiny), "--check", "ids:p1,p2", "--json")
    assert done.exit_code == 0, done.stderr
    document = json.loads(done.stdout)
    expected = {
        "schema_version", "sensor", "model", "model_source", "parameters", "points", "rmse", "raw_bias",
        "redundancy", "sigma0", "rejected", "outlying", "rmse_of_agreeing_checks", "warnings", "notices", "statistics",
        "removed", "covariance", "map_scale",
    }  # fmt: skip
    assert set(document) == expected
    assert document["model"] == "rpc+shift"
    assert set(document["parameters"]) == {"col_shift", "row_shift"}
    assert document["parameters"]["col_shift"].keys() == {"value", "sigma"}
    assert [point["role"] for point in document["points"]].count("check") == 2
    point = document["points"][0]
    assert set(point) == {"id", "role", "used", "image", "predicted", "residual", "loo_residual"}
    assert point["residual"][0] == pytest.approx(point["image"][0] - point["predicted"][0])
    assert set(document["rmse"]) == {"control", "check", "loo"}
    assert document["rmse"]["check"].keys() == {"col", "row", "total", "n"}
    assert document["redundancy"] == 2 * 10 - 2


def test_fit_prints_a_table_with_every_point(tiny):
    output = run("fit", *fit_arguments(tiny)).stdout
    for number in range(12):
        assert f"\np{number} " in output
    assert "RMSE control" in output
    assert "measured minus predicted" in output


def test_fit_leads_with_check_points_that_contradict_the_control(tiny):
    rows = tiny.points(14)
    rows[12] = (rows[12][0], rows[12][1] + 9.0, *rows[12][2:])
    tiny.write(tiny.gcps, rows)
    done = run("fit", *fit_arguments(tiny), "--check", "ids:p10,p11,p12,p13")
    against = "1 of 4 check points contradicts the control points (p12)"
    assert done.stdout.index(against) < done.stdout.index("RMSE control")
    assert "map scale 1:" not in done.stdout
    assert done.stderr.count("Error: ") == 1
    fine = run("fit", *fit_arguments(tiny), "--check", "ids:p10,p11,p13")
    assert "map scale 1:" in fine.stdout


def test_rectify_takes_the_names_of_gdalwarp(tiny, tmp_path):
    out = tmp_path / "out"
    done = run(
        "rectify", *fit_arguments(tiny), "--dem", tiny.dem, "--dem-vertical", "ellipsoid", "-t_srs", "EPSG:32734",
        "-tr", "10", "-te", "403000", "6680100", "404000", "6681100", "-r", "cubic", "-of", "GTiff",
        "-co", "COMPRESS=LZW", "-o", out, "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.stderr
    document = json.loads(done.stdout)
    assert set(document) == {"schema_version", "files", "report"}
    from osgeo import gdal

    ortho = gdal.Open(document["files"]["ortho"])
    assert ortho.GetGeoTransform() == (403000, 10, 0, 6681100, 0, -10)
    assert (ortho.RasterXSize, ortho.RasterYSize) == (100, 100)
    assert ortho.GetMetadataItem("COMPRESSION", "IMAGE_STRUCTURE") == "LZW"


@pytest.mark.parametrize("wrong", [["--demm", "x"], ["-co", "NOVALUE"], ["--res", "1"], ["--resampling", "sinc"]])
def test_a_wrong_option_is_refused(tiny, tmp_path, wrong):
    done = run("rectify", tiny.image, "-o", tmp_path / "out", "--height", "500", *wrong)
    assert done.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_an_unknown_creation_option_is_refused(tiny, tmp_path):
    done = run("rectify", tiny.image, "-o", tmp_path / "out", "--height", "500", "-co", "KOMPRESS=LZW")
    assert done.exit_code == 2
    assert "KOMPRESS" in done.stderr
    assert not list((tmp_path / "out").glob("*.tif")) if (tmp_path / "out").exists() else True


def test_what_the_user_can_correct_is_exit_code_2_with_a_remedy(tiny, tmp_path):
    done = run("rectify", tiny.image, "-o", tmp_path / "out", "--json")
    assert done.exit_code == 2
    assert "--height" in done.stderr
    error = json.loads(done.stdout)["error"]
    assert error["kind"] == "InputError"
    assert error["field"] == "--dem"
    assert error["remedy"]


def test_a_missing_file_is_named():
    done = run("info", "no/such/file.tif")
    assert done.exit_code == 2
    assert "no/such/file.tif" in done.stderr


def test_failure_and_interruption_have_their_exit_codes(monkeypatch):
    def fail(**_: bool) -> None:
        raise ModelError("the mathematics failed")

    def interrupt(**_: bool) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "doctor", fail)
    assert run("doctor").exit_code == 1
    monkeypatch.setattr(commands, "doctor", interrupt)
    done = run("doctor")
    assert done.exit_code == 130
    assert "Interrupted" in done.stderr


# -- faults ----------------------------------------------------------------------------------------------------------

WITHOUT_GDAL = """
import json, sys
sys.modules["osgeo"] = None
from click.testing import CliRunner
from ortho_pipeline.cli.program import cli
done = {line: CliRunner().invoke(cli, line.split()) for line in sys.argv[1:]}
print(json.dumps({line: [one.exit_code, one.stdout, one.stderr] for line, one in done.items()}))
"""
COMMANDS = [
    "doctor", "sensors", "models", "info a.tif", "fit a.tif --gcps b.csv", "compare a.tif --gcps b.csv",
    "rectify a.tif --height 5 -o out", "export a.tif -o out", "report a.json --plots out", "edge a.tif", "init .",
    "adjust a.tif b.tif --points c.csv -o out", "intersect a.tif b.tif --points c.csv", "run a.yaml",
    "simulate ikonos -o out", "reproduce bilsat", "register a.tif b.tif -o out", "dem-check a.tif --points b.csv",
    "match a.tif --reference b.tif --height 5 -o c.csv", "ties a.tif b.tif --height 5 -o c.csv",
    "measure a.tif --reference b.tif --height 5 -o c.geojson", "mosaic a.tif b.tif -o c.tif",
    "cache list", "stack a.tif b.tif -o out",
    "verify a.tif --reference b.tif", "align a.tif --reference b.tif -o out",
    "sharpen a.tif b.tif -o out",
]  # fmt: skip


def test_without_gdal_every_command_says_one_line_and_its_remedy(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_GDAL, *COMMANDS], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    for code, stdout, stderr in json.loads(done.stdout).values():
        lines = stderr.splitlines()
        assert (code, stdout, len(lines)) == (2, "", 2), stderr
        assert lines[0].startswith("Error: cannot load the Python bindings of GDAL")
        assert lines[1].startswith("  Remedy: run 'make setup'")
    assert set(cli.list_commands(click.Context(cli))) == {line.split()[0] for line in COMMANDS}
    assert not list(tmp_path.iterdir())


def test_an_unforeseen_error_is_one_line_and_a_traceback_only_with_debug(monkeypatch):
    def fail(**_: bool) -> None:
        raise KeyError("nobody thought of this")

    monkeypatch.setattr(commands, "doctor", fail)
    done = run("doctor", "--json")
    assert done.exit_code == 1
    assert "nobody thought of this" in done.stderr
    assert "--debug" in done.stderr
    assert "Traceback" not in done.stderr
    assert json.loads(done.stdout)["error"]["kind"] == "OrthoError"
    shown = run("doctor", "--debug")
    assert shown.exit_code == 1
    assert "Traceback" in shown.stderr
    assert 'raise KeyError("nobody' in shown.stderr


def test_debug_shows_where_a_wrong_request_was_found():
    assert "Traceback" not in run("info", "no/such/file.tif").stderr
    assert "Traceback" in run("info", "no/such/file.tif", "--debug").stderr


def test_verbose_says_what_is_done(tiny):
    words = [sys.executable, "-m", "ortho_pipeline", "info", str(tiny.image)]
    quiet, loud = (
        subprocess.run([*words, *more], capture_output=True, text=True, check=True).stderr for more in ([], ["-v"])
    )
    assert "GTiff" not in quiet
    assert "tiny.tif: opened by GTiff" in loud
    assert "sensor rpc" in loud


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (("rectify", "a.tif", "--json"), "--output"),
        (("info", "a.tif", "--nope", "--json"), "--nope"),
        (("info", "--json"), "image"),
        (("--nope", "info", "--json"), "--nope"),
        (("fly", "--json"), None),
        (("rectify", "a.tif", "-o", "out", "-wm", "much", "--json"), "--memory"),
    ],
)
def test_usage_errors_are_documents_too(words, field):
    done = run(*words)
    assert done.exit_code == 2
    document = json.loads(done.stdout)
    assert document["error"]["kind"] == "UsageError"
    assert document["error"]["field"] == field
    assert document["error"]["remedy"]
    assert document["error"]["message"] in done.stderr


def test_a_full_disk_that_receives_what_is_printed_is_no_bug(monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("ortho_pipeline.cli.machine.installed.say", full)
    done = CliRunner().invoke(cli, ["sensors"])
    assert done.exit_code == 1
    assert "cannot write (No space left on device)\n  Remedy: free some space" in done.output
