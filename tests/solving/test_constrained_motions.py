"""Simulations with holonomic constraints, against elliptic functions and motions in angles by DOP853 of scipy."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import PROBLEMS
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk, eval_laguerre, roots_laguerre
from sympy import cos, sin

import codegen
from codegen import Simulate, coordinates, parameters, time
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
from codegen.solving.compiler import generate

DOUBLE = PROBLEMS / "double_pendulum_cartesian.py"
ANGLE, LENGTH, GRAVITY, DURATION = 1.2, 1.3, 9.81, 3.0
LIMIT = 1e-12


def pendulum() -> Simulate:
    """Release a pendulum at rest, in the plane."""
    (x, y), (dx, dy) = coordinates("x y")
    g, length, a = parameters(g=GRAVITY, l=LENGTH, a=ANGLE)
    return Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - g * y,
        constraint=[x**2 + y**2 - length**2],
        duration=DURATION,
        start={x: length * sin(a), y: -length * cos(a), dx: 0, dy: 0},
    )


def exact_angle(t):
    """Return the angle at times t: 2 asin(k cd(omega t, k)), with the modulus k = sin(ANGLE/2)."""
    k, omega = np.sin(ANGLE / 2), np.sqrt(GRAVITY / LENGTH)
    return 2 * np.arcsin(k * ellipj(omega * t + ellipk(k**2), k**2)[0])


def slopes(errors, steps):
    return np.diff(np.log(errors)) / -np.diff(np.log(steps))


@pytest.mark.parametrize(
    ("scheme", "order"), [("trapezoidal", 2), ("midpoint", 2), ("rectangle", 1), ("suzuki-4-of-trapezoidal", 4)]
)
def test_pendulum_has_the_order_of_its_scheme_against_elliptic_functions(scheme, order):
    solver, errors, steps = codegen.compile(pendulum(), scheme=scheme), [], [200, 400, 800]
    for n in steps:
        result = solver.solve(steps=n)
        exact = exact_angle(result.t)
        places = LENGTH * np.column_stack([np.sin(exact), -np.cos(exact)])
        errors.append(np.abs(result.q - places).max())
    assert slopes(errors, steps) == pytest.approx(order, abs=0.1)
    assert errors[-1] < {1: 0.03, 2: 2e-4, 4: 1e-7}[order]


def test_trapezoidal_pendulum_is_rattle():
    """One step of RATTLE by hand: Hairer, Lubich and Wanner (2006), (VII.1.26), for unit mass and a unit rod."""
    (x, y), (dx, dy) = coordinates("x y")
    q, p, h, g = np.array([0.6, -0.8]), np.array([0.8, 0.6]), 0.05, 9.81
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - g * y,
        constraint=[x**2 + y**2 - 1],
        duration=h,
        start={x: q[0], y: q[1], dx: p[0], dy: p[1]},
        steps=1,
    )
    result = codegen.solve(problem, scheme="trapezoidal")
    # |q + h (p + h/2 f) - r q|^2 = 1 is a quadratic equation for r, whose small root belongs to the step.
    free = q + h * (p + h / 2 * np.array([0.0, -g]))
    r = np.roots([q @ q, -2 * free @ q, free @ free - 1]).min()
    new = free - r * q
    half = (new - q) / h + h / 2 * np.array([0.0, -g])
    assert result.q[1] == pytest.approx(new, abs=1e-14)
    assert result.p[1] == pytest.approx(half - (half @ new) * new, abs=1e-13)


@pytest.mark.parametrize("scheme", ["trapezoidal", "midpoint"])
def test_spherical_pendulum_in_a_quartic_potential_has_order_two(scheme):
    """For this potential the two schemes differ. The reference is DOP853 in the angles theta and phi."""
    (x, y, z), (dx, dy, dz) = coordinates("x y z")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2 + dz**2) / 2 - 3 * z - x**4 - x * y * z,
        constraint=[x**2 + y**2 + z**2 - 1],
        force={x: -dx / 5, y: -dy / 5, z: -dz / 5},
        duration=2,
        start={x: 0.8, y: 0, z: -0.6, dx: 0, dy: 1, dz: 0},
    )

    def field(t, state):
        place, speed = state[:3], state[3:]
        a, b, c = place
        force = np.array([-4 * a**3 - b * c, -a * c, -3 - a * b]) - speed / 5
        return np.concatenate([speed, force - (force @ place + speed @ speed) * place])

    start = np.array([0.8, 0, -0.6, 0, 1, 0])
    exact = solve_ivp(field, (0, 2), start, "DOP853", rtol=1e-12, atol=1e-13).y[:3, -1]
    solver, steps = codegen.compile(problem, scheme=scheme), [100, 200, 400]
    errors = [np.abs(solver.solve(steps=n).q[-1] - exact).max() for n in steps]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    assert errors[-1] < 2e-4


def test_schemes_differ_in_a_quartic_potential():
    (x, y), (dx, dy) = coordinates("x y")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - x**4, constraint=[x**2 + y**2 - 1], duration=1,
        start={x: 0.6, y: 0.8, dx: 0.8, dy: -0.6}, steps=20,
    )  # fmt: skip
    ends = [codegen.solve(problem, scheme=scheme).q[-1] for scheme in ("midpoint", "trapezoidal")]
    assert 1e-5 < np.abs(ends[0] - ends[1]).max() < 1e-2


@pytest.mark.parametrize("scheme", ["trapezoidal", "midpoint"])
def test_double_pendulum_follows_its_angles(scheme):
    """The reference is the textbook's motion of two unit masses on unit rods, in angles."""

    def field(t, state):
        a, b, da, db = state
        mass = np.array([[2, np.cos(a - b)], [np.cos(a - b), 1]])
        force = [-np.sin(a - b) * db**2 - 2 * 9.81 * np.sin(a), np.sin(a - b) * da**2 - 9.81 * np.sin(b)]
        return np.concatenate([[da, db], np.linalg.solve(mass, force)])

    a, b = solve_ivp(field, (0, 1.5), [np.pi / 2, np.pi / 2, 0, 0], "DOP853", rtol=1e-12, atol=1e-13).y[:2, -1]
    exact = [np.sin(a), -np.cos(a), np.sin(a) + np.sin(b), -np.cos(a) - np.cos(b)]
    solver, steps = codegen.compile(DOUBLE, scheme=scheme), [300, 600, 1200]
    errors = [np.abs(solver.solve(steps=n, parameters={"duration": 1.5}).q[-1] - exact).max() for n in steps]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    assert errors[-1] < 1e-3


