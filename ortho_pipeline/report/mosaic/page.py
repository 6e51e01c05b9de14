"""The page of a mosaic: a picture with its seams, and tables of gains and of seams."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.display.pages import render
from ortho_pipeline.files import staged, write_text
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.report.mosaic.document import summary_text
from ortho_pipeline.report.summary import processed
from ortho_pipeline.warp.mosaic import Owners

#: Cells per side of the drawing of the seams, at most; seams that the page lists.
_DRAWN, _LISTED = 400, 200


def write_page(
    document: Mapping[str, Any], path: str | PathLike[str], mosaic: str | PathLike[str], owners: Owners | None
) -> None:
    """Write the page of a mosaic, with a picture of it and its seams."""
    png = preview_png(staged(mosaic))
    seams = sorted(document["seams"], key=lambda seam: -(seam["rmse_px"] or 0.0))
    page = render(
        "report/mosaic.html.j2",
        document=document,
        name=Path(path).name.removesuffix(".html"),
        about={"Processed": processed()},
        unit={"metre": " m", "degree": "°"}.get(parse_crs(document["crs"]).axis_info[0].unit_name, ""),
        lines=summary_text(document).split("\n")[1:],
        picture=base64.b64encode(png).decode(),
        drawn=None if owners is None else _outlines(owners),
        seams=seams[:_LISTED],
        left_out=max(0, len(seams) - _LISTED),
        has_along=any(seam.get("after") for seam in seams),
    )
    write_text(path, page)


def _outlines(owners: Owners) -> dict[str, Any]:
    """Return the lines between scenes as an SVG path, and the width and height that it is drawn in."""
    step = max(1, -(-max(owners.owners.shape) // _DRAWN))
    labels = owners.owners[::step, ::step]
    parts = []
    for labels_of, form in ((labels, "M{1} {0}h{2}"), (labels.T, "M{0} {1}v{2}")):
        differs = (labels_of[1:] != labels_of[:-1]) & (labels_of[1:] >= 0) & (labels_of[:-1] >= 0)
        edges = np.diff(np.pad(differs, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        (line, begin), (_, end) = np.nonzero(edges == 1), np.nonzero(edges == -1)
        parts += [form.format(row + 1, first, last - first) for row, first, last in zip(line, begin, end, strict=True)]
    return {"path": "".join(parts), "width": labels.shape[1], "height": labels.shape[0]}
