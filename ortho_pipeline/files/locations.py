"""Where files lie: on disk, in an archive, or behind a URL, by the names that GDAL has for such places.

A `VsiPath` is made by `located`, which asks whether the network is allowed, and from another one. What a file of
strangers says of other files is text, which nothing here opens.
"""

from __future__ import annotations

import contextlib
import errno
import fnmatch
import io
import itertools
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self
from urllib.parse import unquote

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.traffic import count_gdal

#: Schemes of web servers, which give files and neither list nor take any, and GDAL's file systems that read them.
WEB = {"https": "/vsicurl/https://", "http": "/vsicurl/http://"}
#: Schemes of stores, whose objects are also listed and written.
STORES = {"s3": "/vsis3/", "gs": "/vsigs/", "az": "/vsiaz/"}
SCHEMES = WEB | STORES  # of all URLs that are read
_ARCHIVES = ("/vsizip", "/vsitar", "/vsigzip", "/vsi7z", "/vsirar")
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
#: An address of a folder or an object.
_ADDRESS = re.compile(rf"({'|'.join(SCHEMES)})://[^/]")
#: An item and a collection of a STAC API.
_ITEM_OF_API = re.compile(r"https?://[^?]*/collections/[^/?]+/items/[^/?#]+$")
_COLLECTION_OF_API = re.compile(r"https?://[^?#]*/collections/[^/?#]+/?$")
#: What opens a door and stands in an address itself: a name with a password, or what a query calls so.
_NAMED = re.compile(r"(?<=://)[^/?#@]*@")
_SIGNED = re.compile(
    r"[?&;#](?:x-(?:amz|goog|ms|auth)-?[\w-]*|awsaccesskeyid|googleaccessid|h?mac|sig|signature|pass(?:word|wd|phrase)|"
    r"pwd|auth|authorization|bearer|jwt|assertion|code|otp|ticket|credentials?|(?:client)?[_-]?secret|"
    r"(?:api|access|auth|subscription)?[_-]?key|(?:access|auth|sas|session|security|id|refresh)?[_-]?token|"
    r"header\.[\w-]*|\w*userpwd)=",
    re.IGNORECASE,
)
_PAGE = re.compile(r"(?<=[?&])token=[^&]*", re.IGNORECASE)  # the token of a page of answers opens none
_SHOWN, _MOST_ENCODED = 5, 5
#: No more is read at once of a file in an archive or behind a URL: a zip of 1 kB may hold billions of zeros.
MAX_READ = 5_000_000
#: No delivery has more files in a folder; a store behind a URL may.
MAX_LISTED = 10_000


def check_path(path: str | os.PathLike[str]) -> str:
    """Return the remedy where nothing lies at a path: the name in its folder that is most like it, if there is one."""
    import difflib

    place = Path(path)
    if any(mark in str(place) for mark in "*?"):  # brackets are in names of files, too
        return "list the files, or write the pattern without quotes, so that the shell expands it"
    if not place.parent.is_dir():
        return f"check the path: there is no folder '{place.parent}'"
    with contextlib.suppress(OSError), os.scandir(place.parent) as listed:
        names = [entry.name for entry in itertools.islice(listed, MAX_LISTED)]
        if close := difflib.get_close_matches(place.name, names, 1, 0.7):
            return f"did you mean '{place.parent / close[0]}'?"
    return "check the path"


