"""The command line: parse, call one function of `commands` or `batch`, print.

Heavy imports wait until a command needs them, so that `ortho --help` answers at once.
"""

from __future__ import annotations

from ortho_pipeline.cli.program import main

__all__ = ["main"]
