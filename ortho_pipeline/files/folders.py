"""Names in folders: a folder is listed once while nothing in it is added, removed or renamed.

A scene is looked at a dozen times: by GDAL's gate, by each sensor that asks for its metadata, by the record of a run.
In a folder of 5,000 scenes the lists alone would take ten times as long as the scene.
"""

from __future__ import annotations

import bisect
import os
import re
import stat
import time
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import AnyPath, VsiPath

#: A folder that was changed less than so long ago (s) may be changed again within the same tick of its clock.
_SETTLED = 2.0
#: Lists that are kept.
_MOST = 16
_State = tuple[int, int, int, int]
_kept: dict[str, tuple[_State, Listing]] = {}


def cache_folder() -> Path | None:
    """Return the folder for all that this package keeps for a user; None where the user has no home.

    A relative one, in the environment or for want of a home, would be a folder in the working folder.
    """
    above = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(above):
        above = os.path.expanduser("~/.cache")
    return Path(above) / "ortho-pipeline" if os.path.isabs(above) else None


def listed_paths(paths: Iterable[AnyPath], field: str = "roots") -> tuple[AnyPath, ...]:
    """Return the paths of a caller; of one text each character would be a path, and as a root ``/`` allows all files.

    Raises
    ------
    InputError
        If it is one path in place of a list.
    """
    if isinstance(paths, str | bytes | os.PathLike):
        name = os.fspath(paths)
        raise InputError(f"{name!r} is one path in place of a list", field=field, remedy=f"give [{name!r}]")
    return tuple(paths)


def ignore_working_folder() -> None:
    """Keep libraries and child processes from taking code or settings from the working folder.

    For a process of the command line: the environment is that of its host, which a library leaves alone.
    """
    # Python puts the working folder first where a child process looks for modules.
    os.environ["PYTHONSAFEPATH"] = "1"
    # Without a home, or with a relative one, libraries look for their settings below the working folder.
    if not os.path.isabs(os.path.expanduser("~")):
        os.environ["HOME"] = "/nonexistent"
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        if not os.path.isabs(os.environ.get(name, "/")):
            del os.environ[name]


class Listing:
    """The names in a folder.

    Attributes
    ----------
    names : tuple of str
        Sorted.
    special : frozenset of str
        Those of them that are neither plain files nor folders: links, pipes, devices.

    Examples
    --------
    >>> Listing(["SCENE.TIF", "scene_RPC.TXT", "dem.tif"]).beginning("scene")
    ['SCENE.TIF', 'scene_RPC.TXT']
    """

    def __init__(self, names: Iterable[str], special: Iterable[str] = ()) -> None:
        self.names, self.special = tuple(sorted(names)), frozenset(special)
        self._matching: dict[re.Pattern[str], list[str]] = {}

    @cached_property
    def _lower(self) -> list[tuple[str, str]]:
        return sorted((name.lower(), name) for name in self.names)

    def beginning(self, start: str) -> list[str]:
        """Return the names that begin with `start`, whatever the case of letters."""
        start, found = start.lower(), []
        for index in range(bisect.bisect_left(self._lower, (start, "")), len(self._lower)):
            lower, name = self._lower[index]
            if not lower.startswith(start):
                break
            found.append(name)
        return found

    def named(self, wanted: str) -> list[str]:
        """Return the names that are `wanted`, whatever the case of letters."""
        return [name for name in self.beginning(wanted) if name.lower() == wanted.lower()]

    def matching(self, pattern: re.Pattern[str]) -> list[str]:
        """Return the names that a pattern matches from their beginning; each is asked once."""
        if pattern not in self._matching:
            self._matching[pattern] = [name for name in self.names if pattern.match(name)]
        return self._matching[pattern]


def listing(folder: AnyPath) -> Listing:
    """Return the names in a folder.

    Raises
    ------
    OSError
        If it cannot be listed.

    Examples
    --------
    >>> listing("sample_data").named("SCENE.TIF")
    ['scene.tif']
    """
    if isinstance(folder, VsiPath):
        return Listing(one.name for one in folder.iterdir())
    key, state = os.path.abspath(folder), _state(folder)
    kept = _kept.get(key)
    if kept is not None and kept[0] == state:
        return kept[1]
    with os.scandir(folder) as entries:
        found = [
            (entry.name, entry.is_file(follow_symlinks=False) or entry.is_dir(follow_symlinks=False))
            for entry in entries
        ]
    made = Listing((name for name, _ in found), (name for name, plain in found if not plain))
    if time.time() - max(state[2:]) / 1e9 > _SETTLED and _state(folder) == state:
        while len(_kept) >= _MOST:
            _kept.pop(next(iter(_kept)), None)
        _kept[key] = state, made
    return made


def _state(folder: str | os.PathLike[str]) -> _State:
    stat = os.stat(folder)
    return stat.st_dev, stat.st_ino, stat.st_ctime_ns, stat.st_mtime_ns


def is_removable(path: str | os.PathLike[str]) -> bool:
    """Return whether a path, which a record may state, is a file or a link, and can be one."""
    return os.path.isfile(path) or os.path.islink(path)


def require_replaceable(path: Path) -> None:
    """Refuse an output in place of a device, or of a file that only its owner may replace.

    Raises
    ------
    InputError
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(
            "this is a device, a pipe or a socket; outputs do not replace it",
            file=path,
            remedy="choose another path",
        )
    if os.name == "nt" or not os.path.lexists(path):
        return
    folder, file = os.stat(path.parent), os.lstat(path)
    if folder.st_mode & stat.S_ISVTX and os.geteuid() not in (0, folder.st_uid, file.st_uid):
        raise InputError(
            "this file belongs to another user, and in this folder only owners may replace files (sticky bit)",
            file=path,
            remedy="choose another folder, or let its owner remove it",
        )
