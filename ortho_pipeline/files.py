"""Files that appear whole or not at all, and files of strangers, of which no more is read than they may have."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError
from pathlib import Path

from ortho_pipeline.errors import InputError
from ortho_pipeline.locations import VsiPath

#: Bytes that are read at once for a checksum.
_CHUNK = 1 << 20


@contextlib.contextmanager
def whole_or_nothing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path` and move it there when the block ends well.

    The temporary file has the same suffix (drivers go by it) and lies in the same folder (a rename is atomic only
    within a file system). On an exception it is removed and a file that was at `path` before is untouched.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    final = Path(path)
    # A rename onto a symbolic link would replace the link, not what it points to.
    final = final.resolve() if final.is_symlink() else final
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{final.stem}.", suffix=f".part{final.suffix}", dir=final.parent)
    except OSError as error:
        raise InputError(
            f"cannot write here ({error.strerror})", file=final.parent, remedy="choose a folder that you may write to"
        ) from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes files private; outputs get what the umask of the user says.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        with open(temporary, "rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, final)
        _sync_folder(final.parent)
    finally:
        for left in temporary.parent.glob(f"{glob.escape(temporary.name)}*"):
            left.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8 to `path`, whole or not at all."""
    with whole_or_nothing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_bounded(path: str | os.PathLike[str], limit: int, **told: str) -> bytes:
    """Return the bytes of a file, of one that is larger the first ``limit + 1``.

    Raises
    ------
    InputError
        If it cannot be read; with field and remedy as `told`.
    """
    try:
        if isinstance(path, VsiPath):
            return path.read(limit + 1)
        with open(path, "rb") as file:
            return file.read(limit + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"this file cannot be read ({reason})", file=path, **told) from error


def decoded(data: bytes) -> str:
    """Return text that ought to be UTF-8 but may be Latin-1: what is read of it is ASCII, its names need not be."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def sha256(path: str | os.PathLike[str], stop: threading.Event | None = None) -> str:
    """Return the SHA-256 of a file as hexadecimal text.

    Raises
    ------
    CancelledError
        As soon as `stop` is set.
    """
    digest = hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        while chunk := file.read(_CHUNK):
            if stop is not None and stop.is_set():
                raise CancelledError
            digest.update(chunk)
    return digest.hexdigest()


def _sync_folder(folder: Path) -> None:
    # Without this a power cut after the rename can lose the new name.
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
