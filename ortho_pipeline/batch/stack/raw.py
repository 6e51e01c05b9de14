"""Raw scenes of a stack: an ortho of each with its delivered model, for matching; corrections as those of that model.

The aligned ortho is resampled once, from the raw image.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.batch.executors import Crew
from ortho_pipeline.batch.freshness import DIGESTS, far_states
from ortho_pipeline.batch.records import FileState
from ortho_pipeline.batch.stack.dates import Dated, RawScene
from ortho_pipeline.batch.stack.placing import Placed, map_grid_of
from ortho_pipeline.batch.stack.recorded import FileSet, Made, RecordedFolder
from ortho_pipeline.block.stack.adjustment import AdjustedStack
from ortho_pipeline.commands.block_results.orthos import on_one_grid
from ortho_pipeline.commands.control.points import no_points
from ortho_pipeline.commands.heights.opening import has_surface, open_surface
from ortho_pipeline.commands.orthos.opening import ORTHO, open_ortho
from ortho_pipeline.commands.placement import Placement, open_rasters
from ortho_pipeline.commands.rectification import warp_placed
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.opening import on_surface
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.errors import InputError
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.files.locations import Location
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.surface.footprint import image_grid
from ortho_pipeline.surface.rays import meet_surface

#: Places per side of the image at which a correction is transferred to the model, and how many need heights.
_SIDE, _FEWEST = 17, 3


def written_with(output: OutputOptions) -> list[Any]:
    """Return the options that the pixels of an ortho and its file depend on."""
    return [
        output.resampling, output.nodata, output.dtype, output.format, dict(output.creation_options),
        output.bands and list(output.bands), output.dem_interpolation, output.tolerance, output.engine,
    ]  # fmt: skip


def write_in(placed: Placement, name: str, folder: Path) -> None:
    """Write the ortho of a placed scene into a folder.

    Raises
    ------
    InputError
        If it cannot be read or written.
    """
    source = open_rasters(placed.scene, placed.request)
    warp_placed(placed, None, source, folder / name, lambda stage, share: None)


@dataclass(frozen=True, eq=False)
class Levelled:
    """Positions in orthos of raw scenes, as if they were made with the heights of the places that they show.

    An ortho that shows ground displaced was made with the heights next to it. On slopes this adds to the displacement.
    Here rays end at the height of the true place, so that an error of the model is the same on all slopes.

    Parameters
    ----------
    placements : mapping of int to Placement
        Raw scenes by the numbers of their dates.
    stack : AdjustedStack
        From the positions in the orthos; it says where the true places are.
    """

    placements: Mapping[int, Placement]
    placed: Placed
    stack: AdjustedStack

    @classmethod
    def of(cls, dates: Sequence[Dated], placed: Placed, stack: AdjustedStack) -> Levelled:
        """Return the positions of a stack."""
        raw = {number: one.raw.placed for number, one in enumerate(dates) if one.raw is not None}
        return cls(raw, placed, stack)

    def pair(self, first: int, second: int, at: Array, seen: Array) -> tuple[Array, Array]:
        """Return positions ``(n, 2)`` px of matches in the earlier ortho (`second`) and in the later one.

        NaN where heights are unknown.
        """
        true = at - self.stack.at(at)[0][second]
        return self._one(second, at, true), self._one(first, seen, true)

    def _one(self, date: int, shown: Array, true: Array) -> Array:
        placement = self.placements.get(date)
        if placement is None:
            return shown
        model, crs = placement.model, self.placed.model.crs
        seen = model.ground_to_image(ground_transform(crs, model.crs)(self.placed.on(placement.surface, shown)))
        level = model.image_to_ground(seen, self.placed.on(placement.surface, true)[:, 2])
        return self.placed.at(ground_transform(model.crs, crs)(level)[:, :2])


def corrected_model(placement: Placement, placed: Placed, stack: AdjustedStack, date: int) -> ImageCorrection:
    """Return the delivered model of a raw scene with the correction of its date.

    The correction displaces the ground at its own height. At places all over the scene, the pixel of the displaced
    place is compared with that of the place: their difference, as a shift or affine transformation of the image, is the
    error of the model.
    """
    model, crs = placement.model, placed.model.crs
    size = placement.scene.width, placement.scene.height
    ground = ground_transform(model.crs, crs)(meet_surface(model, image_grid(*size, _SIDE), placement.surface))
    there = ground[np.isfinite(ground).all(axis=1)]
    place = placed.at(there[:, :2])
    moved = placed.model.image_to_ground(place + stack.at(place)[0][date], there[:, 2])
    to_model = ground_transform(crs, model.crs)
    predicted, seen = model.ground_to_image(to_model(there)), model.ground_to_image(to_model(moved))
    used = np.isfinite(predicted).all(axis=1) & np.isfinite(seen).all(axis=1)
    if used.sum() < _FEWEST:
        raise InputError(
            "this scene has no heights where its correction is applied",
            file=placement.scene.path,
            field="surface.dem",
            remedy="give a DEM that covers the whole scene",
        )
    kind, origin = "affine" if stack.sloped[date] else "shift", np.array(size) / 2
    design = np.column_stack([np.ones(int(used.sum())), predicted[used] - origin])[:, : 3 if kind == "affine" else 1]
    terms = np.zeros((3, 2))
    terms[: design.shape[1]] = np.linalg.lstsq(design, seen[used] - predicted[used], rcond=None)[0]
    return ImageCorrection(
        model, kind, (float(origin[0]), float(origin[1])), np.concatenate([terms[:, 0], terms[:, 1]])
    )


@dataclass(frozen=True, eq=False)
class Rectifier:
    """Makes an ortho of each raw scene with its delivered model; one whose inputs are as recorded is kept."""

    folder: RecordedFolder
    surface: SurfaceOptions
    scene: SceneOptions
    output: OutputOptions

    def orthos(
        self, dates: Sequence[Dated], some: Collection[int], crew: Crew, told: Callable[[float], None]
    ) -> list[Dated]:
        """Return the dates with orthos in place of raw scenes: in the CRS and pixel size of the first finished ortho.

        Without any, they have the UTM zone of the first scene and the smallest pixel.

        Parameters
        ----------
        some : collection of int
            Dates whose orthos are needed; the others stay as they are.

        Raises
        ------
        InputError
            If heights are given and no scene is raw, or they do not cover a scene.
        """
        raw = [one for one in dates if one.scene.sensor != ORTHO]
        if not raw:
            if has_surface(self.surface):
                raise InputError(
                    "heights are for raw scenes, and all of these are finished orthos",
                    field="surface.dem" if self.surface.dem is not None else "surface.height",
                    remedy="leave them out",
                )
            return list(dates)
        heights = open_surface(self.surface, self.scene, self.output.memory, [one.scene for one in raw])
        scenes = {one.name: on_surface(one.scene, heights) for one in raw}
        finished = next((one for one in dates if one.scene.sensor == ORTHO), None)
        if finished is None:
            output = on_one_grid(scenes, heights, self.output)
        else:
            grid = map_grid_of(finished)
            output = replace(self.output, crs=grid.crs, resolution=grid.pixel)
        access = SceneOptions(allow_network=self.scene.allow_network, roots=self.scene.roots)
        opened: dict[int, RawScene] = {}
        for number in sorted(some):
            scene = scenes.get(dates[number].name)
            if scene is not None:
                request = Request(scene, access, surface=self.surface, output=output)
                ledger = Ledger.of(request, scene, heights)
                resolved = Resolved(request, scene, heights, no_points(), None, ledger)
                self.folder.learn(dates[number].name)
                opened[number] = RawScene(resolved, self._inputs(resolved))
        sets = [self._set(dates[number].name, raw_scene) for number, raw_scene in opened.items()]
        made = self.folder.make_all(crew, sets, told)
        return [
            self._with_ortho(one, opened[number], made[one.name]) if number in opened else one
            for number, one in enumerate(dates)
        ]

    @staticmethod
    def _inputs(resolved: Resolved) -> tuple[FileState, ...]:
        near = (FileState.of(role, file.absolute(), DIGESTS) for file, role in resolved.ledger.roles.items())
        return (*near, *far_states(resolved.request, resolved.ledger))

    def _set(self, name: str, raw: RawScene) -> FileSet:
        file, placed = _ortho_of(name), raw.placed
        write = functools.partial(write_in, placed, file)
        return FileSet(name, raw.inputs, self._configuration(placed), {"ortho": file}, write)

    def _with_ortho(self, one: Dated, raw: RawScene, made: Made) -> Dated:
        path = self.folder.path(_ortho_of(one.name))
        state = made.record.outputs[0].replaced(path=Location(path.absolute()).url)
        access = SceneOptions(allow_network=self.scene.allow_network)
        return replace(one, path=path, scene=open_ortho(path, access), raw=raw, made=state)

    def _configuration(self, placed: Placement) -> dict[str, Any]:
        output, grid = placed.request.output, placed.grid
        return {
            "model": placed.model.to_dict(),
            "grid": [grid.crs.to_wkt(), *grid.geotransform, grid.width, grid.height],
            "surface": json_value(placed.surface.provenance),
            "output": written_with(output),
        }


def _ortho_of(name: str) -> str:
    return f"{name}_ortho.tif"
