"""`ortho stack`: orthos of many dates in; corrections that agree, aligned orthos, a record and a page out."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.batch.executors import Crew, crew_of
from ortho_pipeline.batch.paths import key_of_name
from ortho_pipeline.batch.records import locked
from ortho_pipeline.batch.stack.acquisition.times import time_of
from ortho_pipeline.batch.stack.dates import Dated, dated_orthos, placed_at
from ortho_pipeline.batch.stack.document import chips_of, record_of
from ortho_pipeline.batch.stack.items import items_of, write_items
from ortho_pipeline.batch.stack.matching import DatePair, Matcher
from ortho_pipeline.batch.stack.placing import Placed, map_grid_of, pixel_of, require_one_crs
from ortho_pipeline.batch.stack.raw import Levelled, Rectifier
from ortho_pipeline.batch.stack.recorded import LOCK, RecordedFolder, recorded_in
from ortho_pipeline.batch.stack.result import StackResult, part_summary, summary
from ortho_pipeline.batch.stack.writing import Writer
from ortho_pipeline.block.stack.adjustment import AdjustedStack, adjust
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.graph import pairs_of
from ortho_pipeline.commands.orthos.opening import ORTHO, open_ortho
from ortho_pipeline.commands.results import SCHEMA_VERSION, Result
from ortho_pipeline.errors import InputError, completed
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files import retire, together, write_json
from ortho_pipeline.files.locations import Location
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions, StackOptions, SurfaceOptions
from ortho_pipeline.raster.caching.block_cache import cache_restored
from ortho_pipeline.report.stack.chips import ChipSheet
from ortho_pipeline.report.stack.page import write_page
from ortho_pipeline.report.stack.records import StackRecord
from ortho_pipeline.runtime.process_limits import Progress, one_blas_thread
from ortho_pipeline.stores.delivery import address_of, delivered
from ortho_pipeline.stores.objects import Objects

_EDGES, _ALIGNED, _RAW = LOCK.parent.name, "aligned", "raw"
_DAYS_A_YEAR = 365.25
#: What the items are called together in object storage.
_ITEMS = "items"
#: The name of a reference in the records of pairs.
_REFERENCE = "reference"


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
    executor: str | Executor | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> StackResult:
    """Make finished orthos and raw scenes of many dates agree with each other.

    A second run with the same folder matches only new pairs and writes only changed orthos.

    Parameters
    ----------
    orthos : sequence of path
        Images, folders of them, patterns of names, and CSV lists with the columns file and date.
    folder : path or address
        Folder of all outputs, on this machine or in object storage.
    surface : SurfaceOptions
        Heights for raw scenes.
    output : OutputOptions, optional
        Of the aligned orthos. Default: cubic resampling.
    executor, workers, scheduler
        Who rectifies, matches and writes, as in `run`. Default: this process, or dask where a scheduler is given.
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
    planned = _Planned.of(orthos, folder, options, match, surface, scene, output, progress)
    _refuse_unfit(planned)
    with (
        _held(planned.folder, shared=False),
        _crew(executor, workers, scheduler, planned) as (crew, threads),
    ):
        return _made(planned.with_threads(threads), crew)


