"""The server of the page, on this machine only: its files, tiles of images, uploads, downloads, and a socket.

The page in a notebook: a server in a thread of its own, on this machine, and a frame that shows it.
"""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPFile, parse_body_arguments
from tornado.ioloop import IOLoop
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler, stream_request_body
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from codegen.errors import ArgumentError, CodegenError
from codegen.registration.app import solving
from codegen.registration.app.autosave import Store, default_folder
from codegen.registration.app.live import LiveWork, Works, parsed
from codegen.registration.app.reading import (
    LIMITS,
    MOST_LANDMARK_BYTES,
    Files,
    example,
    in_order,
    picture_from,
    session_of,
)
from codegen.registration.app.session import Session, tile
from codegen.registration.formats import FORMATS, parse_landmarks
from codegen.registration.formats.base import Frames

HOSTS = ("localhost", "127.0.0.1", "[::1]")
"""Names of this machine. Others may be anybody's that lead here (DNS rebinding)."""


class Guarded(RequestHandler):
    """A handler that refuses foreign hosts and origins before anything is read, and lets no page frame this one.

    `ancestors` of the application's settings are the origins whose pages may frame it: those of a notebook.
    """

    def set_default_headers(self) -> None:
        """What browsers enforce: no scripts, styles, images or connections but those of this server."""
        port = self.application.settings["port"]
        ancestors = self.application.settings["ancestors"]
        sockets = " ".join(f"ws://{host}:{port}" for host in HOSTS[:2])
        policy = {
            "default-src": "'none'", "script-src": "'self'", "style-src": "'self'", "img-src": "'self' blob:",
            "connect-src": f"'self' {sockets}", "base-uri": "'none'", "form-action": "'none'",
            "frame-ancestors": " ".join(ancestors) or "'none'",
        }  # fmt: skip
        self.set_header("Content-Security-Policy", "; ".join(f"{name} {value}" for name, value in policy.items()))
        if not ancestors:
            self.set_header("X-Frame-Options", "DENY")
        self.set_header("X-Content-Type-Options", "nosniff")
        self.set_header("Referrer-Policy", "no-referrer")  # the name of a work stands in the address
        self.set_header("Cross-Origin-Resource-Policy", "same-origin")
        self.set_header("Cache-Control", "no-store")
        self.clear_header("Server")

    def prepare(self) -> None:
        """403 for a Host header that is not this machine's, and for an Origin that is not this server's."""
        port = self.application.settings["port"]
        hosts = {f"{host}:{port}" for host in HOSTS}
        if self.request.headers.get_list("Host") not in [[host] for host in hosts]:
            raise HTTPError(403, reason="Foreign host")
        origin = self.request.headers.get("Origin")
        if origin is None:
            if self.request.method not in ("GET", "HEAD") or self._is_upgrade():
                raise HTTPError(403, reason="No origin")
        elif not self.is_own(origin):
            raise HTTPError(403, reason="Foreign origin")

    def is_own(self, origin: str) -> bool:
        """Whether a page is one of this server's."""
        parts = urlsplit(origin)
        port = self.application.settings["port"]
        return parts.scheme == "http" and parts.netloc in {f"{host}:{port}" for host in HOSTS}

    def _is_upgrade(self) -> bool:
        return self.request.headers.get("Upgrade", "").lower() == "websocket"

    def write_error(self, status_code: int, **values: object) -> None:
        """The reason in a line, never a traceback."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code} {self._reason}\n")


class Nothing(Guarded):
    """Whatever else is asked for."""

    def prepare(self) -> None:
        """404, once host and origin are right."""
        super().prepare()
        raise HTTPError(404)


OVERHEAD = 1 << 16
"""Bytes of a form beside its files."""
MOST_AT_ONCE = 4
"""Files that are received at a time, by all pages together."""
MOST_FILES = 2
_receiving: set[int] = set()


@stream_request_body
class Upload(Guarded):
    """A handler whose body is a form with files of at most `most` bytes together."""

    most = 0

    def prepare(self) -> None:
        """413 for a body that is too long, 411 for one of unknown length, 503 while too many others are received."""
        super().prepare()
        try:
            length = int(self.request.headers["Content-Length"])
        except (KeyError, ValueError):
            raise HTTPError(411) from None
        if length > self.most + OVERHEAD:
            raise HTTPError(413)
        if len(_receiving) >= MOST_AT_ONCE:
            raise HTTPError(503, reason="Too many files at once, try again")
        _receiving.add(id(self))
        self._length = length
        self._body = bytearray()

    def data_received(self, chunk: bytes) -> None:
        """Another part of the body."""
        if len(self._body) + len(chunk) > self._length:
            raise HTTPError(413)
        self._body += chunk

    def on_finish(self) -> None:
        """Answered."""
        _receiving.discard(id(self))

    def on_connection_close(self) -> None:
        """Broken off."""
        _receiving.discard(id(self))

    def files(self) -> Files:
        """Names and contents; 400 where there is none."""
        found: dict[str, list[HTTPFile]] = {}
        arguments: dict[str, list[bytes]] = {}
        kind = self.request.headers.get("Content-Type", "")
        parse_body_arguments(kind, bytes(self._body), arguments, found)
        self._body.clear()
        received: list[Any] = [file for files in found.values() for file in files]
        if not 0 < len(received) <= MOST_FILES:
            raise HTTPError(400, reason="One or two files are expected")
        return [(file.filename, file.body) for file in received]


HOST = "localhost"
KINDS = {
    ".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}  # fmt: skip
MOST_MESSAGE = 1 << 20
"""Bytes of what a page sends through its socket."""
CLIENT = 64
"""Characters of what a tab calls itself."""
aside = ThreadPoolExecutor(2, thread_name_prefix="registration-files")
"""Decodes images and encodes tiles and downloads."""


def application(works: Works, port: int, ancestors: Sequence[str] = ()) -> Application:
    """All that is served at a port; `ancestors` are origins whose pages may frame it."""
    work = r"/work/([0-9a-f]{32})"
    routes: list[Any] = [
        (rf"/(|{'|'.join(_ASSETS)})", Asset),
        (rf"{work}/tile/([0-9a-f]{{64}})/(\d{{1,2}})/(\d{{1,4}})/(\d{{1,4}})", Tile),
        (rf"{work}/image/(moving|fixed|alone)", OpenImage),
        (rf"{work}/landmarks", OpenLandmarks),
        (rf"{work}/example", OpenExample),
        (rf"{work}/export/(image|field|animation|landmarks)", Export),
        (r"/socket", Socket),
    ]
    return Application(
        routes, default_handler_class=Nothing, works=works, port=port, ancestors=tuple(ancestors), log_function=_quiet,
        websocket_max_message_size=MOST_MESSAGE, websocket_ping_interval=20,
    )  # fmt: skip


def _quiet(handler: Any) -> None:
    """Requests are nobody's business; errors are logged all the same."""


