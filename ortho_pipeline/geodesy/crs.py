"""Coordinate systems, height datums, and the transformations between them.

Heights inside the package are metres above the WGS84 ellipsoid, for any horizontal CRS: a point in the Belgian Lambert
grid has the same height as in WGS84. Only a vertical datum (`Vertical`) changes a height, and only when a file is read.

Every transformation uses ``only_best`` and no ballpark operations. Otherwise PROJ would leave heights unchanged,
without an error, if a geoid grid is not installed. PROJ's network access is off, so results depend only on files.
"""

from __future__ import annotations

import functools
import itertools
import json
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import Transformer

from ortho_pipeline.errors import CrsError, DatumError, OrthoError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.geodesy.crs_gate import refuse_files
from ortho_pipeline.geodesy.geoid_grid import header_fault, refuse_absurd, refuse_unread
from ortho_pipeline.geodesy.missing_grids import grid_of_message, grid_remedy, unavailable_grids, warn_of_better

Array = NDArray[np.float64]

#: Where systems keep PROJ's grids; wheels of pyproj look into none of these.
SYSTEM_FOLDERS = ("/usr/share/proj", "/usr/local/share/proj", "/opt/homebrew/share/proj", f"{sys.prefix}/share/proj")
#: Short names of height datums on the command line.
VERTICAL_NAMES = {"ellipsoid": "ellipsoid", "egm96": "EPSG:5773", "egm2008": "EPSG:3855", "egm84": "EPSG:5798"}
VERTICAL_FORMS = "ellipsoid, egm96, egm2008, EPSG:n of a vertical CRS, or a geoid grid file (.gtx, .tif)"
_GRID_SUFFIXES = {".gtx", ".tif", ".tiff", ".byn", ".isg", ".gri"}
_BARE_NAME = re.compile(r"\w[\w.-]*")
_WGS84_SEMI_MAJOR = 6378137.0
#: Realisations differ by less (m). Other datums on an ellipsoid of the same size by 4 to 80 m (GGRS87, VN-2000).
_REALISATIONS = 3.0
#: How WKT, PROJJSON and PROJ strings begin. PROJ seeks anything else by its name, for a quarter of a second.
_STATED = re.compile(r"(?:\{|[A-Za-z]\w{0,40}\s*[\[(]|\+?\s*(?:proj|init|title)\s*=|\+?\w+\s*=.*\bproj\s*=)", re.DOTALL)
#: Codes, URNs and names: the longest name in PROJ's database has 106 characters.
_NAME = re.compile(r"[\w ,.:/&@'()\[\]+–-]{1,200}( = \w+)?")


def add_system_grids() -> tuple[str, ...]:
    """Append the system's PROJ data folders to pyproj's search path; return the whole path.

    The folders named by ``PROJ_DATA`` and ``PROJ_LIB`` come first, and the folder of the wheel, which holds the
    matching ``proj.db``, stays ahead of all. Calling it again changes nothing.
    """
    present = pyproj.datadir.get_data_dir().split(os.pathsep)
    named = [os.environ.get(key, "") for key in ("PROJ_DATA", "PROJ_LIB")]
    for folder in [*os.pathsep.join(named).split(os.pathsep), *SYSTEM_FOLDERS]:
        if folder and folder not in present and Path(folder).is_dir():
            pyproj.datadir.append_data_dir(folder)
            present.append(folder)
    pyproj.network.set_network_enabled(False)
    return tuple(present)


add_system_grids()


# -- coordinate systems ----------------------------------------------------------------------------------------------


def parse_crs(text: str | pyproj.CRS) -> pyproj.CRS:
    """Return the CRS that `text` states: ``EPSG:n``, WKT, PROJ string or a `pyproj.CRS`.

    Raises
    ------
    CrsError
        If it is not a coordinate system, or names a file by its path.

    Examples
    --------
    >>> parse_crs("EPSG:32633").name
    'WGS 84 / UTM zone 33N'
    """
    if isinstance(text, pyproj.CRS):
        return text
    try:
        refuse_files(text if isinstance(text, str) else json.dumps(text))
        # Without the blanks around it: a pattern with them would try each of them as the beginning.
        if isinstance(text, str) and not _STATED.match(text.strip()) and not _NAME.fullmatch(text.strip()):
            raise ValueError("not a name, a code or a definition of a CRS")
        return pyproj.CRS.from_user_input(text)
    except (CRSError, ProjError, ValueError, TypeError, RecursionError) as error:
        shown = str(text) if len(str(text)) < 80 else f"{str(text)[:80]}..."
        raise CrsError(
            f"{shown!r} is not a coordinate system", field="CRS", remedy="give EPSG:n, WKT or a PROJ string"
        ) from error


