"""Contact-implicit optimal control against closed forms, phases in a prescribed order, and IPOPT."""

import numpy as np
import pytest
from conftest import PROBLEMS
from sympy import Eq, Symbol

import codegen
from codegen import (
    Control,
    Phases,
    Simulate,
    control,
    controls,
    coordinate,
    coordinates,
    free_parameter,
    parameters,
    states,
)
from codegen.emit.naming import Choices
from codegen.errors import (
    ArgumentError,
    BoundaryError,
    DegenerateError,
    ExpressionError,
    ProblemFileError,
    SchemeError,
    SymbolError,
)
from codegen.evidence import checks
from codegen.solving.compiler import generate

BLOCK, SHOVE, HOPPER = (PROBLEMS / f"{name}.py" for name in ("pushed_block", "shove", "hopper"))
G, MU = 9.81, 0.3
SMALL = 1e-6
"""Largest product of a contact law, relative to the forces and lengths of order one in these problems."""


def thrown(**options) -> Control:
    """A point without controls above a floor."""
    (x, y), (dx, dy) = coordinates("x y")
    m, g, mu = parameters(m=2, g=G, mu=MU)
    has_friction = options.pop("friction", False)
    return Control(
        lagrangian=m / 2 * (dx**2 + dy**2) - m * g * y,
        duration=1,
        unilateral={"floor": y >= 0},
        **({"friction": mu, "slip": [dx]} if has_friction else {}),
        start={x: 0, y: options.pop("height", 0), dx: options.pop("speed", 0), dy: 0},
        **{"steps": 40, **options},
    )


def pushed(**options) -> Control:
    """A block that is pushed over a rough floor; `options` replace arguments, and None leaves an argument out."""
    (x, y), (dx, dy) = coordinates("x y")
    (u,) = controls("u")
    m, g, mu = parameters(m=1, g=G, mu=MU)
    arguments = {
        "lagrangian": m / 2 * (dx**2 + dy**2) - m * g * y,
        "force": {x: u},
        "cost": u**2,
        "duration": 1,
        "start": {x: 0, y: 0, dx: 0, dy: 0},
        "end": {x: 1, y: 0, dx: 0, dy: 0},
        "unilateral": {"floor": y >= 0},
        "friction": mu,
        "slip": [dx],
        "steps": 6,
    }
    symbols = {"x": x, "y": y, "dx": dx, "dy": dy, "u": u, "m": m}
    arguments |= {name: value(symbols) if callable(value) else value for name, value in options.items()}
    return Control(**{name: value for name, value in arguments.items() if value is not None})


# ---- Closed forms ----


def test_a_falling_point_lands_without_a_rebound():
    result = codegen.solve(thrown(height=1))
    assert result.solved, result.message
    t, y = result.t, result.q[:, 1]
    flight = t < np.sqrt(2 / G)
    assert y[flight] == pytest.approx(1 - G * t[flight] ** 2 / 2, abs=1e-7)
    assert np.abs(y[t > np.sqrt(2 / G) + 2 * t[1]]).max() < SMALL
    assert result.gaps["floor"] == pytest.approx(y[1:], abs=1e-10)
    impulse = t[1] * result.u[:, result.names["u"].index("normal_floor")].sum()
    # The floor takes the momentum of the fall, then carries the weight; the last half step is not part of the motion.
    assert impulse == pytest.approx(2 * G * (1 - t[1] / 2), rel=1e-6)


def test_friction_stops_a_block_after_the_distance_of_coulombs_law():
    result = codegen.solve(thrown(speed=2, friction=True))
    assert result.solved, result.message
    distance, time = 2**2 / (2 * MU * G), 2 / (MU * G)
    sliding, resting = result.t < time, result.t > time + result.t[1]
    exact = 2 * result.t - MU * G * result.t**2 / 2
    assert result.q[sliding, 0] == pytest.approx(exact[sliding], abs=1e-6)
    assert result.q[resting, 0] == pytest.approx(distance, abs=2e-4)
    assert np.ptp(result.q[resting, 0]) < SMALL
    friction = result.u[:, result.names["u"].index("friction_floor")]
    assert friction[1:20] == pytest.approx(-MU * 2 * G, rel=1e-5)


