"""The table of points that every reader of a point file fills, and how text and numbers of a file are checked.

Image points are (column, row) from the outer corner of the first pixel. Ground points are as in the file, with the CRS
that it states; `points.ground` makes ellipsoidal heights.
"""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import UTF_16, read_bounded
from ortho_pipeline.options import PIXEL_ORIGINS

Array = NDArray[np.float64]

#: Limits: bytes of a point file, characters of a line.
MAX_FILE = 32_000_000
MAX_LINE = 100_000
#: The square of a larger standard deviation would overflow.
MAX_SIGMA = 1e150
ROLES = ("control", "check", "tie")
CSV_COLUMNS = ("id", "col", "row", "x", "y", "h", "role", "sigma_image", "sigma_xy", "sigma_h")
#: Column of a CSV of several images: the image in which a point was measured.
CSV_IMAGE = "image"
#: Columns for errors that differ with the direction, or that points share with neighbours or with all others.
CSV_ERRORS = ("var_col", "var_row", "cov_col_row", "group", "sigma_common", "sigma_alike")


#: Columns of laser altimetry for heights (above the ellipsoid) and their sigmas: SlideRule, ATL06, ATL08.
ALTIMETRY = {"hmean": "hsigma", "hli": "hlisigma", "htebestfit": "hteuncertainty"}


class ColumnRules(NamedTuple):
    """Columns that a CSV may have, those that every line needs, and the default role.

    `aliases` are further names of ours (without punctuation). With aliases, unknown columns are skipped.
    """

    names: tuple[str, ...]
    needed: tuple[str, ...]
    role: str
    aliases: Mapping[str, str] = {}


#: Points of one image; rays of a block, with or without ground; ground points that test heights; ground points.
OF_IMAGE = ColumnRules((*CSV_COLUMNS, *CSV_ERRORS, CSV_IMAGE), CSV_COLUMNS[1:5], "control")
OF_BLOCK = ColumnRules(("id", CSV_IMAGE, *CSV_COLUMNS[1:], *CSV_ERRORS), ("id", CSV_IMAGE, "col", "row"), "")
OF_HEIGHTS = ColumnRules(
    (*CSV_COLUMNS, *CSV_ERRORS, CSV_IMAGE),
    CSV_COLUMNS[3:6],
    "check",
    dict.fromkeys(ALTIMETRY, "h") | dict.fromkeys(("sigma", *ALTIMETRY.values()), "sigma_h"),
)
OF_GROUND = ColumnRules(("id", *CSV_COLUMNS[3:7], *CSV_COLUMNS[8:]), ("id", "x", "y"), "")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


#: Position of another image in this one: column and row of its first corner, and the width of its pixels.
Placement = tuple[float, float, float]
OWN_IMAGE: Placement = (0.0, 0.0, 1.0)


class TablePoint(NamedTuple):
    """A point of a table: `image` and `sigma_image` in px, `sigma_ground` in metres.

    `covariance_image` (px^2) is the covariance of column and row. Points with the same `group` from 0 on share errors,
    as matched neighbours do; -1 means no shared errors. `sigma_common` (m, per axis) is an error of the ground that all
    points with one have in common, such as that of a reference. `sigma_alike` (px, per axis) is such an error of the
    measurement, for example if the bands of a reference disagree. More points do not reduce common errors.
    """

    id: str
    image: tuple[float, float]
    ground: tuple[float, float, float]
    role: str
    sigma_image: float
    sigma_ground: tuple[float, float, float]
    covariance_image: tuple[tuple[float, float], tuple[float, float]]
    group: int
    sigma_common: float
    sigma_alike: float


@dataclass(slots=True)
class PointRow:
    """One point as its file has it; None is what the file does not give. `piece` is where its image lies.

    `covariance` has the variances (px^2) of column and row and their covariance.
    """

    where: str
    id: str | None
    image: tuple[float, float]
    ground: tuple[float, float, float]
    role: str = "control"
    sigma_image: float | None = None
    sigma_xy: float | None = None
    sigma_h: float | None = None
    image_name: str | None = None
    piece: Placement = OWN_IMAGE
    covariance: tuple[float, float, float] | None = None
    group: int | None = None
    sigma_common: float | None = None
    sigma_alike: float | None = None

    def __post_init__(self) -> None:
        if self.id is not None:
            self.id = plain_id(self.id) or None
            if not is_writable(self.id or ""):
                raise InputError(f"{short(self.id)} is not an id", field=self.where, remedy="use letters and digits")


