"""What the documentation says is run: Python as doctests, commands as far as they can be."""

from __future__ import annotations

import doctest
import inspect
import os
import re
import shlex
import sys
import tomllib
from pathlib import Path

import click
import pytest

import ortho_pipeline
from ortho_pipeline.cli.program import COMMANDS as HOST
from ortho_pipeline.cli.program import cli

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("sample_data/**/*.md")])
OPTIONS = doctest.NORMALIZE_WHITESPACE


#: Tutorials are run by tests/test_tutorials.py, docstrings (docs/reference) by tests/test_docstrings.py.
WITH_PYTHON = [
    page for page in PAGES if ">>> " in page.read_text() and page.parent.name not in ("tutorials", "reference")
]


@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: page.name)
def test_python_examples(page, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    done = doctest.testfile(str(page), module_relative=False, globs={"out": tmp_path}, optionflags=OPTIONS)
    assert done.attempted
    assert not done.failed


def test_every_public_name_is_on_the_page():
    page = (ROOT / "docs" / "api.md").read_text()
    missing = [name for name in ortho_pipeline.__all__ if f"`{name}" not in page and f"op.{name}" not in page]
    assert not missing


def commands(page: Path) -> list[str]:
    """Return the lines of code blocks that start with `ortho`, continued lines joined; sessions are run elsewhere."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    found = re.findall(r"^```([^\n`]*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    blocks = [block for language, block in found if language != "console"]
    return [line.strip() for block in blocks for line in block.splitlines() if line.strip().startswith("ortho ")]


COMMANDS = [pytest.param(line, id=f"{page.name}: {line[:60]}") for page in PAGES for line in commands(page)]


@pytest.fixture
def with_tinysat(monkeypatch):
    """Have the plugin that docs/plugins.md builds."""
    from ortho_studies import studies

    monkeypatch.syspath_prepend(str(ROOT / "examples" / "ortho_tinysat"))
    import ortho_tinysat_flight
    import ortho_tinysat_study

    monkeypatch.setitem(cli.commands, "flight", ortho_tinysat_flight.flight)
    installed = studies.studies()
    monkeypatch.setattr(studies, "studies", lambda: {"tinysat": ortho_tinysat_study.STUDY, **installed})
    yield
    for name in ("ortho_tinysat_study", "ortho_tinysat_flight", "ortho_tinysat"):
        sys.modules.pop(name, None)


@pytest.mark.usefixtures("with_tinysat")
@pytest.mark.parametrize("line", COMMANDS)
def test_commands_are_understood(line):
    words = shlex.split(line.split(" | ")[0], comments=True)[1:]
    command, context = cli, click.Context(cli, info_name="ortho", **cli.context_settings)
    while isinstance(command, click.Group):
        name, words = words[0], words[1:]
        found = command.get_command(context, name)
        assert found, f"there is no command {name}"
        command, context = found, click.Context(found, info_name=name, parent=context)
    # Files that do not exist are no fault of the example; options that do not exist are.
    command.parse_args(context, words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    """Only to what is in the repository: people read the pages there, where `make docs` has not run."""
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if not re.match(r"[a-z]+:", target):
            assert os.path.exists(page.parent / target), f"{page.name} links to {target}"


def test_every_command_has_a_group_and_a_page(tmp_path):
    """Each is in one group of docs/cli.md, and its generated page is in the same group of the site."""
    import make_commands

    make_commands.main(tmp_path)
    names = cli.list_commands(click.Context(cli))
    assert set(names) <= {path.stem for path in tmp_path.iterdir()}
    rows = re.findall(r"^\| (.*?) \|", (ROOT / "docs/cli.md").read_text(), re.MULTILINE)
    grouped, group = {}, ""
    for row in rows:
        found = re.findall(r"`ortho ([a-z-]+)`", row)
        group = group if found else row
        grouped |= dict.fromkeys(found, group)
    assert sorted(grouped) == names
    (listed,) = re.findall(r"- Commands: .*\n((?: {6}.*\n)+)", (ROOT / "mkdocs.yml").read_text())
    site = {}
    for line in listed.splitlines():
        name = re.search(r"commands/([a-z-]+)\.md", line)
        group = group if name else line.strip(" -:")
        site |= {name[1]: group} if name else {}
    assert site == grouped


def test_the_page_of_a_command_has_all_of_its_help(tmp_path):
    """Each option is in a table, the examples are in a block; a bar in a cell does not end it."""
    import make_commands

    make_commands.main(tmp_path)
    for name in HOST:
        text, command = (tmp_path / f"{name}.md").read_text(), cli.get_command(click.Context(cli), name)
        assert "## More options" not in text, name
        for option in command.params:
            if isinstance(option, click.Option) and option.name != "help":
                assert re.search(rf"^\| `[^`]*--{make_commands.long_name(option)}\b", text, re.MULTILINE), (
                    name,
                    option.name,
                )
        for row in re.findall(r"^\|.*$", text, re.MULTILINE):
            outside_code = re.sub(r"`[^`]*`", "", row)
            assert len(re.split(r"(?<!\\)\|", outside_code)) in (4, 5), row
            assert "\\|" not in "".join(re.findall(r"`[^`]*`", row)), row  # the site would show the backslash
    assert (
        "\northo rectify scene.tif --gcps gcps.geojson --dem dem.tif -o out\n" in (tmp_path / "rectify.md").read_text()
    )


def test_every_public_name_has_a_page_of_its_docstring(tmp_path):
    import make_reference

    make_reference.main(tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == {*ortho_pipeline.__all__, "plugin-fields", "plugin-names"}
    site = (ROOT / "mkdocs.yml").read_text()
    assert re.findall(r"- reference/(\S+)\.md\n", site) == [*ortho_pipeline.__all__, "plugin-fields", "plugin-names"]
    for name in ortho_pipeline.__all__:
        page, thing = (tmp_path / f"{name}.md").read_text(), getattr(ortho_pipeline, name)
        assert len(page.splitlines()) > 4, name
        assert "---" not in page  # every section was understood
        if not inspect.isclass(thing):
            documented = re.findall(
                r"^- `(\w+)`", page.partition("**Parameters**")[2].partition("**R")[0], re.MULTILINE
            )
            assert set(documented) <= set(inspect.signature(thing).parameters)
    assert "\n**Examples**\n\n```python\n>>> notice = " in (tmp_path / "Notice.md").read_text()


def test_changes_stand_by_version():
    """Newest first, with dates; the newest is that of the package; what is new stands under "Unreleased"."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    intro, *sections = re.split(r"^## ", text, flags=re.MULTILINE)
    heads = [section.partition("\n")[0] for section in sections]
    assert heads[0] == "Unreleased"
    found = [re.fullmatch(r"(\d+)\.(\d+)\.(\d+) \((\d{4}-\d\d-\d\d)\)", head) for head in heads[1:]]
    assert all(found), heads
    versions = [tuple(map(int, one.groups()[:3])) for one in found if one]
    dates = [one[4] for one in found if one]
    assert versions == sorted(set(versions), reverse=True)
    assert dates == sorted(dates, reverse=True)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert ".".join(map(str, versions[0])) == project["version"]
    lines = [line for line in text.splitlines() if line.startswith("- ")]
    twice = {line for line in lines if lines.count(line) > 1}
    assert not twice
    assert "\n- " not in text.rpartition("<!--")[2], "the last line of CHANGELOG.md belongs to Unreleased, at the top"
    assert "- " not in intro.splitlines()


@pytest.mark.parametrize("page", ["SECURITY.md", "docs/engineering/reliability.md"])
def test_tests_that_hold_promises_are_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`(?:[\w/]+\.py::)?(test_\w+)`", text))
    files = set(re.findall(r"`(?:tests/)?([\w/]+/test_\w+\.py|test_\w+\.py)\b", text))
    assert len(named | files) > 20
    there = {path: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")}
    defined = set(re.findall(r"^def (test_\w+)", "\n".join(there.values()), flags=re.MULTILINE))
    assert named - defined == set()
    assert {name for name in files if ROOT / "tests" / name not in there} == set()
