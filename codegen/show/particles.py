"""The derived equations of a problem about particles, laid out for people to read."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

import sympy
from sympy import Expr, Symbol

from codegen.expressions.invariants import Invariants
from codegen.model.pairwise import PairwiseModel
from codegen.show.notation import WIDTH
from codegen.transcribe.connect import PairwiseProgram, pairwise


def pairwise_equations(model: PairwiseModel, scheme: str | None, method: str | None, latex: bool) -> str:
    """The Hamiltonian, its scalars, Hamilton's equations and the equations of a step."""
    program = pairwise(model, scheme, method)
    lines = [f"{model.title.rstrip('.')} ({program.method} method, scheme {program.scheme})", ""]
    rows = list(_rows(model, program))
    if latex:
        return "\n".join(
            [rf"\section*{{{lines[0]}}}", *(rf"\[ {sympy.latex(a)} = {sympy.latex(b)} \]" for a, b in rows)]
        )
    for left, right in rows:
        lines += textwrap.wrap(f"{left} = {sympy.sstr(right)}", WIDTH, initial_indent="  ", subsequent_indent="      ")
    return "\n".join(lines)


def _rows(model: PairwiseModel, program: PairwiseProgram) -> Iterator[tuple[Symbol, Expr]]:
    parts = Invariants.of(model.pair_term, model.first.moving, model.second.moving)
    yield Symbol("self"), model.self_term
    yield from zip(parts.symbols, parts.polynomials, strict=True)
    yield Symbol("pair"), parts.outer
    if model.limit is not None:
        yield Symbol("limit of pair where particles meet"), model.limit
    names = dict(zip(parts.symbols, (Symbol(f"pair_by_{s}") for s in parts.symbols), strict=True))
    for k, symbol in enumerate(parts.symbols):
        yield names[symbol], parts.slope(k)
    for z in model.first.moving:
        total = sum(
            (names[s] * sympy.diff(p, z) for s, p in zip(parts.symbols, parts.polynomials, strict=True)), sympy.S.Zero
        )
        yield Symbol(f"pair_by_{z}"), total
    h = Symbol("h")
    for fraction, a, b in program.substeps:
        q = f"H_p((1 - {a}) q_0 + {a} q_1, (1 - {b}) p_0 + {b} p_1)"
        yield Symbol("q_1"), Symbol("q_0") + fraction * h * Symbol(q)
        yield Symbol("p_1"), Symbol("p_0") - fraction * h * Symbol(q.replace("H_p", "H_q"))