def test_the_pyramid_of_friction_acts_on_the_faster_component_first():
    """All friction slows the component y until both velocities are equal; then each has half of the friction."""
    (x, y, z), (dx, dy, dz) = coordinates("x y z")
    problem = Control(
        lagrangian=(dx**2 + dy**2 + dz**2) / 2 - G * z,
        duration=1,
        start={x: 0, y: 0, z: 0, dx: 0.5, dy: -1.5, dz: 0},
        unilateral=[z >= 0],
        friction=MU,
        slip=[(dx, dy)],
        steps=40,
    )
    result = codegen.solve(problem)
    assert result.solved, result.message
    assert result.names["u"] == ("normal_1", "friction_1_1", "friction_1_2")
    first, second = 1 / (MU * G), 0.5 / (MU * G / 2)
    assert result.q[-1, 0] == pytest.approx(0.5 * first + 0.25 * second, rel=0.01)
    assert result.q[-1, 1] == pytest.approx(-1.0 * first - 0.25 * second, rel=0.01)
    assert np.abs(result.q[:, 2]).max() < SMALL


@pytest.mark.parametrize("n", [20, 40, 41])
def test_a_wall_stops_a_mass_at_the_end_without_effort(n):
    """The least effort over a distance d in the time T with a free velocity at the end is 3 d^2 / T^3."""
    x, dx = coordinate("x")
    u = control("u")
    problem = Control(
        lagrangian=dx**2 / 2,
        force={x: u},
        cost=u**2,
        duration=1,
        start={x: 0, dx: 0},
        end={x: 1, dx: 0},
        unilateral={"wall": 1 - x >= 0},
        steps=n,
    )
    result = codegen.solve(problem)
    assert result.solved, result.message
    assert result.cost == pytest.approx(3 / (1 - 1 / (4 * n**2)), rel=1e-5)


@pytest.mark.parametrize(("n", "part"), [(40, 0.045), (160, 0.025)])
def test_a_mass_waits_on_the_floor_and_is_lifted_with_the_least_effort(n, part):
    """The force m (g + a) without waiting has the cost m^2 (g^2 T + 12 d^2 / T^3), which is least for T^2 = 6 d / g."""
    y, dy = coordinate("y")
    u = control("u")
    m, height = 2, 0.5
    problem = Control(
        lagrangian=m * dy**2 / 2 - m * G * y,
        force={y: u},
        cost=u**2,
        duration=1,
        start={y: 0, dy: 0},
        end={y: height, dy: 0},
        bounds={u: (0, 60)},
        unilateral={"floor": y >= 0},
        steps=n,
    )
    result = codegen.solve(problem)
    assert result.solved, result.message
    time = np.sqrt(6 * height / G)
    exact = 4 / 3 * m**2 * G**2 * time
    assert exact < result.cost < (1 + part) * exact
    assert result.q[result.t < 0.9 * (1 - time), 0] == pytest.approx(0, abs=SMALL)
    assert result.summary["cost_error"] > 0.3 * (result.cost / exact - 1)


def test_a_block_is_pushed_with_the_least_effort_at_second_order():
    exact = 12 + (MU * G) ** 2
    errors, steps = [], (15, 30, 60)
    for n in steps:
        result = codegen.solve(BLOCK, steps=n)
        assert result.solved, result.message
        errors.append(result.cost - exact)
        u, normal, friction = result.u.T
        middle = (result.t[1:] + result.t[:-1]) / 2
        assert u == pytest.approx(MU * G + 6 * (1 - 2 * middle), abs=30 / n**2)
        assert normal[1:] == pytest.approx(G, rel=1e-6)
        assert friction[1:] == pytest.approx(-MU * G, rel=1e-6)
        assert result.p[:, 0] == pytest.approx(6 * (result.t - result.t**2), abs=20 / n**2)
        assert np.abs(result.p[:, 1]).max() < SMALL
        assert 0 < result.summary["complementarity"] < SMALL
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(2, abs=0.02)


