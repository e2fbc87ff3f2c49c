"""Modified equations of a scheme on a problem, and the modified Hamiltonian: backward error analysis.

A step of length h is, as a formal series, the flow over the time h of a modified vector field f_0 + h f_1 + h^2 f_2 +
... It is found by comparing powers of h. For a symplectic scheme it is Hamiltonian, and the modified Hamiltonian
follows without any integration: the action of a step, S, is the integral of p . dq/dt - H along the modified flow, so
that p . dq/dt - H = D/(exp(h D) - 1) S with the derivative D along the modified field.

Source: Hairer, Lubich and Wanner (2006), Geometric numerical integration, IX.1 and VI.5; Vermeeren (2017), Modified
equations for variational integrators, Numerische Mathematik 137.

The map of one step as a power series in h, from its implicit equations and for any number of inner stages.

The unknowns of a step are series with coefficients in a FunctionRing. Coefficient n follows from the equations'
coefficient n, which is linear in it; nothing is solved in closed form.

Modified equations of a problem file, laid out for people to read: the conclusion first, then power by power.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import sympy
from sympy import Add, Expr, Rational, S, Symbol

from codegen.discretise import schemes, transcribe
from codegen.discretise.interval import STEP, Sites, at_nodes, one_step_interval, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Boundary, Model
from codegen.discretise.model.from_file import load_problem
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.schemes.base import Scheme
from codegen.discretise.schemes.one_step import alpha
from codegen.errors import ArgumentError, SchemeError
from codegen.evidence.analysis.function_ring import Element, FunctionRing
from codegen.problem.sources import settings_of
from codegen.show.notation import Block, Notation, written
from codegen.symbolic.zeros import identically_zero

Series = list[Element]
"""Coefficients of h^0, h^1, ..., as many as are wanted."""


def padded(values: Sequence[Element], ring: FunctionRing, order: int) -> Series:
    """A series cut, or filled with zeros, to end at h^order."""
    return [*values[: order + 1], *[ring.zero] * (order + 1 - len(values))]


class Evaluation:
    """Expressions at series, by Taylor's formula on every function; parts that occur twice are evaluated once."""

    def __init__(self, ring: FunctionRing, values: Mapping[Symbol, Series], order: int) -> None:
        self._ring, self._order = ring, order
        self._known: dict[Expr, Series] = {symbol: padded(v, ring, order) for symbol, v in values.items()}

    def __call__(self, expression: Expr) -> Series:
        """The series of an expression."""
        if expression not in self._known:
            self._known[expression] = self._evaluated(expression)
        return self._known[expression]

    def _evaluated(self, expression: Expr) -> Series:
        ring = self._ring
        if not expression.free_symbols & self._known.keys():
            return padded([ring.function(expression, STEP, ring.zero)], ring, self._order)
        if expression.is_Add:
            return [sum(parts, ring.zero) for parts in zip(*map(self, expression.args), strict=True)]
        if expression.is_Mul:
            result = self(expression.args[0])
            for factor in expression.args[1:]:
                result = self._product(result, self(factor))
            return result
        x = sympy.Dummy("x", real=True)
        if expression.is_Pow:
            base, exponent = expression.as_base_exp()
            if exponent.free_symbols & self._known.keys():
                return self(sympy.exp(exponent * sympy.log(base)))
            if exponent.is_Integer and exponent > 0:
                result = self(base)
                for _ in range(int(exponent) - 1):
                    result = self._product(result, self(base))
                return result
            return self._composed(x**exponent, x, self(base))
        if len(expression.args) != 1:
            return padded([ring.function(expression, x, ring.zero)], ring, self._order)
        return self._composed(expression.func(x), x, self(expression.args[0]))

    def _product(self, a: Series, b: Series) -> Series:
        ring = self._ring
        products = (
            sum((a[i] * b[n - i] for i in range(n + 1) if a[i] and b[n - i]), ring.zero) for n in range(self._order + 1)
        )
        return [ring.reduced(total) for total in products]

    def _composed(self, outer: Expr, x: Symbol, inner: Series) -> Series:
        """Taylor's formula for an outer function around the inner series' first coefficient."""
        ring = self._ring
        change = [ring.zero, *inner[1:]]
        power = padded([ring.one], ring, self._order)
        result = padded([ring.function(outer, x, inner[0])], ring, self._order)
        if not any(change):
            return result
        for k in range(1, self._order + 1):
            outer, power = sympy.diff(outer, x) / k, self._product(power, change)
            factor = ring.function(outer, x, inner[0])
            result = [ring.reduced(r + factor * c) for r, c in zip(result, power, strict=True)]
        return result


