"""First-order systems, free duration, bounds and terminal costs, against closed forms by a dense assembly."""

import numpy as np
import pytest
from dense_assembly import DenseProblem

from codegen import Control, control, coordinate, free_parameter, parameters, states, time
from codegen.discretise import schemes
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.transcribe import transcribe
from codegen.errors import ArgumentError, SchemeError

CHAINS = [s for s in schemes.of_method(schemes.FIRST_ORDER) if s.is_chain and not s.parts]
SECOND_ORDER = [s.name for s in CHAINS if s.order == 2]


def double_integrator(**changes) -> Control:
    """From rest to rest over the unit distance in unit time with least effort."""
    x, v = states("x v")
    u = control("u")
    given = {"dynamics": {x: v, v: u}, "cost": u**2 / 2, "duration": 1, "start": {x: 0, v: 0}, "end": {x: 1, v: 0}}
    return Control(**(given | {key: value(x, v, u) for key, value in changes.items()}))


@pytest.mark.parametrize("scheme", CHAINS, ids=lambda s: s.name)
def test_least_effort_converges_at_the_scheme_s_order(scheme):
    x = states("x")[0]
    u, t = control("u"), time()
    model = normalise(
        Control(dynamics={x: x + u}, cost=(u - t) ** 2 / 2, duration=1, start={x: 1}, end={x: 0}, steps=4)
    )
    # x(1) = e + int e^(1-t) u, so u - t = -c e^(1-t) with c = (e + (e - 2)) / ((e^2 - 1)/2), and J = c (2e - 2)/2.
    e = np.e
    exact = (2 * e - 2) ** 2 / (e**2 - 1)
    errors = []
    for steps in (20, 40):
        problem = DenseProblem(transcribe(model, scheme.name), steps)
        errors.append(abs(problem.cost(problem.newton(problem.initial())) - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(scheme.order, abs=0.1)


@pytest.mark.parametrize("scheme", SECOND_ORDER)
def test_double_integrator_has_its_discrete_closed_form(scheme):
    problem = DenseProblem(transcribe(normalise(double_integrator()), scheme), 6)
    z = problem.newton(problem.initial())
    # min sum h u^2/2 with sum h u = 0 and sum h u (1 - t_mid) = 1: u is linear in t_mid, J = 6 / (1 - 1/N^2).
    assert problem.cost(z) == pytest.approx(6 / (1 - 1 / 36), rel=1e-10)
    assert problem.program_cost(z) == pytest.approx(problem.cost(z), rel=1e-12)


def test_the_trapezoidal_rule_has_no_stage():
    program = transcribe(normalise(double_integrator()), "trapezoidal")
    assert [u.name for u in program.interval] == ["mu_x", "mu_v"]
    assert str(program.equations[0].value.expand()) == "-h*v_k/2 - h*v_k1/2 - x_k + x_k1"


def test_free_duration_with_a_cost_on_time():
    T = free_parameter("T", 1.5, lower=0.1)
    problem = double_integrator(terminal_cost=lambda *_: 2 * T, duration=lambda *_: T)
    program = transcribe(normalise(problem))
    assert program.scaled_time
    assert [u.name for u in program.linking.unknowns] == ["T"]
    assert program.linking.own == 0
    dense = DenseProblem(program, 8)
    z = dense.newton(dense.slsqp(dense.initial()).z)
    # J(T) = 2 T + c / T^3 with c = 6 / (1 - 1/N^2), least at T^4 = 3 c / 2.
    c = 6 / (1 - 1 / 64)
    best = (1.5 * c) ** 0.25
    assert dense.shared_value(z, "T") == pytest.approx(best, rel=1e-9)
    assert dense.cost(z) == pytest.approx(2 * best + c / best**3, rel=1e-10)
    assert dense.program_cost(z) == pytest.approx(dense.cost(z), rel=1e-12)


def test_least_time_with_bounded_control():
    T = free_parameter("T", 3, lower=0.1)
    problem = double_integrator(
        terminal_cost=lambda *_: T, duration=lambda *_: T, cost=lambda *_: 0, bounds=lambda x, v, u: {u: (-1, 1)}
    )
    program = transcribe(normalise(problem), "trapezoidal")
    assert (program.controls[0].lower, program.controls[0].upper) == (-1, 1)
    dense = DenseProblem(program, 10)
    result = dense.slsqp(dense.initial())
    # Bang-bang with the switch in the middle, which is a node: T = 2 exactly.
    assert dense.shared_value(result.z, "T") == pytest.approx(2.0, abs=1e-6)
    assert dense.on_intervals(result.z, "u") == pytest.approx(np.repeat([1.0, -1.0], 5), abs=1e-5)


def test_explicit_time_is_scaled_with_the_duration():
    """x' = t + u, so x(T) = T^2/2 + int u: with x(T) = 2 and no effort T is 2."""
    (x,) = states("x")
    u, t, T = control("u"), time(), free_parameter("T", 1.0)
    model = normalise(Control(dynamics={x: t + u}, cost=u**2, duration=T, start={x: 0}, end={x: 2}))
    dense = DenseProblem(transcribe(model), 4)
    z = dense.newton(dense.initial())
    assert dense.shared_value(z, "T") == pytest.approx(2.0, abs=1e-9)


def test_terminal_cost_of_the_state():
    """Free end with x(T)^2 k/2: u constant, J = k d^2 / (2 (1 + k T)) for x' = u from d."""
    (x,) = states("x")
    u = control("u")
    d, k = parameters(d=3, k=5)
    model = normalise(Control(dynamics={x: u}, cost=u**2 / 2, terminal_cost=k * x**2 / 2, duration=2, start={x: d}))
    dense = DenseProblem(transcribe(model), 3)
    z = dense.newton(dense.initial())
    assert dense.cost(z) == pytest.approx(5 * 9 / (2 * (1 + 5 * 2)), rel=1e-12)
    assert dense.program_cost(z) == pytest.approx(dense.cost(z), rel=1e-12)


def test_free_parameter_in_the_dynamics_and_in_an_end_value():
    """x' = a + u to x(1) = b: choosing a costs (a - 1)^2/2, b costs (b - 3)^2/2, u^2/2, so each gives a third."""
    (x,) = states("x")
    u = control("u")
    a, b = free_parameter("a", 0.0), free_parameter("b", 0.0)
    model = normalise(
        Control(
            dynamics={x: a + u},
            cost=u**2 / 2,
            terminal_cost=(a - 1) ** 2 / 2 + (b - 3) ** 2 / 2,
            duration=1,
            start={x: 0},
            end={x: b},
        )
    )
    program = transcribe(model)
    assert not program.scaled_time
    dense = DenseProblem(program, 3)
    z = dense.newton(dense.initial())
    found = [dense.shared_value(z, "a"), dense.shared_value(z, "b"), *dense.on_intervals(z, "u")]
    assert found == pytest.approx([5 / 3, 7 / 3, 2 / 3, 2 / 3, 2 / 3], rel=1e-10)


@pytest.mark.parametrize("scheme", ["midpoint", "explicit-euler"])
def test_nodal_controls(scheme):
    program = transcribe(normalise(double_integrator()), scheme, controls="nodal")
    assert [u.name for u in program.node] == ["x", "v", "u"]
    assert program.controls == ()
    assert (2 in dict(program.end.pins)) == (scheme == "explicit-euler")


def test_methods_and_schemes_are_refused_by_name():
    first_order = normalise(double_integrator())
    q, v = coordinate("q")
    u = control("u")
    mechanical = normalise(Control(lagrangian=v**2 / 2, force={q: u}, cost=u**2, duration=1, start={q: 0}, end={q: 1}))
    for method in schemes.METHODS:
        with pytest.raises(ArgumentError, match="use one-step"):
            transcribe(first_order, method=method)
    with pytest.raises(ArgumentError, match="use variational or hamiltonian"):
        transcribe(mechanical, method="one-step")
    with pytest.raises(ArgumentError, match=r"does not exist.*use one-step"):
        transcribe(first_order, method="shooting")
    for scheme in ("symplectic-euler", "stormer-verlet", "rectangle", "alpha-0.3"):
        with pytest.raises(SchemeError, match=rf"{scheme}.*explicit-euler, implicit-euler, midpoint, trapezoidal"):
            transcribe(first_order, scheme)
    with pytest.raises(SchemeError, match="did you mean midpoint"):
        transcribe(first_order, "midpont")