def test_a_ball_waits_on_the_floor_before_it_rises():
    """It falls, rests and rises by 0.5 in time tau with effort g^2 tau + 3/tau^3, least at tau^4 = 9/g^2."""
    (y,), (dy,) = coordinates("y")
    (u,) = controls("u")
    problem = Control(
        lagrangian=dy**2 / 2 - G * y,
        force={y: u},
        cost=u**2,
        duration=1.5,
        start={y: 1, dy: 0},
        end={y: 0.5, dy: 0},
        unilateral={"floor": y >= 0},
        steps=100,
    )
    tau = (9 / G**2) ** 0.25
    result = codegen.solve(problem)
    assert result.solved, result.message
    assert result.cost == pytest.approx(G**2 * tau + 3 / tau**3, rel=0.05)
    resting = (result.t > np.sqrt(2) / np.sqrt(G) + 0.05) & (result.t < 1.5 - tau - 0.05)
    assert resting.sum() > 10
    assert np.abs(result.q[resting, 0]).max() < SMALL
    assert np.abs(result.u[resting[:-1], 0]).max() < 0.2


# ---- Other formulations ----


def in_phases(n: int) -> Phases:
    """The problem of `shove.py` with a prescribed sequence: approach, impact, common motion, return."""
    (x_1, x_2), (dx_1, dx_2) = coordinates("x_1 x_2")
    u, normal = controls("u normal")
    m_1, m_2, c = parameters(m_1=1, m_2=0.5, c=0.5)
    first, second = free_parameter("T_1", guess=0.5, lower=0.05), free_parameter("T_2", guess=0.2, lower=0.02)
    common = {"lagrangian": m_1 / 2 * dx_1**2 + m_2 / 2 * dx_2**2, "cost": u**2, "steps": n}
    apart = {x_1: u, x_2: -c * dx_2}
    after = (m_1 * dx_1 + m_2 * dx_2) / (m_1 + m_2)
    return Phases(
        Control(
            **common, force=apart, duration=first, start={x_1: 0, x_2: 0.3, dx_1: 0, dx_2: 0},
            end_conditions=[Eq(x_1, x_2)],
        ),
        Control(
            **common, force={x_1: u - normal, x_2: normal - c * dx_2}, duration=second, path=[Eq(dx_1, dx_2)],
            bounds={normal: (0, None)},
        ),
        Control(**common, force=apart, duration=2 - first - second, end={x_1: 0, x_2: 1, dx_1: 0}),
        jumps=[{dx_1: after, dx_2: after}, {}],
    )  # fmt: skip


def test_the_costs_tend_to_those_of_phases_in_the_right_sequence():
    coarse, fine = (codegen.solve(in_phases(n)) for n in (10, 20))
    assert coarse.solved
    assert fine.solved
    exact = fine.cost - (coarse.cost - fine.cost) / 3
    excess = []
    for n in (20, 40, 80):  # on finer grids rounding decides which of several contact sequences is found
        result = codegen.solve(SHOVE, steps=n)
        assert result.solved, result.message
        excess.append(result.cost / exact - 1)
    # The impact lies at a node, so that the order is one.
    assert 0 < excess[-1] < 0.04
    assert excess == sorted(excess, reverse=True)
    assert excess[0] / excess[-1] > 2.4