class VsiPath:
    """A file in an archive or behind a URL, with as much of `pathlib.Path` as reading metadata takes."""

    def __init__(self, name: str) -> None:
        self._name = name.rstrip("/")

    def __fspath__(self) -> str:
        return self._name

    def __str__(self) -> str:
        return self._name

    def __repr__(self) -> str:
        return f"VsiPath({self._name!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, VsiPath) and self._name == other._name

    def __lt__(self, other: VsiPath) -> bool:
        return self._name < other._name

    def __hash__(self) -> int:
        return hash(self._name)

    @property
    def name(self) -> str:
        """Last part of the name, without what a URL asks for."""
        return self._name.rpartition("/")[2].partition("?")[0]

    @property
    def stem(self) -> str:
        """The name without its ending."""
        return Path(self.name).stem

    @property
    def suffix(self) -> str:
        """The ending of the name."""
        return Path(self.name).suffix

    @property
    def parent(self) -> VsiPath:
        """The folder; of a server, a bucket or an archive on disk itself."""
        folder = self._name.rpartition("/")[0]
        return self if re.fullmatch(r"/vsi\w+(/\w+:/)?", folder) else VsiPath(folder)

    def with_name(self, name: str) -> VsiPath:
        """Return the file of that name in the same folder."""
        return self.parent / name

    def __truediv__(self, name: str) -> VsiPath:
        if "/" in name or name == "..":
            raise InputError(f"{name!r} is not the name of a file in this folder", file=self._name)
        return VsiPath(f"{self._name}/{name}")

    def with_suffix(self, suffix: str) -> VsiPath:
        """Return the file next to it whose name has another ending."""
        return self.with_name(self.stem + suffix)

    def absolute(self) -> VsiPath:
        """Return the path itself."""
        return self

    def resolve(self) -> VsiPath:
        """Return the path itself: there are no links."""
        return self

    def stat(self) -> Any:
        """Return size and kind.

        Raises
        ------
        FileNotFoundError
        """
        found = self._stat()
        if found is None:
            raise FileNotFoundError(2, "there is no such file", self._name)
        return SimpleNamespace(st_size=found.size)

    def size(self) -> int:
        """Return the bytes of the file; 0 where there is none."""
        found = self._stat()
        return 0 if found is None else int(found.size)

    def exists(self) -> bool:
        """Tell whether there is such a file or folder."""
        return self._stat() is not None

    def is_file(self) -> bool:
        """Tell whether it is a file."""
        found = self._stat()
        return found is not None and not found.IsDirectory()

    def is_dir(self) -> bool:
        """Tell whether it is a folder."""
        found = self._stat()
        return found is not None and bool(found.IsDirectory())

    def iterdir(self) -> Iterator[VsiPath]:
        """Yield what lies in the folder, the first `MAX_LISTED`.

        Raises
        ------
        FileNotFoundError
            If it is none.
        """
        from osgeo import gdal

        try:
            names = gdal.ReadDir(self._name, MAX_LISTED)
        except RuntimeError:
            names = None
        if names is None:
            raise FileNotFoundError(2, "there is no such folder", self._name)
        for name in names:
            if name not in (".", "..", "") and "/" not in name:
                yield self / name

    def glob(self, pattern: str) -> Iterator[VsiPath]:
        """Yield what lies in the folder and has a name of this pattern."""
        return (path for path in self.iterdir() if fnmatch.fnmatchcase(path.name, pattern))

    def read(self, limit: int) -> bytes:
        """Return the first bytes, at most `limit`.

        Raises
        ------
        OSError
            If it cannot be read.
        """
        from osgeo import gdal

        try:
            file = gdal.VSIFOpenL(self._name, "rb")
        except RuntimeError:
            file = None
        if file is None:
            raise FileNotFoundError(2, "there is no such file, or it cannot be reached", self._name)
        try:
            return bytes(gdal.VSIFReadL(1, limit, file) or b"")
        finally:
            gdal.VSIFCloseL(file)

    def read_bytes(self) -> bytes:
        """Return all bytes.

        Raises
        ------
        OSError
            If it cannot be read, or has more than `MAX_READ`, whatever size an archive states of it.
        """
        data = self.read(MAX_READ + 1)
        if len(data) > MAX_READ:
            raise OSError(
                errno.EFBIG,
                f"the file is larger than {MAX_READ // 1_000_000} MB, the limit for reading it at once",
                self._name,
            )
        return data

    def read_text(self, encoding: str = "utf-8") -> str:
        """Return all text."""
        return self.read_bytes().decode(encoding)

    def open(self, mode: str = "r", encoding: str = "utf-8") -> io.BytesIO | io.StringIO:
        """Return the content as a file that is open for reading."""
        if "b" in mode:
            return io.BytesIO(self.read_bytes())
        return io.StringIO(self.read_text(encoding))

    def _stat(self) -> Any:
        from osgeo import gdal

        try:
            return gdal.VSIStatL(self._name)
        except RuntimeError:
            return None


#: What a closed process says to libcurl by way of GDAL: no file has this name, and nobody listens there.
_CLOSED = {
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "GDAL_HTTP_PROXY": "127.0.0.1:1",
    "GDAL_HTTPS_PROXY": "127.0.0.1:1",
    "GDAL_HTTP_MAX_RETRY": "0",
    "GDAL_HTTP_CONNECTTIMEOUT": "1",
    "NO_PROXY": "",
    "no_proxy": "",
}
_closed_with: dict[str, str | None] = {}
#: A request that fails in passing (429, 502, 503, 504, no answer) is repeated by GDAL too, if nobody says otherwise.
_PATIENT = {"GDAL_HTTP_MAX_RETRY": "5", "GDAL_HTTP_RETRY_DELAY": "0.2", "GDAL_HTTP_CONNECTTIMEOUT": "10"}


