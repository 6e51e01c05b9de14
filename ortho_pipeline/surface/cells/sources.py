"""Where cells come from: a folder on disk, or one of objects, whose cells are kept on this machine once fetched."""

from __future__ import annotations

import functools
import os
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np

from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.files import read_bounded
from ortho_pipeline.files.locations import Location
from ortho_pipeline.raster.source import open_pixels
from ortho_pipeline.runtime.process_limits import thread_pool
from ortho_pipeline.stores.local_cache import kept
from ortho_pipeline.stores.objects import Objects
from ortho_pipeline.stores.stac.collection import Collection
from ortho_pipeline.surface.cells.copernicus import LARGEST, LIST, PUBLIC, PUBLIC_LAND, Cell, cells_of_list
from ortho_pipeline.surface.dem_file import Affine

#: Environment variable with the source of cells, if no option states it.
VARIABLE = "ORTHO_DEM_SOURCE"
_LIST_BYTES = 20_000_000
#: Largest offset of a file from the grid of its cell, in parts of a sample.
_OFF_GRID = 0.01
#: Cells that are fetched at a time.
_AT_ONCE = 4


class Source(ABC):
    """Where cells come from."""

    address: str

    @abstractmethod
    def files(self, cells: list[Cell]) -> dict[Cell, str]:
        """Return the files of those cells that are there."""

    @abstractmethod
    def land(self) -> frozenset[Cell] | None:
        """Return all existing cells: every other one is sea. None if that is unknown."""


def places_of(folder: str, name: str) -> tuple[Path, Path]:
    """Return where a folder may have the file of a cell: in it, or as the bucket in a folder of the cell's name."""
    return Path(folder) / f"{name}.tif", Path(folder) / name / f"{name}.tif"


def address_of(chosen: str | os.PathLike[str] | None) -> str:
    """Return the address that is given, that of the environment variable, or the public bucket."""
    return os.fspath(chosen or os.environ.get(VARIABLE) or PUBLIC)


def source_of(chosen: str | os.PathLike[str] | None, *, allow_network: bool) -> Source:
    """Return the source that is given, that of the environment variable, or the public bucket.

    Raises
    ------
    InputError
        If there is no such folder, or the network is not allowed.
    """
    text = address_of(chosen)
    if Location(text).is_collection:
        return _Catalogue(text, allow_network)
    if Location(text).is_address:
        return _Bucket(text, allow_network)
    if not Path(text).is_dir():
        raise InputError(
            "there is no such folder of DEM cells",
            file=text,
            field="surface.source",
            remedy="give a folder of cells with the names of the public bucket, a STAC collection of them, or "
            "an address",
        )
    return _Folder(text)


class _Folder(Source):
    def __init__(self, path: str) -> None:
        self.address = path

    def files(self, cells: list[Cell]) -> dict[Cell, str]:
        found = {}
        for cell in cells:
            for place in places_of(self.address, cell.name):
                if place.is_file():
                    found[cell] = str(place)
        return found

    def land(self) -> frozenset[Cell] | None:
        path = Path(self.address) / LIST
        return cells_of_list(read_bounded(path, _LIST_BYTES).decode("latin-1")) if path.is_file() else None


class _Bucket(Source):
    def __init__(self, address: str, allow_network: bool) -> None:
        self._objects = Objects(address, allow_network=allow_network)
        self.address = self._objects.address
        self._allow_network = allow_network

    def files(self, cells: list[Cell]) -> dict[Cell, str]:
        with thread_pool(_AT_ONCE, "cells") as pool:
            found = dict(zip(cells, pool.map(self._kept, cells), strict=True))
        return {cell: path for cell, path in found.items() if path is not None}

    def land(self) -> frozenset[Cell] | None:
        own = self._list(self._objects)
        if self.address != PUBLIC or own is None:
            return own
        others = self._list(Objects(PUBLIC_LAND, allow_network=self._allow_network))
        return None if others is None else own | others

    def _kept(self, cell: Cell) -> str | None:
        name = f"{cell.name}/{cell.name}.tif"
        fetch = functools.partial(self._objects.fetch, name, limit=LARGEST)
        try:
            return str(kept("dem", self._objects.of(name), fetch, fault=functools.partial(fault_of, cell)))
        except FileNotFoundError:
            return None

    @staticmethod
    def _list(objects: Objects) -> frozenset[Cell] | None:
        fetch = functools.partial(objects.fetch, LIST, limit=_LIST_BYTES)
        try:
            return cells_of_list(kept("dem", objects.of(LIST), fetch).read_text("latin-1"))
        except FileNotFoundError:
            return None


