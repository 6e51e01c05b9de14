"""Paths in commands that people paste into a shell."""

from __future__ import annotations

import os
import re
import shlex


def typed(path: str | os.PathLike[str]) -> str:
    """Return a path as it is typed in a shell.

    >>> typed("my scene.tif")
    "'my scene.tif'"
    """
    return shlex.quote(os.fspath(path))


def typed_pattern(pattern: str) -> str:
    """Return a pattern of files as it is typed in a shell, which expands its wildcards.

    >>> typed_pattern("my cells/*.tif")
    'my\\\\ cells/*.tif'
    """
    return re.sub(r"([^\w./*?\[\]!-])", r"\\\1", pattern)


def converted(path: str | os.PathLike[str], what: str) -> str:
    """Return a file and a new GeoTIFF in the working folder, as they are typed after a program that converts one.

    >>> converted("scenes/pan.vrt", "tiled")
    'scenes/pan.vrt pan_tiled.tif'
    """
    stem = re.split(r"[/\\]", os.fspath(path))[-1].rpartition(".")
    return f"{typed(path)} {typed(f'{stem[0] or stem[2]}_{what}.tif')}"
