"""A request once its scene, heights and points are open."""

from __future__ import annotations

from dataclasses import dataclass

from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.points import Points
from ortho_pipeline.surface.base import Surface


@dataclass(frozen=True, eq=False)
class Resolved:
    """A request whose scene, heights and points are open.

    References, the raster of the grid and another ortho are opened where they are used.

    Parameters
    ----------
    scene : Scene
        Its models are meant for the surface.
    surface : Surface, optional
        None where no heights are given.
    points : Points
        As they were read, with their roles; matches are not among them.
    ledger : Ledger
        The files that were read, as they were when the work began.
    """

    request: Request
    scene: Scene
    surface: Surface | None
    points: Points
    ledger: Ledger
