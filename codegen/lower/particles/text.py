"""What a module about particles says about itself: its equations, what was left out, its record."""

from __future__ import annotations

from collections.abc import Sequence

from sympy import Rational, S, Symbol, sstr

from codegen.derive.pairwise import PairDerivatives
from codegen.lower.module import record_fields
from codegen.lower.particles.blocks import BlockLoop
from codegen.lower.particles.pair_writer import PairLoop
from codegen.runtime.record import ConnectRecord, Form, Method, ParticleRecord
from codegen.transcribe.connect import PairwiseProgram


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
