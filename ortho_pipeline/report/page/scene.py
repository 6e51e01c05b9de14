"""The page of a scene, of a comparison and of matches: one file that needs no other and no network."""

from __future__ import annotations

import base64
import math
from os import PathLike
from typing import TYPE_CHECKING, Any

from ortho_pipeline.display.drawing import style_sheet
from ortho_pipeline.display.notices import doubted
from ortho_pipeline.display.numbers import flat
from ortho_pipeline.display.pages import render
from ortho_pipeline.estimation.records import is_known
from ortho_pipeline.files import write_text
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.report.gallery.chips import gallery
from ortho_pipeline.report.gallery.plots import residuals_by_axis
from ortho_pipeline.report.gallery.points import point_chips
from ortho_pipeline.report.page.advice import WORDS
from ortho_pipeline.report.page.behaviour import policy, script
from ortho_pipeline.report.page.locator import place_of, plot_locator
from ortho_pipeline.report.page.ortho_map import LONGEST_ARROW, plot_ortho
from ortho_pipeline.report.plots import plots
from ortho_pipeline.report.records import UNKNOWN, Provenance, SceneReport
from ortho_pipeline.report.summary import (
    about,
    circular_error,
    error_table,
    errors_of_points,
    first_notes,
    signals_of,
)
from ortho_pipeline.report.wording import fit_notes, option_of_choice, runner_up, scale_rules, unsettled, verdict

if TYPE_CHECKING:
    from ortho_pipeline.imaging.matching import Matches
    from ortho_pipeline.raster.source import RasterSource

#: Longer side of the quicklook, px: pixels of no two alike in three bands are 2 MB.
_SIDE = 720


def write_report_html(
    report: SceneReport,
    path: str | PathLike[str],
    *,
    ortho: str | PathLike[str] | bytes | None = None,
    matches: Matches | None = None,
    pixels: RasterSource | None = None,
) -> None:
    """Write the report as one page that needs no other file and no network.

    Parameters
    ----------
    ortho : path or bytes, optional
        The orthoimage, of which a preview is made, or the PNG of a preview.
    matches : Matches, optional
        Those that `report.matching` is of, whose chips are shown.
    pixels : RasterSource, optional
        Those of the scene, of which chips about the measured points are shown.
    """
    png = ortho if isinstance(ortho, bytes) or ortho is None else preview_png(ortho, side=_SIDE)
    adjustment, code = report.adjustment, script()
    over_ortho, where = plot_ortho(report) if png else None, plot_locator(place_of(report))
    said = signals_of(report)
    page = render(
        "report/report.html.j2",
        report=report,
        adjustment=adjustment,
        head=report.headline,
        about=about(report),
        unknown=report.headline.figure == UNKNOWN,
        ce90=circular_error(report),
        errors=error_table(errors_of_points(report)),
        notes=first_notes(report, said),
        fit_notes=fit_notes(adjustment),
        verdict=verdict(report),
        scale_rules=None if report.map_scale is None else scale_rules(report.map_scale),
        unsettled=unsettled(report),
        runner_up=runner_up(report),
        option_of_choice=option_of_choice(report.comparison),
        doubted=doubted(adjustment.notices) & {one.id for one in adjustment.points},
        of_fit=not adjustment.rmse.check and bool(adjustment.rmse.loo) and bool(adjustment.parameters),
        too_short=_too_short(report),
        signals=said,
        levels=WORDS,
        roles={one.role for one in adjustment.points},
        rejected={one.id: one.reason for one in adjustment.rejected},
        outlying={one.id: one.reason for one in adjustment.outlying},
        has_loo=any(point.loo_residual for point in adjustment.points),
        provenance=list(flat({**report.scene.facts, **_brief(report.provenance)})),
        inputs=report.provenance.inputs,
        plots={name: drawing.svg() for name, drawing in plots(report).items()},
        plotted_role=report.covariance.drawn and report.covariance.drawn[0],
        plot_style=style_sheet(),
        preview=base64.b64encode(png).decode() if png else None,
        over_ortho=None if over_ortho is None else over_ortho.svg(),
        locator=None if where is None else where.svg(),
        match_axes=residuals_by_axis(report)[0],
        gallery=None if matches is None else gallery(report, matches),
        points=None if pixels is None else point_chips(report, pixels),
        script=code,
        policy=policy(code),
        running=_running(report.scene.name),
    )
    write_text(path, page)


def _too_short(report: SceneReport) -> bool:
    """Tell whether some arrows over the ortho are too short to be drawn next to the longest."""
    sizes = [
        math.hypot(*one.residual_m)
        for one in report.adjustment.points
        if one.kind != "out" and is_known(one.residual_m)
    ]
    return bool(sizes) and min(sizes) < max(sizes) / LONGEST_ARROW


def _running(name: str) -> str:
    """Return a name for the head of printed pages, of which nothing can end a text in a style sheet."""
    return "".join(letter if letter.isalnum() or letter in " ._-" else "_" for letter in name)[:60]


def _brief(provenance: Provenance) -> dict[str, Any]:
    """Return the provenance without what the page shows in tables of its own."""
    shown = ("inputs", "surface", "model_source", "image", "sensor")
    return {key: value for key, value in provenance.to_json().items() if key not in shown}
