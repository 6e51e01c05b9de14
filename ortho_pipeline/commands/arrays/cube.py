"""Orthos on one grid as a lazy cube of times: dask reads only the blocks that are used."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.commands.arrays.lazy import attributes_of, blocks_of, coordinates_of, libraries
from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.raster.source import Grid, RasterSource

if TYPE_CHECKING:
    import xarray

#: Default side (px) of a block: two blocks of a COG.
SIDE = 1024


class FileTiles:
    """What reads blocks of an ortho; it may be sent to other processes, where it opens its file again."""

    def __init__(self, path: str, access: Mapping[str, Any]) -> None:
        self._parts = path, dict(access)
        self._source: RasterSource | None = RasterSource(path, **access)
        self.profile = Profile.of(self._source)
        # Files of many dates are not kept open.
        self._source = None
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return FileTiles, self._parts

    def __call__(self, top: int, left: int, height: int, width: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels ``(bands, height, width)`` of a block, and which of them ``(height, width)`` are valid."""
        with self._lock:
            if self._source is None:
                path, access = self._parts
                self._source = RasterSource(path, **access)
        pixels = self._source.read(left, top, width, height)
        valid = self._source.read_valid(left, top, pixels)
        return pixels, np.ones((height, width), dtype=bool) if valid is None else np.asarray(valid.all(axis=0))


def cube_of(
    paths: Sequence[str | os.PathLike[str]],
    times: Sequence[datetime],
    of_times: Mapping[str, Any],
    chunks: int | None,
    access: Mapping[str, Any],
) -> xarray.DataArray:
    """Return orthos of one grid as an array ``(time, band, y, x)``.

    Parameters
    ----------
    times : sequence of datetime
        Of the orthos, in their order.
    of_times : mapping
        Further coordinates of times ``(T,)``, by name.
    chunks : int, optional
        Side of a block in pixels.
    access : mapping
        Permissions to open files.

    Raises
    ------
    InputError
        If dask or xarray is missing, or the orthos differ in grid, bands, type, nodata value, scale or colours.
    """
    dask, xarray = libraries("to_xarray")
    side = SIDE if chunks is None else chunks
    if not isinstance(side, int) or side < 1:
        raise InputError(f"blocks of {chunks} pixels are not made", field="chunks", remedy="such as 512")
    grid, tiles = grid_of(paths[0], **access), [FileTiles(os.fspath(path), access) for path in paths]
    first = tiles[0].profile
    for path, one in zip(paths, tiles, strict=True):
        if _grid(grid_of(path, **access)) != _grid(grid) or _kind(one.profile) != _kind(first):
            raise InputError(
                "this ortho differs from the first one in its grid, bands, type or nodata value",
                file=path,
                field="to_xarray",
                remedy="stack orthos with the same bands and type, and let the stack write their pixels",
            )
        what = first.unlike(one.profile, os.path.basename(paths[0]), os.path.basename(path))
        if what:
            raise InputError(what, file=path, field="to_xarray", remedy="stack only orthos whose values mean the same")
    blocks = [blocks_of(one, grid, side) for one in tiles]
    coordinates = coordinates_of(grid, first)
    # NumPy has no time zones: times are UTC.
    plain = [time.astimezone(UTC).replace(tzinfo=None) for time in times]
    coordinates["time"] = np.array(plain, dtype="datetime64[ns]")
    coordinates |= {name: ("time", values) for name, values in of_times.items()}
    if first.validity == "mask":
        coordinates["valid"] = (("time", "y", "x"), dask.array.stack([valid for _, valid in blocks]))
    pixels = dask.array.stack([values for values, _ in blocks])
    return xarray.DataArray(pixels, coordinates, ("time", "band", "y", "x"), "stack", attributes_of(first))


def _grid(grid: Grid) -> tuple[Any, ...]:
    return (*grid.geotransform, grid.width, grid.height)


def _kind(profile: Profile) -> tuple[Any, ...]:
    return profile.count, profile.dtype, profile.validity, repr(profile.nodata)