def test_double_pendulum_keeps_constraints_and_energy_over_many_steps():
    """|c| and |dc/dt| at each of 200 001 nodes; the energy of equal stretches of the motion."""
    result = codegen.solve(DOUBLE, scheme="trapezoidal", steps=200_000, parameters={"duration": 400})
    assert result.solved
    assert len(result.t) == 200_001
    (x1, y1, x2, y2), (vx1, vy1, vx2, vy2) = result.q.T, result.p.T
    assert np.abs(x1**2 + y1**2 - 1).max() < LIMIT
    assert np.abs((x2 - x1) ** 2 + (y2 - y1) ** 2 - 1).max() < LIMIT
    assert np.abs(x1 * vx1 + y1 * vy1).max() < LIMIT
    assert np.abs((x2 - x1) * (vx2 - vx1) + (y2 - y1) * (vy2 - vy1)).max() < LIMIT
    first, second = x1**2 + y1**2 - 1, (x2 - x1) ** 2 + (y2 - y1) ** 2 - 1
    assert result.summary["constraint_error"] == pytest.approx(np.abs([first, second]).max(), abs=1e-15)
    assert result.summary["constraint_rate"] < LIMIT
    error = result.energy - result.energy[0]
    means = error[1:].reshape(8, -1).mean(axis=1)
    assert np.abs(error).max() < 0.05  # of 2 g
    assert np.ptp(means) < 1e-3
    assert abs(np.polyfit(result.t, error, 1)[0]) * 400 < 1e-3


