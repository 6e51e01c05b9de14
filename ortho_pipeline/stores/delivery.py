"""Outputs that go to a store of objects: made on this machine, then uploaded, their record last.

A record (``<name>_delivery.json``) lists the files with sizes and SHA-256. An older one is removed before the first
file is uploaded, and the new one is written after the last file agreed with its checksum in the store: with a record,
the files that it lists are whole and belong together.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import STORES, Location
from ortho_pipeline.files.whole import json_text
from ortho_pipeline.runtime.process_limits import thread_pool
from ortho_pipeline.stores.objects import Content, Objects

DOCUMENT, SCHEMA_VERSION = "ortho-pipeline delivery", 1
_RECORD = "_delivery.json"
#: Files that are uploaded at a time.
_AT_ONCE = 4


@dataclass(frozen=True)
class Upload:
    """A local folder whose files are uploaded; afterwards `stored` has the content of each in the store."""

    folder: Path
    stored: dict[str, Content] = field(default_factory=dict)


@contextlib.contextmanager
def delivered(address: str, name: str, *, allow_network: bool, keep: Callable[[Path], bool]) -> Iterator[Upload]:
    """Yield a folder on this machine, whose files are in the folder of objects when the block has ended well.

    Parameters
    ----------
    name : str
        What the outputs are called together; their record is named after it.
    keep : callable (path) -> bool
        Whether a file is uploaded.

    Raises
    ------
    InputError
        If the network is not allowed, or nothing can be written to such an address.
    StorageError
        If the store fails; there is no record then.
    """
    if address.partition("://")[0] not in STORES:
        raise InputError(
            "outputs cannot be written to such an address",
            file=address,
            field="folder",
            remedy=f"use one of {', '.join(STORES)}, or a folder",
        )
    store = Objects(address, allow_network=allow_network)
    with tempfile.TemporaryDirectory(prefix="ortho_") as folder:
        delivery = Upload(Path(folder))
        yield delivery
        delivery.stored.update(_upload(store, Path(folder), f"{name}{_RECORD}", keep))


def _upload(store: Objects, folder: Path, record: str, keep: Callable[[Path], bool]) -> dict[str, Content]:
    """Upload the files and their record; return what each is in the store."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and keep(path))
    names = [path.relative_to(folder).as_posix() for path in paths]
    store.delete(record)
    with thread_pool(_AT_ONCE, "upload") as pool:
        contents = list(pool.map(store.put, names, paths))
    store.put(record, _record_of(names, contents))
    return dict(zip(names, contents, strict=True))


def _record_of(names: list[str], contents: list[Content]) -> bytes:
    files: list[dict[str, Any]] = [
        {"name": name, "bytes": content.size, "sha256": content.sha256}
        for name, content in zip(names, contents, strict=True)
    ]
    return json_text({"document": DOCUMENT, "schema_version": SCHEMA_VERSION, "files": files}).encode()


def address_of(folder: str | os.PathLike[str] | None) -> str | None:
    """Return a folder as address, or None if it is on this machine."""
    return os.fspath(folder) if folder is not None and Location(folder).is_address else None
