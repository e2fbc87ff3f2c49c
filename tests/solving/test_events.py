"""Events, impacts and contacts of simulations, against closed forms, elliptic functions and DOP853 of scipy."""

from pathlib import Path

import numpy as np
import pytest
from conftest import PROBLEMS
from scipy.integrate import solve_ivp
from scipy.special import ellipk
from sympy import Abs, Eq, Matrix, Rational, cos, eye, sin, sqrt

import codegen
from codegen import Event, Simulate, canonical_pair, coordinate, coordinates, parameters, pose, states, time
from codegen.emit.naming import Choices
from codegen.errors import ArgumentError, BoundaryError, CodegenError, ExpressionError, NumericsError, ProblemFileError
from codegen.evidence import checks
from codegen.solving.compiler import generate

BALL, CRADLE = PROBLEMS / "resting_ball.py", PROBLEMS / "newton_cradle.py"
GRAVITY, ROUNDING = 9.81, 1e-13


def slopes(errors, steps):
    return np.diff(np.log(errors)) / -np.diff(np.log(steps))


# ---- Impacts ----


@pytest.mark.parametrize("restitution", [0.8, 0.5, 0.97])
def test_a_ball_bounces_at_the_times_of_the_closed_form(restitution):
    """Impact n is at t_0 (1 + 2 e (1 - e^n)/(1 - e)), and the velocity after it is e^(n + 1) g t_0."""
    result = codegen.solve(BALL, parameters={"e": restitution})
    times, fall = result.events.times("floor", "impact"), np.sqrt(2 / GRAVITY)
    n = np.arange(times.size)
    assert result.solved
    assert times.size >= 5
    exact = fall * (1 + 2 * restitution * (1 - restitution**n) / (1 - restitution))
    assert np.abs(times - exact).max() < ROUNDING
    speeds = result.events.after[: times.size, 3]
    assert np.abs(speeds - restitution ** (n + 1) * GRAVITY * fall).max() < ROUNDING


def test_infinitely_many_impacts_end_in_rest_on_the_floor():
    """The times of the impacts accumulate at t_0 (1 + e)/(1 - e) (Zeno); then the ball slides."""
    result = codegen.solve(BALL)
    last = result.events[-1]
    assert (last.name, last.action) == ("floor", "rest")
    assert last.t == pytest.approx(np.sqrt(2 / GRAVITY) * 9, abs=ROUNDING)
    later = result.t > last.t
    assert later.sum() > 80
    assert np.abs(result.q[later, 1]).max() < 1e-15
    assert np.abs(result.p[later, 1]).max() < 1e-15
    assert np.abs(result.q[:, 0] - result.t / 2).max() < ROUNDING


def test_an_inelastic_ball_rests_after_its_first_impact():
    result = codegen.solve(BALL, parameters={"e": 0})
    assert [event.action for event in result.events] == ["impact", "rest"]
    assert result.events.t == pytest.approx(np.sqrt(2 / GRAVITY) * np.ones(2), abs=ROUNDING)


def test_one_step_with_an_impact_by_hand():
    """A step of the trapezoidal rule of length d, the impact, and a step of length h - d, for an oscillator."""
    (x,), (v,) = coordinates("x")
    problem = Simulate(
        lagrangian=v**2 / 2 - x**2 / 2, unilateral=[x >= -1], restitution=0.6, duration=0.5, steps=1,
        start={x: -0.9, v: -1},
    )  # fmt: skip
    result = codegen.solve(problem, scheme="trapezoidal")

    def step(x, v, d):
        new = x + d * v - d**2 / 2 * x
        return new, v - d / 2 * (x + new)

    d = np.roots([0.45, -1, 0.1]).min()  # -0.9 - d + 0.45 d^2 = -1
    wall, speed = step(-0.9, -1, d)
    assert wall == pytest.approx(-1)
    assert result.events[0].t == pytest.approx(d, abs=1e-15)
    assert result.events[0].before == pytest.approx([-1, speed], abs=1e-15)
    assert result.events[0].after == pytest.approx([-1, -0.6 * speed], abs=1e-15)
    assert (result.q[1, 0], result.p[1, 0]) == pytest.approx(step(-1, -0.6 * speed, 0.5 - d), abs=1e-15)


def quartic():
    """Return an oscillator x'' = -x^3 that bounces on a wall at -1/2 with the restitution 9/10."""
    q, p = canonical_pair("q", "p")
    return Simulate(
        hamiltonian=p**2 / 2 + q**4 / 4, unilateral={"wall": q >= Rational(-1, 2)}, restitution=0.9, duration=15,
        start={q: 1, p: 0},
    )  # fmt: skip


