"""Holonomic constraints: pendulums in Cartesian coordinates against the same in angles."""

from dataclasses import replace

import numpy as np
import pytest
from dense_assembly import DenseProblem
from dense_layout import pinned_names
from sympy import cos, sin

import codegen
from codegen import Control, control, controls, coordinate, coordinates, parameters, time
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.transcribe import transcribe
from codegen.errors import ArgumentError, BoundaryError, DegenerateError
from codegen.runtime.search.grid import holding_forces, views
from codegen.solving.loading import load

FROM, TO, SPEED = 0.3, 1.2, 0.5


def solved(problem: Control, steps: int, scheme: str = "midpoint"):
    dense = DenseProblem(transcribe(normalise(problem), scheme, "variational"), steps)
    return dense, dense.newton(dense.initial())


def angle_pendulum() -> Control:
    """Swing a pendulum of unit mass and length by a torque."""
    th, w = coordinate("th")
    u = control("u")
    (g,) = parameters(g=9.81)
    return Control(
        lagrangian=w**2 / 2 + g * cos(th), force={th: u}, cost=u**2 / 2, duration=1,
        start={th: FROM, w: 0}, end={th: TO, w: SPEED},
    )  # fmt: skip


def point(angle):
    return np.sin(angle), -np.cos(angle)


def cartesian_pendulum(end=("x", "y", "dx", "dy"), start=("x", "y", "dx", "dy")) -> Control:
    """The same in the plane; ends give what is listed, which determines angle and speed."""
    (x, y), (dx, dy) = coordinates("x y")
    u = control("u")
    g, length = parameters(g=9.81, l=1)
    symbols = {"x": x, "y": y, "dx": dx, "dy": dy}
    values = [
        {"x": point(a)[0], "y": point(a)[1], "dx": np.cos(a) * w, "dy": np.sin(a) * w}
        for a, w in ((FROM, 0), (TO, SPEED))
    ]
    return Control(
        lagrangian=(dx**2 + dy**2) / 2 - g * y, force={x: -u * y, y: u * x}, cost=u**2 / 2, duration=1,
        start={symbols[name]: values[0][name] for name in start}, end={symbols[name]: values[1][name] for name in end},
        constraint=[(x**2 + y**2 - length**2) / 2], guess={y: -0.8},
    )  # fmt: skip


@pytest.fixture(scope="module")
def exact_swing():
    costs = [dense.cost(z) for dense, z in (solved(angle_pendulum(), n) for n in (40, 80))]
    return (4 * costs[1] - costs[0]) / 3


def test_lagrangian_may_be_singular_across_a_constraint(exact_swing):
    """A rotation's kinetic energy says nothing of what the constraint forbids, as with quaternions of a rigid body."""
    problem, errors = cartesian_pendulum(), []
    x, y, dx, dy = (next(s for s in problem.start if s.name == name) for name in ("x", "y", "dx", "dy"))
    problem = replace(problem, lagrangian=(x * dy - y * dx) ** 2 / 2 - 9.81 * y)
    for steps in (10, 20):
        dense, z = solved(problem, steps)
        assert dense.at_nodes(z, "x") ** 2 + dense.at_nodes(z, "y") ** 2 == pytest.approx(1, abs=1e-12)
        errors.append(abs(dense.cost(z) - exact_swing))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.25)


def hanging_load(mass: float = 0.3) -> Control:
    """Carry a load on a rope of length 0.8 by a cart, from rest to rest."""
    (s, x, y), (ds, dx, dy) = coordinates("s x y")
    u = control("u")
    (m,) = parameters(m=mass)
    rest = {s: 0, x: 0, y: -0.8, ds: 0, dx: 0, dy: 0}
    return Control(
        lagrangian=ds**2 / 2 + m * (dx**2 + dy**2) / 2 - m * 9.81 * y, force={s: u}, cost=u**2, duration=3, start=rest,
        end=rest | {s: 1, x: 1}, constraint=[((x - s) ** 2 + y**2 - 0.64) / 2], steps=40,
    )  # fmt: skip


def test_constraint_forces_of_a_guess_hold_the_load():
    """The tension per length is m g/l. Without it the linear equations of the load have no sideways force."""
    solver = codegen.compile(hanging_load())
    module = load(solver.source.path)
    grid = module.make_grid(40, m=0.5)
    nodes, _ = views(grid, module.initial_guess(grid))
    assert nodes[0, :, 6] == pytest.approx(np.full(41, -0.5 * 9.81 / 0.8), rel=1e-9)
    result = solver.solve()
    assert result.status == "solved"
    assert result.iterations <= 5  # 7 from a guess without forces


