"""Problems of several phases with rotations, unit vectors and rolling constraints, against closed forms.

Along one axis a sphere is a double integrator. The least integral of the square of an acceleration, from speed v to
speed w over the distance s in the time T, is (12 s^2 - 12 s T (v + w) + 4 T^2 (v^2 + v w + w^2))/T^3.
"""

import numpy as np
import pytest
from scipy.optimize import fsolve, minimize, minimize_scalar
from scipy.spatial.transform import Rotation
from sympy import Matrix, cos, eye, sin

import codegen
from codegen import Control, Phases, controls, coordinates, direction, parameter, rotation
from codegen.errors import BoundaryError, ExpressionError, SymbolError

AXIS = np.array([1.0, 2.0, 2.0]) / 3


def effort(s, v, w, T=1.0):
    return (12 * s**2 - 12 * s * T * (v + w) + 4 * T**2 * (v**2 + v * w + w**2)) / T**3


def turned(result):
    """Return the rotation vectors of all steps."""
    attitudes = Rotation.from_quat(result.q[:, :4], scalar_first=True)
    return (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()


def slew(ends, inertias=(1, 1), jumps=()):
    """Turn a sphere in two phases of one second each, with the least torque, from rest."""
    R, omega = rotation("R")
    u = Matrix(controls("u1:4"))
    start = {"start": {R: eye(3), omega: (0, 0, 0)}}
    return Phases(
        *(
            Control(
                lagrangian=J * omega.dot(omega) / 2,
                force={R: u},
                cost=u.dot(u),
                duration=1,
                end=end(R, omega),
                steps=40,
                **(start if number == 0 else {}),
            )
            for number, (J, end) in enumerate(zip(inertias, ends, strict=True))
        ),
        jumps=[jump(omega) for jump in jumps],
    )


def at_rest(axis, angle):
    return lambda R, omega: {R: (axis, angle), omega: (0, 0, 0)}


def free(R, omega):
    return {}


def test_a_stop_at_an_attitude():
    """Two slews from rest to rest, about different axes."""
    one, other = (Rotation.from_rotvec(angle * axis) for angle, axis in ((1.0, np.eye(3)[2]), (1.2, np.eye(3)[0])))
    ends = [at_rest([0, 0, 1], 1.0), lambda R, omega: {R: (one * other).as_matrix(), omega: (0, 0, 0)}]
    result = codegen.solve(slew(ends))
    assert result.status == "solved"
    assert result.cost == pytest.approx(effort(1.0, 0, 0) + effort(1.2, 0, 0), rel=2e-3)
    assert result["R"][40] == pytest.approx(one.as_matrix(), abs=1e-9)


def test_an_angular_velocity_at_a_switch_without_an_attitude():
    """The spin is prescribed at the switch, and the attitude is free."""
    ends = [lambda R, omega: {omega: tuple(0.7 * AXIS)}, at_rest([1, 2, 2], 1.5)]
    result = codegen.solve(slew(ends))
    assert result.status == "solved"
    exact = minimize_scalar(lambda s: effort(s, 0, 0.7) + effort(1.5 - s, 0.7, 0)).fun
    assert result.cost == pytest.approx(exact, rel=2e-3)


@pytest.fixture(scope="module")
def booms():
    """Booms come out at the switch: the inertia of one grows to J, and the angular momentum is kept."""
    J = parameter("J", 2)
    return codegen.compile(slew([free, at_rest([1, 2, 2], 1.5)], (1, J), [lambda omega: {omega: omega / J}]))


def test_a_switch_without_conditions_leaves_the_slew_as_it_is(booms):
    """The inertia does not change. The optimum of both phases together is 12 angle^2/T^3 with T = 2."""
    result = booms.solve(parameters={"J": 1})
    assert result.status == "solved"
    assert result.cost == pytest.approx(12 * 1.5**2 / 8, rel=1e-3)
    assert turned(result).sum(axis=0) == pytest.approx(1.5 * AXIS, abs=1e-9)


def test_a_change_of_inertia_halves_the_spin(booms):
    result = booms.solve()
    assert result.status == "solved"
    exact = minimize(lambda x: effort(x[0], 0, x[1]) + 4 * effort(1.5 - x[0], x[1] / 2, 0), [0.7, 1.0], tol=1e-12).fun
    assert result.cost == pytest.approx(exact, rel=2e-3)
    turns = turned(result)
    assert turns.sum(axis=0) == pytest.approx(1.5 * AXIS, abs=1e-8)
    assert np.linalg.norm(turns[40]) == pytest.approx(np.linalg.norm(turns[39]) / 2, rel=0.05)


def test_a_switch_of_torque_bounds():
    """The torque is limited in the second phase alone: u = max(a - c t, -limit) after t = 1 for a unit sphere."""
    limit, angle = 0.9, 1.0
    R, omega = rotation("R")
    u = Matrix(controls("u1:4"))
    body = {"lagrangian": omega.dot(omega) / 2, "force": {R: u}, "cost": u.dot(u), "duration": 1, "steps": 40}
    problem = Phases(
        Control(**body, start={R: eye(3), omega: (0, 0, 0)}),
        Control(**body, end={R: ([0, 0, 1], angle), omega: (0, 0, 0)}, bounds={u[2]: (-limit, limit)}),
    )
    t = (np.arange(20_000) + 0.5) / 10_000  # midpoints of steps

    def torque(x):
        free = x[0] - x[1] * t
        return np.where(t > 1, np.maximum(free, -limit), free)

    a = fsolve(lambda x: [torque(x).mean(), 2 * ((2 - t) * torque(x)).mean() - angle], [1.5, 1.5], xtol=1e-12)
    result = codegen.solve(problem)
    assert result.status == "solved"
    assert result.cost == pytest.approx(2 * (torque(a) ** 2).mean(), rel=2e-3)
    assert result["u3"].min() == pytest.approx(-limit, abs=1e-6)
    assert result["u3"][:40].max() > 1.2


def test_a_ball_on_a_sphere_bounces_off_a_wall():
    """A point on the unit sphere is pushed along the equator to a wall, and back with 0.8 of its speed."""
    n, dn = direction("n")
    push = Matrix(controls("u1:4"))
    point = {"lagrangian": dn.dot(dn) / 2, "force": {n: push}, "cost": push.dot(push), "duration": 1, "steps": 40}
    problem = Phases(
        Control(**point, start={n: (1, 0, 0), dn: (0, 0, 0)}, end={n: (0, 1, 0)}),
        Control(**point, end={n: (cos(0.5), sin(0.5), 0), dn: (0, 0, 0)}),
        jumps=[{dn: -0.8 * dn}],
    )
    result = codegen.solve(problem)
    assert result.status == "solved"
    exact = minimize_scalar(lambda v: effort(np.pi / 2, 0, v) + effort(0.5 - np.pi / 2, -0.8 * v, 0)).fun
    assert result.cost == pytest.approx(exact, rel=2e-3)
    assert np.abs(np.linalg.norm(result.q[:, :3], axis=1) - 1).max() < 1e-12


def test_a_wheel_that_rolls_takes_another_load():
    """A wheel of inertia 1/2 and mass 1 rolls without slip. At the switch its mass grows by 1, the speed is kept."""
    (x, phi), (dx, dphi) = coordinates("x phi")
    (u,) = controls("u")

    def phase(mass, **others):
        kinetic = mass * dx**2 / 2 + dphi**2 / 4
        return Control(
            lagrangian=kinetic, force={phi: u}, rolling=[dx - dphi], cost=u**2, duration=1, steps=40, **others
        )

    at_rest = {x: 0, phi: 0, dx: 0, dphi: 0}
    problem = Phases(phase(1, start=at_rest), phase(2, end={**at_rest, x: 2, phi: 2}))
    result = codegen.solve(problem)
    assert result.status == "solved"

    def total(z):
        return 1.5**2 * effort(z[0], 0, z[1]) + 2.5**2 * effort(2 - z[0], z[1], 0)

    assert result.cost == pytest.approx(minimize(total, [1, 1], tol=1e-12).fun, rel=2e-3)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda w: {w: 3}, BoundaryError, "jumps of the angular velocity of R is 3"),
        (lambda w: {w[0]: 1}, SymbolError, "which was never declared"),
        (lambda w: {sorted(w.free_symbols, key=str)[4]: 1}, BoundaryError, "does not hold"),
    ],
    ids=["no vector", "component", "quaternion"],
)
def test_jumps_away_from_the_constraint_are_refused(make, error, text):
    with pytest.raises(error) as caught:
        codegen.solve(slew([free, at_rest([0, 0, 1], 1)], jumps=[make]))
    assert text in str(caught.value)


@pytest.mark.fast
def test_constraints_of_one_phase_alone_are_refused():
    (x, y), (dx, dy) = coordinates("x y")
    (u,) = controls("u")
    body = {"lagrangian": dx**2 + dy**2, "force": {x: u}, "cost": u**2, "duration": 1}
    problem = Phases(Control(**body, start={x: 0, y: 0, dx: 0, dy: 0}), Control(**body, end={x: 1}, rolling=[dy]))
    with pytest.raises(ExpressionError, match="rolling dy holds in one of the phases 1 and 2"):
        codegen.solve(problem)


def test_checks_pass_after_a_solve_of_two_phases(booms):
    """A solve takes the machine code of inner kernels away from Python. The layout check then ended the process."""
    assert booms.solve().status == "solved"
    findings = booms.check()
    assert findings.passed, [finding for finding in findings if not finding.passed]
    assert any(finding.check == "switches" and finding.applies for finding in findings)