def bounced(duration):
    """Return the state of `quartic` at the end, and the number of impacts, by DOP853."""
    at, state, count = 0.0, [1.0, 0.0], 0

    def wall(_, z):
        return z[0] + 0.5

    wall.terminal, wall.direction = True, -1
    while True:
        part = solve_ivp(
            lambda _, z: [z[1], -(z[0] ** 3)], (at, duration), state, "DOP853", rtol=1e-12, atol=1e-13, events=wall
        )
        at, state = part.t[-1], part.y[:, -1]
        if part.status == 0:
            return state, count
        state, count = [-0.5, -0.9 * state[1]], count + 1


@pytest.mark.parametrize(
    ("scheme", "order"), [("midpoint", 2), ("stormer-verlet", 2), ("gauss-4", 4), ("yoshida-4", 4)]
)
def test_schemes_keep_their_order_across_impacts(scheme, order):
    exact, count = bounced(15)
    solver, errors, steps = codegen.compile(quartic(), scheme=scheme, method="hamiltonian"), [], [400, 800, 1600]
    for n in steps:
        result = solver.solve(steps=n)
        assert len(result.events) == count >= 3
        errors.append(np.hypot(result.q[-1, 0] - exact[0], result.p[-1, 0] - exact[1]))
    assert slopes(errors, steps).mean() == pytest.approx(order, abs=0.3)
    assert errors[-1] < {2: 2e-4, 4: 1e-7}[order]


def test_a_billiard_in_an_ellipse_keeps_its_constants_over_a_hundred_thousand_impacts():
    """The energy, and the product of the angular momenta about both foci (x = +-sqrt(3)), are constant."""
    (x, y), (dx, dy) = coordinates("x y")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2, unilateral={"wall": 1 - x**2 / 4 - y**2 >= 0}, duration=180_000, steps=180_000,
        start={x: 0.3, y: 0.1, dx: 1, dy: 0.7},
    )  # fmt: skip
    result = codegen.solve(problem)
    (a, b), (u, v) = result.q.T, result.p.T
    assert result.solved
    assert len(result.events) > 100_000
    energy, product = u**2 + v**2, (a * v - b * u) ** 2 - 3 * v**2
    assert np.abs(energy - energy[0]).max() < 1e-11
    assert np.abs(product - product[0]).max() < 1e-11
    assert result.summary["least_gap"] > -1e-13


def test_a_mass_slides_down_a_sphere_and_leaves_it():
    """It leaves the sphere at two thirds of the initial height. The error is that of the scheme in contact."""
    (x, y), (dx, dy) = coordinates("x y")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - y, unilateral={"dome": sqrt(x**2 + y**2) >= 1}, restitution=0, duration=2.5,
        start={x: sin(0.3), y: cos(0.3), dx: 0, dy: 0},
    )  # fmt: skip
    solver, steps = codegen.compile(problem, scheme="trapezoidal"), [100, 200, 400]
    results = [solver.solve(steps=n) for n in steps]
    for result in results:
        assert [event.action for event in result.events] == ["rest", "opening"]
        assert result.summary["least_gap"] > -1e-15
    errors = [abs(result.events[1].before[1] - 2 / 3 * np.cos(0.3)) for result in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    assert errors[-1] < 5e-6


@pytest.mark.parametrize("scheme", ["midpoint", "gauss-4"])
def test_a_ball_leaves_a_table_that_falls_faster_than_the_ball(scheme):
    """The table is at sin(3 t)/5, and the ball leaves it where the acceleration 9/5 sin(3 t) exceeds gravity, 1."""
    (y,), (v,) = coordinates("y")
    t = time()
    problem = Simulate(
        lagrangian=v**2 / 2 - y, unilateral={"table": y - sin(3 * t) / 5 >= 0}, restitution=0.3, duration=40, steps=800,
        start={y: 0, v: 0.6},
    )  # fmt: skip
    result = codegen.solve(problem, scheme=scheme)
    opened = result.events.times("table", "opening")
    n = np.arange(opened.size)
    assert result.solved
    assert opened.size == 20
    assert np.abs(opened - (np.arcsin(5 / 9) + 2 * np.pi * n) / 3).max() < 1e-12


def test_two_balls_come_to_rest_on_each_other():
    (y, z), (dy, dz) = coordinates("y z")
    problem = Simulate(
        lagrangian=dy**2 / 2 + dz**2 - GRAVITY * (y + 2 * z), unilateral={"floor": y >= 0, "between": z >= y},
        restitution=[0.5, 0.3], duration=3, start={y: 1, z: 2, dy: 0, dz: 0},
    )  # fmt: skip
    result = codegen.solve(problem, steps=150)
    assert result.solved
    assert np.abs(result.q[-10:]).max() < 1e-14
    assert np.abs(result.p[-10:]).max() < 1e-14
    assert {event.name for event in result.events if event.action == "rest"} == {"floor", "between"}


def test_a_body_comes_to_rest_in_a_corner():
    """The force (-3, -9.81) pushes into the corner of two gaps, which both close; their forces are 3 and 9.81."""
    (x, y), (dx, dy) = coordinates("x y")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - GRAVITY * y - 3 * x,
        unilateral={"floor": y >= 0, "wall": x >= 0, "lid": y <= 1},
        restitution=0.7, duration=10, start={x: 0.5, y: 0.5, dx: 2, dy: 3},
    )  # fmt: skip
    result = codegen.solve(problem, steps=500)
    assert result.solved
    assert np.abs(np.hstack([result.q, result.p])[-50:]).max() < 1e-14
    # Along x the ball is at rest at (v + sqrt(v^2 + 2 a d) (1 + e)/(1 - e))/a, with v = 2, a = 3 and d = 1/2.
    rest = result.events.times("wall", "rest")
    assert rest == pytest.approx([(2 + np.sqrt(4 + 3) * 1.7 / 0.3) / 3], abs=1e-12)


