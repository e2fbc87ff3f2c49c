"""Second derivatives of a pairwise Hamiltonian -> loops over pairs: as a matrix, by momenta alone, times directions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import sympy
from sympy import Expr, Symbol

from codegen.derive.pairwise import TermDerivatives
from codegen.lower.kernels import Kernel, Line, Output, kernel, needed
from codegen.lower.particles.pair_writer import STATE, PairLoop, Writer


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
