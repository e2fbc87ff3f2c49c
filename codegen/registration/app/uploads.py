"""Files that pages send: their size is known and bounded before they are read."""

from __future__ import annotations

from typing import Any

from tornado.httputil import HTTPFile, parse_body_arguments
from tornado.web import HTTPError, stream_request_body

from codegen.registration.app.guard import Guarded
from codegen.registration.app.reading import Files

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
