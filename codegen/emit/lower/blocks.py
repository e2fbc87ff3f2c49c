"""Sums over all particles for blocks of points: the gathered gradient of H, and velocities of tracer points.

Arrays of a block store one quantity of all points of the block, then the next quantity. The inner loop over points
reads adjacent memory and calls no function with branches, so that a compiler can vectorise the loop.

If self_term is half the limit of the pair term at coincidence, H_q and H_p of particle i are sums of one expression
over all particles j, particle i included. Gathering these sums for each particle takes twice as many evaluations as
visiting each pair once. But each evaluation writes to particle i alone, so that several particles run at once.

A tracer point moves with the flow of the particles. On a particle, it has the limit of the velocity there. For a smooth
pair term it also has the limit of the derivative. For a pair term with a kink, as in three-dimensional space, it has
the mean of the derivatives on both sides.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr

from codegen.discretise.model.pairwise import PairwiseModel
from codegen.emit.lower.kernels import Kernel, Line
from codegen.emit.lower.pairs import STATE, Writer, accurate_sum, signature, views
from codegen.emit.pairwise_derivatives import PairDerivatives, TracerDerivatives, tracer_derivatives
from codegen.errors import ExpressionError

GROUP = 64
"""Number of particles in a block of the gathered gradient."""
BLOCK = 128
"""Number of tracer points in a block, whose quantities all fit in the first-level cache of the processor."""
_REMEDY = "leave parallel out: this gradient visits each pair once, which threads cannot share"


@dataclass(frozen=True)
class BlockLoop:
    """A function that sums the contributions of all particles j to each point m of a block, as groups of lines.

    `views` make arrays from pointers. `head` comes first. Each block has `before` for each point m; `inputs` for each
    particle j, then for each m `point_inputs`, `body` and `outputs`; then `after` for each m. `over_points` is the code
    of this last loop, if it is optional. Blocks divide the points from `begin` to `end`, which are code.
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


