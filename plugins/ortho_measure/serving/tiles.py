"""Tiles of scenes, rendered references and maps: PNG at any reduction, made on request."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ortho_measure.project import Project
from ortho_pipeline.errors import InputError
from ortho_pipeline.imaging.matching.chips import Renderer
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.pyramid import Pyramid, stretch
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.raster.verified_writing import png_bytes

#: Side of a tile (px).
SIDE = 256
#: Largest number of scene pixels per tile pixel; factors are powers of two.
MOST = 1 << 16

Pixels = NDArray[np.float32]


class TileServer:
    """Tiles of one project, by the names of its views (`Project`).

    Parameters
    ----------
    memory : int
        Size of the cache of pixels (bytes).
    """

    def __init__(self, project: Project, opened: SceneOptions = SceneOptions(), memory: int = 256_000_000) -> None:
        self._project, self._access = project, opened.access
        images = [view.intensity for view in project.views]
        maps = [sheet.reference.intensity for sheet in project.sheets]
        self._shown: dict[str, list[Intensity]] = {}
        for number, image in enumerate(images):
            self._shown[f"scene-{number}"] = [image]
            if maps:
                self._shown[f"reference-{number}"] = maps
        self._shown |= {f"map-{number}": [image] for number, image in enumerate(maps)}
        self._lock = threading.Lock()
        self._open: dict[tuple[Intensity, int], Pyramid] = {}
        self._kept: OrderedDict[Hashable, Pixels] = OrderedDict()
        self._most = max(1, memory // (4 * SIDE * SIDE))
        self.bands = {name: shown[0].source.count for name, shown in self._shown.items()}

    def png(
        self,
        name: str,
        version: int,
        factor: int,
        column: int,
        row: int,
        bands: Sequence[int],
        limits: Sequence[tuple[float, float]],
    ) -> bytes:
        """Return a tile as PNG, transparent where there are no data.

        Parameters
        ----------
        factor : int
            Pixels of the scene per pixel of the tile.
        column, row : int
            Position of the tile among those of this factor.
        bands : sequence of int
            One band (grey) or three (colour); 0 is the mean of all.
        limits : sequence of (float, float)
            Values of black and white for each band.
        """
        planes = [
            self.pixels(name, version, factor, column * SIDE * factor, row * SIDE * factor, band) for band in bands
        ]
        valid = np.logical_and.reduce([np.isfinite(plane) for plane in planes])
        shown = [_shade(plane, *limit) for plane, limit in zip(planes, limits, strict=True)]
        return png_bytes(np.stack([*shown, np.where(valid, 255, 0).astype(np.uint8)]))

    def limits(self, name: str, version: int, box: Sequence[float] | None, band: int) -> tuple[float, float]:
        """Return the values of black and white: percentiles 1 and 99 of the raster, or of a box of the view.

        Parameters
        ----------
        box : (left, top, right, bottom), optional
            px of the scene.
        """
        if box is None:
            return self._pyramids(name, band)[0].stretch()
        left, top, right, bottom = (round(value) for value in box)
        factor = 1
        while max(right - left, bottom - top) > SIDE * factor and factor < MOST:
            factor *= 2
        plane = self.pixels(name, version, factor, left, top, band)
        rows, columns = (max(1, extent // factor) for extent in (bottom - top, right - left))
        return stretch(plane[:rows, :columns]) or self._pyramids(name, band)[0].stretch()

    def pixels(self, name: str, version: int, factor: int, left: int, top: int, band: int) -> Pixels:
        """Return the intensities ``(SIDE, SIDE)`` of a square of the scene's pixels; NaN without data."""
        if (
            name not in self.bands
            or not 0 <= band <= self.bands[name]
            or not (1 <= factor <= MOST and factor & (factor - 1) == 0)
        ):
            raise InputError("unknown tile", field="tile")
        places = self._project.rendering(name, version)
        key = (name, 0 if places is None else version, factor, left, top, band)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        pyramids = self._pyramids(name, band)
        if places is None:
            values = pyramids[0].read(left, top, SIDE, SIDE, factor)
        else:
            shown = [
                replace(target, intensity=pyramid)  # type: ignore[type-var]  # all of them are dataclasses
                for target, pyramid in zip(places.references, pyramids, strict=True)
            ]
            values = Renderer(places.view, shown, np.array([[left, top]]), SIDE, factor).render(np.array([0]))[0]
        with self._lock:
            self._kept[key] = values
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return values

    def _pyramids(self, name: str, band: int) -> list[Pyramid]:
        """Return the rasters of a view, opened on first use."""
        with self._lock:
            for one in self._shown[name]:
                if (one, band) not in self._open:
                    bands = [band] if 0 < band <= one.source.count else one.bands
                    self._open[one, band] = Pyramid(RasterSource(*one.source.paths, **self._access), bands)
            return [self._open[one, band] for one in self._shown[name]]


def _shade(plane: Pixels, low: float, high: float) -> NDArray[np.uint8]:
    with np.errstate(over="ignore"):  # black and white may have the same value
        scaled = np.clip((plane - low) * (255.0 / max(high - low, 1e-30)), 0.0, 255.0)
    return np.nan_to_num(scaled).astype(np.uint8)
