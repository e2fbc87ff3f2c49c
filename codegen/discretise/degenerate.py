"""Lagrangians that are linear in the velocities, L = theta(q, t).v - H(q, t): point vortices, guiding centres.

The Euler-Lagrange equations are of first order. With the two-form Omega_ij = d_i theta_j - d_j theta_i and forces f,

    Omega(q, t) q' = dH/dq + d theta/dt - f,

and the state has the coordinates alone. Omega must be regular, so that the number of coordinates is even. Source:
Rowley and Marsden (2002), Variational integrators for degenerate Lagrangians, with application to point vortices, CDC.

One-step method: schemes in the coordinates, x' = Omega^-1 (...). Runge-Kutta methods commute with linear maps, so that
the symplectic ones conserve a constant Omega. They do not conserve another one.

Hamiltonian method: half of the coordinates, the `partners` y, have no component in theta, perhaps after the total
derivative of a function S(q, t) was added to L. Then p = theta_x(x, y, t) are the momenta of the other coordinates x,

    p' = (d theta_x/dx)^T x' - dH/dx + f_x,    (d theta_x/dy)^T x' = dH/dy - f_y,

and a scheme for canonical pairs (x, p) keeps Omega if it is symplectic. Its unknowns are the coordinates: each stage
has the y that belongs to its x and p. There is no multistep formula, and so there are no parasitic modes.
Symplectic Euler is the degenerate variational integrator of Ellison, Finn, Burby, Kraus, Qin and Tang (2018),
Degenerate variational integrators for magnetic field line flow and guiding center trajectories, Physics of Plasmas 25,
052502.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TypeAlias

import numpy as np
import sympy
from sympy import Add, Expr, Matrix, S, Symbol, diff

from codegen.discretise.conditions.base import Points
from codegen.discretise.interval import STEP, OneStepInterval, Sites, at_nodes, one_step_interval, substitute
from codegen.discretise.model.definitions import Boundary, CanonicalPairs, LinearLagrangian, Model
from codegen.discretise.schemes.base import Scheme
from codegen.errors import BoundaryError, DegenerateError, ExpressionError, SizeError
from codegen.symbolic import checks as expressions
from codegen.symbolic.derivatives import gradient, partials
from codegen.symbolic.zeros import identically_zero

Row: TypeAlias = tuple[Expr, ...]
"""A row of a Butcher tableau."""
_LARGEST_BLOCK = 8
"""Greatest number of coordinates that Omega couples: its Pfaffian has 105 terms."""


_SINGULAR = 1e-11
"""Singular values of the two-form below this fraction of the largest one count as zero."""


def is_linear(function: Expr, rates: Sequence[Symbol]) -> bool:
    """Return True if a Lagrangian contains velocities, and is linear in all of them."""
    at_rest = dict.fromkeys(rates, S.Zero)
    theta = {v: slope.xreplace(at_rest) for v, slope in partials(function, rates).items()}
    linear = Add(function.xreplace(at_rest), *(a * v for v, a in theta.items()))
    return any(a != 0 for a in theta.values()) and identically_zero(function - linear)


def first_order_form(model: Model, points: Points) -> Model:
    """Return the first-order form of a simulation whose Lagrangian is linear in the velocities.

    The Lagrangian is kept in `linear`. Raises DegenerateError if the two-form is singular, and errors for velocities at
    the start, constraints, and forces that depend on velocities.
    """
    at_rest = dict.fromkeys(model.rates, S.Zero)
    theta = tuple(slope.xreplace(at_rest) for slope in gradient(model.function, model.rates))
    q, omega = model.coordinates, _two_form(theta, model.coordinates)
    if expressions.null_direction(expressions.values_at(omega, point) for point in points) is not None:
        names = " ".join(str(v) for v, free in zip(model.rates, _undetermined(omega, points[-1]), strict=True) if free)
        finding = f"the Lagrangian is degenerate in {names}: it is linear in all velocities, and "
        odd = len(q) % 2
        finding += f"{len(q)} is no even number of coordinates" if odd else "its two-form d theta is singular"
        raise DegenerateError(finding, "give every coordinate a conjugate one, or a kinetic energy, or leave it out")
    if expressions.null_direction([expressions.values_at(omega, points[0])]) is not None:
        names = ", ".join(str(v) for v, free in zip(model.rates, _undetermined(omega, points[0]), strict=True) if free)
        raise BoundaryError(
            f"the start does not determine {names}, because the two-form d theta of the Lagrangian is singular there",
            "start elsewhere, or use coordinates that are regular there",
        )
    if model.holonomic or model.rolling or model.gaps:
        argument = "constraint" if model.holonomic else "rolling" if model.rolling else "unilateral"
        finding = f"{argument} with a Lagrangian that is linear in the velocities"
        raise ExpressionError(finding, "use coordinates that need no constraint")
    for event in model.events:
        for v in model.rates:
            if event.expression.has(v) or any(key == v or value.has(v) for key, value in event.changes):
                finding = f"event {event.name} depends on {v}, and the Lagrangian is linear in it"
                raise ExpressionError(finding, "write the event with coordinates and time")
    for x, f in zip(q, model.force, strict=True):
        for v in model.rates:
            if f.has(v):
                remedy = "leave it out: the equations of motion determine the velocities"
                raise ExpressionError(f"force of {x} depends on {v}, and the Lagrangian is linear in it", remedy)
    for v, value in zip(model.rates, model.start.rates, strict=True):
        if value is not None:
            raise BoundaryError(
                f"start gives {v}, but the Lagrangian is linear in the velocities, and coordinates determine them",
                f"leave {v} out of the start",
            )
    linear = LinearLagrangian(model.function, model.rates, theta, -model.function.xreplace(at_rest), model.force)
    start = Boundary(model.start.positions, ())
    return _solved(replace(model, form="first-order", rates=(), function=S.Zero, force=(), start=start, linear=linear))


def _undetermined(omega: Matrix, point: Mapping[Symbol, float]) -> Iterator[bool]:
    """Yield for each coordinate if the null vectors of a singular two-form at a point contain it."""
    values = expressions.values_at(omega, point)
    assert values is not None, "the two-form has real values at trial points"
    _, singular, right = np.linalg.svd(values)
    null = right[singular <= _SINGULAR * (singular[0] or 1.0)]
    yield from (np.abs(null).max(axis=0, initial=0.0) > 1e-6).tolist()


def without_forces(model: Model) -> Model:
    """Return a model with a Lagrangian that is linear in the velocities, without its forces."""
    assert model.linear is not None, "the Lagrangian is linear in the velocities"
    linear = replace(model.linear, force=(S.Zero,) * len(model.coordinates))
    unforced = _solved(replace(model, linear=linear))
    return unforced if model.linear.pairs else for_method(unforced, "one-step")


def _solved(model: Model) -> Model:
    """Return the model with its dynamics q' = Omega^-1 (dH/dq + d theta/dt - f) and its canonical pairs."""
    linear, q, t = model.linear, model.coordinates, model.time
    assert linear is not None, "the Lagrangian is linear in the velocities"
    omega = two_form(model).applyfunc(lambda entry: S.Zero if identically_zero(entry) else entry)
    terms = zip(q, linear.one_form, linear.force, strict=True)
    right = [diff(linear.energy, x) + diff(a, t) - f for x, a, f in terms]
    dynamics = [S.Zero] * len(q)
    for block in omega.connected_components():
        rows = sorted(block)
        if len(rows) > _LARGEST_BLOCK:
            raise SizeError(
                f"the two-form d theta couples {len(rows)} coordinates, from {q[rows[0]]} to {q[rows[-1]]}",
                f"use coordinates of which it couples at most {_LARGEST_BLOCK}",
            )
        whole = _pfaffian(omega, rows)
        for i in rows:
            for j in rows:
                # The inverse of an antisymmetric matrix has the Pfaffians without two rows, and no long fractions.
                if i != j:
                    sign = (-1) ** (rows.index(i) + rows.index(j)) * (1 if i < j else -1)
                    dynamics[i] += sign * _pfaffian(omega, [k for k in rows if k not in (i, j)]) * right[j] / whole
    pairs = _canonical_pairs(linear, omega, q, t, dynamics)
    return replace(model, dynamics=tuple(dynamics), linear=replace(linear, pairs=pairs))


