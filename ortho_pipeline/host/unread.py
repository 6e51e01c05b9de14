"""Images whose orientation is next to them in a form that no sensor opens automatically: what was recognised."""

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
    "write a camera file (JSON) and a table of orientations (CSV) as in docs/formats/frame.md, and give ",
    Setting("scene.sensor_options", "FILE", key="camera"),
    " ",
    Setting("scene.sensor_options", "FILE", key="exterior"),
    " ",
    Setting("scene.sensor_options", "DATUM", key="vertical"),
)


class Unread(NamedTuple):
    """What was recognised, and the remedy."""

    what: str
    remedy: str


def unread(dataset: Any) -> Unread | None:
    """Return what describes the orientation of an image, next to it or in it; None if nothing does."""
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
                    f"this image belongs to an OpenDroneMap or OpenSfM project ({file})",
                    Text("give ", options, " (replace ellipsoid if its altitudes have another datum)"),
                )
        if files := list(_of_orthority(image.parent)):
            return Unread(f"this image belongs to an orthority project ({', '.join(files)})", _BY_HAND)
        if table := _table_of(image):
            return Unread(f"{table} seems to have an exterior orientation for this image (six numbers)", _BY_HAND)
    tags = {**(dataset.GetMetadata() or {}), **(dataset.GetMetadata("EXIF") or {})}
    if "EXIF_GPSLatitude" in tags:
        camera = " ".join(str(tags[key]).strip() for key in ("EXIF_Make", "EXIF_Model") if tags.get(key))
        return Unread(f"this is a photo with a GPS position in EXIF{f' ({camera})' if camera else ''}", _BY_HAND)
    return None


def _of_orthority(folder: Path) -> Iterator[str]:
    """Yield the names of orthority's parameter files in a folder."""
    names = os.listdir(folder) if folder.is_dir() else []
    return (name for name in sorted(names) if _INTERIOR.search(name) or _EXTERIOR.search(name))


def _table_of(image: Path) -> str | None:
    """Return the name of a text file next to an image with a line of the image's name and six numbers."""
    row = re.compile(rf"^\s*\"?{re.escape(image.stem)}(?:\.\w{{1,5}})?\"?{_NUMBERS}", re.M | re.I)
    for name in sorted(os.listdir(image.parent)) if image.parent.is_dir() else ():
        file = image.parent / name
        small = file.suffix.lower() in (".txt", ".csv") and file.is_file() and file.stat().st_size <= _TABLE_BYTES
        with contextlib.suppress(InputError):  # skip files that cannot be read
            if small and row.search(read_bounded(file, _TABLE_BYTES).decode("utf-8", "replace")):
                return name
    return None
