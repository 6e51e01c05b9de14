"""Masks of an ortho: a raster of classes, on any grid, leaves out clouds and water from the matching."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.regridded import Regridded, coarser, grid_of, part_of
from ortho_pipeline.raster.source import RasterSource


@dataclass(frozen=True)
class ClassMask:
    """A raster of classes, and those that hide the ground; all but 0 without values.

    Parameters
    ----------
    shift : (float, float)
        How far (pixels of the ortho along columns and rows) the raster shows the ground displaced from the ortho.
    """

    path: str
    values: frozenset[int] = frozenset()
    shift: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def parse(cls, text: str | os.PathLike[str]) -> ClassMask:
        """Return the mask of ``FILE`` or ``FILE=3,8-10``.

        Raises
        ------
        InputError
            If the values are not whole numbers.
        """
        whole = os.fspath(text)
        path, equals, values = whole.rpartition("=")
        if not equals or Path(whole).exists():
            return cls(whole)
        found: set[int] = set()
        for part in values.split(","):
            first, _, last = part.partition("-")
            if not first.strip().isdigit() or not (last or first).strip().isdigit():
                raise InputError(
                    f"{values!r} is not a list of mask classes",
                    file=path,
                    field="mask",
                    remedy="give whole numbers, such as scl.tif=3,8-10",
                )
            found |= set(range(int(first), int(last or first) + 1))
        return cls(path, frozenset(found))

    def hides(self, classes: NDArray[np.generic]) -> NDArray[np.bool_]:
        """Tell which classes hide the ground."""
        return np.isin(classes, list(self.values)) if self.values else np.asarray(classes != 0)


class Masked(Intensity):
    """Intensities of an ortho, NaN where a mask hides the ground."""

    def __init__(
        self, source: RasterSource, bands: Sequence[int], masks: Sequence[ClassMask], opened: SceneOptions
    ) -> None:
        super().__init__(source, bands)
        self._masks, self._opened = tuple(masks), opened
        self._grid = grid_of(source.path, **opened.access)
        self._reduced_masks: dict[int, list[Regridded]] = {}
        self._lock = threading.Lock()

    def read(self, left: int, top: int, width: int, height: int, factor: int = 1) -> NDArray[np.float32]:
        """Return intensities as `Intensity.read` does."""
        found = super().read(left, top, width, height, factor)
        for mask, classes in zip(self._masks, self._of(factor), strict=True):
            pixels, valid = classes.read(round(left / factor), round(top / factor), width, height)
            found[mask.hides(pixels[0]) & valid[0]] = np.nan
        return found

    def _of(self, factor: int) -> list[Regridded]:
        """Return the masks on the grid of means of `factor` x `factor` pixels."""
        grid = self._grid
        with self._lock:
            if factor not in self._reduced_masks:
                size = -(-grid.width // factor), -(-grid.height // factor)
                shown = [part_of(grid, *mask.shift, grid.width, grid.height) for mask in self._masks]
                self._reduced_masks[factor] = [
                    Regridded(mask.path, coarser(one, factor, *size), resampling="nearest", **self._opened.access)
                    for mask, one in zip(self._masks, shown, strict=True)
                ]
            return self._reduced_masks[factor]
