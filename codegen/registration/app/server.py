"""The web server of the page: files of the page, tiles of images, uploads, downloads and the web socket of a tab.

The server accepts connections from this machine only. `serve` runs until the process is interrupted. `shown` serves one
session for a notebook in a thread.
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
from typing import TypeVar
from urllib.parse import quote, urlsplit

from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPFile, parse_body_arguments
from tornado.ioloop import IOLoop
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler, stream_request_body
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from codegen.errors import ArgumentError, CodegenError
from codegen.registration.app import reading, solving
from codegen.registration.app.live import LiveWork, Message, Works, parsed
from codegen.registration.app.reading import Store, default_folder
from codegen.registration.app.session import Session, Work, tile
from codegen.registration.app.solving import Download
from codegen.registration.formats import FORMATS, parse_landmarks
from codegen.registration.formats.base import Frames

T = TypeVar("T")
HOST = "localhost"
HOSTS = ("localhost", "127.0.0.1", "[::1]")
"""Names of this machine. Other names that resolve to this machine may belong to attackers (DNS rebinding)."""
ANCESTORS = ("'self'", "http://localhost:*", "http://127.0.0.1:*")
"""Origins of notebooks on this machine, whose pages may show this page in a frame."""
KINDS = {
    ".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}  # fmt: skip
OVERHEAD = 1 << 16  # largest number of bytes of an upload in addition to its files
MOST_AT_ONCE = 4  # largest number of uploads at the same time, of all tabs together
MOST_FILES = 2
MOST_MESSAGE = 1 << 20  # largest number of bytes of a message of a tab
CLIENT = 64  # largest number of characters of the name of a tab
aside = ThreadPoolExecutor(2, thread_name_prefix="registration-files")
"""The threads that decode images and encode tiles and downloads."""
_receiving: set[int] = set()
_FOLDER = files("codegen.registration.app") / "static"
_ASSETS = {entry.name: entry.read_bytes() for entry in _FOLDER.iterdir() if Path(entry.name).suffix in KINDS}


class Guarded(RequestHandler):
    """A request handler that refuses foreign hosts and origins before the body of a request is read.

    No foreign page may show its answers in a frame, except pages of the origins in the setting `ancestors`.
    """

    def set_default_headers(self) -> None:
        """Let browsers load scripts, styles and images, and open connections, from this server only."""
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
        self.set_header("Referrer-Policy", "no-referrer")  # the address contains the name of a work
        self.set_header("Cross-Origin-Resource-Policy", "same-origin")
        self.set_header("Cache-Control", "no-store")
        self.clear_header("Server")

    def prepare(self) -> None:
        """Answer 403 for a foreign Host header, a foreign Origin, or a missing Origin where it is required."""
        port = self.application.settings["port"]
        hosts = {f"{host}:{port}" for host in HOSTS}
        if self.request.headers.get_list("Host") not in [[host] for host in hosts]:
            raise HTTPError(403, reason="Foreign host")
        origin = self.request.headers.get("Origin")
        if origin is None:
            is_upgrade = self.request.headers.get("Upgrade", "").lower() == "websocket"
            if self.request.method not in ("GET", "HEAD") or is_upgrade:
                raise HTTPError(403, reason="No origin")
        elif not self.is_own(origin):
            raise HTTPError(403, reason="Foreign origin")

    def is_own(self, origin: str) -> bool:
        """Return True for the origin of a page of this server."""
        parts = urlsplit(origin)
        port = self.application.settings["port"]
        return parts.scheme == "http" and parts.netloc in {f"{host}:{port}" for host in HOSTS}

    def write_error(self, status_code: int, **values: object) -> None:
        """Answer with the reason in one line, without a traceback."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code} {self._reason}\n")


class Nothing(Guarded):
    """The handler of all other addresses."""

    def prepare(self) -> None:
        """Answer 404, or 403 for a foreign host or origin."""
        super().prepare()
        raise HTTPError(404)


@stream_request_body
class Upload(Guarded):
    """A handler of forms with one or two files of at most `most` bytes together."""

    most = 0

    def prepare(self) -> None:
        """Answer 413 for too long bodies, 411 for unknown lengths, 503 during too many other uploads."""
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
        """Append a part of the body; answer 413 if it is longer than announced."""
        if len(self._body) + len(chunk) > self._length:
            raise HTTPError(413)
        self._body += chunk

    def on_finish(self) -> None:
        """Count an upload as finished or interrupted."""
        _receiving.discard(id(self))

    on_connection_close = on_finish

    def files(self) -> reading.Files:
        """Return the names and contents of the files; answer 400 unless there are one or two."""
        by_field: dict[str, list[HTTPFile]] = {}
        arguments: dict[str, list[bytes]] = {}
        parse_body_arguments(self.request.headers.get("Content-Type", ""), bytes(self._body), arguments, by_field)
        self._body.clear()
        received = [file for files in by_field.values() for file in files]
        if not 0 < len(received) <= MOST_FILES:
            raise HTTPError(400, reason="One or two files are expected")
        return [(file.filename, file.body) for file in received]