def test_holding_forces_are_the_least_squares_solution():
    """Two constraints and three forces at two nodes, by the pseudo-inverse of numpy; no force along no gradient."""
    rng = np.random.default_rng(0)
    force, rows = rng.normal(size=(3, 2)), rng.normal(size=(2, 3, 2))
    found = holding_forces([*force], [[*row] for row in rows])
    for node in range(2):
        assert found[node] == pytest.approx(-np.linalg.pinv(rows[:, :, node].T) @ force[:, node], rel=1e-9)
    assert holding_forces([1.0, 0.0], [[0.0, 0.0]]) == pytest.approx([0.0], abs=0)
    assert holding_forces([np.nan], [[1.0]]) == pytest.approx([0.0], abs=0)


def test_lagrangian_that_is_singular_along_a_constraint_is_refused():
    problem = cartesian_pendulum()
    dx = next(s for s in problem.start if s.name == "dx")
    x, y = (next(s for s in problem.start if s.name == name) for name in ("x", "y"))
    with pytest.raises(DegenerateError, match="degenerate in dy"):
        normalise(replace(problem, lagrangian=dx**2 / 2 - y, constraint=[x - point(FROM)[0]]))


@pytest.mark.parametrize(("scheme", "order"), [("midpoint", 2), ("trapezoidal", 2), ("rectangle", 1)])
def test_planar_pendulum_converges_to_the_motion_in_angles(exact_swing, scheme, order):
    errors = []
    for steps in (10, 20):
        dense, z = solved(cartesian_pendulum(), steps, scheme)
        x, y = dense.at_nodes(z, "x"), dense.at_nodes(z, "y")
        assert x**2 + y**2 == pytest.approx(1, abs=1e-12)
        errors.append(abs(dense.cost(z) - exact_swing))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        (("x", "y", "dx", "dy"), ("x", "y", "dx")),
        (("x", "y", "dx", "dy"), ("x", "dx")),
        (("x", "y", "dx", "dy"), ("x", "dx", "dy")),
        (("x", "dx"), ("x", "y", "dy")),
        (("x", "dx", "dy"), ("y", "dy")),
    ],
)
def test_whatever_determines_angle_and_speed_is_the_same_problem(start, end):
    dense, z = solved(cartesian_pendulum(), 5)
    other, w = solved(cartesian_pendulum(end, start), 5)
    assert other.cost(w) == pytest.approx(dense.cost(z), rel=1e-8)
    assert other.condition_number(w) < 1e6


def test_a_free_end_pins_the_force_and_keeps_the_constraint():
    problem = cartesian_pendulum(end=())
    program = transcribe(normalise(problem))
    assert pinned_names(program, program.start) == {"x", "y", "eta_1"}
    assert pinned_names(program, program.end) == {"lambda_x", "lambda_y", "kappa_1"}
    dense, z = solved(problem, 5)
    assert dense.cost(z) == pytest.approx(0, abs=1e-12)
    assert dense.at_nodes(z, "x")[-1] ** 2 + dense.at_nodes(z, "y")[-1] ** 2 == pytest.approx(1)
    assert dense.condition_number(z) < 1e6


def test_the_constraint_force_is_the_tension_of_the_rod():
    """At rest at the bottom kappa c with c = (r^2 - l^2)/2 pulls up with m g / l."""
    (x, y), (dx, dy) = coordinates("x y")
    u = control("u")
    rest = {x: 0, y: -2, dx: 0, dy: 0}
    problem = Control(
        lagrangian=(dx**2 + dy**2) / 2 - 10 * y, force={x: u}, cost=u**2, duration=1, start=rest, end=rest,
        constraint=[(x**2 + y**2 - 4) / 2],
    )  # fmt: skip
    dense, z = solved(problem, 4)
    assert dense.at_nodes(z, "kappa_1") == pytest.approx(-10 / 2)
    assert dense.cost(z) == pytest.approx(0, abs=1e-20)


