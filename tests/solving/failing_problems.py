"""Control problems that cannot be solved: what is wrong with each, how it must end, and what the message must name."""

from __future__ import annotations

from dataclasses import dataclass

HEAD = '''"""A problem without a solution."""
from sympy import Eq, Rational, exp, log, sin, sqrt
from codegen import Control, body_number, control, controls, coordinate, coordinates, free_parameter, states, time
def problem():
'''


@dataclass(frozen=True)
class Failing:
    """A problem file's body, the status word that is right for it, and parts of the message: rows, places, remedies."""

    id: str
    body: str
    status: str
    fragments: tuple[str, ...]

    @property
    def text(self) -> str:
        """The problem file."""
        return HEAD + "".join(f"    {line}\n" for line in self.body.strip().splitlines())


def mass(declare: str = "", **changes: str) -> str:
    """A unit mass that is pushed over a unit of length in a unit of time, from rest to rest."""
    arguments = {
        "dynamics": "{x: v, v: u}",
        "cost": "u**2",
        "duration": "1",
        "start": "{x: 0, v: 0}",
        "end": "{x: 1, v: 0}",
        "steps": "6",
        **changes,
    }
    return f'x, v = states("x v")\nu = control("u")\n{declare}\n{_returned(arguments)}'


def plane(declare: str = "", **changes: str) -> str:
    """A point mass in the plane that is pushed in both directions and comes to rest somewhere."""
    arguments = {
        "lagrangian": "(dx**2 + dy**2)/2",
        "force": "{x: f, y: g}",
        "cost": "f**2 + g**2",
        "duration": "1",
        "start": "{x: 1, y: 0, dx: 0, dy: 0}",
        "end": "{dx: 0, dy: 0}",
        "steps": "6",
        **changes,
    }
    symbols = '(x, y), (dx, dy) = coordinates("x y")\nf, g = controls("f g")'
    return f"{symbols}\n{declare}\n{_returned(arguments)}"


def row(conditions: str) -> str:
    """Three bodies on a line."""
    arguments = {
        "lagrangian": "v**2/2",
        "force": "{x: u}",
        "cost": "u**2",
        "duration": "1",
        "bodies": "3",
        "start": "{x: body_number(), v: 0}",
        "end": "{v: 0}",
        "steps": "4",
        "end_conditions": conditions,
    }
    return f'x, v = coordinate("x")\nu = control("u")\n{_returned(arguments)}'


def _returned(arguments: dict[str, str]) -> str:
    given = ", ".join(f"{name}={value}" for name, value in arguments.items() if value)
    return f"return Control({given})"


_RELAX = "relax a condition or bound"

INFEASIBLE = [
    Failing(
        "thrust-too-small",
        mass(bounds="{u: (-1, 1)}"),
        "infeasible",
        ("the step of x on interval 0 (t = 0) is off by 1.2e-01", "bounds active on u", _RELAX),
    ),
    Failing(
        "speed-limit",
        mass(bounds="{v: (-0.5, 0.5)}"),
        "infeasible",
        ("the step of x on interval", "bounds active on v", _RELAX),
    ),
    Failing(
        "path-inequality-out-of-reach",
        mass(path="[x + v <= 0.5]", end="{x: 1}"),
        "infeasible",
        ("v + x <= 0.5 at 1 of interval", _RELAX),
    ),
    Failing(
        "path-equality-against-ends",
        mass(path="[Eq(v, x**2 + 0.5)]", start="{x: 0}", end="{x: 0}"),
        "infeasible",
        ("v = x**2 + 0.5 at node", "19 equations for 18 unknowns", _RELAX),
    ),
    Failing(
        "end-condition-without-solution",
        plane(end_conditions="[Eq(x**2 + y**2 + x*y + 1, 0)]"),
        "infeasible",
        ("x**2 + x*y + y**2 + 1 = 0 at the end is off by 1.0e+00", _RELAX),
    ),
    Failing(
        "circles-that-do-not-meet",
        plane(end_conditions="[Eq(x**2 + y**2, 1), Eq((x - 3)**2 + y**2, 1)]"),
        "infeasible",
        ("x**2 + y**2 = 1 at the end is off by", "y**2 + (x - 3)**2 = 1 at the end is off by", _RELAX),
    ),
    Failing(
        "constraint-that-the-start-cannot-meet",
        plane(constraint="[x**2 + y**2 - 4]", start="{x: 3, dx: 0, dy: 0}", end="{x: 0}"),
        "infeasible",
        ("the constraint x**2 + y**2 - 4 at node 0 (t = 0) is off by", _RELAX),
    ),
    Failing(
        "distances-of-three-bodies",
        row("[Eq((x.of(0) - x.of(1))**2, 1), Eq((x.of(1) - x.of(2))**2, 1), Eq((x.of(0) - x.of(2))**2, 9)]"),
        "infeasible",
        ("(x_0 - x_2)**2 = 9 is off by", _RELAX),
    ),
    Failing(
        "too-few-intervals",
        mass(steps="1"),
        "infeasible",
        ("the step of x on interval 0", "2 equations for 1 unknown", "the steps"),
    ),
    Failing(
        "nothing-that-moves-it",
        'x, v = states("x v")\nT = free_parameter("T", 1.5, lower=0.1)\n'
        "return Control(dynamics={x: v, v: -x}, terminal_cost=T, duration=T, start={x: 0, v: 0}, end={x: 1, v: 0},"
        " steps=20)",
        "infeasible",
        ("the step of x on interval", "40 equations for 39 unknowns", _RELAX),
    ),
]

