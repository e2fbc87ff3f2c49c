"""The order of a scheme, by expanding one step and the exact flow in powers of h.

Both expansions are made for a generic forced, time-dependent system with rational coefficients, in exact arithmetic,
so that agreement and disagreement are proved. The exact flow is expanded by its Lie series.

Where a step is made up of many or has stages that depend on each other the expansion is too long. Then the order is
measured: the error of one step with two short steps, in arithmetic of many digits.

The midpoint rule is the discrete Hamiltonian map of Ld = h L(midpoint), forces included. Source: Marsden and West
(2001), Discrete mechanics and variational integrators, section 2.6.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import mpmath
import sympy
from sympy import Expr, Rational, S, Symbol

from codegen.discretise import schemes
from codegen.discretise.interval import STEP, at_nodes, between, one_step_interval, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Model
from codegen.discretise.schemes.base import Scheme
from codegen.discretise.simulation import phase_functions
from codegen.errors import DegenerateError
from codegen.evidence.checks.base import Context, Finding, does_not_apply
from codegen.evidence.checks.evaluation import Function, function_of, vanishing
from codegen.evidence.checks.one_step import StepEquations, generic_model, jacobians, solved_step, step_equations

_STATE = (Rational(3, 5), Rational(4, 7))
_INSTANT = Rational(1, 3)
_DIGITS = 60
_DIVISIONS = (200, 400)
_EXACT = 0.1
"""By how much a measured order may differ from a whole number."""


def check_consistency(context: Context) -> Iterator[Finding]:
    """Find the first power of h in which one step differs from the flow; the scheme's order is one less."""
    scheme = context.scheme
    if scheme.parts or not scheme.is_chain:
        order, error = measured_order(scheme)
        passed = abs(order - scheme.order) < _EXACT
        detail = f"one step departs from the flow like h^{order + 1:.3f} (error {error:.2g} of a short step)"
        if not passed:
            detail = f"order {scheme.order} is claimed, but {detail}"
        yield Finding("consistency", f"order of {scheme.name}", passed, detail)
        return
    agreement, difference = first_difference(scheme, scheme.order + 1)
    passed = difference != 0 and agreement == scheme.order
    detail = f"one step and the Lie series of the flow agree up to h^{agreement} (exact expansion, generic system)"
    if difference != 0:
        detail += f", and differ by {float(difference):.3g} h^{agreement + 1}"
    if not passed:
        detail = f"order {scheme.order} is claimed, but {detail}"
    yield Finding("consistency", f"order of {scheme.name}", passed, detail)


def measured_order(scheme: Scheme) -> tuple[float, float]:
    """The order of the error of one step by two short lengths, and the smaller of both errors."""
    model = generic_model().with_free_ends
    step = step_equations(model, scheme)
    known = [model.time, *step.lengths, *step.left]
    residual = function_of([*known, *step.unknowns], step.equations)
    jacobian = function_of([*known, *step.unknowns], list(jacobians(step.left, step.unknowns, step.equations)[1]))
    errors = []
    with mpmath.workdps(_DIGITS):
        for divisions in _DIVISIONS:
            found = _state_after(step, residual, jacobian, 1 / mpmath.mpf(divisions))
            errors.append(max(abs(a - b) for a, b in zip(_flow_after(divisions), found, strict=True)))
        return float(mpmath.log(errors[0] / errors[1], 2)) - 1.0, float(errors[1])


def _state_after(step: StepEquations, residual: Function, jacobian: Function, length: mpmath.mpf) -> list[mpmath.mpf]:
    """The state after a step from the generic one, solved part by part."""
    state, instant = [mpmath.mpf(x.p) / x.q for x in _STATE], mpmath.mpf(_INSTANT.p) / _INSTANT.q
    rows = [[mpmath.mpf(str(sympy.N(f, _DIGITS))) for f in row] for row in step.fractions] or [[mpmath.mpf(1)]]
    for row in rows:
        lengths = [length * fraction for fraction in row]
        start = [state[i % len(state)] for i in range(-len(step.unknowns), 0)]
        state = solved_step(residual, jacobian, (instant, *lengths, *state), start)[-len(state) :]
        instant += sum(lengths)
    return state


