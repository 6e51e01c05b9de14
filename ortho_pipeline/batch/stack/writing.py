"""The corrected ortho of each date of a stack, with a record from which files and with which correction it was made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ortho_pipeline.batch.freshness import DIGESTS, recorded_at
from ortho_pipeline.batch.records import FileState, RunRecord, key_of
from ortho_pipeline.batch.stack.dates import Dated, RawScene
from ortho_pipeline.batch.stack.placing import Placed, geotransform_of
from ortho_pipeline.batch.stack.raw import corrected_model, write_placed, written_with
from ortho_pipeline.block.stack.adjustment import AdjustedStack
from ortho_pipeline.commands.orthos.resampling import write_resampled
from ortho_pipeline.commands.placement import Placement
from ortho_pipeline.commands.resolved.ledger import versions
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.exchange.moved_grid import write_moved
from ortho_pipeline.exchange.rpc import export_rpc, write_vrt
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.options import OutputOptions, SceneOptions
from ortho_pipeline.raster.source import open_dataset

Told = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class _Part:
    """How the files of a date are made: from which files, with which model, and how its image is written."""

    inputs: tuple[FileState, ...]
    saved: SavedModel
    endings: tuple[str, ...]
    write: Callable[[Path], None]
    surface: Any = None


@dataclass(frozen=True, eq=False)
class Writer:
    """Writes the corrected ortho of each date; one whose inputs and correction are as recorded is kept.

    Parameters
    ----------
    corrections_only : bool
        Keep the pixels, and write VRTs with a corrected map grid; of raw scenes with an RPC, if one represents the
        corrected model.
    rebuild : bool
        Write also what is as recorded.
    """

    folder: Path
    placed: Placed
    scene: SceneOptions
    output: OutputOptions
    corrections_only: bool
    rebuild: bool
    software: dict[str, Any] = field(default_factory=versions)

    def write(self, dates: Sequence[Dated], solved: AdjustedStack, told: Told) -> dict[str, str]:
        """Return the files of dates, relative to the folder of the stack."""
        found = {}
        for number, one in enumerate(dates):
            if solved.determined[number]:
                found[one.name] = self._one(one, solved, number)
            told("writing", (number + 1) / len(dates))
        return found

    def _one(self, one: Dated, solved: AdjustedStack, number: int) -> str:
        part = self._part(one, solved, number)
        place = self.folder / f"{one.name}.record.json"
        files = [self.folder / f"{one.name}{ending}" for ending in (*part.endings, "_model.json")]
        record = recorded_at(place, *files, rebuild=self.rebuild)
        key = key_of(part.inputs, self._configuration(part), self.software)
        if record is None or not record.is_of(key, self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            if part.endings:
                part.write(files[0])
            write_model_file(part.saved, files[-1])
            outputs = tuple(FileState.of(file.suffix[1:], file, name=file.name) for file in files)
            RunRecord(name=one.name, key=key, status="done", inputs=part.inputs, outputs=outputs).write(place)
        return f"{self.folder.name}/{files[0].name}"

    def _part(self, one: Dated, solved: AdjustedStack, number: int) -> _Part:
        """Return how the files of a date are made."""
        if one.raw is None:
            return self._finished(one, self.placed.corrected(one, solved, number))
        placement = one.raw.placed
        return self._raw(one.raw, placement, corrected_model(placement, self.placed, solved, number))

    def _finished(self, one: Dated, model: ImageCorrection) -> _Part:
        scene = one.scene

        def write(path: Path) -> None:
            if self.corrections_only:
                write_moved(open_dataset(one.path, **self.scene.access), geotransform_of(model), path)
            else:
                write_resampled(scene, model, self.placed.grid, path, self.output, self.scene)

        saved = SavedModel(model, scene.sensor, str(one.path), (scene.width, scene.height), {})
        inputs = (FileState.of("ortho", one.path.absolute(), DIGESTS),)
        return _Part(inputs, saved, ("_aligned.vrt" if self.corrections_only else "_aligned.tif",), write)

    def _raw(self, raw: RawScene, placement: Placement, model: ImageCorrection) -> _Part:
        scene = placement.scene
        saved = SavedModel(model, scene.sensor, scene.model_source, (scene.width, scene.height), {})
        if not self.corrections_only:

            def write(path: Path) -> None:
                write_placed(placement._replace(model=model, grid=self.placed.grid), path)

            return _Part(raw.inputs, saved, ("_aligned.tif",), write, json_value(placement.surface.provenance))
        try:
            exported = export_rpc(model).rpc
        except InputError:
            # No RPC represents it: the model file is the only output.
            return _Part(raw.inputs, saved, (), lambda path: None)

        def write_rpc(path: Path) -> None:
            write_vrt(open_dataset(scene.path, **self.scene.access), exported, path)

        return _Part(raw.inputs, saved, ("_aligned.vrt",), write_rpc)

    def _configuration(self, part: _Part) -> dict[str, Any]:
        return {
            "surface": part.surface,
            "model": part.saved.model.to_dict(),
            "grid": [*self.placed.grid.geotransform, self.placed.grid.width, self.placed.grid.height],
            "corrections_only": self.corrections_only,
            "output": written_with(self.output),
        }
