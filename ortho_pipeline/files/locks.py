"""The lock of a file, by which processes keep out of each other's way.

The library `filelock` does not serve here. It truncates the file that it locks, which may be a journal, a log, or say
who holds it. Readers cannot share its locks of files. Until 3.20.1 it followed links in place of the file.
"""

from __future__ import annotations

import fcntl
import os


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
        self.descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        self.held = True
        try:
            fcntl.flock(self.descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
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