def test_many_masses_between_walls_keep_the_energy():
    q, v = coordinates("a0 a1 a2 a3 a4 a5")
    problem = Simulate(
        lagrangian=sum((i + 1) * rate**2 / 2 for i, rate in enumerate(v)),
        unilateral={"left": q[0] >= 0, "right": q[5] <= 10, **{f"gap {i}": q[i] >= q[i - 1] for i in range(1, 6)}},
        duration=2000, steps=10_000,
        start={**{a: i + 1 for i, a in enumerate(q)}, **{b: (-1) ** i * (1 + i / 10) for i, b in enumerate(v)}},
    )  # fmt: skip
    result = codegen.solve(problem)
    assert result.solved
    assert len(result.events) > 5000
    assert result.summary["energy_drift"] < 1e-11 * result.energy[0]
    assert result.summary["least_gap"] > -1e-12


def test_the_impulse_is_along_the_normal_in_the_metric_of_the_mass_matrix():
    """A rod falls on its end: the textbook's impulse (1 + e) v/(1/m + (l cos(a))^2/J) at the end of the rod."""
    (y, a), (dy, da) = coordinates("y a")
    m, inertia, length, e = 2.0, 0.3, 0.7, 0.5
    problem = Simulate(
        lagrangian=m * dy**2 / 2 + inertia * da**2 / 2, unilateral={"end": y - length * sin(a) >= 0}, restitution=e,
        duration=1, start={y: 1, a: 0.4, dy: -1, da: 0},
    )  # fmt: skip
    event = codegen.solve(problem, steps=10).events[0]
    arm = length * np.cos(0.4)
    impulse = (1 + e) / (1 / m + arm**2 / inertia)
    assert event.after[2:] == pytest.approx([-m + impulse, -arm * impulse], abs=ROUNDING)


def test_a_large_mass_matrix_is_not_inverted():
    """Beads of unit mass in a row, whose coordinates are differences: bead i is at s_0 + ... + s_i."""
    s, ds = coordinates("s0 s1 s2 s3 s4")
    velocities = [sum(ds[: i + 1]) for i in range(5)]
    problem = Simulate(
        lagrangian=sum(v**2 for v in velocities) / 2,
        unilateral={f"gap {i}": s[i] >= Rational(1, 10) for i in range(1, 5)},
        duration=10, start={s[0]: 0, **dict.fromkeys(s[1:], 1), ds[0]: 1, ds[1]: -1, **dict.fromkeys(ds[2:], 0)},
    )  # fmt: skip
    result = codegen.solve(problem, steps=100)
    assert result.solved
    # Equal masses exchange their velocities: one bead moves at a time, and the last one leaves at t = 0.9 * 4.
    assert result.events.t == pytest.approx(0.9 * np.arange(1, 5), abs=1e-12)
    assert result.q[-1].cumsum() == pytest.approx([0.9, 1.9, 2.9, 3.9, 4 + 10 - 3.6], abs=1e-11)


