"""Layers of a mosaic whose pixels are in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.warp.mosaic.layout import Ortho, PlacedOrtho
from ortho_pipeline.warp.mosaic.reading import Opened

UTM = pyproj.CRS.from_epsg(32633)


def grid(width: int, height: int, step: tuple[float, float] = (1.0, 1.0)) -> Grid:
    return Grid(UTM, 5e5, 5e6, *step, width, height)


class Pixels:
    """An ortho in memory: its values ``(bands, h, w)`` and which of them are valid."""

    def __init__(self, values: np.ndarray, valid: np.ndarray) -> None:
        self.values, self.valid, self.count = values, valid, len(values)

    def read(self, left: int, top: int, width: int, height: int) -> np.ndarray:
        return self.values[:, top : top + height, left : left + width]

    def read_valid(self, left: int, top: int, values: np.ndarray) -> np.ndarray:
        return self.valid[:, top : top + values.shape[1], left : left + values.shape[2]]


def layer(left: int, top: int, pixels: Pixels, accuracy: Path | None = None, name: str = "a") -> Opened:
    """Return a layer that begins at a column and a row of its mosaic."""
    _, height, width = pixels.values.shape
    placed = PlacedOrtho(Ortho(name, Path(f"{name}.tif"), None, accuracy), grid(width, height), left, top)
    return Opened(placed, lambda path: pixels)  # type: ignore[arg-type,return-value]
