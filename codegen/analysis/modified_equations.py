"""Modified equations of a scheme on a problem, and the modified Hamiltonian: backward error analysis.

A step of length h is, as a formal series, the flow over the time h of a modified vector field f_0 + h f_1 + h^2 f_2 +
... It is found by comparing powers of h. For a symplectic scheme it is Hamiltonian, and the modified Hamiltonian
follows without any integration: the action of a step, S, is the integral of p . dq/dt - H along the modified flow, so
that p . dq/dt - H = D/(exp(h D) - 1) S with the derivative D along the modified field.

Source: Hairer, Lubich and Wanner (2006), Geometric numerical integration, IX.1 and VI.5; Vermeeren (2017), Modified
equations for variational integrators, Numerische Mathematik 137.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Rational, S, Symbol

from codegen.analysis.flow_series import FlowSeries, Series, flow_series
from codegen.analysis.function_ring import FunctionRing
from codegen.analysis.normal_form import Element
from codegen.expressions.zeros import identically_zero
from codegen.model import Model, legendre
from codegen.schemes import Scheme


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
