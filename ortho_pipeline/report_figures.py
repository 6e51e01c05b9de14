"""Figures of the report: the plot of residual vectors as SVG, and the preview of the orthoimage as PNG.

The plot is written as SVG directly: its colours are CSS variables, so that one drawing suits a light page, a dark one
and paper, and the ids of the points stay text.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from html import escape
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.raster import open_dataset

#: Drawing area of the plot in CSS pixels, and the space around it.
_PLOT_WIDTH, _PLOT_HEIGHT, _PAD = 452.0, 460.0, 19.0
#: The longest arrow, as a share of the drawing area.
_LONGEST = 0.13
#: With more points than this, their ids would hide the arrows.
_MAX_LABELS = 60
#: GDAL's number for averaging in a raster read.
_AVERAGE = 5

_STYLE = """<style>
.residuals text{font:12px system-ui,-apple-system,"Segoe UI",sans-serif;fill:currentColor}
.residuals .quiet{opacity:.6}
.residuals .frame{fill:none;stroke:currentColor;stroke-opacity:.45}
.residuals .control{stroke:var(--control,#2563a8);fill:var(--control,#2563a8)}
.residuals .check{stroke:var(--check,#c2570c);fill:var(--check,#c2570c)}
.residuals .out{stroke:currentColor;stroke-opacity:.6;fill:none;stroke-width:1.6}
.residuals .bar{stroke:currentColor;fill:currentColor}
.residuals line{stroke-width:1.7}
.residuals circle.check,.residuals rect.check{fill:var(--paper,#fff);stroke-width:1.8}
</style>"""


def plot_residuals(report: Mapping[str, Any]) -> str:
    """Draw the residual vectors over the frame of the image, as SVG.

    Used control points are dots, check points squares, points that were left out crosses without an arrow. Points
    outside of the image are drawn where they are, tie points not at all. Empty text where nothing is left to draw.
    """
    points = [p for p in report["adjustment"]["points"] if p["residual"] and p["image"] and p["role"] != "tie"]
    if not points:
        return ""
    width, height = report["scene"]["size"]
    image = np.array([point["image"] for point in points])
    low, high = np.minimum(image.min(axis=0), 0.0), np.maximum(image.max(axis=0), (width, height))
    scale = min(_PLOT_WIDTH / (high[0] - low[0]), _PLOT_HEIGHT / (high[1] - low[1]))
    wide, tall = (high - low) * scale + 2 * _PAD
    wide = max(wide, 340.0)
    shift = np.array([(wide - (high[0] - low[0]) * scale) / 2, _PAD]) - low * scale
    lengths = [math.hypot(*point["residual"]) for point in points if not _is_out(point)]
    longest = max(lengths, default=0.0)
    arrow = _LONGEST * min(_PLOT_WIDTH, max(tall - 2 * _PAD, wide / 2)) / longest if longest > 0 else 0.0
    label = len(points) <= _MAX_LABELS
    x0, y0 = shift
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" class="residuals" viewBox="0 0 {wide:.0f} {tall + 36:.0f}" '
        f'role="img" aria-label="Residual vectors of {len(points)} points over the frame of the image">{_STYLE}',
        f'<rect class="frame" x="{x0:.1f}" y="{y0:.1f}" width="{width * scale:.1f}" height="{height * scale:.1f}"/>',
        _text(x0, y0 - 8, "0, 0", "quiet"),
        _text(x0 + width * scale, y0 + height * scale + 15, f"{width}, {height}", "quiet", "end"),
        *(_point(point, np.array(point["image"]) * scale + shift, arrow, label) for point in points),
        _legend(points, arrow, longest, tall + 20, wide),
        "</svg>",
    ]
    return "\n".join(parts)


def _is_out(point: Mapping[str, Any]) -> bool:
    return point["role"] == "control" and not point["used"]


def _point(point: Mapping[str, Any], at: NDArray[np.float64], arrow: float, label: bool) -> str:
    x, y = at
    dx, dy = (value * arrow for value in point["residual"])
    sizes = f"{point['residual'][0]:+.2f}, {point['residual'][1]:+.2f} px"
    kind = "out" if _is_out(point) else ("check" if point["role"] == "check" else "control")
    parts = [f"<g><title>{escape(str(point['id']))} ({point['role']}): {sizes}</title>"]
    if kind != "out":
        parts.append(_arrow(x, y, dx, dy, kind))
    parts.append(_mark(x, y, kind))
    if label:
        # Beside the point, on the side that the arrow does not go to.
        side, anchor = (-9, "end") if dx > 0 else (9, "start")
        parts.append(_text(x + side, y + (4 if abs(dx) > abs(dy) else (-5 if dy > 0 else 12)), str(point["id"]),
                           "quiet" if kind == "out" else "", anchor))  # fmt: skip
    return "".join([*parts, "</g>"])


def _mark(x: float, y: float, kind: str) -> str:
    if kind == "out":
        return f'<path class="out" d="M{x - 5:.1f} {y - 5:.1f}l10 10m0 -10l-10 10"/>'
    if kind == "check":
        return f'<rect class="check" x="{x - 3.6:.1f}" y="{y - 3.6:.1f}" width="7.2" height="7.2"/>'
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="3.4"/>'


def _arrow(x: float, y: float, dx: float, dy: float, kind: str) -> str:
    length = math.hypot(dx, dy)
    if length < 1.0:
        return ""
    ux, uy = dx / length, dy / length
    head = min(8.0, 0.6 * length + 2.0)
    tip_x, tip_y = x + dx, y + dy
    base_x, base_y = tip_x - head * ux, tip_y - head * uy
    wing = 0.42 * head
    return (
        f'<line class="{kind}" x1="{x:.1f}" y1="{y:.1f}" x2="{base_x:.1f}" y2="{base_y:.1f}"/>'
        f'<path class="{kind}" stroke="none" d="M{tip_x:.1f} {tip_y:.1f}L{base_x - wing * uy:.1f} '
        f'{base_y + wing * ux:.1f}L{base_x + wing * uy:.1f} {base_y - wing * ux:.1f}Z"/>'
    )


def _legend(points: list[Mapping[str, Any]], arrow: float, longest: float, y: float, wide: float) -> str:
    kinds = [("control", "control"), ("check", "check"), ("out", "left out")]
    present = {"out" if _is_out(p) else ("check" if p["role"] == "check" else "control") for p in points}
    parts, x = [], _PAD + 4.0
    for kind, name in kinds:
        if kind in present:
            parts += [_mark(x, y, kind), _text(x + 11, y + 4, name)]
            x += 32 + 6.6 * len(name)
    if longest > 0:
        size = _round_down(longest)
        bar = size * arrow
        parts += [
            _arrow(wide - _PAD - bar, y, bar, 0.0, "bar"),
            _text(wide - _PAD - 8 - bar, y + 4, f"{size:g} px", "", "end"),
        ]
    return "".join(parts)


def _text(x: float, y: float, text: str, kind: str = "", anchor: str = "start") -> str:
    style = f' class="{kind}"' if kind else ""
    return f'<text{style} x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))


# -- preview ---------------------------------------------------------------------------------------------------------


def preview_png(path: str | PathLike[str], *, side: int = 800) -> bytes:
    """Return a reduced, contrast-stretched copy of a raster as PNG, transparent where it has no value.

    Three bands or more give colours (the first three in their order), fewer give grey.
    """
    dataset = open_dataset(path)
    shrink = min(1.0, side / max(dataset.RasterXSize, dataset.RasterYSize))
    size = max(1, round(dataset.RasterXSize * shrink)), max(1, round(dataset.RasterYSize * shrink))
    reading = {"buf_xsize": size[0], "buf_ysize": size[1]}
    bands = [dataset.GetRasterBand(k + 1) for k in range(3 if dataset.RasterCount >= 3 else 1)]
    mask = bands[0].GetMaskBand().ReadAsArray(**reading) > 0
    planes = [_stretched(np.abs(band.ReadAsArray(resample_alg=_AVERAGE, **reading)), mask) for band in bands]
    return _png(np.stack([*planes, np.where(mask, 255, 0).astype(np.uint8)], axis=2))


def _stretched(values: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    values = values.astype(np.float64)
    seen = values[mask & np.isfinite(values)]
    if not len(seen):
        return np.zeros(values.shape, dtype=np.uint8)
    low, high = np.percentile(seen, [1.0, 99.0])
    scaled = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0)
    return np.nan_to_num(scaled * 255.0).astype(np.uint8)


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """Encode ``(rows, columns, 2 or 4)`` grey-alpha or RGBA bytes (PNG specification, filter "up")."""
    rows, columns, channels = pixels.shape
    before = np.concatenate([np.zeros_like(pixels[:1]), pixels[:-1]])
    lines = np.full((rows, 1 + columns * channels), 2, dtype=np.uint8)
    lines[:, 1:] = (pixels - before).reshape(rows, -1)
    header = struct.pack(">IIBBBBB", columns, rows, 8, 4 if channels == 2 else 6, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes(), 9)), (b"IEND", b"")]
    body = b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body
