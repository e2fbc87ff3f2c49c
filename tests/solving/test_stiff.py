"""Stiff first-order dynamics step by step, against published values and against scipy.

Published values: Mazzia and Magherini (2008), Test set for initial value problem solvers, release 2.4.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from interpreted import of_problem
from scipy.integrate import solve_ivp
from sympy import exp, sqrt

from codegen import Simulate, parameter, solve, states, time
from codegen import compile as compile_problem
from codegen.discretise import schemes
from codegen.errors import ArgumentError

HIRES = (
    0.7371312573325668e-3, 0.1442485726316185e-3, 0.5888729740967575e-4, 0.1175651343283149e-2,
    0.2386356198831331e-2, 0.6238968252742796e-2, 0.2849998395185769e-2, 0.2850001604814231e-2,
)  # fmt: skip
ROBERTSON = 0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050
FIRST_ORDER = [scheme.name for scheme in schemes.of_method(schemes.FIRST_ORDER)]


def hires() -> Simulate:
    """High irradiance responses of photomorphogenesis: eight reactions (Schaefer 1975)."""
    y = states(" ".join(f"y{i}" for i in range(1, 9)))
    bound = 280 * y[5] * y[7]
    rates = (
        -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007,
        1.71 * y[0] - 8.75 * y[1],
        -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4],
        8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
        -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6],
        -bound + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
        bound - 1.81 * y[6],
        1.81 * y[6] - bound,
    )
    start = dict(zip(y, (1, 0, 0, 0, 0, 0, 0, 0.0057), strict=True))
    return Simulate(dynamics=dict(zip(y, rates, strict=True)), duration=321.8122, start=start)


def robertson() -> Simulate:
    """Three reactions with rates from 0.04 to 3e7 (Robertson 1966)."""
    x, y, z = states("x y z")
    slow, fast, back = 0.04 * x, 3e7 * y**2, 1e4 * y * z
    return Simulate(dynamics={x: back - slow, y: slow - back - fast, z: fast}, duration=1e11, start={x: 1, y: 0, z: 0})


def van_der_pol() -> Simulate:
    """The oscillator y'' = mu ((1 - y^2) y' - y), whose states jump."""
    y, v = states("y v")
    mu = parameter("mu", 1000)
    return Simulate(dynamics={y: v, v: mu * ((1 - y**2) * v - y)}, duration=2, start={y: 2, v: 0})


def falling() -> Simulate:
    """x' = -x + e^-t with x(t) = t e^-t, and a slave y' = 5 (x - y)."""
    x, y = states("x y")
    return Simulate(dynamics={x: -x + exp(-time()), y: 5 * (x - y)}, duration=2, start={x: 0, y: 0})


@cache
def module_of(problem: Any, scheme: str) -> Any:
    return of_problem(problem(), scheme=scheme)


def relative_error(solution: Any, exact: Any) -> float:
    assert solution.status == "solved", solution.message
    assert solution.p.shape == (solution.t.size, 0)
    assert solution.energy is None
    return float(np.abs(solution.q[-1] / exact - 1.0).max())


def graded(problem: Any, times: int, **accuracy: float) -> Any:
    """Return the steps of scipy's Radau method, each divided into equal parts, as fractions of the duration."""
    module = module_of(problem, "explicit-euler")
    grid = module.make_grid(1, duration=1.0)

    def rates(t: float, x: Any) -> Any:
        return np.asarray(module.step(grid, x, t)) - x

    duration = float(problem().duration)
    nodes = solve_ivp(rates, (0, duration), grid.start, "Radau", **accuracy).t
    return np.repeat(np.diff(nodes), times) / times / duration


@pytest.mark.parametrize(("scheme", "error"), [("radau-5", 1e-5), ("sdirk-4", 3e-4)])
def test_hires_ends_at_the_published_values(scheme: str, error: float) -> None:
    fractions = graded(hires, 2, rtol=1e-4, atol=1e-8)
    module = compile_problem(hires(), scheme=scheme).module
    assert relative_error(module.solve(grid=fractions), HIRES) <= error


@pytest.mark.parametrize(("scheme", "error"), [("radau-5", 1e-6), ("sdirk-4", 1e-3)])
def test_robertson_ends_at_the_published_values(scheme: str, error: float) -> None:
    """Over eleven decades of time, in 200 steps whose lengths grow by a constant factor."""
    nodes = np.append(0.0, np.geomspace(1e-5, 1e11, 200))
    solution = module_of(robertson, scheme).solve(grid=np.diff(nodes) / 1e11)
    assert relative_error(solution, ROBERTSON) <= error
    np.testing.assert_allclose(solution.t, nodes, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(solution.q.sum(axis=1), 1.0, rtol=1e-12)


def test_van_der_pol_jumps_as_by_scipy() -> None:
    def rates(_: float, x: Any) -> list[float]:
        return [x[1], 1000 * ((1 - x[0] ** 2) * x[1] - x[0])]

    exact = solve_ivp(rates, (0, 2), [2, 0], "Radau", rtol=1e-10, atol=1e-10)
    fractions = graded(van_der_pol, 4, rtol=1e-4, atol=1e-4)
    for scheme, error in (("radau-5", 1e-6), ("sdirk-4", 1e-4)):
        solution = module_of(van_der_pol, scheme).solve(grid=fractions)
        assert relative_error(solution, exact.y[:, -1]) <= error


@pytest.mark.parametrize("scheme", FIRST_ORDER)
def test_order_of_every_scheme(scheme: str) -> None:
    """On grids whose steps grow; the errors are above rounding."""
    module = module_of(falling, scheme)
    exact = 2 * np.exp(-2.0)
    errors = []
    coarsest = {1: 400, 2: 100, 3: 50, 4: 20, 5: 12, 6: 8, 8: 4}[module.metadata.order]
    for steps in (coarsest, 2 * coarsest):
        lengths = np.linspace(1.0, 2.0, steps)
        solution = module.solve(grid=lengths / lengths.sum())
        errors.append(abs(solution.q[-1, 0] - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(module.metadata.order, abs=0.5), errors


def test_equal_fractions_are_equal_steps() -> None:
    module = module_of(hires, "radau-5")
    one, other = module.solve(40), module.solve(grid=np.full(40, 1 / 40))
    np.testing.assert_allclose(one.q, other.q, rtol=1e-10, atol=1e-16)
    for grid in ([0.5, 0.6], [1.5, -0.5], [[0.5, 0.5]], [0.5, np.nan]):
        with pytest.raises(ValueError, match=r"^grid must hold"):
            module.solve(grid=grid)


def test_a_linear_system_with_steps_of_two_lengths() -> None:
    """The matrix of a step is constant for equal steps only: x' = -3 x by implicit Euler."""

    def decay() -> Simulate:
        (x,) = states("x")
        return Simulate(dynamics={x: -3 * x}, duration=1, start={x: 1})

    solution = of_problem(decay(), scheme="implicit-euler").solve(grid=[0.25, 0.75])
    np.testing.assert_allclose(solution.q[:, 0], [1, 1 / 1.75, 1 / 1.75 / 3.25], rtol=1e-14)


def test_results_have_states_alone(tmp_path: Any) -> None:
    result = solve(hires(), scheme="radau-5", steps=200)
    assert result.status == "solved", result.message
    assert (result.energy, result.method) == (None, "one-step")
    assert result["y8"][-1] == pytest.approx(HIRES[7], rel=0.1)
    assert "energy_drift" not in result.summary
    assert result.summary["final_y1"] == result.q[-1, 0]
    result.plot(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    fsolved = solve(hires(), scheme="radau-5", steps=200, driver="fsolve")
    np.testing.assert_allclose(fsolved.q[-1], result.q[-1], rtol=1e-6)
    with pytest.raises(ArgumentError, match="needs a Lagrangian or a Hamiltonian"):
        solve(hires(), method="variational")


def test_all_checks_hold_and_sweeps_store_states() -> None:
    solver = compile_problem(van_der_pol(), scheme="radau-3")
    findings = solver.check(steps=2000)
    assert len(findings) > 20
    assert not [finding for finding in findings if not finding.passed]
    data = solver.sweep({"mu": [10.0, 20.0]}, steps=400)
    assert "p" not in data
    assert "energy" not in data
    assert (data["status"] == "solved").all()
    exact = solve_ivp(lambda _, x: [x[1], 20 * ((1 - x[0] ** 2) * x[1] - x[0])], (0, 2), [2, 0], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(data["q"].sel(mu=20.0)[-1], exact.y[:, -1], rtol=1e-3)


def test_stiff_rod_is_solved():
    """A rounding error of the length changes the force by a factor of 1e8; the reference is scipy's Radau at 1e-10."""
    x, y, v, w = states("x y v w")
    length = sqrt(x**2 + y**2)
    pull = -1e8 * (length - 1) / length - 1e5 * (x * v + y * w) / length**2
    dynamics = {x: v, y: w, v: pull * x, w: pull * y - 9.81}
    result = solve(Simulate(dynamics=dynamics, start={x: 1, y: 0, v: 0, w: 0}, duration=3, steps=300))

    def rates(_, z):
        size = np.hypot(z[0], z[1])
        force = -1e8 * (size - 1) / size - 1e5 * (z[0] * z[2] + z[1] * z[3]) / size**2
        return z[2], z[3], force * z[0], force * z[1] - 9.81

    exact = solve_ivp(rates, (0, 3), (1, 0, 0, 0), method="Radau", rtol=1e-10, atol=1e-12).y[:, -1]
    assert result.status == "solved", result.message
    np.testing.assert_allclose(result.q[-1, :2], exact[:2], atol=5e-3)
