"""Files of a stack that are made once: each set has a record of what it was made from, on disk or in object storage.

Any worker makes a set: it needs the set and the folder, nothing else.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ortho_pipeline.batch.executors import Crew, completed
from ortho_pipeline.batch.freshness import DIGESTS, change_in_store, recorded_at, require_versions
from ortho_pipeline.batch.paths import key_of_name
from ortho_pipeline.batch.plan import STATE
from ortho_pipeline.batch.records import MAX_BYTES, FileState, RunRecord, key_of, locked, require_lock
from ortho_pipeline.commands.resolved.ledger import versions
from ortho_pipeline.errors import InputError, error_document
from ortho_pipeline.files import clear_up
from ortho_pipeline.files.locations import Location, VsiPath, located
from ortho_pipeline.runtime.process_limits import one_blas_thread
from ortho_pipeline.stores.delivery import address_of, delivered
from ortho_pipeline.stores.objects import Objects

#: No file of a stack is larger (bytes).
LARGEST = 1 << 42
#: The lock of a stack within its folder.
LOCK = Path("pairs", ".lock")
#: How the names of records end.
_RECORD = ".record.json"


@dataclass(frozen=True)
class FileSet:
    """Files that are made together.

    Parameters
    ----------
    inputs : tuple of FileState
        The files that they are made from.
    configuration : mapping
        JSON values of all else that they depend on, but for the software.
    files : mapping
        Their names by role.
    write : callable (folder) -> None
        Writes them. It is sent to other processes.
    may_fail : bool
        An `InputError` of `write` is recorded, too, but not one of the disk. Otherwise it ends the run.
    """

    name: str
    inputs: tuple[FileState, ...]
    configuration: Mapping[str, Any]
    files: Mapping[str, str]
    write: Callable[[Path], None]
    may_fail: bool = False
    software: Mapping[str, Any] = field(default_factory=versions)

    @property
    def key(self) -> str:
        """The key of their record: the same while nothing that they depend on has changed."""
        return key_of(self.inputs, self.configuration, self.software)

    def is_in(self, record: RunRecord) -> bool:
        """Return whether a record is that of this set; a failure with far files may have been one of access."""
        if (record.name, record.key) != (self.name, self.key):
            return False
        if record.status == "done":
            return {state.path for state in record.outputs} == set(self.files.values())
        return self.may_fail and record.error is not None and not any(state.tag for state in self.inputs)

    def made(self, folder: Path) -> RunRecord:
        """Write the files into a folder, and return their record."""
        require_versions(self.software)
        self._require_inputs()
        record = RunRecord(name=self.name, key=self.key, status="failed", inputs=self.inputs)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.write(folder)
        except InputError as error:
            # The cause is the disk, not the inputs. The next run must try again.
            if not self.may_fail or isinstance(error.__cause__, OSError):
                raise
            return record.replaced(error=error_document(error))
        outputs = tuple(FileState.of(role, folder / name, name=name) for role, name in self.files.items())
        return record.replaced(status="done", outputs=outputs)

    def _require_inputs(self) -> None:
        """Refuse to make it without an input: that would be recorded as a failure of the images."""
        near = (state for state in self.inputs if not Location(state.path).is_far)
        lost = next((state for state in near if not os.path.isfile(state.path)), None)
        if lost is not None:
            raise InputError(
                "this worker does not have this input",
                file=lost.path,
                remedy="give all workers the inputs, at the same path",
            )


class Made(NamedTuple):
    """The record of a set of files, and whether an earlier run made them."""

    record: RunRecord
    kept: bool


@dataclass(frozen=True)
class RecordedFolder:
    """A folder of sets of files with records, on this machine or in object storage.

    Parameters
    ----------
    place : str
        Path or address.
    rebuild : bool
        Make also files that are as recorded.
    """

    place: str
    allow_network: bool
    rebuild: bool

    @property
    def is_far(self) -> bool:
        """Whether it is in object storage."""
        return address_of(self.place) is not None

    @property
    def store(self) -> Objects:
        """The folder in object storage."""
        return Objects(self.place, allow_network=self.allow_network)

    def path(self, name: str) -> Path | VsiPath:
        """Return the path of a file."""
        if not self.is_far:
            return Path(self.place) / name
        place = located(f"{self.place}/{name}", allow_network=self.allow_network)
        assert isinstance(place, VsiPath)
        return place

    def learn(self, name: str) -> None:
        """Learn the checksums of inputs that the record of a set states."""
        record = None if self.rebuild or self.is_far else RunRecord.at(Path(self.place) / record_file(name))
        if record is not None:
            DIGESTS.learn(record.inputs)

    def make_all(
        self,
        crew: Crew,
        sets: Sequence[FileSet],
        told: Callable[[float], None],
        begin: Callable[[], None] | None = None,
    ) -> dict[str, Made]:
        """Make sets of files, unless they are as recorded; return their records by name.

        Parameters
        ----------
        told : callable
            Called with the finished share.
        begin : callable, optional
            Called before any is made.

        Raises
        ------
        InputError, StorageError
            If a set cannot be made.
        """
        found: dict[str, Made] = {}

        def note(name: str, made: Made) -> None:
            found[name] = made
            told(len(found) / len(sets))

        left, folder = [], Path(self.place)
        for one in sets:
            # Another worker may be writing it: this only reads.
            record = None if self.is_far or self.rebuild else RunRecord.at(folder / record_file(one.name))
            kept = self._valid(one, record)
            if kept is None:
                left.append(one)
            else:
                # A command that was killed after its last rename has left a lock; another worker may hold it.
                for name in (record_file(one.name), *one.files.values()):
                    with contextlib.suppress(InputError):
                        clear_up(folder / name)
                note(one.name, Made(kept, True))
        # New processes for nothing take longer than all of this.
        if left:
            if begin is not None:
                begin()
            for one, future in completed(crew, self.make, left):
                note(one.name, future.result())
        return found

    def make(self, one: FileSet) -> Made:
        """Make a set of files unless they are as recorded; called in a worker.

        On a disk, two workers that were given the same set make it once. Object storage has no lock: both make it.
        """
        with one_blas_thread():
            if self.is_far:
                return self._make_far(one)
            folder = Path(self.place)
            require_lock(folder.parent / LOCK)
            with locked(folder / STATE / f"{one.name}.lock", wait=True):
                kept = self._kept(one)
                if kept is not None:
                    return Made(kept, True)
                record = one.made(folder)
                record.write(folder / record_file(one.name))
                return Made(record, False)

    def _kept(self, one: FileSet) -> RunRecord | None:
        folder = Path(self.place)
        files = [folder / name for name in one.files.values()]
        return self._valid(one, recorded_at(folder / record_file(one.name), *files, rebuild=self.rebuild))

    def _valid(self, one: FileSet, record: RunRecord | None) -> RunRecord | None:
        """Return a record on this machine if it is that of a set, and the files are as it states."""
        return record if record is not None and one.is_in(record) and record.intact(Path(self.place)) else None

    def _make_far(self, one: FileSet) -> Made:
        """Make the files on this machine and upload them; the record is removed first and written last."""
        store, name = self.store, record_file(one.name)
        record = None if self.rebuild else _record_in(store, name)
        if record is not None and one.is_in(record) and not change_in_store(store, record):
            return Made(record, True)
        store.delete(name)
        with delivered(self.place, one.name, allow_network=self.allow_network, keep=lambda path: True) as delivery:
            record = one.made(delivery.folder)
        stored = delivery.stored
        outputs = tuple(state.replaced(mtime_ns=0, tag=stored[state.path].tag) for state in record.outputs)
        record = record.replaced(outputs=outputs)
        store.put(name, record.text().encode())
        return Made(record, False)

    def names(self) -> set[str]:
        """Return the names of all files in the folder."""
        if self.is_far:
            return {name for name, _ in self.store.names()}
        return set(os.listdir(self.place)) if os.path.isdir(self.place) else set()

    def begun(self, names: Iterable[str]) -> list[str]:
        """Return the sets on this machine that were begun and have no record, and none of some names.

        A command that was killed has left some of their files.
        """
        if self.is_far:
            return []
        known, there = {key_of_name(name) for name in names}, self.names()
        found = sorted(path.name.removesuffix(".lock") for path in (Path(self.place) / STATE).glob("*.lock"))
        return [name for name in found if key_of_name(name) not in known and record_file(name) not in there]

    def others(self, names: Iterable[str]) -> list[str]:
        """Return the names of recorded sets other than some."""
        known, found = {key_of_name(record_file(name)) for name in names}, []
        for name in sorted(self.names()):
            if not name.endswith(_RECORD) or key_of_name(name) in known:
                continue
            record = _record_in(self.store, name) if self.is_far else RunRecord.at(Path(self.place) / name)
            if record is not None:
                found.append(name.removesuffix(_RECORD))
        return found

    @contextlib.contextmanager
    def local(self, *names: str, folder: Path | None = None) -> Iterator[Path]:
        """Yield a folder on this machine with some of the files; of object storage, with copies for the block.

        Parameters
        ----------
        folder : Path, optional
            For the copies. Default: a temporary folder.
        """
        if not self.is_far:
            yield Path(self.place)
            return
        with tempfile.TemporaryDirectory(prefix="ortho_") as scratch:
            copies = [(folder or Path(scratch)) / name for name in names]
            for copy in copies:
                self.store.fetch(copy.name, copy, LARGEST)
            yield folder or Path(scratch)
            for copy in copies:
                copy.unlink()


def recorded_in(folder: str | os.PathLike[str], name: str, allow_network: bool, rebuild: bool) -> RecordedFolder:
    """Return a folder of a stack."""
    address = address_of(folder)
    place = os.path.join(folder, name) if address is None else f"{address.rstrip('/')}/{name}"
    return RecordedFolder(place, allow_network, rebuild)


def record_file(name: str) -> str:
    """Return the name of the record of a set."""
    return f"{name}{_RECORD}"


def _record_in(store: Objects, name: str) -> RunRecord | None:
    """Return a record in object storage; None if there is none that can be understood."""
    try:
        return RunRecord.parse(store.read(name, MAX_BYTES)[0])
    except FileNotFoundError:
        return None
