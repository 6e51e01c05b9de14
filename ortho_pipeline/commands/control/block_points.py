"""The points of a block as a command takes them: of a file, ties found by matching, matches with references."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.block.points import BlockPoints, joined
from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.block_images import points_of_images
from ortho_pipeline.commands.control.crops import settled_options
from ortho_pipeline.commands.control.matching import match_scene
from ortho_pipeline.commands.control.ties import tie_scenes
from ortho_pipeline.commands.heights.opening import has_surface, open_surface, require_heights
from ortho_pipeline.commands.resolved.opening import on_surface
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files.locations import located
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import BlockOptions, MatchOptions, SceneOptions, SurfaceOptions, numbers_of
from ortho_pipeline.points import Points, assign_roles
from ortho_pipeline.points.heights.datums import datums_apart
from ortho_pipeline.points.heights.spot_heights import read_spot_heights
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface, moved

#: Sigma (m) of the ground of matches: its errors are in the covariances in the image.
_EXACT = 1e-3


@dataclass(frozen=True, eq=False)
class Gathered:
    """The points of a block and their notices; documents, texts and heights of the matching."""

    table: BlockPoints
    notices: list[Notice]
    document: dict[str, Any]
    text: list[str]
    heights: Surface | None = None


def gather(
    images: Sequence[str | os.PathLike[str]],
    labels: Sequence[str],
    scenes: Sequence[SceneOptions],
    options: BlockOptions,
    match: MatchOptions = MatchOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
) -> Gathered:
    """Return the points of images, by label, from the sources in the options.

    Parameters
    ----------
    scenes : sequence of SceneOptions
        How each image is opened.
    surface : SurfaceOptions
        Heights, for matching.

    Raises
    ------
    InputError
        If there are none; as `tie_scenes` and `match_scene`.
    """
    matched = options.ties is not None or bool(match.reference)
    tables, notices, document, text = [], list[Notice](), dict[str, Any](), list[str]()
    heights: Surface | None = None
    if options.points is not None:
        table, notes = read_points(images, labels, options, scenes[0].allow_network, whole=not matched)
        tables.append(table)
        notices += notes
    if matched:
        alone = [inputs.open_scene(image, scene) for image, scene in zip(images, scenes, strict=True)]
        heights = _placed(open_surface(surface, scenes[0], under=alone), options, alone[0])
        opened = {label: on_surface(scene, heights) for label, scene in zip(labels, alone, strict=True)}
        if options.ties is not None:
            tied = tie_scenes(opened, match, heights, scenes[0])
            tables.append(tied.points)
            notices += tied.notices
            document["ties"] = tied.to_json()
            text.append(tied.summary())
        if match.reference:
            matches = _matches(opened, match, heights, scenes[0])
            tables.append(matches.table)
            notices += matches.notices
            document |= matches.document
            text += matches.text
    elif observes(options, surface):
        alone = [inputs.open_scene(image, scene) for image, scene in zip(images, scenes, strict=True)]
        heights = _placed(open_surface(surface, scenes[0], under=alone), options, alone[0])
    if options.points is not None:
        notices += _between_datums(table, heights)
    return Gathered(joined(labels, tables), notices, document, text, heights)


def _between_datums(points: BlockPoints, surface: Surface | None) -> list[Notice]:
    """Return a notice if the heights of known points and of a DEM probably have different datums."""
    known = (points.control | points.check) & np.isfinite(points.ground).all(axis=1)
    if surface is None or not known.any():
        return []
    difference = surface.above(points.ground[known], points.crs)
    return datums_apart(difference[np.isfinite(difference)], points.ground[known], points.crs)


def settled_scenes(
    images: Sequence[str | os.PathLike[str]],
    labels: Sequence[str],
    scenes: Sequence[SceneOptions],
    options: BlockOptions,
    surface: SurfaceOptions = SurfaceOptions(),
) -> tuple[list[SceneOptions], list[Notice]]:
    """Return the options of images, with the offset of crops that points or DEM decide, and notices.

    Raises
    ------
    UndecidedCrop
        If neither settles it.
    """

    def points_in(number: int) -> Points | None:
        if options.points is None:
            return None
        table, _ = read_points(images, labels, options, scenes[number].allow_network, whole=False)
        return table.in_image(labels[number])

    return settled_options(images, scenes, surface, points_in)


def refuse_contradictions(
    options: BlockOptions, match: MatchOptions, surface: SurfaceOptions, *, orthos: bool = False
) -> None:
    """Refuse options that contradict each other, before any file is opened.

    Parameters
    ----------
    orthos : bool
        Whether orthos are made, which need heights.

    Raises
    ------
    InputError
        If there is no source of points, heights that matching needs are missing, or an option has no effect.
    """
    if options.points is None and options.ties is None:
        raise InputError(
            "no points connect the images",
            field="points.points",
            remedy=Text(
                "give measured points with ",
                Setting("points.points", "FILE"),
                ", or ",
                Setting("points.ties", "auto"),
                " (and ",
                Setting("surface.dem", "FILE"),
                ") to find tie points by matching",
            ),
        )
    if options.points is None:
        for name in ("gcps", "check", "ground_sigma"):
            if getattr(options, name) is not None:
                raise InputError(
                    "this option is for points that were measured in the images, and none are given",
                    field=f"points.{name}",
                    remedy=Text(
                        "give them with ",
                        Setting("points.points", "FILE"),
                        " (id,image,col,row; a file that also has x,y,h needs no second one), or leave it out",
                    ),
                )
    if options.ties is None and not match.reference:
        for name in ("search", "points"):
            if getattr(match, name) != getattr(MatchOptions, name):
                raise InputError(
                    "this option is for matching, and nothing is matched",
                    field=f"match.{name}",
                    remedy=Text("leave it out, or give ", Setting("points.ties", "auto")),
                )
        if has_surface(surface) and not observes(options, surface) and not orthos:
            raise InputError(
                "heights are used only for matching, and nothing is matched",
                field="surface.dem" if surface.dem is not None else "surface.height",
                remedy=Text("leave them out, or give ", Setting("points.ties", "auto")),
            )
    _refuse_of_heights(options, surface)
    for name in ("reference_bands", "search_rotation", "reference_sigma"):
        if getattr(match, name) is not None and not match.reference:
            raise InputError(
                "this option is for matching with a reference, and none is given",
                field=f"match.{name}",
                remedy=Text("leave it out, or give ", Setting("match.reference")),
            )
    if options.ties is not None or match.reference or orthos:
        require_heights(surface, "orthos need" if orthos else "matching needs")


def _refuse_of_heights(options: BlockOptions, surface: SurfaceOptions) -> None:
    """Refuse options of observed heights if no heights are observed."""
    remedy = Setting("surface.dem") if surface.dem is None else Setting("points.dem_heights", "on")
    for name in ("dem_bias", "dem_correlation", "dem_shift", "dem_shift_sigma", "spot_heights"):
        if getattr(options, name) is not None and not observes(options, surface):
            raise InputError(
                "this option describes DEM heights that are observations, but no heights are observed",
                field=f"points.{name}",
                remedy=Text("leave it out, or give ", remedy),
            )
    for name in ("spot_crs", "spot_vertical"):
        if getattr(options, name) is not None and options.spot_heights is None:
            raise InputError(
                Text(Setting(f"points.{name}"), " needs spot heights, and none are given"),
                field=f"points.{name}",
                remedy=Text("leave it out, or give ", Setting("points.spot_heights", "FILE")),
            )
    shift_of(options)


def shift_of(options: BlockOptions) -> tuple[float, float] | None:
    """Return the stated shift of the DEM (m, east and north), which is applied first; None if none is stated.

    Raises
    ------
    InputError
        If it is neither two numbers nor ``estimate``.
    """
    if options.dem_shift in (None, "estimate"):
        return None
    found = numbers_of(str(options.dem_shift))
    if len(found) != 2 or not np.isfinite(found).all():
        raise InputError(
            f"{options.dem_shift!r} is not a shift",
            field="points.dem_shift",
            remedy="give estimate, or metres east and north, such as 10,-5",
        )
    return found[0], found[1]


def _placed(heights: Surface, options: BlockOptions, scene: Scene) -> Surface:
    """Return heights with the shift that the options state."""
    shift = shift_of(options)
    if shift is None or not isinstance(heights, DemSurface):
        return heights
    if not scene.models:
        rows, columns = heights.shape
        return moved(heights, (*shift, 0.0), np.concatenate(heights.grid.lonlat(*np.array([[columns], [rows]]) / 2)))
    middle = np.array([[scene.width / 2, scene.height / 2]])
    ground = scene.model.image_to_ground(middle, scene.model.reference_height)
    return moved(heights, (*shift, 0.0), ground_transform(scene.model.crs, "EPSG:4979")(ground)[0, :2])


def observes(options: BlockOptions, surface: SurfaceOptions) -> bool:
    """Return whether the heights of a DEM are observations of the ties."""
    return surface.dem is not None and options.dem_heights == "on"


def observed(options: BlockOptions, surface: SurfaceOptions, heights: Surface | None) -> DemHeights | None:
    """Return the heights of a DEM as observations; None without.

    Raises
    ------
    InputError
        For spot heights that cannot be used.
    """
    if not observes(options, surface) or not isinstance(heights, DemSurface):
        return None
    spots = None
    if options.spot_heights is not None:
        spots = read_spot_heights(options.spot_heights, options.spot_crs, options.spot_vertical)
    return DemHeights(
        heights,
        options.dem_bias,
        options.dem_correlation,
        options.dem_shift_sigma,
        spots,
        correct_shift=options.dem_shift == "estimate",
    )


def relative_to_reference(fit: BlockFit, options: BlockOptions, match: MatchOptions) -> list[Notice]:
    """Return a notice if control of a block was matched: its accuracy is relative to the reference."""
    common = fit.common_error
    if not match.reference and common is None:
        return []
    floor, beside = "the accuracy of the reference is not stated", ""
    sigma = None if common is None else float(common.sigmas.max())
    if common is not None and sigma:
        floor = f"the sigmas include its {metres(sigma)} per axis, which all matches have in common"
        if common.value.any():
            east, north = common.value * sigma
            beside = ". The rest of the block shows that the reference is displaced by "
            beside += f"{east:+.2f} m east and {north:+.2f} m north"
    part = "all control points were matched" if options.points is None else "control points were matched"
    text = (
        f"accuracy is relative to the reference, because {part}; {floor}{beside}. An error common to images and "
        "reference cannot be detected"
    )
    if fit.points.groups is not None and not fit.shared_errors:
        text += ". The block is too large to include errors common to neighbouring matches in the sigmas"
    elif len(fit.shared_errors) > 1:
        text += ". The sigmas include errors common to neighbouring matches, estimated separately for each image"
    return [Notice("relative-to-reference", text, reference_sigma_m=sigma, in_sigmas=common is not None)]


def _matches(scenes: Any, match: MatchOptions, surface: Any, opened: SceneOptions) -> Gathered:
    """Return the matches of each scene with the references; none for scenes outside all references."""
    tables: dict[str, Points] = {}
    notices, document, text = list[Notice](), dict[str, Any](), list[str]()
    first: InputError | None = None
    for label, scene in scenes.items():
        try:
            matched = match_scene(scene, match, surface, opened)
        except InputError as error:
            first = first or error
            notices.append(
                Notice("no-matches", Text("not matched with the reference: ", error.message)).in_image(label)
            )
            continue
        points = matched.matches.points
        tables[label] = replace(
            points, ids=tuple(f"{label} {name}" for name in points.ids), sigma_ground=np.full((len(points), 3), _EXACT)
        )
        notices += [notice.in_image(label) for notice in matched.notices]
        document[label] = matched.to_json()
        text.append(f"{label}: {counted(len(points), 'match', 'matches')} with the reference")
    if not tables and first is not None:
        raise first
    return Gathered(BlockPoints.of(tables), notices, {"matching": document}, text)


# -- of a file -------------------------------------------------------------------------------------------------------


def read_points(
    images: Sequence[str | os.PathLike[str]],
    labels: Sequence[str],
    options: BlockOptions,
    allow_network: bool,
    *,
    whole: bool = True,
) -> tuple[BlockPoints, list[Notice]]:
    """Return the points of a file in these images, and notices.

    Parameters
    ----------
    whole : bool
        Each of the images has to have points.

    Raises
    ------
    InputError
        For a wrong file, or if there is none.
    """
    if options.points is None:
        raise InputError("no points given", field="points.points", remedy="give a file of points")
    read = read_block_points(
        located(options.points, allow_network=allow_network),
        gcps=None if options.gcps is None else located(options.gcps, allow_network=allow_network),
        crs=None if options.crs is None else parse_crs(options.crs),
        vertical=None if options.vertical is None else Vertical.parse(options.vertical),
        pixel_origin=options.pixel_origin,
    )
    table, strangers = points_of_images(read, images, labels, whole=whole)
    if options.check is not None:
        table = assign_roles(table, options.check)
    if options.ground_sigma is not None:
        table = table.with_ground_sigma(*_sigmas(options.ground_sigma))
    notes = []
    if strangers:
        text = f"skipped the points of images that are not in the block: {', '.join(strangers[:10])}"
        notes.append(Notice("images-not-given", text, images=strangers[:10]))
    flat = table.control & ~np.isfinite(table.ground[:, 2])
    if flat.any():
        names = np.array(table.ids)[flat][:10].tolist()
        text = (
            f"control points without a height count in plan only, unless a DEM gives their height: {', '.join(names)}"
        )
        notes.append(Notice("control-without-height", text, points=names))
    return table, notes


def _sigmas(text: str) -> list[float]:
    """Return the sigmas of ``XY`` or ``XY,H``."""
    sigmas = numbers_of(text)
    if len(sigmas) not in (1, 2) or not all(sigma > 0 for sigma in sigmas):
        raise InputError(
            f"{text!r} is neither one nor two positive numbers",
            field="points.ground_sigma",
            remedy="give the sigma in plan, or in plan and height, in metres, such as 0.5,1",
        )
    return sigmas
