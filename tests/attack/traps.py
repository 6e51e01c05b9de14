"""A secret that nobody may read, a server that nobody may ask, hostile files that name both, and who came for them."""

from __future__ import annotations

import contextlib
import os
import socketserver
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import hostile
import pytest
from osgeo import gdal


@dataclass
class Trap:
    """Hostile files around a raster and around a pipe, and who came for what they name."""

    url: str
    asked: list[bytes]
    rasters: dict[str, Path | str] = field(default_factory=dict)
    pipes: dict[str, Path | str] = field(default_factory=dict)
    readers: list[float] = field(default_factory=list)


@contextlib.contextmanager
def listening() -> Iterator[tuple[str, list[bytes]]]:
    """Serve nothing; yield a URL and the list of whoever connected."""
    asked: list[bytes] = []

    class Handler(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            asked.append(self.request.recv(200))
            self.request.sendall(b"HTTP/1.0 404 Not Found\r\nContent-Length: 0\r\n\r\n")

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/secret.tif", asked
        server.shutdown()
        thread.join()
    gdal.VSICurlClearCache()


def watch(pipe: Path, readers: list[float], stop: threading.Event) -> None:
    """Note whoever opens a pipe for reading, and let them go: they would wait for ever."""
    while not stop.wait(0.002):
        with contextlib.suppress(OSError):
            os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
            readers.append(time.monotonic())


def trapped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trap]:
    """Write all hostile files twice, with a server that listens and a thread that watches the pipe."""
    folder = tmp_path_factory.mktemp("trap")
    (folder / "piped").mkdir()
    pipe = folder / "piped" / "secret.tif"
    os.mkfifo(pipe)
    with listening() as (url, asked):
        trap = Trap(url, asked)
        trap.rasters = hostile.write(folder / "files", hostile.raster(folder / "secret.tif", hostile.SECRET), url)
        trap.pipes = hostile.write(folder / "piped" / "files", pipe, url)
        stop = threading.Event()
        watcher = threading.Thread(target=watch, args=(pipe, trap.readers, stop), daemon=True)
        watcher.start()
        # Making them may have opened what they name.
        asked.clear()
        trap.readers.clear()
        yield trap
        stop.set()
        watcher.join()
