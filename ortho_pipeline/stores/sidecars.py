"""Parallel requests for files behind URLs and their sidecars.

GDAL, its readers of metadata, and sensors search about fifty sidecars of an image. A store lists a folder with one
answer, but a web server needs a request for each name, and each request is a full round trip. GDAL caches the answers:
after these parallel requests it knows the names when it searches them one by one. A name that is not in these lists is
only searched later.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

from ortho_pipeline.files.locations import AnyPath, Location, VsiPath, located
from ortho_pipeline.runtime.process_limits import thread_pool

#: Questions at a time.
_AT_ONCE = 16
#: Endings after the name of an image, after its stem, after its stem in capitals; and beginnings before its stem.
_AFTER_NAME = (".ovr", ".msk", ".aux.xml", ".aux", ".AUX", ".OVR", ".MSK")
_AFTER_STEM = (
    "_rpc.txt",
    "_RPC.TXT",
    ".RPB",
    ".rpb",
    ".IMD",
    ".imd",
    ".RPC",
    ".rpc",
    ".XML",
    ".xml",
    ".TXT",
    ".txt",
    ".PVL",
    ".pvl",
    "_metadata.txt",
    "_METADATA.txt",
    "_metadata.xml",
    "_METADATA.XML",
    "_MTL.txt",
    "_MTL.TXT",
    ".pass",
    ".PASS",
    ".aux",
    ".AUX",
    ".tab",
    ".TAB",
    ".wld",
    ".WLD",
    "_survey.txt",
    "_MET.TXT",
    "_MET.txt",
    "_met.txt",
    "_extended.json",
)
_AFTER_UPPER = ("_MET.TXT", "_MET.txt", "_met.txt")
_BEFORE_REST = ("HDR", "RPC")
#: Names of their own in the folder.
_IN_FOLDER = ("METADATA.DIM", "metadata.dim", "summary.txt", "SUMMARY.TXT")
#: GDAL reads this much of a file before it knows what it is.
_HEADER = 16_384
#: GDAL's names of the files that this process has requested.
_known: set[str] = set()


def ask_beside(*paths: AnyPath | None, allow_network: bool = False) -> None:
    """Request remote files and their possible sidecars once; local files are ignored.

    A missing file is no error here; it is one when the file is opened.

    Raises
    ------
    InputError
        If the network is not allowed.
    """
    far_paths = (path for path in paths if path is not None and Location(path).is_far)
    far = {os.fspath(located(path, allow_network=allow_network)) for path in far_paths}
    new = [VsiPath(name) for name in sorted(far - _known)]
    if not new:
        return
    _known.update(far)
    with thread_pool(_AT_ONCE, "beside") as pool:
        for path in new:
            pool.submit(path.read, _HEADER)
        for path in new:
            for name in _questions(path):
                pool.submit(name.exists)


def _questions(path: VsiPath) -> Iterator[VsiPath]:
    """Yield the names to request next to a file; none if the folder is listed."""
    if not str(path).startswith("/vsicurl/"):
        return
    rest, letters = path.stem[3:], path.suffix[1:]
    world = {letters[:1] + letters[-1:] + "w", letters + "w"}
    names = [
        *(path.name + end for end in _AFTER_NAME),
        *(path.stem + end for end in _AFTER_STEM),
        *(f"{path.stem}.{end}" for one in world for end in (one, one.upper())),
        *(f"{path.stem.upper()}{end}" for end in _AFTER_UPPER),
        *(f"{first}{rest}{end}" for first in _BEFORE_REST for end in (".txt", ".TXT")),
        *_IN_FOLDER,
    ]
    for name in names:
        yield path.with_name(name)