_GATHER_LIMIT = 300
"""Operation count up to which sympy's trigonometric simplification is affordable."""


@dataclass(frozen=True)
class FlowSeries:
    """z_k1 = sum_n h^n flow[i][n] for each variable i of (q, p, t), and the action's S = sum_n h^n action[n].

    The action is the discrete Lagrangian, or the scheme's own quadrature of p . dH/dp - H; for a symplectic scheme
    dS = p_k1 dq_k1 - p_k dq_k. It is None for a first-order system.
    """

    ring: FunctionRing
    flow: tuple[Series, ...]
    action: Series | None


def flow_series(model: Model, scheme: Scheme, order: int) -> FlowSeries:
    """Expand one step of a scheme to the power `order` of h.

    The model is of first-order or Hamiltonian form for a one-step scheme, of Lagrangian or Hamiltonian form for a
    discrete Lagrangian. Variables are coordinates, momenta if there are any, and time; controls, parameters and free
    parameters are constants. Raises ExpressionError where a function has no expansion, SchemeError where the equations
    of a step are not of a known kind, and what the Legendre transforms raise.
    """
    # The model without what an expansion does not see, its angles gathered: cos(a - b) for cos a cos b + sin a sin b.
    #
    # Sums of products of sines and cosines in denominators would have no normal form.
    function, dynamics = _gathered(model.function), tuple(map(_gathered, model.dynamics))
    model = replace(model.with_free_ends, cost=None, path=(), function=function, dynamics=dynamics)
    phase = legendre.hamiltonian_form(model)
    step = _Variational(model, phase, scheme) if scheme.variational else _OneStep(phase, scheme)
    expand = step.expanded
    variables = (*phase.coordinates, *phase.rates, phase.time)
    inner = {*step.known, *step.unknowns, *variables, STEP}
    constants = sorted((step.symbols() - inner) | set(phase.controls), key=str)
    roomy = FunctionRing(variables, constants)
    expand(roomy, 1)
    ring = roomy.compressed(lambda ring: expand(ring, 1))
    if not step.is_solved(ring):
        raise SchemeError(f"scheme {scheme.name!r} has equations that h = 0 does not solve", "use another scheme")
    return expand(ring, order)


def _gathered(function: Expr) -> Expr:
    if not function.has(sympy.sin, sympy.cos):
        return function
    expanded = sympy.expand(function)
    if expanded.count_ops() > _GATHER_LIMIT:
        return function
    found = sympy.expand(sympy.trigsimp(expanded))
    return found if found.count_ops() < expanded.count_ops() else function


