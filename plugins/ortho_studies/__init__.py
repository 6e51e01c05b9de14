"""Studies: scenes of known truth, and the tables of papers computed on them, as commands of ``ortho``.

This module declares the commands, and imports no more: ``ortho --help`` imports it. `hookspecs` has what the author of
a study reads, `studies` finds and runs studies, `simulation` has what they share, and each paper has a folder.
"""

from collections.abc import Iterable

from ortho_pipeline.plugin import Subcommand, hookimpl


@hookimpl
def ortho_commands() -> Iterable[Subcommand]:
    """Add `ortho simulate` and `ortho reproduce`."""
    yield Subcommand("simulate", "Make scenes of known truth.", "ortho_studies.cli:simulate")
    yield Subcommand(
        "reproduce",
        "Compute the tables of the papers that this package implements, beside the papers' numbers.",
        "ortho_studies.cli:reproduce",
    )
