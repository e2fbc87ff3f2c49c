"""A pairwise Hamiltonian H and its derivatives as loops over particles and pairs.

States are arrays z of shape (2, n, d): positions z[0], momenta z[1]. Rows of second derivatives follow the order of
z.reshape(2 n d). Every loop visits each pair once and writes to both of its particles. The loops compute H, its
gradient, its Hessian, Hessian products, and H_pp. `alone` is the self term, `pair` the pair term of particles i and j.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Symbol

from codegen.discretise.model.pairwise import FRACTION, PairwiseModel
from codegen.emit.lower.kernels import Kernel, Line, Output, kernel, needed
from codegen.emit.lower.printer import scalar_code
from codegen.emit.pairwise_derivatives import PairDerivatives, TermDerivatives
from codegen.symbolic.graph import Assignment

CLOSEST = Symbol("CLOSEST", positive=True)
"""The least squared distance that kernels distinguish from zero if the pair term has a limit at coincidence."""
STATE = ("z", "own", "parameters")
"""The arguments of every loop: the state, the particles' own parameters, and common parameters."""


@dataclass(frozen=True)
class PairLoop:
    """A function that visits all particles and all pairs, as groups of lines in the order of execution.

    `arguments` are pointers and numbers; `views` make arrays from the pointers. `head` comes first. Each particle i
    has `inputs`, `alone` and `alone_outputs`, then for each j < i `pair_inputs`, `pair` and `pair_outputs`, then
    `after`. `tail` and `results` come last. `alone_directions` and `pair_directions` are repeated for each direction of
    a Hessian product. `over_pairs` and `over_directions` are the code of these inner loops, empty if not needed.
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


@dataclass(frozen=True)
class ParticleLoop:
    """A function that visits all particles: `head`, then `lines` in the loop `over` them, and `results`."""

    name: str
    summary: str
    arguments: tuple[str, ...]
    decorator: str
    views: tuple[Line, ...]
    head: tuple[Line, ...]
    over: tuple[str, ...]
    lines: tuple[Line, ...]
    results: tuple[str, ...]


def signature(arguments: Sequence[str]) -> tuple[str, ...]:
    """Return the arguments of a kernel, with `count` and `columns` added where necessary.

    `count`, the number of particles, follows `z` or `start`; `columns`, the number of directions, follows `directions`.
    """
    first = next((name for name in ("z", "start") if name in arguments), "")
    after = {first: "count", "directions": "columns"}
    return tuple(name for a in arguments for name in ((a, after[a]) if a in after else (a,)))


def views(arguments: Sequence[str], model: PairwiseModel, blocks: int = 1) -> tuple[Line, ...]:
    """Return lines that make arrays from a kernel's pointers; `blocks` is the number of rows of H_pp per particle."""
    size, own = len(model.coordinates), len(model.own)
    state, positions, rows = f"(2, count, {size})", f"(count, {size})", f"{2 * size}*count"
    shapes = {"z": state, "gradient": state, "hessian": f"({rows}, {rows})"}
    shapes |= dict.fromkeys(("rates", "start", "target", "position"), positions)
    shapes |= dict.fromkeys(("directions", "products"), f"({rows}, columns)")
    shapes |= {"own": f"(count, {own})"} if own else {}
    shapes["matrix"] = "(count, count)" if blocks == 1 else f"({blocks}*count, {blocks}*count)"
    return tuple(Line(name, f"carray({name}, {shapes[name]})") for name in arguments if name in shapes)


