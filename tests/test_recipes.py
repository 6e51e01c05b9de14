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
import release
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


def test_the_conda_recipe_takes_the_archive_of_make_dist():
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    archive = (ROOT / "conda" / recipe["source"]["path"]).resolve()
    assert archive == ROOT / "out" / "dist" / "ortho_pipeline-${{ version }}.tar.gz"
    assert "hatchling build --directory out/dist\n" in (ROOT / "Makefile").read_text(encoding="utf-8")


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
    page = (ROOT / "docs" / "citing.md").read_text(encoding="utf-8")
    assert re.findall(r"version = \{(.*)\}", page) == [PROJECT["version"]]


def test_forms_for_issues_are_whole():
    forms = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert forms
    for form in forms:
        found = yaml.safe_load(form.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= set(found)
        assert all(part["type"] and part["attributes"]["label"] for part in found["body"])


def workflow(name: str) -> dict:
    return yaml.safe_load((ROOT / ".github" / "workflows" / f"{name}.yml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["docs", "release", "tests"])
def test_actions_are_pinned_by_their_commits(name):
    text = (ROOT / ".github" / "workflows" / f"{name}.yml").read_text(encoding="utf-8")
    used = re.findall(r"uses: (.*)", text)
    assert used
    for action in used:
        assert action.startswith("./.github/") or re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v[\d.]+", action), action


def test_nothing_is_uploaded_before_the_tag_is_compared_and_all_tests_have_passed():
    jobs = workflow("release")["jobs"]
    order = ["github"]
    while "needs" in jobs[order[-1]]:
        order.append(jobs[order[-1]]["needs"])
    assert order == ["github", "pypi", "attest", "build", "tests", "notes"]
    assert set(order) == set(jobs)
    assert jobs["tests"]["uses"] == "./.github/workflows/tests.yml"
    assert "workflow_call" in workflow("tests")[True]  # YAML reads "on" so
    (checked,) = [step["run"] for step in jobs["notes"]["steps"] if "run" in step]
    assert checked == 'python3 tools/release.py "$GITHUB_REF_NAME" > notes.md'


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A copy of what a release reads, after the step "Address" of RELEASING.md."""
    for name in ("pyproject.toml", "README.md", "CHANGELOG.md"):
        shutil.copy(ROOT / name, tmp_path)
    if "urls" not in PROJECT:
        page = (ROOT / "RELEASING.md").read_text(encoding="utf-8")
        (commands,) = re.findall(r"```\n( +url=.*?)```", page, flags=re.DOTALL)
        subprocess.run(["bash", "-euc", commands], cwd=tmp_path, check=True)
    return tmp_path


def test_pypi_can_follow_the_links_of_the_readme(repository):
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (repository / "README.md").read_text(encoding="utf-8")
    home = re.escape(project["urls"]["Source"])
    files = re.findall(rf"\]\({home}/(?:blob|raw)/HEAD/([^)#]+)", text)
    assert len(files) > 10
    assert all((ROOT / file).exists() for file in files)
    assert release.relative_links(text) == []
    assert re.findall(rf"!\[[^]]*\]\({home}/raw/HEAD/(.*)\)", text) == ["docs/images/sample.png"]


def test_the_notes_of_a_release_are_its_part_of_the_changes(repository):
    version, path = PROJECT["version"], repository / "CHANGELOG.md"
    notes = release.notes(f"v{version}", repository).splitlines()
    assert len(notes) > 3
    assert set(notes) <= set(path.read_text(encoding="utf-8").splitlines())
    head = f"## {version} (2026-01-02)"
    path.write_text(
        f"# Changes\n\n## Unreleased\n\n- New.\n\n{head}\n\nMore.\n\n- A (b).\n- C.\n\n## 0.0.1 (2025-01-02)\n\n- D.\n"
    )
    assert release.notes(f"v{version}", repository) == "More.\n\n- A (b).\n- C.\n"


def test_a_tag_that_is_not_ready_is_refused(repository):
    version = PROJECT["version"]
    with pytest.raises(
        SystemExit, match=rf"the tag is v99\.0\.0, but pyproject\.toml has version {re.escape(version)}"
    ):
        release.notes("v99.0.0", repository)
    readme = repository / "README.md"
    readme.write_text(readme.read_text(encoding="utf-8") + "[a page](docs/install.md)", encoding="utf-8")
    with pytest.raises(SystemExit, match=r"1 links of README\.md are relative \(docs/install\.md"):
        release.notes(f"v{version}", repository)
    (repository / "CHANGELOG.md").write_text(f"# Changes\n\n## Unreleased\n\n- A line.\n\n## {version} (2026-01-02)\n")
    with pytest.raises(SystemExit, match=r"CHANGELOG\.md has no section"):
        release.notes(f"v{version}", repository)