@cache
def _flow_after(divisions: int) -> list[mpmath.mpf]:
    """The exact flow of the generic system over a fraction of the unit of time, by mpmath's Taylor series."""
    phase = legendre.hamiltonian_form(generic_model().with_free_ends)
    rates = function_of([phase.time, *phase.coordinates, *phase.rates], _vector_field(phase))
    with mpmath.workdps(_DIGITS):
        start = [mpmath.mpf(x.p) / x.q for x in _STATE]
        instant = mpmath.mpf(_INSTANT.p) / _INSTANT.q
        return list(mpmath.odefun(lambda t, z: rates(t, *z), instant, start)(instant + 1 / mpmath.mpf(divisions)))


def first_difference(scheme: Scheme, highest: int) -> tuple[int, Expr]:
    """The last power of h up to which step and flow agree, and the largest coefficient of their difference after it.

    Zero when they agree up to the highest power.
    """
    model = generic_model().with_free_ends
    step = _step_series(model, scheme, highest)
    flow = _flow_series(model, highest)
    for power in range(1, highest + 1):
        differences = [a[power] - b[power] for a, b in zip(step, flow, strict=True)]
        largest = max(differences, key=abs)
        if largest != 0:
            return power - 1, largest
    return highest, S.Zero


def _flow_series(model: Model, highest: int) -> list[list[Expr]]:
    """Taylor coefficients of (q, p)(t + h), from x_{j+1} = [h^j] F(x_0 + x_1 h + ... ) / (j + 1)."""
    phase = legendre.hamiltonian_form(model)
    states = (*phase.coordinates, *phase.rates)
    field = _vector_field(phase)
    series = [[value] for value in _STATE]
    for power in range(highest):
        here = {**_polynomials(states, series), phase.time: _INSTANT + STEP}
        coefficients = [_coefficient(rate.xreplace(here), power) for rate in field]
        for known, value in zip(series, coefficients, strict=True):
            known.append(value / (power + 1))
    return series


def _vector_field(phase: Model) -> list[Expr]:
    slopes = [f - sympy.diff(phase.function, q) for q, f in zip(phase.coordinates, phase.force, strict=True)]
    return [*(sympy.diff(phase.function, p) for p in phase.rates), *slopes]


def _step_series(model: Model, scheme: Scheme, highest: int) -> list[list[Expr]]:
    """Coefficients of the state after one step, one linear system for each power of h."""
    step = step_equations(model, scheme)
    start = dict(zip(step.left, _STATE, strict=True)) | {model.time: _INSTANT}
    equations, unknowns, first = _regularised(model, scheme, step, start)
    matrix = sympy.Matrix(
        [
            [_coefficient(e.diff(y).xreplace(dict(zip(unknowns, first, strict=True))), 0) for y in unknowns]
            for e in equations
        ]
    )
    series = [[value] for value in first]
    for power in range(1, highest + 1):
        here = _polynomials(unknowns, series)
        left_over = sympy.Matrix([_coefficient(e.xreplace(here), power) for e in equations])
        for known, value in zip(series, -matrix.LUsolve(left_over), strict=True):
            known.append(value)
    size = len(step.left)
    if not scheme.variational:
        return series[-size:]
    # The unknown was the mean velocity V, and q_k1 = q_k + h V.
    half = size // 2
    positions = [[q, *velocity[:-1]] for q, velocity in zip(_STATE[:half], series[:half], strict=True)]
    return positions + series[half:]


