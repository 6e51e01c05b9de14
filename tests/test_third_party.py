"""A sensor of somebody else: built, installed next to the host in a fresh environment, used from the command line."""

from __future__ import annotations

import ast
import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import make_reference
import numpy as np
import pytest
from ortho_studies import hookspecs as of_studies
from osgeo import gdal

from ortho_pipeline import hookspecs, plugin
from ortho_pipeline.testing import check_sensor_model

ROOT = Path(__file__).resolve().parent.parent
EXAMPLE = ROOT / "examples" / "ortho_tinysat"
TUTORIAL = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
REFERENCE = (ROOT / "docs" / "plugin-reference.md").read_text(encoding="utf-8")


def run(*command, **options) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


#: Runs the command lines that it is given, in one process, and prints how each ended.
SEVERAL = """
import json, sys
from click.testing import CliRunner
from ortho_pipeline.cli.program import cli
ended = [CliRunner().invoke(cli, words) for words in json.loads(sys.argv[1])]
print(json.dumps([(one.exit_code, one.stdout) for one in ended]))
"""


def several(fresh: Path, *lines: list[object]) -> list[tuple[int, str]]:
    """Return exit code and output of command lines of the fresh environment."""
    words = json.dumps([[str(word) for word in line] for line in lines])
    return [(code, told) for code, told in json.loads(run(fresh / "python", "-c", SEVERAL, words))]


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """Return the folder of the programs of a new environment that has host and plugin, both from wheels."""
    folder = tmp_path_factory.mktemp("fresh")
    wheels, home = folder / "wheels", folder / "venv"
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", wheels, ROOT, EXAMPLE)
    run(sys.executable, "-m", "venv", "--without-pip", home)
    python = home / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-index",
        *wheels.glob("*.whl"))  # fmt: skip
    # Everything that host and plugin need is taken from where the tests run; they themselves are not.
    site = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    Path(site, "needs.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    where = run(python, "-c", "import ortho_pipeline, ortho_tinysat as t; print(ortho_pipeline.__file__, t.__file__)",
                cwd=folder)  # fmt: skip
    assert all(Path(path).is_relative_to(home) for path in where.split())
    return home / "bin"


@pytest.fixture
def tinysat(tmp_path):
    """Return an image with the flight that the tutorial prints."""
    image = tmp_path / "scene.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(image), 120, 90)
    dataset.GetRasterBand(1).Fill(100)
    dataset = None
    (flight,) = re.findall(r"```json\n(.*?)```", TUTORIAL, re.DOTALL)
    (tmp_path / "scene.tinysat.json").write_text(flight, encoding="utf-8")
    return image


def test_the_plugin_is_not_there_unless_it_is_installed():
    assert subprocess.run([sys.executable, "-c", "import ortho_tinysat"], check=False, capture_output=True).returncode


