"""A DEM from the items of a STAC collection: which item is used where several overlap, and its height datum."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pyproj

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import CoverageError, CrsError, DatumError, completed
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files.locations import Location
from ortho_pipeline.geodesy.crs import Vertical, horizontal, parse_crs
from ortho_pipeline.geodesy.declared_vertical import DeclaredVertical, declared_vertical
from ortho_pipeline.stores.sidecars import ask_beside
from ortho_pipeline.stores.stac.collection import Collection
from ortho_pipeline.stores.stac.item import Asset
from ortho_pipeline.surface.base import parse_fill
from ortho_pipeline.surface.cells.copernicus import Extent
from ortho_pipeline.surface.dem import DemSurface, dem_of
from ortho_pipeline.surface.dem_file import DemFile, SampleGrid
from ortho_pipeline.surface.dem_mosaic import DemMosaic, Samples, laid_out

#: Items that one DEM may have.
_MOST_ITEMS = 10_000
#: Two items that share more than this part of the smaller one show the same ground; neighbours share rims.
_SAME_GROUND = 0.5
_SHOWN = 6
_CHOOSE = (
    "give a FeatureCollection file of the items that belong together, or resample them to one grid: "
    "`gdalwarp -r bilinear -dstnodata -9999 FILES dem.tif`"
)
Placed = tuple[Samples, pyproj.CRS, SampleGrid, str]


def open_collected(
    address: str | os.PathLike[str],
    extents: Iterable[Extent],
    vertical: Vertical | str | None = None,
    override: bool = False,
    fill: str | float = "error",
    memory: int = 512_000_000,
    access: Mapping[str, Any] | None = None,
) -> DemSurface:
    """Return the items of a collection under some extents as a DEM.

    Where several have a height, the one with the finest columns is used, then the one with the latest date.

    Parameters
    ----------
    address : path or address
        With the key of the asset, or a pattern of it, after a ``#``, if its role does not identify it.
    vertical, override, fill, memory
        As for `open_dem`.
    access : mapping
        What `raster.open_pixels` may do for its files.

    Raises
    ------
    CoverageError
        If no item covers the extents.
    DatumError
        If the items state different height datums, or no datum.
    InputError
        If it is not a collection, an item has no raster of heights, or there are too many items.
    """
    access = access or {}
    network, roots = bool(access.get("allow_network")), tuple(access.get("roots", ()))
    name = Location(address)
    items, documents = Collection(name.document, allow_network=network, roots=roots).under(
        [extent.widened() for extent in extents]
    )
    if not 0 < len(items) <= _MOST_ITEMS:
        raise CoverageError(
            f"{counted(len(items), 'item')} of this collection {'covers' if len(items) == 1 else 'cover'} the scene",
            file=name,
            field="surface.dem",
            remedy="give a DEM of this place" if not items else _CHOOSE,
        )
    chosen = [item.heights(name.asset) for item in items]
    ask_beside(*(asset.href for asset in chosen if Location(asset.href).is_far), allow_network=network)
    opened = [_placed(asset, access, override) for asset in chosen]
    try:
        mosaic = laid_out(name, [placed for placed, _ in opened])
    except (CrsError, DatumError) as error:
        raise type(error)(error.message, file=error.file, field=error.field, remedy=_CHOOSE) from error
    surface = dem_of(mosaic, vertical, override, parse_fill(fill), memory)
    ids = {placed[0].path: item.id for item, (placed, _) in zip(items, opened, strict=True)}
    details = {
        "warnings": [*surface.record["warnings"], *_same_ground(mosaic, ids)],
        "items": [item.id for item in items],
        "documents": documents,
        "declared_in": None if surface.record["declared_vertical"] is None else ("items" if opened[0][1] else "files"),
    }
    return replace(surface, record={**surface.record, **details})


def _placed(asset: Asset, access: Mapping[str, Any], override: bool) -> tuple[Placed, bool]:
    """Return the file of an asset, its grid and its unit; and whether its datum comes from the item."""
    file = DemFile(asset.href, access)
    crs, grid = file.place()
    unit = file.unit
    file.close()
    stated = _stated(asset, grid)
    own = declared_vertical(crs)
    if stated is None:
        return (file, crs, grid, unit), False
    system, declared = stated
    if own is None:
        return (file, system, grid, unit), True
    if own.vertical != declared.vertical and not override:
        raise DatumError(
            f"the height datum is {own.name!r} in this file, but {declared.name!r} in its STAC item",
            file=file.path,
            field="surface.vertical",
            remedy=Text(
                "state the right one: ",
                Setting("surface.vertical"),
                " together with ",
                Setting("surface.override_vertical"),
            ),
        )
    return (file, crs, grid, unit), False


def _stated(asset: Asset, grid: SampleGrid) -> tuple[pyproj.CRS, DeclaredVertical] | None:
    """Return the system with heights that an item states for a file of this grid; None where it states none."""
    for text in asset.systems:
        try:
            crs = parse_crs(text)
            with completed(asset.href):
                declared = declared_vertical(crs)
            if declared is not None and horizontal(crs).equals(grid.crs, ignore_axis_order=True):
                return crs, declared
        except CrsError:
            # Ignore what cannot be read: the position in the file itself decides.
            continue
    return None


def _same_ground(mosaic: DemMosaic, ids: Mapping[str, str]) -> list[Notice]:
    """Return a notice if items show the same ground, so that one hides the other."""
    places: list[tuple[str, float, float, float, float]] = []
    for layer in mosaic.layers:
        for part in layer.parts:
            (height, width), left = part.shape, layer.first + part.column * layer.step
            places.append((ids[part.samples.path], left, part.row, left + width * layer.step, part.row + height))
    hidden = list(dict.fromkeys(first[0] for first, second in _neighbours(places) if _shared(first, second)))
    if not hidden:
        return []
    shown = ", ".join(hidden[:_SHOWN]) + (" and others" if len(hidden) > _SHOWN else "")
    return [
        Notice(
            "dem-items-overlap",
            f"{counted(len(hidden), 'item')} of the DEM's collection {'overlaps' if len(hidden) == 1 else 'overlap'} "
            f"another one ({shown}). There the finer item was used, and the newer one if both are equally fine",
            items=hidden,
        )
    ]


def _neighbours(places: Sequence[tuple[Any, ...]]) -> Iterable[tuple[Any, Any]]:
    """Yield pairs of places whose columns overlap, in the order in which they are laid on each other."""
    order = sorted(range(len(places)), key=lambda index: places[index][1])
    for number, index in enumerate(order):
        for after in range(number + 1, len(order)):
            other = order[after]
            if places[other][1] >= places[index][3]:
                break
            yield places[min(index, other)], places[max(index, other)]


def _shared(first: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    wide = min(first[3], other[3]) - max(first[1], other[1])
    high = min(first[4], other[4]) - max(first[2], other[2])
    least = min((place[3] - place[1]) * (place[4] - place[2]) for place in (first, other))
    return wide > 0 and high > 0 and wide * high > _SAME_GROUND * least