_FOLDER = files("codegen.registration.app") / "static"
_ASSETS = {entry.name: entry.read_bytes() for entry in _FOLDER.iterdir() if Path(entry.name).suffix in KINDS}


class Asset(Guarded):
    """The files of the page, which are all in memory: no path of a request is ever looked up on the disk."""

    def get(self, name: str) -> None:
        """The page itself, or one of its files."""
        name = name or "index.html"
        self.set_header("Content-Type", KINDS[Path(name).suffix])
        self.finish(_ASSETS[name])


class OfWork(Guarded):
    """What belongs to a work that is open."""

    @property
    def works(self) -> Works:
        """All works."""
        found: Works = self.application.settings["works"]
        return found

    def work(self, token: str) -> LiveWork:
        """The work of that name; 404 where it is not open."""
        found = self.works.find(token)
        if found is None:
            raise HTTPError(404)
        return found

    def refuse(self, error: CodegenError) -> None:
        """Say what is wrong with what was sent or asked for."""
        self.set_status(422)
        self.set_header("Content-Type", "application/json")
        self.finish(json.dumps({"error": str(error)}))

    def answer(self, values: Mapping[str, Any]) -> None:
        """Values for the page."""
        self.set_header("Content-Type", "application/json")
        self.finish(json.dumps(values))