def gathered_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[BlockLoop, ...]:
    """Return the gathered gradient loop if one without branches exists; raise ExpressionError if threads need it."""
    acts_on_itself = False
    if model.limit is not None and model.smooth:
        own = dict(zip((*model.second.p, *model.second.own), (*model.first.p, *model.first.own), strict=True))
        acts_on_itself = sympy.expand(model.limit.xreplace(own) / 2 - model.self_term) == 0
    if not acts_on_itself:
        if model.parallel:
            raise ExpressionError("parallel=True, but particles do not act on themselves as on others", _REMEDY)
        return ()
    writer = Writer(model, derivatives)
    pair, size = writer.derivatives.pair, writer.dimension
    scalars = {s: code for s, code in writer.single_codes.items() if s in dict(pair.scalars)}
    codes = [*writer.codes("i").values(), *(f"singles[i, {k}]" for k in range(len(writer.singles)))]
    rows = {code: _entry("state", row, "GROUP") for row, code in enumerate(codes)}
    outputs = [(_entry("sums", row, "GROUP"), value) for row, value in enumerate(pair.gradient[: 2 * size])]
    reads = {s: rows.get(code, code) for s, code in {**writer.codes("i"), **writer.codes("j"), **scalars}.items()}
    made = writer.summed((*pair.differences, *pair.scalars, *pair.slopes), reads, outputs, scalars)
    used = {line.code for line in made.inputs}
    gradient = BlockLoop(
        name="hamiltonian_gradient",
        summary="Fill `gradient`, shape (2, n, d), with H_q and H_p.",
        arguments=signature((*STATE, "gradient")),
        decorator="@Contracted",
        views=views((*STATE, "gradient"), writer.model),
        head=(
            *([Line("singles", "single_values(z)")] if writer.singles else []),
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
        body=_packed(made.body),
        outputs=_packed(made.outputs),
        after=tuple(
            Line(f"gradient[{k // size}, first + m, {k % size}]", target) for k, (target, _) in enumerate(outputs)
        ),
        operations_before=made.operations_before,
        operations_after=made.operations_after,
    )
    called = {name for line in (*gradient.body, *gradient.outputs) for name in re.findall(r"math\.(\w+)\(", line.code)}
    if not called <= {"sqrt"}:
        if model.parallel:
            names = " and ".join(sorted(called - {"sqrt"}))
            raise ExpressionError(f"parallel=True, but the gradient calls {names}", _REMEDY)
        return ()
    if not model.parallel:
        return (gradient,)
    return (
        replace(
            gradient,
            name="gradient_of_some",
            summary="Fill `gradient`, shape (2, n, d), with H_q and H_p of particles from `begin` to `end`.",
            arguments=(*STATE, "begin", "end", "gradient"),
            decorator='@njit(error_model="numpy", fastmath={"contract"})',
            views=(),
            begin="begin",
            end="end",
        ),
    )


def tracer_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[BlockLoop, ...]:
    """Return the loops for the velocity of tracer points, and for velocity and gradient; none without tracer points."""
    if not model.passive:
        return ()
    tracers, size = tracer_derivatives(model, derivatives), len(model.coordinates)
    writer = Writer(model, derivatives)
    velocity = [(_entry("rates", a), value) for a, value in enumerate(tracers.velocity)]
    gradient = [(_entry("gradients", k), value) for k, value in enumerate(tracers.gradient)]
    shapes = f"`rates`, shape ({size}*BLOCK,), with the velocities of tracer points at `positions`"
    return (
        _tracer_loop(writer, tracers, "tracer_velocity", f"Fill {shapes}.", ("rates",), velocity),
        _tracer_loop(
            writer, tracers, "tracer_gradient",
            f"Fill `rates` as `tracer_velocity`, and `gradients`, shape ({size**2}*BLOCK,), with their derivatives.",
            ("rates", "gradients"), [*velocity, *gradient],
        ),
    )  # fmt: skip


def _tracer_loop(
    writer: Writer,
    tracers: TracerDerivatives,
    name: str,
    summary: str,
    filled: tuple[str, ...],
    outputs: Sequence[tuple[str, Expr]],
) -> BlockLoop:
    model = writer.model
    reads = {s: _entry("positions", a) for a, s in enumerate(model.first.q)}
    # Point m of a block takes the role of particle i.
    singles = {
        s: re.sub(r"singles\[i, (\d+)\]", lambda match: _entry("scalars", int(match[1])), code)
        for s, code in writer.single_codes.items()
    }
    pair_scalars = {s for s, _ in writer.derivatives.pair.scalars}
    reads |= writer.codes("j") | {s: code for s, code in singles.items() if s in pair_scalars}
    made: Kernel = writer.summed(tracers.assignments, reads, outputs, singles)
    codes = [_entry("positions", a) for a in range(len(model.coordinates))]
    sums = [accurate_sum(e, model, codes) for e in writer.singles]
    scalars = {code: _entry("scalars", k) for k, code in enumerate(sums)}
    lengths = f"{len(sums)}*BLOCK" if len(sums) > 1 else "BLOCK"
    arrays = [Line("singles", "single_values(z)"), Line("scalars", f"np.empty({lengths})")] if sums else []
    positive = [scalars.get(code, code) for code in (accurate_sum(e, model, codes) for e in model.domain)]
    margin = positive[0] if len(positive) == 1 else f"min({', '.join(positive)})"
    return BlockLoop(
        name=name,
        summary=summary,
        arguments=signature(("positions", *STATE, *filled)),
        decorator="@Contracted",
        views=views(STATE, model),
        head=(*arrays, *(line for line in made.inputs if line.code.startswith("parameters["))),
        before=(
            *(Line(target, code) for code, target in scalars.items()),
            *(Line(target, "0.0") for target, _ in outputs),
        ),
        inputs=tuple(line for line in made.inputs if re.search(r"\bj\b", line.code)),
        point_inputs=tuple(line for line in made.inputs if re.search(r"\bm\]", line.code)),
        body=_packed(made.body),
        outputs=_packed(made.outputs),
        over_points=("for m in range(BLOCK):",) if model.domain else (),
        after=tuple(Line(target, f"{target} if {margin} > 0.0 else 0.0") for target, _ in outputs if model.domain),
        operations_before=made.operations_before,
        operations_after=made.operations_after,
    )


def _entry(array: str, row: int, block: str = "BLOCK") -> str:
    """Return code that reads quantity number `row` of point m; constant `block` is the number of points of a block."""
    offset = "" if row == 0 else f"{block} + " if row == 1 else f"{row}*{block} + "
    return f"{array}[{offset}m]"


def _packed(lines: Sequence[Line]) -> tuple[Line, ...]:
    """Return lines with branch-free logarithms instead of the C library's logarithms."""
    functions = r"\b(?:math\.)?(log1p|x_minus_log1p|log1p_minus_ratio)\("
    return tuple(replace(line, code=re.sub(functions, r"packed_\1(", line.code)) for line in lines)
