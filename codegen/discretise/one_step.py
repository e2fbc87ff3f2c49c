"""The Hamiltonian side, and first-order systems: the equations of one step, and its discrete cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.nodes import STEP, PathValue, Sites, at_nodes, distinct, mean_controls, sites, substitute
from codegen.discretise.polynomials import between
from codegen.expressions.tangents import gradient
from codegen.model import Model
from codegen.schemes import Composition, OfSteps, RungeKutta


@dataclass(frozen=True)
class OneStepInterval:
    """Equations of one step in (q_k, p_k), inner stages and (q_k1, p_k1), each an expression that must vanish.

    The equations for the stages come first, then those of the coordinates, then those of the momenta. A first-order
    system has no momenta. `integrals` are the integrands of the model's conditions on integrals, integrated like the
    cost.
    """

    q: Sites
    p: Sites
    stages: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    cost: Expr
    path: tuple[PathValue, ...] = ()
    integrals: tuple[Expr, ...] = ()


def one_step_interval(model: Model, scheme: OfSteps, nodal_controls: bool = False) -> OneStepInterval:
    """Write the equations of one step of a chain of substeps, of a Runge-Kutta method or of a composition.

    The model is of Hamiltonian form, with forced Hamilton's equations, or of first-order form x' = f(x, u, t). The cost
    is integrated like a further state, so that it has the scheme's order.
    """
    if isinstance(scheme, RungeKutta):
        return _runge_kutta_interval(model, scheme, nodal_controls)
    if isinstance(scheme, Composition):
        scheme = scheme.written_out()
    q_sites = sites(model, model.coordinates, nodal_controls)
    p_sites = sites(model, model.rates, nodal_controls)
    ends = [(*q_sites.left, *p_sites.left)]
    for index in range(1, len(scheme.substeps)):
        ends.append(at_nodes((*model.coordinates, *model.rates), f"_stage{index}"))
    ends.append((*q_sites.right, *p_sites.right))

    integrands = _integrands(model)
    field = (*_vector_field(model), *integrands)
    dimension = len(model.coordinates)
    equations: list[Expr] = []
    path: list[PathValue] = []
    integrals, elapsed = [sympy.S.Zero] * len(integrands), sympy.S.Zero
    for substep, x0, x1 in zip(scheme.substeps, ends[:-1], ends[1:], strict=True):
        a, b, fraction = substep.position, substep.momentum, STEP * substep.fraction
        position = [between(left, right, a) for left, right in zip(x0[:dimension], x1[:dimension], strict=True)]
        momentum = [between(left, right, b) for left, right in zip(x0[dimension:], x1[dimension:], strict=True)]
        c = elapsed + a * substep.fraction
        controls = mean_controls(q_sites, c)

        values = [substitute(model, f, position, momentum, controls, c) for f in field]
        rates, densities = values[: len(x0)], values[len(x0) :]
        equations += [right - left - fraction * rate for left, right, rate in zip(x0, x1, rates, strict=True)]
        integrals = [total + fraction * density for total, density in zip(integrals, densities, strict=True)]
        path += [PathValue(g, c, substitute(model, g.expression, position, momentum, controls, c)) for g in model.path]
        elapsed = sympy.expand(elapsed + substep.fraction)
    stages, kept = _without_idle_stages(ends[1:-1], equations)
    return OneStepInterval(q_sites, p_sites, stages, kept, integrals[0], distinct(path), tuple(integrals[1:]))


def _runge_kutta_interval(model: Model, scheme: RungeKutta, nodal_controls: bool) -> OneStepInterval:
    """The stages of a Runge-Kutta method, of which those that a state equals are not unknown, and the right node."""
    q_sites = sites(model, model.coordinates, nodal_controls)
    p_sites = sites(model, model.rates, nodal_controls)
    left, right = (*q_sites.left, *p_sites.left), (*q_sites.right, *p_sites.right)
    dimension, states = len(model.coordinates), (*model.coordinates, *model.rates)
    points = [_stage_values(scheme, i, dimension, states, left, right) for i in range(len(scheme.weights))]

    integrands = _integrands(model)
    rates, integrals, path = list[list[Expr]](), [sympy.S.Zero] * len(integrands), list[PathValue]()
    for c, weight, point in zip(scheme.places, scheme.weights, points, strict=True):
        position, momentum, controls = point[:dimension], point[dimension:], mean_controls(q_sites, c)
        rates.append([substitute(model, f, position, momentum, controls, c) for f in _vector_field(model)])
        densities = [substitute(model, f, position, momentum, controls, c) for f in integrands]
        integrals = [total + STEP * weight * density for total, density in zip(integrals, densities, strict=True)]
        path += [PathValue(g, c, substitute(model, g.expression, position, momentum, controls, c)) for g in model.path]

    def step(row: Sequence[Expr], x: int) -> Expr:
        return STEP * sum((a * rate[x] for a, rate in zip(row, rates, strict=True)), sympy.S.Zero)

    stages, equations = list[Symbol](), list[Expr]()
    for i, point in enumerate(points):
        for x, value in enumerate(point):
            if value not in (left[x], right[x]):
                stages.append(value)
                equations.append(value - left[x] - step(_row(scheme, i, x < dimension), x))
    equations += [end - begin - step(scheme.weights, x) for x, (begin, end) in enumerate(zip(left, right, strict=True))]
    values = tuple(integrals[1:])
    return OneStepInterval(q_sites, p_sites, tuple(stages), tuple(equations), integrals[0], distinct(path), values)


def _row(scheme: RungeKutta, stage: int, of_coordinates: bool) -> tuple[Expr, ...]:
    return (scheme.positions if of_coordinates else scheme.momenta)[stage]


def _stage_values(
    scheme: RungeKutta,
    i: int,
    dimension: int,
    states: Sequence[Symbol],
    left: Sequence[Symbol],
    right: Sequence[Symbol],
) -> list[Symbol]:
    """The symbols of a stage: those of a node where the table says that it is one."""
    values = list(at_nodes(states, f"_stage{i + 1}"))
    for x in range(len(states)):
        row = _row(scheme, i, x < dimension)
        if not any(row):
            values[x] = left[x]
        elif row == scheme.weights:
            values[x] = right[x]
    return values


def _vector_field(model: Model) -> tuple[Expr, ...]:
    """The right-hand sides of Hamilton's equations with forces, or of a first-order system."""
    if model.form == "first-order":
        return model.dynamics
    return (
        *gradient(model.function, model.rates),
        *(f - slope for slope, f in zip(gradient(model.function, model.coordinates), model.force, strict=True)),
    )


def _integrands(model: Model) -> tuple[Expr, ...]:
    """What is integrated beside the motion: the cost, and what conditions on integrals are on."""
    return (model.cost or sympy.S.Zero, *(integral.integrand for integral in model.integrals))


def _without_idle_stages(
    stages: Sequence[tuple[Symbol, ...]], equations: Sequence[Expr]
) -> tuple[tuple[Symbol, ...], tuple[Expr, ...]]:
    """Drop each stage at which no field is evaluated, as in the trapezoidal rule, by adding the steps beside it.

    The sum is free of such a stage because one step ends where the next begins.
    """
    size = len(stages[0]) if stages else len(equations)
    kept, steps = list[Symbol](), [list(equations[i : i + size]) for i in range(0, len(equations), size)]
    joined = [steps[0]]
    for stage, step in zip(stages, steps[1:], strict=True):
        # A step is linear in its ends unless its field is evaluated there.
        sums = [before + after for before, after in zip(joined[-1], step, strict=True)]
        if any(total.has(*stage) for total in sums):
            kept += stage
            joined.append(step)
        else:
            joined[-1] = sums
    return tuple(kept), tuple(equation for step in joined for equation in step)
