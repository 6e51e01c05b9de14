"""Examples in docstrings run, and every public name has one.

They run from the root of the repository, with `op`, `np`, the public names, and `out`, a new folder.
"""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest

import ortho_pipeline as op
from ortho_pipeline import plugin

ROOT = Path(__file__).resolve().parents[1]
OPTIONS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
#: Public name -> module that holds it.
HOMES = {**plugin._HOMES, **op._HOMES}
PUBLIC = {name: getattr(op if name in op._HOMES else plugin, name) for name in sorted(HOMES)}
#: Public names without an example, and why.
WITHOUT = {
    "Array": "a type of NumPy",
    "ECCENTRICITY_SQUARED": "a number",
    "Fit": "`fit` returns it",
    "GEOGRAPHIC": "a text",
    "KINDS": "a table of classes",
    "LOOKS_PAST": "a notice",
    "SEMI_MAJOR": "a number",
    "Pushbroom": "`pushbroom_of_tables` returns it",
    "TOPOCENTRIC": "a text",
    "hookimpl": "an object of pluggy; docs/plugins.md shows it",
    # Decorators of click, in the command that docs/plugins.md builds.
    **dict.fromkeys(("folder_option", "image_argument", "images_argument", "json_option"), "a decorator of click"),
    **{f"{group}_options": "a decorator of click" for group in ("match", "output", "point", "scene", "surface")},
}
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in (ROOT / "ortho_pipeline").rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


def docstrings(thing: object) -> list[str]:
    """Return the docstring of a function, or those of a class and of what it has that is public."""
    members = [value for name, value in vars(thing).items() if name[:1] != "_"] if inspect.isclass(thing) else []
    parts = [thing, *(getattr(one, "__func__", one) for one in members)]
    return [
        inspect.getdoc(part) or ""
        for part in parts
        if part is thing or callable(part) or inspect.isdatadescriptor(part)
    ]


def test_every_public_name_has_an_example() -> None:
    missing = [
        f"{HOMES[name]}.{name}"
        for name, thing in PUBLIC.items()
        if name not in WITHOUT and not any(">>> " in text for text in docstrings(thing))
    ]
    assert not missing, "\n".join(sorted(missing))


def test_names_without_an_example_are_public() -> None:
    assert set(WITHOUT) <= set(PUBLIC)


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    module = importlib.import_module(name)
    names = {**PUBLIC, **vars(module), "op": op, "np": np, "out": tmp_path}
    found = [test for test in doctest.DocTestFinder(exclude_empty=True).find(module, globs=names) if test.examples]
    # Docstrings of private classes and functions, and of what decorators hide, are not left out.
    written = sum(
        ">>> " in (ast.get_docstring(node) or "")
        for node in ast.walk(ast.parse(inspect.getsource(module)))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
    )
    assert len(found) == written
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=OPTIONS)
    for test in found:
        runner.run(test, out=said.append)
    assert not runner.failures, "".join(said)
