"""Tables of the reproductions: the paper's numbers compared with ours, and the conclusions.

An experiment has a sequence of `Number`, one for each number of the paper's tables (`paper` is None for numbers that
the paper does not have), a sequence of `Knob`, one for each chosen setting, and an array with the results of all
realisations. `make_document` combines them; `page` shows the document.

A number to which a setting was fitted proves nothing, so it is counted separately. The others are predictions. Each is
also compared with a naive guess from other numbers of the paper, without simulation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.models.base import Array

#: Numbers are counted within these factors of the paper's; the first is that which a row has to keep.
FACTORS = (1.5, 1.2)
SCHEMA_VERSION = 2
#: What a row is: a prediction, a number that a knob was fitted to, one draw of which only the spread can be known, and
#: what the paper did not have.
ROLES = ("predicted", "fitted", "draw", "extra")
#: Where the value of a knob comes from: this paper, elsewhere (published or customary), a choice, or rows of the paper.
SOURCES = ("paper", "published", "chosen", "fitted")
#: What became of a statement; ``by settings``: it holds, but could hardly fail to with the settings as they are.
VERDICTS = ("reproduced", "by settings", "not reproduced")


@dataclass(frozen=True)
class Number:
    """One number of a table.

    Attributes
    ----------
    table, label, quantity
        Which table, row and column it is in.
    units : str
        ``px``, ``m``, or empty where the number has none.
    paper : float, optional
        The number of the paper, if it has one.
    naive : float, optional
        A guess from other numbers of the paper.
    draw : bool
        The paper's number is a single draw from a distribution with a known spread.
    """

    table: int | str
    label: str
    quantity: str
    units: str
    paper: float | None = None
    naive: float | None = None
    draw: bool = False

    @property
    def key(self) -> str:
        """Text for comparison with the patterns of `Knob.rows`."""
        return f"{self.table}|{self.label}|{self.quantity}"


@dataclass(frozen=True)
class Knob:
    """A setting of an experiment.

    Attributes
    ----------
    value : number, string, sequence or mapping
        The value, with its units in `units`.
    source : str
        One of `SOURCES`.
    why : str
        The reason for the value.
    rows : tuple of str
        Numbers to which it was fitted: patterns ``table|label|quantity`` with ``*``; empty unless fitted.
    """

    name: str
    value: Any
    units: str
    source: str
    why: str
    rows: tuple[str, ...] = ()

    def fits(self, number: Number) -> bool:
        """Return whether the setting was fitted to a number."""
        return any(fnmatchcase(number.key, pattern) for pattern in self.rows)

    def to_json(self) -> dict[str, Any]:
        """Return the knob as JSON values."""
        return {
            "name": self.name,
            "value": self.value,
            "units": self.units,
            "source": self.source,
            "why": self.why,
            "rows": list(self.rows),
        }


@dataclass(frozen=True)
class Statement:
    """A statement of the paper, whether our results confirm it, with which numbers, and the reason if not.

    Attributes
    ----------
    by_settings : bool
        The settings make it true, so it proves nothing.
    """

    text: str
    holds: bool
    detail: str = ""
    why: str = ""
    by_settings: bool = False

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`."""
        return VERDICTS[2] if not self.holds else VERDICTS[int(self.by_settings)]

    def to_json(self) -> dict[str, Any]:
        """Return the statement as JSON values, with the reason if it is needed."""
        why = self.why if self.verdict != VERDICTS[0] else ""
        return {"text": self.text, "verdict": self.verdict, "detail": self.detail, "why": why}


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
    settings_text: str,
    knobs: Sequence[Knob],
    naive_text: str,
    numbers: Sequence[Number],
    found: ArrayLike,
    titles: Mapping[Any, str],
    statements: Sequence[Statement],
    curves: Sequence[Curve] = (),
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the document of ``ortho reproduce`` (docs/engineering/formats.md).

    Parameters
    ----------
    naive_text : str
        Method of the naive guesses of `numbers`.
    found : (R, N)
        Results of each realisation for each of `numbers`; NaN if nothing could be fitted.
    titles : mapping
        Title of each table, in the order of the page.
    """
    values = np.asarray(found, dtype=np.float64)
    lines = [_line(number, values[:, k], knobs) for k, number in enumerate(numbers)]
    tables = [
        {
            "table": table,
            "title": title,
            "rows": [row for row, number in zip(lines, numbers, strict=True) if number.table == table],
        }
        for table, title in titles.items()
        if any(number.table == table for number in numbers)
    ]
    return {
        "schema_version": SCHEMA_VERSION,
        "paper": paper,
        "sensor": sensor,
        "realisations": len(values),
        "settings_text": settings_text,
        "knobs": [knob.to_json() for knob in knobs],
        "naive_text": naive_text,
        "summary": _summary(lines, values),
        "tables": tables,
        "statements": [statement.to_json() for statement in statements],
        "curves": [curve.to_json() for curve in curves],
        "notes": list(notes),
    }


def _line(number: Number, values: Array, knobs: Sequence[Knob]) -> dict[str, Any]:
    """Return the row of a document for one number and its values ``(R,)``."""
    finite = values[np.isfinite(values)]
    low, middle, high = np.percentile(finite, (5, 50, 95)).tolist() if len(finite) else (None, None, None)
    fitted = [knob.name for knob in knobs if knob.fits(number)]
    role = ROLES[3] if number.paper is None else ROLES[1] if fitted else ROLES[2] if number.draw else ROLES[0]
    return {
        "label": number.label,
        "quantity": number.quantity,
        "units": number.units,
        "role": role,
        "fitted_by": fitted,
        "paper": number.paper,
        "naive": number.naive,
        "median": middle,
        "p5": low,
        "p95": high,
        "failed": len(values) - len(finite),
    }


def is_within(row: Mapping[str, Any], factor: float = FACTORS[0], which: str = "median") -> bool:
    """Return whether our median (or the naive guess) of a row is within a factor of the paper's number."""
    if row["paper"] is None or row[which] is None:
        return False
    return bool(1 / factor <= row[which] / row["paper"] <= factor)


