"""Rolling constraints against closed forms, the equations of Newton and Euler, and Pontryagin's conditions."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import PROBLEMS
from scipy.integrate import quad, solve_bvp, solve_ivp
from scipy.special import ellipj, ellipk
from sympy import Add, Eq, cos, pi, sin

import codegen
from codegen import Control, Simulate, body_number, controls, coordinates, free_parameter, parameters, time
from codegen.emit.naming import Choices
from codegen.errors import (
    ArgumentError,
    BoundaryError,
    CodegenError,
    DegenerateError,
    ExpressionError,
    NumericsError,
    SchemeError,
)
from codegen.evidence import checks
from codegen.runtime.record import Kind
from codegen.solving.compiler import generate

SLEIGH, DISC, SNAKEBOARD = (PROBLEMS / f"{name}.py" for name in ("chaplygin_sleigh", "rolling_disc", "snakeboard"))
LIMIT = 1e-12
GRAVITY, HEADING, TURN = 1.0, 0.3, 1.1


def slopes(errors, steps):
    return np.diff(np.log(errors)) / -np.diff(np.log(steps))


def blade(**options) -> Simulate:
    """Release a blade on a slope that falls in the direction x, with a spin."""
    (x, y, phi), (dx, dy, dphi) = coordinates("x y phi")
    return Simulate(
        lagrangian=(dx**2 + dy**2) / 2 + 0.15 * dphi**2 + GRAVITY * x,
        rolling=[dx * sin(phi) - dy * cos(phi)],
        start={x: 0, y: 0, phi: HEADING, dx: 0, dy: 0, dphi: TURN},
        **{"duration": 5, "steps": 100, **options},
    )


def exact_blade(t):
    """Return (x, y, phi): the speed is v = g/w (sin phi - sin phi_0) with the constant spin w."""
    phi, ratio = HEADING + TURN * t, GRAVITY / TURN**2
    x = ratio * (np.sin(phi) ** 2 - np.sin(HEADING) ** 2) / 2 - ratio * np.sin(HEADING) * (
        np.sin(phi) - np.sin(HEADING)
    )
    y = ratio * ((phi - HEADING) / 2 - (np.sin(2 * phi) - np.sin(2 * HEADING)) / 4)
    y += ratio * np.sin(HEADING) * (np.cos(phi) - np.cos(HEADING))
    return np.column_stack([x, y, phi])


# ---- Simulations ----


@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        ("trapezoidal", 2), ("midpoint", 2), ("rectangle", 1), ("suzuki-4-of-trapezoidal", 4),
        ("suzuki-4-of-midpoint", 4),
    ],
)  # fmt: skip
def test_blade_on_a_slope_has_the_order_of_its_scheme(scheme, order):
    solver, errors, steps = codegen.compile(blade(), scheme=scheme), [], [50, 100, 200]
    for n in steps:
        result = solver.solve(steps=n)
        errors.append(np.abs(result.q - exact_blade(result.t)).max())
        assert result.summary["rolling_error"] < LIMIT
    assert slopes(errors, steps) == pytest.approx(order, abs=0.1)
    assert errors[-1] < {1: 0.06, 2: 5e-4, 4: 1e-8}[order]


def test_one_step_of_the_midpoint_rule_by_hand():
    """The blade without spin about itself: the equations of Cortes and Martinez with numpy, for a given phi_1."""
    h, v = 0.2, 0.7
    problem = blade(duration=h, steps=1)
    at_start = 0, 0, HEADING, v * np.cos(HEADING), v * np.sin(HEADING), TURN
    problem = replace(problem, start=dict(zip(problem.start, at_start, strict=True)))
    result = codegen.solve(problem, scheme="midpoint")
    new, middle = HEADING + h * TURN, HEADING + h * TURN / 2
    row = [np.array([np.sin(a), -np.cos(a)]) for a in (HEADING, middle, new)]
    # Unknowns: the displacement, and the impulses j_0, j_1 along the rows at both nodes.
    p = v * np.array([np.cos(HEADING), np.sin(HEADING)])
    gain = h / 2 * np.array([GRAVITY, 0])
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    matrix[:2, :2], matrix[:2, 2], right[:2] = np.eye(2) / h, -row[0], p + gain
    matrix[2, :2] = row[1]
    *moved, _ = np.linalg.solve(matrix, right)
    free = np.array(moved) / h + gain
    assert result.q[1] == pytest.approx([*moved, new], abs=1e-14)
    assert result.p[1, :2] == pytest.approx(free - row[2] * (row[2] @ free), abs=1e-14)


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal"])
def test_chaplygin_sleigh_follows_its_closed_form(scheme):
    """The speed is k w tanh(rate t) and the spin w/cosh(rate t), with k^2 = (J + m a^2)/m and rate = a w/k."""
    a, w, k = 0.3, 2.0, np.sqrt(0.2 + 0.3**2)
    rate, duration = a * w / k, 3.0

    def heading(t):
        return 2 * w / rate * np.arctan(np.tanh(rate * t / 2))

    def speed(t):
        return k * w * np.tanh(rate * t)

    x = quad(lambda t: speed(t) * np.cos(heading(t)), 0, duration, epsabs=1e-13)[0]
    y = quad(lambda t: speed(t) * np.sin(heading(t)), 0, duration, epsabs=1e-13)[0]
    exact = [x, y, heading(duration)]
    solver, steps = codegen.compile(SLEIGH, scheme=scheme), [100, 200, 400]
    results = [solver.solve(steps=n, parameters={"duration": duration}) for n in steps]
    errors = [np.abs(result.q[-1] - exact).max() for result in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.05)
    assert errors[-1] < 1e-4
    assert results[-1].summary["energy_drift"] < 1e-4


def disc(duration, wobble, lean=0.3, turn=1.5, mass=1.0, r=0.5, g=9.81):
    """Return the axle, the point of contact and the spin at the start, by the equations of Newton and Euler.

    No angles and no Lagrangian: n is the axle, w the angular velocity, d points from the contact to the centre. The
    force of the table is m a + m g e_z, and its moment changes the angular momentum.
    """
    small, large, up = mass * r**2 / 4, mass * r**2 / 2, np.array([0, 0, 1.0])
    spin = (mass * g * r * np.tan(lean) / turn - small * turn * np.sin(lean)) / (large + mass * r**2)
    spin += turn * np.sin(lean)

    def field(t, state):
        n, w = state[:3], state[3:6]
        dn = np.cross(w, n)
        along, change = up - up @ n * n, -(up @ dn) * n - up @ n * dn
        size = np.linalg.norm(along)
        d = along / size
        dd = (change - d * (d @ change)) / size
        turning = np.array([[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]])
        inertia = small * np.eye(3) + (large - small) * np.outer(n, n) - mass * r**2 * turning @ turning
        moment = -r * np.cross(d, mass * r * np.cross(w, dd) + mass * g * up)
        moment -= (large - small) * (dn * (n @ w) + n * (dn @ w))
        return np.concatenate([dn, np.linalg.solve(inertia, moment), (r * np.cross(w, d) - r * dd)[:2]])

    n = np.array([0, np.cos(lean), -np.sin(lean)])
    start = np.concatenate([n, turn * up - wobble * np.array([1.0, 0, 0]) + spin * n, [0, 0]])
    end = solve_ivp(field, (0, duration), start, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return end[:3], end[6:], spin


@pytest.mark.parametrize("scheme", ["midpoint", "suzuki-4-of-midpoint"])
def test_rolling_disc_follows_newton_and_euler(scheme):
    axle, contact, _ = disc(2.0, 0.8)
    order = 4 if "suzuki" in scheme else 2
    solver, steps, errors = codegen.compile(DISC, scheme=scheme), [100, 200, 400], []
    for n in steps:
        result = solver.solve(steps=n, parameters={"duration": 2.0})
        x, y, phi, lean, _ = result.q[-1]
        found = [-np.sin(phi) * np.cos(lean), np.cos(phi) * np.cos(lean), -np.sin(lean)]
        errors.append(np.abs(np.concatenate([found - axle, [x, y] - contact])).max())
        assert result.summary["rolling_error"] < LIMIT
    assert slopes(errors, steps) == pytest.approx(order, abs=0.1)
    assert errors[-1] < {2: 5e-4, 4: 2e-6}[order]


def test_a_disc_without_wobble_rolls_in_a_circle():
    """The closed form of steady rolling: a circle of radius r dpsi/dphi."""
    radius = 0.5 * disc(0.01, 0.0)[2] / 1.5
    result = codegen.solve(DISC, steps=4000, parameters={"wobble": 0.0, "duration": 4.0})
    assert np.hypot(result.q[:, 0], result.q[:, 1] - radius) == pytest.approx(radius, abs=1e-5)
    assert result.q[:, 3] == pytest.approx(0.3, abs=1e-5)
    assert np.ptp(result.q[:, 2]) == pytest.approx(6.0, abs=2e-5)


def test_energy_and_constraints_of_a_disc_over_many_steps():
    result = codegen.solve(DISC, steps=200_000, parameters={"duration": 1000.0})
    assert result.solved
    error = result.energy - result.energy[0]
    assert result.summary["rolling_error"] < LIMIT
    assert np.abs(error).max() < 2e-4 * result.energy[0]
    assert np.ptp(error[1:].reshape(8, -1).mean(axis=1)) < 2e-5 * result.energy[0]


def test_an_integrable_rolling_constraint_is_a_pendulum():
    """x dx + y dy = 0 keeps the length of a rod; the reference are elliptic functions."""
    (x, y), (dx, dy) = coordinates("x y")
    angle, g = 1.2, 9.81
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - g * y, rolling=[x * dx + y * dy], duration=2,
        start={x: sin(angle), y: -cos(angle), dx: 0, dy: 0},
    )  # fmt: skip
    k = np.sin(angle / 2)
    exact = 2 * np.arcsin(k * ellipj(np.sqrt(g) * 2 + ellipk(k**2), k**2)[0])
    solver, steps = codegen.compile(problem, scheme="midpoint"), [100, 200, 400]
    results = [solver.solve(steps=n) for n in steps]
    errors = [np.abs(result.q[-1] - [np.sin(exact), -np.cos(exact)]).max() for result in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.05)
    # The mean of the constraint on a step is (|q_1|^2 - |q_0|^2)/2h: the midpoint rule keeps the length.
    assert np.abs(np.hypot(*results[-1].q.T) - 1).max() < LIMIT


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal"])
def test_rolling_beside_a_holonomic_constraint(scheme):
    """The blade with its direction (c, s) as coordinates of a point on a circle."""
    (x, y, c, s), (dx, dy, dc, ds) = coordinates("x y c s")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 + 0.15 * (dc**2 + ds**2) + GRAVITY * x,
        constraint=[c**2 + s**2 - 1],
        rolling=[dx * s - dy * c],
        duration=2,
        start={x: 0, y: 0, c: cos(HEADING), s: sin(HEADING), dx: 0, dy: 0}
        | {dc: -TURN * sin(HEADING), ds: TURN * cos(HEADING)},
    )
    ((*place, phi),) = exact_blade(np.array([2.0]))
    solver, steps = codegen.compile(problem, scheme=scheme), [50, 100, 200]
    results = [solver.solve(steps=n) for n in steps]
    errors = [np.abs(r.q[-1] - [*place, np.cos(phi), np.sin(phi)]).max() for r in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    assert max(results[-1].summary[name] for name in ("constraint_error", "constraint_rate", "rolling_error")) < LIMIT


def test_a_wheel_on_a_moving_belt_with_friction():
    """An affine constraint of time: dx - r dphi = sin t. The reference is DOP853 for one velocity."""
    (x, phi), (dx, dphi) = coordinates("x phi")
    t, m, r, inertia, drag = time(), 2.0, 0.5, 0.3, 0.4
    problem = Simulate(
        lagrangian=m * dx**2 / 2 + inertia * dphi**2 / 2, force={x: -drag * dx}, rolling=[Eq(dx, r * dphi + sin(t))],
        duration=3, start={x: 0, phi: 0, dx: 1, dphi: 2},
    )  # fmt: skip

    def field(t, state):
        # m x'' = k - drag x', J phi'' = -r k, x'' = r phi'' + cos t.
        _, _, speed, spin = state
        change = (inertia / r**2 * np.cos(t) - drag * speed) / (m + inertia / r**2)
        return [speed, spin, change, (change - np.cos(t)) / r]

    exact = solve_ivp(field, (0, 3), [0, 0, 1, 2], "DOP853", rtol=1e-12, atol=1e-13).y[:2, -1]
    solver, steps = codegen.compile(problem, scheme="midpoint"), [50, 100, 200]
    results = [solver.solve(steps=n) for n in steps]
    errors = [np.abs(result.q[-1] - exact).max() for result in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    assert results[-1].summary["rolling_error"] < LIMIT
    assert "energy_change" in results[-1].summary  # the belt drives the wheel


# ---- Optimal control ----


def unicycle(end=(1, 1, 0.5, 0, 0, 0), **options) -> Control:
    """Drive a unicycle by a force along its direction and a torque, from rest to the values (x, y, phi, dx, dy, dphi).

    Values that are None are free.
    """
    (x, y, phi), (dx, dy, dphi) = coordinates("x y phi")
    f, tau = controls("f tau")
    return Control(
        lagrangian=(dx**2 + dy**2) / 2 + 0.15 * dphi**2,
        force={x: f * cos(phi), y: f * sin(phi), phi: tau},
        rolling=[dx * sin(phi) - dy * cos(phi)],
        cost=f**2 + tau**2,
        start=dict.fromkeys((x, y, phi, dx, dy, dphi), 0),
        end={q: value for q, value in zip((x, y, phi, dx, dy, dphi), end, strict=True) if value is not None},
        **{"duration": 2, "steps": 40, **options},
    )


@pytest.fixture(scope="module")
def least_effort():
    """The cost of the unicycle by Pontryagin's conditions of (x, y, phi, v, w), and the motion, by solve_bvp."""
    duration, inertia = 2.0, 0.3

    def field(t, z):
        _, _, phi, v, w, a, b, c, d, e = z
        along = a * np.cos(phi) + b * np.sin(phi)
        turned = v * (a * np.sin(phi) - b * np.cos(phi))
        rates = [v * np.cos(phi), v * np.sin(phi), w, -d / 2, -e / (2 * inertia**2), 0 * t, 0 * t, turned, -along, -c]
        return np.array(rates)

    def ends(z0, z1):
        return np.concatenate([z0[:5], z1[:5] - [1, 1, 0.5, 0, 0]])

    t = np.linspace(0, duration, 400)
    rough = codegen.solve(unicycle())
    guess = np.zeros((10, t.size))
    guess[:3] = [np.interp(t, rough.t, column) for column in rough.q.T]
    middles = (rough.t[1:] + rough.t[:-1]) / 2
    guess[8], guess[9] = (-2 * np.interp(t, middles, u) * factor for u, factor in zip(rough.u.T, (1, 0.3), strict=True))
    found = solve_bvp(field, ends, t, guess, tol=1e-10, max_nodes=100_000)
    assert found.success
    cost = quad(lambda t: found.sol(t)[8] ** 2 / 4 + found.sol(t)[9] ** 2 / (4 * inertia**2), 0, duration, epsabs=1e-11)
    return cost[0], found.sol


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal"])
def test_the_least_effort_of_a_unicycle_fulfils_pontryagins_conditions(least_effort, scheme):
    cost, motion = least_effort
    solver, steps = codegen.compile(unicycle(), scheme=scheme), [20, 40, 80]
    results = [solver.solve(steps=n) for n in steps]
    assert all(result.solved for result in results)
    errors = [abs(result.cost - cost) for result in results]
    distances = [np.abs(result.q - motion(result.t)[:3].T).max() for result in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.15)
    assert slopes(distances, steps) == pytest.approx(2, abs=0.15)
    assert errors[-1] < 1e-3 * cost


