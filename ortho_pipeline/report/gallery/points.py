"""The points as they were measured: a chip of the scene for each, with the measured and the predicted place."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.estimation.records import Pair, Point, is_known
from ortho_pipeline.raster.verified_writing import png_bytes
from ortho_pipeline.report.gallery.chips import stretched
from ortho_pipeline.report.records import SceneReport

if TYPE_CHECKING:
    from ortho_pipeline.raster.source import RasterSource

#: Side of a chip, px, how many of them lie next to each other in the picture, and how many there are at most.
SIDE, _COLUMNS, _MOST = 41, 12, 120
#: The larger of measured and predicted is at most this share of half a chip from its middle.
_INSIDE = 0.75


@dataclass(frozen=True)
class Chip:
    """A chip: its point (number and record), its corner in the picture, and places in it, px of the picture.

    `factor` is how many pixels of the scene one of the chip is; `predicted` is None where it is not known.
    """

    index: int
    point: Point
    corner: tuple[int, int]
    factor: int
    measured: Pair
    predicted: Pair | None


@dataclass(frozen=True)
class PointChips:
    """Chips in the order of the points, the picture (PNG in base64) with its size, and how many points there are."""

    chips: tuple[Chip, ...]
    picture: str
    size: tuple[int, int]
    of: int
    side: int = SIDE


def point_chips(report: SceneReport, source: RasterSource) -> PointChips | None:
    """Return chips about the measured points, of at most 120: then those with the largest residuals.

    Matches have chips of their own, next to those of the reference; points outside of the image have none.
    """
    matched = report.matched_places
    known = [
        (k, point, point.image)
        for k, point in enumerate(report.adjustment.points)
        if point.role != "tie" and is_known(point.image) and point.image not in matched and _in(point.image, source)
    ]
    known = sorted(known, key=lambda one: -(one[1].length or 0.0))[:_MOST]
    rows = math.ceil(len(known) / _COLUMNS)
    step = SIDE + 1
    sheet = np.zeros((2, max(rows, 1) * step, min(max(len(known), 1), _COLUMNS) * step), dtype=np.uint8)
    chips = []
    for place, (k, point, image) in enumerate(sorted(known, key=lambda one: one[0])):
        down, across = divmod(place, _COLUMNS)
        left, top = across * step, down * step
        factor = _factor(point)
        window = _start(image[0], factor), _start(image[1], factor)
        try:
            sheet[:, top : top + SIDE, left : left + SIDE] = stretched(_read(source, window, factor))
        except OrthoError:
            # A block that cannot be read, which the ortho may not have needed.
            continue
        at = [(image[axis] - window[axis]) / factor for axis in (0, 1)]
        shift = point.residual if is_known(point.residual) else None
        to = None if shift is None else (at[0] - shift[0] / factor, at[1] - shift[1] / factor)
        chips.append(Chip(k, point, (left, top), factor, (at[0], at[1]), to))
    if not chips:
        return None
    picture = base64.b64encode(png_bytes(sheet)).decode()
    return PointChips(tuple(chips), picture, (sheet.shape[2], sheet.shape[1]), len(report.adjustment.points))


def _in(image: Pair, source: RasterSource) -> bool:
    return 0 <= image[0] <= source.width and 0 <= image[1] <= source.height


def _factor(point: Point) -> int:
    """Return how many pixels of the scene a pixel of the chip is: more where the prediction is far away."""
    reach = max(map(abs, point.residual)) if is_known(point.residual) else 0.0
    # Gross errors beyond this would need more pixels of the scene than a chip is worth.
    return min(max(1, math.ceil(reach / (_INSIDE * SIDE / 2))), 16)


def _start(middle: float, factor: int) -> int:
    return math.floor(middle) - SIDE * factor // 2


def _read(source: RasterSource, window: tuple[int, int], factor: int) -> NDArray[np.float64]:
    """Return a chip ``(SIDE, SIDE)`` as the mean of its bands, NaN where there is no image."""
    size = SIDE * factor
    chip = np.full((size, size), np.nan)
    left, top = max(window[0], 0), max(window[1], 0)
    right, low = min(window[0] + size, source.width), min(window[1] + size, source.height)
    if right > left and low > top:
        pixels = source.read(left, top, right - left, low - top)
        valid = source.read_valid(left, top, pixels)
        values = np.abs(pixels).astype(np.float64)
        if valid is not None:
            values[~valid] = np.nan
        chip[top - window[1] : low - window[1], left - window[0] : right - window[0]] = values.mean(axis=0)
    return chip.reshape(SIDE, factor, SIDE, factor).mean(axis=(1, 3))
