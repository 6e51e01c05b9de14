"""The server of the page: starlette behind the guard, for this machine only.

The page can load only a fixed table of files, read at the start of the server: it never opens a path of a request.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import threading
from collections.abc import Callable, Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

from ortho_measure.block.session import BlockSession
from ortho_measure.project import Project
from ortho_measure.serving.entry import PageEntry
from ortho_measure.serving.guard import REPORT_POLICY, Admit, App, Guard
from ortho_measure.serving.listener import LOOPBACK, QUEUE, Listener
from ortho_measure.serving.log import repetitions_counted
from ortho_measure.serving.making import PICTURES, Making
from ortho_measure.serving.tiles import MOST, SIDE, TileServer
from ortho_measure.session import Session
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import parse_json
from ortho_pipeline.options import CORRECTIONS, OutputOptions, SceneOptions
from ortho_pipeline.raster.caching.block_cache import limit_cache
from ortho_pipeline.runtime.process_limits import thread_pool

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

#: The files of the page: name -> media type.
PAGE = {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "app.js": "text/javascript; charset=utf-8",
    "views.js": "text/javascript; charset=utf-8",
    "table.js": "text/javascript; charset=utf-8",
    "ol.js": "text/javascript; charset=utf-8",
    "ol.css": "text/css; charset=utf-8",
    "ol-LICENSE.md": "text/plain; charset=utf-8",
}
_REMEDY = "reload the page"


class Windows:
    """Which browser window can write: the first one, until it leaves or another takes over."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._writer: str | None = None

    def claim(self, window: str, *, take: bool = False) -> bool:
        """Return whether a window can write; with `take`, it takes over."""
        with self._lock:
            if not self._writer or take:
                self._writer = window
            return self._writer == window

    def writes(self, window: str) -> bool:
        """Return whether a window can write without `claim`: after another one has left, its points may be old."""
        with self._lock:
            if self._writer is None:
                self._writer = window
            return self._writer == window

    def leave(self, window: str) -> None:
        """Release the right to write, if this window has it."""
        with self._lock:
            if self._writer == window:
                self._writer = ""


