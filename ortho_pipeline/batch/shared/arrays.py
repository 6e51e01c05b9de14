"""The part of a run for a worker of a job array, from its environment."""

from __future__ import annotations

import os
from collections.abc import Mapping

from ortho_pipeline.errors import InputError

#: Environment variable: number of workers, if the array does not give it.
COUNT = "ORTHO_SHARDS"
_AWS, _KUBERNETES, _SLURM = "AWS_BATCH_JOB_ARRAY_INDEX", "JOB_COMPLETION_INDEX", "SLURM_ARRAY_TASK_ID"
_MOST = 1_000_000


def part_of_array(environment: Mapping[str, str] = os.environ) -> tuple[int, int]:
    """Return (k, n), the k-th of n parts, for a worker of AWS Batch, a Kubernetes indexed job or a Slurm array.

    Raises
    ------
    InputError
        If the environment has none or several of these, or not the number of workers.
    """
    kinds = [name for name in (_AWS, _KUBERNETES, _SLURM) if name in environment]
    if len(kinds) != 1:
        what = "no job array" if not kinds else f"several job arrays ({', '.join(kinds)})"
        raise InputError(
            f"the environment describes {what}",
            field="shard",
            remedy=f"give the part, such as 1/4, or set one of {_AWS}, {_KUBERNETES}, {_SLURM}",
        )
    kind = kinds[0]
    index, first, step = _number(environment, kind, 0), 0, 1
    count: int | None = None
    if kind == _SLURM:
        first = _number(environment, "SLURM_ARRAY_TASK_MIN", 0) if "SLURM_ARRAY_TASK_MIN" in environment else 0
        step = _number(environment, "SLURM_ARRAY_TASK_STEP", 1) if "SLURM_ARRAY_TASK_STEP" in environment else 1
        count = _number(environment, "SLURM_ARRAY_TASK_COUNT", 1) if "SLURM_ARRAY_TASK_COUNT" in environment else None
    elif kind == _AWS and "AWS_BATCH_JOB_ARRAY_SIZE" in environment:
        count = _number(environment, "AWS_BATCH_JOB_ARRAY_SIZE", 1)
    if COUNT in environment:
        count = _number(environment, COUNT, 1)
    if count is None:
        raise InputError(
            f"{kind} gives the number of this worker, but not how many there are",
            field="shard",
            remedy=f"set the environment variable {COUNT} to the number of workers",
        )
    part, rest = divmod(index - first, step)
    if rest or not 0 <= part < count:
        raise InputError(
            f"{kind} is {index}, which does not fit {count} workers",
            field="shard",
            remedy=f"correct {COUNT} or the array",
        )
    return part + 1, count


def _number(environment: Mapping[str, str], name: str, least: int) -> int:
    text = environment[name].strip()
    if not (text.isascii() and text.isdigit() and len(text) < 10 and least <= int(text) <= _MOST):
        raise InputError(f"{name} is {text[:40]!r}, which is not a valid number", field="shard", remedy="correct it")
    return int(text)
