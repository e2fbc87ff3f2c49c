"""What transcription of a simulation produces: one step, solved explicitly as far as possible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sympy import Expr, Symbol

from codegen.model import Model
from codegen.transcribe.program import BoundaryValue, Unknown


@dataclass(frozen=True)
class StepProgram:
    """An initial value problem: one step from the left node (q_k, p_k) to the right node (q_k1, p_k1).

    `equations` are the scheme's equations as a textbook writes them, expressions that must vanish, in the symbols of
    the left node, of inner stages and of the right node; `summary` says in formulas where they come from. Solving
    them takes three parts: `before` are explicit assignments in order, `unknowns` with `residual` are what is left
    for Newton's method (none for an explicit scheme; `linear` when one linear solve will do), `after` are explicit
    assignments that follow. Where a mass matrix is large, `guess` and `energy` may read `state_assignments`, which
    depend on the left node alone. `velocities` are unknowns in place of positions, each with the two positions of
    which it is the divided difference and the time between them. `guess` starts Newton's method. `energy` is the
    Hamiltonian at the left node; `start` holds the initial (q, p) in terms of the parameters and of the symbols of
    `start_values`.

    Of a composition all this is one step of its base, whose lengths are the symbols `lengths`; `fractions` has a row
    for each step of the base with these lengths in parts of the whole step. Otherwise the only length is h, and there
    are no fractions.
    """

    model: Model
    method: str
    scheme: str
    order: int
    state: tuple[Unknown, ...]
    left_symbols: tuple[Symbol, ...]
    velocities: tuple[tuple[Symbol, Symbol, Symbol, Expr], ...]
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
    lengths: tuple[Symbol, ...]
    fractions: tuple[tuple[Expr, ...], ...] = ()
    state_assignments: tuple[tuple[Symbol, Expr], ...] = ()

    controlled: ClassVar[str] = "interval"
    holonomic_multipliers: ClassVar[tuple[Unknown, ...]] = ()
    """Where controls would live, and of constraints what optimisations alone have."""

    def in_time(self, expression: Expr) -> Expr:
        """An expression of t and h, which are times as they stand."""
        return expression

    def controls_of(self, control: Symbol) -> tuple[Symbol, ...]:
        """Where a control lives: a simulation has none."""
        return ()
