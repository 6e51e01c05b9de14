"""Windows of two orthos on one grid, for a correlation that shares no code with ours."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from osgeo import gdal

#: Side of a window, px.
SIDE = 64


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    dataset = gdal.Open(str(path))
    pixels = np.atleast_3d(dataset.ReadAsArray().astype(float).T).mean(axis=2).T
    return pixels, dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0, dataset.GetGeoTransform()


def windows(first: Path, second: Path, step: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the pixels of both orthos (mean of the bands) in windows at every `step` px that are valid in both."""
    (one, shown, place), (other, shown_too, there) = _read(first), _read(second)
    right, down = round((there[0] - place[0]) / place[1]), round((there[3] - place[3]) / place[5])
    rows = range(max(0, down), min(one.shape[0], other.shape[0] + down) - SIDE, step)
    columns = range(max(0, right), min(one.shape[1], other.shape[1] + right) - SIDE, step)
    for row, column in itertools.product(rows, columns):
        here = np.s_[row : row + SIDE, column : column + SIDE]
        far = np.s_[row - down : row - down + SIDE, column - right : column - right + SIDE]
        if shown[here].all() and shown_too[far].all():
            yield one[here], other[far]


def tapered(window: np.ndarray) -> np.ndarray:
    """Return a window about its mean, less towards its rim."""
    return (window - window.mean()) * np.outer(np.hanning(SIDE), np.hanning(SIDE))