class Tile(OfWork):
    """A square of one of the two images."""

    async def get(self, token: str, digest: str, level: str, column: str, row: str) -> None:
        """A PNG file, which never changes."""
        session = self.work(token).session
        picture = next((p for p in (session.moving, session.picture("fixed")) if p.digest == digest), None)
        made = None
        if picture is not None:
            made = await _elsewhere(partial(tile, picture, int(level), int(column), int(row)))
        if made is None:
            raise HTTPError(404)
        self.set_header("Content-Type", "image/png")
        self.set_header("Cache-Control", "private, max-age=86400, immutable")
        self.finish(made)


class OpenImage(Upload, OfWork):
    """Another moving or fixed image, or one alone that is bent."""

    most = LIMITS.bytes

    async def post(self, token: str, which: str) -> None:
        """Take the image into the work."""
        work = self.work(token)
        name, data = self.files()[0]
        try:
            picture = await _elsewhere(lambda: picture_from(data, name))
            await _elsewhere(lambda: (picture.levels, picture.digest))
            session = work.session
            if which == "alone":
                work.change(partial(session.open_alone, picture), images=True)
            else:
                work.change(partial(session.open, "moving" if which == "moving" else "fixed", picture), images=True)
        except CodegenError as error:
            self.refuse(error)
        else:
            self.answer({})


class OpenLandmarks(Upload, OfWork):
    """Pairs from one or two files."""

    most = 2 * MOST_LANDMARK_BYTES

    async def post(self, token: str) -> None:
        """Take the pairs instead of those that there are."""
        work = self.work(token)
        frames = Frames(work.session.moving.shape, work.session.picture("fixed").shape)
        try:
            ordered, remarks = in_order(self.files())
            landmarks = await _elsewhere(lambda: parse_landmarks(ordered, frames=frames))
            work.change(partial(work.session.load, landmarks))
        except CodegenError as error:
            self.refuse(error)
        else:
            self.answer({"remark": " ".join(remarks)})


class OpenExample(OfWork):
    """The bundled example."""

    def post(self, token: str) -> None:
        """Show it instead of what is there."""
        work, made = self.work(token), example()
        work.change(partial(work.session.replace, made.moving, made.fixed, made.work), images=True)
        self.answer({})


class Export(OfWork):
    """A file for the visitor, made when it is asked for."""

    async def post(self, token: str, kind: str) -> None:
        """One file, or for landmarks in two files the one that `part` names."""
        work = self.work(token)
        form, part = self.get_query_argument("form", "csv"), self.get_query_argument("part", "0")
        grid = self.get_query_argument("grid", "") == "1"
        task = work.session.task()
        if form not in FORMATS or part not in ("0", "1"):
            raise HTTPError(400)
        jobs: dict[str, Callable[[], Any]] = {
            "image": partial(solving.warped_image, task), "field": partial(solving.field, task),
            "landmarks": lambda: solving.landmarks(task, form), "animation": partial(solving.animation, task, grid),
        }  # fmt: skip
        try:
            if kind != "landmarks":
                work.require_solver()
            made = await _elsewhere(jobs[kind])
        except CodegenError as error:
            self.refuse(error)
            return
        parts = made if isinstance(made, tuple) else (made,)
        download = parts[min(int(part), len(parts) - 1)]
        self.set_header("Content-Type", download.kind)
        self.set_header("Content-Disposition", f"attachment; filename*=UTF-8''{quote(download.name)}")
        self.set_header("X-Parts", str(len(parts)))
        self.finish(download.data)


class Socket(OfWork, WebSocketHandler):
    """The way between a tab and its work."""

    live: LiveWork | None = None
    client = ""

    def check_origin(self, origin: str) -> bool:
        """Whether the page is one of this server's."""
        return self.is_own(origin)

    def open(self, *arguments: str, **values: str) -> None:
        """A tab names itself and the work that it shows."""
        self.client = self.get_query_argument("client", "")[:CLIENT]
        self.set_nodelay(True)
        self.live = self.works.get(self.get_query_argument("work", ""))
        self.live.join(self.client, self)

    def on_message(self, message: str | bytes) -> None:
        """Something is asked for."""
        if self.live is not None:
            self.live.hear(self.client, parsed(message))

    def on_close(self) -> None:
        """The tab is gone, or its connection."""
        if self.live is not None:
            self.live.leave(self.client, self)
            self.works.left(self.live)

    def send(self, message: Mapping[str, Any] | bytes) -> None:
        """Send values or a packed picture; whoever is gone hears nothing."""
        try:
            if isinstance(message, bytes):
                self.write_message(message, binary=True)
            else:
                self.write_message(json.dumps(message, allow_nan=False))
        except WebSocketClosedError:
            pass


