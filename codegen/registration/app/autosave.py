"""Work that survives a reload: every visitor's pairs and images, in a folder of the user who runs the server.

A work is found by a random name that the page keeps in its address, and all tabs with that name share it. Images are
stored once, by the hash of their content, however their files were called.
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
"""The oldest works beyond these are deleted."""
PROBE = 4096
"""Bytes that are written to see whether a folder takes any."""
TOKEN = re.compile(r"[0-9a-f]{32}")
DIGEST = re.compile(r"[0-9a-f]{64}")


def default_folder() -> Path:
    """$CODEGEN_STATE_DIR, or a folder in the user's state directory."""
    given = os.environ.get("CODEGEN_STATE_DIR")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return Path(given) if given else state / "codegen" / "app"


def new_token() -> str:
    """A name for a work that nobody guesses."""
    return secrets.token_hex(16)


class OtherWriterError(CodegenError):
    """Another server has written to the same work meanwhile."""


@dataclass(frozen=True)
class Saved:
    """A work as it was left; `heard` is the number of the last edit of every page that had a part in it.

    `edition` names the state of the file: whoever goes on from it knows whether somebody else wrote meanwhile.
    """

    moving: Picture
    fixed: Picture | None
    work: Work
    heard: dict[str, int]
    edition: str


@dataclass(frozen=True)
class Store:
    """The folder of works; nothing outside it is ever read or written."""

    folder: Path

    def require_writable(self) -> None:
        """FileError, which names the option that chooses another folder, where works cannot be saved in this one."""
        remedy = "choose another folder with --state, or $CODEGEN_STATE_DIR"
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.TemporaryFile(dir=self.folder) as probe:
                probe.write(bytes(PROBE))
        except OSError as error:
            raise refused(error, self.folder, remedy) from error

    def save(self, token: str, saved: Saved) -> Saved:
        """Write a work, its images only where they are new, and return it with its new edition.

        OtherWriterError where the file is no longer of the edition that was read or written last, and FileError where
        the file system refuses: the file is then as it was.
        """
        path = self._path(token)
        if path is None:
            return saved
        with suppress(OSError):  # a folder that cannot be made is named when a file is written
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if (there := self._edition(path)) and there != saved.edition:
            finding = "another codegen app has changed this work meanwhile"
            raise OtherWriterError(finding, "both states are kept, this one under a new address")
        for picture in (saved.moving, saved.fixed):
            if picture is not None:
                self._keep(picture)
        fixed = None if saved.fixed is None else _label(saved.fixed)
        written = replace(saved, edition=secrets.token_hex(8))
        own = {"moving": _label(saved.moving), "fixed": fixed, "heard": saved.heard, "edition": written.edition}
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(as_record(saved.work) | own))
        self._tidy()
        return written

    def load(self, token: str) -> Saved | None:
        """A work by its name; None where there is none, or where it cannot be read any more."""
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
        """That of the file; empty where there is none that can be read."""
        try:
            return str(json.loads(path.read_text())["edition"])
        except (OSError, ValueError, KeyError, TypeError):
            return ""

    def _path(self, token: str) -> Path | None:
        return self.folder / f"{token}.json" if TOKEN.fullmatch(token) else None

    def _keep(self, picture: Picture) -> None:
        path = self.folder / picture.digest
        if picture.source and not path.exists():
            with replacing(path) as temporary:
                temporary.write_bytes(picture.source)

    def _picture(self, label: dict[str, Any]) -> Picture:
        digest = str(label["digest"])
        if not DIGEST.fullmatch(digest):
            raise ImageError("the saved work names no image", "open the image again")
        return picture_from((self.folder / digest).read_bytes(), str(label["name"]))

    def _tidy(self) -> None:
        """Delete the oldest works, and images that no work names."""
        with suppress(OSError, ValueError):
            works = sorted(self.folder.glob("*.json"), key=lambda path: path.stat().st_mtime, reverse=True)
            if len(works) <= MOST_WORKS:
                return
            kept = "".join(path.read_text() for path in works[:MOST_WORKS])
            for path in works[MOST_WORKS:]:
                path.unlink(missing_ok=True)
            for path in self.folder.iterdir():
                if DIGEST.fullmatch(path.name) and path.name not in kept:
                    path.unlink(missing_ok=True)


def _label(picture: Picture) -> dict[str, str]:
    return {"digest": picture.digest, "name": picture.name}


class Keeper:
    """Keeps a work under `token`, from the state that was read, if one was; without a store nothing is kept.

    `safe` are the last edits of pages that are in what is kept, and `problem` says why the last attempt failed, if it
    did. `told` is called after every attempt; `renamed` hears why the work has got another name.
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
        """Whether anything is being saved, or could not be."""
        return self._worker.busy or self.problem is not None

    def save(self, state: Saved) -> None:
        """Save a state soon; of several that wait only the newest."""
        store, token = self._store, self.token
        if store is None:
            self.safe = state.heard
            self._told()
            return

        def job() -> tuple[str, Saved, str]:
            # What was written last is what this state goes on from, even where it was asked for before.
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
