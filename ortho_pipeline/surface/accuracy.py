"""Accuracy of a DEM: its heights compared with check heights, by the slope of the terrain.

An error of the DEM moves a point of an ortho along the line of sight, so every accuracy budget needs it. It increases
with the slope, because a horizontal shift causes an error in height there.

Source: Höhle and Höhle 2009, "Accuracy assessment of digital elevation models by means of robust statistical methods"
(median, NMAD and quantiles in addition to mean and RMSE, because errors of DEMs have long tails).
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.points.ground import ground_of
from ortho_pipeline.points.heights.spot_heights import read_height_table
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface

Array = NDArray[np.float64]

#: Limits (degrees) between the classes of slope.
SLOPES = (5.0, 10.0, 20.0, 30.0)
#: NMAD of a normal distribution is its standard deviation.
_NMAD = 1.4826
#: Differences farther from the median than this many NMAD are listed.
_GROSS = 5.0
#: The 90 % quantile of fewer differences is one of the largest of them, and is not given.
_ENOUGH = 10
#: Places per side at which a raster of standard deviations is looked at for a typical one.
_PLACES = 64


@dataclass(frozen=True)
class HeightErrors:
    """Differences DEM minus check height, in metres; None where there are too few.

    `le90` is the 90 % quantile of their absolute values, which assumes no distribution.
    """

    count: int
    mean: float | None
    rmse: float | None
    median: float | None
    nmad: float | None
    le90: float | None
    largest: float | None

    @classmethod
    def of(cls, differences: Array) -> HeightErrors:
        """Return the statistics of differences ``(N,)``."""
        count = len(differences)
        if not count:
            return cls(0, None, None, None, None, None, None)
        median = float(np.median(differences))
        return cls(
            count=count,
            mean=float(differences.mean()),
            rmse=float(np.sqrt((differences**2).mean())),
            median=median,
            nmad=float(_NMAD * np.median(np.abs(differences - median))) if count > 2 else None,
            le90=float(np.quantile(np.abs(differences), 0.9)) if count >= _ENOUGH else None,
            largest=float(differences[np.argmax(np.abs(differences))]),
        )


@dataclass(frozen=True)
class DemAccuracy:
    """A DEM against check heights.

    Parameters
    ----------
    ids : sequence of str
    differences : (N,)
        DEM minus check height (m); NaN where one of them has no height.
    slopes : (N,)
        Of the DEM at the points, degrees.
    """

    ids: Sequence[str]
    differences: Array
    slopes: Array

    @property
    def overall(self) -> HeightErrors:
        """All points with a height."""
        return HeightErrors.of(self.differences[np.isfinite(self.differences)])

    def by_slope(self) -> list[tuple[float, float | None, HeightErrors]]:
        """Return lower and upper limit (degrees, None: no limit) and the differences of each class of slope."""
        edges = [0.0, *SLOPES, np.inf]
        rows = []
        for low, high in itertools.pairwise(edges):
            inside = (self.slopes >= low) & (self.slopes < high) & np.isfinite(self.differences)
            rows.append((low, None if np.isinf(high) else high, HeightErrors.of(self.differences[inside])))
        return rows

    def gross(self) -> list[str]:
        """Return the points whose difference is far from all others."""
        errors = self.overall
        if errors.nmad is None or errors.median is None:
            return []
        far = np.abs(self.differences - errors.median) > _GROSS * max(errors.nmad, 1e-6)
        return [name for name, out in zip(self.ids, far, strict=True) if out]

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``ortho dem-check --json`` (docs/engineering/formats.md)."""
        points = [
            {"id": name, "difference_m": json_value(difference), "slope_deg": json_value(slope)}
            for name, difference, slope in zip(self.ids, self.differences, self.slopes, strict=True)
        ]
        classes = [{"slope_deg": [low, high], **vars(errors)} for low, high, errors in self.by_slope()]
        return {
            "overall": vars(self.overall),
            "by_slope": classes,
            "gross": self.gross(),
            "without_height": int((~np.isfinite(self.differences)).sum()),
            "points": points,
        }


