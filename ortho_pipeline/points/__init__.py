"""Control, check and tie points: one table, a reader for every format, and the choice of control.

Imports `geodesy` and the rooms below. A new point format is an entry in `formats`.
"""

from __future__ import annotations

from ortho_pipeline.points.rows import TablePoint
from ortho_pipeline.points.selection import AnyPoints, assign_roles
from ortho_pipeline.points.shared_marks import HasGround, marks_warning, one_mark
from ortho_pipeline.points.table import (
    DEFAULT_SIGMA_IMAGE,
    Points,
    gcps_of_dataset,
    points_of,
    read_points,
    write_points,
)

__all__ = [
    "DEFAULT_SIGMA_IMAGE",
    "AnyPoints",
    "HasGround",
    "Points",
    "TablePoint",
    "assign_roles",
    "gcps_of_dataset",
    "marks_warning",
    "one_mark",
    "points_of",
    "read_points",
    "write_points",
]
