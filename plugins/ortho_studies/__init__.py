"""Studies: scenes of known truth, and the tables of papers computed on them, as commands of ``ortho``.

This module declares the commands, and imports no more: ``ortho --help`` imports it. `hookspecs` has what the author of
a study reads, `studies` finds and runs studies, `simulation` has what they share, and each paper has a folder.
"""

from collections.abc import Iterable

from ortho_pipeline.plugin import Subcommand, hookimpl


@hookimpl
def ortho_commands() -> Iterable[Subcommand]:
    """Add `ortho simulate` and `ortho reproduce`."""
    yield Subcommand("simulate", "Write scenes of known truth.", "ortho_studies.cli:simulate", group="Set-up")
    yield Subcommand(
        "reproduce",
        "Recompute the tables of four papers.",
        "ortho_studies.cli:reproduce",
        group="Set-up",
    )
