"""A limit on the processor time of long symbolic work, which ends even in the middle of one call of sympy.

Such a call never looks at a clock. In the main thread a timer of the operating system interrupts it; elsewhere, and
where there is no such timer, the limit is looked at whenever a stage begins. Processor time is counted, so that other
work on the machine makes no build fail. Garbage is collected less often meanwhile.
"""

from __future__ import annotations

import gc
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from codegen.errors import SizeError

if TYPE_CHECKING:
    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.pairwise import PairwiseModel
    from codegen.discretise.particles import PairwiseProgram
    from codegen.discretise.program import ControlProgram, StepProgram

BUILD = 30.0
"""Seconds that a derivation may take."""
CHECK = 120.0
"""Seconds that all checks may take together."""
_AGAIN = 0.5
"""Seconds after which the timer interrupts once more, where what it interrupted swallowed it."""
_COUNTED = 1_000_000
"""Parts of an expression after which they are no longer counted."""


class Overdue(BaseException):
    """The time is over; not an Exception, so that no handler between takes it for a failure of what it guards."""


class Stages:
    """The stages of a derivation: which one is at work, and on what."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self._end = time.process_time() + limit
        self._stage = "reading and checking the problem file"
        self._described: Callable[[], str] = str

    def begin(self, stage: str, described: Callable[[], str] | None = None) -> None:
        """Go on to a stage; `described` says what is worked on, should it take too long."""
        if time.process_time() > self._end:
            raise Overdue
        self._stage, self._described = stage, described or self._described

    @contextmanager
    def limited(self) -> Iterator[None]:
        """End what is inside with a SizeError that names the stage and what is too large."""
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
    """Raise Overdue inside after so many seconds of processor time, where a timer can be set that is not in use."""
    if not _settable() or math.isinf(seconds):
        yield
        return

    def ring(*_: Any) -> None:
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
    """Look for cyclic garbage less often: expressions leave little, and looking takes a sixth of the time."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _settable() -> bool:
    here = threading.current_thread() is threading.main_thread()
    return here and hasattr(signal, "setitimer") and signal.getitimer(signal.ITIMER_PROF)[0] == 0.0


def described(model: Model | PairwiseModel) -> str:
    """What is large in a problem: its coordinates, and its longest expression."""
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
    """What is large in the equations of an interval of a problem that is described already."""
    from codegen.discretise.program import ControlProgram, StepProgram

    if isinstance(program, ControlProgram):
        unknowns, parts = program.element_symbols, parts_of(program.element)
    elif isinstance(program, StepProgram):
        unknowns, parts = program.unknowns, parts_of(*program.residual)
    else:
        return problem
    return f"{problem}; the equations of an interval have {len(unknowns)} unknowns and {parts} parts"


def parts_of(*expressions: Any) -> int:
    """How many different parts some expressions have, counted up to a million."""
    seen: set[Any] = set()
    waiting = list(expressions)
    while waiting and len(seen) < _COUNTED:
        part = waiting.pop()
        if part not in seen:
            seen.add(part)
            waiting += part.args
    return len(seen)
