"""Properties of the map of one step: order, symplecticity, areas, conserved momenta, and the midpoint rule.

Derivative: with the equations E(z0, y) = 0 of a step and its unknowns y, Dy = -(dE/dy)^-1 dE/dz0. Source: Hairer,
Lubich and Wanner (2006), Geometric numerical integration, section VI.2.

Symplecticity: S^T J S = J for the derivative S of the map, or a violation if the scheme does not claim it. With
dE/dz0 = A and dE/dz1 = B, S = -B^-1 A, and the identity is equivalent to A J A^T = B J B^T. This form has no inverse
and can often be decided symbolically. For one degree of freedom, every scheme's determinant of the map is computed.

Discrete Noether theorem: a cyclic coordinate's discrete momentum is conserved without forces. For a translation of q_i
the infinitesimal symmetry of Ld is D1 Ld + D2 Ld = 0 in that component, so p_k = p_k1. Source: Marsden and West (2001),
Discrete mechanics and variational integrators, section 1.3.3.

Order: one step and the exact flow are expanded in powers of h, for a generic forced, time-dependent system with
rational coefficients. The arithmetic is exact, so that agreement and disagreement are proved. The exact flow is
expanded by its Lie series. The expansion is too long for compositions and for coupled stages. The order of such schemes
is measured from the errors of two short steps in arithmetic of many digits.

The midpoint rule is the discrete Hamiltonian map of Ld = h L(midpoint), forces included (Marsden and West, 2.6).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import mpmath
import sympy
from sympy import Add, Expr, Matrix, Rational, S, Symbol

from codegen.discretise import degenerate, schemes
from codegen.discretise.degenerate import step_interval
from codegen.discretise.interval import STEP, at_nodes, between, one_step_interval, repeated, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.schemes import METHODS
from codegen.discretise.schemes.base import Scheme, Tableau
from codegen.discretise.simulation import phase_functions
from codegen.errors import DegenerateError, NumericsError
from codegen.evidence.analysis.function_ring import Evaluation
from codegen.evidence.analysis.modified_equations import flow_series, vector_field
from codegen.evidence.checks.base import Context, Finding, Function, Numbers, does_not_apply, function_of, random_points
from codegen.problem.problem import Simulate
from codegen.problem.symbols import coordinate, time
from codegen.symbolic.zeros import identically_zero

_MOST_ITERATIONS = 60


@dataclass(frozen=True)
class StepEquations:
    """Expressions that vanish in a step from `left` = (q_k, p_k) over inner `stages` to `right` = (q_k1, p_k1).

    A composition repeats a base scheme, and `equations` describe one step of the base with the symbols `lengths`. Each
    row of `fractions` has the values of `lengths` in one repetition, relative to the whole step.
    """

    left: tuple[Symbol, ...]
    stages: tuple[Symbol, ...]
    right: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    lengths: tuple[Symbol, ...] = (STEP,)
    fractions: tuple[tuple[Expr, ...], ...] = ()

    @property
    def unknowns(self) -> tuple[Symbol, ...]:
        """The stages and the state after the step."""
        return (*self.stages, *self.right)

    def links(self) -> list[tuple[tuple[Symbol, ...], tuple[Symbol, ...], tuple[Expr, ...]]]:
        """Return substeps (state before, unknowns, equations); a single substep if stages depend on each other."""
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
    """Return the equations of a one-step scheme, or of a discrete Lagrangian: inner balances, Legendre transforms.

    Raises the errors of the Legendre transforms.
    """
    model = model.with_free_ends
    lengths, part = repeated(scheme)
    if not part.variational:
        phase = legendre.hamiltonian_form(model)
        step = step_interval(phase, part)
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


def jacobians(left: Sequence[Symbol], right: Sequence[Symbol], equations: Sequence[Expr]) -> tuple[Matrix, Matrix]:
    """Return the Jacobians of equations with respect to the symbols `left` and with respect to the symbols `right`."""
    column = Matrix(list(equations))
    return column.jacobian(list(left)), column.jacobian(list(right))


def solved_step(
    residual: Function, jacobian: Function, data: Sequence[mpmath.mpf], start: Sequence[mpmath.mpf]
) -> Numbers:
    """Return the unknowns of a step by Newton's method in mpmath's current precision, from the initial guess `start`.

    `residual` and `jacobian` (row by row) are functions of `data` and the unknowns. Raises NumericsError if the
    iteration does not converge.
    """
    y = [mpmath.mpf(x) for x in start]
    least = mpmath.mpf(10) ** (8 - mpmath.mp.dps)
    for _ in range(_MOST_ITERATIONS):
        try:
            change = mpmath.lu_solve(_matrix(jacobian(*data, *y), len(y)), mpmath.matrix(residual(*data, *y)))
        except ZeroDivisionError:
            break
        y = [value - change[i] for i, value in enumerate(y)]
        if max(abs(x) for x in change) <= least * (1 + max(abs(x) for x in y)):
            return y
    raise NumericsError("the equations of a step could not be solved", "check the scheme")


def _matrix(entries: Numbers, columns: int) -> mpmath.matrix:
    return mpmath.matrix([entries[i : i + columns] for i in range(0, len(entries), columns)])


def without_forces(model: Model) -> Model:
    """Return a model without its forces, controls and cost."""
    return replace(model, force=(S.Zero,) * len(model.force), controls=(), cost=None)


def generic_model() -> Model:
    """Return a model without special structure, so that no scheme has an accidental advantage.

    The mass depends on the position, and the system is gyroscopic, driven in time and damped. All coefficients are
    rational, so that series in h are exact.
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
PRESERVED = 1e-35  # a defect below this number is a rounding error of 50-digit arithmetic
_VIOLATED = 1e-20
_LARGEST_SYSTEM = 8
_ATTEMPTS = 6
"""Largest number of step lengths to try, each a quarter of the previous length, until a step can be solved."""


