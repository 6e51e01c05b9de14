"""The commands that TinySat-1 adds to `ortho`. `ortho --help` imports this module, so it only declares them."""

from collections.abc import Iterable

from ortho_pipeline.plugin import Subcommand, hookimpl


@hookimpl
def ortho_commands() -> Iterable[Subcommand]:
    example = ("How high and how fast?", "ortho flight scene.tif")
    summary = "Show how high and how fast TinySat-1 flew when it took IMAGE."
    yield Subcommand("flight", summary, "ortho_tinysat_flight:flight", (example,))
