"""The work behind each command: paths in, paths out.

Imports everything below; parses no command line and prints nothing.
"""

from __future__ import annotations

from ortho_pipeline.commands.fitting import compare, fit
from ortho_pipeline.commands.rectification import check, export, rectify
from ortho_pipeline.commands.scene import dem_check, doctor, edge, info, models, sensors, write_plots

__all__ = [
    "check",
    "compare",
    "dem_check",
    "doctor",
    "edge",
    "export",
    "fit",
    "info",
    "models",
    "rectify",
    "sensors",
    "write_plots",
]