@dataclass
class Table:
    """All points of a file, and what it states about their coordinates.

    `vertical` is stated by the file; `assumed_vertical` is the default of the format. `of_ground` is ``geographic`` or
    ``projected`` if column names say so. With `origin_allowed` the user may state the pixel origin. `source` is the
    file.
    """

    format: str
    rows: list[PointRow] = field(default_factory=list)
    source: str = ""
    crs: str | None = None
    vertical: str | None = None
    assumed_vertical: str | None = None
    of_ground: str | None = None
    origin_allowed: bool = False


def plain_id(text: str) -> str:
    """Return an id in its plain form: no blanks around it, single blanks within, no line breaks."""
    return " ".join(text.split())


def is_writable(text: str) -> bool:
    """Return whether a UTF-8 file can hold a text: no NUL, and no half of a surrogate pair, which JSON can hold."""
    return "\0" not in text and not any("\ud800" <= letter <= "\udfff" for letter in text)


def numbered_ids(path: str | os.PathLike[str], rows: Sequence[PointRow]) -> tuple[str, ...]:
    """Number the points without an id by their position in the file; refuse an id that appears twice."""
    first: dict[str, str] = {}
    for count, row in enumerate(rows, start=1):
        row.id = row.id if row.id is not None else str(count)
        if row.id in first:
            raise InputError(
                f"two points have the id {row.id!r}; the first is in {first[row.id]}",
                file=path,
                field=row.where,
                remedy="give each point a different id",
            )
        first[row.id] = row.where
    return tuple(str(row.id) for row in rows)


def refuse_duplicates(
    path: str | os.PathLike[str], wheres: Sequence[str], image: Array, ground: Array, roles: Sequence[str]
) -> None:
    """Refuse points that appear twice: the same ground or the same pixel, to all digits that matter."""
    # A millimetre in degrees and in metres; pixels to a millionth.
    digits = 8 if np.abs(ground[:, :2]).max(initial=0) <= 360 else 3
    for what, keys in (("ground", np.round(ground, digits)), ("image", np.round(image, 6))):
        first: dict[tuple[float, ...], int] = {}
        for count, key in enumerate(map(tuple, np.nan_to_num(keys, nan=-1e9).tolist())):
            other = first.setdefault(key, count)
            if other != count:
                both = sorted({roles[other], roles[count]})
                as_both = f", as {' and '.join(both)}" if len(both) > 1 else ""
                raise InputError(
                    f"the same {what} coordinates as in {wheres[other]}{as_both}",
                    file=path,
                    field=wheres[count],
                    remedy="remove one of the two",
                )


def origin_shift(path: str | os.PathLike[str], table: Table, origin: str) -> float:
    """Return the number to add to image coordinates of a file with this pixel origin.

    Raises
    ------
    InputError
        For an unknown origin, or if the format defines its own.
    """
    if origin not in PIXEL_ORIGINS:
        raise InputError(
            f"{origin!r} is not a pixel origin",
            field="points.pixel_origin",
            remedy=f"use one of {', '.join(PIXEL_ORIGINS)}",
        )
    if origin != "corner" and not table.origin_allowed:
        raise InputError(
            f"the format {table.format} defines its own pixel origin",
            file=path,
            field="points.pixel_origin",
            remedy="leave the option out",
        )
    return PIXEL_ORIGINS[origin]


class Line(NamedTuple):
    """A line that is not blank, and its number."""

    number: int
    text: str


