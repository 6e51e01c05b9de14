"""`ortho verify`: measure the accuracy of a finished ortho with references or points, and name the likely cause."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.commands.control.points import read_control
from ortho_pipeline.commands.heights.opening import has_surface, open_surface
from ortho_pipeline.commands.orthos.dependence import (
    FieldStep,
    HeightDependence,
    causes_of,
    height_dependence,
    steps_of,
)
from ortho_pipeline.commands.orthos.masks import ClassMask
from ortho_pipeline.commands.orthos.measuring import CELLS, MeasuredOrtho, measure_ortho, pixel_of
from ortho_pipeline.commands.orthos.opening import filled_of, open_ortho
from ortho_pipeline.commands.orthos.requirement import Requirement
from ortho_pipeline.commands.orthos.statistics import FEWEST_POINTS, Accuracy, Verified, profile
from ortho_pipeline.commands.resolved.ledger import Ledger, provenance, software
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.results import SCHEMA_VERSION, Result, to_store
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.display.numbers import class_size, size_m
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.ground_residuals import shifts_of, with_reference_height
from ortho_pipeline.files import Checksums, sha256, together, write_json
from ortho_pipeline.files.folders import listed_paths
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.imaging.band_shifts import BandShift
from ortho_pipeline.imaging.matching.agreement import said_of_parts
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.report.document import report_of_ortho
from ortho_pipeline.report.orthos.page import write_page, write_table
from ortho_pipeline.report.orthos.summary import summary_text, table_text
from ortho_pipeline.report.stac import ortho_accuracy
from ortho_pipeline.runtime.process_limits import one_blas_thread
from ortho_pipeline.surface.base import Surface

#: Endings of rasters that a folder of orthos may have.
RASTERS = (".tif", ".tiff", ".jp2", ".vrt", ".img", ".png")
#: ASPRS 2023 asks for so many check points.
_ENOUGH = 30


@to_store(folder="verify")
@one_blas_thread()
def verify(
    ortho: str | os.PathLike[str],
    folder: str | os.PathLike[str] | None = None,
    *,
    match: MatchOptions = MatchOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    scene: SceneOptions = SceneOptions(),
    output: OutputOptions = OutputOptions(),
    masks: Sequence[str | os.PathLike[str]] = (),
    band: int | None = None,
    require: Sequence[str] = (),
    command: str | None = None,
) -> Result:
    """Measure how accurate a finished ortho is: relative to references, and at points on the ground.

    Parameters
    ----------
    ortho : path
        A finished ortho, or a folder of them, of which one table is made.
    folder : path, optional
        For the report, its numbers and the displacements. Default: write nothing.
    masks : sequence of str
        ``FILE`` or ``FILE=values``: classes that hide the ground.
    band : int, optional
        The band of the ortho to compare.
    require : sequence of str
        Such as ``ce90<5``; the document says in `requirements` whether they are met.
    command : str, optional
        The command line, for the report.

    Raises
    ------
    InputError
        If the image is not an ortho, there is neither reference nor point, or matching fails.

    Examples
    --------
    >>> displaced = op.rectify("sample_data/scene.tif", out, surface=op.SurfaceOptions(dem="sample_data/dem.tif"))
    >>> match = op.MatchOptions(reference=["sample_data/reference.tif"], points=150)
    >>> found = op.verify(displaced.files["ortho"], match=match).document
    >>> round(found["relative"]["bias_m"]["value"]), found["causes"][0]["code"]
    (17, 'shift')
    """
    if not match.reference and points.gcps is None:
        raise InputError(
            "no reference and no points to compare the ortho with",
            field="match.reference",
            remedy=Text(
                "give an orthoimage of the same place with ", Setting("match.reference", "FILE"), ", or points with ",
                Setting("points.gcps", "FILE"),
            ),
        )  # fmt: skip
    required = [Requirement.parse(text) for text in require]
    hidden = [ClassMask.parse(text) for text in listed_paths(masks, "masks")]
    one = _Job(match, points, surface, scene, output, hidden, band, required, command)
    if os.path.isdir(ortho):
        return _verify_folder(Path(ortho), folder, one)
    document, measured = one.document(ortho)
    return _written(document, measured, folder, scene)


class _Job:
    """What is asked of each ortho."""

    def __init__(
        self,
        match: MatchOptions,
        points: PointOptions,
        surface: SurfaceOptions,
        scene: SceneOptions,
        output: OutputOptions,
        masks: Sequence[ClassMask],
        band: int | None,
        required: Sequence[Requirement],
        command: str | None,
    ) -> None:
        self.match, self.points, self.surface, self.scene, self.output = match, points, surface, scene, output
        self.masks, self.band, self.required, self.command = masks, band, required, command
        # The orthos of a folder have a DEM and references in common.
        self.digest = Checksums()

    def document(self, ortho: str | os.PathLike[str]) -> tuple[dict[str, Any], MeasuredOrtho | None]:
        """Return the document of one ortho, and its matches."""
        opened = open_ortho(ortho, self.scene)
        measured = None
        if self.match.reference:
            measured = measure_ortho(
                opened, self.match, scene=self.scene, masks=self.masks, band=self.band, output=self.output, whole=True
            )
        errors = self._point_errors(opened)
        filled = 1.0 if measured else float(filled_of(opened, self.scene, CELLS).mean())
        heights = self._heights(opened)
        document = document_of(measured or opened, self.match, heights, errors, filled=filled)
        document["requirements"] = [one.judged(document) for one in self.required]
        request = Request(ortho, self.scene, self.points, self.surface, self.match)
        document["provenance"] = provenance_of(request, opened, heights, self.masks, self.command, self.digest)
        return document, measured

    def _heights(self, opened: Scene) -> Surface | None:
        if not has_surface(self.surface):
            return None
        surface = open_surface(self.surface, self.scene, self.output.memory, [opened])
        return surface.with_fill("mask")

    def _point_errors(self, opened: Scene) -> PointErrors | None:
        """Return where the ortho shows points minus where they are; None without points."""
        if self.points.gcps is None:
            return None
        points = read_control(opened, Request(opened, self.scene, points=self.points))
        _refuse_points_of_scene(points, opened)
        ground = with_reference_height(opened.model, points.ground)
        ground = ground_transform(points.crs, opened.model.crs)(ground)
        off = points.image - opened.model.ground_to_image(ground)
        errors = shifts_of(opened.model, ground, off)
        good = np.isfinite(errors).all(axis=1)
        typical = float(np.median(np.hypot(*off[good].T))) if good.any() else 0.0
        if typical > math.hypot(opened.width, opened.height):
            raise InputError(
                f"half of the points are more than {typical:.0f} pixels from where the ortho shows them, which is more "
                "than its size",
                file=points.source or None,
                field="points.gcps",
                remedy=Text(
                    "give columns and rows of the ortho, not map coordinates, and check the CRS of the points (",
                    Setting("points.crs"),
                    ")",
                ),
            )
        return PointErrors(tuple(np.array(points.ids)[good].tolist()), errors[good])


def _refuse_points_of_scene(points: Points, ortho: Scene) -> None:
    """Refuse points with the columns and rows of the scene that an ortho was made of, which its report lists."""
    report = report_of_ortho(ortho.path)
    of_scene = {point.id: point.image for point in report.adjustment.points} if report else {}
    both = [(at, of_scene[name]) for name, at in zip(points.ids, points.image, strict=True) if name in of_scene]
    if both and all(np.allclose(at, np.array(raw, float), rtol=0.0, atol=1e-3) for at, raw in both):
        name = Path(ortho.path).name.replace("_ortho.tif", "_report.json")
        raise InputError(
            f"these points were measured in the raw scene, not in the ortho: {name} has the same columns and rows",
            file=points.source or None,
            field="points.gcps",
            remedy="measure the points in the ortho ('ortho measure ORTHO') and give that file",
        )


class PointErrors(NamedTuple):
    """Names of points, and where the ortho shows them minus where they are: metres to east and north ``(n, 2)``."""

    ids: tuple[str, ...]
    errors: Array


def provenance_of(
    request: Request,
    scene: Scene,
    surface: Surface | None,
    masks: Sequence[ClassMask],
    command: str | None,
    digest: Callable[..., str] = sha256,
) -> dict[str, Any]:
    """Return the record of the files, options and versions that the document of an ortho was made with."""
    hiding = Ledger({Path(mask.path): "mask" for mask in masks if Path(mask.path).is_file()})
    inputs = Ledger.of(request, scene, surface).joined(hiding).hashed(digest)
    settings = request.asked("scene", "surface", "match", "output")
    return dict(json_value(provenance(request, scene, surface, inputs, command, settings)))


def document_of(
    found: MeasuredOrtho | Scene,
    match: MatchOptions,
    surface: Surface | None = None,
    points: PointErrors | None = None,
    *,
    filled: float = 1.0,
) -> dict[str, Any]:
    """Return what is published of an ortho: of its matches, or of points alone where it was not matched.

    `filled` is the share of pixels of a scene without matches that have a value.
    """
    opened = found if isinstance(found, Scene) else found.scene
    pixel = pixel_of(opened)
    filled = filled if isinstance(found, Scene) else float(found.filled.mean())
    middle = opened.model.image_to_ground(np.array([[opened.width / 2, opened.height / 2]]), 0.0)
    document: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "ortho": str(opened.path),
        "size": [opened.width, opened.height],
        "crs": opened.model.crs,
        "pixel_m": pixel,
        "area_m2": opened.width * opened.height * pixel**2 * filled,
        "lon_lat": json_value(ground_transform(opened.model.crs, "EPSG:4979")(middle)[0, :2]),
        "acquired": opened.facts.get("acquired"),
        "references": [str(path) for path in match.reference],
    }
    notices: list[Notice] = []
    if isinstance(found, MeasuredOrtho):
        document |= _of_matches(found, surface, match.reference_sigma)
        notices += [one for one in found.searched.notices if one.code != "search-by-default"]
    else:
        document |= {"relative": None, "absolute": None, "heights": None, "bands": [], "causes": [], "steps": []}
    document["points"] = None if points is None else _of_points(points, pixel)
    document["asprs"] = _asprs(document)
    document["requirements"] = []
    document["stac"] = ortho_accuracy(document)
    if isinstance(found, MeasuredOrtho):
        notices += _notices(document, found, match.reference_sigma)
    return document | to_document(notices)


def _of_matches(measured: MeasuredOrtho, surface: Surface | None, reference_sigma: float | None) -> dict[str, Any]:
    """Return what matches say of an ortho."""
    verified = Verified.of(measured)
    pixel, field = measured.pixel, verified.field
    relative = verified.relative()
    heights: HeightDependence | None = None if surface is None else height_dependence(measured, surface)
    steps: list[FieldStep] = steps_of(measured)
    matched = measured.searched.record
    bands = _bands(measured)
    cells = [
        {"image": place, "east_m": east, "north_m": north}
        for place, (east, north) in zip(verified.cells.tolist(), verified.mean.tolist(), strict=True)
    ]
    return {
        "matches": {
            "tried": matched.tried,
            "kept": len(measured.image),
            "local": int(measured.local.sum()),
            "reasons": dict(measured.reasons),
            "tested_share": verified.tested,
            "band": measured.band,
            "noise_px": json_value(field.noise / pixel),
        },
        "relative": relative.to_json(pixel),
        "absolute": None if reference_sigma is None else verified.absolute(reference_sigma).to_json(pixel),
        "pixel_axes_m": measured.metres.tolist(),
        "field": {"shared_m": json_value(field.shared), "range_m": json_value(field.range * pixel), "cells": cells},
        "heights": None if heights is None else heights.to_json(pixel),
        "columns": profile(verified, 0),
        "rows": profile(verified, 1),
        "steps": [one.to_json() for one in steps],
        "bands": bands,
        "causes": causes_of(verified, heights, surface, steps) + _band_causes(bands),
    }


def _bands(measured: MeasuredOrtho) -> list[dict[str, Any]]:
    """Return where single bands of the ortho show the ground, relative to all of them together, in px."""
    from ortho_pipeline.imaging.matching import open_references
    from ortho_pipeline.imaging.matching.chip_search import SIDE, in_each_band
    from ortho_pipeline.imaging.matching.targets import SceneView
    from ortho_pipeline.raster.intensity import Intensity
    from ortho_pipeline.raster.source import RasterSource
    from ortho_pipeline.surface.flat import FlatSurface

    matches, scene = measured.matched.matches, measured.scene
    access = measured.opened.access
    source = RasterSource(scene.path, **access)
    if source.count < 2:
        return []
    kept = np.flatnonzero(matches.reason == "")
    own = open_references([scene.path], **access)
    view = SceneView(Intensity(source), scene.model, FlatSurface(0.0))
    origins = np.round(matches.image[kept] - SIDE * matches.factor / 2).astype(int)
    found: Sequence[BandShift] = in_each_band(
        view, own, origins, matches.scene[kept], np.zeros((len(kept), 2)), matches.factor, 1
    )
    # The move of the model is against that of what the band shows.
    return [
        {"band": one.band, "column_px": -one.shift[0], "row_px": -one.shift[1], "sigma_px": max(one.sigma)}
        for one in found
    ]


def _band_causes(bands: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    apart = [
        (float(np.hypot(one["column_px"] - other["column_px"], one["row_px"] - other["row_px"])), one, other)
        for one in bands
        for other in bands
        if one["band"] < other["band"]
    ]
    most, one, other = max(apart, key=lambda found: found[0], default=(0.0, {}, {}))
    if most < 0.3 or most < 4 * np.hypot(one["sigma_px"], other["sigma_px"]):
        return []
    text = f"bands {one['band']} and {other['band']} are displaced by {most:.2f} px"
    return [{"code": "bands", "text": text, "share": None}]


def _of_points(points: PointErrors, pixel: float) -> dict[str, Any]:
    """Return what points say of an ortho."""
    ids, errors = points
    if len(errors) < FEWEST_POINTS:
        raise InputError(
            f"too few points ({len(errors)}) to estimate the accuracy of an ortho",
            field="points.gcps",
            remedy=f"give at least {FEWEST_POINTS} points, preferably {_ENOUGH}",
        )
    residuals = [
        {"id": name, "east_m": east, "north_m": north} for name, (east, north) in zip(ids, errors.tolist(), strict=True)
    ]
    return {"count": len(errors)} | Accuracy.of_points(errors).to_json(pixel) | {"residuals": residuals}


def _asprs(document: Mapping[str, Any]) -> str:
    """Return what ASPRS 2023 lets people say of the accuracy."""
    points = document["points"]
    if points is not None:
        rmse, count = points["rmse_m"]["value"], points["count"]
        said = (
            f"Horizontal RMSE_H {size_m(rmse)} at {counted(count, 'check point')}: ASPRS 2023 class "
            f"{class_size(max(1, int(np.ceil(rmse * 100 - 1e-9))))}"
        )
        return said if count >= _ENOUGH else f"{said}. Indicative: ASPRS 2023 asks for {_ENOUGH} check points"
    rmse = document["relative"]["rmse_m"]["value"]
    return f"Horizontal RMSE_H {size_m(rmse)} relative to the reference. ASPRS 2023 classes need check points"


def _notices(document: Mapping[str, Any], measured: MeasuredOrtho, reference_sigma: float | None) -> list[Notice]:
    found = []
    share = document["matches"]["tested_share"]
    if share < 0.5:
        text = f"matches test {share:.0%} of the ortho; the accuracy of the rest is unknown"
        found.append(Notice("ortho-tested-in-part", text, tested_share=share))
    if reference_sigma is None and document["points"] is None:
        text = "this accuracy is relative to the reference; the error of the reference is not included"
        found.append(Notice("ortho-relative", text))
    apart = measured.apart
    if apart.any():
        off = measured.displacement[apart] - np.median(measured.displacement[~apart], axis=0)
        far = np.hypot(*off.T)
        parts = said_of_parts(measured.image[~apart], measured.image[apart], far)
        text = f"a part of the ortho or of the reference is displaced: {parts}"
        found.append(Notice("ortho-part-displaced", text, matches=int(apart.sum()), displaced_m=float(np.median(far))))
    local = document["matches"]["local"]
    if local > 0.02 * len(measured.image) and local > 2:
        text = f"{counted(local, 'match differs', 'matches differ')} from the neighbouring matches"
        found.append(Notice("ortho-local-changes", text, matches=local))
    return found


# -- files -----------------------------------------------------------------------------------------------------------


def _written(
    document: dict[str, Any],
    measured: MeasuredOrtho | None,
    folder: str | os.PathLike[str] | None,
    scene: SceneOptions,
) -> Result:
    files: dict[str, Path] = {}
    if folder is not None:
        stem = Path(document["ortho"]).stem
        files = {"html": Path(folder) / f"{stem}_verify.html", "json": Path(folder) / f"{stem}_verify.json"}
        if measured is not None:
            files["displacements"] = Path(folder) / f"{stem}_displacements.geojson"
        with together(folder, stem):
            write_json(files["json"], document)
            write_page(document, files["html"], document["ortho"], scene.access)
            if measured is not None:
                write_json(files["displacements"], displacements(measured))
    return Result(files, document, summary_text(document))


def displacements(measured: MeasuredOrtho) -> dict[str, Any]:
    """Return the matches of an ortho as GeoJSON, with the displacement of each."""
    lon_lat = ground_transform(measured.scene.model.crs, "EPSG:4979")(measured.ground)[:, :2]
    local = measured.local
    rows = zip(
        measured.ids, lon_lat.tolist(), measured.image.tolist(), measured.displacement.tolist(),
        measured.sigma.tolist(), local.tolist(), strict=True,
    )  # fmt: skip
    features = [
        {
            "type": "Feature",
            "id": name,
            "geometry": {"type": "Point", "coordinates": place},
            "properties": {
                "column": image[0],
                "row": image[1],
                "east_m": east_north[0],
                "north_m": east_north[1],
                "length_m": float(np.hypot(*east_north)),
                "sigma_px": sigma,
                "local": alone,
            },
        }
        for name, place, image, east_north, sigma, alone in rows
    ]
    return {"type": "FeatureCollection", "features": features}


def _verify_folder(folder: Path, out: str | os.PathLike[str] | None, job: _Job) -> Result:
    """Verify all orthos of a folder; what cannot be verified is a row with its error."""
    own = {os.path.realpath(path) for path in job.match.reference}
    images = sorted(path for path in folder.iterdir() if path.suffix.lower() in RASTERS)
    images = [path for path in images if os.path.realpath(path) not in own]
    if not images:
        raise InputError(
            "this folder has no raster", file=folder, remedy=f"give a folder with orthos ({', '.join(RASTERS)})"
        )
    rows: list[dict[str, Any]] = []
    done: list[Result] = []
    for image in images:
        try:
            document, measured = job.document(image)
        except OrthoError as error:
            rows.append({"ortho": str(image), "error": error.message, "remedy": error.remedy})
            continue
        done.append(_written(document, measured, out, job.scene))
        kept = ("ortho", "pixel_m", "relative", "absolute", "points", "causes", "requirements")
        rows.append({name: document[name] for name in kept})
    table = {"schema_version": SCHEMA_VERSION, "folder": str(folder), "orthos": rows, "failed": len(images) - len(done)}
    table["requirements"] = [one for row in rows for one in row.get("requirements") or ()]
    table["provenance"] = _in_common([one.document["provenance"] for one in done], job.command)
    table |= to_document([])
    files: dict[str, Path] = {}
    if out is not None:
        files = {"html": Path(out) / "verify.html", "json": Path(out) / "verify.json"}
        write_json(files["json"], table)
        write_table(table, files["html"])
    return Result(files, table, table_text(table))


def _in_common(records: Sequence[Mapping[str, Any]], command: str | None) -> dict[str, Any]:
    """Return command, versions and the inputs that the orthos of a folder have in common; each has its own record."""
    shared = [
        entry
        for entry in (records[0]["inputs"] if records else ())
        if entry["role"] not in ("image", "metadata") and all(entry in record["inputs"] for record in records)
    ]
    return {"command": command, "software": software(), "inputs": shared}