def check_symplecticity(context: Context) -> Iterator[Finding]:
    """Check without forces that the scheme satisfies S^T J S = J, or violates it if it does not claim symplecticity."""
    scheme, model = context.scheme, context.model
    if model.rolling:
        yield does_not_apply("symplecticity", "motions with rolling constraints preserve no symplectic form")
        return
    if model.form == "first-order":
        yield (
            _kept_two_form(model, scheme)
            if model.linear
            else does_not_apply("symplecticity", "a first-order system has no symplectic form")
        )
        return
    if not scheme.symplectic:
        generic = without_forces(generic_model())
        defect = defect_at_random_points(generic, step_equations(generic, scheme))
        right = f"not claimed, and violated by a generic system: |S^T J S - J| = {defect:.2g}"
        wrong = f"not claimed, but |S^T J S - J| = {defect:.2g} for a generic system; flag it as symplectic"
        yield Finding.decided("symplecticity", scheme.name, defect > _VIOLATED, right, wrong)
        return
    if not (scheme.variational or scheme.is_chain):
        passed = has_symplectic_table(scheme.step().tableau)
        detail = "b_i a_ij + b_j a_ji = b_i b_j, exactly" if passed else "b_i a_ij + b_j a_ji = b_i b_j does not hold"
        yield Finding("symplecticity", scheme.name, passed, f"{detail} (a_ij of the momenta, a_ji of the coordinates)")
        return
    step = step_equations(without_forces(context.model), scheme)
    if len(step.left) <= _LARGEST_SYSTEM and _is_proved(step):
        yield Finding("symplecticity", scheme.name, True, "S^T J S = J, proved symbolically")
        return
    defect = defect_at_random_points(context.model, step)
    detail = f"|S^T J S - J| = {defect:.2g} at random points in {_DIGITS}-digit arithmetic"
    yield Finding("symplecticity", scheme.name, defect < PRESERVED, detail)


def _kept_two_form(model: Model, scheme: Scheme) -> Finding:
    """Return the finding on S^T Omega(x_k1) S = Omega(x_k), for a Lagrangian that is linear in the velocities.

    Every symplectic scheme for canonical pairs satisfies the equation. In the coordinates it needs a constant Omega.
    """
    model, form = degenerate.without_forces(model), degenerate.two_form(model)
    name, kept = "symplecticity", scheme.symplectic
    if not (model.linear and model.linear.pairs) and form.free_symbols & {*model.coordinates, model.time}:
        return does_not_apply(name, "d theta is not constant, and the one-step method does not keep it")
    defect = defect_at_random_points(model, step_equations(model, scheme), form)
    detail = f"|S^T Omega S - Omega| = {defect:.2g} for Omega = d theta, at random points in {_DIGITS}-digit arithmetic"
    detail += "" if kept else ", which is not claimed"
    return Finding(name, scheme.name, defect < PRESERVED if kept else defect > _VIOLATED, detail)


