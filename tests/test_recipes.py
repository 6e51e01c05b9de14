"""Recipes, the citation and the changes say what pyproject.toml says."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from ortho_pipeline.cli.program import cli

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_conda_recipe_has_the_requirements_of_the_package():
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    wanted = {" ".join(re.split(r"(?=>=)", text)) for text in PROJECT["dependencies"]}
    own = {"python >=3.11", "gdal >=3.6", "proj-data"}
    assert set(recipe["requirements"]["run"]) == wanted | own
    assert recipe["context"]["version"] == PROJECT["version"]
    assert recipe["build"]["python"]["entry_points"] == [f"ortho = {PROJECT['scripts']['ortho']}"]


def test_the_conda_recipe_is_one_for_those_who_build_it():
    """rattler-build's own reader takes it, and what it makes of it is this package."""
    rattler_build = pytest.importorskip("rattler_build", reason="rattler-build is not installed")
    recipe = rattler_build.Stage0Recipe.from_file(ROOT / "conda" / "recipe.yaml")
    (rendered,) = recipe.render(rattler_build.VariantConfig())
    package = rendered.recipe().package if callable(rendered.recipe) else rendered.recipe.package
    assert (str(package.name), str(package.version)) == (PROJECT["name"], PROJECT["version"])


def test_the_dockerfile_has_no_faults_that_linters_know():
    hadolint = shutil.which("hadolint", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if hadolint is None:
        pytest.skip("hadolint is not installed")
    done = subprocess.run([hadolint, ROOT / "Dockerfile"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


def test_the_image_is_made_of_what_its_steps_read(tmp_path):
    """The step that compiles is done with the files that are copied for it; the RPC next to the scene was not."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
    copied = [line.split()[1:] for line in text.splitlines() if line.startswith("COPY ") and "--from" not in line]
    for *sources, target in copied:
        for source in (one for one in sources if not one.startswith("--")):
            assert (ROOT / source).exists(), source
            if target == "/tmp/sample/":
                shutil.copy(ROOT / source, tmp_path)
    (step,) = re.findall(r"^RUN ortho (.*?) &&", text, flags=re.MULTILINE)
    words = [
        word.replace("/tmp/sample", str(tmp_path)).replace("/tmp/warm", str(tmp_path / "o")) for word in step.split()
    ]
    result = CliRunner().invoke(cli, words)
    assert result.exit_code == 0, result.output


def test_the_citation_is_of_this_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (cited["version"], cited["license"]) == (PROJECT["version"], PROJECT["license"])


def test_forms_for_issues_are_whole():
    forms = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert forms
    for form in forms:
        found = yaml.safe_load(form.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= set(found)
        assert all(part["type"] and part["attributes"]["label"] for part in found["body"])
