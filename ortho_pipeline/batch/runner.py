"""Many scenes: each is made once, and again only if an input, a setting or the software has changed.

The work on a scene is `commands.rectify`. A failed scene does not stop the others. After an interruption the next run
continues where it stopped, and its outputs have the same bytes as those of an uninterrupted run.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ortho_pipeline import commands
from ortho_pipeline.batch.executors import Crew, Processes, Sequential, completed, crew_of
from ortho_pipeline.batch.freshness import (
    DIGESTS,
    as_read,
    far_states,
    folders,
    inputs_as_recorded,
    is_scene,
    reads_the_same,
    require_versions,
    untouched,
)
from ortho_pipeline.batch.plan import RUN_FILES, STATE, Job, Plan, for_run, plan
from ortho_pipeline.batch.records import FileState, RunRecord, key_of, locked, require_lock, siblings
from ortho_pipeline.batch.results import BatchResult, Outcome
from ortho_pipeline.batch.shared.run import SharedFolder, run_shared
from ortho_pipeline.batch.summary import paths_of, provenance_of
from ortho_pipeline.commands.mosaic.assembly import assemble
from ortho_pipeline.commands.resolved.ledger import versions
from ortho_pipeline.commands.results import Result
from ortho_pipeline.errors import InputError, OrthoError, ReportError, error_document
from ortho_pipeline.files import allowed, append_line, clear_up, confined, read_json, retire, together, write_json
from ortho_pipeline.files.folders import is_removable
from ortho_pipeline.files.locations import Location
from ortho_pipeline.host.registry import fault_of_plugin
from ortho_pipeline.report.page.run import write_run_page
from ortho_pipeline.report.stac import write_catalog
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.warp.mosaic import Ortho, Overlap, measure_seam

#: The record of the mosaic within the output folder.
MOSAIC_RECORD = Path(STATE, "mosaic", "record.json")
#: The lock of a run within the output folder.
_RUN_LOCK = Path(STATE, "run.lock")
#: A larger file is not a report on a mosaic.
_REPORT_BYTES = 50_000_000
#: Seams from which on they are measured by several processes.
_MANY_SEAMS = 64


# -- one scene -------------------------------------------------------------------------------------------------------


def make_scene(job: Job, checksums: bool = False) -> Outcome:
    """Make a scene unless it exists; called in a worker. Errors of a scene are in the outcome.

    The lock of the scene is held meanwhile: a scene that a scheduler hands out twice is made once.

    Parameters
    ----------
    checksums : bool
        Compare files by checksum, ignoring timestamps.
    """
    begin = time.monotonic()
    try:
        with confined(job.output), locked(job.lock, wait=True):
            return _make_locked(job, checksums, begin)
    except OrthoError as error:
        return Outcome(job.name, "failed", time.monotonic() - begin, error=error_document(error))


def _make_locked(job: Job, checksums: bool, begin: float) -> Outcome:
    clear_up(job.record)
    record = RunRecord.at(job.record)
    # What an earlier run wrote, and this one may not write any more.
    before = record.outputs if record is not None else ()
    try:
        require_versions(job.versions)
        listing = siblings(folders(job))
        # Before the work, so that an object which changes meanwhile is noticed by the next run.
        far = far_states(job.request)
        good = _still_good(record, job, listing, checksums)
        if good is not None:
            # A worker of this run may have made it and died before it reported.
            mine = bool(job.run) and good.run == job.run
            seconds = good.seconds if mine else time.monotonic() - begin
            return Outcome(job.name, "done" if mine else "unchanged", seconds, paths_of(good, job), good.facts)
        _remove_mosaic(job.output, job.name)
        if record is not None:
            RunRecord(name=job.name, key="", status="started", outputs=before).write(job.record)
        result = _rectified(job)
        outputs = tuple(FileState.of(role, path, name=path.name) for role, path in result.files.items())
        _remove(job.folder, {state.path for state in before} - {state.path for state in outputs})
        before = outputs
        if result.failure is not None:
            raise result.failure
        report = result.document["report"]
        read = as_read(job, report, far)
        done = RunRecord(
            name=job.name,
            key=key_of(read, job.configuration, job.versions),
            status="done",
            inputs=read,
            outputs=outputs,
            siblings=listing,
            seconds=time.monotonic() - begin,
            facts=_facts(report),
            run=job.run,
        )
        done.write(job.record)
        return Outcome(job.name, "done", done.seconds, paths_of(done, job), done.facts)
    except Exception as error:
        document = error_document(fault_of_plugin(error) or error)
        failed = RunRecord(
            name=job.name, key="", status="failed", outputs=before, seconds=time.monotonic() - begin, error=document
        )
        with contextlib.suppress(OrthoError):
            failed.write(job.record)
        # Without its report an ortho is there, but not finished: the next run makes the scene again.
        kept = paths_of(failed, job) if isinstance(error, ReportError) else {}
        return Outcome(job.name, "failed", failed.seconds, kept, error=document)


def _rectified(job: Job) -> Result:
    request = job.request
    return commands.rectify(
        request.image,
        job.folder,
        scene=request.scene,
        points=request.points,
        surface=request.surface,
        match=request.match,
        output=request.output,
        name=job.name,
        digest=DIGESTS,
    )


def _still_good(record: RunRecord | None, job: Job, listing: str, checksums: bool) -> RunRecord | None:
    """Return the record with the present dates if inputs, settings and outputs have the content recorded."""
    if record is None or not is_scene(record) or not record.intact(job.folder, checksums):
        return None
    read = inputs_as_recorded(record, job, checksums)
    if read is None:
        return None
    fresh = record.replaced(inputs=read, siblings=listing, outputs=_restated(record.outputs, job.folder))
    if fresh != record:
        fresh.write(job.record)
    return fresh


def _remove_mosaic(output: Path, scene: str | None = None) -> None:
    """Remove the mosaic, or only one that has the ortho of a scene: a VRT would show the new ortho at the old place.

    The next run of all scenes makes it again. The record goes last: a killed process leaves what the next one removes.
    """
    place = output / MOSAIC_RECORD
    record = RunRecord.at(place)
    if record is not None and (scene is None or any(state.role == scene for state in record.inputs)):
        _remove(output, {state.path for state in record.outputs})
        allowed(place).unlink(missing_ok=True)


def _restated(outputs: Sequence[FileState], folder: Path) -> tuple[FileState, ...]:
    """Return outputs of unchanged content with their present dates."""
    return tuple(state.replaced(mtime_ns=(folder / state.path).stat().st_mtime_ns) for state in outputs)


def _remove(folder: Path, names: set[str]) -> None:
    for name in names:
        if is_removable(folder / name):
            (folder / name).unlink(missing_ok=True)


def _facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the facts of a scene for the summary."""
    scene, adjustment = report["scene"], report["adjustment"]
    return {
        "sensor": scene["sensor"],
        "model": adjustment["model"],
        "headline": report["headline"],
        "lean_m_per_m": scene["lean_m_per_m"],
        "rmse_px": {which: rmse and rmse["total"] for which, rmse in adjustment["rmse"].items()},
        "rmse_m": {which: rmse and rmse["total"] for which, rmse in report["rmse_m"].items()},
        "rmse_points": {which: rmse and rmse["n"] for which, rmse in adjustment["rmse"].items()},
        "ortho": {name: report["ortho"][name] for name in ("crs", "resolution", "size", "valid_share")},
        "warnings": list(report["warnings"]),
        "notices": list(report["notices"]),
    }


# -- all scenes ------------------------------------------------------------------------------------------------------


def run(
    config: str | os.PathLike[str] | Plan,
    *,
    executor: str | Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    memory: int = 512_000_000,
    scheduler: str | None = None,
    only: Sequence[str] = (),
    shard: tuple[int, int] | None = None,
    checksums: bool = False,
    progress: Progress | None = None,
    allow_network: bool = False,
    store: SharedFolder | None = None,
) -> BatchResult:
    """Make all scenes of a pipeline file.

    Parameters
    ----------
    executor : {'sequential', 'processes', 'dask'} or concurrent.futures.Executor, optional
        Default: processes, or dask where a scheduler is given. An executor of the caller is not shut down.
    workers, threads, memory : int
        Processes; threads and bytes of each scene. Default: all processors, divided among the workers.
    scheduler : str, optional
        Address of a dask scheduler.
    only, shard : optional
        Names of scenes, or (k, n) for the k-th of n parts. The mosaic is made by a run of all scenes; a part that
        makes one of its scenes again removes it. In a shared `store` a worker that has finished its part goes on with
        what is left of the other parts of `only`.
    checksums : bool
        Take all checksums again.
    allow_network : bool
        Let the scenes be read from URLs, and `surface.dem=auto` fetch cells.
    progress : callable, optional
        Told the outcome of each scene as one line, and the finished share of the scenes.
    store : SharedFolder, optional
        Where the outputs go in place of the folder of the file: a folder of objects, which other workers share.

    Raises
    ------
    InputError
        If the file is wrong, or another run works in the output folder. What is wrong with a scene is its outcome.
    """
    planned = config if isinstance(config, Plan) else plan(config, allow_network=allow_network)
    if store is None and Location(planned.path).is_far:
        raise InputError(
            "a remote pipeline file needs an output in object storage",
            file=planned.path,
            field="output",
            remedy="give an address for the outputs, such as s3://bucket/prefix, or copy the file to this machine",
        )
    jobs, part = planned.chosen(only, shard), bool(only) or shard is not None
    if store is not None:
        _refuse_unshared(planned)
        with crew_of(executor, workers, threads, scheduler, len(jobs)) as (crew, budget):
            ready = for_run(planned.chosen(only), _run_id(), memory, budget, allow_network=allow_network)
            own = [job for job in ready if job.name in {chosen.name for chosen in jobs}]
            return run_shared(replace(planned, jobs=tuple(ready)), own, store, crew, make_scene, progress)
    lock = planned.output / _RUN_LOCK
    with (
        confined(planned.output),
        locked(lock, shared=part, owner=f"'ortho run {planned.path.name}'"),
        crew_of(executor, workers, threads, scheduler, len(jobs)) as (crew, budget),
    ):
        return _Run(planned, part, checksums, progress).make(
            crew, for_run(jobs, _run_id(), memory, budget, allow_network=allow_network)
        )


