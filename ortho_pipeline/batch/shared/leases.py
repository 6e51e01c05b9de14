"""Who makes which scene: leases in a folder of objects, by writes that a store refuses if another one was faster.

A scene has a lease, which its worker renews while it lives, and a result in the end. Times of several machines are not
compared: a worker takes over a lease that it has seen unchanged for as long as `PATIENCE`, by its own clock.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import threading
from collections.abc import Iterator

from ortho_pipeline.batch.records import MAX_BYTES, RunRecord
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.files import json_text
from ortho_pipeline.stores.objects import Conflict, Objects

#: Seconds after which another worker may take a lease that is not renewed; it is renewed four times in that time.
PATIENCE = 120.0
_RENEWALS = 4
_LEASE, _RESULT = ".lease.json", ".result.json"


class Lost(OrthoError):
    """Another worker has taken over the lease."""


class Lease:
    """A scene that this worker makes, until the block of `held` ends."""

    def __init__(self, store: Objects, name: str, version: str | None, holder: str, beat: int = 0) -> None:
        self._store, self.name, self._version, self._holder, self._beat = store, name, version, holder, beat
        self._lock, self._lost = threading.Lock(), False

    @contextlib.contextmanager
    def held(self, patience: float) -> Iterator[Lease]:
        """Renew the lease in a thread for the length of the block."""
        stop = threading.Event()

        def renew() -> None:
            while not stop.wait(patience / _RENEWALS):
                with contextlib.suppress(OrthoError):
                    self.renew()

        thread = threading.Thread(target=renew, name="lease", daemon=True)
        thread.start()
        try:
            yield self
        finally:
            stop.set()
            thread.join()

    def renew(self) -> None:
        """Say that this worker lives.

        Raises
        ------
        Lost
            If another one has the lease.
        """
        with self._lock:
            if self._lost:
                raise Lost(f"another worker has taken over {self.name!r}")
            self._beat += 1
            data = lease_document(self._holder, self._beat)
            try:
                self._version = self._store.put(self.name + _LEASE, data, replacing=self._version).version
            except Conflict as error:
                self._lost = True
                raise Lost(f"another worker has taken over {self.name!r}") from error

    def finish(self, result: RunRecord) -> None:
        """Write the result of the scene, its record, in place of an older one.

        Raises
        ------
        Lost
            If another one has the lease.
        """
        self.renew()
        self._store.put(self.name + _RESULT, result.text().encode())


class Leases:
    """The leases and the results of a run in a folder of objects."""

    def __init__(self, address: str, *, allow_network: bool) -> None:
        self._store = Objects(address, allow_network=allow_network)
        self._holder = f"{socket.gethostname()} {os.getpid()} {secrets.token_hex(8)}"

    def take(self, name: str, seen: str | None = None) -> Lease | str:
        """Return the lease of a scene, or the version of the one that another worker holds.

        Parameters
        ----------
        seen : str, optional
            The version that may be taken over, of a dead worker.
        """
        data = lease_document(self._holder, 0)
        try:
            taken = self._store.put(name + _LEASE, data, new=seen is None, replacing=seen)
        except Conflict:
            with contextlib.suppress(FileNotFoundError):
                return self._store.version(name + _LEASE) or ""
            return ""
        return Lease(self._store, name, taken.version, self._holder)

    def result(self, name: str) -> RunRecord | None:
        """Return the result of a scene, None where there is none of its name that can be understood."""
        try:
            record = RunRecord.parse(self._store.read(name + _RESULT, MAX_BYTES)[0])
        except (FileNotFoundError, InputError):
            return None
        return record if record is not None and record.name == name else None

    def finished(self) -> frozenset[str]:
        """Return the names of the scenes that have a result."""
        return frozenset(name.removesuffix(_RESULT) for name, _ in self._store.names() if name.endswith(_RESULT))

    def forget(self, name: str) -> None:
        """Delete result and lease of a scene, so that it is made again."""
        self._store.delete(name + _RESULT)
        self._store.delete(name + _LEASE)


def lease_document(holder: str, beat: int) -> bytes:
    """Return the content of a lease, which no two workers and no two moments share."""
    return json_text({"holder": holder, "beat": beat}).encode()