@one_blas_thread()
@cache_restored()
def match_part(
    orthos: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    part: tuple[int, int],
    options: StackOptions = StackOptions(),
    *,
    match: MatchOptions = MatchOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    scene: SceneOptions = SceneOptions(),
    output: OutputOptions | None = None,
    executor: str | Executor | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Result:
    """Match the k-th of n parts of the pairs of a stack; several workers share a folder.

    `stack` finds these pairs matched.

    Parameters
    ----------
    part : (k, n)
        From 1.

    Raises
    ------
    InputError
        As `stack`, or if there is no such part.
    """
    number, count = part
    if not 1 <= number <= count:
        raise InputError(f"there is no part {number} of {count}", field="shard", remedy="use a part such as 1/4")
    planned = _Planned.of(orthos, folder, options, match, surface, scene, output, progress)
    # Neighbours in the list have dates in common.
    first, last = ((number + step) * len(planned.wanted) // count for step in (-1, 0))
    planned = replace(planned, wanted=planned.wanted[first:last])
    with (
        _held(planned.folder, shared=True),
        _crew(executor, workers, scheduler, planned) as (crew, threads),
    ):
        _, pairs = _matched(planned.with_threads(threads), crew)
    matched = sum(pair.matches is not None for pair in pairs)
    document = {"schema_version": SCHEMA_VERSION, "part": list(part), "pairs": len(pairs), "matched": matched}
    return Result({}, document, part_summary(part, pairs))


@dataclass(frozen=True, eq=False)
class _Planned:
    """What a stack is made of, and where.

    Parameters
    ----------
    nodes : list of Dated
        The dates, and after them the reference if it is the datum.
    count : int
        Number of dates.
    fixed : int, optional
        Number of the datum; None is the mean.
    wanted : list of (int, int)
        The pairs.
    """

    nodes: list[Dated]
    count: int
    fixed: int | None
    wanted: list[tuple[int, int]]
    folder: str
    options: StackOptions
    match: MatchOptions
    surface: SurfaceOptions
    scene: SceneOptions
    output: OutputOptions
    told: Progress

    @classmethod
    def of(
        cls, orthos: Sequence[str | os.PathLike[str]], folder: str | os.PathLike[str], options: StackOptions,
        match: MatchOptions, surface: SurfaceOptions, scene: SceneOptions, output: OutputOptions | None,
        progress: Progress | None,
    ) -> _Planned:  # fmt: skip
        """Open the images, and choose the pairs."""
        output = OutputOptions(resampling="cubic") if output is None else output
        dates = dated_orthos(orthos, options.date_pattern, scene, surface)
        nodes, fixed = _with_datum(dates, options.datum, match, scene)
        _refuse_crs(dates, nodes[len(dates) :])
        seen = [one.conditions for one in dates]
        wanted = pairs_of(
            [one.days for one in dates], options.neighbours, [one.cloud_percent for one in seen],
            [one.sun_elevation_deg for one in seen],
        )  # fmt: skip
        if len(nodes) > len(dates):
            wanted += [(date, len(dates)) for date in range(len(dates))]
        told = progress or (lambda what, share: None)
        # Workers elsewhere have another working folder.
        place = os.fspath(folder).rstrip("/") if address_of(folder) is not None else os.path.abspath(folder)
        return cls(nodes, len(dates), fixed, wanted, place, options, match, surface, scene, output, told)

    def with_threads(self, threads: int | None) -> _Planned:
        """Return the plan with threads for each piece of work."""
        return replace(self, output=replace(self.output, threads=threads))

    def part(self, name: str) -> RecordedFolder:
        """Return a folder within that of the outputs."""
        return recorded_in(self.folder, name, self.scene.allow_network, self.options.rebuild)


def _refuse_unfit(planned: _Planned) -> None:
    """Refuse outputs that cannot be."""
    options, far = planned.options, address_of(planned.folder) is not None
    written = next((one for one in planned.nodes if _is_written(one, planned.folder)), None)
    if written is not None:
        raise InputError(
            "this image is an output of the stack in the same folder, which would replace or remove it",
            file=written.image,
            field="orthos" if written in planned.nodes[: planned.count] else "match.reference",
            remedy="choose another output folder",
        )
    if planned.output.stac and options.corrections_only:
        raise InputError(
            "STAC items need aligned orthos, and only corrections are written",
            field="output.stac",
            remedy=Text("leave out ", Setting("output.stac"), " or ", Setting("stack.corrections_only")),
        )
    near = next((one for one in planned.nodes[: planned.count] if not Location(one.image).is_far), None)
    if far and options.corrections_only and near is not None:
        raise InputError(
            "a VRT in object storage cannot refer to an image on this machine",
            file=near.image,
            field="stack.corrections_only",
            remedy=Text("leave out ", Setting("stack.corrections_only"), ", or give the addresses of the images"),
        )


def _is_written(one: Dated, folder: str) -> bool:
    """Return whether an image is where a stack in a folder writes orthos."""
    if Location(one.image).is_far:
        image, place = str(Location(one.image).url), folder
    else:
        image, place = os.path.realpath(one.image), os.path.realpath(folder)
    return os.path.dirname(image) in {f"{place}/{name}" for name in (_ALIGNED, _RAW)}


def _crew(
    executor: str | Executor | None, workers: int | None, scheduler: str | None, planned: _Planned
) -> contextlib.AbstractContextManager[tuple[Crew, int | None]]:
    if executor is None and scheduler is None:
        executor = "sequential" if workers is None else "processes"
    return crew_of(executor, workers, planned.output.threads, scheduler, len(planned.wanted))


@contextlib.contextmanager
def _held(folder: str, *, shared: bool) -> Iterator[None]:
    """Keep other runs out of the folder; workers of parts share it."""
    if address_of(folder) is not None:
        yield
        return
    with locked(Path(folder) / LOCK, shared=shared, owner="ortho stack"):
        yield


def _matched(planned: _Planned, crew: Crew) -> tuple[list[Dated], list[DatePair]]:
    """Return the nodes with orthos of the raw scenes that the pairs need, and the matched pairs."""
    told, count = planned.told, planned.count
    rectifier = Rectifier(planned.part(_RAW), planned.surface, planned.scene, planned.output)
    some = {node for pair in planned.wanted for node in pair if node < count}
    dates = rectifier.orthos(planned.nodes[:count], some, crew, lambda share: told("rectifying", share))
    nodes = [*dates, *planned.nodes[count:]]
    matcher = Matcher(planned.part(_EDGES), replace(planned.match, reference=()), planned.scene, planned.output)
    return nodes, matcher.pairs(nodes, planned.wanted, crew, lambda share: told("matching", share))


def _made(planned: _Planned, crew: Crew) -> StackResult:
    """Make all of a stack."""
    options, scene, told = planned.options, planned.scene, planned.told
    nodes, pairs = _matched(planned, crew)
    dates = nodes[: planned.count]
    placed = Placed.of(dates)
    solved = _adjusted(nodes, dates, placed, pairs, planned.fixed, not options.shift_only)
    placed, solved = placed.of_corrected(dates, solved)
    aligned = planned.part(_ALIGNED)
    writer = Writer(aligned, placed, scene, planned.output, options.corrections_only)
    names, outdated = writer.write(
        dates, solved, crew, lambda share: told("writing", share), lambda: _clear_documents(planned, dates)
    )
    outputs = {name: f"{_ALIGNED}/{file}" for name, file in names.items()}
    groups = {"stack": options, "match": planned.match, "surface": planned.surface, "output": planned.output}
    record = record_of(dates, placed, pairs, solved, outputs, groups)
    chips = chips_of(dates, placed, solved, aligned, names, scene)
    files = _documents(planned, dates, record, outdated, chips)
    said = summary(record, sum(pair.fresh for pair in pairs))
    return StackResult(files, record.to_json(), said, record=record, access=scene.access)


def _clear_documents(planned: _Planned, dates: Sequence[Dated]) -> None:
    """Remove items, record and page of an earlier run on this machine, before the orthos that they describe change."""
    aligned = planned.part(_ALIGNED)
    if not aligned.is_far:
        with together(aligned.place, "items of a stack"):
            retire(items_of(Path(aligned.place), dates))
        with together(planned.folder, "stack"):
            retire(_files_of(Path(planned.folder)).values())


def _documents(
    planned: _Planned, dates: Sequence[Dated], record: StackRecord, outdated: Sequence[str], chips: ChipSheet | None
) -> dict[str, Any]:
    """Write items, record and page, and remove outdated files of orthos; return the files of the stack."""
    aligned, allowed = planned.part(_ALIGNED), planned.scene.allow_network
    items = {path.name for path in items_of(Path(), dates)}
    files: dict[str, Any] = {"aligned": Path(aligned.place) if not aligned.is_far else aligned.place}
    if not aligned.is_far:
        within = Path(aligned.place)
        with together(within, "items of a stack"):
            # Items of an earlier run would state its sigmas.
            retire(within / name for name in (*sorted(items), *outdated))
            if planned.output.stac:
                files["stac"] = write_items(aligned, within, dates, record)
        with together(planned.folder, "stack"):
            return files | _write_documents(record, chips, Path(planned.folder))
    _retire(Objects(planned.folder, allow_network=allowed), [*sorted(items), *outdated])
    if planned.output.stac:
        with delivered(planned.folder, _ITEMS, allow_network=allowed, keep=lambda path: path.name in items) as upload:
            within = upload.folder / _ALIGNED
            within.mkdir()
            files["stac"] = f"{aligned.place}/{write_items(aligned, within, dates, record).name}"
    with delivered(planned.folder, "stack", allow_network=allowed, keep=lambda path: True) as upload:
        written = _write_documents(record, chips, upload.folder)
    return files | {role: f"{planned.folder}/{path.name}" for role, path in written.items()}


def _write_documents(record: StackRecord, chips: ChipSheet | None, folder: Path) -> dict[str, Path]:
    files = _files_of(folder)
    write_json(files["json"], record.to_json())
    write_page(record, files["html"], chips)
    return files


def _files_of(folder: Path) -> dict[str, Path]:
    return {"json": folder / "stack.json", "html": folder / "stack.html"}


def _retire(store: Objects, names: Sequence[str]) -> None:
    """Remove files of an earlier run from object storage: items would state its sigmas."""
    # Without the record of their delivery some may be there, too: an upload was interrupted.
    for name in (f"{_ITEMS}_delivery.json", *(f"{_ALIGNED}/{name}" for name in names)):
        store.delete(name)


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
        _refuse_reference(dates, match)
        path = placed_at(match.reference[0], scene)
        last = dates[-1].time
        return [*dates, Dated(_REFERENCE, path, last, "", open_ortho(path, scene))], len(dates)
    for number, one in enumerate(dates):
        if one.name == datum:
            return list(dates), number
    such = f"give mean, reference, or a date such as {dates[0].time.date()}"
    try:
        wanted = time_of(datum).date()
    except InputError as error:
        text = f"{datum[:40]!r} is neither a date nor the name of an image"
        raise InputError(text, field="stack.datum", remedy=such) from error
    numbers = [number for number, one in enumerate(dates) if one.time.date() == wanted]
    if len(numbers) > 1:
        names = [dates[number].name for number in numbers]
        raise InputError(
            f"{counted(len(names), 'image')} are of {wanted}: {', '.join(names)}",
            field="stack.datum",
            remedy=Text("name one of them: ", Setting("stack.datum", names[0])),
        )
    if numbers:
        return list(dates), numbers[0]
    raise InputError(f"no ortho is of {wanted}", field="stack.datum", remedy=such)


def _refuse_reference(dates: Sequence[Dated], match: MatchOptions) -> None:
    """Refuse more than one reference, and a date whose records would have the names of those of the reference."""
    if len(match.reference) > 1:
        raise InputError(
            f"a stack has one reference, not {len(match.reference)}",
            field="match.reference",
            remedy="give one file, such as a VRT of all of them",
        )
    same = next((one for one in dates if key_of_name(one.name) == _REFERENCE), None)
    if same is not None:
        raise InputError(
            f"an image is called {same.name}, as the reference is in the records of a stack",
            file=same.image,
            field="orthos",
            remedy="rename this image",
        )


def _refuse_crs(dates: Sequence[Dated], references: Sequence[Dated]) -> None:
    """Refuse finished orthos whose CRS differ, and a reference in a CRS without a transformation."""
    finished = [one for one in dates if one.scene.sensor == ORTHO]
    require_one_crs(finished)
    for one in references if finished else ():
        with completed(one.path):
            ground_transform(map_grid_of(finished[0]).crs, map_grid_of(one).crs)


def _adjusted(
    nodes: Sequence[Dated], dates: Sequence[Dated], placed: Placed, pairs: Sequence[DatePair], datum: int | None,
    affine: bool,
) -> AdjustedStack:  # fmt: skip
    """Return the adjustment of matched pairs."""
    matched = [pair for pair in pairs if pair.matches is not None]
    remedy = Text("check that all images show one place, or search farther with ", Setting("match.search"))
    if not matched:
        raise InputError(
            f"none of {counted(len(pairs), 'pair')} could be matched: {pairs[0].reason if pairs else ''}",
            field="orthos",
            remedy=remedy,
        )
    cells = Cells.over(*placed.shared(dates, [(pair.first, pair.second) for pair in matched]))
    years = [one.days / _DAYS_A_YEAR for one in nodes]
    years = [year if number < len(dates) else np.nan for number, year in enumerate(years)]
    solved = adjust(cells, _edges(nodes, placed, cells, matched), years, datum, affine=affine)
    if any(one.raw is not None for one in dates):
        # Where an ortho shows the ground displaced, it was made with the height of another place.
        edges = _edges(nodes, placed, cells, matched, Levelled.of(dates, placed, solved))
        solved = adjust(cells, edges, years, datum, affine=affine)
    # The datum itself needs no correction.
    if solved.determined.sum() < 2:
        other = "others" if datum is None else "datum"
        reasons = [pair.reason for pair in pairs if pair.matches is None and datum in (None, pair.first, pair.second)]
        why = f": {reasons[0]}" if reasons else ""
        raise InputError(f"no accepted pair connects a date with the {other}{why}", field="orthos", remedy=remedy)
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
