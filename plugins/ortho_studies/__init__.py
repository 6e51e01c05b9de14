"""Studies: simulated scenes with known truth, and the tables of papers computed on them, as commands of ``ortho``.

This module only declares the commands, because ``ortho --help`` imports it. `hookspecs` is for authors of studies,
`studies` finds and runs them, `simulation` has their common code, and each paper has a folder.
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
