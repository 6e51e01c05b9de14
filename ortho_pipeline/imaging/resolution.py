"""Effective resolution of an image: finds and measures its edges; results as document, text and plot.

Edges are searched in windows spread over the image: straight runs of strong gradient (Canny's outlines, a probabilistic
Hough transform) between even areas. Edges that are not sharp on the ground are wider, so the median counts, and its
spread shows their effect.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ortho_pipeline.display.drawing import Axes, Drawing
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.imaging.edge import HALF_WIDTH, Array, Edge, Segment, analyse_edge, said
from ortho_pipeline.options import numbers_of
from ortho_pipeline.raster.source import RasterSource

SCHEMA_VERSION = 1
#: Largest number of windows, their side (px), and largest number of edges.
_WINDOWS, _WINDOW, _MOST = 16, 768, 30
#: Limits of found edges: width of the even areas (px), least step (in standard deviations of the noise), largest misfit
#: of the model, and largest error of the width (as shares).
_NARROW, _CLEAR, _MISFIT, _UNSURE = 5.0, 6.0, 0.06, 0.1
#: Edges closer than this (px) are the same.
_APART = 5.0
#: Longest given edge (px), and overshoot above which an image is called sharpened.
_LONGEST, _SHARPENED = 5000, 0.03
#: Smallest significant standard deviation (px) of a point spread.
_NONE = 0.1

# -- finding edges ---------------------------------------------------------------------------------------------------


def find_edges(pixels: Array, limits: tuple[float, ...] = ()) -> list[Edge]:
    """Find straight edges between even areas, clearest first, and measure them.

    Parameters
    ----------
    pixels : (H, W)
        NaN where there is no value.
    limits : tuple of float
        Values of saturated pixels.

    Returns
    -------
    list of Edge
        Empty if there is none; each crosses ten lines of pixels or more.
    """
    clear: list[Edge] = []
    for segment in _candidates(pixels):
        try:
            edge = analyse_edge(pixels, segment, half_width=_NARROW, limits=limits)
        except InputError:
            continue
        if edge.contrast < _CLEAR * edge.noise or edge.misfit > _MISFIT or edge.sigma_error > _UNSURE * edge.sigma:
            continue
        clear.append(edge)
        if len(clear) >= 2 * _MOST:
            break
    return _distinct(clear, _MOST)


def _distinct(edges: Iterable[Edge], most: int) -> list[Edge]:
    """Return the clearest edges, without parts of other edges."""
    kept: list[Edge] = []
    for edge in sorted(edges, key=lambda edge: edge.noise / edge.contrast):
        middle = np.mean(edge.segment, axis=0)
        if all(_distance(middle, other.segment) > _APART for other in kept):
            kept.append(edge)
    return kept[:most]


def _distance(point: Array, segment: Segment) -> float:
    """Return the distance of a point from a segment, extended by `_APART` at both ends."""
    first, last = np.array(segment)
    length = float(np.hypot(*(last - first)))
    along = (last - first) / length
    share = float(np.clip((point - first) @ along, -_APART, length + _APART))
    return float(np.hypot(*(point - first - share * along)))


def _candidates(pixels: Array) -> Iterable[Segment]:
    """Return straight runs of strong gradient, the longest first, without their ends."""
    from skimage.feature import canny
    from skimage.transform import probabilistic_hough_line

    known = np.isfinite(pixels)
    if known.sum() < 400:
        return []
    low, high = np.percentile(pixels[known], (1.0, 99.0))
    if not high > low:
        return []
    even = np.where(known, np.clip((pixels - low) / (high - low), 0.0, 1.0), 0.0)
    outline = canny(even, sigma=1.5, low_threshold=0.02, high_threshold=0.06, mask=known)
    lines = probabilistic_hough_line(outline, threshold=10, line_length=15, line_gap=1, rng=0)
    # The centre of a pixel is half a pixel from its corner.
    ends = [(np.array(first) + 0.5, np.array(last) + 0.5) for first, last in lines]
    ends.sort(key=lambda pair: -float(np.hypot(*(pair[1] - pair[0]))))
    return [_shortened(first, last) for first, last in ends[: 20 * _MOST]]


def _shortened(first: Array, last: Array) -> Segment:
    step = 2.0 * (last - first) / np.hypot(*(last - first))
    (x1, y1), (x2, y2) = (first + step).tolist(), (last - step).tolist()
    return (x1, y1), (x2, y2)


# -- a file ----------------------------------------------------------------------------------------------------------


def parse_edge(text: str) -> Segment:
    """Read ``x1,y1,x2,y2``.

    Raises
    ------
    InputError
        If it is not four finite numbers.
    """
    numbers = numbers_of(text)
    if len(numbers) != 4 or any(map(math.isnan, numbers)):
        raise InputError(
            f"{text!r} is not an edge",
            field="edge",
            remedy="give columns and rows of both ends, such as 120.5,30,140,95",
        )
    return (numbers[0], numbers[1]), (numbers[2], numbers[3])


def measure(
    image: str | os.PathLike[str], *, edge: Segment | None = None, band: int = 1, allow_network: bool = False
) -> list[Edge]:
    """Measure one given edge of an image, or the edges found in windows spread over it.

    Raises
    ------
    InputError
        If the image or the edge cannot be used, or no edge is found.
    """
    source = RasterSource(image, allow_network=allow_network)
    if not 1 <= band <= source.count:
        raise InputError(
            f"there is no band {band}: the image has {counted(source.count, 'band')}",
            file=source.path,
            field="band",
            remedy=f"give one from 1 to {source.count}",
        )
    if edge is not None:
        return [_given(source, edge, band)]
    edges: list[Edge] = []
    for left, top, width, height in _windows(source.width, source.height):
        inside = find_edges(_pixels(source, band, left, top, width, height), _limits(source))
        edges += [_moved(part, left, top) for part in inside]
    if not edges:
        raise InputError(
            "no suitable edge found: it must be straight, between even unsaturated areas, and oblique",
            file=source.path,
            remedy=Text("give one with ", Setting("edge", "x1,y1,x2,y2")),
        )
    return _distinct(edges, _MOST)


def _given(source: RasterSource, edge: Segment, band: int) -> Edge:
    (x1, y1), (x2, y2) = edge
    reach = 2 * HALF_WIDTH + 2
    numbers = np.array([x1, y1, x2, y2])
    known = np.isfinite(numbers).all() and (numbers >= 0).all()
    if not (known and max(x1, x2) <= source.width and max(y1, y2) <= source.height):
        raise InputError(
            f"the edge {said(edge)} is outside the image of {source.width} x {source.height} pixels",
            file=source.path,
            field="edge",
            remedy="give columns and rows within the image",
        )
    if math.hypot(x2 - x1, y2 - y1) > _LONGEST:
        raise InputError(
            f"the edge is longer than the limit of {_LONGEST} pixels",
            file=source.path,
            field="edge",
            remedy="give a part of it",
        )
    left, top = max(0, math.floor(min(x1, x2) - reach)), max(0, math.floor(min(y1, y2) - reach))
    right = min(source.width, math.ceil(max(x1, x2) + reach))
    bottom = min(source.height, math.ceil(max(y1, y2) + reach))
    pixels = _pixels(source, band, left, top, right - left, bottom - top)
    try:
        inside = (x1 - left, y1 - top), (x2 - left, y2 - top)
        return _moved(analyse_edge(pixels, inside, limits=_limits(source)), left, top)
    except InputError as error:
        raise InputError(error.message, file=source.path, field=error.field, remedy=error.remedy) from error


def _windows(width: int, height: int) -> list[tuple[int, int, int, int]]:
    """Return at most `_WINDOWS` windows (left, top, width, height), spread evenly over an image."""
    side = math.isqrt(_WINDOWS)

    def along(length: int) -> list[tuple[int, int]]:
        count = min(side, max(1, math.ceil(length / _WINDOW)))
        size = min(_WINDOW, length)
        return [(round(start), size) for start in np.linspace(0, length - size, count)]

    return [(left, top, wide, tall) for top, tall in along(height) for left, wide in along(width)]


def _pixels(source: RasterSource, band: int, left: int, top: int, width: int, height: int) -> Array:
    """Return one band of a window as floats, NaN where there is no value."""
    stack = source.read(left, top, width, height)
    valid = source.read_valid(left, top, stack)
    pixels: Array = stack[band - 1].astype(np.float64)
    if valid is not None:
        pixels[~valid[band - 1]] = np.nan
    return pixels


def _limits(source: RasterSource) -> tuple[float, ...]:
    """Return the values of saturated pixels: the ends of an integer type, and the largest of so many bits."""
    if source.dtype.kind not in "iu":
        return ()
    ends = np.iinfo(source.dtype)
    bits = {band.GetMetadataItem("NBITS", "IMAGE_STRUCTURE") for band in source.bands} - {None}
    return float(ends.min), float(ends.max), *(2.0 ** int(number) - 1 for number in bits)


def _moved(edge: Edge, left: int, top: int) -> Edge:
    (x1, y1), (x2, y2) = edge.segment
    return replace(edge, segment=((x1 + left, y1 + top), (x2 + left, y2 + top)))


# -- results ---------------------------------------------------------------------------------------------------------


def document(edges: Sequence[Edge], image: str | os.PathLike[str], band: int) -> dict[str, Any]:
    """Return what ``ortho edge --json`` prints (docs/engineering/formats.md): each edge, and medians by direction."""
    groups = {"all": list(edges)}
    groups |= {name: [edge for edge in edges if edge.profile == name] for name in ("along the row", "along the column")}
    return {
        "schema_version": SCHEMA_VERSION,
        "image": os.fspath(image),
        "band": band,
        "edges": [edge.to_json() for edge in edges],
        "median": {name: _medians(group) for name, group in groups.items()},
    }


def _medians(edges: Sequence[Edge]) -> dict[str, Any] | None:
    """Return median and spread (scaled median absolute deviation; None for one edge) of each width."""
    if not edges:
        return None
    medians: dict[str, Any] = {"n": len(edges)}
    for name in ("fwhm", "sigma", "psf_sigma"):
        values = np.array([getattr(edge, name) for edge in edges])
        median = float(np.median(values))
        medians[f"{name}_px"] = median
        medians[f"{name}_spread_px"] = None if len(edges) < 2 else 1.4826 * float(np.median(np.abs(values - median)))
    medians["overshoot"] = float(np.median([edge.overshoot for edge in edges]))
    return medians


def typical(edges: Sequence[Edge]) -> Edge:
    """Return the edge whose line spread is nearest to the median width."""
    middle = float(np.median([edge.fwhm for edge in edges]))
    return min(edges, key=lambda edge: abs(edge.fwhm - middle))


def text(result: dict[str, Any]) -> str:
    """Return the document as a table, with its interpretation."""
    lines = [
        f"{'edge (x1,y1,x2,y2)':<36}{'angle':>6}{'lines':>7}{'contrast':>10}{'noise':>8}{'FWHM':>8}{'sigma':>8}"
        f"{'PSF sigma':>16}"
    ]
    for edge in result["edges"]:
        place = ",".join(f"{value:.1f}" for end in edge["edge"] for value in end)
        lines.append(
            f"{place:<36}{edge['angle_deg']:>6.1f}{edge['lines']:>7}{edge['contrast']:>10.4g}{edge['noise']:>8.2g}"
            f"{edge['fwhm_px']:>8.2f}{edge['sigma_px']:>8.2f}"
            + (
                f"{'below 0.1':>16}"
                if edge["psf_sigma_px"] < _NONE
                else f"{edge['psf_sigma_px']:>9.2f} ± {edge['psf_sigma_error_px']:.2f}"
            )
        )
    lines.append("")
    median = result["median"]
    for name, group in median.items():
        if group is None or (name != "all" and None in (median["along the row"], median["along the column"])):
            continue
        spread = "" if group["fwhm_spread_px"] is None else f" ± {group['fwhm_spread_px']:.2f}"
        count = counted(group["n"], "edge")
        what = "" if name == "all" else f", profiles {name}"
        lines.append(
            f"Effective resolution {group['fwhm_px']:.2f}{spread} px (FWHM; {count}{what}), "
            f"PSF sigma {group['psf_sigma_px']:.2f} px"
        )
    lines.append("FWHM and sigma include the aperture of the pixel (alone: 1.00 and 0.29 px); the PSF sigma does not.")
    if median["all"]["overshoot"] > _SHARPENED:
        share = 100 * median["all"]["overshoot"]
        lines.append(
            f"The edges overshoot by {share:.0f} % of their step: the image is sharpened, and the optics are worse."
        )
    if median["all"]["fwhm_px"] < 0.9:
        lines.append("This is narrower than the aperture of a pixel: sharpened, or sampled without an aperture.")
    return "\n".join(lines)


def plot(edge: Edge) -> Drawing:
    """Draw the edge spread and the line spread of an edge against the distance from it."""
    drawing = Drawing(840, 420, "Edge spread and line spread of an edge", "edge")
    reach = float(min(np.abs(edge.distance[[0, -1]]).min(), max(3.0, 4 * edge.sigma)))
    near = np.abs(edge.distance) <= reach
    for left, values, name in ((0.0, edge.esf, "edge spread"), (420.0, edge.lsf, "line spread, per px")):
        shown = values[near]
        margin = 0.08 * float(np.ptp(shown))
        low, high = float(shown.min()) - margin, float(shown.max()) + margin
        axes = Axes(drawing, (left + 52.0, 14.0, 354.0, 316.0), (-reach, reach), (low, high))
        axes.draw("distance from the edge, px", name, margin=left)
        at = [axes.at(x, y) for x, y in zip(edge.distance[near], shown, strict=True)]
        for start, end in itertools.pairwise(at):
            drawing.line("control", *start, *end)
        for x, y in at:
            drawing.circle("control", x, y, 2.4)
    drawing.text(58, 404, f"FWHM {edge.fwhm:.2f} px, with the aperture of the pixel; PSF sigma {edge.psf_sigma:.2f} px")
    return drawing
