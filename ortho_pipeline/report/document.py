"""The accuracy report: one record, shown as JSON, as a page, as plots, as GeoJSON and as text for the terminal.

`build_report` collects everything; the other functions only show what is in its record. A residual is measured minus
predicted, in pixels. In metres it is where the ortho shows a point minus where the point belongs, east and north, on
the assumption that the DEM is right there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.display.drawing import round_down
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.choice.comparison import ComparisonRecord
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import along_view, in_metres, rmse_metres, viewing
from ortho_pipeline.estimation.records import Adjustment, Point, Rmse, RmseOfView, RmsesOfView, is_known
from ortho_pipeline.estimation.spatial.correlation import Covariances, analyse_fit
from ortho_pipeline.files import read_json, whole_or_nothing, write_json, write_text
from ortho_pipeline.files.json.records import DocumentError
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.distortion import map_from_enu, metres_of_steps
from ortho_pipeline.geodesy.ellipsoid import longitudes_near
from ortho_pipeline.geodesy.naming import crs_definition, crs_name
from ortho_pipeline.models import SensorModel
from ortho_pipeline.points.control_hull import control_hull
from ortho_pipeline.points.heights.datums import FROM_DEM, datums_apart, median_and_spread
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.report.delivered import accuracy_before
from ortho_pipeline.report.layers.accuracy import AccuracyLayer
from ortho_pipeline.report.layers.angles import AnglesLayer
from ortho_pipeline.report.layers.styles import raster_style
from ortho_pipeline.report.map_scale import map_scale
from ortho_pipeline.report.matching import MatchingRecord
from ortho_pipeline.report.page.scene import write_report_html
from ortho_pipeline.report.plots import plots
from ortho_pipeline.report.records import (
    Dem,
    FlatGround,
    MapScaleRecord,
    OrthoRecord,
    PointHeights,
    Provenance,
    RpcRecord,
    SceneRecord,
    SceneReport,
)
from ortho_pipeline.report.summary import summary_text
from ortho_pipeline.report.wording import corrected, headline, points_again, refuted
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.flat import FlatSurface

if TYPE_CHECKING:
    from ortho_pipeline.exchange.rpc_fit import RpcExport
    from ortho_pipeline.hookspecs import Scene
    from ortho_pipeline.points import Points
    from ortho_pipeline.raster.source import Grid
    from ortho_pipeline.warp.job import WarpRecord

Array = NDArray[np.float64]

#: Typical difference between heights of points and of the surface beyond which the surface is not the ground, metres:
#: twice the error that global DEMs state (90 %).
_NOT_THE_GROUND = 20.0
_MAX_BYTES = 50_000_000
_DOCUMENT, _VERSION = "ortho-pipeline report", 1
_REMEDY = "give a <stem>_report.json"

__all__ = [
    "accuracy_style",
    "build_report",
    "headline",
    "plots",
    "preview_png",
    "read_report",
    "read_report_json",
    "report_of_ortho",
    "residuals_geojson",
    "residuals_style",
    "summary_text",
    "with_layers",
    "write_plots",
    "write_report_html",
    "write_report_json",
]

# -- collecting ------------------------------------------------------------------------------------------------------


def build_report(
    *,
    scene: Scene,
    fit: Fit,
    exported: RpcExport | None = None,
    surface: Surface | None = None,
    coverage: float | None = None,
    grid: Grid | None = None,
    warp: WarpRecord | None = None,
    comparison: ComparisonRecord | None = None,
    matching: MatchingRecord | None = None,
    near: float | None = None,
    provenance: Mapping[str, Any] | None = None,
    warnings: Iterable[Notice] = (),
) -> SceneReport:
    """Collect scene, adjustment, heights, ortho and provenance as what people and programs read.

    Parameters
    ----------
    exported : RpcExport, optional
        The adjusted model as RPC.
    coverage : float, optional
        Share (0 to 1) of the scene for which the DEM has a height.
    comparison : ComparisonRecord, optional
    matching : MatchingRecord, optional
    provenance : mapping, optional
        From `commands.inputs.provenance`.
    near : float, optional
        Distance (m) below which points are neighbours; as `spatial_correlation.analyse` chooses it without one.
    warnings : iterable of Notice
        What the reader ought to know. Systematic errors, and a suspicious difference between control and DEM heights,
        are added to them.
    """
    seen = viewing(fit.model, scene.width, scene.height)
    heights, doubts = (None, []) if surface is None else _heights_of_points(fit, surface, seen)
    covariance = analyse_fit(fit, near=near)
    noted = to_document([*warnings, *doubts, *patterns(covariance)])
    adjustment, rmse_m = _adjustment(fit, noted), rmse_metres(fit)
    untested = refuted(noted["notices"]) or points_again(adjustment, scene.adjusted)
    return SceneReport(
        scene=_scene(scene, seen, fit.model),
        adjustment=adjustment,
        rmse_m=rmse_m,
        view_rmse=_view_rmse(fit),
        covariance=covariance,
        map_scale=None if untested else _map_scale(fit, seen, grid),
        control_hull=control_hull(fit.points.image[fit.used], (scene.width, scene.height)),
        comparison=comparison,
        matching=matching,
        heights=heights,
        surface=None if surface is None else _surface(surface, coverage),
        rpc=None if exported is None else RpcRecord(exact=exported.exact, max_error_px=exported.max_error_px),
        ortho=None if grid is None else _ortho(grid, warp),
        warp=warp,
        provenance=Provenance.model_validate(json_value(provenance or {})),
        warnings=tuple(noted["warnings"]),
        notices=tuple(noted["notices"]),
        headline=corrected(
            headline(adjustment, rmse_m, accuracy_before(scene), adjusted=scene.adjusted, matching=matching),
            noted["notices"],
        ),
    )


def patterns(covariance: Covariances) -> list[Notice]:
    """Return a notice if neighbouring points have similar residuals."""
    tested = {"control": covariance.control, "check": covariance.check}
    roles = [role for role, found in tested.items() if found is not None and found.verdict == "systematic"]
    if not roles:
        return []
    text = f"systematic errors remain: neighbouring {' and '.join(roles)} points have similar residuals"
    return [Notice("systematic-errors", text, roles=roles)]


def _scene(scene: Scene, seen: Mapping[str, Any], model: SensorModel) -> SceneRecord:
    middle = model.image_to_ground(np.array([[scene.width / 2, scene.height / 2]]), model.reference_height)
    lon_lat = ground_transform(model.crs, "EPSG:4979")(middle)[0, :2]
    # A model near the antimeridian counts on beyond 180 degrees.
    lon_lat[0] = longitudes_near(lon_lat[0], 0.0)
    known = {
        "middle_lon_lat": lon_lat.tolist() if np.isfinite(lon_lat).all() else None,
        "name": Path(scene.path).name,
        "size": (scene.width, scene.height),
        "sensor": scene.sensor,
        "model_source": scene.model_source,
        "facts": json_value(scene.facts),
    }
    return SceneRecord.model_validate({**known, **seen})


def _adjustment(fit: Fit, noted: Mapping[str, Any]) -> Adjustment:
    """Return the adjustment with all that there is to warn of, and its points as they are on the ground."""
    record, shifts = fit.record, in_metres(fit, fit.residuals)
    places, shown = _in_degrees(fit, shifts)
    names = ("raw_residual", "residual_m", "view_residual", "lon_lat", "shown_lon_lat")
    vectors = zip(fit.raw_residuals, shifts, along_view(fit), places, shown, strict=True)
    points = [
        Point.model_validate(
            {**point.given(), "height_m": json_value(height), **dict(zip(names, map(json_position, row), strict=True))}
        )
        for point, height, row in zip(record.points, fit.points.ground[:, 2], vectors, strict=True)
    ]
    return record.replaced(points=tuple(points), **{name: tuple(one) for name, one in noted.items()})


def _in_degrees(fit: Fit, shifts: Array) -> tuple[Array, Array]:
    """Return where points belong and where the ortho shows them, longitude and latitude ``(N, 2)``."""
    points = fit.points
    if not len(points):
        return np.zeros((0, 2)), np.zeros((0, 2))
    to_degrees, moved = ground_transform(points.crs, "EPSG:4979"), points.ground.copy()
    moved[:, :2] += np.einsum("nij,nj->ni", map_from_enu(points.crs, points.ground)[:, :2, :2], shifts)
    return to_degrees(points.ground)[:, :2], to_degrees(moved)[:, :2]


def _map_scale(fit: Fit, seen: Mapping[str, Any], grid: Grid | None) -> MapScaleRecord | None:
    pixels = [*(seen["ground_pixel_m"] or ()), *(() if grid is None else _pixel_on_ground(grid))]
    return map_scale(fit, max(pixels) if pixels else None)


def _pixel_on_ground(grid: Grid) -> list[float]:
    """Return width and height of the ortho's middle pixel in metres on the ellipsoid; nothing where it has no place."""
    left, bottom, right, top = grid.extent
    middle = np.array([[(left + right) / 2, (bottom + top) / 2, 0.0]])
    sizes = metres_of_steps(grid.crs, middle, np.array([grid.dx, grid.dy]))[0]
    return [float(size) for size in sizes if np.isfinite(size)]