class _Step(ABC):
    """The equations of a step; `known` maps the symbols at the left node to variables."""

    known: dict[Symbol, Symbol]
    unknowns: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    _solution: Mapping[Symbol, Series]

    @abstractmethod
    def symbols(self) -> set[Symbol]:
        """All symbols of the equations and of the action."""

    @abstractmethod
    def expanded(self, ring: FunctionRing, order: int) -> FlowSeries:
        """Solve for the unknowns, coefficient by coefficient."""

    def is_solved(self, ring: FunctionRing) -> bool:
        """Whether the first two coefficients of the series satisfy the equations."""
        self.expanded(ring, 1)
        evaluate = Evaluation(ring, self._solution, 1)
        return all(ring.vanishes(value) for equation in self.equations for value in evaluate(equation))

    def _given(self, ring: FunctionRing, order: int) -> dict[Symbol, Series]:
        values = {symbol: [ring.symbol(variable)] for symbol, variable in self.known.items()}
        values[STEP] = [ring.zero, ring.one]
        return {symbol: padded(value, ring, order) for symbol, value in values.items()}

    def _solve(
        self,
        ring: FunctionRing,
        guess: Sequence[Element],
        order: int,
        correction: Callable[[Sequence[Element]], Sequence[Element]],
    ) -> Mapping[Symbol, Series]:
        """Series of the unknowns; `correction` maps residuals to what must be added to the newest coefficients."""
        known = self._given(ring, order)
        unknown = {symbol: padded([value], ring, order) for symbol, value in zip(self.unknowns, guess, strict=True)}
        for n in range(order + 1):
            cut = {symbol: value[: n + 1] for symbol, value in {**known, **unknown}.items()}
            evaluate = Evaluation(ring, cut, n)
            residuals = [evaluate(equation)[n] for equation in self.equations]
            for symbol, change in zip(self.unknowns, correction(residuals), strict=True):
                unknown[symbol][n] = ring.reduced(unknown[symbol][n] + change)
        self._solution = {**known, **unknown}
        return self._solution


class _OneStep(_Step):
    """Equations in stages and the right node, of which h = 0 leaves linear equations with numbers as coefficients."""

    def __init__(self, phase: Model, scheme: Scheme) -> None:
        states = (*phase.coordinates, *phase.rates)
        if phase.form == "hamiltonian":
            momentum = sum((p * sympy.diff(phase.function, p) for p in phase.rates), S.Zero)
            phase = replace(phase, cost=momentum - phase.function)
        step = one_step_interval(phase, scheme)
        self.action = step.cost if phase.form == "hamiltonian" else None
        self.known = dict(zip((*step.q.left, *step.p.left), states, strict=True)) | {phase.time: phase.time}
        self.known |= dict(zip(step.q.left_controls, phase.controls, strict=True))
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
        if any(entry.free_symbols for entry in slopes) or slopes.det() == 0:
            raise SchemeError(f"scheme {scheme.name!r} has stages that h = 0 does not determine", "use another scheme")
        self.inverse = slopes.inv()

    def symbols(self) -> set[Symbol]:
        expressions = (*self.equations, *([] if self.action is None else [self.action]))
        return set().union(*(e.free_symbols for e in expressions))

    def expanded(self, ring: FunctionRing, order: int) -> FlowSeries:
        numbers = [[ring.function(entry, STEP, ring.zero) for entry in row] for row in self.inverse.tolist()]

        def correction(residuals: Sequence[Element]) -> list[Element]:
            sums = (sum((a * r for a, r in zip(row, residuals, strict=True)), ring.zero) for row in numbers)
            return [ring.reduced(-total) for total in sums]

        guess = [ring.symbol(self.origin[y]) if y in self.origin else ring.zero for y in self.unknowns]
        values = self._solve(ring, guess, order, correction)
        action = None if self.action is None else Evaluation(ring, values, order)(self.action)
        flow = (*(values[y] for y in self.right), _clock(ring, order))
        return FlowSeries(ring, flow, action)


