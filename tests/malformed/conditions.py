"""Malformed problem files: first-order dynamics, free parameters, bounds, conditions, constraints, several bodies."""

from __future__ import annotations

from codegen.errors import BoundaryError, DegenerateError, ExpressionError, ProblemFileError, SymbolError
from malformed.templates import Malformed, first_order, group, optimal, simulation

_K = "k = parameter('k', 1)"
_T = "T = free_parameter('T', 1)"
_TIME = "t = time()"
_PLANE = '(x, y), (dx, dy) = coordinates("x y")'


def plane(declare: str = "", **changes: str) -> str:
    """A sound control of a point in the plane, beside which the oscillator of the template moves as well."""
    arguments = {
        "lagrangian": "(dq**2 + dx**2 + dy**2)/2",
        "force": "{q: f}",
        "start": "{q: 0, dq: 0}",
        "end": "{q: 1, dq: 0}",
        **changes,
    }
    return optimal(f"{_PLANE}\n{declare}", **arguments)


_DYNAMICS = [
    Malformed("dynamics-beside-lagrangian", optimal(dynamics="{q: f}"), ExpressionError, "exactly one"),
    Malformed("dynamics-list", first_order(dynamics="[v, u]"), ExpressionError, "dynamics is a list"),
    Malformed("dynamics-empty", first_order(dynamics="{}"), ExpressionError, "dynamics lacks x, v"),
    Malformed("dynamics-incomplete", first_order(dynamics="{v: u}"), ExpressionError, "dynamics lacks x"),
    Malformed("dynamics-of-control", first_order(dynamics="{x: v, v: u, u: x}"), SymbolError, "dynamics gives u"),
    Malformed("dynamics-none", first_order(dynamics="{x: v, v: None}"), ExpressionError, "dynamics of v is None"),
    Malformed(
        "dynamics-of-coordinate", optimal(lagrangian="", dynamics="{q: dq, dq: f}"), SymbolError, "dq is a velocity"
    ),
    Malformed("dynamics-nowhere-real", first_order(dynamics="{x: sqrt(-1 - v**2), v: u}"), ExpressionError, "of x has"),
    Malformed("dynamics-and-force", first_order(force="{x: u}"), ExpressionError, "force beside dynamics"),
    Malformed(
        "dynamics-constraint",
        first_order(constraint="[x - v]"),
        ExpressionError,
        "constraint -v + x = 0 beside dynamics",
    ),
    Malformed("control-in-no-dynamics", first_order("w = control('w')", cost="w**2 + u**2"), SymbolError, "control w"),
    Malformed("state-in-lagrangian", optimal('x, = states("x")', cost="f**2 + x**2"), SymbolError, "x is a state"),
    Malformed(
        "simulation-of-dynamics-with-a-control",
        simulation('x, = states("x"); w = control("w")', lagrangian="", dynamics="{x: w - x}", start="{x: 1}"),
        SymbolError,
        "control w in a simulation",
    ),
    Malformed("states-none", first_order('states("")'), SymbolError, "''"),
    Malformed("no-cost", optimal(cost=""), ExpressionError, "neither cost nor terminal_cost"),
]

