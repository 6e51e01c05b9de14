"""A run without pixels: opens all inputs and reports their errors and warnings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from ortho_pipeline import commands
from ortho_pipeline.batch.plan import Plan, plan
from ortho_pipeline.errors import OrthoError, error_document


def check_scenes(
    config: str | os.PathLike[str] | Plan, only: Sequence[str], shard: tuple[int, int] | None
) -> list[dict[str, Any]]:
    """Open all inputs of every scene (images, points, DEM) and check the coverage; read no pixels.

    Returns
    -------
    list of dict
        Name and image, and the result of `commands.check` or ``error``.
    """
    planned = config if isinstance(config, Plan) else plan(config)
    checked: list[dict[str, Any]] = []
    for job in planned.chosen(only, shard):
        request = job.request
        row: dict[str, Any] = {"name": job.name, "image": str(job.image)}
        try:
            row |= commands.check(
                request.image,
                scene=request.scene,
                points=request.points,
                surface=request.surface,
                match=request.match,
                output=request.output,
            )
        except OrthoError as error:
            row["error"] = error_document(error)
        checked.append(row)
    return checked
