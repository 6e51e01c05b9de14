"""Whoever has no cookie can connect, and cannot keep its owner out: by idle connections, slow requests or the log."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib import request

import pytest
from ortho_measure.serving.listener import MOST, PATIENCE, Listener
from ortho_measure.serving.log import repetitions_counted

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
DESCRIPTORS, STRANGERS = 256, 300
#: What a stranger sends, who never sends the rest.
BEGINNINGS = (
    b"",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-",
    b"GET / HTTP/1.1\r\nX-Long: " + b"x" * 100_000,
    b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 60000\r\n\r\n{",
    b"\x16\x03\x01\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: upgrade\r\nUpgrade: websocket\r\n\r\n",
)


async def echoed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer each line with itself."""
    with contextlib.suppress(OSError, asyncio.CancelledError):
        while line := await reader.readline():
            writer.write(line)
    writer.close()


class Client:
    """A connection to a server of `echoed`."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @property
    def address(self) -> tuple[str, int]:
        """The address that the server sees."""
        address: tuple[str, int] = self._writer.get_extra_info("sockname")
        return address

    async def open(self) -> bool:
        """Return whether the server answers on this connection."""
        try:
            self._writer.write(b"x\n")
            return await asyncio.wait_for(self._reader.readline(), 5.0) == b"x\n"
        except ConnectionError:
            return False

    def close(self) -> None:
        """Close the connection."""
        self._writer.close()


async def connected(listener: Listener) -> Client:
    """Return a connection that the server has accepted."""
    client = Client(*await asyncio.open_connection(*listener.getsockname()))
    assert await client.open()
    return client


def with_server(listener: Listener, work: Callable[[], Any]) -> None:
    async def served() -> None:
        async with await asyncio.start_server(echoed, sock=listener):
            await work()

    asyncio.run(served())


def test_a_new_connection_closes_the_oldest_one_without_the_cookie() -> None:
    listener = Listener(most=3)

    async def work() -> None:
        first, second, third = [await connected(listener) for _ in range(3)]
        listener.admit(first.address)
        fourth = await connected(listener)
        assert [await one.open() for one in (first, second, third, fourth)] == [True, False, True, True]
        # One that its client has closed counts no longer.
        third.close()
        await asyncio.sleep(0.05)
        fifth = await connected(listener)
        assert [await one.open() for one in (first, fourth, fifth)] == [True, True, True]
        # Nobody closes connections with the cookie.
        listener.admit(fourth.address)
        listener.admit(fifth.address)
        stranger = Client(*await asyncio.open_connection(*listener.getsockname()))
        assert [await one.open() for one in (stranger, first, fourth, fifth)] == [False, True, True, True]

    with_server(listener, work)


def test_a_connection_without_the_cookie_is_closed_in_time() -> None:
    listener = Listener(patience=0.3)

    async def work() -> None:
        stranger, owner = await connected(listener), await connected(listener)
        listener.admit(owner.address)
        await asyncio.sleep(0.8)
        assert [await stranger.open(), await owner.open()] == [False, True]

    with_server(listener, work)


def test_only_this_machine_connects() -> None:
    with Listener() as listener:
        port = listener.getsockname()[1]
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
        with pytest.raises(OSError, match=r"refused|unreachable|assign"):
            # Another address of this machine, which a server for all addresses would answer.
            socket.create_connection(("127.0.0.2", port), timeout=5)


def test_the_number_of_connections_leaves_descriptors_for_files() -> None:
    code = "from ortho_measure.serving.listener import _affordable; print(_affordable())"
    most = [
        int(subprocess.run(["bash", "-c", f'ulimit -n {limit}; exec "$0" -c "$1"', sys.executable, code],
                           check=True, capture_output=True, text=True).stdout)
        for limit in (64, DESCRIPTORS)
    ]  # fmt: skip
    assert most == [16, MOST]


#: Holds all descriptors of the process but a few, and serves.
WITHOUT_DESCRIPTORS = """
import asyncio, os, sys
sys.path.insert(0, {here!r})
from test_connections import Listener, connected, with_server
listener = Listener(most=1000)
async def work():
    clients = [await connected(listener) for _ in range(5)]
    held = []
    try:
        while True: held.append(os.dup(0))
    except OSError:
        os.close(held.pop())  # for the socket of a client
    for _ in range(3):
        clients.append(await connected(listener))
        os.close(held.pop())
    print([await client.open() for client in clients])
