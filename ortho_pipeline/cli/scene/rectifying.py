"""The commands `ortho rectify`, `ortho export` and `ortho report`: the ortho of a scene, its model, the plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ortho_pipeline.cli.machine.browser import open_option
from ortho_pipeline.cli.machine.terminal import say
from ortho_pipeline.cli.options import (
    dry_run_option,
    folder_option,
    image_argument,
    json_option,
    match_options,
    network_option,
    output_options,
    point_options,
    scene_options,
    surface_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import checked_text, print_json, print_result, progress
from ortho_pipeline.cli.sharpening import weights_option
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions


@click.command(
    cls=Command,
    one="Give one image; for several use 'ortho run PIPELINE.yaml'. Name the output folder with '-o DIR'.",
)
@image_argument
@folder_option
@click.option(
    "--overwrite",
    "-overwrite",
    is_flag=True,
    help="Also delete outputs of an earlier run whose report is missing, and sidecar files that GIS software would "
    "pick up. (Existing outputs are always replaced.)",
)
@click.option(
    "--sharpen",
    metavar="MS",
    type=click.Path(),
    help="Multispectral image of the same acquisition: also make its ortho on the same grid, and pan-sharpen it.",
)
@weights_option
@dry_run_option
@point_options
@match_options
@scene_options
@surface_options
@output_options
@open_option
@json_option
def rectify(
    image: str,
    folder: str,
    overwrite: bool,
    sharpen: str | None,
    weights: tuple[float, ...] | None,
    dry_run: bool,
    points: PointOptions,
    match: MatchOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    output: OutputOptions,
    as_json: bool,
) -> None:
    """Make the ortho of IMAGE, with its accuracy report.

    The command also writes the adjusted model.
    """
    from ortho_pipeline import commands

    if weights is not None and sharpen is None:
        raise click.UsageError("--weights are for pan-sharpening: also give --sharpen.")
    if dry_run and sharpen is not None:
        raise click.UsageError("--dry-run checks one image: leave out --sharpen.")
    if dry_run:
        checked = commands.check(image, scene=scene, points=points, surface=surface, match=match, output=output)
        return print_json(checked) if as_json else say(checked_text(Path(image).name, checked))
    options: dict[str, Any] = {
        "scene": scene,
        "points": points,
        "surface": surface,
        "match": match,
        "output": output,
        "overwrite": overwrite,
        "command": click.get_current_context().meta["command"],
    }
    with progress() as advance:
        if sharpen is None:
            result = commands.rectify(image, folder, progress=advance, **options)
        else:
            from ortho_pipeline.commands.sharpening.bundle import rectify_bundle

            result = rectify_bundle(image, sharpen, folder, weights=weights, progress=advance, **options)
    return print_result(result, as_json)


class _Formats(click.Option):
    """The option ``--format``: its help names the formats that are installed."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the option and its help, for which the plugins are loaded."""
        from ortho_pipeline import commands

        listed = ", ".join(f"{name} ({title})" for name, title in commands.formats().items())
        self.help = f"What to write: {listed}. May be repeated.  [default: rpc-txt,rpb,vrt,tag]"
        return super().get_help_record(ctx)


@click.command(cls=Command)
@image_argument
@folder_option
@click.option("--format", "formats", cls=_Formats, multiple=True, metavar="F[,F...]", help="What to write.")
@click.option("--force", is_flag=True, help="Write a file even if it differs from the model by more than 0.1 px.")
@point_options
@match_options
@scene_options
@surface_options
@json_option
def export(
    image: str,
    folder: str,
    formats: tuple[str, ...],
    force: bool,
    points: PointOptions,
    match: MatchOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    as_json: bool,
) -> None:
    """Write the model of IMAGE for other programs.

    With --gcps or --reference the command adjusts the model first. It writes an RPC (text, RPB, XML, VRT, or tag in a
    copy of the image), GCPs (the measured points, or a grid if there are none; as VRT, or as tags in a copy of the
    image), or geolocation arrays.
    """
    from ortho_pipeline import commands

    chosen = [name.strip() for text in formats for name in text.split(",")]
    formats_given: dict[str, Any] = {"formats": chosen} if chosen else {}
    result = commands.export(
        image, folder, scene=scene, points=points, surface=surface, match=match, force=force, **formats_given
    )
    print_result(result, as_json)


@click.command(cls=Command)
@click.argument("report_file", metavar="REPORT.json", type=click.Path())
@click.option(
    "--plots", "folder", required=True, type=click.Path(file_okay=False), metavar="DIR", help="Folder of the plots."
)
@click.option(
    "--kind",
    type=click.Choice(["svg", "png"]),
    default="svg",
    show_default=True,
    help="Format of the plots; png needs matplotlib.",
)
@network_option
@json_option
def report(report_file: str, folder: str, kind: str, scene: SceneOptions, as_json: bool) -> None:
    """Write the plots of a report as pictures."""
    from ortho_pipeline import commands

    print_result(commands.write_plots(report_file, folder, kind, allow_network=scene.allow_network), as_json)
