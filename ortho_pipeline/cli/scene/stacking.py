"""The command `ortho stack`: finished orthos of many dates."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click

from ortho_pipeline.cli.machine.browser import open_option
from ortho_pipeline.cli.options import click_options, folder_option, grouped_options, json_option
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result, progress
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.options.option import RESAMPLING


@click.command(cls=Command)
@click.argument("orthos", metavar="ORTHO|FOLDER|LIST.csv...", nargs=-1, required=True, type=click.Path())
@click.option(
    "--datum",
    default="mean",
    show_default=True,
    metavar="mean|DATE|reference",
    help="What keeps its place: the mean of all dates, one date, or the reference (--reference).",
)
@click.option(
    "--date-pattern",
    metavar="PATTERN",
    help="Place of the date in the file names, such as %Y%m%d.  [default: metadata]",
)
@click_options("match", MatchOptions, "reference", "search", "points")
@click.option(
    "--neighbours",
    type=click.IntRange(1, 50),
    default=3,
    show_default=True,
    metavar="N",
    help="Earlier dates with which each date is matched, besides the same season of earlier years.",
)
@click.option("--shift-only", is_flag=True, help="Correct each date by a shift only.")
@click.option(
    "--corrections-only", is_flag=True, help="Keep the pixels: write VRTs with a corrected map grid, and models."
)
@click.option("--rebuild", is_flag=True, help="Match all pairs again and write all orthos again.")
@click.option("--resampling", "-r", type=click.Choice(RESAMPLING), default="cubic", show_default=True)
@folder_option
@open_option
@click_options("output", OutputOptions, "nodata", "creation_options", "memory", "threads")
@click_options("scene", SceneOptions, "roots")
@json_option
def stack(
    orthos: tuple[str, ...],
    datum: str,
    date_pattern: str | None,
    neighbours: int,
    shift_only: bool,
    resampling: str,
    folder: str,
    as_json: bool,
    **grouped: Any,
) -> None:
    """Make finished ORTHOs of many dates agree with each other.

    Each date is matched with earlier dates and with the same season of earlier years. One network of all pairs gives
    the smallest correction of each date that the matches justify. Wrong pairs and moving ground are found and left out.
    A second run matches only new pairs. Dates come from a list with the columns file and date, file names, STAC items,
    reports or metadata.
    """
    from ortho_pipeline.batch.stack import command

    only = {name: grouped.pop(name) for name in ("corrections_only", "rebuild")}
    groups = grouped_options(grouped, "match", "scene", "output")
    groups["output"] = replace(groups["output"], resampling=resampling)
    with progress() as shown:
        result = command.stack(
            orthos, folder, datum=datum, date_pattern=date_pattern, neighbours=neighbours, affine=not shift_only,
            progress=shown, **only, **groups,
        )  # fmt: skip
    print_result(result, as_json)
