"""Whether a scene agrees with its record: one rule for outputs on disk and in object storage.

A record states of every input and output its place, its size and its checksum, or the tag that a store gives it. A
scene is fresh while all of them are so, and settings and software too.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ortho_pipeline.batch.plan import Job
from ortho_pipeline.batch.records import MISSING, Digests, FileState, RunRecord, key_of, siblings
from ortho_pipeline.commands.resolved.ledger import Ledger, versions
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.files import clear_up, confined
from ortho_pipeline.files.folders import listing
from ortho_pipeline.files.locations import Location, VsiPath
from ortho_pipeline.stores.objects import Objects, stated_at
from ortho_pipeline.surface.cells.copernicus import LIST
from ortho_pipeline.surface.cells.sources import places_of

#: Larger files next to an image are not metadata.
_COMPANION_BYTES = 5_000_000
#: Role of the file that the model was read from, if the scene does not name it otherwise.
_MODEL = "model source"
#: Checksums that this process has taken.
DIGESTS = Digests()


def recorded_at(place: Path, *files: Path, rebuild: bool) -> RunRecord | None:
    """Return the record of some files, and learn its checksums; None if there is none, or all is to be made again.

    What a killed command left of record and files is cleared up.
    """
    for file in (*files, place):
        clear_up(file)
    record = None if rebuild else RunRecord.at(place)
    if record is not None:
        DIGESTS.learn(record.inputs)
    return record


def require_versions(expected: Mapping[str, Any]) -> None:
    """Refuse work for a run with other software.

    Raises
    ------
    InputError
        With what differs.
    """
    here = versions()
    other = [
        f"{name} {here[name]} instead of {expected.get(name)}" for name in here if here[name] != expected.get(name)
    ]
    if other:
        raise InputError(
            f"this worker has different software versions: {'; '.join(other)}",
            field="scheduler",
            remedy="install the same versions everywhere",
        )


def is_scene(record: RunRecord) -> bool:
    """Return whether a record belongs to a finished scene and has all facts of a summary."""
    return record.status == "done" and bool(record.facts)


def inputs_as_recorded(record: RunRecord, job: Job, checksums: bool = False) -> tuple[FileState, ...] | None:
    """Return the inputs of a scene with their present dates; None if they, settings or software are not as recorded.

    Parameters
    ----------
    checksums : bool
        Take the checksums again of files whose size and date are those recorded, too.
    """
    if not checksums:
        DIGESTS.learn(record.inputs)
    known = {state.path: state.role for state in record.inputs if os.path.isfile(state.path)}
    ledger = Ledger.of(job.request)
    read = (
        *_local_states(job, {**{str(path): role for path, role in ledger.roles.items()}, **known}),
        *(state for state in record.inputs if state.role == MISSING and state.untouched()),
        *_far_now(record, job, ledger),
    )
    return read if record.key == key_of(read, job.configuration, job.versions) else None


def as_read(job: Job, report: Mapping[str, Any], far: Sequence[FileState]) -> tuple[FileState, ...]:
    """Return the files that a report was made from, and DEM cells that were missing; a changed file is an error.

    Parameters
    ----------
    far : sequence of FileState
        From `far_states` before the work.
    """
    used = {entry["path"]: entry for entry in report["provenance"]["inputs"]}
    roles = {path: entry["role"] for path, entry in used.items()}
    source = str(report["scene"]["model_source"])
    if os.path.isfile(source):
        roles.setdefault(os.path.abspath(source), _MODEL)
    sought = _sought_of_cells(job, report)
    roles.update((str(path), "DEM") for path in sought if path.name == LIST and path.is_file())
    states = _local_states(job, roles)
    for state in states:
        if state.path in used and used[state.path]["sha256"] != state.sha256:
            raise InputError("this file changed during the run", file=state.path, remedy="run again")
    missing = (FileState.missing(path) for path in sought if str(path) not in roles)
    return (*states, *missing, *far, *_further(job, source, far))


def _far_now(record: RunRecord, job: Job, ledger: Ledger) -> tuple[FileState, ...]:
    """Return size and tag of the recorded inputs on other machines as they are now, in the order of `as_read`."""
    far = far_states(job.request, ledger)
    sources = [state.path for state in record.inputs if state.role == _MODEL]
    return (*far, *(state for source in sources for state in _further(job, source, far)))


def _further(job: Job, source: str, far: Sequence[FileState]) -> list[FileState]:
    """Return the state of far metadata from which the model was read, and which are no side-car for GDAL."""
    address = Location(source).url
    if Location(source).is_far and address.is_address and address not in {state.path for state in far}:
        # A source may be a name with a remark, such as one of a tag.
        with contextlib.suppress(InputError):
            return [far_state(_MODEL, address, allow_network=job.request.scene.allow_network)]
    return []


def _sought_of_cells(job: Job, report: Mapping[str, Any]) -> list[Path]:
    """Return what a folder of DEM cells lacks for a scene, and its list of cells, which then decides what is sea."""
    surface, source = report["provenance"]["surface"] or {}, job.dem_source
    names = (*surface.get("sea_cells", ()), *surface.get("missing_cells", ()))
    if not names or source is None or not os.path.isdir(source):
        return []
    return [Path(source, LIST), *(path for name in names for path in places_of(source, name))]


def as_recorded(record: RunRecord, job: Job) -> bool:
    """Return whether inputs and outputs have the recorded content, ignoring timestamps."""
    with confined(job.output):
        try:
            return record.intact(job.folder) and inputs_as_recorded(record, job) is not None
        except OrthoError:
            return False


def far_states(request: Request, ledger: Ledger | None = None) -> tuple[FileState, ...]:
    """Return size and tag of the inputs and their side-cars in object storage, or on a server.

    Parameters
    ----------
    ledger : Ledger, optional
        That of the request.

    Raises
    ------
    InputError
        If one is not there, or the network is not allowed.
    StorageError
        If the store does not answer.
    """
    addresses, allowed = (ledger or Ledger.of(request)).far, request.scene.allow_network
    return tuple(far_state("far input", address, allow_network=allowed) for address in addresses)


def far_state(role: str, address: str, *, allow_network: bool) -> FileState:
    """Return size and tag of a file in object storage, or on a server; see `far_states`."""
    size, tag = stated_at(address, allow_network=allow_network)
    return FileState(role=role, path=address, bytes=size, mtime_ns=0, sha256="", tag=tag)


def state_of(role: str, path: Path | VsiPath, *, allow_network: bool) -> FileState:
    """Return the state of an input: checksum, or size and tag; of a file in an archive, the state of the archive."""
    place = Location(path)
    if place.is_far:
        return far_state(role, place.url, allow_network=allow_network)
    return FileState.of(role, (place.archive or Path(place)).absolute(), DIGESTS)


def change_in_store(store: Objects, record: RunRecord, checksums: bool = False) -> str:
    """Return how outputs in object storage differ from their record; empty if they do not.

    Parameters
    ----------
    checksums : bool
        Compare the content. Otherwise the store tells size and tag.
    """
    for state in record.outputs:
        try:
            if checksums:
                same = store.read(state.path, state.bytes)[1].sha256 == state.sha256
            else:
                same = store.stated(state.path) == (state.bytes, state.tag)
        except (FileNotFoundError, InputError):
            return f"{state.path} is missing or has grown"
        if not same:
            return f"{state.path} has changed"
    return ""


def folders(job: Job) -> list[str | os.PathLike[str]]:
    """Return the files in whose folders a new name could change the scene."""
    return [path for _, path in job.request.named if os.path.isabs(path) and not Location(path).is_far]


def _local_states(job: Job, roles: Mapping[str, str]) -> tuple[FileState, ...]:
    """Return all files that a scene depends on: files of `roles`, and small companions of the image."""
    known = _with_companions(job, roles)
    return tuple(FileState.of(role, Path(path), DIGESTS) for path, role in sorted(known.items()))


def _with_companions(job: Job, roles: Mapping[str, str]) -> dict[str, str]:
    known, stem = dict(roles), job.image.stem
    for name in listing(job.image.parent).beginning(stem) if isinstance(job.image, Path) else ():
        path, rest = job.image.parent / name, name.removeprefix(stem)
        belongs = rest != name and rest[:1] in ("_", ".", "-") and str(path) not in known
        if belongs and path.is_file() and path.stat().st_size <= _COMPANION_BYTES:
            known[str(path)] = "companion"
    return known


def untouched(record: RunRecord, job: Job, listings: dict[Path, Sequence[str]]) -> bool:
    """Return whether all files of a scene have the recorded size, date and neighbours.

    Of a scene with inputs in a store this is not known here.
    """
    return _files_untouched(record, job, record.inputs) and record.siblings == siblings(folders(job), listings)


def _files_untouched(record: RunRecord, job: Job, recorded: Sequence[FileState]) -> bool:
    return (
        is_scene(record)
        and all(state.untouched() for state in record.inputs)
        and all(state.untouched(job.folder) for state in record.outputs)
        and record.key == key_of(recorded, job.configuration, job.versions)
    )


def reads_the_same(record: RunRecord, job: Job) -> bool:
    """Return whether a scene with changed neighbours would still be made from the same files."""
    try:
        far = tuple(state for state in record.inputs if state.tag)
        near = record.replaced(inputs=tuple(state for state in record.inputs if not state.tag))
        if not _files_untouched(near, job, record.inputs):
            return False
        with confined(job.output):
            ledger = Ledger.of(job.request)
        if far and far != _far_now(record, job, ledger):
            return False
        roles = ledger.roles
    except OrthoError:
        return False
    known = {state.path for state in record.inputs}
    return set(_with_companions(job, {str(path): role for path, role in roles.items()})) <= known