class Writer:
    """The code of the symbols in all loops, and `singles`: scalars of one particle's position, evaluated only once."""

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
                        code = f"singles[{mark}, {self.singles.index(value)}]"
                        self.single_codes[self.renamed(term, symbol)] = code

    def renamed(self, term: TermDerivatives, expression: Expr) -> Expr:
        """Return an expression of a term; in the self term, scalars and derivatives get the suffix `_alone`."""
        if term is self.derivatives.pair:
            return expression
        named = [symbol for symbol, _ in (*term.scalars, *term.slopes, *term.curvatures)]
        return expression.xreplace({symbol: Symbol(f"{symbol.name}_alone", real=True) for symbol in named})

    def codes(self, mark: str) -> dict[Symbol, str]:
        """Return the code that reads position, momentum and own parameters of the particle `mark`, "i" or "j"."""
        particle = self.model.first if mark == "i" else self.model.second
        codes = {s: f"z[0, {mark}, {a}]" for a, s in enumerate(particle.q)}
        codes |= {s: f"z[1, {mark}, {a}]" for a, s in enumerate(particle.p)}
        return codes | {s: f"own[{mark}, {a}]" for a, s in enumerate(particle.own)}

    def lowered(
        self, term: TermDerivatives, outputs: Sequence[tuple[str, str, Expr]], names: Sequence[Assignment] = ()
    ) -> Kernel:
        """Return a kernel of a term's scalars, of its derivatives `names`, and of outputs (target, operator, value)."""
        assignments = []
        for symbol, value in needed((*term.differences, *term.scalars, *names), [value for _, _, value in outputs]):
            renamed = self.renamed(term, symbol)
            if renamed in self.single_codes:
                continue
            if self.model.smooth and symbol in term.distances:
                value = sympy.Max(value, CLOSEST)
            assignments.append((renamed, self.renamed(term, value)))
        codes = {**self.codes("i"), **self.codes("j"), **self.single_codes}
        codes |= {s: f"parameters[{k}]" for k, s in enumerate(self.model.parameters)}
        written = [Output(target, self.renamed(term, value), "", operator) for target, operator, value in outputs]
        return kernel("", "", (), codes, written, assignments=assignments)

    def summed(
        self,
        assignments: Sequence[Assignment],
        reads: dict[Symbol, str],
        outputs: Sequence[tuple[str, Expr]],
        inputs: Collection[Symbol],
    ) -> Kernel:
        """Return a kernel that adds outputs (target, value) of particle j; symbols `inputs` need no assignments."""
        distances = self.derivatives.pair.distances
        written = [
            (symbol, sympy.Max(value, CLOSEST) if symbol in distances else value)
            for symbol, value in needed(assignments, [value for _, value in outputs])
            if symbol not in inputs
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
        """Return a loop over particles and pairs; values that do not depend on particle j are read outside its loop."""
        uses_singles = any("singles[" in line.code for k in (alone, pair) for line in (*k.inputs, *k.body, *k.outputs))
        start = [Line("singles", "single_values(z)")] if uses_singles else []
        of_pair = [", j, " in line.code or "[j, " in line.code for line in pair.inputs]
        read_i = [*alone.inputs, *(line for line, is_inner in zip(pair.inputs, of_pair, strict=True) if not is_inner)]
        read_j = [line for line, is_inner in zip(pair.inputs, of_pair, strict=True) if is_inner]
        return PairLoop(
            name=name,
            summary=summary,
            arguments=signature(arguments),
            decorator="@Value" if results else "@Kernel",
            views=views(arguments, self.model, 1 if self.derivatives.isotropic else self.dimension),
            head=(*start, *head),
            inputs=tuple(dict.fromkeys(read_i)),
            alone=alone.body,
            alone_outputs=alone.outputs,
            alone_directions=tuple(directions[0]),
            pair_inputs=tuple(dict.fromkeys(read_j)),
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


def pair_loops(
    model: PairwiseModel, derivatives: PairDerivatives, by_turns: bool = False
) -> tuple[tuple[str, ...], tuple[PairLoop, ...]]:
    """Return the code of scalars of single particles, and the loops for H and its derivatives.

    If steps update positions and momenta `by_turns`, the loops compute only H, H_q and H_p.
    """
    writer = Writer(model, derivatives)
    size, alone, pair = writer.dimension, derivatives.alone, derivatives.pair
    hamiltonian = writer.loop(
        "hamiltonian", "H at a state `z`, shape (2, n, d), of particles with parameters `own`, shape (n, k).", STATE,
        writer.lowered(alone, [("energy", "+=", alone.value)]),
        writer.lowered(pair, [("energy", "+=", pair.value)]),
        head=[Line("energy", "0.0")],
        results=["energy"],
    )  # fmt: skip
    singles = tuple(accurate_sum(e, model) for e in writer.singles)
    if by_turns:
        return singles, (
            hamiltonian,
            _gradient(writer, "slope", "Fill `rates`, shape (n, d), with H_q.", range(size)),
            _gradient(writer, "velocity", "Fill `rates`, shape (n, d), with H_p.", range(size, 2 * size)),
        )
    summary = "Fill `gradient`, shape (2, n, d), with H_q and H_p."
    return singles, (
        hamiltonian,
        _gradient(writer, "hamiltonian_gradient", summary, range(2 * size)),
        _hessian(writer),
        _hessian_products(writer),
        _momentum_matrix(writer),
    )


def _gradient(writer: Writer, name: str, summary: str, indices: range) -> PairLoop:
    """Return the loop for H_q, H_p or both; `indices` select coordinates and momenta among a particle's symbols."""
    size, alone, pair = writer.dimension, writer.derivatives.alone, writer.derivatives.pair
    array = "gradient" if len(indices) == 2 * size else "rates"

    def entry_of(k: int, mark: str) -> str:
        return f"{array}[{k // size}, {mark}, {k % size}]" if array == "gradient" else f"{array}[{mark}, {k % size}]"

    sums = {k: f"by_{writer.model.first.moving[k]}" for k in indices}
    # A sum that starts from zero must start from a floating-point zero.
    first = [alone.gradient[k] for k in indices]
    own = [(sums[k], "=", sympy.Float(0) if v == 0 else v) for k, v in zip(indices, first, strict=True)]
    both = [(sums[k], "+=", pair.gradient[k]) for k in indices]
    both += [(entry_of(k, "j"), "+=", pair.gradient[2 * size + k]) for k in indices]
    return writer.loop(
        name, summary, (*STATE, array),
        writer.lowered(alone, own, alone.slopes),
        writer.lowered(pair, [output for output in both if output[2] != 0], pair.slopes),
        head=[Line(f"{array}[:]", "0.0")],
        after=[Line(entry_of(k, "i"), sums[k], operator="+=") for k in indices],
    )  # fmt: skip


def _hessian(writer: Writer) -> PairLoop:
    """Return the loop that fills the Hessian of H as a matrix."""
    size = writer.dimension
    half, *rows = _offsets(size)
    kernels = []
    for term, offset in zip((writer.derivatives.alone, writer.derivatives.pair), rows, strict=True):
        # Equal second derivatives have one name: h0, h1, ...
        names: dict[Expr, str] = {}
        outputs = []
        for row, column, value in term.hessian:
            one, other = row // size, column // size
            # Rows of momenta follow rows of positions, and rows of particle i follow rows of particle j < i.
            is_lower = (one % 2, -(one // 2)) >= (other % 2, -(other // 2))
            low, high = (row, column) if is_lower else (column, row)
            name = names.setdefault(value, f"h{len(names)}")
            outputs.append(Line(f"hessian[{_row(low, size)}, {_row(high, size)}]", name, operator="+="))
        named = [(name, "=", value) for value, name in names.items()]
        made = writer.lowered(term, named, term.slopes + term.curvatures)
        kernels.append(replace(made, body=(offset, *made.body, *made.outputs), outputs=tuple(outputs)))
    return writer.loop(
        "hamiltonian_hessian", "Fill `hessian`, shape (2nd, 2nd), with the second derivatives of H.",
        (*STATE, "hessian"), kernels[0], kernels[1],
        head=[half, Line("hessian[:]", "0.0")],
        tail=[Line("", "mirror_lower_triangle(hessian)", operator="")],
    )  # fmt: skip


def _hessian_products(writer: Writer) -> PairLoop:
    """Return the loop for products of the Hessian with directions, which take fewer operations than the Hessian."""
    half, *rows = _offsets(writer.dimension)
    kernels, lines, operations = [], [], (0, 0)
    for term, offset in zip((writer.derivatives.alone, writer.derivatives.pair), rows, strict=True):
        named = [(str(writer.renamed(term, s)), "=", value) for s, value in (*term.slopes, *term.curvatures)]
        made = writer.lowered(term, named)
        kernels.append(replace(made, body=(offset, *made.body, *made.outputs), outputs=()))
        along = _along_direction(writer, term)
        # Common subexpressions x0, x1, ... of the outer loop keep their values: in the inner loop they are y0, y1, ...
        common = re.compile(r"\bx(\d+)\b")
        lines.append(
            [
                replace(line, target=common.sub(r"y\1", line.target), code=common.sub(r"y\1", line.code))
                for line in (*along.inputs, *along.body, *along.outputs)
            ]
        )
        operations = made.operations_before + along.operations_before, made.operations_after + along.operations_after
    visit = writer.loop(
        "hessian_products",
        "Fill `products`, shape (2 n d, m), with the second derivatives of H times m directions, shape (2 n d, m).",
        (*STATE, "directions", "products"), kernels[0], kernels[1],
        head=[half, Line("products[:]", "0.0")],
        directions=(lines[0], lines[1]),
    )  # fmt: skip
    return replace(visit, operations_before=operations[0], operations_after=operations[1])


def _momentum_matrix(writer: Writer) -> PairLoop:
    """Return the loop for H_pp: one row per particle if H_pp is isotropic, else one row per momentum component."""
    size, isotropic = writer.dimension, writer.derivatives.isotropic
    kernels = []
    for term in (writer.derivatives.alone, writer.derivatives.pair):
        outputs = []
        for row, column, value in term.hessian:
            (one, a), (other, b) = divmod(row, size), divmod(column, size)
            if one % 2 == 0 or other % 2 == 0 or (isotropic and a > 0):
                continue
            codes = [f"{'ij'[one // 2]}", f"{'ij'[other // 2]}"]
            if not isotropic:
                codes = [f"{size}*{index} + {axis}" for index, axis in zip(codes, (a, b), strict=True)]
            # The row of particle i follows the row of particle j < i.
            low, high = codes if one // 2 <= other // 2 else codes[::-1]
            outputs.append((f"matrix[{low}, {high}]", "+=", value))
        kernels.append(writer.lowered(term, outputs, term.slopes + term.curvatures))
    return writer.loop(
        "momentum_matrix",
        "Fill `matrix` with the second derivatives of H by momenta"
        + (", alike for every component of space: shape (n, n)." if isotropic else ", shape (nd, nd)."),
        (*STATE, "matrix"), kernels[0], kernels[1],
        head=[Line("matrix[:]", "0.0")],
        tail=[Line("", "mirror_lower_triangle(matrix)", operator="")],
    )  # fmt: skip


def _row(index: int, size: int) -> str:
    """Return code of the Hessian's row for coordinate or momentum `index` of a pair; `size` is the space dimension."""
    group, axis = divmod(index, size)
    particle, is_momentum = divmod(group, 2)
    parts = [*(["half"] if is_momentum else []), "row_" + "ij"[particle], *([str(axis)] if axis else [])]
    return " + ".join(parts)


def _offsets(size: int) -> tuple[Line, Line, Line]:
    """Return the lines that assign the first row of momenta, and the first rows of particles i and j."""
    return (
        Line("half", f"{size}*z.shape[1]" if size > 1 else "z.shape[1]", "where rows of momenta begin"),
        Line("row_i", f"{size}*i" if size > 1 else "i"),
        Line("row_j", f"{size}*j" if size > 1 else "j"),
    )


def _along_direction(writer: Writer, term: TermDerivatives) -> Kernel:
    """Return a kernel that adds a term's derivatives of the gradient along direction c to `products`."""
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
    assigned = (symbol for symbol, _ in (*term.differences, *term.scalars, *term.slopes, *term.curvatures))
    codes |= {writer.renamed(term, symbol): writer.renamed(term, symbol).name for symbol in (*moving, *assigned)}
    return kernel(
        "", "", (), codes,
        [Output(target, writer.renamed(term, value), "", "+=") for target, value in outputs],
        assignments=[(symbol, writer.renamed(term, value)) for symbol, value in read],
    )  # fmt: skip


def particle_loops(model: PairwiseModel, singles: Sequence[str]) -> tuple[ParticleLoop, ...]:
    """Return the loop for scalars of single particles, if any; for connect problems, loops for domain and guess."""
    loops = []
    if singles:
        size = f"{len(singles)}"
        loops.append(
            ParticleLoop(
                "single_values",
                f"Scalars of particles at `z`, shape (2, n, d), that all their pairs share, shape (n, {size}).", ("z",),
                '@njit(error_model="numpy")', (),
                (Line("singles", f"np.empty((z.shape[1], {size}))"),), ("for i in range(z.shape[1]):",),
                tuple(Line(f"singles[i, {k}]", code) for k, code in enumerate(singles)), ("singles",),
            )
        )  # fmt: skip
    if not model.connects:
        return tuple(loops)
    domain = tuple(accurate_sum(e, model) for e in model.domain)
    loops.append(
        ParticleLoop(
            "domain_margin",
            "The least value of what must be positive wherever a particle of `z`, shape (2, n, d), is.",
            signature(("z",)), "@Value", views(("z",), model) if domain else (),
            (Line("margin", "np.inf"),), ("for i in range(z.shape[1]):",) if domain else (),
            tuple(Line("margin", f"min(margin, {code})") for code in domain), ("margin",),
        )
    )  # fmt: skip
    codes: dict[Symbol, str] = {x: f"start[i, {a}]" for a, x in enumerate(model.first.q)}
    codes |= {x: f"target[i, {a}]" for a, x in enumerate(model.second.q)}
    codes[FRACTION] = "fraction"
    made = kernel("", "", (), codes, [Output(f"position[i, {a}]", e, "") for a, e in enumerate(model.path)])
    arguments = ("start", "target", "fraction", "position")
    loops.append(
        ParticleLoop(
            "guide", "Fill `position`, shape (n, d) as all are, with where particles may be after a part of their way.",
            signature(arguments), "@Kernel", views(arguments, model), (), ("for i in range(start.shape[0]):",),
            (*made.inputs, *made.body, *made.outputs), (),
        )
    )  # fmt: skip
    return tuple(loops)


def accurate_sum(expression: Expr, model: PairwiseModel, codes: Sequence[str] = ()) -> str:
    """Return code of a polynomial in one particle's coordinates; products of two are summed with twice the digits.

    `codes` read the coordinates; by default, they read the coordinates of particle i.
    """
    codes = codes or [f"z[0, i, {a}]" for a in range(len(model.first.q))]
    reads = {s: Symbol(code, real=True) for s, code in zip(model.first.q, codes, strict=True)}
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
