"""Pixels of the orthos of a mosaic, by positions in the mosaic."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.raster.caching.block_cache import limit_cache
from ortho_pipeline.raster.source import MEMORY, RasterSource
from ortho_pipeline.warp.mosaic.layout import Box, Mosaic, PlacedOrtho, box_of, intersection


class Opened:
    """An ortho of a mosaic, open for reading."""

    def __init__(self, layer: PlacedOrtho, memory: int = MEMORY) -> None:
        self.layer, self.source = layer, RasterSource(layer.ortho.path, memory=memory)

    def read(self, box: Box) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels and validity ``(bands, h, w)`` of a box of the mosaic within the ortho."""
        left, top = box[0] - self.layer.left, box[1] - self.layer.top
        values = self.source.read(left, top, box[2] - box[0], box[3] - box[1])
        good = self.source.read_valid(left, top, values)
        return values, np.ones(values.shape, dtype=bool) if good is None else np.broadcast_to(good, values.shape)

    def read_around(self, box: Box) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return pixels ``(bands, h, w)`` of any box of the mosaic, and which are valid in all bands ``(h, w)``."""
        shape = box[3] - box[1], box[2] - box[0]
        values, valid = np.zeros((self.source.count, *shape)), np.zeros(shape, dtype=bool)
        inner = intersection(box, box_of(self.layer))
        if inner is not None:
            part = (slice(inner[1] - box[1], inner[3] - box[1]), slice(inner[0] - box[0], inner[2] - box[0]))
            pixels, good = self.read(inner)
            valid[part] = good.all(axis=0)
            values[(slice(None), *part)] = np.where(good, pixels, 0)
        return values, valid


def open_layers(placed: Mosaic, memory: int = MEMORY) -> list[Opened]:
    """Open all orthos of a mosaic, with GDAL's cache within the memory (bytes)."""
    opened = [Opened(layer, memory) for layer in placed.layers]
    limit_cache(memory, 1, max(one.source.block for one in opened))
    return opened