with_server(listener, work)
"""


def test_without_a_descriptor_the_oldest_connection_is_closed() -> None:
    code = WITHOUT_DESCRIPTORS.format(here=str(Path(__file__).parent))
    done = subprocess.run(
        ["bash", "-c", 'ulimit -n 64; exec "$0" -c "$1"', sys.executable, code],
        check=True, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert json.loads(done.stdout.lower())[-3:] == [True] * 3
    assert not done.stderr


def test_a_message_is_written_less_often_the_more_often_it_comes(caplog: pytest.LogCaptureFixture) -> None:
    logger = logging.getLogger("test_connections")
    with repetitions_counted(logger.name):
        for number in range(1000):
            logger.warning("Invalid request of %s.\nIt was %d.", "a stranger", number)
            if number % 100 == 0:
                logger.error("socket.accept() out of system resource\nsocket: %d" % number)  # noqa: UP031
    logger.warning("Invalid request of %s.\nIt was %d.", "a stranger", 1000)
    assert [text.replace("\n", " ") for text in caplog.messages] == [
        "Invalid request of a stranger. It was 0.", "socket.accept() out of system resource socket: 0",
        "Invalid request of a stranger. It was 9. (10 times)", "Invalid request of a stranger. It was 99. (100 times)",
        "socket.accept() out of system resource socket: 900 (10 times)",
        "Invalid request of a stranger. It was 999. (1,000 times)", "Invalid request of a stranger. It was 1000.",
    ]  # fmt: skip


# -- the server as a process ------------------------------------------------------------------------------------------


class Served:
    """`ortho measure` with few descriptors, and the person whose browser has the cookie."""

    def __init__(self, folder: Path, reference: Path) -> None:
        self._log = folder / "log"
        with self._log.open("w") as log:
            self.process = subprocess.Popen(
                ["bash", "-c", f'ulimit -n {DESCRIPTORS}; exec "$0" "$@"', sys.executable, "-m", "ortho_pipeline",
                 "measure", str(SAMPLE / "scene.tif"), "--reference", str(reference), "--dem", str(SAMPLE / "dem.tif"),
                 "-o", str(folder / "p.geojson"), "--no-browser"],
                stdout=subprocess.PIPE, stderr=log, text=True,
            )  # fmt: skip
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().split()[-1]
        self._browser = request.build_opener(request.HTTPCookieProcessor())
        self.port = int(self.address.split("/")[2].split(":")[1])

    def enter(self) -> None:
        """Use the address that works once."""
        self._browser.open(self.address, timeout=5).close()

    def answers(self, within: float = 5.0) -> bool:
        """Return whether the person, on a new connection, gets an answer within so many seconds."""
        body = json.dumps({"window": "window-of-tests"}).encode()
        asked = request.Request(f"{self.address.split('?')[0]}api/state", body, {"content-type": "application/json"})
        try:
            with self._browser.open(asked, timeout=within) as answer:
                return "marks" in json.loads(answer.read())
        except OSError:
            return False

    def connections(self) -> int:
        """Return how many sockets the server has."""
        count = 0
        for path in Path(f"/proc/{self.process.pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                count += str(path.readlink()).startswith("socket:")
        return count

    def log(self) -> str:
        """Return what the server wrote on stderr."""
        return self._log.read_text()


@pytest.fixture
def served(reference: Path, tmp_path: Path) -> Iterator[Served]:
    pytest.importorskip("uvicorn", reason="the extra 'measure' is not installed")
    server = Served(tmp_path, reference)
    yield server
    server.process.kill()
    server.process.wait()


def stranger(port: int, sent: bytes) -> socket.socket:
    """Return a connection on which something was sent."""
    connection = socket.create_connection(("127.0.0.1", port), timeout=5)
    with contextlib.suppress(OSError):
        connection.sendall(sent)
    return connection


def closed(connection: socket.socket) -> bool:
    """Return whether the server has closed a connection, after what it answered."""
    connection.settimeout(0.01)
    try:
        while connection.recv(10_000):
            pass
    except TimeoutError:
        return False
    except OSError:
        pass
    return True


needs_proc = pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="no list of descriptors in /proc")


@needs_proc
def test_a_person_is_answered_among_300_connections_of_others(served: Served) -> None:
    before = served.connections()
    idle = [stranger(served.port, b"") for _ in range(STRANGERS)]
    served.enter()
    assert served.answers()
    assert served.connections() <= before + MOST + 4
    assert sum(closed(one) for one in idle) >= STRANGERS - MOST
    slow = [stranger(served.port, sent) for sent in BEGINNINGS * (STRANGERS // len(BEGINNINGS))]
    assert served.answers()
    assert served.connections() <= before + MOST + 4
    assert sum(closed(one) for one in idle) == STRANGERS
    assert sum(closed(one) for one in slow) >= STRANGERS - MOST
    assert len(served.log()) < 5_000, served.log()[:5_000]
    assert "Traceback" not in served.log()
    served.process.send_signal(signal.SIGINT)
    assert served.process.wait(30) == 0


@needs_proc
@pytest.mark.slow
def test_a_person_is_answered_while_others_connect_without_pause(served: Served) -> None:
    before, ended = served.connections(), threading.Event()

    def attack(sent: bytes) -> None:
        held: list[socket.socket] = []
        while not ended.is_set():
            with contextlib.suppress(OSError):
                held.append(stranger(served.port, sent))
            if len(held) > STRANGERS:
                held.pop(0).close()

    served.enter()
    threads = [threading.Thread(target=attack, args=(sent,)) for sent in BEGINNINGS]
    for thread in threads:
        thread.start()
    asked, longest = 0, 0.0
    try:
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            begun = time.monotonic()
            assert served.answers(10.0), f"after {asked} answers"
            asked, longest = asked + 1, max(longest, time.monotonic() - begun)
    finally:
        ended.set()
        for thread in threads:
            thread.join()
    print(f"{asked} answers, the longest in {longest:.2f} s; {len(served.log())} bytes of log")
    assert len(served.log()) < 20_000
    # Those that the attack has left are closed in time.
    last = [stranger(served.port, sent) for sent in BEGINNINGS]
    time.sleep(PATIENCE + 5.0)
    assert all(closed(one) for one in last)
    assert served.connections() <= before + 4
    assert served.answers()
