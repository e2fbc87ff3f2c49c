"""The Hamiltonian side, and first-order systems: the equations of one step, and its discrete cost."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.nodes import (
    STEP,
    PathValue,
    Sites,
    StateValue,
    at_nodes,
    continued,
    distinct,
    observed_at,
    sites,
    strictly_inside,
    substitute,
)
from codegen.expressions.tangents import gradient
from codegen.model import Model
from codegen.schemes import Scheme


@dataclass(frozen=True)
class OneStepInterval:
    """Equations of one step in (q_k, p_k), inner stages and (q_k1, p_k1), each an expression that must vanish.

    The equations for the stages come first, then those of the coordinates, then those of the momenta. A first-order
    system has no momenta. `integrals` are the integrands of the model's conditions on integrals, integrated like the
    cost. `observed` is what the model's measurements are of, at FRACTION of the interval. `inside` are the values of
    states where an implicit scheme evaluates the dynamics inside the interval, and of the inner stages behind them.
    """

    q: Sites
    p: Sites
    stages: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    cost: Expr
    path: tuple[PathValue, ...] = ()
    integrals: tuple[Expr, ...] = ()
    observed: tuple[Expr, ...] = ()
    inside: tuple[StateValue, ...] = ()


def one_step_interval(model: Model, scheme: Scheme, controls: str = "interval") -> OneStepInterval:
    """Write the equations of a scheme's `Step`, those that lead to inner states first.

    The model is of Hamiltonian form, with forced Hamilton's equations, or of first-order form x' = f(x, u, t). The cost
    is integrated like a further state, so that it has the scheme's order.
    """
    step, states, dimension = scheme.step(), (*model.coordinates, *model.rates), len(model.coordinates)
    q_sites = sites(model, model.coordinates, controls, len(step.points))
    p_sites = sites(model, model.rates, controls, len(step.points))
    inner = (at_nodes(states, f"_stage{n}") for n in range(1, len(step.abscissae)))
    values = [(*q_sites.left, *p_sites.left), *inner, (*q_sites.right, *p_sites.right)]

    integrands, motion = _integrands(model), _vector_field(model)
    field = (*motion, *integrands)
    rates, integrals, path = list[list[Expr]](), [sympy.S.Zero] * len(integrands), list[PathValue]()
    evaluated, elapsed = list[StateValue](), (sympy.S.Zero, *step.abscissae)
    for i, point in enumerate(step.points):
        shares = [point.position] * dimension + [point.momentum] * len(model.rates)
        state = [_sum((share, values[n][x]) for n, share in own) for x, own in enumerate(shares)]
        for x, own in enumerate(shares):
            evaluated += [StateValue(states[x], elapsed[n], values[n][x]) for n, _ in own]
            evaluated.append(StateValue(states[x], _sum((share, elapsed[n]) for n, share in own), state[x]))
        at = (state[:dimension], state[dimension:], q_sites.controls_at(i, point.abscissa), point.abscissa)
        there = [substitute(model, f, *at) for f in field]
        rates.append(there[: len(states)])
        densities = zip(integrals, there[len(states) :], strict=True)
        integrals = [total + STEP * point.weight * density for total, density in densities]
        path += [PathValue(g, point.abscissa, substitute(model, g.expression, *at)) for g in model.path]

    unknowns, equations = list[Symbol](), list[Expr]()
    for n, of_kind in enumerate(zip(step.positions, step.momenta, strict=True), start=1):
        for x, value in enumerate(values[n]):
            if update := of_kind[x >= dimension]:
                rate = _sum(zip(update.weights, (own[x] for own in rates), strict=True))
                unknowns.append(value)
                equations.append(value - values[update.begin][x] - STEP * update.fraction * rate)
    stages = unknowns[: -len(states)]
    if step.is_chain:
        read = {symbol for value in (*integrals, *(g.value for g in path)) for symbol in value.free_symbols}
        stages, equations = _without_idle_stages(values[1:-1], equations, read)
    cost, *others = integrals
    observed = ()
    if model.observed:
        abscissae = [point.abscissa for point in step.points]
        states_there = continued(model, scheme.dense_derivatives, q_sites, p_sites, motion, abscissae)
        observed = observed_at(model, states_there[:dimension], states_there[dimension:])
    inside = () if step.is_explicit else strictly_inside(evaluated)
    return OneStepInterval(
        q_sites, p_sites, tuple(stages), tuple(equations), cost, distinct(path), tuple(others), observed, inside
    )


def _sum(terms: Iterable[tuple[Expr, Expr]]) -> Expr:
    return sum((factor * value for factor, value in terms if factor != 0), sympy.S.Zero)


def _vector_field(model: Model) -> tuple[Expr, ...]:
    """The right-hand sides of Hamilton's equations with forces, or of a first-order system."""
    if model.form == "first-order":
        return model.dynamics
    return (
        *gradient(model.function, model.rates),
        *(f - slope for slope, f in zip(gradient(model.function, model.coordinates), model.force, strict=True)),
    )


def _integrands(model: Model) -> tuple[Expr, ...]:
    return (model.cost or sympy.S.Zero, *(integral.expression for integral in model.integrals))


def _without_idle_stages(
    stages: Sequence[tuple[Symbol, ...]], equations: Sequence[Expr], read: Collection[Symbol]
) -> tuple[list[Symbol], list[Expr]]:
    """Drop each stage at which no field is evaluated, as in the trapezoidal rule, by adding the steps beside it.

    The sum is free of such a stage because one step ends where the next begins. What cost, integrals or path conditions
    have `read` stays.
    """
    size = len(stages[0]) if stages else len(equations)
    kept, steps = list[Symbol](), [list(equations[i : i + size]) for i in range(0, len(equations), size)]
    joined = [steps[0]]
    for stage, step in zip(stages, steps[1:], strict=True):
        # A step is linear in its ends unless its field is evaluated there.
        sums = [before + after for before, after in zip(joined[-1], step, strict=True)]
        if any(x in read for x in stage) or any(total.has(*stage) for total in sums):
            kept += stage
            joined.append(step)
        else:
            joined[-1] = sums
    return kept, [equation for step in joined for equation in step]
