"""Edges of a stack: each pair of dates is matched once; its record says from which files and options."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.batch.freshness import DIGESTS, recorded_at
from ortho_pipeline.batch.records import FileState, RunRecord, key_of
from ortho_pipeline.batch.stack.dates import Dated
from ortho_pipeline.commands.orthos.measuring import measure_ortho
from ortho_pipeline.commands.resolved.ledger import versions
from ortho_pipeline.errors import InputError, error_document
from ortho_pipeline.files import read_json, write_json
from ortho_pipeline.files.json.records import Count, Record
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions

#: Error that all matches of a pair share, px of a chip; more than `ortho verify` assumes.
_ALIKE = 0.0075
_BYTES = 100_000_000


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
    """Matches pairs, with a record for each in a folder.

    Parameters
    ----------
    rebuild : bool
        Match also pairs with a record.
    """

    folder: Path
    match: MatchOptions
    scene: SceneOptions
    output: OutputOptions
    rebuild: bool = False

    def pairs(
        self, dates: Sequence[Dated], wanted: Sequence[tuple[int, int]], told: Callable[[int, int], None]
    ) -> list[DatePair]:
        """Return all pairs, matched now or before; `told` hears how many are done."""
        software = versions()
        found = []
        for number, (one, other) in enumerate(wanted):
            found.append(self._pair(dates, one, other, software))
            told(number + 1, len(wanted))
        return found

    def _pair(self, dates: Sequence[Dated], one: int, other: int, software: dict[str, Any]) -> DatePair:
        first, second = dates[one], dates[other]
        name = f"{first.name}__{second.name}"
        data, place = self.folder / f"{name}.json", self.folder / f"{name}.record.json"
        record = recorded_at(place, data, rebuild=self.rebuild)
        inputs = tuple(
            FileState.of(role, dated.path.absolute(), DIGESTS)
            for role, dated in (("later ortho", first), ("earlier ortho", second))
        )
        key = key_of(inputs, self._configuration(), software)
        if record is not None and record.is_of(key, self.folder):
            if record.status == "failed" and record.error is not None:
                return DatePair(one, other, None, str(record.error["message"]), True)
            if record.status == "done" and len(record.outputs) == 1:
                return DatePair(one, other, read_matches(data), fresh=True)
        made = RunRecord(name=name, key=key, status="failed", inputs=inputs)
        try:
            matches = self._matched(first, second)
        except InputError as error:
            made.replaced(error=error_document(error)).write(place)
            return DatePair(one, other, None, error.message)
        write_json(data, matches.to_json())
        made.replaced(status="done", outputs=(FileState.of("matches", data, name=data.name),)).write(place)
        return DatePair(one, other, matches)

    def _configuration(self) -> dict[str, Any]:
        return {
            "search": self.match.search,
            "points": self.match.points,
            "reference_bands": None if self.match.reference_bands is None else list(self.match.reference_bands),
            "search_rotation": self.match.search_rotation,
        }

    def _matched(self, first: Dated, second: Dated) -> EdgeMatches:
        options = replace(self.match, reference=(str(second.path),))
        measured = measure_ortho(first.scene, options, scene=self.scene, output=self.output)
        matches = measured.matched.matches
        # Matches on moving ground contradict the others, and they are measured like those.
        kept = np.isin(matches.reason, ("", "contradicts")) & np.isfinite(matches.ground).all(axis=1)
        sigma = np.full(len(kept), float(np.median(measured.sigma)))
        sigma[matches.reason == ""] = measured.sigma
        shown = first.scene.model.image_to_ground(matches.image[kept], 0.0)[:, :2]
        alike = max(float(matches.points.sigma_alike.max(initial=0.0)), _ALIKE * matches.factor)
        return EdgeMatches(
            first=first.name,
            second=second.name,
            place=_pairs(matches.ground[kept, :2]),
            shown=_pairs(shown),
            sigma_px=tuple(sigma[kept].tolist()),
            alike_px=alike,
            tried=len(kept),
            kept=int((matches.reason == "").sum()),
        )


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
