"""The work behind each command: paths in, paths out.

Imports everything below; parses no command line and prints nothing. What a command needs is loaded when it is first
asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ortho_pipeline.runtime.lazy_names import lazily

if TYPE_CHECKING:
    from ortho_pipeline.commands.fitting import compare as compare
    from ortho_pipeline.commands.fitting import fit as fit
    from ortho_pipeline.commands.rectification import check as check
    from ortho_pipeline.commands.rectification import export as export
    from ortho_pipeline.commands.rectification import rectify as rectify
    from ortho_pipeline.commands.scene import block_formats as block_formats
    from ortho_pipeline.commands.scene import dem_check as dem_check
    from ortho_pipeline.commands.scene import doctor as doctor
    from ortho_pipeline.commands.scene import edge as edge
    from ortho_pipeline.commands.scene import forget_kept_files as forget_kept_files
    from ortho_pipeline.commands.scene import formats as formats
    from ortho_pipeline.commands.scene import info as info
    from ortho_pipeline.commands.scene import kept_files as kept_files
    from ortho_pipeline.commands.scene import models as models
    from ortho_pipeline.commands.scene import sensors as sensors
    from ortho_pipeline.commands.scene import write_plots as write_plots

_NAMES = {
    "fitting": ("compare", "fit"),
    "rectification": ("check", "export", "rectify"),
    "scene": (
        "block_formats",
        "dem_check",
        "doctor",
        "edge",
        "forget_kept_files",
        "formats",
        "info",
        "kept_files",
        "models",
        "sensors",
        "write_plots",
    ),
}
#: Public name -> module that holds it.
_HOMES = {name: f"commands.{module}" for module, names in _NAMES.items() for name in names}

__all__ = sorted(_HOMES)  # noqa: PLE0605

if not TYPE_CHECKING:  # a checker knows the names from above, and no others
    __getattr__ = lazily(__name__, _HOMES)
