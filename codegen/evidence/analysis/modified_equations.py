"""Backward error analysis: the modified equations of a scheme on a problem, and the modified Hamiltonian.

A step of length h is, as a formal series, the flow over the time h of a modified vector field f_0 + h f_1 + h^2 f_2 +
... Its coefficients follow from a comparison of powers of h. The field of a symplectic scheme is Hamiltonian. Its
modified Hamiltonian follows without integration: the action S of a step is the integral of p . dq/dt - H along the
modified flow. So p . dq/dt - H = D/(exp(h D) - 1) S with the derivative D along the modified field.

Source: Hairer, Lubich and Wanner (2006), Geometric numerical integration, IX.1 and VI.5; Vermeeren (2017), Modified
equations for variational integrators, Numerische Mathematik 137.

The map of one step is expanded from its implicit equations, for any number of inner stages. The unknowns of a step are
power series in h with coefficients in a FunctionRing. Coefficient n of the unknowns follows from coefficient n of the
equations, which is linear in the unknown coefficient.

`analysis` writes the result as text: the conclusion first, then the coefficients of each power of h.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import sympy
from sympy import Add, Expr, Rational, S, Symbol

from codegen.discretise import schemes, transcribe
from codegen.discretise.degenerate import for_method, step_interval
from codegen.discretise.interval import STEP, at_nodes, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Boundary, Model
from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.schemes.base import Scheme
from codegen.discretise.schemes.low_order import alpha
from codegen.errors import ArgumentError, SchemeError
from codegen.evidence.analysis.function_ring import Element, Evaluation, FunctionRing, Series, padded
from codegen.problem.sources import settings_of
from codegen.show.notation import Block, Notation, written
from codegen.symbolic.zeros import identically_zero

LARGEST_ORDER = 8
_FAMILY = "alpha"


def analysis(
    path: Path | str,
    arguments: Mapping[str, str] | None = None,
    *,
    scheme: str | None = None,
    method: str | None = None,
    order: int = 3,
    latex: bool = False,
) -> str:
    """Return a text with the modified equations of a scheme that is applied to a problem.

    Parameters
    ----------
    path : Path or str
        The problem file.
    arguments : Mapping[str, str], optional
        Arguments of the function `problem` of the file, as texts.
    scheme : str, optional
        The name of a registered scheme, or `alpha` for the whole family with a symbol as its parameter.
    method : str, optional
        The method of the scheme. By default the method for the form in which the problem is written.
    order : int
        The highest power of h, from 1 to 8.
    latex : bool
        True for LaTeX; else text of about 100 columns.

    Returns
    -------
    str
        The conclusion, the coefficients of the modified field, and the modified Hamiltonian or the defects.

    Raises
    ------
    ArgumentError
        If `order` is out of range, or the problem has particles, several phases, constraints or delayed values.
        `modified_equations` raises further errors.
    """
    if not 1 <= order <= LARGEST_ORDER:
        raise ArgumentError(f"--order {order}", f"give a power of h from 1 to {LARGEST_ORDER}")
    model = load_problem(Path(path), settings_of(path, arguments))
    reason = ""
    if isinstance(model, PairwiseModel):
        reason = "particles that interact in pairs"
    elif model.phases:
        reason = "several phases"
    elif model.holonomic:
        reason = "holonomic constraints"
    elif model.rolling:
        reason = "rolling constraints"
    elif model.segments:
        reason = "values of the past"
    if reason:
        raise ArgumentError(
            f"modified equations are not derived for {reason}",
            "analyse one body, one phase, or independent coordinates by themselves",
        )
    assert isinstance(model, Model)

    name, usable = scheme or transcribe.DEFAULT_SCHEME, transcribe.methods_for(model)
    if method is not None and method not in usable:
        raise ArgumentError(f"method {method!r} is not for a {model.form} problem", f"use {' or '.join(usable)}")
    if name == _FAMILY and "hamiltonian" in usable and method in (None, "hamiltonian"):
        taken = {s.name for s in (*model.coordinates, *model.rates, *model.controls, *model.parameters)}
        weight = next(n for n in ("alpha", "beta", "gamma", "weight", "family_weight") if n not in taken)
        chosen: Scheme = replace(alpha(Symbol(weight, real=True)), name=f"{weight} family")
    else:
        chosen = schemes.find(name, method or transcribe.method_with(model, name))
    model = for_method(model, method or transcribe.method_with(model, name))
    result = modified_equations(model, chosen, order)
    notation = Notation.of(legendre.hamiltonian_form(model.with_free_ends), latex=latex)
    head = f"{chosen.name} on {model.name}: {_conclusion(result, latex)}"
    return written(head, list(_blocks(result, model, notation)), notation)


@dataclass(frozen=True)
class Defect:
    """The proof that a coefficient of a modified field has no Hamiltonian.

    The coefficient f belongs to h^power. With omega = sum dq ^ dp, the component of d(i_f omega) for the two variables
    `pair` has the `value`, which would vanish for a Hamiltonian field.
    """

    power: int
    pair: tuple[Symbol, Symbol]
    value: Expr


@dataclass(frozen=True)
class ModifiedEquations:
    """The modified field of a scheme, and the modified Hamiltonian or its defects.

    `field[k][i]` is the coefficient of h^k in the rate of variable i of `states` = (q, p), or of first-order states.
    `defects` is empty if the field is Hamiltonian. Then `hamiltonian[k]` is the coefficient of h^k of the modified
    Hamiltonian, up to functions of time alone; the tuple is empty if no antiderivative was found. Both are None for a
    first-order system, which has no canonical coordinates.
    """

    states: tuple[Symbol, ...]
    field: tuple[tuple[Expr, ...], ...]
    defects: tuple[Defect, ...] | None
    hamiltonian: tuple[Expr, ...] | None


def modified_equations(model: Model, scheme: Scheme, power: int) -> ModifiedEquations:
    """Return the modified equations of a scheme up to h^power.

    Controls are constants. Forces with a potential become part of the Hamiltonian. Raises ExpressionError if a function
    has no expansion, and the errors of the Legendre transforms.
    """
    conservative = with_potential(model)
    series = flow_series(conservative or model, scheme, power + 1)
    ring = series.ring
    fields = modified_field(series)
    states = ring.variables[:-1]

    def expressions(elements: Sequence[Element], originals: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return the author's expressions `originals` where they equal the elements, else new expressions."""
        pairs = zip(elements, originals, strict=False)
        return tuple(theirs if ring.equals(ours, theirs) else ring.expression(ours) for ours, theirs in pairs)

    phase = legendre.hamiltonian_form((conservative or model).with_free_ends)
    others = (tuple(ring.expression(c) for c in field[:-1]) for field in fields[1:])
    field_expressions = (expressions(fields[0], vector_field(phase)), *others)
    if model.form == "first-order":
        return ModifiedEquations(states, field_expressions, None, None)
    hamiltonian = modified_hamiltonian(series, fields) if conservative is not None else []
    half, is_generated = len(states) // 2, bool(hamiltonian)
    for h, field in zip(hamiltonian, fields, strict=False):  # dq/dt = dH/dp and dp/dt = -dH/dq
        gradient = ring.gradient(h)[:-1]
        slopes = (*gradient[half:], *(-g for g in gradient[:half]))
        if not all(ring.vanishes(f - slope) for f, slope in zip(field[:-1], slopes, strict=True)):
            is_generated = False
            break
    if is_generated:
        first = expressions(hamiltonian[:1], (phase.function,))
        terms = (*first, *(ring.expression(h) for h in hamiltonian[1:]))
        return ModifiedEquations(states, field_expressions, (), terms)
    defects = tuple(defect for k, field in enumerate(fields) for defect in _defects(ring, field, k))
    return ModifiedEquations(states, field_expressions, defects, None if defects else ())


