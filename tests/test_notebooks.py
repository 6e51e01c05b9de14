"""The notebooks of the documentation run, and show what is stored in them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat", reason="Jupyter's nbformat is not installed")
pytest.importorskip("nbclient", reason="Jupyter's nbclient is not installed")

from make_notebooks import NOTEBOOKS, ROOT, page, run  # noqa: E402

_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]\d+)?")


def texts(notebook: Any) -> list[str]:
    """Return what the cells print and show, tables as their HTML; of a picture only that there is one."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return [
        data.get("text/html") or data.get("text/plain") or ", ".join(data)
        for data in (output.get("data", {"text/plain": output.get("text", "")}) for output in outputs)
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path: Path, tmp_path: Path) -> None:
    stored, made = nbformat.read(path, as_version=4), run(path, tmp_path)
    for was, now in zip(texts(stored), texts(made), strict=True):
        assert _NUMBER.sub("#", now) == _NUMBER.sub("#", was)
        numbers = [[float(number) for number in _NUMBER.findall(text)] for text in (was, now)]
        assert numbers[1] == pytest.approx(numbers[0], rel=0.02, abs=0.02)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_small_and_have_a_page_with_pictures(path: Path, tmp_path: Path) -> None:
    assert path.stat().st_size < 200_000
    text = page(nbformat.read(path, as_version=4), tmp_path, path.stem)
    pictures = re.findall(r"\]\((\S+\.png)\)", text)
    assert pictures
    assert all((tmp_path / picture).stat().st_size > 1000 for picture in pictures)
    assert f"notebooks/{path.stem}.md" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert str(ROOT) not in path.read_text(encoding="utf-8")
