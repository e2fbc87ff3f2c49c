"""Derivatives by time of what moves: sympy takes symbols for constants, so that the author has to be told."""

from __future__ import annotations

import inspect

import pytest
import sympy
from malformed.templates import Malformed, optimal
from refused_files import refusal

from codegen import (
    Control,
    attitude,
    body_number,
    canonical_pair,
    control,
    coordinate,
    free_parameter,
    parameter,
    rotation,
    state,
    time,
)
from codegen.discretise.model.from_problem import load_problem
from codegen.errors import ExpressionError
from codegen.problem import symbols
from codegen.problem.particles import ParticleQuantity, particles
from codegen.problem.symbols import Quantity

T = time()
Q, DQ = coordinate("q")
Z, P = canonical_pair("z", "p")
X, U = state("x"), control("u")
MASS = parameter("m", 2)
TURNING, TURNED = (min(R.free_symbols, key=str) for R in (rotation("R")[0], attitude("A")))
MOVING = {
    symbols.Coordinate: (Q, "use its velocity dq"),
    symbols.Velocity: (DQ, "dynamics={q: dq, dq: a}"),
    symbols.Momentum: (P, "less the derivative of the Hamiltonian by z"),
    symbols.State: (X, "the expression that dynamics={x: ...} gives"),
    symbols.ControlInput: (U, "declare the rate as the control and u as a state: dynamics={u: du, ...}"),
    symbols.Delayed: (Q.delayed(MASS), "use its velocity dq, and delay that"),
    symbols.EndValue: (X.of(1), "dynamics={x: ...}"),
    type(TURNING): (TURNING, "use its velocity dR_w"),
    type(TURNED): (TURNED, "the expression that dynamics={A_w: ...} gives"),
    ParticleQuantity: (particles("x y", "px py")[0].q[0], "without rates"),
}
AT_REST = {
    symbols.Parameter: MASS,
    symbols.FreeParameter: free_parameter("tau", 1),
    symbols.BodyNumber: body_number(),
    symbols.Time: T,
}


def kinds(parent=Quantity):
    """Every class of declared symbols without classes under it."""
    for kind in parent.__subclasses__():
        yield from kinds(kind) if kind.__subclasses__() else [kind]


def test_every_kind_of_symbol_is_tried():
    assert {*MOVING, *AT_REST} == {*kinds(), symbols.Coordinate, symbols.State}


@pytest.mark.parametrize(("symbol", "remedy"), MOVING.values(), ids=[kind.__name__ for kind in MOVING])
@pytest.mark.parametrize(
    "differentiate",
    [
        lambda x: sympy.diff(x, T),
        lambda x: x.diff(T),
        lambda x: sympy.Derivative(x, T),
        lambda x: x.diff(T, 2),
        lambda x: (x**2 * sympy.sin(T)).diff(T),
        lambda x: sympy.diff(MASS * x, x, T),
        lambda x: sympy.Matrix([T, x]).diff(T),
        lambda x: sympy.Matrix([T * x]).jacobian([T]),
        lambda x: sympy.diff(sympy.Array([x, T]), T),
        lambda x: sympy.Piecewise((x, T > 1), (T, True)).diff(time()),
        lambda x: sympy.diff(sympy.sqrt(1 + x**2), time(unit="min")),
    ],
    ids=range(11),
)
def test_a_derivative_of_what_moves_is_refused(differentiate, symbol, remedy):
    with pytest.raises(ExpressionError) as refused:
        differentiate(symbol)
    assert f"sympy takes {symbol} for a constant" in refused.value.finding
    assert remedy in refused.value.remedy


def test_the_quantity_that_was_declared_first_is_named():
    with pytest.raises(ExpressionError, match="takes q for a constant; use its velocity dq"):
        sympy.diff(U * Q, T)


@pytest.mark.parametrize("symbol", AT_REST.values(), ids=[kind.__name__ for kind in AT_REST])
def test_functions_of_time_are_differentiated(symbol):
    assert sympy.diff(symbol**2 * sympy.sin(3 * T), T).subs(T, 0) == (0 if symbol == T else 3 * symbol**2)


