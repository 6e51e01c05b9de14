"""Folders of objects: behind ``https://``, and in the stores of ``s3://``, ``gs://`` and ``az://``.

Only complete objects; GDAL reads windows. `obstore` retries temporary failures (429, 5xx, a lost connection) with
increasing pauses, and resumes an interrupted download. Received data are compared with the size and the checksum that
the store states. Credentials are those of the store's own clients (environment, role of the machine). Messages contain
no credentials and no text of a server.
"""

from __future__ import annotations

import collections
import contextlib
import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

from ortho_pipeline.errors import InputError, OrthoError, StorageError
from ortho_pipeline.files.locations import SCHEMES, Location, require_network
from ortho_pipeline.files.traffic import count

#: How often a request is repeated, and for how long, before it has failed.
RETRIES: dict[str, Any] = {
    "max_retries": 8,
    "retry_timeout": timedelta(minutes=3),
    "backoff": {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=15), "base": 2},
}
#: Attempts to download an object whose content differs from what the store states.
_ATTEMPTS = 3
#: Objects that are written on a condition are small (bytes).
_MOST_ON_A_CONDITION = 100_000_000
_TIMEOUTS = {"connect_timeout": "10s", "timeout": "900s"}
_CHUNK = 4 << 20
#: Attributes that are stored with an encrypted object.
_SHA256 = "sha256"
#: Bytes of the parts in which a large object is stored.
PART = 8 << 20
#: The ETag of an object that was stored at once is the MD5 of its content; of one in parts see `Content`.
_TAG = re.compile(r'"?([0-9a-f]{32}(?:-([0-9]+))?)"?')


@dataclass(frozen=True)
class Content:
    """What an object was when it was written or read: its size, checksums, and the store's name of this version.

    That name is its ETag, and in Google's store the number of its generation.
    `tags` are the ETags that stores give such a content: the MD5 of what is stored at once, and for what is stored in
    parts the MD5 of theirs, with their number. `tag` is the ETag that the store gave it when it was written.
    """

    size: int
    sha256: str
    tags: tuple[str, ...]
    version: str | None
    tag: str = ""


