"""The order of a scheme in simulations, measured on a span of the motion in which the asymptotic range is reached.

Over many periods the error is a sum of terms that grow at different rates with time, and rounding grows with it, so
that between the coarsest useful step and the plateau no power of the step need prevail. On a span in which the state
moves by about its own size one does. The number of steps grows by a third of a doubling at a time until local orders
have settled; where rounding comes first, longer and shorter spans are tried.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.interfaces import SimulateModule, Vector
from codegen.report.measure.orders import Order, is_exhausted, measured_order
from codegen.report.measure.reference_motion import (
    Motion,
    component_sizes,
    duration_of,
    field_of,
    reference_motion,
)
from codegen.report.store import Values

CHECKPOINTS = 4
"""Intervals between the times at which errors are taken; their root mean square varies smoothly with the step."""
SPANS = (2.0, 4.0, 8.0, 1.0)
"""Spans in turn, in units of the time in which the state moves by its own size."""
ENOUGH = 0.01
"""Once local orders differ by no more than this, no more steps are taken."""
LEAST_RUNGS, MOST_STEPS = 12, 40_000


@dataclass(frozen=True)
class Span:
    """A part of the motion: its duration, in words, and the reference on it."""

    duration: float
    motion: Motion


class Spans:
    """Spans that are computed one after the other, when an iteration first comes to them."""

    def __init__(self, source: Iterator[Span]) -> None:
        """Take them from `source`."""
        self._source, self._known = source, list[Span]()

    def __iter__(self) -> Iterator[Span]:
        yield from self._known
        for span in self._source:
            self._known.append(span)
            yield span


def rungs() -> Iterator[int]:
    """Numbers of steps, multiples of the number of checkpoints that grow by a third of a doubling."""
    before = 0
    for k in range(100):
        steps = CHECKPOINTS * round(2.0 * 2.0 ** (k / 3.0))
        if steps > MOST_STEPS:
            return
        if steps > before:
            yield steps
        before = steps


def spans_of(euler: SimulateModule, times: Sequence[float], states: Any) -> Iterator[Span]:
    """The spans of a problem, each made when it is asked for, with the motion by an explicit Euler module's field."""
    duration = duration_of(euler)
    field, sizes = field_of(euler, duration), component_sizes(states)
    speeds = [float(np.linalg.norm(field(t, z) / sizes)) for t, z in zip(times, states, strict=True)]
    unit = 1.0 / (float(np.median(speeds)) or 1.0 / duration)
    lengths = dict.fromkeys(min(duration, factor * unit) for factor in SPANS)
    for length in lengths:
        yield Span(length, reference_motion(euler, CHECKPOINTS, length))


def order_values(module: SimulateModule, spans: Iterable[Span], limit: float) -> Values:
    """The first span on which local orders settle, with every error on it; else the last span, without an order.

    `limit` is how many seconds a solve may take before no more steps are tried.
    """
    found: dict[str, Any] = {}
    for span in spans:
        steps, errors = _ladder(module, span, limit)
        order = measured_order(steps, errors, span.motion.error)
        found = {"span": span.duration, "steps": steps, "errors": errors, "floor": span.motion.error}
        if order is not None:
            break
    return found


def order_from(values: Values | None) -> Order | None:
    """The order that stored errors show."""
    return None if values is None else measured_order(values["steps"], values["errors"], values["floor"])


def _ladder(module: SimulateModule, span: Span, limit: float) -> tuple[list[int], list[float | None]]:
    steps: list[int] = []
    errors: list[float | None] = []
    for count in rungs():
        begin = time.perf_counter()
        steps.append(count)
        errors.append(_error(module, span, count))
        order = measured_order(steps, errors, span.motion.error)
        enough = order is not None and order.spread <= ENOUGH and len(steps) >= LEAST_RUNGS
        if enough or is_exhausted(steps, errors) or (len(steps) > 1 and time.perf_counter() - begin > limit):
            break
    return steps, errors


def _error(module: SimulateModule, span: Span, count: int) -> float | None:
    """Root mean square over checkpoints and components of the state's error, by component's size."""
    solution: Any = module.solve(count, duration=span.duration, every=count // CHECKPOINTS)
    if solution.status != "solved":
        return None
    shape = (CHECKPOINTS + 1, -1)
    states: Vector = np.hstack([np.reshape(solution.q, shape), np.reshape(solution.p, shape)])
    wrong = (states - span.motion.states) / component_sizes(span.motion.states)
    error = float(np.sqrt(np.mean(wrong[1:] ** 2)))
    return error if math.isfinite(error) else None
