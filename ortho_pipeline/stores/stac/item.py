"""STAC items in place of images, DEMs and tables: which of their assets is meant, by its role."""

from __future__ import annotations

import fnmatch
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any

from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.locations import AnyPath, Location
from ortho_pipeline.stores.stac.boxes import Box, boxes_of
from ortho_pipeline.stores.stac.documents import COLLECTIONS, REMEDY, read_document, target

#: Roles of what an image or a DEM is read from, the first first.
_ROLES = ("data", "visual")
#: Roles and keys of heights among other rasters.
_OF_HEIGHTS = {"dem", "elevation"}
_NO_RASTER = ("thumbnail", "overview", "metadata")
_RASTER_TYPE = re.compile(r"image/(?!png|jpeg|webp|svg|gif)|application/(x-hdf5?|x-erdas-hfa|gml\+xml)")
_RASTER_NAME = re.compile(r"\.(tiff?|jp2|ntf|nitf|img|vrt|dt[0-2]|hgt)$", re.IGNORECASE)
_TABLE_TYPE = re.compile(r"application/geo\+json|text/csv")
_TABLE_NAME = re.compile(r"\.(csv|geojson|points|pts)$", re.IGNORECASE)
_RPC_TEXTS, _RPC_FILES = (".txt", ".xml"), (".rpb", ".rpc")
_SHOWN = 12
#: How the projection extension names a system, the most explicit first; `proj:epsg` is that of its first version.
_SYSTEMS = ("proj:wkt2", "proj:projjson", "proj:code", "proj:epsg")
_CODE = re.compile(r"[A-Za-z][\w-]*:[\w.+-]+")
_SYSTEM_CHARS = 50_000