def has_symplectic_table(table: Tableau) -> bool:
    """Return True if a Butcher tableau satisfies the condition for symplectic partitioned methods (HLW, VI.4.6)."""
    b, a, c = table.weights, table.positions, table.momenta
    indices = range(len(b))
    return all(sympy.expand(b[i] * c[i][j] + b[j] * a[j][i] - b[i] * b[j]) == 0 for i in indices for j in indices)


def _is_proved(step: StepEquations) -> bool:
    """Return True if A J A^T = B J B^T can be proved symbolically for every substep."""
    for left, right, equations in step.links():
        if len(left) != len(right):
            return False
        before, after = jacobians(left, right, equations)
        form = _symplectic_form(len(left))
        difference = before * form * before.T - after * form * after.T
        if not all(identically_zero(entry) for entry in difference):
            return False
    return True


def _symplectic_form(size: int) -> Matrix:
    """Return the matrix J of the canonical symplectic form on a phase space of this (even) dimension."""
    zero, unit = sympy.zeros(size // 2), sympy.eye(size // 2)
    return Matrix(sympy.BlockMatrix([[zero, unit], [-unit, zero]]))


def defect_at_random_points(model: Model, step: StepEquations, form: Matrix | None = None) -> float:
    """Return the largest entry of |S^T J S - J| for random steps of a model, in 50-digit arithmetic.

    J is the canonical form, or a two-form `form` that depends on states and time, at both ends of the step.
    """
    form = _symplectic_form(len(step.left)) if form is None else form
    states = (*model.coordinates, *model.rates)[: len(step.left)]
    ends = [dict(zip(states, side, strict=False)) for side in (step.left, step.right)]
    ends[1][model.time] = model.time + Add(*step.lengths)
    forms = [form.xreplace(end) for end in ends]
    of_equations = (value.free_symbols for value in step.equations)
    symbols = set().union(*of_equations, step.left, step.unknowns, *(f.free_symbols for f in forms))
    ordered = sorted(symbols, key=lambda symbol: symbol.name)
    data_symbols = [symbol for symbol in ordered if symbol not in step.unknowns]
    order = [*data_symbols, *step.unknowns]
    residual = function_of(order, step.equations)
    before, after = (function_of(order, list(m)) for m in jacobians(step.left, step.unknowns, step.equations))
    columns, rows = len(step.left), len(step.unknowns)
    matrices = [function_of(order, list(f)) for f in forms]
    largest = 0.0
    with mpmath.workdps(_DIGITS):
        for point in random_points(step.equations, ordered, model, count=2):
            start = [point[step.left[i % columns]] for i in range(-rows, 0)]
            for attempt in range(1, _ATTEMPTS + 1):
                lengths = dict.fromkeys(step.lengths, 4**attempt)
                data = [mpmath.mpf(point[symbol]) / lengths.get(symbol, 1) for symbol in data_symbols]
                try:
                    y = solved_step(residual, after, data, start)
                    break
                except NumericsError:  # for example bodies that meet
                    if attempt == _ATTEMPTS:
                        raise
            a, b = _matrix(before(*data, *y), columns), _matrix(after(*data, *y), rows)
            derivative = (-(b**-1) * a)[rows - columns :, :]
            first, last = (_matrix(matrix(*data, *y), columns) for matrix in matrices)
            difference = derivative.T * last * derivative - first
            largest = max(largest, float(max(abs(entry) for entry in difference)))
    return largest


def check_area_preservation(context: Context) -> Iterator[Finding]:
    """Check for every scheme that the one-step map preserves areas (det = 1) if and only if it is symplectic.

    The check is for one coordinate, without forces. The determinant of a composition is a product of determinants of
    its base, so that compositions are left out.
    """
    if len(context.model.coordinates) != 1:
        yield does_not_apply("area preservation", "there is more than one coordinate")
        return
    model = without_forces(context.model)
    curvature = sympy.hessian(model.function, [*model.coordinates, *model.rates])
    # The Hessian of the Hamiltonian of a Lagrangian L has the determinant -L_qq / L_vv.
    curved = not (identically_zero(curvature.det()) or identically_zero(curvature[0, 0]))
    linear = not curvature.has(*model.coordinates, *model.rates)
    for method, table in METHODS.items():
        try:
            for scheme in (scheme for scheme in table.values() if not scheme.parts):
                if scheme.is_chain:
                    determinant = area_factor(model, scheme)
                    preserved, result = determinant == 1, f"det = {sympy.sstr(determinant)}"
                else:
                    # The determinant of a step with inner stages is a long expression. For two variables it is S^T J S.
                    defect = defect_at_random_points(context.model, step_equations(model, scheme))
                    preserved, result = defect < PRESERVED, f"|det - 1| = {defect:.2g} at random points"
                # If the Hessian of the Hamiltonian is singular, any scheme may preserve areas by accident, for example
                # with det = 1 + h^2 (H_qq H_pp - H_qp^2) for Euler's method. Symmetric schemes preserve them if H is
                # quadratic: the map is R(hA) with R(z) R(-z) = 1.
                accident = preserved and (not curved or (linear and scheme.symmetric))
                detail = f"{result}, and the scheme is {'symplectic' if scheme.symplectic else 'not symplectic'}"
                passed = preserved == scheme.symplectic or accident
                yield Finding("area preservation", f"{scheme.name} ({method})", passed, detail)
        except DegenerateError:
            yield does_not_apply("area preservation", f"a degenerate Legendre transform rules out {method} schemes")


def area_factor(model: Model, scheme: Scheme) -> Expr:
    """Return the determinant of the derivative of the one-step map, simplified. It is a product over substeps.

    For a composition, return the determinant of one step of the base scheme, of any length.
    """
    factor = S.One
    for left, right, equations in step_equations(model, scheme).links():
        before, after = jacobians(left, right, equations)
        if len(right) == len(left):
            factor *= before.det() / after.det()
        else:
            factor *= (-after.LUsolve(before))[-len(left) :, :].det()
    factor = sympy.factor(sympy.simplify(factor))
    return factor if factor.count_ops() < sympy.expand(factor).count_ops() else sympy.expand(factor)


def check_noether(context: Context) -> Iterator[Finding]:
    """Check without forces that momenta of coordinates absent from the Lagrangian or Hamiltonian are conserved."""
    model = context.model
    cyclic = [i for i, q in enumerate(model.coordinates) if not model.function.has(q)]
    if not cyclic:
        yield does_not_apply("discrete Noether", f"no coordinate is cyclic in the {model.form.capitalize()}")
    for i in cyclic:
        q = model.coordinates[i]
        change = momentum_change(model, context.scheme, i)
        right = f"{q} is cyclic, and without force its discrete momentum is conserved, proved symbolically"
        if model.force[i] != 0:
            right += f" (the force {sympy.sstr(model.force[i])} changes it)"
        pushes = any(sympy.diff(c, model.rates[i]) != 0 for c in model.rolling)
        if pushes or any(constraint.has(q) for constraint in model.holonomic):
            right += " (the force of a constraint changes it)"
        wrong = f"{q} is cyclic, but its discrete momentum changes by {sympy.sstr(change)[:200]} in a step"
        yield Finding.decided("discrete Noether", f"momentum of {q}", identically_zero(change), right, wrong)


def momentum_change(model: Model, scheme: Scheme, i: int) -> Expr:
    """Return the change of momentum component i in one step, without forces.

    For a discrete Lagrangian it is the sum of component i of all D_j Ld. For a composition, the step is a step of its
    base scheme, because a composition conserves a momentum if its base does.
    """
    model = without_forces(model.with_free_ends)
    _, scheme = repeated(scheme)
    if scheme.variational:
        interval = variational_interval(legendre.lagrangian_form(model), scheme)
        inner = interval.inner[i :: len(model.coordinates)]
        positions = (interval.q.left[i], interval.q.right[i], *inner)
        return sum((sympy.diff(interval.lagrangian, q) for q in positions), S.Zero)
    step, dimension = one_step_interval(legendre.hamiltonian_form(model), scheme), len(model.coordinates)
    equations = step.equations if scheme.is_chain else step.equations[-2 * dimension :]
    return sum(equations[dimension + i :: 2 * dimension], S.Zero) - (step.p.right[i] - step.p.left[i])


_STATE = (Rational(3, 5), Rational(4, 7))
_INSTANT = Rational(1, 3)
_ORDER_DIGITS = 60
_DIVISIONS = (200, 400)
_EXACT = 0.1  # allowed difference between the measured order and the order of the scheme


def check_consistency(context: Context) -> Iterator[Finding]:
    """Check that one step agrees with the exact flow up to h^order, for the order that the scheme claims."""
    scheme = context.scheme
    if scheme.parts or not scheme.is_chain:
        order, error = measured_order(scheme)
        passed = abs(order - scheme.order) < _EXACT
        detail = f"one step departs from the flow like h^{order + 1:.3f} (error {error:.2g} of a short step)"
    else:
        agreement, difference = first_difference(scheme, scheme.order + 1)
        passed = difference != 0 and agreement == scheme.order
        detail = f"one step and the Lie series of the flow agree up to h^{agreement} (exact expansion, generic system)"
        if difference != 0:
            detail += f", and differ by {float(difference):.3g} h^{agreement + 1}"
    if not passed:
        detail = f"order {scheme.order} is claimed, but {detail}"
    yield Finding("consistency", f"order of {scheme.name}", passed, detail)


def measured_order(scheme: Scheme) -> tuple[float, float]:
    """Return the order of a scheme from the errors of two short steps, and the error of the shorter step."""
    model = generic_model().with_free_ends
    step = step_equations(model, scheme)
    symbols = [model.time, *step.lengths, *step.left, *step.unknowns]
    residual = function_of(symbols, step.equations)
    jacobian = function_of(symbols, list(jacobians(step.left, step.unknowns, step.equations)[1]))
    errors = []
    with mpmath.workdps(_ORDER_DIGITS):
        fractions = [[mpmath.mpf(str(sympy.N(f, _ORDER_DIGITS))) for f in row] for row in step.fractions]
        for divisions in _DIVISIONS:
            state, instant = [mpmath.mpf(x.p) / x.q for x in _STATE], mpmath.mpf(_INSTANT.p) / _INSTANT.q
            for row in fractions or [[mpmath.mpf(1)]]:
                lengths = [fraction / mpmath.mpf(divisions) for fraction in row]
                start = [state[i % len(state)] for i in range(-len(step.unknowns), 0)]
                state = solved_step(residual, jacobian, (instant, *lengths, *state), start)[-len(state) :]
                instant += sum(lengths)
            errors.append(max(abs(a - b) for a, b in zip(_flow_after(divisions), state, strict=True)))
        return float(mpmath.log(errors[0] / errors[1], 2)) - 1.0, float(errors[1])


@cache
def _flow_after(divisions: int) -> Numbers:
    """Return the state (q, p) of the generic system after the time 1/divisions, by mpmath's Taylor series."""
    phase = legendre.hamiltonian_form(generic_model().with_free_ends)
    rates = function_of([phase.time, *phase.coordinates, *phase.rates], vector_field(phase))
    with mpmath.workdps(_ORDER_DIGITS):
        start = [mpmath.mpf(x.p) / x.q for x in _STATE]
        instant = mpmath.mpf(_INSTANT.p) / _INSTANT.q
        return list(mpmath.odefun(lambda t, z: rates(t, *z), instant, start)(instant + 1 / mpmath.mpf(divisions)))


def first_difference(scheme: Scheme, highest: int) -> tuple[int, Expr]:
    """Return the last power of h in which step and flow agree, and their largest difference in the next coefficient.

    The difference is zero if step and flow agree up to the power `highest`.
    """
    model = generic_model().with_free_ends
    phase = legendre.hamiltonian_form(model)
    states = (*phase.coordinates, *phase.rates)
    series = flow_series(model, scheme, highest, dict(zip((*states, phase.time), (*_STATE, _INSTANT), strict=True)))
    ring = series.ring
    # Taylor coefficients of the flow (q, p)(t + h), from x_{j+1} = [h^j] F(x_0 + x_1 h + ... ) / (j + 1).
    flow = [[ring.symbol(x)] for x in states]
    for power in range(highest):
        at = dict(zip(states, flow, strict=True)) | {phase.time: [ring.symbol(phase.time), ring.one]}
        evaluate = Evaluation(ring, at, power)
        rates = [evaluate(rate)[power] for rate in vector_field(phase)]
        for coefficients, rate in zip(flow, rates, strict=True):
            coefficients.append(rate * ring.number(Rational(1, power + 1)))
    for power in range(1, highest + 1):
        differences = [ring.expression(a[power] - b[power]) for a, b in zip(series.flow, flow, strict=False)]
        if any(differences):
            return power - 1, max(differences, key=abs)
    return highest, S.Zero


def check_midpoint_equivalence(context: Context) -> Iterator[Finding]:
    """Check that the discrete Legendre transforms of the midpoint scheme satisfy the implicit midpoint equations."""
    if context.scheme.name != "midpoint":
        yield does_not_apply("midpoint equivalence", f"the scheme is {context.scheme.name}")
        return
    try:
        equations = residuals(context.model)
    except DegenerateError:
        yield does_not_apply("midpoint equivalence", "the Legendre transform is degenerate: there is no Lagrangian")
        return
    for name, residual in equations:
        right = "p_k = -D1 Ld - f-, p_k1 = D2 Ld + f+ satisfy it, proved symbolically"
        wrong = f"the discrete Hamiltonian map leaves {sympy.sstr(residual)[:200]}"
        subject = f"implicit midpoint rule of {name}"
        yield Finding.decided("midpoint equivalence", subject, identically_zero(residual), right, wrong)


def residuals(model: Model) -> list[tuple[str, Expr]]:
    """Return (name, residual) of each equation of the midpoint rule, with the momenta of the discrete Lagrangian.

    The midpoint rule is v = dH/dp and p' = f - dH/dq at the midpoint. The Hamiltonian of a large system is not written
    out; equivalent equations are p = dL/dv and p' = f + dL/dq at the velocity v = (q_k1 - q_k)/h.
    """
    model = model.with_free_ends
    scheme = schemes.METHODS["variational"]["midpoint"]
    if not phase_functions(model):
        phase = legendre.hamiltonian_form(model)
        rule = schemes.METHODS["hamiltonian"]["midpoint"]
        interval = variational_interval(legendre.lagrangian_form(model), scheme)
        left, right = at_nodes(phase.rates, "_k"), at_nodes(phase.rates, "_k1")
        # Halves of sums of momenta are expanded first, where curvature terms cancel.
        momenta = dict(zip((*left, *right), (*interval.left_momentum, *interval.right_momentum), strict=True))
        means = {a / 2 + b / 2: sympy.expand((momenta[a] + momenta[b]) / 2) for a, b in zip(left, right, strict=True)}
        equations = one_step_interval(phase, rule).equations
        names = [symbol.name for symbol in (*phase.coordinates, *phase.rates)]
        return [(name, e.subs(means).xreplace(momenta)) for name, e in zip(names, equations, strict=True)]
    interval = variational_interval(model, scheme)
    left, right = interval.left_momentum, interval.right_momentum
    ends = list(zip(interval.q.left, interval.q.right, strict=True))
    middle: dict[Symbol, Expr] = dict(zip(model.coordinates, (between(a, b, S.Half) for a, b in ends), strict=True))
    middle |= dict(zip(model.rates, ((b - a) / STEP for a, b in ends), strict=True))
    middle |= dict(zip(model.controls, interval.q.left_controls, strict=True)) | {model.time: model.time + STEP / 2}
    rows = []
    for i, (q, v) in enumerate(zip(model.coordinates, model.rates, strict=True)):
        rows.append((q.name, (left[i] + right[i]) / 2 - sympy.diff(model.function, v).xreplace(middle)))
        slope = (sympy.diff(model.function, q) + model.force[i]).xreplace(middle)
        rows.append((f"p_{q.name}", right[i] - left[i] - STEP * slope))
    return rows
