"""Styles in QGIS of layers next to an ortho: one band in five steps of colour."""

from __future__ import annotations

from collections.abc import Callable

from ortho_pipeline.display.pages import render

_COLOURS = ("#2563a8", "#7fb3d5", "#f4f1de", "#e59866", "#b4500b")


def raster_style(band: int, low: float, high: float, label: Callable[[float], str]) -> str:
    """Return a QGIS style (QML) that shows a band (from 1) of a raster from a low to a high value."""
    high = max(high, 1.01 * low)
    values = [low + (high - low) * k / (len(_COLOURS) - 1) for k in range(len(_COLOURS))]
    stops = [(f"{value:.6g}", label(value), colour) for value, colour in zip(values, _COLOURS, strict=True)]
    return render("report/raster.qml.j2", band=band, low=stops[0][0], high=stops[-1][0], stops=stops)