def test_newtons_cradle_hands_the_velocity_to_the_last_ball():
    """The quarter of a period is K(sin(pi/8))/sqrt(g)."""
    result, errors, steps = None, [], [500, 1000, 2000]
    solver = codegen.compile(CRADLE)
    for n in steps:
        result = solver.solve(steps=n)
        quarter = ellipk(np.sin(np.pi / 8) ** 2) / np.sqrt(GRAVITY)
        impacts = result.events.times("gap 1", "impact")
        exact = quarter * (1 + 2 * np.arange(impacts.size))
        assert impacts.size >= 5
        errors.append(np.abs(impacts - exact).max())
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    first = [event for event in result.events if abs(event.t - result.events.t[0]) < 1e-12 and event.action == "impact"]
    assert [event.name for event in first] == ["gap 1", "gap 2", "gap 3", "gap 4"]
    assert first[-1].after[5:] == pytest.approx([0, 0, 0, 0, first[0].before[5]], abs=1e-14)
    assert np.abs(result.q[:, 1:4]).max() < 1e-12


# ---- Events ----


def pendulum(**events):
    (q,), (v,) = coordinates("q")
    return Simulate(
        lagrangian=v**2 / 2 + cos(q), duration=10, start={q: 1.2, v: 0}, events={k: e(q, v) for k, e in events.items()}
    )


@pytest.mark.parametrize(("scheme", "order"), [("midpoint", 2), ("stormer-verlet", 2), ("gauss-4", 4)])
def test_a_pendulum_stops_where_it_turns(scheme, order):
    """Half a period is 2 K(sin(a/2)); the value zero of the velocity at the start is no event."""
    problem = pendulum(turn=lambda q, v: v, lowest=lambda q, v: Event(q, then="record"))
    solver, errors, steps = codegen.compile(problem, scheme=scheme), [], [100, 200, 400]
    quarter = ellipk(np.sin(0.6) ** 2)
    for n in steps:
        result = solver.solve(steps=n)
        assert [event.name for event in result.events] == ["lowest", "turn"]
        assert result.t[-1] == result.events[1].t
        assert abs(result.p[-1, 0]) < 1e-14
        errors.append(np.abs(result.events.t - quarter * np.array([1, 2])).max())
    assert slopes(errors, steps) == pytest.approx(order, abs=0.1)
    assert "event 'turn' ended the motion" in result.message


def test_pericentres_of_an_ellipse():
    """From the apocentre, pericentre n is at (2 n + 1) pi sqrt(a^3)."""
    (x, y), (dx, dy) = coordinates("x y")
    e = 0.5
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 + 1 / sqrt(x**2 + y**2), duration=6 * np.pi, steps=1200,
        events={"pericentre": Event(x * dx + y * dy, then="record", direction=1)},
        start={x: -(1 + e), y: 0, dx: 0, dy: -np.sqrt((1 - e) / (1 + e))},
    )  # fmt: skip
    result = codegen.solve(problem, scheme="gauss-6")
    assert result.events.t == pytest.approx(np.pi * np.array([1, 3, 5]), abs=1e-8)
    assert np.hypot(*result.events.before[:, :2].T) == pytest.approx(1 - e, abs=1e-8)


def test_several_events_in_one_step_happen_in_the_order_of_time():
    """The particle moves with the velocity 1, 2 from t = 0.5 on, in a single step."""
    (x,), (v,) = coordinates("x")
    problem = Simulate(
        lagrangian=v**2 / 2, duration=1, steps=1, start={x: 0, v: 1},
        events={
            "c": Event(x - Rational(9, 10), then="record"), "b": Event(x - Rational(1, 2), then={v: 2 * v}),
            "a": Event(x - Rational(3, 10), then="record"), "down": Event(x - Rational(3, 10), direction=-1),
            "never": x + 5,
        },
    )  # fmt: skip
    result = codegen.solve(problem)
    assert [event.name for event in result.events] == ["a", "b", "c"]
    assert result.events.t == pytest.approx([0.3, 0.5, 0.7], abs=1e-15)
    assert (result.q[-1, 0], result.p[-1, 0]) == pytest.approx((1.5, 2), abs=1e-15)