@dataclass(frozen=True)
class _VelocityForm:
    """One interval in velocities v_j = (q_j - q_k)/h of the inner points j and of the right node, these last.

    With Ld = h D(q_k, v), the derivative of Ld by q_j is that of D by v_j, so that no equation holds 1/h.
    """

    left: Sites
    velocities: tuple[Symbol, ...]
    abscissae: tuple[Expr, ...]
    equations: tuple[Expr, ...]
    momenta: tuple[Expr, ...]
    action: Expr

    @classmethod
    def of(cls, model: Model, scheme: Scheme) -> _VelocityForm:
        """p_k + D1 Ld + f- and D_j Ld + f_j for inner points, which vanish, and D2 Ld + f+ = p_k1."""
        interval = variational_interval(model, scheme)
        size, left = len(model.coordinates), interval.q.left
        # The motion is a straight line without inner points, unless the kind of scheme has them.
        inner = tuple(interval.inner)
        points = (*inner, *interval.q.right)
        velocities = tuple(Symbol(f"{q.name}_velocity", real=True) for q in points)
        arrival = {q: left[i % size] + STEP * v for i, (q, v) in enumerate(zip(points, velocities, strict=True))}
        density = Add(*(term.xreplace(arrival) / STEP for term in Add.make_args(interval.lagrangian)))
        slopes = [sympy.diff(density, v) for v in velocities]
        forces = [f.xreplace(arrival) for f in (*interval.force_inner, *interval.force_plus)]
        equations = []
        for i, (q, f) in enumerate(zip(left, interval.force_minus, strict=True)):
            pull = STEP * sympy.diff(density, q) - Add(*slopes[i::size])
            equations.append(at_nodes(_momenta_of(model), "_k")[i] + pull + f.xreplace(arrival))
        balances = [slope + f for slope, f in zip(slopes, forces, strict=True)]
        abscissae = (*interval.inner_abscissae, *[S.One] * size)
        count = len(inner)
        return cls(
            left=interval.q,
            velocities=velocities,
            abscissae=abscissae,
            equations=(*equations, *balances[:count]),
            momenta=tuple(balances[count:]),
            action=STEP * density,
        )

    @classmethod
    def inverse_slopes(cls, model: Model, scheme: Scheme) -> sympy.Matrix:
        """The inverse derivative of the equations of a free particle of unit mass by the velocities.

        At h = 0 all velocities agree, so that for any L the derivative is this one times the mass matrix L_vv.
        """
        particle = replace(
            model,
            coordinates=model.coordinates[:1],
            rates=model.rates[:1],
            function=model.rates[0] ** 2 / 2,
            force=(S.Zero,),
            start=Boundary((None,), (None,)),
            end=None,
        )
        form = cls.of(particle, scheme)
        return sympy.Matrix(form.equations).jacobian(list(form.velocities)).inv()


def _momenta_of(model: Model) -> tuple[Symbol, ...]:
    """Symbols for the momenta of a model of Lagrangian form, which no author can declare."""
    return tuple(Symbol(f"{q.name}_momentum", real=True) for q in model.coordinates)


class _Variational(_Step):
    """The forced discrete Legendre transforms and the stationarity of Ld at inner points, in velocities."""

    def __init__(self, model: Model, phase: Model, scheme: Scheme) -> None:
        side = legendre.lagrangian_form(model)
        self.phase, self.form = phase, _VelocityForm.of(side, scheme)
        self.inverse = _VelocityForm.inverse_slopes(side, scheme)
        left = (*self.form.left.left, *at_nodes(_momenta_of(side), "_k"), *self.form.left.left_controls, phase.time)
        right = (*phase.coordinates, *phase.rates, *phase.controls, phase.time)
        self.known = dict(zip(left, right, strict=True))
        self.unknowns, self.equations = self.form.velocities, self.form.equations

    def symbols(self) -> set[Symbol]:
        every = (*self.equations, *self.form.momenta, self.form.action, self.phase.function)
        return set().union(*(e.free_symbols for e in every))

    def expanded(self, ring: FunctionRing, order: int) -> FlowSeries:
        function, momenta, size = self.phase.function, self.phase.rates, len(self.phase.rates)
        own = {x: [ring.symbol(x)] for x in (*self.phase.coordinates, *momenta, self.phase.time)}
        at_start = Evaluation(ring, own, 0)
        velocity = [at_start(sympy.diff(function, p))[0] for p in momenta]
        inverse_mass = [[at_start(sympy.diff(function, a, b))[0] for a in momenta] for b in momenta]
        numbers = [[ring.function(entry, STEP, ring.zero) for entry in row] for row in self.inverse.tolist()]

        def weighted(row: Sequence[Element], values: Sequence[Element]) -> Element:
            return ring.reduced(sum((a * x for a, x in zip(row, values, strict=True)), ring.zero))

        def correction(residuals: Sequence[Element]) -> list[Element]:
            accelerations = [
                [weighted(row, residuals[j : j + size]) for row in inverse_mass] for j in range(0, len(residuals), size)
            ]
            return [-weighted(row, column) for row in numbers for column in zip(*accelerations, strict=True)]

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


