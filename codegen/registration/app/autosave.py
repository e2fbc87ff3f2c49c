"""Work that survives a reload: every visitor's pairs and images, in a folder of the user who runs the server.

A work is found by a random name that the page keeps in its address, so that two windows never overwrite each other.
Images are stored once, by the hash of their content, however their files were called.
"""

from __future__ import annotations

import json
import os
import re
import secrets
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.errors import CodegenError, ImageError
from codegen.files import replacing
from codegen.registration.app.picture import Picture
from codegen.registration.app.reading import picture_from
from codegen.registration.app.state import Work, as_record, from_record

MOST_WORKS = 50
"""The oldest works beyond these are deleted."""
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


@dataclass(frozen=True)
class Saved:
    """A work as it was left."""

    moving: Picture
    fixed: Picture | None
    work: Work


@dataclass(frozen=True)
class Store:
    """The folder of works; nothing outside it is ever read or written."""

    folder: Path

    def save(self, token: str, moving: Picture, fixed: Picture | None, work: Work) -> None:
        """Write a work, its images only where they are new. FileError when the file system refuses."""
        path = self._path(token)
        if path is None:
            return
        self._make()
        for picture in (moving, fixed):
            if picture is not None:
                self._keep(picture)
        record = as_record(work) | {"moving": _label(moving), "fixed": None if fixed is None else _label(fixed)}
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(record))
        self._tidy()

    def load(self, token: str) -> Saved | None:
        """A work by its name; None where there is none, or where it cannot be read any more."""
        path = self._path(token)
        if path is None or not path.is_file():
            return None
        try:
            record = json.loads(path.read_text())
            moving = self._picture(record["moving"])
            fixed = None if record["fixed"] is None else self._picture(record["fixed"])
            return Saved(moving, fixed, from_record(record))
        except (OSError, ValueError, KeyError, TypeError, CodegenError):
            return None

    def _path(self, token: str) -> Path | None:
        return self.folder / f"{token}.json" if TOKEN.fullmatch(token) else None

    def _make(self) -> None:
        with suppress(OSError):  # a folder that cannot be made is named when a file is written
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)

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
