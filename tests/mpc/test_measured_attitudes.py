"""Controllers of bodies with rotations: measured attitudes have any sign, and may be matrices."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sympy import Matrix, diag, eye

from codegen import Control, Controller, controls, rotation
from codegen.errors import NumericsError
from codegen.mpc.controller import attitudes_of


@pytest.fixture(scope="module")
def problem() -> Control:
    R, omega = rotation("R")
    u = Matrix(controls("u1:4"))
    return Control(
        lagrangian=omega.dot(diag(1, 2, 3) * omega) / 2,
        force={R: u},
        cost=u.dot(u),
        duration=4,
        start={R: ([0, 0, 1], 1.0), omega: (0, 0, 0)},
        end={R: eye(3), omega: (0, 0, 0)},
        steps=20,
    )


def test_a_closed_loop_turns_back_whatever_the_signs_of_the_measured_quaternions(problem):
    """The plant is Euler's equation by small steps; the estimator returns each quaternion with a random sign."""
    inertia, random = np.array([1.0, 2.0, 3.0]), np.random.default_rng(3)
    R, omega = Rotation.from_rotvec([0.9, -0.8, 1.2]), np.array([0.1, 0.0, -0.2])
    controller = Controller(problem)
    angles, statuses = [R.magnitude()], set()
    for sample in range(15):
        q = R.as_quat(canonical=True, scalar_first=True) * random.choice([-1.0, 1.0])
        rate = np.array([-q[1:] @ omega, *(q[0] * omega + np.cross(q[1:], omega))]) / 2
        torque = controller.step([*q, *rate], t=0.2 * sample)
        statuses.add(controller.last.status)
        for _ in range(100):
            omega = omega + 0.002 * (torque - np.cross(omega, inertia * omega)) / inertia
            R = R * Rotation.from_rotvec(0.002 * omega)
        angles.append(R.magnitude())
    assert statuses == {"solved"}
    # The horizon recedes: the angle decreases like a damped motion, and never grows to a whole turn.
    assert max(angles) < 1.1 * angles[0]
    assert angles[-1] < 0.4 * angles[0]


def test_a_matrix_is_measured_as_a_quaternion(problem):
    controller = Controller(problem)
    R, omega = Rotation.from_rotvec([0.3, -0.8, 0.5]), np.array([0.1, 0.3, -0.2])
    q = R.as_quat(scalar_first=True)
    rate = np.array([-q[1:] @ omega, *(q[0] * omega + np.cross(q[1:], omega))]) / 2
    by_quaternion = controller.step([*q, *rate])
    by_matrix = controller.step({"R": R.as_matrix(), "omega": omega})
    by_noisy = controller.step([*(-1.001 * q), *(-rate + 1e-3 * q)])
    assert by_matrix == pytest.approx(by_quaternion, abs=1e-7)
    assert by_noisy == pytest.approx(by_quaternion, abs=5e-3)
    for state, text in (
        ({"R": np.diag([1, 1, -1]), "omega": omega}, "R is no rotation"),
        ({"R": np.eye(2), "omega": omega}, "expected"),
        ({"R": np.eye(3), "omega": [0, 0]}, "omega has shape"),
        ([2, 0, 0, 0, 0, 0, 0, 0], "quaternion of R has the length 2"),
    ):
        with pytest.raises(NumericsError, match=text):
            controller.step(state)


def test_vectors_are_measured_by_their_names():
    states = tuple(f"{name}_{part}" for name in ("n", "dn") for part in "xyz")
    measured = attitudes_of((), states)
    assert measured.by_state({"n": [0, 0, 1], "dn": [2, 3, 0]}) == dict(zip(states, (0, 0, 1, 2, 3, 0), strict=True))
    assert measured.by_state({"m": 1}) == {"m": 1}  # what is no state is refused later
    with pytest.raises(NumericsError, match="n has shape"):
        measured.by_state({"n": [0, 1]})