def test_the_snakeboard_takes_the_effort_that_casadi_finds():
    """See `benchmarks/rolling.py`: the discrete program, and the limit of RK4 for accelerations without multipliers."""
    solver = codegen.compile(SNAKEBOARD)
    costs = [solver.solve(steps=n).cost for n in (40, 80, 160, 320)]
    assert costs[:3] == pytest.approx([0.079076194923, 0.0778035644047, 0.0774883470721], rel=1e-10)
    assert (4 * costs[3] - costs[2]) / 3 == pytest.approx(0.0773835, abs=3e-7)


def test_a_wheel_is_an_inertia():
    """The wheel on a road: 12 (J + m r^2)^2 phi_T^2/T^3, times N^2/(N^2 - 1) for constant torques on intervals."""
    (x, phi), (dx, dphi) = coordinates("x phi")
    (tau,) = controls("tau")
    problem = Control(
        lagrangian=2 * dx**2 / 2 + 0.3 * dphi**2 / 2, force={phi: tau}, rolling=[dx - 0.5 * dphi], cost=tau**2,
        duration=2, steps=10, start=dict.fromkeys((x, phi, dx, dphi), 0), end={x: 1, dx: 0, dphi: 0},
    )  # fmt: skip
    result = codegen.solve(problem)
    assert result.cost == pytest.approx(12 * (0.3 + 2 * 0.25) ** 2 * 4 / 8 * 100 / 99, rel=1e-10)
    assert result.q[:, 1] == pytest.approx(2 * result.q[:, 0], abs=1e-12)


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal"])
def test_a_motion_without_controls_is_that_of_the_simulation(scheme):
    followed = codegen.solve(blade(duration=2, steps=40), scheme=scheme)
    problem = blade(duration=2, steps=40)
    whole = Control(
        lagrangian=problem.lagrangian, rolling=problem.rolling, start=problem.start, duration=2, steps=40
    )  # fmt: skip
    solved = codegen.solve(whole, scheme=scheme)
    assert solved.solved
    assert solved.q == pytest.approx(followed.q, abs=1e-10)


