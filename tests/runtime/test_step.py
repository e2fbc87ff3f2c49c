"""Numerics of simulations: small linear systems, Newton's method for one step, and stepping with thinned storage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from codegen.runtime.kkt import dense, lu
from codegen.runtime.stepping import (
    path,
    scalar,
    step_callbacks,
    step_constant,
    step_explicit,
    step_linear,
    step_newton,
)
from codegen.runtime.stepping.trajectory import energies, follow, largest_residual

NOTHING = np.empty(0)
START = np.array([0.7, 1.1])
STEP = 0.3


def midpoint_step(q: float, p: float, h: float) -> tuple[float, float]:
    """The midpoint rule of the pendulum by bracketing q_k1, to rounding."""

    def defect(q1: float) -> float:
        return (q1 - q) / h - p + h / 2 * np.sin((q + q1) / 2)

    q1 = brentq(defect, q - 10.0, q + 10.0, xtol=1e-15, rtol=1e-15)
    return q1, p - h * np.sin((q + q1) / 2)


def follow_from(start: np.ndarray, steps: int, every: int = 1, limit: int = 50) -> tuple[np.ndarray, np.ndarray, tuple]:
    trajectory = np.full((2 - (-steps // every), 2), np.nan)
    before = np.full((trajectory.shape[0], 2), np.nan) if every > 1 else trajectory
    outcome = follow(start, steps, STEP, NOTHING, every, 1e-13, limit, trajectory, before)
    return trajectory, before, outcome


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_dense_factorisation_agrees_with_lapack(size: int) -> None:
    generator = np.random.default_rng(size)
    matrix, right = generator.normal(size=(size, size)), generator.normal(size=size)
    if size > 1:
        matrix[0, 0] = 0.0  # no factorisation without row exchanges
    expected = np.linalg.solve(matrix, right)
    pivots = np.empty(size, np.int64)
    assert lu.factor_matrix(matrix, pivots) == -1
    dense.solve_factored(matrix, pivots, right)
    np.testing.assert_allclose(right, expected, rtol=1e-11)


def test_dense_factorisation_names_the_singular_column() -> None:
    matrix = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 1.0], [3.0, 6.0, 5.0]])
    assert lu.factor_matrix(matrix, np.empty(3, np.int64)) == 1
    assert lu.factor_matrix(np.full((2, 2), np.nan), np.empty(2, np.int64)) == 0


def test_scalar_equation() -> None:
    right, pivots = np.array([6.0]), np.empty(1, np.int64)
    assert scalar.factor_matrix(np.array([[0.0]]), pivots) == 0
    assert scalar.factor_matrix(np.array([[np.nan]]), pivots) == 0
    assert scalar.factor_matrix(np.array([[4.0]]), pivots) == -1
    scalar.solve_factored(np.array([[4.0]]), pivots, right)
    assert right[0] == 1.5


@pytest.mark.parametrize("h", [1e-3, 0.1, 1.0])
def test_newton_solves_a_step_to_rounding(h: float) -> None:
    interval = np.empty(2)
    work = step_newton.allocate_work(h, NOTHING)
    iterations = step_newton.advance(START, 0.0, h, NOTHING, work, interval, 1e-13, 50)
    assert 1 <= iterations <= 7
    np.testing.assert_allclose(interval, midpoint_step(*START, h), rtol=0.0, atol=4e-15)


def test_newton_stops_at_the_equilibrium_and_without_reaching_an_impossible_tolerance() -> None:
    interval, work = np.empty(2), step_newton.allocate_work(STEP, NOTHING)
    assert step_newton.advance(np.zeros(2), 0.0, STEP, NOTHING, work, interval, 1e-13, 50) == 1
    assert np.array_equal(interval, np.zeros(2))
    assert 0 < step_newton.advance(START, 0.0, STEP, NOTHING, work, interval, 0.0, 50) < 10


def test_newton_reports_why_it_failed() -> None:
    interval, work = np.empty(2), step_newton.allocate_work(STEP, NOTHING)
    assert step_newton.advance(START, 0.0, STEP, NOTHING, work, interval, 1e-13, 1) == step_newton.NOT_CONVERGED
    nowhere = np.array([np.nan, 1.0])
    assert step_newton.advance(nowhere, 0.0, STEP, NOTHING, work, interval, 1e-13, 50) == step_newton.NON_FINITE


def test_corrections_are_measured_unknown_by_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small unknown beside a large one has not converged before its own digits stand."""
    monkeypatch.setattr(step_newton, "UNKNOWNS", 2)
    has_converged = step_newton.has_converged.py_func
    unknowns, last = np.array([1e6, 1e-6]), np.full(2, np.inf)
    arguments = 1e-13, step_newton.ROUNDING * np.abs(unknowns).sum(), np.abs(unknowns), last
    assert not has_converged(unknowns, np.array([0.0, 1e-9]), *arguments)
    assert not has_converged(unknowns, np.array([0.0, 1e-15]), *arguments)
    assert has_converged(unknowns, np.array([0.0, 1e-20]), *arguments)
    assert has_converged(unknowns, np.array([1e-9, 2e-20]), *arguments)


def test_linear_steps_make_one_newton_step() -> None:
    """The stand-in is not linear, so that one solve leaves a known error; both variants leave what belongs to them."""
    expected = midpoint_step(*START, 1e-3)
    for variant in (step_linear, step_constant):
        interval = np.empty(2)
        work = variant.allocate_work(1e-3, NOTHING)
        assert variant.advance(START, 0.0, 1e-3, NOTHING, work, interval, 1e-13, 50) == 1
        np.testing.assert_allclose(interval, expected, rtol=0.0, atol=1e-12)


