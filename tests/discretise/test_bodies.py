"""Several different bodies in one problem: what `together` makes of them, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sympy import Symbol

from codegen import (
    Control,
    Phases,
    canonical_pair,
    control,
    coordinate,
    coordinates,
    free_parameter,
    parameters,
    states,
    together,
)
from codegen.discretise.model.from_problem import normalise
from codegen.errors import CodegenError
from codegen.problem.symbols import Coordinate


def cart(name: str, **changes: Any) -> tuple[Coordinate, Control]:
    """A driven cart with a coordinate of that name."""
    q, dq = coordinate(name)
    u = control(f"u_{name}")
    arguments = {
        "lagrangian": dq**2 / 2,
        "force": {q: u},
        "cost": u**2,
        "duration": 1,
        "start": {q: 0, dq: 0},
        "end": {q: 1},
        "end_conditions": [dq],
        "bounds": {u: (-9, 9)},
        **changes,
    }
    return q, Control(**arguments)


def test_bodies_add_up_to_the_problem_that_one_would_write_by_hand() -> None:
    a, first = cart("a")
    b, second = cart("b", end={}, terminal_cost=2)
    both = together(first, second, interaction=-((a - b) ** 2), cost=a**2, path=[a - b <= 1], end_conditions=[a - b])

    (a, b), (da, db) = coordinates("a b")
    u_a, u_b = control("u_a"), control("u_b")
    by_hand = Control(
        lagrangian=(da**2 + db**2) / 2 - (a - b) ** 2,
        force={a: u_a, b: u_b},
        cost=u_a**2 + u_b**2 + a**2,
        terminal_cost=2,
        duration=1,
        start={a: 0, b: 0, da: 0, db: 0},
        end={a: 1},
        end_conditions=[da, db, a - b],
        bounds={u_a: (-9, 9), u_b: (-9, 9)},
        path=[a - b <= 1],
    )
    assert normalise(both) == normalise(by_hand)


def test_hamiltonians_and_dynamics_add_up_too() -> None:
    (q, p), (r, s) = canonical_pair("q", "p"), canonical_pair("r", "s")
    moves = {"duration": 1, "cost": 1}
    both = together(Control(hamiltonian=p**2, **moves), Control(hamiltonian=s**2 + r, **moves), interaction=q * r)
    assert both.hamiltonian == p**2 + s**2 + r + q * r
    x, y = states("x y")
    both = together(Control(dynamics={x: -x}, **moves), Control(dynamics={y: x - y}, **moves))
    assert both.dynamics == {x: -x, y: x - y}
    assert both.cost == 2


def test_a_free_duration_may_be_common() -> None:
    T = free_parameter("T", guess=1)
    assert together(cart("a", duration=T)[1], cart("b", duration=T)[1]).duration == T


def refused(what: str) -> Control:
    """Bodies that do not fit together."""
    q, first = cart("a")
    _, second = cart("b")
    x = states("x")[0]
    (k,) = parameters(k=1)
    rates = Control(dynamics={x: -x}, cost=1, duration=1)
    other_rates = Control(dynamics={states("y")[0]: 1}, cost=1, duration=1)
    makers: dict[str, Any] = {
        "one body": lambda: together(first),
        "no body": together,
        "no control problem": lambda: together(first, Phases(first, second)),
        "another form": lambda: together(first, rates),
        "no form": lambda: together(first, Control(duration=1)),
        "another duration": lambda: together(first, cart("c", duration=k)[1]),
        "another number of steps": lambda: together(first, cart("c", steps=7)[1]),
        "several bodies in one": lambda: together(first, cart("c", bodies=3)[1]),
        "the same body twice": lambda: together(first, first),
        "a common coordinate": lambda: together(first, cart("c", lagrangian=q**2)[1]),
        "two starts": lambda: together(first, cart("c", start={q: 3})[1]),
        "no mapping": lambda: together(first, cart("c", start=[q])[1]),
        "no expression": lambda: together(first, cart("c", cost="u**2")[1]),
        "interaction beside dynamics": lambda: together(rates, other_rates, interaction=x),
        "a plain symbol": lambda: together(first, second, interaction=Symbol("z")),
    }
    return makers[what]()


@pytest.mark.parametrize(
    ("what", "finding"),
    [
        ("one body", "together(...) has 1 bodies"),
        ("no body", "together(...) has 0 bodies"),
        ("no control problem", "body 1 is a Phases"),
        ("another form", "body 0 is given by lagrangian, body 1 by dynamics"),
        ("no form", "exactly one of lagrangian, hamiltonian and dynamics"),
        ("another duration", "duration is 1 for body 0 and k for body 1"),
        ("another number of steps", "steps is 100 for body 0 and 7 for body 1"),
        ("several bodies in one", "body 1 stands for 3 bodies"),
        ("the same body twice", "bodies 0 and 1 both have a"),
        ("a common coordinate", "bodies 0 and 1 both have a"),
        ("two starts", "start of a is given twice: 0 and 3"),
        ("no mapping", "start of body 1 is a list"),
        ("no expression", "cost is 'u**2'"),
        ("interaction beside dynamics", "interaction beside dynamics"),
        ("a plain symbol", "z in lagrangian was never declared"),
    ],
)
def test_refusals_name_the_body(what: str, finding: str) -> None:
    with pytest.raises(CodegenError) as caught:
        normalise(refused(what))
    assert finding in str(caught.value)
    assert caught.value.remedy


def least_effort(steps: int, mass: float, velocity: float, distance: float) -> float:
    """h times the squared forces, one for each of N intervals, that stop a mass after a distance within one unit.

    Forces of the midpoint rule act with one half at either node, where momentum and place are linear in them.
    """
    h = 1 / steps
    places = 1 - h * (np.arange(steps) + 0.5)
    influence = h / mass * np.array([np.ones(steps), places])
    force = np.linalg.lstsq(influence, np.array([-velocity, distance - velocity]), rcond=None)[0]
    return h * float(force @ force)


def test_bodies_that_nothing_ties_move_as_they_would_alone(interpreted: Any) -> None:
    steps, weight = 10, 1.0
    solution = interpreted("convoy").solve(steps, R=100.0)
    trolley = least_effort(steps, 2.0, 0.0, 2.0)
    # The weight is a force of its own, which the rotors make up for: f_y = weight + what moves the drone.
    h = 1 / steps
    places = 1 - h * (np.arange(steps) + 0.5)
    influence = h * np.array([np.ones(steps), places])
    extra = np.array([-4.0, -4.0]) + influence @ np.full(steps, weight)
    f_y = np.linalg.lstsq(influence, extra, rcond=None)[0]
    drone = least_effort(steps, 1.0, -4.0, 2.0) + h * float(f_y @ f_y)
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(trolley + drone, rel=1e-9)
