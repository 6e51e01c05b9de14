"""The kit for plugins: the template makes a package whose test passes, and `ortho sensors --test` finds faults."""

from __future__ import annotations

import ast
import importlib.util
import json
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import jinja2
import jinja2.sandbox
import pytest
import yaml
from click.testing import CliRunner, Result
from osgeo import gdal

from ortho_pipeline.cli.program import cli
from ortho_pipeline.host import Host

ROOT = Path(__file__).resolve().parent.parent
KIT = ROOT / "examples" / "plugin_template"
QUESTIONS = yaml.safe_load((KIT / "copier.yml").read_text(encoding="utf-8"))
#: As copier makes it, but names without a value are errors.
JINJA = jinja2.sandbox.SandboxedEnvironment(keep_trailing_newline=True, undefined=jinja2.StrictUndefined)
GIVEN = {"sensor": "norna-2", "title": "Norna's second scenes", "ending": ".norna.txt"}


def answers(given: dict[str, str]) -> dict[str, str]:
    """Return the answers to all questions, with the defaults of those that are not given."""
    found: dict[str, str] = {}
    for name, question in QUESTIONS.items():
        if not name.startswith("_"):
            found[name] = given.get(name) or JINJA.from_string(question["default"]).render(found)
    return found


def refusal(name: str, value: str) -> str:
    """Return what copier says about an answer; nothing if it is good."""
    return JINJA.from_string(QUESTIONS[name]["validator"]).render({**answers(GIVEN), name: value}).strip()


def render(folder: Path, given: dict[str, str]) -> Path:
    """Write the package as copier does: a name that ends with .jinja is rendered without it, all else is copied."""
    source = KIT / QUESTIONS["_subdirectory"]
    for path in sorted(one for one in source.rglob("*") if one.is_file()):
        name = JINJA.from_string(path.relative_to(source).as_posix()).render(answers(given))
        target, text = folder / name.removesuffix(".jinja"), path.read_text(encoding="utf-8")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(JINJA.from_string(text).render(answers(given)) if name != target.name else text, "utf-8")
    return folder


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(tmp_path_factory.mktemp("kit") / "ortho-norna-2", GIVEN)


@pytest.fixture(scope="module")
def product(package: Path) -> Path:
    """Return an image with the metadata that the created test has."""
    image = package.parent / "scene.tif"
    gdal.GetDriverByName("GTiff").Create(str(image), 40, 30)
    tree = ast.parse((package / "tests" / "test_ortho_norna_2.py").read_text(encoding="utf-8"))
    (text,) = [
        node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and node.targets[0].id == "METADATA"  # type: ignore[attr-defined]
    ]
    image.with_name("scene.norna.txt").write_text(text, encoding="utf-8")
    return image


@pytest.mark.parametrize("given", [GIVEN, {}], ids=["answers", "defaults"])
def test_the_test_of_the_created_package_passes(given: dict[str, str], tmp_path: Path) -> None:
    render(tmp_path / "made", given)
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "made"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 passed" in done.stdout


def test_the_created_package_declares_its_sensor(package: Path) -> None:
    project = tomllib.loads((package / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["name"] == "ortho-norna-2"
    assert project["project"]["entry-points"]["ortho_pipeline"] == {"norna-2": "ortho_norna_2"}
    assert (package / "ortho_norna_2.py").is_file()
    assert project["tool"]["hatch"]["build"]["targets"]["wheel"]["include"] == ["ortho_norna_2.py"]
    assert "{{" not in "".join(path.read_text(encoding="utf-8") for path in package.rglob("*.*") if path.is_file())


def test_the_created_package_imports_what_is_public(package: Path) -> None:
    for path in package.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        hosts = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
        hosts = {name for name in hosts if name.startswith("ortho_pipeline")}
        assert hosts <= {"ortho_pipeline.plugin", "ortho_pipeline.testing"}


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("sensor", ("norna", "norna-2", "n2"), ("Norna", "2norna", "-n", "nor na", "nor_na", "", "nørna")),
        ("title", ("Norna-2, level 1", "Norna's"), ('the "best"', "a\\b", "a {b}", "}")),
        ("ending", ("_rpc.txt", ".norna.json"), ("", 'a"', "\\x.txt")),
    ],
)
def test_answers_that_make_no_package_are_refused(name: str, good: tuple[str, ...], bad: tuple[str, ...]) -> None:
    assert [refusal(name, value) for value in good] == ["" for _ in good]
    assert all(refusal(name, value) for value in bad)