def test_a_double_zero_within_a_step():
    """For y = (t - 0.55)^2 - c with steps of length 0.1, both zeros are in one step, or one grazing zero, or none."""
    (y,), (v,) = coordinates("y")
    (c,) = parameters(c=0.0)
    problem = Simulate(
        lagrangian=v**2 / 2 + 2 * y, duration=1, steps=10, start={y: Rational("0.3025") - c, v: Rational("-1.1")},
        events={"touch": Event(y, then="record")},
    )  # fmt: skip
    solver = codegen.compile(problem)
    for depth, exact in ((0.0, [0.55]), (1e-4, [0.54, 0.56]), (-1e-4, [])):
        assert solver.solve(parameters={"c": depth}).events.t == pytest.approx(exact, abs=1e-9)


def test_events_of_first_order_dynamics_change_the_state():
    """For x' = -x with x -> 2 x where x = 1/2, the events are at n ln 2."""
    (x,) = states("x")
    problem = Simulate(
        dynamics={x: -x}, duration=5, start={x: 1}, events={"refill": Event(x - Rational(1, 2), then={x: 2 * x})}
    )
    errors, steps = [], [50, 100, 200]
    for n in steps:
        result = codegen.solve(problem, scheme="rk4", steps=n)
        exact = np.log(2) * np.arange(1, 8)
        assert result.events.t.size == 7
        errors.append(np.abs(result.events.t - exact).max())
    assert slopes(errors, steps) == pytest.approx(4, abs=0.15)
    assert result.events.after == pytest.approx(np.ones((7, 1)), abs=1e-14)


def test_a_pendulum_in_cartesian_coordinates_stops_where_it_turns():
    """The rate of the velocity contains the force of the rod; the reference is as in `pendulum`."""
    (x, y), (dx, dy) = coordinates("x y")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - y, constraint=[x**2 + y**2 - 1], duration=10,
        start={x: sin(1.2), y: -cos(1.2), dx: 0, dy: 0},
        events={"turn": dx * y - dy * x, "lowest": Event(x, then="record")},
    )  # fmt: skip
    solver, errors, steps = codegen.compile(problem, scheme="trapezoidal"), [], [100, 200, 400]
    for n in steps:
        result = solver.solve(steps=n)
        assert [event.name for event in result.events] == ["lowest", "turn"]
        errors.append(np.abs(result.events.t - ellipk(np.sin(0.6) ** 2) * np.array([1, 2])).max())
        assert result.events.before[1, :2] == pytest.approx([-np.sin(1.2), -np.cos(1.2)], abs=100 / n**2)
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)


def test_an_event_of_time():
    t = time()
    (x,) = states("x")
    problem = Simulate(
        dynamics={x: 1 + 0 * t}, duration=1, start={x: 0}, events={"switch": Event(t - Rational(1, 3), then={x: x + 1})}
    )
    result = codegen.solve(problem, scheme="rk4", steps=7)
    assert result.events.t == pytest.approx([1 / 3], abs=1e-15)
    assert result.q[-1, 0] == pytest.approx(2, abs=1e-14)


def test_changes_that_accumulate_end_the_motion_with_their_name():
    (y,), (v,) = coordinates("y")
    problem = Simulate(
        lagrangian=v**2 / 2 - GRAVITY * y,
        duration=5,
        start={y: 1, v: 0},
        events={"floor": Event(y, then={v: -0.5 * v})},
    )
    result = codegen.solve(problem)
    assert result.status == "events accumulate"
    assert result.t[-1] < np.sqrt(2 / GRAVITY) * 3 < result.t[-1] + 0.06
    assert "event 'floor' returns without end near t = 1.3545" in result.message


def test_redundant_gaps_that_close_end_the_motion():
    (y,), (v,) = coordinates("y")
    problem = Simulate(
        lagrangian=v**2 / 2 - y,
        duration=5,
        start={y: 1, v: 0},
        unilateral={"a": y >= 0, "b": 2 * y >= 0},
        restitution=0,
    )
    result = codegen.solve(problem)
    assert result.solved or result.status == "contact failed"
    assert np.all(result.q >= -1e-12)


def test_stored_states_and_the_archive(tmp_path: Path):
    solver = codegen.compile(BALL)
    whole, part = solver.solve(), solver.solve(every=7)
    assert part.t == pytest.approx(np.append(whole.t[::7], whole.t[-1]))
    assert np.array_equal(part.q[:-1], whole.q[::7])
    assert np.array_equal(part.events.t, whole.events.t)
    assert part.solved


