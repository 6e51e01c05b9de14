"""The page as text: what its scripts name is there, and their types hold."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "plugins/ortho_measure/page"
SCRIPTS = {name: (PAGE / name).read_text(encoding="utf-8") for name in ("app.js", "views.js", "table.js")}


def test_every_element_that_a_script_names_is_in_the_page() -> None:
    elements = re.findall(r' id="([^"]+)"', (PAGE / "index.html").read_text(encoding="utf-8"))
    assert len(elements) == len(set(elements))
    named = {name for text in SCRIPTS.values() for name in re.findall(r"\$\('([\w-]+)'\)", text)}
    assert named <= set(elements)
    assert len(named) > 40


def test_the_page_sends_back_every_field_of_a_point() -> None:
    """A point of a file keeps its errors when its role, name or position changes."""
    from ortho_measure.marks import Mark, RayMark

    lists = re.findall(r"only\((?:mark|ray), \[(.*?)\]\)", SCRIPTS["app.js"])
    several, ray, single = (set(re.findall(r"'(\w+)'", fields)) for fields in lists)
    assert single == set(Mark.model_fields) - {"rays", "at"}
    assert ray == set(RayMark.model_fields)
    assert several == single - {"image", "sigma_image", "sigma_alike", "covariance", "group", "score"}


def test_everything_that_the_page_asks_is_answered() -> None:
    from ortho_measure.serving.server import ASKED

    asked = {name for text in SCRIPTS.values() for name in re.findall(r"ask(?:\)\()?\(?'(\w+)'", text)}
    assert asked <= set(ASKED)
    assert {"begin", "act", "tie", "compare", "make"} <= asked


@pytest.mark.slow
def test_the_types_of_the_scripts_hold(tmp_path: Path) -> None:
    """TypeScript checks the JSDoc comments, if it is on this machine; `make page-types` fetches it."""
    tsc = shutil.which("tsc")
    if tsc is None:
        pytest.skip("there is no TypeScript (tsc) on this machine")
    project = Path(__file__).parent / "types"
    found = subprocess.run([tsc, "-p", str(project)], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout
