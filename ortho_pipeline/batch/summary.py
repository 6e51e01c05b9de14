"""The summary of all parts of a run."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ortho_pipeline.batch.freshness import as_recorded, untouched
from ortho_pipeline.batch.plan import RUN_FILES, Job, Plan, plan
from ortho_pipeline.batch.records import RunRecord
from ortho_pipeline.batch.results import BatchResult, Outcome
from ortho_pipeline.batch.shared.run import SharedFolder, summary_of
from ortho_pipeline.commands.resolved.ledger import software
from ortho_pipeline.errors import InputError, error_document
from ortho_pipeline.files import write_json
from ortho_pipeline.report.page.run import write_run_page


def summarise(config: str | os.PathLike[str] | Plan, store: SharedFolder | None = None) -> BatchResult:
    """Collect the results of all parts, and write the summary; make no scenes.

    An unfinished scene has the status ``missing``.
    """
    planned = config if isinstance(config, Plan) else plan(config)
    if store is not None:
        return summary_of(planned, store)
    begin, outcomes = time.monotonic(), []
    listings: dict[Path, Sequence[str]] = {}
    for job in planned.jobs:
        record = RunRecord.at(job.record)
        if record is None or record.status not in ("done", "failed"):
            outcomes.append(Outcome(job.name, "missing"))
        elif record.status == "failed":
            outcomes.append(Outcome(job.name, "failed", record.seconds, error=record.error))
        elif not untouched(record, job, listings) and not as_recorded(record, job):
            error = InputError("inputs or outputs have changed", file=job.folder, remedy="run it again")
            outcomes.append(Outcome(job.name, "missing", error=error_document(error)))
        else:
            outcomes.append(Outcome(job.name, "done", record.seconds, paths_of(record, job), record.facts))
    files = {kind: planned.output / RUN_FILES[kind] for kind in ("summary", "index")}
    result = BatchResult(tuple(outcomes), files, time.monotonic() - begin)
    write_json(files["summary"], result.to_json())
    write_run_page(files["index"], planned.path.stem, result.to_json()["scenes"], provenance_of(planned))
    return result


def provenance_of(planned: Plan) -> dict[str, Any]:
    """Return the pipeline file that was planned, with its SHA-256, and the versions; scenes have their own.

    The command is no part of it: runs with other executors or workers write the same page.
    """
    return {"software": software(), "inputs": [dict(planned.source)]}


def paths_of(record: RunRecord, job: Job) -> dict[str, str]:
    """Return the outputs of a scene by role."""
    return {state.role: str(job.folder / state.path) for state in record.outputs}