def _refuse_unshared(planned: Plan) -> None:
    if planned.mosaic is not None:
        raise InputError(
            "workers that share object storage cannot make a mosaic",
            file=planned.path,
            field="mosaic",
            remedy="remove it from the file, and run `ortho mosaic` on the orthos afterwards",
        )


def _run_id() -> str:
    return f"{datetime.now(UTC).isoformat(timespec='microseconds')} {os.getpid()}"


def list_scenes(config: str | os.PathLike[str] | Plan) -> list[dict[str, Any]]:
    """Return name, image and state (new, started, done, changed, failed) of each scene, without making any."""
    planned = config if isinstance(config, Plan) else plan(config)
    listings: dict[Path, Sequence[str]] = {}
    listed = []
    for job in planned.jobs:
        record = RunRecord.at(job.record)
        state = "new" if record is None else record.status
        if state == "done" and record is not None and not untouched(record, job, listings):
            state = "done" if reads_the_same(record, job) else "changed"
        listed.append({"name": job.name, "image": str(job.image), "state": state})
    return listed


class _Run:
    """One call of `run`: the log, the count, the end."""

    def __init__(self, planned: Plan, part: bool, checksums: bool, progress: Progress | None) -> None:
        self.planned, self.part, self.checksums, self.progress = planned, part, checksums, progress
        self.begin = time.monotonic()
        self.log_path = planned.output / RUN_FILES["log"]
        self.outcomes: dict[str, Outcome] = {}

    def make(self, crew: Crew, jobs: Sequence[Job]) -> BatchResult:
        self.log("run started", scenes=len(jobs), file=str(self.planned.path), versions=versions())
        try:
            changed = list(self._without_unchanged(jobs))
            work = functools.partial(_make_in_run, checksums=self.checksums)
            for job, future in completed(crew, work, changed):
                self._note(_outcome(job, future), len(jobs))
            mosaic = None if self.part else self._mosaic(crew, jobs)
        except KeyboardInterrupt:
            self.log("run interrupted", finished=len(self.outcomes), scenes=len(jobs))
            raise
        return self._finish(jobs, mosaic)

    def _mosaic(self, crew: Crew, jobs: Sequence[Job]) -> dict[str, Any] | None:
        """Make the mosaic of the finished scenes; its document has the error, if any. Remove one no longer wanted."""
        with contextlib.suppress(OrthoError):
            clear_up(self.planned.output / MOSAIC_RECORD)
        if self.planned.mosaic is None:
            _remove_mosaic(self.planned.output)
            return None
        present = [job for job in jobs if self.outcomes[job.name].status != "failed"]
        try:
            document = _Mosaic(self.planned, present, self.outcomes).make(crew, self.checksums)
        except OrthoError as error:
            document = {"error": error_document(error)}
        missing = [job.name for job in jobs if job not in present]
        self.log("mosaic", **{name: value for name, value in document.items() if name != "seams"}, missing=missing)
        return {**document, "missing": missing}

    def _without_unchanged(self, jobs: Sequence[Job]) -> Iterator[Job]:
        """Yield the jobs that dates and sizes alone do not show to be done."""
        # A run that was killed just after it wrote a record leaves the lock of that.
        left = any(name.endswith(".part") for name in os.listdir(self.planned.output / STATE))
        listings: dict[Path, Sequence[str]] = {}
        for job in jobs:
            record = None if self.checksums else RunRecord.at(job.record)
            if record is not None and untouched(record, job, listings):
                if left:
                    with contextlib.suppress(OrthoError):
                        clear_up(job.record)
                self._note(Outcome(job.name, "unchanged", files=paths_of(record, job), facts=record.facts), len(jobs))
            else:
                yield job

    def _note(self, outcome: Outcome, total: int) -> None:
        self.outcomes[outcome.name] = outcome
        self.log("scene", **vars(outcome))
        if self.progress:
            self.progress(outcome.text(), len(self.outcomes) / total)

    def _finish(self, jobs: Sequence[Job], mosaic: dict[str, Any] | None) -> BatchResult:
        ordered = tuple(self.outcomes[job.name] for job in jobs)
        files = {"log": self.log_path}
        items = [Path(outcome.files["stac"]) for outcome in ordered if "stac" in outcome.files]
        if not self.part:
            files |= self._catalog(items)
            files |= {kind: self.planned.output / RUN_FILES[kind] for kind in ("summary", "index")}
        if mosaic is not None and "file" in mosaic:
            files |= {
                "mosaic": self.planned.output / mosaic["file"],
                "seams": self.planned.output / RUN_FILES["seams"],
                "mosaic page": self.planned.output / RUN_FILES["page"],
            }
        result = BatchResult(ordered, files, time.monotonic() - self.begin, mosaic)
        if not self.part:
            write_json(files["summary"], result.to_json())
            scenes, name = result.to_json()["scenes"], self.planned.path.stem
            write_run_page(files["index"], name, scenes, provenance_of(self.planned))
        self.log("run finished", counts=result.to_json()["counts"], seconds=result.seconds)
        return result

    def _catalog(self, items: Sequence[Path]) -> dict[str, Path]:
        """Write the catalog of the items, or remove that of the last run, whose items are no longer there."""
        path = self.planned.output / RUN_FILES["catalog"]
        if items:
            write_catalog(path, items, self.planned.path.stem)
            return {"catalog": path}
        with contextlib.suppress(InputError):
            before = read_json(self.planned.output / RUN_FILES["summary"], _REPORT_BYTES, "run again")
            if isinstance(before, dict) and "catalog" in (before.get("files") or ()):
                allowed(path).unlink(missing_ok=True)
        return {}

    def log(self, event: str, **fields: Any) -> None:
        """Append a line to the log; several runs of parts may do so at once."""
        line = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **fields}
        append_line(self.log_path, json.dumps(line, allow_nan=False, default=str))


