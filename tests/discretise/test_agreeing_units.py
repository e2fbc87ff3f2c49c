"""Units that authors give: what follows from them by the rules of dimensions, and what is refused."""

from __future__ import annotations

import pickle

import pytest
from sympy import Abs, Max, Rational, atan2, cos, exp, log, pi, sqrt

from codegen import (
    Control,
    Phases,
    Simulate,
    body_number,
    canonical_pair,
    canonical_pairs,
    control,
    controls,
    coordinate,
    coordinates,
    free_parameter,
    parameters,
    state,
    states,
    time,
)
from codegen.discretise.model.from_problem import normalise
from codegen.errors import SymbolError, UnitError
from codegen.problem.description import described

theta, omega = coordinate("theta", unit="rad")
m, rod, g = parameters(m=(1, "kg"), rod=(0.5, "m"), g=(9.81, "m/s**2"))
torque = control("torque", unit="N*m")
LAGRANGIAN = m * rod**2 * omega**2 / 2 + m * g * rod * cos(theta)
SWING = {
    "lagrangian": LAGRANGIAN, "force": {theta: torque}, "cost": torque**2, "duration": 2,
    "start": {theta: 0, omega: 0}, "end": {theta: pi, omega: 0},
}  # fmt: skip


def units(problem):
    return dict(normalise(problem).units)


def test_what_follows_from_units():
    found = units(Control(**SWING))
    assert found == {
        "theta": "rad", "dtheta": "rad/s", "m": "kg", "rod": "m", "g": "m/s²", "torque": "N·m", "t": "s",
        "p_theta": "kg·m²/s", "energy": "J", "cost": "m²·N²·s",
    }  # fmt: skip


def test_without_units_there_are_none():
    q, dq = coordinate("q")
    assert normalise(Simulate(lagrangian=dq**2 / 2 - q**2, start={q: 1, dq: 0}, duration=1)).units == ()


def test_where_some_are_missing_nothing_is_derived_and_nothing_refused():
    q, dq = coordinate("q", unit="m")
    (k,) = parameters(k=2)
    found = units(Simulate(lagrangian=dq**2 / 2 - k * q**2, start={q: 1, dq: 0}, duration=1))
    assert found == {"q": "m", "dq": "m/s", "t": "s"}


def test_time_may_have_another_unit():
    x, u, t = state("x", unit="mol"), control("u", unit="mol/h"), time(unit="h")
    (tau,) = parameters(tau=(3, "h"))
    found = units(Control(dynamics={x: u}, cost=u**2 * exp(-t / tau), duration=2, start={x: 0}, end={x: 1}))
    assert found == {"x": "mol", "u": "mol/h", "tau": "h", "t": "h", "cost": "mol²/h"}
    assert time(unit="h") != time()
    assert time(unit="h") == time(unit="h")


def test_hamiltonians_and_states():
    q, p = canonical_pair("q", "p", unit="m", momentum_unit="kg*m/s")
    (k,) = parameters(k=(3, "N/m"))
    found = units(Simulate(hamiltonian=p**2 / (2 * m) + k * q**2 / 2, start={q: 1, p: 0}, duration=1))
    assert found == {"q": "m", "p": "kg·m/s", "m": "kg", "k": "N/m", "t": "s", "energy": "J"}


def test_phases_have_those_of_all():
    x, v = states("x v", unit="m m/s")
    u = control("u", unit="m/s**2")
    T = free_parameter("T", 1, lower=0.1, unit="s")
    motion = {"dynamics": {x: v, v: u}, "cost": u**2}
    found = units(Phases(
        Control(**motion, duration=T, start={x: 0, v: 0}, end={x: 1}), Control(**motion, duration=1, end={x: 2, v: 0})
    ))  # fmt: skip
    assert found["T"] == "s"
    assert found["cost"] == "m²/s³"


def test_lists_of_units():
    (r, phi), (dr, dphi) = coordinates("r phi", unit="m rad")
    assert [r.unit, phi.unit] == ["m", "rad"]
    assert not hasattr(dr, "unit")
    assert not hasattr(dphi, "unit")
    assert [u.unit for u in controls("a b", unit="N")] == ["N", "N"]
    (_, _), (a, b) = canonical_pairs("a b", "pa pb", unit="m", momentum_unit="N*s, kg*m/s")
    assert [a.unit, b.unit] == ["N*s", "kg*m/s"]
    with pytest.raises(SymbolError, match=r"2 units .* of 3 quantities; give one for all or one for each"):
        states("a b c", unit="m s")
    with pytest.raises(SymbolError, match="the unit of a is 3"):
        state("a", unit=3)


