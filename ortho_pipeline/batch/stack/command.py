"""`ortho stack`: orthos of many dates in; corrections that agree, aligned orthos, a record and a page out."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ortho_pipeline.batch.records import locked
from ortho_pipeline.batch.stack.dates import Dated, dated_orthos, time_of
from ortho_pipeline.batch.stack.document import record_of
from ortho_pipeline.batch.stack.items import items_of, write_items
from ortho_pipeline.batch.stack.matching import DatePair, Matcher
from ortho_pipeline.batch.stack.placing import Placed, pixel_of
from ortho_pipeline.batch.stack.raw import Levelled, Rectifier
from ortho_pipeline.batch.stack.result import StackResult, summary
from ortho_pipeline.batch.stack.writing import Told, Writer
from ortho_pipeline.block.stack.adjustment import AdjustedStack, adjust
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.graph import pairs_of
from ortho_pipeline.commands.orthos.opening import open_ortho
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files import retire, together, write_json
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions, StackOptions, SurfaceOptions
from ortho_pipeline.raster.caching.block_cache import cache_restored
from ortho_pipeline.report.stack.page import write_page
from ortho_pipeline.runtime.process_limits import one_blas_thread
from ortho_pipeline.stores.delivery import address_of

_EDGES, _ALIGNED, _RAW = "pairs", "aligned", "raw"
_DAYS_A_YEAR = 365.25


@one_blas_thread()
@cache_restored()
def stack(
    orthos: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    options: StackOptions = StackOptions(),
    *,
    match: MatchOptions = MatchOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    scene: SceneOptions = SceneOptions(),
    output: OutputOptions | None = None,
    progress: Told | None = None,
) -> StackResult:
    """Make finished orthos and raw scenes of many dates agree with each other.

    A second run with the same folder matches only new pairs and writes only changed orthos.

    Parameters
    ----------
    orthos : sequence of path
        Images, folders of them, patterns of names, and CSV lists with the columns file and date.
    folder : path
        Folder of all outputs.
    surface : SurfaceOptions
        Heights for raw scenes.
    output : OutputOptions, optional
        Of the aligned orthos. Default: cubic resampling.
    progress : callable, optional
        Called with a stage and its finished share.

    Returns
    -------
    StackResult
        `dates` has the corrections (m to east and north, and px) with their standard deviations, `orthos` the aligned
        orthos, `files` the folder of these, stack.json, the page, and with `output.stac` the catalog of items.
        `to_xarray()` is a lazy ``(time, band, y, x)``.

    Raises
    ------
    InputError
        If an image has no date, a raw scene no heights, the CRS differ, or no pair can be matched.

    Examples
    --------
    >>> done = op.stack(["series"], "stacked", op.StackOptions(date_pattern="%Y%m%d"))  # doctest: +SKIP
    >>> [(one.time[:10], one.east_north_m, one.sigma_m) for one in done.dates]  # doctest: +SKIP
    >>> done.to_xarray().sel(time="2024").median("time").compute()  # doctest: +SKIP
    """
    if address_of(folder) is not None:
        raise InputError(
            "a stack is written to a folder on this machine", file=str(folder), field="folder", remedy="give a folder"
        )
    output = OutputOptions(resampling="cubic") if output is None else output
    if output.stac and options.corrections_only:
        raise InputError(
            "STAC items need aligned orthos, and only corrections are written",
            field="output.stac",
            remedy=Text("leave out ", Setting("output.stac"), " or ", Setting("stack.corrections_only")),
        )
    dates = dated_orthos(orthos, options.date_pattern, scene, surface)
    nodes, fixed = _with_datum(dates, options.datum, match, scene)
    told, folder = progress or (lambda what, share: None), Path(folder)
    with locked(folder / _EDGES / ".lock", owner="ortho stack"):
        rectifier = Rectifier(folder / _RAW, surface, scene, output, options.rebuild)
        dates = rectifier.orthos(dates, told)
        nodes, placed = [*dates, *nodes[len(dates) :]], Placed.of(dates)
        matcher = Matcher(folder / _EDGES, replace(match, reference=()), scene, output, options.rebuild)
        seen = [one.conditions for one in dates]
        wanted = pairs_of(
            [one.days for one in dates], options.neighbours, [one.cloud_percent for one in seen],
            [one.sun_elevation_deg for one in seen],
        )  # fmt: skip
        if len(nodes) > len(dates):
            wanted += [(date, len(dates)) for date in range(len(dates))]
        pairs = matcher.pairs(nodes, wanted, lambda done, of: told("matching", done / of))
        solved = _adjusted(nodes, dates, placed, pairs, fixed, not options.shift_only)
        aligned = folder / _ALIGNED
        writer = Writer(aligned, placed, scene, output, options.corrections_only, options.rebuild)
        outputs = writer.write(dates, solved, told)
        record = record_of(dates, placed, pairs, solved, outputs, options.datum)
        files = {"aligned": aligned, "json": folder / "stack.json", "html": folder / "stack.html"}
        with together(aligned, "items of a stack"):
            # Items of an earlier run would state its sigmas.
            retire(items_of(aligned, dates))
            if output.stac:
                files["stac"] = write_items(aligned, dates, record)
        with together(folder, "stack"):
            write_json(files["json"], record.to_json())
            write_page(record, files["html"])
    said = summary(record, sum(pair.fresh for pair in pairs))
    return StackResult(files, record.to_json(), said, record=record, access=scene.access)


def _with_datum(
    dates: Sequence[Dated], datum: str, match: MatchOptions, scene: SceneOptions
) -> tuple[list[Dated], int | None]:
    """Return the dates, with the reference after them if it is the datum, and the number of the datum."""
    if (datum == "reference") != bool(match.reference):
        setting = Text("give both: ", Setting("match.reference", "FILE"), " and ", Setting("stack.datum", "reference"))
        what = "no reference" if datum == "reference" else "a reference, but another datum"
        raise InputError(f"there is {what}", field="stack.datum", remedy=setting)
    if datum == "mean":
        return list(dates), None
    if datum == "reference":
        path = Path(match.reference[0])
        last = dates[-1].time
        return [*dates, Dated("reference", path, last, "", open_ortho(path, scene))], len(dates)
    for number, one in enumerate(dates):
        if one.name == datum:
            return list(dates), number
    wanted = time_of(datum).date()
    for number, one in enumerate(dates):
        if one.time.date() == wanted:
            return list(dates), number
    raise InputError(
        f"no ortho is of {wanted}", field="stack.datum", remedy=f"give mean, or a date such as {dates[0].time.date()}"
    )


def _adjusted(
    nodes: Sequence[Dated], dates: Sequence[Dated], placed: Placed, pairs: Sequence[DatePair], datum: int | None,
    affine: bool,
) -> AdjustedStack:  # fmt: skip
    """Return the adjustment of matched pairs."""
    matched = [pair for pair in pairs if pair.matches is not None]
    if not matched:
        raise InputError(
            f"none of {counted(len(pairs), 'pair')} could be matched: {pairs[0].reason if pairs else ''}",
            field="orthos",
            remedy=Text("check that the orthos show one place, or search farther with ", Setting("match.search")),
        )
    cells = Cells.over(*placed.covered(dates))
    years = [one.days / _DAYS_A_YEAR for one in nodes]
    years = [year if number < len(dates) else np.nan for number, year in enumerate(years)]
    solved = adjust(cells, _edges(nodes, placed, cells, matched), years, datum, affine=affine)
    if any(one.raw is not None for one in dates):
        # Where an ortho shows the ground displaced, it was made with the height of another place.
        edges = _edges(nodes, placed, cells, matched, Levelled.of(dates, placed, solved))
        solved = adjust(cells, edges, years, datum, affine=affine)
    return solved


def _edges(
    nodes: Sequence[Dated], placed: Placed, cells: Cells, matched: Sequence[DatePair], levelled: Levelled | None = None
) -> Edges:
    """Return the edges of matched pairs."""
    step = float(np.sqrt(placed.grid.dx * placed.grid.dy))
    value, variance, alike = [], [], []
    for pair in matched:
        assert pair.matches is not None
        place, shown, sigma = pair.matches.arrays
        own = pixel_of(nodes[pair.first]) / step
        at, seen = placed.at(place), placed.at(shown)
        if levelled is not None:
            at, seen = levelled.pair(pair.first, pair.second, at, seen)
        known = np.isfinite(at).all(axis=1) & np.isfinite(seen).all(axis=1)
        mean, spread = cells.sampled(at[known], (seen - at)[known], sigma[known] * own)
        value.append(mean)
        variance.append(spread)
        alike.append(pair.matches.alike_px * own)
    return Edges(
        np.array([pair.first for pair in matched]), np.array([pair.second for pair in matched]), np.array(value),
        np.array(variance), np.array(alike),
    )  # fmt: skip
