"""Identical bodies that path conditions tie together: the same problem as with every body written out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from interpreted import of_problem
from sympy import Eq, Integer, cos, pi, sin

from codegen import (
    Control,
    body_number,
    canonical_pair,
    control,
    controls,
    coordinate,
    coordinates,
    parameters,
    states,
    time,
    together,
)
from codegen.discretise.model.from_problem import normalise
from codegen.drawing import Circle
from codegen.errors import CodegenError
from codegen.problem.bodies import has_path_couplings


def discs(**changes: Any) -> Control:
    """Three discs that change places around a circle."""
    (x, y), (vx, vy) = coordinates("x y", "vx vy")
    fx, fy = controls("fx fy")
    i, t = body_number(), time()
    T, d = parameters(T=2, d=0.5)
    a = 2 * pi * i / 3
    given: dict[str, Any] = {
        "path": [
            fx <= 9,
            *((x.of(j) - x.of(k)) ** 2 + (y.of(j) - y.of(k)) ** 2 >= d**2 for j in range(3) for k in range(j)),
        ],
        "guess": {x: cos(a + pi * t / T), y: sin(a + pi * t / T)},
    }
    return Control(
        **{
            "lagrangian": (vx**2 + vy**2) / 2,
            "force": {x: fx, y: fy},
            "cost": fx**2 + fy**2,
            "duration": T,
            "start": {x: cos(a), y: sin(a), vx: 0, vy: 0},
            "end": {x: -cos(a), y: -sin(a), vx: 0, vy: 0},
            "bodies": 3,
            "steps": 8,
            "drawing": [Circle((x, y), d / 2)],
            **given,
            **changes,
        }
    )


def by_hand() -> Control:
    T, d = parameters(T=2, d=0.5)
    t, bodies, places = time(), [], []
    for j in range(3):
        a = 2 * pi * Integer(j) / 3
        (x, y), (vx, vy) = coordinates(f"x_{j} y_{j}", f"vx_{j} vy_{j}")
        fx, fy = controls(f"fx_{j} fy_{j}")
        places.append((x, y))
        bodies.append(
            Control(
                lagrangian=(vx**2 + vy**2) / 2,
                force={x: fx, y: fy},
                cost=fx**2 + fy**2,
                duration=T,
                start={x: cos(a), y: sin(a), vx: 0, vy: 0},
                end={x: -cos(a), y: -sin(a), vx: 0, vy: 0},
                path=[fx <= 9],
                guess={x: cos(a + pi * t / T), y: sin(a + pi * t / T)},
                steps=8,
                drawing=[Circle((x, y), d / 2)],
            )
        )
    apart = [
        (places[j][0] - places[k][0]) ** 2 + (places[j][1] - places[k][1]) ** 2 >= d**2
        for j in range(3)
        for k in range(j)
    ]
    return together(*bodies, path=apart)


def test_the_model_is_that_of_bodies_written_by_hand():
    assert normalise(discs()) == normalise(by_hand())


@pytest.mark.slow
def test_discs_keep_their_distance():
    """Head-on, two discs must give way, which costs; the optimum touches the least distance."""
    (x, y), (vx, vy) = coordinates("x y")
    fx, fy = controls("fx fy")
    i, t = body_number(), time()
    side = 1 - 2 * i
    given: dict[str, Any] = {
        "lagrangian": (vx**2 + vy**2) / 2,
        "force": {x: fx, y: fy},
        "cost": fx**2 + fy**2,
        "duration": 2,
        "start": {x: -side, y: 0, vx: 0, vy: 0},
        "end": {x: side, y: 0, vx: 0, vy: 0},
        "guess": {x: side * (t - 1), y: side * t * (2 - t) / 4},
        "bodies": 2,
        "steps": 10,
    }
    free = of_problem(Control(**given)).solve()
    apart = of_problem(Control(**given, path=[(x.of(0) - x.of(1)) ** 2 + (y.of(0) - y.of(1)) ** 2 >= 0.25])).solve()
    assert (free.status, apart.status) == ("solved", "solved")
    q = apart.q.reshape(11, 2, 2)
    distances = np.linalg.norm(q[:, 0] - q[:, 1], axis=1)
    assert distances.min() == pytest.approx(0.5, abs=1e-7)
    assert np.linalg.norm(free.q[:, :2] - free.q[:, 2:], axis=1).min() < 1e-8
    assert apart.cost > free.cost * 1.05


@pytest.mark.parametrize("kind", ["states", "momenta", "start", "end inequality"])
def test_other_kinds_of_quantities_and_conditions(kind):
    if kind == "states":
        (x,), u = states("x"), control("u")
        problem = Control(dynamics={x: u}, cost=u**2, duration=1, bodies=2, path=[x.of(0) - x.of(1) <= 1])
    elif kind == "momenta":
        (x, p), u = canonical_pair("x", "p"), control("u")
        problem = Control(
            hamiltonian=p**2 / 2, force={x: u}, cost=u**2, duration=1, bodies=2, path=[Eq(x.of(0), x.of(1))]
        )
    else:
        (x, v), u = coordinate("x"), control("u")
        tie = {"start_conditions": [x.of(0) - x.of(1) - 1]} if kind == "start" else {"end_conditions": [x.of(0) >= 1]}
        problem = Control(lagrangian=v**2 / 2, force={x: u}, cost=u**2, duration=1, bodies=2, **tie)
    model = normalise(problem)
    assert [str(q) for q in model.coordinates] == ["x_0", "x_1"]
    assert model.bodies == 1
    assert len([*model.path, *model.start_conditions, *model.end_conditions]) == 1


def test_equations_at_the_end_stay_a_loop_over_bodies():
    (x, v), u = coordinate("x"), control("u")
    problem = Control(
        lagrangian=v**2 / 2, force={x: u}, cost=u**2, duration=1, bodies=2, end_conditions=[Eq(x.of(0), x.of(1))]
    )
    assert not has_path_couplings(problem)
    assert normalise(problem).bodies == 2


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (lambda x, v: [x.of(0) - x.of(3) <= 1], ["x.of(3) is no body", "raise bodies"]),
        (lambda x, v: [x.of(0) - x <= 1], ["has x of every body beside x_0 of one", ".of(...)"]),
        (lambda x, v: [x.of(0) + v <= 1], ["has dx of every body beside x_0 of one"]),
    ],
)
def test_what_cannot_be_tied_is_named(path, words):
    (x, v), u = coordinate("x"), control("u")
    problem = Control(lagrangian=v**2 / 2, force={x: u}, cost=u**2, duration=1, bodies=2, path=path(x, v))
    with pytest.raises(CodegenError) as error:
        normalise(problem)
    assert all(word in str(error.value) for word in words)
