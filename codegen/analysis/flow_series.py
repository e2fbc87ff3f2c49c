"""The map of one step as a power series in h, from its implicit equations and for any number of inner stages.

The unknowns of a step are series with coefficients in a FunctionRing. Coefficient n follows from the equations'
coefficient n, which is linear in it; nothing is solved in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Add, Expr, S, Symbol

from codegen import legendre
from codegen.analysis.function_ring import FunctionRing
from codegen.analysis.normal_form import Element
from codegen.discretise import STEP, at_nodes, one_step_interval, variational_interval
from codegen.errors import SchemeError
from codegen.model import Boundary, Model
from codegen.schemes import DiscreteLagrangian, OneStep, Scheme

Series = list[Element]
"""Coefficients of h^0, h^1, ..., as many as are wanted."""
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
    model = _bare(model)
    phase = model if model.form == "first-order" else legendre.hamiltonian_form(model)
    step = _Variational(model, phase, scheme) if isinstance(scheme, DiscreteLagrangian) else _OneStep(phase, scheme)
    expand = step.expanded
    variables = (*phase.coordinates, *phase.rates, phase.time)
    inner = {*step.known, *step.unknowns, *variables, STEP}
    constants = sorted((step.symbols() - inner) | set(phase.controls), key=str)
    roomy = FunctionRing(variables, constants)
    expand(roomy, 1)
    return expand(roomy.compressed(lambda ring: expand(ring, 1)), order)


def _bare(model: Model) -> Model:
    """The model without what an expansion does not see, its angles gathered: cos(a - b) for cos a cos b + sin a sin b.

    Sums of products of sines and cosines in denominators would have no normal form.
    """
    function, dynamics = _gathered(model.function), tuple(map(_gathered, model.dynamics))
    return replace(without_ends(model), function=function, dynamics=dynamics)


def without_ends(model: Model) -> Model:
    """The model with free ends and no cost, whose Legendre transforms cannot fail for their sake."""
    free = Boundary((None,) * len(model.coordinates), (None,) * len(model.coordinates))
    return replace(model, cost=None, path=(), start=free, end=free if model.end else None)


def _gathered(function: Expr) -> Expr:
    if not function.has(sympy.sin, sympy.cos):
        return function
    expanded = sympy.expand(function)
    if expanded.count_ops() > _GATHER_LIMIT:
        return function
    found = sympy.expand(sympy.trigsimp(expanded))
    return found if found.count_ops() < expanded.count_ops() else function


class _Step:
    """The equations of a step; `known` maps the symbols at the left node to variables."""

    known: dict[Symbol, Symbol]
    unknowns: tuple[Symbol, ...]
    equations: tuple[Expr, ...]

    def symbols(self) -> set[Symbol]:
        """All symbols of the equations and of the action."""
        raise NotImplementedError

    def expanded(self, ring: FunctionRing, order: int) -> FlowSeries:
        """Solve for the unknowns, coefficient by coefficient."""
        raise NotImplementedError

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
    ) -> dict[Symbol, Series]:
        """Series of the unknowns; `correction` maps residuals to what must be added to the newest coefficients."""
        known = self._given(ring, order)
        unknown = {symbol: padded([value], ring, order) for symbol, value in zip(self.unknowns, guess, strict=True)}
        for n in range(order + 1):
            cut = {symbol: value[: n + 1] for symbol, value in {**known, **unknown}.items()}
            evaluate = Evaluation(ring, cut, n)
            residuals = [evaluate(equation)[n] for equation in self.equations]
            for symbol, change in zip(self.unknowns, correction(residuals), strict=True):
                unknown[symbol][n] = ring.reduced(unknown[symbol][n] + change)
        return {**known, **unknown}


class _OneStep(_Step):
    """Equations in stages and the right node, of which h = 0 leaves linear equations with numbers as coefficients."""

    def __init__(self, phase: Model, scheme: Scheme) -> None:
        assert isinstance(scheme, OneStep)
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


class _Variational(_Step):
    """p_k = -D1 Ld - f- and p_k1 = D2 Ld + f+ in the mean velocity v, q_k1 = q_k + h v, which h = 0 leaves regular."""

    def __init__(self, model: Model, phase: Model, scheme: DiscreteLagrangian) -> None:
        side = legendre.lagrangian_form(model)
        interval = variational_interval(side, scheme)
        self.phase = phase
        self.velocities = self.unknowns = at_nodes((Symbol(f"{q.name}_mean") for q in phase.coordinates), "_k")
        momenta = at_nodes(phase.rates, "_k")
        self.known = dict(zip((*interval.q.left, *momenta), (*phase.coordinates, *phase.rates), strict=True))
        self.known |= {phase.time: phase.time, **dict(zip(interval.q.left_controls, phase.controls, strict=True))}
        left = interval.q.left
        arrival = {b: a + STEP * v for b, a, v in zip(interval.q.right, left, self.velocities, strict=True)}
        # Ld/h as a function of the left node and of v is free of 1/h, unlike the derivatives of Ld.
        density = Add(*(term.xreplace(arrival) / STEP for term in Add.make_args(interval.lagrangian)))
        minus = [f.xreplace(arrival) for f in interval.force_minus]
        plus = [f.xreplace(arrival) for f in interval.force_plus]
        slopes = [sympy.diff(density, v) for v in self.velocities]
        pulls = [STEP * sympy.diff(density, q) for q in left]
        pairs = zip(momenta, slopes, pulls, minus, strict=True)
        self.equations = tuple(p - (slope - pull - f) for p, slope, pull, f in pairs)
        self.momenta = tuple(slope + f for slope, f in zip(slopes, plus, strict=True))
        self.action = STEP * density

    def symbols(self) -> set[Symbol]:
        every = (*self.equations, *self.momenta, self.action, self.phase.function)
        return set().union(*(e.free_symbols for e in every))

    def expanded(self, ring: FunctionRing, order: int) -> FlowSeries:
        function, momenta = self.phase.function, self.phase.rates
        own = {x: [ring.symbol(x)] for x in (*self.phase.coordinates, *momenta, self.phase.time)}
        at_start = Evaluation(ring, own, 0)
        guess = [at_start(sympy.diff(function, p))[0] for p in momenta]
        inverse_mass = [[at_start(sympy.diff(function, a, b))[0] for a in momenta] for b in momenta]

        def correction(residuals: Sequence[Element]) -> list[Element]:
            sums = (sum((a * r for a, r in zip(row, residuals, strict=True)), ring.zero) for row in inverse_mass)
            return [ring.reduced(total) for total in sums]

        values = self._solve(ring, guess, order, correction)
        evaluate = Evaluation(ring, values, order)
        positions = [
            padded([ring.symbol(q), *values[v]], ring, order)
            for q, v in zip(self.phase.coordinates, self.velocities, strict=True)
        ]
        flow = (*positions, *(evaluate(p) for p in self.momenta), _clock(ring, order))
        return FlowSeries(ring, flow, evaluate(self.action))


def _clock(ring: FunctionRing, order: int) -> Series:
    return padded([ring.symbol(ring.variables[-1]), ring.one], ring, order)


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
