"""The command `ortho dem-check`: a DEM against check heights."""

from __future__ import annotations

import click

from ortho_pipeline.cli.options import click_options, dem_datum_options, json_option, network_option
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_result
from ortho_pipeline.options import PointOptions, SceneOptions, SurfaceOptions


@click.command("dem-check", cls=Command)
@click.argument("dem", type=click.Path())
@click.option("--points", required=True, metavar="FILE", help="Check heights: CSV or GeoJSON with x, y, h.")
@click_options("points", PointOptions, "crs", "vertical")
@dem_datum_options
@network_option
@json_option
def dem_check(
    dem: str,
    points: str,
    points_crs: str | None,
    points_vertical: str | None,
    surface: SurfaceOptions,
    scene: SceneOptions,
    as_json: bool,
) -> None:
    """Compare a DEM with check heights.

    The result has bias, RMSE, NMAD and LE90, also by slope of the terrain.
    """
    from ortho_pipeline import commands

    crs_options = {"crs": points_crs, "vertical": points_vertical}
    print_result(commands.dem_check(dem, points, **crs_options, surface=surface, scene=scene), as_json)