class Objects:
    """A folder of objects.

    Parameters
    ----------
    address : str
        Of the folder: ``https://host/folder``, ``s3://bucket/prefix``, ``gs://…``, ``az://…``.
    allow_network : bool

    Raises
    ------
    InputError
        If the network is not allowed, or the address is none of these.
    """

    def __init__(self, address: str, *, allow_network: bool) -> None:
        require_network(address, allow_network)
        if not Location(address).is_address:
            raise InputError(
                "this is not the address of a folder",
                file=address,
                remedy=f"use one of {', '.join(SCHEMES)}, and a name",
            )
        self.address = address.rstrip("/")
        self._store, self._is_on_web = _store_of(self.address), Location(self.address).is_on_web
        self._version = "version" if self.address.startswith("gs://") else "e_tag"
        # The ETag of what is encrypted so is no checksum; the store verifies the SHA-256 that comes with an object.
        self._encrypted = bool(_key_management()) and self.address.startswith("s3://")

    def __repr__(self) -> str:
        return f"Objects({self.address!r})"

    def of(self, name: str) -> str:
        """Return the address of an object in the folder."""
        return f"{self.address}/{name}"

    # -- reading -----------------------------------------------------------------------------------------------------

    def read(self, name: str, limit: int) -> tuple[bytes, Content]:
        """Return an object of at most `limit` bytes, and its `Content`.

        Raises
        ------
        FileNotFoundError
            If it does not exist.
        InputError
            If it is larger, or access is denied.
        StorageError
            If the store does not answer, or the bytes differ from what it states.
        """
        return self._attempts(name, limit, b"".join)

    def fetch(self, name: str, path: Path, limit: int) -> Content:
        """Write an object to a file, which has no other name yet (`files.whole_or_nothing`); see `read`."""

        def write(chunks: Iterator[bytes]) -> None:
            with path.open("wb") as file:
                file.writelines(chunks)

        return self._attempts(name, limit, write)[1]

    def _attempts(self, name: str, limit: int, take: Any) -> tuple[Any, Content]:
        wrong = ""
        for _ in range(_ATTEMPTS):
            with self._errors(name):
                result = self._store.get(name)
                if result.meta["size"] > limit:
                    raise InputError(
                        f"this object has {result.meta['size']} bytes; the limit is {limit}",
                        file=self.of(name),
                        remedy="check the address",
                    )
                digests = _Digests()
                taken = take(digests.through(result.stream(min_chunk_size=_CHUNK), limit))
                content = digests.content(result.meta[self._version])
                count(content.size)
                wrong = _difference(content, result.meta)
                if self._encrypted:
                    wrong = _noted_difference(content, result.meta, result.attributes)
            if not wrong:
                return taken, content
        raise StorageError(
            f"{wrong}, {_ATTEMPTS} times",
            file=self.of(name),
            remedy="try again later; if this persists, the object in the store is damaged",
        )

    def names(self, prefix: str = "") -> Iterator[tuple[str, int]]:
        """Yield names and sizes of the objects whose names begin so; a plain web server lists none."""
        with self._errors(prefix):
            for chunk in self._store.list(prefix or None):
                for item in chunk:
                    yield item["path"], item["size"]

    def stated(self, name: str) -> tuple[int, str]:
        """Return the size of an object and the tag that its store gives this version (empty if it gives none).

        Of a web server without tags it is the date of the last change.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        with self._errors(name):
            found = self._store.head(name)
        return found["size"], found["e_tag"] or (self._is_on_web and found["last_modified"].isoformat()) or ""

    def version(self, name: str) -> str | None:
        """Return the store's name of this version of an object, whose content is not read.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        with self._errors(name):
            found = self._store.head(name)[self._version]
        return None if found is None else str(found)

    def exists(self, name: str) -> bool:
        """Return whether an object exists."""
        try:
            with self._errors(name):
                self._store.head(name)
        except FileNotFoundError:
            return False
        return True

    # -- writing -----------------------------------------------------------------------------------------------------

    def put(self, name: str, data: bytes | Path, *, replacing: str | None = None, new: bool = False) -> Content:
        """Store an object, whole or not at all, and hold the store's checksum against that of the content.

        Parameters
        ----------
        replacing : str, optional
            The version that it takes the place of: not written if another one is there.
        new : bool
            Do not write it if there is one of this name.

        Raises
        ------
        Conflict
            If there is another version, or one at all.
        StorageError
            If the store does not answer, or has other bytes than it was given.
        """
        content = _content(data)
        if new or replacing is not None:
            return self._put_if(name, data, content, "create" if new else {self._version: replacing})
        for _ in range(_ATTEMPTS):
            with self._errors(name):
                result = self._store.put(name, data, attributes=self._note(content), chunk_size=PART, max_concurrency=4)
                if self._encrypted or (result["e_tag"] or "").strip('"') in content.tags:
                    return replace(content, version=result[self._version], tag=result["e_tag"] or "")
                stored = self._store.head(name)
            wrong = _difference(content, stored, ours=True)
            if not wrong and _TAG.fullmatch(stored["e_tag"] or "") is None:
                # As Azure's: an ETag that is a number of the version alone.
                there = self._attempts(name, content.size, collections.deque(maxlen=0).extend)[1]
                wrong = "" if there.sha256 == content.sha256 else "the content differs"
            if not wrong:
                return replace(content, version=stored[self._version], tag=stored["e_tag"] or "")
        with contextlib.suppress(OrthoError):
            self.delete(name)
        gone = "could not be removed" if self.exists(name) else "was removed"
        raise StorageError(
            f"{wrong} after it was written, {_ATTEMPTS} times; it {gone}",
            file=self.of(name),
            remedy="try again; if this persists, check the store and the connection",
        )

    def _put_if(self, name: str, data: bytes | Path, content: Content, mode: Any) -> Content:
        """Store an object on a condition.

        Such a request is not repeated blindly: one whose answer was lost may have been carried out, and would be in its
        own way. What is there tells.
        """
        for attempt in range(_ATTEMPTS):
            wrong, failed = "", None
            try:
                with self._errors(name):
                    result = self._store.put(name, data, attributes=self._note(content), mode=mode, use_multipart=False)
                stated = {"size": content.size, "e_tag": result["e_tag"]}
                if self._encrypted or not (wrong := _difference(content, stated, ours=True)):
                    return replace(content, version=result[self._version])
            except StorageError as error:
                failed = error
            with contextlib.suppress(FileNotFoundError):
                _, there = self.read(name, _MOST_ON_A_CONDITION)
                if there.sha256 == content.sha256:
                    return there
            if isinstance(failed, Conflict) or (failed is not None and attempt == _ATTEMPTS - 1):
                raise failed
            if wrong:
                break
        self.delete(name)
        raise StorageError(
            f"{wrong} after it was written; it was removed",
            file=self.of(name),
            remedy="check the connection to the store",
        )

    def _note(self, content: Content) -> Any:
        """Return attributes with the checksum of an object whose ETag is no checksum."""
        return {_SHA256: content.sha256} if self._encrypted else None

    def delete(self, name: str) -> None:
        """Remove an object; one that is not there is no error."""
        with contextlib.suppress(FileNotFoundError), self._errors(name):
            self._store.delete(name)

    @contextlib.contextmanager
    def _errors(self, name: str) -> Iterator[None]:
        """Convert exceptions to errors in our own words: texts of libraries and servers may have signed addresses."""
        from obstore import exceptions

        try:
            yield
        except FileNotFoundError as error:
            raise FileNotFoundError(2, "there is no such object", self.of(name)) from error
        except (exceptions.AlreadyExistsError, exceptions.PreconditionError) as error:
            raise Conflict("another version of this object is there", file=self.of(name)) from error
        except (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError) as error:
            raise InputError(
                "the store denies access",
                file=self.of(name),
                remedy="set credentials as for the store's own clients (docs/remote.md), or check their permissions",
            ) from error
        except exceptions.BaseError as error:
            raise StorageError(
                f"the request to the store failed ({_status(error)})",
                file=self.of(name),
                remedy="check the address and the network connection, and try again later",
            ) from error


