"""A session: scene, reference, heights and marks together; every action is journaled, then solved, then shown."""

from __future__ import annotations

import datetime
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.control.matching import open_reference_views, search_of
from ortho_pipeline.commands.control.points import read_control, with_heights
from ortho_pipeline.commands.fitting import compare
from ortho_pipeline.commands.heights.surfaces import open_surface, require_heights
from ortho_pipeline.commands.results import Result
from ortho_pipeline.commands.scene_fit import on_surface
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import sha256, write_json
from ortho_pipeline.files.documents import json_position, json_value
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.imaging.matching import View
from ortho_pipeline.imaging.matching.targets import metres_per_pixel
from ortho_pipeline.measure.journal import Journal
from ortho_pipeline.measure.marks import GROUND_CRS, History, Marks, marks_of
from ortho_pipeline.measure.places import Places, ground_typed
from ortho_pipeline.measure.planning import Grid, measure_next
from ortho_pipeline.measure.proposals import NEAR, propose
from ortho_pipeline.measure.solution import Solution, figures, solve
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.surface.base import Surface

#: What is appended to the name of the points for their journal.
JOURNAL = ".journal"
#: The reference is rendered anew where the model moves it by more than this (px).
_MOVED = 0.2
#: A click is looked for within this many standard deviations of the prediction, and the pixels of a hand.
_SIGMAS, _HAND = 3.0, 4.0


