"""The progress of builds that Python code starts: one line on a terminal or in a notebook, and none elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from rich.status import Status

Working: TypeAlias = Callable[[str], AbstractContextManager[object]]
"""A function (action) -> context manager, which shows activity during a long step."""


def building(what: str) -> AbstractContextManager[Status | _Line | None]:
    """Return a context manager that shows a text during a with block; its value may have a method `update`.

    The line is written to stderr and disappears at the end of the block.
    """
    if type(sys.stderr).__module__.partition(".")[0] == "ipykernel":
        return _Line(f"{what} ...")
    if not sys.stderr.isatty():
        return nullcontext()
    from rich.console import Console  # its import is slow

    return Console(stderr=True, highlight=False).status(f"{what} ...")


@contextmanager
def shown_from_call(working: Working, what: str) -> Iterator[Callable[[], None]]:
    """Provide a function whose first call lets `working` show a text until the end of the with block.

    A build calls the function when a derivation begins, so that nothing is shown for a cache hit.
    """
    with ExitStack() as stack:
        is_shown = False

        def show() -> None:
            nonlocal is_shown
            if not is_shown:
                is_shown = True
                stack.enter_context(working(what))

        yield show


class _Line:
    """A line of text in the output of a notebook."""

    def __init__(self, text: str) -> None:
        self._text, self._width = text, 0

    def __enter__(self) -> _Line:
        self.update(self._text)
        return self

    def update(self, text: str) -> None:
        """Replace the text of the line."""
        self._width = max(self._width, len(text))
        sys.stderr.write(f"\r{text.ljust(self._width)}")
        sys.stderr.flush()

    def __exit__(self, *error: object) -> None:
        sys.stderr.write(f"\r{' ' * self._width}\r")
        sys.stderr.flush()
