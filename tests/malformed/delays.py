"""Malformed problems with values of the past: what each gets wrong, and what the message must name."""

from __future__ import annotations

from codegen.errors import BoundaryError, CodegenError, ExpressionError, SizeError, SymbolError
from malformed.templates import Malformed, first_order, group, optimal, phased, simulation

_FIRST, _HISTORY = "{x: v, v: u + x.delayed(0.5)}", "{x: 1}"


def _past(id_: str, error: type[CodegenError], fragment: str, declare: str = "", **changes: str) -> Malformed:
    """A first-order system that reads its past."""
    changes = {"dynamics": _FIRST, "history": _HISTORY, "start": "{v: 0}"} | changes
    return Malformed(f"past-{id_}", first_order(declare, **changes), error, fragment)


def _lag(id_: str, error: type[CodegenError], fragment: str, lag: str, declare: str = "", **changes: str) -> Malformed:
    """A delay that cannot be."""
    return _past(id_, error, fragment, declare, dynamics=f"{{x: v, v: u + x.delayed({lag})}}", **changes)


MALFORMED_DELAYS = (
    _lag("zero", SymbolError, "broken.py:11: x.delayed(0) is no value of the past; give a positive delay", "0"),
    _lag("negative", SymbolError, "x.delayed(-0.5) is no value of the past", "-0.5"),
    _lag("infinite", ExpressionError, "the delay of x contains oo", "oo"),
    _lag("text", ExpressionError, "the delay of x is 'late'", "'late'"),
    _lag("of-state", SymbolError, "x.delayed(x**2) depends on x; give a number", "x**2"),
    _lag("of-time", SymbolError, "x.delayed(t/2) depends on t", "t/2", "t = time()"),
    _lag("free", SymbolError, "x.delayed(T/2) depends on T", "T/2", 'T = free_parameter("T", 1)'),
    _lag(
        "no-common-part",
        ExpressionError,
        "the delay tau of x is no fixed rational part of the duration 1",
        "tau",
        'tau = parameter("tau", 0.5)',
    ),
    _lag("irrational", ExpressionError, "is no fixed rational part of the duration 1; write the one", "sqrt(2)/2"),
    _lag("many-segments", SizeError, "the delay 0.371 of x in the duration 1 makes 1000 equal segments", "0.371"),
    _lag("nearest", SizeError, "0.333333 or 0.5 divide it", "0.371"),
    # 96 quantities are 32 segments of two states and a control; what divides the duration more often is no remedy.
    _lag(
        "too-short",
        SizeError,
        "where 32 can be derived; take a larger delay that divides the duration; 0.03125 divides it",
        "0.01",
    ),
    _lag(
        "negative-parameter",
        ExpressionError,
        "the delay -tau of x is no value of the past",
        "-tau",
        'tau = parameter("tau", 1)',
        duration="2*tau",
    ),
    _past(
        "free-duration",
        ExpressionError,
        "the duration T is free, and the delay 1/2 of x",
        duration="T",
        declare='T = free_parameter("T", 1, lower=0)',
    ),
    _past(
        "no-history",
        BoundaryError,
        "x.delayed(1/2) reaches before t = 0, and x has no history",
        history="{}",
        start="{x: 0, v: 0}",
    ),
    _past(
        "no-history-of-control",
        BoundaryError,
        "and u has no history; say what it was",
        history="{x: 1, v: 0}",
        dynamics="{x: v, v: u + u.delayed(1)}",
    ),
    _past("history-undeclared", SymbolError, "s in history of x was never declared", history="{x: Symbol('s')}"),
    _past(
        "history-of-state",
        ExpressionError,
        "history of x depends on v; use time, parameters and numbers only",
        history="{x: v}",
    ),
    _past(
        "history-of-parameter",
        SymbolError,
        "history gives m, which does not move",
        'm = parameter("m", 1)',
        history="{x: m, m: 1}",
    ),
    _past("history-of-nothing", SymbolError, "history gives u, which is never delayed", history="{x: 1, u: 0}"),
    _past("history-no-mapping", ExpressionError, "history is a int", history="1"),
    _past(
        "of-parameter",
        SymbolError,
        "m.delayed(1); m does not move",
        "m = parameter('m', 1)",
        dynamics="{x: v, v: u + m.delayed(1)}",
    ),
    _past("at-the-end", ExpressionError, "terminal_cost depends on x.delayed(1/2)", terminal_cost="x.delayed(0.5)"),
    _past("start-outside", BoundaryError, "start of x is 1, above its upper bound 0.5", bounds="{x: (0, 0.5)}"),
    Malformed(
        "past-lagrangian",
        optimal(lagrangian="dq**2/2 - q*q.delayed(0.5)", history="{q: 0}"),
        ExpressionError,
        "lagrangian depends on q.delayed(1/2); let values of the past act through force",
    ),
    Malformed(
        "past-velocity",
        optimal(force="{q: f - dq.delayed(0.5)}"),
        BoundaryError,
        "dq.delayed(1/2) reaches before t = 0, and q has no history",
    ),
    Malformed(
        "past-simulation",
        simulation(force="{q: -q.delayed(0.5)}"),
        ExpressionError,
        "q.delayed(1/2) in a simulation; return codegen.Control",
    ),
    Malformed(
        "past-bodies", group(force="{x: f - x.delayed(0.5), y: g}"), ExpressionError, "x.delayed(1/2) beside bodies=2"
    ),
    Malformed(
        "past-phases",
        phased(second={"dynamics": "{x: v, v: u - v.delayed(0.5)}"}),
        ExpressionError,
        "v.delayed(1/2) in a problem of phases",
    ),
    Malformed(
        "past-history-in-phases",
        phased(second={"history": "{v: 0}"}),
        ExpressionError,
        "history in a problem of phases; say by start",
    ),
    _past(
        "drawn",
        ExpressionError,
        "depends on x.delayed(1/2)",
        "from codegen.drawing import Mass",
        drawing="[Mass((x.delayed(0.5), 0), 1)]",
    ),
    _past("inner-times", ExpressionError, "at or waypoints beside the delay 1/2 of x", at="{0.25: [x >= 0]}"),
    _past("periodic", BoundaryError, "x.delayed(1/2) in a periodic motion", periodic="[v]", start="{}", end="{}"),
)