def _clock(ring: FunctionRing, order: int) -> Series:
    return padded([ring.symbol(ring.variables[-1]), ring.one], ring, order)


@dataclass(frozen=True)
class Defect:
    """A component of d(i_f omega) that does not vanish: of the pair of variables, in the coefficient of h^power."""

    power: int
    pair: tuple[Symbol, Symbol]
    value: Expr


@dataclass(frozen=True)
class ModifiedEquations:
    """field[k][i] is the coefficient of h^k in the rate of variable i of `states` = (q, p), or of first-order states.

    `defects` is empty where the field is Hamiltonian; `hamiltonian[k]` is then the coefficient of h^k of the modified
    Hamiltonian, up to functions of time alone, or the tuple is empty where no antiderivative was found. Both are None
    for a first-order system, which has no canonical coordinates.
    """

    states: tuple[Symbol, ...]
    field: tuple[tuple[Expr, ...], ...]
    defects: tuple[Defect, ...] | None
    hamiltonian: tuple[Expr, ...] | None


def modified_equations(model: Model, scheme: Scheme, power: int) -> ModifiedEquations:
    """The modified equations of a scheme up to h^power.

    Controls are constants. Forces that derive from a potential become part of the Hamiltonian. Raises ExpressionError
    where a function has no expansion, and what the Legendre transforms raise.
    """
    conservative = with_potential(model)
    series = flow_series(conservative or model, scheme, power + 1)
    ring = series.ring
    fields = modified_field(series)
    states = ring.variables[:-1]
    written = tuple(tuple(ring.expression(c) for c in field[:-1]) for field in fields)
    phase = legendre.hamiltonian_form((conservative or model).with_free_ends)
    written = (_as_given(ring, fields[0], _vector_field(phase)), *written[1:])
    if model.form == "first-order":
        return ModifiedEquations(states, written, None, None)
    found = modified_hamiltonian(series, fields) if conservative is not None else None
    if found is not None and all(_generates(ring, h, field) for h, field in zip(found, fields, strict=True)):
        _, *others = (ring.expression(h) for h in found)
        return ModifiedEquations(states, written, (), (*_as_given(ring, found[:1], (phase.function,)), *others))
    defects = tuple(defect for k, field in enumerate(fields) for defect in _defects(ring, field, k))
    return ModifiedEquations(states, written, defects, None if defects else ())


def _vector_field(phase: Model) -> tuple[Expr, ...]:
    if phase.form == "first-order":
        return phase.dynamics
    slopes = (f - sympy.diff(phase.function, q) for q, f in zip(phase.coordinates, phase.force, strict=True))
    return (*(sympy.diff(phase.function, p) for p in phase.rates), *slopes)


def _as_given(ring: FunctionRing, found: Sequence[Element], given: Sequence[Expr]) -> tuple[Expr, ...]:
    """What the author wrote instead of what was found, where both are equal."""
    return tuple(
        theirs if ring.equals(ours, theirs) else ring.expression(ours)
        for ours, theirs in zip(found, given, strict=False)
    )


