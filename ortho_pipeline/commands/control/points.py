"""Points as a command takes them: read or matched, with their roles, in a scene's own pixels, with heights."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.commands.control.matching import Matched, match_scene
from ortho_pipeline.commands.resolved.request import OWN_POINTS, Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.errors import InputError, of_option
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files.locations import located
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.hookspecs import Piece, Scene
from ortho_pipeline.options import MatchOptions, PointOptions
from ortho_pipeline.points import Points, assign_roles, gcps_of_dataset, points_of
from ortho_pipeline.points.formats import read_table
from ortho_pipeline.points.rows import OWN_IMAGE
from ortho_pipeline.points.selection import select_control
from ortho_pipeline.raster import source as raster
from ortho_pipeline.surface.base import Surface

#: Options that have no effect without a reference.
_OF_MATCHING = ("reference_bands", "search", "search_rotation", "points", "reference_sigma", "gcps_as")


def control_of(resolved: Resolved) -> tuple[Points, Matched | None]:
    """Return the control and check points of a scene: of a file, matches with a reference, or both.

    With matches, points of a file are check points; if the user wants it, they keep the roles of their file.

    Raises
    ------
    InputError
        As `match_scene`, and for points without heights.
    """
    request, surveyed = resolved.request, resolved.points
    match, output = request.match, request.output
    if not match.reference:
        return surveyed, None
    matched = match_scene(resolved.scene, match, resolved.surface, request.scene, output.threads, output.memory)
    points = matched.matches.points
    if request.points.gcps is None:
        return points, matched
    if match.gcps_as == "check":
        surveyed = surveyed.with_roles(np.where(surveyed.control, "check", surveyed.roles))
    return _joined(with_heights(surveyed, resolved.surface), points), matched


def refuse_contradictions(points: PointOptions, match: MatchOptions) -> None:
    """Refuse options of points and matching that contradict each other, or have no effect.

    Raises
    ------
    InputError
        With the option.
    """
    if not match.reference:
        _refuse_idle(match, _OF_MATCHING, "this option is for matching, and no reference is given", "match.reference")
        if points.gcps is None and points.correction not in (None, "none"):
            raise InputError(
                f"the correction {points.correction!r} needs control points",
                field="points.gcps",
                remedy=Text(
                    "give a file of points, match an orthoimage (",
                    Setting("match.reference"),
                    "), or leave out ",
                    Setting("points.correction"),
                ),
            )
        if points.gcps is None:
            names = [one.name for one in fields(points) if one.name not in ("gcps", "correction")]
            _refuse_idle(points, names, "this option is for control points, and none are given", "points.gcps")
        return
    chosen = next((name for name in ("select", "check") if getattr(points, name) is not None), None)
    if chosen is not None and points.gcps is None:
        raise InputError(
            Text(Setting(f"points.{chosen}"), " selects from ", Setting("points.gcps"), ", which is not given"),
            field=f"points.{chosen}",
            remedy="leave it out; the matches in every fifth cell of the image are check points already",
        )
    if chosen is not None and match.gcps_as == "check":
        raise InputError(
            Text(Setting(f"points.{chosen}"), " selects control points, but these points are all check points"),
            field=f"points.{chosen}",
            remedy=Text("leave it out, or give ", Setting("match.gcps_as", "control")),
        )


def _refuse_idle(options: PointOptions | MatchOptions, names: Iterable[str], why: str, needed: str) -> None:
    """Refuse options that have no effect without another one, `needed`.

    Raises
    ------
    InputError
        With the option.
    """
    group = needed.partition(".")[0]
    for name in names:
        if getattr(options, name) != getattr(type(options), name):
            raise InputError(why, field=f"{group}.{name}", remedy=Text("leave it out, or give ", Setting(needed)))


def _joined(surveyed: Points, matches: Points) -> Points:
    """Return points of a file and matches as one table, in the CRS of the matches."""
    surveyed = surveyed.to_crs(matches.crs)
    prefix = ""
    while any(prefix + name in surveyed.ids for name in matches.ids):
        prefix += "m"
    groups = np.where(matches.groups >= 0, matches.groups + surveyed.groups.max(initial=-1) + 1, -1)

    def both(name: str) -> np.ndarray:
        return np.concatenate([getattr(surveyed, name), getattr(matches, name)])

    return Points(
        ids=(*surveyed.ids, *(prefix + name for name in matches.ids)),
        image=both("image"),
        ground=both("ground"),
        roles=both("roles"),
        sigma_image=both("sigma_image"),
        sigma_ground=both("sigma_ground"),
        crs=matches.crs,
        source=f"{surveyed.source}, {matches.source}",
        covariance_image=both("covariance_image"),
        groups=np.concatenate([surveyed.groups, groups]),
        sigma_common=both("sigma_common"),
        sigma_alike=both("sigma_alike"),
    )


def read_control(scene: Scene, request: Request, surface: Surface | None = None) -> Points:
    """Read the points of a request with their roles; none where none are given.

    `surface` says at which height points lie that were measured in the other image of a bundle, where their file does
    not.

    Raises
    ------
    InputError
        For a wrong file, and roles that contradict each other.
    """
    options = request.points
    if options.gcps is None:
        return no_points()
    points = _given_points(scene, request, surface)
    if options.select is not None and options.check is not None:
        raise InputError(
            Text(Setting("points.select"), " and ", Setting("points.check"), " both choose the check points"),
            field="points.select",
            remedy="use one of them",
        )
    if options.select is not None:
        return select_control(points, options.select)
    return points if options.check is None else assign_roles(points, options.check)


def _given_points(scene: Scene, request: Request, surface: Surface | None) -> Points:
    options, path = request.points, request.point_file
    with of_option("points.crs"):
        crs = None if options.crs is None else parse_crs(options.crs)
    with of_option("points.vertical"):
        vertical = None if options.vertical is None else Vertical.parse(options.vertical)
    origin = options.pixel_origin
    if path is None or os.fspath(path) == OWN_POINTS:
        if origin != "corner" or (path is None and not (crs is vertical is None)):
            raise InputError(
                "these points already state their coordinate system",
                field="points.pixel_origin",
                remedy=Text(
                    "leave out ",
                    Setting("points.pixel_origin"),
                    "; for a table of points also ",
                    Setting("points.crs"),
                    " and ",
                    Setting("points.vertical"),
                ),
            )
        if isinstance(options.gcps, Points):
            return options.gcps
        return gcps_of_dataset(raster.open_dataset(scene.path, **request.scene.access), crs=crs, vertical=vertical)
    pieces = {
        Path(piece.path).name: OWN_IMAGE if piece.sees_apart else (*piece.offset, piece.scale) for piece in scene.pieces
    }
    path = located(path, allow_network=request.scene.allow_network)
    table = read_table(path, os.fspath(scene.path), pieces)
    points = points_of(table, crs, vertical, origin)
    # The same rows in the same order: the table names the image in which each was measured.
    named = np.array([Path(row.image_name).stem.lower() if row.image_name else "" for row in table.rows])
    for piece in scene.pieces:
        if piece.sees_apart:
            points = _taken_over(scene, piece, points, named == Path(piece.path).stem.lower(), surface)
    return points


def _taken_over(
    scene: Scene, piece: Piece, points: Points, there: NDArray[np.bool_], surface: Surface | None
) -> Points:
    """Return points of which some were measured in another image of the acquisition, all in the pixels of the scene.

    By how much the other image's model is off there, the scene's is, in pixels of its own width: what both have in
    common are the errors of orbit and attitude. Their parallax is in the models.
    """
    if piece.model is None or not there.any():
        return points
    ground = with_heights(points, surface).ground if surface is not None else points.ground
    ground = np.where(np.isnan(ground), [0.0, 0.0, scene.model.reference_height], ground)
    ground = ground_transform(points.crs, scene.model.crs)(ground)
    off = points.image - piece.model.ground_to_image(ground)
    image = scene.model.ground_to_image(ground) + off * piece.scale
    lost = there & ~np.isfinite(image).all(axis=1)
    if lost.any():
        raise InputError(
            f"point {points.ids[int(np.argmax(lost))]!r} of {Path(piece.path).name} is not visible in this image",
            file=points.source,
            field="image",
            remedy="remove the point for this image",
        )
    scale = np.where(there, piece.scale, 1.0)
    return replace(
        points,
        image=np.where(there[:, None], image, points.image),
        sigma_image=points.sigma_image * scale,
        covariance_image=points.covariance_image * (scale**2)[:, None, None],
    )


def no_points() -> Points:
    """Return an empty table of points."""
    none = np.zeros(0)
    return Points(
        ids=(),
        image=np.zeros((0, 2)),
        ground=np.zeros((0, 3)),
        roles=np.zeros(0, dtype="<U7"),
        sigma_image=none,
        sigma_ground=np.zeros((0, 3)),
        crs=pyproj.CRS.from_epsg(4326),
        source="",
    )


def with_heights(points: Points, surface: Surface | None) -> Points:
    """Fill missing heights from the surface."""
    missing = ~np.isfinite(points.ground[:, 2])
    if not missing.any():
        return points
    if surface is None:
        names = ", ".join(np.array(points.ids)[missing][:5])
        raise InputError(
            f"{int(missing.sum())} of {counted(len(points), 'point')} have no height ({names})",
            file=points.source,
            field="h",
            remedy=Text("add heights to the file, or give a DEM with ", Setting("surface.dem")),
        )
    ground = points.ground.copy()
    ground[missing, 2] = surface.heights(ground[missing, :2], points.crs)
    return points.with_ground(ground)
