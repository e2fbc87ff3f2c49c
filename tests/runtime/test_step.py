"""Numerics of simulations: small linear systems, Newton's method for one step, and stepping with thinned storage."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq

from codegen.runtime import arithmetic
from codegen.runtime.kernels import Kernel, Value
from codegen.runtime.stepping import motion, steps
from codegen.runtime.stepping.problem import StepProblem

NOTHING = np.empty(0)
START = np.array([0.7, 1.1])
STEP = 0.3


@Kernel
def predict_step(state, t, lengths, parameters, unknowns):
    """Explicit Euler step of the momentum of the pendulum q'' = -sin q."""
    unknowns[0] = state[1] - lengths[0] * math.sin(state[0])


@Kernel
def step_residual(unknowns, state, t, lengths, parameters, residual):
    """Residual p_k1 - p_k + h sin((q_k + q_k1)/2), from which q_k1 is eliminated."""
    h = lengths[0]
    residual[0] = unknowns[0] - state[1] + h * math.sin(state[0] + h / 4 * (state[1] + unknowns[0]))


@Kernel
def step_jacobian(unknowns, state, t, lengths, parameters, residual, jacobian):
    """Residual and its derivative by p_k1."""
    h = lengths[0]
    middle = state[0] + h / 4 * (state[1] + unknowns[0])
    residual[0] = unknowns[0] - state[1] + h * math.sin(middle)
    jacobian[0] = 1 + h**2 / 4 * math.cos(middle)


@Kernel
def complete_step(unknowns, state, t, lengths, parameters, interval):
    """State at the right node."""
    interval[0] = state[0] + lengths[0] / 2 * (state[1] + unknowns[0])
    interval[1] = unknowns[0]


@Kernel
def explicit_step(state, t, lengths, parameters, interval):
    """State at the right node by the symplectic Euler method."""
    momentum = state[1] - lengths[0] * math.sin(state[0])
    interval[0] = state[0] + lengths[0] * momentum
    interval[1] = momentum


@Kernel
def all_steps(state, now, interval, lengths, numbers, parameters, path, before, outcome):
    """All steps of the symplectic Euler method."""
    steps.follow_explicitly(
        inlined_step, 2, 0, 1, 1, state, now, interval, lengths, numbers, parameters, path, before, outcome
    )


inlined_step = explicit_step.inlined


@Kernel
def step_equations(state, interval, t, lengths, parameters, residual):
    """Both equations of the midpoint rule."""
    h = lengths[0]
    residual[0] = interval[0] - state[0] - h / 2 * (state[1] + interval[1])
    residual[1] = interval[1] - state[1] + h * math.sin((state[0] + interval[0]) / 2)


@Value
def energy(state, t, parameters):
    """Hamiltonian p^2/2 - cos q."""
    return state[1] ** 2 / 2 - math.cos(state[0])


MIDPOINT = StepProblem(
    metadata={}, state=2, stages=0, equations=step_equations, energy=energy, unknowns=1, predict=predict_step,
    residual=step_residual, jacobian=step_jacobian, complete=complete_step,
)  # fmt: skip
EULER = StepProblem(
    metadata={}, state=2, stages=0, equations=step_equations, energy=energy, explicit=explicit_step,
    all_steps=all_steps,
)  # fmt: skip


def made_step(problem, start, h, tolerance=1e-13, most=50):
    """The outcome of a step, and the interval."""
    interval = np.full(2, np.nan)
    given = problem.scheme, steps.memory_for(problem.scheme), start, 0.0, h, NOTHING, tolerance, most
    return steps.make_step(*given, interval, np.empty((0, 2))), interval


def midpoint_step(q: float, p: float, h: float) -> tuple[float, float]:
    """The midpoint rule of the pendulum by bracketing q_k1, to rounding."""

    def defect(q1: float) -> float:
        return (q1 - q) / h - p + h / 2 * np.sin((q + q1) / 2)

    q1 = brentq(defect, q - 10.0, q + 10.0, xtol=1e-15, rtol=1e-15)
    return q1, p - h * np.sin((q + q1) / 2)


def follow_from(
    start: np.ndarray, number: int, every: int = 1, limit: int = 50
) -> tuple[np.ndarray, np.ndarray, tuple]:
    trajectory = np.full((1 - (-number // every), 2), np.nan)
    before = np.full((trajectory.shape[0], 2), np.nan) if every > 1 else trajectory
    outcome = MIDPOINT.follow(start, number, STEP, NOTHING, 1e-13, limit, every, trajectory, before)
    return trajectory, before, outcome


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_dense_factorisation_agrees_with_lapack(size: int) -> None:
    generator = np.random.default_rng(size)
    matrix, right = generator.normal(size=(size, size)), generator.normal(size=size)
    if size > 1:
        matrix[0, 0] = 0.0  # no factorisation without row exchanges
    expected = np.linalg.solve(matrix, right)
    pivots = np.empty(size, np.int64)
    assert arithmetic.factor_matrix(matrix, pivots) == -1
    arithmetic.solve_factored(matrix, pivots, right)
    np.testing.assert_allclose(right, expected, rtol=1e-11)


def test_dense_factorisation_names_the_singular_column() -> None:
    matrix = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 1.0], [3.0, 6.0, 5.0]])
    assert arithmetic.factor_matrix(matrix, np.empty(3, np.int64)) == 1
    assert arithmetic.factor_matrix(np.full((2, 2), np.nan), np.empty(2, np.int64)) == 0


@pytest.mark.parametrize("h", [1e-3, 0.1, 1.0])
def test_newton_solves_a_step_to_rounding(h: float) -> None:
    iterations, interval = made_step(MIDPOINT, START, h)
    assert 1 <= iterations <= 7
    np.testing.assert_allclose(interval, midpoint_step(*START, h), rtol=0.0, atol=4e-15)


def test_newton_stops_at_the_equilibrium_and_without_reaching_an_impossible_tolerance() -> None:
    iterations, interval = made_step(MIDPOINT, np.zeros(2), STEP)
    assert iterations == 1
    assert np.array_equal(interval, np.zeros(2))
    assert 0 < made_step(MIDPOINT, START, STEP, tolerance=0.0)[0] < 10


def test_newton_reports_why_it_failed() -> None:
    assert made_step(MIDPOINT, START, STEP, most=1)[0] == steps.NOT_CONVERGED
    assert made_step(MIDPOINT, np.array([np.nan, 1.0]), STEP)[0] == steps.NON_FINITE


def test_corrections_are_measured_unknown_by_unknown() -> None:
    """A small unknown beside a large one has not converged before its own digits stand."""
    has_converged = steps.has_converged.py_func
    unknowns, last = np.array([1e6, 1e-6]), np.full(2, np.inf)
    arguments = 1e-13, steps.ROUNDING * np.abs(unknowns).sum(), np.abs(unknowns), last
    assert not has_converged(unknowns, np.array([0.0, 1e-9]), *arguments)
    assert not has_converged(unknowns, np.array([0.0, 1e-15]), *arguments)
    assert has_converged(unknowns, np.array([0.0, 1e-20]), *arguments)
    assert has_converged(unknowns, np.array([1e-9, 2e-20]), *arguments)


def with_factor(factor: float) -> Kernel:
    """The Jacobian times a factor, run by the interpreter."""

    def scaled(unknowns, state, t, lengths, parameters, residual, jacobian):
        step_jacobian.function(unknowns, state, t, lengths, parameters, residual, jacobian)
        jacobian[0] *= factor

    return Kernel(scaled, is_interpreted=True)


@pytest.mark.parametrize("constant", [False, True])
def test_linear_steps_make_one_newton_step(constant: bool) -> None:
    """The problem is not linear, so that one solve leaves a known error."""
    linear = replace(MIDPOINT, is_linear=True, is_constant=constant)
    iterations, interval = made_step(linear, START, 1e-3)
    assert iterations == 1
    np.testing.assert_allclose(interval, midpoint_step(*START, 1e-3), rtol=0.0, atol=1e-9 if constant else 1e-12)
    for factor in (0.0, np.nan):
        assert made_step(replace(linear, jacobian=with_factor(factor)), START, STEP)[0] == steps.SINGULAR


@pytest.mark.parametrize("constant", [False, True])
def test_linear_systems_of_two_unknowns_are_solved_by_one_factorisation(constant: bool) -> None:
    """q_k1 = q_k + h p_k1 and p_k1 = p_k - h q_k1: the implicit Euler method of an oscillator."""

    def residual(unknowns, state, t, lengths, parameters, values):
        values[0] = unknowns[0] - state[0] - lengths[0] * unknowns[1]
        values[1] = unknowns[1] - state[1] + lengths[0] * unknowns[0]

    def jacobian(unknowns, state, t, lengths, parameters, values, matrix):
        residual(unknowns, state, t, lengths, parameters, values)
        matrix[0], matrix[1], matrix[2], matrix[3] = 1.0, -lengths[0], lengths[0], 1.0

    def kept(given, state, t, lengths, parameters, filled):
        filled[0], filled[1] = given[0], given[1]

    oscillator = replace(
        MIDPOINT, unknowns=2, predict=Kernel(lambda state, t, lengths, parameters, unknowns: None, True),
        residual=Kernel(residual, True), jacobian=Kernel(jacobian, True), complete=Kernel(kept, True),
        is_linear=True, is_constant=constant,
    )  # fmt: skip
    iterations, interval = made_step(oscillator, START, STEP)
    assert iterations == 1
    np.testing.assert_allclose(interval, np.linalg.solve([[1.0, -STEP], [STEP, 1.0]], START), rtol=1e-14)


def test_explicit_step() -> None:
    outcome, interval = made_step(EULER, START, STEP)
    assert outcome == 0
    momentum = 1.1 - STEP * np.sin(0.7)
    np.testing.assert_allclose(interval, [0.7 + STEP * momentum, momentum], rtol=1e-15)


@pytest.mark.parametrize("every", [1, 3])
def test_the_loop_with_an_inlined_step_makes_the_steps_of_the_common_loop(every: int) -> None:
    """Also where a state overflows: q grows by 3e306 a step."""
    for start in (START, np.array([1.6e308, 1e307])):
        paths, outcomes = [], []
        for problem in (EULER, replace(EULER, all_steps=None)):
            path = np.full((1 - (-20 // every), 2), np.nan)
            before = path if every == 1 else np.full((len(path) - 1, 2), np.nan)
            outcomes.append(problem.follow(start, 20, STEP, NOTHING, 1e-13, 50, every, path, before))
            paths.append(np.vstack([path, before]))
        assert tuple(outcomes[0]) == tuple(outcomes[1])
        np.testing.assert_array_equal(paths[0], paths[1])


def test_interpreted_kernels_make_the_same_steps() -> None:
    names = "equations energy predict residual jacobian complete".split()
    kernels = {name: type(k := getattr(MIDPOINT, name))(k.function, is_interpreted=True) for name in names}
    one, other = (
        motion.follow_motion(motion.checked_step_grid(p, 10, 3.0, [], START))
        for p in (MIDPOINT, replace(MIDPOINT, **kernels))
    )
    np.testing.assert_allclose(one.q, other.q, rtol=1e-13)
    assert one.iterations == other.iterations


def test_every_step_is_stored() -> None:
    trajectory, _, (made, rows, iterations, outcome) = follow_from(START, 10)
    assert (made, rows, outcome) == (10, 11, 0)
    assert 20 <= iterations <= 50
    state = tuple(START)
    for row in trajectory[1:11]:
        state = midpoint_step(*state, STEP)
        np.testing.assert_allclose(row, state, rtol=0.0, atol=2e-14)


@pytest.mark.parametrize(("every", "stored"), [(2, [0, 2, 4, 6, 8, 10]), (3, [0, 3, 6, 9, 10]), (10, [0, 10])])
def test_thinned_storage_holds_the_same_states(every: int, stored: list[int]) -> None:
    full, _, _ = follow_from(START, 10)
    thinned, before, (made, rows, _, outcome) = follow_from(START, 10, every)
    assert (made, rows, outcome) == (10, len(stored), 0)
    assert np.array_equal(thinned[:rows], full[stored])
    assert np.array_equal(before[: rows - 1], full[[k - 1 for k in stored[1:]]])


def test_a_failed_step_leaves_the_last_good_state() -> None:
    trajectory, _, (made, rows, iterations, outcome) = follow_from(START, 5, every=2, limit=1)
    assert (made, rows, iterations, outcome) == (0, 1, 0, steps.NOT_CONVERGED)
    assert np.array_equal(trajectory[0], START)
    overflow = np.array([1.6e308, 1e307])  # q grows by 3e306 a step
    trajectory, _, (made, rows, _, outcome) = follow_from(overflow, 20, every=2)
    assert (made, rows, outcome) == (3, 3, steps.NON_FINITE)
    np.testing.assert_allclose(trajectory[:3, 0], [1.6e308, 1.66e308, 1.69e308])


def test_residual_is_measured_along_the_stored_path() -> None:
    for every in (1, 3):
        trajectory, before, (made, rows, _, _) = follow_from(START, 10, every)
        scheme, arguments = MIDPOINT.scheme, (rows, made, STEP, NOTHING, 1e-13, 50, every, steps.EQUAL)
        given = scheme, steps.memory_for(scheme), before, trajectory
        measured = partial(steps.largest_residual, *given, *arguments)
        assert measured() < 1e-15
        trajectory[rows - 1, 1] += 1e-3
        assert measured() == pytest.approx(1e-3, rel=1e-9)
        trajectory[rows - 1, 1] = np.nan
        assert measured() == np.inf


def test_energies() -> None:
    values = np.empty(2)
    steps.energies(energy.address, np.array([[0.0, 2.0], [np.pi, 0.0]]), np.zeros(2), NOTHING, values)
    np.testing.assert_allclose(values, [1.0, 1.0])


def test_callbacks_describe_one_step() -> None:
    grid = motion.checked_step_grid(MIDPOINT, 10, 3.0, [], START)
    unknowns = motion.predict(grid, START)
    derivative = motion.jacobian(grid, unknowns, START)
    shift = 1e-6
    difference = motion.residual(grid, unknowns + shift, START) - motion.residual(grid, unknowns - shift, START)
    assert derivative.shape == (1, 1)
    assert derivative[0, 0] == pytest.approx(difference[0] / (2 * shift), rel=1e-9)
    solution = brentq(lambda p: motion.residual(grid, [p], START)[0], -5.0, 5.0, xtol=1e-15)
    np.testing.assert_allclose(motion.complete(grid, [solution], START), motion.step(grid, START), atol=1e-14)


def test_unusable_arguments_are_named() -> None:
    for arguments, name in (
        ((0, 1.0, [], START), "steps"),
        ((True, 1.0, [], START), "steps"),
        ((2.5, 1.0, [], START), "steps"),
        ((5, 0.0, [], START), "duration"),
        ((5, np.nan, [], START), "duration"),
        ((5, 1.0, [np.inf], START), "parameters"),
        ((5, 1.0, [], START[:1]), "start"),
        ((5, 1.0, [], [np.nan, 0.0]), "start"),
    ):
        with pytest.raises(ValueError, match=f"^{name}"):
            motion.checked_step_grid(MIDPOINT, *arguments)
    grid = motion.checked_step_grid(MIDPOINT, 5, 1.0, [], START)
    with pytest.raises(ValueError, match=r"^every"):
        motion.follow_motion(grid, 0)
    with pytest.raises(ValueError, match=r"^tolerance"):
        motion.follow_motion(grid, tolerance=0.0)
    with pytest.raises(ValueError, match=r"speed.*prescribed: q, p"):
        motion.start_values({"q": 0.0, "p": 1.0}, {"speed": 1.0})


def test_messages_name_step_and_time() -> None:
    grid = motion.checked_step_grid(MIDPOINT, 10, 3.0, [], START)
    status, message = motion.follow_motion(grid, max_iterations=1)[:2]
    assert status == "newton failed"
    assert message.startswith("newton failed in step 1 of 10, from t = 0 to 0.3: ")
    status, message, made, t, q, p, energies, residual, iterations, events = motion.follow_motion(grid, 4)
    assert (status, made, events) == ("solved", 10, None)
    assert message.startswith("all 10 steps were made with ")
    np.testing.assert_allclose(t, [0.0, 1.2, 2.4, 3.0])
    assert q.shape == p.shape == (4, 1)
    assert energies.shape == (4,)
    assert residual < 1e-15
    assert iterations >= 20