def is_covered(row: Mapping[str, Any]) -> bool:
    """Return whether the paper's number is between the 5th and the 95th percentile of ours."""
    return row["median"] is not None and row["paper"] is not None and bool(row["p5"] <= row["paper"] <= row["p95"])


def is_missed(row: Mapping[str, Any]) -> bool:
    """Return whether a row disagrees with the paper: outside the factor, or for a draw, outside the percentiles."""
    if row["role"] == "extra":
        return False
    return not (is_covered(row) if row["role"] == "draw" else is_within(row))


def count(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the number of rows, and of those that agree, by each measure of a document."""
    return {
        "rows": len(rows),
        "within": {f"{factor:g}": sum(is_within(row, factor) for row in rows) for factor in FACTORS},
        "naive": {f"{factor:g}": sum(is_within(row, factor, "naive") for row in rows) for factor in FACTORS},
        "covered": sum(is_covered(row) for row in rows),
    }


def _summary(lines: list[dict[str, Any]], values: Array) -> dict[str, Any]:
    predicted = np.array([line["role"] == "predicted" for line in lines])
    rows = {role: [line for line in lines if line["role"] == role] for role in ROLES[:3]}
    medians = np.array([np.nan if line["median"] is None else line["median"] for line in rows["predicted"]])
    single = None
    if len(medians):
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = values[:, predicted] / medians
            close = (ratio >= 1 / FACTORS[0]) & (ratio <= FACTORS[0])
        single = dict(
            zip(("p5", "median", "p95"), np.percentile(close.mean(axis=1), (5, 50, 95)).tolist(), strict=True)
        )
    return {
        "factors": list(FACTORS),
        **{role: count(part) for role, part in rows.items()},
        "single_realisation": single,
    }
