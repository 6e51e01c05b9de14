"""`ortho stack`: orthos of many dates in; corrections that agree, aligned orthos, a record and a page out."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.batch.freshness import DIGESTS
from ortho_pipeline.batch.records import FileState, RunRecord, key_of, locked
from ortho_pipeline.batch.stack.dates import Dated, dated_orthos, time_of
from ortho_pipeline.batch.stack.document import record_of
from ortho_pipeline.batch.stack.matching import DatePair, Matcher
from ortho_pipeline.batch.stack.placing import Placed, geotransform_of, pixel_of
from ortho_pipeline.block.stack.adjustment import AdjustedStack, adjust
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.graph import NEIGHBOURS, pairs_of
from ortho_pipeline.commands.orthos.opening import open_ortho
from ortho_pipeline.commands.orthos.resampling import write_resampled
from ortho_pipeline.commands.resolved.ledger import versions
from ortho_pipeline.commands.results import Result
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.exchange.moved_grid import write_moved
from ortho_pipeline.files import clear_up, together, write_json
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.raster.caching.block_cache import cache_restored
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.report.stack.page import write_page
from ortho_pipeline.report.stack.records import StackRecord
from ortho_pipeline.runtime.process_limits import one_blas_thread
from ortho_pipeline.stores.delivery import address_of

_EDGES, _ALIGNED = "pairs", "aligned"
_DAYS_A_YEAR = 365.25
Told = Callable[[str, float], None]


@one_blas_thread()
@cache_restored()
def stack(
    orthos: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    *,
    datum: str = "mean",
    date_pattern: str | None = None,
    match: MatchOptions = MatchOptions(),
    scene: SceneOptions = SceneOptions(),
    output: OutputOptions = OutputOptions(resampling="cubic"),
    neighbours: int = NEIGHBOURS,
    affine: bool = True,
    corrections_only: bool = False,
    rebuild: bool = False,
    progress: Told | None = None,
) -> Result:
    """Make finished orthos of many dates agree with each other.

    Parameters
    ----------
    orthos : sequence of path
        Orthos, folders of them, patterns of names, and CSV lists with the columns file and date.
    datum : str
        What keeps its place: ``mean`` of all dates, one date, or ``reference`` (`match.reference`).
    neighbours : int
        Earlier dates with which each date is matched, besides the same season of earlier years.
    affine : bool
        Let dates have an affine correction where it is significant.
    corrections_only : bool
        Keep the pixels: write VRTs with a corrected map grid.
    rebuild : bool
        Match and write again what has a record.

    Raises
    ------
    InputError
        If an ortho has no date, the CRS differ, or no pair can be matched.
    """
    if address_of(folder) is not None:
        raise InputError(
            "a stack is written to a folder on this machine", file=str(folder), field="folder", remedy="give a folder"
        )
    dates = dated_orthos(orthos, date_pattern, scene)
    nodes, fixed = _with_datum(dates, datum, match, scene)
    placed, folder = Placed.of(nodes[: len(dates)]), Path(folder)
    told = progress or (lambda what, share: None)
    with locked(folder / _EDGES / ".lock", owner="ortho stack"):
        matcher = Matcher(folder / _EDGES, replace(match, reference=()), scene, output, rebuild)
        wanted = pairs_of([one.days for one in dates], neighbours)
        if len(nodes) > len(dates):
            wanted += [(date, len(dates)) for date in range(len(dates))]
        pairs = matcher.pairs(nodes, wanted, lambda done, of: told("matching", done / of))
        solved = _adjusted(nodes, dates, placed, pairs, fixed, affine)
        writer = _Writer(folder / _ALIGNED, placed, scene, output, corrections_only, rebuild)
        outputs = writer.write(dates, solved, told)
        record = record_of(dates, placed, pairs, solved, outputs, datum)
        files = {"aligned": folder / _ALIGNED, "json": folder / "stack.json", "html": folder / "stack.html"}
        with together(folder, "stack"):
            write_json(files["json"], record.to_json())
            write_page(record, files["html"])
    return Result(files, record.to_json(), summary(record, sum(pair.fresh for pair in pairs)))


def _with_datum(
    dates: Sequence[Dated], datum: str, match: MatchOptions, scene: SceneOptions
) -> tuple[list[Dated], int | None]:
    """Return the dates, with the reference after them if it is the datum, and the number of the datum."""
    if (datum == "reference") != bool(match.reference):
        setting = Text("give both: ", Setting("match.reference", "FILE"), " and ", Setting("datum", "reference"))
        what = "no reference" if datum == "reference" else "a reference, but another datum"
        raise InputError(f"there is {what}", field="datum", remedy=setting)
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
        f"no ortho is of {wanted}", field="datum", remedy=f"give mean, or a date such as {dates[0].time.date()}"
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
    step = float(np.sqrt(placed.grid.dx * placed.grid.dy))
    value, variance, alike = [], [], []
    for pair in matched:
        assert pair.matches is not None
        place, shown, sigma = pair.matches.arrays
        own = pixel_of(nodes[pair.first]) / step
        at = placed.at(place)
        mean, spread = cells.sampled(at, placed.at(shown) - at, sigma * own)
        value.append(mean)
        variance.append(spread)
        alike.append(pair.matches.alike_px * own)
    edges = Edges(
        np.array([pair.first for pair in matched]), np.array([pair.second for pair in matched]), np.array(value),
        np.array(variance), np.array(alike),
    )  # fmt: skip
    years = [one.days / _DAYS_A_YEAR for one in nodes]
    years = [year if number < len(dates) else np.nan for number, year in enumerate(years)]
    return adjust(cells, edges, years, datum, affine=affine)


class _Writer:
    """Writes the corrected ortho of each date; one whose inputs and correction are as recorded is kept."""

    def __init__(
        self,
        folder: Path,
        placed: Placed,
        scene: SceneOptions,
        output: OutputOptions,
        corrections_only: bool,
        rebuild: bool,
    ) -> None:
        self.folder, self.placed, self.scene, self.output = folder, placed, scene, output
        self.corrections_only, self.rebuild = corrections_only, rebuild
        self.software = versions()

    def write(self, dates: Sequence[Dated], solved: AdjustedStack, told: Told) -> dict[str, str]:
        """Return the files of dates, relative to the folder of the stack."""
        found = {}
        for number, one in enumerate(dates):
            if solved.determined[number]:
                found[one.name] = self._one(one, solved, number)
            told("writing", (number + 1) / len(dates))
        return found

    def _one(self, one: Dated, solved: AdjustedStack, number: int) -> str:
        model = self.placed.corrected(one, solved, number)
        name = f"{one.name}_aligned{'.vrt' if self.corrections_only else '.tif'}"
        path, place = self.folder / name, self.folder / f"{one.name}.record.json"
        files = [path, path.with_name(f"{one.name}_model.json")]
        for file in (*files, place):
            clear_up(file)
        inputs = (FileState.of("ortho", one.path.absolute(), DIGESTS),)
        key = key_of(inputs, self._configuration(model.to_dict()), self.software)
        record = None if self.rebuild else RunRecord.at(place)
        if record is None or record.key != key or not record.intact(self.folder):
            self._written(one, model, path)
            outputs = tuple(FileState.of(file.suffix[1:], file, name=file.name) for file in files)
            RunRecord(name=one.name, key=key, status="done", inputs=inputs, outputs=outputs).write(place)
        return f"{self.folder.name}/{name}"

    def _configuration(self, model: dict[str, Any]) -> dict[str, Any]:
        output = self.output
        return {
            "model": model,
            "grid": [*self.placed.grid.geotransform, self.placed.grid.width, self.placed.grid.height],
            "corrections_only": self.corrections_only,
            "output": [output.resampling, output.nodata, output.dtype, output.format, dict(output.creation_options)],
        }

    def _written(self, one: Dated, model: Any, path: Path) -> None:
        if self.corrections_only:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_moved(open_dataset(one.path, **self.scene.access), geotransform_of(model), path)
        else:
            write_resampled(one.scene, model, self.placed.grid, path, self.output, self.scene)
        size = one.scene.width, one.scene.height
        saved = SavedModel(model, one.scene.sensor, str(one.path), size, {})
        write_model_file(saved, path.with_name(f"{one.name}_model.json"))


def summary(record: StackRecord, fresh: int = 0) -> str:
    """Return what people read of a stack."""
    sigmas = [max(one.sigma_px) for one in record.dates if one.sigma_px is not None]
    status = [one.status for one in record.pairs]
    lines = [
        f"{counted(len(record.dates), 'date')}, {sum(one.correction == 'affine' for one in record.dates)} with an "
        f"affine correction; sigma of a correction {np.median(sigmas):.3f} px (median)",
        f"Pairs: {len(status)} ({fresh} from an earlier run), {status.count('rejected')} rejected, "
        f"{status.count('not matched')} not matched",
    ]
    after = record.closure_after
    if after.median_px is not None:
        before = record.closure_before
        lines.append(
            f"Loops of three pairs close to {after.median_px:.3f} px (median; largest {after.largest_px:.2f} px, "
            f"with rejected pairs {before.largest_px:.2f} px)"
        )
    lines.append(f"Moving ground: {counted(len(record.moving), 'area')}; steps: {len(record.steps)}")
    return "\n".join(lines)
