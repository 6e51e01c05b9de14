"""Pixels of the orthos of a mosaic, by places of the mosaic."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.raster.caching.block_cache import limit_cache
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.warp.mosaic.layout import Box, Mosaic, PlacedOrtho, box_of, intersection

#: Orthos that are open at a time. A process may have 1024 files open by default, some of them several for an ortho.
_OPEN = 200


class Opened:
    """An ortho of a mosaic for reading. It is open while it is among those that were read last."""

    def __init__(self, layer: PlacedOrtho, source_of: Callable[[Path], RasterSource]) -> None:
        self.layer, self._source_of = layer, source_of

    @property
    def source(self) -> RasterSource:
        """Its pixels."""
        return self._source_of(self.layer.ortho.path)

    def read(self, box: Box) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels and their validity ``(bands, h, w)`` in a box of the mosaic inside the ortho."""
        left, top = box[0] - self.layer.left, box[1] - self.layer.top
        values = self.source.read(left, top, box[2] - box[0], box[3] - box[1])
        good = self.source.read_valid(left, top, values)
        return values, np.ones(values.shape, dtype=bool) if good is None else np.broadcast_to(good, values.shape)

    def read_around(self, box: Box) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return pixels ``(bands, h, w)`` of any box of the mosaic, and which have values in all bands ``(h, w)``."""
        shape = box[3] - box[1], box[2] - box[0]
        values, valid = np.zeros((self.source.count, *shape)), np.zeros(shape, dtype=bool)
        inner = intersection(box, box_of(self.layer))
        if inner is not None:
            part = (slice(inner[1] - box[1], inner[3] - box[1]), slice(inner[0] - box[0], inner[2] - box[0]))
            pixels, good = self.read(inner)
            valid[part] = good.all(axis=0)
            values[(slice(None), *part)] = np.where(good, pixels, 0)
        return values, valid


def open_layers(placed: Mosaic, memory: int) -> list[Opened]:
    """Return all orthos of a mosaic for reading, with GDAL's cache within the memory (bytes)."""
    source_of = functools.lru_cache(maxsize=_OPEN)(functools.partial(RasterSource, memory=memory))
    opened = [Opened(layer, source_of) for layer in placed.layers]
    limit_cache(memory, 1, max(raster.source.block for raster in opened))
    return opened
