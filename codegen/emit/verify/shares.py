"""Verification of shares, which are contributions to the Lagrangian, by complex steps.

The emitted gradient is compared with complex steps of the unchanged expression. Then the emitted Hessian is compared
with complex steps of the verified gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from sympy import Expr, S, Symbol

from codegen.discretise.program import ControlProgram, Coupling
from codegen.emit.differentiation import data_of
from codegen.emit.lower.control.layout import parameters
from codegen.emit.verify.comparison import (
    EXACT,
    SIZED,
    Complex,
    Sized,
    Values,
    complex_numbers,
    difference,
    finite_points,
    judge,
    random_points,
    sized,
    step_of,
)
from codegen.emit.verify.execution import Function, Operand, Tape, Text

Call = Callable[[Function, Mapping[Symbol, Operand], list[Operand]], Operand]
"""A function that calls a kernel with values of symbols and a list that the kernel fills."""


@dataclass(frozen=True)
class Share:
    """A `scalar` whose emitted derivatives are compared, with the names of two kernels and functions that call them.

    The `gradient` kernel returns `output`, which errors call `returned`. `indices` select the unknowns whose
    derivatives are emitted. `pattern` has (row, column) for each entry that the `hessian` kernel fills. Second
    derivatives are compared for `pairs` of indices, by default for all pairs.
    """

    name: str
    scalar: Expr
    output: Expr
    unknowns: tuple[Symbol, ...]
    indices: tuple[int, ...]
    pattern: tuple[tuple[int, int], ...]
    gradient: str
    hessian: str
    call_gradient: Call
    call_hessian: Call
    returned: str = "the cost of"
    pairs: tuple[tuple[int, int], ...] | None = None


class ShareComparison:
    """The comparison of one share's kernels with its expressions, at `candidates` where the expressions have values."""

    def __init__(self, share: Share, text: Text, candidates: Sequence[Values]) -> None:
        self.share, self.text = share, text
        self.tape = Tape([share.scalar, share.output])
        self.points, self.count = finite_points(self.tape.evaluate, candidates)
        rows = (p for p in share.indices)
        every = [(row, column) for row in rows for column in share.indices if column <= row]
        self.pairs = every if share.pairs is None else list(share.pairs)
        self._evaluations: dict[Operand, tuple[Operand, ...]] = {}
        self._sized: dict[tuple[str, int], tuple[list[Operand], Operand]] = {}

    def verify(self) -> None:
        """Raise VerificationError if the returned value, the gradient or the Hessian is wrong, tested in this order."""
        if not self.count:
            return
        share = self.share
        self._judge([f"{share.returned} {share.name}"], 0, lambda entry: [])
        of, unknowns = f"of {share.name}'s share of the Lagrangian by", share.unknowns
        names = [f"the derivative {of} {unknowns[index]}" for index in share.indices]
        self._judge(names, 1, lambda entry: [share.indices[entry]])
        names = [f"the second derivative {of} {unknowns[row]} and {unknowns[column]}" for row, column in self.pairs]
        self._judge(names, 2, lambda entry: list(self.pairs[entry]))

    def _judge(self, names: Sequence[str], order: int, by: Callable[[int], list[int]]) -> None:
        judge(names, lambda kind: self._evaluated(kind)[order], lambda e, p: self._opinion(order, by(e), p))

    def _evaluated(self, kind: Complex) -> tuple[Operand, ...]:
        """Return (emitted, exact) arrays (points, entries) for the returned value, the gradient and the Hessian."""
        if kind in self._evaluations:
            return self._evaluations[kind]
        share, numbers, step = self.share, complex_numbers(kind), step_of(kind)
        size, chosen = len(share.unknowns), list(share.indices)
        shape = self.count, size
        plain = {symbol: array.astype(kind)[:, None] for symbol, array in self.points.items()}
        moved = dict(plain)
        for index, symbol in enumerate(share.unknowns):
            moved[symbol] = np.tile(plain[symbol], (1, size))
            moved[symbol][:, index] += 1j * step
        scalar, output = (np.broadcast_to(value, shape) for value in self.tape.evaluate(moved, numbers))
        gradient: list[Operand] = [kind(0)] * size
        kernels = self.text.kernels((share.gradient, share.hessian), numbers)
        returned = share.call_gradient(kernels[share.gradient], moved, gradient)
        columns = np.stack([np.broadcast_to(np.asarray(value, kind), shape) for value in gradient], axis=1)
        entries: list[Operand] = [kind(0)] * len(share.pattern)
        if share.pattern:
            share.call_hessian(kernels[share.hessian], plain, entries)
        hessian = np.zeros((self.count, size, size), np.finfo(kind).dtype)
        for (row, column), value in zip(share.pattern, entries, strict=True):
            hessian[:, row, column] += np.broadcast_to(np.asarray(value).real.reshape(-1), self.count)
        rows, below = [row for row, _ in self.pairs], [column for _, column in self.pairs]
        self._evaluations[kind] = (
            (np.broadcast_to(np.asarray(returned, kind), shape)[:, :1].real, output[:, :1].real),
            (columns[:, chosen, 0].real, scalar.imag[:, chosen] / step),
            (hessian[:, rows, below], (columns.imag / step)[:, rows, below]),
        )
        return self._evaluations[kind]

    def _opinion(self, order: int, by: list[int], point: int) -> tuple[Sized, Operand, Operand]:
        at = {symbol: float(array[point]) for symbol, array in self.points.items()}
        index = 0 if order else 1
        names = [self.share.unknowns[i] for i in by]
        exact, error = difference(lambda values: self.tape.evaluate(values, EXACT)[index], at, names)
        share = self.share
        if order == 2 and tuple(by) not in share.pattern:
            return Sized(0), exact, error
        name, call = (share.hessian, share.call_hessian) if order == 2 else (share.gradient, share.call_gradient)
        if (name, point) not in self._sized:
            filled: list[Operand] = [Sized(0)] * (len(share.pattern) if order == 2 else len(share.unknowns))
            sized_values = {symbol: Sized(value) for symbol, value in at.items()}
            returned = call(self.text.kernels((name,), SIZED)[name], sized_values, filled)
            self._sized[name, point] = filled, returned
        filled, returned = self._sized[name, point]
        if order == 2:
            entries = [value for value, pair in zip(filled, share.pattern, strict=True) if pair == tuple(by)]
            return reduce(Sized.__add__, entries, Sized(0)), exact, error
        value: Operand = filled[by[0]] if order else returned
        return sized(value), exact, error


