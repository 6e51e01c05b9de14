"""The work behind each command: paths in, paths out.

Imports everything below; parses no command line and prints nothing. What a command needs is loaded when it is first
asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ortho_pipeline.runtime.lazy_names import lazily

if TYPE_CHECKING:
    from ortho_pipeline.commands.facts import block_formats as block_formats
    from ortho_pipeline.commands.facts import dem_check as dem_check
    from ortho_pipeline.commands.facts import doctor as doctor
    from ortho_pipeline.commands.facts import edge as edge
    from ortho_pipeline.commands.facts import forget_kept_files as forget_kept_files
    from ortho_pipeline.commands.facts import formats as formats
    from ortho_pipeline.commands.facts import info as info
    from ortho_pipeline.commands.facts import kept_files as kept_files
    from ortho_pipeline.commands.facts import models as models
    from ortho_pipeline.commands.facts import sensor_test as sensor_test
    from ortho_pipeline.commands.facts import sensors as sensors
    from ortho_pipeline.commands.facts import write_plots as write_plots
    from ortho_pipeline.commands.fitting import compare as compare
    from ortho_pipeline.commands.fitting import fit as fit
    from ortho_pipeline.commands.rectification import check as check
    from ortho_pipeline.commands.rectification import export as export
    from ortho_pipeline.commands.rectification import rectify as rectify

_NAMES = {
    "fitting": ("compare", "fit"),
    "rectification": ("check", "export", "rectify"),
    "facts": (
        "block_formats",
        "dem_check",
        "doctor",
        "edge",
        "forget_kept_files",
        "formats",
        "info",
        "kept_files",
        "models",
        "sensor_test",
        "sensors",
        "write_plots",
    ),
}
#: Public name -> module that holds it.
_HOMES = {name: f"commands.{module}" for module, names in _NAMES.items() for name in names}

__all__ = sorted(_HOMES)  # noqa: PLE0605

if not TYPE_CHECKING:  # a checker knows the names from above, and no others
    __getattr__ = lazily(__name__, _HOMES)