@functools.lru_cache(maxsize=64)  # PROJ takes some milliseconds, which a fit of 20 points would mostly consist of
def horizontal(crs: str | pyproj.CRS) -> pyproj.CRS:
    """Return the two-dimensional part of a compound or 3D system.

    Raises
    ------
    CrsError
        If the system has no horizontal part (vertical or geocentric).
    """
    crs = parse_crs(crs)
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    if crs.is_vertical or crs.is_geocentric:
        raise CrsError(
            f"{crs.name!r} has no horizontal coordinates", field="CRS", remedy="give a geographic or a projected CRS"
        )
    return crs.to_2d() if len(crs.axis_info) > 2 else crs


def map_crs(text: str | pyproj.CRS) -> pyproj.CRS:
    """Return the CRS that `text` states for a map that is written to a GeoTIFF.

    Raises
    ------
    CrsError
        If it has no horizontal coordinates, or only PROJ knows it, so that no file could store it.
    """
    crs = parse_crs(text)
    remedy = "give a geographic or a projected CRS, such as EPSG:n"
    try:
        plain = horizontal(crs)
    except CrsError as error:
        raise CrsError(error.message, field="output.crs", remedy=remedy) from error
    operation = plain.coordinate_operation
    if "Derived" in plain.type_name or (operation is not None and operation.method_name.startswith("PROJ ")):
        raise CrsError(f"a GeoTIFF cannot store the CRS {plain.to_string()!r}", field="output.crs", remedy=remedy)
    return crs


