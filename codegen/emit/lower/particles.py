"""Lowering of a problem of particles and its derivatives to a module: loops, constants, description, and record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sympy import Rational, S, Symbol, sstr

from codegen.discretise.particles import PairwiseProgram
from codegen.emit.lower.blocks import BLOCK, GROUP, BlockLoop, gathered_loops, tracer_loops
from codegen.emit.lower.kernels import Line
from codegen.emit.lower.module import Argument, Module, arguments_of, record_fields
from codegen.emit.lower.pairs import STATE, PairLoop, ParticleLoop, pair_loops, particle_loops, views
from codegen.emit.lower.printer import scalar_code
from codegen.emit.pairwise_derivatives import PairDerivatives
from codegen.runtime.record import ConnectRecord, Form, Method, ParticleRecord


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
        record=_record_fields(program, derivatives, [visit.name for visit in (*all_loops, *around)]),
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


def _record_fields(
    program: PairwiseProgram, derivatives: PairDerivatives, loops: Sequence[str]
) -> tuple[tuple[str, str], ...]:
    """Return the fields of the PairProblem with their code; `loops` are the names of the module's loops."""
    kernels = {
        "gradient": "hamiltonian_gradient", "hessian": "hamiltonian_hessian", "products": "hessian_products",
        **{name: name for name in ("momentum_matrix", "slope", "velocity", "domain_margin", "guide")},
        **{name: name for name in ("tracer_velocity", "tracer_gradient")},
    }  # fmt: skip
    made = {*loops, *(("hamiltonian_gradient",) if program.model.parallel else ())}
    coefficients = {"substeps": "SUBSTEPS"} if program.substeps else {"rows": "ROWS", "weights": "WEIGHTS"}
    return tuple(
        {
            **{"metadata": "metadata", "dimension": "DIMENSION", "hamiltonian": "hamiltonian"},
            **{field: name for field, name in kernels.items() if name in made},
            **coefficients,
            **({"blocks": "BLOCKS", "cost_weights": "COST_WEIGHTS"} if program.model.connects else {}),
            **({"quadratic": "True"} if derivatives.quadratic else {}),
            **({"block": "BLOCK"} if program.model.passive else {}),
            **({"abscissa": "ABSCISSA"} if program.method == "action" else {}),
        }.items()
    )


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
    fields = record_fields(model) | {
        "method": Method(program.method), "scheme": program.scheme, "order": program.order, "form": Form.HAMILTONIAN,
        "operations": {v.name: (v.operations_before, v.operations_after) for v in loops}, "left_out": tuple(reasons),
        "own": model.own, "separable": derivatives.separable, "quadratic": derivatives.quadratic,
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