def with_potential(model: Model) -> Model | None:
    """The model with its forces in the Hamiltonian or Lagrangian, or None where they have no potential."""
    if model.form == "first-order" or not any(model.force):
        return model
    coordinates, left, potential = model.coordinates, list(model.force), S.Zero
    if any(force.has(*model.rates) for force in left):
        return None
    for i, q in enumerate(coordinates):
        part = sympy.integrate(sympy.expand(left[i]), q)
        if part.has(sympy.Integral):
            return None
        left = [f - sympy.diff(part, x) for f, x in zip(left, coordinates, strict=True)]
        potential -= part
    if not all(identically_zero(rest) for rest in left):
        return None
    function = model.function + (potential if model.form == "hamiltonian" else -potential)
    return replace(model, function=function, force=(S.Zero,) * len(left))


def modified_field(series: FlowSeries) -> list[tuple[Element, ...]]:
    """Coefficients f_0, f_1, ... of the modified vector field, time included (HLW, IX.1).

    With D_k the derivative along f_k, the coefficient of h^n in the flow is the sum of D_k1 ... D_ki x / i! over all
    i and all k1 + ... + ki + i = n; the only one of them that holds f_(n-1) is f_(n-1) itself.
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
    """Coefficients of H = p . dq/dt - D/(exp(h D) - 1) S along the modified field; right if S is the step's action."""
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
    dimension = len(ring.variables) // 2
    momenta = [ring.symbol(p) for p in ring.variables[dimension : 2 * dimension]]
    found = []
    for k, field in enumerate(fields):
        pairing = sum((p * f for p, f in zip(momenta, field[:dimension], strict=True)), ring.zero)
        found.append(_without_constants(ring, ring.reduced(pairing - mean[k + 1])))
    return found


def _without_constants(ring: FunctionRing, element: Element) -> Element:
    """The element without the terms that depend on no coordinate and no momentum."""
    states = ring.variables[:-1]
    kept = {m: c for m, c in element.items() if ring.expression(ring.ring.from_dict({m: c})).free_symbols & set(states)}
    return ring.ring.from_dict(kept)


def _generates(ring: FunctionRing, hamiltonian: Element, field: Sequence[Element]) -> bool:
    """Whether dq/dt = dH/dp and dp/dt = -dH/dq, exactly."""
    *gradient, _ = ring.gradient(hamiltonian)
    dimension = len(gradient) // 2
    slopes = (*gradient[dimension:], *(-g for g in gradient[:dimension]))
    return all(ring.vanishes(f - s) for f, s in zip(field[:-1], slopes, strict=True))


def _defects(ring: FunctionRing, field: Sequence[Element], power: int) -> list[Defect]:
    """The components of d(i_f omega), omega = sum dq ^ dp, that do not vanish."""
    states = ring.variables[:-1]
    dimension = len(states) // 2
    form = (*(-f for f in field[dimension:-1]), *field[:dimension])
    gradients = [ring.gradient(component) for component in form]
    found = []
    for a in range(len(states)):
        for b in range(a + 1, len(states)):
            value = gradients[b][a] - gradients[a][b]
            if not ring.vanishes(value):
                found.append(Defect(power, (states[a], states[b]), ring.expression(value)))
    return found


