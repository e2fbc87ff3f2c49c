"""Velocities of points without momenta -> loops over particles and, inside them, over blocks of points.

A point that lies on a particle has the limit of the velocity there. Its derivative as well where the kernel is smooth;
where that has a kink, as in space, the mean of the derivatives on both sides.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from sympy import Expr

from codegen.derive.pairwise import PairDerivatives, TracerDerivatives, tracer_derivatives
from codegen.lower.kernels import Line
from codegen.lower.particles.blocks import BlockLoop, entry, packed
from codegen.lower.particles.pair_writer import STATE, Writer, signature, views
from codegen.lower.particles.particle_loops import accurate_sum
from codegen.model.pairwise import PairwiseModel

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
