"""The guard before the page: this machine alone, the right host, the secret of the address, and bodies of a size.

The address holds a random token as its first folder; nothing is answered without it. A page of another origin does not
know the token, and a name that an attacker lets point at this machine fails at the Host header.
"""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

#: A request has no longer body than this (bytes).
MAX_BODY = 64_000
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
    """An ASGI application that lets through what may be asked, without the token in the path.

    Parameters
    ----------
    app : ASGI application
    hosts : set of str
        Host headers that are ours: name and port.
    token : str
    """

    def __init__(self, app: App, hosts: set[str], token: str) -> None:
        self._app, self._hosts, self._token = app, {host.encode() for host in hosts}, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            raise RuntimeError("only HTTP is spoken here")
        status, path = self._judged(scope)
        if status:
            await _refused(send, status)
            return
        body = await _body(receive)
        if body is None:
            await _refused(send, 413)
            return
        inner = {**scope, "path": path, "raw_path": path.encode(), "root_path": ""}
        await self._app(inner, _replayed(body, receive), _with_headers(send))

    def _judged(self, scope: Scope) -> tuple[int, str]:
        """Return a status to refuse with, or 0 and the path without the token."""
        headers: dict[bytes, list[bytes]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.lower(), []).append(value)
        hosts = headers.get(b"host", [])
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return 421, ""
        for origin in headers.get(b"origin", []):
            if origin.lower() not in {b"http://" + host for host in self._hosts}:
                return 403, ""
        if headers.get(b"sec-fetch-site", [b"none"])[0] == b"cross-site" and scope["method"] != "GET":
            return 403, ""
        parts = scope["path"].split("/", 2)
        if len(parts) != 3 or not secrets.compare_digest(parts[1].encode(), self._token.encode()):
            return 404, ""
        return 0, "/" + parts[2]


async def _body(receive: Receive) -> bytes | None:
    """Return the body of a request, None where it is too long."""
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
    """Return what gives a body that was read already once more."""
    given = False

    async def again() -> MutableMapping[str, Any]:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            own = list(message.get("headers", []))
            named = {name for name, _ in own}
            message = {**message, "headers": [*own, *(one for one in HEADERS if one[0] not in named)]}
        await send(message)

    return sending


async def _refused(send: Send, status: int) -> None:
    body = b"refused\n"
    headers = [(b"content-type", b"text/plain"), (b"content-length", str(len(body)).encode()), *HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
