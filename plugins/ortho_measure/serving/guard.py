"""The guard of the page: only this machine, the right host, the cookie, and limited request bodies.

Every request needs the cookie, which the address of `PageEntry` sets once. Pages of other origins cannot use it. A host
name that an attacker points to this machine fails at the Host header.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from ortho_measure.serving.entry import REFUSED, PageEntry, leading_to

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]
Headers = dict[bytes, list[bytes]]
#: Is told the address (host, port) of a client that has the cookie.
Admit = Callable[[tuple[str, int]], None]

#: A request has no longer body than this (bytes).
MAX_BODY = 64_000
#: Nor a longer path or query (bytes).
MAX_ADDRESS = 1_000
#: Nothing but what this server gives is loaded, run or asked; no other page shows this one.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: Of a report, which is one page with its styles and pictures in itself; its scripts do not run here.
REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'; sandbox"
HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), geolocation=(), microphone=()"),
)


class Guard:
    """An ASGI application that passes on allowed requests, without the folder of the entry in the path.

    Parameters
    ----------
    app : ASGI application
    hosts : set of str
        Host headers that are ours: name and port.
    entry : PageEntry
    admit : callable, optional
        Told the address of each client that has the cookie.
    """

    def __init__(self, app: App, hosts: set[str], entry: PageEntry, admit: Admit | None = None) -> None:
        self._app, self._hosts, self._entry, self._admit = app, {host.encode() for host in hosts}, entry, admit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            raise RuntimeError("only HTTP is supported")
        headers = _headers(scope)
        status = self._foreign(scope, headers)
        if status:
            await _refused(send, status)
            return
        query, known = scope["query_string"], self._entry.knows(headers.get(b"cookie", []))
        if known and self._admit and scope["client"]:
            self._admit(tuple(scope["client"]))
        path = scope["path"].removeprefix("/" + self._entry.folder)
        if path == "/" and scope["method"] == "GET" and query:
            cookie = None if known else self._entry.exchange(query)
            if cookie or known:
                await _entered(send, f"/{self._entry.folder}/", cookie)
                return
        if not known:
            await _refused(send, 403, REFUSED)
            return
        body = await _body(receive)
        if body is None:
            await _refused(send, 413)
            return
        inner = {**scope, "path": path, "raw_path": path.encode(), "root_path": ""}
        await self._app(inner, _replayed(body, receive), _with_headers(send))

    def _foreign(self, scope: Scope, headers: Headers) -> int:
        """Return the status for refusing another host, origin or folder; 0 for an allowed request."""
        hosts = headers.get(b"host", [])
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return 421
        for origin in headers.get(b"origin", []):
            if origin.lower() not in {b"http://" + host for host in self._hosts}:
                return 403
        # Another port of this machine is of the same site, and of another origin.
        if scope["method"] != "GET" and headers.get(b"sec-fetch-site", [b"none"])[0] not in (b"same-origin", b"none"):
            return 403
        if max(len(scope["path"]), len(scope["query_string"])) > MAX_ADDRESS:
            return 414
        return 0 if scope["path"].startswith(f"/{self._entry.folder}/") else 404


def _headers(scope: Scope) -> Headers:
    headers: Headers = {}
    for name, value in scope["headers"]:
        headers.setdefault(name.lower(), []).append(value)
    return headers


async def _body(receive: Receive) -> bytes | None:
    """Return the body of a request; None if it is too long."""
    parts, size, more = [], 0, True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            return b""
        parts.append(message.get("body", b""))
        size += len(parts[-1])
        if size > MAX_BODY:
            return None
        more = message.get("more_body", False)
    return b"".join(parts)


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Return a function that delivers a body that was already read."""
    delivered = False

    async def again() -> MutableMapping[str, Any]:
        nonlocal delivered
        if delivered:
            return await receive()
        delivered = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            own = list(message.get("headers", []))
            named = {name for name, _ in own}
            message = {**message, "headers": [*own, *(header for header in HEADERS if header[0] not in named)]}
        await send(message)

    return sending


async def _refused(send: Send, status: int, text: bytes = b"refused\n") -> None:
    await _answered(send, status, text, [(b"content-type", b"text/plain")])


async def _entered(send: Send, folder: str, cookie: bytes | None) -> None:
    given = [] if cookie is None else [(b"set-cookie", cookie)]
    kind = [(b"content-type", b"text/html; charset=utf-8"), (b"cache-control", b"no-store")]
    await _answered(send, 200, leading_to(folder).encode(), [*kind, *given])


async def _answered(send: Send, status: int, body: bytes, given: list[tuple[bytes, bytes]]) -> None:
    headers = [*given, (b"content-length", str(len(body)).encode()), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