def test_other_derivatives_of_what_moves_are_taken():
    energy = MASS * DQ**2 / 2 + U * sympy.cos(T) * Q
    assert sympy.diff(energy, Q) == U * sympy.cos(T)
    assert sympy.hessian(energy, [DQ, U, Q])[0, 0] == MASS


def test_a_known_path_is_followed_by_its_rate(tmp_path):
    """The path sin(3 t), in the rates of a cost: what a module minimises has 3 cos(3 t) in it."""
    arguments = {"lagrangian": "dq**2/2", "force": "{q: f}", "cost": "f**2 + (dq - sin(3*time()).diff(time()))**2"}
    path = tmp_path / "path.py"
    path.write_text(optimal(**arguments))
    model = load_problem(path)
    assert sympy.simplify(model.cost.subs(dict(zip((*model.rates, *model.controls), (0, 0), strict=True)))) == (
        9 * sympy.cos(3 * model.time) ** 2
    )


# Every argument of a control, and of what stands in one, in which an author writes expressions.
CONTROL = {
    "lagrangian": "dq**2/2 + RATE",
    "hamiltonian": "RATE",
    "dynamics": "{q: RATE}",
    "force": "{q: f + RATE}",
    "duration": "1 + RATE",
    "start": "{q: RATE, dq: 0}",
    "drawing": "[Circle((RATE, 0), 1)]",
    "cost": "f**2 + 100*RATE**2",
    "terminal_cost": "RATE",
    "end": "{q: RATE}",
    "maximise": "RATE",
    "terminal_maximise": "RATE",
    "start_conditions": "[dq - RATE]",
    "end_conditions": "[Eq(dq, RATE)]",
    "bounds": "{f: (-1, 1 + RATE)}",
    "path": '{"limit": RATE <= 1}',
    "integral": "[Eq(RATE, 1)]",
    "at": "{0.5: [Eq(q, RATE)]}",
    "waypoints": "[[Eq(q, RATE)]]",
    "constraint": "[q - RATE]",
    "rolling": "[dq - RATE]",
    "unilateral": "[q + RATE >= 0]",
    "friction": "RATE",
    "slip": "[dq - RATE]",
    "periodic": "{q: RATE}",
    "history": "{q: RATE}",
    "observations": 'Measurements("m.csv", time="t", values={RATE: "x"}, sigma=1)',
    "guess": "{q: RATE}",
    "scale": "{q: 1 + RATE}",
}
INSIDE = {
    "table": ("cost", 'f**2 + Table("m.csv", inputs="x", output="y")(RATE)'),
    "delay": ("cost", "q.delayed(RATE)"),
}
"""Other places where expressions are written, which end in an argument."""
WITHOUT = {"bodies", "steps"}
"""Arguments that are whole numbers."""


def test_every_argument_is_tried():
    assert {*inspect.signature(Control).parameters} - WITHOUT == set(CONTROL)


@pytest.mark.parametrize(("argument", "text"), [*CONTROL.items(), *INSIDE.values()], ids=[*CONTROL, *INSIDE])
@pytest.mark.parametrize(
    ("rate", "end"),
    [
        ("diff(f, time())", "sympy takes f for a constant; declare the rate as the control and f as a state: "
                            "dynamics={f: df, ...}"),
        ("(q*f).diff(time())", "sympy takes q for a constant; use its velocity dq"),
    ],
)  # fmt: skip
def test_every_argument_of_a_problem_refuses_a_rate(tmp_path, argument, text, rate, end):
    lines = "from codegen import Measurements, Table\nfrom codegen.drawing import Circle"
    files = (("m.csv", "x,y\n0,0\n1,1\n2,4\n3,9\n"),)
    written = optimal(lines, **{argument: text.replace("RATE", rate)})
    error = refusal(Malformed("rate", written, ExpressionError, end, files).write(tmp_path))
    assert type(error) is ExpressionError
    assert str(error).endswith(end)
