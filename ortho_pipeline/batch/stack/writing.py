"""The corrected ortho of each date of a stack, with a record from which files and with which correction it was made."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ortho_pipeline.batch.executors import Crew
from ortho_pipeline.batch.records import FileState
from ortho_pipeline.batch.stack.dates import Dated, RawScene
from ortho_pipeline.batch.stack.placing import Placed, geotransform_of
from ortho_pipeline.batch.stack.raw import corrected_model, write_in, written_with
from ortho_pipeline.batch.stack.recorded import FileSet, RecordedFolder, record_file
from ortho_pipeline.block.stack.adjustment import AdjustedStack
from ortho_pipeline.commands.orthos.resampling import write_resampled
from ortho_pipeline.commands.placement import Placement
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.exchange.moved_grid import write_moved
from ortho_pipeline.exchange.rpc import RPC, export_rpc, write_vrt
from ortho_pipeline.files import clear_up
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.options import OutputOptions, SceneOptions
from ortho_pipeline.raster.source import Grid, open_dataset

_log = logging.getLogger(__name__)
#: How the names of corrected images end.
_TIF, _VRT = "_aligned.tif", "_aligned.vrt"
#: How the names of all files of a date end.
_WRITTEN = _TIF, _VRT, "_model.json"
#: Writes the image of a date with a name into a folder.
WriteImage = Callable[[str, Path], None]


@dataclass(frozen=True, eq=False)
class _Part:
    """How the files of a date are made: from which files, with which model, and how its image is written, if at all."""

    inputs: tuple[FileState, ...]
    saved: SavedModel
    ending: str = ""
    write: WriteImage | None = None
    surface: Any = None


@dataclass(frozen=True, eq=False)
class Writer:
    """Writes the corrected ortho of each date; one whose inputs and correction are as recorded is kept.

    Parameters
    ----------
    corrections_only : bool
        Keep the pixels, and write VRTs with a corrected map grid; of raw scenes with an RPC, if one represents the
        corrected model.
    """

    folder: RecordedFolder
    placed: Placed
    scene: SceneOptions
    output: OutputOptions
    corrections_only: bool

    def write(
        self, dates: Sequence[Dated], solved: AdjustedStack, crew: Crew, told: Callable[[float], None],
        begin: Callable[[], None],
    ) -> tuple[dict[str, str], list[str]]:  # fmt: skip
        """Return the names of files of dates, and those of files of earlier runs that are no part of the result.

        `begin` is called before the first of them changes.
        """
        sets = [self._set(one, solved, number) for number, one in enumerate(dates) if solved.determined[number]]
        self.folder.make_all(crew, sets, told, begin)
        return {one.name: next(iter(one.files.values())) for one in sets}, self._outdated(sets)

    def _outdated(self, sets: Sequence[FileSet]) -> list[str]:
        """Return the names of files of dates that are not in the result."""
        found: list[str] = []
        for name in self.folder.others(one.name for one in sets):
            # The record itself does not decide what is removed: others may have written it.
            endings = "_stac.json", "_delivery.json", *_WRITTEN
            found += [*(f"{name}{end}" for end in endings), record_file(name)]
        for name in self.folder.begun(one.name for one in sets):
            files = [f"{name}{end}" for end in _WRITTEN]
            for file in files:
                clear_up(Path(self.folder.place) / file)
            found += files
        # Those of an earlier run with the other kind of output.
        found += [f"{one.name}{end}" for one in sets for end in (_TIF, _VRT) if one.files.get(end[-3:]) is None]
        there = self.folder.names()
        return [name for name in found if name in there]

    def _set(self, one: Dated, solved: AdjustedStack, number: int) -> FileSet:
        self.folder.learn(one.name)
        part = self._part(one, solved, number)
        image, model = f"{one.name}{part.ending}", f"{one.name}_model.json"
        names = [model] if part.write is None else [image, model]
        write = None if part.write is None else functools.partial(part.write, image)
        return FileSet(
            one.name, part.inputs, self._configuration(part),
            {Path(name).suffix[1:]: name for name in names}, functools.partial(_write, write, part.saved, model),
        )  # fmt: skip

    def _part(self, one: Dated, solved: AdjustedStack, number: int) -> _Part:
        """Return how the files of a date are made."""
        if one.raw is None:
            return self._finished(one, self.placed.corrected(one, solved, number))
        placement = one.raw.placed
        return self._raw(one.raw, placement, corrected_model(placement, self.placed, solved, number))

    def _finished(self, one: Dated, model: ImageCorrection) -> _Part:
        scene, access = one.scene, self.scene
        write: WriteImage = (
            functools.partial(_write_moved, scene, model, access)
            if self.corrections_only
            else functools.partial(_write_resampled, scene, model, self.placed.grid, self.output, access)
        )
        saved = SavedModel(model, scene.sensor, scene.model_source, (scene.width, scene.height), {})
        return _Part(one.states(access), saved, _VRT if self.corrections_only else _TIF, write)

    def _raw(self, raw: RawScene, placement: Placement, model: ImageCorrection) -> _Part:
        scene = placement.scene
        saved = SavedModel(model, scene.sensor, scene.model_source, (scene.width, scene.height), {})
        if not self.corrections_only:
            corrected = placement._replace(model=model, grid=self.placed.grid)
            write: WriteImage = functools.partial(write_in, corrected)
            return _Part(raw.inputs, saved, _TIF, write, json_value(placement.surface.provenance))
        try:
            exported = export_rpc(model)
        except InputError:
            # No RPC represents it: the model file is the only output.
            return _Part(raw.inputs, saved)
        for notice in exported.warnings:
            _log.warning("%s: %s", scene.path, notice)
        return _Part(raw.inputs, saved, _VRT, functools.partial(_write_rpc, scene, exported.rpc, self.scene))

    def _configuration(self, part: _Part) -> dict[str, Any]:
        return {
            "surface": part.surface,
            "model": part.saved.model.to_dict(),
            "grid": [*self.placed.grid.geotransform, self.placed.grid.width, self.placed.grid.height],
            "corrections_only": self.corrections_only,
            "output": written_with(self.output),
        }


def _write(image: Callable[[Path], None] | None, saved: SavedModel, model: str, folder: Path) -> None:
    if image is not None:
        image(folder)
    write_model_file(saved, folder / model)


def _write_moved(scene: Scene, model: ImageCorrection, access: SceneOptions, name: str, folder: Path) -> None:
    write_moved(open_dataset(scene.path, **access.access), geotransform_of(model), folder / name)


def _write_resampled(
    scene: Scene, model: ImageCorrection, grid: Grid, output: OutputOptions, access: SceneOptions, name: str,
    folder: Path,
) -> None:  # fmt: skip
    write_resampled(scene, model, grid, folder / name, output, access)


def _write_rpc(scene: Scene, rpc: RPC, access: SceneOptions, name: str, folder: Path) -> None:
    write_vrt(open_dataset(scene.path, **access.access), rpc, folder / name)