def vector_field(phase: Model) -> tuple[Expr, ...]:
    """Return x' of a first-order system, or q' = dH/dp and p' = f - dH/dq of a Hamiltonian form."""
    if phase.form == "first-order":
        return phase.dynamics
    slopes = (f - sympy.diff(phase.function, q) for q, f in zip(phase.coordinates, phase.force, strict=True))
    return (*(sympy.diff(phase.function, p) for p in phase.rates), *slopes)


def with_potential(model: Model) -> Model | None:
    """Return the model with its forces as a potential in the Hamiltonian or Lagrangian; None if impossible."""
    if model.form == "first-order" or not any(model.force):
        return model
    coordinates, rest, potential = model.coordinates, list(model.force), S.Zero
    if any(force.has(*model.rates) for force in rest):
        return None
    for i, q in enumerate(coordinates):
        part = sympy.integrate(sympy.expand(rest[i]), q)
        if part.has(sympy.Integral):
            return None
        rest = [f - sympy.diff(part, x) for f, x in zip(rest, coordinates, strict=True)]
        potential -= part
    if not all(identically_zero(force) for force in rest):
        return None
    function = model.function + (potential if model.form == "hamiltonian" else -potential)
    return replace(model, function=function, force=(S.Zero,) * len(rest))


def modified_field(series: FlowSeries) -> list[tuple[Element, ...]]:
    """Return the coefficients f_0, f_1, ... of the modified vector field, time included (HLW, IX.1).

    With D_k the derivative along f_k, the coefficient of h^n in the flow is the sum of D_k1 ... D_ki x / i! over all
    i and all k1 + ... + ki + i = n. Only one term contains f_(n-1): f_(n-1) itself.
    """
    ring = series.ring
    order, size = len(series.flow[0]) - 1, len(series.flow)
    fields: list[tuple[Element, ...]] = []
    directions: list[tuple[Element, ...]] = []
    iterated: dict[tuple[int, int], list[Element]] = {}
    for n in range(1, order + 1):
        remaining = [component[n] for component in series.flow]
        factorial = 1
        for i in range(2, n + 1):
            factorial *= i
            total = [ring.zero] * size
            for k in range(1, n - i + 2):
                inner = iterated[i - 1, n - k]
                total = [t + ring.derivative(g, directions[k - 1]) for t, g in zip(total, inner, strict=True)]
            iterated[i, n] = total
            remaining = [r - t * ring.ring.domain(1, factorial) for r, t in zip(remaining, total, strict=True)]
        field = tuple(ring.zero if ring.vanishes(r) else ring.reduced(r) for r in remaining)
        fields.append(field)
        directions.append(ring.directions(field))
        iterated[1, n] = list(field)
    return fields