_FREE = [
    Malformed("free-guessed-only", optimal(_T, bounds="{T: (0, 2)}"), SymbolError, "T occurs in no expression"),
    Malformed("free-in-bound", optimal(_T, duration="T", bounds="{f: (0, T)}"), ExpressionError, "of f depends on T"),
    Malformed("free-in-constraint", plane(_T, constraint="[x - T]"), ExpressionError, "depends on T"),
    Malformed("free-in-simulation", simulation(_T, duration="T"), SymbolError, "free parameter T"),
    Malformed("free-key", optimal(_T, duration="T", guess="{T: 2}"), SymbolError, "guess gives T"),
    Malformed("free-fixed", optimal(_T, duration="T", end="{q: 1, T: 2}"), BoundaryError, "end fixes T"),
    Malformed("free-text", optimal("T = free_parameter('T', '1')", duration="T"), ExpressionError, "guess of T is '1'"),
    Malformed("free-nan", optimal("T = free_parameter('T', nan)", duration="T"), ExpressionError, "guess of T"),
    Malformed("free-of-state", optimal("T = free_parameter('T', q)", duration="T"), ExpressionError, "depends on q"),
    Malformed("free-order", optimal("T = free_parameter('T', 1, 2, 0)", duration="T"), BoundaryError, "lower bound 2"),
    Malformed("free-outside", optimal("T = free_parameter('T', 3, 0, 2)", duration="T"), BoundaryError, "guess of T"),
    Malformed(
        "free-twice-bounded",
        optimal("T = free_parameter('T', 1, lower=0)", duration="T", bounds="{T: (0, None)}"),
        ExpressionError,
        "two lower bounds",
    ),
    Malformed(
        "free-division",
        optimal("k = parameter('k', 0)\nT = free_parameter('T', 1/k)", duration="T"),
        ExpressionError,
        "guess of T is 1/k",
    ),
    Malformed("free-duration", optimal(_T, duration="T - 1"), ExpressionError, "duration is 0 at the first guess"),
    Malformed("free-undeclared", optimal("T = free_parameter('T', Symbol('k'))", duration="T"), SymbolError, "k in"),
]

_BOUNDS = [
    Malformed("bounds-list", optimal(bounds="[(q, 0, 1)]"), ExpressionError, "bounds is a list"),
    Malformed("bounds-number", optimal(bounds="{q: 1}"), ExpressionError, "bounds of q is 1"),
    Malformed("bounds-triple", optimal(bounds="{q: (0, 1, 2)}"), ExpressionError, "bounds of q is (0, 1, 2)"),
    Malformed("bounds-none", optimal(bounds="{q: (None, None)}"), ExpressionError, "neither a lower nor an upper"),
    Malformed("bounds-infinite", optimal(bounds="{f: (oo, 1)}"), ExpressionError, "lower bound of f"),
    Malformed("bounds-float-infinite", optimal(bounds="{f: (0, -float('inf'))}"), ExpressionError, "upper bound of f"),
    Malformed("bounds-text", optimal(bounds="{f: ('0', 1)}"), ExpressionError, "lower bound of f is '0'"),
    Malformed("bounds-of-state", optimal(bounds="{f: (0, q)}"), ExpressionError, "upper bound of f depends on q"),
    Malformed("bounds-of-time", optimal(_TIME, bounds="{f: (0, t)}"), ExpressionError, "upper bound of f depends on t"),
    Malformed("bounds-exchanged", optimal(bounds="{f: (1, -1)}"), BoundaryError, "f has the lower bound 1"),
    Malformed("bounds-equal", optimal(bounds="{f: (2, 2)}"), BoundaryError, "f has the lower bound 2"),
    Malformed("bounds-equal-of-control", optimal(bounds="{f: (2, 2)}"), BoundaryError, "make it a parameter of that"),
    Malformed("bounds-equal-of-state", optimal(bounds="{q: (0, 0)}"), BoundaryError, "hold it by a path equality"),
    Malformed("bounds-parameter", optimal(_K, bounds="{f: (k, -k)}"), BoundaryError, "f has the lower bound 1"),
    Malformed("bounds-velocity", optimal(bounds="{dq: (1, -1)}"), BoundaryError, "dq has the lower bound 1"),
    Malformed("bounds-divide", optimal(_K, bounds="{f: (0, 1/(k - 1))}"), ExpressionError, "upper bound of f"),
    Malformed("bounds-key", optimal(_K, bounds="{k: (0, 2)}"), SymbolError, "bounds gives k"),
    Malformed("bounds-text-key", optimal(bounds="{'q': (0, 2)}"), SymbolError, "'q'"),
    Malformed("bounds-of-unused", optimal('r, dr = coordinate("r")', bounds="{r: (0, 2)}"), DegenerateError, "dr"),
    Malformed("start-below-bound", optimal(bounds="{q: (0.5, 2)}"), BoundaryError, "start of q is 0, below"),
    Malformed("end-above-bound", optimal(bounds="{q: (None, 0.5)}"), BoundaryError, "end of q is 1, above"),
    Malformed("rate-outside-bound", optimal(bounds="{dq: (1, None)}"), BoundaryError, "start of dq is 0, below"),
]