def _view_rmse(fit: Fit) -> RmsesOfView:
    """Return root mean squares (px) along and across the direction of view, over control (used) and check points."""
    views = along_view(fit)

    def over(mask: NDArray[np.bool_]) -> RmseOfView | None:
        rmse = Rmse.of(views[mask & np.isfinite(views).all(axis=1)])
        return None if rmse is None else RmseOfView(along=rmse.col, across=rmse.row, n=rmse.n)

    return RmsesOfView(control=over(fit.used), check=over(fit.points.tests))


def _surface(surface: Surface, coverage: float | None) -> FlatGround | Dem:
    if isinstance(surface, FlatSurface):
        return FlatGround(coverage=coverage, constant_height=surface.height)
    return Dem.model_validate({"coverage": coverage, **json_value(surface.provenance)})


def _heights_of_points(fit: Fit, surface: Surface, seen: Mapping[str, Any]) -> tuple[PointHeights | None, list[Notice]]:
    """Compare the heights of the points with the DEM's: a difference of datums shows here and nowhere else."""
    points = fit.points
    if isinstance(surface, FlatSurface):
        difference = points.ground[:, 2] - surface.height
        return None, _not_the_ground(difference, _sigmas(points, surface), seen)
    difference, ids, stated = _above(points, surface)
    if not len(difference):
        return None, []
    largest = int(np.abs(difference).argmax())
    median, spread = median_and_spread(difference)
    doubts = datums_apart(difference, points.ground, points.crs, seen["lean_m_per_m"])
    doubts = doubts or _not_the_ground(difference, stated, seen)
    warning = str(doubts[0]) if doubts else None
    heights = PointHeights(
        median_m=median,
        spread_m=spread,
        n=len(difference),
        warning=warning,
        largest_m=float(difference[largest]),
        largest_at=str(ids[largest]),
        without=int((points.groups < 0).sum()) - len(difference),
    )
    return heights, doubts


