"""PairwiseProgram and its derivatives -> Module: loops over pairs, tables, and the record of the problem.

What a module about particles says about itself: its equations, what was left out, its record.

Derivatives of a pairwise Hamiltonian -> loops over pairs, as strings.

States are arrays z of shape (2, n, d): positions z[0], momenta z[1]. Rows of second derivatives run over z in this
order, z.reshape(2 n d). Every loop visits each pair once and writes to both of its particles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import sympy
from sympy import Expr, Rational, S, Symbol, sstr

from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import PairwiseProgram
from codegen.emit.lower.kernels import Line
from codegen.emit.lower.module import Argument, Module, arguments_of, record_fields
from codegen.emit.lower.particles.pair_second import GROUP, gathered_loops, hessian, hessian_products, momentum_matrix
from codegen.emit.lower.particles.pairs import STATE, BlockLoop, PairLoop, Writer, views
from codegen.emit.lower.particles.single import BLOCK, ParticleLoop, accurate_sum, particle_loops, tracer_loops
from codegen.emit.lower.printer import scalar_code
from codegen.emit.pairwise_derivatives import PairDerivatives
from codegen.runtime.record import ConnectRecord, Form, Method, ParticleRecord


def description(program: PairwiseProgram, loops: Sequence[PairLoop | BlockLoop]) -> list[str]:
    """The Hamiltonian, a step, what is solved, and how many operations loops take."""
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
    lines += [*_equations(program), ""]
    lines += ["Operations of one pair, before and after common subexpressions are shared:", ""]
    lines += [f"    {visit.name}: {visit.operations_before} -> {visit.operations_after}" for visit in loops]
    return lines


def _equations(program: PairwiseProgram) -> list[str]:
    lines = []
    if program.adaptive:
        lines += [
            f"Steps are chosen by scipy's {program.adaptive}; the method below, on N steps, gives Newton's matrix.",
            "",
        ]
    if program.substeps:
        lines += ["One step from z_0 = (q_0, p_0), in substeps that begin where the one before ended:", ""]
        for fraction, a, b in program.substeps:
            scale = "h" if fraction == 1 else f"{sstr(fraction * Symbol('h'))}"
            lines.append(f"    q_1 = q_0 + {scale} H_p(q, p),  p_1 = p_0 - {scale} H_q(q, p)  at {_between(a, b)}")
    else:
        lines.append("One step by the explicit Runge-Kutta method of the tables ROWS and WEIGHTS.")
    names = {
        "stepping": "q_N(p_0) + sigma^2 p_N(p_0) = target, for the initial momenta p_0",
        "full": "all steps and q_N + sigma^2 p_N = target, for all inner positions and all momenta",
        "action": "minimise 2 h sum H such that (q_k+1 - q_k)/h = H_p, whose conditions these steps are",
    }
    if not program.model.connects:
        return lines
    return [*lines, "", f"What is solved ({program.method}): {names[program.method]}."]


def _between(a: Rational, b: Rational) -> str:
    words = {S.Zero: "{0}_0", S.One: "{0}_1", Rational(1, 2): "({0}_0 + {0}_1)/2"}
    return f"({words[a].format('q')}, {words[b].format('p')})"


def left_out(
    program: PairwiseProgram,
    derivatives: PairDerivatives,
    singles: tuple[str, ...],
    *,
    implicit: bool,
    by_turns: bool = False,
    gathered: bool = False,
) -> list[str]:
    """What the module does not hold, and why; `by_turns` says whether positions and momenta are updated in turn."""
    model = program.model
    reasons = (
        (not implicit and not by_turns, "Newton's method inside a step: the scheme is explicit"),
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


def record(
    program: PairwiseProgram,
    derivatives: PairDerivatives,
    loops: Sequence[PairLoop | BlockLoop],
    reasons: Sequence[str],
) -> ParticleRecord:
    """The record of the module; that of a simulation names the coordinates of every particle."""
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


def pair_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[tuple[str, ...], tuple[PairLoop, ...]]:
    """The code of the scalars of single particles, and the loops for H and its derivatives."""
    writer = Writer(model, derivatives)
    singles = tuple(accurate_sum(e, model) for e in writer.singles)
    return singles, (
        _hamiltonian(writer),
        _gradient(writer),
        hessian(writer),
        hessian_products(writer),
        momentum_matrix(writer),
    )


def separable_loops(model: PairwiseModel, derivatives: PairDerivatives) -> tuple[tuple[str, ...], tuple[PairLoop, ...]]:
    """The code of the scalars of single particles, and the loops for H, H_q and H_p of a separable Hamiltonian."""
    writer = Writer(model, derivatives)
    singles = tuple(accurate_sum(e, model) for e in writer.singles)
    return singles, (_hamiltonian(writer), _part(writer, "slope", 0), _part(writer, "velocity", 1))


def _part(writer: Writer, name: str, part: int) -> PairLoop:
    """H_q (part 0) or H_p (part 1) alone."""
    model, size = writer.model, writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    sums = [f"by_{s}" for s in model.first.moving][part * size : (part + 1) * size]
    own = [(target, "=", as_float(value)) for target, value in zip(sums, alone.gradient[part * size :], strict=False)]
    first, second = pair.gradient[part * size :], pair.gradient[(2 + part) * size :]
    both = [(target, "+=", value) for target, value in zip(sums, first, strict=False)]
    both += [(f"rates[j, {a}]", "+=", value) for a, value in enumerate(second[:size])]
    quantity = "H_p" if part else "H_q"
    return writer.loop(
        name, f"Fill `rates`, shape (n, d), with {quantity}.", (*STATE, "rates"),
        writer.lowered(alone, own, alone.slopes),
        writer.lowered(pair, [entry for entry in both if entry[2] != 0], pair.slopes),
        head=[Line("rates[:]", "0.0")],
        after=[Line(f"rates[i, {a}]", target, operator="+=") for a, target in enumerate(sums)],
    )  # fmt: skip


def _hamiltonian(writer: Writer) -> PairLoop:
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    return writer.loop(
        "hamiltonian", "H at a state `z`, shape (2, n, d), of particles with parameters `own`, shape (n, k).", STATE,
        writer.lowered(alone, [("energy", "+=", alone.value)]),
        writer.lowered(pair, [("energy", "+=", pair.value)]),
        head=[Line("energy", "0.0")],
        results=["energy"],
    )  # fmt: skip


def _gradient(writer: Writer) -> PairLoop:
    model, size = writer.model, writer.dimension
    alone, pair = writer.derivatives.alone, writer.derivatives.pair
    sums = [f"by_{s}" for s in model.first.moving]
    own = [(target, "=", as_float(value)) for target, value in zip(sums, alone.gradient, strict=True)]
    both = [(target, "+=", value) for target, value in zip(sums, pair.gradient, strict=False)]
    both += [
        (f"gradient[{k // size}, j, {k % size}]", "+=", value) for k, value in enumerate(pair.gradient[2 * size :])
    ]
    return writer.loop(
        "hamiltonian_gradient", "Fill `gradient`, shape (2, n, d), with H_q and H_p.", (*STATE, "gradient"),
        writer.lowered(alone, own, alone.slopes),
        writer.lowered(pair, [entry for entry in both if entry[2] != 0], pair.slopes),
        head=[Line("gradient[:]", "0.0")],
        after=[Line(f"gradient[{k // size}, i, {k % size}]", name, operator="+=") for k, name in enumerate(sums)],
    )  # fmt: skip


def as_float(value: Expr) -> Expr:
    """A sum that begins with zero begins with a floating-point number."""
    return sympy.Float(0) if value == 0 else value


@dataclass(frozen=True)
class PairwiseModule(Module):
    """A module about particles; `own` are a particle's own parameters.

    `public` are names for users, and `record` the fields of the PairProblem with their code.
    """

    public: tuple[str, ...]
    record: tuple[tuple[str, str], ...]
    particle_loops: tuple[ParticleLoop, ...]
    loops: tuple[PairLoop, ...]
    own: tuple[Argument, ...]
    duration: str
    dimension: int


@dataclass(frozen=True)
class ConnectModule(PairwiseModule):
    """A module that connects given points by the motion of particles; `tracer_loops` carry points along.

    Where threads share the gradient, `threaded` has one group of lines, which make arrays of pointers.
    """

    gathered_loops: tuple[BlockLoop, ...]
    threaded: tuple[tuple[Line, ...], ...]
    tracer_loops: tuple[BlockLoop, ...]


@dataclass(frozen=True)
class ParticlesModule(PairwiseModule):
    """A module that follows particles; `start` and `own_values` are those of the default particles."""

    start: tuple[tuple[tuple[float, ...], ...], ...]
    own_values: tuple[tuple[float, ...], ...]


def lower_connect(program: PairwiseProgram, derivatives: PairDerivatives) -> ConnectModule:
    """Write every loop over pairs, with the tables and texts of its module, as strings."""
    model = program.model
    singles, loops = pair_loops(model, derivatives)
    around = particle_loops(model, singles)
    gathered, carried = gathered_loops(model, derivatives), tracer_loops(model, derivatives)
    loops = tuple(visit for visit in loops if not gathered or visit.name != "hamiltonian_gradient")
    implicit, all_loops = _is_implicit(program), list[PairLoop | BlockLoop]([*loops, *gathered, *carried])
    constants = _constants(program, derivatives)
    if gathered:
        constants.append(Line("GROUP", str(GROUP), "particles whose derivatives are gathered together"))
    return ConnectModule(
        **_common(program, loops, around),
        template="connect.py.j2",
        description=tuple(description(program, all_loops)),
        metadata=record(
            program,
            derivatives,
            all_loops,
            left_out(program, derivatives, singles, implicit=implicit, gathered=bool(gathered)),
        ),
        constants=tuple(constants),
        public=_public(program, derivatives, loops),
        record=_record(program, derivatives, _names(loops, around, gathered, carried)),
        gathered_loops=gathered,
        threaded=(views((*STATE, "gradient"), model),) if model.parallel else (),
        tracer_loops=carried,
        own=tuple(Argument(name, "1.0") for name in model.own),
    )


def lower_particles(program: PairwiseProgram, derivatives: PairDerivatives) -> ParticlesModule:
    """Write the loops over pairs of a simulation as strings; those of second derivatives only if steps are implicit."""
    model = program.model
    by_turns = (
        derivatives.separable
        and bool(program.substeps)
        and all({a, b} <= {0, 1} and a * b == 0 for _, a, b in program.substeps)
    )
    singles, loops = (separable_loops if by_turns else pair_loops)(model, derivatives)
    around = particle_loops(model, singles)
    implicit = _is_implicit(program) and not by_turns
    return ParticlesModule(
        **_common(program, loops, around),
        template="particles.py.j2",
        description=tuple(description(program, loops)),
        metadata=record(
            program, derivatives, loops, left_out(program, derivatives, singles, implicit=implicit, by_turns=by_turns)
        ),
        constants=tuple(c for c in _constants(program, derivatives) if c.target not in ("BLOCKS", "COST_WEIGHTS")),
        public=("OWN", "START", "energy", "make_grid", "metadata", "path_residual", "problem", "solve", "step"),
        record=_record(program, derivatives, _names(loops, around)),
        own=tuple(Argument(name, "") for name in model.own),
        start=model.start,
        own_values=model.own_values,
    )


def _common(program: PairwiseProgram, loops: tuple[PairLoop, ...], around: tuple[ParticleLoop, ...]) -> dict[str, Any]:
    """The fields that are the same for both tasks."""
    model = program.model
    return {
        "name": model.name,
        "title": model.title,
        "kernels": (),
        "sizes": (),
        "arguments": arguments_of(model),
        "steps": model.steps,
        "particle_loops": around,
        "loops": loops,
        "duration": scalar_code(model.duration),
        "dimension": len(model.coordinates),
    }


def _constants(program: PairwiseProgram, derivatives: PairDerivatives) -> list[Line]:
    model = program.model
    size = len(model.coordinates)
    lines = [
        Line("DIMENSION", str(size), f"coordinates of a particle: {', '.join(model.coordinates)}"),
        Line("BLOCKS", "1" if derivatives.isotropic else str(size), "rows of H_pp for each particle"),
    ]
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
        lines.append(Line("WEIGHTS", _floats(program.weights), "weights of the stages"))
        weights = list(program.weights)
    lines.append(Line("COST_WEIGHTS", _floats(weights), "weights of the points in the discrete cost"))
    if model.passive:
        lines.append(Line("BLOCK", str(BLOCK), "tracer points that are carried together"))
    if program.method == "action":
        lines.append(Line("ABSCISSA", repr(float(program.abscissa)), "where on an interval the action takes H"))
    return lines


def _floats(values: Iterable[Rational]) -> str:
    return f"({', '.join(repr(float(v)) for v in values)},)"


def _names(*groups: Sequence[PairLoop] | Sequence[ParticleLoop] | Sequence[BlockLoop]) -> list[str]:
    """The names of loops."""
    return [visit.name for group in groups for visit in group]


def _public(program: PairwiseProgram, derivatives: PairDerivatives, loops: Sequence[PairLoop]) -> tuple[str, ...]:
    """Names for users of a module that connects points."""
    names = (
        "Linearised all_equations all_equations_jacobian all_states domain_margin end_residual first_momenta "
        "first_unknowns guessed_path jacobian make_case metadata momenta_of path_cost path_errors path_of "
        "preconditioner problem residual solve solve_case trajectory hamiltonian_gradient"
    )
    if derivatives.quadratic:
        names += " misses_by_far momenta_of_least_action penalised"
    if program.method == "action":
        names += (
            " action_constraints action_cost action_cost_gradient action_hessian action_jacobian action_path"
            " action_start"
        )
    if program.model.passive:
        names += " carry stages_of"
    return tuple(sorted({*names.split(), *(visit.name for visit in loops)}))


def _record(
    program: PairwiseProgram, derivatives: PairDerivatives, loops: Sequence[str]
) -> tuple[tuple[str, str], ...]:
    """The fields of the PairProblem with their code; `loops` are the names of those that there are."""
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


def _is_implicit(program: PairwiseProgram) -> bool:
    """Whether equations are solved inside a step."""
    return any(a != 0 or b != 0 for _, a, b in program.substeps)
