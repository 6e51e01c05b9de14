"""A session with one scene: the scene, its reference, the heights and the marks."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ortho_measure.marks import Mark, marks_of
from ortho_measure.places import Geometry, SceneGeometry, Sheet
from ortho_measure.planning import Next, PlanningGrid, measure_next
from ortho_measure.project import Project, moved, now, points_file
from ortho_measure.proposals import proposal_of
from ortho_measure.solution import LiveAdjustment, figures, solve
from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.control.crops import open_by_evidence
from ortho_pipeline.commands.control.matching import open_reference_views
from ortho_pipeline.commands.control.points import read_control, with_heights
from ortho_pipeline.commands.control.search import search_of
from ortho_pipeline.commands.fitting import compare
from ortho_pipeline.commands.heights.opening import open_surface, require_heights
from ortho_pipeline.commands.resolved.opening import on_surface
from ortho_pipeline.commands.resolved.request import OWN_POINTS, Request
from ortho_pipeline.commands.results import Result
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import confined, sha256
from ortho_pipeline.files.json.values import json_position
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.imaging.matching import Reference, SceneView
from ortho_pipeline.imaging.matching.targets import metres_per_pixel
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.options import MatchOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.surface.base import Surface

#: Search radius of a click: this many standard deviations of the prediction, plus the error of a click (px).
_SIGMAS, _HAND = 3.0, 4.0


class Session(Project):
    """Points measured in one scene.

    Parameters
    ----------
    scene : Scene
    places : SceneGeometry
        With the delivered model.
    output : Path
        The GeoJSON of the points; the journal is next to it.
    request : Request
        Options of image and heights, the correction (as for `ortho fit`), and the search distance.
    """

    _solution: LiveAdjustment
    rendered: list[SensorModel]

    def __init__(self, scene: Scene, places: SceneGeometry, output: Path, request: Request) -> None:
        maps = [Sheet(reference, places.surface) for reference in places.references if isinstance(reference, Reference)]
        super().__init__(output, places.surface, [places.view], maps)
        self.scene, self.places = scene, places
        self._request = request
        self.search = search_of(scene, request.match, metres_per_pixel(places.view))
        self.grid = PlanningGrid.over(places)
        self.rendered = [places.model]
        self._solution = LiveAdjustment(scene.model, None)
        self._begin()

    # -- methods of a project ----------------------------------------------------------------------------------------

    def _identity(self) -> dict[str, Any]:
        return {"name": Path(self.scene.path).name, "size": [self.scene.width, self.scene.height]}

    def _source(self) -> dict[str, Any] | None:
        path = self._request.point_file
        if path is None:
            return None
        if os.fspath(path) == OWN_POINTS:
            return {"name": OWN_POINTS}
        return {"name": Path(path).name, "sha256": sha256(path)}

    def _given(self) -> list[Mark] | None:
        if self._request.points.gcps is None:
            return None
        read = read_control(self.scene, self._request)
        return marks_of(with_heights(read, self.places.surface), now())

    def _document(self) -> dict[str, Any]:
        return self.marks.document(self._called)

    def _require_possible(self, marks: Iterable[Mark], correction: str | None) -> None:
        for mark in marks:
            if mark.rays or mark.role == "tie":
                raise InputError(
                    "this point belongs to several images, but there is one", field="rays", remedy="reload the page"
                )

    def _solve(self) -> None:
        marks = self._history.marks
        self._solution = solve(
            self.scene, marks.points(self._called), self._request, self.places.surface, marks.correction
        )
        if moved(self.rendered[-1], self._solution.model, self.grid.everywhere):
            self.rendered = [*self.rendered, self._solution.model]

    @property
    def _called(self) -> str:
        return os.fspath(self.output)

    @property
    def solution(self) -> LiveAdjustment:
        """The adjustment to the present points."""
        return self._solution

    @property
    def version(self) -> int:
        return len(self.rendered) - 1

    def _figures(self) -> dict[str, Any]:
        return {
            "correction": self.marks.correction or self._request.points.correction,
            **figures(self._solution, self.places.surface),
        }

    def _ahead(self) -> list[Next]:
        taken = np.array([mark.image for mark in self.marks.by_id.values() if mark.counts], dtype=float)
        return measure_next(self.grid, self._solution.fit, taken.reshape(-1, 2))

    # -- places ------------------------------------------------------------------------------------------------------

    def places_of(self, number: int) -> SceneGeometry:
        return self.places.by(self._solution.model)

    def at(self, version: int) -> SceneGeometry:
        """Return the geometry used to render the reference."""
        if not 0 <= version < len(self.rendered):
            raise InputError("unknown rendering", field="version", remedy="reload the page")
        return self.places.by(self.rendered[version])

    def _geometries(self, version: int) -> dict[str, Geometry]:
        maps = {f"map-{number}": sheet for number, sheet in enumerate(self.sheets)}
        return {"scene-0": self.places_of(0), "reference-0": self.at(version), **maps}

    def rendering(self, name: str, version: int) -> SceneGeometry | None:
        return self.at(version) if name == "reference-0" else None

    def _sigma(self, ground: Array) -> list[float] | None:
        fit, known = self._solution.fit, self.places_of(0)
        if fit is None or not len(fit.param_names) or not np.isfinite(ground).all():
            return None
        return json_position(fit.image_sigma(known.model.image_to_ground(known.image_of(ground), ground[:, 2]))[0])

    def proposal(self, image: Sequence[float] | None, ground: Sequence[float] | None = None) -> dict[str, Any]:
        """Return a sub-pixel match for a click in the scene: its `image` and `ground`, score and covariance.

        With a ground (clicked in the reference, or entered), its image is searched near the click, or near the
        predicted position. Without one, the ground of the click is searched near its prediction. `reason` states why a
        match is not reliable; it is empty for a reliable one.
        """
        known = self.places_of(0)
        click = None if image is None else np.asarray(image, dtype=float)
        place = None if ground is None else np.asarray(ground, dtype=float)
        about = click if click is not None or place is None else known.image_of(place)[0]
        return proposal_of(known, click, place, self._radius(about))

    def compared(self) -> dict[str, Any]:
        """Return the document of `ortho compare` for the present points."""
        options = PointOptions(gcps=self.marks.points(self._called), significance=self._request.points.significance)
        return compare(self.scene, options).to_json()

    def ortho(self, progress: Progress, number: int = 0) -> Result:
        """Run `ortho rectify` with the saved points, into a folder next to them."""
        from ortho_pipeline.commands.rectification import rectify

        with self._lock:
            self.save()
            correction = self.marks.correction or self._request.points.correction
        # The saved points state their CRS and roles themselves.
        points = replace(
            self._request.points,
            gcps=self.output,
            crs=None,
            vertical=None,
            pixel_origin="corner",
            check=None,
            select=None,
            correction=correction,
        )
        with confined(self.output.parent):
            return rectify(
                self.scene.path,
                self.output.with_name(f"{self.output.stem}_ortho"),
                scene=self._request.scene,
                points=points,
                surface=self._request.surface,
                progress=progress,
            )

    def _radius(self, click: Array | None) -> float:
        """Return the search radius (px) around the prediction of a click."""
        fit = self._solution.fit
        if click is None or fit is None or not len(fit.param_names):
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
    """Open scene, reference and heights, and continue with the points of the journal next to the output.

    Parameters
    ----------
    output : path
        A ``.geojson`` file.

    Raises
    ------
    InputError
        For every mistake that the user can correct.
    """
    path = points_file(output)
    if points.fit_model is not None:
        raise InputError(
            "ortho measure works with the scene's own model",
            field="points.fit_model",
            remedy="leave it out; fit this model later to the saved points",
        )
    require_heights(surface)
    request = Request(image, scene, points, surface, match)
    opened = open_by_evidence(request)
    heights: Surface = open_surface(surface, scene, under=[opened])
    opened = on_surface(opened, heights)
    view, references = open_reference_views(opened, match, heights, scene)
    inputs.check_paths({"points": path}, replace(request, points=PointOptions()))
    places = SceneGeometry(SceneView(view.intensity, opened.model, heights), references)
    return Session(opened, places, path, request)
