"""Pontryagin's conditions, exact optima and reference optima against closed forms and independent integration."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.model.legendre import hamiltonian_form
from codegen.errors import ArgumentError, BoundaryError, DegenerateError, NumericsError
from codegen.evidence.analysis.maximum_principle import (
    ExactOptimum,
    Reference,
    exact_optimum,
    necessary_conditions,
    reference_optimum,
)
from codegen.problem.problem import Control
from codegen.problem.symbols import (
    canonical_pair,
    control,
    coordinate,
    coordinates,
    parameters,
    recorded_declarations,
    time,
)

PROBLEMS = Path(__file__).parents[2] / "problems"
PENDULUM_COST = 4.530760981081599
"""Closed form of the linear pendulum, by the maximum principle."""


def gallery(name: str) -> Model:
    with recorded_declarations() as declared:
        problem = runpy.run_path(str(PROBLEMS / f"{name}.py"))["problem"]()
    return normalise(problem, declared, name, name)


def double_integrator(**changes: Any) -> Model:
    q, v = coordinate("q")
    u = control("u")
    given: dict[str, Any] = {"cost": u**2, "duration": 2, "start": {q: 0, v: 0}, "end": {q: 1, v: 0}}
    free = changes.pop("free", ())
    given["end"] = {key: value for key, value in given["end"].items() if key.name not in free}
    if "cost" in changes:
        given["cost"] = changes.pop("cost")(q, v, u)
    potential = changes.pop("potential", lambda q: 0)
    return normalise(Control(lagrangian=v**2 / 2 - potential(q), force={q: u}, **given))


def found_exact(model: Model) -> ExactOptimum:
    optimum = exact_optimum(model)
    assert optimum is not None
    return optimum


def test_conditions_of_the_linear_pendulum() -> None:
    found = necessary_conditions(gallery("linear_pendulum"))
    (q, v), (a, b) = found.states, found.costates
    assert found.optimal_control == (-b / 2,)
    assert found.state_rates == (v, -b / 2 - q)
    assert found.costate_rates == (b, -a)
    assert found.cost_rate == b**2 / 4
    assert found.end == (q - 2 * sympy.pi / 5, v)


@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_exact_optimum_of_the_linear_pendulum(form: str) -> None:
    model = gallery("linear_pendulum")
    optimum = found_exact(model if form == "lagrangian" else hamiltonian_form(model))
    assert optimum.cost_at() == pytest.approx(PENDULUM_COST, rel=1e-15)
    q, u, t = optimum.states[0], optimum.controls[0], optimum.model.time
    assert sympy.simplify(q.diff(t, 2) + q - u) == 0
    ends = [q.subs(t, 0), q.diff(t).subs(t, 0), q.subs(t, sympy.pi / 2), q.diff(t).subs(t, sympy.pi / 2)]
    wanted = [3 * sympy.pi / 5, 0, 2 * sympy.pi / 5, 0]
    assert [sympy.simplify(end - value) for end, value in zip(ends, wanted, strict=True)] == [0, 0, 0, 0]


@pytest.mark.parametrize(("free", "factor"), [((), 12), (("dq",), 3)])
def test_double_integrator_has_its_textbook_cost(free: tuple[str, ...], factor: int) -> None:
    # Bryson and Ho: moving by d in time T costs 12 d^2/T^3, and 3 d^2/T^3 when the end velocity is free.
    model = double_integrator(free=free)
    assert found_exact(model).cost == sympy.Rational(factor, 8)
    assert reference_optimum(model).cost == pytest.approx(factor / 8, rel=1e-10)


def test_regulator_with_free_end_has_the_cost_of_its_riccati_equation() -> None:
    model = double_integrator(cost=lambda q, v, u: u**2 + q**2 + v**2 + q, free=("q", "dq"))
    riccati = solve_ivp(_completed_square_rates, (0, 2), np.zeros(6), rtol=1e-12, atol=1e-13, method="DOP853")
    # The start is (0, 0), so only the constant of the value function remains.
    assert found_exact(model).cost_at() == pytest.approx(riccati.y[5, -1], rel=1e-10)
    assert reference_optimum(model).cost == pytest.approx(riccati.y[5, -1], rel=1e-9)


def _completed_square_rates(_: float, w: np.ndarray) -> np.ndarray:
    """Value function x.Px + 2 s.x + c of the regulator above, in time to go, by hand (B = (0, 1), R = 1)."""
    a, b, c, s, r, _ = w
    return np.array([1 - b * b, a - b * c, 1 + 2 * b - c * c, 0.5 - b * r, s - c * r, -r * r])


def test_weight_and_constant_cost_enter_the_exact_cost() -> None:
    model = double_integrator(potential=lambda q: 10 * q, cost=lambda q, v, u: u**2 + q + 1, free=("dq",))
    assert reference_optimum(model).cost == pytest.approx(found_exact(model).cost_at(), rel=1e-10)


def test_exact_cost_in_parameters_and_damping() -> None:
    q, v = coordinate("q")
    M, k, d, u = *parameters(M=1.5, k=2, d=0.3), control("u")
    problem = Control(
        lagrangian=M * v**2 / 2 - k * q**2 / 2,
        force={q: u - d * v},
        cost=u**2,
        duration=2,
        start={q: 0, v: 0},
        end={q: 1, v: 0},
    )
    model = normalise(problem)
    optimum = found_exact(model)
    for values in ({}, {"k": 3.0, "d": 0.1}):
        assert optimum.cost_at(values) == pytest.approx(reference_optimum(model, values).cost, rel=1e-9)


@pytest.mark.parametrize(
    ("problem", "feature"),
    [
        ("bryson_denham", "bounds"),
        ("convoy", "path conditions"),
        ("bouncing_ball", "several phases"),
        ("van_der_pol", "a first-order system"),
        ("hovercraft", "several bodies"),
    ],
)
def test_what_the_conditions_do_not_provide_for_is_refused(problem: str, feature: str) -> None:
    with pytest.raises(ArgumentError, match=feature):
        exact_optimum(gallery(problem))


def test_nonlinear_or_time_dependent_problems_have_no_exact_optimum() -> None:
    assert exact_optimum(gallery("orbital_transfer")) is None
    t = time()
    assert exact_optimum(double_integrator(cost=lambda q, v, u: u**2 * (1 + t))) is None


def test_reference_of_the_linear_pendulum() -> None:
    model = gallery("linear_pendulum")
    reference = reference_optimum(model)
    assert reference.cost == pytest.approx(PENDULUM_COST, rel=1e-12)
    assert reference.residual < 1e-10
    exact = found_exact(model).controls[0]
    u = sympy.lambdify(model.time, exact)(reference.t)
    np.testing.assert_allclose(reference.controls[:, 0], u, atol=1e-9)


@pytest.fixture(scope="module")
def orbital_references() -> dict[int, Reference]:
    model = gallery("orbital_transfer")
    return {p: reference_optimum(model, {"revolutions": p}) for p in (1, 2)}


@pytest.mark.parametrize("revolutions", [1, 2])
def test_orbital_transfer_reaches_its_target_with_the_found_thrust(
    orbital_references: dict[int, Reference], revolutions: int
) -> None:
    reference = orbital_references[revolutions]
    m, GM, r0, r1 = 100.0, 0.40038, 5.0, 6.0
    thrust = CubicSpline(reference.t, reference.controls[:, 0])

    def rates(t: float, y: np.ndarray) -> list[float]:
        r, _, dr, dphi, _ = y
        u = float(thrust(t))
        return [dr, dphi, r * dphi**2 - GM / r**2, (u / m - 2.0 * dr * dphi) / r, u * u]

    start = [r0, 0.0, 0.0, math.sqrt(GM / r0**3), 0.0]
    duration = math.pi * revolutions * (math.sqrt(r0**3 / GM) + math.sqrt(r1**3 / GM))
    assert reference.t[-1] == pytest.approx(duration, rel=1e-14)
    end = solve_ivp(rates, (0.0, duration), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(end[:4], [r1, 2 * math.pi * revolutions, 0.0, math.sqrt(GM / r1**3)], atol=1e-8)
    assert end[4] == pytest.approx(reference.cost, rel=1e-9)


@pytest.mark.parametrize(("revolutions", "discrete", "share"), [(1, 0.0487567009, 3e-4), (2, 0.0244340488530, 5e-6)])
def test_orbital_transfer_is_near_the_discrete_optima(
    orbital_references: dict[int, Reference], revolutions: int, discrete: float, share: float
) -> None:
    # Variational midpoint with 50 and 300 intervals (independent programs): errors of the size of h^2.
    cost = orbital_references[revolutions].cost
    assert cost == pytest.approx(discrete, rel=share)
    assert cost != pytest.approx(discrete, rel=share / 10)


def test_both_forms_have_the_same_optimum(orbital_references: dict[int, Reference]) -> None:
    reference = reference_optimum(hamiltonian_form(gallery("orbital_transfer")))
    assert reference.cost == pytest.approx(orbital_references[1].cost, rel=1e-11)


def test_guess_from_another_optimum_is_used(orbital_references: dict[int, Reference]) -> None:
    near = orbital_references[1]
    guess = (near.t, near.states, near.costates)
    again = reference_optimum(gallery("orbital_transfer"), {"r1": 6.01}, 1e-9, guess)
    assert again.states[-1, 0] == pytest.approx(6.01, rel=1e-12)
    with pytest.raises(NumericsError, match="shapes"):
        reference_optimum(gallery("orbital_transfer"), guess=(near.t, near.states[:-1], near.costates))


def test_swing_up_of_a_pendulum_ends_upright() -> None:
    q, v = coordinate("q")
    u = control("u")
    problem = Control(
        lagrangian=v**2 / 2 + sympy.cos(q),
        force={q: u},
        cost=u**2,
        duration=10,
        start={q: 0, v: 0},
        end={q: sympy.pi, v: 0},
    )
    reference = reference_optimum(normalise(problem), tolerance=1e-8)
    thrust = CubicSpline(reference.t, reference.controls[:, 0])
    motion = solve_ivp(
        lambda t, y: [y[1], float(thrust(t)) - math.sin(y[0]), float(thrust(t)) ** 2],
        (0, 10),
        [0.0, 0.0, 0.0],
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
    )
    np.testing.assert_allclose(motion.y[:, -1], [math.pi, 0.0, reference.cost], atol=1e-4)


def test_cost_that_does_not_determine_the_control_is_refused() -> None:
    with pytest.raises(DegenerateError, match="does not determine u"):
        necessary_conditions(double_integrator(cost=lambda q, v, u: q**2))


def test_unreachable_end_is_refused() -> None:
    (y, z), (dy, dz) = coordinates("y z")
    u = control("u")
    problem = Control(
        lagrangian=(dy**2 + dz**2) / 2,
        force={y: u},
        cost=u**2,
        duration=1,
        start={y: 0, z: 0, dy: 0, dz: 0},
        end={y: 1, z: 1, dy: 0, dz: 0},
    )
    model = normalise(problem)
    with pytest.raises(BoundaryError, match="do not determine"):
        exact_optimum(model)
    with pytest.raises(NumericsError, match=r"no optimum.*guess"):
        reference_optimum(model)


def test_unknown_parameter_and_useless_tolerance_are_refused() -> None:
    model = gallery("orbital_transfer")
    with pytest.raises(ArgumentError, match="no parameter mass"):
        reference_optimum(model, {"mass": 1.0})
    with pytest.raises(ArgumentError, match="tolerance"):
        reference_optimum(model, tolerance=1e-16)


def test_hamiltonian_problem_with_force_depending_on_momentum() -> None:
    q, p = canonical_pair("q", "p")
    u = control("u")
    problem = Control(
        hamiltonian=p**2 / 2, force={q: u - p}, cost=u**2, duration=1, start={q: 0, p: 0}, end={q: 1, p: 0}
    )
    model = normalise(problem)
    # The minimum energy is d.W^-1 d with the controllability Gramian W of q' = p, p' = u - p.
    e = math.exp(-1.0)
    W = np.array([[1 - 2 * (1 - e) + (1 - e**2) / 2, (1 - e) ** 2 / 2], [(1 - e) ** 2 / 2, (1 - e**2) / 2]])
    expected = np.linalg.inv(W)[0, 0]
    assert found_exact(model).cost_at() == pytest.approx(expected, rel=1e-12)
    assert reference_optimum(model).cost == pytest.approx(expected, rel=1e-10)
