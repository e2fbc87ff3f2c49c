"""PairwiseProgram and its derivatives -> Module: loops over pairs, tables, and the record of the problem."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sympy import Rational

from codegen.derive.pairwise import PairDerivatives
from codegen.lower.kernels import Line
from codegen.lower.module import Argument, Module, arguments_of
from codegen.lower.particles.blocks import BlockLoop
from codegen.lower.particles.gathered import GROUP, gathered_loops
from codegen.lower.particles.pair_writer import STATE, PairLoop, views
from codegen.lower.particles.pairwise import pair_loops, separable_loops
from codegen.lower.particles.particle_loops import ParticleLoop, particle_loops
from codegen.lower.particles.text import description, left_out, record
from codegen.lower.particles.tracers import BLOCK, tracer_loops
from codegen.lower.printer import scalar_code
from codegen.transcribe.connect import PairwiseProgram


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
