"""The corrected ortho of each date of a stack, with a record from which files and with which correction it was made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ortho_pipeline.batch.freshness import DIGESTS
from ortho_pipeline.batch.records import FileState, RunRecord, key_of
from ortho_pipeline.batch.stack.dates import Dated
from ortho_pipeline.batch.stack.placing import Placed, geotransform_of
from ortho_pipeline.block.stack.adjustment import AdjustedStack
from ortho_pipeline.commands.orthos.resampling import write_resampled
from ortho_pipeline.commands.resolved.ledger import versions
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.exchange.moved_grid import write_moved
from ortho_pipeline.files import clear_up
from ortho_pipeline.options import OutputOptions, SceneOptions
from ortho_pipeline.raster.source import open_dataset

Told = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Writer:
    """Writes the corrected ortho of each date; one whose inputs and correction are as recorded is kept.

    Parameters
    ----------
    corrections_only : bool
        Keep the pixels, and write VRTs with a corrected map grid.
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
        model = self.placed.corrected(one, solved, number)
        name = f"{one.name}_aligned{'.vrt' if self.corrections_only else '.tif'}"
        path, place = self.folder / name, self.folder / f"{one.name}.record.json"
        files = [path, path.with_name(f"{one.name}_model.json")]
        for file in (*files, place):
            clear_up(file)
        inputs = (FileState.of("ortho", one.path.absolute(), DIGESTS),)
        key = key_of(inputs, self._configuration(model.to_dict()), self.software)
        record = None if self.rebuild else RunRecord.at(place)
        if record is None or record.key != key or not record.intact(self.folder):
            self._written(one, model, path)
            outputs = tuple(FileState.of(file.suffix[1:], file, name=file.name) for file in files)
            RunRecord(name=one.name, key=key, status="done", inputs=inputs, outputs=outputs).write(place)
        return f"{self.folder.name}/{name}"

    def _configuration(self, model: dict[str, Any]) -> dict[str, Any]:
        output = self.output
        return {
            "model": model,
            "grid": [*self.placed.grid.geotransform, self.placed.grid.width, self.placed.grid.height],
            "corrections_only": self.corrections_only,
            "output": [output.resampling, output.nodata, output.dtype, output.format, dict(output.creation_options)],
        }

    def _written(self, one: Dated, model: Any, path: Path) -> None:
        if self.corrections_only:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_moved(open_dataset(one.path, **self.scene.access), geotransform_of(model), path)
        else:
            write_resampled(one.scene, model, self.placed.grid, path, self.output, self.scene)
        size = one.scene.width, one.scene.height
        saved = SavedModel(model, one.scene.sensor, str(one.path), size, {})
        write_model_file(saved, path.with_name(f"{one.name}_model.json"))