def _pfaffian(matrix: Matrix, rows: Sequence[int]) -> Expr:
    """Return the Pfaffian of the given rows and columns of an antisymmetric matrix, expanded along the first row."""
    if not rows:
        return S.One
    first, *others = rows
    return Add(
        *(
            (-1) ** n * matrix[first, j] * _pfaffian(matrix, [k for k in others if k != j])
            for n, j in enumerate(others)
            if matrix[first, j] != 0
        )
    )


def two_form(model: Model) -> Matrix:
    """Return the matrix of d theta of a model with a Lagrangian that is linear in the velocities."""
    assert model.linear is not None, "the Lagrangian is linear in the velocities"
    return _two_form(model.linear.one_form, model.coordinates)


def _two_form(theta: Sequence[Expr], q: Sequence[Symbol]) -> Matrix:
    return Matrix(len(q), len(q), lambda i, j: diff(theta[j], q[i]) - diff(theta[i], q[j]))


def _canonical_pairs(
    linear: LinearLagrangian, omega: Matrix, q: Sequence[Symbol], t: Symbol, dynamics: Sequence[Expr]
) -> CanonicalPairs | None:
    """Return canonical pairs (x, theta_x), or None if no half of the coordinates can be their partners."""
    theta, energy, force = linear.one_form, linear.energy, dict(zip(q, linear.force, strict=True))
    chosen, total = list[Symbol](), S.Zero
    for block in omega.connected_components():
        options = list(_partners(sorted(block), omega, theta, q))
        if not options:
            return None
        chosen += options[0]
    for y in chosen:
        component = theta[q.index(y)] + diff(total, y)
        total -= sympy.integrate(sympy.expand(component), y)
    momenta = [theta[i] + diff(total, x) for i, x in enumerate(q) if x not in chosen]
    if total != 0:
        momenta = [sympy.expand(p) for p in momenta]
        energy -= diff(total, t)
    positions = tuple(x for x in q if x not in chosen)
    partners = _matched(momenta, chosen)
    velocities = tuple(dynamics[q.index(x)] for x in positions)
    slopes = tuple(
        Add(*(diff(p, x) * v for p, v in zip(momenta, velocities, strict=True))) - diff(energy, x) + force[x]
        for x in positions
    )
    return CanonicalPairs(positions, tuple(partners), tuple(momenta), velocities, slopes)


