"""The equations of one step of any scheme in phase space, and the derivative of the map that they define.

The determinant of the one-step map of every scheme, for a system with one degree of freedom. By implicit
differentiation of the equations of a step: with E(z0, y) = 0, y the unknowns, Dy = -(dE/dy)^-1 dE/dz0. Source: Hairer,
Lubich and Wanner (2006), Geometric numerical integration, section VI.2.

Discrete Noether theorem: a cyclic coordinate's discrete momentum is conserved where no force acts on it. Source:
Marsden and West (2001), section 1.3.3. For a translation of q_i the infinitesimal symmetry of Ld is D1 Ld + D2 Ld = 0
in that component, which is p_k = p_k1.

Symplecticity of the one-step map: S^T J S = J for its derivative S, or a violation where it is not claimed. With dE/dz0
= A and dE/dz1 = B in the equations E(z0, z1) = 0 of a step, S = -B^-1 A, and the identity is equivalent to A J A^T = B
J B^T, which holds no inverse and is decided symbolically where it can be. Source: Hairer, Lubich and Wanner (2006),
Geometric numerical integration, section VI.2.

The order of a scheme, by expanding one step and the exact flow in powers of h.

Both expansions are made for a generic forced, time-dependent system with rational coefficients, in exact arithmetic,
so that agreement and disagreement are proved. The exact flow is expanded by its Lie series.

Where a step is made up of many or has stages that depend on each other the expansion is too long. Then the order is
measured: the error of one step with two short steps, in arithmetic of many digits.

The midpoint rule is the discrete Hamiltonian map of Ld = h L(midpoint), forces included. Source: Marsden and West
(2001), Discrete mechanics and variational integrators, section 2.6.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import mpmath
import sympy
from sympy import Expr, Matrix, Rational, S, Symbol

from codegen.discretise import schemes
from codegen.discretise.interval import STEP, at_nodes, between, one_step_interval, repeated, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.phases import normalise
from codegen.discretise.schemes import METHODS
from codegen.discretise.schemes.base import Scheme, Tableau
from codegen.discretise.simulation import phase_functions
from codegen.errors import DegenerateError, NumericsError
from codegen.evidence.checks.base import (
    Context,
    Finding,
    Function,
    does_not_apply,
    function_of,
    random_points,
    symbols_of,
    vanishing,
)
from codegen.problem.problem import Simulate
from codegen.problem.symbols import coordinate, time
from codegen.symbolic.zeros import identically_zero

_MOST_ITERATIONS = 60


@dataclass(frozen=True)
class StepEquations:
    """Expressions that vanish in a step from `left` = (q_k, p_k) over inner `stages` to `right` = (q_k1, p_k1).

    Of a composition they are those of one step of its base, which depend on `lengths`; `fractions` has them for each
    step of the base, in parts of the whole.
    """

    left: tuple[Symbol, ...]
    stages: tuple[Symbol, ...]
    right: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    lengths: tuple[Symbol, ...] = (STEP,)
    fractions: tuple[tuple[Expr, ...], ...] = ()

    @property
    def unknowns(self) -> tuple[Symbol, ...]:
        """What a step determines."""
        return (*self.stages, *self.right)

    def links(self) -> list[tuple[tuple[Symbol, ...], tuple[Symbol, ...], tuple[Expr, ...]]]:
        """The step as a chain of substeps from one state to the next; one link when it is no such chain."""
        size = len(self.left)
        whole = (*self.left, *self.unknowns)
        chain = [whole[i : i + size] for i in range(0, len(whole), size)]
        parts = [self.equations[i : i + size] for i in range(0, len(self.equations), size)]
        links = list(zip(chain[:-1], chain[1:], parts, strict=True))
        for before, after, part in links:
            if any(e.free_symbols & (set(whole) - set(before) - set(after)) for e in part):
                return [(self.left, self.unknowns, self.equations)]
        return links


def step_equations(model: Model, scheme: Scheme) -> StepEquations:
    """Write one step: the equations of a one-step method, or a discrete Lagrangian's balances and Legendre transforms.

    Raises what the Legendre transforms raise.
    """
    model = model.with_free_ends
    lengths, part = repeated(scheme)
    if not part.variational:
        phase = legendre.hamiltonian_form(model)
        step = one_step_interval(phase, part)
        left, right = (*step.q.left, *step.p.left), (*step.q.right, *step.p.right)
        return StepEquations(left, step.stages, right, step.equations, lengths, scheme.parts)
    interval = variational_interval(legendre.lagrangian_form(model), part)
    momenta = model.rates if model.form == "hamiltonian" else legendre.conjugate_symbols(model)
    left, right = at_nodes(momenta, "_k"), at_nodes(momenta, "_k1")
    equations = [*interval.inner_balance]
    equations += [p - momentum for p, momentum in zip(left, interval.left_momentum, strict=True)]
    equations += [p - momentum for p, momentum in zip(right, interval.right_momentum, strict=True)]
    left, right = (*interval.q.left, *left), (*interval.q.right, *right)
    return StepEquations(left, interval.inner, right, tuple(equations), lengths, scheme.parts)


def solved_step(residual: Function, jacobian: Function, given: Sequence[Any], start: Sequence[Any]) -> list[Any]:
    """The unknowns of a step by Newton's method in mpmath's current precision, from `start`.

    `residual` and `jacobian` (row by row) are functions of `given` and the unknowns. Raises NumericsError where the
    method does not converge.
    """
    y, count = [mpmath.mpf(x) for x in start], len(start)
    least = mpmath.mpf(10) ** (8 - mpmath.mp.dps)
    for _ in range(_MOST_ITERATIONS):
        entries = jacobian(*given, *y)
        matrix = mpmath.matrix([entries[i : i + count] for i in range(0, count**2, count)])
        try:
            change = mpmath.lu_solve(matrix, mpmath.matrix(residual(*given, *y)))
        except ZeroDivisionError:
            break
        y = [value - change[i] for i, value in enumerate(y)]
        if max(abs(x) for x in change) <= least * (1 + max(abs(x) for x in y)):
            return y
    raise NumericsError("the equations of a step could not be solved", "check the scheme")


def without_forces(model: Model) -> Model:
    """The conservative part of a model."""
    return replace(model, force=(S.Zero,) * len(model.force), controls=(), cost=None)


def jacobians(left: Sequence[Symbol], right: Sequence[Symbol], equations: Sequence[Expr]) -> tuple[Matrix, Matrix]:
    """Derivatives of equations by the state before and the unknowns after a step."""
    column = Matrix(list(equations))
    return column.jacobian(list(left)), column.jacobian(list(right))


def symplectic_form(size: int) -> Matrix:
    """The matrix J of the canonical symplectic form on a phase space of that (even) dimension."""
    half = size // 2
    zero, unit = sympy.zeros(half), sympy.eye(half)
    return Matrix(sympy.BlockMatrix([[zero, unit], [-unit, zero]]))


def generic_model() -> Model:
    """A system without special structure, which no scheme treats better than any other.

    Its mass depends on the position, it is gyroscopic, driven in time and damped; everything is rational, so that
    series in h are computed exactly.
    """
    q, v = coordinate("q")
    t = time()
    return normalise(
        Simulate(
            lagrangian=(1 + q**2 / 3) * v**2 / 2 + q**2 * v / 5 - q**3 / 3 + q * t / 7,
            force={q: -q * v / 4 + t**2 / 3 + q**2 / 9},
            duration=1,
            start={q: 1, v: 1},
        ),
        name="generic",
    )


_DIGITS = 50
PRESERVED = 1e-35
"""A defect in 50-digit arithmetic that is rounding."""
_VIOLATED = 1e-20
_LARGEST_SYSTEM = 8
_SHORTER = 6
"""How often a step of random length is made shorter where its equations have no solution nearby."""


def check_symplecticity(context: Context) -> Iterator[Finding]:
    """Prove or refute the identity for the chosen scheme, forces left out."""
    scheme = context.scheme
    if not scheme.symplectic:
        defect = defect_at_random_points(generic_model_without_forces(), scheme_step(context, generic=True))
        detail = f"not claimed, and violated by a generic system: |S^T J S - J| = {defect:.2g}"
        if not defect > _VIOLATED:
            detail = f"not claimed, but |S^T J S - J| = {defect:.2g} for a generic system; flag it as symplectic"
        yield Finding("symplecticity", scheme.name, defect > _VIOLATED, detail)
        return
    if not (scheme.variational or scheme.is_chain):
        passed = has_symplectic_table(scheme.step().tableau)
        detail = "b_i a_ij + b_j a_ji = b_i b_j, exactly" if passed else "b_i a_ij + b_j a_ji = b_i b_j does not hold"
        yield Finding("symplecticity", scheme.name, passed, f"{detail} (a_ij of the momenta, a_ji of the coordinates)")
        return
    step = scheme_step(context, generic=False)
    if len(step.left) <= _LARGEST_SYSTEM and is_proved(step):
        yield Finding("symplecticity", scheme.name, True, "S^T J S = J, proved symbolically")
        return
    defect = defect_at_random_points(context.model, step)
    detail = f"|S^T J S - J| = {defect:.2g} at random points in {_DIGITS}-digit arithmetic"
    yield Finding("symplecticity", scheme.name, defect < PRESERVED, detail)


def scheme_step(context: Context, generic: bool) -> StepEquations:
    """One unforced step of the problem, or of the generic system."""
    model = generic_model_without_forces() if generic else without_forces(context.model)
    return step_equations(model, context.scheme)


def generic_model_without_forces() -> Model:
    """The conservative part of the generic system."""
    return without_forces(generic_model())


def has_symplectic_table(table: Tableau) -> bool:
    """Whether a table satisfies the condition for partitioned methods (HLW, theorem VI.4.6)."""
    b, a, c = table.weights, table.positions, table.momenta
    indices = range(len(b))
    return all(sympy.expand(b[i] * c[i][j] + b[j] * a[j][i] - b[i] * b[j]) == 0 for i in indices for j in indices)


def is_proved(step: StepEquations) -> bool:
    """Whether A J A^T = B J B^T holds symbolically in every link of the chain that makes up the step."""
    for left, right, equations in step.links():
        if len(left) != len(right):
            return False
        before, after = jacobians(left, right, equations)
        form = symplectic_form(len(left))
        difference = before * form * before.T - after * form * after.T
        if not all(identically_zero(entry) for entry in difference):
            return False
    return True


def defect_at_random_points(model: Model, step: StepEquations) -> float:
    """The largest entry of S^T J S - J where the equations of a step hold, solved in 50-digit arithmetic."""
    symbols = symbols_of(step.equations, step.left, step.unknowns)
    known = [symbol for symbol in symbols if symbol not in step.unknowns]
    order = [*known, *step.unknowns]
    residual = function_of(order, step.equations)
    before, after = (function_of(order, list(m)) for m in jacobians(step.left, step.unknowns, step.equations))
    form = mpmath.matrix(symplectic_form(len(step.left)).tolist())
    largest = 0.0
    with mpmath.workdps(_DIGITS):
        for point in random_points(step.equations, symbols, model, count=2):
            size = len(step.left)
            start = [point[step.left[i % size]] for i in range(-len(step.unknowns), 0)]
            for attempt in range(1, _SHORTER + 1):
                given = [mpmath.mpf(point[symbol]) / (4**attempt if symbol in step.lengths else 1) for symbol in known]
                try:
                    y = solved_step(residual, after, given, start)
                    break
                except NumericsError:  # bodies that meet, for instance
                    if attempt == _SHORTER:
                        raise
            columns, rows = len(step.left), len(step.unknowns)
            a = mpmath.matrix(rows, columns)
            b = mpmath.matrix(rows, rows)
            a[:, :], b[:, :] = _shaped(before(*given, *y), columns), _shaped(after(*given, *y), rows)
            derivative = -(b**-1) * a
            derivative = derivative[rows - columns :, :]
            difference = derivative.T * form * derivative - form
            largest = max(largest, float(max(abs(entry) for entry in difference)))
    return largest


def _shaped(entries: list[mpmath.mpf], columns: int) -> mpmath.matrix:
    return mpmath.matrix([entries[i : i + columns] for i in range(0, len(entries), columns)])


def check_area_preservation(context: Context) -> Iterator[Finding]:
    """Derive the determinant for every registered scheme, forces left out, where there is one coordinate.

    Compositions are left out, whose determinant is a product of those of their base.
    """
    if len(context.model.coordinates) != 1:
        yield does_not_apply("area preservation", "there is more than one coordinate")
        return
    for method, table in METHODS.items():
        try:
            yield from _of_method(context.model, method, table.values())
        except DegenerateError:
            yield does_not_apply("area preservation", f"a degenerate Legendre transform rules out {method} schemes")


def _of_method(forced: Model, method: str, schemes: Iterable[Scheme]) -> Iterator[Finding]:
    """The rows of the schemes of a method; DegenerateError where the problem has no form for it."""
    model = without_forces(forced)
    curvature = sympy.hessian(model.function, [*model.coordinates, *model.rates])
    curved, linear = not identically_zero(curvature.det()), not curvature.has(*model.coordinates, *model.rates)
    for scheme in schemes:
        if scheme.parts:
            continue
        if scheme.is_chain:
            determinant = area_factor(model, scheme)
            preserved, found = determinant == 1, f"det = {sympy.sstr(determinant)}"
        else:
            # The determinant of a step with inner stages is a long expression; for two variables it is S^T J S.
            defect = defect_at_random_points(forced, step_equations(model, scheme))
            preserved, found = defect < PRESERVED, f"|det - 1| = {defect:.2g} at random points"
        # Where the potential or the kinetic energy is linear, any scheme may preserve areas by accident, and so do
        # symmetric ones where both are quadratic: the map is R(hA) with R(z) R(-z) = 1.
        accident = preserved and (not curved or (linear and scheme.symmetric))
        claim = "symplectic" if scheme.symplectic else "not symplectic"
        passed = preserved == scheme.symplectic or accident
        yield Finding("area preservation", f"{scheme.name} ({method})", passed, f"{found}, and the scheme is {claim}")


def area_factor(model: Model, scheme: Scheme) -> Expr:
    """The determinant of the derivative of the one-step map, simplified; a product over substeps.

    That of a composition is the factor of one step of its base, of any length.
    """
    factor = sympy.S.One
    for left, right, equations in step_equations(model, scheme).links():
        before, after = jacobians(left, right, equations)
        if len(right) == len(left):
            factor *= before.det() / after.det()
        else:
            factor *= (-after.LUsolve(before))[-len(left) :, :].det()
    factor = sympy.factor(sympy.simplify(factor))
    return factor if factor.count_ops() < sympy.expand(factor).count_ops() else sympy.expand(factor)


def check_noether(context: Context) -> Iterator[Finding]:
    """Prove conservation for every coordinate that the Lagrangian or Hamiltonian does not hold."""
    model = context.model
    cyclic = [i for i, q in enumerate(model.coordinates) if not model.function.has(q)]
    if not cyclic:
        yield does_not_apply("discrete Noether", f"no coordinate is cyclic in the {model.form.capitalize()}")
    for i in cyclic:
        q = model.coordinates[i]
        change = momentum_change(model, context.scheme, i)
        known = vanishing(change)
        passed, detail = bool(known), f"{q} is cyclic, and without force its discrete momentum is conserved, {known}"
        if model.force[i] != 0:
            detail += f" (the force {sympy.sstr(model.force[i])} changes it)"
        if any(constraint.has(q) for constraint in model.holonomic):
            detail += " (the force of a constraint changes it)"
        if not passed:
            detail = f"{q} is cyclic, but its discrete momentum changes by {sympy.sstr(change)[:200]} in a step"
        yield Finding("discrete Noether", f"momentum of {q}", passed, detail)


def momentum_change(model: Model, scheme: Scheme, i: int) -> Expr:
    """The sum of all D_j Ld in one component, or what a one-step method adds to the momentum; forces left out.

    A composition conserves what its base does.
    """
    model = without_forces(model.with_free_ends)
    _, scheme = repeated(scheme)
    if scheme.variational:
        interval = variational_interval(legendre.lagrangian_form(model), scheme)
        inner = interval.inner[i :: len(model.coordinates)]
        positions = (interval.q.left[i], interval.q.right[i], *inner)
        return sum((sympy.diff(interval.lagrangian, q) for q in positions), sympy.S.Zero)
    step, dimension = one_step_interval(legendre.hamiltonian_form(model), scheme), len(model.coordinates)
    equations = step.equations if scheme.is_chain else step.equations[-2 * dimension :]
    return sum(equations[dimension + i :: 2 * dimension], sympy.S.Zero) - (step.p.right[i] - step.p.left[i])


_STATE = (Rational(3, 5), Rational(4, 7))
_INSTANT = Rational(1, 3)
_ORDER_DIGITS = 60
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
    with mpmath.workdps(_ORDER_DIGITS):
        for divisions in _DIVISIONS:
            found = _state_after(step, residual, jacobian, 1 / mpmath.mpf(divisions))
            errors.append(max(abs(a - b) for a, b in zip(_flow_after(divisions), found, strict=True)))
        return float(mpmath.log(errors[0] / errors[1], 2)) - 1.0, float(errors[1])


def _state_after(step: StepEquations, residual: Function, jacobian: Function, length: mpmath.mpf) -> list[mpmath.mpf]:
    """The state after a step from the generic one, solved part by part."""
    state, instant = [mpmath.mpf(x.p) / x.q for x in _STATE], mpmath.mpf(_INSTANT.p) / _INSTANT.q
    rows = [[mpmath.mpf(str(sympy.N(f, _ORDER_DIGITS))) for f in row] for row in step.fractions] or [[mpmath.mpf(1)]]
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
    with mpmath.workdps(_ORDER_DIGITS):
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
