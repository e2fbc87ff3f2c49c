"""Shared parts of commands: one-line errors with an exit status, the console, and progress on a terminal."""

from __future__ import annotations

import os
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperGroup

from codegen.errors import INTERRUPTED, CodegenError, Interrupted, one_line
from codegen.files import is_refusal, refused

if TYPE_CHECKING:
    from rich.console import Console
    from rich.status import Status

FILE_WIDTH = 120
"""Width of lines in characters if the output is not a terminal."""


class _Ended(Exception):
    """An interrupt with a message, in place of Interrupted, whose message typer would lose."""


class OneLineErrors(TyperGroup):
    """A group of commands that report errors by one line on stderr and an exit status."""

    def invoke(self, ctx: Any) -> object:
        """Run a command; raise _Ended in place of Interrupted, so that its message is not lost."""
        try:
            return super().invoke(ctx)
        except Interrupted as error:
            raise _Ended(str(error)) from error

    def main(self, *positional: Any, **options: Any) -> object:
        """Run a command, report its errors, and exit."""
        try:
            with warnings.catch_warnings():
                if not sys.warnoptions:
                    # Warnings are suppressed, because status and residuals report numerical problems.
                    warnings.simplefilter("ignore")
                status = super().main(*positional, **{**options, "standalone_mode": False})
            sys.stdout.flush()  # an error of the output is reported below
            if status == 130:  # the exit status of typer for an interrupt
                typer.echo(INTERRUPTED, err=True)
        except _Ended as ended:
            status = 130
            typer.echo(f"codegen: {one_line(str(ended))}", err=True)
        except Exception as error:
            status, text = _described(error)
            typer.echo(f"codegen: error: {text}", err=True)
            try:
                sys.stdout.flush()
            except OSError:  # Python would write again at its end, fail, and change the exit status
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(status if isinstance(status, int) else 0)


def _described(error: Exception) -> tuple[int, str]:
    """Return the exit status and the message for an exception."""
    if isinstance(error, CodegenError):
        return 2, one_line(str(error))
    if hasattr(error, "format_message"):  # a usage error of typer, whose class differs between versions
        command = getattr(getattr(error, "ctx", None), "command_path", "codegen")
        # typer takes the message of pydantic, whose prefix names an exception of Python.
        message = error.format_message().replace(": Value error, ", ": ", 1).rstrip(".")
        return 2, one_line(f"{message}; see {command} --help")
    if isinstance(error, OSError) and is_refusal(error):
        return 2, one_line(str(refused(error, error.filename or "the output")))
    if isinstance(error, MemoryError):
        return 2, "there is not enough memory; take fewer --steps, or a larger --every"
    if type(error).__name__ == "Abort":
        return 1, "aborted"
    if os.environ.get("CODEGEN_TRACEBACK"):
        traceback.print_exception(error)
    text = f"unexpected {type(error).__name__}: {error}"
    return 1, one_line(text, 200) + "; this is a defect of codegen, please report what CODEGEN_TRACEBACK=1 shows"


def console(stderr: bool = False) -> Console:
    """Return a console of rich with the width of the terminal, or with FILE_WIDTH if the output is not a terminal."""
    from rich.console import Console

    result = Console(stderr=stderr, highlight=False)
    if not result.is_terminal and "COLUMNS" not in os.environ:
        result.width = FILE_WIDTH
    return result


@contextmanager
def progress(what: str, count: int) -> Iterator[Callable[[int, str], None]]:
    """Show a progress bar for `count` parts on a terminal during a with block.

    The value of the block is a function (number of finished parts, text), which updates the bar.
    """
    if not sys.stderr.isatty():
        yield lambda done, text: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=count)
        yield lambda done, text: bar.update(task, completed=done, description=text)


@contextmanager
def following() -> Iterator[Callable[[int, tuple[float, ...]], None] | None]:
    """Show the iterates of a search on a terminal during a with block, if the search takes more than one second.

    The value of the block is a function (number of the iterate, row of the log), or None without a terminal.
    """
    with working("Solving") as line:
        if line is None:
            yield None
            return
        begin = shown = time.monotonic()

        def watch(number: int, row: tuple[float, ...]) -> None:
            nonlocal shown
            now = time.monotonic()
            if now > begin + 1.0 and now > shown + 0.1:
                shown = now
                cost, residual, stationarity = row[:3]
                errors = f"equations {residual:.1e}, stationarity {stationarity:.1e}"
                line.update(f"Solving: iteration {number}, cost {cost:.6g}, {errors} ({now - begin:.0f} s) ...")

        yield watch


def working(what: str) -> AbstractContextManager[Status | None]:
    """Return a context manager that shows a spinner with a text on a terminal."""
    if not sys.stderr.isatty():
        return nullcontext()
    return console(stderr=True).status(f"{what} ...")
