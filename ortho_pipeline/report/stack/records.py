"""The record of a stack, `stack.json`: corrections of dates, pairs, closures, moving ground and steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ortho_pipeline.files.json.records import Count, Pair, Record, Words


class DateRecord(Record):
    """A date: where its ortho shows ground, relative to the datum; null if no accepted pair connects it."""

    # `shift_px` is at the middle of the area, in pixels (columns, rows) of the stack's grid. `corner_px` is the largest
    # correction at a corner, `corner_sigma_px` the largest sigma there. Sigmas are standard deviations per axis,
    # relative to the datum.
    name: str
    path: str
    time: str
    time_from: str
    correction: str | None
    shift_px: Pair | None
    sigma_px: Pair | None
    corner_px: float | None
    east_north_m: Pair | None
    sigma_m: float | None
    pairs: Count
    output: str | None
    cloud_percent: float | None = None
    sun_elevation_deg: float | None = None
    corner_sigma_px: float | None = None


class PairRecord(Record):
    """A pair of dates; `status` is accepted, rejected, untested (accepted, but in no loop), or not matched."""

    # `closure_px` is the pair's shift minus what all other pairs say; `ratio` its square in units of its covariance,
    # which is above 18.4 by chance in one of 10,000.
    first: str
    second: str
    status: str
    reason: Words
    matches: Count
    shift_px: Pair | None
    closure_px: Pair | None
    ratio: float | None


class ClosureRecord(Record):
    """Closing errors (px) of loops of three pairs."""

    loops: Count
    median_px: float | None
    p95_px: float | None
    largest_px: float | None


class MovingRecord(Record):
    """Ground that moves, relative to the stable ground; rate and sigma in m a year.

    Rate, sigma and significance are medians of its inner cells; of an area without any, those of its fastest cell.
    """

    lon: float
    lat: float
    cells: Count
    area_m2: float
    east_m_per_year: float
    north_m_per_year: float
    sigma_m_per_year: float
    significance: float
    form: str


class CellRecord(Record):
    """A cell of the map of moving ground; `place` is its middle in pixels of the stack's grid.

    How it moves: steadily, with a step, or yearly.
    """

    place: Pair
    tested: bool
    moving: bool
    form: str | None
    rate_px_per_year: Pair
    sigma_px_per_year: Pair


class StepRecord(Record):
    """From this date on the orthos are displaced relative to those before."""

    date: str
    size_px: Pair
    sigma_px: Pair
    chance: float


class GridRecord(Record):
    """The grid of a stack."""

    crs: str
    geotransform: tuple[float, float, float, float, float, float]
    size: tuple[int, int]
    pixel_m: float


class StackRecord(Record):
    """A stack of orthos."""

    schema_version: int
    datum: str
    grid: GridRecord
    dates: tuple[DateRecord, ...]
    pairs: tuple[PairRecord, ...]
    closure_before: ClosureRecord
    closure_after: ClosureRecord
    moving: tuple[MovingRecord, ...]
    cells: tuple[CellRecord, ...]
    steps: tuple[StepRecord, ...]
    warnings: tuple[Words, ...]
    notices: tuple[Mapping[str, Any], ...]
    provenance: Mapping[str, Any] = {}
