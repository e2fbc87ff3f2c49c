"""Normal forms of several bodies: values at their ends, couplings, and what differs from body to body."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from sympy import Eq, S, Symbol, sqrt
from written_problems import names, plain, runners

from codegen import Control, body_number, control, coordinates, free_parameter, states, time
from codegen.discretise.model.definitions import Bounds, Condition, EndValue
from codegen.discretise.model.from_problem import normalise
from codegen.errors import CodegenError
from codegen.problem.symbols import recorded_declarations


def test_couplings_and_conditions_of_each_body() -> None:
    model = normalise(
        runners(
            bodies=3,
            end=lambda x, v: {v[0]: 0},
            end_conditions=lambda x, v: [
                x[1].of(2) - x[0].of(1),
                Eq(v[1], 1),
                Eq(x[0].of(0) + x[0].of(1) + x[0].of(2), 3),
            ],
        )
    )
    x0, x1, x2, y2 = plain("x_0 x_1 x_2 y_2")
    assert model.end_values == (EndValue(x0, 0, 0), EndValue(x1, 0, 1), EndValue(x2, 0, 2), EndValue(y2, 1, 2))
    assert model.couplings == (Condition("-x_1 + y_2 = 0", y2 - x1), Condition("x_0 + x_1 + x_2 = 3", x0 + x1 + x2 - 3))
    assert names(model.end_conditions) == ["dy = 1"]
    assert model.bodies == 3


def test_couplings_of_states_and_free_parameters() -> None:
    x, v = states("x v")
    u = control("u")
    place = free_parameter("place", 1)
    model = normalise(
        Control(
            dynamics={x: v, v: u},
            cost=u**2,
            duration=1,
            start={x: 0, v: 0},
            end={v: 0},
            bodies=2,
            end_conditions=[x.of(0) - place, x.of(1) - place - 1],
        )
    )
    assert [value.coordinate for value in model.end_values] == [0, 0]
    assert model.couplings[1].expression == Symbol("x_1", real=True) - Symbol("place", real=True) - 1


def test_boundary_values_bounds_and_guesses_may_differ_from_body_to_body() -> None:
    i, t = body_number(), time()
    model = normalise(
        runners(
            bodies=4,
            start=lambda x, v: {x[0]: 1 + i, x[1]: 0},
            end=lambda x, v: {x[1]: sqrt(i)},
            bounds=lambda x, v: {x[0]: (None, i + 2)},
            guess=lambda x, v: {x[0]: i + t},
        )
    )
    body = Symbol("body", real=True)
    assert model.body == body
    assert model.start.positions == (1 + body, S.Zero)
    assert model.end is not None
    assert model.end.positions == (None, sqrt(body))
    assert model.bounds == (Bounds(Symbol("x", real=True), None, body + 2),)


def test_end_values_are_the_same_symbol_each_time() -> None:
    (x, y), _ = coordinates("x y")
    assert x.of(1) is x.of(1)
    assert len({x.of(0), x.of(1), y.of(1)}) == 3
    assert (str(x.of(1)), x.of(1).partner, x.of(1).body) == ("x_1", x, 1)


def test_end_values_need_not_be_used() -> None:
    with recorded_declarations() as declared:
        problem = runners(lagrangian=lambda x, v: (v[0] ** 2 + v[1] ** 2) / 2 + 0 * x[0].of(1))
    assert normalise(problem, declared).end_values == ()


@given(st.integers(1, 5), st.integers(0, 5))
def test_a_body_is_one_of_the_bodies(bodies: int, number: int) -> None:
    model, refusal = None, ""
    try:
        model = normalise(runners(bodies=bodies, end_conditions=lambda x, v: [x[0].of(number) - 1]))
    except CodegenError as error:
        refusal = str(error)
    assert (model is not None) == (number < bodies)
    assert (f"x.of({number}) is no body" in refusal) == (number >= bodies)
