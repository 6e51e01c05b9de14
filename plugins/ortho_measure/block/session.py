"""A session of several images: a stereo pair or a block, with or without a reference."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ortho_measure.block.comparison import compare_corrections
from ortho_measure.block.planning import BlockGrid, next_of_block
from ortho_measure.block.proposals import TieSearch
from ortho_measure.block.solution import BlockSolution, figures, solve
from ortho_measure.block.table import block_points, document, marks_of_block
from ortho_measure.marks import GROUND_CRS, Mark
from ortho_measure.places import Geometry, SceneGeometry, Sheet
from ortho_measure.planning import Next
from ortho_measure.project import Project, moved, now, points_file
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.start import Start
from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.block_images import labels_of, scenes_of, start_of
from ortho_pipeline.commands.control.block_points import observed, read_points, settled_scenes
from ortho_pipeline.commands.control.search import search_of
from ortho_pipeline.commands.control.ties import DEM_SIGMA, FLAT_SIGMA, names_of
from ortho_pipeline.commands.heights.opening import open_surface, require_heights
from ortho_pipeline.commands.resolved.opening import on_surface
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.results import Result
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import confined, sha256
from ortho_pipeline.geodesy.crs import horizontal, parse_crs
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.imaging.matching import Reference, SceneView, open_references
from ortho_pipeline.imaging.matching.targets import metres_per_pixel
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.options import CORRECTIONS, BlockOptions, MatchOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.runtime.process_limits import Progress
from ortho_pipeline.surface.accuracy import typical_sigma

#: Search radius of a click (px), once there is an adjustment.
_HAND = 6.0


@dataclass(frozen=True, eq=False)
class BlockImages:
    """The images of a session: paths, labels, names in files, scenes, and geometries with the delivered models."""

    paths: tuple[str, ...]
    labels: tuple[str, ...]
    names: tuple[str, ...]
    scenes: tuple[Scene, ...]
    places: tuple[SceneGeometry, ...]


class BlockSession(Project):
    """Points measured in several images.

    Parameters
    ----------
    images : BlockImages
    references : tuple of Reference
        May be empty.
    output : Path
        The GeoJSON of the points; the journal is next to it.
    options : BlockOptions
        Options of the adjustment, as for `ortho adjust`; `points` are the first points.
    """

    _solution: BlockSolution
    rendered: list[tuple[SensorModel, ...]]

    def __init__(
        self,
        images: BlockImages,
        references: tuple[Reference, ...],
        output: Path,
        options: BlockOptions,
        opened: Sequence[SceneOptions] = (),
        match: MatchOptions = MatchOptions(),
        heights: SurfaceOptions = SurfaceOptions(),
    ) -> None:
        surface = images.places[0].surface
        maps = [Sheet(reference, surface) for reference in references]
        super().__init__(output, surface, [geometry.view for geometry in images.places], maps)
        self.images, self._options, self._heights = images, options, heights
        self._opened = list(opened) or [SceneOptions()] * len(images.paths)
        self._starts: dict[str | None, dict[str, Start]] = {}
        self._search = [
            search_of(scene, match, metres_per_pixel(geometry.view)).distance / metres_per_pixel(geometry.view)
            for scene, geometry in zip(images.scenes, images.places, strict=True)
        ]
        usual = FLAT_SIGMA if surface.provenance.get("constant_height") is not None else DEM_SIGMA
        stated = typical_sigma(surface)
        self._sigma_height = usual if stated is None else stated
        self.grid = BlockGrid.over(images.places, references)
        self._everywhere = [self._spread(geometry) for geometry in images.places]
        self.rendered = [tuple(geometry.model for geometry in images.places)]
        self._solution = BlockSolution(dict(zip(images.labels, self.rendered[0], strict=True)))
        self._begin()

    @staticmethod
    def _spread(places: SceneGeometry) -> Array:
        """Return ground in the CRS of the model, spread over an image."""
        width, height = places.view.size
        columns, rows = np.meshgrid(np.linspace(0, width, 5), np.linspace(0, height, 5))
        image = np.column_stack([columns.ravel(), rows.ravel()])
        return places.model.image_to_ground(image, np.full(len(image), places.model.reference_height))

    # -- methods of a project ----------------------------------------------------------------------------------------

    def _identity(self) -> dict[str, Any]:
        return {
            "images": [
                {"name": name, "size": list(view.size)}
                for name, view in zip(self.images.names, self.views, strict=True)
            ]
        }

    def _source(self) -> dict[str, Any] | None:
        path = self._options.points
        return None if path is None else {"name": Path(path).name, "sha256": sha256(path)}

    def _given(self) -> list[Mark] | None:
        if self._options.points is None:
            return None
        images = self.images
        table, _ = read_points(images.paths, images.labels, self._options, self._opened[0].allow_network, whole=False)
        return marks_of_block(table, now())

    def _document(self) -> dict[str, Any]:
        return document(self.marks, dict(zip(self.images.labels, self.images.names, strict=True)), self._called)

    @property
    def _called(self) -> str:
        return os.fspath(self.output)

    def starts(self, correction: str | None) -> Mapping[str, Start]:
        """Return the start of the adjustment with a correction, as in `ortho adjust`.

        Raises
        ------
        InputError
            If a model cannot have this correction.
        """
        if correction not in self._starts:
            options = replace(self._options, points=None, correction=correction or self._options.correction)
            self._starts[correction] = {
                label: start_of(path, options, opened, _nothing(), None)
                for label, path, opened in zip(self.images.labels, self.images.paths, self._opened, strict=True)
            }
        return self._starts[correction]

    def _require_possible(self, marks: Iterable[Mark], correction: str | None) -> None:
        for mark in marks:
            if mark.image is not None or not set(mark.rays) <= set(self.images.labels):
                raise InputError("unknown image", field="rays", remedy="reload the page")
        self.starts(correction)

    @property
    def _observed(self) -> DemHeights | None:
        """The heights of the DEM as observations; None of flat ground."""
        return observed(self._options, self._heights, self.images.places[0].surface)

    def _solve(self) -> None:
        table = block_points(self.marks, self.images.labels, self._called)
        starts = self.starts(self.marks.correction)
        self._solution = solve(starts, table, self._options.hold, heights=self._observed)
        if self._solution.fit is None:
            # Use the opened models, which know the heights below the scene.
            delivered = dict(zip(self.images.labels, self.rendered[0], strict=True))
            self._solution = replace(self._solution, models=delivered)
        models = tuple(self._solution.models[label] for label in self.images.labels)
        if any(moved(*three) for three in zip(self.rendered[-1], models, self._everywhere, strict=True)):
            self.rendered = [*self.rendered, models]

    @property
    def solution(self) -> BlockSolution:
        """The adjustment to the present points."""
        return self._solution

    @property
    def version(self) -> int:
        return len(self.rendered) - 1

    def _figures(self) -> dict[str, Any]:
        relative = any(
            mark.ground_from == "reference" and mark.role != "tie" and mark.counts for mark in self.marks.by_id.values()
        )
        return {"correction": self.marks.correction, **figures(self._solution, relative)}

    def _ahead(self) -> list[Next]:
        taken = self._grounds([mark for mark in self.marks.by_id.values() if mark.counts])
        return next_of_block(self.grid, self._solution.fit, taken, tie=not self.sheets)

    def _grounds(self, marks: Sequence[Mark]) -> Array:
        """Return the ground of marks: known, adjusted (ties), or on the surface (a single ray)."""
        ground, fit = super()._grounds(marks), self._solution.fit
        adjusted = {} if fit is None else dict(zip(fit.points.ids, fit.ground, strict=True))
        for k, mark in enumerate(marks):
            if mark.ground is not None and mark.role != "tie":
                continue
            ground[k] = adjusted.get(mark.id, np.full(3, np.nan))
            if not np.isfinite(ground[k]).all() and mark.rays:
                label, ray = next(iter(mark.rays.items()))
                ground[k] = self.places_of(self.images.labels.index(label)).ground_of([ray.image])[0]
        return ground

    def _sigma(self, ground: Array) -> list[float] | None:
        return None

    # -- places ------------------------------------------------------------------------------------------------------

    def places_of(self, number: int) -> SceneGeometry:
        return self.images.places[number].by(self._solution.models[self.images.labels[number]])

    def at(self, version: int, number: int = 0) -> SceneGeometry:
        """Return the geometry used to render the references for an image."""
        if not 0 <= version < len(self.rendered):
            raise InputError("unknown rendering", field="version", remedy="reload the page")
        return self.images.places[number].by(self.rendered[version][number])

    def _geometries(self, version: int) -> dict[str, Geometry]:
        geometries: dict[str, Geometry] = {}
        for number in range(len(self.images.labels)):
            geometries[f"scene-{number}"] = self.places_of(number)
            geometries[f"reference-{number}"] = self.at(version, number)
        return geometries | {f"map-{number}": sheet for number, sheet in enumerate(self.sheets)}

    def rendering(self, name: str, version: int) -> SceneGeometry | None:
        kind, number = name.split("-")
        return self.at(version, int(number)) if kind == "reference" else None

    # -- proposals ---------------------------------------------------------------------------------------------------

    @property
    def _search_of_clicks(self) -> TieSearch:
        models, fitted = self._solution.models, self._solution.fit is not None
        places = tuple(self.places_of(number) for number in range(len(models)))
        reaches = tuple([_HAND] * len(models) if fitted else self._search)
        return TieSearch(places, self.images.labels, reaches, self._sigma_height, bool(self.sheets))

    def proposal(self, number: int, image: Sequence[float], known: Mapping[str, Sequence[float]]) -> dict[str, Any]:
        """Return matches of a click in an image, as `TieSearch.of_click`."""
        return self._search_of_clicks.of_click(number, image, known)

    def of_ground(self, ground: Sequence[float]) -> dict[str, Any]:
        """Return matches of a ground position in all images, as `TieSearch.of_ground`."""
        return self._search_of_clicks.of_ground(ground)

    # -- results -----------------------------------------------------------------------------------------------------

    def _asked(self) -> BlockOptions:
        """Return the options of `ortho adjust` for the same adjustment with the saved points."""
        return replace(
            self._options,
            points=self.output,
            crs=None,
            vertical=None,
            pixel_origin="corner",
            check=None,
            correction=self.marks.correction or self._options.correction,
        )

    def compared(self) -> dict[str, Any]:
        """Return a comparison of the corrections on the present points."""
        with self._lock:
            table = block_points(self.marks, self.images.labels, self._called)
        return compare_corrections(self.starts, CORRECTIONS, table, self._options.hold, self._observed)

    def ortho(self, progress: Progress, number: int = 0) -> Result:
        """Run `ortho adjust` with the saved points, and `ortho rectify` for an image with its adjusted model."""
        from ortho_pipeline.commands.block import adjust
        from ortho_pipeline.commands.rectification import rectify

        with self._lock:
            self.save()
            options = self._asked()
        label, folder = self.images.labels[number], self.output.with_name(f"{self.output.stem}_ortho")
        path, own = self.images.paths[number], self._opened[number]
        with confined(self.output.parent):
            surface = self._heights if self._observed is not None else SurfaceOptions()
            block = adjust(self.images.paths, folder / "block", options, self._opened, surface=surface)
            opened = SceneOptions(model=block.files[f"{label} model"], allow_network=own.allow_network, roots=own.roots)
            return rectify(path, folder / label, scene=opened, surface=self._heights, progress=progress)


def _nothing() -> Points:
    """Return a table without points."""
    none = np.zeros(0)
    return Points(
        (),
        none.reshape(0, 2),
        none.reshape(0, 3),
        none.astype("<U7"),
        none,
        none.reshape(0, 3),
        horizontal(parse_crs(GROUND_CRS)),
        "",
    )


def open_block_session(
    images: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    scene: SceneOptions | Sequence[SceneOptions] = SceneOptions(),
    points: BlockOptions = BlockOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
) -> BlockSession:
    """Open images, heights and references, and continue with the points of the journal next to the output.

    Parameters
    ----------
    output : path
        A ``.geojson`` file.
    scene : SceneOptions or sequence of SceneOptions
        Options of all images, or of each.

    Raises
    ------
    InputError
        For every mistake that the user can correct.
    """
    path = points_file(output)
    require_heights(surface)
    labels, names = labels_of(images), names_of(images)
    given = scenes_of(images, scene)
    for image, own in zip(images, given, strict=True):
        inputs.check_paths({"points": path}, Request(image, own, surface=surface, match=match))
    given, _ = settled_scenes(images, labels, given, points, surface)
    alone = [inputs.open_scene(image, own) for image, own in zip(images, given, strict=True)]
    access = given[0].access
    heights = open_surface(surface, given[0], under=alone)
    scenes = tuple(on_surface(one, heights) for one in alone)
    bands = match.reference_bands or ()
    references = open_references(match.reference, bands, **access) if match.reference else ()
    places = tuple(
        SceneGeometry(
            SceneView(Intensity(RasterSource(*(one.rasters or (one.path,)), **access)), one.model, heights), references
        )
        for one in scenes
    )
    known = BlockImages(tuple(os.fspath(image) for image in images), tuple(labels), tuple(names), scenes, places)
    return BlockSession(known, references, path, points, given, match, surface)
