"""Functions that are singular at the guess are told at build, and only those that are so all along it."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import of_problem
from made_records import control_record
from sympy import Abs, acos, exp, log, sqrt

from codegen import Control, controls, coordinate, states, time
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.model.values import singular_at_guess
from codegen.discretise.transcribe import transcribe
from codegen.emit.differentiation import derivatives
from codegen.emit.lower import lower
from codegen.solving.results.output import notes

x, y = states("x y")
a, b = controls("a b")


def problem(cost=a**2, rate=a, end_y=0, **more) -> Control:
    return Control(
        dynamics={x: rate, y: b}, cost=cost, duration=2, start={x: 0, y: 0}, end={x: 1, y: end_y}, steps=4, **more
    )


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (problem(log(a), guess={a: 0}), [("log(a)", "value", "a = 0")]),
        (problem(log(-a)), [("log(-a)", "value", "a = 0")]),  # one is no better
        (problem(sqrt(a**2 + b**2)), [("sqrt(a**2 + b**2)", "slope", "a = 0, b = 0")]),
        (problem(rate=a + 1 / b, guess={b: 0}), [("1/b", "value", "b = 0")]),
        (problem((a**2 + b**2) ** 1.5), [("(a**2 + b**2)**(3/2)", "curvature", "a = 0, b = 0")]),
        (problem(acos(a), guess={a: 1}), [("acos(a)", "slope", "a = 1")]),
        (problem(path=[sqrt(a**2 + b**2) <= 1]), [("sqrt(a**2 + b**2)", "slope", "a = 0, b = 0")]),
        (problem(sqrt(a**2 + b**2), guess={a: 1}), []),
        (problem(log(a), bounds={a: (0, None)}), []),  # optimisers begin inside
        (problem(log(a), bounds={a: (-1, 0.5)}), []),
        (problem(rate=sqrt(x) + a), []),  # zero at the start alone, where no scheme evaluates for long
        (problem(rate=sqrt(y) + a), [("sqrt(y)", "slope", "y = 0")]),
        (problem(rate=sqrt(y) + a, end_y=1), []),
        (problem(a**2 * exp(-x) + Abs(a) + 1 / (1 + a**2)), []),
    ],
    ids=lambda one: "" if isinstance(one, list) else str(one.cost),
)
def test_singular_functions(given, expected):
    assert list(singular_at_guess(normalise(given))) == expected


def test_controls_are_guessed_where_functions_of_them_have_a_value():
    given = problem(-log(a) + sqrt(b), rate=a + 1 / b)
    assert {u.name: value for u, value in normalise(given).guess} == {"a": 1, "b": 1}
    assert not normalise(problem(log(a), bounds={a: (0, None)})).guess


def consumption() -> Control:
    """Eat of a cake with discounted logarithmic utility: from 1 to 1/2, as exp(-t / 10) says, in the course of 10."""
    t = time()
    return Control(dynamics={x: -a}, maximise=exp(-t / 10) * log(a), duration=10, start={x: 1}, end={x: 0.5}, steps=40)


def test_a_logarithm_of_a_control_needs_no_guess():
    """With the multiplier c of the constant total, a = exp(-t / 10) c, c = 1 / 20 / (1 - exp(-1))."""
    solution = of_problem(consumption()).solve()
    assert solution.status == "solved", solution.message
    middles = 0.25 * np.arange(40) + 0.125
    assert np.abs(solution.u[:, 0] / (np.exp(-middles / 10) / 20 / (1 - np.exp(-1))) - 1).max() < 1e-4


def test_velocities_are_those_of_the_guess():
    """A path length whose guess rests has no slope; of one that moves it has."""
    (q, dq), (r, dr) = coordinate("q"), coordinate("r")

    def length(end: float) -> Control:
        return Control(
            lagrangian=(dq**2 + dr**2) / 2,
            force={q: a, r: b},
            cost=sqrt(dq**2 + dr**2),
            duration=1,
            start={q: 0, r: 0},
            end={q: end, r: 0},
            steps=4,
        )

    assert [one[2] for one in singular_at_guess(normalise(length(0)))] == ["dq = 0, dr = 0"]
    assert singular_at_guess(normalise(length(1))) == ()


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_values_at_the_ends_count_whatever_the_method(method):
    """1/r has a value on the line from 5 to 6, although the Hamiltonian's ends are written otherwise."""
    (q, dq), (r, dr) = coordinate("q"), coordinate("r")
    orbit = Control(
        lagrangian=(dr**2 + r**2 * dq**2) / 2 + 1 / r,
        force={q: a, r: b},
        cost=a**2 + b**2,
        duration=1,
        start={q: 0, r: 5, dq: 1, dr: 0},
        end={q: 1, r: 6, dq: 1, dr: 0},
        steps=4,
    )
    program = transcribe(normalise(orbit), None, method)
    assert lower(program, derivatives(program)).metadata.singular_at_guess == ()


def test_note():
    root, logarithm = notes(
        control_record(singular_at_guess=(("sqrt(a**2 + b**2)", "slope", "a = 0, b = 0"), ("log(c)", "value", "c = 0")))
    )
    assert root.startswith("sqrt(a**2 + b**2) has no finite slope at the guess, a = 0, b = 0,")
    assert root.endswith("for a length in the cost, a control c >= 0 in its place with path a**2 + b**2 <= c**2")
    assert "give another guess" in logarithm
    assert "control" not in logarithm
