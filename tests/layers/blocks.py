"""Box buildings and cliffs on flat ground, seen by parallel rays: what they hide is plain geometry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyproj

from ortho_pipeline.models.base import SensorModel, as_ground
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem

ZONE = 32636
WEST, NORTH = 500_000.0, 4_100_000.0
#: Height of the ground above the ellipsoid.
FLOOR = 100.0


@dataclass(frozen=True, eq=False)
class Parallel(SensorModel):
    """Rays that are all parallel: per metre upwards they go `east` and `north` metres; pixels of `pixel` m."""

    kind = "parallel"

    east: float
    north: float
    pixel: float
    side: float
    box: tuple = field(default=())

    @property
    def crs(self) -> str:
        return f"EPSG:{ZONE}"

    @property
    def domain(self):
        half = np.array([self.side, self.side, 500.0])
        return np.array([WEST + self.side / 2, NORTH - self.side / 2, FLOOR]), half

    def ground_to_image(self, ground):
        x, y, h = as_ground(ground).T
        up = h - FLOOR
        return np.stack([(x - self.east * up - WEST) / self.pixel, (NORTH - y + self.north * up) / self.pixel], axis=1)


def towards(off_nadir_deg: float, azimuth_deg: float) -> tuple[float, float]:
    """Return metres east and north per metre upwards of a ray to a sensor in an azimuth."""
    tangent, azimuth = np.tan(np.radians(off_nadir_deg)), np.radians(azimuth_deg)
    return float(tangent * np.sin(azimuth)), float(tangent * np.cos(azimuth))


@dataclass(frozen=True)
class City:
    """Boxes (west, south, east, north, height; m from the south-west corner) on a square of ground."""

    boxes: tuple[tuple[float, float, float, float, float], ...]
    side: float = 256.0

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return heights over the ground at places in metres from the south-west corner."""
        out = np.zeros(np.broadcast(x, y).shape)
        for west, south, east, north, height in self.boxes:
            inside = (x >= west) & (x <= east) & (y >= south) & (y <= north)
            np.maximum(out, height, out=out, where=inside)
        return out

    def hidden(self, x: np.ndarray, y: np.ndarray, east: float, north: float) -> np.ndarray:
        """Return which places a box hides: a line upwards is under its roof while it is over its plan."""
        base, out = self.heights(x, y), np.zeros(x.shape, dtype=bool)
        for west, south, right, top, height in self.boxes:
            enter, leave = np.zeros(x.shape), np.full(x.shape, np.inf)
            for at, step, low, high in ((x, east, west, right), (y, north, south, top)):
                if step == 0:
                    inside = (at > low) & (at < high)
                    enter, leave = np.where(inside, enter, np.inf), np.where(inside, leave, -np.inf)
                    continue
                ends = np.sort(np.stack([(low - at) / step, (high - at) / step]), axis=0)
                enter, leave = np.maximum(enter, ends[0]), np.minimum(leave, ends[1])
            out |= (enter < leave) & (leave > 0) & (base + enter < height)
        return out

    def edges(self, x: np.ndarray, y: np.ndarray, east: float, north: float) -> np.ndarray:
        """Return how far (m) places lie from where what is hidden begins or ends: from any change about them."""
        step, around = 0.05, np.full(x.shape, np.inf)
        middle = self.hidden(x, y, east, north)
        for reach in np.arange(0.25, 2.01, 0.25):
            for angle in np.arange(0, 2 * np.pi, np.pi / 8):
                moved = x + reach * np.cos(angle), y + reach * np.sin(angle)
                changed = (self.hidden(*moved, east, north) != middle) | (
                    np.abs(self.heights(*moved) - self.heights(x, y)) > step
                )
                around = np.where(changed & (around > reach), reach, around)
        return around

    def surface(self, path, step: float = 1.0) -> Surface:
        """Write the city as a DSM whose posts lie on whole steps from the corner, with a margin of ground."""
        margin = 40.0
        count = int((self.side + 2 * margin) / step) + 1
        x = -margin + step * np.arange(count)
        y = self.side + margin - step * np.arange(count)
        heights = FLOOR + self.heights(*np.meshgrid(x, y))
        corner = (WEST - margin - step / 2, NORTH + margin + step / 2)
        write_dem(path, heights, corner, step, f"EPSG:{ZONE}")
        return open_dem(path, "ellipsoid")

    def grid(self, pixel: float = 0.5) -> Grid:
        """Return an output grid over the square."""
        count = round(self.side / pixel)
        return Grid(pyproj.CRS.from_epsg(ZONE), WEST, NORTH, pixel, pixel, count, count)

    def places(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Return the centres of the pixels of a grid in metres from the south-west corner."""
        columns, rows = np.meshgrid(np.arange(grid.width) + 0.5, np.arange(grid.height) + 0.5)
        x, y = grid.xy(columns, rows)
        return x - WEST, y - (NORTH - self.side)


def f1(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the F1 score of a mask: 1 where both are the same."""
    both = (found & wanted).sum()
    return float(2 * both / max(found.sum() + wanted.sum(), 1)) if wanted.any() or found.any() else 1.0


def slopes_of(surface: Surface, sight: Any, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the rise per metre true east and north over pixels."""

    def at(column: float, row: float) -> np.ndarray:
        return surface.heights(np.stack(sight.grid.xy(columns + column, rows + row), axis=1), sight.grid.crs)

    rise = np.stack([at(0.5, 0) - at(-0.5, 0), at(0, 0.5) - at(0, -0.5)], axis=1)
    return np.einsum("ni,nij->nj", rise, np.linalg.inv(sight.metres(columns, rows, np.full(len(rows), FLOOR))))
