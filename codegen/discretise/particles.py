"""The program of a problem about particles, from a pairwise model, a scheme and a method.

The residual of an interval is the residual of a one-step method, r = z_k1 - z_k - h F. The program has the derivatives
of H at each point where the field F = (H_p, -H_q) is evaluated. Methods of the task connect:

- stepping: shooting; unknowns are the initial momenta, equations require the targets as final positions.
- full: unknowns are all inner positions and all momenta, equations are all steps.
- action: minimise the discrete cost 2 h sum H over positions and one momentum on each interval, such that every
  interval covers its distance, (q_k1 - q_k)/h = H_p. The momenta multiply these equations, so that the optimality
  conditions are Hamilton's discrete equations for a symplectic scheme. With the cost and equations of the explicit
  Euler method this is the symplectic Euler method (Marsden and West 2001, section 2.6).
"""

from __future__ import annotations

from dataclasses import dataclass

from sympy import Expr, Rational, S

from codegen.discretise import schemes
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.schemes.base import PARTICLES, Scheme
from codegen.errors import ArgumentError, SchemeError, nearest

CONNECT_METHODS = ("stepping", "full", "action")
DEFAULT_SCHEME = "midpoint"
PARTICLE_SCHEMES: dict[str, Scheme] = {scheme.name: scheme for scheme in schemes.of_method(PARTICLES)}
"""Schemes for pairwise systems by name; `particle_scheme` also finds compositions of higher order."""


@dataclass(frozen=True)
class PairwiseProgram:
    """A pairwise model with the tables of its scheme.

    `substeps` are the triples (g, a, b) of a chain, see `Step.substeps`. Otherwise `rows` and `weights` are the table
    of an explicit Runge-Kutta method; with an adaptive scheme it serves for derivatives alone. `adaptive` is the name
    of an adaptive scheme in scipy. `abscissa` is the point of an interval at which the method action evaluates H.
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
    """Return the program of a pairwise model for the named scheme and method; None means the default.

    Raises ArgumentError for a method that the task does not have, SchemeError for a scheme that the method cannot use.
    """
    methods = CONNECT_METHODS if model.connects else ("hamiltonian",)
    method = method or methods[0]
    if method not in methods:
        raise ArgumentError(f"method {method!r} does not exist for this problem", f"use {' or '.join(methods)}")
    chosen = particle_scheme(scheme or DEFAULT_SCHEME, model.task)
    if method == "action":
        if not chosen.is_chain or len(chosen.step().substeps) > 1:
            raise SchemeError(
                f"scheme {chosen.name} evaluates H more than once in a step, so that no action belongs to it",
                "use an Euler method or midpoint",
            )
        # The action is stationary where the equations of this symplectic scheme hold.
        ((_, abscissa, _),), half = chosen.step().substeps, Rational(1, 2)
        substep = Rational(1), abscissa, half if abscissa == half else 1 - abscissa
        return PairwiseProgram(model, method, chosen.name, chosen.order, substeps=(substep,), abscissa=abscissa)
    if chosen.adaptive and method == "full":
        raise SchemeError(f"scheme {chosen.name} chooses its own steps", "use --method stepping")
    if chosen.is_chain:
        return PairwiseProgram(model, method, chosen.name, chosen.order, substeps=chosen.step().substeps)
    table = chosen.step().tableau
    return PairwiseProgram(
        model, method, chosen.name, chosen.order, rows=table.positions, weights=table.weights, adaptive=chosen.adaptive
    )


def particle_scheme(name: str, task: str) -> Scheme:
    """Return the named scheme for particles; raise SchemeError, with the schemes for the task, for other names."""
    offered = [n for n, s in PARTICLE_SCHEMES.items() if task == "connect" or not s.adaptive]
    if name in offered:
        return PARTICLE_SCHEMES[name]
    if "-of-" in name or (schemes.is_known(name, "hamiltonian") and schemes.find(name, "hamiltonian").parts):
        return schemes.find(name, "hamiltonian")
    hint = nearest(name, offered, f"use one of {', '.join(offered)}")
    raise SchemeError(f"there is no scheme {name!r} for particles and task {task}", hint)
