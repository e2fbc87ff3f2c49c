"""Pontryagin's necessary conditions of a control problem, derived symbolically.

The state x holds the coordinates and their rates. With the dynamics x' = f(x, u, t), the cost rate C(x, u, t) and the
costate psi, the Hamiltonian is C + psi.f, and an optimum satisfies

    x' = f,    psi' = -dH/dx,    0 = dH/du,    psi_i = 0 at an end that leaves x_i free.

Source: Pontryagin, Boltyanskii, Gamkrelidze and Mishchenko (1962); Bryson and Ho, Applied optimal control, chapter 2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import sympy

from codegen.errors import ArgumentError, DegenerateError
from codegen.model import Boundary, Model
from codegen.model.conditions.table import CONDITIONS
from codegen.model.legendre import new_symbols, solve_blocks


@dataclass(frozen=True)
class NecessaryConditions:
    """The boundary value problem of an optimum; tuples are in the order of `states` = (coordinates, rates).

    `dynamics` and `hamiltonian` hold the controls; `optimal_control`, `state_rates`, `costate_rates` and `cost_rate`
    hold them no longer. `start` and `end` are equations, one a state, whose left sides are given and vanish.
    """

    model: Model
    states: tuple[sympy.Symbol, ...]
    costates: tuple[sympy.Symbol, ...]
    dynamics: tuple[sympy.Expr, ...]
    hamiltonian: sympy.Expr
    optimal_control: tuple[sympy.Expr, ...]
    state_rates: tuple[sympy.Expr, ...]
    costate_rates: tuple[sympy.Expr, ...]
    cost_rate: sympy.Expr
    start: tuple[sympy.Expr, ...]
    end: tuple[sympy.Expr, ...]


def beyond_maximum_principle(model: Model) -> str:
    """What a problem has that the necessary conditions below do not provide for, in words; nothing if they hold."""
    features = {
        "several phases": bool(model.phases),
        "values of the past": bool(model.joined),
        "a first-order system": model.form == "first-order",
        "bounds": bool(model.bounds),
        **dict.fromkeys((kind.words for kind in CONDITIONS if kind.of_model(model)), True),
        "a terminal cost": model.terminal_cost != 0,
        "free parameters": bool(model.free_parameters),
        "several bodies": model.bodies > 1,
        "no controls": not model.controls,
    }
    return ", ".join(name for name, present in features.items() if present)


def necessary_conditions(model: Model) -> NecessaryConditions:
    """Derive the necessary conditions of a control problem in the form (Lagrangian or Hamiltonian) that it has.

    Raises ArgumentError when the problem has no cost, or something that these conditions do not provide for,
    SymbolError when a name `psi_<state>` is taken, and DegenerateError when dH/du = 0 does not determine the controls.
    """
    if model.cost is None or model.end is None:
        raise ArgumentError(f"{model.name} is no control problem", "return codegen.Control(...) from problem()")
    beyond = beyond_maximum_principle(model)
    if beyond:
        raise ArgumentError(
            f"{model.name} has {beyond}, for which the maximum principle is not derived",
            "take its reference from a finer grid instead",
        )
    states = (*model.coordinates, *model.rates)
    costates = new_symbols(model, "psi_", states)
    dynamics = _dynamics(model)
    hamiltonian = model.cost + sum((psi * f for psi, f in zip(costates, dynamics, strict=True)), sympy.S.Zero)
    optimal = _optimal_control(model, hamiltonian)
    substitution = dict(zip(model.controls, optimal, strict=True))
    return NecessaryConditions(
        model=model,
        states=states,
        costates=costates,
        dynamics=dynamics,
        hamiltonian=hamiltonian,
        optimal_control=optimal,
        state_rates=tuple(f.xreplace(substitution) for f in dynamics),
        costate_rates=tuple(-hamiltonian.diff(x).xreplace(substitution) for x in states),
        cost_rate=model.cost.xreplace(substitution),
        start=_end_equations(states, costates, model.start),
        end=_end_equations(states, costates, model.end),
    )


def _dynamics(model: Model) -> tuple[sympy.Expr, ...]:
    """The right sides of the forced Euler-Lagrange equations, solved for (v, v'), or of Hamilton's for (q', p')."""
    function, q, rates = model.function, model.coordinates, model.rates
    gradient = [function.diff(symbol) for symbol in q]
    if model.form == "hamiltonian":
        forced = [f - slope for f, slope in zip(model.force, gradient, strict=True)]
        return (*(function.diff(p) for p in rates), *forced)
    momenta = [function.diff(v) for v in rates]
    right = [
        slope + f - p.diff(model.time) - sum(p.diff(x) * v for x, v in zip(q, rates, strict=True))
        for slope, f, p in zip(gradient, model.force, momenta, strict=True)
    ]
    return (*rates, *solve_blocks(sympy.hessian(function, rates), right))


def _optimal_control(model: Model, hamiltonian: sympy.Expr) -> tuple[sympy.Expr, ...]:
    """Solve dH/du = 0 for the controls."""
    stationarity = [hamiltonian.diff(u) for u in model.controls]
    curvature = sympy.Matrix(stationarity).jacobian(list(model.controls)).applyfunc(sympy.expand)
    names = " ".join(map(str, model.controls))
    if not curvature.has(*model.controls):
        off = dict.fromkeys(model.controls, sympy.S.Zero)
        try:
            return solve_blocks(curvature, [-slope.xreplace(off) for slope in stationarity])
        except DegenerateError:
            raise DegenerateError(
                f"the cost does not determine {names}", "add a term to it that grows with the square of each control"
            ) from None
    try:
        solutions = sympy.solve(stationarity, list(model.controls), dict=True)
    except NotImplementedError:
        solutions = []
    complete = [found for found in solutions if set(found) == set(model.controls)]
    if len(complete) != 1:
        raise DegenerateError(
            f"stationarity has {len(complete) or 'no'} closed solutions for {names}", "make the cost quadratic in it"
        )
    return tuple(complete[0][u] for u in model.controls)


def _end_equations(
    states: Sequence[sympy.Symbol], costates: Sequence[sympy.Symbol], boundary: Boundary
) -> tuple[sympy.Expr, ...]:
    values = (*boundary.positions, *boundary.rates)
    return tuple(psi if v is None else x - v for x, psi, v in zip(states, costates, values, strict=True))


def parameter_values(model: Model, values: Mapping[str, float] | None) -> dict[sympy.Symbol, float]:
    """Values of all parameters: the defaults, overridden by name. Raises ArgumentError for an unknown name."""
    known = {parameter.name: parameter for parameter in model.parameters}
    for name in values or {}:
        if name not in known:
            raise ArgumentError(f"{model.name} has no parameter {name}", f"use one of {', '.join(known) or 'none'}")
    return model.default_values | {known[name]: float(value) for name, value in (values or {}).items()}
