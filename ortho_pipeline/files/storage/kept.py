"""What is kept on this machine of files that lie elsewhere: whole or not there, and checked whenever it is used.

Beside each file stands a record (its name and ``.json``) of where it came from, its size and its SHA-256. A file that
does not agree with its record, or has none, counts as not there and is fetched again. Several processes share the
folder; who needs a file that another one is fetching waits for it.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import re
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.folders import cache_folder
from ortho_pipeline.files.locks import Lock
from ortho_pipeline.files.reading import parse_json, read_bounded, sha256
from ortho_pipeline.files.storage.objects import Content

#: Environment variable: the folder of what is kept.
FOLDER = "ORTHO_CACHE"
_RECORD, _LOCK, _PART = ".json", ".lock", ".part"
_RECORD_BYTES = 100_000
#: Members of a record, and of which types they are.
_FIELDS: dict[str, tuple[type, ...]] = {"address": (str,), "bytes": (int,), "sha256": (str,), "fetched": (int, float)}
#: Files of this process that agreed with their records, by size, time of change and inode.
_agreed: dict[str, tuple[int, int, int]] = {}


@dataclass(frozen=True)
class Record:
    """A file that is kept: where, where it came from, and what it was when it came."""

    path: Path
    address: str
    bytes: int
    sha256: str
    fetched: float

    def state(self) -> str:
        """Return ``sound``, or what is wrong with the file."""
        try:
            if self.path.stat().st_size != self.bytes:
                return "of another size"
            return "sound" if sha256(self.path) == self.sha256 else "damaged"
        except OSError:
            return "missing"


def folder() -> Path:
    """Return the folder of what is kept: ``$ORTHO_CACHE``, or one of the user's folder of caches.

    Raises
    ------
    InputError
        If there is none, or its path is relative: it would be a folder in the working folder.
    """
    given = os.environ.get(FOLDER)
    found = Path(given) if given else cache_folder()
    if found is None or not found.is_absolute():
        wrong = f"{FOLDER} has a relative path" if given else "there is no home folder"
        raise InputError(
            f"files of the network cannot be kept ({wrong})", field=FOLDER,
            remedy=f"set the environment variable {FOLDER} to the absolute path of a folder that you may write to",
        )  # fmt: skip
    return found


def kept(
    kind: str, address: str, fetch: Callable[[Path], Content], *, fault: Callable[[Path], str] | None = None
) -> Path:
    """Return the file that is kept of an address, fetched if it is not there or not what it was.

    Parameters
    ----------
    kind : str
        The folder that it lies in, such as ``dem``.
    fetch : callable (path) -> Content
        Writes the file under a temporary name. What it raises, this raises, and nothing is kept.
    fault : callable (path) -> str, optional
        What is wrong with a file that was fetched; empty if nothing is.

    Raises
    ------
    InputError
        If the folder cannot be written, or there is a fault in what was fetched.
    """
    path = folder() / kind / _name_of(address)
    if _agrees(path, address):
        return path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(path):
            if not _agrees(path, address):
                _fill(path, address, fetch, fault)
    except OSError as error:
        if isinstance(error, FileNotFoundError) and error.filename == address:
            raise
        raise InputError(
            f"files of the network cannot be kept here ({error.strerror or error})", file=path.parent,
            remedy=f"name a folder that you may write to and that has room in the environment variable {FOLDER}",
        ) from error  # fmt: skip
    return path


def _fill(path: Path, address: str, fetch: Callable[[Path], Content], fault: Callable[[Path], str] | None) -> None:
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}{_PART}")
    for left in path.parent.glob(f"{glob.escape(path.name)}.*{_PART}"):
        left.unlink(missing_ok=True)  # of a process that was killed: we hold the lock
    try:
        content = fetch(part)
        wrong = fault(part) if fault is not None else ""
        if wrong:
            raise InputError(f"what was fetched is not sound: {wrong}", file=address, remedy="check the address")
        record = {"address": address, "bytes": content.size, "sha256": content.sha256, "fetched": time.time()}
        text = path.with_name(f"{part.name}{_RECORD}{_PART}")
        text.write_text(json.dumps(record), encoding="utf-8")
        # A file without its record is fetched again, and so is one with the record of another.
        os.replace(part, path)
        os.replace(text, _record_of(path))
        _agreed[os.fspath(path)] = _state(path)
    finally:
        part.unlink(missing_ok=True)


def records() -> Iterator[Record]:
    """Yield what is kept, by name."""
    for path in sorted(folder().glob(f"*/*{_RECORD}")):
        found = _read(path)
        if found is not None:
            yield found


def clear() -> tuple[int, int]:
    """Remove all that is kept; return the number of files and their bytes."""
    count = size = 0
    for record in list(records()):
        with _locked(record.path):
            with contextlib.suppress(FileNotFoundError):
                size += record.path.stat().st_size
                record.path.unlink()
                count += 1
            _record_of(record.path).unlink(missing_ok=True)
        _agreed.pop(os.fspath(record.path), None)
    return count, size


def _agrees(path: Path, address: str) -> bool:
    """Tell whether a file is there as it was fetched from this address."""
    record = _read(_record_of(path))
    if record is None or record.address != address:
        return False
    try:
        if _agreed.get(os.fspath(path)) == _state(path):
            return True
        if record.state() != "sound":
            return False
        _agreed[os.fspath(path)] = _state(path)
    except OSError:
        return False
    return True


def _read(path: Path) -> Record | None:
    """Return the record of a kept file; None where it is none, so that the file is fetched again."""
    try:
        given = parse_json(read_bounded(path, _RECORD_BYTES), path, "fetch the file again")
        record = Record(path.with_name(path.name.removesuffix(_RECORD)), **{name: given[name] for name in _FIELDS})
    except (InputError, KeyError, TypeError):
        return None
    kinds = all(type(getattr(record, name)) in kinds for name, kinds in _FIELDS.items())
    return record if kinds and record.bytes >= 0 else None


def _locked(path: Path) -> contextlib.closing[Lock]:
    """Wait for others who are at this file. On a file system without locks the same file is fetched twice."""
    return contextlib.closing(Lock(path.with_name(path.name + _LOCK), needed=False))


def _record_of(path: Path) -> Path:
    return path.with_name(path.name + _RECORD)


def _state(path: Path) -> tuple[int, int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ino


def _name_of(address: str) -> str:
    """Return a name of a file that is told from those of other addresses, and ends as this one does."""
    last = re.sub(r"[^A-Za-z0-9._-]", "_", address.rpartition("/")[2])[-120:]
    return f"{hashlib.sha256(address.rpartition('/')[0].encode()).hexdigest()[:12]}_{last}"
