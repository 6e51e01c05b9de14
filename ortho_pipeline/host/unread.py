"""Images whose orientation lies beside them in a form that no sensor opens by itself: what was recognised."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import read_bounded
from ortho_pipeline.files.locations import place

_RECONSTRUCTIONS = ("reconstruction.json", "opensfm/reconstruction.json")
#: Names of orthority's files of cameras and of orientations.
_INTERIOR, _EXTERIOR = re.compile(r"int_param.*\.ya?ml$", re.I), re.compile(r"ext_param.*\.(geojson|csv)$", re.I)
_NUMBERS = r"(?:[\s,;]+[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?){6}"
_TABLE_BYTES = 1_000_000
_BY_HAND = Text(
    "this version reads a camera file (JSON) and a table of orientations (CSV): write them as ",
    "docs/formats/frame.md shows, and give ",
    Setting("scene.sensor_options", "FILE", key="camera"),
    " ",
    Setting("scene.sensor_options", "FILE", key="exterior"),
    " ",
    Setting("scene.sensor_options", "DATUM", key="vertical"),
)


class Unread(NamedTuple):
    """What was recognised, and what can be done with it today."""

    what: str
    remedy: str


def unread(dataset: Any) -> Unread | None:
    """Return what lies beside an image, or in it, that tells of its orientation; None if nothing does."""
    image = place(dataset.GetDescription())
    if isinstance(image, Path):
        for file in (folder / name for folder in (image.parent, image.parent.parent) for name in _RECONSTRUCTIONS):
            if file.is_file():
                options = Text(
                    Setting("scene.sensor_options", str(file), key="exterior"),
                    " ",
                    Setting("scene.sensor_options", "ellipsoid", key="vertical"),
                )
                return Unread(
                    f"it lies in an OpenDroneMap or OpenSfM project ({file})",
                    Text("name the reconstruction: ", options, ", or the datum of its altitudes in place of ellipsoid"),
                )
        if files := list(_of_orthority(image.parent)):
            return Unread(f"it lies in an orthority project ({', '.join(files)})", _BY_HAND)
        if table := _table_of(image):
            return Unread(f"{table} has six numbers for it, which look like an exterior orientation", _BY_HAND)
    tags = {**(dataset.GetMetadata() or {}), **(dataset.GetMetadata("EXIF") or {})}
    if "EXIF_GPSLatitude" in tags:
        camera = " ".join(str(tags[key]).strip() for key in ("EXIF_Make", "EXIF_Model") if tags.get(key))
        return Unread(f"it is a photo with its GPS position in EXIF{f' ({camera})' if camera else ''}", _BY_HAND)
    return None


def _of_orthority(folder: Path) -> Iterator[str]:
    """Yield the names of orthority's files of parameters in a folder."""
    names = os.listdir(folder) if folder.is_dir() else []
    return (name for name in sorted(names) if _INTERIOR.search(name) or _EXTERIOR.search(name))


def _table_of(image: Path) -> str | None:
    """Return the name of a text beside an image that has its name and six numbers in one line."""
    row = re.compile(rf"^\s*\"?{re.escape(image.stem)}(?:\.\w{{1,5}})?\"?{_NUMBERS}", re.M | re.I)
    for name in sorted(os.listdir(image.parent)) if image.parent.is_dir() else ():
        file = image.parent / name
        small = file.suffix.lower() in (".txt", ".csv") and file.is_file() and file.stat().st_size <= _TABLE_BYTES
        with contextlib.suppress(InputError):  # what cannot be read tells nothing
            if small and row.search(read_bounded(file, _TABLE_BYTES).decode("utf-8", "replace")):
                return name
    return None
