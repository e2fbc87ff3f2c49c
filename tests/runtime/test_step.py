"""Numerics of simulations: small linear systems, Newton's method for one step, and stepping with thinned storage."""

from __future__ import annotations

from typing import Any

import interpreted
import numpy as np
import pytest
from scipy.optimize import brentq

from codegen.emit import runtime_source
from codegen.runtime import lu
from codegen.runtime.stand_ins import example_step
from codegen.runtime.stepping import body_motion, motion, step_callbacks, step_explicit, step_newton

NOTHING = np.empty(0)
GIVEN = NOTHING, 1e-13, 50
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
    outcome = motion.follow(start, steps, STEP, (NOTHING, 1e-13, limit), every, trajectory, before)
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
    lu.solve_factored(matrix, pivots, right)
    np.testing.assert_allclose(right, expected, rtol=1e-11)


def test_dense_factorisation_names_the_singular_column() -> None:
    matrix = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 1.0], [3.0, 6.0, 5.0]])
    assert lu.factor_matrix(matrix, np.empty(3, np.int64)) == 1
    assert lu.factor_matrix(np.full((2, 2), np.nan), np.empty(2, np.int64)) == 0


@pytest.mark.parametrize("h", [1e-3, 0.1, 1.0])
def test_newton_solves_a_step_to_rounding(h: float) -> None:
    interval = np.empty(2)
    work = step_newton.allocate_work(h, GIVEN)
    iterations = step_newton.advance(START, 0.0, h, GIVEN, work, interval)
    assert 1 <= iterations <= 7
    np.testing.assert_allclose(interval, midpoint_step(*START, h), rtol=0.0, atol=4e-15)


def test_newton_stops_at_the_equilibrium_and_without_reaching_an_impossible_tolerance() -> None:
    interval, work = np.empty(2), step_newton.allocate_work(STEP, GIVEN)
    assert step_newton.advance(np.zeros(2), 0.0, STEP, GIVEN, work, interval) == 1
    assert np.array_equal(interval, np.zeros(2))
    assert 0 < step_newton.advance(START, 0.0, STEP, (NOTHING, 0.0, 50), work, interval) < 10


def test_newton_reports_why_it_failed() -> None:
    interval, work = np.empty(2), step_newton.allocate_work(STEP, GIVEN)
    assert step_newton.advance(START, 0.0, STEP, (NOTHING, 1e-13, 1), work, interval) == step_newton.NOT_CONVERGED
    nowhere = np.array([np.nan, 1.0])
    assert step_newton.advance(nowhere, 0.0, STEP, GIVEN, work, interval) == step_newton.NON_FINITE


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


def linear_step(matrix: float = 1.0, **sizes: int) -> dict[str, Any]:
    """What a module with linear equations has of `step_newton`, for a stand-in whose Jacobian has a factor."""
    names = {**vars(example_step), "factor_matrix": lu.factor_matrix, "solve_factored": lu.solve_factored}
    names |= {"np": np, "njit": interpreted.njit}

    def step_jacobian(unknowns, state, t, h, parameters, residual, jacobian):
        example_step.step_jacobian(unknowns, state, t, h, parameters, residual, jacobian)
        jacobian[0, 0] *= matrix

    names["step_jacobian"] = step_jacobian
    exec(runtime_source(("step_newton",), (("ITERATED", 0), *sizes.items())), names)
    return names


@pytest.mark.parametrize("constant", [0, 1])
@pytest.mark.parametrize("system", [0, 1])
def test_linear_steps_make_one_newton_step(constant: int, system: int) -> None:
    """The stand-in is not linear, so that one solve leaves a known error."""
    variant, interval = linear_step(CONSTANT=constant, SYSTEM=system), np.empty(2)
    assert "has_converged" not in variant
    work = variant["allocate_work"](1e-3, GIVEN)
    assert variant["advance"](START, 0.0, 1e-3, GIVEN, work, interval) == 1
    np.testing.assert_allclose(interval, midpoint_step(*START, 1e-3), rtol=0.0, atol=1e-12)
    for matrix in (0.0, np.nan):
        variant = linear_step(matrix, CONSTANT=constant, SYSTEM=system)
        work = variant["allocate_work"](STEP, GIVEN)
        assert variant["advance"](START, 0.0, STEP, GIVEN, work, interval) == variant["SINGULAR"]


def test_explicit_step() -> None:
    interval = np.empty(2)
    work = step_explicit.allocate_work(STEP, GIVEN)
    assert step_explicit.advance(START, 0.0, STEP, GIVEN, work, interval) == 0
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
        arguments = (rows, steps, STEP, GIVEN, every)
        assert body_motion.largest_residual(before, trajectory, *arguments) < 1e-15
        trajectory[rows - 1, 1] += 1e-3
        assert body_motion.largest_residual(before, trajectory, *arguments) == pytest.approx(1e-3, rel=1e-9)
        trajectory[rows - 1, 1] = np.nan
        assert body_motion.largest_residual(before, trajectory, *arguments) == np.inf


def test_energies() -> None:
    values = np.empty(2)
    body_motion.energies(np.array([[0.0, 2.0], [np.pi, 0.0]]), np.zeros(2), GIVEN, values)
    np.testing.assert_allclose(values, [1.0, 1.0])


def test_callbacks_describe_one_step() -> None:
    grid = motion.checked_step_grid(10, 3.0, [], START)
    unknowns = step_callbacks.predict(grid, START)
    derivative = step_callbacks.jacobian(grid, unknowns, START)
    shift = 1e-6
    difference = step_callbacks.residual(grid, unknowns + shift, START) - step_callbacks.residual(
        grid, unknowns - shift, START
    )
    assert derivative.shape == (1, 1)
    assert derivative[0, 0] == pytest.approx(difference[0] / (2 * shift), rel=1e-9)
    solution = brentq(lambda p: step_callbacks.residual(grid, [p], START)[0], -5.0, 5.0, xtol=1e-15)
    np.testing.assert_allclose(
        step_callbacks.complete(grid, [solution], START), body_motion.step(grid, START), atol=1e-14
    )


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
            motion.checked_step_grid(*arguments)
    grid = motion.checked_step_grid(5, 1.0, [], START)
    with pytest.raises(ValueError, match=r"^every"):
        motion.integrate(grid, 0)
    with pytest.raises(ValueError, match=r"^tolerance"):
        body_motion.with_settings(grid, 0.0, 50)
    with pytest.raises(ValueError, match=r"speed.*prescribed: q, p"):
        body_motion.replace_values({"q": 0.0, "p": 1.0}, {"speed": 1.0})


def test_messages_name_step_and_time() -> None:
    grid = motion.checked_step_grid(10, 3.0, [], START)
    status, message = motion.integrate(body_motion.with_settings(grid, 1e-13, 1), 1)[:2]
    assert status == "newton failed"
    assert message.startswith("newton failed in step 1 of 10, from t = 0 to 0.3: ")
    status, message, steps, t, q, p, energy, residual, iterations = motion.integrate(grid, 4)
    assert (status, steps) == ("solved", 10)
    assert message.startswith("all 10 steps were made with ")
    np.testing.assert_allclose(t, [0.0, 1.2, 2.4, 3.0])
    assert q.shape == p.shape == (4, 1)
    assert energy.shape == (4,)
    assert residual < 1e-15
    assert iterations >= 20
