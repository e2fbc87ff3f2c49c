"""The derived discrete equations, divided by h, tend to the forced equations of motion as h -> 0.

This settles the signs of forces and potentials. The discrete side is what the module was emitted from; the continuous
side is d/dt dL/dv - dL/dq = f + G^T y with constraint forces y along the normals of holonomic constraints, Hamilton's
equations, or x' = f, put together here. Along a smooth motion their difference must vanish like h.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mpmath
import sympy
from sympy import Expr, S, Symbol

from codegen.checks.base import Context, Finding
from codegen.checks.evaluation import DIGITS, function_of, random_points
from codegen.discretise import STEP, at_nodes, repeated
from codegen.model import Model, legendre
from codegen.schemes import Scheme
from codegen.schemes.base import DiscreteLagrangian
from codegen.transcribe.program import ControlProgram
from codegen.transcribe.step_program import StepProgram

_STEPS = (mpmath.mpf(10) ** -20, mpmath.mpf(10) ** -22)
_VANISHED = 1e-15


def check(context: Context) -> Iterator[Finding]:
    """Compare both sides at random states, one finding for each equation."""
    model, program = context.model.with_free_ends, context.program
    forces: list[Symbol] = []
    if program.method == "variational":
        model = legendre.lagrangian_form(model)
        names = [f"equation of motion of {q}" for q in model.coordinates]
        forces = [Symbol(f"constraint_force_{i}", real=True) for i in range(len(model.holonomic))]
        scheme = repeated(context.scheme)[1].discrete_lagrangian()
        share = weight_of_node(scheme)
        discrete = [e / share for e in _nodal(model, node_equations(program), program, forces, scheme)]
        continuous = _euler_lagrange(model, forces)
        rates: list[Symbol] = [*model.rates, *_accelerations(model), *forces]
    else:
        model = legendre.hamiltonian_form(model)
        names = [f"step of {x}" for x in (*model.coordinates, *model.rates)]
        rates = [Symbol(f"rate_{x}", real=True) for x in (*model.coordinates, *model.rates)]
        discrete = _stepwise(model, program, rates, context.scheme)
        continuous = _flow(model, rates)
    free = [parameter.symbol for parameter in model.free_parameters]
    symbols = [*model.coordinates, *model.rates, *rates, *model.controls, *model.parameters, *free, model.time]
    symbols = list(dict.fromkeys(symbols))
    points = random_points(continuous, symbols, model)
    for name, scheme_side, exact in zip(names, discrete, continuous, strict=True):
        at_h, limit = function_of([*symbols, STEP], [scheme_side]), function_of(symbols, [exact])
        gaps = []
        with mpmath.workdps(DIGITS):
            for step in _STEPS:
                differences, sizes = [], []
                for point in points:
                    numbers = [mpmath.mpf(point[symbol]) for symbol in symbols]
                    wanted = limit(*numbers)[0]
                    differences.append(abs(at_h(*numbers, step)[0] / step - wanted))
                    sizes.append(abs(wanted))
                gaps.append(max(differences) / max(sizes))
        passed = gaps[-1] < _VANISHED
        detail = f"divided by h it is the forced equation of motion, up to {float(gaps[-1]):.1g} at h = 1e-22"
        if not passed:
            detail = f"divided by h it differs from the forced equation of motion by {float(gaps[-1]):.2g} as h -> 0"
        yield Finding("discrete equations", name, bool(passed), detail)


def node_equations(program: ControlProgram | StepProgram) -> tuple[list[Expr], list[Expr]]:
    """Halves of a node's discrete Euler-Lagrange equation: -p_k of the interval after it, p_k1 of the one before it.

    In time, also where the program measures it in fractions of a free duration.
    """
    dimension = len(program.model.coordinates)
    if isinstance(program, ControlProgram):
        left = program.left_symbols[dimension : 2 * dimension]
        right = program.right_symbols[dimension : 2 * dimension]
        after, before = ([program.in_time(sympy.diff(program.element, m)) for m in side] for side in (left, right))
        return after, before
    # The last of the step's equations are p - (momentum as a function of both positions).
    momenta = [*program.left_symbols[dimension:], *program.right_symbols[dimension:]]
    equations = program.equations[-len(momenta) :]
    values = [p - equation for p, (_, equation) in zip(momenta, equations, strict=True)]
    return [-value for value in values[:dimension]], values[dimension:]


def constraint_multipliers(program: ControlProgram | StepProgram, suffix: str) -> list[Symbol]:
    """The forces along the normals of holonomic constraints at a node."""
    return list(at_nodes([Symbol(unknown.name) for unknown in program.holonomic_multipliers], suffix))


def weight_of_node(scheme: DiscreteLagrangian) -> Expr:
    """The part of the equation of motion, in units of h, that a node's equation holds; inner points hold the rest.

    It comes from the interval after the node, of which this is the first point, and the one before, of which it is the
    last.
    """

    def basis(own: Expr, c: Expr) -> Expr:
        return sympy.prod([(c - node) / (own - node) for node in scheme.nodes if node != own])

    shares = (basis(own, point.abscissa) * point.weight for point in scheme.points for own in (S.Zero, S.One))
    return sympy.expand(sympy.Add(*shares))


def inner_motion(model: Model, scheme: DiscreteLagrangian, before: bool) -> dict[Symbol, Expr]:
    """Inner points of the interval after a node at time t, or before it, on q(t + s) = q + s v + s^2 a/2."""
    substitution: dict[Symbol, Expr] = {}
    for i, c in enumerate(scheme.nodes[1:-1], start=1):
        s = STEP * (c - 1 if before else c)
        motion = zip(model.coordinates, model.rates, _accelerations(model), strict=True)
        substitution |= {
            site: x + s * w + s**2 * b / 2
            for site, (x, w, b) in zip(at_nodes(model.coordinates, f"_stage{i}"), motion, strict=True)
        }
    return substitution


def _nodal(
    model: Model,
    halves: tuple[list[Expr], list[Expr]],
    program: ControlProgram | StepProgram,
    forces: Sequence[Symbol],
    scheme: DiscreteLagrangian,
) -> list[Expr]:
    """The equations of a node on the motion q(t +- h) = q +- h v + h^2 a/2, with the node at time t."""
    after, before = halves
    q, v, a = model.coordinates, model.rates, _accelerations(model)
    left, right = at_nodes(q, "_k"), at_nodes(q, "_k1")
    earlier = [x - STEP * w + STEP**2 * b / 2 for x, w, b in zip(q, v, a, strict=True)]
    later = [x + STEP * w + STEP**2 * b / 2 for x, w, b in zip(q, v, a, strict=True)]
    controls = constant_controls(program)
    controls |= {
        site: force
        for suffix in ("_k", "_k1")
        for site, force in zip(constraint_multipliers(program, suffix), forces, strict=True)
    }
    going = {**dict(zip(left, q, strict=True)), **dict(zip(right, later, strict=True)), **controls}
    coming = {**dict(zip(left, earlier, strict=True)), **dict(zip(right, q, strict=True)), **controls}
    coming[model.time] = model.time - STEP
    going |= inner_motion(model, scheme, before=False)
    coming |= inner_motion(model, scheme, before=True)
    return [e.xreplace(going) + f.xreplace(coming) for e, f in zip(after, before, strict=True)]


def _euler_lagrange(model: Model, forces: Sequence[Symbol]) -> list[Expr]:
    """L_q - d/dt L_v + f, and the forces of holonomic constraints along their normals."""
    function, q, v, a = model.function, model.coordinates, model.rates, _accelerations(model)
    equations = []
    for x, w, f in zip(q, v, model.force, strict=True):
        momentum = sympy.diff(function, w)
        rate = sympy.diff(momentum, model.time)
        rate += sum(sympy.diff(momentum, y) * z for y, z in zip((*q, *v), (*v, *a), strict=True))
        normal = sum((y * sympy.diff(c, x) for y, c in zip(forces, model.holonomic, strict=True)), sympy.S.Zero)
        equations.append(sympy.diff(function, x) - rate + f + normal)
    return equations


def _stepwise(
    model: Model, program: ControlProgram | StepProgram, rates: Sequence[Symbol], scheme: Scheme
) -> list[Expr]:
    """What leads from the left to the right node on the motion x(t + s h) = x + s h x', for each state.

    That is the sum over the substeps of a chain, else the last of the equations. The substeps of a composition that is
    stepped are made equal.
    """
    states, equal = (*model.coordinates, *model.rates), dict[Symbol, Expr]()
    if isinstance(program, StepProgram):
        lengths, scheme = repeated(scheme)
        equal = {length: STEP / len(lengths) for length in lengths}
        equations = [equation for _, equation in program.equations]
    else:
        equations = [program.in_time(equation) for name, equation in program.equations if name == "0"]
    size, abscissae = len(states), scheme.step().abscissae
    substitution: dict[Symbol, Expr] = constant_controls(program)
    suffixes = ("_k", *(f"_stage{n}" for n in range(1, len(abscissae))), "_k1")
    for suffix, c in zip(suffixes, (S.Zero, *abscissae), strict=True):
        sites = zip(at_nodes(states, suffix), states, rates, strict=True)
        substitution |= {site: x + c * STEP * rate for site, x, rate in sites}
    leading = equations if scheme.is_chain else equations[-size:]
    return [sum(leading[i::size], S.Zero).xreplace(substitution).xreplace(equal) for i in range(size)]


def _flow(model: Model, rates: Sequence[Symbol]) -> list[Expr]:
    """The left sides of q' - dH/dp = 0 and p' + dH/dq - f = 0, or of x' - f(x, u, t) = 0."""
    if model.form == "first-order":
        return [rate - f for rate, f in zip(rates, model.dynamics, strict=True)]
    half = len(model.coordinates)
    first = [rate - sympy.diff(model.function, p) for rate, p in zip(rates[:half], model.rates, strict=True)]
    pairs = zip(rates[half:], model.coordinates, model.force, strict=True)
    return first + [rate + sympy.diff(model.function, q) - f for rate, q, f in pairs]


def _accelerations(model: Model) -> list[Symbol]:
    return [Symbol(f"acceleration_{q}", real=True) for q in model.coordinates]


def constant_controls(program: ControlProgram | StepProgram) -> dict[Symbol, Expr]:
    """Constant controls, wherever they live."""
    return {site: u for u in program.model.controls for site in program.controls_of(u)}
