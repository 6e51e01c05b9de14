"""The command `ortho stack`: finished orthos and raw scenes of many dates."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from ortho_pipeline.cli.machine.browser import open_option
from ortho_pipeline.cli.options import (
    click_options,
    executor_option,
    folder_option,
    grouped_options,
    json_option,
    scheduler_option,
    shard_option,
    stack_options,
    workers_option,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result, progress
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions, StackOptions, SurfaceOptions
from ortho_pipeline.options.option import RESAMPLING

if TYPE_CHECKING:
    from ortho_pipeline.commands.results import Result


@click.command(cls=Command)
@click.argument("orthos", metavar="IMAGE|FOLDER|LIST.csv...", nargs=-1, required=True, type=click.Path())
@stack_options
@click_options("match", MatchOptions, "reference", "search", "points")
@click_options("surface", SurfaceOptions, "dem", "vertical", "override_vertical", "fill", "height", "source")
@click.option(
    "--resampling", "-r", type=click.Choice(RESAMPLING), default="cubic", show_default=True, help="Resampling method."
)
@folder_option
@open_option
@click_options("output", OutputOptions, "stac", "nodata", "creation_options", "memory", "threads")
@click_options("scene", SceneOptions, "allow_network", "roots")
@executor_option(
    "How the work is distributed.  [default: this process; processes with --workers; dask with --scheduler]"
)
@workers_option("no further process")
@scheduler_option
@shard_option("Match only the K-th of N parts of the pairs.")
@json_option
def stack(
    orthos: tuple[str, ...],
    stack: StackOptions,
    resampling: str,
    folder: str,
    shard: tuple[int, int] | str | None,
    as_json: bool,
    **grouped: Any,
) -> None:
    """Make finished orthos and raw scenes of many dates agree with each other.

    Each date is matched with earlier dates and with the same season of earlier years. One network of all pairs gives
    the smallest correction of each date that the matches justify: a shift or an affine transformation, never a smooth
    field as in align. Wrong pairs and moving ground are found and left out.
    Raw scenes need heights; their pixels are resampled once, with the corrected model. A second run matches only new
    pairs. Dates come from a CSV list (columns file and date), from file names, STAC items, reports or metadata.
    """
    from ortho_pipeline.batch.shared.arrays import part_of_array
    from ortho_pipeline.batch.stack import command

    groups = grouped_options(grouped, "match", "surface", "scene", "output")
    groups["output"] = replace(groups["output"], resampling=resampling)
    part = part_of_array() if isinstance(shard, str) else shard
    groups |= {name: grouped[name] for name in ("executor", "workers", "scheduler")}
    with progress() as shown:
        if part is None:
            result: Result = command.stack(orthos, folder, stack, progress=shown, **groups)
        else:
            result = command.match_part(orthos, folder, part, stack, progress=shown, **groups)
    print_result(result, as_json)