LARGEST_ORDER = 8
_FAMILY = "alpha"
_FACTOR_LIMIT = 400
"""Operation count up to which factors are looked for."""
_WRITING_LIMIT = 1200
"""Operation count up to which an expression is written out."""
_HIGH = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_LOW = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def analysis(
    path: Path | str,
    arguments: Mapping[str, str] | None = None,
    *,
    scheme: str | None = None,
    method: str | None = None,
    order: int = 3,
    latex: bool = False,
) -> str:
    """The modified equations of a scheme on a problem up to h^order, as text of about 100 columns or as LaTeX.

    `scheme` is a name of the registries, or `alpha` for the whole family with a symbol in place of a number. Raises
    ArgumentError for an order outside 1 to 8 and for problems that have no modified equations here (particles, several
    phases, holonomic constraints, values of the past), and what `modified_equations` raises.
    """
    if not 1 <= order <= LARGEST_ORDER:
        raise ArgumentError(f"--order {order}", f"give a power of h from 1 to {LARGEST_ORDER}")
    model = _analysable(load_problem(Path(path), settings_of(path, arguments)))
    found = _scheme(model, scheme or transcribe.DEFAULT_SCHEME, method)
    result = modified_equations(model, found, order)
    side = legendre.hamiltonian_form(model.with_free_ends)
    notation = Notation.of(side, latex=latex)
    blocks = [*_equations(result, model, notation), *_structure(result, notation)]
    return written(f"{found.name} on {model.name}: {_conclusion(result, latex)}", blocks, notation)


def _analysable(model: Model | PairwiseModel) -> Model:
    reason = ""
    if isinstance(model, PairwiseModel):
        reason = "particles that interact in pairs"
    elif model.phases:
        reason = "several phases"
    elif model.holonomic:
        reason = "holonomic constraints"
    elif model.segments:
        reason = "values of the past"
    if reason:
        raise ArgumentError(
            f"modified equations are not derived for {reason}",
            "analyse one body, one phase, or independent coordinates by themselves",
        )
    assert isinstance(model, Model)
    return model


def _scheme(model: Model, name: str, method: str | None) -> schemes.Scheme:
    """The scheme of that name; without a method, that of the side on which the problem is written if it has it."""
    usable = transcribe.methods_for(model)
    if method is not None and method not in usable:
        raise ArgumentError(f"method {method!r} is not for a {model.form} problem", f"use {' or '.join(usable)}")
    if name == _FAMILY and "hamiltonian" in usable and method in (None, "hamiltonian"):
        return _family(model)
    return schemes.find(name, method or transcribe.method_with(model, name))


def _family(model: Model) -> schemes.Scheme:
    """The alpha family with a symbol that the problem does not use."""
    taken = {s.name for s in (*model.coordinates, *model.rates, *model.controls, *model.parameters)}
    name = next(n for n in ("alpha", "beta", "gamma", "weight", "family_weight") if n not in taken)
    return replace(alpha(Symbol(name, real=True)), name=f"{name} family")


def _conclusion(result: ModifiedEquations, latex: bool) -> str:
    power = _power(len(result.field) - 1, latex)
    if result.defects is None:
        return f"modified equations up to {power}, of a first-order system, which has no Hamiltonian"
    if result.defects:
        powers = sorted({defect.power for defect in result.defects})
        names = [_power(k, latex) for k in powers]
        terms = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
        return f"modified equations up to {power} are not Hamiltonian, because of the coefficients of {terms}"
    found = "" if result.hamiltonian else ", but no modified Hamiltonian was found"
    return f"modified equations up to {power} are Hamiltonian{found}"


def _power(k: int, latex: bool) -> str:
    if latex:
        return "h" if k == 1 else f"h to the power {k}"
    return "h" if k == 1 else "h" + str(k).translate(_HIGH)


def _equations(result: ModifiedEquations, model: Model, notation: Notation) -> Iterator[Block]:
    names = ", ".join(notation.name(x) for x in result.states)
    last = len(result.field)
    plain = " + ".join(["f₀", "h f₁", *(f"h{_high(k)} f{_low(k)}" for k in range(2, last))])
    tex = " + ".join(["f_0", "h f_1", *(f"h^{{{k}}} f_{{{k}}}" for k in range(2, last))])
    remarks = [
        (
            f"ż = {plain} + O(h{_high(last)}), z = ({names}); its flow over the time h is a step",
            rf"$\dot{{z}} = {tex} + O(h^{{{last}}})$, $z = ({names})$; its flow over the time $h$ is a step.",
        )
    ]
    for statement, holds in (
        ("controls are constants", bool(model.controls)),
        (f"each of the {model.bodies} bodies by itself", model.bodies > 1),
    ):
        remarks += [(statement, statement)] if holds else []
    yield Block("Modified equations", (), tuple(remarks))
    for k, field in enumerate(result.field):
        rates = [
            (Symbol(f"rate {x.name}", real=True), _tidied(f, k)) for x, f in zip(result.states, field, strict=True)
        ]
        yield _block(f"Coefficient of {_power(k, notation.latex)}", rates, notation)


