"""The page in a notebook: a server in a thread of its own, on this machine, and a frame that shows it."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass
from html import escape

from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop
from tornado.netutil import bind_sockets

from codegen.registration.app.live import LiveWork, Works
from codegen.registration.app.server import HOST, listen
from codegen.registration.app.session import Session

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
