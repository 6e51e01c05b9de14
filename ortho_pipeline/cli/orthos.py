"""The commands `ortho verify` and `ortho align`: finished orthos against references."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import click

from ortho_pipeline.cli.options import (
    click_options,
    folder_option,
    json_option,
    matching_options,
    surface_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result, print_warnings
from ortho_pipeline.options import GROUPS, MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.options.option import RESAMPLING

#: Exit code of `ortho verify` where an ortho does not meet what --require asks.
NOT_MET = 4

_mask_option = click.option(
    "--mask",
    "masks",
    multiple=True,
    metavar="FILE[=VALUES]",
    help="A raster of classes that hide the ground, such as scl.tif=3,8-10; all but 0 without values; may be repeated.",
)
_band_option = click.option(
    "--compare-band",
    "band",
    type=click.IntRange(min=1),
    metavar="N",
    help="The band of the ortho to compare  [default: those with the most content]",
)


@click.command(cls=Command)
@click.argument("ortho", metavar="ORTHO|FOLDER", type=click.Path())
@matching_options
@click_options("points", PointOptions, "gcps", "crs", "vertical", "pixel_origin")
@surface_options
@_mask_option
@_band_option
@click.option(
    "--require",
    multiple=True,
    metavar="'ce90<M'",
    help="A limit of bias, rmse or ce90, in m or px; exit code 4 if not met; may be repeated.",
)
@click.option(
    "--output",
    "-o",
    "folder",
    type=click.Path(file_okay=False),
    metavar="DIR",
    help="For the report page, its numbers and the displacements.",
)
@click_options("scene", SceneOptions, "allow_network", "roots")
@click_options("output", OutputOptions, "memory", "threads")
@json_option
def verify(
    ortho: str,
    match: MatchOptions,
    surface: SurfaceOptions,
    masks: tuple[str, ...],
    band: int | None,
    require: tuple[str, ...],
    folder: str | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Say how accurate a finished ORTHO is.

    Bias, RMSE and CE90 with 95 % intervals, relative to an orthoimage of the place (--reference) and on the ground
    (--gcps). Also: a map of displacements, dependence on height, column and row, band against band, and the likely
    cause. A FOLDER gives one table.
    """
    from ortho_pipeline.commands.orthos import verifying

    groups = _grouped(given, "points", "scene", "output")
    result = verifying.verify(
        ortho, folder, match=match, surface=surface, masks=masks, band=band, require=require, **groups
    )
    print_result(result, as_json)
    if not as_json:
        print_warnings(result.document["warnings"])
    if not all(one["met"] for one in result.document["requirements"]):
        click.get_current_context().exit(NOT_MET)


@click.command(cls=Command)
@click.argument("ortho", type=click.Path())
@matching_options
@_mask_option
@_band_option
@click.option(
    "--correction",
    type=click.Choice(["shift", "affine", "field"]),
    help="What is corrected  [default: what the matches justify]",
)
@click.option("--shift-only", is_flag=True, help="Correct a shift only.")
@click.option(
    "--no-resample",
    is_flag=True,
    help="Do not touch the pixels: write a VRT (or with --format GTiff a copy) whose map grid is moved.",
)
@click.option(
    "--max-bending",
    "bending",
    type=click.FloatRange(0, 0.2, min_open=True),
    default=0.02,
    show_default=True,
    metavar="PX",
    help="How much the displacement of a smooth field may change per pixel.",
)
@click.option("--resampling", "-r", type=click.Choice(RESAMPLING), default="cubic", show_default=True)
@folder_option
@click_options("output", OutputOptions, "nodata", "format", "creation_options", "memory", "threads")
@click_options("scene", SceneOptions, "allow_network", "roots")
@json_option
def align(
    ortho: str,
    match: MatchOptions,
    masks: tuple[str, ...],
    band: int | None,
    correction: str | None,
    shift_only: bool,
    no_resample: bool,
    bending: float,
    resampling: str,
    folder: str,
    as_json: bool,
    **given: Any,
) -> None:
    """Move a finished ORTHO onto an orthoimage.

    Corrects what the matches justify: a shift; more only where it is significant, up to a smooth field. The ortho is
    resampled once, on its own grid. Data type, nodata, mask and bands are kept. The report shows before and after.
    """
    from ortho_pipeline.commands.orthos import aligning

    if shift_only and correction not in (None, "shift"):
        raise click.UsageError("--shift-only and --correction contradict each other")
    groups = _grouped(given, "scene", "output")
    groups["output"] = replace(groups["output"], resampling=resampling)
    result = aligning.align(
        ortho,
        folder,
        match=match,
        masks=masks,
        band=band,
        correction="shift" if shift_only else correction,
        bending=bending,
        resample=not no_resample,
        **groups,
    )
    print_result(result, as_json)
    if not as_json:
        print_warnings(result.document["warnings"])


def _grouped(given: Mapping[str, Any], *groups: str) -> dict[str, Any]:
    """Return the options that arrive one by one as objects of their groups."""
    found: dict[str, Any] = {}
    for group in groups:
        values = {key.removeprefix(f"{group}_"): value for key, value in given.items() if key.startswith(f"{group}_")}
        # Without any, click's empty tuple stands for the default.
        found[group] = GROUPS[group](**{key: value for key, value in values.items() if value != ()})
    return found
