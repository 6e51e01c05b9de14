"""The journal: every action on its own line, written to disk before it is shown, so that nothing is lost.

A line is a JSON object with a checksum. An incomplete last line, from a killed process or a power cut, is removed when
the journal is opened again. A wrong line anywhere else is an error, because later actions depend on it. One process
holds the lock and writes; others can read.
"""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import Lock, allowed, open_itself, parse_json, sync_folder

#: A larger file (bytes) is not a journal of manual measurements.
MAX_BYTES = 256_000_000
#: Suffix of the file for actions after an impossible one.
REST = ".rest"
#: Remedy if a journal cannot be opened.
REMEDY = "move the journal away to start again, or restore it from a backup"


class Journal:
    """An open journal.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    actions : list of dict
        Its actions, in order.
    read_only : bool
        Whether another process holds the lock.
    healed : int
        Bytes of an incomplete last line that were removed.

    Raises
    ------
    InputError
        If it cannot be opened, or is damaged before its end.
    """

    def __init__(self, path: Path) -> None:
        self.path = allowed(path)
        try:
            try:
                self._lock: Lock | None = Lock(path, wait=False)
                self._file = self._lock.descriptor
            except BlockingIOError:
                self._lock, self._file = None, open_itself(path, os.O_RDONLY)
            self.read_only = self._lock is None
            data = _whole(self._file, path)
        except OSError as error:
            raise _unwritable(path, error) from error
        sound, self.actions = _lines(data, path)
        self.healed = len(data) - sound
        if not self.read_only:
            if self.healed:
                os.ftruncate(self._file, sound)
                os.fsync(self._file)
            sync_folder(path.parent)

    def append(self, action: Mapping[str, Any]) -> None:
        """Write an action and wait until it is on disk; if that fails, nothing of it remains.

        Raises
        ------
        InputError
            If another process holds the lock, or the journal cannot be written, or is no longer in its place.
        """
        if self._lock is None:
            raise InputError(
                "these points are open in another ortho measure process; this one is read-only",
                file=self.path,
                remedy="close the other process, and start again",
            )
        self._require_in_place()
        try:
            self._lock.append(_line(action))
        except OSError as error:
            raise _unwritable(self.path, error) from error
        self.actions.append(dict(action))

    def _require_in_place(self) -> None:
        """Refuse to write to a file that has no name any more, or another one: nobody would find it."""
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(self._file), os.stat(self.path, follow_symlinks=False)):
                return
        raise InputError(
            "the journal was moved, deleted or replaced, so this action is not saved",
            file=self.path,
            remedy="move it back; or save, close this process, and begin another output with the saved points",
        )

    def more(self) -> list[dict[str, Any]]:
        """Return and keep what another process has written since; an incomplete line is left for later.

        Raises
        ------
        InputError
            If the journal is damaged.
        """
        if not self.read_only:
            return []
        try:
            os.lseek(self._file, 0, os.SEEK_SET)
            data = _whole(self._file, self.path)
        except OSError as error:
            raise _unwritable(self.path, error) from error
        new = _lines(data, self.path)[1][len(self.actions) :]
        self.actions += new
        return new

    def set_aside(self, count: int) -> None:
        """Keep this many actions; move the others to the end of a file next to the journal.

        A journal that another process writes is not changed.
        """
        kept, rest = (b"".join(map(_line, part)) for part in (self.actions[:count], self.actions[count:]))
        self.actions = self.actions[:count]
        if self.read_only:
            return
        path = self.path.with_name(self.path.name + REST)
        try:
            with contextlib.closing(Lock(path)) as aside:
                aside.append(rest)
            sync_folder(path.parent)
            os.ftruncate(self._file, len(kept))
            os.fsync(self._file)
        except OSError as error:
            raise _unwritable(path, error) from error

    def close(self) -> None:
        """Close the file and release its lock."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def _line(action: Mapping[str, Any]) -> bytes:
    text = json.dumps(action, allow_nan=False, separators=(",", ":"))
    return f'{{"crc":"{zlib.crc32(text.encode()):08x}","action":{text}}}\n'.encode()


def _whole(descriptor: int, path: Path) -> bytes:
    if os.fstat(descriptor).st_size > MAX_BYTES:
        raise InputError("this file is too large for a journal of measured points", file=path, remedy=REMEDY)
    parts = []
    while part := os.read(descriptor, 1 << 20):
        parts.append(part)
    return b"".join(parts)


def _lines(data: bytes, path: Path) -> tuple[int, list[dict[str, Any]]]:
    """Return the number of valid bytes, and their actions."""
    actions: list[dict[str, Any]] = []
    start = 0
    while start < len(data):
        end = data.find(b"\n", start)
        if end < 0:
            return start, actions
        action = _action(data[start:end])
        if action is None:
            if end + 1 == len(data):
                # After a power cut, a line can have its length but not its bytes.
                return start, actions
            raise InputError(
                "the journal is damaged at this line, and later actions depend on it",
                file=path,
                field=f"line {len(actions) + 1}",
                remedy=REMEDY,
            )
        actions.append(action)
        start = end + 1
    return start, actions


def _action(line: bytes) -> dict[str, Any] | None:
    """Return the action of a line; None if its checksum is wrong."""
    try:
        document = parse_json(line, "journal", REMEDY)
    except InputError:
        return None
    action = document.get("action") if isinstance(document, dict) else None
    return action if isinstance(action, dict) and _line(action) == line + b"\n" else None


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(
        f"the journal cannot be written ({error.strerror or error})",
        file=path,
        remedy="choose an output in a folder with write permission and free space",
    )
