"""The web page of registration: click pairs of points on two images and see one image warped onto the other.

`serve` runs the page on this machine, and `page` shows the page in a notebook. `session.Session` has all operations
without a browser. The page needs the extra `app` (tornado).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from codegen.errors import ArgumentError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from codegen.registration.app.server import NotebookPage
    from codegen.registration.app.session import Session

__all__ = ["page", "prepare", "serve"]


def page(*images: Path | str, session: Session | None = None) -> NotebookPage:
    """Serve the page in the background, and return an object that a notebook shows as the page.

    Parameters
    ----------
    *images : Path or str
        One image, or a moving and a fixed image; by default the bundled example.
    session : Session, optional
        The session of the page; replaces the images.

    Raises
    ------
    ArgumentError
        If the extra `app` is missing.
    ImageError
        If an image cannot be read.

    Notes
    -----
    Nothing is saved automatically.
    """
    _require_tornado()
    from codegen.registration.app.reading import session_of
    from codegen.registration.app.server import shown

    return shown(session or session_of([Path(image) for image in images]))


def prepare(images: Sequence[Path] = (), state: Path | None = None) -> None:
    """Check the images, and start to prepare the solver in the background, which goes on while the page is served.

    Raises ArgumentError if the extra `app` is missing, FileError if works cannot be saved in the folder `state`, and
    ImageError if an image cannot be read.
    """
    _require_tornado()
    from codegen.registration.app.reading import Store, default_folder, session_of
    from codegen.registration.app.worker import prepared
    from codegen.registration.solver import DEFAULT_SCHEME

    Store(state or default_folder()).require_writable()
    session_of(images)
    prepared(DEFAULT_SCHEME)


def serve(images: Sequence[Path] = (), port: int = 5006, show: bool = True, state: Path | None = None) -> None:
    """Serve the page on localhost until the process is interrupted.

    `show` opens a browser. Works, the landmarks and images of visitors, are saved in the folder `state`. Raises
    ArgumentError if tornado is missing or the port is in use, FileError if works cannot be saved, and ImageError.
    """
    _require_tornado()
    from codegen.registration.app import server

    server.serve(images, port, show, state)


def _require_tornado() -> None:
    try:
        import tornado  # noqa: F401
    except ImportError as error:
        remedy = "pip install tornado"
        raise ArgumentError("the page needs Tornado", remedy) from error
