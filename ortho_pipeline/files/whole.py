"""Files that appear whole or not at all, and files of strangers, of which no more is read than they may have.

The outputs of a command appear together: each is written under a temporary name in its folder, and all get their names
when the last is complete (`together`). The names are given by renames whose list stands in a journal, so that the next
command for the same outputs completes what a killed one had begun, and removes what one left that had not got so far.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.folders import is_removable, require_replaceable
from ortho_pipeline.files.locks import Lock
from ortho_pipeline.files.reading import read_bounded

#: What a temporary name has between its random part and its suffix.
_PART = ".part"
#: Default remedy for a file that cannot be written.
_REMEDY = "choose a folder with write access and enough free space"


class Outputs:
    """Files of one command in one folder, written under temporary names until all of them are complete.

    Parameters
    ----------
    folder : Path
    name : str
        What the outputs are called together (the stem of a scene); two commands do not write outputs of one name at
        the same time, and the next one clears up after one that was killed.
    remedy : str
        What helps where they cannot be written.
    """

    def __init__(self, folder: Path, name: str, remedy: str = _REMEDY) -> None:
        self.folder, self.name, self.remedy = folder, name, remedy
        # Temporary names are as long for every output: a final name may have all that a file system allows.
        self.prefix = f".{hashlib.sha256(name.encode(errors='surrogateescape')).hexdigest()[:12]}."
        self.staged: dict[Path, Path] = {}
        #: Files of an earlier command that no longer belong to the outputs: removed when these get their names.
        self.obsolete: list[Path] = []
        #: Whether something else than plain text was written, beside which a driver may have put files of its own.
        self.side_cars = False
        self._made: list[Path] = []
        self._lock: Lock | None = None

    @property
    def journal(self) -> Path:
        """List of renames that are under way."""
        return self.folder / f"{self.prefix}journal{_PART}"

    @property
    def lock_path(self) -> Path:
        """File whose lock is held while they are written."""
        return self.folder / f"{self.prefix}lock{_PART}"

    # -- begin and end -----------------------------------------------------------------------------------------------

    def begin(self, *, wait: bool = False) -> None:
        """Make the folder, lock the name, and clear up after a command that was killed.

        Parameters
        ----------
        wait : bool
            Wait for another command that writes them; otherwise it is an error.
        """
        try:
            missing = [path for path in (self.folder, *self.folder.parents) if not path.exists()]
            self.folder.mkdir(parents=True, exist_ok=True)
            self._made = missing
            self._lock, killed = self._locked(wait)
            if killed:
                self._recover()
        except OSError as error:
            self.end()
            raise self.unwritable(self.folder, error) from error
        except InputError:
            self.end()
            raise

    def end(self, *, failed: bool = True) -> None:
        """Remove what is left under temporary names, and unlock; folders that were made for nothing go too."""
        if self._lock is not None:
            with contextlib.suppress(OSError):
                if failed or self.side_cars:
                    self._clear(self.prefix)
                self.lock_path.unlink(missing_ok=True)
            self._lock.close()
            self._lock = None
        for path in self._made:
            with contextlib.suppress(OSError):
                path.rmdir()

    def _locked(self, wait: bool) -> tuple[Lock, bool]:
        """Return the lock of this name, and whether a killed command has left its file."""
        path = self.lock_path
        while True:
            killed = os.path.lexists(path)
            try:
                lock = Lock(path, wait=wait, needed=False)
            except BlockingIOError as error:
                raise InputError(
                    f"another command is writing {self.name!r} in this folder",
                    file=self.folder,
                    field="folder",
                    remedy="wait until it ends, or choose another output folder",
                ) from error
            if not lock.held:
                # A file system without locks: two commands on one folder do not notice each other there.
                return lock, False
            # The one that held it may have removed the file between our opening and our locking.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock.descriptor), os.stat(path, follow_symlinks=False)):
                    return lock, killed
            lock.close()

    def _recover(self) -> None:
        """Complete the renames that a killed command had begun, and remove its other temporary files."""
        renames, obsolete = self._listed()
        for name, final in renames:
            if (self.folder / name).is_file() and not (self.folder / name).is_symlink():
                os.replace(self.folder / name, self.folder / final)
        for name in obsolete:
            (self.folder / name).unlink(missing_ok=True)
        self._clear(self.prefix)

    def _listed(self) -> tuple[list[tuple[str, str]], list[str]]:
        """Return the renames of the journal, and the names to remove.

        Somebody else may have written it: one that leads out of the folder, or to what is no file, lists nothing.
        """
        with contextlib.suppress(InputError, ValueError, KeyError, TypeError, RecursionError):
            # Half characters are allowed here: they stand for the bytes of names that are not UTF-8.
            document = json.loads(read_bounded(self.journal, 1_000_000))
            renames, obsolete = [(name, final) for name, final in document["renames"]], list(document["obsolete"])
            names = [*(name for pair in renames for name in pair), *obsolete]
            if all(map(self._is_file_here, names)) and all(name.startswith(self.prefix) for name, _ in renames):
                return renames, obsolete
        return [], []

    def _is_file_here(self, name: str) -> bool:
        """Tell whether a file in the folder may have this name; ValueError for what no file can have."""
        encoded = os.fsencode(name)
        return (
            Path(name).name == name not in ("", "..")
            and b"\0" not in encoded
            and len(encoded) <= os.pathconf(self.folder, "PC_NAME_MAX")
            and not os.path.isdir(self.folder / name)
        )

    def _clear(self, start: str) -> None:
        """Remove the files in the folder whose names begin so, but for the lock's."""
        with os.scandir(self.folder) as entries:
            left = [
                entry.path
                for entry in entries
                if entry.name.startswith(start)
                and not entry.name.endswith(f"lock{_PART}")
                and not entry.is_dir(follow_symlinks=False)
            ]
        for path in left:
            Path(path).unlink(missing_ok=True)

    # -- one file ----------------------------------------------------------------------------------------------------

    def holds(self, final: Path) -> bool:
        """Tell whether a file belongs to these outputs."""
        return final.parent == self.folder

    def temporary(self, final: Path) -> Path:
        """Return a new temporary path for `final`; drivers go by its suffix."""
        suffix = final.suffix if len(final.suffix) < 40 else ""
        if os.path.isdir(final) or not final.name:
            raise InputError(
                "a folder with this name exists, so the file cannot be written",
                file=final,
                remedy="remove or rename it",
            )
        require_replaceable(final)
        try:
            if len(os.fsencode(final.name)) > os.pathconf(final.parent, "PC_NAME_MAX"):
                raise InputError("this name is too long for the file system", file=final, remedy="rename the image")
            path = self.folder / f"{self.prefix}{secrets.token_hex(4)}{_PART}{suffix}"
            # Made at once, so that a folder that cannot be written is known before the work.
            os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666))
        except OSError as error:
            raise self.unwritable(self.folder, error) from error
        return path

    def put(self, temporary: Path, final: Path) -> None:
        """Take a complete file into the outputs; a later one for the same path takes its place."""
        _sync(temporary)
        before = self.staged.pop(final, None)
        if before is not None:
            before.unlink(missing_ok=True)
        self.staged[final] = temporary

    def take_back(self, kept: Mapping[Path, Path]) -> None:
        """Remove the complete files that are not among those `kept`."""
        for final in [path for path in self.staged if path not in kept]:
            self.staged.pop(final).unlink(missing_ok=True)

    def drop(self, temporary: Path) -> None:
        """Remove a temporary file and the side-cars that a driver put next to it."""
        self._clear(temporary.name)

    # -- all files ---------------------------------------------------------------------------------------------------

    def commit(self) -> None:
        """Give all files their names, and remove those that no longer belong to them."""
        obsolete = [path for path in self.obsolete if path not in self.staged and is_removable(path)]
        renames = [(temporary.name, final.name) for final, temporary in self.staged.items()]
        try:
            if len(renames) + len(obsolete) > 1:
                journal = self.journal.with_name(f"{self.prefix}{secrets.token_hex(4)}{_PART}")
                text = json.dumps({"renames": renames, "obsolete": [path.name for path in obsolete]})
                journal.write_text(text, encoding="utf-8", errors="surrogateescape")
                _sync(journal)
                os.replace(journal, self.journal)
            for final, temporary in self.staged.items():
                os.replace(temporary, final)
            for path in obsolete:
                path.unlink(missing_ok=True)
            sync_folder(self.folder)
            self.journal.unlink(missing_ok=True)
        except OSError as error:
            raise self.unwritable(self.folder, error) from error
        if self.staged:
            self._made = []

    def unwritable(self, path: Path, error: OSError) -> InputError:
        """Return the error that a file or folder of these cannot be written."""
        return _unwritable(path, error, self.remedy)