def modified_hamiltonian(series: FlowSeries, fields: Sequence[Sequence[Element]]) -> list[Element]:
    """Return the coefficients, by power of h, of H = p . dq/dt - D/(exp(h D) - 1) S along the modified field.

    The result is correct if S is the action of the step. It has no terms that depend on no coordinate and no momentum.
    """
    ring = series.ring
    assert series.action is not None
    directions = [ring.directions(field) for field in fields]
    order = len(fields)
    iterate: Series = list(series.action)
    mean = [ring.zero] * (order + 1)
    for m in range(order):
        weight = (Rational(-1, 2) if m == 1 else sympy.bernoulli(m)) / sympy.factorial(m)
        mean = [a + ring.number(weight) * b for a, b in zip(mean, iterate, strict=True)]
        iterate = [
            sum((ring.derivative(iterate[n - k], directions[k - 1]) for k in range(1, n + 1)), ring.zero)
            for n in range(order + 1)
        ]
    dimension, states = len(ring.variables) // 2, set(ring.variables[:-1])
    momenta = [ring.symbol(p) for p in ring.variables[dimension : 2 * dimension]]
    coefficients = []
    for k, field in enumerate(fields):
        pairing = sum((p * f for p, f in zip(momenta, field[:dimension], strict=True)), ring.zero)
        terms = ring.reduced(pairing - mean[k + 1]).items()
        kept = {m: c for m, c in terms if ring.expression(ring.ring.from_dict({m: c})).free_symbols & states}
        coefficients.append(ring.ring.from_dict(kept))
    return coefficients


