"""The web page of registration: click pairs of points on two images and see one warped onto the other.

`serve` runs it on this machine, `page` shows it in a notebook. What it does without a browser is `session.Session`.
Needs the extra `app` (panel, bokeh).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from codegen.errors import ArgumentError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from panel.viewable import Viewable

    from codegen.registration.app.session import Session

__all__ = ["page", "prepare", "serve"]


def page(*images: Path | str, session: Session | None = None) -> Viewable:
    """The page as a Panel object, for a notebook: on a session of one's own, or on images as `codegen app` takes them.

    Raises ArgumentError when the extra `app` is missing, and the errors of reading images.
    """
    _require_panel()
    from codegen.registration.app import server

    return server.page(*images, session=session)


def prepare(images: Sequence[Path] = ()) -> None:
    """Read the images, and begin to make the solver ready, which goes on while the page is being served.

    Raises ArgumentError when the extra `app` is missing, and the errors of reading images.
    """
    _require_panel()
    from codegen.registration.app.preparing import prepared
    from codegen.registration.app.reading import session_of
    from codegen.registration.solver import DEFAULT_SCHEME

    session_of(images)
    prepared(DEFAULT_SCHEME)


def serve(images: Sequence[Path] = (), port: int = 5006, show: bool = True) -> None:
    """Serve the page on localhost until it is interrupted; `show` opens a browser.

    Raises ArgumentError when the extra `app` is missing or the port is in use, and the errors of reading images.
    """
    _require_panel()
    from codegen.registration.app import server

    server.serve(images, port, show)


def _require_panel() -> None:
    try:
        import bokeh  # noqa: F401
        import panel  # noqa: F401
    except ImportError as error:
        remedy = 'install it with python -m pip install "variational-codegen[app]"'
        raise ArgumentError("the page needs Panel and Bokeh", remedy) from error
