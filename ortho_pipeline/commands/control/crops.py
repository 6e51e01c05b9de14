"""Whether the model of a crop belongs to the crop or to the larger image, by what a command is given.

What the image itself shows, `exchange.crop` has looked at before.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.control.matching import match_scene
from ortho_pipeline.commands.control.points import read_control
from ortho_pipeline.commands.heights.automatic import AUTO
from ortho_pipeline.commands.heights.opening import has_surface, open_surface
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.crop import UndecidedCrop, nearer, noted_offset
from ortho_pipeline.files.locations import Location
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.surface.dem import DemSurface

#: Pixels per side of the grid that is looked for on a DEM, and the part of them that has to be on it.
_GRID, _ON_DEM = 9, 0.5
#: Part of the points that has to be within the crop: others were measured in the larger image.
_WITHIN = 0.5


def open_by_evidence(request: Request, *, needs_model: bool = True) -> Scene:
    """Open the scene of a request; a crop whose model may be of the larger image is settled by points, DEM or matches.

    Raises
    ------
    UndecidedCrop
        If nothing that is given decides.
    InputError
        As opening the scene and reading the points do.
    """
    try:
        return inputs.open_image(request.image, request.scene, needs_model=needs_model)
    except UndecidedCrop as undecided:
        decided = (
            _by_points(undecided, read_control(undecided.scene, request))
            or _by_heights(undecided, request.surface, request.scene)
            or _by_matches(undecided, request)
        )
        if decided is None:
            raise
        return undecided.settled(*decided)


def settled_options(
    images: Sequence[str | os.PathLike[str]],
    scenes: Sequence[SceneOptions],
    surface: SurfaceOptions,
    points: Callable[[int], Points | None] = lambda _: None,
) -> tuple[list[SceneOptions], list[Notice]]:
    """Return the options of images of a block with the offsets of crops that points or heights settle, and notices.

    Parameters
    ----------
    points : callable(number)
        Returns the points of an image (only those with known ground count); None without any.

    Raises
    ------
    UndecidedCrop
        If nothing that is given decides.
    """
    settled, notices = list(scenes), []
    for number, (image, options) in enumerate(zip(images, scenes, strict=True)):
        # Few images are crops: they alone are opened once more.
        if options.crop_offset is not None or noted_offset(open_dataset(image, **options.access)) is None:
            continue
        try:
            inputs.open_image(image, options, needs_model=False)
        except UndecidedCrop as undecided:
            table = points(number)
            decided = None if table is None else _by_points(undecided, table)
            decided = decided or _by_heights(undecided, surface, options)
            if decided is None:
                raise
            notices.append(undecided.settled(*decided).notices[-1].in_image(os.fspath(image)))
            settled[number] = replace(options, crop_offset=undecided.offset if decided[0] else (0.0, 0.0))
    return settled, notices


def _by_points(undecided: UndecidedCrop, points: Points) -> tuple[bool, str] | None:
    """Return whether to move the model, by the median distance of points from their predicted positions."""
    scene = undecided.scene
    known = points.select(np.isfinite(points.ground[:, :2]).all(axis=1))
    inside = ((known.image >= 0) & (known.image <= (scene.width, scene.height))).all(axis=1)
    if not len(known) or inside.mean() < _WITHIN:
        return None
    ground = np.where(np.isnan(known.ground), [0.0, 0.0, scene.model.reference_height], known.ground)
    seen = scene.model.ground_to_image(ground_transform(known.crs, scene.model.crs)(ground))
    off = (known.image - seen)[np.isfinite(seen).all(axis=1)]
    return _by_distance(undecided, np.median(off, axis=0), "points") if len(off) else None


def _by_heights(undecided: UndecidedCrop, surface: SurfaceOptions, options: SceneOptions) -> tuple[bool, str] | None:
    """Return whether to move the model, if the DEM covers the crop for only one of both positions."""
    if surface.dem is None or surface.dem == AUTO or Location(surface.dem).is_collection:
        return None
    heights = open_surface(surface, options)
    assert isinstance(heights, DemSurface)
    kept, moved = (_share_on(heights, scene) for scene in undecided.both)
    if min(kept, moved) > 0.0 or max(kept, moved) < _ON_DEM:
        return None
    return moved > kept, "the DEM lies there"


def _share_on(heights: DemSurface, scene: Scene) -> float:
    """Return the share of the pixels of a scene that lie on a DEM."""
    sides = (np.linspace(0, side, _GRID) for side in (scene.width, scene.height))
    image = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    model = scene.model
    ground = ground_transform(model.crs, "EPSG:4979")(model.image_to_ground(image, model.reference_height))
    seen = np.isfinite(ground).all(axis=1)
    return heights.coverage(ground[seen, :2], "EPSG:4979") * float(seen.mean()) if seen.any() else 0.0


def _by_matches(undecided: UndecidedCrop, request: Request) -> tuple[bool, str] | None:
    """Return whether to move the model, by matching with the reference."""
    if not request.match.reference or not has_surface(request.surface):
        return None
    for is_moved, scene in zip((False, True), undecided.both, strict=True):
        try:
            heights = open_surface(request.surface, request.scene, under=[scene])
            shift = match_scene(scene, request.match, heights, request.scene).shift
        except InputError:
            continue
        # Measured minus predicted, by the model as it was read.
        off = shift - undecided.offset if is_moved else shift
        if decided := _by_distance(undecided, off, "matches"):
            return decided
    return None


def _by_distance(undecided: UndecidedCrop, off: np.ndarray, what: str) -> tuple[bool, str] | None:
    """Return whether to move the model, from measured minus predicted positions."""
    kept, moved = float(np.hypot(*off)), float(np.hypot(*(off + undecided.offset)))
    decided = nearer(kept, moved, undecided.offset)
    return None if decided is None else (decided, f"its {what} are there")