def test_steps_of_different_lengths(tmp_path: Path):
    module = codegen.load(codegen.build(BALL).path)
    fractions = np.linspace(1, 3, 200)
    solution = module.solve(grid=fractions / fractions.sum())
    assert solution.status == "solved"
    assert solution.events.t[0] == pytest.approx(np.sqrt(2 / GRAVITY), abs=ROUNDING)
    assert solution.q[-1] == pytest.approx([2.5, 0], abs=ROUNDING)


# ---- Refusals ----


def ball(start=(1, 0), lagrangian=None, **options):
    """Return a ball above the floor; functions of y, v and e among the options are called."""
    (y,), (v,) = coordinates("y")
    (e,) = parameters(e=0.5)
    written = {name: value(y, v, e) if callable(value) else value for name, value in options.items()}
    return Simulate(
        lagrangian=v**2 / 2 - y + 0 * e if lagrangian is None else lagrangian(y, v),
        start={y: start[0], v: start[1]},
        **{"duration": 1, "steps": 20, **written},
    )


def floor(y, v, e):
    return {"floor": y >= 0}


def growing():
    (x,) = states("x")
    return Simulate(dynamics={x: x}, start={x: 1}, duration=1, unilateral=[x >= 0])


REFUSED = {
    "a gap that is violated at the start": (
        lambda: ball((-1, 0), unilateral=floor), BoundaryError, "start violates floor: the gap is -1",
    ),
    "a velocity into a gap at the start": (
        lambda: ball((0, -2), unilateral=floor), BoundaryError, "start closes floor with the velocity -2",
    ),
    "a restitution above one": (
        lambda: ball(unilateral=floor, restitution=1.5), ExpressionError, "restitution of floor is 1.5",
    ),
    "a negative restitution": (
        lambda: ball(unilateral=floor, restitution=-0.5), ExpressionError, "restitution of floor is -0.5",
    ),
    "a restitution that moves": (
        lambda: ball(unilateral=floor, restitution=lambda y, v, e: y), ExpressionError,
        "restitution of gap 1 depends on y",
    ),
    "too many restitutions": (
        lambda: ball(unilateral=floor, restitution=[0.5, 0.6]), ExpressionError, "restitution has 2 values for 1 gaps",
    ),
    "a restitution without a gap": (
        lambda: ball(restitution=0.5), ExpressionError, "restitution without unilateral; write unilateral=[gap >= 0]",
    ),
    "a gap that depends on a velocity": (
        lambda: ball(unilateral=lambda y, v, e: [v >= -1]), ExpressionError, "depends on dy",
    ),
    "a gap that depends on no coordinate": (
        lambda: ball(unilateral=lambda y, v, e: [e >= 0]), ExpressionError, "depends on no coordinate",
    ),
    "a gap that is an equation": (
        lambda: ball(unilateral=lambda y, v, e: [Eq(y, 0)]), ExpressionError, "is no inequality; write gap >= 0, or",
    ),
    "a gap of first-order dynamics": (growing, ExpressionError, "with dynamics; give a Lagrangian or a Hamiltonian"),
    "a gap beside a constraint": (
        lambda: ball(unilateral=floor, constraint=lambda y, v, e: [y - 1]), ExpressionError,
        "with a holonomic constraint; use generalised coordinates",
    ),
    "an energy that is not quadratic": (
        lambda: ball(unilateral=floor, lagrangian=lambda y, v: v**4 / 4 + v**2 / 2 - y), ExpressionError,
        "unilateral floor with a lagrangian that is not quadratic in dy",
    ),
    "a constant event": (
        lambda: ball(events=lambda y, v, e: {"end": e - 1}), ExpressionError, "event 'end' is constant: e - 1",
    ),
    "an event that cancels": (
        lambda: ball(events=lambda y, v, e: {"end": Abs(y) ** 2 - y**2 + e}), ExpressionError,
        "event 'end' is constant",
    ),
    "an inequality as an event": (
        lambda: ball(events=lambda y, v, e: {"end": y <= 0}), ExpressionError, "give the expression that vanishes",
    ),
    "events in a list": (lambda: ball(events=lambda y, v, e: [y]), ExpressionError, "events is a list; write events"),
    "an event without a name": (
        lambda: ball(events=lambda y, v, e: {"": y}), ExpressionError, "events has the name ''",
    ),
    "an unknown effect": (
        lambda: ball(events=lambda y, v, e: {"end": Event(y, then="halt")}), ExpressionError, "has then='halt'",
    ),
    "an empty change": (
        lambda: ball(events=lambda y, v, e: {"end": Event(y, then={})}), ExpressionError, 'write then="record"',
    ),
    "a change without effect": (
        lambda: ball(events=lambda y, v, e: {"end": Event(y, then={v: v})}), ExpressionError, "is its value before",
    ),
    "a change of a parameter": (
        lambda: ball(events=lambda y, v, e: {"end": Event(y, then={e: 1})}), BoundaryError,
        "let coordinates and velocities change only",
    ),
    "a direction of two": (
        lambda: ball(events=lambda y, v, e: {"end": Event(y, direction=2)}), ExpressionError, "has the direction 2",
    ),
    "two of one name": (
        lambda: ball(events=lambda y, v, e: {"floor": v}, unilateral=floor), ExpressionError,
        "two events or gaps are called 'floor'",
    ),
    "a misspelt argument": (
        lambda: ball(event=lambda y, v, e: {"end": y}), ProblemFileError,
        "has no argument 'event'; perhaps it is events",
    ),
}  # fmt: skip