def test_units_belong_to_what_a_problem_says():
    """Pictures of modules in the cache have units, so that an object with others is another problem."""
    q, dq = coordinate("q")
    with_unit, rate = coordinate("q", unit="m")
    texts = [described(Simulate(lagrangian=v**2 / 2 - x**2, start={x: 1, v: 0}, duration=1)) for x, v in
             ((q, dq), (with_unit, rate))]  # fmt: skip
    assert texts[0] != texts[1]
    assert "unit" not in texts[0]
    assert pickle.loads(pickle.dumps(with_unit)).unit == "m"
    assert pickle.loads(pickle.dumps(time(unit="h") + 1)) == time(unit="h") + 1


def test_identical_bodies_that_meet_on_the_way_have_units_each():
    x, v = states("x v", unit="m m/s")
    u = control("u", unit="m/s**2")
    body, (d,) = body_number(), parameters(d=(0.5, "m"))
    found = units(Control(
        dynamics={x: v, v: u}, cost=u**2, duration=1, start={x: body, v: 0}, end={x: body + 1, v: 0}, bodies=2,
        path=[x.of(1) - x.of(0) >= d],
    ))  # fmt: skip
    assert (found["x_0"], found["v_1"], found["u_1"]) == ("m", "m/s", "m/s²")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"lagrangian": m * rod**2 * omega**2 / 2 + 9.81 * m * rod * cos(theta)}, "lagrangian: .* is in kg·m, .* in J"),
        ({"lagrangian": LAGRANGIAN.subs(cos(theta), cos(rod * theta))}, "in cos is in m"),
        ({"force": {theta: torque * rod}}, "force of theta is in m²·N, the Lagrangian by theta in J"),
        ({"start": {theta: rod, omega: 0}}, "start of theta is in m, theta in rad"),
        ({"duration": rod}, "duration is in m, the time in s"),
        ({"cost": torque**2 + theta**2}, "cost: .*theta.* is in .*"),
        ({"path": [torque <= rod]}, "path torque <= rod: .* is in .*m, .* in .*J|path torque <= rod: .* in m"),
        ({"bounds": {torque: (-rod, rod)}}, "lower bound of torque is in m, torque in "),
        ({"terminal_cost": theta}, "the integral of the cost is in m²·N²·s, the terminal cost in rad"),
    ],
)
def test_units_that_do_not_agree_are_refused(changed, said):
    with pytest.raises(UnitError, match=said):
        normalise(Control(**{**SWING, **changed}))


@pytest.mark.parametrize(
    ("unit", "said"),
    [
        ("smoot", "the unit 'smoot' of x is unknown"),
        ("kilogramm", "perhaps it is kilogram"),
        ("kg**", "is unknown"),
        ("degC", "does not begin at zero"),
    ],
)
def test_units_that_cannot_be_used(unit, said):
    x, u = state("x", unit=unit), control("u")
    with pytest.raises(UnitError, match=said):
        normalise(Control(dynamics={x: u}, cost=u**2, duration=1, start={x: 0}))


@pytest.mark.parametrize("other", ["km", "s", "deg"])
def test_sizes_must_agree_as_well(other):
    (r, x), (dr, dx) = coordinates("r x", unit=f"m {other}")
    with pytest.raises(UnitError):
        normalise(Simulate(lagrangian=m * (dr**2 + dx**2), start={r: 0, dr: 1, x: 0, dx: 1}, duration=1))


def test_a_degree_is_no_radian():
    q, dq = coordinate("q", unit="deg")
    with pytest.raises(UnitError, match="q in cos is in deg"):
        normalise(Simulate(lagrangian=m * dq**2 * rod**2 / 2 + m * g * rod * cos(q), start={q: 0, dq: 1}, duration=1))


def test_what_agrees_in_many_functions_is_accepted():
    (x, y), (dx, dy) = coordinates("x y", unit="m")
    k, c = parameters(k=(1, "N/m"), c=(1, "1"))
    distance = sqrt(x**2 + y**2)
    potential = (
        k * distance ** Rational(3, 2) * Max(distance, Abs(x)) ** Rational(1, 2) * exp(-c * x / (rod + distance))
    )
    force = k * x * log(1 + y**2 / rod**2) + k * rod * atan2(y, x)
    problem = Simulate(
        lagrangian=m * (dx**2 + dy**2) / 2 - potential, force={x: force}, start={x: rod, y: 1, dx: 0, dy: 0}, duration=1
    )
    assert units(problem)["energy"] == "J"


def test_plain_numbers_may_be_values_and_sides_of_relations():
    problem = Control(**{**SWING, "path": [torque <= 30, theta + 1 >= -3], "bounds": {omega: (-30, 30)}})
    assert units(problem)["cost"] == "m²·N²·s"
