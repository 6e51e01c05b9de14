"""STAC documents, local or remote, and their references to other places."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

from ortho_pipeline.errors import InputError, StorageError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.locations import AnyPath, Location, require_network, within
from ortho_pipeline.files.reading import parse_json, read_json
from ortho_pipeline.files.traffic import count
from ortho_pipeline.stores.objects import Objects

#: Types of documents that hold items, or lead to them.
COLLECTIONS = ("Collection", "Catalog", "FeatureCollection")
REMEDY = "give a valid STAC item (a JSON object with stac_version, type and assets)"
_MAX_BYTES = 20_000_000
_ATTEMPTS, _PAUSE, _TIMEOUT = 5, 0.2, 30.0
#: Answers that may be others a moment later.
_PASSING = (408, 429, 500, 502, 503, 504)


def read_document(address: AnyPath, *, allow_network: bool, paged: bool = False) -> dict[str, Any]:
    """Return the JSON object in a file, an object of a store, or the answer of a server (`paged`: one of many).

    Raises
    ------
    InputError
        If it is none, there is none, or the network is not allowed.
    StorageError
        If a server does not answer.
    """
    text = Location(address).url
    if text.is_on_web:
        require_network(text, allow_network, paged=paged)
        document = parse_json(_answer(text), text, REMEDY)
    elif text.is_address:
        folder, _, name = text.rpartition("/")
        try:
            document = parse_json(Objects(folder, allow_network=allow_network).read(name, _MAX_BYTES)[0], text, REMEDY)
        except FileNotFoundError as error:
            raise InputError("there is no such object", file=text, remedy="check the address") from error
    else:
        document = read_json(text, _MAX_BYTES, REMEDY)
    if not isinstance(document, dict):
        raise InputError("this is not a JSON object", file=text, remedy=REMEDY)
    return document


def _answer(url: str) -> bytes:
    import http.client
    import urllib.error
    import urllib.request

    class WebOnly(urllib.request.HTTPRedirectHandler):
        """Follows to web servers only."""

        def redirect_request(self, req: Any, fp: Any, code: Any, msg: Any, headers: Any, newurl: str) -> Any:
            return super().redirect_request(req, fp, code, msg, headers, newurl) if Location(newurl).is_on_web else None

    opener = urllib.request.build_opener(WebOnly)
    request = urllib.request.Request(url, headers={"User-Agent": "ortho-pipeline", "Accept": "application/json"})
    failure = ""
    for attempt in range(_ATTEMPTS):
        if attempt:
            time.sleep(_PAUSE * 2**attempt)
        try:
            with opener.open(request, timeout=_TIMEOUT) as reply:
                data = bytes(reply.read(_MAX_BYTES + 1))
                if reply.length and len(data) <= _MAX_BYTES:  # the connection ended before the answer
                    raise http.client.IncompleteRead(data, reply.length)
        except urllib.error.HTTPError as error:
            if error.code not in _PASSING:
                raise InputError(
                    f"the server refuses this document (HTTP status {error.code})",
                    file=url,
                    remedy="check the address",
                ) from error
            failure = f"HTTP status {error.code}"
        except (OSError, http.client.HTTPException) as error:
            failure = f"no answer ({type(error).__name__})"
        else:
            if len(data) > _MAX_BYTES:
                raise InputError(f"this document is larger than {_MAX_BYTES // 1_000_000} MB", file=url, remedy=REMEDY)
            count(len(data))
            return data
    raise StorageError(f"the request to the server failed ({failure})", file=url, remedy="try again later")


def target(href: str, base: AnyPath, roots: tuple[AnyPath, ...] = ()) -> str:
    """Return the place that a document at `base` names: an address, or a path below its own folder or `roots`.

    Raises
    ------
    InputError
        If it is a file elsewhere on this machine: the document may be a stranger's.
    """
    text, here = Location(href.strip()), Location(base).url
    if text.is_address:
        return text
    if not text or "\0" in text or text.startswith("/vsi") or (":" in text.partition("/")[0] and "://" in text):
        raise InputError(f"{text[:200]!r} is not the address of a file", file=base, field="href", remedy=REMEDY)
    if here.is_address:
        if here.is_on_web:
            return urljoin(here, text)
        scheme, _, rest = here.partition("://")
        return f"{scheme}://{os.path.normpath(os.path.join(os.path.dirname(rest), text.lstrip('/')))}"
    path = Path(here).parent / text
    if not within(path, [Path(here).resolve().parent, Path(here).parent, *roots]):
        raise InputError(
            f"this refers to {text[:200]!r}, which is outside its own folder",
            file=base,
            field="href",
            remedy=Text("put the files into one folder, or allow another one with ", Setting("scene.roots", "DIR")),
        )
    return os.fspath(path)
