"""What all loops over pairs of one problem share: how symbols are read, and how both terms stand in a loop.

Code for blocks of points: arrays that hold one quantity after the other, of all points of the block.

The inner loop over the points then reads neighbours in memory, at distances that are known when it is compiled, and
calls nothing that has branches: a compiler turns it into operations on several points at once.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.model.pairwise import PairwiseModel
from codegen.emit.lower.kernels import Kernel, Line, Output, kernel, needed
from codegen.emit.pairwise_derivatives import Assignment, PairDerivatives, TermDerivatives

CLOSEST = Symbol("CLOSEST", positive=True)
"""The least squared distance that kernels tell from zero, where a limit exists."""
STATE = ("z", "own", "parameters")
"""The arguments that every loop has: state, particles' own parameters, common parameters."""


def signature(arguments: Sequence[str]) -> tuple[str, ...]:
    """The arguments of a kernel: after the first array of particles their number, after directions how many."""
    first = next((name for name in ("z", "start") if name in arguments), "")
    after = {first: "count", "directions": "columns"}
    return tuple(name for a in arguments for name in ((a, after[a]) if a in after else (a,)))


def views(arguments: Sequence[str], model: PairwiseModel, blocks: int = 1) -> tuple[Line, ...]:
    """Lines that make arrays of the pointers that a kernel is given; `blocks` are the rows of H_pp for a particle."""
    size, own = len(model.coordinates), len(model.own)
    state, positions, rows = f"(2, count, {size})", f"(count, {size})", f"{2 * size}*count"
    shapes = {"z": state, "gradient": state, "hessian": f"({rows}, {rows})"}
    shapes |= dict.fromkeys(("rates", "start", "target", "position"), positions)
    shapes |= dict.fromkeys(("directions", "products"), f"({rows}, columns)")
    shapes |= {"own": f"(count, {own})"} if own else {}
    shapes["matrix"] = "(count, count)" if blocks == 1 else f"({blocks}*count, {blocks}*count)"
    return tuple(Line(name, f"carray({name}, {shapes[name]})") for name in arguments if name in shapes)


@dataclass(frozen=True)
class PairLoop:
    """A function that visits all particles, and all pairs, as groups of lines in the order in which they are run.

    `arguments` are pointers and numbers, of which `views` make arrays.
    `head` comes first; for each particle i `inputs`, `alone` and `alone_outputs`; for each j < i `pair_inputs`, `pair`
    and `pair_outputs`; then `after` for particle i, and at last `tail` and `results`. Lines of `alone_directions` and
    `pair_directions` are repeated for each of several `directions`. `over_pairs` and `over_directions` are the code of
    these loops, none where there is nothing to repeat.
    """

    name: str
    summary: str
    arguments: tuple[str, ...]
    decorator: str
    views: tuple[Line, ...]
    head: tuple[Line, ...]
    inputs: tuple[Line, ...]
    alone: tuple[Line, ...]
    alone_outputs: tuple[Line, ...]
    alone_directions: tuple[Line, ...]
    pair_inputs: tuple[Line, ...]
    pair: tuple[Line, ...]
    pair_outputs: tuple[Line, ...]
    pair_directions: tuple[Line, ...]
    after: tuple[Line, ...]
    tail: tuple[Line, ...]
    results: tuple[str, ...]
    operations_before: int
    operations_after: int
    over_pairs: tuple[str, ...]
    over_directions: tuple[str, ...]


