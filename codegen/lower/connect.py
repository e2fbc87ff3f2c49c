"""PairwiseProgram and its derivatives -> Module: loops over pairs and texts of problems about particles."""

from __future__ import annotations

from dataclasses import dataclass

import sympy
from sympy import Symbol

from codegen.derive.pairwise import PairDerivatives
from codegen.lower.blocks import BlockLoop
from codegen.lower.gathered import GROUP, gathered_loops
from codegen.lower.kernels import Line
from codegen.lower.module import Argument, Module
from codegen.lower.pair_writer import PairLoop
from codegen.lower.pairwise import pair_loops, separable_loops
from codegen.lower.particle_loops import ParticleLoop, particle_loops
from codegen.lower.passive import BLOCK, passive_loops
from codegen.lower.printer import scalar_code
from codegen.transcribe.connect import PairwiseProgram


@dataclass(frozen=True)
class ConnectModule(Module):
    """A module that connects given points by the motion of particles.

    `own` are a particle's own parameters, `method` is the module's; there are `passive_loops` where points are carried.
    """

    particle_loops: tuple[ParticleLoop, ...]
    loops: tuple[PairLoop, ...]
    gathered_loops: tuple[BlockLoop, ...]
    passive_loops: tuple[BlockLoop, ...]
    own: tuple[Argument, ...]
    method: str
    duration: str
    dimension: int


def lower_connect(program: PairwiseProgram, derivatives: PairDerivatives) -> ConnectModule:
    """Write every loop over pairs, and what surrounds it, as strings."""
    model = program.model
    singles, loops = pair_loops(model, derivatives)
    around = particle_loops(model, singles)
    gathered, carried = gathered_loops(model, derivatives), passive_loops(model, derivatives)
    loops = tuple(visit for visit in loops if not gathered or visit.name != "hamiltonian_gradient")
    blocks: tuple[BlockLoop, ...] = (*gathered, *carried)
    return ConnectModule(
        template="connect.py.j2",
        name=model.name,
        title=model.title,
        description=tuple(_description(program, derivatives, (*loops, *blocks))),
        left_out=tuple(_left_out_of_connection(program, derivatives, singles, bool(gathered))),
        metadata=tuple(_metadata(program, derivatives, (*loops, *blocks))),
        constants=(
            *_constants(program, derivatives),
            *([Line("GROUP", str(GROUP), "particles whose derivatives are gathered together")] if gathered else []),
        ),
        kernels=(),
        runtime=(
            *_packed(blocks),
            *_parallel(program),
            *_runtime(program, derivatives, loops, around),
            *_passive_runtime(program, carried),
        ),
        sizes=(("IMPLICIT", int(_implicit(program))), ("QUADRATIC", int(derivatives.quadratic))),
        arguments=tuple(
            Argument(p.name, repr(value)) for p, value in zip(model.parameters, model.defaults, strict=True)
        ),
        steps=model.steps,
        particle_loops=around,
        loops=loops,
        gathered_loops=gathered,
        passive_loops=carried,
        own=tuple(Argument(name, "1.0") for name in model.own),
        method=program.method,
        duration=scalar_code(model.duration),
        dimension=len(model.coordinates),
    )


@dataclass(frozen=True)
class ParticlesModule(Module):
    """A module that follows particles from a start; fields as in ConnectModule, numbers of the default particles."""

    particle_loops: tuple[ParticleLoop, ...]
    loops: tuple[PairLoop, ...]
    own: tuple[Argument, ...]
    duration: str
    dimension: int
    start: tuple[tuple[tuple[float, ...], ...], ...]
    own_values: tuple[tuple[float, ...], ...]


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
    implicit = _implicit(program) and not by_turns
    step = ["pair_separable"] if by_turns else [
        "pair_algebra", "pair_curvature", *_step(program), *(["lu", "pair_implicit"] if implicit else []),
    ]  # fmt: skip
    return ParticlesModule(
        template="particles.py.j2",
        name=model.name,
        title=model.title,
        description=tuple(_description(program, derivatives, loops)),
        left_out=tuple(_left_out_of_motion(program, derivatives, singles, by_turns)),
        metadata=tuple(_metadata_of_motion(program, derivatives, loops)),
        constants=tuple(c for c in _constants(program, derivatives) if c.target not in ("BLOCKS", "COST_WEIGHTS")),
        kernels=(),
        runtime=(*_special(loops, around), *step, "counts", "pair_motion", "motion"),
        sizes=(("IMPLICIT", int(implicit)), ("STATE", 0), ("PARTS", 0)),
        arguments=tuple(
            Argument(p.name, repr(value)) for p, value in zip(model.parameters, model.defaults, strict=True)
        ),
        steps=model.steps,
        particle_loops=around,
        loops=loops,
        own=tuple(Argument(name, "") for name in model.own),
        duration=scalar_code(model.duration),
        dimension=len(model.coordinates),
        start=model.start,
        own_values=model.own_values,
    )


