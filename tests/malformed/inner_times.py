"""Malformed problem files: conditions at inner times, and waypoints."""

from __future__ import annotations

from codegen.errors import BoundaryError, ExpressionError, SymbolError
from malformed.templates import Malformed, file_text, first_order, optimal

_WAYPOINT = "from codegen import Waypoint"
_T = "T = free_parameter('T', 1)"


def _at(text: str, declare: str = "") -> str:
    return optimal(declare, at=text)


def _way(text: str, declare: str = _WAYPOINT, **changes: str) -> str:
    return optimal(declare, waypoints=text, **changes)


MALFORMED_INNER_TIMES: tuple[Malformed, ...] = (
    Malformed("at-list", _at("[q]"), ExpressionError, "at is a list"),
    Malformed("at-no-condition", _at("{0.5: []}"), ExpressionError, "at[0.5] has no condition"),
    Malformed("at-no-list", _at("{0.5: q - 1}"), ExpressionError, "at[0.5] is a single expression"),
    Malformed("at-true", _at("{True: [q]}"), ExpressionError, "a time of at is True"),
    Malformed("at-text", _at("{'half': [q]}"), ExpressionError, "a time of at is 'half'"),
    Malformed("at-nan", _at("{float('nan'): [q]}"), ExpressionError, "a time of at contains nan"),
    Malformed("at-infinite", _at("{oo: [q]}"), ExpressionError, "a time of at contains oo"),
    Malformed("at-zero", _at("{0: [q - 0.1]}"), BoundaryError, "the time 0 of at is 0, not after the start"),
    Malformed("at-negative", _at("{-1: [q - 0.1]}"), BoundaryError, "not after the start"),
    Malformed("at-end", _at("{1: [q - 0.1]}"), BoundaryError, "the time 1 of at is 1, not before the end, 1"),
    Malformed("at-late", _at("{k: [q - 0.1]}", "k = parameter('k', 3)"), BoundaryError, "the time k of at is 3, not"),
    Malformed("at-same", _at("{0.5: [q - 0.1], k: [dq]}", "k = parameter('k', 0.5)"), BoundaryError, "are the same"),
    Malformed("at-control", _at("{0.5: [f <= 1]}"), ExpressionError, "at[0.5] f <= 1 depends on f"),
    Malformed("at-free-time", _at("{p: [q]}", "p = free_parameter('p', 0.5)"), ExpressionError, "depends on p"),
    Malformed("at-unknown", _at("{0.5: [Symbol('z') - q]}"), SymbolError, "z in at[0.5]"),
    Malformed(
        "at-nothing-moves", _at("{0.5: [k <= 1]}", "k = parameter('k', 1)"), ExpressionError, "nothing that moves"
    ),
    Malformed("at-twice", _at("{0.5: [Eq(q, 0.2), q <= 1, Eq(q, 0.2)]}"), ExpressionError, "twice"),
    Malformed("at-dependent", _at("{0.5: [Eq(q, 0.2), Eq(2*q, 0.7)]}"), BoundaryError, "depend on each other"),
    Malformed(
        "at-on-path",
        first_order(path="[x - v]", at="{0.5: [2*x - 2*v - 1]}"),
        BoundaryError,
        "depend on each other",
    ),
    Malformed("at-beside", optimal(at="{0.5: [q]}", waypoints="[[q]]"), BoundaryError, "at beside waypoints"),
    Malformed("waypoints-mapping", _way("{0.5: [q]}"), ExpressionError, "waypoints is a dict"),
    Malformed("waypoints-flat", _way("[q - 1, dq]"), ExpressionError, "waypoints[0] is a single expression"),
    Malformed("waypoint-empty", _way("[[q - 0.1], []]"), ExpressionError, "waypoints[1] has no condition"),
    Malformed("window-number", _way("[Waypoint([q - 0.1], window=0.5)]"), ExpressionError, "is 0.5"),
    Malformed("window-three", _way("[Waypoint([q - 0.1], window=(0, 1, 2))]"), ExpressionError, "window=(earliest"),
    Malformed("window-nan", _way("[Waypoint([q], window=(float('nan'), 1))]"), ExpressionError, "contains nan"),
    Malformed("window-turned", _way("[Waypoint([q], window=(0.6, 0.4))]"), BoundaryError, "ends before it begins"),
    Malformed("window-moves", _way("[Waypoint([q], window=(0, q))]"), ExpressionError, "depends on q"),
    Malformed("window-at-start", _way("[Waypoint([q], window=(None, 0))]"), BoundaryError, "and the start at 0"),
    Malformed("window-late", _way("[Waypoint([q], window=(1.5, None))]"), BoundaryError, "1.5 or later, after the end"),
    Malformed(
        "windows-in-no-order",
        _way("[Waypoint([q], window=(0.5, None)), Waypoint([dq], window=(None, 0.4))]"),
        BoundaryError,
        "waypoint 2 is to be at 0.4 or before, and an earlier one at 0.5 or later",
    ),
    Malformed("waypoints-of-bodies", _way("[[q - 0.1]]", bodies="3"), BoundaryError, "waypoints beside bodies"),
    Malformed("waypoint-control", _way("[[f]]"), ExpressionError, "depends on f"),
    Malformed(
        "waypoints-in-phase",
        file_text(
            "q, dq = coordinate('q')\nf = control('f')\n"
            "m = dict(lagrangian=dq**2/2, force={q: f}, cost=f**2, duration=1)\n"
            "return Phases(Control(**m, start={q: 0}, at={0.5: [q - 1]}), Control(**m, end={q: 1}))"
        ),
        BoundaryError,
        "phase 1: it has conditions at inner times",
    ),
)
