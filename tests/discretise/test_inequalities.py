"""Path conditions and bounds, against closed forms and against each other."""

import numpy as np
import pytest
from dense_assembly import DenseProblem
from dense_layout import pinned_names

from codegen import (
    Control,
    body_number,
    canonical_pair,
    control,
    controls,
    coordinate,
    coordinates,
    free_parameter,
    parameters,
    states,
    time,
)
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.transcribe import transcribe
from codegen.errors import ExpressionError

MASS_METHODS = [("variational", "midpoint"), ("variational", "trapezoidal"), ("hamiltonian", "midpoint")]


def bryson_denham(limit: str) -> Control:
    """Least effort from x=0, v=1 to x=0, v=-1 in unit time below x = c: J = 4/(9 c). Bryson and Ho (1975), 3.11."""
    x, v = states("x v")
    u = control("u")
    (top,) = parameters(top=1 / 9)
    return Control(
        dynamics={x: v, v: u},
        cost=u**2 / 2,
        duration=1,
        start={x: 0, v: 1},
        end={x: 0, v: -1},
        bounds={x: (None, top)} if limit == "bounds" else {},
        path=[x <= top] if limit == "path" else [],
    )


@pytest.mark.parametrize("limit", ["bounds", "path"])
def test_state_constraint(limit):
    program = transcribe(normalise(bryson_denham(limit)), "trapezoidal")
    if limit == "path":
        assert [u.name for u in program.interval] == ["mu_x", "mu_v", "y_1"]
        assert [u.name for u in program.slacks] == ["s_1"]
        assert program.slack_multipliers == (2,)
        assert program.interval[2].multiplier
        assert not program.slacks[0].multiplier
    dense = DenseProblem(program, 12)
    result = dense.slsqp(dense.initial())
    assert dense.at_nodes(result.z, "x").max() == pytest.approx(1 / 9, abs=1e-6)
    assert result.fun == pytest.approx(4.0, rel=2e-2)


def test_bounds_and_path_conditions_at_nodes_are_the_same_problem():
    costs = [
        (dense := DenseProblem(transcribe(normalise(bryson_denham(limit))), 8)).slsqp(dense.initial()).fun
        for limit in ("bounds", "path")
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)


def limited_speed() -> Control:
    q, v = coordinate("q")
    u = control("u")
    (top,) = parameters(top=1.2)
    return Control(
        lagrangian=v**2, force={q: u}, cost=u**2 / 2, duration=1, start={q: 0, v: 0}, end={q: 1, v: 0},
        bounds={v: (None, top)},
    )  # fmt: skip


@pytest.mark.parametrize(("method", "scheme"), MASS_METHODS)
def test_velocity_bounds_hold_where_the_scheme_takes_the_velocity(method, scheme):
    program = transcribe(normalise(limited_speed()), scheme, method)
    assert len(program.slacks) == 1, "the same velocity at both points of the trapezoidal rule counts once"
    dense = DenseProblem(program, 10)
    result = dense.slsqp(dense.initial())
    speed = np.diff(dense.at_nodes(result.z, "q")) * 10
    assert speed.max() == pytest.approx(1.2, abs=1e-6)
    assert dense.on_intervals(result.z, "s_1") == pytest.approx(1.2 - speed, abs=1e-6)


def test_velocity_bounds_agree_between_the_methods():
    costs = []
    for method in ("variational", "hamiltonian"):
        dense = DenseProblem(transcribe(normalise(limited_speed()), "midpoint", method), 10)
        costs.append(dense.slsqp(dense.initial()).fun)
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)
    # With u = 2 v' the speed rises as a parabola during t1 = 3/2 (1 - 1/c), stays at c, and J = 16 c^2 / (3 t1).
    assert costs[0] == pytest.approx(16 * 1.2**2 / (3 * 0.25), rel=5e-2)


def test_control_inequality_equals_a_bound():
    x, v = states("x v")
    u = control("u")

    def problem(**how):
        return normalise(
            Control(dynamics={x: v, v: u}, cost=u**2 / 2, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0}, **how)
        )

    costs, names = [], []
    for how in ({"bounds": {u: (-5, 5)}}, {"path": [u <= 5, u >= -5]}):
        program = transcribe(problem(**how), "trapezoidal")
        dense = DenseProblem(program, 8)
        costs.append(dense.slsqp(dense.initial()).fun)
        names.append([s.name for s in program.slacks])
    assert names == [[], ["s_1", "s_2"]]
    assert costs[0] == pytest.approx(costs[1], rel=1e-8)
    free = DenseProblem(transcribe(problem(), "trapezoidal"), 8)
    assert costs[0] > free.cost(free.newton(free.initial())) + 1e-4


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_path_equality_on_coordinates_holds_at_nodes(method):
    (x, y), (dx, dy) = coordinates("x y")
    f, g = controls("f g")
    model = normalise(
        Control(
            lagrangian=(dx**2 + dy**2) / 2, force={x: f, y: g}, cost=(f**2 + g**2) / 2, duration=1,
            start={x: 0, y: 0, dx: 0, dy: 0}, end={x: 1, y: 1, dx: 0, dy: 0}, path=[y - x],
        )
    )  # fmt: skip
    program = transcribe(model, "midpoint", method)
    assert "y_1" in [u.name for u in program.node]
    assert "y_1" in pinned_names(program, program.start)
    assert "y_1" in pinned_names(program, program.end)
    # Equal places have equal velocities: of the four that are prescribed one follows from the others.
    assert (program.start.dependent, program.end.dependent) == ((), ("dy",))
    for steps in (4, 5, 6):
        dense = DenseProblem(program, steps)
        assert dense.condition_number(dense.initial()) < 1e6
    dense = DenseProblem(program, 5)
    z = dense.newton(dense.initial())
    assert dense.at_nodes(z, "x") == pytest.approx(dense.at_nodes(z, "y"), abs=1e-12)
    assert dense.cost(z) == pytest.approx(12 / (1 - 1 / 25), rel=1e-9)


