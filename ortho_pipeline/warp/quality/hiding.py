"""Occluded pixels of an ortho: write a mask of them, leave them empty, or fill them from another ortho."""

from __future__ import annotations

import contextlib
import os
import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.raster.ortho import RasterWriter, classes_profile
from ortho_pipeline.raster.regridded import Regridded
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.warp.quality.sight import Sight
from ortho_pipeline.warp.quality.visibility import Visibility
from ortho_pipeline.warp.quality.visibility_kernel import HIDDEN, VOID

#: Classes of the mask by value, with names and colours; 0 means no value.
CLASSES = {
    1: ("visible", "#d9e8d0"),
    2: ("hidden", "#b4500b"),
    3: ("outside the image", "#e6e6e6"),
    4: ("without a height", "#6b6b6b"),
}
VISIBLE, BEHIND, OUTSIDE, WITHOUT = 1, 2, 3, 4


@dataclass(frozen=True)
class Hiding:
    """Output of an ortho, and what to do with pixels that terrain hides.

    Parameters
    ----------
    ortho : path
    heights : (float, float)
        Approximate lowest and highest ground of the scene.
    mask : path, optional
        File for the classes of all pixels; without it, hidden pixels have no value in the ortho.
    other : Regridded, optional
        Ortho that fills hidden pixels where it has values.
    """

    ortho: str | os.PathLike[str]
    heights: tuple[float, float]
    mask: str | os.PathLike[str] | None = None
    other: Regridded | None = None

    def begun(self, model: SensorModel, surface: Surface, grid: Grid, window_bytes: int) -> Looked:
        """Start the work on an ortho; `window_bytes` limits the heights in memory."""
        return Looked(self, grid, Visibility(Sight(model, grid), surface, self.heights, window_bytes))


@dataclass
class Looked:
    """The work on one ortho, shared by its threads."""

    hiding: Hiding
    grid: Grid
    visibility: Visibility
    _hidden: int = 0
    _shown: int = 0
    _filled: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def hidden_share(self) -> float:
        """Share of the pixels within the image that terrain hides."""
        return self._hidden / max(self._shown, 1)

    @property
    def filled_share(self) -> float | None:
        """Share of these pixels that another ortho filled; None without one."""
        return None if self.hiding.other is None else self._filled / max(self._shown, 1)

    def look(
        self, left: int, top: int, pixels: NDArray[Any], valid: NDArray[np.bool_], fill: Any
    ) -> tuple[NDArray[np.uint8] | None, NDArray[np.bool_] | None]:
        """Return the classes of a tile ``(h, w)``, and its hidden pixels; None if none is hidden.

        Without a mask there are no classes, and hidden pixels get the value `fill`.

        Parameters
        ----------
        pixels, valid : (bands, h, w)
            Of the tile, before writing.
        """
        height, width = pixels.shape[1:]
        visibility = self.visibility.look(left, top, width, height)
        shown: NDArray[np.bool_] = valid[0] if len(valid) == 1 else np.asarray(valid.any(axis=0))
        count = int(np.count_nonzero(shown))
        # Most tiles have no hidden pixels, so avoid every unnecessary pass over their pixels.
        hidden = np.asarray((visibility == HIDDEN) & shown) if visibility.any() else None
        with self._lock:
            self._shown += count
            self._hidden += 0 if hidden is None else int(np.count_nonzero(hidden))
        if self.hiding.mask is not None:
            return _classes(visibility, shown, hidden), hidden
        if hidden is not None:
            pixels[:, hidden], valid[:, hidden] = fill, False
        return None, hidden

    def fill(
        self, left: int, top: int, hidden: NDArray[np.bool_] | None, pixels: NDArray[Any], valid: NDArray[np.bool_]
    ) -> None:
        """Fill the hidden pixels ``(h, w)`` of a tile from the other ortho, where it has values.

        Parameters
        ----------
        pixels, valid : (bands, h, w)
            Of the tile; changed in place.
        """
        if self.hiding.other is None or hidden is None or not hidden.any():
            return
        rows, columns = (np.flatnonzero(hidden.any(axis=axis)) for axis in (1, 0))
        part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        size = int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)
        values, good = self.hiding.other.read(left + int(columns[0]), top + int(rows[0]), *size)
        new = hidden[part] & good
        for band in range(len(pixels)):
            pixels[band][part][new[band]] = values[band][new[band]]
            valid[band][part] |= new[band]
        with self._lock:
            self._filled += int(np.count_nonzero(new.any(axis=0)))

    def writer(self, driver: str, threads: int) -> Any:
        """Return the writer of the mask by a GDAL driver as a context; it writes nothing without a mask."""
        if self.hiding.mask is None:
            return contextlib.nullcontext()
        profile = classes_profile("visibility", CLASSES, {})
        return RasterWriter(
            self.hiding.mask, self.grid, profile, driver=driver, creation_options=of_classes(driver), threads=threads
        )


def of_classes(driver: str) -> dict[str, str]:
    """Return the creation options of a raster of classes, which has large uniform areas.

    Run-length compression is four times as fast as deflate, and all programs read it; COGs do not offer it.
    """
    if driver == "GTiff":
        return {"COMPRESS": "PACKBITS"}
    return {"LEVEL": "1", "PREDICTOR": "NO", "OVERVIEW_RESAMPLING": "NEAREST"}


def _classes(found: NDArray[np.uint8], shown: NDArray[np.bool_], hidden: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    # Two simple passes: boolean indexing takes ten times as long.
    classes = np.left_shift(shown.view(np.uint8), 1)
    np.subtract(OUTSIDE, classes, out=classes)
    if hidden is not None:
        classes[hidden] = BEHIND
        classes[(found == VOID) & ~shown] = WITHOUT
    return classes
