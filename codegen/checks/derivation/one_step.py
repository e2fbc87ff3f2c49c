"""The equations of one step of any scheme in phase space, and the derivative of the map that they define."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mpmath
import sympy
from sympy import Expr, Matrix, S, Symbol

from codegen.author.problem import Simulate
from codegen.author.symbols import coordinate, time
from codegen.checks.evaluation import Function
from codegen.discretise import STEP, at_nodes, one_step_interval, repeated, variational_interval
from codegen.errors import NumericsError
from codegen.model import Model, legendre, normalise
from codegen.schemes import Scheme

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
