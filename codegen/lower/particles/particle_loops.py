"""What concerns single particles -> loops over particles: their scalars, the domain, the guessed way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.lower.kernels import INNER, Line, Output, kernel
from codegen.lower.particles.pair_writer import signature, views
from codegen.lower.printer import scalar_code
from codegen.model.pairwise import FRACTION, PairwiseModel


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


def particle_loops(model: PairwiseModel, singles: Sequence[str]) -> tuple[ParticleLoop, ...]:
    """The scalars of single particles, if there are any; for a connect problem the domain and the guessed way."""
    loops = []
    if singles:
        size = f"{len(singles)}"
        loops.append(
            ParticleLoop(
                "single_values",
                f"Scalars of particles at `z`, shape (2, n, d), that all their pairs share, shape (n, {size}).", ("z",),
                INNER[0], (),
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
    of_guide = ("start", "target", "fraction", "position")
    loops.append(
        ParticleLoop(
            "guide", "Fill `position`, shape (n, d) as all are, with where particles may be after a part of their way.",
            signature(of_guide), "@Kernel", views(of_guide, model), (), ("for i in range(start.shape[0]):",),
            (*made.inputs, *made.body, *made.outputs), (),
        )
    )  # fmt: skip
    return tuple(loops)


def accurate_sum(expression: Expr, model: PairwiseModel, codes: Sequence[str] = ()) -> str:
    """Code of a polynomial of one particle's coordinates: to the last digit where it is a sum of products of two.

    `codes` read the coordinates, by default those of particle i.
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
