"""Path equalities that first-order dynamics conserve: left out on the way, and told."""

import math

import pytest
from interpreted import of_problem
from sympy import Eq

from codegen import Control, control, controls, notes, states
from codegen.errors import BoundaryError
from codegen.model import normalise
from codegen.transcribe import transcribe


def circle(**changes) -> Control:
    """A point that is turned by a quarter from rest to rest; 12 (pi/2)^2 is the least integral of u^2."""
    (x, y, w), u = states("x y w"), control("u")
    given = {
        "dynamics": {x: -w * y, y: w * x, w: u}, "cost": u**2, "duration": 1,
        "start": {x: 1, y: 0, w: 0}, "end": {x: 0, y: 1, w: 0}, "path": {"radius": Eq(x**2 + y**2, 1)},
    }  # fmt: skip
    return Control(**(given | {name: value(x, y, w) for name, value in changes.items()}))


def quaternion() -> Control:
    """A body that is turned by a right angle about its first axis; all four components are given at both ends."""
    a, b, c, d, *rates = states("a b c d p q r")
    torques, (p, q, r) = controls("f g h"), rates
    turned = {
        a: -(b * p + c * q + d * r) / 2, b: (a * p + c * r - d * q) / 2,
        c: (a * q + d * p - b * r) / 2, d: (a * r + b * q - c * p) / 2,
    }  # fmt: skip
    rest = {p: 0, q: 0, r: 0}
    half = math.sqrt(0.5)
    return Control(
        dynamics={**turned, **dict(zip(rates, torques, strict=True))}, cost=sum(f**2 for f in torques), duration=1,
        start={a: 1, b: 0, c: 0, d: 0, **rest}, end={a: half, b: half, c: 0, d: 0, **rest},
        path=[Eq(a**2 + b**2 + c**2 + d**2, 1)],
    )  # fmt: skip


@pytest.mark.parametrize(("problem", "norm", "last"), [(circle, 2, "y"), (quaternion, 4, "a")])
def test_what_the_dynamics_conserve_is_left_out(problem, norm, last):
    module = of_problem(problem())
    errors = []
    for steps in (20, 40):
        solution = module.solve(steps)
        assert solution.status == "solved", solution.message
        assert (solution.q[:, :norm] ** 2).sum(axis=1) == pytest.approx(1.0, abs=1e-10)
        errors.append(solution.cost / (12 * (math.pi / 2) ** 2) - 1)
    assert abs(errors[1]) < 3e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    path, end = notes.notes(module.metadata)
    assert "follows from the dynamics and the start" in path
    assert end.startswith(f"{last} at the end follows from the path equalities")


def test_without_values_at_the_start_it_holds_there():
    problem = circle(start=lambda x, y, w: {y: 0.6, w: 0}, guess=lambda x, y, w: {x: 0.5})
    solution = of_problem(problem).solve(30)
    assert solution.status == "solved", solution.message
    assert solution.q[:, 0] ** 2 + solution.q[:, 1] ** 2 == pytest.approx(1.0, abs=1e-10)
    assert solution.q[0, 0] == pytest.approx(0.8, abs=1e-10)
    assert solution.cost == pytest.approx(12 * math.acos(0.6) ** 2, rel=3e-3)


@pytest.mark.parametrize(("where", "radius"), [("start", 0.75), ("end", 3)])
def test_values_that_violate_it_are_refused(where, radius):
    problem = circle(**{where: lambda x, y, w: {x: (1 + radius) ** 0.5, y: 0, w: 0}})
    with pytest.raises(BoundaryError, match=f"{where} violates radius by {radius}; correct one of them"):
        transcribe(normalise(problem))


def test_what_controls_can_change_stays():
    """With a push outwards the radius is no longer conserved."""
    u, v = controls("u v")
    problem = circle(
        dynamics=lambda x, y, w: {x: v * x - w * y, y: v * y + w * x, w: u}, cost=lambda x, y, w: u**2 + v**2
    )
    program = transcribe(normalise(problem))
    assert program.conserved == ()
    assert [g.name for g in program.model.path] == ["radius"]