def stated_at(address: str, *, allow_network: bool) -> tuple[int, str]:
    """Return size and tag of a file in a store or on a web server, as `Objects.stated` does.

    Raises
    ------
    InputError
        If it is not there, or access is denied.
    StorageError
        If the store does not answer.
    """
    folder, _, name = address.rpartition("/")
    try:
        return Objects(folder, allow_network=allow_network).stated(name)
    except FileNotFoundError as error:
        raise InputError("file not found", file=address, remedy="check the address") from error


class Conflict(StorageError):
    """Another version of an object is there than the one that was to be replaced."""


class _Digests:
    """Sizes and checksums of what goes through."""

    def __init__(self) -> None:
        self._size = 0
        self._sha256, self._md5 = hashlib.sha256(), hashlib.md5(usedforsecurity=False)
        self._part = hashlib.md5(usedforsecurity=False)
        self._parts: list[bytes] = []

    def through(self, chunks: Iterable[Any], limit: int) -> Iterator[bytes]:
        """Yield the chunks; raise an error beyond `limit` bytes, whatever size the server stated."""
        for chunk in chunks:
            piece = bytes(chunk)
            self._sha256.update(piece)
            self._md5.update(piece)
            self._add_to_parts(piece)
            self._size += len(piece)
            if self._size > limit:
                raise InputError(f"this object has more than {limit} bytes", remedy="check the address")
            yield piece

    def _add_to_parts(self, piece: bytes) -> None:
        at = 0
        while at < len(piece):
            room = PART - (self._size + at) % PART
            self._part.update(piece[at : at + room])
            at += room
            if at <= len(piece):
                self._parts.append(self._part.digest())
                self._part = hashlib.md5(usedforsecurity=False)

    def content(self, version: str | None) -> Content:
        """Return what went through."""
        parts = self._parts + ([self._part.digest()] if self._size % PART else [])
        joined = hashlib.md5(b"".join(parts), usedforsecurity=False).hexdigest()
        tags = (self._md5.hexdigest(), f"{joined}-{len(parts)}")
        return Content(self._size, self._sha256.hexdigest(), tags, version)


def _content(data: bytes | Path) -> Content:
    digests = _Digests()
    if isinstance(data, bytes):
        for _ in digests.through([data], len(data)):
            pass
        return digests.content(None)
    with data.open("rb") as file:
        for _ in digests.through(iter(lambda: file.read(_CHUNK), b""), os.fstat(file.fileno()).st_size):
            pass
    return digests.content(None)


