"""Pairwise model x scheme x method -> what a module about particles computes.

The interval's residual is that of a one-step method, r = z_k1 - z_k - h F, with the derivatives of H at each point
where the field F = (H_p, -H_q) is evaluated. Methods of the task connect:

- stepping: shoot; unknowns are the initial momenta, equations say where the last step arrives.
- full: unknowns are all inner positions and all momenta, equations are all steps.
- action: minimise the discrete cost 2 h sum H over positions and one momentum on each interval, such that every
  interval covers its distance, (q_k1 - q_k)/h = H_p. The momenta multiply these equations, so that the optimality
  conditions are Hamilton's discrete equations of a symplectic scheme; for the explicit Euler method's cost and
  equations this is the symplectic Euler method (Marsden and West 2001, section 2.6).

Schemes for many particles: those that families offer for them, and compositions of higher order.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from sympy import Expr, Rational, S

from codegen.discretise import schemes
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.schemes.base import PARTICLES, Scheme
from codegen.errors import ArgumentError, SchemeError

PARTICLE_SCHEMES: dict[str, Scheme] = {scheme.name: scheme for scheme in schemes.of_method(PARTICLES)}
"""Schemes for pairwise systems by name, over which tests run; `find` knows the compositions of higher order as well."""


def particle_scheme(name: str, task: str) -> Scheme:
    """The scheme of that name; SchemeError tells which there are for the task."""
    offered = [n for n, s in PARTICLE_SCHEMES.items() if task == "connect" or not s.adaptive]
    found = PARTICLE_SCHEMES.get(name) if name in offered else None
    if found is None and (
        "-of-" in name or (schemes.is_known(name, "hamiltonian") and bool(schemes.find(name, "hamiltonian").parts))
    ):
        found = schemes.find(name, "hamiltonian")
    if found is None:
        close = difflib.get_close_matches(name, offered, 1)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(offered)}"
        raise SchemeError(f"there is no scheme {name!r} for particles and task {task}", hint)
    return found


CONNECT_METHODS = ("stepping", "full", "action")
DEFAULT_SCHEME = "midpoint"


@dataclass(frozen=True)
class PairwiseProgram:
    """A pairwise model with the tables of its scheme.

    `substeps` are (fraction, position, momentum) of a composition; or `rows` and `weights` are those of an explicit
    Runge-Kutta method, which for an adaptive scheme serves for the derivatives alone; `adaptive` is that scheme's name
    in scipy. `abscissa` is where on its interval the action takes H, for the method action.
    """

    model: PairwiseModel
    method: str
    scheme: str
    order: int
    substeps: tuple[tuple[Expr, Expr, Expr], ...] = ()
    rows: tuple[tuple[Expr, ...], ...] = ()
    weights: tuple[Expr, ...] = ()
    adaptive: str = ""
    abscissa: Rational = S.Zero


def pairwise(model: PairwiseModel, scheme: str | None = None, method: str | None = None) -> PairwiseProgram:
    """Choose the tables of a scheme and a method.

    Raises ArgumentError for a method that the task does not have, SchemeError for a scheme that the method cannot use.
    """
    methods = CONNECT_METHODS if model.connects else ("hamiltonian",)
    method = method or methods[0]
    if method not in methods:
        raise ArgumentError(f"method {method!r} does not exist for this problem", f"use {' or '.join(methods)}")
    found = particle_scheme(scheme or DEFAULT_SCHEME, model.task)
    if method == "action":
        abscissa, substep = _action(found)
        return PairwiseProgram(model, method, found.name, found.order, substeps=(substep,), abscissa=abscissa)
    if found.adaptive and method == "full":
        raise SchemeError(f"scheme {found.name} chooses its own steps", "use --method stepping")
    if found.is_chain:
        return PairwiseProgram(model, method, found.name, found.order, substeps=found.step().substeps)
    table = found.step().tableau
    return PairwiseProgram(
        model, method, found.name, found.order, rows=table.positions, weights=table.weights, adaptive=found.adaptive
    )


def _action(scheme: Scheme) -> tuple[Rational, tuple[Rational, Rational, Rational]]:
    """Where the action takes H, and the symplectic scheme whose equations are its stationarity."""
    if not scheme.is_chain or len(scheme.step().substeps) > 1:
        raise SchemeError(
            f"scheme {scheme.name} evaluates H more than once in a step, so that no action belongs to it",
            "use an Euler method or midpoint",
        )
    ((_, abscissa, _),), half = scheme.step().substeps, Rational(1, 2)
    momentum = half if abscissa == half else 1 - abscissa
    return abscissa, (Rational(1), abscissa, momentum)
