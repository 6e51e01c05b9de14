"""A project of measured points: each action is solved, written to the journal, and shown in all geometries."""

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
from ortho_pipeline.files import json_text, parse_json, write_json
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.imaging.matching import SceneView
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.surface.base import Surface

#: Suffix of the journal of a file of points.
JOURNAL = ".journal"
#: Properties of a point that other programs read.
_READ = ("id", "ji", "role", "filename", "sigma_image", "sigma_xy", "sigma_h")
#: Render again if the model moves anything by more than this (px).
_MOVED = 0.2


class _Shown(abc.ABC):
    """What the page shows of a project: its points, their positions in every view, and the figures."""

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
        """The points now."""
        return self._history.marks

    @property
    @abc.abstractmethod
    def version(self) -> int:
        """Version of the models that render the references now."""

    @abc.abstractmethod
    def places_of(self, number: int) -> SceneGeometry:
        """Return the geometry of an image with the present adjustment."""

    @abc.abstractmethod
    def _figures(self) -> dict[str, Any]:
        """Return the figures of the solution, as JSON values."""

    @abc.abstractmethod
    def _ahead(self) -> list[Next]:
        """Return the next places to measure, the best first."""

    def _grounds(self, marks: Sequence[Mark]) -> Array:
        """Return the ground ``(N, 3)`` of marks; NaN if there is none."""
        return np.array([mark.ground or (np.nan,) * 3 for mark in marks], dtype=float).reshape(-1, 3)

    def _shown(self) -> dict[str, Any]:
        """Return the document of `state` without the number of actions."""
        marks, history, version = list(self.marks.by_id.values()), self._history, self.version
        shown, ahead = self._places(version, self._grounds(marks)), self._ahead()
        there = np.full((len(ahead), 3), np.nan)
        for number in {place.number for place in ahead}:
            rows = [k for k, place in enumerate(ahead) if place.number == number]
            there[rows] = self.places_of(number).ground_about(
                [ahead[k].image for k in rows], [ahead[k].height for k in rows]
            )
        documents = [self._written.of(mark) for mark in marks]
        return {
            "marks": [{**mark, "places": places} for mark, places in zip(documents, shown, strict=True)],
            "version": version,
            "undo": history.can_undo,
            "redo": history.can_redo,
            **self._figures(),
            "next": [
                {**json_value(place), "places": places}
                for place, places in zip(ahead, self._places(version, there), strict=True)
            ],
        }

    # -- places ------------------------------------------------------------------------------------------------------

    def _places(self, version: int, ground: Array) -> list[dict[str, list[float] | None]]:
        """Return the positions of each ground ``(N, 3)`` in all geometries; null if it is outside."""
        positions = {name: geometry.image_of(ground) for name, geometry in self._geometries(version).items()}
        return [{name: json_position(places[k]) for name, places in positions.items()} for k in range(len(ground))]

    def _geometry(self, name: str, version: int) -> Geometry:
        known = self._geometries(version)
        if name not in known:
            raise InputError("unknown view", field="at")
        return known[name]

    def predict(
        self,
        version: int,
        at: str | None = None,
        place: Sequence[float] | None = None,
        ground: Sequence[float] | None = None,
    ) -> dict[str, Any]:
        """Return the positions of a place of one geometry, or of ground, in all geometries.

        Parameters
        ----------
        at : str, optional
            The geometry of `place`.
        ground : (lon, lat, h), optional
            In `GROUND_CRS`.

        Returns
        -------
        dict
            `ground`; `places` by geometry, px; `sigma` of the prediction in the first image; null if unknown.
        """
        with self._lock:
            if ground is not None:
                positions = np.array([ground], dtype=float)
            else:
                positions = self._geometry(str(at), version).ground_of(np.array([place], dtype=float))
            return {
                "ground": json_position(positions[0]),
                "places": self._places(version, positions)[0],
                "sigma": self._sigma(positions),
            }

    @abc.abstractmethod
    def _sigma(self, ground: Array) -> list[float] | None:
        """Return the standard deviations (px) of the predicted image of ground ``(1, 3)``, if known."""

    def link(self, version: int, at: str, place: Sequence[float], to: str) -> dict[str, Any]:
        """Return the relation of two geometries at a place, as `places.linked`."""
        with self._lock:
            return linked(self._geometry(at, version), self._geometry(to, version), place)

    def typed(self, values: Sequence[float | None], crs: str, vertical: str | None) -> list[float]:
        """Return entered coordinates as ground in `GROUND_CRS`."""
        return ground_typed(values, crs or GROUND_CRS, vertical, self.surface).tolist()


