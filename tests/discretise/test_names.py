"""Any identifier names a quantity: problems with names that generated code needs solve as with plain names."""

from __future__ import annotations

import ast

import interpreted
import numpy as np
import pytest
import sympy

from codegen import (
    Control,
    Pairwise,
    Phases,
    Simulate,
    body_number,
    canonical_pair,
    control,
    coordinate,
    coordinates,
    errors,
    free_parameter,
    parameter,
    particles,
    state,
    states,
    time,
)
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.model.pairwise import normalise_pairwise
from codegen.emit.lower.module import Origin
from codegen.emit.naming import Choices
from codegen.identifiers import MARK, renamed
from codegen.problem.symbols import recorded_declarations
from codegen.solving.compiler import generate_from_model

PLAIN = "a b c r e f g q v w".split()
NASTY = (
    "h steps state rows grid status duration residual interval guess min max len id x_k y_stage1 z_k1 t_k np math sin "
    "t gradient parameters hessian lambda match body _0 x0 h_1 lambda_x mu_x p_x start_x end_x d_x x start end "
    "tolerance log warm BODIES float shared common own lower upper nodes intervals solve Solution metadata nu_1 s_1 "
    "unknowns values range sum abs every lengths FRACTIONS PARTS dict isinstance x_0 x_1 θ Ω ü class None x_ x_k_ h_"
).split()


def first_order(names, **given):
    m, k, span = (parameter(name, value) for name, value in zip(names, (2.0, 3.0, 1.5), strict=False))
    f, t, u = free_parameter(names[3], 0.4, 0.1, 0.9), time(names[4]), control(names[5])
    x, v = state(names[6]), state(names[7])
    return Control(
        dynamics={x: v + 0.1 * sympy.sin(x), v: u / m - 0.1 * k * x},
        cost=u**2 * (m + t) + (f - sympy.Rational(1, 3)) ** 2 * k, duration=span, steps=6,
        start={x: 0, v: f}, end={x: k / 3}, bounds={u: (-10, 10)}, path=[x <= 5], end_conditions=[v + f * x - 1],
    )  # fmt: skip


def lagrangian(names, **given):
    m, k, span = (parameter(name, value) for name, value in zip(names, (2.0, 3.0, 1.5), strict=False))
    f, t, u = free_parameter(names[3], 0.4, 0.1, 0.9), time(names[4]), control(names[5])
    x, v = coordinate(names[6], names[7])
    return Control(
        lagrangian=m * v**2 / 2 - k * sympy.cos(x), force={x: u},
        cost=u**2 * (m + t) + (f - sympy.Rational(1, 3)) ** 2 * k, duration=span, steps=6,
        start={x: 0, v: f}, end={x: k / 3}, path=[u <= 8 + f], end_conditions=[v + f * x - 1],
        guess={x: k * t / 4}, **given,
    )  # fmt: skip


def hamiltonian(names):
    m, k, span = (parameter(name, value) for name, value in zip(names, (2.0, 3.0, 1.5), strict=False))
    f, t, u = free_parameter(names[3], 0.4, 0.1, 0.9), time(names[4]), control(names[5])
    x, p = canonical_pair(names[6], names[7])
    return Control(
        hamiltonian=p**2 / (2 * m) - k * sympy.cos(x), force={x: u}, cost=u**2 * (m + t) + (f - 0.4) ** 2,
        duration=span, steps=6, start={x: 0, p: f}, end={x: k / 3}, path=[u <= 8 + f],
    )  # fmt: skip


