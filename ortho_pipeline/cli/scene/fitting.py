"""The commands `ortho fit` and `ortho compare`: one model of a scene, or many, adjusted to points."""

from __future__ import annotations

import click

from ortho_pipeline.cli.machine.browser import open_option, page_of, require_page, show_page
from ortho_pipeline.cli.options import (
    image_argument,
    json_option,
    match_options,
    optional_folder,
    point_options,
    scene_options,
    surface_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_comparison, print_fit, print_json
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions


@click.command(cls=Command)
@image_argument
@point_options
@match_options
@scene_options
@surface_options
@json_option
def fit(
    image: str,
    points: PointOptions,
    match: MatchOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    as_json: bool,
) -> None:
    """Adjust the model of IMAGE to control points.

    Every residual is shown: measured minus predicted, in pixels.
    """
    from ortho_pipeline import commands

    result = commands.fit(image, points, scene, surface, match)
    if as_json:
        return print_json(result.to_json())
    print_fit(result)
    return None


@click.command(cls=Command)
@image_argument
@click.option("--models", default="all", show_default=True, metavar="all|A,B,C", help="Models to compare.")
@click.option("--units", type=click.Choice(["px", "m"]), default="px", show_default=True, help="Units of the table.")
@optional_folder("Folder of the report.")
@point_options
@match_options
@scene_options
@surface_options
@open_option
@json_option
def compare(
    image: str,
    models: str,
    units: str,
    folder: str | None,
    points: PointOptions,
    match: MatchOptions,
    scene: SceneOptions,
    surface: SurfaceOptions,
    as_json: bool,
) -> None:
    """Compare models on the same points and recommend one.

    The image's own model takes part with each of its corrections (rpc, rpc+shift, rpc+shift-drift, rpc+affine). With
    -o the report of the recommended model is written; it contains the comparison.
    """
    from ortho_pipeline import commands

    require_page("-o DIR", folder)
    command = click.get_current_context().meta["command"]
    result = commands.compare(
        image, points, models=models, folder=folder, scene=scene, surface=surface, match=match, command=command
    )
    if as_json:
        print_json(result.to_json())
        return show_page(page_of(result.files))
    return print_comparison(result, units)
