"""The commands `ortho adjust` and `ortho intersect`: several images and the points that they share."""

from __future__ import annotations

import click

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
from ortho_pipeline.cli.printing import print_result, print_warnings, progress
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import BlockOptions, MatchOptions, OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.options.texts import Setting, Text

_models = click.option(
    "--models", multiple=True, type=click.Path(), metavar="FILE", help="A saved *_model.json of each image."
)


@click.command(cls=Command)
@images_argument
@folder_option
@block_options
@_models
@adjustment_options
@matching_options
@surface_options
@click.option("--orthos", is_flag=True, help="Also make the orthos of all images on one grid, for 'ortho mosaic'.")
@block_output_options
@sensor_options
@json_option
def adjust(
    images: tuple[str, ...],
    folder: str,
    points: BlockOptions,
    models: tuple[str, ...],
    match: MatchOptions,
    surface: SurfaceOptions,
    orthos: bool,
    output: OutputOptions,
    scene: SceneOptions | list[SceneOptions],
    as_json: bool,
) -> None:
    """Adjust several IMAGEs together (bundle adjustment).

    The images may be a stereo pair or a block. The command writes a model and an RPC of each image, the ground points
    with their sigmas, and one report. Points with ground coordinates are control or check points; the others tie the
    images together. --models starts from saved models (repeat it, in the order of the images). --ties auto and
    --reference find points by matching; both need heights. --orthos makes the orthos of all images, too.
    """
    from ortho_pipeline.commands import block as blocks

    if not orthos and output != OutputOptions():
        raise InputError(
            "this describes orthos, and none are made", field="orthos", remedy=Text("give ", Setting("orthos"), " too")
        )
    command = click.get_current_context().meta["command"]
    asked = output if orthos else None
    with progress() as shown:
        result = blocks.adjust(
            images, folder, points, scene, models=models, match=match, surface=surface, orthos=asked, command=command,
            progress=shown,
        )  # fmt: skip
    print_result(result, as_json)


@click.command(cls=Command)
@images_argument
@block_options
@_models
@click.option(
    "--output", "-o", type=click.Path(dir_okay=False), metavar="FILE", help="Ground points: .csv or .geojson."
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

    The points have coordinates with sigmas. --models uses saved models instead of the images' own (repeat it, in the
    order of the images).
    """
    from ortho_pipeline.commands import block as blocks

    result = blocks.intersect(images, points, scene, models=models, output=output)
    print_result(result, as_json)
    if not as_json:
        print_warnings(result.document["warnings"])