def phases(names):
    m, k, span = (parameter(name, value) for name, value in zip(names, (2.0, 3.0, 1.5), strict=False))
    f, u = free_parameter(names[3], 0.6, 0.1, 0.9), control(names[5])
    x, v = coordinate(names[6], names[7])

    def phase(stiffness, **given):
        return Control(
            lagrangian=m * v**2 / 2 - stiffness * sympy.cos(x), force={x: u}, cost=u**2 + (f - 0.5) ** 2, steps=4,
            path=[u <= 9 + f], **given,
        )  # fmt: skip

    first = phase(k, duration=f * span, start={x: 0, v: 0}, end={x: 0.3})
    return Phases(first, phase(k / 2, duration=span, end={x: 1, v: 0}), jumps=[{v: v / 2}])


def bodies(names):
    m, k, span = (parameter(name, value) for name, value in zip(names, (2.0, 3.0, 1.5), strict=False))
    number, u = body_number(), control(names[5])
    (x, y), (v, w) = coordinates(f"{names[6]} {names[7]}", f"{names[8]} {names[9]}")
    apart = (x.of(0) - x.of(1)) ** 2 + (y.of(0) - y.of(1)) ** 2
    return Control(
        lagrangian=m * (v**2 + w**2) / 2 - k * x**2 / 5, force={x: u, y: u / 3}, cost=u**2, duration=span, bodies=2,
        steps=4, start={x: number, y: 0, v: 0, w: 0}, end_conditions=[apart - 0.3, x.of(0) + x.of(1) - 1],
        guess={y: number / 10}, bounds={u: (-50, 50)},
    )  # fmt: skip


def simulated(names):
    m, k, span = (parameter(name, value) for name, value in zip(names, (2.0, 3.0, 1.5), strict=False))
    t = time(names[4])
    x, v = coordinate(names[6], names[7])
    return Simulate(
        lagrangian=m * v**2 / 2 + k * sympy.cos(x) * (1 + t / 10) + v * x**2 / 3, duration=span,
        start={x: m / 4, v: k / 5}, steps=8,
    )  # fmt: skip


CASES = [
    (first_order, {}), (first_order, {"scheme": "hermite-simpson"}), (lagrangian, {}),
    (lagrangian, {"method": "hamiltonian"}), (lagrangian, {"scheme": "gauss-4"}), (lagrangian, {"controls": "nodal"}),
    (hamiltonian, {}), (phases, {}), (phases, {"method": "hamiltonian"}), (bodies, {}),
    (bodies, {"method": "hamiltonian"}), (simulated, {}), (simulated, {"scheme": "yoshida-4"}),
    (simulated, {"scheme": "gauss-4"}), (simulated, {"method": "hamiltonian"}),
]  # fmt: skip


def solved(make, names, choices):
    module = interpreted.of_problem(make(names), **choices)
    solution = module.solve()
    assert solution.status == "solved"
    return module, solution.cost if hasattr(solution, "cost") else solution.q[-1, 0] + solution.p[-1, 0]


@pytest.mark.parametrize(("make", "choices"), CASES, ids=lambda case: getattr(case, "__name__", str(case)))
def test_names_change_nothing(make, choices):
    _, expected = solved(make, PLAIN, choices)
    generator = np.random.default_rng([len(str(choices)), *map(ord, make.__name__)])
    for _ in range(2):
        names = [str(name) for name in generator.choice(NASTY, 10, replace=False)]
        module, found = solved(make, names, choices)
        assert abs(found - expected) <= 1e-12 * abs(expected), names
        assert [*module.metadata.parameters] == names[:3]
        assert MARK not in str(module.metadata)
        assert names[6] in module.metadata.coordinates


def pair_text(names, task):
    """A module of particles; `names` are of coordinate, momentum, own parameter, common parameter."""
    with recorded_declarations() as declared:
        i, j = particles(names[0], names[1], names[2])
        stiff = parameter(names[3], 2.0)
    pair = stiff * i.own[0] * j.own[0] * (i.q[0] - j.q[0]) ** 2
    system = Pairwise((i, j), self_term=i.p[0] ** 2 / (2 * i.own[0]), pair_term=pair)
    start = {i.q[0]: [0.0, 1.0, 3.0], i.p[0]: [0.1, 0.0, 0.2], i.own[0]: [1.0, 2.0, 1.5]}
    problem = Simulate(hamiltonian=system, duration=1, start=start, steps=5)
    model = normalise_pairwise(problem, declared, "chain", "A chain")
    return generate_from_model(
        model, Choices("stormer-verlet"), Origin("test.py", "codegen build test.py", "0", ("0",))
    )


