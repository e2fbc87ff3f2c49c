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
class EndElement:
    """What happens at one end of the time interval.

    `pins` fix unknowns of the end node (local index, value); a multiplier whose equation is absent is pinned to zero.
    `extra` are unknowns that exist at this end only, `element` is the end's own share of the Lagrangian of the
    optimisation problem, in the symbols of the node (suffix `_k` at the start, `_k1` at the end) and of `extra`.
    """

    pins: tuple[tuple[int, Expr], ...]
    extra: tuple[Unknown, ...]
    extra_symbols: tuple[Symbol, ...]
    element: Expr
    conditions: tuple[tuple[str, Expr], ...]


@dataclass(frozen=True)
class ControlProgram:
    """An optimal-control problem as sum over intervals of one scalar `element`, plus one scalar at each end.

    Unknowns are ordered node_k, interval_k, control_k, node_k1; `controls` are those that live on intervals.
    `equations` are the discrete equations for people to read, `momenta` the discrete momenta (p_k, p_k1) that
    belong to an interval, in the element's symbols.
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
    left_momentum: tuple[Expr, ...]
    right_momentum: tuple[Expr, ...]
    start: EndElement
    end: EndElement


@dataclass(frozen=True)
class StepProgram:
    """An initial value problem: one step (q_k, p_k) -> (q_k1, p_k1).

    `before` are explicit assignments that the residual needs, in order; `unknowns` with `residual` are what is left
    for Newton's method (none for an explicit scheme); `after` are explicit assignments that follow. `guess` starts
    Newton's method. `start` holds the initial (q, p) in terms of the parameters and of initial rates.
    """

    model: Model
    method: str
    scheme: str
    state: tuple[Unknown, ...]
    left_symbols: tuple[Symbol, ...]
    right_symbols: tuple[Symbol, ...]
    unknowns: tuple[Symbol, ...]
    guess: tuple[Expr, ...]
    before: tuple[tuple[Symbol, Expr], ...]
    residual: tuple[Expr, ...]
    after: tuple[tuple[Symbol, Expr], ...]
    linear: bool
    equations: tuple[tuple[str, Expr], ...]
    energy: Expr
    start: tuple[Expr, ...]
