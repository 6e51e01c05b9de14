"""Projects of other programs that an image belongs to: their files, and the axes of their poses.

OpenDroneMap writes poses twice: in east, north, up (``reconstruction.topocentric.json``), and along the axes of the UTM
zone, less the offset in ``odm_georeferencing/coords.txt`` (``reconstruction.json``). A project without both of
``coords.txt`` and the first file does not say which it has. Then the GPS positions in the reconstruction decide: they
are always in east, north, up.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ortho_frame.pose import Shot
from ortho_frame.tables import MAX_JSON_BYTES, shot_of
from ortho_pipeline.plugin import (
    GEOGRAPHIC,
    TOPOCENTRIC,
    Array,
    InputError,
    enu_from_ecef,
    geocentric,
    geodetic,
    ground_transform,
    listing,
    place,
    read_bounded,
    read_json,
)

MAP = "map"
_INTERIOR, _EXTERIOR = (
    re.compile(r".*int_param.*\.ya?ml$", re.I | re.S),
    re.compile(r".*ext_param.*\.geojson$", re.I | re.S),
)
_ZONE = re.compile(r"\s*WGS84 UTM (\d{1,2})([NS])\s*", re.I)
_NUMBER = re.compile(r"-?\d{1,9}(\.\d{0,9})?", re.ASCII)
_REMEDY = "copy the folder opensfm of the project again"
#: Shots whose GPS positions decide.
_MOST = 200


@dataclass(frozen=True)
class ProjectAxes:
    """The axes of a reconstruction: topocentric, or those of a map about a corner (its x, y)."""

    frame: str
    crs: str | None = None
    corner: tuple[float, float] | None = None


def on_map(dataset: Any) -> bool:
    """Return whether a raster is upright on a map grid, as a project's orthophoto and surface models are."""
    grid = dataset.GetGeoTransform(can_return_null=True)
    return bool(dataset.GetProjection()) and grid is not None and grid[2] == grid[4] == 0.0


def reconstruction_of(name: str) -> Path | None:
    """Return the reconstruction of the OpenDroneMap or OpenSfM project that an image belongs to; None without."""
    if not name:
        return None
    try:
        image = place(name)
        folders = [image.parent / "opensfm", image.parent.parent / "opensfm", image.parent, image.parent.parent]
        for folder in folders:
            if (folder / "reconstruction.json").is_file():
                exact = folder / "reconstruction.topocentric.json"
                return exact if exact.is_file() else folder / "reconstruction.json"
    except (OSError, ValueError, InputError):
        pass
    return None


def orthority_of(name: str) -> tuple[Path, Path] | None:
    """Return orthority's files of cameras and orientations next to an image; None unless there is one of each."""
    if not name:
        return None
    try:
        folder = place(name).parent
        cameras, orientations = (listing(folder).matching(pattern) for pattern in (_INTERIOR, _EXTERIOR))
    except (OSError, ValueError, InputError):
        return None
    if len(cameras) != 1 or len(orientations) != 1:
        return None
    return folder / cameras[0], folder / orientations[0]


def shot_in(path: Path, image: Path) -> tuple[Shot, ProjectAxes]:
    """Return the shot of an image in the reconstruction of a project, and the axes of the reconstruction.

    Raises
    ------
    InputError
        If the image has no shot, or the project is not georeferenced.
    """
    state = path.stat()
    document = _document(str(path), state.st_mtime_ns, state.st_size)
    shot = shot_of(path, document, image)
    if path.name != "reconstruction.json":
        return shot, ProjectAxes(TOPOCENTRIC)
    stated = path.parent.parent / "odm_georeferencing" / "coords.txt"
    if stated.is_file():
        return shot, _of_coordinates(stated)
    return shot, _of_positions(document, shot.origin)


@functools.lru_cache(maxsize=2)
def _document(path: str, _modified: int, _size: int) -> Any:
    """Return the document of a file in its present state, once for all images of a block."""
    return read_json(path, MAX_JSON_BYTES, _REMEDY, unique=True)


def _of_coordinates(path: Path) -> ProjectAxes:
    """Return the axes that ``coords.txt`` states: the zone, then the offset east and north."""
    remedy = "copy odm_georeferencing/coords.txt of the project again"
    lines = read_bounded(path, 100_000_000, remedy=remedy)[:4096].decode("ascii", "replace").splitlines()
    zone = _ZONE.fullmatch(lines[0]) if lines else None
    offset = lines[1].split() if len(lines) > 1 else []
    if zone is None or not 1 <= int(zone[1]) <= 60 or len(offset) != 2 or not all(map(_NUMBER.fullmatch, offset)):
        raise InputError("expected 'WGS84 UTM zone', then the offset east and north", file=path, remedy=remedy)
    east, north = map(float, offset)
    return ProjectAxes(MAP, f"EPSG:{326 if zone[2].upper() == 'N' else 327}{int(zone[1]):02d}", (east, north))


def _of_positions(document: Any, origin: tuple[float, float, float]) -> ProjectAxes:
    """Return the axes along which the cameras are nearest to their GPS positions."""
    parts = document if isinstance(document, list) else [document]
    shots = [shot for part in parts for shot in part.get("shots", {}).values() if isinstance(shot, dict)][:_MOST]
    known = [(shot, gps) for shot in shots if _is_triple(gps := shot.get("gps_position"))]
    known = [
        (shot, gps) for shot, gps in known if all(_is_triple(shot.get(key)) for key in ("rotation", "translation"))
    ]
    if not known:
        return ProjectAxes(TOPOCENTRIC)
    centres = np.array([Shot("", "", origin, shot["rotation"], shot["translation"], "").centre for shot, _ in known])
    gps = np.array([position for _, position in known], dtype=np.float64)
    start = np.array([origin])
    on_earth = geodetic(geocentric(start) + gps @ enu_from_ecef(start)[0])
    crs = f"EPSG:{326 if origin[1] >= 0 else 327}{int((origin[0] + 180) // 6) % 60 + 1:02d}"
    to_map = ground_transform(GEOGRAPHIC, crs)
    corner = to_map(start)[0]
    in_map: Array = to_map(on_earth) - corner
    apart = [float(np.median(np.hypot(*(centres - places)[:, :2].T))) for places in (gps, in_map)]
    return (
        ProjectAxes(MAP, crs, (float(corner[0]), float(corner[1]))) if apart[1] < apart[0] else ProjectAxes(TOPOCENTRIC)
    )


def _is_triple(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(isinstance(one, int | float) and not isinstance(one, bool) and abs(one) < 1e7 for one in value)
    )
