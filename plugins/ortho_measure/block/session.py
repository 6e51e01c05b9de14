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
from ortho_pipeline.commands.control.matching import search_of
from ortho_pipeline.commands.control.ties import DEM_SIGMA, FLAT_SIGMA, names_of
from ortho_pipeline.commands.heights.surfaces import open_surface, require_heights
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolving import on_surface
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

#: What a click may be off in any case (px), once there is an adjustment.
_HAND = 6.0


@dataclass(frozen=True, eq=False)
class BlockImages:
    """The images of a session: their paths, labels, names in files, scenes, and places by the models as delivered."""

    paths: tuple[str, ...]
    labels: tuple[str, ...]
    names: tuple[str, ...]
    scenes: tuple[Scene, ...]
    places: tuple[SceneGeometry, ...]


class BlockSession(Project):
    """Points that are measured in several images.

    Parameters
    ----------
    images : BlockImages
    references : tuple of Reference
        None or more.
    output : Path
        The GeoJSON of the points; its journal lies beside it.
    options : BlockOptions
        What is adjusted, as for `ortho adjust`; `points` is what it begins with.
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
        maps = [Sheet(one, surface) for one in references]
        super().__init__(output, surface, [one.view for one in images.places], maps)
        self.images, self._options, self._heights = images, options, heights
        self._opened = list(opened) or [SceneOptions()] * len(images.paths)
        self._starts: dict[str | None, dict[str, Start]] = {}
        self._search = [
            search_of(scene, match, metres_per_pixel(one.view)).distance / metres_per_pixel(one.view)
            for scene, one in zip(images.scenes, images.places, strict=True)
        ]
        usual = FLAT_SIGMA if surface.provenance.get("constant_height") is not None else DEM_SIGMA
        stated = typical_sigma(surface)
        self._sigma_height = usual if stated is None else stated
        self.grid = BlockGrid.over(images.places, references)
        self._everywhere = [self._spread(one) for one in images.places]
        self.rendered = [tuple(one.model for one in images.places)]
        self._solution = BlockSolution(dict(zip(images.labels, self.rendered[0], strict=True)))
        self._begin()

    @staticmethod
    def _spread(places: SceneGeometry) -> Array:
        """Return ground in the CRS of the model, all over an image."""
        width, height = places.view.size
        columns, rows = np.meshgrid(np.linspace(0, width, 5), np.linspace(0, height, 5))
        image = np.column_stack([columns.ravel(), rows.ravel()])
        return places.model.image_to_ground(image, np.full(len(image), places.model.reference_height))

    # -- as any project ----------------------------------------------------------------------------------------------

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
        """Return what the adjustment starts from with a correction, as `ortho adjust` has it.

        Raises
        ------
        InputError
            If a model cannot be corrected so.
        """
        if correction not in self._starts:
            asked = replace(self._options, points=None, correction=correction or self._options.correction)
            self._starts[correction] = {
                label: start_of(path, asked, opened, _nothing(), None)
                for label, path, opened in zip(self.images.labels, self.images.paths, self._opened, strict=True)
            }
        return self._starts[correction]

    def _require_possible(self, marks: Iterable[Mark], correction: str | None) -> None:
        for mark in marks:
            if mark.image is not None or not set(mark.rays) <= set(self.images.labels):
                raise InputError("there is no such image", field="rays", remedy="load the page anew")
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
            # Heights under the scene are known to the models that were opened for it.
            delivered = dict(zip(self.images.labels, self.rendered[0], strict=True))
            self._solution = replace(self._solution, models=delivered)
        models = tuple(self._solution.models[label] for label in self.images.labels)
        if any(moved(*three) for three in zip(self.rendered[-1], models, self._everywhere, strict=True)):
            self.rendered = [*self.rendered, models]

    @property
    def solution(self) -> BlockSolution:
        """The adjustment to the points as they are now."""
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
        """Return known ground, that of the adjustment for ties, and on the surface for what has one ray alone."""
        found, fit = super()._grounds(marks), self._solution.fit
        adjusted = {} if fit is None else dict(zip(fit.points.ids, fit.ground, strict=True))
        for k, mark in enumerate(marks):
            if mark.ground is not None and mark.role != "tie":
                continue
            found[k] = adjusted.get(mark.id, np.full(3, np.nan))
            if not np.isfinite(found[k]).all() and mark.rays:
                label, ray = next(iter(mark.rays.items()))
                found[k] = self.places_of(self.images.labels.index(label)).ground_of([ray.image])[0]
        return found

    def _sigma(self, ground: Array) -> list[float] | None:
        return None

    # -- places ------------------------------------------------------------------------------------------------------

    def places_of(self, number: int) -> SceneGeometry:
        return self.images.places[number].by(self._solution.models[self.images.labels[number]])

    def at(self, version: int, number: int = 0) -> SceneGeometry:
        """Return the geometry that references were rendered with for an image."""
        if not 0 <= version < len(self.rendered):
            raise InputError("there is no such rendering", field="version")
        return self.images.places[number].by(self.rendered[version][number])

    def _geometries(self, version: int) -> dict[str, Geometry]:
        found: dict[str, Geometry] = {}
        for number in range(len(self.images.labels)):
            found[f"scene-{number}"] = self.places_of(number)
            found[f"reference-{number}"] = self.at(version, number)
        return found | {f"map-{number}": sheet for number, sheet in enumerate(self.sheets)}

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
        """Return what the other images and the references show at a click in an image, as `TieSearch.of_click`."""
        return self._search_of_clicks.of_click(number, image, known)

    def of_ground(self, ground: Sequence[float]) -> dict[str, Any]:
        """Return where all images show a ground of the reference, as `TieSearch.of_ground`."""
        return self._search_of_clicks.of_ground(ground)

    # -- what comes of it --------------------------------------------------------------------------------------------

    def _asked(self) -> BlockOptions:
        """Return how `ortho adjust` is asked for the same with the saved points, which say all of themselves."""
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
        """Return the corrections compared on the points as they are now."""
        with self._lock:
            table = block_points(self.marks, self.images.labels, self._called)
        return compare_corrections(self.starts, CORRECTIONS, table, self._options.hold, self._observed)

    def ortho(self, progress: Progress, number: int = 0) -> Result:
        """Make what `ortho rectify` makes of an image with the model that `ortho adjust` has of the saved points."""
        from ortho_pipeline.commands.block import adjust
        from ortho_pipeline.commands.rectification import rectify

        with self._lock:
            self.save()
            asked = self._asked()
        label, folder = self.images.labels[number], self.output.with_name(f"{self.output.stem}_ortho")
        path, own = self.images.paths[number], self._opened[number]
        with confined(self.output.parent):
            observed = self._heights if self._observed is not None else SurfaceOptions()
            block = adjust(self.images.paths, folder / "block", asked, self._opened, surface=observed)
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
    """Open images, heights and references, and go on with the points that a journal beside the output has.

    Parameters
    ----------
    output : path
        A ``.geojson`` file.
    scene : SceneOptions or sequence of SceneOptions
        How all images are opened, or each.

    Raises
    ------
    InputError
        For whatever the user can correct.
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
