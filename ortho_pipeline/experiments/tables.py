"""What the reproductions of all papers share: the paper's numbers, ours beside them, and how many agree.

An experiment is a sequence of `Number`, one for each number of the paper's tables (and, with `paper` None, for what the
paper did not have), and an array of what came out in each realisation. `make_document` puts them together; `page` shows
the document.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.models.base import Array

#: A number counts as reproduced within this factor of the paper's.
FACTOR = 1.5


@dataclass(frozen=True)
class Number:
    """One number of a table: which row and column it is in, and what the paper found (None: nothing)."""

    table: int | str
    label: str
    quantity: str
    paper: float | None = None


@dataclass(frozen=True)
class Statement:
    """A sentence of the paper, whether it holds for our medians, and the numbers that say so."""

    text: str
    holds: bool
    detail: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the statement as JSON values."""
        return {"text": self.text, "holds": bool(self.holds), "detail": self.detail}


@dataclass(frozen=True)
class Curve:
    """Values ``y`` over ``x`` for each named series; None in ``y`` where there is no value."""

    title: str
    x_label: str
    y_label: str
    series: Mapping[str, tuple[Sequence[float], Sequence[float | None]]]

    def to_json(self) -> dict[str, Any]:
        """Return the curve as JSON values."""
        series = [{"name": name, "x": list(x), "y": list(y)} for name, (x, y) in self.series.items()]
        return {"title": self.title, "x_label": self.x_label, "y_label": self.y_label, "series": series}


def make_document(
    paper: str,
    *,
    sensor: str,
    units: str,
    settings: Mapping[str, Any],
    settings_text: str,
    numbers: Sequence[Number],
    found: ArrayLike,
    titles: Mapping[Any, str],
    statements: Sequence[Statement] = (),
    curves: Sequence[Curve] = (),
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the document of ``ortho reproduce`` (docs/formats.md).

    Parameters
    ----------
    units : str
        Of the numbers, as it stands in the head of a table: ``px`` or ``m``.
    found : (R, N)
        What came out in each realisation for each of `numbers`; NaN where nothing could be fitted.
    titles : mapping
        Title of each table, in the order of the page.
    """
    values = np.asarray(found, dtype=np.float64)
    lines = [line(number, values[:, k]) for k, number in enumerate(numbers)]
    tables = [
        {"table": table, "title": title,
         "rows": [row for row, number in zip(lines, numbers, strict=True) if number.table == table]}
        for table, title in titles.items() if any(number.table == table for number in numbers)
    ]  # fmt: skip
    compared = np.array([number.paper is not None for number in numbers])
    return {
        "paper": paper,
        "sensor": sensor,
        "units": units,
        "settings": dict(settings),
        "settings_text": settings_text,
        "summary": _summary([row for row in lines if row["paper"] is not None], values[:, compared]),
        "tables": tables,
        "statements": [statement.to_json() for statement in statements],
        "curves": [curve.to_json() for curve in curves],
        "notes": list(notes),
    }


def line(number: Number, values: Array) -> dict[str, Any]:
    """Return the row of a document for one number and its values ``(R,)``."""
    finite = values[np.isfinite(values)]
    low, middle, high = np.percentile(finite, (5, 50, 95)).tolist() if len(finite) else (None, None, None)
    return {
        "label": number.label, "quantity": number.quantity, "paper": number.paper, "median": middle, "p5": low,
        "p95": high, "failed": len(values) - len(finite),
    }  # fmt: skip


def is_within(row: Mapping[str, Any], factor: float = FACTOR) -> bool:
    """Tell whether our median of a row is within a factor of the paper's number; True where the paper has none."""
    if row["paper"] is None:
        return True
    return row["median"] is not None and 1 / factor <= row["median"] / row["paper"] <= factor


def within_factor(document: Mapping[str, Any], factor: float = FACTOR) -> float:
    """Return the share of the paper's numbers that ours are within a factor of."""
    rows = [row for table in document["tables"] for row in table["rows"] if row["paper"] is not None]
    return sum(is_within(row, factor) for row in rows) / len(rows)


def _summary(rows: list[dict[str, Any]], values: Array) -> dict[str, Any]:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = values / np.array([np.nan if row["median"] is None else row["median"] for row in rows])
        close = (ratio >= 1 / FACTOR) & (ratio <= FACTOR)
    low, middle, high = np.percentile(close.mean(axis=1), (5, 50, 95)).tolist()
    return {
        "factor": FACTOR,
        "rows": len(rows),
        "within": sum(is_within(row) for row in rows),
        "single_realisation": {"median": middle, "p5": low, "p95": high},
    }