class Asset(Guarded):
    """The handler of the files of the page, which are in memory: requests cannot read the disk."""

    def get(self, name: str) -> None:
        """Answer with the page, or with one of its files."""
        name = name or "index.html"
        self.set_header("Content-Type", KINDS[Path(name).suffix])
        self.finish(_ASSETS[name])


class OfWork(Guarded):
    """A handler of requests that concern an open work."""

    @property
    def works(self) -> Works:
        """All open works."""
        works: Works = self.application.settings["works"]
        return works

    def work(self, token: str) -> LiveWork:
        """Return the work with this token; answer 404 if no such work is open."""
        work = self.works.find(token)
        if work is None:
            raise HTTPError(404)
        return work

    def answer(self, values: Mapping[str, str], status: int = 200) -> None:
        """Answer with JSON for the page."""
        self.set_status(status)
        self.set_header("Content-Type", "application/json")
        self.finish(json.dumps(values))


class Tile(OfWork):
    """The handler of a tile: a square part of one of the two images."""

    async def get(self, token: str, digest: str, level: str, column: str, row: str) -> None:
        """Answer with a PNG file, which a browser may keep; 404 if the work shows no such image."""
        session = self.work(token).session
        picture = next((p for p in (session.moving, session.picture("fixed")) if p.digest == digest), None)
        data = None
        if picture is not None:
            data = await _aside(partial(tile, picture, int(level), int(column), int(row)))
        if data is None:
            raise HTTPError(404)
        self.set_header("Content-Type", "image/png")
        self.set_header("Cache-Control", "private, max-age=86400, immutable")
        self.finish(data)


class OpenImage(Upload, OfWork):
    """The handler of the upload of a moving or fixed image, or of a single image to be deformed."""

    most = reading.LIMITS.bytes

    async def post(self, token: str, which: str) -> None:
        """Put the image into the work; answer 422 with the reason if it cannot be read."""
        work = self.work(token)
        name, data = self.files()[0]
        try:
            picture = await _aside(lambda: reading.picture_from(data, name))
            await _aside(lambda: (picture.levels, picture.digest))
            session = work.session
            if which == "alone":
                work.change(partial(session.replace, picture, None, Work(settings=session.work.settings)), images=True)
            else:
                work.change(partial(session.open, "moving" if which == "moving" else "fixed", picture), images=True)
        except CodegenError as error:
            self.answer({"error": str(error)}, 422)
        else:
            self.answer({})


class OpenLandmarks(Upload, OfWork):
    """The handler of the upload of one or two landmark files."""

    most = 2 * reading.MOST_LANDMARK_BYTES

    async def post(self, token: str) -> None:
        """Replace the pairs of the work; answer 422 with the reason if the files are invalid."""
        work = self.work(token)
        frames = Frames(work.session.moving.shape, work.session.picture("fixed").shape)
        try:
            ordered, remarks = reading.in_order(self.files())
            landmarks = await _aside(lambda: parse_landmarks(ordered, frames=frames))
            work.change(partial(work.session.load, landmarks))
        except CodegenError as error:
            self.answer({"error": str(error)}, 422)
        else:
            self.answer({"remark": " ".join(remarks)})


class OpenExample(OfWork):
    """The handler of the request to open the bundled example."""

    def post(self, token: str) -> None:
        """Replace the images and pairs of the work by the example."""
        work, session = self.work(token), reading.example()
        work.change(partial(work.session.replace, session.moving, session.fixed, session.work), images=True)
        self.answer({})


class Export(OfWork):
    """The handler of downloads, which are computed on request."""

    async def post(self, token: str, kind: str) -> None:
        """Answer with a file, or 422 with the reason; the query argument `part` selects one of two landmark files."""
        work = self.work(token)
        form, part = self.get_query_argument("form", "csv"), self.get_query_argument("part", "0")
        grid = self.get_query_argument("grid", "") == "1"
        task = work.session.task()
        if form not in FORMATS or part not in ("0", "1"):
            raise HTTPError(400)
        jobs: dict[str, Callable[[], Download | tuple[Download, ...]]] = {
            "image": partial(solving.warped_image, task), "field": partial(solving.field, task),
            "landmarks": lambda: solving.landmarks(task, form), "animation": partial(solving.animation, task, grid),
        }  # fmt: skip
        try:
            if kind != "landmarks":
                work.require_solver()
            result = await _aside(jobs[kind])
        except CodegenError as error:
            self.answer({"error": str(error)}, 422)
            return
        parts = result if isinstance(result, tuple) else (result,)
        download = parts[min(int(part), len(parts) - 1)]
        self.set_header("Content-Type", download.kind)
        self.set_header("Content-Disposition", f"attachment; filename*=UTF-8''{quote(download.name)}")
        self.set_header("X-Parts", str(len(parts)))
        self.finish(download.data)


