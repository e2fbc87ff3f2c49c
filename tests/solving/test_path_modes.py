"""Path conditions on states where the scheme evaluates cost and dynamics: a sawtooth between nodes wins nothing.

Reference values are closed forms, or optima by CasADi 3.8.2 and IPOPT of the same discrete problem (tolerance 1e-12,
bounds not relaxed), written a second time by hand.
"""

import numpy as np
import pytest
from interpreted import of_problem
from sympy import Eq, Symbol, cos, pi, sin

from codegen import Control, controls, coordinates, parameters, states, time
from codegen.discretise.interval import at_nodes
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.transcribe import transcribe
from codegen.runtime.record import phrase


def resting(**how) -> Control:
    """Outside the unit circle at least cost, from a place on it back to that place: to stay is best, and costs 100."""
    x, y = states("x y")
    u, w = controls("u w")
    return Control(
        dynamics={x: u, y: w},
        cost=100 * (x**2 + y**2) + (u**2 + w**2) / 100,
        duration=1,
        start={x: 1, y: 0},
        end={x: 1, y: 0},
        path=[x**2 + y**2 >= 1],
        **how,
    )


def sawtooth(module, steps: int) -> np.ndarray:
    """Unknowns whose nodes jump across the circle, all outside it, with the middle of every interval inside."""
    grid = module.make_grid(steps)
    unknowns = module.initial_guess(grid)
    nodes, _ = module.views(grid, unknowns)
    nodes[0, 1:-1, 0] = 0.6
    nodes[0, 1:-1, 1] = 0.8 * (-1.0) ** np.arange(1, steps)
    return unknowns


@pytest.mark.parametrize(
    "steps", [pytest.param(10, marks=pytest.mark.slow), 21, pytest.param(40, marks=pytest.mark.slow)]
)
def test_a_sawtooth_wins_nothing(steps):
    """With the condition at nodes only, 4.0, 18.1 and 64.0 were called solved."""
    module = of_problem(resting())
    for guess in (None, sawtooth(module, steps)):
        solution = module.solve(steps, guess=guess, max_iterations=1000)
        assert solution.status == "solved", solution.message
        assert solution.cost == pytest.approx(100.0, rel=1e-9)
        middles = (solution.q[1:] + solution.q[:-1]) / 2
        for places in (solution.q, middles):
            assert np.hypot(*places.T).min() > 1.0 - 1e-7


@pytest.mark.parametrize(
    "scheme",
    [
        "trapezoidal",
        "implicit-euler",
        pytest.param("gauss-4", marks=pytest.mark.slow),
        pytest.param("hermite-simpson", marks=pytest.mark.slow),
    ],
)
def test_schemes_that_see_other_points(scheme):
    solution = of_problem(resting(), scheme=scheme).solve(20)
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(100.0, rel=1e-9)


@pytest.mark.slow
def test_multipliers_that_are_not_unique_come_to_rest():
    """Three conditions bind on an interval where two unknowns are free; IPOPT takes 6 to 9 iterations.

    Once primal unknowns rest but for rounding, no filter tells whether multipliers come closer: searches stalled, began
    anew and took up to 600 iterations, or ended in saddle points.
    """
    module = of_problem(resting(), scheme="gauss-4")
    for steps in (15, 25, 30, 50):
        solution = module.solve(steps)
        assert solution.status == "solved", solution.message
        assert solution.cost == pytest.approx(100.0, rel=1e-11)
        assert solution.iterations <= 30


@pytest.mark.slow
def test_around_a_disc():
    """A taut string: of length 2 sqrt(3) + pi/3, and the least integral of the squared speed is its square."""
    x, y = states("x y")
    u, w = controls("u w")
    t = time()
    module = of_problem(
        Control(
            dynamics={x: u, y: w},
            cost=u**2 + w**2,
            duration=1,
            start={x: -2, y: 0},
            end={x: 2, y: 0},
            path=[x**2 + y**2 >= 1],
            guess={x: 4 * t - 2, y: 3 * sin(pi * t) / 2},
        )
    )
    coarse, fine = module.solve(20), module.solve(100)
    assert coarse.status == fine.status == "solved"
    assert coarse.cost == pytest.approx(20.39137393290, rel=1e-9)  # CasADi and IPOPT
    assert fine.cost == pytest.approx((2 * np.sqrt(3) + np.pi / 3) ** 2, rel=1e-4)


def points(problem: Control, scheme: str, method: str | None = None) -> list[str]:
    """Where the path condition is imposed."""
    program = transcribe(normalise(problem), scheme, method)
    return [phrase(unknown.meaning).partition(" at ")[2] for unknown in program.interval[-program.path_multipliers :]]


MIDDLE, RIGHT = "1/2 of an interval", "1 of an interval"


@pytest.mark.parametrize(
    ("scheme", "expected"),
    [("midpoint", [MIDDLE, RIGHT]), ("trapezoidal", [RIGHT]), ("explicit-euler", [RIGHT]), ("implicit-euler", [RIGHT]),
     ("hermite-simpson", [MIDDLE, RIGHT])],
)  # fmt: skip
def test_points_of_a_forbidden_disc(scheme, expected):
    assert points(resting(), scheme) == expected


def test_points_that_follow_from_nodes():
    """Between two nodes inside a convex set the straight line is inside it: nothing is imposed twice."""
    x, y = states("x y")
    u, w = controls("u w")
    (size,) = parameters(size=2)

    def with_path(condition):
        return Control(
            dynamics={x: u, y: w}, cost=x + y + u**2 + w**2, duration=1, start={x: 0, y: 1}, path=[condition]
        )

    assert points(with_path(x + 2 * y <= size), "midpoint") == [RIGHT]
    assert points(with_path(x**2 + x * y + y**2 <= size), "midpoint") == [RIGHT]
    assert points(with_path(x**2 - y**2 <= size), "midpoint") == [MIDDLE, RIGHT]
    assert points(with_path(cos(x) <= size * y), "midpoint") == [MIDDLE, RIGHT]
    assert len(points(with_path(x + 2 * y <= size), "gauss-4")) == 3


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_coordinates_of_a_lagrangian(method):
    (x, y), (dx, dy) = coordinates("x y")
    f, g = controls("f g")
    problem = Control(
        lagrangian=(dx**2 + dy**2) / 2,
        force={x: f, y: g},
        cost=f**2 + g**2,
        duration=1,
        start={x: -2, y: 0, dx: 0, dy: 0},
        end={x: 2, y: 0, dx: 0, dy: 0},
        path=[x**2 + y**2 >= 1],
    )
    assert points(problem, "midpoint", method) == [MIDDLE, RIGHT]
    program = transcribe(normalise(problem), "midpoint", method)
    (left, right) = (at_nodes([Symbol("x")], suffix)[0] for suffix in ("_k", "_k1"))
    values = [e.value for e in program.equations if "x**2" in e.condition]
    middle, at_right = (value.diff(right) for value in values)
    assert middle.equals(-(left + right) / 2)
    assert at_right.equals(-2 * right)


def test_equalities_stay_at_nodes():
    x, y = states("x y")
    u, w = controls("u w")
    model = normalise(
        Control(dynamics={x: u, y: w}, cost=u**2 + w**2, duration=1, start={x: 1, y: 0}, path=[Eq(x**2 + y**2, 1)])
    )
    program = transcribe(model, "midpoint")
    assert program.path_multipliers == 0
    assert "y_1" in [unknown.name for unknown in program.node]