class Session:
    """Points that are measured in one scene.

    Parameters
    ----------
    scene : Scene
    places : Places
        By the model as delivered.
    output : Path
        The GeoJSON of the points; its journal lies beside it.
    options : PointOptions
        What is adjusted, as for `ortho fit`.
    opened : SceneOptions
    match : MatchOptions
        How far the model may be off.
    surface : SurfaceOptions
        The heights, as `ortho` opens them.
    """

    def __init__(
        self, scene: Scene, places: Places, output: Path, options: PointOptions,
        opened: SceneOptions = SceneOptions(), match: MatchOptions = MatchOptions(),
        surface: SurfaceOptions = SurfaceOptions(),
    ) -> None:  # fmt: skip
        self.scene, self.places, self.output = scene, places, output
        self._options, self._opened, self._surface = options, opened, surface
        self.search = search_of(scene, match, metres_per_pixel(places.view))
        self.grid = Grid.over(places)
        self.rendered: list[SensorModel] = [places.model]
        self._lock = threading.RLock()
        self._saved = -1
        self.journal = Journal(output.with_name(output.name + JOURNAL))
        self._history = History()
        self._solution = Solution(scene.model, None)
        self._begin()

    # -- beginning and end -------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Do again what the journal holds; a new one begins with the points that were given."""
        try:
            if not self.journal.actions:
                if not self.journal.read_only:
                    self.journal.append(self._first())
            elif self.journal.actions[0].get("image") != self._identity():
                raise InputError("this journal is of another image", file=self.journal.path, field="output",
                                 remedy="choose another output, or move the journal away")  # fmt: skip
            elif self._options.gcps is not None and self._source() != self.journal.actions[0].get("source"):
                raise InputError(
                    "there is a journal of these points, which began with others", file=self.journal.path,
                    field="points.gcps", remedy="leave out `points.gcps` to go on, or choose another output",
                )  # fmt: skip
            for action in self.journal.actions:
                self._history.take(self._history.after(_plain(action)))
        except BaseException:
            self.journal.close()
            raise
        self._solve()

    def _first(self) -> dict[str, Any]:
        """Return the action that a journal begins with."""
        marks = []
        if self._options.gcps is None and self.output.exists():
            raise InputError("there are points here, and no journal of them", file=self.output, field="output",
                             remedy="give them as `points.gcps` to go on, or choose another output")  # fmt: skip
        if self._options.gcps is not None:
            read = read_control(self.scene, replace(self._options, correction=None), self._opened)
            marks = marks_of(with_heights(read, self.places.surface), _now())
        return {"do": "begin", "marks": [json_value(mark) for mark in marks], "source": self._source(),
                "image": self._identity(), "at": _now()}  # fmt: skip

    def _source(self) -> dict[str, Any] | None:
        path = inputs.point_file(self._options)
        if path is None:
            return None
        if os.fspath(path) == inputs.OWN_POINTS:
            return {"name": inputs.OWN_POINTS}
        return {"name": Path(path).name, "sha256": sha256(path)}

    def _identity(self) -> dict[str, Any]:
        return {"name": Path(self.scene.path).name, "size": [self.scene.width, self.scene.height]}

    def save(self) -> None:
        """Write the GeoJSON, whole, unless it holds all actions already."""
        with self._lock:
            if self.journal.read_only or self._saved == len(self.journal.actions):
                return
            document, count = self._history.marks.document(self._called), len(self.journal.actions)
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
                {**action, "mark": {**action["mark"], "at": _now()}} if isinstance(action.get("mark"), dict) else action
            )
            step = self._history.after(done)
            self.journal.append({**done, "at": _now()})
            self._history.take(step)
            self._solve()
            return self.state()

    def _solve(self) -> None:
        marks = self._history.marks
        self._solution = solve(
            self.scene, marks.points(self._called), self._options, self._opened, self.places.surface, marks.correction
        )  # fmt: skip
        before, now = (one.ground_to_image(self.grid.everywhere) for one in (self.rendered[-1], self._solution.model))
        if len(now) and not np.nanmax(np.abs(now - before), initial=0.0) <= _MOVED:
            self.rendered.append(self._solution.model)

    @property
    def _called(self) -> str:
        return os.fspath(self.output)

    @property
    def solution(self) -> Solution:
        """The adjustment to the points as they are now."""
        return self._solution

    @property
    def marks(self) -> Marks:
        """The points as they are now."""
        return self._history.marks

    def state(self) -> dict[str, Any]:
        """Return all that changes with the points, as JSON values."""
        with self._lock:
            marks, history = list(self._history.marks.by_id.values()), self._history
            version = len(self.rendered) - 1
            shown = self.at(version).image_of(np.array(
                [mark.ground or (np.nan,) * 3 for mark in marks], dtype=float).reshape(-1, 3))  # fmt: skip
            taken = np.array([mark.image for mark in marks if mark.counts], dtype=float).reshape(-1, 2)
            ahead = measure_next(self.grid, self._solution.fit, taken)
            return {
                "marks": [
                    {**json_value(mark), "shown": json_position(place)}
                    for mark, place in zip(marks, shown, strict=True)
                ],
                "correction": history.marks.correction or self._options.correction, "version": version,
                "undo": history.can_undo, "redo": history.can_redo, "actions": len(self.journal.actions),
                "next": json_value(ahead),
                **figures(self._solution, self.places.surface),
            }  # fmt: skip

    # -- places ------------------------------------------------------------------------------------------------------

    def at(self, version: int) -> Places:
        """Return the geometry that the reference was rendered with."""
        if not 0 <= version < len(self.rendered):
            raise InputError("there is no such rendering", field="version")
        return self.places.by(self.rendered[version])

    def predict(self, version: int, *, scene: Sequence[float] | None = None, shown: Sequence[float] | None = None,
                ground: Sequence[float] | None = None) -> dict[str, Any]:  # fmt: skip
        """Return where a place of the scene, of the rendered reference, or of the ground lies in all of them.

        In the document `ground` is in `GROUND_CRS`, `scene` in px by the adjusted model with its standard deviations
        `sigma`, `shown` in px of the rendering; null is what cannot be said.
        """
        rendered, now = self.at(version), self.places.by(self._solution.model)
        if ground is None:
            place = now.ground_of(np.array([scene])) if scene is not None else rendered.ground_of(np.array([shown]))
        else:
            place = np.array([ground], dtype=float)
        image = now.image_of(place)
        sigma, fit = None, self._solution.fit
        if fit is not None and len(fit.param_names) and np.isfinite(place).all():
            sigma = json_position(fit.image_sigma(now.model.image_to_ground(image, place[:, 2]))[0])
        return {
            "ground": json_position(place[0]), "scene": json_position(image[0]), "sigma": sigma,
            "shown": json_position(rendered.image_of(place)[0]),
        }  # fmt: skip

    def typed(self, values: Sequence[float | None], crs: str, vertical: str | None) -> list[float]:
        """Return typed coordinates as ground in `GROUND_CRS`."""
        return ground_typed(values, crs or GROUND_CRS, vertical, self.places.surface).tolist()

    def proposal(self, image: Sequence[float], ground: Sequence[float] | None = None) -> dict[str, Any]:
        """Return a sub-pixel match for a click in the scene: its `image` and `ground`, score and covariance.

        With a ground (clicked in the reference, or typed) its image is looked for about the click; without one, the
        ground of the click where the model, as well as it is known, puts it. `reason` says why a match is not to be
        believed, and is empty if it is.
        """
        now, click = self.places.by(self._solution.model), np.asarray(image, dtype=float)
        if ground is not None:
            local = now.moved(click - now.image_of([ground])[0])
            found = propose(local, click.tolist(), NEAR)
            place, place_on_ground = click - found.shift, np.asarray(ground, dtype=float)
        else:
            found = propose(now, click.tolist(), self._radius(click))
            place = click
            place_on_ground = (
                now.ground_of([click + found.shift])[0] if np.isfinite(found.shift).all() else np.full(3, np.nan)
            )
        reason = found.reason or ("" if np.isfinite(place_on_ground).all() else "the heights do not reach here")
        (column, both), (_, row) = found.covariance
        return json_value({
            "image": json_position(place), "ground": json_position(place_on_ground), "score": found.score,
            "covariance": json_position([column, row, both]), "scattered": found.scattered, "reason": reason,
        })  # fmt: skip

    def compared(self) -> dict[str, Any]:
        """Return the document of `ortho compare` for the points as they are now."""
        asked = PointOptions(gcps=self.marks.points(self._called), significance=self._options.significance)
        return compare(self.scene, asked).to_json()

    def ortho(self, progress: Callable[[float], None]) -> Result:
        """Make what `ortho rectify` makes with the saved points, in a folder beside them."""
        from ortho_pipeline.commands.rectification import rectify

        with self._lock:
            self.save()
            correction = self.marks.correction or self._options.correction
        # The saved points say themselves where they are and which of them check.
        points = replace(
            self._options, gcps=self.output, crs=None, vertical=None, pixel_origin="corner", check=None, select=None,
            correction=correction,
        )  # fmt: skip
        return rectify(
            self.scene.path, self.output.with_name(f"{self.output.stem}_ortho"), scene=self._opened, points=points,
            surface=self._surface, progress=progress,
        )  # fmt: skip

    def _radius(self, click: np.ndarray) -> float:
        """Return within how many px of the prediction a click is looked for."""
        fit = self._solution.fit
        if fit is None or not len(fit.param_names):
            return self.search.distance / metres_per_pixel(self.places.view)
        nearest = self.grid.ground[[np.argmin(((self.grid.image - click) ** 2).sum(axis=1))]]
        return float(_SIGMAS * np.linalg.norm(fit.image_sigma(nearest)) + _HAND)