def _difference(content: Content, stated: Mapping[str, Any], *, ours: bool = False) -> str:
    """Return how a content differs from what a store states; empty if it does not.

    The ETag of a multipart upload is not a checksum of the content alone.
    """
    if content.size != stated["size"]:
        return f"{content.size} bytes, but the store states {stated['size']}"
    tag = _TAG.fullmatch(stated["e_tag"] or "")
    if tag is None or tag[1] in content.tags or (tag[2] and not ours):
        return ""
    return "the checksum differs from the one that the store states"


def _noted_difference(content: Content, stated: Mapping[str, Any], attributes: Mapping[str, str]) -> str:
    """Return how a content differs from what was noted when it was encrypted; others note nothing."""
    if content.size != stated["size"]:
        return _difference(content, stated)
    return (
        ""
        if attributes.get(_SHA256, content.sha256) == content.sha256
        else "the checksum differs from the recorded one"
    )


def _status(error: Exception) -> str:
    match = re.search(r"status code: (\d{3})", str(error))
    if match:
        return f"HTTP status {match[1]}"
    return "cannot connect" if "connect" in str(error) else "the connection failed"


def _store_of(address: str) -> Any:
    from obstore import store

    options: Any = {**_TIMEOUTS, "user_agent": "ortho-pipeline"}
    scheme = address.partition("://")[0]
    if scheme == "http" or os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes"):
        options["allow_http"] = True
    settings = _SETTINGS[scheme]() if scheme in _SETTINGS else {}
    if settings.get("endpoint", settings.get("base_url", "")).startswith("http://"):
        options["allow_http"] = True
    make: Any = store.from_url  # one signature for each kind of store
    return make(address, client_options=options, retry_config=RETRIES, **settings)


def _s3_settings() -> dict[str, Any]:
    """Return settings from the variables of GDAL and Amazon's clients that `obstore` does not read itself."""
    settings: dict[str, Any] = {}
    endpoint = os.environ.get("AWS_ENDPOINT_URL") or os.environ.get("AWS_S3_ENDPOINT")
    if endpoint:
        plain = os.environ.get("AWS_HTTPS", "YES").upper() in ("NO", "FALSE", "0")
        settings["endpoint"] = endpoint if "://" in endpoint else f"http{'' if plain else 's'}://{endpoint}"
    if _key_management():
        settings["checksum_algorithm"] = "SHA256"
    if os.environ.get("AWS_NO_SIGN_REQUEST", "").upper() in ("YES", "TRUE", "1"):
        settings["skip_signature"] = True
    return settings


def _azure_settings() -> dict[str, Any]:
    """Return settings from the variables of GDAL and Azure's clients that `obstore` does not read itself."""
    stated = os.environ.get("AZURE_STORAGE_CONNECTION_STRING", "")
    parts = {key: value for key, sign, value in (part.partition("=") for part in stated.split(";")) if sign}
    named = {
        "account_name": parts.get("AccountName") or os.environ.get("AZURE_STORAGE_ACCOUNT"),
        "account_key": parts.get("AccountKey"),
        "endpoint": parts.get("BlobEndpoint") or os.environ.get("AZURE_STORAGE_ENDPOINT"),
    }
    return {key: value for key, value in named.items() if value}


def _google_settings() -> dict[str, Any]:
    """Return settings from the variables of GDAL that `obstore` does not read itself."""
    settings: dict[str, Any] = {}
    endpoint = os.environ.get("CPL_GS_ENDPOINT")
    if endpoint:
        settings["base_url"] = endpoint.rstrip("/")
    if os.environ.get("GS_NO_SIGN_REQUEST", "").upper() in ("YES", "TRUE", "1"):
        settings["skip_signature"] = True
    return settings


#: Settings of the clients of stores, by scheme.
_SETTINGS = {"s3": _s3_settings, "az": _azure_settings, "gs": _google_settings}


def _key_management() -> str | None:
    """Return the kind of encryption with keys of S3's key management that objects get; None for any other."""
    kind = os.environ.get("AWS_SERVER_SIDE_ENCRYPTION", "")
    return kind if kind.startswith("aws:kms") else None
