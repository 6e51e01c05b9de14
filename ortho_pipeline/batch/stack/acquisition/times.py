"""Dates in texts and in file names."""

from __future__ import annotations

import os
import re
from datetime import UTC, datetime

from ortho_pipeline.errors import InputError

_PARTS = {"%Y": r"(?P<Y>\d{4})", "%m": r"(?P<m>\d{2})", "%d": r"(?P<d>\d{2})", "%j": r"(?P<j>\d{3})",
          "%H": r"(?P<H>\d{2})", "%M": r"(?P<M>\d{2})", "%S": r"(?P<S>\d{2})", "%%": "%"}  # fmt: skip
#: Which part of a date a part is within, if not the year: %M is not the month.
_WITHIN = {"%d": "%m", "%M": "%H", "%S": "%M"}
#: Numbers in names that are years of other times are no dates, nor are times that programs write for unknown ones.
_YEARS = range(1900, 2101)


def time_of(
    text: str, file: str | os.PathLike[str] | None = None, remedy: str = "write dates as 2024-05-03"
) -> datetime:
    """Return a date or time as texts and metadata write it; UTC if they do not say otherwise.

    >>> time_of("2024:05:03 10:12:00").isoformat()
    '2024-05-03T10:12:00+00:00'

    Raises
    ------
    InputError
        If it is none.
    """
    plain = re.sub(r"^(\d{4})[:/](\d\d)[:/](\d\d)", r"\1-\2-\3", text.strip())
    try:
        time = datetime.fromisoformat(plain)
        time = time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
        if time.year not in _YEARS:
            raise ValueError(time.year)
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"{text[:40]!r} is not a date from {_YEARS[0]} to {_YEARS[-1]}",
            file=file,
            field="date",
            remedy=remedy,
        ) from error
    return time


def by_pattern(name: str, pattern: str) -> datetime:
    """Return the date in a file name.

    >>> by_pattern("T36_20240503_B04.tif", "_%Y%m%d_").date().isoformat()
    '2024-05-03'

    Raises
    ------
    InputError
        If the pattern has no year, does not occur in the name, or takes a part of a whole date there.
    """
    parts = re.split(r"(%[a-zA-Z%])", pattern)
    codes = [part for part in parts if part.startswith("%") and len(part) == 2]
    wrong = [code for code in codes if code not in _PARTS or _WITHIN.get(code, "%Y") not in codes]
    if wrong or "%Y" not in codes or len(set(codes)) < len(codes):
        raise InputError(
            f"{pattern!r} is not a pattern of a date", field="stack.date_pattern", remedy="such as %Y%m%d or %Y-%j"
        )
    place = "".join(_PARTS.get(part, re.escape(part)) for part in parts)
    # A lookahead finds places that overlap, too.
    matches = list(re.finditer(f"(?=(?P<whole>{place}))", name))
    if not matches:
        raise InputError(
            f"the name {name} does not have the date pattern {pattern}",
            field="stack.date_pattern",
            remedy="change the pattern, or give a CSV file with the columns file and date",
        )
    found = {match.span("whole"): _time_in(match) for match in matches}
    valid = [(span, time) for span, time in found.items() if time is not None]
    # Archives put the day of acquisition before that of processing.
    alone = [time for span, time in valid if not _is_within(name, *span)]
    if not alone and "%d" not in codes and (whole := _date_about(name, [span for span, _ in valid])):
        raise InputError(
            f"the pattern {pattern} takes a part of {whole} in the name {name}",
            field="stack.date_pattern",
            remedy="such as %Y%m%d for 20240503",
        )
    times = alone[:1] or list(dict.fromkeys(time for _, time in valid))
    if len(times) != 1:
        what = f"{len(times)} dates" if times else "no valid date"
        raise InputError(
            f"the name {name} has {what} of the pattern {pattern}",
            field="stack.date_pattern",
            remedy="add more characters of the name to the pattern, or give a CSV file with the columns file and date",
        )
    return times[0]


def _date_about(name: str, spans: list[tuple[int, int]]) -> str | None:
    """Return a number of a name that is a year, a month and a day, if each span touches such a number."""
    numbers = re.finditer(r"(?<!\d)(?P<Y>\d{4})(?P<m>\d{2})(?P<d>\d{2})(?!\d)", name)
    dates = [match for match in numbers if _time_in(match) is not None]
    about = [next((d[0] for d in dates if first < d.end() and d.start() < last), "") for first, last in spans]
    return about[0] if about and all(about) else None


def _time_in(match: re.Match[str]) -> datetime | None:
    """Return the time at a place of a pattern; None if there is no such time, or in no year of images."""
    numbers = {key: text for key, text in match.groupdict().items() if key != "whole"}
    try:
        time = datetime.strptime("".join(numbers.values()), "".join(f"%{key}" for key in numbers)).replace(tzinfo=UTC)
    except ValueError:
        return None
    # strptime takes day 366 of any year.
    return time if time.year == int(numbers["Y"]) and time.year in _YEARS else None


def _is_within(name: str, first: int, last: int) -> bool:
    """Return whether a part of a name begins or ends within a number."""
    return any(name[edge - 1 : edge + 1].isdigit() for edge in (first, last) if 0 < edge < len(name))