_PATHS = [
    Malformed("path-single", optimal(path="q <= 1"), ExpressionError, "path is a single relation"),
    Malformed("path-set", optimal(path="{q <= 1}"), ExpressionError, "path is a set"),
    Malformed("path-text", optimal(path="['q <= 1']"), ExpressionError, "path[0] is 'q <= 1'"),
    Malformed("path-true", optimal(path="[q**2 >= 0]"), ExpressionError, "path[0] always holds"),
    Malformed("path-python-true", optimal(path="[1 <= 2]"), ExpressionError, "path[0] always holds"),
    Malformed("path-false", optimal(path="[q <= 1, q**2 < 0]"), ExpressionError, "path[1] never holds"),
    Malformed("path-chain", optimal(path="[0 <= q <= 2]"), ProblemFileError, "two inequalities, such as x >= 0 and x"),
    Malformed("path-zero", optimal(path="[q - q]"), ExpressionError, "always holds"),
    Malformed("path-compared", optimal(path="[q == 1]"), ExpressionError, "write Eq(a, b)"),
    Malformed("path-number", optimal(path="[3]"), ExpressionError, "3 = 0, never holds"),
    Malformed(
        "path-cancels", optimal(path="[Eq((q + 1)**2, q**2 + 2*q + 1)]"), ExpressionError, "q**2 + 2*q + 1, always"
    ),
    Malformed(
        "path-cancels-in-general", optimal(path="[sin(q)**2 + cos(q)**2 <= 2]"), ExpressionError, "depends on no"
    ),
    Malformed("path-unequal", optimal(path="[Ne(q, f)]"), ExpressionError, "write an inequality"),
    Malformed("path-and", optimal(path="[And(q <= 1, f <= 1)]"), ExpressionError, "path[0] joins relations by And"),
    Malformed("path-or", optimal(path="[Or(q <= 1, f <= 1)]"), ExpressionError, "path[0] joins relations by Or"),
    Malformed("path-chained", optimal(path="[0 <= q <= 1]"), ProblemFileError, "truth value"),
    Malformed("path-twice", optimal(path="[q <= 1, 1 >= q]"), ExpressionError, "twice"),
    Malformed("path-parameter", optimal(_K, path="[k <= 2]"), ExpressionError, "path k <= 2 depends on no"),
    Malformed("path-free", optimal(_T, duration="T", path="[T <= 2]"), ExpressionError, "limit free parameters"),
    Malformed("path-time", optimal(_TIME, path="[t <= 2]"), ExpressionError, "path t <= 2 depends on no"),
    Malformed("path-complex", optimal(path="[I*q <= 2]"), ExpressionError, "path[0] is complex"),
    Malformed("path-nowhere-real", optimal(path="[f + log(-1 - f**2)]"), ExpressionError, "no finite real"),
    Malformed("path-undeclared", optimal(path="[q <= Symbol('L')]"), SymbolError, "L in path q <= L"),
    Malformed("path-zeta", optimal(path="[zeta(q) <= 1]"), ExpressionError, "uses zeta"),
    Malformed("path-matrix", optimal(path="[Matrix([q])]"), ExpressionError, "path[0] is a"),
    Malformed("path-dependent", optimal(path="[f - q, 2*f - 2*q]"), DegenerateError, "depend on each other"),
    Malformed("path-at-start", optimal(path="[q >= 1]"), BoundaryError, "start violates q >= 1 by 1"),
    Malformed("path-at-end", optimal(_TIME, path="[q <= t/2]"), BoundaryError, "end violates q <= t/2 by 0.5"),
]

