"""Servers of tests, on this machine: a folder behind HTTP as a public bucket is, with faults where a test wants."""

from __future__ import annotations

import hashlib
import http.server
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class PublicFolder:
    """A folder behind HTTP: ranges, ETags that are MD5, and what is asked for, counted.

    `faults` maps a path to a function (content, number of the request) -> content, status or None for the true answer.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.asked: Counter[str] = Counter()
        self.sent = 0
        self.faults: dict[str, Callable[[bytes, int], bytes | int | None]] = {}

    address = ""

    def answer(self, handler: http.server.BaseHTTPRequestHandler) -> None:
        name = handler.path.lstrip("/").partition("?")[0]
        self.asked[name] += 1
        path = self.folder / name
        if not path.is_file():
            return self._say(handler, 404, b"")
        data = path.read_bytes()
        tag = hashlib.md5(data).hexdigest()
        fault = self.faults.get(name)
        changed = fault(data, self.asked[name]) if fault is not None else None
        if isinstance(changed, int):
            return self._say(handler, changed, b"")
        data = data if changed is None else changed
        status, extra = (
            200,
            {"ETag": f'"{tag}"', "Last-Modified": "Wed, 21 Oct 2015 07:28:00 GMT", "Accept-Ranges": "bytes"},
        )
        asked = handler.headers.get("Range")
        if asked:
            first, _, last = asked.removeprefix("bytes=").partition("-")
            begin, end = int(first), min(int(last or len(data) - 1), len(data) - 1)
            extra["Content-Range"] = f"bytes {begin}-{end}/{len(data)}"
            status, data = 206, data[begin : end + 1]
        self._say(handler, status, data, extra)

    def _say(
        self, handler: http.server.BaseHTTPRequestHandler, status: int, data: bytes, extra: dict[str, str] | None = None
    ) -> None:
        handler.send_response(status)
        for key, value in (extra or {}).items():
            handler.send_header(key, value)
        handler.send_header("Content-Length", str(len(data)))
        handler.end_headers()
        if handler.command != "HEAD":
            handler.wfile.write(data)
            self.sent += len(data)


@contextmanager
def serving(folder: Path) -> Iterator[PublicFolder]:
    """Serve a folder on the loopback for the length of a block."""
    public = PublicFolder(folder)

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: Any) -> None: ...

        def do_GET(self) -> None:
            public.answer(self)

        do_HEAD = do_GET  # noqa: N815

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        public.address = f"http://127.0.0.1:{server.server_port}"
        try:
            yield public
        finally:
            server.shutdown()
            thread.join()
