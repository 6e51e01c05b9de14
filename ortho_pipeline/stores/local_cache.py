"""The local cache of remote files: each file is complete or absent, and is checked whenever it is used.

Each file has a record (its name and ``.json``) with its address, size and SHA-256. A file that does not agree with its
record, or has none, is downloaded again. Several processes share the folder; a process waits for a file that another
one is downloading. A file and its record are written like the outputs of a command (`files.together`), but in a
separate context: they are not part of the current outputs, and not limited to their folder.
"""

from __future__ import annotations

import contextlib
import contextvars
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.folders import cache_folder
from ortho_pipeline.files.reading import parse_json, read_bounded, sha256, states
from ortho_pipeline.files.whole import Outputs, together, whole_or_nothing, write_json
from ortho_pipeline.stores.objects import Content

#: Environment variable: the folder of what is kept.
FOLDER = "ORTHO_CACHE"
_RECORD = ".json"
_REMEDY = f"set the environment variable {FOLDER} to a folder with write access and enough free space"
_RECORD_BYTES = 100_000
#: Members of a record, and their types.
_FIELDS: dict[str, tuple[type, ...]] = {"address": (str,), "bytes": (int,), "sha256": (str,), "fetched": (int, float)}
#: The states in which files agreed with their records in this process.
_agreed: dict[str, tuple[int, int, int]] = {}


@dataclass(frozen=True)
class CachedFile:
    """A cached file: its path, its address, and its size and checksum when it was downloaded."""

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
    """Return the folder of cached files: ``$ORTHO_CACHE``, or a folder in the user's cache folder.

    Raises
    ------
    InputError
        If there is none, or its path is relative: it would be a folder in the working folder.
    """
    text = os.environ.get(FOLDER)
    path = Path(text) if text else cache_folder()
    if path is None or not path.is_absolute():
        wrong = f"{FOLDER} has a relative path" if text else "there is no home folder"
        raise InputError(
            f"downloaded files cannot be cached ({wrong})",
            field=FOLDER,
            remedy=f"set the environment variable {FOLDER} to the absolute path of a folder that you may write to",
        )
    return path


def kept(
    kind: str, address: str, fetch: Callable[[Path], Content], *, fault: Callable[[Path], str] | None = None
) -> Path:
    """Return the cached file of an address; download it if it is missing or changed.

    Parameters
    ----------
    kind : str
        Its folder in the cache, such as ``dem``.
    fetch : callable (path) -> Content
        Writes the file under a temporary name. If it raises an exception, this function raises it and caches nothing.
    fault : callable (path) -> str, optional
        Returns what is wrong with a downloaded file; empty if nothing is.

    Raises
    ------
    InputError
        If the folder cannot be written, or the downloaded file is wrong.
    """
    path = folder() / kind / _name_of(address)
    if not _agrees(path, address):
        contextvars.Context().run(_fill, path, address, fetch, fault)
    return path


def _fill(path: Path, address: str, fetch: Callable[[Path], Content], fault: Callable[[Path], str] | None) -> None:
    with _alone(path):
        if _agrees(path, address):
            return
        with whole_or_nothing(path, side_cars=False) as part:
            content = fetch(part)
            wrong = fault(part) if fault is not None else ""
            if wrong:
                raise InputError(f"the downloaded file is not valid: {wrong}", file=address, remedy="check the address")
            _agreed[os.fspath(path)] = states([part])[os.fspath(part)]
        record = {"address": address, "bytes": content.size, "sha256": content.sha256, "fetched": time.time()}
        write_json(_record_of(path), record)


def records() -> Iterator[CachedFile]:
    """Yield what is kept, by name."""
    for path in sorted(folder().glob(f"*/[!.]*{_RECORD}")):
        record = _read(path)
        if record is not None:
            yield record


def clear() -> tuple[int, int]:
    """Remove all that is kept; return the number of files and their bytes."""
    count = size = 0
    for record in list(records()):
        with _alone(record.path) as files:
            with contextlib.suppress(FileNotFoundError):
                size += record.path.stat().st_size
                count += 1
            files.obsolete += [record.path, _record_of(record.path)]
        _agreed.pop(os.fspath(record.path), None)
    return count, size


def _agrees(path: Path, address: str) -> bool:
    """Return whether a file exists, unchanged since its download from this address."""
    record = _read(_record_of(path))
    if record is None or record.address != address:
        return False
    now = states([path]).get(os.fspath(path))
    if now is None or (_agreed.get(os.fspath(path)) != now and record.state() != "sound"):
        return False
    _agreed[os.fspath(path)] = now
    return True


def _read(path: Path) -> CachedFile | None:
    """Return the record of a kept file; None where it is none, so that the file is fetched again."""
    try:
        fields = parse_json(read_bounded(path, _RECORD_BYTES), path, "fetch the file again")
        record = CachedFile(path.with_name(path.name.removesuffix(_RECORD)), **{name: fields[name] for name in _FIELDS})
    except (InputError, KeyError, TypeError):
        return None
    kinds = all(type(getattr(record, name)) in kinds for name, kinds in _FIELDS.items())
    return record if kinds and record.bytes >= 0 else None


def _alone(path: Path) -> contextlib.AbstractContextManager[Outputs]:
    """Wait for others who are at this file, and let what is done with it and its record appear at once."""
    return together(path.parent, path.name, wait=True, remedy=_REMEDY)


def _record_of(path: Path) -> Path:
    return path.with_name(path.name + _RECORD)


def _name_of(address: str) -> str:
    """Return a file name that is unique for an address, with its ending."""
    last = re.sub(r"[^A-Za-z0-9._-]", "_", address.rpartition("/")[2])[-120:]
    return f"{hashlib.sha256(address.rpartition('/')[0].encode()).hexdigest()[:12]}_{last}"
