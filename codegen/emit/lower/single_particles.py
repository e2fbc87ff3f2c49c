"""What concerns single particles -> loops over particles: their scalars, the domain, the guessed way.

Velocities of points without momenta -> loops over particles and, inside them, over blocks of points.

A point that lies on a particle has the limit of the velocity there. Its derivative as well where the kernel is smooth;
where that has a kink, as in space, the mean of the derivatives on both sides.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.model.pairwise import FRACTION, PairwiseModel
from codegen.emit.lower.kernels import INNER, Line, Output, kernel
from codegen.emit.lower.pairs import STATE, BlockLoop, Writer, entry, packed, signature, views
from codegen.emit.lower.printer import scalar_code
from codegen.emit.pairwise_derivatives import PairDerivatives, TracerDerivatives, tracer_derivatives


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


BLOCK = 128
"""Points of a block: all that is known about them stays in the cache nearest to the processor."""


def tracer_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[BlockLoop, ...]:
    """The velocity of tracer points; and the velocity with its derivative by their positions. None if not asked for."""
    if not model.passive:
        return ()
    tracers, size = tracer_derivatives(model, derivatives), len(model.coordinates)
    writer = Writer(model, derivatives)
    velocity = [(_entry("rates", a), value) for a, value in enumerate(tracers.velocity)]
    gradient = [(_entry("gradients", k), value) for k, value in enumerate(tracers.gradient)]
    shapes = f"`rates`, shape ({size}*BLOCK,), with the velocities of tracer points at `positions`"
    return (
        _loop(writer, tracers, "tracer_velocity", f"Fill {shapes}.", ("rates",), velocity),
        _loop(
            writer, tracers, "tracer_gradient",
            f"Fill `rates` as `tracer_velocity`, and `gradients`, shape ({size**2}*BLOCK,), with their derivatives.",
            ("rates", "gradients"), [*velocity, *gradient],
        ),
    )  # fmt: skip


def _loop(
    writer: Writer,
    tracers: TracerDerivatives,
    name: str,
    summary: str,
    filled: tuple[str, ...],
    outputs: Sequence[tuple[str, Expr]],
) -> BlockLoop:
    model = writer.model
    reads = {s: _entry("positions", a) for a, s in enumerate(model.first.q)}
    own = {s: _of_point(code) for s, code in writer.single_codes.items()}
    pair_scalars = {s for s, _ in writer.derivatives.pair.scalars}
    reads |= writer.codes("j") | {s: code for s, code in own.items() if s in pair_scalars}
    made = writer.summed(tracers.assignments, reads, outputs, own)
    codes = [_entry("positions", a) for a in range(len(model.coordinates))]
    sums = [accurate_sum(e, model, codes) for e in writer.singles]
    scalars = {code: _entry("scalars", k) for k, code in enumerate(sums)}
    lengths = f"{len(sums)}*BLOCK" if len(sums) > 1 else "BLOCK"
    singles = [Line("singles", "single_values(z)"), Line("scalars", f"np.empty({lengths})")] if sums else []
    positive = [scalars.get(code, code) for code in (accurate_sum(e, model, codes) for e in model.domain)]
    margin = positive[0] if len(positive) == 1 else f"min({', '.join(positive)})"
    return BlockLoop(
        name=name,
        summary=summary,
        arguments=signature(("positions", *STATE, *filled)),
        decorator="@Contracted",
        views=views(STATE, model),
        head=(*singles, *(line for line in made.inputs if line.code.startswith("parameters["))),
        before=(
            *(Line(target, code) for code, target in scalars.items()),
            *(Line(target, "0.0") for target, _ in outputs),
        ),
        inputs=tuple(line for line in made.inputs if re.search(r"\bj\b", line.code)),
        point_inputs=tuple(line for line in made.inputs if re.search(r"\bm\]", line.code)),
        body=tuple(map(packed, made.body)),
        outputs=tuple(map(packed, made.outputs)),
        over_points=("for m in range(BLOCK):",) if model.domain else (),
        after=tuple(Line(target, f"{target} if {margin} > 0.0 else 0.0") for target, _ in outputs if model.domain),
        operations_before=made.operations_before,
        operations_after=made.operations_after,
    )  # fmt: skip


def _entry(array: str, row: int) -> str:
    return entry(array, row, "BLOCK")


def _of_point(code: str) -> str:
    """The code of a scalar of a single particle, where particle i is a point of a block."""
    return re.sub(r"singles\[i, (\d+)\]", lambda found: _entry("scalars", int(found[1])), code)
