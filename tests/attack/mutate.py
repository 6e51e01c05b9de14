"""Damage to files, drawn from a seed: text, JSON, XML and TIFF, each damaged where its readers look.

Every mutator takes the bytes of a valid file and a generator and returns other bytes; `mutant` chooses among them. The
same seed gives the same mutants on every machine.
"""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

#: What stands in place of a number: each was seen in, or made from, a file that broke some reader.
NUMBERS = (
    "nan", "NaN", "inf", "-inf", "Infinity", "1e400", "-1e400", "1e308", "1e-320", "9" * 30, "-" + "9" * 400,
    "9" * 5000, "0", "-0.0", "-1", "1,5", "", " ", "1e", "0x1F", "1_000", "٣", "1.5.2", "+-1", "2.5", "true", "null",
    "2147483648", "18446744073709551616", "1e15", "1e18",
)  # fmt: skip
#: Words in place of others.
WORDS = (
    "", "x", "\0", "é", "𝔘", "../../x", "/dev/null", "a" * 300, "b" * 100_000, "%s%n",
    "{0}", "{stem}", "$HOME", "\x1b[0m",
    "9999-12-31T23:59:59-14:00", "0001-01-01T00:00:00+14:00", "EPSG:0", "EPSG:999999999",
    "*/" * 40 + "*", "<", "&", "'", '"',
)  # fmt: skip
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z][\w:.-]*")
_DEEP = 3000


def mutant(data: bytes, kind: str, draw: random.Random) -> bytes:
    """Return one to three damages of `data`, a file of a `kind` of `KINDS`."""
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        # Damage to the bytes of a structured file mostly ends in its parser; most goes to what the file says.
        choices = KINDS[kind] if draw.random() < 0.7 or kind == "text" else KINDS["text"]
        data = draw.choice(choices)(data, draw)
    return data


# -- bytes and lines -------------------------------------------------------------------------------------------------


def _flip(data: bytes, draw: random.Random) -> bytes:
    found = bytearray(data)
    for _ in range(draw.choice((1, 1, 4, 30)) if found else 0):
        found[draw.randrange(len(found))] ^= 1 << draw.randrange(8)
    return bytes(found)


def _cut(data: bytes, draw: random.Random) -> bytes:
    return data[: draw.randrange(len(data) + 1)]


def _drop(data: bytes, draw: random.Random) -> bytes:
    at = draw.randrange(len(data) + 1)
    return data[:at] + data[at + draw.choice((1, 2, 10, 200)) :]


def _insert(data: bytes, draw: random.Random) -> bytes:
    at = draw.randrange(len(data) + 1)
    return data[:at] + draw.choice((b"\0", b"\n", b"\r", b";", b",", b"=", b'"', b"\xff", b"(" * 2000)) + data[at:]


