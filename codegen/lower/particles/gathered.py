"""The gradient of H where particles act on themselves as they act on others -> a loop that gathers it for blocks.

Where self_term is half the limit of the pair term at coincidence, H_q and H_p of a particle i are sums of one
expression over all particles j, particle i among them. To gather them takes twice as many evaluations as to visit each
pair once, but each evaluation writes to particle i alone, so that several particles are worked on at once.
"""

from __future__ import annotations

import re
from dataclasses import replace

import sympy

from codegen.derive.pairwise import PairDerivatives
from codegen.errors import ExpressionError
from codegen.lower.kernels import Line
from codegen.lower.particles.blocks import BlockLoop, entry, packed
from codegen.lower.particles.pair_writer import STATE, Writer, signature, views
from codegen.model.pairwise import PairwiseModel

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
