"""Where emitted kernels are compared with what they stand for: near the guess, and at random points.

Near the guess means what a solver meets first: the module's own guess with default parameters, its own steps, and
unknowns moved by parts of their sizes; multipliers, of which there is no guess, are drawn at random.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from sympy import Symbol

from codegen.discretise import LENGTHS, STEP
from codegen.verify.execution import Arithmetic
from codegen.verify.judgement import complex_numbers


class Evaluated(Protocol):
    """Expressions that can be evaluated in an arithmetic."""

    def evaluate(self, given: Mapping[Symbol, Any], arithmetic: Arithmetic, /) -> list[Any]:
        """Their values, given those of symbols."""
        ...


Values = dict[Symbol, Any]
"""Of each symbol its values at some points, shape (points,)."""
_MOVED = (0.004, 0.03, 0.2, 0.5)
"""Never by nothing, nor to where an interval begins: kinks often lie at the very guess, and have no derivative."""
_BESIDE = 0.0137
_KEPT = 5
"""Points of each set at which kernels are compared."""
_STEPS = 24
"""At most; a guess on more intervals shows no more."""


def random_points(symbols: Sequence[Symbol], defaults: Mapping[Symbol, float], count: int, seed: int) -> Values:
    """Numbers about 1, then of magnitudes 1e-3 to 1e3; parameters about their defaults, lengths of steps shorter."""
    generator = np.random.default_rng(seed)
    wide = np.arange(count) % 3 == 2
    values: Values = {}
    for symbol in symbols:
        near = generator.uniform(0.4, 1.6, count)
        far = generator.choice((-1.0, 1.0), count) * 10.0 ** generator.uniform(-3, 3, count)
        if defaults.get(symbol):
            values[symbol] = defaults[symbol] * near
        elif symbol in (STEP, *LENGTHS):
            values[symbol] = 0.25 * near
        else:
            values[symbol] = np.where(wide, far, near)
    return values


class GuessedPoints:
    """Points near the guess that a module of a control problem makes for itself."""

    def __init__(self, module: Mapping[str, Any], steps: int, least: int = 1) -> None:
        self.module = module
        self.grid = module["make_grid"](max(least, min(steps, _STEPS)))
        with np.errstate(all="ignore"):
            self.unknowns = module["initial_guess"](self.grid)
        if "read_shared" in module:
            for body in range(module["BODIES"]):
                module["read_shared"](self.unknowns, body, self.grid.parameters)
        self.generator = np.random.default_rng(3)

    def on_intervals(self, local: Sequence[Symbol], others: Sequence[Symbol], within: tuple[float, float]) -> Values:
        """Values on three intervals between two parts of the chain; `others` are what the parameters hold."""
        count = self.grid.steps
        first, last = int(within[0] * count), max(int(within[0] * count), round(within[1] * count) - 1)
        intervals = sorted({first, (first + last) // 2, last})
        rows = [interval * self.module["STRIDE"] for interval in intervals for _ in _MOVED]
        values = self._moved(rows, local, others)
        t = np.array([(interval + _BESIDE) * self.grid.h for interval in intervals for _ in _MOVED])
        return values | {_TIME: t, STEP: np.full(t.size, self.grid.h)}

    def at_node(self, last: bool, local: Sequence[Symbol], others: Sequence[Symbol]) -> Values:
        """Values at the first or the last node."""
        row = self.grid.steps * self.module["STRIDE"] if last else 0
        values = self._moved([row for _ in _MOVED], local, others)
        t = np.full(len(_MOVED), self.grid.steps * self.grid.h if last else 0.0)
        return values | {_TIME: t, STEP: np.full(t.size, self.grid.h)}

    def _moved(self, rows: Sequence[int], local: Sequence[Symbol], others: Sequence[Symbol]) -> Values:
        moved = np.tile(_MOVED, len(rows) // len(_MOVED))
        values: Values = {}
        for offset, symbol in enumerate(local):
            indices = np.array(rows) + offset
            at = self.unknowns[indices]
            noise = self.generator.uniform(-1.0, 1.0, at.size)
            multiplier = self.grid.is_multiplier[indices[0]]
            values[symbol] = noise if multiplier else at + moved * noise * self._size(offset)
        shared = len(others) - self.module.get("SHARED", 0)
        for column, symbol in enumerate(others):
            at = np.full(len(rows), self.grid.parameters[0, column])
            noise = self.generator.uniform(-1.0, 1.0, at.size)
            values[symbol] = at * (1 + 0.1 * moved * noise)
            if column >= shared:
                values[symbol] += np.where(at == 0, noise, 0.0)
        return values

    def _size(self, offset: int) -> float:
        """The largest value of an unknown along the guess, or 1."""
        stride = self.module["STRIDE"]
        size = float(np.abs(self.unknowns[offset % stride :: stride]).max(initial=0.0))
        return size if 0.0 < size < np.inf else 1.0


_TIME = Symbol("t")
"""Stands for the time of the model, whatever it is called."""


def with_time(values: Values, time: Symbol) -> Values:
    """The values with the model's own symbol for time."""
    return {time if symbol is _TIME else symbol: value for symbol, value in values.items()}


def finite_points(tape: Evaluated, candidates: Sequence[Values]) -> tuple[Values, int]:
    """The first points of each set at which all expressions of a tape have values, and how many there are."""
    found: list[tuple[Values, Any]] = []
    for values in candidates:
        given = {symbol: array.astype(np.clongdouble) for symbol, array in values.items()}
        with np.errstate(all="ignore"):
            results = tape.evaluate(given, complex_numbers(np.clongdouble))
        size = len(next(iter(values.values())))
        finite = np.logical_and.reduce([np.isfinite(np.broadcast_to(array, size)) for array in results])
        found.append((values, np.flatnonzero(finite)[:_KEPT]))
    count = sum(len(indices) for _, indices in found)
    return {s: np.concatenate([values[s][indices] for values, indices in found]) for s in candidates[0]}, count