class Socket(OfWork, WebSocketHandler):
    """The web socket between a tab and its work."""

    live: LiveWork | None = None
    client = ""

    def check_origin(self, origin: str) -> bool:
        """Return True for the origin of a page of this server."""
        return self.is_own(origin)

    def open(self, *arguments: str, **values: str) -> None:
        """Connect a tab to the work that its query arguments name."""
        self.client = self.get_query_argument("client", "")[:CLIENT]
        self.set_nodelay(True)
        self.live = self.works.get(self.get_query_argument("work", ""))
        self.live.join(self.client, self)

    def on_message(self, message: str | bytes) -> None:
        """Pass a message of the tab to its work."""
        if self.live is not None:
            self.live.hear(self.client, parsed(message))

    def on_close(self) -> None:
        """Disconnect the tab from its work."""
        if self.live is not None:
            self.live.leave(self.client, self)
            self.works.left(self.live)

    def send(self, message: Message | bytes) -> None:
        """Send a dict as JSON, or a picture as bytes; a closed connection is ignored."""
        try:
            if isinstance(message, bytes):
                self.write_message(message, binary=True)
            else:
                self.write_message(json.dumps(message, allow_nan=False))
        except WebSocketClosedError:
            pass


async def _aside(job: Callable[[], T]) -> T:
    return await IOLoop.current().run_in_executor(aside, job)


def listen(works: Works, sockets: Sequence[socket.socket], port: int, ancestors: Sequence[str] = ()) -> HTTPServer:
    """Return a running server of works on `sockets`, bound to `port`; pages of the origins `ancestors` may frame it."""
    work = r"/work/([0-9a-f]{32})"
    routes: list[tuple[str, type[RequestHandler]] | tuple[str, type[RequestHandler], dict[str, object]]] = [
        (rf"/(|{'|'.join(_ASSETS)})", Asset),
        (rf"{work}/tile/([0-9a-f]{{64}})/(\d{{1,2}})/(\d{{1,4}})/(\d{{1,4}})", Tile),
        (rf"{work}/image/(moving|fixed|alone)", OpenImage),
        (rf"{work}/landmarks", OpenLandmarks),
        (rf"{work}/example", OpenExample),
        (rf"{work}/export/(image|field|animation|landmarks)", Export),
        (r"/socket", Socket),
    ]
    application = Application(
        routes, default_handler_class=Nothing, works=works, port=port, ancestors=tuple(ancestors),
        log_function=lambda handler: None,  # requests are private; errors are logged all the same
        websocket_max_message_size=MOST_MESSAGE, websocket_ping_interval=20,
    )  # fmt: skip
    server = HTTPServer(
        application, max_body_size=max(reading.LIMITS.bytes, 2 * reading.MOST_LANDMARK_BYTES) + OVERHEAD,
        max_header_size=1 << 14, idle_connection_timeout=600,
    )  # fmt: skip
    server.add_sockets(sockets)
    return server


def serve(images: Sequence[Path] = (), port: int = 5006, show: bool = True, state: Path | None = None) -> None:
    """Serve the page until the process is interrupted; `show` opens a browser.

    Images are read once, before the server starts. Raises ImageError, ArgumentError, also for a port in use, and
    FileError if works cannot be saved in the folder `state`.
    """
    store = Store(state or default_folder())
    store.require_writable()
    opened = reading.session_of(images)

    async def run() -> None:
        loop = IOLoop.current()
        works = Works(
            lambda: Session(opened.moving, opened.fixed, opened.work), loop.add_callback, loop.call_later, store
        )
        try:
            sockets = bind_sockets(port, "127.0.0.1", socket.AF_INET)
        except (OSError, OverflowError) as error:
            raise ArgumentError(f"--port {port} cannot be used ({error})", "choose another port") from error
        server = listen(works, sockets, port)
        if show:
            loop.run_in_executor(aside, webbrowser.open, f"http://{HOST}:{port}/")
        try:
            await asyncio.Event().wait()
        finally:
            server.stop()

    asyncio.run(run())


@dataclass(frozen=True)
class NotebookPage:
    """The page of one session for a notebook, which must run on the same machine as its browser."""

    session: Session
    work: LiveWork
    port: int
    server: HTTPServer
    loop: IOLoop

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://{HOST}:{self.port}/"

    def _repr_html_(self) -> str:
        address = escape(self.address, quote=True)
        return (
            f'<p><a href="{address}" target="_blank">Image registration by landmarks</a></p>'
            f'<iframe src="{address}" title="Image registration" width="100%" height="720"></iframe>'
        )

    def close(self) -> None:
        """Stop the server; the session remains usable."""
        self.loop.add_callback(self.server.stop)


def shown(session: Session) -> NotebookPage:
    """Serve a session in a thread until the kernel ends or `close` is called; return its page. Nothing is saved."""
    ready: list[NotebookPage] = []
    started = threading.Event()

    async def run() -> None:
        loop = IOLoop.current()
        sockets = bind_sockets(0, "127.0.0.1")
        port = int(sockets[0].getsockname()[1])
        work = LiveWork(session, loop.add_callback, None, "0" * 32)
        works = Works(lambda: session, loop.add_callback, loop.call_later, only=work)
        ready.append(NotebookPage(session, work, port, listen(works, sockets, port, ANCESTORS), loop))
        work.draw()
        started.set()
        await asyncio.Event().wait()

    threading.Thread(target=lambda: asyncio.run(run()), name="registration-page", daemon=True).start()
    started.wait()
    return ready[0]