Columns = dict[int, Symbol]
"""A map from the column in which kernels write derivatives to the datum by which they differentiate."""


def columns_of(program: ControlProgram, begins_at: int = 0) -> Columns:
    """Return the data, by column, of intervals that begin at inner time number `begins_at`, or at none (-1)."""
    inner, data = program.inner, data_of(program)
    first, count = len(data) - len(inner.symbols), len(inner.times)
    columns = {i: datum for i, datum in enumerate(data[:first]) if datum not in inner.parameters}
    if begins_at >= 0:  # data of the left node have their values among the parameters
        numbers = inner.parameters[count + begins_at :: count] if count else ()
        columns |= {first + i: number for i, number in enumerate(numbers)}
    return columns


def mixed_shares(share: Share, kernel: str, pattern: Iterable[tuple[int, int]], columns: Columns) -> list[Share]:
    """Return two shares, which verify a share's derivatives by data, and its mixed ones by unknowns and data.

    `kernel` is the name of the kernel that fills both; `pattern` has (unknown, column) for each mixed entry. Unknowns
    that are not among the share's indices are prescribed, and count as data.
    """
    data = [datum for datum in columns.values() if datum not in share.unknowns]
    unknowns = (*share.unknowns, *data)
    indices = {column: unknowns.index(datum) for column, datum in columns.items()}
    pairs = tuple(pattern)
    width = 1 + max((*columns, *(column for _, column in pairs)))

    def call_slopes(called: Function, values: Mapping[Symbol, Operand], filled: list[Operand]) -> Operand:
        slopes: list[Operand] = [0] * width
        mixed: list[Operand] = [0] * len(pairs)
        share.call_gradient(lambda *arguments: called(*arguments[:-1], slopes, mixed), values, [])
        for column, index in indices.items():
            filled[index] = slopes[column] + filled[index]
        return 0

    def call_mixed(called: Function, values: Mapping[Symbol, Operand], filled: list[Operand]) -> None:
        slopes: list[Operand] = [0] * width
        mixed: list[Operand] = [0] * len(pairs)
        share.call_gradient(lambda *arguments: called(*arguments[:-1], slopes, arguments[-1]), values, mixed)
        filled[:] = [value for value, (_, column) in zip(mixed, pairs, strict=True) if column in indices]

    of_slopes = replace(
        share, output=S.Zero, unknowns=unknowns, indices=tuple(indices.values()), pattern=(), pairs=(), gradient=kernel,
        hessian=kernel, call_gradient=call_slopes,
    )  # fmt: skip
    every = tuple((row, index) for row in share.indices for index in indices.values() if index not in share.indices)
    of_mixed = replace(
        share, unknowns=unknowns, pattern=tuple((row, indices[column]) for row, column in pairs if column in indices),
        pairs=every, hessian=kernel, call_hessian=call_mixed,
    )  # fmt: skip
    return [of_slopes, of_mixed]


def pattern_of(module: Mapping[str, Operand], name: str) -> tuple[tuple[int, int], ...]:
    """Return pairs (row, column) from a module's arrays `<name>_ROWS` and `<name>_COLUMNS`; empty without arrays."""
    rows, columns = (module.get(f"{name}_{side}", ()) for side in ("ROWS", "COLUMNS"))
    return tuple((int(row), int(column)) for row, column in zip(rows, columns, strict=True))


_DRAWN = 30
_TABLES = ("COUPLING_KINDS", "COUPLING_ROWS", "COUPLING_COUNTS", "COUPLING_INDICES")
_KERNEL, _MIXED = "coupling_term", "coupling_mixed"