RANK_DEFICIENT = [
    Failing(
        "condition-without-slope",
        plane(end_conditions="[Eq((x - 2)**2, 0)]"),
        "rank-deficient",
        ("(x - 2)**2 = 0 at the end", "run codegen check"),
    ),
    Failing(
        "two-controls-for-one",
        mass('w = control("w")', dynamics="{x: v, v: u + w}", cost="(u + w)**2"),
        "rank-deficient",
        ("the cost does not change along", "on interval", "give every control a cost"),
    ),
]

DEPENDENT_END = Failing(  # w is v^2, which the midpoint rule keeps exactly
    "end-value-that-follows-from-others",
    mass('w, = states("w")', dynamics="{x: v, v: u, w: 2*v*u}", start="{x: 0, v: 0, w: 0}", end="{x: 1, v: 1, w: 1}"),
    "rank-deficient",
    ("the step of v on interval", "the step of w on interval", "leave out a condition"),
)
"""Has a solution, whose multipliers are not unique; rounding decides whether it is found."""

UNBOUNDED = [
    Failing(
        "as-far-as-possible",
        mass(cost="", terminal_cost="-x", end="{}"),
        "unbounded",
        ("the cost falls for ever along u on interval", "add bounds"),
    ),
    Failing("reward-for-effort", mass(cost="-u**2", end="{}"), "unbounded", ("along u on interval", "check the sign")),
    Failing(
        "reward-for-effort-of-a-pendulum",
        mass(cost="-u**2", dynamics="{x: v, v: u - sin(x)}", end="{}", guess="{u: 1}"),
        "unbounded",
        ("u on interval", "has grown to", "check the sign"),
    ),
    Failing(
        "reward-for-effort-against-a-wall",
        mass(cost="-u**2", end="{}", bounds="{x: (0, None)}"),
        "unbounded",
        ("u on interval", "has grown to", "check the sign"),
    ),
    Failing(
        "the-longer-the-easier",
        mass('T = free_parameter("T", 1, lower=0.01)', duration="T"),
        "unbounded",
        ("T has grown to", "add bounds"),
    ),
    Failing(
        "the-longer-the-better",
        mass('T = free_parameter("T", 1, lower=0.01)', terminal_cost="-T", duration="T"),
        "unbounded",
        ("T has grown to", "add bounds"),
    ),
    Failing(
        "no-least-duration",
        mass('T = free_parameter("T", 1, lower=-10)', cost="", terminal_cost="T", duration="T"),
        "unbounded",
        ("a duration has become -", "needs a lower bound"),
    ),
]

NON_FINITE = [
    Failing(
        "logarithm-in-the-guess",
        mass(guess="{x: log(time() - 2)}"),
        "non-finite",
        ("the initial guess of x at node 1 (t = 0.167) is nan", "change the guess"),
    ),
    Failing(
        "logarithm-in-the-cost",
        mass(cost="u**2 + log(x - 0.1)", end="{x: 1}"),
        "non-finite",
        ("the cost is nan on interval 0 (kernel interval_gradient)", "change the guess"),
    ),
    Failing(
        "logarithm-at-the-end",
        mass(terminal_cost="log(v - 1)", end="{x: 1}"),
        "non-finite",
        ("the cost is nan at the end (kernel end_gradient)", "change the guess"),
    ),
    Failing(
        "root-in-a-path-constraint",
        mass(path="[sqrt(x - 0.5) + u <= 5]", end="{x: 1}"),
        "non-finite",
        ("u + sqrt(x - 0.5) <= 5 at 1/2 of interval 0 (t = 0) is nan", "change the guess"),
    ),
    Failing(
        "division-by-zero",
        mass(cost="u**2 + 1/(x - 0.25)**2", end="{x: 1}", guess="{x: time()}"),
        "non-finite",
        ("by x at node 1 (t = 0.167) is -inf (kernel interval_gradient)", "change the guess"),
    ),
    Failing(
        "overflow",
        mass(cost="u**2 + exp(1000*x)", end="{x: 1}"),
        "non-finite",
        ("by x at node 4 (t = 0.667) is inf (kernel interval_gradient)", "change the guess"),
    ),
    Failing(
        "second-derivative",
        mass(dynamics="{x: v, v: u + u**Rational(3, 2)}", end="{x: 1}", guess="{x: 0}"),
        "non-finite",
        ("a second derivative by", "is not finite (kernel interval_hessian)", "change the guess"),
    ),
]

STEEP = Failing(
    "too-steep-for-a-hundred-iterations",
    mass(cost="u**2 + exp(200*x)", end="{x: 1}"),
    "iteration limit",
    ("the derivative of the Lagrangian by x at node", "raise --max-iterations"),
)
"""Solved where it may take some hundred iterations."""

FAILING = [*INFEASIBLE, *RANK_DEFICIENT, *UNBOUNDED, *NON_FINITE]