def test_path_equality_on_controls_has_a_multiplier_on_intervals():
    (x,) = states("x")
    f, g = controls("f g")
    model = normalise(
        Control(dynamics={x: f + g}, cost=(f**2 + g**2) / 2, duration=1, start={x: 0}, end={x: 3}, path=[f - 2 * g])
    )
    program = transcribe(model)
    assert [u.name for u in program.interval] == ["mu_x", "y_1"]
    assert not program.slacks
    dense = DenseProblem(program, 4)
    z = dense.newton(dense.initial())
    assert dense.cost(z) == pytest.approx(2.5, rel=1e-12)


def test_moving_wall_also_at_a_free_start():
    """x >= 1 + t at every node, the first one included; x' = u with cost u^2/2 + x: x must follow the wall."""
    (x,) = states("x")
    u, t = control("u"), time()
    model = normalise(Control(dynamics={x: u}, cost=u**2 / 2 + 10 * x, duration=1, path=[x >= 1 + t]))
    program = transcribe(model, "trapezoidal")
    assert len(program.start.slacks) == 1
    assert not program.end.slacks
    dense = DenseProblem(program, 5)
    result = dense.slsqp(dense.initial() + 2.0)
    assert dense.at_nodes(result.z, "x") == pytest.approx(1 + np.linspace(0, 1, 6), abs=1e-5)


def test_control_limited_by_a_free_parameter():
    x, v = states("x v")
    u = control("u")
    top = free_parameter("top", 4.0)
    model = normalise(
        Control(
            dynamics={x: v, v: u}, cost=u**2 / 2, terminal_cost=top, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0},
            path=[u <= top],
        )
    )  # fmt: skip
    program = transcribe(model, "trapezoidal")
    assert len(program.slacks) == 1
    dense = DenseProblem(program, 8)
    result = dense.slsqp(dense.initial())
    assert dense.on_intervals(result.z, "u").max() == pytest.approx(dense.shared_value(result.z, "top"), abs=1e-6)


def test_momentum_bounds_of_a_hamiltonian():
    q, p = canonical_pair("q", "p")
    u = control("u")
    (m,) = parameters(m=2)
    model = normalise(
        Control(
            hamiltonian=p**2 / (2 * m), force={q: u}, cost=u**2 / 2, duration=1, start={q: 0, p: 0}, end={q: 1, p: 0},
            bounds={p: (-1, 2.4)},
        )
    )  # fmt: skip
    by_bounds = transcribe(model, "midpoint", "hamiltonian")
    assert [(u.name, u.lower, float(u.upper)) for u in by_bounds.node if u.upper is not None] == [("p", -1, 2.4)]
    by_conditions = transcribe(model, "midpoint", "variational")
    assert len(by_conditions.slacks) == 2
    assert not any(u.upper is not None for u in by_conditions.node)
    for program in (by_bounds, by_conditions):
        dense = DenseProblem(program, 10)
        result = dense.slsqp(dense.initial())
        assert np.diff(dense.at_nodes(result.z, "q")).max() * 10 == pytest.approx(1.2, abs=2e-2)


def test_names_avoid_the_author_s():
    (x,) = states("x")
    u = control("u")
    y_1, s_1 = parameters(y_1=2, s_1=3)
    model = normalise(Control(dynamics={x: u}, cost=u**2, duration=1, start={x: 0}, end={x: 1}, path=[u * y_1 <= s_1]))
    program = transcribe(model)
    assert [program.interval[-1].name, program.slacks[0].name] == ["y_2", "s_2"]


def test_momentum_bounds_that_differ_between_bodies_need_the_hamiltonian_method():
    q, p = canonical_pair("q", "p")
    u, body = control("u"), body_number()
    model = normalise(
        Control(
            hamiltonian=p**2 / 2, force={q: u}, cost=u**2, duration=1, start={q: 0, p: 0}, end={q: 1, p: 0}, bodies=2,
            bounds={p: (None, 3 + body)},
        )
    )  # fmt: skip
    assert str(transcribe(model, method="hamiltonian").node[1].upper) == "body + 3"
    with pytest.raises(ExpressionError, match=r"bound on p depends on the body's number.*--method hamiltonian"):
        transcribe(model, method="variational")