def test_the_force_of_the_constraint_is_no_control():
    """The force across a blade that turns is m v w. The velocity at the end determines the heading, which is free."""
    solver = codegen.compile(unicycle((1, 1, None, 0, 1, 0)))
    result = solver.solve(steps=400)
    assert result.solved
    assert result.names["u"] == ("f", "tau")
    assert result.q[-1, 2] == pytest.approx(np.pi / 2, abs=1e-10)
    record = solver.module.metadata
    nodes, _ = solver.module.views(solver.module.make_grid(400), result.unknowns)
    (index,) = (i for i, name in enumerate(record.node) if record.kind(name) == Kind.NORMAL_FORCE)
    t, (x, y, phi) = result.t, result.q.T
    speed = np.gradient(x, t) * np.cos(phi) + np.gradient(y, t) * np.sin(phi)
    expected = -speed * np.gradient(phi, t)  # the row (sin phi, -cos phi) points to the right
    assert np.abs(expected).max() > 0.1
    assert nodes[0, 1:-1, index] == pytest.approx(expected[1:-1], abs=1e-3)


def test_a_unicycle_rolls_in_a_circle_without_effort():
    """A lap that is periodic but for a full turn: the heading of the end is that of the start, and one force acts."""
    problem = unicycle()
    x, y, phi, *_ = problem.start
    t = time()
    lap = replace(
        problem, start={x: 0, y: 0, phi: 0}, end={}, periodic={**dict.fromkeys(problem.start, 0), phi: 2 * pi},
        at={1: [Eq(x, 0), Eq(y, 1)]}, guess={x: sin(pi * t) / 2, y: (1 - cos(pi * t)) / 2, phi: pi * t},
    )  # fmt: skip
    result = codegen.solve(lap)
    assert result.solved
    assert result.cost == pytest.approx(0, abs=1e-20)
    assert np.hypot(result.q[:, 0], result.q[:, 1] - 0.5) == pytest.approx(0.5, abs=1e-12)
    assert result.q[-1, 2] == pytest.approx(2 * np.pi, abs=1e-12)


