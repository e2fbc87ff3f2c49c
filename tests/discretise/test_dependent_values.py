"""Values at the ends that follow from path equalities, found by the rank of all equations."""

import numpy as np
import pytest
from dense_assembly import DenseProblem
from interpreted import of_problem
from sympy import Eq

from codegen import Control, controls, coordinates, states, time
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.transcribe import transcribe
from codegen.errors import BoundaryError
from codegen.solving.results import output


def together(**how) -> Control:
    """Two carts that stay side by side from rest to rest: 12 N^2/(N^2 - 1) is the least integral of (f^2 + g^2)/2."""
    (x, y), (dx, dy) = coordinates("x y")
    f, g = controls("f g")
    given = {
        "lagrangian": (dx**2 + dy**2) / 2, "force": {x: f, y: g}, "cost": (f**2 + g**2) / 2, "duration": 1,
        "start": {x: 0, y: 0, dx: 0, dy: 0}, "end": {x: 1, y: 1, dx: 0, dy: 0}, "path": [y - x],
    }  # fmt: skip
    return Control(**(given | {name: value(x, y, dx, dy) for name, value in how.items()}))


def states_together() -> Control:
    x, y, v, w = states("x y v w")
    f, g = controls("f g")
    return Control(
        dynamics={x: v, y: w, v: f, w: g}, cost=(f**2 + g**2) / 2, duration=1, start={x: 0, y: 0, v: 0, w: 0},
        end={x: 1, y: 1, v: 0, w: 0}, path=[Eq(x, y)],
    )  # fmt: skip


LAGRANGIAN = [("variational", s) for s in ("midpoint", "trapezoidal", "rectangle", "gauss-4")]
HAMILTONIAN = [("hamiltonian", s) for s in ("midpoint", "stormer-verlet", "gauss-4", "implicit-euler")]


@pytest.mark.parametrize(("method", "scheme"), [*LAGRANGIAN, *HAMILTONIAN])
def test_velocities_at_the_end(method, scheme):
    program = transcribe(normalise(together()), scheme, method)
    assert (program.start.dependent, program.end.dependent) == ((), ("dy",))
    for steps in (4, 5):
        dense = DenseProblem(program, steps)
        assert dense.condition_number(dense.initial()) < 1e7
        z = dense.newton(dense.initial())
        assert dense.at_nodes(z, "x") == pytest.approx(dense.at_nodes(z, "y"), abs=1e-11)
        if scheme == "midpoint":
            assert dense.cost(z) == pytest.approx(12 * steps**2 / (steps**2 - 1), rel=1e-9)


@pytest.mark.parametrize(
    ("scheme", "left_out"),
    [("midpoint", ((), ("w",))), ("trapezoidal", ((), ("w",))), ("explicit-euler", (("w",), ()))],
)
def test_states(scheme, left_out):
    """An explicit step decides the velocity at the start: x and y would part by h (v - w) in it."""
    program = transcribe(normalise(states_together()), scheme)
    assert (program.start.dependent, program.end.dependent) == left_out
    module = of_problem(states_together(), scheme=scheme)
    solution = module.solve(6)
    assert solution.status == "solved", solution.message
    assert solution.q[:, 3] == pytest.approx(solution.q[:, 2], abs=1e-10)
    (note,) = output.notes(module.metadata)
    where = "start" if left_out[0] else "end"
    assert (
        note == f"w at the {where} follows from the path equalities with the other values at the ends, and was left out"
    )


@pytest.mark.parametrize(
    "how",
    [
        {"end": lambda x, y, dx, dy: {x: 1, y: 1}},
        {"end": lambda x, y, dx, dy: {x: 1, y: 1, dx: 0}},
        {"start": lambda x, y, dx, dy: {x: 0, y: 0}},
    ],
)
def test_what_does_not_follow_stays(how):
    program = transcribe(normalise(together(**how)))
    assert (program.start.dependent, program.end.dependent) == ((), ())
    dense = DenseProblem(program, 5)
    assert dense.condition_number(dense.initial()) < 1e6


def test_a_free_end_and_a_moving_path():
    t = time()
    free = transcribe(normalise(together(end=lambda x, y, dx, dy: {x: 1, dx: 0, dy: 0})))
    assert free.end.dependent == ("dy",)
    drifting = together(
        start=lambda x, y, dx, dy: {x: 0, y: 0, dx: 1, dy: 2},
        end=lambda x, y, dx, dy: {x: 1, y: 2, dx: 1, dy: 2},
        path=lambda x, y, dx, dy: [y - x - t],
    )
    solution = of_problem(drifting).solve(6)
    assert (solution.status, solution.cost) == ("solved", pytest.approx(0.0, abs=1e-12))
    assert solution.p[-1] == pytest.approx([1, 2], abs=1e-9)


def test_an_end_condition_that_repeats_the_path():
    problem = together(end=lambda x, y, dx, dy: {x: 1}, end_conditions=lambda x, y, dx, dy: [Eq(x, y)])
    program = transcribe(normalise(problem))
    assert program.end.dependent == ("-x + y = 0",)
    dense = DenseProblem(program, 5)
    assert np.isfinite(dense.newton(dense.initial())).all()


def test_a_contradiction_is_refused():
    with pytest.raises(BoundaryError, match=r"dy at the end contradicts -x [+] y = 0"):
        transcribe(normalise(together(end=lambda x, y, dx, dy: {x: 1, y: 1, dx: 0, dy: 1})))


def test_a_curved_path_leaves_nothing_out():
    """Along a circle the normals turn, and prescribed velocities at both ends are independent of each other."""
    t = time()
    problem = together(
        start=lambda x, y, dx, dy: {x: 1, y: 0, dx: 0, dy: 0},
        end=lambda x, y, dx, dy: {x: 0, y: 1, dx: 0, dy: 0},
        path=lambda x, y, dx, dy: [x**2 + y**2 - 1],
        guess=lambda x, y, dx, dy: {x: 1 - t, y: t},
    )
    program = transcribe(normalise(problem))
    assert (program.start.dependent, program.end.dependent) == ((), ())
    assert of_problem(problem).solve(10).status == "solved"