def relaxed_by_ipopt(casadi, result, relaxation):
    """Return the optimum that IPOPT finds for the equations of `shove.py`, from the given motion."""
    n, h = result.steps, 2 / result.steps
    opti, m, c = casadi.Opti(), np.array([1, 0.5]), 0.5
    q, u, normal = opti.variable(n + 1, 2), opti.variable(n), opti.variable(n)
    v = (q[1:, :] - q[:-1, :]) / h
    opti.minimize(h * casadi.sumsqr(u))
    for k in range(n):
        force = (h / 2 * u[k], -h / 2 * c * v[k, 1])
        contact = (-h * normal[k], h * normal[k])
        gap = q[k + 1, 1] - q[k + 1, 0]
        opti.subject_to([normal[k] >= 0, gap >= 0, normal[k] * gap <= relaxation])
        for i in range(2):
            before = 0 if k == 0 else m[i] * v[k - 1, i] + (h / 2 * u[k - 1], -h / 2 * c * v[k - 1, 1])[i]
            opti.subject_to(m[i] * v[k, i] - force[i] - contact[i] == before)
    opti.subject_to(m[0] * v[n - 1, 0] + h / 2 * u[n - 1] == 0)
    opti.subject_to([q[0, 0] == 0, q[0, 1] == 0.3, q[n, 0] == 0, q[n, 1] == 1])
    opti.set_initial(q, result.q)
    opti.set_initial(u, result.u[:, 0])
    opti.set_initial(normal, result.u[:, 1])
    quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.tol": 1e-10, "ipopt.bound_relax_factor": 0.0}
    close = dict.fromkeys(("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac"), 1e-9)
    opti.solver("ipopt", quiet | {"ipopt.mu_init": 1e-9} | {f"ipopt.{name}": value for name, value in close.items()})
    solution = opti.solve()
    return solution.value(opti.f), solution.value(q)


@pytest.mark.parametrize("relaxation", [1e-4, 1e-7])
def test_ipopt_finds_the_same_optimum_of_the_relaxed_program(relaxation):
    casadi = pytest.importorskip("casadi")
    result = codegen.solve(SHOVE, steps=20, parameters={"relaxation": relaxation})
    assert result.solved, result.message
    cost, q = relaxed_by_ipopt(casadi, result, relaxation)
    assert cost == pytest.approx(result.cost, rel=1e-6)
    assert q == pytest.approx(result.q, abs=1e-5)


def test_the_hopper_finds_its_contacts():
    result = codegen.solve(HOPPER)
    assert result.solved, result.message
    x, y, length, angle = result.q.T
    _, _, normal, friction = result.u.T
    height = y - length * np.cos(angle)
    foot = x + length * np.sin(angle)
    assert height.min() > -SMALL
    assert (normal * height[1:]).max() < SMALL
    assert np.abs(friction).max() <= 0.7 * normal.max() + SMALL
    assert (np.abs(friction) - 0.7 * normal).max() < SMALL
    sliding = np.diff(foot) / np.diff(result.t)
    assert np.abs(np.minimum(normal, np.abs(sliding))).max() > 0  # it moves in the air alone
    closed = height < 0.005  # the foot also moves by less in the first step
    assert closed[:12].all()
    assert closed[-4:].all()
    assert not closed[20:25].any()
    assert height.max() > 0.05
    # Stance, flight and stance: two changes of the contact.
    assert np.count_nonzero(np.diff(closed.astype(int))) == 2
    # Without forces of the floor the momentum of the body follows from weight alone.
    flying = np.flatnonzero(~closed[:-1] & ~closed[1:])
    change = np.diff(result.p[:, 1])[flying[1:-1]]
    assert change == pytest.approx(-1.1 * G * result.t[1], rel=1e-6)


# ---- Options, statuses and results ----


def test_all_checks_pass():
    findings = checks.run(SHOVE, steps=20)
    failed = [f"{finding.check}: {finding.subject}: {finding.detail}" for finding in findings if not finding.passed]
    assert not failed
    assert {"gap bumper", "normal force of bumper"} <= {f.subject for f in findings if f.check == "contact"}