def test_the_least_time_of_a_wheel():
    """A free duration and bounds: the wheel is the inertia M with the time 2 sqrt(M phi_T/limit)."""
    (x, phi), (dx, dphi) = coordinates("x phi")
    (tau,) = controls("tau")
    duration = free_parameter("T", 2.0)
    problem = Control(
        lagrangian=2 * dx**2 / 2 + 0.3 * dphi**2 / 2, force={phi: tau}, rolling=[dx - 0.5 * dphi],
        terminal_cost=duration, duration=duration, steps=20, bounds={tau: (-1.5, 1.5)},
        start=dict.fromkeys((x, phi, dx, dphi), 0), end={x: 1, dx: 0, dphi: 0},
    )  # fmt: skip
    assert codegen.solve(problem).cost == pytest.approx(2 * np.sqrt(0.8 * 2 / 1.5), rel=1e-7)


def test_bodies_differ_in_their_ends():
    problem = unicycle()
    x, y, phi, dx, dy, dphi = problem.start
    end = {x: 1, y: body_number(), phi: body_number() / 2, dx: 0, dy: 0, dphi: 0}
    together = codegen.solve(replace(problem, bodies=2, end=end))
    alone = [codegen.solve(unicycle((1, i, i / 2, 0, 0, 0))) for i in range(2)]
    assert together.cost == pytest.approx(sum(result.cost for result in alone), rel=1e-10)
    assert alone[0].cost == pytest.approx(2 * 12 / 8 / 2 * 1600 / 1599, rel=1e-9)  # a straight line