def open_session(
    image: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
) -> Session:
    """Open scene, reference and heights, and go on with the points that a journal beside the output has.

    Parameters
    ----------
    output : path
        A ``.geojson`` file.

    Raises
    ------
    InputError
        For whatever the user can correct.
    """
    path = Path(output)
    if path.suffix.lower() != ".geojson":
        raise InputError("measured points are written as GeoJSON", file=path, field="output",
                         remedy="a name with `.geojson`")  # fmt: skip
    if points.fit_model is not None:
        raise InputError("the reference is shown by the scene's own model", field="points.fit_model",
                         remedy="leave it out, and fit the model to the saved points")  # fmt: skip
    require_heights(surface)
    opened = inputs.open_scene(image, scene)
    heights: Surface = open_surface(surface, scene, under=[opened])
    opened = on_surface(opened, heights)
    view, references = open_reference_views(opened, match, heights, scene)
    inputs.check_paths({"points": path}, image, scene, PointOptions(), surface, match)
    places = Places(View(view.intensity, opened.model, heights), references)
    return Session(opened, places, path, points, scene, match, surface)


def _plain(action: Mapping[str, Any]) -> dict[str, Any]:
    """Return an action without what the journal says about it."""
    return {key: value for key, value in action.items() if key not in ("at", "image", "source")}


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