def close_network() -> None:
    """Keep GDAL in this process and its children from the network until `located` is asked for a place there.

    For a process of the command line: the environment is that of GDAL's host, which a library leaves alone.
    """
    for key, value in _CLOSED.items():
        _closed_with.setdefault(key, os.environ.get(key))
        os.environ[key] = value


def network_is_closed() -> bool:
    """Tell whether this process has been kept from the network, by itself or by its parent."""
    return all(os.environ.get(key) == value for key, value in _CLOSED.items())


def _open_network() -> None:
    for key, value in _closed_with.items():
        if value is None:
            os.environ.pop(key, None)
        else:
            os.environ[key] = value
    _closed_with.clear()
    for key, value in _PATIENT.items():
        os.environ.setdefault(key, value)
    count_gdal()


#: What readers of metadata take.
AnyPath = str | os.PathLike[str]


class Location(str):
    """What a user or a document calls a file or a folder: the same text, which knows what kind of place it is.

    A path on this machine, an address of `SCHEMES`, or a name of GDAL's. Only `archive` looks at the disk.
    """

    __slots__ = ()

    def __new__(cls, name: AnyPath) -> Self:
        """Return the location that has a name."""
        return name if isinstance(name, cls) else super().__new__(cls, os.fspath(name))

    @property
    def is_address(self) -> bool:
        """Whether it is an address of one of `SCHEMES`."""
        return bool(_ADDRESS.match(self))

    @property
    def is_on_web(self) -> bool:
        """Whether it is an address of a web server."""
        return self.startswith(tuple(f"{scheme}://" for scheme in WEB))

    @property
    def is_far(self) -> bool:
        """Whether it is on another machine, where each request takes its time."""
        url = _URL.match(self)
        if url is not None:
            return url[1].lower() in SCHEMES
        return self.startswith("/vsi") and not self.in_archive and not self.startswith("/vsimem")

    @property
    def url(self) -> Location:
        """The address of a file on another machine, also where GDAL's name for it is given; any other name as it is."""
        for scheme, prefix in SCHEMES.items():
            if self.startswith(prefix):
                return Location(f"{scheme}://{self.removeprefix(prefix)}")
        return self

    # -- archives ----------------------------------------------------------------------------------------------------

    @property
    def in_archive(self) -> bool:
        """Whether it is a name of GDAL's that leads into archives on disk and nowhere else."""
        chain = [prefix for prefix in _ARCHIVES if self.startswith((prefix + "/", prefix + "{"))]
        if not chain:
            return False
        # GDAL takes /vsizip//vsicurl/… and /vsizip/vsicurl/… for the same.
        rest = self[len(chain[0]) :]
        if not rest.startswith("/vsi"):
            rest = rest.removeprefix("/")
        rest = rest.removeprefix("{")
        return Location(rest).in_archive if rest.startswith("/vsi") else "://" not in rest

    @property
    def archive(self) -> Path | None:
        """The archive on disk that it leads into; None where there is none."""
        if not self.in_archive:
            return None
        rest = re.sub(r"^(/vsi[a-z0-9]+(/(?=/)|(?=/vsi))|/vsi[a-z0-9]+/)+", "", self).replace("{", "").replace("}", "")
        parts = rest.split("/")
        for count in range(1, len(parts) + 1):
            path = Path("/".join(parts[:count]) or "/")
            if path.is_file():
                return path
        return None

    # -- documents of STAC -------------------------------------------------------------------------------------------

    @property
    def document(self) -> Location:
        """The address of a STAC document, without the key of an asset after its ``#``."""
        return self._parts()[0]

    @property
    def asset(self) -> str:
        """The key of an asset after the ``#`` of a STAC document; empty where there is none."""
        return self._parts()[1]

    def _parts(self) -> tuple[Location, str]:
        text = self.url
        if not (text.is_address or ".json#" in text.lower()):
            return text, ""
        address, _, key = text.partition("#")
        return Location(address), key

    @property
    def is_item(self) -> bool:
        """Whether, by its name, it may be a STAC item: a JSON file, or an address of an API's items."""
        return self.document._is_json() or bool(_ITEM_OF_API.match(self.document))

    @property
    def is_collection(self) -> bool:
        """Whether, by its name, it may be a STAC collection: a JSON file, or a collection of an API."""
        return self.document._is_json() or bool(_COLLECTION_OF_API.match(self.document))

    def _is_json(self) -> bool:
        return self.lower().partition("?")[0].endswith((".json", ".geojson"))


