"""Samples of a DEM in memory."""

from __future__ import annotations

import numpy as np
import pyproj

from ortho_pipeline.surface.dem_file import SampleGrid

CRS = pyproj.CRS("EPSG:32735")
#: Metres between samples.
STEP = 10.0


class Memory:
    """Samples 10 m apart, from a corner (x, y) on."""

    path, block, unit, files = "dem.tif", 64, "", ("dem.tif",)

    def __init__(self, heights: np.ndarray, corner: tuple[float, float]) -> None:
        self.heights, self.corner = heights, corner

    def place(self) -> tuple[pyproj.CRS, SampleGrid]:
        x, y = self.corner
        return CRS, SampleGrid(CRS, self.heights.shape, (x, STEP, 0.0, y, 0.0, -STEP))

    def read(self, left: int, top: int, width: int, height: int, metres_per_unit: float) -> np.ndarray:
        rows, columns = self.heights.shape
        assert 0 <= left < left + width <= columns
        assert 0 <= top < top + height <= rows
        return self.heights[top : top + height, left : left + width] * metres_per_unit

    def close(self) -> None:
        pass
