"""A run whose outputs go to a folder of objects, by any number of workers at once.

Each worker makes the scenes of its part, then those that nobody has begun, then those whose worker has died. A scene is
made in a folder of this machine and uploaded, its result last (see `leases`, `stores.delivery`).
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from ortho_pipeline.batch.executors import Crew, completed
from ortho_pipeline.batch.freshness import change_in_store, inputs_as_recorded, is_scene
from ortho_pipeline.batch.plan import STATE, Job, Plan
from ortho_pipeline.batch.records import RunRecord
from ortho_pipeline.batch.results import BatchResult, Outcome
from ortho_pipeline.batch.shared.leases import PATIENCE, Lease, Leases, Lost
from ortho_pipeline.errors import InputError, OrthoError, error_document
from ortho_pipeline.files import json_text
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.stores.delivery import delivered
from ortho_pipeline.stores.objects import Objects

_SUMMARY = "run.json"
#: Seconds between two checks of the other workers.
_LONGEST_NAP = 5.0
Make = Callable[[Job], Outcome]


@dataclasses.dataclass(frozen=True)
class SharedFolder:
    """Where the outputs of a run go, how long a worker may be silent, and whether contents are compared."""

    address: str
    allow_network: bool
    patience: float = PATIENCE
    checksums: bool = False

    def address_of(self, name: str) -> str:
        """Return the address of a scene's folder."""
        return f"{self.address.rstrip('/')}/{name}"

    def leases(self) -> Leases:
        """Open the leases."""
        return Leases(f"{self.address.rstrip('/')}/{STATE}", allow_network=self.allow_network)


@dataclasses.dataclass(frozen=True)
class Order:
    """A scene that a worker is to make, if nobody else does; `seen` is the lease that it may take over."""

    job: Job
    seen: str | None = None


def make_shared(where: SharedFolder, make: Make, order: Order) -> Outcome:
    """Make a scene of a shared run; called in a process, and never raises for what is wrong with a scene.

    Returns
    -------
    Outcome
        Of the status ``busy`` while another worker has it, with the version of its lease as facts.
    """
    begin = time.monotonic()
    name = order.job.name
    try:
        leases = where.leases()
        lease = leases.take(name, order.seen)
        if isinstance(lease, str):
            return Outcome(name, "busy", facts={"lease": lease})
        there = leases.result(name)
        if there is not None and there.status == "done" and not why_stale(where, order.job, there):
            return outcome_of(where, there)
        with lease.held(where.patience):
            return _made(where, make, order.job, lease)
    except Lost:
        return Outcome(name, "busy", facts={"lease": ""})
    except OrthoError as error:
        return Outcome(name, "failed", time.monotonic() - begin, error=error_document(error))


def _made(where: SharedFolder, make: Make, job: Job, lease: Lease) -> Outcome:
    address = where.address_of(job.name)
    with tempfile.TemporaryDirectory(prefix="ortho_run_") as scratch:
        local = dataclasses.replace(job, output=Path(scratch))
        outcome = make(local)
        record = RunRecord.at(local.record)
        if record is None:
            record = RunRecord(name=job.name, key="", status="failed", seconds=outcome.seconds, error=outcome.error)
        if outcome.status != "failed":
            lease.renew()
            with delivered(address, job.name, allow_network=where.allow_network, keep=_goes_along) as delivery:
                for path in local.folder.iterdir():
                    path.replace(delivery.folder / path.name)
            stored = delivery.stored
            outputs = tuple(
                state.replaced(mtime_ns=0, tag=stored[state.path].tag)
                for state in record.outputs
                if state.path in stored
            )
            record = record.replaced(outputs=outputs)
            outcome = dataclasses.replace(outcome, files=_files(where, record))
    lease.finish(record)
    return outcome


def _goes_along(path: Path) -> bool:
    return path.suffix != ".vrt"


def _files(where: SharedFolder, record: RunRecord) -> dict[str, str]:
    return {state.role: f"{where.address_of(record.name)}/{state.path}" for state in record.outputs}


def why_stale(where: SharedFolder, job: Job, record: RunRecord) -> str:
    """Return how a scene differs from its record; empty if it does not.

    Outputs are asked of the store: size and tag, or with `where.checksums` the content.
    """
    if not is_scene(record):
        return "its record is incomplete"
    store = Objects(where.address_of(job.name), allow_network=where.allow_network)
    changed = change_in_store(store, record, where.checksums)
    if changed:
        return changed
    if inputs_as_recorded(record, job, where.checksums) is None:
        return "its inputs, settings or software have changed"
    return ""


