"""Path conditions and bounds that are met at an end by what is prescribed there, and periodic states with bounds.

Reference values are closed forms of the discrete problems, or optima by CasADi 3.8.2 and IPOPT of the same discrete
problem (tolerance 1e-12, bounds not relaxed), written a second time by hand.
"""

import numpy as np
import pytest
from interpreted import of_problem
from sympy import Eq, sin

from codegen import Control, control, states, time
from codegen.errors import BoundaryError
from codegen.solving.results import output

LEAST = 6 * 400 / 399
"""The discrete cost of the midpoint rule from rest at 1 to rest at 0 in unit time: 6 N^2/(N^2 - 1), N = 20."""


def to_rest(kind: str, limit: float = 0.0) -> Control:
    x, v = states("x v")
    u = control("u")
    how = {
        "path": {"end": {x: 0, v: 0}, "path": [x >= limit]},
        "bound": {"end": {x: 0, v: 0}, "bounds": {x: (limit, None)}},
        "bound met by equations": {"end_conditions": [Eq(x, v), Eq(v, 0)], "bounds": {x: (limit, None)}},
        "path met by equations": {"end_conditions": [Eq(x + v, 0), Eq(v, 0)], "path": [x >= limit]},
        "path met by one value": {"end": {v: 0}, "end_conditions": [Eq(2 * x, v)], "path": [x >= limit]},
        "the same expression": {
            "end": {v: 0}, "end_conditions": [Eq((x + 1) ** 2, 1)], "path": [(x + 1) ** 2 >= (1 + limit) ** 2]
        },
    }  # fmt: skip
    return Control(
        dynamics={x: v, v: u}, cost=u**2 / 2, duration=1, start={x: 1, v: 0}, guess={x: 1}, steps=20, **how[kind]
    )


KINDS = ["path", "bound met by equations", "path met by equations", "path met by one value", "the same expression"]


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_condition_that_is_met_with_equality_at_the_end(kind, scheme):
    module = of_problem(to_rest(kind), scheme=scheme)
    solution = module.solve()
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(LEAST, rel=1e-9)
    assert solution.q[-1] == pytest.approx([0, 0], abs=1e-9)
    (note,) = output.notes(module.metadata)
    assert note.endswith("holds with equality at the end, by what is prescribed there, and was left out")


def test_a_bound_needs_no_note_where_the_value_is_given():
    module = of_problem(to_rest("bound"))
    assert module.solve().cost == pytest.approx(LEAST, rel=1e-9)
    assert output.notes(module.metadata) == []


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_prescribed_beyond_a_limit_is_refused(kind):
    with pytest.raises(BoundaryError, match=r"the end violates .*|end violates .*"):
        of_problem(to_rest(kind, limit=0.25))


def test_a_value_beyond_a_limit_at_run_time_is_named():
    module = of_problem(to_rest("path"))
    solution = module.solve(end={"x": -0.3})
    assert solution.status == "infeasible"
    assert "what is prescribed at the end violates x >= 0" in solution.message
    assert module.solve(end={"x": 0.2}).status == "solved"


def test_a_limit_that_nothing_meets_holds_at_a_free_end():
    x, v = states("x v")
    u = control("u")
    module = of_problem(
        Control(
            dynamics={x: v, v: u}, cost=u**2 / 2 + 100 * x, duration=1, start={x: 1, v: 0}, end={v: 0},
            path=[x**2 >= 0.25], guess={x: 1}, steps=20,
        )
    )  # fmt: skip
    solution = module.solve()
    assert solution.status == "solved", solution.message
    assert solution.q[:, 0].min() == pytest.approx(0.5, abs=1e-7)
    assert output.notes(module.metadata) == []


@pytest.mark.parametrize("guess", [2.0, 0.5, -0.5, 0.0, -40.0])
def test_a_periodic_state_with_bounds(guess):
    """The value at the start, that at the end and the unknown that they share are one."""
    (x,) = states("x")
    u, t = control("u"), time()
    module = of_problem(
        Control(
            dynamics={x: u}, cost=(x - sin(t)) ** 2 + u**2 / 10, duration=2 * np.pi, periodic=[x], guess={x: guess},
            bounds={x: (-0.5, 0.5)}, steps=40,
        )
    )  # fmt: skip
    solution = module.solve()
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(0.6992896217268563, rel=1e-9)  # CasADi and IPOPT
    assert solution.q[0] == solution.q[-1]
    assert np.abs(solution.q).max() <= 0.5 + 1e-7
