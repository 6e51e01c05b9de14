"""The command `ortho measure`: points by hand in the browser."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import click

from ortho_pipeline.cli.options import (
    image_argument,
    json_option,
    point_options,
    reference_options,
    scene_options,
    surface_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_json
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions


@click.command(cls=Command)
@image_argument
@reference_options
@point_options
@surface_options
@click.option(
    "--output", "-o", type=click.Path(dir_okay=False), metavar="FILE.geojson",
    help="Points, with their journal beside them.  [default: <stem>_points.geojson]",
)  # fmt: skip
@click.option("--no-browser", is_flag=True, help="Print the address, and open nothing.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="On this machine.  [default: any that is free]")
@scene_options
@json_option
def measure(
    image: str, match: MatchOptions, points: PointOptions, surface: SurfaceOptions, output: str | None,
    no_browser: bool, port: int, scene: SceneOptions, as_json: bool,
) -> None:  # fmt: skip
    """Measure points of IMAGE in the browser, beside its reference in the geometry of the image.

    A click is matched to a part of a pixel, the fit is solved after every point, and the page says where the next one
    tells most. Everything stays on this machine; Ctrl-C ends. The file of points is for --gcps of 'ortho fit',
    'rectify', 'compare' and 'export'.
    """
    from ortho_pipeline.measure.session import open_session

    if not match.reference:
        raise InputError("there is nothing to measure against", field="match.reference",
                         remedy="give an orthoimage of the same place")  # fmt: skip
    missing = [name for name in ("starlette", "uvicorn") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"measuring in the browser needs {' and '.join(missing)}",
                         remedy='pip install "ortho-pipeline[measure]"')  # fmt: skip
    from ortho_pipeline.measure.serving.server import serve

    session = open_session(
        image, output or f"{Path(image).stem}_points.geojson", scene=scene, points=points, surface=surface, match=match
    )  # fmt: skip

    def ready(address: str) -> None:
        if as_json:
            print_json({"address": address, "points": str(session.output)})
        else:
            click.echo(f"Measuring at {address}")
            click.echo(f"Points: {session.output}. Ctrl-C ends.")
        if not no_browser:
            import webbrowser

            webbrowser.open(address)

    serve(session, scene, ready, port)
