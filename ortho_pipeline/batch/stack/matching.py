"""Edges of a stack: each pair of dates is matched once; its record says from which files and options."""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.batch.executors import Crew
from ortho_pipeline.batch.records import FileState
from ortho_pipeline.batch.stack.dates import Dated
from ortho_pipeline.batch.stack.recorded import LARGEST, FileSet, Made, RecordedFolder
from ortho_pipeline.commands.orthos.measuring import measure_ortho
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import files_of
from ortho_pipeline.files import read_json, write_json
from ortho_pipeline.files.json.records import Count, Record
from ortho_pipeline.files.locations import Location
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.stores.objects import Objects

_BYTES = 100_000_000
#: What is between the names of two dates.
_BETWEEN = "__"
#: Bytes of a name of a pair: file systems allow 255, and files of records end with more.
_LONGEST = 230


class EdgeMatches(Record):
    """The matches of a pair: where the later ortho shows ground (map x, y) that the earlier one shows at `place`."""

    first: str
    second: str
    place: tuple[tuple[float, float], ...]
    shown: tuple[tuple[float, float], ...]
    sigma_px: tuple[float, ...]
    alike_px: float
    tried: Count
    kept: Count

    @property
    def arrays(self) -> tuple[Array, Array, Array]:
        """Places and positions ``(n, 2)``, and sigmas ``(n,)``."""
        return np.array(self.place).reshape(-1, 2), np.array(self.shown).reshape(-1, 2), np.array(self.sigma_px)


@dataclass(frozen=True)
class DatePair:
    """A pair of dates with its matches; None if it could not be matched, for the reason."""

    first: int
    second: int
    matches: EdgeMatches | None
    reason: str = ""
    fresh: bool = False


@dataclass(frozen=True, eq=False)
class Matcher:
    """Matches pairs, with a record for each in a folder."""

    folder: RecordedFolder
    match: MatchOptions
    scene: SceneOptions
    output: OutputOptions

    def pairs(
        self, dates: Sequence[Dated], wanted: Sequence[tuple[int, int]], crew: Crew, told: Callable[[float], None]
    ) -> list[DatePair]:
        """Return all pairs, matched now or before; `told` hears the finished share."""
        for one, other in wanted:
            self.folder.learn(_name_of(dates[one], dates[other]))
        states = {node: dates[node].states(self.scene) for node in {node for pair in wanted for node in pair}}
        sets = [self._set(dates, states, one, other) for one, other in wanted]
        made = self.folder.make_all(crew, sets, told)
        return [self._pair(one, other, made[of_pair.name]) for (one, other), of_pair in zip(wanted, sets, strict=True)]

    def _set(self, dates: Sequence[Dated], states: Mapping[int, Sequence[FileState]], one: int, other: int) -> FileSet:
        first, second = dates[one], dates[other]
        name = _name_of(first, second)
        roles = {one: "later ortho", other: "earlier ortho"}
        inputs = tuple(state.replaced(role=role) for node, role in roles.items() for state in states[node])
        write = functools.partial(self._write, replace(first, raw=None), replace(second, raw=None), _file_of(name))
        return FileSet(name, inputs, self._configuration(), {"matches": _file_of(name)}, write, may_fail=True)

    def _pair(self, one: int, other: int, made: Made) -> DatePair:
        record = made.record
        if record.error is not None:
            return DatePair(one, other, None, str(record.error["message"]), made.kept)
        with self.folder.local(_file_of(record.name)) as folder:
            return DatePair(one, other, read_matches(folder / _file_of(record.name)), fresh=made.kept)

    def _configuration(self) -> dict[str, Any]:
        return {
            "search": self.match.search,
            "points": self.match.wanted,
            "reference_bands": None if self.match.reference_bands is None else list(self.match.reference_bands),
            "search_rotation": self.match.search_rotation,
        }

    def _write(self, first: Dated, second: Dated, name: str, folder: Path) -> None:
        # Of far images the matcher reads fewer places, and many pairs need all of them.
        with tempfile.TemporaryDirectory(prefix="ortho_") as scratch:
            here = (_copied(one, Path(scratch), self.scene) for one in (first, second))
            write_json(folder / name, self._matched(*here).to_json())

    def _matched(self, first: Dated, second: Dated) -> EdgeMatches:
        options = replace(self.match, reference=(str(second.path),))
        measured = measure_ortho(first.scene, options, scene=self.scene, output=self.output, rounds=0)
        matches = measured.matched.matches
        # Matches on moving ground contradict the others, and they are measured like those.
        kept = np.isin(matches.reason, ("", "contradicts")) & np.isfinite(matches.ground).all(axis=1)
        usual = float(np.median(measured.sigma))
        sigma = np.full(len(kept), usual)
        sigma[matches.reason == ""] = measured.sigma
        shown = first.scene.model.image_to_ground(matches.image[kept], 0.0)[:, :2]
        return EdgeMatches(
            first=first.name,
            second=second.name,
            place=_pairs(matches.ground[kept, :2]),
            shown=_pairs(shown),
            sigma_px=tuple(sigma[kept].tolist()),
            alike_px=float(measured.alike(usual)),
            tried=len(kept),
            kept=int((matches.reason == "").sum()),
        )


def _copied(one: Dated, folder: Path, options: SceneOptions) -> Dated:
    """Return a date with a copy of its ortho on this machine; itself if the ortho is there, or more than one file."""
    address = Location(one.path).url
    if not address.is_address or len(files_of(open_dataset(one.path, **options.access))) > 1:
        return one
    path, (parent, _, name) = folder / f"{one.name}{one.path.suffix}", address.rpartition("/")
    Objects(parent, allow_network=options.allow_network).fetch(name, path, LARGEST)
    return replace(one, path=path, scene=replace(one.scene, path=path))


def _name_of(first: Dated, second: Dated) -> str:
    """Return the name of the record of a pair, which no other pair has."""
    name = f"{first.name}{_BETWEEN}{second.name}"
    # Another pair may have its names joined to the same text: here the length tells where the first one ends.
    is_ambiguous = name.find(_BETWEEN) != name.rfind(_BETWEEN)
    name = f"{name}{_BETWEEN}{len(first.name)}" if is_ambiguous else name
    encoded = os.fsencode(name)
    return name if len(encoded) <= _LONGEST else hashlib.sha256(encoded).hexdigest()


def _file_of(name: str) -> str:
    return f"{name}.json"


def _pairs(values: Array) -> tuple[tuple[float, float], ...]:
    return tuple((x, y) for x, y in values.tolist())


def read_matches(path: Path) -> EdgeMatches:
    """Return the matches of a pair from their file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    remedy = "delete this file and run again"
    try:
        found = EdgeMatches.read(read_json(path, _BYTES, remedy))
    except ValueError as error:
        raise InputError(
            f"these are not the matches of a pair ({error})", file=path, field="pair", remedy=remedy
        ) from error
    if not len(found.place) == len(found.shown) == len(found.sigma_px):
        raise InputError("the matches of this pair have unequal lengths", file=path, field="pair", remedy=remedy)
    return found
