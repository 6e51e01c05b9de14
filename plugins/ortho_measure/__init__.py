"""Measure points by hand: a local page for clicking points in a scene and its reference, with a live fit.

The page shows the reference rendered into the pixels of the scene, so a click in one view predicts the other position.
This module only declares the command `ortho measure`, because ``ortho --help`` imports it. starlette and uvicorn (an
extra) are loaded when the page is served.
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
