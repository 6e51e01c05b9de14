"""Tiles: the scene, and the reference rendered into its pixels, as PNG of any reduction, made when asked for."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.imaging.matching import Reference, View
from ortho_pipeline.imaging.matching.chips import Renderer
from ortho_pipeline.measure.session import Session
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.raster.output import png_bytes
from ortho_pipeline.raster.pyramid import Pyramid, stretch
from ortho_pipeline.raster.source import RasterSource

#: Side of a tile (px).
SIDE = 256
PANES = ("scene", "reference")
#: Pixels of the scene in one of a tile: whole powers of two up to this.
MOST = 1 << 16

Pixels = NDArray[np.float32]


class Tiles:
    """Tiles of one session.

    Parameters
    ----------
    memory : int
        Bytes of pixels that are kept.
    """

    def __init__(self, session: Session, opened: SceneOptions = SceneOptions(), memory: int = 256_000_000) -> None:
        self._session, self._access = session, opened.access
        self._references = session.places.references
        self._sources = {
            "scene": [session.places.view.intensity.source],
            "reference": [one.intensity.source for one in self._references],
        }
        self._lock = threading.Lock()
        self._open: dict[tuple[str, int], list[Pyramid]] = {}
        self._kept: OrderedDict[Hashable, Pixels] = OrderedDict()
        self._most = max(1, memory // (4 * SIDE * SIDE))
        self.bands = {pane: sources[0].count for pane, sources in self._sources.items()}

    def png(
        self, pane: str, version: int, factor: int, column: int, row: int, bands: Sequence[int],
        limits: Sequence[tuple[float, float]],
    ) -> bytes:  # fmt: skip
        """Return a tile as PNG, transparent where nothing is shown.

        Parameters
        ----------
        factor : int
            Pixels of the scene in one of the tile.
        column, row : int
            Of the tile among those of this factor.
        bands : sequence of int
            One shown in grey, or three in colours; 0 is the mean of all.
        limits : sequence of (float, float)
            What is black and what is white, for each band.
        """
        planes = [
            self.pixels(pane, version, factor, column * SIDE * factor, row * SIDE * factor, band) for band in bands
        ]
        valid = np.logical_and.reduce([np.isfinite(plane) for plane in planes])
        shown = [_shade(plane, *limit) for plane, limit in zip(planes, limits, strict=True)]
        return png_bytes(np.stack([*shown, np.where(valid, 255, 0).astype(np.uint8)]))

    def limits(self, pane: str, version: int, box: Sequence[float] | None, band: int) -> tuple[float, float]:
        """Return what is black and what is white: percentiles 1 and 99 of the raster, or of a box of the view.

        Parameters
        ----------
        box : (left, top, right, bottom), optional
            px of the scene.
        """
        if box is None:
            return self._pyramids(pane, band)[0].stretch()
        left, top, right, bottom = (round(value) for value in box)
        factor = 1
        while max(right - left, bottom - top) > SIDE * factor and factor < MOST:
            factor *= 2
        plane = self.pixels(pane, version, factor, left, top, band)
        rows, columns = (max(1, extent // factor) for extent in (bottom - top, right - left))
        return stretch(plane[:rows, :columns]) or self._pyramids(pane, band)[0].stretch()

    def pixels(self, pane: str, version: int, factor: int, left: int, top: int, band: int) -> Pixels:
        """Return the intensities ``(SIDE, SIDE)`` of a square of the scene's pixels; NaN where nothing is shown."""
        if (
            pane not in PANES
            or not 0 <= band <= self.bands[pane]
            or not (1 <= factor <= MOST and factor & (factor - 1) == 0)
        ):
            raise InputError("there is no such tile", field="tile")
        key = (pane, version if pane == "reference" else 0, factor, left, top, band)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        made = self._made(pane, version, factor, left, top, band)
        with self._lock:
            self._kept[key] = made
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return made

    def _made(self, pane: str, version: int, factor: int, left: int, top: int, band: int) -> Pixels:
        pyramids = self._pyramids(pane, band)
        if pane == "scene":
            return pyramids[0].read(left, top, SIDE, SIDE, factor)
        places = self._session.at(version)
        shown = [
            Reference(pyramid, one.crs, one.pixel_from_map)
            for pyramid, one in zip(pyramids, self._references, strict=True)
        ]
        view = View(places.view.intensity, places.model, places.surface)
        return Renderer(view, shown, np.array([[left, top]]), SIDE, factor).render(np.array([0]))[0]

    def _pyramids(self, pane: str, band: int) -> list[Pyramid]:
        """Return the rasters of a pane, opened when they are first asked for."""
        with self._lock:
            found = self._open.get((pane, band))
            if found is None:
                found = [
                    Pyramid(RasterSource(*one.paths, bands=[band] if 0 < band <= one.count else None, **self._access))
                    for one in self._sources[pane]
                ]
                self._open[pane, band] = found
            return found


def _shade(plane: Pixels, low: float, high: float) -> NDArray[np.uint8]:
    scaled = np.clip((plane - low) * (255.0 / max(high - low, 1e-30)), 0.0, 255.0)
    return np.nan_to_num(scaled).astype(np.uint8)