def _encode(data: bytes, draw: random.Random) -> bytes:
    if draw.random() < 0.5:
        return draw.choice((b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff")) + data
    return data.decode("latin-1").encode(draw.choice(("utf-16", "utf-16-le", "utf-32", "utf-8")))


def _lines(data: bytes, draw: random.Random) -> bytes:
    """Delete, double, swap, empty or lengthen a line."""
    lines = data.split(b"\n")
    at, other = draw.randrange(len(lines)), draw.randrange(len(lines))
    action = draw.randrange(6)
    if action == 0:
        del lines[at]
    elif action == 1:
        lines.insert(other, lines[at])
    elif action == 2:
        lines[at], lines[other] = lines[other], lines[at]
    elif action == 3:
        lines[at] = b""
    elif action == 4:
        lines[at] = (lines[at] + b" ") * draw.choice((2, 200))
    else:
        lines[at] = b"#" + lines[at]
    return b"\n".join(lines)


def _replace(data: bytes, draw: random.Random, pattern: re.Pattern[bytes], by: tuple[str, ...]) -> bytes:
    found = [match.span() for match in pattern.finditer(data[:200_000])]
    if not found:
        return _flip(data, draw)
    start, end = draw.choice(found)
    return data[:start] + draw.choice(by).encode() + data[end:]


def _number(data: bytes, draw: random.Random) -> bytes:
    return _replace(data, draw, _NUMBER, NUMBERS)


def _word(data: bytes, draw: random.Random) -> bytes:
    return _replace(data, draw, _WORD, WORDS)


def _exchange(data: bytes, draw: random.Random) -> bytes:
    """Put a number of the file in the place of another: all is well formed, and means something else."""
    found = [match.span() for match in _NUMBER.finditer(data[:200_000])]
    if len(found) < 2:
        return _flip(data, draw)
    (start, end), (a, b) = draw.sample(found, 2)
    return data[:start] + draw.choice((data[a:b], b"-" + data[start:end], data[start:end] + b"e6")) + data[end:]


# -- JSON ------------------------------------------------------------------------------------------------------------


def _json(data: bytes, draw: random.Random) -> bytes:
    """Change, delete, nest or double a value anywhere in a document."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return _number(data, draw)
    places: list[tuple[Any, Any]] = []
    stack = [document]
    while stack:
        node = stack.pop()
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in items:
            places.append((node, key))
            stack.append(value)
    if not places:
        return _number(data, draw)
    raw: list[str] = []

    def literal(text: str) -> str:
        raw.append(text)
        return f"@raw{len(raw) - 1}@"

    node, key = draw.choice(places)
    action = draw.randrange(9)
    if action <= 2:
        node[key] = literal(draw.choice(NUMBERS) or "0")
    elif action == 3:
        node[key] = draw.choice((None, True, False, [], {}, "", 0, -1, 1.5, "x", [1], {"a": 1}, [[]], [None]))
    elif action == 4:
        del node[key]
    elif action == 5:
        node[key] = draw.choice(WORDS)
    elif action == 6:
        node[key] = literal(draw.choice(("[" * _DEEP + "]" * _DEEP, '{"a":' * _DEEP + "1" + "}" * _DEEP)))
    elif action == 7 and isinstance(node, dict):
        node[draw.choice(WORDS)] = node.pop(key)
    else:
        other, where = draw.choice(places)
        node[key] = json.loads(json.dumps(other[where]))
    text = json.dumps(document, ensure_ascii=False)
    for number, one in enumerate(raw):
        text = text.replace(f'"@raw{number}@"', one)
    return text.encode("utf-8", "surrogatepass")


# -- XML -------------------------------------------------------------------------------------------------------------


def _xml(data: bytes, draw: random.Random) -> bytes:
    """Change, delete, double, empty, rename or move an element."""
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError):
        return _number(data, draw)
    pairs = [(parent, child) for parent in root.iter() for child in parent]
    if not pairs:
        return _number(data, draw)
    parent, child = draw.choice(pairs)
    action = draw.randrange(8)
    if action == 0:
        parent.remove(child)
    elif action == 1:
        parent.append(child)
    elif action <= 4:
        tokens = (child.text or "").split() or [""]
        tokens[draw.randrange(len(tokens))] = draw.choice(NUMBERS)
        child.text = " ".join(tokens)
    elif action == 5:
        child.text = draw.choice(WORDS).replace("\0", "")
    elif action == 6:
        child.tag = draw.choice([other.tag for _, other in pairs])
    else:
        for name in list(child.attrib):
            child.set(name, draw.choice((*NUMBERS, "x")))
        child[:] = []
    return ElementTree.tostring(root)


# -- TIFF ------------------------------------------------------------------------------------------------------------


def _tiff(data: bytes, draw: random.Random) -> bytes:
    """Change tag, type, count or value of a field of the first directory, or what the value points to."""
    if len(data) < 16 or data[:4] != b"II*\0":
        return _flip(data, draw)
    (start,) = struct.unpack_from("<I", data, 4)
    if start + 2 > len(data):
        return _flip(data, draw)
    (count,) = struct.unpack_from("<H", data, start)
    entries = [start + 2 + 12 * k for k in range(count) if start + 14 + 12 * k <= len(data)]
    if not entries:
        return _flip(data, draw)
    found, at = bytearray(data), draw.choice(entries)
    tag, kind, length, value = struct.unpack_from("<HHII", data, at)
    size = length * {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 11: 4, 12: 8}.get(kind, 1)
    action = draw.randrange(6)
    if action >= 3 and 4 < size < 100_000 and value + size <= len(data):
        # Out of line: doubles of the RPC, of the geotransform, numbers of the GeoKeys, text.
        if kind == 12:
            one = draw.choice((float("nan"), float("inf"), -1.0, 0.0, 1e300, 1e-300, 1e6))
            struct.pack_into("<d", found, value + 8 * draw.randrange(length), one)
        elif kind == 3:
            struct.pack_into("<H", found, value + 2 * draw.randrange(length), draw.randrange(65536))
        else:
            found[value + draw.randrange(size)] = draw.randrange(256)
    elif action == 0:
        struct.pack_into("<H", found, at, draw.choice((draw.randrange(65536), tag ^ 1)))
    elif action == 1:
        struct.pack_into("<H", found, at + 2, draw.choice((0, 1, 2, 3, 4, 5, 7, 12, 13, 255, 65535)))
    elif action == 2:
        struct.pack_into("<I", found, at + 4, draw.choice((0, 1, min(length + 1, 2**32 - 1), 2**31 - 1, 2**32 - 1)))
    else:
        struct.pack_into("<I", found, at + 8, draw.choice((0, 1, 7, 65535, 2**31 - 1, 2**32 - 1, len(data) - 1)))
    return bytes(found)


_Mutator = Callable[[bytes, random.Random], bytes]
_TEXT: tuple[_Mutator, ...] = (
    _flip, _cut, _drop, _insert, _encode, _lines, _lines, _number, _number, _number, _exchange, _word,
)  # fmt: skip
KINDS: dict[str, tuple[_Mutator, ...]] = {
    "text": _TEXT,
    "json": (_json,),
    "xml": (_xml, _xml, _number, _exchange),
    "tiff": (_tiff, _tiff, _tiff, _flip, _cut),
    "binary": (_flip, _flip, _cut, _drop),
}