def test_its_own_tests_pass(fresh, tmp_path):
    run(fresh / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", EXAMPLE / "tests", cwd=tmp_path)


def test_the_command_line_has_the_sensor(fresh, tinysat):
    listed = json.loads(run(fresh / "ortho", "sensors", "--json"))["sensors"]
    (sensor,) = [sensor for sensor in listed if sensor["name"] == "tinysat"]
    assert sensor["distribution"] == "ortho-tinysat"
    # GDAL's engine needs no kernels, which are compiled once more for an environment of its own.
    rectify = ["rectify", tinysat, "--height", "0", "-r", "nearest", "--engine", "gdal", "-o", tinysat.parent / "out"]
    (code, told), (made_code, made_told) = several(fresh, ["info", tinysat, "--json"], [*rectify, "--json"])
    assert (code, made_code) == (0, 0), (told, made_told)
    found, made = json.loads(told), json.loads(made_told)
    assert found["sensor"] == "tinysat"
    assert found["gsd_m"] == pytest.approx(10, rel=0.01)
    ortho = gdal.Open(made["files"]["ortho"])
    assert (ortho.ReadAsArray() == 100).sum() == pytest.approx(120 * 90, rel=0.02)


def test_the_points_of_the_tutorial_adjust_it(fresh, tinysat):
    (points,) = blocks_of("points.csv")
    tinysat.with_name("points.csv").write_text(points, encoding="utf-8")
    (command,) = re.findall(r"^ortho (fit scene\.tif .*)$", TUTORIAL, re.MULTILINE)
    document = json.loads(run(fresh / "ortho", *command.split(), "--json", cwd=tinysat.parent))
    assert document["parameters"]["roll"]["value"] == pytest.approx(1e-4, abs=1e-5)
    assert document["parameters"]["delay"]["value"] == pytest.approx(0.004, abs=4e-4)
    assert document["rmse"]["control"]["total"] < 1
    assert document["rmse"]["check"]["total"] < 1


def test_the_test_of_the_tutorial_runs_as_it_is_printed(fresh, tinysat, tmp_path):
    (text,) = blocks_of("test_tinysat.py")
    folder = tmp_path / "tests"
    shutil.copytree(tinysat.parent, folder / "data", ignore=shutil.ignore_patterns("tests"))
    (folder / "test_tinysat.py").write_text(text, encoding="utf-8")
    run(fresh / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", folder, cwd=tmp_path)


def test_its_command_is_one_of_ortho(fresh, tinysat):
    assert "\n  flight  " in run(fresh / "ortho", "--help")
    (helped, shown), (code, told) = several(fresh, ["flight", "--help"], ["flight", tinysat, "--json"])
    assert (helped, code) == (0, 0)
    assert "ortho flight scene.tif" in shown
    # The tutorial prints a speed of 7.5 km/s at 500 km, rounded.
    assert json.loads(told) == {"height": pytest.approx(500e3, abs=1), "speed": pytest.approx(7500, abs=1)}


@pytest.mark.slow
def test_its_study_is_a_command_of_simulate_and_reproduce(fresh, tmp_path):
    helped, simulated, refused = several(
        fresh,
        ["simulate", "--help"],
        ["simulate", "tinysat", "-o", tmp_path, "--noise", "0.1", "--json"],
        ["simulate", "tinysat", "-o", tmp_path, "--noise", "-1"],
    )
    assert "A TinySat-1 scene over Rome" in helped[1]
    assert refused[0] == 2
    made = json.loads(simulated[1])["files"]
    fitted, reproduced = several(
        fresh,
        ["fit", made["image"], "--gcps", made["gcps"], "--correction", "model", "--json"],
        ["reproduce", "tinysat", "--realisations", "20", "-o", tmp_path / "page", "--json"],
    )
    roll = json.loads(fitted[1])["parameters"]["roll"]
    assert roll["value"] == pytest.approx(1e-4, abs=4 * roll["sigma"])
    found = reproduced[1]
    # Student's t with ten degrees of freedom has a spread of 1.12; 20 draws of it scatter by 0.2.
    assert json.loads(found)["spread"]["roll"] == pytest.approx(1.12, abs=0.5)
    assert (tmp_path / "page" / "tinysat.html").read_text().startswith("<!doctype html>")


# -- the tutorial ----------------------------------------------------------------------------------------------------


def blocks_of(name: str, page: str = TUTORIAL) -> list[str]:
    """Return the parts of a file that a page prints."""
    return re.findall(rf"<!-- {re.escape(name)} -->\n```\w*\n(.*?)```", page, re.DOTALL)


def test_the_camera_of_the_reference_looks_where_it_says():
    found = {}
    exec(blocks_of("frame", REFERENCE)[0], found)
    model = found["model"]
    centre, half = model.domain
    check_sensor_model(model, centre + np.array([[0, 0, 0], [0.5, 0.3, 0.9], [-0.5, -0.4, -0.9]]) * half)
    # Flying east with the right wing down it looks to the left: north, by height times tan 2 degrees.
    lon, lat, _ = model.image_to_ground([[2000, 1500]], 0.0)[0]
    assert lon == pytest.approx(12.5, abs=1e-9)
    assert (lat - 41.9) * 111_070 == pytest.approx(2500 * np.tan(np.radians(2)), rel=1e-3)
    # Forwards is up in the image.
    assert model.image_to_ground([[2000, 0]], 0.0)[0, 0] > lon


def test_the_tutorial_is_the_example():
    for name in ("pyproject.toml", *(path.name for path in EXAMPLE.glob("*.py"))):
        parts = [text.strip("\n") for text in blocks_of(name)]
        assert "\n\n\n".join(parts) + "\n" == (EXAMPLE / name).read_text(encoding="utf-8"), name


def test_everything_that_an_author_can_use_is_in_the_reference():
    hooks = [name for name, value in vars(hookspecs).items() if hasattr(value, "ortho_pipeline_spec")]
    hooks += [name for name, value in vars(of_studies).items() if hasattr(value, "ortho_studies_spec")]
    assert len(hooks) == 5
    for name in hooks:
        assert f"`{name}`" in REFERENCE, f"{name} is not explained in docs/plugin-reference.md"


def test_every_field_of_what_plugins_return_is_described():
    page = make_reference.plugin_fields()
    for kind in make_reference.FIELDS:
        section = re.search(rf"^## {kind.__name__}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
        for field in dataclasses.fields(kind):
            # Two fields of one type may share an entry: `width, height`.
            assert re.search(rf"^- `(\w+, )?{field.name}(, \w+)?` .*: \S", section[1], re.MULTILINE), (kind, field.name)


def test_every_name_for_plugins_is_documented():
    assert not [name for name in plugin.__all__ if not make_reference.plugin_text(name)]
    listed = re.findall(r"^\| `(\w+)` \| \S.* \|$", make_reference.plugin_names(), re.MULTILINE)
    assert sorted(listed) == plugin.__all__


@pytest.mark.parametrize("path", sorted(EXAMPLE.rglob("*.py")), ids=lambda path: path.name)
def test_the_example_imports_what_is_public(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    named = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    named |= {one.name for node in ast.walk(tree) if isinstance(node, ast.Import) for one in node.names}
    hosts = {name for name in named if name.partition(".")[0] == "ortho_pipeline"}
    assert hosts <= {"ortho_pipeline", "ortho_pipeline.plugin", "ortho_pipeline.testing"}


def test_the_example_stays_small():
    assert len((EXAMPLE / "ortho_tinysat.py").read_text(encoding="utf-8").splitlines()) < 125
    assert not os.access(EXAMPLE / "__init__.py", os.F_OK)