class Writer:
    """What all loops of one problem share: how symbols are read, and which scalars belong to single particles."""

    def __init__(self, model: PairwiseModel, derivatives: PairDerivatives) -> None:
        self.model, self.derivatives = model, derivatives
        self.dimension = len(model.coordinates)
        back = dict(zip(model.second.q, model.first.q, strict=True))
        self.singles: list[Expr] = []
        self.single_codes: dict[Symbol, str] = {}
        for term in (derivatives.alone, derivatives.pair):
            for symbol, polynomial in term.scalars:
                for mark, own in (("i", model.first.q), ("j", model.second.q)):
                    if polynomial.is_Add and polynomial.free_symbols <= set(own):
                        value = polynomial.xreplace(back)
                        if value not in self.singles:
                            self.singles.append(value)
                        self.single_codes[self._scalar(term, symbol)] = f"singles[{mark}, {self.singles.index(value)}]"

    def _scalar(self, term: TermDerivatives, symbol: Symbol) -> Symbol:
        """Scalars of the self term and of the pair term may carry the same names."""
        return symbol if term is self.derivatives.pair else Symbol(f"{symbol.name}_alone", real=True)

    def renamed(self, term: TermDerivatives, expression: Expr) -> Expr:
        """An expression of one term with its scalars and their derivatives under names of their own."""
        if term is self.derivatives.pair:
            return expression
        named = [symbol for symbol, _ in (*term.scalars, *term.slopes, *term.curvatures)]
        return expression.xreplace({symbol: Symbol(f"{symbol.name}_alone", real=True) for symbol in named})

    def codes(self, mark: str) -> dict[Symbol, str]:
        """The code that reads the quantities of one particle."""
        one = self.model.first if mark == "i" else self.model.second
        codes = {s: f"z[0, {mark}, {a}]" for a, s in enumerate(one.q)}
        codes |= {s: f"z[1, {mark}, {a}]" for a, s in enumerate(one.p)}
        return codes | {s: f"own[{mark}, {a}]" for a, s in enumerate(one.own)}

    def lowered(
        self, term: TermDerivatives, outputs: Sequence[tuple[str, str, Expr]], names: Sequence[Assignment] = ()
    ) -> Kernel:
        """Scalars, named derivatives and outputs (target, operator, value) of one term with common parts shared."""
        read = needed((*term.differences, *term.scalars, *names), [value for _, _, value in outputs])
        assignments = []
        for symbol, value in read:
            renamed = self.renamed(term, symbol)
            if renamed in self.single_codes:
                continue
            if self.model.smooth and symbol in term.distances:
                value = sympy.Max(value, CLOSEST)
            assignments.append((renamed, self.renamed(term, value)))
        codes = {**self.codes("i"), **self.codes("j"), **self.single_codes}
        codes |= {s: f"parameters[{k}]" for k, s in enumerate(self.model.parameters)}
        return kernel(
            "", "", (), codes,
            [Output(target, self.renamed(term, value), "", operator) for target, operator, value in outputs],
            assignments=assignments,
        )  # fmt: skip

    def summed(
        self,
        assignments: Sequence[Assignment],
        reads: dict[Symbol, str],
        outputs: Sequence[tuple[str, Expr]],
        known: Collection[Symbol],
    ) -> Kernel:
        """Outputs (target, value) that are added up over all particles; `known` are the symbols that stay as read."""
        distances = self.derivatives.pair.distances
        written = [
            (symbol, sympy.Max(value, CLOSEST) if symbol in distances else value)
            for symbol, value in needed(assignments, [value for _, value in outputs])
            if symbol not in known
        ]
        reads = reads | {s: f"parameters[{k}]" for k, s in enumerate(self.model.parameters)}
        added = [Output(target, value, "", "+=") for target, value in outputs if value != 0]
        return kernel("", "", (), reads, added, assignments=written)

    def loop(
        self,
        name: str,
        summary: str,
        arguments: Sequence[str],
        alone: Kernel,
        pair: Kernel,
        head: Sequence[Line] = (),
        after: Sequence[Line] = (),
        tail: Sequence[Line] = (),
        results: Sequence[str] = (),
        directions: tuple[Sequence[Line], Sequence[Line]] = ((), ()),
    ) -> PairLoop:
        """Put both terms into a loop; what belongs to particle i is read once."""
        uses_singles = any("singles[" in line.code for k in (alone, pair) for line in (*k.inputs, *k.body, *k.outputs))
        start = [Line("singles", "single_values(z)")] if uses_singles else []
        read_i, read_j = dict.fromkeys(alone.inputs), dict.fromkeys(line for line in pair.inputs if _of_pair(line))
        read_i |= dict.fromkeys(line for line in pair.inputs if not _of_pair(line))
        return PairLoop(
            name=name,
            summary=summary,
            arguments=signature(arguments),
            decorator="@Value" if results else "@Kernel",
            views=views(arguments, self.model, 1 if self.derivatives.isotropic else self.dimension),
            head=(*start, *head),
            inputs=tuple(read_i),
            alone=alone.body,
            alone_outputs=alone.outputs,
            alone_directions=tuple(directions[0]),
            pair_inputs=tuple(read_j),
            pair=pair.body,
            pair_outputs=pair.outputs,
            pair_directions=tuple(directions[1]),
            after=tuple(after),
            tail=tuple(tail),
            results=tuple(results),
            operations_before=pair.operations_before,
            operations_after=pair.operations_after,
            over_pairs=("for j in range(i):",) if pair.outputs or directions[1] else (),
            over_directions=("for c in range(directions.shape[1]):",) if directions[1] else (),
        )


def _of_pair(line: Line) -> bool:
    """Whether an input is read for every j; parameters and what belongs to i are read outside that loop."""
    return ", j, " in line.code or "[j, " in line.code


@dataclass(frozen=True)
class BlockLoop:
    """A function that adds up what all particles j contribute to each point m of a block.

    `views` make arrays of pointers. `head` comes first; for each block `before` for each point m of it; `inputs` for
    each particle j, then for each m `point_inputs`, `body` and `outputs`; at last `after` for each m, in a loop whose
    code is `over_points` where it is not needed always. Blocks divide the points from `begin` to `end`, which are
    code.
    """

    name: str
    summary: str
    arguments: tuple[str, ...]
    decorator: str
    views: tuple[Line, ...]
    head: tuple[Line, ...]
    before: tuple[Line, ...]
    inputs: tuple[Line, ...]
    point_inputs: tuple[Line, ...]
    body: tuple[Line, ...]
    outputs: tuple[Line, ...]
    after: tuple[Line, ...]
    operations_before: int
    operations_after: int
    over_points: tuple[str, ...] = ()
    begin: str = "0"
    end: str = "z.shape[1]"


def entry(array: str, row: int, block: str) -> str:
    """The code of a quantity of point m, where `block` is the constant that holds the length of a row."""
    offset = "" if row == 0 else f"{block} + " if row == 1 else f"{row}*{block} + "
    return f"{array}[{offset}m]"


def packed(line: Line) -> Line:
    """A line with logarithms that have no branches in place of those of the C library."""
    code = re.sub(r"\b(?:math\.)?(log1p|x_minus_log1p|log1p_minus_ratio)\(", r"packed_\1(", line.code)
    return Line(line.target, code, line.comment, line.operator)
