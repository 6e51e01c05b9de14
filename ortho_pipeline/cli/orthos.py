"""The commands `ortho verify` and `ortho align`: finished orthos against references."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click

from ortho_pipeline.cli.machine.browser import open_option, require_page
from ortho_pipeline.cli.options import (
    click_options,
    folder_option,
    grouped_options,
    json_option,
    matching_options,
    optional_folder,
    surface_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import FAILED, PARTLY_DONE, print_result
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.options.option import RESAMPLING

#: Exit code of `ortho verify` if an ortho does not meet a requirement (--require).
NOT_MET = 4

_mask_option = click.option(
    "--mask",
    "masks",
    multiple=True,
    metavar="FILE[=VALUES]",
    help="Raster of classes that hide the ground, such as scl.tif=3,8-10. Without values: all classes except 0. "
    "May be repeated.",
)
_band_option = click.option(
    "--compare-band",
    "band",
    type=click.IntRange(min=1),
    metavar="N",
    help="Band of the ortho to compare.  [default: those with the most content]",
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
    help="Limit of bias, rmse or ce90, in m or px. The exit code is 4 if it is not met. May be repeated.",
)
@optional_folder("Folder for the report, its numbers and the displacements.")
@open_option
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
    **grouped: Any,
) -> None:
    """Measure how accurate a finished ORTHO is.

    The result is bias, RMSE and CE90 with 95 % intervals: relative to an orthoimage of the same place (--reference),
    and on the ground (--gcps). The report also has a map of displacements, profiles by height, column and row, the
    shifts between bands, and the likely cause. For a FOLDER of orthos it is one table.
    """
    from ortho_pipeline.commands.orthos import verifying

    require_page("-o DIR", folder)
    groups = grouped_options(grouped, "points", "scene", "output")
    result = verifying.verify(
        ortho,
        folder,
        match=match,
        surface=surface,
        masks=masks,
        band=band,
        require=require,
        command=click.get_current_context().meta["command"],
        **groups,
    )
    print_result(result, as_json)
    # In a folder, an ortho that could not be compared is a row with an error: it meets no requirement.
    rows = result.document.get("orthos", [])
    failed = result.document.get("failed", 0)
    if (require and failed) or not all(requirement["met"] for requirement in result.document["requirements"]):
        click.get_current_context().exit(NOT_MET)
    if failed:
        click.get_current_context().exit(FAILED if failed == len(rows) else PARTLY_DONE)


@click.command(cls=Command)
@click.argument("ortho", type=click.Path())
@matching_options
@_mask_option
@_band_option
@click.option(
    "--shift-only", is_flag=True, help="Correct a shift only.  [default: the correction that the matches justify]"
)
@click.option(
    "--no-resample",
    is_flag=True,
    help="Correct a shift only, by moving the map grid. Write a VRT, or a copy with --format GTiff.",
)
@click.option(
    "--max-bending",
    "bending",
    type=click.FloatRange(0, 0.2, min_open=True),
    default=0.02,
    show_default=True,
    metavar="PX",
    help="Most that the displacement of a smooth field may change from one pixel to the next.",
)
@click.option(
    "--resampling", "-r", type=click.Choice(RESAMPLING), default="cubic", show_default=True, help="Resampling method."
)
@folder_option
@open_option
@click_options("output", OutputOptions, "nodata", "format", "creation_options", "memory", "threads")
@click_options("scene", SceneOptions, "allow_network", "roots")
@json_option
def align(
    ortho: str,
    match: MatchOptions,
    masks: tuple[str, ...],
    band: int | None,
    shift_only: bool,
    no_resample: bool,
    bending: float,
    resampling: str,
    folder: str,
    as_json: bool,
    **grouped: Any,
) -> None:
    """Align a finished ORTHO with an orthoimage.

    The matches decide the correction: a shift, an affine transformation or a smooth field. The ortho is resampled once,
    on its own grid. Data type, nodata, mask and bands stay the same. The report compares before and after.
    """
    from ortho_pipeline.commands.orthos import aligning

    groups = grouped_options(grouped, "scene", "output")
    groups["output"] = replace(groups["output"], resampling=resampling)
    result = aligning.align(
        ortho,
        folder,
        match=match,
        masks=masks,
        band=band,
        shift_only=shift_only,
        bending=bending,
        resample=not no_resample,
        command=click.get_current_context().meta["command"],
        **groups,
    )
    print_result(result, as_json)
