"""A limit on the processor time of long symbolic work, also inside one call of sympy.

In the main thread a timer of the operating system interrupts such a call. In other threads, and on systems without
such a timer, the limit is checked when a stage begins. Processor time is limited instead of wall-clock time, so that
other work on the machine makes no build fail. During limited work garbage can be collected less often.
"""

from __future__ import annotations

import gc
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from codegen.errors import SizeError

if TYPE_CHECKING:
    from sympy import Basic

    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.pairwise import PairwiseModel
    from codegen.discretise.particles import PairwiseProgram
    from codegen.discretise.program import ControlProgram, StepProgram

BUILD = 30.0
"""Default limit for the derivation of a module, in seconds of processor time."""
CHECK = 60.0
"""Default limit for all checks of a problem together, in seconds of processor time."""
_AGAIN = 0.5
"""Seconds after which the timer interrupts again, in case the interrupted code caught the exception."""
_COUNTED = 1_000_000
"""Number of subexpressions at which counting stops."""


class Overdue(BaseException):
    """The time limit has passed; a BaseException, so that no `except Exception` catches it."""


class Stages:
    """The current stage of a derivation that may take `limit` seconds of processor time, for the error message."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self._end = time.process_time() + limit
        self._stage = "reading and checking the problem file"
        self._described: Callable[[], str] = str

    def begin(self, stage: str, described: Callable[[], str] | None = None) -> None:
        """Begin a stage, or raise Overdue if no time is left; `described` returns a phrase on the stage's input."""
        if time.process_time() > self._end:
            raise Overdue
        self._stage, self._described = stage, described or self._described

    @contextmanager
    def limited(self) -> Iterator[None]:
        """Limit the time of a `with` block; raise SizeError with the stage and its input's size if time runs out."""
        try:
            with interrupted_after(self._end - time.process_time()):
                yield
        except Overdue:
            large = self._described()
            raise SizeError(
                f"{self._stage} was not done after {self.limit:g} s of processor time"
                + (f": {large}" if large else ""),
                "give it more with codegen build --time-limit S, whose module other commands find, or take "
                "coordinates, a --method or a --scheme whose expressions are shorter",
            ) from None


@contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Raise Overdue in a `with` block after some seconds of processor time; set no limit if no timer is free."""
    in_main = threading.current_thread() is threading.main_thread()
    is_free = in_main and hasattr(signal, "setitimer") and signal.getitimer(signal.ITIMER_PROF)[0] == 0.0
    if not is_free or math.isinf(seconds):
        yield
        return

    def ring(*_: object) -> None:
        raise Overdue

    former = signal.signal(signal.SIGPROF, ring)
    try:
        signal.setitimer(signal.ITIMER_PROF, max(seconds, 1e-3), _AGAIN)
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, former)


@contextmanager
def rare_collections() -> Iterator[None]:
    """Collect cyclic garbage less often in a `with` block: collection takes a sixth of the time and frees little."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def described(model: Model | PairwiseModel) -> str:
    """Return a phrase on a problem's coordinates and the size of its longest expression; empty for particles."""
    from codegen.discretise.model.definitions import Model

    if not isinstance(model, Model):
        return ""
    named = [
        ("the Hamiltonian" if model.form == "hamiltonian" else "the Lagrangian", model.function),
        *((f"the force on {q}", f) for q, f in zip(model.coordinates, model.force, strict=False)),
        *((f"the rate of {x}", f) for x, f in zip(model.coordinates, model.dynamics, strict=False)),
        ("the cost", model.cost),
        *((str(condition.name), condition.expression) for condition in model.path),
    ]
    sizes = [(parts_of(expression), name) for name, expression in named if expression is not None]
    most, name = max(sizes)
    return f"it has {len(model.coordinates)} coordinates, and {name} has {most} parts"


def extent(program: ControlProgram | StepProgram | PairwiseProgram, problem: str) -> str:
    """Return the phrase `problem`, extended by the numbers of unknowns and parts in the equations of an interval."""
    from codegen.discretise.program import ControlProgram, StepProgram

    if isinstance(program, ControlProgram):
        unknowns, parts = program.element_symbols, parts_of(program.element)
    elif isinstance(program, StepProgram):
        unknowns, parts = program.unknowns, parts_of(*program.residual)
    else:
        return problem
    return f"{problem}; the equations of an interval have {len(unknowns)} unknowns and {parts} parts"


def parts_of(*expressions: Basic) -> int:
    """Return the number of distinct subexpressions of some expressions, counted up to a million."""
    seen: set[Basic] = set()
    waiting = list(expressions)
    while waiting and len(seen) < _COUNTED:
        part = waiting.pop()
        if part not in seen:
            seen.add(part)
            waiting += part.args
    return len(seen)