def _defects(ring: FunctionRing, field: Sequence[Element], power: int) -> list[Defect]:
    """Return the nonzero components of d(i_f omega), omega = sum dq ^ dp, for the coefficient f of h^power."""
    states = ring.variables[:-1]
    dimension = len(states) // 2
    form = (*(-f for f in field[dimension:-1]), *field[:dimension])
    gradients = [ring.gradient(component) for component in form]
    defects = []
    for a in range(len(states)):
        for b in range(a + 1, len(states)):
            value = gradients[b][a] - gradients[a][b]
            if not ring.vanishes(value):
                defects.append(Defect(power, (states[a], states[b]), ring.expression(value)))
    return defects


_GATHER_LIMIT = 300  # largest number of operations of an expression to which trigonometric simplification is applied


@dataclass(frozen=True)
class FlowSeries:
    """The step z_k1 = sum_n h^n flow[i][n] for each variable i of (q, p, t), and the action S = sum_n h^n action[n].

    The action is the discrete Lagrangian, or the scheme's own quadrature of p . dH/dp - H. For a symplectic scheme
    dS = p_k1 dq_k1 - p_k dq_k. The action of a first-order system is None.
    """

    ring: FunctionRing
    flow: tuple[Series, ...]
    action: Series | None


def flow_series(model: Model, scheme: Scheme, order: int, at: Mapping[Symbol, Rational] | None = None) -> FlowSeries:
    """Expand one step of a scheme to the power `order` of h, from any state or from the numbers `at`.

    A one-step scheme needs a model of first-order or Hamiltonian form. A discrete Lagrangian needs the Lagrangian or
    Hamiltonian form. Variables are coordinates, momenta if there are any, and time. Controls, parameters and free
    parameters are constants. Raises ExpressionError if a function has no expansion, SchemeError if the equations of a
    step are not of a known kind, and the errors of the Legendre transforms.
    """

    def gathered(function: Expr) -> Expr:
        """Write cos(a - b) for cos a cos b + sin a sin b. Denominators with such products have no normal form."""
        if not function.has(sympy.sin, sympy.cos):
            return function
        expanded = sympy.expand(function)
        if expanded.count_ops() > _GATHER_LIMIT:
            return function
        simplified = sympy.expand(sympy.trigsimp(expanded))
        return simplified if simplified.count_ops() < expanded.count_ops() else function

    function, dynamics = gathered(model.function), tuple(map(gathered, model.dynamics))
    model = replace(model.with_free_ends, cost=None, path=(), function=function, dynamics=dynamics)
    phase = legendre.hamiltonian_form(model)
    step = _Variational(model, phase, scheme) if scheme.variational else _OneStep(phase, scheme)
    variables = (*phase.coordinates, *phase.rates, phase.time)
    inner = {*step.at_left, *step.unknowns, *variables, STEP}
    symbols = set().union(*(e.free_symbols for e in (*step.equations, *step.others)))
    constants = sorted((symbols - inner) | set(phase.controls), key=str)
    roomy = FunctionRing(variables, constants, at or {})
    step.expanded(roomy, 1)
    ring = roomy.compressed(lambda ring: step.expanded(ring, 1))
    if not step.is_solved(ring):
        raise SchemeError(f"scheme {scheme.name!r} has equations that h = 0 does not solve", "use another scheme")
    return step.expanded(ring, order)


