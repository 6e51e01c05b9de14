"""Write a page of each public name from its docstring into docs/reference: ``make docs``.

Plain Markdown, so that any generator of sites takes it: MkDocs is no longer developed, and what comes after it reads
neither its hooks nor its plugins.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from ortho_studies import hookspecs as of_studies

import ortho_pipeline as op
from ortho_pipeline import plugin

FOLDER = Path(__file__).resolve().parent / "reference"
#: The classes for authors of plugins whose fields have a page.
FIELDS = (
    *(plugin.Sensor, plugin.Scene, plugin.Piece, plugin.Prior),
    *(plugin.Format, plugin.Export, plugin.BlockFormat, plugin.BlockExport, plugin.Subcommand),
    *(of_studies.Study, of_studies.StudyOption, of_studies.Simulated, of_studies.Reproduced),
)
_SECTION = re.compile(r"^(Parameters|Attributes|Returns|Raises|Examples|Notes)\n-{3,}\n", re.MULTILINE)
_ENTRY = re.compile(r"^(?P<name>\S.*)$\n?(?P<text>(?:^[ \t]+.*\n?|^\n(?=[ \t]))*)", re.MULTILINE)
#: What a type is called in a signature, without its module.
_MODULE = re.compile(r"\b(?:[a-z_]\w*\.)+(?=[A-Za-z_])")


def main(folder: Path = FOLDER) -> None:
    """Write all pages, and remove those of names that are no more."""
    folder.mkdir(exist_ok=True)
    pages = {f"{name}.md": page(name) for name in op.__all__}
    pages |= {"plugin-fields.md": plugin_fields(), "plugin-names.md": plugin_names()}
    for old in folder.glob("*.md"):
        if old.name not in pages:
            old.unlink()
    for name, text in pages.items():
        (folder / name).write_text(text, encoding="utf-8")


def page(name: str) -> str:
    """Return the page of a public name."""
    thing = getattr(op, name)
    home = f"`ortho_pipeline.{op._HOMES[name]}`"
    parts = [f"# {name}", f"`from ortho_pipeline import {name}` (it lives in {home})"]
    if not inspect.isclass(thing):
        parts += [_signature(name, thing), *_described(thing)]
        return "\n\n".join(parts) + "\n"
    if dataclasses.is_dataclass(thing) and not inspect.isabstract(thing):
        parts.append(_signature(name, thing))
    parts += _described(thing)
    for member, found in _members(thing):
        kind = inspect.getattr_static(thing, member)
        if isinstance(kind, property) or not callable(found):
            parts += [f"## {member}", *_described(getattr(kind, "fget", None) or kind)]
        else:
            parts += [f"## {member}()", _signature(member, found), *_described(found)]
    return "\n\n".join(parts) + "\n"


def plugin_fields() -> str:
    """Return the page that lists the fields of all classes that hooks return, or that functions of plugins receive."""
    parts = [
        "# What plugins return",
        "These are the classes that [hooks](../plugin-reference.md#hooks) return, and those that functions of plugins "
        "receive.",
    ]
    for one in FIELDS:
        parts += [f"## {one.__name__}", *_described(one)]
    return "\n\n".join(parts) + "\n"


def plugin_names() -> str:
    """Return the page that lists the names for authors of plugins, by module, with the first lines of docstrings."""
    parts = [
        "# Names for plugins",
        "`from ortho_pipeline.plugin import NAME`. [Plugin reference](../plugin-reference.md) explains hooks, and "
        "[What plugins return](plugin-fields.md) fields. `help(ortho_pipeline.plugin.NAME)` prints a whole docstring.",
    ]
    for module in sorted(plugin._NAMES):
        about = _prose(inspect.getdoc(_module(module)).splitlines()[0])
        rows = [f"| `{name}` | {_prose(plugin_text(name).splitlines()[0])} |" for name in plugin._NAMES[module]]
        parts += [f"## {module}", about, "\n".join(["| name | what it is |", "|---|---|", *rows])]
    return "\n\n".join(parts) + "\n"


def plugin_text(name: str) -> str:
    """Return the docstring of a name of `ortho_pipeline.plugin`, or the comment above a value; "" if none."""
    value, home = getattr(plugin, name), _module(plugin._HOMES[name])
    if (inspect.isclass(value) or inspect.isfunction(value)) and inspect.getdoc(value):
        return inspect.getdoc(value)
    stated = re.search(rf"^((?:#: .*\n)+)(?:\w+, )*{name}\b.*? = ", inspect.getsource(home), re.MULTILINE)
    return stated[1].replace("#: ", "") if stated else ""


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"ortho_pipeline.{name}")


def _members(thing: type) -> Iterator[tuple[str, Any]]:
    """Return what a class offers: methods and properties with a docstring, in the order in which they are written."""
    seen = set()
    for base in thing.__mro__:
        if not base.__module__.startswith("ortho_pipeline"):
            continue
        for name, raw in vars(base).items():
            documented = inspect.getdoc(getattr(raw, "__func__", raw))
            kinds = (property, staticmethod, classmethod)
            if name.startswith("_") or name in seen or not documented or not (callable(raw) or isinstance(raw, kinds)):
                continue
            seen.add(name)
            yield name, getattr(thing, name)


def _signature(name: str, thing: Any) -> str:
    """Return the signature as code, a parameter a line where it is long; defaults that are records by their class."""
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return f"```python\n{name}(...)\n```"
    shown, star = [], False
    for one in signature.parameters.values():
        if one.name == "self":
            continue
        if one.kind is one.KEYWORD_ONLY and not star:
            shown.append("*")
            star = True
        text = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "") + one.name
        star = star or one.kind is one.VAR_POSITIONAL
        if one.annotation is not one.empty:
            text += f": {_type(one.annotation)}"
        if one.default is not one.empty:
            plain = isinstance(one.default, str | int | float | bool | tuple | None)
            text += f" = {one.default!r}" if plain else " = ..."
        shown.append(text)
    back = "" if signature.return_annotation is signature.empty else f" -> {_type(signature.return_annotation)}"
    line = f"{name}({', '.join(shown)}){back}"
    if len(line) > 88:
        line = f"{name}(\n    " + ",\n    ".join(shown) + f",\n){back}"
    return f"```python\n{line}\n```"


def _type(annotation: Any) -> str:
    """Return a type as people read it."""
    if typing.get_origin(annotation) is typing.Annotated:
        annotation = typing.get_args(annotation)[0]
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", None) or str(annotation)
    return _MODULE.sub("", text.strip("'"))


def _described(thing: Any) -> list[str]:
    """Return a numpydoc docstring as Markdown: prose, and a table or a list of each section."""
    text = inspect.getdoc(thing) or ""
    pieces = _SECTION.split(text)
    found = [_prose(pieces[0])]
    for heading, body in zip(pieces[1::2], pieces[2::2], strict=True):
        found.append(f"**{heading}**")
        if heading in ("Examples", "Notes"):
            found.append(_prose(body))
            continue
        # After the entries prose may go on: a line at the margin that is no name with a type.
        entries, rest = _entries(body, heading)
        found += [entries, _prose(rest)] if rest else [entries]
    return [piece for piece in found if piece]


def _entries(body: str, heading: str) -> tuple[str, str]:
    """Return the entries of a section as a list, and what is written after them."""
    items, at = [], 0
    for one in _ENTRY.finditer(body):
        name, text = one["name"].strip(), " ".join(one["text"].split())
        if not text and items and heading != "Attributes":
            break
        what, _, kind = name.partition(" : ")
        items.append(f"- `{what}`" + (f" ({_escaped(kind)})" if kind else "") + (f": {_plain(text)}" if text else ""))
        at = one.end()
    return "\n".join(items), body[at:].strip()


def _prose(text: str) -> str:
    """Return text as Markdown: double backticks are single ones, indented lines and examples are code."""
    text = re.sub(r"^>>> (?:.+\n?)+", lambda found: f"```python\n{found[0].strip()}\n```\n", text, flags=re.MULTILINE)
    text = re.sub(r"^::\n\n", "", text, flags=re.MULTILINE)  # what follows is indented, so it is code in Markdown, too
    return re.sub(r"(?<!`)``([^`]+)``(?!`)", r"`\1`", text.strip())


def _plain(text: str) -> str:
    return re.sub(r"``([^`]+)``", r"`\1`", text)


def _escaped(text: str) -> str:
    return text.replace("*", r"\*").replace("_", r"\_")


if __name__ == "__main__":
    main()
