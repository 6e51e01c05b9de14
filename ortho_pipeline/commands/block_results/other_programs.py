"""A block for other programs: models, images without a georeference, a coarse DEM, and the configurations."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.start import Start
from ortho_pipeline.commands.block_results.orthos import corrected
from ortho_pipeline.commands.control.points import no_points
from ortho_pipeline.commands.inputs import refuse_read
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.block_export import BlockExport, ExportedImage, ImagePair, pairs_of
from ortho_pipeline.exchange.export import Export, check_formats
from ortho_pipeline.exchange.rpc import write_bare_vrt
from ortho_pipeline.files import part_of_outputs, write_text
from ortho_pipeline.files.shell import typed
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import longitudes_near
from ortho_pipeline.geodesy.naming import crs_text
from ortho_pipeline.hookspecs import BlockFormat, Format
from ortho_pipeline.host import Host
from ortho_pipeline.models import SensorModel
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface
from ortho_pipeline.surface.footprint import border, ground_sample_distance, output_crs, two_digits
from ortho_pipeline.surface.writing import write_ellipsoidal

#: Degrees around the images that the coarse DEM covers, too: CARS looks so far.
_AROUND = 0.03
_ELEVATION = "elevation.tif"


def block_formats(names: Sequence[str]) -> tuple[BlockFormat, ...]:
    """Return the formats with these names, each once.

    Raises
    ------
    InputError
        If one is unknown.
    """
    known = Host.discover().block_formats
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(
            f"unknown program {', '.join(unknown)}", field="export", remedy=f"use one or more of {', '.join(known)}"
        )
    return tuple(known[name] for name in dict.fromkeys(names))


def files_for(formats: Sequence[BlockFormat], folder: Path, labels: Sequence[str]) -> dict[str, Path]:
    """Return all files that an export may write."""
    if not formats:
        return {}
    known = Host.discover().formats
    chosen = check_formats([name for each in formats for name in each.models], known)
    files = {each.name: folder / each.file for each in formats} | {"elevation": folder / _ELEVATION}
    for label in labels:
        files |= {f"{label} {kind.name}": folder / f"{label}{kind.ending}" for kind in chosen}
        files[f"{label} image"] = folder / _bare(label)
    return files


@dataclass(frozen=True)
class AdjustedBlock:
    """An adjusted block to export.

    Parameters
    ----------
    starts : mapping
        What the adjustment of each image started from, by label.
    models : mapping
        The adjusted models.
    heights : Surface, optional
        The ground, as given.
    scene : SceneOptions
        How rasters may be opened.
    """

    fit: BlockFit
    starts: Mapping[str, Start]
    models: Mapping[str, SensorModel]
    heights: Surface | None
    scene: SceneOptions

    def pairs(self) -> list[ImagePair]:
        """Return the pairs for stereo.

        Raises
        ------
        CoverageError
            If there is none.
        """
        sizes = {label: (start.scene.width, start.scene.height) for label, start in self.starts.items()}
        level = self.level
        return pairs_of({label: (model, sizes[label]) for label, model in self.models.items()}, level)

    @property
    def level(self) -> float:
        """Median height (m) of the ground points."""
        return float(np.nanmedian(self.fit.ground[:, 2]))

    def export(self, formats: Sequence[BlockFormat], folder: Path, files: dict[str, Path]) -> list[str]:
        """Write what the programs take, add it to `files`, and return what people read: pairs, and what to run.

        Raises
        ------
        InputError
            If a program cannot take the block.
        """
        if not formats:
            return []
        pairs, datasets = self.pairs(), {label: self._dataset(label) for label in self.starts}
        lines = list[str]()
        pictures = {label: self._picture(label, dataset, folder, files) for label, dataset in datasets.items()}
        resolution, crs = self._grid()
        elevation = self._elevation(folder, files)
        exports = {label: self._model(label, dataset) for label, dataset in datasets.items()}
        read = [path for start in self.starts.values() for path in (start.scene.model_source, *start.scene.sources)]
        for chosen in formats:
            kind, written = _models(chosen, exports, folder)
            refuse_read(written.values(), read)
            files |= written
            images = {
                label: ExportedImage(
                    pictures[label],
                    written[f"{label} {kind.name}"].name,
                    exports[label].size,
                    dataset.RasterCount,
                    dataset.GetRasterBand(1).GetNoDataValue(),
                )
                for label, dataset in datasets.items()
            }
            block = BlockExport(images, kind.name, pairs, resolution, crs, elevation)
            write_text(folder / chosen.file, chosen.text(block))
            files[chosen.name] = folder / chosen.file
            lines.append(f"{chosen.title}: `{chosen.command} {typed(folder / chosen.file)}`")
        return [*_described(pairs), *lines]

    def _dataset(self, label: str) -> Any:
        """Return the image, which other programs have to find on this machine."""
        path = self.starts[label].scene.path
        dataset = open_dataset(path, **self.scene.access)
        if not Path(dataset.GetDescription()).is_file():
            raise InputError(
                "other programs need this image as a file on disk", file=path, field="export", remedy="copy it to disk"
            )
        return dataset

    def _picture(self, label: str, dataset: Any, folder: Path, files: dict[str, Path]) -> str:
        """Return the path of the image without a georeference, from the folder; write a VRT if the image has one."""
        located = dataset.GetGeoTransform(can_return_null=True) or dataset.GetGCPCount() or dataset.GetSpatialRef()
        if located:
            files[f"{label} image"] = folder / _bare(label)
            write_bare_vrt(dataset, folder / _bare(label))
            return _bare(label)
        return os.path.relpath(Path(dataset.GetDescription()).resolve(), folder.resolve())

    def _grid(self) -> tuple[float, str]:
        """Return the resolution (m) and the CRS of a DSM."""
        first = next(iter(self.starts.values())).scene
        crs = output_crs(next(iter(self.models.values())), first.width, first.height)
        sizes = {label: (start.scene.width, start.scene.height) for label, start in self.starts.items()}
        steps = [ground_sample_distance(model, crs, *sizes[label], self.level) for label, model in self.models.items()]
        return two_digits(min(steps)), crs_text(crs)

    def _elevation(self, folder: Path, files: dict[str, Path]) -> str | None:
        """Write the ground under the images as a coarse DEM; return its name, None without a DEM."""
        if not isinstance(self.heights, DemSurface):
            return None
        ground = np.concatenate(list(self._corners()))
        # Across the antimeridian each image may count longitudes from another side.
        ground[:, 0] = longitudes_near(ground[:, 0], np.nanmin(ground[:, 0]))
        box = [np.nanmin(ground, axis=0) - _AROUND, np.nanmax(ground, axis=0) + _AROUND]
        write_ellipsoidal(folder / _ELEVATION, corrected(self.heights, self.fit).with_fill("mask"), box)
        files["elevation"] = folder / _ELEVATION
        return _ELEVATION

    def _corners(self) -> Iterator[Array]:
        for label, model in self.models.items():
            scene = self.starts[label].scene
            ground = model.image_to_ground(border(scene.width, scene.height), self.level)
            yield ground_transform(model.crs, "EPSG:4979")(ground)[:, :2]

    def _model(self, label: str, dataset: Any) -> Export:
        scene = self.starts[label].scene
        return Export(dataset, self.models[label], (scene.width, scene.height), None, no_points())


def _bare(label: str) -> str:
    return f"{label}_image.vrt"


def _models(chosen: BlockFormat, exports: Mapping[str, Export], folder: Path) -> tuple[Format, dict[str, Path]]:
    """Write the models in the first format that represents all of them; return it and the files."""
    kinds = check_formats(chosen.models, Host.discover().formats)
    for kind in kinds:
        files = {f"{label} {kind.name}": folder / f"{label}{kind.ending}" for label in exports}
        try:
            with part_of_outputs():
                for label, export in exports.items():
                    export.write(kind, files[f"{label} {kind.name}"])
            return kind, files
        except InputError:
            if kind is kinds[-1]:
                raise
    raise AssertionError("a format names at least one format of models")


def _described(pairs: Sequence[ImagePair]) -> list[str]:
    return [
        f"Stereo pair {pair.first} and {pair.second}: {pair.angle_deg:.1f} degrees apart, overlap {pair.overlap:.0%}"
        for pair in pairs
    ]