class _Catalogue(Source):
    """A STAC collection; its assets have the names of cells in the public bucket."""

    def __init__(self, address: str, allow_network: bool) -> None:
        self._collection = Collection(address, allow_network=allow_network)
        self.address, self._allow_network = address, allow_network

    def files(self, cells: list[Cell]) -> dict[Cell, str]:
        found = {cell: self._asset(cell) for cell in cells}
        with thread_pool(_AT_ONCE, "cells") as pool:
            there = [cell for cell, href in found.items() if href is not None]
            return dict(zip(there, pool.map(self._kept, there, [found[cell] for cell in there]), strict=True))

    def land(self) -> frozenset[Cell] | None:
        # A collection may have only some cells; the list of the public bucket tells which others exist.
        if not Location(self.address).is_address:
            return None
        try:
            return _Bucket(PUBLIC, self._allow_network).land()
        except OrthoError:
            return None

    def _asset(self, cell: Cell) -> str | None:
        middle = (cell.lon + 0.4, cell.lat + 0.4, cell.lon + 0.6, cell.lat + 0.6)
        for item in self._collection.items(middle, cell.name.removesuffix("_DEM")):
            for asset in item.assets:
                if asset.name == f"{cell.name}.tif":
                    return asset.href
        return None

    def _kept(self, cell: Cell, href: str | None) -> str:
        assert href is not None
        if not Location(href).is_address:
            return href
        folder, _, name = href.rpartition("/")
        if "?" in name:
            raise InputError(
                "signed URLs are not read",
                file=href.partition("?")[0],
                field="surface.source",
                remedy="give a collection whose assets are open, or the store itself with your credentials",
            )
        fetch = functools.partial(Objects(folder, allow_network=self._allow_network).fetch, name, limit=LARGEST)
        try:
            return str(kept("dem", href, fetch, fault=functools.partial(fault_of, cell)))
        except FileNotFoundError as error:
            raise InputError(
                "the collection lists this cell, but it does not exist",
                file=href,
                field="surface.source",
                remedy="check the collection, or choose another source",
            ) from error


def fault_of(cell: Cell, path: Path | str) -> str:
    """Return what is wrong with the file of a cell: its size, its place, or a block that cannot be unpacked."""
    try:
        dataset, _ = open_pixels(path)
        shape, place = (dataset.RasterYSize, dataset.RasterXSize), dataset.GetGeoTransform()
        dataset.GetRasterBand(1).Checksum()
    except (InputError, RuntimeError) as error:
        return f"it cannot be read ({getattr(error, 'message', error)})"
    x, dx, _, y, _, dy = place
    return misplaced(cell, shape, (x + dx / 2, dx, 0.0, y + dy / 2, 0.0, dy))


def misplaced(cell: Cell, shape: tuple[int, int], place: Affine) -> str:
    """Return how the samples of a file differ from the grid of a cell; empty if they do not."""
    if shape != cell.grid.shape:
        rows, columns = cell.grid.shape
        return f"it has {shape[1]} x {shape[0]} samples instead of {columns} x {rows}"
    own = np.array(cell.grid.crs_from_pixel)
    ends = np.array([[1, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0], [1, shape[1], 0, 0, 0, 0], [0, 0, 0, 1, 0, shape[0]]])
    off = np.abs(ends @ (np.array(place) - own)).max() / own[1]
    return "" if off < _OFF_GRID else "it is at another place than this cell"