_CONDITIONS = [
    Malformed("condition-mapping", optimal(end_conditions="{q: 1}"), ExpressionError, "end_conditions has the name q"),
    Malformed("condition-control", optimal(end="{}", end_conditions="[q - f]"), ExpressionError, "depends on f"),
    Malformed("condition-time", optimal(_TIME, end="{}", end_conditions="[q - t]"), ExpressionError, "depends on t"),
    Malformed("condition-start-time", optimal(_TIME, start="{}", start_conditions="[q - t]"), ExpressionError, "on t"),
    Malformed("condition-parameter", optimal(_K, end_conditions="[k - 1]"), BoundaryError, "depends on no coordinate"),
    Malformed("condition-fixed", optimal(end_conditions="[q**2 - 1]"), BoundaryError, "end fixes already"),
    Malformed("condition-start-fixed", optimal(start_conditions="[q - dq]"), BoundaryError, "start fixes already"),
    Malformed(
        "condition-dependent",
        optimal(end="{}", end_conditions="[q + dq - 1, 2*q + 2*dq - 2]"),
        BoundaryError,
        "q + dq - 1 = 0 and 2*q + 2*dq - 2 = 0 depend",
    ),
    Malformed(
        "condition-too-many", optimal(end="{dq: 0}", end_conditions="[q - 1, q**2 - 1]"), BoundaryError, "depend on"
    ),
    Malformed("condition-violated", optimal(end_conditions="[q + dq <= 0]"), BoundaryError, "end violates q + dq <= 0"),
    Malformed("condition-always", optimal(start_conditions="[Eq(q, q)]"), ExpressionError, "always holds"),
    Malformed("terminal-control", optimal(terminal_cost="f"), ExpressionError, "terminal_cost depends on f"),
    Malformed("terminal-time", optimal(_TIME, terminal_cost="q*t"), ExpressionError, "time is the duration there"),
    Malformed("terminal-complex", optimal(terminal_cost="I*q"), ExpressionError, "terminal_cost is complex"),
    Malformed(
        "terminal-nowhere-real", optimal(terminal_cost="log(-1 - q**2)"), ExpressionError, "terminal_cost has no"
    ),
    Malformed("constraint-velocity", plane(constraint="[x*dy]"), ExpressionError, "depends on dy"),
    Malformed("constraint-control", plane(constraint="[x - f]"), ExpressionError, "depends on f"),
    Malformed("constraint-inequality", plane(constraint="[x <= y]"), ExpressionError, "is an inequality"),
    Malformed("constraint-not-list", plane(constraint="x - y"), ExpressionError, "constraint is a"),
    Malformed("constraint-time", plane(_TIME, constraint="[t - 1]"), DegenerateError, "depends on no coordinate"),
    Malformed("constraint-flat", plane(constraint="[sin(x)**2 + cos(x)**2 - y**0]"), DegenerateError, "no coordinate"),
    Malformed(
        "constraint-dependent", plane(constraint="[x - y, (x - y)*exp(x - y)]"), DegenerateError, "depend on each other"
    ),
    Malformed("constraint-all", plane(constraint="[x, y, q - 1]"), DegenerateError, "leave nothing to move"),
    Malformed(
        "constraint-at-start",
        plane(start="{q: 0, dq: 0, x: 1, y: 1}", constraint="[x**2 + y**2 - 1]"),
        BoundaryError,
        "start violates constraint",
    ),
    Malformed(
        "constraint-rate-at-start",
        plane(start="{x: 1, y: 0, dx: 1, dy: 0}", constraint="[x**2 + y**2 - 1]"),
        BoundaryError,
        "start violates the rate of constraint",
    ),
    Malformed("periodic-text", optimal(periodic="'q'"), ExpressionError, "periodic is a str"),
    Malformed("periodic-fixed", optimal(periodic="[q]"), BoundaryError, "start and end fix q, which is periodic"),
    Malformed("periodic-twice", optimal(start="{}", end="{}", periodic="[q, q]"), ExpressionError, "lists q twice"),
    Malformed("periodic-control", optimal(periodic="[f]"), BoundaryError, "periodic lists f"),
    Malformed("periodic-name", optimal(periodic="['q']"), SymbolError, "'q'"),
    Malformed(
        "periodic-shift-of-state", optimal(start="{}", end="{}", periodic="{q: dq}"), ExpressionError, "shift of q"
    ),
]