class _Step(ABC):
    """The equations of a step for its unknowns; `at_left` maps the symbols at the left node to variables.

    `others` are the action and other expressions of the step.
    """

    at_left: dict[Symbol, Symbol]
    unknowns: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    others: tuple[Expr, ...]
    _solution: Mapping[Symbol, Series]

    @abstractmethod
    def expanded(self, ring: FunctionRing, order: int) -> FlowSeries:
        """Return the step as a series in h up to `order`, solved coefficient by coefficient."""

    def is_solved(self, ring: FunctionRing) -> bool:
        """Return True if the first two coefficients of the series satisfy the equations."""
        self.expanded(ring, 1)
        evaluate = Evaluation(ring, self._solution, 1)
        return all(ring.vanishes(value) for equation in self.equations for value in evaluate(equation))

    def _solve(
        self,
        ring: FunctionRing,
        guess: Sequence[Element],
        order: int,
        correction: Callable[[Sequence[Element]], Sequence[Element]],
    ) -> Mapping[Symbol, Series]:
        """Return the series of all symbols; `correction` maps residuals to the change of the newest coefficients."""
        fixed = {symbol: padded([ring.symbol(variable)], ring, order) for symbol, variable in self.at_left.items()}
        fixed[STEP] = padded([ring.zero, ring.one], ring, order)
        unknown = {symbol: padded([value], ring, order) for symbol, value in zip(self.unknowns, guess, strict=True)}
        for n in range(order + 1):
            cut = {symbol: value[: n + 1] for symbol, value in {**fixed, **unknown}.items()}
            evaluate = Evaluation(ring, cut, n)
            residuals = [evaluate(equation)[n] for equation in self.equations]
            for symbol, change in zip(self.unknowns, correction(residuals), strict=True):
                unknown[symbol][n] = ring.reduced(unknown[symbol][n] + change)
        self._solution = {**fixed, **unknown}
        return self._solution


def _numbers(ring: FunctionRing, matrix: sympy.Matrix) -> list[list[Element]]:
    return [[ring.function(entry, STEP, ring.zero) for entry in row] for row in matrix.tolist()]


def _weighted(ring: FunctionRing, row: Sequence[Element], values: Sequence[Element]) -> Element:
    return ring.reduced(sum((a * x for a, x in zip(row, values, strict=True)), ring.zero))


def _clock(ring: FunctionRing, order: int) -> Series:
    return padded([ring.symbol(ring.variables[-1]), ring.one], ring, order)


class _OneStep(_Step):
    """A one-step scheme: equations in stages and right node, which are linear with constant coefficients at h = 0."""

    def __init__(self, phase: Model, scheme: Scheme) -> None:
        states = (*phase.coordinates, *phase.rates)
        if phase.form == "hamiltonian":
            momentum = sum((p * sympy.diff(phase.function, p) for p in phase.rates), S.Zero)
            phase = replace(phase, cost=momentum - phase.function)
        step = step_interval(phase, scheme)
        self.others = (step.cost,) if phase.form == "hamiltonian" else ()
        self.at_left = dict(zip((*step.q.left, *step.p.left), states, strict=True)) | {phase.time: phase.time}
        self.at_left |= dict(zip(step.q.left_controls, phase.controls, strict=True))
        self.right = (*step.q.right, *step.p.right)
        self.unknowns = (*step.stages, *self.right)
        self.equations = step.equations
        self.origin = dict(zip(self.right, states, strict=True))
        for stage in step.stages:
            for x in states:
                if stage.name.startswith(f"{x.name}_stage"):
                    self.origin[stage] = x
        at_rest = sympy.Matrix([equation.xreplace({STEP: S.Zero}) for equation in self.equations])
        slopes = at_rest.jacobian(list(self.unknowns))
        if phase.linear and phase.linear.pairs:  # equations for momenta
            if slopes.has(*self.unknowns):
                finding = f"scheme {scheme.name!r} in canonical pairs whose momenta are not linear in the coordinates"
                raise SchemeError(f"{finding} has no series here", "use --method one-step")
            self.equations = tuple(slopes.LUsolve(sympy.Matrix(self.equations)))
            slopes = sympy.eye(len(self.unknowns))
        if any(entry.free_symbols for entry in slopes) or slopes.det() == 0:
            raise SchemeError(f"scheme {scheme.name!r} has stages that h = 0 does not determine", "use another scheme")
        self.inverse = slopes.inv()

    def expanded(self, ring: FunctionRing, order: int) -> FlowSeries:
        numbers = _numbers(ring, self.inverse)

        def correction(residuals: Sequence[Element]) -> list[Element]:
            return [-_weighted(ring, row, residuals) for row in numbers]

        guess = [ring.symbol(self.origin[y]) if y in self.origin else ring.zero for y in self.unknowns]
        values = self._solve(ring, guess, order, correction)
        action = Evaluation(ring, values, order)(self.others[0]) if self.others else None
        flow = (*(values[y] for y in self.right), _clock(ring, order))
        return FlowSeries(ring, flow, action)


