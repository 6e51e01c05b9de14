"""List the texts that the product shows a person: `python tools/product_text.py [FOLDER OF THE REPOSITORY]`.

Prints, for each room, what breaks the rules of `tools/words.py`: its phrases, and sentences that are too long.

The texts are

- strings of Python source with two words or more: errors, remedies, notices, helps and what commands print. A
  placeholder of an f-string counts as one word, and so does an option (`Setting`).
- docstrings of commands, which are their helps. Other docstrings are for programmers.
- visible text of HTML templates, with titles and labels. A value counts as one word. Each branch of a condition is a
  text of its own.
- strings of page scripts, and the pages of the documentation.

Nothing is imported; the files are read as text.
"""

from __future__ import annotations

import ast
import functools
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import NamedTuple

import house
import words

#: Stands for a value that is known only when the product runs.
VALUE = "X"
#: Calls whose strings are no text for people.
_SILENT = ("compile", "debug", "re.sub", "namedtuple", "TypeVar", "cache_path")
_STYLED = (
    "b",
    "i",
    "em",
    "strong",
    "small",
    "span",
    "a",
    "abbr",
    "sub",
    "sup",
    "var",
    "label",
    "wbr",
    "output",
    "time",
)
_LABELS = ("title", "alt", "placeholder", "aria-label", "data-label")


#: Files whose commands are examples: tests/cli/test_examples.py and tests/cli/test_first_use.py run these.
EXAMPLES = (
    "ortho_pipeline/cli/survey/examples.py",
    "ortho_pipeline/cli/survey/first_use.py",
    "ortho_pipeline/commands/survey/pipeline_file.py",
)
#: Beginnings of commands: programs of GDAL anywhere, words that are also plain English after a quote or a verb.
_COMMAND = re.compile(
    r"(?P<opened>[`'\"(])?(?<![\w.-])(?P<command>"
    r"(?:gdal_\w+(?:\.py)?|gdal(?:warp|addo|info|buildvrt)|pip install|python3? -m|pyproj sync|projsync)\b"
    r"|(?:(?<=[`'\"(])|(?<=take )|(?<=use )|(?<=run )|(?<=see )|(?<=with ))ortho (?=[a-z]))"
)
_CLOSING = {"(": r"\)", "`": "`", "'": "'", '"': '"', None: r"[,;)\n]|:(?=\s|$)"}


class Shown(NamedTuple):
    """A text that the product shows.

    Parameters
    ----------
    kind : str
        message, remedy, notice, help, text (other strings of Python), page, script or docs.
    room : str
        Room of the host, package of a plugin, or docs.
    path, line
        Where it is.
    text : str
        The text, with placeholders as one word.
    """

    kind: str
    room: str
    path: str
    line: int
    text: str

    @property
    def where(self) -> str:
        """Path, line and kind."""
        return f"{self.path}:{self.line} ({self.kind})"

    def sentences(self) -> list[str]:
        """Return its sentences; each line of a string of Python is a paragraph."""
        lines = self.text.splitlines() if self.kind in ("message", "remedy", "notice", "text") else [self.text]
        return [sentence for line in lines for sentence in words.sentences(line)]

    def commands(self) -> list[str]:
        """Return the commands that it tells a person to run; helps and examples have none."""
        if self.kind in ("help", "docs") or self.path in EXAMPLES:
            return []
        return commands(self.text)

    def long_sentences(self) -> list[str]:
        """Return its sentences that are longer than 19 of 20 may be."""
        return [sentence for sentence in self.sentences() if words.length(sentence) > words.NEARLY_ALL]


@functools.cache
def shown(root: Path) -> tuple[Shown, ...]:
    """Return all texts of a checkout, read once: that takes some seconds."""
    return tuple(_shown(root))


def _shown(root: Path) -> Iterator[Shown]:
    for folder in ("ortho_pipeline", "plugins"):
        for path in sorted((root / folder).rglob("*")):
            reader = READERS.get(path.suffix)
            if reader is None or path.name == "ol.js":  # OpenLayers
                continue
            start = root if folder == "ortho_pipeline" else root / folder
            room = house.room_of(house.module_of(path, start)).removeprefix("ortho_pipeline.")
            for kind, line, text in reader(path.read_text(encoding="utf-8")):
                yield Shown(kind, room, words.name_of(path, root), line, text)
    for path in words.written_pages(root):
        for line, text in paragraphs(path.read_text(encoding="utf-8")):
            yield Shown("docs", "docs", words.name_of(path, root), line, text)