def _left_out_of_motion(
    program: PairwiseProgram, derivatives: PairDerivatives, singles: tuple[str, ...], by_turns: bool
) -> list[str]:
    """What a simulation leaves out; `by_turns` says whether places and momenta are updated in turn."""
    lines = [line for line in _left_out(program, derivatives, singles) if "action" not in line and "H_pp" not in line]
    if not by_turns:
        return lines
    lines = [line for line in lines if "explicit" not in line]
    return [*lines, "Newton's method and second derivatives: H is separable, so that steps are explicit"]


def _metadata_of_motion(
    program: PairwiseProgram, derivatives: PairDerivatives, loops: tuple[PairLoop | BlockLoop, ...]
) -> list[tuple[str, str]]:
    """The metadata of a simulation, which names the coordinates of every particle."""
    model = program.model
    numbers = range(1, len(model.start[0]) + 1)
    dropped = ("adaptive", "points", "coordinates", "rates")
    kept = [entry for entry in _metadata(program, derivatives, loops) if entry[0] not in dropped]
    for key, group in (("coordinates", model.coordinates), ("rates", model.momenta)):
        kept.append((key, repr(tuple(f"{name}_{i}" for i in numbers for name in group))))
    return kept


def _special(loops: tuple[PairLoop, ...], around: tuple[ParticleLoop, ...]) -> tuple[str, ...]:
    """The files of special functions that are called."""
    code = [line.code for visit in loops for line in (*visit.pair, *visit.pair_outputs, *visit.alone)]
    special = any("x_minus_log1p(" in c or "log1p_minus_ratio(" in c for c in code)
    accurate = any("accurate_dot(" in line.code for visit in around for line in visit.lines)
    return (*(["pair_special"] if special else []), *(["pair_accurate"] if accurate else []))


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
        lines.append(Line("SUBSTEPS", f"({table},)", "fraction of the step, place and momentum between its ends"))
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
        lines.append(Line("BLOCK", str(BLOCK), "passive points that are carried together"))
    if program.method == "action":
        lines.append(Line("PLACE", repr(float(program.place)), "where on an interval the action takes H"))
    return lines


def _floats(values: list[sympy.Rational] | tuple[sympy.Rational, ...]) -> str:
    return f"({', '.join(repr(float(v)) for v in values)},)"


def _runtime(
    program: PairwiseProgram,
    derivatives: PairDerivatives,
    loops: tuple[PairLoop, ...],
    around: tuple[ParticleLoop, ...],
) -> tuple[str, ...]:
    files = [*_special(loops, around)]
    files += [
        "lu",
        "pair_algebra",
        "pair_curvature",
        *_step(program),
        *(["pair_implicit"] if _implicit(program) else []),
    ]
    files += ["pair_trajectory", "pair_secant", "pair_shooting", "counts", "tolerances", "pair_case"]
    files += [*(["pair_least_action"] if derivatives.quadratic else []), "pair_ladder"]
    files += ["pair_callbacks", *(["pair_action"] if program.method == "action" else [])]
    return tuple(files)


def _step(program: PairwiseProgram) -> tuple[str, ...]:
    """The files that make a step."""
    return ("pair_moved", "pair_substeps") if program.substeps else ("pair_runge_kutta",)


def _packed(blocks: tuple[BlockLoop, ...]) -> tuple[str, ...]:
    """The file of logarithms without branches, if blocks of points call them."""
    lines = [line for visit in blocks for line in (*visit.body, *visit.outputs)]
    return ("packed_logarithms",) if any("packed_" in line.code for line in lines) else ()


def _parallel(program: PairwiseProgram) -> tuple[str, ...]:
    """The file that has threads share the gradient, if they are to."""
    return ("pair_parallel",) if program.model.parallel else ()