class Project(_Shown):
    """Measured points with their journal.

    Geometries have names: ``scene-K`` is image K with the present adjustment, ``reference-K`` is the reference rendered
    into its pixels by a version of the model, ``map-R`` is reference R in its own pixels.

    Parameters
    ----------
    output : Path
        The GeoJSON of the points; the journal is next to it.
    surface : Surface
        The heights.
    views : sequence of SceneView
        The images.
    sheets : sequence of Sheet
        The references as maps.

    Attributes
    ----------
    stopped : str
        Message about an impossible action of the journal, if any; only the actions before it are loaded.
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

    # -- one image or several ----------------------------------------------------------------------------------------

    @abc.abstractmethod
    def _identity(self) -> dict[str, Any]:
        """Return the identity of the images of a journal."""

    @abc.abstractmethod
    def _source(self) -> dict[str, Any] | None:
        """Return the identity of the file of points at the start; None without one."""

    @abc.abstractmethod
    def _given(self) -> list[Mark] | None:
        """Return the points at the start; None if none were given."""

    @abc.abstractmethod
    def _require_possible(self, marks: Iterable[Mark], correction: str | None) -> None:
        """Raise an error for marks or a correction that these images cannot have.

        Raises
        ------
        InputError
        """

    @abc.abstractmethod
    def _solve(self) -> None:
        """Adjust to the present points."""

    @abc.abstractmethod
    def _geometries(self, version: int) -> Mapping[str, Geometry]:
        """Return all geometries by their names."""

    @abc.abstractmethod
    def rendering(self, name: str, version: int) -> SceneGeometry | None:
        """Return the geometry from which a view is rendered; None if it is the raster itself.

        Raises
        ------
        InputError
            If the version is unknown.
        """

    @abc.abstractmethod
    def _document(self) -> dict[str, Any]:
        """Return the GeoJSON of the points."""

    @abc.abstractmethod
    def compared(self) -> dict[str, Any]:
        """Return a comparison of models or corrections on the points, with a recommendation."""

    @abc.abstractmethod
    def ortho(self, progress: Progress, number: int = 0) -> Result:
        """Make the ortho of an image with the saved points, in a folder next to them."""

    # -- opening and closing -----------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Repeat the actions of the journal; a new journal starts with the given points."""
        try:
            source = self._source()
            if not self.journal.actions:
                if not self.journal.read_only:
                    self.journal.append(self._first())
            elif self.journal.actions[0].get("image") != self._identity():
                raise InputError(
                    "this journal belongs to another image",
                    file=self.journal.path,
                    field="output",
                    remedy="choose another output, or move the journal away",
                )
            elif source is not None and source != self.journal.actions[0].get("source"):
                raise InputError(
                    "the journal of this output started with other points",
                    file=self.journal.path,
                    field="points.gcps",
                    remedy=Text("leave out ", Setting("points.gcps"), " to continue, or choose another output"),
                )
            with completed(self.journal.path, remedy=JOURNAL_REMEDY):
                count = self._take(self.journal.actions)
            if self.stopped:
                self.journal.set_aside(count)
            elif not self.journal.read_only:
                self._require_own_file()
        except BaseException:
            self.journal.close()
            raise
        self._solve()

    def _require_own_file(self) -> None:
        """Raise an error if another program changed the file of points: it would be overwritten."""
        try:
            changed, written = (os.stat(path).st_mtime_ns for path in (self.output, self.journal.path))
        except FileNotFoundError:
            return
        # After a kill, the file can be older than the journal, but not newer.
        if changed > written and _points_of(self.output.read_bytes()) != _points_of(json_text(self._document())):
            raise InputError(
                "another program changed these points, and their journal has others",
                file=self.output,
                field="output",
                remedy=Text(
                    "to continue with this file, give it as ",
                    Setting("points.gcps"),
                    " with another output; to continue with the journal, move this file away",
                ),
            )

    def _take(self, actions: Sequence[Mapping[str, Any]]) -> int:
        """Apply actions of the journal until one is impossible; return the number of applied ones."""
        for number, action in enumerate(actions):
            try:
                self._history.take(self._step(_plain(action)))
            except InputError as error:
                if action.get("do") == "begin":
                    raise
                line = len(self.journal.actions) - len(actions) + number + 1
                self.stopped = f"action {line} of the journal cannot be repeated ({error.message})"
                return number
        return len(actions)

    def _step(self, action: Mapping[str, Any]) -> Marks | int:
        """Return the result of an action, as `History.after`, after checking that these images can have it."""
        step, known = self._history.after(action), self.marks.by_id
        if isinstance(step, Marks):
            changed = (mark for name, mark in step.by_id.items() if known.get(name) is not mark)
            self._require_possible(changed, step.correction)
        return step

    def _first(self) -> dict[str, Any]:
        """Return the first action of a journal."""
        marks = self._given()
        if marks is None and self.output.exists():
            raise InputError(
                "this file already exists and was not made by ortho measure",
                file=self.output,
                field="output",
                remedy=Text(
                    "give it as ", Setting("points.gcps"), " to continue with its points, or choose another output"
                ),
            )
        return {
            "do": "begin",
            "marks": [mark.to_json() for mark in marks or ()],
            "source": self._source(),
            "image": self._identity(),
            "at": now(),
        }

    def save(self) -> None:
        """Write the GeoJSON, unless it already has all actions."""
        with self._lock:
            is_saved = self._saved == len(self.journal.actions) and self.output.exists()
            if self.journal.read_only or is_saved:
                return
            document, count = self._document(), len(self.journal.actions)
            write_json(self.output, document)
            self._saved = count

    def close(self) -> None:
        """Save, and close the journal."""
        self.save()
        self.journal.close()

    # -- actions -----------------------------------------------------------------------------------------------------

    def act(self, action: Mapping[str, Any]) -> dict[str, Any]:
        """Apply an action and return the new state.

        Raises
        ------
        InputError
            If it is not possible or cannot be written; then nothing has changed.
        """
        with self._lock:
            if action.get("do") == "begin":
                raise InputError("unknown action", field="do")
            done = (
                {**action, "mark": {**action["mark"], "at": now()}} if isinstance(action.get("mark"), dict) else action
            )
            step = self._step(done)
            before = self._history, self._solution, self.rendered
            self._history = copy.copy(self._history)
            try:
                # Write to the journal last, so that only actions that can be solved and shown are in it.
                self._history.take(step)
                self._solve()
                shown = self._shown()
                self.journal.append({**done, "at": now()})
            except BaseException:
                self._history, self._solution, self.rendered = before
                raise
            return {**shown, "actions": len(self.journal.actions)}

    def _follow(self) -> None:
        """Apply what another process has written since."""
        new = [] if self.stopped else self.journal.more()
        if new:
            self._take(new)
            self._solve()

    def state(self) -> dict[str, Any]:
        """Return everything that depends on the points, as JSON values."""
        with self._lock:
            self._follow()
            return {**self._shown(), "actions": len(self.journal.actions)}


