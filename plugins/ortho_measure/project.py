"""A project of measured points: each action is journaled, then solved, then shown in all geometries that there are."""

from __future__ import annotations

import abc
import copy
import datetime
import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ortho_measure.journal import REMEDY as JOURNAL_REMEDY
from ortho_measure.journal import Journal
from ortho_measure.marks import GROUND_CRS, History, Mark, Marks, Written
from ortho_measure.places import Geometry, SceneGeometry, Sheet, ground_typed, linked
from ortho_measure.planning import Next
from ortho_pipeline.commands.results import Result
from ortho_pipeline.errors import InputError, completed
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import write_json
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.imaging.matching import SceneView
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.surface.base import Surface

#: What is appended to the name of the points for their journal.
JOURNAL = ".journal"
#: What is rendered by a model is rendered anew where it moves by more than this (px).
_MOVED = 0.2


class _Shown(abc.ABC):
    """What a page is shown of a project: its points, their places in every view, and the figures."""

    views: tuple[SceneView, ...]
    sheets: tuple[Sheet, ...]
    surface: Surface
    _history: History
    _written: Written
    _lock: threading.RLock

    @abc.abstractmethod
    def _geometries(self, version: int) -> Mapping[str, Geometry]: ...

    @property
    def marks(self) -> Marks:
        """The points as they are now."""
        return self._history.marks

    @property
    @abc.abstractmethod
    def version(self) -> int:
        """Number of the models that references are rendered with now."""

    @abc.abstractmethod
    def places_of(self, number: int) -> SceneGeometry:
        """Return the geometry of an image as it is adjusted now."""

    @abc.abstractmethod
    def _figures(self) -> dict[str, Any]:
        """Return what is shown of the solution, as JSON values."""

    @abc.abstractmethod
    def _ahead(self) -> list[Next]:
        """Return places where to measure next, the best first."""

    def _grounds(self, marks: Sequence[Mark]) -> Array:
        """Return the ground ``(N, 3)`` at which marks are shown; NaN where there is none."""
        return np.array([mark.ground or (np.nan,) * 3 for mark in marks], dtype=float).reshape(-1, 3)

    def _shown(self) -> dict[str, Any]:
        """Return what `state` does, but for the number of actions."""
        marks, history, version = list(self.marks.by_id.values()), self._history, self.version
        shown, ahead = self._places(version, self._grounds(marks)), self._ahead()
        there = np.full((len(ahead), 3), np.nan)
        for number in {one.number for one in ahead}:
            rows = [k for k, one in enumerate(ahead) if one.number == number]
            there[rows] = self.places_of(number).ground_about(
                [ahead[k].image for k in rows], [ahead[k].height for k in rows]
            )
        told = [self._written.of(mark) for mark in marks]
        return {
            "marks": [{**mark, "places": places} for mark, places in zip(told, shown, strict=True)],
            "version": version,
            "undo": history.can_undo,
            "redo": history.can_redo,
            **self._figures(),
            "next": [
                {**json_value(one), "places": places}
                for one, places in zip(ahead, self._places(version, there), strict=True)
            ],
        }

    # -- places ------------------------------------------------------------------------------------------------------

    def _places(self, version: int, ground: Array) -> list[dict[str, list[float] | None]]:
        """Return where each ground ``(N, 3)`` lies in all geometries; null where it does not."""
        found = {name: one.image_of(ground) for name, one in self._geometries(version).items()}
        return [{name: json_position(places[k]) for name, places in found.items()} for k in range(len(ground))]

    def _geometry(self, name: str, version: int) -> Geometry:
        known = self._geometries(version)
        if name not in known:
            raise InputError("there is no such view", field="at")
        return known[name]

    def predict(
        self,
        version: int,
        at: str | None = None,
        place: Sequence[float] | None = None,
        ground: Sequence[float] | None = None,
    ) -> dict[str, Any]:
        """Return where a place of a geometry, or of the ground, lies in all of them.

        Parameters
        ----------
        at : str, optional
            The geometry of `place`.
        ground : (lon, lat, h), optional
            In `GROUND_CRS`.

        Returns
        -------
        dict
            `ground`; `places` by geometry, px; `sigma`, of the prediction in the first image; null is what cannot be
            said.
        """
        with self._lock:
            if ground is not None:
                found = np.array([ground], dtype=float)
            else:
                found = self._geometry(str(at), version).ground_of(np.array([place], dtype=float))
            return {
                "ground": json_position(found[0]),
                "places": self._places(version, found)[0],
                "sigma": self._sigma(found),
            }

    @abc.abstractmethod
    def _sigma(self, ground: Array) -> list[float] | None:
        """Return the standard deviations (px) of the predicted image of ground ``(1, 3)``, if they are known."""

    def link(self, version: int, at: str, place: Sequence[float], to: str) -> dict[str, Any]:
        """Return how one geometry lies in another about a place, as `places.linked`."""
        with self._lock:
            return linked(self._geometry(at, version), self._geometry(to, version), place)

    def typed(self, values: Sequence[float | None], crs: str, vertical: str | None) -> list[float]:
        """Return typed coordinates as ground in `GROUND_CRS`."""
        return ground_typed(values, crs or GROUND_CRS, vertical, self.surface).tolist()