@dataclass(frozen=True)
class Asset:
    """A file of an item: its key, address, roles, and media type (empty if not stated).

    `systems` are the coordinate systems that the item states, as `geodesy.parse_crs` reads them.
    """

    key: str
    href: str
    roles: tuple[str, ...]
    type: str
    systems: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The name of the file."""
        return PurePosixPath(self.href.partition("?")[0]).name

    @property
    def is_raster(self) -> bool:
        """Whether it may be an image or a DEM."""
        named = bool(_RASTER_NAME.search(self.name))
        typed = bool(_RASTER_TYPE.match(self.type)) if self.type else named
        return typed and not set(_NO_RASTER) & set(self.roles)

    @property
    def is_rpc(self) -> bool:
        """Whether it is a sidecar file with an RPC."""
        name = self.name.lower()
        named = name.endswith(_RPC_FILES) or ("rpc" in name and name.endswith(_RPC_TEXTS))
        return named or (self.key.lower() == "rpc" and not self.is_raster)

    @property
    def is_table(self) -> bool:
        """Whether it may hold points."""
        return bool(_TABLE_TYPE.match(self.type) or _TABLE_NAME.search(self.name))


@dataclass(frozen=True)
class Item:
    """A STAC item: its address, id and assets, its bounding boxes, and its date (s since 1970; 0: none)."""

    address: str
    id: str
    assets: tuple[Asset, ...]
    boxes: tuple[Box, ...]
    date: float

    def image(self, key: str = "") -> Asset:
        """Return the raster that an image or a reference is read from.

        Parameters
        ----------
        key : str
            Which one, or a pattern of its key; empty where the role tells.

        Raises
        ------
        InputError
            If there is none, or several are possible.
        """
        rasters = [asset for asset in self.assets if asset.is_raster]
        groups = [[asset for asset in rasters if role in asset.roles] for role in _ROLES]
        groups.append(rasters)
        return self._chosen(key, groups, "raster")

    def heights(self, key: str = "") -> Asset:
        """Return the raster that a DEM is read from, which is no picture of heights; see `image`."""
        rasters = [asset for asset in self.assets if asset.is_raster]
        named = [asset for asset in rasters if _OF_HEIGHTS & {asset.key.lower(), *asset.roles}]
        data = [asset for asset in rasters if _ROLES[0] in asset.roles]
        plain = [asset for asset in rasters if _ROLES[1] not in asset.roles]
        return self._chosen(key, [named, data, plain, rasters], "raster of heights")

    def table(self, key: str = "") -> Asset:
        """Return the table that points are read from; see `image`."""
        return self._chosen(key, [[asset for asset in self.assets if asset.is_table]], "table of points")

    def rpc_of(self, image: Asset) -> Asset | None:
        """Return the sidecar with the RPC of an image; None if there is none, or if GDAL finds it by itself.

        Raises
        ------
        InputError
            If there are several, and not one that has the name of the image.
        """
        candidates = [asset for asset in self.assets if asset.is_rpc]
        if len(candidates) > 1:
            stem = PurePosixPath(image.name).stem
            named = [asset for asset in candidates if asset.name.startswith(stem)]
            if len(named) != 1:
                raise InputError(
                    f"several assets could be the RPC of {image.key!r}: {self._keys(named or candidates)}",
                    file=self.address,
                    field="assets",
                    remedy=Text("choose one with ", Setting("scene.rpc"), ", or give the address of the image itself"),
                )
            candidates = named
        if not candidates:
            return None
        beside = candidates[0].href.rpartition("/")[0] == image.href.rpartition("/")[0]
        ours = {f"{PurePosixPath(image.name).stem}{end}".lower() for end in ("_rpc.txt", ".rpb", ".rpc")}
        return None if beside and candidates[0].name.lower() in ours else candidates[0]

    def _chosen(self, key: str, groups: Iterable[list[Asset]], what: str) -> Asset:
        if key:
            assets = [asset for asset in self.assets if asset.key == key]
            assets = assets or [asset for asset in self.assets if fnmatch.fnmatchcase(asset.key, key)]
            if len(assets) == 1:
                return assets[0]
            raise InputError(
                f"{'several assets are' if assets else 'there is no asset'} {key!r}",
                file=self.address,
                field="assets",
                remedy=f"one of {self._keys(assets or None)}",
            )
        several: list[Asset] = []
        for group in groups:
            if len(group) == 1:
                return group[0]
            several = several or group
        if several:
            raise InputError(
                f"several assets could be the image: {self._keys(several)}",
                file=self.address,
                field="assets",
                remedy=f"choose one, for example {self.address}#{several[0].key}",
            )
        raise InputError(
            f"no asset of the item {self.id!r} is a {what}",
            file=self.address,
            field="assets",
            remedy=f"add the key of one after a #: {self._keys()}" if self.assets else "give another item",
        )

    def _keys(self, assets: Iterable[Asset] | None = None) -> str:
        return ", ".join(asset.key for asset in list(self.assets if assets is None else assets)[:_SHOWN])


@reads(REMEDY)
def read_item(path: AnyPath, *, allow_network: bool = False, roots: tuple[AnyPath, ...] = ()) -> Item:
    """Read a STAC item.

    Parameters
    ----------
    path : path or address
    roots : sequence of path
        Further folders on this machine in which its assets may be.

    Raises
    ------
    InputError
        If it is not a STAC item, or names files elsewhere on this machine.
    """
    return item_of(read_document(path, allow_network=allow_network), path, roots)


def is_item_file(path: AnyPath, *, allow_network: bool = False) -> bool:
    """Return whether a file is a STAC item, and no collection, GeoJSON or other JSON.

    Raises
    ------
    InputError
        If its name is that of a JSON file, and it cannot be read.
    """
    return Location(path).is_item and _is_item(read_document(path, allow_network=allow_network))


@reads(REMEDY)
def item_at(path: AnyPath, *, allow_network: bool, roots: tuple[AnyPath, ...]) -> Item | None:
    """Read a STAC item as `read_item` does; None if it is a collection."""
    document = read_document(path, allow_network=allow_network)
    return None if document.get("type") in COLLECTIONS else item_of(document, path, roots)


def _is_item(document: Mapping[str, Any]) -> bool:
    return document.get("type") == "Feature" and isinstance(document.get("stac_version"), str)


def item_of(document: Mapping[str, Any], address: AnyPath, roots: tuple[AnyPath, ...] = ()) -> Item:
    """Return the item that a JSON object is; see `read_item`."""
    if not _is_item(document):
        raise InputError("this is not a STAC item", file=address, field="stac_version", remedy=REMEDY)
    assets = document.get("assets")
    if not isinstance(assets, dict):
        raise InputError("this STAC item has no assets", file=address, field="assets", remedy=REMEDY)
    place = Location(address).url
    own = next(
        (
            link["href"]
            for link in _list(document.get("links"))
            if isinstance(link, dict)
            and link.get("rel") == "self"
            and isinstance(link.get("href"), str)
            and Location(link["href"]).is_address
            and place.is_address
        ),
        place,
    )
    listed = []
    for key, asset in assets.items():
        if not isinstance(asset, dict) or not isinstance(asset.get("href"), str):
            raise InputError("this asset has no href", file=address, field=f"assets.{key[:60]}", remedy=REMEDY)
        roles = tuple(role for role in _list(asset.get("roles")) if isinstance(role, str))
        kind = asset.get("type") if isinstance(asset.get("type"), str) else ""
        systems = tuple(_systems(asset, document.get("properties")))
        listed.append(Asset(key, target(asset["href"], own, roots), roles, kind or "", systems))
    properties = document.get("properties")
    date = _date(properties) if isinstance(properties, dict) else 0.0
    return Item(place, str(document.get("id", "")), tuple(listed), boxes_of(document), date)


def _systems(*places: Any) -> Iterator[str]:
    """Yield the coordinate systems that an asset states, then those of its item."""
    for place in places:
        for name in _SYSTEMS:
            value = place.get(name) if isinstance(place, dict) else None
            if name == "proj:epsg" and isinstance(value, int):
                yield f"EPSG:{value}"
            elif name == "proj:projjson" and isinstance(value, dict):
                yield json.dumps(value)[:_SYSTEM_CHARS]
            elif isinstance(value, str) and (name == "proj:wkt2" or _CODE.fullmatch(value)):
                yield value[:_SYSTEM_CHARS]


def _date(properties: Mapping[str, Any]) -> float:
    """Return the time of an item in seconds since 1970: the end of its time range; 0 if it states none."""
    for name in ("datetime", "end_datetime", "start_datetime"):
        try:
            time = datetime.fromisoformat(str(properties.get(name)))
            return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError):
            continue
    return 0.0


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