def located(path: AnyPath, *, allow_network: bool = False) -> AnyPath:
    """Return where a file lies that the user named: itself on disk, a `VsiPath` in an archive or behind a URL.

    Parameters
    ----------
    path : path
        A file, a URL (`SCHEMES`), or a name of GDAL's (``/vsizip/scene.zip/scene.tif``, ``/vsicurl/…``).
    allow_network : bool
        Whether anything but files and archives on disk may be read.

    Raises
    ------
    InputError
        If the network is not allowed, or the kind of URL not known.
    """
    if isinstance(path, VsiPath):
        return path
    name = os.fspath(path)
    url = _URL.match(name)
    if url is None and not name.startswith("/vsi"):
        return path
    if url is not None:
        scheme = url[1].lower()
        if scheme == "file":
            return name[url.end() :]
        if scheme not in SCHEMES:
            raise InputError(
                f"URLs with the scheme {scheme!r} are not supported",
                file=name,
                remedy=f"one of {', '.join(SCHEMES)}, or a file",
            )
        name = SCHEMES[scheme] + name[url.end() :]
    if not Location(name).in_archive:
        require_network(os.fspath(path), allow_network)
    return VsiPath(name)


def require_network(address: str, allowed: bool, *, paged: bool = False) -> None:
    """Let this process reach the network, if that is allowed.

    What is read is named in reports, records, models and logs: so an address holds no credentials.

    Parameters
    ----------
    paged : bool
        It is that of one page of many, as a server gave it: its token is no credential.

    Raises
    ------
    InputError
        If it is not allowed, or the address, which is what would be read or written there, holds credentials.
    """
    plain = _decoded(address)
    if _NAMED.search(plain) or _SIGNED.search(_PAGE.sub("", plain) if paged else plain):
        raise InputError(
            "an address must not contain credentials (a password, a signature), because outputs name all their inputs",
            file=re.split("[?#;&]", _NAMED.sub("", plain))[0],
            remedy=f"use {', '.join(f'{one}://' for one in STORES)} with the credentials in the environment",
        )
    if not allowed:
        raise InputError(
            "network access is off by default",
            file=address,
            remedy=Text("allow it with ", Setting("scene.allow_network")),
        )
    _open_network()


def _decoded(address: str) -> str:
    """Return an address without percent signs: what is encoded twice is decoded twice by some servers."""
    for _ in range(_MOST_ENCODED):
        address, before = unquote(address), address
        if address == before:
            break
    return address


def place(name: AnyPath) -> Any:
    """Return the path of a dataset that is open (``dataset.GetDescription()``): a `Path`, or a `VsiPath`.

    Both know names, siblings and content by the methods of `pathlib.Path`: what is written for a folder on disk works
    in an archive as well. `files.read_bounded` reads either with a limit.

    >>> place("/vsizip/order.zip/po_1_pan.tif").with_suffix(".txt").name
    'po_1_pan.txt'
    """
    text = os.fspath(name)
    return VsiPath(text) if text.startswith("/vsi") else Path(text)


def within(path: Path, roots: Iterable[AnyPath]) -> bool:
    """Tell whether a path lies in one of the folders, wherever links lead."""
    resolved = path.resolve()
    return any(resolved.is_relative_to(Path(root).resolve()) for root in roots)


def members(archive: AnyPath, endings: tuple[str, ...] = (".tif", ".ntf", ".jp2", ".xml", ".img")) -> list[str]:
    """Return names by which the images in an archive are opened, the first few."""
    from osgeo import gdal

    prefix = "/vsizip/" if os.fspath(archive).lower().endswith(".zip") else "/vsitar/"
    folder = prefix + os.path.abspath(archive)
    try:
        names = gdal.ReadDirRecursive(folder) or []
    except RuntimeError:
        return []
    return [f"{folder}/{name}" for name in names if name.lower().endswith(endings)][:_SHOWN]