def test_a_motion_into_a_singular_point_ends_with_the_name_of_the_constraint():
    """y dx + x dy = 0 keeps a bead on the crossing lines x y = 0, which it reaches after 64 steps of length 1/64."""
    (x, y), (dx, dy) = coordinates("x y")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2, rolling=[y * dx + x * dy], duration=2, steps=128,
        start={x: 1, y: 0, dx: -1, dy: 0},
    )  # fmt: skip
    result = codegen.solve(problem, scheme="trapezoidal")
    assert result.status == "singular"
    assert "the gradient of the constraint dx*y + dy*x = 0 vanishes there" in result.message


def test_show_has_the_forces_and_the_discrete_constraint(capsys):
    from codegen.cli import main

    with pytest.raises(SystemExit) as ended:
        main(["show", str(SLEIGH), "--latex"])
    assert ended.value.code in (0, None)
    text = capsys.readouterr().out
    assert "Rolling constraints" in text
    assert "Discrete rolling constraints of an interval" in text
    assert r"G^T \kappa" in text


def test_a_sweep_varies_parameters_of_a_rolling_problem(tmp_path):
    found = codegen.sweep(SLEIGH, {"w": [1.0, 2.0]}, out=tmp_path / "sleigh.zarr")
    assert list(found["status"].values) == ["solved", "solved"]
    ends = found["p"].isel(node=-1).values
    for w, (px, py, _) in zip((1.0, 2.0), ends, strict=True):
        # The momentum of the centre of mass is m v along the sleigh and m a w across.
        rate, k = 0.3 * w / np.sqrt(0.29), np.sqrt(0.29)
        assert np.hypot(px, py) == pytest.approx(
            np.hypot(k * w * np.tanh(rate * 6), 0.3 * w / np.cosh(rate * 6)), rel=1e-3
        )


