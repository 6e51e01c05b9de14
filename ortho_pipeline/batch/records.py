"""Records of a run, one per scene, and their locks.

A record says from which content (checksums of inputs, configuration, versions) which outputs were made. It says "done"
only after all of them are written, and no longer once work begins again, whatever kills the process in between.
Checksums are taken again only of files whose size or time of change differ from those recorded.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import logging
import os
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import pydantic

from ortho_pipeline import files
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Text
from ortho_pipeline.files.folders import listing
from ortho_pipeline.files.json.records import Record
from ortho_pipeline.report.wording import refuted

SCHEMA_VERSION = 1
DOCUMENT = "ortho-pipeline scene record"
_log = logging.getLogger(__name__)
#: A larger file is not a record.
MAX_BYTES = 50_000_000


#: Role of a file that was looked for, and was not there.
MISSING = "missing"


class FileState(Record):
    """A file at the time of its checksum; `role` is its role in the scene.

    An object in a store has no date. Its `tag` identifies the version in the store. A `MISSING` file has a path only.
    """

    role: str
    path: str
    bytes: int
    mtime_ns: int
    sha256: str
    tag: str = ""

    @classmethod
    def of(cls, role: str, path: Path, digest: Callable[..., str] = files.sha256, name: str | None = None) -> FileState:
        """Return the state of a file, which is recorded under `name` (its path without one)."""
        stat = path.stat()
        return cls(
            role=role, path=name or str(path), bytes=stat.st_size, mtime_ns=stat.st_mtime_ns, sha256=digest(path)
        )

    @classmethod
    def missing(cls, path: Path) -> FileState:
        """Return the state of a file that was looked for, and was not there."""
        return cls(role=MISSING, path=str(path), bytes=0, mtime_ns=0, sha256="")

    def untouched(self, folder: Path | None = None) -> bool:
        """Return whether size and time of change are as recorded; `folder` is the base of a relative path."""
        if self.tag:
            return False  # only its store can tell
        if self.role == MISSING and folder is None:
            return not os.path.exists(self.path)
        try:
            stat = os.stat(folder / self.path if folder else self.path)
        except (OSError, ValueError):
            return False
        return (stat.st_size, stat.st_mtime_ns) == (self.bytes, self.mtime_ns)

    def same(self, folder: Path) -> bool:
        """Return whether the file in `folder` has the recorded content."""
        return self.untouched(folder) or self.identical(folder)

    def identical(self, folder: Path) -> bool:
        """Return whether the file in `folder` has the recorded content, ignoring timestamps."""
        try:
            return (folder / self.path).is_file() and files.sha256(folder / self.path) == self.sha256
        except (OSError, ValueError):
            # A name that no file can have, or a file that cannot be read.
            return False


class RunRecord(Record):
    """Inputs and outputs of a scene.

    Parameters
    ----------
    key : str
        SHA-256 of content of the inputs, configuration and versions.
    inputs, outputs : tuple of FileState
        Outputs by their names within the folder of the scene.
    siblings : str
        Digest of the names in the folders of the inputs: a new side-car changes it.
    status : {'started', 'done', 'failed'}
    facts : mapping
        JSON values for the summary.
    error : mapping, optional
        Kind, message, file, field and remedy.
    run : str
        The run that made it.
    """

    name: str
    key: str
    status: str
    inputs: tuple[FileState, ...] = ()
    outputs: tuple[FileState, ...] = ()
    siblings: str = ""
    seconds: float = 0.0
    facts: Mapping[str, Any] = pydantic.Field(default_factory=dict)
    error: Mapping[str, Any] | None = None
    run: str = ""

    def text(self) -> str:
        """Return the record as one line of JSON."""
        document = {
            "document": DOCUMENT,
            "schema_version": SCHEMA_VERSION,
            **vars(self),
            "inputs": [vars(state) for state in self.inputs],
            "outputs": [vars(state) for state in self.outputs],
        }
        # On one line: the encoder of many is written in Python, and takes as long as the rest of the record.
        return json.dumps(document, allow_nan=False) + "\n"

    def write(self, path: Path) -> None:
        """Write the record, whole or not at all."""
        files.write_text(path, self.text())

    @classmethod
    def at(cls, path: Path) -> Self | None:
        """Return the record, or None where there is none of this version that can be understood."""
        if not path.is_file():
            return None
        record = None
        with contextlib.suppress(InputError):
            record = cls.parse(files.read_bounded(path, MAX_BYTES, remedy="run again"))
        if record is None:
            _log.warning("%s: cannot read this record; its outputs are made again", path)
        return record

    @classmethod
    def parse(cls, data: bytes) -> Self | None:
        """Return the record in an untrusted text; None if it is not valid."""
        try:
            document = files.parse_json(data, "record", "run again")
            if (document.pop("document"), document.pop("schema_version")) != (DOCUMENT, SCHEMA_VERSION):
                return None
            record = cls.read(document)
            if record.facts:
                Facts.read(record.facts)
                refuted(record.facts["notices"])  # what a page says of them needs their members
            if record.error is not None:
                Failure.read(record.error)
                error = {key: text if text is None else Text.read(text) for key, text in record.error.items()}
                record = record.replaced(error=error)
        except (InputError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return None
        # What is outside of the scene's folder is not ours to judge, or to remove.
        inside = all(Path(state.path).name == state.path not in ("", "..") for state in record.outputs)
        complete = not record.facts or {state.role for state in record.outputs} >= _OUTPUTS
        return record if inside and complete else None

    def intact(self, folder: Path, checksums: bool = False) -> bool:
        """Return whether all outputs are unchanged; with `checksums` by content, ignoring timestamps."""
        if checksums:
            return all(state.identical(folder) for state in self.outputs)
        return all(state.same(folder) for state in self.outputs)


class Facts(Record):
    """What a summary says of a scene that is done."""

    sensor: str
    model: str
    headline: Mapping[str, Any]
    lean_m_per_m: float | None
    rmse_px: Mapping[str, float | None]
    rmse_m: Mapping[str, float | None]
    rmse_points: Mapping[str, int | None]
    ortho: Mapping[str, Any]
    warnings: Sequence[str]
    notices: Sequence[Mapping[str, Any]]


class Failure(Record):
    """What a summary says of a scene that failed."""

    kind: str
    message: str
    file: str | None
    field: str | None
    remedy: str | None
    trace: str = ""


#: Roles of the outputs that every scene has which is done.
_OUTPUTS = {"ortho", "report", "html"}


def key_of(inputs: Sequence[FileState], configuration: Mapping[str, Any], versions: Mapping[str, Any]) -> str:
    """Return the SHA-256 of all that the outputs depend on."""
    content = {
        "inputs": sorted((state.role, state.path, state.sha256 or f"{state.bytes} {state.tag}") for state in inputs),
        "configuration": configuration,
        "versions": versions,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()


def siblings(paths: Sequence[str | os.PathLike[str]], cache: dict[Path, Sequence[str]] | None = None) -> str:
    """Return a digest of the names in the folders of some files or patterns; `cache` holds listings of this run."""
    listed: dict[Path, Sequence[str]] = {} if cache is None else cache
    digest = hashlib.sha256()
    for folder in sorted({folder for path in paths for folder in _folders_of(Path(path).parent)}):
        if folder not in listed:
            listed[folder] = listing(folder).names if folder.is_dir() else ()
        digest.update("\0".join([str(folder), *listed[folder], ""]).encode(errors="surrogateescape"))
    return digest.hexdigest()


def _folders_of(folder: Path) -> Iterable[Path]:
    """Return a folder, or the folders that match a pattern such as ``dem/*``."""
    pattern = glob.has_magic(str(folder)) and not folder.is_dir()
    return map(Path, glob.iglob(str(folder))) if pattern else (folder,)


class Digests(files.Checksums):
    """Checksums that records know are not taken again."""

    _renewed = ""

    def renew(self, run: str) -> None:
        """Forget all checksums from before a run; a process may make several of its scenes."""
        if run != self._renewed:
            self.known.clear()
            self._renewed = run

    def learn(self, states: Sequence[FileState]) -> None:
        """Take over what a record knows."""
        self.known.update({(state.path, state.bytes, state.mtime_ns): state.sha256 for state in states})


# -- locks -----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def locked(path: Path, *, shared: bool = False, wait: bool = False, owner: str = "") -> Iterator[None]:
    """Hold a lock, which the system releases however the process ends.

    Parameters
    ----------
    shared : bool
        Others may hold it too, if they share it.
    wait : bool
        Wait for it; otherwise a lock that is held is an error.
    owner : str
        What the error of others names, with the process and the machine.

    Raises
    ------
    InputError
        If the lock is held, or the folder cannot be written or locked.
    """
    path = files.allowed(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = files.Lock(path, shared=shared, wait=wait)
    except BlockingIOError as error:
        with path.open("rb") as file:
            holder = file.read(500).decode(errors="replace").strip() or "another run"
        raise InputError(
            f"{holder} is using this output folder",
            file=path.parent.parent,
            field="output",
            remedy="wait until it ends, or choose another output folder",
        ) from error
    except OSError as error:
        raise InputError(
            f"cannot write here ({error.strerror})",
            file=path.parent,
            field="output",
            remedy="choose a folder with write permission, on a file system with locks",
        ) from error
    with contextlib.closing(lock):
        if not wait:
            owner = f"{owner} (process {os.getpid()} on {socket.gethostname()})".strip()
            os.ftruncate(lock.descriptor, 0)
            os.lseek(lock.descriptor, 0, os.SEEK_SET)
            os.write(lock.descriptor, owner.encode())
        yield


def require_lock(path: Path) -> None:
    """Refuse work in a folder without the lock of the run: a worker on another machine may have one of its own here.

    Raises
    ------
    InputError
        If the lock is not there, or cannot be seen.
    """
    if not os.path.isfile(path):
        raise InputError(
            "this worker does not have the output folder of the run",
            file=path.parent.parent,
            field="output",
            remedy="share one folder, at the same path, with all workers",
        )
