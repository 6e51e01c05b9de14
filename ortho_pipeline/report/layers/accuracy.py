"""The layer of accuracy in the report: its record, what it says in words, its map and its style in QGIS."""

from __future__ import annotations

from typing import Annotated

import pydantic

from ortho_pipeline.display.drawing import Drawing
from ortho_pipeline.display.numbers import metres, share
from ortho_pipeline.files.json.records import Record

#: What makes up the error of an ortho, in words.
_NAMES = {
    "points": "the control points",
    "model": "the delivered model",
    "heights": "the heights",
    "reference": "the reference image",
    "interpolation": "the warp",
}
#: Side of the map in CSS pixels.
_SIDE = 420.0
Share = Annotated[float, pydantic.Field(ge=0)]


class AccuracyLayer(Record):
    """How accurate the pixels of the ortho are; docs/engineering/accuracy.md says what each number is.

    `ce90_m` holds 90 % of the errors of all pixels together, `range_m` is 5, 50 and 95 % of the pixels' own, `sigma_m`
    the root mean square east and north. `shares` are parts of the mean variance, `unknown` is what nobody said anything
    of, `cells` the mean ce90 in cells of `cell` pixels of the ortho, from the northwest.
    """

    ce90_m: float
    range_m: tuple[float, float, float]
    sigma_m: tuple[float, float]
    shares: dict[str, Share]
    unknown: tuple[str, ...]
    known: Share
    assumptions: tuple[str, ...]
    cell: int
    cells: tuple[tuple[float | None, ...], ...]

    @property
    def statement(self) -> str:
        """Return what the layer comes to in words."""
        ordered = sorted(((part, name) for name, part in self.shares.items() if part >= 0.01), reverse=True)
        parts = ", ".join(f"{share(part)} {_NAMES[name]}" for part, name in ordered)
        low, _, high = self.range_m
        least = "" if not self.unknown else "at least "
        said = (
            f"CE90 over the scene: {least}{metres(self.ce90_m)} ({metres(low)} to {metres(high)} in 90 % of the area). "
            f"Sources of the variance: {parts}."
        )
        if self.unknown:
            said += f" Unknown and not included: {' and '.join(_NAMES[name] for name in self.unknown)}."
        if self.known < 1.0:
            said += f" In {share(1.0 - self.known)} of the pixels the height accuracy is not stated."
        return said


def plot_accuracy(layer: AccuracyLayer | None) -> Drawing | None:
    """Draw the map of ce90: the darker, the less accurate, with a scale in metres."""
    if layer is None or not any(value is not None for row in layer.cells for value in row):
        return None
    values = [value for row in layer.cells for value in row if value is not None]
    low, high = min(values), max(values)
    rows, columns = len(layer.cells), max(len(row) for row in layer.cells)
    side = _SIDE / max(rows, columns)
    drawing = Drawing(_SIDE, rows * side + 52, "Map of the 90 % circular error of the ortho", "accuracy")

    def strength(value: float) -> float:
        # Even where all is alike, a cell is told from no cell.
        return 0.12 + 0.88 * (value - low) / (high - low) if high > 1.02 * low else 0.5

    left = (_SIDE - columns * side) / 2
    for j, row in enumerate(layer.cells):
        for i, value in enumerate(row):
            if value is not None:
                with drawing.titled(f"CE90 {metres(value)}"):
                    drawing.rect("minus", left + i * side, j * side, side, side, strength(value))
    drawing.rect("frame", left, 0, columns * side, rows * side)
    base, wide = rows * side + 14, 180.0
    steps = 24
    for k in range(steps):
        value = low + (high - low) * (k + 0.5) / steps
        drawing.rect("minus", left + k * wide / steps, base, wide / steps, 12, strength(value))
    drawing.text(left, base + 28, metres(low), quiet=True)
    drawing.text(left + wide, base + 28, metres(high), quiet=True, anchor="end")
    drawing.text(left + wide + 14, base + 11, "CE90")
    return drawing