def _path_of(name: str | None) -> Path | None:
    return None if name is None else Path(name)


class _Mosaic:
    """The mosaic of a run, made again only when an ortho or the settings have changed."""

    def __init__(self, planned: Plan, jobs: Sequence[Job], outcomes: Mapping[str, Outcome]) -> None:
        assert planned.mosaic is not None
        self.output, self.settings = planned.output, planned.mosaic
        self.path = planned.output / f"mosaic.{'vrt' if self.settings.format == 'VRT' else 'tif'}"
        self.report, self.page = planned.output / RUN_FILES["seams"], planned.output / RUN_FILES["page"]
        self.record = planned.output / MOSAIC_RECORD
        self.orthos = [
            Ortho(
                job.name,
                Path(outcomes[job.name].files["ortho"]),
                outcomes[job.name].facts["lean_m_per_m"],
                _path_of(outcomes[job.name].files.get("accuracy")),
                job.request.output.resampling,
            )
            for job in jobs
        ]
        # What the records know of the orthos need not be taken again.
        known = [RunRecord.at(job.record) for job in jobs]
        self.inputs = tuple(
            state.replaced(role=job.name, path=str(job.folder / state.path))
            for job, record in zip(jobs, known, strict=True)
            for state in (record.outputs if record else ())
            if state.role in ("ortho", "accuracy")
        )
        order = {ortho.name: ortho.relief_displacement for ortho in self.orthos}
        self.key = key_of(self.inputs, {**asdict(self.settings), "order": list(order.items())}, versions())

    def make(self, crew: Crew, checksums: bool = False) -> dict[str, Any]:
        record = RunRecord.at(self.record)
        if record is not None and record.key == self.key and record.intact(self.output, checksums):
            # A record may be wrong: its files are read like any other, and made again if they are not reports.
            with contextlib.suppress(InputError):
                document = read_json(self.report, _REPORT_BYTES, "run again")
                if isinstance(document, dict):
                    return {**document, "status": "unchanged"}
        files = {"mosaic": self.path, "seams": self.report, "page": self.page}
        # Whoever makes one of these scenes again removes also the mosaic of a run that was killed before it ended.
        before, made_from = ((), ()) if record is None else (record.outputs, record.inputs)
        planned = [FileState(role=role, path=path.name, bytes=0, mtime_ns=0, sha256="") for role, path in files.items()]
        started = RunRecord(
            name="mosaic",
            key="",
            status="started",
            inputs=tuple({state.path: state for state in (*made_from, *self.inputs)}.values()),
            outputs=tuple({state.path: state for state in (*before, *planned)}.values()),
        )
        started.write(self.record)
        with together(self.output, "mosaic"):
            document, failure = assemble(
                self.orthos, files, self.settings, measure=lambda pairs: self._seams(pairs, crew)
            )
            write_json(self.report, document)
            retire({self.output / state.path for state in before} - set(files.values()))
        if failure is not None:
            return {**document, "status": "done", "error": error_document(failure)}
        outputs = tuple(FileState.of(role, path, name=path.name) for role, path in files.items())
        RunRecord(name="mosaic", key=self.key, status="done", inputs=self.inputs, outputs=outputs).write(self.record)
        return {**document, "status": "done"}

    def _seams(self, pairs: Sequence[Overlap], crew: Crew) -> list[dict[str, Any]]:
        # New processes for a few seams take longer than these.
        crew = Sequential() if isinstance(crew, Processes) and len(pairs) < _MANY_SEAMS else crew
        overlaps = {id(pair): future.result() for pair, future in completed(crew, measure_seam, pairs)}
        return [overlaps[id(pair)] for pair in pairs]


def _make_in_run(job: Job, checksums: bool) -> Outcome:
    require_lock(job.output / _RUN_LOCK)
    if checksums:
        # A process of the caller, or of a cluster, may know checksums of earlier runs.
        DIGESTS.renew(job.run)
    return make_scene(job, checksums)


def _outcome(job: Job, future: Future[Outcome]) -> Outcome:
    error = future.exception()
    return future.result() if error is None else Outcome(job.name, "failed", error=error_document(error))
