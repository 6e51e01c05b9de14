"""Fetch the real images and metadata of the tests marked `realdata` from the public repositories that have them.

    python tools/real_data.py [--base URL] [--check] [FOLDER]

`tests/data/real_files.json` names repository, commit and licence of each origin, and source, SHA-256 and size of each
file. A file gets its name when both are right. Right files stay, so a run that was stopped can be continued.
The files may be downloaded for tests. They are not part of this package: never commit one.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import sys
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path, PurePosixPath
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import urlopen

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "tests" / "data" / "real_files.json"
FOLDER = ROOT / "out" / "real-data"


class NotFetched(Exception):
    """Of a file (the arguments): name, address, what is wrong, what to do."""

    def __str__(self) -> str:
        return "{0}: {2}\n  address: {1}\n  {3}".format(*self.args)


class NoAnswer(NotFetched):
    """The server does not answer, so it has no other file either."""


@dataclass(frozen=True)
class RealFile:
    """A file: its path below the folder, its source in the repository at a commit, and its content."""

    path: str
    source: str
    sha256: str
    bytes: int
    repository: str
    commit: str

    def __post_init__(self) -> None:
        for name in (self.path, self.source):
            parts = PurePosixPath(name).parts
            if not parts or parts[0].startswith("/") or ".." in parts or "\\" in name or "\0" in name:
                raise ValueError(f"{TABLE}: {name!r} is not a path inside a folder")
        if not re.fullmatch(r"\w[\w-]*/\w[\w.-]*", self.repository) or not re.fullmatch("[0-9a-f]{40}", self.commit):
            raise ValueError(f"{TABLE}: {self.repository!r} at {self.commit!r} is not OWNER/NAME at a commit")

    def is_right(self, content: bytes) -> bool:
        return len(content) == self.bytes and hashlib.sha256(content).hexdigest() == self.sha256


def data_folder() -> Path:
    """Return the folder that tests use: `ORTHO_REAL_DATA`, else ../shared/data, else out/real-data."""
    stated, beside = os.environ.get("ORTHO_REAL_DATA"), ROOT.parent / "shared" / "data"
    return Path(stated).absolute() if stated else beside if beside.is_dir() else FOLDER


def read_table(path: Path) -> dict[str, list[RealFile]]:
    """Return the files of each origin, whose name is that of its repository with its licence."""
    return {
        f"{one['repository']} ({one['licence']})": [
            RealFile(**file, repository=one["repository"], commit=one["commit"]) for file in one["files"]
        ]
        for one in json.loads(path.read_text(encoding="utf-8"))["origins"]
    }


def download(file: RealFile, address: str) -> bytes:
    """Return the content of a file, which is right."""
    try:
        with urlopen(address, timeout=60.0) as answer:
            content: bytes = answer.read(2 * file.bytes)
    except (OSError, HTTPException, ValueError) as error:
        failure = NotFetched if isinstance(error, HTTPError) else NoAnswer
        remedy = "Is this machine online, and does the repository still exist? Run the command again to continue."
        raise failure(file.path, address, f"cannot be downloaded ({error})", remedy) from error
    if not file.is_right(content):
        problem = f"wrong size ({len(content)} instead of {file.bytes} bytes) or SHA-256"
        remedy = "Run the command again. If the error stays, the file was changed there: do not use it."
        raise NotFetched(file.path, address, problem, remedy)
    return content


def fetch(file: RealFile, folder: Path, address: str) -> None:
    """Download a file, and give it its name when it is complete."""
    parent = (folder / file.path).parent.resolve()
    if not parent.is_relative_to(folder.resolve()):
        raise NotFetched(file.path, address, f"a link leads out of {folder}", "Remove the link.")
    content, name = download(file, address), PurePosixPath(file.path).name
    part = parent / f".{name}.{os.getpid()}.part"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as stream:
            stream.write(content)
        os.replace(part, parent / name)
    except OSError as error:
        remedy = f"Make {folder} writable, with enough space, and run the command again to continue."
        raise NotFetched(file.path, address, f"cannot be written ({error})", remedy) from error
    finally:
        if part.exists():
            part.unlink()


def complete(files: list[RealFile], folder: Path, base: str, *, check: bool) -> int:
    """Fetch the missing files of an origin, or only name them; return how many files are right then."""
    right = 0
    for file in files:
        target, address = folder / file.path, f"{base}/{file.repository}/{file.commit}/{quote(file.source)}"
        try:
            if not (target.is_file() and file.is_right(target.read_bytes())):
                if check:
                    raise NotFetched(file.path, address, "missing or different", "Run this without --check.")
                fetch(file, folder, address)
            right += 1
        except NotFetched as error:
            print(f"Error: {error}", file=sys.stderr)
            if isinstance(error, NoAnswer):
                break
    return right


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER, help="default: out/real-data in the checkout")
    parser.add_argument("--base", default="https://raw.githubusercontent.com", help="URL of OWNER/NAME/COMMIT/PATH")
    parser.add_argument("--check", action="store_true", help="only compare the files with the table")
    words, right, wanted = parser.parse_args(arguments), 0, 0
    for origin, files in read_table(TABLE).items():
        count = complete(files, words.folder, words.base.rstrip("/"), check=words.check)
        print(f"{count:4} of {len(files):3} files: {origin}", flush=True)
        right, wanted = right + count, wanted + len(files)
    print(f"{right:4} of {wanted:3} files are in {words.folder}")
    return 0 if right == wanted else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