def paragraphs(page: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of what blank lines of a page separate, without its code blocks and comments."""
    page = re.sub(r"<!--.*?-->", lambda found: _lines(found[0]), page, flags=re.DOTALL)
    page = words.FENCED.sub(lambda found: _lines(found[0]), page)
    for found in re.finditer(r"(?:^.*\S.*\n?)+", page, flags=re.MULTILINE):
        yield _line(page, found.start()), found[0]


def commands(text: str) -> list[str]:
    """Return the commands in a text: each up to the quote that ends it, or to the next comma, colon or line."""
    found = []
    for start in _COMMAND.finditer(text):
        rest = text[start.start("command") :]
        found.append(re.split(_CLOSING[start["opened"]], rest, maxsplit=1)[0].strip().rstrip("."))
    return found


# -- Python ----------------------------------------------------------------------------------------------------------


def of_python(source: str) -> Iterator[tuple[str, int, str]]:
    """Yield kind, line and text of the strings of a module, and of the docstrings of its commands."""
    yield from _strings(ast.parse(source), "text")


def _strings(node: ast.AST, kind: str) -> Iterator[tuple[str, int, str]]:
    """Yield the texts below a node; `kind` is that of the call or statement around it."""
    match node:
        case ast.Expr(value=ast.Constant()) | ast.Assert():
            return
        case ast.Raise():
            kind = "message"
        case ast.FunctionDef() | ast.ClassDef() | ast.AsyncFunctionDef():
            text = ast.get_docstring(node)
            if text and any(_name(one) == "command" for one in node.decorator_list):
                yield "help", node.lineno, text
        case ast.Call():
            name = _name(node)
            if name in _SILENT:
                return
            kind = _KINDS.get(name, "message" if name.endswith("Error") else kind)
        case ast.keyword(arg="remedy" | "help") if node.arg:
            kind = node.arg
    text = _text(node)
    if text is None:
        for child in ast.iter_child_nodes(node):
            yield from _strings(child, kind)
        return
    if words.length(text) > 1:
        yield kind, node.lineno, _without_tags(text)
    for value in _values(node):
        yield from _strings(value, kind)


_KINDS = {"Notice": "notice", "Option": "help", "option": "help", "reads": "remedy"}


def _name(node: ast.AST) -> str:
    """Return the name of a call or of a decorator, without what is before its last dot."""
    node = node.func if isinstance(node, ast.Call) else node
    return str(getattr(node, "attr", getattr(node, "id", "")))


def _text(node: ast.AST) -> str | None:
    """Return the text that an expression makes, with values as one word; None for what makes none."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr():
            return "".join(_text(part) or VALUE for part in node.values)
        case ast.BinOp(op=ast.Add()):
            parts = [_text(node.left), _text(node.right)]
            return None if parts == [None, None] else "".join(part or VALUE for part in parts)
        case ast.Call() if _name(node) == "Text":
            return "".join(_text(part) or VALUE for part in node.args)
    return None


def _values(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the values within a text."""
    match node:
        case ast.Constant():
            return
        case ast.JoinedStr():
            parts = [part.value for part in node.values if isinstance(part, ast.FormattedValue)]
        case ast.BinOp():
            parts = [node.left, node.right]
        case ast.Call():
            parts = node.args
        case _:
            parts = []
    for part in parts:
        if isinstance(part, ast.JoinedStr) or _text(part) is not None:
            yield from _values(part)
        else:
            yield part


def _without_tags(text: str) -> str:
    return re.sub(r"</?[a-z][^<>]*>", " ", text)


# -- pages -----------------------------------------------------------------------------------------------------------


def of_page(source: str) -> Iterator[tuple[str, int, str]]:
    """Yield kind, line and text of what a template shows, and of the strings of its expressions and scripts."""
    source = re.sub(r"\{#.*?#\}", lambda found: _lines(found[0]), source, flags=re.DOTALL)
    for found in re.finditer(r"\{[{%](.*?)[%}]\}", source, flags=re.DOTALL):
        for text in re.findall(r"'([^'\n]*)'|\"([^\"\n]*)\"", found[1]):
            if words.length("".join(text)) > 1:
                yield "page", _line(source, found.start()), _without_tags("".join(text))
    source = re.sub(r"\{\{.*?\}\}", lambda found: VALUE + _lines(found[0]), source, flags=re.DOTALL)
    for branch in _branches(source):
        parser = _Visible()
        parser.feed(branch)
        parser.close()
        parser.end()
        yield from parser.texts


def _branches(source: str) -> list[str]:
    """Return the template with the first branch of each condition, then each other branch, all at their lines."""
    kept, others = [], []
    stack: list[list[str]] = [kept]
    blank: list[str] = [""]  # what precedes, as empty lines
    for part in re.split(r"(\{%.*?%\})", source, flags=re.DOTALL):
        words_ = part.strip("{%-+ }").split()
        word = words_[0] if part.startswith("{%") and words_ else None
        here = _lines("".join(blank))
        blank.append(_lines(part))
        for stream in {id(one): one for one in stack if one is not stack[-1]}.values():
            stream.append(_lines(part))
        if word is None:
            stack[-1].append(part)
            continue
        stack[-1].append(_lines(part))
        if word == "if":
            stack.append(stack[-1])
        elif word in ("elif", "else") and len(stack) > 1:
            stack[-1] = [here]
            others.append(stack[-1])
        elif word == "endif":
            stack.pop()
    return ["".join(one) for one in (kept, *others)]


def _lines(text: str) -> str:
    return "\n" * text.count("\n")


def _line(text: str, at: int) -> int:
    return text.count("\n", 0, at) + 1


class _Visible(HTMLParser):
    """Collects the visible texts of a page: those of each block, and labels."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[tuple[str, int, str]] = []
        self.parts: list[str] = []
        self.line = 1
        self.inside = ""  # script, style, code

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in _LABELS and value and words.length(value) > 1:
                self.texts.append(("page", self.getpos()[0], value))
        if tag in ("script", "style"):
            self.end()
            self.inside = tag
        elif tag in ("code", "kbd"):
            self.inside = tag
            self.parts.append("code")
        elif tag not in _STYLED:
            self.end()

    def handle_endtag(self, tag: str) -> None:
        if tag == self.inside:
            self.inside = ""
        elif tag not in _STYLED:
            self.end()

    def handle_data(self, data: str) -> None:
        if self.inside == "script":
            at = self.getpos()[0] - 1
            self.texts += [(kind, at + line, text) for kind, line, text in of_script(data)]
        elif not self.inside:
            if not self.parts:
                self.line = self.getpos()[0] + data[: len(data) - len(data.lstrip())].count("\n")
            if self.parts or data.strip():
                self.parts.append(data)

    def end(self) -> None:
        """End a block of text."""
        text = re.sub(r" ([.,;:)])", r"\1", " ".join("".join(self.parts).split()))
        if words.length(text) > 1:
            self.texts.append(("page", self.line, text))
        self.parts = []


_SCRIPT = re.compile(
    r"/\*.*?\*/|//[^\n]*"
    r"|(?<=[=(,:!&|?{};\n])\s*/(?![/*])(?:\\.|\[(?:\\.|[^\]\\\n])*\]|[^/\\\n\[])+/[a-z]*"
    r"|\"(?P<double>(?:\\.|[^\"\\\n])*)\"|'(?P<single>(?:\\.|[^'\\\n])*)'|`(?P<template>(?:\\.|[^`\\])*)`",
    re.DOTALL,
)


def of_script(source: str) -> Iterator[tuple[str, int, str]]:
    """Yield kind, line and text of the strings of a script; a value in a template counts as one word."""
    for found in _SCRIPT.finditer(source):
        text = found["double"] or found["single"] or found["template"] or ""
        if found["template"]:
            for value in re.findall(r"\$\{((?:[^{}]|\{[^{}]*\})*)\}", text):
                for _, line, inner in of_script(value):
                    yield "script", _line(source, found.start()) + line - 1, inner
            text = re.sub(r"\$\{(?:[^{}]|\{[^{}]*\})*\}", VALUE, text)
        text = _without_tags(re.sub(r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), text))
        if words.length(text) > 1:
            yield "script", _line(source, found.start()), text


READERS = {".py": of_python, ".html": of_page, ".j2": of_page, ".js": of_script}


def by_room(root: Path) -> dict[str, list[Shown]]:
    """Return the texts of each room."""
    rooms: defaultdict[str, list[Shown]] = defaultdict(list)
    for one in shown(root):
        rooms[one.room].append(one)
    return dict(sorted(rooms.items()))


def faults(texts: list[Shown]) -> list[str]:
    """Return what breaks the rules in the texts of a room: phrases, and the lengths of all of its sentences."""
    phrases = [f'{one.where} has "{phrase}"' for one in texts for phrase in words.phrases(one.text)]
    return phrases + words.faults_of_lengths([sentence for one in texts for sentence in one.sentences()])


def offenders(texts: list[Shown]) -> list[str]:
    """Return the long sentences of a room, of which it may have a few."""
    return [
        f"{one.where} {words.length(sentence)} words: {sentence}" for one in texts for sentence in one.long_sentences()
    ]


def main() -> None:
    """Print for each room what it has, the rules that it breaks, and its long sentences."""
    root = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent.parent).resolve()
    for room, texts in by_room(root).items():
        broken = faults(texts)
        count = sum(len(one.sentences()) for one in texts)
        print(f"{room}: {len(texts)} texts, {count} sentences, {'FAILS' if broken else 'passes'}")
        for line in broken + offenders(texts):
            print(f"  {line}")


if __name__ == "__main__":
    main()
