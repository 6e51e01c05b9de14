"""A request resolved: its files are opened here, once, and entered in its ledger."""

from __future__ import annotations

import contextlib
import dataclasses
import os

from ortho_pipeline.commands.control.crops import open_by_evidence
from ortho_pipeline.commands.control.points import read_control
from ortho_pipeline.commands.heights.opening import gaps_masked, has_surface, open_surface
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.errors import InputError, ModelError, completed
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import states
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import SurfaceOptions
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.footprint import lay


def resolve(request: Request, *, needs_model: bool = True) -> Resolved:
    """Open the scene of a request, its heights, its points and the raster that gives the grid.

    Points, heights and matches decide whether the model of a crop belongs to it.

    Parameters
    ----------
    needs_model : bool
        Whether an image without a model of its own is an error.

    Raises
    ------
    InputError
        If a file cannot be opened or contradicts an option.
    """
    begun = states(path for _, path in request.files)
    scene = open_by_evidence(request, needs_model=needs_model)
    surface = None
    if has_surface(request.surface):
        surface = open_surface(_heights_of(request), request.scene, request.output.memory, [scene])
    ledger = Ledger.of(request, scene, surface, begun)
    scene = on_surface(scene, surface)
    return Resolved(request, scene, surface, read_control(scene, request, surface), _grid_like(request), ledger)


def _heights_of(request: Request) -> SurfaceOptions:
    """Return the options of heights. A true ortho has empty pixels anyway: so it has where the DSM has gaps."""
    return gaps_masked(request.surface) if request.output.visibility == "nodata" else request.surface


def on_surface(scene: Scene, surface: Surface | None) -> Scene:
    """Return the scene with models that are meant for the heights under it, where their own range is but a guess."""
    if surface is None:
        return scene
    models = dict(scene.models)
    for name, model in models.items():
        if model.with_heights(*model.height_range) is model:
            continue
        # A model that only starts an adjustment may look anywhere.
        with contextlib.suppress(ModelError, InputError):
            models[name] = lay(model, surface, scene.width, scene.height).fitted(model)
    return dataclasses.replace(scene, models=models)


def _grid_like(request: Request) -> Grid | None:
    """Return the grid of the raster that an ortho is to match; None where none is given."""
    output = request.output
    if output.like is None:
        return None
    conflicts = [name for name in ("crs", "resolution", "extent", "align") if getattr(output, name)]
    if conflicts:
        raise InputError(
            Text(Setting("output.like"), " sets the grid, which ", Setting(f"output.{conflicts[0]}"), " would change"),
            field=f"output.{conflicts[0]}",
            remedy="leave out one of them",
        )
    with completed(os.fspath(output.like), field="output.like"):
        return grid_of(output.like, **request.scene.access)