def utm_crs(lon: float, lat: float) -> pyproj.CRS:
    """Return the WGS84 UTM zone of a position in degrees; polar stereographic (UPS) beyond 84 N and 80 S."""
    if not (np.isfinite(lon) and np.isfinite(lat) and abs(lat) <= 90 and abs(lon) <= 540):
        raise CrsError(f"longitude {lon}, latitude {lat} is not on Earth", field="position")
    if lat > 84 or lat < -80:
        return pyproj.CRS.from_epsg(5041 if lat > 0 else 5042)
    zone = int(((lon + 180) % 360) // 6) + 1
    return pyproj.CRS.from_epsg((32600 if lat >= 0 else 32700) + zone)


def same_crs(first: pyproj.CRS, second: pyproj.CRS) -> bool:
    """Return whether two CRSs are equal, for any order of their axes (x is always first here).

    >>> same_crs(parse_crs("EPSG:4326"), parse_crs("OGC:CRS84"))
    True
    """
    return bool(first == second or first.equals(second, ignore_axis_order=True))


# -- heights ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vertical:
    """A height datum: ``ellipsoid``, a vertical CRS (``EPSG:n``), or a geoid grid file.

    Parameters
    ----------
    name : str
        One of these. Create it with `parse`, which checks it.

    Examples
    --------
    >>> Vertical.parse("egm96").label
    'EGM96 height (EPSG:5773)'
    """

    name: str

    @classmethod
    def parse(cls, text: str | Vertical) -> Vertical:
        """Return the height datum that `text` names (see `VERTICAL_FORMS`).

        Raises
        ------
        DatumError
            If it names none, or a grid file that cannot be read.
        """
        if isinstance(text, Vertical):
            return text
        plain = text.strip()
        if plain.lower() in VERTICAL_NAMES:
            return cls(VERTICAL_NAMES[plain.lower()])
        if re.fullmatch(r"(?i)[a-z]+:[\d+]+", plain):
            return _vertical_of_code(plain.upper())
        if Path(plain).suffix.lower() in _GRID_SUFFIXES:
            path = Path(plain)
            grid = cls(str(path.resolve()) if path.exists() else plain)
            vertical_transformer(grid.name)
            return grid
        raise DatumError(f"{plain!r} is not a height datum", field="vertical", remedy=f"give {VERTICAL_FORMS}")

    @classmethod
    def stated(cls, text: str) -> Vertical:
        """Return the height datum that a file states: as `parse`, but a path of a grid is an error."""
        name = text.strip()
        if Path(name).suffix.lower() not in _GRID_SUFFIXES:
            return cls.parse(name)
        if not _BARE_NAME.fullmatch(name):
            raise DatumError(
                f"a file refers to the geoid grid {name[:80]!r} by its path; such paths are not opened",
                field="vertical",
                remedy=Text("give the grid as ", Setting("points.vertical", "FILE")),
            )
        vertical_transformer(name)
        return cls(name)

    @property
    def is_ellipsoid(self) -> bool:
        """True if heights are above the ellipsoid already."""
        return self.name == "ellipsoid"

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        if self.is_ellipsoid:
            return "WGS84 ellipsoid"
        if self.name.startswith("EPSG:"):
            return f"{pyproj.CRS.from_user_input(self.name).name} ({self.name})"
        return f"geoid grid {Path(self.name).name}"

    @property
    def metres_per_unit(self) -> float:
        """Length of the unit of its heights: that of the vertical CRS; 1 for the ellipsoid and for geoid grids.

        >>> Vertical.parse("EPSG:8228").metres_per_unit  # NAVD88 height (ft)
        0.3048
        """
        if not self.name.startswith("EPSG:"):
            return 1.0
        return float(pyproj.CRS.from_user_input(self.name).axis_info[0].unit_conversion_factor)

    def ellipsoidal(self, lon: ArrayLike, lat: ArrayLike, heights: ArrayLike) -> Array:
        """Return ellipsoidal heights (m) ``(N,)`` of heights in the unit of this datum; NaN and errors as `undulation`.

        >>> Vertical.parse("ellipsoid").ellipsoidal([33.0], [37.0], [800.0])
        array([800.])
        """
        return np.asarray(np.asarray(heights, dtype=float) * self.metres_per_unit + self.undulation(lon, lat))

    def undulation(self, lon: ArrayLike, lat: ArrayLike) -> Array:
        """Return the height (m) of the datum's zero above the WGS84 ellipsoid: ``h = H + undulation``.

        Parameters
        ----------
        lon, lat : array_like, shape (N,)
            Position in degrees; longitude may run over 180.

        Returns
        -------
        ndarray, shape (N,)
            NaN where the position is NaN or outside the grid.

        Raises
        ------
        DatumError
            If the grid is not installed, or gives impossible heights.
        """
        lon, lat = np.broadcast_arrays(np.asarray(lon, dtype=float), np.asarray(lat, dtype=float))
        if self.is_ellipsoid:
            return np.where(np.isfinite(lon) & np.isfinite(lat), 0.0, np.nan)
        transformer = vertical_transformer(self.name)
        try:
            shift = np.array(transformer.transform(lon, lat, np.zeros(lon.shape))[2], dtype=float)
        except ProjError as error:
            raise _grid_error(self, str(error)) from error
        shift[~np.isfinite(shift)] = np.nan
        refuse_absurd(shift, self.name)
        if not self.name.startswith("EPSG:"):
            refuse_unread(transformer, lon, lat, shift, self.name)
        known = np.isfinite(lon) & np.isfinite(lat)
        if known.any() and not np.isfinite(shift).any() and self.name.startswith("EPSG:"):
            # PROJ picks among several operations per point, and answers inf, not an error, where none has its grid.
            missing = unavailable_grids(_compound(self.name), "EPSG:4979")
            if missing:
                raise _grid_error(self, f"Grid {missing[0]} is not available")
        return shift


def _vertical_of_code(code: str) -> Vertical:
    try:
        crs = pyproj.CRS.from_user_input(code)
    except CRSError as error:
        raise DatumError(f"{code} does not exist", field="vertical", remedy=f"give {VERTICAL_FORMS}") from error
    # pyproj calls a compound of a geographic and a vertical system geographic too.
    if crs.is_geographic and len(crs.axis_info) == 3 and not crs.is_compound:
        return Vertical("ellipsoid")
    part = crs.sub_crs_list[1] if crs.is_compound else crs
    authority = part.to_authority()
    if not part.is_vertical or authority is None or authority[0] != "EPSG":
        raise DatumError(
            f"{code} ({crs.name}) is not a vertical CRS of EPSG", field="vertical", remedy=f"give {VERTICAL_FORMS}"
        )
    if part.axis_info[0].direction.lower() != "up":
        raise DatumError(f"{code} ({crs.name}) gives depths, not heights", field="vertical")
    return Vertical(":".join(authority))


def _compound(name: str) -> str:
    return f"EPSG:4326+{name.removeprefix('EPSG:')}"


@functools.lru_cache(maxsize=32)
def vertical_transformer(name: str) -> Transformer:
    """Return the transformation of heights from a datum to the ellipsoid (pyproj keeps one per thread inside)."""
    try:
        if name.startswith("EPSG:"):
            return Transformer.from_crs(
                _compound(name), "EPSG:4979", always_xy=True, only_best=True, allow_ballpark=False
            )
        # PROJ looks for bare names in its own folders only.
        if Path(name).is_absolute() and (fault := header_fault(Path(name))):
            raise _grid_error(Vertical(name), fault)
        if set(name) & {",", '"'}:
            raise DatumError(
                "PROJ cannot read a grid whose path contains a comma or a quotation mark", file=name, remedy="rename it"
            )
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f'+step +proj=vgridshift +grids="{name}" +multiplier=1 '
            "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
    except (ProjError, CRSError) as error:
        raise _grid_error(Vertical(name), str(error)) from error


def _grid_error(vertical: Vertical, message: str) -> DatumError:
    if not vertical.name.startswith("EPSG:"):
        exists = Path(vertical.name).exists()
        return DatumError(
            "PROJ cannot read this file as a geoid grid" if exists else "this geoid grid does not exist",
            file=vertical.name,
            field="vertical",
            remedy="give a .gtx or GeoTIFF geoid grid, or only its name if it is in PROJ's search path",
        )
    grid = grid_of_message(message)
    if grid is None:
        return DatumError(
            f"there is no transformation from {vertical.label} to the ellipsoid",
            field="vertical",
            remedy="give a geoid grid file of this datum instead",
        )
    return DatumError(
        f"heights in {vertical.label} need the geoid grid {grid}, which is not installed",
        field="vertical",
        remedy=grid_remedy(grid, "or give a geoid grid file (.gtx, .tif) instead of the datum's name"),
    )


# -- ground to ground ------------------------------------------------------------------------------------------------


class GroundTransform:
    """Transforms ground points ``(N, 3)`` from one CRS to another; heights are ellipsoidal metres on both sides.

    A CRS on a modern ellipsoid is promoted to 3D, so small differences between realisations enter the height. A CRS on
    a classical ellipsoid (Bessel, Airy, Hayford ...), or on a modern one about another centre, keeps the WGS84 height,
    because heights are not measured above such ellipsoids. Geocentric CRSs are allowed on either side.

    Instances can be pickled, and shared between threads.

    Parameters
    ----------
    source, target : str or pyproj.CRS
        Only the horizontal part of a compound or 3D CRS is used.

    Raises
    ------
    CrsError
        If there is no transformation, or the grid of the best one is not installed.
    """

    def __init__(self, source: str | pyproj.CRS, target: str | pyproj.CRS) -> None:
        self.source, self.target = parse_crs(source), parse_crs(target)
        first, last = _ground_crs(self.source), _ground_crs(self.target)
        self._legs: list[tuple[Transformer, str]] = []
        self._checked = False
        if same_crs(first, last):
            return
        middle = [pyproj.CRS.from_epsg(4326)] if first.is_geocentric or last.is_geocentric else []
        for one, other in itertools.pairwise([first, *middle, last]):
            geocentric, modern = one.is_geocentric or other.is_geocentric, _is_modern(one) and _is_modern(other)
            ends = (_promoted(one), _promoted(other)) if geocentric or modern else (one, other)
            if not same_crs(one, other):
                self._legs.append(
                    (_transformer(*ends), "all" if geocentric else "plan and height" if modern else "plan")
                )

    def __reduce__(self) -> tuple[Any, ...]:
        return GroundTransform, (self.source, self.target)

    @property
    def is_identity(self) -> bool:
        """True if points come back unchanged."""
        return not self._legs

    def __call__(self, ground: ArrayLike) -> Array:
        """Transform points ``(N, 3)``; rows that are not finite or cannot be transformed come back as NaN."""
        out = np.array(ground, dtype=float, ndmin=2)
        out[~np.isfinite(out).all(axis=1)] = np.nan
        for transformer, kind in self._legs:
            before = out
            out = self._leg(transformer, kind, before)
            self._check(transformer, kind, before, out)
        return out

    @staticmethod
    def _leg(transformer: Transformer, kind: str, ground: Array, errcheck: bool = False) -> Array:
        x, y, h = (np.ascontiguousarray(column) for column in ground.T)
        if kind == "plan":
            out = np.column_stack([*transformer.transform(x, y, errcheck=errcheck), h])
        else:
            out = np.column_stack(transformer.transform(x, y, h, errcheck=errcheck))
        if kind == "plan and height":
            far = np.abs(out[:, 2] - h) > _REALISATIONS
            out[far, 2] = h[far]
        out[~np.isfinite(out).all(axis=1)] = np.nan
        return out

    def _check(self, transformer: Transformer, kind: str, before: Array, after: Array) -> None:
        """Tell a missing grid from points out of range, once, on the first finite point."""
        finite = np.isfinite(before).all(axis=1)
        if self._checked or not finite.any():
            return
        arrived = np.isfinite(after).all(axis=1)
        if arrived.any():
            self._checked = True
            if not self.target.is_geocentric and transformer.accuracy < 0:
                warn_of_better(transformer, self.source, self.target, after[arrived][0])
            return
        sample = before[finite][:1]
        try:
            self._leg(transformer, kind, sample, errcheck=True)
        except ProjError as error:
            grid = grid_of_message(str(error))
            if grid is None and "No operation" in str(error):
                grid = next(iter(unavailable_grids(self.source, self.target)), None)
            if grid is not None:
                raise _way_error(self.source, self.target, grid) from error


def _ground_crs(crs: pyproj.CRS) -> pyproj.CRS:
    return crs if crs.is_geocentric else horizontal(crs)


def _is_modern(crs: pyproj.CRS) -> bool:
    return crs.ellipsoid is not None and abs(crs.ellipsoid.semi_major_metre - _WGS84_SEMI_MAJOR) < 1.0


def _promoted(crs: pyproj.CRS) -> pyproj.CRS:
    return crs if crs.is_geocentric else crs.to_3d()


@functools.lru_cache(maxsize=64)  # 5 ms of PROJ each; a scene asks nine times for two pairs of systems
def _transformer(source: pyproj.CRS, target: pyproj.CRS) -> Transformer:
    try:
        return Transformer.from_crs(source, target, always_xy=True, only_best=True, allow_ballpark=False)
    except (ProjError, CRSError) as error:
        raise _way_error(source, target, grid_of_message(str(error))) from error


def _way_error(source: pyproj.CRS, target: pyproj.CRS, grid: str | None) -> OrthoError:
    if grid is None:
        return CrsError(
            f"there is no transformation from {source.name!r} to {target.name!r}",
            field="CRS",
            remedy="choose a CRS with a known datum, such as UTM on WGS84",
        )
    return CrsError(
        f"the transformation from {source.name!r} to {target.name!r} needs the grid {grid}, which is not installed",
        field="CRS",
        remedy=grid_remedy(grid, "or choose a CRS on WGS84"),
    )


#: By the texts that systems are made of: a CRS writes its WKT to be hashed.
_made_once = functools.lru_cache(maxsize=64)(GroundTransform)


def ground_transform(source: str | pyproj.CRS, target: str | pyproj.CRS) -> GroundTransform:
    """Return a `GroundTransform`, the same one for the same pair: PROJ takes ten milliseconds to make one.

    Examples
    --------
    >>> ground_transform("EPSG:4979", "EPSG:32636")(np.array([[33.0, 37.0, 500.0]])).round(1).tolist()
    [[500000.0, 4094872.4, 500.0]]
    """
    return _made_once(*(crs if isinstance(crs, str) else crs.srs for crs in (source, target)))
