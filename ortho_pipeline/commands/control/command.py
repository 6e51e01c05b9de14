"""`ortho match`: a scene, its references and heights in; control points out."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.control.matching import match_scene
from ortho_pipeline.commands.heights.opening import require_heights
from ortho_pipeline.commands.resolved.ledger import provenance
from ortho_pipeline.commands.resolved.opening import resolve
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.results import Result, attempted, to_store
from ortho_pipeline.commands.scene_fit import Adjusted, adjust
from ortho_pipeline.commands.stac.given import with_items
from ortho_pipeline.display.notices import to_document
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import together
from ortho_pipeline.options import MatchOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import write_points
from ortho_pipeline.report import document as reports
from ortho_pipeline.runtime.process_limits import one_blas_thread
from ortho_pipeline.surface.base import Surface

#: Suffixes of files that hold all properties of a match.
_SUFFIXES = (".geojson", ".csv", ".tsv")


@with_items
@to_store(output=None, report=None)
@one_blas_thread()
def match(
    image: str | os.PathLike[str],
    output: str | os.PathLike[str],
    match: MatchOptions,
    *,
    scene: SceneOptions = SceneOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    report: str | os.PathLike[str] | None = None,
) -> Result:
    """Match a scene with reference orthoimages and write the control and check points that this gives.

    Parameters
    ----------
    output : path
        A ``.geojson`` or ``.csv`` file, written whole or not at all.
    report : path, optional
        A page ``.html`` of the matches and of how a model fits that is adjusted to them; its numbers are written beside
        it as ``.json``.

    Raises
    ------
    InputError
        If an input or an option is wrong.
    """
    if not match.reference:
        raise InputError("no reference given", field="match.reference", remedy="give an ortho of the same place")
    files = {"points": Path(output)}
    if files["points"].suffix.lower() not in _SUFFIXES:
        raise InputError(
            "matches cannot be written in this format",
            file=output,
            field="output",
            remedy=f"one of {', '.join(_SUFFIXES)}",
        )
    files |= _page(report)
    require_heights(surface)
    request = Request(image, scene, surface=surface, match=match)
    inputs.check_paths(files, request)
    resolved = resolve(request)
    opened, heights = resolved.scene, resolved.surface
    adjusted = None if report is None else adjust(resolved)
    matched = None if adjusted is None else adjusted.matched
    if matched is None:
        matched = match_scene(opened, match, heights, scene)
    settings = request.asked("scene", "surface", "match")
    record = provenance(request, opened, heights, resolved.ledger.hashed(), None, settings)
    points = matched.matches.points
    # Points of a bundle or strip also serve its other images, if they name the image in which they were measured.
    said = bool(opened.pieces) and files["points"].suffix.lower() != ".geojson"
    failure = None
    with together(files["points"].parent, files["points"].stem):
        write_points(points, output, images=[Path(opened.path).name] * len(points) if said else None)
        if adjusted is not None:
            make = functools.partial(_write_page, adjusted, heights, record, files)
            failure = attempted(make, files, "html", "report")
    document = {"matching": matched.to_json(), "provenance": record, **to_document([*opened.notices, *matched.notices])}
    text = "\n".join(f"{name:<10}{said}" for name, said in matched.summary())
    return Result(files, document, text, failure)


def _page(report: str | os.PathLike[str] | None) -> dict[str, Path]:
    """Return the files of the page and its numbers, by what they are."""
    if report is None:
        return {}
    page = Path(report)
    if page.suffix.lower() != ".html":
        raise InputError(
            "the report of matches is an HTML page", file=page, field="report", remedy="use a name that ends in .html"
        )
    return {"html": page, "report": page.with_suffix(".json")}


def _write_page(
    adjusted: Adjusted, surface: Surface | None, record: Mapping[str, Any], files: Mapping[str, Path]
) -> None:
    """Write the page of the matches and of the model that is fitted to them."""
    report = reports.build_report(
        scene=adjusted.scene,
        fit=adjusted.fit,
        surface=surface,
        provenance=record,
        matching=adjusted.matching,
        warnings=adjusted.warnings(surface),
    )
    reports.write_report_json(report, files["report"])
    matches = None if adjusted.matched is None else adjusted.matched.matches
    reports.write_report_html(report, files["html"], matches=matches)
