"""The commands `ortho adjust` and `ortho intersect`: several images and the points that they share."""

from __future__ import annotations

import click

from ortho_pipeline.cli.machine.browser import open_option
from ortho_pipeline.cli.options import (
    adjustment_options,
    block_options,
    block_output_options,
    folder_option,
    images_argument,
    json_option,
    matching_options,
    sensor_options,
    surface_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result, progress
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options import (
    BlockOptions,
    MatchOptions,
    MosaicOptions,
    OutputOptions,
    SceneOptions,
    SurfaceOptions,
)

_models = click.option(
    "--models",
    multiple=True,
    type=click.Path(),
    metavar="FILE",
    help="Saved *_model.json of an image. Repeat it for each image, in their order.",
)


_PROGRAMS = "Also write models and a configuration for these stereo programs: {}. May be repeated."


class _Programs(click.Option):
    """The option ``--export``: its help names the programs of installed plugins."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the option and its help, for which the plugins are loaded."""
        from ortho_pipeline import commands

        listed = ", ".join(f"{name} ({title})" for name, title in commands.block_formats().items())
        self.help = _PROGRAMS.format(listed)
        return super().get_help_record(ctx)


@click.command(cls=Command)
@images_argument
@folder_option
@block_options
@_models
@adjustment_options
@matching_options
@surface_options
@click.option("--orthos", is_flag=True, help="Also make the orthos of all images on one grid, for 'ortho mosaic'.")
@click.option("--mosaic", is_flag=True, help="Also make these orthos and one raster of them, mosaic.tif.")
@click.option("--export", cls=_Programs, multiple=True, metavar="PROGRAM[,PROGRAM...]", help=_PROGRAMS)
@block_output_options
@sensor_options
@open_option
@json_option
def adjust(
    images: tuple[str, ...],
    folder: str,
    points: BlockOptions,
    models: tuple[str, ...],
    match: MatchOptions,
    surface: SurfaceOptions,
    orthos: bool,
    mosaic: bool,
    export: tuple[str, ...],
    output: OutputOptions,
    scene: SceneOptions | list[SceneOptions],
    as_json: bool,
) -> None:
    """Adjust several IMAGEs together (bundle adjustment).

    The images may be a stereo pair, a block, or one folder of photos. The command writes a model and an RPC of each
    image, the ground points with their sigmas, and one report. Points with ground coordinates are control or check
    points; the others tie the images together. --ties auto and --reference find points by matching; both need heights.
    --orthos also makes the orthos of all images, and --mosaic one raster of them. --export writes what stereo programs
    need to compute a surface.
    """
    from ortho_pipeline.commands import block as blocks
    from ortho_pipeline.stores.delivery import address_of

    orthos |= mosaic
    if not orthos and output != OutputOptions():
        raise InputError(
            "this option is for orthos, and none are made",
            field="orthos",
            remedy=Text("leave it out, or add ", Setting("orthos")),
        )
    programs = [name.strip() for text in export for name in text.split(",")]
    if programs and address_of(folder) is not None:
        raise InputError(
            "stereo programs read images and models from disk",
            field="export",
            remedy=Text("give a folder on disk, or leave out ", Setting("export")),
        )
    command = click.get_current_context().meta["command"]
    asked = output if orthos else None
    with progress() as shown:
        result = blocks.adjust(
            images,
            folder,
            points,
            scene,
            models=models,
            match=match,
            surface=surface,
            orthos=asked,
            mosaic=MosaicOptions(format="COG") if mosaic else None,
            export=programs,
            command=command,
            progress=shown,
        )
    print_result(result, as_json)


@click.command(cls=Command)
@images_argument
@block_options
@_models
@click.option(
    "--output", "-o", type=click.Path(dir_okay=False), metavar="FILE", help="File of ground points: .csv or .geojson."
)
@sensor_options
@json_option
def intersect(
    images: tuple[str, ...],
    points: BlockOptions,
    models: tuple[str, ...],
    output: str | None,
    scene: SceneOptions | list[SceneOptions],
    as_json: bool,
) -> None:
    """Compute ground points from rays in several IMAGEs.

    The result has the coordinates and their sigmas. --models replaces the images' own models.
    """
    from ortho_pipeline.commands import block as blocks

    result = blocks.intersect(images, points, scene, models=models, output=output)
    print_result(result, as_json)