def _block(heading: str, rows: list[tuple[Symbol, Expr]], notation: Notation) -> Block:
    """Equations, and in words what vanishes or is too long to be read."""
    remarks: list[tuple[str, str]] = []
    vanishing = [notation.name(label) for label, value in rows if value == 0]
    if len(vanishing) == len(rows):
        return Block(heading, (), (("it vanishes",) * 2,))
    if vanishing:
        listed, marked = ", ".join(vanishing), ", ".join(f"${name}$" for name in vanishing)
        remarks.append((f"no contribution to {listed}", f"No contribution to {marked}."))
    shown = []
    for label, value in rows:
        operations = value.count_ops()
        if operations > _WRITING_LIMIT:
            name = notation.name(label)
            statement = "is not written out: it has"
            remarks.append(
                (f"{name} {statement} {operations} operations", f"${name}$ {statement} {operations} operations.")
            )
        elif value != 0:
            shown.append((label, value))
    return Block(heading, tuple(shown), tuple(remarks))


def _structure(result: ModifiedEquations, notation: Notation) -> Iterator[Block]:
    """The modified Hamiltonian, or what shows that there is none."""
    if result.hamiltonian:
        last = len(result.hamiltonian)
        plain = " + ".join(["H₀", "h H₁", *(f"h{_high(k)} H{_low(k)}" for k in range(2, last))])
        tex = " + ".join(["H_0", "h H_1", *(f"h^{{{k}}} H_{{{k}}}" for k in range(2, last))])
        statement = "checked by differentiation; constants, and functions of time alone, are left out"
        rows = [(Symbol(f"H_{k}", real=True), _tidied(h, k)) for k, h in enumerate(result.hamiltonian)]
        block = _block("Modified Hamiltonian", rows, notation)
        remark = (
            f"H̃ = {plain} + O(h{_high(last)}), {statement}",
            rf"$\tilde{{H}} = {tex} + O(h^{{{last}}})$, {statement}.",
        )
        yield Block(block.heading, block.equations, (remark, *block.remarks))
    for k in sorted({defect.power for defect in result.defects or ()}):
        rows = [
            (Symbol(f"omega_{a.name}_{b.name}", real=True), _tidied(defect.value, k))
            for defect in result.defects or ()
            for a, b in [defect.pair]
            if defect.power == k
        ]
        block = _block(f"Why the coefficient of {_power(k, notation.latex)} is not Hamiltonian", rows, notation)
        remark = (
            "d(i_f ω) = Σ ω_ab da ∧ db does not vanish, where ω = Σ dq ∧ dp",
            r"$d(i_f \omega) = \sum \omega_{ab}\, da \wedge db$ does not vanish, where $\omega = \sum dq \wedge dp$.",
        )
        yield Block(block.heading, block.equations, (remark, *block.remarks))


def _high(k: int) -> str:
    return "" if k == 1 else str(k).translate(_HIGH)


def _low(k: int) -> str:
    return str(k).translate(_LOW)


def _tidied(expression: Expr, power: int) -> Expr:
    """The shorter of a sum and its product of factors; what the author wrote stays as it is."""
    if power == 0 or expression.count_ops() > _FACTOR_LIMIT:
        return expression
    return min(expression, sympy.factor(expression), key=lambda candidate: int(candidate.count_ops()))