def datums_of(fit: Fit, surface: Surface | None) -> list[Notice]:
    """Return a notice if heights of points and of a DEM that gives heights to others differ as if by their datums."""
    if surface is None or isinstance(surface, FlatSurface):
        return []
    difference, _, _ = _above(fit.points, surface)
    return datums_apart(difference, fit.points.ground, fit.points.crs)


def _above(points: Points, surface: Surface) -> tuple[Array, NDArray[np.str_], Array]:
    """Return heights (m) of measured points above a DEM ``(n,)``, their ids, and the sigmas that both state."""
    # Matches have the heights of the DEM.
    measured = points.select(points.groups < 0)
    difference = surface.above(measured.ground, measured.crs)
    known = np.isfinite(difference)
    return difference[known], np.array(measured.ids)[known], _sigmas(measured, surface)[known]


def _sigmas(points: Points, surface: Surface) -> Array:
    """Return what points and surface state of the difference of their heights ``(N,)`` m; 0 where neither does."""
    sigma = surface.sigma
    of_surface = sigma.heights(points.ground[:, :2], points.crs) if isinstance(sigma, Surface) else sigma or 0.0
    return np.asarray(np.hypot(np.nan_to_num(points.sigma_ground[:, 2]), np.nan_to_num(of_surface)))


