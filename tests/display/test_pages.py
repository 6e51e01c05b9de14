"""Templates are compiled once per installation."""

from __future__ import annotations

import jinja2
import pytest

from ortho_pipeline.display import pages


@pytest.fixture
def environment():
    """Return a function that gives the environment as a new process would make it."""

    def anew():
        pages._environment.cache_clear()
        return pages._environment("ortho_pipeline")

    yield anew
    pages._environment.cache_clear()


def template(folder, environment, text):
    """Render a template of that text from a folder, by the environment's own cache."""
    (folder / "page.html.j2").write_text(text)
    made = environment()
    made.loader = jinja2.FileSystemLoader(folder)
    return made.get_template("page.html.j2").render(x="<")


def test_a_template_is_compiled_once(tmp_path, environment, monkeypatch):
    monkeypatch.setattr("sys.dont_write_bytecode", False)
    assert template(tmp_path, environment, "a{{ x }}") == "a&lt;"
    (kept,) = (tmp_path / "__pycache__").iterdir()
    monkeypatch.setattr(jinja2.Environment, "compile", None)
    assert template(tmp_path, environment, "a{{ x }}") == "a&lt;"
    monkeypatch.undo()
    assert template(tmp_path, environment, "b{{ x }}") == "b&lt;"  # not what was kept
    kept.write_bytes(b"")
    assert template(tmp_path, environment, "b{{ x }}") == "b&lt;"


def test_nothing_is_kept_where_nothing_can_be_written_or_shall_be(tmp_path, environment, monkeypatch):
    monkeypatch.setattr("sys.dont_write_bytecode", True)
    assert template(tmp_path, environment, "a{{ x }}") == "a&lt;"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html.j2"]
    monkeypatch.setattr("sys.dont_write_bytecode", False)
    (tmp_path / "__pycache__").write_text("not a folder")
    assert template(tmp_path, environment, "c{{ x }}") == "c&lt;"
