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

from ortho_pipeline.display.numbers import metres
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files import write_text
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.report.page.advice import WORDS, Signal, signals
from ortho_pipeline.report.page.behaviour import policy, script
from ortho_pipeline.report.records import UNKNOWN
from ortho_pipeline.report.summary import processed, sensors_text
from ortho_pipeline.report.wording import refuted

#: Longer side of a thumbnail, px, and how many scenes have one: a page of thousands would be no page.
_SIDE, _MOST = 88, 300
#: Of a scene that no run has finished.
_NOT_MADE = {"message": "this scene is not made yet", "file": None, "field": None, "remedy": "run it"}
#: The evidence that scenes are ordered by, the best first.
EVIDENCE = {
    "check": ("check point", "check points"),
    "matched": ("match (relative)", "matches (relative)"),
    "loo": ("control point, left out in turn", "control points, each left out in turn"),
    "control": ("point of the delivered model", "points of the delivered model"),
}


#: What a scene may be other than tested, the worst first.
STATES = {"failed": "failed", "stop": "with errors", "untested": "of unknown accuracy"}


@dataclass(frozen=True)
class SceneRow:
    """A scene of the page; `page` is the address of its report from here, `rmse` px of the best `evidence` there is.

    `signal` is the gravest of its errors and warnings; `state` is ``failed``, ``stop`` (with errors), ``untested`` or
    ``ready``; `tested_at` the evidence in words.
    """

    name: str
    error: Mapping[str, Any] | None
    facts: Mapping[str, Any]
    page: str | None
    evidence: str | None
    rmse: float | None
    metres: float | None
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
        return tested_at(self.facts)


def write_run_page(
    path: str | os.PathLike[str], title: str, scenes: Sequence[Mapping[str, Any]], provenance: Mapping[str, Any]
) -> None:
    """Write the page of a run, unless it is there and of the same scenes, results and provenance.

    Parameters
    ----------
    scenes : sequence of mapping
        As in ``run.json``: name, files (paths), facts, error. What differs between runs of one result (seconds, and
        whether a scene was made or found) is no part of the page.
    provenance : mapping
        Versions, and the pipeline file among the inputs.
    """
    folder = Path(path).parent
    rows = sorted((_row(one, folder) for one in scenes), key=_order)
    told = [[row.name, row.error, row.facts, row.page] for row in rows]
    content = [title, told, script(), dict(provenance)]
    key = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()
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
        about=_about(rows),
        provenance=provenance,
    )
    write_text(path, page)


def _headline(states: Mapping[str, int], count: int) -> str:
    """Say how many orthos there are, how many of them are tested, and how many scenes failed."""
    failed = states.get("failed", 0)
    kinds = {"ready": "tested", "stop": STATES["stop"], "untested": STATES["untested"]}
    which = {what: states[state] for state, what in kinds.items() if states.get(state)}
    orthos = counted(count - failed, "ortho")
    parts = [f"{orthos} ({', '.join(f'{number} {what}' for what, number in which.items())})"] if len(which) > 1 else []
    if len(which) == 1:
        parts = [counted(count - failed, "tested ortho") if "tested" in which else f"{orthos} {next(iter(which))}"]
    parts += [f"{failed} failed"] if failed else []
    return f"{counted(count, 'scene')}: {'; '.join(parts)}"


def _summary(rows: Sequence[SceneRow]) -> str:
    """Say how accurate the tested orthos are, and from which points."""
    ready = [row for row in rows if row.state == "ready"]
    parts = []
    for kind, (_, name) in EVIDENCE.items():
        sizes = [row.metres for row in ready if row.evidence == kind and row.metres is not None]
        if sizes:
            span = metres(sizes[0]) if len(sizes) == 1 else f"{min(sizes):.2f} to {metres(max(sizes))}"
            parts.append(f"{len(sizes)} tested at {name}: RMSE {span}")
    return f"{'; '.join(parts)}." if parts else "no ortho is tested."


def _about(rows: Sequence[SceneRow]) -> dict[str, str]:
    """Return when the page was made, how many scenes there are, and their sensors."""
    sensors = sensors_text((str(row.facts["sensor"]) for row in rows if row.facts.get("sensor")), ())
    texts = {"Processed": processed(), "Scenes": str(len(rows)), "Sensor": sensors}
    return {key: text for key, text in texts.items() if text}


def _is_of(path: Path, key: str) -> bool:
    try:
        with open(path, encoding="utf-8") as file:
            return f'content="{key}"' in file.read(2000)
    except (OSError, UnicodeDecodeError):
        return False


def _row(scene: Mapping[str, Any], folder: Path) -> SceneRow:
    facts, error = scene["facts"], scene["error"]
    if not error and not facts:
        error = _NOT_MADE
    found = None if error else evidence_in(facts)
    rmses, on_ground = facts.get("rmse_px") or {}, facts.get("rmse_m") or {}
    tested = found is not None or refuted(facts.get("notices") or ()) is not None
    page = scene["files"].get("html")
    return SceneRow(
        name=scene["name"],
        error=error,
        facts={} if error else facts,
        page=None if page is None or error else quote(os.path.relpath(page, folder)),
        evidence=found,
        rmse=None if found is None else rmses[found],
        metres=None if found is None else on_ground.get(found),
        signal=None if error else _gravest(facts, tested=tested),
    )


def evidence_in(facts: Mapping[str, Any]) -> str | None:
    """Return which points tell the accuracy of a scene, by the facts of a run; None where it is unknown."""
    if refuted(facts.get("notices") or ()) or (facts.get("headline") or {}).get("figure") == UNKNOWN:
        return None
    rmses = facts.get("rmse_px") or {}
    return next((kind for kind in EVIDENCE if rmses.get(kind) is not None), None)


def tested_at(facts: Mapping[str, Any]) -> str:
    """Return the points that tell the accuracy of a scene, in words with their number."""
    kind = evidence_in(facts)
    if kind is None:
        why = "see the error" if refuted(facts.get("notices") or ()) else "untested"
        return f"accuracy unknown: {why}"
    number, (one, many) = (facts.get("rmse_points") or {}).get(kind), EVIDENCE[kind]
    return many if number is None else counted(number, one, many)


def _gravest(facts: Mapping[str, Any], *, tested: bool) -> Signal | None:
    said = signals(facts.get("warnings") or (), facts.get("notices") or (), tested=tested)
    return next((one for one in said if one.level != "know"), None)


def _order(row: SceneRow) -> tuple[Any, ...]:
    """Failed scenes first, then those with errors, then those of unknown accuracy, then the largest RMSE."""
    return [*STATES, "ready"].index(row.state), -(row.rmse or 0.0), row.name


def _with_thumbnail(row: SceneRow, ortho: str | None) -> SceneRow:
    if ortho is None or row.error is not None:
        return row
    try:
        picture = base64.b64encode(preview_png(ortho, side=_SIDE)).decode()
    except OrthoError:
        return row
    return SceneRow(**{**vars(row), "thumbnail": picture})
