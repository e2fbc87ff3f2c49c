"""Saved works: the pairs and images of every visitor, in a folder of the user who runs the server.

The address of the page contains the random name of its work. All tabs with this name share the work. Images are stored
once, under the hash of their content.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from codegen.errors import CodegenError, ImageError
from codegen.files import refused, replacing
from codegen.registration.app.reading import picture_from
from codegen.registration.app.session import Picture, Work, as_record, from_record
from codegen.registration.app.worker import Deliver, Worker, saving

MOST_WORKS = 50
"""Works that are kept; older ones are deleted."""
PROBE = 4096
"""Bytes that are written to test a folder."""
TOKEN = re.compile(r"[0-9a-f]{32}")
DIGEST = re.compile(r"[0-9a-f]{64}")


def default_folder() -> Path:
    """Return $CODEGEN_STATE_DIR, or a folder in the state directory of the user."""
    given = os.environ.get("CODEGEN_STATE_DIR")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return Path(given) if given else state / "codegen" / "app"


def new_token() -> str:
    """Return a random name of a work."""
    return secrets.token_hex(16)


class OtherWriterError(CodegenError):
    """Another server has changed the same work meanwhile."""


@dataclass(frozen=True)
class Saved:
    """A saved work; `heard` has the number of the last edit of every page.

    `edition` identifies the state of the file, so that changes by another server are detected.
    """

    moving: Picture
    fixed: Picture | None
    work: Work
    heard: dict[str, int]
    edition: str


@dataclass(frozen=True)
class Store:
    """The folder of works; nothing outside it is read or written."""

    folder: Path

    def require_writable(self) -> None:
        """Raise FileError, with the option that selects another folder, if works cannot be saved in this one."""
        remedy = "choose another folder with --state, or $CODEGEN_STATE_DIR"
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.TemporaryFile(dir=self.folder) as probe:
                probe.write(bytes(PROBE))
        except OSError as error:
            raise refused(error, self.folder, remedy) from error

    def save(self, token: str, saved: Saved) -> Saved:
        """Write a work and its new images, and return it with its new edition.

        OtherWriterError if the edition of the file has changed, and FileError if the file system refuses; the file is
        then unchanged.
        """
        path = self._path(token)
        if path is None:
            return saved
        with suppress(OSError):  # writing a file reports a missing folder
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if (there := self._edition(path)) and there != saved.edition:
            finding = "another codegen app has changed this work meanwhile"
            raise OtherWriterError(finding, "both states are kept, this one under a new address")
        labels: list[dict[str, str] | None] = []
        for picture in (saved.moving, saved.fixed):
            labels.append(None if picture is None else {"digest": picture.digest, "name": picture.name})
            if picture is not None and picture.source and not (self.folder / picture.digest).exists():
                with replacing(self.folder / picture.digest) as temporary:
                    temporary.write_bytes(picture.source)
        written = replace(saved, edition=secrets.token_hex(8))
        images = {"moving": labels[0], "fixed": labels[1], "heard": saved.heard, "edition": written.edition}
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(as_record(saved.work) | images))
        self._tidy()
        return written

    def load(self, token: str) -> Saved | None:
        """Return the work of a name; None if there is none, or if it is not readable."""
        path = self._path(token)
        if path is None or not path.is_file():
            return None
        try:
            record = json.loads(path.read_text())
            moving = self._picture(record["moving"])
            fixed = None if record["fixed"] is None else self._picture(record["fixed"])
            heard = {str(client): int(number) for client, number in record["heard"].items()}
            return Saved(moving, fixed, from_record(record), heard, str(record["edition"]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, CodegenError):
            return None

    def _edition(self, path: Path) -> str:
        """Return the edition of the file; empty if the file is not readable."""
        try:
            return str(json.loads(path.read_text())["edition"])
        except (OSError, ValueError, KeyError, TypeError):
            return ""

    def _path(self, token: str) -> Path | None:
        return self.folder / f"{token}.json" if TOKEN.fullmatch(token) else None

    def _picture(self, label: dict[str, Any]) -> Picture:
        digest = str(label["digest"])
        if not DIGEST.fullmatch(digest):
            raise ImageError("the saved work names no image", "open the image again")
        return picture_from((self.folder / digest).read_bytes(), str(label["name"]))

    def _tidy(self) -> None:
        """Delete the oldest works, and images without a work."""
        with suppress(OSError, ValueError):
            works = sorted(self.folder.glob("*.json"), key=lambda path: path.stat().st_mtime, reverse=True)
            if len(works) <= MOST_WORKS:
                return
            texts = "".join(path.read_text() for path in works[:MOST_WORKS])
            for path in works[MOST_WORKS:]:
                path.unlink(missing_ok=True)
            for path in self.folder.iterdir():
                if DIGEST.fullmatch(path.name) and path.name not in texts:
                    path.unlink(missing_ok=True)


class Keeper:
    """Saves a work under `token`, in the background; without a store nothing is saved.

    `read` is the saved state at the start. `safe` has the last saved edit of every page, and `problem` is the reason of
    a failed attempt. `told` is called after every attempt, and `renamed` with the reason of another name of the work.
    """

    def __init__(
        self,
        deliver: Deliver,
        store: Store | None,
        token: str,
        read: Saved | None,
        told: Callable[[], None],
        renamed: Callable[[str], None],
    ) -> None:
        self.token = token
        self.safe: Mapping[str, int] = dict(read.heard) if read else {}
        self.problem: str | None = None
        self._store, self._edition = store, read.edition if read else ""
        self._told, self._renamed = told, renamed
        self._worker = Worker(deliver, ("save",), saving)

    @property
    def busy(self) -> bool:
        """True if a save is in progress or has failed."""
        return self._worker.busy or self.problem is not None

    def save(self, state: Saved) -> None:
        """Save a state in the background; of several waiting states only the newest."""
        store, token = self._store, self.token
        if store is None:
            self.safe = state.heard
            self._told()
            return

        def job() -> tuple[str, Saved, str]:
            # The edition of the last write, which may be newer than the request.
            newest = replace(state, edition=self._edition)
            try:
                return token, store.save(token, newest), ""
            except OtherWriterError as error:
                other = new_token()
                return other, store.save(other, newest), str(error)

        self._worker.ask("save", job, self._saved, self._failed)

    def _saved(self, result: tuple[str, Saved, str]) -> None:
        token, saved, said = result
        self._edition, self.safe, self.problem = saved.edition, saved.heard, None
        if token != self.token:
            self.token = token
            self._renamed(said)
        self._told()

    def _failed(self, error: Exception) -> None:
        self.problem = str(error) if isinstance(error, CodegenError) else type(error).__name__
        self._told()