def _partners(
    block: Sequence[int], omega: Matrix, theta: Sequence[Expr], q: Sequence[Symbol]
) -> Iterator[list[Symbol]]:
    """Yield halves of a block between which Omega vanishes and whose components of theta can be removed.

    Halves without components come first. Other components must be polynomials in all coordinates of the half, whose
    integrals are certain.
    """
    halves = [
        half
        for half in combinations(reversed(block), len(block) // 2)
        if all(omega[i, j] == 0 for i, j in combinations(half, 2))
    ]
    for half in sorted(halves, key=lambda half: sum(theta[i] != 0 for i in half)):
        symbols = [q[i] for i in half]
        if all(theta[i].is_polynomial(*symbols) for i in half):
            yield symbols


def _matched(momenta: Sequence[Expr], partners: Sequence[Symbol]) -> list[Symbol]:
    """Return the partners in an order in which each momentum depends on its own one, as far as possible."""
    slopes = Matrix(momenta).jacobian(partners)
    rest, ordered = list(range(len(partners))), list[Symbol]()
    for row in range(len(momenta)):
        present = [i for i in rest if slopes[row, i] != 0] or rest
        # First a constant slope, which elimination can divide by.
        best = min(present, key=lambda i: (bool(slopes[row, i].free_symbols & {*partners}), i))
        ordered.append(partners[best])
        rest.remove(best)
    return ordered


def for_method(model: Model, method: str) -> Model:
    """Return the model for a method: only the Hamiltonian method has canonical pairs."""
    if model.linear is None or method == "hamiltonian":
        return model
    return replace(model, linear=replace(model.linear, pairs=None))


def step_interval(model: Model, scheme: Scheme) -> OneStepInterval:
    """Return the equations of one step in canonical pairs (x, p) if the model has them, else in its states.

    The unknowns of a step in pairs are the coordinates x and y, where the equations p = theta_x(x, y, t) determine y.
    Stage i is the point i of the scheme.
    """
    if model.linear is None or model.linear.pairs is None:
        return one_step_interval(model, scheme)
    pairs, q, step = model.linear.pairs, model.coordinates, scheme.step()
    table, instants = step.tableau, [point.abscissa for point in step.points]
    rows = list(zip(table.positions, table.momenta, strict=True))
    left, right = (dict(zip(q, at_nodes(q, suffix), strict=True)) for suffix in ("_k", "_k1"))
    # The values x of a point belong to its row of the table for positions, and y to its rows of both tables. The rows
    # of both nodes are zero, and the weights of the scheme.
    zero = (S.Zero,) * len(rows)
    positions, states = {zero: left, table.weights: right}, {(zero, zero): left, (table.weights, table.weights): right}
    # An equation for each unknown: its symbol, its coordinate, the rows of its point, its values, its abscissa.
    unknowns = list[tuple[Symbol, Symbol, tuple[Row, Row], dict[Symbol, Symbol], Expr]]()
    for i, (row, c) in enumerate(zip(rows, instants, strict=True), start=1):
        if row in states:
            continue
        values = dict(zip(q, at_nodes(q, f"_stage{i}"), strict=True))
        if row[0] in positions:
            values |= {x: positions[row[0]][x] for x in pairs.positions}
        new = pairs.partners if row[0] in positions else q
        states[row] = positions[row[0]] = values
        unknowns += [(values[x], x, row, values, c) for x in q if x in new]
    stages = tuple(symbol for symbol, *_ in unknowns)
    unknowns += [(right[x], x, (table.weights, table.weights), right, step.abscissae[-1]) for x in q]

    def at(function: Expr, values: dict[Symbol, Symbol], c: Expr) -> Expr:
        return substitute(model, function, [values[x] for x in q], (), (), c)

    def gained(rate: Expr, weights: Row) -> Expr:
        points = zip(weights, rows, instants, strict=True)
        return Add(*(STEP * w * at(rate, states[row], c) for w, row, c in points if w != 0))

    equations = list[Expr]()
    for symbol, x, (of_positions, of_momenta), values, c in unknowns:
        if x in pairs.positions:
            equations.append(symbol - left[x] - gained(pairs.velocities[pairs.positions.index(x)], of_positions))
        else:
            a = pairs.partners.index(x)
            momentum = at(pairs.momenta[a], values, c) - at(pairs.momenta[a], left, S.Zero)
            equations.append(momentum - gained(pairs.slopes[a], of_momenta))
    nodes = Sites(tuple(left.values()), tuple(right.values()), (), ())
    return OneStepInterval(nodes, Sites((), (), (), ()), stages, tuple(equations), S.Zero)
