"""Servers of tests, on this machine: a public bucket, with faults where a test wants; an ortho made within a store."""

from __future__ import annotations

import functools
import hashlib
import http.client
import http.server
import random
import shutil
import socket
import subprocess
import threading
import time
import urllib.parse
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.commands import rectify
from ortho_pipeline.options import SceneOptions, SurfaceOptions
from ortho_pipeline.stores.objects import Objects


@contextmanager
def installed_server(program: str, options: Callable[[int], list[str]]) -> Iterator[int]:
    """Run a server that is told by its options on which port to listen; skip the test where it is not installed."""
    found = shutil.which(program)
    if found is None:
        pytest.skip(f"{program} is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([found, *options(port)], **quiet) as server:
        for _ in range(400):
            with socket.socket() as asked:
                if asked.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.05)
        yield port
        server.terminate()


class PublicFolder:
    """A folder behind HTTP: ranges, ETags that are MD5, and what is asked for, counted; for reading also a store of S3.

    `faults` maps a path to a function (content, number of the request) -> content, status or None for the true answer;
    every answer takes `delay` seconds more.
    """

    def __init__(self, folder: Path, delay: float = 0.0) -> None:
        self.folder, self.delay = folder, delay
        self.asked: Counter[str] = Counter()
        self.sent = 0
        self.times: list[tuple[float, float]] = []
        self.faults: dict[str, Callable[[bytes, int], bytes | int | None]] = {}
        self._content = functools.cache(_content_of)

    address = ""

    @property
    def rounds(self) -> float:
        """How often somebody waited for an answer: the time in which one was under way, in delays."""
        busy = until = 0.0
        for begin, end in sorted(self.times):
            busy += max(0.0, end - max(begin, until))
            until = max(until, end)
        return busy / self.delay

    def answer(self, handler: http.server.BaseHTTPRequestHandler) -> None:
        begin = time.monotonic()
        time.sleep(self.delay)
        self.times.append((begin, time.monotonic()))
        name, _, query = handler.path.lstrip("/").partition("?")
        self.asked[name] += 1
        asked_for = urllib.parse.parse_qs(query)
        if "list-type" in asked_for or "delimiter" in asked_for:
            return self._say(handler, 200, self._listing(name.strip("/"), asked_for.get("prefix", [""])[0]))
        path = self.folder / name
        if not path.is_file():
            return self._say(handler, 404, b"")
        data, tag = self._content(path, path.stat().st_mtime_ns)
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

    def _listing(self, bucket: str, prefix: str) -> bytes:
        """Return what S3 says of the objects in a folder."""
        folder = self.folder / bucket / prefix
        objects = [path for path in sorted(folder.iterdir()) if path.is_file()] if folder.is_dir() else []
        contents = "".join(
            f"<Contents><Key>{prefix}{path.name}</Key><Size>{path.stat().st_size}</Size>"
            "<LastModified>2015-10-21T07:28:00.000Z</LastModified></Contents>"
            for path in objects
        )
        return (
            '<ListBucketResult xmlns="http://s3.amazonaws.com/doc/2006-03-01/">'
            f"<Name>{bucket}</Name><Prefix>{prefix}</Prefix><IsTruncated>false</IsTruncated>{contents}"
            "</ListBucketResult>"
        ).encode()

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
def running(served: Any) -> Iterator[Any]:
    """Let an object answer requests on the loopback for the length of a block."""

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: Any) -> None: ...

        def handle(self) -> None:
            with suppress(ConnectionError):
                super().handle()

        def do_GET(self) -> None:
            served.answer(self)

        do_HEAD = do_PUT = do_POST = do_DELETE = do_GET  # noqa: N815

    class Server(http.server.ThreadingHTTPServer):
        daemon_threads = True
        request_queue_size = 128  # who finds no place in it tries again after a second

        def handle_error(self, *_: Any) -> None:
            """A client that has gone, or a connection that was cut on purpose."""

    with Server(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        served.address = f"http://127.0.0.1:{server.server_port}"
        try:
            yield served
        finally:
            server.shutdown()
            thread.join()


def _content_of(path: Path, _: int) -> tuple[bytes, str]:
    data = path.read_bytes()
    return data, hashlib.md5(data).hexdigest()


@contextmanager
def serving(folder: Path, delay: float = 0.0) -> Iterator[PublicFolder]:
    """Serve a folder on the loopback for the length of a block."""
    with running(PublicFolder(folder, delay)) as public:
        yield public


class FaultyWay:
    """A proxy before a server, on which things go wrong: drawn from a seed, each request by itself.

    Parameters
    ----------
    target : (str, int)
        Host and port of the server.
    share : float
        Of requests at which something goes wrong, but for the first `good` ones.
    """

    KINDS = ("cut", "delay", "429", "500", "503", "truncated", "flipped", "flipped request", "answer lost")

    def __init__(self, target: tuple[str, int], seed: int, share: float = 0.3) -> None:
        self.target, self.share = target, share
        self.random = random.Random(seed)
        self.lock = threading.Lock()
        self.met: Counter[str] = Counter()
        self.asked = self.sent = self.good = 0

    address = ""

    def drawn(self) -> str:
        with self.lock:
            self.asked += 1
            faulty = self.random.random() < self.share and self.asked > self.good
            kind = self.random.choice(self.KINDS) if faulty else "none"
            self.met[kind] += 1
            return kind

    def answer(self, handler: http.server.BaseHTTPRequestHandler) -> None:
        size = int(handler.headers.get("Content-Length") or 0)
        body = handler.rfile.read(size)
        kind = self.drawn()
        if kind in ("429", "500", "503"):
            return self.say(handler, int(kind), [], b"")
        if kind == "delay":
            time.sleep(0.02)
        if kind == "flipped request" and body:
            body = self.flipped(body)
        connection = http.client.HTTPConnection(*self.target, timeout=30)
        headers = {key: value for key, value in handler.headers.items() if key.lower() != "connection"}
        connection.request(handler.command, handler.path, body=body, headers=headers)
        reply = connection.getresponse()
        data = reply.read()
        connection.close()
        kept = [(k, v) for k, v in reply.getheaders() if k.lower() not in ("transfer-encoding", "connection", "date")]
        if kind == "answer lost":
            handler.close_connection = True
            return handler.connection.close()
        # What a signed answer to a question holds has no checksum: XML of listings is not what is delivered.
        is_object = handler.command == "GET" and "?" not in handler.path
        if kind == "flipped" and data and is_object:
            data = self.flipped(data)
        if kind == "truncated" and data and is_object:
            data = data[: len(data) // 2]
            kept = [(k, v) for k, v in kept if k.lower() != "content-length"] + [("Content-Length", str(len(data)))]
        self.say(handler, reply.status, kept, data, cut=kind == "cut")
        return None

    def flipped(self, data: bytes) -> bytes:
        with self.lock:
            at = self.random.randrange(len(data))
        return data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]

    def say(
        self, handler: http.server.BaseHTTPRequestHandler, status: int, headers: list[tuple[str, str]], data: bytes,
        *, cut: bool = False,
    ) -> None:  # fmt: skip
        handler.send_response(status)
        for key, value in headers:
            handler.send_header(key, value)
        if not any(key.lower() == "content-length" for key, _ in headers):
            handler.send_header("Content-Length", str(len(data)))
        handler.end_headers()
        if handler.command == "HEAD":
            return
        handler.wfile.write(data[: len(data) // 3] if cut else data)
        self.sent += len(data)
        if cut:
            handler.wfile.flush()
            handler.close_connection = True
            handler.connection.close()


@contextmanager
def on_a_faulty_way(target: tuple[str, int], seed: int, share: float = 0.3) -> Iterator[FaultyWay]:
    """Run a `FaultyWay` for the length of a block."""
    with running(FaultyWay(target, seed, share)) as way:
        yield way


@contextmanager
def moto_server(bucket: str) -> Iterator[tuple[str, int]]:
    """Serve S3 by moto, with a bucket, and yield host and port; the test is skipped without moto."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    try:
        bucket_at(f"http://{host}:{port}", bucket)
        yield host, port
    finally:
        server.stop()


def bucket_at(address: str, name: str) -> None:
    """Make a bucket in a server."""
    urllib.request.urlopen(urllib.request.Request(f"{address}/{name}", method="PUT")).close()


def rectify_within(box: str, tiny: Any, folder: Path) -> None:
    """Rectify a scene and a DEM of a store into it, and see that the ortho is that of the same files here."""
    there = Objects(f"{box}/in", allow_network=True)
    for path in (tiny.image, tiny.dem):
        there.put(path.name, path)
    surface = SurfaceOptions(dem=f"{box}/in/dem.tif", vertical="ellipsoid")
    made = rectify(f"{box}/in/tiny.tif", f"{box}/out", surface=surface, scene=SceneOptions(allow_network=True))
    assert made.files["ortho"] == f"{box}/out/tiny_ortho.tif"
    Objects(f"{box}/out", allow_network=True).fetch("tiny_ortho.tif", folder / "there.tif", 1 << 30)
    local = rectify(tiny.image, folder / "out", surface=SurfaceOptions(dem=str(tiny.dem), vertical="ellipsoid"))
    np.testing.assert_array_equal(
        gdal.Open(str(folder / "there.tif")).ReadAsArray(), gdal.Open(str(local.files["ortho"])).ReadAsArray()
    )
