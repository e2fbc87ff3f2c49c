"""The storage of works. A work has the landmark pairs, settings and images of one visitor of the page.

Works are files in a folder of the user who runs the server. The address of the page contains the random name of the
work, its token; all tabs with this token share the work. Images are stored once, under the hash of their content.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import tempfile
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from codegen.errors import CodegenError
from codegen.files import refused, replacing
from codegen.registration.app.reading import picture_from
from codegen.registration.app.session import Picture, Work, as_record, from_record

MOST_WORKS = 50  # largest number of works that are kept; older works are deleted
PROBE = 4096  # number of bytes that are written to test that a folder is writable
TOKEN = re.compile(r"[0-9a-f]{32}")
DIGEST = re.compile(r"[0-9a-f]{64}")


def default_folder() -> Path:
    """Return the folder of works: $CODEGEN_STATE_DIR, or by default a folder in the state directory of the user."""
    given = os.environ.get("CODEGEN_STATE_DIR")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return Path(given) if given else state / "codegen" / "app"


def new_token() -> str:
    """Return a random token for the name of a work."""
    return secrets.token_hex(16)


class OtherWriterError(CodegenError):
    """Raised if another server has changed the same work since it was last read or written."""


@dataclass(frozen=True)
class Saved:
    """A work to be saved, or a saved work; `heard` maps every tab to the number of its last edit in this work.

    `edition` is a random text that changes with every save, so that changes by another server are detected.
    """

    moving: Picture
    fixed: Picture | None
    work: Work
    heard: dict[str, int]
    edition: str


@dataclass(frozen=True)
class Store:
    """The folder of works; nothing outside the folder is read or written."""

    folder: Path

    def require_writable(self) -> None:
        """Raise FileError, with the option that selects another folder, if works cannot be saved in this folder."""
        remedy = "choose another folder with --state, or $CODEGEN_STATE_DIR"
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.TemporaryFile(dir=self.folder) as probe:
                probe.write(bytes(PROBE))
        except OSError as error:
            raise refused(error, self.folder, remedy) from error

    def save(self, token: str, saved: Saved) -> Saved:
        """Write a work and its new images, and return the work with its new edition.

        Raises OtherWriterError if the edition in the file is not `saved.edition`, and FileError if the file system
        refuses. After an error the file is unchanged.
        """
        path = self._path(token)
        if path is None:
            return saved
        with suppress(OSError):  # writing a file reports a missing folder
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        try:
            edition = str(json.loads(path.read_text())["edition"])
        except (OSError, ValueError, KeyError, TypeError):  # the file is missing or not readable
            edition = ""
        if edition and edition != saved.edition:
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
        # Delete the oldest works, and images that no work uses.
        with suppress(OSError, ValueError):
            works = sorted(self.folder.glob("*.json"), key=lambda path: path.stat().st_mtime, reverse=True)
            if len(works) > MOST_WORKS:
                texts = "".join(path.read_text() for path in works[:MOST_WORKS])
                images_of_none = [p for p in self.folder.iterdir() if DIGEST.fullmatch(p.name) and p.name not in texts]
                for path in (*works[MOST_WORKS:], *images_of_none):
                    path.unlink(missing_ok=True)
        return written

    def load(self, token: str) -> Saved | None:
        """Return the work with this token; None if it is missing or not readable."""
        path = self._path(token)
        if path is None or not path.is_file():
            return None
        try:
            record = json.loads(path.read_text())
            pictures: list[Picture | None] = []
            for label in (record["moving"], record["fixed"]):
                if label is not None and not DIGEST.fullmatch(str(label["digest"])):
                    return None
                data = None if label is None else (self.folder / str(label["digest"])).read_bytes()
                pictures.append(None if data is None else picture_from(data, str(label["name"])))
            moving, fixed = pictures
            if moving is None:
                return None
            heard = {str(client): int(number) for client, number in record["heard"].items()}
            return Saved(moving, fixed, from_record(record), heard, str(record["edition"]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, CodegenError):
            return None

    def _path(self, token: str) -> Path | None:
        return self.folder / f"{token}.json" if TOKEN.fullmatch(token) else None
