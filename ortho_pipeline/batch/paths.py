"""Locations in a pipeline file: paths in its root on this machine, and addresses of other machines."""

from __future__ import annotations

import fnmatch
import glob
import itertools
import os
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.locations import Location, VsiPath, located
from ortho_pipeline.stores.objects import Objects

_WALKS, _PATTERN_BYTES = 2, 1000
#: No store has more objects behind a pattern.
_MOST_LISTED = 1_000_000
Place: TypeAlias = Path | VsiPath


class PipelinePaths:
    """Resolves names in a pipeline file.

    Names are relative to the file. Of a file on this machine they stay in its root wherever links lead; a file on
    another one leads to no file of this one.

    Parameters
    ----------
    file : path or address
    root : path, optional
        Folder that contains all paths; by default that of the file.
    allow_network : bool
        Allow addresses.
    """

    def __init__(self, file: str | os.PathLike[str], root: str | os.PathLike[str] | None, allow_network: bool) -> None:
        self.file: str | os.PathLike[str] = file
        self.far, self.allow_network = Location(file).is_far, allow_network
        self.base = Path() if self.far else Path(os.path.abspath(file)).parent
        self.address = Location(file).url.rpartition("/")[0] if self.far else ""
        self.root = self.base.resolve() if root is None else Path(root).resolve()

    def inside(self, text: str, field: str) -> Path:
        """Return an absolute path on this machine, which must be inside the root after resolving links."""
        if "\0" in text or "://" in text or text.startswith("/vsi"):
            raise InputError(
                f"{text!r} is not the path of a local file", file=self.file, field=field, remedy="give a local file"
            )
        path = Path(os.path.abspath(self.base / text))
        try:
            resolved = path.resolve()
            path.is_file()
        except (OSError, RuntimeError, ValueError) as error:
            # Names longer than the file system's, links in a circle, surrogates.
            reason = getattr(error, "strerror", None) or error
            raise InputError(
                f"{text[:60]!r} is not the path of a file ({reason})",
                file=self.file,
                field=field,
                remedy="check the name and its symbolic links",
            ) from error
        if not resolved.is_relative_to(self.root):
            raise InputError(
                f"{text} is outside the root folder {self.root}",
                file=self.file,
                field=field,
                remedy=Text(
                    "move it there, or allow a common folder with ",
                    Setting("root", str(self._common(path.resolve()))),
                ),
            )
        return path

    def of(self, text: str, field: str) -> Place:
        """Return the place of a file: a path, or an address."""
        if Location(text).is_address:
            return self._located(text, field)
        return self._located(self._address(text, field), field) if self.far else self.inside(text, field)

    def name(self, text: str, field: str) -> str:
        """Return the place of a file as text: an absolute path, or an address."""
        if Location(text).is_address:
            self._located(text, field)
            return text
        return self._address(text, field) if self.far else str(self.inside(text, field))

    def matching(self, pattern: str, field: str) -> list[Place]:
        """Return the files that match a pattern, by name."""
        if len(os.fsencode(pattern)) > _PATTERN_BYTES or pattern.split("/").count("**") > _WALKS:
            # Every ** walks all folders below each that the one before it found.
            raise InputError(
                f"{pattern[:60]!r} is too complex a pattern",
                file=self.file,
                field=field,
                remedy=f"use at most {_WALKS} times ** and {_PATTERN_BYTES} bytes",
            )
        if Location(pattern).is_address or self.far:
            text = pattern if Location(pattern).is_address else self._address(pattern, field)
            return [self._located(address, field) for address in self._listed(text, field)]
        # Nothing outside of the root is searched either.
        parts = pattern.split("/")
        fixed = "/".join(itertools.takewhile(lambda part: not glob.has_magic(part), parts))
        self.inside(fixed or ("/" if pattern.startswith("/") else "."), field)
        names = set(_found("/" if pattern.startswith("/") else str(self.base), [part for part in parts if part]))
        return [Path(os.path.abspath(name)) for name in sorted(names) if os.path.isfile(name)]

    def _located(self, address: str, field: str) -> VsiPath:
        if not self.allow_network:
            raise InputError(
                f"network access is off by default, and {address!r} is on another machine",
                file=self.file,
                field=field,
                remedy=Text("add ", Setting("scene.allow_network"), ", or give a local file"),
            )
        place = located(address, allow_network=self.allow_network)
        assert isinstance(place, VsiPath)
        return place

    def _address(self, text: str, field: str) -> str:
        """Return the address of what a file on another machine names."""
        parts = text.split("/")
        if "\0" in text or "://" in text or text.startswith("/") or ".." in parts:
            raise InputError(
                f"{text[:200]!r} is not below the folder of the pipeline file",
                file=self.file,
                field=field,
                remedy="give a path relative to that folder, or a full address",
            )
        return "/".join([self.address, *(part for part in parts if part not in ("", "."))])

    def _listed(self, pattern: str, field: str) -> list[str]:
        """Return the addresses of the objects that match a pattern."""
        if not glob.has_magic(pattern):
            return [pattern]
        scheme, _, rest = pattern.partition("://")
        parts = rest.split("/")
        fixed = list(itertools.takewhile(lambda part: not glob.has_magic(part), parts))
        if Location(pattern).is_on_web or not fixed:
            raise InputError(
                "patterns cannot search a web server",
                file=self.file,
                field=field,
                remedy="name the images one by one, or use a pattern in an object store",
            )
        wanted = parts[len(fixed) :]
        folder = f"{scheme}://{'/'.join(fixed)}"
        names = Objects(folder, allow_network=self.allow_network).names()
        listed = (name for name, _ in itertools.islice(names, _MOST_LISTED) if _fits(name.split("/"), wanted))
        return [f"{folder}/{name}" for name in sorted(listed)]

    def _common(self, place: Path) -> str:
        return os.path.commonpath([self.base.resolve(), place if place.is_dir() else place.parent])


def _fits(name: Sequence[str], pattern: Sequence[str]) -> bool:
    """Return whether the parts of a name match a pattern; ``**`` is any number of folders."""
    if not pattern:
        return not name
    if pattern[0] == "**":
        rest = pattern[1:] or ["*"]
        return any(_fits(name[skipped:], rest) for skipped in range(len(name)))
    return bool(name) and fnmatch.fnmatchcase(name[0], pattern[0]) and _fits(name[1:], pattern[1:])


def _found(base: str, parts: Sequence[str]) -> Iterator[str]:
    """Yield what a pattern matches below a folder.

    ``**`` walks no linked folders, as in shells: two links that lead up again would give 2 to the power of 40 paths.
    """
    at = parts.index("**") if "**" in parts else len(parts)
    tops = glob.iglob(os.path.join(glob.escape(base), *parts[:at]))
    if at == len(parts):
        yield from tops
        return
    for top in tops:
        for folder, names, _ in os.walk(top):
            names[:] = [name for name in names if not name.startswith(".")]
            yield from _found(folder, parts[at + 1 :] or ["*"])


def key_of_name(name: str) -> str:
    """Return a key that is equal for names that are one file where case, or the encoding of é, is ignored.

    >>> key_of_name("Scene") == key_of_name("scene")
    True
    """
    return unicodedata.normalize("NFC", name).casefold()