def _not_the_ground(difference: Array, stated: Array, seen: Mapping[str, Any]) -> list[Notice]:
    """Return a notice if the surface is typically far from the points ``(n,)`` m, and that moves the ortho by a pixel.

    Flat ground, filled voids and a DEM that is mirrored or of another place are such surfaces. The fit uses the heights
    of the points and does not see it. Points show nothing within two sigmas ``(n,)`` that they and the surface state.
    """
    own = np.abs(difference) > FROM_DEM
    difference, stated = difference[own], stated[own]
    if len(difference) < 3:
        return []
    typical, worst = 1.4826 * float(np.median(np.abs(difference))), float(np.abs(difference).max())
    moved = None if seen["lean_m_per_m"] is None else typical * seen["lean_m_per_m"]
    if typical < max(_NOT_THE_GROUND, 2 * float(np.median(stated))):
        return []
    if moved is not None and moved < max(seen["ground_pixel_m"] or (0.0,)):
        return []
    text = (
        f"the surface is typically {metres(typical)} (at most {metres(worst)}) from the heights of the points, so it "
        f"is not the ground there{'' if moved is None else f'; that moves the ortho by {metres(moved)}'}"
    )
    return [Notice("surface-not-ground", text, typical_m=typical, worst_m=worst, moved_m=moved)]


def _ortho(grid: Grid, warp: WarpRecord | None) -> OrthoRecord:
    unit = grid.crs.axis_info[0].unit_name
    left, bottom, right, top = (float(value) for value in grid.extent)
    return OrthoRecord(
        crs=crs_definition(grid.crs, min_confidence=70),
        crs_name=crs_name(grid.crs),
        unit={"metre": "m", "degree": "°"}.get(unit, unit),
        extent=(left, bottom, right, top),
        resolution=(float(grid.dx), float(grid.dy)),
        size=(grid.width, grid.height),
        valid_share=None if warp is None else warp.valid_pixels / max(warp.pixels, 1),
    )


def with_layers(report: SceneReport, *, accuracy: AccuracyLayer | None, angles: AnglesLayer | None) -> SceneReport:
    """Return the report with what layers next to the ortho say; the headline gives the accuracy over the scene."""
    report = report.replaced(angles=angles)
    if accuracy is None:
        return report
    if refuted(report.notices):  # nor does the layer know of the error
        return report.replaced(accuracy=accuracy)
    head = report.headline
    return report.replaced(accuracy=accuracy, headline=head.replaced(notes=(accuracy.statement, *head.notes)))


def residuals_geojson(fit: Fit) -> dict[str, Any]:
    """Return the points as GeoJSON in lon, lat (WGS 84), one flat property per number, as GIS want them.

    ``res_*`` are residuals in pixels, ``raw_*`` those of the model as delivered, ``loo_*`` leave-one-out; ``east_m``
    and ``north_m`` the shift of the ortho on the ground (m, true east and north), for a vector field symbol.
    """
    points = fit.points
    where = ground_transform(points.crs, "EPSG:4979")(points.ground) if len(points) else np.zeros((0, 3))
    metres = in_metres(fit, fit.residuals)
    reasons, doubts = dict(fit.rejected), {one.id: one.reason for one in fit.outlying}
    features = []
    for i, name in enumerate(points.ids):
        pairs = {
            "": points.image[i],
            "res_": fit.residuals[i],
            "raw_": fit.raw_residuals[i],
            "loo_": fit.loo_residuals[i],
        }
        numbers = {f"{key}{axis}": pair[k] for key, pair in pairs.items() for k, axis in enumerate(("col", "row"))}
        numbers |= {"res_px": float(np.hypot(*fit.residuals[i])), "east_m": metres[i, 0], "north_m": metres[i, 1]}
        numbers["length_m"] = float(np.hypot(*metres[i]))
        properties = {
            "id": name,
            "role": str(points.roles[i]),
            "used": bool(fit.used[i]),
            **{key: json_value(value) for key, value in numbers.items()},
            "rejected": reasons.get(name),
            "outlying": doubts.get(name),
        }
        # A position without a height is legal GeoJSON, NaN is not.
        position = [float(value) for value in where[i] if np.isfinite(value)]
        geometry = {"type": "Point", "coordinates": position} if len(position) >= 2 else None
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return {"type": "FeatureCollection", "features": features}


