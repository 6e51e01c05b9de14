"""The lock of a file, by which processes keep out of each other's way.

The library `filelock` does not serve here. It truncates the file that it locks, which may be a journal, a log, or say
who holds it. Readers cannot share its locks of files. Until 3.20.1 it followed links in place of the file.
"""

from __future__ import annotations

import errno
import importlib
import os
import random
import time
from typing import Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: Where there is no `fcntl`: bytes of a lock, far beyond the end of any file, and seconds between two attempts.
_FIRST, _BYTES, _PAUSE = 1 << 40, 64, 0.02


class Lock:
    """The lock of a file, held until it is closed; the system releases it however the process ends.

    Parameters
    ----------
    path : path
        The file is made if there is none. A symbolic link in its place is not followed.
    shared : bool
        Others may hold it too, if they share it.
    wait : bool
        Wait for others to release it.
    needed : bool
        Whether a file system without locks is an error.

    Attributes
    ----------
    descriptor : int
        The file, open for reading and writing.
    held : bool
        False on a file system without locks.

    Raises
    ------
    BlockingIOError
        If another process holds it, without `wait`.
    OSError
        If the file cannot be opened or locked.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, shared: bool = False, wait: bool = True, needed: bool = True
    ) -> None:
        self.descriptor = open_itself(path, os.O_RDWR | os.O_CREAT)
        self.held = True
        try:
            _lock(self.descriptor, shared, wait)
        except OSError as error:
            self.held = False
            if needed or isinstance(error, BlockingIOError):
                self.close()
                raise

    def append(self, data: bytes) -> None:
        """Append to the file and wait until it is on disk; where that fails nothing of it is left."""
        size = os.lseek(self.descriptor, 0, os.SEEK_END)
        try:
            while data:
                data = data[os.write(self.descriptor, data) :]
            os.fsync(self.descriptor)
        except OSError:
            os.ftruncate(self.descriptor, size)
            raise

    def close(self) -> None:
        """Release the lock."""
        os.close(self.descriptor)


def open_itself(path: str | os.PathLike[str], flags: int) -> int:
    """Open a file, but not by a symbolic link in its place."""
    if not hasattr(os, "O_NOFOLLOW") and os.path.islink(path):
        raise OSError(errno.ELOOP, "a symbolic link is not followed", os.fspath(path))
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0), 0o666)


def _lock(descriptor: int, shared: bool, wait: bool) -> None:
    """Lock a file; where there is no `fcntl`, one of some bytes to share it, and all of them to have it alone."""
    if fcntl is not None:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
        return
    try:
        windows: Any = importlib.import_module("msvcrt")
    except ImportError:
        raise OSError(errno.ENOLCK, "No locks available") from None
    places = random.sample(range(_BYTES), _BYTES) if shared else [0]
    while not any(_taken(windows, descriptor, place, 1 if shared else _BYTES) for place in places):
        if not wait:
            raise BlockingIOError(errno.EAGAIN, "another process holds this lock")
        time.sleep(_PAUSE)
    os.lseek(descriptor, 0, os.SEEK_SET)


def _taken(windows: Any, descriptor: int, place: int, count: int) -> bool:
    """Lock some bytes, and tell whether that was possible."""
    os.lseek(descriptor, _FIRST + place, os.SEEK_SET)
    try:
        windows.locking(descriptor, windows.LK_NBLCK, count)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EAGAIN, errno.EDEADLK):
            raise
        return False
    return True
