"""Access of a browser: by an address that works once, and then by a cookie.

The address has a key, which is exchanged for a cookie at its first use. The page is in a folder with a random name, and
the cookie is valid only for this folder: browsers send cookies of a host to all its ports, and another port may belong
to another user. Every user of a machine can read the command line of a browser, so the browser opens a file that only
its user can read.
"""

from __future__ import annotations

import contextlib
import html
import os
import secrets
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

_COOKIE = b"ortho_measure="
#: What a file is called that leads to the page, after the name of the points.
_ENDING = ".open.html"
_LEADING = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={address}">
<title>ortho measure</title>
<link rel="icon" href="data:,">
</head>
<body><p><a href="{address}">Continue to ortho measure</a></p></body>
</html>
"""
#: Text for requests without the cookie.
REFUSED = (
    b"This address does not open the page: it was used before, or it has no key.\n"
    b"Use the browser that opened it first, or start 'ortho measure' again for a new address.\n"
)


def _secret() -> str:
    return secrets.token_urlsafe(24)


@dataclass
class PageEntry:
    """Address, key and cookie of one server.

    Parameters
    ----------
    folder : str
        The first folder of all addresses.
    """

    folder: str = field(default_factory=_secret)
    _key: str | None = field(default_factory=_secret, repr=False)
    _cookie: str = field(default_factory=_secret, repr=False)

    @property
    def path(self) -> str:
        """The path that works once, with its query; later the path of the page."""
        return f"/{self.folder}/" + (f"?key={self._key}" if self._key else "")

    def knows(self, cookies: list[bytes]) -> bool:
        """Return whether the ``Cookie`` headers of a request have the cookie."""
        mine = _COOKIE + self._cookie.encode()
        return any(secrets.compare_digest(cookie.strip(), mine) for header in cookies for cookie in header.split(b";"))

    def exchange(self, query: bytes) -> bytes | None:
        """Return the ``Set-Cookie`` header for the query of the address; None if it is wrong or was used before."""
        if self._key is None or not secrets.compare_digest(query, b"key=" + self._key.encode()):
            return None
        self._key = None
        return _COOKIE + f"{self._cookie}; Path=/{self.folder}/; HttpOnly; SameSite=Strict".encode()


def leading_to(address: str) -> str:
    """Return a page that leads to an address.

    Browsers do not send a strict cookie after a link from a file or a foreign page. So the first answer is such a page
    too: from there on, links are within the site.
    """
    return _LEADING.format(address=html.escape(address))


@contextlib.contextmanager
def private_file(address: str, points: Path) -> Iterator[Path | None]:
    """Provide a file that leads to an address while the context lasts; None if others could read it.

    It is next to the points, because packaged browsers cannot read ``/tmp`` or hidden folders.
    """
    path = points.with_name(points.name + _ENDING)
    try:
        path.unlink(missing_ok=True)  # of a process that was killed
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError:
        yield None
        return
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            status = os.fstat(file.fileno())
            # File systems without modes show all files to everybody.
            private = stat.S_IMODE(status.st_mode) & 0o077 == 0 and status.st_uid == os.geteuid()
            if private:
                file.write(leading_to(address))
        yield path.absolute() if private else None
    finally:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