def test_driven_constraint_follows_the_angle_of_a_pendulum_with_a_moving_pivot():
    """The pivot is at (sin t, 0); the reference is theta'' = -g sin theta + sin t cos theta."""
    (x, y), (dx, dy) = coordinates("x y")
    t = time()
    problem = Simulate(
        lagrangian=(dx**2 + dy**2) / 2 - GRAVITY * y,
        constraint=[(x - sin(t)) ** 2 + y**2 - 1],
        duration=2,
        start={x: 0, y: -1, dx: 1, dy: 0},
    )
    exact = solve_ivp(
        lambda t, s: [s[1], -GRAVITY * np.sin(s[0]) + np.sin(t) * np.cos(s[0])],
        (0, 2), [0, 0], "DOP853", rtol=1e-12, atol=1e-14,
    ).y[0, -1]  # fmt: skip
    solver, steps = codegen.compile(problem, scheme="trapezoidal"), [100, 200, 400]
    results = [solver.solve(steps=n) for n in steps]
    places = np.array([np.sin(2) + np.sin(exact), -np.cos(exact)])
    errors = [np.abs(result.q[-1] - places).max() for result in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    last = results[-1]
    along = (last.q[:, 0] - np.sin(last.t)) * (last.p[:, 0] - np.cos(last.t)) + last.q[:, 1] * last.p[:, 1]
    assert np.abs((last.q[:, 0] - np.sin(last.t)) ** 2 + last.q[:, 1] ** 2 - 1).max() < LIMIT
    assert np.abs(along).max() < LIMIT


def test_linear_constraint_in_polar_coordinates_is_a_pendulum():
    """The mass matrix depends on the position, and the constraint r = l is eliminated from the step."""
    (r, q), (dr, dq) = coordinates("r q")
    (length,) = parameters(l=LENGTH)
    problem = Simulate(
        lagrangian=(dr**2 + r**2 * dq**2) / 2 + GRAVITY * r * cos(q),
        constraint=[r - length],
        duration=DURATION,
        start={r: length, q: ANGLE, dr: 0, dq: 0},
    )
    solver, steps = codegen.compile(problem, scheme="midpoint"), [200, 400, 800]
    results = [solver.solve(steps=n) for n in steps]
    errors = [np.abs(result.q[:, 1] - exact_angle(result.t)).max() for result in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    assert np.abs(results[-1].q[:, 0] - LENGTH).max() < LIMIT
    assert np.abs(results[-1].p[:, 0]).max() < LIMIT


def test_mass_matrix_that_couples_many_coordinates():
    """Five beads in a row, each sum of neighbours a coordinate; the constrained motion is a harmonic oscillation."""
    names = " ".join(f"s{i}" for i in range(5))
    (*s,), (*ds,) = coordinates(names)
    # x_i = s_0 + ... + s_i, with unit masses on unit springs at the origin; the constraint joins the last two beads.
    x, v = ([sum(values[: i + 1]) for i in range(5)] for values in (s, ds))
    problem = Simulate(
        lagrangian=sum(b**2 for b in v) / 2 - sum((i + 1) * a**2 for i, a in enumerate(x)) / 2,
        constraint=[x[4] - 2 * x[3]],
        duration=2,
        start={q: float(value) for q, value in zip(s, [1, 0, 0, 0, 1], strict=True)} | dict.fromkeys(ds, 0),
    )
    solver, steps = codegen.compile(problem, scheme="trapezoidal"), [50, 100, 200]
    # Beads 3 and 4 have the kinetic energy 5 v^2/2 and the potential energy (4 + 20) x^2/2.
    exact = np.array([np.cos(np.sqrt(k) * 2) for k in (1, 2, 3, 24 / 5)])
    errors = [np.abs(np.cumsum(solver.solve(steps=n).q[-1])[:4] - exact).max() for n in steps]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)


def quaternion_body(added: float = 1.0) -> Simulate:
    """Spin a free rigid body with the moments of inertia 1, 2, 3; `added` is a factor of the square of a rate."""
    (q0, q1, q2, q3), (d0, d1, d2, d3) = coordinates("q0 q1 q2 q3")
    spin = (
        2 * (q0 * d1 - q1 * d0 - q2 * d3 + q3 * d2),
        2 * (q0 * d2 - q2 * d0 - q3 * d1 + q1 * d3),
        2 * (q0 * d3 - q3 * d0 - q1 * d2 + q2 * d1),
    )
    return Simulate(
        lagrangian=(spin[0] ** 2 + 2 * spin[1] ** 2 + 3 * spin[2] ** 2) / 2
        + added * (q0 * d0 + q1 * d1 + q2 * d2 + q3 * d3) ** 2,
        constraint=[q0**2 + q1**2 + q2**2 + q3**2 - 1],
        duration=4,
        start={q0: 1, q1: 0, q2: 0, q3: 0, d0: 0, d1: 0.1, d2: 1, d3: 0.2},
    )


def product(a, b):
    """Return the product of two quaternions."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[scalar], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def test_rigid_body_by_a_quaternion_follows_the_equations_of_euler():
    """The reference is DOP853 for I w' = I w x w and q' = q w/2. The spatial angular momentum is a momentum map."""
    inertia = np.array([1.0, 2.0, 3.0])

    def field(t, state):
        q, w = state[:4], state[4:]
        return np.concatenate([product(q, np.array([0, *w])) / 2, np.cross(inertia * w, w) / inertia])

    start = np.array([1, 0, 0, 0, 0.2, 2, 0.4])
    exact = solve_ivp(field, (0, 4), start, "DOP853", rtol=1e-12, atol=1e-13).y[:4, -1]
    solver, steps = codegen.compile(quaternion_body(), scheme="trapezoidal"), [200, 400, 800]
    results = [solver.solve(steps=n) for n in steps]
    errors = [np.abs(result.q[-1] - exact).max() for result in results]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    units = np.eye(4)[1:]
    momentum = np.array(
        [[p @ product(e, q) / 2 for e in units] for q, p in zip(results[0].q, results[0].p, strict=True)]
    )
    assert momentum[0] == pytest.approx(inertia * start[4:])
    assert np.abs(momentum - momentum[0]).max() < 1e-12
    assert np.abs(np.linalg.norm(results[0].q, axis=1) - 1).max() < LIMIT


def test_a_lagrangian_without_kinetic_energy_across_a_constraint_is_refused():
    with pytest.raises(DegenerateError, match="across a constraint, add the square of its time derivative"):
        codegen.solve(quaternion_body(added=0))


# ---- Refusals ----


def planar(constraint, start=(1, 0, 0, 0), lagrangian=None, **options):
    """Return a particle of unit mass in the plane, with these constraints of (x, y, l) and start (x, y, dx, dy)."""
    (x, y), (dx, dy) = coordinates("x y")
    (length,) = parameters(l=1.0)
    return Simulate(
        lagrangian=(dx**2 + dy**2) / 2 + 0 * length,
        constraint=constraint(x, y, length),
        start=dict(zip((x, y, dx, dy), start, strict=True)),
        **{"duration": 1, "steps": 20, **options},
    )


def circle(x, y, length):
    return [x**2 + y**2 - length**2]


REFUSED = {
    "a start beside the constraint": (
        lambda: planar(circle, (1, 0.5, 0, 0)), {}, BoundaryError, "start violates constraint -l**2 + x**2 + y**2 = 0",
    ),
    "a velocity across the constraint": (
        lambda: planar(circle, (1, 0, 0.5, 0)), {}, BoundaryError,
        "the rate of constraint -l**2 + x**2 + y**2 = 0 by 1",
    ),
    "a parameter that moves the constraint": (
        lambda: planar(circle), {"parameters": {"l": 1.2}}, NumericsError,
        "start violates the constraint -l**2 + x**2 + y**2 = 0, whose value is -0.44",
    ),
    "a gradient that vanishes": (
        lambda: planar(lambda x, y, a: [circle(x, y, a)[0] ** 2]), {}, NumericsError,
        "the gradient of the constraint (-l**2 + x**2 + y**2)**2 = 0 vanishes",
    ),
    "one constraint twice": (
        lambda: planar(lambda x, y, a: [x**2 + y**2 - 1, 2 * x**2 + 2 * y**2 - 2]), {}, DegenerateError,
        "x**2 + y**2 - 1 = 0 and 2*x**2 + 2*y**2 - 2 = 0 depend on each other",
    ),
    "as many constraints as coordinates": (
        lambda: planar(lambda x, y, a: [x**2 + y**2 - 1, x - 1]), {}, DegenerateError, "leave nothing to move",
    ),
    "an inequality": (
        lambda: planar(lambda x, y, a: [x**2 + y**2 <= 1]), {}, ExpressionError, "is an inequality",
    ),
    "a scheme with inner points": (
        lambda: planar(circle), {"scheme": "gauss-4"}, SchemeError, "use midpoint or trapezoidal",
    ),
    "the Hamiltonian method": (
        lambda: planar(circle), {"method": "hamiltonian"}, ArgumentError, "use --method variational",
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


def test_constraints_that_depend_on_each_other_on_the_constraint_manifold_only():
    (x, y, z), (dx, dy, dz) = coordinates("x y z")
    problem = Simulate(
        lagrangian=(dx**2 + dy**2 + dz**2) / 2, constraint=[x**2 + y**2 - 1, (x**2 + y**2 - 1) * z], duration=1,
        start={x: 1, y: 0, z: 1, dx: 0, dy: 0, dz: 0},
    )  # fmt: skip
    with pytest.raises(NumericsError) as caught:
        codegen.solve(problem)
    assert "the constraints x**2 + y**2 - 1 = 0 and z*(x**2 + y**2 - 1) = 0 depend on each other" in str(caught.value)


def test_a_motion_into_a_singular_point_ends_with_the_name_of_the_constraint():
    """A bead on the crossing lines x y = 0 reaches the crossing after 64 steps of length 1/64."""
    result = codegen.solve(planar(lambda x, y, a: [x * y], (1, 0, -1, 0), duration=2, steps=128), scheme="trapezoidal")
    assert result.status == "singular"
    assert result.q[-1] == pytest.approx([1 / 64, 0])
    assert "the gradient of the constraint x*y = 0 vanishes there" in result.message


def test_a_constraint_of_a_simulation_with_first_order_dynamics_is_refused():
    (x,) = codegen.states("x")
    with pytest.raises(ExpressionError, match="constraint x = 0 beside dynamics; give a Lagrangian"):
        codegen.solve(Simulate(dynamics={x: -x}, constraint=[x], start={x: 1}, duration=1))


def test_a_constraint_of_particles_is_refused():
    particles = runpy.run_path(str(PROBLEMS / "lennard_jones.py"))["problem"]()
    (x,), _ = coordinates("x")
    with pytest.raises(ExpressionError, match="constraint beside particles; leave it out"):
        codegen.solve(replace(particles, constraint=[x]))


# ---- Evidence ----


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal", "suzuki-4-of-midpoint"])
def test_all_checks_of_a_constrained_simulation_pass(scheme):
    findings = list(checks.run(DOUBLE, scheme=scheme, steps=50))
    assert [finding for finding in findings if not finding.passed] == []
    found = {(finding.check, finding.subject) for finding in findings if finding.applies}
    assert ("problem as written", "equations of motion") in found
    assert ("derivatives", "node_constraints") in found
    assert ("holonomic drift", "rate of x1**2 + y1**2 - 1") in found


@pytest.mark.parametrize(
    ("written", "damaged", "failed"),
    [("values[1] = ", "values[1] = 2*", "node_constraints"), ("residual[0] = ", "residual[0] = 1e-3 + ", "one step")],
)
def test_damage_of_a_constraint_in_the_module_fails_the_checks(tmp_path: Path, written, damaged, failed):
    text = generate(DOUBLE, {}, Choices(scheme="trapezoidal"))
    assert written in text
    module = tmp_path / "damaged.py"
    module.write_text(text.replace(written, damaged))
    findings = checks.run(DOUBLE, scheme="trapezoidal", module=module, steps=20)
    assert failed in {finding.subject for finding in findings if not finding.passed}


def chain(links: int) -> Simulate:
    """Release a horizontal chain of unit masses and unit links, which hangs at one end."""
    q, v = coordinates(" ".join(f"x{i} y{i}" for i in range(links)))
    places, speeds = [*zip(q[::2], q[1::2], strict=True)], [*zip(v[::2], v[1::2], strict=True)]
    pairs = zip([(0, 0), *places], places, strict=False)
    return Simulate(
        lagrangian=sum(dx**2 + dy**2 for dx, dy in speeds) / 2 - 9.81 * sum(y for _, y in places),
        constraint=[(x - a) ** 2 + (y - b) ** 2 - 1 for (a, b), (x, y) in pairs],
        duration=0.5,
        start={**{q[2 * i]: i + 1 for i in range(links)}, **dict.fromkeys(q[1::2], 0), **dict.fromkeys(v, 0)},
    )


@pytest.mark.parametrize("links", [6, 12], ids="written out, in loops".split(", "))
def test_steps_of_a_chain_are_solved_in_a_band(links):
    """The reference is DOP853 for the angles of the links to the vertical."""

    def field(t, state):
        angle, rate = state[:links], state[links:]
        hanging = links - np.maximum.outer(np.arange(links), np.arange(links))
        between = np.subtract.outer(angle, angle)
        weight = 9.81 * (links - np.arange(links)) * np.sin(angle)
        force = -(hanging * np.sin(between)) @ rate**2 - weight
        return np.concatenate([rate, np.linalg.solve(hanging * np.cos(between), force)])

    start = np.concatenate([np.full(links, np.pi / 2), np.zeros(links)])
    angle = solve_ivp(field, (0, 0.5), start, "DOP853", rtol=1e-12, atol=1e-13).y[:links, -1]
    exact = np.column_stack([np.cumsum(np.sin(angle)), -np.cumsum(np.cos(angle))]).ravel()
    solver, steps = codegen.compile(chain(links), scheme="trapezoidal"), [100, 200, 400]
    below, above = solver.module.problem.bands
    assert 2 * below + above < solver.module.problem.unknowns
    errors = [np.abs(solver.solve(steps=n).q[-1] - exact).max() for n in steps]
    assert slopes(errors, steps) == pytest.approx(2, abs=0.1)
    assert errors[-1] < 1e-4


@pytest.fixture(scope="module")
def long_chain():
    return codegen.compile(PROBLEMS / "chain.py", scheme="trapezoidal")


def test_long_chain_keeps_constraints_and_energy(long_chain):
    result = long_chain.solve(steps=2000)
    places = np.hstack([np.zeros((len(result.t), 2)), result.q])
    lengths = np.hypot(*(np.diff(places[:, i::2]) for i in range(2)))
    assert np.abs(64 * lengths - 1).max() < 1e-12
    energies = (32 * result.p**2).sum(axis=1) + 9.81 * result.q[:, 1::2].mean(axis=1)
    errors = np.abs(energies - energies[0])
    assert errors.max() < 1e-5
    assert errors[1500:].max() < 2 * errors[:500].max()


def test_long_chain_swings_in_its_lowest_mode(long_chain):
    """Small swings of n beads on a chain of length 1 have omega^2 = g n z with a zero z of the Laguerre polynomial L_n.

    The bead above j others is displaced in proportion to L_j(z), by the recurrence of the polynomials.
    """
    n, amplitude = 64, 1e-6
    z = roots_laguerre(n)[0][0]
    across = amplitude * np.array([eval_laguerre(n - i, z) for i in range(1, n + 1)])
    down = -np.cumsum(np.sqrt(1 / n**2 - np.diff(across, prepend=0) ** 2))
    start = np.concatenate([np.column_stack([across, down]).ravel(), np.zeros(2 * n)])
    result = long_chain.module.solve(1000, start=start)
    exact = np.outer(np.cos(np.sqrt(9.81 * n * z) * result.t), across)
    assert np.abs(result.q[:, ::2] - exact).max() < 1e-4 * amplitude
