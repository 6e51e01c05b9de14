"""The page of a run: every scene with a thumbnail, what failed first, then the least accurate."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ortho_pipeline.display.numbers import fixed, px
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files import write_text
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.report.page.advice import WORDS, Signal, signals
from ortho_pipeline.report.page.behaviour import policy, script
from ortho_pipeline.report.wording import refuted

#: Longer side of a thumbnail, px, and how many scenes have one: a page of thousands would be no page.
_SIDE, _MOST = 88, 300
#: Of a scene that no run has finished.
_NOT_MADE = {"message": "nobody has made this scene yet", "file": None, "field": None, "remedy": "run it"}
#: The evidence that scenes are ordered by, the best first.
EVIDENCE = {
    "check": ("check point", "check points"),
    "matched": ("held-out match", "held-out matches"),
    "loo": ("control point left out in turn", "control points left out in turn"),
    "control": ("control point: the fit", "control points: the fit"),
}


#: What a scene may be other than ready, the worst first.
STATES = {"failed": "failed", "stop": "to settle first", "untested": "not tested"}


@dataclass(frozen=True)
class SceneRow:
    """A scene of the page; `page` is the address of its report from here, `rmse` px of the best `evidence` there is.

    `signal` is the gravest of its notices, if it is to be looked at; `state` is ``failed``, ``stop`` (something is to
    be settled first), ``untested`` or ``ready``; `tested_at` the evidence in words;
    `untrue` tells that an error makes its figures untrue.
    """

    name: str
    error: Mapping[str, Any] | None
    facts: Mapping[str, Any]
    page: str | None
    evidence: str | None
    rmse: float | None
    metres: float | None
    untrue: bool = False
    signal: Signal | None = None
    thumbnail: str | None = None

    @property
    def state(self) -> str:
        """Which of the four states of `STATES` it is in."""
        if self.error is not None:
            return "failed"
        if self.signal is not None and self.signal.level == "stop":
            return "stop"
        return "untested" if self.evidence is None else "ready"

    @property
    def tested_at(self) -> str:
        """The evidence in words, with the number of points."""
        if self.untrue:
            return "unknown: see the error"
        if self.evidence is None:
            return "not tested"
        one, many = EVIDENCE[self.evidence]
        number = (self.facts.get("rmse_points") or {}).get(self.evidence)
        return many if number is None else counted(number, one, many)


def write_run_page(path: str | os.PathLike[str], title: str, scenes: Sequence[Mapping[str, Any]]) -> None:
    """Write the page of a run, unless it is there and of the same scenes and results.

    Parameters
    ----------
    scenes : sequence of mapping
        As in ``run.json``: name, files (paths), facts, error. What differs between runs of one result (seconds, and
        whether a scene was made or found) is no part of the page.
    """
    folder = Path(path).parent
    rows = sorted((_row(one, folder) for one in scenes), key=_order)
    told = [[row.name, row.error, row.facts, row.page] for row in rows]
    key = hashlib.sha256(json.dumps([title, told, script()], sort_keys=True, default=str).encode()).hexdigest()
    if _is_of(Path(path), key):
        return
    orthos = {one["name"]: one["files"].get("ortho") for one in scenes}
    shown = [_with_thumbnail(row, orthos[row.name]) if k < _MOST else row for k, row in enumerate(rows)]
    code = script()
    states = Counter(row.state for row in rows)
    page = render(
        "report/run.html.j2",
        title=title,
        rows=shown,
        key=key,
        script=code,
        policy=policy(code),
        thumbnails=_MOST,
        head=_headline(states, len(rows)),
        levels=WORDS,
        said=_summary(rows),
    )
    write_text(path, page)


def _headline(states: Mapping[str, int], count: int) -> str:
    """Say of how many scenes what holds; every scene counts once."""
    others = [f"{states[state]} {what}" for state, what in STATES.items() if states.get(state)]
    ready = f"{states.get('ready', 0)} of {counted(count, 'scene')} ready"
    return f"{ready}; {', '.join(others)}" if others else f"{counted(count, 'scene')}, all ready"


def _summary(rows: Sequence[SceneRow]) -> str:
    """Say how accurate the scenes are that are ready, by what evidence."""
    ready = [row for row in rows if row.state == "ready"]
    parts = []
    for kind, (_, name) in EVIDENCE.items():
        sizes = [row.rmse for row in ready if row.evidence == kind and row.rmse is not None]
        if sizes:
            span = px(sizes[0]) if len(sizes) == 1 else f"{fixed(min(sizes))} to {px(max(sizes))}"
            parts.append(f"{len(sizes)} tested at {name}, RMSE {span}")
    return f"of those ready {'; '.join(parts)}." if parts else "none is ready."


def _is_of(path: Path, key: str) -> bool:
    try:
        with open(path, encoding="utf-8") as file:
            return f'content="{key}"' in file.read(2000)
    except (OSError, UnicodeDecodeError):
        return False


def _row(scene: Mapping[str, Any], folder: Path) -> SceneRow:
    facts, error, found = scene["facts"], scene["error"], None
    if not error and not facts:
        error = _NOT_MADE
    rmses, metres = facts.get("rmse_px") or {}, facts.get("rmse_m") or {}
    # A figure that an error makes untrue is not shown.
    untrue = not error and refuted(facts.get("notices") or ()) is not None
    if not error and not untrue:
        found = next((kind for kind in EVIDENCE if rmses.get(kind) is not None), None)
    page = scene["files"].get("html")
    return SceneRow(
        name=scene["name"],
        error=error,
        facts={} if error else facts,
        page=None if page is None or error else quote(os.path.relpath(page, folder)),
        evidence=found,
        rmse=None if found is None else rmses[found],
        metres=None if found is None else metres.get(found),
        untrue=untrue,
        signal=None if error else _gravest(facts, tested=untrue or found is not None),
    )


def _gravest(facts: Mapping[str, Any], *, tested: bool) -> Signal | None:
    said = signals(facts.get("warnings") or (), facts.get("notices") or (), tested=tested)
    return next((one for one in said if one.level != "know"), None)


def _order(row: SceneRow) -> tuple[Any, ...]:
    """Failed scenes first, then what is to be settled, then those of unknown accuracy, then the largest RMSE."""
    return [*STATES, "ready"].index(row.state), -(row.rmse or 0.0), row.name


def _with_thumbnail(row: SceneRow, ortho: str | None) -> SceneRow:
    if ortho is None or row.error is not None:
        return row
    try:
        picture = base64.b64encode(preview_png(ortho, side=_SIDE)).decode()
    except OrthoError:
        return row
    return SceneRow(**{**vars(row), "thumbnail": picture})
