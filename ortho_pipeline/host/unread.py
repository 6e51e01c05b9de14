"""Images whose orientation is next to them in a form that no sensor opens automatically: what was recognised."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import read_bounded
from ortho_pipeline.files.locations import place

_NUMBERS = r"(?:[\s,;]+[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?){6}"
_TABLE_BYTES = 1_000_000


class Unread(NamedTuple):
    """What was recognised, and the remedy."""

    what: str
    remedy: str


def unread(dataset: Any) -> Unread | None:
    """Return what describes the orientation of an image, next to it or in it; None if nothing does."""
    image = place(dataset.GetDescription())
    if isinstance(image, Path) and (table := _table_of(image)):
        remedy = Text(
            "give it with a camera file (docs/formats/frame.md): ",
            Setting("scene.sensor_options", str(image.parent / table), key="exterior"),
            " ",
            Setting("scene.sensor_options", "FILE", key="camera"),
            " ",
            Setting("scene.sensor_options", "EPSG:N", key="crs"),
            " ",
            Setting("scene.sensor_options", "DATUM", key="vertical"),
        )
        return Unread(f"{table} seems to have an exterior orientation for this image (six numbers)", remedy)
    return None


def _table_of(image: Path) -> str | None:
    """Return the name of a text file next to an image with a line of the image's name and six numbers."""
    row = re.compile(rf"^[ \t]*\"?{re.escape(image.stem)}(?:\.\w{{1,5}})?\"?{_NUMBERS}", re.M | re.I)
    for name in sorted(os.listdir(image.parent)) if image.parent.is_dir() else ():
        file = image.parent / name
        small = file.suffix.lower() in (".txt", ".csv") and file.is_file() and file.stat().st_size <= _TABLE_BYTES
        with contextlib.suppress(InputError):  # skip files that cannot be read
            if small and row.search(read_bounded(file, _TABLE_BYTES).decode("utf-8", "replace")):
                return name
    return None