def _passive_runtime(program: PairwiseProgram, carried: tuple[BlockLoop, ...]) -> tuple[str, ...]:
    """The files that carry passive points, if there are kernels for them."""
    step = "passive_substeps" if program.substeps else "passive_runge_kutta"
    return ("passive_newton", step, "passive_flow") if carried else ()


def _implicit(program: PairwiseProgram) -> bool:
    """Whether equations are solved inside a step."""
    return any(a != 0 or b != 0 for _, a, b in program.substeps)


def _left_out(program: PairwiseProgram, derivatives: PairDerivatives, singles: tuple[str, ...]) -> list[str]:
    model = program.model
    out = []
    if not _implicit(program):
        out.append("Newton's method inside a step: the scheme is explicit")
    if derivatives.isotropic:
        out.append("all but one row of H_pp for each particle: it acts on every component alike")
    if not model.domain:
        out.append("a test of the domain: particles may be anywhere")
    if not model.own:
        out.append("own parameters of particles: there are none")
    if not singles:
        out.append("scalars of single particles: the pair term has none")
    if program.method != "action":
        out.append("the action as a minimisation: --method action has it")
    if not derivatives.quadratic and model.task == "connect":
        out.append("first momenta from a path of least action: H is not kinetic energy alone")
    return out


def _left_out_of_connection(
    program: PairwiseProgram, derivatives: PairDerivatives, singles: tuple[str, ...], gathered: bool
) -> list[str]:
    lines = _left_out(program, derivatives, singles)
    if not program.model.passive:
        lines.append("points without momenta that the motion carries along: passive=True has them")
    if gathered and not program.model.parallel:
        lines.append("threads that share the gradient of many particles: parallel=True has them")
    return lines


def _description(
    program: PairwiseProgram, derivatives: PairDerivatives, loops: tuple[PairLoop | BlockLoop, ...]
) -> list[str]:
    model = program.model
    lines = [
        "Particles i = 1 ... n with places q_i and momenta p_i move by the Hamiltonian",
        "",
        "    H = sum_i self(z_i) + sum_{i<j} pair(z_i, z_j)",
        f"    self = {sympy.sstr(model.self_term)}",
        f"    pair = {sympy.sstr(model.pair_term)}",
        "",
    ]
    if model.limit is not None:
        lines += [f"where particles meet, pair tends to {sympy.sstr(model.limit)},"]
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
            scale = "h" if fraction == 1 else f"{sympy.sstr(fraction * Symbol('h'))}"
            lines.append(f"    q_1 = q_0 + {scale} H_p(q, p),  p_1 = p_0 - {scale} H_q(q, p)  at {_between(a, b)}")
    else:
        lines.append("One step by the explicit Runge-Kutta method of the tables ROWS and WEIGHTS.")
    names = {
        "stepping": "q_N(p_0) + sigma^2 p_N(p_0) = target, for the initial momenta p_0",
        "full": "all steps and q_N + sigma^2 p_N = target, for all inner places and all momenta",
        "action": "minimise 2 h sum H such that (q_k+1 - q_k)/h = H_p, whose conditions these steps are",
    }
    if program.model.task == "simulate":
        return lines
    return [*lines, "", f"What is solved ({program.method}): {names[program.method]}."]


def _between(a: sympy.Rational, b: sympy.Rational) -> str:
    words = {sympy.S.Zero: "{0}_0", sympy.S.One: "{0}_1", sympy.Rational(1, 2): "({0}_0 + {0}_1)/2"}
    return f"({words[a].format('q')}, {words[b].format('p')})"


def _metadata(
    program: PairwiseProgram, derivatives: PairDerivatives, loops: tuple[PairLoop | BlockLoop, ...]
) -> list[tuple[str, str]]:
    model = program.model
    return [
        ("task", repr(model.task)),
        ("method", repr(program.method)),
        ("scheme", repr(program.scheme)),
        ("order", repr(program.order)),
        ("form", repr("hamiltonian")),
        ("adaptive", repr(program.adaptive)),
        ("coordinates", repr(model.coordinates)),
        ("rates", repr(model.momenta)),
        ("own", repr(model.own)),
        ("points", repr(model.points)),
        ("separable", repr(derivatives.separable)),
        ("quadratic", repr(derivatives.quadratic)),
        *([("passive", "True")] if model.passive else []),
        *([("unused", repr(model.unused))] if model.unused else []),
        ("operations", repr({v.name: (v.operations_before, v.operations_after) for v in loops})),
    ]