@dataclass(frozen=True)
class _VelocityForm:
    """The equations of an interval in velocities v_j = (q_j - q_k)/h of the inner points j, then of the right node.

    With Ld = h D(q_k, v), the derivative dLd/dq_j equals dD/dv_j, so that no equation contains 1/h. The equations are
    p_k + D1 Ld + f- = 0, and D_j Ld + f_j = 0 for inner points. `momenta` are D2 Ld + f+ = p_k1.
    """

    left: tuple[Symbol, ...]
    velocities: tuple[Symbol, ...]
    abscissae: tuple[Expr, ...]
    equations: tuple[Expr, ...]
    momenta: tuple[Expr, ...]
    action: Expr

    @classmethod
    def of(cls, model: Model, scheme: Scheme) -> _VelocityForm:
        """Return the equations of a model in Lagrangian form. `left` has coordinates, momenta and controls."""
        interval = variational_interval(model, scheme)
        size, left = len(model.coordinates), interval.q.left
        # Names of problems cannot equal the names of these momenta.
        left_momenta = at_nodes([Symbol(f"{q.name}_momentum", real=True) for q in model.coordinates], "_k")
        # Some schemes have no inner points. Then the motion is a straight line.
        points, count = (*interval.inner, *interval.q.right), len(interval.inner)
        velocities = tuple(Symbol(f"{q.name}_velocity", real=True) for q in points)
        arrival = {q: left[i % size] + STEP * v for i, (q, v) in enumerate(zip(points, velocities, strict=True))}
        density = Add(*(term.xreplace(arrival) / STEP for term in Add.make_args(interval.lagrangian)))
        slopes = [sympy.diff(density, v) for v in velocities]
        forces = [f.xreplace(arrival) for f in (*interval.force_inner, *interval.force_plus)]
        balances = [slope + f for slope, f in zip(slopes, forces, strict=True)]
        transforms = []
        for i, (q, f) in enumerate(zip(left, interval.force_minus, strict=True)):
            pull = STEP * sympy.diff(density, q) - Add(*slopes[i::size])
            transforms.append(left_momenta[i] + pull + f.xreplace(arrival))
        return cls(
            left=(*left, *left_momenta, *interval.q.left_controls),
            velocities=velocities,
            abscissae=(*interval.inner_abscissae, *[S.One] * size),
            equations=(*transforms, *balances[:count]),
            momenta=tuple(balances[count:]),
            action=STEP * density,
        )