@pytest.mark.parametrize(
    "names",
    [
        "x p half steps",
        "h row m START",
        "half p_x i j",
        "θ y z rates",
        "s0 x1 row energy",
        "q by_q OWN z",
        "d dd log k",
    ],
)
def test_names_of_particles_change_nothing(names):
    expected = interpreted.without_compilation(pair_text("a b c e".split(), "simulate")).solve()
    module = interpreted.without_compilation(pair_text(names.split(), "simulate"))
    np.testing.assert_allclose(module.solve().q, expected.q, rtol=1e-13)
    assert (module.metadata.own, [*module.metadata.parameters]) == ((names.split()[2],), names.split()[3:])


def test_arguments_have_underscores_and_everything_else_the_authors_names():
    module = interpreted.of_problem(lagrangian("steps lambda θ guess tau id h dh".split()))
    solution = module.solve(8, steps_=2.0, lambda_=3.0, theta=1.5)
    assert solution.status == "solved"
    assert solution.t.size == 9
    assert "steps_ for steps, lambda_ for lambda, theta for θ" in module.__doc__
    assert module.metadata.free_parameters == ("guess",)
    assert module.metadata.start[0] == "h"


def test_an_underscore_more_where_the_name_with_one_is_taken():
    module = interpreted.of_problem(lagrangian("steps steps_ steps__ guess t u q v".split()))
    assert module.solve(steps_=3.0, steps___=2.0, steps__=1.5).status == "solved"
    assert [*module.metadata.parameters] == ["steps", "steps_", "steps__"]


def test_only_names_in_code_are_renamed():
    text = f'"""About x{MARK}."""\nx{MARK} = 1  # of x{MARK}\nx_ = {{"x{MARK}": x{MARK}}}\n'
    assert renamed(text) == '"""About x."""\nx__ = 1  # of x\nx_ = {"x": x__}\n'
    assert ast.parse(renamed(text))


@pytest.mark.parametrize("name", ["", "two words", "1x", "x-y", f"x{MARK}", 3, None])
def test_what_is_no_identifier_is_refused(name):
    with pytest.raises(errors.SymbolError, match=r"identifier|declares no symbol"):
        parameter(name, 1.0)


def test_a_range_stands_for_its_names():
    assert [x.name for x in states("x1:4, y z:2")] == ["x1", "x2", "x3", "y", "z0", "z1"]
    (_, second), (velocity, _) = coordinates("q:2")
    assert (second.name, velocity.name) == ("q1", "dq0")


def test_messages_have_the_authors_names():
    h, dh = coordinate("h")
    steps = parameter("steps", 1.0)
    problem = Control(lagrangian=dh**2 / 2, cost=h**2, duration=steps, start={h: 0}, end={dh: sympy.log(-steps)})
    with pytest.raises(errors.CodegenError, match=r"end of dh is log\(-steps\)"):
        interpreted.of_problem(problem)


def test_two_of_one_name_are_still_refused():
    names = ["a", "b", "c", "f", "t", "u", "x", "x"]
    with pytest.raises(errors.SymbolError, match="two symbols are called x"):
        interpreted.of_problem(first_order(names))


def test_time_is_the_same_each_time_it_is_declared():
    x, u = state("x"), control("u")
    problem = Control(dynamics={x: u * time()}, cost=u**2 + time(), duration=1, start={x: 0}, guess={u: time()})
    assert normalise(problem).dynamics[0].free_symbols == {normalise(problem).time, normalise(problem).controls[0]}
