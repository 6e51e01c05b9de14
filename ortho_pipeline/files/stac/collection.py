"""STAC collections: the items at a place, of an API that is asked for it, or of a static collection that names them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import urlencode

from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.files.locations import AnyPath
from ortho_pipeline.files.stac.documents import read_document, target
from ortho_pipeline.files.stac.item import Item, item_of, read_item
from ortho_pipeline.files.storage.objects import is_address

_REMEDY = "give a STAC collection: its JSON file, or its address in an API (…/collections/NAME)"
_OF_API = re.compile(r"https?://[^?#]*/collections/[^/?#]+/?$")
#: Items that are asked for at a time, and pages that are followed.
_LIMIT, _PAGES = 100, 50
Box = tuple[float, float, float, float]


def is_collection(path: AnyPath) -> bool:
    """Tell by its name whether something is a STAC collection: a JSON file, or a collection of an API."""
    text = os.fspath(path)
    return text.lower().partition("?")[0].endswith(".json") or bool(_OF_API.match(text))


class Collection:
    """A collection that is read, or asked, for items at a place.

    Parameters
    ----------
    address : path or address

    Raises
    ------
    InputError
        If it is no collection.
    """

    def __init__(self, address: AnyPath, *, allow_network: bool = False) -> None:
        self.address, self._allow_network = os.fspath(address), allow_network
        self._document = read_collection(self.address, allow_network=allow_network)
        self._links = [link for link in self._document.get("links") or () if _is_link(link)]

    def items(self, box: Box, name: str) -> Iterator[Item]:
        """Yield the items at a place.

        Parameters
        ----------
        box : (west, south, east, north)
            Degrees, of an API.
        name : str
            What addresses of items contain, of a static collection, which says nothing of their places.
        """
        for feature in self._document.get("features") or ():
            yield item_of(_object(feature, self.address), self.address)
        asked = next((link["href"] for link in self._links if link["rel"] == "items"), None)
        if asked is not None:
            yield from self._of_api(target(asked, self.address), box)
            return
        for link in self._links:
            if link["rel"] == "item" and name in link["href"]:
                yield read_item(target(link["href"], self.address), allow_network=self._allow_network)

    def _of_api(self, address: str, box: Box) -> Iterator[Item]:
        query = urlencode({"bbox": ",".join(f"{value:.6g}" for value in box), "limit": _LIMIT}, safe=",")
        page: str | None = f"{address}{'&' if '?' in address else '?'}{query}"
        for _ in range(_PAGES):
            if page is None:
                return
            found = read_document(page, allow_network=self._allow_network, paged=True)
            for feature in found.get("features") or ():
                yield item_of(_object(feature, page), page)
            following = [link for link in found.get("links") or () if _is_link(link) and link["rel"] == "next"]
            ours = [link for link in following if str(link.get("method", "GET")).upper() == "GET"]
            page = target(ours[0]["href"], page) if ours else None


@reads(_REMEDY)
def read_collection(address: AnyPath, *, allow_network: bool = False) -> dict[str, Any]:
    """Return the document of a collection, or of a list of items."""
    found = read_document(address, allow_network=allow_network)
    if found.get("type") not in ("Collection", "Catalog", "FeatureCollection"):
        raise InputError("this is no STAC collection", file=address, field="type", remedy=_REMEDY)
    for member in ("links", "features"):
        if not isinstance(found.get(member, []), list):
            raise InputError("this is no list", file=address, field=member, remedy=_REMEDY)
    return found


def _is_link(link: object) -> bool:
    return isinstance(link, dict) and isinstance(link.get("rel"), str) and isinstance(link.get("href"), str)


def _object(feature: Any, address: str) -> Mapping[str, Any]:
    if not isinstance(feature, dict):
        raise InputError("an item is an object", file=address, field="features", remedy=_REMEDY)
    # An API leaves out of its answer what stands in it once.
    return {"stac_version": "1.0.0", **feature} if is_address(address) else feature
