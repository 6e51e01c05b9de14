"""Measuring by hand: a local page on which points are clicked in a scene and its reference, with the fit live.

The page shows the reference rendered into the scene's own pixels, so that a click in one predicts itself in the other.
This module declares the command `ortho measure`, and imports no more: ``ortho --help`` imports it. starlette and
uvicorn, an extra, are loaded when a page is served.
"""

from collections.abc import Iterable

from ortho_pipeline.plugin import Subcommand, hookimpl


@hookimpl
def ortho_commands() -> Iterable[Subcommand]:
    """Add `ortho measure`."""
    yield Subcommand(
        "measure",
        "Measure control points in the browser.",
        "ortho_measure.cli:measure",
        (
            (
                "Measure points by hand in the browser, next to the reference:",
                "ortho measure scene.tif --reference reference.tif --dem dem.tif -o points.geojson",
            ),
        ),
        group="Control points",
    )