#: The outputs of the command that is under way in this context.
_under_way: ContextVar[Outputs | None] = ContextVar("_under_way", default=None)


#: The folder that all outputs have to lie in, in this context: as it was named, and where that leads.
_confined: ContextVar[tuple[Path, Path] | None] = ContextVar("_confined", default=None)


@contextlib.contextmanager
def confined(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Let nothing be written outside of `folder` within the block, nor through a symbolic link in it."""
    token = _confined.set((Path(os.path.abspath(folder)), Path(folder).resolve()))
    try:
        yield
    finally:
        _confined.reset(token)


def allowed(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a file that may be written.

    Links on the way to the folder that a user named are followed: they are the user's. No link is followed in place of
    the file, nor below the folder that outputs are `confined` to. One that appears later is replaced, not followed.

    Raises
    ------
    InputError
        If such a link is in the way, or the path is outside of the folder.
    """
    place = _place(path)
    for link in (place, *place.parents):
        if os.path.islink(link):
            raise InputError(
                "this is a symbolic link; outputs are not written through links",
                file=link,
                remedy="remove the link, or give its target as the output",
            )
    return place


@contextlib.contextmanager
def together(
    folder: str | os.PathLike[str], name: str, *, wait: bool = False, remedy: str = _REMEDY
) -> Iterator[Outputs]:
    """Let all files that are written into `folder` within the block appear at once, when it ends well.

    On an exception nothing appears, and files that were there before are untouched. Within a block for the same
    folder, this is a part of it.

    Parameters
    ----------
    name : str
        What the outputs are called together, see `Outputs`.
    wait : bool
        Wait for another command that is writing outputs of this name there.
    remedy : str
        What helps where they cannot be written.

    Raises
    ------
    InputError
        If the folder cannot be written, or, without `wait`, another command is writing outputs of this name there.
    """
    place = _place(Path(folder) / _PART).parent
    outer = _under_way.get()
    if outer is not None and outer.folder == place:
        yield outer
        return
    outputs = Outputs(place, name, remedy)
    allowed(outputs.lock_path)
    outputs.begin(wait=wait)
    token, failed = _under_way.set(outputs), True
    try:
        yield outputs
        outputs.commit()
        failed = False
    finally:
        _under_way.reset(token)
        outputs.end(failed=failed)


@contextlib.contextmanager
def whole_or_nothing(path: str | os.PathLike[str], *, side_cars: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`, whose file gets that name when the block ends well.

    Within a block of `together` it gets its name with the others; `staged` finds it until then. The temporary file has
    the same suffix and lies in the same folder (a rename is atomic only within a file system). On an exception it is
    removed and a file that was at `path` before is untouched.

    Parameters
    ----------
    side_cars : bool
        Whether a driver may put files of its own next to the temporary one; they are removed.

    Raises
    ------
    InputError
        If the folder cannot be written, the disk is full, or a link is in the way (see `allowed`).
    """
    final = allowed(path)
    outer = _under_way.get()
    with contextlib.ExitStack() as stack:
        if outer is not None and outer.holds(final):
            outputs = outer
        else:
            outputs = stack.enter_context(together(final.parent, final.name))
        outputs.side_cars |= side_cars
        temporary = outputs.temporary(final)
        try:
            yield temporary
            outputs.put(temporary, final)
        except OSError as error:
            outputs.drop(temporary)
            if error.filename in (None, os.fspath(temporary)):
                raise outputs.unwritable(final, error) from error
            raise
        except BaseException:
            outputs.drop(temporary)
            raise


@contextlib.contextmanager
def part_of_outputs() -> Iterator[None]:
    """Let the files that are written within the block appear with the other outputs, or none of them on an exception.

    The outputs that were complete before the block stay.
    """
    outer = _under_way.get()
    before = {} if outer is None else dict(outer.staged)
    try:
        yield
    except BaseException:
        if outer is not None:
            outer.take_back(before)
        raise


def retire(paths: Iterable[str | os.PathLike[str]]) -> None:
    """Let files of an earlier command go when the outputs that are under way get their names."""
    outer = _under_way.get()
    if outer is not None:
        outer.obsolete += [place for place in map(_place, paths) if outer.holds(place)]


def staged(path: str | os.PathLike[str]) -> Path:
    """Return where the content of an output is to be found now: before it has its name, under its temporary one."""
    outer = _under_way.get()
    return Path(path) if outer is None else outer.staged.get(_place(path), Path(path))


def _place(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of an output, in which only the links on the way to the user's folder are followed."""
    confined_to = _confined.get()
    try:
        if confined_to is None:
            return Path(path).parent.resolve() / Path(path).name
    except (OSError, RuntimeError) as error:
        # Links that point at each other are a RuntimeError before Python 3.13.
        raise InputError(
            f"this path cannot be resolved ({getattr(error, 'strerror', None) or error})",
            file=path,
            remedy="check its links",
        ) from error
    named, folder = confined_to
    absolute = Path(os.path.abspath(path))
    for root in (named, folder):
        if absolute.is_relative_to(root):
            return folder / absolute.relative_to(root)
    raise InputError(
        f"this path is outside the output folder {folder}", file=path, remedy="choose a path in that folder"
    )


def _unwritable(path: Path, error: OSError, remedy: str = _REMEDY) -> InputError:
    return InputError(f"cannot write here ({error.strerror or error})", file=path, remedy=remedy)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8 to `path`, whole or not at all.

    Examples
    --------
    >>> write_text(out / "corners.json", "[]")
    >>> (out / "corners.json").read_text()
    '[]'
    """
    with whole_or_nothing(path, side_cars=False) as temporary:
        # Half characters stand for the bytes of a file name that is not UTF-8.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: str | os.PathLike[str], document: Any, *, ascii_only: bool = True) -> None:
    """Write a JSON document to `path`, whole or not at all, as `json_text` gives it."""
    write_text(path, json_text(document, ascii_only=ascii_only))


def json_text(document: Any, *, ascii_only: bool = True) -> str:
    """Return a JSON document as the text of a file: one member a line.

    Parameters
    ----------
    ascii_only : bool
        Escape other characters; without it they stand as they are, in UTF-8.

    Raises
    ------
    ValueError
        If a number is not finite: JSON has none such (`documents.json_value` makes them null).
    """
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=ascii_only) + "\n"


def append_line(path: str | os.PathLike[str], line: str) -> None:
    """Append a line to a file to which several processes may do so at once; on a full disk nothing of it is left.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    path = allowed(path)
    try:
        with contextlib.closing(Lock(path)) as lock:
            lock.append((line + "\n").encode("utf-8", errors="backslashreplace"))
    except OSError as error:
        raise _unwritable(path, error) from error


def clear_up(path: str | os.PathLike[str]) -> None:
    """Remove what a killed command left of a file that it was writing alone."""
    final = _place(path)
    # One that was killed leaves its lock.
    if os.path.lexists(Outputs(final.parent, final.name).lock_path):
        with together(final.parent, final.name):
            pass


def _sync(path: Path) -> None:
    with open(path, "rb+") as written:
        os.fsync(written.fileno())


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to disk: a power cut after a file was made or renamed could lose its name."""
    if os.name == "nt":  # a folder cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