class Project(_Shown):
    """Points that are measured, with their journal.

    Geometries have names: ``scene-K`` is image K as it is adjusted now, ``reference-K`` what is rendered into its
    pixels by an earlier model, its version, ``map-R`` reference R in its own pixels.

    Parameters
    ----------
    output : Path
        The GeoJSON of the points; its journal lies beside it.
    surface : Surface
        The heights.
    views : sequence of SceneView
        The images.
    sheets : sequence of Sheet
        The references as maps.

    Attributes
    ----------
    stopped : str
        Which action of the journal was impossible, if one was: the points are those before it.
    """

    _solution: Any
    rendered: list[Any]

    def __init__(self, output: Path, surface: Surface, views: Sequence[SceneView], sheets: Sequence[Sheet]) -> None:
        self.output, self.surface, self.views, self.sheets = output, surface, tuple(views), tuple(sheets)
        self._lock = threading.RLock()
        self._saved = -1
        self.stopped = ""
        self.journal = Journal(output.with_name(output.name + JOURNAL))
        self._history, self._written = History(), Written()

    # -- what differs ------------------------------------------------------------------------------------------------

    @abc.abstractmethod
    def _identity(self) -> dict[str, Any]:
        """Say which images a journal is of."""

    @abc.abstractmethod
    def _source(self) -> dict[str, Any] | None:
        """Say which file of points it begins with; None for none."""

    @abc.abstractmethod
    def _given(self) -> list[Mark] | None:
        """Return the points that it begins with; None if none were given."""

    @abc.abstractmethod
    def _require_possible(self, marks: Iterable[Mark], correction: str | None) -> None:
        """Refuse marks, and a correction, that images such as these cannot have.

        Raises
        ------
        InputError
        """

    @abc.abstractmethod
    def _solve(self) -> None:
        """Adjust to the points as they are."""

    @abc.abstractmethod
    def _geometries(self, version: int) -> Mapping[str, Geometry]:
        """Return all geometries by their names."""

    @abc.abstractmethod
    def rendering(self, name: str, version: int) -> SceneGeometry | None:
        """Return what a view is rendered from by a model; None if it is the raster itself.

        Raises
        ------
        InputError
            If there is no such version.
        """

    @abc.abstractmethod
    def _document(self) -> dict[str, Any]:
        """Return the GeoJSON of the points."""

    @abc.abstractmethod
    def compared(self) -> dict[str, Any]:
        """Return the models, or corrections, that the points could be fitted with, compared, and the one to take."""

    @abc.abstractmethod
    def ortho(self, progress: Progress, number: int = 0) -> Result:
        """Make the ortho of an image with the saved points, in a folder beside them."""

    # -- beginning and end -------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Do again what the journal holds; a new one begins with the points that were given."""
        try:
            source = self._source()
            if not self.journal.actions:
                if not self.journal.read_only:
                    self.journal.append(self._first())
            elif self.journal.actions[0].get("image") != self._identity():
                raise InputError(
                    "this journal is of another image",
                    file=self.journal.path,
                    field="output",
                    remedy="choose another output, or move the journal away",
                )
            elif source is not None and source != self.journal.actions[0].get("source"):
                raise InputError(
                    "there is a journal of these points, which began with others",
                    file=self.journal.path,
                    field="points.gcps",
                    remedy=Text("leave out ", Setting("points.gcps"), " to go on, or choose another output"),
                )
            with completed(self.journal.path, remedy=JOURNAL_REMEDY):
                count = self._take(self.journal.actions)
            if self.stopped:
                self.journal.set_aside(count)
        except BaseException:
            self.journal.close()
            raise
        self._solve()

    def _take(self, actions: Sequence[Mapping[str, Any]]) -> int:
        """Do actions of the journal up to one that is impossible; return how many were done."""
        for number, action in enumerate(actions):
            try:
                self._history.take(self._step(_plain(action)))
            except InputError as error:
                if action.get("do") == "begin":
                    raise
                line = len(self.journal.actions) - len(actions) + number + 1
                self.stopped = f"action {line} of the journal is impossible ({error.message})"
                return number
        return len(actions)

    def _step(self, action: Mapping[str, Any]) -> Marks | int:
        """Return what an action leads to, as `History.after`, if images such as these can have it."""
        step, known = self._history.after(action), self.marks.by_id
        if isinstance(step, Marks):
            changed = (mark for name, mark in step.by_id.items() if known.get(name) is not mark)
            self._require_possible(changed, step.correction)
        return step

    def _first(self) -> dict[str, Any]:
        """Return the action that a journal begins with."""
        given = self._given()
        if given is None and self.output.exists():
            raise InputError(
                "there are points here, and no journal of them",
                file=self.output,
                field="output",
                remedy=Text("give them as ", Setting("points.gcps"), " to go on, or choose another output"),
            )
        return {
            "do": "begin",
            "marks": [mark.to_json() for mark in given or ()],
            "source": self._source(),
            "image": self._identity(),
            "at": now(),
        }

    def save(self) -> None:
        """Write the GeoJSON, whole, unless it holds all actions already."""
        with self._lock:
            if self.journal.read_only or self._saved == len(self.journal.actions):
                return
            document, count = self._document(), len(self.journal.actions)
            write_json(self.output, document)
            self._saved = count

    def close(self) -> None:
        """Write what is not written, and let go of the journal."""
        self.save()
        self.journal.close()

    # -- actions -----------------------------------------------------------------------------------------------------

    def act(self, action: Mapping[str, Any]) -> dict[str, Any]:
        """Do an action and return what there is to show after it.

        Raises
        ------
        InputError
            If it cannot be done or written down; nothing has changed then.
        """
        with self._lock:
            if action.get("do") == "begin":
                raise InputError("this is no action", field="do")
            done = (
                {**action, "mark": {**action["mark"], "at": now()}} if isinstance(action.get("mark"), dict) else action
            )
            step = self._step(done)
            before = self._history, self._solution, self.rendered
            self._history = copy.copy(self._history)
            try:
                # What is in the journal has to open again: it was solved, and all that is shown of it was made.
                self._history.take(step)
                self._solve()
                shown = self._shown()
                self.journal.append({**done, "at": now()})
            except BaseException:
                self._history, self._solution, self.rendered = before
                raise
            return {**shown, "actions": len(self.journal.actions)}

    def _follow(self) -> None:
        """Do what another process has done since, if that one writes."""
        new = [] if self.stopped else self.journal.more()
        if new:
            self._take(new)
            self._solve()

    def state(self) -> dict[str, Any]:
        """Return all that changes with the points, as JSON values."""
        with self._lock:
            self._follow()
            return {**self._shown(), "actions": len(self.journal.actions)}


def _plain(action: Mapping[str, Any]) -> dict[str, Any]:
    """Return an action without what the journal says about it."""
    return {key: value for key, value in action.items() if key not in ("at", "image", "source")}


def points_file(output: str | os.PathLike[str]) -> Path:
    """Return the path that measured points are written to.

    Raises
    ------
    InputError
        If it is not named as GeoJSON.
    """
    path = Path(output)
    if path.suffix.lower() != ".geojson":
        raise InputError(
            "measured points are written as GeoJSON", file=path, field="output", remedy="a name with `.geojson`"
        )
    return path


def moved(before: SensorModel, after: SensorModel, ground: Array) -> bool:
    """Tell whether a model puts ground of its CRS ``(N, 3)`` elsewhere than another one, so far that people see it."""
    step = after.ground_to_image(ground) - before.ground_to_image(ground)
    return bool(len(step)) and not np.nanmax(np.abs(step), initial=0.0) <= _MOVED


def now() -> str:
    """Return the time as files have it."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
