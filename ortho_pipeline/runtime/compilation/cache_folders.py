"""Folders in which compiled kernels are kept, and who may have written there.

Kept kernels are machine code and pickles: whoever writes them runs code as whoever loads them. So a folder is used if
it belongs to this user, and nobody else can write to it, to a file in it or to a folder above it. What root has
compiled is read as well, under the same conditions.
"""

from __future__ import annotations

import functools
import os
import stat
from pathlib import Path

from ortho_pipeline.files.folders import cache_folder

#: Environment variable: the folder of compiled kernels.
FOLDER = "NUMBA_CACHE_DIR"
_ROOT = 0


@functools.cache
def own() -> tuple[Path | None, str]:
    """Return the folder to which this user's kernels are written, or None and the reason why there is none."""
    if not hasattr(os, "geteuid"):
        return None, "this system does not say which user a file belongs to"
    folder = _of(os.geteuid())
    if folder is None:
        return None, f"there is no home folder, and {FOLDER} names no absolute path"
    try:
        folder.mkdir(parents=True, mode=0o700, exist_ok=True)
    except OSError as error:
        return None, f"{folder} cannot be made ({error.strerror or error})"
    if not os.access(folder, os.W_OK):
        return None, f"{folder} cannot be written"
    fault = fault_of(folder, os.geteuid())
    return (None, fault) if fault else (folder, "")


@functools.cache
def of_root() -> Path | None:
    """Return the folder of the kernels that root has compiled, if it is another one and can be read and trusted."""
    folder = _of(_ROOT) if hasattr(os, "geteuid") else None
    if folder is None or not os.geteuid() or not os.access(folder, os.R_OK | os.X_OK):
        return None
    return None if fault_of(folder, _ROOT) else folder


def _of(user: int) -> Path | None:
    """Return the folder of a user: each has one of their own, so that a folder can be named for all."""
    named = os.environ.get(FOLDER, "")
    above = Path(named) if os.path.isabs(named) else cache_folder()
    return None if above is None else above / f"kernels-{user}"


def fault_of(folder: Path, user: int) -> str:
    """Return why what is in a folder may have been written by others than a user and root; empty if it may not."""
    try:
        real = folder.resolve(strict=True)
        for path in (real, *real.parents):
            state = path.stat()
            # In a sticky folder, such as /tmp, nobody can rename or remove what belongs to others.
            open_to_all = state.st_mode & 0o022 and (path == real or not state.st_mode & stat.S_ISVTX)
            if open_to_all or state.st_uid not in ((user,) if path == real else (user, _ROOT)):
                return f"others can write to {path}"
        # Nobody else reaches the files of a closed folder, whatever their modes are.
        closed = not real.stat().st_mode & 0o077
        for entry in os.scandir(real):
            state = entry.stat(follow_symlinks=False)
            plain = stat.S_ISREG(state.st_mode) and state.st_uid == user
            if not plain or (state.st_mode & 0o022 and not closed):
                return f"others can write to {entry.path}"
    except OSError as error:
        return f"{folder} cannot be read ({error.strerror or error})"
    return ""