def outcome_of(where: SharedFolder, record: RunRecord) -> Outcome:
    """Return the outcome of a record; a scene of another worker or an earlier run is unchanged."""
    status = "failed" if record.status == "failed" else "unchanged"
    return Outcome(record.name, status, record.seconds, _files(where, record), record.facts, record.error)


def run_shared(
    planned: Plan,
    own: Sequence[Job],
    where: SharedFolder,
    crew: Crew,
    make: Make,
    progress: Progress | None = None,
) -> BatchResult:
    """Make the scenes of a plan together with other workers, beginning with one's own; end when all have a result.

    Raises
    ------
    InputError, StorageError
        If the folder of objects cannot be used.
    """
    begin = time.monotonic()
    leases, work = where.leases(), functools.partial(make_shared, where, make)
    outcomes: dict[str, Outcome] = {}
    for job in own:
        there = leases.result(job.name)
        if there is None or there.status == "failed" or _unfit(where, leases, job):
            leases.forget(job.name)
    looked: set[str] = set()
    watched: dict[str, tuple[str, float]] = {}

    def go(orders: Iterable[Order]) -> None:
        pairs: Iterable[tuple[Any, Future[Outcome]]] = completed(crew, work, list(orders))
        for order, future in pairs:
            outcome = future.result()
            if outcome.status == "busy":
                lease = outcome.facts["lease"]
                if watched.get(order.job.name, ("", 0.0))[0] != lease:
                    watched[order.job.name] = (lease, time.monotonic())
                continue
            outcomes[order.job.name] = outcome
            if progress:
                progress(outcome.text(), len(outcomes) / len(planned.jobs))

    go(Order(job) for job in own)
    while True:
        finished = leases.finished()
        for job in planned.jobs:
            # What others were to make, and an earlier run made otherwise.
            if job.name in finished - outcomes.keys() - looked:
                looked.add(job.name)
                if _unfit(where, leases, job):
                    leases.forget(job.name)
                    finished -= {job.name}
        left = [job for job in planned.jobs if job.name not in finished and job.name not in outcomes]
        if not left:
            break
        now = time.monotonic()
        dead = {name: lease for name, (lease, since) in watched.items() if lease and now - since > where.patience}
        go(Order(job, dead.get(job.name)) for job in left)
        if any(job.name not in outcomes for job in left):
            time.sleep(min(where.patience / 4, _LONGEST_NAP))
    return BatchResult(tuple(_collected(where, leases, planned, outcomes)), {}, time.monotonic() - begin)


def _unfit(where: SharedFolder, leases: Leases, job: Job) -> bool:
    """Return whether a result is invalid, or belongs to another version of the scene."""
    there = leases.result(job.name)
    if there is None or there.status not in ("done", "failed"):
        return True
    return there.status == "done" and bool(why_stale(where, job, there))


def _collected(
    where: SharedFolder, leases: Leases, planned: Plan, outcomes: Mapping[str, Outcome]
) -> Iterable[Outcome]:
    for job in planned.jobs:
        if job.name in outcomes:
            yield outcomes[job.name]
            continue
        there = leases.result(job.name)
        unfinished = there is None or there.status not in ("done", "failed")
        why = "no worker has finished it" if unfinished else ""
        if there is not None and there.status == "done":
            why = why_stale(where, job, there)
        if there is None or why:
            error = error_document(InputError(why, file=where.address_of(job.name), remedy="run it again"))
            yield Outcome(job.name, "missing", error=error)
        else:
            yield outcome_of(where, there)


def summary_of(planned: Plan, where: SharedFolder) -> BatchResult:
    """Collect the results of all workers, and write them next to the scenes as ``run.json``; make nothing."""
    begin = time.monotonic()
    outcomes = tuple(_collected(where, where.leases(), planned, {}))
    store = Objects(where.address, allow_network=where.allow_network)
    files: dict[str, Any] = {"summary": store.of(_SUMMARY)}
    result = BatchResult(outcomes, files, time.monotonic() - begin)
    store.put(_SUMMARY, json_text(result.to_json()).encode())
    return result
