"""The command `ortho sharpen`: a pan-sharpened ortho of two orthos."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from ortho_pipeline.cli.options import click_options, folder_option, grouped_options, json_option
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result, progress
from ortho_pipeline.options import OutputOptions, SceneOptions


def weights_of(ctx: click.Context, _: click.Parameter, text: str | None) -> tuple[float, ...] | None:
    """Return the numbers of an option that lists them."""
    try:
        return None if text is None else tuple(float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a list of numbers, such as 0.2,0.3,0.3,0.2.") from None


def weights_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--weights``."""
    return click.option(
        "--weights",
        metavar="W,...",
        callback=weights_of,
        help="Weight of each multispectral band in the panchromatic one.  [default: by regression]",
    )(command)


@click.command(cls=Command)
@click.argument("pan", metavar="PAN_ORTHO", type=click.Path())
@click.argument("multispectral", metavar="MS_ORTHO", type=click.Path())
@weights_option
@click.option(
    "--ratio",
    type=click.IntRange(2, 100),
    metavar="N",
    help="How many panchromatic pixels wide an original multispectral pixel is, if MS_ORTHO was resampled.",
)
@folder_option
@click_options("output", OutputOptions, "dtype", "nodata", "format", "creation_options", "memory", "threads")
@click_options("scene", SceneOptions, "allow_network", "roots")
@json_option
def sharpen(
    pan: str,
    multispectral: str,
    weights: tuple[float, ...] | None,
    ratio: int | None,
    folder: str,
    as_json: bool,
    **grouped: Any,
) -> None:
    """Pan-sharpen MS_ORTHO with PAN_ORTHO.

    Both orthos show one acquisition; the result covers where they overlap. GDAL sharpens the multispectral bands
    (weighted Brovey). The command measures how well the orthos agree. At reduced resolution it compares the sharpened
    image with one that is only upsampled.
    """
    from ortho_pipeline.commands.sharpening import sharpen as sharpening

    options = grouped_options(grouped, "scene", "output")
    with progress() as advance:
        result = sharpening.sharpen(
            pan, multispectral, folder, weights=weights, ratio=ratio, progress=advance, **options
        )
    print_result(result, as_json)