def _regularised(
    model: Model, scheme: Scheme, step: StepEquations, start: dict[Symbol, Expr]
) -> tuple[list[Expr], list[Symbol], list[Expr]]:
    """Equations that are regular at h = 0, their unknowns, and the values of these at h = 0."""
    if not scheme.variational:
        states = _STATE * (len(step.unknowns) // len(_STATE))
        return [e.xreplace(start) for e in step.equations], list(step.unknowns), list(states)
    half = len(step.left) // 2
    velocities = [Symbol(f"V{i}", real=True) for i in range(half)]
    arrival = {q1: start[q] + STEP * v for q, q1, v in zip(step.left, step.right, velocities, strict=False)}
    equations = [sympy.cancel(e.xreplace(start).xreplace(arrival)) for e in step.equations]
    momentum = dict(zip((*model.coordinates, *legendre.conjugate_symbols(model)), _STATE, strict=True))
    initial = [v.xreplace({**momentum, model.time: _INSTANT}) for v in legendre.velocity_of_momentum(model)]
    return equations, [*velocities, *step.right[half:]], [*initial, *_STATE[half:]]


def _polynomials(symbols: Sequence[Symbol], series: Sequence[Sequence[Expr]]) -> dict[Symbol, Expr]:
    return {
        symbol: sum((c * STEP**i for i, c in enumerate(coefficients)), S.Zero)
        for symbol, coefficients in zip(symbols, series, strict=True)
    }


def _coefficient(expression: Expr, power: int) -> Expr:
    """The coefficient of h^power of a rational function of h that is regular at zero, by long division."""
    numerator, denominator = sympy.fraction(sympy.cancel(sympy.together(expression)))
    above, below = (sympy.Poly(part, STEP).all_coeffs()[::-1] for part in (numerator, denominator))
    quotient: list[Expr] = []
    for n in range(power + 1):
        value = above[n] if n < len(above) else S.Zero
        value -= sum((below[i] * quotient[n - i] for i in range(1, min(n, len(below) - 1) + 1)), S.Zero)
        quotient.append(value / below[0])
    return quotient[power]


def check_midpoint_equivalence(context: Context) -> Iterator[Finding]:
    """Put both discrete Legendre transforms into the implicit midpoint equations, which must then vanish."""
    if context.scheme.name != "midpoint":
        yield does_not_apply("midpoint equivalence", f"the scheme is {context.scheme.name}")
        return
    try:
        found = residuals(context.model)
    except DegenerateError:
        yield does_not_apply("midpoint equivalence", "the Legendre transform is degenerate: there is no Lagrangian")
        return
    for name, left_over in found:
        known = vanishing(left_over)
        passed, detail = bool(known), f"p_k = -D1 Ld - f-, p_k1 = D2 Ld + f+ satisfy it, {known}"
        if not passed:
            detail = f"the discrete Hamiltonian map leaves {sympy.sstr(left_over)[:200]}"
        yield Finding("midpoint equivalence", f"implicit midpoint rule of {name}", passed, detail)


def residuals(model: Model) -> list[tuple[str, Expr]]:
    """Residuals of the midpoint rule under the discrete Hamiltonian map, by coordinate and momentum."""
    model = model.with_free_ends
    if phase_functions(model):
        return _with_velocities(model)
    phase = legendre.hamiltonian_form(model)
    map_ = schemes.METHODS["variational"]["midpoint"]
    rule = schemes.METHODS["hamiltonian"]["midpoint"]
    interval = variational_interval(legendre.lagrangian_form(model), map_)
    left, right = at_nodes(phase.rates, "_k"), at_nodes(phase.rates, "_k1")
    # Halves of sums of momenta are expanded first, where curvature terms cancel.
    momenta = dict(zip((*left, *right), (*interval.left_momentum, *interval.right_momentum), strict=True))
    means = {a / 2 + b / 2: sympy.expand((momenta[a] + momenta[b]) / 2) for a, b in zip(left, right, strict=True)}
    equations = one_step_interval(phase, rule).equations
    names = [symbol.name for symbol in (*phase.coordinates, *phase.rates)]
    return [(name, e.subs(means).xreplace(momenta)) for name, e in zip(names, equations, strict=True)]


def _with_velocities(model: Model) -> list[tuple[str, Expr]]:
    """The same where the Hamiltonian of a large system is not written out.

    The midpoint rule's v = dH/dp and p' = f - dH/dq at the midpoint are p = dL/dv and p' = f + dL/dq at the velocity
    v = (q_k1 - q_k)/h.
    """
    map_ = schemes.METHODS["variational"]["midpoint"]
    interval = variational_interval(model, map_)
    left, right = interval.left_momentum, interval.right_momentum
    ends = list(zip(interval.q.left, interval.q.right, strict=True))
    middle: dict[Symbol, Expr] = dict(zip(model.coordinates, (between(a, b, S.Half) for a, b in ends), strict=True))
    middle |= dict(zip(model.rates, ((b - a) / STEP for a, b in ends), strict=True))
    middle |= dict(zip(model.controls, interval.q.left_controls, strict=True)) | {model.time: model.time + STEP / 2}
    found = []
    for i, (q, v) in enumerate(zip(model.coordinates, model.rates, strict=True)):
        found.append((q.name, (left[i] + right[i]) / 2 - sympy.diff(model.function, v).xreplace(middle)))
        slope = (sympy.diff(model.function, q) + model.force[i]).xreplace(middle)
        found.append((f"p_{q.name}", right[i] - left[i] - STEP * slope))
    return found
