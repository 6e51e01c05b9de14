"""The commands `ortho adjust` and `ortho intersect`: several images and the points that they share."""

from __future__ import annotations

import click

from ortho_pipeline.cli.options import (
    adjustment_options,
    block_options,
    folder_option,
    images_argument,
    json_option,
    matching_options,
    sensor_options,
    surface_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result, print_warnings
from ortho_pipeline.options import BlockOptions, MatchOptions, SceneOptions, SurfaceOptions

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
@sensor_options
@json_option
def adjust(
    images: tuple[str, ...],
    folder: str,
    points: BlockOptions,
    models: tuple[str, ...],
    match: MatchOptions,
    surface: SurfaceOptions,
    scene: SceneOptions | list[SceneOptions],
    as_json: bool,
) -> None:
    """Adjust several IMAGEs and the points that they share (bundle adjustment of a stereo pair or a block).

    Writes a model and an RPC of each image, the ground points with their sigmas, and one report. Points with ground
    coordinates control or check, the others tie the images together. With --models (repeated, in the order of the
    images) the saved models, such as those of an earlier adjustment, are where it starts. With --ties auto and
    --reference points are found by matching, without a hand; that needs heights.
    """
    from ortho_pipeline.commands import block as blocks

    command = click.get_current_context().meta["command"]
    result = blocks.adjust(images, folder, points, scene, models=models, match=match, surface=surface, command=command)
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
    """Intersect the rays of points that were measured in several IMAGEs: ground coordinates with their sigmas.

    With --models (repeated, in the order of the images) the saved models take the place of the images' own.
    """
    from ortho_pipeline.commands import block as blocks

    result = blocks.intersect(images, points, scene, models=models, output=output)
    print_result(result, as_json)
    if not as_json:
        print_warnings(result.document["warnings"])