@pytest.mark.slow
def test_spherical_pendulum_converges_to_the_motion_in_angles():
    g = 9.81
    (th, ph), (wt, wp) = coordinates("th ph")
    a, b = controls("a b")
    angles = Control(
        lagrangian=(wt**2 + sin(th) ** 2 * wp**2) / 2 + g * cos(th), force={th: a, ph: b * sin(th)},
        cost=(a**2 + b**2) / 2, duration=1, start={th: 0.8, ph: 0, wt: 0, wp: 0}, end={th: 1.1, ph: 1, wt: 0, wp: 0},
    )  # fmt: skip
    (x, y, z), (dx, dy, dz) = coordinates("x y z")
    u, v, w = controls("u v w")

    def place(th, ph):
        values = (np.sin(th) * np.cos(ph), np.sin(th) * np.sin(ph), -np.cos(th))
        return {**dict(zip((x, y, z), values, strict=True)), dx: 0, dy: 0, dz: 0}

    cartesian = Control(
        lagrangian=(dx**2 + dy**2 + dz**2) / 2 - g * z, force={x: u, y: v, z: w}, cost=(u**2 + v**2 + w**2) / 2,
        duration=1, start=place(0.8, 0), end=place(1.1, 1), constraint=[(x**2 + y**2 + z**2 - 1) / 2],
    )  # fmt: skip
    costs = [[dense.cost(s) for dense, s in (solved(p, n) for n in (8, 16))] for p in (angles, cartesian)]
    limits = [(4 * fine - coarse) / 3 for coarse, fine in costs]
    assert limits[0] == pytest.approx(limits[1], rel=2e-3)
    gaps = [abs(costs[1][i] - costs[0][i]) for i in (0, 1)]
    assert np.log2(gaps[0] / gaps[1]) == pytest.approx(2, abs=0.3)


def test_periodic_swing():
    """A driven swing, periodic in x, y and their velocities: the constraint's force of the end is redundant."""
    (x, y), (dx, dy) = coordinates("x y")
    u, t = control("u"), time()
    cartesian = Control(
        lagrangian=(dx**2 + dy**2) / 2 - y, force={x: -u * y, y: u * x},
        cost=(x - cos(2 * t) / 2) ** 2 + u**2 / 2, duration=np.pi, constraint=[(x**2 + y**2 - 1) / 2],
        periodic=[x, y, dx, dy], guess={x: cos(2 * t) / 4, y: -0.95},
    )  # fmt: skip
    th, w = coordinate("th")
    angle = Control(
        lagrangian=w**2 / 2 + cos(th), force={th: u}, cost=(sin(th) - cos(2 * t) / 2) ** 2 + u**2 / 2,
        duration=np.pi, periodic=[th, w], guess={th: cos(2 * t) / 4},
    )  # fmt: skip
    errors = []
    reference = [dense.cost(z) for dense, z in (solved(angle, n) for n in (20, 40))]
    exact = (4 * reference[1] - reference[0]) / 3
    for steps in (10, 20):
        dense, z = solved(cartesian, steps)
        errors.append(abs(dense.cost(z) - exact))
        assert {"kappa_1", "eta_1"} <= pinned_names(dense.program, dense.program.end)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.3)


def test_a_constraint_that_moves():
    """A bead on a rod that turns: y cos(t) = x sin(t). Pushed to stay at a distance of one it needs the force -t'^2."""
    (x, y), (dx, dy) = coordinates("x y")
    u, t = control("u"), time()
    problem = Control(
        lagrangian=(dx**2 + dy**2) / 2, force={x: u * cos(t), y: u * sin(t)}, cost=u**2 / 2, duration=1,
        start={x: 1, y: 0, dx: 0, dy: 1}, end={x: np.cos(1), y: np.sin(1), dx: -np.sin(1), dy: np.cos(1)},
        constraint=[y * cos(t) - x * sin(t)], guess={x: cos(t), y: sin(t)},
    )  # fmt: skip
    r, v = coordinate("r")
    radial = Control(
        lagrangian=v**2 / 2 + r**2 / 2, force={r: u}, cost=u**2 / 2, duration=1, start={r: 1, v: 0}, end={r: 1, v: 0}
    )
    gaps = []
    for steps in (5, 10):
        (moving, z), (one, w) = solved(problem, steps), solved(radial, steps)
        gaps.append(abs(moving.cost(z) - one.cost(w)))
    assert np.log2(gaps[0] / gaps[1]) == pytest.approx(2, abs=0.4)


def test_refusals_name_the_remedy():
    model = normalise(cartesian_pendulum())
    with pytest.raises(ArgumentError, match=r"no holonomic constraints.*--method variational"):
        transcribe(model, method="hamiltonian")
    (x, y), (dx, dy) = coordinates("x y")
    u = control("u")
    partly = Control(
        lagrangian=(dx**2 + dy**2) / 2, force={x: u}, cost=u**2, duration=1, constraint=[x**2 + y**2 - 1],
        periodic=[x, y, dx], guess={y: 1},
    )  # fmt: skip
    with pytest.raises(BoundaryError, match="not all of them alike; make dx dy and their coordinates periodic"):
        transcribe(normalise(partly))
