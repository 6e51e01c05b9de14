"""The commands `ortho match` and `ortho ties`: control points from reference orthoimages, ties between scenes."""

from __future__ import annotations

import click

from ortho_pipeline.cli.machine.browser import open_option, require_page
from ortho_pipeline.cli.options import (
    image_argument,
    images_argument,
    json_option,
    matching_options,
    scene_options,
    sensor_options,
    surface_options,
    tie_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result
from ortho_pipeline.options import MatchOptions, SceneOptions, SurfaceOptions


@click.command(cls=Command)
@image_argument
@matching_options
@surface_options
@click.option(
    "--output",
    "-o",
    type=click.Path(dir_okay=False),
    required=True,
    metavar="FILE",
    help="File of points: .geojson or .csv.",
)
@click.option(
    "--report",
    type=click.Path(dir_okay=False),
    metavar="FILE.html",
    help="Page that shows the matches: chips, map, residuals. A .json of the same name has the numbers.",
)
@open_option
@scene_options
@json_option
def match(
    image: str,
    match: MatchOptions,
    surface: SurfaceOptions,
    output: str,
    report: str | None,
    scene: SceneOptions,
    as_json: bool,
) -> None:
    """Find control points of IMAGE in an orthoimage.

    One match in five is reserved as a check point. The file has the covariances of the points. Give it to 'ortho fit',
    'rectify', 'compare' or 'export' with --gcps. With --reference these commands match by themselves.
    """
    from ortho_pipeline.commands.control import command

    require_page("--report FILE.html", report)
    result = command.match(image, output, match, scene=scene, surface=surface, report=report)
    print_result(result, as_json)


@click.command(cls=Command)
@images_argument
@tie_options
@surface_options
@click.option(
    "--output", "-o", type=click.Path(dir_okay=False), required=True, metavar="FILE", help="File of tie points: .csv."
)
@sensor_options
@json_option
def ties(
    images: tuple[str, ...],
    match: MatchOptions,
    surface: SurfaceOptions,
    output: str,
    scene: SceneOptions | list[SceneOptions],
    as_json: bool,
) -> None:
    """Find tie points between overlapping IMAGEs.

    A tie point is a place that two or more images show; the file has its covariances. Heights only bring the images
    into one geometry. They may be wrong: state their accuracy with --dem-sigma. Give the ties to 'ortho adjust' with
    --points. 'ortho adjust --ties auto' finds them itself.
    """
    from ortho_pipeline.commands.control import ties as command

    result = command.ties(images, output, match, scene=scene, surface=surface)
    print_result(result, as_json)