@pytest.mark.fast
@pytest.mark.parametrize("case", REFUSED)
def test_refusals_are_one_line_that_names_the_event(case):
    problem, kind, words = REFUSED[case]
    with pytest.raises(CodegenError) as caught:
        generate(problem(), {}, Choices())
    assert type(caught.value) is kind
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"e": 1.5}, "the restitution of floor is 1.5"),
        ({"start.y": -1}, "start violates floor: the gap is -1"),
        ({"start.y": 0, "start.dy": -1}, "start closes floor with the velocity -1"),
    ],
)
def test_parameters_that_violate_a_gap_are_refused(changed, words):
    with pytest.raises(NumericsError, match=words):
        codegen.solve(BALL, parameters=changed)


def test_a_root_finder_finds_no_events():
    with pytest.raises(ArgumentError, match="driver fsolve finds no events; use newton"):
        codegen.solve(BALL, driver="fsolve")


# ---- Evidence ----


@pytest.mark.parametrize("scheme", ["midpoint", "gauss-4"])
def test_all_checks_of_a_motion_with_events_pass(scheme):
    problem = pendulum(
        low=lambda q, v: Event(q + v / 7, then="record"), kick=lambda q, v: Event(q - 1, then={v: v + cos(q)})
    )
    findings = list(checks.run(problem, scheme=scheme, steps=50))
    assert [finding for finding in findings if not finding.passed] == []
    found = {(finding.check, finding.subject) for finding in findings if finding.applies}
    assert {("derivatives", "event_values"), ("derivatives", "event_jumps")} <= found
    assert ("problem as written", "events and gaps") in found


@pytest.mark.parametrize(
    ("written", "damaged", "failed"),
    [
        ("values[0] = ", "values[0] = 1e-3 + ", "event_values"),
        ("normals[6] = ", "normals[6] = 2*", "gap_normals"),
        ("normals[1] = ", "normals[1] = 0.5*", "events and gaps"),
    ],
)
def test_damage_of_a_gap_in_the_module_fails_the_checks(tmp_path: Path, written, damaged, failed):
    text = generate(BALL, {}, Choices())
    assert written in text
    module = tmp_path / "damaged.py"
    module.write_text(text.replace(written, damaged))
    findings = checks.run(BALL, module=module, steps=20)
    assert failed in {finding.subject for finding in findings if not finding.passed}


def blade(**options) -> Simulate:
    """A blade that turns steadily on a horizontal plane: dx = sin(t) cos(t) with its start at rest on a slope."""
    (x, y, phi), (dx, dy, dphi) = coordinates("x y phi")
    return Simulate(
        lagrangian=(dx**2 + dy**2 + dphi**2) / 2 + x,
        rolling=[dx * sin(phi) - dy * cos(phi)],
        start={x: 0, y: 0, phi: 0, dx: 0, dy: 0, dphi: 1},
        duration=4,
        steps=100,
        **{name: make(x, y, dx, dy) for name, make in options.items()},
    )


def test_events_of_velocities_know_the_forces_of_rolling_constraints():
    """The speed of the blade is sin(t), so that dx = sin(t) cos(t) vanishes at pi/2 and pi."""
    result = codegen.solve(
        blade(events=lambda x, y, dx, dy: {"turn": Event(dx, then="record")}), scheme="suzuki-4-of-midpoint"
    )
    assert result.status == "solved"
    assert result.events.times("turn") == pytest.approx([np.pi / 2, np.pi], abs=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        {"unilateral": lambda x, y, dx, dy: {"wall": 1 - y >= 0}},
        {"events": lambda x, y, dx, dy: {"kick": Event(y - 0.5, then={dy: -dy})}},
    ],
    ids=["gap", "change"],
)
def test_impulses_beside_rolling_constraints_are_refused(options):
    with pytest.raises(ExpressionError, match="with a rolling constraint"):
        codegen.solve(blade(**options))


