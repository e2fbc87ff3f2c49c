"""Normal forms: what `normalise` makes of everything that an author can write."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import sympy
from hypothesis import example, given
from hypothesis import strategies as st
from sympy import Eq, S, Symbol
from written_problems import names, oscillator, plain, runners

from codegen import (
    Control,
    Phases,
    Simulate,
    canonical_pair,
    control,
    coordinate,
    free_parameter,
    parameter,
    state,
    states,
    time,
)
from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model.definitions import Boundary, Bounds, Condition, FreeParameter
from codegen.discretise.model.from_problem import normalise
from codegen.errors import CodegenError


def test_every_kind_of_condition_reads_an_argument_and_has_a_field() -> None:
    model = normalise(oscillator())
    for kind in CONDITIONS:
        assert kind.argument in {part.name for part in fields(Control)} & set(kind.scope)
        assert kind.of_model(model) == ()
    assert len({kind.argument for kind in CONDITIONS}) == len(CONDITIONS)


def test_what_is_left_out_is_empty() -> None:
    model = normalise(oscillator())
    assert (model.form, model.dynamics, model.bounds, model.path, model.holonomic) == ("lagrangian", (), (), (), ())
    assert (model.start_conditions, model.end_conditions, model.periodic, model.couplings) == ((), (), (), ())
    assert (model.free_parameters, model.bodies, model.body, model.end_values) == ((), 1, None, ())
    assert model.terminal_cost == 0
    assert model.end == Boundary((None,), (None,))


def test_first_order_form() -> None:
    x, v = states("x v")
    u = control("u")
    t = time()
    model = normalise(
        Control(
            dynamics={v: u - x * t, x: v},
            terminal_cost=x**2,
            duration=2,
            start={x: 1},
            end={v: 0},
            guess={x: t, u: 1},
            bounds={v: (None, 3), u: (-1, 1)},
        )
    )
    X, V, U, T = plain("x v u t")
    assert (model.form, model.function, model.force, model.cost) == ("first-order", 0, (), 0)
    assert (model.coordinates, model.rates, model.controls) == ((X, V), (), (U,))
    assert model.dynamics == (V, U - X * T)
    assert (model.start, model.end) == (Boundary((S.One, None), ()), Boundary((None, S.Zero), ()))
    assert model.bounds == (Bounds(V, None, S(3)), Bounds(U, S(-1), S.One))
    assert model.path == ()
    assert model.terminal_cost == X**2
    assert model.guess == ((X, T), (U, S.One))


def test_free_parameters_keep_guess_and_bounds() -> None:
    longest = parameter("longest", 8)
    T = free_parameter("T", guess=longest / 2, lower=1)
    a = free_parameter("a", 0)
    model = normalise(
        oscillator(duration=2 * T, terminal_cost=T + a, bounds={T: (None, longest), a: (-1, 1)}, cost=S.Zero)
    )
    L, T_, a_ = plain("longest T a")
    assert model.free_parameters == (FreeParameter(T_, L / 2, S.One, L), FreeParameter(a_, S.Zero, S(-1), S.One))
    assert (model.duration, model.terminal_cost) == (2 * T_, T_ + a_)
    assert (model.parameters, model.defaults, model.bounds) == ((L,), (8.0,), ())


def test_values_that_depend_on_a_free_parameter_are_conditions() -> None:
    A = free_parameter("A", 1)
    model = normalise(oscillator(start=lambda q, v, u: {q: A**2, v: 0}, end=lambda q, v, u: {v: -A}))
    q, dq, A_ = plain("q dq A")
    assert model.start == Boundary((None,), (S.Zero,))
    assert model.start_conditions == (Condition("q = A**2", q - A_**2),)
    assert model.end == Boundary((None,), (None,))
    assert model.end_conditions == (Condition("dq = -A", dq + A_),)


def test_bounds_of_velocities_are_path_conditions_in_lagrangian_form() -> None:
    fast = parameter("fast", 2)
    model = normalise(oscillator(bounds=lambda q, v, u: {v: (-fast, fast), q: (-1, None), u: (0, 0.1)}))
    q, dq, u, limit = plain("q dq u fast")
    assert model.bounds == (Bounds(q, S(-1), None), Bounds(u, S.Zero, S.One / 10))
    assert model.path == (Condition("dq >= -fast", -limit - dq, False), Condition("dq <= fast", dq - limit, False))


def test_bounds_and_conditions_of_momenta_in_hamiltonian_form() -> None:
    q, p = canonical_pair("q", "p")
    u = control("u")
    model = normalise(
        Control(
            hamiltonian=p**2 / 2 + q**2,
            force={q: u},
            cost=u**2,
            duration=1,
            start={q: 0, p: 0},
            bounds={p: (-1, 1)},
            end_conditions=[p <= q],
        )
    )
    Q, P = plain("q p")
    assert model.bounds == (Bounds(P, S(-1), S.One),)
    assert (model.path, model.end_conditions) == ((), (Condition("p <= q", P - Q, False),))


def test_decimal_numbers_become_rational() -> None:
    model = normalise(oscillator(path=lambda q, v, u: [0.1 * u <= 0.25, Eq(u, 0.5 * q)]))
    assert names(model.path) == ["0.1*u <= 0.25", "u = 0.5*q"]
    u, q = plain("u q")
    assert [condition.expression for condition in model.path] == [u / 10 - S.One / 4, u - q / 2]


def test_path_and_conditions_keep_their_order() -> None:
    radius = parameter("radius", 3)
    model = normalise(
        runners(
            bodies=1,
            bounds=lambda x, v: {v[0]: (None, 4)},
            path=lambda x, v: [x[0] ** 2 + x[1] ** 2 <= radius**2, v[1] >= -9],
            end_conditions=lambda x, v: [Eq(x[0] ** 2 + x[1] ** 2, 1), x[0] * v[0] + x[1] * v[1], v[0] <= 3],
        )
    )
    assert names(model.path) == ["dx <= 4", "x**2 + y**2 <= radius**2", "dy >= -9"]
    assert names(model.end_conditions) == ["x**2 + y**2 = 1", "x*dx + y*dy = 0", "dx <= 3"]
    assert [condition.equality for condition in model.end_conditions] == [True, True, False]


def test_a_control_may_act_in_the_path_alone() -> None:
    q, dq = coordinate("q")
    s = control("s")
    model = normalise(
        Control(lagrangian=dq**2 / 2, cost=s**2, duration=1, start={q: 0, dq: 1}, path=[Eq(s, q), s <= 2])
    )
    assert (model.controls, model.force) == ((Symbol("s", real=True),), (S.Zero,))


def test_holonomic_constraints() -> None:
    length = parameter("length", 2)
    model = normalise(
        runners(
            bodies=1,
            constraint=lambda x, v: [x[0] ** 2 + x[1] ** 2 - length**2],
            start=lambda x, v: {x[0]: length, x[1]: 0, v[0]: 0, v[1]: 1},
        )
    )
    x, y, length_ = plain("x y length")
    assert model.holonomic == (x**2 + y**2 - length_**2,)
    equation = normalise(runners(bodies=1, start={}, constraint=lambda x, v: [Eq(x[0], x[1] ** 2)]))
    assert equation.holonomic == (x - y**2,)


@pytest.mark.parametrize("as_mapping", [False, True])
def test_periodic(as_mapping: bool) -> None:
    period = parameter("period", 6.28)

    def periodic(q: Any, v: Any, u: Any) -> Any:
        return {q: period, v: 0} if as_mapping else [v, q]

    model = normalise(oscillator(start={}, cost=lambda q, v, u: u**2 + q * period, periodic=periodic))
    q, dq, shift = plain("q dq period")
    assert model.periodic == (((q, shift), (dq, S.Zero)) if as_mapping else ((dq, S.Zero), (q, S.Zero)))


def test_states_are_simulated_from_a_complete_start() -> None:
    x, y = states("x y")
    model = normalise(Simulate(dynamics={x: -y, y: x}, duration=1, start={x: 1, y: 0}))
    assert (model.form, [str(rate) for rate in model.dynamics]) == ("first-order", ["-y", "x"])
    with pytest.raises(CodegenError, match="start lacks y"):
        normalise(Simulate(dynamics={x: -y, y: x}, duration=1, start={x: 1}))


def test_models_are_equal_when_their_problems_read_alike() -> None:
    assert normalise(runners(end={})) == normalise(runners(end={}))
    assert replace(normalise(runners(bodies=3)), bodies=2) == normalise(runners(bodies=2))


ORDINARY = st.floats(-5, 5, allow_subnormal=False)  # numbers that have not all digits are refused as such


@pytest.mark.slow
@given(ORDINARY, ORDINARY, ORDINARY)
@example(-5e-98, 0.0, 2.220446049250313e-16)  # no more than sin(pi) is off, whose zero an author means
@example(-5e-98, 0.0, 1e-12)
def test_a_value_is_within_its_bounds_or_refused(lower: float, upper: float, value: float) -> None:
    """But for the digits that authors copy, and the rounding of numbers about one that they compute."""
    refused = False
    try:
        normalise(oscillator(start=lambda q, v, u: {q: value, v: 0}, bounds=lambda q, v, u: {q: (lower, upper)}))
    except CodegenError:
        refused = True
    slack = max(1e-9 * max(abs(value), abs(lower), abs(upper)), 200 * np.finfo(float).eps)
    if lower < upper and lower + slack <= value <= upper - slack:
        assert not refused
    if lower >= upper or value < lower - slack or value > upper + slack:
        assert refused


def test_infinite_bounds_and_whole_numbers_of_numpy_are_what_they_say() -> None:
    """Bounds often come from tables in which infinity stands for none."""
    x, u, w = state("x"), control("u"), control("w")
    bounds = {x: (-np.inf, 2.0), u: (-sympy.oo, sympy.oo), w: (np.float64(0), float("inf"))}
    model = normalise(
        Control(dynamics={x: u + w}, cost=u**2 + w**2, duration=1, start={x: 0}, bounds=bounds, steps=np.int64(7))
    )
    limits = {bound.symbol.name: (bound.lower, bound.upper) for bound in model.bounds}
    assert limits == {"x": (None, 2), "w": (0, None)}
    assert type(model.steps) is int
    assert model.steps == 7


@pytest.mark.parametrize(
    ("bounds", "lower"), [({}, 0), ({"lower": 0.5}, S.Half), ({"lower": -1}, -1), ({"upper": 3}, 0)]
)
def test_a_free_duration_is_not_negative_unless_its_author_says_so(bounds: dict[str, float], lower: Any) -> None:
    """In problems of one phase and of several; another free parameter stays as it is."""
    x, u, T, c = state("x"), control("u"), free_parameter("T", 1, **bounds), free_parameter("c", 1)
    phase = {"dynamics": {x: u + c}, "cost": u**2 + c**2, "duration": T}
    whole = Control(**phase, start={x: 0}, end={x: 1})
    chain = Phases(Control(**phase, start={x: 0}), Control(**phase, end={x: 1}))
    models = normalise(whole), normalise(chain), *normalise(chain).phases
    for model in models:
        assert {free.symbol.name: free.lower for free in model.free_parameters} == {"T": lower, "c": None}