def check_dem(surface: DemSurface, ground: Array, crs: str | pyproj.CRS, ids: Sequence[str]) -> DemAccuracy:
    """Compare a DEM with check heights.

    Parameters
    ----------
    ground : (N, 3)
        x, y in `crs` and ellipsoidal height (m) of the check points.

    Returns
    -------
    DemAccuracy
        NaN at points where the DEM has no height; they are counted but not used.
    """
    lonlat = ground_transform(parse_crs(crs), "EPSG:4979")(ground)
    surface = surface.with_fill("mask").around(float(np.nanmedian(lonlat[:, 0])))
    differences = -surface.above(np.column_stack([lonlat[:, :2], ground[:, 2]]), "EPSG:4979")
    return DemAccuracy(tuple(ids), differences, slopes_at(surface, lonlat[:, :2]))


def slopes_at(surface: DemSurface, lonlat: Array) -> Array:
    """Return the slope (degrees) ``(N,)`` of a DEM at longitudes and latitudes ``(N, 2)``, over two of its samples."""
    step, geod, count = surface.sample_size, pyproj.Geod(ellps="WGS84"), len(lonlat)

    def away(azimuth: float) -> Array:
        lon, lat, _ = geod.fwd(lonlat[:, 0], lonlat[:, 1], np.full(count, azimuth), np.full(count, step))
        return surface.heights(np.column_stack([lon, lat]), "EPSG:4979")

    rise = np.hypot(away(90.0) - away(270.0), away(0.0) - away(180.0)) / (2 * step)
    return np.degrees(np.arctan(rise))


def typical_sigma(surface: Surface) -> float | None:
    """Return the standard deviation (m) of the heights of a surface, of a raster their root mean square.

    None if it is unknown, or the raster has none.
    """
    sigma = surface.sigma
    if not isinstance(sigma, DemSurface):
        return sigma if isinstance(sigma, float | int) else None
    rows, columns = sigma.shape
    u, v = np.meshgrid(np.linspace(0, columns - 1, _PLACES), np.linspace(0, rows - 1, _PLACES))
    squares = sigma.heights(np.column_stack(sigma.grid.lonlat(u.ravel(), v.ravel())), "EPSG:4979") ** 2
    return float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else None


def read_check_heights(
    path: str | os.PathLike[str], crs: str | None = None, vertical: str | None = None
) -> tuple[Array, pyproj.CRS, tuple[str, ...]]:
    """Read check heights: CSV, GeoJSON or GeoParquet with x, y, h. Other columns are not used.

    Returns
    -------
    ground : (N, 3)
        With ellipsoidal heights.
    crs : pyproj.CRS
    ids : tuple of str

    Raises
    ------
    InputError, CrsError, DatumError
        As `points.read_points`; also if no point has a height.
    """
    table = read_height_table(path)
    ground, plane = ground_of(
        path, table, None if crs is None else parse_crs(crs), None if vertical is None else Vertical.parse(vertical)
    )
    if not np.isfinite(ground[:, 2]).any():
        raise InputError("no point has a height", file=path, field="h", remedy="give the heights of the points")
    return ground, plane, tuple(row.id or row.where for row in table.rows)


def summary(document: dict[str, Any]) -> str:
    """Return the document as text for people."""

    def cells(errors: dict[str, Any]) -> str:
        values = (errors[key] for key in ("mean", "rmse", "median", "nmad", "le90", "largest"))
        return f"{errors['count']:>6}" + "".join(f"{'-' if v is None else f'{v:.2f}':>9}" for v in values)

    lines = [f"{'slope':<12}{'points':>6}{'mean':>9}{'RMSE':>9}{'median':>9}{'NMAD':>9}{'LE90':>9}{'largest':>9}  (m)"]
    for row in document["by_slope"]:
        low, high = row["slope_deg"]
        if row["count"]:
            name = f"over {low:g}°" if high is None else f"{low:g}-{high:g}°"
            lines.append(f"{name:<12}{cells(row)}")
    lines.append(f"{'all':<12}{cells(document['overall'])}")
    unknown = document["overall"]["count"] - sum(row["count"] for row in document["by_slope"])
    if unknown:
        lines.append(f"next to the edge or a gap of the DEM, so without a slope: {unknown} (only in the row of all)")
    lines.append("DEM minus check height; slopes without points have no row")
    if document["without_height"]:
        lines.append(f"without a height in the DEM, or of their own: {document['without_height']}")
    if document["gross"]:
        shown = ", ".join(document["gross"][:10])
        lines.append(f"far from all others (they count all the same): {shown}")
    return "\n".join(lines)