def test_events_of_velocities_know_the_forces_of_contact():
    """A mass slides without friction in a bowl y = x^2/2, whose velocity vanishes once in each half of its period."""
    (x, y), (dx, dy) = coordinates("x y")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - y,
        unilateral={"bowl": y - x**2 / 2 >= 0},
        restitution=0,
        start={x: 0.6, y: 0.18, dx: 0, dy: 0},
        duration=8,
        events={"turn": Event(dx, then="record")},
        steps=800,
    )

    def field(t, state):
        # (1 + x^2) x'' + x x'^2 + x = 0
        return [state[1], -state[0] * (1 + state[1] ** 2) / (1 + state[0] ** 2)]

    def still(t, state):
        return state[1]

    exact = solve_ivp(field, (0, 8), [0.6, 0], "DOP853", rtol=1e-12, atol=1e-13, events=still).t_events[0]
    result = codegen.solve(problem)
    assert result.status == "solved"
    assert result.events.times("turn") == pytest.approx(exact[exact > 1e-6], abs=1e-4)


def test_a_ball_at_rest_has_no_apex():
    """One apex follows each impact until the ball rests; at rest its velocity is zero, which is no event."""
    (x, y), (dx, dy) = coordinates("x y")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - GRAVITY * y,
        unilateral={"floor": y >= 0},
        restitution=0.5,
        start={x: 0, y: 1, dx: 0.5, dy: 0},
        duration=3,
        events={"apex": Event(dy, then="record")},
        steps=300,
    )
    result = codegen.solve(problem)
    impacts, apexes = result.events.times("floor", "impact"), result.events.times("apex")
    assert 0 <= impacts.size - apexes.size <= 1
    assert apexes[:5] == pytest.approx((impacts[:5] + impacts[1:6]) / 2, abs=1e-12)


def test_a_pole_is_no_event():
    (q,), (v,) = coordinates("q")
    problem = Simulate(
        lagrangian=v**2 / 2,
        start={q: 0, v: 1},
        duration=2,
        events={"pole": Event(1 / (q - Rational(1, 2)), then="record"), "zero": Event(q - 1, then="record")},
        steps=30,
    )
    assert codegen.solve(problem).events.names == ("zero",)


def test_a_change_below_the_floor_is_one_line():
    z, dz = coordinate("z")
    problem = Simulate(
        lagrangian=dz**2 / 2 - GRAVITY * z, events={"down": Event(z - 0.5, then={z: -1})}, duration=1,
        unilateral={"floor": z >= 0}, restitution=0.5, start={z: 1, dz: 0},
    )  # fmt: skip
    result = codegen.solve(problem)
    assert result.status == "contact failed"
    assert "the change of event 'down' at t = 0.3192754" in result.message
    assert "makes a gap negative; give new values in `then` that keep every gap" in result.message


def test_events_of_velocities_of_a_ball_that_rolls_down_a_slope():
    """The ball has the acceleration g sin(a)/(1 + J/(m r^2)); the events are zeros of its velocity and its spin."""
    (x, R), (v, omega) = pose("B")
    slope, radius, inertia = 0.2, Rational(1, 2), Rational(1, 10)
    slip = v + (R @ omega).cross(Matrix([0, 0, -radius]))
    problem = Simulate(
        lagrangian=v.dot(v) / 2 + inertia * omega.dot(omega) / 2 + GRAVITY * sin(slope) * x[0],
        rolling=[slip[0], slip[1]], constraint=[x[2] - radius], duration=1, steps=100,
        events={"fast": Event(v[0] - 1, then="record"), "spin": Event((R @ omega)[1] - 1.5, then="record")},
        start={x: (0, 0, radius), R: eye(3), v: (0, 0.3, 0), omega: (-0.6, 0, 0)},
    )  # fmt: skip
    result = codegen.solve(problem)
    acceleration = GRAVITY * np.sin(slope) / (1 + 0.1 / 0.25)
    assert result.events.times("fast") == pytest.approx([1 / acceleration], abs=1e-12)
    assert result.events.times("spin") == pytest.approx([0.75 / acceleration], abs=1e-12)
    spin = result["B"][-1] @ result["omega"][-1]
    assert spin[1] == pytest.approx(2 * acceleration, rel=1e-10)