def test_checks_pass_for_a_gap_that_is_open_until_the_end():
    """A crate reaches a wall at any speed: the force m a + f with a = 3 (1 - t) (1 + f/2m) - f/m has the least cost."""
    walled = {
        "unilateral": lambda s: {"floor": s["y"] >= 0, "wall": 1 - s["x"] >= 0},
        "friction": [MU, 0],
        "slip": lambda s: [s["dx"], ()],
        "end": lambda s: {s["x"]: 1, s["y"]: 0},
        "steps": 40,
    }
    problem = pushed(**walled)
    result = codegen.solve(problem)
    assert result.solved, result.message
    assert result.cost == pytest.approx(3 * (1 + MU * G / 2) ** 2, rel=1e-3)
    findings = [f for f in checks.run(problem, steps=40) if f.check == "contact"]
    assert {"gap wall", "normal force of wall"} <= {f.subject for f in findings}
    assert all(f.passed for f in findings)


@pytest.mark.parametrize("scheme", ["trapezoidal", "rectangle"])
def test_other_schemes_have_the_same_contact_laws(scheme):
    result = codegen.solve(pushed(steps=15), scheme=scheme)
    assert result.solved, result.message
    assert result.cost == pytest.approx(12 + (MU * G) ** 2, rel=0.02)
    assert np.abs(result.gaps["floor"]).max() < SMALL


def test_a_large_relaxation_is_named():
    result = codegen.solve(SHOVE, steps=20, parameters={"relaxation": 1e-2})
    assert result.solved
    assert any("default relaxation" in note for note in result.notes)
    assert result.summary["complementarity"] == pytest.approx(1e-2, rel=1e-6)


def test_warm_starts_sweeps_and_several_guesses():
    solver = codegen.compile(SHOVE)
    first = solver.solve(steps=20)
    warm = solver.solve(steps=20, warm=first)
    assert warm.solved
    assert warm.cost == pytest.approx(first.cost, rel=1e-8)
    assert warm.iterations < first.iterations / 2
    heavier = codegen.sweep(solver, vary={"m_2": [0.5, 0.6]}, steps=20)
    assert list(heavier.status.values) == ["solved", "solved"]
    assert float(heavier.cost[0]) == pytest.approx(first.cost, rel=1e-6)


def test_a_periodic_motion_has_contact_at_its_ends():
    """A point hops with the period T by impulses of the floor alone if a force along the vertical is free of charge."""
    (y,), (dy,) = coordinates("y")
    (u,) = controls("u")
    problem = Control(
        lagrangian=dy**2 / 2 - G * y,
        force={y: u},
        cost=u**2,
        duration=1,
        start={y: 0},
        periodic=[y, dy],
        unilateral={"floor": y >= 0},
        steps=20,
    )
    result = codegen.solve(problem)
    assert result.solved, result.message
    # It is best to rest: the floor carries the weight.
    assert result.cost == pytest.approx(0, abs=1e-6)
    assert result.u[:, 1].mean() == pytest.approx(G, rel=1e-6)


# ---- Bad input ----


def derived(problem, **options) -> str:
    """Return the text of the module of a problem."""
    return generate(problem, {}, Choices(**options))


