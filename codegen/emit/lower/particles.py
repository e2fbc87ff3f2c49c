"""Lowering of a problem of particles and its derivatives to a module: loops, constants, description, and record.

Two kinds of loops sum over all particles for blocks of points: the gathered gradient of H, and the velocities of tracer
points. Arrays of a block store one quantity of all points of the block, then the next quantity. The inner loop over
points reads adjacent memory and calls no function with branches, so that a compiler can vectorise the loop.

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
from sympy import Expr, Rational, S, Symbol, sstr

from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import PairwiseProgram
from codegen.emit.lower.kernels import Kernel, Line
from codegen.emit.lower.module import Argument, Module, arguments_of, record_fields
from codegen.emit.lower.pairs import (
    STATE,
    PairLoop,
    ParticleLoop,
    Writer,
    accurate_sum,
    pair_loops,
    particle_loops,
    signature,
    views,
)
from codegen.emit.lower.printer import scalar_code
from codegen.emit.pairwise_derivatives import PairDerivatives, TracerDerivatives, tracer_derivatives
from codegen.errors import ExpressionError
from codegen.runtime.record import ConnectRecord, Form, ParticleRecord


@dataclass(frozen=True)
class ParticlesModule(Module):
    """A module that moves particles; `own` are the parameters of each particle.

    `public` are the public names, and `record` the fields of the PairProblem with their code. If threads share the
    gradient, `threaded` has one group of lines, which make arrays from pointers. `tracer_loops` move tracer points.
    `start` (2, n, d) and `own_values` are the default particles of a simulation.
    """

    public: tuple[str, ...]
    record: tuple[tuple[str, str], ...]
    particle_loops: tuple[ParticleLoop, ...]
    loops: tuple[PairLoop, ...]
    gathered_loops: tuple[BlockLoop, ...]
    threaded: tuple[tuple[Line, ...], ...]
    tracer_loops: tuple[BlockLoop, ...]
    own: tuple[Argument, ...]
    duration: str
    dimension: int
    start: tuple[tuple[tuple[float, ...], ...], ...]
    own_values: tuple[tuple[float, ...], ...]


_PUBLIC = (
    "Linearised all_equations all_equations_jacobian all_states domain_margin end_residual first_momenta "
    "first_unknowns guessed_path jacobian make_case metadata momenta_of path_cost path_errors path_of preconditioner "
    "problem residual solve solve_case trajectory hamiltonian_gradient"
).split()
"""Public names of a module that connects points."""
_LEAST_ACTION = ("misses_by_far", "momenta_of_least_action", "penalised")
"""Further public names if H is kinetic energy alone."""
_ACTION = "constraints cost cost_gradient hessian jacobian path start".split()
"""Further public names for the method "action", without their prefix `action_`."""


def lower_particles(program: PairwiseProgram, derivatives: PairDerivatives) -> ParticlesModule:
    """Return the module of a particle problem as strings; explicit simulations need no second derivatives."""
    model, connects = program.model, program.model.connects
    by_turns = (
        not connects
        and derivatives.separable
        and bool(program.substeps)
        and all({a, b} <= {0, 1} and a * b == 0 for _, a, b in program.substeps)
    )
    singles, loops = pair_loops(model, derivatives, by_turns)
    gathered = gathered_loops(model, derivatives) if connects else ()
    tracers = tracer_loops(model, derivatives) if connects else ()
    if gathered:
        loops = tuple(visit for visit in loops if visit.name != "hamiltonian_gradient")
    around, all_loops = particle_loops(model, singles), list[PairLoop | BlockLoop]([*loops, *gathered, *tracers])
    constants = _constants(program, derivatives)
    constants += [Line("GROUP", str(GROUP), "particles whose derivatives are gathered together")] if gathered else []
    public = ["OWN", "START", "energy", "make_grid", "metadata", "path_residual", "problem", "solve", "step"]
    if connects:
        public = [*_PUBLIC, *(visit.name for visit in loops), *(_LEAST_ACTION if derivatives.quadratic else ())]
        public += [f"action_{name}" for name in _ACTION if program.method == "action"]
        public += ["carry", "stages_of"] if model.passive else []
    reasons = _left_out(program, derivatives, singles, by_turns=by_turns, gathered=bool(gathered))
    kernels = {
        "gradient": "hamiltonian_gradient", "hessian": "hamiltonian_hessian", "products": "hessian_products",
        **{name: name for name in ("momentum_matrix", "slope", "velocity", "domain_margin", "guide")},
        **{name: name for name in ("tracer_velocity", "tracer_gradient")},
    }  # fmt: skip
    made = {
        *[visit.name for visit in (*all_loops, *around)],
        *(("hamiltonian_gradient",) if program.model.parallel else ()),
    }
    coefficients = {"substeps": "SUBSTEPS"} if program.substeps else {"rows": "ROWS", "weights": "WEIGHTS"}
    return ParticlesModule(
        template="connect.py.j2" if connects else "particles.py.j2",
        name=model.name,
        title=model.title,
        description=tuple(_description(program, all_loops)),
        metadata=_record(program, derivatives, all_loops, reasons),
        constants=tuple(c for c in constants if connects or c.target not in ("BLOCKS", "COST_WEIGHTS")),
        kernels=(),
        sizes=(),
        arguments=arguments_of(model),
        steps=model.steps,
        public=tuple(sorted(set(public))),
        record=tuple(
            {
                **{"metadata": "metadata", "dimension": "DIMENSION", "hamiltonian": "hamiltonian"},
                **{field: name for field, name in kernels.items() if name in made},
                **coefficients,
                **({"blocks": "BLOCKS", "cost_weights": "COST_WEIGHTS"} if program.model.connects else {}),
                **({"quadratic": "True"} if derivatives.quadratic else {}),
                **({"block": "BLOCK"} if program.model.passive else {}),
                **({"abscissa": "ABSCISSA"} if program.method == "action" else {}),
            }.items()
        ),
        particle_loops=around,
        loops=loops,
        gathered_loops=gathered,
        threaded=(views((*STATE, "gradient"), model),) if model.parallel else (),
        tracer_loops=tracers,
        own=tuple(Argument(name, "1.0" if connects else "") for name in model.own),
        duration=scalar_code(model.duration),
        dimension=len(model.coordinates),
        start=model.start,
        own_values=model.own_values,
    )


def _constants(program: PairwiseProgram, derivatives: PairDerivatives) -> list[Line]:
    model = program.model
    size = len(model.coordinates)
    lines = [
        Line("DIMENSION", str(size), f"coordinates of a particle: {', '.join(model.coordinates)}"),
        Line("BLOCKS", "1" if derivatives.isotropic else str(size), "rows of H_pp for each particle"),
    ]

    def floats(values: Sequence[Rational]) -> str:
        return f"({', '.join(repr(float(v)) for v in values)},)"

    if (model.smooth or model.passive) and derivatives.pair.distances:
        lines.append(Line("CLOSEST", "1e-300", "squared distances below this count as zero"))
    if program.substeps:
        table = ", ".join(f"({', '.join(repr(float(v)) for v in row)})" for row in program.substeps)
        lines.append(Line("POINTS", str(len(program.substeps)), "points of a step at which H is evaluated"))
        lines.append(Line("SUBSTEPS", f"({table},)", "fraction of the step, position and momentum between its ends"))
        weights = [fraction for fraction, _, _ in program.substeps]
    else:
        count = len(program.weights)
        rows = [[*(float(v) for v in row), *[0.0] * (count - len(row))] for row in program.rows]
        lines.append(Line("POINTS", str(count), "stages of a step, at which H is evaluated"))
        lines.append(Line("ROWS", f"({', '.join(str(tuple(row)) for row in rows)})", "coefficients of the stages"))
        lines.append(Line("WEIGHTS", floats(program.weights), "weights of the stages"))
        weights = list(program.weights)
    lines.append(Line("COST_WEIGHTS", floats(weights), "weights of the points in the discrete cost"))
    if model.passive:
        lines.append(Line("BLOCK", str(BLOCK), "tracer points that are carried together"))
    if program.method == "action":
        lines.append(Line("ABSCISSA", repr(float(program.abscissa)), "where on an interval the action takes H"))
    return lines


def _description(program: PairwiseProgram, loops: Sequence[PairLoop | BlockLoop]) -> list[str]:
    """Return the Hamiltonian, the equations of a step, the solved equations, and the operation counts of loops."""
    model = program.model
    lines = [
        "Particles i = 1 ... n with positions q_i and momenta p_i move by the Hamiltonian",
        "",
        "    H = sum_i self(z_i) + sum_{i<j} pair(z_i, z_j)",
        f"    self = {sstr(model.self_term)}",
        f"    pair = {sstr(model.pair_term)}",
        "",
    ]
    if model.limit is not None:
        lines += [f"where particles meet, pair tends to {sstr(model.limit)},"]
        lines += [
            "and so does its gradient; its kernels attain both limits."
            if model.smooth
            else "but its gradient has no limit.",
            "",
        ]
    if program.adaptive:
        lines += [
            f"Steps are chosen by scipy's {program.adaptive}; the method below, on N steps, gives Newton's matrix.",
            "",
        ]
    if program.substeps:
        words = {S.Zero: "{0}_0", S.One: "{0}_1", Rational(1, 2): "({0}_0 + {0}_1)/2"}
        lines += ["One step from z_0 = (q_0, p_0), in substeps that begin where the one before ended:", ""]
        for fraction, a, b in program.substeps:
            scale = "h" if fraction == 1 else f"{sstr(fraction * Symbol('h'))}"
            point = f"({words[a].format('q')}, {words[b].format('p')})"
            lines.append(f"    q_1 = q_0 + {scale} H_p(q, p),  p_1 = p_0 - {scale} H_q(q, p)  at {point}")
    else:
        lines.append("One step by the explicit Runge-Kutta method of the tables ROWS and WEIGHTS.")
    if model.connects:
        solved = {
            "stepping": "q_N(p_0) + sigma^2 p_N(p_0) = target, for the initial momenta p_0",
            "full": "all steps and q_N + sigma^2 p_N = target, for all inner positions and all momenta",
            "action": "minimise 2 h sum H such that (q_k+1 - q_k)/h = H_p, whose conditions these steps are",
        }
        lines += ["", f"Equations ({program.method}): {solved[program.method]}."]
    lines += ["", "Operations of one pair, before and after common subexpressions are shared:", ""]
    return [*lines, *(f"    {visit.name}: {visit.operations_before} -> {visit.operations_after}" for visit in loops)]


def _left_out(
    program: PairwiseProgram,
    derivatives: PairDerivatives,
    singles: tuple[str, ...],
    *,
    by_turns: bool,
    gathered: bool,
) -> list[str]:
    """Return the features that the module lacks, each with the reason; steps `by_turns` update q and p alternately."""
    model, is_implicit = program.model, any(a != 0 or b != 0 for _, a, b in program.substeps)
    reasons = (
        (not is_implicit and not by_turns, "Newton's method inside a step: the scheme is explicit"),
        (
            model.connects and derivatives.isotropic,
            "all but one row of H_pp for each particle: it acts on every component alike",
        ),
        (not model.domain, "a test of the domain: particles may be anywhere"),
        (not model.own, "own parameters of particles: there are none"),
        (not singles, "scalars of single particles: the pair term has none"),
        (model.connects and program.method != "action", "the action as a minimisation: --method action has it"),
        (
            model.connects and not derivatives.quadratic,
            "first momenta from a path of least action: H is not kinetic energy alone",
        ),
        (
            model.connects and not model.passive,
            "points without momenta that the motion carries along: passive=True has them",
        ),
        (
            gathered and not model.parallel,
            "threads that share the gradient of many particles: parallel=True has them",
        ),
        (by_turns, "Newton's method and second derivatives: H is separable, so that steps are explicit"),
    )
    return [reason for lacks, reason in reasons if lacks]


def _record(
    program: PairwiseProgram,
    derivatives: PairDerivatives,
    loops: Sequence[PairLoop | BlockLoop],
    reasons: Sequence[str],
) -> ParticleRecord:
    """Return the module's metadata record; for a simulation, it names the coordinates of every particle."""
    model = program.model
    fields = record_fields(program, program.order, loops, reasons) | {
        "form": Form.HAMILTONIAN, "own": model.own,
        "separable": derivatives.separable, "quadratic": derivatives.quadratic,
    }  # fmt: skip
    if model.connects:
        return ConnectRecord(
            **fields, coordinates=model.coordinates, rates=model.momenta, adaptive=program.adaptive,
            points=model.points, passive=model.passive,
        )  # fmt: skip
    numbers = range(1, len(model.start[0]) + 1)
    groups = (model.coordinates, model.momenta)
    coordinates, momenta = (tuple(f"{name}_{i}" for i in numbers for name in group) for group in groups)
    return ParticleRecord(**fields, coordinates=coordinates, rates=momenta)


# Sums for blocks of points

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
    """Return the loop that gathers the gradient of each particle, or an empty tuple for a model without such a loop.

    The loop exists if a particle acts on itself as on others, and if the limit there is smooth. Raise ExpressionError
    if a parallel model has no such loop.
    """
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
