"""The listening socket of the page: it limits the number of connections, and the time of those without the cookie.

Every user of this machine can connect. Users without the cookie must not block its owner, neither by connections that
stay open, nor by so many that this process has no file descriptor left.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from dataclasses import dataclass
from typing import Any

LOOPBACK = "127.0.0.1"
#: Connections at a time. A browser opens six; each window of `ortho measure` shares them.
MOST = 64
#: Connections that wait to be accepted: room for a burst, and not so many that waiting behind them takes seconds.
QUEUE = 512
#: Seconds after which a connection without the cookie is closed.
PATIENCE = 10.0
_BETWEEN = 0.25
#: The process, or the system, has no descriptor or memory for one more connection.
_EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


@dataclass
class _Connection:
    socket: socket.socket
    since: float
    known: bool = False


class Listener(socket.socket):
    """A listening socket for this machine only; an asyncio event loop accepts its connections.

    A connection beyond `most` closes the oldest one without the cookie. A connection with the cookie is never closed.

    Parameters
    ----------
    port : int
        0 is any that is free.
    most : int, optional
        Connections at a time; a quarter of the descriptors of this process, and at most `MOST`, without.
    patience : float
        Seconds until a connection without the cookie is closed.
    """

    def __init__(self, port: int = 0, most: int | None = None, patience: float = PATIENCE) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_STREAM)
        self._most, self._patience = most or _affordable(), patience
        self._connections: dict[Any, _Connection] = {}
        self._accepted = self._watching = False
        try:
            self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.bind((LOOPBACK, port))
            self.listen()
        except OSError:
            self.close()
            raise

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept one connection for each turn of the event loop, so that each is read before it can be closed.

        Raises
        ------
        BlockingIOError
            Until the next turn.
        """
        if self._accepted:
            self._accepted = False
            raise BlockingIOError(errno.EAGAIN, "one connection at a time")
        try:
            connection, address = super().accept()
        except OSError as error:
            if error.errno in _EXHAUSTED and self._close_oldest_stranger():
                raise BlockingIOError(errno.EAGAIN, "a descriptor is being closed") from error
            raise
        self._accepted = True
        loop = asyncio.get_running_loop()
        self._forget_closed()
        self._connections[address] = _Connection(connection, loop.time())
        if len(self._connections) > self._most:
            self._close_oldest_stranger()
        if not self._watching:
            self._watch(loop)
        return connection, address

    def admit(self, address: Any) -> None:
        """Record that the connection from an address has the cookie."""
        if address in self._connections:
            self._connections[address].known = True

    def _watch(self, loop: asyncio.AbstractEventLoop) -> None:
        """Close connections without the cookie after some time, as long as there are connections."""
        self._forget_closed()
        for address, connection in list(self._connections.items()):
            if not connection.known and loop.time() - connection.since > self._patience:
                self._close(address)
        self._watching = bool(self._connections)
        if self._watching:
            loop.call_later(_BETWEEN, self._watch, loop)

    def _close_oldest_stranger(self) -> bool:
        """Close the oldest connection without the cookie, and return whether there is any."""
        address = next((address for address, one in self._connections.items() if not one.known), None)
        if address is None:
            return False
        self._close(address)
        return True

    def _close(self, address: Any) -> None:
        # The event loop closes the descriptor when it reads the end.
        with contextlib.suppress(OSError):
            self._connections.pop(address).socket.shutdown(socket.SHUT_RDWR)

    def _forget_closed(self) -> None:
        self._connections = {key: one for key, one in self._connections.items() if one.socket.fileno() >= 0}


def _affordable() -> int:
    try:
        import resource
    except ImportError:  # Windows
        return MOST
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MOST if descriptors == resource.RLIM_INFINITY else max(2, min(MOST, descriptors // 4))
