"""The commands `ortho edge` and `ortho register`: how sharp an image is, and single bands as one image."""

from __future__ import annotations

import click

from ortho_pipeline.cli.options import (
    folder_option,
    image_argument,
    json_option,
    network_option,
    optional_folder,
    scene_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result
from ortho_pipeline.options import SceneOptions


@click.command(cls=Command)
@image_argument
@click.option(
    "--edge", metavar="X1,Y1,X2,Y2", help="Columns and rows of the ends of one edge.  [default: found automatically]"
)
@click.option("--band", type=click.IntRange(min=1), default=1, show_default=True, help="Band to measure.")
@optional_folder("Folder for the result (JSON) and a plot.")
@network_option
@json_option
def edge(image: str, edge: str | None, band: int, folder: str | None, scene: SceneOptions, as_json: bool) -> None:
    """Measure how sharp IMAGE is, from straight edges.

    The result is the edge spread, the line spread and the width in pixels.
    """
    from ortho_pipeline import commands

    print_result(commands.edge(image, folder, edge=edge, band=band, allow_network=scene.allow_network), as_json)


@click.command(cls=Command)
@click.argument("images", nargs=-1, required=True, type=click.Path())
@folder_option
@click.option("--reference", metavar="IMAGE", help="Image to which the others are aligned.  [default: the first]")
@click.option(
    "--transform",
    type=click.Choice(["similarity", "affine", "projective", "poly2"]),
    default="projective",
    show_default=True,
    help="Transformation between the bands.",
)
@scene_options
@json_option
def register(
    images: tuple[str, ...], folder: str, reference: str | None, transform: str, scene: SceneOptions, as_json: bool
) -> None:
    """Align the bands of separate cameras in one image.

    Use it for bands of one acquisition. The result opens as the reference did: its metadata file is copied, or its
    model is written as a model file.
    """
    from ortho_pipeline.commands import bands

    print_result(bands.register(images, folder, reference=reference, transform=transform, scene=scene), as_json)