async def _elsewhere(job: Callable[[], Any]) -> Any:
    return await IOLoop.current().run_in_executor(aside, job)


def listen(works: Works, sockets: Sequence[socket.socket], port: int, ancestors: Sequence[str] = ()) -> HTTPServer:
    """Begin to serve works in the present event loop."""
    server = HTTPServer(
        application(works, port, ancestors), max_body_size=max(LIMITS.bytes, 2 * MOST_LANDMARK_BYTES) + OVERHEAD,
        max_header_size=1 << 14, idle_connection_timeout=600,
    )  # fmt: skip
    server.add_sockets(sockets)
    return server


def serve(images: Sequence[Path] = (), port: int = 5006, show: bool = True, state: Path | None = None) -> None:
    """Serve the page until it is interrupted.

    Images are read once, before anything is served: raises ImageError and ArgumentError, the latter also for a port
    that is in use, and FileError where works cannot be saved in the folder `state`.
    """
    store = Store(state or default_folder())
    store.require_writable()
    opened = session_of(images)
    asyncio.run(_serve(opened, port, show, store))


async def _serve(opened: Session, port: int, show: bool, store: Store) -> None:
    loop = IOLoop.current()

    def begun() -> Session:
        """A session of its own for every new work, on the images that were given."""
        return Session(opened.moving, opened.fixed, opened.work)

    works = Works(begun, loop.add_callback, loop.call_later, store)
    server = listen(works, _sockets(port), port)
    if show:
        loop.run_in_executor(aside, webbrowser.open, f"http://{HOST}:{port}/")
    try:
        await asyncio.Event().wait()
    finally:
        server.stop()


def _sockets(port: int) -> list[socket.socket]:
    """ArgumentError when something else listens there."""
    try:
        return bind_sockets(port, "127.0.0.1", socket.AF_INET)
    except (OSError, OverflowError) as error:
        raise ArgumentError(f"--port {port} cannot be used ({error})", "choose another port") from error


ANCESTORS = ("'self'", "http://localhost:*", "http://127.0.0.1:*")
"""Origins of notebooks on this machine, whose pages may frame this one."""


@dataclass(frozen=True)
class NotebookPage:
    """The page of one session, which shows itself in a notebook that runs on the same machine as its browser."""

    session: Session
    work: LiveWork
    port: int
    server: HTTPServer
    loop: IOLoop

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{HOST}:{self.port}/"

    def _repr_html_(self) -> str:
        address = escape(self.address, quote=True)
        return (
            f'<p><a href="{address}" target="_blank">Image registration by landmarks</a></p>'
            f'<iframe src="{address}" title="Image registration" width="100%" height="720"></iframe>'
        )

    def close(self) -> None:
        """End the server; the session stays."""
        self.loop.add_callback(self.server.stop)


def shown(session: Session) -> NotebookPage:
    """Serve a session until the kernel ends, or `close` is called; nothing is saved automatically."""
    ready: list[NotebookPage] = []
    begun = threading.Event()

    async def run() -> None:
        loop = IOLoop.current()
        sockets = bind_sockets(0, "127.0.0.1")
        port = int(sockets[0].getsockname()[1])
        work = LiveWork(session, loop.add_callback, None, "0" * 32)
        works = Works(lambda: session, loop.add_callback, loop.call_later, only=work)
        ready.append(NotebookPage(session, work, port, listen(works, sockets, port, ANCESTORS), loop))
        work.draw()
        begun.set()
        await asyncio.Event().wait()

    threading.Thread(target=lambda: asyncio.run(run()), name="registration-page", daemon=True).start()
    begun.wait()
    return ready[0]
