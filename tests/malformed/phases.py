"""Malformed problem files of several phases."""

from __future__ import annotations

from codegen.errors import BoundaryError, ExpressionError, ProblemFileError, SymbolError
from malformed.templates import Malformed, file_text, phased

_OSCILLATOR = 'q, dq = coordinate("q")\nf = control("f")\n'
_MOTION = "lagrangian=dq**2/2, force={q: f}, cost=f**2, duration=1"

MALFORMED_PHASES: tuple[Malformed, ...] = (
    Malformed("phases-none", phased(phases="Phases()"), ProblemFileError, "a single phase"),
    Malformed("phases-single", phased(phases="Phases(first)"), ProblemFileError, "a single phase"),
    Malformed("phases-list", phased(phases="Phases([first, second])"), ProblemFileError, "phase 1 is a list"),
    Malformed("phases-nested", phased(phases="Phases(first, Phases(second, second))"), ProblemFileError, "is a Phases"),
    Malformed(
        "phases-simulation",
        file_text(
            f"{_OSCILLATOR}move = Simulate(lagrangian=dq**2/2, duration=1, start={{q: 0, dq: 1}})\n"
            f"return Phases(Control({_MOTION}, start={{q: 0}}), move)"
        ),
        ProblemFileError,
        "phase 2 is a Simulate",
    ),
    Malformed("phases-unknown-keyword", phased(phases="Phases(first, second, jump=[])"), ProblemFileError, "'jump'"),
    Malformed(
        "phases-of-two-forms",
        file_text(
            f'{_OSCILLATOR}x, = states("x")\n'
            f"return Phases(Control({_MOTION}, start={{q: 0}}), Control(dynamics={{x: f}}, cost=f**2, duration=1))"
        ),
        ExpressionError,
        "phase 1 is given by lagrangian, phase 2 by dynamics",
    ),
    Malformed("phases-formless", phased(second={"dynamics": ""}), ExpressionError, "phase 2: a problem needs exactly"),
    Malformed("phases-steps", phased(second={"steps": "7"}), ExpressionError, "phase 2 has 7"),
    Malformed("phases-states", phased(second={"dynamics": "{x: u}", "end": "{x: 2}"}), SymbolError, "phase 2: v of an"),
    Malformed("phases-state-underived", phased(second={"dynamics": "{x: v}"}), ExpressionError, "phase 2: dynamics la"),
    Malformed("phases-no-cost", phased(first={"cost": ""}, second={"cost": ""}), ExpressionError, "neither cost"),
    Malformed(
        "phases-later-start", phased(second={"start": "{x: 1}"}), BoundaryError, "phase 2: it says how it starts"
    ),
    Malformed(
        "phases-later-start-condition", phased(second={"start_conditions": "[x - v]"}), BoundaryError, "jumps[0]"
    ),
    Malformed("phases-periodic", phased(second={"periodic": "[v]", "end": "{x: 2}"}), BoundaryError, "is periodic"),
    Malformed("phases-periodic-remedy", phased(second={"periodic": "[v]", "end": "{x: 2}"}), BoundaryError, "Eq(v, V)"),
    Malformed(
        "phases-all-periodic", phased(phases="Phases(first, second, periodic=[v])"), ProblemFileError, "Eq(v, V)"
    ),
    Malformed("phases-common-steps", phased(phases="Phases(first, second, steps=5)"), ProblemFileError, "each Control"),
    Malformed("phases-bodies", phased(first={"bodies": "2"}), ExpressionError, "phase 1: bodies is 2"),
    Malformed("phases-body", phased("b = body_number()", first={"start": "{x: b, v: 0}"}), SymbolError, "body belongs"),
    Malformed("phases-of-body", phased(second={"end_conditions": "[x.of(0)]", "end": "{v: 0}"}), SymbolError, "x.of"),
    Malformed(
        "phases-constraint",
        file_text(
            f'(x, y), (dx, dy) = coordinates("x y")\n{_OSCILLATOR}'
            f"motion = dict(lagrangian=(dx**2 + dy**2 + dq**2)/2, force={{q: f}}, cost=f**2, duration=1)\n"
            f"return Phases(Control(**motion, constraint=[x - y]), Control(**motion))"
        ),
        ExpressionError,
        "constraint x - y holds in one of the phases 1 and 2",
    ),
    Malformed("phases-path-equality", phased(second={"path": "[x - v]"}), BoundaryError, "fixes coordinates"),
    Malformed("phases-later-drawing", phased(second={"drawing": "[1]"}), ExpressionError, "a drawing"),
    Malformed(
        "phases-same-name",
        phased('T = free_parameter("T", 1)\nS = parameter("T", 1)', {"duration": "T"}, {"duration": "S"}),
        SymbolError,
        "called T",
    ),
    Malformed(
        "phases-two-times",
        phased('t, s = time(), time("s")', {"cost": "t*u**2"}, {"cost": "s*u**2"}),
        SymbolError,
        "t, s",
    ),
    Malformed(
        "phases-idle-control", phased('w = control("w")', second={"cost": "w**2"}), SymbolError, "control w is in no"
    ),
    Malformed("phases-duration", phased(second={"duration": "-1"}), ExpressionError, "phase 2: duration is -1"),
    Malformed(
        "phases-duration-of-state", phased(first={"duration": "x"}), ExpressionError, "phase 1: duration depends"
    ),
    Malformed("phases-undeclared", phased(second={"cost": 'Symbol("w")*u**2'}), SymbolError, "w in cost"),
    Malformed("jumps-mapping", phased(jumps="{v: -v}"), ExpressionError, "jumps is a dict"),
    Malformed("jumps-too-many", phased(jumps="[{}, {v: -v}]"), ExpressionError, "2 entries for 1 switches"),
    Malformed("jumps-list", phased(jumps="[[v]]"), ExpressionError, "jumps[0] is a list"),
    Malformed("jumps-none", phased(jumps="[None]"), ExpressionError, "jumps[0] is a NoneType"),
    Malformed("jumps-text-key", phased(jumps="[{'v': 0}]"), SymbolError, "'v'"),
    Malformed("jumps-text", phased(jumps="[{v: '-v'}]"), ExpressionError, "jumps[0] of v is '-v'"),
    Malformed("jumps-of-control", phased(jumps="[{u: 0}]"), BoundaryError, "let states jump only"),
    Malformed("jumps-by-control", phased(jumps="[{v: v + u}]"), ExpressionError, "jumps[0] of v depends on u"),
    Malformed("jumps-by-time", phased("t = time()", jumps="[{v: v + t}]"), ExpressionError, "depends on t"),
    Malformed("jumps-identity", phased(jumps="[{v: v}]"), ExpressionError, "jumps[0] of v is its value before"),
    Malformed("jumps-undeclared", phased(jumps='[{v: -Symbol("e")*v}]'), SymbolError, "e in jumps[0] of v"),
    Malformed("jumps-nowhere-real", phased(jumps="[{v: sqrt(-1 - v**2)}]"), ExpressionError, "jumps[0] of v has no"),
    Malformed("jumps-foreign", phased('y, = states("y")', jumps="[{y: 1}]"), SymbolError, "y of another phase"),
    Malformed(
        "phases-bounds-apart",
        phased(first={"bounds": "{v: (None, 1)}"}, second={"bounds": "{v: (2, None)}", "end": "{x: 2}"}),
        BoundaryError,
        "leave no value at the switch from phase 1 to phase 2",
    ),
    Malformed(
        "phases-bounds-touch",
        phased(first={"bounds": "{v: (None, 1)}"}, second={"bounds": "{v: (1, None)}", "end": "{x: 2}"}),
        BoundaryError,
        "leave one value",
    ),
    Malformed(
        "phases-given-outside",
        phased(first={"end": "{x: 1}"}, second={"bounds": "{x: (1.5, None)}"}),
        BoundaryError,
        "x is 1 at the switch from phase 1 to phase 2, outside its bounds 1.5",
    ),
    Malformed(
        "phases-free-twice-bounded",
        phased(
            'T = free_parameter("T", 1)',
            {"duration": "T", "bounds": "{T: (0.5, None)}"},
            {"duration": "T", "bounds": "{T: (0.6, None)}"},
        ),
        ExpressionError,
        "T has two lower bounds",
    ),
    Malformed(
        "phases-end-violates-path",
        phased("t = time()", second={"path": "[x <= 1 + t/4]"}),
        BoundaryError,
        "phase 2: end violates x <= t/4 + 1 by 0.5",
    ),
)