# ---- Refusals ----


def given(kind=Simulate, rolling=None, start=None, **options):
    """Return a function that makes a problem of the unicycle from functions of its quantities."""

    def made():
        basis = unicycle() if kind is Control else blade()
        (r,) = parameters(r=1.0)
        q = *basis.start, r
        at_start = dict(zip(q, start(r) if start else (0, 0, 0.3, 0, 0, TURN), strict=False))
        written = {name: value(*q) if callable(value) else value for name, value in options.items()}
        constraint = rolling(*q) if rolling else basis.rolling
        return replace(basis, rolling=constraint, start=at_start, **written)

    return made


REFUSED = {
    "a square of a velocity": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [dx**2 + dy**2 - r**2]), {}, ExpressionError,
        "rolling -r**2 + dx**2 + dy**2 = 0 is not linear in the velocities",
    ),
    "a product of velocities": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [dx * dy - sin(phi)]), {}, ExpressionError,
        "its derivative by dx and dy is not zero",
    ),
    "no velocity": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [x - r * y]), {}, ExpressionError,
        "rolling x - y*r = 0 has no velocity; write it in constraint",
    ),
    "an inequality": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [dx <= r * dy]), {}, ExpressionError, "is an inequality",
    ),
    "no list": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: dx - r * dy), {}, ExpressionError,
        "rolling is a single expression; write rolling as [",
    ),
    "a constant": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [1]), {}, ExpressionError, "never holds",
    ),
    "one constraint in two ways": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [dx * sin(phi) - dy * cos(phi), dx * sin(phi) ** 2
                                                           - dy * sin(phi) * cos(phi)]),
        {}, DegenerateError,
        "dx*sin(phi) - dy*cos(phi) = 0 and dx*sin(phi)**2 - dy*sin(phi)*cos(phi) = 0 depend on each other",
    ),
    "the rate of a holonomic constraint": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [x * dx + y * dy], start=lambda r: (1, 0, 0, 0, 0, 0),
              constraint=lambda x, y, phi, dx, dy, dphi, r: [x**2 + y**2 - 1]),
        {}, DegenerateError, "d/dt (x**2 + y**2 - 1) = 0 and dx*x + dy*y = 0 depend on each other",
    ),
    "as many constraints as coordinates": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [dx * sin(phi) - dy * cos(phi), dx + dy - r * dphi, dphi]),
        {}, DegenerateError, "3 constraints on 3 coordinates leave nothing to move",
    ),
    "a start that slips": (
        given(start=lambda r: (0, 0, 0.3, 1, 0, 0)), {}, BoundaryError,
        "start violates rolling dx*sin(phi) - dy*cos(phi) = 0 by 0.29552",
    ),
    "a start that slips, by a long equation": (
        given(start=lambda r: (0, 0, 0.3, 1, 0, 0), rolling=lambda x, y, phi, dx, dy, dphi, r: [
            dx * sin(phi) - dy * cos(phi) + Add(*(r * dphi * sin(phi) ** n for n in range(2, 9)))]), {}, BoundaryError,
        "start violates equation 1 of rolling by 0.29552",
    ),
    "a parameter with which the start slips": (
        given(start=lambda r: (0, 0, 0, 0, r - 1, 0)), {"parameters": {"r": 1.5}}, NumericsError,
        "violate the rolling constraint dx*sin(phi) - dy*cos(phi) = 0, whose value is -0.5",
    ),
    "a start without a direction": (
        given(rolling=lambda x, y, phi, dx, dy, dphi, r: [x * dx + y * dphi], start=lambda r: (0, 0, 0, 1, 0, 0)), {},
        NumericsError, "the gradient of the constraint dphi*y + dx*x = 0 vanishes",
    ),
    "a scheme with inner points": (given(), {"scheme": "gauss-4"}, SchemeError, "use midpoint or trapezoidal"),
    "the Hamiltonian method": (given(), {"method": "hamiltonian"}, ArgumentError, "use --method variational"),
    "an end that slips": (
        given(Control, end=lambda x, y, phi, dx, dy, dphi, r: {x: 1, phi: 0, dx: 0, dy: r}), {}, BoundaryError,
        "end violates rolling dx*sin(phi) - dy*cos(phi) = 0 by 1",
    ),
    "an end that slips with another parameter": (
        given(Control, end=lambda x, y, phi, dx, dy, dphi, r: {x: 1, phi: 0, dx: 0, dy: r - 1}),
        {"parameters": {"r": 1.5}}, BoundaryError, "for other values of r; write velocities in r",
    ),
    "a condition on velocities on the way": (
        given(Control, at=lambda x, y, phi, dx, dy, dphi, r: {0.5: [Eq(dx, 0.3)]}), {}, BoundaryError,
        "depends on velocities, with rolling constraints",
    ),
    "a control scheme with inner points": (
        given(Control), {"scheme": "gauss-4"}, SchemeError, "use midpoint or trapezoidal",
    ),
    "a periodic motion that ends in another direction": (
        given(Control, start=lambda r: (0, 0), end={},
              periodic=lambda x, y, phi, dx, dy, dphi, r: {x: 0, y: 0, phi: 1, dx: 0, dy: 0, dphi: 0}),
        {}, BoundaryError, "is not the same at both ends of a periodic motion",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_are_one_line_that_names_the_constraint(case):
    problem, options, kind, words = REFUSED[case]
    with pytest.raises(CodegenError) as caught:
        codegen.solve(problem(), **options)
    assert type(caught.value) is kind
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_rolling_needs_velocities_of_a_lagrangian_and_numbers():
    (x,) = codegen.states("x")
    with pytest.raises(ExpressionError, match="rolling x = 0 with dynamics; give a Lagrangian"):
        codegen.solve(Simulate(dynamics={x: -x}, rolling=[x], start={x: 1}, duration=1))
    particles = runpy.run_path(str(PROBLEMS / "lennard_jones.py"))["problem"]()
    (q,), (dq,) = coordinates("q")
    with pytest.raises(ExpressionError, match="rolling beside particles; leave it out"):
        codegen.solve(replace(particles, rolling=[q * dq]))
    control = unicycle()
    _, _, _, dx, _, dphi = control.start
    (f,) = (symbol for symbol in control.cost.free_symbols if symbol.name == "f")
    with pytest.raises(ExpressionError, match="depends on f; write it in path"):
        codegen.solve(replace(control, rolling=[dx - f]))
    radius = free_parameter("r", 1.0)
    with pytest.raises(ExpressionError, match="depends on r"):
        codegen.solve(replace(control, rolling=[dx - radius * dphi]))


# ---- Evidence ----


@pytest.mark.parametrize(
    ("problem", "scheme"),
    [(SLEIGH, "trapezoidal"), (SLEIGH, "suzuki-4-of-midpoint"), (DISC, "midpoint"), (SNAKEBOARD, "midpoint")],
)
def test_all_checks_of_rolling_problems_pass(problem, scheme):
    findings = list(checks.run(problem, scheme=scheme, steps=40))
    assert [finding for finding in findings if not finding.passed] == []
    found = {(finding.check, finding.subject) for finding in findings if finding.applies}
    assert ("problem as written", "equations of motion") in found
    assert any(check == "rolling constraints" for check, _ in found)


@pytest.mark.parametrize(
    ("problem", "written", "damaged", "failed"),
    [
        (SLEIGH, "values[1] = ", "values[1] = 2*", "node_constraints"),
        (SLEIGH, "residual[0] = ", "residual[0] = 1e-3 + ", "one step"),
    ],
)
def test_damage_of_a_rolling_constraint_in_the_module_fails_the_checks(
    tmp_path: Path, problem, written, damaged, failed
):
    text = generate(problem, {}, Choices(scheme="trapezoidal"))
    assert written in text
    module = tmp_path / "damaged.py"
    module.write_text(text.replace(written, damaged))
    findings = checks.run(problem, scheme="trapezoidal", module=module, steps=20)
    assert failed in {finding.subject for finding in findings if not finding.passed}


def test_a_model_with_another_force_fails_the_check_against_the_author(monkeypatch, tmp_path):
    """The force along (sin, cos) does work on virtual displacements; only the author's object knows."""
    from codegen.discretise.conditions import rolling

    honest = rolling.coefficients
    monkeypatch.setattr(
        rolling, "coefficients", lambda model, c: [(-1) ** i * e for i, e in enumerate(honest(model, c))]
    )
    module = tmp_path / "damaged.py"
    module.write_text(generate(SLEIGH, {}, Choices(scheme="midpoint")))
    monkeypatch.undo()
    findings = checks.run(SLEIGH, scheme="midpoint", module=module, steps=20)
    failed = {(finding.check, finding.subject) for finding in findings if not finding.passed}
    assert ("problem as written", "equations of motion") in failed


@pytest.mark.fast
def test_means_of_nodal_controls_beside_rolling_are_refused():
    with pytest.raises(SchemeError, match=r"rolling with nodal controls .* use --controls interval, .* trapezoidal"):
        codegen.solve(unicycle(), controls="nodal")