class _Answers:
    """The answers to requests; methods have the names of the paths."""

    def __init__(self, session: Project, tiles: TileServer) -> None:
        self._session, self._tiles, self._windows = session, tiles, Windows()
        self.making = Making(session)

    @property
    def scene(self) -> Session:
        """The session of a single scene.

        Raises
        ------
        InputError
            If there are several scenes.
        """
        if not isinstance(self._session, Session):
            raise InputError("this request is for a single scene", field="request", remedy=_REMEDY)
        return self._session

    def begin(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return what does not change: sizes, names, bands."""
        session = self._session
        writes = not session.journal.read_only and self._windows.claim(_window(given), take=bool(given.get("take")))
        return {
            "images": [_facts(view.intensity.source.path, view.size) for view in session.views],
            "maps": [_facts(sheet.reference.path, sheet.size) for sheet in session.sheets],
            "labels": list(session.images.labels) if isinstance(session, BlockSession) else None,
            "output": os.path.basename(session.output),
            "tile": SIDE,
            "bands": self._tiles.bands,
            "corrections": list(CORRECTIONS),
            "writes": writes,
            "locked": session.journal.read_only,
            "healed": session.journal.healed,
            "stopped": session.stopped,
            "state": session.state(),
        }

    def leave(self, given: dict[str, Any]) -> dict[str, Any]:
        """Record that a window was closed."""
        self._windows.leave(_window(given))
        return {}

    def act(self, given: dict[str, Any]) -> dict[str, Any]:
        """Apply an action; only for the window that can write."""
        self._require_writer(given)
        action = given.get("action")
        if not isinstance(action, dict):
            raise InputError("the request has no action", field="action")
        return self._session.act(action)

    def state(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return everything that changes."""
        return self._session.state()

    def predict(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the positions of a place in all views."""
        version = _whole(given.get("version", 0))
        if given.get("ground") is not None:
            return self._session.predict(version, ground=_numbers(given["ground"], 3))
        return self._session.predict(version, str(given.get("at")), _numbers(given.get("place"), 2))

    def link(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the relation of one view to another."""
        version, place = _whole(given.get("version", 0)), _numbers(given.get("place"), 2)
        return self._session.link(version, str(given.get("at")), place, str(given.get("to")))

    def propose(self, given: dict[str, Any]) -> dict[str, Any]:
        """Match a click."""
        image, ground = given.get("image"), given.get("ground")
        if image is None and ground is None:
            raise InputError("no position to match", field="image", remedy=_REMEDY)
        return self.scene.proposal(
            None if image is None else _numbers(image, 2), None if ground is None else _numbers(ground, 3)
        )

    def tie(self, given: dict[str, Any]) -> dict[str, Any]:
        """Match a click in one of several images, or ground, in all images."""
        session, known = self._session, given.get("known") or {}
        if not isinstance(session, BlockSession) or not isinstance(known, dict):
            raise InputError("this request is for several images", field="request", remedy=_REMEDY)
        if given.get("ground") is not None:
            return session.of_ground(_numbers(given["ground"], 3))
        number, labels = _whole(given.get("number")), session.images.labels
        if number >= len(labels) or not set(known) <= set(labels):
            raise InputError("unknown image", field="number", remedy=_REMEDY)
        places = {str(label): _numbers(place, 2) for label, place in known.items()}
        return session.proposal(number, _numbers(given.get("image"), 2), places)

    def typed(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return entered coordinates as ground."""
        values = given.get("values")
        if not isinstance(values, list) or len(values) != 3:
            raise InputError("enter x and y; the height is optional", field="values")
        numbers = [None if value is None else _numbers([value], 1)[0] for value in values]
        vertical = given.get("vertical")
        return {
            "ground": self._session.typed(numbers, str(given.get("crs") or ""), str(vertical) if vertical else None)
        }

    def stretch(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the values of black and white for each band."""
        pane, box = str(given.get("pane")), given.get("box")
        if pane not in self._tiles.bands:
            raise InputError("unknown view", field="pane")
        where = None if box is None else _numbers(box, 4)
        bands, version = _bands(given.get("bands")), _whole(given.get("version", 0))
        return {"limits": [self._tiles.limits(pane, version, where, self._band(pane, band)) for band in bands]}

    def compare(self, given: dict[str, Any]) -> dict[str, Any]:
        """Compare models on the points."""
        return self._session.compared()

    def save(self, given: dict[str, Any]) -> dict[str, Any]:
        """Write the points."""
        self._session.save()
        return {}

    def make(self, given: dict[str, Any]) -> dict[str, Any]:
        """Start the ortho of an image."""
        self._require_writer(given)
        return self.making.begin(_whole(given.get("number", 0)))

    def made(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the progress of the ortho."""
        return self.making.told()

    def _require_writer(self, given: dict[str, Any]) -> None:
        if not self._windows.writes(_window(given)):
            raise InputError(
                "these points are open in another window; this one is read-only", field="window", remedy="take over"
            )

    def _band(self, pane: str, band: int) -> int:
        if not 0 <= band <= self._tiles.bands[pane]:
            raise InputError("unknown band", field="bands")
        return band


def application(
    session: Project,
    entry: PageEntry,
    hosts: set[str],
    opened: SceneOptions = SceneOptions(),
    admit: Admit | None = None,
) -> App:
    """Return the ASGI application of a session."""
    from starlette.applications import Starlette
    from starlette.routing import Route

    given = _Given(session, TileServer(session, opened))
    routes = [
        Route("/", given.page),
        Route("/api/{what}", given.answer, methods=["POST"]),
        Route("/made/{which}", given.outcome),
        Route("/tiles/{pane}/{version:int}/{factor:int}/{column:int}/{row:int}", given.tile),
        Route("/{name}", given.page),
    ]
    return Guard(Starlette(routes=routes), hosts, entry, admit)


class _Given:
    """The responses: files of the page, tiles, answers, and results; threads do the work."""

    def __init__(self, session: Project, tiles: TileServer) -> None:
        self._session, self._tiles, self._answers = session, tiles, _Answers(session, tiles)
        room = resources.files("ortho_measure")
        self._files = {name: room.joinpath("page", name).read_bytes() for name in PAGE}
        self._workers = thread_pool(max(2, os.cpu_count() or 1), "measure")

    async def _run(self, work: Callable[..., Any], *given: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._workers, work, *given)

    async def page(self, request: Request) -> Response:
        """Return a file of the page."""
        from starlette.responses import Response

        name = request.path_params.get("name", "index.html")
        if name not in self._files:
            return Response("refused\n", 404)
        return Response(self._files[name], media_type=PAGE[name], headers={"cache-control": "no-cache"})

    async def tile(self, request: Request) -> Response:
        """Return a tile."""
        from starlette.responses import JSONResponse, Response

        try:
            given = _tile(request)
            made = await self._run(lambda: self._tiles.png(*given))
        except OrthoError as error:
            return JSONResponse(_told(error), 400)
        # The address contains everything that the pixels depend on.
        return Response(made, media_type="image/png", headers={"cache-control": "private, max-age=86400, immutable"})

    async def outcome(self, request: Request) -> Response:
        """Return the report of the ortho, or a picture of it."""
        from starlette.responses import JSONResponse, Response

        which, own = request.path_params["which"], {"cache-control": "no-store"}
        try:
            making = self._answers.making
            if which == "report":
                own["content-security-policy"] = REPORT_POLICY
                return Response(await self._run(making.report), media_type="text/html; charset=utf-8", headers=own)
            if which not in PICTURES:
                return Response("refused\n", 404)
            return Response(await self._run(making.picture, which), media_type="image/png", headers=own)
        except OrthoError as error:
            return JSONResponse(_told(error), 400)

    async def answer(self, request: Request) -> Response:
        """Answer a request of the page."""
        from starlette.responses import JSONResponse, Response

        what = request.path_params["what"]
        work = getattr(self._answers, what) if what in ASKED else None
        if work is None:
            return Response("refused\n", 404)
        try:
            given = _asked(await request.body())
            done = await self._run(work, given)
        except OrthoError as error:
            return JSONResponse(_told(error), 409 if error.field == "window" else 400)
        if what == "act":
            self._workers.submit(self._session.save)
        return JSONResponse(done, headers={"cache-control": "no-store"})


#: Allowed requests: methods of `_Answers`.
ASKED = (
    "begin",
    "leave",
    "act",
    "state",
    "predict",
    "link",
    "propose",
    "tie",
    "typed",
    "stretch",
    "compare",
    "save",
    "make",
    "made",
)


def serve(session: Project, opened: SceneOptions, ready: Callable[[str], None], port: int = 0) -> None:
    """Serve the page of a session until the process is stopped.

    Parameters
    ----------
    ready : callable
        Called with the address when the server is ready. The address works once.
    port : int
        0 means any free port.

    Raises
    ------
    InputError
        If the port cannot be used.
    """
    import uvicorn

    try:
        entry, listener = PageEntry(), Listener(port)
    except OSError as error:
        raise InputError(
            f"port {port} of this machine cannot be used ({error.strerror or error})",
            field="port",
            remedy=Text("give another ", Setting("port"), ", or leave it out to use any free port"),
        ) from error
    number = listener.getsockname()[1]
    hosts = {f"{LOOPBACK}:{number}", f"localhost:{number}"}
    limit_cache(OutputOptions.memory, os.cpu_count() or 1)
    app = application(session, entry, hosts, opened, listener.admit)
    # h11 limits the size of headers. The listener gets the true address of a client, whatever headers state.
    config = uvicorn.Config(
        app,
        loop="asyncio",
        http="h11",
        ws="none",
        lifespan="off",
        proxy_headers=False,
        server_header=False,
        date_header=False,
        access_log=False,
        log_config=None,
        timeout_graceful_shutdown=3,
        backlog=QUEUE,
    )
    try:
        ready(f"http://{LOOPBACK}:{number}{entry.path}")
        # Ctrl-C ends this command normally.
        with contextlib.suppress(KeyboardInterrupt), repetitions_counted("uvicorn.error", "asyncio"):
            uvicorn.Server(config).run([listener])
    finally:
        listener.close()
        session.close()


# -- contents of requests --------------------------------------------------------------------------------------------


def _asked(body: bytes) -> dict[str, Any]:
    document = parse_json(body or b"{}", "request", _REMEDY)
    if not isinstance(document, dict):
        raise InputError("a request must be a JSON object", remedy=_REMEDY)
    try:
        json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        # JSON can contain unpaired surrogates, which files and answers cannot.
        raise InputError("this request has text that is not Unicode", field="request", remedy=_REMEDY) from error
    return document


def _tile(request: Request) -> tuple[Any, ...]:
    given = request.path_params
    query = request.query_params
    numbered = [text.isascii() and text.isdigit() and len(text) < 10 for text in query.get("b", "0").split(",")]
    if not all(numbered):
        raise InputError("unknown band", field="bands")
    bands = _bands([int(text) for text in query.get("b", "0").split(",")])
    values = query.get("l", "").split(",")
    if len(values) != 2 * len(bands):
        raise InputError("unknown tile", field="tile")
    try:
        limits = _numbers([float(text) for text in values], len(values))
    except ValueError:
        raise InputError("unknown tile", field="tile") from None
    pairs = list(zip(limits[::2], limits[1::2], strict=True))
    factor, column, row = given["factor"], given["column"], given["row"]
    if factor > MOST or max(column, row) > 1 << 20:
        raise InputError("unknown tile", field="tile")
    return given["pane"], given["version"], factor, column, row, bands, pairs


def _bands(values: Any) -> list[int]:
    bands = [_whole(value) for value in values] if isinstance(values, list) else []
    if len(bands) not in (1, 3):
        raise InputError("choose one band (grey) or three (colour)", field="bands")
    return bands


def _whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 31:
        raise InputError("this must be a whole number", field="request", remedy=_REMEDY)
    return value


def _numbers(values: Any, count: int) -> list[float]:
    """Return a list of this many finite numbers from a request."""
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        raise InputError(f"this must be a list of {count} numbers", field="request", remedy=_REMEDY)
    for value in values:
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
            or abs(value) > 1e12
        ):
            raise InputError("this must be a number", field="request", remedy=_REMEDY)
    return [float(value) for value in values]


def _facts(path: str, size: tuple[int, int]) -> dict[str, Any]:
    return {"name": os.path.basename(path), "size": list(size)}


def _window(given: dict[str, Any]) -> str:
    name = given.get("window")
    if not isinstance(name, str) or not 8 <= len(name) <= 64:
        raise InputError("the window has no name", field="request", remedy=_REMEDY)
    return name


def _told(error: OrthoError) -> dict[str, Any]:
    """Return an error for the page, without paths of this machine."""
    return {"error": {"message": error.message, "field": error.field, "remedy": error.remedy}}
