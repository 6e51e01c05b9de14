"""Which files belong to a CARTOSAT-1 image: its metadata, its RPC, and the other image of the pair.

=====================================  ====================================================================
image                                  next to it (in any mixture of upper and lower case that vendors use)
=====================================  ====================================================================
``BANDA.tif``, ``BANDF.tif``           ``BANDA_MET.TXT``, ``BANDA_RPC.TXT`` …, aft and fore
``<name>_A.tif``, ``<name>_F.tif``     ``<name>_A_MET.TXT``, ``<name>_A_RPC.TXT`` …
``PRODUCT.tif``                        ``product_met.txt``, ``PRODUCT_RPC.TXT`` …, a folder for each image
=====================================  ====================================================================

An RPC is the first of ``<image>_RPC_ORG.TXT``, ``DECRYPTED_<image>_RPC.TXT`` and ``<image>_RPC.TXT`` that is RPC text:
the last one may be encrypted.
"""

from __future__ import annotations

import re
from os import PathLike
from pathlib import Path

from ortho_cartosat.metadata import Metadata, read_metadata
from ortho_pipeline.plugin import RPC, InputError, Notice, place, read_rpc_text

#: Image names that show which of the two images it is.
_SIDE = re.compile(r"(.*(?:band|_|-))([af])", re.IGNORECASE)
_OTHER = {"a": "f", "f": "a", "A": "F", "F": "A"}
_VIEW = {"a": "aft", "f": "fore"}
#: Limit on sibling folders: no delivery has more, but a shared disk may.
MAX_FOLDERS = 200


def beside(image: str | PathLike[str], before: str, after: str) -> Path | None:
    """Return the file ``<before><stem><after>`` next to an image, in the usual cases of letters; None without it."""
    path = place(image)
    for stem in dict.fromkeys((path.stem, path.stem.upper(), path.stem.lower())):
        head, tail = before + stem, after.removesuffix("TXT")
        for name in (head + tail + "TXT", head + tail + "txt", f"{before.lower()}{stem}{tail.lower()}txt"):
            try:
                if path.with_name(name).is_file():
                    return path.with_name(name)
            except (OSError, ValueError):
                return None
    return None


def metadata_of(image: str | PathLike[str]) -> Path | None:
    """Return the path of the metadata of an image; None without it."""
    return beside(image, "", "_MET.TXT")


def rpc_of(image: str | PathLike[str]) -> tuple[RPC | None, Path | None, list[Notice]]:
    """Return the first readable RPC next to an image, its file, and warnings about unreadable ones."""
    warnings: list[Notice] = []
    for before, after in (("", "_RPC_ORG.TXT"), ("DECRYPTED_", "_RPC.TXT"), ("", "_RPC.TXT")):
        path = beside(image, before, after)
        if path is None:
            continue
        try:
            return read_rpc_text(path), path, warnings
        except InputError as error:
            what = error.message if error.field is None else f"{error.field}: {error.message}"
            text = f"{path.name} cannot be read; it may be encrypted or damaged ({what})"
            warnings.append(Notice("rpc-not-used", text, file=path.name))
    return None, None, warnings


def view_of(image: str | PathLike[str], metadata: Metadata) -> str | None:
    """Return 'fore' or 'aft' from the file name, or else from the metadata; None if neither states it.

    Raises
    ------
    InputError
        If the two contradict each other.
    """
    named = _SIDE.fullmatch(Path(image).stem)
    by_name, by_text = None if named is None else _VIEW[named[2].lower()], metadata.view
    if by_name and by_text and by_name != by_text:
        raise InputError(
            f"this is the {by_name} image by its file name, but the {by_text} image by its metadata",
            file=metadata.path,
            field="Sensor",
            remedy="keep the files of each image together, or state fore or aft with the sensor option view",
        )
    return by_text or by_name


def partner_of(image: str | PathLike[str], metadata: Metadata) -> Path | None:
    """Return the other image of the stereo pair: next to this one, or in a folder next to its own.

    None without it, and if several folders have one.
    """
    path = place(image)
    named = _SIDE.fullmatch(path.stem)
    name = (path.stem if named is None else named[1] + _OTHER[named[2]]) + path.suffix
    if named is not None and _is_partner(path.with_name(name), metadata):
        return path.with_name(name)
    own = path.absolute().parent
    try:
        folders = sorted(folder for folder in own.parent.iterdir() if folder != own and folder.is_dir())
    except OSError:
        return None
    partners = [folder / name for folder in folders[:MAX_FOLDERS] if _is_partner(folder / name, metadata)]
    return partners[0] if len(partners) == 1 else None


def _is_partner(candidate: Path, metadata: Metadata) -> bool:
    """Return whether an image is from the same pass and the other camera, according to both metadata files."""
    path = metadata_of(candidate) if candidate.is_file() else None
    if path is None:
        return False
    try:
        other = read_metadata(path)
        views = {view_of(candidate, other), metadata.view}
        return (
            other.is_cartosat1
            and len(views) == 2
            and all(other.text(key) == metadata.text(key) for key in ("DateOfPass", "Path", "Row"))
        )
    except InputError:
        return False
