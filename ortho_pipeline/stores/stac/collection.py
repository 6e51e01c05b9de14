"""STAC collections: the items at a place, from an API or from a static collection."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import urlencode

from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.files.locations import AnyPath, Location
from ortho_pipeline.runtime.process_limits import thread_pool
from ortho_pipeline.stores.stac.boxes import Box, any_meet, extent_boxes, questions
from ortho_pipeline.stores.stac.documents import COLLECTIONS, read_document, target
from ortho_pipeline.stores.stac.item import Item, item_of, read_item

_REMEDY = "give a STAC collection: its JSON file, or its address in an API (…/collections/NAME)"
#: Items of a page, and largest number of pages.
_LIMIT, _PAGES = 100, 50
#: Documents of a static collection that are read, and how many at a time; catalogs within each other.
_MOST_DOCUMENTS, _AT_ONCE, _DEEPEST = 30_000, 16, 8
_FEWER = "give a smaller collection, or a FeatureCollection file of the items that you need"


class Collection:
    """A collection, static or of an API, with items at a place.

    Parameters
    ----------
    address : path or address
    roots : sequence of path
        Further folders on this machine in which its files may be.

    Raises
    ------
    InputError
        If it is not a collection.
    """

    def __init__(self, address: AnyPath, *, allow_network: bool = False, roots: tuple[AnyPath, ...] = ()) -> None:
        self.address, self._allow_network, self._roots = os.fspath(address), allow_network, roots
        self._document = read_collection(self.address, allow_network=allow_network)
        self._links = _links(self._document)

    def items(self, box: Box, name: str) -> Iterator[Item]:
        """Yield the items at a place.

        Parameters
        ----------
        box : (west, south, east, north)
            Degrees, for an API.
        name : str
            Part of the addresses of items, for a static collection, which does not state their positions.
        """
        yield from self._listed()
        api = next((link["href"] for link in self._links if link["rel"] == "items"), None)
        if api is not None:
            yield from self._of_api(target(api, self.address), box)
            return
        for link in self._links:
            if link["rel"] == "item" and name in link["href"]:
                yield read_item(target(link["href"], self.address), allow_network=self._allow_network)

    def under(self, boxes: Sequence[Box]) -> tuple[list[Item], list[str]]:
        """Return the items that overlap one of some boxes, and the documents that lead to them.

        An API searches them. The items of a static collection are all read, except those in catalogs that state another
        extent. Items are in the order of their dates, then of their ids.

        Raises
        ------
        InputError
            If an item does not state its position, or there are too many.
        """
        documents = [self.address]
        api = next((link["href"] for link in self._links if link["rel"] == "items"), None)
        items: Iterable[Item] = self._listed()
        if api is not None:
            address = target(api, self.address, self._roots)
            items = [*items, *(item for box in questions(boxes) for item in self._of_api(address, box))]
        else:
            items = [*items, *self._below(boxes, documents)]
        by_place = {}
        for item in items:
            if not item.boxes:
                raise InputError(
                    f"the item {item.id!r} does not state its position", file=item.address, field="bbox", remedy=_REMEDY
                )
            if any_meet(item.boxes, boxes):
                by_place[item.id, tuple(asset.href for asset in item.assets)] = item
        documents += [item.address for item in by_place.values() if api is None]
        return sorted(by_place.values(), key=lambda item: (item.date, item.id)), list(dict.fromkeys(documents))

    def _listed(self) -> Iterator[Item]:
        for feature in self._document.get("features") or ():
            yield item_of(_object(feature, self.address), self.address, self._roots)

    def _below(self, boxes: Sequence[Box], documents: list[str]) -> Iterator[Item]:
        """Yield the items that links of a static collection and of catalogs below it lead to."""
        seen: set[str] = {Location(self.address).url}
        places = self._named(self._links, self.address, seen)
        for _ in range(_DEEPEST):
            if not places:
                return
            if len(seen) > _MOST_DOCUMENTS:
                raise InputError(
                    f"this collection has more than {_MOST_DOCUMENTS} documents", file=self.address, remedy=_FEWER
                )
            below = []
            with thread_pool(_AT_ONCE, "stac") as pool:
                for place, read in zip(places, pool.map(self._read, places), strict=True):
                    if isinstance(read, Item):
                        yield read
                    elif self._may_hold(read, place, boxes):
                        documents.append(place)
                        below += self._named(_links(read), place, seen)
            places = below
        if places:
            raise InputError(f"more than {_DEEPEST} nested catalogs", file=self.address, remedy=_FEWER)

    def _named(self, links: list[dict[str, Any]], base: str, seen: set[str]) -> list[str]:
        """Return the targets of links to items and catalogs that are not yet known."""
        named = [target(link["href"], base, self._roots) for link in links if link["rel"] in ("item", "child")]
        new = [place for place in dict.fromkeys(named) if place not in seen]
        seen.update(new)
        return new

    def _read(self, place: str) -> Item | dict[str, Any]:
        """Return the item or the catalog at a place."""
        document = read_document(place, allow_network=self._allow_network)
        return item_of(document, place, self._roots) if document.get("type") == "Feature" else document

    def _may_hold(self, document: dict[str, Any], place: str, boxes: Sequence[Box]) -> bool:
        """Return whether a catalog below the collection may have items in some boxes."""
        _require_collection(document, place)
        if document["type"] == "Collection" and self._document["type"] == "Catalog":
            raise InputError(
                f"this is a catalog of collections, such as {str(document.get('id'))[:60]!r}",
                file=self.address,
                field="links",
                remedy=f"give one of them, such as {place}",
            )
        extent = extent_boxes(document)
        return not extent or any_meet(extent, boxes)

    def _of_api(self, address: str, box: Box) -> Iterator[Item]:
        query = urlencode({"bbox": ",".join(f"{value:.6g}" for value in box), "limit": _LIMIT}, safe=",")
        page: str | None = f"{address}{'&' if '?' in address else '?'}{query}"
        for _ in range(_PAGES):
            if page is None:
                return
            document = read_document(page, allow_network=self._allow_network, paged=True)
            _require_lists(document, page)
            for feature in document.get("features") or ():
                yield item_of(_object(feature, page), page)
            following = [link for link in _links(document) if link["rel"] == "next"]
            ours = [link for link in following if str(link.get("method", "GET")).upper() == "GET"]
            if following and not ours:
                raise InputError(
                    "the next page of items cannot be read with GET", file=page, field="links", remedy=_FEWER
                )
            page = target(ours[0]["href"], page) if ours else None
        raise InputError(f"more than {_PAGES} pages of items at one place", file=address, remedy=_FEWER)


@reads(_REMEDY)
def read_collection(address: AnyPath, *, allow_network: bool) -> dict[str, Any]:
    """Return the document of a collection, or of a list of items."""
    document = read_document(address, allow_network=allow_network)
    _require_collection(document, address)
    return document


def _require_collection(document: Mapping[str, Any], address: AnyPath) -> None:
    if document.get("type") not in COLLECTIONS:
        raise InputError("this is not a STAC collection", file=address, field="type", remedy=_REMEDY)
    _require_lists(document, address)


def _require_lists(document: Mapping[str, Any], address: AnyPath) -> None:
    for member in ("links", "features"):
        if not isinstance(document.get(member, []), list):
            raise InputError("this is not a list", file=address, field=member, remedy=_REMEDY)


def _links(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [link for link in document.get("links") or () if _is_link(link)]


def _is_link(link: object) -> bool:
    return isinstance(link, dict) and isinstance(link.get("rel"), str) and isinstance(link.get("href"), str)


def _object(feature: Any, address: str) -> Mapping[str, Any]:
    if not isinstance(feature, dict):
        raise InputError("an item must be a JSON object", file=address, field="features", remedy=_REMEDY)
    # An API omits the version from each item of its answer.
    return {"stac_version": "1.0.0", **feature} if Location(address).is_address else feature
