"""Pairs of points that are one mark on the ground, measured twice."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.points.table import Array

#: Two points closer than this (m) are one mark; no survey has targets so close together.
_ONE_MARK = 0.01


class HasGround(Protocol):
    """A table of points with ground: of one image, or of a block."""

    @property
    def ids(self) -> tuple[str, ...]: ...
    @property
    def ground(self) -> Array: ...
    @property
    def crs(self) -> pyproj.CRS: ...
    @property
    def check(self) -> NDArray[np.bool_]: ...
    def select(self, mask: NDArray[np.bool_], /) -> HasGround: ...


def one_mark(points: HasGround) -> list[tuple[str, str]]:
    """Return pairs of ids of points that are within a centimetre on the ground: one mark that was measured twice.

    In a cluster each point is in one pair, with its nearest neighbour.
    """
    plan = np.isfinite(points.ground[:, :2]).all(axis=1)
    place = np.nan_to_num(points.ground[plan])
    if len(place) < 2:
        return []
    place = ground_transform(points.crs, "EPSG:4978")(place)
    index = np.flatnonzero(plan)[np.isfinite(place).all(axis=1)]
    place = place[np.isfinite(place).all(axis=1)]
    # Near points are near along each axis; with few points this excludes all of them quickly.
    if (np.diff(np.sort(place, axis=0), axis=0) > _ONE_MARK).all(axis=0).any():
        return []
    from scipy.spatial import cKDTree  # loading it takes as long as the warp of a small scene

    distance, neighbour = cKDTree(place).query(place, k=2, distance_upper_bound=_ONE_MARK)
    # For points at the same position, the first neighbour may be the other point.
    other = np.where(neighbour[:, 0] == np.arange(len(place)), neighbour[:, 1], neighbour[:, 0])
    near = np.flatnonzero(np.isfinite(distance).all(axis=1))
    pairs = {(min(index[k], index[other[k]]), max(index[k], index[other[k]])) for k in near}
    return [(points.ids[first], points.ids[second]) for first, second in sorted(pairs)]


def marks_warning(points: HasGround, used: NDArray[np.bool_]) -> list[Notice]:
    """Return warnings if used points ``(N,)`` or check points are one mark: the second one neither adds nor tests."""
    pairs = one_mark(points.select(points.check | used))
    checks = {name for name, check in zip(points.ids, points.check, strict=True) if check}
    tested = [pair for pair in pairs if checks.intersection(pair)]
    added = [pair for pair in pairs if pair not in tested]
    found = []
    for near, who, why in (
        (added, "control points", "counts as two points, so redundancy and sigmas look too good"),
        (tested, "check points and others", "tests nothing, so the accuracy looks too good"),
    ):
        if near:
            shown = ", ".join(f"{first} and {second}" for first, second in near[:5]) + (" ..." if near[5:] else "")
            text = (
                f"{who} are within a centimetre of each other ({shown}). A mark that was measured twice {why}: keep "
                "one point of each pair"
            )
            found.append(Notice("one-mark-twice", text, pairs=[list(pair) for pair in near]))
    return found