def load_text(path: str | os.PathLike[str]) -> str:
    """Return a file as text: UTF-8, a byte-order mark allowed, no NUL, no larger than `MAX_FILE`."""
    data = read_bounded(path, MAX_FILE, remedy="check the path")
    if len(data) > MAX_FILE:
        raise InputError(
            f"this file is larger than {MAX_FILE // 1_000_000} MB, the limit for point files",
            file=path,
            remedy="use fewer points",
        )
    if data.startswith(b"EHFA_HEADER_TAG") or Path(path).suffix.lower() == ".gcc":
        raise InputError(
            "cannot read GCP files of ERDAS IMAGINE (.gcc): their format is not published",
            file=path,
            remedy="export the cell array of the GCP tool as text, and name its columns Name, Pixel, Line, Easting, "
            "Northing, Elev",
        )
    if data.startswith(UTF_16):
        raise InputError("this file is UTF-16", file=path, remedy="save it as UTF-8")
    if b"\0" in data:
        line = data[: data.index(b"\0")].count(b"\n") + 1
        raise InputError(
            "this is not a text file (NUL byte)", file=path, field=f"line {line}", remedy="save it as text (UTF-8)"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InputError(
            "this file is not UTF-8", file=path, field=f"line {line}", remedy="save it as UTF-8"
        ) from error


def number(text: Any, path: str | os.PathLike[str], where: str) -> float:
    """Return a finite number; an error names `where` (line and column)."""
    if isinstance(text, bool) or not isinstance(text, str | int | float):
        raise InputError(f"{short(text)} is not a number", file=path, field=where)
    try:
        plain = text.strip() if isinstance(text, str) else text
        if isinstance(plain, str) and (len(plain) > 64 or not _NUMBER.fullmatch(plain)):
            raise ValueError
        value = float(plain)
    except (ValueError, OverflowError):
        comma = isinstance(text, str) and re.fullmatch(r"\s*[+-]?\d*,\d+\s*", text)
        remedy = "write numbers with a decimal point" if comma else None
        raise InputError(f"{short(text)} is not a number", file=path, field=where, remedy=remedy) from None
    if not math.isfinite(value):
        raise InputError(f"{short(text)} is not a finite number", file=path, field=where)
    return value


def short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 48 else f"{text[:48]}..."


def lines_of(path: str | os.PathLike[str], text: str) -> Iterator[Line]:
    for count, line in enumerate(text.splitlines(), start=1):
        if len(line) > MAX_LINE:
            raise InputError(
                f"this line has {len(line)} characters; the limit is {MAX_LINE}", file=path, field=f"line {count}"
            )
        if line.strip():
            yield Line(count, line)


def role_of(text: Any, path: str | os.PathLike[str], where: str) -> str:
    role = str(text).strip().lower()
    if role not in ROLES:
        raise InputError(
            f"{short(text)} is not a role", file=path, field=where, remedy=f"use one of {', '.join(ROLES)}"
        )
    return role


def sigma_of(
    text: Any, path: str | os.PathLike[str], where: str, *, zero: bool, what: str = "standard deviation"
) -> float:
    value = number(text, path, where)
    if value < 0 or (value == 0 and not zero) or value > MAX_SIGMA:
        raise InputError(f"{short(text)} is not a {what}", file=path, field=where)
    return value


def refuse_odd_ids(ids: Sequence[str], path: str | os.PathLike[str]) -> None:
    """Refuse ids that would be different when they are read again from a file."""
    odd = next((name for name in ids if not name or name != plain_id(name) or not is_writable(name)), None)
    if odd is not None:
        raise InputError(
            f"the id {short(odd)} would be different when it is read again",
            file=path,
            field="id",
            remedy="use ids without line breaks, without blanks around them, and without several blanks in a row",
        )


def refuse_unreadable(
    ids: Sequence[str], path: str | os.PathLike[str], field: str, readable: NDArray[np.bool_]
) -> None:
    """Refuse points with values that no reader would accept from a file."""
    if not readable.all():
        name = short(ids[int(readable.argmin())])
        raise InputError(f"{field} of point {name} has a value that cannot be read again", file=path, field=field)


def cells_of(path: str | os.PathLike[str], line: Line, delimiter: str) -> list[str]:
    """Return the cells of a line without blanks around them; a blank as delimiter means any white space."""
    if delimiter == " " and '"' not in line.text:
        return line.text.split()
    try:
        text = " ".join(line.text.split()) if delimiter == " " else line.text
        return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter, strict=True))]
    except csv.Error as error:
        raise InputError(f"this line is not valid CSV ({error})", file=path, field=f"line {line.number}") from error
