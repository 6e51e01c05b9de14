"""A request once its files are open."""

from __future__ import annotations

from dataclasses import dataclass

from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.points import Points
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface


@dataclass(frozen=True, eq=False)
class Resolved:
    """A request whose scene, heights, points and grid are open.

    References are opened with the scene that is matched, of a crop with both of its candidates. Another ortho is
    opened on the grid of the ortho, which is only known once the scene is adjusted.

    Parameters
    ----------
    scene : Scene
        Its models are meant for the surface.
    surface : Surface, optional
        None where no heights are given.
    points : Points
        As they were read, with their roles; matches are not among them.
    grid : Grid, optional
        That of the raster which an ortho is to match.
    ledger : Ledger
        The files that were read, as they were when the work began.
    """

    request: Request
    scene: Scene
    surface: Surface | None
    points: Points
    grid: Grid | None
    ledger: Ledger
