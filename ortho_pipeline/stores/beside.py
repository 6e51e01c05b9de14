"""Questions about files behind URLs and what lies beside them, asked at once.

GDAL and its readers of metadata, and sensors, look for some fifty side-cars of an image. A store lists a folder with
one answer; a web server is asked for one name after the other, and each question takes as long as the way there and
back. GDAL remembers answers: what was asked here together is known when it is asked again one by one. A name that is
not in these lists is only found later.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

from ortho_pipeline.files.locations import AnyPath, Location, VsiPath, located
from ortho_pipeline.runtime.process_limits import thread_pool

#: Questions at a time.
_AT_ONCE = 16
#: What follows the whole name of an image, its stem, its stem in capitals, and what stands before the rest of its stem.
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
#: GDAL's names of what has been asked for by this process.
_known: set[str] = set()


def ask_beside(*paths: AnyPath | None, allow_network: bool = False) -> None:
    """Ask servers for files and what may lie beside them, unless that was done; files of this machine are left alone.

    Nothing is an error here: who opens the file is told what is wrong.

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
    """Yield what is asked for beside a file: nothing where the folder is listed."""
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