# -- ortho sensors --test ----------------------------------------------------------------------------------------------


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def installed(package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that installs the created module, with parts of its text replaced."""

    def install(*changes: tuple[str, str]) -> Path:
        text = (package / "ortho_norna_2.py").read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "ortho_norna_2.py"
        path.write_text(text, encoding="utf-8")
        monkeypatch.delitem(sys.modules, "ortho_norna_2", raising=False)
        host = Host([load(path)], installed=True)
        monkeypatch.setattr(Host, "discover", classmethod(lambda _: host))
        return path

    yield install
    sys.modules.pop("ortho_norna_2", None)


def run(*words: object) -> Result:
    return CliRunner().invoke(cli, ["sensors", *map(str, words)], prog_name="ortho")


def test_a_good_plugin_passes_and_what_was_tested_is_printed(installed: Any, product: Path) -> None:
    installed()
    done = run("--test", "norna-2", product)
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith(f"The sensor norna-2 passes the contract with {product}.\n")
    assert "40 x 30 pixels" in done.stdout
    assert "model rpc: " in done.stdout
    assert (
        f"Not tested: where the camera looks. Compare the corners with the vendor's: ortho info {product}"
        in done.stdout
    )
    document = json.loads(run("--test", "ortho_norna_2", product, "--json").stdout)
    assert document["schema_version"] == 1
    assert (document["sensor"], document["models"], document["size"]) == ("norna-2", {"rpc": "rpc"}, [40, 30])
    assert document["facts"] == {"acquired": "2026-03-01T10:00:00Z"}
    assert document["recognised"] is True


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (".is_file()", ".parent.exists()", "recognises returns True for a raster in memory"),
        ("dataset.RasterXSize, ", "1 + dataset.RasterXSize, ", "the scene has the size 41 x 30, the file 40 x 30"),
        ("facts=facts", 'facts={"sun": float("nan")}', "facts"),
        ("    size = dataset", "    size = datset", "the plugin failed (NameError: name 'datset' is not defined at "),
        (
            "    size = dataset",
            '    assert 0, "mine"\n    size = dataset',
            "the plugin failed (AssertionError: mine at ",
        ),
        ("    size = dataset", "    raise SystemExit(0)\n    size = dataset", "the plugin failed (SystemExit: 0 at "),
        (
            "def recognises(dataset: Any) -> bool:",
            "def recognises(dataset: Any) -> bool:\n    1 / 0",
            "ZeroDivisionError",
        ),
    ],
    ids=["too broad", "size", "nan", "name", "assertion", "exit", "recognises"],
)
def test_a_fault_names_requirement_file_and_remedy(
    installed: Any, product: Path, old: str, new: str, text: str
) -> None:
    path = installed((old, new))
    done = run("--test", "norna-2", product, "--json")
    assert done.exit_code == 1, done.output
    assert "Traceback" not in done.output
    error = json.loads(done.stdout)["error"]
    assert error["kind"] == "PluginError"
    assert text in error["message"]
    assert (error["file"], error["field"]) == (str(path), "norna-2")
    assert error["remedy"].endswith(f"test again: `ortho sensors --test norna-2 {product}`")


def test_a_damaged_product_is_an_error_of_the_product(installed: Any, product: Path, tmp_path: Path) -> None:
    installed()
    image = tmp_path / "scene.tif"
    image.write_bytes(product.read_bytes())
    image.with_name("scene.norna.txt").write_text("ACQUIRED: 2026-03-01", encoding="utf-8")
    done = run("--test", "norna-2", image)
    assert done.exit_code == 2
    assert "scene.norna.txt: this is not the metadata of Norna's second scenes (KeyError: 'LINE_OFF')" in done.stderr


@pytest.mark.parametrize(
    ("words", "texts"),
    [
        (["--test", "norna-2"], ["an image of the sensor 'norna-2' is missing", "ortho sensors --test norna-2 IMAGE"]),
        (["--test", "nix", "a.tif"], ["no installed sensor or plugin has the name 'nix'"]),
        (
            ["--test", "ortho-pipeline", "a.tif"],
            ["has several sensors: asp, bilsat,", "ortho sensors --test asp IMAGE"],
        ),
        (["--test", "norna-2", "a.tif"], ["a.tif"]),
        (["--test", "norna-2", "a.tif", "--sensor-option", "a=1"], ["the sensor 'norna-2' has no option 'a'"]),
        (["a.tif"], ["Unexpected argument 'a.tif' for 'sensors'", "ortho sensors --test NAME IMAGE"]),
        (["--sensor-option", "a=1"], ["Unexpected argument '--sensor-option'"]),
    ],
)
def test_what_a_person_can_correct_is_exit_code_2(installed: Any, words: list[str], texts: list[str]) -> None:
    installed()
    done = run(*words)
    assert done.exit_code == 2, done.output
    assert all(text in done.stderr for text in texts), done.stderr


def test_an_option_of_the_sensor_reaches_the_plugin(installed: Any, product: Path) -> None:
    installed(
        ("recognises, open_scene)", 'recognises, open_scene, {"when": "date"})'),
        ("open_scene(dataset: Any)", 'open_scene(dataset: Any, when: str = "")'),
        ("facts=facts", 'facts={**facts, "when": when}'),
    )
    done = run("--test", "norna-2", product, "--sensor-option", "when=now", "--json")
    assert json.loads(done.stdout)["facts"]["when"] == "now"


def test_a_plugin_that_cannot_be_imported_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    from ortho_pipeline.host.registry import Broken

    broken = Broken("norna-2", "ortho-norna-2", "0.1.0", "SyntaxError: invalid syntax (ortho_norna_2.py, line 9)")
    monkeypatch.setattr(Host, "broken", (broken,))
    for name in ("norna-2", "ortho-norna-2", "ortho_norna_2"):
        done = run("--test", name, "a.tif")
        assert done.exit_code == 1
        assert "norna-2: the plugin cannot be imported (SyntaxError: invalid syntax" in done.stderr


def test_without_assertions_nothing_is_promised() -> None:
    code = (
        "from click.testing import CliRunner; from ortho_pipeline.cli.program import cli; import sys; "
        "done = CliRunner().invoke(cli, sys.argv[1:]); print(done.output); sys.exit(done.exit_code)"
    )
    words = ["sensors", "--test", "rpc", str(ROOT / "sample_data" / "scene.tif")]
    done = subprocess.run([sys.executable, "-O", "-c", code, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "unset PYTHONOPTIMIZE" in done.stdout