_BODIES = [
    Malformed("bodies-zero", group(bodies="0"), ExpressionError, "bodies is 0"),
    Malformed("bodies-fractional", group(bodies="2.0"), ExpressionError, "bodies is 2.0"),
    Malformed("bodies-truth", group(bodies="True"), ExpressionError, "bodies is True"),
    Malformed("body-too-large", group(bodies="1"), BoundaryError, "x.of(1) is no body"),
    Malformed("body-negative", group("x.of(-1)"), SymbolError, "x.of(-1)"),
    Malformed("body-fractional", group("x.of(0.5)"), SymbolError, "x.of(0.5)"),
    Malformed("body-in-cost", group(cost="body*f**2 + g**2"), ExpressionError, "cost depends on body"),
    Malformed("body-in-duration", group(duration="1 + body"), ExpressionError, "duration depends on body"),
    Malformed("body-in-path", group(path="[x <= body + 9]"), ExpressionError, "depends on body"),
    Malformed("body-in-velocity-bound", group(bounds="{dx: (0, body + 1)}"), ExpressionError, "bound of dx depends on"),
    Malformed("body-in-simulation", simulation("b = body_number()", start="{q: b, dq: 0}"), SymbolError, "body in a"),
    Malformed("body-and-free", group(_T, start="{x: T*body}", duration="T"), ExpressionError, "body and on the free"),
    Malformed("body-start-division", group(start="{x: 1/(1 - body)}"), ExpressionError, "start of x is"),
    Malformed("body-bound-exchanged", group(bounds="{f: (0, 1 - 2*body)}"), BoundaryError, "f has the lower bound 0"),
    Malformed("body-start-outside", group(bounds="{x: (None, 0.5)}"), BoundaryError, "start of x is 1, above"),
    Malformed(
        "coupling-outside",
        group(cost="f**2 + x.of(0)**2"),
        ExpressionError,
        "use x.of(0) in end_conditions and path only",
    ),
    Malformed("coupling-in-end", group(end="{dy: x.of(0)}"), ExpressionError, "end of dy depends on x_0"),
    Malformed("coupling-in-start", group(start_conditions="[x.of(0) - y]"), ExpressionError, "has y of every body"),
    Malformed(
        "coupling-fixed", group(end="{x: 1, dx: 0, dy: 0}"), BoundaryError, "x.of(0) is x of body 0 at the end, and end"
    ),
    Malformed(
        "coupling-inequality", group(end_conditions="[x.of(0) <= 1]", bodies="1"), BoundaryError, "by an inequality"
    ),
    Malformed(
        "coupling-mixed", group(end_conditions="[x.of(0) - y]"), ExpressionError, "has y of every body beside x_0"
    ),
    Malformed("coupling-velocity", group(end_conditions="[x.of(0) - dx]"), ExpressionError, "has dx of every body"),
    Malformed(
        "coupling-cancels", group(end_conditions="[sin(x.of(0))**2 + cos(x.of(0))**2 - 1]"), BoundaryError, "nothing"
    ),
    Malformed("coupling-of-velocity", group(end_conditions="[dx.of(0)]"), ProblemFileError, "AttributeError"),
]

MALFORMED_CONDITIONS: tuple[Malformed, ...] = (*_DYNAMICS, *_FREE, *_BOUNDS, *_PATHS, *_CONDITIONS, *_BODIES)
