"""A run whose outputs go to a folder of objects, by any number of workers at once.

Each worker makes the scenes of its part, then those that nobody has begun, then those whose worker has died. A scene is
made in a folder of this machine and uploaded, its result last (see `leases`, `files.storage.delivery`).
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
from ortho_pipeline.batch.plan import STATE, Job, Plan
from ortho_pipeline.batch.records import key_of
from ortho_pipeline.batch.results import BatchResult, Outcome
from ortho_pipeline.batch.shared.leases import PATIENCE, Lease, Leases, Lost
from ortho_pipeline.errors import OrthoError, error_document
from ortho_pipeline.files import json_text
from ortho_pipeline.files.process_limits import Progress
from ortho_pipeline.files.storage.delivery import delivered
from ortho_pipeline.files.storage.objects import Objects

_SUMMARY = "run.json"
#: Seconds between two looks at what the others do.
_LONGEST_NAP = 5.0
Make = Callable[[Job], Outcome]


@dataclasses.dataclass(frozen=True)
class SharedFolder:
    """Where the outputs of a run go, and how long a worker may be silent."""

    address: str
    allow_network: bool
    patience: float = PATIENCE

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
        if there is not None and there.get("key") == key_of_shared(order.job) and there.get("status") != "failed":
            return outcome_of(name, there)
        with lease.held(where.patience):
            return _made(where, make, order.job, lease)
    except Lost:
        return Outcome(name, "busy", facts={"lease": ""})
    except OrthoError as error:
        return Outcome(name, "failed", time.monotonic() - begin, error=error_document(error))


def _made(where: SharedFolder, make: Make, job: Job, lease: Lease) -> Outcome:
    address = f"{where.address.rstrip('/')}/{job.name}"
    with tempfile.TemporaryDirectory(prefix="ortho_run_") as scratch:
        outcome = make(dataclasses.replace(job, output=Path(scratch)))
        if outcome.files:
            lease.renew()
            with delivered(address, job.name, allow_network=where.allow_network, keep=_goes_along) as folder:
                for path in (Path(scratch) / job.name).iterdir():
                    path.replace(folder / path.name)
            files = {role: f"{address}/{Path(path).name}" for role, path in outcome.files.items()}
            outcome = dataclasses.replace(outcome, files=files)
    lease.finish({**vars(outcome), "key": key_of_shared(job)})
    return outcome


def _goes_along(path: Path) -> bool:
    return path.suffix != ".vrt"


def key_of_shared(job: Job) -> str:
    """Return the digest of what a scene is asked to be: settings, software, and the size of the image."""
    size = job.image.stat().st_size if isinstance(job.image, Path) and job.image.is_file() else 0
    return key_of((), {"image_bytes": size, **job.configuration}, job.versions)


def outcome_of(name: str, result: Mapping[str, Any]) -> Outcome:
    """Return the outcome that a result tells: what another worker, or an earlier run, has made is unchanged."""
    status = "failed" if result.get("status") == "failed" else "unchanged"
    given = {field: result.get(field) or {} for field in ("files", "facts")}
    return Outcome(name, status, float(result.get("seconds") or 0.0), **given, error=result.get("error"))


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
        _again(leases, job)
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
        left = [job for job in planned.jobs if job.name not in finished and job.name not in outcomes]
        if not left:
            break
        now = time.monotonic()
        dead = {
            name: lease for name, (lease, since) in watched.items() if lease and now - since > where.patience
        }  # fmt: skip
        go(Order(job, dead.get(job.name)) for job in left)
        if any(job.name not in outcomes for job in left):
            time.sleep(min(where.patience / 4, _LONGEST_NAP))
    return BatchResult(tuple(_collected(leases, planned, outcomes)), {}, time.monotonic() - begin)


def _again(leases: Leases, job: Job) -> None:
    """Let a scene of one's own part be made again that failed, or was asked for otherwise, in an earlier run."""
    there = leases.result(job.name)
    if there is not None and (there.get("status") == "failed" or there.get("key") != key_of_shared(job)):
        leases.forget(job.name)


def _collected(leases: Leases, planned: Plan, outcomes: Mapping[str, Outcome]) -> Iterable[Outcome]:
    for job in planned.jobs:
        if job.name in outcomes:
            yield outcomes[job.name]
            continue
        there = leases.result(job.name)
        yield Outcome(job.name, "missing") if there is None else outcome_of(job.name, there)


def summary_of(planned: Plan, where: SharedFolder) -> BatchResult:
    """Collect the results of all workers, and write them beside the scenes as ``run.json``; make nothing."""
    begin = time.monotonic()
    found = tuple(_collected(where.leases(), planned, {}))
    store = Objects(where.address, allow_network=where.allow_network)
    files: dict[str, Any] = {"summary": store.of(_SUMMARY)}
    result = BatchResult(found, files, time.monotonic() - begin)
    store.put(_SUMMARY, json_text(result.to_json()).encode())
    return result