BAD = [
    ({"end": lambda s: {s["x"]: 1, s["y"]: -1, s["dx"]: 0, s["dy"]: 0}}, BoundaryError, "end violates unilateral"),
    ({"start": lambda s: {s["x"]: 0, s["y"]: -1, s["dx"]: 0, s["dy"]: 0}}, BoundaryError, "start violates unilateral"),
    ({"friction": -0.2}, ExpressionError, "friction of floor is -0.2"),
    ({"friction": "rough"}, ExpressionError, "friction of floor is 'rough'"),
    ({"friction": lambda s: s["x"]}, ExpressionError, "friction of floor depends on x"),
    ({"friction": [0.1, 0.2]}, ExpressionError, "friction has 2 values for 1 gaps"),
    ({"unilateral": None}, ExpressionError, "friction without unilateral"),
    ({"unilateral": None, "friction": None}, ExpressionError, "slip without unilateral"),
    ({"slip": None}, ExpressionError, "no sliding velocity"),
    ({"friction": None}, ExpressionError, "no friction"),
    ({"slip": lambda s: s["dx"]}, ExpressionError, "slip is a single expression"),
    ({"slip": lambda s: [s["dx"] ** 2]}, ExpressionError, "not linear in the velocities"),
    ({"slip": lambda s: [s["x"]]}, DegenerateError, "depends on no velocity"),
    ({"slip": lambda s: [(s["dx"], s["dy"], s["dx"] + s["dy"])]}, ExpressionError, "3 velocities"),
    ({"slip": lambda s: [s["dx"], s["dx"]]}, ExpressionError, "slip has 2 entries for 1 gaps"),
    ({"unilateral": lambda s: {"floor": s["y"] + s["dy"] >= 0}}, ExpressionError, "depends on dy"),
    ({"unilateral": lambda s: {"floor": s["y"] + s["u"] >= 0}}, ExpressionError, "depends on u"),
    ({"unilateral": lambda s: {"floor": s["m"] >= 0}}, ExpressionError, "depends on no coordinate"),
    ({"unilateral": lambda s: {"floor": Symbol("w") >= 0}}, SymbolError, "w in unilateral floor was never declared"),
    ({"unilateral": lambda s: [Eq(s["y"], 0)]}, ExpressionError, "is no inequality"),
    ({"unilateral": lambda s: s["y"] >= 0}, ExpressionError, "unilateral is a single relation"),
    ({"constraint": lambda s: [s["x"] - 1]}, ExpressionError, "with a holonomic constraint"),
    ({"rolling": lambda s: [s["dx"] - s["dy"]]}, ExpressionError, "with a rolling constraint"),
    ({"bodies": 2}, ExpressionError, "with 2 bodies"),
]  # fmt: skip


@pytest.mark.fast
@pytest.mark.parametrize(("options", "kind", "text"), BAD)
def test_an_unusable_contact_is_one_line(options, kind, text):
    with pytest.raises(kind, match=text) as error:
        derived(pushed(**options))
    assert "\n" not in str(error.value)
    assert "; " in str(error.value)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("options", "kind", "text"),
    [
        ({"scheme": "gauss-4"}, SchemeError, "where gaps and contact forces are not imposed"),
        ({"method": "hamiltonian"}, ArgumentError, "no contact forces"),
        ({"controls": "linear", "scheme": "trapezoidal"}, ArgumentError, "contact forces belong to intervals"),
    ],
)
def test_an_unusable_option_is_one_line(options, kind, text):
    with pytest.raises(kind, match=text):
        derived(pushed(), **options)


@pytest.mark.fast
def test_unusable_problems_are_one_line():
    (_, y), (dx, dy) = coordinates("x y")
    (z,) = states("z")
    (u,) = controls("u")
    with pytest.raises(ProblemFileError, match="contacts of a Control are inelastic"):
        pushed(restitution=0.5)
    with pytest.raises(ProblemFileError, match="contacts of a simulation have no friction"):
        Simulate(lagrangian=dx**2 + dy**2, duration=1, start={}, unilateral=[y >= 0], friction=0.1)
    with pytest.raises(ExpressionError, match="with dynamics; give a Lagrangian"):
        derived(Control(dynamics={z: u}, cost=u**2, duration=1, start={z: 0}, end={z: 1}, unilateral=[z >= 0]))
    with pytest.raises(ExpressionError, match="phase 1: it has contact forces"):
        derived(Phases(pushed(), pushed(start=None)))
    with pytest.raises(BoundaryError, match="start leaves dx free"):
        derived(pushed(start=lambda s: {s["x"]: 0, s["y"]: 0}))
    with pytest.raises(ArgumentError, match="the sequence of contacts changes"):
        derived(pushed(), sensitivities=True)
