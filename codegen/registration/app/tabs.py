"""A browser's tab as the server knows it: what it looks at, and which pictures are on their way to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from codegen.registration.app import messages
from codegen.registration.app.solving import Look, Seen


class Line(Protocol):
    """The way to a browser's tab."""

    def send(self, message: Mapping[str, Any] | bytes) -> None:
        """Send values or a packed picture; whoever is gone hears nothing."""


class Tab:
    """One picture is on its way at a time; of those that come meanwhile only the newest is sent."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self.look = Look()
        self._number = 0
        self._busy = False
        self._next: tuple[Seen, int] | None = None

    def show(self, seen: Seen, revision: int) -> None:
        """Send a picture, now or when the one before it has been drawn."""
        if self._busy:
            self._next = (seen, revision)
            return
        self._busy = True
        self._number += 1
        self.line.send(messages.seen(seen, self._number, revision))

    def drawn(self) -> None:
        """The tab has drawn what it was sent."""
        self._busy = False
        if self._next is not None:
            following, self._next = self._next, None
            self.show(*following)