def verify_couplings(program: ControlProgram, text: Text) -> None:
    """Compare every condition between bodies with its terms in the module; raise VerificationError for a wrong one."""
    if not program.linking.couplings:
        return
    module = text.interpreted(*_TABLES)
    terms = list(zip(*(module[table].tolist() for table in _TABLES), strict=True))
    for number, coupling in enumerate(program.linking.couplings):
        own = [(kind, indices[:count]) for kind, row, count, indices in terms if row == number]
        share = _share(program, coupling, own)
        symbols = list(dict.fromkeys([*share.unknowns, *parameters(program)]))
        points = random_points(symbols, program.model.default_values, _DRAWN, seed=5)
        for compared in (share, *(_by_data(program, share, own) if text.defines(_MIXED) else ())):
            ShareComparison(compared, text, [points]).verify()


def _by_data(program: ControlProgram, share: Share, terms: Sequence[tuple[int, Sequence[int]]]) -> tuple[Share, Share]:
    """Return two shares, which verify a condition's derivatives by data, and its mixed ones by unknowns and data."""
    every, others, size = shared_symbols(program), parameters(program), len(share.unknowns)
    data = {column: s for column, s in columns_of(program, -1).items() if s in others}
    local = dict(zip(data, range(size, size + len(data)), strict=True))
    pattern = tuple((row, index) for row in range(size) for index in local.values())
    entry = {pair: i for i, pair in enumerate(pattern)}

    def call(kernel: Function, values: Mapping[Symbol, Operand], slopes: list[Operand], mixed: list[Operand]) -> int:
        for kind, indices in terms:
            by_data, by_both = dict[int, Operand](), dict[tuple[int, int], Operand]()
            inputs, others_at = [values[every[index]] for index in indices], [values[s] for s in others]
            kernel(kind, inputs, others_at, by_data, by_both)
            for column, value in by_data.items():
                slopes[local[column]] = value + slopes[local[column]]
            for (a, column), value in by_both.items():
                i = entry[share.unknowns.index(every[indices[a]]), local[column]]
                mixed[i] = value + mixed[i]
        return 0

    common = replace(share, unknowns=(*share.unknowns, *data.values()), hessian=_MIXED)
    return (
        replace(
            common, output=S.Zero, indices=tuple(local.values()), pattern=(), pairs=(), gradient=_MIXED,
            call_gradient=lambda kernel, values, filled: call(kernel, values, filled, [0] * len(pattern)),
        ),
        replace(
            common, pattern=pattern, pairs=pattern,
            call_hessian=lambda kernel, values, filled: call(kernel, values, [0] * (size + len(data)), filled),
        ),
    )  # fmt: skip


def _share(program: ControlProgram, coupling: Coupling, terms: Sequence[tuple[int, Sequence[int]]]) -> Share:
    """Return a share for a condition between bodies; `terms` are (kind, indices of linking variables) in the module."""
    every, others = shared_symbols(program), parameters(program)
    named = {index for _, indices in terms for index in indices}
    read = [index for index, symbol in enumerate(every) if index in named or coupling.expression.has(symbol)]
    local, size = {index: i for i, index in enumerate(read)}, len(read)
    pattern = tuple((row, column) for row in range(size) for column in range(row + 1))
    entry = {pair: i for i, pair in enumerate(pattern)}

    def call_gradient(kernel: Function, values: Mapping[Symbol, Operand], filled: list[Operand]) -> Operand:
        total: Operand = 0
        for kind, indices in terms:
            slopes = [0] * len(indices)
            inputs, others_at = [values[every[index]] for index in indices], [values[s] for s in others]
            total = kernel(kind, inputs, others_at, slopes, [0] * len(indices) ** 2) + total
            for index, slope in zip(indices, slopes, strict=True):
                filled[local[index]] = slope + filled[local[index]]
        return total

    def call_hessian(kernel: Function, values: Mapping[Symbol, Operand], filled: list[Operand]) -> None:
        for kind, indices in terms:
            curvatures = [0] * len(indices) ** 2
            inputs, others_at = [values[every[index]] for index in indices], [values[s] for s in others]
            kernel(kind, inputs, others_at, [0] * len(indices), curvatures)
            for a, row in enumerate(indices):
                for b, column in enumerate(indices):
                    if local[column] <= local[row]:
                        i = entry[local[row], local[column]]
                        filled[i] = curvatures[a * len(indices) + b] + filled[i]

    return Share(
        name=f"the condition {coupling.multiplier.meaning.of}",
        scalar=coupling.expression,
        output=coupling.expression,
        unknowns=tuple(every[index] for index in read),
        indices=tuple(range(size)),
        pattern=pattern,
        gradient=_KERNEL,
        hessian=_KERNEL,
        call_gradient=call_gradient,
        call_hessian=call_hessian,
        returned="the value of",
    )


def shared_symbols(program: ControlProgram) -> list[Symbol]:
    """Return a symbol for every linking variable: first for each body in turn, then for the whole problem."""
    symbols = [Symbol(f"_shared_{index}", real=True) for index in range(program.model.bodies * program.linking.own)]
    for symbol, body, j in program.linking.coupling_symbols:
        symbols[body * program.linking.own + j] = symbol
    return [*symbols, *program.linking.common_symbols]
