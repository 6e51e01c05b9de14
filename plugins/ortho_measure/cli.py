"""The command `ortho measure`: measure points of one or several images in the browser."""

from __future__ import annotations

import contextlib
import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ortho_pipeline.cli.machine.terminal import say
from ortho_pipeline.cli.options import (
    images_argument,
    json_option,
    point_options,
    reference_options,
    scenes_options,
    surface_options,
)
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_json
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import BlockOptions, MatchOptions, PointOptions, SceneOptions, SurfaceOptions

if TYPE_CHECKING:
    from ortho_measure.project import Project


@click.command(cls=Command)
@images_argument
@reference_options
@point_options
@surface_options
@click.option(
    "--output",
    "-o",
    type=click.Path(dir_okay=False),
    metavar="FILE.geojson",
    help="File for the points; their journal is next to it.  [default: <stems>_points.geojson]",
)
@click.option("--no-browser", is_flag=True, help="Only print the address; do not open a browser.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=0, help="Port on this machine.  [default: any free port]"
)
@scenes_options
@json_option
def measure(
    images: tuple[str, ...],
    match: MatchOptions,
    points: PointOptions,
    surface: SurfaceOptions,
    output: str | None,
    no_browser: bool,
    port: int,
    scene: SceneOptions | list[SceneOptions],
    as_json: bool,
) -> None:
    """Measure control points in the browser.

    The page shows IMAGE next to its reference, in the geometry of the image. A click is matched to a fraction of a
    pixel, the fit is updated after every point, and the page proposes the best next point. Everything stays on this
    machine; Ctrl-C ends the command. Give the file of points to 'ortho fit', 'rectify', 'compare' or 'export' with
    --gcps. Points of several images, such as a stereo pair, are for --points of 'ortho adjust'.
    """
    if not match.reference and len(images) == 1:
        raise InputError(
            "a single image needs a reference to measure against",
            field="match.reference",
            remedy="give an orthoimage of the same place",
        )
    missing = [name for name in ("starlette", "uvicorn") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"measuring in the browser needs {' and '.join(missing)}",
            remedy="run pip install '.[measure]' in the checkout of ortho-pipeline",
        )
    from ortho_measure.serving.server import serve

    session = _session(images, output, scene, points, surface, match)
    with contextlib.ExitStack() as until_end:

        def ready(address: str) -> None:
            if as_json:
                print_json({"address": address, "points": str(session.output)})
            else:
                say(f"Measuring at {address}")
                say(f"Points: {session.output}. The address works once. Ctrl-C ends.")
            if not no_browser:
                _open_browser(address, session.output, until_end)

        serve(session, _first(scene), ready, port)


def _open_browser(address: str, points: Path, until_end: contextlib.ExitStack) -> None:
    """Open the address through a file, because every user of this machine can read a browser's command line."""
    import webbrowser

    from ortho_measure.serving.entry import private_file

    path = until_end.enter_context(private_file(address, points))
    if path is None:
        say("Note: cannot write a private file next to the points. Open the address in a browser yourself.", err=True)
    else:
        webbrowser.open(path.as_uri())


def _first(scene: SceneOptions | list[SceneOptions]) -> SceneOptions:
    """Return the options of the first image; permissions are the same for all images."""
    return scene if isinstance(scene, SceneOptions) else scene[0]


def _session(
    images: tuple[str, ...],
    output: str | None,
    scene: SceneOptions | list[SceneOptions],
    points: PointOptions,
    surface: SurfaceOptions,
    match: MatchOptions,
) -> Project:
    """Open the session of one or several images."""
    name = output or "_".join([*(Path(image).stem for image in images[:2]), "points.geojson"])
    if len(images) == 1:
        from ortho_measure.session import open_session

        return open_session(images[0], name, scene=_first(scene), points=points, surface=surface, match=match)
    from ortho_measure.block.session import open_block_session

    for field in ("select", "fit_model", "model_crs", "prune", "params", "significance", "ridge", "near"):
        if getattr(points, field) != getattr(PointOptions, field):
            raise InputError(
                "this option is for a single image, but there are several",
                field=f"points.{field}",
                remedy="leave it out",
            )
    if points.gcps is not None and not isinstance(points.gcps, str):
        raise InputError("for several images, this must be a file of points", field="points.gcps", remedy="give a file")
    options = BlockOptions(
        points=points.gcps,
        crs=points.crs,
        vertical=points.vertical,
        pixel_origin=points.pixel_origin,
        check=points.check,
        correction=points.correction,
    )
    return open_block_session(images, name, scene=scene, points=options, surface=surface, match=match)