class _Variational(_Step):
    """A scheme with discrete Lagrangian Ld: its forced Legendre transforms, and stationarity at inner points."""

    def __init__(self, model: Model, phase: Model, scheme: Scheme) -> None:
        side = legendre.lagrangian_form(model)
        self.phase, self.form = phase, _VelocityForm.of(side, scheme)
        # At h = 0 all velocities agree. So for any L the Jacobian of the equations with respect to velocities is the
        # Jacobian for a free particle of unit mass times the mass matrix L_vv.
        particle = replace(
            side,
            coordinates=side.coordinates[:1],
            rates=side.rates[:1],
            function=side.rates[0] ** 2 / 2,
            force=(S.Zero,),
            start=Boundary((None,), (None,)),
            end=None,
        )
        free = _VelocityForm.of(particle, scheme)
        self.inverse = sympy.Matrix(free.equations).jacobian(list(free.velocities)).inv()
        variables = (*phase.coordinates, *phase.rates, *phase.controls, phase.time)
        self.at_left = dict(zip((*self.form.left, phase.time), variables, strict=True))
        self.unknowns, self.equations = self.form.velocities, self.form.equations
        self.others = (*self.form.momenta, self.form.action, phase.function)

    def expanded(self, ring: FunctionRing, order: int) -> FlowSeries:
        function, momenta, size = self.phase.function, self.phase.rates, len(self.phase.rates)
        states = {x: [ring.symbol(x)] for x in (*self.phase.coordinates, *momenta, self.phase.time)}
        at_start = Evaluation(ring, states, 0)
        velocity = [at_start(sympy.diff(function, p))[0] for p in momenta]
        inverse_mass = [[at_start(sympy.diff(function, a, b))[0] for a in momenta] for b in momenta]
        numbers = _numbers(ring, self.inverse)

        def correction(residuals: Sequence[Element]) -> list[Element]:
            accelerations = [
                [_weighted(ring, row, residuals[j : j + size]) for row in inverse_mass]
                for j in range(0, len(residuals), size)
            ]
            return [-_weighted(ring, row, column) for row in numbers for column in zip(*accelerations, strict=True)]

        abscissae = [ring.function(c, STEP, ring.zero) for c in self.form.abscissae]
        guess = [ring.product(c, velocity[i % size]) for i, c in enumerate(abscissae)]
        values = self._solve(ring, guess, order, correction)
        evaluate = Evaluation(ring, values, order)
        positions = [
            padded([ring.symbol(q), *values[v]], ring, order)
            for q, v in zip(self.phase.coordinates, self.unknowns[-size:], strict=True)
        ]
        flow = (*positions, *(evaluate(p) for p in self.form.momenta), _clock(ring, order))
        return FlowSeries(ring, flow, evaluate(self.form.action))


_FACTOR_LIMIT = 400  # largest number of operations of an expression that is factored
_WRITING_LIMIT = 1200  # largest number of operations of an expression that is written out
_HIGH = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_LOW = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def _conclusion(result: ModifiedEquations, latex: bool) -> str:
    power = _power(len(result.field) - 1, latex)
    if result.defects is None:
        return f"modified equations up to {power}, of a first-order system, which has no Hamiltonian"
    if result.defects:
        names = [_power(k, latex) for k in sorted({defect.power for defect in result.defects})]
        terms = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
        return f"modified equations up to {power} are not Hamiltonian, because of the coefficients of {terms}"
    missing = "" if result.hamiltonian else ", but no modified Hamiltonian was found"
    return f"modified equations up to {power} are Hamiltonian{missing}"


def _power(k: int, latex: bool) -> str:
    if latex:
        return "h" if k == 1 else f"h to the power {k}"
    return f"h{_high(k)}"


def _high(k: int) -> str:
    return "" if k == 1 else str(k).translate(_HIGH)


def _series_of(name: str, last: int) -> tuple[str, str]:
    """Return the series name_0 + h name_1 + ... below h^last, as plain text and as LaTeX."""
    powers = range(2, last)
    plain = [f"{name}₀", f"h {name}₁", *(f"h{_high(k)} {name}{str(k).translate(_LOW)}" for k in powers)]
    tex = [f"{name}_0", f"h {name}_1", *(f"h^{{{k}}} {name}_{{{k}}}" for k in powers)]
    return " + ".join(plain), " + ".join(tex)