def accuracy_style(layer: AccuracyLayer) -> str:
    """Return a QGIS style (QML) for the raster of accuracy: ce90 in five steps of colour."""
    return raster_style(4, layer.range_m[0], layer.range_m[2], metres)


def residuals_style(report: SceneReport) -> str:
    """Return a QGIS style (QML) for the residuals: marks by role, and arrows that are exaggerated in length.

    QGIS takes it by itself, as it has the name of the GeoJSON file with the ending ``.qml``.
    """
    # Points that were left out have no arrow: a gross error would shrink those of all others to dots.
    shifts = [point.residual_m for point in report.adjustment.points if point.kind != "out"]
    longest = max((math.hypot(*shift) for shift in shifts if is_known(shift)), default=0.0)
    ground = report.scene.ground_pixel_m
    extent = max(report.scene.size) * (max(ground) if ground else 1.0)
    # The longest arrow spans about a twelfth of the scene.
    exaggeration = round_down(extent / 12 / longest) if longest > 0 else 1.0
    return render("report/residuals.qml.j2", exaggeration=exaggeration)


# -- showing ---------------------------------------------------------------------------------------------------------


def write_report_json(report: SceneReport, path: str | PathLike[str]) -> None:
    """Write the report as JSON, whole or not at all."""
    write_json(path, report.to_json(), ascii_only=False)


def read_report_json(path: str | PathLike[str]) -> dict[str, Any]:
    """Read the document of a report of this version, whatever else it holds.

    Raises
    ------
    InputError
        If the file is not a report of this version.
    """
    document = read_json(path, _MAX_BYTES, _REMEDY)
    if not isinstance(document, dict) or document.get("document") != _DOCUMENT:
        raise InputError("this is not a report of ortho-pipeline", file=path, remedy=_REMEDY)
    if document.get("schema_version") != _VERSION:
        raise InputError(
            f"schema version {document.get('schema_version')!r} is not known here (this version reads {_VERSION})",
            file=path,
            field="schema_version",
            remedy="make the report again",
        )
    return document


def read_report(path: str | PathLike[str]) -> SceneReport:
    """Read a report again.

    Raises
    ------
    InputError
        If the file is not a report of this version, or does not hold what docs/report.schema.json says.
    """
    document = read_report_json(path)
    try:
        return SceneReport.read(document)
    except DocumentError as error:
        raise InputError(
            f"the report is damaged: {error.fault}", file=path, field=error.place, remedy="make the report again"
        ) from error


def report_of_ortho(ortho: str | PathLike[str]) -> SceneReport | None:
    """Return the report next to an ortho `<stem>_ortho.tif`; None without one that can be read."""
    path = Path(str(ortho).replace("_ortho.tif", "_report.json"))
    if path.suffix != ".json" or not path.is_file():
        return None
    try:
        return read_report(path)
    except InputError:
        return None


def write_plots(report: SceneReport, folder: Path, stem: str, kind: str = "svg") -> dict[str, Path]:
    """Write each plot as a picture of its own: ``<stem>_<plot>.svg`` or ``.png``.

    Raises
    ------
    InputError
        If PNG is asked for and matplotlib is not installed, or the numbers of the report cannot be drawn.
    """
    try:
        drawings = plots(report)
    except (LookupError, ValueError, ArithmeticError) as error:
        # Its members have their types, but numbers that contradict each other are nobody's.
        raise InputError(
            f"the report is damaged ({type(error).__name__}: {str(error)[:120]})",
            field="plots",
            remedy="make the report again",
        ) from error
    files = {}
    for name, drawing in drawings.items():
        files[name] = folder / f"{stem}_{name}.{kind}"
        if kind == "svg":
            write_text(files[name], drawing.svg(alone=True) + "\n")
            continue
        with whole_or_nothing(files[name]) as temporary:
            temporary.write_bytes(drawing.png())
    return files
