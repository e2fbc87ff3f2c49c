"""Second derivatives of a pairwise Hamiltonian -> loops over pairs: as a matrix, by momenta alone, times directions.

The gradient of H where particles act on themselves as they act on others -> a loop that gathers it for blocks.

Where self_term is half the limit of the pair term at coincidence, H_q and H_p of a particle i are sums of one
expression over all particles j, particle i among them. To gather them takes twice as many evaluations as to visit each
pair once, but each evaluation writes to particle i alone, so that several particles are worked on at once.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import sympy
from sympy import Expr, Symbol

from codegen.discretise.model.pairwise import PairwiseModel
from codegen.emit.lower.kernels import Kernel, Line, Output, kernel, needed
from codegen.emit.lower.particles.pairs import STATE, BlockLoop, PairLoop, Writer, entry, packed, signature, views
from codegen.emit.pairwise_derivatives import PairDerivatives, TermDerivatives
from codegen.errors import ExpressionError


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
    gradient = _gradient(Writer(model, derivatives))
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


def _gradient(writer: Writer) -> BlockLoop:
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
