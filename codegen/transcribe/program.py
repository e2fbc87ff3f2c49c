"""What transcription produces: a scalar on one interval (or a step), and the layout of its unknowns."""

from __future__ import annotations

from dataclasses import dataclass

from sympy import Expr, Symbol

from codegen.model import Model


@dataclass(frozen=True)
class Unknown:
    """One unknown of a node or an interval: its name, what it means, and whether it multiplies an equation."""

    name: str
    meaning: str
    multiplier: bool = False


@dataclass(frozen=True)
class BoundaryValue:
    """A number that a boundary condition prescribes: at the start or end, for which quantity, symbol and value."""

    where: str
    quantity: str
    symbol: Symbol
    value: Expr


@dataclass(frozen=True)
class EndElement:
    """What happens at one end of the time interval.

    `pins` fix unknowns of the end node (local index, value); a multiplier whose equation is absent is pinned to zero.
    `element` is the end's own share of the Lagrangian of the optimisation problem, in the symbols of the node (suffix
    `_k` at the start, `_k1` at the end).
    """

    pins: tuple[tuple[int, Expr], ...]
    element: Expr
    conditions: tuple[tuple[str, Expr], ...]


@dataclass(frozen=True)
class ControlProgram:
    """An optimal-control problem as sum over intervals of one scalar `element`, plus one scalar at each end.

    Unknowns are ordered node_k, interval_k, control_k, node_k1; `controls` are those that live on intervals.
    `only_at_ends` are places in a node of unknowns that only the first or last node has; elsewhere they are zero.
    `equations` are the discrete equations for people to read, the guesses are expressions of time, duration and
    parameters, for the primal unknowns of a node, the stages of an interval and the controls.
    """

    model: Model
    method: str
    scheme: str
    nodal_controls: bool
    node: tuple[Unknown, ...]
    interval: tuple[Unknown, ...]
    controls: tuple[Unknown, ...]
    left_symbols: tuple[Symbol, ...]
    interval_symbols: tuple[Symbol, ...]
    control_symbols: tuple[Symbol, ...]
    right_symbols: tuple[Symbol, ...]
    element: Expr
    cost: Expr
    equations: tuple[tuple[str, Expr], ...]
    only_at_ends: tuple[int, ...]
    start: EndElement
    end: EndElement
    boundary_values: tuple[BoundaryValue, ...]
    node_guess: tuple[Expr, ...]
    stage_guess: tuple[Expr, ...]
    control_guess: tuple[Expr, ...]


@dataclass(frozen=True)
class StepProgram:
    """An initial value problem: one step from the left node (q_k, p_k) to the right node (q_k1, p_k1).

    `equations` are the scheme's equations as a textbook writes them, expressions that must vanish, in the symbols of
    the left node, of inner stages and of the right node; `summary` says in formulas where they come from. Solving
    them takes three parts: `before` are explicit assignments in order, `unknowns` with `residual` are what is left
    for Newton's method (none for an explicit scheme; `linear` when one linear solve will do), `after` are explicit
    assignments that follow. `guess` starts Newton's method. `energy` is the Hamiltonian at the left node; `start`
    holds the initial (q, p) in terms of the parameters and of the symbols of `start_values`.
    """

    model: Model
    method: str
    scheme: str
    order: int
    state: tuple[Unknown, ...]
    left_symbols: tuple[Symbol, ...]
    velocity_symbols: tuple[Symbol, ...]
    stage_symbols: tuple[Symbol, ...]
    right_symbols: tuple[Symbol, ...]
    before: tuple[tuple[Symbol, Expr], ...]
    unknowns: tuple[Symbol, ...]
    guess: tuple[Expr, ...]
    residual: tuple[Expr, ...]
    after: tuple[tuple[Symbol, Expr], ...]
    linear: bool
    equations: tuple[tuple[str, Expr], ...]
    summary: tuple[tuple[str, Expr], ...]
    energy: Expr
    start_values: tuple[BoundaryValue, ...]
    start: tuple[Expr, ...]
