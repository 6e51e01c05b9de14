"""Options of a stack of scenes."""

# Annotations are read from the class: as values, not as text.
from dataclasses import dataclass
from typing import Annotated

from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options.option import Option, documented


@documented
@dataclass(frozen=True)
class StackOptions:
    """Dates and corrections of a stack.

    Examples
    --------
    >>> op.StackOptions(datum="2024-03-10", date_pattern="%Y%m%d")
    StackOptions(datum='2024-03-10', date_pattern='%Y%m%d')
    """

    datum: Annotated[
        str,
        Option(
            "--datum",
            Text(
                "What keeps its place: the mean of all dates, one date, or the reference (",
                Setting("match.reference"),
                ").",
            ),
            "mean|DATE|reference",
        ),
    ] = "mean"
    date_pattern: Annotated[
        str | None,
        Option("--date-pattern", "Place of the date in the file names, such as %Y%m%d.", "PATTERN", unset="metadata"),
    ] = None
    neighbours: Annotated[
        int,
        Option(
            "--neighbours",
            "Earlier dates with which each date is matched, besides the same season of earlier years.",
            "N",
            kind="integer",
            above=0,
            below=51,
        ),
    ] = 3
    shift_only: Annotated[bool, Option("--shift-only", "Correct each date by a shift only.")] = False
    corrections_only: Annotated[
        bool, Option("--corrections-only", "Keep the pixels: write VRTs with a corrected map grid, and models.")
    ] = False
    rebuild: Annotated[bool, Option("--rebuild", "Match all pairs again and write all orthos again.")] = False