def test_constant_step_reports_a_singular_matrix() -> None:
    unknowns, residual, jacobian, pivots = step_constant.allocate_work(STEP, NOTHING)
    pivots[0] = -1
    work = unknowns, residual, jacobian, pivots
    assert step_constant.advance(START, 0.0, STEP, NOTHING, work, np.empty(2), 1e-13, 50) == step_constant.SINGULAR


def test_explicit_step() -> None:
    interval = np.empty(2)
    work = step_explicit.allocate_work(STEP, NOTHING)
    assert step_explicit.advance(START, 0.0, STEP, NOTHING, work, interval, 1e-13, 50) == 0
    momentum = 1.1 - STEP * np.sin(0.7)
    np.testing.assert_allclose(interval, [0.7 + STEP * momentum, momentum], rtol=1e-15)


def test_every_step_is_stored() -> None:
    trajectory, _, (steps, rows, iterations, outcome) = follow_from(START, 10)
    assert (steps, rows, outcome) == (10, 11, 0)
    assert 20 <= iterations <= 50
    state = tuple(START)
    for row in trajectory[1:11]:
        state = midpoint_step(*state, STEP)
        np.testing.assert_allclose(row, state, rtol=0.0, atol=2e-14)


@pytest.mark.parametrize(("every", "stored"), [(2, [0, 2, 4, 6, 8, 10]), (3, [0, 3, 6, 9, 10]), (10, [0, 10])])
def test_thinned_storage_holds_the_same_states(every: int, stored: list[int]) -> None:
    full, _, _ = follow_from(START, 10)
    thinned, before, (steps, rows, _, outcome) = follow_from(START, 10, every)
    assert (steps, rows, outcome) == (10, len(stored), 0)
    assert np.array_equal(thinned[:rows], full[stored])
    assert np.array_equal(before[: rows - 1], full[[k - 1 for k in stored[1:]]])


def test_a_failed_step_leaves_the_last_good_state() -> None:
    needed = follow_from(START, 1)[2][2]
    trajectory, _, (steps, rows, iterations, outcome) = follow_from(START, 5, every=2, limit=needed - 1)
    assert (steps, rows, iterations, outcome) == (0, 1, 0, step_newton.NOT_CONVERGED)
    assert np.array_equal(trajectory[0], START)
    overflow = np.array([1.6e308, 1e307])  # q grows by 3e306 a step
    trajectory, _, (steps, rows, _, outcome) = follow_from(overflow, 20, every=2)
    assert (steps, rows, outcome) == (3, 3, step_newton.NON_FINITE)
    np.testing.assert_allclose(trajectory[:3, 0], [1.6e308, 1.66e308, 1.69e308])


def test_residual_is_measured_along_the_stored_path() -> None:
    for every in (1, 3):
        trajectory, before, (steps, rows, _, _) = follow_from(START, 10, every)
        arguments = (rows, steps, STEP, NOTHING, every, 1e-13, 50)
        assert largest_residual(before, trajectory, *arguments) < 1e-15
        trajectory[rows - 1, 1] += 1e-3
        assert largest_residual(before, trajectory, *arguments) == pytest.approx(1e-3, rel=1e-9)
        trajectory[rows - 1, 1] = np.nan
        assert largest_residual(before, trajectory, *arguments) == np.inf


def test_energies() -> None:
    values = np.empty(2)
    energies(np.array([[0.0, 2.0], [np.pi, 0.0]]), np.zeros(2), NOTHING, values)
    np.testing.assert_allclose(values, [1.0, 1.0])


def test_callbacks_describe_one_step() -> None:
    grid = path.checked_grid(10, 3.0, [], START)
    unknowns = step_callbacks.predict(grid, START)
    derivative = step_callbacks.jacobian(grid, unknowns, START)
    shift = 1e-6
    difference = step_callbacks.residual(grid, unknowns + shift, START) - step_callbacks.residual(
        grid, unknowns - shift, START
    )
    assert derivative.shape == (1, 1)
    assert derivative[0, 0] == pytest.approx(difference[0] / (2 * shift), rel=1e-9)
    solution = brentq(lambda p: step_callbacks.residual(grid, [p], START)[0], -5.0, 5.0, xtol=1e-15)
    np.testing.assert_allclose(step_callbacks.complete(grid, [solution], START), path.step(grid, START), atol=1e-14)


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
            path.checked_grid(*arguments)
    grid = path.checked_grid(5, 1.0, [], START)
    with pytest.raises(ValueError, match=r"^every"):
        path.integrate(grid, 0, 1e-13, 50)
    with pytest.raises(ValueError, match=r"speed.*prescribed: q, p"):
        path.replace_values({"q": 0.0, "p": 1.0}, {"speed": 1.0})


def test_messages_name_step_and_time() -> None:
    grid = path.checked_grid(10, 3.0, [], START)
    status, message = path.integrate(grid, 1, 1e-13, 1)[:2]
    assert status == "newton failed"
    assert message.startswith("newton failed in step 1 of 10, from t = 0 to 0.3: ")
    status, message, steps, t, q, p, energy, residual, iterations = path.integrate(grid, 4, 1e-13, 50)
    assert (status, steps) == ("solved", 10)
    assert message.startswith("all 10 steps were made with ")
    np.testing.assert_allclose(t, [0.0, 1.2, 2.4, 3.0])
    assert q.shape == p.shape == (4, 1)
    assert energy.shape == (4,)
    assert residual < 1e-15
    assert iterations >= 20
