"""Simulations end to end: one step against textbook equations, orders, invariants, explicitness, failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import mpmath
import numpy as np
import pytest
from interpreted import without_compilation
from scipy.integrate import solve_ivp
from simulation_systems import (
    SYSTEMS,
    H,
    T,
    compiled,
    escape,
    falling_root,
    kepler,
    model_of,
    module_of,
    pendulum,
    text_of,
)
from textbook_stages import TABLES, composed_of_midpoint, higher_order_step
from textbook_steps import TEXTBOOK, textbook_step

from codegen.discretise import schemes
from codegen.discretise.simulation import simulate
from codegen.errors import SchemeError

COMBINATIONS = [(method, name) for method, table in schemes.METHODS.items() for name in table]
BASIC = [(method, name) for method, name in COMBINATIONS if schemes.METHODS[method][name].order <= 2]
HIGHER = [combination for combination in COMBINATIONS if combination not in BASIC]
STEPS = {
    1: (50, 100, 200, 400),
    2: (50, 100, 200, 400),
    4: (40, 80, 160),
    5: (10, 20, 40),
    6: (6, 12, 24),
    8: (5, 7, 10),
}
"""Numbers of steps at which errors show the order, from an asymptotic one to one above rounding."""


@pytest.fixture(scope="session")
def build(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """Compiled modules by model function, method and scheme."""
    folder = tmp_path_factory.mktemp("simulate")

    @cache
    def made(model: Callable[[], Any], method: str, scheme: str) -> Any:
        name = f"{model.__name__}_{method}_{scheme}".replace("-", "_")
        return compiled(text_of(model(), scheme, method), folder, name)

    return made


# ---- One step against the scheme's equations as they stand in textbooks ----


def test_every_scheme_has_textbook_equations() -> None:
    composed = {(m, s) for m, s in HIGHER if schemes.METHODS[m][s].parts}
    assert set(BASIC) <= set(TEXTBOOK)
    assert set(HIGHER) <= set(TABLES) | composed


@pytest.mark.parametrize(("method", "scheme"), BASIC)
@pytest.mark.parametrize("system", SYSTEMS)
def test_one_step_solves_the_textbook_equations(system: str, method: str, scheme: str) -> None:
    module = module_of(system, method, scheme)
    grid = module.make_grid(10, duration=10 * H)
    with mpmath.workdps(30):
        expected = textbook_step(SYSTEMS[system], method, scheme, T, H)
    np.testing.assert_allclose(module.step(grid, SYSTEMS[system].state, T), expected, rtol=0.0, atol=2e-14)


@pytest.mark.parametrize(
    ("system", "method", "scheme"),
    [
        *(("driven", method, scheme) for method, scheme in HIGHER),
        ("kepler", "hamiltonian", "gauss-4"),
        ("kepler", "variational", "gauss-4"),
        ("kepler", "hamiltonian", "lobatto-4"),
        ("coupled", "hamiltonian", "rk4"),
    ],
)
def test_one_step_of_higher_order_is_the_textbooks(system: str, method: str, scheme: str) -> None:
    module = module_of(system, method, scheme)
    expected = higher_order_step(SYSTEMS[system], method, scheme, T, H)
    found = module.step(module.make_grid(10, duration=10 * H), SYSTEMS[system].state, T)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-14)


def test_a_composition_of_the_midpoint_rule_where_nothing_is_separable() -> None:
    """The steps themselves are textbook_steps', their lengths Yoshida's."""
    module, root = module_of("kepler", "hamiltonian", "yoshida-4-of-midpoint"), 2 ** (1 / 3)
    lengths = [1 / (2 - root), -root / (2 - root), 1 / (2 - root)]
    expected = composed_of_midpoint(SYSTEMS["kepler"], lengths, T, H)
    found = module.step(module.make_grid(10, duration=10 * H), SYSTEMS["kepler"].state, T)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-14)


def test_a_motion_that_has_died_away_goes_on() -> None:
    """Numbers next to the least ones have spacings of 3e-8 and more, so that no relative accuracy is to be had."""
    solution = module_of("pendulum-hamiltonian", "hamiltonian", "implicit-euler").solve(
        200, duration=60.0, start=(1.6e-316, -6e-318)
    )
    assert solution.status == "solved"
    assert abs(solution.q[-1, 0]) < 1e-317


@pytest.mark.parametrize("system", SYSTEMS)
def test_energy_is_the_hamiltonian(system: str) -> None:
    module = module_of(system, "variational", "midpoint")
    state, n = SYSTEMS[system].state, SYSTEMS[system].dimension
    expected = float(SYSTEMS[system].hamiltonian(state[:n], state[n:], T))
    parameters = module.make_grid().parameters
    assert module.energy(np.array(state), T, parameters) == pytest.approx(expected, abs=1e-13)


# ---- Accuracy ----


def exact_pendulum(start: Sequence[float], duration: float) -> np.ndarray:
    motion = solve_ivp(
        lambda t, z: [z[1], -np.sin(z[0])], (0.0, duration), start, method="DOP853", rtol=1e-13, atol=1e-13
    )
    return np.asarray(motion.y[:, -1])


@pytest.mark.parametrize(("method", "scheme"), COMBINATIONS)
def test_order_of_convergence(method: str, scheme: str) -> None:
    module = module_of("pendulum-hamiltonian", method, scheme)
    start, duration = (0.5, 1.4), 2.0
    exact = exact_pendulum(start, duration)
    errors, claimed = [], module.metadata.order
    for steps in STEPS[claimed]:
        solution = module.solve(steps, duration=duration, start=start)
        errors.append(np.abs(np.array([*solution.q[-1], *solution.p[-1]]) - exact).max())
    order = np.log(errors[-2] / errors[-1]) / np.log(STEPS[claimed][-1] / STEPS[claimed][-2])
    assert order == pytest.approx(claimed, abs=0.05 if claimed < 6 else 0.2)
    assert errors[-1] > 1e-12  # no rounding, whose order is not that of the scheme


@pytest.mark.parametrize("system", ["pendulum-hamiltonian", "kepler", "double-pendulum"])
def test_variational_midpoint_is_the_midpoint_rule(system: str) -> None:
    """The discrete Hamiltonian map of Ld = h L(mid, v) is the implicit midpoint rule."""
    solutions = [module_of(system, m, "midpoint").solve(100, duration=5.0) for m in ("variational", "hamiltonian")]
    np.testing.assert_allclose(solutions[0].q, solutions[1].q, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(solutions[0].p, solutions[1].p, rtol=0.0, atol=1e-11)


def test_galerkin_integrators_are_gauss_methods() -> None:
    """Marsden and West (2001), section 2.6.6, for a Hamiltonian that is not separable."""
    solutions = [module_of("kepler", m, "gauss-4").solve(40, duration=5.0) for m in ("variational", "hamiltonian")]
    np.testing.assert_allclose(solutions[0].q, solutions[1].q, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(solutions[0].p, solutions[1].p, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("scheme", ["gauss-4", "gauss-6", "lobatto-4"])
def test_the_momentum_of_a_cyclic_coordinate_keeps_its_every_bit(scheme: str) -> None:
    """Rounded coefficients of velocities would change it a little in every step, and always the same way."""
    momentum = module_of("kepler", "variational", scheme).solve(40, duration=5.0).p[:, 1]
    assert set(momentum) == {momentum[0]}


@pytest.mark.parametrize(
    ("variational", "hamiltonian"), [("trapezoidal", "stormer-verlet"), ("rectangle", "symplectic-euler")]
)
def test_variational_schemes_with_constant_mass_are_known_ones(variational: str, hamiltonian: str) -> None:
    """Marsden and West (2001), section 2.6; Hairer, Lubich and Wanner (2006), VI.6.2."""
    first = module_of("pendulum-lagrangian", "variational", variational).solve(100, duration=10.0)
    second = module_of("pendulum-lagrangian", "hamiltonian", hamiltonian).solve(100, duration=10.0)
    np.testing.assert_allclose(first.q, second.q, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(first.p, second.p, rtol=0.0, atol=1e-13)


def test_eulers_spiral() -> None:
    """With h = 0.2, explicit Euler from (.5, 0) spirals out, implicit Euler from (1.5, 0) in."""
    outward, inward = (
        module_of("pendulum-hamiltonian", "hamiltonian", scheme).solve(100, duration=20.0, start=(start, 0.0))
        for scheme, start in (("explicit-euler", 0.5), ("implicit-euler", 1.5))
    )
    assert outward.status == inward.status == "solved"
    assert outward.energy[-1] - outward.energy[0] > 0.5
    assert np.all(np.diff(outward.energy) > 0.0)
    assert np.all(np.diff(inward.energy) < 0.0)
    assert inward.energy[-1] < -0.9


@pytest.mark.parametrize(("scheme", "allowed"), [("symplectic-euler", 0.5), ("midpoint", 0.05)])
@pytest.mark.parametrize("momentum", [0.7, 1.4, 2.1])
def test_symplectic_schemes_keep_to_level_curves(
    build: Callable[..., Any], scheme: str, allowed: float, momentum: float
) -> None:
    """With h = 0.3 from (0, .7), (0, 1.4), (0, 2.1); here for 1e5 steps, bounded and without drift."""
    solution = build(pendulum, "hamiltonian", scheme).solve(100_000, duration=30_000.0, start=(0.0, momentum))
    assert solution.status == "solved"
    error = np.abs(solution.energy - solution.energy[0])
    assert error.max() < allowed * momentum
    assert error[-10_000:].max() == pytest.approx(error[:10_000].max(), rel=0.01)


def test_a_million_steps(build: Callable[..., Any]) -> None:
    for method, scheme in (("hamiltonian", "stormer-verlet"), ("hamiltonian", "midpoint"), ("variational", "midpoint")):
        solution = build(pendulum, method, scheme).solve(1_000_000, duration=1e5, every=1000)
        assert (solution.status, solution.steps, solution.t.size) == ("solved", 1_000_000, 1001)
        assert np.abs(solution.energy - solution.energy[0]).max() < 1e-2
        assert solution.residual < 1e-12


def test_small_steps_lose_no_digits(build: Callable[..., Any]) -> None:
    """Velocities in place of differences of positions keep the rounding of the two forms of one scheme alike."""
    steps = 100_000
    first = build(pendulum, "variational", "trapezoidal").solve(steps, duration=1.0, every=steps)
    second = build(pendulum, "hamiltonian", "stormer-verlet").solve(steps, duration=1.0, every=steps)
    np.testing.assert_allclose(first.q[-1], second.q[-1], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(first.p[-1], second.p[-1], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose([*first.q[-1], *first.p[-1]], exact_pendulum((0.0, 1.4), 1.0), rtol=0.0, atol=1e-10)


def test_compiled_and_interpreted_modules_agree(build: Callable[..., Any]) -> None:
    first = build(kepler, "variational", "midpoint").solve(50)
    second = module_of("kepler", "variational", "midpoint").solve(50)
    np.testing.assert_allclose(first.q, second.q, rtol=1e-13)
    np.testing.assert_allclose(first.p, second.p, rtol=1e-12, atol=1e-13)
    assert first.residual < 1e-13


# ---- Storage, initial values, parameters ----


def test_thinned_storage_and_last_state(build: Callable[..., Any]) -> None:
    module = build(pendulum, "hamiltonian", "midpoint")
    full, thinned = module.solve(25, duration=5.0), module.solve(25, duration=5.0, every=10)
    np.testing.assert_allclose(thinned.t, [0.0, 2.0, 4.0, 5.0])
    assert np.array_equal(thinned.q, full.q[[0, 10, 20, 25]])
    assert np.array_equal(thinned.energy, full.energy[[0, 10, 20, 25]])
    assert thinned.iterations == full.iterations


def test_initial_values_by_array_and_by_name() -> None:
    module = module_of("coupled", "variational", "midpoint")
    by_name = module.initial_state(start={"da": 0.5, "b": 0.25})
    # p = M v with M = ((m, m/2), (m/2, m)), m = 2
    np.testing.assert_allclose(by_name, [1.0, 0.25, 1.0, 0.5])
    assert np.array_equal(module.make_grid(start=by_name).start, by_name)
    np.testing.assert_allclose(module.initial_state(m=4.0, start={"da": 0.5}), [1.0, 2.0, 2.0, 1.0])
    with pytest.raises(ValueError, match="'speed' is not prescribed"):
        module.solve(start={"speed": 1.0})
    with pytest.raises(ValueError, match=r"^start"):
        module.solve(start=[1.0, 2.0])


def test_parameters_are_arguments(build: Callable[..., Any]) -> None:
    module = module_of("kepler", "hamiltonian", "stormer-verlet")
    circle = module.solve(1000, GM=4.0, duration=np.pi, start=(1.0, 0.0, 0.0, 2.0), every=1000)
    np.testing.assert_allclose(circle.q[-1], [1.0, 2 * np.pi], atol=1e-4)
    assert module.metadata.parameters == {"GM": 1.5}


def test_residual_of_a_path_is_measured_outside_the_solver() -> None:
    module = module_of("double-pendulum", "hamiltonian", "stormer-verlet")
    solution = module.solve(20, duration=0.4)
    path, grid = np.hstack([solution.q, solution.p]), module.make_grid(20, duration=0.4)
    assert module.path_residual(grid, path) == solution.residual < 1e-13
    path[7, 1] += 1e-6
    assert 0.5e-6 < module.path_residual(grid, path) < 1e-4


# ---- Failures ----


def test_long_steps_are_solved_by_continuation_in_their_length(build: Callable[..., Any]) -> None:
    """Newton's method fails from an explicit Euler step, 6 long; every step of the path solves the midpoint rule."""
    h = 6.0
    solution = build(pendulum, "hamiltonian", "midpoint").solve(50, duration=50 * h)
    assert (solution.status, solution.steps) == ("solved", 50)
    q, p = solution.q[:, 0], solution.p[:, 0]
    np.testing.assert_allclose(q[1:], q[:-1] + h * (p[:-1] + p[1:]) / 2, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(p[1:], p[:-1] - h * np.sin((q[:-1] + q[1:]) / 2), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("h", "steps"), [(1.01, 0), (0.6, 2)])
def test_newton_failure_is_reported(h: float, steps: int) -> None:
    """With m = q + h p/2 + h^2 m^2/4 for the midpoint m, a step exists if h^2 (q + h p/2) <= 1."""
    solution = without_compilation(text_of(escape(), "midpoint", "hamiltonian")).solve(50, duration=50 * h)
    assert (solution.status, solution.steps) == ("newton failed", steps)
    assert h**2 * (solution.q[-1, 0] + h * solution.p[-1, 0] / 2) > 1.0
    assert f"step {solution.steps + 1} of 50" in solution.message
    assert "use more steps" in solution.message
    assert solution.q.shape[0] == solution.t.size == solution.energy.size == solution.steps + 1


def test_non_finite_state_is_reported() -> None:
    for scheme in ("symplectic-euler", "midpoint"):
        with np.errstate(all="ignore"):
            solution = without_compilation(text_of(falling_root(), scheme, "hamiltonian")).solve(100)
        assert solution.status == "non-finite"
        assert 15 < solution.steps < 25  # q = 0 is passed soon after t = 2
        assert "t = " in solution.message
        assert np.all(np.isfinite(solution.q))
        assert solution.residual < 1e-14


def test_failure_of_the_first_step() -> None:
    solution = module_of("double-pendulum", "hamiltonian", "midpoint").solve(10, max_iterations=1)
    assert (solution.status, solution.steps, solution.t.size) == ("newton failed", 0, 1)
    assert np.isnan(solution.residual)


def test_scheme_of_the_other_method_is_refused() -> None:
    with pytest.raises(SchemeError, match="does not belong"):
        simulate(model_of("kepler"), schemes.find("midpoint", "variational"), "hamiltonian")
