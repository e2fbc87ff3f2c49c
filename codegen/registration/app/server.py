"""The server of the page: on this machine only, one session for each visitor; and the page in a notebook."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import panel as pn

from codegen.errors import ArgumentError
from codegen.registration.app.autosave import TOKEN, Store, default_folder, new_token
from codegen.registration.app.reading import LIMITS, session_of
from codegen.registration.app.session import Session
from codegen.registration.app.view import View

HOST = "localhost"
pn.extension("tabulator")
TITLE = "Image registration by landmarks"
QUERY = "work"
"""Argument of the page's address that names the saved work."""
OVERHEAD = 1 << 20
"""Bytes of a message beside the file that it carries."""
PATIENCE = 60_000
"""Milliseconds for which the session of a closed page is kept."""


def page(*images: Path | str, session: Session | None = None) -> pn.viewable.Viewable:
    """The page as a Panel object, for a notebook: on a session of one's own, or on images as `codegen app` takes them.

    Nothing is saved automatically. Raises the errors of reading images.
    """
    pn.extension("tabulator")  # the notebook's output cell needs it, too
    return _view(session or session_of([Path(image) for image in images])).root


def serve(
    images: Sequence[Path] = (), port: int = 5006, show: bool = True, store: Store | None = None, **values: Any
) -> Any:
    """Serve the page until it is interrupted; further values go to `panel.serve`.

    Images are read once, before anything is served: raises ImageError and ArgumentError, the latter
    also for a port that is in use.
    """
    _require_free(port)
    opened = session_of(images)
    kept = store or Store(default_folder())

    def visit() -> pn.viewable.Viewable:
        """A session of its own for every visitor, on the images that were given or on the work that was saved."""
        token = _token()
        saved = kept.load(token) if token else None
        if saved is not None:
            session = Session(saved.moving, saved.fixed, saved.work)
        else:
            session, token = Session(opened.moving, opened.fixed, opened.work), new_token()
        location = pn.state.location
        if location is not None:
            pn.state.onload(lambda: location.update_query(**{QUERY: token}))
        return _view(session, kept, token).root

    return pn.serve(
        {"/": visit}, port=port, address=HOST, websocket_origin=_origins(port), show=show, title=TITLE, verbose=False,
        websocket_max_message_size=LIMITS.bytes + OVERHEAD, unused_session_lifetime_milliseconds=PATIENCE,
        check_unused_sessions_milliseconds=PATIENCE // 4, **values,
    )  # fmt: skip


def _view(session: Session, store: Store | None = None, token: str = "") -> View:
    document = pn.state.curdoc
    served = document is not None and document.session_context is not None

    def deliver(act: Callable[[], None]) -> None:
        if document is not None and served:
            document.add_next_tick_callback(act)
        else:  # a notebook has no event loop of its own to wait for
            act()

    return View(session, deliver, store, token)


def _token() -> str:
    """The name of a saved work in the page's address; empty where there is none, or nothing like one."""
    given = pn.state.session_args.get(QUERY, [b""])[0]
    text = given.decode("ascii", "replace")
    return text if TOKEN.fullmatch(text) else ""


def _origins(port: int) -> list[str]:
    return [f"{HOST}:{port}", f"127.0.0.1:{port}"]


def _require_free(port: int) -> None:
    """ArgumentError when something else listens there."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise ArgumentError(f"--port {port} cannot be used ({error})", "choose another port") from error
