"""What all loops over pairs of one problem share: how symbols are read, and how both terms stand in a loop.

Code for blocks of points: arrays that hold one quantity after the other, of all points of the block.

The inner loop over the points then reads neighbours in memory, at distances that are known when it is compiled, and
calls nothing that has branches: a compiler turns it into operations on several points at once.

Second derivatives of a pairwise Hamiltonian -> loops over pairs: as a matrix, by momenta alone, times directions.

The gradient of H where particles act on themselves as they act on others -> a loop that gathers it for blocks.

Where self_term is half the limit of the pair term at coincidence, H_q and H_p of a particle i are sums of one
expression over all particles j, particle i among them. To gather them takes twice as many evaluations as to visit each
pair once, but each evaluation writes to particle i alone, so that several particles are worked on at once.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Symbol

from codegen.discretise.model.pairwise import PairwiseModel
from codegen.emit.lower.kernels import Kernel, Line, Output, kernel, needed
from codegen.emit.pairwise_derivatives import Assignment, PairDerivatives, TermDerivatives
from codegen.errors import ExpressionError

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


def hessian(writer: Writer) -> PairLoop:
    """All second derivatives as a matrix."""
    size = writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    half, row_i, row_j = _offsets(size)
    filled = {}
    for term in (alone, pair):
        lines = []
        for name, row, column, _ in _entries(term):
            one, other = divmod(row, size)[0], divmod(column, size)[0]
            # j < i: momenta come after positions, particle i after particle j.
            later = (one % 2, -(one // 2)) >= (other % 2, -(other // 2))
            index = (row, column) if later else (column, row)
            lines.append(Line(f"hessian[{_row(index[0], size)}, {_row(index[1], size)}]", name, operator="+="))
        filled[term is pair] = lines
    first = writer.lowered(alone, _named(_entries(alone)), alone.slopes + alone.curvatures)
    second = writer.lowered(pair, _named(_entries(pair)), pair.slopes + pair.curvatures)
    return writer.loop(
        "hamiltonian_hessian", "Fill `hessian`, shape (2nd, 2nd), with the second derivatives of H.",
        (*STATE, "hessian"),
        _extended(first, (row_i,), filled[False]),
        _extended(second, (row_j,), filled[True]),
        head=[half, Line("hessian[:]", "0.0")],
        tail=[Line("", "mirror_lower_triangle(hessian)", operator="")],
    )  # fmt: skip


def hessian_products(writer: Writer) -> PairLoop:
    """The derivative of the gradient along directions, which takes fewer operations than the second derivatives."""
    size = writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    half, row_i, row_j = _offsets(size)
    kernels, lines, operations = [], [], (0, 0)
    for term, row in ((alone, row_i), (pair, row_j)):
        named = [(str(writer.renamed(term, s)), "=", value) for s, value in (*term.slopes, *term.curvatures)]
        made = writer.lowered(term, named)
        kernels.append(replace(made, body=(row, *made.body, *made.outputs), outputs=()))
        along = _along_direction(writer, term)
        lines.append(_inner_lines(along))
        operations = made.operations_before + along.operations_before, made.operations_after + along.operations_after
    visit = writer.loop(
        "hessian_products",
        "Fill `products`, shape (2nd, m), with the second derivatives of H times m directions, shape (2nd, m).",
        (*STATE, "directions", "products"),
        kernels[0],
        kernels[1],
        head=[half, Line("products[:]", "0.0")],
        directions=(lines[0], lines[1]),
    )
    return replace(visit, operations_before=operations[0], operations_after=operations[1])


def momentum_matrix(writer: Writer) -> PairLoop:
    """H_pp, one row for each particle if it acts on every component alike, else one for each component."""
    size = writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    isotropic = writer.derivatives.isotropic
    kernels = []
    for term in (alone, pair):
        outputs = []
        for _, row, column, value in _entries(term):
            (one, a), (other, b) = divmod(row, size), divmod(column, size)
            if one % 2 == 0 or other % 2 == 0 or (isotropic and a > 0):
                continue
            codes = [f"{'ij'[one // 2]}", f"{'ij'[other // 2]}"]
            if not isotropic:
                codes = [f"{size}*{index} + {axis}" for index, axis in zip(codes, (a, b), strict=True)]
            # The row of particle i comes after that of j.
            later = codes if one // 2 <= other // 2 else codes[::-1]
            outputs.append((f"matrix[{later[0]}, {later[1]}]", "+=", value))
        kernels.append(writer.lowered(term, outputs, term.slopes + term.curvatures))
    return writer.loop(
        "momentum_matrix",
        "Fill `matrix` with the second derivatives of H by momenta"
        + (", alike for every component of space: shape (n, n)." if isotropic else ", shape (nd, nd)."),
        (*STATE, "matrix"), kernels[0], kernels[1],
        head=[Line("matrix[:]", "0.0")],
        tail=[Line("", "mirror_lower_triangle(matrix)", operator="")],
    )  # fmt: skip


def _entries(term: TermDerivatives) -> list[tuple[str, int, int, Expr]]:
    """Distinct values among second derivatives under names h0, h1, ..., with all indices that they have."""
    names: dict[Expr, str] = {}
    return [(names.setdefault(value, f"h{len(names)}"), row, column, value) for row, column, value in term.hessian]


def _row(index: int, size: int) -> str:
    """The row of a moving symbol of one of two particles."""
    group, axis = divmod(index, size)
    particle, is_momentum = divmod(group, 2)
    parts = [*(["half"] if is_momentum else []), "row_" + "ij"[particle], *([str(axis)] if axis else [])]
    return " + ".join(parts)


def _named(entries: Iterable[tuple[str, int, int, Expr]]) -> list[tuple[str, str, Expr]]:
    return [(name, "=", value) for name, value in {name: value for name, _, _, value in entries}.items()]


def _offsets(size: int) -> tuple[Line, Line, Line]:
    """Where rows of momenta begin, and where those of particles i and j do."""
    return (
        Line("half", f"{size}*z.shape[1]" if size > 1 else "z.shape[1]", "where rows of momenta begin"),
        Line("row_i", f"{size}*i" if size > 1 else "i"),
        Line("row_j", f"{size}*j" if size > 1 else "j"),
    )


def _extended(made: Kernel, inputs: Sequence[Line], outputs: Sequence[Line]) -> Kernel:
    return replace(made, body=(*inputs, *made.body, *made.outputs), outputs=tuple(outputs))


def _along_direction(writer: Writer, term: TermDerivatives) -> Kernel:
    """What is computed for one direction c: changes of the scalars, of the derivatives by them, and of the gradient."""
    size, moving = writer.dimension, term.moving
    changes = {z: Symbol(f"d_{z.name}", real=True) for z in moving}
    changes |= {d: Symbol(f"d_{d.name}", real=True) for d, _ in term.differences}

    def change(expression: Expr) -> Expr:
        return sum((sympy.diff(expression, z) * dz for z, dz in changes.items()), sympy.S.Zero)

    assignments = [(changes[d], change(difference)) for d, difference in term.differences]
    by_scalar: dict[Symbol, Expr] = {}
    for symbol, polynomial in term.scalars:
        by_scalar[symbol] = Symbol(f"d_{symbol.name}", real=True)
        assignments.append((by_scalar[symbol], change(polynomial)))
    total = {slope: sympy.S.Zero for slope, _ in term.slopes}
    for (symbol, _), (slope, _) in zip(term.scalars, term.slopes, strict=True):
        for curvature, _ in term.curvatures:
            first, second = curvature.name.removeprefix("by_").split("_")
            for one, other in {(first, second), (second, first)}:
                if symbol.name == one:
                    total[slope] += curvature * next(d for s, d in by_scalar.items() if s.name == other)
    slope_changes = {slope: Symbol(f"d_{slope.name}", real=True) for slope, value in total.items() if value != 0}
    assignments += [(changed, total[slope]) for slope, changed in slope_changes.items()]
    outputs = []
    for row, value in enumerate(term.gradient):
        changed = change(value) + sum((sympy.diff(value, f) * df for f, df in slope_changes.items()), sympy.S.Zero)
        if changed != 0:
            outputs.append((f"products[{_row(row, size)}, c]", changed))
    read = needed(assignments, [value for _, value in outputs])
    codes: dict[Symbol, str] = {changes[z]: f"directions[{_row(k, size)}, c]" for k, z in enumerate(moving)}
    known = (
        *moving,
        *(d for d, _ in term.differences),
        *(s for s, _ in (*term.scalars, *term.slopes, *term.curvatures)),
    )
    codes |= {writer.renamed(term, symbol): writer.renamed(term, symbol).name for symbol in known}
    return kernel(
        "", "", (), codes,
        [Output(target, writer.renamed(term, value), "", "+=") for target, value in outputs],
        assignments=[(symbol, writer.renamed(term, value)) for symbol, value in read],
    )  # fmt: skip


def _inner_lines(made: Kernel) -> list[Line]:
    """The lines of a kernel inside a loop over pairs, whose own common parts must keep their values."""
    lines = [*made.inputs, *made.body, *made.outputs]
    return [replace(line, target=_inner(line.target), code=_inner(line.code)) for line in lines]


def _inner(code: str) -> str:
    """Code with its common parts x0, x1, ... called y0, y1, ..."""
    return re.sub(r"\bx(\d+)\b", r"y\1", code)


GROUP = 64
"""Particles of a block."""
_REMEDY = "leave parallel out: this gradient visits each pair once, which threads cannot share"


def gathered_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[BlockLoop, ...]:
    """The gradient of H, where it can be gathered, and its code calls nothing that keeps particles apart."""
    if not _acts_on_itself(model):
        if model.parallel:
            raise ExpressionError("parallel=True, but particles do not act on themselves as on others", _REMEDY)
        return ()
    gradient = _gathered_gradient(Writer(model, derivatives))
    called = {name for line in (*gradient.body, *gradient.outputs) for name in re.findall(r"math\.(\w+)\(", line.code)}
    if called <= {"sqrt"}:
        return (_of_some(gradient) if model.parallel else gradient,)
    if model.parallel:
        raise ExpressionError(
            f"parallel=True, but the gradient calls {' and '.join(sorted(called - {'sqrt'}))}", _REMEDY
        )
    return ()


def _of_some(gradient: BlockLoop) -> BlockLoop:
    """The same for particles from `begin` to `end` only, which one of several threads works on."""
    return replace(
        gradient,
        name="gradient_of_some",
        summary="Fill `gradient`, shape (2, n, d), with H_q and H_p of particles from `begin` to `end`.",
        arguments=(*STATE, "begin", "end", "gradient"),
        decorator='@njit(error_model="numpy", fastmath={"contract"})',
        views=(),
        begin="begin",
        end="end",
    )


def _acts_on_itself(model: PairwiseModel) -> bool:
    if model.limit is None or not model.smooth:
        return False
    own = dict(zip((*model.second.p, *model.second.own), (*model.first.p, *model.first.own), strict=True))
    return bool(sympy.expand(model.limit.xreplace(own) / 2 - model.self_term) == 0)


def _gathered_gradient(writer: Writer) -> BlockLoop:
    pair, size = writer.derivatives.pair, writer.dimension
    scalars = {s: code for s, code in writer.single_codes.items() if s in dict(pair.scalars)}
    codes = [*writer.codes("i").values(), *(f"singles[i, {k}]" for k in range(len(writer.singles)))]
    rows = {code: entry("state", row, "GROUP") for row, code in enumerate(codes)}
    outputs = [(entry("sums", row, "GROUP"), value) for row, value in enumerate(pair.gradient[: 2 * size])]
    reads = {s: rows.get(code, code) for s, code in {**writer.codes("i"), **writer.codes("j"), **scalars}.items()}
    made = writer.summed((*pair.differences, *pair.scalars, *pair.slopes), reads, outputs, scalars)
    used = {line.code for line in made.inputs}
    singles = [Line("singles", "single_values(z)")] if writer.singles else []
    return BlockLoop(
        name="hamiltonian_gradient",
        summary="Fill `gradient`, shape (2, n, d), with H_q and H_p.",
        arguments=signature((*STATE, "gradient")),
        decorator="@Contracted",
        views=views((*STATE, "gradient"), writer.model),
        head=(
            *singles,
            Line("state", f"np.empty({len(codes)}*GROUP)"),
            Line("sums", f"np.empty({2 * size}*GROUP)"),
            *(line for line in made.inputs if line.code.startswith("parameters[")),
        ),
        before=(
            *(Line(row, re.sub(r"\bi\b", "first + m", code)) for code, row in rows.items() if row in used),
            *(Line(target, "0.0") for target, _ in outputs),
        ),
        inputs=tuple(line for line in made.inputs if re.search(r"\bj\b", line.code)),
        point_inputs=tuple(line for line in made.inputs if line.code.startswith("state[")),
        body=tuple(map(packed, made.body)),
        outputs=tuple(map(packed, made.outputs)),
        after=tuple(
            Line(f"gradient[{k // size}, first + m, {k % size}]", target) for k, (target, _) in enumerate(outputs)
        ),
        operations_before=made.operations_before,
        operations_after=made.operations_after,
    )