def _plain(action: Mapping[str, Any]) -> dict[str, Any]:
    """Return an action without the fields of the journal."""
    return {key: value for key, value in action.items() if key not in ("at", "image", "source")}


def _points_of(text: bytes | str) -> object:
    """Return what other programs read of a file of points; None if it is no such file."""
    try:
        return [
            (feature["geometry"] and feature["geometry"]["coordinates"], *map(feature["properties"].get, _READ))
            for feature in parse_json(text, "points", JOURNAL_REMEDY)["features"]
        ]
    except (InputError, LookupError, TypeError, AttributeError):
        return None


def points_file(output: str | os.PathLike[str]) -> Path:
    """Return the path for measured points.

    Raises
    ------
    InputError
        If its name is not that of GeoJSON.
    """
    path = Path(output)
    if path.suffix.lower() != ".geojson":
        raise InputError(
            "measured points are written as GeoJSON", file=path, field="output", remedy="use a name with .geojson"
        )
    return path


def moved(before: SensorModel, after: SensorModel, ground: Array) -> bool:
    """Return whether two models project ground of their CRS ``(N, 3)`` visibly apart."""
    step = after.ground_to_image(ground) - before.ground_to_image(ground)
    return bool(len(step)) and not np.nanmax(np.abs(step), initial=0.0) <= _MOVED


def now() -> str:
    """Return the present time in the format of the files."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
