"""Files of strangers: no more is read of them than they may have, and JSON only within its standard."""

from __future__ import annotations

import codecs
import contextlib
import hashlib
import json
import math
import os
import re
import stat
import threading
from collections.abc import Iterable
from concurrent.futures import CancelledError
from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import VsiPath, check_path

#: Marks at the beginning of text in UTF-16.
UTF_16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
#: Bytes that are read at once for a checksum.
_CHUNK = 1 << 20
#: The escape of half a character.
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
#: Digits that a whole number in a JSON document may have.
_DIGITS = 40


def read_bounded(path: str | os.PathLike[str], limit: int, **told: str) -> bytes:
    """Return the bytes of a file, of one that is larger the first ``limit + 1``.

    Raises
    ------
    InputError
        If it cannot be read, or is a pipe or a device, which may never end; with field and remedy as `told`.

    Examples
    --------
    >>> read_bounded("sample_data/gcps.csv", 5)
    b'#CRS: '
    """
    try:
        if isinstance(path, VsiPath):
            return path.read(limit + 1)
        # Without O_NONBLOCK, opening a pipe waits for somebody who writes to it; Windows has no pipes among files.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with open(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                told.setdefault("remedy", "give a plain file")
                raise InputError("this is a folder, a pipe or a device, not a file", file=path, **told)
            return file.read(limit + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, FileNotFoundError) and not isinstance(path, VsiPath):
            told["remedy"] = check_path(path)
        told.setdefault("remedy", "check its path and its permissions")
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"this file cannot be read ({reason})", file=path, **told) from error


def why_no_file(name: str) -> str:
    """Return why a path is neither a file nor a folder.

    Examples
    --------
    >>> why_no_file("missing.tif")
    'there is no such file'
    """
    try:
        os.stat(name)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return "there is no such file"
    except OSError as error:
        return f"this file cannot be read ({error.strerror})"
    return "this is a pipe or a device"


def decoded(data: bytes) -> str:
    """Return text that ought to be UTF-8 but may be Latin-1: what is read of it is ASCII, its names need not be.

    PowerShell and spreadsheets write UTF-16, with its mark at the beginning.

    Examples
    --------
    >>> decoded("Büyüksalih".encode("latin-1"))
    'Büyüksalih'
    """
    try:
        return data.decode("utf-16" if data.startswith(UTF_16) else "utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def parse_json(data: str | bytes, file: object, remedy: str, *, unique: bool = False) -> Any:
    """Return a JSON document whose numbers are all finite.

    Parameters
    ----------
    file : path
        For messages.
    unique : bool
        Refuse fields that stand twice in an object.

    Raises
    ------
    InputError
        Names the line, for what is not JSON in UTF-8, ``NaN``, ``Infinity`` and numbers beyond those of a computer.

    Examples
    --------
    >>> parse_json('{"gain": 0.5}', "scene.json", "copy the file again")
    {'gain': 0.5}
    """
    try:
        text = data.decode("utf-8-sig") if isinstance(data, bytes) else data
        found = json.loads(
            text,
            parse_constant=_finite,
            parse_float=_finite,
            parse_int=_whole,
            object_pairs_hook=_unique if unique else None,
        )
        if _SURROGATE.search(text):
            # Half of a character is in no name of a file, and cannot be written to a report.
            json.dumps(found, ensure_ascii=False).encode()
        return found
    except (ValueError, RecursionError) as error:
        line = f"line {error.lineno}" if isinstance(error, json.JSONDecodeError) else None
        reason = str(error)[:120]
        raise InputError(f"this is not JSON ({reason})", file=str(file), field=line, remedy=remedy) from error


def read_json(path: str | os.PathLike[str], limit: int, remedy: str, *, unique: bool = False) -> Any:
    """Return the JSON document in a file of at most `limit` bytes, as `parse_json` does.

    Examples
    --------
    >>> sorted(read_json("sample_data/truth.json", 1_000_000, "copy the file again"))
    ['about', 'camera', 'noise', 'points', 'rpc', 'seeds', 'terrain']
    """
    data = read_bounded(path, limit, remedy=remedy)
    if len(data) > limit:
        raise InputError(f"this file is larger than the limit of {limit // 1_000_000} MB", file=path, remedy=remedy)
    return parse_json(data, path, remedy, unique=unique)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is not a finite number")
    return value


def _whole(text: str) -> int:
    # Longer ones are not numbers of anything here, and overflow where they become floats.
    if len(text) > _DIGITS:
        raise ValueError(f"{text[:20]}... is too large for a number")
    return int(text)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a field appears twice")
    return found


def sha256(path: str | os.PathLike[str], stop: threading.Event | None = None) -> str:
    """Return the SHA-256 of a file as hexadecimal text.

    Raises
    ------
    CancelledError
        As soon as `stop` is set.
    """
    digest = hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        while chunk := file.read(_CHUNK):
            if stop is not None and stop.is_set():
                raise CancelledError
            digest.update(chunk)
    return digest.hexdigest()


class Checksums:
    """SHA-256 of files, taken once for each state (path, size, time of change) of a file.

    Examples
    --------
    >>> checksums = Checksums()
    >>> checksums("sample_data/gcps.csv") == checksums("sample_data/gcps.csv") == sha256("sample_data/gcps.csv")
    True
    """

    def __init__(self) -> None:
        self.known: dict[tuple[str, int, int], str] = {}

    def __call__(self, path: str | os.PathLike[str], stop: threading.Event | None = None) -> str:
        """Return the SHA-256 of a file; as `sha256`."""
        status = os.stat(path)
        state = os.fspath(path), status.st_size, status.st_mtime_ns
        if state not in self.known:
            self.known[state] = sha256(path, stop)
        return self.known[state]


def states(paths: Iterable[str | os.PathLike[str]]) -> dict[str, tuple[int, int, int]]:
    """Return size, time of change and inode of the files among `paths`, by which a change is noticed."""
    found = {}
    for path in paths:
        with contextlib.suppress(OSError):
            status = os.stat(path)
            found[os.fspath(path)] = (status.st_size, status.st_mtime_ns, status.st_ino)
    return found
