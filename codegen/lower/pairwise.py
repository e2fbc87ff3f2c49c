"""Derivatives of a pairwise Hamiltonian -> loops over pairs, as strings.

States are arrays z of shape (2, n, d): places z[0], momenta z[1]. Rows of second derivatives run over z in that order,
z.reshape(2 n d). Every loop visits each pair once and writes to both of its particles.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Symbol

from codegen.differentiate.pairwise import Assignment, PairDerivatives, TermDerivatives
from codegen.lower.kernels import Kernel, Line, Output, kernel
from codegen.model.pairwise import FRACTION, PairwiseModel

CLOSEST = Symbol("CLOSEST", positive=True)
"""The least squared distance that kernels tell from zero, where a limit exists."""
_STATE = ("z", "own", "parameters")


@dataclass(frozen=True)
class PairLoop:
    """A function that visits all particles, and all pairs, as groups of lines in the order in which they are run.

    `head` comes first; for each particle i `inputs`, `alone` and `alone_outputs`; for each j < i `pair_inputs`, `pair`
    and `pair_outputs`; then `after` for particle i, and at last `tail` and `results`. Lines of `alone_directions` and
    `pair_directions` are repeated for each of several `directions`. `over_pairs` and `over_directions` are the code of
    these loops, none where there is nothing to repeat.
    """

    name: str
    summary: str
    arguments: tuple[str, ...]
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


@dataclass(frozen=True)
class ParticleLoop:
    """A function that visits all particles: `head`, then `lines` in the loop `over` them, and `results`."""

    name: str
    summary: str
    arguments: tuple[str, ...]
    head: tuple[Line, ...]
    over: tuple[str, ...]
    lines: tuple[Line, ...]
    results: tuple[str, ...]


class _Writer:
    """What all loops of one problem share: how symbols are read, and which scalars belong to single particles."""

    def __init__(self, model: PairwiseModel, derivatives: PairDerivatives) -> None:
        self.model, self.derivatives = model, derivatives
        self.dimension = len(model.coordinates)
        back = dict(zip(model.second.q, model.first.q, strict=True))
        self.singles: list[Expr] = []
        self.single_places: dict[Symbol, str] = {}
        for term in (derivatives.alone, derivatives.pair):
            for symbol, polynomial in term.scalars:
                for mark, own in (("i", model.first.q), ("j", model.second.q)):
                    if polynomial.is_Add and polynomial.free_symbols <= set(own):
                        value = polynomial.xreplace(back)
                        if value not in self.singles:
                            self.singles.append(value)
                        self.single_places[self._scalar(term, symbol)] = f"singles[{mark}, {self.singles.index(value)}]"

    def _scalar(self, term: TermDerivatives, symbol: Symbol) -> Symbol:
        """Scalars of the self term and of the pair term may carry the same names."""
        return symbol if term is self.derivatives.pair else Symbol(f"{symbol.name}_alone", real=True)

    def renamed(self, term: TermDerivatives, expression: Expr) -> Expr:
        """An expression of one term with its scalars and their derivatives under names of their own."""
        if term is self.derivatives.pair:
            return expression
        named = [symbol for symbol, _ in (*term.scalars, *term.slopes, *term.curvatures)]
        return expression.xreplace({symbol: Symbol(f"{symbol.name}_alone", real=True) for symbol in named})

    def places(self, mark: str) -> dict[Symbol, str]:
        """The code that reads the quantities of one particle."""
        one = self.model.first if mark == "i" else self.model.second
        places = {s: f"z[0, {mark}, {a}]" for a, s in enumerate(one.q)}
        places |= {s: f"z[1, {mark}, {a}]" for a, s in enumerate(one.p)}
        return places | {s: f"own[{mark}, {a}]" for a, s in enumerate(one.own)}

    def lowered(
        self, term: TermDerivatives, outputs: Sequence[tuple[str, str, Expr]], names: Sequence[Assignment] = ()
    ) -> Kernel:
        """Scalars, named derivatives and outputs (target, operator, value) of one term with common parts shared."""
        needed = _needed((*term.differences, *term.scalars, *names), [value for _, _, value in outputs])
        assignments = []
        for symbol, value in needed:
            renamed = self.renamed(term, symbol)
            if renamed in self.single_places:
                continue
            if self.model.smooth and symbol in term.distances:
                value = sympy.Max(value, CLOSEST)
            assignments.append((renamed, self.renamed(term, value)))
        places = {**self.places("i"), **self.places("j"), **self.single_places}
        places |= {s: f"parameters[{k}]" for k, s in enumerate(self.model.parameters)}
        return kernel(
            "", "", (), places,
            [Output(target, self.renamed(term, value), "", operator) for target, operator, value in outputs],
            assignments=assignments,
        )  # fmt: skip

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
            arguments=tuple(arguments),
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


def pair_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[tuple[str, ...], tuple[PairLoop, ...]]:
    """The code of the scalars of single particles, and the loops for H and its derivatives."""
    writer = _Writer(model, derivatives)
    singles = tuple(_accurate_sum(e, model) for e in writer.singles)
    return singles, (
        _hamiltonian(writer),
        _gradient(writer),
        _hessian(writer),
        _hessian_products(writer),
        _momentum_matrix(writer),
    )


def separable_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[tuple[str, ...], tuple[PairLoop, ...]]:
    """The code of the scalars of single particles, and the loops for H, H_q and H_p of a separable Hamiltonian."""
    writer = _Writer(model, derivatives)
    singles = tuple(_accurate_sum(e, model) for e in writer.singles)
    return singles, (_hamiltonian(writer), _part(writer, "slope", 0), _part(writer, "velocity", 1))


def _part(writer: _Writer, name: str, part: int) -> PairLoop:
    """H_q (part 0) or H_p (part 1) alone."""
    model, size = writer.model, writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    sums = [f"by_{s}" for s in model.first.moving][part * size : (part + 1) * size]
    own = [(target, "=", _float(value)) for target, value in zip(sums, alone.gradient[part * size :], strict=False)]
    first, second = pair.gradient[part * size :], pair.gradient[(2 + part) * size :]
    both = [(target, "+=", value) for target, value in zip(sums, first, strict=False)]
    both += [(f"rates[j, {a}]", "+=", value) for a, value in enumerate(second[:size])]
    quantity = "H_p" if part else "H_q"
    return writer.loop(
        name, f"Fill `rates`, shape (n, d), with {quantity}.", (*_STATE, "rates"),
        writer.lowered(alone, own, alone.slopes),
        writer.lowered(pair, [entry for entry in both if entry[2] != 0], pair.slopes),
        head=[Line("rates[:]", "0.0")],
        after=[Line(f"rates[i, {a}]", target, operator="+=") for a, target in enumerate(sums)],
    )  # fmt: skip


def particle_loops(model: PairwiseModel, singles: Sequence[str]) -> tuple[ParticleLoop, ...]:
    """The scalars of single particles, if there are any; for a connect problem the domain and the guessed way."""
    loops = []
    if singles:
        size = f"{len(singles)}"
        loops.append(
            ParticleLoop(
                "single_values", f"Scalars of single particles that all their pairs share, shape (n, {size}).", ("z",),
                (Line("singles", f"np.empty((z.shape[1], {size}))"),), ("for i in range(z.shape[1]):",),
                tuple(Line(f"singles[i, {k}]", code) for k, code in enumerate(singles)), ("singles",),
            )
        )  # fmt: skip
    if model.task != "connect":
        return tuple(loops)
    domain = tuple(_accurate_sum(e, model) for e in model.domain)
    loops.append(
        ParticleLoop(
            "domain_margin", "The least value of what must be positive wherever a particle is.", ("z",),
            (Line("margin", "np.inf"),), ("for i in range(z.shape[1]):",) if domain else (),
            tuple(Line("margin", f"min(margin, {code})") for code in domain), ("margin",),
        )
    )  # fmt: skip
    places: dict[Symbol, str] = {x: f"start[i, {a}]" for a, x in enumerate(model.first.q)}
    places |= {x: f"target[i, {a}]" for a, x in enumerate(model.second.q)}
    places[FRACTION] = "fraction"
    made = kernel("", "", (), places, [Output(f"place[i, {a}]", e, "") for a, e in enumerate(model.path)])
    loops.append(
        ParticleLoop(
            "guide", "Fill `place`, shape (n, d), with where particles may be after a fraction of their way.",
            ("start", "target", "fraction", "place"), (), ("for i in range(start.shape[0]):",),
            (*made.inputs, *made.body, *made.outputs), (),
        )
    )  # fmt: skip
    return tuple(loops)


def _hamiltonian(writer: _Writer) -> PairLoop:
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    return writer.loop(
        "hamiltonian", "H at a state.", _STATE,
        writer.lowered(alone, [("energy", "+=", alone.value)]),
        writer.lowered(pair, [("energy", "+=", pair.value)]),
        head=[Line("energy", "0.0")],
        results=["energy"],
    )  # fmt: skip


def _gradient(writer: _Writer) -> PairLoop:
    model, size = writer.model, writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    sums = [f"by_{s}" for s in model.first.moving]
    own = [(target, "=", _float(value)) for target, value in zip(sums, alone.gradient, strict=True)]
    both = [(target, "+=", value) for target, value in zip(sums, pair.gradient, strict=False)]
    both += [
        (f"gradient[{k // size}, j, {k % size}]", "+=", value) for k, value in enumerate(pair.gradient[2 * size :])
    ]
    return writer.loop(
        "hamiltonian_gradient", "Fill `gradient`, shape (2, n, d), with H_q and H_p.", (*_STATE, "gradient"),
        writer.lowered(alone, own, alone.slopes),
        writer.lowered(pair, [entry for entry in both if entry[2] != 0], pair.slopes),
        head=[Line("gradient[:]", "0.0")],
        after=[Line(f"gradient[{k // size}, i, {k % size}]", name, operator="+=") for k, name in enumerate(sums)],
    )  # fmt: skip


def _float(value: Expr) -> Expr:
    """A sum that begins with zero begins with a floating-point number."""
    return sympy.Float(0) if value == 0 else value


def _entries(term: TermDerivatives) -> list[tuple[str, int, int, Expr]]:
    """Distinct values among second derivatives under names h0, h1, ..., with all places that they have."""
    names: dict[Expr, str] = {}
    return [(names.setdefault(value, f"h{len(names)}"), row, column, value) for row, column, value in term.hessian]


def _row(place: int, size: int) -> str:
    """The row of a moving symbol of one of two particles."""
    group, axis = divmod(place, size)
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


def _hessian(writer: _Writer) -> PairLoop:
    size = writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    half, row_i, row_j = _offsets(size)
    filled = {}
    for term in (alone, pair):
        lines = []
        for name, row, column, _ in _entries(term):
            one, other = divmod(row, size)[0], divmod(column, size)[0]
            # j < i: momenta come after places, particle i after particle j.
            later = (one % 2, -(one // 2)) >= (other % 2, -(other // 2))
            place = (row, column) if later else (column, row)
            lines.append(Line(f"hessian[{_row(place[0], size)}, {_row(place[1], size)}]", name, operator="+="))
        filled[term is pair] = lines
    first = writer.lowered(alone, _named(_entries(alone)), alone.slopes + alone.curvatures)
    second = writer.lowered(pair, _named(_entries(pair)), pair.slopes + pair.curvatures)
    return writer.loop(
        "hamiltonian_hessian", "Fill `hessian`, shape (2nd, 2nd), with the second derivatives of H.",
        (*_STATE, "hessian"),
        _extended(first, (row_i,), filled[False]),
        _extended(second, (row_j,), filled[True]),
        head=[half, Line("hessian[:]", "0.0")],
        tail=[Line("", "mirror_lower_triangle(hessian)", operator="")],
    )  # fmt: skip


def _extended(made: Kernel, inputs: Sequence[Line], outputs: Sequence[Line]) -> Kernel:
    return replace(made, body=(*inputs, *made.body, *made.outputs), outputs=tuple(outputs))


def _hessian_products(writer: _Writer) -> PairLoop:
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
        (*_STATE, "directions", "products"),
        kernels[0],
        kernels[1],
        head=[half, Line("products[:]", "0.0")],
        directions=(lines[0], lines[1]),
    )
    return replace(visit, operations_before=operations[0], operations_after=operations[1])


def _along_direction(writer: _Writer, term: TermDerivatives) -> Kernel:
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
    slope_changes = {slope: Symbol(f"d_{slope.name}", real=True) for slope in total}
    assignments += [(slope_changes[slope], value) for slope, value in total.items()]
    outputs = []
    for row, value in enumerate(term.gradient):
        changed = change(value) + sum((sympy.diff(value, f) * df for f, df in slope_changes.items()), sympy.S.Zero)
        if changed != 0:
            outputs.append((f"products[{_row(row, size)}, c]", changed))
    needed = _needed(assignments, [value for _, value in outputs])
    places: dict[Symbol, str] = {changes[z]: f"directions[{_row(k, size)}, c]" for k, z in enumerate(moving)}
    known = (
        *moving,
        *(d for d, _ in term.differences),
        *(s for s, _ in (*term.scalars, *term.slopes, *term.curvatures)),
    )
    places |= {writer.renamed(term, symbol): writer.renamed(term, symbol).name for symbol in known}
    return kernel(
        "", "", (), places,
        [Output(target, writer.renamed(term, value), "", "+=") for target, value in outputs],
        assignments=[(symbol, writer.renamed(term, value)) for symbol, value in needed],
    )  # fmt: skip


def _inner_lines(made: Kernel) -> list[Line]:
    """The lines of a kernel inside a loop over pairs, whose own common parts must keep their values."""
    lines = [*made.inputs, *made.body, *made.outputs]
    return [replace(line, target=_inner(line.target), code=_inner(line.code)) for line in lines]


def _inner(code: str) -> str:
    """Code with its common parts x0, x1, ... called y0, y1, ..."""
    return re.sub(r"\bx(\d+)\b", r"y\1", code)


def _momentum_matrix(writer: _Writer) -> PairLoop:
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
            places = [f"{'ij'[one // 2]}", f"{'ij'[other // 2]}"]
            if not isotropic:
                places = [f"{size}*{place} + {axis}" for place, axis in zip(places, (a, b), strict=True)]
            # The row of particle i comes after that of j.
            later = places if one // 2 <= other // 2 else places[::-1]
            outputs.append((f"matrix[{later[0]}, {later[1]}]", "+=", value))
        kernels.append(writer.lowered(term, outputs, term.slopes + term.curvatures))
    return writer.loop(
        "momentum_matrix",
        "Fill `matrix` with the second derivatives of H by momenta"
        + (", which act on every component of space alike: shape (n, n)." if isotropic else ", shape (nd, nd)."),
        (*_STATE, "matrix"), kernels[0], kernels[1],
        head=[Line("matrix[:]", "0.0")],
        tail=[Line("", "mirror_lower_triangle(matrix)", operator="")],
    )  # fmt: skip


def _needed(assignments: Sequence[Assignment], read: Iterable[Expr]) -> list[Assignment]:
    """Those assignments that the expressions read, directly or through others."""
    symbols: set[Symbol] = set().union(*(expression.free_symbols for expression in read))
    kept: list[Assignment] = []
    for symbol, value in reversed(assignments):
        if symbol in symbols:
            kept.append((symbol, value))
            symbols |= value.free_symbols
    return kept[::-1]


def _of_pair(line: Line) -> bool:
    """Whether an input is read for every j; parameters and what belongs to i are read outside that loop."""
    return ", j, " in line.code or "[j, " in line.code


def _accurate_sum(expression: Expr, model: PairwiseModel) -> str:
    """Code of a polynomial of one particle's coordinates: to the last digit where it is a sum of products of two."""
    from codegen.lower.printer import scalar_code

    reads = {s: Symbol(f"z[0, i, {a}]", real=True) for a, s in enumerate(model.first.q)}
    first, second = list[str](), list[str]()
    for term in sympy.Add.make_args(sympy.expand(expression)):
        coefficient, rest = term.as_coeff_Mul()
        factors = [b for base, e in rest.as_powers_dict().items() for b in [base] * int(e)] if rest != 1 else []
        exact = coefficient.is_Rational and abs(coefficient.q) == 1 and abs(coefficient.p) in (1, 2)
        if len(factors) > 2 or not exact or not all(f in reads for f in factors):
            return scalar_code(expression.xreplace(reads))
        one, other = [*(str(reads[f]) for f in factors), *["1.0"] * (2 - len(factors))]
        first.append(one if coefficient == 1 else f"-{one}" if coefficient == -1 else f"{int(coefficient)}.0*{one}")
        second.append(other)
    return f"accurate_dot(({', '.join(first)}), ({', '.join(second)}))"