def _blocks(result: ModifiedEquations, model: Model, notation: Notation) -> Iterator[Block]:
    """Yield blocks of text: the modified field, then the modified Hamiltonian, or the defects without one."""
    names = ", ".join(notation.name(x) for x in result.states)
    last = len(result.field)
    plain, tex = _series_of("f", last)
    remarks = [
        (
            f"ż = {plain} + O(h{_high(last)}), z = ({names}); its flow over the time h is a step",
            rf"$\dot{{z}} = {tex} + O(h^{{{last}}})$, $z = ({names})$; its flow over the time $h$ is a step.",
        )
    ]
    if model.controls:
        remarks.append(("controls are constants",) * 2)
    if model.bodies > 1:
        remarks.append((f"each of the {model.bodies} bodies by itself",) * 2)
    yield Block("Modified equations", (), tuple(remarks))
    for k, field in enumerate(result.field):
        rates = [(Symbol(f"rate {x.name}", real=True), f) for x, f in zip(result.states, field, strict=True)]
        yield _block(f"Coefficient of {_power(k, notation.latex)}", rates, k, notation)
    if result.hamiltonian:
        last = len(result.hamiltonian)
        plain, tex = _series_of("H", last)
        statement = "checked by differentiation; constants, and functions of time alone, are left out"
        rows = [(Symbol(f"H_{k}", real=True), _factored(h) if k else h) for k, h in enumerate(result.hamiltonian)]
        block = _block("Modified Hamiltonian", rows, 0, notation)
        remark = (
            f"H̃ = {plain} + O(h{_high(last)}), {statement}",
            rf"$\tilde{{H}} = {tex} + O(h^{{{last}}})$, {statement}.",
        )
        yield replace(block, remarks=(remark, *block.remarks))
    for k in sorted({defect.power for defect in result.defects or ()}):
        rows = []
        for defect in result.defects or ():
            if defect.power == k:
                a, b = defect.pair
                rows.append((Symbol(f"omega_{a.name}_{b.name}", real=True), defect.value))
        block = _block(f"Why the coefficient of {_power(k, notation.latex)} is not Hamiltonian", rows, k, notation)
        remark = (
            "d(i_f ω) = Σ ω_ab da ∧ db does not vanish, where ω = Σ dq ∧ dp",
            r"$d(i_f \omega) = \sum \omega_{ab}\, da \wedge db$ does not vanish, where $\omega = \sum dq \wedge dp$.",
        )
        yield replace(block, remarks=(remark, *block.remarks))


def _block(heading: str, rows: Sequence[tuple[Symbol, Expr]], power: int, notation: Notation) -> Block:
    """Return a block of equations `rows` (symbol, value), with remarks about rows that vanish or are too long.

    Rows of higher powers are factored; rows of power 0 stay as the author wrote them.
    """
    if power:
        rows = [(label, _factored(value)) for label, value in rows]
    vanishing = [notation.name(label) for label, value in rows if value == 0]
    if len(vanishing) == len(rows):
        return Block(heading, (), (("it vanishes",) * 2,))
    remarks: list[tuple[str, str]] = []
    if vanishing:
        listed, marked = ", ".join(vanishing), ", ".join(f"${name}$" for name in vanishing)
        remarks.append((f"no contribution to {listed}", f"No contribution to {marked}."))
    shown = []
    for label, value in rows:
        operations = value.count_ops()
        if operations > _WRITING_LIMIT:
            name = notation.name(label)
            statement = f"is not written out: it has {operations} operations"
            remarks.append((f"{name} {statement}", f"${name}$ {statement}."))
        elif value != 0:
            shown.append((label, value))
    return Block(heading, tuple(shown), tuple(remarks))


def _factored(expression: Expr) -> Expr:
    """Return the shorter of an expression and its factored form; very long expressions are not factored."""
    if expression.count_ops() > _FACTOR_LIMIT:
        return expression
    return min(expression, sympy.factor(expression), key=lambda candidate: int(candidate.count_ops()))
